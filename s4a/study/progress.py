"""How far a run over a study folder is (4): what it notes while it works, and who looks at that."""

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
EVERY = 1.0  # seconds between two notes of a stage
# of every run, in order; those of flagged shapes are in some
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
    """How far a stage is.

    Of its tasks, one for each shape or for some pairs, `done` of `all` have a file, and `had` of
    them did when this run began it, at the time `begun` (seconds since 1970).  `seconds` and
    `memory` (MiB) are what it took in all runs; memory is NaN where the system does not say.
    """

    done: int
    all: int
    had: int
    begun: float
    seconds: float
    memory: float
    ended: bool

    def remaining(self, now: float) -> float:
        """Seconds until its end by the pace of this run; NaN where there is none yet."""
        if self.ended or self.done <= self.had:
            return 0.0 if self.ended else float("nan")
        return (now - self.begun) / (self.done - self.had) * (self.all - self.done)


class Status(NamedTuple):
    """How far a run is.

    `state` is "running", "finished", "stopped", or "elsewhere" where it runs or ran on the other
    machine `host`; `owner` is its process, `begun` and `told` when it began and when it last said
    something (seconds since 1970).  `stages` are those that it reached, `failures` the shapes that
    it left out and why, `memory` (MiB) and `processes` what it has now, both 0 where it is over.
    """

    state: str
    host: str
    owner: int
    begun: float
    told: float
    stages: dict[str, Stage]
    failures: dict[str, str]
    memory: float
    processes: int


class Notes:
    """What a run notes of itself in its folder; what cannot be written is not missed by it.

    Attributes
    ----------
    costs : dict of str to list
        Seconds and MiB of every stage, those of earlier runs over the folder included.
    stages : dict of str to Stage
        Those that this run reached.
    failures : dict of str to str
        Name of a shape that is left out -> why.
    """

    def __init__(self, folder: Path, owner: int):
        self.path, self.told = folder / FILE, time.time()
        self.over = ""
        self.run = {"owner": owner, "host": platform.node(), "begun": self.told}
        self.stages: dict[str, Stage] = {}
        self.failures: dict[str, str] = {}
        self.costs = read_costs(self.path)

    def add(self, stage: str) -> None:
        """One task more is done, or has failed."""
        self.stages[stage] = self.stages[stage]._replace(done=self.stages[stage].done + 1)
        if time.time() - self.told > EVERY:
            self.write()

    def write(self, over: str = "") -> None:
        """Write all of it at once, and whether the run is over: "finished" or "stopped"."""
        self.told, self.over = time.time(), over
        said = self.run | {"told": self.told, "over": over, "stages": self.stages}
        said |= {"failures": self.failures, "costs": self.costs}
        with contextlib.suppress(OSError):
            new = self.path.with_name(f"{self.path.name}.tmp")
            new.unlink(missing_ok=True)  # it may be a link
            new.write_text(json.dumps(said))
            os.replace(new, self.path)


def read_costs(path: Path) -> dict[str, list[float]]:
    """The costs in the note of an earlier run; a note of any other form is told and has none."""
    try:
        check_regular(path)
        costs = json.loads(path.read_text("utf-8"))["costs"]
        return {
            stage: [float(seconds), float(memory)] for stage, (seconds, memory) in costs.items()
        }
    except FileNotFoundError:
        return {}
    except Exception as error:  # whatever it holds, the run goes on
        log.warning("%s cannot be read (%s): times of earlier runs are not counted", path, error)
        return {}


def status(folder: Path | str) -> Status:
    """How far the run over a folder is, or was when it was stopped.

    Parameters
    ----------
    folder : path
        Of a study.  Nothing in it is changed, and the run is not disturbed.

    Raises
    ------
    ValueError
        When no run has noted anything there, or the note has another form.

    Examples
    --------
    >>> import tempfile
    >>> import s4a
    >>> from s4a.study.progress import status
    >>> store = tempfile.mkdtemp()
    >>> study = s4a.analyse(
    ...     s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3, store=store
    ... )
    >>> found = status(store)
    >>> found.state, found.stages["registration"].done
    ('finished', 3)
    """
    path = Path(folder) / FILE
    try:
        check_regular(path)
        said = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise ValueError(
            f"{folder} has no {FILE}: no run of this version of s4a has begun there; "
            "`s4a verify` says what a study holds"
        ) from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    try:
        return _status(said)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} is no note of a run: {error!r}") from error


def _status(said: dict[str, Any]) -> Status:
    stages = {name: Stage(*stage) for name, stage in said["stages"].items()}
    owner, begun, state = int(said["owner"]), float(said["begun"]), said["over"]
    memory, processes = 0.0, 0
    if not state and said["host"] != platform.node():
        state = "elsewhere"
    elif not state:
        memory, processes = memory_of(owner, begun)
        state = "running" if processes else "stopped"
    rest = said["told"], stages, dict(said["failures"]), memory, processes
    return Status(state, said["host"], owner, begun, *rest)


def memory_of(owner: int, begun: float) -> tuple[float, int]:
    """MiB of a run and the processes below it, and how many there are.

    None where the process of that number is not the one that noted the time `begun`.
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
    for one in family:
        with contextlib.suppress(psutil.Error):  # it has just ended
            memory += one.memory_info().rss / 2**20
    return memory, len(family)
