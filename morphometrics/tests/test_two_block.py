"""Fields against shape: two-block partial least squares."""

import shutil

import numpy as np
import pytest
from simulated import HEIGHT, X, field_study

from s4a import cli, open_study
from s4a_morphometrics import covariation, covariation_modes, with_field, write_field
from s4a_morphometrics.two_block import two_block


@pytest.fixture(scope="module")
def simulated():
    return field_study()


def test_scores_of_a_covariation_are_freed_of_its_covariates(simulated):
    z = np.random.default_rng(1).normal(size=simulated["registration"].sizes["shape"])
    found = covariation(simulated, "thickness", covariates={"z": z}, n_permutations=9)
    for a, b, r in zip(
        found["score"].values.T,
        found["field_score"].values.T,
        found["pair_correlation"].values,
        strict=True,
    ):
        assert np.isclose(np.corrcoef(a, b)[0, 1], r)
        assert abs(np.corrcoef(a, z)[0, 1]) < 1e-6


def test_two_blocks_are_those_of_the_singular_value_decomposition():
    rng = np.random.default_rng(3)
    A, B = rng.normal(size=(15, 6)), rng.normal(size=(15, 4))
    found = two_block(A, B, n_permutations=19)
    A, B = A - A.mean(0), B - B.mean(0)
    cross = A.T @ B / 14
    assert np.allclose(found["singular"], np.linalg.svd(cross, compute_uv=False))
    scores = A @ found["U"][:, 0], B @ found["V"][:, 0]
    assert np.isclose(found["r"][0], np.corrcoef(*scores)[0, 1])
    rv = np.trace(A.T @ B @ B.T @ A)
    rv /= np.sqrt(np.trace(A.T @ A @ A.T @ A) * np.trace(B.T @ B @ B.T @ B))
    assert np.isclose(found["rv"], rv)


def test_a_field_that_follows_shape_is_found_with_its_pattern(simulated):
    found = covariation(simulated, "thickness", covariates=["age", "group"], n_permutations=199)
    assert found["p_value"] == 0.005
    assert found["rv_p"] == 0.005
    assert abs(np.corrcoef(found["field_pattern"].values[0], HEIGHT)[0, 1]) > 0.9
    along = found["deformation"].values[0, :, 0]
    assert abs(np.corrcoef(along, X[:, 0])[0, 1]) > 0.9
    assert found["field_pattern"].attrs["units"] == "mm"
    # both follow the simulated score with the sign that it has
    both = (
        np.polyfit(HEIGHT, found["field_pattern"].values[0], 1)[0]
        * np.polyfit(X[:, 0], along, 1)[0]
    )
    assert both > 0
    moving = covariation_modes(simulated, found)
    assert np.allclose(moving["pca"]["deformation"], found["deformation"])
    with pytest.raises(ValueError, match="n_components must be an integer of at most"):
        covariation(simulated, "thickness", n_components=99)


def test_the_test_of_covariation_keeps_its_level_for_fields_of_noise():
    found = []
    for run in range(100):
        rng = np.random.default_rng([1, run])
        A, B, Z = (rng.normal(size=(15, c)) for c in (6, 4, 2))
        one = two_block(A, B, covariates=Z, n_permutations=39, seed=run)
        found.append([one["p"] <= 0.05, one["singular_p"][0] <= 0.05, one["rv_p"] <= 0.05])
    assert np.all(np.mean(found, axis=0) < 0.12)  # 0.05 and three standard errors


def test_the_command_writes_results_and_a_page(tmp_path, capsys, study_folder, no_pictures):
    folder = shutil.copytree(study_folder, tmp_path / "study")
    study, rng = open_study(folder), np.random.default_rng(0)
    meshes = study["original"].children.items()
    values = {name: rng.normal(size=mesh.sizes["vertex"]) for name, mesh in meshes}
    write_field(with_field(study, "noise", values), "noise", folder)
    assert cli.main(["covariation", str(folder), "noise", "--permutations", "19"]) == 0
    assert "noise against shape: first pair" in capsys.readouterr().out
    assert {"covariation.nc", "covariation.html"} <= {
        p.name for p in (folder / "statistics").iterdir()
    }
