"""Write and read the files of a study (4): netCDF-4 with checksums and a fast table of contents.

HDF5 takes milliseconds to list a file, and a study of a thousand shapes has three thousand files.
Each file therefore has its contents in the variable ``/s4a/contents_3``: JSON with the attributes,
dims and types of every group, and the values of texts and small variables.  The contents and all
numeric variables have Fletcher-32 checksums, which HDF5 verifies whenever it reads them; its
metadata has checksums since version 1.10.

Files may be untrusted.  HDF5 follows links into other files, reads values from them (external
storage, virtual datasets) and unpacks compressed data of any size.  :func:`open_hdf5`, the only
function that opens HDF5 files for reading, and :func:`values_of` refuse all of this.
"""

import json
import math
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
from h5py import h5a, h5d, h5ds, h5f, h5l, h5o, h5s, h5t, h5z
from xarray.backends import BackendArray
from xarray.conventions import cf_encoder, encode_dataset_coordinates
from xarray.core import indexing

from s4a.schema import check_indices

GROUP, CONTENTS = "s4a", "s4a/contents_3"  # with the number of the format
SMALL = 100  # largest variable whose values are in the contents
COMPRESSED = 1000  # smallest variable that is compressed on request
LARGEST_TEXT = 2**28  # bytes of memory for the texts of a variable
LEAST, RATIO = 2**26, 200  # bytes that are always read; beyond, the ratio of these to those stored
FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable."  # text of netCDF


class DamagedError(OSError):
    """A file of a study is damaged or was changed."""


# ---- reading any HDF5


@contextmanager
def damage_named(path: Path | str) -> Iterator[None]:
    """Turn any error that damage in a file causes into a DamagedError with file and remedy."""
    try:
        yield
    except (FileNotFoundError, PermissionError, MemoryError, DamagedError):
        raise
    except Exception as error:  # HDF5, h5py and NumPy raise many types
        raise DamagedError(
            f"{path} cannot be read ({error}): remove it and run the analysis again, "
            "which computes only the missing file"
        ) from error


def check_regular(path: Path | str) -> None:
    """Raise OSError unless a file of a study is a regular file, not a link, pipe or device."""
    kind = os.lstat(path).st_mode
    if stat.S_ISLNK(kind):
        raise OSError("a symbolic link, which is not followed within a study")
    if not stat.S_ISREG(kind):
        raise OSError("not a regular file")


@contextmanager
def open_hdf5(path: Path | str) -> Iterator[h5f.FileID]:
    """Open an untrusted HDF5 file; links, pipes, devices and folders are refused."""
    check_regular(path)
    file = h5f.open(os.fsencode(path), h5f.ACC_RDONLY)
    try:
        yield file
    finally:
        file.close()


def stored_in(file: h5f.FileID, name: str) -> Any:
    """Return the low-level group or dataset of a name; OSError if a part of the name is a link."""
    stored: Any = file
    for part in name.encode().split(b"/"):
        if stored.links.get_info(part).type != h5l.TYPE_HARD:
            raise OSError(f"{name} is a link, and links are not followed")
        stored = h5o.open(stored, part)
    return stored


def values_of(file: h5f.FileID, name: str, shape: Sequence[int] | None = None) -> np.ndarray:
    """Read the numbers of a variable; OSError unless they are in the file, and of this shape."""
    stored = stored_in(file, name)
    if not isinstance(stored, h5d.DatasetID):
        raise OSError(f"{name} is not a variable")
    if shape is not None and stored.shape != tuple(shape):
        raise OSError(f"{name} has another shape than its contents say")
    check_contained(stored, name)
    if stored.dtype.kind not in "iuf":
        raise OSError(f"{name} needs numbers, found {stored.dtype}")
    values = np.empty(stored.shape, stored.dtype)
    stored.read(h5s.ALL, h5s.ALL, values)
    return values


def check_contained(stored: h5d.DatasetID, name: str) -> None:
    """Raise OSError unless the values of a dataset are in its file, and not too many for it."""
    plan = stored.get_create_plist()
    if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
        raise OSError(f"{name} has its values in other files, which are not read")
    if not {plan.get_filter(i)[0] for i in range(plan.get_nfilters())} <= FILTERS:
        raise OSError(f"{name} has a filter that is not deflate, shuffle or Fletcher-32")
    # Deflate packs at most 1032 to 1: check before memory is allocated
    size, packed = math.prod(stored.shape) * stored.dtype.itemsize, stored.get_storage_size()
    if size > 1032 * packed:
        raise OSError(f"{name} is incomplete")
    check_size(name, size, packed)


