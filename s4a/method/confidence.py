"""How sure a registration is of each vertex (4.2): the share of such vertices that are right.

Without the truth a registration knows two things of itself: the gap g that it leaves to the surface
of the shape, and the stretch s by which it bends the template.  Their logarithms vary from triangle
to triangle, errors do not: what is smooth in them, U Phi (U Phi)^+ log g, is the evidence, and

    confidence = 1 / (1 + exp(-(w_0 + w_g log g + w_s log s)))

is the probability that the vertex lies within :data:`RIGHT` of its true place.  The weights are
those of a logistic regression on pairs with a known truth; ``benchmarks/confidence.py`` makes
it, and says how well it holds for others.  A vertex that slides along a smooth surface leaves no
gap and needs little stretch: where poses are near and all is within 1 %, the order of the vertices
by their confidence says nothing of the order of their errors.
"""

import numpy as np

from s4a.geometry.closest import closest_point_in_star, interpolate
from s4a.geometry.mesh import triangle_areas
from s4a.method.deform import distortion
from s4a.method.shape import Shape

RIGHT = 0.01  # share of sqrt(area): errors below are right
LEAST = 1e-4  # added to gap and stretch: what is below is noise of the mesh
# w_0, and those of the logarithms of gap and stretch: docs/decisions.md
WEIGHTS = (-12.06, -1.46, -1.58)


def stretch(X: np.ndarray, image: np.ndarray, T: np.ndarray) -> np.ndarray:
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
    >>> from s4a.method.confidence import stretch
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


def evidence(source: Shape, target: Shape, match: np.ndarray, P: np.ndarray) -> np.ndarray:
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


def confidence(source: Shape, target: Shape, match: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Probability ``(n_target,)`` that a vertex lies within 1 % of sqrt(area) of its true place.

    Parameters
    ----------
    source, target, match, P : see :func:`evidence`
    """
    w_0, *w = WEIGHTS
    doubt = -(w_0 + evidence(source, target, match, P) @ np.array(w))
    return 1 / (1 + np.exp(np.clip(doubt, -50, 50)))


def uncertainty(confidence: np.ndarray) -> np.ndarray:
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
    >>> from s4a.method.confidence import uncertainty
    >>> uncertainty(np.array([0.1, 0.63, 1.0])).round(3).tolist()
    [0.031, 0.01, 0.003]
    """
    return RIGHT / np.sqrt(-np.log1p(-np.clip(confidence, 0.1, 1 - 1e-6)))
