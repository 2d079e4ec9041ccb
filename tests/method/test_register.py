"""Registration at full resolution (eq. 4, 6, 7).

The identity, a simulated deformation, invariance, closest template points.
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from s4a import clean, coarsen, match_pair, spectrum, synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method import register
from s4a.method.deform import displacement_in_template
from s4a.method.register import confidence
from s4a.method.shape import Shape

OPTIONS = {"n_coarse": 2000, "k": 60}
STILL = np.eye(3), np.zeros(3)  # no transform


def bumps(X, size):
    return (
        0.015
        * size
        * np.stack([np.sin(6 * X[:, 1]), np.sin(5 * X[:, 2] + 1), np.cos(6 * X[:, 0])], axis=1)
    )


@pytest.fixture(scope="module")
def template():
    return synthetic.brains(1, 5000)["original/brain_01"].to_dataset()


@pytest.fixture(scope="module")
def size(template):
    """Square root of the template's area, in mm."""
    return np.sqrt(vertex_areas(*as_arrays(template)).sum())


@pytest.fixture(scope="module")
def deformed(template, size):
    """The template after a known smooth deformation, in the template's vertex order."""
    X, T = as_arrays(template)
    return clean(as_dataset(X + bumps(X / size, size), T))


@pytest.fixture(scope="module")
def pair(deformed, template):
    return match_pair(deformed, template, **OPTIONS)


@pytest.fixture(scope="module")
def true_displacement(template, deformed):
    X, T = as_arrays(template)
    return displacement_in_template(X, deformed["position"].values, vertex_areas(X, T))[0]


def mean_difference(found, other, size):
    """Mean distance of two displacements, as a share of sqrt(area)."""
    return np.linalg.norm(found["displacement"].values - other, axis=1).mean() / size


def test_a_shape_registered_to_itself_does_not_move(template, size):
    found = match_pair(template, template, **OPTIONS)
    assert (found["match"].values == np.arange(5000)).all()
    assert np.abs(found["displacement"].values).max() < 1e-6 * size
    assert np.abs(found["displacement_raw"].values).max() < 1e-6 * size
    assert found["confidence"].values == pytest.approx(1, abs=1e-5)
    assert found["round_trip"].values == pytest.approx(0, abs=1e-5)
    assert found["distortion"].values == pytest.approx(0, abs=1e-4)
    assert found["fmap"].values == pytest.approx(np.eye(60), abs=1e-6)


def test_a_simulated_deformation_is_recovered_more_accurately_than_by_nearest_neighbours(
    pair, template, deformed, true_displacement, size
):
    true = deformed["position"].values
    near = cKDTree(true).query(template["position"].values)[1]
    nearest = np.linalg.norm(true[near] - true, axis=1).mean() / size
    assert nearest > 0.01
    assert mean_difference(pair, true_displacement, size) < 0.002
    assert mean_difference(pair, true_displacement, size) < nearest / 4
    assert (pair["match"].values == np.arange(5000)).mean() > 0.7


def test_the_algorithm_of_the_paper_finds_a_correspondence_and_is_named(template, deformed, size):
    found = match_pair(deformed, template, refine="intrinsic", init="landmarks", **OPTIONS)
    assert found.attrs["initialisation"] == "intrinsic"
    assert 0 < found.attrs["compared_share"] < 1
    assert 0 < found.attrs["certified_share"] <= 1
    distance = deformed["position"].values[found["match"].values] - deformed["position"].values
    assert np.linalg.norm(distance, axis=1).mean() < 0.03 * size


@pytest.mark.parametrize("degrees", [10, 70, 170])
def test_the_displacement_does_not_depend_on_the_pose_of_the_source(
    template, deformed, true_displacement, size, degrees
):
    X, T = as_arrays(deformed)
    R = Rotation.from_rotvec(degrees * np.array([0.6, 0, 0.8]), True).as_matrix()
    found = match_pair(clean(as_dataset(X @ R.T + 70, T)), template, **OPTIONS)
    assert mean_difference(found, true_displacement, size) < 0.003


def test_the_result_does_not_depend_on_the_numbering_of_the_source(pair, template, deformed, size):
    X, T = as_arrays(deformed)
    order = np.random.default_rng(0).permutation(len(X))
    other = clean(as_dataset(X[order], np.argsort(order)[T]))
    found = match_pair(other, template, **OPTIONS)
    assert mean_difference(found, pair["displacement"].values, size) < 0.002
    vertex = order[other["file_vertex"].values][found["match"].values]
    assert (vertex == pair["match"].values).mean() > 0.7


@pytest.fixture(scope="module")
def shapes(template, deformed):
    return [Shape(m, spectrum(coarsen(m, n_coarse=800), k=30)) for m in (deformed, template)]


