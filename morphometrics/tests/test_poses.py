"""Several structures of each subject: poses between them and shapes within, on known variation."""

import logging

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

import s4a
from s4a import statistics
from s4a.geometry.mesh import vertex_areas
from s4a.schema import dataset, in_unit
from s4a.show.surfaces import mode_arrays
from s4a.study.tree import of_structure
from s4a_morphometrics.poses import align_wholes, measured, pose_fields, poses_of
from s4a_morphometrics.synthetic import bean, example_structures, subjects

SPHERE = s4a.synthetic.sphere(120)
U, T = SPHERE["position"].values, SPHERE["corner_vertex"].values
BEAN = bean(U)
AREA = vertex_areas(BEAN, T)
NAMES = ["left", "right"]
APART = np.array([[-16.0, 0, 0], [16, 0, 0]])
N = 12


def drawn(seed, *, pose=0.0, shape=0.0, n=N):
    """Points (s, 2, v, 3) of two beans, of poses and shapes drawn at random."""
    rng = np.random.default_rng(seed)
    Y = np.empty((n, 2, len(U), 3))
    for i in range(n):
        for k in range(2):
            X = bean(U, *(shape * rng.normal(size=2) * [0.1, 1]))
            turn = Rotation.from_rotvec(pose * 0.1 * rng.normal(size=3))
            Y[i, k] = turn.apply(X) + APART[k] + pose * 1.5 * rng.normal(size=3)
    return Y


def tree_of(Y, columns=None, unit="mm"):
    """A study of several structures that are registered already: template + displacement."""
    shapes = [f"s{i:02d}" for i in range(len(Y))]
    nodes = {}
    for k, name in enumerate(NAMES):
        template = Y[0, k]
        n = len(Y)
        data = dataset(
            {"template": "s00"},
            position=template,
            corner_vertex=T,
            vertex_area=vertex_areas(template, T),
            displacement=Y[:, k] - template,
            rotation=np.broadcast_to(np.eye(3), (n, 3, 3)),
            translation=np.zeros((n, 3)),
            scale=np.ones(n),
        )
        nodes[f"/structures/{name}/registration"] = in_unit(data, unit).assign_coords(shape=shapes)
        if columns:
            nodes[f"/structures/{name}/subjects"] = s4a.input.subjects.subjects(columns, shapes)
    return xr.DataTree.from_dict(nodes)


def tree_of_new(Y, study):
    """New subjects, registered to the templates of a study."""
    tree = tree_of(Y)
    for k, name in enumerate(NAMES):
        place = f"structures/{name}/registration"
        template = study[place]["position"].values
        data = tree[place].to_dataset()
        tree[place] = xr.DataTree(
            data.assign(
                position=study[place]["position"],
                displacement=data["displacement"].copy(data=Y[:, k] - template),
            )
        )
    return tree


def share(found, level):
    """Of all structures together."""
    return float(found["level_share"].sel(level=level).sum())


def test_the_two_levels_add_up_to_the_joint_one_without_a_rest():
    study = tree_of(drawn(0, pose=2, shape=3))  # turns of 11 degrees, so that nothing is small
    found = statistics.structures(study, n_permutations=9)
    assert share(found, "between") > 0.15 < share(found, "within")
    assert float(found["level_share"].sum()) == pytest.approx(1, abs=1e-12)
    total = float((found["standard_deviation"] ** 2).sum())
    assert total == pytest.approx(float(found["level_variance"].sum()), rel=1e-10)
    for level in ("between", "within"):
        modes = statistics.structures_modes(study, found, level)["pca"]
        of_level = float(found["level_variance"].sel(level=level).sum())
        assert float((modes["standard_deviation"] ** 2).sum()) == pytest.approx(of_level, rel=1e-5)
    joint = statistics.structures_modes(study, found, "joint")["pca"]
    assert np.allclose(joint["standard_deviation"], found["standard_deviation"], rtol=1e-5)


