"""Folder of a study: one netCDF file per task, keys, and a lock.

Every file is written under a temporary name and renamed, so a killed run leaves only complete
files.  The key of the task (content, parameters, version) in the attributes says whether a file is
valid; checksums (:mod:`s4a.study.netcdf`) say whether it is undamaged.
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
from s4a.study.processes import remove_remains, try_lock

log = logging.getLogger(__name__)

LOCK = ".lock"
# folders of a study
STAGES = ("original", "coarse", "network", "latent", "iterations", "registration", "fields")
OF_ALL = ("network", "latent", "registration", "pca", "subjects", "report")  # other files
LOGS = ".log"  # folder with a file for each task that is running or has failed
TEMPORARY = re.compile(r"\.[\w-]+\.nc\.\d+\.tmp")  # temporary names of `write`

VERSION = version("s4a")


def task_key(*parts: Any) -> str:
    """Hash of everything that a result depends on, and of the version of S4A.

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
        else:  # numbers of NumPy become those of Python
            text = json.dumps(part, sort_keys=True, default=lambda number: number.item())
            kind, data = "json", text.encode()
        # with kind and length, "ab" differs from "a", "b", and an array from the text of its bytes
        digest.update(f"{kind} {len(data)}:".encode() + data)
    return digest.hexdigest()[:32]


@dataclass(frozen=True)
class Claim:
    """The right of a run to write into a folder, as recorded in the lock; passed to workers."""

    folder: Path
    token: str  # process id and a unique word

    @property
    def owner(self) -> int:
        """Process id of the run."""
        return int(self.token.split()[0])

    def check(self) -> None:
        """Raise ValueError if another run has taken over the folder, as after a kill."""
        try:
            token = (self.folder / LOCK).read_text()
        except OSError:
            token = ""
        if token != self.token:
            raise ValueError(f"process {self.owner} no longer has the lock of {self.folder}")


def write(
    data: xr.Dataset | xr.DataTree,
    path: Path | str,
    key: str = "",
    made_from: Iterable[str] = (),
    claim: Claim | None = None,
    compression: int = 0,
    name: str = "",
) -> None:
    """Write a file atomically, under a temporary name that is then renamed.

    Parameters
    ----------
    data : Dataset or DataTree
    path : Path or str
    key : str
        See :func:`task_key`.
    made_from : iterable of str
        Names and keys, ``name=key``, of the files that it was computed from;
        :func:`s4a.open_study` skips a file if one of them is missing, as after an incomplete run
        with other options.
    claim : Claim, optional
        Write only if the claim is still valid.
    compression : int
        See :func:`s4a.study.netcdf.write_netcdf`.
    name : str
        Name of the file within a study, as ``coarse/brain_01``, which :func:`s4a.open_study`
        compares with its path; by default the path's own.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    data = data.copy(deep=False)
    name = name or (f"{path.parent.name}/" if path.parent.name in STAGES else "") + path.stem
    data.attrs |= {"file": name, "task_key": key, "made_from": " ".join(made_from)}
    buffer = io.BytesIO()  # HDF5 crashes the process if the disk is full
    write_netcdf(data, buffer, compression)
    if claim is not None:
        claim.check()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(buffer.getbuffer())
            file.flush()
            os.fsync(file.fileno())  # otherwise a power cut may leave an empty file
        if claim is not None:
            claim.check()
        os.replace(temporary, path)  # atomic
    except OSError as error:
        raise OSError(
            f"{path} cannot be written ({error}): is the disk full, or the folder read-only? "
            "Finished files are kept; the same command resumes the run"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def refuse_links(folder: Path) -> None:
    """Raise ValueError if a folder within a study is a symbolic link; the study may be one."""
    for name in (*STAGES, LOGS, *(f"{LOGS}/{stage}" for stage in STAGES)):
        if (folder / name).is_symlink():
            raise ValueError(
                f"{folder / name} is a symbolic link, which is not followed within a study: "
                "put the folder itself in its place"
            )


def check_is_study(folder: Path) -> None:
    """Raise ValueError unless a folder is a study, without links to folders."""
    if not (folder / STAGES[0]).is_dir():
        if inner := sorted(folder.glob(f"*/*/{STAGES[0]}")):
            raise ValueError(
                f"{folder} contains studies: give one of them, such as {inner[0].parent}"
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
    """Raise ValueError if a folder is not empty and not a study.

    A study has a lock, or files written by :func:`write`.
    """
    refuse_links(folder)
    for name in OF_ALL:
        if is_ours(folder / f"{name}.nc") is False:
            raise ValueError(
                f"{folder / name}.nc was not made by s4a, and a run would replace it: "
                "move it away, or give another folder"
            )
    if not folder.is_dir() or (folder / LOCK).is_file():
        return
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    files = [*folder.glob("[!.]*.nc"), *(folder / STAGES[0]).glob("[!.]*.nc")]
    if names and not any(is_ours(path) for path in files):
        shown = ", ".join(names[:3]) + ", ..." * (len(names) > 3)
        raise ValueError(
            f"{folder} is not a study and not empty (it has {shown}): give a new or an empty folder"
        )


def is_ours(path: Path) -> bool | None:
    """Return whether :func:`write` has written a file; None if it is missing or unreadable."""
    try:
        with open_hdf5(path) as file:
            return file.links.exists(GROUP.encode())
    except OSError:
        return None


def open_without_following(path: str, flags: int) -> int:
    """Open a file for writing; OSError if it is a symbolic link."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


@contextmanager
def lock(folder: Path | str) -> Iterator[Claim]:
    """Lock a study folder against a second run.

    The system releases the lock when the process ends, even if it is killed.  Temporary files of
    killed processes are removed at the beginning and the end.

    Yields
    ------
    Claim

    Raises
    ------
    ValueError
        If another process has locked the folder, or the folder is not a study and not empty.
    """
    check_own(Path(folder))
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        handle = open(Path(folder) / LOCK, "a+", errors="replace", opener=open_without_following)
    except OSError as error:
        raise OSError(f"{folder} cannot be written ({error}): give another folder") from error
    with handle:
        try:
            if not try_lock(handle.fileno()):
                log.warning("this system cannot lock %s; do not start a second run in it", folder)
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
        os.fsync(handle.fileno())  # it identifies the study, even after a power cut
        remove_temporary(Path(folder))
        claim = Claim(Path(folder), token)
        try:
            yield claim
        finally:  # if a task fails, other workers are killed, perhaps while writing
            with suppress(ValueError, OSError):
                claim.check()
                remove_temporary(Path(folder))


def remove_temporary(folder: Path) -> None:
    """Remove unfinished files of :func:`write`; no process may be writing."""
    for stage in ("", *STAGES):
        for temporary in (folder / stage).glob(".*.nc.*.tmp"):
            if TEMPORARY.fullmatch(temporary.name):
                temporary.unlink(missing_ok=True)
