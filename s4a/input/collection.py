"""A collection of shapes.

Every file read and cleaned, and a report of what was found (4.1, the input).
"""

import os
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_dataset
from s4a.input import plausibility
from s4a.input.clean import REPAIRS, check_components, clean
from s4a.input.files import find_meshes, not_meshes, read_mesh, slug
from s4a.schema import check_switch, check_text, dataset, in_unit

COUNTS = (
    *REPAIRS,
    "file_vertices",
    "file_triangles",
    "components",
    "holes",
    "genus",
    "self_intersections",
)
TEXTS = ("status", "reason", "warning", "path")


def read_shape(path, *, components="largest", strict=False, close_holes=False):
    """One mesh file, cleaned.

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
        mesh.attrs["reason"] = "; ".join(
            filter(None, [mesh.attrs.pop("note"), mesh.attrs["reason"]])
        )
    return in_unit(mesh, mesh.attrs.get("unit"))


def read_shapes(
    paths,
    *,
    components="largest",
    strict=False,
    close_holes=False,
    pattern=None,
    compare=True,
    intersections=True,
):
    """A collection of shapes, cleaned, and a report.

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
    meshes, attrs = {}, {}
    for name, source in _sources(paths, pattern).items():
        try:
            meshes[name] = _cleaned(
                source, components=components, strict=strict, close_holes=close_holes
            )
            attrs[name] = meshes[name].attrs
        except ValueError as error:
            path = str(source) if isinstance(source, Path) else ""
            attrs[name] = {"status": "excluded", "reason": str(error), "path": path}
    if not meshes:
        reasons = "; ".join(f"{name}: {given['reason']}" for name, given in attrs.items())
        raise ValueError(f"none of {len(attrs)} shapes can be used ({reasons})")
    looks, remarks = {}, passed_over(paths, pattern)
    if compare and len(meshes) > 1:
        reference = plausibility.sample(
            meshes[plausibility.median_size({n: m.attrs["area"] for n, m in meshes.items()})]
        )
        looks = {
            name: plausibility.look(mesh, reference, intersections) for name, mesh in meshes.items()
        }
    nodes = {f"/original/{name}": mesh for name, mesh in meshes.items()}
    return xr.DataTree.from_dict({**nodes, "/report": shape_report(attrs, looks, remarks)})


def passed_over(paths, pattern=None):
    """The files among `paths` that are no meshes, in words."""
    if isinstance(paths, dict | xr.DataTree):
        return []
    return [
        f"{file} is not a mesh ({why}) and was passed over"
        for file, why in not_meshes(paths, pattern)
    ]


def shape_report(attrs, looks=None, remarks=(), doubts=None):
    """The report on shapes from the attributes of each.

    A dict of name to ``status``, ``reason``, ``path``, counts.

    Counts are -1 where a shape was excluded.  `looks` are of :func:`s4a.input.plausibility.look`;
    `remarks` are kept as they are, with those on the collection; `doubts` are further warnings, a
    dict of name to str.
    """
    used = {name: given for name, given in attrs.items() if given["status"] != "excluded"}
    warning, of_all = plausibility.warnings(used, looks or {})
    counted = {
        n: {"self_intersections": look["self_intersections"]} for n, look in (looks or {}).items()
    }
    said = {n: "; ".join(filter(None, [warning.get(n), (doubts or {}).get(n)])) for n in attrs}
    attrs = {n: given | counted.get(n, {}) | {"warning": said[n]} for n, given in attrs.items()}
    columns = {name: [str(given.get(name, "")) for given in attrs.values()] for name in TEXTS}
    columns |= {
        name: np.array([given.get(name, -1) for given in attrs.values()], np.int64)
        for name in COUNTS
    }
    for name in ("area", "area_dropped"):
        columns[name] = [float(given.get(name, np.nan)) for given in attrs.values()]
    return dataset({"remarks": "\n".join([*remarks, *of_all])}, **columns).assign_coords(
        shape=list(attrs)
    )


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
        raise ValueError(
            f"points (n, 3) and triangles (m, 3) needed, found {points.shape} and {triangles.shape}"
        )
    return clean(as_dataset(points, triangles), **options)
