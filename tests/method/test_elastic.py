"""Elastic iterations: the energy they minimise, recovery of deformations, and accuracy."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from s4a import match_pair, synthetic
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.closest import distance_to_surface
from s4a.geometry.mesh import (
    as_arrays,
    as_dataset,
    cotan_weights,
    stiffness,
    triangle_normals,
    vertex_normals,
)
from s4a.method import elastic, spectral_icp
from s4a.method.register import (
    MAX_STRAIN,
    elastic_surfaces,
    improves,
    register_surface,
    strain_quantile,
)
from s4a.method.remesh import laplacian
from s4a.method.shape import Basis
from s4a.options import Options
from s4a.schema import dataset
from s4a.study.pair import shape_of


@pytest.fixture(scope="module")
def pair():
    """A template, a shape with other vertices, and the true image of the template's vertices."""
    tree = synthetic.brains(2, 3000, seed=5)
    options = Options(n_coarse=1500, k=60)
    template, shape = (
        shape_of(tree["original"][name].to_dataset(), options) for name in ("brain_01", "brain_02")
    )
    truth = tree["truth"]
    at = synthetic.position(truth, "brain_02", truth["brain_01"]["reference_point"].values)
    return template, shape, shape.to_frame(at)


def initial_warps(template, shape):
    """Two initialisations: the given alignment, and a match with an error of 0.1 everywhere."""
    near = shape.low.tree.query(template.low.tree.data)[1]
    off = shape.low.tree.query(template.low.tree.data + [0.5, 0, 0, 0, 0, 0])[1]
    return [spectral_icp.fit_warp(shape.low, template.low, match) for match in (near, off)]


def error(image, true_image):
    return np.linalg.norm(image - true_image, axis=1).mean()


@pytest.fixture(scope="module")
def ends(pair):
    template, shape, _ = pair
    return [
        elastic.elastic_iterations(shape.full, template.low, warp)
        for warp in initial_warps(template, shape)
    ]


def test_they_are_more_accurate_than_spectral_icp(pair, ends):
    template, shape, true_image = pair
    near = shape.low.tree.query(template.low.tree.data)[1]
    warp = spectral_icp.coarse_spectral_icp(shape.low, template.low, near, k=60)[1]
    warp = spectral_icp.dense_spectral_icp(shape.full, template.full, warp)[1]
    by_joint = error(spectral_icp.move(template.full, warp), true_image)
    by_elastic = error(spectral_icp.move(template.full, ends[0]), true_image)
    assert by_elastic < 0.5 * by_joint


def test_no_triangle_is_flipped(pair, ends):
    template, _, _ = pair
    T = template.full.T
    image = spectral_icp.move(template.full, ends[0])
    around = vertex_normals(image, T)[T].mean(axis=1)
    assert (np.einsum("tx,tx->t", triangle_normals(image, T), around) > 0).all()


def test_a_linear_map_bends_nothing_and_stays(pair):
    template, _, _ = pair
    A = np.array([[1.1, 0.1, 0.0], [0.0, 0.95, 0.05], [-0.1, 0.0, 1.0]])
    source = replace(template.low, X=template.low.X @ A.T + 0.1)
    begin = A, np.full(3, 0.1), np.zeros((1, 3))
    R, t, c = elastic.elastic_iterations(source, template.low, begin)
    assert R == pytest.approx(A, abs=1e-6)
    assert t == pytest.approx(0.1, abs=1e-6)
    assert np.abs(c).max() < 1e-6


def test_the_normal_equations_are_those_of_the_sum():
    rng = np.random.default_rng(0)
    E, y = rng.normal(size=(20, 4)), rng.normal(size=(20, 3))
    area, m = rng.uniform(0.5, 1, 20), elastic.unit(rng.normal(size=(20, 3)))
    matrix, right = elastic.normal_equations(E, area, m, y, 0.1)

    def total(w):
        d = E @ w.reshape(3, -1).T - y
        across = (m * d).sum(1) ** 2
        return area @ (across + 0.1 * ((d**2).sum(1) - across))

    for _ in range(5):
        w, v = rng.normal(size=(2, 12))
        slope = (total(w + 1e-4 * v) - total(w - 1e-4 * v)) / 2e-4
        assert slope == pytest.approx(2 * (matrix @ w - right) @ v, rel=1e-5)  # float32


