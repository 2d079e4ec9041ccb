"""Which vertex of one surface lies on which of another."""

import numpy as np
import pytest

from s4a import synthetic
from s4a.geometry import closest
from s4a.geometry.closest import closest_point_on_triangles, feature_tree, match_surfaces
from s4a.geometry.compiled import Missing
from s4a.geometry.mesh import as_arrays, vertex_normals


@pytest.fixture(scope="module")
def ball():
    """A sphere of unit area."""
    X, T = as_arrays(synthetic.sphere(2000))
    return X / (np.sqrt(4 * np.pi) * np.linalg.norm(X, axis=1).mean()), T


def test_a_smooth_surface_finds_its_vertices_on_a_rough_one(ball):
    X, T = ball
    height = np.random.default_rng(0).normal(0, 0.04, (len(X), 1))  # half of an edge
    rough = (1 + height) * X
    here = np.arange(len(X))
    assert (
        match_surfaces(X, vertex_normals(X, T), rough, vertex_normals(rough, T)) == here
    ).mean() > 0.93
    by_normals_too = feature_tree(rough, T).query(feature_tree(X, T).data)[1]
    assert (by_normals_too == here).mean() < 0.75


def on_grid(P, A, B, C, n=200):
    """Least distance of a point from a triangle, by its points on a grid."""
    i, j = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]).T / n
    return np.linalg.norm(A + i[:, None] * (B - A) + j[:, None] * (C - A) - P, axis=1).min()


@pytest.mark.parametrize("d", [2, 3, 6])
@pytest.mark.parametrize("shape", ["A = B", "B = C", "A = C", "all one", "a line", "a triangle"])
def test_the_closest_point_is_found_on_triangles_of_any_shape(shape, d):
    rng = np.random.default_rng(0)
    for _ in range(30):
        P, A, B, C = rng.normal(size=(4, d))
        if shape == "all one":
            B = C = A
        elif shape == "a line":
            A, B, C = rng.integers(0, 5, (3, 1)) / 4 * rng.normal(size=d)
        else:
            A, B, C = {"A = B": (A, A, C), "B = C": (A, B, B), "A = C": (A, B, A)}.get(
                shape, (A, B, C)
            )
        weights = closest_point_on_triangles(*(one[None] for one in (P, A, B, C)))[0]
        assert weights.sum() == pytest.approx(1)
        assert (weights >= 0).all()
        gap = np.linalg.norm(weights @ [A, B, C] - P)
        least = on_grid(P, A, B, C)
        assert least - 0.02 < gap < least + 1e-9


def test_the_closest_point_of_a_segment_as_a_triangle_lies_within_it():
    P, A, C = np.array([[0.5, 1, 0]]), np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    assert closest_point_on_triangles(P, A, A, C).tolist() == [[0.5, 0, 0.5]]


def test_the_right_side_of_a_thin_wall_is_found(ball):
    X, T = ball
    wall = X * [1, 1, 0.01]  # two sides, nearer to each other than two vertices
    moved = wall + [0, 0, 0.01]
    match = match_surfaces(moved, vertex_normals(moved, T), wall, vertex_normals(wall, T))
    inside = np.linalg.norm(X[:, :2], axis=1) < 0.8 * np.abs(X).max()
    assert (np.sign(X[match, 2]) == np.sign(X[:, 2]))[inside].mean() > 0.99


@pytest.mark.parametrize("far", [0.01, 0.5, 5.0])
def test_without_libigl_the_closest_points_are_as_near(ball, far, monkeypatch):
    X, T = ball
    rng = np.random.default_rng(1)
    X = X * [1, 2, 3]  # triangles of several sizes
    P = X[rng.integers(len(X), size=2500)] + far * rng.normal(size=(2500, 3))
    expected = closest.distance_to_surface(P, X, T)
    monkeypatch.setattr(closest, "igl", Missing("libigl", ImportError()))
    assert closest.distance_to_surface(P, X, T) == pytest.approx(expected, abs=1e-9)
    triangle, weights = closest.closest_point(P, X, T)
    found = np.linalg.norm(closest.interpolate(X, T, triangle, weights) - P, axis=1)
    assert found == pytest.approx(expected, abs=1e-9)
