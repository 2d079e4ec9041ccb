"""Modes of variation (6.1): simulated modes are recovered with their variances.

Every shape is reconstructed from its scores.
"""

import numpy as np
import pytest
import xarray as xr

from s4a import synthesize, synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method import pca
from s4a.schema import dataset
from s4a.study import netcdf, store

DEVIATIONS = np.array([3.0, 1.5, 0.5])


@pytest.fixture(scope="module")
def simulated():
    """Ten displacement fields of three area-orthonormal modes with uncorrelated scores.

    And a mean.
    """
    X, T = as_arrays(synthetic.ellipsoid(800, (60, 80, 50)))
    area = vertex_areas(X, T)
    rng = np.random.default_rng(0)
    w = np.repeat(area / area.sum(), 3)
    mode = np.linalg.qr(rng.normal(size=(2400, 3)) * np.sqrt(w)[:, None])[0] / np.sqrt(w)[:, None]
    score = rng.normal(size=(10, 3))
    score = np.linalg.qr(score - score.mean(0))[0] * 3  # variance 1 with the divisor 9
    mean = np.sin(X / 20)
    d = (score * DEVIATIONS) @ mode.T
    template = as_dataset(X, T, {"template": "shape_0"})
    registration = template.assign(
        dataset(displacement=(d.reshape(10, 800, 3) + mean).astype(np.float32)).data_vars
    ).assign_coords(shape=[f"shape_{i}" for i in range(10)])
    return registration, area, mode.T.reshape(3, 800, 3), score, mean


@pytest.fixture(scope="module")
def modes(simulated):
    return pca.pca(simulated[0], simulated[1])


def test_simulated_modes_come_back_with_their_standard_deviations_and_shares(simulated, modes):
    variance = DEVIATIONS**2
    assert modes["standard_deviation"].values[:3] == pytest.approx(DEVIATIONS, rel=1e-5)
    assert modes["explained_variance_ratio"].values[:3] == pytest.approx(
        variance / variance.sum(), rel=1e-5
    )
    assert modes["mean_displacement"].values == pytest.approx(simulated[4], abs=1e-5)


def test_simulated_scores_come_back(simulated, modes):
    score, found = simulated[3], modes["score"].values[:, :3]
    assert np.abs(np.corrcoef(score.T, found.T)[:3, 3:]) == pytest.approx(np.eye(3), abs=1e-5)
    assert np.abs(found) == pytest.approx(np.abs(score), abs=1e-4)


def test_a_deformation_is_the_mode_times_its_standard_deviation(simulated, modes):
    _, area, mode, _, _ = simulated
    deformation = modes["deformation"].values[:3].astype(float)
    w = area / area.sum()
    assert np.sqrt(np.einsum("cnx,cnx,n->c", deformation, deformation, w)) == pytest.approx(
        DEVIATIONS, rel=1e-5
    )
    along = np.einsum("cnx,dnx,n->cd", deformation, mode, w)
    assert np.abs(along) == pytest.approx(np.diag(DEVIATIONS), abs=1e-4)


def test_scores_have_mean_0_variance_1_and_are_uncorrelated(modes):
    score = modes["score"].values[:, :3]
    assert score.mean(0) == pytest.approx(np.zeros(3), abs=1e-6)
    assert np.cov(score.T) == pytest.approx(np.eye(3), abs=1e-5)
    assert ((score**3).sum(0) > 0).all()


def study_of(registration, modes):
    return xr.DataTree.from_dict({"registration": registration, "pca": modes})


def test_every_shape_is_made_again_from_its_scores(simulated, modes):
    registration = simulated[0]
    study = study_of(registration, modes)
    for shape in registration["shape"].values:
        made = synthesize(study, modes["score"].sel(shape=shape))
        true = registration["position"] + registration["displacement"].sel(shape=shape)
        assert np.abs(made["position"].values - true.values).max() < 2e-5
    assert np.array_equal(made["corner_vertex"], registration["corner_vertex"])


def test_scores_of_the_first_components_are_enough(simulated, modes):
    study = study_of(simulated[0], modes)
    mean = simulated[0]["position"].values + simulated[4]
    assert synthesize(study, [0.0])["position"].values == pytest.approx(mean, abs=1e-5)
    one = synthesize(study, [2.0])["position"].values - mean
    assert one == pytest.approx(2 * modes["deformation"].values[0], abs=1e-5)


def test_too_many_scores_are_refused(simulated, modes):
    with pytest.raises(
        ValueError, match=f"at most {modes.sizes['component']} numbers; found shape"
    ):
        synthesize(study_of(simulated[0], modes), np.zeros(modes.sizes["component"] + 1))


