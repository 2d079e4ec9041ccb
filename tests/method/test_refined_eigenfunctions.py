"""Eigenfunctions at full resolution from those of the low-resolution mesh."""

import numpy as np
import pytest

import s4a
from s4a import synthetic
from s4a.geometry.mesh import as_arrays, stiffness, vertex_areas
from s4a.method.refined_eigenfunctions import SPARE, refine_eigenfunctions, smooth
from s4a.method.remesh import laplacian
from s4a.method.shape import Shape
from s4a.method.spectral import eigenpairs

K = 30


@pytest.fixture(scope="module")
def shape():
    mesh = synthetic.ellipsoid(4000, (1.3, 1.1, 1.0))
    X, _ = as_arrays(mesh)
    X = X * (1 + 0.1 * np.cos(5 * X[:, :1]) * np.sin(4 * X[:, 1:2]))
    mesh = mesh.assign(position=(mesh["position"].dims, X))
    return mesh, Shape(mesh, s4a.spectrum(s4a.coarsen(mesh, n_coarse=500), k=K + SPARE))


@pytest.fixture(scope="module")
def exact(shape):
    X, T = as_arrays(shape[0])
    E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
    return *eigenpairs(E, w, area, K), area / area.sum(), stiffness(E, w, len(X))


def with_refined_eigenfunctions(shape):
    mesh, scan = shape
    X, T = as_arrays(mesh)
    return refine_eigenfunctions(X, T, vertex_areas(X, T), scan.U, scan.coarse, K)


def outside(B, Phi, area):
    """Root mean square share of the exact eigenfunctions that is not in the span of B."""
    mass, inside = B.T @ (area[:, None] * B), B.T @ (area[:, None] * Phi)
    return np.sqrt(np.mean(1 - (inside * np.linalg.solve(mass, inside)).sum(0)))


def test_lifted_functions_are_eigenfunctions_of_the_mesh_where_projected_ones_are_not(shape, exact):
    eigenvalue, Phi, area, _ = exact
    found, B = with_refined_eigenfunctions(shape)
    _, scan = shape
    projected = scan.U @ scan.coarse["eigenfunction"].values[:, :K]
    assert outside(B.astype(float), Phi, area) < 0.35 * outside(projected, Phi, area)
    off, coarse_off = (
        np.abs(e[1:K] / eigenvalue[1:] - 1).max() for e in (found, scan.low.eigenvalue)
    )
    assert off < 0.1 * coarse_off


def test_refined_eigenfunctions_are_orthonormal_and_the_first_is_constant(shape, exact):
    area = exact[2]
    _, B = with_refined_eigenfunctions(shape)
    assert np.allclose(B.T @ (area[:, None] * B), np.eye(K), atol=1e-4)
    assert np.allclose(B[:, 0], 1, atol=1e-4)


def test_the_eigenvalue_of_constants_is_zero_so_that_descriptors_do_not_take_it_for_a_frequency(
    shape,
):
    found, _ = with_refined_eigenfunctions(shape)
    assert found[0] == 0
    assert found[1] > 1


def test_the_smoother_damps_what_is_rough_and_enlarges_nothing():
    rates = np.linspace(0, 1, 101)
    left = smooth(
        np.diag(rates), np.zeros((101, 1)), np.ones((101, 1)), iterations=4, least=0.05
    ).ravel()
    assert np.abs(left).max() <= 1
    assert np.abs(left[5:]).max() < 0.4


def test_a_mesh_of_obtuse_triangles_is_lifted_too(shape):
    mesh, _ = shape
    flat = mesh.assign(position=mesh["position"] * [1.0, 1.0, 0.15])
    scan = Shape(flat, s4a.spectrum(s4a.coarsen(flat, n_coarse=500), k=K + SPARE))
    X, T = as_arrays(flat)
    E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
    assert (w < 0).mean() > 0.02
    eigenvalue, _ = eigenpairs(E, w, area, K)
    found, B = with_refined_eigenfunctions((flat, scan))
    assert np.isfinite(B).all()
    assert np.abs(found[1:] / eigenvalue[1:] - 1).max() < 0.01


def test_every_piece_of_a_mesh_keeps_its_constant():
    ball = synthetic.sphere(1500)
    X, T = as_arrays(ball)
    two = s4a.geometry.mesh.as_dataset(np.r_[X, X + [3, 0, 0]], np.r_[T, T + len(X)])
    scan = Shape(two, s4a.spectrum(s4a.coarsen(two, n_coarse=400), k=12))
    X, T = as_arrays(two)
    eigenvalue, B = refine_eigenfunctions(X, T, vertex_areas(X, T), scan.U, scan.coarse, 6)
    assert np.allclose(eigenvalue[:2], 0, atol=1e-3)
    assert eigenvalue[2] > 20
    assert np.ptp(B[:1500, :2], axis=0).max() < 1e-3
