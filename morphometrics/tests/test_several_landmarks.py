"""Landmarks of several structures: in a folder for each, or named as the files of a table."""

import numpy as np
import pytest
import xarray as xr
from s4a.study.structures import (
    check_parts,
    landmark_folders,
    parts_of_dict,
    parts_of_labels,
    parts_of_table,
)

import s4a
from s4a import analyse, cli, write_mesh
from s4a.input.annotations import write_landmarks
from s4a.input.hands import mirror_image
from s4a.input.subjects import read_table
from s4a.method.shape import features_of
from s4a.schema import dataset
from s4a.study.insert import read_new
from s4a.study.options import Options
from s4a.study.sources import find_sources
from s4a_morphometrics.synthetic import subjects

SMALL = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 3, "n_jobs": 1}
WHERE = np.concatenate([np.eye(3), -np.eye(3)])  # on the unit sphere that all beans are made of


def marks(mesh):
    """Six landmarks at the vertices of a bean that are nearest to known places."""
    nearest = abs(mesh["reference_point"].values[:, None] - WHERE).sum(2).argmin(0)
    points = mesh["position"].values[nearest]
    return dataset(landmark_name=list("abcdef"), landmark_position=points)


@pytest.fixture(scope="module")
def two():
    """Three subjects."""
    return subjects(3, 200)


@pytest.fixture
def folder(two, tmp_path):
    """Their landmarks, in a folder for each structure; the last has none of the right one."""
    folder = tmp_path / "marks"
    for subject, of in two.items():
        for name, mesh in of.items():
            if (subject, name) != ("subject_3", "right"):
                (folder / name).mkdir(parents=True, exist_ok=True)
                write_landmarks(folder / name / f"{subject}.csv", marks(mesh))
    return folder


def files_of(two, scans):
    """Files of the subjects, and their table."""
    scans.mkdir()
    lines = ["shape,subject,structure"]
    for subject, of in two.items():
        for name, mesh in of.items():
            path = scans / f"{name}_of_{subject}.ply"
            write_mesh(path, mesh["position"].values, mesh["corner_vertex"].values)
            lines.append(f"{path.name},{subject},{name}")
    table = scans.parent / f"{scans.name}.csv"
    table.write_text("\n".join(lines) + "\n")
    return scans, table


def test_landmarks_of_a_folder_do_what_those_in_memory_do(two, folder):
    study = analyse(two, landmarks=folder, **SMALL)
    given = {
        subject: {
            name: s4a.with_landmarks(mesh, folder / name / f"{subject}.csv")
            if (folder / name / f"{subject}.csv").exists()
            else mesh
            for name, mesh in of.items()
        }
        for subject, of in two.items()
    }
    in_memory, without = (analyse(meshes, **SMALL) for meshes in (given, two))
    for name in ("left", "right"):
        part = study[f"structures/{name}"]
        assert part["original/subject_1"]["guide_name"].values.tolist() == list("abcdef")
        found = part["registration"]["displacement"]
        same, other = (
            one[f"structures/{name}/registration"]["displacement"] for one in (in_memory, without)
        )
        xr.testing.assert_allclose(found, same, atol=1e-5)
        assert float(abs(found - other).max()) > 0.1
    said = study["structures/right/report"].attrs["remarks"]
    assert "1 of 3 shapes have no file of landmarks and are registered without: subject_3" in said


def test_files_of_a_table_have_landmarks_by_their_own_names_or_by_subject(two, folder, tmp_path):
    scans, table = files_of(two, tmp_path / "scans")
    sources = find_sources(scans)
    rows = read_table(table, list(sources))
    of_subjects = parts_of_table(sources, rows, Options(landmarks=folder))
    flat = tmp_path / "flat"
    flat.mkdir()
    for path in folder.glob("*/*.csv"):
        (flat / f"{path.parent.name}_of_{path.name}").write_bytes(path.read_bytes())
    of_files = parts_of_table(sources, rows, Options(landmarks=flat))
    for name in ("left", "right"):
        marked = of_subjects[name].marked
        assert sorted(marked) == [f"subject_{i}" for i in range(1, 4 if name == "left" else 3)]
        keys = {subject: guides.landmarks[1] for subject, guides in marked.items()}
        assert keys == {s: guides.landmarks[1] for s, guides in of_files[name].marked.items()}
        assert of_subjects[name].sources == of_files[name].sources


def test_files_of_a_dict_have_fields_beside_them(two, tmp_path):
    scans, _ = files_of(two, tmp_path / "scans")
    np.save(scans / "left_of_subject_1.depth.npy", np.arange(200.0))
    np.save(scans / "right_of_subject_2.depth.npy", np.arange(200.0))
    given = {
        subject: {name: scans / f"{name}_of_{subject}.ply" for name in of}
        for subject, of in two.items()
    }
    parts = parts_of_dict(given, Options(features="depth"))
    assert {name: list(part.marked) for name, part in parts.items()} == {
        "left": ["subject_1"],
        "right": ["subject_2"],
    }
    assert list(parts["left"].marked["subject_1"].features) == ["depth"]


