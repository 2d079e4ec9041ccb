"""Cleaning (4.1, before step 1): from the triangles of a file to an oriented manifold surface.

What makes the triangles a manifold, edge by edge, is in :mod:`s4a.input.clean`, which says how
half-edges are counted.
"""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from s4a.geometry.mesh import (
    as_arrays,
    as_dataset,
    components,
    counting_order,
    directed_edges,
    equal_rows,
    euler_characteristic,
    n_used,
    triangle_areas,
    triangle_normals,
    unique_edges,
)
from s4a.options import check_components
from s4a.schema import require

# of the diagonal of the bounding box: nearer vertices are one, lower triangles are flat
_RELATIVE_TOLERANCE = 1e-7
# largest coordinate, and one over the least extent: sums of squares stay in float32, which holds
# the displacements (1e-38 to 3e38)
LARGEST = 1e15
# largest coordinate beside the extent: from here on rounding is over 1 % of the extent in float32;
# in float64 the frame of a shape is 1e-4 of its extent off (measured for offsets of 1e13 and 1e14)
_FARTHEST = {"float32": 1e5, "float64": 1e11}

REPAIRS = {
    "nonfinite_vertices": "non-finite vertices removed",
    "welded_vertices": "vertices welded",
    "degenerate_triangles": "triangles with repeated corners dropped",
    "duplicate_triangles": "duplicate triangles dropped",
    "flipped_edges": "edges of zero-area triangles flipped",
    "flat_triangles": "zero-area triangles dropped",
    "nonmanifold_edges": "non-manifold edges separated",
    "cut_edges": "sides of edges cut open",
    "split_vertices": "vertices added by splitting non-manifold ones",
    "inserted_vertices": "vertices inserted on edges that met twice",
    "reoriented_triangles": "triangles reoriented",
    "dropped_components": "components dropped",
    "unreferenced_vertices": "vertices without triangles dropped",
    "closed_holes": "holes closed",
}
_SINGULAR = {
    "vertices": "vertex",
    "triangles": "triangle",
    "edges": "edge",
    "sides": "side",
    "components": "component",
    "holes": "hole",
}


def clean(
    mesh: xr.Dataset,
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
) -> xr.Dataset:
    """Make a mesh an oriented edge- and vertex-manifold surface.

    Vertices nearer than 1e-7 of the bounding-box diagonal are welded, degenerate and duplicate
    triangles dropped, zero-area triangles removed by flipping their long edge (collapsed where two
    of their corners weld), non-manifold edges and vertices separated into sheets, triangles
    oriented consistently and outwards, small components dropped. Holes stay as they are unless
    `close_holes` is set.

    Parameters
    ----------
    mesh : Dataset
        With ``position(vertex, xyz)`` and ``corner_vertex(triangle, corner)``.
    components : "largest", "all" or int
        Keep the component with the largest area, all of them, or that many of the largest.
    strict : bool
        Refuse vertices that are not finite instead of removing them with their triangles.
    close_holes : bool
        Close every hole by a fan of triangles around a new vertex, see
        :func:`s4a.input.clean.fill_holes`.

    Returns
    -------
    Dataset
        With ``position``, ``corner_vertex``, ``file_vertex`` (several vertices share one where it
        was split) and ``vertex_of_file``; what was found and repaired is counted in the attributes,
        see :func:`clean_arrays`, and summed up as ``status`` (ok or repaired) and ``reason``.

    Raises
    ------
    ValueError
        When indices are out of range, coordinates are too large or too near to each other to
        compute with, nothing is left, or the largest component has under half of the area.

    Examples
    --------
    >>> import s4a
    >>> from s4a.geometry.mesh import as_dataset
    >>> tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 1, 3]]  # one twice
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
        kept = counted(counts["holes"], "holes kept as boundary (close_holes=True closes them)")
        reason = "; ".join(filter(None, [reason, kept]))
    attrs = {**mesh.attrs, **counts, "status": status, "reason": reason}
    return as_dataset(X, T, attrs, file_vertex=file_vertex, vertex_of_file=vertex_of_file)


def clean_arrays(
    points: np.ndarray,
    triangles: np.ndarray,
    *,
    components: str | int = "largest",
    strict: bool = False,
    close_holes: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, int | float]]:
    """Clean a surface of arrays as :func:`clean` does a Dataset.

    Returns
    -------
    X : float ndarray (n, 3)
    T : int32 ndarray (m, 3)
    file_vertex : int32 ndarray (n,)
        Row of `points` that each vertex is; a vertex inserted on an edge has that of one end, one
        in a hole that of a vertex around it.
    vertex_of_file : int32 ndarray (len(points),)
        A vertex that each row of `points` became, -1 where it was dropped.
    counts : dict of str to int
        The keys of :data:`REPAIRS`, sizes of the input (``file_vertices``, ``file_triangles``),
        ``components`` found, and of the result ``holes`` (boundary loops), ``euler_characteristic``
        and ``genus`` (sum over components); and ``area`` and ``area_dropped``, the share of it in
        the dropped components.
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
    X, T, file_vertex = _split_double_edges(P[file_vertex], V, file_vertex, mate, counts)
    X, T, kept = _keep_components(X, T, components, counts)
    new = np.where(kept, np.cumsum(kept) - 1, -1)
    T, file_vertex = new[T], file_vertex[kept]
    if close_holes:
        X, T, nearby = fill_holes(X, T)
        file_vertex = np.r_[file_vertex, file_vertex[nearby]]
        counts["closed_holes"] = len(nearby)
    _count_topology(T, counts)
    counts["area"] = float(triangle_areas(X, T).sum())
    vertex_of_file = _vertex_of_file(group, new[V].ravel(), F.ravel())
    return X, T.astype(np.int32), file_vertex.astype(np.int32), vertex_of_file, counts


