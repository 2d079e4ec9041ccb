"""Several structures of each subject: poses between them and shapes within, on known variation."""

import logging

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import RBFInterpolator
from scipy.spatial.transform import Rotation

import s4a
from s4a import statistics
from s4a.geometry.mesh import as_dataset, vertex_areas
from s4a.input.coordinates import CoordinateSystem, transform
from s4a.input.subjects import subjects as table_of
from s4a.schema import dataset, in_unit
from s4a_morphometrics import of_structure, structures, structures_modes, structures_of_new, within
from s4a_morphometrics.poses import align_wholes, measure_levels, pose_fields, poses_of
from s4a_morphometrics.synthetic import bean, subjects

SPHERE = s4a.synthetic.sphere(120)
U, T = SPHERE["position"].values, SPHERE["corner_vertex"].values
BEAN = bean(U)
AREA = vertex_areas(BEAN, T)
NAMES = ["left", "right"]
APART = np.array([[-16.0, 0, 0], [16, 0, 0]])
N = 12
FEW = {"n_permutations": 9}


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


def tree_of(Y, columns=None, unit="mm", templates=None):
    """A study of several structures that are registered already: template + displacement."""
    shapes = [f"s{i:02d}" for i in range(len(Y))]
    nodes = {}
    for k, name in enumerate(NAMES):
        template = Y[0, k] if templates is None else templates[k]
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
            nodes[f"/structures/{name}/subjects"] = table_of(columns, shapes)
    return xr.DataTree.from_dict(nodes)


def tree_of_new(Y, study):
    """New subjects, registered to the templates of a study."""
    registered = [study[f"structures/{name}/registration"] for name in NAMES]
    return tree_of(Y, templates=[one["position"].values for one in registered])


def without_poses(Y):
    """Points with all structures moved to a common pose."""
    found = [poses_of(Y[:, k], AREA) for k in range(2)]
    return np.stack([one.mean + one.shape for one in found], axis=1)


def share(found, level):
    """Of all structures together."""
    return float(found["level_share"].sel(level=level).sum())


def test_the_two_levels_add_up_to_the_joint_one_without_a_rest():
    study = tree_of(drawn(0, pose=2, shape=3))  # rotations of 11 degrees, which are not small
    found = structures(study, **FEW)
    assert share(found, "between") > 0.15 < share(found, "within")
    assert float(found["level_share"].sum()) == pytest.approx(1, abs=1e-12)
    total = float((found["standard_deviation"] ** 2).sum())
    assert total == pytest.approx(float(found["level_variance"].sum()), rel=1e-10)
    for level in ("between", "within"):
        modes = structures_modes(study, found, level)["pca"]
        of_level = float(found["level_variance"].sel(level=level).sum())
        assert float((modes["standard_deviation"] ** 2).sum()) == pytest.approx(of_level, rel=1e-5)
    joint = structures_modes(study, found, "joint")["pca"]
    assert np.allclose(joint["standard_deviation"], found["standard_deviation"], rtol=1e-5)


def test_shapes_have_no_translation_or_rotation():
    Y = drawn(1, pose=3, shape=2)[:, 0]
    found = poses_of(Y, AREA)
    g = AREA @ found.mean / AREA.sum()
    arm = found.mean - g
    size = np.abs(found.shape).max() * AREA.sum()
    assert np.abs(np.einsum("n,snx->sx", AREA, found.shape)).max() < 1e-9 * size
    turn = np.einsum("n,snx->sx", AREA, np.cross(arm, found.shape))
    assert np.abs(turn).max() < 1e-9 * size * np.abs(arm).max()
    for zero in (found.rotation, found.translation, found.shape):
        assert np.abs(zero.mean(0)).max() < 1e-8
    each = zip(found.rotation, found.translation, found.shape, strict=True)
    assert np.allclose([Rotation.from_rotvec(w).apply(arm + v) + g + t for w, t, v in each], Y)


def test_simulated_poses_are_between_and_simulated_shapes_within():
    poses = structures(tree_of(drawn(2, pose=1)), **FEW)
    assert share(poses, "between") > 1 - 1e-9
    assert np.isnan(poses["pose_shape_rv"])
    shapes = structures(tree_of(without_poses(drawn(2, shape=1))), **FEW)
    assert share(shapes, "within") > 0.99


