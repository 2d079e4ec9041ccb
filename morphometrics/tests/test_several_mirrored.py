"""Runs over several structures take the mirror images of whole subjects, named or found."""

import numpy as np
import pytest
import xarray as xr
from s4a.study.structures import to_mirror

import s4a
from s4a import analyse, cli, open_study, write_mesh
from s4a.geometry.mesh import as_arrays, volume
from s4a.input.hands import mirror_image, seen_together, subjects_of_other_hand
from s4a.input.subjects import subjects as table_of
from s4a.schema import dataset
from s4a_morphometrics.synthetic import subjects

SMALL = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 6, "n_jobs": 1}
FLAGS = "--n-coarse 100 --k 10 --k-init 6 --n-pairs 6 --n-jobs 1".split()
ODD = ["subject_2", "subject_4"]
STATED = ("pose_rotation", "pose_translation", "level_share", "standard_deviation", "score")


def mirrored(of):
    """All structures of a subject, as in a scan that was mirrored."""
    return {name: mirror_image(mesh).drop_attrs() for name, mesh in of.items()}


@pytest.fixture(scope="module")
def right():
    """Four subjects, all of one hand."""
    return subjects(4, 200)


@pytest.fixture(scope="module")
def mixed(right):
    """The same, half of them mirrored."""
    return {name: mirrored(of) if name in ODD else of for name, of in right.items()}


@pytest.fixture(scope="module")
def alone(right):
    """The study of those that are all of one hand."""
    return analyse(right, **SMALL)


@pytest.fixture(scope="module")
def store(mixed, tmp_path_factory):
    """The study of the others, which found the mirrored ones itself."""
    folder = tmp_path_factory.mktemp("mirrored") / "study"
    analyse(mixed, store=folder, reflect="auto", **SMALL)
    return folder


def test_poses_and_modes_of_mirrored_subjects_are_those_of_the_subjects(alone, mixed, store):
    named = analyse(mixed, reflect=ODD, **SMALL)
    found = open_study(store)
    true = s4a.statistics.structures(alone, n_permutations=9)
    for study in (named, found):
        result = s4a.statistics.structures(study, n_permutations=9)
        for name in STATED:
            np.testing.assert_allclose(result[name], true[name], atol=1e-6, err_msg=name)
        for side in ("left", "right"):
            modes = [one[f"structures/{side}/pca"]["deformation"] for one in (study, alone)]
            np.testing.assert_allclose(*modes, atol=1e-6)


def test_without_mirroring_half_of_the_subjects_the_study_is_another(alone, mixed):
    wrong = analyse(mixed, keep_doubtful=True, **SMALL)
    turns = [
        float(abs(s4a.statistics.structures(study, n_permutations=9)["pose_rotation"]).max())
        for study in (alone, wrong)
    ]
    assert turns[1] > 1.5 * turns[0]


def test_the_reports_say_who_was_mirrored_and_by_how_clear_a_hand(store):
    study = open_study(store)
    report = study["report"].to_dataset()
    assert report["shape"].values[report["reflected"].values.astype(bool)].tolist() == ODD
    for name in ("left", "right"):
        part = study[f"structures/{name}"]
        of_part = part["report"].to_dataset()
        assert of_part["shape"].values[of_part["reflected"].values.astype(bool)].tolist() == ODD
        hand = of_part["handedness"]
        assert (hand.sel(shape=ODD) < -1).all()
        assert (hand.drop_sel(shape=ODD) > 1).all()
        assert part["original"][ODD[0]].attrs["reflected"] == 1
        assert "mirrored, as reflect= says" in of_part["reason"].sel(shape=ODD[0]).item()
        assert (s4a.verify(store / "structures" / name)["state"] == "whole").all()


def test_a_finished_study_with_mirrored_subjects_is_not_computed_again(mixed, store):
    made = {path: path.stat().st_mtime_ns for path in store.rglob("structures/*/*/*.nc")}
    analyse(mixed, store=store, reflect="auto", **SMALL)
    assert made == {path: path.stat().st_mtime_ns for path in store.rglob("structures/*/*/*.nc")}


