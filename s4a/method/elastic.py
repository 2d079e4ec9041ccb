"""Elastic registration: the smoothing of the displacement (4.2, eq. 8) with a price on bending.

The paper cuts a displacement off after K eigenfunctions of the template N; within these every
tangential shift costs nothing, so that iterations of nearest neighbours drift along the surface.
Here the coefficients c (K, 3) and a linear map A x + b of what the first iterations left minimise

    sum_i a_i |z_i - y_i|^2_i + stiffness * sum_k lambda_k^2 |c_k|^2,   z = A x + b + Phi c,

where y_i is the point of the shape's surface M that is nearest to z_i in position and normal,
a_i the vertex area, lambda_k an eigenvalue.  |d|^2_i = (m_i . d)^2 + slide (|d|^2 - (m_i . d)^2)
along the mean m_i of both normals: vertices may slide, as in the point-to-plane distance of Chen
and Medioni (1992), with the normals of both surfaces as of Rusinkiewicz (2019).  The second term is
the bending energy, the integral of |Laplacian|^2 of the displacement.  The stiffness falls from
round to round, as in the non-rigid ICP of Amberg, Romdhani and Vetter (CVPR 2007), and on where the
bending energy has settled: there the template follows the shape, and what the price shrinks is the
displacement alone.  Where each step bends it more, it would follow noise.  Before all that each
start is made so stiff that near starts meet, and their mean goes on
(:func:`converging_initialisations`). Lengths are for surfaces of unit area.

Nothing above keeps a surface from shifting along itself over its own boundary.  Where both
boundaries lie on each other already they are taken for one line, and the squared distances from it
across the boundary and along the surface, times its length, are added from the third step on.

Landmarks that a user marked on both surfaces add their squared distances, each by the same weight.
Fields that a user gives on both, such as sulcal depth, count beside position and normal in what is
nearest.

What K functions cannot follow is left to local iterations: a displacement d (n, 3) of the vertices
of low resolution, beyond the warp, that minimises

    sum_i a_i |d_i - r_i|^2 + time * integral |grad d|^2,

r_i what d_i and the way to the nearest point add up to, the way along the surface counted by half.
That is one implicit step of heat diffusion, (A + time W) d = A r; the time falls, as that of the
smoothing in MeshMonk does (White et al., Scientific Reports 2019).  Landmarks add their squared
distances here, too.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.spatial import cKDTree

from s4a.geometry.closest import closest_point_in_star, features, interpolate
from s4a.method.shape import Basis, common_fields, field_columns
from s4a.method.spectral import Diffusion
from s4a.method.spectral_icp import Warp, move, turn
from s4a.schema import Array

_N_STEPS = 8
_N_FURTHER = 5  # steps at most, where the last was nearly in vain
# Of each step: from 1e-4 to 1e-7 by equal factors, and on.  Chosen on a pair of faces, of brains
# and of skulls and two cortex templates, reported on others: docs/decisions.md
STIFFNESS = 1e-4 * 1e-3 ** (np.arange(_N_STEPS + _N_FURTHER) / (_N_STEPS - 1))
# Of the first two steps, in which different starts meet, and of the others, in which vertices must
# not drift along the surface any more
SLIDE = (0.01, 0.1)
_SETTLED = 1.2  # as long as a step lets the bending energy grow by less than that factor
BOUNDARY_WEIGHT = 0.01  # share of sqrt(area): of distances at the boundary, by its length
_BOUNDARY_NEAR = 0.03  # share of sqrt(area): boundaries that are farther apart may be cut anywhere
_LANDMARK_WEIGHT = 1e-3  # of each landmark: as much as this share of the area
MEET = 0.01  # share of sqrt(area): starts that end nearer to each other than that go on as one
_TIME = (2e-2, 2e-4)  # of local iterations: smooth over 0.2, then over 0.02 of sqrt(area)
_LOCAL_SLIDE = 0.5
_N_LOCAL_ITERATIONS = 10


class Schedule(NamedTuple):
    """How stiff the steps of elastic iterations are, and how long each of them lasts."""

    stiffness: Array  # (steps,), of each step
    further: int  # so many, the last ones, only while the bending energy has not settled
    iterations: int  # of a step, at most
    still: float  # share of sqrt(area): a step ends with a round that moves less


FOLLOWING = Schedule(STIFFNESS, _N_FURTHER, 8, 1e-3)
# Before, from each start: so stiff that starts meet.  Chosen on heads 2 to 10, with nothing left to
# report on but other collections
MEETING = Schedule(np.array([1e-2, 1e-3]), 0, 32, 1e-4)
Rows = Array | slice
_ALL = slice(None)


def nearest_on_surface(
    source: Basis, X: Array, normals: Array, target: Basis | None = None, vertices: Rows = _ALL
) -> tuple[Array, Array]:
    """The points of the source's surface nearest to rows of X in position and normal.

    And in the fields that guide both. Unlike nearest vertices they do not crowd where the source is
    finely meshed.

    Parameters
    ----------
    source : Basis
    X, normals : float ndarray (n, 3)
    target : Basis, optional
        The surface whose n vertices these are, which may have fields.
    vertices : int ndarray (n,), optional
        Which of its vertices; all by default.

    Returns
    -------
    points, normals : float ndarray (n, 3)
        On the surface of the source.
    """
    names: tuple[str, ...] = ()
    fields = None
    if target is not None and (names := common_fields(source, target)):
        fields = field_columns(target, names)[vertices]
    rows = features(X, normals, fields)  # (n, 6 + f)
    tree = source.guided_tree(names)
    nearest = tree.query(rows)[1]
    triangle, weights = closest_point_in_star(rows, nearest, tree.data, source.T, source.stars)
    points = interpolate(source.X, source.T, triangle, weights)
    normals = interpolate(source.normals, source.T, triangle, weights)
    return points, unit(normals)


def _points_ahead(source, target, X, vertices=_ALL):
    """Where the target's vertices at X are drawn, and the directions across both surfaces there.

    All n of them, or some.

    Returns
    -------
    y : float ndarray (n, 3)
        Of :func:`nearest_on_surface`.
    m : float ndarray (n, 3)
        Unit mean of the normals of both surfaces.
    """
    normals = target.normals_at(X)[vertices]
    y, normals_y = nearest_on_surface(source, X[vertices], normals, target, vertices)
    return y, unit(normals + normals_y)


class Landmarks(NamedTuple):
    """Landmarks that a user marked on both surfaces."""

    on_target: Basis  # as a surface of no triangles: X (l, 3), and U (l, n) to its low resolution
    y: Array  # (l, 3), on the source


def boundary_ahead(
    source: Basis, target: Basis, X: Array
) -> tuple[Array, Array, Array, Array] | None:
    """Where the target's boundary, its vertices at X, is drawn, if both boundaries are one line.

    They are where nine tenths of the vertices of each lie within ``_BOUNDARY_NEAR`` of the other.
    Scans may end anywhere, and holes are of one shape alone: such boundaries are left as they are.

    Returns
    -------
    vertex : int ndarray (r,)
        Boundary vertices near the source's boundary.
    length : float ndarray (r,)
        Of the boundary around each: half its two edges.
    across : float ndarray (r, 3)
        Unit vectors along the surface and across its boundary.
    y : float ndarray (r, 3)
        The nearest vertices of the source's boundary.
    """
    if not (len(source.boundary) and len(target.boundary)):
        return None
    start, end = target.boundary.T
    vertex = np.unique(target.boundary)
    gap, nearest = source.boundary_tree.query(X[vertex])
    back = cKDTree(X[vertex]).query(source.boundary_tree.data)[0]
    if max(np.quantile(gap, 0.9), np.quantile(back, 0.9)) > _BOUNDARY_NEAR:
        return None
    step = X[end] - X[start]
    tangent, length = np.zeros_like(X), np.zeros(len(X))
    for corner in (start, end):
        np.add.at(tangent, corner, step)
        np.add.at(length, corner, np.linalg.norm(step, axis=1) / 2)
    near = gap < _BOUNDARY_NEAR
    vertex, nearest = vertex[near], nearest[near]
    across = unit(np.cross(unit(tangent[vertex]), target.normals_at(X)[vertex]))
    return vertex, length[vertex], across, source.boundary_tree.data[nearest]


def unit(vectors: Array) -> Array:
    """Vectors ``(n, 3)`` of length 1; those of length 0 stay."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length == 0, 1, length)


