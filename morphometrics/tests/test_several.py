"""Multi-structure studies: shapes by subject, mirrored subjects, new subjects."""

import shutil

import numpy as np
import pytest
import xarray as xr

import s4a
from s4a import cli, write_mesh
from s4a.geometry.mesh import as_arrays, volume
from s4a.input.annotations import write_landmarks
from s4a.input.chirality import mirror_image
from s4a.schema import dataset
from s4a_morphometrics import (
    analyse_structures,
    insert_structures,
    of_structure,
    open_structures,
    structures,
    structures_modes,
    structures_of_new,
)
from s4a_morphometrics.mirrored import combine, mirrored_subjects
from s4a_morphometrics.several import Part, named_subjects, parts_of
from s4a_morphometrics.structures_commands import named_label
from s4a_morphometrics.synthetic import subjects

SMALL = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 6, "n_jobs": 1}
FLAGS = "--n-coarse 100 --k 10 --k-init 6 --n-pairs 6 --n-jobs 1".split()
SIDES = ("left", "right")
ODD = ["subject_2", "subject_4"]
WHERE = np.concatenate([np.eye(3), -np.eye(3)])  # on the unit sphere that all beans are made of


def written(given, folder, **columns):
    """Files of subjects, and their table."""
    folder.mkdir(exist_ok=True)
    lines = [",".join(["shape,subject,structure", *columns])]
    for i, (subject, of) in enumerate(given.items()):
        for name, mesh in of.items():
            path = folder / f"scan_{name}_{i}.ply"
            write_mesh(path, mesh["position"].values, mesh["corner_vertex"].values)
            cells = [path.name, subject, name, *(str(one[i]) for one in columns.values())]
            lines.append(",".join(cells))
    table = folder.parent / f"{folder.name}.csv"
    table.write_text("\n".join(lines) + "\n")
    return folder, table


def marks(mesh):
    """Six landmarks at the vertices of a bean that are nearest to known points."""
    nearest = abs(mesh["reference_point"].values[:, None] - WHERE).sum(2).argmin(0)
    points = mesh["position"].values[nearest]
    return dataset(landmark_name=list("abcdef"), landmark_position=points)


def marked(given, folder):
    """Landmarks of subjects, in a folder for each structure."""
    for subject, of in given.items():
        for name, mesh in of.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            write_landmarks(folder / name / f"{subject}.csv", marks(mesh))
    return folder


def mirrored(of):
    """All structures of a subject, as in a scan that was mirrored."""
    return {name: mirror_image(mesh).drop_attrs() for name, mesh in of.items()}


@pytest.fixture(scope="module")
def six():
    """Six subjects, the last of whom has no right."""
    given = subjects(6, 200)
    del given["subject_6"]["right"]
    return given


@pytest.fixture(scope="module")
def files(six, tmp_path_factory):
    return written(six, tmp_path_factory.mktemp("files") / "scans", age=range(30, 36))


@pytest.fixture(scope="module")
def store(files, tmp_path_factory):
    """The study that the command line makes of the files."""
    out = tmp_path_factory.mktemp("several") / "study"
    words = ["run-structures", str(files[0]), "--table", str(files[1]), "--out", str(out)]
    assert cli.main([*words, *FLAGS]) == 0
    return out


@pytest.fixture(scope="module")
def study(store):
    return open_structures(store).load()


@pytest.fixture(scope="module")
def new():
    return subjects(8, 200, seed=1)["subject_1"]


def test_folders_of_structures_that_were_exchanged_are_refused_by_name(store, tmp_path):
    folder = shutil.copytree(store, tmp_path / "study") / "structures"
    (folder / "left").rename(folder / "other")
    (folder / "right").rename(folder / "left")
    (folder / "other").rename(folder / "right")
    with pytest.raises(ValueError, match="structures/left holds right, is named left"):
        open_structures(tmp_path / "study")


