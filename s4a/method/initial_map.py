"""Initial functional maps (4.1, steps 3 and 4), and their refinement by a step of ZoomOut (4.2).

As in the paper, maps are fitted to nearest neighbours after ICP, of all vertices or 10 landmarks.
If poses differ much, these are wrong, and the best of several maps is used.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from s4a.geometry.align import RigidTransform, farthest_points
from s4a.geometry.closest import POSITION_WEIGHT
from s4a.geometry.mesh import edges
from s4a.method import fmap, spectral_icp
from s4a.method.shape import Basis, common_fields, corresponding_landmarks, field_columns
from s4a.options import check
from s4a.schema import Array, dataset

N_LANDMARKS = 10  # of step 3
# maps that a search tries for a pair: signatures, number of functions relative to k_init, weight of
# orientation.  All use signed mean curvature, which distinguishes front and back of a body
SEARCHED = tuple(itertools.product(("hks+wks", "wks", "hks"), (0.5, 1.0, 1.5), (1.0, 10.0)))
N_ENDS, N_ENDS_OTHER = 5, 7  # extremities of one shape, matched to some of those of the other
N_PAIRED = 8  # number of best pairings
_CURVATURE = 3.0  # weight of mean curvature relative to a signature
_CURVATURE_WEIGHT = 0.3  # of the curvature difference in the score of a search
SHORT = 60  # functions of the short ZoomOut before a map is scored
# scores at which the search ends: of any map, or of the best if two others agree with it.  Wrong
# maps between bodies score 0.11 or more
_MAX_SCORE, _MAX_AGREED = 0.07, 0.1
# mean distances of the matches of maps that agree, and of maps that differ, of sqrt(area)
_AGREE, _DIFFER = 0.03, 0.1
# of maps that are returned: number, largest score and curvature difference over those of the best
_N_BEST, _MARGIN, _CURVATURE_MARGIN = 4, 1.25, 1.1


class _InitialMap(NamedTuple):
    """Initial map of a directed pair, and the data to which it was fitted."""

    name: str  # "dense", "landmarks", or a name of best_initial_maps
    C: Array  # (k_init, k_init)
    fitted: Array  # (k_init, k_init), before the step of ZoomOut
    near: Array  # (n_target,), nearest neighbours in space after the rigid transform
    landmarks: tuple[Array, Array] | None = None  # of source and target, with init="landmarks"
    descriptors: tuple[Array, Array] | None = None  # of source and target, with init="landmarks"
    energies: Array | None = None  # both terms of the fit to them
    score: float = 1.0  # of best_initial_maps
    others: tuple["_InitialMap", ...] = ()  # maps of a search that may be better

    def fit_to_landmarks(self, keep_descriptors: bool) -> xr.Dataset:
        """Return the terms of the fit to landmarks and, if asked for, the descriptors."""
        if self.descriptors is None or self.energies is None:
            return xr.Dataset()
        energies = dict(zip(("descriptor_energy", "laplacian_energy"), self.energies, strict=True))
        F, G = (values.astype(np.float32) for values in self.descriptors)
        descriptors = {"descriptor_of_source": F, "descriptor_of_target": G}
        return dataset(None, **energies, **(descriptors if keep_descriptors else {}))


class _Scored(NamedTuple):
    """Candidate: score, its curvature difference, matched points ``(n_target, 3)``, and the map."""

    score: float
    curvature: float
    X: Array
    candidate: tuple[str, Array, Array]


def nearest_after_alignment(source: Basis, target: Basis, transform: RigidTransform) -> Array:
    """Return the nearest vertex of the aligned source for every target vertex ``(n_target,)``.

    Nearest in position and common fields.
    """
    R, t = transform
    P, Q = source.X @ R.T + t, target.X
    names = common_fields(source, target)
    if names:
        P = np.concatenate([POSITION_WEIGHT * P, field_columns(source, names)], axis=1)
        Q = np.concatenate([POSITION_WEIGHT * Q, field_columns(target, names)], axis=1)
    return cKDTree(P).query(Q)[1]


def landmarks_after_alignment(X: Array, Y: Array, transform: RigidTransform) -> tuple[Array, Array]:
    """Return ten farthest-point samples of the source and their nearest target vertices (step 3).

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
) -> _InitialMap:
    """Fit a map to all nearest neighbours, or to landmarks (step 4); it is not refined."""
    M, N = source.truncated(k_init), target.truncated(k_init)
    if init == "dense":
        C = fmap.fmap_from_match(M.Phi, N.Phi, N.mass, near)
        return _InitialMap(init, C, C, near)
    landmarks = landmarks_after_alignment(M.X, N.X, transform)
    if init == "wave_kernels":
        C = fmap.fmap_from_wave_kernels(source, target, *landmarks, k=k_init)
        return _InitialMap(init, C, C, near, landmarks)
    F, G = fmap.landmark_descriptors(M, N, *landmarks)
    C = fmap.fit_to_landmarks(M, N, F, G)
    energies = fmap.landmark_energies(M, N, C, F, G)
    return _InitialMap(init, C, C, near, landmarks, (F, G), energies)


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
    """Compute the initial functional map of a directed pair (4.1, steps 3 and 4).

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    transform : tuple (R, t)
        Rigid transform of the source onto the target (step 2).
    init : {"dense", "landmarks", "wave_kernels"}
        Fit to nearest neighbours of all vertices, as in the paper to 10 farthest points, or to wave
        kernels of the shapes and around these points.
    initial_refinement : bool
        Whether to refine the map by a step of ZoomOut (4.2).
    n_samples : int
        Samples of that step, see :func:`s4a.method.fmap.refine_once`.
    """
    check("init", init)
    near = nearest_after_alignment(source, target, transform)
    initial = fit_after_alignment(source, target, transform, k_init=k_init, init=init, near=near)
    if not initial_refinement:
        return initial
    return initial._replace(C=fmap.refine_once(source, target, initial.fitted, n_samples))


