"""Fields against shape (6.1): two-block partial least squares with permutation.

With A the displacements and B the fields of s shapes, both less their means and weighted by the
root of the vertex areas, the singular vectors of the cross-covariance A^T B / (s - 1) are pairs of
a deformation and a pattern of the field that vary together (Rohlf and Corti 2000).  What each says
is the covariance of a pair (its singular value), their correlation (r-PLS), and the RV coefficient
of both blocks, |A^T B|^2 / (|A^T A| |B^T B|) (Escoufier 1973).  p values come of permuted shapes.
"""

import math

import numpy as np
import xarray as xr

from s4a.analysis.effects import modes_study
from s4a.analysis.inputs import Values, registration_of
from s4a.analysis.permutation import check_permutations, design, p_values
from s4a.method.pca import gram, principal_components
from s4a.schema import FIELD_UNIT, dataset, in_unit, unit_of
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
    """Two-block partial least squares of coordinates ``(s, p)`` and ``(s, q)``.

    Parameters
    ----------
    A, B : float ndarray
    covariates : float ndarray (s, c), optional
        Taken from both blocks; the residuals of B are permuted, and freed of the covariates again
        (Freedman and Lane 1983).
    n_permutations, seed : int

    Returns
    -------
    dict of str to ndarray
        ``U (p, k)``, ``V (q, k)`` and ``singular (k,)`` of A^T B / (s - 1), both less what the
        covariates explain; ``r (k,)``, the correlations of the scores; ``rv``; ``p`` of the first
        correlation (r-PLS), ``singular_p (k,)`` and ``rv_p``.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.two_block import two_block
    >>> rng = np.random.default_rng(0)
    >>> A, B = rng.normal(size=(2, 30, 4))
    >>> B[:, 2] += 3 * A[:, 0]
    >>> found = two_block(A, B, n_permutations=99)
    >>> float(found["p"]), bool(found["r"][0] > 0.9)
    (0.01, True)
    """
    n = len(A)
    Z = basis_of(covariates, n)
    A, B = (free(np.asarray(M, float), Z) for M in (A, B))
    size = np.linalg.norm(A.T @ A)
    U, singular, Vt = np.linalg.svd(A.T @ B / (n - 1), full_matrices=False)
    scores = A @ U, B @ Vt.T
    r = _correlation(*scores)

    def measures(permuted):
        """First correlation, RV, and singular values over the size of B, of blocks (b, s, q)."""
        permuted = free(permuted, Z)
        Ub, S, Vb = np.linalg.svd(A.T @ permuted, full_matrices=False)
        length = np.sqrt((permuted**2).sum((1, 2)))
        K = permuted @ permuted.swapaxes(1, 2)  # (b, s, s)
        rv = (S**2).sum(1) / (size * np.sqrt((K**2).sum((1, 2))))
        one = np.einsum("sp,bp->bs", A, Ub[:, :, 0])
        other = np.einsum("bsq,bq->bs", permuted, Vb[:, 0])
        return np.column_stack([_correlation(one, other, axis=1), rv, S / length[:, None]])

    own = measures(B[None])[0]
    rng = np.random.default_rng(seed)
    orders = (rng.permutation(n) for _ in range(n_permutations))
    at_once = max(1, 2_000_000 // (n * n + A.size + B.size))
    (p, rv_p, *singular_p), _ = p_values(
        orders,
        n_permutations,
        lambda batch: measures(np.stack([B[order] for order in batch])),
        own * (1 - 1e-9),
        at_once,
    )
    return {
        "U": U, "V": Vt.T, "singular": singular, "r": r, "rv": own[1],
        "p": p, "singular_p": np.array(singular_p), "rv_p": rv_p,
    }  # fmt: skip


def _correlation(a, b, axis=0):
    """Of samples along an axis, which have mean zero."""
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
    """Does a field vary together with shape?  Two-block partial least squares.

    Parameters
    ----------
    study : DataTree
    field : str
        Name in ``/fields``, see :func:`s4a_morphometrics.with_field`.
    covariates : see :func:`s4a.statistics.group_test`
        Taken from shape and field.
    n_components : int, optional
        Pairs that are given; at most 10 by default.
    n_permutations : int
        Of the shapes.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        ``deformation(component, vertex, xyz)`` and ``field_pattern(component, vertex)`` of one
        standard deviation of the scores, ``score(shape, component)`` and ``field_score``, freed of
        the covariates as what is tested is;
        ``singular_value(component)``, its share ``covariance_share`` of all squared covariance, and
        ``singular_p``; ``pair_correlation(component)``; ``statistic``, the first of these (r-PLS),
        and its ``p_value``; ``rv`` and ``rv_p``.

    Raises
    ------
    ValueError
        When the study has no such field, it does not differ, or n_components is out of range.

    Notes
    -----
    The axes of a pair are chosen for their covariance, so that r-PLS is far from 0 by chance in
    small samples: only its p value says something.  The p of a later pair is of its singular value
    alone, whatever those before it are.

    Examples
    --------
    With the ``study`` of six small brains; the height of their vertices is of their shape:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height, unit="mm")
    >>> found = s4a_morphometrics.covariation(study, "height", n_permutations=99)
    >>> bool(0 < found["rv"] < 1), found["field_pattern"].dims
    (True, ('component', 'vertex'))
    """
    seed = seed_of(seed, rng)
    check_permutations(n_permutations)
    anything = np.zeros(registration_of(study).sizes["shape"])
    blocks = field_sample(study, field, anything, "", covariates)
    of_field = blocks.sample
    A, B = coordinates(blocks.shape, blocks.shape_area), coordinates(of_field.d, of_field.area)
    found = two_block(A, B, covariates=of_field.Z, n_permutations=n_permutations, seed=seed)
    most = len(found["singular"])
    c = min(most, 10) if n_components is None else n_components
    if not 1 <= c <= most:
        raise ValueError(f"n_components needs a number from 1 to {most}, found {c}")
    n = len(A)
    Z = basis_of(of_field.Z, n)
    scores, deviations, axes = [], [], []
    for d, M, axis in ((blocks.shape, A, found["U"]), (of_field.d, B, found["V"])):
        M = free(M, Z)
        score = M @ axis[:, :c]
        deviation = score.std(axis=0, ddof=1)
        deviation[deviation == 0] = 1
        around = free(d.reshape(n, -1).astype(float), Z).reshape(d.shape)
        # an axis in coordinates is sum_s of the shapes: M^T (M M^T)^-1 brings it back to them
        weight = np.linalg.pinv(M).T @ axis[:, :c]  # (s, c)
        axes.append(np.einsum("sc,snk->cnk", weight * deviation, around, optimize=True))
        scores.append(score / deviation)
        deviations.append(deviation)
    pattern = blocks.whole(axes[1][..., 0])
    squared = found["singular"] ** 2
    result = dataset(
        deformation=axes[0].astype(np.float32),
        field_pattern=pattern,
        standard_deviation=deviations[0],
        score=scores[0],
        field_score=scores[1],
        singular_value=found["singular"][:c],
        covariance_share=squared[:c] / squared.sum(),
        singular_p=found["singular_p"][:c],
        pair_correlation=found["r"][:c],
        statistic=found["r"][0],
        p_value=found["p"],
        rv=found["rv"],
        rv_p=found["rv_p"],
    )
    result = in_unit(result, unit_of(of_field.registration["displacement"]))
    result = in_unit(result, of_field.unit, of=FIELD_UNIT)
    return result.assign_coords(shape=of_field.registration["shape"].values).assign_attrs(
        field=field,
        permutations=n_permutations,
        smallest_p=max(1 / (n_permutations + 1), 1 / math.factorial(n)),
        **of_field.attributes,
    )


def basis_of(covariates: np.ndarray | None, n: int) -> np.ndarray:
    """An orthonormal basis ``(n, r)`` of the constant and the covariates."""
    if covariates is None:
        return np.full((n, 1), 1 / np.sqrt(n))
    return design(np.random.default_rng(0).normal(size=n), covariates)[0]  # of Z alone


def free(M: np.ndarray, Z: np.ndarray) -> np.ndarray:
    """What an orthonormal basis Z ``(n, r)`` does not explain of M ``(..., n, c)``."""
    return np.asarray(M - Z @ (Z.T @ M))


def coordinates(d: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Isometric coordinates ``(s, c)`` of fields ``(s, n, k)`` under the areas, less their mean."""
    variance, V = principal_components(gram(d - d.mean(0), area))
    return V * np.sqrt(variance * (len(d) - 1))


def covariation_modes(study: xr.DataTree, found: xr.Dataset) -> xr.DataTree:
    """The pairs of a :func:`covariation` in the form of a study, for everything that shows modes.

    Parameters
    ----------
    study : DataTree
    found : Dataset
        Of :func:`covariation`.

    Returns
    -------
    DataTree
        ``/registration`` and ``/coarse`` of the study, and ``/pca`` with a component for each pair:
        its deformation, and ``explained_variance_ratio`` the share of the squared covariance.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height)
    >>> found = s4a_morphometrics.covariation(study, "height", n_permutations=99)
    >>> moving = s4a_morphometrics.covariation_modes(study, found)
    >>> moving["pca"].sizes["component"] == found.sizes["component"]
    True
    """
    return modes_study(
        study,
        found["shape"],
        name=f"shape with {found.attrs['field']}",
        deformation=found["deformation"].values,
        standard_deviation=found["standard_deviation"].values,
        score=found["score"].values,
        explained_variance_ratio=found["covariance_share"].values,
    )
