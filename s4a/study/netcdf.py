"""One file of a study (4): netCDF-4, which any program reads, with one writer and one fast reader.

HDF5 takes milliseconds to tell what a file holds, and a study of a thousand shapes has three
thousand files.  Each file therefore has its own contents as text in the variable
``/s4a/contents_3``: JSON with the attributes, dims and types of every group, and the values of
texts and small variables.  The contents and all variables of numbers have Fletcher-32 checksums,
which HDF5 verifies whenever it reads them; its notes of them have checksums since version 1.10.

A study may be of a stranger.  HDF5 follows links into other files, takes values from them (external
storage, virtual datasets) and unpacks what was stored small.  :func:`open_hdf5` and
:func:`values_of` refuse all of this.
"""

import json
import math
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
from h5py import h5d, h5f, h5l, h5o, h5s, h5z
from xarray.backends import BackendArray
from xarray.conventions import cf_encoder, encode_dataset_coordinates
from xarray.core import indexing

from s4a.schema import check_indices

GROUP, CONTENTS = "s4a", "s4a/contents_3"  # with the number of the format
SMALL = 100  # numbers up to which the contents have the values of a variable
COMPRESSED = 1000  # numbers from which a variable is compressed where that is asked for
LARGEST_TEXT = 2**31  # bytes of memory that the texts of a variable may need
FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable."  # as netCDF notes it


class DamagedError(OSError):
    """A file of a study that is not, or no longer, what a run wrote."""


# ---- reading any HDF5


@contextmanager
def damage_named(path: Path | str) -> Iterator[None]:
    """Turn every error that damage in a file causes into a DamagedError with file and remedy."""
    try:
        yield
    except (FileNotFoundError, PermissionError, MemoryError, DamagedError):
        raise
    except Exception as error:  # HDF5, h5py and NumPy each have their own ways with damage
        raise DamagedError(
            f"{path} cannot be read ({error}): remove it and run the analysis again, "
            "which makes it again and nothing else"
        ) from error


def check_regular(path: Path | str) -> None:
    """OSError for a link, a pipe, a device or a folder in the place of a file of a study."""
    kind = os.lstat(path).st_mode
    if stat.S_ISLNK(kind):
        raise OSError("a symbolic link, which is not followed within a study")
    if not stat.S_ISREG(kind):
        raise OSError("not a regular file")


@contextmanager
def open_hdf5(path: Path | str) -> Iterator[h5f.FileID]:
    """Open an HDF5 file of whatever origin: neither a link nor a pipe, a device or a folder."""
    with damage_named(path):
        check_regular(path)
        file = h5f.open(os.fsencode(path), h5f.ACC_RDONLY)
        try:
            yield file
        finally:
            file.close()


def values_of(file: h5f.FileID, name: str) -> np.ndarray:
    """Read the numbers of a variable; OSError unless they are bytes of the file itself."""
    place: Any = file
    for part in name.encode().split(b"/"):
        if place.links.get_info(part).type != h5l.TYPE_HARD:
            raise OSError(f"{name} is a link, and links are not followed")
        place = h5o.open(place, part)
    if not isinstance(place, h5d.DatasetID):
        raise OSError(f"{name} is not a variable")
    plan = place.get_create_plist()
    if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
        raise OSError(f"{name} takes its values from other files, which are not read")
    if not {plan.get_filter(i)[0] for i in range(plan.get_nfilters())} <= FILTERS:
        raise OSError(f"{name} is packed in another way than variables of a study are")
    if place.dtype.kind not in "iuf":
        raise OSError(f"{name} needs numbers, found {place.dtype}")
    # Deflate packs at most 1032 to 1: more is refused before memory is asked for
    if math.prod(place.shape) * place.dtype.itemsize > 1032 * place.get_storage_size():
        raise OSError(f"{name} has not all values that it should have")
    values = np.empty(place.shape, place.dtype)
    place.read(h5s.ALL, h5s.ALL, values)
    return values


# ---- reading a file of a study


@contextmanager
def opened(path: Path | str) -> Iterator[tuple[h5f.FileID, bytes, dict[str, Any]]]:
    """An open file, its contents as they stand in it, and as a dict.

    The dict has for each group, by its path ("" for that of the file), its attributes ``attrs``,
    its ``variables`` and the names of its coordinates ``coords``.
    """
    with open_hdf5(path) as file:
        if not file.links.exists(GROUP.encode()):
            raise OSError(
                f"it has no /{CONTENTS}: another version of s4a wrote it; run the analysis again"
            )
        text = values_of(file, CONTENTS).tobytes()
        yield file, text, json.loads(text)


