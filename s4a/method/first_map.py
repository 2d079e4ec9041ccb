"""First maps of shapes whose poses are far apart.

Where nearest neighbours after ICP (4.1) are wrong.
"""

import numpy as np
from scipy.spatial import cKDTree

from s4a.geometry.mesh import edges
from s4a.method import fmap, joint
from s4a.method.network import first_map


def stretch(target, motion):
    """Median |log| of the lengths of the registered edges by those of the target."""
    X, ends = joint.registered(target, motion), edges(target.T)
    new, old = (np.linalg.norm(np.subtract(*P[ends.T]), axis=1) for P in (X, target.X))
    return float(np.median(np.abs(np.log(np.maximum(new, 1e-12) / np.maximum(old, 1e-12)))))


def best_first_map(source, target, C, *, k=60, step=10):
    """The best of a first map and of those from heat and from wave kernel signatures.

    Which no pose changes.

    Either kind alone fails on some pairs: shapes that nearly are their own mirror image are turned
    over, or limbs exchanged.  Each map is refined by a short ZoomOut and a few rounds of
    :func:`s4a.method.joint.low_rounds` by parts; their end is scored without truth,
    :func:`s4a.method.joint.badness` + :func:`stretch`, as a pose hardly stretches the surface.

    Parameters
    ----------
    source, target : s4a.method.joint.Surface
        At low resolution.
    C : float ndarray (k_init, k_init)
        First map from ICP.
    k, step : int
        Of the short ZoomOut.

    Returns
    -------
    name : {"icp", "hks", "wks"}
    C : float ndarray (k_init, k_init)
    """
    ends = [(s.eigenvalue, s.Phi, s.area, s.T) for s in (source, target)]
    k_init, found, scores = len(C), {"icp": C}, {}
    for kind in ("hks", "wks"):
        fitted = fmap.fmap_of_descriptors(*ends, k=k_init, kind=kind)
        found[kind] = fmap.once_refined(fitted, source.Phi, target.Phi, target.area)
    k = min(k, source.Phi.shape[1], target.Phi.shape[1])
    for name, first in found.items():
        match = fmap.zoomout(first, source.Phi, target.Phi, target.area, k, step=step)[1]
        end = joint.low_rounds(source, target, match, k_first=20, step=20, rounds=1, by_parts=True)
        scores[name] = joint.badness(source, target, *end) + stretch(target, end[1])
    best = min(scores, key=scores.get)
    return best, found[best]


def have_signatures(source, target, k):
    """Whether the first k eigenvalues of both shapes, less those of 0, have a range in common.

    Of pieces not always.
    """
    least = max(s.eigenvalue[s.eigenvalue > 0].min(initial=np.inf) for s in (source, target))
    return bool(1.01 * least < min(s.eigenvalue[k - 1] for s in (source, target)))


def first_map_of(source, target, motion, *, k_init=20, init="dense"):
    """:func:`s4a.method.network.first_map`.

    Or :func:`best_first_map` where that is dense and poses are far apart.

    Without signatures, :func:`have_signatures`, it stays as it is.

    Parameters
    ----------
    source, target : s4a.method.joint.Surface
        At low resolution.
    motion : tuple (R, t)
        Rigid motion of the source onto the target.
    k_init, init : see :func:`s4a.method.network.first_map`

    Returns
    -------
    name : str
        `init`, or what :func:`best_first_map` chose.
    C : float ndarray (k_init, k_init)
    near : int ndarray (n_target,)
        Nearest neighbours in space after the motion.
    """
    near = cKDTree(source.X @ motion[0].T + motion[1]).query(target.X)[1]
    ends = ((s.X, s.area, s.Phi, s.eigenvalue) for s in (source, target))
    C = first_map(*ends, motion, k_init=k_init, init=init, near=near)
    if (
        init == "dense"
        and joint.far_apart(source, target, near)
        and have_signatures(source, target, k_init)
    ):
        return *best_first_map(source, target, C), near
    return init, C, near
