"""Voronoi cells and their dual (4.1, step 1): faults that are drawn are found, and no others."""

import numpy as np
import pytest

from s4a.geometry.mesh import directed_edges
from s4a.geometry.voronoi import (
    between_boundaries,
    boundaries,
    cut_handles,
    dual,
    faults,
    mesh_graph,
    refine,
    voronoi_cells,
)


def sheet(*rows):
    """A flat mesh with a vertex for each letter of a drawing: its graph, cells, number of cells."""
    cell = np.array([[int(letter) for letter in row] for row in rows])
    nx, ny = cell.shape
    x, y = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    i, j = x[:-1, :-1].ravel(), y[:-1, :-1].ravel()
    a, b, c, d = i * ny + j, (i + 1) * ny + j, (i + 1) * ny + j + 1, i * ny + j + 1
    T = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    X = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(float)
    return mesh_graph(X, T), cell.ravel(), cell.max() + 1


def ball(n=24):
    """A sphere of meridians and parallels, and the longitude of each vertex."""
    latitude, longitude = np.meshgrid(
        np.linspace(-1.4, 1.4, n), np.arange(n) * 2 * np.pi / n, indexing="ij"
    )
    rings = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ],
        axis=2,
    ).reshape(-1, 3)
    X = np.concatenate([rings, [[0, 0, -1], [0, 0, 1]]])
    i, j = np.meshgrid(np.arange(n - 1), np.arange(n), indexing="ij")
    a, b = (i * n + j).ravel(), (i * n + (j + 1) % n).ravel()
    ring = np.arange(n)
    south = np.stack([np.full(n, n * n), (ring + 1) % n, ring], axis=1)
    north = np.stack([np.full(n, n * n + 1), ring, (ring + 1) % n], axis=1)
    north[:, 1:] += n * (n - 1)
    T = np.concatenate(
        [np.stack([a, b, b + n], axis=1), np.stack([a, b + n, a + n], axis=1), south, north]
    )
    return X, T, np.r_[longitude.ravel(), 0, 0]


def test_cells_that_meet_as_they_should_have_no_fault():
    found = faults(*sheet("000111", "000111", "002211", "222222", "222222"))
    assert not found.cell.any()
    assert len(found.pair) == len(found.edge) == len(found.triangle) == 0


def test_a_cell_around_another_has_two_rims():
    found = faults(*sheet("0000022", "0011022", "0011033", "0000033"))
    assert found.cell.tolist() == [True, True, False, False]  # the inner one has no triangle


def test_a_border_in_two_pieces_is_a_fault_of_the_pair_with_the_edges_across():
    graph, cell, n = sheet("000111", "000111", "002211", "002211", "000111", "000111")
    found = faults(graph, cell, n)
    assert not found.cell.any()
    assert found.pair.tolist() == [[0, 1]]
    assert (np.sort(cell[graph.E[found.edge]], axis=1) == [0, 1]).all()
    assert (found.edge_pair == 0).all()


def test_three_slices_of_a_ball_meet_twice():
    X, T, longitude = ball()
    cell = np.floor(longitude / (2 * np.pi) * 3).astype(int)
    found = faults(mesh_graph(X, T), cell, 3)
    assert not found.cell.any()
    assert len(found.pair) == 0
    assert len(found.triangle) == len(dual(T, cell)) == 2


def test_a_cell_that_a_changed_neighbour_leaves_without_triangle_is_a_fault():
    graph, cell, n = sheet("00", "11", "23", "23")
    bad = faults(graph, cell, n, among=np.array([False, True, False, False])).cell
    assert bad[0]
    assert (bad == faults(graph, cell, n).cell).all()


def test_more_samples_mend_what_is_faulty():
    X, T, longitude = ball()
    graph = mesh_graph(X, T)
    slices = [np.abs(longitude[: len(X) - 2] - angle).argmin() for angle in (0, 2.1, 4.2)]
    start = voronoi_cells(graph.G, np.array(slices) + 24 * 12)
    assert len(faults(graph, start.cell, 3).triangle) == 2
    state, iterations, faulty = refine(graph, start, 50, np.zeros(len(X), bool))
    assert (iterations > 0, faulty) == (True, False)
    found = faults(graph, state.cell, len(state.sample))
    assert not found.cell.any()
    assert len(found.pair) == len(found.triangle) == 0


@pytest.mark.parametrize("rows, n_rims", [(("000", "010", "000"), 2), (("00", "00"), 0)])
def test_rims_lead_out_of_a_region(rows, n_rims):
    graph, cell, _ = sheet(*rows)
    triangle, vertex, boundary, owner = boundaries(graph.T, cell)
    assert len(owner) == n_rims
    assert sorted(owner.tolist()) == list(range(n_rims))
    assert (cell[vertex] == owner[boundary]).all()
    assert set(triangle) <= set(range(len(graph.T)))


def test_a_torus_that_is_cut_is_closed_to_a_ball():
    n, m = 24, 12
    u, v = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.arange(m) * 2 * np.pi / m, indexing="ij")
    r = 1 + 0.4 * np.cos(v)
    X = np.stack([r * np.cos(u), r * np.sin(u), 0.4 * np.sin(v)], axis=2).reshape(-1, 3)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    T = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    Y, F, origin = cut_handles(X, T, np.tile(i == 5, 2), crumb=0.0)
    graph = mesh_graph(Y, F)
    assert not graph.is_open.any()
    assert len(np.unique(directed_edges(F), axis=0)) == 3 * len(F)  # all turned the same way
    assert len(Y) - len(graph.E) + len(F) == 2
    assert (origin < 0).sum() == 2  # the centres of two fans
    np.testing.assert_array_equal(Y[origin >= 0], X[origin[origin >= 0]])


def test_what_would_cut_off_more_than_a_crumb_stays():
    X, T, _ = ball()
    belt = np.abs(X[T][:, :, 2].mean(1) - 0.2) < 0.1
    Y, F, origin = cut_handles(X, T, belt, crumb=1.0)
    assert len(Y) == len(X)
    assert len(F) == len(T)
    assert (origin >= 0).all()


def test_a_piece_of_a_region_that_no_rim_bounds_is_not_cut():
    X, T, _ = ball()
    n = len(X)
    assert not between_boundaries(
        mesh_graph(X, T).G, T, np.zeros(n, int)
    ).any()  # closed, all one region
    two = mesh_graph(np.r_[X, X + 9], np.r_[T, T + n])  # beside one that has two boundaries
    height = np.r_[X[:, 2], np.full(n, 0.0)]
    removed = between_boundaries(two.G, two.T, np.where(np.abs(height) < 0.5, 0, -1))
    assert removed[: len(T)].any()
    assert not removed[len(T) :].any()
