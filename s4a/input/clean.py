"""Cleaning (4.1, before step 1): from the triangles of a file to an oriented manifold surface.

Half-edge ``h = t + m * i`` of m triangles runs from corner i of triangle t to its next corner; its
mate is the half-edge of the neighbour across the edge, -1 if there is none.
"""

import re

import numpy as np
import scipy.sparse as sp
import xarray as xr
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from s4a.geometry.mesh import (
    as_arrays,
    as_dataset,
    components,
    counted_edges,
    counting_order,
    directed_edges,
    equal_rows,
    n_used,
    triangle_areas,
    triangle_normals,
    unique_edges,
)
from s4a.options import check_components
from s4a.schema import TABLE, Array, require

# share of the bounding-box diagonal within which vertices are welded and triangles are flat
_RELATIVE_TOLERANCE = 1e-7
# largest coordinate, and one over the least extent: sums of squares stay within the range of
# float32 (1e-38 to 3e38), in which displacements are stored
LARGEST = 1e15
# largest coordinate over extent: beyond, rounding exceeds 1 % of the extent in float32, and
# the frame of a shape is off by 1e-4 of its extent in float64 (measured for 1e13 and 1e14)
_FARTHEST = {"float32": 1e5, "float64": 1e11}

REPAIRS = {
    name: TABLE[name][2]
    for name in (
        "nonfinite_vertices welded_vertices degenerate_triangles duplicate_triangles flipped_edges "
        "flat_triangles nonmanifold_edges cut_edges split_vertices inserted_vertices "
        "reoriented_triangles dropped_components unreferenced_vertices closed_holes"
    ).split()
}


