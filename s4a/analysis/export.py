"""Registered collections for other programs.

Meshes of one connectivity, tables, and training sets (4.3, 6.1, 6.2).
"""

import csv
import json
from pathlib import Path

import numpy as np

from s4a.analysis.transfer import transfer_labels, transfer_landmarks
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import write_landmarks
from s4a.input.files import write_mesh
from s4a.study import store

FORMATS = {"ply": ".ply", "vtk": ".vtk", "obj": ".obj", "npz": ".npz", "gifti": ".gii"}


def registered_positions(study, name, *, frame="template"):
    """Vertices of the template's mesh on one shape ``(n, 3)``.

    Aligned to the template or where the shape's file is.
    """
    one = study["registration"].to_dataset().sel(shape=name)
    X = one["position"].values + one["displacement"].values
    if frame == "template":
        return X
    R, t, s = (one[v].values for v in ("rotation", "translation", "scale"))
    return (X - t) @ R / s


def write_registered(study, folder, *, format="ply", frame="template", n_modes=3):
    """Write every shape with the template's triangles, and the scores and modes.

    Vertex i is the same place on every shape, as ShapeWorks, Scalismo and geomorph want it.

    Parameters
    ----------
    study : DataTree
        With ``/registration``; without ``/pca`` no scores and modes are written.
    folder : path
        Made where it is missing.
    format : {"ply", "vtk", "obj", "npz", "gifti"}
        All but OBJ hold the ``confidence`` of every vertex too.
    frame : {"template", "shape"}
        Aligned to the template, or where each shape lies in its file; the unit is that of the
        input.
    n_modes : int
        Modes written as CSV; the netCDF file has all.

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
        When the study is not registered, a shape is named ``template``, or an option is not one of
        those above.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import tempfile
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> folder = tempfile.mkdtemp()
    >>> [path.name for path in s4a.write_registered(study, folder)][5:8]
    ['brain_06.ply', 'template.ply', 'scores.csv']
    """
    if format not in FORMATS or frame not in ("template", "shape"):
        legal = ", ".join(FORMATS)
        raise ValueError(
            f"format must be one of {legal}, frame template or shape; found {format!r}, {frame!r}"
        )
    if "registration" not in study:
        raise ValueError(
            f"a registered study is needed; this one has {', '.join(study.children) or 'no nodes'}"
        )
    data, folder = study["registration"].to_dataset(), Path(folder)
    names = data["shape"].values.tolist()
    if "template" in names:
        raise ValueError(
            "shapes need names other than 'template', which is the file of the template's mesh"
        )
    folder.mkdir(parents=True, exist_ok=True)
    X, T = as_arrays(data)
    paths = []
    for name in names:
        paths.append(folder / f"{name}{FORMATS[format]}")
        scalars = (
            {} if format == "obj" else {"confidence": data["confidence"].sel(shape=name).values}
        )
        write_mesh(paths[-1], registered_positions(study, name, frame=frame), T, **scalars)
    paths.append(folder / f"template{FORMATS[format]}")
    write_mesh(paths[-1], X, T)
    return paths + (
        _write_modes(study["pca"].to_dataset(), folder, n_modes) if "pca" in study else []
    )