def test_nearest_points_are_on_the_surface_and_not_farther_than_nearest_vertices(pair):
    template, shape, _ = pair
    X, T = template.low.X, template.low.T
    points, normals = elastic.nearest_on_surface(shape.full, X, vertex_normals(X, T))
    assert distance_to_surface(points, shape.full.X, shape.full.T).max() < 1e-9
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    vertex = spectral_icp.nearest_vertices(shape.full, template.low.moved_to(X))
    distance = np.linalg.norm(points - X, axis=1).mean()
    assert distance < 0.9 * np.linalg.norm(shape.full.X[vertex] - X, axis=1).mean()


@pytest.fixture(scope="module")
def local(pair, ends):
    """Result of elastic iterations at low resolution, then displacement of local ones."""
    template, shape, _ = pair
    X = spectral_icp.move(template.low, ends[0])
    return X, elastic.local_iterations(shape.full, template.low, template.diffusion, X)


def surface_distance(X, shape):
    return distance_to_surface(X, shape.full.X, shape.full.T).mean()


def test_local_iterations_reduce_the_surface_distance_and_keep_the_accuracy(pair, ends, local):
    template, shape, true_image = pair
    X, d = local
    assert surface_distance(X + d, shape) < 0.8 * surface_distance(X, shape)
    before = spectral_icp.move(template.full, ends[0])
    after = before + template.U @ d
    # the deformation is as smooth as elastic iterations can fit; the residual is noise
    assert error(after, true_image) < 1.2 * error(before, true_image)


def test_a_part_that_the_template_lacks_moves_the_rest_little(pair):
    low = pair[0].low
    distance = np.linalg.norm(low.X - low.X[100], axis=1)
    bump = 0.2 * np.exp(-((distance / 0.06) ** 2))[:, None] * low.normals
    source = replace(low, X=low.X + bump)
    rest, moved = distance > 0.15, []
    warp = np.eye(3), np.zeros(3), np.zeros((60, 3))
    for schedule in (elastic.CONVERGENCE, elastic.CONVERGENCE._replace(outlier=np.inf)):
        X = spectral_icp.move(low, elastic.elastic_iterations(source, low, warp, schedule))
        moved.append(error(X[rest], low.X[rest]))
    assert moved[0] < 0.5 * moved[1], moved


def test_local_iterations_fit_a_bump_outside_the_span_of_the_basis(pair):
    template, _, _ = pair
    low = template.low
    point = low.X[100]
    bump = 0.01 * np.exp(-((low.X - point) ** 2).sum(1) / (2 * 0.05**2))[:, None] * low.normals
    source = replace(low, X=low.X + bump)
    d = elastic.local_iterations(source, low, template.diffusion, low.X)
    assert np.linalg.norm(d - bump, axis=1).max() < 0.4 * np.linalg.norm(bump, axis=1).max()
    coarse = low.truncated(10)
    left = bump - coarse.field(coarse.coefficients(bump))
    assert np.linalg.norm(d - bump, axis=1).mean() < 0.5 * np.linalg.norm(left, axis=1).mean()


def test_a_local_iteration_is_a_step_of_heat_diffusion(pair):
    template, shape, _ = pair
    low, time = template.low, 0.01
    d = elastic.local_iterations(
        shape.full, low, template.diffusion, low.X, time=(time, time), slide=1.0, iterations=1
    )
    y, _ = elastic.nearest_on_surface(shape.full, low.X, vertex_normals(low.X, low.T))
    W = stiffness(*cotan_weights(low.X, low.T), len(low.X))
    A = low.area[:, None]
    assert A * d + time * (W @ d) == pytest.approx(A * (y - low.X), abs=1e-9)


def test_on_the_surface_itself_nothing_is_left_to_do(pair):
    template, _, _ = pair
    low = template.low
    assert np.abs(elastic.local_iterations(low, low, template.diffusion, low.X)).max() < 1e-12


