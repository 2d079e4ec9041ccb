"""Manifold surfaces from triangles, as part of the cleaning.

Which triangles continue each other, and which way (4.1).

A triangle corner is counted as half-edges are: corner h = i m + t is corner i of triangle t, and
half-edge h runs from it to the next corner of the triangle
(:func:`s4a.geometry.mesh.directed_edges`).  Two half-edges that the surface joins are mates; the
rest of the topology follows from the mates.  Vertices that lie in one place are a `group`; what is
repaired is added to `counts`, see :data:`s4a.input.clean.REPAIRS`.
"""

import numpy as np

from s4a.geometry.mesh import (
    components,
    directed_edges,
    triangle_areas,
    triangle_normals,
    unique_edges,
)

MOST_AROUND_EDGE = (
    16  # an edge with more triangles is cut; pairing them would need their number squared
)


def manifold_mates(edge_of, count):
    """The mate of each half-edge on edges with two triangles, else -1."""
    order = np.argsort(edge_of, kind="stable")
    first = (np.cumsum(count) - count)[count == 2]
    mate = np.full(len(edge_of), -1)
    mate[order[first]], mate[order[first + 1]] = order[first + 1], order[first]
    return mate


def mates(P, F, group, counts):
    """The triangles oriented consistently.

    And the mate of each half-edge, -1 at boundaries and cuts.
    """
    _, edge_of, count = unique_edges(group[F], len(P))
    F, mate = _orient(P, F, group, manifold_mates(edge_of, count), counts)
    if (count > 2).any():
        _, edge_of, count = unique_edges(group[F], len(P))
        counts["nonmanifold_edges"] = int((count > 2).sum())
        pairs, cost = _pairs_around_edges(P, F, group, edge_of, count)
        pairs = pairs[cheapest(cost, pairs)]
        mate[pairs], mate[pairs[:, ::-1]] = pairs[:, ::-1], pairs
        F, mate = _orient(P, F, group, mate, counts)
    counts["cut_edges"] = int((mate < 0).sum() - (count == 1).sum())
    return F, mate


def _pairs_around_edges(P, F, group, edge_of, count):
    """All pairs of half-edges on each non-manifold edge ``(c, 2)``.

    And how badly each continues the surface ``(c,)``.

    The cost is 1 - cos of the bend, more for a pair that disagrees in orientation; between equal
    bends the pair that encloses less of the inside goes first, so that solids that touch in an edge
    come apart.
    """
    order, first = np.argsort(edge_of, kind="stable"), np.cumsum(count) - count
    pairs = [np.empty((0, 2), np.int64)]
    for k in range(3, MOST_AROUND_EDGE + 1):
        around = order[first[count == k][:, None] + np.arange(k)]
        pairs += [around[:, [i, j]] for i in range(k) for j in range(i + 1, k)]
    pairs = np.concatenate(pairs)
    m, start = len(F), group[F].T.ravel()
    N = triangle_normals(P, F)
    N /= np.maximum(
        np.linalg.norm(N, axis=1, keepdims=True), np.finfo(float).tiny
    )  # some have lost theirs to rounding
    one, other = N[pairs[:, 0] % m], N[pairs[:, 1] % m]
    twisted = start[pairs[:, 0]] == start[pairs[:, 1]]
    cos = np.einsum("ij,ij->i", one, other) * np.where(twisted, -1, 1)
    file_vertex = F.T.ravel()
    towards = P[file_vertex[(pairs[:, 1] + 2 * m) % (3 * m)]] - P[file_vertex[pairs[:, 0]]]
    convex = np.einsum("ij,ij->i", one, towards) < 0
    return pairs, np.round(1 - cos, 6) + 4 * twisted - 1e-7 * convex


