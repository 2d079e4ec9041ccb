"""The network of maps (3.4): pairs, initial maps, cycles."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from s4a.method import network
from s4a.method.initial_map import map_after_alignment
from s4a.method.shape import Shape


def distances(n, seed=0):
    x = np.random.default_rng(seed).normal(size=(n, 2))
    return np.linalg.norm(x[:, None] - x[None], axis=2)


def is_connected(pairs, n):
    graph = np.zeros((n, n))
    graph[tuple(pairs.T)] = 1
    return connected_components(graph, directed=False)[0] == 1


@pytest.mark.parametrize("n", [2, 3, 5, 12])
def test_pairs_are_connected_distinct_sorted_and_exactly_the_budget(n):
    every = n * (n - 1) // 2
    for budget in range(n - 1, every + 3):
        pairs = network.choose_pairs(distances(n, budget), budget)
        assert pairs.shape == (min(budget, every), 2)
        assert is_connected(pairs, n)
        assert (pairs[:, 0] < pairs[:, 1]).all()
        assert (pairs == np.unique(pairs, axis=0)).all()


def test_the_smallest_budget_gives_the_minimum_spanning_tree():
    x = np.array([0.0, 1, 3, 7, 15])[:, None]
    assert network.choose_pairs(np.abs(x - x.T), 4).tolist() == [[0, 1], [1, 2], [2, 3], [3, 4]]


@pytest.mark.parametrize("n", [3, 6, 15])
def test_every_shape_is_in_a_triangle_with_twice_as_many_pairs_as_shapes(n):
    for seed in range(5):
        pairs = network.choose_pairs(distances(n, seed), 2 * n - 3).tolist()
        both = [*pairs, *(p[::-1] for p in pairs)]
        cycles = network.three_cycles(*zip(*both, strict=True))
        assert set(np.array(both)[cycles].ravel().tolist()) == set(range(n))


def chosen_by_definition(distance, n_pairs):
    """Choose the pairs one by one by the definition in :func:`network.choose_pairs`."""
    n = len(distance)
    inside, edges, closing = [int(np.argmin(distance.sum(1)))], [], []
    while len(inside) < n:
        options = [(distance[i, j], j, i) for j in range(n) if j not in inside for i in inside]
        least = min(options)[0]
        new = min(j for d, j, _ in options if d == least)
        parent = next(i for i in inside if distance[i, new] == least)
        around = sorted({j for edge in edges for j in edge if parent in edge} - {parent})
        if around:
            closing.append({new, min(around, key=lambda j: (distance[new, j], j))})
        edges.append({new, parent})
        inside.append(new)
    near = [sorted({*range(n)} - {i}, key=lambda j, i=i: (distance[i, j], j)) for i in range(n)]
    rest = sorted(
        itertools.combinations(range(n), 2),
        key=lambda p: (min(near[p[0]].index(p[1]), near[p[1]].index(p[0])), distance[p], p),
    )
    wanted = [tuple(sorted(pair)) for pair in (*edges, *closing, *rest)]
    return sorted([*dict.fromkeys(wanted)][:n_pairs])


@pytest.mark.parametrize("kind", ["plane", "ties", "star", "no metric"])
@pytest.mark.parametrize("seed", range(8))
def test_pairs_are_those_of_the_definition(kind, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 25))
    x = rng.normal(size=(n, 2))
    distance = np.linalg.norm(x[:, None] - x, axis=2)
    if kind == "ties":
        distance = np.round(distance)
    elif kind == "star":
        distance = np.linalg.norm(x, axis=1)[:, None] + np.linalg.norm(x, axis=1)
    elif kind == "no metric":
        distance = rng.uniform(size=(n, n))
        distance += distance.T
    np.fill_diagonal(distance, 0)
    for n_pairs in {n - 1, 2 * n, 4 * n}:
        found = network.choose_pairs(distance, n_pairs).tolist()
        assert [tuple(pair) for pair in found] == chosen_by_definition(distance, n_pairs)


@pytest.mark.parametrize("budget", [0, 3, -1, 4.5])
def test_a_budget_that_cannot_connect_is_refused_with_the_range(budget):
    with pytest.raises(ValueError, match=r"from 4 \(a tree\) to 10 \(all pairs\)"):
        network.choose_pairs(distances(5), budget)


def test_a_single_shape_is_not_a_network():
    with pytest.raises(ValueError, match="at least 2 shapes; found 1"):
        network.choose_pairs(np.zeros((1, 1)), 1)


def test_the_spectral_distance_of_scaled_spectra_is_the_logarithm_of_the_scale():
    ev = np.array([0.0, 10, 20, 30])
    d = network.spectral_distance([ev, ev, 2 * ev])
    assert d == pytest.approx(np.log(2) * np.array([[0, 0, 1], [0, 0, 1], [1, 1, 0]]))


@pytest.fixture(scope="module")
def low(low_brain):
    return Shape(coarse=low_brain).low


@pytest.mark.parametrize("init", ["dense", "landmarks"])
def test_the_initial_map_of_a_shape_to_itself_moved_is_the_identity(low, init):
    R, t = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3])
    first = map_after_alignment(low, replace(low, X=low.X @ R.T + t), (R, t), k_init=20, init=init)
    assert pytest.approx(np.eye(20), abs=1e-9) == first.C


@pytest.fixture(scope="module")
def consistent():
    """Maps C_ij = Y_j Y_i^-1 of four shapes, all pairs in both directions."""
    Y = np.random.default_rng(0).normal(size=(4, 6, 6)) + 3 * np.eye(6)
    source, target = np.array(list(itertools.permutations(range(4), 2))).T
    return (
        np.stack([Y[j] @ np.linalg.inv(Y[i]) for i, j in zip(source, target, strict=True)]),
        source,
        target,
    )


def test_every_directed_cycle_is_found_once(consistent):
    _, source, target = consistent
    cycles = network.three_cycles(source.tolist(), target.tolist())
    assert len(cycles) == 8  # 4 triangles in two orientations
    assert len(np.unique(np.sort(cycles, axis=1), axis=0)) == 8
    for a, b, c in cycles:
        assert target[a] == source[b]
        assert target[b] == source[c]
        assert target[c] == source[a]


def test_maps_of_consistent_bases_close_their_cycles(consistent):
    C, source, target = consistent
    error = network.cycle_errors(C, network.three_cycles(source.tolist(), target.tolist()))
    assert error == pytest.approx(np.zeros(12), abs=1e-10)


def test_the_cycle_error_of_one_scaled_map_is_known():
    C = np.stack([np.eye(3), np.eye(3), 1.5 * np.eye(3), np.eye(3)])
    error = network.cycle_errors(C, network.three_cycles([0, 1, 2, 2], [1, 2, 0, 3]))
    assert error[:3] == pytest.approx([0.5] * 3)  # |1.5 I - I|_F / sqrt(3)
    assert np.isnan(error[3])


def test_weights_fall_with_the_error_and_never_to_nothing():
    weight = network.cycle_weights(np.array([0.5, 1.0, 100.0, np.nan, 1.0]))
    assert weight[1] == pytest.approx(np.exp(-0.5))
    assert weight[0] > weight[1] > weight[2] == 0.01
    assert weight[3] == pytest.approx(np.exp(-0.5))  # of no cycle: the median


@pytest.mark.parametrize("error", [[np.nan, np.nan], [0.0, 1e-15], []])
def test_weights_are_plain_without_cycles_or_without_errors(error):
    assert network.cycle_weights(np.array(error)).tolist() == [1.0] * len(error)


def test_a_tree_has_no_cycles():
    assert network.three_cycles([0, 1, 1, 2], [1, 0, 2, 1]).shape == (0, 3)
