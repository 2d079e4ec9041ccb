"""The separate steps equal those of an analysis, and the formulas of the paper on stored arrays."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree

import s4a
from s4a.method.shape import Shape
from s4a.options import Options

OPTIONS = {"n_coarse": 300, "k": 24, "k_init": 10, "n_pairs": 5}


@pytest.fixture(scope="module")
def study():
    return s4a.analyse(s4a.synthetic.brains(4, 1000), **OPTIONS)


@pytest.fixture(scope="module")
def coarse(study):
    return {name: node.to_dataset() for name, node in study["coarse"].children.items()}


def test_the_network_of_an_analysis_is_built_and_refined_step_by_step(study, coarse):
    first = s4a.build_network(coarse, n_pairs=5, k_init=10)
    tree = s4a.refine_network(coarse, first, k=24)
    for stage in ("network", "latent"):
        for name, values in tree[stage].data_vars.items():
            np.testing.assert_array_equal(values, study[stage][name], err_msg=f"{stage}/{name}")
    assert tree["latent"].attrs["median"] == study["latent"].attrs["median"]


def test_the_latent_match_is_the_nearest_row_of_the_projected_basis(study):
    source, target = "brain_02", "brain_03"
    rows = []
    for name in (source, target):
        shape = Shape(study["original"][name].to_dataset(), study["coarse"][name].to_dataset())
        Y = study["latent"]["latent_basis"].sel(shape=name).values
        rows.append((shape.low.Phi @ Y, shape.U @ (shape.low.Phi @ Y)))
    for full in (False, True):
        F, G = (ends[full] for ends in rows)
        gap, _ = cKDTree(F).query(G)
        match = s4a.latent_match(study, source, target, full=full)["match"].values
        assert np.linalg.norm(F[match] - G, axis=1) == pytest.approx(gap, rel=1e-4, abs=1e-6)


def test_a_shape_registered_alone_ends_where_the_analysis_has_it(study):
    alone = s4a.register_shape(study, "brain_02", study["registration"].attrs["template"])
    there = study["registration"].sel(shape="brain_02")
    size = np.sqrt(study["registration"]["vertex_area"].values.sum())
    gap = np.linalg.norm(alone["displacement"].values - there["displacement"].values, axis=1)
    assert gap.mean() < 0.002 * size


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"preset": "paper"},
        {"refine": "intrinsic", "area_weighted": False, "n_projected": 0, "dense_match": "fmap"},
        {"remove_size": True, "refine": "spectral_icp", "template": "brain_01"},
    ],
)
def test_a_shape_is_registered_alone_as_its_study_did_it_whatever_the_options(options):
    study = s4a.analyse(s4a.synthetic.brains(3, 600), n_coarse=200, k=30, **options)
    for name in ("brain_02", "brain_03"):
        there = study["registration"].sel(shape=name)
        alone = s4a.register_shape(study, name)
        for variable in ("displacement", "registered_match", "displacement_low", "icp_rotation"):
            np.testing.assert_array_equal(alone[variable], there[variable], err_msg=variable)


def test_options_that_are_given_win_over_those_of_the_study(study):
    there = s4a.analyse(s4a.synthetic.brains(4, 1000), **OPTIONS, preset="paper")
    own = {
        "refine": "intrinsic",
        "articulated": False,
        "alignment": "icp",
        "displacement_alignment": "initial",
        "dense_match": "latent",
    }
    name, median = "brain_02", there["latent"].attrs["median"]
    given = own | {"area_weighted": False, "n_projected": 0}
    tree = xr.DataTree.from_dict(
        {stage: there[stage] for stage in ("original", "coarse", "latent", "network")}
    )
    alone = s4a.register_shape(tree, name, median, **given)
    of_study = there["registration"]["displacement"].sel(shape=name)
    np.testing.assert_array_equal(alone["displacement"], of_study)
    other = s4a.register_shape(there, name, refine="elastic")
    assert other.attrs["initialisation"].endswith("elastic")


def test_words_that_options_cannot_be_are_refused_with_those_that_they_can(study, coarse):
    for name in ("brain_02", study["latent"].attrs["median"]):
        with pytest.raises(
            ValueError, match="refine must be one of 'elastic', 'spectral_icp', 'intrins"
        ):
            s4a.register_shape(study, name, refine="intrinsc")
        with pytest.raises(ValueError, match="alignment must be one of 'search', 'icp', 'given'; "):
            s4a.register_shape(study, name, alignment="ICP")
        with pytest.raises(
            ValueError, match="dense_match must be one of 'latent', 'fmap'; found 'our'"
        ):
            s4a.register_shape(study, name, dense_match="our")
        with pytest.raises(TypeError, match="unexpected options projected; those of a registrat"):
            s4a.register_shape(study, name, projected=3)
    with pytest.raises(ValueError, match="init must be one of 'dense', 'landmarks'"):
        s4a.build_network(coarse, init="landmark")
    first = s4a.build_network(coarse, n_pairs=3, k_init=6)
    with pytest.raises(ValueError, match="weights must be one of 'cycles', 'linear_program'"):
        s4a.refine_network(coarse, first, k=10, weights="equl")
    with pytest.raises(ValueError, match="norm must be one of 'h2'"):
        s4a.refine_network(coarse, first, k=10, norm="h3")


def test_a_latent_space_as_large_as_maps_that_are_reduced_is_reduced_with_them():
    study = s4a.analyse(s4a.synthetic.brains(3, 95), n_coarse=100, n_latent=100)
    k = study["network"].sizes["eigenpair_source"]
    assert k < 100
    assert study["latent"]["latent_basis"].shape == (3, k, k)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step": 0}, "step must be an integer of at least 1; found 0"),
        ({"step": -1}, "step must be an integer of at least 1; found -1"),
        ({"k": 6}, "k must be at least 10, the size of the initial maps; found 6"),
        ({"k": 12, "n_latent": 13}, "n_latent must be at most k = 12; found 13"),
        ({"n_samples": 47}, "need at least 48 samples; found 47: give n_samples=48"),
    ],
)
def test_sizes_that_do_not_fit_each_other_are_refused_by_name(study, coarse, options, message):
    with pytest.raises(ValueError, match=message):
        s4a.refine_network(coarse, study["network"].to_dataset(), **{"k": 24} | options)


def test_the_smallest_number_of_samples_refines_identical_shapes_to_the_identity(coarse):
    same = dict.fromkeys("abc", coarse["brain_01"])
    first = s4a.build_network(same, k_init=10)
    for n_samples in (48, 0):
        maps = s4a.refine_network(same, first, k=24, n_samples=n_samples)["network/fmap"].values
        assert np.abs(maps - np.eye(24)).max() < 1e-5


def test_all_vertices_of_a_small_mesh_are_enough_samples(coarse):
    small = {name: mesh.isel(eigenpair=slice(12)) for name, mesh in coarse.items()}
    first = s4a.build_network(small, k_init=10)
    assert s4a.refine_network(small, first, k=100, n_samples=50)["network/fmap"].shape[1:] == (
        12,
        12,
    )
    every = max(mesh.sizes["vertex"] for mesh in coarse.values())
    k = min(100, *(mesh.sizes["eigenpair"] for mesh in coarse.values()))
    s4a.refine_network(coarse, first, k=k, n_samples=every)


def test_options_refuse_too_few_samples_for_k_but_presets_do_not():
    with pytest.raises(ValueError, match="needs n_samples = 200 or more, or n_samples = 0"):
        Options(n_samples=150)
    for given in ({"n_samples": 200}, {"n_samples": 0}, {"n_coarse": 150, "n_samples": 150}):
        assert Options(**given).n_samples == given["n_samples"]
    for preset in (None, "paper", "fast"):
        assert Options(preset=preset, k=600).k == 600


def test_the_template_is_registered_to_itself_by_definition(study):
    median = study["latent"].attrs["median"]
    assert s4a.register_shape(study, median).attrs["initialisation"] == "template"


def test_a_mesh_aligned_to_itself_stays(coarse):
    mesh = coarse["brain_01"]
    transform = s4a.align_pair(mesh, mesh)
    assert transform["rotation"].values == pytest.approx(np.eye(3), abs=1e-9)
    assert transform["translation"].values == pytest.approx(np.zeros(3), abs=1e-9)
    assert transform.attrs["residual"] == pytest.approx(0, abs=1e-9)


def test_what_lacks_is_named(study, coarse):
    with pytest.raises(ValueError, match=r"coarse mesh a needs the variables .*eigenvalue"):
        s4a.build_network({"a": coarse["brain_01"].drop_vars("eigenvalue")})
    with pytest.raises(ValueError, match="/original/nobody is needed; this one has none"):
        s4a.latent_match(study, "nobody", "brain_01")
    with pytest.raises(ValueError, match="dense_match must be"):
        s4a.latent_match(study, "brain_01", "brain_02", dense_match="both")