def test_label_volumes_have_landmarks_in_a_folder_for_each_label(folder, tmp_path):
    scans = tmp_path / "volumes"
    scans.mkdir()
    for i in (1, 2):
        (scans / f"subject_{i}.nii").write_bytes(b"")
    options = Options(landmarks=folder)
    parts = parts_of_labels(scans, {"left": 1, "right": 2}, options)
    assert sorted(parts["right"].marked) == ["subject_1", "subject_2"]
    file, _ = parts["right"].marked["subject_1"].landmarks
    assert file == str(folder / "right" / "subject_1.csv")


def test_a_structure_without_landmarks_and_a_folder_of_none_are_named(two, folder, tmp_path):
    (folder / "right").rename(folder / "rihgt")
    options = Options(landmarks=folder)
    with pytest.raises(ValueError, match=r"for each structure \(left, right\) needed.*'rihgt'"):
        parts_of_dict(two, options)
    (folder / "rihgt").rename(tmp_path / "right")
    parts = parts_of_dict(two, options)
    assert parts["right"].marked == {}
    told = check_parts(parts, options)
    assert told == ["no file of landmarks for any right: registered without"]
    (folder / "left").rename(tmp_path / "left")
    with pytest.raises(ValueError, match=r"such as .*marks/left/subject_1\.csv; found none"):
        landmark_folders(options, ["left", "right"])
    file = tmp_path / "file.csv"
    file.write_text("")
    with pytest.raises(ValueError, match=r"a folder needed, with one for each .*file\.csv"):
        parts_of_dict(two, Options(landmarks=file))


def test_a_new_mesh_in_memory_keeps_its_landmarks_and_fields_when_it_is_cleaned(two):
    mesh = two["subject_1"]["left"]
    fields = {"depth": mesh["position"].values[:, 2]}
    given = s4a.with_features(s4a.with_landmarks(mesh, marks(mesh)), fields)
    read, _ = read_new({"new": given}, Options())
    place = read["new"]["guide_position"].values
    np.testing.assert_allclose(place, marks(mesh)["landmark_position"].values, atol=1e-6)
    assert list(features_of(read["new"])) == ["depth"]


def test_landmarks_guide_new_subjects_and_are_mirrored_with_them(two, folder, tmp_path, caplog):
    study = analyse(two, landmarks=folder, **SMALL)
    new = {"new": subjects(6, 200, seed=1)["subject_2"]}
    own = tmp_path / "own"
    for name, mesh in new["new"].items():
        (own / name).mkdir(parents=True)
        write_landmarks(own / name / "new.csv", marks(mesh))
    inserted = s4a.insert(study, new, landmarks=own, n_jobs=1)
    given = {
        name: s4a.with_landmarks(mesh, own / name / "new.csv") for name, mesh in new["new"].items()
    }
    in_memory = s4a.insert(study, {"new": given}, n_jobs=1)
    for name in ("left", "right"):
        both = [one[f"structures/{name}/pca"]["score"] for one in (inserted, in_memory)]
        xr.testing.assert_allclose(*both, atol=1e-5)
    scans, table = files_of(
        {"new": {n: mirror_image(m) for n, m in new["new"].items()}}, tmp_path / "scans"
    )
    flat = tmp_path / "flat"
    flat.mkdir()
    left = marks(mirror_image(new["new"]["left"]))
    write_landmarks(flat / "left_of_new.csv", left)
    store, out = tmp_path / "study", tmp_path / "out"
    analyse(two, landmarks=folder, store=store, **SMALL)
    words = ["insert", str(store), str(scans), "--table", str(table), "--landmarks", str(flat)]
    assert cli.main([*words, "--reflect", "new", "--out", str(out), "--n-jobs", "1"]) == 0
    assert "no file of landmarks for any right: inserted without" in caplog.text
    with xr.open_datatree(out / "inserted.nc") as tree:
        place = tree["structures/left/original/new"]["guide_position"].values
        np.testing.assert_allclose(place, left["landmark_position"].values * [-1, 1, 1], atol=1e-3)
        assert "guide_position" not in tree["structures/right/original/new"]
    with pytest.raises(ValueError, match="landmarks: "):
        s4a.insert(study, new, landmarks=flat)


def test_a_folder_with_landmarks_of_no_new_subject_is_told_for_each_structure(two, folder):
    study = analyse(two, **SMALL)
    new = subjects(6, 200, seed=1)["subject_2"]
    write_landmarks(folder / "left" / "new.csv", marks(new["left"]))
    both = s4a.insert(study, {"new": new}, landmarks=folder, n_jobs=1)
    said = both["report"].attrs["remarks"]
    assert said == "no file of landmarks for any right: inserted without"
    assert "guide_position" in both["structures/left/original/new"]
    one = s4a.insert(study, {"new": {"right": new["right"]}}, landmarks=folder, n_jobs=1)
    assert "no file of landmarks for any right" in one["report"].attrs["remarks"]
