"""A study of the preset of the paper equals that of an independent implementation."""

import numpy as np
import pytest
from small import OPTIONS

import s4a

independent = pytest.importorskip("independent", reason="needs pyFM")
K_INIT, K = OPTIONS["k_init"], OPTIONS["k"]


@pytest.fixture(scope="module")
def both(meshes):
    """The network, latent space, registration and modes of a study; the same, independently."""
    small = {name: mesh.isel() for name, mesh in meshes.items()}
    study = s4a.analyse(small, preset="paper", **OPTIONS | {"n_coarse": 300})
    return study, independent.paper(study, K_INIT, K)


def edges(study):
    """Indices of source and target of each map."""
    names = study["latent"]["shape"].values.tolist()
    ends = (study["network"][end].values for end in ("source", "target"))
    return [(names.index(i), names.index(j)) for i, j in zip(*ends, strict=True)]


def test_spectra_and_their_distances(both):
    study, found = both
    for shape, coarse in zip(found["shapes"], study["coarse"].children.values(), strict=True):
        assert coarse["eigenvalue"].values == pytest.approx(shape.eigenvalue, rel=1e-6, abs=1e-6)
        assert coarse["eigenfunction"].values == pytest.approx(shape.Phi, abs=1e-5)
    distance = study["network"]["spectral_distance"].values
    assert distance == pytest.approx(found["spectral_distance"], abs=1e-6)


def test_transforms_landmarks_and_initial_maps(both):
    study, found = both
    network = study["network"]
    for p, edge in enumerate(edges(study)):
        R, t = found["transforms"][edge]
        assert network["pair_rotation"].values[p] == pytest.approx(R, abs=1e-6)
        assert network["pair_translation"].values[p] == pytest.approx(t, abs=1e-6)
        ends = (network[f"landmark_of_{end}"].values[p] for end in ("source", "target"))
        assert np.array_equal(list(ends), found["landmarks"][edge])
        assert network["fmap_fitted"].values[p] == pytest.approx(found["fitted"][edge], abs=1e-5)
        assert network["fmap_initial"].values[p] == pytest.approx(found["initial"][edge], abs=1e-5)


def test_refined_maps_latent_bases_energies_and_median(both):
    study, found = both
    C = np.array([found["maps"][edge] for edge in edges(study)])
    difference = np.abs(study["network"]["fmap"].values - C)  # a vertex may match another one
    assert difference.max() < 0.02
    assert difference.mean() < 5e-4
    latent = study["latent"]
    assert latent["latent_eigenvalue"].values[1:] == pytest.approx(
        found["latent_eigenvalue"][1:], rel=1e-3
    )
    assert latent["latent_basis"].values == pytest.approx(found["latent"], abs=5e-3)
    assert latent["distance_to_limit"].values == pytest.approx(found["energy"], rel=2e-2)
    assert latent.attrs["median"] == found["median"]


def test_matches_displacements_and_modes(both):
    study, found = both
    registration, modes = study["registration"], study["pca"]
    for variable, name in (("registered_match_low", "low"), ("registered_match", "match")):
        assert (registration[variable].values == np.array(found[name])).mean() > 0.99
    same = registration["registered_match"].values == np.array(found["match"])
    raw, smooth = (np.array(found[name]) for name in ("raw", "smooth"))
    assert registration["displacement_raw"].values[same] == pytest.approx(raw[same], abs=1e-3)
    size = np.abs(smooth).max()
    assert np.abs(registration["displacement"].values - smooth).max() < 0.02 * size
    assert modes["standard_deviation"].values == pytest.approx(found["sd"], rel=1e-2)
    deformation = modes["deformation"].values * found["root"][:, None]
    deformation = deformation.reshape(len(deformation), -1)
    deformation /= np.linalg.norm(deformation, axis=1, keepdims=True)
    assert np.abs((deformation * found["modes"]).sum(1)) == pytest.approx(np.ones(3), abs=1e-3)
