"""Files of scalar fields (6.1, 6.2): a number per vertex, in the order of the file of the mesh."""

import logging
import zipfile
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.input import bounded
from s4a.input.annotations import (
    check_cells,
    is_number,
    number_of,
    order_of_vertices,
    table_rows,
)
from s4a.input.files import stem_of
from s4a.input.formats import gifti_arrays, ply_properties
from s4a.input.raw import check_there, shown, text_of
from s4a.schema import dataset, require

log = logging.getLogger(__name__)

CURV = b"\xff\xff\xff"  # how FreeSurfer's files of a number per vertex begin
SUFFIXES = (".npy", ".npz", ".ply", ".csv", ".txt", ".gii")


def read_scalars(path: Path | str, name: str = "", n: int | None = None) -> np.ndarray:
    """One number per vertex from a file.

    Parameters
    ----------
    path : str or Path
        NPY; NPZ, the array `name` where there are several; PLY, the property `name` of its
        vertices; CSV or text, a row per vertex, with a header the column `name`; GIFTI (.gii), the
        first array of one dimension; FreeSurfer's curvature files (``lh.curv``, ``lh.thickness``);
        each compressed by gzip too.
    name : str
        Of the field.
    n : int, optional
        Number of vertices in the file of the mesh.

    Returns
    -------
    float64 ndarray (n,)

    Raises
    ------
    ValueError
        When the file is missing, holds no such field, or has not `n` values.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from s4a.input.scalars import read_scalars
    >>> file = Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = file.write_text("vertex,thickness\\n0,2.5\\n1,3\\n")
    >>> read_scalars(file, "thickness").tolist()
    [2.5, 3.0]
    """
    file = Path(path)
    check_there(file)
    try:
        data = bounded.content(file)
        values = np.asarray(_values(data, file.name.lower().removesuffix(".gz"), name))
        if values.dtype.kind not in "iufb":
            raise ValueError(f"numbers expected, found {values.dtype}")
    except Exception as error:  # whatever the file holds, the message must name it
        raise ValueError(
            f"{shown(path)} cannot be read as a field: {shown(error) or type(error).__name__}"
        ) from error
    values = values.reshape(-1) if values.size == max(values.shape, default=0) else values
    if values.ndim != 1 or n not in (None, len(values)):
        wanted = "one number per vertex" if n is None else f"{n} numbers, one per vertex,"
        raise ValueError(f"{shown(path)}: {wanted} needed, found an array of shape {values.shape}")
    return values.astype(float)


def of_vertices(values: Any, mesh: xr.Dataset, what: str) -> np.ndarray:
    """A field ``(n,)`` on the vertices of a clean mesh, a number for each of these or of its file.

    ValueError where it is not numbers, has another length, is infinite or NaN everywhere; `what`
    names it.
    """
    values = np.asarray(values)
    if values.dtype.kind not in "iufb":
        raise ValueError(f"{what} needs numbers, found {values.dtype}")
    n = mesh.sizes["vertex"]
    in_file = mesh.sizes.get("file_vertex_index", n)
    if values.shape not in ((n,), (in_file,)):
        of_file = "" if n == in_file else f", or each of the {in_file} of its file"
        raise ValueError(
            f"{what} needs a number for each of the {n} vertices of its mesh{of_file}; found shape "
            f"{values.shape}"
        )
    if len(values) == in_file and "file_vertex" in mesh:
        values = values[mesh["file_vertex"].values]
    values = values.astype(float)
    if np.isinf(values).any():
        raise ValueError(
            f"{what} needs finite numbers, or NaN where there is none; {np.isinf(values).sum()} "
            "are infinite"
        )
    known = values[~np.isnan(values)]
    if not len(known):
        raise ValueError(f"{what} is NaN everywhere: leave it out")
    if len(known) < n:
        log.warning("%s is NaN at %d of %d vertices", what, n - len(known), n)
    if np.ptp(known) <= 1e-12 * abs(known).max():
        log.warning("%s is %.4g everywhere: is it the right file?", what, known[0])
    return values


