"""A collection of shapes (5.1, the data): every file read and cleaned, and a report on all."""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_dataset
from s4a.input import plausibility
from s4a.input.clean import REPAIRS, check_components, clean
from s4a.input.files import Paths, find_meshes, not_meshes, read_mesh, slug
from s4a.schema import check_switch, check_text, dataset, in_unit

# columns of the report
COUNTS = [
    *REPAIRS,
    *"file_vertices file_triangles components holes genus self_intersections".split(),
]
TEXTS = ("status", "reason", "warning", "path")
AREAS = ("area", "area_dropped")


def read_shape(
    path: str | os.PathLike,
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
) -> xr.Dataset:
    """Read one mesh file and clean it.

    Parameters
    ----------
    path : str or Path
        See :func:`s4a.input.files.read_mesh` for the formats.
    components, strict, close_holes
        See :func:`s4a.input.clean.clean`.

    Returns
    -------
    Dataset
        As :func:`s4a.input.clean.clean` gives it; in the attributes also ``path``, ``format`` and,
        where the file says so, ``coordinate_system`` and ``unit``.

    Raises
    ------
    ValueError
        When the file cannot be read or cleaned.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import s4a
    >>> from s4a.geometry.mesh import as_arrays
    >>> folder = Path(tempfile.mkdtemp())
    >>> written = s4a.write_mesh(folder / "ball.ply", *as_arrays(s4a.synthetic.sphere(100)))
    >>> s4a.read_shape(folder / "ball.ply").sizes["vertex"]
    100
    """
    points, triangles, attrs = read_mesh(path)
    name = os.fsencode(Path(path)).decode("utf-8", "replace")
    try:
        mesh = as_dataset(points, triangles, {"path": name, **attrs})
        mesh = clean(mesh, components=components, strict=strict, close_holes=close_holes)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if "note" in attrs:
        reasons = [mesh.attrs.pop("note"), mesh.attrs["reason"]]
        mesh.attrs["reason"] = "; ".join(filter(None, reasons))
    return in_unit(mesh, mesh.attrs.get("unit"))


def read_shapes(
    paths: Paths | dict,
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
    pattern: str | None = None,
    compare: bool = True,
    intersections: bool = True,
) -> xr.DataTree:
    """Read a collection of shapes, clean each, and report on all.

    Parameters
    ----------
    paths : str, Path, list of these, or dict
        A folder, a glob, a file or several of these, see :func:`s4a.input.files.find_meshes`; or
        shapes in memory as a dict of name to ``(points, triangles)`` or to a mesh Dataset.
    components, strict, close_holes
        See :func:`s4a.input.clean.clean`.
    pattern : str, optional
        Of the files found, those whose name it matches, such as ``"*_brain"``.
    compare : bool
        Whether each shape is compared with the others: unit, handedness, pose, genus
        (:mod:`s4a.input.plausibility`).
    intersections : bool
        Whether triangles that pass through others are counted then.

    Returns
    -------
    DataTree
        ``/original/<shape>`` for every shape that could be used, and ``/report`` over all shapes
        with ``status`` (ok, repaired or excluded), ``reason`` (what was found and done),
        ``warning`` (what looks wrong and was left as it is), ``path`` and counts; the attribute
        ``remarks`` has what concerns several shapes or none, one a line.

    Raises
    ------
    ValueError
        When an option is out of range, or no shape can be used; the message has every reason.

    Examples
    --------
    >>> import s4a
    >>> points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> triangles = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    >>> shapes = s4a.read_shapes({"good": (points, triangles), "bad": (points, [[0, 1, 9]])})
    >>> list(shapes["original"]), shapes["report"]["status"].values.tolist()
    (['good'], ['excluded', 'ok'])
    """
    check_components(components)
    check_switch("strict", strict)
    check_switch("close_holes", close_holes)
    check_text("pattern", pattern)
    options = {"components": components, "strict": strict, "close_holes": close_holes}
    meshes, attrs = {}, {}
    for name, source in _sources(paths, pattern).items():
        try:
            meshes[name] = _cleaned(source, **options)
            attrs[name] = meshes[name].attrs
        except ValueError as error:
            path = str(source) if isinstance(source, Path) else ""
            attrs[name] = {"status": "excluded", "reason": str(error), "path": path}
    if not meshes:
        reasons = "; ".join(f"{name}: {said['reason']}" for name, said in attrs.items())
        raise ValueError(f"none of {len(attrs)} shapes can be used ({reasons})")
    evidence = {}
    if compare and len(meshes) > 1:
        areas = {name: mesh.attrs["area"] for name, mesh in meshes.items()}
        reference = plausibility.sample_vertices(meshes[plausibility.median_size(areas)])
        for name, mesh in meshes.items():
            evidence[name] = plausibility.examine(mesh, reference, intersections)
    nodes = {f"/original/{name}": mesh for name, mesh in meshes.items()}
    nodes["/report"] = shape_report(attrs, evidence, passed_over(paths, pattern))
    return xr.DataTree.from_dict(nodes)