def values_in(file: h5f.FileID, path: str, one: Mapping[str, Any]) -> np.ndarray:
    """The values of a variable of an open file, of which `one` are the contents."""
    dtype = type_of(one)
    values = np.array(one["values"], object) if "values" in one else values_of(file, path)
    if dtype.kind == "U":  # NumPy gives each text the length of the longest
        if 4 * max(map(len, values.flat), default=0) * values.size > LARGEST_TEXT:
            raise OSError(f"{path} has more text than its file")
        return values.astype(str).reshape(one["shape"])
    return values.astype(dtype, copy=False).reshape(one["shape"])


def type_of(one: Mapping[str, Any]) -> np.dtype:
    """The type of a variable; OSError unless it is one of numbers, truth values or texts."""
    dtype = np.dtype(one["dtype"])
    if dtype.kind not in "iufbU":
        raise OSError(f"numbers or texts needed, found {dtype}")
    return dtype


class Stored(BackendArray):
    """A variable of a file that is read when it is asked for; it holds no file open."""

    def __init__(
        self, file: Path, path: str, one: Mapping[str, Any], stamp: bytes, sizes: dict[str, int]
    ):
        self.file, self.path, self.one, self.stamp, self.sizes = file, path, one, stamp, sizes
        self.shape, self.dtype = tuple(map(int, one["shape"])), type_of(one)
        self.written = os.stat(file).st_mtime_ns

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self.part
        )

    def part(self, key: Any) -> np.ndarray:
        """Read the selection from the file; ValueError where it was written again."""
        with open_hdf5(self.file) as file:
            same = os.stat(self.file).st_mtime_ns == self.written  # or by the same run again
            if same := same or values_of(file, CONTENTS).tobytes() == self.stamp:
                values = values_in(file, self.path, self.one)
                check_indices(Path(self.path).name, values, self.sizes)
        if not same:
            raise ValueError(
                f"{self.file} was written again since it was opened; open the study again"
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
            return self.variables[rows][tuple(rest)].values
        like = xr.Variable(self.variables[0].dims, np.broadcast_to(0, self.shape[1:]))
        found = np.empty((len(rows), *like[tuple(rest)].shape), self.dtype)
        for i, row in enumerate(rows):
            found[i] = self.variables[row][tuple(rest)].values
        return found


def stacked(variables: list[xr.Variable]) -> Any:
    """What a variable holds that is read from several files when it is used, and then kept."""
    lazy: Any = indexing.LazilyIndexedArray(Stacked(variables))
    return indexing.MemoryCachedArray(indexing.CopyOnWriteArray(lazy))


def open_file(
    path: Path | str,
    others: Mapping[str, int] | None = None,
    *,
    node: str = "",
    load: bool = False,
) -> xr.Dataset:
    """The Dataset of a file, or of a group; its larger variables are read when they are used.

    Parameters
    ----------
    path : path
    others : dict of str to int, optional
        Sizes of dims of other files, into which indices of this one point.
    node : str
        Path of the group.
    load : bool
        Whether all variables are read now.
    """
    path = Path(path).absolute()  # what is read later does not follow the working directory
    with opened(path) as (file, text, nodes):
        sizes = dict(others or {})
        for one in nodes[node]["variables"].values():
            sizes |= dict(zip(one["dims"], one["shape"], strict=True))
        variables = {}
        for name, one in nodes[node]["variables"].items():
            place = f"{node}/{name}".lstrip("/")
            values: Any
            if load or "values" in one:
                values = values_in(file, place, one)
                check_indices(name, values, sizes)
            else:
                values = indexing.LazilyIndexedArray(Stored(path, place, one, text, sizes))
            variables[name] = xr.Variable(one["dims"], values, one["attrs"])
        data = xr.Dataset(variables, attrs=nodes[node]["attrs"])
        data.encoding["source"] = str(path)
        coords = [name for name in nodes[node]["coords"] if name not in data.coords]
        return data.set_coords(coords) if coords else data


def read(path: Path | str, others: Mapping[str, int] | None = None) -> xr.Dataset:
    """The Dataset of :func:`open_file`, in memory."""
    return open_file(path, others, load=True)


def read_tree(path: Path | str) -> xr.DataTree:
    """The tree of one file, in memory."""
    with opened(path) as (_, _, nodes):
        names = list(nodes)
    return xr.DataTree.from_dict({f"/{n}": open_file(path, node=n, load=True) for n in names})


def arrays(path: Path | str, *names: str) -> list[np.ndarray]:
    """The values of some variables of one file, without a Dataset."""
    with opened(path) as (file, _, nodes):
        return [values_in(file, name, nodes[""]["variables"][name]) for name in names]


def attributes(path: Path | str) -> dict[str, Any]:
    """The attributes of one file."""
    with opened(path) as (_, _, nodes):
        return nodes[""]["attrs"]


def is_done(path: Path | str, key: str) -> bool:
    """Whether the file of a task is there, of this key, and every variable as it was written."""
    try:
        with opened(path) as (file, _, nodes):
            for name, one in nodes[""]["variables"].items():
                values_in(file, name, one)
            return nodes[""]["attrs"].get("task_key") == key
    except OSError:  # absent, damaged, foreign: computed again
        return False


# ---- writing


def write_netcdf(
    data: xr.Dataset | xr.DataTree, file: BufferedIOBase, compression: int = 0
) -> None:
    """Write a Dataset, or each node of a tree as a group, into an empty binary file.

    Parameters
    ----------
    data : Dataset or DataTree
        Of numbers, truth values and texts.
    file : binary file
        Open for reading and writing, such as ``io.BytesIO()``.
    compression : int
        Level of zlib, up to 9, for variables of more than 1,000 numbers; 0 compresses nothing.

    Raises
    ------
    TypeError
        When a variable or an attribute is neither a number, nor a text, nor an array of them.
    ValueError
        When a name has a slash, or a variable the name of a dim and others than that alone.

    Examples
    --------
    >>> import io
    >>> import xarray as xr
    >>> from s4a.study.netcdf import write_netcdf
    >>> data = xr.Dataset({"area": ("vertex", [0.5, 0.5])}, {"shape": "a"}, {"unit": "mm"})
    >>> file = io.BytesIO()
    >>> write_netcdf(data, file)
    >>> xr.open_dataset(file, engine="h5netcdf").identical(data)
    True
    """
    nodes = {"": data}
    if isinstance(data, xr.DataTree):
        nodes = {n.path.strip("/"): n.to_dataset(inherit=False) for n in data.subtree}
    # 1.10 has checksums of its own notes, and no index of 2 KB for each variable
    with h5py.File(file, "w", libver="v110", track_order=True) as root:  # as netCDF asks
        root.attrs["_NCProperties"] = np.array(f"version=2,hdf5={h5py.version.hdf5_version}", "S")
        for node, one in nodes.items():
            _write_group(root.require_group(node) if node else root, one, compression)
        said = {node: _contents_of(one) for node, one in nodes.items()}
        text = json.dumps(said, default=lambda number: number.tolist()).encode()
        packed = {"chunks": (len(text),), "compression": 1, "fletcher32": True}
        root.create_dataset(CONTENTS, data=np.frombuffer(text, "u1"), **packed).make_scale()


def _contents_of(data):
    """The contents of one group, see :func:`opened`."""
    variables = {}
    for name, one in data.variables.items():
        kind = "U" if one.dtype.kind in "UO" else one.dtype.str
        variables[name] = {"dims": one.dims, "shape": one.shape, "dtype": kind, "attrs": one.attrs}
        if kind == "U" or one.size <= SMALL:
            variables[name]["values"] = one.values.tolist()
    return {"attrs": data.attrs, "variables": variables, "coords": list(data.coords)}


def _write_group(group, data, compression):
    """The variables, attributes and dims of one group, as the conventions of netCDF have them."""
    variables, attrs = cf_encoder(*encode_dataset_coordinates(data.drop_encoding()))
    _add_attributes(group, attrs)
    stored: dict[str, h5py.Dataset] = {}
    for name, one in variables.items():
        if "/" in "".join((name, *one.dims)) or (name in data.sizes and one.dims != (name,)):
            raise ValueError(
                f"names without slash, and of no dim but its own, needed; found {name}{one.dims}"
            )
        values = _as_stored(one.values, name)
        packed = {}
        if values.dtype.kind in "iuf" and values.size and values.ndim:  # in one chunk
            packed = {"chunks": values.shape, "fletcher32": True}
            if compression and values.size > COMPRESSED:
                packed |= {"compression": compression, "shuffle": True}
        if data.variables[name].dtype.kind not in "iufbUO":
            raise TypeError(f"{name} needs numbers or texts, found {data.variables[name].dtype}")
        fill = one.attrs.get("_FillValue")
        stored[name] = group.create_dataset(
            name, data=values, fillvalue=fill, track_order=True, **packed
        )
        _add_attributes(stored[name], one.attrs)
    for dim, size in data.sizes.items():
        scale = stored.get(dim) or group.create_dataset(dim, (size,), ">f4", track_order=True)
        scale.make_scale(dim if dim in stored else f"{NO_VARIABLE}{size:10}")
    for name, one in variables.items():
        for axis, dim in enumerate(one.dims if name not in data.sizes else ()):
            stored[name].dims[axis].attach_scale(group[dim])


def _as_stored(values, name):
    """Values as HDF5 takes them: numbers as they are, texts of any length."""
    values = np.asarray(values)
    if values.dtype.kind in "iuf":
        return values
    if values.dtype.kind == "U" or all(isinstance(text, str) for text in values.flat):
        return values.astype(h5py.string_dtype())
    raise TypeError(f"{name} needs numbers or texts, found {values.dtype}")


def _add_attributes(stored, attrs):
    """The attributes of a variable or a group; single numbers as lists of one, as netCDF does."""
    for name, value in attrs.items():
        values = _as_stored(value, name)
        stored.attrs[name] = values if values.dtype.hasobject else np.atleast_1d(values)