def test_the_command_mirrors_the_subjects_that_a_column_names(alone, mixed, tmp_path, capsys):
    lines = ["shape,subject,structure,side"]
    for i, (subject, of) in enumerate(mixed.items()):
        for name, mesh in of.items():
            path = tmp_path / f"scan_{name}_{i}.ply"
            write_mesh(path, mesh["position"].values, mesh["corner_vertex"].values)
            side = "left" if subject in ODD else "right"
            lines.append(f"{path.name},{subject},{name},{side}")
    table = tmp_path / "table.csv"
    table.write_text("\n".join(lines) + "\n")
    words = ["run", str(tmp_path), "--table", str(table), "--out", str(tmp_path / "study"), *FLAGS]
    assert cli.main([*words, "--reflect", "side=left"]) == 0
    study = open_study(tmp_path / "study")
    assert study["report"]["reflected"].sel(shape=ODD).all()
    found, true = (s4a.statistics.structures(one, n_permutations=9) for one in (study, alone))
    np.testing.assert_allclose(found["pose_translation"], true["pose_translation"], atol=0.05)
    capsys.readouterr()
    assert cli.main([*words, "--reflect", "structure=left"]) == 2
    said = capsys.readouterr().err
    assert "need one value in the column 'structure'; subject_1 has 'left' (left)" in said
    assert "Structures of both sides as one kind are a study of one structure" in said
    assert cli.main([*words, "--reflect", "scan_left_0"]) == 2
    assert "names 'scan_left_0', none of the subjects (subject_1, " in capsys.readouterr().err


def test_label_volumes_of_mirrored_scans_are_mirrored_with_all_their_structures(tmp_path):
    import nibabel

    grid = np.indices((24, 14, 14)).transpose(1, 2, 3, 0)
    rng = np.random.default_rng(0)
    for name in "abc":
        labels = np.zeros(grid.shape[:3], np.uint8)
        for value, x in ((1, 6.5), (2, 17.5)):
            axes = rng.uniform([4.5, 3.4, 2.6], [5, 3.8, 3])
            labels[(((grid - [x, 6.5, 6.5]) / axes) ** 2).sum(-1) < 1] = value
        affine = np.diag([-1 if name == "c" else 1, 1, 1, 1])
        nibabel.Nifti1Image(labels, affine).to_filename(tmp_path / f"{name}.nii.gz")
    out = tmp_path / "study"
    words = ["run", *map(str, sorted(tmp_path.glob("*.nii.gz"))), "--out", str(out), *FLAGS]
    words += ["--structures", "front=1", "back=2", "--keep-doubtful"]
    assert cli.main([*words, "--reflect", "c"]) == 0
    study = open_study(out)
    assert study["report"]["reflected"].values.astype(bool).tolist() == [False, False, True]
    for name, x in (("front", 6.5), ("back", 17.5)):
        for one in "abc":
            mesh = study[f"structures/{name}/original/{one}"]
            assert mesh["position"][:, 0].mean().item() == pytest.approx(x, abs=0.5)
            assert volume(*as_arrays(mesh)) > 0


def test_what_names_no_subject_or_all_is_refused():
    of = {"femur": ["a", "b"], "tibia": ["a", "b", "c"]}
    rows = {name: table_of({"side": ["l", "r", "l"][: len(n)]}, n) for name, n in of.items()}
    assert to_mirror("side=l", of, rows) == ["a", "c"]
    assert to_mirror("c", of, dict.fromkeys(of)) == ["c"]
    for reflect, words in [
        ("d", r"reflect names 'd', none of the subjects \(a, b, c\).*of the table \(side\)"),
        ("a,b,c", "mirrors all 3 subjects, which changes nothing among them"),
        ("side=m", "no shape has 'm' in the column 'side', which has l, r"),
        ("age=3", "needs a table with the column 'age'; it has side"),
    ]:
        with pytest.raises(ValueError, match=words):
            to_mirror(reflect, of, rows)
    assert to_mirror("a,b,c", of, rows, beside=True) == ["a", "b", "c"]
    rows["tibia"] = table_of({"side": ["r", "r", "l"]}, of["tibia"])
    with pytest.raises(ValueError, match=r"'side'; a has 'l' \(femur\), 'r' \(tibia\)"):
        to_mirror("side=l", of, rows)


def looks(hands):
    """Of a, b, c and d beside each other, where `hands` are the signs of their hands."""
    names = list("abcd")
    table = np.outer(hands, hands) + np.diag([np.nan] * 4)
    return {
        name: dataset(hand=row).assign_coords(reference=names)
        for name, row in zip(names, table, strict=True)
    }


def test_structures_say_together_of_which_hand_a_subject_is():
    both = {"left": looks([0.9, 0.9, -0.9, 0.9]), "right": looks([0.9, 0.9, -0.9, 0.9])}
    assert seen_together(both)["a"]["hand"].values[1] == pytest.approx(2 * 0.81 / np.sqrt(2))
    hand, names, told = subjects_of_other_hand(both)
    assert names == ["c"]
    assert told == []
    assert hand["c"] == pytest.approx(-1.1455, abs=1e-3)
    # one that is like its mirror image says nothing against the other
    unsure = both | {"left": looks([1.2, 1.2, -1.2, 1.2]), "right": looks([0.1] * 4)}
    assert subjects_of_other_hand(unsure)[1] == ["c"]
    del both["right"]["d"]  # missing there
    assert subjects_of_other_hand(both)[1] == ["c"]


