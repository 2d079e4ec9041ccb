"""Export of a study to other programs (4.3, 6.1, 6.2) by one function, :func:`write_for`.

The page *For other programs* describes the files, their units and frames.
"""

import inspect
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.analysis.export import map_to_scan, write_dataset
from s4a.analysis.inputs import registration_of
from s4a.analysis.transfer import image_in_shape, transfer_labels, transfer_landmarks
from s4a.geometry.align import farthest_points
from s4a.geometry.mesh import as_arrays, vertex_normals
from s4a.input.annotations import write_landmarks, write_rows
from s4a.input.coordinates import CoordinateSystem, moved, turned
from s4a.input.files import write_mesh
from s4a.input.formats import vtp_bytes
from s4a.input.landmarks import locate
from s4a.method.pca import synthesize
from s4a.schema import check_count, dataset, in_unit, unit_of, variable
from s4a.seeds import RNG, seed_of
from s4a_morphometrics.scalismo import write_scalismo
from s4a_morphometrics.volumes import write_label_volumes

log = logging.getLogger(__name__)

N_POINTS = 500  # points per shape for programs that work on points
R_SCRIPT = """\
library(ncdf4)
nc <- nc_open("shapes.nc")
coords <- aperm(ncvar_get(nc, "aligned_position"), c(2, 1, 3))  # p x 3 x n: geomorph's array
dimnames(coords)[[3]] <- ncvar_get(nc, "shape")
faces <- t(ncvar_get(nc, "corner_vertex")) + 1                  # triangles, counted from 1
chosen <- ncvar_get(nc, "point_vertex") + 1                     # the points of points.tps
nc_close(nc)
subjects <- read.csv("subjects.csv", row.names = 1)[dimnames(coords)[[3]], , drop = FALSE]
flat <- t(apply(coords[chosen, , ], 3, function(x) as.vector(t(x))))  # geomorph: two.d.array()
modes <- prcomp(flat)
"""


def write_for(study: xr.DataTree, folder: Path | str, program: str, **options: Any) -> list[Path]:
    """Write a study in the files of another program.

    Parameters
    ----------
    study : DataTree
        With ``/original`` and ``/registration``; Scalismo and ParaView need ``/pca``.
    folder : path
        Created if missing.
    program : {"slicer", "shapeworks", "scalismo", "paraview", "r", "nifti"}
        See :func:`write_slicer`, :func:`write_shapeworks`,
        :func:`s4a_morphometrics.scalismo.write_scalismo`, :func:`write_paraview`, :func:`write_r`
        and :func:`s4a_morphometrics.volumes.write_label_volumes`.
    **options
        Options of that function.

    Returns
    -------
    list of Path

    Raises
    ------
    ValueError
        If the program is unknown, has no such option, or the study lacks a node that it needs.

    See Also
    --------
    write_training_set : labelled meshes for machine learning.
    s4a_morphometrics.scalismo.read_scalismo : reads a statistical shape model.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import tempfile
    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> [path.name for path in s4a_morphometrics.write_for(study, tempfile.mkdtemp(), "scalismo")]
    ['model.h5']
    """
    if program not in PROGRAMS:
        raise ValueError(f"program must be one of {', '.join(PROGRAMS)}; found {program!r}")
    writer = PROGRAMS[program]
    accepted = [name for name in inspect.signature(writer).parameters if name not in LEADING]
    wrong = [name for name in options if name not in accepted]
    if wrong:
        raise ValueError(
            f"{program} takes the options {', '.join(accepted)}; found {', '.join(wrong)}"
        )
    return writer(study, Path(folder), **options)


LEADING = ("study", "folder")