def stretch(target: Basis, X: Array) -> float:
    """Return the median |log| ratio of edge lengths with target vertices at X ``(n, 3)``."""
    ends = edges(target.T).T  # (2, e)
    after, before = (
        np.maximum(np.linalg.norm(np.subtract(*P[ends]), axis=1), 1e-12) for P in (X, target.X)
    )
    return float(np.median(np.abs(np.log(after / before))))


def best_initial_maps(
    source: Basis, target: Basis, C: Array, fitted: Array | None = None, *, search: bool = False
) -> list[tuple[str, Array, Array, float]]:
    """Return the best of the map from ICP and maps fitted to heat and wave kernels.

    If both shapes have landmarks, also a map fitted to wave kernels around these.  No descriptor
    works for all pairs: nearly symmetric shapes are flipped, or limbs exchanged.  Each map is
    refined by a short ZoomOut and piecewise rigid iterations of
    :func:`s4a.method.spectral_icp.coarse_spectral_icp`.  The result is scored without ground truth
    by :func:`s4a.method.spectral_icp.registration_score` + :func:`stretch`, as changes of pose
    hardly stretch a surface.  A search adds 0.3 :func:`s4a.method.fmap.curvature_difference`, which
    distinguishes front and back.

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    C : float ndarray (k_init, k_init)
        Initial map from ICP.
    fitted : float ndarray (k_init, k_init), optional
        The same before the step of ZoomOut; C by default.
    search : bool
        Whether to continue with :func:`paired_extremities` and :data:`SEARCHED` until the first two
        terms of a score are below 0.07, or below 0.1 and two other maps agree with the best.  If
        none is, up to four maps that differ are returned, and their registrations at full
        resolution decide.  Their scores are at most 1.25 times, and their curvature differences 1.1
        times those of the best, which excludes symmetric flips.

    Returns
    -------
    list of (name, C, fitted, score)
        The best first.  The name is "icp", "marked", "hks" or "wks", or from the search
        "extremities 1" or "hks+wks, curvature, k 10, oriented 1".  C and fitted ``(k_init,
        k_init)`` are the map after and before the step of ZoomOut.
    """
    k = min(SHORT, source.k, target.k)
    maps = [("icp", C, C if fitted is None else fitted)]
    maps += _map_from_landmarks(source, target, len(C))
    best = np.inf
    scored: list[_Scored] = []
    for candidate in itertools.chain(maps, maps_from_signatures(source, target, len(C), search)):
        match = fmap.zoomout(source, target, candidate[1], k, step=10)[1]
        match, warp = spectral_icp.coarse_spectral_icp(
            source, target, match, k_initial=20, step=20, iterations=1, articulated=True
        )
        image = spectral_icp.move(target, warp)
        score = spectral_icp.registration_score(source, target, match, target.moved_to(image))
        score += stretch(target, image)
        best = min(best, score)
        curvature = fmap.curvature_difference(source, target, match) if search else 0.0
        score += _CURVATURE_WEIGHT * curvature
        scored.append(_Scored(score, curvature, source.X[match], candidate))
        scored.sort(key=lambda row: row.score)
        n_agreed = sum(_distance(row, scored[0], target) < _AGREE for row in scored)
        if len(scored) >= 2 + len(maps) and best < (_MAX_AGREED if n_agreed > 2 else _MAX_SCORE):
            search = False
            break
    best_ones = _leaders(scored, target) if search else scored[:1]
    return [(*row.candidate, row.score) for row in best_ones]


def _distance(one, other, target):
    """Mean distance of two matches."""
    return np.linalg.norm(one.X - other.X, axis=1) @ target.area


def _leaders(scored, target):
    """Best of the sorted candidates that differ from each other."""
    leaders: list[_Scored] = []
    for row in scored:
        differs = all(_distance(row, other, target) > _DIFFER for other in leaders)
        alike = row.curvature <= _CURVATURE_MARGIN * scored[0].curvature  # no symmetric flip
        if differs and alike and row.score < _MARGIN * scored[0].score:
            leaders.append(row)
    return leaders[:_N_BEST]


