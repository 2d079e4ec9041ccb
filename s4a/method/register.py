"""Registration of one shape and the template at full resolution (4.2; eq. 3, 4, 6, 7, 8).

The source is the shape M_i, the target the template, in the paper the median shape.  A match holds,
at every vertex of the template, a vertex of the shape.
"""

from typing import Any

import numpy as np
import xarray as xr

from s4a.geometry import mesh as surface
from s4a.geometry.align import RigidTransform
from s4a.geometry.closest import closest_point_in_star, interpolate, match_surfaces
from s4a.geometry.mesh import as_arrays, norms, triangle_areas, vertex_areas
from s4a.method import spectral_icp
from s4a.method.deform import displacement_in_template, distortion
from s4a.method.elastic import (
    DEFORMATION,
    NO_SLIDING,
    STIFFNESS,
    Landmarks,
    converging_initialisations,
    elastic_iterations,
    local_iterations,
    slides,
)
from s4a.method.fmap import fmap_from_match
from s4a.method.initial_map import nearest_after_alignment
from s4a.method.nearest import nearest_in_cells, nearest_of_few, nearest_rows
from s4a.method.network import in_threads
from s4a.method.shape import Basis, Shape
from s4a.options import check
from s4a.schema import INPUT, Array, dataset, in_unit

RADIUS = 0.01  # share of sqrt(area): a match with a smaller error counts as correct
OFFSET = 1e-4  # added to distance and stretch, whose smaller values are mesh noise
# intercept, and weights of the logarithms of distance and stretch: docs/decisions.md
WEIGHTS = (-12.06, -1.46, -1.58)


def stretch(X: Array, image: Array, T: Array) -> Array:
    """Return the stretch of the triangles around every vertex under a map ``(n,)``.

    The area-weighted root mean square of sqrt(log(s1)^2 + log(s2)^2), where s1 and s2 are the
    singular values of a triangle's linear map.

    Parameters
    ----------
    X, image : float ndarray (n, 3)
        Vertices, and their images.
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
    squared = np.minimum(np.where(np.isnan(squared), 0.0, squared), 100.0)  # degenerate, collapsed
    sums = surface.sums_at_vertices(T, np.stack([before * squared, before], axis=1), len(X))
    return np.sqrt(sums[:, 0] / np.maximum(sums[:, 1], np.finfo(float).tiny))


def confidence_features(source: Shape, target: Shape, match: Array, P: Array) -> Array:
    """Return the logarithms of distance and stretch, smoothed on the template ``(n_target, 2)``.

    Parameters
    ----------
    source, target : Shape
        The shape and the template.
    match : int ndarray (n_target,)
        Vertex of the shape close to each vertex of the template.
    P : float ndarray (n_target, 3)
        The registered template, in the frame of the shape.
    """
    X, T, near = target.full.X, target.full.T, target.near_coarse  # enough for smooth fields
    Y, S = source.full.X, source.full.T
    triangle, weights = closest_point_in_star(P[near], match[near], Y, S, source.full.stars)
    distance = np.linalg.norm(P[near] - interpolate(Y, S, triangle, weights), axis=1)
    is_near = np.zeros(len(X), bool)
    is_near[near] = True
    around = T[is_near[T].any(axis=1)]
    features = np.log(np.stack([distance, stretch(X, P, around)[near]], axis=1) + OFFSET)
    return target.full.field(target.full.coefficients(features))


def confidence(source: Shape, target: Shape, match: Array, P: Array) -> Array:
    """Estimate the probability of an error below 1 % of sqrt(area) at every vertex ``(n_target,)``.

    Parameters
    ----------
    source, target, match, P : see :func:`confidence_features`
    """
    w_0, *w = WEIGHTS
    logit = w_0 + confidence_features(source, target, match, P) @ np.array(w)
    return 1 / (1 + np.exp(np.clip(-logit, -50, 50)))


def uncertainty(confidence: Array) -> Array:
    """Root mean squared error of matches of a given confidence, as a share of sqrt(area).

    A confidence is the share of such vertices with an error below 1 % of sqrt(area).  For errors
    that are Gaussian in the plane with root mean square r it is 1 - exp(-0.01^2 / r^2).

    Parameters
    ----------
    confidence : ndarray (p,)
        Values below 0.1 count as 0.1, an error of 3 %.

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
    return RADIUS / np.sqrt(-np.log1p(-np.clip(confidence, 0.1, 1 - 1e-6)))


