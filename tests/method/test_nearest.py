"""Exact nearest neighbours over cells (eq. 7).

The answer of an exhaustive search, with fewer comparisons.
"""

import numpy as np
import pytest

from s4a import synthetic
from s4a.geometry.mesh import as_arrays
from s4a.method.nearest import (
    as_candidates,
    as_queries,
    nearest_around,
    nearest_bidirectional,
    nearest_float32,
    nearest_in_cells,
    nearest_of_few,
)


def distances(Q, D):
    """All squared distances in float64."""
    return (Q**2).sum(1)[:, None] + (D**2).sum(1) - 2 * Q @ D.T


def check(Q, D, found):
    """Each result is as near as the nearest row.

    Up to float32 rounding of the squared distance.
    """
    distance = distances(Q, D)
    centred = np.concatenate([Q, D]) - D.mean(0)
    slack = 2e-6 * (centred**2).sum(1).max()
    assert (distance[np.arange(len(Q)), found] <= distance.min(1) + slack).all()
    return (found == distance.argmin(1)).mean()


def clustered(n, d, seed, spread=0.05):
    """Rows in 40 clusters on the unit sphere and their cluster."""
    centre = np.random.default_rng(99).normal(size=(40, d))
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    rng = np.random.default_rng(seed)
    cell = rng.integers(0, 40, n)
    return centre[cell] + spread * rng.normal(size=(n, d)) / np.sqrt(d), cell


@pytest.mark.parametrize("d", [1, 6, 50])
@pytest.mark.parametrize("n_initial", [1, 12, 1000])
def test_the_answer_is_that_of_an_exhaustive_search_on_random_rows_in_random_cells(d, n_initial):
    rng = np.random.default_rng(d)
    Q, D = rng.normal(size=(1500, d)), rng.normal(size=(1200, d))
    found, *_ = nearest_in_cells(
        Q, rng.integers(0, 37, 1500), D, rng.integers(0, 29, 1200), n_initial=n_initial
    )
    assert check(Q, D, found) > (0.99 if d > 1 else 0.9)


@pytest.mark.parametrize("n_initial", [1, 12])
def test_the_answer_is_that_of_an_exhaustive_search_on_clusters_with_few_comparisons(n_initial):
    (Q, cell_q), (D, cell_d) = clustered(3000, 20, 1), clustered(2500, 20, 2)
    found, share, _ = nearest_in_cells(Q, cell_q, D, cell_d, n_initial=n_initial)
    assert check(Q, D, found) > 0.999
    assert share < (0.1 if n_initial == 1 else 0.5)


def test_rows_far_from_the_origin_lose_nothing():
    (Q, cell_q), (D, cell_d) = clustered(2000, 20, 3), clustered(2000, 20, 4)
    far = np.full(20, 300.0)
    found, *_ = nearest_in_cells(Q + far, cell_q, D + far, cell_d)
    assert (found == distances(Q, D).argmin(1)).all()


def test_rows_that_are_nearly_the_same_are_found_across_cells():
    rng = np.random.default_rng(5)
    D = rng.normal(size=(2000, 30))
    order = rng.permutation(2000)
    Q = D[order] + 1e-4 * rng.normal(size=D.shape)
    found, *_ = nearest_in_cells(
        Q, rng.integers(0, 50, 2000), D, rng.integers(0, 50, 2000), n_initial=1
    )
    assert (found == order).all()


def test_the_numbering_of_the_cells_does_not_matter():
    (Q, cell_q), (D, cell_d) = clustered(1000, 10, 6), clustered(900, 10, 7)
    one, share, _ = nearest_in_cells(Q, cell_q, D, cell_d)
    numbers = np.random.default_rng(0).choice(
        10**6, 40, replace=False
    )  # most numbers are of empty cells
    two, same, _ = nearest_in_cells(Q, numbers[cell_q], D, numbers[::-1][cell_d])
    assert (one == two).all()
    assert share == pytest.approx(same, abs=0.02)


