"""Flagged shapes (5.1) are registered and reported, without effect on the others."""

import numpy as np
import pytest
import xarray as xr

from s4a import analyse, explore, insert, latent_match, open_study, statistics, synthetic
from s4a.cli import tables
from s4a.geometry.mesh import as_arrays
from s4a.schema import dataset
from s4a.show.page import study_html
from s4a.study.quality_control import check_modes
from s4a.study.tree import excluded_of, left_out

OPTIONS = {"n_coarse": 200, "k_init": 8, "k": 20, "n_jobs": 1, "intersections": False}
TETRAHEDRON = 60 * np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
FLAGGED = ["a_metre", "z_inch"]


@pytest.fixture(scope="module")
def good():
    """Five brains as points and triangles."""
    tree = synthetic.brains(5, 400, seed=2)["original"]
    return {name: as_arrays(node.to_dataset()) for name, node in tree.children.items()}


@pytest.fixture(scope="module")
def mixed(good):
    """The brains, two of them in other units, and a tetrahedron."""
    (X, T), (Y, S) = good["brain_01"], good["brain_02"]
    return good | {"a_metre": (X / 1000, T), "z_inch": (Y / 25.4, S), "corner": TETRAHEDRON}


@pytest.fixture(scope="module")
def alone(good):
    """The study of the brains."""
    return analyse(good, **OPTIONS)


@pytest.fixture(scope="module")
def folder(mixed, tmp_path_factory):
    """The folder of the study of all."""
    folder = tmp_path_factory.mktemp("flagged") / "study"
    analyse(mixed, store=folder, **OPTIONS).close()
    return folder


@pytest.fixture(scope="module")
def study(folder):
    """The study of all, in memory."""
    with open_study(folder) as tree:
        return tree.load()


def results(study, stage):
    """A stage without the results of flagged shapes."""
    data = study[stage].to_dataset().drop_attrs(deep=False)
    return data.drop_vars(["score_excluded", "shape_excluded"], errors="ignore")


def test_the_results_of_the_others_are_bit_identical_to_those_without(alone, study):
    for stage in ("network", "latent", "pca"):
        assert results(study, stage).identical(results(alone, stage)), stage
    names = alone["registration"]["shape"].values
    registered = results(study, "registration").sel(shape=names)
    assert registered.identical(results(alone, "registration"))
    assert study["latent"].attrs["median"] == alone["latent"].attrs["median"]


def test_a_shape_with_too_few_eigenfunctions_is_excluded_and_takes_no_k_from_the_others(study):
    report = study["report"].to_dataset().sel(shape="corner")
    assert report["status"].item() == "excluded"
    assert "only 2 eigenfunctions, but 5 of 5 shapes have 20 or more" in report["reason"].item()
    assert study["network"]["fmap"].shape[1:] == (20, 20)


def test_flagged_shapes_are_registered_and_named(study):
    report = study["report"].to_dataset().sel(shape=FLAGGED)
    assert report["status"].values.tolist() == ["flagged"] * 2
    assert report["flag_kinds"].values.tolist() == ["unit"] * 2
    assert excluded_of(study["registration"].to_dataset()) == left_out(study) == FLAGGED
    registration = study["registration"].to_dataset().sel(shape=FLAGGED)
    assert np.isfinite(registration["displacement"]).all()
    assert (registration["registration_error"] < 0.06).all()
    assert list(study["latent"].children) == FLAGGED
    assert study["pca"]["score_excluded"].dims == ("shape_excluded", "component")
    match = latent_match(study, "a_metre", "brain_01", full=False)["match"]
    assert (match.values == np.arange(match.size)).mean() > 0.9  # the same surface, smaller


def test_a_finished_study_with_flagged_shapes_is_not_computed_again(folder, mixed):
    kept = [path for stage in ("latent", "registration") for path in (folder / stage).glob("*.nc")]
    before = {path: path.stat().st_mtime_ns for path in kept}
    analyse(mixed, store=folder, **OPTIONS).close()
    assert {path: path.stat().st_mtime_ns for path in kept} == before
    assert len(before) == len(FLAGGED) + 7


