"""The network of functional maps (3.4).

Which pairs are matched, their first maps, and how far cycles close.
"""

import itertools

import numpy as np
from joblib import Parallel, delayed
from scipy.sparse.csgraph import connected_components, shortest_path


def spectral_distance(eigenvalues):
    """Distances of shapes by their spectra ``(n, n)``.

    RMS difference of the logarithms of the eigenvalues.
    """
    x = np.log(np.maximum(np.asarray(eigenvalues, float)[:, 1:], 1e-12))
    return np.sqrt(((x[:, None] - x[None]) ** 2).mean(axis=2))


def choose_pairs(distance, n_pairs):
    """The unordered pairs of a network: connected, with as many triangles as the budget allows.

    First a minimum spanning tree (connectivity), then for every shape a second edge to a neighbour
    of its tree parent, which closes a triangle, then the pairs that are nearest for one of their
    two shapes.

    Parameters
    ----------
    distance : float ndarray (n, n)
        Symmetric dissimilarity of the shapes; near pairs have better first maps.
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
            f"n_pairs = {n_pairs!r} cannot connect {n} shapes: give an integer from {n - 1} (a tree) "
            f"to {n * (n - 1) // 2} (all pairs)"
        )
    tree, closing = [], []
    inside, neighbours = [int(np.argmin(distance.sum(1)))], {i: [] for i in range(n)}
    while len(inside) < n:
        outside = [i for i in range(n) if i not in inside]
        sub = distance[np.ix_(outside, inside)]
        a, b = np.unravel_index(np.argmin(sub), sub.shape)
        new, parent = outside[a], inside[b]
        tree.append((new, parent))
        if neighbours[parent]:
            closing.append((new, min(neighbours[parent], key=lambda j: (distance[new, j], j))))
        neighbours[parent].append(new)
        neighbours[new].append(parent)
        inside.append(new)
    rank = np.argsort(np.argsort(distance + np.diag([np.inf] * n), axis=1, kind="stable"), axis=1)
    rest = sorted(
        itertools.combinations(range(n), 2),
        key=lambda p: (min(rank[p], rank[p[::-1]]), distance[p]),
    )
    wanted = dict.fromkeys((min(p), max(p)) for p in [*tree, *closing, *rest])
    return np.array(sorted(itertools.islice(wanted, int(n_pairs))))


def three_cycles(source, target):
    """Rows of directed maps that close a 3-cycle ``(c, 3)``.

    I -> j, j -> k, k -> i, each cycle once.

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


def cycle_errors(C, cycles, k=None, *, n_jobs=1):
    """How far each directed map is from closing its 3-cycles.

    Mean |C_ki C_jk C_ij - I|_F / sqrt(k).

    Of the product only the first `k` rows and columns are looked at, all by default; maps of
    different sizes can only be compared at one k.

    Returns
    -------
    float ndarray (p,)
        NaN for maps in no 3-cycle.
    """
    k = k or C.shape[1]

    def of(some):
        a, b, c = some.T
        return np.linalg.norm(
            C[c][:, :k] @ (C[b] @ C[a][:, :, :k]) - np.eye(k), axis=(1, 2)
        ) / np.sqrt(k)

    parts = np.array_split(cycles, len(cycles) // 32 + 1)
    error = np.concatenate(
        Parallel(n_jobs=n_jobs, backend="threading")(delayed(of)(some) for some in parts)
    )
    total, count = (np.bincount(cycles.ravel(), w, len(C)) for w in (np.repeat(error, 3), None))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def cycle_weights(error):
    """Weights exp(-(e / s)^2 / 2) of the maps from their cycle errors, s the median error.

    Maps in no cycle get the median weight; a network without 3-cycles gets plain weights of 1.  No
    weight is under 0.01, so that a connected network stays connected.
    """
    known = np.isfinite(error)
    if not known.any() or np.nanmedian(error) < 1e-9:
        return np.ones(len(error))
    w = np.exp(-0.5 * (error / np.nanmedian(error)) ** 2)
    return np.maximum(np.where(known, w, np.nanmedian(w)), 0.01)


def connectivity(pairs, n):
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
    A[pairs[:, 0], pairs[:, 1]] = A[pairs[:, 1], pairs[:, 0]] = 1
    through = np.diag(A @ A @ A) / 2
    steps = shortest_path(A, unweighted=True)
    return {
        "components": int(connected_components(A)[0]),
        "triangles": round(through.sum() / 3),
        "in_no_triangle": int((through == 0).sum()),
        "smallest_degree": int(A.sum(0).min()),
        "diameter": int(steps.max()) if np.isfinite(steps).all() else -1,
    }