# 99 % quantile of the |log| area ratio above which part of the template may lie on a wrong fold
MAX_STRAIN = 0.65
FEW = 2000  # with fewer low-resolution vertices the strain is smoothed
_STRAIN_REDUCTION = 0.3  # share of MAX_STRAIN by which the limit is lower then
_LESS_STIFF_STEP = 4  # first step of the less stiff elastic iterations
# largest remaining share of score times strain after less stiff iterations.  They leave 0.3 to 0.72
# if they find the right fold, 0.81 or more on real heads (docs/decisions.md)
_MAX_REMAINING = 0.75

Functions = tuple[Array, Array]  # functions of source and target, whose rows are compared


def match_low(
    source: Shape, target: Shape, bases: Functions, *, dense_match: str = "latent"
) -> tuple[Array, Functions]:
    """Match at low resolution (eq. 6), and return the functions for the full-resolution match.

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
        At all vertices if the shapes have refined eigenfunctions.
    """
    check("dense_match", dense_match)
    Y_source, Y_target = bases  # (k, m) each
    k = len(Y_source)
    Phi, Psi = source.low.Phi[:, :k], target.low.Phi[:, :k]
    match = nearest_rows(Psi @ Y_target, Phi @ Y_source)  # eq. 6
    if dense_match == "latent":
        return match, latent_functions(source, target, bases)
    C = fmap_from_match(Phi, Psi, target.low.mass, match)  # eq. 3, for eq. 4
    return match, (source.functions(C.T), target.functions(np.eye(k)))


def latent_functions(source: Shape, target: Shape, bases: Functions) -> Functions:
    """Return the latent functions Phi Y of both shapes, whose rows eq. 7 compares."""
    Y_source, Y_target = bases
    return source.functions(Y_source), target.functions(Y_target)


