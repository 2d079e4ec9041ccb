"""Tasks of a run over a study folder (4): what is done already, processes, costs, failures."""

import contextlib
import faulthandler
import logging
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from joblib import delayed, effective_n_jobs
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from s4a.study.netcdf import is_done
from s4a.study.processes import died, interruption_kept, workers
from s4a.study.progress import Notes, Stage
from s4a.study.store import LOGS, Claim, open_without_following, task_key, write

log = logging.getLogger(__name__)

Keys = dict[str, str]  # name of a shape, or file of several -> key of what was computed
LONGEST = len("align flagged shapes: ")  # of the names beside the progress bar


@dataclass(frozen=True)
class Task:
    """One file of a study: how it is computed, and all that it depends on.

    Parameters
    ----------
    name : str
        Of the shape, or of the file where it is of several shapes.
    file : str
        Path in the folder of the study.
    function : callable
        Gives the Dataset of the file from the `arguments`.
    arguments : tuple
    inputs : tuple
        What the result depends on: keys of the tasks that it is made from, contents, parameters.
    made_from : tuple of str
        Keys of files without which :func:`s4a.open_study` leaves this one out.

    Examples
    --------
    >>> from s4a.study.runner import Task
    >>> task = Task("a", "coarse/a.nc", dict, (), ("key of original/a.nc", 6000))
    >>> task.key == Task("a", "coarse/a.nc", dict, (), ("key of original/a.nc", 3000)).key
    False
    """

    name: str
    file: str
    function: Callable[..., xr.Dataset]
    arguments: tuple[Any, ...]
    inputs: tuple[Any, ...]
    made_from: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The key of the result: of its inputs and the version of S4A."""
        return task_key(*self.inputs)

    @property
    def log(self) -> str:
        """The file in the folder of the study in which a task at work, or failed, is recorded."""
        return f"{LOGS}/{self.file.replace('/', '-').removesuffix('.nc')}.txt"

    @property
    def see(self) -> str:
        """Where its traceback is, in words."""
        return f"see {self.log} in the folder of the study"


class StageError(RuntimeError):
    """A stage that needs all shapes cannot be done, for a reason that is not in the input."""


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Parameters
    ----------
    name : str
        Of the task.
    failure : str
        Why there is no file; empty where it was written.
    unforeseen : bool
        Whether that is none of the errors with which S4A refuses its input.
    pid : int
    memory : float
        Peak of that process in MiB.
    """

    name: str
    failure: str = ""
    unforeseen: bool = False
    pid: int = 0
    memory: float = 0.0


