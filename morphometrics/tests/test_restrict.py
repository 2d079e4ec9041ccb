"""Parts of what varies (6.1): a region, without a nuisance, with size given back."""

import numpy as np
import pytest
import xarray as xr
from simulated import TOP, T, X, noise, study_of

from s4a import analyse, cli, open_study, read_mesh, statistics, synthetic, write_registered
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method.pca import gram, pca
from s4a_morphometrics import with_size, within, without


@pytest.fixture(scope="module")
def simulated():
    """Twenty shapes: groups differ at the top, and age has the strongest effect everywhere."""
    rng = np.random.default_rng(0)
    group = np.repeat(["a", "b"], 10)
    age = rng.permutation(20).astype(float)
    d = noise(1, 20) + 0.05 * (group == "b")[:, None, None] * TOP[:, None] * X
    return study_of(d + 0.05 * age[:, None, None] * X * [1, 0, 0], group=group, age=age)


def test_a_region_has_its_vertices_their_displacements_and_modes_of_its_own(simulated):
    part = within(simulated, TOP)
    mesh = part["registration"].to_dataset()
    vertex = mesh["template_vertex"].values
    assert set(vertex) <= set(np.flatnonzero(TOP))
    assert len(vertex) > 0.95 * TOP.sum()
    assert np.array_equal(mesh["position"].values, X[vertex])
    whole = simulated["registration"]["displacement"].values
    assert np.array_equal(mesh["displacement"].values, whole[:, vertex])
    triangles = vertex[mesh["corner_vertex"].values]
    assert {tuple(t) for t in triangles} == {tuple(t) for t in T[TOP[T].all(axis=1)]}
    expected = pca(mesh, vertex_areas(*as_arrays(mesh)))
    assert part["pca"].to_dataset().equals(expected)
    labelled = within(simulated, 7)
    assert labelled["registration"].equals(part["registration"])
    sure = within(simulated, min_confidence=0.5)
    assert sure["registration"].equals(part["registration"])
    assert within(simulated)["registration"].sizes["vertex"] == len(X)


def test_an_effect_is_found_in_its_region_and_not_in_the_other(simulated):
    options = {"covariates": ["age"], "n_permutations": 199}
    inside, outside = (
        statistics.group_test(within(simulated, label), "group", **options)["p_value"]
        for label in (7, 3)
    )
    assert inside <= 0.05 < outside
    found = statistics.group_map(within(simulated, 7), "group", **options)
    assert found.sizes["vertex"] == within(simulated, 7)["registration"].sizes["vertex"]


@pytest.mark.parametrize(
    "region, words",
    [
        (TOP[:-1], "one value for each of the template's 400 vertices, found .399,."),
        (9, "no vertex of the template has the label 9; it has 3, 7"),
        (np.arange(400) < 3, "at least 12 vertices with triangles among them, found"),
    ],
)
def test_a_region_that_is_none_is_an_error(simulated, region, words):
    with pytest.raises(ValueError, match=words):
        within(simulated, region)


def test_a_region_of_a_region_says_which_vertices_of_the_template_it_has(simulated):
    top = within(simulated, TOP.tolist())
    mesh = top["registration"].to_dataset()
    half = within(top, mesh["position"][:, 0] > 0)["registration"].to_dataset()
    assert np.array_equal(half["position"].values, X[half["template_vertex"].values])


def test_labels_of_a_region_can_be_given(simulated):
    labels = np.where(TOP, "top", "rest")
    named = within(simulated, "top", labels=labels)
    assert named["registration"].equals(within(simulated, 7)["registration"])
    with pytest.raises(ValueError, match=r"for each of the template's 400 vertices, found \(3,\)"):
        within(simulated, "top", labels=labels[:3])
    bare = simulated.filter(lambda node: "label" not in node)
    with pytest.raises(ValueError, match=r"has no labels; give them as labels= \(--labels FILE\)"):
        within(bare, 7)


