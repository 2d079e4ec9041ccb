"""Consistent latent basis and Consistent ZoomOut (3.4, eq. 3; Huang, Ren, Wonka, Ovsjanikov 2020).

The latent bases synchronise the maps of the network: C_ij Y_i = Y_j in the least-squares sense.
Y_i is k x m.  The latent functions are Phi_i Y_i, the Y_i of eq. 3 and 6, and U_i Phi_i Y_i at full
resolution (eq. 7).
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

from s4a.geometry.align import RigidTransform
from s4a.method.alignment import pair_transform
from s4a.method.fmap import fmap_from_match, orthogonality_error
from s4a.method.initial_map import initial_map
from s4a.method.median import area_differences, conformal_differences, distance_to_identity
from s4a.method.nearest import (
    as_candidates,
    as_queries,
    nearest_around,
    nearest_bidirectional,
    nearest_float32,
    nearest_rows,
)
from s4a.method.network import (
    cycle_errors,
    cycle_weights,
    in_threads,
    program_errors,
    spectral_distance,
    three_cycles,
)
from s4a.method.shape import Basis
from s4a.options import N_SAMPLES, PER_FUNCTION
from s4a.schema import Array, dataset

log = logging.getLogger(__name__)

_N_FINAL = 3  # shapes of a study that the final iterations of an out-of-sample shape use
TARGETS = 256  # shapes whose least-squares factors are in memory at once, 0.3 GB
DENSE_ITERATIONS = 4  # final iterations of Consistent ZoomOut that also search between the samples
N_AROUND = 32  # vertices around a sample that they search
ROUGH, FINE = 1e-4, 1e-6  # tolerances of the latent basis: intermediate and final
MOST_ITERATIONS = 100  # for the latent basis

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
    """Return the quadratic form sum w |C_ij Y_i - Y_j|^2 of the stacked Y as a matrix product.

    A map C_ij adds four blocks of k x k::

                 i          j
        i    w C^T C    -w C^T
        j     -w C        w I

    The form is never assembled.  Every shape has a row of blocks, one for itself and one for each
    neighbour in the network, so memory is linear in the number of maps.

    Parameters
    ----------
    C : float ndarray (p, k, k)
    source, target, weight : ndarray (p,)
    n : int
        Number of shapes.
    dtype : type
        Precision of the products.
    n_jobs : int
        Threads; the result does not depend on it.

    Returns
    -------
    callable
        Maps vectors ``(n k, q)`` to vectors of the same shape.
    """
    k = C.shape[1]
    maps_of: list[list[int]] = [[] for _ in range(n)]
    for r, (i, j) in enumerate(zip(source.tolist(), target.tolist(), strict=True)):
        maps_of[i].append(r)
        maps_of[j].append(r)
    neighbours, rows = [], []
    for shape, incident in enumerate(maps_of):  # in turn, so that each row is in memory once
        blocks = {shape: np.zeros((k, k))}
        for r in incident:
            c, i, j, w = C[r], int(source[r]), int(target[r]), weight[r]
            if shape == i:
                blocks[i] += w * (c.T @ c)
                blocks[j] = blocks.get(j, 0) - w * c.T
            else:
                blocks[j] += w * np.eye(k)
                blocks[i] = blocks.get(i, 0) - w * c
        columns = sorted(blocks)
        neighbours.append(columns)
        rows.append(np.concatenate([blocks[j] for j in columns], axis=1, dtype=dtype))

    def product(shapes, V):
        return [rows[i] @ V[neighbours[i]].reshape(-1, V.shape[2]) for i in shapes]

    shares = np.array_split(np.arange(n), effective_n_jobs(n_jobs))

    def apply(V):
        V = np.asarray(V, dtype).reshape(n, k, -1)
        if V.shape[2] == 1:  # one vector takes no longer than starting a thread
            return np.concatenate(product(range(n), V))
        parts = in_threads(lambda shapes: product(shapes, V), shares, n_jobs)
        return np.concatenate([block for part in parts for block in part])

    return apply


def _spanning_tree_bases(C, source, target, n):
    """Initial guess of all Y ``(n, k, k)``: maps composed along a spanning tree.

    Y is the identity at the root, the shape with the most outgoing maps.
    """
    k = C.shape[1]
    adjacency = np.zeros((n, n))
    adjacency[source, target] = 1
    root = int(np.argmax(adjacency.sum(1)))
    order, parent = breadth_first_order(adjacency, root)
    if len(order) < n:
        raise ValueError(
            f"the network is not connected: {len(order)} of {n} shapes are reached "
            f"from shape {root}; use more pairs"
        )
    row = {pair: r for r, pair in enumerate(zip(source.tolist(), target.tolist(), strict=True))}
    Y = np.zeros((n, k, k))
    Y[root] = np.eye(k)
    for j in order[1:]:
        Y[j] = C[row[int(parent[j]), int(j)]] @ Y[parent[j]]
    return Y


def smallest_eigenvectors(apply: _Form, guess: Array, *, tolerance: float = FINE) -> Array:
    """Return the eigenvectors of the smallest eigenvalues of a semi-definite form ``(n, m)``.

    Chebyshev-filtered subspace iteration (Zhou, Saad, Tiago, Chelikowsky 2006): each iteration
    damps the eigenvalues above the largest Ritz value by a Chebyshev polynomial of the form, and
    solves the small eigenproblem in the subspace.  Nothing is assembled or factored: memory is
    linear in the number of maps, and time at most that of a Cholesky factorisation.

    Parameters
    ----------
    apply : callable
        Product of the form with vectors.
    guess : float ndarray (n, m)
        Initial vectors, close to the eigenvectors if possible.
    tolerance : float
        Largest residual of a vector, as a share of the largest eigenvalue.
    """
    n, m = guess.shape
    n_spare = min(n - m, max(4, m // 10))  # the last vectors of a subspace converge slowest
    spare = np.cos(np.outer(np.arange(n) + 1.0, np.arange(n_spare) + 1.0) * 0.7)  # like random
    V = np.linalg.qr(np.concatenate([guess, spare], axis=1))[0]  # (n, m + n_spare)
    form = LinearOperator((n, n), lambda v: apply(v.reshape(n, 1)).ravel(), dtype=float)
    largest = eigsh(form, 1, which="LA", tol=1e-2, v0=spare[:, 0], return_eigenvectors=False)[0]
    top = 1.02 * largest  # above all eigenvalues, though `largest` is 1 % uncertain
    for _ in range(MOST_ITERATIONS):
        LV = apply(V)
        ritz, R = np.linalg.eigh(V.T @ LV)
        V = V @ R
        residual = np.linalg.norm(LV @ R[:, :m] - V[:, :m] * ritz[:m], axis=0)  # (m,)
        if residual.max() <= tolerance * top:
            return V[:, :m]
        V = np.linalg.qr(_chebyshev_filter(apply, V, ritz[0], ritz[-1], top))[0]
    log.warning("the latent basis reached %d iterations before its tolerance", MOST_ITERATIONS)
    return V[:, :m]


def _chebyshev_filter(apply, V, least, cut, top):
    """T(L) V with the Chebyshev polynomial T that is small on [cut, top] and 1 at `least`.

    Degree d damps by about cosh(2 d sqrt(cut / top)), a factor of ten here.
    """
    half, middle = (top - cut) / 2, (top + cut) / 2
    if half <= 1e-9 * top:  # no eigenvalue lies above the subspace
        return V
    degree = int(np.clip(1.5 * np.sqrt(top / max(cut, 1e-4 * top)), 6, 40))
    ratio = ratio_1 = half / (least - middle)
    new = (apply(V) - middle * V) * (ratio_1 / half)
    for _ in range(degree - 1):  # the recurrence of the T_d, scaled to be 1 at `least`
        next_ratio = 1 / (2 / ratio_1 - ratio)
        V, new = new, (apply(new) - middle * new) * (2 * next_ratio / half) - ratio * next_ratio * V
        ratio = next_ratio
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

    Minimises sum w |C_ij Y_i - Y_j|^2 subject to sum Y_i^T Y_i = n I, then rotates the latent space
    so that mean Y_i^T Lambda_i Y_i = Lambda^0 is diagonal and ascending.

    Parameters
    ----------
    C : float ndarray (p, k, k)
        Directed maps, from functions of the source to functions of the target.
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
    guess = _spanning_tree_bases(C, source, target, n).reshape(n * k, k)[:, :m]
    dtype = np.float32 if tolerance >= ROUGH else float
    form = consistency_form(C, source, target, weight, n, dtype=dtype, n_jobs=n_jobs)
    Y = smallest_eigenvectors(form, guess, tolerance=tolerance).reshape(n, k, m) * np.sqrt(n)
    mean = np.einsum("nkl,nk,nkm->lm", Y, eigenvalues[:, :k], Y) / n  # (m, m)
    latent_eigenvalue, rotation = np.linalg.eigh(mean)
    Y = Y @ rotation
    total = Y.sum(0)  # (k, m)
    largest = total[np.abs(total).argmax(0), np.arange(m)]
    Y *= np.where(largest < 0, -1.0, 1.0)  # a convention: eigenvectors have no sign
    return Y, np.maximum(latent_eigenvalue, 0.0)


def isometric_maps(C: Array, source: Array, target: Array) -> Array:
    """Replace both maps of each pair by the more orthogonal one and its transpose ``(p, k, k)``.

    The maps of an isometry are orthogonal, and transposes of each other.  This is pyFM's variant of
    Consistent ZoomOut (``FMN.set_isometries``).

    Parameters
    ----------
    C : float ndarray (p, k, k)
    source, target : int ndarray (p,)
        Shapes of each map.  A map without a map in the other direction stays as it is.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.latent import isometric_maps
    >>> isometric_maps(np.array([[[1.0]], [[3.0]]]), np.array([0, 1]), np.array([1, 0])).tolist()
    [[[1.0]], [[1.0]]]
    """
    row = {pair: r for r, pair in enumerate(zip(source.tolist(), target.tolist(), strict=True))}
    error = [orthogonality_error(c) for c in C]
    C = C.copy()
    for (i, j), r in row.items():
        back = row.get((j, i), r)
        if r < back:
            better, worse = (r, back) if error[r] <= error[back] else (back, r)
            C[worse] = C[better].T
    return C


def latent_size(n_latent: int | None, k: int, k_final: int) -> int:
    """Return the latent dimension at size k: at most k, in proportion to `n_latent` / `k_final`."""
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
    isometric: bool = False,
    samples: list[Array] | None = None,
    dense_iterations: int = DENSE_ITERATIONS,
    n_jobs: int | None = 1,
    progress: Callable[..., Any] | None = None,
    keep: Callable[..., Any] | None = None,
    keep_matches: Callable[..., Any] | None = None,
) -> tuple[Array, Array, Array, Array, Array]:
    """Refine the maps of a network by Consistent ZoomOut (4.2) until all are k x k.

    Each iteration embeds every shape in the latent space (rows of Phi_i Y_i), matches nearest
    neighbours for every map (eq. 3) and solves for larger maps by least squares.  All of this uses
    `samples` only, on which Phi^T A of eq. 1 is not an inverse of Phi.  Matches of samples are
    accurate to the spacing of the samples, so the final `dense_iterations` also search the
    ``N_AROUND`` vertices around each match.  With all vertices as samples the method is that of the
    paper.  The latent basis has the tolerance ``ROUGH``, and ``FINE`` at the end.

    Parameters
    ----------
    bases : sequence of Basis
        The shapes of the network at low resolution, with at least k functions.  Each is accessed
        once, and again in each of the final `dense_iterations`, so it may be read on access.
    C : float ndarray (p, k_init, k_init)
    source, target : int ndarray (p,)
        Indices of the shapes of each map.
    k : int
        Final size.
    step : int
        Growth per iteration.
    n_latent : int, optional
        Final latent dimension; k by default.
    weights : {"cycles", "linear_program", "equal"}
        Weights of the maps: by cycle error, by the errors of
        :func:`s4a.method.network.program_errors`, or 1 for all.
    isometric : bool
        Whether :func:`isometric_maps` come before each latent basis, also the last.
    samples : list of int ndarray, optional
        Farthest-point samples of every shape, at least 2 k unless they are all vertices; all
        vertices by default.
    dense_iterations : int
        Final iterations that also search between the samples.
    n_jobs : int
        Threads; the result does not depend on it.
    progress : callable, optional
        Called with the current size after each iteration.
    keep : callable, optional
        Called with C, Y, the latent eigenvalues, weights and cycle errors of each iteration.
    keep_matches : callable, optional
        Called with the matches of each iteration (eq. 3): for every map the matched coarse vertices
        of the source, and the coarse vertices of the target.

    Returns
    -------
    C : float ndarray (p, k, k)
    weight, error : float ndarray (p,)
        Weights and cycle errors of the final maps.
    Y, latent_eigenvalue : see :func:`latent_basis`

    Raises
    ------
    ValueError
        If there are too few samples for maps of k functions.
    """
    cycles = three_cycles(source.tolist(), target.tolist())
    dense_iterations = 0 if samples is None else dense_iterations
    n_around = N_AROUND if dense_iterations else 1
    sampled = [
        sample(basis, None if samples is None else samples[i], k, n_around)
        for i, basis in enumerate(bases)
    ]
    eigenvalues = np.stack([shape.eigenvalue for shape in sampled])
    sizes = [*range(C.shape[1], k, step), k]
    if samples is not None and len(sizes) > 1:
        _check_samples(sampled, k)
    dense_sizes = sizes[:-1][max(len(sizes) - 1 - dense_iterations, 0) :]
    for size, next_size in zip(
        sizes, [*sizes[1:], None], strict=True
    ):  # the last only solves for Y
        C = isometric_maps(C, source, target) if isometric else C
        by_program = weights == "linear_program"
        error = program_errors(C, cycles) if by_program else cycle_errors(C, cycles, n_jobs=n_jobs)
        weight = np.ones(len(C)) if weights == "equal" else cycle_weights(error)
        m = latent_size(n_latent, size, k)
        tolerance = ROUGH if next_size else FINE
        Y, latent_eigenvalue = latent_basis(
            C, source, target, weight, eigenvalues, m, tolerance=tolerance, n_jobs=n_jobs
        )
        if progress:
            progress(size)
        if keep:
            keep(C, Y, latent_eigenvalue, weight, error)
        if next_size:
            del C  # so that maps of only one size are in memory
            dense_bases = bases if size in dense_sizes else None
            C, match = _larger_maps(sampled, Y, source, target, next_size, dense_bases, n_jobs)
        elif keep_matches:
            match = _sample_matches(sampled, Y, source, target, n_jobs)
        if keep_matches:
            if size not in dense_sizes:  # matches are between samples
                match = [sampled[i].vertex[m] for i, m in zip(source, match, strict=True)]
            keep_matches(match, [sampled[j].vertex for j in target])
    return C, weight, error, Y, latent_eigenvalue


class _Sampled(NamedTuple):
    """The functions of a shape at its samples, which Consistent ZoomOut holds in memory.

    ``eigenvalue (k,)``; ``Phi (s, >= k)`` and ``area (s,)`` at the samples; the vertices nearest to
    each sample, ``around (s, w)``.
    """

    eigenvalue: Array
    Phi: Array
    area: Array
    around: Array
    n: int  # vertices of the shape

    @property
    def vertex(self) -> Array:
        """The samples, as vertices ``(s,)``."""
        return self.around[:, 0]


def _check_samples(sampled, k):
    """Raise ValueError if a shape has too few samples for k functions."""
    least = PER_FUNCTION * k
    fewest = min((len(s.area) for s in sampled if len(s.area) < s.n), default=least)
    if fewest < least:
        raise ValueError(
            f"maps of k = {k} functions need at least {least} samples; found {fewest}: "
            f"give n_samples={least} or more, n_samples=0 for all vertices, or a smaller k"
        )


def sample(basis: Basis, vertex: Array | None, k: int, n_around: int) -> _Sampled:
    """Return a shape at some of its vertices, or at all if None, and the vertices around each."""
    vertex = np.arange(len(basis.area)) if vertex is None else vertex
    around = vertex[:, None]
    if n_around > 1:
        ranks = np.arange(1, min(n_around, len(basis.X)) + 1)
        around = cKDTree(basis.X).query(basis.X[vertex], ranks)[1]
    functions = basis.eigenvalue[:k], basis.Phi[vertex], basis.area[vertex]
    return _Sampled(*functions, around, len(basis.area))


def _larger_maps(sampled, Y, source, target, k, bases, n_jobs=1):
    """Maps ``(p, k, k)`` and the matches of the latent functions that they follow from (eq. 3).

    Parameters
    ----------
    sampled : list of _Sampled
        The samples that are matched.
    Y : float ndarray (n, size, m)
        Latent bases of a smaller size.
    bases : sequence of Basis, optional
        All vertices of every shape, to search between the samples, too; a few shapes are accessed
        at a time.
    """
    size = Y.shape[1]
    C = np.empty((len(target), k, k))
    match = _sample_matches(sampled, Y, source, target, n_jobs)

    def solver_and_query(j):
        """Factored least squares of shape j, and the rows to be matched."""
        F = np.ascontiguousarray(sampled[j].Phi[:, :k])
        root = np.sqrt(sampled[j].area)
        solve = np.linalg.pinv(F * root[:, None]) * root  # (k, s)
        return solve, as_queries(F[:, :size] @ Y[j])

    def maps_from(i):
        """Compute the maps from shape i to the targets of this block."""
        Phi = np.ascontiguousarray((sampled[i] if bases is None else bases[i]).Phi[:, :k])
        if bases is not None:
            rows = np.ascontiguousarray(as_candidates(Phi[:, :size] @ Y[i]).T)
        for r in some_maps[source[some_maps] == i]:
            solve, query = prepared[target[r]]
            matched = match[r]
            if bases is not None:
                match[r] = matched = nearest_around(query, rows, sampled[i].around[matched])
            C[r] = solve @ Phi.take(matched, axis=0)

    for begin in range(0, len(sampled), TARGETS):
        block = range(begin, min(begin + TARGETS, len(sampled)))
        prepared = dict(zip(block, in_threads(solver_and_query, block, n_jobs), strict=True))
        some_maps = np.flatnonzero((target >= begin) & (target < begin + TARGETS))
        in_threads(maps_from, np.unique(source[some_maps]), n_jobs)
    return C, match


def _sample_matches(sampled, Y, source, target, n_jobs=1):
    """Nearest source sample of each target sample, for every map (eq. 3).

    Both directions between two shapes take one matrix product.
    """
    row = {pair: r for r, pair in enumerate(zip(source.tolist(), target.tolist(), strict=True))}
    match: list[Array] = [np.empty(0, np.int64)] * len(row)

    def functions(i):
        return as_candidates(sampled[i].Phi[:, : Y.shape[1]] @ Y[i])

    def match_pair(pair):
        i, j = pair
        query = candidates[j].T.copy()
        query[:, -1] = -1  # the form of as_queries
        if (j, i) in row:
            match[row[i, j]], match[row[j, i]] = nearest_bidirectional(query, candidates[i])
        else:
            match[row[i, j]] = nearest_float32(query, candidates[i])

    candidates = in_threads(functions, range(len(sampled)), n_jobs)
    in_threads(match_pair, [(i, j) for i, j in row if i < j or (j, i) not in row], n_jobs)
    return match


def frozen_basis(C_out: Array, C_in: Array, Y: Array) -> Array:
    """Compute the latent basis of one shape from its maps to and from others, held fixed (eq. 3).

    One block of the unknowns of :func:`latent_basis`: minimises
    sum_j |C_out_j Y_new - Y_j|^2 + |C_in_j Y_j - Y_new|^2.

    Parameters
    ----------
    C_out, C_in : float ndarray (p, k, k)
        Functional maps from the new shape to the others, and from the others to the new shape.
    Y : float ndarray (p, k, m)
        Latent bases of the others.

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