def check_size(name: str, size: int, packed: int) -> None:
    """Raise OSError if `size` bytes of values are too many for those that are stored."""
    if size > max(LEAST, RATIO * packed):
        raise OSError(f"{name} needs {size} bytes of memory, but has {packed} in the file")


def check_texts(stored: h5d.DatasetID, name: str) -> None:
    """Raise OSError if the texts of a variable are too long; many may share bytes of the file."""
    texts, n_bytes = h5py.Dataset(stored), 0
    for row in range(stored.shape[0]):
        n_bytes += sum(map(len, np.ravel(texts[row])))
        if n_bytes > LARGEST_TEXT:
            raise OSError(f"{name} has more text than its file")


def open_plain(path: Path | str) -> xr.Dataset:
    """Open a file as other netCDF programs do, after a check that all values are in it."""
    with open_hdf5(path) as file:
        links: list[tuple[bytes, int]] = []  # an error within `visit` would be lost
        file.links.visit(lambda name, info: links.append((name, info.type)), info=True)
        for name, kind in links:
            if kind != h5l.TYPE_HARD:
                raise OSError(f"{name.decode()} is a link, and links are not followed")
            stored = h5o.open(file, name)
            if isinstance(stored, h5d.DatasetID):
                scale = h5py.Dataset(stored).attrs.get("NAME", b"")
                if stored.get_storage_size() or not scale.startswith(NO_VARIABLE.encode()):
                    check_contained(stored, name.decode())
                if stored.dtype.kind == "O" and stored.shape:
                    check_texts(stored, name.decode())
    return xr.open_dataset(path, engine="h5netcdf", decode_times=False)


# ---- reading a file of a study


@contextmanager
def opened(path: Path | str) -> Iterator[tuple[h5f.FileID, bytes, dict[str, Any]]]:
    """Open a file; yields the file, its contents as stored, and as a dict.

    The dict has for each group, by its path ("" for the root), its attributes ``attrs``, its
    ``variables`` and the names of its coordinates ``coords``.
    """
    with damage_named(path), open_hdf5(path) as file:
        if not file.links.exists(GROUP.encode()):
            raise OSError(f"it has no /{CONTENTS}: another version of s4a wrote it")
        text = values_of(file, CONTENTS).tobytes()
        nodes = json.loads(text)
        entries = [entry for node in nodes.values() for entry in node["variables"].values()]
        size = sum(math.prod(e["shape"]) * np.dtype(e["dtype"]).itemsize for e in entries)
        check_size("it", size, os.stat(path).st_size)
        yield file, text, nodes


def values_in(file: h5f.FileID, path: str, entry: Mapping[str, Any]) -> np.ndarray:
    """Read a variable of an open file, given its entry in the contents."""
    dtype = type_of(entry)
    if "values" in entry:
        values = np.array(entry["values"], object)
    else:
        values = values_of(file, path, entry["shape"])
    if dtype.kind == "U":  # NumPy pads each text to the longest
        if 4 * max(map(len, values.flat), default=0) * values.size > LARGEST_TEXT:
            raise OSError(f"{path} has more text than its file")
        return values.astype(str).reshape(entry["shape"])
    return values.astype(dtype, copy=False).reshape(entry["shape"])


def type_of(entry: Mapping[str, Any]) -> np.dtype:
    """Return the type of a variable; OSError unless it is of numbers, booleans or texts."""
    dtype = np.dtype(entry["dtype"])
    if dtype.kind not in "iufbU":
        raise OSError(f"numbers or texts needed, found {dtype}")
    return dtype


class Stored(BackendArray):
    """A variable that is read when it is used; the file is not kept open."""

    def __init__(
        self, file: Path, path: str, entry: Mapping[str, Any], stamp: bytes, sizes: dict[str, int]
    ):
        self.file, self.path, self.entry, self.stamp, self.sizes = file, path, entry, stamp, sizes
        self.shape, self.dtype = tuple(map(int, entry["shape"])), type_of(entry)
        self.written = os.stat(file).st_mtime_ns

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self.part
        )

    def part(self, key: Any) -> np.ndarray:
        """Read the selection from the file; ValueError if the file was written again."""
        if not self.file.exists():
            raise FileNotFoundError(
                f"{self.file} was removed since it was opened: put it back and open the study again"
            )
        with damage_named(self.file), open_hdf5(self.file) as file:
            same = os.stat(self.file).st_mtime_ns == self.written
            # a repeated run may write the same contents
            if same := same or values_of(file, CONTENTS).tobytes() == self.stamp:
                values = values_in(file, self.path, self.entry)
                check_indices(Path(self.path).name, values, self.sizes)
        if not same:
            raise ValueError(
                f"{self.file} was written again since it was opened; open the study again"
            )
        return values[key]


