"""An analysis in its own process: progress of each stage, cancelled or opened while it runs."""

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
    """Analyse in the child process, and send the text of the error, empty for none."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # hide the progress bars of the child process
    try:
        analyse(shapes, **options)
        answer.send("")
    except KeyboardInterrupt:
        answer.send("cancelled")
    except Exception as error:  # the panel must show any error
        answer.send(f"{type(error).__name__}: {error}")


def clock(seconds: float) -> str:
    """Format a duration as minutes and seconds.

    Examples
    --------
    >>> from s4a.widgets.progress import clock
    >>> clock(75.2)
    '1:15'
    """
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def status_text(run: Status) -> str:
    """Return processes and memory of a run, and the shapes that failed with the reason."""
    text = ""
    if run.state == "running":
        text += f"; processes: {run.processes}, {run.memory:.0f} MiB now"
    return text + "".join(f"; left out {name}: {why}" for name, why in run.failures.items())


class Progress(Panel):
    """Run :func:`s4a.analyse` in its own process and show the progress of each stage.

    Parameters
    ----------
    shapes : see :func:`s4a.analyse`
    store : path
        Folder of the study; a cancelled run resumes when it is started with the same folder.
    **options
        Options of :func:`s4a.analyse`.

    Attributes
    ----------
    state : {"running", "finished", "cancelled", "failed"}
    explored : Explore or None
        The panels, once they have been opened.

    See Also
    --------
    s4a.analyse : the same analysis in this process.
    """

    title = "Progress"

    def __init__(self, shapes: Shapes, store: Path | str, **options: Any):
        self.folder, self.explored = Path(store), None
        self.opened = []  # the stages that were ready when the panels were filled
        self.arguments = shapes, options | {"store": str(store)}
        super().__init__(xr.DataTree())  # there is no study yet
        self.start()

    def start(self) -> None:
        """Start or resume the run."""
        self.show_message("")
        self.view.disabled = not self.ready()
        self.state, self.stopped, self.started = "running", threading.Event(), time.monotonic()
        context = multiprocessing.get_context("spawn")
        try:
            self.answer, sender = context.Pipe(duplex=False)
        except ImportError as error:
            raise ImportError(
                "Progress runs the analysis in its own process, which this kernel cannot start (as "
                "in a browser): call s4a.analyse instead"
            ) from error
        self.process = context.Process(target=work, args=(sender, *self.arguments))
        self.process.start()
        sender.close()
        self.stop.disabled, self.resume.disabled = False, True
        threading.Thread(target=self.watch, args=(self.stopped,), daemon=True).start()

    def build(self) -> list[ipywidgets.Widget]:
        """Return a progress bar for each stage, and the buttons."""
        layout = {"flex": "1 1 22em", "width": "auto", "min_width": "0", "max_width": "37em"}
        options = {"max": 1, "style": {"description_width": "min(18em, 60%)"}, "layout": layout}
        self.bars = {name: ipywidgets.IntProgress(description=name, **options) for name in STAGES}
        self.texts = {stage: ipywidgets.HTML(layout={"flex": "1 1 12em"}) for stage in STAGES}
        self.total = ipywidgets.HTML()
        self.stop = self.button("Cancel", self.cancel, "stop the run; finished tasks are kept")
        self.resume = self.button("Resume", self.start, "resume the run", disabled=True)
        self.view = self.button("Open", self.show, "show the finished stages")
        rows = [row(self.bars[stage], self.texts[stage]) for stage in STAGES]
        return [*rows, row(self.stop, self.resume, self.view, self.total)]

    def watch(self, stopped: threading.Event) -> None:
        """Poll the folder until the process ends; runs in its own thread."""
        while self.process.is_alive() and not stopped.wait(EVERY):
            self.guarded(self.update)()
        if not stopped.is_set():
            self.guarded(self.finish)()

    def update(self) -> None:
        """Show the progress of every stage and the shapes that failed, by the run's notes."""
        text = f"{self.state}, {clock(time.monotonic() - self.started)}"
        with contextlib.suppress(ValueError):  # no notes yet
            run = status(self.folder)
            if run.owner == self.process.pid:  # not of the previous run
                for name, stage in run.stages.items():
                    self.show_stage(name, stage)
                text += status_text(run)
        self.total.value = PARTS.paragraph(text)
        ready = self.ready()
        self.view.disabled = not ready
        if self.explored is not None and ready != self.opened:
            self.opened = ready
            self.explored.extend(open_study(self.folder))

    def show_stage(self, name: str, stage: Stage) -> None:
        """Show the progress of a stage, its time and memory, and the estimated time left."""
        bar, now = self.bars[name], time.time()
        bar.max, bar.value = max(stage.all, 1), stage.done if stage.all else stage.ended
        bar.bar_style = "success" if stage.ended else "info"
        running = self.state == "running" and not stage.ended
        text = f"{stage.done} of {stage.all}"
        text += f", {clock(stage.seconds + running * (now - stage.begun))}"
        if stage.ended and np.isfinite(stage.memory):
            text += f", {stage.memory:.0f} MiB"
        if running and np.isfinite(left := stage.remaining(now)):
            text += f", about {clock(left)} left"
        self.texts[name].value = text

    def ready(self) -> list[str]:
        """Return the finished stages."""
        return [stage for stage, bar in self.bars.items() if bar.bar_style == "success"]

    def finish(self) -> None:
        """Show how the process ended."""
        self.process.join()
        message = f"the process ended with code {self.process.exitcode}"
        with contextlib.suppress(EOFError):
            if self.answer.poll():
                message = self.answer.recv()
        if self.state == "running":
            self.state = {"": "finished", "cancelled": "cancelled"}.get(message, "failed")
        self.update()
        if self.state == "failed":
            self.show_message(message, error=True)
        self.stop.disabled, self.resume.disabled = True, self.state == "finished"

    def cancel(self) -> None:
        """End the process; the files that it wrote are kept."""
        self.state = "cancelled"
        if self.process.pid and self.process.is_alive():
            os.kill(self.process.pid, signal.SIGINT)
            self.process.join(5)
            if self.process.is_alive():
                self.process.terminate()
        self.show_message("cancelled; press Resume, or start again with the same store")

    def show(self) -> None:
        """Open the panels of the finished stages; others are filled when their stage ends."""
        self.opened = self.ready()
        study = open_study(self.folder)
        if self.explored is None:
            self.explored = Explore(study)
            self.children = [*self.children, self.explored]
        else:
            self.explored.refresh(study)

    def close(self) -> None:
        """Cancel a running analysis, and close all widgets."""
        self.stopped.set()
        if hasattr(self, "process") and self.process.is_alive():
            self.cancel()
        super().close()
