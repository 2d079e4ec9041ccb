"""Files of a study, one netCDF file per task; keys, and the lock of its folder.

Every file is written under a temporary name and renamed, so that a killed run leaves only whole
files; the key of its task (content, parameters, version) stands in its attributes and says whether
it is still valid.  Checksums (:mod:`s4a.study.seal`) say whether it is still what was written.
"""

import hashlib
import io
import json
import logging
import os
import re
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.conventions import decode_cf_variables
from xarray.core import indexing

from s4a.schema import check_indices
from s4a.study.hdf5 import Place, StudyFile
from s4a.study.header import Header
from s4a.study.locks import hold
from s4a.study.netcdf import write_netcdf
from s4a.study.processes import remove_remains
from s4a.study.seal import (
    BEHIND,
    SEALED,
    Seal,
    add_seal,
    check_parts,
    check_rest,
    is_larger,
    open_regular,
    read_part,
    read_seal,
)

log = logging.getLogger(__name__)

LOCK = ".lock"
# folders of a study
STAGES = ("original", "coarse", "network", "latent", "rounds", "registration", "fields")
OF_ALL = ("network", "latent", "registration", "pca", "subjects", "report")  # files beside them
LOGS = ".log"  # folder in that of a study: a file for each task that is at work or failed
TEMPORARY = re.compile(r"\.[\w-]+\.nc\.\d+\.tmp")  # as `write` names them

# attributes by which the conventions of netCDF say that values are not what they stand for
CODES = {"_FillValue", "missing_value", "scale_factor", "add_offset", "_Unsigned", "dtype"}
CODES |= {"coordinates", "_Encoding"}

ENGINE: Final = "h5netcdf"
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
    data: xr.Dataset,
    path: Path | str,
    key: str = "",
    made_from: Iterable[str] = (),
    claim: Claim | None = None,
    *,
    compression: int = 0,
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
    compression : int
        Of :func:`s4a.study.netcdf.write_netcdf`; encodings of the variables count for nothing.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    data = data.assign_attrs({"task_key": key, "made_from": " ".join(made_from), SEALED: BEHIND})
    data = data.drop_encoding()  # names put together keep the length of the first file's else
    whole = io.BytesIO()  # HDF5 brings the process down when the disk is full
    write_netcdf(data, whole, compression)
    add_seal(whole)
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


class Stored(BackendArray):
    """A variable of a file that is read when it is asked for; it holds no file open."""

    def __init__(
        self, path: Path, name: str, place: Place, stamp: Seal | str, sizes: dict[str, Any]
    ):
        self.path, self.name, self.place = path, name, place
        self.shape, self.dtype = place.shape, place.dtype
        self.stamp, self.sizes = stamp, sizes  # of the file, and of its dims

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self.part
        )

    def part(self, key: Any) -> np.ndarray:
        """Read the selection from the file; ValueError where it was written anew."""
        with damage_named(self.path), open_regular(self.path) as raw:
            seal = read_seal(raw)
            if same := self.stamp == (seal or attributes(self.path).get("task_key")):
                values = read_part(raw, seal, self.name, self.place)
                check_indices(self.name, values, self.sizes)
        if not same:
            raise ValueError(
                f"{self.path} was written anew since it was opened; open the study again"
            )
        return values[key]


class Stacked(BackendArray):
    """Variables of equal shape, one of each shape of a study; read are those that are asked for."""

    def __init__(self, variables: list[xr.Variable]):
        self.variables = variables
        shapes = {one.shape for one in variables}
        if len(shapes) != 1:
            raise ValueError(f"arrays of one shape needed, found {sorted(shapes)}")
        self.shape = (len(variables), *shapes.pop())
        self.dtype = np.result_type(*(one.dtype for one in variables))

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self.part
        )

    def part(self, key: tuple[Any, ...]) -> np.ndarray:
        """The selection: of each axis an integer, a slice or an array of integers."""
        first, *rest = key
        rows = np.arange(len(self.variables))[first]
        if np.ndim(rows) == 0:
            return selected(self.variables[rows].values, rest)
        found = None
        for i, row in enumerate(rows):
            values = selected(self.variables[row].values, rest)
            if found is None:
                found = np.empty((len(rows), *values.shape), self.dtype)
            found[i] = values
        if found is None:  # no rows
            found = np.empty((0, *self.shape[1:]), self.dtype)
            found = selected(found, [slice(None), *rest])
        return found


def selected(values: np.ndarray, key: Iterable[Any]) -> np.ndarray:
    """The entries of an array that are selected along each of its axes by itself."""
    axis = 0
    for one in key:
        values = values[(slice(None),) * axis + (one,)]
        axis += np.ndim(one) > 0 or isinstance(one, slice)
    return values


def stacked(variables: list[xr.Variable]) -> Any:
    """What a variable holds that is read from several files when it is used, and then kept."""
    lazy: Any = indexing.LazilyIndexedArray(Stacked(variables))
    return indexing.MemoryCachedArray(indexing.CopyOnWriteArray(lazy))


class DamagedError(OSError):
    """A file of a study that is not, or no longer, what a run wrote."""


@contextmanager
def damage_named(path: Path | str) -> Iterator[None]:
    """Whatever comes of damage in a file is one OSError that names it, and what mends it."""
    try:
        yield
    except (FileNotFoundError, PermissionError, MemoryError, DamagedError):
        raise
    except Exception as error:  # HDF5, h5py and NumPy each have their own ways with damage
        raise DamagedError(
            f"{path} cannot be read ({error}): remove it and run the analysis again, "
            "which makes it anew and nothing else"
        ) from error


