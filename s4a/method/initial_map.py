"""First functional maps (4.1, steps 2 to 4), and one step of ZoomOut ahead (4.2).

The paper's way is from nearest neighbours after ICP, of all vertices or of 10 landmarks.  Where
poses are far apart these are wrong: then the best of several maps is taken.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from s4a.geometry.align import RigidTransform, align, farthest_points, realign, rigid_transform
from s4a.geometry.closest import POSITION_WEIGHT
from s4a.geometry.mesh import edges
from s4a.method import fmap, spectral_icp
from s4a.method.shape import Basis, common_fields, corresponding_landmarks, field_columns
from s4a.options import check
from s4a.schema import Array

N_LANDMARKS = 10  # of step 3
# Of a pair alone, in a far pose: signatures, functions by k_init, and weight of the orientation.
# Signed mean curvature goes with each: front and back of a body differ by nothing else
SEARCHED = tuple(itertools.product(("hks+wks", "wks", "hks"), (0.5, 1.0, 1.5), (1.0, 10.0)))
N_ENDS, N_ENDS_OTHER = 5, 7  # extremities of one shape, and of the other among which they are
N_PAIRED = 8  # the likeliest ways to pair them
_CURVATURE = 3.0  # its weight by that of a signature
_ON_A_LINE = 0.02  # of sqrt(area): landmarks as near to a line say nothing of turns about it
_BENT = 0.3  # weight of the gap of curvatures in that score
SHORT = 60  # functions of the short ZoomOut that a map is scored after
_FOUND = 0.07  # score at which the search ends; of wrong maps between bodies it is 0.11 or more


class _InitialMap(NamedTuple):
    """An initial map of a directed pair, and what it was made of."""

    name: str  # "dense", "landmarks", or of far poses that of best_initial_map
    C: Array  # (k_init, k_init)
    fitted: Array  # (k_init, k_init), before the step of ZoomOut ahead
    near: Array  # (n_target,), nearest neighbours in space after the transform
    landmarks: tuple[Array, Array] | None  # of source and target, where it was fitted so


def transform_onto(source: Basis, target: Basis) -> RigidTransform:
    """Rigid transform (R, t) of the source onto the target by ICP (4.1, step 2).

    It begins where landmarks say, if both have three or more that do not lie on one line.
    """
    at_source, at_target = corresponding_landmarks(source, target)
    P = source.X[at_source]
    if len(P) < 3 or np.linalg.svd(P - P.mean(0), compute_uv=False)[1] < _ON_A_LINE:
        R, t, _ = align(source.X, source.area, target.X, target.area)
        return R, t
    R, t, _ = rigid_transform(P, target.X[at_target])
    return realign(source.cloud, target.cloud, (R, t))


def nearest_after_alignment(source: Basis, target: Basis, transform: RigidTransform) -> Array:
    """The vertex of the moved source nearest to every vertex of the target ``(n_target,)``.

    Nearest in position and in the fields that guide both.
    """
    R, t = transform
    P, Q = source.X @ R.T + t, target.X
    names = common_fields(source, target)
    if names:
        P = np.concatenate([POSITION_WEIGHT * P, field_columns(source, names)], axis=1)
        Q = np.concatenate([POSITION_WEIGHT * Q, field_columns(target, names)], axis=1)
    return cKDTree(P).query(Q)[1]


def landmarks_after_alignment(X: Array, Y: Array, transform: RigidTransform) -> tuple[Array, Array]:
    """Step 3: ten spread vertices of the source, and the vertices of the target nearest to them.

    Parameters
    ----------
    X, Y : float ndarray (n_source, 3), (n_target, 3)
        Vertices of source and target.
    transform : tuple (R, t)
        Rigid transform of the source onto the target.
    """
    R, t = transform
    landmark = farthest_points(X, N_LANDMARKS)
    return landmark, cKDTree(Y).query(X[landmark] @ R.T + t)[1]


def fit_after_alignment(
    source: Basis, target: Basis, transform: RigidTransform, *, k_init: int, init: str, near: Array
) -> tuple[Array, tuple[Array, Array] | None]:
    """The map as it is fitted, and with ``init="landmarks"`` the landmarks of both."""
    M, N = source.first(k_init), target.first(k_init)
    if init == "dense":
        return fmap.fmap_from_match(M.Phi, N.Phi, N.mass, near), None
    landmarks = landmarks_after_alignment(M.X, N.X, transform)
    return fmap.fmap_from_landmarks(M, N, *landmarks), landmarks


def map_after_alignment(
    source: Basis,
    target: Basis,
    transform: RigidTransform,
    *,
    k_init: int = 20,
    init: str = "dense",
    initial_refinement: bool = True,
    n_samples: int = 0,
) -> _InitialMap:
    """First functional map of a directed pair (4.1, steps 3 and 4).

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    transform : tuple (R, t)
        Rigid transform of the source onto the target (step 2).
    init : {"dense", "landmarks"}
        From all vertices' nearest neighbours, or the paper's fit on 10 farthest points.
    initial_refinement : bool
        Whether one step of ZoomOut is done ahead (4.2).
    n_samples : int
        Of that step, see :func:`s4a.method.fmap.refine_once`.
    """
    check("init", init)
    near = nearest_after_alignment(source, target, transform)
    fitted, landmarks = fit_after_alignment(
        source, target, transform, k_init=k_init, init=init, near=near
    )
    C = fmap.refine_once(source, target, fitted, n_samples) if initial_refinement else fitted
    return _InitialMap(init, C, fitted, near, landmarks)


def stretch(target: Basis, X: Array) -> float:
    """Median |log| of the edges' lengths where the target is at X ``(n, 3)``, by its own."""
    ends = edges(target.T).T  # (2, e)
    after, before = (
        np.maximum(np.linalg.norm(np.subtract(*P[ends]), axis=1), 1e-12) for P in (X, target.X)
    )
    return float(np.median(np.abs(np.log(after / before))))


