"""Partial shape on a complete one (4.2, 6.1): alignment, match and missing region.

Points of the part look for the nearest of the mean shape moved along its modes, in position and
normal, never the other way: what is missing asks for nothing.  Rounds of rigid ICP from many starts
come first (turns of a cube; centres of pieces as large as the part); of the best, each round solves
for a small transform and the scores b that minimise

    sum_j a_j |z_j + sum_c b_c B_cj - p_j|^2_j + (r^2 / N) |b|^2,

|.|_j mostly across the surface as in :mod:`s4a.method.elastic`, r the distance that is left and N
as many points as count as independent.  Distances far above the median are left out, and points
whose nearest one lies on the boundary of the whole.  A vertex of the whole is there where the point
of the part that is nearest to it is near, looks the same way and is not on the part's own boundary.
Elastic and local iterations of those vertices alone follow.
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

N_ROUGH = 150  # points of the part in the first iterations of ICP, and
N_ROUGH_ITERATIONS = 12
N_POINTS = 1500  # in those with modes
N_ITERATIONS = 40
N_ANCHORS = 8  # places of the whole on which the part may begin
N_STARTS = 16  # of ICP that go on
N_INDEPENDENT = 100
FAR = 3.0  # times the median distance: left out
SLIDE = 0.1  # weight of the distance along the surface
LEAST_GAP = 0.01  # share of sqrt(area): what is nearer is never left out
PREFER = 0.9  # another turn than that of the study's shapes must leave less than this share
LONGEST_TURN = 60.0  # degrees within which a pose counts as that of the study's shapes


class Pose(NamedTuple):
    """The transform s R x + t of a part into the frame of the template."""

    R: Array
    t: Array
    s: float

    def __call__(self, X: Array) -> Array:
        """Points ``(n, 3)`` moved."""
        return self.s * X @ self.R.T + self.t


class Part(NamedTuple):
    """A partial shape: vertices, triangles, normals, areas and boundary."""

    X: Array
    T: Array
    N: Array
    area: Array
    boundary: Array  # (n,) of bool

    def spread(self, n: int) -> Array:
        """Vertices within, spread."""
        inner = np.flatnonzero(~self.boundary & (self.area > 0))
        return inner[farthest_points(self.X[inner], n)]


class Whole(NamedTuple):
    """The mean shape and its modes at low resolution, of unit area: ``X``, ``T``, ``modes``."""

    X: Array  # (n, 3)
    T: Array
    modes: Array  # (c, n, 3)
    boundary: Array  # (n,) of bool


class Fit(NamedTuple):
    """Where a part came to lie: its pose, scores ``b`` of the whole, and how near.

    ``residual``: root mean square distance across the surface of what was not left out; ``inside``:
    the share of the part's points of which it is.
    """

    pose: Pose
    b: Array
    residual: float
    inside: float


def on_boundary(T: Array, n: int) -> Array:
    """Which of n vertices are on the boundary.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.part import on_boundary
    >>> on_boundary(np.array([[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]]), 4).any()
    np.False_
    """
    boundary = Basis(np.zeros((n, 3)), T, np.ones(n), np.zeros((n, 0))).boundary
    found = np.zeros(n, bool)
    found[np.unique(boundary)] = True
    return found


def part_of(X: Array, T: Array) -> Part:
    """A part of its vertices and triangles."""
    return Part(X, T, vertex_normals(X, T), vertex_areas(X, T), on_boundary(T, len(X)))


def cut(X: Array, T: Array, kept: Array) -> tuple[Array, Array]:
    """The part of a surface whose vertices are kept.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.part import cut
    >>> T = np.array([[0, 1, 2], [1, 3, 2]])
    >>> cut(np.eye(4, 3), T, np.array([False, True, True, True]))[1].tolist()
    [[0, 2, 1]]
    """
    T = T[kept[T].all(1)]
    used = np.unique(T)
    number = np.full(len(X), -1)
    number[used] = np.arange(len(used))
    return X[used], number[T]


def rough_starts(
    part: Part, whole: Whole, first: Pose, *, turns: str = "O"
) -> list[tuple[float, Pose]]:
    """Poses after ICP of some points of the partial shape, with residuals, the best first.

    Parameters
    ----------
    part : Part
    whole : Whole
    first : Pose
        How the shapes of the study lie in their files; turns and shifts are tried around it.
    turns : {"O", "I"}
        The 24 of a cube, or the 60 of an icosahedron.
    """
    P = first(part.X[part.spread(N_ROUGH)])
    center = P.mean(0)
    tree = cKDTree(whole.X)
    anchors = _anchors(whole, first.s**2 * part.area.sum())
    shifts = [np.zeros(3), *(anchors - center)]
    ends = []
    for turn in Rotation.create_group(turns).as_matrix():
        for shift in shifts:
            R, t = turn, center + shift - turn @ center
            residual = np.inf
            for _ in range(N_ROUGH_ITERATIONS):
                gap, nearest = tree.query(P @ R.T + t)
                keep = gap <= np.quantile(gap, 0.9)
                R, t, _ = rigid_transform(P[keep], whole.X[nearest[keep]])
                before, residual = residual, float(np.sqrt((gap[keep] ** 2).mean()))
                if before - residual < 0.01 * residual:
                    break
            ends.append((residual, Pose(R @ first.R, R @ first.t + t, first.s)))
    return sorted(ends, key=lambda end: end[0])


def _anchors(whole, area):
    """Centres ``(N_ANCHORS, 3)`` of pieces of the whole of that area, round samples."""
    weight = vertex_areas(whole.X, whole.T)
    centers = []
    for vertex in farthest_points(whole.X, N_ANCHORS):
        order = np.argsort(np.linalg.norm(whole.X - whole.X[vertex], axis=1))
        inside = order[: np.searchsorted(np.cumsum(weight[order]), area) + 1]
        centers.append(weight[inside] @ whole.X[inside] / weight[inside].sum())
    return np.array(centers)


def different(
    ends: list[tuple[float, Pose]], first: Pose, part: Part, most: int = N_STARTS
) -> list[Pose]:
    """The best poses that differ, and the best of those near the first."""
    points = part.X[part.spread(20)]
    near = [end for end in ends if angle(end[1], first) < LONGEST_TURN]
    chosen: list[Pose] = []
    for _, pose in [*near[:1], *ends]:
        at = pose(points)
        if all(np.linalg.norm(at - other(points), axis=1).mean() > 0.05 for other in chosen):
            chosen.append(pose)
        if len(chosen) == most:
            break
    return chosen


def angle(pose: Pose, other: Pose) -> float:
    """Degrees between two poses."""
    turn = Rotation.from_matrix(pose.R @ other.R.T)
    return float(np.degrees(turn.magnitude()))


def fit_modes(
    part: Part, whole: Whole, pose: Pose, *, iterations: int = N_ITERATIONS, free_size: bool = False
) -> Fit:
    """Pose and scores of a part from a start, in iterations of nearest points of the whole.

    Parameters
    ----------
    part, whole : see :class:`Part`, :class:`Whole`
    pose : Pose
    iterations : int
    free_size : bool
        Whether the size of the part is fitted, too.
    """
    chosen = part.spread(N_POINTS)
    P, N, weight = part.X[chosen], part.N[chosen], part.area[chosen]
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


def _inliers(way, m, n, boundary, corners, share):
    """Points that are near, look the same way, and are not nearest to the whole's boundary."""
    gap = np.linalg.norm(way, axis=1)
    same = np.einsum("jx,jx->j", m, n) > 0.3
    at_boundary = ((share > 1e-6) <= boundary[corners]).all(1)  # all corners that count are on it
    good = same & ~at_boundary
    limit = max(FAR * float(np.median(gap[good])) if good.any() else 0.0, LEAST_GAP)
    good &= gap <= limit
    return good if good.sum() > 30 else gap <= np.quantile(gap, 0.9)


