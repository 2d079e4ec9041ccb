"""Rigid alignment (4.1, step 2): transforms that are known come back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from s4a import synthetic
from s4a.geometry import align
from s4a.geometry.compiled import Missing
from s4a.geometry.mesh import as_arrays, vertex_areas


def turned(degrees, axis=(1, 2, 3)):
    axis = np.array(axis) / np.linalg.norm(axis)
    return Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()


@pytest.fixture(scope="module")
def brain():
    """Vertices and areas of a lopsided shape, centred and of unit area."""
    X, T = as_arrays(synthetic.brains(1, 2000)["original/brain_01"].to_dataset())
    area = vertex_areas(X, T)
    X = (X - area @ X / area.sum()) / np.sqrt(area.sum())
    return X, area / area.sum()


@pytest.mark.parametrize("seed", range(5))
def test_a_motion_and_a_scale_are_recovered_exactly(seed):
    rng = np.random.default_rng(seed)
    P, weight = rng.normal(size=(40, 3)), rng.uniform(0.1, 2, 40)
    R, t, s = (
        Rotation.random(random_state=seed).as_matrix(),
        rng.normal(size=3),
        rng.uniform(0.2, 5),
    )
    found = align.rigid_transform(P, s * P @ R.T + t, weight, scale=True)
    for one, two in zip(found, (R, t, s), strict=True):
        assert one == pytest.approx(two, abs=1e-12)
    assert align.rigid_transform(P, P @ R.T + t)[0] == pytest.approx(R, abs=1e-12)


def test_without_scale_size_stays():
    P = np.random.default_rng(0).normal(size=(20, 3))
    R, t, s = align.rigid_transform(P, 3 * P)
    assert s == 1.0
    assert R == pytest.approx(np.eye(3))
    assert t == pytest.approx(2 * P.mean(0))


@pytest.mark.parametrize("flat", [0, 1], ids=["in space", "in a plane"])
def test_a_reflection_is_never_given(flat):
    P = np.random.default_rng(1).normal(size=(30, 3)) * [1, 1, 1 - flat]
    R, _, s = align.rigid_transform(P, P * [1, -1, 1], scale=True)
    assert np.linalg.det(R) == pytest.approx(1)
    assert R @ R.T == pytest.approx(np.eye(3))
    assert s > 0


def test_points_of_no_weight_do_not_count():
    P = np.random.default_rng(2).normal(size=(30, 3))
    Q = P @ turned(70).T + 1
    Q[:5] += 100
    R, t, _ = align.rigid_transform(P, Q, np.r_[np.zeros(5), np.ones(25)])
    assert turned(70) == pytest.approx(R)
    assert t == pytest.approx([1, 1, 1])


@pytest.mark.parametrize("degrees", [2, 5, -5])
def test_icp_recovers_a_small_rotation_exactly(brain, degrees):
    X, area = brain
    clouds = align.cloud(X, area), align.cloud(X @ turned(degrees).T + 0.05, area)
    R, t, residual = align.icp(*clouds, np.eye(3), np.zeros(3))
    assert turned(degrees) == pytest.approx(R, abs=1e-9)
    assert t == pytest.approx([0.05] * 3, abs=1e-9)
    assert residual == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)])
def test_a_shape_turned_by_180_degrees_is_found(brain, axis):
    X, area = brain
    R, t, residual = align.align(X, area, X @ turned(180, axis).T + 3, area)
    assert turned(180, axis) == pytest.approx(R, abs=1e-6)
    assert t == pytest.approx([3] * 3, abs=1e-6)
    assert residual == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("degrees", [0, 15, 30, 60, 120])
def test_the_alignment_of_two_different_shapes_does_not_depend_on_their_pose(degrees):
    tree = synthetic.brains(2, 2500)["original"]
    (X, area), (Y, area_y) = (
        (m["position"].values, vertex_areas(*as_arrays(m))) for m in tree.children.values()
    )
    still = align.align(X, area, Y, area_y)[0]
    found = align.align(X @ turned(degrees).T, area, Y, area_y)[0]
    away = Rotation.from_matrix(still.T @ found @ turned(degrees)).magnitude()
    assert np.rad2deg(away) < 3


def test_a_sphere_keeps_its_pose_as_no_other_is_better():
    X, T = as_arrays(synthetic.sphere(700))
    R, _, _ = align.align(X, vertex_areas(X, T), X, vertex_areas(X, T))
    assert R == pytest.approx(np.eye(3), abs=1e-9)


def test_alignment_does_not_depend_on_vertex_order(brain):
    X, area = brain
    Y = 1.05 * X @ turned(20).T
    order = np.random.default_rng(0).permutation(len(X))
    one, two = align.align(X, area, Y, area), align.align(X[order], area[order], Y, area)
    assert one[0] == pytest.approx(two[0], abs=1e-6)
    assert one[1] == pytest.approx(two[1], abs=1e-6)


def test_realign_ends_at_the_motion_from_near_it(brain):
    X, area = brain
    clouds = align.cloud(X, area, 300), align.cloud(X @ turned(40).T, area, 300)
    R, t = align.realign(*clouds, (turned(36), np.zeros(3)))
    assert turned(40) == pytest.approx(R, abs=0.01)
    assert t == pytest.approx(np.zeros(3), abs=0.005)


def test_principal_axes_are_a_rotation_longest_first():
    X, T = as_arrays(synthetic.ellipsoid(800, (1.0, 3.0, 2.0)))
    center, axes = align.principal_axes(X + 5, vertex_areas(X, T))
    assert center == pytest.approx([5] * 3, abs=0.01)
    assert np.abs(axes) == pytest.approx(np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), abs=0.01)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_farthest_points_are_spread_and_follow_the_shape_not_its_numbering(brain):
    X, _ = brain
    order = np.random.default_rng(3).permutation(len(X))
    found = align.farthest_points(X, 50)
    assert (order[align.farthest_points(X[order], 50)] == found).all()
    apart = np.linalg.norm(X[found][:, None] - X[found][None], axis=2) + 9 * np.eye(50)
    some = np.random.default_rng(4).choice(len(X), 50, replace=False)
    random = np.linalg.norm(X[some][:, None] - X[some][None], axis=2) + 9 * np.eye(50)
    assert apart.min() > 5 * random.min()


@pytest.mark.parametrize("n", [1, 2, 5, 17])
def test_all_points_are_given_where_more_are_wanted_than_there_are(n):
    X = np.random.default_rng(5).normal(size=(n, 3))
    assert (align.farthest_points(X, 20) == np.arange(n)).all()


@pytest.fixture(params=["fpsample", "NumPy"])
def sampler(request, monkeypatch):
    """Farthest points by the package, and by what stands for it in a browser."""
    if request.param == "NumPy":
        monkeypatch.setattr(align, "fpsample", Missing("fpsample", ImportError()))


@pytest.mark.usefixtures("sampler")
@pytest.mark.parametrize("n, k", [(2, 1), (7, 5), (300, 40), (2000, 300)])
def test_farthest_points_are_those_of_the_exhaustive_search(n, k):
    X = np.random.default_rng(n).normal(size=(n, 3))
    found = [int(((X - X.mean(0)) ** 2).sum(1).argmax())]
    gap = np.full(n, np.inf)
    while len(found) < k:
        gap = np.minimum(gap, ((X - X[found[-1]]) ** 2).sum(1))
        found.append(int(gap.argmax()))
    assert align.farthest_points(X, k).tolist() == found
    assert align.many_farthest_points(X, k, center=X.mean(0)).tolist() == found


@pytest.mark.usefixtures("sampler")
def test_another_seed_or_centre_starts_elsewhere():
    X = np.random.default_rng(7).normal(size=(500, 3))
    center = np.zeros(3)
    first = {
        int(align.many_farthest_points(X, 5, center=center, seed=seed)[0]) for seed in range(4)
    }
    assert len(first) > 1
    center = np.array([9.0, 0, 0])
    outermost = ((X - center) ** 2).sum(1).argmax()
    assert align.many_farthest_points(X, 5, center=center)[0] == outermost


@pytest.mark.usefixtures("sampler")
def test_points_that_coincide_are_taken_once():
    X = np.repeat(np.eye(3), 10, axis=0)
    assert sorted(align.many_farthest_points(X, 8, center=np.zeros(3)) // 10) == [0, 1, 2]


def test_starts_that_are_looked_up_together_end_as_they_do_alone(brain):
    X, area = brain
    clouds = align.cloud(X, area, 200), align.cloud(X * [1.1, 1.0, 0.9], area, 200)
    starts = [(turned(degrees), np.zeros(3)) for degrees in (0, 30, 180)]
    together = align.icp_each(*clouds, starts, tolerance=1e-4)
    assert len({residual for *_, residual in together}) > 1
    for start, end in zip(starts, together, strict=True):
        alone = align.icp(*clouds, *start, tolerance=1e-4)
        assert all(np.array_equal(a, b) for a, b in zip(alone, end, strict=True))
