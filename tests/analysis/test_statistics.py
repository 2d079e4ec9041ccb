"""Statistics (6.1): closed forms of a one-mode family, simulated groups.

And p values under the null hypothesis.
"""

import numpy as np
import pandas
import pytest
import xarray as xr
from PIL import Image
from scipy import stats
from scipy.integrate import quad
from sklearn.svm import SVC

from s4a import statistics, synthesize, synthetic, write_page
from s4a.analysis import model, permutation
from s4a.analysis.inputs import displacements_of, values_of
from s4a.analysis.permutation import Model
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method.pca import gram, gram_pca, pca, principal_components
from s4a.schema import dataset
from s4a.show.pictures import write_film
from s4a.widgets.modes import Modes

SCORES = np.array([-1.9, -1.1, -0.6, -0.2, 0.1, 0.4, 0.9, 1.2, 1.2])


def study_of(X, T, d, **subjects):
    """A finished study of given displacements (s, n, 3) of a template."""
    names = [f"shape_{i:02d}" for i in range(len(d))]
    mesh = (
        as_dataset(X, T, {"template": "shape_00"})
        .merge(dataset(displacement=d))
        .assign_coords(shape=names)
    )
    modes = pca(mesh, vertex_areas(X, T))
    table = xr.Dataset({n: ("shape", v) for n, v in subjects.items()}, {"shape": names})
    return xr.DataTree.from_dict({"registration": mesh, "pca": modes, "subjects": table})


@pytest.fixture(scope="module")
def family():
    """Ellipsoids that differ in one semi-axis, and the root mean square of the mode."""
    X, T = as_arrays(synthetic.ellipsoid(900))
    mode = X * [0, 0, 1]
    area = vertex_areas(X, T)
    return study_of(X, T, SCORES[:, None, None] * mode), np.sqrt(
        area @ mode[:, 2] ** 2 / area.sum()
    )


def smooth_noise(rng, u, s, size=0.1, waves=12):
    """Smooth random fields (s, n, 3) on points u of the unit sphere."""
    k, phase = rng.normal(0, 2.0, (waves, 3)), rng.uniform(0, 2 * np.pi, waves)
    return (
        size
        * np.einsum("swx,nw->snx", rng.normal(size=(s, waves, 3)), np.cos(u @ k.T + phase))
        / np.sqrt(waves)
    )


def test_a_mode_of_a_regression_explains_what_covariates_leave_of_its_variable(simulated):
    whole = simulated[0]
    _, d, _ = displacements_of(whole)
    rng = np.random.default_rng(0)
    z = rng.normal(size=len(d))
    x = z + 0.05 * rng.normal(size=len(d))
    X, T = as_arrays(whole["registration"].to_dataset())
    study = study_of(X, T, 0.001 * d + (x - z)[:, None, None] * X)
    fit = statistics.regression(study, x, covariates={"z": z}, n_permutations=9)
    assert fit.attrs["freed_deviation"] < 0.1 * fit.attrs["standard_deviation"]
    modes = statistics.regression_modes(study, fit)["pca"]
    assert 0.5 < modes["explained_variance_ratio"].item() <= 1


def test_the_smallest_p_knows_of_a_symmetric_variable_and_of_constants():
    assert Model(np.arange(4)).smallest_p == 2 / 24
    assert Model(np.array([0, 1, 2, 4])).smallest_p == 1 / 24
    x = permutation.indicators(list("aaabbb"))[1]
    assert Model(x, np.ones((6, 1))).smallest_p == Model(x).smallest_p == 0.1


def test_where_nothing_varies_a_test_of_vertices_finds_nothing():
    x = permutation.indicators(list("aaabbb"))[1]
    for z in (None, np.arange(6.0)[:, None]):
        d = np.full((6, 3, 1), 0.1) * np.array([1, 1, 1, 1, 1, 1 + 1e-15])[:, None, None]
        d[:, 2, 0] = [0, 0.1, 0, 3, 3.2, 3]
        share, p, _ = Model(x, z).vertex_test(d)
        assert share[:2].tolist() == [0, 0]
        assert p[:2].tolist() == [1, 1]
        assert share[2] > 0.5


