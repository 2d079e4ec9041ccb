"""Parts of shapes in a finished study: found, completed, with intervals that hold."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation
from small import small_searches

from s4a import analyse, cli, insert, synthetic, with_landmarks, write_mesh
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a_morphometrics import calibration, complete, posterior
from s4a_morphometrics.calibration import between_paths, deviation_of, path_differences
from s4a_morphometrics.completion import read_part, warnings_of
from s4a_morphometrics.part import cut
from s4a_morphometrics.partial import model_of

OPTIONS = {"n_coarse": 600, "k_init": 12, "k": 30, "n_jobs": 1}
TURN = Rotation.from_rotvec([0.3, -0.5, 0.4]).as_matrix()


@pytest.fixture(scope="module", autouse=True)
def few_points():
    """Search with fewer points and initialisations, as the shapes are small and smooth."""
    with pytest.MonkeyPatch.context() as patch:
        small_searches(patch.setattr)
        yield


@pytest.fixture(scope="module")
def tree():
    return synthetic.brains(8, 2000, seed=7, n_modes=2)


@pytest.fixture(scope="module")
def study(tree):
    """Seven of eight brains, with landmarks."""
    brains = {name: tree["original"][name].to_dataset() for name in sorted(tree["original"])[:-1]}
    marks = ["landmark_name", "landmark_position"]
    return analyse({n: with_landmarks(mesh, mesh[marks]) for n, mesh in brains.items()}, **OPTIONS)


@pytest.fixture(scope="module")
def brain(tree):
    return tree["original/brain_08"].to_dataset()


@pytest.fixture(scope="module")
def part(brain):
    """A brain without its rear 30 %, rotated."""
    return part_of(brain)


def part_of(brain):
    X, T = as_arrays(brain)
    X, T = cut(X, T, X[:, 1] > np.quantile(X[:, 1], 0.3))
    return X @ TURN.T + [5.0, 0, 0], T


@pytest.fixture(scope="module")
def found(study, part):
    return complete(study, part, n_samples=200)


def truth_of(tree, study):
    """Where the template's vertices truly are on the brain."""
    template = study["registration"].attrs["template"]
    u = tree["truth"][template]["reference_point"].values
    return synthetic.position(tree["truth"], "brain_08", u)


def test_conditioning_a_normal_vector_follows_the_formula():
    rng = np.random.default_rng(0)
    s, n, K = 6, 40, 4
    fields = rng.normal(size=(s, n, 3))
    area = rng.uniform(1, 2, n)
    area /= area.sum()
    Phi = np.linalg.qr(rng.normal(size=(n, K)))[0] / np.sqrt(area)[:, None]
    present = np.arange(n) < 25
    known = posterior.know(fields, Phi, rng.normal(size=(n, 3)), area, present)
    gram = np.einsum("snx,tnx,n->st", known.columns[:s], known.columns[:s], area)
    weights = posterior.weights_of(known, posterior.modes_of(gram, np.arange(s)))
    shape = rng.normal(size=(n, 3))
    seen = np.einsum("qnx,nx,n->q", known.columns[:, present], shape[present], area[present])
    got = posterior.condition(known, weights, seen, 1.0)
    # the same by the covariance of all coordinates, transforms of a large variance
    E = np.einsum("qp,qnx->nxp", weights, known.columns).reshape(3 * n, -1)
    weight = K / known.rest
    before = np.concatenate([np.ones(s - 1), known.variance, np.full(6, 1e9 / weight)])
    rows = np.repeat(present, 3)
    cross = (E * before) @ E[rows].T
    noise = np.diag(np.repeat(1 / (weight * area[present]), 3))
    told = cross @ np.linalg.solve(cross[rows] + noise, shape[present].ravel())
    assert E @ got.mean == pytest.approx(told, abs=1e-5 * abs(told).max())
    covariance = (E * before) @ E.T - cross @ np.linalg.solve(cross[rows] + noise, cross.T)
    mine = (E @ got.root) @ (E @ got.root).T
    assert mine == pytest.approx(covariance, abs=1e-4 * abs(mine).max())


def test_new_shapes_are_predicted_as_well_as_left_out_shapes():
    rng = np.random.default_rng(1)
    mesh = synthetic.ellipsoid(300)
    X, T = as_arrays(mesh)
    area = vertex_areas(X, T)
    area /= area.sum()
    wave = np.cos(X @ rng.normal(size=(3, 8)) + rng.uniform(0, 6, 8))  # (n, 8)
    fields = np.einsum("swx,nw->snx", rng.normal(size=(60, 8, 3)), wave)
    fields += 0.05 * rng.normal(size=fields.shape)
    Phi = np.linalg.qr(wave * np.sqrt(area)[:, None])[0] / np.sqrt(area)[:, None]
    present = X[:, 2] < np.quantile(X[:, 2], 0.7)
    known = posterior.know(fields[:30], Phi, X, area, present)
    density, left_out = posterior.best_density(known, ~present)
    gram = np.einsum("snx,tnx,n->st", known.columns[:30], known.columns[:30], area)
    weights = posterior.weights_of(known, posterior.modes_of(gram, np.arange(30)))
    columns = np.einsum("qp,qnx->pnx", weights, known.columns)
    errors = []
    for own in fields[30:] - fields[:30].mean(0):
        seen = np.einsum("qnx,nx,n->q", known.columns[:, present], own[present], area[present])
        got = posterior.condition(known, weights, seen, density)
        errors.append((own - np.tensordot(got.mean, columns, 1))[~present])
    assert np.sqrt(np.square(errors).mean()) == pytest.approx(left_out, rel=0.3)


