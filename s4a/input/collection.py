"""A collection of shapes (5.1, the data): every file read and cleaned, and a report on all."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_dataset
from s4a.input import plausibility
from s4a.input.clean import REPAIRS, check_arrays, clean
from s4a.input.files import (
    LONGEST_NAME,
    Paths,
    check_names,
    find_meshes,
    not_meshes,
    read_mesh,
    was_cut,
)
from s4a.input.labels import Label, read_volume
from s4a.input.plausibility import examine
from s4a.input.raw import shown
from s4a.options import check, check_label
from s4a.schema import check_type, dataset, in_unit, require

# columns of the report
COUNTS = [
    *REPAIRS,
    *"file_vertices file_triangles components holes genus self_intersections".split(),
]
TEXTS = ("status", "reason", "warning", "flag_kinds", "warning_kinds", "path")
Mesh = Path | str | xr.Dataset  # a file, or a clean mesh
_AREAS = ("area", "area_dropped")


def read_shape(
    path: str | os.PathLike[str],
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
    label: Label = None,
) -> xr.Dataset:
    """Read one mesh file and clean it.

    Parameters
    ----------
    path : str or Path
        See :func:`s4a.input.files.read_mesh` for the formats.
    components, strict, close_holes
        See :func:`s4a.input.clean.clean`.
    label : int, several, or "all", optional
        The file is a label volume, and the mesh the surface of what bears this label, see
        :func:`s4a.input.labels.read_volume`.

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
    points, triangles, attrs = read_mesh(path) if label is None else read_volume(path, label)
    name = os.fsencode(Path(path)).decode("utf-8", "replace")
    try:
        mesh = as_dataset(points, triangles, {"path": name, **attrs})
        mesh = clean(mesh, components=components, strict=strict, close_holes=close_holes)
    except ValueError as error:
        raise ValueError(f"{shown(path)}: {error}") from error
    if "note" in attrs:
        reasons = [mesh.attrs.pop("note"), mesh.attrs["reason"]]
        mesh.attrs["reason"] = "; ".join(filter(None, reasons))
    return in_unit(mesh, mesh.attrs.get("unit"))


def as_mesh(shape: Mesh, what: str = "mesh") -> xr.Dataset:
    """Return a mesh that is given as a Dataset, or read and clean its file if a path is given."""
    if isinstance(shape, str | os.PathLike):
        return read_shape(shape)
    expected = "a path or a Dataset, such as s4a.read_shape returns"
    check_type(shape, xr.Dataset | xr.DataTree, what, expected)
    require(shape, "position", "corner_vertex", what=what)
    return shape


