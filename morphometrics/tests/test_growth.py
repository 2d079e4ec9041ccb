"""Repeated measures: random intercepts, change within subjects, trajectories."""

import logging
import shutil

import numpy as np
import pytest
from scipy import optimize
from simulated import TOP, noise, study_of, with_transferred

from s4a import cli, open_study, statistics
from s4a.analysis.permutation import Model
from s4a_morphometrics import growth
from s4a_morphometrics.longitudinal import random_intercepts, within_subjects

SUBJECT = np.repeat(np.arange(8), 3)
AGE = np.tile([0.0, 1, 2.5], 8) + 0.3 * SUBJECT


@pytest.fixture(scope="module")
def simulated():
    """Eight subjects of three visits who grow along x above, and differ as much again."""
    d = noise(1, 24, size=0.02) + noise(2, 8, size=0.1)[SUBJECT]
    d += 0.05 * (AGE - AGE.mean())[:, None, None] * TOP[:, None] * [1, 0, 0]
    names = np.array([f"p{i}" for i in SUBJECT])
    return study_of(d, age=AGE, person=names, sex=np.array(["f", "m"])[SUBJECT % 2])


def test_balanced_data_have_the_closed_form_of_the_analysis_of_variance():
    rng = np.random.default_rng(0)
    s, m = 12, 4
    t, subject = np.tile(np.arange(m) * 1.0, s), np.repeat(np.arange(s), m)
    Y = rng.normal(size=(s * m, 30)) + rng.normal(size=(s, 30))[subject] + 0.3 * t[:, None]
    fit = random_intercepts(Y, np.column_stack([np.ones(s * m), t]), subject)
    E, x = within_subjects(Y, subject), within_subjects(t, subject)
    slope = x @ E / (x @ x)
    residual = ((E - np.outer(x, slope)) ** 2).sum(0) / (s * (m - 1) - 1)
    between = m * Y.reshape(s, m, -1).mean(1).var(0, ddof=1)
    ratio = np.maximum(between / residual - 1, 0) / m
    assert (ratio > 0).sum() > 20
    assert np.allclose(fit.slope[1], slope, rtol=0, atol=1e-12)
    assert np.allclose(fit.ratio, ratio, atol=1e-5)
    some = ratio > 0
    assert np.allclose(fit.variance[some], residual[some], rtol=1e-6)
    assert np.allclose(fit.error[1], np.sqrt(fit.variance / (x @ x)), rtol=1e-9)


@pytest.mark.parametrize("restricted", [True, False])
def test_unbalanced_data_have_the_likelihood_of_dense_matrices(restricted):
    rng = np.random.default_rng(1)
    each = rng.integers(1, 6, 15)
    subject = np.repeat(np.arange(15), each)
    n = len(subject)
    X = np.column_stack([np.ones(n), 50 + rng.normal(size=n), rng.normal(size=15)[subject]])
    Y = X @ [1, 0.5, -1] + rng.normal(size=(5, n)) + 1.5 * rng.normal(size=(5, 15))[:, subject]
    fit = random_intercepts(Y.T, X, subject, restricted=restricted)
    same = (subject[:, None] == subject).astype(float)

    def solved(log_ratio, y):
        V = np.eye(n) + np.exp(log_ratio) * same
        A = X.T @ np.linalg.solve(V, X)
        b = np.linalg.solve(A, X.T @ np.linalg.solve(V, y))
        rest = (y - X @ b) @ np.linalg.solve(V, y - X @ b)
        dof = n - 3 if restricted else n
        deviance = dof * np.log(rest) + np.linalg.slogdet(V)[1]
        deviance += np.linalg.slogdet(A)[1] if restricted else 0
        return deviance, b, np.sqrt(np.diag(np.linalg.inv(A)) * rest / dof)

    for i, y in enumerate(Y):
        best = optimize.minimize_scalar(
            lambda r, y=y: solved(r, y)[0], bounds=(-6, 6), options={"xatol": 1e-10}
        )
        _, b, error = solved(best.x, y)
        assert np.isclose(fit.ratio[i], np.exp(best.x), rtol=1e-4)
        assert np.allclose(fit.slope[:, i], b, atol=1e-5)
        assert np.allclose(fit.error[:, i], error, rtol=1e-4)