def test_intervals_of_ninety_percent_cover_the_complete_shape(study, brain, found):
    whole = insert(study, {"brain_08": brain}, compare=False)["registration"].to_dataset()
    image = image_in_shape(whole["position"].values, whole.isel(shape=0)) @ TURN.T + [5.0, 0, 0]
    # both are matches over the template: what two ways of matching differ by is in neither
    sd = np.sqrt(found["completion_sd"].values ** 2 - found.attrs["added"] ** 2)
    ratio = abs(found["position"].values - image) / sd
    missing = ~found["present"].values
    assert 0.8 < (ratio[missing] < posterior.WITHIN_90).mean() < 0.99


def test_intervals_hold_nine_tenths_of_the_truth(tree, study, found):
    true = truth_of(tree, study) @ TURN.T + [5.0, 0, 0]
    within = abs(found["position"].values - true) / found["completion_sd"].values
    within = within < posterior.WITHIN_90
    there = found["present"].values
    assert 0.85 < within[there].mean() < 0.99
    assert 0.85 < within[~there].mean() < 0.99
    assert found.attrs["between_paths"] > found.attrs["added"] > 0
    assert found.attrs["match_noise"] > found.attrs["between_paths"]


def slid(study, names):
    """The study with the match rotated by eleven degrees on some shapes, and the error."""
    X = study["registration"]["position"].values
    slide = np.cross([0, 0, 0.2], X - X.mean(0))
    wrong = study.copy(deep=True)
    displacement = wrong["registration"]["displacement"]
    displacement[displacement["shape"].isin(names)] += slide.astype(np.float32)
    return wrong, deviation_of([abs(slide).ravel()]) / model_of(study).template.frame[1]


def test_an_error_of_one_match_is_measured_by_the_other_path(study):
    names = study["registration"]["shape"].values.tolist()
    others = [name for name in names if name != study["registration"].attrs["template"]]
    right = between_paths(path_differences(model_of(study)))
    wrong, turned = slid(study, others[:3])  # each is registered onto one of the other three
    assert right < 0.2 * turned
    assert between_paths(path_differences(model_of(wrong))) == pytest.approx(turned, rel=0.15)
    alike, _ = slid(study, others)
    assert between_paths(path_differences(model_of(alike))) < 0.5 * turned


def test_a_shape_excluded_from_the_network_is_not_registered_to_others(study):
    latent = study["latent"].to_dataset()
    name = next(iter(path_differences(model_of(study))))
    without = study.copy()
    without["latent"] = xr.DataTree(latent.sel(shape=latent["shape"] != name))
    distances = path_differences(model_of(without))
    assert name not in distances
    assert len(distances) == 5  # of seven shapes, the template is one


@pytest.mark.parametrize("n_beside", [0, 1])
def test_fewer_than_two_shapes_besides_the_template_are_reported(study, n_beside, found):
    template = study["registration"].attrs["template"]
    latent = study["latent"].to_dataset()
    others = [name for name in latent["shape"].values if name != template]
    few = study.copy()
    few["latent"] = xr.DataTree(latent.sel(shape=[template, *others[:n_beside]]))
    assert calibration.path_differences(model_of(few)) == {}
    assert calibration.between_paths({}) == 0
    said = warnings_of(found.assign_attrs(between_paths=0.0))
    assert any("too narrow" in line for line in said)
    assert not any("too narrow" in line for line in warnings_of(found))


def test_the_missing_region_is_detected_and_the_present_one_as_accurate_as_of_the_whole(
    tree, study, brain, found
):
    true = truth_of(tree, study)
    there = true[:, 1] > np.quantile(brain["position"].values[:, 1], 0.3)
    assert (found["present"].values == there).mean() > 0.95
    assert found.attrs["missing"] == pytest.approx(0.3, abs=0.08)
    error = np.linalg.norm((found["position"].values - [5.0, 0, 0]) @ TURN - true, axis=1)
    whole = insert(study, {"brain_08": brain}, compare=False)["registration"].to_dataset()
    whole = whole.isel(shape=0)
    of_whole = np.linalg.norm(image_in_shape(whole["position"].values, whole) - true, axis=1)
    assert error[there].mean() < 1.5 * of_whole[there].mean()
    mean = study["pca"]["mean_displacement"].values + study["registration"]["position"].values
    away = np.linalg.norm(mean @ whole["rotation"].values - true, axis=1)
    assert error[~there].mean() < 0.5 * away[~there].mean()


