r"""Manifold surfaces from triangles (4.1): which continue each other, and which way.

A triangle corner is counted as half-edges are: corner h = i m + t is corner i of triangle t, and
half-edge h runs from it to the next corner of the triangle
(:func:`s4a.geometry.mesh.directed_edges`).  Two half-edges that the surface joins are mates; the
rest of the topology follows from the mates.  Vertices that lie in one place are a `group`; what is
repaired is added to `counts`, see :data:`s4a.input.clean.REPAIRS`.

::

               2
             /   \             triangle t
    h + 2m  /     \  h + m     h = t runs from corner 0 to 1,
           /   t   \           h + m from 1 to 2, h + 2m from 2 to 0;
          0---------1          modulo 3m, h + m is always the next
               h               and h + 2m starts at the corner opposite to h
"""

from typing import Any

import numpy as np

from s4a.geometry.mesh import (
    components,
    counting_order,
    directed_edges,
    triangle_areas,
    triangle_normals,
    unique_edges,
)

MOST_AROUND_EDGE = 16  # an edge with more triangles is cut: pairing takes their number squared


def manifold_mates(edge_of: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The mate of each half-edge ``(3 m,)`` on edges with two triangles, else -1.

    `edge_of` and `count` are those of :func:`s4a.geometry.mesh.unique_edges`.
    """
    order = counting_order(edge_of, len(count))
    first = (np.cumsum(count) - count)[count == 2]
    one, other = order[first], order[first + 1]
    mate = np.full(len(edge_of), -1)
    mate[one], mate[other] = other, one
    return mate


def join_triangles(
    P: np.ndarray, F: np.ndarray, group: np.ndarray, counts: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Find the mates of all half-edges, and orient the triangles consistently.

    Returns
    -------
    F : int ndarray (m, 3)
        The triangles, some turned.
    mate : int ndarray (3 m,)
        Of each half-edge, -1 at boundaries and cuts.
    """
    _, edge_of, count = unique_edges(group[F], len(P))
    F, mate = _orient(P, F, group, manifold_mates(edge_of, count), counts)
    if (count > 2).any():
        _, edge_of, count = unique_edges(group[F], len(P))
        counts["nonmanifold_edges"] = int((count > 2).sum())
        pairs, cost = _pairs_around_edges(P, F, group, edge_of, count)
        one, other = pairs[cheapest(cost, pairs)].T
        mate[one], mate[other] = other, one
        F, mate = _orient(P, F, group, mate, counts)
    counts["cut_edges"] = int((mate < 0).sum() - (count == 1).sum())
    return F, mate


def _pairs_around_edges(P, F, group, edge_of, count):
    """All pairs of half-edges on each non-manifold edge, and how badly each continues the surface.

    Returns
    -------
    pairs : int ndarray (c, 2)
    cost : float ndarray (c,)
        1 - cos of the bend, more for a pair that disagrees in orientation; between equal bends the
        pair that encloses less of the inside goes first, so that solids that touch in an edge come
        apart.
    """
    order = counting_order(edge_of, len(count))
    first = np.cumsum(count) - count
    found = [np.empty((0, 2), np.int64)]
    for k in range(3, MOST_AROUND_EDGE + 1):
        around = order[first[count == k][:, None] + np.arange(k)]  # (edges, k) half-edges
        found += [around[:, [i, j]] for i in range(k) for j in range(i + 1, k)]
    pairs = np.concatenate(found)
    h, g = pairs.T
    m = len(F)
    normal = triangle_normals(P, F)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(length, np.finfo(float).tiny)  # some have lost theirs to rounding
    start = group[F].T.ravel()
    twisted = start[h] == start[g]
    cos = np.einsum("ij,ij->i", normal[h % m], normal[g % m]) * np.where(twisted, -1, 1)
    corner = F.T.ravel()
    towards = P[corner[(g + 2 * m) % (3 * m)]] - P[corner[h]]  # to the other one's third corner
    convex = np.einsum("ij,ij->i", normal[h % m], towards) < 0
    return pairs, np.round(1 - cos, 6) + 4 * twisted - 1e-7 * convex


def _orient(P, F, group, mate, counts):
    """Turn triangles so that mates run against each other, most of each patch's area as it was.

    A triangle stands for two nodes, as it is and reversed; a patch whose two copies are connected
    cannot be oriented (a Moebius strip), and is cut where the file's orientation changes.
    """
    m = len(F)
    h = np.flatnonzero(mate > np.arange(3 * m))
    g = mate[h]
    start = group[F].T.ravel()
    twisted = start[h] == start[g]
    if not twisted.any():
        return F, mate
    t, u = h % m, g % m
    links = np.stack([np.r_[t, t + m], np.r_[u + m * twisted, u + m * ~twisted]], axis=1)
    label = components(links, 2 * m)
    as_is, turned = label[:m], label[m:]
    area = np.bincount(as_is, triangle_areas(P, F), label.max() + 1)
    tie = (area[turned] == area[as_is]) & (turned < as_is)
    flip = (area[turned] > area[as_is]) | tie
    cut = twisted & (as_is == turned)[t]
    mate[h[cut]] = mate[g[cut]] = -1
    counts["reoriented_triangles"] += int(flip.sum())
    return _reverse(F, mate, np.flatnonzero(flip))


def _reverse(F, mate, t):
    """Exchange corners 0 and 1 of triangles t: half-edge 0 stays, 1 and 2 trade places."""
    m, F = len(F), F.copy()
    F[t] = F[t][:, [1, 0, 2]]
    moved = np.arange(3 * m)
    moved[t + m] = t + 2 * m
    moved[t + 2 * m] = t + m
    mate = mate[moved]
    return F, np.where(mate >= 0, moved[mate], -1)


def join_corners(F: np.ndarray, mate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as the sets of corners that mates join: one for each umbrella of triangles.

    A bow-tie or the end of a separated edge falls apart into several.

    Returns
    -------
    V : int ndarray (m, 3)
        The triangles' corners as such vertices.
    file_vertex : int ndarray (n,)
        The smallest file vertex of each.
    """
    m = len(F)
    h = np.flatnonzero(mate > np.arange(3 * m))
    g = mate[h]
    # the start of one is the end of the other
    links = np.stack([np.r_[h, (h + m) % (3 * m)], np.r_[(g + m) % (3 * m), g]], axis=1)
    label = components(links, 3 * m)
    file_vertex = np.full(label.max() + 1, np.iinfo(np.int64).max)
    np.minimum.at(file_vertex, label, F.T.ravel())
    order = counting_order(file_vertex, F.max() + 1)
    rank = np.empty_like(file_vertex)
    rank[order] = np.arange(len(order))
    return rank.take(label).reshape(3, m).T, file_vertex[order]


def split_double_edges(
    X: np.ndarray, V: np.ndarray, file_vertex: np.ndarray, mate: np.ndarray, counts: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give each of two sheets its own midpoint where they share both ends of an edge.

    Returns
    -------
    X : float ndarray (n + s, 3)
        The midpoints appended.
    V : int ndarray (m', 3)
        A triangle with midpoints is replaced by those around them.
    file_vertex : int ndarray (n + s,)
    """
    m, n = len(V), len(X)
    E, edge_of, count = unique_edges(V, n)
    start = V.T.ravel()
    turn = np.bincount(edge_of, np.where(start < np.roll(start, -m), 1, -1))
    double = (count > 2) | ((count == 2) & (turn != 0))
    half = np.flatnonzero(double[edge_of])
    if len(half) == 0:
        return X, V, file_vertex
    sheet = np.where(mate[half] >= 0, np.minimum(mate[half], half), half)
    sheets, middle = np.unique(sheet, return_inverse=True)
    of_half = np.full(3 * m, -1)
    of_half[half] = n + middle
    M = of_half.reshape(3, m).T  # (m, 3) the midpoint of each side, or -1
    #        r             a is there: the sides are turned until it is;
    #      / | \           without c the triangle a-c-p is none, without b it is a-q-b
    #    c   |   b
    #   /  \ | /  \
    #  p-----a-----q
    t = np.flatnonzero((M >= 0).any(axis=1))
    turn = ((M[t] >= 0).argmax(axis=1)[:, None] + np.arange(3)) % 3
    p, q, r = np.take_along_axis(V[t], turn, 1).T
    a, b, c = np.take_along_axis(M[t], turn, 1).T
    b = np.where(b < 0, r, b)
    c = np.where(c < 0, p, c)
    parts = [(a, q, b), (a, b, r), (a, r, c), (a, c, p)]
    fan = np.concatenate([np.stack(part, axis=1) for part in parts])
    fan = fan[(fan[:, 0] != fan[:, 2]) & (fan[:, 1] != fan[:, 2])]
    ends = E[edge_of[sheets]]
    counts["inserted_vertices"] = len(sheets)
    X = np.concatenate([X, X[ends].mean(axis=1)])
    V = np.concatenate([np.delete(V, t, axis=0), fan])
    return X, V, np.r_[file_vertex, file_vertex[ends].min(axis=1)]


def cheapest(cost: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Greedy matching: the mask of the pairs taken in order of cost, each end once.

    Parameters
    ----------
    cost : float ndarray (c,)
    ends : int ndarray (c, 2)
    """
    if len(cost) == 0:
        return np.zeros(0, bool)
    rank = np.argsort(np.argsort(cost, kind="stable"))
    items, ends = np.unique(ends, return_inverse=True)
    ends = ends.reshape(-1, 2)
    taken, used = np.zeros(len(cost), bool), np.zeros(len(items), bool)
    left = np.arange(len(cost))
    while len(left):  # all pairs at once that are the best of both their ends
        best = np.full(len(items), len(cost))
        np.minimum.at(best, ends[left], rank[left, None])
        win = left[(best[ends[left]] == rank[left, None]).all(axis=1)]
        taken[win] = True
        used[ends[win]] = True
        left = left[~used[ends[left]].any(axis=1)]
    return taken


def fill_holes(X: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Close every boundary loop of an oriented manifold by a fan around a new vertex.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)

    Returns
    -------
    X : float ndarray (n + h, 3)
        A vertex for each of h loops is appended, at the mean of the loop weighted by the length of
        its edges.
    T : int ndarray (m + b, 3)
        A triangle for each of b boundary edges is appended.
    nearby : int ndarray (h,)
        A vertex of each loop.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.manifold import fill_holes
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> X, T, nearby = fill_holes(X, np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    >>> X[4].round(2).tolist(), T[3:].tolist(), nearby.tolist()
    ([0.35, 0.35, 0.0], [[1, 0, 4], [2, 1, 4], [0, 2, 4]], [0])
    """
    E, n = directed_edges(T), len(X)
    E = E[~np.isin(E @ [n, 1], E[:, ::-1] @ [n, 1])]
    rim, ends = np.unique(E, return_inverse=True)
    ends = ends.reshape(-1, 2)
    loop = components(ends, len(rim))
    of, h = loop[ends[:, 0]], loop.max(initial=-1) + 1
    length = np.linalg.norm(X[E[:, 0]] - X[E[:, 1]], axis=1)
    weight = length / np.bincount(of, length, h)[of] if len(E) else length
    middle = np.stack([np.bincount(of, weight * X[E, i].mean(1), h) for i in range(3)], axis=1)
    fans = np.column_stack([E[:, 1], E[:, 0], n + of])
    nearby = np.full(h, n)
    np.minimum.at(nearby, of, E[:, 0])
    return np.concatenate([X, middle]), np.concatenate([T, fans]), nearby