def test_each_structure_has_the_same_study_as_its_meshes_alone(store, study, files, six):
    assert list(study["structures"].children) == list(SIDES)
    left = of_structure(study, "left")
    assert left["subjects"]["age"].values.tolist() == [30, 31, 32, 33, 34, 35]
    status = study["report"]["structure_status"]
    assert status.sel(shape="subject_6").values.tolist() == ["ok", "missing"]
    assert "subject_6 has no right" in study["report"].attrs["remarks"]
    given = {subject: files[0] / f"scan_left_{i}.ply" for i, subject in enumerate(six)}
    for alone in (s4a.open_study(store / "structures/left"), s4a.analyse(given, **SMALL)):
        for node in ("pca", "registration", "latent"):
            xr.testing.assert_identical(alone[node].to_dataset(), left[node].to_dataset())
    assert (s4a.verify(store / "structures/left")["state"] == "whole").all()


def test_a_second_run_finds_all_done(files, store):
    made = {path: path.stat().st_mtime_ns for path in store.rglob("structures/*/*/*.nc")}
    analyse_structures(files[0], table=files[1], store=store, **SMALL)
    assert len(made) > 40
    assert made == {path: path.stat().st_mtime_ns for path in store.rglob("structures/*/*/*.nc")}


def test_folders_of_one_and_of_several_structures_are_not_confused(store, files, tmp_path):
    for command in (s4a.open_study, s4a.verify):
        with pytest.raises(ValueError, match=r"contains studies: give one of them.*ures.left"):
            command(store)
    with pytest.raises(ValueError, match="is not a multi-structure study"):
        open_structures(store / "structures/left")
    with pytest.raises(ValueError, match="is not a multi-structure study and is not empty"):
        analyse_structures(files[0], table=files[1], store=store / "structures/left", **SMALL)
    (tmp_path / "structures").mkdir()
    (tmp_path / "structures/left").symlink_to(store / "structures/left")
    (tmp_path / "structures.json").write_bytes((store / "structures.json").read_bytes())
    with pytest.raises(ValueError, match="is a symbolic link, which is not followed"):
        open_structures(tmp_path)
    (tmp_path / "structures.json").write_text('{"structures": ["../left"]}')
    with pytest.raises(ValueError, match=r"structures.json cannot be read, run again: names"):
        open_structures(tmp_path)


def test_the_core_says_who_analyses_several_structures(six, files):
    with pytest.raises(ValueError, match="dict of left, right; s4a_morphometrics"):
        s4a.analyse(six, **SMALL)
    with pytest.raises(ValueError, match=r"column 'structure', found several.*run-structures"):
        s4a.analyse(files[0], table=files[1], **SMALL)


@pytest.mark.parametrize(
    "old, by, words",
    [
        ("subject_2,right", "subject_1,right", "has two of right: scan_right_0, scan_right_1"),
        (
            "subject,",
            "person,",
            "columns 'structure' and 'subject' needed in addition to 'shape'; found",
        ),
        ("subject_2,right", "subject_2,NA", "scan_right_1 has 'NA' and 'subject_2'"),
        (",right,", ",left,", "has two of left"),
    ],
)
def test_tables_without_subjects_or_structures_are_refused(old, by, words, files, tmp_path):
    wrong = tmp_path / "table.csv"
    wrong.write_text(files[1].read_text().replace(old, by))
    with pytest.raises(ValueError, match=words):
        analyse_structures(files[0], table=wrong, store=tmp_path / "study", **SMALL)
    assert not (tmp_path / "study").exists()


MESH = s4a.synthetic.sphere(60)
TWO = {"left": MESH, "right": MESH}
THREE = {f"subject_{i}": TWO for i in (1, 2, 3)}


@pytest.mark.parametrize(
    "given, options, words",
    [
        (THREE | {"b": MESH}, {}, "a dict of its structures.*single mesh for b"),
        (THREE, {"label": 1}, "gives the labels of each structure: leave out label="),
        ({"a": {"left": MESH}, "b": {"left": MESH}}, {}, "several structures needed; found left"),
        ({"a": MESH}, {}, "several structures of each subject: {subject: {structure: mesh}}"),
        (THREE, {"reflect": "left"}, "'left' is not a shape .subject_1, subj"),
        (THREE, {"landmarks": "none"}, "landmarks: a folder needed, with one for each structure"),
        (THREE, {"features": "sulc"}, "structure left: features: no shape has a field 'sulc'"),
        ({"a b": TWO, "c": TWO}, {}, "names of shapes need"),
        ({"a": {"le/ft": MESH, "right": MESH}}, {}, "names of shapes need"),
        ({"a": {"left": "no.ply", "right": MESH}, "b": TWO}, {}, "shape a: no.ply is not a file"),
        (THREE, {"template": "d"}, "template 'd' is not one of the shapes"),
        ({"a": TWO, "b": {"left": MESH}}, {}, "least 2 subjects that have it; right has only a"),
        ({"a": TWO, "b": {}}, {}, "a mesh of a structure needed; b has none"),
    ],
)
def test_structures_that_do_not_go_together_are_refused(given, options, words):
    with pytest.raises(ValueError, match=words):
        analyse_structures(given, **SMALL, **options)