def test_values_with_names_are_taken_by_name_in_whatever_order_they_come(family):
    study, _ = family
    names = study["registration"]["shape"].values
    by_name = xr.DataArray(SCORES, {"shape": names})[::-1]
    mixed = by_name.to_pandas().sample(frac=1, random_state=1)
    frame = pandas.DataFrame({"a": mixed, "b": mixed**2})
    known = SCORES, np.stack([SCORES, SCORES**2], axis=1)
    for given, expected in ((by_name, known[0]), (mixed, known[0]), (frame, known[1])):
        assert values_of(study, given, "age").tolist() == expected.tolist()
    rows = pandas.Series(SCORES, index=range(1, len(SCORES) + 1))  # an index of rows is no name
    assert values_of(study, rows, "age").tolist() == SCORES.tolist()
    with pytest.raises(ValueError, match="age needs a value for every shape; it lacks shape_00"):
        values_of(study, mixed.rename({"shape_00": "shape_0"}), "age")
    twice = pandas.concat([mixed, mixed[:1]])
    with pytest.raises(ValueError, match="one value for every shape; it has several for shape_0"):
        values_of(study, twice, "age")


@pytest.fixture(scope="module")
def simulated():
    """30 spheres with noise.

    In every other one a patch is pushed out.  Study, groups, patch, age.
    """
    rng = np.random.default_rng(3)
    u, T = as_arrays(synthetic.sphere(1200))
    group = np.tile(["control", "patient"], 15)
    bump = np.exp(8 * (u @ [0, 0.6, 0.8] - 1))
    age = rng.uniform(20, 80, 30)
    d = smooth_noise(rng, u, 30) + 0.35 * (group == "patient")[:, None, None] * bump[:, None] * u
    d += (age - 50)[:, None, None] / 60 * 0.3 * u * [1, 0, 0]
    return study_of(u, T, d, group=group, age=age), group, bump > 0.5, age


# the model


def test_a_one_mode_family_has_the_closed_form_of_every_measure(family):
    study, rms = family
    found = statistics.evaluate(study, n_samples=4000, n_points=200, n_surface=50)
    assert found.sizes["component"] == 1
    assert found["compactness"].values == pytest.approx(SCORES.var(ddof=1) * rms**2)
    assert found["compactness_error"].values == pytest.approx(
        np.sqrt(2 / 9) * SCORES.var(ddof=1) * rms**2
    )
    others = (SCORES.sum() - SCORES) / 8
    assert found.attrs["generalization_0"] == pytest.approx(np.abs(SCORES - others).mean() * rms)
    assert found["generalization"].values == pytest.approx(
        0, abs=1e-6
    )  # one mode describes each left-out shape
    mean, deviation = SCORES.mean(), SCORES.std(ddof=1)
    nearest = quad(
        lambda x: np.abs(x - SCORES).min() * stats.norm.pdf(x, mean, deviation),
        -8,
        8,
        limit=400,
        points=SCORES,
    )[0]
    error = found["specificity_error"].item()
    assert abs(found["specificity"].item() - nearest * rms) < 4 * error
    assert 0 < error < 0.05 * nearest * rms
    assert 0 < found["specificity_surface"].item() < nearest * rms
    assert found["generalization_surface"].values == pytest.approx(0, abs=1e-6)
    assert "optimistic" in found.attrs["correspondence"]


def test_left_out_shapes_are_reconstructed_as_by_a_model_of_the_others():
    rng = np.random.default_rng(0)
    d, area = rng.normal(size=(6, 30, 3)), rng.uniform(1, 2, 30)
    error, score = model.leave_one_out(gram(d, area))
    w = (area / area.sum())[:, None]
    for i in range(6):
        mean, deformation, deviation, _, _ = gram_pca(np.delete(d, i, axis=0), area)
        left = d[i] - mean
        for c in range(5):
            assert error[i, c] == pytest.approx(np.sqrt((w * left**2).sum()))
            if c < 4:
                own = (w * left * deformation[c]).sum() / deviation[c] ** 2
                assert abs(own) == pytest.approx(abs(score[i, c]))
                left = left - own * deformation[c]


