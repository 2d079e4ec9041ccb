"""Faulty input (docs/faults.md).

In Python, in ``s4a check`` and in ``s4a run`` the outcome that is promised.
"""

import contextlib
import inspect
import io
import re

import numpy as np
import pytest
from faults import shapes as faulty
from faults import table
from paths import ROOT, TESTS

import s4a
from s4a import analyse, cli, insert, open_study, read_shapes
from s4a.geometry.mesh import as_dataset, euler_characteristic
from s4a.input import plausibility
from s4a.show.page import study_html
from s4a.study.quality_control import flagged
from s4a.study.report import tied

SMALL = {"n_coarse": 100, "k_init": 6, "k": 10, "step": 4, "refine": "intrinsic"}
FLAGS = [
    part for name, value in SMALL.items() for part in ("--" + name.replace("_", "-"), str(value))
]
BY_NAME = {one.shape: one for one in faulty.FAULTS}


def printed(*arguments):
    """The exit code of a command and what it wrote, in one line."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = cli.main(list(arguments))
    return code, re.sub(
        r"(?<=\w)- (?=\w)", "-", re.sub(r"\s+", " ", out.getvalue())
    )  # wrapped at hyphens too


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return faulty.make(tmp_path_factory.mktemp("faults") / "meshes")


@pytest.fixture(scope="session")
def checked_folder(folder):
    """What ``s4a check`` gives and prints, and the report of the call of Python in it."""
    reports, defaults = [], inspect.signature(read_shapes).parameters

    def read(paths, **options):
        assert paths == [str(folder)]
        assert all(options[name] == defaults[name].default for name in options)
        reports.append(read_shapes(paths, **options))
        return reports[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(s4a, "read_shapes", read)
        checked = printed("check", str(folder))
    (tree,) = reports
    return checked, tree["report"].to_dataset()


@pytest.fixture(scope="session")
def checked(checked_folder):
    return checked_folder[0]


@pytest.fixture(scope="session")
def in_python(checked_folder):
    return checked_folder[1]


@pytest.fixture(scope="session")
def ran(folder, tmp_path_factory):
    """What a run over all wrote, and its study."""
    out = tmp_path_factory.mktemp("out") / "study"
    more = "--n-pairs 80 --alignment given --template good_0 --n-jobs 1".split()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plausibility.pick_references, "__defaults__", (5,))
        code, text = printed("run", str(folder), "--out", str(out), *FLAGS, *more)
    full = re.sub(r"\s+", " ", (out / "report.txt").read_text(encoding="utf-8"))
    with open_study(out) as study:
        yield code, text + re.sub(r"(?<=\w)- (?=\w)", "-", full), study


def message(report, one):
    return (
        report.attrs["remarks"]
        if one.where == "remarks"
        else report[one.where].sel(shape=one.shape).item()
    )


@pytest.mark.parametrize("name", BY_NAME)
def test_every_fault_has_its_outcome(name, in_python, checked, ran):
    one, in_run = BY_NAME[name], ran[2]["report"].to_dataset()
    silent = one.said in ("", "^$")
    for report in (in_python, in_run):
        if one.where == "remarks":
            assert name not in report["shape"].values
        else:
            row = report.sel(shape=name)
            # ten functions on 100 vertices register some shapes wrongly, which a run flags
            wrong = report is in_run and "registration" in row["flag_kinds"].item()
            assert row["status"].item() == ("flagged" if wrong else one.status)
        if not (silent and report is in_run):  # a run has other warnings
            assert re.search(one.said, message(report, one))
    used = one.status in ("ok", "repaired", "flagged")
    assert (name in ran[2]["registration"]["shape"].values) == used
    for _, text, *_ in (checked, ran):
        assert name in text or silent
        assert silent or re.search(one.said, text)


def test_a_run_over_all_faults_ends_with_ten_good_shapes(in_python, checked, ran):
    code, text, study = ran
    assert code == 0
    assert checked[0] == 1  # as shapes were excluded
    assert in_python.sel(shape=faulty.GOOD)["status"].values.tolist() == ["ok"] * 10
    assert in_python.sel(shape=faulty.GOOD)["warning"].values.tolist() == [""] * 10
    assert set(faulty.GOOD) <= set(study["registration"]["shape"].values)
    assert study["report"].sizes["shape"] == 10 + sum(
        one.where != "remarks" for one in faulty.FAULTS
    )
    for data in (
        study[stage].to_dataset() for stage in ("network", "latent", "registration", "pca")
    ):
        for name, variable in data.variables.items():
            if "cycle_error" not in name:  # a pair in no 3-cycle has none
                assert variable.dtype.kind != "f" or np.isfinite(variable.values).all(), name
    assert "genus 0: " in text
    assert "genus 1: handle" in text


def test_the_page_of_a_study_escapes_the_names_of_files(ran, no_pictures):
    html = study_html(ran[2].drop_nodes("pca"))  # which has no names of files, and many pictures
    assert "<img src=x" not in html
    assert "&lt;img src=x" in html


def test_the_documentation_is_current(in_python):
    assert table.PAGE.read_text(encoding="utf-8") == table.page(table.sentences(in_python))


def test_every_other_row_of_the_table_has_its_test():
    for file, test in table.proofs():
        result = [*TESTS.rglob(file), *(ROOT / "morphometrics/tests").glob(file)]
        texts = [path.read_text(encoding="utf-8") for path in result]
        assert any(f"def {test}(" in text for text in texts), (file, test)


# rows that need more than a file


def test_strict_excludes_what_would_be_repaired(tmp_path):
    faulty.nan(tmp_path / "nan.ply")
    faulty.far(tmp_path / "far.obj")
    report = read_shapes(tmp_path, strict=True)["report"].to_dataset()
    assert report["status"].values.tolist() == ["ok", "excluded"]
    assert (
        "2 of 300 vertices are not finite; strict=False removes them" in report["reason"].values[1]
    )


def test_holes_are_closed_on_demand(tmp_path):
    faulty.nan(tmp_path / "nan.ply")
    tree = read_shapes(tmp_path, close_holes=True)
    mesh = tree["original/nan"].to_dataset()
    assert mesh.attrs["holes"] == 0
    assert mesh.attrs["closed_holes"] == 2
    assert euler_characteristic(mesh["corner_vertex"].values) == 2
    assert mesh.sizes["vertex"] == 300  # two went, and one came for each hole
    X = faulty.shape(5)[0]
    kept = slice(298)
    assert np.allclose(mesh["position"][kept], X[mesh["file_vertex"][kept]], atol=1e-4)
    assert "2 holes closed" in tree["report"]["reason"].item()


def collection(factor=1.0, offset=0.0):
    return {f"shape_{i}": (factor * X + offset, T) for i in range(3) for X, T in [faulty.shape(i)]}


OPTIONS = SMALL | {"n_jobs": 1, "intersections": False}


@pytest.fixture(scope="module")
def reference():
    """The study of three good shapes."""
    return analyse(collection(), **OPTIONS)


def test_the_study_does_not_depend_on_position_and_unit(reference):
    factor = 1e-9
    result = analyse(collection(factor, 1e6 * factor), **OPTIONS)
    one, other = (t["registration"].to_dataset() for t in (reference, result))
    assert one.attrs["template"] == other.attrs["template"]
    assert np.allclose(other["displacement"] / factor, one["displacement"], atol=1e-3)
    assert np.allclose(result["pca"]["score"], reference["pca"]["score"], atol=1e-3)
    warnings = [t["report"]["warning"].values.tolist() for t in (reference, result)]
    assert warnings[0] == warnings[1]


def test_a_suspect_new_shape_is_reported(reference):
    X, T = faulty.shape(5)
    given = {
        "good": X,
        "metres": X / 1000,
        "mirrored": X * [-1, 1, 1],
        "upside_down": X * [1, -1, -1],
    }
    result = insert(reference, {name: (Y, T) for name, Y in given.items()})
    report = result["report"]
    names = report["shape"].values.tolist()
    warning = dict(zip(names, report["warning"].values, strict=True))
    assert warning["good"] == ""
    assert "near 10^-3: are its coordinates in another unit" in warning["metres"]
    assert "fits as a mirror image" in warning["mirrored"]
    assert warning["upside_down"] == ""  # the alignment turns it
    assert "near 10" not in warning["mirrored"]
    assert np.ptp(result["original/metres"]["position"].values) == pytest.approx(np.ptp(X) / 1000)
    assert (
        insert(reference, {"mirrored": (given["mirrored"], T)}, compare=False)["report"]["warning"]
        == ""
    ).all()


def test_files_of_different_units_are_reported():
    meshes = {name: as_dataset(*mesh) for name, mesh in collection().items()}
    meshes["shape_0"].attrs |= {"unit": "mm", "coordinate_system": "RAS"}
    meshes["shape_1"].attrs |= {"unit": "m", "coordinate_system": "LPS"}
    report = read_shapes(meshes)["report"].to_dataset()
    assert report["coordinate_system"].values[:3].tolist() == ["RAS, mm", "LPS, m", "unknown"]
    assert report["reason"].values[1] == "converted from LPS, m to RAS, mm"


def test_of_two_mirror_images_none_is_the_right_one():
    X, T = faulty.shape()
    report = read_shapes({"a": (X, T), "b": (X * [1, -1, 1], T)})["report"].to_dataset()
    assert report["warning"].values.tolist() == ["", ""]
    assert (
        "mirror images of each other, by ICP: a and b; none was changed" in report.attrs["remarks"]
    )


def test_a_suspect_reference_does_not_flag_the_others():
    X, T = faulty.shape()
    shapes = {f"s{i}": (Y, S) for i in range(4) for Y, S in [faulty.shape(i)]}
    reference = sorted(shapes, key=lambda n: as_area(*shapes[n]))[1]  # the one with the median area
    X, T = shapes[reference]
    shapes[reference] = X * [-1, 1, 1], T
    warning = read_shapes(shapes)["report"]["warning"]
    assert "fits as a mirror image" in warning.sel(shape=reference).item()
    assert (warning.drop_sel(shape=reference) == "").all()


def as_area(X, T):
    return np.linalg.norm(np.cross(X[T[:, 1]] - X[T[:, 0]], X[T[:, 2]] - X[T[:, 0]]), axis=1).sum()


def test_reduced_numbers_are_reported():
    meshes = {
        name: faulty.shape(i, n) for i, (name, n) in enumerate({"a": 60, "b": 20, "c": 60}.items())
    }
    report = analyse(meshes, **SMALL | {"k": 40}, n_jobs=1, intersections=False)["report"]
    assert "all 1 pairs of 2 shapes are used (n_pairs = 500)" in report.attrs["remarks"]
    assert report["status"].sel(shape="b").item() == "excluded"
    why = report["reason"].sel(shape="b").item()
    assert re.search(r"only 1\d eigenfunctions, but 2 of 3 shapes have 40 or more", why)
    assert (
        "all vertices used, as there are fewer than n_coarse = 100"
        in report["reason"].sel(shape="a").item()
    )


def test_a_triangle_and_a_tetrahedron_end_no_run():
    X = np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]])
    solid = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    tiny = {"triangle": (X[:3], [[0, 1, 2]]), "tetrahedron": (X, solid)}
    study = analyse(collection() | tiny, **OPTIONS)
    assert set(collection()) <= set(study["registration"]["shape"].values.tolist())
    assert np.isfinite(study["pca"]["score"]).all()


def test_a_wrong_registration_is_flagged():
    wrong, remarks = flagged({"a": 0.0, "b": 0.02, "c": 0.1})
    assert list(wrong) == ["c"]
    assert [(one.kind, one.flagged) for one in wrong["c"]] == [("registration", True)]
    assert "wrong (score 0.100" in wrong["c"][0].words
    assert remarks == []
    assert flagged({"a": 0.0, "b": 0.12, "c": 0.1})[0] == {}
    coarse = dict.fromkeys("abc", 300)  # below twice the vertex spacing
    assert flagged({"a": 0.0, "b": 0.02, "c": 0.1}, n=coarse) == ({}, [])


def test_two_shapes_share_the_median_with_a_remark():
    assert (
        "the median is not unique: a, b are equally near" in tied(["a", "b"], [0.1, 0.1 + 1e-12])[0]
    )
    assert tied(["a", "b", "c"], [0.1, 0.2, 0.3]) == []
