"""Spectral ICP: iterated smoothing of the displacement (4.2, eq. 8 and the line after it).

The match lives on the target N, the source M is searched.  An iteration moves N onto M with a
displacement in the first K eigenfunctions of N, then finds nearest neighbours in position, normal
and, with ``spectral``, spectral coordinates together; K grows as in ZoomOut.  Smooth Shells
(Eisenberger, Laehner, Cremers, CVPR 2020) couples both in this way.  If poses differ much, the
displacement is piecewise rigid first.  All lengths are for surfaces of unit area.

A *warp* (R, t, c) maps N to R x + t + Phi c, with one R (3, 3) and t (3,) for all of N, or one for
each vertex of low resolution; R is a rotation, after elastic iterations any linear map.
"""

from typing import NamedTuple

import numpy as np

from s4a.geometry.align import RigidTransform, rigid_transform
from s4a.geometry.closest import features
from s4a.geometry.mesh import path_lengths, vertex_normals
from s4a.method.deform import onto
from s4a.method.fmap import fmap_from_match
from s4a.method.nearest import nearest_rows
from s4a.method.shape import Basis, corresponding_landmarks
from s4a.method.spectral import project
from s4a.schema import Array

POSE_DISTANCE = 0.035  # 90 % quantile of distances above which poses differ, see `poses_differ`
N_TRIPS, LONGEST_TRIP = 300, 0.5  # samples of the round trip, and its largest error
MANY = 20_000  # vertices above which paths are searched locally
GOOD = 0.03  # score up to which no spectral coordinates are tried
# first and last weight of spectral coordinates in piecewise rigid iterations.  With few functions a
# hand moves with its arm, so consistent maps of a network, which are more accurate than those of a
# pair, count more at first (docs/decisions.md)
PAIR, NETWORK = (0.2, 0.2), (0.7, 0.2)

Warp = tuple[Array, Array, Array]


class Candidate(NamedTuple):
    """A registration at low resolution, and its score without ground truth (lower is better)."""

    score: float
    match: Array
    warp: Warp


def apply_transform(target: Basis, R: Array, t: Array) -> Array:
    """Return R x + t for every vertex ``(n, 3)``, with one R and t, or one per low vertex."""
    if R.ndim == 2:
        return target.X @ R.T + t
    R = R.reshape(-1, 9)
    if target.U is not None:
        R = target.U @ R  # (n, 9)
        t = target.U @ t  # (n, 3)
    return np.einsum("nij,nj->ni", R.reshape(-1, 3, 3), target.X) + t


def move(target: Basis, warp: Warp) -> Array:
    """Return the registered target R x + t + Phi c ``(n, 3)``."""
    R, t, c = warp
    return apply_transform(target, R, t) + target.field(c)


def nearest_vertices(source: Basis, moved: Basis) -> Array:
    """Nearest source vertices ``(s,)`` in position and normal to the registered target.

    For its vertices near coarse ones, at low resolution for all.
    """
    near = moved.near_coarse
    return source.tree.query(features(moved.X[near], moved.normals[near]))[1]


def fit_warp(source: Basis, target: Basis, match: Array) -> Warp:
    """Fit the warp of the target's vertices near coarse ones to their matches ``(s,)``."""
    rows = target.near_coarse
    return onto(target.X[rows], source.X[match], target.area[rows], target.coefficients)


def warp_after(
    source: Basis, target: Basis, match: Array, transform: RigidTransform, ratio: float
) -> Warp:
    """Fit the warp after a given transform: eq. 8 and the line after it.

    The source moves by ``ratio R x + t``; the displacement to its vertices that match the target's
    vertices near coarse ones ``(s,)`` is smoothed.  The warp is that of the target, the inverse.

    Parameters
    ----------
    source, target : Basis
    match : int ndarray (s,)
    transform : tuple (R, t)
        Rigid transform of the source onto the target, between their frames.
    ratio : float
        Size of the source divided by that of the target; 1 to remove size.
    """
    R, t = transform
    moved = ratio * source.X[match] @ R.T + t
    c = target.coefficients(moved - target.X[target.near_coarse])  # (k, 3)
    return R.T / ratio, -R.T @ t / ratio, c @ R / ratio


