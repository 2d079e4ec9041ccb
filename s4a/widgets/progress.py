"""An analysis in a process of its own.

Stage by stage how far it is, cancelled or opened while it runs.
"""

import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import ipywidgets

from s4a.study.options import Options
from s4a.study.pipeline import analyse, in_batches
from s4a.study.sources import find_sources
from s4a.study.store import open_study
from s4a.widgets.panel import Panel, paragraph, row

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


def work(answer, shapes, options):
    """Analyse, in the process of its own; the answer is the error's text, empty without one."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # its own bars would be written below the panel
    try:
        analyse(shapes, **options)
        answer.send("")
    except KeyboardInterrupt:
        answer.send("cancelled")
    except Exception as error:  # whatever it is, the panel must show it
        answer.send(f"{type(error).__name__}: {error}")


def clock(seconds):
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

    While the notebook stays free.

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

    def __init__(self, shapes, store, **options):
        self.folder, self.explored = Path(store), None
        self.arguments = shapes, options | {"store": str(store)}
        self.given = len(find_sources(shapes, options.get("pattern")))
        super().__init__(None)
        self.start()

    def start(self):
        """Run, from the beginning or where it stopped."""
        self.state, self.stopped, self.started = "running", threading.Event(), time.monotonic()
        self.first = {}
        context = multiprocessing.get_context("spawn")
        self.answer, there = context.Pipe(duplex=False)
        self.process = context.Process(target=work, args=(there, *self.arguments))
        self.process.start()
        there.close()
        self.stop.disabled, self.go_on.disabled = False, True
        threading.Thread(target=self.watch, args=(self.stopped,), daemon=True).start()

    def build(self):
        """A bar for each stage, and the buttons."""
        wide = {"description_width": "200px"}
        self.bars = {
            stage: ipywidgets.IntProgress(
                description=stage, max=1, style=wide, layout={"width": "440px"}
            )
            for stage in STAGES
        }
        self.texts = {stage: ipywidgets.HTML() for stage in STAGES}
        self.total = ipywidgets.HTML()
        self.stop = ipywidgets.Button(
            description="Cancel", tooltip="what is finished stays and is used again"
        )
        self.view = ipywidgets.Button(description="Open", tooltip="the stages that are finished")
        self.go_on = ipywidgets.Button(
            description="Resume", tooltip="where it stopped", disabled=True
        )
        self.go_on.on_click(self.guarded(lambda _: self.start()))
        self.stop.on_click(self.guarded(lambda _: self.cancel()))
        self.view.on_click(self.guarded(lambda _: self.show()))
        lines = [row(self.bars[stage], self.texts[stage]) for stage in STAGES]
        return [*lines, row(self.stop, self.go_on, self.view, self.total)]

    def watch(self, stopped):
        """Look at the folder until the process ends, in a thread of its own."""
        while self.process.is_alive() and not stopped.wait(EVERY):
            self.guarded(self.look)()
        if not stopped.is_set():
            self.guarded(self.finish)()

    def totals(self, shapes):
        """How many files each stage writes when so many shapes are usable."""
        pairs = min(self.arguments[1].get("n_pairs", Options.n_pairs), shapes * (shapes - 1) // 2)
        batches = len(in_batches(range(max(pairs, shapes - 1))))
        each = {stage: shapes for stage, (_, one_each) in STAGES.items() if one_each}
        return (
            dict.fromkeys(STAGES, 1)
            | each
            | {"read and clean": self.given, "first maps, in batches": batches}
        )

    def look(self):
        """Count the files of every stage.

        What is left is told from the pace since the first file of the stage.
        """
        now = time.monotonic()
        counts = {
            stage: len(list(self.folder.glob(pattern))) for stage, (pattern, _) in STAGES.items()
        }
        totals, after = self.totals(counts["read and clean"] or self.given), list(STAGES)
        for i, stage in enumerate(STAGES):
            done, whole = counts[stage], totals[stage]
            later = any(counts[name] for name in after[i + 1 :])
            bar, text = self.bars[stage], f"{done} of {whole}"
            bar.max, bar.value = whole, done
            ended = done >= whole or (done and later)
            bar.bar_style = "success" if ended else "info"
            begin, had, end = self.first.get(stage, (now, done, now))
            before = i == 0 or self.bars[after[i - 1]].bar_style == "success"
            if before and not (ended and stage not in self.first):
                self.first[stage] = begin, had, end if ended and end > begin else now
                text += f", {clock(self.first[stage][2] - begin)}"
            if had < done < whole:
                text += f", about {clock((now - begin) / (done - had) * (whole - done))} left"
            self.texts[stage].value = text
        self.total.value = paragraph(f"{self.state}, {clock(now - self.started)}")
        ready = [stage for stage in STAGES if self.bars[stage].bar_style == "success"]
        self.view.disabled = not ready
        if self.explored is not None and ready != self.opened:
            self.opened = ready
            self.explored.extend(open_study(self.folder))

    def finish(self):
        """What the process said at its end."""
        self.process.join()
        try:
            said = (
                self.answer.recv()
                if self.answer.poll()
                else f"the process ended with code {self.process.exitcode}"
            )
        except EOFError:
            said = f"the process ended with code {self.process.exitcode}"
        if self.state == "running":
            self.state = {"": "finished", "cancelled": "cancelled"}.get(said, "failed")
        self.look()
        if self.state == "failed":
            self.say(said, error=True)
        self.stop.disabled, self.go_on.disabled = True, self.state == "finished"

    def cancel(self):
        """End the process; the files that it wrote stay."""
        self.state = "cancelled"
        if self.process.is_alive():
            os.kill(self.process.pid, signal.SIGINT)
            self.process.join(5)
            if self.process.is_alive():
                self.process.terminate()
        self.say("cancelled; Resume, or the same store, goes on where it stopped")

    def show(self):
        """Open the panels of what is finished.

        They fill as other stages end, or at another click.
        """
        from s4a.widgets.explore import Explore

        self.opened = [stage for stage in STAGES if self.bars[stage].bar_style == "success"]
        study = open_study(self.folder)
        if self.explored is None:
            self.explored = Explore(study)
            self.children = [*self.children, self.explored]
        else:
            self.explored.refresh(study)

    def close(self):
        """Cancel a run that goes on, and close everything."""
        self.stopped.set()
        if self.process.is_alive():
            self.cancel()
        super().close()
