"""Triangles that pass through others are counted, and nothing else is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import s4a
from s4a.geometry import crossing
from s4a.geometry.crossing import count_crossing, expected_pairs
from s4a.geometry.mesh import as_arrays


def sphere(n=500):
    return as_arrays(s4a.synthetic.sphere(n))


def two(X, T, shift):
    """A surface and its copy beside it."""
    return np.concatenate([X, X + shift]), np.concatenate([T, T + len(X)])


def segments_through(X, T):
    """Triangles of which an edge passes through another without a common corner, one by one."""
    A, ab, ac = X[T[:, 0]], X[T[:, 1]] - X[T[:, 0]], X[T[:, 2]] - X[T[:, 0]]
    crossing = np.zeros(len(T), bool)
    for t, corners in enumerate(T):
        apart = ~np.isin(T, corners).any(1)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            start, step = X[corners[i]], X[corners[j]] - X[corners[i]]
            system = np.stack([ab, ac, np.broadcast_to(-step, ab.shape)], axis=2)
            apart &= np.abs(np.linalg.det(system)) > 1e-12
            system[~apart] = np.eye(3)
            u, v, s = np.linalg.solve(system, (start - A)[:, :, None])[:, :, 0].T
            through = apart & (u > 0) & (v > 0) & (u + v < 1) & (s > 0) & (s < 1)
            crossing |= through
            crossing[t] |= through.any()
    return crossing


def test_a_surface_without_crossings_has_none_in_any_pose_and_unit():
    X, T = sphere()
    for turn in Rotation.random(3, rng=0).as_matrix():
        assert count_crossing(1e-6 * X @ turn.T + 7, T) == 0


def test_two_spheres_cross_where_edges_of_one_pass_through_triangles_of_the_other():
    X, T = two(*sphere(120), [0.31, 0.17, 0.43])
    expected = segments_through(X, T)
    assert expected.sum() > 20
    assert count_crossing(X, T) == expected.sum()


def test_sheets_that_touch_at_a_corner_do_not_cross():
    X, T = sphere()
    top = X[:, 2].argmax()
    both, triangles = two(X, T, [0, 0, 0])
    both[len(X) :] = [1, 1, -1] * X + [0, 0, 2 * X[top, 2]]  # its image in the plane at the top
    assert count_crossing(both, triangles) == 0


def test_a_crumpled_surface_is_told_from_a_sample_within_its_memory():
    X, T = sphere(2000)
    crumpled = X[np.random.default_rng(0).permutation(len(X))]
    assert expected_pairs(crumpled, T) > 100 * expected_pairs(X, T)
    assert count_crossing(crumpled, T, most_pairs=1000) == pytest.approx(len(T), rel=0.05)


def test_the_memory_of_an_estimate_does_not_grow_with_the_limit_of_counting(monkeypatch):
    X, T = sphere(2000)
    crumpled = X[np.random.default_rng(0).permutation(len(X))]
    monkeypatch.setattr(crossing, "_MOST_PAIRS", 20_000)
    found, find = [], crossing.igl.predicates.find_intersections

    def spy(*meshes):
        found.append(find(*meshes))
        return found[0]

    monkeypatch.setattr(crossing.igl.predicates, "find_intersections", spy)
    assert crossing.count_crossing(crumpled, T) == pytest.approx(len(T), rel=0.05)
    assert len(found[0][1]) < 30_000


def test_what_a_sample_tells_is_what_counting_does():
    X, T = two(*sphere(2000), [0.05, 0.02, 0.03])
    counted, expected = count_crossing(X, T), expected_pairs(X, T)
    told = count_crossing(X, T, most_pairs=int(0.99 * expected))  # of half of them
    assert told == pytest.approx(counted, rel=0.25)


def test_large_surfaces_without_crossings_are_counted_and_not_sampled():
    X, T = sphere()
    apart = (X.take(T, axis=0) + 10 * np.arange(len(T))[:, None, None]).reshape(-1, 3)
    assert expected_pairs(apart, np.arange(len(apart)).reshape(-1, 3)) == 0


def test_a_surface_without_triangles_has_none():
    assert count_crossing(np.zeros((0, 3)), np.zeros((0, 3), int)) == 0