def test_deviations_are_larger_where_nothing_is_and_samples_scatter_by_them(found):
    sd, there = found["completion_sd"].values, found["present"].values
    assert sd[~there].mean() > 1.03 * sd[there].mean()
    normal = found["completion_normal_sd"].values
    assert (normal <= np.linalg.norm(sd, axis=1) * (1 + 1e-5)).all()
    drawn = found["sample_position"].values
    assert drawn.std(0)[~there].mean() == pytest.approx(sd[~there].mean(), rel=0.2)
    distance = (drawn.mean(0) - found["position"].values)[~there]
    assert abs(distance).mean() < 0.3 * sd[~there].mean()


def test_the_result_has_the_template(study, found):
    X = study["registration"]["position"].values + found["displacement"].values
    back = (X - found["translation"].values) @ found["rotation"].values / found["scale"].item()
    assert back == pytest.approx(found["position"].values, abs=1e-3)
    covariance = found["score_covariance"].values
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.diag(covariance).max() < 1.05  # the part has information on every mode


def test_a_whole_shape_lacks_nothing(study, brain):
    found = complete(study, brain, n_samples=0)
    assert found.attrs["missing"] < 0.02
    assert found.sizes["sample"] == 0


def test_landmarks_determine_the_pose_of_a_part_and_each_run_has_the_same_result(
    study, brain, part, tmp_path
):
    P = brain["landmark_position"].values
    there = np.flatnonzero(P[:, 1] > np.quantile(brain["position"].values[:, 1], 0.35))
    assert len(there) >= 3
    upside_down = np.diag([1.0, -1, -1])
    X, T = part
    points = (P[there] @ TURN.T + [5.0, 0, 0]) @ upside_down
    names = brain["landmark_name"].values[there]
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in zip(names, points, strict=True)]
    file = tmp_path / "part.csv"
    file.write_text("name,x,y,z\n" + "\n".join(rows) + "\n")
    found, again = (
        complete(study, (X @ upside_down, T), landmarks=file, n_samples=9) for _ in range(2)
    )
    assert found.attrs["missing"] == pytest.approx(0.3, abs=0.1)
    xr.testing.assert_identical(again, found)


def test_a_part_is_converted_to_the_coordinate_system_of_the_study(study, brain):
    study, ras = study.copy(), {"coordinate_system": "RAS", "unit": "mm"}
    study["original"][study["registration"].attrs["template"]].attrs |= ras
    X, T = as_arrays(brain)
    las = as_dataset(X * [-1, 1, 1], T[:, ::-1], {"coordinate_system": "LAS", "unit": "mm"})
    assert read_part(study, las)["position"].values == pytest.approx(X)
    with pytest.raises(ValueError, match="convertible coordinate systems needed"):
        read_part(study, las.assign_attrs(unit=""))


def test_invalid_parts_are_refused_with_the_reason(study, brain, tmp_path):
    X, T = as_arrays(brain)
    small = cut(X, T, X[:, 1] > np.quantile(X[:, 1], 0.93))
    with pytest.raises(ValueError, match=r"at least 15 % of the template's area; found"):
        complete(study, small)
    with pytest.raises(ValueError, match="vertices are not finite"):
        complete(study, (np.full_like(X, np.nan), T))
    with pytest.raises(ValueError, match="no such file"):
        complete(study, tmp_path / "none.ply")
    nodes = {name: study[name] for name in ("original", "coarse", "latent", "registration")}
    with pytest.raises(ValueError, match="a finished study is needed; this one lacks pca"):
        complete(xr.DataTree.from_dict(nodes), brain)
    with pytest.raises(ValueError, match="the partial shape does not fit the study"):
        complete(study, (0.05 * X, T))
    with pytest.raises(ValueError, match=r"and its area is \d+ times that of the template"):
        complete(study, (10 * X, T))


def test_a_part_of_another_bone_is_refused_or_named(study, brain, caplog):
    X, T = as_arrays(synthetic.sphere(1500))
    size = np.sqrt(vertex_areas(*as_arrays(brain)).sum() / vertex_areas(X, T).sum())
    half = cut(size * X, T, X[:, 2] > -0.3)
    found = complete(study, half, n_samples=0)
    assert "another kind" in found.attrs["warning"]
    assert "another kind" in caplog.text


def test_the_command_writes_the_completed_mesh(study_folder, meshes, tmp_path, capsys):
    file = tmp_path / "part.ply"
    write_mesh(file, *part_of(meshes["brain_02"]))
    out = tmp_path / "out"
    words = ["complete", str(study_folder), str(file), "--out", str(out), "--samples", "1"]
    assert cli.main(words) == 2  # the study is in RAS, the part in an unknown system
    words += ["--coordinate-system", "RAS", "--unit", "mm"]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert "% of the template" in said
    assert sorted(path.name for path in out.iterdir()) == [
        "completed.nc",
        "completed.ply",
        "sample_00.ply",
    ]
    with xr.open_dataset(out / "completed.nc") as written:
        assert written["present"].values.mean() == pytest.approx(0.7, abs=0.15)
    words = ["complete", str(study_folder), str(out / "none.ply"), "--out", str(out)]
    assert cli.main(words) == 2
