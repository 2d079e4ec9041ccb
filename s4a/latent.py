"""Consistent latent basis and Consistent ZoomOut (3.4, eq. 3; Huang, Ren, Wonka, Ovsjanikov 2020).

The functions of all shapes live in one latent space: C_ij Y_i = Y_j for every map of the network, as far as it can
be had.  Y_i is k x m; the functions themselves are Phi_i Y_i, at full resolution U_i Phi_i Y_i.
"""

import logging

import numpy as np
import scipy.linalg
from joblib import Parallel, delayed
from scipy.sparse.csgraph import breadth_first_order

from s4a.fmap import nearest_rows
from s4a.network import cycle_errors, cycle_weights, three_cycles

log = logging.getLogger(__name__)


def consistency_matrix(C, source, target, weight, n):
    """The matrix of sum w |C_ij Y_i - Y_j|^2 as a quadratic form of the stacked Y ``(n k, n k)``."""
    k = C.shape[1]
    L = np.zeros((n, k, n, k))
    for c, i, j, w in zip(C, source, target, weight, strict=True):
        L[i, :, i] += w * (c.T @ c)
        L[j, :, j] += w * np.eye(k)
        L[i, :, j] -= w * c.T
        L[j, :, i] -= w * c
    return L.reshape(n * k, n * k)


def spanning_start(C, source, target, n):
    """Y_i = composition of the maps along a tree from the shape with most maps: the first guess ``(n, k, k)``."""
    k = C.shape[1]
    adjacency = np.zeros((n, n))
    adjacency[source, target] = 1
    root = int(np.argmax(adjacency.sum(1)))
    order, parent = breadth_first_order(adjacency, root)
    if len(order) < n:
        raise ValueError(f"the network is not connected: {len(order)} of {n} shapes are reached from shape {root}")
    row = {pair: r for r, pair in enumerate(zip(source.tolist(), target.tolist(), strict=True))}
    Y = np.zeros((n, k, k))
    Y[root] = np.eye(k)
    for j in order[1:]:
        Y[j] = C[row[int(parent[j]), int(j)]] @ Y[parent[j]]
    return Y


