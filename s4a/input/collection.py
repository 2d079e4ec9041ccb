"""Collections of shapes (5.1, the data): read and clean every file, and report on all."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_dataset
from s4a.input import plausibility
from s4a.input.clean import REPAIRS, check_arrays, clean
from s4a.input.coordinates import CoordinateSystem, file_system, in_one_system, with_system
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
from s4a.options import Options, check, check_label
from s4a.schema import Array, check_type, dataset, in_unit, require

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
    coordinate_system: str | None = None,
    unit: str | None = None,
) -> xr.Dataset:
    """Read one mesh file and clean it.

    Parameters
    ----------
    path : str or Path
        See :func:`s4a.read_mesh` for the formats.
    components, strict, close_holes
        See :func:`s4a.clean`.
    label : int, list of int, or "all", optional
        Read the file as a label volume, and return the surface of this label, see
        :func:`s4a.input.labels.read_volume`.
    coordinate_system, unit : str, optional
        For files that state none (:mod:`s4a.input.coordinates`).

    Returns
    -------
    Dataset
        See :func:`s4a.clean`; with the attributes ``path``, ``format`` and, if they are known,
        ``coordinate_system`` and ``unit``.

    Raises
    ------
    ValueError
        If the file cannot be read or cleaned.

    See Also
    --------
    read_shapes : read a collection.
    read_mesh : read without cleaning.
    with_landmarks : add landmarks that guide the registration.

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
        mesh = with_system(mesh, coordinate_system, unit)
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


def as_meshes(shapes: dict[str, Mesh], options: Options) -> dict[str, xr.Dataset]:
    """Return meshes, or those of files, in one coordinate system; `options` for unknown ones.

    Raises ValueError if some systems are known and others are not.
    """
    given = options.coordinate_system, options.unit
    return in_one_system({n: with_system(as_mesh(one, n), *given) for n, one in shapes.items()})