def test_components_are_at_most_one_less_than_shapes():
    rng = np.random.default_rng(1)
    _, deformation, deviation, score, ratio = pca.gram_pca(rng.normal(size=(5, 30, 3)), np.ones(30))
    assert deformation.shape == (4, 30, 3)
    assert score.shape == (5, 4)
    assert ratio.sum() == pytest.approx(1)
    assert (np.diff(deviation) <= 0).all()


def test_the_unit_of_the_area_does_not_matter_and_that_of_the_input_scales():
    rng = np.random.default_rng(2)
    d, area = rng.normal(size=(6, 40, 3)), rng.uniform(1, 2, 40)
    one, two = pca.gram_pca(d, area), pca.gram_pca(1000 * d, 1e6 * area)
    assert two[2] == pytest.approx(1000 * one[2])
    assert two[3] == pytest.approx(one[3])
    assert two[4] == pytest.approx(one[4])


def test_the_order_of_the_shapes_only_orders_the_scores(simulated):
    order = np.random.default_rng(3).permutation(10)
    one, two = (
        pca.gram_pca(simulated[0]["displacement"].values[i], simulated[1])
        for i in (np.arange(10), order)
    )
    assert two[3][:, :3] == pytest.approx(one[3][order, :3], abs=1e-4)


def test_a_vertex_without_area_has_no_weight():
    rng = np.random.default_rng(4)
    d = rng.normal(size=(5, 20, 3))
    with_outlier = d.copy()
    with_outlier[:, 0] *= 1e4
    area = np.r_[0, np.ones(19)]
    assert pca.gram_pca(with_outlier, area)[4] == pytest.approx(pca.gram_pca(d, area)[4])


def test_low_vertices_are_those_that_u_weighs_most():
    coarse = dataset(
        position=np.zeros((2, 3)),
        coarse_vertex=[[0, 1, 1], [1, 0, 0], [0, 1, 0], [1, 0, 1]],
        coarse_weight=[[0.6, 0.4, 0.0], [0.9, 0.1, 0.0], [1.0, 0.0, 0.0], [0.5, 0.5, 0.0]],
    )
    assert pca.low_vertices(coarse).tolist() == [2, 1]


def test_two_shapes_are_refused_with_the_reason(simulated):
    with pytest.raises(ValueError, match="at least 3 shapes; found 2"):
        pca.pca(simulated[0].isel(shape=[0, 1]), simulated[1])


@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_identical_shapes_are_refused_with_the_reason(simulated, shift):
    same = simulated[0].assign(displacement=xr.full_like(simulated[0]["displacement"], shift))
    with pytest.raises(ValueError, match="all displacements are equal"):
        pca.pca(same, simulated[1])


def test_a_registration_without_displacement_is_refused_by_name(simulated):
    with pytest.raises(ValueError, match="lacks displacement"):
        pca.pca(simulated[0].drop_vars("displacement"), simulated[1])


def test_modes_by_blocks_of_vertices_are_those_of_the_whole(simulated, monkeypatch):
    registration, area, *_ = simulated
    d = registration["displacement"].values
    whole, K = pca.gram_pca(d, area), pca.gram(d, area)
    monkeypatch.setattr(pca, "BLOCK", 10 * 3 * 37)  # 800 vertices are 21 blocks and a part of one
    assert len(list(pca.blocks(d.shape))) == 22
    found = pca.gram_pca(d, area)
    assert pca.gram(d, area) == pytest.approx(K, rel=1e-12)
    for name in ("mean", "deformation", "standard_deviation", "score", "ratio"):
        there = getattr(whole, name)[:3] if name == "deformation" else getattr(whole, name)
        here = getattr(found, name)[:3] if name == "deformation" else getattr(found, name)
        assert here.dtype == there.dtype
        assert here[..., :3] == pytest.approx(there[..., :3], rel=1e-5, abs=1e-5)


def test_fields_in_files_are_read_in_parts_and_their_modes_are_the_same(monkeypatch, tmp_path):
    d = np.random.default_rng(0).normal(size=(5, 300, 3)).astype(np.float32)
    for i, field in enumerate(d):
        data = dataset(displacement=field[None]).isel(shape=0)
        store.write(data, tmp_path / f"{i}.nc")
    files = [netcdf.open_file(tmp_path / f"{i}.nc")["displacement"].variable for i in range(5)]
    monkeypatch.setattr(pca, "BLOCK", 5 * 3 * 7)  # 7 vertices
    monkeypatch.setattr(pca, "N_READ", 2)
    sizes, part = [], netcdf.Stacked.part

    def noted(self, key):
        found = part(self, key)
        sizes.append(found.size)
        return found

    monkeypatch.setattr(netcdf.Stacked, "part", noted)
    area = np.linspace(1, 2, 300)
    fields = xr.Variable(("shape", "vertex", "xyz"), netcdf.stacked(files))
    found, expected = pca.gram_pca(fields, area), pca.gram_pca(d, area)
    assert max(sizes) == 2 * 5 * 3 * 7
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
