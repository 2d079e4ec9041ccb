"""The network of functional maps (3.4): choice of pairs, cycle errors and weights.

The maps C_ij of a 3-cycle i -> j -> k -> i are consistent if C_ki C_jk C_ij = I.  The deviation,
averaged over the cycles of a map, is its cycle error e (:func:`cycle_errors`), which gives its
weight exp(-(e / s)^2 / 2) in the latent basis (:func:`cycle_weights`).
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
    """Spectral distances of shapes ``(n, n)``: RMS difference of log eigenvalues.

    Parameters
    ----------
    eigenvalues : float ndarray (n, k)
        For unit area, the first of each 0.
    """
    x = np.log(np.maximum(np.asarray(eigenvalues, float)[:, 1:], 1e-12))
    return np.sqrt(((x[:, None] - x[None]) ** 2).mean(axis=2))


def choose_pairs(distance: Array, n_pairs: int) -> Array:
    """Choose the unordered pairs of a connected network with many triangles.

    First a minimum spanning tree, then for every shape an edge to a neighbour of its parent in the
    tree, which closes a triangle, then the nearest neighbours of each shape.

    Parameters
    ----------
    distance : float ndarray (n, n)
        Symmetric dissimilarity of the shapes; similar pairs have better initial maps.
    n_pairs : int
        Number of pairs; all pairs if it is at least n (n - 1) / 2.

    Returns
    -------
    pairs : int ndarray (p, 2)
        Smaller index first, sorted.

    Raises
    ------
    ValueError
        If so few pairs cannot connect the shapes.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.network import choose_pairs
    >>> choose_pairs(np.array([[0, 1, 2.0], [1, 0, 1.5], [2, 1.5, 0]]), 2).tolist()
    [[0, 1], [1, 2]]
    """
    n = len(distance)
    if n < 2:
        raise ValueError(f"a network needs at least 2 shapes; found {n}")
    if int(n_pairs) != n_pairs or n_pairs < n - 1:
        raise ValueError(
            f"n_pairs = {n_pairs!r} cannot connect {n} shapes: give an integer from {n - 1} "
            f"(a tree) to {n * (n - 1) // 2} (all pairs)"
        )
    ranked = np.concatenate([*_tree_and_closing(distance), _by_nearness(distance)])
    key = ranked.min(axis=1) * n + ranked.max(axis=1)
    _, first_row = np.unique(key, return_index=True)
    chosen = key[np.sort(first_row)[: int(n_pairs)]]
    return np.stack(np.divmod(np.sort(chosen), n), axis=1)


def _tree_and_closing(distance):
    r"""Edges of a minimum spanning tree, and for each new shape one that closes a triangle.

    Prim's algorithm from the most central shape.  A new shape is connected to its nearest shape in
    the tree, the parent, and to the nearest neighbour of the parent::

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
    parent = np.full(n, root)  # nearest shape in the tree
    to_tree = distance[:, root].copy()
    to_tree[root] = np.inf
    outside = np.arange(n) != root
    adjacent = np.zeros((n, n), bool)
    tree, closing = [], []
    for _ in range(n - 1):
        remaining = np.flatnonzero(outside)
        new = remaining[to_tree[remaining].argmin()]
        near = np.flatnonzero(adjacent[parent[new]])
        if len(near):
            closing.append((new, near[distance[new, near].argmin()]))
        tree.append((new, parent[new]))
        adjacent[new, parent[new]] = adjacent[parent[new], new] = True
        outside[new] = False
        closer = distance[:, new] < to_tree
        to_tree[closer] = distance[closer, new]
        parent[closer & outside] = new
    return np.array(tree), np.array(closing, int).reshape(-1, 2)


def _by_nearness(distance):
    """All pairs ``(n (n-1) / 2, 2)`` by the better rank of each as neighbour of the other."""
    others = distance.copy()
    np.fill_diagonal(others, np.inf)
    rank = np.argsort(np.argsort(others, axis=1, kind="stable"), axis=1)  # of neighbour j of i
    i, j = np.triu_indices(len(distance), 1)
    order = np.lexsort((distance[i, j], np.minimum(rank, rank.T)[i, j]))
    return np.stack([i, j], axis=1)[order]


def three_cycles(source: list[int], target: list[int]) -> Array:
    """Return the rows of the directed maps i -> j, j -> k, k -> i of each 3-cycle ``(c, 3)``.

    Parameters
    ----------
    source, target : list of int
        Shapes of each map, of length p.

    Examples
    --------
    >>> from s4a.method.network import three_cycles
    >>> three_cycles([0, 1, 2], [1, 2, 0]).tolist()
    [[0, 1, 2]]
    """
    row = {pair: r for r, pair in enumerate(zip(source, target, strict=True))}
    targets_of = {}
    for i, j in row:
        targets_of.setdefault(i, []).append(j)
    cycles = [
        (row[i, j], row[j, k], row[k, i])
        for i, j in row
        for k in targets_of.get(j, [])
        if i < min(j, k) and j != k and (k, i) in row
    ]
    return np.array(cycles, np.int64).reshape(-1, 3)


