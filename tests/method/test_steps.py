"""The steps one by one are those of an analysis, and the formulas of the paper on stored arrays."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import s4a
from s4a.method.shape import Shape

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


def test_the_template_is_registered_to_itself_by_definition(study):
    median = study["latent"].attrs["median"]
    assert s4a.register_shape(study, median).attrs["method"] == "template"


def test_a_mesh_aligned_to_itself_stays(coarse):
    mesh = coarse["brain_01"]
    motion = s4a.align_pair(mesh, mesh)
    assert motion["rotation"].values == pytest.approx(np.eye(3), abs=1e-9)
    assert motion["translation"].values == pytest.approx(np.zeros(3), abs=1e-9)
    assert motion.attrs["residual"] == pytest.approx(0, abs=1e-9)


def test_what_lacks_is_named(study, coarse):
    with pytest.raises(ValueError, match=r"coarse mesh a needs the variables .*eigenvalue"):
        s4a.build_network({"a": coarse["brain_01"].drop_vars("eigenvalue")})
    with pytest.raises(ValueError, match="/original/nobody is needed; this one has brain_01"):
        s4a.latent_match(study, "nobody", "brain_01")
    with pytest.raises(ValueError, match="how must be"):
        s4a.latent_match(study, "brain_01", "brain_02", how="both")