class Run:
    """One run over a study folder: does what is not done yet, keeps time, memory and failures.

    Attributes
    ----------
    failures : dict of str to str
        Name of a shape that is left out -> why.
    unforeseen : list of str
        Those of them whose files are not the reason.
    costs : dict of str to tuple
        Seconds and MiB of every stage, those of earlier runs over the folder included.
    """

    def __init__(self, claim: Claim, n_jobs: int | None):
        self.folder, self.n_jobs, self.claim = claim.folder, n_jobs, claim
        self.notes = Notes(self.folder, claim.owner)
        self.failures, self.costs = self.notes.failures, self.notes.costs
        self.unforeseen: list[str] = []
        self.doing = "begin"
        self.bar: Any = None  # of tqdm, once a stage has something to do
        self.interrupted = threading.Event()

    @contextlib.contextmanager
    def stage(self, name: str, share: float = 1.0, *, done: int = 0, of: int = 1) -> Iterator[None]:
        """Time and peak memory of a stage (seconds; MiB, this process and its workers together).

        They are added to those of earlier runs over the folder where a `share` of the stage is left
        to do, and take their place where all of it is.  Its end is one line of the log.

        Parameters
        ----------
        name : str
        share : float
        done, of : int
            How many of its tasks are done, of how many.
        """
        self.end_if_interrupted()
        begin, now = time.perf_counter(), time.time()
        self.doing, self.workers = name, {}
        before = self.costs.get(name, [0.0, 0.0]) if share < 1 else [0.0, 0.0]
        self.notes.stages[name] = Stage(done, of, done, now, before[0], before[1], False)
        self.notes.write()
        whole = False
        try:
            yield
            whole = True
        finally:  # an interrupted stage has cost something too
            spent = time.perf_counter() - begin
            if share > 0 or name not in self.costs:
                peak = together(self.workers, effective_n_jobs(self.n_jobs))
                self.costs[name] = [before[0] + spent, float(np.fmax(before[1], peak))]
            n_done = of if whole else self.notes.stages[name].done
            seconds, peak = self.costs[name]
            self.notes.stages[name] = Stage(n_done, of, done, now, seconds, peak, whole)
            self.notes.write()
        log.info("%s: %d of %d were to do, %.1f s, %.0f MiB", name, of - done, of, spent, peak)

    def do(self, stage: str, tasks: list[Task], *, each: bool = True) -> Keys:
        """Do the tasks whose file is not done; name -> key of all that are done then.

        An error in a task is kept as a failure where the tasks are one for `each` shape, and raised
        where all need all.  One of files (no room, no such file) is always raised: it is not of the
        shape, and what is finished is kept.
        """
        missing = [task for task in tasks if not self.has(task)]
        n_done, share = len(tasks) - len(missing), len(missing) / max(len(tasks), 1)
        with self.stage(stage, share, done=n_done, of=len(tasks)):
            outcomes = self.outcomes(missing)
            if missing:
                self.show(stage, len(missing))
            for done in outcomes:
                self.end_if_interrupted()
                self.workers[done.pid] = max(done.memory, self.workers.get(done.pid, 0))
                if done.failure and not each:
                    raise (StageError if done.unforeseen else ValueError)(
                        f"{stage}: {done.failure}; what is finished is kept"
                    )
                if done.unforeseen:
                    log.warning("%s is left out: %s: %s", done.name, stage, done.failure)
                    self.unforeseen.append(done.name)
                if done.failure:
                    self.failures[done.name] = f"{stage}: {done.failure}"
                self.notes.add(stage)
                self.bar.update()
        return {task.name: task.key for task in tasks if task.name not in self.failures}

    def show(self, stage: str, total: int) -> tqdm:
        """The progress bar, at the beginning of a stage: one for all, which goes with the run."""
        stage = f"{stage}: ".ljust(LONGEST)
        if self.bar is None:
            # a line of the log for each stage instead, or nothing where warnings are off
            in_lines = log.isEnabledFor(logging.INFO) or not log.isEnabledFor(logging.WARNING)
            look = {"leave": False, "bar_format": "{desc}{percentage:3.0f}%|{bar}{r_bar}"}
            self.bar = tqdm(desc=stage, total=total, disable=in_lines, **look)
            if box := getattr(self.bar, "container", None):  # in a notebook
                box.children[0].layout.width = "17em"
        self.bar.set_description_str(stage, refresh=False)
        self.bar.reset(total)
        return self.bar

    def outcomes(self, tasks: list[Task]) -> Iterator[Outcome]:
        """Do the tasks side by side.

        When a worker dies, joblib ends the others too.  Those that were at work then come one at a
        time, until one dies alone: that one has failed, and the rest go on side by side.
        """
        todo = {task.name: task for task in tasks}
        suspects: list[str] = []
        while todo:
            alone, begun = suspects[:1], []

            def jobs(names=alone or list(todo), begun=begun):
                for name in names:
                    begun.append(name)
                    yield delayed(do_task)(todo[name], self.claim)

            n_jobs = max(2, effective_n_jobs(self.n_jobs)) if alone else self.n_jobs
            # meshes in memory go through the pipe: files to share them would outlive a killed run
            parallel = workers(n_jobs, return_as="generator_unordered", max_nbytes=None)
            try:
                for outcome in parallel(jobs()):
                    yield outcome
                    del todo[outcome.name]
                suspects = suspects[1:]
            except Exception as error:
                how = died(error)
                if not how:
                    raise
                if not begun:
                    raise StageError(f"processes die before they begin ({how})") from error
                for name in [one for one in begun if one in todo and self.has(todo[one])]:
                    yield Outcome(todo.pop(name).name)  # its process died before it could say so
                suspects = [name for name in begun if name in todo]
                if alone and suspects:
                    failure = f"its process died ({how}); {todo.pop(alone[0]).see}"
                    yield Outcome(alone[0], failure, True)
                    suspects = []

    def end_if_interrupted(self) -> None:
        """KeyboardInterrupt where Ctrl-C was asked for, and that of Python was lost."""
        if self.interrupted.is_set():
            raise KeyboardInterrupt

    def has(self, task: Task) -> bool:
        """Whether the file of a task is there, whole and of this key."""
        return is_done(self.folder / task.file, task.key)

    @contextlib.contextmanager
    def report_unforeseen(self) -> Iterator[None]:
        """An error that nobody foresaw becomes a StageError, its traceback a file of the study.

        The progress bar is gone at the end.
        """
        file = self.folder / LOGS / "run.txt"
        file.unlink(missing_ok=True)
        try:
            with interruption_kept() as self.interrupted:
                yield
            self.notes.write("finished")
        except (ValueError, OSError, StageError):
            self.end_if_interrupted()  # it may be what became of it
            raise
        except Exception as error:
            self.end_if_interrupted()
            note(file, traceback.format_exc())
            raise StageError(
                f"{self.doing}: {in_a_line(error)}: a fault of S4A or of its installation, not of "
                f"a shape; its traceback is in {file}; finished files are kept"
            ) from error
        finally:
            if self.notes.over != "finished":
                self.notes.write("stopped")
            if self.bar is not None:
                self.bar.close()