def clean(
    mesh: xr.Dataset,
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
) -> xr.Dataset:
    """Make a mesh an oriented edge- and vertex-manifold surface.

    Vertices closer to each other than 1e-7 of the bounding-box diagonal are welded.  Degenerate and
    duplicate triangles are dropped, and zero-area triangles are removed by flipping their long
    edge. Non-manifold edges and vertices are split, triangles are oriented consistently and
    outwards, and small components are dropped.  Holes are kept unless `close_holes` is set.

    Parameters
    ----------
    mesh : Dataset
        With ``position(vertex, xyz)`` and ``corner_vertex(triangle, corner)``.
    components : "largest", "all" or int
        Keep the component with the largest area, all of them, or that many of the largest.
    strict : bool
        Raise an error for vertices that are not finite; by default they are removed.
    close_holes : bool
        Close every hole by a fan of triangles, see :func:`s4a.input.clean.fill_holes`.

    Returns
    -------
    Dataset
        With ``position``, ``corner_vertex``, ``file_vertex`` (equal for copies of a split vertex)
        and ``vertex_of_file``.  Repairs are counted in the attributes, see :func:`clean_arrays`,
        and summarized as ``status`` (ok or repaired) and ``reason``.

    Raises
    ------
    ValueError
        If indices are out of range, coordinates are outside the numerical range, no triangle is
        left, or the largest component has under half of the area.

    See Also
    --------
    read_shape : read a file and clean it.
    coarsen : remesh at low resolution.

    References
    ----------
    A. Guéziec, G. Taubin, F. Lazarus and W. Horn (2001), Cutting and stitching: converting sets of
    polygons to manifold surfaces, IEEE TVCG 7(2).

    Examples
    --------
    >>> import s4a
    >>> from s4a.geometry.mesh import as_dataset
    >>> tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 1, 3]]  # last: a duplicate
    >>> mesh = s4a.clean(as_dataset([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], tetrahedron))
    >>> mesh.sizes["triangle"], mesh.attrs["duplicate_triangles"], mesh.attrs["genus"]
    (4, 1, 0)
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    X, T, file_vertex, vertex_of_file, counts = clean_arrays(
        *as_arrays(mesh), components=components, strict=strict, close_holes=close_holes
    )
    reason = repairs(counts)
    status = "repaired" if reason else "ok"
    if counts["holes"]:
        holes = counted(counts["holes"], "holes kept as boundary (close_holes=True closes them)")
        reason = "; ".join(filter(None, [reason, holes]))
    attrs = {**mesh.attrs, **counts, "status": status, "reason": reason}
    return as_dataset(X, T, attrs, file_vertex=file_vertex, vertex_of_file=vertex_of_file)


def clean_arrays(
    points: Array,
    triangles: Array,
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
) -> tuple[Array, Array, Array, Array, dict[str, int | float]]:
    """Clean a mesh given as arrays; see :func:`clean`.

    Returns
    -------
    X : float ndarray (n, 3)
    T : int32 ndarray (m, 3)
    file_vertex : int32 ndarray (n,)
        Row of `points` of each vertex; a vertex inserted on an edge or in a hole has the row of a
        neighbour.
    vertex_of_file : int32 ndarray (len(points),)
        Vertex of each row of `points`, -1 if it was dropped.
    counts : dict of str to int
        The keys of :data:`REPAIRS`; ``file_vertices``, ``file_triangles`` and ``components`` of the
        input; ``holes`` (boundary loops), ``euler_characteristic``, ``genus`` (sum over components)
        and ``area`` of the result; ``area_dropped``, the share in dropped components.
    """
    P, F = check_arrays(points, triangles)
    check_components(components)
    counts: dict[str, int | float] = {"file_vertices": len(P), "file_triangles": len(F)}
    counts |= dict.fromkeys(REPAIRS, 0)
    counts["unreferenced_vertices"] = len(P) - n_used(F)
    F = _drop_nonfinite(P, F, strict, counts)
    check_range(P, F)
    group, tolerance = _weld(P, F, counts)
    F = _drop_repeated(F, group, counts)
    F = _flip_flat(P, F, group, tolerance, counts)
    if len(F) == 0:
        raise ValueError(
            f"a surface needs triangles with area; none of the {counts['file_triangles']} has any"
        )
    F, mate = _join_triangles(P, F, group, counts)
    V, file_vertex = _join_corners(F, mate)
    counts["split_vertices"] = len(file_vertex) - n_used(group[F])
    X, T, boundary = P[file_vertex], V, directed_edges(V)[mate < 0]
    if any(counts[kind] for kind in ("nonmanifold_edges", "cut_edges", "split_vertices")):
        X, T, file_vertex = _split_double_edges(X, V, file_vertex, mate, counts)
        E, count = counted_edges(T, len(X))
        boundary = E[count == 1]
    T, is_kept = _keep_components(X, T, boundary, components, counts)
    new = np.where(is_kept, np.cumsum(is_kept) - 1, -1)
    X, T, file_vertex = X[is_kept], new[T], file_vertex[is_kept]
    boundary = new[boundary[is_kept[boundary[:, 0]]]]
    if close_holes:
        X, T, nearby = fill_holes(X, T)
        file_vertex, boundary = np.r_[file_vertex, file_vertex[nearby]], boundary[:0]
        counts["closed_holes"] = len(nearby)
    _count_topology(X, T, boundary, counts)
    counts["area"] = float(triangle_areas(X, T).sum())
    vertex_of_file = _vertex_of_file(group, new[V].ravel(), F.ravel())
    return X, T.astype(np.int32), file_vertex.astype(np.int32), vertex_of_file, counts


def repairs(counts: dict[str, int | float]) -> str:
    """Summarize the repairs in words; empty if there were none.

    Examples
    --------
    >>> from s4a.input.clean import repairs
    >>> repairs({"welded_vertices": 2, "dropped_components": 1, "area_dropped": 0.0214})
    '2 vertices welded; 1 component dropped (2.1 % of the area)'
    """
    parts = []
    for name, text in REPAIRS.items():
        if counts.get(name):
            parts.append(counted(counts[name], text))
            if name == "dropped_components":
                parts[-1] += f" ({100 * counts['area_dropped']:.2g} % of the area)"
    return "; ".join(parts)


def counted(n: float, text: str) -> str:
    """Put a number before its noun, the first plural of the text; in the singular after 1.

    Examples
    --------
    >>> from s4a.input.clean import counted
    >>> counted(1, "holes closed"), counted(2, "holes closed")
    ('1 hole closed', '2 holes closed')
    """
    if n == 1:
        text = re.sub(r"vertices|(\w+)s\b", lambda plural: plural[1] or "vertex", text, count=1)
    return f"{n} {text}"


def check_arrays(points: ArrayLike, triangles: ArrayLike) -> tuple[Array, Array]:
    """Convert points ``(n, 3)`` to float64 and triangles ``(m, 3)`` to int64, or ValueError."""
    P, F = np.asarray(points, np.float64), np.asarray(triangles)
    if P.ndim != 2 or P.shape[1] != 3 or F.ndim != 2 or F.shape[1] != 3 or len(F) == 0:
        raise ValueError(
            f"a mesh needs points (n, 3) and triangles (m, 3); found {P.shape} and {F.shape}"
        )
    if not np.issubdtype(F.dtype, np.integer):
        raise ValueError(f"triangles need integer vertex indices; found {F.dtype}")
    if F.min() < 0 or F.max() >= len(P):
        n_wrong = ((F < 0) | (F >= len(P))).any(axis=1).sum()
        raise ValueError(
            f"triangles need vertex indices 0..{len(P) - 1}, as there are {len(P)} vertices; "
            f"found {F.min()}..{F.max()}, {n_wrong} triangles out of range"
        )
    return P, F.astype(np.int64)


def _drop_nonfinite(P, F, strict, counts):
    bad = ~np.isfinite(P).all(axis=1)
    counts["nonfinite_vertices"] = int(bad.sum())
    which = f"{bad.sum()} of {len(P)} vertices are not finite"
    if strict and bad.any():
        raise ValueError(f"{which}; strict=False removes them")
    F = F[~bad[F].any(axis=1)] if bad.any() else F
    if len(F) == 0:
        raise ValueError(f"no triangle with finite vertices; {which}")
    return F


def check_range(P: Array, F: Array) -> None:
    """Raise ValueError if coordinates are outside the numerical range.

    Parameters
    ----------
    P : float ndarray (p, 3)
    F : int ndarray (m, 3)
        Other vertices are not checked.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.clean import check_range
    >>> check_range(1e20 * np.eye(3), np.array([[0, 1, 2]]))
    Traceback (most recent call last):
    ValueError: coordinates of at most 1e+15 needed, found 1.0e+20: scale the file
    """
    X = P[np.bincount(F.ravel(), minlength=len(P)) > 0]
    size = np.abs(X).max()
    if size > LARGEST:
        raise ValueError(
            f"coordinates of at most {LARGEST:.0e} needed, found {size:.1e}: scale the file"
        )
    extent = np.ptp(X, axis=0).max()  # a norm would underflow
    if 0 < extent < 1 / LARGEST:
        raise ValueError(
            f"an extent of at least {1 / LARGEST:.0e} needed, found {extent:.1e}: scale the file"
        )
    precision = "float32" if np.array_equal(X, X.astype(np.float32)) else "float64"
    if size > _FARTHEST[precision] * extent > 0:
        raise ValueError(
            f"the shape is lost in rounding: the extent is {extent:.2g}, but {precision} "
            f"coordinates reach {size:.1e}; subtract the offset before the file is written"
        )


def _weld(P, F, counts):
    """Group of coincident vertices of each row of P, -1 if no triangle uses it."""
    used = np.flatnonzero(np.bincount(F.ravel()))
    X = P[used]
    side = _sides(P, F)
    if not side.any():
        raise ValueError(f"a surface with area needed; all {len(F)} triangles are points")
    # the median side limits the tolerance if an outlier enlarges the bounding box
    tolerance = _RELATIVE_TOLERANCE * np.linalg.norm(np.ptp(X, axis=0))
    if side.min() < 1e3 * tolerance:
        tolerance = min(tolerance, 1e-3 * np.median(side[side > 0]))
    group = np.full(len(P), -1)
    group[used] = components(_near_pairs(X, tolerance), len(X))
    counts["welded_vertices"] = int(len(used) - group.max() - 1)
    return group, tolerance


def _near_pairs(X, tolerance):
    """Pairs of points within the tolerance ``(p, 2)``; each copy of a point is in one pair."""
    # candidates are within the tolerance along a line too: few, even on a voxel lattice
    along = ((X - np.median(X, axis=0)) * np.sqrt(np.arange(1, 4) / 6)).sum(1)
    order = np.argsort(along)
    close = np.diff(along[order]) <= 1.001 * tolerance  # with a margin for rounding
    near = order[np.append(close, False) | np.append(False, close)]
    first, copy_of = equal_rows(X[near])
    distinct = near[first]
    tree = cKDTree(X[distinct], balanced_tree=False, compact_nodes=False)
    n_distinct = len(X) - len(near) + len(distinct)
    neighbours = tree.count_neighbors(tree, tolerance) / n_distinct
    if neighbours > 100:  # the pairs would fill the memory
        raise ValueError(
            f"distinct vertices needed; each has {neighbours:.0f} others within 1e-7 of the extent "
            f"({tolerance:.1e})"
        )
    pairs = distinct[tree.query_pairs(tolerance, output_type="ndarray").astype(np.int64)]
    return np.concatenate([pairs, np.stack([near, distinct[copy_of]], axis=1)])


def _drop_repeated(F, group, counts):
    """Drop triangles that repeat a corner, and duplicate triangles."""
    T = np.sort(group[F], axis=1)
    good = (T[:, 0] != T[:, 1]) & (T[:, 1] != T[:, 2])
    counts["degenerate_triangles"] = int((~good).sum())
    if not good.all():
        F, T = F[good], T[good]
    first, inverse = equal_rows(T)
    counts["duplicate_triangles"] = len(T) - len(first)
    if len(first) == len(T):
        return F
    copies = np.bincount(inverse)
    cancel = _touching_components(T[first], copies % 2 == 0)
    counts["duplicate_triangles"] += int(cancel.sum())
    return F[np.sort(first[~cancel])]


def _touching_components(T, even):
    """Mask of the triangles with an even number of copies where two surfaces touch.

    Around a patch where surfaces touch, the other triangles meet in pairs: keeping one copy would
    leave a fin.  Around a superfluous copy they are single.  Each patch is decided by the majority
    of the edges around it.
    """
    E, edge_of, count = unique_edges(T)
    triangle = np.tile(np.arange(len(T)), 3)  # of each half-edge
    inside = even[triangle]
    n_inside = np.bincount(edge_of, inside, len(E)).astype(int)
    links = np.stack([triangle[inside], len(T) + edge_of[inside]], axis=1)
    patch = components(links, len(T) + len(E))
    around = inside & (n_inside[edge_of] % 2 == 1)
    outside = (count - n_inside)[edge_of[around]]
    votes = np.where(outside == 0, 0, np.where(outside % 2 == 0, 1, -1))
    total = np.bincount(patch[triangle[around]], votes, len(T) + len(E))
    return even & (total[patch[: len(T)]] > 0)


def _flip_flat(P, F, group, tolerance, counts, iterations=50):
    """Remove triangles lower than the tolerance, whose middle vertex lies on the long edge.

    Deleting such a triangle would open a crack, so its long edge is flipped with the neighbour.
    Triangles whose long edge is a boundary, and degenerate ones that no flip improves, are deleted.
    """
    F, alive = F.copy(), np.ones(len(F), bool)
    suspects = np.arange(len(F))
    for _ in range(iterations):
        suspects = suspects[alive[suspects] & (_heights(P, F[suspects])[0] <= tolerance)]
        if len(suspects) == 0:
            break
        ring = np.flatnonzero(alive & np.isin(group[F], group[F[suspects]]).any(axis=1))
        flat = np.searchsorted(ring, suspects)
        pairs, flipped, at_boundary = _flips(P, F[ring], group, flat, tolerance)
        if len(pairs) == 0 and len(at_boundary) == 0:
            break
        F[ring[pairs]] = flipped
        alive[ring[np.setdiff1d(at_boundary, pairs)]] = False
        suspects = np.union1d(suspects, ring[pairs])
        counts["flipped_edges"] += len(pairs)
    alive[suspects[_heights(P, F[suspects])[0] <= 1e-3 * tolerance]] = False
    counts["flat_triangles"] = int((~alive).sum())
    return F[alive]


def _flips(P, F, group, flat, tolerance):
    """Find flips of the long edges of flat triangles, each triangle in at most one.

    Returns
    -------
    pairs : int ndarray (c, 2)
        The triangles to replace: a flat one and its neighbour across the long edge.
    flipped : int ndarray (c, 2, 3)
        Their replacements.
    at_boundary : int ndarray
        The flat triangles whose long edge is a boundary.
    """
    #      d                   d
    #    /   \               / | \       q p b is flat: b lies on the long edge, or beyond it;
    #   p-----q     ->      p  |  q      p q d, which has the area, keeps its orientation
    #    \.b./               \.b./
    m, corner = len(F), F.T.ravel()  # corner h starts half-edge h
    E, edge_of, count = unique_edges(group[F], len(P))
    half = flat + m * _heights(P, F[flat])[1]
    at_boundary = flat[count[edge_of[half]] == 1]
    mate = _manifold_mates(edge_of, count)[half]
    half, mate = half[mate >= 0], mate[mate >= 0]
    p = corner[mate]
    q = corner[(mate + m) % (3 * m)]
    d = corner[(mate + 2 * m) % (3 * m)]
    b = corner[(half + 2 * m) % (3 * m)]
    pairs = np.stack([half, mate], axis=1) % m
    flipped = np.stack([np.stack([p, b, d], axis=1), np.stack([b, q, d], axis=1)], axis=1)
    # an edge b-d must not exist, nor be made twice
    new_edge = np.sort(group[np.stack([b, d], axis=1)], axis=1) @ [len(P), 1]
    is_new = (group[b] != group[d]) & ~np.isin(new_edge, E @ [len(P), 1])
    # accept a flip if neither triangle is then flat, or if it shortens the edge (no cycles)
    before = np.linalg.norm(P[p] - P[q], axis=1)
    after = np.linalg.norm(P[b] - P[d], axis=1)
    height = _heights(P, flipped.reshape(-1, 3))[0].reshape(-1, 2).min(axis=1)
    good = np.flatnonzero(is_new & ((height > tolerance) | (after < before)))
    good = good[cheapest(-before[good], pairs[good])]
    good = good[np.unique(new_edge[good], return_index=True)[1]]
    return pairs[good], flipped[good], at_boundary


def _heights(P, F):
    """Height of each triangle over its longest side, and first corner of that side."""
    side = _sides(P, F)
    double_area = np.linalg.norm(triangle_normals(P, F), axis=1)
    return double_area / np.maximum(side.max(axis=0), 1e-300), side.argmax(axis=0)


def _sides(P, F):
    """Lengths of the sides 0-1, 1-2 and 2-0 of each triangle ``(3, m)``."""
    a, b, c = (P.take(corner, axis=0) for corner in F.T)
    return np.stack([np.sqrt(np.einsum("ij,ij->i", v, v)) for v in (a - b, b - c, c - a)])


def _keep_components(X, T, boundary, wanted, counts):
    """Keep the `wanted` components, oriented outwards; return T and the mask of vertices."""
    label = components(np.concatenate([T[:, :2], T[:, 1:]]), len(X))
    n = label.max() + 1
    area = np.bincount(label[T[:, 0]], triangle_areas(X, T), n)
    order = np.argsort(-area, kind="stable")
    share = area[order[0]] / area.sum()
    if wanted == "largest" and share < 0.5:
        n_enough = int(np.searchsorted(np.cumsum(area[order]), 0.9 * area.sum())) + 1
        raise ValueError(
            f"the largest of {n} components has {100 * share:.1f} % of the area, under half; "
            f"say how many belong to the shape: components={n_enough} keeps 90 %, "
            f'components="all" keeps all'
        )
    keep = np.zeros(n, bool)
    keep[order[: {"largest": 1, "all": n}.get(wanted, wanted)]] = True
    counts["components"] = int(n)
    counts["dropped_components"] = int(n - keep.sum())
    counts["area_dropped"] = float(area[~keep].sum() / area.sum())
    T = T[keep[label[T[:, 0]]]]
    T, n_flipped = _orient_outwards(X, T, boundary, label, n)
    counts["reoriented_triangles"] += n_flipped
    return T, keep[label]


def _orient_outwards(X, T, boundary, label, n):
    """Orient components to enclose a positive volume; return T and the number of flips.

    The volume is measured from the mean of the boundary vertices, or of all vertices if closed.
    """
    weight = np.zeros(len(X))
    weight[boundary] = 1
    closed = np.bincount(label, weight, n) == 0
    weight[closed[label]] = 1
    total = np.maximum(np.bincount(label, weight, n), 1)
    centre = np.stack([np.bincount(label, weight * x, n) / total for x in X.T], axis=1)  # (n, 3)
    component, normal = label[T[:, 0]], triangle_normals(X, T)
    corner = X.take(T[:, 0], axis=0) - centre.take(component, axis=0)
    volume = np.bincount(component, np.einsum("ij,ij->i", corner, normal) / 6, n)
    area = np.bincount(component, np.linalg.norm(normal, axis=1) / 2, n)
    inwards = volume < np.where(closed, 0, -1e-3 * area**1.5)  # a flat open patch has no outside
    flip = inwards[component]
    return np.where(flip[:, None], T[:, ::-1], T), int(flip.sum())


def _count_topology(X, T, boundary, counts):
    """Count holes, Euler characteristic and genus of a manifold with these boundary edges."""
    vertex, ends = np.unique(boundary, return_inverse=True)
    holes = int(components(ends.reshape(-1, 2), len(vertex)).max(initial=-1) + 1)
    chi = len(X) - (3 * len(T) + len(boundary)) // 2 + len(T)  # an inner edge has two triangles
    n = counts["components"] - counts["dropped_components"]
    # chi = 2 - 2 genus - holes, for each component
    counts |= {"holes": holes, "euler_characteristic": chi, "genus": (2 * n - holes - chi) // 2}


def _vertex_of_file(group, new, file_vertex):
    """Vertex of each row of the file, -1 if it was dropped.

    The lowest new vertex at a corner of the row, else at a corner of a vertex welded to it.

    Parameters
    ----------
    group : int ndarray (p,)
        Group of each row of the file.
    new, file_vertex : int ndarray (c,)
        New vertex, and row of the file, of each corner of the triangles.
    """
    none = np.iinfo(np.int64).max

    def lowest(key, n):
        vertex = np.full(n, none)
        np.minimum.at(vertex, key[new >= 0], new[new >= 0])
        return np.where(vertex < none, vertex, -1)

    vertex = lowest(file_vertex, len(group))
    welded = np.r_[lowest(group[file_vertex], group.max() + 1), -1]  # the last for group -1
    return np.where(vertex >= 0, vertex, welded[group]).astype(np.int32)


_MOST_AROUND_EDGE = 16  # edges with more triangles are cut: pairing is quadratic in their number


def _manifold_mates(edge_of, count):
    """Mate of each half-edge ``(3 m,)`` on edges with two triangles, else -1.

    `edge_of` and `count` are those of :func:`s4a.geometry.mesh.unique_edges`.
    """
    order = counting_order(edge_of, len(count))
    start = (np.cumsum(count) - count)[count == 2]
    h, g = order[start], order[start + 1]
    mate = np.full(len(edge_of), -1)
    mate[h], mate[g] = g, h
    return mate


def _join_triangles(P, F, group, counts):
    """Find the mates of all half-edges, and orient the triangles consistently.

    Returns
    -------
    F : int ndarray (m, 3)
        The triangles, some flipped.
    mate : int ndarray (3 m,)
        Mate of each half-edge, -1 at boundaries and cuts.
    """
    _, edge_of, count = unique_edges(group[F], len(P))
    F, mate = _orient(P, F, group, _manifold_mates(edge_of, count), counts)
    if (count > 2).any():
        _, edge_of, count = unique_edges(group[F], len(P))
        counts["nonmanifold_edges"] = int((count > 2).sum())
        pairs, cost = _pairs_around_edges(P, F, group, edge_of, count)
        h, g = pairs[cheapest(cost, pairs)].T
        mate[h], mate[g] = g, h
        F, mate = _orient(P, F, group, mate, counts)
    counts["cut_edges"] = int((mate < 0).sum() - (count == 1).sum())
    return F, mate


def _pairs_around_edges(P, F, group, edge_of, count):
    """All pairs of half-edges on each non-manifold edge, with the cost of joining them.

    Returns
    -------
    pairs : int ndarray (c, 2)
    cost : float ndarray (c,)
        1 - cos of the dihedral angle, more if orientations disagree.  On a tie, the convex pair
        is cheaper, to separate solids that touch in an edge.
    """
    order = counting_order(edge_of, len(count))
    start_of_edge = np.cumsum(count) - count
    blocks = [np.empty((0, 2), np.int64)]
    for k in range(3, _MOST_AROUND_EDGE + 1):
        around = order[start_of_edge[count == k][:, None] + np.arange(k)]  # (edges, k) half-edges
        blocks += [around[:, [i, j]] for i in range(k) for j in range(i + 1, k)]
    pairs = np.concatenate(blocks)
    h, g = pairs.T
    m = len(F)
    normal = triangle_normals(P, F)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(length, np.finfo(float).tiny)  # rounding may leave a length of zero
    start = group[F].T.ravel()
    twisted = start[h] == start[g]
    cos = np.einsum("ij,ij->i", normal[h % m], normal[g % m]) * np.where(twisted, -1, 1)
    corner = F.T.ravel()
    towards = P[corner[(g + 2 * m) % (3 * m)]] - P[corner[h]]  # to the third corner of the mate
    convex = np.einsum("ij,ij->i", normal[h % m], towards) < 0
    return pairs, np.round(1 - cos, 6) + 4 * twisted - 1e-7 * convex


def _orient(P, F, group, mate, counts):
    """Flip triangles until mates run in opposite directions, keeping most of each patch's area.

    Each triangle has two nodes, as it is and flipped.  A patch whose two copies are connected is
    not orientable (a Moebius strip), and is cut where the orientation in the file changes.
    """
    m = len(F)
    h = np.flatnonzero(mate > np.arange(3 * m))
    g = mate[h]
    start = group[F].T.ravel()
    twisted = start[h] == start[g]
    if not twisted.any():
        return F, mate
    t, u = h % m, g % m
    links = np.stack([np.r_[t, t + m], np.r_[u + m * twisted, u + m * ~twisted]], axis=1)
    label = components(links, 2 * m)
    as_is, flipped = label[:m], label[m:]
    area = np.bincount(as_is, triangle_areas(P, F), label.max() + 1)
    tie = (area[flipped] == area[as_is]) & (flipped < as_is)
    flip = (area[flipped] > area[as_is]) | tie
    cut = twisted & (as_is == flipped)[t]
    mate[h[cut]] = mate[g[cut]] = -1
    counts["reoriented_triangles"] += int(flip.sum())
    return _reverse(F, mate, np.flatnonzero(flip))


def _reverse(F, mate, t):
    """Exchange corners 0 and 1 of triangles t: half-edge 0 stays, 1 and 2 are exchanged."""
    m, F = len(F), F.copy()
    F[t] = F[t][:, [1, 0, 2]]
    moved = np.arange(3 * m)
    moved[t + m] = t + 2 * m
    moved[t + 2 * m] = t + m
    mate = mate[moved]
    return F, np.where(mate >= 0, moved[mate], -1)


def _join_corners(F, mate):
    """Vertices as sets of corners joined by mates, one for each fan of triangles.

    A bow-tie vertex, or the end of a split edge, becomes several vertices.

    Returns
    -------
    V : int ndarray (m, 3)
        New vertex of each corner.
    file_vertex : int ndarray (n,)
        The lowest row of the file of each vertex.
    """
    # next corner around the vertex: that of the mate of the half-edge before, which ends there
    m = len(F)
    following, corner = np.roll(mate, m), np.arange(3 * m)
    links = np.where(following >= 0, following, corner), np.arange(3 * m + 1)
    graph = sp.csr_matrix((np.ones(3 * m), *links), (3 * m, 3 * m))
    label = connected_components(graph, directed=False)[1]
    file_vertex = np.full(label.max() + 1, np.iinfo(np.int64).max)
    np.minimum.at(file_vertex, label, F.T.ravel())
    order = counting_order(file_vertex, F.max() + 1)
    rank = np.empty_like(file_vertex)
    rank[order] = np.arange(len(order))
    return rank.take(label).reshape(3, m).T, file_vertex[order]


def _split_double_edges(X, V, file_vertex, mate, counts):
    """Insert a midpoint for each of two surfaces that share both ends of an edge.

    Returns
    -------
    X : float ndarray (n + s, 3)
        The midpoints are appended.
    V : int ndarray (m', 3)
        Triangles with midpoints are subdivided.
    file_vertex : int ndarray (n + s,)
    """
    m, n = len(V), len(X)
    E, edge_of, count = unique_edges(V, n)
    start = V.T.ravel()
    balance = np.bincount(edge_of, np.where(start < np.roll(start, -m), 1, -1))
    double = (count > 2) | ((count == 2) & (balance != 0))
    half = np.flatnonzero(double[edge_of])
    if len(half) == 0:
        return X, V, file_vertex
    joined = np.where(mate[half] >= 0, np.minimum(mate[half], half), half)
    edges, inverse = np.unique(joined, return_inverse=True)
    midpoint = np.full(3 * m, -1)
    midpoint[half] = n + inverse
    M = midpoint.reshape(3, m).T  # (m, 3) the midpoint of each side, or -1
    #        r             corners are rotated until a exists;
    #      / | \           without c there is no triangle a-c-p, without b no a-q-b
    #    c   |   b
    #   /  \ | /  \
    #  p-----a-----q
    t = np.flatnonzero((M >= 0).any(axis=1))
    turn = ((M[t] >= 0).argmax(axis=1)[:, None] + np.arange(3)) % 3
    p, q, r = np.take_along_axis(V[t], turn, 1).T
    a, b, c = np.take_along_axis(M[t], turn, 1).T
    b = np.where(b < 0, r, b)
    c = np.where(c < 0, p, c)
    corners = [(a, q, b), (a, b, r), (a, r, c), (a, c, p)]
    fan = np.concatenate([np.stack(triangle, axis=1) for triangle in corners])
    fan = fan[(fan[:, 0] != fan[:, 2]) & (fan[:, 1] != fan[:, 2])]
    ends = E[edge_of[edges]]
    counts["inserted_vertices"] = len(edges)
    X = np.concatenate([X, X[ends].mean(axis=1)])
    V = np.concatenate([np.delete(V, t, axis=0), fan])
    return X, V, np.r_[file_vertex, file_vertex[ends].min(axis=1)]


def cheapest(cost: Array, ends: Array) -> Array:
    """Greedy matching: mask of the pairs taken in order of cost, each end once.

    Parameters
    ----------
    cost : float ndarray (c,)
    ends : int ndarray (c, 2)
    """
    if len(cost) == 0:
        return np.zeros(0, bool)
    rank = np.argsort(np.argsort(cost, kind="stable"))
    items, ends = np.unique(ends, return_inverse=True)
    ends = ends.reshape(-1, 2)
    taken, used = np.zeros(len(cost), bool), np.zeros(len(items), bool)
    rest = np.arange(len(cost))
    while len(rest):  # take all pairs that are the best of both ends
        best = np.full(len(items), len(cost))
        np.minimum.at(best, ends[rest], rank[rest, None])
        win = rest[(best[ends[rest]] == rank[rest, None]).all(axis=1)]
        taken[win] = True
        used[ends[win]] = True
        rest = rest[~used[ends[rest]].any(axis=1)]
    return taken


def fill_holes(X: Array, T: Array) -> tuple[Array, Array, Array]:
    """Close every boundary loop of an oriented manifold by a fan around a new vertex.

    The new vertex is the mean of the loop, weighted by edge length.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)

    Returns
    -------
    X : float ndarray (n + h, 3)
        With a vertex for each of h loops.
    T : int ndarray (m + b, 3)
        With a triangle for each of b boundary edges.
    nearby : int ndarray (h,)
        A vertex of each loop.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.clean import fill_holes
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> X, T, nearby = fill_holes(X, np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    >>> X[4].round(2).tolist(), T[3:].tolist(), nearby.tolist()
    ([0.35, 0.35, 0.0], [[1, 0, 4], [2, 1, 4], [0, 2, 4]], [0])
    """
    E, n = directed_edges(T), len(X)
    E = E[~np.isin(E @ [n, 1], E[:, ::-1] @ [n, 1])]
    boundary, ends = np.unique(E, return_inverse=True)
    ends = ends.reshape(-1, 2)
    label = components(ends, len(boundary))
    loop, h = label[ends[:, 0]], label.max(initial=-1) + 1  # loop of each edge
    length = np.linalg.norm(X[E[:, 0]] - X[E[:, 1]], axis=1)
    weight = length / np.bincount(loop, length, h)[loop] if len(E) else length
    centre = np.stack([np.bincount(loop, weight * X[E, i].mean(1), h) for i in range(3)], axis=1)
    fans = np.column_stack([E[:, 1], E[:, 0], n + loop])
    nearby = np.full(h, n)
    np.minimum.at(nearby, loop, E[:, 0])
    return np.concatenate([X, centre]), np.concatenate([T, fans]), nearby
