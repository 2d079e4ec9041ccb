"""Files of a study, one netCDF file per task; keys, and the lock of its folder.

Every file is written under a temporary name and renamed, so that a killed run leaves only whole
files; the key of its task (content, parameters, version) stands in its attributes and says whether
it is still valid.  Checksums (:mod:`s4a.study.netcdf`) say whether it is still what was written.
"""

import hashlib
import io
import json
import logging
import os
import re
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.study.netcdf import GROUP, open_hdf5, write_netcdf
from s4a.study.processes import hold, remove_remains

log = logging.getLogger(__name__)

LOCK = ".lock"
# folders of a study
STAGES = ("original", "coarse", "network", "latent", "iterations", "registration", "fields")
OF_ALL = ("network", "latent", "registration", "pca", "subjects", "report")  # files beside them
LOGS = ".log"  # folder in that of a study: a file for each task that is at work or failed
TEMPORARY = re.compile(r"\.[\w-]+\.nc\.\d+\.tmp")  # as `write` names them

VERSION = version("s4a")


def task_key(*parts: Any) -> str:
    """A hash of all that a result depends on, and of the version of S4A.

    Parameters
    ----------
    *parts : str, number, list, dict, ndarray or bytes

    Examples
    --------
    >>> from s4a.study.store import task_key
    >>> task_key("content", {"k": 20}) == task_key("content", {"k": 30})
    False
    """
    digest = hashlib.sha256(f"s4a {VERSION}".encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            kind, data = f"{part.dtype.str}{part.shape}", np.ascontiguousarray(part).tobytes()
        elif isinstance(part, bytes):
            kind, data = "bytes", part
        else:  # numbers of NumPy as those of Python
            text = json.dumps(part, sort_keys=True, default=lambda number: number.item())
            kind, data = "json", text.encode()
        # kind and length before it: "ab" is not "a", "b", and no array is the text of its bytes
        digest.update(f"{kind} {len(data)}:".encode() + data)
    return digest.hexdigest()[:32]


@dataclass(frozen=True)
class Claim:
    """The right of one run to write into a folder, as it stands in its lock.

    It travels to the workers.
    """

    folder: Path
    token: str  # number of the process, and a word that no other run has

    @property
    def owner(self) -> int:
        """Number of the process of the run."""
        return int(self.token.split()[0])

    def check(self) -> None:
        """Raise ValueError when another run has taken over the folder, as after one was killed."""
        try:
            token = (self.folder / LOCK).read_text()
        except OSError:
            token = ""
        if token != self.token:
            raise ValueError(f"the run of process {self.owner} no longer holds {self.folder}")


def write(
    data: xr.Dataset | xr.DataTree,
    path: Path | str,
    key: str = "",
    made_from: Iterable[str] = (),
    claim: Claim | None = None,
    compression: int = 0,
) -> None:
    """Write a file at once: under a temporary name in the same folder, then renamed.

    Parameters
    ----------
    data : Dataset or DataTree
    path : Path or str
    key : str
        Of :func:`task_key`.
    made_from : iterable of str
        Keys of the files that it was computed from; :func:`s4a.open_study` leaves a file out when
        one of them is no longer there, as after a run with other options was stopped half-way.
    claim : Claim, optional
        Nothing is written when it no longer holds.
    compression : int
        See :func:`s4a.study.netcdf.write_netcdf`.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    data = data.copy(deep=False)
    data.attrs = data.attrs | {"task_key": key, "made_from": " ".join(made_from)}
    whole = io.BytesIO()  # HDF5 brings the process down when the disk is full
    write_netcdf(data, whole, compression)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(whole.getbuffer())
            file.flush()
            os.fsync(file.fileno())  # or a power cut leaves its name and not its content
        if claim is not None:
            claim.check()
        os.replace(temporary, path)  # at once, or not at all
    except OSError as error:
        raise OSError(
            f"{path} cannot be written ({error}): is the disk full, or the folder read-only? "
            "Finished files are whole; the same command goes on where it stopped"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def refuse_links(folder: Path) -> None:
    """ValueError where a folder within a study is a symbolic link; the study itself may be one."""
    for name in (*STAGES, LOGS, *(f"{LOGS}/{stage}" for stage in STAGES)):
        if (folder / name).is_symlink():
            raise ValueError(
                f"{folder / name} is a symbolic link, which is not followed within a study: "
                "put the folder itself in its place"
            )


def check_is_study(folder: Path) -> None:
    """ValueError unless a folder is a study, and none within it is a link."""
    if not (folder / STAGES[0]).is_dir():
        if inner := sorted(folder.glob(f"*/*/{STAGES[0]}")):
            raise ValueError(
                f"{folder} has studies in it: give one of them, such as {inner[0].parent}"
            )
        if not folder.is_dir():
            raise ValueError(
                f"{folder} is not a study folder: there is no such folder; give the one that "
                "`s4a run PATH... --out FOLDER` has written"
            )
        raise ValueError(
            f"{folder} is not a study folder: it has no folder {STAGES[0]!r}; to analyse meshes "
            f"in it, run `s4a run {folder} --out FOLDER` and give that folder"
        )
    refuse_links(folder)


def check_own(folder: Path) -> None:
    """ValueError where a folder holds files and is no study: a run would write among them.

    A study has its lock, or files that :func:`write` has written.
    """
    refuse_links(folder)
    for name in OF_ALL:
        if is_ours(folder / f"{name}.nc") is False:
            raise ValueError(
                f"{folder / name}.nc was not made by s4a, and a run would write in its place: "
                "move it away, or give another folder"
            )
    if not folder.is_dir() or (folder / LOCK).is_file():
        return
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    files = [*folder.glob("[!.]*.nc"), *(folder / STAGES[0]).glob("[!.]*.nc")]
    if names and not any(is_ours(path) for path in files):
        shown = ", ".join(names[:3]) + ", ..." * (len(names) > 3)
        raise ValueError(
            f"{folder} is no study and is not empty (it has {shown}): give a new or an empty folder"
        )


def is_ours(path: Path) -> bool | None:
    """Whether :func:`write` has written a file; None where it is absent or cannot be read."""
    try:
        with open_hdf5(path) as file:
            return file.links.exists(GROUP.encode())
    except OSError:
        return None


def open_without_following(path: str, flags: int) -> int:
    """Open a file of our own: where a symbolic link lies in its place, that is an OSError."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


@contextmanager
def lock(folder: Path | str) -> Iterator[Claim]:
    """Hold a study folder against a second run.

    Released by the system when the process ends in whatever way.  Temporary files of processes that
    were killed are removed when it begins and when it ends; a folder with files of somebody else
    is not touched.

    Yields
    ------
    Claim

    Raises
    ------
    ValueError
        When another process holds the folder; its number is named.  When it is no study, and not
        empty.
    """
    check_own(Path(folder))
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        handle = open(Path(folder) / LOCK, "a+", errors="replace", opener=open_without_following)
    except OSError as error:
        raise OSError(f"{folder} cannot be written ({error}): give another folder") from error
    with handle:
        try:
            if not hold(handle.fileno()):
                log.warning("this system cannot lock %s; start no second run in it", folder)
        except OSError:
            handle.seek(0)
            owner, *_ = handle.read().split() or ["unknown"]
            raise ValueError(
                f"another run (process {owner}) is working on {folder}; "
                "wait for it to end or give another folder"
            ) from None
        handle.seek(0)
        remove_remains(handle.read())
        token = f"{os.getpid()} {uuid.uuid4().hex}"
        handle.truncate(0)
        handle.write(token)
        handle.flush()
        os.fsync(handle.fileno())  # it says that the folder is a study, after a power cut too
        remove_temporary(Path(folder))
        claim = Claim(Path(folder), token)
        try:
            yield claim
        finally:  # where a task fails, the workers beside it are killed, in the midst of a file too
            with suppress(ValueError, OSError):
                claim.check()
                remove_temporary(Path(folder))


def remove_temporary(folder: Path) -> None:
    """Remove what :func:`write` had begun and not finished, when nobody writes any more."""
    for stage in ("", *STAGES):
        for temporary in (folder / stage).glob(".*.nc.*.tmp"):
            if TEMPORARY.fullmatch(temporary.name):
                temporary.unlink(missing_ok=True)
