"""Consistent latent basis and Consistent ZoomOut (3.4).

Exactly consistent maps have no cycle error.
"""

import itertools

import numpy as np
import pytest
import scipy.linalg

from s4a import coarsen, spectrum, synthetic
from s4a.method import latent, median, network
from s4a.method.initial_map import map_after_alignment
from s4a.method.shape import Basis, Shape


def complete(n):
    return np.array(list(itertools.permutations(range(n), 2))).T


@pytest.fixture(scope="module")
def eigenvalues():
    rng = np.random.default_rng(1)
    return np.concatenate([np.zeros((5, 1)), np.sort(rng.uniform(10, 200, (5, 7)), axis=1)], axis=1)


@pytest.fixture(scope="module")
def maps():
    """Maps C_ij = Y_j Y_i^-1 of five shapes with 8 functions, constants to constants."""
    Y = np.random.default_rng(0).normal(0, 0.2, (5, 8, 8)) + np.eye(8)
    Y[:, 0], Y[:, :, 0] = np.eye(8)[0], np.eye(8)[0]
    source, target = complete(5)
    C = np.stack([Y[j] @ np.linalg.inv(Y[i]) for i, j in zip(source, target, strict=True)])
    return C, source, target, np.ones(len(C))


def closing(C, source, target, Y):
    return max(np.abs(c @ Y[i] - Y[j]).max() for c, i, j in zip(C, source, target, strict=True))


def test_the_basis_of_exactly_consistent_maps_closes_every_map(maps, eigenvalues):
    Y, _ = latent.latent_basis(*maps, eigenvalues)
    assert closing(*maps[:3], Y) < 1e-8


def test_a_tree_of_maps_is_enough(maps, eigenvalues):
    C, source, target, weight = maps
    keep = np.abs(source - target) == 1
    Y, _ = latent.latent_basis(C[keep], source[keep], target[keep], weight[keep], eigenvalues)
    assert closing(C, source, target, Y) < 1e-8


def test_the_basis_is_normalised_and_canonical(maps, eigenvalues):
    noisy = maps[0] + np.random.default_rng(3).normal(0, 0.02, maps[0].shape)
    Y, latent_eigenvalue = latent.latent_basis(noisy, *maps[1:], eigenvalues)
    assert np.einsum("nkl,nkm->lm", Y, Y) == pytest.approx(5 * np.eye(8), abs=1e-9)
    mean = np.einsum("nkl,nk,nkm->lm", Y, eigenvalues, Y) / 5
    assert mean == pytest.approx(np.diag(latent_eigenvalue), abs=1e-7)
    assert (np.diff(latent_eigenvalue) > 0).all()
    assert median.area_differences(Y).mean(0) == pytest.approx(np.eye(8), abs=1e-9)


def test_the_basis_does_not_depend_on_the_order_of_the_shapes(maps, eigenvalues):
    C, source, target, weight = maps
    noisy = C + np.random.default_rng(3).normal(0, 0.02, C.shape)
    order = np.array([3, 0, 4, 1, 2])
    where = np.argsort(order)
    one, _ = latent.latent_basis(noisy, source, target, weight, eigenvalues)
    two, _ = latent.latent_basis(noisy, where[source], where[target], weight, eigenvalues[order])
    assert two == pytest.approx(one[order], abs=1e-3)


def test_a_smaller_latent_space_of_consistent_maps_is_closed_too(maps, eigenvalues):
    Y, latent_eigenvalue = latent.latent_basis(*maps, eigenvalues, 5)
    assert Y.shape == (5, 8, 5)
    assert latent_eigenvalue.shape == (5,)
    assert closing(*maps[:3], Y) < 1e-8


def test_a_map_without_weight_does_not_count(maps, eigenvalues):
    C, source, target, weight = maps
    C, weight = C.copy(), weight.copy()
    C[3] += 1
    weight[3] = 0
    Y, _ = latent.latent_basis(C, source, target, weight, eigenvalues)
    assert closing(np.delete(C, 3, 0), np.delete(source, 3), np.delete(target, 3), Y) < 1e-6


def test_the_quadratic_form_is_the_sum_of_the_residuals(maps):
    C, source, target, _ = maps
    rng = np.random.default_rng(4)
    weight, Y = rng.uniform(size=len(C)), rng.normal(size=(5, 8, 3))
    L = latent.consistency_form(C, source, target, weight, 5)(np.eye(40))
    total = sum(
        w * ((c @ Y[i] - Y[j]) ** 2).sum()
        for c, i, j, w in zip(C, source, target, weight, strict=True)
    )
    assert np.trace(Y.reshape(40, 3).T @ L @ Y.reshape(40, 3)) == pytest.approx(total)
    assert pytest.approx(L.T) == L