def normal_equations(
    E: Array, area: Array, m: Array, y: Array, slide: float, mass: Array | None = None
) -> tuple[Array, Array]:
    """Matrix ``(3 q, 3 q)`` and right side ``(3 q,)`` of the first term, for z = E w, w ``(q, 3)``.

    With W_i = slide I + (1 - slide) m_i m_i^T it is sum_i a_i (z_i - y_i)^T W_i (z_i - y_i); the
    unknowns are the columns of w, one after the other.  The product of the matrix is in single
    precision: half the time, and its rounding is 1e-5 of what `slide` adds.

    Parameters
    ----------
    E : float ndarray (n, q)
    area : float ndarray (n,)
    m : float ndarray (n, 3)
        Unit normals.
    y : float ndarray (n, 3)
    slide : float
    mass : float ndarray (q, q), optional
        E^T diag(area) E, where it is known.
    """
    n, q = E.shape
    # distances across the surface are those of one field: m_i^T z_i, in the 3 q unknowns
    weight = (np.sqrt((1 - slide) * area)[:, None] * m).astype(np.float32)
    across = (weight[:, :, None] * E.astype(np.float32)[:, None]).reshape(n, 3 * q)
    matrix = (across.T @ across).astype(float)
    if slide:
        mass = E.T @ (area[:, None] * E) if mass is None else mass
        for i in range(0, 3 * q, q):
            matrix[i : i + q, i : i + q] += slide * mass
    along = np.einsum("ni,ni->n", m, y)[:, None] * m
    right = E.T @ (area[:, None] * (slide * y + (1 - slide) * along))  # (q, 3)
    return matrix, right.T.ravel()


