"""Rigid alignment by iterative closest points (4.1, step 2), and spread points.

A transform ``R, t`` carries x to R x + t, rows of X to ``X @ R.T + t``.
"""

import itertools
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from s4a.geometry.compiled import fpsample
from s4a.schema import Array

RigidTransform = tuple[Array, Array]  # R (3, 3), t (3,)
End = tuple[Array, Array, float]  # of an ICP: R, t and the residual

ROUGH = 2e-5  # tolerance where few points are paired, or ends are only compared: twice icp's own
N_POINTS = 300  # spread vertices of each shape by which starts are compared
CLEARLY, PREFER = 0.98, 0.9  # see align
TRIM = 0.1
TILT = 15.0  # degrees, tried both ways
residual_of = itemgetter(2)  # the residual of an ICP's end


class Cloud(NamedTuple):
    """The vertices of a shape as ICP takes them; see :func:`cloud`."""

    X: Array  # (n, 3)
    area: Array  # (n,)
    tree: cKDTree  # of all vertices
    paired: Array  # indices of those that are paired with the other shape's nearest


def rigid_transform(
    P: Array, Q: Array, weight: Array | None = None, *, scale: bool = False
) -> tuple[Array, Array, float]:
    """Return s R x + t that maps points P to Q with least (weighted) squared error.

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
    p, q = w @ P, w @ Q  # centroids
    U, S, Vt = np.linalg.svd((Q - q).T @ ((P - p) * w[:, None]))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])  # -1: no reflection
    R = (U * sign) @ Vt
    s = float(S @ sign / (w @ ((P - p) ** 2).sum(1))) if scale else 1.0
    return R, q - s * R @ p, s


def farthest_points(P: Array, k: int) -> Array:
    """Indices of k points, each as far as possible from those before it (Euclidean).

    The first is the point farthest from the mean, so that the choice follows the shape and not its
    numbering.  Where there are no more than k points, all are given in their own order.

    Parameters
    ----------
    P : float ndarray (n, d)
    k : int

    Returns
    -------
    int ndarray (k,)
        In the order of sampling.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.align import farthest_points
    >>> farthest_points(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]), 2).tolist()
    [2, 0]
    """
    if k >= len(P):
        return np.arange(len(P))
    start = int(np.argmax(((P - P.mean(0)) ** 2).sum(1)))
    if not fpsample:
        return farthest_samples(P, k, start)
    return fpsample.fps_sampling(P, k, start_idx=start).astype(np.int64)


def farthest_samples(P: Array, k: int, start: int) -> Array:
    """Farthest points from the point `start` on, by comparing all; fewer where points coincide.

    Parameters
    ----------
    P : float ndarray (n, d)
    k, start : int

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.align import farthest_samples
    >>> farthest_samples(np.array([[0.0, 0], [1, 0], [5, 0], [5, 0]]), 4, 0).tolist()
    [0, 2, 1]
    """
    columns = np.ascontiguousarray(P.T, float)
    sample, gap = [start], np.full(len(P), np.inf)
    while True:
        way = columns - columns[:, sample[-1:]]
        np.minimum(gap, (way * way).sum(0), out=gap)
        if len(sample) >= k or gap.max() == 0:
            break
        sample.append(int(gap.argmax()))
    return np.array(sample, np.int64)


def many_farthest_points(P: Array, k: int, *, center: Array, seed: int = 0) -> Array:
    """:func:`farthest_points` for thousands of points, by buckets; near ties may fall otherwise.

    Parameters
    ----------
    P : float ndarray (n, d)
    k : int
    center : float ndarray (d,)
        The first point is the farthest from it.
    seed : int
        Another seed starts elsewhere, near the seed-th farthest point.

    Returns
    -------
    int ndarray (k,)
        In the order of sampling; fewer where the points are fewer, or coincide.
    """
    if k >= len(P):
        return np.arange(len(P))
    if k < 1:
        return np.arange(0)
    P = P - center
    radius = np.linalg.norm(P, axis=1)
    if not fpsample:
        if seed:
            opposite = P[np.argsort(-radius, kind="stable")[seed % len(P)]]
            radius = np.linalg.norm(P + opposite, axis=1)
        return farthest_samples(P, k, int(radius.argmax()))
    # fpsample starts at a place in a tree of its own.  So a beacon is added, far away in one more
    # dimension; it may be taken again when all others coincide with samples, but goes in any case.
    beacon = np.zeros((1, P.shape[1] + 1))
    beacon[0, -1] = -8 * radius.max() - 1
    if seed:
        beacon[0, :-1] = -P[np.argsort(-radius, kind="stable")[seed % len(P)]]
    points = np.concatenate([beacon, np.c_[P, np.zeros(len(P))]])  # (n + 1, d + 1)
    height = min(7, int(np.log2(len(points))))  # of the tree; every leaf needs a point
    sample = fpsample.bucket_fps_kdline_sampling(points, k + 1, h=height, start_idx=0)
    _, first = np.unique(sample, return_index=True)
    return sample[np.sort(first)][1:].astype(np.int64) - 1


def principal_axes(X: Array, area: Array) -> tuple[Array, Array]:
    """Centroid and principal axes of an area-weighted point set.

    Returns
    -------
    center : float ndarray (3,)
    axes : float ndarray (3, 3)
        A proper rotation, the axes in its columns, the longest first.
    """
    w = area / area.sum()
    c = w @ X
    _, V = np.linalg.eigh((X - c).T @ ((X - c) * w[:, None]))
    V = V[:, ::-1]
    return c, V * np.array([1, 1, np.sign(np.linalg.det(V))])


def cloud(X: Array, area: Array, n_points: int | None = None) -> Cloud:
    """A shape's vertices and areas for ICP, which pairs `n_points` spread ones of it (or all)."""
    paired = np.arange(len(X)) if n_points is None else farthest_points(X, n_points)
    return Cloud(X, area, cKDTree(X), paired)


