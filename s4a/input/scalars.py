"""Files of scalar fields (6.1, 6.2): a number per vertex, in the order of the file of the mesh."""

import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np

from s4a.input import bounded
from s4a.input.annotations import check_cells, is_number, number_of, table_rows
from s4a.input.formats import gifti_arrays, ply_properties
from s4a.input.raw import check_there, shown, text_of

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
    if len(first) == 1:
        at = 0
        if not is_number(first[0]):
            del rows[next(iter(rows))]
    elif name in first:
        at = first.index(name)
        del rows[next(iter(rows))]
    else:
        raise ValueError(f"a column {name!r} expected, found {', '.join(first)[:80]}")
    check_cells(rows, len(first), 1 + at)
    return np.array([number_of(row[at], line) for line, row in rows.items()])
