"""Posterior shape model (6.1): distribution of a shape of which a part is known.

A shape is the mean, plus modes with normal scores, plus a smooth field of the template's first
eigenfunctions for variation that the modes of few shapes lack.  The variances of the smooth field
are those of the errors of each shape when all others describe it.  All terms are normal, so the
posterior given a partial shape is normal, too (Albrecht, Luethi, Gerig and Vetter, Medical Image
Analysis 2013; modes with a smooth field: Luethi, Gerig, Jud and Vetter, TPAMI 2018).  With columns
E of modes, eigenfunctions and small transforms, and y the known vertices minus their mean,

    H = E^T W E + P,   w = H^-1 E^T W y,   cov(w) = H^-1,

where W weights the known vertices by area and P is the prior precision, 0 for transforms, as the
pose is unknown.  The number of independent points is chosen by leave-one-out: it minimises the
errors of the study's shapes when the others complete them from the same part.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from s4a.method.spectral import factor
from s4a.schema import Array

DENSITY = (0.25, 1.0, 4.0, 16.0)  # independent points on the whole template, per eigenfunction
WITHIN_90 = 1.6449  # standard deviations
N_TESTED = 400  # vertices at which errors of left-out shapes are computed


class Known(NamedTuple):
    """Prior of the shapes, and the known vertices of one shape.

    ``columns (q, n, 3)``: the s centred fields of the study, 3 K smooth fields, transforms;
    ``n_fields`` and ``n_smooth``, their numbers; ``area (n,)``, sums to 1; ``present (n,)``, the
    known vertices; ``gram (q, q)`` of the columns there; ``variance (3 K,)`` of the smooth fields;
    ``rest``, the variance of each coordinate that no column explains.
    """

    columns: Array
    n_fields: int
    n_smooth: int
    area: Array
    present: Array
    gram: Array
    variance: Array
    rest: float


class Posterior(NamedTuple):
    """Normal weights of columns: ``mean (p,)``, and ``root (p, p)`` with covariance root root^T."""

    mean: Array
    root: Array


def residual_weights(K: Array) -> Array:
    """Return weights of all fields that give the residual of each field from the others.

    Row i gives field i minus the nearest field in the affine hull of the others: with the
    pseudo-inverse P of the centred Gram matrix, P_ij / P_ii.

    Parameters
    ----------
    K : float ndarray (s, s)
        Gram matrix of the centred fields.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.posterior import residual_weights
    >>> x = np.array([[0.0, 0], [2, 0], [1, 3]])
    >>> residual_weights((x - x.mean(0)) @ (x - x.mean(0)).T)[2].round(6).tolist()
    [-0.5, -0.5, 1.0]
    """
    P = np.linalg.pinv(K, rcond=1e-10, hermitian=True)
    return P / np.diag(P)[:, None]


def smooth_variance(coefficient: Array) -> Array:
    """Return variances ``(K,)`` of coefficients ``(s, K, 3)``, smoothed over the frequency."""
    variance = (coefficient**2).mean((0, 2))  # (K,)
    total = np.concatenate([[0], np.cumsum(variance)])
    k = np.arange(len(variance))
    first, end = np.maximum(k - k // 4, 0), np.minimum(k + k // 4 + 1, len(k))
    return (total[end] - total[first]) / (end - first)


def transforms(X: Array, center: Array, *, scale: bool = False) -> Array:
    """Return infinitesimal rotations, translations and scaling of points: ``(6 or 7, n, 3)``.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.posterior import transforms
    >>> transforms(np.array([[1.0, 0, 0]]), np.zeros(3))[2].tolist()
    [[0.0, 1.0, 0.0]]
    """
    axes = np.eye(3)
    rotations = [np.cross(axis, X - center) for axis in axes]
    translations = [np.broadcast_to(axis, X.shape) for axis in axes]
    return np.stack([*rotations, *translations, *[X - center] * scale])


def know(
    fields: Array, Phi: Array, X: Array, area: Array, present: Array, *, scale: bool = False
) -> Known:
    """Return the prior of a study for shapes with some known vertices.

    Parameters
    ----------
    fields : float ndarray (s, n, 3)
        Displacements of the study.
    Phi : float ndarray (n, K)
        Eigenfunctions, orthonormal in the areas.
    X : float ndarray (n, 3)
        Vertices of the template.
    area : float ndarray (n,)
        Sums to 1.
    present : bool ndarray (n,)
    scale : bool
        Whether size is unknown, too.
    """
    s, n, _ = fields.shape
    centred = fields - fields.mean(0)
    weighted = centred * area[:, None]
    K = np.einsum("snx,tnx->st", centred, weighted, optimize=True)
    weights = residual_weights(K)
    coefficient = np.einsum("st,tnx,nk->skx", weights, weighted, Phi, optimize=True)
    length = np.einsum("ij,jk,ik->i", weights, K, weights)  # squared
    left = length - (coefficient**2).sum((1, 2))
    variance = smooth_variance(coefficient)
    each = np.zeros((Phi.shape[1], 3, n, 3))  # one coordinate of one function
    for x in range(3):
        each[:, x, :, x] = Phi.T
    smooth = each.reshape(-1, n, 3)
    columns = np.concatenate([centred, smooth, transforms(X, area @ X, scale=scale)])
    rows = (columns[:, present] * np.sqrt(area[present])[:, None]).reshape(len(columns), -1)
    rest = max(float(left.mean()) / 3, 1e-6 * float(np.trace(K)) / s)
    # a lower bound, so that the variances can be inverted
    variance = np.maximum(np.repeat(variance, 3), 1e-9 * variance.max() + 1e-15)
    return Known(columns, s, len(smooth), area, present, rows @ rows.T, variance, rest)


def weights_of(known: Known, modes: Array) -> Array:
    """Return weights of the columns ``(q, p)`` for modes, eigenfunctions and transforms.

    Parameters
    ----------
    known : Known
    modes : float ndarray (c, s)
        Modes of one standard deviation, as weights of the fields.
    """
    q, c = len(known.columns), len(modes)
    weights = np.zeros((q, c + q - known.n_fields))
    weights[: known.n_fields, :c] = modes.T
    weights[known.n_fields :, c:] = np.eye(q - known.n_fields)
    return weights


def modes_of(K: Array, used: Array) -> Array:
    """Return modes of some fields, of one standard deviation, as weights of all ``(c, s)``.

    Parameters
    ----------
    K : float ndarray (s, s)
        Gram matrix of the fields.
    used : int ndarray (u,)
    """
    center = np.eye(len(used)) - 1 / len(used)
    eigenvalue, V = np.linalg.eigh(center @ K[np.ix_(used, used)] @ center)
    keep = eigenvalue > 1e-10 * eigenvalue[-1]
    modes = np.zeros((int(keep.sum()), len(K)))
    modes[:, used] = (center @ V[:, keep][:, ::-1]).T / np.sqrt(len(used) - 1)
    return modes


def precision(known: Known, model: Array, density: float) -> tuple[Array, float]:
    """Return the matrix H of the equation above, and the weight of the area in W."""
    c = model.shape[1] - (len(known.columns) - known.n_fields)
    weight = density * known.n_smooth / 3 / known.rest
    H = weight * (model.T @ known.gram @ model)
    prior = np.zeros(len(H))
    prior[:c] = 1
    prior[c : c + known.n_smooth] = 1 / known.variance
    prior[c + known.n_smooth :] = 1e-9 * weight
    H[np.diag_indices_from(H)] += prior
    return H, weight


def condition(known: Known, model: Array, observed: Array, density: float) -> Posterior:
    """Return the posterior weights of the columns of the model.

    Parameters
    ----------
    known : Known
    model : float ndarray (q, p)
        From :func:`weights_of`.
    observed : float ndarray (q,)
        Inner products of the columns with the known vertices minus their mean.
    density : float
        See :data:`DENSITY`.
    """
    H, weight = precision(known, model, density)
    L = scipy.linalg.cholesky(H, lower=True, check_finite=False)
    root = scipy.linalg.solve_triangular(L, np.eye(len(H)), lower=True, check_finite=False).T
    return Posterior(root @ (root.T @ (weight * (model.T @ observed))), root)


def left_out(known: Known, density: float, tested: Array) -> Array:
    """Return leave-one-out errors ``(s, t, 3)`` of every shape at tested vertices."""
    s, q = known.n_fields, len(known.columns)
    rows = known.columns[:, tested].reshape(q, -1)  # (q, 3 t)
    fields = known.columns[:s]
    K = np.einsum("snx,tnx,n->st", fields, fields, known.area, optimize=True)
    errors = []
    for i in range(s):
        used = np.delete(np.arange(s), i)
        model = weights_of(known, modes_of(K, used))
        weights = np.zeros(q)  # of shape i minus the mean of the others
        weights[i] = 1
        weights[used] = -1 / (s - 1)
        estimate = condition(known, model, known.gram @ weights, density)
        errors.append((weights - model @ estimate.mean) @ rows)
    return np.reshape(errors, (s, len(tested), 3))


def best_density(known: Known, where: Array) -> tuple[float, float]:
    """Return the best value of :data:`DENSITY` and its leave-one-out error of a coordinate.

    Parameters
    ----------
    known : Known
    where : bool ndarray (n,)
        Vertices at which errors are computed, usually the missing ones.
    """
    rows = np.flatnonzero(where)
    tested = rows[:: max(1, len(rows) // N_TESTED)]
    sizes = [float(np.sqrt((left_out(known, density, tested) ** 2).mean())) for density in DENSITY]
    least = int(np.argmin(sizes))
    return DENSITY[least], sizes[least]


def extend(values: Array, known: Array, W: sp.csr_matrix, area: Array, kappa2: float) -> Array:
    """Extend values ``(n, 3)`` of known vertices, decaying to 0: (W + kappa^2 A) u = 0.

    Parameters
    ----------
    values : float ndarray (n, 3)
    known : bool ndarray (n,)
    W : sparse matrix (n, n)
        Stiffness matrix.
    area : float ndarray (n,)
    kappa2 : float
        The values decay over a length of 1 / kappa.
    """
    u = np.where(known[:, None], values, 0.0)
    free = np.flatnonzero(~known)
    if len(free):
        S = (W + kappa2 * sp.diags_array(area)).tocsr()[free]
        u[free] = factor(S[:, free])(-(S[:, np.flatnonzero(known)] @ values[known]))
    return u


def rough_fields(
    W: sp.csr_matrix, area: Array, kappa2: float
) -> Callable[[np.random.Generator], Array]:
    """Return a function that draws random fields ``(n, 3)`` of variance about 1.

    (W + kappa^2 A) u = A^(1/2) g with white noise g has the correlation length 1 / kappa and on a
    plane the variance 1 / (4 pi kappa^2) (Lindgren, Rue and Lindstroem 2011).
    """
    solve = factor(W + kappa2 * sp.diags_array(area))
    size = np.sqrt(4 * np.pi * kappa2)

    def draw(rng: np.random.Generator) -> Array:
        return size * solve(np.sqrt(area)[:, None] * rng.standard_normal((len(area), 3)))

    return draw
