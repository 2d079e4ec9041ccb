"""Rigid alignment by iterative closest points, and landmark sampling (4.1, steps 2 and 3)."""

import itertools

import fpsample
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation


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
    >>> import numpy as np
    >>> from s4a.geometry.align import rigid_transform
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
    """Indices of m vertices, each as far as possible from those before it (Euclidean).

    All where there are fewer.

    The first is the vertex farthest from the centroid, so that the choice follows the shape and not
    its numbering.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.align import farthest_points
    >>> farthest_points(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]), 2).tolist()
    [2, 0]
    """
    start = int(np.argmax(((X - X.mean(0)) ** 2).sum(1)))
    if m >= len(X):
        return np.arange(len(X))
    return fpsample.fps_sampling(X, m, start_idx=start).astype(
        np.int64
    )  # the faster variants choose their own start


def principal_axes(X, area):
    """Centroid and principal axes (columns, proper rotation.

    Longest first) of an area-weighted point set.
    """
    w = area / area.sum()
    c = w @ X
    _, V = np.linalg.eigh((X - c).T @ ((X - c) * w[:, None]))
    V = V[:, ::-1]
    return c, V * np.array([1, 1, np.sign(np.linalg.det(V))])


def cloud(X, n_points=None):
    """A KD-tree of all vertices, and the indices of `n_points` spread ones.

    What ICP needs of a shape.
    """
    return cKDTree(X), np.arange(len(X)) if n_points is None else farthest_points(X, n_points)


def icp(
    X, area, Y, area_y, R, t, *, n_points=None, clouds=None, rounds=60, tolerance=1e-5, trim=0.1
):
    """Iterative closest points (Besl & McKay 1992) from a given start: moves X onto Y.

    Each round pairs vertices of X with the nearest of all of Y and vertices of Y with the nearest
    of all of X, leaves out the `trim` farthest pairs, and solves for the motion, weighted by area.

    Parameters
    ----------
    X, Y : float ndarray (n, 3), (p, 3)
    area, area_y : float ndarray (n,), (p,)
    R, t : start, R x + t
    n_points : int, optional
        How many vertices of each, spread over it, are paired; all by default.
    clouds : tuple, optional
        :func:`cloud` of X and of Y, where they are at hand.
    rounds : int
    tolerance : float
        The end comes when the residual falls by less, as a share of sqrt(area of X).
    trim : float

    Returns
    -------
    R, t
        The motion R x + t.
    residual : float
        Trimmed root mean square distance of the pairs, both ways.
    """
    (tree_x, i), (tree_y, j) = clouds or (cloud(X, n_points), cloud(Y, n_points))
    weight = np.concatenate([area[i] / area[i].sum(), area_y[j] / area_y[j].sum()])
    size = np.sqrt(area.sum())
    last = np.inf
    for _ in range(rounds):
        forth_gap, forth = tree_y.query(X[i] @ R.T + t)
        back_gap, back = tree_x.query((Y[j] - t) @ R)
        P, Q = np.concatenate([X[i], X[back]]), np.concatenate([Y[forth], Y[j]])
        gap = np.concatenate([forth_gap, back_gap])
        keep = gap <= (1 + 1e-9) * np.quantile(
            gap, 1 - trim
        )  # two that are each other's nearest stay or go together
        residual = float(np.sqrt(weight[keep] @ gap[keep] ** 2 / weight[keep].sum()))
        R, t, _ = rigid_transform(P[keep], Q[keep], weight[keep])
        if last - residual < tolerance * size:
            break
        last = residual
    return R, t, residual


def tilted(X, area, Y, area_y, start, *, degrees=15.0, **options):
    """ICP again from the end of an ICP tilted about each axis of Y both ways.

    As long as that ends nearer.

    ICP alone ends wherever no pair changes: on folded surfaces up to 20 degrees from the best
    rotation.  The axes are the principal ones, so that the end does not depend on how both lie.

    Parameters
    ----------
    X, area, Y, area_y : as of :func:`icp`
    start : tuple (R, t, residual)
        The end of an ICP with the same `options`.
    degrees : float
    **options
        Of :func:`icp`.

    Returns
    -------
    R, t, residual
    """
    best, center = start, area @ X / area.sum()
    B = principal_axes(Y, area_y)[1]
    tilts = [
        B @ Rotation.from_euler(axis, sign * degrees, True).as_matrix() @ B.T
        for axis in "xyz"
        for sign in (1, -1)
    ]
    for _ in range(5):
        R, t, residual = best
        middle = R @ center + t
        found = [
            icp(X, area, Y, area_y, P @ R, P @ (t - middle) + middle, **options) for P in tilts
        ]
        best = min(found, key=lambda f: f[2])
        if best[2] > 0.999 * residual:
            return R, t, residual
    return best


def align(X, area, Y, area_y, *, n_points=300, clearly=0.98, prefer=0.9):
    """Rigid motion of X onto Y by ICP.

    From the pose as given and from the four turns that align principal axes.

    The starts are compared by pairing `n_points` spread vertices of each shape.  Two go on, tilted:
    of the four turns, the best that ends within 90 degrees of where the pose as given (centred)
    ends, and the best of the others.  The former is kept unless the latter ends below `prefer`
    times its residual: near-symmetric shapes would otherwise be turned over by noise.  The pose as
    given takes its place only where that ends below `clearly` times its residual, as with shapes
    whose principal axes mean little; so the end does not depend on how the shapes were turned, as
    long as they lie within about 90 degrees of each other.  What is kept is then refined on all
    vertices.

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
    cx, A = principal_axes(X, area)
    cy, B = principal_axes(Y, area_y)
    flips = [np.diag(d) for d in itertools.product((1, -1), repeat=3) if np.prod(d) == 1]
    starts = [np.eye(3)] + [B @ flip @ A.T for flip in flips]
    options = {"clouds": (cloud(X, n_points), cloud(Y, n_points)), "tolerance": 2e-5}
    given, *found = [icp(X, area, Y, area_y, R, cy - R @ cx, **options) for R in starts]
    sides = {True: [], False: []}
    for f in found:
        sides[bool(np.trace(f[0].T @ given[0]) >= 1)].append(f)
    ends = {
        upright: tilted(X, area, Y, area_y, min(some, key=lambda f: f[2]), **options)
        for upright, some in sides.items()
        if some
    }
    if True in ends and clearly * ends[True][2] <= given[2]:
        best = ends[True]
    else:
        best = tilted(X, area, Y, area_y, given, **options)
    if False in ends and ends[False][2] < prefer * best[2]:
        best = ends[False]
    return icp(X, area, Y, area_y, *best[:2])


def realign(X, area, Y, area_y, start, *, n_points=300, clouds=None):
    """Rigid motion (R, t) of X onto Y by ICP, `n_points` spread vertices of each paired.

    From a start (R, t).
    """
    return icp(X, area, Y, area_y, *start, n_points=n_points, clouds=clouds, tolerance=2e-5)[:2]
