"""Rigid alignment (4.1, step 2): transforms that are known come back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from s4a import synthetic
from s4a.geometry import align
from s4a.geometry.compiled import Missing
from s4a.geometry.mesh import as_arrays, vertex_areas, vertex_normals


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
    R, t, residual = align.align(
        align.cloud(X, area), align.cloud(X @ turned(180, axis).T + 3, area)
    )
    assert turned(180, axis) == pytest.approx(R, abs=1e-6)
    assert t == pytest.approx([3] * 3, abs=1e-6)
    assert residual == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("degrees", [15, 60, 120, 180])
def test_the_alignment_of_two_different_shapes_does_not_depend_on_their_pose(degrees):
    tree = synthetic.brains(2, 1500)["original"]
    meshes = [(*as_arrays(m), vertex_areas(*as_arrays(m))) for m in tree.children.values()]

    def found(Q):
        (X, T, area), (Y, S, area_y) = meshes
        source = align.cloud(X @ Q.T, area, 300, vertex_normals(X @ Q.T, T))
        return align.align(source, align.cloud(Y, area_y, 300, vertex_normals(Y, S)))[0] @ Q

    assert found(turned(degrees)) == pytest.approx(found(np.eye(3)), abs=1e-9)


def test_plain_icp_starts_at_the_pose_as_given_and_pairs_one_direction_without_weights(brain):
    X, area = brain
    Y = X @ turned(5).T
    clouds = align.cloud(X, area), align.cloud(np.concatenate([Y, Y[:5] + 1]), np.ones(len(X) + 5))
    R, _, residual = align.point_to_point(*clouds, np.eye(3), np.zeros(3))
    assert turned(5) == pytest.approx(R, abs=1e-3)
    assert residual == pytest.approx(0, abs=1e-3)
    far = align.point_to_point(
        clouds[0], align.cloud(X @ turned(180).T, area), np.eye(3), np.zeros(3)
    )
    assert far[2] > 0.01


def test_a_rod_of_nearly_round_section_has_more_initial_rotations():
    counts, boxes = (
        {},
        {"box": (4, 2, 1), "rod": (4, 1.1, 1), "disc": (4, 3.9, 1), "ball": (1, 1, 1)},
    )
    for name, axes in boxes.items():
        P = align.cloud(synthetic.ellipsoid(300, axes)["position"].values, np.ones(300))
        counts[name] = len(align.initial_transforms(P, P))
    assert counts == {"box": 4, "rod": 16, "disc": 16, "ball": 24}


def test_alignment_does_not_depend_on_vertex_order(brain):
    X, area = brain
    Y = 1.05 * X @ turned(20).T
    order = np.random.default_rng(0).permutation(len(X))
    target = align.cloud(Y, area)
    one, two = (align.align(align.cloud(X[i], area[i]), target) for i in (slice(None), order))
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
    P = np.random.default_rng(n).normal(size=(n, 3))
    X = align.without_ties(P)
    found = [int(((X - X.mean(0)) ** 2).sum(1).argmax())]
    gap = np.full(n, np.inf)
    while len(found) < k:
        gap = np.minimum(gap, ((X - X[found[-1]]) ** 2).sum(1))
        found.append(int(gap.argmax()))
    assert align.farthest_points(P, k).tolist() == found
    assert align.many_farthest_points(P, k, center=X.mean(0)).tolist() == found


@pytest.mark.usefixtures("sampler")
def test_samples_of_points_on_a_grid_do_not_depend_on_their_pose():
    X = np.unique(np.random.default_rng(0).integers(0, 12, (700, 3)), axis=0).astype(float)
    R = Rotation.random(random_state=0).as_matrix()
    for P in (X @ R.T, np.float32(X @ R.T)):
        assert np.array_equal(align.farthest_points(X, 100), align.farthest_points(P, 100))
        one, other = (align.many_farthest_points(Y, 100, center=Y.mean(0), seed=3) for Y in (X, P))
        assert np.array_equal(one, other)


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
