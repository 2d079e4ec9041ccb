"""Left against right (6.1): simulated asymmetries are found as what they are, and no others."""

import logging

import numpy as np
import pytest
import xarray as xr
from faults import shapes as faulty
from scipy import stats

from s4a import cli, open_study, read_mesh, synthetic
from s4a.analysis.permutation import Model
from s4a.geometry.closest import interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas, vertex_normals
from s4a.input.clean import clean
from s4a.method.pca import pca
from s4a.schema import dataset
from s4a.show.surfaces import unit_text
from s4a_morphometrics import asymmetry, asymmetry_modes, symmetric_template, symmetry
from s4a_morphometrics import bilateral as left_right
from s4a_morphometrics.bilateral import antisymmetry_test, sides_test
from s4a_morphometrics.bilateral_pairs import involution, plane_between

M = np.array([-1.0, 1, 1])
OPTIONS = {"n_permutations": 199}
MESH = as_arrays(synthetic.ellipsoid(500, (2.0, 3.0, 1.5)))


def smooth(rng, P, s, waves=12):
    """Smooth random fields (s, n, 3) at points."""
    k, phase = rng.normal(0, 0.6, (waves, 3)), rng.uniform(0, 2 * np.pi, waves)
    return np.einsum("swx,nw->snx", rng.normal(size=(s, waves, 3)), np.cos(P @ k.T + phase)) / 4


def fields(seed, s, symmetric=0.3, fluctuating=0.05):
    """Displacements of an ellipsoid (s, n, 3) that are symmetric in x, and some that are not."""
    X, _ = MESH
    once, twice = (np.random.default_rng(seed) for _ in range(2))
    both = smooth(once, X, s) + smooth(twice, X * M, s) * M
    once, twice = (np.random.default_rng(seed + 1000) for _ in range(2))
    odd = smooth(once, X, s) - smooth(twice, X * M, s) * M
    return symmetric * both + fluctuating * odd


def study_of(d, mesh=MESH, **subjects):
    """A study of given displacements (s, n, 3), whose shapes may have columns."""
    names = [f"shape_{i:02d}" for i in range(len(d))]
    X, T = mesh
    registered = as_dataset(X, T, {"template": names[0]}).merge(dataset(displacement=d))
    registered = registered.assign_coords(shape=names)
    table = xr.Dataset({n: ("shape", v) for n, v in subjects.items()}, {"shape": names})
    modes = pca(registered, vertex_areas(X, T))
    return xr.DataTree.from_dict({"registration": registered, "pca": modes, "subjects": table})


def bump():
    """An outward bump at a point on the right, of height 1 (n, 3), and the mask of its top."""
    X, T = MESH
    height = np.exp(-((X - [1.7, 1.0, 0.6]) ** 2).sum(1) / 0.5)
    return height[:, None] * vertex_normals(X, T), height > 0.5


@pytest.fixture(scope="module")
def partners():
    """The partners of the vertices of the ellipsoid, as its equation gives them."""
    X, T = MESH
    (triangle, weights), _, distance = involution(X * M, X, T)
    return dataset(
        partner_triangle=triangle, partner_barycentric=weights, partner_distance=distance
    )


def test_the_plane_is_that_between_points_and_their_mirror_images():
    rng = np.random.default_rng(3)
    X, normal = rng.normal(size=(50, 3)), np.array([2.0, -1, 2]) / 3
    plane = left_right.Mirror(np.array([1.0, 2, 3]), normal)
    found = plane_between(X, plane(X) + rng.normal(size=(50, 3)) * 1e-6, rng.uniform(1, 2, 50))
    assert abs(found.normal @ normal) == pytest.approx(1)
    assert (found.center - plane.center) @ normal == pytest.approx(0, abs=1e-5)
    np.testing.assert_allclose(plane(plane(X)), X, atol=1e-12)


def test_a_map_to_the_other_side_that_errs_becomes_an_involution():
    X, T = MESH
    rng = np.random.default_rng(0)
    (triangle, weights), before, after = involution(X * M + 0.05 * smooth(rng, X, 1)[0], X, T)
    assert np.sqrt((after**2).mean()) < 0.3 * np.sqrt((before**2).mean())
    there = interpolate(X, T, triangle, weights)
    again = interpolate(there, T, triangle, weights)
    np.testing.assert_allclose(np.linalg.norm(again - X, axis=1), after, atol=1e-12)


