"""Discrete surfaces (3.1): a mesh (X, T) as arrays, its areas, normals, edges and cotan weights.

X holds the positions of the n vertices ``(n, 3)``, T the corners of the m triangles ``(m, 3)``,
counter-clockwise as seen from outside.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp
import xarray as xr
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from s4a.schema import Array, dataset


def as_dataset(
    points: Array, triangles: Array, attrs: dict[str, Any] | None = None, **variables: Any
) -> xr.Dataset:
    """A mesh Dataset: ``position(vertex, xyz)``, ``corner_vertex(triangle, corner)``."""
    X, T = np.asarray(points, float), np.asarray(triangles, np.int32)
    return dataset(attrs, position=X, corner_vertex=T, **variables)


def as_arrays(mesh: xr.Dataset) -> tuple[Array, Array]:
    """Positions ``(n, 3)`` float64 and triangles ``(m, 3)`` int32 of a mesh Dataset."""
    X, T = mesh["position"].values, mesh["corner_vertex"].values
    return (
        X.astype(np.float64, casting="same_kind", copy=False),
        T.astype(np.int32, casting="same_kind", copy=False),
    )


def triangle_normals(X: Array, T: Array) -> Array:
    """Normals of the triangles ``(m, 3)``, as long as twice their area."""
    X = np.asarray(X, float)  # products of integers may overflow
    a, b, c = (X.take(corner, axis=0) for corner in T.T)
    ux, uy, uz = (b - a).T
    vx, vy, vz = (c - a).T
    # written out: np.cross gives the same bits in twice the time
    return np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=1)


def triangle_areas(X: Array, T: Array) -> Array:
    """Areas of the triangles ``(m,)``."""
    return 0.5 * np.linalg.norm(triangle_normals(X, T), axis=1)


def vertex_areas(X: Array, T: Array) -> Array:
    """Lumped (barycentric) area of every vertex ``(n,)``: a third of each incident triangle."""
    return np.bincount(T.ravel(), np.repeat(triangle_areas(X, T) / 3, 3), len(X))


def normal_sums(X: Array, T: Array) -> Array:
    """Sums ``(n, 3)`` of :func:`triangle_normals` around each vertex: quadratic in X.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import normal_sums
    >>> normal_sums(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))[0]
    array([0., 0., 1.])
    """
    ones, first_corner = np.ones(T.size), np.arange(0, T.size + 1, 3)
    touches = sp.csc_matrix((ones, T.ravel(), first_corner), (len(X), len(T)))
    return touches @ triangle_normals(X, T)


def vertex_normals(X: Array, T: Array) -> Array:
    """Unit normals of the vertices ``(n, 3)``, area-weighted; zero where a vertex has no area."""
    N = normal_sums(X, T)
    length = np.linalg.norm(N, axis=1, keepdims=True)
    return N / np.where(length > 0, length, 1)


def turned(vectors: Array, start: Array, end: Array) -> Array:
    """Vectors ``(n, 3)`` after the least rotations that take unit vectors `start` to `end`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import turned
    >>> x, y, z = np.eye(3)[:, None]
    >>> turned(x, x, y).tolist(), turned(z, x, y).tolist()
    ([[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    """
    # Rodrigues: v cos + (a x v) sin + a (a . v) (1 - cos), with the axis a sin = start x end
    axis = np.cross(start, end)
    cos = np.einsum("ij,ij->i", start, end)[:, None]
    along = np.einsum("ij,ij->i", axis, vectors)[:, None]
    return vectors * cos + np.cross(axis, vectors) + axis * along / np.maximum(1 + cos, 1e-6)


def directed_edges(T: Array) -> Array:
    """The half-edges ``(3 m, 2)`` of the triangles: corners 0-1 of all, then 1-2, then 2-0."""
    return np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])


def edges(T: Array) -> Array:
    """The undirected edges ``(e, 2)``, each once, smaller index first, sorted.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import edges
    >>> edges(np.array([[0, 1, 2], [2, 1, 3]])).tolist()
    [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    """
    return unique_edges(T)[0]


def unique_edges(T: Array, n: int | None = None) -> tuple[Array, Array, Array]:
    """The undirected edges and what belongs to each; n is the number of vertices, if at hand.

    Returns
    -------
    E : int ndarray (e, 2)
        Smaller index first, sorted.
    edge_of : int ndarray (3 m,)
        Row of E of each half-edge, in the order of :func:`directed_edges`.
    count : int ndarray (e,)
        Triangles at the edge: 2 inside of a manifold, 1 on its boundary.
    """
    start = np.asarray(T).T.astype(np.int64).ravel()  # as in directed_edges
    end = np.roll(start, -len(T))
    n = max(int(start.max(initial=0)) + 1 if n is None else n, 1)
    _check_numbers(start, n)
    key = np.minimum(start, end) * n + np.maximum(start, end)
    edge, edge_of, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.stack(np.divmod(edge, n), axis=1), edge_of, count


def _check_numbers(key, n):
    """IndexError unless all are numbers from 0 to n - 1."""
    if len(key) and not 0 <= key.min() <= key.max() < n:
        raise IndexError(f"numbers from 0 to {n - 1} needed, found {key.min()} to {key.max()}")


def counting_order(key: Array, n: int) -> Array:
    """The order ``(m,)`` that sorts numbers 0 to n - 1; equal ones stay in their order.

    In linear time, as a sparse matrix is transposed: 5 ms for 600,000, of which a sort takes 60.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import counting_order
    >>> counting_order(np.array([2, 0, 1, 0]), 3).tolist()
    [1, 3, 2, 0]
    """
    _check_numbers(key, n)  # what follows would write beside its memory
    m = len(key)
    one_a_row = sp.csr_matrix((np.ones(m, np.int8), key, np.arange(m + 1)), (m, n))
    return one_a_row.tocsc().indices.astype(np.int64)


def order_in_space(X: Array) -> Array:
    """An order of points in which neighbours mostly follow each other, that of a KD-tree ``(n,)``.

    What takes them in this order finds most in the cache, whatever the order of their file.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import order_in_space
    >>> X = np.random.default_rng(0).random((1000, 3))
    >>> def steps(X): return float(np.linalg.norm(np.diff(X, axis=0), axis=1).mean().round(1))
    >>> steps(X), steps(X[order_in_space(X)])
    (0.7, 0.2)
    """
    return cKDTree(X, balanced_tree=False, compact_nodes=False).indices


def lexical_order(A: Array) -> Array:
    """The order of rows ``(n, k)``, the last column first; equal rows stay in their order ``(n,)``.

    That of :func:`numpy.lexsort`, which is asked for rows alone whose last columns are equal.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import lexical_order
    >>> lexical_order(np.array([[5, 1], [0, 0], [4, 1], [4, 1]])).tolist()
    [1, 2, 3, 0]
    """
    order = np.argsort(A[:, -1])
    last = A[:, -1].take(order)
    tie = ~(last[1:] > last[:-1])  # NaN, too
    tied = np.zeros(len(A), bool)
    tied[1:] |= tie
    tied[:-1] |= tie
    rows = np.sort(order[tied])
    order[tied] = rows.take(np.lexsort(A.take(rows, axis=0).T))
    return order


def equal_rows(A: Array) -> tuple[Array, Array]:
    """Which rows of an array ``(n, k)`` are equal; NaN equals nothing.

    Returns
    -------
    first : int ndarray (g,)
        The first row of each group of equal ones, the groups sorted by the last column first.
    group : int ndarray (n,)
        The group of each row.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import equal_rows
    >>> first, group = equal_rows(np.array([[5, 1], [0, 0], [5, 1]]))
    >>> first.tolist(), group.tolist()
    ([1, 0], [1, 0, 1])
    """
    if A.dtype.kind in "iu" and A.min(initial=0) >= 0 and A.max(initial=0) < 8 * len(A):
        order = np.arange(len(A))
        for column in A.T:
            order = order.take(counting_order(column.take(order), int(column.max()) + 1))
    else:
        order = lexical_order(A)
    ordered = A.take(order, axis=0)
    new = np.r_[True, (ordered[1:] != ordered[:-1]).any(axis=1)][: len(A)]
    group = np.empty(len(A), np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new], group


def components(pairs: Array, n: int) -> Array:
    """Connected component of each of n nodes that the pairs ``(p, 2)`` link, numbered from 0."""
    links = sp.coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (n, n))
    return connected_components(links, directed=False)[1]


def edge_graph(X: Array, E: Array) -> sp.csr_matrix:
    """Lengths of the edges E ``(e, 2)`` as a symmetric matrix ``(n, n)``: Dijkstra's graph."""
    i, j = E.T
    length = np.linalg.norm(X[i] - X[j], axis=1)  # (e,)
    least = 1e-12 * (length.max(initial=0) or 1)  # an explicit zero would count as no edge
    half = sp.coo_matrix((np.maximum(length, least), (i, j)), (len(X), len(X))).tocsr()
    return half + half.T


def path_lengths(G: sp.csr_matrix, start: Array, end: Array, limit: float) -> Array:
    """Lengths of the shortest paths along edges between pairs of vertices ``(p,)``, cut at `limit`.

    An edge is the shortest path between its ends.  Of the others short paths are looked for first,
    and a few starts at a time, so that neither time nor memory grow with the whole surface.

    Parameters
    ----------
    G : sparse matrix (n, n)
        As of :func:`edge_graph`.
    start, end : int ndarray (p,)
    limit : float
        In the unit of the edges.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import edge_graph, edges, path_lengths
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]])
    >>> G = edge_graph(X, edges(np.array([[0, 1, 2], [0, 2, 3]])))
    >>> path_lengths(G, np.array([0, 1, 1]), np.array([0, 3, 3]), 9.0).tolist()
    [0.0, 3.0, 3.0]
    """
    if len(start) == 0:
        return np.zeros(0)
    edge = np.asarray(G[start, end]).ravel()
    length = np.where(start == end, 0.0, np.where(edge > 0, edge, np.inf))
    for reach in (0.1 * limit, limit):
        missing = np.flatnonzero(np.isinf(length))
        origin, row = np.unique(start[missing], return_inverse=True)
        for first in range(0, len(origin), 64):
            distance = dijkstra(G, indices=origin[first : first + 64], limit=reach)  # (64, n)
            here = (row >= first) & (row < first + 64)
            length[missing[here]] = distance[row[here] - first, end[missing[here]]]
    return np.minimum(length, limit)


def half_cotangents(X: Array, T: Array) -> Array:
    """Half the cotangent of the angle opposite to each half-edge ``(3 m,)``.

    Half-edges are in the order of :func:`directed_edges`.
    """
    #        o          cot(angle at o) = u.v / |u x v|,
    #      u/ \v        and |u x v| is twice the area of the triangle
    #      i---j
    double_area = np.maximum(2 * triangle_areas(X, T), np.finfo(float).tiny)
    half_cotangent = []
    for i, j, opposite in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        o = X.take(T[:, opposite], axis=0)
        u, v = X.take(T[:, i], axis=0) - o, X.take(T[:, j], axis=0) - o
        dot = np.einsum("ij,ij->i", u, v)  # (m,)
        half_cotangent.append(dot / (2 * double_area))
    return np.concatenate(half_cotangent)


def cotan_weights(X: Array, T: Array) -> tuple[Array, Array]:
    """Cotan weights of the edges: half the sum of the cotangents of the opposite angles.

    Returns
    -------
    E : int ndarray (e, 2)
    w : float ndarray (e,)
        The stiffness matrix has ``-w`` off the diagonal and row sums 0, and L = A^-1 W (Pinkall &
        Polthier 1993).
    """
    E, edge_of, _ = unique_edges(T, len(X))
    return E, np.bincount(edge_of, half_cotangents(X, T), len(E))


def stiffness(E: Array, w: Array, n: int) -> sp.csr_matrix:
    """Sparse symmetric stiffness matrix W ``(n, n)`` of the edges' weights."""
    i, j = E.T
    W = sp.coo_matrix((-np.r_[w, w], (np.r_[i, j], np.r_[j, i])), (n, n)).tocsr()
    return W - sp.diags(np.asarray(W.sum(axis=1)).ravel())


def n_used(T: Array) -> int:
    """How many vertices triangles have."""
    return int(np.count_nonzero(np.bincount(T.ravel())))


def euler_characteristic(T: Array, E: Array | None = None) -> int:
    """V - E + F over the vertices in use; E the edges, where they are at hand."""
    return n_used(T) - len(edges(T) if E is None else E) + len(T)


def volume(X: Array, T: Array) -> float:
    """Signed enclosed volume; positive when the normals point outwards."""
    a, b, c = (X.take(corner, axis=0) for corner in T.T)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