def test_specificity_is_the_distance_between_the_fields():
    rng = np.random.default_rng(1)
    d, area = rng.normal(size=(5, 20, 3)), rng.uniform(1, 2, 20)
    K = gram(d - d.mean(0), area)
    distance, nearest, score = model.specificity(K, 7, rng)
    variance, V = principal_components(K)
    modes = np.einsum("sc,snx->cnx", V, d - d.mean(0)) / np.sqrt(4)
    w = (area / area.sum())[:, None]
    assert distance.shape == (len(variance), 7) == (4, 7)
    for c in range(4):
        drawn = d.mean(0) + np.einsum("pc,cnx->pnx", score[:, : c + 1], modes[: c + 1])
        distances = np.sqrt((w * (drawn[:, None] - d) ** 2).sum((2, 3)))
        assert distance[c] == pytest.approx(distances.min(1))
        assert (nearest[c] == distances.argmin(1)).all()


def test_only_components_above_chance_explain_more_than_permuted_coefficients():
    rng = np.random.default_rng(2)
    features = rng.normal(size=(20, 60))
    features[:, :30] += 3 * np.outer(rng.normal(size=20), rng.normal(size=30))
    variance = np.linalg.svd(features - features.mean(0), compute_uv=False) ** 2
    null = model.variance_baseline(features, 100, rng)
    assert null.sum(1) == pytest.approx(1)
    above = variance[:19] / variance.sum() > np.quantile(null, 0.95, axis=0)
    assert above[0]
    assert not above[1:].any()


def test_the_evaluation_of_many_modes_is_ordered(simulated):
    found = statistics.evaluate(
        simulated[0], n_samples=200, n_permutations=20, n_points=100, n_surface=5
    )
    assert (np.diff(found["compactness"]) > 0).all()
    left = found["generalization"].values
    assert np.isnan(left[-1])
    assert (np.diff(left[:-1]) <= 1e-12).all()
    assert left[0] < found.attrs["generalization_0"]
    assert (found["generalization_surface"].values[:-1] < left[:-1]).all()
    assert (found["specificity_surface"].values < found["specificity"].values).all()
    ratio, null = found["variance_ratio"].values, found["variance_ratio_null_95"].values
    assert ratio[0] > null[0]
    assert (found["variance_ratio_null"].values <= null + 1e-12).all()


def test_samples_have_the_drawn_scores(simulated):
    drawn = statistics.sample(simulated[0], 4, n_components=3, seed=1)
    assert drawn["score"].shape == (4, 3)
    assert set(drawn.children) == {f"sample_{i}" for i in range(1, 5)}
    template = (
        simulated[0]["registration"]["position"].values
        + simulated[0]["pca"]["mean_displacement"].values
    )
    moved = np.tensordot(drawn["score"].values[0], simulated[0]["pca"]["deformation"].values[:3], 1)
    assert drawn["sample_1"]["position"].values == pytest.approx(template + moved, abs=1e-6)
    with pytest.raises(ValueError, match="an integer of at most 29"):
        statistics.sample(simulated[0], 2, n_components=30)


# groups and variables


def test_simulated_groups_are_found_and_the_map_marks_the_patch(simulated):
    study, group, patch, _ = simulated
    whole = statistics.group_test(study, "group", covariates={"age": "age"}, n_permutations=999)
    assert whole["p_value"].item() == whole.attrs["smallest_p"] == 0.001
    assert whole.attrs["groups"] == "control: 15, patient: 15"
    found = statistics.group_map(study, group, covariates={"age": "age"})
    marked = found["p_family_wise"].values < 0.05
    dice = 2 * (marked & patch).sum() / (marked.sum() + patch.sum())
    assert dice > 0.8
    assert (found["p_false_discovery"].values[patch] < 0.05).mean() > 0.95
    top = int(found["explained_share"].values.argmax())
    assert patch[top]
    u = study["registration"]["position"].values
    assert found["effect"].values[top] @ u[top] == pytest.approx(0.35, abs=0.08)
    assert found["effect_size"].values[patch].min() > 1


def test_groups_without_a_difference_are_not_found(simulated):
    study, group, _, _ = simulated
    shuffled = np.random.default_rng(5).permutation(group)
    assert statistics.group_test(study, shuffled, n_permutations=199)["p_value"] > 0.02
    assert statistics.group_map(study, shuffled, n_permutations=199)["p_family_wise"].min() > 0.02