def test_statistics_exclude_flagged_shapes_and_name_them(alone, study, caplog):
    result = statistics.outliers(study)
    assert result.identical(statistics.outliers(alone))
    assert "flagged shapes are excluded: a_metre, z_inch" in caplog.text
    values = dict(zip(study["registration"]["shape"].values.tolist(), range(7), strict=True))
    test = statistics.regression(study, values, n_permutations=9)
    assert test.sizes["shape"] == 5
    assert test.attrs["left_out"] == "a_metre, z_inch"
    as_array = statistics.regression(study, list(values.values()), n_permutations=9)
    assert as_array["standard_score"].equals(test["standard_score"])


def test_flagged_shapes_are_included_on_request(folder, mixed, study):
    kept = statistics.with_flagged(study)
    assert kept["pca"].sizes["shape"] == statistics.outliers(kept).sizes["shape"] == 7
    assert left_out(kept) == []
    with analyse(mixed, store=folder, include_flagged=True, **OPTIONS) as again:
        assert results(again, "pca").identical(results(kept, "pca"))
        assert results(again, "latent").identical(results(study, "latent"))
    analyse(mixed, store=folder, **OPTIONS).close()


def test_a_run_can_stop_at_flagged_shapes_before_its_long_stages(mixed, tmp_path):
    with pytest.raises(
        ValueError, match=r"(?s)3 of 8 shapes are flagged.*3 unit: a_metre, corner, z_inch"
    ):
        analyse(mixed, store=tmp_path / "study", quality_control="stop", **OPTIONS)
    assert not (tmp_path / "study" / "coarse").exists()
    with pytest.raises(ValueError, match="leave out one of the two"):
        analyse(mixed, quality_control="stop", include_flagged=True, **OPTIONS)


def test_without_quality_control_all_shapes_are_in_everything_and_findings_are_warnings(
    mixed, tmp_path
):
    four = {name: mixed[name] for name in ("a_metre", "brain_01", "brain_02", "brain_03")}
    study = analyse(four, preset="paper", store=tmp_path, **OPTIONS)
    assert not list(tmp_path.glob("network/descriptor*")) + list(tmp_path.glob("network/compar*"))
    assert study["latent"]["shape"].values.tolist() == study["pca"]["shape"].values.tolist()
    assert study["latent"]["shape"].values.tolist() == list(four)
    report = study["report"].to_dataset().sel(shape="a_metre")
    assert "flagged" not in study["report"]["status"].values
    assert "unit" in report["warning_kinds"].item()
    assert "not detected" in study["report"].attrs["remarks"]
    assert excluded_of(study["registration"].to_dataset()) == left_out(study) == []
    assert statistics.with_flagged(study)["pca"]["score"].equals(study["pca"]["score"])


def test_a_flagged_shape_is_the_template_if_given_by_name(mixed):
    names = (*FLAGGED, "brain_03", "brain_04", "brain_05")
    study = analyse({name: mixed[name] for name in names}, template="a_metre", **OPTIONS)
    assert study["registration"].attrs["template"] == "a_metre"
    assert left_out(study) == ["z_inch"]
    assert "a_metre, given by name, is flagged" in study["report"].attrs["remarks"]


def test_if_fewer_than_two_shapes_are_not_flagged_all_are_used(good):
    (X, T), (Y, S), (Z, U) = list(good.values())[:3]
    study = analyse({"mm": (X, T), "m": (Y / 1000, S), "km": (Z / 1e6, U)}, **OPTIONS)
    assert study["latent"].sizes["shape"] == 3
    assert "flagged" not in study["report"]["status"].values


def test_a_new_shape_is_inserted_as_in_the_study_of_the_others(alone, study, good):
    new = {"new": good["brain_03"]}
    a, b = (insert(one, new) for one in (alone, study))
    assert a["pca"]["score"].equals(b["pca"]["score"])
    X, T = good["brain_03"]
    assert insert(study, {"new": (X / 1000, T)})["report"]["status"].item() == "flagged"


def test_panels_and_page_mark_flagged_shapes(study, no_pictures):
    tabs = explore(study)
    for title in tabs.tabs.titles:
        tabs[title]
    texts = [text for text, _ in tabs["Correspondence"].choice.options]
    assert {"a_metre (flagged)", "brain_02"} <= set(texts)
    assert "excluded (flagged): a_metre, z_inch" in tabs["Network"].facts.value
    tabs["Correspondence"].map.value = "low"
    tabs["Correspondence"].shape = "z_inch"
    assert not tabs["Correspondence"].failed
    tabs.close()
    html = study_html(study)
    assert "scale the files to the unit of the others" in html
    assert "z_inch (flagged)" in html