def test_shapes_have_no_shift_and_no_turn_left():
    Y = drawn(1, pose=3, shape=2)[:, 0]
    found = poses_of(Y, AREA)
    arm = found.mean - AREA @ found.mean / AREA.sum()
    size = np.abs(found.shape).max()
    assert np.abs(np.einsum("n,snx->sx", AREA, found.shape)).max() < 1e-9 * size * AREA.sum()
    turn = np.einsum("n,snx->sx", AREA, np.cross(arm, found.shape))
    assert np.abs(turn).max() < 1e-9 * size * AREA.sum() * np.abs(arm).max()
    for zero in (found.rotation, found.translation, found.shape):
        assert np.abs(zero.mean(0)).max() < 1e-8
    back = [
        Rotation.from_rotvec(w).apply(arm + v) + AREA @ found.mean / AREA.sum() + t
        for w, t, v in zip(found.rotation, found.translation, found.shape, strict=True)
    ]
    assert np.allclose(back, Y)


def test_planted_poses_are_between_and_planted_shapes_within():
    poses = statistics.structures(tree_of(drawn(2, pose=1)), n_permutations=9)
    assert share(poses, "between") > 1 - 1e-9
    assert np.isnan(poses["pose_shape_rv"])
    shapes = statistics.structures(tree_of(without_poses(drawn(2, shape=1))), n_permutations=9)
    assert share(shapes, "within") > 0.99


def without_poses(Y):
    """Points of which every structure is moved back to one place."""
    moved = Y.copy()
    for k in range(2):
        found = poses_of(Y[:, k], AREA)
        moved[:, k] = found.mean + found.shape
    return moved


def test_known_poses_are_found_relative_to_the_whole():
    turn, shift = np.array([0.0, 0, 0.2]), np.array([0, 3.0, 0])
    Y = np.broadcast_to(BEAN + APART[:, None], (6, 2, *BEAN.shape)).copy()
    for i, sign in enumerate([1, -1, 1, -1, 1, -1]):
        centre = AREA @ Y[i, 0] / AREA.sum()
        Y[i, 0] = Rotation.from_rotvec(sign * turn).apply(Y[i, 0] - centre) + centre + sign * shift
    found = statistics.structures(tree_of(Y), n_permutations=9)
    rotation, translation = found["pose_rotation"].values, found["pose_translation"].values
    sign = np.array([1, -1, 1, -1, 1, -1])[:, None]
    assert np.allclose(rotation[:, 0] - rotation[:, 1], sign * turn, atol=0.02)
    # the whole is turned back: the structures lie 32 mm from each other
    assert np.allclose((translation[:, 0] - translation[:, 1])[:, 0], 0, atol=0.2)
    assert (np.sign(rotation[:, 0, 2]) == sign[:, 0]).all()


def test_where_a_subject_lies_in_its_scan_changes_nothing():
    Y = drawn(3, pose=1, shape=1)
    rng = np.random.default_rng(0)
    moved = Y.copy()
    for i in range(N):
        frame = Rotation.from_rotvec(2 * rng.normal(size=3)).as_matrix()
        moved[i] = Y[i] @ frame.T + 100 * rng.normal(size=3)
    one, other = (statistics.structures(tree_of(X), n_permutations=9) for X in (Y, moved))
    assert np.allclose(one["level_variance"], other["level_variance"], rtol=1e-8)
    assert np.allclose(one["pose_size"], other["pose_size"], rtol=1e-6)


def test_size_of_the_whole_is_taken_out_on_request():
    Y = np.broadcast_to(BEAN + APART[:, None], (N, 2, *BEAN.shape))
    Y = Y * np.random.default_rng(0).uniform(0.8, 1.2, N)[:, None, None, None]
    assert share(statistics.structures(tree_of(Y), n_permutations=9), "within") > 0.1
    with pytest.raises(ValueError, match="structures need subjects that differ"):
        statistics.structures(tree_of(Y), scale=True)