def test_queries_far_from_all_other_cells_are_certified_and_those_between_two_are_not():
    rng = np.random.default_rng(2)
    cell = np.repeat(np.arange(10), 50)
    D = 100.0 * np.eye(10)[cell] + rng.normal(size=(500, 10))
    assert nearest_in_cells(D, cell, D, cell, n_initial=1)[2] == 1
    between = 50.0 * (np.eye(10)[0] + np.eye(10)[1]) + rng.normal(size=(30, 10))
    found, _, certified = nearest_in_cells(between, np.zeros(30, int), D, cell, n_initial=1)
    assert certified < 0.5
    assert check(between, D, found) == 1


def test_a_single_cell_is_an_exhaustive_search():
    rng = np.random.default_rng(8)
    Q, D = rng.normal(size=(50, 4)), rng.normal(size=(60, 4))
    found, share, _ = nearest_in_cells(Q, np.zeros(50, int), D, np.zeros(60, int))
    assert share == 1
    assert check(Q, D, found) == 1


def test_cells_of_single_rows_work():
    rng = np.random.default_rng(9)
    D = rng.normal(size=(300, 5))
    assert (nearest_in_cells(D, np.arange(300), D, np.arange(300))[0] == np.arange(300)).all()


def test_of_equal_rows_one_is_given():
    (D, cell), rng = clustered(200, 8, 10), np.random.default_rng(1)
    found = nearest_in_cells(D, cell, np.concatenate([D, D]), rng.integers(0, 9, 400))[0]
    assert (found % 200 == np.arange(200)).all()


@pytest.mark.parametrize("d", [1, 6, 50])
@pytest.mark.parametrize("block", [7, 256])
def test_few_queries_have_the_answer_of_an_exhaustive_search(d, block):
    rng = np.random.default_rng(d)
    Q, D = rng.normal(size=(200, d)), rng.normal(size=(1200, d))
    found = nearest_of_few(Q, D, rng.integers(0, 29, 1200), block=block)
    assert check(Q, D, found) > (0.99 if d > 1 else 0.9)


def test_few_queries_among_clusters_far_from_the_origin_lose_nothing():
    (Q, _), (D, cell) = clustered(300, 20, 3), clustered(2000, 20, 4)
    assert (nearest_of_few(Q + 300, D + 300, cell) == distances(Q, D).argmin(1)).all()


def test_few_queries_take_the_first_of_equally_near_rows():
    rng = np.random.default_rng(8)
    D = rng.normal(size=(200, 12))
    found = nearest_of_few(D, np.concatenate([D, D]), rng.integers(0, 9, 400))
    assert (found == np.arange(200)).all()


def test_a_search_around_what_is_found_among_some_gives_nearly_what_is_nearest_of_all():
    X, _ = as_arrays(synthetic.ellipsoid(900))
    some = np.arange(0, 900, 6)  # spread: the vertices are a spiral
    distance = np.linalg.norm(X[some, None] - X, axis=2)  # (some, n)
    q, d = as_queries(X + 0.01), as_candidates(X)
    exact = nearest_float32(q, d)

    def found(width):
        around = np.argsort(distance, axis=1)[:, :width]
        return nearest_around(q, d.T, around[nearest_float32(q, d[:, some])])

    assert np.array_equal(found(900), exact)
    assert np.isin(found(1), some).all()
    assert (found(32) == exact).mean() > 0.99 > (found(4) == exact).mean()


@pytest.mark.parametrize(("n", "m"), [(600, 700), (1, 300), (300, 1), (256, 512)])
def test_one_product_gives_the_nearest_in_both_directions(n, m):
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(n, 20)) + 3, rng.normal(size=(m, 20)) * [[1], [4]][n % 2] + 3
    of_a, of_b = nearest_bidirectional(as_queries(A), as_candidates(B))
    distance = np.linalg.norm(A[:, None] - B, axis=2)
    assert np.array_equal(of_a, distance.argmin(1))
    assert np.array_equal(of_b, distance.argmin(0))


def test_ties_in_both_directions_give_the_first_row():
    A = np.random.default_rng(5).integers(0, 3, (400, 3)).astype(float)
    of_a, of_b = nearest_bidirectional(as_queries(A), as_candidates(A))
    n_initial = (A[:, None] == A).all(2).argmax(1)
    assert np.array_equal(of_a, n_initial)
    assert np.array_equal(of_b, n_initial)