def repairs(counts: dict[str, int | float]) -> str:
    """What was repaired, in words; empty when the file was a clean surface.

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
    """A number before what it counts, which is one or many.

    Examples
    --------
    >>> from s4a.input.clean import counted
    >>> counted(1, "holes closed"), counted(2, "holes closed")
    ('1 hole closed', '2 holes closed')
    """
    if n == 1:
        many = next(word for word in text.split() if word in _SINGULAR)
        text = text.replace(many, _SINGULAR[many], 1)
    return f"{n} {text}"


def check_arrays(points: ArrayLike, triangles: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Points ``(n, 3)`` as float64 and triangles ``(m, 3)`` as int64, or ValueError."""
    P, F = np.asarray(points, np.float64), np.asarray(triangles)
    if P.ndim != 2 or P.shape[1] != 3 or F.ndim != 2 or F.shape[1] != 3 or len(F) == 0:
        raise ValueError(
            f"a mesh needs points (n, 3) and triangles (m, 3); found {P.shape} and {F.shape}"
        )
    if not np.issubdtype(F.dtype, np.integer):
        raise ValueError(f"triangles need integer vertex indices; found {F.dtype}")
    if F.min() < 0 or F.max() >= len(P):
        wrong = ((F < 0) | (F >= len(P))).any(axis=1).sum()
        raise ValueError(
            f"triangles need vertex indices 0..{len(P) - 1}, as there are {len(P)} vertices; "
            f"found {F.min()}..{F.max()}, {wrong} triangles out of range"
        )
    return P, F.astype(np.int64)


def _drop_nonfinite(P, F, strict, counts):
    bad = ~np.isfinite(P).all(axis=1)
    counts["nonfinite_vertices"] = int(bad.sum())
    which = f"{bad.sum()} of {len(P)} vertices are not finite"
    if strict and bad.any():
        raise ValueError(f"{which}; strict=False removes them")
    F = F[~bad[F].any(axis=1)]
    if len(F) == 0:
        raise ValueError(f"no triangle with finite vertices; {which}")
    return F


