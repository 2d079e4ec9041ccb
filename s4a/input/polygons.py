"""Triangles of the polygons and triangle strips of mesh files (5, the data).

Readers return polygons as a pair ``(corners, sizes)``: the concatenated corners of all polygons,
and the number of corners of each.
"""

import numpy as np

from s4a.schema import Array

Polygons = tuple[Array, Array]
_FLAT = 1e-6  # largest distance of corners from the plane of a planar polygon, in its extents
_NEGATIVE = 1e-7  # largest share of the area of a triangle that may be folded over, by rounding
_EPSILON = 1e-12  # area of a triangle that is not distinguished from 0, for extents of 1
_MOST = 20_000  # corners of a concave polygon, as ear clipping takes the square of their number


def polygons(corners: Array, offsets: Array) -> Polygons:
    """Return polygons by their sizes, given by offsets ``(p + 1,)`` into their corners ``(c,)``.

    Raises
    ------
    ValueError
        If offsets decrease, or exceed the number of corners.
    """
    decreasing = (offsets[1:] < offsets[:-1]).any()  # not by differences, which may overflow
    if decreasing or (len(offsets) and (offsets[0] < 0 or offsets[-1] > len(corners))):
        raise ValueError(f"polygons of {offsets[-1]} corners expected, found {len(corners)}")
    if not len(offsets):
        return corners[:0], offsets
    return corners[offsets[0] : offsets[-1]], np.diff(offsets)


def joined(parts: list[Polygons]) -> Polygons:
    """Concatenate polygons."""
    none = np.empty(0, np.int64)
    corners, sizes = zip((none, none), *parts, strict=True)
    return np.concatenate(corners), np.concatenate(sizes)


