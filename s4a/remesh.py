"""Low-resolution mesh and projection operator U (4.1, step 1; after ReMatching, Maggioli et al. 2024)."""

import fpsample
import numpy as np
import robust_laplacian
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from s4a.mesh import (
    as_arrays,
    boundary_vertices,
    closest_point_in_star,
    cotan_weights,
    edge_graph,
    euler_characteristic,
    unique_edges,
    vertex_areas,
)
from s4a.schema import dataset, require


def farthest_points(X, k, start):
    """Indices of k farthest-point samples, from the index `start` on."""
    return fpsample.bucket_fps_kdline_sampling(X, k, h=7, start_idx=int(start)).astype(np.int64)


def voronoi_cells(G, sample):
    """Cell of every vertex, as the number of its nearest sample along edges, and that distance."""
    distance, _, nearest = dijkstra(G, indices=sample, min_only=True, return_predecessors=True)
    number = np.full(G.shape[0], -1)
    number[sample] = np.arange(len(sample))
    return np.where(nearest >= 0, number[nearest], -1), distance


def dual(T, cell):
    """Triangles between cells: one for each triangle of the mesh whose corners lie in three cells."""
    L = cell[T]
    return L[(L[:, 0] != L[:, 1]) & (L[:, 1] != L[:, 2]) & (L[:, 2] != L[:, 0])]


def laplacian(X, T):
    """Vertex areas, edges, cotan weights, and "cotan", or "robust" where the mesh is not manifold or degenerate."""
    area = vertex_areas(X, T)
    E, w = cotan_weights(X, T)
    count = unique_edges(T, len(X))[2]
    if (count > 2).any() or (area <= 0).any() or np.abs(w).max() > 1e6:
        L, M = robust_laplacian.mesh_laplacian(X, T)
        L = sp.triu(L, 1).tocoo()
        return M.diagonal(), np.stack([L.row, L.col], axis=1), -L.data, "robust"
    return area, E, w, "cotan"


def coarsen(mesh, *, n_coarse=6000, wrap=False, seed=0):
    """Low-resolution mesh of about `n_coarse` vertices and the operator U that carries functions back (4.1)."""
    require(mesh, "position", "corner_vertex", what="mesh")
    X, T = as_arrays(mesh)
    start = np.argmax(((X - X.mean(0)) ** 2).sum(1))
    sample = farthest_points(X, min(n_coarse, len(X)), start)
    cell, _ = voronoi_cells(edge_graph(X, T), sample)
    C = dual(T, cell)
    used = np.unique(C)
    if len(used) < len(sample):
        sample = sample[used]
        cell, _ = voronoi_cells(edge_graph(X, T), sample)
        C = dual(T, cell)
    Y = X[sample]
    area, E, w, kind = laplacian(Y, C)
    triangle, weight = closest_point_in_star(X, cell, Y, C)
    return dataset(
        {"laplacian": kind, "wrapped": 0, "euler_characteristic": euler_characteristic(C)},
        position=Y,
        corner_vertex=C.astype(np.int32),
        vertex_area=area,
        edge_vertex=E.astype(np.int32),
        cotan_weight=w,
        sample_vertex=sample.astype(np.int32),
        coarse_vertex=C[triangle].astype(np.int32),
        coarse_weight=weight,
    )