def test_poses_and_shapes_that_vary_together_are_told_from_those_that_do_not():
    rng = np.random.default_rng(5)
    apart = drawn(6, pose=1, shape=1, n=16)
    together = np.empty_like(apart)
    for i, score in enumerate(rng.normal(size=16)):
        for k in range(2):
            X = bean(U, 0.15 * score)
            together[i, k] = X + APART[k] + [0, 2.0 * score * (-1) ** k, 0]
    still = without_poses(apart)
    shifted = still + (apart - still).mean(2)[:, :, None]
    p = [
        float(statistics.structures(tree_of(Y), n_permutations=199)["pose_shape_p"])
        for Y in (together, shifted)
    ]
    assert p[0] == pytest.approx(1 / 200)
    assert p[1] > 0.05


def test_a_group_that_differs_in_poses_is_found_between_structures_and_not_within():
    Y = without_poses(drawn(7, shape=1)) + drawn(8, pose=0.5) - BEAN - APART[:, None]
    group = np.repeat(["a", "b"], N // 2)
    Y[group == "b", 0, :, 0] -= 4.0
    study = tree_of(Y, {"group": group, "side": np.arange(N)})
    found = statistics.structures(study, n_permutations=9)
    p = {}
    for level in ("between", "within"):
        of_level = statistics.structures_modes(study, found, level)
        assert list(of_level["subjects"].data_vars) == ["group", "side"]
        test = statistics.group_test(of_level, "group", n_permutations=199)
        p[level] = float(test["p_value"])
    assert p["between"] <= 0.01
    assert p["within"] > 0.05


def test_a_level_is_a_study_for_what_takes_one(tmp_path):
    study = tree_of(drawn(0, pose=1, shape=1))
    found = statistics.structures(study, n_permutations=9)
    of_level = statistics.structures_modes(study, found, "between")
    mean, triangles, deformation = mode_arrays(of_level)
    assert np.allclose(mean, found["position"], atol=1e-5)
    assert triangles.max() == 2 * len(U) - 1
    moved = s4a.synthesize(of_level, [2.0])["position"].values
    assert np.allclose(moved, mean + 2 * deformation[0])
    assert statistics.evaluate(of_level)["generalization"].sizes["component"] > 0
    assert statistics.with_doubtful(of_level)["pca"].sizes == of_level["pca"].sizes
    assert s4a.write_registered(of_level, tmp_path)[0].is_file()
    with pytest.raises(ValueError, match="needs the motion of every shape"):
        s4a.write_registered(of_level, tmp_path, frame="shape")
    part = statistics.within(of_level, found["structure_of_vertex"].values == 1)
    assert part["registration"].sizes["vertex"] == len(U)
    with pytest.raises(ValueError, match="level must be one of joint, between, within"):
        statistics.structures_modes(study, found, "poses")


def test_a_level_without_variation_is_named():
    study = tree_of(drawn(2, pose=1))
    found = statistics.structures(study, n_permutations=9)
    found["within_displacement"] = 0 * found["within_displacement"]
    with pytest.raises(ValueError, match="within: PCA needs shapes that differ"):
        statistics.structures_modes(study, found, "within")


def test_a_structure_in_another_frame_is_told(caplog):
    Y = drawn(9, pose=1)
    Y[4, 1] += [300, 0, 0]
    statistics.structures(tree_of(Y), n_permutations=9)
    assert "structures lie far from where they are in the other subjects" in caplog.text
    assert "s04 (" in caplog.text
    assert caplog.text.count(" of its radius") == 1


def test_a_structure_mirrored_in_its_file_is_told(caplog):
    Y = drawn(9, pose=1)
    Y[4, 1] *= [-1, 1, 1]
    statistics.structures(tree_of(Y), n_permutations=9)
    assert "s04 (" in caplog.text


def test_usual_poses_are_not_told_of(caplog):
    for seed in range(20):
        statistics.structures(tree_of(drawn(seed, pose=1, shape=1)), n_permutations=9)
    assert not caplog.text


def test_files_that_were_centred_each_for_itself_are_told(caplog):
    Y = drawn(9, pose=1, shape=1)
    weights = np.stack([vertex_areas(Y[0, k], T) for k in range(2)])
    weights /= weights.sum(1, keepdims=True)
    centre = np.einsum("kn,sknx->skx", weights, Y)
    statistics.structures(tree_of(Y - centre[:, :, None]), n_permutations=9)
    assert "left and right have the same centre in every subject" in caplog.text


def test_structures_of_different_units_are_refused_or_told(caplog):
    Y = drawn(9, pose=1)
    study = tree_of(Y)
    right = study["structures/right/registration"].to_dataset()
    study["structures/right/registration"] = xr.DataTree(in_unit(right, "m", of="mm"))
    with pytest.raises(ValueError, match="structures need one unit; found left: mm, right: m"):
        statistics.structures(study)
    small = Y.copy()
    small[:, 1] /= 1000
    statistics.structures(tree_of(small), n_permutations=9)
    assert "left is 1000 times as large as right: are both in the same unit?" in caplog.text


def test_what_is_no_study_of_several_structures_is_refused():
    study = tree_of(drawn(0, pose=1))
    with pytest.raises(ValueError, match="a study of several structures needed"):
        statistics.structures(of_structure(study, "left"))
    with pytest.raises(ValueError, match="no structure 'middle'; it has left, right"):
        of_structure(study, "middle")
    with pytest.raises(ValueError, match="at least 4 subjects that have all of them, found 3 of 3"):
        statistics.structures(tree_of(drawn(0, pose=1, n=3)))


@pytest.mark.parametrize("scale", [False, True])
def test_a_new_subject_is_where_it_would_be_in_the_study(scale):
    Y = drawn(3, pose=1, shape=1) * np.linspace(0.9, 1.1, N)[:, None, None, None]
    study = tree_of(Y)
    found = statistics.structures(study, scale=scale, n_permutations=9)
    Q = Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix()
    again = statistics.structures_of_new(found, tree_of_new(Y @ Q.T + [5, 0, -3], study))
    for name in ("pose_rotation", "pose_translation", "pose_size", "within_displacement"):
        scatter = float(abs(found[name]).max())
        assert np.allclose(again[name], found[name], atol=1e-5 * scatter), name
    for level in ("joint", "between", "within"):
        modes = statistics.structures_modes(study, found, level)
        new = statistics.structures_modes(study, found, level, again)
        c = int((modes["pca"]["explained_variance_ratio"] > 1e-3).sum())
        assert np.allclose(new["pca"]["score"][:, :c], modes["pca"]["score"][:, :c], atol=1e-3)
        size = float(modes["pca"]["standard_deviation"][0])
        assert float(new["pca"]["reconstruction_error"].max()) < 0.05 * size
        assert "subjects" not in new.children


def test_a_new_subject_with_a_shifted_structure_is_far_along_the_modes_of_poses_alone(caplog):
    Y = drawn(4, pose=1, shape=1)
    new = Y[:1].copy()
    new[0, 1] += [60.0, 0, 0]
    study = tree_of(Y)
    found = statistics.structures(study, n_permutations=9)
    with caplog.at_level(logging.WARNING):
        far = statistics.structures_of_new(found, tree_of_new(new, study))
    assert "s00 (" in caplog.text
    assert "as if in another frame" in caplog.text
    left = {
        level: statistics.structures_modes(study, found, level, far)["pca"]
        for level in ("between", "within")
    }
    usual = statistics.structures_modes(study, found, "between")["pca"]["score"]
    assert abs(left["between"]["score"]).max() > 1.5 * abs(usual).max()
    own = statistics.structures_modes(study, found, "within")["pca"]["score"][0]
    assert np.allclose(left["within"]["score"][0], own, atol=0.05)


def test_new_subjects_of_other_structures_or_templates_are_refused():
    Y = drawn(5, pose=1, shape=1)
    study = tree_of(Y)
    found = statistics.structures(study, n_permutations=9)
    left = study.filter(lambda node: "right" not in node.path)
    with pytest.raises(ValueError, match="new shapes of left, right needed, found left"):
        statistics.structures_of_new(found, left)
    with pytest.raises(ValueError, match="new shapes in mm needed, found cm"):
        statistics.structures_of_new(found, tree_of(Y, unit="cm"))
    other = study.copy()
    part = other["structures/left/registration"].to_dataset().isel(vertex=slice(100))
    other["structures/left/registration"] = xr.DataTree(part.drop_vars("corner_vertex"))
    with pytest.raises(ValueError, match="needed, with templates of 120, 120 vertices; found 100"):
        statistics.structures_of_new(found, other)


def test_the_arithmetic_needs_no_study():
    Y = drawn(0, pose=1, shape=1)
    whole = align_wholes(np.concatenate([Y[:, 0], Y[:, 1]], axis=1), np.tile(AREA, 2))
    each = [poses_of(whole[:, : len(U)], AREA), poses_of(whole[:, len(U) :], AREA)]
    found = measured(each, [AREA, AREA], n_permutations=9)
    d = pose_fields(each[0].mean, AREA, each[0].rotation, each[0].translation)
    rms = np.sqrt(np.einsum("n,snx->s", AREA / AREA.sum(), d**2))
    assert np.allclose(found["pose_size"][:, 0], rms)


@pytest.fixture(scope="module")
def registered():
    """A registered study of six subjects with two structures."""
    return example_structures()


def test_of_registered_meshes_the_poses_and_shapes_are_those_that_were_made(registered):
    found = statistics.structures(registered, n_permutations=9)
    assert found["shape"].values.tolist() == [f"subject_{i}" for i in range(1, 7)]
    made = subjects(6, 200)
    template = {k: registered[f"structures/{k}/registration"].attrs["template"] for k in NAMES}
    points = []  # where the template's points truly are on every subject
    for one in made:
        of = [made[one][k] for k in NAMES]
        there = [made[template[k]][k]["reference_point"].values for k in NAMES]
        points.append([nearest(mesh, u) for mesh, u in zip(of, there, strict=True)])
    Y = np.array(points)
    areas = [
        vertex_areas(*(made[template[k]][k][v].values for v in ("position", "corner_vertex")))
        for k in NAMES
    ]
    whole = align_wholes(np.concatenate([Y[:, 0], Y[:, 1]], axis=1), np.concatenate(areas))
    each = [poses_of(whole[:, :200], areas[0]), poses_of(whole[:, 200:], areas[1])]
    truth = measured(each, areas, n_permutations=9)
    # of 200 vertices, which slide along the surface
    assert np.allclose(found["level_share"], truth["level_share"], atol=0.06)
    shift, true_shift = (one["pose_translation"].values for one in (found, truth))
    assert np.corrcoef(shift.ravel(), true_shift.ravel())[0, 1] > 0.97
    size, true_size = (one["pose_size"].values for one in (found, truth))
    assert np.corrcoef(size.ravel(), true_size.ravel())[0, 1] > 0.9


def nearest(mesh, u):
    """Where a mesh has the reference points u, by smooth interpolation in between its own."""
    from scipy.interpolate import RBFInterpolator

    return RBFInterpolator(mesh["reference_point"].values, mesh["position"].values)(u)


def test_a_tree_of_several_structures_gives_each_as_a_study(registered):
    left = of_structure(registered, "left")
    assert left["pca"].sizes["shape"] == 6
    assert s4a.synthesize(left, [1.0]).sizes["vertex"] == 200
    assert (registered["report"]["structure_status"] == "ok").all()


def test_warnings_name_the_subject_that_lacks_a_structure(caplog):
    study = tree_of(drawn(0, pose=1))
    left = study["structures/left/registration"].to_dataset().isel(shape=slice(1, None))
    study["structures/left/registration"] = xr.DataTree(left)
    with caplog.at_level(logging.WARNING):
        found = statistics.structures(study, n_permutations=9)
    assert found.sizes["shape"] == N - 1
    assert "left out, as a structure is missing or doubtful: s00 (no left)" in caplog.text