def coarse_spectral_icp(
    source: Basis,
    target: Basis,
    match: Array,
    *,
    k_initial: int = 30,
    k: int = 100,
    step: int = 5,
    iterations: int = 2,
    spectral: tuple[float, float] | None = None,
    articulated: bool = False,
) -> tuple[Array, Warp]:
    """Spectral ICP on low-resolution meshes, for K = k_initial, k_initial + step, ..., k.

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    match : int ndarray (n_target,)
        Initialisation, for example by ZoomOut.
    spectral : tuple of float, optional
        Spectral coordinates have the weight w / sqrt(K); w changes by equal factors, from the first
        value at the first K to the second at the last.  By default they are not used, and a KD-tree
        of 6 dimensions is searched.
    articulated : bool
        Whether the warp is piecewise rigid, see :func:`s4a.method.deform.rigid_parts`.

    Returns
    -------
    match : int ndarray (n_target,)
    warp : tuple (R, t, c)
    """
    k = min(k, target.k, source.k)
    sizes = [*range(min(k_initial, k), k, step), k]
    weights = np.zeros(len(sizes))
    if spectral is not None:
        weights = np.geomspace(*spectral, len(sizes)) / np.sqrt(sizes)
    for K, weight in zip(sizes, weights, strict=True):
        Phi = target.Phi[:, :K]
        spectrum = (target.mass, Phi, target.eigenvalue[:K]) if articulated else None

        def coefficients(d, Phi=Phi):
            return project(Phi, target.mass, d)  # (K, 3)

        for _ in range(iterations):
            warp = onto(target.X, source.X[match], target.area, coefficients, spectrum)
            X = move(target, warp)
            if not weight:
                match = nearest_vertices(source, target.moved_to(X))
                continue
            C = fmap_from_match(source.Phi[:, :K], Phi, target.mass, match)
            match = nearest_rows(
                features(X, vertex_normals(X, target.T), weight * Phi),
                features(source.X, source.normals, weight * source.Phi[:, :K] @ C.T),
            )
    return match, warp


def dense_spectral_icp(source: Basis, target: Basis, warp: Warp) -> tuple[Array, Warp]:
    """Spectral ICP at full resolution, on vertices near coarse ones; R and t of parts are fixed.

    Parameters
    ----------
    source, target : Basis
        At full resolution.
    warp : tuple (R, t, c)
        Result at low resolution.

    Returns
    -------
    match : int ndarray (s,)
    warp : tuple (R, t, c)
    """
    match = nearest_vertices(source, target.moved_to(move(target, warp)))
    R, t, _ = warp
    for _ in range(3):
        if R.ndim == 2:
            warp = fit_warp(source, target, match)
        else:
            warp = (
                R,
                t,
                target.coefficients(
                    source.X[match] - apply_transform(target, R, t)[target.near_coarse]
                ),
            )
        match = nearest_vertices(source, target.moved_to(move(target, warp)))
    return match, warp


def registration_score(source: Basis, target: Basis, match: Array, moved: Basis) -> float:
    """Score a registration without ground truth: round trip plus distances; lower is better.

    The round trip goes from a vertex of the target to its match and back to the vertex whose
    registered position and normal are nearest; its error is the path length along the edges of the
    target, at most 0.5.  The distances are the mean distances between registered target and
    source, in both directions, at the vertices near coarse ones, and ``_landmark_distance``.
    Lengths are for unit area.

    Stretch is not in the score: on heads and brains with known warps it favours the identity.

    Parameters
    ----------
    source, target : Basis
        At one resolution.
    match : int ndarray (s,)
        Matches of the target's vertices near coarse ones.
    moved : Basis
        The registered target, see :meth:`s4a.method.shape.Basis.moved_to`.
    """
    X, tree = moved.X, moved.tree
    rows = np.arange(len(X))[target.near_coarse]
    back = X[tree.query(source.tree.data[source.near_coarse])[1]]
    back_distance = np.linalg.norm(source.X[source.near_coarse] - back, axis=1)
    distance = np.linalg.norm(X[rows] - source.X[match], axis=1)
    n_samples = min(N_TRIPS, len(match))
    sample = target.outwards[np.linspace(0, len(match) - 1, n_samples).astype(int)]
    end = tree.query(source.tree.data[match[sample]])[1]
    near = target.X if len(X) > MANY else None
    trip = path_lengths(target.graph, rows[sample], end, LONGEST_TRIP, near)
    return float(
        trip.mean() + distance.mean() + back_distance.mean() + _landmark_distance(source, target, X)
    )


