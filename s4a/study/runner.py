"""Tasks of a run over a study folder (4): what is done already, processes, costs, failures."""

import contextlib
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import psutil
import xarray as xr
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from s4a.study.store import Claim, is_done, task_key, write

log = logging.getLogger(__name__)


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
    arguments: tuple
    inputs: tuple
    made_from: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The key of the result: of its inputs and the version of S4A."""
        return task_key(*self.inputs)


class Run:
    """One run over a study folder: does what is not done yet, keeps time, memory and failures.

    Attributes
    ----------
    failures : dict of str to str
        Name of a shape that is left out -> why.
    costs : dict of str to tuple
        Seconds and MiB of every stage, those of earlier runs over the folder included.
    """

    def __init__(self, claim: Claim, n_jobs: int | None):
        self.folder, self.n_jobs, self.claim = claim.folder, n_jobs, claim
        self.failures, self.costs = {}, {}
        with contextlib.suppress(OSError, ValueError):
            costs = json.loads(self.costs_file.read_text())
            self.costs = {stage: [float(x) for x in cost] for stage, cost in costs.items()}

    @property
    def costs_file(self) -> Path:
        """Where the costs are kept for the next run."""
        return self.folder / ".costs.json"

    @contextlib.contextmanager
    def stage(self, name: str, share: float = 1.0) -> Iterator[None]:
        """Time and peak memory of a stage (seconds; MiB, this process and its workers together).

        They are added to those of earlier runs over the folder where a `share` of the stage is left
        to do, and take their place where all of it is.
        """
        begin = time.perf_counter()
        self.workers = {}
        seconds, memory = self.costs.get(name, (0.0, 0.0)) if share < 1 else (0.0, 0.0)
        try:
            yield
        finally:  # an interrupted stage has cost something too
            if share > 0 or name not in self.costs:
                own = {os.getpid(): peak_memory()}
                memory = np.fmax(memory, sum((self.workers | own).values()))
                self.costs[name] = [seconds + time.perf_counter() - begin, float(memory)]
                with contextlib.suppress(OSError):
                    self.costs_file.write_text(json.dumps(self.costs))

    def do(self, stage: str, tasks: list[Task], *, each: bool = True) -> dict[str, str]:
        """Do the tasks whose file is not done; name -> key of all that are done then.

        A ValueError is kept as a failure where the tasks are one for `each` shape, and raised where
        all need all.
        """
        missing = [task for task in tasks if not is_done(self.folder / task.file, task.key)]
        with self.stage(stage, len(missing) / max(len(tasks), 1)):
            log.info("%s: %d of %d to do", stage, len(missing), len(tasks))
            jobs = (delayed(do_task)(task, self.claim) for task in missing)
            results = Parallel(n_jobs=self.n_jobs, return_as="generator_unordered")(jobs)
            bar = tqdm(results, total=len(missing), desc=stage, disable=not missing)
            for name, failure, pid, memory in bar:
                self.workers[pid] = max(memory, self.workers.get(pid, 0))
                if failure and not each:
                    raise ValueError(f"{stage}: {failure}")
                if failure:
                    self.failures[name] = f"{stage}: {failure}"
        return {task.name: task.key for task in tasks if task.name not in self.failures}


def do_task(task: Task, claim: Claim) -> tuple[str, str, int, float]:
    """Compute one Dataset and write its file; with one BLAS thread, as tasks run side by side.

    Returns
    -------
    name, failure : str
        Why there is no file; empty where it was written.
    pid : int
    memory : float
        Peak of this process in MiB.
    """
    end_with(claim.owner)
    claim.check()
    failure = ""
    try:
        with threadpool_limits(1):
            data = task.function(*task.arguments)
    except ValueError as error:
        failure = str(error)
    else:
        write(data, claim.folder / task.file, task.key, task.made_from, claim)
    return task.name, failure, os.getpid(), peak_memory()


@cache
def end_with(owner: int) -> None:
    """Let a worker process that process `owner` started end within a second of it.

    However that ended: a killed run tells its workers nothing.
    """
    if os.getppid() != owner:
        return

    def watch():
        while os.getppid() == owner:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def peak_memory() -> float:
    """Peak resident memory of this process in MiB; nan where the system does not say."""
    try:
        import resource
    except ImportError:  # on Windows
        return getattr(psutil.Process().memory_info(), "peak_wset", np.nan) / 2**20
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