def check_range(P: np.ndarray, F: np.ndarray) -> None:
    """ValueError where coordinates are too large, or too near to each other, to compute with.

    Parameters
    ----------
    P : float ndarray (p, 3)
    F : int ndarray (m, 3)
        Vertices in none of these triangles are not looked at.

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
            f"the shape is lost in rounding: its extent is {extent:.2g}, its coordinates, which "
            f"are of {precision}, reach {size:.1e}; subtract the offset before it is written"
        )


def _weld(P, F, counts):
    """The group of coincident vertices of each row of P, -1 where no triangle uses it."""
    used = np.flatnonzero(np.bincount(F.ravel()))
    X = P[used]
    side = _sides(P, F)
    if not side.any():
        raise ValueError(f"a surface needs extent; all {len(F)} triangles are points")
    # the median side guards against a far outlier, whose bounding box would weld the whole shape
    diagonal = np.linalg.norm(np.ptp(X, axis=0))
    tolerance = min(_RELATIVE_TOLERANCE * diagonal, 1e-3 * np.median(side[side > 0]))
    first, place = equal_rows(X)
    label = components(_near_pairs(X[first], tolerance), len(first))
    group = np.full(len(P), -1)
    group[used] = label[place]
    counts["welded_vertices"] = int(len(used) - label.max() - 1)
    return group, tolerance


def _near_pairs(X, tolerance):
    """Pairs of points within the tolerance ``(p, 2)``."""
    # candidates have another so near along a line: few even of a lattice of voxels
    along = (X - np.median(X, axis=0)) @ (np.sqrt([1.0, 2.0, 3.0]) / np.sqrt(6))
    order = np.argsort(along)
    close = np.diff(along[order]) <= 1.001 * tolerance  # with what rounding may add
    near = order[np.append(close, False) | np.append(False, close)]
    tree = cKDTree(X[near], balanced_tree=False, compact_nodes=False)
    crowd = tree.count_neighbors(tree, tolerance) / len(X)
    if crowd > 100:  # the pairs would fill the memory
        raise ValueError(
            f"vertices crowd: each has {crowd:.0f} others within 1e-7 of the extent "
            f"({tolerance:.1e})"
        )
    return near[tree.query_pairs(tolerance, output_type="ndarray").astype(np.int64)]


def _drop_repeated(F, group, counts):
    """Without triangles that repeat a corner, and of triangles with the same corners one."""
    T = np.sort(group[F], axis=1)
    good = (T[:, 0] != T[:, 1]) & (T[:, 1] != T[:, 2])
    counts["degenerate_triangles"] = int((~good).sum())
    F, T = F[good], T[good]
    first, place = equal_rows(T)
    counts["duplicate_triangles"] = len(T) - len(first)
    if len(first) == len(T):
        return F
    copies = np.bincount(place)
    cancel = _touching_components(T[first], copies % 2 == 0)
    counts["duplicate_triangles"] += int(cancel.sum())
    return F[np.sort(first[~cancel])]


def _touching_components(T, even):
    """Where two sheets touch, among the triangles that lie there an even number of times.

    Around a patch of them the other triangles meet in pairs, so that to keep one copy would leave a
    fin; around a superfluous copy they are single.  Decided patch by patch, by most of the edges
    around it that have others.
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
    """Without triangles lower than the tolerance, whose middle vertex lies on the long edge.

    To delete one would open a crack: the long edge is flipped with the neighbour across.  Deleted
    are those whose long edge is a boundary, where nothing opens, and those that no flip helps and
    that have no height at all.
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
    """Flips of the long edges of flat triangles, each triangle in one at most.

    Returns
    -------
    pairs : int ndarray (c, 2)
        The triangles to be replaced: a flat one and its neighbour across the long edge.
    flipped : int ndarray (c, 2, 3)
        What replaces them.
    at_boundary : int ndarray
        The flat triangles whose long edge is a boundary.
    """
    #      d                   d
    #    /   \               / | \       q p b is flat: b lies on the long edge, and may lie beyond;
    #   p-----q     ->      p  |  q      p q d keeps its orientation, as it has the area
    #    \.b./               \.b./
    m, corner = len(F), F.T.ravel()  # corner h starts half-edge h, see s4a.input.clean
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
    # an edge b-d must not be there already, nor arise twice
    new_edge = np.sort(group[np.stack([b, d], axis=1)], axis=1) @ [len(P), 1]
    is_new = (group[b] != group[d]) & ~np.isin(new_edge, E @ [len(P), 1])
    # it helps if neither is flat then, or if the edge gets shorter: no endless turns
    before = np.linalg.norm(P[p] - P[q], axis=1)
    after = np.linalg.norm(P[b] - P[d], axis=1)
    height = _heights(P, flipped.reshape(-1, 3))[0].reshape(-1, 2).min(axis=1)
    good = np.flatnonzero(is_new & ((height > tolerance) | (after < before)))
    good = good[cheapest(-before[good], pairs[good])]
    good = good[np.unique(new_edge[good], return_index=True)[1]]
    return pairs[good], flipped[good], at_boundary


def _heights(P, F):
    """Height of each triangle over its longest side, and the first corner of that side."""
    side = _sides(P, F)
    double_area = np.linalg.norm(triangle_normals(P, F), axis=1)
    return double_area / np.maximum(side.max(axis=1), 1e-300), side.argmax(axis=1)


def _sides(P, F):
    """Lengths of the sides 0-1, 1-2 and 2-0 of each triangle ``(m, 3)``."""
    a, b, c = (P.take(corner, axis=0) for corner in F.T)
    return np.stack([np.sqrt(np.einsum("ij,ij->i", v, v)) for v in (a - b, b - c, c - a)], axis=1)


def _keep_components(X, T, wanted, counts):
    """The components asked for, outwards, in the old numbering; and the mask of their vertices."""
    label = components(np.concatenate([T[:, :2], T[:, 1:]]), len(X))
    n = label.max() + 1
    area = np.bincount(label[T[:, 0]], triangle_areas(X, T), n)
    order = np.argsort(-area, kind="stable")
    share = area[order[0]] / area.sum()
    if wanted == "largest" and share < 0.5:
        enough = int(np.searchsorted(np.cumsum(area[order]), 0.9 * area.sum())) + 1
        raise ValueError(
            f"the largest of {n} components has {100 * share:.1f} % of the area, under half; "
            f"say how many belong to the shape: components={enough} holds 90 %, "
            f'components="all" keeps all'
        )
    keep = np.zeros(n, bool)
    keep[order[: {"largest": 1, "all": n}.get(wanted, wanted)]] = True
    counts["components"] = int(n)
    counts["dropped_components"] = int(n - keep.sum())
    counts["area_dropped"] = float(area[~keep].sum() / area.sum())
    T = T[keep[label[T[:, 0]]]]
    T, n_turned = _turn_outwards(X, T, label, n)
    counts["reoriented_triangles"] += n_turned
    return X[keep[label]], T, keep[label]


def _turn_outwards(X, T, label, n):
    """Turn components so that they enclose a positive volume; say how many triangles were turned.

    An open one is seen from the middle of its boundary, a closed one from that of its vertices.
    """
    E, _, count = unique_edges(T, len(X))
    weight = np.zeros(len(X))
    weight[E[count == 1]] = 1  # on the boundary
    closed = np.bincount(label, weight, n) == 0
    weight[closed[label]] = 1
    total = np.maximum(np.bincount(label, weight, n), 1)
    centre = np.stack([np.bincount(label, weight * x, n) / total for x in X.T], axis=1)  # (n, 3)
    component = label[T[:, 0]]
    a, b, c = (X.take(T[:, i], axis=0) - centre.take(component, axis=0) for i in range(3))
    volume = np.bincount(component, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, n)
    area = np.bincount(component, triangle_areas(X, T), n)
    inwards = volume < np.where(closed, 0, -1e-3 * area**1.5)  # a flat open patch has no outside
    turned = inwards[component]
    return np.where(turned[:, None], T[:, ::-1], T), int(turned.sum())


def _count_topology(T, counts):
    E, _, count = unique_edges(T)
    boundary, ends = np.unique(E[count == 1], return_inverse=True)
    holes = int(components(ends.reshape(-1, 2), len(boundary)).max(initial=-1) + 1)
    chi = int(euler_characteristic(T, E))
    kept = counts["components"] - counts["dropped_components"]
    # chi = 2 - 2 genus - holes, of each component
    counts |= {"holes": holes, "euler_characteristic": chi, "genus": (2 * kept - holes - chi) // 2}


def _vertex_of_file(group, new, file_vertex):
    """The vertex that each row of the file became, -1 where it was dropped.

    It is the first new vertex at a corner of the file's vertex, else of one welded to it.

    Parameters
    ----------
    group : int ndarray (p,)
        Of each row of the file.
    new, file_vertex : int ndarray (c,)
        Of each corner of the triangles.
    """
    nothing = np.iinfo(np.int64).max

    def first(key, n):
        vertex = np.full(n, nothing)
        np.minimum.at(vertex, key[new >= 0], new[new >= 0])
        return np.where(vertex < nothing, vertex, -1)

    own = first(file_vertex, len(group))
    welded = np.r_[first(group[file_vertex], group.max() + 1), -1]  # the last for group -1
    return np.where(own >= 0, own, welded[group]).astype(np.int32)


_MOST_AROUND_EDGE = 16  # an edge with more triangles is cut: pairing takes their number squared


def _manifold_mates(edge_of, count):
    """The mate of each half-edge ``(3 m,)`` on edges with two triangles, else -1.

    `edge_of` and `count` are those of :func:`s4a.geometry.mesh.unique_edges`.
    """
    order = counting_order(edge_of, len(count))
    first = (np.cumsum(count) - count)[count == 2]
    one, other = order[first], order[first + 1]
    mate = np.full(len(edge_of), -1)
    mate[one], mate[other] = other, one
    return mate


def _join_triangles(P, F, group, counts):
    """Find the mates of all half-edges, and orient the triangles consistently.

    Returns
    -------
    F : int ndarray (m, 3)
        The triangles, some turned.
    mate : int ndarray (3 m,)
        Of each half-edge, -1 at boundaries and cuts.
    """
    _, edge_of, count = unique_edges(group[F], len(P))
    F, mate = _orient(P, F, group, _manifold_mates(edge_of, count), counts)
    if (count > 2).any():
        _, edge_of, count = unique_edges(group[F], len(P))
        counts["nonmanifold_edges"] = int((count > 2).sum())
        pairs, cost = _pairs_around_edges(P, F, group, edge_of, count)
        one, other = pairs[cheapest(cost, pairs)].T
        mate[one], mate[other] = other, one
        F, mate = _orient(P, F, group, mate, counts)
    counts["cut_edges"] = int((mate < 0).sum() - (count == 1).sum())
    return F, mate


def _pairs_around_edges(P, F, group, edge_of, count):
    """All pairs of half-edges on each non-manifold edge, and how badly each continues the surface.

    Returns
    -------
    pairs : int ndarray (c, 2)
    cost : float ndarray (c,)
        1 - cos of the bend, more for a pair that disagrees in orientation; between equal bends the
        pair that encloses less of the inside goes first, so that solids that touch in an edge come
        apart.
    """
    order = counting_order(edge_of, len(count))
    first = np.cumsum(count) - count
    found = [np.empty((0, 2), np.int64)]
    for k in range(3, _MOST_AROUND_EDGE + 1):
        around = order[first[count == k][:, None] + np.arange(k)]  # (edges, k) half-edges
        found += [around[:, [i, j]] for i in range(k) for j in range(i + 1, k)]
    pairs = np.concatenate(found)
    h, g = pairs.T
    m = len(F)
    normal = triangle_normals(P, F)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(length, np.finfo(float).tiny)  # some have lost theirs to rounding
    start = group[F].T.ravel()
    twisted = start[h] == start[g]
    cos = np.einsum("ij,ij->i", normal[h % m], normal[g % m]) * np.where(twisted, -1, 1)
    corner = F.T.ravel()
    towards = P[corner[(g + 2 * m) % (3 * m)]] - P[corner[h]]  # to the other one's third corner
    convex = np.einsum("ij,ij->i", normal[h % m], towards) < 0
    return pairs, np.round(1 - cos, 6) + 4 * twisted - 1e-7 * convex


def _orient(P, F, group, mate, counts):
    """Turn triangles so that mates run against each other, most of each patch's area as it was.

    A triangle stands for two nodes, as it is and reversed; a patch whose two copies are connected
    cannot be oriented (a Moebius strip), and is cut where the file's orientation changes.
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
    as_is, turned = label[:m], label[m:]
    area = np.bincount(as_is, triangle_areas(P, F), label.max() + 1)
    tie = (area[turned] == area[as_is]) & (turned < as_is)
    flip = (area[turned] > area[as_is]) | tie
    cut = twisted & (as_is == turned)[t]
    mate[h[cut]] = mate[g[cut]] = -1
    counts["reoriented_triangles"] += int(flip.sum())
    return _reverse(F, mate, np.flatnonzero(flip))


