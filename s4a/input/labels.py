"""Surfaces of label volumes (5.1, the data): segmented structures as meshes in millimetres.

The surface is extracted by marching cubes and smoothed without shrinking (Taubin, "A signal
processing approach to fair surface design", 1995).
"""

import io
import math
import os
import re
from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy import sparse

from s4a.geometry.mesh import directed_edges
from s4a.input.coordinates import AXES, UNKNOWN, XFORMS, CoordinateSystem, map_to_ras
from s4a.input.formats import PLY_TYPES
from s4a.input.raw import check_there, content, gunzip, reading
from s4a.options import MILLIMETRES, check_label
from s4a.schema import Array

VOLUMES = {".nii": "NIfTI", ".mgz": "MGH", ".mgh": "MGH", ".nrrd": "NRRD"}
Label = int | str | Iterable[int] | None
ITERATIONS = 20  # of smoothing
_UNPACKED = 2**29  # unpacked bytes that are always accepted: labels compress well
SHRINK, GROW = 0.5, -0.51  # steps of an iteration: lambda and mu of Taubin
_UNITS = {"unknown": "mm", "meter": "m", "micron": "um"}  # of NIfTI
_MOST_REPORTED = 30  # labels that an error lists
_ROUNDED = 1e-3  # largest distance of a label from a whole number


def volume_format(data: bytes) -> str:
    """Return the format of a volume, NIfTI, MGH or NRRD, by its first bytes; "" for other files."""
    if data[344:348] in (b"n+1\0", b"ni1\0") or data[4:8] in (b"n+2\0", b"ni2\0"):
        return "NIfTI"
    return "MGH" if data[:4] == b"\0\0\0\1" else "NRRD" if data[:4] == b"NRRD" else ""