def test_the_commands_insert_and_compare(store, study, new, tmp_path, capsys, no_pictures):
    scans, table = written({"new": new}, tmp_path / "new")
    out = tmp_path / "out"
    words = ["insert-structures", str(store), str(scans), "--table", str(table), "--out", str(out)]
    assert cli.main([*words, "--n-jobs", "1"]) == 0
    direct = insert_structures(study, {"new": new}, n_jobs=1)
    for side in SIDES:
        row = (out / f"structures/{side}/scores.csv").read_text().splitlines()[1].split(",")
        score = direct[f"structures/{side}/pca"]["score"].values[0]
        np.testing.assert_allclose([float(cell) for cell in row[1:]], score, atol=0.02)
    capsys.readouterr()
    both = tmp_path / "both"
    words = ["structures", str(store), "--permutations", "9", "--out", str(both)]
    assert cli.main([*words, "--new", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "5 subjects" in printed
    rows = {line.split()[0]: line for line in printed.splitlines() if line.strip()}
    shares = [float(cell) for cell in rows["all"].replace("%", "").split()[-2:]]
    assert sum(shares) == pytest.approx(100, abs=0.11)
    assert printed.count("  new: Mahalanobis") == 3
    assert {path.stem for path in both.glob("*.html")} == {"joint", "between", "within"}
    found = structures(study, n_permutations=9)
    joint = structures_modes(study, found, "joint", structures_of_new(found, direct))["pca"]
    row = (both / "new_joint.csv").read_text().splitlines()[1].split(",")
    np.testing.assert_allclose([float(cell) for cell in row[1:]], joint["score"][0], atol=0.02)
    assert cli.main([*words, "--new", str(tmp_path / "none.nc")]) == 2
    assert named_label("left=1,2") == ("left", "1,2")
    with pytest.raises(SystemExit):
        cli.main(["run-structures", "scans", "--out", "x", "--structures", "left"])


def test_a_missing_structure_of_a_new_subject_is_reported_and_the_others_are_inserted(study, new):
    spoilt = {"left": s4a.synthetic.sphere(9), "right": new["right"]}
    given = {"a": new, "b": {"left": new["left"]}}
    both = insert_structures(study, given, n_jobs=1)["report"]
    assert both["structure_status"].values.tolist() == [["ok", "ok"], ["ok", "missing"]]
    assert "b has no right" in both.attrs["remarks"]
    inserted = insert_structures(study, {"new": spoilt}, n_jobs=1)
    assert inserted["report"]["structure_status"].values.tolist() == [["excluded", "ok"]]
    assert "structure left: no shape can be inserted" in inserted["report"].attrs["remarks"]
    alone = s4a.insert(of_structure(study, "right"), {"new": new["right"]}, n_jobs=1)
    xr.testing.assert_equal(inserted["structures/right/pca"]["score"], alone["pca"]["score"])


def test_invalid_new_subjects_are_refused(study, tmp_path):
    template = study["structures/left/registration"].attrs["template"]
    for given, options, words in [
        ({"new": MESH}, {}, r"several structures \(left, right\): {subject: {structure"),
        ({"new": {"middle": MESH}}, {}, "has no structure 'middle'; it has left, right"),
        ({"new": TWO}, {"reflect": "left"}, r"'left' is not a shape \(new\)"),
        ({"new": TWO}, {"landmarks": "none"}, "landmarks: a folder needed, with one for each"),
        ({"new": {"left": s4a.synthetic.sphere(9)}}, {}, "structure left: no shape can be insert"),
        ({template: {"left": MESH}}, {}, "structure left: new shapes need other names than the te"),
    ]:
        with pytest.raises(ValueError, match=words):
            insert_structures(study, given, n_jobs=1, **options)


def test_label_volumes_hold_a_structure_in_each_label(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    grid = np.indices((24, 14, 14)).transpose(1, 2, 3, 0)
    rng = np.random.default_rng(0)
    centres = {"front": 6.5, "back": 17.5}
    for name in "abcd":
        labels = np.zeros(grid.shape[:3], np.uint8)
        for value, x in enumerate(centres.values(), 1):
            axes = rng.uniform([4.5, 3.4, 2.6], [5, 3.8, 3])
            labels[(((grid - [x, 6.5, 6.5]) / axes) ** 2).sum(-1) < 1] = value
        affine = np.diag([-1 if name == "c" else 1, 1, 1, 1])
        nibabel.Nifti1Image(labels, affine).to_filename(tmp_path / f"{name}.nii.gz")
    out = tmp_path / "study"
    words = ["run-structures", *(str(tmp_path / f"{name}.nii.gz") for name in "abc")]
    words += ["--structures", "front=1", "back=2", "--include-flagged", "--reflect", "c"]
    assert cli.main([*words, "--out", str(out), *FLAGS]) == 0
    study = open_structures(out)
    assert study["report"]["reflected"].values.tolist() == [False, False, True]
    inserted = insert_structures(study, tmp_path / "d.nii.gz", n_jobs=1)
    for name, x in centres.items():
        meshes = [study[f"structures/{name}/original/{one}"] for one in "abc"]
        for mesh in [*meshes, inserted[f"structures/{name}/original/d"]]:
            assert mesh["position"][:, 0].mean().item() == pytest.approx(x, abs=0.5)
            assert volume(*as_arrays(mesh)) > 0


# ---- landmarks


def test_landmarks_of_folders_and_tables_have_the_effect_of_those_in_memory(tmp_path, new, caplog):
    three = subjects(3, 200)
    folder = marked(three, tmp_path / "marks")
    (folder / "right/subject_3.csv").unlink()
    in_memory = {
        subject: {
            name: s4a.with_landmarks(mesh, marks(mesh))
            if (subject, name) != ("subject_3", "right")
            else mesh
            for name, mesh in of.items()
        }
        for subject, of in three.items()
    }
    scans, table = written(three, tmp_path / "scans")
    flat = tmp_path / "flat"
    flat.mkdir()
    for i, of in enumerate(in_memory.values()):
        for name, mesh in of.items():
            if "guide_position" in mesh:
                write_landmarks(flat / f"scan_{name}_{i}.csv", marks(mesh))
    options = SMALL | {"n_pairs": 3}
    study = analyse_structures(three, landmarks=folder, **options)
    same = analyse_structures(in_memory, **options)
    of_files = parts_of(scans, None, table, flat)
    new_marks = marked({"new": new}, tmp_path / "new")
    (new_marks / "right/new.csv").unlink()
    inserted = insert_structures(study, {"new": new}, landmarks=new_marks, n_jobs=1)
    assert "no landmark file for any right" in inserted["report"].attrs["remarks"]
    assert "guide_position" in inserted["structures/left/original/new"]
    assert "guide_position" not in inserted["structures/right/original/new"]
    for name in SIDES:
        both = [one[f"structures/{name}/registration"]["displacement"] for one in (study, same)]
        xr.testing.assert_allclose(*both, atol=1e-5)
        assert list(of_files[name].landmarks) == list(three)[: 3 if name == "left" else 2]
    (folder / "right").rename(folder / "rihgt")
    with pytest.raises(ValueError, match=r"for each structure \(left, right\) needed.*'rihgt'"):
        parts_of(three, None, None, folder)


# ---- mirrored subjects


@pytest.fixture(scope="module")
def four():
    """Subjects that are all of one side."""
    return subjects(4, 200)


@pytest.fixture(scope="module")
def mixed(four):
    """The same, half of them mirrored."""
    return {name: mirrored(of) if name in ODD else of for name, of in four.items()}


@pytest.fixture(scope="module")
def found(mixed, tmp_path_factory):
    """The study that found the mirrored ones itself."""
    store = tmp_path_factory.mktemp("mirrored") / "study"
    analyse_structures(mixed, store=store, reflect="auto", **SMALL)
    return open_structures(store).load()


def test_poses_and_modes_of_mirrored_subjects_are_those_of_the_subjects(four, found):
    true = structures(analyse_structures(four, **SMALL), n_permutations=9)
    assert found["report"]["reflected"].values.tolist() == [name in ODD for name in four]
    result = structures(found, n_permutations=9)
    for name in ("pose_rotation", "pose_translation", "level_share", "standard_deviation"):
        np.testing.assert_allclose(result[name], true[name], atol=1e-6, err_msg=name)
    chirality = found["report"]["mean_chirality"]
    assert (chirality.sel(shape=ODD) < -1).all()
    assert (chirality.drop_sel(shape=ODD) > 1).all()


def test_a_new_subject_of_the_other_side_is_mirrored_as_a_whole(found, new):
    true = insert_structures(found, {"new": new}, n_jobs=1)
    assert "reflected" not in true["report"]
    given = {"new": mirrored(new), "same": new}
    inserted = insert_structures(found, given, reflect="auto", n_jobs=1)
    assert inserted["report"]["reflected"].values.tolist() == [True, False]
    for side in SIDES:
        scores = [one[f"structures/{side}/pca"]["score"] for one in (inserted, true)]
        np.testing.assert_allclose(scores[0], np.tile(scores[1], (2, 1)), atol=1e-5)


def test_structures_of_one_subject_are_mirrored_together_or_not_at_all():
    rows = {"a": {"side": "l"}, "b": {"side": "r"}}
    parts = {name: Part(dict.fromkeys(rows), {}, rows) for name in ("femur", "tibia")}
    assert named_subjects("side=l", parts) == ["a"]
    assert named_subjects("b", parts) == ["b"]
    with pytest.raises(ValueError, match="no shape has 'm' in the column 'side', which has l, r"):
        named_subjects("side=m", parts)
    parts["tibia"] = parts["tibia"]._replace(rows={"a": {"side": "r"}, "b": {"side": "r"}})
    with pytest.raises(ValueError, match=r"'side'; a has 'l' \(femur\), 'r' \(tibia\)"):
        named_subjects("side=l", parts)


def comparisons(signs):
    """Comparisons of a, b, c and d, whose sides have these `signs`."""
    names = list("abcd")
    table = np.outer(signs, signs) + np.diag([np.nan] * 4)
    return {
        name: dataset(chirality=row).assign_coords(reference=names)
        for name, row in zip(names, table, strict=True)
    }


@pytest.mark.parametrize(
    "left, right, mirrored, remarks",
    [
        ([0.9, 0.9, -0.9, 0.9], [0.9, 0.9, -0.9, 0.9], ["c"], []),
        # a structure that equals its mirror image has no influence
        ([1.2, 1.2, -1.2, 1.2], [0.1] * 4, ["c"], []),
        (
            [1.2, 1.2, -1.2, 1.2],
            [1.2] * 4,
            [],
            ["c has structures of both sides (left -1.44, right +1.44)"],
        ),
        # also if one structure has larger values than the other
        ([1.2, 1.2, -3, 1.2], [1.2, 1.2, 0.9, 1.2], [], ["c has structures of both sides (left -"]),
        (
            [1.8, 1.8, -1.8, 0.1],
            [1.8, 1.8, 1.8, 0.1],
            [],
            ["cannot determine the side of d", "c has structures of both sides (left -"],
        ),
    ],
)
def test_structures_together_determine_the_side_of_a_subject(left, right, mirrored, remarks):
    _, names, lines = mirrored_subjects({"left": comparisons(left), "right": comparisons(right)})
    assert names == mirrored
    assert all(word in line for word, line in zip(remarks, lines, strict=True))


def test_comparisons_are_added_and_a_single_subject_has_no_side():
    both = {"left": comparisons([0.9, 0.9, -0.9, 0.9]), "right": comparisons([0.9, 0.9, -0.9, 0.9])}
    assert combine(both)["a"]["chirality"].values[1] == pytest.approx(2 * 0.81 / np.sqrt(2))
    chirality, names, remarks = mirrored_subjects({"left": {}, "right": {}})
    assert (chirality, names) == ({}, [])
    assert "needs at least two shapes" in remarks[0]
