"""Low-resolution mesh and projection operator U (4.1, step 1.

In the spirit of ReMatching, Maggioli et al. 2024).

Well-spread samples, the manifold dual of their geodesic Voronoi cells
(:mod:`s4a.geometry.voronoi`), and for every vertex of the original the closest point on the coarse
triangles around its own cell.
"""

import contextlib
import os

import numpy as np
import robust_laplacian
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from s4a.geometry.align import farthest_points
from s4a.geometry.closest import closest_point_in_star
from s4a.geometry.mesh import (
    as_arrays,
    directed_edges,
    edge_graph,
    edges,
    euler_characteristic,
    half_cotangents,
    n_used,
    triangle_areas,
    unique_edges,
    vertex_areas,
    vertex_normals,
)
from s4a.geometry.voronoi import (
    between_rims,
    components,
    cut_handles,
    dual,
    refine,
    thin_regions,
    voronoi_cells,
)
from s4a.schema import dataset, require

FIRST, MOST = (
    0.95,
    1.1,
)  # share of n_coarse that is sampled first, and with which cutting handles begins


def sample_surface(X, T, G, rim, avoid, k, seed=0):
    """About k vertices spread over the surface, its boundary edges `rim` at the same spacing.

    Farthest points of (position, spacing * normal): the two sides of a thin wall count as apart,
    and bends get more.
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
    origin = np.zeros(6)
    length = np.linalg.norm(X[rim[:, 0]] - X[rim[:, 1]], axis=1).sum()
    rim = np.unique(rim)
    sample, free = np.empty(0, np.int64), np.flatnonzero(~avoid)
    if len(rim):
        sample = rim[
            farthest_points(
                P[rim],
                min(int(np.ceil(length / (0.8 * spacing))), k // 2),
                center=origin,
                seed=seed,
            )
        ]
        near = dijkstra(G, indices=rim, min_only=True, limit=0.6 * spacing)
        free = np.setdiff1d(np.flatnonzero(np.isinf(near) & ~avoid), rim)
    return np.sort(
        np.r_[sample, free[farthest_points(P[free], k - len(sample), center=origin, seed=seed)]]
    )


def laplacian(X, T, area):
    """Edges, cotan weights and vertex areas.

    And "cotan", or "robust" where triangles are degenerate.

    The areas are the given ones, raised to a thousandth of their mean so that none vanishes.
    """
    area = np.maximum(area, 1e-3 * area.mean())
    E, edge_of, count = unique_edges(T, len(X))
    half = directed_edges(T)
    longest = ((X[half[:, 0]] - X[half[:, 1]]) ** 2).sum(1).reshape(3, -1).max(0)
    if (count > 2).any() or (triangle_areas(X, T) < 1e-6 * longest).any():
        L = sp.triu(robust_laplacian.mesh_laplacian(X, T)[0], 1).tocoo()
        return np.stack([L.row, L.col], axis=1), -L.data, area, "robust"
    return E, np.bincount(edge_of, half_cotangents(X, T), len(E)), area, "cotan"


def sorted_mesh(X, T):
    """The mesh with vertices and triangles in an order that the positions alone decide.

    And that vertex order.
    """
    order = np.lexsort(X.T[::-1])
    rank = np.empty(len(X), np.int64)
    rank[order] = np.arange(len(X))
    T = rank[T]
    T = np.take_along_axis(T, (T.argmin(1)[:, None] + np.arange(3)) % 3, axis=1)
    return X[order], T[np.lexsort((T[:, 2], T[:, 0] * len(X) + T[:, 1]))], order


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
    for most in (MOST, MOST, MOST, np.inf):
        E, _, count = unique_edges(F, len(V))
        G = edge_graph(V, E)
        first = sample_surface(
            V, F, G, E[count == 1], origin < 0, max(4, round(FIRST * n_coarse)), seed
        )
        start = voronoi_cells(G, first)
        state, rounds, left = refine(G, F, E, count == 1, start, most * n_coarse, origin < 0)
        if not left:
            break
        region = thin_regions(F, E, count == 1, start[1], len(start[0]))
        V, F, came_from = cut_handles(
            V, F, between_rims(G, F, region), triangle_areas(V, F).sum() / n_coarse
        )
        origin = np.where(came_from >= 0, origin[came_from], -1)
    sample, cell_of, _ = state
    C = dual(F, cell_of)
    kept = np.flatnonzero(origin >= 0)
    attrs = {
        "samples_first": len(first),
        "samples_added": len(sample) - len(first),
        "rounds": rounds,
    }
    cell = np.full(len(X), -1)
    cell[origin[kept]] = cell_of[kept]
    attrs["vertices_cut"] = int((cell < 0).sum())
    if attrs["vertices_cut"]:
        known = np.flatnonzero(cell >= 0)
        cell = cell[
            dijkstra(
                edge_graph(X, edges(T)), indices=known, min_only=True, return_predecessors=True
            )[2]
        ]
    return V[sample], C, origin[sample], cell, attrs


def alpha_wrap(X, T, alpha=1.0, offset=0.2):
    """A closed surface wrapped around the mesh; `alpha` and `offset` in percent of its diagonal."""
    try:
        with silence():
            import pymeshlab
    except ImportError as error:
        raise ValueError(
            "wrap=True needs pymeshlab: install it with `pip install pymeshlab`"
        ) from error
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
    """Vertex of the mesh (V, F) near each vertex of (X, T).

    On a side of a wall that faces the same way.
    """
    reach = 0.02 * np.linalg.norm(np.ptp(V, axis=0))
    tree = cKDTree(np.c_[V, reach * vertex_normals(V, F)])
    return tree.query(np.c_[X, reach * vertex_normals(X, T)])[1]


def topology(T):
    """Euler characteristic, number of boundary loops, and of edges with three or more triangles."""
    E, _, count = unique_edges(T)
    rim, vertex = np.unique(E[count == 1], return_inverse=True)
    loops = components(vertex.reshape(-1, 2), len(rim)).max(initial=-1) + 1
    return {
        "euler_characteristic": euler_characteristic(T, E),
        "boundary_loops": int(loops),
        "nonmanifold_edges": int((count > 2).sum()),
    }


def check_clean(X, T):
    """Topology of a mesh; ValueError unless positions are finite, indices valid.

    Vertices in use, edges manifold.
    """
    if len(T) == 0 or T.min() < 0 or T.max() >= len(X) or not np.isfinite(X).all():
        raise ValueError(
            "coarsen needs triangles of existing vertices at finite positions; found others: clean the mesh first"
        )
    idle, found = len(X) - n_used(T), topology(T)
    knots = found["nonmanifold_edges"]
    if idle or knots:
        raise ValueError(
            f"coarsen needs a manifold mesh without idle vertices; found {knots} edges of three or more triangles and "
            f"{idle} vertices without triangle: clean the mesh first"
        )
    return found


def coarsen(mesh, *, n_coarse=6000, wrap=False, seed=0):
    """Low-resolution mesh of about `n_coarse` vertices.

    And the operator U that carries functions back (4.1).

    Parameters
    ----------
    mesh : xarray.Dataset
        A clean mesh: ``position`` and ``corner_vertex``, manifold, oriented; boundary and several
        components allowed.
    n_coarse : int
        Number of vertices to aim at; the result has from 5 % less to 10 % more, or what the
        topology needs where that is more (handles by the hundred, n_coarse in the hundreds).  A
        mesh that has no more is kept.
    wrap : bool
        Coarsen a closed surface wrapped around the mesh, for scans whose inside is of no interest
        (needs pymeshlab).
    seed : int
        The sampling starts at an outermost vertex; another seed starts elsewhere.

    Returns
    -------
    xarray.Dataset
        ``position``, ``corner_vertex``: the coarse mesh, manifold, its vertices in
        ``sample_vertex`` (-1 where they are no vertex of the mesh);  ``edge_vertex``,
        ``cotan_weight``: W;  ``vertex_area``: A, the area of the original surface carried by U, so
        that it sums to the original area (of the coarse mesh after wrapping); ``coarse_vertex``,
        ``coarse_weight (original_vertex, corner)``: U, rows non-negative of sum 1. The attributes
        count samples, rounds, vertices that went with cut handles (U reaches them, too), Euler
        characteristic and boundary loops, and say which Laplacian it is ("robust" where triangles
        are degenerate).

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
    >>> from s4a.geometry.mesh import as_dataset
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
    attrs = {
        "n_coarse": int(n_coarse),
        "seed": int(seed),
        "wrapped": int(bool(wrap)),
        "kept_whole": 0,
    }
    X, T, order = sorted_mesh(X0, T0)
    V, F = sorted_mesh(*alpha_wrap(X, T))[:2] if wrap else (X, T)
    if len(V) <= n_coarse:
        Y, C, sample, cell = V, F, np.arange(len(V)), np.arange(len(V))
        attrs.update(kept_whole=1, samples_first=len(V), samples_added=0, rounds=0, vertices_cut=0)
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