def read_shapes(
    paths: Paths | dict[str, Any],
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
    pattern: str | None = None,
    label: Label = None,
    compare: bool = True,
    intersections: bool = True,
) -> xr.DataTree:
    """Read a collection of shapes, clean each, and report on all.

    Parameters
    ----------
    paths : str, Path, list of these, or dict
        A folder, a glob, a file or several of these, see :func:`s4a.input.files.find_meshes`; or
        a dict of name to a file, ``(points, triangles)`` or a mesh Dataset.
    components, strict, close_holes
        See :func:`s4a.input.clean.clean`.
    pattern : str, optional
        Of the files found, those whose name it matches, such as ``"*_brain"``.
    label : int, several, or "all", optional
        The files are label volumes, see :func:`read_labels`.
    compare : bool
        Whether each shape is compared with the others: unit, mean_chirality, pose, genus
        (:mod:`s4a.input.plausibility`).
    intersections : bool
        Whether triangles that pass through others are counted then.

    Returns
    -------
    DataTree
        ``/original/<shape>`` for every shape that could be used, and ``/report`` over all shapes
        with ``status`` (ok, repaired, flagged or excluded), ``reason`` (what was found and done),
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
    given = {"components": components, "strict": strict, "close_holes": close_holes}
    for name, value in {**given, "pattern": pattern}.items():
        check(name, value)
    options = {"components": components, "strict": strict, "close_holes": close_holes}
    label = check_label(label)
    volumes = label is not None
    meshes, attrs = {}, {}
    for name, source in _sources(paths, pattern, volumes).items():
        try:
            meshes[name] = _cleaned(source, label, **options)
            attrs[name] = meshes[name].attrs
        except ValueError as error:
            path = str(source) if isinstance(source, str | Path) else ""
            attrs[name] = {"status": "excluded", "reason": str(error), "path": path}
    if not meshes:
        reasons = "; ".join(f"{name}: {said['reason']}" for name, said in attrs.items())
        raise ValueError(f"none of {len(attrs)} shapes can be used ({reasons})")
    evidence = {}
    if compare and len(meshes) > 1:
        evidence = examine(meshes, intersections=intersections)
    used = {name: said for name, said in attrs.items() if said["status"] != "excluded"}
    flags, remarks = plausibility.find_warnings(used, evidence)
    nodes = {f"/original/{name}": mesh for name, mesh in meshes.items()}
    remarks = [*remarks, *remarks_on_files(paths, pattern, volumes=volumes)]
    nodes["/report"] = shape_report(attrs, flags, remarks, evidence)
    return xr.DataTree.from_dict(nodes)


def read_labels(paths: Paths, *, label: Label = "all", **options: Any) -> xr.DataTree:
    """Surfaces of one structure of every label volume, as a segmentation marks it, cleaned.

    Marching cubes between the voxels inside and those outside, smoothed without shrinking (Taubin),
    in world coordinates: millimetres, RAS.

    Parameters
    ----------
    paths : str, Path or list of these
        Folders, globs or files: NIfTI (.nii) or FreeSurfer (.mgh, .mgz), each also as .gz.
    label : int, str or list of int
        The structure; several (``[1, 2]`` or ``"1,2"``) are one, ``"all"`` is whatever is not 0.
    **options
        Of :func:`read_shapes`.

    Returns
    -------
    DataTree
        As of :func:`read_shapes`.  The report says of each volume where a label reached its border
        and was closed there, and how many components were found and dropped.

    Raises
    ------
    ValueError
        When scikit-image is not installed or no volume has the label; the message has every
        reason, and the labels that were found.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import nibabel
    >>> import numpy as np
    >>> import s4a
    >>> folder = Path(tempfile.mkdtemp())
    >>> far = np.linalg.norm(np.indices((24, 24, 24)).T - 11.5, axis=-1)
    >>> ball = nibabel.Nifti1Image(17 * (far < 10).astype(np.uint8), np.diag([2, 2, 2, 1.0]))
    >>> ball.to_filename(folder / "ball.nii.gz")
    >>> shapes = s4a.read_labels(folder, label=17)
    >>> X = shapes["original/ball"]["position"].values
    >>> (np.ptp(X, axis=0).round() == 40).all(), shapes["original/ball"].attrs["unit"]
    (np.True_, 'mm')
    """
    if label is None:
        raise ValueError("label needs a number other than 0, several (1,2) or 'all'; found None")
    return read_shapes(paths, label=label, **options)


def remarks_on_files(
    paths: Paths | dict[str, Any] | xr.DataTree,
    pattern: str | None = None,
    *,
    volumes: bool = False,
) -> list[str]:
    """In words: the files among `paths` that are no meshes, and those whose names are too long."""
    if isinstance(paths, dict | xr.DataTree):
        return []
    what = "label volume" if volumes else "mesh"
    return [
        f"{shown(file)} is not a {what} ({why}) and was passed over"
        for file, why in not_meshes(paths, pattern, volumes=volumes)
    ] + [
        f"{shown(file)} is called {name}: names of shapes have at most {LONGEST_NAME} letters"
        for file, name in find_meshes(paths, pattern, volumes=volumes)
        if was_cut(file, name)
    ]


def shape_report(
    attrs: dict[str, dict[str, Any]],
    flags: plausibility.Flags | None = None,
    remarks: Iterable[str] = (),
    evidence: dict[str, xr.Dataset] | None = None,
) -> xr.Dataset:
    """Make the report on the shapes of a collection.

    Parameters
    ----------
    attrs : dict
        Name of each shape -> ``status``, ``reason``, ``path`` and counts; where one was excluded,
        counts are -1 in the report.
    flags : dict of str to list of Doubt, optional
        What looks wrong, as of :func:`s4a.input.plausibility.find_warnings`; a shape that is not
        excluded is flagged where one of them says so.
    remarks : list of str
        On the collection, the most important first.
    evidence : dict, optional
        Name -> :func:`s4a.input.plausibility.compare`, whose counts are columns.
    """
    evidence, flags = evidence or {}, flags or {}
    rows = []
    for name, said in attrs.items():
        of_shape = [] if said["status"] == "excluded" else flags.get(name, [])
        rows.append({**said, **_flag_columns(of_shape)})
        if name in evidence:
            rows[-1]["self_intersections"] = evidence[name].attrs["self_intersections"]
    columns: dict[str, list[Any] | np.ndarray] = {
        key: [shown(row.get(key, "")) for row in rows] for key in TEXTS
    }
    columns |= {key: np.array([row.get(key, -1) for row in rows], np.int64) for key in COUNTS}
    columns |= {key: [float(row.get(key, np.nan)) for row in rows] for key in _AREAS}
    report = dataset({"remarks": "\n".join(remarks)}, **columns)
    return report.assign_coords(shape=list(attrs))


def _flag_columns(flags):
    """What the report says of a shape's flags; the status only where they make it flagged."""
    serious = dict.fromkeys(one.kind for one in flags if one.flagged)
    others = dict.fromkeys(one.kind for one in flags if not one.flagged)
    columns = {
        "warning": plausibility.in_words(flags),
        "flag_kinds": " ".join(serious),
        "warning_kinds": " ".join(others),
    }
    return columns | ({"status": "flagged"} if serious else {})


def _sources(paths, pattern, volumes):
    """Name to path, arrays or Dataset, in the order of the names."""
    if not isinstance(paths, dict):
        return dict(
            sorted((name, path) for path, name in find_meshes(paths, pattern, volumes=volumes))
        )
    check_names(paths)
    return dict(sorted(paths.items()))


def _cleaned(source, label, **options):
    """A file, a Dataset or a pair of arrays, cleaned."""
    if isinstance(source, str | Path):
        return read_shape(source, label=label, **options)
    if isinstance(source, xr.Dataset):
        return in_unit(clean(source, **options), source.attrs.get("unit"))
    return clean(as_dataset(*check_arrays(*source)), **options)
