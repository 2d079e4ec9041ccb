"""Posterior shape model (6.1): what the modes say of a whole of which a part is known.

A shape is the mean, the modes with normal scores, and what no mode of so few shapes holds: a smooth
field of the template's first functions, whose variances are those of the errors with which each
shape is described by all others.  All of it is normal, so that the shapes that agree with a part
are normal again (Albrecht, Luethi, Gerig and Vetter, Medical Image Analysis 2013; the smooth field
in addition to the modes is that of Luethi, Gerig, Jud and Vetter, TPAMI 2018).  With E the columns
of modes, functions and small transforms, y what is known at some vertices less the mean there,

    H = E^T W E + P,   w = H^-1 E^T W y,   cov(w) = H^-1,

W the weights of these vertices by their areas, P the inverse of the variances before, and 0 of
transforms: how a part lies is not known either.  The same is asked of every shape of the study by
the model of the others, with the same part known: how many places of a part count as independent is
what makes these errors least.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from s4a.method.spectral import factor
from s4a.schema import Array

DENSITY = (0.25, 1.0, 4.0, 16.0)  # independent places known on all of the template, by functions
WITHIN_90 = 1.6449  # standard deviations
N_TESTED = 400  # vertices at which the errors of left-out shapes are looked at


class Known(NamedTuple):
    """What is known of a shape, and of which kind shapes are.

    ``columns (q, n, 3)``: the s fields of the study less their mean, 3 K smooth fields, transforms;
    ``n_fields``, ``n_smooth``, how many of the former; ``area (n,)`` of sum 1; ``present (n,)``,
    the vertices that are known; ``gram (q, q)`` of the columns there; ``variance (3 K,)`` of the
    smooth fields; ``rest``, the variance of every coordinate that none of them holds.
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
    """Row i: weights ``(s,)`` of all fields that give field i less its best description by others.

    The nearest field of the affine hull of the others: with the pseudo-inverse P of the centred
    Gram matrix, P_ij / P_ii.

    Parameters
    ----------
    K : float ndarray (s, s)
        Gram matrix of the fields less their mean.

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
    """Variance ``(K,)`` of coefficients ``(s, K, 3)``, a mean over functions of like frequency."""
    variance = (coefficient**2).mean((0, 2))  # (K,)
    total = np.concatenate([[0], np.cumsum(variance)])
    k = np.arange(len(variance))
    first, end = np.maximum(k - k // 4, 0), np.minimum(k + k // 4 + 1, len(k))
    return (total[end] - total[first]) / (end - first)


def transforms(X: Array, center: Array, *, scale: bool = False) -> Array:
    """Small transforms ``(6 or 7, n, 3)`` of points X ``(n, 3)``: turns, shifts, growth.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.posterior import transforms
    >>> transforms(np.array([[1.0, 0, 0]]), np.zeros(3))[2].tolist()
    [[0.0, 1.0, 0.0]]
    """
    axes = np.eye(3)
    turns = [np.cross(axis, X - center) for axis in axes]
    shifts = [np.broadcast_to(axis, X.shape) for axis in axes]
    return np.stack([*turns, *shifts, *[X - center] * scale])


def know(
    fields: Array, Phi: Array, X: Array, area: Array, present: Array, *, scale: bool = False
) -> Known:
    """What a study says of shapes of which some vertices are known.

    Parameters
    ----------
    fields : float ndarray (s, n, 3)
        Displacements of the study.
    Phi : float ndarray (n, K)
        Functions, orthonormal in the areas.
    X : float ndarray (n, 3)
        Vertices of the template.
    area : float ndarray (n,)
        Of sum 1.
    present : bool ndarray (n,)
    scale : bool
        Whether the size of a shape says nothing either.
    """
    s, n, _ = fields.shape
    around = fields - fields.mean(0)
    weighted = around * area[:, None]
    K = np.einsum("snx,tnx->st", around, weighted, optimize=True)
    weights = residual_weights(K)
    coefficient = np.einsum("st,tnx,nk->skx", weights, weighted, Phi, optimize=True)
    length = np.einsum("ij,jk,ik->i", weights, K, weights)  # squared
    left = length - (coefficient**2).sum((1, 2))
    variance = smooth_variance(coefficient)
    each = np.zeros((Phi.shape[1], 3, n, 3))  # one coordinate of one function
    for x in range(3):
        each[:, x, :, x] = Phi.T
    smooth = each.reshape(-1, n, 3)
    columns = np.concatenate([around, smooth, transforms(X, area @ X, scale=scale)])
    rows = (columns[:, present] * np.sqrt(area[present])[:, None]).reshape(len(columns), -1)
    rest = max(float(left.mean()) / 3, 1e-6 * float(np.trace(K)) / s)
    # of nothing: a number that inverts
    variance = np.maximum(np.repeat(variance, 3), 1e-9 * variance.max() + 1e-15)
    return Known(columns, s, len(smooth), area, present, rows @ rows.T, variance, rest)


def weights_of(known: Known, modes: Array) -> Array:
    """Weights of all columns ``(q, p)`` that give modes, functions and transforms.

    Parameters
    ----------
    known : Known
    modes : float ndarray (c, s)
        Of one standard deviation each, as weights of the fields.
    """
    q, c = len(known.columns), len(modes)
    weights = np.zeros((q, c + q - known.n_fields))
    weights[: known.n_fields, :c] = modes.T
    weights[known.n_fields :, c:] = np.eye(q - known.n_fields)
    return weights


def modes_of(K: Array, used: Array) -> Array:
    """Modes of some fields, of one standard deviation each, as weights of all ``(c, s)``.

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
    """Matrix H of the module's equation, and the weight of the area in W."""
    c = model.shape[1] - (len(known.columns) - known.n_fields)
    weight = density * known.n_smooth / 3 / known.rest
    H = weight * (model.T @ known.gram @ model)
    prior = np.zeros(len(H))
    prior[:c] = 1
    prior[c : c + known.n_smooth] = 1 / known.variance
    prior[c + known.n_smooth :] = 1e-9 * weight
    H[np.diag_indices_from(H)] += prior
    return H, weight