def test_a_covariate_that_changes_nothing_changes_no_statistic(simulated):
    rng = np.random.default_rng(0)
    w, options = rng.normal(size=24), {"of": "normal", "n_permutations": 9}
    constant = np.repeat(rng.normal(size=8), 3)  # within subjects
    fits = [
        growth(simulated, "age", "person", covariates=of, **options)
        for of in ({"w": w}, {"w": w, "constant": constant}, {"w": w, "twice": 2 * w})
    ]
    assert np.allclose([fit["statistic"] for fit in fits], fits[0]["statistic"])


def test_a_simulated_growth_is_found_where_it_is_with_its_slope(simulated):
    fit = growth(simulated, "age", "person", n_permutations=199)
    assert np.allclose(fit["effect"].values[TOP, 0].mean(), 0.05, rtol=0.15)
    assert abs(fit["effect"].values[~TOP]).mean() < 0.01
    assert (fit["p_family_wise"].values[TOP] < 0.05).mean() > 0.8
    assert (fit["p_family_wise"].values[~TOP] < 0.05).mean() < 0.05
    assert fit["p_value"] == 0.005
    assert fit["intraclass_correlation"].median() > 0.7
    assert np.corrcoef(fit["shape_time"], AGE)[0, 1] > 0.3
    assert fit.attrs["subjects"] == 8
    assert fit.attrs["once"] == 0
    adjusted = growth(simulated, "age", "person", covariates="sex", n_permutations=199)
    assert np.array_equal(adjusted["p_vertex"], fit["p_vertex"])
    signs = growth(simulated, "age", "person", of="normal", variances="unequal", n_permutations=199)
    assert signs.attrs["smallest_p"] == 2**-7
    assert signs["p_value"] <= 0.02


def test_the_trajectory_is_the_mean_shape_at_each_time_and_a_mode_that_plays(simulated):
    fit = growth(simulated, "age", "person", n_permutations=99)
    young, old = (statistics.predict(simulated, fit, age)["position"].values for age in (0, 4))
    assert np.allclose(old - young, 4 * fit["effect"])
    moving = statistics.regression_modes(simulated, fit, "age")
    assert moving["pca"].sizes["component"] == 1
    assert np.allclose(
        moving["pca"]["deformation"][0], fit["effect"] * fit.attrs["standard_deviation"], atol=1e-6
    )


def test_a_field_grows_too(simulated):
    values = noise(5, 24, size=0.1)[..., 0] + 0.4 * AGE[:, None] * TOP
    study = with_transferred(simulated, values)
    fit = growth(study, "age", "person", field="thickness", n_permutations=199)
    assert np.allclose(fit["field_effect"].values[TOP], 0.4, atol=0.1)
    assert np.allclose(fit["field_within_effect"].values[TOP], 0.4, atol=0.1)
    assert fit["field_effect"].attrs["units"] == "mm"
    assert (fit["p_family_wise"].values[TOP] < 0.05).all()
    with pytest.raises(ValueError, match="a regression of displacements is needed"):
        statistics.predict(study, fit, 1.0)


def test_orders_leave_every_visit_with_its_subject_and_are_all_different():
    blocks, x = np.array([0, 1, 0, 1, 1, 2]), np.array([1.0, 2, 3, 4, 5, 6])
    model = Model(x, blocks=blocks)
    orders, n = model.rearrangements()
    found = {tuple(order) for order in orders}
    assert len(found) == n == model.n_rearrangements - 1 == 11
    assert all((blocks[list(order)] == blocks).all() for order in found)
    drawn, n = Model(x, blocks=blocks, n_permutations=5).rearrangements()
    drawn = list(drawn)
    assert len(drawn) == n == 5
    assert all((blocks[order] == blocks).all() for order in drawn)
    signs, n = Model(x, None, "unequal", blocks).rearrangements()
    signs = [tuple(one) for one in signs]
    assert len(set(signs)) == n == 3
    assert all(one[0] == one[2] and one[1] == one[3] == one[4] for one in signs)
    # two visits each: reversing all gives the same slope with the other sign
    pairs = np.repeat(np.arange(5), 2)
    assert Model(np.arange(10.0), blocks=pairs).smallest_p == 2 / 2**5
    assert Model(np.arange(10.0) ** 2, blocks=np.repeat([0, 1], 5)).smallest_p == 1 / 1000


