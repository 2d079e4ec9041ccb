"""Rigid alignment of the shapes (4.1, step 2), and ambiguous poses.

A pose of a shape is a rigid transform onto the reference.  Several are found by ICP from the
principal axes.  Other aligned shapes vote: the pose that fits the reference and all of them best is
used, so poses are consistent around the cycles of the network.  If several are equally good, the
pose of the files is used where ICP from it fits nearly as well and rotates the shape little.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from s4a.geometry.align import (
    N_POSES,
    ROUGH,
    RigidTransform,
    align,
    icp,
    icp_each,
    point_to_point,
    poses,
    realign,
    relative_transform,
    rigid_transform,
)
from s4a.input.plausibility import flag
from s4a.method import spectral_icp
from s4a.method.shape import Basis, corresponding_landmarks
from s4a.options import check
from s4a.schema import POSE, Array

N_VOTERS = 6
N_VOTED = 150  # samples that are paired while a pose is fitted to a voter; all measure the residual
# poses are equally good if the root mean square residual to the voters is at most ALIKE times that
# of the best; or NEARLY times, if it is the same for one voter but for SAME (of sqrt(area), root of
# the difference of squares).  Shapes of a collection differ by about 0.04.  With fewer vertices
# than ENOUGH their spacing hides part of the difference: ALIKE is lower, and NEARLY does not apply
ALIKE, NEARLY, SAME, ENOUGH = 1.07, 1.2, 0.008, 400
AS_GIVEN = 20.0  # degrees by which ICP from the pose of the files may rotate it
_COLLINEAR = 0.02  # of sqrt(area): landmarks this close to a line do not determine a rotation
IDENTITY = np.eye(3), np.zeros(3)


class Alignment(NamedTuple):
    """Rigid transform of a shape onto a reference, and equally good poses."""

    R: Array  # (3, 3)
    t: Array  # (3,)
    fits: tuple[float, ...] = (0.0,)  # residuals of equally good poses, the least first
    angle: float = 0.0  # degrees between the first and the second of them

    @property
    def transform(self) -> RigidTransform:
        """The transform (R, t)."""
        return self.R, self.t

    @property
    def ambiguity(self) -> str:
        """Message on equally good poses; empty if there is only one."""
        if len(self.fits) < 2:
            return ""
        best, second, *_ = self.fits
        number, angle = len(self.fits), self.angle
        return flag(POSE, number=number, best=best, second=second, angle=angle).words


def less_confident(registration: xr.Dataset, n_poses: int) -> xr.Dataset:
    """Divide the confidence of a registration by the number of equally good poses."""
    confidence = registration["confidence"]
    return registration.assign(confidence=confidence.copy(data=confidence.values / n_poses))


Voters = Mapping[str, tuple[Basis, RigidTransform]]  # name -> shape, and its pose


def transform_onto(
    source: Basis,
    target: Basis,
    alignment: str = "search",
    start: RigidTransform | None = None,
) -> RigidTransform:
    """Return the rigid transform (R, t) of the source onto the target (4.1, step 2).

    Parameters
    ----------
    source, target : Basis
    alignment : {"search", "icp", "given"}
        The best of several results of ICP; plain ICP from the pose of the files, or that pose with
        centroids aligned.
    start : tuple (R, t), optional
        Approximate transform, from which alone ICP starts.  Three or more common landmarks that are
        not collinear replace it.
    """
    check("alignment", alignment)
    if alignment == "given":
        return start or IDENTITY
    start = from_landmarks(source, target) or start
    if alignment == "icp":
        return point_to_point(source.cloud, target.cloud, *(start or IDENTITY))[:2]
    if start is None:
        return align(source.cloud, target.cloud)[:2]
    return realign(source.cloud, target.cloud, start)


def from_landmarks(source: Basis, target: Basis) -> RigidTransform | None:
    """Return the transform that fits common landmarks; None if they do not determine it."""
    at_source, at_target = corresponding_landmarks(source, target)
    P = source.X[at_source]
    if len(P) < 3 or np.linalg.svd(P - P.mean(0), compute_uv=False)[1] < _COLLINEAR:
        return None
    R, t, _ = rigid_transform(P, target.X[at_target])
    return R, t


def pair_transform(
    source: Basis, target: Basis, start: RigidTransform, alignment: str
) -> RigidTransform:
    """Return the transform of a pair of the network, whose poses give the transform `start`."""
    if alignment == "search":
        return realign(source.cloud, target.cloud, start)
    return transform_onto(source, target, alignment)


def alignment_residual(source: Basis, target: Basis, transform: RigidTransform) -> float:
    """Root mean square distance of nearest vertices, in both directions, after a transform."""
    M, N = (b.cloud._replace(normals=None, tree=cKDTree(b.X)) for b in (source, target))
    return float(icp(M, N, *transform, iterations=1)[2])


def align_onto(
    source: Basis, target: Basis, alignment: str = "search", voters: Voters | None = None
) -> Alignment:
    """Align a shape to a reference, and find equally good poses.

    Parameters
    ----------
    source, target, alignment : see :func:`transform_onto`
    voters : dict, optional
        Other shapes, with their poses on the target.

    Returns
    -------
    Alignment
        With one pose only if landmarks or another `alignment` determine it, or if parts of the
        shape are in another pose (:func:`s4a.method.spectral_icp.poses_differ`).
    """
    if alignment != "search" or from_landmarks(source, target):
        return Alignment(*transform_onto(source, target, alignment))
    found = [(R, t) for R, t, _ in poses(source.cloud, target.cloud)[:N_POSES]]
    return elect(source, {"": (target, IDENTITY), **(voters or {})}, found)


def ambiguity_of_reference(target: Basis, voters: Voters) -> Alignment:
    """Find poses in which the reference itself fits the other shapes equally well."""
    other, (S, u) = next(iter(voters.values()))
    if from_landmarks(target, other):
        return Alignment(*IDENTITY)
    found = [(S @ R, S @ t + u) for R, t, _ in poses(target.cloud, other.cloud)[:N_POSES]]
    return elect(target, voters, found)._replace(R=np.eye(3), t=np.zeros(3))


def elect(source: Basis, voters: Voters, found: Sequence[RigidTransform]) -> Alignment:
    """Choose the pose with the least mean squared residual to the voters.

    If several are equally good, the result of ICP from the pose of the files is chosen, provided
    that it fits nearly as well and is within ``AS_GIVEN`` degrees of that pose.

    Parameters
    ----------
    source : Basis
    voters : dict
        Shapes with their poses on the reference, the reference itself among them.
    found : sequence of tuple (R, t)
        Poses of the source on the reference.
    """
    if len(found) == 1:
        return Alignment(*found[0])
    squared = _squared_residuals(source, voters, found)
    order = np.argsort(squared.mean(0), kind="stable")
    squared, (R, t) = squared[:, order], found[order[0]]
    residual = np.sqrt(squared.mean(0))
    known = min(1.0, len(source.X) / ENOUGH)
    same = (known == 1) & (abs(squared - squared[:, :1]).min(0) < SAME**2)
    alike = residual <= np.where(same, NEARLY, 1 + known * (ALIKE - 1)) * residual[0]
    fits = tuple(residual[alike].tolist())
    if len(fits) < 2 or _differs(source, voters, (R, t)):
        return Alignment(R, t, fits[:1])
    angle = _degrees(R.T @ found[order[np.flatnonzero(alike)[1]]][0])
    S, u = realign(source.cloud, next(iter(voters.values()))[0].cloud, IDENTITY)
    fit = np.sqrt(_squared_residuals(source, voters, [(S, u)]).mean())
    if _degrees(S) < AS_GIVEN and fit < NEARLY * fits[0]:
        R, t = S, u
    return Alignment(R, t, fits, angle)


def _squared_residuals(source: Basis, voters: Voters, found: Sequence[RigidTransform]) -> Array:
    """Return the squared residuals (voters, poses) of ICP from each pose to each voter."""
    rows, few = [], source.cloud.thinned(N_VOTED)
    for other, onto in voters.values():
        starts = [relative_transform(pose, onto) for pose in found]
        ends = icp_each(few, other.cloud.thinned(N_VOTED), starts, tolerance=5 * ROUGH)
        ends = icp_each(source.cloud, other.cloud, [end[:2] for end in ends], iterations=1)
        rows.append([residual**2 for *_, residual in ends])
    return np.array(rows)


def _degrees(R: Array) -> float:
    """Return the angle of a rotation."""
    return float(np.rad2deg(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def _differs(source: Basis, voters: Voters, pose: RigidTransform) -> bool:
    """Return whether parts of the shape are in another pose than those of most voters."""
    count = 0
    for other, onto in voters.values():
        R, t = relative_transform(pose, onto)
        near = cKDTree(source.X @ R.T + t).query(other.X)[1]
        count += spectral_icp.poses_differ(source, other, near)
    return 2 * count > len(voters)


def align_all(
    bases: Mapping[str, Basis], reference: str, alignment: str = "search"
) -> dict[str, Alignment]:
    """Align all shapes to the reference, with votes of some of them."""
    voters = voters_of(bases, reference, alignment)
    return {
        name: align_voted(name, basis, bases[reference], reference, alignment, voters)
        for name, basis in bases.items()
    }


def voters_of(bases: Mapping[str, Basis], reference: str, alignment: str = "search") -> Voters:
    """Return at most ``N_VOTERS`` + 1 of the shapes with their poses; none for "icp", "given"."""
    if alignment != "search":
        return {}
    names = itertools.islice((name for name in bases if name != reference), N_VOTERS + 1)
    target = bases[reference]
    return {name: (bases[name], transform_onto(bases[name], target)) for name in names}


def align_voted(
    name: str, basis: Basis, target: Basis, reference: str, alignment: str, voters: Voters
) -> Alignment:
    """Align a shape of a network with the votes of other shapes."""
    others = {other: voter for other, voter in voters.items() if other != name}
    others = dict(itertools.islice(others.items(), N_VOTERS))
    if name != reference:
        return align_onto(basis, target, alignment, others)
    return ambiguity_of_reference(basis, others) if others else Alignment(*IDENTITY)