class Stacked(BackendArray):
    """Stack of variables, one per shape of a study, that are read when they are used."""

    def __init__(self, variables: list[xr.Variable]):
        self.variables = variables
        shapes = {variable.shape for variable in variables}
        if len(shapes) != 1:
            raise ValueError(f"arrays of equal shape needed, found {sorted(shapes)}")
        self.shape = (len(variables), *shapes.pop())
        self.dtype = np.result_type(*(variable.dtype for variable in variables))

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self.part
        )

    def part(self, key: tuple[Any, ...]) -> np.ndarray:
        """Read a selection: an integer, a slice or an array of integers for each axis."""
        row_key, *rest = key
        rows = np.arange(len(self.variables))[row_key]
        if np.ndim(rows) == 0:
            return self.variables[rows][tuple(rest)].values
        like = xr.Variable(self.variables[0].dims, np.broadcast_to(0, self.shape[1:]))
        values = np.empty((len(rows), *like[tuple(rest)].shape), self.dtype)
        for i, row in enumerate(rows):
            values[i] = self.variables[row][tuple(rest)].values
        return values


def stacked(variables: list[xr.Variable]) -> Any:
    """Lazy data of a variable, stacked from several files, with a cache."""
    lazy: Any = indexing.LazilyIndexedArray(Stacked(variables))
    return indexing.MemoryCachedArray(indexing.CopyOnWriteArray(lazy))


def open_file(
    path: Path | str, others: Mapping[str, int] | None = None, *, node: str = "", load: bool = False
) -> xr.Dataset:
    """Open a file, or a group of it, as a Dataset; larger variables are read when they are used.

    Parameters
    ----------
    path : path
    others : dict of str to int, optional
        Sizes of dims of other files that indices of this file refer to.
    node : str
        Path of the group.
    load : bool
        Read all variables now.
    """
    path = Path(path).absolute()  # the working directory may change before a variable is read
    with opened(path) as (file, text, nodes):
        sizes = dict(others or {})
        for entry in nodes[node]["variables"].values():
            sizes |= dict(zip(entry["dims"], entry["shape"], strict=True))
        variables = {}
        for name, entry in nodes[node]["variables"].items():
            inner = f"{node}/{name}".lstrip("/")
            values: Any
            if load or "values" in entry:
                values = values_in(file, inner, entry)
                check_indices(name, values, sizes)
            else:
                values = indexing.LazilyIndexedArray(Stored(path, inner, entry, text, sizes))
            variables[name] = xr.Variable(entry["dims"], values, entry["attrs"])
        data = xr.Dataset(variables, attrs=nodes[node]["attrs"])
        data.encoding["source"] = str(path)
        coords = [name for name in nodes[node]["coords"] if name not in data.coords]
        return data.set_coords(coords) if coords else data


def read(path: Path | str, others: Mapping[str, int] | None = None) -> xr.Dataset:
    """Read a file as a Dataset in memory, see :func:`open_file`."""
    return open_file(path, others, load=True)


def read_tree(path: Path | str) -> xr.DataTree:
    """Read a file as a DataTree in memory."""
    with opened(path) as (_, _, nodes):
        names = list(nodes)
    return xr.DataTree.from_dict({f"/{n}": open_file(path, node=n, load=True) for n in names})


def arrays(path: Path | str, *names: str) -> list[np.ndarray]:
    """Read the values of some variables of a file."""
    with opened(path) as (file, _, nodes):
        return [values_in(file, name, nodes[""]["variables"][name]) for name in names]


def attributes(path: Path | str) -> dict[str, Any]:
    """Read the attributes of a file."""
    with opened(path) as (_, _, nodes):
        return nodes[""]["attrs"]


def is_done(path: Path | str, key: str) -> bool:
    """Return whether the file of a task exists, has this key, and is undamaged."""
    try:
        with opened(path) as (file, _, nodes):
            for name, entry in nodes[""]["variables"].items():
                values_in(file, name, entry)
            return nodes[""]["attrs"].get("task_key") == key
    except OSError:  # missing, damaged or foreign: compute again
        return False


# ---- writing