def test_the_parts_add_up_and_the_asymmetry_changes_sign_on_the_other_side(partners):
    study = study_of(fields(0, 8))
    found = asymmetry(study, partners=partners, **OPTIONS)
    a, s = found["asymmetry"].values, found["symmetric"].values
    mean = found["symmetric_position"].values
    X, T = MESH
    place = partners["partner_triangle"].values, partners["partner_barycentric"].values
    plane = plane_between(mean, interpolate(mean, T, *place), vertex_areas(X, T))
    reflected = plane.reflected(a)
    there = np.stack([interpolate(one, T, *place) for one in a.astype(float)])
    assert np.sqrt(((there + reflected) ** 2).mean()) < 0.1 * np.sqrt((a**2).mean())
    symmetric = np.stack([interpolate(mean + one, T, *place) for one in s])
    np.testing.assert_allclose(symmetric, plane(mean + s), atol=0.05)
    # each shape is the consensus, its symmetric part and its asymmetry, moved
    shape = X + study["registration"]["displacement"].values[3]
    distance = np.linalg.norm(shape[:, None, :] - shape[None], axis=-1)
    ours = mean + s[3] + a[3]
    np.testing.assert_allclose(
        np.linalg.norm(ours[:, None, :] - ours, axis=-1), distance, atol=1e-5
    )
    # the table: sums of squares over both sides
    area = vertex_areas(X, T) / vertex_areas(X, T).sum()
    total = sum(((s + sign * a) ** 2).sum(-1).sum(0) @ area for sign in (1, -1))
    assert found["sum_of_squares"].sum().item() == pytest.approx(total, rel=1e-5)
    assert found["variance_share"].values[0] > 0.9
    assert found.attrs["symmetry"] == "object"


def test_directional_asymmetry_is_found_where_it_is_and_on_the_other_side(partners):
    push, patch = bump()
    study = study_of(fields(1, 14) + 0.4 * push)
    found = asymmetry(study, partners=partners, **OPTIONS)
    assert found["p_value"].item() == 0.005
    T = MESH[1]
    place = partners["partner_triangle"].values, partners["partner_barycentric"].values
    there = interpolate(patch[:, None].astype(float), T, *place)[:, 0] > 0.5
    marked = found["p_family_wise"].values <= 0.05
    assert marked[patch | there].mean() > 0.8
    far = np.linalg.norm(push, axis=1) < 0.02
    far &= interpolate(far[:, None].astype(float), T, *place)[:, 0] > 0.5
    assert marked[far].mean() < 0.05
    outward = found["directional_normal"].values
    assert outward[patch].mean() == pytest.approx(0.15, abs=0.04)  # half of the push
    assert outward[there].mean() == pytest.approx(-0.15, abs=0.06)
    assert found["effect_size"].values[patch].mean() > 1
    assert found["antisymmetry_p"] > 0.05
    vectors = asymmetry(study, partners=partners, of="vector", **OPTIONS)
    assert (vectors["p_family_wise"].values[patch] <= 0.05).mean() > 0.5


def test_without_it_nothing_is_found(partners):
    p = []
    for seed in range(12):
        found = asymmetry(study_of(fields(10 + seed, 10)), partners=partners, n_permutations=99)
        p.append([found["p_value"].item(), found["p_family_wise"].min().item()])
    assert (np.array(p) <= 0.05).mean(0).max() <= 0.25
    assert np.median(p) > 0.2


def test_an_error_of_the_partners_along_the_surface_is_no_asymmetry_along_the_normals(partners):
    X, T = MESH
    rng = np.random.default_rng(1)
    place, _, distance = involution(X * M + 0.5 * smooth(rng, X, 1)[0], X, T)
    wrong = dataset(
        partner_triangle=place[0], partner_barycentric=place[1], partner_distance=distance
    )
    study = study_of(fields(30, 12))
    of = {}
    for kind in ("vector", "normal"):
        found = asymmetry(study, partners=wrong, of=kind, **OPTIONS)
        of[kind] = (found["p_family_wise"].values <= 0.05).mean()
    assert of["vector"] > 0.2
    assert of["normal"] < 0.05


