"""Shapes in different poses: piecewise rigid transforms, and initial maps independent of pose.

And when they are computed.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from s4a import analyse, insert, match_pair, synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method import deform, initial_map, spectral_icp
from s4a.method.remesh import coarsen
from s4a.method.shape import Shape
from s4a.method.spectral import spectrum


def worm(n, bend):
    """A tapering tube of length 8 with a knob at one side, bent by an angle of 8 `bend`.

    Vertex i is vertex i.
    """
    mesh = synthetic.sphere(n)
    u = as_arrays(mesh)[0]
    s, (y, z) = 4 * u[:, 0], 0.4 * (1 + 0.3 * u[:, 0]) * u[:, 1:].T
    y = y + 0.35 * np.exp(-8 * ((u - [0.48, 0.6, 0.64]) ** 2).sum(1))
    if bend:
        r, angle = 1 / bend, bend * s
        s, y = (r - y) * np.sin(angle), r - (r - y) * np.cos(angle)
    return mesh.assign(position=(mesh["position"].dims, np.stack([s, y, z], axis=1)))


def error(found, source):
    """Mean distance to the true vertex, as a share of sqrt(area)."""
    X, T = as_arrays(source)
    return np.linalg.norm(X[found["match"].values] - X, axis=1).mean() / np.sqrt(
        vertex_areas(X, T).sum()
    )


@pytest.fixture(scope="module")
def bent():
    return worm(2500, 0), worm(2500, -0.5)


@pytest.fixture(scope="module")
def shapes(bent):
    return [Shape(mesh, spectrum(coarsen(mesh, n_coarse=1000), k=50)) for mesh in bent]


def test_a_different_pose_is_matched_although_nearest_neighbours_are_wrong(bent, monkeypatch):
    found = match_pair(*bent, n_coarse=1000, k=50)
    assert found.attrs["initialisation"] == "intrinsic+parts+local"
    assert found.attrs["initial_map"].split(",")[0] in ("hks", "wks", "hks+wks", "extremities 1")
    assert error(found, bent[0]) < 0.002
    assert (found.attrs["status"], found.attrs["warning"]) == ("ok", "")
    monkeypatch.setattr(spectral_icp, "poses_differ", lambda *_: False)
    failed = match_pair(*bent, n_coarse=1000, k=50)
    assert error(failed, bent[0]) > 0.05
    assert failed.attrs["status"] == "flagged"


def test_one_motion_of_all_parts_is_that_of_the_whole(shapes):
    low = shapes[0].low
    R = Rotation.from_rotvec([0.3, 2.0, -0.1]).as_matrix()
    found, t = deform.rigid_parts(low.X, low.X @ R.T + 0.2, low.area, low.Phi, low.eigenvalue)
    assert found == pytest.approx(np.broadcast_to(R, found.shape), abs=1e-6)
    assert t == pytest.approx(0.2, abs=1e-6)


def test_parts_follow_a_bend_that_displacements_alone_cannot(shapes):
    straight = shapes[0].low
    true = shapes[0].coarse["sample_vertex"].values
    X = shapes[1].original["position"].values[true]
    X = (X - shapes[1].frame[0]) / shapes[1].frame[1]
    few = straight.Phi[:, :20]

    def residual(spectrum):
        R, t, c = deform.onto(
            straight.X, X, straight.area, lambda d: few.T @ (straight.area[:, None] * d), spectrum
        )
        return np.linalg.norm(spectral_icp.move(straight, (R, t, c)) - X, axis=1).mean()

    assert residual((straight.area, few, straight.eigenvalue[:20])) < 0.25 * residual(None)


def test_the_parts_of_the_full_resolution_are_those_of_its_coarse_vertices(shapes):
    low, full = shapes[0].low, shapes[0].full
    R, t = deform.rigid_parts(
        low.X, 2 * low.X[:, [1, 0, 2]] * [1, -1, 1], low.area, low.Phi, low.eigenvalue
    )
    at = shapes[0].coarse["sample_vertex"].values
    assert spectral_icp.apply_transform(full, R, t)[at] == pytest.approx(
        spectral_icp.apply_transform(low, R, t), abs=1e-6
    )


def test_shapes_in_one_pose_keep_their_initial_map(monkeypatch):
    tree = synthetic.brains(2, 1500)
    source, target = (node.to_dataset() for node in tree["original"].children.values())

    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(initial_map, "best_initial_maps", refuse)
    assert match_pair(source, target, n_coarse=600, k=40).attrs["initial_map"] == "dense"


def test_of_initial_maps_the_best_is_chosen(shapes):
    low = shapes[0].low
    (name, C, *_), *_ = initial_map.best_initial_maps(low, low, np.diag((-1.0) ** np.arange(20)))
    assert name in ("hks", "wks")
    assert np.diag(C).min() > 0.9


def test_a_search_continues_with_signatures_and_curvature_until_a_map_fits(shapes, monkeypatch):
    low = shapes[0].low
    turned_over = np.diag((-1.0) ** np.arange(20))
    fit = initial_map.fmap.fmap_from_descriptors

    def spoilt(*ends, curvature=0.0, **options):
        return fit(*ends, curvature=curvature, **options) if curvature else turned_over

    monkeypatch.setattr(initial_map.fmap, "fmap_from_descriptors", spoilt)
    assert np.diag(initial_map.best_initial_maps(low, low, turned_over)[0][1]).min() < 0
    name, C, fitted, _ = initial_map.best_initial_maps(low, low, turned_over, search=True)[0]
    assert name == "hks+wks, curvature, k 10, oriented 1"
    assert np.diag(C).min() > 0.9
    assert C.shape == fitted.shape == (20, 20)


def test_extremities_are_the_ends_of_a_worm_in_any_pose(shapes):
    for shape in shapes:
        low = shape.low
        vertex, distance = initial_map.extremities(low, 3)
        along = shape.coarse["sample_vertex"].values[vertex]  # the sphere's vertex, whose x is 4 s
        s = as_arrays(synthetic.sphere(2500))[0][along, 0]
        assert sorted(s[:2].round(1)) == [-1.0, 1.0]
        assert distance.diagonal() == pytest.approx(0)
        assert distance == pytest.approx(distance.T)


def test_a_piece_that_is_not_connected_has_no_extremity(shapes):
    low = shapes[0].low
    n = len(low.X)
    two = replace(
        low,
        X=np.concatenate([low.X, low.X + [9, 0, 0]]),
        T=np.concatenate([low.T, low.T + n]),
        area=np.concatenate([low.area, low.area]) / 2,
    )
    vertex, distance = initial_map.extremities(two, 4)
    assert len({int(v) // n for v in vertex}) == 1
    assert np.isfinite(distance).all()


def test_extremities_are_paired_by_their_distances_whatever_the_order_of_the_vertices(shapes):
    low = shapes[0].low
    order = np.random.default_rng(0).permutation(len(low.X))
    rank = np.argsort(order)
    other = replace(low, X=low.X[order], T=rank[low.T], area=low.area[order])
    a, b = initial_map.paired_extremities(low, other)[0]
    assert len(a) == initial_map.N_ENDS
    assert (order[b] == a).all()


def test_all_maps_of_a_search_carry_a_shape_to_itself(shapes):
    low = shapes[0].low
    found = {name: C for name, C, _ in initial_map.maps_from_signatures(low, low, 20, True)}
    others = [f"extremities {i}" for i in range(2, initial_map.N_PAIRED + 1)]  # not with themselves
    assert len(found) == 3 + len(others) + len(initial_map.SEARCHED)
    for name, C in found.items():
        if name in others:
            continue
        assert C.shape == (20, 20), name
        assert np.diag(C).min() > 0.9, name


def test_the_initial_maps_of_an_analysis_do_not_depend_on_pose(bent):
    straight, other = bent
    study = analyse({"a": straight, "b": other}, n_coarse=1000, k=50, n_pairs=1, template="b")
    X = straight["position"].values
    match = study["registration"]["registered_match"].sel(shape="a").values
    assert (
        np.linalg.norm(X[match] - X, axis=1).mean()
        / np.sqrt(vertex_areas(*as_arrays(straight)).sum())
        < 0.005
    )


def test_a_new_shape_in_another_pose_is_registered_to_a_study(bent):
    straight, other = bent
    study = analyse(
        {"a": straight, "b": worm(2500, -0.1)}, n_coarse=1000, k=50, n_pairs=1, template="a"
    )
    found = insert(study, {"new": other})["registration"]
    X = straight["position"].values
    match = found["registered_match"].sel(shape="new").values
    assert (
        np.linalg.norm(X[match] - X, axis=1).mean()
        / np.sqrt(vertex_areas(*as_arrays(straight)).sum())
        < 0.005
    )


def spheres(places, size, n=30):
    X, T = as_arrays(synthetic.sphere(n))
    return as_dataset(
        np.concatenate([size * X + x for x in places]),
        np.concatenate([T + i * n for i in range(len(places))]),
    )


@pytest.mark.parametrize("k", [20, 30])
def test_with_more_components_than_functions_the_initial_map_is_that_of_nearest_neighbours(k):
    i = np.arange(25)
    source, target = (
        spheres(np.c_[3 * i, 0 * i, 0 * i], 1),
        spheres(np.c_[0 * i, i**2 / 2, i % 3], [4, 1, 0.7]),
    )
    found = match_pair(source, target, n_coarse=750, k=k)
    assert found.attrs["initial_map"] == "dense"
    assert np.isfinite(found["displacement"]).all()


def test_pieces_of_one_function_each_move_as_a_whole():
    low, part = synthetic.sphere(30), np.repeat([0, 1], 30)
    X = np.concatenate([as_arrays(low)[0], as_arrays(low)[0] + 5])
    R = np.stack([Rotation.from_rotvec(v).as_matrix() for v in ([0.3, 0, 0], [0, 0.5, 1])])[part]
    Phi = np.sqrt(2) * (part[:, None] == [0, 1])
    found, _ = deform.rigid_parts(
        X, np.einsum("nij,nj->ni", R, X), np.full(60, 1 / 60), Phi, np.zeros(2)
    )
    assert found == pytest.approx(R, abs=1e-6)