def match_functions(
    source: Shape, target: Shape, F_source: Array, F_target: Array
) -> tuple[Array, float, float]:
    """Match at full resolution by nearest rows of U F: eq. 7 with F = Phi Y, eq. 4 with Phi C^T.

    Functions with a row for every original vertex are used directly.

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
    """Refine a map by a ZoomOut iteration that searches all vertices of the source.

    ZoomOut on the coarse meshes matches coarse vertices only.  Its C has noise of half the vertex
    spacing, which this iteration removes.

    Parameters
    ----------
    source, target : Shape
    C : float ndarray (k_target, k_source)
    B : float ndarray (n_source, >= k_source), optional
        Functions of the source at all vertices; U Phi by default.

    Returns
    -------
    C : float ndarray (k_target, k_source)
    """
    k_target, k_source = C.shape
    Phi, Psi = source.low.Phi[:, :k_source], target.low.Phi[:, :k_target]
    if B is None:  # U Phi is not formed: 0.4 GB for a million vertices
        match = nearest_of_few(Psi, source.full.extend(Phi @ C.T), source.cell)
        matched = source.U[match] @ Phi
    else:
        match = nearest_of_few(Psi, B[:, :k_source] @ C.T.astype(B.dtype), source.cell)
        matched = B[match, :k_source]
    return fmap_from_match(matched, Psi, target.low.mass, np.arange(len(match)))


def from_latent(
    source: Shape,
    target: Shape,
    bases: Functions,
    transform: RigidTransform,
    *,
    dense_match: str = "latent",
    **options: Any,
) -> xr.Dataset:
    """Register one shape by the latent bases of a network (eq. 6, 7 and 8).

    Eq. 6 and ICP give two initialisations.  Elastic iterations refine both, and the result with the
    lower score is returned.  With ``refine="intrinsic"``, as in the paper, or if that candidate is
    the best, the match at full resolution is that of eq. 7, or of eq. 3 and 4.  Eq. 8 follows.

    Parameters
    ----------
    source, target : Shape
        The shape and the template.
    bases : tuple of float ndarray (k, m)
        Consistent latent bases Y of both.
    transform : tuple (R, t)
        Rigid transform of the shape onto the template (4.1, step 2), between their frames.
    dense_match : {"latent", "fmap"}
        Eq. 7, or eq. 3 and 4.
    **options
        Options of :func:`register`.

    Returns
    -------
    xarray.Dataset
        Registration, see :func:`register`.
    """
    match, functions = match_low(source, target, bases, dense_match=dense_match)
    by_icp = nearest_after_alignment(source.low, target.low, transform)
    matches = {"intrinsic": match, "icp": by_icp}
    options |= {"k": len(bases[0]), "spectral": spectral_icp.NETWORK}
    return register(source, target, matches, functions, transform, **options)


def register(
    source: Shape,
    target: Shape,
    matches: dict[str, Array],
    functions: Functions,
    transform: RigidTransform,
    *,
    k: int = 100,
    refine: str = "elastic",
    remove_size: bool = False,
    articulated: bool = True,
    spectral: tuple[float, float] = spectral_icp.PAIR,
    displacement_alignment: str = "fitted",
) -> xr.Dataset:
    """Register one shape to the template at full resolution.

    Parameters
    ----------
    source, target : Shape
        The shape and the template.
    matches : dict
        Name -> match (n_coarse_target,): initialisations at low resolution, one of them
        "intrinsic".
    functions : tuple (F_source, F_target)
        Functions on both coarse meshes for the match at full resolution, see
        :func:`match_functions`.
    transform : tuple (R, t)
        Rigid transform of the shape onto the template found by ICP, between their frames.
    k : int
        Number of eigenfunctions of the displacement.
    refine : {"elastic", "spectral_icp", "intrinsic"}
        Elastic and local iterations, after spectral ICP if poses differ; spectral ICP; or the
        spectral match alone.  After local iterations the displacement exceeds the first k
        functions; ``displacement_coefficient`` is its projection onto them.
    remove_size : bool
        Whether to remove size from the displacement.
    articulated : bool
        Whether spectral ICP may be piecewise rigid if poses differ.
    spectral : tuple of float
        First and last weight of spectral coordinates in the piecewise rigid iterations, see
        :func:`s4a.method.spectral_icp.coarse_spectral_icp`.
    displacement_alignment : {"fitted", "initial"}
        Measure the displacement after the rigid transform that fits the registered surface best, or
        after the initial one as in the paper; then eq. 8 and (U Phi)(U Phi)^+ hold as printed.

    Returns
    -------
    xarray.Dataset
        ``registered_match(vertex)``, ``displacement(vertex, xyz)``, ``displacement_raw``;
        ``registered_match_low(low_vertex)``, the match "intrinsic" (eq. 6, or ZoomOut if a pair is
        matched without a network), and its ``displacement_low(low_vertex, xyz)``;
        ``displacement_coefficient(eigenpair, xyz)`` in U Phi of the template; ``icp_rotation``,
        ``icp_translation`` as given; ``rotation``, ``translation``, ``scale``,
        ``confidence(vertex)``, ``round_trip``, ``distortion``;
        ``template_triangle(original_vertex)``, ``template_barycentric``.  Displacements are in the
        unit of the input, in the frame of the template.  Attributes: ``initialisation``, the
        candidate with the best ``score`` at full resolution, and ``score_<candidate>`` at low
        resolution.
    """
    check("displacement_alignment", displacement_alignment)
    candidates = find_candidates(
        source, target, matches, k=k, refine=refine, articulated=articulated, spectral=spectral
    )
    by_icp = None
    if displacement_alignment == "initial":
        by_icp = _transform_in_unit(source, target, transform, remove_size)
    # image = R x + t + U Phi c, smoothed by the line after eq. 8 or by elastic iterations
    fixed, elastic = by_icp and (transform, by_icp[3]), refine == "elastic"
    match, moved, attrs = register_surface(
        source, target, candidates, functions, fixed, elastic=elastic
    )
    image = source.from_frame(moved.X)
    triangle, barycentric = closest_on_template(source.full, moved)
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
    low = s * source.coarse["position"].values[matches["intrinsic"]] @ R.T + t - X_low
    coefficient = target.full.coefficients(displacement[target.near_coarse])  # (k, 3)
    trip = round_trip(target, match, triangle, barycentric)
    probability = confidence(source, target, match, moved.X)
    registration = dataset(
        attrs,
        registered_match=match.astype(np.int32),
        displacement=displacement.astype(np.float32),
        displacement_raw=raw.astype(np.float32),
        registered_match_low=matches["intrinsic"].astype(np.int32),
        displacement_low=low.astype(np.float32),
        displacement_coefficient=coefficient,
        rotation=R,
        translation=t,
        scale=np.array(s),
        icp_rotation=transform[0],
        icp_translation=transform[1],
        confidence=probability.astype(np.float32),
        round_trip=trip.astype(np.float32),
        distortion=log_area_ratio(image, X, T).astype(np.float32),
        template_triangle=triangle.astype(np.int32),
        template_barycentric=barycentric,
    )
    if not np.isfinite(registration["displacement"]).all():
        raise ValueError("the displacement is not finite: check the coordinates of the shape")
    return in_unit(registration, common_unit(source.original, target.original))


def _transform_in_unit(
    source: Shape, target: Shape, transform: RigidTransform, remove_size: bool
) -> tuple[Array, Array, float, float]:
    """Convert a rigid transform between frames to the unit of the files: R, t, s, ratio of sizes.

    Without `remove_size` both shapes keep their size: s is 1.
    """
    (center, size), (center_target, size_target) = source.frame, target.frame
    R, t = transform
    s = size_target / size if remove_size else 1.0
    return R, center_target + size_target * t - s * R @ center, s, s * size / size_target


def find_candidates(
    source: Shape,
    target: Shape,
    matches: dict[str, Array],
    *,
    k: int = 100,
    refine: str = "elastic",
    articulated: bool = True,
    spectral: tuple[float, float] = spectral_icp.PAIR,
) -> dict[str, spectral_icp.Candidate]:
    """Return the low-resolution candidates to initialise full resolution, with their scores.

    Elastic iterations converge to the same registration from eq. 6, from ICP and from spectral ICP
    after either (docs/decisions.md).  Spectral ICP is used only if poses differ.

    Parameters
    ----------
    source, target, matches, k, refine, articulated, spectral : see :func:`register`

    Returns
    -------
    dict
        Name -> :class:`s4a.method.spectral_icp.Candidate`; empty for the spectral match alone.
    """
    check("refine", refine)
    if refine == "intrinsic":
        return {}
    M, N = source.low, target.low
    if refine == "spectral_icp" or all(
        spectral_icp.poses_differ(M, N, match) for match in matches.values()
    ):
        return spectral_icp.candidates(
            M, N, matches, k=k, articulated=articulated, spectral=spectral
        )
    return spectral_icp.unrefined_candidates(M, N, matches)


def register_surface(
    source: Shape,
    target: Shape,
    candidates: dict[str, spectral_icp.Candidate],
    functions: Functions,
    fixed: tuple[RigidTransform, float] | None = None,
    *,
    elastic: bool = False,
) -> tuple[Array, Basis, dict[str, Any]]:
    """Register the template at full resolution: the best of the low-resolution finalists.

    Parameters
    ----------
    source, target : Shape
    candidates : dict
        Candidates of :func:`find_candidates`; empty for the spectral match alone.
    functions : see :func:`register`
    fixed : tuple (transform, ratio), optional
        Transform after which the displacement of the spectral match is smoothed, see
        :func:`s4a.method.spectral_icp.warp_after`; by default the transform of best fit.
    elastic : bool
        Whether to refine finalists by :func:`elastic_surfaces`, again with less stiffness if the
        strain of the best result is too large (:func:`strain_quantile`).  Piecewise rigid
        finalists get local iterations only, which were more accurate on bodies.

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
    results: dict[str, tuple[float, Basis]] = {}
    # unrefined candidates predict the final score less well
    margin = 2.0 if elastic else 1.25
    names = spectral_icp.finalists(candidates, margin=margin) if candidates else ["intrinsic"]
    if elastic:
        warps = {n: candidates[n].warp for n in names if candidates[n].warp[0].ndim == 2}
        names = [name for name in names if name not in warps]  # piecewise rigid
        results = _elastic_result(source, target, warps) if warps else {}
    for name in names:
        if name == "intrinsic":
            match, compared, certified = match_functions(source, target, *functions)
            attrs |= {"compared_share": compared, "certified_share": certified}
            match_near = match[N.near_coarse]
            warp = (
                spectral_icp.warp_after(M, N, match_near, *fixed)
                if fixed
                else spectral_icp.fit_warp(M, N, match_near)
            )
        else:
            match_near, warp = spectral_icp.dense_spectral_icp(M, N, candidates[name].warp)
        if elastic:  # the piecewise rigid candidates
            X = _after_local_iterations(source, target, warp)
            results[f"{name}+local"] = _score_nearest(M, N, X)
        else:
            moved = N.moved_to(spectral_icp.move(N, warp))
            results[name] = spectral_icp.registration_score(M, N, match_near, moved), moved
    results = _lowest_score(results)
    ((best, (score, moved)),) = results.items()
    if best != "intrinsic":
        match = match_surfaces(moved.X, moved.normals, M.X, M.normals, moved.order, M.order)
    attrs |= {"initialisation": best, "score": score}
    return match, moved, attrs


