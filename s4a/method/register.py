"""Registration (4.2; eq. 3, 4, 6, 7, 8): one shape onto the template at full resolution, and back.

The source is the shape M_i, the target the template, the paper's median shape: a match holds, on
every vertex of the template, a vertex of the shape.
"""

from typing import Any

import numpy as np
import xarray as xr

from s4a.geometry.align import RigidTransform
from s4a.geometry.closest import closest_point_in_star, interpolate, match_surfaces
from s4a.geometry.mesh import as_arrays, triangle_areas, vertex_areas
from s4a.method import spectral_icp
from s4a.method.deform import displacement_in_template, distortion
from s4a.method.elastic import (
    FOLLOWING,
    STIFFNESS,
    Landmarks,
    converging_initialisations,
    elastic_iterations,
    local_iterations,
)
from s4a.method.fmap import fmap_from_match
from s4a.method.initial_map import nearest_after_alignment
from s4a.method.nearest import nearest_in_cells, nearest_of_few, nearest_rows
from s4a.method.shape import Basis, Shape
from s4a.options import check
from s4a.schema import INPUT, Array, dataset, in_unit

RIGHT = 0.01  # share of sqrt(area): errors below are right
LEAST = 1e-4  # added to gap and stretch: what is below is noise of the mesh
# w_0, and those of the logarithms of gap and stretch: docs/decisions.md
WEIGHTS = (-12.06, -1.46, -1.58)


def stretch(X: Array, image: Array, T: Array) -> Array:
    """How much a map stretches the triangles around every vertex ``(n,)``.

    The root mean square over their areas of sqrt(log(s1)^2 + log(s2)^2), s1 and s2 the singular
    values of a triangle's linear map.

    Parameters
    ----------
    X, image : float ndarray (n, 3)
        The vertices, and where the map takes them.
    T : int ndarray (m, 3)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.register import stretch
    >>> X, T = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    >>> image = X * [2.0, 0.5, 1.0]  # of the same area
    >>> bool(np.allclose(stretch(X, image, T), np.sqrt(2) * np.log(2)))
    True
    """
    conformal, area = distortion(X, image, T)
    before = triangle_areas(X, T)
    squared = (area**2 + conformal**2) / 2  # log(s1)^2 + log(s2)^2
    squared = np.minimum(np.where(np.isnan(squared), 0.0, squared), 100.0)  # points, collapsed ones
    corners = T.ravel()
    total, weight = (
        np.bincount(corners, np.repeat(values, 3), len(X)) for values in (before * squared, before)
    )
    return np.sqrt(total / np.maximum(weight, np.finfo(float).tiny))


def evidence(source: Shape, target: Shape, match: Array, P: Array) -> Array:
    """Logarithms of gap and stretch, smooth over the template ``(n_target, 2)``.

    Parameters
    ----------
    source, target : Shape
        The shape and the template.
    match : int ndarray (n_target,)
        Near which vertex of the shape each vertex of the template lies.
    P : float ndarray (n_target, 3)
        The registered template, in the frame of the shape.
    """
    X, T, near = target.full.X, target.full.T, target.near_coarse  # what is smooth is known there
    Y, S = source.full.X, source.full.T
    place = closest_point_in_star(P[near], match[near], Y, S, source.full.stars)
    gap = np.linalg.norm(P[near] - interpolate(Y, S, *place), axis=1)  # share of sqrt(area)
    beside = np.zeros(len(X), bool)
    beside[near] = True
    around = T[beside[T].any(axis=1)]
    found = np.log(np.stack([gap, stretch(X, P, around)[near]], axis=1) + LEAST)
    return target.full.field(target.full.coefficients(found))


def confidence(source: Shape, target: Shape, match: Array, P: Array) -> Array:
    """Probability ``(n_target,)`` that a vertex lies within 1 % of sqrt(area) of its true place.

    Parameters
    ----------
    source, target, match, P : see :func:`evidence`
    """
    w_0, *w = WEIGHTS
    flag = -(w_0 + evidence(source, target, match, P) @ np.array(w))
    return 1 / (1 + np.exp(np.clip(flag, -50, 50)))