def test_a_continuous_variable_is_found_with_its_slope_and_its_shapes_move(simulated):
    study, group, _, age = simulated
    found = statistics.regression(
        study, "age", covariates={"group": (group == "patient").astype(float)}
    )
    assert found["p_value"].item() == 0.001
    u = study["registration"]["position"].values
    slope = found["effect"].values
    simulated_slope = 0.3 / 60 * u * [1, 0, 0]
    assert np.vdot(slope, simulated_slope) > 0.8 * np.linalg.norm(slope) * np.linalg.norm(
        simulated_slope
    )
    old, young = (statistics.predict(study, found, a)["position"].values for a in (80, 20))
    assert np.ptp(old[:, 0]) > np.ptp(young[:, 0]) + 0.3
    assert statistics.predict(study, found, age.mean())["position"].values == pytest.approx(
        u + study["registration"]["displacement"].mean("shape").values, abs=1e-6
    )


@pytest.mark.parametrize("with_covariates", [False, True])
def test_p_values_are_uniform_without_a_difference(with_covariates):
    p = []
    x = np.repeat([0.0, 1.0], [8, 10])
    for seed in range(100):
        rng = np.random.default_rng(seed)
        Z = rng.normal(size=(18, 2)) + x[:, None] if with_covariates else None
        scores = rng.standard_t(5, size=(18, 4)) @ rng.normal(size=(4, 4))
        scores += 0 if Z is None else 2 * Z[:, :1]
        p.append(Model(x, Z, n_permutations=99, seed=seed).test(scores)[1])
    assert stats.kstest(p, "uniform").pvalue > 0.05
    assert np.mean(np.array(p) <= 0.05) <= 0.11


def test_family_wise_p_values_keep_their_level():
    x = np.repeat([0.0, 1.0], 9)
    found = [
        Model(x, n_permutations=99, seed=seed).vertex_test(
            np.random.default_rng(seed).normal(size=(18, 60, 3))
        )
        for seed in range(100)
    ]
    smallest = np.array([p_max.min() for _, _, p_max in found])
    assert stats.kstest(smallest, "uniform").pvalue > 0.01
    assert 0.03 < np.mean([(p <= 0.05).mean() for _, p, _ in found]) < 0.07


@pytest.mark.parametrize("n, c", [(12, 5), (20, 8)])
def test_covariates_do_not_raise_the_family_wise_error(n, c):
    smallest = []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        d, x, Z = rng.normal(size=(n, 30, 3)), rng.normal(size=n), rng.normal(size=(n, c))
        p_max = Model(x, Z, n_permutations=99, seed=seed).vertex_test(d)[2]
        smallest.append(p_max.min())
    assert np.mean(np.array(smallest) <= 0.05) < 0.16  # four standard errors above 0.05


def test_the_statistics_are_those_of_the_textbook():
    rng = np.random.default_rng(4)
    d, x = rng.normal(size=(14, 5, 3)), np.repeat([0.0, 1.0], [6, 8])
    share, _, _ = Model(x, n_permutations=0).vertex_test(d)
    for v in range(5):
        a, b = d[:6, v], d[6:, v]
        S = (np.cov(a.T, bias=True) * 6 + np.cov(b.T, bias=True) * 8) / 12
        difference = b.mean(0) - a.mean(0)
        assert 12 * share[v] / (1 - share[v]) == pytest.approx(
            6 * 8 / 14 * difference @ np.linalg.solve(S, difference), rel=1e-4
        )
    one, _, _ = Model(x, n_permutations=0).vertex_test(d[..., :1])
    t = stats.ttest_ind(d[:6, :, 0], d[6:, :, 0]).statistic
    assert 12 * one / (1 - one) == pytest.approx(t**2, rel=1e-4)
    three = np.repeat(["a", "b", "c"], [4, 5, 5])
    F = stats.f_oneway(*(d[three == g, :, 0] for g in "abc")).statistic
    share, _, _ = Model(permutation.indicators(three)[1], n_permutations=0).vertex_test(d[..., :1])
    assert 11 / 2 * share / (1 - share) == pytest.approx(F, rel=1e-4)


