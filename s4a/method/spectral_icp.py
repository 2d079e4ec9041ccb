"""Joint iterations: the smoothing of the displacement (4.2, eq. 8 and the line after it), iterated.

The target N carries the match, the source M is searched.  A round moves N onto M with a
displacement that lives in the first K eigenfunctions of N, then asks for the nearest neighbours in
position, normal and, with ``spectral > 0``, spectrum together; K grows as in ZoomOut.  The idea of
coupling both is that of Smooth Shells (Eisenberger, Laehner, Cremers, CVPR 2020).  Where poses are
far apart, every part of N turns on its own before.  All lengths are for surfaces of unit area.

A *warp* (R, t, c) takes N to R x + t + Phi c, with one R (3, 3) and t (3,) for all of N, or one
for each vertex of low resolution; R is a rotation, after elastic iterations any linear map.
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

FAR = 0.035  # between shapes of one pose the tenth that is farthest lies nearer, see `far_apart`

Warp = tuple[Array, Array, Array]


class Candidate(NamedTuple):
    """A registration at low resolution, and its score without truth (lower is better)."""

    score: float
    match: Array
    warp: Warp


def turn(target: Basis, R: Array, t: Array) -> Array:
    """R x + t for every vertex ``(n, 3)``, with one R and t for all, or one a low vertex."""
    if R.ndim == 2:
        return target.X @ R.T + t
    R = R.reshape(-1, 9)
    if target.U is not None:
        R = target.U @ R  # (n, 9)
        t = target.U @ t  # (n, 3)
    return np.einsum("nij,nj->ni", R.reshape(-1, 3, 3), target.X) + t


def move(target: Basis, warp: Warp) -> Array:
    """The registered target R x + t + Phi c ``(n, 3)``."""
    R, t, c = warp
    return turn(target, R, t) + target.field(c)


def nearest_vertices(source: Basis, moved: Basis) -> Array:
    """The vertices ``(s,)`` of the source nearest in position and normal to the registered target.

    To its vertices near coarse ones, which at low resolution are all.
    """
    return source.tree.query(features(moved.X, moved.normals)[moved.near_coarse])[1]


def fit_warp(source: Basis, target: Basis, match: Array) -> Warp:
    """The warp that brings the target's vertices near coarse ones onto their matches ``(s,)``."""
    rows = target.near_coarse
    return onto(target.X[rows], source.X[match], target.area[rows], target.coefficients)


def warp_after(
    source: Basis, target: Basis, match: Array, transform: RigidTransform, ratio: float
) -> Warp:
    """The warp after a given transform instead of a fitted one: eq. 8 and the line after it.

    The source moves by ``ratio R x + t``; what is left to its vertices, matched by the target's
    vertices near coarse ones ``(s,)``, is smoothed.  The warp is that of the target, backwards.

    Parameters
    ----------
    source, target : Basis
    match : int ndarray (s,)
    transform : tuple (R, t)
        Rigid transform of the source onto the target, between their frames.
    ratio : float
        Size of the source by that of the target; 1 where it is to be taken out.
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
    k_first: int = 30,
    k: int = 100,
    step: int = 5,
    iterations: int = 2,
    spectral: float = 0.0,
    by_parts: bool = False,
) -> tuple[Array, Warp]:
    """Joint iterations on low-resolution meshes, for K = k_first, k_first + step, ..., k.

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    match : int ndarray (n_target,)
        Start, for example of ZoomOut.
    spectral : float
        The spectral coordinates weigh ``spectral / sqrt(K)``; 0 leaves 6 dimensions and a KD-tree.
        0.1 for poses that are far apart.
    by_parts : bool
        Whether every vertex turns with its surroundings, :func:`s4a.method.deform.rigid_parts`, as
        limbs do.

    Returns
    -------
    match : int ndarray (n_target,)
    warp : tuple (R, t, c)
    """
    k = min(k, target.k, source.k)
    for K in [*range(min(k_first, k), k, step), k]:
        Phi = target.Phi[:, :K]
        spectrum = (target.mass, Phi, target.eigenvalue[:K]) if by_parts else None

        def coefficients(d, Phi=Phi):
            return project(Phi, target.mass, d)  # (K, 3)

        for _ in range(iterations):
            warp = onto(target.X, source.X[match], target.area, coefficients, spectrum)
            X = move(target, warp)
            if not spectral:
                match = nearest_vertices(source, target.moved_to(X))
                continue
            weight = spectral / np.sqrt(K)
            C = fmap_from_match(source.Phi[:, :K], Phi, target.mass, match)
            match = nearest_rows(
                features(X, vertex_normals(X, target.T), weight * Phi),
                features(source.X, source.normals, weight * source.Phi[:, :K] @ C.T),
            )
    return match, warp


def dense_spectral_icp(
    source: Basis, target: Basis, warp: Warp, *, iterations: int = 3
) -> tuple[Array, Warp]:
    """Joint iterations at full resolution, on vertices near coarse ones; transforms of parts stay.

    Parameters
    ----------
    source, target : Basis
        At full resolution.
    warp : tuple (R, t, c)
        The end of the low iterations.

    Returns
    -------
    match : int ndarray (s,)
    warp : tuple (R, t, c)
    """
    match = nearest_vertices(source, target.moved_to(move(target, warp)))
    R, t, _ = warp
    for _ in range(iterations):
        if R.ndim == 2:
            warp = fit_warp(source, target, match)
        else:
            warp = (
                R,
                t,
                target.coefficients(source.X[match] - turn(target, R, t)[target.near_coarse]),
            )
        match = nearest_vertices(source, target.moved_to(move(target, warp)))
    return match, warp


def registration_score(
    source: Basis,
    target: Basis,
    match: Array,
    moved: Basis,
    *,
    n_samples: int = 300,
    limit: float = 0.5,
) -> float:
    """Score of a registration without truth, lower is better: round trip + gaps, both ways.

    The round trip goes from a vertex of the target to its match and back to the vertex whose
    registered position (in position and normal) is nearest, measured along the edges of the target
    and cut at `limit`; the gaps are the mean distances of the registered target and the source, at
    the vertices near coarse ones of each; to them comes ``_landmark_distance``.  Lengths are for
    unit area.

    Stretch of edges is left out: on heads and brains with known warps it prefers maps that move
    nothing.

    Parameters
    ----------
    source, target : Basis
        At one resolution.
    match : int ndarray (s,)
        For the target's vertices near coarse ones.
    moved : Basis
        The registered target, see :meth:`s4a.method.shape.Basis.moved_to`.
    """
    X, tree = moved.X, moved.tree
    rows = np.arange(len(X))[target.near_coarse]
    back = X[tree.query(source.tree.data[source.near_coarse])[1]]
    back_distance = np.linalg.norm(source.X[source.near_coarse] - back, axis=1)
    gap = np.linalg.norm(X[rows] - source.X[match], axis=1)
    n_samples = min(n_samples, len(match))
    sample = target.outwards[np.linspace(0, len(match) - 1, n_samples).astype(int)]
    end = tree.query(source.tree.data[match[sample]])[1]
    trip = path_lengths(target.graph, rows[sample], end, limit)
    return float(
        trip.mean() + gap.mean() + back_distance.mean() + _landmark_distance(source, target, X)
    )


def _landmark_distance(source, target, X):
    """Mean distance of the landmarks that both have, the target's vertices at X; 0 without any."""
    at_source, at_target = corresponding_landmarks(source, target)
    if len(at_source) == 0:
        return 0.0
    return float(np.linalg.norm(X[at_target] - source.X[at_source], axis=1).mean())


