"""The benchmark of parts: what it says of shapes that are left out, and of several studies."""

import numpy as np
import pytest
from paths import benchmark

from s4a.analysis.inputs import registration_of
from s4a_morphometrics.calibration import Errors, Found, image_of
from s4a_morphometrics.partial import model_of

partial = benchmark("partial")
NAMES = list("abcd")


def found_with(errors):
    """Shapes of which the others tell every vertex with these errors, half of them being there."""
    found = {}
    for name, p in errors.items():
        there, missing = np.split(np.arange(len(p)), 2)
        of = Errors(there, p[there]), Errors(missing, p[missing], np.ones((len(missing), 3)))
        found[name] = Found(*of, 0.0)
    return found


@pytest.fixture
def wrong():
    """Errors of matches."""
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=(2000, 3)) for name in NAMES}


def test_the_truth_is_missed_by_what_is_told_and_by_what_the_match_has_wrong(wrong):
    gaps = {name: 2 * e for name, e in wrong.items()}
    # a match's own errors, which no other shape tells: the truth is met
    met = list(partial.rows_of_left_out(found_with({n: -e for n, e in wrong.items()}), gaps, wrong))
    for row in met:
        np.testing.assert_allclose(row, [1, 1, -1, -0.5, -1, -0.5])
    # and where what is told has the same errors, it is missed by twice as much
    twice = partial.rows_of_left_out(
        found_with(wrong), {n: 1e-6 * e for n, e in wrong.items()}, wrong
    )
    for row in twice:
        assert row[0] == pytest.approx(0.59, abs=0.05)  # of 1.6449 / 2 standard deviations
        assert row[2] == pytest.approx(1)


def test_a_shape_is_told_with_the_factor_and_the_ways_of_the_others(wrong):
    right = {name: 1e-9 * e for name, e in wrong.items()}
    told = {name: e * (20 if name == "c" else 1) for name, e in wrong.items()}
    rows = dict(zip(NAMES, partial.rows_of_left_out(found_with(told), {}, right), strict=True))
    assert rows["c"][0] < 0.15  # its own errors would have widened the intervals
    assert min(row[0] for name, row in rows.items() if name != "c") > 0.95
    assert np.isnan(rows["a"][3])  # it has no other way
    gaps = {"a": 1e-6 * wrong["a"], "c": 1e3 * wrong["c"]}
    rows = dict(zip(NAMES, partial.rows_of_left_out(found_with(told), gaps, right), strict=True))
    assert rows["c"][1] < 0.15


def test_by_how_much_a_match_is_off_the_truth_is_told_in_the_frame_of_the_template(study):
    model, registration = model_of(study), registration_of(study)
    shift = np.array([1.0, -2.0, 0.5])
    of = {name: registration.sel(shape=name) for name in registration["shape"].values.tolist()}
    wrong = partial.wrong_of(model, {name: image_of(one) - shift for name, one in of.items()})
    for name, one in of.items():
        turned = one["rotation"].values @ shift * one["scale"].item() / model.template.frame[1]
        np.testing.assert_allclose(wrong[name], np.tile(turned, (len(model.at), 1)), atol=1e-5)


def test_the_table_of_a_small_study_has_a_row_for_every_share(study, monkeypatch, capsys):
    registration = registration_of(study)
    true = {n: image_of(registration.sel(shape=n)) for n in registration["shape"].values.tolist()}
    monkeypatch.setattr(partial, "study_of_brains", lambda store, seed: (study, None, true))
    monkeypatch.setattr(partial, "SHARES", (0.0, 0.3))
    partial.left_out(None, 2, 7)
    title, head, _, row = filter(None, capsys.readouterr().out.split("\n"))
    assert title == "brains of seed 7, left out"
    share, parts, *cells = row.strip("| ").split(" | ")
    assert head.count("|") == 1 + len(partial.HEAD_LEFT_OUT) == 3 + len(cells)
    assert (share, parts) == ("30 %", "6")  # two planes and three shapes, the template is none
    within, with_all = map(float, cells[:2])
    assert 0.5 < within <= with_all <= 1


def test_planes_leave_the_share_that_is_asked_and_are_the_same_again(study):
    model = model_of(study)
    parts = list(partial.parts_of(model, 0.3, 2))
    assert [present.mean() for present, _ in parts] == pytest.approx([0.7, 0.7], abs=0.01)
    assert (parts[0][0] != parts[1][0]).any()
    for (one, _), (other, _) in zip(parts, partial.parts_of(model, 0.3, 2), strict=True):
        np.testing.assert_array_equal(one, other)


# ---- several studies


def test_seeds_are_numbers_and_ranges_up_to_the_next_word():
    words = "brains --seed 4 6-8 --few".split()
    assert partial.numbers_after("--seed", words, 3) == [4, 6, 7, 8]
    assert partial.numbers_after("--seed", ["--few"], 3) == [3]


def test_shapes_of_one_study_that_are_alike_make_the_error_of_the_mean_larger():
    values = np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0])
    alone = partial.standard_error(values, np.arange(6))
    assert alone == pytest.approx(np.sqrt(4 / 5 / 6))
    together = partial.standard_error(values, np.array([1, 1, 2, 2, 3, 3]))
    assert together == pytest.approx(np.sqrt(1 / 3))  # of the mean of 0, 1 and 2


def test_shapes_of_several_studies_are_pooled_and_refused_ones_are_in_no_mean():
    columns = len(partial.HEAD) - 2
    lines = partial.pooled(
        {
            seed: {share: [[value] * columns, None] for share in partial.SHARES}
            for seed, value in ((4, 0.8), (5, 1.0))
        }
    ).splitlines()
    assert len(lines) == 2 + len(partial.SHARES)
    assert lines[-1].startswith("| 50 % | 2 | 0.900 (0.100, 0.100; 0.80, 1.00) | ")


def test_shapes_left_out_of_several_studies_are_pooled():
    tables = {
        seed: {share: np.full((3, 6), value) for share in partial.SHARES[1:]}
        for seed, value in ((4, 0.8), (5, 1.0))
    }
    lines = partial.pooled_left_out(tables).splitlines()
    assert len(lines) == 2 + len(partial.SHARES[1:])
    assert lines[-1] == "| 50 % | 6 | 0.900 (0.100) | 0.900 (0.100) |"


def test_each_shape_of_several_studies_is_cut_by_planes_of_its_own(monkeypatch, capsys):
    drawn = []

    def row_of(*given, alone):
        drawn.append(given[-1].normal())
        return [0.9] * (len(partial.HEAD) - 2)

    monkeypatch.setattr(partial, "brains", lambda *_: iter([(None, None, None)] * 2))
    monkeypatch.setattr(partial, "whole_inserted", lambda *_: None)
    monkeypatch.setattr(partial, "row_of", row_of)
    partial.main(["brains", "--few", "--alone", "--seed", "4", "5"])
    assert len(set(drawn)) == len(drawn) == 2 * 2 * len(partial.SHARES)
    said = capsys.readouterr().out
    assert said.index("brains, 2 new shapes, seed 5") < said.index("brains, 2 studies")