def _reverse(F, mate, t):
    """Exchange corners 0 and 1 of triangles t: half-edge 0 stays, 1 and 2 trade places."""
    m, F = len(F), F.copy()
    F[t] = F[t][:, [1, 0, 2]]
    moved = np.arange(3 * m)
    moved[t + m] = t + 2 * m
    moved[t + 2 * m] = t + m
    mate = mate[moved]
    return F, np.where(mate >= 0, moved[mate], -1)


def _join_corners(F, mate):
    """Vertices as the sets of corners that mates join: one for each umbrella of triangles.

    A bow-tie or the end of a separated edge falls apart into several.

    Returns
    -------
    V : int ndarray (m, 3)
        The triangles' corners as such vertices.
    file_vertex : int ndarray (n,)
        The smallest file vertex of each.
    """
    m = len(F)
    h = np.flatnonzero(mate > np.arange(3 * m))
    g = mate[h]
    # the start of one is the end of the other
    links = np.stack([np.r_[h, (h + m) % (3 * m)], np.r_[(g + m) % (3 * m), g]], axis=1)
    label = components(links, 3 * m)
    file_vertex = np.full(label.max() + 1, np.iinfo(np.int64).max)
    np.minimum.at(file_vertex, label, F.T.ravel())
    order = counting_order(file_vertex, F.max() + 1)
    rank = np.empty_like(file_vertex)
    rank[order] = np.arange(len(order))
    return rank.take(label).reshape(3, m).T, file_vertex[order]