@pytest.mark.parametrize("seed", range(3))
def test_the_smallest_eigenvectors_span_what_a_full_eigensolver_gives(seed):
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.normal(size=(120, 120)))[0]
    L = (Q * np.r_[rng.uniform(0, 0.1, 15), rng.uniform(0.2, 5, 105)]) @ Q.T
    V = latent.smallest_eigenvectors(L.__matmul__, rng.normal(size=(120, 15)))
    assert V.T @ V == pytest.approx(np.eye(15), abs=1e-10)
    true = scipy.linalg.eigh(L, subset_by_index=[0, 14])[1]
    assert scipy.linalg.subspace_angles(V, true).max() < 1e-3


def test_an_unconnected_network_is_refused(maps, eigenvalues):
    C, source, target, weight = maps
    keep = (source < 3) == (target < 3)
    with pytest.raises(ValueError, match="not connected"):
        latent.latent_basis(C[keep], source[keep], target[keep], weight[keep], eigenvalues)


@pytest.fixture(scope="module")
def shapes():
    tree = synthetic.brains(3, 3000)["original"]
    return [spectrum(coarsen(m.to_dataset(), n_coarse=600), k=25) for m in tree.children.values()]


def zoomed(shapes, first, **options):
    bases = [Shape(coarse=mesh).low for mesh in shapes]
    return latent.consistent_zoomout(bases, first, *complete(len(shapes)), 25, step=4, **options)


@pytest.fixture(scope="module")
def first(shapes):
    low = [Shape(coarse=mesh).low for mesh in shapes]
    still = (np.eye(3), np.zeros(3))
    return np.stack(
        [map_after_alignment(low[i], low[j], still, k_init=12).C for i, j in complete(3).T]
    )


def test_consistent_zoomout_of_identical_shapes_is_the_identity(shapes):
    first = np.stack([np.eye(12)] * 6)
    C, weight, error, Y, latent_eigenvalue = zoomed([shapes[0]] * 3, first)
    assert C.shape == (6, 25, 25)
    assert np.abs(C - np.eye(25)).max() < 1e-8
    assert weight.tolist() == [1] * 6
    assert error == pytest.approx(np.zeros(6), abs=1e-7)
    D = median.area_differences(Y)
    assert pytest.approx(np.stack([np.eye(25)] * 3), abs=1e-7) == D
    assert median.distance_to_identity(D, latent_eigenvalue) == pytest.approx(np.zeros(3), abs=1e-8)
    assert latent_eigenvalue == pytest.approx(shapes[0]["eigenvalue"].values, abs=1e-6)


def test_consistent_zoomout_does_not_depend_on_the_workers_or_on_what_is_held(
    shapes, first, monkeypatch
):
    samples = [np.arange(0, s.sizes["vertex"], 2) for s in shapes]
    one, two = (zoomed(shapes, first, n_jobs=n, samples=samples) for n in (1, 3))
    monkeypatch.setattr(latent, "TARGETS", 2)  # of three shapes
    three = zoomed(shapes, first, samples=samples)
    for a, b, c in zip(one, two, three, strict=True):
        assert np.array_equal(a, b)
        assert np.array_equal(a, c)


def test_dense_iterations_search_around_the_matched_sample(shapes, first, monkeypatch):
    samples = [Shape(coarse=shape).low.sample_vertices_of(150) for shape in shapes]  # of 600

    def maps(wide, n_around=latent.N_AROUND):
        monkeypatch.setattr(latent, "N_AROUND", n_around)
        return zoomed(shapes, first, samples=samples, dense_iterations=wide)[0]

    of_all = zoomed(shapes, first)[0]
    far = {wide: np.linalg.norm(maps(wide) - of_all) for wide in (0, 2)}
    assert far[2] < 0.6 * far[0]
    assert np.array_equal(maps(2, n_around=1), maps(0))
    assert np.abs(maps(2, n_around=600) - maps(2)).max() < 0.02  # 32 are nearly as good as all


def test_consistent_zoomout_has_smaller_cycle_errors_than_the_initial_maps(shapes, first):
    cycles = network.three_cycles(*complete(3).tolist())
    rough = first + 0.05 * np.random.default_rng(0).normal(size=first.shape)
    C, _, error, _, _ = zoomed(shapes, rough)
    assert error.max() < 1
    before, after = (network.cycle_errors(maps, cycles).mean() for maps in (rough, C[:, :12, :12]))
    assert after < 0.5 * before


def test_progress_is_called_with_the_size_of_every_iteration(shapes, first):
    sizes = []
    zoomed(shapes, first, progress=sizes.append)
    assert sizes == [12, 16, 20, 24, 25]


def test_maps_that_have_their_size_stay_as_they_are(maps, eigenvalues):
    C, source, target, _ = maps
    Phi = np.random.default_rng(0).normal(size=(30, 8))
    bases = [Basis(None, None, np.full(30, 1 / 30), Phi, values) for values in eigenvalues]
    assert np.array_equal(latent.consistent_zoomout(bases, C, source, target, 8)[0], C)