def test_known_poses_are_found_relative_to_the_whole():
    turn, shift = np.array([0.0, 0, 0.2]), np.array([0, 3.0, 0])
    sign = np.array([1, -1, 1, -1, 1, -1])[:, None]
    Y = np.broadcast_to(BEAN + APART[:, None], (6, 2, *BEAN.shape)).copy()
    for i, one in enumerate(sign):
        centre = AREA @ Y[i, 0] / AREA.sum()
        Y[i, 0] = Rotation.from_rotvec(one * turn).apply(Y[i, 0] - centre) + centre + one * shift
    found = structures(tree_of(Y), **FEW)
    rotation, translation = found["pose_rotation"].values, found["pose_translation"].values
    assert np.allclose(rotation[:, 0] - rotation[:, 1], sign * turn, atol=0.02)
    # the alignment rotates the whole back: the structures are 32 mm independent
    assert np.allclose((translation[:, 0] - translation[:, 1])[:, 0], 0, atol=0.2)
    assert (np.sign(rotation[:, 0, 2]) == sign[:, 0]).all()


def test_the_pose_of_a_subject_in_its_scan_has_no_effect():
    Y = drawn(3, pose=1, shape=1)
    rng = np.random.default_rng(0)
    frames = Rotation.from_rotvec(2 * rng.normal(size=(N, 3))).as_matrix()
    moved = Y @ np.swapaxes(frames, 1, 2)[:, None] + 100 * rng.normal(size=(N, 1, 1, 3))
    one, other = (structures(tree_of(X), **FEW) for X in (Y, moved))
    assert np.allclose(one["level_variance"], other["level_variance"], rtol=1e-8)
    assert np.allclose(one["pose_size"], other["pose_size"], rtol=1e-6)


def test_size_of_the_whole_is_removed_on_request():
    Y = np.broadcast_to(BEAN + APART[:, None], (N, 2, *BEAN.shape))
    Y = Y * np.random.default_rng(0).uniform(0.8, 1.2, N)[:, None, None, None]
    assert share(structures(tree_of(Y), **FEW), "within") > 0.1
    with pytest.raises(ValueError, match="structures need subjects that differ"):
        structures(tree_of(Y), remove_size=True)


def test_covarying_poses_and_shapes_are_distinguished_from_independent_ones():
    rng = np.random.default_rng(5)
    independent = drawn(6, pose=1, shape=1, n=16)
    together = np.empty_like(independent)
    for i, score in enumerate(rng.normal(size=16)):
        for k in range(2):
            together[i, k] = bean(U, 0.15 * score) + APART[k] + [0, 2.0 * score * (-1) ** k, 0]
    still = without_poses(independent)
    shifted = still + (independent - still).mean(2)[:, :, None]
    p = [
        float(structures(tree_of(Y), n_permutations=199)["pose_shape_p"])
        for Y in (together, shifted)
    ]
    assert p[0] == pytest.approx(1 / 200)
    assert p[1] > 0.05