def _solve(pose, b, p, z, across, columns, weight, residual, free_size):
    """One step of Gauss and Newton: small transform of the part, and new scores."""
    c = len(b)
    center = weight @ p
    q = 7 if free_size else 6
    E = np.zeros((len(p), 3, c + q))
    E[:, :, :c] = columns
    turns = np.cross(np.eye(3)[:, None], (p - center)[None])  # (3, j, 3)
    E[:, :, c : c + 3] = -turns.transpose(1, 2, 0)
    E[:, :, c + 3 : c + 6] = -np.eye(3)
    if free_size:
        E[:, :, c + 6] = center - p
    y = p - z + columns @ b  # what modes and transform are to make up for
    along = np.einsum("jx,jxq->jq", across, E)
    right = np.einsum("jx,jx->j", across, y)
    rows = (E * (SLIDE * weight)[:, None, None]).reshape(-1, c + q)
    H = rows.T @ E.reshape(-1, c + q) + (along * ((1 - SLIDE) * weight)[:, None]).T @ along
    g = rows.T @ y.ravel() + along.T @ ((1 - SLIDE) * weight * right)
    price = max(residual, 1e-4) ** 2 / N_INDEPENDENT
    H[np.diag_indices(c)] += price
    H[np.diag_indices(c + q)] += 1e-12
    x = np.linalg.solve(H, g)
    b = x[:c] * min(1.0, 3 * np.sqrt(c) / max(np.linalg.norm(x[:c]), 1e-12)) if c else x[:c]
    turn = Rotation.from_rotvec(x[c : c + 3]).as_matrix()
    grow = 1 + float(np.clip(x[c + 6], -0.1, 0.1)) if free_size else 1.0
    shift = center + x[c + 3 : c + 6] - grow * turn @ center
    return Pose(turn @ pose.R, grow * turn @ pose.t + shift, grow * pose.s), b


