"""Partial shape on a complete one (4.2, 6.1): alignment, match and missing region.

Points of the partial shape search the nearest points, in position and normal, of the mean shape
deformed by its modes.  The search has one direction, since missing vertices have no counterpart.
Rigid ICP runs first from many initialisations: the rotations of a cube, about the centres of
regions as large as the partial shape.  From the best results, each iteration solves for a small
transform and the scores b that minimise

    sum_j a_j |z_j + sum_c b_c B_cj - p_j|^2_j + (r^2 / N) |b|^2,

where |.|_j mostly counts the distance across the surface, as in :mod:`s4a.method.elastic`, r is the
residual and N the number of independent points.  Distances far above the median are left out, and
points whose nearest point is on the boundary of the complete shape.  A vertex of the complete shape
is present if the nearest point of the partial shape is close, has a similar normal and is not on
the boundary of the partial shape.  Elastic and local iterations of the present vertices follow.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from s4a.geometry.align import farthest_points, rigid_transform
from s4a.geometry.closest import (
    closest_point,
    closest_point_in_star,
    feature_tree,
    features,
    interpolate,
    stars,
)
from s4a.geometry.mesh import triangle_normals, vertex_areas, vertex_normals
from s4a.method.elastic import elastic_iterations, local_iterations
from s4a.method.shape import Basis, Shape
from s4a.method.spectral import Diffusion
from s4a.schema import Array

N_ROUGH = 150  # points of the partial shape in the first iterations of ICP
N_ROUGH_ITERATIONS = 12
N_POINTS = 1500  # points in iterations with modes
N_ITERATIONS = 40
N_ANCHORS = 8  # regions of the complete shape on which ICP begins
N_INITIALISATIONS = 16  # ICP results that are refined
N_INDEPENDENT = 100
FAR = 3.0  # largest distance, relative to the median
SLIDE = 0.1  # weight of the distance along the surface
LEAST_DISTANCE = 0.01  # share of sqrt(area): smaller distances are never left out
PREFER = 0.9  # a rotation unlike those of the study needs a residual below this share
LARGEST_ANGLE = 60.0  # degrees within which a pose is like those of the study


class Pose(NamedTuple):
    """Transform s R x + t of a partial shape into the frame of the template."""

    R: Array
    t: Array
    s: float

    def __call__(self, X: Array) -> Array:
        """Transform points ``(n, 3)``."""
        return self.s * X @ self.R.T + self.t


class Part(NamedTuple):
    """A partial shape: vertices, triangles, normals, areas and boundary."""

    X: Array
    T: Array
    N: Array
    area: Array
    boundary: Array  # (n,) of bool

    def samples(self, n: int) -> Array:
        """Return farthest-point samples of the interior vertices."""
        inner = np.flatnonzero(~self.boundary & (self.area > 0))
        return inner[farthest_points(self.X[inner], n)]


class Whole(NamedTuple):
    """Mean shape and modes at low resolution, of unit area."""

    X: Array  # (n, 3)
    T: Array
    modes: Array  # (c, n, 3)
    boundary: Array  # (n,) of bool


class Fit(NamedTuple):
    """Fit of a partial shape: its pose and the scores ``b`` of the complete shape.

    ``residual``: root mean square distance across the surface of the points that were not left out;
    ``inside``: their share.
    """

    pose: Pose
    b: Array
    residual: float
    inside: float


def on_boundary(T: Array, n: int) -> Array:
    """Find the boundary vertices ``(n,)`` of a mesh.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.part import on_boundary
    >>> on_boundary(np.array([[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]]), 4).any()
    np.False_
    """
    boundary = Basis(np.zeros((n, 3)), T, np.ones(n), np.zeros((n, 0))).boundary
    result = np.zeros(n, bool)
    result[np.unique(boundary)] = True
    return result


def part_of(X: Array, T: Array) -> Part:
    """Return a partial shape from its vertices and triangles."""
    return Part(X, T, vertex_normals(X, T), vertex_areas(X, T), on_boundary(T, len(X)))


def cut(X: Array, T: Array, keep: Array) -> tuple[Array, Array]:
    """Cut a surface to the triangles whose vertices are kept.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.part import cut
    >>> T = np.array([[0, 1, 2], [1, 3, 2]])
    >>> cut(np.eye(4, 3), T, np.array([False, True, True, True]))[1].tolist()
    [[0, 2, 1]]
    """
    T = T[keep[T].all(1)]
    used = np.unique(T)
    number = np.full(len(X), -1)
    number[used] = np.arange(len(used))
    return X[used], number[T]


def rough_poses(
    part: Part, whole: Whole, usual: Pose, *, rotations: str = "O"
) -> list[tuple[float, Pose]]:
    """Return poses by ICP of some points of the partial shape, with residuals, best first.

    Parameters
    ----------
    part : Part
    whole : Whole
    usual : Pose
        Mean pose of the shapes of the study; rotations and translations are relative to it.
    rotations : {"O", "I"}
        The 24 rotations of a cube, or the 60 of an icosahedron.
    """
    P = usual(part.X[part.samples(N_ROUGH)])
    center = P.mean(0)
    tree = cKDTree(whole.X)
    anchors = _anchors(whole, usual.s**2 * part.area.sum())
    shifts = [np.zeros(3), *(anchors - center)]
    results = []
    for rotation in Rotation.create_group(rotations).as_matrix():
        for shift in shifts:
            R, t = rotation, center + shift - rotation @ center
            residual = np.inf
            for _ in range(N_ROUGH_ITERATIONS):
                distance, nearest = tree.query(P @ R.T + t)
                keep = distance <= np.quantile(distance, 0.9)
                R, t, _ = rigid_transform(P[keep], whole.X[nearest[keep]])
                before, residual = residual, float(np.sqrt((distance[keep] ** 2).mean()))
                if before - residual < 0.01 * residual:
                    break
            results.append((residual, Pose(R @ usual.R, R @ usual.t + t, usual.s)))
    return sorted(results, key=lambda result: result[0])


def _anchors(whole, area):
    """Centres ``(N_ANCHORS, 3)`` of regions of the given area around samples."""
    weight = vertex_areas(whole.X, whole.T)
    centers = []
    for vertex in farthest_points(whole.X, N_ANCHORS):
        order = np.argsort(np.linalg.norm(whole.X - whole.X[vertex], axis=1))
        inside = order[: np.searchsorted(np.cumsum(weight[order]), area) + 1]
        centers.append(weight[inside] @ whole.X[inside] / weight[inside].sum())
    return np.array(centers)


def distinct(
    results: list[tuple[float, Pose]], usual: Pose, part: Part, most: int = N_INITIALISATIONS
) -> list[Pose]:
    """Return the best distinct poses, and the best of those near the usual one."""
    points = part.X[part.samples(20)]
    near = [result for result in results if angle(result[1], usual) < LARGEST_ANGLE]
    chosen: list[Pose] = []
    for _, pose in [*near[:1], *results]:
        moved = pose(points)
        if all(np.linalg.norm(moved - other(points), axis=1).mean() > 0.05 for other in chosen):
            chosen.append(pose)
        if len(chosen) == most:
            break
    return chosen


def angle(pose: Pose, other: Pose) -> float:
    """Return the angle between two poses in degrees."""
    rotation = Rotation.from_matrix(pose.R @ other.R.T)
    return float(np.degrees(rotation.magnitude()))


def fit_modes(
    part: Part, whole: Whole, pose: Pose, *, iterations: int = N_ITERATIONS, free_size: bool = False
) -> Fit:
    """Fit pose and scores of a partial shape by iterated nearest points.

    Parameters
    ----------
    part, whole : see :class:`Part`, :class:`Whole`
    pose : Pose
        Initial pose.
    iterations : int
    free_size : bool
        Whether to fit the size as well.
    """
    sample = part.samples(N_POINTS)
    P, N, weight = part.X[sample], part.N[sample], part.area[sample]
    star = stars(whole.T, len(whole.X))
    c = len(whole.modes)
    b = np.zeros(c)
    modes = whole.modes.transpose(1, 2, 0)  # (n, 3, c)
    residual, inside, last = np.inf, 0.0, np.inf
    for step in range(iterations):
        Z = whole.X + modes @ b
        normals = vertex_normals(Z, whole.T)
        p, m = pose(P), N @ pose.R.T
        near = feature_tree(Z, whole.T).query(features(p, m))[1]
        triangle, share = closest_point_in_star(p, near, Z, whole.T, star)
        z, n = (interpolate(values, whole.T, triangle, share) for values in (Z, normals))
        keep = _inliers(p - z, m, n, whole.boundary, whole.T[triangle], share)
        inside = float(weight[keep].sum() / weight.sum())
        across = m + n
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        w = weight[keep] / weight[keep].sum()
        off = np.einsum("jx,jx->j", across, p - z)[keep]
        residual = float(np.sqrt(w @ off**2))
        columns = interpolate(modes.reshape(len(Z), -1), whole.T, triangle, share)
        columns = columns.reshape(len(p), 3, c)[keep]
        pose, b = _solve(pose, b, p[keep], z[keep], across[keep], columns, w, residual, free_size)
        if step >= 10 and last - residual < 1e-3 * residual:
            break
        last = residual
    return Fit(pose, b, residual, inside)


def _inliers(offset, m, n, boundary, corners, share):
    """Find points that are close, have similar normals and are not nearest to the boundary."""
    distance = np.linalg.norm(offset, axis=1)
    same = np.einsum("jx,jx->j", m, n) > 0.3
    at_boundary = ((share > 1e-6) <= boundary[corners]).all(1)  # all corners with weight are on it
    good = same & ~at_boundary
    limit = max(FAR * float(np.median(distance[good])) if good.any() else 0.0, LEAST_DISTANCE)
    good &= distance <= limit
    return good if good.sum() > 30 else distance <= np.quantile(distance, 0.9)


def _solve(pose, b, p, z, across, columns, weight, residual, free_size):
    """One Gauss-Newton step: small transform of the partial shape, and new scores."""
    c = len(b)
    center = weight @ p
    q = 7 if free_size else 6
    E = np.zeros((len(p), 3, c + q))
    E[:, :, :c] = columns
    rotations = np.cross(np.eye(3)[:, None], (p - center)[None])  # (3, j, 3)
    E[:, :, c : c + 3] = -rotations.transpose(1, 2, 0)
    E[:, :, c + 3 : c + 6] = -np.eye(3)
    if free_size:
        E[:, :, c + 6] = center - p
    y = p - z + columns @ b  # to be explained by modes and transform
    along = np.einsum("jx,jxq->jq", across, E)
    right = np.einsum("jx,jx->j", across, y)
    rows = (E * (SLIDE * weight)[:, None, None]).reshape(-1, c + q)
    H = rows.T @ E.reshape(-1, c + q) + (along * ((1 - SLIDE) * weight)[:, None]).T @ along
    g = rows.T @ y.ravel() + along.T @ ((1 - SLIDE) * weight * right)
    penalty = max(residual, 1e-4) ** 2 / N_INDEPENDENT
    H[np.diag_indices(c)] += penalty
    H[np.diag_indices(c + q)] += 1e-12
    x = np.linalg.solve(H, g)
    b = x[:c] * min(1.0, 3 * np.sqrt(c) / max(np.linalg.norm(x[:c]), 1e-12)) if c else x[:c]
    R = Rotation.from_rotvec(x[c : c + 3]).as_matrix()
    grow = 1 + float(np.clip(x[c + 6], -0.1, 0.1)) if free_size else 1.0
    t = center + x[c + 3 : c + 6] - grow * R @ center
    return Pose(R @ pose.R, grow * R @ pose.t + t, grow * pose.s), b


def best_fit(part: Part, whole: Whole, poses: list[Pose], usual: Pose, free_size: bool) -> Fit:
    """Return the best fit from several poses; a rotation far from the usual one must be clear.

    Fits are compared by the residual divided by the share of the points that it includes.
    """
    fits = [fit_modes(part, whole, pose, iterations=15, free_size=free_size) for pose in poses]
    # continue all fits, from the mean shape: after few iterations the correct one may be behind
    fits = [fit_modes(part, whole, fit.pose, free_size=free_size) for fit in fits]

    def score(fit: Fit) -> float:
        rotated = angle(fit.pose, usual) > LARGEST_ANGLE
        value = fit.residual / max(fit.inside, 0.05) * np.sqrt(1 + fit.b @ fit.b / N_INDEPENDENT)
        return value / PREFER if rotated else value

    return min(fits, key=score)


def present_vertices(X: Array, N: Array, part: Part, placed: Array, limit: float) -> Array:
    """Find the vertices ``(n,)`` of the complete shape that the partial shape has.

    Parameters
    ----------
    X, N : float ndarray (n, 3)
        Vertices and normals of the complete shape.
    part : Part
    placed : float ndarray (p, 3)
        Vertices of the partial shape in the frame of the complete one.
    limit : float
        Largest distance.
    """
    triangle, share = closest_point(X, placed, part.T)
    corners = part.T[triangle]
    at_boundary = ((share > 1e-6) <= part.boundary[corners]).all(1)
    at_boundary &= (share > 1e-6).sum(1) < 3
    distance = np.linalg.norm(X - interpolate(placed, part.T, triangle, share), axis=1)
    facing = np.einsum("nx,nx->n", N, triangle_normals(placed, part.T)[triangle]) > 0
    return (distance <= limit) & facing & ~at_boundary


def refine(part: Part, placed: Array, target: Shape, X_low: Array, present: Array) -> Array:
    """Return the coarse vertices ``(n, 3)`` after elastic and local iterations.

    Parameters
    ----------
    part : Part
    placed : float ndarray (p, 3)
        Vertices of the partial shape in the frame of the template.
    target : Shape
        The template.
    X_low : float ndarray (n, 3)
        Approximate positions of its coarse vertices on the partial shape.
    present : bool ndarray (n,)
    """
    area = vertex_areas(placed, part.T)
    source = Basis(placed, part.T, area, np.zeros((len(placed), 0)))
    low = target.low_on_surface
    target_low = replace(
        low, X=X_low, area=np.where(present, low.area, 0.0), surface_normals=low.normals_at(X_low)
    )
    start = np.eye(3), np.zeros(3), np.zeros((target_low.k, 3))
    R, t, c = elastic_iterations(source, target_low, start)
    X = X_low @ R.T + t + target_low.field(c)
    return X + local_iterations(source, target_low, Diffusion(target_low.area, target.W), X)