def with_features(
    mesh: xr.Dataset, features: Mapping[str, Any], *, weight: float = 1.0
) -> xr.Dataset:
    """A mesh with fields that guide its registration, such as sulcal depth or curvature.

    Fields are paired by name.  Those that two shapes have are descriptors of first maps in far
    poses, and columns beside position (and normal) where nearest points are searched: in first maps
    after ICP and in the elastic rounds.  They are taken as the first K functions have them, and one
    standard deviation counts as much as 2 % of sqrt(area), times `weight`
    (:data:`s4a.method.shape.FIELD_WEIGHT`).

    Parameters
    ----------
    mesh : Dataset
        Clean, as of :func:`s4a.read_shape` or :func:`s4a.clean`.
    features : dict of str to array_like (vertex,) or path
        Name -> a number for each vertex of the mesh, or of its file; or a file of them
        (:func:`s4a.input.scalars.read_scalars`).  NaN counts as the mean.
    weight : float
        Of them all: more where they are to be believed and the surface says little, as on a round
        one.  All shapes need the same.

    Returns
    -------
    Dataset
        The mesh with ``feature_name(feature)``, ``feature_value(vertex, feature)`` and
        ``feature_weight(feature)``; others that it had are gone.

    Raises
    ------
    ValueError
        When there is none, a file cannot be read, a field does not fit the mesh, or the weight is
        not positive.

    Examples
    --------
    >>> import s4a
    >>> mesh = s4a.clean(s4a.synthetic.ellipsoid(200))
    >>> s4a.with_features(mesh, {"height": mesh["position"].values[:, 2]})["feature_value"].shape
    (200, 1)
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    if not features:
        raise ValueError("features needs a field at least, found none")
    if not (np.isfinite(weight) and weight > 0):
        raise ValueError(f"weight must be positive, found {weight!r}")
    values = [
        of_vertices(
            read_scalars(given, name) if isinstance(given, str | Path) else given,
            mesh,
            f"the feature {name!r}",
        )
        for name, given in features.items()
    ]
    found = dataset(
        feature_name=list(features),
        feature_value=np.stack(values, axis=1),
        feature_weight=np.full(len(values), float(weight)),
    )
    return mesh.drop_dims("feature", errors="ignore").merge(found)


def files_beside(path: Path | str, names: Iterable[str]) -> dict[str, Path]:
    """The files with fields of a mesh, by name: beside its file, or that itself.

    Of the field ``sulc`` of ``a.ply`` that is ``a.sulc`` or ``a.sulc.npy``, with any of
    :data:`SUFFIXES`; or ``a.ply`` where its vertices have a property ``sulc``.

    Raises
    ------
    ValueError
        When there are two of one name.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from s4a.input.scalars import files_beside
    >>> folder = Path(tempfile.mkdtemp())
    >>> np.save(folder / "a.sulc.npy", np.zeros(3))
    >>> [file.name for file in files_beside(folder / "a.ply", ["sulc", "curv"]).values()]
    ['a.sulc.npy']
    """
    mesh, found = Path(path), {}
    for name in names:
        endings = [end + packed for end in ("", *SUFFIXES) for packed in ("", ".gz")]
        there = [mesh.with_name(f"{stem_of(mesh)}.{name}{end}") for end in endings]
        there = [file for file in there if file.is_file()]
        if len(there) > 1:
            raise ValueError(
                f"one file with the field {name!r} of {shown(mesh)} needed: "
                f"{shown(there[0])} and {shown(there[1])}"
            )
        if there:
            found[name] = there[0]
        elif mesh.is_file() and name in _properties(mesh):
            found[name] = mesh
    return found


def _properties(path):
    """The names of what a PLY file has for its vertices; none of another file, or a broken one."""
    try:
        data = bounded.content(path)
        return ply_properties(data) if data[:3] == b"ply" else {}
    except (ValueError, OSError):  # its own task will say so
        return {}


def _values(data, file, name):
    """The numbers of a file, by what it begins with, or by its suffix."""
    if data.startswith(CURV):
        return _curv(data)
    if data[:3] == b"ply":
        return _named(ply_properties(data), name)
    if zipfile.is_zipfile(BytesIO(data)):
        arrays = bounded.npz(data)
        wanted = _one_of(arrays, name)
        return arrays[wanted]()
    if file.endswith(".npy"):
        return bounded.npy(data)
    if file.endswith(".gii"):
        found = [values for _, values in gifti_arrays(data) if values.ndim == 1]
        if not found:
            raise ValueError("a GIFTI array of one dimension expected, found none")
        return found[0]
    return _column(text_of(data), name)


def _curv(data):
    """FreeSurfer: counts of vertices, triangles and numbers per vertex, then the numbers."""
    if len(data) < 15:
        raise ValueError(f"15 bytes of a header expected, found {len(data)}")
    n, _, per_vertex = (int(count) for count in np.frombuffer(data, ">i4", 3, 3))
    if per_vertex != 1 or n < 0 or len(data) != 15 + 4 * n:
        raise ValueError(
            f"one number for each of {n} vertices expected, found {per_vertex} and "
            f"{len(data) - 15} bytes"
        )
    return np.frombuffer(data, ">f4", n, 15)


def _one_of(arrays, name):
    """The name of the array that is asked for, or of the only one."""
    if name in arrays:
        return name
    if len(arrays) == 1:
        return next(iter(arrays))
    raise ValueError(f"an array {name!r} expected, found {', '.join(arrays) or 'none'}")


def _named(columns, name):
    if name not in columns:
        raise ValueError(
            f"a property {name!r} of its vertices expected, found {', '.join(columns)}"
        )
    return columns[name]


def _column(text, name):
    """The column of that name, or the only one."""
    rows = table_rows(text)
    first = next(iter(rows.values()))
    order = None
    if len(first) == 1:
        at = 0
        if not is_number(first[0]):
            del rows[next(iter(rows))]
    elif name in first:
        at = first.index(name)
        del rows[next(iter(rows))]
        order = order_of_vertices([cell.lower() for cell in first], rows)
    else:
        raise ValueError(f"a column {name!r} expected, found {', '.join(first)[:80]}")
    check_cells(rows, len(first), 1 + at)
    values = np.array([number_of(row[at], line) for line, row in rows.items()])
    return values if order is None else values[order]