def _split_double_edges(X, V, file_vertex, mate, counts):
    """Give each of two sheets its own midpoint where they share both ends of an edge.

    Returns
    -------
    X : float ndarray (n + s, 3)
        The midpoints appended.
    V : int ndarray (m', 3)
        A triangle with midpoints is replaced by those around them.
    file_vertex : int ndarray (n + s,)
    """
    m, n = len(V), len(X)
    E, edge_of, count = unique_edges(V, n)
    start = V.T.ravel()
    turn = np.bincount(edge_of, np.where(start < np.roll(start, -m), 1, -1))
    double = (count > 2) | ((count == 2) & (turn != 0))
    half = np.flatnonzero(double[edge_of])
    if len(half) == 0:
        return X, V, file_vertex
    sheet = np.where(mate[half] >= 0, np.minimum(mate[half], half), half)
    sheets, middle = np.unique(sheet, return_inverse=True)
    of_half = np.full(3 * m, -1)
    of_half[half] = n + middle
    M = of_half.reshape(3, m).T  # (m, 3) the midpoint of each side, or -1
    #        r             a is there: the sides are turned until it is;
    #      / | \           without c the triangle a-c-p is none, without b it is a-q-b
    #    c   |   b
    #   /  \ | /  \
    #  p-----a-----q
    t = np.flatnonzero((M >= 0).any(axis=1))
    turn = ((M[t] >= 0).argmax(axis=1)[:, None] + np.arange(3)) % 3
    p, q, r = np.take_along_axis(V[t], turn, 1).T
    a, b, c = np.take_along_axis(M[t], turn, 1).T
    b = np.where(b < 0, r, b)
    c = np.where(c < 0, p, c)
    parts = [(a, q, b), (a, b, r), (a, r, c), (a, c, p)]
    fan = np.concatenate([np.stack(part, axis=1) for part in parts])
    fan = fan[(fan[:, 0] != fan[:, 2]) & (fan[:, 1] != fan[:, 2])]
    ends = E[edge_of[sheets]]
    counts["inserted_vertices"] = len(sheets)
    X = np.concatenate([X, X[ends].mean(axis=1)])
    V = np.concatenate([np.delete(V, t, axis=0), fan])
    return X, V, np.r_[file_vertex, file_vertex[ends].min(axis=1)]