@contextmanager
def readable(path: Path | str) -> Iterator[tuple[StudyFile | Header, Seal | None]]:
    """An open file of a study, whose seal holds for all that is read here, and its seal.

    What it holds is said by its header, or by HDF5 where it has none.
    """
    with damage_named(path), open_regular(path) as raw:
        seal = read_seal(raw)
        if seal:
            check_rest(raw, seal)  # before HDF5 is asked
        if seal and seal.header:
            yield Header(seal.header, raw), seal
            return
        with h5py.File(raw) as file:
            found = StudyFile(file, raw)
            if not seal and SEALED in file.attrs:
                raise OSError("its seal was cut off")
            yield found, seal


def open_file(path: Path | str, others: Mapping[str, int] | None = None) -> xr.Dataset:
    """The Dataset of one file; its larger variables are read when they are used.

    What :func:`xarray.open_dataset` gives, in a tenth of the time.  Only files as :func:`write`
    writes them can be read, see :mod:`s4a.study.hdf5`.

    Parameters
    ----------
    path : path
    others : dict of str to int, optional
        Sizes of dims of other files, into which indices of this one point.
    """
    path = Path(path).absolute()  # what is read later does not follow the working directory
    with readable(path) as (file, seal):
        attrs = file.attributes()
        attrs.pop(SEALED, None)
        variables: dict[str, xr.Variable] = {}
        sizes = dict(others or {})
        for name, place in file.places.items():
            dims = file.dims(name)
            sizes |= dict(zip(dims, place.shape, strict=True))
            values: Any
            if is_larger(place):
                stamp = seal or attrs.get("task_key", "")
                values = indexing.LazilyIndexedArray(Stored(path, name, place, stamp, sizes))
            else:
                values = file.values(name)
            variables[name] = xr.Variable(dims, values, file.attributes(name))
        for name, variable in variables.items():
            if not is_larger(file.places[name]):
                check_indices(name, variable.values, sizes)
        # as xarray.decode_cf, which makes three Datasets of it
        coded = {name: one for name, one in variables.items() if not decode_plain(one)}
        decoded, rest, coordinates = decode_cf_variables(coded, attrs, decode_times=False)
        data = xr.Dataset({**variables, **decoded}, attrs=rest)
        if not coordinates <= set(data.coords):
            data = data.set_coords(coordinates & set(decoded))
    data.encoding["source"] = str(path)
    return data


def decode_plain(variable: xr.Variable) -> bool:
    """Whether a variable holds its values as they are: numbers, NaN where there is none.

    It is then as xarray decodes it, but for the search for NaN, to put NaN there.
    """
    attrs, kind = variable.attrs, variable.dtype.kind
    fill = attrs.get("_FillValue")
    missing = kind == "f" and isinstance(fill, np.floating) and bool(np.isnan(fill))
    if kind not in "iuf" or len(CODES & attrs.keys()) > missing:
        return False
    variable.encoding["dtype"] = variable.dtype
    if missing:
        variable.encoding["_FillValue"] = attrs.pop("_FillValue")
    return True


def read(path: Path | str, others: Mapping[str, int] | None = None) -> xr.Dataset:
    """The Dataset of :func:`open_file`, in memory."""
    return open_file(path, others).load()


def arrays(path: Path | str, *names: str) -> list[np.ndarray]:
    """The values of some variables of one file, without a Dataset."""
    with readable(path) as (file, seal):
        if seal:
            check_parts(file.raw, seal, names)
        return [file.values(name) for name in names]


def attributes(path: Path | str) -> dict[str, Any]:
    """The attributes of one file."""
    with readable(path) as (file, _):
        attrs = file.attributes()
    attrs.pop(SEALED, None)
    return attrs


def is_done(path: Path | str, key: str) -> bool:
    """Whether the file of a task is there, of this key, and every byte of it as it was written."""
    try:
        with readable(path) as (file, seal):
            if file.attributes().get("task_key") != key:
                return False
            if seal:
                check_parts(file.raw, seal, seal.parts)
    except OSError:  # absent, damaged, foreign: computed again
        return False
    return True


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
        raise ValueError(
            f"{folder} is not a study folder: it has no folder {STAGES[0]!r}; "
            f"run `s4a run ... --out {folder}`"
        )
    refuse_links(folder)


def check_own(folder: Path) -> None:
    """ValueError where a folder holds files and is no study: a run would write among them.

    A study has its lock, or files with the key of a task.
    """
    refuse_links(folder)
    for name in OF_ALL:
        if is_of_another(folder / f"{name}.nc"):
            raise ValueError(
                f"{folder / name}.nc was not made by s4a, and a run would write in its place: "
                "move it away, or give another folder"
            )
    if not folder.is_dir() or (folder / LOCK).is_file():
        return
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    files = [*folder.glob("[!.]*.nc"), *(folder / STAGES[0]).glob("[!.]*.nc")]
    if names and not any(is_keyed(path) for path in files):
        shown = ", ".join(names[:3]) + ", ..." * (len(names) > 3)
        raise ValueError(
            f"{folder} is no study and is not empty (it has {shown}): give a new or an empty folder"
        )


def is_of_another(path: Path) -> bool:
    """Whether a file can be read, and :func:`write` has not written it."""
    try:
        return "task_key" not in attributes(path)
    except OSError:  # absent, or damaged and to be made anew
        return False


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