def icp(source: Cloud, target: Cloud, R: Array, t: Array, **options: Any) -> End:
    """:func:`icp_each` from one start R x + t."""
    return icp_each(source, target, [(R, t)], **options)[0]


def icp_each(
    source: Cloud,
    target: Cloud,
    starts: list[RigidTransform],
    *,
    iterations: int = 60,
    tolerance: float = 1e-5,
) -> list[End]:
    """Iterative closest points (Besl & McKay 1992) from each of some starts: moves the source.

    Each round pairs vertices of the source with the nearest of all of the target and vertices of
    the target with the nearest of all of the source, leaves out the farthest ``TRIM`` of the pairs,
    and solves for the transform, weighted by area.  Starts that still move are looked up together.

    Parameters
    ----------
    source, target : Cloud
    starts : list of tuple (R, t)
        R x + t.
    iterations : int
        At least 1.
    tolerance : float
        The end comes when the residual falls by less, as a share of sqrt(area of the source).

    Returns
    -------
    list of tuple (R, t, residual)
        The transform R x + t, and the trimmed root mean square distance of the pairs, both ways.
    """
    X, Y = source.X[source.paired], target.X[target.paired]
    area, area_y = source.area[source.paired], target.area[target.paired]
    weight = np.concatenate([area / area.sum(), area_y / area_y.sum()])
    least = tolerance * np.sqrt(source.area.sum())
    ends: list[End] = [(R, t, np.inf) for R, t in starts]
    moving = list(range(len(ends)))
    for _ in range(iterations):
        forth = _nearest(target, [X @ R.T + t for R, t, _ in (ends[i] for i in moving)])
        back = _nearest(source, [(Y - t) @ R for R, t, _ in (ends[i] for i in moving)])
        moved, moving = moving, []
        for i, (there, forth_distance), (here, back_distance) in zip(
            moved, forth, back, strict=True
        ):
            P = np.concatenate([X, source.X[here]])  # (pairs, 3)
            Q = np.concatenate([target.X[there], Y])
            gap = np.concatenate([forth_distance, back_distance])
            # two that are each other's nearest stay or go together, whatever the rounding
            keep = gap <= (1 + 1e-9) * np.quantile(gap, 1 - TRIM)
            residual = float(np.sqrt(weight[keep] @ gap[keep] ** 2 / weight[keep].sum()))
            R, t, _ = rigid_transform(P[keep], Q[keep], weight[keep])
            if ends[i][2] - residual >= least:
                moving.append(i)
            ends[i] = R, t, residual
        if not moving:
            break
    return ends


def _nearest(shape, places):
    """The nearest vertices of a cloud and their distances, for each of some arrays (p, 3)."""
    gap, nearest = shape.tree.query(np.concatenate(places))
    each = (len(places), -1)
    return zip(nearest.reshape(each), gap.reshape(each), strict=True)