def cheapest(cost: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Greedy matching: the mask of the pairs taken in order of cost, each end once.

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
    left = np.arange(len(cost))
    while len(left):  # all pairs at once that are the best of both their ends
        best = np.full(len(items), len(cost))
        np.minimum.at(best, ends[left], rank[left, None])
        win = left[(best[ends[left]] == rank[left, None]).all(axis=1)]
        taken[win] = True
        used[ends[win]] = True
        left = left[~used[ends[left]].any(axis=1)]
    return taken


def fill_holes(X: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Close every boundary loop of an oriented manifold by a fan around a new vertex.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)

    Returns
    -------
    X : float ndarray (n + h, 3)
        A vertex for each of h loops is appended, at the mean of the loop weighted by the length of
        its edges.
    T : int ndarray (m + b, 3)
        A triangle for each of b boundary edges is appended.
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
    loop = components(ends, len(boundary))
    of, h = loop[ends[:, 0]], loop.max(initial=-1) + 1
    length = np.linalg.norm(X[E[:, 0]] - X[E[:, 1]], axis=1)
    weight = length / np.bincount(of, length, h)[of] if len(E) else length
    middle = np.stack([np.bincount(of, weight * X[E, i].mean(1), h) for i in range(3)], axis=1)
    fans = np.column_stack([E[:, 1], E[:, 0], n + of])
    nearby = np.full(h, n)
    np.minimum.at(nearby, of, E[:, 0])
    return np.concatenate([X, middle]), np.concatenate([T, fans]), nearby
