"""Registered output and training sets: files equal the arrays of the study."""

import csv
import json

import numpy as np
import pytest
import xarray as xr

from s4a import read_mesh, write_registered
from s4a.geometry.mesh import as_arrays
from s4a_morphometrics import write_training_set


@pytest.mark.parametrize(
    "format, suffix",
    [("ply", "ply"), ("vtk", "vtk"), ("obj", "obj"), ("npz", "npz"), ("gifti", "gii")],
)
def test_every_shape_is_written_with_the_triangles_of_the_template(study, tmp_path, format, suffix):
    paths = write_registered(study, tmp_path, format=format)
    data = study["registration"].to_dataset()
    for name in [*data["shape"].values, "template"]:
        points, triangles, attrs = read_mesh(tmp_path / f"{name}.{suffix}")
        assert attrs.get("coordinate_system") == (
            None if suffix == "npz" else "RAS, origin unknown"
        )
        assert (triangles == data["corner_vertex"].values).all()
        moved = 0 if name == "template" else data["displacement"].sel(shape=name).values
        assert points == pytest.approx(data["position"].values + moved, abs=1e-3)
    assert all(path.is_file() for path in paths)


def test_scores_and_modes_are_written_as_tables_and_netcdf(study, tmp_path):
    write_registered(study, tmp_path, n_modes=2)
    rows = list(csv.reader((tmp_path / "scores.csv").read_text().splitlines()))
    assert rows[0] == ["shape", "component_1", "component_2", "component_3"]
    assert np.array([row[1:] for row in rows[1:]], float) == pytest.approx(
        study["pca"]["score"].values
    )
    mode = np.loadtxt(tmp_path / "mode_2.csv", delimiter=",", skiprows=1)
    assert mode == pytest.approx(study["pca"]["deformation"].values[1])
    assert not (tmp_path / "mode_3.csv").exists()
    with xr.open_dataset(tmp_path / "modes.nc", engine="h5netcdf") as modes:
        assert modes["deformation"].equals(study["pca"]["deformation"])


def test_in_the_frame_of_the_shape_the_registered_surface_lies_on_it(study, meshes, tmp_path):
    write_registered(study, tmp_path, frame="shape")
    matched = study["registration"]["registered_match"]
    for name, mesh in meshes.items():
        points, _, _ = read_mesh(tmp_path / f"{name}.ply")
        distance = points - mesh["position"].values[matched.sel(shape=name).values]
        assert np.linalg.norm(distance, axis=1).mean() < 8  # mm, few modes on few vertices


def test_a_training_set_has_meshes_labels_landmarks_and_a_split(study, meshes, tmp_path):
    template = meshes[study["registration"].attrs["template"]]
    marks = template[["landmark_name", "landmark_position"]]
    split = write_training_set(
        study, tmp_path, label=template["label"].values, landmarks=marks, test_share=0.25
    )
    assert split == json.loads((tmp_path / "split.json").read_text())
    assert len(split["test"]) == 1
    assert sorted(split["train"] + split["test"]) == sorted(meshes)
    for name, mesh in meshes.items():
        points, triangles, _ = read_mesh(tmp_path / "meshes" / f"{name}.ply")
        assert points == pytest.approx(as_arrays(mesh)[0], abs=1e-3)
        assert (triangles == as_arrays(mesh)[1]).all()
        for file in (f"{name}.npy", f"{name}.confidence.npy"):
            assert np.load(tmp_path / "labels" / file).shape == (len(points),)
        assert len((tmp_path / "landmarks" / f"{name}.csv").read_text().splitlines()) == 11


def test_wrong_options_are_refused(study, tmp_path):
    with pytest.raises(ValueError, match=r"format must be one of 'ply', .* found 'stl'"):
        write_registered(study, tmp_path, format="stl")
    with pytest.raises(ValueError, match="a registered study is needed"):
        write_registered(study.drop_nodes("registration"), tmp_path)
    with pytest.raises(ValueError, match="labels, landmarks or both"):
        write_training_set(study, tmp_path)
