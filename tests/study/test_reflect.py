"""A run mirrors shapes given by name, or detected automatically."""

import numpy as np
import pytest
from faults import shapes as faulty

import s4a
from s4a import analyse, cli, open_study, verify
from s4a.analysis.export import write_registered
from s4a.show.page import study_html

OPTIONS = {"n_coarse": 150, "k_init": 8, "k": 15, "n_jobs": 1, "intersections": False}
LEFT = ["s1", "s3"]


@pytest.fixture(scope="module")
def right():
    """Clearly chiral shapes."""
    return {f"s{i}": faulty.shape(300 + i) for i in range(5)}


@pytest.fixture(scope="module")
def mixed(right):
    """The same, two of them mirrored."""
    return right | {name: (right[name][0] * [-1, 1, 1], right[name][1][:, ::-1]) for name in LEFT}


@pytest.fixture(scope="module")
def folder(mixed, tmp_path_factory):
    """The folder of a study with ``reflect="auto"``."""
    folder = tmp_path_factory.mktemp("reflect") / "study"
    analyse(mixed, store=folder, reflect="auto", **OPTIONS).close()
    return folder


def test_the_study_of_left_and_right_shapes_is_that_of_right_ones(right, folder, no_pictures):
    alone = analyse(right, **OPTIONS)
    with open_study(folder) as result:
        assert result["pca"].to_dataset().drop_attrs().equals(alone["pca"].to_dataset())
        report = result["report"].to_dataset()
        assert report["shape"].values[report["reflected"].values].tolist() == LEFT
        assert set(report["status"].values) == {"ok"}
        for name in LEFT:
            assert result["original"][name].attrs["reflected"] == 1
            assert "mirrored" in report["reason"].sel(shape=name).item()
        chirality = result["report"]["mean_chirality"]
        assert (chirality.sel(shape=LEFT) < -0.5).all()
        assert (chirality.drop_sel(shape=LEFT) > 0.5).all()
        assert "mirrored by reflect=" in study_html(result)


def test_a_finished_study_is_not_computed_again_and_holds(mixed, folder):
    kept = sorted(folder.glob("*/*.nc"))
    before = {path: path.stat().st_mtime_ns for path in kept}
    analyse(mixed, store=folder, reflect="auto", **OPTIONS).close()
    assert {path: path.stat().st_mtime_ns for path in kept} == before
    assert set(verify(folder)["state"].values.tolist()) == {"whole"}


def test_without_mirroring_left_shapes_are_flagged_and_the_report_has_no_column(mixed, study):
    assert "reflected" not in study["report"]
    report = s4a.read_shapes(mixed, intersections=False)["report"].to_dataset()
    assert report["shape"].values[report["status"].values == "flagged"].tolist() == LEFT
    assert "reflect= mirrors it" in report["warning"].sel(shape="s1").item()


def test_the_command_takes_a_column_of_the_table(mixed, tmp_path, capsys):
    files = tmp_path / "meshes"
    files.mkdir()
    for name in ("s0", *LEFT):
        s4a.write_mesh(files / f"{name}.ply", *mixed[name])
    table = tmp_path / "sides.csv"
    rows = [f"{name},{'left' if name in LEFT else 'right'}" for name in ("s0", *LEFT)]
    table.write_text("\n".join(["shape,side", *rows]))
    flags = [f"--{k.replace('_', '-')}={v}" for k, v in OPTIONS.items() if k != "intersections"]
    command = ["run", str(files), "--out", str(tmp_path / "study"), *flags, "--no-intersections"]
    assert cli.main([*command, "--table", str(table), "--reflect", "side=left"]) == 0
    with open_study(tmp_path / "study") as study:
        assert study["report"]["reflected"].values.tolist() == [False, True, True]
        assert "mean_chirality" not in study["report"]
        assert s4a.Options.from_report(study).reflect == "side=left"
    capsys.readouterr()
    assert cli.main([*command, "--reflect", "s9"]) == 2
    assert "'s9' is not a shape" in capsys.readouterr().err


# ---- new shapes in a study whose left ones were mirrored


@pytest.fixture(scope="module")
def new_mirrored():
    """Another right shape, and the left one that is its mirror image."""
    X, T = faulty.shape(310)
    return (X, T), (X * [-1, 1, 1], T[:, ::-1])


def test_a_new_shape_of_the_other_side_is_mirrored_on_request(new_mirrored, folder, tmp_path):
    right, left = new_mirrored
    with open_study(folder) as study:
        known = s4a.insert(study, {"s9": right}, n_jobs=1)
        for reflect in ("auto", ["s9"]):
            result = s4a.insert(study, {"s9": left}, reflect=reflect, n_jobs=1)
            position = result["registration"]["displacement"].values
            np.testing.assert_allclose(
                position, known["registration"]["displacement"].values, atol=1e-5
            )
            assert result["report"]["reflected"].values.tolist() == [1]
            assert result["report"]["status"].values.tolist() == ["ok"]
            assert "mirrored by reflect=" in result["report"]["reason"].values[0]
            assert result["original/s9"].attrs["reflected"] == 1
        stayed = s4a.insert(study, {"s9": right}, reflect="auto", n_jobs=1)
    assert stayed["report"]["reflected"].values.tolist() == [0]
    assert stayed["pca"]["score"].equals(known["pca"]["score"])
    write_registered(result, tmp_path, frame="shape")  # in the frame of its file
    points, _, _ = s4a.read_mesh(tmp_path / "s9.ply")
    assert np.linalg.norm(points.mean(0) - left[0].mean(0)) < 0.05 * np.ptp(left[0], axis=0).max()


def test_a_new_shape_of_the_other_side_is_flagged_by_default(new_mirrored, folder):
    with open_study(folder) as study:
        result = s4a.insert(study, {"s9": new_mirrored[1]}, n_jobs=1)
    report = result["report"].sel(shape="s9")
    assert report["status"].item() == "flagged"
    assert "reflect= mirrors it" in report["warning"].item()
    assert "reflected" not in result["report"]


def test_an_undetermined_side_is_reported_and_an_unknown_name_is_an_error(
    new_mirrored, folder, study, meshes, caplog
):
    with pytest.raises(ValueError, match=r"'s8' is not a new shape \(s9\)"):
        s4a.insert(open_study(folder), {"s9": new_mirrored[0]}, reflect="s8", n_jobs=1)
    brain = meshes["brain_02"]
    result = s4a.insert(study, {"again": brain}, reflect="auto", n_jobs=1)
    message = "reflect='auto' left again as it is: the shapes of the study are too symmetric"
    assert message in result["report"].attrs["remarks"]
    assert message in caplog.text
    assert result["report"]["reflected"].values.tolist() == [0]


def test_the_command_of_new_shapes_mirrors_them_too(new_mirrored, folder, tmp_path, capsys):
    s4a.write_mesh(tmp_path / "s9.ply", *new_mirrored[1])
    command = ["insert", str(folder), str(tmp_path / "s9.ply"), "--out", str(tmp_path / "out")]
    assert cli.main([*command, "--reflect", "s9", "--n-jobs", "1"]) == 0
    assert "mirror image" not in capsys.readouterr().out
    assert cli.main([*command, "--reflect", "s1", "--n-jobs", "1"]) == 2
    assert "'s1' is not a new shape (s9)" in capsys.readouterr().err