def test_closest_template_points_reproduce_the_positions(shapes):
    source, target = shapes
    image = source.original["position"].values  # the template deformed exactly
    moved = target.full.moved_to(source.to_frame(image))
    triangle, weight = register.closest_on_template(source.full, moved)
    assert weight.sum(1) == pytest.approx(1)
    assert weight.min() >= 0
    found = np.einsum("nc,ncx->nx", weight, image[target.full.T[triangle]])
    assert found == pytest.approx(image, abs=1e-6)


def test_confidence_is_high_for_a_true_image_and_low_where_that_is_broken(shapes):
    source, target = shapes
    image, every = source.full.X, np.arange(5000)
    assert confidence(source, target, every, image).min() > 0.5
    away = target.full.X[:, 0] > 0.15
    broken = image.copy()
    broken[away] += 0.1 * np.random.default_rng(0).standard_normal((away.sum(), 3))
    found = confidence(source, target, every, broken)
    assert 0 <= found.min() <= found.max() <= 1
    assert found[target.full.X[:, 0] > 0.2].mean() < 0.05
    assert found[target.full.X[:, 0] < 0].mean() > 0.9


def test_confidence_falls_where_the_template_leaves_the_surface_and_where_it_is_stretched(shapes):
    source, target = shapes
    image, every = source.full.X, np.arange(5000)
    sure = confidence(source, target, every, image).mean()
    center = image.mean(axis=0)
    off = confidence(source, target, every, center + 1.02 * (image - center))
    stretched = confidence(source, target, every, image * [1.3, 1, 1 / 1.3])
    assert off.mean() < sure - 0.1
    assert stretched.mean() < off.mean()


def test_the_template_is_registered_to_itself_by_definition(template):
    own = register.identity(shape := Shape(template, template))
    X, T = as_arrays(template)
    corner = X[T[own["template_triangle"].values]]
    assert np.einsum("nc,ncx->nx", own["template_barycentric"].values, corner) == pytest.approx(X)
    assert (own["registered_match"].values == np.arange(5000)).all()
    assert shape.frame[1] == pytest.approx(np.sqrt(vertex_areas(X, T).sum()))


def test_size_can_be_removed_from_the_displacement(shapes):
    _, target = shapes
    X, T = as_arrays(target.original)
    grown = clean(as_dataset(1.2 * X, T))
    source = Shape(grown, spectrum(coarsen(grown, n_coarse=800), k=30))
    start = {"intrinsic": cKDTree(source.low.X).query(target.low.X)[1]}
    functions = source.low.Phi, target.low.Phi
    with_size = register.register(source, target, start, functions, STILL, k=30)
    without = register.register(source, target, start, functions, STILL, k=30, remove_size=True)
    assert without["scale"].item() == pytest.approx(1 / 1.2, rel=1e-3)
    radius = np.linalg.norm(X - X.mean(0), axis=1).mean()
    assert np.linalg.norm(without["displacement"].values, axis=1).mean() < 0.005 * radius
    assert np.linalg.norm(with_size["displacement"].values, axis=1).mean() == pytest.approx(
        0.2 * radius, rel=0.03
    )


def test_more_functions_than_a_mesh_has_are_reduced_and_it_is_said():
    meshes = synthetic.brains(2, 40)["original"]
    found = match_pair(*(meshes[n].to_dataset() for n in meshes), k=60, k_init=10, n_coarse=100)
    assert found["fmap"].shape == (38, 38)
    assert (
        found.attrs["note"] == "k = 60 reduced to 38, the eigenfunctions that the smaller mesh has"
    )


def test_a_mesh_without_triangles_is_refused_by_name(template):
    with pytest.raises(ValueError, match="source needs the variables position, corner_vertex"):
        match_pair(template[["position"]], template)


def test_distortion_is_the_log_of_the_areas_ratio_and_size_does_not_count():
    X, T = as_arrays(synthetic.sphere(2000))
    assert register.log_area_ratio(3 * X, X, T) == pytest.approx(0)
    half = X * [1, 1, 2]  # an ellipsoid: a band around the equator grows twofold, the poles stay
    found = register.log_area_ratio(half, X, T)
    total = np.log(vertex_areas(half, T).sum() / vertex_areas(X, T).sum())
    height = np.abs(X[:, 2])
    assert np.median(found[height < 0.05]) == pytest.approx(np.log(2) - total, abs=0.02)
    assert np.median(found[height > 0.99]) == pytest.approx(-total, abs=0.03)


def test_the_match_of_eq_6_is_kept_at_low_resolution_as_it_is(pair, deformed, template, size):
    low = pair["displacement_low"].values
    assert low.shape[1] == 3
    assert low.shape[0] < 2500
    template_low, shape_low = (
        coarsen(m, n_coarse=2000)["position"].values for m in (template, deformed)
    )
    R, t = pair["rotation"].values, pair["translation"].values
    distance = cKDTree(shape_low @ R.T + t).query(template_low + low)[0]
    assert distance.max() < 1e-4 * size  # every one is at a vertex of the coarse shape