def do_task(task: Task, claim: Claim) -> Outcome:
    """Compute one Dataset and write its file; with one BLAS thread, as tasks run side by side."""
    claim.check()
    file = claim.folder / task.log
    failure, unforeseen = "", False
    with at_work(file, claim):
        try:
            with threadpool_limits(1):
                data = task.function(*task.arguments)
            write(data, claim.folder / task.file, task.key, task.made_from, claim)
        except OSError:  # of the folder or of the disk, not of the shape
            raise
        except (Exception, SystemExit) as error:  # whatever it is, it costs this task only
            claim.check()
            text, unforeseen = traceback.format_exc(), not isinstance(error, ValueError)
            failure = f"{in_a_line(error)}; {task.see}" if unforeseen else str(error)
    if failure:
        note(file, text)
    return Outcome(task.name, failure, unforeseen, os.getpid(), peak_memory())


def in_a_line(error: BaseException) -> str:
    """Kind and text of an error.

    Examples
    --------
    >>> from s4a.study.runner import in_a_line
    >>> in_a_line(IndexError("too\\nlarge"))
    'IndexError: too large'
    """
    text = " ".join(str(error).split())
    return type(error).__name__ + (f": {text[:300]}" if text else "")


def note(file: Path, text: str) -> None:
    """Write a file of the log, in place of what it said before."""
    with contextlib.suppress(OSError):  # the disk may be what the error is about
        file.parent.mkdir(parents=True, exist_ok=True)
        with open(file, "w", encoding="utf-8", opener=open_without_following) as log_of_task:
            log_of_task.write(text)


@contextlib.contextmanager
def at_work(file: Path, claim: Claim) -> Iterator[None]:
    """Record a task while a worker is at it; the record stays only where its process dies.

    It then says where, if the system let it: that of a segmentation fault.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(file.unlink, missing_ok=True)
        if os.getppid() == claim.owner:
            note(file, f"begun by process {os.getpid()}, {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
            with contextlib.suppress(OSError):  # what the task writes will tell
                record = open(file, "a", encoding="utf-8", opener=open_without_following)
                faulthandler.enable(stack.enter_context(record))
                stack.callback(faulthandler.enable)  # on the error stream, as joblib has it
        yield


def together(peaks: dict[int, float], n_jobs: int) -> float:
    """MiB of this process and its workers at most: of the largest where some took others' places.

    Parameters
    ----------
    peaks : dict of int to float
        Of every worker that there was, by its number; this process may be among them.
    n_jobs : int
        How many there were at once.
    """
    others = sorted(memory for pid, memory in peaks.items() if pid != os.getpid())
    return peak_memory() + sum(others[-n_jobs:])


def peak_memory() -> float:
    """Peak resident memory of this process in MiB; nan where the system does not say."""
    try:
        import resource
    except ImportError:  # on Windows, and in a browser
        return float("nan")
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
