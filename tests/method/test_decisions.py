"""Effect of each term of a score, each stopping criterion and each threshold of the method.

Most values were tuned by measurement; tests of a whole study pass without any one of them.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from s4a import coarsen, spectrum, synthetic
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method import alignment, elastic, initial_map, latent, spectral_icp
from s4a.method.shape import Basis, Shape
from s4a.study import pair

# ---- the score of a registration: round trip, distances in both directions, landmarks


def basis(X, T, **more):
    """A surface of unit area with one constant function."""
    area = vertex_areas(X, T)
    return Basis(X / np.sqrt(area.sum()), T, area / area.sum(), np.ones((len(X), 1)), **more)


@pytest.fixture(scope="module")
def sphere():
    """A sphere of unit area."""
    return basis(*as_arrays(synthetic.sphere(2000)))


def hemisphere(whole):
    """Return the upper half of a surface, and the index of each of its vertices in the whole."""
    upper = np.flatnonzero(whole.X[:, 2] > 0)
    row = np.full(len(whole.X), -1)
    row[upper] = np.arange(len(upper))
    T = row[whole.T[(row[whole.T] >= 0).all(axis=1)]]
    used = np.unique(T)
    part = Basis(
        whole.X[upper[used]],
        np.searchsorted(used, T),
        whole.area[upper[used]],
        np.ones((len(used), 1)),
    )
    return part, upper[used]


def far(X, Y):
    """Return the distance from each point of X to the nearest point of Y."""
    return np.linalg.norm(X[:, None] - Y[None], axis=2).min(axis=1)


def test_the_identity_scores_zero(sphere):
    assert spectral_icp.registration_score(sphere, sphere, np.arange(len(sphere.X)), sphere) == 0


def test_what_the_target_does_not_cover_of_the_source_is_in_the_score(sphere):
    half, at = hemisphere(sphere)
    score = spectral_icp.registration_score(sphere, half, at, half)
    assert score == pytest.approx(far(sphere.X, half.X).mean(), rel=0.25)
    assert score > 0.05


def test_what_the_source_lacks_of_the_target_is_in_the_score(sphere):
    half, _ = hemisphere(sphere)
    match = half.tree.query(sphere.tree.data)[1]
    distance = np.linalg.norm(sphere.X - half.X[match], axis=1).mean()
    assert distance > 0.05
    assert spectral_icp.registration_score(half, sphere, match, sphere) >= distance


def test_a_match_that_slides_is_in_the_score_by_its_distance_and_by_its_path(sphere):
    angle = 0.3
    c, s = np.cos(angle), np.sin(angle)
    slid = sphere.X @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    match = np.argmin(np.linalg.norm(slid[:, None] - sphere.X[None], axis=2), axis=1)
    distance = np.linalg.norm(sphere.X - sphere.X[match], axis=1).mean()
    # a path along edges is up to a tenth longer than the arc
    score = spectral_icp.registration_score(sphere, sphere, match, sphere)
    assert 1.95 * distance < score < 2.3 * distance


def test_a_round_trip_is_counted_up_to_half_the_size_of_the_surface(sphere):
    antipode = np.argmin(np.linalg.norm(sphere.X[:, None] + sphere.X[None], axis=2), axis=1)
    diameter = 2 / np.sqrt(4 * np.pi)
    score = spectral_icp.registration_score(sphere, sphere, antipode, sphere)
    assert score == pytest.approx(0.5 + diameter, rel=0.01)


def test_the_distance_of_landmarks_is_added_to_the_score(sphere):
    ends = [basis(sphere.X, sphere.T, landmarks={"tip": at}) for at in (0, 1000)]
    score = spectral_icp.registration_score(*ends, np.arange(len(sphere.X)), ends[1])
    assert score == pytest.approx(np.linalg.norm(sphere.X[0] - sphere.X[1000]))


@pytest.mark.parametrize("share, expected", [(0.85, False), (1.15, True)])
def test_poses_differ_above_0_035_plus_four_tenths_of_the_spacing(sphere, share, expected):
    stretched = sphere.X * [1, 1, 0]  # what moves along the axis is not rigid
    distance = np.quantile(np.abs(stretched - sphere.X)[:, 2], 0.9)
    factor = share * (0.035 + 0.4 / np.sqrt(len(sphere.X))) / distance
    source = sphere.moved_to(sphere.X * [1, 1, 1 + factor])
    assert spectral_icp.poses_differ(source, sphere, np.arange(len(sphere.X))) == expected


def test_two_candidates_within_the_margin_are_finalists_the_better_one_first():
    tried = {
        name: spectral_icp.Candidate(score, None, None)
        for name, score in {"a": 1.2, "b": 1.0, "c": 1.1, "d": 3.0}.items()
    }
    assert spectral_icp.finalists(tried, margin=1.25) == ["b", "c"]
    assert spectral_icp.finalists(tried, margin=1.05) == ["b"]


# ---- elastic iterations


@pytest.fixture(scope="module")
def surface():
    """A shape of unit area with its eigenfunctions."""
    brain = synthetic.brains(1, 3000)["original/brain_01"].to_dataset()
    return Shape(coarse=spectrum(coarsen(brain, n_coarse=600), k=40)).low


def ends(surface, X, **changed):
    """Return the registered vertices of a surface on the same surface moved to X."""
    begin = np.eye(3), np.zeros(3), np.zeros((1, 3))
    schedule = elastic.DEFORMATION._replace(**changed)
    return spectral_icp.move(
        surface, elastic.elastic_iterations(surface.moved_to(X), surface, begin, schedule)
    )


def smooth(X):
    waves = [np.sin(6 * X[:, 1]), np.sin(5 * X[:, 2] + 1), np.cos(6 * X[:, 0])]
    return 0.02 * np.stack(waves, axis=1)


def test_all_steps_are_made_while_the_bending_energy_has_settled(surface):
    X = surface.X + smooth(surface.X)
    np.testing.assert_array_equal(ends(surface, X), ends(surface, X, further=0))
    first = ends(surface, X, stiffness=elastic.STIFFNESS[: elastic._N_STEPS], further=0)
    assert np.abs(ends(surface, X) - first).max() > 1e-3


def test_no_further_step_is_made_where_a_step_lets_the_bending_energy_grow(surface):
    noise = 0.01 * np.random.default_rng(0).normal(size=surface.X.shape)
    X = surface.X + noise
    first = ends(surface, X, stiffness=elastic.STIFFNESS[: elastic._N_STEPS], further=0)
    np.testing.assert_array_equal(ends(surface, X), first)
    assert np.abs(ends(surface, X, further=0) - first).max() > 1e-2, "it would follow the noise"


# ---- the size of the latent basis


def test_the_latent_size_is_the_nearest_whole_number_to_its_share_of_maps_of_any_size():
    sizes = {20: 5, 21: 5, 23: 6, 30: 8, 2: 1, 100: 25}  # 5.25 is 5, 5.75 is 6, 7.5 is 8
    assert {k: latent.latent_size(25, k, 100) for k in sizes} == sizes
    assert [latent.latent_size(n, 20, 100) for n in (None, 100, 50, 1)] == [20, 20, 10, 1]
    assert [latent.latent_size(50, k, 12) for k in (6, 12)] == [6, 12], "of maps that are reduced"


def test_of_initialisations_that_end_within_a_hundredth_one_is_kept(surface, monkeypatch):
    monkeypatch.setattr(
        elastic, "elastic_iterations", lambda _source, _target, initial_warp, *_, **__: initial_warp
    )

    def initial_warp(x):
        return np.eye(3), np.array([x, 0.0, 0.0]), np.zeros((1, 3))

    warps = {"a": initial_warp(0.0), "b": initial_warp(0.008), "c": initial_warp(0.02)}
    assert list(elastic.converging_initialisations(surface, surface, warps)) == ["a", "c"]
    warps["icp"] = warps.pop("b")
    assert list(elastic.converging_initialisations(surface, surface, warps)) == ["icp", "c"]


# ---- initial maps


def test_collinear_landmarks_do_not_determine_the_rotation(surface):
    X = surface.X
    start, *near = cKDTree(X).query(X[0], 9)[1]
    far = np.flatnonzero(np.linalg.norm(X - X[start], axis=1) > 0.5)
    along = (X[far] - X[start]) / np.linalg.norm(X[far] - X[start], axis=1)[:, None]
    off = np.linalg.norm(np.cross((X[near] - X[start])[:, None], along), axis=2)  # from the line
    third, end = np.unravel_index(off.argmin(), off.shape)
    # the third is a vertex near that line in one shape, and another neighbour in the other
    one, other = ({"a": start, "b": far[end], "c": c} for c in (near[third], near[third - 1]))
    bases = [replace(surface, landmarks=marks) for marks in (one, other)]
    R, t = alignment.transform_onto(*bases)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(t, 0, atol=1e-6)


def test_of_maps_with_equal_scores_the_one_that_preserves_curvatures_is_chosen(
    surface, monkeypatch
):
    C = np.eye(10)
    monkeypatch.setattr(initial_map, "maps_from_signatures", lambda *_: iter([("other", C, C)] * 2))
    monkeypatch.setattr(initial_map, "stretch", lambda *_: 0.0)

    def found(search):
        scores, differences = iter([0.10, 0.11, 0.5]), iter([0.1, 0.0, 0.0])
        monkeypatch.setattr(spectral_icp, "registration_score", lambda *_: next(scores))
        monkeypatch.setattr(initial_map.fmap, "curvature_difference", lambda *_: next(differences))
        return initial_map.best_initial_maps(surface, surface, C, search=search)[0][0]

    assert found(search=False) == "icp"
    assert found(search=True) == "other"


def test_of_maps_with_similar_scores_those_that_differ_are_registered_and_the_best_is_used(
    surface, monkeypatch
):
    C, flipped = np.eye(10), np.diag((-1.0) ** np.arange(10))
    maps = [("first", flipped, flipped), ("same", flipped, flipped), ("second", C, C)]
    scores = iter([0.3, 0.2, 0.21, 0.22])
    monkeypatch.setattr(initial_map, "maps_from_signatures", lambda *_: iter(maps))
    monkeypatch.setattr(initial_map, "stretch", lambda *_: 0.0)
    monkeypatch.setattr(initial_map.fmap, "curvature_difference", lambda *_: 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(spectral_icp, "registration_score", lambda *_: next(scores))
        found = initial_map.best_initial_maps(surface, surface, C, search=True)
    assert [(name, score) for name, _, _, score in found] == [("first", 0.2), ("second", 0.22)]
    near = np.arange(len(surface.X))
    first, second = (initial_map._InitialMap(*one, near, score=score) for *one, score in found)
    monkeypatch.setattr(pair, "initial_map", lambda *_, **__: first._replace(others=(second,)))
    mesh = synthetic.brains(1, 400)["original/brain_01"].to_dataset()
    options = {"n_coarse": 300, "k": 10, "k_init": 10, "refine": "intrinsic"}
    assert pair.match_pair(mesh, mesh, **options).attrs["initial_map"] == "second"


def test_three_maps_that_agree_end_a_search(surface, monkeypatch):
    C, scores = np.eye(10), iter([0.09, 0.095, 0.091])
    monkeypatch.setattr(initial_map, "maps_from_signatures", lambda *_: iter([("other", C, C)] * 9))
    monkeypatch.setattr(initial_map, "stretch", lambda *_: 0.0)
    monkeypatch.setattr(spectral_icp, "registration_score", lambda *_: next(scores))
    monkeypatch.setattr(initial_map.fmap, "curvature_difference", lambda *_: 0.0)
    assert initial_map.best_initial_maps(surface, surface, C, search=True)[0][0] == "icp"
