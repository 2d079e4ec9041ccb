"""Spectral ICP and displacement (eq. 8): simulated deformations, and the score of a match."""

from dataclasses import replace

import numpy as np
import pytest
from paths import DATA
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from s4a import clean, coarsen, spectrum, synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas, vertex_normals
from s4a.method import deform, spectral_icp
from s4a.method.shape import Shape


def bumps(X):
    """A smooth field that moves the points of a shape of unit area by a tenth of its radius."""
    return 0.02 * np.stack(
        [np.sin(6 * X[:, 1]), np.sin(5 * X[:, 2] + 1), np.cos(6 * X[:, 0])], axis=1
    )


@pytest.fixture(scope="module")
def surface():
    """A shape of unit area with its eigenfunctions."""
    mesh = spectrum(
        coarsen(synthetic.brains(1, 6000)["original/brain_01"].to_dataset(), n_coarse=1500), k=60
    )
    return Shape(coarse=mesh).low


def moved(surface, X):
    return replace(surface, X=X)


def test_spectral_icp_keeps_the_identity(surface):
    every = np.arange(len(surface.X))
    match, transform = spectral_icp.coarse_spectral_icp(surface, surface, every, k=60)
    assert (match == every).all()
    assert spectral_icp.move(surface, transform) == pytest.approx(surface.X, abs=1e-12)


@pytest.mark.parametrize("spectral", [None, (0.1, 0.1), (0.7, 0.2)])
def test_a_simulated_deformation_is_recovered_far_more_accurately_than_by_nearest_neighbours(
    surface, spectral
):
    source = moved(surface, surface.X + bumps(surface.X))
    start = cKDTree(source.X).query(surface.X)[1]
    match, transform = spectral_icp.coarse_spectral_icp(
        source, surface, start, k=60, spectral=spectral
    )
    error = np.linalg.norm(spectral_icp.move(surface, transform) - source.X, axis=1).mean()
    nearest = np.linalg.norm(source.X[start] - source.X, axis=1).mean()
    assert nearest > 0.015
    assert error < 0.005
    assert error < nearest / 4
    assert (match == np.arange(len(match))).mean() > 0.6


@pytest.mark.skipif(not (DATA / "faust_r").is_dir(), reason="needs ../shared/data/faust_r")
def test_hands_stay_where_the_consistent_map_of_a_network_puts_them():
    shapes, corresponding = [], []
    for number in (15, 11):  # a body whose arms hang, and one with its hands on its hips
        with np.load(DATA / "faust_r" / f"tr_reg_{number:03d}.npz") as body:
            mesh = clean(as_dataset(body["vertices"].astype(float), body["faces"]))
            vertex = mesh["vertex_of_file"].values[body["corres"]]
        low = coarsen(mesh, n_coarse=6000)  # of all vertices, in another order
        corresponding.append(np.argsort(low["sample_vertex"].values)[vertex])
        shapes.append(Shape(mesh, spectrum(low, k=100)).low)
    (source, target), (there, here) = shapes, corresponding
    # the correspondence of the data, at the nearest vertices that have one
    nearest = cKDTree(target.X[here]).query(target.X)[1]
    errors = {}
    for name, weights in (("pair", spectral_icp.PAIR), ("network", spectral_icp.NETWORK)):
        match = spectral_icp.coarse_spectral_icp(
            source,
            target,
            there[nearest],
            k_initial=20,
            iterations=1,
            spectral=weights,
            articulated=True,
        )[0]
        errors[name] = np.linalg.norm(source.X[match[here]] - source.X[there], axis=1)
    largest = {name: np.quantile(error, 0.99) for name, error in errors.items()}
    assert largest["network"] < 0.065 < largest["pair"]


def test_a_rigid_motion_is_recovered_exactly_without_any_deformation(surface):
    R = Rotation.from_rotvec([0.3, 0.2, -0.1]).as_matrix()
    source = moved(surface, surface.X @ R.T + 0.2)
    _, (found, t, c) = spectral_icp.coarse_spectral_icp(
        source, surface, np.arange(len(surface.X)), k=40
    )
    assert found == pytest.approx(R, abs=1e-9)
    assert t == pytest.approx([0.2] * 3, abs=1e-9)
    assert np.abs(c).max() < 1e-9