def strips(corners: Array, sizes: Array) -> Polygons:
    """Return the triangles of triangle strips; every second triangle of a strip is reversed.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.polygons import strips
    >>> corners, sizes = strips(np.array([0, 1, 2, 3]), np.array([4]))
    >>> corners.reshape(-1, 3).tolist()
    [[0, 1, 2], [3, 2, 1]]
    """
    # 1---3   0, 1, 2 and 3, 2, 1
    # | \ |
    # 0---2
    count = np.maximum(sizes - 2, 0)  # triangles of each strip
    first = np.repeat(np.cumsum(sizes) - sizes, count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    first, odd = first + step, step % 2
    triangles = np.stack([first + 2 * odd, first + 1, first + 2 - 2 * odd], axis=1)
    return corners[triangles].ravel(), np.full(len(triangles), 3)


def triangulated(X: Array, corners: Array, sizes: Array) -> tuple[Array, int]:
    """Triangulate polygons; those of fewer than three corners give no triangle.

    A planar polygon becomes the triangle fan of its first corner, unless a triangle is folded over.
    Otherwise the fan of its vertex of the lowest index is used or, if a triangle is then folded
    over, ear clipping.  Area and volume do not depend on which corner is the first.

    Parameters
    ----------
    X : float ndarray (n, 3)
    corners : int ndarray (c,)
        Vertices, from 0 to n - 1.
    sizes : int ndarray (p,)

    Returns
    -------
    T : int ndarray (m, 3)
    n_crossing : int
        Number of polygons that intersect themselves.

    Raises
    ------
    ValueError
        If a concave polygon has more than 20,000 corners.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.polygons import triangulated
    >>> X = np.array([[0, 0, 0], [2, 0, 0], [0.5, 0.5, 0], [0, 2, 0]])  # concave at vertex 2
    >>> triangulated(X, np.array([1, 2, 3, 0]), np.array([4]))[0].tolist()
    [[0, 1, 2], [0, 2, 3]]
    """
    # 3---2   the first corner and each opposite side
    # | / |
    # 0---1
    if (sizes == 3).all():
        return corners.reshape(-1, 3), 0
    begin, count = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    T, first, n_crossing = np.empty((count.sum(), 3), corners.dtype), np.cumsum(count) - count, 0
    rounding = 2e-7 * np.abs(X[np.isfinite(X)]).max(initial=0)  # of single precision
    for size in np.unique(sizes[count > 0]).tolist():
        which, at = np.flatnonzero(sizes == size), np.arange(size)
        rows = corners[begin[which, None] + at]  # (q, size)
        folded, is_planar = _fans(X[rows], rounding)
        again = np.flatnonzero(folded | ~is_planar)
        lowest = rows[again].argmin(axis=1)[:, None]
        rows[again] = np.take_along_axis(rows[again], (lowest + at) % size, axis=1)
        folded[again], _ = _fans(X[rows[again]], rounding)
        common = np.broadcast_to(rows[:, :1], (len(rows), size - 2))
        cut = np.stack([common, rows[:, 1:-1], rows[:, 2:]], axis=2)
        for i in np.flatnonzero(folded):
            ears, is_simple = _ears(X[rows[i]])
            cut[i], n_crossing = rows[i][ears], n_crossing + (not is_simple)
        T[first[which, None] + at[: size - 2]] = cut
    return T, n_crossing


def _fans(P, rounding):
    """Return whether fans of the first corner of polygons ``(q, c, 3)`` are folded over.

    Also whether the polygons are planar, up to the rounding of coordinates.
    """
    P = P - P[:, :1]
    parts = np.cross(P[:, 1:-1], P[:, 2:])
    N = parts.sum(axis=1)  # (q, 3), as long as twice the area
    length = np.linalg.norm(N, axis=1)
    folded = np.einsum("qti,qi->qt", parts, N) < -_NEGATIVE * length[:, None] ** 2
    height = np.abs(np.einsum("qci,qi->qc", P, N)).max(axis=1)
    is_planar = ~(height > (_FLAT * np.abs(P).max(axis=(1, 2)) + rounding) * length)
    return folded.any(axis=1), is_planar


def _ears(P):
    """Triangles ``(c - 2, 3)`` of a polygon ``(c, 3)`` by ear clipping, and whether it is simple.

    Ears without area are clipped last, so corners on a straight side belong to a triangle.
    """
    if len(P) > _MOST:
        raise ValueError(
            f"concave polygons of at most {_MOST} corners expected, found {len(P)}: save the "
            "surface as triangles"
        )
    P = P - P.mean(axis=0)
    N = np.cross(P, np.roll(P, -1, axis=0)).sum(axis=0)
    k = int(np.abs(N).argmax())
    P = P[:, [(k + 1) % 3, (k + 2) % 3][:: 1 if N[k] > 0 else -1]]  # counter-clockwise
    P = P / (np.abs(P).max() or 1.0)
    left, ears, at, n_failed = list(range(len(P))), [], 0, 0
    while len(left) > 2:
        n = len(left)
        corners = [left[(at + i) % n] for i in (-1, 0, 1)]
        turn = _turn(*P[corners])
        is_ear = turn > _EPSILON and not _any_inside(P[corners], P[left])
        if is_ear or (n_failed >= n and turn > -_EPSILON) or n_failed >= 2 * n:
            ears.append(corners)
            left.pop(at % n)
            at, n_failed = at % n, 0
        else:
            at, n_failed = at + 1, n_failed + 1
    return np.array(ears), bool((_turn(*P[np.array(ears).T]) > -_EPSILON).all())


def _turn(a, b, c):
    """Twice the area of triangles in the plane, positive if counter-clockwise."""
    u, v = b - a, c - b
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _any_inside(triangle, points):
    """Return whether a triangle or its sides contain any of the points but its corners."""
    inside = np.ones(len(points), bool)
    for i in range(3):
        inside &= _turn(triangle[i - 1], triangle[i], points) > -_EPSILON
        inside &= (points != triangle[i]).any(axis=1)
    return bool(inside.any())