def _try_tilts(source: Cloud, target: Cloud, start: End) -> End:
    """ICP again from its end tilted about each axis of the target, as long as that ends nearer.

    ICP alone ends wherever no pair changes: on folded surfaces up to 20 degrees from the best
    rotation.  The axes are the principal ones, so that the end does not depend on how both lie.

    Parameters
    ----------
    source, target : Cloud
    start : tuple (R, t, residual)
        The end of an ICP.

    Returns
    -------
    R, t, residual
    """
    _, axes = principal_axes(target.X, target.area)
    tilts = [
        axes @ Rotation.from_euler(axis, sign * TILT, degrees=True).as_matrix() @ axes.T
        for axis in "xyz"
        for sign in (1, -1)
    ]
    center = source.area @ source.X / source.area.sum()
    best = start
    for _ in range(5):
        R, t, residual = best
        middle = R @ center + t  # the tilts turn X about where its centre has come to lie
        starts = [(tilt @ R, tilt @ (t - middle) + middle) for tilt in tilts]
        end = min(icp_each(source, target, starts, tolerance=ROUGH), key=residual_of)
        if residual_of(end) > 0.999 * residual:
            return best
        best = end
    return best


def align(X: Array, area: Array, Y: Array, area_y: Array) -> End:
    """Rigid transform of X onto Y by ICP from several initial rotations.

    The starts are compared by pairing ``N_POINTS`` spread vertices of each shape.  Two go on,
    tilted: of the four turns that align principal axes, the best that ends within 90 degrees of
    where the pose as given (centred) ends, and the best of the others.  The former is kept unless
    the latter ends below ``PREFER`` times its residual: near-symmetric shapes would otherwise be
    turned over by noise.  The pose as given takes its place only where that ends below ``CLEARLY``
    times its residual, as with shapes whose principal axes mean little; so the end does not depend
    on how the shapes were turned, as long as they lie within about 90 degrees of each other.  What
    is kept is then refined on all vertices.

    Parameters
    ----------
    X, Y : float ndarray (n, 3), (p, 3)
        Vertices, usually of low-resolution meshes.
    area, area_y : float ndarray (n,), (p,)
        Their areas.

    Returns
    -------
    R, t, residual : as of :func:`icp_each`
    """
    center, A = principal_axes(X, area)
    center_y, B = principal_axes(Y, area_y)
    flips = [np.diag(d) for d in itertools.product((1, -1), repeat=3) if np.prod(d) == 1]
    turns = [np.eye(3)] + [B @ flip @ A.T for flip in flips]
    starts = [(R, center_y - R @ center) for R in turns]
    source, target = cloud(X, area, N_POINTS), cloud(Y, area_y, N_POINTS)
    posed, *turned = icp_each(source, target, starts, tolerance=ROUGH)
    # the trace of a rotation is 1 + 2 cos(angle): 1 at 90 degrees
    as_posed = [np.trace(R.T @ posed[0]) >= 1 for R, _, _ in turned]
    upright, upside_down = (
        list(itertools.compress(turned, side)) for side in (as_posed, np.invert(as_posed))
    )
    best, other = (
        _try_tilts(source, target, min(ends, key=residual_of)) if ends else None
        for ends in (upright, upside_down)
    )
    if best is None or CLEARLY * residual_of(best) > residual_of(posed):
        best = _try_tilts(source, target, posed)
    if other is not None and residual_of(other) < PREFER * residual_of(best):
        best = other
    R, t, _ = best
    return icp(cloud(X, area), cloud(Y, area_y), R, t)


def realign(source: Cloud, target: Cloud, start: RigidTransform) -> RigidTransform:
    """Rigid transform (R, t) of the source onto the target by ICP from a start (R, t) near it."""
    R, t, _ = icp(source, target, *start, tolerance=ROUGH)
    return R, t


def relative_transform(source: RigidTransform, target: RigidTransform) -> RigidTransform:
    """The transform source -> target from the transforms (R, t) of both onto a common reference.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.align import relative_transform
    >>> R, t = relative_transform((np.eye(3), np.ones(3)), (np.eye(3), np.zeros(3)))
    >>> t.tolist()
    [1.0, 1.0, 1.0]
    """
    (R, t), (R_target, t_target) = source, target
    return R_target.T @ R, R_target.T @ (t - t_target)
