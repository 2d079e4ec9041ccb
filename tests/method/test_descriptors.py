"""Descriptors and the fit of a functional map on them.

Known answers, the optimum, and agreement with pyFM.
"""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.sparse import diags

from s4a import coarsen, metrics, spectrum, synthetic
from s4a.geometry.align import farthest_points
from s4a.geometry.mesh import as_arrays, vertex_normals
from s4a.method import fmap, spectral
from s4a.method.shape import Shape


def low(mesh):
    return Shape(coarse=mesh).low


@pytest.fixture(scope="module")
def brains():
    tree = synthetic.brains(2, 4000)
    return [
        spectrum(coarsen(tree[f"original/brain_0{i}"].to_dataset(), n_coarse=800), k=60)
        for i in (1, 2)
    ]


@pytest.fixture(scope="module")
def shape(brains):
    mesh = brains[0]
    return (
        mesh["eigenfunction"].values,
        spectral.unit_area(mesh),
        mesh["eigenvalue"].values,
        *as_arrays(mesh),
    )


def test_signatures_are_those_of_pyfm_at_its_own_settings(shape):
    signatures = pytest.importorskip("pyFM.signatures")
    Phi, _, ev, _, _ = shape
    for ours, theirs in ((fmap.hks, signatures.auto_HKS), (fmap.wks, signatures.auto_WKS)):
        for landmark in (None, np.array([5, 70, 300])):
            found, expected = (
                ours(Phi, ev, n=30, landmark=landmark),
                theirs(ev, Phi, 30, landmarks=landmark),
            )
            assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("signature", [fmap.hks, fmap.wks])
def test_signatures_do_not_change_with_signs_and_numbering_and_those_of_landmarks_follow_them(
    shape, signature
):
    Phi, _, ev, _, _ = shape
    rng = np.random.default_rng(0)
    order, sign = rng.permutation(len(Phi)), rng.choice([-1, 1], Phi.shape[1])
    turned, landmark = (Phi * sign)[order], np.array([4, 9])
    same = np.argsort(order)[landmark]
    assert signature(turned, ev) == pytest.approx(signature(Phi, ev)[order])
    expected = signature(Phi, ev, landmark=landmark)[order]
    assert signature(turned, ev, landmark=same) == pytest.approx(expected, abs=1e-9)


def test_a_sphere_has_the_same_signature_everywhere():
    ball = spectrum(
        coarsen(synthetic.sphere(8000), n_coarse=2500), k=49
    )  # all of the modes of degree 0 to 6
    for signature in (fmap.hks, fmap.wks):
        found = signature(ball["eigenfunction"].values, ball["eigenvalue"].values, n=20)
        assert found.std(axis=0) == pytest.approx(0, abs=0.06)
        assert found.mean(axis=0) == pytest.approx(
            1, abs=0.03
        )  # filters of sum 1, functions of norm 1


def test_the_heat_kernel_around_a_landmark_is_that_of_the_plane_at_short_times(shape):
    Phi, area, ev, X, _ = shape
    t = 4 * np.log(10) / ev[-1]
    kernel = np.exp(-t * ev)
    heat = fmap.signature(Phi, kernel[None], np.array([100]))[:, 0]
    assert area @ heat == pytest.approx(1)  # heat is kept
    assert heat[100] == pytest.approx(1 / (4 * np.pi * t), rel=0.5)
    assert np.linalg.norm(X - X[100], axis=1)[np.argmax(heat)] < 0.05 * np.ptp(X, axis=0).max()


def test_both_spectra_of_a_pair_are_filtered_at_the_same_times_and_energies():
    low, high = np.array([0.0, 1, 2, 3, 9]), np.array([0.0, 2, 4, 5, 6, 30])
    for kernel in (fmap.heat_filter, fmap.wave_filter):
        one, other = kernel(low, high, n=7), kernel(high, low, n=7)
        both = np.intersect1d(low, high)[1:]
        ratio = [k[:, np.searchsorted(s, both)] for k, s in ((one, low), (other, high))]
        assert ratio[0][:, 0] / one[:, 2] == pytest.approx(np.ones(7))
        assert one.sum(axis=1) == pytest.approx(np.ones(7))
    heat = [
        np.exp(-t) for t in np.diff(np.log(fmap.heat_filter(low, high, n=7)[:, 1:3]), axis=1)[:, 0]
    ]
    assert np.log(heat) == pytest.approx(np.geomspace(4 * np.log(10) / 9, 4 * np.log(10) / 2, 7))