def test_piecewise_rigid_candidates_get_local_iterations_only(pair, monkeypatch):
    template, shape, _ = pair

    def never(*_args, **_options):
        raise AssertionError("elastic iterations begin at one transform for all")

    one = initial_warps(template, shape)[0]
    n = len(template.low.X)
    parts = np.repeat(one[0][None], n, 0), np.repeat(one[1][None], n, 0), one[2]
    candidate = spectral_icp.Candidate(0.0, np.zeros(n, int), parts)
    monkeypatch.setattr("s4a.method.register.elastic_iterations", never)
    functions = shape.low.Phi, template.low.Phi
    found = {
        asked: register_surface(shape, template, {"icp+parts": candidate}, functions, elastic=asked)
        for asked in (True, False)
    }
    assert {attrs["initialisation"] for _, _, attrs in found.values()} == {
        "icp+parts",
        "icp+parts+local",
    }
    distances = {asked: surface_distance(end.X, shape) for asked, (_, end, _) in found.items()}
    assert distances[True] < 0.8 * distances[False]


def test_of_converging_initialisations_one_is_kept_and_others_stay(pair):
    template, shape, _ = pair
    here, there = initial_warps(template, shape)[:2]
    half_turn = np.diag([-1.0, -1.0, 1.0])
    away = half_turn @ here[0], half_turn @ here[1], here[2] @ half_turn
    found = elastic_surfaces(shape, template, {"here": here, "there": there, "away": away})
    assert set(found) == {"here", "away"}
    alone = elastic_surfaces(shape, template, {"there": there})["there"]
    assert np.linalg.norm(alone - found["here"], axis=1).mean() < 1e-3


def test_a_ring_does_not_slide_around_its_axis():
    X, T = as_arrays(synthetic.torus(60, 24))
    angle = np.arctan2(X[:, 1], X[:, 0])
    middle = 3 * np.c_[np.cos(angle), np.sin(angle), 0 * angle]
    rings = [
        as_dataset(middle + (X - middle) * (1 + 0.3 * np.cos(angle) + side)[:, None], T)
        for side in (0, 0.1 * np.sin(angle))
    ]
    found = match_pair(*rings[::-1], alignment="given", n_coarse=400, k=30)
    wrong = np.angle(np.exp(1j * (angle[found["match"].values] - angle)))
    assert np.rad2deg(abs(wrong).mean()) < 3  # 18 with the very stiff iterations


def test_an_initialisation_that_converges_to_that_of_icp_changes_nothing(pair):
    template, shape, _ = pair
    here, there = initial_warps(template, shape)[:2]
    alone = elastic_surfaces(shape, template, {"icp": here})["icp"]
    found = elastic_surfaces(shape, template, {"intrinsic": there, "icp": here})
    assert list(found) == ["icp"]
    assert (found["icp"] == alone).all()


def test_less_stiff_iterations_are_more_accurate_for_a_strained_template(monkeypatch):
    tree = synthetic.brains(4, 2500, seed=25)
    template, shape = (tree[f"original/brain_{i:02d}"].to_dataset() for i in (3, 4))
    at = tree["truth/brain_03/reference_point"].values
    true = synthetic.position(tree["truth"], "brain_04", at)

    def registered():
        found = match_pair(shape, template, n_coarse=600, k=50)
        image = image_in_shape(template["position"].values, found)
        torn = np.quantile(abs(found["distortion"]), 0.99)
        return found.attrs["initialisation"], torn, np.linalg.norm(image - true, axis=1).mean()

    method, torn, error = registered()
    monkeypatch.setattr("s4a.method.register.MAX_STRAIN", np.inf)
    stiff, torn_before, error_before = registered()
    assert method.endswith("+looser")
    assert stiff.endswith("+elastic")
    assert torn < torn_before
    assert error < 0.7 * error_before


def test_a_less_stiff_result_is_chosen_if_score_and_strain_decrease_together(pair):
    N = pair[0].full
    near = np.exp(-40 * ((N.X - N.X[0]) ** 2).sum(1))

    def end(score, stretch):
        moved = N.moved_to(N.X[0] + (N.X - N.X[0]) * (1 + stretch * near)[:, None])
        return score, moved

    torn = end(1.0, 0.8)
    assert strain_quantile(end(1.0, 0.0)[1], N) == pytest.approx(0, abs=1e-9)
    assert strain_quantile(torn[1], N) > MAX_STRAIN
    assert improves(end(0.97, 0.3), torn, N)  # right fold: slightly better score, little strain
    assert not improves(end(0.91, 1.0), torn, N)  # fits noise: better score, more strain
    assert not improves(end(2.0, 0.5), torn, N)  # merely stiffer