def write_slicer(
    study: xr.DataTree,
    folder: Path | str,
    *,
    n_points: int = N_POINTS,
    landmarks: xr.Dataset | None = None,
    coordinate_system: str | None = None,
    unit: str | None = None,
) -> list[Path]:
    """Write registered surfaces and points for 3D Slicer, each in the frame of its file.

    They are in millimetres if the unit is known, and in scanner RAS for files of FreeSurfer.

    Parameters
    ----------
    study : DataTree
    folder : path
        Receives, for every shape, ``<shape>.vtk`` with its ``confidence``,
        ``points/<shape>.mrk.json``, the landmarks for SlicerMorph's GPA, and
        ``landmarks/<shape>.mrk.json``.
    n_points : int
        Number of farthest-point samples, the same vertices on every shape.
    landmarks : Dataset, optional
        Landmarks of the template, by default those of its file; transferred to all shapes.
    coordinate_system, unit : str, optional
        For files that state none.

    Returns
    -------
    list of Path
    """
    registration, X, T, chosen = _parts(study, n_points)
    folder = _folders(folder, "points")
    name = registration.attrs["template"]
    from_file = landmarks is None and "landmark_position" in study["original"][name]
    landmarks = study["original"][name].to_dataset() if from_file else landmarks
    transferred: dict[str, xr.Dataset] = {}
    if landmarks is not None:
        (folder / "landmarks").mkdir(exist_ok=True)
        others = transfer_landmarks(study, landmarks).children
        if not from_file:  # project them to the surface, as on all other shapes
            landmarks = locate(landmarks, study["original"][name].to_dataset())
        transferred = {name: landmarks}
        transferred |= {other: node.to_dataset() for other, node in others.items()}
    given = CoordinateSystem.of({"coordinate_system": coordinate_system, "unit": unit})
    paths, unknown = [], []
    names = np.array([str(vertex) for vertex in chosen.tolist()])
    for shape in registration["shape"].values.tolist():
        registered = registration.sel(shape=shape)
        M, system = map_to_scan(study, shape, given, slicer=True)
        points = moved(image_in_shape(X, registered), M)
        triangles = turned(T, M)
        unknown += [] if system.axes else [shape]
        paths.append(folder / f"{shape}.vtk")
        confidence = registered["confidence"].values
        write_mesh(paths[-1], points, triangles, **system.attrs, confidence=confidence)
        lists = {"points": dataset(landmark_name=names, landmark_position=points[chosen])}
        if shape in transferred:
            names_of_marks = [n for n in transferred[shape] if str(n) in MARKS]
            marks = transferred[shape][names_of_marks].drop_attrs()
            position = moved(marks["landmark_position"].values, M)
            marks["landmark_position"] = variable("landmark_position", position)
            lists["landmarks"] = marks
        for kind, marks in lists.items():
            paths.append(folder / kind / f"{shape}.mrk.json")
            marks = in_unit(marks, system.unit).assign_attrs(system.attrs)
            write_landmarks(paths[-1], marks)
    if unknown:
        log.warning(
            "the files of %d shapes, such as %s, do not say whether they are RAS or LPS; 3D Slicer "
            "takes them as LPS; coordinate_system= sets it",
            len(unknown),
            unknown[0],
        )
    return paths


MARKS = ("landmark_name", "landmark_position", "landmark_curve", "landmark_closed")


def write_shapeworks(
    study: xr.DataTree, folder: Path | str, *, n_points: int = N_POINTS
) -> list[Path]:
    """Write a ShapeWorks project: the meshes, and corresponding vertices as particles.

    Local particles are on the mesh of each shape; ``alignment_1`` transforms them to world
    coordinates, the frame of the template.

    Parameters
    ----------
    study : DataTree
    folder : path
        Receives ``study.swproj``, ``shapes/<shape>.ply`` (the cleaned mesh, mirrored if the run
        mirrored it) and ``particles/<shape>_local.particles`` and ``_world.particles``.
    n_points : int
        Number of particles, farthest-point samples.

    Returns
    -------
    list of Path
    """
    registration, X, _, chosen = _parts(study, n_points)
    folder = _folders(folder, "shapes", "particles")
    subjects = study["subjects"].to_dataset() if "subjects" in study.children else xr.Dataset()
    rows, paths = [], []
    for shape in registration["shape"].values.tolist():
        registered = registration.sel(shape=shape)
        mesh = f"shapes/{shape}.ply"
        write_mesh(folder / mesh, *as_arrays(study["original"][shape].to_dataset()))
        row = {"name": shape, "shape_1": mesh, "groomed_1": mesh}
        R, t, s = (registered[name].values for name in ("rotation", "translation", "scale"))
        M = np.eye(4)
        M[:3, :3], M[:3, 3] = s * R, t
        row["alignment_1"] = " ".join(map(repr, M.ravel().tolist()))
        row["procrustes_1"] = " ".join(map(repr, np.eye(4).ravel().tolist()))
        local, world = image_in_shape(X, registered), X + registered["displacement"].values
        paths.append(folder / mesh)
        for kind, position in {"local": local, "world": world}.items():
            row[f"{kind}_particles_1"] = f"particles/{shape}_{kind}.particles"
            paths.append(folder / row[f"{kind}_particles_1"])
            np.savetxt(paths[-1], position[chosen], fmt="%.9g")
        rows.append(row | _cells(subjects, shape))
    project = {
        "data": rows,
        "groom": {},
        "optimize": {"number_of_particles": str(len(chosen))},
        "landmarks": [],
    }
    paths.append(folder / "study.swproj")
    paths[-1].write_text(json.dumps(project, indent=4) + "\n", encoding="utf-8")
    return paths


