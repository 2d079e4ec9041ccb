"""Shape differences and the median shape (3.5, 3.6, eq. 5)."""

import numpy as np
import xarray as xr

from s4a.method.pca import gram_pca
from s4a.schema import Array, dataset, require

# |(Lambda^0)^a (D - I) (Lambda^0)^-b|_F: the powers a and b of each reading of eq. 5's norm
NORMS = {
    "h2": (0.0, 1.0),
    "h1": (0.0, 0.5),
    "frobenius": (0.0, 0.0),
    "h2_image": (1.0, 0.0),
    "h2_both": (1.0, 1.0),
}


def area_differences(Y: Array) -> Array:
    """D_i = Y_i^T Y_i ``(n, m, m)``: how each shape's areas differ from the latent mean.

    After Huang et al. (2019); Y ``(n, k, m)`` are the consistent latent bases.
    """
    return np.einsum("nkl,nkm->nlm", Y, Y)


def conformal_differences(Y: Array, eigenvalues: Array, latent_eigenvalue: Array) -> Array:
    """(Lambda^0)^+ Y_i^T Lambda_i Y_i ``(n, m, m)``: how Dirichlet energies differ.

    Constant modes are zero.
    """
    D = np.einsum("nkl,nk,nkm->nlm", Y, eigenvalues[:, : Y.shape[1]], Y)
    constant = _constant_eigenfunctions(latent_eigenvalue)
    D[:, constant] = 0
    D[:, :, constant] = 0
    return inverse(latent_eigenvalue)[None, :, None] * D


def inverse(latent_eigenvalue: Array, power: float = 1.0) -> Array:
    """Diagonal ``(m,)`` of ((Lambda^0)^+)^power, whose powers may be negative.

    Constant modes map to 0.
    """
    constant = _constant_eigenfunctions(latent_eigenvalue)
    return np.where(constant, 0.0, np.where(constant, 1.0, latent_eigenvalue) ** -power)


def _constant_eigenfunctions(latent_eigenvalue):
    """Which latent functions are constant on every component, ``(m,)``: one for each component."""
    constant = latent_eigenvalue < 1e-6 * np.max(latent_eigenvalue, initial=0.0)
    constant[:1] = True
    return constant


def distance_to_identity(D: Array, latent_eigenvalue: Array, norm: str = "h2") -> Array:
    """E(M_i) = |D_i - I| of eq. 5 ``(n,)``.

    The paper writes the norm of H_0^2, in which |f| = |Lambda^0 f|, and does not say of what D - I
    is an operator.  ``"h2"`` is our reading: the Hilbert-Schmidt norm of D - I from H_0^2 to L^2,
    |(D - I) (Lambda^0)^+|_F, in which fine detail weighs less.  ``"h1"`` takes the square root of
    the inverse, ``"frobenius"`` none.  ``"h2_image"`` goes from L^2 to H_0^2, |Lambda^0 (D - I)|_F,
    in which fine detail weighs more, and ``"h2_both"`` from H_0^2 to itself,
    |Lambda^0 (D - I) (Lambda^0)^+|_F.  Constant modes, one for each component of the surface, are
    left out.
    """
    if norm not in NORMS:
        raise ValueError(f"norm must be one of {', '.join(NORMS)}, found {norm!r}")
    of_image, of_argument = NORMS[norm]
    weighted = (D - np.eye(D.shape[1])) * inverse(latent_eigenvalue, of_argument)  # (n, m, m)
    weighted = inverse(latent_eigenvalue, -of_image)[:, None] * weighted
    varying = ~_constant_eigenfunctions(latent_eigenvalue)
    return np.linalg.norm(weighted[:, varying][:, :, varying], axis=(1, 2))


def difference_pca(D: Array) -> tuple[Array, Array]:
    """PCA of vectorised operators ``(n, m, m)`` (3.6).

    Scores ``(n, n - 1)`` in the unit of the operators and shares of variance ``(n - 1,)``.
    """
    n, m = D.shape[:2]
    modes = gram_pca(D, np.ones(m))
    # gram_pca measures by the mean over the m rows, the operators' norm by their sum
    score = modes.score * modes.standard_deviation * np.sqrt(m)  # (n, c)
    empty = n - 1 - len(modes.ratio)  # components without variance
    return np.pad(score, ((0, 0), (0, empty))), np.pad(modes.ratio, (0, empty))


def median_shape(latent: xr.Dataset, eigenvalues: Array, *, norm: str = "h2") -> xr.Dataset:
    """Shape differences of a collection, its distances to the limit shape, and the median (eq. 5).

    Parameters
    ----------
    latent : xarray.Dataset
        With ``latent_basis(shape, eigenpair, latent)`` and ``latent_eigenvalue(latent)``.
    eigenvalues : float ndarray (shape, eigenpair)
        Laplacian eigenvalues of the shapes, for unit area.
    norm : {"h2", "h1", "frobenius", "h2_image", "h2_both"}
        See :func:`distance_to_identity`.

    Returns
    -------
    xarray.Dataset
        `latent` with ``area_difference``, ``conformal_difference``, ``distance_to_limit``, the PCA
        scores of both operators, and the attributes ``median`` (name of the shape) and ``norm``.
    """
    require(latent, "latent_basis", "latent_eigenvalue", what="latent dataset")
    Y, latent_eigenvalue = latent["latent_basis"].values, latent["latent_eigenvalue"].values
    area = area_differences(Y)
    conformal = conformal_differences(Y, np.asarray(eigenvalues, float), latent_eigenvalue)
    distance = distance_to_identity(area, latent_eigenvalue, norm)
    area_score, area_ratio = difference_pca(area)
    conformal_score, conformal_ratio = difference_pca(conformal)
    differences = dataset(
        area_difference=area,
        conformal_difference=conformal,
        distance_to_limit=distance,
        area_score=area_score,
        area_variance_ratio=area_ratio,
        conformal_score=conformal_score,
        conformal_variance_ratio=conformal_ratio,
    )
    median = str(latent["shape"].values[int(np.argmin(distance))])
    return latent.assign(differences.data_vars).assign_attrs(latent.attrs, median=median, norm=norm)


def near_ties(distance: Array, *, within: float = 0.05) -> list[int]:
    """Indices of the shapes at most the share `within` farther than the nearest, nearest first.

    More than one says that the median is a choice among near equals.

    Examples
    --------
    >>> from s4a.method.median import near_ties
    >>> near_ties([1.04, 1.0, 2.0])
    [1, 0]
    """
    distance = np.asarray(distance, float)
    order = np.argsort(distance, kind="stable")
    return [int(i) for i in order if distance[i] <= (1 + within) * distance[order[0]]]
