"""Shape differences and the median shape (3.5, 3.6, eq. 5)."""

import numpy as np
import xarray as xr

from s4a.method.pca import gram_pca
from s4a.schema import Array, check_choice, dataset, require

# |(Lambda^0)^a (D - I) (Lambda^0)^-b|_F: powers a and b of each interpretation of the norm of eq. 5
NORMS = {
    "h2": (0.0, 1.0),
    "h1": (0.0, 0.5),
    "frobenius": (0.0, 0.0),
    "h2_image": (1.0, 0.0),
    "h2_both": (1.0, 1.0),
}


def area_differences(Y: Array) -> Array:
    """Return the area-based shape differences D_i = Y_i^T Y_i ``(n, m, m)`` from the latent mean.

    Y ``(n, k, m)`` are the consistent latent bases.

    See Also
    --------
    conformal_differences : Conformal shape differences.

    References
    ----------
    R. Rustamov et al. (2013), Map-based exploration of intrinsic shape differences and variability,
    ACM Transactions on Graphics 32(4).
    R. Huang et al. (2019), Limit shapes: a tool for understanding shape differences and variability
    in 3D model collections, Computer Graphics Forum 38(5).
    """
    return np.einsum("nkl,nkm->nlm", Y, Y)


def conformal_differences(Y: Array, eigenvalues: Array, latent_eigenvalue: Array) -> Array:
    """Return the conformal shape differences (Lambda^0)^+ Y_i^T Lambda_i Y_i ``(n, m, m)``.

    They compare Dirichlet energies.  Rows and columns of constant functions are zero.

    See Also
    --------
    area_differences : Area-based shape differences, with references.
    """
    D = np.einsum("nkl,nk,nkm->nlm", Y, eigenvalues[:, : Y.shape[1]], Y)
    constant = _constant_eigenfunctions(latent_eigenvalue)
    D[:, constant] = 0
    D[:, :, constant] = 0
    return inverse(latent_eigenvalue)[None, :, None] * D


def inverse(latent_eigenvalue: Array, power: float = 1.0) -> Array:
    """Return the diagonal ``(m,)`` of ((Lambda^0)^+)^power, 0 for constant functions."""
    constant = _constant_eigenfunctions(latent_eigenvalue)
    return np.where(constant, 0.0, np.where(constant, 1.0, latent_eigenvalue) ** -power)


def _constant_eigenfunctions(latent_eigenvalue):
    """Mask of the latent functions that are constant on every component ``(m,)``."""
    constant = latent_eigenvalue < 1e-6 * np.max(latent_eigenvalue, initial=0.0)
    constant[:1] = True
    return constant


def distance_to_identity(D: Array, latent_eigenvalue: Array, norm: str = "h2") -> Array:
    """Return the distances to the limit shape, E(M_i) = |D_i - I| of eq. 5 ``(n,)``.

    The paper writes the norm of H_0^2, in which |f| = |Lambda^0 f|, but not the spaces between
    which D - I maps.  ``"h2"``, S4A's interpretation, is the Hilbert-Schmidt norm from H_0^2 to
    L^2, |(D - I) (Lambda^0)^+|_F, with less weight on fine detail.  ``"h1"`` takes the square root
    of the inverse, ``"frobenius"`` none.  ``"h2_image"`` is the norm from L^2 to H_0^2,
    |Lambda^0 (D - I)|_F, with more weight on fine detail, and ``"h2_both"`` that from H_0^2 to
    itself, |Lambda^0 (D - I) (Lambda^0)^+|_F.  Constant functions, one per component of the
    surface, are excluded.
    """
    check_choice("norm", norm, NORMS)
    power_image, power_argument = NORMS[norm]
    weighted = (D - np.eye(D.shape[1])) * inverse(latent_eigenvalue, power_argument)  # (n, m, m)
    weighted = inverse(latent_eigenvalue, -power_image)[:, None] * weighted
    varying = ~_constant_eigenfunctions(latent_eigenvalue)
    return np.linalg.norm(weighted[:, varying][:, :, varying], axis=(1, 2))


def difference_pca(D: Array) -> tuple[Array, Array, Array]:
    """PCA of vectorised operators ``(n, m, m)`` (3.6).

    Returns
    -------
    score : float ndarray (n, n - 1)
        In the unit of the operators: D_i is their mean plus the sum of score_ic component_c.
    ratio : float ndarray (n - 1,)
        Shares of the variance.
    component : float32 ndarray (n - 1, m, m)
        Of norm 1, or 0 without variance.
    """
    n, m = D.shape[:2]
    modes = gram_pca(D, np.ones(m))
    # gram_pca averages over the m rows, the norm of operators sums over them
    unit = modes.standard_deviation * np.sqrt(m)  # (c,)
    component = (modes.deformation / unit[:, None, None]).astype(np.float32)
    n_empty = n - 1 - len(modes.ratio)  # components without variance
    return (
        np.pad(modes.score * modes.standard_deviation * np.sqrt(m), ((0, 0), (0, n_empty))),
        np.pad(modes.ratio, (0, n_empty)),
        np.pad(component, ((0, n_empty), (0, 0), (0, 0))),
    )


def median_shape(latent: xr.Dataset, eigenvalues: Array, *, norm: str = "h2") -> xr.Dataset:
    """Compute shape differences, distances to the limit shape, and the median shape (eq. 5).

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
        `latent` with ``area_difference``, ``conformal_difference``, ``distance_to_limit``,
        ``distance_by_norm``, scores and components of the PCA of both operators, and the attributes
        ``median`` (name of the shape) and ``norm``.

    See Also
    --------
    s4a.refine_network : Computes the latent bases and calls this function.
    """
    require(latent, "latent_basis", "latent_eigenvalue", what="latent dataset")
    Y, latent_eigenvalue = latent["latent_basis"].values, latent["latent_eigenvalue"].values
    area = area_differences(Y)
    conformal = conformal_differences(Y, np.asarray(eigenvalues, float), latent_eigenvalue)
    distances = {name: distance_to_identity(area, latent_eigenvalue, name) for name in NORMS}
    distance = distances[norm]
    area_score, area_ratio, area_component = difference_pca(area)
    conformal_score, conformal_ratio, conformal_component = difference_pca(conformal)
    differences = dataset(
        area_difference=area,
        conformal_difference=conformal,
        distance_to_limit=distance,
        distance_by_norm=np.stack(list(distances.values())),
        area_score=area_score,
        area_variance_ratio=area_ratio,
        area_component=area_component,
        conformal_score=conformal_score,
        conformal_variance_ratio=conformal_ratio,
        conformal_component=conformal_component,
    ).assign_coords(norm=list(NORMS))
    median = str(latent["shape"].values[int(np.argmin(distance))])
    return latent.assign(differences.variables).assign_attrs(latent.attrs, median=median, norm=norm)


def near_ties(distance: Array, *, within: float = 0.05) -> list[int]:
    """Return the indices of shapes within a factor 1 + `within` of the least distance, ascending.

    If there are several, the choice of the median is ambiguous.

    Examples
    --------
    >>> from s4a.method.median import near_ties
    >>> near_ties([1.04, 1.0, 2.0])
    [1, 0]
    """
    distance = np.asarray(distance, float)
    order = np.argsort(distance, kind="stable")
    return [int(i) for i in order if distance[i] <= (1 + within) * distance[order[0]]]
