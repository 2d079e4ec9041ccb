"""Metrics: known answers, and what each of them can and cannot see."""

import numpy as np
import pytest
import xarray as xr

from s4a import metrics, synthetic
from s4a.geometry.mesh import as_arrays, cotan_weights, triangle_areas, vertex_areas
from s4a.method.spectral import eigenpairs
from s4a.schema import dataset


@pytest.fixture(scope="module")
def ball():
    return synthetic.sphere(1200)


@pytest.fixture(scope="module")
def arrays(ball):
    return as_arrays(ball)


@pytest.fixture
def shuffled(ball):
    return np.random.default_rng(0).permutation(ball.sizes["vertex"])


def test_a_random_permutation_scores_0_on_chamfer_and_hausdorff_and_badly_where_truth_is_seen(
    ball, shuffled
):
    same = np.arange(len(shuffled))
    wrong = metrics.evaluate(ball, ball, shuffled, reverse=np.argsort(shuffled), truth=same)
    for name in ("chamfer", "hausdorff", "hausdorff_paper", "bijectivity"):
        assert wrong[name] == 0, name
    assert wrong["coverage"] == 1
    assert wrong["geodesic_error"] > 0.3
    assert wrong["euclidean_error"] > 0.3
    assert wrong["dirichlet"] > 100
    assert wrong["conformal_distortion"] > 0.5


def test_the_identity_is_perfect_by_every_metric(ball):
    same = np.arange(ball.sizes["vertex"])
    found = metrics.evaluate(ball, ball, same, reverse=same, truth=ball["position"].values)
    zero = "chamfer hausdorff hausdorff_paper bijectivity".split()
    zero += "collapsed_share geodesic_error euclidean_error".split()
    for name in [*zero, "conformal_distortion", "area_distortion"]:
        assert found[name] == pytest.approx(0, abs=1e-6), name
    assert found["coverage"] == 1
    assert (found["error_curve"] == 1).all()


def test_chamfer_and_hausdorff_of_a_sphere_and_a_larger_one_are_the_difference_of_radii(arrays):
    X, _ = arrays
    assert metrics.chamfer(X, 1.5 * X) == pytest.approx(2 * 0.5)
    assert metrics.hausdorff(X, 1.5 * X) == pytest.approx(0.5)
    assert metrics.hausdorff(X, 1.5 * X, "paper") == pytest.approx(0.5 + 0.5 / len(X))


def test_the_printed_hausdorff_distance_all_but_ignores_one_of_both_ways():
    near, far = np.zeros((100, 3)), np.zeros((100, 3))
    far[0] = 7
    gap = np.sqrt(3) * 7
    assert metrics.hausdorff(near, far) == metrics.hausdorff(far, near) == pytest.approx(gap)
    assert metrics.hausdorff(near, far, "paper") == pytest.approx(gap / 100)
    with pytest.raises(ValueError, match="formula"):
        metrics.hausdorff(near, far, "printed")


def test_the_dirichlet_energy_of_coordinates_is_twice_the_area_of_an_eigenfunction_its_eigenvalue(
    arrays,
):
    X, T = arrays
    E, w = cotan_weights(X, T)
    assert metrics.dirichlet(X, E, w) == pytest.approx(2 * triangle_areas(X, T).sum())
    eigenvalue, Phi = eigenpairs(E, w, vertex_areas(X, T), 8)
    assert [metrics.dirichlet(f, E, w) for f in Phi.T] == pytest.approx(eigenvalue, abs=1e-6)
    assert metrics.dirichlet(Phi, E, w) == pytest.approx(eigenvalue.sum())


def test_the_dirichlet_energy_does_not_see_a_map_to_one_point_but_coverage_and_distortion_do(ball):
    point = np.zeros(ball.sizes["vertex"], int)
    found = metrics.evaluate(ball, ball, point)
    assert found["dirichlet"] == 0
    assert found["coverage"] < 0.002
    assert found["collapsed_share"] == 1
    assert np.isinf(found["conformal_distortion"])


def test_a_similarity_has_no_conformal_distortion_and_its_factor_squared_as_area_distortion(arrays):
    X, T = arrays
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    conformal, area = metrics.distortion(X, 3 * X @ turn.T + 5, T)
    assert conformal == pytest.approx(0, abs=1e-6)
    assert area == pytest.approx(np.log(9))