def _map_from_landmarks(source, target, k):
    """Name, initial map and fit ``(k, k)`` from wave kernels around three or more landmarks."""
    landmarks = corresponding_landmarks(source, target)
    if len(landmarks[0]) < 3:
        return []
    fitted = fmap.fmap_from_descriptors(source, target, k=k, landmarks=landmarks)
    return [("marked", fmap.refine_once(source, target, fitted), fitted)]


def maps_from_signatures(
    source: Basis, target: Basis, k: int, search: bool
) -> Iterator[tuple[str, Array, Array]]:
    """Yield name, initial map and fit ``(k, k)`` for heat and wave kernels, and those of a search.

    The search begins with wave kernels around extremities.
    """
    for kind in ("hks", "wks"):
        fitted = fmap.fmap_from_descriptors(source, target, k=k, kind=kind)
        yield kind, fmap.refine_once(source, target, fitted), fitted
    if not search:
        return
    for i, landmarks in enumerate(paired_extremities(source, target)):
        fitted = fmap.fmap_from_descriptors(source, target, k=k, landmarks=landmarks)
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
    """Return geodesic farthest points, such as hands and feet, on the component of the first.

    The first is the farthest from the centre.

    Returns
    -------
    vertex : int ndarray (n,)
    distance : float ndarray (n, n)
        Path lengths between them along the edges.
    """

    def distance_from(vertex: int) -> Array:
        d = dijkstra(basis.graph, indices=vertex)
        return np.where(np.isfinite(d), d, 0.0)

    from_centre = ((basis.X - basis.area @ basis.X) ** 2).sum(1)
    vertices = [int(distance_from(int(from_centre.argmin())).argmax())]
    rows = [distance_from(vertices[0])]
    while len(vertices) < n:
        vertices.append(int(np.min(rows, axis=0).argmax()))
        rows.append(distance_from(vertices[-1]))
    return np.array(vertices), np.array(rows)[:, vertices]


def paired_extremities(source: Basis, target: Basis) -> list[tuple[Array, Array]]:
    """Return the best pairings of extremities of source and target ``(5,)``.

    Five of one shape are matched to five of seven of the other, in both directions.  The cost is
    the sum of the differences of geodesic distances.  A nearly symmetric shape has several good
    pairings.
    """
    ends = [extremities(basis, N_ENDS_OTHER) for basis in (source, target)]
    chosen = np.array(list(itertools.permutations(range(N_ENDS_OTHER), N_ENDS)))  # (p, 5)
    costs = []
    for (few, D), (many, E) in (ends, ends[::-1]):
        D = D[:N_ENDS, :N_ENDS]
        cost = np.abs(D - E[chosen[:, :, None], chosen[:, None, :]]).sum((1, 2)) / D.sum()
        for row in np.argsort(cost, kind="stable")[:N_PAIRED]:
            pair = few[:N_ENDS], many[chosen[row]]
            costs.append((cost[row], pair if few is ends[0][0] else pair[::-1]))
    pairings = {}  # both directions find some of them
    for _, (a, b) in sorted(costs, key=lambda pairing: pairing[0]):
        pairings.setdefault(frozenset(zip(a.tolist(), b.tolist(), strict=True)), (a, b))
    return list(pairings.values())[:N_PAIRED]


def _have_signatures(source, target, k):
    """Whether the positive ones of the first k eigenvalues of both shapes overlap in range.

    A surface with many components may have only eigenvalues 0.
    """
    spectra = (source.eigenvalue, target.eigenvalue)
    least = max(value[value > 0].min(initial=np.inf) for value in spectra)
    return bool(1.01 * least < min(value[k - 1] for value in spectra))


def initial_map(
    source: Basis,
    target: Basis,
    transform: RigidTransform,
    *,
    search: bool = False,
    alignment: str = "search",
    **options: Any,
) -> _InitialMap:
    """Compute an initial map: :func:`map_after_alignment`, or the best of several if poses differ.

    :func:`best_initial_maps` needs ``init="dense"`` and signatures.

    Parameters
    ----------
    source, target, transform : see :func:`map_after_alignment`
    search : bool
        See :func:`best_initial_maps`; for single pairs, as Consistent ZoomOut corrects the maps of
        a network.
    alignment : {"search", "icp", "given"}
        Only the map after alignment is used if the pose is given, as others can be of other poses.
    **options
        Options of :func:`map_after_alignment`; `n_samples` is ignored if poses differ.
    """
    initial = map_after_alignment(source, target, transform, **options)
    if alignment == "given":
        return initial
    differ = initial.name == "dense" and spectral_icp.poses_differ(source, target, initial.near)
    if not (differ and _have_signatures(source, target, len(initial.C))):
        return initial
    best, *others = (
        _InitialMap(name, C, fitted, initial.near, score=score)
        for name, C, fitted, score in best_initial_maps(
            source, target, initial.C, initial.fitted, search=search
        )
    )
    return best._replace(others=tuple(others))
