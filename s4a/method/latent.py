"""Consistent latent basis and Consistent ZoomOut (3.4, eq. 3; Huang, Ren, Wonka, Ovsjanikov 2020).

The functions of all shapes live in one latent space: C_ij Y_i = Y_j for every map of the network,
as far as it can be had.  Y_i is k x m; the functions themselves are Phi_i Y_i, the Y_i of eq. 3 and
6, at full resolution U_i Phi_i Y_i (eq. 7).
"""

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from joblib import effective_n_jobs
from scipy.sparse.csgraph import breadth_first_order
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import cKDTree

from s4a.geometry.align import RigidTransform, realign
from s4a.method.fmap import fmap_from_match
from s4a.method.initial_map import initial_map
from s4a.method.median import area_differences, conformal_differences, distance_to_identity
from s4a.method.nearest import (
    as_candidates,
    as_queries,
    nearest_around,
    nearest_both_ways,
    nearest_float32,
    nearest_rows,
)
from s4a.method.network import (
    cycle_errors,
    cycle_weights,
    in_threads,
    spectral_distance,
    three_cycles,
)
from s4a.method.shape import Basis
from s4a.options import N_SAMPLES, PER_FUNCTION
from s4a.schema import Array, dataset

log = logging.getLogger(__name__)

_FINAL = 3  # shapes of a study in the last iterations of a new one, on all vertices
TARGETS = 256  # shapes whose least squares are held at once, 0.3 GB of them
DENSE_ITERATIONS = 4  # last iterations of Consistent ZoomOut, which look between the samples, too
N_AROUND = 32  # vertices around a sample among which they look
ROUGH, FINE = 1e-4, 1e-6  # tolerances of the latent basis: on the way, and at the end

_Form = Callable[[Array], Array]  # the product of a quadratic form with vectors


def consistency_form(
    C: Array,
    source: Array,
    target: Array,
    weight: Array,
    n: int,
    *,
    dtype: type = float,
    n_jobs: int | None = 1,
) -> _Form:
    """The quadratic form sum w |C_ij Y_i - Y_j|^2 of the stacked Y, as its product with vectors.

    A map C_ij adds four blocks of k x k::

                 i          j
        i    w C^T C    -w C^T
        j     -w C        w I

    The form is never assembled: every shape has its row of blocks, one for itself and one for each
    shape that a map joins it with, so that memory is linear in the maps.

    Parameters
    ----------
    C : float ndarray (p, k, k)
    source, target, weight : ndarray (p,)
    n : int
        Number of shapes.
    dtype : type
        In which products are computed.
    n_jobs : int
        Threads; the result does not depend on it.

    Returns
    -------
    callable
        From vectors ``(n k, q)`` to vectors of the same shape.
    """
    k = C.shape[1]
    maps_with: list[list[int]] = [[] for _ in range(n)]
    for r, (i, j) in enumerate(zip(source.tolist(), target.tolist(), strict=True)):
        maps_with[i].append(r)
        maps_with[j].append(r)
    joined, rows = [], []
    for shape, own in enumerate(maps_with):  # one after the other: each row once in memory
        blocks = {shape: np.zeros((k, k))}
        for r in own:
            c, i, j, w = C[r], int(source[r]), int(target[r]), weight[r]
            if shape == i:
                blocks[i] += w * (c.T @ c)
                blocks[j] = blocks.get(j, 0) - w * c.T
            else:
                blocks[j] += w * np.eye(k)
                blocks[i] = blocks.get(i, 0) - w * c
        near = sorted(blocks)
        joined.append(near)
        rows.append(np.concatenate([blocks[j] for j in near], axis=1, dtype=dtype))

    def product(shapes, V):
        return [rows[i] @ V[joined[i]].reshape(-1, V.shape[2]) for i in shapes]

    shares = np.array_split(np.arange(n), effective_n_jobs(n_jobs))

    def apply(V):
        V = np.asarray(V, dtype).reshape(n, k, -1)
        if V.shape[2] == 1:  # one vector takes as long as it takes to start a thread
            return np.concatenate(product(range(n), V))
        parts = in_threads(lambda shapes: product(shapes, V), shares, n_jobs)
        return np.concatenate([block for part in parts for block in part])

    return apply