def test_small_groups_are_refused_or_warned_about_and_the_smallest_p_is_reported(caplog):
    rng = np.random.default_rng(0)
    u, T = as_arrays(synthetic.sphere(200))
    study = study_of(u, T, smooth_noise(rng, u, 7))
    with pytest.raises(ValueError, match="each of at least 3 shapes; found a: 2, b: 5"):
        statistics.group_test(study, list("aabbbbb"))
    found = statistics.group_test(study, list("aaabbbb"), n_permutations=999)
    assert "under 10 shapes" in caplog.text
    assert found.attrs["smallest_p"] == pytest.approx(1 / 35)
    assert found["p_value"] >= 0.02
    with pytest.raises(ValueError, match="lacks shape_03"):
        statistics.group_test(study, {f"shape_{i:02d}": "a" for i in range(7) if i != 3})
    with pytest.raises(ValueError, match="needs one value for each of 7 shapes"):
        statistics.regression(study, np.arange(6))
    with pytest.raises(ValueError, match="the tested variable is a combination of the covariates"):
        statistics.regression(study, np.arange(7), covariates=2 * np.arange(7) + 1)
    with pytest.raises(ValueError, match="'age' needs a column of that name in /subjects"):
        statistics.regression(study, "age")
    with pytest.raises(ValueError, match="at least 4 shapes; found 3"):
        statistics.outliers(study_of(u, T, smooth_noise(rng, u, 3)))


@pytest.fixture(scope="module")
def twelve():
    """Twelve spheres with noise, and two groups of six."""
    u, T = as_arrays(synthetic.sphere(100))
    return study_of(u, T, smooth_noise(np.random.default_rng(1), u, 12)), list("ab" * 6)


@pytest.mark.parametrize(
    "variable, words",
    [
        (np.full(12, 0.1), "the tested variable is constant"),
        (1e9 + 1e-7 * np.arange(12), "the tested variable is constant"),
        (1e-300 * np.arange(1, 13), "between 1e-30 and 1e30; found 1.2e-299"),
        ([np.inf] + [1.0] * 11, "variable needs finite numbers; found infinite ones for shape_00"),
        ([np.nan] * 12, "at least 4 shapes with all values; found 0 of 12"),
        (np.array(["2020-01-01"] * 12, "M8[D]"), "found dates: give a date as a number"),
        (np.arange(12) * 1j, "found complex numbers"),
        (np.zeros((12, 2)), "one number for each shape"),
        (["31", "?", *map(str, range(10))], "1 of 12 cells are not .shape_01: '\\?'"),
    ],
)
def test_a_variable_of_no_use_is_refused_with_what_to_do(variable, words, twelve):
    with pytest.raises(ValueError, match=words):
        statistics.regression(twelve[0], variable, n_permutations=9)


