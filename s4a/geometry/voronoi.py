"""Geodesic Voronoi cells on a surface and their dual as a manifold mesh (4.1, step 1).

The dual of the cells is a manifold when every cell has one rim, every two neighbouring cells share
one border, and no three cells meet twice.  Where this fails, samples are added (:func:`refine`);
where that would cost too many, as on scans full of pin-holes, the surface itself is simplified:
tubes about a cell thin are cut (:func:`cut_handles`).
"""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, dijkstra

from s4a.geometry.mesh import components, directed_edges, triangle_areas, unique_edges


def farthest_of_each(group, vertex, distance):
    """The vertex of greatest distance in every group."""
    order = np.lexsort((distance[vertex], group))
    return vertex[order[np.append(np.diff(group[order]) != 0, True)[: len(order)]]]


def add_samples(G, new, sample, cell, distance):
    """Voronoi cells along edges after new samples.

    Only vertices that are nearer to one of these change.

    Returns
    -------
    sample : int ndarray (samples,)
    cell : int ndarray (n,)
        Number of each vertex's nearest sample.
    distance : float ndarray (n,)
    """
    to_new, _, nearest = dijkstra(
        G, indices=new, min_only=True, return_predecessors=True, limit=distance.max()
    )
    number = np.full(len(cell), -1)
    number[new] = len(sample) + np.arange(len(new))
    nearer = to_new < distance
    cell, distance = cell.copy(), distance.copy()
    cell[nearer], distance[nearer] = number[nearest[nearer]], to_new[nearer]
    return np.r_[sample, new], cell, distance


def voronoi_cells(G, sample):
    """Samples, cells and distances of :func:`add_samples`.

    With a sample more in every component that had none.
    """
    n = G.shape[0]
    part = connected_components(G, directed=False)[1]
    first = np.unique(part, return_index=True)[1]
    sample = np.union1d(sample, first[~np.isin(part[first], part[sample])])
    return add_samples(G, sample, np.empty(0, np.int64), np.full(n, -1), np.full(n, np.inf))


def dual(T, cell):
    """Triangles between cells.

    One for each triangle of the mesh whose corners lie in three cells.
    """
    L = cell[T]
    return L[(L[:, 0] != L[:, 1]) & (L[:, 1] != L[:, 2]) & (L[:, 2] != L[:, 0])]


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
    """Which of the suspect cells have no rim or several.

    Handles and holes inside a single rim do no harm.
    """
    owner = rims(T, np.where(suspect[cell], cell, -1))[3]
    return suspect & (np.bincount(owner, minlength=len(suspect)) != 1)


def faults(T, E, open_edge, cell, n, among=None):
    """Cells, pairs of cells and triangles that keep the dual from being a manifold.

    Parameters
    ----------
    T, E, open_edge
        Triangles, edges and which of these lie on the boundary.
    cell : int ndarray (vertices,)
    n : int
        Number of cells.
    among : bool ndarray (n,), optional
        Faults in which none of these cells takes part are not looked for, but their neighbours
        without triangle are.

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
    among = np.ones(n, bool) if among is None else among
    triangle, edge = (
        np.flatnonzero(np.logical_or.reduce([among[cell][v] for v in rows.T])) for rows in (T, E)
    )
    L, ends, open_edge = cell[T[triangle]], cell[E[edge]], open_edge[edge]
    inner = ends[:, 0] == ends[:, 1]
    a, b, c = L[:, 0] == L[:, 1], L[:, 1] == L[:, 2], L[:, 2] == L[:, 0]
    euler = np.bincount(cell, minlength=n) - np.bincount(ends[inner, 0], minlength=n)
    euler += np.bincount(L[a & b, 0], minlength=n)
    corner = np.flatnonzero(~(a | b | c))
    C = L[corner]
    stretches = np.bincount(ends[open_edge & ~inner].ravel(), minlength=n)
    bad = many_rims(T[triangle], cell, among & (euler != 1))
    lone = (np.bincount(ends.ravel(), minlength=n) > 0) & (np.bincount(C.ravel(), minlength=n) == 0)
    if (lone & ~among).any():  # of neighbours not all triangles were looked at
        lone[dual(T, cell)] = False
    bad |= lone | (among & (stretches > 2))

    border = np.flatnonzero(~inner)
    pair, strip = np.unique(np.sort(ends[border], axis=1) @ [n, 1], return_inverse=True)
    half = directed_edges(C)
    half = np.sort(half[among[half].any(1)], axis=1) @ [n, 1]
    strip_ends = np.bincount(np.searchsorted(pair, half), minlength=len(pair))
    strip_ends += np.bincount(strip[open_edge[border]], minlength=len(pair))
    bad_pair = strip_ends != 2
    at = bad_pair[strip]
    row = np.cumsum(bad_pair) - 1

    _, triple, count = np.unique(
        np.sort(C, axis=1) @ [n * n, n, 1], return_inverse=True, return_counts=True
    )
    pairs = np.stack([pair[bad_pair] // n, pair[bad_pair] % n], axis=1)
    return bad, pairs, edge[border[at]], row[strip[at]], triangle[corner[count[triple] > 1]]


def refine(G, T, E, open_edge, state, most, avoid):
    """Add samples where the dual is not a manifold until it is.

    Or until there are more than `most`.

    The vertices to avoid are only taken where there are no others.  Returns the samples, cells and
    distances, the number of rounds, and whether faults are left.
    """
    rounds, changed = 0, np.ones(len(state[0]), bool)
    while True:
        sample, cell, distance = state
        distance = np.where(avoid, 1e-9, 1) * distance
        bad, _, edge, row, repeated = faults(T, E, open_edge, cell, len(sample), changed)
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
        state = add_samples(
            G, farthest_of_each(cell[new], new, distance), *state
        )  # one in each cell
        moved = state[1] != cell
        changed = np.zeros(
            len(state[0]), bool
        )  # every fault had a new sample in one of its cells: others have none
        changed[cell[moved]] = changed[state[1][moved]] = True
        rounds += 1


def thin_regions(T, E, open_edge, cell, n):
    """Cells that are no disk.

    And pairs of cells that are none together, as disjoint regions of vertices.
    """
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

    Vertices where sheets would touch go, too; pieces of less area than `crumb` that come off are
    dropped, and what would cut off more is not removed.

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
        small[farthest_of_each(component, part, part_area)] = (
            False  # of every component something stays
        )
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
