"""An analysis in a process of its own: how far each stage is, cancelled or opened while it runs."""

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import ipywidgets
import xarray as xr

from s4a.show.browser import PARTS
from s4a.study.options import Options
from s4a.study.pipeline import analyse, in_batches
from s4a.study.sources import find_sources
from s4a.study.tree import open_study
from s4a.widgets.explore import Explore
from s4a.widgets.panel import Panel, row

# stage: the files that it writes, and whether there is one for each shape
STAGES = {
    "read and clean": ("original/[!.]*.nc", True),
    "low resolution and spectrum": ("coarse/[!.]*.nc", True),
    "first maps, in batches": ("network/first_*.nc", False),
    "consistent maps and median": ("latent.nc", False),
    "registration": ("registration/[!.]*.nc", True),
    "modes": ("pca.nc", False),
}
EVERY = 0.5  # seconds
Shapes = Path | str | list[Path | str] | dict[str, Any] | xr.DataTree


def work(answer: Any, shapes: Any, options: dict[str, Any]) -> None:
    """Analyse, in the process of its own; the answer is the error's text, empty without one."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # its own bars would be written below the panel
    try:
        analyse(shapes, **options)
        answer.send("")
    except KeyboardInterrupt:
        answer.send("cancelled")
    except Exception as error:  # whatever it is, the panel must show it
        answer.send(f"{type(error).__name__}: {error}")


def clock(seconds: float) -> str:
    """Minutes and seconds.

    Examples
    --------
    >>> from s4a.widgets.progress import clock
    >>> clock(75.2)
    '1:15'
    """
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


class Progress(Panel):
    """Runs :func:`s4a.analyse` in a process of its own and shows how far it is.

    Parameters
    ----------
    shapes : see :func:`s4a.analyse`
    store : path
        Folder of the study; a cancelled run goes on where it stopped when it is started with the
        same.
    **options
        Of :func:`s4a.analyse`.

    Attributes
    ----------
    state : {"running", "finished", "cancelled", "failed"}
    explored : Explore or None
        The panels, once they were opened.
    """

    title = "Progress"

    def __init__(self, shapes: Shapes, store: Path | str, **options: Any):
        self.folder, self.explored = Path(store), None
        self.opened = []  # the stages that were ready when the panels were filled
        self.arguments = shapes, options | {"store": str(store)}
        volumes = options.get("label") is not None
        self.n_shapes = len(find_sources(shapes, options.get("pattern"), volumes=volumes))
        super().__init__(xr.DataTree())  # there is no study yet
        self.start()

    def start(self) -> None:
        """Run, from the beginning or where it stopped."""
        self.state, self.stopped, self.started = "running", threading.Event(), time.monotonic()
        self.clocks = {}  # stage -> when its first file was seen, how many there were, its end
        context = multiprocessing.get_context("spawn")
        self.answer, there = context.Pipe(duplex=False)
        self.process = context.Process(target=work, args=(there, *self.arguments))
        self.process.start()
        there.close()
        self.stop.disabled, self.go_on.disabled = False, True
        threading.Thread(target=self.watch, args=(self.stopped,), daemon=True).start()

    def build(self) -> list[ipywidgets.Widget]:
        """A bar for each stage, and the buttons."""
        look = {"max": 1, "style": {"description_width": "15em"}, "layout": {"width": "34em"}}
        self.bars = {stage: ipywidgets.IntProgress(description=stage, **look) for stage in STAGES}
        self.texts = {stage: ipywidgets.HTML() for stage in STAGES}
        self.total = ipywidgets.HTML()
        self.stop = self.button("Cancel", self.cancel, "what is finished stays and is used again")
        self.go_on = self.button("Resume", self.start, "where it stopped", disabled=True)
        self.view = self.button("Open", self.show, "the stages that are finished")
        lines = [row(self.bars[stage], self.texts[stage]) for stage in STAGES]
        return [*lines, row(self.stop, self.go_on, self.view, self.total)]

    def watch(self, stopped: threading.Event) -> None:
        """Look at the folder until the process ends, in a thread of its own."""
        while self.process.is_alive() and not stopped.wait(EVERY):
            self.guarded(self.look)()
        if not stopped.is_set():
            self.guarded(self.finish)()

    def totals(self, shapes: int) -> dict[str, int]:
        """How many files each stage writes when so many shapes are usable."""
        pairs = min(self.arguments[1].get("n_pairs", Options.n_pairs), shapes * (shapes - 1) // 2)
        totals = {stage: shapes if each else 1 for stage, (_, each) in STAGES.items()}
        totals["read and clean"] = self.n_shapes
        totals["first maps, in batches"] = len(in_batches(range(max(pairs, shapes - 1))))
        return totals

    def look(self) -> None:
        """Count the files of every stage, and show how far it is."""
        now = time.monotonic()
        counts = {
            stage: len(list(self.folder.glob(pattern))) for stage, (pattern, _) in STAGES.items()
        }
        totals = self.totals(counts["read and clean"] or self.n_shapes)
        reached = True  # the stage before has ended
        for i, stage in enumerate(STAGES):
            done, whole = counts[stage], totals[stage]
            later = any(list(counts.values())[i + 1 :])
            ended = done >= whole or (done > 0 and later)
            bar = self.bars[stage]
            bar.max, bar.value = whole, done
            bar.bar_style = "success" if ended else "info"
            self.texts[stage].value = self.told(stage, done, whole, ended, reached, now)
            reached = ended
        self.total.value = PARTS.paragraph(f"{self.state}, {clock(now - self.started)}")
        ready = self.ready()
        self.view.disabled = not ready
        if self.explored is not None and ready != self.opened:
            self.opened = ready
            self.explored.extend(open_study(self.folder))

    def told(
        self, stage: str, done: int, whole: int, ended: bool, reached: bool, now: float
    ) -> str:
        """How far a stage is, since when, and how long it takes by its pace so far."""
        text = f"{done} of {whole}"
        begin, had, end = self.clocks.get(stage, (now, done, now))
        if reached and not (ended and stage not in self.clocks):
            self.clocks[stage] = begin, had, end if ended and end > begin else now
            text += f", {clock(self.clocks[stage][2] - begin)}"
        if had < done < whole:
            text += f", about {clock((now - begin) / (done - had) * (whole - done))} left"
        return text

    def ready(self) -> list[str]:
        """The stages that have ended."""
        return [stage for stage, bar in self.bars.items() if bar.bar_style == "success"]

    def finish(self) -> None:
        """What the process said at its end."""
        self.process.join()
        said = f"the process ended with code {self.process.exitcode}"
        with contextlib.suppress(EOFError):
            if self.answer.poll():
                said = self.answer.recv()
        if self.state == "running":
            self.state = {"": "finished", "cancelled": "cancelled"}.get(said, "failed")
        self.look()
        if self.state == "failed":
            self.say(said, error=True)
        self.stop.disabled, self.go_on.disabled = True, self.state == "finished"

    def cancel(self) -> None:
        """End the process; the files that it wrote stay."""
        self.state = "cancelled"
        if self.process.pid and self.process.is_alive():
            os.kill(self.process.pid, signal.SIGINT)
            self.process.join(5)
            if self.process.is_alive():
                self.process.terminate()
        self.say("cancelled; Resume, or the same store, goes on where it stopped")

    def show(self) -> None:
        """Open the panels of what is finished; they fill as other stages end."""
        self.opened = self.ready()
        study = open_study(self.folder)
        if self.explored is None:
            self.explored = Explore(study)
            self.children = [*self.children, self.explored]
        else:
            self.explored.refresh(study)

    def close(self) -> None:
        """Cancel a run that goes on, and close everything."""
        self.stopped.set()
        if self.process.is_alive():
            self.cancel()
        super().close()