def _cells(subjects, shape):
    """Return the table's row of a shape as texts; text columns become groups of ShapeWorks."""
    if "shape" not in subjects.coords or shape not in subjects["shape"].values:
        return {}
    row = subjects.sel(shape=shape)
    return {
        f"group_{name}" if row[name].dtype.kind == "U" else str(name): str(row[name].item())
        for name in row.data_vars
    }


def write_paraview(
    study: xr.DataTree,
    folder: Path | str,
    *,
    n_modes: int = 3,
    n_steps: int = 25,
    extent: float = 3.0,
) -> list[Path]:
    """Write modes and registered shapes, aligned to the template, as time series of ParaView.

    Parameters
    ----------
    study : DataTree
    folder : path
        Receives ``mode_<i>.pvd``, with the score in standard deviations as time; ``shapes.pvd``,
        with the index in the study as time; and folders of ``.vtp`` files with ``displacement``
        from the mean shape, ``along_normal``, positive outward, and ``confidence``.
    n_modes, n_steps : int
        Number of modes, and of surfaces of each mode.
    extent : float
        Range of the scores, from -extent to extent.

    Returns
    -------
    list of Path
        The ``.pvd`` files.
    """
    check_count("n_modes", n_modes, 1)
    check_count("n_steps", n_steps, 2)
    if not 0 < extent < np.inf:
        raise ValueError(f"extent needs a positive number of standard deviations, found {extent!r}")
    registration = registration_of(study)
    X, T = as_arrays(registration)
    mean = synthesize(study, np.zeros(1))["position"].values
    normals = vertex_normals(mean, T)
    n_modes = min(n_modes, study["pca"].sizes["component"])
    confidence = registration["confidence"].values
    series = {}
    for i in range(n_modes):
        scores = np.linspace(-extent, extent, n_steps)
        surfaces = [
            synthesize(study, np.eye(n_modes)[i] * score)["position"].values for score in scores
        ]
        mean_confidence = [confidence.mean(0)] * n_steps
        series[f"mode_{i + 1}"] = zip(scores.tolist(), surfaces, mean_confidence, strict=True)
    shapes = X + registration["displacement"].values
    series["shapes"] = zip(range(len(shapes)), shapes, confidence, strict=True)
    folder = _folders(folder, *series)
    paths = []
    for name, steps in series.items():
        lines = []
        for i, (time, position, at_vertices) in enumerate(steps):
            file, d = f"{name}/{i:03d}.vtp", position - mean
            along = (d * normals).sum(1)
            fields = {"displacement": d, "along_normal": along, "confidence": at_vertices}
            (folder / file).write_bytes(vtp_bytes(position, T, fields))
            lines.append(f'<DataSet timestep="{time!r}" part="0" file="{file}"/>\n')
        paths.append(folder / f"{name}.pvd")
        paths[-1].write_text(
            '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1" '
            'byte_order="LittleEndian">\n<Collection>\n'
            f"{''.join(lines)}</Collection>\n</VTKFile>\n",
            encoding="utf-8",
        )
    return paths


def write_r(study: xr.DataTree, folder: Path | str, *, n_points: int = N_POINTS) -> list[Path]:
    """Write the registered shapes, aligned to the template, for R and geomorph.

    Parameters
    ----------
    study : DataTree
    folder : path
        Receives ``shapes.nc`` (all vertices; R reverses the order of dims), ``points.tps`` (some
        vertices, for ``geomorph::readland.tps(file, specID = "ID")``), ``subjects.csv`` (a row per
        shape, with its scores) and ``study.R``, a script that reads these files.
    n_points : int
        Number of points in the TPS file, farthest-point samples.

    Returns
    -------
    list of Path
    """
    registration, X, T, chosen = _parts(study, n_points)
    folder = _folders(folder)
    names = registration["shape"].values
    position = X + registration["displacement"].values.astype(float)
    whole = dataset(aligned_position=position, corner_vertex=T, point_vertex=chosen)
    paths = [folder / name for name in ("shapes.nc", "points.tps", "subjects.csv", "study.R")]
    unit = unit_of(registration["displacement"])
    write_dataset(in_unit(whole.assign_coords(shape=names), unit), paths[0])
    with open(paths[1], "w", encoding="utf-8") as file:
        for name, points in zip(names.tolist(), position[:, chosen], strict=True):
            file.write(f"LM3={len(chosen)}\n")
            np.savetxt(file, points, fmt="%.9g")
            file.write(f"ID={name}\n")
    columns = {"shape": names.tolist()}
    if "subjects" in study.children:
        table = study["subjects"].to_dataset().reindex(shape=names)
        columns |= {str(name): table[name].values.tolist() for name in table.data_vars}
    if "pca" in study.children:
        scores = study["pca"].to_dataset()["score"].sel(shape=names).values
        columns |= {f"component_{i}": score.tolist() for i, score in enumerate(scores.T, 1)}
    write_rows(paths[2], [columns, *zip(*columns.values(), strict=True)])
    paths[3].write_text(R_SCRIPT, encoding="utf-8")
    return paths


