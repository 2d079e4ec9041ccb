"""Runs over several structures of each subject, from files, meshes and label volumes."""

import numpy as np
import pytest
import xarray as xr
from s4a.study.structures import parts_of_dict, parts_of_labels, parts_of_table

import s4a
from s4a import analyse, cli, open_study, write_mesh
from s4a.cli.flags import named_label
from s4a.input.subjects import read_table
from s4a.study.options import Options
from s4a.study.sources import find_sources
from s4a_morphometrics.synthetic import subjects

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


def test_commands_for_one_structure_name_those_that_there_are(store, files, capsys):
    for words in (["view"], ["status"], ["statistics"], ["export", "--to", "r", "--out", "x"]):
        assert cli.main([words[0], str(store), *words[1:]]) == 2
        assert "a study of several structures (left, right)" in capsys.readouterr().err
    labels = ["--labels", "no.npy", "--out", "x"]
    source = next(files[0].glob("*left*.ply"))
    assert cli.main(["transfer", str(source), str(store), *labels]) == 2
    assert "a study of several structures (left, right)" in capsys.readouterr().err


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
        (two, {"reflect": "left"}, "reflect names 'left', none of the subjects .subject_1, subj"),
        (two, {"landmarks": str(tmp_path)}, "landmarks: a folder for each structure .left, right"),
        (two, {"features": "sulc"}, "features: no shape has a field 'sulc'"),
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
    parts = parts_of_table(sources, read_table(table, list(sources)), Options())
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


@pytest.fixture(scope="module")
def study(store):
    return open_study(store).load()


def test_a_new_subject_is_inserted_structure_by_structure(study):
    new = subjects(8, 200, seed=1)
    given = {"new_1": new["subject_1"], "new_2": {"left": new["subject_2"]["left"]}}
    inserted = s4a.insert(study, given, n_jobs=1)
    status = inserted["report"]["structure_status"]
    assert status.sel(shape="new_1").values.tolist() == ["ok", "ok"]
    assert status.sel(shape="new_2").values.tolist() == ["ok", "missing"]
    for name in ("left", "right"):
        alone = s4a.insert(
            s4a.statistics.of_structure(study, name), {"new_1": given["new_1"][name]}, n_jobs=1
        )
        found = s4a.statistics.of_structure(inserted, name)["pca"]["score"].sel(shape="new_1")
        xr.testing.assert_equal(found, alone["pca"]["score"].sel(shape="new_1"))


def test_new_subjects_may_lack_a_structure_which_is_told(study, caplog):
    new = subjects(8, 200, seed=1)["subject_1"]
    inserted = s4a.insert(study, {"new": {"right": new["right"]}}, n_jobs=1)
    assert list(inserted["structures"].children) == ["right"]
    report = inserted["report"]
    assert report["structure"].values.tolist() == ["left", "right"]
    assert report["structure_status"].values.tolist() == [["missing", "ok"]]
    assert "new has no left: it is inserted without" in caplog.text
    assert "new has no left" in report.attrs["remarks"]


def test_a_structure_that_cannot_be_used_costs_the_others_nothing(study, caplog):
    new = subjects(8, 200, seed=1)["subject_1"]
    given = {"new": {"left": s4a.synthetic.sphere(9), "right": new["right"]}}
    inserted = s4a.insert(study, given, n_jobs=1)
    assert inserted["report"]["structure_status"].values.tolist() == [["excluded", "ok"]]
    assert "structure left: no shape can be inserted" in inserted["report"].attrs["remarks"]
    assert "structure left: no shape can be inserted" in caplog.text
    alone = s4a.insert(study, {"new": {"right": new["right"]}}, n_jobs=1)
    score = [one["structures/right/pca"]["score"] for one in (inserted, alone)]
    xr.testing.assert_equal(*score)


