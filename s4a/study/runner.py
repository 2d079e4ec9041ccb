"""Run the tasks of a study (4): skip finished ones, in parallel, with costs and failures."""

import contextlib
import faulthandler
import functools
import logging
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from joblib import delayed, effective_n_jobs
from threadpoolctl import ThreadpoolController
from tqdm.auto import tqdm

from s4a.input.raw import sentences
from s4a.study.netcdf import is_done
from s4a.study.processes import died, interruption_kept, workers
from s4a.study.progress import Notes, Stage
from s4a.study.store import LOCK, LOGS, Claim, open_without_following, task_key, write

log = logging.getLogger(__name__)

Keys = dict[str, str]  # name of a shape, or file of several -> key of the result


def names_and_keys(stage: str, keys: Keys) -> tuple[str, ...]:
    """Return names and keys of the files of shapes, for files that are made from them.

    Examples
    --------
    >>> from s4a.study.runner import names_and_keys
    >>> names_and_keys("coarse", {"a": "0c1d"})
    ('coarse/a=0c1d',)
    """
    return tuple(f"{stage}/{name}={key}" for name, key in keys.items())


LONGEST = len("insert flagged shapes: ")  # longest text before the progress bar


@dataclass(frozen=True)
class Task:
    """One file of a study, with its function and dependencies.

    Parameters
    ----------
    name : str
        Name of the shape, or of the file if it is of several shapes.
    file : str
        Path in the folder of the study.
    function : callable
        Function of the `arguments` that returns the Dataset of the file.
    arguments : tuple
    inputs : tuple
        Dependencies of the result: keys of other tasks, contents, parameters.
    made_from : tuple of str
        Names and keys, ``name=key``, of files that :func:`s4a.open_study` needs to use this one.

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
        """Key of the result: a hash of its inputs and the version of S4A."""
        return task_key(*self.inputs)

    @property
    def log(self) -> str:
        """Log file of the task in the folder of the study, while it runs or if it failed."""
        return f"{LOGS}/{self.file.replace('/', '-').removesuffix('.nc')}.txt"

    @property
    def see(self) -> str:
        """Reference to the log file, for messages."""
        return f"see {self.log} in the folder of the study"


class StageError(RuntimeError):
    """A stage of all shapes failed for a reason other than the input."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task.

    Parameters
    ----------
    name : str
        Name of the task.
    failure : str
        Reason why there is no file; empty if it was written.
    unforeseen : bool
        The failure is not an error of S4A about its input.
    pid : int
    memory : float
        Peak memory of the process in MiB.
    """

    name: str
    failure: str = ""
    unforeseen: bool = False
    pid: int = 0
    memory: float = 0.0


class Run:
    """A run over a study folder, with its costs and failures.

    Attributes
    ----------
    failures : dict of str to str
        Name of an excluded shape -> reason.
    unforeseen : list of str
        Shapes that failed for a reason other than their files.
    costs : dict of str to tuple
        Seconds and MiB of every stage, in all runs over the folder.
    """

    def __init__(self, claim: Claim, n_jobs: int | None, system: Mapping[str, str] | None = None):
        self.system = system  # attributes of the coordinate system to convert shapes to
        self.folder, self.n_jobs, self.claim = claim.folder, n_jobs, claim
        self.notes = Notes(self.folder, claim.owner)
        self.failures, self.costs = self.notes.failures, self.notes.costs
        self.unforeseen: list[str] = []
        self.doing = "begin"
        self.bar: Any = None  # of tqdm, once a stage has something to do
        self.interrupted = threading.Event()

    @contextlib.contextmanager
    def stage(
        self, name: str, share: float = 1.0, *, done: int = 0, total: int = 1
    ) -> Iterator[None]:
        """Record time and peak memory (MiB, of this process and its workers) of a stage.

        They are added to those of earlier runs if only a share of the stage is left to do, else
        they replace them.

        Parameters
        ----------
        name : str
        share : float
            Share of the stage that is left to do.
        done, total : int
            Number of finished tasks, and of all tasks.
        """
        self.end_if_interrupted()
        begin, now = time.perf_counter(), time.time()
        self.doing, self.workers = name, {}
        before = self.costs.get(name, [0.0, 0.0]) if share < 1 else [0.0, 0.0]
        self.notes.stages[name] = Stage(done, total, done, now, before[0], before[1], False)
        self.notes.write()
        completed = False
        try:
            yield
            completed = True
        finally:  # an interrupted stage has costs too
            spent = time.perf_counter() - begin
            if share > 0 or name not in self.costs:
                peak = total_memory(self.workers, effective_n_jobs(self.n_jobs))
                self.costs[name] = [before[0] + spent, float(np.fmax(before[1], peak))]
            n_done = total if completed else self.notes.stages[name].done
            seconds, peak = self.costs[name]
            self.notes.stages[name] = Stage(n_done, total, done, now, seconds, peak, completed)
            self.notes.write()
        text = "%s: %d of %d tasks computed, %.1f s, %.0f MiB"
        log.info(text, name, total - done, total, spent, peak)

    def do(self, stage: str, tasks: list[Task], *, each: bool = True) -> Keys:
        """Run the tasks whose file is not done; return name -> key of all finished tasks.

        With one task for `each` shape, an error is recorded as failure of the shape; else it is
        raised.  Errors of the file system are always raised.  Finished files are kept.
        """
        missing = [task for task in tasks if not self.has(task)]
        n_done, share = len(tasks) - len(missing), len(missing) / max(len(tasks), 1)
        with self.stage(stage, share, done=n_done, total=len(tasks)):
            outcomes = self.outcomes(missing)
            if missing:
                self.show(stage, len(missing))
            for outcome in outcomes:
                self.end_if_interrupted()
                pid, memory = outcome.pid, outcome.memory
                self.workers[pid] = max(memory, self.workers.get(pid, 0))
                if outcome.failure and not each:
                    raise (StageError if outcome.unforeseen else ValueError)(
                        f"{stage}: {outcome.failure}; finished files are kept"
                    )
                if outcome.unforeseen:
                    log.warning("%s is excluded: %s: %s", outcome.name, stage, outcome.failure)
                    self.unforeseen.append(outcome.name)
                if outcome.failure:
                    self.failures[outcome.name] = f"{stage}: {outcome.failure}"
                self.notes.add(stage)
                self.bar.update()
        return {task.name: task.key for task in tasks if task.name not in self.failures}

    def show(self, stage: str, total: int) -> tqdm:
        """Reset the progress bar of the run at the beginning of a stage, and return it."""
        stage = f"{stage}: ".ljust(LONGEST)
        if self.bar is None:
            # a log line for each stage instead, or nothing if warnings are off
            is_off = log.isEnabledFor(logging.INFO) or not log.isEnabledFor(logging.WARNING)
            style = {"leave": False, "bar_format": "{desc}{percentage:3.0f}%|{bar}{r_bar}"}
            self.bar = tqdm(desc=stage, total=total, disable=is_off, **style)
            if box := getattr(self.bar, "container", None):  # in a notebook
                box.children[0].layout.width = "17em"
        self.bar.set_description_str(stage, refresh=False)
        self.bar.reset(total)
        return self.bar

    def outcomes(self, tasks: list[Task]) -> Iterator[Outcome]:
        """Run the tasks in parallel.

        If a worker dies, joblib ends the others too.  The tasks that were running are then repeated
        one at a time until one dies again.  That task has failed, and the others run in parallel.
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
            parallel = workers(n_jobs, return_as="generator_unordered")
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
                for name in [name for name in begun if name in todo and self.has(todo[name])]:
                    yield Outcome(todo.pop(name).name)  # the process died after writing the file
                suspects = [name for name in begun if name in todo]
                if alone and suspects:
                    failure = f"its process died ({how}); {todo.pop(alone[0]).see}"
                    yield Outcome(alone[0], failure, True)
                    suspects = []

    def end_if_interrupted(self) -> None:
        """Raise KeyboardInterrupt after Ctrl-C, if the exception of Python was lost."""
        if self.interrupted.is_set():
            raise KeyboardInterrupt

    def has(self, task: Task) -> bool:
        """Return whether the file of a task exists, undamaged and with this key."""
        return is_done(self.folder / task.file, task.key)

    @contextlib.contextmanager
    def report_unforeseen(self) -> Iterator[None]:
        """Turn an unforeseen error into a StageError, with the traceback in a file of the study.

        The progress bar is closed at the end.
        """
        file = self.folder / LOGS / "run.txt"
        file.unlink(missing_ok=True)
        try:
            with interruption_kept() as self.interrupted:
                yield
            self.notes.write("finished")
        except (ValueError, OSError, StageError) as error:
            self.end_if_interrupted()  # the interrupt may be the cause
            gone = getattr(error, "filename", "") if isinstance(error, FileNotFoundError) else ""
            if gone or not (self.folder / LOCK).is_file():
                gone = gone if (self.folder / LOCK).is_file() else self.folder
                raise OSError(
                    f"{gone} was removed or replaced during the run: start it again, and keep the "
                    "folder of the study in its place until the run ends"
                ) from error
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


