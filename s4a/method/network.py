"""The network of functional maps (3.4): which pairs, how far their cycles close, weights from that.

The maps C_ij of a 3-cycle i -> j -> k -> i close where C_ki C_jk C_ij = I.  What they lack is the
cycle error e of each of them, averaged over its cycles (:func:`cycle_errors`), and gives its weight
exp(-(e / s)^2 / 2) in the latent basis (:func:`cycle_weights`).
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from joblib import effective_n_jobs
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra, shortest_path

from s4a.schema import Array


def spectral_distance(eigenvalues: Array | list[Array]) -> Array:
    """Distances of shapes by their spectra ``(n, n)``: RMS difference of log eigenvalues.

    Parameters
    ----------
    eigenvalues : float ndarray (n, k)
        For unit area, the first of each 0.
    """
    x = np.log(np.maximum(np.asarray(eigenvalues, float)[:, 1:], 1e-12))
    return np.sqrt(((x[:, None] - x[None]) ** 2).mean(axis=2))


def choose_pairs(distance: Array, n_pairs: int) -> Array:
    """The unordered pairs of a network: connected, with as many triangles as the budget allows.

    First a minimum spanning tree (connectivity), then for every shape a second edge to a neighbour
    of its tree parent, which closes a triangle, then the pairs that are nearest for one of their
    two shapes.

    Parameters
    ----------
    distance : float ndarray (n, n)
        Symmetric dissimilarity of the shapes; near pairs have better initial maps.
    n_pairs : int
        Budget; the clique where it is at least n (n - 1) / 2.

    Returns
    -------
    pairs : int ndarray (p, 2)
        Smaller index first, sorted.

    Raises
    ------
    ValueError
        When the budget cannot connect the shapes.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.network import choose_pairs
    >>> choose_pairs(np.array([[0, 1, 2.0], [1, 0, 1.5], [2, 1.5, 0]]), 2).tolist()
    [[0, 1], [1, 2]]
    """
    n = len(distance)
    if n < 2:
        raise ValueError(f"a network needs at least 2 shapes, found {n}")
    if int(n_pairs) != n_pairs or n_pairs < n - 1:
        raise ValueError(
            f"n_pairs = {n_pairs!r} cannot connect {n} shapes: give an integer from {n - 1} "
            f"(a tree) to {n * (n - 1) // 2} (all pairs)"
        )
    wanted = np.concatenate([*_tree_and_closing(distance), _by_nearness(distance)])  # most first
    key = wanted.min(axis=1) * n + wanted.max(axis=1)
    _, first = np.unique(key, return_index=True)
    chosen = key[np.sort(first)[: int(n_pairs)]]
    return np.stack(np.divmod(np.sort(chosen), n), axis=1)


def _tree_and_closing(distance):
    r"""Edges of a minimum spanning tree, and one more for each new shape that closes a triangle.

    Prim's algorithm from the most central shape.  A new shape is joined with its nearest shape in
    the tree, the parent, and then with the nearest of the parent's neighbours::

        parent --- neighbour
             \     .
              \   .   closing
               new

    Returns
    -------
    tree, closing : int ndarray (n - 1, 2), (n - 2, 2)
    """
    n = len(distance)
    root = int(np.argmin(distance.sum(axis=1)))
    parent = np.full(n, root)  # nearest shape in the tree, so far
    gap = distance[:, root].copy()
    gap[root] = np.inf
    outside = np.arange(n) != root
    adjacent = np.zeros((n, n), bool)
    tree, closing = [], []
    for _ in range(n - 1):
        left = np.flatnonzero(outside)
        new = left[gap[left].argmin()]
        near = np.flatnonzero(adjacent[parent[new]])
        if len(near):
            closing.append((new, near[distance[new, near].argmin()]))
        tree.append((new, parent[new]))
        adjacent[new, parent[new]] = adjacent[parent[new], new] = True
        outside[new] = False
        nearer = distance[:, new] < gap
        gap[nearer] = distance[nearer, new]
        parent[nearer & outside] = new
    return np.array(tree), np.array(closing, int).reshape(-1, 2)


def _by_nearness(distance):
    """All pairs ``(n (n-1) / 2, 2)``, first those that are nearest for one of their two shapes."""
    apart = distance.copy()
    np.fill_diagonal(apart, np.inf)
    rank = np.argsort(np.argsort(apart, axis=1, kind="stable"), axis=1)  # j is i's rank[i, j]-th
    i, j = np.triu_indices(len(distance), 1)
    order = np.lexsort((distance[i, j], np.minimum(rank, rank.T)[i, j]))
    return np.stack([i, j], axis=1)[order]


def three_cycles(source: list[int], target: list[int]) -> Array:
    """Rows of the directed maps i -> j, j -> k, k -> i that close a 3-cycle ``(c, 3)``.

    Each cycle comes once.

    Parameters
    ----------
    source, target : list of int
        Shapes of each map, (p,) long.

    Examples
    --------
    >>> from s4a.method.network import three_cycles
    >>> three_cycles([0, 1, 2], [1, 2, 0]).tolist()
    [[0, 1, 2]]
    """
    row = {pair: r for r, pair in enumerate(zip(source, target, strict=True))}
    onward = {}
    for i, j in row:
        onward.setdefault(i, []).append(j)
    cycles = [
        (row[i, j], row[j, k], row[k, i])
        for i, j in row
        for k in onward.get(j, [])
        if i < min(j, k) and j != k and (k, i) in row
    ]
    return np.array(cycles, np.int64).reshape(-1, 3)


def cycle_errors(C: Array, cycles: Array, k: int | None = None, *, n_jobs: int | None = 1) -> Array:
    """How far each map is from closing its 3-cycles: mean |C_ki C_jk C_ij - I|_F / sqrt(k).

    Of the product only the first `k` rows and columns are looked at, all by default; maps of
    different sizes can only be compared at one k.

    Parameters
    ----------
    C : float ndarray (p, K, K)
    cycles : int ndarray (c, 3)
        Of :func:`three_cycles`.
    k : int, optional
    n_jobs : int
        Threads; the result does not depend on it.

    Returns
    -------
    float ndarray (p,)
        NaN for maps in no 3-cycle.
    """
    k = k or C.shape[1]

    def errors_of(part):
        ij, jk, ki = part.T
        around = C[ki][:, :k] @ (C[jk] @ C[ij][:, :, :k])  # (c, k, k)
        return np.linalg.norm(around - np.eye(k), axis=(1, 2)) / np.sqrt(k)

    parts = np.array_split(cycles, len(cycles) // 32 + 1)  # few, so that products stay small
    error = np.concatenate(in_threads(errors_of, parts, n_jobs))
    total = np.bincount(cycles.ravel(), np.repeat(error, 3), len(C))
    count = np.bincount(cycles.ravel(), minlength=len(C))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def cycle_weights(error: Array) -> Array:
    """Weights exp(-(e / s)^2 / 2) of the maps from their cycle errors, s the median error ``(p,)``.

    Maps in no cycle get the median weight; a network without 3-cycles gets plain weights of 1.  No
    weight is under 0.01, so that a connected network stays connected.
    """
    known = np.isfinite(error)
    if not known.any() or np.nanmedian(error) < 1e-9:
        return np.ones(len(error))
    w = np.exp(-0.5 * (error / np.nanmedian(error)) ** 2)
    return np.maximum(np.where(known, w, np.nanmedian(w)), 0.01)


def connectivity(pairs: Array, n: int) -> dict[str, int]:
    """How well unordered pairs connect n shapes.

    Parameters
    ----------
    pairs : int ndarray (p, 2)
    n : int

    Returns
    -------
    dict of str to int
        ``components``; ``triangles``; ``in_no_triangle``, the shapes whose maps no 3-cycle can
        check; ``smallest_degree``; ``diameter``, the most maps from one shape to another (-1 where
        there is no way).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.network import connectivity
    >>> connectivity(np.array([[0, 1], [1, 2], [0, 2], [2, 3]]), 4)
    {'components': 1, 'triangles': 1, 'in_no_triangle': 1, 'smallest_degree': 1, 'diameter': 2}
    """
    A = np.zeros((n, n))
    pairs = np.asarray(pairs, int).reshape(-1, 2)
    A[pairs[:, 0], pairs[:, 1]] = 1
    A = np.maximum(A, A.T)
    through = np.diag(A @ A @ A) / 2  # triangles through each shape: closed walks of three steps
    steps = shortest_path(A, unweighted=True)
    return {
        "components": int(connected_components(A)[0]),
        "triangles": round(through.sum() / 3),
        "in_no_triangle": int((through == 0).sum()),
        "smallest_degree": int(A.sum(0).min()),
        "diameter": int(steps.max()) if np.isfinite(steps).all() else -1,
    }


def nearest_by_maps(pairs: Array, n: int, first: list[int], most: int) -> Array:
    """The shapes that the fewest maps lead to from some of them, these included.

    Parameters
    ----------
    pairs : int ndarray (p, 2)
        Unordered.
    n : int
        How many shapes there are.
    first : list of int
        From where it is counted: from the first of them; the others are taken in any case.
    most : int
        How many at most.

    Returns
    -------
    int ndarray (m,)
        Sorted; of those equally far the first are taken.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.network import nearest_by_maps
    >>> chain = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    >>> nearest_by_maps(chain, 5, [3, 0], 3).tolist()
    [0, 2, 3]
    """
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    A = csr_array((np.ones(len(ends)), ends.T), shape=(n, n))
    steps = dijkstra(A, indices=first[0], unweighted=True)
    steps[first] = -1
    return np.sort(np.argsort(steps, kind="stable")[:most])


def in_threads(do: Callable[..., Any], items: Iterable[Any], n_jobs: int | None) -> list[Any]:
    """The results of a function for each item, in their order, by so many threads.

    Of the standard library: those of joblib look for what has ended every hundredth of a second,
    and products of a few milliseconds took three times as long in two of them as in one.

    Parameters
    ----------
    do : callable
        One that leaves the interpreter free, as NumPy does in products.
    items : iterable
    n_jobs : int, optional
        Threads, as in joblib.

    Examples
    --------
    >>> from s4a.method.network import in_threads
    >>> in_threads(abs, [-1, 2], 2)
    [1, 2]
    """
    n_threads = effective_n_jobs(n_jobs)
    if n_threads == 1:
        return [do(item) for item in items]
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(do, items))
