"""A Dataset as a netCDF-4 file (4), by plain calls of HDF5.

xarray's conventions and what reads them are the same.  It writes by h5netcdf itself, which looks
names up in the file again and again: ``speed.py write`` has what that takes.
"""

from importlib.metadata import version
from io import BufferedIOBase
from typing import Any

import h5py
import numpy as np
import xarray as xr
from xarray.conventions import cf_encoder, encode_dataset_coordinates

# who wrote a file, and what is a dim without a coordinate, as the netCDF library says it
WRITTEN_BY = f"version=2,s4a={version('s4a')},hdf5={h5py.version.hdf5_version}"
COMPRESSED = 1000  # numbers from which on a variable is compressed: a chunk has costs of its own
NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable."


def write_netcdf(data: xr.Dataset, file: BufferedIOBase, compression: int = 0) -> None:
    """Write a Dataset into an empty binary file, each variable as one whole.

    Parameters
    ----------
    data : Dataset
        Of numbers and texts; truth values and dates as what xarray makes of them.
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
    variables, attrs = cf_encoder(*encode_dataset_coordinates(data))
    number = {dim: i for i, dim in enumerate(data.sizes)}
    for name in {**number, **variables}:
        dims = variables[name].dims if name in variables else (name,)
        if "/" in name or (name in number and dims != (name,)):
            raise ValueError(
                f"a name without slash, and of no dim but its own, needed; found {name}"
            )
    libver = "v110" if compression else None  # before 1.10 an index of 2 KB for each variable
    # the order of writing, as netCDF asks
    with h5py.File(file, "w", libver=libver, track_order=True) as root:
        root.attrs["_NCProperties"] = np.array(WRITTEN_BY, "S")
        _add_attributes(root, attrs)
        stored = {
            name: _add_variable(root, name, one, compression) for name, one in variables.items()
        }
        scales = {dim: stored[dim] for dim in number if dim in stored}
        for dim, size in data.sizes.items():
            if dim not in scales:
                scales[dim] = root.create_dataset(dim, (size,), ">f4", track_order=True)
            scales[dim].make_scale(dim if dim in stored else f"{NO_VARIABLE}{size:10}")
            scales[dim].attrs["_Netcdf4Dimid"] = np.int32(number[dim])
        for name, variable in variables.items():
            if not variable.dims:
                continue
            for axis, dim in enumerate(variable.dims if name not in scales else ()):
                stored[name].dims[axis].attach_scale(scales[dim])
            ids = np.array([number[dim] for dim in variable.dims], np.int32)
            stored[name].attrs["_Netcdf4Coordinates"] = ids
            stored[name].attrs["_Netcdf4Dimid"] = ids[0]


def _add_variable(root, name, variable, compression):
    """The values and attributes of a variable, without its dims."""
    attrs = dict(variable.attrs)
    values = _as_stored(variable.values, name)
    packed: dict[str, Any] = {}
    if compression and values.dtype.kind in "iuf" and values.size > COMPRESSED:
        packed = {"compression": compression, "shuffle": True, "chunks": values.shape}
    fill = attrs.get("_FillValue")
    stored = root.create_dataset(name, data=values, fillvalue=fill, track_order=True, **packed)
    _add_attributes(stored, attrs)
    return stored


def _as_stored(values: Any, name: str) -> Any:
    """Values as HDF5 takes them: numbers as they are, texts of any length."""
    values = np.asarray(values)
    if values.dtype.kind in "iuf":
        return values
    if values.dtype.kind == "U" or all(isinstance(text, str) for text in values.flat):
        return values.astype(h5py.string_dtype())
    raise TypeError(f"{name} needs numbers or texts, found {values.dtype}")


def _add_attributes(stored, attrs):
    """The attributes of a variable or the file; single numbers as lists of one, as netCDF does."""
    for name, value in attrs.items():
        values = _as_stored(value, name)
        stored.attrs[name] = values if values.dtype.hasobject else np.atleast_1d(values)