def write_netcdf(
    data: xr.Dataset | xr.DataTree, file: BufferedIOBase, compression: int = 0
) -> None:
    """Write a Dataset, or each node of a tree as a group, into an empty binary file.

    Parameters
    ----------
    data : Dataset or DataTree
        Variables of numbers, booleans and texts.
    file : binary file
        Open for reading and writing, such as ``io.BytesIO()``.
    compression : int
        Level of zlib, up to 9, for variables of more than 1,000 numbers; 0 for none.

    Raises
    ------
    TypeError
        If a variable or an attribute is not a number, a text, or an array of them.
    ValueError
        If a name has a slash, or a variable has the name of a dim and other dims.

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
    # 1.10 has checksums of its metadata, and no index of 2 KB for each variable
    with h5py.File(file, "w", libver="v110", track_order=True) as root:  # netCDF needs the order
        root.attrs["_NCProperties"] = np.array(f"version=2,hdf5={h5py.version.hdf5_version}", "S")
        for node, group in nodes.items():
            _write_group(root.require_group(node) if node else root, group, compression)
        contents = {node: _contents_of(group) for node, group in nodes.items()}
        text = json.dumps(contents, default=lambda number: number.tolist()).encode()
        packed = {"chunks": (len(text),), "compression": 1, "fletcher32": True}
        root.create_dataset(CONTENTS, data=np.frombuffer(text, "u1"), **packed).make_scale()


def _contents_of(data):
    """Contents of one group, see :func:`opened`."""
    variables = {}
    for name, var in data.variables.items():
        kind = "U" if var.dtype.kind in "UO" else var.dtype.str
        variables[name] = {"dims": var.dims, "shape": var.shape, "dtype": kind, "attrs": var.attrs}
        if kind == "U" or var.size <= SMALL:
            variables[name]["values"] = var.values.tolist()
    return {"attrs": data.attrs, "variables": variables, "coords": list(data.coords)}


def _write_group(group, data, compression):
    """Write variables, attributes and dims of a group by the conventions of netCDF."""
    variables, attrs = cf_encoder(*encode_dataset_coordinates(data.drop_encoding()))
    _add_attributes(group, attrs)
    stored: dict[str, h5py.Dataset] = {}
    for name, var in variables.items():
        if "/" in "".join((name, *var.dims)) or (name in data.sizes and var.dims != (name,)):
            raise ValueError(
                "names without slash needed, and that of a dim only for its coordinate; "
                f"found {name}{var.dims}"
            )
        values = _as_stored(var.values, name)
        packed = {}
        if values.dtype.kind in "iuf" and values.size and values.ndim:  # in one chunk
            packed = {"chunks": values.shape, "fletcher32": True}
            if compression and values.size > COMPRESSED:
                packed |= {"compression": compression, "shuffle": True}
        if data.variables[name].dtype.kind not in "iufbUO":
            raise TypeError(f"{name} needs numbers or texts, found {data.variables[name].dtype}")
        fill = var.attrs.get("_FillValue")
        stored[name] = group.create_dataset(
            name, data=values, fillvalue=fill, track_order=True, **packed
        )
        _add_attributes(stored[name], var.attrs)
    scales: dict[str, h5py.Dataset] = {}
    for dim, size in data.sizes.items():
        scale = stored.get(dim) or group.create_dataset(dim, (size,), ">f4", track_order=True)
        scale.make_scale(dim if dim in stored else f"{NO_VARIABLE}{size:10}")
        scales[dim] = scale
    for name, var in variables.items():
        for axis, dim in enumerate(var.dims if name not in data.sizes else ()):
            h5ds.attach_scale(stored[name].id, scales[dim].id, axis)


def _as_stored(values, name):
    """Values for HDF5: numbers as they are, texts with variable length."""
    values = np.asarray(values)
    if values.dtype.kind in "iuf":
        return values
    if values.dtype.kind == "U" or all(isinstance(text, str) for text in values.flat):
        return values.astype(h5py.string_dtype())
    raise TypeError(f"{name} needs numbers or texts, found {values.dtype}")


def _add_attributes(stored, attrs):
    """Write attributes of a variable or a group; single numbers as arrays, as in netCDF."""
    for name, value in attrs.items():
        values = _as_stored(value, name)
        values = values if values.dtype.hasobject else np.atleast_1d(values)
        kind = h5t.py_create(values.dtype, logical=True)  # h5py's own way takes three times as long
        space = h5s.create_simple(values.shape) if values.ndim else h5s.create(h5s.SCALAR)
        h5a.create(stored.id, name.encode(), kind, space).write(values)