def _sampled_area(target, spread):
    """The area ``(s,)`` of the vertices nearest to each of some that are spread over a surface."""
    nearest = cKDTree(target.X[spread]).query(target.X)[1]
    return np.bincount(nearest, target.area, len(spread))


def _unmixed(E, area):
    """B ``(q, q)`` for which E B has the vertices at the start without their smooth part.

    Smooth functions and the start, three columns of E before its last, nearly depend on each other,
    and exactly on a sphere, which costs the equations of E half their digits; not those of E B.
    """
    B = np.eye(E.shape[1])
    smooth, start = E[:, :-4], E[:, -4:-1]
    weighted = area[:, None] * smooth
    B[:-4, -4:-1] = -np.linalg.solve(weighted.T @ smooth, weighted.T @ start)
    return B


def pins(
    landmarks: Landmarks | None, smooth: Array, R: Array, t: Array
) -> tuple[Array, Array, Array]:
    """E ``(l, q)``, weight and goal of landmarks, which count in all directions alike."""
    if landmarks is None:
        return np.zeros((0, smooth.shape[1] + 4)), np.zeros(0), np.zeros((0, 3))
    at, y = landmarks
    start = turn(at, R, t)  # (l, 3)
    E = np.concatenate([at.U @ smooth, start, np.ones((len(y), 1))], axis=1)
    return E, np.full(len(y), _LANDMARK_WEIGHT), y


def step_of(matrix: Array, right: Array) -> Array:
    """The solution of normal equations ``(q, q)``, ``(q,)``.

    Where a surface has collapsed, single precision can leave a direction of which no point tells
    with less than nothing. Then those below 1e-10 of the largest eigenvalue are not taken.
    """
    try:
        return scipy.linalg.solve(matrix, right, assume_a="pos")
    except np.linalg.LinAlgError:
        eigenvalue, Q = scipy.linalg.eigh(matrix)
        told = eigenvalue > 1e-10 * eigenvalue[-1]
        return Q[:, told] @ (Q[:, told].T @ right / eigenvalue[told])


def elastic_iterations(
    source: Basis,
    target: Basis,
    warp: Warp,
    schedule: Schedule = FOLLOWING,
    *,
    vertices: Rows = _ALL,
    landmarks: Landmarks | None = None,
) -> Warp:
    """The warp after iterations in which the target's displacement becomes less and less stiff.

    Parameters
    ----------
    source : Basis
        At full resolution: its surface is searched.
    target : Basis
        At low resolution, with the normals of the original mesh:
        :attr:`s4a.method.shape.Shape.low_on_surface`.
    warp : tuple (R, t, c)
        Where to begin, with one transform for all: bending is counted from there.
    schedule : Schedule
        Its further steps are made only as long as the one before let the bending energy grow by
        less than a fifth.
    vertices : int ndarray (s,), optional
        Those of the target that are drawn, each for the area around it; all by default.
    landmarks : Landmarks, optional

    Returns
    -------
    warp : tuple (R, t, c)
        R is a linear map, and no rotation.
    """
    R, t, c = warp
    start = turn(target, R, t)  # (n, 3)
    n = len(start)
    smooth = target.Phi[:, 1:]  # the constant is b
    E = np.concatenate([smooth, start, np.ones((n, 1))], axis=1)  # (n, K - 1 + 3 + 1)
    w = np.zeros((E.shape[1], 3))  # z = E w
    w[: len(c) - 1] = c[1:]
    w[-4:-1] = np.eye(3)
    w[-1] = c[0] * target.Phi[0, 0]
    apart = _unmixed(E, target.area)
    unlike = E @ apart
    at, pin_weight, pin = pins(landmarks, smooth, R, t)
    bending = np.zeros((len(w), 1))
    bending[: smooth.shape[1], 0] = target.eigenvalue[1:] ** 2
    X = E @ w
    energies: list[float] = []  # of bending, after each step
    area = target.area if isinstance(vertices, slice) else _sampled_area(target, vertices)
    F = unlike[vertices]
    mass = F.T @ (area[:, None] * F)
    sure = len(schedule.stiffness) - schedule.further
    for step, stiff in enumerate(schedule.stiffness):
        if step >= sure and energies[-1] > _SETTLED * energies[-2]:
            break
        price = np.kron(np.eye(3), apart.T @ (stiff * bending * apart))
        # nothing may be left of the start: a little keeps the matrix definite then
        price[np.diag_indices_from(price)] += 1e-12
        for _ in range(schedule.iterations):
            y, m = _points_ahead(source, target, X, vertices)
            # of what w is to change by, so that rounding is of the step and not of what it leads to
            matrix, right = normal_equations(F, area, m, y - X[vertices], SLIDE[step >= 2], mass)
            boundary = boundary_ahead(source, target, X) if step >= 2 else None
            if boundary is not None:
                vertex, length, across, y = boundary
                way = y - X[vertex]
                more = normal_equations(unlike[vertex], BOUNDARY_WEIGHT * length, across, way, 0.0)
                matrix += more[0]
                right += more[1]
            if len(pin):
                way = pin - at @ w
                more = normal_equations(at @ apart, pin_weight, np.zeros_like(way), way, 1.0)
                matrix += more[0]
                right += more[1]
            right -= (apart.T @ (stiff * bending * w)).T.ravel()
            change = step_of(matrix + price, right)
            w = w + apart @ change.reshape(3, -1).T
            before, X = X, E @ w
            if target.area @ ((X - before) ** 2).sum(1) < schedule.still**2:
                break
        energies.append((bending * w**2).sum())
    A = w[-4:-1].T  # (3, 3)
    b = w[-1]
    c = np.concatenate([np.zeros((1, 3)), w[:-4]])  # (K, 3)
    return A @ R, A @ t + b, c