def _write_modes(pca, folder, n_modes):
    components = range(1, pca.sizes["component"] + 1)
    pairs = zip(pca["shape"].values.tolist(), pca["score"].values.tolist(), strict=True)
    score = [[name, *row] for name, row in pairs]
    names = ["standard_deviation", "explained_variance_ratio"]
    share = [
        [c, *row]
        for c, row in zip(components, np.stack([pca[n] for n in names], 1).tolist(), strict=True)
    ]
    tables = {"scores": (["shape", *(f"component_{c}" for c in components)], score)}
    tables["components"] = (["component", *names], share)
    tables |= {
        f"mode_{c}": ("xyz", pca["deformation"].values[c - 1].tolist())
        for c in components[:n_modes]
    }
    for name, (head, rows) in tables.items():
        with open(folder / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([list(head), *rows])
    store.write(pca.load(), folder / "modes.nc")
    return [*(folder / f"{name}.csv" for name in tables), folder / "modes.nc"]


def write_training_set(
    study, folder, *, label=None, landmarks=None, source=None, test_share=0.2, seed=0
):
    """Write a training set for learners of segmentations and key-points.

    Meshes, labels, landmarks, split.

    Parameters
    ----------
    study : DataTree
        With ``/original`` and ``/registration``.
    folder : path
        Gets ``meshes/<shape>.ply`` (the cleaned mesh, with all its vertices, in the coordinates of
        its file), ``labels/<shape>.npy`` (one per vertex) and ``labels/<shape>.confidence.npy``
        (share of the votes times confidence of the match), ``landmarks/<shape>.csv`` (name,x,y,z),
        and ``split.json`` with the lists ``train`` and ``test``.
    label, landmarks, source : see :func:`s4a.transfer_labels` and :func:`s4a.transfer_landmarks`
    test_share : float
        Of the shapes, rounded up.
    seed : int
        Of the split.

    Returns
    -------
    dict
        The split.

    Raises
    ------
    ValueError
        When there is nothing to learn, or the share leaves no shape to train or to test on.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import tempfile
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> folder = tempfile.mkdtemp()
    >>> label = study["original/brain_01/label"].values
    >>> split = s4a.write_training_set(study, folder, label=label, source="brain_01")
    >>> len(split["train"]), len(split["test"])
    (4, 2)
    """
    if label is None and landmarks is None:
        raise ValueError("a training set needs labels, landmarks or both; found neither")
    folder = Path(folder)
    names = study["registration"]["shape"].values.tolist()
    n_test = int(np.ceil(test_share * len(names)))
    if not 0 < n_test < len(names):
        raise ValueError(
            f"test_share needs a share of {len(names)} shapes that leaves some on both sides: {test_share}"
        )
    marked = None if label is None else transfer_labels(study, label, source=source, targets=names)
    placed = (
        None
        if landmarks is None
        else transfer_landmarks(study, landmarks, source=source, targets=names)
    )
    for part, wanted in (("meshes", True), ("labels", marked), ("landmarks", placed)):
        if wanted is not None:
            (folder / part).mkdir(parents=True, exist_ok=True)
    for name in names:
        write_mesh(
            folder / "meshes" / f"{name}.ply", *as_arrays(study["original"][name].to_dataset())
        )
        if marked is not None:
            one = marked[name]
            np.save(folder / "labels" / f"{name}.npy", one["label"].values)
            np.save(
                folder / "labels" / f"{name}.confidence.npy",
                (one["label_share"] * one["confidence"]).values,
            )
        if placed is not None:
            write_landmarks(folder / "landmarks" / f"{name}.csv", placed[name])
    order = np.random.default_rng(seed).permutation(len(names))
    split = {
        "train": sorted(names[i] for i in order[n_test:]),
        "test": sorted(names[i] for i in order[:n_test]),
    }
    (folder / "split.json").write_text(json.dumps(split, indent=1) + "\n")
    return split


def write_results(found, folder, name):
    """Write a Dataset of :mod:`s4a.analysis.statistics` as netCDF.

    And a CSV for each of its one-dimensional tables.

    Parameters
    ----------
    found : Dataset
    folder : path
        Made where it is missing.
    name : str

    Returns
    -------
    list of Path
        ``<name>.nc`` with everything; ``<name>.<dim>.csv``, a row per shape, component, fold or
        vertex and a column per variable over this dim alone, and ``<name>.csv`` with the numbers
        that have none.

    Examples
    --------
    >>> import tempfile
    >>> from s4a.analysis.export import write_results
    >>> from s4a.schema import dataset
    >>> paths = write_results(dataset(p_value=0.5, outlier=[True, False]), tempfile.mkdtemp(), "test")
    >>> [path.name for path in paths], paths[2].read_text().split()
    (['test.nc', 'test.csv', 'test.shape.csv'], ['shape,outlier', '0,True', '1,False'])
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.nc"]
    store.write(found, paths[0])
    tables = {}
    for variable, values in found.data_vars.items():
        if values.ndim < 2:
            tables.setdefault(values.dims, {})[variable] = np.atleast_1d(values.values)
    for dims, columns in sorted(tables.items(), key=lambda item: item[0]):
        paths.append(folder / f"{'.'.join([name, *dims])}.csv")
        rows = list(zip(*(values.tolist() for values in columns.values()), strict=True))
        if dims:
            index = (
                found[dims[0]].values.tolist()
                if dims[0] in found.coords
                else range(dims[0] == "component", len(rows) + 1)
            )
            rows = [(i, *row) for i, row in zip(index, rows, strict=False)]
        with open(paths[-1], "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([[*dims, *columns], *rows])
    return paths
