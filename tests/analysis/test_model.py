"""Components of all shapes but one, from those of all, compared with a direct computation."""

import numpy as np
import pytest

from s4a.analysis.model import describe_by_others, downdate, leave_one_out


def computed_again(K):
    """Error and score of every field by the model of the others, decomposed for each."""
    described = []
    for i in range(len(K)):
        others = np.delete(np.arange(len(K)), i)
        described.append(describe_by_others(K[np.ix_(others, others)], K[i, others], K[i, i])[:2])
    error, score = map(np.array, zip(*described, strict=True))
    return error, np.abs(score)


def fields(kind, s, rng):
    """Fields (s, n) of one kind."""
    x = rng.normal(size=(s, 200))
    if kind == "decaying":
        x *= 0.9 ** np.arange(200)
    elif kind == "of low rank":
        x[:, 3:] = 0
    elif kind == "equal":
        x[1] = x[-1] = x[0]
    elif kind == "one is the mean":
        x[0] = x[1:].mean(0)
    elif kind == "one has a dimension of its own":
        x[:, 5:] = 0
        x[0, 5] = 7
    elif kind == "of equal variances":  # a cross polytope: every eigenvalue is there s / 2 times
        x = np.repeat(np.eye(s, 200), 2, axis=0)[:s] * np.resize([1, -1], s)[:, None]
    return x


KINDS = ["independent", "decaying", "of low rank", "equal", "one is the mean"]
KINDS += ["one has a dimension of its own", "of equal variances"]


@pytest.mark.parametrize("s", [4, 7, 40])
@pytest.mark.parametrize("kind", KINDS)
def test_left_out_fields_are_described_as_by_components_computed_again(kind, s):
    x = fields(kind, s, np.random.default_rng(s))
    K = x @ x.T
    error, score = leave_one_out(K)
    expected = computed_again(K)
    # the square of an error that is 0 is rounded, to 1e-15 of the largest
    assert error**2 == pytest.approx(expected[0] ** 2, abs=1e-12 * K.max())
    assert score == pytest.approx(expected[1], rel=1e-6, abs=1e-6, nan_ok=True)


def test_the_rounding_of_equal_fields_is_no_component():
    x = np.repeat(np.random.default_rng(0).normal(size=(2, 50)), [1, 6], axis=0)
    error, score = leave_one_out(x @ x.T)
    assert error[0] == pytest.approx(np.linalg.norm(x[0] - x[1]))
    assert np.isnan(score[0]).all()
    assert error[1:, 1:] == pytest.approx(0, abs=1e-6)
    assert np.isfinite(score[1:, 0]).all()


def test_equal_fields_have_no_components():
    error, score = leave_one_out(np.zeros((5, 5)))
    assert not error.any()
    assert np.isnan(score).all()


@pytest.mark.parametrize("seed", range(20))
def test_a_downdate_has_the_eigenvalues_and_eigenvectors_of_the_matrix(seed):
    rng = np.random.default_rng(seed)
    c, rho = rng.integers(1, 60), rng.uniform(1, 2)
    d = np.sort(10.0 ** rng.uniform(-6, 3, c))[::-1]
    d[rng.integers(0, c) :][:3] = d[c // 2]  # some are equal
    d = np.sort(d)[::-1]
    z = rng.normal(size=c) * (rng.uniform(size=c) < 0.8)  # some are 0
    z *= np.sqrt(rng.uniform(0.1, 1) / rho / max((z**2 / d).sum(), 1e-300))  # nothing under 0
    eigenvalue, along = downdate(d, z, rho)
    expected, U = np.linalg.eigh(np.diag(d) - rho * np.outer(z, z))
    assert eigenvalue == pytest.approx(expected[::-1], rel=1e-9, abs=1e-12 * d[0])
    # of equal eigenvalues only the sum is anyone's
    groups = np.cumsum(np.r_[0, np.diff(eigenvalue) < -1e-9 * d[0]])
    squares = (rho * z @ U[:, ::-1]) ** 2
    assert np.bincount(groups, along**2) == pytest.approx(
        np.bincount(groups, squares), rel=1e-6, abs=1e-9 * (z**2).sum()
    )