def _lowest_score(results):
    """Result with the lowest score, by its name; others can be freed."""
    best = min(results, key=lambda name: results[name][0])
    return {best: results[best]}


def _elastic_result(source, target, warps):
    """Score and registered target of elastic iterations, less stiff ones if its strain is large."""
    N = target.full
    results = _lowest_score(_scored(source.full, N, elastic_surfaces(source, target, warps)))
    (strained,) = results.values()
    limit = MAX_STRAIN * (1 - _STRAIN_REDUCTION if len(target.low.X) < FEW else 1)
    if strain_quantile(strained[1], N) > limit:
        surfaces = elastic_surfaces(source, target, warps, less_stiff=True)
        scored = _scored(source.full, N, surfaces, "looser")
        results |= {name: r for name, r in scored.items() if improves(r, strained, N)}
    return _lowest_score(results)


def strain_quantile(moved: Basis, target: Basis) -> float:
    """Return the 99 % quantile of the |log| area ratio of the registered template.

    The strain is large where neighbouring vertices are registered to different folds.
    """
    strain = np.abs(moved.log_area_shares - target.log_area_shares)
    return float(np.quantile(strain, 0.99))


def improves(result: tuple[float, Basis], strained: tuple[float, Basis], target: Basis) -> bool:
    """Return whether a result is better than a strained one, by score times strain.

    The score alone also falls if a less stiff template follows noise, but its strain grows then.
    """
    before, after = (score * strain_quantile(moved, target) for score, moved in (strained, result))
    return after < _MAX_REMAINING * before