def best_initial_map(
    source: Basis, target: Basis, C: Array, fitted: Array | None = None, *, search: bool = False
) -> tuple[str, Array, Array]:
    """Return the best of an initial map and of those from heat and wave kernels.

    Where both have landmarks, also of one from wave kernels and these.

    Either kind alone fails on some pairs: shapes that nearly are their own mirror image are turned
    over, or limbs exchanged.  Each map is refined by a short ZoomOut and a few iterations of
    :func:`s4a.method.spectral_icp.coarse_spectral_icp` by parts; their end is scored without truth,
    :func:`s4a.method.spectral_icp.registration_score` + :func:`stretch`, as a pose hardly stretches
    the surface, + in a search 0.3 :func:`s4a.method.fmap.curvature_difference`, which tells front
    from back.

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    C : float ndarray (k_init, k_init)
        Initial map from ICP.
    fitted : float ndarray (k_init, k_init), optional
        That map before its step of ZoomOut; C where there was none.
    search : bool
        Whether to go on through :func:`paired_extremities` and :data:`SEARCHED` until the first two
        terms of a score are below ``_FOUND``.

    Returns
    -------
    name : str
        "icp", "marked", "hks" or "wks", or of the search as "extremities 1" or
        "hks+wks, curvature, k 10, oriented 1".
    C, fitted : float ndarray (k_init, k_init)
        The map, and as it was before its step of ZoomOut.
    """
    k = min(SHORT, source.k, target.k)
    maps = [("icp", C, C if fitted is None else fitted)]
    maps += _map_from_landmarks(source, target, len(C))
    best = np.inf
    tried = []  # score, name, map, fit
    for one in itertools.chain(maps, maps_from_signatures(source, target, len(C), search)):
        match = fmap.zoomout(source, target, one[1], k, step=10)[1]
        end = spectral_icp.coarse_spectral_icp(
            source, target, match, k_first=20, step=20, iterations=1, articulated=True
        )
        image = spectral_icp.move(target, end[1])
        gap = spectral_icp.registration_score(source, target, end[0], target.moved_to(image))
        score = gap + stretch(target, image)
        best = min(best, score)
        bent = _BENT * fmap.curvature_difference(source, target, end[0]) if search else 0.0
        tried.append((score + bent, *one))
        if len(tried) >= 2 + len(maps) and best < _FOUND:
            break
    return min(tried, key=lambda one: one[0])[1:]


def _map_from_landmarks(source, target, k):
    """Name, initial map and its fit ``(k, k)`` of wave kernels and three landmarks."""
    landmarks = corresponding_landmarks(source, target)
    if len(landmarks[0]) < 3:
        return []
    fitted = fmap.fmap_from_descriptors(source, target, k=k, landmarks=landmarks)
    return [("marked", fmap.refine_once(source, target, fitted), fitted)]