def _parts(study, n_points):
    """Return the registration, the template ``X, T``, and farthest-point samples of it."""
    check_count("n_points", n_points, 3)
    registration = registration_of(study)
    X, T = as_arrays(registration)
    return registration, X, T, farthest_points(X, n_points)


def _folders(folder: Path | str, *names: str) -> Path:
    """Create a folder with subfolders."""
    for path in (Path(folder), *(Path(folder) / name for name in names)):
        path.mkdir(parents=True, exist_ok=True)
    return Path(folder)


def write_training_set(
    study: xr.DataTree,
    folder: Path | str,
    *,
    label: np.ndarray | None = None,
    landmarks: xr.Dataset | None = None,
    source: str | xr.Dataset | None = None,
    test_share: float = 0.2,
    seed: int = 0,
    rng: RNG | None = None,
    **options: Any,
) -> dict[str, list[str]]:
    """Write labelled meshes to train and test models of segmentation or landmark detection.

    Parameters
    ----------
    study : DataTree
        With ``/original`` and ``/registration``.
    folder : path
        Receives ``meshes/<shape>.ply`` (the cleaned mesh with all vertices, in the coordinates of
        its file, or mirrored if the run mirrored it), ``labels/<shape>.npy`` (one per vertex) and
        ``labels/<shape>.confidence.npy`` (share of the votes times confidence of the match),
        ``landmarks/<shape>.csv`` (name,x,y,z), and ``split.json`` with the lists ``train`` and
        ``test``.
    label, landmarks, source : see :func:`s4a.transfer_labels` and :func:`s4a.transfer_landmarks`
    test_share : float
        Share of shapes in the test set, rounded up.
    seed, rng : see :mod:`s4a.seeds`
        For the split.
    **options
        Options to match an external source, see :func:`s4a.transfer_labels`.

    Returns
    -------
    dict
        The split.

    Raises
    ------
    ValueError
        If neither labels nor landmarks are given, or no shape is left to train or to test on.

    See Also
    --------
    s4a.transfer_labels, s4a.transfer_landmarks : transfer without files.
    write_for : export to other programs.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import tempfile
    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> folder = tempfile.mkdtemp()
    >>> label = study["original/brain_01/label"].values
    >>> split = s4a_morphometrics.write_training_set(study, folder, label=label, source="brain_01")
    >>> len(split["train"]), len(split["test"])
    (4, 2)
    """
    if label is None and landmarks is None:
        raise ValueError("a training set needs labels, landmarks or both; found neither")
    folder = Path(folder)
    names = registration_of(study)["shape"].values.tolist()
    n_test = int(np.ceil(test_share * len(names)))
    if not 0 < n_test < len(names):
        raise ValueError(
            f"test_share must leave some of {len(names)} shapes for training and for testing; "
            f"found {test_share}"
        )
    transfer = {"source": source, "targets": names} | options
    transferred = {}  # before anything is written, because it may fail
    if label is not None:
        transferred["labels"] = transfer_labels(study, label, **transfer)
    if landmarks is not None:
        transferred["landmarks"] = transfer_landmarks(study, landmarks, **transfer)
    for part in ("meshes", *transferred):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for name in names:
        mesh = study["original"][name].to_dataset()
        write_mesh(folder / "meshes" / f"{name}.ply", *as_arrays(mesh))
        if "labels" in transferred:
            labels = transferred["labels"][name].to_dataset()
            confidence = labels["label_share"] * labels["confidence"]
            np.save(folder / "labels" / f"{name}.npy", labels["label"].values)
            np.save(folder / "labels" / f"{name}.confidence.npy", confidence.values)
        if "landmarks" in transferred:
            write_landmarks(
                folder / "landmarks" / f"{name}.csv", transferred["landmarks"][name].to_dataset()
            )
    order = np.random.default_rng(seed_of(seed, rng)).permutation(len(names))
    split = {
        "train": sorted(names[i] for i in order[n_test:]),
        "test": sorted(names[i] for i in order[:n_test]),
    }
    (folder / "split.json").write_text(json.dumps(split, indent=1) + "\n")
    return split


PROGRAMS: dict[str, Callable[..., list[Path]]] = {
    "slicer": write_slicer,
    "shapeworks": write_shapeworks,
    "scalismo": write_scalismo,
    "paraview": write_paraview,
    "r": write_r,
    "nifti": write_label_volumes,
}
