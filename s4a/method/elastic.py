"""Elastic registration: smoothing of the displacement (4.2, eq. 8) with a bending penalty.

The paper truncates a displacement after K eigenfunctions of the template N.  Tangential shifts
within these cost nothing, so iterations of nearest neighbours drift along the surface.  Here the
coefficients c (K, 3) and a linear map A x + b of the initially aligned template minimise

    sum_i a_i |z_i - y_i|^2_i + stiffness * sum_k lambda_k^2 |c_k|^2,   z = A x + b + Phi c,

where y_i is the point of the shape's surface M that is nearest to z_i in position and normal,
a_i the vertex area, lambda_k an eigenvalue.  |d|^2_i = (m_i . d)^2 + slide (|d|^2 - (m_i . d)^2)
along the mean m_i of both normals: vertices may slide, as in the point-to-plane distance of Chen
and Medioni (1992), with the normals of both surfaces as in Rusinkiewicz (2019).  The second term is
the bending energy, the integral of |Laplacian|^2 of the displacement.  The stiffness decreases from
step to step, as in the non-rigid ICP of Amberg, Romdhani and Vetter (CVPR 2007), and further if the
bending energy has converged: then the template follows the shape.  If the energy still grows, less
stiffness would fit noise.  Lengths are for surfaces of unit area.

First come very stiff iterations; of the initialisations that end in the same place, one continues
(:func:`converging_initialisations`).  In these, a_i is multiplied by the Welsch weight
exp(-|y_i - z_i|^2 / (18 r^2)), r the root mean square distance, as in the robust non-rigid ICP of
Yao et al. (CVPR 2020): otherwise they do not converge where the nearest point of a vertex
alternates between folds.  Surfaces such as tori slide onto themselves in very stiff iterations
(:func:`slides`); then they are left out, and the tangential weight is larger.

These terms do not keep a surface from sliding over its own boundary.  If both boundaries coincide
after two steps, squared distances between them, across the boundary and within the surface, are
added with the boundary's length as weight.

Landmarks marked on both surfaces add their squared distances, with equal weights.  Fields given on
both surfaces, such as sulcal depth, enter the nearest-neighbour search next to position and normal.

Local iterations then fit what K functions cannot: a displacement d (n, 3) of the low-resolution
vertices, in addition to the warp, that minimises

    sum_i a_i |d_i - r_i|^2 + time * integral |grad d|^2,

where r_i is d_i plus the vector to the nearest point, whose tangential part counts half.  That is
one implicit step of heat diffusion, (A + time W) d = A r.  The time decreases, as in the smoothing
of MeshMonk (White et al., Scientific Reports 2019).  Landmarks add their squared distances.
"""

from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.spatial import cKDTree

from s4a.geometry.align import rigid_transform
from s4a.geometry.closest import closest_point_in_star, features, interpolate
from s4a.method.network import in_threads
from s4a.method.shape import Basis, common_fields, field_columns
from s4a.method.spectral import Diffusion
from s4a.method.spectral_icp import Warp, apply_transform, move
from s4a.schema import Array

_N_STEPS = 8
_N_FURTHER = 5  # at most so many more steps, while the bending energy has converged
# of each step, from 1e-4 to 1e-7 by equal factors, and further.  Tuned on pairs of faces, brains,
# skulls and cortex templates, reported on others: docs/decisions.md
STIFFNESS = 1e-4 * 1e-3 ** (np.arange(_N_STEPS + _N_FURTHER) / (_N_STEPS - 1))
# tangential weight in the first two steps, in which initialisations converge, and in the others, in
# which vertices must not drift along the surface
SLIDE = (0.01, 0.1)
_MAX_GROWTH = 1.2  # factor of growth of the bending energy below which it has converged
BOUNDARY_WEIGHT = 0.01  # share of sqrt(area): weight of boundary distances, times the length
_MAX_BOUNDARY_DISTANCE = 0.03  # share of sqrt(area): more distant boundaries do not correspond
_LANDMARK_WEIGHT = 1e-3  # of each landmark, as a share of the area
MERGE_DISTANCE = 0.01  # share of sqrt(area): of initialisations that end closer, one is kept
_TIME = (2e-2, 2e-4)  # of local iterations: smooths over 0.2, finally over 0.02 of sqrt(area)
_LOCAL_SLIDE = 0.5
_N_LOCAL_ITERATIONS = 10


