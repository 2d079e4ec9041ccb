"""Landmarks of the user: their effect on the registration, and errors for wrong ones."""

import logging
import shutil
import subprocess
import sys

import numpy as np
import pytest
from paths import DATA
from scipy.spatial.transform import Rotation
from small import FLAGS, OPTIONS

from s4a import (
    analyse,
    cli,
    insert,
    match_pair,
    open_study,
    read_shape,
    synthetic,
    with_landmarks,
    write_mesh,
)
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.closest import interpolate
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import write_landmarks
from s4a.input.chirality import mirror_image
from s4a.input.files import files_named
from s4a.input.landmarks import SUFFIXES
from s4a.method.alignment import transform_onto
from s4a.method.refined_eigenfunctions import low_resolution
from s4a.method.shape import Shape
from s4a.schema import dataset


def points(positions, names="abcdefghij"):
    """Landmarks of these positions and one letter each."""
    return dataset(landmark_name=list(names[: len(positions)]), landmark_position=positions)


@pytest.fixture(scope="module")
def brains():
    """Two brains of one truth, and five places that both have."""
    tree = synthetic.brains(2, 2000, seed=5)
    meshes = [tree["original"][f"brain_{i:02d}"].to_dataset() for i in (1, 2)]
    vertex = np.linspace(0, 1999, 5).astype(int)
    at = tree["truth"]["brain_01"]["reference_point"].values[vertex]
    places = [synthetic.position(tree["truth"], f"brain_{i:02d}", at) for i in (1, 2)]
    return meshes, places


def test_a_landmark_that_contradicts_the_surfaces_pulls_the_registration_where_it_lies(brains):
    (template, shape), (on_template, on_shape) = brains
    X, _ = as_arrays(shape)
    size = np.sqrt(shape.attrs.get("area", 0) or 1)
    away = np.linalg.norm(X - on_shape[2], axis=1)
    moved = on_shape.copy()
    moved[2] = X[np.argmin(abs(away - 0.05 * np.ptp(X)))]  # a twentieth of its length aside
    options = {"n_coarse": 800, "k": 40}
    distances = {}
    for what, target in (("none", None), ("true", on_shape), ("moved", moved)):
        pair = [template, shape]
        if target is not None:
            pair = [
                with_landmarks(mesh, points(where))
                for mesh, where in ((template, on_template), (shape, target))
            ]
        result = match_pair(pair[1], pair[0], **options)
        marked = with_landmarks(template, points(on_template))
        point = marked["guide_triangle"].values, marked["guide_barycentric"].values
        image = image_in_shape(template["position"].values, result)
        at = interpolate(image, as_arrays(template)[1], *point)
        distances[what] = np.linalg.norm(at - moved, axis=1), np.linalg.norm(at - on_shape, axis=1)
    assert distances["moved"][0][2] < 0.75 * distances["none"][0][2]  # drawn to where it was put
    others = [0, 1, 3, 4]
    assert distances["moved"][1][others].max() < 0.02 * np.ptp(X)  # and only there
    assert distances["true"][1].max() <= distances["none"][1].max() + 1e-3 * size


def test_shapes_without_common_names_are_registered_as_without_landmarks(brains):
    (template, shape), (on_template, on_shape) = brains
    options = {"n_coarse": 400, "k": 20}
    alone = match_pair(shape, template, **options)
    other = match_pair(
        with_landmarks(shape, points(on_shape, "vwxyz")),
        with_landmarks(template, points(on_template)),
        **options,
    )
    np.testing.assert_array_equal(alone["displacement"], other["displacement"])


@pytest.mark.parametrize("n", [2, 3])
def test_three_landmarks_say_how_a_shape_lies_that_its_form_does_not_tell(n):
    mesh = synthetic.ellipsoid(600)
    turn = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    there = mesh["position"].values[[0, 200, 400][:n]]
    lows = [
        Shape(coarse=low_resolution(with_landmarks(mesh, points(P)), n_coarse=300, k=10)).low
        for P in (there, there @ turn.T)
    ]
    R, _ = transform_onto(*lows)
    # an ellipsoid coincides with itself after each half turn
    assert np.allclose(R, turn if n == 3 else np.eye(3), atol=0.15)


def test_names_that_are_there_twice_are_refused_and_points_of_curves_left_out(brains):
    (template, _), (on_template, _) = brains
    with pytest.raises(ValueError, match="unique names needed, found 'a' 2 times"):
        with_landmarks(template, points(on_template[:2], "aa"))
    curve = dataset(
        landmark_name=["a", "", ""],
        landmark_position=on_template[:3],
        landmark_curve=["", "sulcus", "sulcus"],
        landmark_closed=[False] * 3,
    )
    assert with_landmarks(template, curve)["guide_name"].values.tolist() == ["a"]
    with pytest.raises(ValueError, match="unique names needed, found none"):
        with_landmarks(template, curve.isel(landmark=[1, 2]))