def test_the_summary_begins_with_what_to_decide_and_fits_on_a_screen(study):
    lines = tables.run_summary(study, again="s4a run d --out s").splitlines()
    assert lines[1].startswith("TO DECIDE: 2 of 8 shapes are flagged")
    assert lines[2].startswith("  2 unit  a_metre, z_inch  -> scale the files")
    assert any("s4a run d --out s --include-flagged" in line for line in lines)
    assert len(lines) < 40
    assert max(map(len, lines)) <= 100


def test_a_summary_of_many_flags_and_long_names_fits_on_a_screen(study):
    report = study["report"].to_dataset()
    n = 60
    names = [f"{i:03d}_{'of_a_very_long_name_' * 4}" for i in range(n)]
    kinds = ["unit", "size", "mirrored", "partial", "kind", "duplicate", "registration"]
    status = np.array(["flagged", "excluded", "ok"])[np.arange(n) % 3]
    reason = "cannot be read as mesh: one of PLY, OBJ, OFF, STL, VTK, GIFTI expected, found 7 bytes"
    many = report.isel(shape=np.arange(n) % 5).assign_coords(shape=names)
    many = many.assign(
        status=("shape", status),
        reason=("shape", [reason + 40 * " more" if one == "excluded" else "" for one in status]),
        path=("shape", [f"folder/{name}.ply" for name in names]),
        flag_kinds=("shape", [kinds[i % 7] if i % 3 == 0 else "" for i in range(n)]),
        warning_kinds=("shape", [["genus", "spacing", "dropped"][i % 3] for i in range(n)]),
    ).assign_attrs(remarks="\n".join(9 * ["a remark of many words " * 20]))
    other = study.copy()
    other["report"] = xr.DataTree(many)
    long = f"s4a run {' '.join(f'/data/scans/{name}.ply' for name in names)}"
    for again, shown in (("s4a run 'my scans' --out s" + 9 * " --k-init 12", 1), (long, 0)):
        text = tables.run_summary(other, again=again)
        assert "TO DECIDE: 20 of 60" in text
        assert "20 of 60 shapes cannot be used" in text
        assert all(f" {kind} " in text for kind in kinds)
        assert max(map(len, text.splitlines())) <= 100
        assert len(text.splitlines()) <= 50
        assert text.count("s4a run 'my scans'") == shown
        assert ("the same command with --include-flagged" in text) != shown
    assert {*names, *reason.split()} <= set(tables.report_table(many).split())


def modes_of(score):
    """Modes of shapes whose displacements are the rows of `score` (s, c)."""
    score = score - score.mean(0)
    U, S, _ = np.linalg.svd(score, full_matrices=False)
    s = len(score)
    modes = dataset(
        score=U * np.sqrt(s - 1),
        standard_deviation=S / np.sqrt(s - 1),
        explained_variance_ratio=S**2 / (S**2).sum(),
    )
    return modes.assign_coords(shape=[f"s{i}" for i in range(s)])


def test_a_shape_that_makes_a_mode_alone_and_a_near_copy_are_named():
    rng = np.random.default_rng(0)
    size = 0.03 * 0.9 ** np.arange(12)
    for s in (8, 12, 30):
        score = size * rng.normal(size=(s, 12))
        assert check_modes(modes_of(score), 1.0) == {}
        large, copy = score.copy(), score.copy()
        large[2] += 1.0
        (one,) = check_modes(modes_of(large), 1.0)["s2"]
        assert (one.kind, one.flagged) == ("influential", False)
        assert one.words.startswith("dominates mode 1: ")
        copy[5] = copy[1] + 5e-4 * rng.normal(size=12)
        assert [*check_modes(modes_of(copy), 1.0)] == ["s1"]
        assert "nearly the same shape as s5" in check_modes(modes_of(copy), 1.0)["s1"][0].words


def test_at_most_one_in_a_hundred_clean_collections_has_a_warning_of_its_modes():
    rng = np.random.default_rng(1)
    size = 0.03 * 0.7 ** np.arange(10)
    warned = [bool(check_modes(modes_of(size * rng.normal(size=(8, 10))), 1.0)) for _ in range(200)]
    assert sum(warned) <= 2