def _scored(source, target, surfaces, step="elastic"):
    """Score and registered target of each surface, by the name of its initialisation and step."""
    scored = in_threads(lambda X: _score_nearest(source, target, X), surfaces.values())
    return dict(zip([f"{name}+{step}" for name in surfaces], scored, strict=True))


def _score_nearest(source, target, X):
    """Score of the registered target, matched by nearest vertices, and the registered target."""
    moved = target.moved_to(X)
    match = spectral_icp.nearest_vertices(source, moved)
    return spectral_icp.registration_score(source, target, match, moved), moved


def elastic_surfaces(
    source: Shape, target: Shape, warps: dict[str, spectral_icp.Warp], *, less_stiff: bool = False
) -> dict[str, Array]:
    """Return the template ``(n_target, 3)`` after elastic and local iterations, by initialisation.

    Of initialisations that converge one is kept, see
    :func:`s4a.method.elastic.converging_initialisations`.  If it ends on a wrong fold, less stiff
    iterations from all initialisations, `less_stiff`, may find the right one.  All are kept, too,
    if the surface slides in the very stiff iterations, see :func:`s4a.method.elastic.slides`.
    """
    M, N, landmarks = source.full, target.low_on_surface, _common_landmarks(source, target)
    schedule = DEFORMATION
    if less_stiff:
        schedule = DEFORMATION._replace(stiffness=STIFFNESS[_LESS_STIFF_STEP:])
    elif warps:
        converged = converging_initialisations(M, N, warps, landmarks)
        if slides(N, warps, converged):
            schedule = NO_SLIDING
        else:
            warps = converged

    def surface(initial):
        warp = elastic_iterations(M, N, initial, schedule, landmarks=landmarks)
        return _after_local_iterations(source, target, warp)

    return dict(zip(warps, in_threads(surface, warps.values()), strict=True))