@functools.cache
def blas() -> ThreadpoolController:
    """Return the BLAS libraries of this process, which take two milliseconds to find."""
    return ThreadpoolController()


def do_task(task: Task, claim: Claim) -> Outcome:
    """Compute one Dataset and write its file, with one BLAS thread, as tasks run in parallel."""
    claim.check()
    file = claim.folder / task.log
    failure, unforeseen = "", False
    with at_work(file, claim):
        try:
            with blas().limit(limits=1):
                data = task.function(*task.arguments)
            name, path = task.file.removesuffix(".nc"), claim.folder / task.file
            write(data, path, task.key, task.made_from, claim, name=name)
        except OSError:  # of the folder or the disk, not of the shape
            raise
        except (Exception, SystemExit) as error:  # any error stops this task only
            claim.check()
            text, unforeseen = traceback.format_exc(), not isinstance(error, ValueError)
            failure = f"{in_a_line(error)}; {task.see}" if unforeseen else str(error)
    if failure:
        note(file, text)
    return Outcome(task.name, failure, unforeseen, os.getpid(), peak_memory())


def in_a_line(error: BaseException) -> str:
    """Format type and text of an error in one line.

    Examples
    --------
    >>> from s4a.study.runner import in_a_line
    >>> in_a_line(IndexError("too\\nlarge"))
    'IndexError: too large'
    """
    text = " ".join(str(error).split())
    return type(error).__name__ + (f": {sentences(text, 300)}" if text else "")