def read_shapes(
    paths: Paths | dict[str, Any],
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
    pattern: str | None = None,
    label: Label = None,
    coordinate_system: str | None = None,
    unit: str | None = None,
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
        See :func:`s4a.clean`.
    pattern : str, optional
        Use only files whose name matches, such as ``"*_brain"``.
    label : int, list of int, or "all", optional
        Read the files as label volumes, see :func:`read_labels`.
    coordinate_system, unit : str, optional
        For files that state none.  Shapes are converted to the most frequent system; if that
        is not possible, none is converted, and a remark says so.
    compare : bool
        Compare each shape with the others in unit, chirality, form and genus
        (:mod:`s4a.input.plausibility`).
    intersections : bool
        Count self-intersecting triangles in that comparison.

    Returns
    -------
    DataTree
        ``/original/<shape>`` is the clean mesh of every usable shape.  ``/report`` has for every
        shape

        - ``status``: ok, repaired, flagged or excluded;
        - ``reason``: repairs, or the reason why the shape is excluded;
        - ``warning``: suspect properties, which are not changed;
        - ``path`` of the file, and counts.

        The attribute ``remarks`` has findings about several shapes, one per line.

    Raises
    ------
    ValueError
        If an option is out of range, or no shape can be used; the message has every reason.

    See Also
    --------
    read_shape : read a single shape.
    analyse : analyse a collection, of the same arguments or of the tree returned.

    Examples
    --------
    >>> import s4a
    >>> points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> triangles = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    >>> shapes = s4a.read_shapes({"good": (points, triangles), "bad": (points, [[0, 1, 9]])})
    >>> list(shapes["original"]), shapes["report"]["status"].values.tolist()
    (['good'], ['excluded', 'ok'])
    """
    options = {"components": components, "strict": strict, "close_holes": close_holes}
    for name, value in {**options, "pattern": pattern}.items():
        check(name, value)
    system = {"coordinate_system": coordinate_system, "unit": unit}
    with_system(xr.Dataset(), **system)  # an error of the options, not of each file
    label = check_label(label)
    volumes = label is not None
    meshes: dict[str, xr.Dataset] = {}
    attrs: dict[str, dict[Any, Any]] = {}
    for name, source in _sources(paths, pattern, volumes).items():
        try:
            meshes[name] = _cleaned(source, label, options, system)
        except ValueError as error:
            path = str(source) if isinstance(source, str | Path) else ""
            attrs[name] = {"status": "excluded", "reason": str(error), "path": path}
    if not meshes:
        reasons = "; ".join(f"{name}: {values['reason']}" for name, values in attrs.items())
        raise ValueError(f"none of {len(attrs)} shapes can be used ({reasons})")
    remarks = remarks_on_files(paths, pattern, volumes=volumes)
    try:
        meshes = in_one_system(meshes)
    except ValueError as error:
        remarks.append(str(error))
    attrs |= {name: mesh.attrs for name, mesh in meshes.items()}
    attrs = dict(sorted(attrs.items()))
    comparisons = {}
    if compare and len(meshes) > 1:
        comparisons = examine(meshes, intersections=intersections)
    used = {name: values for name, values in attrs.items() if values["status"] != "excluded"}
    flags, on_shapes = plausibility.find_warnings(used, comparisons)
    nodes = {f"/original/{name}": mesh for name, mesh in meshes.items()}
    nodes["/report"] = shape_report(attrs, flags, [*on_shapes, *remarks], comparisons)
    return xr.DataTree.from_dict(nodes)


def read_labels(paths: Paths, *, label: Label = "all", **options: Any) -> xr.DataTree:
    """Read label volumes as a collection of surfaces, one structure of each volume.

    Surfaces are extracted by marching cubes, smoothed without shrinking and cleaned.  World
    coordinates are in millimetres, RAS.

    Parameters
    ----------
    paths : str, Path or list of these
        Folders, globs or files: NIfTI (.nii), FreeSurfer (.mgh, .mgz) or NRRD (.nrrd), also as .gz.
    label : int, str or list of int
        The structure; several labels (``[1, 2]`` or ``"1,2"``) are merged, ``"all"`` means every
        voxel that is not 0.
    **options
        Options of :func:`read_shapes`.

    Returns
    -------
    DataTree
        See :func:`read_shapes`.  The report also says which surfaces were closed at the border of
        the volume.

    Raises
    ------
    ValueError
        If scikit-image is not installed or no volume has the label; the message has every reason,
        and the labels that were found.

    See Also
    --------
    s4a_morphometrics.write_label_volumes : labels of the template in the volumes of the shapes.

    References
    ----------
    G. Taubin (1995), A signal processing approach to fair surface design, SIGGRAPH.

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
    """Remarks on files among `paths` that are not meshes, or whose names were shortened."""
    if isinstance(paths, dict | xr.DataTree):
        return []
    what = "label volume" if volumes else "mesh"
    return [
        f"{shown(file)} is not a {what} ({why}) and was skipped"
        for file, why in not_meshes(paths, pattern, volumes=volumes)
    ] + [
        f"{shown(file)} is named {name}: names of shapes have at most {LONGEST_NAME} characters"
        for file, name in find_meshes(paths, pattern, volumes=volumes)
        if was_cut(file, name)
    ]


def shape_report(
    attrs: dict[str, dict[str, Any]],
    flags: plausibility.Flags | None = None,
    remarks: Iterable[str] = (),
    comparisons: dict[str, xr.Dataset] | None = None,
) -> xr.Dataset:
    """Make the report on the shapes of a collection.

    Parameters
    ----------
    attrs : dict
        Name of each shape -> ``status``, ``reason``, ``path`` and counts; counts of an excluded
        shape are -1 in the report.
    flags : dict of str to list of Flag, optional
        See :func:`s4a.input.plausibility.find_warnings`; flags of excluded shapes are ignored.
    remarks : list of str
        On the collection, the most important first.
    comparisons : dict, optional
        Name -> :func:`s4a.input.plausibility.compare`, for the counts.
    """
    comparisons, flags = comparisons or {}, flags or {}
    rows = []
    for name, values in attrs.items():
        flags_of_shape = [] if values["status"] == "excluded" else flags.get(name, [])
        rows.append({**values, **_flag_columns(flags_of_shape)})
        if name in comparisons:
            rows[-1]["self_intersections"] = comparisons[name].attrs["self_intersections"]
    columns: dict[str, list[Any] | Array] = {
        key: [shown(row.get(key, "")) for row in rows] for key in TEXTS
    }
    known = [CoordinateSystem() if r["status"] == "excluded" else file_system(r) for r in rows]
    columns["coordinate_system"] = [str(system) for system in known]
    columns |= {key: np.array([row.get(key, -1) for row in rows], np.int64) for key in COUNTS}
    columns |= {key: [float(row.get(key, np.nan)) for row in rows] for key in _AREAS}
    report = dataset({"remarks": "\n".join(remarks)}, **columns)
    return report.assign_coords(shape=list(attrs))


def _flag_columns(flags):
    """Columns of the report for a shape's flags; ``status`` only if it is flagged."""
    serious = dict.fromkeys(flag.kind for flag in flags if flag.flagged)
    others = dict.fromkeys(flag.kind for flag in flags if not flag.flagged)
    columns = {
        "warning": plausibility.in_words(flags),
        "flag_kinds": " ".join(serious),
        "warning_kinds": " ".join(others),
    }
    return columns | ({"status": "flagged"} if serious else {})


def _sources(paths, pattern, volumes):
    """Name -> path, arrays or Dataset, sorted by name."""
    if not isinstance(paths, dict):
        return dict(
            sorted((name, path) for path, name in find_meshes(paths, pattern, volumes=volumes))
        )
    check_names(paths)
    return dict(sorted(paths.items()))


def _cleaned(source, label, options, system):
    """Read and clean a file, a Dataset or a pair of arrays."""
    if isinstance(source, str | Path):
        return read_shape(source, label=label, **options, **system)
    mesh = source if isinstance(source, xr.Dataset) else as_dataset(*check_arrays(*source))
    mesh = with_system(mesh, **system)
    return in_unit(clean(mesh, **options), mesh.attrs.get("unit"))