def test_the_test_of_change_keeps_its_level_under_the_null_hypothesis():
    found = []
    for run in range(150):
        rng = np.random.default_rng([7, run])
        subject = np.repeat(np.arange(8), 3)
        d = rng.normal(size=(24, 10, 1)) + 3 * rng.normal(size=(8, 10, 1))[subject]
        E, x = within_subjects(d, subject), within_subjects(rng.normal(size=24), subject)
        options = {"blocks": subject, "n_permutations": 39, "seed": run}
        found.append(
            [
                Model(x, variances=v, **options).vertex_test(E)[2].min() <= 0.05
                for v in ("equal", "unequal")
            ]
        )
    assert np.all(np.mean(found, axis=0) < 0.11)


def test_single_visits_are_refused_or_reported(simulated, caplog):
    caplog.set_level(logging.WARNING)
    person = simulated["subjects"]["person"].values
    options = {"n_permutations": 99}
    with pytest.raises(ValueError, match="two subjects with visits at different times, found 0"):
        growth(simulated, "age", [f"q{i}" for i in range(24)], **options)
    with pytest.raises(ValueError, match="needs a time of numbers; found text such as 'f'"):
        growth(simulated, "sex", "person", **options)
    with pytest.raises(ValueError, match="24 shapes"):
        growth(simulated, "age", ["a", "b"], **options)
    with pytest.raises(ValueError, match="combination of the covariates"):
        growth(simulated, "age", "person", covariates={"years": AGE * 2}, **options)
    with pytest.raises(ValueError, match="of must be one of 'vector', 'normal'"):
        growth(simulated, "age", "person", of="x", **options)
    caplog.clear()
    alone = np.where(np.arange(24) == 23, "alone", person)
    fit = growth(simulated, "age", alone, **options)
    assert "visits at one time only" in caplog.text
    assert "alone" in caplog.text
    assert fit.attrs["once"] == 1
    unknown = np.where(np.arange(24) == 5, "", person)
    fit = growth(simulated, "age", unknown, **options)
    assert fit.attrs["left_out"] == "shape_05"
    assert fit.sizes["shape"] == 23
    caplog.clear()
    few = np.where(
        np.arange(24) < 4, np.repeat([0, 1], 12)[np.arange(24) * 3 % 24], np.arange(24) + 9
    )
    few[:4] = [0, 0, 1, 1]
    growth(simulated, "age", few, of="normal", **options)
    assert "allow no p value below 0.5" in caplog.text


@pytest.mark.usefixtures("short_films")
def test_the_command_writes_the_trajectory(study_folder, tmp_path, capsys):
    folder = shutil.copytree(study_folder, tmp_path / "study")
    names = open_study(folder)["registration"]["shape"].values.tolist()
    table = tmp_path / "t.csv"
    rows = [f"{name},{'ab'[i // 2]},{i + i * i}" for i, name in enumerate(names)]
    table.write_text("\n".join(["shape,id,age", *rows]))
    words = ["growth", str(folder), "--time", "age", "--subject", "id", "--table", str(table)]
    words += ["--of", "normal", "--permutations", "19"]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert "4 visits of 2 subjects" in printed
    out = folder / "statistics"
    assert {path.name for path in out.iterdir()} >= {
        "growth.nc",
        "growth.vertex.csv",
        "growth.html",
        "growth.gif",
    }


def test_times_and_subjects_are_checked(simulated, caplog):
    names = simulated["subjects"]["person"].values
    with pytest.raises(ValueError, match="time: -999 of shape_02 is a code of a missing value"):
        growth(simulated, np.where(np.arange(24) == 2, -999, AGE), names, n_permutations=9)
    person = [*names[:2], f"{names[2]}\u200b", *names[3:]]
    with pytest.raises(ValueError, match=r"subject: 'p0' .* 'p0.u200b' \(shape_02\) look alike"):
        growth(simulated, AGE, person, n_permutations=9)
    growth(simulated, AGE, [*names[:2], "P0", *names[3:]], n_permutations=9)
    assert "'p0' (shape_00) differ only in case" in caplog.text
