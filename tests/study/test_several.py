"""Runs over several structures of each subject, from files, meshes and label volumes."""

import numpy as np
import pytest
import xarray as xr

import s4a
from s4a import analyse, cli, open_study, write_mesh
from s4a.cli.flags import named_label
from s4a.datasets.structures import subjects
from s4a.input.subjects import read_table
from s4a.study.options import Options
from s4a.study.sources import find_sources
from s4a.study.structures import parts_of_dict, parts_of_labels, parts_of_table

SMALL = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 6, "n_jobs": 1}
FLAGS = "--n-coarse 100 --k 10 --k-init 6 --n-pairs 6 --n-jobs 1".split()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Eleven files of six subjects, the last of whom has no right, and their table."""
    folder = tmp_path_factory.mktemp("scans")
    lines = ["shape,subject,structure,age"]
    for i, (subject, of) in enumerate(subjects(6, 200).items()):
        for structure, mesh in of.items():
            if (i, structure) != (5, "right"):
                path = folder / f"scan_{structure}_{i}.ply"
                write_mesh(path, mesh["position"].values, mesh["corner_vertex"].values)
                lines.append(f"{path.name},{subject},{structure},{30 + i}")
    table = folder / "table.csv"
    table.write_text("\n".join(lines) + "\n")
    return folder, table


@pytest.fixture(scope="module")
def store(files, tmp_path_factory):
    """The study that the command line makes of them, and what it said."""
    folder, table = files
    out = tmp_path_factory.mktemp("several") / "study"
    assert cli.main(["run", str(folder), "--table", str(table), "--out", str(out), *FLAGS]) == 0
    return out


def test_a_table_says_which_shape_is_whose(store):
    study = open_study(store)
    assert list(study["structures"].children) == ["left", "right"]
    left, right = (s4a.statistics.of_structure(study, name) for name in ("left", "right"))
    assert left["registration"]["shape"].values.tolist() == [f"subject_{i}" for i in range(1, 7)]
    assert right["registration"].sizes["shape"] == 5
    assert left["subjects"]["age"].values.tolist() == [30, 31, 32, 33, 34, 35]
    status = study["report"]["structure_status"]
    assert status.sel(shape="subject_6").values.tolist() == ["ok", "missing"]
    assert "subject_6 has no right" in left["report"].attrs["remarks"]
    study.close()


def test_each_structure_is_a_study_of_its_own_folder(store):
    alone = open_study(store / "structures/left")
    of_tree = s4a.statistics.of_structure(open_study(store), "left")
    assert set(alone.children) == set(of_tree.children)
    xr.testing.assert_identical(alone["pca"].to_dataset(), of_tree["pca"].to_dataset())
    with pytest.raises(ValueError, match=r"several structures \(left, right\): give one of them"):
        s4a.verify(store)
    assert (s4a.verify(store / "structures/left")["state"] == "whole").all()


def test_the_command_prints_variances_and_writes_pages(store, tmp_path, capsys):
    assert cli.main(["structures", str(store), "--permutations", "9", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "5 subjects" in said
    rows = {line.split()[0]: line for line in said.splitlines() if line.strip()}
    shares = [float(cell) for cell in rows["all"].replace("%", "").split()[-2:]]
    assert sum(shares) == pytest.approx(100, abs=0.11)
    assert {"left", "right", "joint:", "between:", "within:"} <= set(rows)
    assert {path.name for path in tmp_path.glob("*.html")} == {
        "joint.html", "between.html", "within.html",
    }  # fmt: skip
    with xr.open_dataset(tmp_path / "structures.nc") as found:
        assert found["level_share"].sum() == pytest.approx(1)


def test_a_second_run_finds_all_done_and_a_folder_holds_one_kind(files, store):
    folder, table = files
    made = {path: path.stat().st_mtime_ns for path in store.rglob("structures/*/*/*.nc")}
    analyse(folder, table=table, store=store, **SMALL)
    assert len(made) > 40
    assert made == {path: path.stat().st_mtime_ns for path in store.rglob("structures/*/*/*.nc")}
    with pytest.raises(ValueError, match="has a study of several structures"):
        analyse(folder, store=store, **SMALL)
    with pytest.raises(ValueError, match="has a study of one structure"):
        analyse(folder, table=table, store=store / "structures/left", **SMALL)


def test_a_link_in_place_of_a_structure_is_refused(store, tmp_path):
    (tmp_path / "structures").mkdir()
    (tmp_path / "structures/left").symlink_to(store / "structures/left")
    with pytest.raises(ValueError, match="is a symbolic link, which is not followed"):
        open_study(tmp_path)


def test_a_subject_with_two_shapes_of_one_structure_is_named(files, tmp_path):
    folder, table = files
    text = table.read_text().replace("subject_2,right", "subject_1,right")
    wrong = tmp_path / "table.csv"
    wrong.write_text(text)
    with pytest.raises(ValueError, match="subject_1 has two of right: scan_right_0, scan_right_1"):
        analyse(folder, table=wrong, store=tmp_path / "study", **SMALL)
    wrong.write_text(text.replace("subject,", "person,"))
    with pytest.raises(ValueError, match="needs a column 'subject' beside it"):
        analyse(folder, table=wrong, store=tmp_path / "study", **SMALL)
    wrong.write_text(table.read_text().replace("subject_2,right", "subject_2,NA"))
    with pytest.raises(ValueError, match="scan_right_1 has 'none' and 'subject_2'"):
        analyse(folder, table=wrong, store=tmp_path / "study", **SMALL)
    assert not (tmp_path / "study").exists()


def test_a_column_of_one_structure_is_a_column_as_any_other(files, tmp_path):
    folder, table = files
    plain = tmp_path / "table.csv"
    plain.write_text(table.read_text().replace(",right,", ",left,"))
    sources = find_sources(folder)
    found = read_table(plain, list(sources))
    assert not s4a.study.structures.has_structures(found)


def test_structures_that_do_not_go_together_are_refused(tmp_path):
    two = subjects(3, 60)
    mesh = two["subject_1"]["left"]
    for given, options, words in [
        (two | {"subject_3": mesh}, {}, "a dict of its structures.*single mesh for subject_3"),
        ({name: {"left": of["left"]} for name, of in two.items()}, {}, "several.*found left"),
        (two, {"reflect": "auto"}, "reflect= would put mirrored structures into another frame"),
        (two, {"landmarks": str(tmp_path)}, "landmarks= has a file for each shape"),
        ({"a b": two["subject_1"]}, {}, "shapes need names of letters"),
        ({"a": {"le/ft": mesh, "right": mesh}}, {}, "shapes need names of letters"),
        ({"a": {"left": "no.ply", "right": mesh}}, {}, "shape a: no.ply is no file"),
        (two, {"template": "subject_9"}, "template 'subject_9' is none of the shapes"),
    ]:
        with pytest.raises(ValueError, match=words):
            analyse(given, store=tmp_path / "study", **SMALL, **options)
    only = {"a": two["subject_1"], "b": {"left": mesh}}
    with pytest.raises(ValueError, match="at least 2 subjects that have it; right has a alone"):
        analyse(only, store=tmp_path / "few", **SMALL)


def test_files_and_meshes_of_a_dict_are_taken_alike(files):
    folder, _ = files
    given = {"a": {"left": folder / "scan_left_0.ply", "right": str(folder / "scan_right_0.ply")}}
    parts = parts_of_dict(given, Options())
    assert parts["left"].sources["a"][0] == str(folder / "scan_left_0.ply")
    alone = find_sources(folder)["scan_left_0"]
    assert parts["left"].sources["a"] == alone


def test_parts_of_a_table_keep_the_rows_of_their_shapes(files):
    folder, table = files
    sources = find_sources(folder)
    parts = parts_of_table(sources, {}, read_table(table, list(sources)), Options())
    assert list(parts["right"].sources) == [f"subject_{i}" for i in range(1, 6)]
    assert parts["right"].sources["subject_2"] == sources["scan_right_1"]
    assert parts["right"].subjects["age"].values.tolist() == [30, 31, 32, 33, 34]


def test_label_volumes_give_a_structure_for_each_label(tmp_path):
    import nibabel

    for name in ("a", "b"):
        labels = np.zeros((12, 12, 12), np.uint8)
        labels[2:6, 2:6, 2:6], labels[6:10, 2:6, 2:6] = 1, 2
        nibabel.Nifti1Image(labels, np.eye(4)).to_filename(tmp_path / f"{name}.nii.gz")
    parts = parts_of_labels(tmp_path, {"front": "1", "back": 2}, Options())
    assert {name: part.options.label for name, part in parts.items()} == {"front": 1, "back": 2}
    assert list(parts["front"].sources) == ["a", "b"]
    with pytest.raises(ValueError, match="leave out label="):
        parts_of_labels(tmp_path, {"front": 1}, Options(label=1))


def test_the_flag_of_structures_needs_a_name_and_a_label(capsys):
    assert named_label("left=1,2") == ("left", "1,2")
    with pytest.raises(SystemExit):
        cli.main(["run", "scans", "--out", "x", "--structures", "left"])
    assert "a structure and its label needed, as left=17" in capsys.readouterr().err
