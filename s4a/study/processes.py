"""Worker processes of a run (4): they end with the process that started them, leaving nothing."""

import contextlib
import ctypes
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

from joblib import Parallel
from joblib.parallel import LokyBackend, get_active_backend

from s4a.geometry.compiled import psutil

CAN_HOLD = find_spec("fcntl") is not None  # not on Windows, where nobody can tell who holds what
PR_SET_PDEATHSIG, M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = 1, -1, -3  # of Linux and glibc
TEMPORARY = "s4a-"  # how the folder of a study that nobody keeps begins


def workers(n_jobs: int | None, **options: Any) -> Parallel:
    """:class:`joblib.Parallel` whose processes end within a second of this one, however it ends.

    Parameters
    ----------
    n_jobs : int, optional
        As in joblib.
    **options
        Of :class:`joblib.Parallel`.

    Examples
    --------
    >>> from joblib import delayed
    >>> from s4a.study.processes import workers
    >>> workers(1)(delayed(abs)(x) for x in (-1, 2))
    [1, 2]
    """
    backend, _ = get_active_backend()
    if isinstance(backend, LokyBackend) and backend.effective_n_jobs(n_jobs) > 1:
        at_once = threading.current_thread() is threading.main_thread()
        options |= {"initializer": begin_worker, "initargs": (os.getpid(), at_once)}
    return Parallel(n_jobs=n_jobs, **options)


def begin_worker(owner: int, at_once: bool) -> None:
    """Let this process end within a second of process `owner`, and ignore Ctrl-C, its affair.

    Parameters
    ----------
    owner : int
        Which started this process.
    at_once : bool
        Whether the system may end it, in the midst of native code too: that looks at the thread
        that started this process, which then must be one that lives as long as the owner.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        c = ctypes.CDLL(None)
        if at_once:
            c.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if hasattr(c, "mallopt"):  # of glibc: memory that arrays freed is used again, not cleared
            c.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
            c.mallopt(M_MMAP_THRESHOLD, 2**30)

    def watch():
        while os.getppid() == owner:
            time.sleep(0.25)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def interruption_kept() -> Iterator[threading.Event]:
    """Ctrl-C is remembered, as its KeyboardInterrupt may be lost.

    Python drops one that comes in a destructor or in the callback of a weak reference, of which
    HDF5 has many, and says "Exception ignored"; a library may take it for an error of its own.

    Yields
    ------
    threading.Event
        Set from the first Ctrl-C on.
    """
    asked = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    # signals come to the main thread, and this one may be ignored
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield asked
        return

    def remember(number: int, frame: FrameType | None) -> None:
        asked.set()
        before(number, frame)

    signal.signal(signal.SIGINT, remember)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


def remove_remains(token: str) -> None:
    """Remove what the workers of a process that is no more left behind: semaphores, memory maps.

    They stay when all processes of a run are killed at the same time; Linux has both as files.

    Parameters
    ----------
    token : str
        Of :class:`s4a.study.store.Claim`, as it was found in a lock that nobody held.
    """
    owner = re.match(r"\d{1,9}\b", token)
    if not owner or not psutil or psutil.pid_exists(int(owner[0])):
        return
    shared = Path("/dev/shm")
    for path in shared.glob(f"sem.loky-{owner[0]}-*"):
        with contextlib.suppress(OSError):
            path.unlink()
    for parent in (shared, Path(tempfile.gettempdir())):
        for folder in parent.glob(f"joblib_memmapping_folder_{owner[0]}_*"):
            shutil.rmtree(folder, ignore_errors=True)


def died(error: Exception) -> str:
    """How a worker died, when the error of joblib or dask says that one did; empty otherwise.

    Examples
    --------
    >>> from concurrent.futures.process import BrokenProcessPool
    >>> from s4a.study.processes import died
    >>> died(BrokenProcessPool("The exit codes of the workers are {SIGKILL(-9)}"))
    'SIGKILL: out of memory?'
    >>> died(IndexError("list index out of range"))
    ''
    """
    names = {kind.__name__ for kind in type(error).__mro__}
    if not names & {"BrokenProcessPool", "KilledWorker"}:
        return ""
    # those of the others are SIGTERM: joblib ends them when it has seen the first
    codes = re.findall(r"(\w+)\((-?\d+)\)", str(error))
    signals = [name for name, code in codes if int(code) < 0] or [f"exit {c}" for _, c in codes]
    known = {"SIGKILL": "out of memory?", "SIGSEGV": "a fault in native code"}
    return ", ".join(f"{name}: {known[name]}" if name in known else name for name in signals) or (
        "out of memory?" if "KilledWorker" in names else str(error).splitlines()[0]
    )


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder for a study that nobody keeps, removed at the end; those of killed runs as well."""
    remove_abandoned(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as name, held(Path(name)):
        yield Path(name)


def remove_abandoned(parent: Path) -> None:
    """Remove the temporary studies that no process holds any more."""
    if not CAN_HOLD:
        return
    for folder in parent.glob(f"{TEMPORARY}????????"):
        with contextlib.suppress(OSError), held(folder):
            # one that is just being made is held before it has a file
            old = time.time() - folder.stat().st_mtime > 3600
            lock = folder / ".lock"
            if folder.stat().st_uid == os.getuid() and (old or lock.is_file()):
                token = lock.read_text() if lock.is_file() else ""
                shutil.rmtree(folder, ignore_errors=True)
                remove_remains(token)


def hold(handle: int) -> bool:
    """Hold an open file or folder; False where this system cannot.

    Raises
    ------
    OSError
        When another process holds it.
    """
    if CAN_HOLD:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return CAN_HOLD


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold a folder until this process ends in whatever way; OSError when another one does."""
    if not CAN_HOLD:
        yield
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        hold(handle)
        yield
    finally:
        os.close(handle)
