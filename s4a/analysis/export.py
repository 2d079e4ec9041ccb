"""Export of registered collections to other programs (4.3, 6.1, 6.2): meshes and tables."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import write_rows
from s4a.input.chirality import map_to_file
from s4a.input.coordinates import UNKNOWN, CoordinateSystem, file_system, map_between, moved, turned
from s4a.input.files import write_mesh
from s4a.input.raw import new_folder
from s4a.schema import Array, check_choice
from s4a.study import store

FORMATS = {"ply": ".ply", "vtk": ".vtk", "obj": ".obj", "npz": ".npz", "gifti": ".gii"}


def write_dataset(data: xr.Dataset | xr.DataTree, path: Path) -> Path:
    """Write a Dataset or tree to a netCDF file with checksums, atomically; return its path."""
    store.write(data, path)
    return path


def write_scores(pca: xr.Dataset, path: Path) -> Path:
    """Write scores to a CSV file, a row per shape, in standard deviations; return its path."""
    columns = (f"component_{c + 1}" for c in range(pca.sizes["component"]))
    rows = zip(pca["shape"].values.tolist(), pca["score"].values.tolist(), strict=True)
    return write_rows(path, [["shape", *columns], *([name, *row] for name, row in rows)])


def write_registered(
    study: xr.DataTree,
    folder: Path | str,
    *,
    format: str = "ply",
    frame: str = "template",
    n_modes: int = 3,
) -> list[Path]:
    """Write every shape in the triangulation of the template, with scores and modes.

    Vertex i is the same point on every shape, as ShapeWorks, Scalismo and geomorph require.

    Parameters
    ----------
    study : DataTree
        With ``/registration``; scores and modes are written if it has ``/pca``.
    folder : path
        Created if missing.
    format : {"ply", "vtk", "obj", "npz", "gifti"}
        All but OBJ include the ``confidence`` of every vertex.
    frame : {"template", "shape"}
        Aligned to the template, or in the coordinates of each shape's file, with mirrored shapes
        reflected back (:func:`s4a.write_mesh` says what the formats need); the unit is that of the
        input.
    n_modes : int
        Number of modes in CSV files; the netCDF file has all.

    Returns
    -------
    list of Path
        ``<shape>.<suffix>`` in the order of the study, ``template.<suffix>``; ``scores.csv`` (a row
        per shape, a column per component, in standard deviations), ``components.csv`` (standard
        deviation, share of the variance), ``mode_<i>.csv`` (x,y,z of one standard deviation, a row
        per vertex) and ``modes.nc``.

    Raises
    ------
    ValueError
        If the study is not registered, a shape is named ``template``, or an option is unknown.

    See Also
    --------
    s4a.write_mesh : Write one mesh.
    s4a_morphometrics.write_for : Write the files of other programs, such as label volumes.

    Examples
    --------
    In a study of six small brains:

    >>> import tempfile
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> folder = tempfile.mkdtemp()
    >>> [path.name for path in s4a.write_registered(study, folder)][5:8]
    ['brain_06.ply', 'template.ply', 'scores.csv']
    """
    check_choice("format", format, FORMATS)
    check_choice("frame", frame, ("template", "shape"))
    registration = registration_of(study)
    names = registration["shape"].values.tolist()
    if "template" in names:
        raise ValueError(
            "no shape may be named 'template', which is the file name of the template: rename it"
        )
    if frame == "shape" and "rotation" not in registration:
        raise ValueError(
            "frame='shape' needs the transform of every shape; this study has none: use "
            "frame='template'"
        )
    folder = new_folder(folder)
    suffix = FORMATS[format]
    X, T = as_arrays(registration)
    paths, aligned = [], system_of_template(study, registration.attrs.get("template", ""))
    for name in names:
        registered = registration.sel(shape=name)
        points, triangles, system = X + registered["displacement"].values, T, aligned
        if frame == "shape":
            M, system = map_to_scan(study, name)
            points = moved(image_in_shape(X, registered), M)
            triangles = turned(T, M)
        has_scalars = format != "obj" and "confidence" in registered
        scalars: Any = {"confidence": registered["confidence"].values} if has_scalars else {}
        paths.append(folder / f"{name}{suffix}")
        write_mesh(paths[-1], points, triangles, **system.attrs, **scalars)
    paths.append(folder / f"template{suffix}")
    write_mesh(paths[-1], X, T, **aligned.attrs)
    return paths + (
        _write_modes(study["pca"].to_dataset(), folder, n_modes) if "pca" in study else []
    )


def system_of_template(study: xr.DataTree, name: str) -> CoordinateSystem:
    """Return the axes and unit of shapes that are aligned to the template, without c_ras."""
    system = CoordinateSystem.of(_attrs_of(study, name))
    return replace(system, origin=UNKNOWN if system.axes else "", to_scanner=None)


def map_to_scan(
    study: xr.DataTree, name: str, given: CoordinateSystem | None = None, *, slicer: bool = False
) -> tuple[Array, CoordinateSystem]:
    """Return the map (4, 4) of a shape to its file, or to scanner RAS, and that system.

    Parameters
    ----------
    study : DataTree
    name : str
    given : CoordinateSystem, optional
        For files that state none.
    slicer : bool
        For 3D Slicer: in millimetres, and in RAS unless it is LPS, as far as they are known.
    """
    attrs = _attrs_of(study, name)
    system = file_system(attrs).filled(given or CoordinateSystem())
    axes = "LPS" if system.axes == "LPS" else "RAS"
    written = system.in_world(axes, "mm") if slicer else system.in_world()
    return map_between(system, written, name) @ map_to_file(attrs), written


def _attrs_of(study, name):
    """Attributes of a mesh; of a study without meshes, whether the run mirrored the shape."""
    if "original" in study.children:
        meshes = study["original"].children
        return meshes[name].attrs if name in meshes else {}
    report = study["report"].to_dataset() if "report" in study.children else xr.Dataset()
    is_known = "reflected" in report and name in report["shape"]  # not in restricted studies
    return {"reflected": bool(report["reflected"].sel(shape=name))} if is_known else {}


def _write_modes(pca, folder, n_modes):
    """Write tables of scores, components and the first modes, and all modes as netCDF."""
    components = range(1, pca.sizes["component"] + 1)
    measures = ["standard_deviation", "explained_variance_ratio"]
    columns = (pca[name].values.tolist() for name in measures)
    rows = zip(components, *columns, strict=True)
    paths = [
        write_scores(pca, folder / "scores.csv"),
        write_rows(folder / "components.csv", [["component", *measures], *rows]),
    ]
    for c in components[:n_modes]:
        mode = pca["deformation"].values[c - 1].tolist()
        paths.append(write_rows(folder / f"mode_{c}.csv", ["xyz", *mode]))
    return [*paths, write_dataset(pca.load(), folder / "modes.nc")]


def write_results(result: xr.Dataset, folder: Path | str, name: str) -> list[Path]:
    """Write a result of :mod:`s4a.analysis.statistics` to netCDF, and its columns to CSV files.

    Parameters
    ----------
    result : Dataset
    folder : path
        Created if missing.
    name : str

    Returns
    -------
    list of Path
        ``<name>.nc`` with all variables; ``<name>.<dim>.csv``, with a row per shape, component,
        fold or vertex and a column per variable of this dim only; ``<name>.csv`` with the scalars.

    Examples
    --------
    >>> import tempfile
    >>> from s4a.analysis.export import write_results
    >>> from s4a.schema import dataset
    >>> result = dataset(p_value=0.5, outlier=[True, False])
    >>> paths = write_results(result, tempfile.mkdtemp(), "test")
    >>> [path.name for path in paths], paths[2].read_text().split()
    (['test.nc', 'test.csv', 'test.shape.csv'], ['shape,outlier', '0,True', '1,False'])
    """
    folder = new_folder(folder)
    paths = [write_dataset(result, folder / f"{name}.nc")]
    tables = {}  # dims -> columns
    for variable, values in result.data_vars.items():
        if values.ndim < 2:
            tables.setdefault(values.dims, {})[variable] = np.atleast_1d(values.values).tolist()
    for dims, columns in sorted(tables.items(), key=lambda item: item[0]):
        rows = zip(*columns.values(), strict=True)
        if dims:
            rows = zip(_index_of(result, dims[0]), *columns.values(), strict=True)
        file = folder / f"{'.'.join([name, *dims])}.csv"
        paths.append(write_rows(file, [[*dims, *columns], *rows]))
    return paths


def _index_of(result, dim):
    """Names along a dim, or numbers: components from 1, others from 0."""
    if dim in result.coords:
        return result[dim].values.tolist()
    start = int(dim == "component")
    return range(start, start + result.sizes[dim])
