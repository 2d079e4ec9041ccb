"""Functional maps (3.3): identity for identical shapes, permutations recovered exactly."""

import numpy as np
import pytest
from paths import DATA
from scipy.spatial import cKDTree

from s4a import clean, coarsen, spectrum, synthetic
from s4a.geometry.align import align, cloud, farthest_points
from s4a.geometry.mesh import as_dataset
from s4a.method import fmap, spectral
from s4a.method.nearest import nearest_rows
from s4a.method.shape import Basis, Shape


@pytest.fixture(scope="module")
def shape(low_brain):
    """Eigenfunctions, areas, eigenvalues and vertices of a shape without symmetry."""
    area = spectral.unit_area(low_brain)
    values = low_brain["eigenfunction"], area, low_brain["eigenvalue"], low_brain["position"]
    return [np.asarray(v) for v in values]


@pytest.fixture(scope="module")
def permuted(shape):
    """The same shape with its vertices renumbered and some signs flipped.

    And the match from it to the shape.
    """
    Phi, area, eigenvalue, X = shape
    rng = np.random.default_rng(0)
    order = rng.permutation(len(X))
    sign = np.r_[1, rng.choice([-1, 1], Phi.shape[1] - 1)]
    return Phi[order] * sign, area[order], eigenvalue, X[order], order, sign


def basis(Phi, area, eigenvalue=None):
    """Functions alone: these tests need no surface."""
    return Basis(None, None, area, Phi, eigenvalue)


def test_the_map_of_a_permutation_is_orthogonal_and_carries_functions(shape, permuted):
    Phi, area, _, _ = shape
    Psi, area_target, _, _, order, sign = permuted
    C = fmap.fmap_from_match(Phi, Psi, area_target, order)
    assert pytest.approx(np.diag(sign), abs=1e-9) == C
    assert fmap.orthogonality_error(C) < 1e-9
    f = Phi @ np.random.default_rng(1).normal(size=40)
    assert Psi @ C @ spectral.project(Phi, area, f) == pytest.approx(f[order], abs=1e-8)


def test_zoomout_recovers_a_permutation_exactly_from_a_small_noisy_map(shape, permuted):
    Phi, area, _, _ = shape
    Psi, area_target, _, _, order, sign = permuted
    C0 = np.diag(sign[:8]) + np.random.default_rng(2).normal(0, 0.05, (8, 8))
    C, match = fmap.zoomout(basis(Phi, area), basis(Psi, area_target), C0, 40, step=3)
    assert (match == order).all()
    assert pytest.approx(np.diag(sign), abs=1e-8) == C


def test_zoomout_ends_at_k_whatever_the_step(shape):
    Phi, area, _, _ = shape
    same = basis(Phi, area)
    for step in (1, 7, 100):
        C, match = fmap.zoomout(same, same, np.eye(33), 40, step=step)
        assert pytest.approx(np.eye(40), abs=1e-9) == C
        assert (match == np.arange(len(Phi))).all()
    assert (fmap.zoomout(same, same, np.eye(40), 40)[0] == np.eye(40)).all()


def test_a_step_on_samples_refines_a_map_about_as_well_as_one_on_all_vertices(shape, permuted):
    Phi, area, _, X = shape
    Psi, area_target, _, Y, _, sign = permuted
    source, target = (
        Basis(points, None, weight, functions)
        for points, weight, functions in ((X, area, Phi), (Y, area_target, Psi))
    )
    noisy = np.diag(sign[:12]) + np.random.default_rng(2).normal(0, 0.05, (12, 12))

    def off(C):
        return np.linalg.norm(C - np.diag(sign[:12]))

    on_all = off(fmap.refine_once(source, target, noisy))
    assert on_all < off(noisy) / 2
    assert off(fmap.refine_once(source, target, noisy, 150)) < 1.5 * on_all
    same = fmap.refine_once(source, target, noisy, len(Y))
    assert (same == fmap.refine_once(source, target, noisy)).all()


def test_a_map_between_different_sizes_has_the_dims_target_by_source(shape):
    Phi, area, _, X = shape
    C = fmap.fmap_from_match(Phi[:, :12], Phi[:, :9], area, np.arange(len(X)))
    assert pytest.approx(np.eye(9, 12), abs=1e-9) == C
    assert fmap.match_from_fmap(C, Phi, Phi).shape == (len(X),)