def test_antisymmetry_is_distinguished_from_directional_asymmetry(partners):
    push, _ = bump()
    sign = np.where(np.arange(16) % 2, 1.0, -1.0)
    d = fields(2, 16) + 0.8 * sign[:, None, None] * push
    found = asymmetry(study_of(d), partners=partners, **OPTIONS)
    assert found["antisymmetry_p"] < 0.02
    assert found["kurtosis"] < 1.6
    assert found["p_value"] > 0.05
    assert abs(np.corrcoef(found["asymmetry_score"].values[:, 0], sign)[0, 1]) > 0.9
    larger = asymmetry(study_of(fields(2, 16, fluctuating=0.1)), partners=partners, **OPTIONS)
    smaller = asymmetry(study_of(fields(2, 16)), partners=partners, **OPTIONS)
    ratio = larger["fluctuating_size"] / smaller["fluctuating_size"]
    assert ratio.values == pytest.approx(2, abs=0.15)


# ---- matching symmetry


def matching(d_left, d_right, **columns):
    """A study of left and right shapes of subjects, one side mirrored."""
    n = len(d_left)
    columns = {
        "subject": [f"p{i}" for i in range(n)] * 2,
        "side": ["left"] * n + ["right"] * n,
    } | columns
    return study_of(np.concatenate([d_left, d_right]), **columns)


def test_both_sides_of_subjects_are_compared_and_the_larger_side_is_found():
    push, patch = bump()
    d, own = fields(3, 9), fields(4, 18, symmetric=0.02)
    study = matching(d + own[:9], d + own[9:] + 0.6 * push)
    found = asymmetry(study, subject="subject", side="side", **OPTIONS)
    assert found.attrs["sides"] == "right minus left"
    assert found["individual"].values.tolist() == [f"p{i}" for i in range(9)]
    assert found["p_value"] <= 0.03
    assert (found["p_family_wise"].values[patch] <= 0.05).mean() > 0.8
    X, T = MESH
    outward = (found["directional"].values * vertex_normals(X, T)).sum(1)
    assert outward[patch].mean() == pytest.approx(0.22, abs=0.06)
    assert "partner_distance" not in found
    other = matching(d + own[:9], d + own[9:])
    p = asymmetry(other, subject="subject", side="side", **OPTIONS)["p_value"]
    assert p > 0.05


def test_errors_of_triangles_and_partners_are_not_asymmetry(partners):
    shapes = fields(3, 16, symmetric=0.1, fluctuating=0.002)  # less than the triangles leave
    for of in ("normal", "vector"):
        found = asymmetry(study_of(shapes), partners=partners, of=of, **OPTIONS)
        assert found["p_value"] > 0.05
        assert found["p_family_wise"].min() > 0.05
    a = found["asymmetry"].values.astype(float)
    area = vertex_areas(*MESH) / vertex_areas(*MESH).sum()
    K = np.einsum("inx,jnx,n->ij", a, a, area)
    assert sides_test(K, Model.one_sample(len(K), 199))[1] < 0.05  # as they are


def test_the_table_is_that_of_two_way_analysis_of_variance():
    d = np.random.default_rng(0).normal(size=(12, 500, 3)) * 0.01
    found = asymmetry(
        matching(d[:6], d[6:] + 0.005), subject="subject", side="side", of="vector", **OPTIONS
    )
    area = vertex_areas(*MESH) / vertex_areas(*MESH).sum()
    a, s = (found[name].values.astype(float) for name in ("asymmetry", "symmetric"))
    y = np.stack([s - a, s + a])  # (side, individual, n, 3)
    grand = y.mean((0, 1))
    cells = y - y.mean(0) - y.mean(1)[:, None] + grand
    expected = [
        2 * ((y.mean(0) - grand) ** 2).sum((0, 2)) @ area,
        6 * ((y.mean(1) - grand) ** 2).sum((0, 2)) @ area,
        (cells**2).sum((0, 1, 3)) @ area,
    ]
    assert found["sum_of_squares"].values == pytest.approx(expected, rel=1e-4)
    F = expected[1] / (expected[2] / 5)
    assert found["statistic"].item() == pytest.approx(F, rel=1e-4)
    assert found["f_ratio"].values[1] == pytest.approx(F, rel=1e-4)