def converging_initialisations(
    source: Basis, target: Basis, starts: dict[str, Warp], landmarks: Landmarks | None = None
) -> dict[str, Warp]:
    """Starts of elastic iterations after steps so stiff that near ones meet; the mean of those.

    Which of them is the better, small changes of the input decide; the mean follows these.

    Parameters
    ----------
    source, target, landmarks : see :func:`elastic_iterations`
    starts : dict
        Name -> warp (R, t, c), with one transform for all.

    Returns
    -------
    dict
        Starts that end within :data:`MEET` of the first of some are one, by its name.
    """
    options: dict[str, Any] = {"vertices": target.sample_vertices_of(), "landmarks": landmarks}
    met: dict[str, list[Warp]] = {}
    for name, start in starts.items():
        warp = elastic_iterations(source, target, start, MEETING, **options)
        X = move(target, warp)
        near = (
            one
            for one, (first, *_) in met.items()
            if np.linalg.norm(X - move(target, first), axis=1) @ target.area < MEET
        )
        met.setdefault(next(near, name), []).append(warp)
    return {
        name: tuple(sum(p) / len(p) for p in zip(*found, strict=True))
        for name, found in met.items()
    }


def local_iterations(
    source: Basis,
    target: Basis,
    diffusion: Diffusion,
    X: Array,
    *,
    time: tuple[float, float] = _TIME,
    slide: float = _LOCAL_SLIDE,
    iterations: int = _N_LOCAL_ITERATIONS,
    pull: tuple[sp.csr_matrix, Array] | None = None,
) -> Array:
    """A displacement beyond that of elastic iterations, free at every vertex of low resolution.

    Parameters
    ----------
    source, target : Basis
        As of :func:`elastic_iterations`.
    diffusion : Diffusion
        On the target.
    X : float ndarray (n, 3)
        The target's vertices after the elastic iterations.
    time : tuple of float
        Of the heat diffusion in the first and in the last round.
    slide : float
        Weight of the way along the surface.
    iterations : int
    pull : tuple (P, missing), optional
        Weights ``(l, n)`` of landmarks on the target, and what d is to be there ``(l, 3)``.

    Returns
    -------
    float ndarray (n, 3)
        d, in the frame of the source.
    """
    pinned, toward = None, 0.0
    if pull is not None:
        P, missing = pull
        pinned = _LANDMARK_WEIGHT * P.T @ P
        toward = _LANDMARK_WEIGHT * P.T @ missing
    d = np.zeros_like(X)
    for step in np.geomspace(*time, iterations):
        y, m = _points_ahead(source, target, X + d)
        way = y - X - d
        across = np.einsum("ni,ni->n", m, way)[:, None] * m
        goal = d + slide * way + (1 - slide) * across
        d = diffusion.step(step, pinned)(target.area[:, None] * goal + toward)
    return d