def uncertainty(confidence: Array) -> Array:
    """Root of the mean squared error of a match that is this sure, as a share of sqrt(area).

    A confidence is the share of such vertices within 1 % of sqrt(area) of the truth.  Where errors
    are Gaussian in the plane, that is 1 - exp(-0.01^2 / r^2) for the radius r.

    Parameters
    ----------
    confidence : ndarray (p,)
        Below 0.1 it counts as 0.1, which is a radius of 3 %.

    Returns
    -------
    ndarray (p,)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.register import uncertainty
    >>> uncertainty(np.array([0.1, 0.63, 1.0])).round(3).tolist()
    [0.031, 0.01, 0.003]
    """
    return RIGHT / np.sqrt(-np.log1p(-np.clip(confidence, 0.1, 1 - 1e-6)))


# |log| of the ratio of areas at the hundredth of the template that changes most, above which it may
# lie on a wrong fold
TORN = 0.65
FEW = 2000  # vertices of low resolution: fewer smear tears
_SMEARED = 0.3  # by this share of TORN
_LOOSER = 4  # the step of elastic iterations with which they begin then, too
# of score times tear: what looser iterations must leave at most.  Where they find the right fold
# they leave 0.3 to 0.72; real heads 0.81 or more where the score falls at all (docs/decisions.md)
_MENDED = 0.75

Functions = tuple[Array, Array]  # of source and target, rows of which are compared


def match_low(
    source: Shape, target: Shape, bases: Functions, *, dense_match: str = "latent"
) -> tuple[Array, Functions]:
    """Match at low resolution (eq. 6), and the functions whose rows full resolution compares.

    Parameters
    ----------
    source, target : Shape
    bases : tuple of float ndarray (k, m)
        Consistent latent bases Y of source and target.
    dense_match : {"latent", "fmap"}
        Functions Phi Y for eq. 7, or those of the functional map of the match for eq. 4.

    Returns
    -------
    match : int ndarray (n_coarse_target,)
    functions : tuple of float ndarray (n_coarse, m)
        At all vertices where they are lifted.
    """
    check("dense_match", dense_match)
    Y_source, Y_target = bases  # (k, m) each
    k = len(Y_source)
    Phi, Psi = source.low.Phi[:, :k], target.low.Phi[:, :k]
    match = nearest_rows(Psi @ Y_target, Phi @ Y_source)  # eq. 6
    if dense_match == "latent":
        return match, latent_functions(source, target, bases)
    C = fmap_from_match(Phi, Psi, target.low.mass, match)  # of eq. 3, for eq. 4
    return match, (source.functions(C.T), target.functions(np.eye(k)))


def latent_functions(source: Shape, target: Shape, bases: Functions) -> Functions:
    """The latent functions Phi Y of both, whose rows eq. 7 compares."""
    Y_source, Y_target = bases
    return source.functions(Y_source), target.functions(Y_target)


def match_functions(
    source: Shape, target: Shape, F_source: Array, F_target: Array
) -> tuple[Array, float, float]:
    """Match at full resolution by nearest rows of U F: eq. 7 with F = Phi Y, eq. 4 with Phi C^T.

    Functions that have a row for every original vertex are taken as they are.

    Returns
    -------
    match : int ndarray (n_target,)
    compared, certified : float
        Shares of :func:`s4a.method.nearest.nearest_in_cells`.
    """
    queries = target.full.extend(F_target)  # (n_target, m)
    rows = source.full.extend(F_source)  # (n_source, m)
    return nearest_in_cells(queries, target.cell, rows, source.cell)


def refine_at_full_resolution(
    source: Shape, target: Shape, C: Array, B: Array | None = None
) -> Array:
    """One more round of ZoomOut: coarse target vertices look among all vertices of the source.

    ZoomOut on the coarse meshes can only match coarse vertices, half their spacing off; that noise
    is in its C.

    Parameters
    ----------
    source, target : Shape
    C : float ndarray (k_target, k_source)
    B : float ndarray (n_source, >= k_source), optional
        Functions of the source at all its vertices; U Phi by default.

    Returns
    -------
    C : float ndarray (k_target, k_source)
    """
    k_target, k_source = C.shape
    if B is None:
        Phi = source.low.Phi[:, :k_source]
        B = source.U.astype(np.float32) @ Phi.astype(np.float32)
    B = B[:, :k_source]
    Psi = target.low.Phi[:, :k_target]
    match = nearest_of_few(Psi, B @ C.T.astype(B.dtype), source.cell)
    return fmap_from_match(B, Psi, target.low.mass, match)