def test_the_landmark_fit_finds_the_signs_of_the_eigenfunctions(shape, permuted):
    Phi, area, eigenvalue, X = shape
    Psi, area_target, _, _, order, sign = permuted
    landmark = farthest_points(X, 10)
    same = np.argsort(order)[landmark]
    source = basis(Phi, area, eigenvalue).truncated(20)
    target = basis(Psi, area_target, eigenvalue).truncated(20)
    C = fmap.fmap_from_landmarks(source, target, landmark, same)
    assert pytest.approx(np.diag(sign[:20]), abs=1e-6) == C


def test_the_landmark_fit_is_the_least_squares_solution_of_its_energy(shape):
    Phi, area, eigenvalue, X = shape
    k, commute = 6, fmap.LAPLACIAN
    landmark, other = farthest_points(X, 4), farthest_points(X, 9)[5:]
    ev, ev_target = eigenvalue[:k], 1.3 * eigenvalue[:k]
    source, target = (basis(Phi[:, :k], area, values) for values in (ev, ev_target))
    C = fmap.fmap_from_landmarks(source, target, landmark, other)
    F = fmap.landmark_coefficients(Phi[:, :k], fmap.heat_filter(ev, ev_target, n=8), landmark)
    G = fmap.landmark_coefficients(Phi[:, :k], fmap.heat_filter(ev_target, ev, n=8), other)
    F, G = F / np.linalg.norm(F, axis=0), G / np.linalg.norm(G, axis=0)
    weight = commute * np.trace(F @ F.T) / ev_target[-1] ** 2

    slope = (C @ F - G) @ F.T + weight * (ev_target[:, None] - ev[None, :]) ** 2 * C
    assert (
        np.abs(slope[:, 1:]).max() < 1e-9
    )  # the first column is not free: constants go to constants
    assert C[:, 0].tolist() == [1, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("d", [1, 3, 30, 100])
def test_nearest_rows_are_those_of_a_float64_search(d):
    rng = np.random.default_rng(d)
    Q, D = rng.normal(size=(3000, d)), rng.normal(size=(2500, d))
    assert (nearest_rows(Q, D, block=700) == cKDTree(D).query(Q)[1]).all()


def test_rows_within_float32_rounding_are_distinguished():
    rng = np.random.default_rng(0)
    D = np.repeat(rng.normal(size=(300, 30)), 2, axis=0)
    D[::2] += 1e-9
    Q = D[rng.permutation(600)]
    assert (D.astype(np.float32)[::2] == D.astype(np.float32)[1::2]).mean() > 0.9
    assert (D[nearest_rows(Q, D)] == Q).all()


def test_of_equal_rows_the_first_is_given():
    D = np.repeat(np.eye(4), 3, axis=0)
    assert nearest_rows(np.eye(4), D).tolist() == [0, 3, 6, 9]


def real_pairs():
    """Pairs of real surfaces, by name: arrays of positions and triangles."""
    face = np.load(DATA / "ict_face/face_head_neck.npz")
    kid = np.load(DATA / "kids/kid1_first6.npz")
    return {
        "faces": [(face["V"][i], face["F"]) for i in (1, 2)],
        "kids": [(kid["V"][i], kid["F"]) for i in (0, 1)],
    }


@pytest.mark.parametrize("name", ["brains", "faces", "kids"])
def test_zoomout_is_that_of_pyfm_to_the_last_index(name):
    refine = pytest.importorskip("pyFM.refine")
    if name == "brains":
        tree = synthetic.brains(2, 6000)
        pair = [tree[f"original/brain_0{i}"].to_dataset() for i in (1, 2)]
    elif (DATA / "ict_face").exists() and (DATA / "kids").exists():
        pair = [clean(as_dataset(X, T)) for X, T in real_pairs()[name]]
    else:
        pytest.skip("the shared surfaces are absent")
    source, target = (spectrum(coarsen(mesh, n_coarse=2000), k=60) for mesh in pair)
    (M, Phi, area_source), (N, Psi, area) = (
        (mesh["position"].values, mesh["eigenfunction"].values, spectral.unit_area(mesh))
        for mesh in (source, target)
    )
    R, t, _ = align(cloud(M, area_source), cloud(N, area))
    C = fmap.fmap_from_match(Phi[:, :20], Psi[:, :20], area, cKDTree(M @ R.T + t).query(N)[1])
    peer, their_match = refine.zoomout_refine(
        C, Phi, Psi, nit=8, step=5, A2=area, return_p2p=True, n_jobs=1
    )
    ours, match = fmap.zoomout(
        *(Shape(coarse=mesh).low for mesh in (source, target)), C, 60, step=5
    )
    assert (match == their_match).all()
    assert ours == pytest.approx(peer, abs=1e-12)
