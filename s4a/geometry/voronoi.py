"""Geodesic Voronoi cells on a surface, and their dual as a manifold mesh (4.1, step 1).

The dual has a vertex for every cell and a triangle where three cells meet.  It is a manifold if
every cell has one boundary, every two neighbouring cells share one border, and no three cells meet
twice.  Otherwise samples are added (:func:`refine`).  If that needs too many, as on scans with many
pin-holes, the surface itself is simplified: tubes thinner than a cell are cut
(:func:`cut_handles`).

Regions, cells and components are arrays with a number for each vertex.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, dijkstra

from s4a.geometry import mesh as surface
from s4a.geometry.align import oscillation
from s4a.geometry.mesh import components, directed_edges, edge_graph, triangle_areas
from s4a.schema import Array


class _MeshGraph(NamedTuple):
    """Triangles and edges of a mesh; see :func:`mesh_graph`."""

    T: Array  # (m, 3)
    E: Array  # (e, 2)
    is_open: Array  # (e,) whether the edge lies on the boundary
    G: sp.csr_matrix  # (n, n) lengths of the edges


class Voronoi(NamedTuple):
    """Samples of a surface and their Voronoi cells along edges."""

    sample: Array  # (samples,) vertex of each sample
    cell: Array  # (n,) number of each vertex's nearest sample
    distance: Array  # (n,) to that sample


class Faults(NamedTuple):
    """Obstacles to a manifold dual; see :func:`faults`."""

    cell: Array
    pair: Array
    edge: Array
    edge_pair: Array
    triangle: Array


def mesh_graph(X: Array, T: Array, found: tuple[Array, Array] | None = None) -> _MeshGraph:
    """Return the edges of a mesh, whether they are open, and the graph of their lengths.

    `found` are the edges and the triangles per edge, if they are known.
    Lengths change by at most a hundredth, so that few vertices are equally far from two samples.
    """
    E, count = found or surface.counted_edges(T, len(X))
    G, factor = edge_graph(X, E), 1 + 0.005 * oscillation(X)
    G.data *= np.repeat(factor, np.diff(G.indptr))
    G.data *= factor.take(G.indices)
    return _MeshGraph(T, E, count == 1, G)


def farthest_of_each(group: Array, vertex: Array, distance: Array) -> Array:
    """Return the vertex of greatest distance in each group; `group` belongs to `vertex`."""
    order = np.lexsort((distance[vertex], group))
    last = np.append(np.diff(group[order]) != 0, True)[: len(order)]
    return vertex[order[last]]


def add_samples(G: sp.csr_matrix, new: Array, state: Voronoi) -> Voronoi:
    """Add samples to Voronoi cells along edges; only vertices closer to a new sample change.

    Parameters
    ----------
    G : sparse matrix (n, n)
        Lengths of the edges, :func:`s4a.geometry.mesh.edge_graph`.
    new : int ndarray
        Vertices to add.
    state : Voronoi
    """
    sample, cell, distance = state
    to_new, _, nearest = dijkstra(
        G, indices=new, min_only=True, return_predecessors=True, limit=distance.max()
    )
    number = np.full(len(cell), -1)
    number[new] = len(sample) + np.arange(len(new))
    nearer = to_new < distance
    cell, distance = cell.copy(), distance.copy()
    cell[nearer] = number[nearest[nearer]]
    distance[nearer] = to_new[nearer]
    return Voronoi(np.r_[sample, new], cell, distance)


def voronoi_cells(G: sp.csr_matrix, sample: Array) -> Voronoi:
    """Return Voronoi cells of samples, with a sample added in each component without one."""
    n = G.shape[0]
    empty = Voronoi(np.empty(0, np.int64), np.full(n, -1), np.full(n, np.inf))
    state = add_samples(G, np.unique(sample), empty)
    if np.isinf(state.distance).any():
        _, component = connected_components(G, directed=False)
        _, first = np.unique(component, return_index=True)
        sample = np.union1d(sample, first[~np.isin(component[first], component[sample])])
        state = add_samples(G, sample, empty)
    return state


def dual(T: Array, cell: Array) -> Array:
    """Return the dual triangles: one for each triangle with corners in three cells."""
    L = cell[T]
    return L[(L[:, 0] != L[:, 1]) & (L[:, 1] != L[:, 2]) & (L[:, 2] != L[:, 0])]


def boundaries(T: Array, region: Array) -> tuple[Array, Array, Array, Array]:
    """Return the boundaries of regions: closed strips of edges and triangles that leave them.

    Parameters
    ----------
    T : int ndarray (m, 3)
    region : int ndarray (n,)
        Region of each vertex, -1 outside of all regions.

    Returns
    -------
    triangle, vertex, boundary : int ndarray (r,)
        Triangles across a boundary, a vertex of each inside the region, and the number of the
        boundary.
    owner : int ndarray
        Region of each boundary.
    """
    # A boundary continues through a triangle from one edge (inside, outside) to the next:
    #
    #          i               i inside, j and k outside: from edge (i, j) to edge (i, k)
    #         / \
    #      --/---\--> boundary      j and k inside, i outside: from edge (j, i) to edge (k, i)
    #       j-----k
    n, L = len(region), region[T]
    whole = (L[:, 0] == L[:, 1]) & (L[:, 1] == L[:, 2])
    across = np.flatnonzero((L >= 0).any(1) & ~whole)
    corners, L = T[across].astype(np.int64), L[across]
    steps = []
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        at_i, at_j, at_k = corners[:, i], corners[:, j], corners[:, k]
        differs = (L[:, i] != L[:, j]) & (L[:, i] != L[:, k])
        alone = differs & (L[:, i] >= 0)
        opposite = differs & (L[:, j] == L[:, k]) & (L[:, j] >= 0)
        steps.append(np.stack([across, at_i * n + at_j, at_i * n + at_k], axis=1)[alone])
        steps.append(np.stack([across, at_j * n + at_i, at_k * n + at_i], axis=1)[opposite])
    step = np.concatenate(steps)  # (s, 3): the triangle, the edge before, the edge after
    edge, link = np.unique(step[:, 1:], return_inverse=True)
    boundary = components(link.reshape(-1, 2), len(edge))
    owner = np.empty(boundary.max(initial=-1) + 1, np.int64)
    owner[boundary] = region[edge // n]
    return np.repeat(step[:, 0], 2), step[:, 1:].ravel() // n, boundary[link.ravel()], owner


def faults(graph: _MeshGraph, cell: Array, n: int, among: Array | None = None) -> Faults:
    r"""Return cells, pairs of cells and triangles at which the dual is not a manifold.

    ::

        a cell of two boundaries      a border in two pieces      a corner that occurs twice
         +-------------+             +-----+-----+                 .*.
         |   1         |             |     |     |               / / \ \     1, 2 and 3 cover a
         |    +---+    |             |   +---+   |              | |   | |    ball like the slices
         |    | 2 |    |             | 1 | 3 | 2 |              |1| 2 |3|    of an orange, and
         |    +---+    |             |   +---+   |              | |   | |    meet at both poles
         |             |             |     |     |               \ \ / /
         +-------------+             +-----+-----+                 '*'

    Parameters
    ----------
    graph : MeshGraph
    cell : int ndarray (vertices,)
    n : int
        Number of cells.
    among : bool ndarray (n,), optional
        Only faults that involve one of these cells are searched, and neighbours without triangle.

    Returns
    -------
    cell : bool ndarray (n,)
        Not a disk (V - E + F != 1), with several boundaries, several stretches of boundary, or no
        triangle.
    pair : int ndarray (p, 2)
        Neighbouring cells whose common border is not one strip with two ends.
    edge, edge_pair : int ndarray
        Edges across those borders and their row of `pair`.
    triangle : int ndarray
        Triangles of the mesh whose three cells also meet elsewhere.
    """
    T, E, is_open, _ = graph
    among = np.ones(n, bool) if among is None else among
    near = among[cell]
    triangle = np.flatnonzero(near[T[:, 0]] | near[T[:, 1]] | near[T[:, 2]])
    edge = np.flatnonzero(near[E[:, 0]] | near[E[:, 1]])
    T_near, ends, is_open = T[triangle], cell[E[edge]], is_open[edge]
    L = cell[T_near]
    corner = np.flatnonzero((L[:, 0] != L[:, 1]) & (L[:, 1] != L[:, 2]) & (L[:, 2] != L[:, 0]))
    C = L[corner]  # (corners, 3) cells that meet in each corner

    bad = _faulty_cells(T_near, ends, is_open, cell, among)
    lone = (np.bincount(ends.ravel(), minlength=n) > 0) & (np.bincount(C.ravel(), minlength=n) == 0)
    if (lone & ~among).any():  # not all triangles of neighbours were examined
        lone[dual(T, cell)] = False
    pair, across, row = _faulty_borders(ends, is_open, C, among)
    return Faults(bad | lone, pair, edge[across], row, triangle[corner[_is_repeated(C, n)]])


def _faulty_cells(T, ends, is_open, cell, among):
    """Find cells with no boundary, several boundaries, or several stretches of boundary ``(n,)``.

    Handles and holes inside a single boundary are harmless, as they vanish with the cell.  `ends`
    are the cells at both ends of the edges ``(e, 2)``.
    """
    n, L = len(among), cell[T]
    inner = ends[:, 0] == ends[:, 1]
    whole = (L[:, 0] == L[:, 1]) & (L[:, 1] == L[:, 2])
    euler = np.bincount(cell, minlength=n)
    euler -= np.bincount(ends[inner, 0], minlength=n)
    euler += np.bincount(L[whole, 0], minlength=n)
    suspect = among & (euler != 1)  # only these can have a number of boundaries other than one
    *_, owner = boundaries(T, np.where(suspect[cell], cell, -1))
    stretch_ends = np.bincount(ends[is_open & ~inner].ravel(), minlength=n)
    return (suspect & (np.bincount(owner, minlength=n) != 1)) | (among & (stretch_ends > 2))


def _faulty_borders(ends, is_open, C, among):
    """Find pairs of cells ``(p, 2)`` whose border is not one strip, edges across, and their rows.

    A strip of edges ends at a corner or at an open edge; a connected border has two such ends.
    """
    n = len(among)
    across = np.flatnonzero(ends[:, 0] != ends[:, 1])
    key, border = np.unique(np.sort(ends[across], axis=1) @ [n, 1], return_inverse=True)
    sides = directed_edges(C)  # (3 corners, 2): the three borders that end in each corner
    sides = np.sort(sides[among[sides].any(1)], axis=1) @ [n, 1]
    n_ends = np.bincount(np.searchsorted(key, sides), minlength=len(key))
    n_ends += np.bincount(border[is_open[across]], minlength=len(key))
    bad = n_ends != 2
    at = bad[border]
    row = np.cumsum(bad) - 1
    return np.stack(np.divmod(key[bad], n), axis=1), across[at], row[border[at]]


def _is_repeated(C, n):
    """Find corners ``(c, 3)`` whose three cells meet more than once."""
    key = np.sort(C, axis=1) @ [n * n, n, 1]
    _, triple, count = np.unique(key, return_inverse=True, return_counts=True)
    return count[triple] > 1


def refine(
    graph: _MeshGraph, state: Voronoi, most: float, avoid: Array
) -> tuple[Voronoi, int, bool]:
    """Add samples until the dual is a manifold, or there are more than `most`.

    Vertices to `avoid` are only sampled if there are no others.

    Returns
    -------
    state : Voronoi
    iterations : int
    faulty : bool
        Whether faults remain.
    """
    changed = np.ones(len(state.sample), bool)
    iterations = 0
    while True:
        sample, cell, distance = state
        distance = np.where(avoid, 1e-9, 1) * distance
        fault = faults(graph, cell, len(sample), changed)
        inside = np.flatnonzero(fault.cell[cell])
        across, corners = graph.E[fault.edge].ravel(), graph.T[fault.triangle].ravel()
        new = np.concatenate(
            [
                farthest_of_each(cell[inside], inside, distance),
                farthest_of_each(np.repeat(fault.edge_pair, 2), across, distance),
                farthest_of_each(np.repeat(fault.triangle, 3), corners, distance),
            ]
        )
        new = new[distance[new] > 0]
        if len(new) == 0 or len(sample) > most:
            return state, iterations, len(new) > 0
        new = farthest_of_each(cell[new], new, distance)  # one in each cell
        state = add_samples(graph.G, new, state)
        moved = state.cell != cell
        # each fault got a sample in one of its cells, so all other cells have no faults
        changed = np.zeros(len(state.sample), bool)
        changed[cell[moved]] = True
        changed[state.cell[moved]] = True
        iterations += 1


def thin_regions(graph: _MeshGraph, state: Voronoi) -> Array:
    """Return cells and pairs of cells that are not disks, as disjoint regions."""
    n = len(state.sample)
    fault = faults(graph, state.cell, n)
    pair = fault.pair[~fault.cell[fault.pair].any(1)]
    number = np.arange(len(pair))
    first = np.full(n, len(pair))  # first pair that contains the cell
    np.minimum.at(first, pair.ravel(), np.repeat(number, 2))
    pair = pair[(first[pair] == number[:, None]).all(1)]
    region = np.where(fault.cell, np.arange(n), -1)
    region[pair] = pair[:, :1]
    return region[state.cell]


def between_boundaries(G: sp.csr_matrix, T: Array, region: Array) -> Array:
    """Find triangles ``(m,)`` half-way between boundaries of a region, to cut a tube."""
    triangle, vertex, boundary, _ = boundaries(T, region)
    boundary_of = np.full(len(region), -1)
    boundary_of[vertex[::-1]] = boundary[::-1]  # the first of several wins
    inside = np.flatnonzero(region >= 0)
    local = G[inside][:, inside].tocoo()
    same = region[inside[local.row]] == region[inside[local.col]]
    local = sp.csr_matrix((local.data[same], (local.row[same], local.col[same])), local.shape)
    seeds = np.flatnonzero(boundary_of[inside] >= 0)
    _, _, nearest = dijkstra(local, indices=seeds, min_only=True, return_predecessors=True)
    closest = np.full(len(region), -1)  # nearest boundary within the region
    reached = nearest >= 0  # a component of a region without boundary has no nearest one
    closest[inside[reached]] = boundary_of[inside[nearest[reached]]]
    P, R = closest[T], region[T]  # (m, 3)
    P_next, R_next = closest[T[:, [1, 2, 0]]], region[T[:, [1, 2, 0]]]
    removed = ((R == R_next) & (R >= 0) & (P != P_next)).any(1)
    removed[triangle[closest[vertex] != boundary]] = True
    return removed


def cut_handles(X: Array, T: Array, removed: Array, crumb: float) -> tuple[Array, Array, Array]:
    """Remove triangles from a surface and close the openings with fans around their centres.

    Vertices at which components would touch are removed, too.  Separated components with an area
    below `crumb` are dropped; triangles whose removal would separate more are kept.

    Returns
    -------
    X, T : the new mesh
    origin : int ndarray
        Index of each vertex in the given mesh, -1 for the centres.
    """
    n, area = len(X), triangle_areas(X, T)
    E, edge_of, count = surface.unique_edges(T, n)
    component = components(E, n)

    def left_at_edge():
        """Return the number of remaining triangles at each edge."""
        return np.bincount(edge_of, np.tile(~removed, 3), len(E)).astype(int)

    while removed.any():
        pinched = np.bincount(E[left_at_edge() == 1].ravel(), minlength=n) > 2
        if pinched.any():
            removed = removed | pinched[T].any(1)
            continue
        part = components(E[left_at_edge() > 0], n)
        part_area = np.bincount(part[T[:, 0]], np.where(removed, 0, area), n)
        small = part_area < crumb
        small[farthest_of_each(component, part, part_area)] = False  # the largest of a component
        small &= np.isin(np.arange(n), part[T[removed]])
        dropped = removed | small[part[T[:, 0]]]
        restored = dropped & _separates(T, dropped, part)
        if not restored.any():
            removed = dropped
            break
        removed = removed & ~restored
    was_closed = (left_at_edge() == 1) & (count == 2)
    opened = np.tile(~removed, 3) & was_closed[edge_of]
    return _close_with_fans(X, T[~removed], directed_edges(T)[opened])


def _separates(T, dropped, part):
    """Find triangles ``(m,)`` of holes in the removed ones that touch several remaining parts."""
    hole = components(directed_edges(T[dropped]), len(part))
    vertex = np.unique(T[dropped])
    vertex = vertex[np.isin(part[vertex], part[T[~dropped, 0]])]
    touching = np.unique(np.stack([hole[vertex], part[vertex]], axis=1), axis=0)  # (hole, part)
    return (np.bincount(touching[:, 0], minlength=len(part)) > 1)[hole[T[:, 0]]]


def _close_with_fans(X, T, half):
    """Close each loop of the open half-edges ``(h, 2)`` with a fan."""
    n = len(X)
    corner, link = np.unique(half, return_inverse=True)
    link = link.reshape(-1, 2)
    loop = components(link, len(corner))[link[:, 0]]  # (h,)
    on_loop = sp.csr_matrix((np.ones(len(half)), (loop, half[:, 0])), (loop.max(initial=-1) + 1, n))
    centre = (on_loop @ X) / np.asarray(on_loop.sum(axis=1))
    T = np.concatenate([T, np.stack([half[:, 1], half[:, 0], n + loop], axis=1)])
    used, T = np.unique(T, return_inverse=True)
    return np.concatenate([X, centre])[used], T.reshape(-1, 3), np.where(used < n, used, -1)