def from_latent(
    source: Shape,
    target: Shape,
    bases: Functions,
    transform: RigidTransform,
    *,
    dense_match: str = "latent",
    **options: Any,
) -> xr.Dataset:
    """One shape registered by the latent bases of a network (eq. 6, 7 and 8).

    Eq. 6 gives one start and ICP another; elastic iterations refine both, and the best is kept.
    Eq. 7, or eq. 3 and 4, is the match at full resolution with ``refine="intrinsic"``, as in the
    paper, or where that candidate is the best; eq. 8 follows.

    Parameters
    ----------
    source, target : Shape
        The shape and the template.
    bases : tuple of float ndarray (k, m)
        Their consistent latent bases Y.
    transform : tuple (R, t)
        Rigid transform of the shape onto the template (4.1, step 2), between their frames.
    dense_match : {"latent", "fmap"}
        Eq. 7, or eq. 3 and 4.
    **options
        Of :func:`register`.

    Returns
    -------
    xarray.Dataset
        As of :func:`register`.
    """
    match, functions = match_low(source, target, bases, dense_match=dense_match)
    near = nearest_after_alignment(source.low, target.low, transform)
    starts = {"intrinsic": match, "icp": near}
    return register(source, target, starts, functions, transform, k=len(bases[0]), **options)


def register(
    source: Shape,
    target: Shape,
    starts: dict[str, Array],
    functions: Functions,
    transform: RigidTransform,
    *,
    k: int = 100,
    refine: str = "elastic",
    remove_size: bool = False,
    articulated: bool = True,
    alignment: str = "fitted",
) -> xr.Dataset:
    """The registration of one shape: match, displacement, transform, confidence and the way back.

    Parameters
    ----------
    source, target : Shape
        The shape and the template.
    starts : dict
        Name -> match (n_coarse_target,): starts at low resolution; "intrinsic" is among them.
    functions : tuple (F_source, F_target)
        Functions on both coarse meshes for the match at full resolution, see
        :func:`match_functions`.
    transform : tuple (R, t)
        Rigid transform of the shape onto the template found by ICP, between their frames.
    k : int
        Functions in which the displacement lives.
    refine : {"elastic", "spectral_icp", "intrinsic"}
        Elastic and local iterations, after joint ones in far poses; joint iterations; or the
        spectral match alone.  After local iterations the displacement is not only in the first k
        functions; ``displacement_coefficient`` is its part there.
    remove_size : bool
        Whether size is taken out of the displacement.
    articulated : bool
        Whether in far poses joint iterations may turn the parts of a shape on their own.
    alignment : {"fitted", "icp"}
        The displacement is measured after the transform that fits the registered surface best, or
        after that of ICP, as the paper has it: then eq. 8 and (U Phi)(U Phi)^+ are as printed.

    Returns
    -------
    xarray.Dataset
        ``registered_match(vertex)``, ``displacement(vertex, xyz)``, ``displacement_raw``,
        ``registered_match_low(low_vertex)``, the start "intrinsic" (of eq. 6, or of ZoomOut where a
        pair is matched on its own), and ``displacement_low(low_vertex, xyz)`` of it;
        ``displacement_coefficient(eigenpair, xyz)`` of the displacement in U Phi of the template;
        ``icp_rotation``, ``icp_translation`` as given; ``rotation``, ``translation``, ``scale``,
        ``confidence(vertex)``, ``round_trip``, ``distortion``,
        ``template_triangle(original_vertex)``, ``template_barycentric``; displacements in the unit
        of the input, in the template's frame.  Attributes ``method``, the candidate that was kept,
        ``score``, its score at full resolution, and ``score_<candidate>`` at low resolution.
    """
    check("alignment", alignment)
    candidates = find_candidates(
        source, target, starts, k=k, refine=refine, articulated=articulated
    )
    by_icp = (
        _transform_in_unit(source, target, transform, remove_size) if alignment == "icp" else None
    )
    # image = R x + t + U Phi c, smooth already: the line after eq. 8; or of elastic iterations
    placed, elastic = by_icp and (transform, by_icp[3]), refine == "elastic"
    match, moved, attrs = register_surface(
        source, target, candidates, functions, placed, elastic=elastic
    )
    image = source.from_frame(moved.X)
    triangle, barycentric = way_back(source.full, moved)
    X, T = as_arrays(target.original)
    if by_icp:
        R, t, s, _ = by_icp
        displacement = s * image @ R.T + t - X
    else:
        displacement, R, t, s = displacement_in_template(
            X, image, target.full.area, scale=remove_size
        )
    raw = s * source.original["position"].values[match] @ R.T + t - X
    X_low = target.coarse["position"].values
    low = s * source.coarse["position"].values[starts["intrinsic"]] @ R.T + t - X_low
    coefficient = target.full.coefficients(displacement[target.near_coarse])  # (k, 3)
    trip = round_trip(target, match, triangle, barycentric)
    sure = confidence(source, target, match, moved.X)
    registration = dataset(
        attrs,
        registered_match=match.astype(np.int32),
        displacement=displacement.astype(np.float32),
        displacement_raw=raw.astype(np.float32),
        registered_match_low=starts["intrinsic"].astype(np.int32),
        displacement_low=low.astype(np.float32),
        displacement_coefficient=coefficient,
        rotation=R,
        translation=t,
        scale=np.array(s),
        icp_rotation=transform[0],
        icp_translation=transform[1],
        confidence=sure.astype(np.float32),
        round_trip=trip.astype(np.float32),
        distortion=log_area_ratio(image, X, T).astype(np.float32),
        template_triangle=triangle.astype(np.int32),
        template_barycentric=barycentric,
    )
    if not np.isfinite(registration["displacement"]).all():
        raise ValueError("the displacement is not finite: look at the shape's coordinates")
    return in_unit(registration, common_unit(source.original, target.original))