def test_a_coarse_triangle_without_area_is_no_obstacle(pair):
    template, shape, _ = pair
    coarse = template.coarse.copy(deep=True)
    X, T = coarse["position"].values, coarse["corner_vertex"].values
    X[T[0, 1]] = X[T[0, 0]]  # its cotangents are infinite, and the robust Laplacian's are not
    E, w, _, kind = laplacian(X, T, coarse["vertex_area"].values)
    assert kind == "robust"
    spoilt = coarse.drop_vars(["edge_vertex", "cotan_weight"])
    spoilt = replace(template, coarse=spoilt.assign(dataset(edge_vertex=E, cotan_weight=w)))
    start = spectral_icp.fit_warp(
        shape.low, spoilt.low, spectral_icp.nearest_vertices(shape.low, spoilt.low.moved_to(X))
    )
    surface = elastic_surfaces(shape, spoilt, {"icp": start})["icp"]
    assert np.isfinite(surface).all()


def test_the_stiffness_is_computed_again_where_a_study_was_made_smaller(pair):
    template, _, _ = pair
    smaller = replace(template, coarse=template.coarse.drop_vars(["edge_vertex", "cotan_weight"]))
    assert (smaller.W != template.W).nnz == 0


def bowl(n_vertices, height=0.0):
    """An ellipsoid below a height, where it ends in a straight cut."""
    mesh = synthetic.ellipsoid(n_vertices, (1.0, 0.8, 0.6))
    X, T = mesh["position"].values, mesh["corner_vertex"].values
    T = T[(X[:, 2] < height)[T].all(axis=1)]
    used = np.unique(T)
    X, T = X[used], np.searchsorted(used, T)
    boundary = Basis(X, T, np.ones(len(X)), X).boundary
    X[np.unique(boundary), 2] = height
    return as_dataset(X, T)


def rim_height(template, shape):
    """Mean height of the boundary of the registered template above that of the shape."""
    warp = spectral_icp.fit_warp(
        shape.low, template.low, shape.low.tree.query(template.low.tree.data)[1]
    )
    end = elastic.elastic_iterations(shape.full, template.low_on_surface, warp)
    top = shape.from_frame(spectral_icp.move(template.low, end))[
        np.unique(template.low.boundary), 2
    ]
    return np.abs(top - shape.from_frame(shape.full.boundary_tree.data)[:, 2].mean()).mean()


def test_boundaries_that_lie_on_each_other_end_on_each_other(monkeypatch):
    options = Options(n_coarse=800, k=40)
    template, shape = (shape_of(bowl(*how), options) for how in ((2000,), (2600, 0.05)))
    drawn = rim_height(template, shape)
    monkeypatch.setattr(elastic, "BOUNDARY_WEIGHT", 0.0)
    assert drawn < 0.5 * rim_height(template, shape)


def test_a_shape_that_ends_elsewhere_keeps_its_boundary(monkeypatch):
    options = Options(n_coarse=800, k=40)
    template, shape = (shape_of(bowl(*how), options) for how in ((2000,), (2600, 0.2)))
    assert elastic.boundary_attraction(shape.full, template.low, template.low.X) is None
    kept = rim_height(template, shape)
    monkeypatch.setattr(elastic, "BOUNDARY_WEIGHT", 0.0)
    assert kept == rim_height(template, shape)
    closed = shape_of(synthetic.ellipsoid(1000), options)
    assert elastic.boundary_attraction(closed.full, template.low, template.low.X) is None
    assert elastic.boundary_attraction(template.full, closed.low, closed.low.X) is None


@pytest.mark.parametrize("below", [-1e-11, -1e-7])
def test_a_direction_with_a_negative_eigenvalue_by_rounding_is_truncated(below):
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    eigenvalues = np.array([1.0, 0.5, 1e-6, below])
    matrix = axes * eigenvalues @ axes.T
    matrix = (matrix + matrix.T) / 2
    right = axes @ np.array([1.0, 1.0, 1e-6, 1e-6])
    with pytest.raises(np.linalg.LinAlgError):
        scipy.linalg.solve(matrix, right, assume_a="pos")
    along = axes.T @ elastic.solve_normal_equations(matrix, right)
    assert along == pytest.approx([1, 2, 1, 0], abs=1e-4)
    sound = matrix + np.eye(4)
    assert (
        elastic.solve_normal_equations(sound, right)
        == scipy.linalg.solve(sound, right, assume_a="pos")
    ).all()