def test_a_group_that_differs_in_poses_is_found_between_structures_and_not_within():
    Y = without_poses(drawn(7, shape=1)) + drawn(8, pose=0.5) - BEAN - APART[:, None]
    group = np.repeat(["a", "b"], N // 2)
    Y[group == "b", 0, :, 0] -= 4.0
    study = tree_of(Y, {"group": group, "side": np.arange(N)})
    found = structures(study, **FEW)
    p = {}
    for level in ("between", "within"):
        of_level = structures_modes(study, found, level)
        assert list(of_level["subjects"].data_vars) == ["group", "side"]
        p[level] = float(statistics.group_test(of_level, "group", n_permutations=199)["p_value"])
    assert p["between"] <= 0.01
    assert p["within"] > 0.05


def test_a_level_is_a_study_for_tests_and_pages(tmp_path):
    study = tree_of(drawn(0, pose=1, shape=1))
    found = structures(study, **FEW)
    of_level = structures_modes(study, found, "between")
    mean = of_level["registration"]["position"].values
    assert np.allclose(mean, found["position"], atol=1e-5)
    moved = s4a.synthesize(of_level, [2.0])["position"].values
    step = of_level["pca"]["deformation"].values[0]
    assert np.allclose(moved, of_level["pca"]["mean_displacement"].values + mean + 2 * step)
    assert statistics.evaluate(of_level)["generalization"].sizes["component"] > 0
    assert s4a.write_registered(of_level, tmp_path)[0].is_file()
    with pytest.raises(ValueError, match="needs the transform of every shape"):
        s4a.write_registered(of_level, tmp_path, frame="shape")
    part = within(of_level, found["structure_of_vertex"].values == 1)
    assert part["registration"].sizes["vertex"] == len(U)
    with pytest.raises(ValueError, match="level must be one of joint, between, within"):
        structures_modes(study, found, "poses")
    found["within_displacement"] = 0 * found["within_displacement"]
    with pytest.raises(ValueError, match="within: PCA needs shapes that differ"):
        structures_modes(study, found, "within")


# ---- what is reported


def far_away(Y):
    Y[4, 1] += [300, 0, 0]


def mirrored(Y):
    Y[4, 1] *= [-1, 1, 1]


def centred(Y):
    weights = np.stack([vertex_areas(Y[0, k], T) for k in range(2)])
    Y -= np.einsum("kn,sknx->skx", weights / weights.sum(1, keepdims=True), Y)[:, :, None]


def in_metres(Y):
    Y[:, 1] /= 1000


@pytest.mark.parametrize(
    "fault, words",
    [
        (far_away, ["unusual relative pose", "s04 ("]),
        (mirrored, ["s04 ("]),
        (centred, ["left and right have the same centre in every subject"]),
        (in_metres, ["times as large as right: are both in the same unit?"]),
    ],
)
def test_structures_that_do_not_fit_together_are_reported(fault, words, caplog):
    Y = drawn(9, pose=1, shape=1)
    fault(Y)
    structures(tree_of(Y), **FEW)
    assert all(word in caplog.text for word in words)


@pytest.mark.parametrize("middle", [lambda X: X.mean(0), lambda X: (X.min(0) + X.max(0)) / 2])
def test_files_that_were_centred_one_by_one_are_reported(middle, caplog):
    Y = drawn(9, pose=1, shape=1)
    for centred in (False, True):
        nodes = tree_of(Y).to_dict()
        for i, k in np.ndindex(Y.shape[:2]):
            X = Y[i, k] - (middle(Y[i, k]) if centred else 0)
            mesh = in_unit(as_dataset(X, T), "mm").assign_attrs(unit="mm")
            nodes[f"/structures/{NAMES[k]}/original/s{i:02d}"] = mesh
        structures(xr.DataTree.from_dict(nodes), **FEW)
        assert ("every file of left, right has its centre at the origin" in caplog.text) == centred


def test_usual_poses_are_not_reported(caplog):
    for seed in range(20):
        structures(tree_of(drawn(seed, pose=1, shape=1)), **FEW)
    assert not caplog.text


def test_structures_that_cannot_be_compared_are_refused():
    study = tree_of(drawn(0, pose=1))
    right = study["structures/right/registration"].to_dataset()
    with pytest.raises(ValueError, match="a multi-structure study needed"):
        structures(of_structure(study, "left"))
    with pytest.raises(ValueError, match="no structure 'middle'; it has left, right"):
        of_structure(study, "middle")
    with pytest.raises(ValueError, match="at least 4 subjects with all structures needed, found 3"):
        structures(tree_of(drawn(0, pose=1, n=3)))
    study["structures/right/registration"] = xr.DataTree(in_unit(right, "m", of="mm"))
    with pytest.raises(ValueError, match="structures need one unit; found left: mm, right: m"):
        structures(study)


def test_structures_in_different_coordinate_systems_are_compared_in_one():
    Y = drawn(3, pose=1, shape=1)
    whole = structures(tree_of(Y), **FEW)
    study, mirror = tree_of(Y), np.diag([-1.0, 1, 1, 1])
    offsets = np.random.default_rng(0).uniform(-30, 30, (N, 3)).round(3).tolist()
    for k, name in enumerate(NAMES):
        data = study[f"structures/{name}/registration"].to_dataset().copy(deep=True)
        data["rotation"] = data["rotation"].copy(data=np.tile(np.eye(3), (N, 1, 1)))
        for i, shape in enumerate(data["shape"].values.tolist()):
            text = f"surface RAS, c_ras {' '.join(map(str, offsets[i]))}" if k else "RAS"
            attrs = {"coordinate_system": "LPS" if i % 2 and not k else text}
            attrs |= {"unit": "mm" if k else "cm", "reflected": int(i == 4)}
            ras = CoordinateSystem("RAS", "scanner", "mm")
            M = transform(ras, CoordinateSystem.of(attrs))  # and now of the mirrored file
            M = mirror @ M @ mirror if i == 4 else M
            s = np.cbrt(np.linalg.det(M[:3, :3]))
            data["rotation"].values[i] = M[:3, :3].T / s
            data["scale"].values[i] = 1 / s
            data["translation"].values[i] = -np.linalg.solve(M[:3, :3], M[:3, 3])
            path = f"structures/{name}/original/{shape}"
            study[path] = xr.DataTree(xr.Dataset(attrs=attrs))
        study[f"structures/{name}/registration"] = xr.DataTree(data)
    found = structures(study, **FEW)
    for key in ("level_share", "pose_size"):
        factor = 10 if key == "pose_size" and found["position"].attrs["units"] == "cm" else 1
        assert factor * found[key].values == pytest.approx(whole[key].values, rel=1e-6), key
    study["structures/left/original/s03"].attrs["coordinate_system"] = "RAS, origin unknown"
    with pytest.raises(ValueError, match=r"RAS, origin unknown, cm: s03 \(left\); surface RAS"):
        structures(study)


def test_warnings_name_the_subject_that_lacks_a_structure(caplog):
    study = tree_of(drawn(0, pose=1))
    left = study["structures/left/registration"].to_dataset().isel(shape=slice(1, None))
    study["structures/left/registration"] = xr.DataTree(left)
    with caplog.at_level(logging.WARNING):
        assert structures(study, **FEW).sizes["shape"] == N - 1
    assert "left out, because a structure is missing or flagged: s00 (no left)" in caplog.text


# ---- new subjects


@pytest.mark.parametrize("remove_size", [False, True])
def test_a_new_subject_is_where_it_would_be_in_the_study(remove_size):
    Y = drawn(3, pose=1, shape=1) * np.linspace(0.9, 1.1, N)[:, None, None, None]
    study = tree_of(Y)
    found = structures(study, remove_size=remove_size, **FEW)
    Q = Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix()
    again = structures_of_new(found, tree_of_new(Y @ Q.T + [5, 0, -3], study))
    for name in ("pose_rotation", "pose_translation", "pose_size", "within_displacement"):
        scatter = float(abs(found[name]).max())
        assert np.allclose(again[name], found[name], atol=1e-5 * scatter), name
    for level in ("joint", "between", "within"):
        modes, new = (structures_modes(study, found, level, one)["pca"] for one in (None, again))
        c = int((modes["explained_variance_ratio"] > 1e-3).sum())
        assert np.allclose(new["score"][:, :c], modes["score"][:, :c], atol=1e-3)
        size = float(modes["standard_deviation"][0])
        assert float(new["reconstruction_error"].max()) < 0.05 * size


def test_a_new_subject_with_a_shifted_structure_is_far_along_the_modes_of_poses_alone(caplog):
    Y = drawn(4, pose=1, shape=1)
    new = Y[:1].copy()
    new[0, 1] += [60.0, 0, 0]
    study = tree_of(Y)
    found = structures(study, **FEW)
    with caplog.at_level(logging.WARNING):
        far = structures_of_new(found, tree_of_new(new, study))
    assert "s00 (" in caplog.text
    score = {
        level: [structures_modes(study, found, level, one)["pca"]["score"] for one in (None, far)]
        for level in ("between", "within")
    }
    usual, shifted = score["between"]
    assert abs(shifted).max() > 1.5 * abs(usual).max()
    own, same = score["within"]
    assert np.allclose(same[0], own[0], atol=0.05)


def test_new_subjects_of_other_structures_or_templates_are_refused():
    Y = drawn(5, pose=1, shape=1)
    study = tree_of(Y)
    found = structures(study, **FEW)
    other = study.copy()
    part = other["structures/left/registration"].to_dataset().isel(vertex=slice(100))
    other["structures/left/registration"] = xr.DataTree(part.drop_vars("corner_vertex"))
    for new, words in [
        (study.filter(lambda node: "right" not in node.path), "of left, right needed, found left"),
        (tree_of(Y, unit="cm"), "new shapes in mm needed, found cm"),
        (other, "needed, with templates of 120, 120 vertices; found 100"),
    ]:
        with pytest.raises(ValueError, match=words):
            structures_of_new(found, new)


def test_of_registered_meshes_the_poses_and_shapes_are_those_that_were_made(several):
    found = structures(several, **FEW)
    made = subjects(6, 200)
    assert found["shape"].values.tolist() == list(made)
    template = [made[several[f"structures/{k}/registration"].attrs["template"]][k] for k in NAMES]
    points = [  # where the template's points truly are on every subject
        [
            RBFInterpolator(of[k]["reference_point"].values, of[k]["position"].values)(
                one["reference_point"].values
            )
            for k, one in zip(NAMES, template, strict=True)
        ]
        for of in made.values()
    ]
    areas = [vertex_areas(one["position"].values, one["corner_vertex"].values) for one in template]
    whole = align_wholes(np.array(points).reshape(6, 400, 3), np.concatenate(areas))
    each = [poses_of(whole[:, :200], areas[0]), poses_of(whole[:, 200:], areas[1])]
    truth = measure_levels(each, areas, **FEW)
    d = pose_fields(each[0].mean, areas[0], each[0].rotation, each[0].translation)
    rms = np.sqrt(np.einsum("n,snx->s", areas[0] / areas[0].sum(), d**2))
    assert np.allclose(truth["pose_size"][:, 0], rms)
    # of 200 vertices, which slide along the surface
    assert np.allclose(found["level_share"], truth["level_share"], atol=0.06)
    for name, least in (("pose_translation", 0.97), ("pose_size", 0.89)):
        both = found[name].values.ravel(), truth[name].values.ravel()
        assert np.corrcoef(*both)[0, 1] > least
