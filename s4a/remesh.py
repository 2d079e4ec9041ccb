"""Low-resolution mesh and projection operator U (4.1, step 1; in the spirit of ReMatching, Maggioli et al. 2024).

Geodesic Voronoi cells of well-spread samples give the coarse mesh as their dual.  The dual is a manifold when every
cell has one rim, every two neighbouring cells share one border, and no three cells meet twice: where this fails,
samples are added, and where that would cost too many (scans full of pin-holes), handles thinner than a cell are cut.
"""

import contextlib
import os

import fpsample
import numpy as np
import robust_laplacian
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from s4a.mesh import (
    as_arrays,
    closest_point_in_star,
    cotan_weights,
    directed_edges,
    edge_graph,
    triangle_areas,
    unique_edges,
    vertex_areas,
    vertex_normals,
)
from s4a.schema import dataset, require

FIRST, MOST = 0.95, 1.1  # share of n_coarse that is sampled first, and with which cutting handles begins


def components(pairs, n):
    """Connected component of each of n nodes that the pairs ``(p, 2)`` link."""
    links = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (n, n))
    return connected_components(links, directed=False)[1]


def topology(T):
    """Euler characteristic, number of boundary loops, and of edges with three or more triangles."""
    E, _, count = unique_edges(T)
    rim, vertex = np.unique(E[count == 1], return_inverse=True)
    loops = components(vertex.reshape(-1, 2), len(rim)).max(initial=-1) + 1
    return {
        "euler_characteristic": len(np.unique(T)) - len(E) + len(T),
        "boundary_loops": int(loops),
        "nonmanifold_edges": int((count > 2).sum()),
    }


def farthest_of_each(group, vertex, distance):
    """The vertex of greatest distance in every group."""
    order = np.lexsort((distance[vertex], group))
    return vertex[order[np.append(np.diff(group[order]) != 0, True)[: len(order)]]]


# samples and cells


def farthest_points(P, k, start=0):
    """Sorted indices of k farthest-point samples of the rows of P, from the row `start` on."""
    k = min(k, len(P))
    if k < 1:
        return np.empty(0, np.int64)
    height = min(7, int(np.log2(len(P))))
    if height < 1:
        return np.arange(k)
    return np.unique(fpsample.bucket_fps_kdline_sampling(P, k, h=height, start_idx=int(start)).astype(np.int64))


