"""Shape differences and the median shape (3.5, 3.6, eq. 5)."""

import numpy as np

from s4a.schema import dataset, require

NORMS = {"h2": 1.0, "h1": 0.5, "frobenius": 0.0}


def area_differences(Y):
    """D_i = Y_i^T Y_i ``(n, m, m)``.

    How each shape's areas differ from the latent mean (Huang et al. 2019).
    """
    return np.einsum("nkl,nkm->nlm", Y, Y)


def conformal_differences(Y, eigenvalues, latent_eigenvalue):
    """(Lambda^0)^+ Y_i^T Lambda_i Y_i ``(n, m, m)``: how Dirichlet energies differ.

    Constant modes are zero.
    """
    D = np.einsum("nkl,nk,nkm->nlm", Y, eigenvalues[:, : Y.shape[1]], Y)
    null = constant_modes(latent_eigenvalue)
    D[:, null], D[:, :, null] = 0, 0
    return inverse(latent_eigenvalue)[None, :, None] * D


def inverse(latent_eigenvalue, power=1.0):
    """Diagonal of ((Lambda^0)^+)^power; constant modes map to 0."""
    null = constant_modes(latent_eigenvalue)
    return np.where(null, 0.0, np.where(null, 1.0, latent_eigenvalue) ** -power)


def constant_modes(latent_eigenvalue):
    """Which latent functions are constant on every component, ``(m,)``.

    One for each component that was kept.
    """
    null = latent_eigenvalue < 1e-6 * np.max(latent_eigenvalue, initial=0.0)
    null[:1] = True
    return null


def distance_to_identity(D, latent_eigenvalue, norm="h2"):
    """E(M_i) = |D_i - I| of eq. 5 ``(n,)``.

    The paper writes the norm of H_0^2 and does not define it.  ``"h2"`` is our reading: the
    Hilbert-Schmidt norm of D - I as an operator H^2 -> L^2, |(D - I) (Lambda^0)^+|_F, in which fine
    detail weighs less.  ``"h1"`` takes the square root of the inverse, ``"frobenius"`` none.
    Constant modes, one for each component of the surface, are left out.
    """
    if norm not in NORMS:
        raise ValueError(f"norm must be one of {', '.join(NORMS)}, found {norm!r}")
    m = D.shape[1]
    w = inverse(latent_eigenvalue, NORMS[norm])
    varying = ~constant_modes(latent_eigenvalue)
    return np.linalg.norm(((D - np.eye(m)) * w)[:, varying][:, :, varying], axis=(1, 2))


def difference_pca(D):
    """PCA of vectorised operators (3.6).

    Scores ``(n, c)`` in their own units and shares of variance ``(c,)``.
    """
    X = D.reshape(len(D), -1)
    U, S, _ = np.linalg.svd(X - X.mean(0), full_matrices=False)
    U, S = U[:, :-1], S[:-1]
    U = U * np.where((U**3).sum(0) < 0, -1.0, 1.0)
    total = (S**2).sum()
    return U * S, S**2 / (total if total > 0 else 1.0)


def median_shape(latent, eigenvalues, *, norm="h2"):
    """Shape differences of a collection, the distance of every shape to the limit shape.

    And the median (eq. 5).

    Parameters
    ----------
    latent : xarray.Dataset
        With ``latent_basis(shape, mode, latent)`` and ``latent_eigenvalue(latent)``.
    eigenvalues : float ndarray (shape, mode)
        Laplacian eigenvalues of the shapes, for unit area.
    norm : {"h2", "h1", "frobenius"}
        See :func:`distance_to_identity`.

    Returns
    -------
    xarray.Dataset
        `latent` with ``area_difference``, ``conformal_difference``, ``distance_to_median``, the PCA
        scores of both operators, and the attributes ``median`` (name of the shape) and ``norm``.
    """
    require(latent, "latent_basis", "latent_eigenvalue", what="latent dataset")
    Y, latent_eigenvalue = latent["latent_basis"].values, latent["latent_eigenvalue"].values
    area = area_differences(Y)
    conformal = conformal_differences(Y, np.asarray(eigenvalues, float), latent_eigenvalue)
    distance = distance_to_identity(area, latent_eigenvalue, norm)
    (area_score, area_ratio), (conformal_score, conformal_ratio) = (
        difference_pca(area),
        difference_pca(conformal),
    )
    found = dataset(
        area_difference=area,
        conformal_difference=conformal,
        distance_to_median=distance,
        area_score=area_score,
        area_variance_ratio=area_ratio,
        conformal_score=conformal_score,
        conformal_variance_ratio=conformal_ratio,
    )
    median = str(latent["shape"].values[int(np.argmin(distance))])
    return latent.assign(found.data_vars).assign_attrs(latent.attrs, median=median, norm=norm)


def near_ties(distance, *, within=0.05):
    """Indices of the shapes whose distance is at most the share `within` above the smallest.

    Nearest first.

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