def test_the_command_inserts_files_of_several_structures_by_their_table(
    store, study, tmp_path, capsys
):
    lines = ["shape,subject,structure"]
    for structure, mesh in subjects(8, 200, seed=1)["subject_1"].items():
        path = tmp_path / f"new_{structure}.ply"
        write_mesh(path, mesh["position"].values, mesh["corner_vertex"].values)
        lines.append(f"{path.name},new,{structure}")
    table, out = tmp_path / "new.csv", tmp_path / "out"
    table.write_text("\n".join(lines) + "\n")
    words = ["insert", str(store), str(tmp_path), "--table", str(table), "--out", str(out)]
    assert cli.main([*words, "--n-jobs", "1"]) == 0
    said = capsys.readouterr().out
    assert said.index("structures/left") < said.index("structures/right")
    direct = s4a.insert(study, {"new": subjects(8, 200, seed=1)["subject_1"]}, n_jobs=1)
    for side in ("left", "right"):
        row = (out / f"structures/{side}/scores.csv").read_text().splitlines()[1].split(",")
        score = direct[f"structures/{side}/pca"]["score"].values[0]
        np.testing.assert_allclose([float(cell) for cell in row[1:]], score, atol=0.02)
    assert {"new.ply", "scores.csv"} <= {path.name for path in (out / "structures/left").iterdir()}
    with xr.open_datatree(out / "inserted.nc") as inserted:
        assert inserted["report"]["structure_status"].values.tolist() == [["ok", "ok"]]
    statistics = ["structures", str(store), "--permutations", "9", "--out", str(tmp_path / "both")]
    assert cli.main([*statistics, "--new", str(out)]) == 0
    said = capsys.readouterr().out
    assert "new subjects\nsubject  structure  turn" in said
    assert said.count("  new: Mahalanobis") == 3
    found = s4a.statistics.structures(study, n_permutations=9)
    new = s4a.statistics.structures_of_new(found, direct)
    joint = s4a.statistics.structures_modes(study, found, "joint", new)["pca"]["score"].values[0]
    row = (tmp_path / "both" / "new_joint.csv").read_text().splitlines()[1].split(",")
    assert row[0] == "new"
    np.testing.assert_allclose([float(cell) for cell in row[1:]], joint, atol=0.02)
    assert cli.main([*statistics, "--new", str(tmp_path / "none.nc")]) == 2
    assert "s4a insert STUDY SHAPES --out DIR writes DIR/inserted.nc" in capsys.readouterr().err


def test_what_cannot_be_inserted_into_several_structures_is_told(study, tmp_path):
    mesh = s4a.synthetic.sphere(200)
    with pytest.raises(ValueError, match=r"several structures \(left, right\): {subject: {struc"):
        s4a.insert(study, {"new": mesh})
    with pytest.raises(ValueError, match="has no structure 'middle'; it has left, right"):
        s4a.insert(study, {"new": {"middle": mesh}})
    with pytest.raises(ValueError, match=r"reflect names 'left', none of the subjects \(new\)"):
        s4a.insert(study, {"new": {"left": mesh}}, reflect="left")
    with pytest.raises(ValueError, match="landmarks: a folder needed, with one for each structure"):
        s4a.insert(study, {"new": {"left": mesh}}, landmarks=tmp_path / "none")
    with pytest.raises(ValueError, match="structure left: no shape can be inserted"):
        s4a.insert(study, {"new": {"left": s4a.synthetic.sphere(9)}}, n_jobs=1)
    with pytest.raises(ValueError, match="a mesh of a structure needed; b has none"):
        s4a.insert(study, {"a": {"left": mesh}, "b": {}})
    template = study["structures/left/registration"].attrs["template"]
    with pytest.raises(ValueError, match="structure left: new shapes need other names than the te"):
        s4a.insert(study, {template: {"left": mesh}})
    table = tmp_path / "ages.csv"
    table.write_text("shape,age\nnew,40\n")
    write_mesh(tmp_path / "new.ply", mesh["position"].values, mesh["corner_vertex"].values)
    with pytest.raises(ValueError, match="'structure' and 'subject' needed beside 'shape'; found"):
        s4a.insert(study, tmp_path / "new.ply", table=table)
    with pytest.raises(ValueError, match="or files and table="):
        s4a.insert(study, {"new": {"left": mesh}}, table=table)
    of_left = s4a.statistics.of_structure(study, "left")
    with pytest.raises(ValueError, match="this study has one alone"):
        s4a.insert(of_left, {"new": mesh}, table=tmp_path / "new.csv")


def test_a_label_volume_is_inserted_into_every_structure_of_such_a_study(tmp_path):
    import nibabel

    grid = np.indices((24, 14, 14)).transpose(1, 2, 3, 0)
    rng = np.random.default_rng(0)
    for name in "abcd":
        labels = np.zeros(grid.shape[:3], np.uint8)
        for value, x in ((1, 6.5), (2, 17.5)):
            axes = rng.uniform([4.5, 3.4, 2.6], [5, 3.8, 3])
            labels[(((grid - [x, 6.5, 6.5]) / axes) ** 2).sum(-1) < 1] = value
        nibabel.Nifti1Image(labels, np.eye(4)).to_filename(tmp_path / f"{name}.nii.gz")
    few = [tmp_path / f"{name}.nii.gz" for name in "abc"]
    study = analyse(few, structures={"front": 1, "back": 2}, keep_doubtful=True, **SMALL)
    inserted = s4a.insert(study, tmp_path / "d.nii.gz", n_jobs=1)
    assert set(inserted["report"]["structure_status"].values.ravel()) <= {"ok", "doubtful"}
    for name, x in (("front", 6.5), ("back", 17.5)):
        assert list(inserted[f"structures/{name}/registration"]["shape"].values) == ["d"]
        points = inserted[f"structures/{name}/original/d"]["position"]
        assert points[:, 0].mean().item() == pytest.approx(x, abs=0.5)
    with pytest.raises(ValueError, match="or label volumes, where it was made of these"):
        s4a.insert(study, {"d": s4a.synthetic.sphere(200)})