def read_volume(
    path: str | os.PathLike[str], label: Label, *, iterations: int = ITERATIONS
) -> tuple[Array, Array, dict[str, str]]:
    """Extract the surface of a label in world coordinates.

    Parameters
    ----------
    path : str or Path
        NIfTI (.nii), FreeSurfer (.mgh, .mgz) or NRRD (.nrrd, .seg.nrrd), optionally as .gz:
        integers in three dimensions.  Values within 0.001 of integers are rounded.
    label : int, list of int, or "all"
        Several labels are merged, "all" means every voxel that is not 0.
    iterations : int
        Smoothing iterations; 0 keeps the steps of the voxels.

    Returns
    -------
    points : float64 ndarray (n, 3)
        In millimetres, RAS if the file has an orientation (:mod:`s4a.input.coordinates`).
    triangles : int32 ndarray (m, 3)
        Counter-clockwise seen from outside.
    attrs : dict of str
        ``format``, ``unit``, ``coordinate_system``, ``label``, and ``note`` if the volume has no
        orientation, its labels were rounded, or the surface was closed at its border.

    Raises
    ------
    ValueError
        If the file is not a label volume or has none of these labels; the message has the file and
        the labels found.
    """
    path = Path(path)
    check_there(path)
    checked = check_label(label)
    with reading(path, "a label volume"):
        values, affine, attrs = _volume(content(path, _UNPACKED))
        points, triangles, at_border = _boundary(_marked(values, checked))
    points = points @ affine[:3, :3].T + affine[:3, 3]
    if np.linalg.det(affine[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    closed = "the structure reaches the border of the volume, and was closed there"
    note = "; ".join(filter(None, [attrs.pop("note"), closed * at_border]))
    attrs |= {"label": str(checked)} | ({"note": note} if note else {})
    return smoothed(points, triangles, iterations), np.ascontiguousarray(triangles), attrs


def voxels_marked(path: str | os.PathLike[str], label: Label) -> tuple[Array, Array]:
    """Mask ``(x, y, z)`` of the voxels with a label, and the affine map to millimetres.

    See :func:`read_volume`.
    """
    values, affine, _ = _volume(content(Path(path), _UNPACKED))
    return _marked(values, check_label(label)), affine


def read_grid(path: str | os.PathLike[str]) -> tuple[tuple[int, ...], Array, CoordinateSystem]:
    """Read the shape of a volume, of labels or grey values, its affine map, and its system.

    Raises
    ------
    ValueError
        If the file is not a NIfTI, MGH or NRRD volume of three dimensions.
    """
    check_there(path)
    with reading(path, "a volume"):
        return grid_of(content(Path(path), _UNPACKED))


def grid_of(data: bytes) -> tuple[tuple[int, ...], Array, CoordinateSystem]:
    """Return shape, affine map and coordinate system of a volume; see :func:`read_grid`."""
    kind, name = _kind_of(data := _as_nifti(data))
    header = kind.header_class.from_fileobj(io.BytesIO(data))
    affine, is_oriented = _affine_of(header, name)
    raw = kind.header_class.from_fileobj(io.BytesIO(data), check=False)
    if name == "NIfTI" and not (raw["pixdim"][1:4].all() or raw["sform_code"]):
        raise ValueError("sizes of voxels needed, found 0 in pixdim: save the volume again")
    codes = [0, 2] if name == "MGH" else [int(header[f"{form}form_code"]) for form in "qs"]
    system = CoordinateSystem(unit="mm")
    if is_oriented:
        system = CoordinateSystem("RAS", XFORMS.get(codes[1] or codes[0], ""), "mm")
    if name == "MGH" and data[28:30] == b"\0\0":  # goodRASFlag: nibabel makes up directions
        system = replace(system, origin=UNKNOWN)
    return _shape_of(header), affine, system


def _volume(data):
    """Labels (x, y, z), affine map of indices to millimetres, and attributes."""
    found, data = volume_format(data), _as_nifti(data)
    kind, name = _kind_of(data)
    header = kind.header_class.from_fileobj(io.BytesIO(data))
    shape, affine, system = grid_of(data)
    needed = int(np.prod(shape, dtype=object)) * header.get_data_dtype().itemsize
    n_bytes = 284 if name == "MGH" else 352
    if needed + n_bytes > len(data):
        raise ValueError(f"{needed} bytes of voxels {shape} expected, found {len(data) - n_bytes}")
    values, rounded = _whole(np.asanyarray(kind.from_bytes(data).dataobj).reshape(shape))
    unknown = "the volume has no orientation, left and right may be exchanged" * (not system.axes)
    notes = filter(None, [unknown, _two_places(header) if name == "NIfTI" else "", rounded])
    return values, affine, {"format": found, "note": "; ".join(notes), **system.attrs}


def _two_places(header):
    """Note on a NIfTI header whose sform and qform differ, unless the sform is of a template."""
    sform, qform = header.get_sform(coded=True)[0], header.get_qform(coded=True)[0]
    if sform is None or qform is None or int(header["sform_code"]) > 2:
        return ""
    corners = np.array(list(product(*((0, n - 1) for n in header.get_data_shape()[:3]), [1])))
    apart = np.linalg.norm(corners @ (sform - qform).T, axis=1).max()
    if apart < min(header.get_zooms()[:3]) / 2:
        return ""
    return (
        f"sform and qform place the volume up to {apart:.3g} apart; the sform is used, other "
        "programs may use the qform"
    )


def _whole(values):
    """Labels as integers, and a note if they were rounded; ValueError for other values."""
    if values.dtype.kind in "iub":
        return values, ""
    if values.dtype.kind != "f":
        raise ValueError(f"integers expected, found {values.dtype}: this is not a label volume")
    with np.errstate(all="ignore"):
        labels = np.round(values)
        rest = np.abs(labels - values)
        if not ((rest <= _ROUNDED) & (np.abs(labels) < 2**53)).all():
            wrong = values[~(rest <= _ROUNDED)].ravel()[:1]
            raise ValueError(
                f"integers expected, found {wrong[0] if len(wrong) else values.max()}: this is not "
                "a label volume"
            )
    most = float(rest.max(initial=0))
    note = f"labels differed from integers by up to {most:.1g} and were rounded" if most else ""
    return labels.astype(np.int64), note


def _kind_of(data):
    """Class of nibabel for the first bytes of a file, and name of the format."""
    import nibabel

    name = volume_format(data)
    if not name:
        raise ValueError(
            f"NIfTI, MGH or NRRD expected, found {len(data)} bytes of an unknown format"
        )
    if name == "MGH":
        return nibabel.MGHImage, name
    return (nibabel.Nifti2Image if data[6:7] == b"2" else nibabel.Nifti1Image), name


def _as_nifti(data):
    """NIfTI file of an NRRD volume, as 3D Slicer writes segmentations; other data as they are."""
    import nibabel

    if volume_format(data) != "NRRD":
        return data
    end = re.search(rb"\r?\n\r?\n", data)
    head = data[: end.start() if end else len(data)].decode("latin-1")
    fields = dict(re.findall(r"^([\w ]+):[ \t]*(.*?)\s*$", head, re.M))
    missing = {"type", "sizes", "encoding"} - {*fields}
    skips = "data file|datafile|(byte|line) ?skip"  # voxels elsewhere
    if not end or missing or any(re.fullmatch(skips, n) and v != "0" for n, v in fields.items()):
        raise ValueError(
            "a header with type, sizes and encoding, and voxels in the same file, expected; save "
            "it as one .nrrd file"
        )
    kind = re.sub("^signed | int$|_t$", "", fields["type"]).replace("unsigned ", "u")
    sizes = [int(word) for word in fields["sizes"].split()]
    if kind not in PLY_TYPES or fields["encoding"] not in ("raw", "gzip", "gz") or len(sizes) != 3:
        raise ValueError(
            "numbers, the encoding raw or gzip, and three sizes expected, found "
            f"{fields['type']}, {fields['encoding']} and {fields['sizes']}: "
            "export a label map, without overlapping segments"
        )
    body = data[end.end() :]
    body = body if fields["encoding"] == "raw" else gunzip(io.BytesIO(body), _UNPACKED)
    dtype = np.dtype((">" if fields.get("endian", "").lower() == "big" else "<") + PLY_TYPES[kind])
    needed = math.prod(sizes) * dtype.itemsize
    if min(sizes) < 1 or needed > len(body):
        raise ValueError(f"{needed} bytes of voxels {sizes} expected, found {len(body)}")
    values = np.frombuffer(body, dtype, math.prod(sizes)).reshape(sizes, order="F")
    image = nibabel.Nifti1Image(values, None, dtype=values.dtype)
    image.header.set_xyzt_units("mm")
    found = re.findall(r"\(([^()]*)\)", fields.get("space directions", ""))
    units = {*re.findall('"(.*?)"', fields.get("space units") or fields.get("units") or '"mm"')}
    if len(units) != 1 or not units <= {*MILLIMETRES}:
        raise ValueError(f"one unit of {', '.join(MILLIMETRES)} expected, found {sorted(units)}")
    scale = MILLIMETRES[units.pop()]
    axes = scale * np.array([axis.split(",") for axis in found], float)
    words = fields.get("space", "").upper().split("-")  # left-posterior-superior, or LPS
    space = words[0] if len(words) == 1 else "".join(word[:1] for word in words)
    if space in AXES and axes.shape == (3, 3):
        origin = fields.get("space origin", "(0,0,0)").strip("()").split(",")
        to_space = np.vstack([np.c_[axes.T, scale * np.array(origin, float)], [0, 0, 0, 1]])
        to_ras = map_to_ras(CoordinateSystem(space), placed=False)
        image.set_sform(to_ras @ to_space, code="aligned")
    else:
        spacings = scale * np.array(fields.get("spacings", "1 1 1").split(), float)
        image.header.set_zooms(np.linalg.norm(axes, axis=1) if len(axes) else spacings)
    return image.to_bytes()


def _shape_of(header):
    """Sizes of the three dimensions; trailing dimensions of size 1 are dropped."""
    shape = tuple(int(n) for n in header.get_data_shape())
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(f"a volume of three dimensions expected, found {shape}")
    return shape


def _affine_of(header, name):
    """Map of indices to millimetres, and whether the header has an orientation."""
    affine = np.array(header.get_best_affine(), float)
    if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-12:
        raise ValueError("an invertible affine map to millimetres needed")
    if name == "MGH":
        return affine, True
    unit = header.get_xyzt_units()[0]
    affine[:3] *= MILLIMETRES[_UNITS.get(unit, unit)]
    return affine, int(header["sform_code"]) != 0 or int(header["qform_code"]) != 0


def _marked(values, label):
    """Mask of the voxels with the label."""
    labels = np.unique(values)
    labels = labels[labels != 0].tolist()
    if not labels:
        raise ValueError("a label expected, found 0 in every voxel")
    wanted = labels if label == "all" else [int(word) for word in str(label).split(",")]
    missing = [value for value in wanted if value not in labels]
    if missing:
        found = ", ".join(map(str, labels[:_MOST_REPORTED]))
        found += " ..." * (len(labels) > _MOST_REPORTED)
        raise ValueError(f"label {', '.join(map(str, missing))} expected, found {found}")
    return np.isin(values, wanted)


def _boundary(inside):
    """Points ``(n, 3)`` in voxel indices, triangles, and whether the border was reached.

    In right-handed axes, triangles are counter-clockwise seen from outside.
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


def smoothed(X: Array, T: Array, iterations: int = ITERATIONS) -> Array:
    """Smooth the points ``(n, 3)`` of a mesh by Taubin's method, which preserves the volume.

    Each step towards the mean of the neighbours is followed by a slightly larger step back.

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
