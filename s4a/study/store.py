"""A study: one xarray DataTree in memory, one folder of netCDF files on disk, one file per task.

Every file is written under a temporary name and renamed, so that a killed run leaves only whole
files; the key of its task (content, parameters, version) stands in its attributes and says whether
it is still valid.
"""

import hashlib
import io
import json
import logging
import os
import sys
import uuid
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

import h5py
import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

log = logging.getLogger(__name__)

ENGINE: Final = "h5netcdf"
VERSION = version("s4a")


def task_key(*parts):
    """A hash of all that a result depends on: strings, numbers, lists, dicts, arrays, bytes.

    And the version of S4A.
    """
    digest = hashlib.sha256(f"s4a {VERSION}".encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            kind, data = f"{part.dtype.str}{part.shape}", np.ascontiguousarray(part).tobytes()
        elif isinstance(part, bytes):
            kind, data = "bytes", part
        else:
            kind, data = (
                "json",
                json.dumps(part, sort_keys=True, default=lambda number: number.item()).encode(),
            )
        digest.update(f"{kind} {len(data)}:".encode() + data)
    return digest.hexdigest()[:32]


@dataclass(frozen=True)
class Claim:
    """The right of one run to write into a folder, as it stands in its lock.

    It travels to the workers.
    """

    folder: Path
    token: str

    @property
    def owner(self):
        """Number of the process of the run."""
        return int(self.token.split()[0])

    def check(self):
        """ValueError when the folder has been taken over.

        As by the run that follows one that was killed.
        """
        try:
            held = (self.folder / ".lock").read_text()
        except OSError:
            held = ""
        if held != self.token:
            raise ValueError(f"the run of process {self.owner} no longer holds {self.folder}")


def write(data, path, key="", made_from=(), claim=None):
    """Write a Dataset to `path` at once: under a temporary name in the same folder, then renamed.

    `made_from` are the keys of the files that it was computed from; :func:`open_study` leaves a
    file out when one of them is no longer there, as after a run with other options was stopped
    half-way.  With a `claim` nothing is written when it no longer holds.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    whole = io.BytesIO()  # HDF5 brings the process down when the disk is full
    with alone():
        data.assign_attrs(task_key=key, made_from=" ".join(made_from)).to_netcdf(
            whole, engine=ENGINE
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(whole.getbuffer())
        if claim is not None:
            claim.check()
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(
            f"{path} cannot be written ({error}): is the disk full, or the folder read-only? "
            "Finished files are whole; the same command goes on where it stopped"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def alone():
    """Keeps xarray from asking a dask scheduler, where there is one.

    For a lock on a buffer that only we have.
    """
    dask = sys.modules.get("dask")
    return dask.config.set(scheduler="synchronous") if dask else nullcontext()


HIDDEN = {
    "CLASS",
    "NAME",
    "DIMENSION_LIST",
    "REFERENCE_LIST",
    "_NCProperties",
    "_Netcdf4Coordinates",
    "_Netcdf4Dimid",
}
SMALL = 1000  # entries up to which a variable is read when its file is opened


class Stored(BackendArray):
    """A variable of a file that is read when it is asked for; it holds no file open."""

    def __init__(self, path, stored, key):
        self.path, self.name, self.key = path, stored.name, key
        self.shape, self.dtype = stored.shape, stored.dtype

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self.part
        )

    def part(self, key):
        """Read the selection from the file; ValueError where it was written anew."""
        with h5py.File(self.path) as file:
            if file.attrs.get("task_key") != self.key:
                raise ValueError(
                    f"{self.path} was written anew since it was opened; open the study again"
                )
            return file[self.name][()][key]


@contextmanager
def readable(path):
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


def opened(path):
    """The Dataset of one file; its larger variables are read when they are used.

    What :func:`xarray.open_dataset` gives, in less than half of the time: h5netcdf asks HDF5 for
    everything about each dimension of each variable.  Only files as :func:`write` writes them can
    be read: no groups, no chunks.
    """
    path = Path(path).absolute()  # what is read later does not follow the working directory
    with readable(path) as file:
        attrs = _attributes(file)
        variables = {}
        for name, stored in file.items():
            own = stored.attrs
            if "DIMENSION_LIST" in own:
                dims = [file[ref[0]].name.lstrip("/") for ref in own["DIMENSION_LIST"]]
            elif own.get("CLASS") == b"DIMENSION_SCALE":
                if own["NAME"].startswith(b"This is a netCDF dimension but not a netCDF variable"):
                    continue
                dims = [name]
            else:
                dims = ()
            if h5py.check_string_dtype(stored.dtype):
                values = np.array(stored.asstr()[()], str)
            elif stored.size <= SMALL:
                values = stored[()]
            else:
                values = indexing.LazilyIndexedArray(Stored(path, stored, attrs.get("task_key")))
            variables[name] = xr.Variable(dims, values, _attributes(stored))
        data = xr.decode_cf(xr.Dataset(variables, attrs=attrs), decode_times=False)
    data.encoding["source"] = str(path)
    return data


def _attributes(stored):
    found = {name: stored.attrs[name] for name in stored.attrs if name not in HIDDEN}
    return {
        n: v[0] if isinstance(v, np.ndarray) and v.shape == (1,) else v for n, v in found.items()
    }


def read(path):
    """The Dataset of one file, in memory."""
    return opened(path).load()


def arrays(path, *names):
    """The values of some variables of one file, without a Dataset."""
    with readable(path) as file:
        return [file[name][()] for name in names]


def attributes(path):
    """The attributes of one file."""
    with readable(path) as file:
        return _attributes(file)


def is_done(path, key):
    """Whether the file of a task is there, whole, and of this key."""
    try:
        with readable(path) as file:
            return bool(file.attrs.get("task_key") == key)
    except OSError:  # absent, truncated, foreign: computed again
        return False


@contextmanager
def lock(folder):
    """Hold a study folder against a second run.

    Released by the system when the process ends in whatever way.

    Temporary files of a run that was killed are removed.

    Yields
    ------
    Claim

    Raises
    ------
    ValueError
        When another process holds the folder; its number is named.
    """
    try:
        import fcntl
    except ImportError:  # on Windows
        fcntl = None
        log.warning("this system cannot lock %s; start no second run in it", folder)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        handle = open(Path(folder) / ".lock", "a+")
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
        for left in Path(folder).rglob(".*.tmp"):
            left.unlink(missing_ok=True)
        yield Claim(Path(folder), token)