def condition(known: Known, model: Array, seen: Array, density: float) -> Posterior:
    """Weights of the model's columns when the part is known.

    Parameters
    ----------
    known : Known
    model : float ndarray (q, p)
        Of :func:`weights_of`.
    seen : float ndarray (q,)
        Inner products of the columns with what is known less the mean, over the part.
    density : float
        See :data:`DENSITY`.
    """
    H, weight = precision(known, model, density)
    L = scipy.linalg.cholesky(H, lower=True, check_finite=False)
    root = scipy.linalg.solve_triangular(L, np.eye(len(H)), lower=True, check_finite=False).T
    return Posterior(root @ (root.T @ (weight * (model.T @ seen))), root)


def left_out(known: Known, density: float, tested: Array) -> Array:
    """Errors ``(s, t, 3)`` of every shape, told from its part by the others, at tested vertices."""
    s, q = known.n_fields, len(known.columns)
    rows = known.columns[:, tested].reshape(q, -1)  # (q, 3 t)
    fields = known.columns[:s]
    K = np.einsum("snx,tnx,n->st", fields, fields, known.area, optimize=True)
    error = []
    for i in range(s):
        used = np.delete(np.arange(s), i)
        model = weights_of(known, modes_of(K, used))
        own = np.zeros(q)
        own[i] = 1
        own[used] = -1 / (s - 1)
        found = condition(known, model, known.gram @ own, density)
        error.append((own - model @ found.mean) @ rows)
    return np.reshape(error, (s, len(tested), 3))


def best_density(known: Known, where: Array) -> tuple[float, float]:
    """How many places of the part count as independent, and the error of shapes left out.

    That of :data:`DENSITY` with the least root mean square error of a coordinate.

    Parameters
    ----------
    known : Known
    where : bool ndarray (n,)
        Vertices at which the errors are looked at: those that are missing.
    """
    rows = np.flatnonzero(where)
    tested = rows[:: max(1, len(rows) // N_TESTED)]
    sizes = [float(np.sqrt((left_out(known, one, tested) ** 2).mean())) for one in DENSITY]
    least = int(np.argmin(sizes))
    return DENSITY[least], sizes[least]


def extend(values: Array, known: Array, W: sp.csr_matrix, area: Array, kappa2: float) -> Array:
    """Values ``(n, 3)`` of the known vertices, fading to 0 on the others: (W + kappa^2 A) u = 0.

    Parameters
    ----------
    values : float ndarray (n, 3)
    known : bool ndarray (n,)
    W : sparse matrix (n, n)
        Stiffness matrix.
    area : float ndarray (n,)
    kappa2 : float
        They fade over 1 / kappa.
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
    """Draws random fields ``(n, 3)`` of variance about 1, alike over 1 / kappa.

    (W + kappa^2 A) u = A^(1/2) g with g white, of variance 1 / (4 pi kappa^2) on a plane (Lindgren,
    Rue and Lindstroem 2011).
    """
    solve = factor(W + kappa2 * sp.diags_array(area))
    size = np.sqrt(4 * np.pi * kappa2)

    def draw(rng: np.random.Generator) -> Array:
        return size * solve(np.sqrt(area)[:, None] * rng.standard_normal((len(area), 3)))

    return draw
