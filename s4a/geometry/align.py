"""Rigid alignment by iterative closest points (4.1, step 2) and farthest-point sampling.

A transform ``R, t`` maps x to R x + t, rows of X to ``X @ R.T + t``.
"""

from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from s4a.geometry.compiled import fpsample
from s4a.geometry.mesh import norms
from s4a.schema import Array

RigidTransform = tuple[Array, Array]  # R (3, 3), t (3,)
IcpResult = tuple[Array, Array, float]  # R, t and the residual

ROUGH = 2e-5  # tolerance for few points, or for results that are only compared: twice the default
N_PAIRED = 500  # farthest-point samples of each shape that are paired with nearest neighbours
N_ROUGH = 100  # of them, those that are paired to compare many initial rotations
# of unit normals relative to positions: pairs of points on different folds are farther apart
NORMAL_WEIGHT = 0.2
SIMILAR = 1.2  # ratio of the extents along two principal axes below which they can be exchanged
DISTINCT = 45.0  # degrees between two poses
N_POSES = 4  # poses that are compared with all samples
# residual of a pose over that of the best, up to which it is compared with other shapes
LIKELY = 1.5
residual_of = itemgetter(2)  # the residual of an ICP result


class Cloud(NamedTuple):
    """Vertices of a shape prepared for ICP; see :func:`cloud`."""

    X: Array  # (n, 3)
    area: Array  # (n,)
    tree: cKDTree  # of the rows of all vertices
    paired: Array  # indices of the vertices paired with their nearest neighbours
    normals: Array | None = None  # (n, 3), unit normals if they are used

    def thinned(self, n: int = N_ROUGH) -> "Cloud":
        """Return the cloud with n of its paired vertices, farthest-point samples."""
        return self._replace(paired=self.paired[farthest_points(self.X[self.paired], n)])

    def rows(self, i: Array | slice = slice(None), R: Array | None = None, t: Any = 0) -> Array:
        """Return positions and weighted normals of some vertices ``(p, 3 or 6)``, moved by R, t."""
        R = np.eye(3) if R is None else R
        moved = self.X[i] @ R.T + t
        if self.normals is None:
            return moved
        return np.concatenate([moved, NORMAL_WEIGHT * self.normals[i] @ R.T], axis=1)


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


def oscillation(P: Array) -> Array:
    """Return a number in [-1, 1] for each point ``(n, d)`` that breaks ties in any pose.

    Vertices of surfaces from volumes lie on a grid.  Rounding would decide between equally distant
    ones, and the result would depend on the pose of the file.  The number oscillates with the
    distance from the mean: slowly enough for the rounding of files in single precision, quickly
    enough for neighbours.
    """
    radius = norms(P - P.mean(0))
    return np.sin(300 * radius / max(radius.mean(), 1e-300))


def without_ties(P: Array, size: float = 1e-3) -> Array:
    """Move points ``(n, d)`` from their mean by at most `size` times the radius; few tie then."""
    offset = P - P.mean(0)
    offset *= size * oscillation(P)[:, None]
    return np.add(P, offset, out=offset)


def farthest_points(P: Array, k: int) -> Array:
    """Return indices of k farthest-point samples (Euclidean).

    The first sample is the point farthest from the mean, and the points are sampled
    :func:`without_ties`, so the samples depend neither on the numbering nor on the pose, except
    where points are equally far from the mean, as on a mirror-symmetric shape.  If there are at
    most k points, all are returned in their order.

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
    P = without_ties(P)
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
    P = without_ties(P) - center
    radius = norms(P)
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
    most = int(np.log2(len(points)))  # height of the tree: each leaf needs a point
    height = min(most, max(7, most - 9))
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


def cloud(
    X: Array, area: Array, paired: int | Array | None = None, normals: Array | None = None
) -> Cloud:
    """Prepare vertices, areas and normals for ICP.

    `paired` are the vertices that it pairs, or the number of farthest-point samples; all by
    default.
    """
    if paired is None or isinstance(paired, int):
        paired = farthest_points(X, len(X) if paired is None else paired)
    bare = Cloud(X, area, cKDTree(X), paired, normals)
    return bare if normals is None else bare._replace(tree=cKDTree(bare.rows()))


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
    trim: float = 0.0,
) -> list[IcpResult]:
    """Bidirectional iterative closest points from several initial transforms.

    Each iteration pairs vertices of the source with the nearest of the target and vertices of the
    target with the nearest of the source, in position and normal if the clouds have normals, and
    solves for the transform of the source, weighted by area.  Neighbours of all initialisations
    that have not converged are queried together.

    Parameters
    ----------
    source, target : Cloud
    starts : list of tuple (R, t)
        Initial transforms R x + t.
    iterations : int
        At least 1.
    tolerance : float
        Stop when the residual decreases by less, as a share of sqrt(area of the source).
    trim : float
        Share of the pairs that are dropped, the farthest ones.

    Returns
    -------
    list of tuple (R, t, residual)
        The transform R x + t, and the root mean square distance of the pairs in both directions,
        with the difference of weighted normals if there are normals.

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
        now = [ends[i][:2] for i in moving]
        forth = _nearest(target, [source.rows(source.paired, R, t) for R, t in now])
        back = _nearest(source, [target.rows(target.paired, R.T, -t @ R) for R, t in now])
        moved, moving = moving, []
        for i, (there, forth_distance), (here, back_distance) in zip(
            moved, forth, back, strict=True
        ):
            P = np.concatenate([X, source.X[here]])  # (pairs, 3)
            Q = np.concatenate([target.X[there], Y])
            distance = np.concatenate([forth_distance, back_distance])
            keep = _nearer_pairs(distance, trim)
            residual = float(np.sqrt(weight[keep] @ distance[keep] ** 2 / weight[keep].sum()))
            R, t, _ = rigid_transform(P[keep], Q[keep], weight[keep])
            if ends[i][2] - residual >= least:
                moving.append(i)
            ends[i] = R, t, residual
        if not moving:
            break
    return ends