def test_the_distortion_of_a_linear_map_is_that_of_its_singular_values_on_each_triangle(arrays):
    X, T = arrays
    axes = np.array([3.0, 2.0, 1.0])
    conformal, area = metrics.distortion(X, X * axes, T)
    for t in range(0, len(T), 50):
        sides = (X[T[t, 1:]] - X[T[t, 0]]).T
        frame, flat = np.linalg.qr(sides)
        s = np.linalg.svd(axes[:, None] * sides @ np.linalg.inv(flat), compute_uv=False)
        assert frame.shape == (3, 2)
        assert conformal[t] == pytest.approx(np.log(s[0] / s[1]), abs=1e-7)
        assert area[t] == pytest.approx(np.log(s[0] * s[1]))


def test_an_ellipsoid_over_a_sphere_has_the_distortion_of_its_axes_at_the_poles(arrays):
    X, T = arrays
    conformal, area = metrics.distortion(X, X * [3.0, 2.0, 1.0], T)
    pole = np.abs(X[T].mean(1)[:, 2]).argmax()  # there the tangent plane is that of x and y
    assert conformal[pole] == pytest.approx(np.log(1.5), abs=0.02)
    assert area[pole] == pytest.approx(np.log(6), abs=0.02)


def test_triangles_without_area_are_left_out_and_those_that_collapse_are_counted():
    X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0, 0]])
    T = np.array([[0, 1, 2], [1, 3, 2], [0, 1, 4]])
    conformal, area = metrics.distortion(X, X[[0, 1, 2, 2, 4]], T)
    assert np.isfinite(conformal[0])
    assert (conformal[1], area[1]) == (np.inf, -np.inf)
    assert np.isnan([conformal[2], area[2]]).all()


def test_the_geodesic_error_is_the_arc_on_a_sphere_of_unit_area_up_to_the_edges(arrays):
    X, T = arrays
    north, south = X[:, 2].argmax(), X[:, 2].argmin()
    for scale in (1.0, 20.0):
        error = metrics.geodesic_error(
            scale * X, T, np.array([south, north]), np.array([north, north]), limit=2.0
        )
        assert error[1] == 0
        arc = np.pi / np.sqrt(4 * np.pi)
        assert 0.99 * arc < error[0] < 1.12 * arc
    assert metrics.geodesic_error(X, T, np.array([south]), np.array([north]), limit=0.3) == 0.3


def test_the_error_curve_counts_what_is_no_larger_than_the_threshold():
    error = np.array([0.2, 0.0, 0.1, 0.1])
    assert metrics.error_curve(error, [0.0, 0.05, 0.1, 0.2]).tolist() == [0.25, 0.25, 0.75, 1.0]


def test_a_cycle_of_rotations_of_the_numbering_closes_and_a_broken_one_does_not(arrays, shuffled):
    X, T = arrays
    back = np.argsort(shuffled)
    assert (metrics.cycle_error(X, T, shuffled, back) == 0).all()
    assert (metrics.cycle_error(X, T, shuffled, shuffled, back[back]) == 0).all()
    assert (
        metrics.cycle_error(X, T, shuffled, np.roll(back, 1), vertices=np.arange(50)).mean() > 0.2
    )


def test_a_symmetric_flip_there_and_back_is_not_seen_by_the_round_trip_but_by_the_truth(ball):
    X = ball["position"].values
    flip = np.linalg.norm(X[:, None] - X[None] * [1, 1, -1], axis=2).argmin(1)
    order = np.arange(len(X))
    found = metrics.evaluate(ball, ball, flip, reverse=flip, truth=order)
    assert found["bijectivity"] < 0.02
    assert found["geodesic_error"] > 0.2


def test_coverage_is_the_area_of_the_vertices_that_are_hit(arrays):
    X, T = arrays
    area, half = vertex_areas(X, T), np.flatnonzero(X[:, 2] > 0)
    match = np.resize(half, len(X))
    assert metrics.coverage(match, area) == pytest.approx(area[half].sum() / area.sum())


def test_labels_are_counted_by_area_and_overlap_is_that_of_sets():
    found, true = np.array([1, 1, 1, 2]), np.array([1, 1, 2, 2])
    assert metrics.label_accuracy(found, true) == 0.75
    assert metrics.label_accuracy(found, true, np.array([1.0, 1, 2, 0])) == 0.5
    assert metrics.dice(found, true) == pytest.approx({1: 0.8, 2: 2 / 3})
    assert metrics.dice(np.array(["a"]), np.array(["b"])) == {"a": 0, "b": 0}