class Schedule(NamedTuple):
    """Stiffness and termination of the steps of elastic iterations."""

    stiffness: Array  # (steps,)
    further: int  # number of final steps that need a converged bending energy
    iterations: int  # of a step, at most
    tolerance: float  # share of sqrt(area): a step ends if an iteration moves vertices less
    slide: tuple[float, float] = SLIDE  # tangential weight in the first two steps, and the others
    outlier: float = np.inf  # `multiple` of outlier_weight


DEFORMATION = Schedule(STIFFNESS, _N_FURTHER, 8, 1e-3)
# stiff enough for initialisations to converge.  Tuned on heads 2 to 10, reported on other
# collections
CONVERGENCE = Schedule(np.array([1e-2, 1e-3]), 0, 32, 1e-4, outlier=3.0)
# with more tangential weight, for surfaces that slide onto themselves
NO_SLIDING = DEFORMATION._replace(slide=(_LOCAL_SLIDE, _LOCAL_SLIDE))
# very stiff iterations slide if they move the target farther than this share of sqrt(area), farther
# than twice the distance between initialisations, and rigidly but for this share: docs/decisions.md
_MIN_SLIDING, _MAX_NOT_RIGID = 0.05, 0.4
Rows = Array | slice
_ALL = slice(None)


def nearest_on_surface(
    source: Basis, X: Array, normals: Array, target: Basis | None = None, vertices: Rows = _ALL
) -> tuple[Array, Array]:
    """Return the points of the source nearest to rows of X in position, normal and common fields.

    Points on the surface, unlike vertices, do not cluster in finely meshed regions.

    Parameters
    ----------
    source : Basis
    X, normals : float ndarray (n, 3)
    target : Basis, optional
        Surface of these n vertices, which may have fields.
    vertices : int ndarray (n,), optional
        Indices of the vertices; all by default.

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


def _attraction(source, target, X, vertices=_ALL):
    """Points to which some of the target's vertices at X are attracted, and normals there.

    Returns
    -------
    y : float ndarray (n, 3)
        Points of :func:`nearest_on_surface`.
    m : float ndarray (n, 3)
        Unit mean of the normals of both surfaces.
    """
    normals = target.normals_at(X)[vertices]
    y, normals_y = nearest_on_surface(source, X[vertices], normals, target, vertices)
    return y, unit(normals + normals_y)


class Landmarks(NamedTuple):
    """Landmarks marked on both surfaces."""

    on_target: Basis  # as a surface without triangles: X (l, 3), and U (l, n) to low resolution
    y: Array  # (l, 3), on the source


def outlier_weight(offset: Array, area: Array, multiple: float) -> Array:
    """Return Welsch weights ``(n,)`` for the vectors `offset` ``(n, 3)`` to nearest points.

    The weight is exp(-1/2) at a distance of `multiple` times the root mean square.

    References
    ----------
    Y. Yao, B. Deng, W. Xu and J. Zhang (2020), Quasi-Newton solver for robust non-rigid
    registration, CVPR.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.elastic import outlier_weight
    >>> outlier_weight(np.eye(3), np.ones(3), 1.0).round(3).tolist()
    [0.607, 0.607, 0.607]
    """
    distance2 = (offset**2).sum(1)
    scale2 = multiple**2 * (area @ distance2) / area.sum()
    return np.exp(-distance2 / (2 * scale2 + 1e-300))


def boundary_attraction(
    source: Basis, target: Basis, X: Array
) -> tuple[Array, Array, Array, Array] | None:
    """Return points to which the boundary of the target is attracted, or None.

    Boundaries correspond if nine tenths of the vertices of each lie within
    ``_MAX_BOUNDARY_DISTANCE`` of the other.  Arbitrary ends of scans, and holes of one shape, do
    not.

    Returns
    -------
    vertex : int ndarray (r,)
        Boundary vertices close to the boundary of the source.
    length : float ndarray (r,)
        Length of the boundary around each vertex: half of its two edges.
    across : float ndarray (r, 3)
        Unit vectors in the surface, perpendicular to its boundary.
    y : float ndarray (r, 3)
        The nearest vertices of the source's boundary.
    """
    if not (len(target.boundary) and len(source.boundary)):  # the template's is kept
        return None
    start, end = target.boundary.T
    vertex = np.unique(target.boundary)
    distance, nearest = source.boundary_tree.query(X[vertex])
    back = cKDTree(X[vertex]).query(source.boundary_tree.data)[0]
    if max(np.quantile(distance, 0.9), np.quantile(back, 0.9)) > _MAX_BOUNDARY_DISTANCE:
        return None
    step = X[end] - X[start]
    tangent, length = np.zeros_like(X), np.zeros(len(X))
    for corner in (start, end):
        np.add.at(tangent, corner, step)
        np.add.at(length, corner, np.linalg.norm(step, axis=1) / 2)
    near = distance < _MAX_BOUNDARY_DISTANCE
    vertex, nearest = vertex[near], nearest[near]
    across = unit(np.cross(unit(tangent[vertex]), target.normals_at(X)[vertex]))
    return vertex, length[vertex], across, source.boundary_tree.data[nearest]


def unit(vectors: Array) -> Array:
    """Normalise vectors ``(n, 3)`` to length 1; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length == 0, 1, length)


