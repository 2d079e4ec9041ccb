"""Triangle meshes (3.1): areas, normals, edges and cotangent weights of a mesh (X, T).

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

_BLOCK = 1 << 12  # triangles whose corners are in the cache at once


def as_dataset(
    points: Array, triangles: Array, attrs: dict[str, Any] | None = None, **variables: Any
) -> xr.Dataset:
    """Return a mesh Dataset: ``position(vertex, xyz)``, ``corner_vertex(triangle, corner)``."""
    X, T = np.asarray(points, float), np.asarray(triangles, np.int32)
    return dataset(attrs, position=X, corner_vertex=T, **variables)


def as_arrays(mesh: xr.Dataset) -> tuple[Array, Array]:
    """Return positions ``(n, 3)`` float64 and triangles ``(m, 3)`` int32 of a mesh Dataset."""
    X, T = mesh["position"].values, mesh["corner_vertex"].values
    return (
        X.astype(np.float64, casting="same_kind", copy=False),
        T.astype(np.int32, casting="same_kind", copy=False),
    )


def triangle_normals(X: Array, T: Array) -> Array:
    """Return normals of the triangles ``(m, 3)``, with twice their area as length."""
    normals = np.empty((len(T), 3))
    for block, vectors in _normals_in_blocks(X, T):
        normals[block] = np.stack(vectors, axis=1)
    return normals


def _normals_in_blocks(X, T):
    """Yield slices of the triangles, and x, y and z of their :func:`triangle_normals`."""
    X = np.asarray(X, float)  # products of integers may overflow
    for start in range(0, len(T), _BLOCK):
        block = slice(start, start + _BLOCK)
        a, b, c = (X.take(corner, axis=0) for corner in T[block].T.astype(np.intp, order="C"))
        b -= a
        c -= a
        (ux, uy, uz), (vx, vy, vz) = b.T, c.T
        # written out: np.cross gives the same bits and takes twice as long
        yield block, (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)


def triangle_areas(X: Array, T: Array) -> Array:
    """Return the areas of the triangles ``(m,)``."""
    return 0.5 * norms(triangle_normals(X, T))


def vertex_areas(X: Array, T: Array) -> Array:
    """Return lumped (barycentric) vertex areas ``(n,)``: a third of each incident triangle."""
    return sums_at_vertices(T, triangle_areas(X, T) / 3, len(X))


def sums_at_vertices(T: Array, values: Array, n: int) -> Array:
    """Return sums ``(n, ...)`` of values ``(m, ...)`` of the triangles around each vertex.

    Equal to :func:`numpy.bincount` for every column, in one pass.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import sums_at_vertices
    >>> sums_at_vertices(np.array([[0, 1, 2], [2, 1, 3]]), np.array([1.0, 2.0]), 4).tolist()
    [1.0, 3.0, 3.0, 2.0]
    """
    _check_numbers(T, n)  # others would be written outside of the sums
    corner = sp.csr_matrix((np.ones(T.size), T.ravel(), np.arange(0, T.size + 1, 3)), (len(T), n))
    return corner.T @ values  # adds in the order of the triangles


def log_shares(area: Array) -> Array:
    """Return logarithms ``(n,)`` of the shares of the vertices in the area of a surface."""
    return np.log(np.maximum(area / area.sum(), np.finfo(np.float32).tiny))


def normal_sums(X: Array, T: Array) -> Array:
    """Return sums ``(n, 3)`` of :func:`triangle_normals` around each vertex.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import normal_sums
    >>> normal_sums(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))[0]
    array([0., 0., 1.])
    """
    return sums_at_vertices(T, triangle_normals(X, T), len(X))


def vertex_normals(X: Array, T: Array) -> Array:
    """Return area-weighted unit normals of the vertices ``(n, 3)``; zero without area."""
    return normals_and_areas(X, T)[0]


def normals_and_areas(X: Array, T: Array) -> tuple[Array, Array]:
    """Return :func:`vertex_normals` and :func:`vertex_areas`, from one pass over triangles."""
    values = np.empty((len(T), 4))
    for block, (x, y, z) in _normals_in_blocks(X, T):
        values[block] = np.stack([x, y, z, 0.5 * np.sqrt(x * x + y * y + z * z) / 3], axis=1)
    sums = sums_at_vertices(T, values, len(X))
    length = norms(sums[:, :3])
    return sums[:, :3] / np.where(length > 0, length, 1)[:, None], sums[:, 3].copy()


def norms(vectors: Array) -> Array:
    """Return the lengths of vectors ``(n, d)``, d < 8, as :func:`numpy.linalg.norm` does.

    It takes three times as long for many vectors of few dims.
    """
    return np.sqrt(sum(column * column for column in vectors.T))


def rotated(vectors: Array, start: Array, end: Array) -> Array:
    """Rotate vectors ``(n, 3)`` by the smallest rotations from unit vectors `start` to `end`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import rotated
    >>> x, y, z = np.eye(3)[:, None]
    >>> rotated(x, x, y).tolist(), rotated(z, x, y).tolist()
    ([[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    """
    # Rodrigues: v cos + (a x v) sin + a (a . v) (1 - cos), with the axis a sin = start x end
    axis = np.cross(start, end)
    cos = np.einsum("ij,ij->i", start, end)[:, None]
    along = np.einsum("ij,ij->i", axis, vectors)[:, None]
    return vectors * cos + np.cross(axis, vectors) + axis * along / np.maximum(1 + cos, 1e-6)


def directed_edges(T: Array) -> Array:
    """Return the half-edges ``(3 m, 2)``: corners 0-1 of all triangles, then 1-2, then 2-0."""
    return np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])


def edges(T: Array) -> Array:
    """Return the undirected edges ``(e, 2)``, smaller index first, sorted.

    See Also
    --------
    unique_edges : also returns the edge of each half-edge and the triangles per edge.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import edges
    >>> edges(np.array([[0, 1, 2], [2, 1, 3]])).tolist()
    [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    """
    return counted_edges(T)[0]


def counted_edges(T: Array, n: int | None = None) -> tuple[Array, Array]:
    """Return the undirected edges ``(e, 2)`` and the triangles per edge ``(e,)``.

    In a third of the time of :func:`unique_edges`, where the arguments are explained.
    """
    start = np.asarray(T).T.ravel()  # as in directed_edges
    n = int(start.max(initial=0)) + 1 if n is None else n
    _check_numbers(start, n)
    start = start.astype(np.int32 if n < 2**31 else np.int64, copy=False)  # the smaller, the faster
    end = np.roll(start, -len(T))
    ends = np.minimum(start, end), np.maximum(start, end)
    count = sp.coo_matrix((np.ones(len(start), np.int32), ends), (n, n)).tocsr()  # adds equal edges
    first = np.repeat(np.arange(n), np.diff(count.indptr))
    return np.stack([first, count.indices], axis=1, dtype=np.int64), count.data


def unique_edges(T: Array, n: int | None = None) -> tuple[Array, Array, Array]:
    """Return the undirected edges, the edge of each half-edge and the triangles per edge.

    Parameters
    ----------
    T : int ndarray (m, 3)
    n : int, optional
        Number of vertices.

    Returns
    -------
    E : int ndarray (e, 2)
        Smaller index first, sorted.
    edge_of : int ndarray (3 m,)
        Row of E of each half-edge, in the order of :func:`directed_edges`.
    count : int ndarray (e,)
        Triangles at the edge: 2 in the interior of a manifold, 1 on its boundary.
    """
    E, count = counted_edges(T, n)
    if len(E) == 0:
        return E, np.zeros(0, np.int64), count
    number, ends = sp.csr_matrix((np.arange(len(E)), E.T)), directed_edges(T).T
    return E, np.asarray(number[ends.min(0), ends.max(0)]).ravel(), count


def _check_numbers(key, n):
    """Raise IndexError unless all numbers are from 0 to n - 1."""
    if len(key) and not 0 <= key.min() <= key.max() < n:
        raise IndexError(f"numbers from 0 to {n - 1} needed, found {key.min()} to {key.max()}")


def counting_order(key: Array, n: int) -> Array:
    """Return the stable order ``(m,)`` that sorts integers from 0 to n - 1.

    Counting sort in linear time, by the transpose of a sparse matrix.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.mesh import counting_order
    >>> counting_order(np.array([2, 0, 1, 0]), 3).tolist()
    [1, 3, 2, 0]
    """
    return counting_sort(key, n)[0].astype(np.int64)


def counting_sort(key: Array, n: int) -> tuple[Array, Array]:
    """Return :func:`counting_order` and the first element of each integer in it ``(n + 1,)``."""
    _check_numbers(key, n)  # others would be written outside of the arrays
    m = len(key)
    indicator = sp.csr_matrix((np.empty(m, np.int8), key, np.arange(m + 1)), (m, n)).tocsc()
    return indicator.indices, indicator.indptr


def order_in_space(X: Array) -> Array:
    """Return an order of points ``(n,)`` in which neighbours mostly follow each other.

    The order is that of the leaves of a KD-tree and makes memory access local.

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
    """Return the stable order ``(n,)`` of rows ``(n, k)``, with the last column as first key.

    Equal to :func:`numpy.lexsort`, which only sorts the rows with equal last columns.

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
    """Group equal rows of an array ``(n, k)``; NaN equals nothing.

    Returns
    -------
    first : int ndarray (g,)
        First row of each group; groups are sorted with the last column as first key.
    group : int ndarray (n,)
        Group of each row.

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
    new = np.zeros(len(A), bool)
    new[:1] = True
    for column in A.T:  # any() along an axis takes longer
        ordered = column.take(order)
        new[1:] |= ordered[1:] != ordered[:-1]
    group = np.empty(len(A), np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new], group


def components(pairs: Array, n: int) -> Array:
    """Return the connected component of each of n nodes linked by pairs ``(p, 2)``, from 0."""
    links = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (n, n))
    links.has_canonical_format = True  # repeated links need not be found
    return connected_components(links, directed=False)[1]


def edge_graph(X: Array, E: Array) -> sp.csr_matrix:
    """Return the lengths of the edges E ``(e, 2)`` as a symmetric sparse matrix ``(n, n)``."""
    i, j = E.T.astype(np.int32 if len(X) < 2**31 else np.int64, order="C")
    length = norms(X.take(i, axis=0) - X.take(j, axis=0))  # (e,)
    least = 1e-12 * (length.max(initial=0) or 1)  # an explicit zero would count as no edge
    half = sp.coo_matrix((np.maximum(length, least), (i, j)), (len(X), len(X))).tocsr()
    return half + half.T


def path_lengths(
    G: sp.csr_matrix, start: Array, end: Array, limit: float, X: Array | None = None
) -> Array:
    """Return lengths of shortest edge paths between pairs of vertices ``(p,)``, at most `limit`.

    An edge is the shortest path between its ends.  For other pairs, short paths are searched first,
    from a few vertices at a time, so time and memory do not grow with the whole surface.

    Parameters
    ----------
    G : sparse matrix (n, n)
        As of :func:`edge_graph`.
    start, end : int ndarray (p,)
    limit : float
        In the unit of the edges.
    X : float ndarray (n, 3), optional
        Positions.  Of a large surface, short paths are then searched around their ends only.

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
    if X is not None:
        _find_short_paths(X, G, start, end, 0.5 * limit, length)
    step = max(1, min(64, 2**22 // G.shape[0]))  # origins at a time: at most 32 MB of distances
    for reach in (0.1 * limit, limit) if X is None else (limit,):
        missing = np.flatnonzero(np.isinf(length))
        origin, row = np.unique(start[missing], return_inverse=True)
        for first in range(0, len(origin), step):
            distance = dijkstra(G, indices=origin[first : first + step], limit=reach)  # (step, n)
            here = (row >= first) & (row < first + step)
            length[missing[here]] = distance[row[here] - first, end[missing[here]]]
    return np.minimum(length, limit)


def _find_short_paths(X, G, start, end, longest, length):
    """Enter paths of at most 1.5 times the distance of their ends, then 2.25, ..., and `longest`.

    A path of at most a length lies in the ball of this diameter around the middle of its ends.
    """
    tree, P, Q = cKDTree(X, balanced_tree=False, compact_nodes=False), X[start], X[end]
    reach = np.maximum(1.5 * norms(P - Q), 0.01 * longest)
    while len(pair := np.flatnonzero(np.isinf(length) & (reach < longest))):
        balls = tree.query_ball_point((P + Q)[pair] / 2, reach[pair] * 0.5001, return_sorted=True)
        for i, ball in zip(pair, map(np.array, balls), strict=True):
            first, last = np.searchsorted(ball, (start[i], end[i]))
            length[i] = dijkstra(G[ball][:, ball], indices=first, limit=reach[i])[last]
        reach *= 1.5


def half_cotangents(X: Array, T: Array) -> Array:
    """Return half the cotangent of the angle opposite to each half-edge ``(3 m,)``.

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
    """Return cotangent weights: half the sum of the cotangents of the opposite angles.

    Returns
    -------
    E : int ndarray (e, 2)
    w : float ndarray (e,)
        The stiffness matrix W has ``-w`` off the diagonal and row sums 0, so it is positive
        semidefinite, and L = A^-1 W.

    References
    ----------
    U. Pinkall and K. Polthier (1993), Computing discrete minimal surfaces and their conjugates,
    Experimental Mathematics 2(1).
    """
    E, edge_of, _ = unique_edges(T, len(X))
    return E, np.bincount(edge_of, half_cotangents(X, T), len(E))


def stiffness(E: Array, w: Array, n: int) -> sp.csr_matrix:
    """Return the sparse symmetric stiffness matrix W ``(n, n)`` of edge weights."""
    i, j = E.T
    W = sp.coo_matrix((-np.r_[w, w], (np.r_[i, j], np.r_[j, i])), (n, n)).tocsr()
    return W - sp.diags(np.asarray(W.sum(axis=1)).ravel())


def n_used(T: Array) -> int:
    """Return the number of vertices that triangles use."""
    return int(np.count_nonzero(np.bincount(T.ravel())))


def euler_characteristic(T: Array, E: Array | None = None) -> int:
    """Return V - E + F over the used vertices; E are the edges, if computed before."""
    return n_used(T) - len(edges(T) if E is None else E) + len(T)


def volume(X: Array, T: Array) -> float:
    """Return the signed enclosed volume, positive if the normals point outwards."""
    a, b, c = (X.take(corner, axis=0) for corner in T.T)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
