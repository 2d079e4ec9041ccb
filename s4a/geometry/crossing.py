"""Triangles of a surface that pass through others (3.1: a surface embedded in space has none).

Which pairs meet is decided with exact predicates (Shewchuk 1997, in libigl), so that neither the
unit nor rounding matters.
"""

import logging

import numpy as np

from s4a.geometry.compiled import igl
from s4a.geometry.mesh import equal_rows, order_in_space
from s4a.schema import Array

log = logging.getLogger(__name__)

# Pairs that cross are held at once, 40 bytes each: of a surface crumpled into a ball they are all
_MOST_PAIRS = 10_000_000
N_PROBED, N_BESIDE = 200, 5000  # triangles whose boxes are compared to foresee how many there are


def count_crossing(X: Array, T: Array, *, most_pairs: int = _MOST_PAIRS) -> int:
    """How many triangles pass through another, or touch one that has no corner in common with it.

    Corners at the same place are one, as where a surface that is not manifold was cut into sheets:
    these touch there and do not cross.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)
    most_pairs : int
        Where more pairs of boxes overlap, the triangles of a sample speak for all, without those
        that cross nothing but triangles with which they have a corner in common: it is no more than
        a lower bound then, of what is far above any number that matters.

    Examples
    --------
    A triangle through another, and one beside them:

    >>> import numpy as np
    >>> from s4a.geometry.crossing import count_crossing
    >>> X = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1, 1], [3, 3, 1.0]])
    >>> beside = X[:3] + [9, 0, 0]
    >>> count_crossing(np.concatenate([X, beside]), np.arange(9).reshape(3, 3))
    2
    """
    if len(T) == 0:
        return 0
    X = np.asarray(X, np.float64)
    first, place = equal_rows(X)
    X = np.ascontiguousarray(X[first])
    T = np.ascontiguousarray(place[T], np.int64)
    T = T[order_in_space(X[T].mean(1))]  # in no order at all the search takes three times as long
    expected = expected_pairs(X, T)
    if expected <= most_pairs:
        _, pair, _ = igl.predicates.find_self_intersections(X, T)
        return len(np.unique(pair))
    sample = evenly(len(T), max(10, int(len(T) * most_pairs / (2 * expected))))
    some = np.ascontiguousarray(T[sample])
    _, pair, _ = igl.predicates.find_intersections(X, some, X, T)
    apart = (some[pair[:, 0], :, None] != T[pair[:, 1], None, :]).all((1, 2))
    return round(len(np.unique(pair[apart, 0])) / len(sample) * len(T))


def can_count(asked: bool) -> bool:
    """Return `asked`, or False with a warning where libigl is missing.

    Examples
    --------
    >>> from s4a.geometry.crossing import can_count
    >>> can_count(True), can_count(False)
    (True, False)
    """
    if asked and not igl:
        log.warning("self-intersections are not counted, as libigl cannot be imported here")
        return False
    return asked


def expected_pairs(X: Array, T: Array) -> float:
    """About how many pairs of triangles have boxes that overlap, from some beside some others."""
    some, others = evenly(len(T), N_PROBED), evenly(len(T), N_BESIDE)
    low, high = X[T[some]].min(1), X[T[some]].max(1)  # (some, 3)
    low_other, high_other = X[T[others]].min(1), X[T[others]].max(1)
    overlap = np.ones((len(some), len(others)), bool)
    for x in range(3):
        overlap &= low[:, x, None] <= high_other[:, x]
        overlap &= high[:, x, None] >= low_other[:, x]
    overlap &= some[:, None] != others
    return float(overlap.mean()) * len(T) ** 2 / 2


def evenly(n: int, most: int) -> Array:
    """At most so many of the numbers 0 to n - 1, evenly spread."""
    return np.linspace(0, n - 1, min(n, most)).astype(int)
