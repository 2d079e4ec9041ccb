"""Files of a study, one netCDF file per task; keys, and the lock of its folder.

Every file is written under a temporary name and renamed, so that a killed run leaves only whole
files; the key of its task (content, parameters, version) stands in its attributes and says whether
it is still valid.
"""

import hashlib
import io
import json
import logging
import os
import re
import sys
import uuid
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

log = logging.getLogger(__name__)

LOCK = ".lock"
STAGES = ("original", "coarse", "network", "registration")  # folders of a study
TEMPORARY = re.compile(r"\.[\w-]+\.nc\.\d+\.tmp")  # as `write` names them

ENGINE: Final = "h5netcdf"
VERSION = version("s4a")
SMALL = 1000  # entries up to which a variable is read when its file is opened
# attributes with which HDF5 and netCDF keep account of dimensions
HIDDEN = {
    "CLASS",
    "NAME",
    "DIMENSION_LIST",
    "REFERENCE_LIST",
    "_NCProperties",
    "_Netcdf4Coordinates",
    "_Netcdf4Dimid",
}
# HDF5's name of a dimension that has no coordinate
NO_COORDINATE = b"This is a netCDF dimension but not a netCDF variable"


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
    data: xr.Dataset,
    path: Path | str,
    key: str = "",
    made_from: Iterable[str] = (),
    claim: Claim | None = None,
) -> None:
    """Write a Dataset to `path` at once: under a temporary name in the same folder, then renamed.

    Parameters
    ----------
    data : Dataset
    path : Path or str
    key : str
        Of :func:`task_key`.
    made_from : iterable of str
        Keys of the files that it was computed from; :func:`s4a.open_study` leaves a file out when
        one of them is no longer there, as after a run with other options was stopped half-way.
    claim : Claim, optional
        Nothing is written when it no longer holds.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    data = data.assign_attrs(task_key=key, made_from=" ".join(made_from))
    whole = io.BytesIO()  # HDF5 brings the process down when the disk is full
    with without_dask():
        data.to_netcdf(whole, engine=ENGINE)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(whole.getbuffer())
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


def without_dask() -> AbstractContextManager:
    """Keeps xarray from asking a dask scheduler for a lock on a buffer that only we have."""
    dask = sys.modules.get("dask")
    return dask.config.set(scheduler="synchronous") if dask else nullcontext()


class Stored(BackendArray):
    """A variable of a file that is read when it is asked for; it holds no file open."""

    def __init__(self, path: Path, variable: h5py.Dataset, key: str):
        self.path, self.name, self.key = path, variable.name, key
        self.shape, self.dtype = variable.shape, variable.dtype

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self.part
        )

    def part(self, key: Any) -> np.ndarray:
        """Read the selection from the file; ValueError where it was written anew."""
        with h5py.File(self.path) as file:
            if file.attrs.get("task_key") != self.key:
                raise ValueError(
                    f"{self.path} was written anew since it was opened; open the study again"
                )
            return file[self.name][()][key]


@contextmanager
def readable(path: Path | str) -> Iterator[h5py.File]:
    """An open file of a study.

    Whatever comes of damage in it is one OSError that names the file.
    """
    try:
        with h5py.File(path) as file:
            yield file
    except (FileNotFoundError, PermissionError, MemoryError):
        raise
    except Exception as error:  # HDF5, h5py and NumPy each have their own ways with damage
        raise OSError(
            f"{path} cannot be read ({error}): remove it and run the analysis again"
        ) from error


def open_file(path: Path | str) -> xr.Dataset:
    """The Dataset of one file; its larger variables are read when they are used.

    What :func:`xarray.open_dataset` gives, in less than half of the time: h5netcdf asks HDF5 for
    everything about each dimension of each variable.  Only files as :func:`write` writes them can
    be read: no groups, no chunks.
    """
    path = Path(path).absolute()  # what is read later does not follow the working directory
    with readable(path) as file:
        attrs = plain_attributes(file)
        variables = {}
        values: Any
        for name, variable in file.items():
            if variable.attrs.get("NAME", b"").startswith(NO_COORDINATE):
                continue
            if h5py.check_string_dtype(variable.dtype):
                values = np.array(variable.asstr()[()], str)
            elif variable.size <= SMALL:
                values = variable[()]
            else:
                stored = Stored(path, variable, attrs.get("task_key"))
                values = indexing.LazilyIndexedArray(stored)
            dims = dims_of(file, name, variable)
            variables[name] = xr.Variable(dims, values, plain_attributes(variable))
        data = xr.decode_cf(xr.Dataset(variables, attrs=attrs), decode_times=False)
    data.encoding["source"] = str(path)
    return data


def dims_of(file: h5py.File, name: str, variable: h5py.Dataset) -> list[str]:
    """Names of the dims of a variable."""
    if "DIMENSION_LIST" in variable.attrs:  # references to the dimensions, one list for each axis
        return [file[ref[0]].name.lstrip("/") for ref in variable.attrs["DIMENSION_LIST"]]
    is_dimension = variable.attrs.get("CLASS") == b"DIMENSION_SCALE"
    return [name] if is_dimension else []


def plain_attributes(stored: h5py.File | h5py.Dataset) -> dict[str, Any]:
    """The attributes as they were before they were written: HDF5 makes arrays of single numbers."""
    attrs = {name: stored.attrs[name] for name in stored.attrs if name not in HIDDEN}
    return {
        name: value[0] if isinstance(value, np.ndarray) and value.shape == (1,) else value
        for name, value in attrs.items()
    }


def read(path: Path | str) -> xr.Dataset:
    """The Dataset of one file, in memory."""
    return open_file(path).load()


def arrays(path: Path | str, *names: str) -> list[np.ndarray]:
    """The values of some variables of one file, without a Dataset."""
    with readable(path) as file:
        return [file[name][()] for name in names]


def attributes(path: Path | str) -> dict[str, Any]:
    """The attributes of one file."""
    with readable(path) as file:
        return plain_attributes(file)


def is_done(path: Path | str, key: str) -> bool:
    """Whether the file of a task is there, whole, and of this key."""
    try:
        with readable(path) as file:
            return bool(file.attrs.get("task_key") == key)
    except OSError:  # absent, truncated, foreign: computed again
        return False


def check_own(folder: Path) -> None:
    """ValueError where a folder holds files and is no study: a run would write among them.

    A study has its lock, or files with the key of a task.
    """
    if not folder.is_dir() or (folder / LOCK).is_file():
        return
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    files = [*folder.glob("[!.]*.nc"), *(folder / STAGES[0]).glob("[!.]*.nc")]
    if names and not any(is_keyed(path) for path in files):
        shown = ", ".join(names[:3]) + ", ..." * (len(names) > 3)
        raise ValueError(
            f"{folder} is no study and is not empty (it has {shown}): give a new or an empty folder"
        )


def is_keyed(path: Path) -> bool:
    """Whether a file was written by :func:`write`."""
    try:
        return "task_key" in attributes(path)
    except OSError:
        return False


def open_without_following(path: str, flags: int) -> int:
    """Open a file of our own: where a symbolic link lies in its place, that is an OSError."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


@contextmanager
def lock(folder: Path | str) -> Iterator[Claim]:
    """Hold a study folder against a second run.

    Released by the system when the process ends in whatever way.  Temporary files of a run that was
    killed are removed; a folder with files of somebody else is not touched.

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
        import fcntl
    except ImportError:  # on Windows
        fcntl = None
        log.warning("this system cannot lock %s; start no second run in it", folder)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        handle = open(Path(folder) / LOCK, "a+", opener=open_without_following)
    except OSError as error:
        raise OSError(f"{folder} cannot be written ({error}): give another folder") from error
    with handle:
        try:
            if fcntl:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.seek(0)
            owner, *_ = handle.read().split() or ["unknown"]
            raise ValueError(
                f"another run (process {owner}) is working on {folder}; "
                "wait for it to end or give another folder"
            ) from None
        token = f"{os.getpid()} {uuid.uuid4().hex}"
        handle.truncate(0)
        handle.write(token)
        handle.flush()
        for stage in ("", *STAGES):
            for temporary in (Path(folder) / stage).glob(".*.nc.*.tmp"):
                if TEMPORARY.fullmatch(temporary.name):
                    temporary.unlink(missing_ok=True)
        yield Claim(Path(folder), token)