@pytest.mark.parametrize(
    "columns, words",
    [
        ({"side": ["left"] * 12}, "side needs two values, such as left and right; found left"),
        (
            {"subject": ["p0", "p0", *(f"p{i}" for i in range(2, 6))] * 2},
            "subject 'p0' has two shapes of the side 'left', shape_00 and shape_01",
        ),
        (
            {"subject": [f"p{i}" for i in range(9)] + ["p0", "p1", "p2"]},
            "at least 4 subjects with both sides, found 3; the other side is missing for",
        ),
    ],
)
def test_sides_that_are_no_pairs_are_errors_that_name_the_shapes(columns, words):
    d = fields(5, 12)
    with pytest.raises(ValueError, match=words):
        asymmetry(matching(d[:6], d[6:], **columns), subject="subject", side="side")


def test_a_subject_with_one_side_is_left_out_by_name_and_sides_are_checked(caplog):
    d = fields(6, 12)
    study = matching(
        d[:6], d[6:], subject=[*(f"p{i}" for i in range(6))] + ["p0", "p1", "p2", "p3", "p4", "q"]
    )
    found = asymmetry(study, subject="subject", side="side", **OPTIONS)
    assert found.sizes["individual"] == 5
    assert (
        "left out, because the other side of the subject is missing: shape_05, shape" in caplog.text
    )
    assert "the run mirrored none of the shapes" in caplog.text
    caplog.clear()
    names = study["registration"]["shape"].values
    report = dataset(reflected=np.arange(12) < 6, status=["ok"] * 12).assign_coords(shape=names)
    study["report"] = xr.DataTree(report)
    asymmetry(study, subject="subject", side="side", **OPTIONS)
    assert "the run mirrored" not in caplog.text


def test_untestable_studies_are_errors(partners):
    study = study_of(fields(7, 6))
    with pytest.raises(ValueError, match="both subject and side"):
        asymmetry(study, subject="subject")
    with pytest.raises(ValueError, match="of must be one of 'vector', 'normal'"):
        asymmetry(study, of="size")
    with pytest.raises(ValueError, match="use 4 shapes, fewer"):
        Model.one_sample(3).vertex_test(np.ones((3, 5, 3)))
    d = fields(7, 4)
    twice = matching(d, d)
    with pytest.raises(ValueError, match="left and right are the same in all shapes"):
        asymmetry(twice, subject="subject", side="side")


# ---- the tests on arrays


def test_the_test_of_a_mean_is_hotellings_and_students():
    rng = np.random.default_rng(0)
    d = rng.normal(size=(11, 4, 3)) + 0.3
    share = Model.one_sample(11, 9).vertex_test(d)[0]
    for v in range(4):
        mean, S = d[:, v].mean(0), np.cov(d[:, v].T)
        assert 10 * share[v] / (1 - share[v]) == pytest.approx(
            11 * mean @ np.linalg.solve(S, mean), rel=1e-4
        )
    one = Model.one_sample(11, 9).vertex_test(d[..., :1])[0]
    t = stats.ttest_1samp(d[..., 0], 0).statistic
    assert 10 * one / (1 - one) == pytest.approx(t**2, rel=1e-4)


def test_all_changes_of_sign_are_gone_through_where_they_are_few():
    a = np.arange(1.0, 6)
    share, p, p_max = Model.one_sample(5).vertex_test(np.abs(a)[:, None, None])
    assert p[0] == p_max[0] == sides_test(np.outer(a, a), Model.one_sample(5))[1] == 1 / 16
    assert share[0] == pytest.approx(a.sum() ** 2 / (5 * (a**2).sum()))


def test_p_values_of_a_mean_of_zero_are_uniform():
    found = [
        Model.one_sample(14, 99, seed).vertex_test(
            np.random.default_rng(seed).normal(size=(14, 30, 3))
        )
        for seed in range(100)
    ]
    smallest = np.array([p_max.min() for _, _, p_max in found])
    assert stats.kstest(smallest, "uniform").pvalue > 0.01
    assert 0.03 < np.mean([(p <= 0.05).mean() for _, p, _ in found]) < 0.07


@pytest.mark.parametrize("deviations", [[1, 1, 1, 1, 1, 1], [9, 2, 1, 1, 1, 1], [1]])
def test_p_of_antisymmetry_is_uniform_for_normal_individuals_of_any_covariance(deviations):
    rng = np.random.default_rng(len(deviations))
    drawn = rng.normal(size=(150, 15, len(deviations))) * deviations
    found = [antisymmetry_test(individuals)[1] for individuals in drawn]
    assert stats.kstest(found, "uniform").pvalue > 0.01


# ---- of whole studies


