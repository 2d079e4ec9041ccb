"""Rigid alignment by iterative closest points (4.1, step 2) and farthest-point sampling.

A transform ``R, t`` maps x to R x + t, rows of X to ``X @ R.T + t``.
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
IcpResult = tuple[Array, Array, float]  # R, t and the residual

ROUGH = 2e-5  # tolerance for few points, or for results that are only compared: twice the default
N_POINTS = 300  # farthest-point samples of each shape used to compare initialisations
CLEARLY, PREFER = 0.98, 0.9  # see align
TRIM = 0.1
TILT = 15.0  # degrees, in both directions
residual_of = itemgetter(2)  # the residual of an ICP result


class Cloud(NamedTuple):
    """Vertices of a shape prepared for ICP; see :func:`cloud`."""

    X: Array  # (n, 3)
    area: Array  # (n,)
    tree: cKDTree  # of all vertices
    paired: Array  # indices of the vertices paired with their nearest neighbours


def rigid_transform(
    P: Array, Q: Array, weight: Array | None = None, *, scale: bool = False
) -> tuple[Array, Array, float]:
    """Fit s R x + t that maps points P to Q with least (weighted) squared error.

    The solution of Kabsch by the SVD of the cross-covariance, or with ``scale=True`` that of
    Umeyama.

    Parameters
    ----------
    P, Q : float ndarray (n, 3)
        Corresponding points.
    weight : float ndarray (n,), optional
    scale : bool
        Whether to fit a uniform scale as well.

    Returns
    -------
    R : (3, 3) proper rotation
    t : (3,)
    s : float, 1.0 without `scale`

    References
    ----------
    S. Umeyama (1991), Least-squares estimation of transformation parameters between two point
    patterns, IEEE TPAMI 13(4).

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
    """Return indices of k farthest-point samples (Euclidean).

    The first sample is the point farthest from the mean, so the samples do not depend on the
    numbering.  If there are at most k points, all are returned in their order.

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
    """Farthest-point samples from the point `start`, by brute force; fewer if points coincide.

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
    sample, distance2 = [start], np.full(len(P), np.inf)
    while True:
        offset = columns - columns[:, sample[-1:]]
        np.minimum(distance2, (offset * offset).sum(0), out=distance2)
        if len(sample) >= k or distance2.max() == 0:
            break
        sample.append(int(distance2.argmax()))
    return np.array(sample, np.int64)


def many_farthest_points(P: Array, k: int, *, center: Array, seed: int = 0) -> Array:
    """Farthest-point samples of many points, by buckets; near ties may differ.

    Parameters
    ----------
    P : float ndarray (n, d)
    k : int
    center : float ndarray (d,)
        The first sample is the point farthest from it.
    seed : int
        Another seed starts near the seed-th farthest point.

    Returns
    -------
    int ndarray (k,)
        In the order of sampling; fewer if there are fewer points, or points coincide.

    See Also
    --------
    farthest_points : exact, for smaller sets.
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
    # fpsample starts at a node of its own tree.  So a first point is added, far away in an
    # additional dimension; it may be sampled again when all others coincide with samples, and is
    # removed.
    extra = np.zeros((1, P.shape[1] + 1))
    extra[0, -1] = -8 * radius.max() - 1
    if seed:
        extra[0, :-1] = -P[np.argsort(-radius, kind="stable")[seed % len(P)]]
    points = np.concatenate([extra, np.c_[P, np.zeros(len(P))]])  # (n + 1, d + 1)
    height = min(7, int(np.log2(len(points))))  # of the tree; each leaf needs a point
    sample = fpsample.bucket_fps_kdline_sampling(points, k + 1, h=height, start_idx=0)
    _, first = np.unique(sample, return_index=True)
    return sample[np.sort(first)][1:].astype(np.int64) - 1


def principal_axes(X: Array, area: Array) -> tuple[Array, Array]:
    """Return centroid and principal axes of an area-weighted point set.

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
    """Prepare vertices and areas for ICP, which pairs `n_points` samples of them (or all)."""
    paired = np.arange(len(X)) if n_points is None else farthest_points(X, n_points)
    return Cloud(X, area, cKDTree(X), paired)


def icp(source: Cloud, target: Cloud, R: Array, t: Array, **options: Any) -> IcpResult:
    """Run :func:`icp_each` from one initial transform R x + t."""
    return icp_each(source, target, [(R, t)], **options)[0]


