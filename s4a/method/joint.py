"""Joint refinement of a match: the paper's own smoothing (eq. 8 and the line after it), iterated.

The target N carries the match, the source M is searched.  A round moves N onto M with a
displacement that lives in the first K eigenfunctions of N, then asks for the nearest neighbours in
position, normal and, with ``spectral > 0``, spectrum together; K grows as in ZoomOut.  The idea of
coupling both is that of Smooth Shells (Eisenberger, Laehner, Cremers, CVPR 2020).  Where poses are
far apart, every part of N turns on its own before.  All lengths are for surfaces of unit area.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from s4a.geometry.align import rigid_transform
from s4a.geometry.closest import feature_tree, features
from s4a.geometry.mesh import edge_graph, edges, path_lengths, vertex_normals
from s4a.method.deform import onto, smoother
from s4a.method.fmap import fmap_from_match, nearest_rows

FAR = 0.035


@dataclass(frozen=True)
class Surface:
    """What the rounds need of a shape, for unit area.

    ``X (n, 3)`` positions, ``T (m, 3)`` triangles, ``area (n,)`` of sum 1, ``Phi (n_coarse, k)``
    area-orthonormal eigenfunctions at low resolution; at full resolution with ``U (n, n_coarse)``,
    whose product with Phi is the basis, and is never formed; ``some (s,)`` the vertices that rounds
    look at, all by default; ``eigenvalue (k,)``, which only rounds by parts need.
    """

    X: np.ndarray
    T: np.ndarray
    area: np.ndarray
    Phi: np.ndarray
    U: object = None
    some: object = field(default_factory=lambda: slice(None))
    eigenvalue: object = None

    @cached_property
    def tree(self):
        """KD-tree over position and normal, 6 dims."""
        return feature_tree(self.X, self.T)

    @cached_property
    def outwards(self):
        """Rows of ``some`` by the distance from the centre.

        An order that pose and numbering leave as it is.
        """
        return np.argsort(((self.X[self.some] - self.area @ self.X) ** 2).sum(1), kind="stable")

    @cached_property
    def smooth(self):
        """Coefficients, in the basis, of a field given at ``some``."""
        return smoother(
            self.Phi, self.area[self.some], self.U if self.U is None else self.U[self.some]
        )

    def field(self, c):
        """The field ``(n, 3)`` with coefficients c in the first columns of the basis."""
        low = self.Phi[:, : len(c)] @ c
        return low if self.U is None else self.U @ low

    @cached_property
    def graph(self):
        """Edge lengths as a sparse matrix."""
        return edge_graph(self.X, edges(self.T))


def turned(target, R, t):
    """R x + t ``(n, 3)``, with one R (3, 3) and t (3,), or R (n_coarse, 3, 3) and t (n_coarse.

    3).
    """
    if R.ndim == 2:
        return target.X @ R.T + t
    R, t = (v if target.U is None else target.U @ v for v in (R.reshape(-1, 9), t))
    return np.einsum("nij,nj->ni", R.reshape(-1, 3, 3), target.X) + t


def registered(target, motion):
    """The registered shape R x + t + Phi c ``(n, 3)`` of a target.

    C for the first columns of its basis.
    """
    R, t, c = motion
    return turned(target, R, t) + target.field(c)


def search(source, target, X, some=slice(None)):
    """The vertices of the source nearest to (some of) the registered target X in position and normal."""
    return source.tree.query(features(X, vertex_normals(X, target.T))[some])[1]


def fitted(source, target, match):
    """The motion (R, t, c) that brings ``some`` of the target's vertices onto their matches ``(s,)``."""
    return onto(target.X[target.some], source.X[match], target.area[target.some], target.smooth)


def low_rounds(
    source, target, match, *, k_first=30, k=100, step=5, rounds=2, spectral=0.0, by_parts=False
):
    """Joint rounds on low-resolution meshes, for K = k_first, k_first + step, ..., k.

    Parameters
    ----------
    source, target : Surface
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
    motion : tuple (R, t, c)
        See :func:`registered`.
    """
    k = min(k, target.Phi.shape[1], source.Phi.shape[1])
    for K in [*range(min(k_first, k), k, step), k]:
        Phi = target.Phi[:, :K]
        for _ in range(rounds):
            motion = onto(
                target.X,
                source.X[match],
                target.area,
                lambda d, Phi=Phi: Phi.T @ (target.area[:, None] * d),
                (Phi, target.eigenvalue[:K]) if by_parts else None,
            )
            X = registered(target, motion)
            if not spectral:
                match = search(source, target, X)
                continue
            w = spectral / np.sqrt(K)
            C = fmap_from_match(source.Phi[:, :K], Phi, target.area, match)
            match = nearest_rows(
                features(X, vertex_normals(X, target.T), w * Phi),
                features(source.X, vertex_normals(source.X, source.T), w * source.Phi[:, :K] @ C.T),
            )
    return match, motion