def _nearer_pairs(distance, trim):
    """Pairs without a share of the farthest; mutual nearest neighbours go together."""
    if not trim:
        return slice(None)
    at = (1 - trim) * (len(distance) - 1)
    below = int(at)
    low, high = np.partition(distance, (below, below + 1))[below : below + 2]
    return distance <= (1 + 1e-9) * (low + (high - low) * (at - below))  # whatever the rounding


def _nearest(shape, rows):
    """Nearest vertices of a cloud and their distances, for each array (p, d) of a list."""
    distance, nearest = shape.tree.query(np.concatenate(rows))
    each = (len(rows), -1)
    return zip(nearest.reshape(each), distance.reshape(each), strict=True)


def point_to_point(source: Cloud, target: Cloud, R: Array, t: Array) -> IcpResult:
    """Run plain ICP of Besl and McKay from one initial transform, without weights.

    Each iteration pairs every vertex of the source with the nearest of the target in space.

    Returns
    -------
    R, t, residual : as for :func:`icp_each`, in one direction
    """
    tree, least, residual = cKDTree(target.X), 1e-6 * np.sqrt(source.area.sum()), np.inf
    for _ in range(200):
        distance, nearest = tree.query(source.X @ R.T + t)
        before, residual = residual, float(np.sqrt((distance**2).mean()))
        if before - residual < least:
            break
        R, t, _ = rigid_transform(source.X, target.X[nearest])
    return R, t, residual


def initial_transforms(source: Cloud, target: Cloud) -> list[RigidTransform]:
    """Return transforms that align centroids and principal axes.

    There are four, or 16 or 24 where the extents along principal axes are similar.  They depend on
    the geometry of the shapes, not on the pose of the files.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.geometry.align import cloud, initial_transforms
    >>> box = np.array([[x, y, z] for x in (-3.0, 3) for y in (-2.0, 2) for z in (-1.0, 1)])
    >>> stick = cloud(box, np.ones(8)), cloud(box * [1, 0.5, 1], np.ones(8))
    >>> len(initial_transforms(stick[0], stick[0])), len(initial_transforms(*stick))
    (4, 16)
    """
    (center, A, ratio), (center_y, B, ratio_y) = (
        (*axes, _extent_ratios(shape, *axes))
        for shape in (source, target)
        for axes in [principal_axes(shape.X, shape.area)]
    )
    similar = tuple(np.minimum(ratio, ratio_y) < SIMILAR)
    names = {(False, False): "D2", (True, False): "D8", (False, True): "D8", (True, True): "O"}
    # D8: rotations by multiples of 45 degrees about an axis, and half turns about axes across it
    group = Rotation.create_group(names[similar], "X" if similar[1] else "Z").as_matrix()
    rotations = [B @ turn @ A.T for turn in group]
    return [(R, center_y - R @ center) for R in rotations]


def _extent_ratios(shape, center, axes):
    """Ratios of the extents along the first two, and the last two, principal axes ``(2,)``."""
    extent = np.sqrt(shape.area @ ((shape.X - center) @ axes) ** 2)
    return extent[:2] / np.maximum(extent[1:], 1e-300)


def poses(source: Cloud, target: Cloud) -> list[IcpResult]:
    """Return distinct transforms of the source onto the target by ICP, the best first.

    ICP starts at the :func:`initial_transforms`, and pairs few points at first.
    """
    starts, few = initial_transforms(source, target), (source.thinned(), target.thinned())
    ends = distinct(icp_each(*few, starts, tolerance=1e-3, iterations=15))[:N_POSES]
    return distinct(icp_each(source, target, [end[:2] for end in ends], tolerance=ROUGH))


def distinct(ends: list[IcpResult]) -> list[IcpResult]:
    """Sort results of ICP by residual.

    Those within ``DISTINCT`` degrees of a better one, and those of more than ``LIKELY`` times the
    least residual, are omitted.
    """
    chosen: list[IcpResult] = []
    for end in sorted(ends, key=residual_of):
        if chosen and end[2] > LIKELY * chosen[0][2]:
            break
        # the trace of a rotation is 1 + 2 cos(angle)
        cosines = [(np.trace(end[0].T @ other[0]) - 1) / 2 for other in chosen]
        if max(cosines, default=-1.0) < np.cos(np.deg2rad(DISTINCT)):
            chosen.append(end)
    return chosen


def align(source: Cloud, target: Cloud) -> IcpResult:
    """Rigid transform of the source onto the target: the best of :func:`poses`.

    The result does not depend on the pose of the files.

    Returns
    -------
    R, t, residual : as for :func:`icp_each`

    See Also
    --------
    s4a.method.alignment.align_onto : Also detect equally good poses.
    rigid_transform : least-squares transform of corresponding points.
    """
    return poses(source, target)[0]


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