def best_fit(part: Part, whole: Whole, starts: list[Pose], first: Pose, free_size: bool) -> Fit:
    """The fit of the start that ends nearest; turned far from the first only where that is clear.

    What is compared is the distance left, over the share of the part that it is of.
    """
    fits = [fit_modes(part, whole, start, iterations=15, free_size=free_size) for start in starts]
    # all go on, from the mean shape again: after so few iterations the right one may be far behind
    fits = [fit_modes(part, whole, fit.pose, free_size=free_size) for fit in fits]

    def registration_error(fit: Fit) -> float:
        turned = angle(fit.pose, first) > LONGEST_TURN
        worth = fit.residual / max(fit.inside, 0.05) * np.sqrt(1 + fit.b @ fit.b / N_INDEPENDENT)
        return worth / PREFER if turned else worth

    return min(fits, key=registration_error)


def seen(X: Array, N: Array, part: Part, placed: Array, limit: float) -> Array:
    """Which vertices of the whole the part has.

    Parameters
    ----------
    X, N : float ndarray (n, 3)
        The whole's vertices and normals.
    part : Part
    placed : float ndarray (p, 3)
        Its vertices in the frame of the whole.
    limit : float
        Largest distance.
    """
    triangle, share = closest_point(X, placed, part.T)
    corners = part.T[triangle]
    at_boundary = ((share > 1e-6) <= part.boundary[corners]).all(1)
    at_boundary &= (share > 1e-6).sum(1) < 3
    gap = np.linalg.norm(X - interpolate(placed, part.T, triangle, share), axis=1)
    facing = np.einsum("nx,nx->n", N, triangle_normals(placed, part.T)[triangle]) > 0
    return (gap <= limit) & facing & ~at_boundary


def refine(part: Part, placed: Array, target: Shape, X_low: Array, present: Array) -> Array:
    """Return the coarse vertices ``(n, 3)`` after elastic and local iterations.

    Parameters
    ----------
    part : Part
    placed : float ndarray (p, 3)
        Its vertices in the frame of the template.
    target : Shape
        The template.
    X_low : float ndarray (n, 3)
        Its low resolution on the part, nearly.
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