def _transform_in_unit(
    source: Shape, target: Shape, transform: RigidTransform, remove_size: bool
) -> tuple[Array, Array, float, float]:
    """A rigid transform between the frames of two shapes as one between their files: R, t and s.

    And the ratio of sizes that it leaves.

    Without `remove_size` each keeps its size: the transform turns the source about its centre and
    carries that to where it belongs.
    """
    (center, size), (center_target, size_target) = source.frame, target.frame
    R, t = transform
    s = size_target / size if remove_size else 1.0
    return R, center_target + size_target * t - s * R @ center, s, s * size / size_target


def find_candidates(
    source: Shape,
    target: Shape,
    starts: dict[str, Array],
    *,
    k: int = 100,
    refine: str = "elastic",
    articulated: bool = True,
) -> dict[str, spectral_icp.Candidate]:
    """Where registration at full resolution may begin: of low resolution, with scores.

    Elastic iterations need no better start than a match of the right parts: from eq. 6, from ICP
    and from joint iterations after either they mostly end at one place (docs/decisions.md), so that
    joint iterations are left to far poses.

    Parameters
    ----------
    source, target, starts, k, refine, articulated : see :func:`register`

    Returns
    -------
    dict
        Name -> :class:`s4a.method.spectral_icp.Candidate`; none for the spectral match alone.
    """
    check("refine", refine)
    if refine == "intrinsic":
        return {}
    M, N = source.low, target.low
    if refine == "spectral_icp" or all(
        spectral_icp.far_apart(M, N, match) for match in starts.values()
    ):
        return spectral_icp.candidates(M, N, starts, k=k, articulated=articulated)
    return spectral_icp.as_given(M, N, starts)