def test_neither_unit_nor_origin_of_a_variable_changes_its_test(twelve):
    age = np.random.default_rng(2).uniform(20, 80, 12)
    one, other = (
        statistics.regression(twelve[0], x, covariates=1e-200 * age**2, n_permutations=19)
        for x in (age, 1e9 + 1e-3 * age)
    )
    assert other["statistic"].item() == pytest.approx(one["statistic"].item(), rel=1e-4)
    assert other["p_family_wise"].values == pytest.approx(one["p_family_wise"].values)
    assert 1e-3 * other["effect"].values == pytest.approx(one["effect"].values, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize(
    "covariate, words",
    [
        (["31,5", *(f"4{i},1" for i in range(11))], "a decimal point and without unit, and NA"),
        ([f"s{i}" for i in range(12)], "it names shapes, not groups"),
        ([f"2020-01-0{1 + i % 3}" for i in range(12)], "has dates, such as 2020-01-01"),
        ([0, 1] * 6, "the tested variable is a combination of the covariates"),
        (np.random.default_rng(0).normal(size=(12, 11)), "11 covariates.*use 14 shapes"),
    ],
)
def test_a_covariate_of_no_use_is_refused_with_what_to_do(covariate, words, twelve):
    with pytest.raises(ValueError, match=words):
        statistics.group_test(*twelve, covariates={"it": covariate}, n_permutations=9)


def test_a_code_of_a_missing_value_is_refused_in_whatever_form_the_values_come(twelve):
    study, group = twelve
    names = study["registration"]["shape"].values.tolist()
    values = [31 + i * i % 7 if i != 3 else -999 for i in range(12)]
    series = pandas.Series(values, names)
    with_table = study.copy()
    with_table["subjects"] = xr.Dataset({"age": ("shape", values)}, {"shape": names})
    forms = [values, dict(zip(names, values, strict=True)), series, "age"]
    forms += [pandas.DataFrame({"age": series}), xr.DataArray(values, {"shape": names})]
    for given in forms:
        with pytest.raises(ValueError, match="-999 of shape_03 is a code of a missing value"):
            statistics.group_test(with_table, group, covariates={"it": given})
        with pytest.raises(ValueError, match="-999 of shape_03 is a code of a missing value"):
            statistics.regression(with_table, given)
    group = [*group[:2], f"{group[2]}\u200b", *group[3:]]
    for test in (statistics.group_test, statistics.group_map, statistics.classify):
        with pytest.raises(ValueError, match=r"group: .*u200b.* \(shape_02\) look alike"):
            test(study, group)


def test_collinear_covariates_are_reported_and_a_variable_that_they_determine_is_refused(
    twelve, caplog
):
    study, group = twelve
    rng = np.random.default_rng(0)
    age, noise = rng.uniform(20, 80, 12), rng.normal(size=12)
    statistics.group_test(study, group, covariates={"age": age, "other": noise}, n_permutations=9)
    assert "inflation" not in caplog.text
    for size in (1e-4, 1, 20):
        other = {"years": age, "months": 12 * age + size * noise}
        statistics.group_test(study, group, covariates=other, n_permutations=9)
        assert "'months' is nearly a linear combination of covariate 'years'" in caplog.text
        caplog.clear()
    with pytest.raises(ValueError, match=r"a combination of the covariates \(variance inflat"):
        statistics.regression(study, age, covariates=age + 1e-4 * noise, n_permutations=9)
    statistics.regression(study, age, covariates=age + 2 * noise, n_permutations=9)
    assert "the covariates explain most of the tested variable (variance inflation" in caplog.text
    caplog.clear()
    sites = np.repeat(list("abcd"), [1, 4, 4, 3])
    statistics.group_test(study, group, covariates={"site": sites}, n_permutations=9)
    assert "inflation" not in caplog.text


def test_names_of_covariates_may_be_separated_by_commas(twelve):
    study, group = twelve
    names, rng = study["registration"]["shape"].values, np.random.default_rng(0)
    columns = {name: ("shape", rng.normal(size=12)) for name in ("age", "size", "a,b")}
    study = study.copy()
    study["subjects"] = xr.Dataset(columns, {"shape": names})
    for words in ("age,size", ["age, size"], ["age", "size,"], ["age", "size"]):
        test = statistics.group_test(study, group, covariates=words, n_permutations=9)
        assert test.attrs["covariates"] == "covariate 'age', covariate 'size'"
    test = statistics.group_test(study, group, covariates="a,b", n_permutations=9)
    assert test.attrs["covariates"] == "covariate 'a,b'"


def test_the_handling_of_covariates_is_reported(twelve, caplog):
    study, group = twelve
    size = np.arange(12) ** 2
    given = {"sex": [0, 0, 1, 1] * 3, "site": list("xxyyzz") * 2, "size": size}
    found = statistics.group_test(
        study, group, covariates=given | {"double": 2 * size + 1, "one": [1.0] * 12}
    )
    assert "'double' is a linear combination of covariate 'size'" in caplog.text
    assert "covariate 'one' is constant and changes nothing" in caplog.text
    alone = statistics.group_test(study, group, covariates=given)
    assert found["p_value"] == alone["p_value"]
    assert alone.attrs["covariates"] == (
        "covariate 'sex', covariate 'site' as indicators of y, z against x, covariate 'size'"
    )


def test_a_covariate_that_numbers_the_shapes_is_reported(twelve, caplog):
    study, group = twelve
    rng = np.random.default_rng(0)
    given = {
        "order": 1 + rng.permutation(12),
        "Subject_ID": 1000 + 7 * np.arange(12),
        "age": [31, 44, 52, 23, 38, 61, 47, 35, 29, 58, 42, 66],
        "score": np.arange(12) ** 2 / 7,
        "site id": [1, 2, 3] * 4,
    }
    statistics.group_test(study, group, covariates=given, n_permutations=9)
    words = " has a different integer"
    columns = [line.partition(words)[0] for line in caplog.messages if words in line]
    assert columns == ["covariate 'order'", "covariate 'Subject_ID'"]
    assert "for each shape, 1000 to 1077: omit it if it only numbers the shapes" in caplog.text


@pytest.mark.parametrize("missing", ["NA", "n/a", "-", "", "nan", None, float("nan")])
def test_a_missing_text_is_no_group(missing, twelve, caplog):
    study, group = twelve
    found = statistics.group_test(study, [missing, *group[1:11], missing], n_permutations=9)
    assert found.attrs["groups"] == "a: 5, b: 5"
    assert found.attrs["left_out"] == "shape_00, shape_11"
    assert "no value for 2 of 12 shapes" in caplog.text


def test_where_few_permutations_are_different_p_is_exact():
    rng = np.random.default_rng(0)
    x = np.repeat([0.0, 1.0], 3)
    d = rng.normal(size=(6, 4, 1)) + 9 * x[:, None, None]
    t = abs(stats.ttest_ind(d[:3], d[3:]).statistic[:, 0])
    splits = [[i, j, k] for i in range(6) for j in range(i) for k in range(j)]
    others = [abs(stats.ttest_ind(d[s], np.delete(d, s, axis=0)).statistic[:, 0]) for s in splits]
    _, p, _ = Model(x).vertex_test(d)
    assert p == pytest.approx((np.array(others) >= t - 1e-6).mean(0))
    assert p.min() == Model(x).smallest_p == pytest.approx(0.1)
    assert Model(x).test(d[:, :, 0])[1] == pytest.approx(0.1)
    many, n = Model(x, np.array([0, 1, 0, 1, 0, 1.0])).rearrangements()
    assert len({tuple(order) for order in many}) == n == 720 / 4 - 1


def test_a_test_that_can_find_nothing_says_so(twelve, caplog):
    study = twelve[0].isel(shape=slice(6))
    found = statistics.group_test(study, list("aaabbb"))
    assert (found.attrs["permutations"], found.attrs["smallest_p"]) == (19, 0.1)
    assert "6 shapes allow no p value below 0.1" in caplog.text
    with pytest.raises(ValueError, match=r"4 shapes are too few .* of='normal'"):
        statistics.regression(study.isel(shape=slice(4)), [1, 2, 4, 8])


@pytest.mark.parametrize("n", [-1, 0, 10**22])
def test_a_number_of_permutations_that_makes_no_test_is_refused(n, twelve):
    for test in (statistics.group_test, statistics.group_map, statistics.classify):
        with pytest.raises(ValueError, match="n_permutations must be an integer of at"):
            test(*twelve, n_permutations=n)


def test_statistics_of_shapes_that_are_equal_or_not_finite_say_so(twelve):
    study = twelve[0]
    d = study["registration"]["displacement"]
    for values, words in (
        (0 * d, "shapes that differ; all displacements are equal"),
        (d.where(d["shape"] != "shape_04"), "finite displacements; .*: shape_04"),
    ):
        registration = study["registration"].to_dataset().assign(displacement=values)
        other = xr.DataTree.from_dict({"registration": registration})
        for function in (statistics.evaluate, statistics.outliers):
            with pytest.raises(ValueError, match=words):
                function(other)
        with pytest.raises(ValueError, match=words):
            statistics.group_map(other, twelve[1])


def test_groups_of_unequal_variance_are_reported_and_sign_flips_hold_the_level(caplog):
    x = np.repeat([0.0, 1.0], [15, 5])
    found = {"equal": [], "unequal": []}
    for seed in range(60):
        d = np.random.default_rng(seed).normal(size=(20, 30, 3)) * (1 + x)[:, None, None]
        for variances, smallest in found.items():
            options = {"n_permutations": 99, "seed": seed, "variances": variances}
            smallest.append(Model(x, **options).vertex_test(d)[2].min())
    assert np.mean(np.array(found["equal"]) <= 0.05) > 0.3
    assert np.mean(np.array(found["unequal"]) <= 0.05) < 0.16
    u, T = as_arrays(synthetic.sphere(100))
    noise = smooth_noise(np.random.default_rng(1), u, 20)
    study = study_of(u, T, noise * (1 + 2 * x)[:, None, None])
    statistics.group_test(study, x, n_permutations=19, variances="unequal")
    assert "variance differs" not in caplog.text
    statistics.group_test(study, x, n_permutations=19)
    assert "variance differs (0.0: " in caplog.text
    with pytest.raises(ValueError, match="variances must be one of 'equal', 'unequal'"):
        statistics.group_test(study, x, variances="welch")


# outliers and classes


def test_an_unusual_shape_and_an_extreme_one_are_outliers_and_the_others_are_not():
    rng = np.random.default_rng(7)
    u, T = as_arrays(synthetic.sphere(400))
    modes = smooth_noise(rng, u, 2)
    d = np.einsum("sc,cnx->snx", rng.normal(size=(24, 2)), modes) + smooth_noise(
        rng, u, 24, size=0.005
    )
    d[5] += smooth_noise(rng, u, 1, size=0.05)[0]  # not like the others
    d[9] = 6 * modes[0]  # like them, but far away
    found = statistics.outliers(study_of(u, T, d), n_components=2)
    marked = found["shape"].values[found["outlier"]].tolist()
    assert {"shape_05", "shape_09"} <= set(marked)
    assert len(marked) <= 3
    assert int(found["left_out_error"].values.argmax()) == 5
    assert int(found["mahalanobis"].values.argmax()) == 9


def test_distances_of_a_normal_population_have_uniform_p_values():
    rng = np.random.default_rng(8)
    u, T = as_arrays(synthetic.sphere(100))
    modes = smooth_noise(rng, u, 3)
    p = np.concatenate(
        [
            statistics.outliers(
                study_of(u, T, np.einsum("sc,cnx->snx", rng.normal(size=(15, 3)), modes)),
                n_components=3,
            )["outlier_p"].values
            for _ in range(20)
        ]
    )
    assert abs(np.mean(p) - 0.5) < 0.06
    assert np.mean(p < 0.05) < 0.1


def test_simulated_groups_are_classified_and_shuffled_ones_are_not(simulated):
    study, group, _, _ = simulated
    found = statistics.classify(study, group, n_permutations=19)
    assert found.attrs["balanced_accuracy"] > 0.85
    assert found["p_value"] == pytest.approx(0.05)
    svm = statistics.classify(study, "group", SVC(), n_folds=3, n_permutations=1)
    assert svm.sizes["fold"] == 3
    assert svm.attrs["balanced_accuracy"] > 0.8
    shuffled = [np.random.default_rng(seed).permutation(group) for seed in range(10)]
    by_chance = [
        statistics.classify(study, g, n_permutations=1).attrs["balanced_accuracy"] for g in shuffled
    ]
    assert 0.35 < np.mean(by_chance) < 0.6


def test_a_regression_is_a_mode_that_page_panel_and_animation_show(simulated, tmp_path):
    study, _, _, age = simulated
    fit = statistics.regression(study, "age", n_permutations=9)
    moving = statistics.regression_modes(study, fit, "age")
    assert moving["pca"]["score"].values[:, 0] == pytest.approx(
        (age - age.mean()) / age.std(ddof=1)
    )
    later = statistics.predict(study, fit, age.mean() + 1.5 * age.std(ddof=1))["position"].values
    assert synthesize(moving, [1.5])["position"].values == pytest.approx(later, abs=1e-5)
    assert 0.1 < moving["pca"]["explained_variance_ratio"].item() < 0.9
    panel = Modes(moving)
    panel.scores = [1.5]
    assert panel.vertices() == pytest.approx(later, abs=1e-5)
    panel.close()
    assert "mode 1" in write_page(moving, tmp_path / "page.html").read_text()
    path = write_film(moving, tmp_path / "age.gif", mode=None, n_frames=4, width=100)
    with Image.open(path) as picture:
        assert (picture.n_frames, picture.width) == (4, 100)
