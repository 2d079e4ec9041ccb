"""The artefacts of scanned surfaces, put into a clean mesh: what cleaning deals with (5.1)."""

import numpy as np
from scipy.spatial import ConvexHull, cKDTree


def soil(
    X: np.ndarray, T: np.ndarray, u: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A clean mesh made as dirty as a file from a scanner.

    4 loose components of 12 to 60 vertices; 3 holes of 10 to 60 triangles; one bow-tie vertex for
    8,000 triangles; and one for 2,000 triangles of each of these: non-manifold edges, duplicate
    vertices (a seam half around the vertex), split edges with two zero-area triangles, duplicate
    triangles, flipped triangles, unreferenced vertices; of all of these at least 3.  Vertices and
    triangles are shuffled.

    Parameters
    ----------
    X, T : the mesh
    u : float ndarray (n, 3)
        Points of the unit sphere that the vertices are images of.
    rng : numpy.random.Generator

    Returns
    -------
    X, T
    u
        NaN in loose components and at unreferenced vertices.
    """
    few = max(3, len(T) // 2000)
    T = _tear(T, u, few, rng)
    T, original = _duplicate_vertices(X, T, u, few, rng)
    X, u = X[original], u[original]
    T = _disorder(T, u, few, rng)
    for near in X[rng.integers(len(X), size=4)]:
        points, triangles = _debris(near, rng)
        X, T = np.r_[X, points], np.r_[T, triangles + len(X)]
    X = np.r_[X, rng.uniform(X.min(0), X.max(0), (few, 3))]
    u = np.r_[u, np.full((len(X) - len(u), 3), np.nan)]
    order = rng.permutation(len(X))
    return X[order], np.argsort(order)[rng.permutation(T)].astype(np.int32), u[order]


def _tear(T, u, few, rng):
    """The triangles but for holes, and but for pairs at a vertex, whose star is a bow-tie then.

    The two have that vertex alone in common.
    """
    keep = np.ones(len(T), bool)
    middles = cKDTree(u[T].mean(1))
    for size in rng.integers(10, 60, 3):
        keep[middles.query(u[rng.integers(len(u))], size)[1]] = False
    for v in rng.choice(len(u), max(3, few // 4), replace=False):
        star = np.flatnonzero((T == v).any(1))
        apart = [t for t in star if len(np.intersect1d(T[t], T[star[0]])) == 1]
        keep[[star[0], *apart[:1]]] = False
    return T[keep]


def _duplicate_vertices(X, T, u, few, rng):
    """Triangles that use copies of some vertices, and the original of every vertex.

    A seam: half of the star of v gets a copy.  A split edge: a b c becomes m b c, a m c and a b m,
    m a copy of a.
    """
    T, original = T.copy(), np.arange(len(X))
    for v in rng.choice(np.unique(T), few, replace=False):
        star = np.flatnonzero((T == v).any(1))
        along = X[original[T[star]]].mean(1) @ np.cross(u[v], rng.normal(size=3))
        half = star[along > np.median(along)]
        T[half] = np.where(T[half] == v, len(original), T[half])
        original = np.r_[original, v]
    split = rng.choice(len(T), few, replace=False)
    a, b, c = T[split].T
    m = len(original) + np.arange(few)
    T[split] = np.c_[m, b, c]
    return np.r_[T, np.c_[a, m, c], np.c_[a, b, m]], np.r_[original, original[a]]


def _disorder(T, u, few, rng):
    """Triangles of which some are there twice, and some flipped.

    Some edges have a third triangle then.
    """
    third, twice, flipped = rng.choice(len(T), (3, few), replace=False)
    beyond = cKDTree(u).query(u[T[third]].mean(1), 15)[1][:, -1]
    more = [np.c_[T[third, :2], beyond], np.roll(T[twice], 1, axis=1)]
    T = T.copy()
    T[flipped] = T[flipped, ::-1]
    return np.concatenate([T, *more])


def _debris(near, rng):
    """A small loose ellipsoid."""
    u = rng.normal(size=(int(rng.integers(12, 61)), 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return near * rng.uniform(0.8, 1.15) + u * rng.uniform(0.8, 3, 3), ConvexHull(u).simplices