def register_surface(
    source: Shape,
    target: Shape,
    candidates: dict[str, spectral_icp.Candidate],
    functions: Functions,
    placed: tuple[RigidTransform, float] | None = None,
    *,
    elastic: bool = False,
) -> tuple[Array, Basis, dict[str, Any]]:
    """The template registered at full resolution: the best of the finalists of low resolution.

    Parameters
    ----------
    source, target : Shape
    candidates : dict
        Of :func:`find_candidates`; empty for the spectral match alone.
    functions : see :func:`register`
    placed : tuple (transform, ratio), optional
        After which the displacement of the spectral match is smoothed, see
        :func:`s4a.method.spectral_icp.warp_after`; by default after the transform that fits it
        best.
    elastic : bool
        Whether finalists go through :func:`elastic_surfaces`, and through looser iterations, too,
        where the best end is torn (:func:`tear`); those by parts, of far poses, through local
        iterations alone, as bodies otherwise ended farther from the truth.

    Returns
    -------
    match : int ndarray (n_target,)
    moved : Basis
        Registered template, in the frame of the source.
    attrs : dict
        See :func:`register`.
    """
    M, N = source.full, target.full
    attrs: dict[str, float | str] = {
        f"score_{name}": candidate.score for name, candidate in candidates.items()
    }
    ends: dict[str, tuple[float, Basis]] = {}
    # starts as they are tell less of their ends than joint iterations do
    margin = 2.0 if elastic else 1.25
    names = spectral_icp.finalists(candidates, margin=margin) if candidates else ["intrinsic"]
    if elastic:
        whole = {n: candidates[n].warp for n in names if candidates[n].warp[0].ndim == 2}
        names = [name for name in names if name not in whole]  # by parts
        surfaces = elastic_surfaces(source, target, whole)
        ends = {f"{name}+elastic": _scored_alone(M, N, X) for name, X in surfaces.items()}
        limit = TORN * (1 - _SMEARED if len(target.low.X) < FEW else 1)
        if ends and tear(ends[_best_of(ends)][1], N) > limit:
            torn = ends[_best_of(ends)]
            again = elastic_surfaces(source, target, whole, looser=True)
            scored = {f"{name}+looser": _scored_alone(M, N, X) for name, X in again.items()}
            ends |= {name: end for name, end in scored.items() if mends(end, torn, N)}
    for name in names:
        if name == "intrinsic":
            match, compared, certified = match_functions(source, target, *functions)
            attrs |= {"compared_share": compared, "certified_share": certified}
            part = match[N.near_coarse]
            warp = (
                spectral_icp.warp_after(M, N, part, *placed)
                if placed
                else spectral_icp.fit_warp(M, N, part)
            )
        else:
            part, warp = spectral_icp.dense_spectral_icp(M, N, candidates[name].warp)
        if elastic:  # here by parts
            X = _after_local_iterations(source, target, warp)
            ends[f"{name}+local"] = _scored_alone(M, N, X)
        else:
            moved = N.moved_to(spectral_icp.move(N, warp))
            ends[name] = spectral_icp.registration_score(M, N, part, moved), moved
    method = _best_of(ends)
    score, moved = ends[method]
    if method != "intrinsic":
        match = match_surfaces(moved.X, moved.normals, M.X, M.normals)
    attrs |= {"initialisation": method, "score": score}
    return match, moved, attrs


def _best_of(ends):
    """The name of the end of registration that has the lowest score."""
    return min(ends, key=lambda name: ends[name][0])


def tear(moved: Basis, target: Basis) -> float:
    """How much the registered template is stretched or squeezed, where it is most.

    The |log| of the ratio of areas that a hundredth of its vertices exceeds.  Between a place on
    the right fold and one on the fold beside, the template is torn.
    """
    strain = np.abs(log_area_ratio(moved.X, target.X, target.T))
    return float(np.quantile(strain, 0.99))


def mends(end: tuple[float, Basis], torn: tuple[float, Basis], target: Basis) -> bool:
    """Whether an end is better than a torn one, in score and tear together (``_MENDED``).

    Score alone falls where a looser template follows noise, which tears it more.  The lower score
    decides among the ends that are left (``_best_of``).
    """
    before, after = (score * tear(moved, target) for score, moved in (torn, end))
    return after < _MENDED * before


def _scored_alone(source, target, X):
    """Score of the registered target, matched by what is nearest to it, and that target."""
    moved = target.moved_to(X)
    match = spectral_icp.nearest_vertices(source, moved)
    return spectral_icp.registration_score(source, target, match, moved), moved


def elastic_surfaces(
    source: Shape, target: Shape, starts: dict[str, spectral_icp.Warp], *, looser: bool = False
) -> dict[str, Array]:
    """The template ``(n_target, 3)`` after elastic iterations from several starts, and local ones.

    Starts that meet go on as one, see :func:`s4a.method.elastic.converging_initialisations`.  Where
    the end of that lies on a fold beside the one on which a start was right, iterations from the
    starts themselves that begin less stiff, `looser`, may end on the right one.
    """
    M, N, landmarks = source.full, target.low_on_surface, _common_landmarks(source, target)
    if not looser:
        starts = converging_initialisations(M, N, starts, landmarks)
    schedule = FOLLOWING._replace(stiffness=STIFFNESS[_LOOSER if looser else 0 :])
    surfaces = {}
    for name, start in starts.items():
        warp = elastic_iterations(M, N, start, schedule, landmarks=landmarks)
        surfaces[name] = _after_local_iterations(source, target, warp)
    return surfaces


