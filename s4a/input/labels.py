"""Surfaces from label volumes (5.1, the data): what a segmentation marks, as a mesh in millimetres.

Between the voxels inside and those outside lies a surface (marching cubes), whose steps of one
voxel are smoothed without shrinking it (Taubin, "A signal processing approach to fair surface
design", 1995).
"""

import io
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy import sparse

from s4a.geometry.mesh import directed_edges
from s4a.input.raw import check_there, content, reading
from s4a.options import check_label

VOLUMES = {".nii": "NIfTI", ".mgz": "MGH", ".mgh": "MGH"}
Label = int | str | Iterable[int] | None
ITERATIONS = 20  # of smoothing
_UNPACKED = 2**29  # bytes of a volume that are never refused: labels compress well
SHRINK, GROW = 0.5, -0.51  # steps of a round: lambda and mu of Taubin
MILLIMETRES = {"mm": 1.0, "unknown": 1.0, "meter": 1000.0, "micron": 0.001}
_MOST_REPORTED = 30  # labels that an error lists


def is_volume(data: bytes) -> bool:
    """Whether the first bytes of a file are those of a NIfTI or MGH volume."""
    return data[344:348] in (b"n+1\0", b"ni1\0") or data[:4] == b"\0\0\0\1"


def read_volume(
    path: str | os.PathLike[str], label: Label, *, iterations: int = ITERATIONS
) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """The surface of what a label volume marks, in its world coordinates.

    Parameters
    ----------
    path : str or Path
        NIfTI (.nii) or FreeSurfer (.mgh, .mgz), each also as .gz: whole numbers in three
        dimensions.
    label : int, several, or "all"
        Several are one structure, "all" is whatever is not 0.
    iterations : int
        Of smoothing; 0 leaves the steps of the voxels.

    Returns
    -------
    points : float64 ndarray (n, 3)
        In millimetres: to the right, to the front and up (RAS), where the file says how it lies.
    triangles : int32 ndarray (m, 3)
        Counter-clockwise seen from outside.
    attrs : dict of str
        ``format``, ``unit``, ``coordinate_system``, ``label``, and ``note`` when the volume does
        not say how it lies, or what is marked reaches its border, where it is closed.

    Raises
    ------
    ValueError
        When the file is no such volume, or marks nothing with one of these labels; the message has
        the file, and the labels that are there.
    """
    path = Path(path)
    check_there(path)
    known = check_label(label)
    with reading(path, "a label volume"):
        values, affine, attrs = _volume(content(path, _UNPACKED))
        points, triangles, at_border = _boundary(_marked(values, known))
    points = points @ affine[:3, :3].T + affine[:3, 3]
    if np.linalg.det(affine[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    attrs |= {"label": str(known), "unit": "mm"}
    if at_border:
        closed = "what is marked reaches the border of the volume, where it was closed"
        attrs["note"] = "; ".join(filter(None, [attrs.get("note"), closed]))
    return smoothed(points, triangles, iterations), np.ascontiguousarray(triangles), attrs


def voxels_marked(path: str | os.PathLike[str], label: Label) -> tuple[np.ndarray, np.ndarray]:
    """Which voxels ``(x, y, z)`` of a volume have a label, and its affine map to millimetres.

    See :func:`read_volume`.
    """
    values, affine, _ = _volume(content(Path(path), _UNPACKED))
    return _marked(values, check_label(label)), affine


def read_grid(path: str | os.PathLike[str]) -> tuple[tuple[int, ...], np.ndarray]:
    """The shape of a volume and its affine map to millimetres, RAS; of grey values too.

    Raises
    ------
    ValueError
        When the file is no NIfTI or MGH volume of three dimensions.
    """
    check_there(path)
    with reading(path, "a volume"):
        kind, name = _kind_of(data := content(Path(path), _UNPACKED))
        header = kind.header_class.from_fileobj(io.BytesIO(data))
        return _shape_of(header), _affine_of(header, name)[0]


def _volume(data):
    """Whole numbers (x, y, z), the affine map of their indices to millimetres, and attributes."""
    kind, name = _kind_of(data)
    header = kind.header_class.from_fileobj(io.BytesIO(data))
    shape = _shape_of(header)
    needed = int(np.prod(shape, dtype=object)) * header.get_data_dtype().itemsize
    n_bytes = 284 if name == "MGH" else 352
    if needed + n_bytes > len(data):
        raise ValueError(f"{needed} bytes of voxels {shape} expected, found {len(data) - n_bytes}")
    values = np.asanyarray(kind.from_bytes(data).dataobj).reshape(shape)
    if values.dtype.kind not in "iub":
        if values.dtype.kind != "f" or not np.array_equal(values, np.round(values)):
            raise ValueError("whole numbers expected, one a structure: this is no label volume")
        values = values.astype(np.int64)
    affine, says = _affine_of(header, name)
    note = "the volume does not say how it lies, left and right may be exchanged"
    return (
        values,
        affine,
        {"format": name} | ({"coordinate_system": "RAS"} if says else {"note": note}),
    )


def _kind_of(data):
    """The class of nibabel's for the first bytes of a file, and the name of the format."""
    import nibabel

    if data[:4] == b"\0\0\0\1":
        return nibabel.MGHImage, "MGH"
    if is_volume(data):
        return nibabel.Nifti1Image, "NIfTI"
    raise ValueError(f"NIfTI or MGH expected, found {len(data)} bytes of something else")


def _shape_of(header):
    """Three dimensions; ones at the end are none."""
    shape = tuple(int(n) for n in header.get_data_shape())
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(f"a volume of three dimensions expected, found {shape}")
    return shape


def _affine_of(header, name):
    """The map of indices to millimetres, and whether the header says how the volume lies."""
    affine = np.array(header.get_best_affine(), float)
    if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-12:
        raise ValueError("its affine map to millimetres cannot be inverted")
    if name == "MGH":
        return affine, True
    affine[:3] *= MILLIMETRES[header.get_xyzt_units()[0]]
    return affine, int(header["sform_code"]) != 0 or int(header["qform_code"]) != 0


def _marked(values, label):
    """Which voxels are inside."""
    found = np.unique(values)
    found = found[found != 0].tolist()
    if not found:
        raise ValueError("every voxel is 0: nothing is marked")
    wanted = found if label == "all" else [int(one) for one in str(label).split(",")]
    missing = [one for one in wanted if one not in found]
    if missing:
        there = ", ".join(map(str, found[:_MOST_REPORTED])) + " ..." * (len(found) > _MOST_REPORTED)
        raise ValueError(f"label {', '.join(map(str, missing))} expected, found {there}")
    return np.isin(values, wanted)


def _boundary(inside):
    """Points (n, 3) in indices of voxels, triangles, and whether the volume's border was reached.

    Seen from outside the triangles are counter-clockwise where the axes are right-handed.
    """
    from skimage.measure import marching_cubes

    spans = []
    for axis in range(3):
        used = np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {axis})))
        spans.append(slice(used[0], used[-1] + 1))
    limits = zip(spans, inside.shape, strict=True)
    at_border = any(span.start == 0 or span.stop == n for span, n in limits)
    box = np.pad(inside[tuple(spans)], 1)
    points, triangles, _, _ = marching_cubes(
        box.astype(np.float32), 0.5, gradient_direction="ascent"
    )
    origin = np.array([span.start - 1 for span in spans])
    return points.astype(float) + origin, triangles.astype(np.int32), at_border


def smoothed(X: np.ndarray, T: np.ndarray, iterations: int = ITERATIONS) -> np.ndarray:
    """Points ``(n, 3)`` of a mesh after iterations of Taubin's smoothing, which keeps its volume.

    A step goes towards the mean of the neighbours, the next a little farther back.

    Examples
    --------
    >>> import s4a
    >>> from s4a.geometry.mesh import as_arrays
    >>> from s4a.input.labels import smoothed
    >>> X, T = as_arrays(s4a.synthetic.sphere(1000))
    >>> round(float((smoothed(X, T) ** 2).sum(1).mean()), 2)
    1.0
    """
    a, b = directed_edges(T).T
    n = len(X)
    W = sparse.csr_array((np.ones(len(a)), (a, b)), (n, n))
    W = ((W + W.T) > 0).astype(float)
    W = sparse.diags_array(1 / np.maximum(W.sum(1), 1)) @ W  # (n, n): the mean of the neighbours
    for _ in range(iterations):
        for step in (SHRINK, GROW):
            X = X + step * (W @ X - X)
    return X