def passed_over(paths: Paths | dict | xr.DataTree, pattern: str | None = None) -> list[str]:
    """The files among `paths` that are no meshes, in words."""
    if isinstance(paths, dict | xr.DataTree):
        return []
    return [
        f"{file} is not a mesh ({why}) and was passed over"
        for file, why in not_meshes(paths, pattern)
    ]


def shape_report(
    attrs: dict[str, dict],
    evidence: dict[str, dict] | None = None,
    remarks: Iterable[str] = (),
    doubts: dict[str, str] | None = None,
) -> xr.Dataset:
    """Make the report on the shapes of a collection.

    Parameters
    ----------
    attrs : dict
        Name of each shape -> ``status``, ``reason``, ``path`` and counts; where one was excluded,
        counts are -1 in the report.
    evidence : dict, optional
        Name -> :func:`s4a.input.plausibility.examine`.
    remarks : list of str
        Kept as they are, before those on the collection.
    doubts : dict of str to str, optional
        Further warnings.
    """
    evidence, doubts = evidence or {}, doubts or {}
    used = {name: said for name, said in attrs.items() if said["status"] != "excluded"}
    warnings, of_all = plausibility.find_warnings(used, evidence)
    rows = []
    for name, said in attrs.items():
        parts = [warnings.get(name), doubts.get(name)]
        rows.append({**said, "warning": "; ".join(filter(None, parts))})
        if name in evidence:
            rows[-1]["self_intersections"] = evidence[name]["self_intersections"]
    columns: dict[str, list | np.ndarray] = {
        key: [str(row.get(key, "")) for row in rows] for key in TEXTS
    }
    columns |= {key: np.array([row.get(key, -1) for row in rows], np.int64) for key in COUNTS}
    columns |= {key: [float(row.get(key, np.nan)) for row in rows] for key in AREAS}
    report = dataset({"remarks": "\n".join([*remarks, *of_all])}, **columns)
    return report.assign_coords(shape=list(attrs))


def _sources(paths, pattern):
    """Name to path, arrays or Dataset, in the order of the names."""
    if not isinstance(paths, dict):
        return dict(sorted((name, path) for path, name in find_meshes(paths, pattern)))
    wrong = [name for name in paths if not isinstance(name, str) or slug(name) != name]
    if wrong or not paths:
        raise ValueError(f"shapes need names of letters, digits, _ and -, found {wrong or 'none'}")
    return dict(sorted(paths.items()))


def _cleaned(source, **options):
    """A file, a Dataset or a pair of arrays, cleaned."""
    if isinstance(source, Path):
        return read_shape(source, **options)
    if isinstance(source, xr.Dataset):
        return in_unit(clean(source, **options), source.attrs.get("unit"))
    points, triangles = (np.asarray(values) for values in source)
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"triangles need integer vertex indices; found {triangles.dtype}")
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(
            f"points (n, 3) and triangles (m, 3) needed, found {points.shape} and {triangles.shape}"
        )
    return clean(as_dataset(points, triangles), **options)
