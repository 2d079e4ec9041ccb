"""Cleaning: from the triangles of a file to an oriented manifold surface.

Before everything else (4.1).

What makes the triangles a manifold, edge by edge, is in :mod:`s4a.input.manifold`, which says how
half-edges are counted.
"""

import numpy as np
from scipy.spatial import cKDTree

from s4a.geometry.mesh import (
    as_arrays,
    as_dataset,
    components,
    euler_characteristic,
    n_used,
    triangle_areas,
    triangle_normals,
    unique_edges,
)
from s4a.input.manifold import (
    cheapest,
    fill_holes,
    manifold_mates,
    mates,
    split_double_edges,
    umbrellas,
)
from s4a.schema import require

RELATIVE_TOLERANCE = (
    1e-7  # of the diagonal of the bounding box: nearer vertices are one, lower triangles are flat
)

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


def clean(mesh, *, components="largest", strict=False, close_holes=False):
    """A mesh made an oriented edge- and vertex-manifold surface.

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
        :func:`s4a.input.manifold.fill_holes`.

    Returns
    -------
    Dataset
        With ``position``, ``corner_vertex``, ``file_vertex`` (several vertices share one where it
        was split) and ``vertex_of_file``; what was found and repaired is counted in the attributes,
        see :func:`clean_arrays`, and summed up as ``status`` (ok or repaired) and ``reason``.

    Raises
    ------
    ValueError
        When indices are out of range, nothing is left, or the largest component has under half of
        the area.

    Examples
    --------
    >>> import s4a
    >>> from s4a.geometry.mesh import as_dataset
    >>> tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 1, 3]]  # the last triangle is there twice
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
        reason = (
            f"{reason}; " * bool(reason)
            + f"{counts['holes']} holes kept as boundary (close_holes=True closes them)"
        )
    attrs = {**mesh.attrs, **counts, "status": status, "reason": reason}
    return as_dataset(X, T, attrs, file_vertex=file_vertex, vertex_of_file=vertex_of_file)


def clean_arrays(points, triangles, *, components="largest", strict=False, close_holes=False):
    """:func:`clean` on arrays.

    Returns
    -------
    X : float ndarray (n, 3)
    T : int32 ndarray (m, 3)
    file_vertex : int32 ndarray (n,)
        Row of `points` that each vertex is; a vertex inserted on an edge has that of one end, one
        in a hole that of a vertex around it.
    vertex_of_file : int32 ndarray (len(points),)
        A vertex that each row of `points` became, -1 where it was dropped.
    counts : dict of str to int; and ``area``, and ``area_dropped``, the share of it in the dropped
    components
        The keys of :data:`REPAIRS`, sizes of the input (``file_vertices``, ``file_triangles``),
        ``components`` found, and of the result ``holes`` (boundary loops), ``euler_characteristic``
        and ``genus`` (sum over components).
    """
    P, F = _validated(points, triangles, components)
    counts = {"file_vertices": len(P), "file_triangles": len(F), **dict.fromkeys(REPAIRS, 0)}
    counts["unreferenced_vertices"] = len(P) - n_used(F)
    F = _drop_nonfinite(P, F, strict, counts)
    group, tolerance = _weld(P, F, counts)
    F = _drop_repeated(F, group, counts)
    F = _flip_flat(P, F, group, tolerance, counts)
    if len(F) == 0:
        raise ValueError(
            f"a surface needs triangles with area; none of the {counts['file_triangles']} has any"
        )
    F, mate = mates(P, F, group, counts)
    V, file_vertex = umbrellas(F, mate)
    counts["split_vertices"] = len(file_vertex) - n_used(group[F])
    X, T, file_vertex = split_double_edges(P[file_vertex], V, file_vertex, mate, counts)
    X, T, kept = _largest_components(X, T, components, counts)
    new = np.cumsum(kept) - 1
    new[~kept] = -1
    T, file_vertex = new[T], file_vertex[kept]
    if close_holes:
        X, T, nearby = fill_holes(X, T)
        file_vertex = np.r_[file_vertex, file_vertex[nearby]]
        counts["closed_holes"] = len(nearby)
    _count_topology(T, counts)
    counts["area"] = float(triangle_areas(X, T).sum())
    vertex_of_file = _vertex_of_file(group, new[V].ravel(), F.ravel())
    return X, T.astype(np.int32), file_vertex.astype(np.int32), vertex_of_file, counts


def repairs(counts):
    """What was repaired, in words; empty when the file was a clean surface.

    Examples
    --------
    >>> from s4a.input.clean import repairs
    >>> repairs({"welded_vertices": 2, "cut_edges": 0, "dropped_components": 3, "area_dropped": 0.0214})
    '2 vertices welded; 3 components dropped (2.1 % of the area)'
    """
    parts = [f"{counts[name]} {text}" for name, text in REPAIRS.items() if counts.get(name)]
    return "; ".join(
        f"{part} ({100 * counts['area_dropped']:.2g} % of the area)"
        if part.endswith("components dropped")
        else part
        for part in parts
    )


def check_components(components):
    """ValueError unless `components` is "largest", "all" or a number from 1."""
    number = isinstance(components, int | np.integer) and not isinstance(components, bool)
    if components not in ("largest", "all") and not (number and components >= 1):
        raise ValueError(
            f'components needs to be "largest", "all" or a number from 1; found {components!r}'
        )


def _validated(points, triangles, components):
    """The arrays as float64 and int64, or ValueError."""
    P, F = np.asarray(points, np.float64), np.asarray(triangles)
    if P.ndim != 2 or P.shape[1] != 3 or F.ndim != 2 or F.shape[1] != 3 or len(F) == 0:
        raise ValueError(
            f"a mesh needs points (n, 3) and triangles (m, 3); found {P.shape} and {F.shape}"
        )
    if not np.issubdtype(F.dtype, np.integer):
        raise ValueError(f"triangles need integer vertex indices; found {F.dtype}")
    if F.min() < 0 or F.max() >= len(P):
        raise ValueError(
            f"triangles need vertex indices 0..{len(P) - 1}, as there are {len(P)} vertices; "
            f"found {F.min()}..{F.max()}, {((F < 0) | (F >= len(P))).any(axis=1).sum()} triangles out of range"
        )
    check_components(components)
    return P, F.astype(np.int64)


def _drop_nonfinite(P, F, strict, counts):
    bad = ~(np.abs(P) < 1e60).all(
        axis=1
    )  # so that no squared area overflows; false for nan as well
    counts["nonfinite_vertices"] = int(bad.sum())
    if strict and bad.any():
        raise ValueError(
            f"{bad.sum()} of {len(P)} vertices are not finite; strict=False removes them"
        )
    F = F[~bad[F].any(axis=1)]
    if len(F) == 0:
        raise ValueError(
            f"no triangle with finite vertices; {bad.sum()} of {len(P)} vertices are not finite"
        )
    return F


def _weld(P, F, counts):
    """For each row of P the number of its group of coincident vertices (-1 where no triangle uses it)."""
    used = np.flatnonzero(np.bincount(F.ravel()))
    X = P[used]
    side = _sides(P, F)
    if not side.any():
        raise ValueError(f"a surface needs extent; all {len(F)} triangles are points")
    # the median side guards against a far outlier, whose bounding box would weld the whole shape
    diagonal = np.linalg.norm(np.ptp(X, axis=0))
    tolerance = min(RELATIVE_TOLERANCE * diagonal, 1e-3 * np.median(side[side > 0]))
    order = np.lexsort(X.T)
    first = np.r_[True, (X[order[1:]] != X[order[:-1]]).any(axis=1)]
    exact = np.empty(len(X), np.int64)
    exact[order] = np.cumsum(first) - 1
    near = _near_pairs(X[order[first]], tolerance)
    label = components(near, first.sum())
    group = np.full(len(P), -1)
    group[used] = label[exact]
    counts["welded_vertices"] = int(len(used) - label.max() - 1)
    return group, tolerance


def _near_pairs(X, tolerance):
    """Pairs of points within the tolerance ``(p, 2)``.

    Sought among those that have another so near in x, y and z.
    """
    some = np.arange(len(X))
    for x in X.T:
        some = some[np.argsort(x[some])]
        close = np.flatnonzero(np.diff(x[some]) <= tolerance)
        some = some[np.union1d(close, close + 1)]
    tree = cKDTree(X[some], balanced_tree=False, compact_nodes=False)
    crowd = tree.count_neighbors(tree, tolerance) / len(X)
    if crowd > 100:
        raise ValueError(
            f"vertices crowd: each has {crowd:.0f} others within 1e-7 of the extent ({tolerance:.1e})"
        )
    return some[tree.query_pairs(tolerance, output_type="ndarray").astype(np.int64)]


def _drop_repeated(F, group, counts):
    """Without triangles that repeat a corner, and of triangles with the same corners one."""
    T = np.sort(group[F], axis=1)
    good = (T[:, 0] != T[:, 1]) & (T[:, 1] != T[:, 2])
    counts["degenerate_triangles"] = int((~good).sum())
    F, T = F[good], T[good]
    order = np.lexsort(T.T)
    new = np.r_[True, (T[order[1:]] != T[order[:-1]]).any(axis=1)][: len(T)]
    counts["duplicate_triangles"] = int((~new).sum())
    if new.all():
        return F
    copies = np.bincount(np.cumsum(new) - 1)
    kept = order[new]
    cancel = _touching_sheets(T[kept], copies % 2 == 0)
    counts["duplicate_triangles"] += int(cancel.sum())
    return F[np.sort(kept[~cancel])]


def _touching_sheets(T, even):
    """Of the triangles that lie there an even number of times.

    Those where two sheets of a surface touch.

    Around a patch of them the other triangles meet in pairs, so that to keep one copy would leave a
    fin; around a superfluous copy they are single.  Decided patch by patch, by most of the edges
    around it that have others.
    """
    E, edge_of, count = unique_edges(T)
    triangle = np.tile(np.arange(len(T)), 3)
    inside = even[triangle]
    n_inside = np.bincount(edge_of, inside, len(E)).astype(int)
    patch = components(
        np.stack([triangle[inside], len(T) + edge_of[inside]], axis=1), len(T) + len(E)
    )
    around = inside & (n_inside[edge_of] % 2 == 1)
    outside = (count - n_inside)[edge_of[around]]
    votes = np.where(outside == 0, 0, np.where(outside % 2 == 0, 1, -1))
    return even & (
        np.bincount(patch[triangle[around]], votes, len(T) + len(E))[patch[: len(T)]] > 0
    )


def _flip_flat(P, F, group, tolerance, counts, rounds=50):
    """Without triangles lower than the tolerance, whose middle vertex lies on the long edge.

    To delete one would open a crack: the long edge is flipped with the neighbour across.  Deleted
    are those whose long edge is a boundary, where nothing opens, and those that no flip helps and
    that have no height at all.
    """
    F, alive, suspect = F.copy(), np.ones(len(F), bool), np.arange(len(F))
    for _ in range(rounds):
        flat = suspect = suspect[alive[suspect] & (_heights(P, F[suspect])[0] <= tolerance)]
        if len(flat) == 0:
            break
        ring = np.flatnonzero(alive & np.isin(group[F], group[F[flat]]).any(axis=1))
        flipped, pairs, at_boundary = _flips(
            P, F[ring], group, np.searchsorted(ring, flat), tolerance
        )
        if len(pairs) == 0 and len(at_boundary) == 0:
            break
        F[ring[pairs]] = flipped
        alive[ring[np.setdiff1d(at_boundary, pairs)]] = False
        suspect = np.union1d(flat, ring[pairs])
        counts["flipped_edges"] += len(pairs)
    alive[suspect[_heights(P, F[suspect])[0] <= 1e-3 * tolerance]] = False
    counts["flat_triangles"] = int((~alive).sum())
    return F[alive]


def _flips(P, F, group, flat, tolerance):
    """Flips of the long edges of flat triangles, each triangle in one at most.

    Returns the new triangles ``(c, 2, 3)``, the pairs of triangles they replace ``(c, 2)``, and the
    flat triangles whose long edge is a boundary.
    """
    m, f = len(F), F.T.ravel()
    E, edge_of, count = unique_edges(group[F], len(P))
    half = flat + m * _heights(P, F[flat])[1]
    at_boundary = flat[count[edge_of[half]] == 1]
    mate = manifold_mates(edge_of, count)[half]
    half, mate = half[mate >= 0], mate[mate >= 0]
    # the neighbour across keeps its orientation: it has the area
    p, q, d, b = (
        f[mate],
        f[(mate + m) % (3 * m)],
        f[(mate + 2 * m) % (3 * m)],
        f[(half + 2 * m) % (3 * m)],
    )
    pairs, key = (
        np.stack([half, mate], axis=1) % m,
        np.sort(group[np.stack([b, d], axis=1)], axis=1) @ [len(P), 1],
    )
    flipped = np.stack([np.stack([p, b, d], axis=1), np.stack([b, q, d], axis=1)], axis=1)
    old, new = np.linalg.norm(P[p] - P[q], axis=1), np.linalg.norm(P[b] - P[d], axis=1)
    height = _heights(P, flipped.reshape(-1, 3))[0].reshape(-1, 2).min(axis=1)
    good = (
        (group[b] != group[d])
        & ~np.isin(key, E @ [len(P), 1])
        & ((height > tolerance) | (new < old))
    )
    good = np.flatnonzero(good)
    good = good[cheapest(-old[good], pairs[good])]
    good = good[np.unique(key[good], return_index=True)[1]]
    return flipped[good], pairs[good], at_boundary


def _heights(P, F):
    """Height of each triangle over its longest side, and the first corner of that side."""
    side = _sides(P, F)
    return np.linalg.norm(triangle_normals(P, F), axis=1) / np.maximum(
        side.max(axis=1), 1e-300
    ), side.argmax(axis=1)


def _sides(P, F):
    """Lengths of the sides 0-1, 1-2 and 2-0 of each triangle ``(m, 3)``."""
    X = [P.take(corner, axis=0) for corner in F.T]
    gaps = (X[0] - X[1], X[1] - X[2], X[2] - X[0])
    return np.stack([np.sqrt(np.einsum("ij,ij->i", d, d)) for d in gaps], axis=1)


def _largest_components(X, T, wanted, counts):
    """The components asked for, outwards, in the old numbering; and the mask of their vertices."""
    label = components(np.concatenate([T[:, :2], T[:, 1:]]), len(X))
    n = label.max() + 1
    areas = triangle_areas(X, T)
    area = np.bincount(label[T[:, 0]], areas, n)
    order = np.argsort(-area, kind="stable")
    share = area[order[0]] / area.sum()
    if wanted == "largest" and share < 0.5:
        raise ValueError(
            f"the largest of {n} components has {100 * share:.1f} % of the area, under half; say how many belong to "
            f"the shape: components={int(np.searchsorted(np.cumsum(area[order]), 0.9 * area.sum())) + 1} "
            f'holds 90 %, components="all" keeps all'
        )
    number = {"largest": 1, "all": n}.get(wanted, wanted)
    keep = np.zeros(n, bool)
    keep[order[:number]] = True
    counts["components"], counts["dropped_components"] = int(n), int(n - keep.sum())
    counts["area_dropped"] = float(area[~keep].sum() / area.sum())
    T = T[keep[label[T[:, 0]]]]
    T, turned = _outwards(X, T, label, n)
    counts["reoriented_triangles"] += turned
    return X[keep[label]], T, keep[label]


def _outwards(X, T, label, n):
    """Components turned so that they enclose a positive volume.

    An open one as if its boundary were closed.
    """
    E, _, count = unique_edges(T, len(X))
    rim = np.unique(E[count == 1])
    weight = np.zeros(len(X))
    weight[rim] = 1
    closed = np.bincount(label[rim], minlength=n) == 0
    weight[closed[label]] = 1
    total = np.maximum(np.bincount(label, weight, n), 1)
    centre = np.stack([np.bincount(label, weight * X[:, i], n) / total for i in range(3)], axis=1)
    of = label[T[:, 0]]
    a, b, c = (X[T[:, i]] - centre[of] for i in range(3))
    volume = np.bincount(of, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, n)
    area = np.bincount(of, triangle_areas(X, T), n)
    inwards = volume < np.where(closed, 0, -1e-3 * area**1.5)  # a flat open patch has no outside
    return np.where(inwards[of][:, None], T[:, ::-1], T), int(inwards[of].sum())


def _count_topology(T, counts):
    E, _, count = unique_edges(T)
    rim = E[count == 1]
    vertex, rim_ends = np.unique(rim, return_inverse=True)
    holes = components(rim_ends.reshape(-1, 2), len(vertex)).max(initial=-1) + 1
    chi = euler_characteristic(T, E)
    kept = counts["components"] - counts["dropped_components"]
    counts |= {
        "holes": int(holes),
        "euler_characteristic": int(chi),
        "genus": int(2 * kept - holes - chi) // 2,
    }


def _vertex_of_file(group, new, file_vertex):
    """The first new vertex at a corner of the file vertex.

    Else of a vertex that was welded to it, else -1.
    """

    def first(key, n):
        result = np.full(n, np.iinfo(np.int64).max)
        np.minimum.at(result, key[new >= 0], new[new >= 0])
        return np.where(result < np.iinfo(np.int64).max, result, -1)

    own = first(file_vertex, len(group))
    welded = np.r_[first(group[file_vertex], group.max() + 1), -1]
    return np.where(own >= 0, own, welded[group]).astype(np.int32)
