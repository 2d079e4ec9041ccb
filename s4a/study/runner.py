"""Tasks of a run over a study folder (4).

What is done already, processes, time and memory, failures.
"""

import contextlib
import json
import logging
import os
import sys
import threading
import time
from functools import cache

import numpy as np
import psutil
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from s4a.study import store

log = logging.getLogger(__name__)


class Run:
    """One run over a study folder.

    Does tasks that are not done yet, and keeps time, memory and failures.
    """

    def __init__(self, claim, n_jobs):
        self.folder, self.n_jobs, self.claim = claim.folder, n_jobs, claim
        self.failures, self.costs = {}, {}
        with contextlib.suppress(OSError, ValueError):
            self.costs = {
                n: [float(x) for x in c] for n, c in json.loads(self.costs_file.read_text()).items()
            }

    @property
    def costs_file(self):
        return self.folder / ".costs.json"

    @contextlib.contextmanager
    def stage(self, name, share=1.0):
        """Time and peak memory of a stage (seconds; MiB, this process and its workers together).

        They are added to those of earlier runs over the folder where a `share` of the stage is left
        to do, and take their place where all of it is.
        """
        begin, self.workers = time.perf_counter(), {}
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

    def tasks(self, stage, function, tasks, *, each=True, made_from=None):
        """Do the tasks (name, file, key, arguments) whose file is not done.

        `made_from` as of :func:`s4a.study.store.write`.

        A ValueError is kept as a failure where the tasks are one for `each` shape, and raised where
        all need all.
        """
        missing = [t for t in tasks if not store.is_done(self.folder / t[1], t[2])]
        with self.stage(stage, len(missing) / max(len(tasks), 1)):
            log.info("%s: %d of %d to do", stage, len(missing), len(tasks))
            jobs = (
                delayed(do_task)(
                    function,
                    name,
                    self.folder / file,
                    key,
                    arguments,
                    (made_from or {}).get(name, []),
                    self.claim,
                )
                for name, file, key, arguments in missing
            )
            results = Parallel(n_jobs=self.n_jobs, return_as="generator_unordered")(jobs)
            for name, failure, pid, memory in tqdm(
                results, total=len(missing), desc=stage, disable=not missing
            ):
                self.workers[pid] = max(memory, self.workers.get(pid, 0))
                if failure and not each:
                    raise ValueError(f"{stage}: {failure}")
                if failure:
                    self.failures[name] = f"{stage}: {failure}"


def do_task(function, name, path, key, arguments, made_from, claim):
    """Compute one Dataset and write its file; with one BLAS thread, as tasks run side by side."""
    end_with(claim.owner)
    claim.check()
    try:
        with threadpool_limits(1):
            data = function(*arguments)
        failure = ""
    except ValueError as error:
        failure = str(error)
    if not failure:
        store.write(data, path, key, made_from, claim)
    return name, failure, os.getpid(), peak_memory()


@cache
def end_with(owner):
    """Let a worker process that process `owner` started end within a second of it.

    However that ended.
    """
    if os.getppid() != owner:
        return

    def watch():
        while os.getppid() == owner:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def peak_memory():
    """Peak resident memory of this process in MiB; nan where the system does not say."""
    try:
        import resource
    except ImportError:  # on Windows
        return getattr(psutil.Process().memory_info(), "peak_wset", np.nan) / 2**20
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