def test_a_folder_of_landmarks_is_read_by_the_names_of_shapes(tmp_path):
    for name in ("head.mrk.json", "arm.landmarks.csv", "Knie 3.csv", "table.txt", "other.pp"):
        (tmp_path / name).write_text("")
    result = files_named(tmp_path, ["head", "arm", "Knie_3", "leg"], "landmarks", SUFFIXES)
    assert {name: file.name for name, file in result.items()} == {
        "head": "head.mrk.json",
        "arm": "arm.landmarks.csv",
        "Knie_3": "Knie 3.csv",
    }
    (tmp_path / "head.csv").write_text("")
    with pytest.raises(ValueError, match=r"landmarks: one file for head needed; found .*head\.csv"):
        files_named(tmp_path, ["head"], "landmarks", SUFFIXES)
    with pytest.raises(
        ValueError, match=r"named after a shape, such as foot with one of .*\.mrk\.json"
    ):
        files_named(tmp_path, ["foot"], "landmarks", SUFFIXES)
    with pytest.raises(ValueError, match="landmarks: a folder of files"):
        files_named(tmp_path / "none", ["head"], "landmarks", SUFFIXES)


@pytest.fixture(scope="module")
def marked(tmp_path_factory):
    """Four small brains, and a folder of landmarks of the first three."""
    tree = synthetic.brains(4, 700, seed=2)
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    at = tree["truth"]["brain_01"]["reference_point"].values[[0, 200, 400, 600]]
    folder = tmp_path_factory.mktemp("marks")
    for name in list(meshes)[:3]:
        there = synthetic.position(tree["truth"], name, at)
        write_landmarks(folder / f"{name}.csv", points(there))
    return meshes, folder


@pytest.fixture(scope="module")
def store(marked, tmp_path_factory):
    """The folder of their study."""
    store = tmp_path_factory.mktemp("marked") / "study"
    analyse(marked[0], landmarks=marked[1], store=store, **OPTIONS).close()
    return store


def test_a_study_keeps_its_landmarks_and_says_who_has_none(store):
    study = open_study(store)
    assert study["original/brain_01"]["guide_name"].values.tolist() == list("abcd")
    assert "guide_name" not in study["original/brain_04"]
    coarse = study["coarse/brain_01"]
    near = coarse["position"].values[coarse["guide_vertex"].values]
    spacing = np.sqrt(coarse["vertex_area"].values.sum() / coarse.sizes["vertex"])
    away = np.linalg.norm(near - study["original/brain_01"]["guide_position"].values, axis=1)
    assert away.max() < 2 * spacing
    assert "1 of 4 shapes have no landmark file" in study["report"].attrs["remarks"]
    assert "brain_04" in study["report"].attrs["remarks"]


def test_landmarks_that_are_not_paired_are_named(marked, store, tmp_path):
    meshes, folder = marked
    own = shutil.copytree(folder, tmp_path / "marks")
    text = (own / "brain_02.csv").read_text()
    (own / "brain_02.csv").write_text(text.replace("\na,", "\nA,"))
    shutil.copytree(store, tmp_path / "study")
    study = analyse(meshes, landmarks=own, store=tmp_path / "study", **OPTIONS)
    said = "landmarks without a partner of that name are ignored (brain_02: A)"
    assert said in study["report"].attrs["remarks"]
    assert "partner" not in open_study(store)["report"].attrs["remarks"]
    (tmp_path / "new").mkdir()
    (tmp_path / "new/brain_05.csv").write_text(text.replace("\na,", "\nA,"))
    new = insert(study, {"brain_05": meshes["brain_02"]}, landmarks=tmp_path / "new")
    assert "are ignored (brain_05: A)" in new["report"].attrs["remarks"]


def test_a_changed_landmark_file_recomputes_its_shape_only(marked, store, tmp_path):
    meshes, folder = marked
    own = shutil.copytree(folder, tmp_path / "marks")
    shutil.copytree(store, tmp_path / "study")
    before = {f.stem: f.stat().st_mtime_ns for f in (tmp_path / "study/original").glob("*.nc")}
    lines = (own / "brain_02.csv").read_text().splitlines()
    (own / "brain_02.csv").write_text("\n".join(lines[:-1]))
    analyse(meshes, landmarks=own, store=tmp_path / "study", **OPTIONS)
    after = {f.stem: f.stat().st_mtime_ns for f in (tmp_path / "study/original").glob("*.nc")}
    assert [name for name in before if before[name] != after[name]] == ["brain_02"]