def _common_landmarks(source, target):
    """Landmarks of the same name on both shapes, or None."""
    names, at_source = source.landmarks
    names_target, at_target = target.landmarks
    common = [name for name in names_target if name in names]
    if not common:
        return None
    B = at_target[[names_target.index(name) for name in common]]  # (l, n_target)
    y = at_source[[names.index(name) for name in common]] @ source.full.X
    N = target.full
    no_triangles = np.zeros((0, 3), int)
    return Landmarks(Basis(B @ N.X, no_triangles, B @ N.area, target.low.Phi, U=B @ target.U), y)


def _after_local_iterations(source: Shape, target: Shape, warp: spectral_icp.Warp) -> Array:
    """Return the template ``(n_target, 3)`` after a warp and local iterations."""
    low, landmarks = target.low_on_surface, _common_landmarks(source, target)
    residuals = landmarks and (
        landmarks[0].U,
        landmarks.y - spectral_icp.move(landmarks.on_target, warp),
    )
    d = local_iterations(
        source.full, low, target.diffusion, spectral_icp.move(low, warp), landmarks=residuals
    )
    return spectral_icp.move(target.full, warp) + target.U @ d


def closest_on_template(source: Basis, moved: Basis) -> tuple[Array, Array]:
    """Return the closest point of the registered template to every vertex of the source.

    It lies on a triangle around the template vertex that is nearest in position and normal, so that
    the normals agree.

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
    nearest = moved.tree.query(source.tree.data, source.order)[1]
    return closest_point_in_star(source.X, nearest, moved.X, moved.T)


def round_trip(target: Shape, match: Array, triangle: Array, barycentric: Array) -> Array:
    """Distance after template -> shape -> template ``(n_target,)``, as a share of sqrt(area)."""
    X, T = target.full.X, target.full.T
    back = interpolate(X, T, triangle[match], barycentric[match])
    return norms(back - X)


def log_area_ratio(image: Array, X: Array, T: Array) -> Array:
    """log(a / A) at every vertex ``(n,)``, with its area share after and before registration.

    0 if the surface is only scaled as a whole.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.register import log_area_ratio
    >>> X, T = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    >>> (log_area_ratio(2 * X, X, T) + 0.0).tolist()
    [0.0, 0.0, 0.0]
    """
    return surface.log_shares(vertex_areas(image, T)) - surface.log_shares(vertex_areas(X, T))


def common_unit(*meshes: xr.Dataset) -> str:
    """Return the unit of all meshes, or "unit of the input" if they differ or have none."""
    units = {mesh.attrs.get("unit") or INPUT for mesh in meshes}
    return units.pop() if len(units) == 1 else INPUT


def identity(template: Shape) -> xr.Dataset:
    """Return the registration of the template to itself: the identity, without displacement."""
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