def test_labels_and_landmarks_of_both_meshes_are_compared_by_name(ball):
    X = ball["position"].values
    marks = {"landmark_name": ["a", "b"], "landmark_position": X[[3, 90]]}
    source = ball.merge(dataset(label=(X[:, 0] > 0).astype(int), **marks))
    marks = {"landmark_name": ["b", "only here", "a"], "landmark_position": X[[90, 7, 3]]}
    target = ball.merge(dataset(label=(X[:, 0] > 0).astype(int), **marks))
    found = metrics.evaluate(source, target, np.arange(len(X)))
    assert found["label_accuracy"] == found["label_dice"] == 1
    assert found["landmark_error"] == pytest.approx(0, abs=1e-9)
    flip = np.linalg.norm(X[:, None] + X[None], axis=2).argmin(1)
    found = metrics.evaluate(source, target, flip)
    assert found["label_accuracy"] < 0.1
    size = np.sqrt(triangle_areas(*as_arrays(ball)).sum())
    assert found["landmark_error"] == pytest.approx(2 / size, rel=0.02)


def test_no_metric_depends_on_the_units_of_both_surfaces(ball, shuffled):
    near = np.where(np.arange(len(shuffled)) % 3, np.arange(len(shuffled)), np.sort(shuffled)[::-1])
    small = metrics.evaluate(ball, ball, near, truth=ball["position"].values)
    scaled = [ball.assign(position=s * ball["position"]) for s in (40.0, 0.01)]
    large = metrics.evaluate(*scaled, near, truth=scaled[0]["position"].values)
    for name in small:
        assert large[name].values == pytest.approx(small[name].values, rel=1e-6), name


def test_an_image_between_vertices_scores_better_than_its_vertices(ball):
    X, n = ball["position"].values, ball.sizes["vertex"]
    turn = np.array([[np.cos(0.02), -np.sin(0.02), 0], [np.sin(0.02), np.cos(0.02), 0], [0, 0, 1]])
    found = metrics.evaluate(ball, ball, np.arange(n), image=X @ turn.T, truth=X @ turn.T)
    assert found["euclidean_error"] == pytest.approx(0, abs=1e-12)
    assert metrics.evaluate(ball, ball, np.arange(n), truth=X @ turn.T)["euclidean_error"] > 0.003


def test_where_the_truth_is_unknown_nothing_is_measured(ball, shuffled):
    X, n = ball["position"].values, ball.sizes["vertex"]
    match = np.arange(n)
    match[: n // 2] = shuffled[: n // 2]
    vertex, position = np.arange(n), X.copy()
    vertex[: n // 2], position[: n // 2] = -1, np.nan
    for truth in (vertex, position):
        found = metrics.evaluate(ball, ball, match, truth=truth)
        assert found["geodesic_error"] == found["euclidean_error"] == 0
    with pytest.raises(ValueError, match="unknown at every vertex"):
        metrics.evaluate(ball, ball, match, truth=np.full(n, -1))


def test_evaluations_stack_over_algorithms_and_pairs(ball, shuffled):
    same = np.arange(len(shuffled))
    rows = [
        xr.concat(
            [metrics.evaluate(ball, ball, m, truth=same) for m in (same, shuffled)], "algorithm"
        )
        for _ in range(2)
    ]
    table = xr.concat(rows, "pair")
    assert dict(table["chamfer"].sizes) == {"pair": 2, "algorithm": 2}
    assert table["chamfer"].attrs["units"] == "share of sqrt(area)"
    assert (
        table["geodesic_error"].isel(algorithm=0) < table["geodesic_error"].isel(algorithm=1)
    ).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"match": np.arange(3)}, "match needs 1200 integers"),
        ({"match": np.full(1200, 1200)}, "from 0 to 1199"),
        ({"match": np.zeros(1200)}, "integers"),
        ({"reverse": np.full(1200, -1)}, "reverse needs"),
        ({"image": np.zeros((1200, 2))}, "image needs"),
        ({"truth": np.zeros(1200)}, "truth needs"),
        ({"truth": np.full(1200, 5000)}, "below 1200"),
    ],
)
def test_arrays_that_do_not_fit_the_meshes_are_refused(ball, change, message):
    with pytest.raises(ValueError, match=message):
        metrics.evaluate(**({"source": ball, "target": ball, "match": np.arange(1200)} | change))