def _common_landmarks(source, target):
    """The landmarks that both shapes have by name; None where there are none."""
    names, at_source = source.landmarks
    names_target, at_target = target.landmarks
    common = [name for name in names_target if name in names]
    if not common:
        return None
    B = at_target[[names_target.index(name) for name in common]]  # (l, n_target)
    y = at_source[[names.index(name) for name in common]] @ source.full.X
    N = target.full
    none = np.zeros((0, 3), int)
    return Landmarks(Basis(B @ N.X, none, B @ N.area, target.low.Phi, U=B @ target.U), y)


def _after_local_iterations(source: Shape, target: Shape, warp: spectral_icp.Warp) -> Array:
    """The template ``(n_target, 3)`` after a warp, by parts or not, and local iterations."""
    low, landmarks = target.low_on_surface, _common_landmarks(source, target)
    pull = landmarks and (
        landmarks[0].U,
        landmarks.y - spectral_icp.move(landmarks.on_target, warp),
    )
    d = local_iterations(
        source.full, low, target.diffusion, spectral_icp.move(low, warp), pull=pull
    )
    return spectral_icp.move(target.full, warp) + target.U @ d


def way_back(source: Basis, moved: Basis) -> tuple[Array, Array]:
    """For every vertex of the source the closest point of the registered template.

    The nearest template vertex in position and normal is looked up first, then the closest point on
    the triangles around it, so that the normals agree.

    Parameters
    ----------
    source : Basis
        At full resolution.
    moved : Basis
        The registered template, in the frame of the source.

    Returns
    -------
    triangle : int ndarray (n_source,)
    barycentric : float ndarray (n_source, 3)
    """
    nearest = moved.tree.query(source.tree.data)[1]
    return closest_point_in_star(source.X, nearest, moved.X, moved.T)


def round_trip(target: Shape, match: Array, triangle: Array, barycentric: Array) -> Array:
    """Length of the way template -> shape -> template ``(n_target,)``, as a share of sqrt(area)."""
    X = target.full.X
    corner = X[target.full.T[triangle[match]]]  # (n_target, 3 corners, 3)
    back = np.einsum("nc,ncx->nx", barycentric[match], corner)
    return np.linalg.norm(back - X, axis=1)


def log_area_ratio(image: Array, X: Array, T: Array) -> Array:
    """log(a / A) for every vertex ``(n,)``: its share of the area after and before registration.

    0 where nothing is stretched but the size as a whole.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.register import log_area_ratio
    >>> X, T = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    >>> (log_area_ratio(2 * X, X, T) + 0.0).tolist()
    [0.0, 0.0, 0.0]
    """
    after, before = (
        np.maximum(area / area.sum(), np.finfo(np.float32).tiny)
        for area in (vertex_areas(image, T), vertex_areas(X, T))
    )
    return np.log(after) - np.log(before)


def common_unit(*meshes: xr.Dataset) -> str:
    """The unit that all meshes say; "unit of the input" where they do not."""
    units = {mesh.attrs.get("unit") or INPUT for mesh in meshes}
    return units.pop() if len(units) == 1 else INPUT


def identity(template: Shape) -> xr.Dataset:
    """The template's own file of ``/registration``: every vertex matches itself, nothing moves."""
    X, T = as_arrays(template.original)
    # a corner of every vertex: the last in the order of the vertices
    last = np.cumsum(np.bincount(T.ravel(), minlength=len(X))) - 1
    corner = np.argsort(T.ravel(), kind="stable")[last]
    zero = np.zeros(X.shape, np.float32)
    low: dict[str, Array] = {}
    if template.coarse:
        n_low = template.coarse.sizes["vertex"]
        low["displacement_low"] = np.zeros((n_low, 3), np.float32)
        low["registered_match_low"] = np.arange(n_low, dtype=np.int32)
        if "eigenpair" in template.coarse.sizes:
            low["displacement_coefficient"] = np.zeros((template.coarse.sizes["eigenpair"], 3))
    registration = dataset(
        {"initialisation": "template", "score": 0.0},
        registered_match=np.arange(len(X), dtype=np.int32),
        displacement=zero,
        displacement_raw=zero,
        rotation=np.eye(3),
        translation=np.zeros(3),
        scale=np.array(1.0),
        icp_rotation=np.eye(3),
        icp_translation=np.zeros(3),
        confidence=np.ones(len(X), np.float32),
        round_trip=zero[:, 0],
        distortion=zero[:, 0],
        template_triangle=(corner // 3).astype(np.int32),
        template_barycentric=np.eye(3)[corner % 3],
        **low,
    )
    return in_unit(registration, common_unit(template.original))
