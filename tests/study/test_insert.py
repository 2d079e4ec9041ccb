"""New shapes in a finished study.

Compared with the ground truth and a full recomputation; the study is not changed.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree

from s4a import analyse, insert, synthetic, transfer_labels, transfer_landmarks
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method.latent import frozen_basis
from s4a.method.pca import gram_pca, project_scores

OPTIONS = {"n_coarse": 350, "k": 30, "n_jobs": 1}


@pytest.fixture(scope="module")
def tree():
    return synthetic.brains(6, 1200, seed=5, n_modes=2)


@pytest.fixture(scope="module")
def meshes(tree):
    return {name: node.to_dataset() for name, node in tree["original"].children.items()}


@pytest.fixture(scope="module")
def study(meshes):
    """Five of six brains."""
    return analyse({n: m for n, m in meshes.items() if n != "brain_06"}, **OPTIONS)


@pytest.fixture(scope="module")
def inserted(study, meshes):
    return insert(study, {"brain_06": meshes["brain_06"]})


def errors(tree, study, shape):
    """Errors of the registered template on one shape, as shares of sqrt(area)."""
    data = study["registration"].to_dataset()
    u = tree["truth"][data.attrs["template"]]["reference_point"].values
    image = image_in_shape(data["position"].values, data.sel(shape=shape))
    size = np.sqrt(vertex_areas(*as_arrays(data)).sum())
    return np.linalg.norm(image - synthetic.position(tree["truth"], shape, u), axis=1) / size


def test_a_new_shape_is_registered_about_as_well_as_those_of_the_study(tree, study, inserted):
    template = study["registration"].attrs["template"]
    known = [
        errors(tree, study, n).mean()
        for n in study["registration"]["shape"].values
        if n != template
    ]
    assert errors(tree, inserted, "brain_06").mean() < 1.5 * max(known)
    assert 0.2 < inserted["registration"]["confidence"].mean() <= 1


def test_a_new_shape_is_close_to_what_a_full_recomputation_gives(meshes, study, inserted):
    template = study["registration"].attrs["template"]
    full = analyse(meshes, template=template, **OPTIONS)
    area = vertex_areas(*as_arrays(study["registration"].to_dataset()))
    names = ("mean_displacement", "deformation", "standard_deviation")
    modes = [study["pca"][n].values for n in names]
    d = full["registration"]["displacement"].sel(shape=["brain_06"]).values
    again, _ = project_scores(d, *modes, area)
    assert inserted["pca"]["score"].values[0, :2] == pytest.approx(again[0, :2], abs=0.25)
    distance = np.linalg.norm(inserted["registration"]["displacement"].values - d, axis=2)[0]
    assert distance.mean() < 0.006 * np.sqrt(area.sum())
    assert inserted["latent"]["distance_to_limit"].item() == pytest.approx(
        full["latent"]["distance_to_limit"].sel(shape="brain_06").item(), rel=1.0
    )


def test_the_study_stays_as_it_is_and_the_result_does_not_depend_on_other_new_shapes(
    study, meshes, inserted
):
    before = {node.path: node.to_dataset(inherit=False).copy(deep=True) for node in study.subtree}
    both = insert(study, {"brain_06": meshes["brain_06"], "again": meshes["brain_01"]}, n_jobs=2)
    assert all(
        node.to_dataset(inherit=False).identical(before[node.path]) for node in study.subtree
    )
    one = both["registration"].to_dataset().sel(shape="brain_06")
    for name, values in inserted["registration"].to_dataset().isel(shape=0).data_vars.items():
        np.testing.assert_array_equal(one[name].values, values.values, err_msg=name)
    assert (both["pca"]["score"].sel(shape="brain_06") == inserted["pca"]["score"][0]).all()
    for name in ("latent_basis", "area_difference", "conformal_difference", "distance_to_limit"):
        of_both = both["latent"][name].sel(shape="brain_06").values
        np.testing.assert_array_equal(of_both, inserted["latent"][name].values[0], err_msg=name)


def test_a_shape_of_the_study_gets_its_own_scores_back(study, meshes):
    template = study["registration"].attrs["template"]
    name = next(n for n in meshes if n not in (template, "brain_06"))
    result = insert(study, {"copy": meshes[name]})
    assert result["report"]["flag_kinds"].item() == "duplicate"
    assert result["pca"]["score"].values[0, :2] == pytest.approx(
        study["pca"]["score"].sel(shape=name).values[:2], abs=0.25
    )


def test_labels_travel_from_the_template_and_from_an_external_mesh_to_new_shapes(
    study, meshes, inserted
):
    template = study["registration"].attrs["template"]
    right = {
        name: (node["label"].values == meshes[name]["label"].values).mean()
        for tree in (study, inserted)
        for name, node in transfer_labels(tree, meshes[template]["label"].values).children.items()
    }
    assert right["brain_06"] > 0.85
    assert right["brain_06"] > min(right.values()) - 0.05
    other = synthetic.brains(1, 2500, seed=9)["original/brain_01"].to_dataset()
    outside = transfer_labels(study, other["label"].values, source=other)
    assert set(outside.children) == set(study["registration"]["shape"].values)
    for name, node in outside.children.items():
        near = cKDTree(other["position"]).query(meshes[name]["position"])[1]
        nearest = (other["label"].values[near] == meshes[name]["label"].values).mean()
        assert (node["label"].values == meshes[name]["label"].values).mean() > max(0.8, nearest)
    path_inside = transfer_landmarks(
        study, other[["landmark_name", "landmark_position"]], source=other, targets=["brain_02"]
    )
    distance = (
        path_inside["brain_02"]["landmark_position"].values
        - meshes["brain_02"]["landmark_position"].values
    )
    assert np.linalg.norm(distance, axis=1).mean() < 5  # mm


def test_a_shape_that_cannot_be_used_is_excluded_and_does_not_stop_the_others(study, meshes):
    tetrahedron = as_dataset(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    )
    result = insert(study, {"small": tetrahedron, "brain_06": meshes["brain_06"]})
    assert result["registration"]["shape"].values.tolist() == ["brain_06"]
    assert result["report"]["status"].sel(shape="small").item() == "excluded"
    with pytest.raises(ValueError, match=r"no shape can be inserted \(small: "):
        insert(study, {"small": tetrahedron})


def test_unfinished_studies_and_the_name_of_the_template_are_refused(study, meshes):
    with pytest.raises(ValueError, match="a finished study is needed; this one lacks latent"):
        insert(
            xr.DataTree.from_dict({n: study[n] for n in ("original", "coarse", "registration")}),
            meshes,
        )
    template = study["registration"].attrs["template"]
    with pytest.raises(ValueError, match="other names than the template"):
        insert(study, {template: meshes["brain_06"]})


def test_the_frozen_basis_is_exact_for_exact_maps():
    rng = np.random.default_rng(0)
    Y = np.linalg.qr(rng.normal(size=(3, 6, 6)))[0]
    new = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    out, into = Y @ new.T, new @ np.swapaxes(Y, 1, 2)  # C_out new = Y, C_in Y = new
    assert frozen_basis(out, into, Y) == pytest.approx(new)


def test_scores_on_the_modes_that_made_them_are_the_scores():
    rng = np.random.default_rng(1)
    d, area = rng.normal(size=(5, 40, 3)), rng.uniform(1, 2, 40)
    mean, deformation, deviation, score, _ = gram_pca(d, area)
    result, left = project_scores(d, mean, deformation, deviation, area)
    assert result == pytest.approx(score)
    assert left == pytest.approx(0, abs=1e-6)