def far_apart(source: Basis, target: Basis, match: Array) -> bool:
    """Whether poses differ: a tenth of the target lies far from its match after a rigid transform.

    Far is 0.035 and 0.4 of the mean spacing 1 / sqrt(n) of the source's vertices, which alone keeps
    matches apart: 0.04 for 6,000.  For nearest neighbours after ICP that tenth lies 0.005 to 0.031
    away between faces, brains, heads or skulls, 0.025 to 0.046 between femurs or vertebrae, 0.044
    to 0.23 between bodies, children or cats in other poses.
    """
    R, t, _ = rigid_transform(target.X, source.X[match], target.area)
    gap = np.linalg.norm(turn(target, R, t) - source.X[match], axis=1)
    return bool(np.quantile(gap, 0.9) > FAR + 0.4 / np.sqrt(len(source.X)))


def as_given(source: Basis, target: Basis, starts: dict[str, Array]) -> dict[str, Candidate]:
    """Registrations at low resolution: every start (n_target,) as it is, with its score."""
    return {
        name: scored(source, target, match, fit_warp(source, target, match))
        for name, match in starts.items()
    }


def scored(source: Basis, target: Basis, match: Array, warp: Warp) -> Candidate:
    """A registration with its score."""
    score = registration_score(source, target, match, target.moved_to(move(target, warp)))
    return Candidate(score, match, warp)


def candidates(
    source: Basis,
    target: Basis,
    starts: dict[str, Array],
    *,
    k: int = 100,
    far: float = 0.03,
    articulated: bool = True,
) -> dict[str, Candidate]:
    """Registrations at low resolution: every start as it is, and after joint iterations.

    From the better start more iterations, with spectral coordinates, are tried: by parts where all
    starts say that the poses are :func:`far_apart`, else in one piece where the best of these still
    scores above `far`, as the shapes then differ much.

    Parameters
    ----------
    source, target : Basis
        At low resolution.
    starts : dict
        Name -> match (n_target,).
    articulated : bool
        Whether to try iterations by parts.

    Returns
    -------
    dict
        ``"<start>"``, ``"<start>+joint"``, ``"<start>+joint+spectral"`` or ``"<start>+parts"`` ->
        :class:`Candidate`.
    """
    tried = as_given(source, target, starts)

    def enter(name, match, warp):
        tried[name] = scored(source, target, match, warp)

    for name, match in starts.items():
        enter(f"{name}+joint", *coarse_spectral_icp(source, target, match, k=k))
    best = min(starts, key=lambda name: tried[f"{name}+joint"].score)
    if articulated and all(far_apart(source, target, match) for match in starts.values()):
        end = coarse_spectral_icp(
            source, target, starts[best], k_first=20, k=k, iterations=1, spectral=0.2, by_parts=True
        )
        enter(f"{best}+parts", *end)
    elif min(candidate.score for candidate in tried.values()) > far:
        end = coarse_spectral_icp(source, target, starts[best], k=k, spectral=0.1)
        enter(f"{best}+joint+spectral", *end)
    return tried


def finalists(tried: dict[str, Candidate], *, margin: float) -> list[str]:
    """Names of the candidates whose score is within `margin` of the least, at most two, best first.

    Scores at low resolution have the coarse sampling in them; near ones can only be told apart at
    full resolution.
    """
    order = sorted(tried, key=lambda name: tried[name].score)[:2]
    return [name for name in order if tried[name].score <= margin * tried[order[0]].score]