def icp_each(
    source: Cloud,
    target: Cloud,
    starts: list[RigidTransform],
    *,
    iterations: int = 60,
    tolerance: float = 1e-5,
) -> list[IcpResult]:
    """Trimmed, bidirectional iterative closest points from several initial transforms.

    Each iteration pairs vertices of the source with the nearest of the target and vertices of the
    target with the nearest of the source, drops the farthest ``TRIM`` of the pairs, and solves for
    the transform of the source, weighted by area.  Neighbours of all initialisations that have not
    converged are queried together.

    Parameters
    ----------
    source, target : Cloud
    starts : list of tuple (R, t)
        Initial transforms R x + t.
    iterations : int
        At least 1.
    tolerance : float
        Stop when the residual decreases by less, as a share of sqrt(area of the source).

    Returns
    -------
    list of tuple (R, t, residual)
        The transform R x + t, and the trimmed root mean square distance of the pairs in both
        directions.

    References
    ----------
    P. Besl and N. McKay (1992), A method for registration of 3-D shapes, IEEE TPAMI 14(2).
    """
    X, Y = source.X[source.paired], target.X[target.paired]
    area, area_y = source.area[source.paired], target.area[target.paired]
    weight = np.concatenate([area / area.sum(), area_y / area_y.sum()])
    least = tolerance * np.sqrt(source.area.sum())
    ends: list[IcpResult] = [(R, t, np.inf) for R, t in starts]
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
            distance = np.concatenate([forth_distance, back_distance])
            # mutual nearest neighbours are kept or dropped together, whatever the rounding
            keep = distance <= (1 + 1e-9) * np.quantile(distance, 1 - TRIM)
            residual = float(np.sqrt(weight[keep] @ distance[keep] ** 2 / weight[keep].sum()))
            R, t, _ = rigid_transform(P[keep], Q[keep], weight[keep])
            if ends[i][2] - residual >= least:
                moving.append(i)
            ends[i] = R, t, residual
        if not moving:
            break
    return ends


def _nearest(shape, points):
    """Nearest vertices of a cloud and their distances, for each array (p, 3) of a list."""
    distance, nearest = shape.tree.query(np.concatenate(points))
    each = (len(points), -1)
    return zip(nearest.reshape(each), distance.reshape(each), strict=True)


def _try_tilts(source: Cloud, target: Cloud, start: IcpResult) -> IcpResult:
    """Repeat ICP from its result tilted about each principal axis, as long as it improves.

    ICP alone stops when no pair changes: on folded surfaces up to 20 degrees from the best
    rotation. With the principal axes of the target the result does not depend on the poses of the
    files.

    Parameters
    ----------
    source, target : Cloud
    start : tuple (R, t, residual)
        Result of an ICP.

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
        middle = R @ center + t  # the tilts rotate X about its moved centre
        starts = [(tilt @ R, tilt @ (t - middle) + middle) for tilt in tilts]
        end = min(icp_each(source, target, starts, tolerance=ROUGH), key=residual_of)
        if residual_of(end) > 0.999 * residual:
            return best
        best = end
    return best


def align(X: Array, area: Array, Y: Array, area_y: Array) -> IcpResult:
    """Rigid transform of X onto Y by ICP from several initial rotations.

    The initialisations are compared with ``N_POINTS`` samples of each shape.  Two are refined with
    tilts: of the four rotations that align principal axes, the best result within 90 degrees of the
    result from the pose as given (centred), and the best of the others.  The former is kept unless
    the residual of the latter is below ``PREFER`` times its own, since noise would otherwise flip
    nearly symmetric shapes.  The pose as given replaces it only if the residual is below
    ``CLEARLY`` times its own, as for shapes with ambiguous principal axes.  So the result does not
    depend on the rotation of the files, if they lie within about 90 degrees of each other.  The
    final result is refined on all vertices.

    Parameters
    ----------
    X, Y : float ndarray (n, 3), (p, 3)
        Vertices, usually of low-resolution meshes.
    area, area_y : float ndarray (n,), (p,)
        Their areas.

    Returns
    -------
    R, t, residual : as for :func:`icp_each`

    See Also
    --------
    icp : ICP from one initial transform.
    rigid_transform : least-squares transform of corresponding points.
    """
    center, A = principal_axes(X, area)
    center_y, B = principal_axes(Y, area_y)
    flips = [np.diag(d) for d in itertools.product((1, -1), repeat=3) if np.prod(d) == 1]
    rotations = [np.eye(3)] + [B @ flip @ A.T for flip in flips]
    starts = [(R, center_y - R @ center) for R in rotations]
    source, target = cloud(X, area, N_POINTS), cloud(Y, area_y, N_POINTS)
    posed, *rotated = icp_each(source, target, starts, tolerance=ROUGH)
    # the trace of a rotation is 1 + 2 cos(angle): 1 at 90 degrees
    as_posed = [np.trace(R.T @ posed[0]) >= 1 for R, _, _ in rotated]
    upright, upside_down = (
        list(itertools.compress(rotated, side)) for side in (as_posed, np.invert(as_posed))
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
    """Rigid transform (R, t) of the source onto the target by ICP from a close one."""
    R, t, _ = icp(source, target, *start, tolerance=ROUGH)
    return R, t


def relative_transform(source: RigidTransform, target: RigidTransform) -> RigidTransform:
    """Return the transform source -> target from those of the two onto a common reference.

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