def cycle_errors(C: Array, cycles: Array, k: int | None = None, *, n_jobs: int | None = 1) -> Array:
    """Return the cycle error of each map: mean |C_ki C_jk C_ij - I|_F / sqrt(k) of its 3-cycles.

    Parameters
    ----------
    C : float ndarray (p, K, K)
    cycles : int ndarray (c, 3)
        Cycles of :func:`three_cycles`.
    k : int, optional
        Number of rows and columns of the product, K by default.  To compare maps of different
        sizes, use the same k.
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
        product = C[ki][:, :k] @ (C[jk] @ C[ij][:, :, :k])  # (c, k, k)
        return np.linalg.norm(product - np.eye(k), axis=(1, 2)) / np.sqrt(k)

    parts = np.array_split(cycles, len(cycles) // 32 + 1)  # limits the size of the products
    error = np.concatenate(in_threads(errors_of, parts, n_jobs))
    total = np.bincount(cycles.ravel(), np.repeat(error, 3), len(C))
    count = np.bincount(cycles.ravel(), minlength=len(C))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def program_errors(C: Array, cycles: Array) -> Array:
    """Return the errors of the maps ``(p,)`` by the linear program of Huang et al. (2020).

    The least weighted sum of errors such that those of the three maps of a cycle sum to at least
    |C_ki C_jk C_ij - I|_F, of the three starting points the largest.  The weight of a map is one
    over the sum of these deviations over its cycles.  pyFM has the same program (``"icsm"``).

    Parameters
    ----------
    C, cycles : see :func:`cycle_errors`

    Returns
    -------
    float ndarray (p,)
        NaN for maps in no 3-cycle.

    References
    ----------
    R. Huang et al. (2020), Consistent ZoomOut: efficient spectral map synchronization, Computer
    Graphics Forum 39(5).
    """
    deviation, identity = np.empty(len(cycles)), np.eye(C.shape[1])
    for part in np.array_split(np.arange(len(cycles)), len(cycles) // 32 + 1):
        products = [
            C[c] @ C[b] @ C[a] for a, b, c in (np.roll(cycles[part].T, i, axis=0) for i in range(3))
        ]
        deviation[part] = np.linalg.norm(np.array(products) - identity, axis=(2, 3)).max(0)
    from scipy.optimize import linprog  # a tenth of a second, and rarely used

    rows = np.repeat(np.arange(len(cycles)), 3)
    A = csr_array((np.ones(cycles.size), (rows, cycles.ravel())), shape=(len(cycles), len(C)))
    total = A.T @ deviation  # (p,)
    error = np.full(len(C), np.nan)
    if len(cycles):
        cost = 1 / np.maximum(total, np.finfo(float).tiny ** 0.5)
        found = linprog(cost * (total > 0), A_ub=-A, b_ub=-deviation, method="highs-ds")
        error = np.where(np.bincount(cycles.ravel(), minlength=len(C)) > 0, found.x, np.nan)
    return error


def cycle_weights(error: Array) -> Array:
    """Return weights exp(-(e / s)^2 / 2) of maps ``(p,)``, e the cycle error, s its median.

    Maps in no cycle have the median weight; without 3-cycles all weights are 1.  Weights are at
    least 0.01, so that a connected network stays connected.
    """
    finite = np.isfinite(error)
    if not finite.any() or np.nanmedian(error) < 1e-9:
        return np.ones(len(error))
    w = np.exp(-0.5 * (error / np.nanmedian(error)) ** 2)
    return np.maximum(np.where(finite, w, np.nanmedian(w)), 0.01)


def connectivity(pairs: Array, n: int) -> dict[str, int]:
    """Measure how well unordered pairs connect n shapes.

    Parameters
    ----------
    pairs : int ndarray (p, 2)
    n : int

    Returns
    -------
    dict of str to int
        ``components``; ``triangles``; ``in_no_triangle``, the number of shapes in no 3-cycle;
        ``smallest_degree``; ``diameter``, the length of the longest shortest path (-1 for a
        disconnected network).

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
    triangles = np.diag(A @ A @ A) / 2  # of each shape: closed walks of three steps
    steps = shortest_path(A, unweighted=True)
    return {
        "components": int(connected_components(A)[0]),
        "triangles": round(triangles.sum() / 3),
        "in_no_triangle": int((triangles == 0).sum()),
        "smallest_degree": int(A.sum(0).min()),
        "diameter": int(steps.max()) if np.isfinite(steps).all() else -1,
    }


def nearest_by_maps(pairs: Array, n: int, selected: list[int], most: int) -> Array:
    """Return some selected shapes and the shapes with the shortest paths to the first of them.

    Parameters
    ----------
    pairs : int ndarray (p, 2)
        Unordered.
    n : int
        Number of shapes.
    selected : list of int
        Path lengths are measured from the first; all are in the result.
    most : int
        Largest number of shapes.

    Returns
    -------
    int ndarray (m,)
        Sorted; smaller indices have precedence.

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
    steps = dijkstra(A, indices=selected[0], unweighted=True)
    steps[selected] = -1
    return np.sort(np.argsort(steps, kind="stable")[:most])


def in_threads(
    function: Callable[..., Any], items: Iterable[Any], n_jobs: int | None = None
) -> list[Any]:
    """Map a function over items in threads, in order.

    Uses the standard library, as joblib polls its threads every hundredth of a second, which is too
    slow for products of a few milliseconds.

    Parameters
    ----------
    function : callable
        It should release the interpreter lock, as NumPy does in products.
    items : iterable
    n_jobs : int, optional
        Threads, as in joblib; None for those of ``joblib.parallel_config``, one by default.

    Examples
    --------
    >>> from s4a.method.network import in_threads
    >>> in_threads(abs, [-1, 2], 2)
    [1, 2]
    """
    items, n_threads = list(items), effective_n_jobs(n_jobs)
    if n_threads == 1 or len(items) == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(function, items))