def normal_equations(
    E: Array, area: Array, m: Array, y: Array, slide: float, mass: Array | None = None
) -> tuple[Array, Array]:
    """Matrix ``(3 q, 3 q)`` and right side ``(3 q,)`` of the first term, for z = E w, w ``(q, 3)``.

    With W_i = slide I + (1 - slide) m_i m_i^T the term is sum_i a_i (z_i - y_i)^T W_i (z_i - y_i).
    The unknowns are the stacked columns of w.  The matrix product is in single precision, which
    takes half the time, with an error of 1e-5 of what `slide` adds.

    Parameters
    ----------
    E : float ndarray (n, q)
    area : float ndarray (n,)
    m : float ndarray (n, 3)
        Unit normals.
    y : float ndarray (n, 3)
    slide : float
    mass : float ndarray (q, q), optional
        E^T diag(area) E, if already computed.
    """
    n, q = E.shape
    # normal distances are those of one field: m_i^T z_i, in the 3 q unknowns
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


def _decorrelation(E, area):
    """B ``(q, q)`` such that E B has the initial positions orthogonal to the smooth functions.

    Smooth functions and initial positions, three columns of E before the last, are nearly linearly
    dependent, on a sphere exactly.  The equations of E lose half their digits, those of E B do not.
    """
    B = np.eye(E.shape[1])
    smooth, initial = E[:, :-4], E[:, -4:-1]
    weighted = area[:, None] * smooth
    B[:-4, -4:-1] = -np.linalg.solve(weighted.T @ smooth, weighted.T @ initial)
    return B


def landmark_equations(
    landmarks: Landmarks | None, smooth: Array, R: Array, t: Array
) -> tuple[Array, Array, Array]:
    """Return E ``(l, q)``, weight and goal of landmarks, which are isotropic."""
    if landmarks is None:
        return np.zeros((0, smooth.shape[1] + 4)), np.zeros(0), np.zeros((0, 3))
    on_target, y = landmarks
    initial = apply_transform(on_target, R, t)  # (l, 3)
    E = np.concatenate([on_target.U @ smooth, initial, np.ones((len(y), 1))], axis=1)
    return E, np.full(len(y), _LANDMARK_WEIGHT), y


def solve_normal_equations(matrix: Array, right: Array) -> Array:
    """Solve normal equations ``(q, q)``, ``(q,)``.

    If a surface has collapsed, single precision can leave a negative eigenvalue.  Then eigenvalues
    below 1e-10 of the largest are truncated.
    """
    try:
        return scipy.linalg.solve(matrix, right, assume_a="pos")
    except np.linalg.LinAlgError:
        eigenvalue, Q = scipy.linalg.eigh(matrix)
        positive = eigenvalue > 1e-10 * eigenvalue[-1]
        return Q[:, positive] @ (Q[:, positive].T @ right / eigenvalue[positive])