def smallest_eigenvectors(L, start, *, tolerance=1e-6, max_rounds=60):
    """The eigenvectors of the smallest eigenvalues of a positive semi-definite L, by block inverse iteration.

    L is factored once; a Rayleigh-Ritz step keeps the block orthonormal.  As many vectors as `start` has columns,
    with one tenth more carried along for the speed of convergence.
    """
    n, m = start.shape
    extra = min(n - m, max(4, m // 10))
    seeds = np.cos(np.outer(np.arange(n) + 1.0, np.arange(extra) + 1.0) * 0.7)
    V = np.linalg.qr(np.concatenate([start, seeds], axis=1))[0]
    shift = 1e-4 * np.trace(L) / n
    factor = scipy.linalg.cho_factor(L + shift * np.eye(n), lower=True, check_finite=False)
    last = None
    for _ in range(max_rounds):
        V = np.linalg.qr(scipy.linalg.cho_solve(factor, V, check_finite=False))[0]
        ritz, R = np.linalg.eigh(V.T @ (L @ V))
        V = V @ R
        if last is not None and np.abs(ritz[:m] - last[:m]).max() < tolerance * (ritz[m - 1] + shift):
            return V[:, :m]
        last = ritz
    log.warning("the latent basis reached %d rounds before its tolerance", max_rounds)
    return V[:, :m]


def latent_basis(C, source, target, weight, eigenvalues, m=None):
    """Canonical consistent latent basis of a network of functional maps.

    Minimises sum w |C_ij Y_i - Y_j|^2 under sum Y_i^T Y_i = n I, then turns the latent space so that
    mean Y_i^T Lambda_i Y_i = Lambda^0 is diagonal and ascending.

    Parameters
    ----------
    C : float ndarray (p, k, k)
        Directed maps, source functions to target functions.
    source, target : int ndarray (p,)
    weight : float ndarray (p,)
    eigenvalues : float ndarray (n, >= k)
        Laplacian eigenvalues of the n shapes, for unit area.
    m : int, optional
        Dimension of the latent space; k by default.

    Returns
    -------
    Y : float ndarray (n, k, m)
    latent_eigenvalue : float ndarray (m,)
        Diagonal of Lambda^0.
    """
    n, k = len(eigenvalues), C.shape[1]
    m = k if m is None else m
    start = spanning_start(C, source, target, n).reshape(n * k, k)[:, :m]
    Y = smallest_eigenvectors(consistency_matrix(C, source, target, weight, n), start).reshape(n, k, m) * np.sqrt(n)
    mean = np.einsum("nkl,nk,nkm->lm", Y, eigenvalues[:, :k], Y) / n
    latent_eigenvalue, turn = np.linalg.eigh(mean)
    Y = Y @ turn
    total = Y.sum(0)
    Y *= np.where(total[np.abs(total).argmax(0), np.arange(m)] < 0, -1.0, 1.0)
    return Y, np.maximum(latent_eigenvalue, 0.0)


def latent_size(n_latent, k, k_final):
    """Latent dimension at size k: all of it, or the share of it that `n_latent` is of `k_final`."""
    return k if n_latent is None else max(1, round(k * n_latent / k_final))


def consistent_zoomout(
    C, source, target, Phi, area, eigenvalues, k, *, step=5, n_latent=None, samples=None, n_jobs=1, progress=None
):
    """Consistent ZoomOut: latent basis -> matches -> larger maps, until all maps of the network are k x k.

    Each round embeds every shape in the latent space (rows of Phi_i Y_i), matches nearest neighbours for every map
    (eq. 3) and solves for the next larger maps in the least-squares sense, on `samples` of the target only; the factor
    of the least squares is made once per shape.  The last round uses all vertices.

    Parameters
    ----------
    C : float ndarray (p, k_init, k_init)
    source, target : int ndarray (p,)
    Phi : list of float ndarray (n_i, >= k)
    area : list of float ndarray (n_i,), each of sum 1
    eigenvalues : float ndarray (n, >= k)
    samples : list of int ndarray, optional
        Spread vertices of every shape; all vertices by default.  Their neighbours are looked for among all vertices of
        the source: among its samples they would be off by the spacing of these, which costs eq. 7 a third.
    n_jobs : int
        Threads; the result does not depend on it.
    progress : callable, optional
        Called with the size reached after each round.

    Returns
    -------
    C : float ndarray (p, k, k)
    weight, error : float ndarray (p,)
        Weights and cycle errors of the final maps.
    Y, latent_eigenvalue : as of :func:`latent_basis`
    """
    cycles = three_cycles(source.tolist(), target.tolist())
    sizes = [*range(C.shape[1], k, step), k]
    everything = [np.arange(len(a)) for a in area]
    for size, larger in zip(sizes, [*sizes[1:], None], strict=True):
        error = cycle_errors(C, cycles)
        weight = cycle_weights(error)
        m = latent_size(n_latent, size, k)
        Y, latent_eigenvalue = latent_basis(C, source, target, weight, eigenvalues, m)
        if progress:
            progress(size)
        if larger is None:
            break
        vertices = everything if samples is None or larger == k else samples
        points = [np.asarray(F[:, :size] @ y, np.float32) for F, y in zip(Phi, Y, strict=True)]
        solve = [
            np.linalg.pinv(Phi[i][v, :larger] * np.sqrt(area[i][v])[:, None]) * np.sqrt(area[i][v])
            for i, v in enumerate(vertices)
        ]

        def larger_map(i, j, points=points, solve=solve, vertices=vertices, larger=larger):
            match = nearest_rows(points[j][vertices[j]], points[i])
            return solve[j] @ Phi[i][match, :larger]

        C = np.stack(
            Parallel(n_jobs=n_jobs, backend="threading")(
                delayed(larger_map)(i, j) for i, j in zip(source, target, strict=True)
            )
        )
    return C, weight, error, Y, latent_eigenvalue
