"""Self-intersections of a surface (3.1: an embedded surface has none).

Exact predicates (Shewchuk 1997, in libigl) decide which triangles intersect, so neither the unit
nor rounding matters.
"""

import logging

import numpy as np

from s4a.geometry.compiled import igl
from s4a.geometry.mesh import equal_rows, order_in_space
from s4a.schema import Array

log = logging.getLogger(__name__)

# intersecting pairs are in memory together, 80 bytes each
_MOST_PAIRS = 10_000_000
# boxes of neighbours overlap on every surface, about 7 pairs a triangle, and few of them intersect;
# the estimate is slower: 13 instead of 5 s for 2 million triangles
_FEW_PAIRS = 20  # per triangle
N_PROBED, N_OTHERS = 200, 5000  # triangles whose boxes are compared to estimate the number


def count_crossing(X: Array, T: Array, *, most_pairs: int | None = None) -> int:
    """Return the number of triangles that intersect another without a common corner.

    Corners at the same position count as one, so that components of a non-manifold surface that
    was cut open touch and do not intersect.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)
    most_pairs : int, optional
        If more pairs of boxes overlap, the number is estimated from a sample of triangles.  The
        estimate is a lower bound, as it leaves out intersections of triangles with a common corner.
        By default 10 million or 20 per triangle, whichever is more.

    Examples
    --------
    A triangle through another, and one next to them:

    >>> import numpy as np
    >>> from s4a.geometry.crossing import count_crossing
    >>> X = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1, 1], [3, 3, 1.0]])
    >>> other = X[:3] + [9, 0, 0]
    >>> count_crossing(np.concatenate([X, other]), np.arange(9).reshape(3, 3))
    2
    """
    if len(T) == 0:
        return 0
    X = np.asarray(X, np.float64)
    first, group = equal_rows(X)
    X = np.ascontiguousarray(X[first])
    T = np.ascontiguousarray(group[T], np.int64)
    T = T[order_in_space(X[T].mean(1))]  # without this order the search takes three times as long
    expected = expected_pairs(X, T)
    if most_pairs is None:
        most_pairs = max(_MOST_PAIRS, _FEW_PAIRS * len(T))
    if expected <= most_pairs:
        _, pair, _ = igl.predicates.find_self_intersections(X, T)
        return len(np.unique(pair))
    most_pairs = min(most_pairs, _MOST_PAIRS)
    sample = evenly(len(T), max(10, int(len(T) * most_pairs / (2 * expected))))
    some = np.ascontiguousarray(T[sample])
    _, pair, _ = igl.predicates.find_intersections(X, some, X, T)
    disjoint = (some[pair[:, 0], :, None] != T[pair[:, 1], None, :]).all((1, 2))
    return round(len(np.unique(pair[disjoint, 0])) / len(sample) * len(T))


def can_count(asked: bool) -> bool:
    """Return `asked`, or False with a warning if libigl is missing.

    Examples
    --------
    >>> from s4a.geometry.crossing import can_count
    >>> can_count(True), can_count(False)
    (True, False)
    """
    if asked and not igl:
        log.warning("self-intersections are not counted because libigl cannot be imported")
        return False
    return asked


def expected_pairs(X: Array, T: Array) -> float:
    """Estimate the number of pairs of triangles with overlapping boxes, from samples."""
    some, others = evenly(len(T), N_PROBED), evenly(len(T), N_OTHERS)
    low, high = X[T[some]].min(1), X[T[some]].max(1)  # (some, 3)
    low_other, high_other = X[T[others]].min(1), X[T[others]].max(1)
    overlap = np.ones((len(some), len(others)), bool)
    for x in range(3):
        overlap &= low[:, x, None] <= high_other[:, x]
        overlap &= high[:, x, None] >= low_other[:, x]
    overlap &= some[:, None] != others
    return float(overlap.mean()) * len(T) ** 2 / 2


def evenly(n: int, most: int) -> Array:
    """Return at most `most` evenly spaced integers from 0 to n - 1."""
    return np.linspace(0, n - 1, min(n, most)).astype(int)