def _zoomout_of_new(new, others, Y, C, *, step=5, n_samples=N_SAMPLES, iterations=2):
    """Latent basis of a new shape by Consistent ZoomOut, with all other bases held fixed.

    Initialised by the maps of the others.  Each iteration matches the rows of the first latent
    functions with those of each other shape, on samples, and transfers more of the functions; the
    final iterations use all vertices.

    Parameters
    ----------
    new : Basis
    others : list of Basis
    Y : float ndarray (p, k, m)
        Latent bases of the others.
    C : list of float ndarray (k_init, k_init)
        Initial maps from each of the others to the new shape.
    step : int
        Growth per iteration.
    n_samples : int
        Farthest-point samples; 0 for all vertices.
    iterations : int
        Iterations of :func:`frozen_basis`, with the first ``_N_FINAL`` of the others.

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
    samples_of_others = [other.sample_vertices_of(n_samples) for other in others]
    root = np.sqrt(new.area[samples])
    while len(y) < k:
        size = min(len(y) + step, k)
        query = new.Phi[samples, : len(y)] @ y
        solve = np.linalg.pinv(new.Phi[samples, :size] * root[:, None]) * root
        transferred = 0
        for vertices, functions in zip(samples_of_others, F, strict=True):
            rows = functions[vertices]
            match = nearest_rows(query, rows[:, : query.shape[1]])
            transferred = transferred + rows[match, : min(size, m)]
        y = solve @ transferred / len(others)
    Phi = new.Phi[:, :k]
    for _ in range(iterations):
        query = Phi @ y
        C_out, C_in = [], []
        for other, functions in zip(others[:_N_FINAL], F, strict=False):
            Psi = other.Phi[:, :k]
            C_out.append(fmap_from_match(Phi, Psi, other.mass, nearest_rows(functions, query)))
            C_in.append(fmap_from_match(Psi, Phi, new.mass, nearest_rows(query, functions)))
        y = frozen_basis(np.stack(C_out), np.stack(C_in), Y[:_N_FINAL])
    return y


_NEIGHBOURS = 6  # shapes of the network to which an out-of-sample shape is mapped


def nearest_spectra(eigenvalue: Array, others: Sequence[Array], k: int) -> list[int]:
    """Return the index 0 and those of the five other shapes with the most similar k eigenvalues.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.latent import nearest_spectra
    >>> spectra = [np.array([0.0, i, 2 * i]) for i in (9, 1, 5, 2, 8, 3, 7, 4)]
    >>> nearest_spectra(np.array([0.0, 1, 2]), spectra, 3)
    [0, 1, 3, 5, 7, 2]
    """
    distance = spectral_distance([values[:k] for values in (eigenvalue, *others)])[0]
    order = np.argsort(distance[2:], kind="stable")  # without the shape itself and index 0
    return [0, *(1 + order[: _NEIGHBOURS - 1]).tolist()]


def out_of_sample_basis(
    new: Basis,
    others: list[Basis],
    Y: Array,
    transforms: list[RigidTransform],
    *,
    k_init: int = 20,
    step: int = 5,
    n_samples: int = N_SAMPLES,
    alignment: str = "search",
    **options: Any,
) -> Array:
    """Compute the latent basis of an out-of-sample shape; the bases of the others stay fixed.

    Parameters
    ----------
    new : Basis
    others : list of Basis
        Shapes of :func:`nearest_spectra`.
    Y : float ndarray (p, k, m)
        Latent bases of the others.
    transforms : list of tuple (R, t)
        Approximate rigid transforms of the new shape onto each of the others.
    k_init, step, n_samples, alignment : see :func:`s4a.analyse`
    **options
        Options of :func:`s4a.method.initial_map.initial_map`.

    Returns
    -------
    float ndarray (k, m)
    """
    maps = []
    for other, transform in zip(others, transforms, strict=True):
        R, t = pair_transform(new, other, transform, alignment)
        back = R.T, -R.T @ t
        settings = {"k_init": k_init, "n_samples": n_samples, "alignment": alignment, **options}
        maps.append(initial_map(other, new, back, **settings).C)
    return _zoomout_of_new(new, others, Y, maps, step=step, n_samples=n_samples)


def out_of_sample_latent(
    Y: Array, eigenvalues: Array, latent_eigenvalue: Array, norm: str
) -> xr.Dataset:
    """Return ``/latent`` of new shapes: bases, shape differences, distances to the limit (eq. 5).

    Parameters
    ----------
    Y : float ndarray (n, k, m)
    eigenvalues : float ndarray (n, >= k)
        Laplacian eigenvalues of the shapes, for unit area.
    latent_eigenvalue : float ndarray (m,)
        Latent eigenvalues of the network.
    norm : see :func:`s4a.analyse`
    """
    D = area_differences(Y)
    # separately, so that the last digit does not depend on the other shapes
    distance = [distance_to_identity(D_i[None], latent_eigenvalue, norm)[0] for D_i in D]
    return dataset(
        latent_basis=Y,
        latent_eigenvalue=latent_eigenvalue,
        area_difference=D,
        conformal_difference=conformal_differences(Y, eigenvalues, latent_eigenvalue),
        distance_to_limit=np.array(distance),
    )