def test_a_subject_with_structures_of_both_hands_stays_and_is_told():
    both = {"left": looks([1.2, 1.2, -1.2, 1.2]), "right": looks([1.2, 1.2, 1.2, 1.2])}
    _, names, (line,) = subjects_of_other_hand(both)
    assert names == []
    assert "c is of both hands (left -1.44, right +1.44) and stayed as it is: was one" in line


def test_subjects_of_both_hands_and_those_of_none_are_each_told_once():
    both = {"left": looks([1.8, 1.8, -1.8, 0.1]), "right": looks([1.8, 1.8, 1.8, 0.1])}
    hand, names, (unsure, odd) = subjects_of_other_hand(both)
    assert names == []
    assert abs(hand["c"]) < 0.5  # what its structures say together says nothing, either
    assert "cannot tell the hand of d, which stayed as it is: look at it, and name it" in unsure
    assert "c is of both hands (left -" in odd
    # where one structure says more than the other, too
    strong = {"left": looks([1.2, 1.2, -3, 1.2]), "right": looks([1.2, 1.2, 0.9, 1.2])}
    hand, names, (odd,) = subjects_of_other_hand(strong)
    assert (hand["c"] < -0.5, names) == (True, [])
    assert "c is of both hands (left -" in odd


def test_one_subject_alone_is_of_no_hand():
    hand, names, told = subjects_of_other_hand({"left": {}, "right": {}})
    assert (hand, names) == ({}, [])
    assert "needs two shapes or more" in told[0]


# ---- new subjects


@pytest.fixture(scope="module")
def study(store):
    return open_study(store).load()


@pytest.fixture(scope="module")
def newcomer():
    """Another subject."""
    return subjects(8, 200, seed=1)["subject_1"]


def test_a_new_subject_of_the_other_hand_is_mirrored_as_a_whole(study, newcomer):
    true = s4a.insert(study, {"new": newcomer}, n_jobs=1)
    assert "reflected" not in true["report"]
    found = s4a.statistics.structures(study, n_permutations=9)
    poses = s4a.statistics.structures_of_new(found, true)
    for reflect in ("new", ["new"], "auto"):
        inserted = s4a.insert(study, {"new": mirrored(newcomer)}, reflect=reflect, n_jobs=1)
        assert inserted["report"]["reflected"].values.tolist() == [True]
        for side in ("left", "right"):
            part = f"structures/{side}"
            assert inserted[f"{part}/report"]["reflected"].values.tolist() == [True]
            scores = [one[f"{part}/pca"]["score"] for one in (inserted, true)]
            np.testing.assert_allclose(*scores, atol=1e-5)
        again = s4a.statistics.structures_of_new(found, inserted)
        for name in ("pose_rotation", "pose_translation"):
            np.testing.assert_allclose(again[name], poses[name], atol=1e-5)


def test_a_new_subject_of_the_same_hand_stays_as_it_is(study, newcomer):
    inserted = s4a.insert(study, {"new": newcomer}, reflect="auto", n_jobs=1)
    assert inserted["report"]["reflected"].values.tolist() == [False]


def test_a_column_of_the_table_names_new_subjects(store, newcomer, tmp_path, capsys):
    lines, scans = ["shape,subject,structure,side"], tmp_path / "scans"
    scans.mkdir()
    for name, mesh in mirrored(newcomer).items():
        path = scans / f"new_{name}.ply"
        write_mesh(path, mesh["position"].values, mesh["corner_vertex"].values)
        lines.append(f"{path.name},new,{name},left")
    table, out = tmp_path / "new.csv", tmp_path / "out"
    table.write_text("\n".join(lines) + "\n")
    words = ["insert", str(store), str(scans), "--table", str(table), "--n-jobs", "1"]
    assert cli.main([*words, "--reflect", "side=left", "--out", str(out)]) == 0
    with xr.open_datatree(out / "inserted.nc") as inserted:
        assert inserted["report"]["reflected"].values.astype(bool).tolist() == [True]
    capsys.readouterr()
    assert cli.main([*words, "--reflect", "other", "--out", str(tmp_path / "none")]) == 2
    assert "reflect names 'other', none of the subjects (new)" in capsys.readouterr().err
