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
import numpy as np
import xarray as xr

from s4a.show.browser import PARTS
from s4a.study.pipeline import analyse
from s4a.study.progress import STAGES, Stage, Status, status
from s4a.study.tree import open_study
from s4a.widgets.explore import Explore
from s4a.widgets.panel import Panel, row

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


def told(found: Status) -> str:
    """What a run takes now, and the shapes that it left out, with the reason."""
    text = ""
    if found.state == "running":
        text += f"; processes: {found.processes}, {found.memory:.0f} MiB now"
    return text + "".join(f"; left out {name}: {why}" for name, why in found.failures.items())


class Progress(Panel):
    """Runs :func:`s4a.analyse` in a process of its own and shows how far it is.

    Its lines are those of ``s4a status``.

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
        super().__init__(xr.DataTree())  # there is no study yet
        self.start()

    def start(self) -> None:
        """Run, from the beginning or where it stopped."""
        self.show_message("")
        self.view.disabled = not self.ready()
        self.state, self.stopped, self.started = "running", threading.Event(), time.monotonic()
        context = multiprocessing.get_context("spawn")
        try:
            self.answer, there = context.Pipe(duplex=False)
        except ImportError as error:
            raise ImportError(
                "Progress runs the analysis in a process of its own, and this kernel cannot start "
                "one, as in a browser: call s4a.analyse instead"
            ) from error
        self.process = context.Process(target=work, args=(there, *self.arguments))
        self.process.start()
        there.close()
        self.stop.disabled, self.go_on.disabled = False, True
        threading.Thread(target=self.watch, args=(self.stopped,), daemon=True).start()

    def build(self) -> list[ipywidgets.Widget]:
        """A bar for each stage, and the buttons."""
        wide = {"flex": "1 1 22em", "width": "auto", "min_width": "0", "max_width": "37em"}
        look = {"max": 1, "style": {"description_width": "min(18em, 60%)"}, "layout": wide}
        self.bars = {stage: ipywidgets.IntProgress(description=stage, **look) for stage in STAGES}
        self.texts = {stage: ipywidgets.HTML(layout={"flex": "1 1 12em"}) for stage in STAGES}
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

    def look(self) -> None:
        """Show how far every stage is, by what the run notes, and who was left out."""
        text = f"{self.state}, {clock(time.monotonic() - self.started)}"
        with contextlib.suppress(ValueError):  # nothing is noted yet
            found = status(self.folder)
            if found.owner == self.process.pid:  # not by the run before it
                for name, stage in found.stages.items():
                    self.show_stage(name, stage)
                text += told(found)
        self.total.value = PARTS.paragraph(text)
        ready = self.ready()
        self.view.disabled = not ready
        if self.explored is not None and ready != self.opened:
            self.opened = ready
            self.explored.extend(open_study(self.folder))

    def show_stage(self, name: str, stage: Stage) -> None:
        """How far a stage is, what it took, and how long it takes by its pace so far."""
        bar, now = self.bars[name], time.time()
        bar.max, bar.value = max(stage.all, 1), stage.done if stage.all else stage.ended
        bar.bar_style = "success" if stage.ended else "info"
        goes_on = self.state == "running" and not stage.ended
        text = f"{stage.done} of {stage.all}"
        text += f", {clock(stage.seconds + goes_on * (now - stage.begun))}"
        if stage.ended and np.isfinite(stage.memory):
            text += f", {stage.memory:.0f} MiB"
        if goes_on and np.isfinite(left := stage.remaining(now)):
            text += f", about {clock(left)} left"
        self.texts[name].value = text

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
            self.show_message(said, error=True)
        self.stop.disabled, self.go_on.disabled = True, self.state == "finished"

    def cancel(self) -> None:
        """End the process; the files that it wrote stay."""
        self.state = "cancelled"
        if self.process.pid and self.process.is_alive():
            os.kill(self.process.pid, signal.SIGINT)
            self.process.join(5)
            if self.process.is_alive():
                self.process.terminate()
        self.show_message("cancelled; Resume, or the same store, goes on where it stopped")

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
        if hasattr(self, "process") and self.process.is_alive():
            self.cancel()
        super().close()