def elastic_iterations(
    source: Basis,
    target: Basis,
    warp: Warp,
    schedule: Schedule = DEFORMATION,
    *,
    vertices: Rows = _ALL,
    landmarks: Landmarks | None = None,
) -> Warp:
    """Register the target by iterations of decreasing stiffness and return the warp.

    Parameters
    ----------
    source : Basis
        At full resolution; its surface is searched.
    target : Basis
        At low resolution, with the normals of the original mesh:
        :attr:`s4a.method.shape.Shape.low_on_surface`.
    warp : tuple (R, t, c)
        Initialisation with one transform for all vertices, relative to which bending is measured.
    schedule : Schedule
        The further steps need a growth of the bending energy by less than a fifth in the step
        before.
    vertices : int ndarray (s,), optional
        Vertices of the target that are attracted, each with the area around it; all by default.
    landmarks : Landmarks, optional

    Returns
    -------
    warp : tuple (R, t, c)
        R is a linear map, not a rotation.
    """
    R, t, c = warp
    initial = apply_transform(target, R, t)  # (n, 3)
    n = len(initial)
    smooth = target.Phi[:, 1:]  # the constant is b
    E = np.concatenate([smooth, initial, np.ones((n, 1))], axis=1)  # (n, K - 1 + 3 + 1)
    w = np.zeros((E.shape[1], 3))  # z = E w
    w[: len(c) - 1] = c[1:]
    w[-4:-1] = np.eye(3)
    w[-1] = c[0] * target.Phi[0, 0]
    B = _decorrelation(E, target.area)
    E_B = E @ B
    E_landmark, landmark_weight, goal = landmark_equations(landmarks, smooth, R, t)
    bending = np.zeros((len(w), 1))
    bending[: smooth.shape[1], 0] = target.eigenvalue[1:] ** 2
    X = E @ w
    energies: list[float] = []  # of bending, after each step
    area = target.area
    if not isinstance(vertices, slice):  # of the vertices nearest to each sample
        nearest = cKDTree(target.X[vertices]).query(target.X)[1]
        area = np.bincount(nearest, target.area, len(vertices))
    F = E_B[vertices]
    robust = np.isfinite(schedule.outlier)
    # with robust weights, the mass matrix is that of an iteration
    weight, mass = area, None if robust else F.T @ (area[:, None] * F)
    n_fixed = len(schedule.stiffness) - schedule.further
    for step, stiffness in enumerate(schedule.stiffness):
        if step >= n_fixed and energies[-1] > _MAX_GROWTH * energies[-2]:
            break
        penalty = np.kron(np.eye(3), B.T @ (stiffness * bending * B))
        # keeps the matrix definite if the initial positions are smooth
        penalty[np.diag_indices_from(penalty)] += 1e-12
        slide = schedule.slide[step >= 2]
        for _ in range(schedule.iterations):
            y, m = _attraction(source, target, X, vertices)
            offset = y - X[vertices]
            if robust:
                weight = area * outlier_weight(offset, area, schedule.outlier)
            # for the change of w, whose rounding is smaller than that of w
            matrix, right = normal_equations(F, weight, m, offset, slide, mass)
            boundary = boundary_attraction(source, target, X) if step >= 2 else None
            if boundary is not None:
                vertex, length, across, y = boundary
                length, offset = BOUNDARY_WEIGHT * length, y - X[vertex]
                terms = normal_equations(E_B[vertex], length, across, offset, 0.0)
                matrix += terms[0]
                right += terms[1]
            if len(goal):
                residual = goal - E_landmark @ w
                isotropic = np.zeros_like(residual)
                terms = normal_equations(E_landmark @ B, landmark_weight, isotropic, residual, 1.0)
                matrix += terms[0]
                right += terms[1]
            right -= (B.T @ (stiffness * bending * w)).T.ravel()
            change = solve_normal_equations(matrix + penalty, right)
            w = w + B @ change.reshape(3, -1).T
            before, X = X, E @ w
            if target.area @ ((X - before) ** 2).sum(1) < schedule.tolerance**2:
                break
        energies.append((bending * w**2).sum())
    A = w[-4:-1].T  # (3, 3)
    b = w[-1]
    c = np.concatenate([np.zeros((1, 3)), w[:-4]])  # (K, 3)
    return A @ R, A @ t + b, c


