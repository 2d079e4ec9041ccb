"""Shape differences and the median shape (3.5, eq. 5): values computed by hand."""

import numpy as np
import pytest

from s4a.method import median
from s4a.schema import dataset

EIGENVALUES = np.array([0.0, 2.0, 4.0])


def three_shapes():
    """Y of the limit shape itself, of one with its second function doubled.

    And one a little turned.
    """
    turned = np.eye(3)
    turned[1:, 1:] = [[0.8, -0.6], [0.6, 0.8]]
    return np.stack([np.eye(3), np.diag([1.0, 2, 1]), turned])


def collection(Y):
    latent = dataset({"made": "by hand"}, latent_basis=Y, latent_eigenvalue=EIGENVALUES)
    return latent.assign_coords(shape=["same", "stretched", "turned"][: len(Y)])


def test_the_area_difference_is_the_gram_matrix_of_the_basis():
    D = median.area_differences(three_shapes())
    assert pytest.approx(np.stack([np.eye(3), np.diag([1, 4, 1]), np.eye(3)])) == D


@pytest.mark.parametrize(
    "norm, weight",
    [("frobenius", 1.0), ("h1", 2**-0.5), ("h2", 0.5), ("h2_image", 2.0), ("h2_both", 1.0)],
)
def test_the_distance_to_the_limit_shape_is_that_computed_by_hand(norm, weight):
    D = median.area_differences(three_shapes())
    # D - I = diag(0, 3, 0); h2 divides the column by its eigenvalue 2, h1 by its root
    assert median.distance_to_identity(D, EIGENVALUES, norm) == pytest.approx([0, 3 * weight, 0])


def test_a_norm_from_the_sobolev_space_or_into_it_tells_rows_from_columns():
    D = np.eye(3)
    D[1, 2] = D[2, 1] = 1.0  # D - I takes the function of 4 to that of 2, and back
    weighted = {"h2": [1 / 4, 1 / 2], "h2_image": [2, 4], "h2_both": [2 / 4, 4 / 2]}
    for norm, terms in weighted.items():
        found = median.distance_to_identity(D[None], EIGENVALUES, norm)
        assert found == pytest.approx(np.linalg.norm(terms))


@pytest.mark.parametrize("norm", median.NORMS)
def test_the_constant_mode_does_not_count(norm):
    D = np.diag([9.0, 1, 1])[None]
    assert median.distance_to_identity(D, EIGENVALUES, norm).tolist() == [0]


def test_an_unknown_norm_is_refused_with_those_there_are():
    with pytest.raises(
        ValueError, match="'h2', 'h1', 'frobenius', 'h2_image', 'h2_both'; found 'l2'"
    ):
        median.distance_to_identity(np.eye(3)[None], EIGENVALUES, "l2")


def test_the_conformal_difference_of_the_limit_shape_is_the_identity_but_for_the_constant():
    found = median.conformal_differences(three_shapes(), np.stack([EIGENVALUES] * 3), EIGENVALUES)
    assert found[0] == pytest.approx(np.diag([0, 1, 1]))
    assert found[1] == pytest.approx(np.diag([0, 4, 1]))
    rotation = np.array([[0.8, -0.6], [0.6, 0.8]])
    by_hand = np.diag([1 / 2, 1 / 4]) @ rotation.T @ np.diag([2, 4]) @ rotation
    assert found[2][1:, 1:] == pytest.approx(by_hand)


def test_the_median_is_the_nearest_and_a_stretched_shape_the_farthest():
    found = median.median_shape(collection(three_shapes()), np.stack([EIGENVALUES] * 3), norm="h1")
    assert found.attrs == {"made": "by hand", "median": "same", "norm": "h1"}
    assert found["distance_to_limit"].idxmax().item() == "stretched"
    assert found["latent_basis"].shape == (3, 3, 3)
    assert found["area_variance_ratio"].values[0] == pytest.approx(1)


def test_the_scores_of_differences_are_centred_and_keep_their_distances():
    D = np.random.default_rng(0).normal(size=(6, 4, 4))
    score, ratio, component = median.difference_pca(D)
    assert score.shape == (6, 5)
    assert score.mean(0) == pytest.approx(np.zeros(5), abs=1e-12)
    assert np.linalg.norm(score[0] - score[1]) == pytest.approx(np.linalg.norm(D[0] - D[1]))
    assert np.einsum("nc,cij->nij", score, component) == pytest.approx(D - D.mean(0), abs=1e-5)
    assert np.linalg.norm(component, axis=(1, 2)) == pytest.approx(np.ones(5))
    assert ratio.sum() == pytest.approx(1)
    assert (np.diff(ratio) < 0).all()
    assert ((score**3).sum(0) >= 0).all()


def test_equal_differences_have_no_variance():
    score, ratio, component = median.difference_pca(np.stack([np.eye(3)] * 4))
    assert np.abs(score).max() == np.abs(component).max() == 0
    assert ratio.tolist() == [0, 0, 0]


def test_surfaces_of_two_components_have_two_constant_modes():
    latent_eigenvalue = np.array([1e-28, 7.5e-14, 36.3, 40.0])
    D = np.stack([np.diag([1.0, 3.0, 1.0, 1.0]), np.diag([1.0, 1.0, 2.0, 1.0])])
    for norm in median.NORMS:
        near, far = median.distance_to_identity(D, latent_eigenvalue, norm)
        assert near == 0
        assert 0 < far < 50
