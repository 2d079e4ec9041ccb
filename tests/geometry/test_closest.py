"""Which vertex of one surface lies on which of another."""

import numpy as np
import pytest

from s4a import synthetic
from s4a.geometry.closest import feature_tree, match_surfaces
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


def test_the_right_side_of_a_thin_wall_is_found(ball):
    X, T = ball
    wall = X * [1, 1, 0.01]  # two sides, nearer to each other than two vertices
    moved = wall + [0, 0, 0.01]
    match = match_surfaces(moved, vertex_normals(moved, T), wall, vertex_normals(wall, T))
    inside = np.linalg.norm(X[:, :2], axis=1) < 0.8 * np.abs(X).max()
    assert (np.sign(X[match, 2]) == np.sign(X[:, 2]))[inside].mean() > 0.99