def converging_initialisations(
    source: Basis, target: Basis, warps: dict[str, Warp], landmarks: Landmarks | None = None
) -> dict[str, Warp]:
    """Apply very stiff iterations to each initialisation, and keep one of those that converge.

    Small changes of the input decide which of two similar ones scores better.  That of ICP is kept,
    as it depends on the two shapes alone and not on the rest of the collection.

    Parameters
    ----------
    source, target, landmarks : see :func:`elastic_iterations`
    warps : dict
        Name -> warp (R, t, c), with one transform for all vertices.

    Returns
    -------
    dict
        Name -> warp after the iterations, farther than :data:`MERGE_DISTANCE` from all others.
    """
    options: dict[str, Any] = {"vertices": target.sample_vertices_of(), "landmarks": landmarks}
    names = sorted(warps, key=lambda name: name != "icp")
    converged = in_threads(
        lambda name: elastic_iterations(source, target, warps[name], CONVERGENCE, **options), names
    )
    kept: dict[str, Warp] = {}
    for name, warp in zip(names, converged, strict=True):
        X = move(target, warp)
        gaps = [np.linalg.norm(X - move(target, other), axis=1) for other in kept.values()]
        if all(gap @ target.area >= MERGE_DISTANCE for gap in gaps):
            kept[name] = warp
    return kept


def slides(target: Basis, warps: dict[str, Warp], converged: dict[str, Warp]) -> bool:
    """Return whether very stiff iterations slide along the surface, away from all initialisations.

    A ring hardly changes if it rotates about its axis, so stiff iterations follow small differences
    of its thickness.  Initialisations that agree are more accurate then.  A single one is no
    evidence.

    Parameters
    ----------
    target : Basis
    warps, converged : dict
        Warps before and after :func:`converging_initialisations`.
    """
    starts, ends = ([move(target, warp) for warp in some.values()] for some in (warps, converged))

    def distance(X, Y):
        return np.linalg.norm(X - Y, axis=1) @ target.area

    moved, start, end = min(
        ((distance(X, Y), X, Y) for X in starts for Y in ends), key=itemgetter(0)
    )
    apart = max(distance(X, start) for X in starts)
    if len(starts) < 2 or moved < max(_MIN_SLIDING, 2 * apart):
        return False
    R, t, _ = rigid_transform(start, end, target.area)
    return bool(distance(start @ R.T + t, end) < _MAX_NOT_RIGID * moved)


def local_iterations(
    source: Basis,
    target: Basis,
    diffusion: Diffusion,
    X: Array,
    *,
    time: tuple[float, float] = _TIME,
    slide: float = _LOCAL_SLIDE,
    iterations: int = _N_LOCAL_ITERATIONS,
    landmarks: tuple[sp.csr_matrix, Array] | None = None,
) -> Array:
    """Compute a displacement of every low-resolution vertex, in addition to elastic iterations.

    Parameters
    ----------
    source, target : see :func:`elastic_iterations`
    diffusion : Diffusion
        Heat diffusion on the target.
    X : float ndarray (n, 3)
        Vertices of the target after the elastic iterations.
    time : tuple of float
        Diffusion time of the first and the last iteration.
    slide : float
        Weight of the tangential part.
    iterations : int
    landmarks : tuple (P, residual), optional
        Weights ``(l, n)`` of landmarks on the target, and the residuals ``(l, 3)``, the values of d
        that reach them.

    Returns
    -------
    float ndarray (n, 3)
        d, in the frame of the source.
    """
    matrix, right = None, 0.0
    if landmarks is not None:
        P, residual = landmarks
        matrix = _LANDMARK_WEIGHT * P.T @ P
        right = _LANDMARK_WEIGHT * P.T @ residual
    d = np.zeros_like(X)
    for step in np.geomspace(*time, iterations):
        y, m = _attraction(source, target, X + d)
        offset = y - X - d
        across = np.einsum("ni,ni->n", m, offset)[:, None] * m
        goal = d + slide * offset + (1 - slide) * across
        d = diffusion.step(step, matrix)(target.area[:, None] * goal + right)
    return d