def maps_from_signatures(
    source: Basis, target: Basis, k: int, search: bool
) -> Iterator[tuple[str, Array, Array]]:
    """Name, initial map and its fit ``(k, k)`` of heat and of wave kernels, and of a search more.

    The search begins with wave kernels and extremities as landmarks.
    """
    for kind in ("hks", "wks"):
        fitted = fmap.fmap_from_descriptors(source, target, k=k, kind=kind)
        yield kind, fmap.refine_once(source, target, fitted), fitted
    if not search:
        return
    for i, ends in enumerate(paired_extremities(source, target)):
        fitted = fmap.fmap_from_descriptors(source, target, k=k, landmarks=ends)
        yield f"extremities {i + 1}", fmap.refine_once(source, target, fitted), fitted
    for kind, share, oriented in SEARCHED:
        size = min(max(4, round(share * k)), source.k, target.k)
        fitted = fmap.fmap_from_descriptors(
            source, target, k=size, kind=kind, oriented=oriented, curvature=_CURVATURE
        )
        if size < k:
            fitted = fmap.zoomout(source, target, fitted, k, step=k)[0]
        fitted = fitted[:k, :k]
        name = f"{kind}, curvature, k {size}, oriented {oriented:g}"
        yield name, fmap.refine_once(source, target, fitted), fitted


def extremities(basis: Basis, n: int) -> tuple[Array, Array]:
    """Vertices that lie as far as possible from each other along the edges, as hands and feet do.

    The first is the farthest from the middle.  What is not connected with it is never taken.

    Returns
    -------
    vertex : int ndarray (n,)
    distance : float ndarray (n, n)
        Between them along the edges.
    """

    def distance_from(vertex: int) -> Array:
        d = dijkstra(basis.graph, indices=vertex)
        return np.where(np.isfinite(d), d, 0.0)

    from_middle = ((basis.X - basis.area @ basis.X) ** 2).sum(1)
    vertices = [int(distance_from(int(from_middle.argmin())).argmax())]
    rows = [distance_from(vertices[0])]
    while len(vertices) < n:
        vertices.append(int(np.min(rows, axis=0).argmax()))
        rows.append(distance_from(vertices[-1]))
    return np.array(vertices), np.array(rows)[:, vertices]


def paired_extremities(source: Basis, target: Basis) -> list[tuple[Array, Array]]:
    """Extremities of the source and of the target ``(5,)``: the likeliest ways to pair them.

    Five of one are some of seven of the other, both ways, and the likelier the better the distances
    along the edges agree, by the sum of their differences.  A shape that nearly is its own mirror
    image has several ways that are as good.
    """
    ends = [extremities(basis, N_ENDS_OTHER) for basis in (source, target)]
    chosen = np.array(list(itertools.permutations(range(N_ENDS_OTHER), N_ENDS)))  # (p, 5)
    found = []
    for (few, D), (many, E) in (ends, ends[::-1]):
        D = D[:N_ENDS, :N_ENDS]
        cost = np.abs(D - E[chosen[:, :, None], chosen[:, None, :]]).sum((1, 2)) / D.sum()
        for way in np.argsort(cost, kind="stable")[:N_PAIRED]:
            pair = few[:N_ENDS], many[chosen[way]]
            found.append((cost[way], pair if few is ends[0][0] else pair[::-1]))
    ways = {}  # by what is paired, as both directions find some ways
    for _, (a, b) in sorted(found, key=lambda one: one[0]):
        ways.setdefault(frozenset(zip(a.tolist(), b.tolist(), strict=True)), (a, b))
    return list(ways.values())[:N_PAIRED]


def _have_signatures(source, target, k):
    """Whether the first k eigenvalues of both, less those of 0, have a range in common.

    Those of a surface in many pieces may be 0 all.
    """
    ends = (source.eigenvalue, target.eigenvalue)
    least = max(value[value > 0].min(initial=np.inf) for value in ends)
    return bool(1.01 * least < min(value[k - 1] for value in ends))


def initial_map(
    source: Basis, target: Basis, transform: RigidTransform, *, search: bool = False, **options: Any
) -> _InitialMap:
    """:func:`map_after_alignment`, or :func:`best_initial_map` where poses are far apart.

    The latter only where `init` is dense and there are signatures, ``_have_signatures``.

    Parameters
    ----------
    source, target, transform : see :func:`map_after_alignment`
    search : bool
        See :func:`best_initial_map`; for pairs alone, as Consistent ZoomOut mends those of a
        network.
    **options
        Of :func:`map_after_alignment`; maps of far poses, which are looked for in other ways, take
        all vertices.
    """
    first = map_after_alignment(source, target, transform, **options)
    far = first.name == "dense" and spectral_icp.poses_differ(source, target, first.near)
    if not (far and _have_signatures(source, target, len(first.C))):
        return first
    name, C, fitted = best_initial_map(source, target, first.C, first.fitted, search=search)
    return _InitialMap(name, C, fitted, first.near, None)