def _landmark_distance(source, target, X):
    """Mean distance of common landmarks, with the target's vertices at X; 0 without landmarks."""
    at_source, at_target = corresponding_landmarks(source, target)
    if len(at_source) == 0:
        return 0.0
    return float(np.linalg.norm(X[at_target] - source.X[at_source], axis=1).mean())


def poses_differ(source: Basis, target: Basis, match: Array) -> bool:
    """Return whether poses differ: the 90 % quantile of residuals after rigid alignment is large.

    The threshold is 0.035 plus 0.4 of the mean vertex spacing 1 / sqrt(n) of the source, 0.04 for
    6,000 vertices.  For nearest neighbours after ICP the quantile is 0.005 to 0.031 between faces,
    brains, heads or skulls, 0.025 to 0.046 between femurs or vertebrae, 0.044 to 0.23 between
    bodies, children or cats in different poses.
    """
    R, t, _ = rigid_transform(target.X, source.X[match], target.area)
    residual = np.linalg.norm(apply_transform(target, R, t) - source.X[match], axis=1)
    return bool(np.quantile(residual, 0.9) > POSE_DISTANCE + 0.4 / np.sqrt(len(source.X)))


def unrefined_candidates(
    source: Basis, target: Basis, matches: dict[str, Array]
) -> dict[str, Candidate]:
    """Return each initial match (n_target,) as a candidate, without iterations."""
    return {
        name: scored(source, target, match, fit_warp(source, target, match))
        for name, match in matches.items()
    }


def scored(source: Basis, target: Basis, match: Array, warp: Warp) -> Candidate:
    """Return a match and its warp as a candidate with its score."""
    score = registration_score(source, target, match, target.moved_to(move(target, warp)))
    return Candidate(score, match, warp)


def candidates(
    source: Basis,
    target: Basis,
    matches: dict[str, Array],
    *,
    k: int = 100,
    articulated: bool = True,
    spectral: tuple[float, float] = PAIR,
) -> dict[str, Candidate]:
    """Return candidates at low resolution: every initial match, before and after spectral ICP.

    The better match also initialises iterations with spectral coordinates: piecewise rigid ones if
    :func:`poses_differ` for all matches, else ordinary ones if all scores exceed :data:`GOOD`, as
    the shapes then differ much.

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    matches : dict
        Name -> match (n_target,).
    articulated : bool
        Whether to try piecewise rigid iterations.
    spectral : tuple of float
        First and last weight of spectral coordinates in these, see :func:`coarse_spectral_icp`.

    Returns
    -------
    dict
        ``"<name>"``, ``"<name>+joint"``, ``"<name>+joint+spectral"`` or ``"<name>+parts"`` ->
        :class:`Candidate`.
    """
    results = unrefined_candidates(source, target, matches)

    def add(name, match, warp):
        results[name] = scored(source, target, match, warp)

    for name, match in matches.items():
        add(f"{name}+joint", *coarse_spectral_icp(source, target, match, k=k))
    best = min(matches, key=lambda name: results[f"{name}+joint"].score)
    initial = source, target, matches[best]
    if articulated and all(poses_differ(source, target, match) for match in matches.values()):
        piecewise = coarse_spectral_icp(
            *initial, k_initial=20, k=k, iterations=1, spectral=spectral, articulated=True
        )
        add(f"{best}+parts", *piecewise)
    elif min(candidate.score for candidate in results.values()) > GOOD:
        add(f"{best}+joint+spectral", *coarse_spectral_icp(*initial, k=k, spectral=(0.1, 0.1)))
    return results


def finalists(candidates: dict[str, Candidate], *, margin: float) -> list[str]:
    """Return the names of at most two candidates with scores within `margin` of the best.

    Low-resolution scores contain the error of coarse sampling; close ones can only be ranked at
    full resolution.
    """
    scores = {name: candidate.score for name, candidate in candidates.items()}
    order = sorted(scores, key=lambda name: scores[name])[:2]
    return [name for name in order if scores[name] <= margin * scores[order[0]]]