def dense_rounds(source, target, motion, *, rounds=3):
    """Joint rounds at full resolution, on ``some`` vertices of the target.

    Motions of its parts stay as they are.

    Parameters
    ----------
    source, target : Surface
    motion : tuple (R, t, c)
        The end of the low rounds.

    Returns
    -------
    match : int ndarray (s,)
    motion : tuple (R, t, c)
    """
    match = search(source, target, registered(target, motion), target.some)
    R, t, _ = motion
    for _ in range(rounds):
        if R.ndim == 2:
            motion = fitted(source, target, match)
        else:
            motion = R, t, target.smooth(source.X[match] - turned(target, R, t)[target.some])
        match = search(source, target, registered(target, motion), target.some)
    return match, motion


def badness(source, target, match, motion, *, n_samples=300, limit=0.5):
    """Score of a match without truth, lower is better.

    Round trip + gaps between the surfaces, both ways.

    The round trip goes from a vertex of the target to its match and back to the vertex whose
    registered position (in position and normal) is nearest, measured along the edges of the target
    and cut at `limit`; the gaps are the mean distances of the registered target and the source, at
    ``some`` of the vertices of each. Lengths are for unit area.

    Stretch of edges is left out: on heads and brains with known warps it prefers maps that move
    nothing.

    Parameters
    ----------
    source, target : Surface
    match : int ndarray (s,)
        For ``some`` vertices of the target.
    motion : tuple (R, t, c)
    """
    X = registered(target, motion)
    tree, some = feature_tree(X, target.T), np.arange(len(X))[target.some]
    back_gap = np.linalg.norm(
        source.X[source.some] - X[tree.query(source.tree.data[source.some])[1]], axis=1
    )
    gap = np.linalg.norm(X[some] - source.X[match], axis=1)
    sample = target.outwards[np.linspace(0, len(match) - 1, min(n_samples, len(match))).astype(int)]
    back = tree.query(source.tree.data[match[sample]])[1]
    trip = path_lengths(target.graph, some[sample], back, limit)
    return float(trip.mean() + gap.mean() + back_gap.mean())


def far_apart(source, target, match):
    """Whether poses differ: a tenth of the target's vertices lie far from their matches after the best rigid motion.

    Far is 0.035 and 0.4 of the mean spacing 1 / sqrt(n) of the source's vertices, which alone keep
    matches apart: 0.04 for 6,000.  For nearest neighbours after ICP that tenth lies 0.005 to 0.031
    away between faces, brains, heads or skulls, 0.025 to 0.046 between femurs or vertebrae, 0.044
    to 0.23 between bodies, children or cats in other poses.
    """
    R, t, _ = rigid_transform(target.X, source.X[match], target.area)
    gap = np.linalg.norm(turned(target, R, t) - source.X[match], axis=1)
    return bool(np.quantile(gap, 0.9) > FAR + 0.4 / np.sqrt(len(source.X)))


def candidates(source, target, starts, *, k=100, far=0.03):
    """Matches at low resolution and their scores: every start as it is, and after joint rounds.

    From the better start more rounds, with spectral coordinates, are tried: by parts where all
    starts say that the poses are :func:`far_apart`, else in one piece where the best of these still
    scores above `far`, as the shapes then differ much.

    Parameters
    ----------
    source, target : Surface
    starts : dict
        Name -> match (n_target,).

    Returns
    -------
    dict
        ``"<start>"``, ``"<start>+joint"``, ``"<start>+joint+spectral"`` or ``"<start>+parts"`` ->
        :func:`badness`, match (n_target,) and motion (R, t, c).
    """
    found = {}

    def enter(name, match, motion):
        found[name] = (badness(source, target, match, motion), match, motion)
        return found[name][0]

    for name, match in starts.items():
        enter(name, match, fitted(source, target, match))
    joint = {
        name: enter(f"{name}+joint", *low_rounds(source, target, match, k=k))
        for name, match in starts.items()
    }
    start = min(joint, key=joint.get)
    if all(far_apart(source, target, match) for match in starts.values()):
        options = {"k_first": 20, "k": k, "rounds": 1, "spectral": 0.2, "by_parts": True}
        enter(f"{start}+parts", *low_rounds(source, target, starts[start], **options))
    elif min(score for score, *_ in found.values()) > far:
        enter(
            f"{start}+joint+spectral", *low_rounds(source, target, starts[start], k=k, spectral=0.1)
        )
    return found


def finalists(found, *, margin=1.25):
    """Names of the candidates whose score is within `margin` of the least, at most two, best first.

    Scores at low resolution have the coarse sampling in them; near ones can only be told apart at
    full resolution.
    """
    order = sorted(found, key=lambda name: found[name][0])[:2]
    return [name for name in order if found[name][0] <= margin * found[order[0]][0]]