def test_dense_spectral_icp_keeps_a_simulated_deformation_of_the_span(surface):
    c = np.zeros((60, 3))
    c[4:12] = np.random.default_rng(0).normal(0, 0.008, (8, 3))
    source = moved(surface, surface.X + surface.Phi @ c)
    match, transform = spectral_icp.dense_spectral_icp(
        source, surface, (np.eye(3), np.zeros(3), 0.9 * c)
    )
    assert (match == np.arange(len(match))).mean() > 0.95
    assert np.linalg.norm(spectral_icp.move(surface, transform) - source.X, axis=1).mean() < 2e-3


def test_a_wrong_match_scores_worse_than_a_right_one(surface):
    every = np.arange(len(surface.X))
    source = moved(surface, surface.X + bumps(surface.X))

    def score(match):
        warp = deform.onto(surface.X, source.X[match], surface.area, surface.coefficients)
        return spectral_icp.registration_score(
            source, surface, match, surface.moved_to(spectral_icp.move(surface, warp))
        )

    right = score(every)
    assert right < 0.02
    assert score(cKDTree(source.X).query(surface.X)[1]) > right
    assert score(np.random.default_rng(0).permutation(every)) > 10 * right


def test_the_finalists_are_the_candidates_of_least_score(surface):
    source = moved(surface, surface.X + bumps(surface.X))
    near = cKDTree(source.X).query(surface.X)[1]
    bad = np.zeros(len(near), int)
    found = spectral_icp.candidates(source, surface, {"bad": bad, "icp": near}, k=60)
    assert {"bad", "icp", "bad+joint", "icp+joint"} <= set(found)
    name, *others = spectral_icp.finalists(found, margin=1.25)
    assert name == "icp+joint"
    score, match, transform = found[name]
    assert score == min(s for s, *_ in found.values())
    assert all(found[other][0] <= 1.25 * score for other in others)
    assert "bad" not in others
    assert np.linalg.norm(spectral_icp.move(surface, transform) - source.X, axis=1).mean() < 0.005
    assert len(match) == len(surface.X)


def test_smoothing_keeps_fields_of_the_span_and_is_a_projection(surface):
    B = surface.Phi @ np.random.default_rng(1).normal(
        size=(60, 60)
    )  # a basis that is not orthonormal
    smooth = deform.smoother(B, surface.area)
    d = surface.Phi[:, :60] @ np.random.default_rng(2).normal(size=(60, 3))
    assert B @ smooth(d) == pytest.approx(d, abs=1e-6)
    rough = np.random.default_rng(3).normal(size=d.shape)
    left = rough - B @ smooth(rough)
    assert B.T @ (surface.area[:, None] * left) == pytest.approx(np.zeros((60, 3)), abs=1e-7)


@pytest.mark.parametrize("scale", [False, True])
def test_the_displacement_in_the_template_is_image_minus_template_after_alignment(scale):
    rng = np.random.default_rng(4)
    X, area = rng.normal(size=(50, 3)), rng.uniform(0.5, 1, 50)
    R = Rotation.random(random_state=0).as_matrix()
    image = 1.5 * X @ R.T + [1, 2, 3]
    d, R_back, t, s = deform.displacement_in_template(X, image, area, scale=scale)
    assert s * image @ R_back.T + t == pytest.approx(X + d)
    assert R_back == pytest.approx(R.T)
    if scale:
        assert s == pytest.approx(1 / 1.5)
        assert d == pytest.approx(np.zeros_like(d), abs=1e-12)
    else:
        assert s == 1
        assert d == pytest.approx(0.5 * (X - area @ X / area.sum()))


def test_growth_is_a_positive_displacement_along_the_normals():
    X, T = as_arrays(synthetic.sphere(500))
    normal = vertex_normals(X, T)
    assert deform.normal_displacement(np.stack([0.1 * X, -0.2 * X]), normal) == pytest.approx(
        np.repeat([[0.1], [-0.2]], 500, axis=1), rel=0.01
    )
    assert vertex_areas(X, T).sum() == pytest.approx(4 * np.pi, rel=0.02)
