"""Consistent latent basis and Consistent ZoomOut (3.4, eq. 3; Huang, Ren, Wonka, Ovsjanikov 2020).

The functions of all shapes live in one latent space: C_ij Y_i = Y_j for every map of the network,
as far as it can be had.  Y_i is k x m; the functions themselves are Phi_i Y_i, at full resolution
U_i Phi_i Y_i.
"""

import logging

import numpy as np
from joblib import Parallel, delayed
from scipy.sparse.csgraph import breadth_first_order
from scipy.sparse.linalg import LinearOperator, eigsh

from s4a.method.fmap import nearly_nearest, queries, searched
from s4a.method.network import cycle_errors, cycle_weights, three_cycles

log = logging.getLogger(__name__)

WIDE = 4  # last rounds of Consistent ZoomOut, which look among all vertices
ROUGH, FINE = 1e-4, 1e-6  # tolerances of the latent basis: on the way, and at the end
SAMPLES = 1000  # vertices per shape whose matches Consistent ZoomOut looks for


def consistency_form(C, source, target, weight, n, *, dtype=float, n_jobs=1):
    """The quadratic form sum w |C_ij Y_i - Y_j|^2 of the stacked Y.

    As its product with vectors ``(n k, q)``.

    The form is never assembled: every shape has its rows of k x k blocks, one for itself and one
    for each shape that a map joins it with, so that memory is linear in the maps.
    """
    k = C.shape[1]
    blocks = [{i: np.zeros((k, k))} for i in range(n)]
    for c, i, j, w in zip(C, source.tolist(), target.tolist(), weight, strict=True):
        blocks[i][i] += w * (c.T @ c)
        blocks[j][j] += w * np.eye(k)
        blocks[i][j] = blocks[i].get(j, 0) - w * c.T
        blocks[j][i] = blocks[j].get(i, 0) - w * c
    joined = [sorted(row) for row in blocks]
    rows = [
        np.concatenate([row[j] for j in near], axis=1, dtype=dtype)
        for row, near in zip(blocks, joined, strict=True)
    ]

    def product(some, V):
        return [rows[i] @ V[joined[i]].reshape(-1, V.shape[2]) for i in some]

    shares = np.array_split(np.arange(n), n_jobs)

    def apply(V):
        V = np.asarray(V, dtype).reshape(n, k, -1)
        if V.shape[2] == 1:  # as long as it takes to start a thread
            return np.concatenate(product(range(n), V))
        parts = Parallel(n_jobs=n_jobs, backend="threading")(
            delayed(product)(some, V) for some in shares
        )
        return np.concatenate([block for part in parts for block in part])

    return apply


def spanning_start(C, source, target, n):
    """Y_i = composition of the maps along a tree from the shape with most maps.

    The first guess ``(n, k, k)``.
    """
    k = C.shape[1]
    adjacency = np.zeros((n, n))
    adjacency[source, target] = 1
    root = int(np.argmax(adjacency.sum(1)))
    order, parent = breadth_first_order(adjacency, root)
    if len(order) < n:
        raise ValueError(
            f"the network is not connected: {len(order)} of {n} shapes are reached from shape {root}"
        )
    row = {pair: r for r, pair in enumerate(zip(source.tolist(), target.tolist(), strict=True))}
    Y = np.zeros((n, k, k))
    Y[root] = np.eye(k)
    for j in order[1:]:
        Y[j] = C[row[int(parent[j]), int(j)]] @ Y[parent[j]]
    return Y