def test_without_a_nuisance_no_displacement_or_mode_depends_on_it(simulated):
    rest = without(simulated, "age")
    fit = statistics.regression(simulated, "age", n_permutations=9)
    after = statistics.regression(rest, "age", n_permutations=99)
    assert abs(after["effect"]).max() < 1e-6 * abs(fit["effect"]).max()
    assert after["p_value"] > 0.9
    area = vertex_areas(X, T) / vertex_areas(X, T).sum()
    modes = rest["pca"]["deformation"].values
    along = np.einsum("cnx,nx,n->c", modes, fit["effect"].values, area)
    size = np.sqrt(np.einsum("nx,nx,n->", fit["effect"].values, fit["effect"].values, area))
    assert abs(along).max() < 1e-6 * size
    assert simulated["pca"]["explained_variance_ratio"].values[0] > 0.5
    two = without(simulated, ["age", "group"])
    assert (
        gram(two["registration"]["displacement"].values, area).trace()
        < gram(rest["registration"]["displacement"].values, area).trace()
    )
    with pytest.raises(ValueError, match="the nuisance is constant"):
        without(simulated, np.ones(20))
    with pytest.raises(ValueError, match="value for every shape; covariate lacks shape_00"):
        without(simulated, [np.nan, *range(19)])
    with pytest.raises(ValueError, match="value for every shape; covariate lacks shape_18"):
        without(simulated, np.array([*"ab" * 9, "NA", "a"]))


def test_size_that_was_taken_out_is_given_back():
    brains = synthetic.brains(5, 300, seed=1)
    shapes = {
        name: as_arrays(node.to_dataset()) for name, node in brains["original"].children.items()
    }
    shapes = {name: (Y * (1 + 0.1 * i), S) for i, (name, (Y, S)) in enumerate(shapes.items())}
    options = {"n_coarse": 120, "k": 12, "k_init": 8, "n_jobs": 1, "intersections": False}
    options |= {"template": "brain_01", "include_flagged": True}
    scaled = analyse(shapes, remove_size=True, **options)
    back = with_size(scaled)
    kept = analyse(shapes, remove_size=False, **options)

    def radius(study):
        mesh = study["registration"].to_dataset()
        Y = mesh["position"].values + mesh["displacement"].values
        return np.sqrt(((Y - Y.mean(1, keepdims=True)) ** 2).sum(-1).mean(1))

    assert np.ptp(radius(scaled)) < 0.1 * np.ptp(radius(kept))
    np.testing.assert_allclose(radius(back), radius(kept), rtol=0.02)
    assert back["pca"]["explained_variance_ratio"].values[0] > 0.8
    position = scaled["registration"]["position"].values
    for name in shapes:  # in the frames of the files, before and after
        ends = [image_in_shape(position, s["registration"].sel(shape=name)) for s in (scaled, back)]
        assert np.allclose(*ends, atol=1e-4)
    with pytest.raises(ValueError, match="of this study include size"):
        with_size(kept)


def test_the_command_takes_a_region_and_a_nuisance(study_folder, tmp_path, capsys, no_pictures):
    table = tmp_path / "table.csv"
    with open(table, "w") as file:
        names = [path.stem for path in sorted((study_folder / "original").glob("*.nc"))]
        file.write("shape,age\n" + "\n".join(f"{n},{20 + i**2}" for i, n in enumerate(names)))
    flags = ["--table", str(table), "--out", str(tmp_path / "o")]
    command = ["region-statistics", str(study_folder), *flags]
    assert cli.main([*command, "--regress-out", "age", "--min-confidence", "0.2"]) == 0
    assert "without age" in capsys.readouterr().out
    assert cli.main([*command, "--region", "999"]) == 2
    assert "no vertex of the template has the label 999" in capsys.readouterr().err
    with open_study(study_folder) as study:
        template = study["registration"].attrs["template"]
        Y = study[f"original/{template}/position"].values
    np.savetxt(tmp_path / "halves.csv", np.where(Y[:, 0] > 0, 5, 9), "%d")  # the file's vertices
    halves = ["--region", "5", "--labels", str(tmp_path / "halves.csv")]
    assert cli.main([*command, *halves]) == 0
    assert f" of {len(Y)} vertices" in capsys.readouterr().out
    assert cli.main([*command, *halves[2:]]) == 2
    assert "--labels needs --region" in capsys.readouterr().err


def test_a_mirrored_shape_of_a_region_is_written_on_the_side_of_its_file(study, tmp_path):
    mirrored = study.copy(deep=True)
    name = study["registration"]["shape"].values[1]
    mirrored["original"][name].attrs["reflected"] = 1
    shapes = study["report"]["shape"]
    mirrored["report"]["reflected"] = xr.DataArray(shapes.values == name, {"shape": shapes.values})
    for tree, folder in ((mirrored, "whole"), (within(mirrored), "part")):
        write_registered(tree, tmp_path / folder, frame="shape")
    (X, T, _), (Y, S, _) = (read_mesh(tmp_path / way / f"{name}.ply") for way in ("whole", "part"))
    assert np.array_equal(X, Y)
    assert np.array_equal(T, S)
