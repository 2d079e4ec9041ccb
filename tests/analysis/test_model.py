"""Models of all shapes but one, of fields that are equal."""

import numpy as np
import pytest

from s4a.analysis.model import leave_one_out


def test_the_rounding_of_equal_fields_is_no_component():
    x = np.repeat(np.random.default_rng(0).normal(size=(2, 50)), [1, 6], axis=0)
    _, (error, *others), (score, *other_scores), _ = zip(*leave_one_out(x @ x.T), strict=True)
    assert error == pytest.approx(np.linalg.norm(x[0] - x[1]))
    assert np.isnan(score).all()
    assert np.array(others)[:, 1:] == pytest.approx(0, abs=1e-6)
    assert np.isfinite(np.array(other_scores)[:, 0]).all()


def test_equal_fields_have_no_components():
    for _, error, score, _ in leave_one_out(np.zeros((5, 5))):
        assert not error.any()
        assert np.isnan(score).all()
