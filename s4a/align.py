"""Rigid alignment by iterative closest points, and landmark sampling (4.1, steps 2 and 3)."""

import itertools

import fpsample
import numpy as np
from scipy.spatial import cKDTree


def rigid_transform(P, Q, weight=None, *, scale=False):
    """The motion s R x + t that brings points P closest to Q in the (weighted) least-squares sense.

    Kabsch's solution by the SVD of the cross-covariance; with ``scale=True`` Umeyama's (1991).

    Parameters
    ----------
    P, Q : float ndarray (n, 3)
        Corresponding points.
    weight : float ndarray (n,), optional
    scale : bool
        Whether a uniform scale is fitted as well.

    Returns
    -------
    R : (3, 3) proper rotation
    t : (3,)
    s : float, 1.0 without `scale`

    Examples
    --------
    >>> P = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    >>> R, t, s = rigid_transform(P, P + [1.0, 2, 3])
    >>> np.allclose(R, np.eye(3)), t.round(6).tolist()
    (True, [1.0, 2.0, 3.0])
    """
    w = np.ones(len(P)) if weight is None else weight
    w = w / w.sum()
    p, q = w @ P, w @ Q
    U, S, Vt = np.linalg.svd((Q - q).T @ ((P - p) * w[:, None]))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = (U * sign) @ Vt
    s = float(S @ sign / (w @ ((P - p) ** 2).sum(1))) if scale else 1.0
    return R, q - s * R @ p, s


def farthest_points(X, m):
    """Indices of m vertices, each as far as possible from those before it (Euclidean); all where there are fewer.

    The first is the vertex farthest from the centroid, so that the choice follows the shape and not its numbering.

    Examples
    --------
    >>> farthest_points(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]), 2).tolist()
    [2, 0]
    """
    start = int(np.argmax(((X - X.mean(0)) ** 2).sum(1)))
    if m >= len(X):
        return np.arange(len(X))
    return fpsample.fps_sampling(X, m, start_idx=start).astype(np.int64)  # the faster variants choose their own start


def principal_axes(X, area):
    """Centroid and principal axes (columns, proper rotation, longest first) of an area-weighted point set."""
    w = area / area.sum()
    c = w @ X
    _, V = np.linalg.eigh((X - c).T @ ((X - c) * w[:, None]))
    V = V[:, ::-1]
    return c, V * np.array([1, 1, np.sign(np.linalg.det(V))])


def icp(X, area, Y, area_y, R, t, *, rounds=30, tolerance=1e-5, trim=0.1):
    """Iterative closest points (Besl & McKay 1992) from a given start: moves X onto Y.

    Each round pairs every vertex of X with the nearest one of Y and every vertex of Y with the nearest one of X,
    leaves out the `trim` farthest pairs of both, and solves for the motion, weighted by area.

    Returns
    -------
    R, t
        The motion R x + t.
    residual : float
        Trimmed root mean square distance of the pairs, both ways.
    """
    tree = cKDTree(Y)
    last = np.inf
    size = np.sqrt(area.sum())
    for _ in range(rounds):
        moved = X @ R.T + t
        forth_gap, forth = tree.query(moved)
        back_gap, back = cKDTree(moved).query(Y)
        P = np.concatenate([X, X[back]])
        Q = np.concatenate([Y[forth], Y])
        w = np.concatenate([area / area.sum(), area_y / area_y.sum()])
        gap = np.concatenate([forth_gap, back_gap])
        keep = gap <= np.quantile(gap, 1 - trim)
        residual = float(np.sqrt(w[keep] @ gap[keep] ** 2 / w[keep].sum()))
        R, t, _ = rigid_transform(P[keep], Q[keep], w[keep])
        if last - residual < tolerance * size:
            break
        last = residual
    return R, t, residual


def align(X, area, Y, area_y, *, n_points=1000, prefer=0.9):
    """Rigid motion of X onto Y by ICP, from the pose as given and from the four turns that align principal axes.

    The starts are compared on about `n_points` vertices spread over each shape; the pose as given (centred) is kept
    unless another start ends below `prefer` times its residual, as near-symmetric shapes would otherwise be flipped
    by noise.  The best is then refined on all vertices.

    Parameters
    ----------
    X, Y : float ndarray (n, 3), (p, 3)
        Vertices, usually of low-resolution meshes.
    area, area_y : float ndarray (n,), (p,)
        Their areas.

    Returns
    -------
    R, t, residual : as of :func:`icp`
    """
    i, j = farthest_points(X, n_points), farthest_points(Y, n_points)
    cx, A = principal_axes(X, area)
    cy, B = principal_axes(Y, area_y)
    flips = [np.diag(d) for d in itertools.product((1, -1), repeat=3) if np.prod(d) == 1]
    starts = [np.eye(3)] + [B @ flip @ A.T for flip in flips]
    ones, ones_y = np.ones(len(i)), np.ones(len(j))
    found = [icp(X[i], ones, Y[j], ones_y, R, cy - R @ cx, tolerance=1e-4) for R in starts]
    best = min(found, key=lambda f: f[2])
    if best[2] > prefer * found[0][2]:
        best = found[0]
    return icp(X, area, Y, area_y, *best[:2])


def realign(X, Y, start, *, n_points=1000):
    """Rigid motion (R, t) of X onto Y by a short ICP on `n_points` spread vertices of each, from a start (R, t)."""
    x, y = X[farthest_points(X, n_points)], Y[farthest_points(Y, n_points)]
    return icp(x, np.ones(len(x)), y, np.ones(len(y)), *start, tolerance=1e-4)[:2]