def _spanning_start(C, source, target, n):
    """The first guess of all Y ``(n, k, k)``: maps composed along a tree.

    Its root, where Y is the identity, is the shape from which most maps start.
    """
    k = C.shape[1]
    adjacency = np.zeros((n, n))
    adjacency[source, target] = 1
    root = int(np.argmax(adjacency.sum(1)))
    order, parent = breadth_first_order(adjacency, root)
    if len(order) < n:
        raise ValueError(
            f"the network is not connected: {len(order)} of {n} shapes are reached "
            f"from shape {root}"
        )
    row = {pair: r for r, pair in enumerate(zip(source.tolist(), target.tolist(), strict=True))}
    Y = np.zeros((n, k, k))
    Y[root] = np.eye(k)
    for j in order[1:]:
        Y[j] = C[row[int(parent[j]), int(j)]] @ Y[parent[j]]
    return Y


def smallest_eigenvectors(
    apply: _Form, start: Array, *, tolerance: float = FINE, max_iterations: int = 100
) -> Array:
    """The eigenvectors of the smallest eigenvalues of a positive semi-definite form ``(n, m)``.

    Chebyshev-filtered subspaces (Zhou, Saad, Tiago, Chelikowsky 2006): each round damps all above
    the largest Ritz value of the block by a Chebyshev polynomial of the form, and solves the small
    eigenproblem within the block.  Nothing is assembled or factored: memory is linear in the maps,
    and time is that of a Cholesky factor or less.

    Parameters
    ----------
    apply : callable
        The form's product with vectors.
    start : float ndarray (n, m)
        As many vectors as are wanted, near the eigenvectors if possible.
    tolerance : float
        Largest residual of a vector, as a share of the largest eigenvalue.
    max_iterations : int
    """
    n, m = start.shape
    n_spare = min(n - m, max(4, m // 10))  # the last vectors of a block converge slowest
    spare = np.cos(np.outer(np.arange(n) + 1.0, np.arange(n_spare) + 1.0) * 0.7)  # like random
    V = np.linalg.qr(np.concatenate([start, spare], axis=1))[0]  # (n, m + n_spare)
    form = LinearOperator((n, n), lambda v: apply(v.reshape(n, 1)).ravel(), dtype=float)
    largest = eigsh(form, 1, which="LA", tol=1e-2, v0=spare[:, 0], return_eigenvectors=False)[0]
    top = 1.02 * largest  # above all eigenvalues, though `largest` is 1 % uncertain
    for _ in range(max_iterations):
        LV = apply(V)
        ritz, R = np.linalg.eigh(V.T @ LV)
        V = V @ R
        residual = np.linalg.norm(LV @ R[:, :m] - V[:, :m] * ritz[:m], axis=0)  # (m,)
        if residual.max() <= tolerance * top:
            return V[:, :m]
        V = np.linalg.qr(_chebyshev_filter(apply, V, ritz[0], ritz[-1], top))[0]
    log.warning("the latent basis reached %d iterations before its tolerance", max_iterations)
    return V[:, :m]


def _chebyshev_filter(apply, V, least, cut, top):
    """T(L) V, with T the Chebyshev polynomial that is small on [cut, top] and 1 at `least`.

    Of degree d it damps by about cosh(2 d sqrt(cut / top)): by ten with the degree taken here.
    """
    half, middle = (top - cut) / 2, (top + cut) / 2
    if half <= 1e-9 * top:  # nothing lies above the block
        return V
    degree = int(np.clip(1.5 * np.sqrt(top / max(cut, 1e-4 * top)), 6, 40))
    ratio = first = half / (least - middle)
    new = (apply(V) - middle * V) * (first / half)
    for _ in range(degree - 1):  # the recurrence of the T_d, scaled to be 1 at `least`
        following = 1 / (2 / first - ratio)
        V, new = new, (apply(new) - middle * new) * (2 * following / half) - ratio * following * V
        ratio = following
    return new


def latent_basis(
    C: Array,
    source: Array,
    target: Array,
    weight: Array,
    eigenvalues: Array,
    m: int | None = None,
    *,
    tolerance: float = FINE,
    n_jobs: int | None = 1,
) -> tuple[Array, Array]:
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
    start = _spanning_start(C, source, target, n).reshape(n * k, k)[:, :m]
    dtype = np.float32 if tolerance >= ROUGH else float
    form = consistency_form(C, source, target, weight, n, dtype=dtype, n_jobs=n_jobs)
    Y = smallest_eigenvectors(form, start, tolerance=tolerance).reshape(n, k, m) * np.sqrt(n)
    mean = np.einsum("nkl,nk,nkm->lm", Y, eigenvalues[:, :k], Y) / n  # (m, m)
    latent_eigenvalue, turn = np.linalg.eigh(mean)
    Y = Y @ turn
    total = Y.sum(0)  # (k, m)
    largest = total[np.abs(total).argmax(0), np.arange(m)]
    Y *= np.where(largest < 0, -1.0, 1.0)  # eigenvectors have no sign: this one is a convention
    return Y, np.maximum(latent_eigenvalue, 0.0)


def latent_size(n_latent: int | None, k: int, k_final: int) -> int:
    """Latent dimension at size k: all of it, or the share of it that `n_latent` is of `k_final`.

    Where `k_final` had to be reduced below `n_latent`, all of it.
    """
    return k if n_latent is None else min(k, max(1, round(k * n_latent / k_final)))


def consistent_zoomout(
    bases: Sequence[Basis],
    C: Array,
    source: Array,
    target: Array,
    k: int,
    *,
    step: int = 5,
    n_latent: int | None = None,
    weights: str = "cycles",
    samples: list[Array] | None = None,
    dense_iterations: int = DENSE_ITERATIONS,
    n_jobs: int | None = 1,
    progress: Callable[..., Any] | None = None,
    keep: Callable[..., Any] | None = None,
) -> tuple[Array, Array, Array, Array, Array]:
    """Consistent ZoomOut (4.2): latent basis -> matches -> larger maps, until all are k x k.

    Each round embeds every shape in the latent space (rows of Phi_i Y_i), matches nearest
    neighbours for every map (eq. 3) and solves for the next larger maps in the least-squares sense,
    on `samples` only, whose least squares are factored once a round and target shape; on
    samples Phi^T A of eq. 1 is no inverse of Phi.  Among the source's samples matches are off by
    the spacing of these: in the `dense_iterations` last iterations they are looked for among the
    ``N_AROUND`` vertices around the sample that was found, too.  With all vertices as samples it is
    the paper's. The latent basis is found to ``ROUGH`` on the way and to ``FINE`` at the end.

    Parameters
    ----------
    bases : sequence of Basis
        The shapes of the network at low resolution, with k functions or more.  Each is asked for
        once, and in the `dense_iterations` last iterations again: it may be read from its file
        then.
    C : float ndarray (p, k_init, k_init)
    source, target : int ndarray (p,)
        Which shape's functions each map takes, and on which it gives functions.
    k : int
        Final size.
    step : int
        Growth per round.
    n_latent : int, optional
        Latent dimension at the end; k by default.
    weights : {"cycles", "equal"}
        Of the maps, by their cycle errors, or 1 for all.
    samples : list of int ndarray, optional
        Spread vertices of every shape, 2 k or more of them where these are not all; all vertices by
        default.
    dense_iterations : int
        Last iterations that look between the samples.
    n_jobs : int
        Threads; the result does not depend on it.
    progress : callable, optional
        Called with the size reached after each round.
    keep : callable, optional
        Called with C, Y and the latent eigenvalues of each round.

    Returns
    -------
    C : float ndarray (p, k, k)
    weight, error : float ndarray (p,)
        Weights and cycle errors of the final maps.
    Y, latent_eigenvalue : as of :func:`latent_basis`

    Raises
    ------
    ValueError
        When samples are too few for maps of k functions.
    """
    cycles = three_cycles(source.tolist(), target.tolist())
    dense_iterations = 0 if samples is None else dense_iterations
    n_around = N_AROUND if dense_iterations else 1
    sampled = [
        sample(basis, None if samples is None else samples[i], k, n_around)
        for i, basis in enumerate(bases)
    ]
    eigenvalues = np.stack([one.eigenvalue for one in sampled])
    sizes = [*range(C.shape[1], k, step), k]
    if samples is not None and len(sizes) > 1:
        _check_samples(sampled, k)
    dense_sizes = sizes[:-1][max(len(sizes) - 1 - dense_iterations, 0) :]
    for size, next_size in zip(
        sizes, [*sizes[1:], None], strict=True
    ):  # the last only solves for Y
        error = cycle_errors(C, cycles, n_jobs=n_jobs)
        weight = cycle_weights(error) if weights == "cycles" else np.ones(len(C))
        m = latent_size(n_latent, size, k)
        tolerance = ROUGH if next_size else FINE
        Y, latent_eigenvalue = latent_basis(
            C, source, target, weight, eigenvalues, m, tolerance=tolerance, n_jobs=n_jobs
        )
        if progress:
            progress(size)
        if keep:
            keep(C, Y, latent_eigenvalue)
        if next_size:
            del C  # those of two sizes need not be in memory
            of_all = bases if size in dense_sizes else None
            C = _larger_maps(sampled, Y, source, target, next_size, of_all, n_jobs)
    return C, weight, error, Y, latent_eigenvalue


class _Sampled(NamedTuple):
    """What Consistent ZoomOut holds of a shape in memory: its functions at its samples.

    ``eigenvalue (k,)``; ``Phi (s, >= k)`` and ``area (s,)`` there; the vertices nearest to each
    sample, ``around (s, w)``.
    """

    eigenvalue: Array
    Phi: Array
    area: Array
    around: Array
    n: int  # vertices of the shape


def _check_samples(sampled, k):
    """ValueError where a shape has samples, not all its vertices, too few for k functions."""
    least = PER_FUNCTION * k
    fewest = min((len(one.area) for one in sampled if len(one.area) < one.n), default=least)
    if fewest < least:
        raise ValueError(
            f"maps of k = {k} functions need {least} spread vertices or more; found {fewest}: "
            f"give n_samples={least} or more, n_samples=0 for all vertices, or a smaller k"
        )


def sample(basis: Basis, vertex: Array | None, k: int, n_around: int) -> _Sampled:
    """A shape at some of its vertices, or at all where None, and so many around each."""
    vertex = np.arange(len(basis.area)) if vertex is None else vertex
    around = vertex[:, None]
    if n_around > 1:
        first = np.arange(1, min(n_around, len(basis.X)) + 1)
        around = cKDTree(basis.X).query(basis.X[vertex], first)[1]
    functions = basis.eigenvalue[:k], basis.Phi[vertex], basis.area[vertex]
    return _Sampled(*functions, around, len(basis.area))


def _larger_maps(sampled, Y, source, target, k, bases, n_jobs=1):
    """Maps ``(p, k, k)`` from the matches of latent functions (eq. 3), one step of ZoomOut each.

    Parameters
    ----------
    sampled : list of Sampled
        Vertices of every shape for which matches are looked for.
    Y : float ndarray (n, size, m)
        Latent bases, of a smaller size.
    bases : sequence of Basis, optional
        All vertices of every shape, where matches are looked for between the samples, too; one or a
        few shapes are asked for at a time.
    """
    size = Y.shape[1]
    C = np.empty((len(target), k, k))
    match = _sample_matches(sampled, Y, source, target, n_jobs)

    def solver_and_query(j):
        """The least squares of shape j, factored, and what is looked for."""
        F = np.ascontiguousarray(sampled[j].Phi[:, :k])
        root = np.sqrt(sampled[j].area)
        solve = np.linalg.pinv(F * root[:, None]) * root  # (k, s)
        return solve, as_queries(F[:, :size] @ Y[j])

    def maps_from(i):
        """The maps from shape i into some of the others."""
        Phi = np.ascontiguousarray((sampled[i] if bases is None else bases[i]).Phi[:, :k])
        if bases is not None:
            rows = np.ascontiguousarray(as_candidates(Phi[:, :size] @ Y[i]).T)
        for r in some_maps[source[some_maps] == i]:
            solve, query = of_target[target[r]]
            found = match[r]
            if bases is not None:
                found = nearest_around(query, rows, sampled[i].around[found])
            C[r] = solve @ Phi.take(found, axis=0)

    for begin in range(0, len(sampled), TARGETS):
        some = range(begin, min(begin + TARGETS, len(sampled)))
        of_target = dict(zip(some, in_threads(solver_and_query, some, n_jobs), strict=True))
        some_maps = np.flatnonzero((target >= begin) & (target < begin + TARGETS))
        in_threads(maps_from, np.unique(source[some_maps]), n_jobs)
    return C


def _sample_matches(sampled, Y, source, target, n_jobs=1):
    """For every map, the source's sample that is nearest to each of the target's (eq. 3).

    Maps there and back between two shapes take one matrix product.
    """
    row = {pair: r for r, pair in enumerate(zip(source.tolist(), target.tolist(), strict=True))}
    match: list[Array] = [np.empty(0, np.int64)] * len(row)

    def functions(i):
        return as_candidates(sampled[i].Phi[:, : Y.shape[1]] @ Y[i])

    def match_pair(pair):
        i, j = pair
        query = of_shape[j].T.copy()
        query[:, -1] = -1  # as of as_queries
        if (j, i) in row:
            match[row[i, j]], match[row[j, i]] = nearest_both_ways(query, of_shape[i])
        else:
            match[row[i, j]] = nearest_float32(query, of_shape[i])

    of_shape = in_threads(functions, range(len(sampled)), n_jobs)
    in_threads(match_pair, [(i, j) for i, j in row if i < j or (j, i) not in row], n_jobs)
    return match


def frozen_basis(C_out: Array, C_in: Array, Y: Array) -> Array:
    """Latent basis of one shape from its maps to and from others whose bases stay (eq. 3).

    One block of the unknowns of :func:`latent_basis`: minimises
    sum_j |C_out_j Y_new - Y_j|^2 + |C_in_j Y_j - Y_new|^2.

    Parameters
    ----------
    C_out, C_in : float ndarray (p, k, k)
        Functional maps from the new shape to the others, and from them to it.
    Y : float ndarray (p, k, m)
        The others' bases.

    Returns
    -------
    float ndarray (k, m)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.latent import frozen_basis
    >>> Y = np.array([[[1.0], [2.0]]])
    >>> frozen_basis(np.eye(2)[None], np.eye(2)[None], Y).tolist()
    [[1.0], [2.0]]
    """
    k = C_out.shape[1]
    left = len(Y) * np.eye(k) + np.einsum("pab,pac->bc", C_out, C_out)
    right = np.einsum("pab,pac->bc", C_out, Y) + np.einsum("pab,pbc->ac", C_in, Y)
    return np.linalg.solve(left, right)


def _latent_basis_of_new(new, others, Y, C, *, step=5, n_samples=N_SAMPLES, iterations=2):
    """Latent basis of a new shape, those of all others frozen: Consistent ZoomOut of one shape.

    It starts from the initial maps of the others; in every round the rows of the first latent
    functions are matched with those of each of the others, on samples, and more of the functions
    carried over; the last iterations use all vertices.

    Parameters
    ----------
    new : Basis
    others : list of Basis
    Y : float ndarray (p, k, m)
        Latent bases of the others.
    C : list of float ndarray (k_init, k_init)
        Initial maps from each of the others to the new shape.
    step : int
        Growth per round.
    n_samples : int
        Spread vertices that are the samples; 0 for all.
    iterations : int
        Of :func:`frozen_basis`, with the first ``FINAL`` of the others.

    Returns
    -------
    float ndarray (k, m)
    """
    _, k, m = Y.shape
    k_init = len(C[0])
    F = [other.Phi[:, :k] @ y for other, y in zip(others, Y, strict=True)]  # latent functions
    y = np.mean(
        [c @ y[:k_init, : min(k_init, m)] for c, y in zip(C, Y, strict=True)], axis=0
    )  # (k_init, <= m)
    samples = new.sample_vertices_of(n_samples)
    among = [other.sample_vertices_of(n_samples) for other in others]
    root = np.sqrt(new.area[samples])
    while len(y) < k:
        size = min(len(y) + step, k)
        query = new.Phi[samples, : len(y)] @ y
        solve = np.linalg.pinv(new.Phi[samples, :size] * root[:, None]) * root
        carried = 0
        for vertices, functions in zip(among, F, strict=True):
            rows = functions[vertices]
            match = nearest_rows(query, rows[:, : query.shape[1]])
            carried = carried + rows[match, : min(size, m)]
        y = solve @ carried / len(others)
    Phi = new.Phi[:, :k]
    for _ in range(iterations):
        query = Phi @ y
        C_out, C_in = [], []
        for other, functions in zip(others[:_FINAL], F, strict=False):
            Psi = other.Phi[:, :k]
            C_out.append(fmap_from_match(Phi, Psi, other.mass, nearest_rows(functions, query)))
            C_in.append(fmap_from_match(Psi, Phi, new.mass, nearest_rows(query, functions)))
        y = frozen_basis(np.stack(C_out), np.stack(C_in), Y[:_FINAL])
    return y


_NEIGHBOURS = 6  # shapes of the network whose maps a new one has


def nearest_spectra(own: Array, others: Sequence[Array], k: int) -> list[int]:
    """The first of the others, and five whose first k eigenvalues are most like its `own`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.latent import nearest_spectra
    >>> spectra = [np.array([0.0, i, 2 * i]) for i in (9, 1, 5, 2, 8, 3, 7, 4)]
    >>> nearest_spectra(np.array([0.0, 1, 2]), spectra, 3)
    [0, 1, 3, 5, 7, 2]
    """
    distance = spectral_distance([values[:k] for values in (own, *others)])[0]
    order = np.argsort(distance[2:], kind="stable")  # without itself and the first
    return [0, *(1 + order[: _NEIGHBOURS - 1]).tolist()]


def place(
    new: Basis,
    others: list[Basis],
    Y: Array,
    starts: list[RigidTransform],
    *,
    k_init: int = 20,
    step: int = 5,
    n_samples: int = N_SAMPLES,
    **options: Any,
) -> Array:
    """Latent basis of a new shape from its maps to others, whose bases stay.

    Parameters
    ----------
    new : Basis
    others : list of Basis
        Of :func:`nearest_spectra`.
    Y : float ndarray (p, k, m)
        Their latent bases.
    starts : list of tuple (R, t)
        About the rigid transforms of the new shape onto each of them.
    k_init, step, n_samples : see :func:`s4a.analyse`
    **options
        Of :func:`s4a.method.initial_map.initial_map`.

    Returns
    -------
    float ndarray (k, m)
    """
    maps = []
    for other, start in zip(others, starts, strict=True):
        R, t = realign(new.cloud, other.cloud, start)
        back = R.T, -R.T @ t
        maps.append(initial_map(other, new, back, k_init=k_init, n_samples=n_samples, **options).C)
    return _latent_basis_of_new(new, others, Y, maps, step=step, n_samples=n_samples)


def latent_of_new(Y: Array, eigenvalues: Array, latent_eigenvalue: Array, norm: str) -> xr.Dataset:
    """``/latent`` of new shapes: bases, shape differences, distances to the limit shape (eq. 5).

    Parameters
    ----------
    Y : float ndarray (n, k, m)
    eigenvalues : float ndarray (n, >= k)
        Of the shapes, for unit area.
    latent_eigenvalue : float ndarray (m,)
        Of the network.
    norm : see :func:`s4a.analyse`
    """
    D = area_differences(Y)
    # one by one, so that the last digit does not depend on the others
    distance = [distance_to_identity(one[None], latent_eigenvalue, norm)[0] for one in D]
    return dataset(
        latent_basis=Y,
        latent_eigenvalue=latent_eigenvalue,
        area_difference=D,
        conformal_difference=conformal_differences(Y, eigenvalues, latent_eigenvalue),
        distance_to_limit=np.array(distance),
    )