def sample_surface(X, T, G, rim, avoid, k, seed=0):
    """About k vertices spread over the surface, its boundary edges `rim` at the same spacing.

    Farthest points of (position, spacing * normal): the two sides of a thin wall count as apart, and bends get more.
    """
    area = vertex_areas(X, T)
    spacing = np.sqrt(2 / np.sqrt(3) * area.sum() / k)
    N = vertex_normals(X, T)
    ring = G.astype(bool).astype(float)
    for _ in range(2):
        N = N + ring @ N
        N /= np.maximum(np.linalg.norm(N, axis=1, keepdims=True), 1e-300)
    X = X - area @ X / area.sum()
    P = np.c_[X / spacing, N]
    length = np.linalg.norm(X[rim[:, 0]] - X[rim[:, 1]], axis=1).sum()
    rim = np.unique(rim)
    sample, free = np.empty(0, np.int64), np.flatnonzero(~avoid)
    if len(rim):
        sample = rim[farthest_points(P[rim], min(int(np.ceil(length / spacing)), k // 2))]
        near = dijkstra(G, indices=sample, min_only=True, limit=0.7 * spacing)
        free = np.setdiff1d(np.flatnonzero(np.isinf(near) & ~avoid), rim)
    outermost = np.argsort(-(X[free] ** 2).sum(1), kind="stable")
    start = outermost[seed % len(free)] if len(free) else 0
    return np.sort(np.r_[sample, free[farthest_points(P[free], k - len(sample), start)]])


def add_samples(G, new, sample, cell, distance):
    """Voronoi cells along edges after new samples: only vertices that are nearer to one of these change.

    Returns
    -------
    sample : int ndarray (samples,)
    cell : int ndarray (n,)
        Number of each vertex's nearest sample.
    distance : float ndarray (n,)
    """
    to_new, _, nearest = dijkstra(G, indices=new, min_only=True, return_predecessors=True, limit=distance.max())
    number = np.full(len(cell), -1)
    number[new] = len(sample) + np.arange(len(new))
    nearer = to_new < distance
    return np.r_[sample, new], np.where(nearer, number[nearest], cell), np.where(nearer, to_new, distance)


def voronoi_cells(G, sample):
    """Samples, cells and distances of :func:`add_samples`, with a sample more in every component that had none."""
    n = G.shape[0]
    part = connected_components(G, directed=False)[1]
    first = np.unique(part, return_index=True)[1]
    sample = np.union1d(sample, first[~np.isin(part[first], part[sample])])
    return add_samples(G, sample, np.empty(0, np.int64), np.full(n, -1), np.full(n, np.inf))


def dual(T, cell):
    """Triangles between cells: one for each triangle of the mesh whose corners lie in three cells."""
    L = cell[T]
    return L[(L[:, 0] != L[:, 1]) & (L[:, 1] != L[:, 2]) & (L[:, 2] != L[:, 0])]


# topology


def rims(T, region):
    """Rims of regions: the closed rows of edges and triangles that lead out of each region.

    Parameters
    ----------
    T : int ndarray (m, 3)
    region : int ndarray (n,)
        Region of each vertex, -1 outside of all.

    Returns
    -------
    triangle, vertex, rim : int ndarray (r,)
        Triangles across a rim, a vertex in it on the region's side, and the number of the rim.
    owner : int ndarray
        Region of each rim.
    """
    n, L = len(region), region[T]
    across = np.flatnonzero((L >= 0).any(1) & ~((L[:, 0] == L[:, 1]) & (L[:, 1] == L[:, 2])))
    t, L, step = T[across].astype(np.int64), L[across], []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        alone = (L[:, i] >= 0) & (L[:, i] != L[:, j]) & (L[:, i] != L[:, k])
        pair = (L[:, j] >= 0) & (L[:, j] == L[:, k]) & (L[:, i] != L[:, j])
        step.append(np.stack([across, t[:, i] * n + t[:, j], t[:, i] * n + t[:, k]], axis=1)[alone])
        step.append(np.stack([across, t[:, j] * n + t[:, i], t[:, k] * n + t[:, i]], axis=1)[pair])
    step = np.concatenate(step)  # a triangle leads from one edge (inside, outside) to the next
    edge, link = np.unique(step[:, 1:], return_inverse=True)
    rim = components(link.reshape(-1, 2), len(edge))
    owner = np.empty(rim.max(initial=-1) + 1, np.int64)
    owner[rim] = region[edge // n]
    return np.repeat(step[:, 0], 2), step[:, 1:].ravel() // n, rim[link.ravel()], owner


def many_rims(T, cell, suspect):
    """Which of the suspect cells have no rim or several: handles and holes inside a single rim do no harm."""
    owner = rims(T, np.where(suspect[cell], cell, -1))[3]
    return suspect & (np.bincount(owner, minlength=len(suspect)) != 1)


def faults(T, E, open_edge, cell, n):
    """Cells, pairs of cells and triangles that keep the dual from being a manifold.

    Parameters
    ----------
    T, E, open_edge
        Triangles, edges and which of these lie on the boundary.
    cell : int ndarray (vertices,)
    n : int
        Number of cells.

    Returns
    -------
    bad_cell : bool ndarray (n,)
        No disk (V - E + F != 1) with several rims, several stretches of boundary, or no triangle.
    pair : int ndarray (p, 2)
        Neighbouring cells whose common border is not one strip: it has not two ends.
    edge, edge_pair : int ndarray
        Edges across those borders and the row of `pair` they belong to.
    repeated : int ndarray
        Triangles of the mesh whose three cells meet elsewhere, too.
    """
    L, ends = cell[T], cell[E]
    inner = ends[:, 0] == ends[:, 1]
    a, b, c = L[:, 0] == L[:, 1], L[:, 1] == L[:, 2], L[:, 2] == L[:, 0]
    euler = np.bincount(cell, minlength=n) - np.bincount(ends[inner, 0], minlength=n)
    euler += np.bincount(L[a & b, 0], minlength=n)
    corner = np.flatnonzero(~(a | b | c))
    C = L[corner]
    stretches = np.bincount(ends[open_edge & ~inner].ravel(), minlength=n)
    bad = many_rims(T, cell, euler != 1) | (stretches > 2) | (np.bincount(C.ravel(), minlength=n) == 0)

    border = np.flatnonzero(~inner)
    pair, strip = np.unique(np.sort(ends[border], axis=1) @ [n, 1], return_inverse=True)
    half = np.sort(directed_edges(C), axis=1) @ [n, 1]
    strip_ends = np.bincount(np.searchsorted(pair, half), minlength=len(pair))
    strip_ends += np.bincount(strip[open_edge[border]], minlength=len(pair))
    bad_pair = strip_ends != 2
    at = bad_pair[strip]
    row = np.cumsum(bad_pair) - 1

    _, triple, count = np.unique(np.sort(C, axis=1) @ [n * n, n, 1], return_inverse=True, return_counts=True)
    pairs = np.stack([pair[bad_pair] // n, pair[bad_pair] % n], axis=1)
    return bad, pairs, border[at], row[strip[at]], corner[count[triple] > 1]


def refine(G, T, E, open_edge, state, most, avoid):
    """Add samples where the dual is not a manifold until it is, or until there are more than `most`.

    The vertices to avoid are only taken where there are no others.  Returns the samples, cells and distances, the
    number of rounds, and whether faults are left.
    """
    rounds = 0
    while True:
        sample, cell, distance = state
        distance = np.where(avoid, 1e-9, 1) * distance
        bad, _, edge, row, repeated = faults(T, E, open_edge, cell, len(sample))
        inside = np.flatnonzero(bad[cell])
        new = np.concatenate(
            [
                farthest_of_each(cell[inside], inside, distance),
                farthest_of_each(np.repeat(row, 2), E[edge].ravel(), distance),
                farthest_of_each(np.repeat(repeated, 3), T[repeated].ravel(), distance),
            ]
        )
        new = new[distance[new] > 0]
        if len(new) == 0 or len(sample) > most:
            return state, rounds, len(new) > 0
        state = add_samples(G, farthest_of_each(cell[new], new, distance), *state)  # one in each cell
        rounds += 1


def thin_regions(T, E, open_edge, cell, n):
    """Cells that are no disk, and pairs of cells that are none together, as disjoint regions of vertices."""
    bad, pair, _, _, _ = faults(T, E, open_edge, cell, n)
    pair = pair[~bad[pair].any(1)]
    number = np.arange(len(pair))
    first = np.full(n, len(pair))
    np.minimum.at(first, pair.ravel(), np.repeat(number, 2))
    pair = pair[(first[pair] == number[:, None]).all(1)]
    region = np.where(bad, np.arange(n), -1)
    region[pair] = pair[:, :1]
    return region[cell]


def between_rims(G, T, region):
    """Triangles half-way between the rims of a region: without them, a tube is cut through."""
    triangle, vertex, rim, _ = rims(T, region)
    rim_of = np.full(len(region), -1)
    rim_of[vertex[::-1]] = rim[::-1]
    inside = np.flatnonzero(region >= 0)
    local = G[inside][:, inside].tocoo()
    same = region[inside[local.row]] == region[inside[local.col]]
    local = sp.csr_matrix((local.data[same], (local.row[same], local.col[same])), local.shape)
    seeds = np.flatnonzero(rim_of[inside] >= 0)
    nearest = dijkstra(local, indices=seeds, min_only=True, return_predecessors=True)[2]
    part = np.full(len(region), -1)
    part[inside] = np.where(nearest >= 0, rim_of[inside[nearest]], -1)
    P, R = part[T], region[T]
    i, j = [0, 1, 2], [1, 2, 0]
    removed = ((R[:, i] == R[:, j]) & (R[:, i] >= 0) & (P[:, i] != P[:, j])).any(1)
    removed[triangle[part[vertex] != rim]] = True
    return removed


def cut_handles(X, T, removed, crumb):
    """The surface without some triangles, the openings closed by a fan around their centre.

    Vertices where sheets would touch go, too; pieces of less area than `crumb` that come off are dropped, and what
    would cut off more is not removed.

    Returns
    -------
    X, T : the new mesh
    origin : int ndarray
        Vertex of the given mesh that each vertex was, -1 for the centres.
    """
    n, area = len(X), triangle_areas(X, T)
    E, edge_of, count = unique_edges(T, n)
    component = components(E, n)

    def rim_count():
        return np.bincount(edge_of, np.tile(~removed, 3), len(E)).astype(int)

    while removed.any():
        pinched = np.bincount(E[rim_count() == 1].ravel(), minlength=n) > 2
        if pinched.any():
            removed = removed | pinched[T].any(1)
            continue
        part = components(E[rim_count() > 0], n)
        part_area = np.bincount(part[T[:, 0]], np.where(removed, 0, area), n)
        small = part_area < crumb
        small[farthest_of_each(component, part, part_area)] = False  # of every component something stays
        small &= np.isin(np.arange(n), part[T[removed]])
        gone = removed | small[part[T[:, 0]]]
        hole, at = components(directed_edges(T[gone]), n), np.unique(T[gone])
        at = at[np.isin(part[at], part[T[~gone, 0]])]
        cut_off = np.unique(np.stack([hole[at], part[at]], axis=1), axis=0)[:, 0]
        restore = gone & (np.bincount(cut_off, minlength=n) > 1)[hole[T[:, 0]]]
        if not restore.any():
            removed = gone
            break
        removed = removed & ~restore
    open_half = np.tile(~removed, 3) & ((rim_count() == 1) & (count == 2))[edge_of]
    half = directed_edges(T)[open_half]
    corner, link = np.unique(half, return_inverse=True)
    loop = components(link.reshape(-1, 2), len(corner))[link.reshape(-1, 2)[:, 0]]
    centre = sp.csr_matrix((np.ones(len(half)), (loop, half[:, 0])), (loop.max(initial=-1) + 1, n))
    centre = (centre @ X) / np.asarray(centre.sum(axis=1))
    T = np.concatenate([T[~removed], np.stack([half[:, 1], half[:, 0], n + loop], axis=1)])
    used, T = np.unique(T, return_inverse=True)
    return np.concatenate([X, centre])[used], T.reshape(-1, 3), np.where(used < n, used, -1)


def laplacian(X, T, area):
    """Edges, cotan weights and vertex areas, and "cotan", or "robust" where triangles are degenerate.

    The areas are the given ones, raised to a thousandth of their mean so that none vanishes.
    """
    area = np.maximum(area, 1e-3 * area.mean())
    count = unique_edges(T, len(X))[2]
    half = directed_edges(T)
    longest = ((X[half[:, 0]] - X[half[:, 1]]) ** 2).sum(1).reshape(3, -1).max(0)
    if (count > 2).any() or (triangle_areas(X, T) < 1e-6 * longest).any():
        L = sp.triu(robust_laplacian.mesh_laplacian(X, T)[0], 1).tocoo()
        return np.stack([L.row, L.col], axis=1), -L.data, area, "robust"
    return *cotan_weights(X, T), area, "cotan"


def sorted_mesh(X, T):
    """The mesh with vertices and triangles in an order that the positions alone decide, and that vertex order."""
    order = np.lexsort(X.T[::-1])
    rank = np.empty(len(X), np.int64)
    rank[order] = np.arange(len(X))
    T = rank[T]
    T = np.take_along_axis(T, (T.argmin(1)[:, None] + np.arange(3)) % 3, axis=1)
    return X[order], T[np.lexsort(T.T[::-1])], order


def coarse_surface(X, T, n_coarse, seed=0):
    """Manifold dual of about `n_coarse` geodesic Voronoi cells.

    Returns
    -------
    Y, C : the coarse mesh
    sample : int ndarray
        Vertex of the mesh that each coarse vertex is; -1 for the centre of a closed opening.
    cell : int ndarray (n,)
        Coarse vertex near each vertex of the mesh.
    attrs : dict
    """
    V, F, origin = X, T, np.arange(len(X))
    for most in (MOST, MOST, np.inf):
        G, (E, _, count) = edge_graph(V, F), unique_edges(F, len(V))
        first = sample_surface(V, F, G, E[count == 1], origin < 0, max(4, round(FIRST * n_coarse)), seed)
        start = voronoi_cells(G, first)
        state, rounds, left = refine(G, F, E, count == 1, start, most * n_coarse, origin < 0)
        if not left:
            break
        region = thin_regions(F, E, count == 1, start[1], len(start[0]))
        V, F, came_from = cut_handles(V, F, between_rims(G, F, region), 3 * triangle_areas(V, F).sum() / n_coarse)
        origin = np.where(came_from >= 0, origin[came_from], -1)
    sample, cell_of, _ = state
    C = dual(F, cell_of)
    kept = np.flatnonzero(origin >= 0)
    cell = np.full(len(X), -1)
    cell[origin[kept]] = cell_of[kept]
    if (cell < 0).any():
        known = np.flatnonzero(cell >= 0)
        cell = cell[dijkstra(edge_graph(X, T), indices=known, min_only=True, return_predecessors=True)[2]]
    attrs = {"samples_first": len(first), "samples_added": len(sample) - len(first), "rounds": rounds}
    return V[sample], C, origin[sample], cell, attrs


def alpha_wrap(X, T, alpha=1.5, offset=0.2):
    """A closed surface wrapped around the mesh; `alpha` and `offset` in percent of its diagonal."""
    try:
        with silence():
            import pymeshlab
    except ImportError as error:
        raise ValueError("wrap=True needs pymeshlab: install it with `pip install pymeshlab`") from error
    with silence():
        meshes = pymeshlab.MeshSet(verbose=False)
        if not hasattr(meshes, "generate_alpha_wrap"):
            raise ValueError(
                "pymeshlab came without its alpha wrap filter: install the system packages libgl1 and libopengl0"
            )
        meshes.add_mesh(pymeshlab.Mesh(X, T))
        percent = pymeshlab.PercentageValue
        meshes.generate_alpha_wrap(alpha=percent(alpha), offset=percent(offset))
        wrapped = meshes.current_mesh()
        return wrapped.vertex_matrix(), wrapped.face_matrix().astype(np.int64)


@contextlib.contextmanager
def silence():
    """Nothing that native code writes reaches the terminal."""
    with open(os.devnull, "w") as null:
        kept = [(fd, os.dup(fd)) for fd in (1, 2)]
        try:
            for fd, _ in kept:
                os.dup2(null.fileno(), fd)
            yield
        finally:
            for fd, copy in kept:
                os.dup2(copy, fd)
                os.close(copy)


def nearest_with_normal(X, T, V, F):
    """Vertex of the mesh (V, F) near each vertex of (X, T), on a side of a wall that faces the same way."""
    reach = 0.02 * np.linalg.norm(np.ptp(V, axis=0))
    tree = cKDTree(np.c_[V, reach * vertex_normals(V, F)])
    return tree.query(np.c_[X, reach * vertex_normals(X, T)])[1]


def coarsen(mesh, *, n_coarse=6000, wrap=False, seed=0):
    """Low-resolution mesh of about `n_coarse` vertices, and the operator U that carries functions back (4.1).

    Parameters
    ----------
    mesh : xarray.Dataset
        A clean mesh: ``position`` and ``corner_vertex``, manifold, oriented; boundary and several components allowed.
    n_coarse : int
        Number of vertices to aim at; the result has a few percent less or more.  A mesh that has no more is kept.
    wrap : bool
        Coarsen a closed surface wrapped around the mesh, for scans whose inside is of no interest (needs pymeshlab).
    seed : int
        The sampling starts at the (seed + 1)-th outermost vertex.

    Returns
    -------
    xarray.Dataset
        ``position``, ``corner_vertex``: the coarse mesh, manifold, its vertices in ``sample_vertex`` (-1 where
        they are no vertex of the mesh);  ``edge_vertex``, ``cotan_weight``: W;  ``vertex_area``: A, the area of the
        original surface carried by U, so that it sums to the original area (of the coarse mesh after wrapping);
        ``coarse_vertex``, ``coarse_weight (original_vertex, corner)``: U, rows non-negative of sum 1.
        The attributes count samples added, rounds, Euler characteristic and boundary loops before and after.

    Raises
    ------
    ValueError
        When the mesh is not clean or an option out of range.

    Notes
    -----
    A vertex takes its weights from the coarse triangles around the sample of its own geodesic Voronoi cell: U never
    looks across a thin wall.  Handles and holes inside one cell are lost; handles about a cell thin are cut only if
    they would need more than 1.1 n_coarse samples.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.mesh import as_dataset
    >>> x, y = np.meshgrid(np.arange(30.0), np.arange(30.0), indexing="ij")
    >>> i = np.arange(900).reshape(30, 30)[:-1, :-1].ravel()
    >>> grid = as_dataset(
    ...     np.c_[x.ravel(), y.ravel(), 0 * x.ravel()], np.r_[np.c_[i, i + 30, i + 31], np.c_[i, i + 31, i + 1]]
    ... )
    >>> coarse = coarsen(grid, n_coarse=100)
    >>> coarse.attrs["euler_characteristic"], bool(np.allclose(coarse["coarse_weight"].sum("corner"), 1))
    (1, True)
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    if int(n_coarse) != n_coarse or n_coarse < 4:
        raise ValueError(f"n_coarse must be an integer of at least 4, found {n_coarse!r}")
    X0, T0 = as_arrays(mesh)
    before = check_clean(X0, T0)
    attrs = {"n_coarse": int(n_coarse), "seed": int(seed), "wrapped": int(bool(wrap)), "kept_whole": 0}
    X, T, order = sorted_mesh(X0, T0)
    V, F = sorted_mesh(*alpha_wrap(X, T))[:2] if wrap else (X, T)
    if len(V) <= n_coarse:
        Y, C, sample, cell = V, F, np.arange(len(V)), np.arange(len(V))
        attrs.update(kept_whole=1, samples_first=len(V), samples_added=0, rounds=0)
    else:
        Y, C, sample, cell, counts = coarse_surface(V, F, n_coarse, seed)
        attrs.update(counts)
    if wrap:
        sample, cell = np.full(len(Y), -1), cell[nearest_with_normal(X, T, V, F)]
    triangle, weight = closest_point_in_star(X, cell, Y, C)
    corner = C[triangle]
    carried = np.bincount(corner.ravel(), (weight * vertex_areas(X, T)[:, None]).ravel(), len(Y))
    E, w, area, attrs["laplacian"] = laplacian(Y, C, vertex_areas(Y, C) if wrap else carried)
    attrs |= topology(C) | {f"{name}_original": value for name, value in before.items()}
    row = np.argsort(order)
    return dataset(
        attrs,
        position=Y,
        corner_vertex=C.astype(np.int32),
        vertex_area=area,
        edge_vertex=E.astype(np.int32),
        cotan_weight=w,
        sample_vertex=np.where(sample >= 0, order[sample], -1).astype(np.int32),
        coarse_vertex=corner[row].astype(np.int32),
        coarse_weight=weight[row],
    )


def check_clean(X, T):
    """Topology of a mesh; ValueError unless positions are finite, indices valid, vertices in use, edges manifold."""
    if len(T) == 0 or T.min() < 0 or T.max() >= len(X) or not np.isfinite(X).all():
        raise ValueError(
            "coarsen needs triangles of existing vertices at finite positions; found others: clean the mesh first"
        )
    idle, found = len(X) - len(np.unique(T)), topology(T)
    knots = found["nonmanifold_edges"]
    if idle or knots:
        raise ValueError(
            f"coarsen needs a manifold mesh without idle vertices; found {knots} edges of three or more triangles and "
            f"{idle} vertices without triangle: clean the mesh first"
        )
    return found