def test_a_shape_fits_itself_with_fewer_functions_by_either_kernel(brains):
    mesh = brains[0]
    few = mesh.isel(eigenpair=slice(20))
    for kind in ("hks", "wks"):
        C = fmap.fmap_from_descriptors(low(few), low(mesh), k=20, kind=kind)
        assert np.linalg.norm(C - np.eye(20)) < 0.01, kind


def test_modes_of_eigenvalue_0_take_no_part_in_the_wave_kernel():
    assert (fmap.wave_filter(np.array([0.0, 0, 1, 2, 3]), n=5)[:, :2] == 0).all()


def test_products_act_on_functions_of_the_basis(shape):
    Phi, area, _, _, _ = shape
    f = Phi[:, 1:3] @ [[1.0, 0.0], [0.0, 2.0]]
    for column, P in zip(f.T, fmap.multiplication(Phi, area, f), strict=True):
        assert pytest.approx(P.T) == P
        assert P[:, 0] == pytest.approx(Phi.T @ (area * column), abs=1e-9)  # the product with 1


def test_the_orientation_operator_of_x_maps_y_to_1_on_a_square_and_to_minus_1_if_flipped():
    x, y = np.meshgrid(np.linspace(0, 2, 9), np.linspace(0, 3, 7), indexing="ij")
    X = np.c_[x.ravel(), y.ravel(), np.zeros(x.size)]
    i, j = np.meshgrid(np.arange(8), np.arange(6), indexing="ij")
    a, b, c, d = (((i + p) * 7 + j + q).ravel() for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    T = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]])
    Phi = np.c_[np.ones(len(X)), X[:, :2]]
    P = fmap.orientation(T, Phi, X[:, :2])
    area = 6.0
    assert P[0, 0] == pytest.approx([0, 0, area])
    assert P[1, 0] == pytest.approx([0, -area, 0])
    assert fmap.orientation(T[:, ::-1], Phi, X[:, :2]) == pytest.approx(-P)


def test_the_orientation_operator_is_that_of_pyfm(shape):
    pyfm = pytest.importorskip("pyFM.mesh")
    Phi, _, _, X, T = shape
    f = X[:, :2] * [1.0, 0.01]
    mesh = pyfm.TriMesh(X, T)
    ours = fmap.orientation(T, Phi[:, :12], f)
    for column, P in zip(f.T, ours, strict=True):
        operator = mesh.orientation_op(mesh.gradient(column))
        theirs = Phi[:, :12].T @ (np.asarray(mesh.vertex_areas)[:, None] * (operator @ Phi[:, :12]))
        assert pytest.approx(theirs, abs=1e-6 * np.abs(theirs).max()) == P


def problem(rng, k_source=6, k_target=6, p=3):
    F, G = rng.normal(size=(k_source, 4)), rng.normal(size=(k_target, 4))
    P, Q = rng.normal(size=(p, k_source, k_source)), rng.normal(size=(p, k_target, k_target))
    skew = [M - M.transpose(0, 2, 1) for M in (P, Q)]
    penalty = rng.uniform(size=(k_target, k_source))
    return F, G, {"penalty": penalty, "operators": [(0.3, P, Q), (0.2, *skew)]}


def energy(C, F, G, penalty, operators):
    terms = [w * ((C @ P - Q @ C) ** 2).sum() for w, P, Q in operators]
    return ((C @ F - G) ** 2).sum() + (penalty * C**2).sum() + sum(terms)


@pytest.mark.parametrize("sizes", [(6, 6), (7, 5), (4, 6)])
@pytest.mark.parametrize("with_operators", [True, False])
def test_the_fit_is_what_a_slow_optimiser_finds(sizes, with_operators):
    F, G, terms = problem(np.random.default_rng(1), *sizes)
    if not with_operators:
        terms["operators"] = []
    C = fmap.fit(F, G, **terms, constant=-1.0)
    assert C[:, 0].tolist() == [-1, *[0] * (sizes[1] - 1)]

    def with_columns(free):
        return np.column_stack([C[:, 0], free.reshape(sizes[1], -1)])

    slow = minimize(
        lambda free: energy(with_columns(free), F, G, **terms), np.zeros(C[:, 1:].size), tol=1e-12
    )
    assert with_columns(slow.x) == pytest.approx(C, abs=1e-5)
    assert energy(C, F, G, **terms) <= slow.fun * (1 + 1e-12)


