"""Closest points on a surface (3.1) and interpolation between vertices.

A point on a surface is given by a triangle and three barycentric weights of its corners.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from joblib import effective_n_jobs
from scipy.spatial import cKDTree

from s4a.geometry import mesh as surface
from s4a.geometry.compiled import igl
from s4a.geometry.mesh import order_in_space, triangle_areas, triangle_normals, vertex_normals
from s4a.schema import Array

# weights of positions (unit area) and unit normals in the search for nearest points
POSITION_WEIGHT, NORMAL_WEIGHT = 5.0, 0.3
# weight of normals once surfaces coincide: enough to find the right side of a thin wall, while the
# noise of a scan's normals, 0.1 and more, weighs less than several edges at 100,000 vertices
_CLOSE_WEIGHT = 0.05
_AT_ONCE = 4096  # points whose triangles are searched at once, in the cache
_FLAT = 1e-14  # squared sine of the angle at A below which a triangle is degenerate


def interpolate(values: Array, T: Array, triangle: Array, weights: Array) -> Array:
    """Interpolate values ``(n, d)`` of the vertices at points of the surface: ``(p, d)``."""
    corners = values.take(T.take(triangle, axis=0), axis=0)  # (p, 3, d)
    return np.einsum("pc,pcd->pd", weights, corners)


def interpolation_matrix(T: Array, triangle: Array, weights: Array, n: int) -> sp.csr_matrix:
    """Sparse matrix ``(p, n)`` that interpolates values of n vertices at p surface points.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.closest import interpolation_matrix
    >>> W = interpolation_matrix(
    ...     np.array([[0, 1, 2]]), np.array([0]), np.array([[0.5, 0.25, 0.25]]), 3
    ... )
    >>> W.toarray().tolist()
    [[0.5, 0.25, 0.25]]
    """
    row = np.repeat(np.arange(len(triangle)), 3)
    return sp.csr_matrix((weights.ravel(), (row, T[triangle].ravel())), (len(triangle), n))


def closest_point(P: Array, X: Array, T: Array) -> tuple[Array, Array]:
    """Return the closest surface point of each row of P: triangle ``(p,)``, weights ``(p, 3)``."""
    P, X = np.asarray(P, float), np.asarray(X, float)
    if not igl:
        return closest_of_all(P, X, T)
    triangle = _by_libigl(P, X, T)[1].reshape(-1)
    return triangle, closest_point_on_triangles(P, *(X[corner] for corner in T[triangle].T))


def _by_libigl(P, X, T):
    """Squared distances ``(p,)``, triangles and closest points."""
    P, X = (np.ascontiguousarray(points, np.float64) for points in (P, X))
    return igl.point_mesh_squared_distance(P, X, np.ascontiguousarray(T, np.int64))


def distance_to_surface(P: Array, X: Array, T: Array) -> Array:
    """Return the distances ``(p,)`` of points from a surface."""
    if not igl:
        return np.linalg.norm(interpolate(X, T, *closest_of_all(P, X, T)) - P, axis=1)
    return np.sqrt(np.maximum(_by_libigl(P, X, T)[0], 0))


def closest_of_all(P: Array, X: Array, T: Array) -> tuple[Array, Array]:
    """Closest points without libigl, among triangles whose centroids are near enough.

    The nearest centroid is a surface point at a distance d, so the closest point is within d, and
    the centroid of its triangle within d plus the largest distance of a corner from its centroid.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.closest import closest_of_all
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    >>> T = np.array([[0, 1, 2], [1, 3, 2]])
    >>> triangle, weights = closest_of_all(np.array([[0.5, 0, 2]]), X, T)
    >>> triangle.tolist(), weights.tolist()
    ([0], [[0.5, 0.5, 0.0]])
    """
    middle = X[T].mean(1)
    reach = np.linalg.norm(X[T] - middle[:, None], axis=2).max()
    tree = cKDTree(middle)
    triangle, weights = np.empty(len(P), np.int64), np.empty((len(P), 3))
    for block in np.array_split(np.arange(len(P)), len(P) // 2000 + 1):
        within = (tree.query(P[block])[0] + reach) * (1 + 1e-12)
        near = tree.query_ball_point(P[block], within)
        row = np.repeat(np.arange(len(block)), list(map(len, near)))
        candidate = np.concatenate([np.empty(0, np.int64), *near]).astype(np.int64)
        a, b, c = T[candidate].T
        share = closest_point_on_triangles(P[block][row], X[a], X[b], X[c])
        distance = np.linalg.norm(interpolate(X, T, candidate, share) - P[block][row], axis=1)
        order = np.lexsort((candidate, distance, row))
        best = order[np.searchsorted(row[order], np.arange(len(block)))]  # the first of a row
        triangle[block], weights[block] = candidate[best], share[best]
    return triangle, weights


def closest_facing_point(P: Array, N: Array, X: Array, T: Array) -> tuple[Array, Array]:
    """Closest points on triangles that face along the normals N ``(p, 3)`` of the points.

    If the closest point lies on a triangle that faces away, such as the other side of a thin wall,
    the triangles around the vertex nearest in position and normal are searched instead.

    See Also
    --------
    closest_point : ignores normals.
    """
    triangle, weights = closest_point(P, X, T)
    away = np.flatnonzero(np.einsum("px,px->p", triangle_normals(X, T)[triangle], N) <= 0)
    if len(away):
        size = np.sqrt(triangle_areas(X, T).sum())
        nearest = feature_tree(X / size, T).query(features(P[away] / size, N[away]))[1]
        triangle[away], weights[away] = closest_point_in_star(P[away], nearest, X, T)
    return triangle, weights


def features(
    X: Array, normals: Array, spectrum: Array | None = None, weight: float = NORMAL_WEIGHT
) -> Array:
    """Return rows for nearest-neighbour search: weighted position and normal ``(n, 6)``.

    Spectral coordinates ``(n, k)`` are appended if given.
    """
    columns = [POSITION_WEIGHT * X, weight * normals]
    return np.concatenate(columns if spectrum is None else [*columns, spectrum], axis=1)


class FeatureTree:
    """KD-tree over rows of :func:`features`, in whose memory rows near in space lie together.

    Parameters
    ----------
    rows : float ndarray (n, d)
    order : int ndarray (n,), optional
        Order of the rows in space, :func:`s4a.geometry.mesh.order_in_space` by default.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.closest import FeatureTree
    >>> FeatureTree(np.array([[3.0], [1.0], [2.0]])).query(np.array([[1.2]]))[1].tolist()
    [1]
    """

    def __init__(self, rows: Array, order: Array | None = None) -> None:
        self.data = rows
        self._order = order_in_space(rows) if order is None else order
        # the leaf size suits queries far from the rows, which take most of the time
        self._tree = cKDTree(rows.take(self._order, axis=0), leafsize=64, balanced_tree=False)

    def query(self, rows: Array, order: Array | None = None) -> tuple[Array, Array]:
        """Return the distance and the index of the nearest row, for each of some rows (q, d).

        In their order in space, and in as many threads as ``joblib.parallel_config`` says, one by
        default.
        """
        order = order_in_space(rows) if order is None else order
        found = self._tree.query(rows.take(order, axis=0), workers=effective_n_jobs(None))
        distance, nearest = np.empty(len(rows)), np.empty(len(rows), np.int64)
        distance[order], nearest[order] = found[0], self._order.take(found[1])
        return distance, nearest


def feature_tree(X: Array, T: Array) -> FeatureTree:
    """KD-tree over the :func:`features` of a surface."""
    return FeatureTree(features(X, vertex_normals(X, T)))


def match_surfaces(Y: Array, normals_y: Array, X: Array, normals_x: Array, *orders: Array) -> Array:
    """Match each vertex of a surface to the nearest vertex of a coinciding surface: ``(n,)``.

    Nearest in position and, with weight ``_CLOSE_WEIGHT``, in normal.

    Parameters
    ----------
    Y, normals_y : float ndarray (n, 3)
        Query vertices and unit normals.
    X, normals_x : float ndarray (m, 3)
        Vertices and unit normals of the other surface, of about unit area.
    *orders : int ndarray (n,), (m,), optional
        Orders of both in space, if computed before.

    Examples
    --------
    >>> import s4a
    >>> from s4a.geometry.closest import match_surfaces
    >>> from s4a.geometry.mesh import as_arrays, vertex_normals
    >>> X, T = as_arrays(s4a.synthetic.sphere(200))
    >>> N = vertex_normals(X, T)
    >>> bool((match_surfaces(1.01 * X, N, X, N) == range(200)).all())
    True
    """
    tree = FeatureTree(features(X, normals_x, weight=_CLOSE_WEIGHT), *orders[1:])
    return tree.query(features(Y, normals_y, weight=_CLOSE_WEIGHT), *orders[:1])[1]


def closest_point_on_triangles(P: Array, A: Array, B: Array, C: Array) -> Array:
    """Barycentric weights of the point of triangle (A_i, B_i, C_i) closest to P_i, row by row.

    Signs of dot products distinguish the seven regions: vertices, edges and interior.

    Parameters
    ----------
    P, A, B, C : float ndarray (n, d)

    Returns
    -------
    weights : float ndarray (n, 3)
        Non-negative, rows sum to 1.

    References
    ----------
    C. Ericson (2005), Real-Time Collision Detection, section 5.1.5.
    """
    v, w, _ = _closest_by_sides((B - A).T, (C - A).T, (P - A).T)
    return np.stack([np.maximum(1 - v - w, 0), v, w], axis=1)


def _closest_by_sides(ab, ac, ap):
    """Weights of B and C in the closest point of :func:`closest_point_on_triangles`.

    Parameters
    ----------
    ab, ac, ap : float ndarray (d, n)
        From A to B, to C and to the point, as columns: sums over d are then sums of rows.

    Returns
    -------
    v, w : float ndarray (n,)
    distance2 : float ndarray (n,)
        Squared distance of the closest point, less that of A.
    """

    def products(a, b):
        return np.einsum("ij,ij->j", a, b)

    d1, d2 = products(ab, ap), products(ac, ap)
    ab_ac, ab_ab, ac_ac = products(ab, ac), products(ab, ab), products(ac, ac)
    d3, d4 = d1 - ab_ab, d2 - ab_ac  # products of ab and ac with the vector from B
    d5, d6 = d1 - ab_ac, d2 - ac_ac  # and from C
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    total = va + vb + vc
    v, w = ratio(vb, total), ratio(vc, total)  # interior
    empty = total <= 0  # by rounding: its nearest corner, unless an edge below is nearer
    v, w = np.where(empty, 0.0, v), np.where(empty, 0.0, w)
    bc = (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0)
    t = ratio(d4 - d3, (d4 - d3) + (d5 - d6))
    v, w = np.where(bc, 1 - t, v), np.where(bc, t, w)
    edge_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0)
    v, w = np.where(edge_ac, 0, v), np.where(edge_ac, ratio(d2, d2 - d6), w)
    edge_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0)
    v, w = np.where(edge_ab, ratio(d1, d1 - d3), v), np.where(edge_ab, 0, w)
    corners = (
        ((d6 >= 0) & (d5 <= d6), 0, 1),
        ((d3 >= 0) & (d4 <= d3), 1, 0),
        ((d1 <= 0) & (d2 <= 0), 0, 0),
    )
    for region, at_b, at_c in corners:
        v, w = np.where(region, at_b, v), np.where(region, at_c, w)
    flat = np.flatnonzero(ab_ac * ab_ac >= (1 - _FLAT) * ab_ab * ac_ac)
    if len(flat):  # the signs are those of rounding errors there
        v[flat], w[flat] = _closest_on_sides(ab[:, flat].T, ac[:, flat].T, ap[:, flat].T)
    distance2 = v * (v * ab_ab + 2 * (w * ab_ac - d1)) + w * (w * ac_ac - 2 * d2)
    return v, w, distance2


def _closest_on_sides(ab, ac, ap):
    """Weights of :func:`_closest_by_sides` for degenerate triangles, on the three sides."""
    bc, zero = ac - ab, np.zeros(len(ab))
    t = ratio(dots(bc, ap - ab), dots(bc, bc))
    v = np.stack([ratio(dots(ab, ap), dots(ab, ab)), zero, 1 - t])  # (3 sides, n)
    w = np.stack([zero, ratio(dots(ac, ap), dots(ac, ac)), t])
    distance = np.linalg.norm(v[..., None] * ab + w[..., None] * ac - ap, axis=2)
    nearest = distance.argmin(axis=0), np.arange(len(ab))
    return v[nearest], w[nearest]


def ratio(a: Array, b: Array) -> Array:
    """Return a / b clipped to 0..1; 0 where both are 0."""
    return np.clip(a / np.where(b == 0, 1, b), 0, 1)


def dots(a: Array, b: Array) -> Array:
    """Dot products ``(n,)`` of the rows of two arrays ``(n, d)``."""
    return np.einsum("ij,ij->i", a, b)


class Stars(NamedTuple):
    """Triangles around every vertex, by their corners at it.

    Those of v are ``corner[start[v] : start[v] + degree[v]]``.
    """

    corner: Array  # (3 m,): 3 t + c for corner c of triangle t
    following: tuple[Array, Array]  # (3 m,) each: vertices of the two corners after it
    start: Array  # (n,)
    degree: Array  # (n,)

    @property
    def triangle(self) -> Array:
        """The triangles ``(3 m,)``."""
        return self.corner // 3


def stars(T: Array, n: int) -> Stars:
    """Return the triangles around each of n vertices.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.closest import stars
    >>> around = stars(np.array([[0, 1, 2], [2, 1, 3]]), 4)
    >>> around.degree.tolist(), around.triangle[around.start[3] :].tolist()
    ([1, 2, 2, 1], [1])
    """
    corner, first = surface.counting_sort(T.ravel(), n)
    b, c = (np.roll(T, shift, axis=1).ravel().take(corner) for shift in (-1, -2))
    return Stars(corner, (b, c), first[:-1], np.diff(first))


def closest_point_in_star(
    P: Array, nearest: Array, X: Array, T: Array, around: Stars | None = None
) -> tuple[Array, Array]:
    """Return the closest point on the triangles around a given vertex, for each point.

    Parameters
    ----------
    P : float ndarray (p, d)
        In three dimensions, or in the space of :func:`features`.
    nearest : int ndarray (p,)
        A vertex of the mesh for each point.  Only its triangles are searched, so a thin wall is
        never crossed.  It must have at least one triangle.
    X : float ndarray (n, d)
    T : int ndarray (m, 3)
    around : Stars, optional
        Of the mesh, if computed before.

    Returns
    -------
    triangle : int ndarray (p,)
    weights : float ndarray (p, 3)
        Barycentric, non-negative, rows sum to 1.
    """
    corner, following, start, degree = around or stars(T, len(X))
    triangle, weights = np.empty(len(P), np.int64), np.empty((len(P), 3))
    for begin in range(0, len(P), _AT_ONCE):
        block = slice(begin, begin + _AT_ONCE)
        vertex = nearest[block]
        repeat = degree.take(vertex)
        if (repeat == 0).any():
            raise ValueError(
                "closest_point_in_star needs vertices with triangles; found an isolated one"
            )
        first = np.cumsum(repeat) - repeat
        row = np.repeat(np.arange(len(vertex)), repeat)
        candidate = np.arange(len(row)) + (start.take(vertex) - first).take(row)
        A = X.take(vertex, axis=0)
        a, ap = (values.T.take(row, axis=1) for values in (A, P[block] - A))  # (d, candidates)
        ab, ac = (
            np.ascontiguousarray(X.take(end.take(candidate), axis=0).T) - a for end in following
        )
        v, w, distance2 = _closest_by_sides(ab, ac, ap)
        best = np.minimum.reduceat(distance2, first)
        is_best = np.flatnonzero(distance2 == best.take(row))
        pick = is_best[np.searchsorted(is_best, first)]  # the first of a row
        triangle[block], c = np.divmod(corner.take(candidate.take(pick)), 3)
        v, w = v.take(pick), w.take(pick)
        ordered = (np.arange(3) - c[:, None]) % 3  # corners of the triangle among A, B, C
        shares = np.stack([np.maximum(1 - v - w, 0), v, w], axis=1)
        weights[block] = np.take_along_axis(shares, ordered, axis=1)
    return triangle, weights