def smallest_eigenvectors(apply, start, *, tolerance=FINE, max_rounds=100):
    """The eigenvectors of the smallest eigenvalues of a positive semi-definite form.

    By Chebyshev-filtered subspaces.

    Each round damps all above the largest Ritz value of the block by a Chebyshev polynomial of the
    form, and solves the small eigenproblem within the block (Zhou, Saad, Tiago, Chelikowsky 2006).
    Nothing is assembled or factored: memory is linear in the maps.  As many vectors as `start` has
    columns, with one tenth more carried along.

    Against a Cholesky factor of the assembled form and inverse iteration, 51 shapes and 1,000 maps:
    at k = 60 0.8 s of CPU for 0.7 s and the same subspace; at k = 80 2.6 s for 3.8 s, and a sum of
    the eigenvalues that exceeds the least by 3e-10 instead of 2e-6.
    """
    n, m = start.shape
    extra = min(n - m, max(4, m // 10))
    seeds = np.cos(np.outer(np.arange(n) + 1.0, np.arange(extra) + 1.0) * 0.7)
    V = np.linalg.qr(np.concatenate([start, seeds], axis=1))[0]
    form = LinearOperator((n, n), lambda v: apply(v.reshape(n, 1)).ravel(), dtype=float)
    top = 1.02 * eigsh(form, 1, which="LA", tol=1e-2, v0=seeds[:, 0], return_eigenvectors=False)[0]
    for _ in range(max_rounds):
        LV = apply(V)
        ritz, R = np.linalg.eigh(V.T @ LV)
        V = V @ R
        if np.linalg.norm(LV @ R[:, :m] - V[:, :m] * ritz[:m], axis=0).max() <= tolerance * top:
            return V[:, :m]
        V = np.linalg.qr(filtered(apply, V, ritz[0], ritz[-1], top))[0]
    log.warning("the latent basis reached %d rounds before its tolerance", max_rounds)
    return V[:, :m]


def filtered(apply, V, least, cut, top):
    """T(L) V, T the Chebyshev polynomial small on [cut, top] and 1 at `least`.

    Its degree grows with top / cut.
    """
    half, middle = (top - cut) / 2, (top + cut) / 2
    if half <= 1e-9 * top:  # nothing lies above the block
        return V
    ratio = first = half / (least - middle)
    new = (apply(V) - middle * V) * (first / half)
    for _ in range(int(np.clip(1.5 * np.sqrt(top / max(cut, 1e-4 * top)), 6, 40)) - 1):
        following = 1 / (2 / first - ratio)
        V, new = new, (apply(new) - middle * new) * (2 * following / half) - ratio * following * V
        ratio = following
    return new


def latent_basis(C, source, target, weight, eigenvalues, m=None, *, tolerance=FINE, n_jobs=1):
    """Canonical consistent latent basis of a network of functional maps.

    Minimises sum w |C_ij Y_i - Y_j|^2 under sum Y_i^T Y_i = n I, then turns the latent space so
    that mean Y_i^T Lambda_i Y_i = Lambda^0 is diagonal and ascending.

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
    tolerance : float
        Largest residual of the eigenvectors, as a share of the largest eigenvalue.
    n_jobs : int
        Threads; the result does not depend on it.

    Returns
    -------
    Y : float ndarray (n, k, m)
    latent_eigenvalue : float ndarray (m,)
        Diagonal of Lambda^0.
    """
    n, k = len(eigenvalues), C.shape[1]
    m = k if m is None else m
    start = spanning_start(C, source, target, n).reshape(n * k, k)[:, :m]
    dtype = np.float32 if tolerance >= ROUGH else float
    form = consistency_form(C, source, target, weight, n, dtype=dtype, n_jobs=n_jobs)
    Y = smallest_eigenvectors(form, start, tolerance=tolerance).reshape(n, k, m) * np.sqrt(n)
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
    C,
    source,
    target,
    Phi,
    area,
    eigenvalues,
    k,
    *,
    step=5,
    n_latent=None,
    samples=None,
    n_jobs=1,
    progress=None,
):
    """Consistent ZoomOut: latent basis -> matches -> larger maps.

    Until all maps of the network are k x k.

    Each round embeds every shape in the latent space (rows of Phi_i Y_i), matches nearest
    neighbours for every map (eq. 3) and solves for the next larger maps in the least-squares sense,
    on `samples` only; the factor of the least squares is made once per shape.  In the last rounds
    (``WIDE``) the samples look among all vertices of the source: among its samples they are off by
    the spacing of these.

    The latent basis is found to ``ROUGH`` on the way and to ``FINE`` at the end: for 51 brains of
    100,000 vertices a sixth less time than ``FINE`` throughout, and the same error of eq. 7 (1.780
    for 1.779 % of sqrt(area)).

    Of 1,000 maps of 51 brains a round takes 3 s of CPU from samples to samples and 15 s among all
    vertices at k = 100; from all vertices to all, 80 s, it closes cycles little better (0.073 for
    0.092) and is no nearer to the truth.  Eq. 7 on six faces with 0, 1, 2, 4, 8, 16 wide rounds:
    0.25, 0.14, 0.09, 0.07, 0.06, 0.05 % of sqrt(area).

    Parameters
    ----------
    C : float ndarray (p, k_init, k_init)
    source, target : int ndarray (p,)
    Phi : list of float ndarray (n_i, >= k)
    area : list of float ndarray (n_i,), each of sum 1
    eigenvalues : float ndarray (n, >= k)
    samples : list of int ndarray, optional
        Spread vertices of every shape; all vertices by default.
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
    shapes, everything = range(len(area)), [np.arange(len(a)) for a in area]
    into = [source[target == j] for j in shapes]
    row = np.argsort(np.argsort(target, kind="stable"), kind="stable")

    def in_threads(function, *arguments):
        return Parallel(n_jobs=n_jobs, backend="threading")(
            delayed(function)(*a) for a in zip(*arguments, strict=True)
        )

    samples = everything if samples is None else samples
    for size, larger in zip(sizes, [*sizes[1:], None], strict=True):
        error = cycle_errors(C, cycles, n_jobs=n_jobs)
        weight = cycle_weights(error)
        m = latent_size(n_latent, size, k)
        tolerance = ROUGH if larger else FINE
        Y, latent_eigenvalue = latent_basis(
            C, source, target, weight, eigenvalues, m, tolerance=tolerance, n_jobs=n_jobs
        )
        if progress:
            progress(size)
        if larger is None:
            break
        among = everything if size in sizes[:-1][-WIDE:] else samples
        rows = in_threads(lambda F, v, y: searched(F[v, : len(y)] @ y), Phi, among, Y)

        def larger_maps(j, size=size, larger=larger, among=among, rows=rows, Y=Y):
            F, w = Phi[j][samples[j], :larger], np.sqrt(area[j][samples[j]])
            q, solve = queries(F[:, :size] @ Y[j]), np.linalg.pinv(F * w[:, None]) * w
            return [
                solve @ Phi[i].take(among[i][nearly_nearest(q, rows[i])], axis=0)[:, :larger]
                for i in into[j]
            ]

        C = np.stack([c for maps in in_threads(larger_maps, shapes) for c in maps])[row]
    return C, weight, error, Y, latent_eigenvalue
