"""SCALABLE: local functions, their eigenpairs, maps in their span."""

import numpy as np
import pytest

from s4a import synthetic
from s4a.geometry.mesh import edge_graph, edges, path_lengths
from s4a.method import fmap
from s4a.method.nearest import nearest_in_cells
from s4a.method.scalable import covering_samples, local_functions, local_space, reduce
from s4a.method.shape import Shape


@pytest.fixture(scope="module")
def ball():
    return reduce(synthetic.sphere(5000), n_samples=500, k=36)


def unit_arrays(mesh):
    """Vertices in the frame of the shape, and triangles."""
    shape = Shape(mesh)
    return shape.to_frame(mesh["position"].values), mesh["corner_vertex"].values


def test_the_spectrum_of_a_sphere_is_0_3x2_5x6_7x12_within_a_tenth(ball):
    true = 4 * np.pi * np.concatenate([[l * (l + 1)] * (2 * l + 1) for l in range(6)])
    assert (ball.low.eigenvalue == 0).tolist() == [True] + 35 * [False]
    np.testing.assert_allclose(ball.low.eigenvalue[1:], true[1:], rtol=0.1)


def test_the_eigenfunctions_are_orthonormal_on_the_dense_mesh(ball):
    Phi = ball.low.Phi
    np.testing.assert_allclose(Phi.T @ (ball.low.mass @ Phi), np.eye(36), atol=1e-9)
    np.testing.assert_allclose(ball.U @ Phi[:, 0], 1, atol=1e-6)


def test_descriptors_take_no_rounding_of_the_eigenvalue_0_for_a_frequency():
    for n in (900, 1200, 1500):
        low = reduce(synthetic.ellipsoid(n), n_samples=150, k=20).low
        assert low.eigenvalue[low.eigenvalue > 0][0] > 1
        assert (low.Phi[:, 0] == 1).all()


def test_local_functions_sum_to_one_and_reach_as_far_as_the_radius_along_the_surface():
    torus = synthetic.torus(60, 30)
    sample, _, U = local_space(torus, 150)
    X, T = unit_arrays(torus)
    _, _, radius, G = covering_samples(X, T, 150)
    np.testing.assert_allclose(U.sum(axis=1), 1)
    i, j = U.nonzero()
    assert (path_lengths(G, sample[j], i, 9.0) < radius).all()
    assert U.data.min() > 0


def test_local_functions_do_not_cross_a_thin_wall():
    outer, inner = synthetic.sphere(3000), synthetic.sphere(3000, radius=0.98)
    X = np.concatenate([m["position"].values for m in (outer, inner)])
    T = np.concatenate([outer["corner_vertex"].values, inner["corner_vertex"].values + 3000])
    sample, _, radius, _ = covering_samples(X, T, 600)
    U = local_functions(X, edge_graph(X, edges(T)), sample, radius)
    i, j = U.nonzero()
    assert ((i < 3000) == (sample[j] < 3000)).all()


def test_every_vertex_is_well_inside_a_bump_on_a_surface_of_uneven_sampling():
    mesh = synthetic.ellipsoid(3000, (6.0, 1.0, 0.3))
    sample, cell, _ = local_space(mesh, 200)
    X, T = unit_arrays(mesh)
    _, _, radius, G = covering_samples(X, T, 200)
    assert path_lengths(G, sample[cell], np.arange(3000), 9.0).max() <= 0.75 * radius


def test_identical_shapes_give_the_identity():
    shape = reduce(synthetic.ellipsoid(2000), n_samples=300, k=30)
    C, match = fmap.zoomout(shape.low, shape.low, np.eye(10), 30)
    np.testing.assert_allclose(C, np.eye(30), atol=1e-8)
    assert (match == np.arange(len(match))).all()
    F = shape.U @ shape.low.Phi
    assert (nearest_in_cells(F, shape.cell, F @ C.T, shape.cell)[0] == np.arange(2000)).all()


def test_the_result_does_not_depend_on_position_and_size():
    mesh = synthetic.ellipsoid(1500)
    moved = mesh.assign(position=mesh["position"] * 7.0 + 3.0)
    one, other = (reduce(m, n_samples=200, k=12).low for m in (mesh, moved))
    np.testing.assert_allclose(one.eigenvalue, other.eigenvalue, atol=1e-6)
    np.testing.assert_allclose(np.abs(one.Phi), np.abs(other.Phi), atol=1e-4)


def test_too_many_eigenpairs_are_refused():
    with pytest.raises(ValueError, match="k must be an integer of at most"):
        reduce(synthetic.sphere(500), n_samples=50, k=80)
