"""Covariation of fields and shape (6.1): two-block partial least squares with permutation tests.

Let A be the displacements and B the fields of s shapes, both centred and weighted by the root of
the vertex areas.  The singular vectors of the cross-covariance A^T B / (s - 1) are pairs of a
deformation and a pattern of the field that covary (Rohlf and Corti 2000).  Measures are the
covariance of a pair (its singular value), its correlation (r-PLS), and the RV coefficient of both
blocks, |A^T B|^2 / (|A^T A| |B^T B|) (Escoufier 1973).  For p values, shapes are permuted.
"""

import math

import numpy as np
import xarray as xr

from s4a.analysis.inputs import Values, registration_of
from s4a.analysis.permutation import check_permutations, design, p_values
from s4a.analysis.statistics import modes_study
from s4a.method.pca import gram, principal_components
from s4a.schema import FIELD_UNIT, check_count, dataset, in_unit, unit_of
from s4a.seeds import RNG, seed_of
from s4a_morphometrics.fields import field_sample


def two_block(
    A: np.ndarray,
    B: np.ndarray,
    *,
    covariates: np.ndarray | None = None,
    n_permutations: int = 999,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Compute two-block partial least squares of coordinates ``(s, p)`` and ``(s, q)``.

    Parameters
    ----------
    A, B : float ndarray
    covariates : float ndarray (s, c), optional
        Regressed out of both blocks; the residuals of B are permuted, and the covariates are
        regressed out again (Freedman and Lane 1983).
    n_permutations, seed : int

    Returns
    -------
    dict of str to ndarray
        ``U (p, k)``, ``V (q, k)`` and ``singular (k,)`` of A^T B / (s - 1), both without the
        covariates; ``r (k,)``, the correlations of the scores; ``rv``; ``p`` of the first
        correlation (r-PLS), ``singular_p (k,)`` and ``rv_p``.

    References
    ----------
    F. J. Rohlf and M. Corti (2000), Use of two-block partial least-squares to study covariation in
    shape, Systematic Biology 49(4).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.two_block import two_block
    >>> rng = np.random.default_rng(0)
    >>> A, B = rng.normal(size=(2, 30, 4))
    >>> B[:, 2] += 3 * A[:, 0]
    >>> pls = two_block(A, B, n_permutations=99)
    >>> float(pls["p"]), bool(pls["r"][0] > 0.9)
    (0.01, True)
    """
    n = len(A)
    Z = basis_of(covariates, n)
    A, B = (residuals(np.asarray(M, float), Z) for M in (A, B))
    size = np.linalg.norm(A.T @ A)
    U, singular, Vt = np.linalg.svd(A.T @ B / (n - 1), full_matrices=False)
    scores = A @ U, B @ Vt.T
    r = _correlation(*scores)

    def measures(permuted):
        """First correlation, RV, and singular values over the norm of B, for blocks (b, s, q)."""
        permuted = residuals(permuted, Z)
        Ub, S, Vb = np.linalg.svd(A.T @ permuted, full_matrices=False)
        length = np.sqrt((permuted**2).sum((1, 2)))
        K = permuted @ permuted.swapaxes(1, 2)  # (b, s, s)
        rv = (S**2).sum(1) / (size * np.sqrt((K**2).sum((1, 2))))
        score_a = np.einsum("sp,bp->bs", A, Ub[:, :, 0])
        score_b = np.einsum("bsq,bq->bs", permuted, Vb[:, 0])
        return np.column_stack([_correlation(score_a, score_b, axis=1), rv, S / length[:, None]])

    observed = measures(B[None])[0]
    rng = np.random.default_rng(seed)
    orders = (rng.permutation(n) for _ in range(n_permutations))
    batch_size = max(1, 2_000_000 // (n * n + A.size + B.size))
    (p, rv_p, *singular_p), _ = p_values(
        orders,
        n_permutations,
        lambda batch: measures(np.stack([B[order] for order in batch])),
        observed * (1 - 1e-9),
        batch_size,
    )
    return {
        "U": U, "V": Vt.T, "singular": singular, "r": r, "rv": observed[1],
        "p": p, "singular_p": np.array(singular_p), "rv_p": rv_p,
    }  # fmt: skip


def _correlation(a, b, axis=0):
    """Return the correlation of samples of mean zero along an axis."""
    size = np.sqrt((a**2).sum(axis) * (b**2).sum(axis))
    return (a * b).sum(axis) / np.where(size > 0, size, 1)


def covariation(
    study: xr.DataTree,
    field: str,
    *,
    covariates: Values | None = None,
    n_components: int | None = None,
    n_permutations: int = 999,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Analyse the covariation of a field with shape by two-block partial least squares.

    Parameters
    ----------
    study : DataTree
    field : str
        Name in ``/fields``, see :func:`s4a_morphometrics.with_field`.
    covariates : see :func:`s4a.statistics.group_test`
        Regressed out of shape and field.
    n_components : int, optional
        Number of pairs; at most 10 by default.
    n_permutations : int
        Permutations of the shapes.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        ``deformation(component, vertex, xyz)`` and ``field_pattern(component, vertex)`` of one
        standard deviation of the scores, ``score(shape, component)`` and ``field_score``, all
        without the covariates;
        ``singular_value(component)``, its share ``covariance_share`` of the squared covariance, and
        ``singular_p``; ``pair_correlation(component)``; ``statistic``, the correlation of the first
        pair (r-PLS), and its ``p_value``; ``rv`` and ``rv_p``.

    Raises
    ------
    ValueError
        If the study has no such field, the field does not vary, or n_components is out of range.

    See Also
    --------
    covariation_modes : the pairs as modes of variation.
    s4a_morphometrics.with_field : adds a field to a study.

    Notes
    -----
    The axes of a pair maximise covariance, so r-PLS is far from 0 by chance in small samples.  Only
    its p value can be interpreted.  The p value of a later pair tests its singular value alone.

    References
    ----------
    F. J. Rohlf and M. Corti (2000), Use of two-block partial least-squares to study covariation in
    shape, Systematic Biology 49(4).  Y. Escoufier (1973), Le traitement des variables
    vectorielles, Biometrics 29(4).

    Examples
    --------
    With the ``study`` of six small brains; the field is the height of their vertices:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height, unit="mm")
    >>> result = s4a_morphometrics.covariation(study, "height", n_permutations=99)
    >>> bool(0 < result["rv"] < 1), result["field_pattern"].dims
    (True, ('component', 'vertex'))
    """
    seed = seed_of(seed, rng)
    check_permutations(n_permutations)
    no_values = np.zeros(registration_of(study).sizes["shape"])
    blocks = field_sample(study, field, no_values, "", covariates)
    sample = blocks.sample
    A, B = coordinates(blocks.shape, blocks.shape_area), coordinates(sample.d, sample.area)
    pls = two_block(A, B, covariates=sample.Z, n_permutations=n_permutations, seed=seed)
    most = len(pls["singular"])
    c = min(most, 10) if n_components is None else n_components
    check_count("n_components", c, 1, most)
    n = len(A)
    Z = basis_of(sample.Z, n)
    scores, deviations, axes = [], [], []
    for d, M, axis in ((blocks.shape, A, pls["U"]), (sample.d, B, pls["V"])):
        M = residuals(M, Z)
        score = M @ axis[:, :c]
        deviation = score.std(axis=0, ddof=1)
        deviation[deviation == 0] = 1
        around = residuals(d.reshape(n, -1).astype(float), Z).reshape(d.shape)
        # an axis is a combination of the shapes; M^T (M M^T)^-1 gives its coefficients
        weight = np.linalg.pinv(M).T @ axis[:, :c]  # (s, c)
        axes.append(np.einsum("sc,snk->cnk", weight * deviation, around, optimize=True))
        scores.append(score / deviation)
        deviations.append(deviation)
    pattern = blocks.whole(axes[1][..., 0])
    squared = pls["singular"] ** 2
    result = dataset(
        deformation=axes[0].astype(np.float32),
        field_pattern=pattern,
        standard_deviation=deviations[0],
        score=scores[0],
        field_score=scores[1],
        singular_value=pls["singular"][:c],
        covariance_share=squared[:c] / squared.sum(),
        singular_p=pls["singular_p"][:c],
        pair_correlation=pls["r"][:c],
        statistic=pls["r"][0],
        p_value=pls["p"],
        rv=pls["rv"],
        rv_p=pls["rv_p"],
    )
    result = in_unit(result, unit_of(sample.registration["displacement"]))
    result = in_unit(result, sample.unit, of=FIELD_UNIT)
    return result.assign_coords(shape=sample.registration["shape"].values).assign_attrs(
        field=field,
        permutations=n_permutations,
        smallest_p=max(1 / (n_permutations + 1), 1 / math.factorial(n)),
        **sample.attributes,
    )


def basis_of(covariates: np.ndarray | None, n: int) -> np.ndarray:
    """Return an orthonormal basis ``(n, r)`` of the constant and the covariates."""
    if covariates is None:
        return np.full((n, 1), 1 / np.sqrt(n))
    return design(np.random.default_rng(0).normal(size=n), covariates)[0]  # of Z alone


def residuals(M: np.ndarray, Z: np.ndarray) -> np.ndarray:
    """Subtract the projection of M ``(..., n, c)`` on an orthonormal basis Z ``(n, r)``."""
    return np.asarray(M - Z @ (Z.T @ M))


def coordinates(d: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Return centred isometric coordinates ``(s, c)`` of fields ``(s, n, k)`` under the areas."""
    variance, V = principal_components(gram(d - d.mean(0), area))
    return V * np.sqrt(variance * (len(d) - 1))


def covariation_modes(study: xr.DataTree, result: xr.Dataset) -> xr.DataTree:
    """Return the pairs of :func:`covariation` as a study, to show them as modes of variation.

    Parameters
    ----------
    study : DataTree
    result : Dataset
        From :func:`covariation`.

    Returns
    -------
    DataTree
        ``/registration`` and ``/coarse`` of the study, and ``/pca`` with a component for each pair:
        its deformation, and as ``explained_variance_ratio`` the share of the squared covariance.

    See Also
    --------
    s4a.explore, s4a.write_page : show the modes.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height)
    >>> result = s4a_morphometrics.covariation(study, "height", n_permutations=99)
    >>> modes = s4a_morphometrics.covariation_modes(study, result)
    >>> modes["pca"].sizes["component"] == result.sizes["component"]
    True
    """
    return modes_study(
        study,
        result["shape"],
        name=f"shape with {result.attrs['field']}",
        deformation=result["deformation"].values,
        standard_deviation=result["standard_deviation"].values,
        score=result["score"].values,
        explained_variance_ratio=result["covariance_share"].values,
    )
