"""Progress of a run over a study folder (4): write and read its status file."""

import contextlib
import json
import logging
import os
import platform
import time
from pathlib import Path
from typing import Any, NamedTuple

from s4a.geometry.compiled import psutil
from s4a.study.netcdf import check_regular

log = logging.getLogger(__name__)

FILE = ".progress.json"
EVERY = 1.0  # seconds between two writes during a stage
# stages of every run, in order; some runs also have those of flagged shapes
STAGES = (
    "read and clean",
    "descriptor",
    "compare",
    "remesh and spectrum",
    "align",
    "initial maps",
    "consistent ZoomOut and median",
    "registration",
    "modes",
)


class Stage(NamedTuple):
    """Progress of a stage.

    `done` of `all` tasks, one per shape or for some pairs, have a file; `done_before` had one when
    this run began the stage, at the time `begun` (seconds since 1970).  `seconds` and `memory`
    (MiB) are totals of all runs; memory is NaN if unknown.
    """

    done: int
    all: int
    done_before: int
    begun: float
    seconds: float
    memory: float
    ended: bool

    def remaining(self, now: float) -> float:
        """Estimate the seconds until the end; NaN before the first task of this run."""
        if self.ended or self.done <= self.done_before:
            return 0.0 if self.ended else float("nan")
        return (now - self.begun) / (self.done - self.done_before) * (self.all - self.done)


class Status(NamedTuple):
    """Status of a run.

    `state` is "running", "finished", "stopped", or "elsewhere" for a run on another machine `host`.
    `owner` is the process, `begun` its start and `updated` the last write (seconds since 1970).
    `stages` were reached; `failures` are excluded shapes with reasons.  `memory` (MiB) and
    `processes` are the present use, 0 after the end.
    """

    state: str
    host: str
    owner: int
    begun: float
    updated: float
    stages: dict[str, Stage]
    failures: dict[str, str]
    memory: float
    processes: int


class Notes:
    """Writer of the status file of a run; a failed write does not stop the run.

    Attributes
    ----------
    costs : dict of str to list
        Seconds and MiB of every stage, in all runs over the folder.
    stages : dict of str to Stage
        Stages that this run reached.
    failures : dict of str to str
        Name of an excluded shape -> reason.
    """

    def __init__(self, folder: Path, owner: int):
        self.path, self.updated = folder / FILE, time.time()
        self.over = ""
        self.run = {"owner": owner, "host": platform.node(), "begun": self.updated}
        self.stages: dict[str, Stage] = {}
        self.failures: dict[str, str] = {}
        self.costs = read_costs(self.path)

    def add(self, stage: str) -> None:
        """Count a task that is done, or has failed."""
        self.stages[stage] = self.stages[stage]._replace(done=self.stages[stage].done + 1)
        if time.time() - self.updated > EVERY:
            self.write()

    def write(self, over: str = "") -> None:
        """Write the status; `over` is "finished" or "stopped" at the end of the run."""
        self.updated, self.over = time.time(), over
        status = self.run | {"updated": self.updated, "over": over, "stages": self.stages}
        status |= {"failures": self.failures, "costs": self.costs}
        with contextlib.suppress(OSError):
            new = self.path.with_name(f"{self.path.name}.tmp")
            new.unlink(missing_ok=True)  # it may be a link
            new.write_text(json.dumps(status))
            os.replace(new, self.path)


def read_costs(path: Path) -> dict[str, list[float]]:
    """Read the costs of earlier runs; none, with a warning, if the file is damaged."""
    try:
        check_regular(path)
        costs = json.loads(path.read_text("utf-8"))["costs"]
        return {
            stage: [float(seconds), float(memory)] for stage, (seconds, memory) in costs.items()
        }
    except FileNotFoundError:
        return {}
    except Exception as error:  # no content may stop the run
        log.warning("%s cannot be read (%s): times of earlier runs are not counted", path, error)
        return {}


def status(folder: Path | str) -> Status:
    """Read the progress of a run, or of a run that was stopped.

    Parameters
    ----------
    folder : path
        Folder of a study; it is not changed, and the run is not disturbed.

    Raises
    ------
    ValueError
        If there is no status file, or it is damaged.

    Examples
    --------
    >>> import tempfile
    >>> import s4a
    >>> from s4a.study.progress import status
    >>> store = tempfile.mkdtemp()
    >>> study = s4a.analyse(
    ...     s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3, store=store
    ... )
    >>> run = status(store)
    >>> run.state, run.stages["registration"].done
    ('finished', 3)
    """
    path = Path(folder) / FILE
    try:
        check_regular(path)
        data = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise ValueError(
            f"{folder} has no {FILE}: no run of this version of s4a was started there; "
            "`s4a verify` lists the files of a study"
        ) from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    try:
        return _status(data)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} is not a status file of a run: {error!r}") from error


def _status(data: dict[str, Any]) -> Status:
    stages = {name: Stage(*stage) for name, stage in data["stages"].items()}
    owner, begun, state = int(data["owner"]), float(data["begun"]), data["over"]
    memory, processes = 0.0, 0
    if not state and data["host"] != platform.node():
        state = "elsewhere"
    elif not state:
        memory, processes = memory_of(owner, begun)
        state = "running" if processes else "stopped"
    rest = data["updated"], stages, dict(data["failures"]), memory, processes
    return Status(state, data["host"], owner, begun, *rest)


def memory_of(owner: int, begun: float) -> tuple[float, int]:
    """Memory (MiB) and number of the processes of a run.

    Both are 0 if the process `owner` has ended, or is another one, begun later than `begun`.
    """
    if not psutil:  # in a browser, where this is the only process
        return 0.0, int(owner == os.getpid())
    try:
        process = psutil.Process(owner)
        if process.create_time() > begun + 1 or process.status() == psutil.STATUS_ZOMBIE:
            return 0.0, 0
        family = [process, *process.children(recursive=True)]
    except psutil.Error:
        return 0.0, 0
    memory = 0.0
    for member in family:
        with contextlib.suppress(psutil.Error):  # the process has just ended
            memory += member.memory_info().rss / 2**20
    return memory, len(family)