def note(file: Path, text: str) -> None:
    """Write a log file, replacing its content."""
    with contextlib.suppress(OSError):  # the disk may be the cause of the error
        file.parent.mkdir(parents=True, exist_ok=True)
        with open(file, "w", encoding="utf-8", opener=open_without_following) as log_of_task:
            log_of_task.write(text)


@contextlib.contextmanager
def at_work(file: Path, claim: Claim) -> Iterator[None]:
    """Keep a log file while a task runs; it remains only if the process dies.

    After a segmentation fault it has the traceback.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(file.unlink, missing_ok=True)
        if os.getppid() == claim.owner:
            note(file, f"begun by process {os.getpid()}, {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
            with contextlib.suppress(OSError):  # writing the result will raise the error
                record = open(file, "a", encoding="utf-8", opener=open_without_following)
                faulthandler.enable(stack.enter_context(record))
                stack.callback(faulthandler.enable)  # on the error stream again, as in joblib
        yield


def total_memory(peaks: dict[int, float], n_jobs: int) -> float:
    """Peak memory (MiB) of this process and its workers, at most.

    Parameters
    ----------
    peaks : dict of int to float
        Peak of every worker by process; this process may be among them.
    n_jobs : int
        Number of simultaneous workers; the largest are counted.
    """
    others = sorted(memory for pid, memory in peaks.items() if pid != os.getpid())
    return peak_memory() + sum(others[-n_jobs:])


def peak_memory() -> float:
    """Peak resident memory of this process in MiB; NaN if unknown."""
    try:
        import resource
    except ImportError:  # on Windows, and in a browser
        return float("nan")
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