def test_the_template_of_a_study_finds_its_other_side(study):
    partners = symmetry(study)
    assert partners.attrs["involution_error"] < min(0.03, partners.attrs["involution_error_before"])
    mesh = study["registration"].to_dataset()
    X, T = as_arrays(mesh)
    place = partners["partner_triangle"].values, partners["partner_barycentric"].values
    there = interpolate(X, T, *place)
    plane = plane_between(X, there, vertex_areas(X, T))
    assert abs(plane.normal[0]) > 0.98  # brains are nearly symmetric in x
    distance = np.linalg.norm(plane(X) - there, axis=1)
    assert np.median(distance) < 0.1 * np.sqrt(vertex_areas(X, T).sum())


def test_a_symmetric_template_has_half_of_a_bump_on_each_side(partners):
    push, high = bump()
    X, T = MESH
    study = study_of(fields(3, 5), (X + 0.2 * push, T))
    mesh = symmetric_template(study, partners)
    S = mesh["position"].values
    assert (mesh["corner_vertex"].values == T).all()
    place = partners["partner_triangle"].values, partners["partner_barycentric"].values
    distances = []
    for P in (study["registration"]["position"].values, S):  # how far from its mirror image
        there = interpolate(P, T, *place)
        plane = plane_between(P, there, vertex_areas(P, T))
        assert abs(plane.normal[0]) > 0.99
        distances.append(np.linalg.norm(plane(there) - P, axis=1))
    assert distances[1].max() < 0.15 * distances[0].max()
    moved = ((S - X) * vertex_normals(X, T)).sum(1)
    opposite = np.exp(-((X * M - [1.7, 1.0, 0.6]) ** 2).sum(1) / 0.5) > 0.5
    for side in (high, opposite):
        whole = 0.2 * np.linalg.norm(push, axis=1)[high].mean()
        assert moved[side].mean() == pytest.approx(whole / 2, rel=0.3)
    again = study_of(fields(3, 5), (S, T))
    assert symmetric_template(again, partners).attrs["moved"] < 0.4 * mesh.attrs["moved"]


def test_a_template_without_bilateral_symmetry_is_reported(caplog):
    mesh = clean(as_dataset(*faulty.shape(400)))
    d = np.random.default_rng(0).normal(size=(5, mesh.sizes["vertex"], 3))
    X, T = as_arrays(mesh)
    with caplog.at_level(logging.WARNING):
        symmetry(study_of(d, (X * [1, 1 + X[:, :1].max() / 50, 1], T)))
    assert "is the template symmetric? For left and right shapes, give" in caplog.text


def test_modes_play_the_directional_part_first_and_have_its_share(partners):
    push, _ = bump()
    study = study_of(fields(8, 8) + 0.2 * push)
    study["registration/displacement"].attrs["units"] = "mm"
    found = asymmetry(study, partners=partners, **OPTIONS)
    modes = asymmetry_modes(study, found)
    assert unit_text(modes, "") == "mm"
    share = found["variance_share"].values
    ratio = modes["pca"]["explained_variance_ratio"].values
    assert ratio.sum() == pytest.approx(1)
    assert ratio[0] == pytest.approx(share[1] / (share[1] + share[2]), rel=1e-4)
    first = modes["pca"]["deformation"].values[0]
    np.testing.assert_allclose(first, found["directional"].values, atol=1e-6)
    assert modes["pca"]["score"].values[:, 0].mean() == pytest.approx(1)


def test_the_command_writes_tables_and_a_page(study_folder, tmp_path, capsys, no_pictures):
    out = tmp_path / "out"
    command = ["asymmetry", str(study_folder), "--permutations", "15", "--out", str(out)]
    assert cli.main(command) == 0
    said = capsys.readouterr().out
    for words in ("individuals x sides", "directional asymmetry", "antisymmetry", "partner"):
        assert words in said
    files = {path.name for path in out.iterdir()}
    assert {"asymmetry.nc", "asymmetry.term.csv", "asymmetry.individual.csv"} <= files
    assert "asymmetry.html" in files
    X, T, _ = read_mesh(out / "symmetric.ply")
    with open_study(study_folder) as study:
        template = study["registration"].to_dataset()
        assert (template["corner_vertex"].values == T).all()
        distance = np.linalg.norm(template["position"].values - X, axis=1)
    assert 0 < distance.mean() < 5  # mm
    assert cli.main([*command, "--subject", "person"]) == 2
    assert "both subject and side" in capsys.readouterr().err
