"""Worker processes of a run (4), which end with the process that started them."""

import contextlib
import ctypes
import logging
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

from joblib import Parallel, cpu_count
from joblib.parallel import LokyBackend, get_active_backend

from s4a.geometry.compiled import psutil

log = logging.getLogger(__name__)

CAN_LOCK = find_spec("fcntl") is not None  # not on Windows
PR_SET_PDEATHSIG, M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = 1, -1, -3  # of Linux and glibc
TEMPORARY = "s4a-"  # prefix of the folder of a temporary study


def limited(n_jobs: int | None, n_tasks: int | None = None) -> int | None:
    """Limit the number of processes on this machine to its cores, or two, and to the tasks.

    Fewer processes than asked for are reported if there are fewer cores.

    Examples
    --------
    >>> from s4a.study.processes import limited
    >>> limited(999, 1), limited(None)
    (1, None)
    """
    backend, _ = get_active_backend()
    asked = backend.effective_n_jobs(n_jobs) if isinstance(backend, LokyBackend) else 0
    cores = cpu_count()
    if n_tasks is None and asked > max(cores, 2):
        log.warning(
            "%d workers were asked for; this machine has %d cores, so %d are used",
            *(asked, cores, max(cores, 2)),
        )
    most = min(max(cores, 2), max(n_tasks or asked, 1))
    return most if asked > most else n_jobs


def workers(n_jobs: int | None, **options: Any) -> Parallel:
    """Make a :class:`joblib.Parallel` whose processes end within a second of this one.

    The processes are reused by the next call, as joblib does if all settings are equal.

    Parameters
    ----------
    n_jobs : int, optional
        As in joblib, but limited, see :func:`limited`.
    **options
        Options of :class:`joblib.Parallel`.

    Examples
    --------
    >>> from joblib import delayed
    >>> from s4a.study.processes import workers
    >>> workers(1)(delayed(abs)(x) for x in (-1, 2))
    [1, 2]
    """
    n_jobs = limited(n_jobs)
    backend, _ = get_active_backend()
    if isinstance(backend, LokyBackend) and backend.effective_n_jobs(n_jobs) > 1:
        at_once = threading.current_thread() is threading.main_thread()
        options |= {"initializer": begin_worker, "initargs": (os.getpid(), at_once)}
    # arrays are sent through a pipe, as shared files would outlive a killed run
    return Parallel(n_jobs=n_jobs, max_nbytes=None, **options)


def begin_worker(owner: int, at_once: bool) -> None:
    """Let this process end within a second of process `owner`, and ignore Ctrl-C.

    Parameters
    ----------
    owner : int
        The process that started this one.
    at_once : bool
        Let the system end this process, even in native code.  It does so when the thread that
        started this process ends, so that thread must live as long as the owner.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        c = ctypes.CDLL(None)
        if at_once:
            c.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if hasattr(c, "mallopt"):  # of glibc: reuse freed memory instead of returning it
            c.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
            c.mallopt(M_MMAP_THRESHOLD, 2**30)

    def watch():
        while os.getppid() == owner:
            time.sleep(0.25)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def interruption_kept() -> Iterator[threading.Event]:
    """Remember Ctrl-C, as its KeyboardInterrupt may be lost.

    Python drops the exception in a destructor or a callback of a weak reference, of which HDF5 has
    many ("Exception ignored"), and a library may catch it.

    Yields
    ------
    threading.Event
        Set by the first Ctrl-C.
    """
    asked = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    # only the main thread receives signals, and SIGINT may be ignored
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
    """Remove semaphores and memory maps of the workers of a process that has ended.

    They remain if all processes of a run are killed at once; on Linux both are files.

    Parameters
    ----------
    token : str
        Token of :class:`s4a.study.store.Claim`, read from a lock that no process holds.
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
    """Describe how a worker died, from an error of joblib or dask; empty for other errors.

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
    # the other workers have SIGTERM, as joblib then ends them
    codes = re.findall(r"(\w+)\((-?\d+)\)", str(error))
    signals = [name for name, code in codes if int(code) < 0] or [f"exit {c}" for _, c in codes]
    causes = {"SIGKILL": "out of memory?", "SIGSEGV": "a fault in native code"}
    return ", ".join(f"{name}: {causes[name]}" if name in causes else name for name in signals) or (
        "out of memory?" if "KilledWorker" in names else str(error).splitlines()[0]
    )


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder for a temporary study, removed at the end with those of killed runs."""
    remove_abandoned(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as name, locked(Path(name)):
        yield Path(name)


def remove_abandoned(parent: Path) -> None:
    """Remove temporary studies that no process has locked."""
    if not CAN_LOCK:
        return
    for folder in parent.glob(f"{TEMPORARY}????????"):
        with contextlib.suppress(OSError), locked(folder):
            # a new folder is locked before it has a file
            old = time.time() - folder.stat().st_mtime > 3600
            lock = folder / ".lock"
            if folder.stat().st_uid == os.getuid() and (old or lock.is_file()):
                token = lock.read_text() if lock.is_file() else ""
                shutil.rmtree(folder, ignore_errors=True)
                remove_remains(token)


def try_lock(handle: int) -> bool:
    """Lock an open file or folder; return False if the system cannot.

    Raises
    ------
    OSError
        If another process has locked it.
    """
    if CAN_LOCK:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return CAN_LOCK


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder until this process ends; OSError if another process has locked it."""
    if not CAN_LOCK:
        yield
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        try_lock(handle)
        yield
    finally:
        os.close(handle)