def test_a_shape_whose_landmarks_lie_elsewhere_is_excluded_with_the_reason(marked, tmp_path):
    meshes, folder = marked
    (tmp_path / "brain_01.csv").write_bytes((folder / "brain_01.csv").read_bytes())
    (tmp_path / "brain_02.csv").write_text("name,x,y,z\na,900,0,0\n")
    logging.disable()
    try:
        study = analyse(meshes, landmarks=tmp_path, **OPTIONS)
    finally:
        logging.disable(logging.NOTSET)
    row = study["report"].to_dataset().sel(shape="brain_02")
    assert row["status"].item() == "excluded"
    assert "'a' is" in row["reason"].item()


def test_landmarks_of_a_mirrored_shape_lie_where_they_lay(marked):
    meshes, folder = marked
    mesh = with_landmarks(meshes["brain_01"], folder / "brain_01.csv")
    image = mirror_image(mesh)
    point = image["guide_triangle"].values, image["guide_barycentric"].values
    np.testing.assert_allclose(interpolate(*as_arrays(image), *point), image["guide_position"])
    np.testing.assert_allclose(image["guide_position"], mesh["guide_position"] * [-1, 1, 1])


@pytest.mark.parametrize("preset", ["paper", None])
def test_landmarks_decide_the_pose_with_every_preset(marked, preset):
    meshes, folder = marked
    turn = np.diag([-1.0, -1.0, 1.0])
    given = {}
    for name in list(meshes)[:3]:
        mesh, rotation = with_landmarks(meshes[name], folder / f"{name}.csv"), np.eye(3)
        if name == "brain_02":
            rotation = turn
        for key in ("position", "guide_position"):
            mesh[key] = mesh[key].copy(data=mesh[key].values @ rotation)
        given[name] = mesh
    small = {"n_coarse": 200, "k": 20, "k_init": 10, "intersections": False}
    small |= {} if preset else {"n_samples": 150}
    study = analyse(given, preset=preset, **small)
    R = study["registration"]["rotation"]
    others = [R.sel(shape=name).values for name in ("brain_01", "brain_03")]
    for rotation in others:  # the rotation of brain_02 without the turn is near the others
        assert np.trace(R.sel(shape="brain_02").values @ turn @ rotation.T) > 2.8


def test_the_command_line_takes_them_for_a_study_and_for_new_shapes(
    marked, tmp_path, capsys, caplog
):
    meshes, folder = marked
    (tmp_path / "scans").mkdir()
    for name, mesh in meshes.items():
        write_mesh(tmp_path / "scans" / f"{name}.ply", *as_arrays(mesh))
    files = sorted((tmp_path / "scans").glob("*.ply"))
    arguments = ["run", *map(str, files[1:]), "--landmarks", str(folder)]
    assert cli.main([*arguments, "--out", str(tmp_path / "study"), *FLAGS]) == 0
    assert "no landmark file" in capsys.readouterr().out
    (tmp_path / "other").mkdir()
    arguments = ["insert", str(tmp_path / "study"), str(files[0]), str(tmp_path / "other")]
    arguments += ["--landmarks", str(folder), "--out", str(tmp_path / "new")]
    assert cli.main(arguments) == 0
    assert "other is not a mesh (a folder without meshes) and was skipped" in caplog.text
    study = open_study(tmp_path / "study")
    new = insert(study, [files[0]], landmarks=folder)
    assert new["original/brain_01"]["guide_name"].values.tolist() == list("abcd")


@pytest.mark.skipif(not (DATA / "faust").exists(), reason="real meshes beside the checkout needed")
def test_five_landmarks_decide_a_pair_of_bodies_that_fails_without(tmp_path):
    command = [sys.executable, DATA / "unpack.py", tmp_path, "faust"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    vertex = [6677, 249, 2065, 5529, 6305]  # head, hands and feet; vertex i is vertex i
    pair = []
    for i in (18, 2):
        mesh = read_shape(tmp_path / "faust" / f"tr_reg_{i:03d}.ply")
        pair.append(with_landmarks(mesh, points(mesh["position"].values[vertex])))
    result = match_pair(*pair, n_coarse=2000, k=60)
    X = pair[0]["position"].values
    error = np.linalg.norm(X[result["match"].values] - X, axis=1).mean()
    assert error < 0.02 * np.sqrt(pair[0].attrs["area"])
