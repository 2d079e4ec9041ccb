"""A collection of shapes: every file read and cleaned, and a report of what was found (4.1, the input)."""

import os
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.clean import REPAIRS, clean
from s4a.io import find_meshes, read_mesh, slug
from s4a.mesh import as_dataset
from s4a.schema import dataset, in_unit

COUNTS = (*REPAIRS, "file_vertices", "file_triangles", "components", "holes", "genus")


def read_shape(path, *, components="largest", strict=False):
    """One mesh file, cleaned.

    Parameters
    ----------
    path : str or Path
        See :func:`s4a.io.read_mesh` for the formats.
    components, strict
        See :func:`s4a.clean.clean`.

    Returns
    -------
    Dataset
        As :func:`s4a.clean.clean` gives it; in the attributes also ``path``, ``format`` and, where the file says so,
        ``coordinate_system`` and ``unit``.

    Raises
    ------
    ValueError
        When the file cannot be read or cleaned.
    """
    points, triangles, attrs = read_mesh(path)
    name = os.fsencode(Path(path)).decode("utf-8", "replace")
    try:
        mesh = clean(as_dataset(points, triangles, {"path": name, **attrs}), components=components, strict=strict)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if "note" in attrs:
        mesh.attrs["reason"] = "; ".join(filter(None, [mesh.attrs.pop("note"), mesh.attrs["reason"]]))
    return in_unit(mesh, mesh.attrs.get("unit"))


def read_shapes(paths, *, components="largest", strict=False, pattern=None):
    """A collection of shapes, cleaned, and a report.

    Parameters
    ----------
    paths : str, Path, list of these, or dict
        A folder, a glob, a file or several of these, see :func:`s4a.io.find_meshes`; or shapes in memory as a dict of
        name to ``(points, triangles)`` or to a mesh Dataset.
    components, strict
        See :func:`s4a.clean.clean`.
    pattern : str, optional
        Of the files found, those whose name it matches, such as ``"*_brain"``.

    Returns
    -------
    DataTree
        ``/original/<shape>`` for every shape that could be used, and ``/report`` over all shapes with ``status`` (ok,
        repaired or excluded), ``reason``, ``path`` and counts.

    Raises
    ------
    ValueError
        When no shape can be used; the message has every reason.

    Examples
    --------
    >>> points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> triangles = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    >>> shapes = read_shapes({"good": (points, triangles), "bad": (points, [[0, 1, 9]])})
    >>> list(shapes["original"]), shapes["report"]["status"].values.tolist()
    (['good'], ['excluded', 'ok'])
    """
    meshes, attrs = {}, {}
    for name, source in _sources(paths, pattern).items():
        try:
            meshes[name] = _cleaned(source, components=components, strict=strict)
            attrs[name] = meshes[name].attrs
        except ValueError as error:
            path = str(source) if isinstance(source, Path) else ""
            attrs[name] = {"status": "excluded", "reason": str(error), "path": path}
    if not meshes:
        reasons = "; ".join(f"{name}: {given['reason']}" for name, given in attrs.items())
        raise ValueError(f"none of {len(attrs)} shapes can be used ({reasons})")
    nodes = {f"/original/{name}": mesh for name, mesh in meshes.items()}
    return xr.DataTree.from_dict({**nodes, "/report": shape_report(attrs)})


def shape_report(attrs):
    """The report on shapes from the attributes of each: a dict of name to ``status``, ``reason``, ``path``, counts.

    Counts are -1 where a shape was excluded.
    """
    columns = {name: [str(given.get(name, "")) for given in attrs.values()] for name in ("status", "reason", "path")}
    columns |= {name: np.array([given.get(name, -1) for given in attrs.values()], np.int64) for name in COUNTS}
    columns["area_dropped"] = [float(given.get("area_dropped", np.nan)) for given in attrs.values()]
    return dataset(**columns).assign_coords(shape=list(attrs))


def _sources(paths, pattern):
    """Name to path, arrays or Dataset, in the order of the names."""
    if not isinstance(paths, dict):
        return dict(sorted((name, path) for path, name in find_meshes(paths, pattern)))
    wrong = [name for name in paths if not isinstance(name, str) or slug(name) != name]
    if wrong or not paths:
        raise ValueError(f"shapes need names of letters, digits, _ and -, found {wrong or 'none'}")
    return dict(sorted(paths.items()))


def _cleaned(source, **options):
    if isinstance(source, Path):
        return read_shape(source, **options)
    if isinstance(source, xr.Dataset):
        return in_unit(clean(source, **options), source.attrs.get("unit"))
    points, triangles = (np.asarray(values) for values in source)
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"triangles need integer vertex indices; found {triangles.dtype}")
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"points (n, 3) and triangles (m, 3) needed, found {points.shape} and {triangles.shape}")
    return clean(as_dataset(points, triangles), **options)