def test_the_fit_to_wave_kernels_is_that_of_pyfm(brains):
    functional, pyfm = map(pytest.importorskip, ("pyFM.functional", "pyFM.mesh"))
    source, target = map(low, brains)
    marks = farthest_points(source.X, 5)
    near = np.linalg.norm(source.X[marks][:, None] - target.X, axis=2).argmin(1)
    meshes = []
    for basis in (source, target):
        mesh = pyfm.TriMesh(basis.X, basis.T)
        mesh.eigenvalues, mesh.eigenvectors = basis.eigenvalue, basis.Phi
        mesh.A = diags(basis.area)
        meshes.append(mesh)
    peer = functional.FunctionalMapping(*meshes)
    k = source.k
    marked = np.stack([marks, near], axis=1)
    peer.preprocess(n_descr=100, landmarks=marked, subsample_step=5, k_process=k, k_descr=k)
    peer.fit(K=(8, 8), w_descr=1, w_lap=1e-2, w_dcomm=1e-1, factr=10, pgtol=1e-12)
    found = fmap.fmap_from_wave_kernels(source, target, marks, near, k=8)
    assert found == pytest.approx(peer.FM_12, abs=1e-4)


def test_the_fit_on_descriptors_of_a_shape_and_itself_renumbered_is_the_map_between_them(brains):
    mesh = brains[0]
    rng = np.random.default_rng(0)
    order, sign = (
        rng.permutation(mesh.sizes["vertex"]),
        rng.choice([-1, 1], mesh.sizes["eigenpair"]),
    )
    sign[0] = 1
    other = mesh.isel(vertex=order).assign(
        corner_vertex=(mesh["corner_vertex"].dims, np.argsort(order)[mesh["corner_vertex"].values])
    )
    other["eigenfunction"] = other["eigenfunction"] * sign
    for kind in ("wks", "hks"):
        C = fmap.fmap_from_descriptors(low(mesh), low(other), kind=kind)
        match = fmap.zoomout(Shape(coarse=mesh).low, Shape(coarse=other).low, C, 60)
        assert (match[1] == order).all(), kind


def test_descriptors_alone_match_different_brains_and_landmarks_help(brains):
    source, target = brains
    (X, T), (Phi, Psi) = as_arrays(source), (m["eigenfunction"].values for m in brains)
    landmark = farthest_points(X, 8)
    nearest = np.linalg.norm(X[landmark][:, None] - target["position"].values, axis=2).argmin(1)
    error = {}
    for name, marks in (("alone", (None, None)), ("landmarks", (landmark, nearest))):
        C = fmap.fmap_from_descriptors(low(source), low(target), landmarks=marks)
        match = fmap.match_from_fmap(C, Phi, Psi)
        true = np.linalg.norm(X[:, None] - target["position"].values, axis=2).argmin(0)
        error[name] = metrics.geodesic_error(X, T, match, true).mean()
    assert error["landmarks"] < error["alone"] < 0.3


def test_the_orientation_term_prefers_the_map_that_keeps_the_sides_over_its_mirror_image():
    ellipsoid = spectrum(coarsen(synthetic.ellipsoid(4000), n_coarse=1000), k=20)
    Phi, area = ellipsoid["eigenfunction"].values, spectral.unit_area(ellipsoid)
    X, T = as_arrays(ellipsoid)
    assert ((vertex_normals(X, T) * X).sum(1) > 0).mean() > 0.99
    mirror = np.linalg.norm(X[:, None] * [1, 1, -1] - X[None], axis=2).argmin(1)
    f = X[:, :2] * X[:, 2:]
    W = fmap.orientation(T, Phi, f)
    turned = fmap.orientation(T, Phi, f[mirror])
    C = fmap.fmap_from_match(Phi, Phi, area, mirror)
    kept = (W**2).sum()
    assert ((C @ W - turned @ C) ** 2).sum() > 2 * kept
    assert ((C @ W + turned @ C) ** 2).sum() < 0.1 * kept


def test_wave_filters_of_a_narrow_common_range_have_sum_one():
    kernel = fmap.wave_filter(np.array([0, 5.0, 26.0, 125.0]), np.array([0, 12.7, 12.9, 14.7]))
    assert kernel.sum(axis=1) == pytest.approx(1)
