"""How far a run over a study folder is (4): what it notes while it works, and who looks at that."""

import contextlib
import json
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from s4a.geometry.compiled import psutil
from s4a.study.netcdf import check_regular

FILE = ".progress.json"
EVERY = 1.0  # seconds between two notes of a stage
# of every run, in order; those of doubtful shapes are in some
STAGES = (
    "read and clean",
    "sketch",
    "compare",
    "remesh and spectrum",
    "align",
    "first maps",
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

    Parameters
    ----------
    folder : Path
        Of the study.
    owner : int
        The process of the run.
    """

    def __init__(self, folder: Path, owner: int):
        self.path = folder / FILE
        now = time.time()
        self.said: dict[str, Any] = {"owner": owner, "host": platform.node(), "begun": now}
        self.told, self.over = now, ""
        self.stages: dict[str, Stage] = {}
        self.failures: dict[str, str] = {}

    def begin(self, stage: str, done: int, of: int, seconds: float, memory: float) -> None:
        """A stage begins, with what it has and has cost already."""
        self.stages[stage] = Stage(done, of, done, time.time(), seconds, memory, False)
        self.write()

    def add(self, stage: str, failure: dict[str, str]) -> None:
        """One task more is done, or has failed."""
        self.failures |= failure
        self.stages[stage] = self.stages[stage]._replace(done=self.stages[stage].done + 1)
        if time.time() - self.told > EVERY:
            self.write()

    def end(self, stage: str, whole: bool, seconds: float, memory: float) -> None:
        """A stage ends, as a `whole` or because it was interrupted."""
        before = self.stages[stage]
        done = before.all if whole else before.done
        self.stages[stage] = before._replace(done=done, seconds=seconds, memory=memory, ended=whole)
        self.write()

    @contextlib.contextmanager
    def whole(self) -> Iterator[None]:
        """All of a run: whether it came to its end, or was interrupted or refused."""
        over = "stopped"
        try:
            yield
            over = "finished"
        finally:
            self.over = over
            self.write()

    def write(self) -> None:
        """Write all of it at once."""
        self.told = time.time()
        stages = {name: list(stage) for name, stage in self.stages.items()}
        said = {"told": self.told, "over": self.over, "stages": stages, "failures": self.failures}
        write_at_once(self.path, json.dumps(self.said | said))


def write_at_once(path: Path, text: str) -> None:
    """Write a small file of a run; a link in its place is not followed, and no error is raised."""
    with contextlib.suppress(OSError):
        new = path.with_name(f"{path.name}.tmp")
        new.unlink(missing_ok=True)
        new.write_text(text)
        os.replace(new, path)


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
    stages = {}
    for name, (done, of, had, begun, seconds, memory, ended) in said["stages"].items():
        costs = float(begun), float(seconds), float(memory)
        stages[name] = Stage(int(done), int(of), int(had), *costs, bool(ended))
    host, owner, begun = str(said["host"]), int(said["owner"]), float(said["begun"])
    failures = {str(name): str(why) for name, why in said["failures"].items()}
    memory, processes = 0.0, 0
    if said["over"] in ("finished", "stopped"):
        state = said["over"]
    elif host != platform.node():
        state = "elsewhere"
    else:
        memory, processes = memory_of(owner, begun)
        state = "running" if processes else "stopped"
    told = float(said["told"])
    return Status(state, host, owner, begun, told, stages, failures, memory, processes)


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