def _orient(P, F, group, mate, counts):
    """Triangles turned so that mates run against each other.

    Most of the area of each patch as it was.

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
    ends = np.stack([np.r_[t, t + m], np.r_[u + m * twisted, u + m * ~twisted]], axis=1)
    label = components(ends, 2 * m)
    same, turned = label[:m], label[m:]
    area = np.bincount(same, triangle_areas(P, F), label.max() + 1)
    flip = (area[turned] > area[same]) | ((area[turned] == area[same]) & (turned < same))
    cut = twisted & (same == turned)[t]
    mate[h[cut]] = mate[g[cut]] = -1
    counts["reoriented_triangles"] += int(flip.sum())
    return _reverse(F, mate, np.flatnonzero(flip))


def _reverse(F, mate, t):
    """Triangles t with corners 0 and 1 exchanged.

    So that their half-edge 0 stays and 1 and 2 trade places.
    """
    m, F = len(F), F.copy()
    F[t] = F[t][:, [1, 0, 2]]
    moved = np.arange(3 * m)
    moved[t + m], moved[t + 2 * m] = t + 2 * m, t + m
    mate = mate[moved]
    return F, np.where(mate >= 0, moved[mate], -1)


def umbrellas(F, mate):
    """Vertices as the sets of corners that mates join.

    ``(m, 3)``, and the smallest file vertex of each.

    A bow-tie or the end of a separated edge falls apart into one vertex per umbrella.
    """
    m = len(F)
    h = np.flatnonzero(mate > np.arange(3 * m))
    g = mate[h]
    ends = np.stack([np.r_[h, (h + m) % (3 * m)], np.r_[(g + m) % (3 * m), g]], axis=1)
    label = components(ends, 3 * m)
    file_vertex = np.full(label.max() + 1, np.iinfo(np.int64).max)
    np.minimum.at(file_vertex, label, F.T.ravel())
    order = np.argsort(file_vertex, kind="stable")
    return np.argsort(order)[label].reshape(3, m).T, file_vertex[order]


def split_double_edges(X, V, file_vertex, mate, counts):
    """Two sheets may share both ends of an edge and still be apart.

    Each gets its own midpoint there.
    """
    m, n = len(V), len(X)
    E, edge_of, count = unique_edges(V, n)
    start = V.T.ravel()
    turn = np.bincount(edge_of, np.where(start < np.roll(start, -m), 1, -1))
    half = np.flatnonzero(((count > 2) | ((count == 2) & (turn != 0)))[edge_of])
    if len(half) == 0:
        return X, V, file_vertex
    sheet = np.where(mate[half] >= 0, np.minimum(mate[half], half), half)
    sheets, middle = np.unique(sheet, return_inverse=True)
    M = np.full(3 * m, -1)
    M[half] = n + middle
    M = M.reshape(3, m).T
    t = np.flatnonzero((M >= 0).any(axis=1))
    turn = ((M[t] >= 0).argmax(axis=1)[:, None] + np.arange(3)) % 3
    (p, q, r), (a, b, c) = np.take_along_axis(V[t], turn, 1).T, np.take_along_axis(M[t], turn, 1).T
    b, c = np.where(b < 0, r, b), np.where(c < 0, p, c)
    fan = np.concatenate(
        [np.stack(x, axis=1) for x in ((a, q, b), (a, b, r), (a, r, c), (a, c, p))]
    )
    fan = fan[(fan[:, 0] != fan[:, 2]) & (fan[:, 1] != fan[:, 2])]
    ends = E[edge_of[sheets]]
    counts["inserted_vertices"] = len(sheets)
    X = np.concatenate([X, X[ends].mean(axis=1)])
    return (
        X,
        np.concatenate([np.delete(V, t, axis=0), fan]),
        np.r_[file_vertex, file_vertex[ends].min(axis=1)],
    )


def cheapest(cost, ends):
    """Greedy matching: mask of the pairs taken in order of cost, each end once.

    Ends ``(c, 2)`` int.
    """
    if len(cost) == 0:
        return np.zeros(0, bool)
    rank = np.argsort(np.argsort(cost, kind="stable"))
    items, ends = np.unique(ends, return_inverse=True)
    ends = ends.reshape(-1, 2)
    taken, used, open_ = np.zeros(len(cost), bool), np.zeros(len(items), bool), np.arange(len(cost))
    while len(open_):
        best = np.full(len(items), len(cost))
        np.minimum.at(best, ends[open_], rank[open_, None])
        win = open_[(best[ends[open_]] == rank[open_, None]).all(axis=1)]
        taken[win], used[ends[win]] = True, True
        open_ = open_[~used[ends[open_]].any(axis=1)]
    return taken


def equal_rows(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    >>> from s4a.input.manifold import equal_rows
    >>> first, group = equal_rows(np.array([[5, 1], [0, 0], [5, 1]]))
    >>> first.tolist(), group.tolist()
    ([1, 0], [1, 0, 1])
    """
    order = np.lexsort(A.T)  # stable; np.unique(axis=0) takes five times as long
    new = np.r_[True, (A[order[1:]] != A[order[:-1]]).any(axis=1)][: len(A)]
    group = np.empty(len(A), np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new], group


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
