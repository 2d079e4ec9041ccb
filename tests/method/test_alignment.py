"""Rigid alignment (4.1, step 2): poses that fit alike, votes, and files in any pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import s4a
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method.alignment import IDENTITY, align_all, align_onto, elect, transform_onto
from s4a.method.shape import Basis

SMALL = {"n_coarse": 150, "k": 20, "k_init": 10, "n_samples": 150, "intersections": False}


def rod(seed, bump=0.0, end=0.0, n=500):
    """Points and triangles of an ellipsoid with a bump and a thick end, and own vertices."""
    rng = np.random.default_rng(seed)
    U, T = as_arrays(s4a.synthetic.sphere(n))
    U = U @ Rotation.random(random_state=seed).as_matrix()
    X = U * [6, 1.5, 1] * (1 + 0.03 * rng.standard_normal(3))
    X = X * (1 + bump * np.exp(-((U - [0.5, 0.86, 0]) ** 2).sum(1) / 0.15))[:, None]
    return X * (1 + end * U[:, :1] * np.array([0, 1, 1])), T


def basis(X, T):
    area = vertex_areas(X, T)
    X = (X - area @ X / area.sum()) / np.sqrt(area.sum())
    return Basis(X, T, area / area.sum(), np.zeros((len(X), 1)))


def turned(X, T, seed):
    return X @ Rotation.random(random_state=seed).as_matrix().T + seed, T


def test_nearly_symmetric_shapes_are_ambiguous_and_others_are_not():
    near = {f"s{i}": basis(*turned(*rod(i, bump=0.1), i)) for i in range(4)}
    clear = {f"s{i}": basis(*turned(*rod(i, bump=0.5, end=0.6), i)) for i in range(4)}
    for aligned in align_all(near, "s1").values():
        assert len(aligned.fits) > 1
        assert aligned.angle > 150
        assert "poses fit equally well" in aligned.ambiguity
    for name, aligned in align_all(clear, "s1").items():
        true = Rotation.random(random_state=1).as_matrix()
        true = true @ Rotation.random(random_state=int(name[1])).as_matrix().T
        assert len(aligned.fits) == 1
        assert np.trace(aligned.R.T @ true) > 2.9


def test_of_equally_good_poses_that_of_the_files_is_used():
    for aligned in align_all({f"s{i}": basis(*rod(i, bump=0.1)) for i in range(6)}, "s0").values():
        assert aligned.ambiguity
        assert np.trace(aligned.R) > 2.9


def test_shapes_vote_on_a_pose_that_the_reference_leaves_open():
    target, shape = (basis(*rod(i, end=end)) for i, end in ((0, 0.0), (1, 0.6)))
    shape = basis(shape.X @ np.diag([-1.0, 1.0, -1.0]), shape.T)
    voters = {f"v{i}": (basis(*rod(i, end=0.6)), (np.eye(3), np.zeros(3))) for i in (2, 3, 4)}
    assert align_onto(shape, target).ambiguity
    voted = align_onto(shape, target, voters=voters)
    thick = shape.X @ voted.R.T  # its thick end lies at large x, as those of the voters
    assert np.corrcoef(thick[:, 0], shape.X[:, 0])[0, 1] < -0.9


def test_voters_with_one_clear_pose_outweigh_as_many_symmetric_ones():
    shape = basis(*rod(1, end=0.6))
    ends = {2: 0.0, 3: 0.0, 4: 0.6, 5: 0.6}
    voters = {f"v{i}": (basis(*rod(i, end=end)), IDENTITY) for i, end in ends.items()}
    rotations = [np.diag(signs) for signs in ([1.0, 1, 1], [-1.0, -1, 1])]
    found = [(R, np.zeros(3)) for R in rotations]
    assert not elect(shape, voters, found).ambiguity
    symmetric = {name: voters[name] for name in ("v2", "v3")}
    assert elect(shape, symmetric, found).ambiguity


@pytest.mark.parametrize("alignment", ["search", "icp", "given"])
def test_the_pose_of_the_files_enters_only_where_it_is_asked_for(alignment):
    M, N = (basis(*rod(i, bump=0.5, end=0.6)) for i in (0, 1))
    R, t = transform_onto(M, N, alignment)
    turn = Rotation.from_euler("z", 170, degrees=True).as_matrix()
    S, _ = transform_onto(basis(M.X @ turn.T, M.T), N, alignment)
    if alignment == "given":
        assert (R == np.eye(3)).all()
        assert (t == 0).all()
        assert (S == np.eye(3)).all()
    elif alignment == "icp":
        assert np.trace(S @ turn @ R.T) < 2
    else:
        assert S @ turn == pytest.approx(R, abs=1e-9)


def test_ten_rotations_of_the_files_give_the_same_poses():
    rods = {f"s{i}": rod(i, bump=0.5, end=0.6, n=200) for i in range(3)}
    first = align_all({name: basis(*mesh) for name, mesh in rods.items()}, "s0")
    for seed in range(10):
        Q = {
            name: Rotation.random(random_state=9 * seed + i).as_matrix()
            for i, name in enumerate(rods)
        }
        found = align_all({n: basis(X @ Q[n].T, T) for n, (X, T) in rods.items()}, "s0")
        for name, aligned in found.items():
            R = Q["s0"].T @ aligned.R @ Q[name]
            assert pytest.approx(first[name].R, abs=1e-9) == R
            assert pytest.approx(first[name].fits, abs=1e-9) == aligned.fits


def test_a_study_of_rotated_files_equals_the_first():
    meshes = s4a.synthetic.brains(3, 200)["original"].children
    meshes = {name: as_arrays(node.to_dataset()) for name, node in meshes.items()}
    files = {name: turned(*mesh, i) for i, (name, mesh) in enumerate(meshes.items())}
    one, two = (s4a.analyse(shapes, **SMALL) for shapes in (meshes, files))
    match, other = (study["registration"]["registered_match"].values for study in (one, two))
    assert (match == other).mean() > 0.999
    np.testing.assert_allclose(
        *(study["pca"]["explained_variance_ratio"].values for study in (one, two)), atol=1e-6
    )


def test_a_study_flags_ambiguous_poses_and_its_confidence_falls():
    rods = {f"s{i}": turned(*rod(i, bump=0.1, n=1000), i) for i in range(3)}
    study = s4a.analyse(rods, **SMALL)
    report = study["report"]
    assert set(report["status"].values) == {"flagged"}
    assert set(report["flag_kinds"].values) == {"pose"}
    assert "all are used" in report.attrs["remarks"]
    assert "given by name" not in report.attrs["remarks"]
    assert study["pca"].sizes["shape"] == 3
    others = report["shape"].values != study["registration"].attrs["template"]
    assert study["registration"]["confidence"].values[others].max() <= 0.5
    given = s4a.analyse(
        {n: rod(i, bump=0.1, n=1000) for i, n in enumerate(rods)}, alignment="given", **SMALL
    )
    assert set(given["report"]["status"].values) == {"ok"}
    match = given["registration"]["registered_match"].values
    X = [given["original"][n]["position"].values for n in given["registration"]["shape"].values]
    template = given["registration"]["position"].values
    for i, points in enumerate(X):
        assert np.corrcoef(points[match[i], 0], template[:, 0])[0, 1] > 0.99


def test_one_ambiguous_shape_of_many_is_excluded_from_the_network():
    rods = {f"s{i}": turned(*rod(i, bump=0.5, end=0.6, n=200), i) for i in range(4)}
    rods["plain"] = turned(*rod(5, n=200), 7)
    study = s4a.analyse(rods, **SMALL)
    report = study["report"]
    flagged = report["shape"].values[report["status"].values == "flagged"].tolist()
    assert flagged == ["plain"]
    assert "plain" not in study["latent"]["shape"].values
    assert "plain" in study["registration"]["shape"].values
