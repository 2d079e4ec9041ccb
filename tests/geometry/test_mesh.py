"""Edges, orders and paths of a mesh: against other ways to find them, and where nothing is."""

import numpy as np
import pytest
import xarray as xr
from scipy.sparse.csgraph import dijkstra

import s4a
from s4a.evaluation.metrics import evaluate
from s4a.geometry.mesh import (
    as_arrays,
    as_dataset,
    counting_order,
    directed_edges,
    edge_graph,
    edges,
    equal_rows,
    lexical_order,
    norms,
    path_lengths,
    sums_at_vertices,
    triangle_areas,
    unique_edges,
)


def whole(kind):
    """An ellipsoid whose positions are whole numbers of that kind."""
    X, T = as_arrays(s4a.synthetic.ellipsoid(300))
    mesh = as_dataset(X, T.astype(np.int64))
    return mesh.assign(
        position=(mesh["position"].dims, np.round(10_000 * X).astype(kind)),
        corner_vertex=(mesh["corner_vertex"].dims, T.astype(np.int64)),
    )


def test_arrays_of_a_mesh_have_one_kind_and_are_no_copies_of_what_has_it():
    X, T = as_arrays(whole(np.int16))
    assert (X.dtype, T.dtype) == (np.float64, np.int32)
    mesh = s4a.synthetic.ellipsoid(300)
    for values, name in zip(as_arrays(mesh), ("position", "corner_vertex"), strict=True):
        assert np.shares_memory(values, mesh[name].values)
    with pytest.raises(TypeError, match="Cannot cast"):
        as_arrays(mesh.assign(corner_vertex=mesh["corner_vertex"] + 0.5))


@pytest.mark.parametrize("kind", [np.int16, np.int64, np.float32])
def test_positions_of_any_kind_are_those_numbers(kind):
    mesh, same = whole(kind), whole(np.float64)
    assert s4a.coarsen(mesh, n_coarse=100).identical(s4a.coarsen(same, n_coarse=100))
    found, expected = (
        s4a.match_pair(one, one, n_coarse=100, k=10, k_init=6) for one in (mesh, same)
    )
    xr.testing.assert_identical(found, expected)
    match = np.arange(300)[::-1]
    xr.testing.assert_identical(*(evaluate(one, one, match) for one in (mesh, same)))
    X, T = mesh["position"].values, mesh["corner_vertex"].values
    assert np.array_equal(triangle_areas(X, T), triangle_areas(*as_arrays(same)))


@pytest.fixture(scope="module")
def sphere():
    return as_arrays(s4a.synthetic.sphere(300))


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.uint32, np.uint8])
def test_unique_edges_are_those_of_numpy(kind, sphere):
    T = sphere[1][sphere[1].max(1) < 200].astype(kind)
    both = np.sort(directed_edges(T.astype(int)), axis=1)
    expected, of, count = np.unique(both, axis=0, return_inverse=True, return_counts=True)
    E, edge_of, n = unique_edges(T)
    assert np.array_equal(E, expected)
    assert np.array_equal(edge_of, of.ravel())
    assert np.array_equal(n, count)


def test_vertices_without_triangles_do_not_change_the_edges(sphere):
    T, far = sphere[1], 2**20
    E, edge_of, count = unique_edges(T)
    found = unique_edges(T + far, far + len(sphere[0]))
    assert np.array_equal(found[0], E + far)
    assert np.array_equal(found[1], edge_of)
    assert np.array_equal(found[2], count)


def test_edges_of_vertices_that_are_not_there_are_refused():
    with pytest.raises(IndexError, match="0 to 2 needed, found 0 to 3"):
        unique_edges(np.array([[0, 1, 3]]), 3)


def test_no_triangles_have_no_edges():
    E, edge_of, count = unique_edges(np.zeros((0, 3), int))
    assert (E.shape, len(edge_of), len(count)) == ((0, 2), 0, 0)


def test_counting_sorts_as_a_stable_sort():
    key = np.random.default_rng(0).integers(0, 50, 1000)
    assert np.array_equal(counting_order(key, 50), np.argsort(key, kind="stable"))


@pytest.mark.parametrize("key", [[-1, 0], [0, 2]])
def test_numbers_that_are_not_counted_are_refused(key):
    with pytest.raises(IndexError, match="0 to 1 needed"):
        counting_order(np.array(key), 2)


@pytest.mark.parametrize("kind", [int, float])
def test_equal_rows_are_found_alike_for_integers_and_others(kind):
    A = np.random.default_rng(0).integers(0, 5, (200, 3)).astype(kind)
    first, group = equal_rows(A)
    assert np.array_equal(A[first][group], A)
    assert len(first) == len(np.unique(A, axis=0))
    assert all(np.flatnonzero(group == g)[0] == f for g, f in enumerate(first))


def test_paths_are_those_of_dijkstra_from_neighbours_to_the_limit(sphere):
    X, T = sphere
    G = edge_graph(X, edges(T))
    start, end = np.divmod(np.arange(0, len(X) ** 2, 97), len(X))
    whole = dijkstra(G)[start, end]
    assert np.allclose(path_lengths(G, start, end, 0.8), np.minimum(whole, 0.8), atol=1e-12)


def test_paths_that_are_searched_around_their_ends_are_the_same(sphere):
    X, T = sphere
    G = edge_graph(X, edges(T))
    start, end = np.divmod(np.arange(0, len(X) ** 2, 97), len(X))
    for limit in (0.8, 9.0):
        whole = path_lengths(G, start, end, limit)
        assert np.array_equal(path_lengths(G, start, end, limit, X), whole)


@pytest.mark.parametrize("d", [1, 3, 6])
def test_norms_are_those_of_numpy(d):
    vectors = np.random.default_rng(0).normal(size=(1000, d))
    assert np.array_equal(norms(vectors), np.linalg.norm(vectors, axis=1))


def test_sums_at_vertices_are_those_of_bincount(sphere):
    X, T = sphere
    values = np.random.default_rng(0).normal(size=(len(T), 2))
    sums = [np.bincount(T.ravel(), np.repeat(column, 3), len(X)) for column in values.T]
    assert np.array_equal(sums_at_vertices(T, values, len(X)), np.stack(sums, axis=1))
    with pytest.raises(IndexError, match="numbers from 0 to 9"):
        sums_at_vertices(T, values, 10)


def test_no_pairs_have_no_paths(sphere):
    X, T = sphere
    none = np.zeros(0, int)
    assert len(path_lengths(edge_graph(X, edges(T)), none, none, 1.0)) == 0


@pytest.mark.parametrize(
    "A",
    [
        np.random.default_rng(0).random((200, 3)),
        np.random.default_rng(1).random((40, 3)).repeat(5, axis=0),
        np.random.default_rng(2).integers(0, 3, (200, 3)).astype(float),
        np.random.default_rng(3).choice([np.nan, -np.inf, 0.0, -0.0, 1.0], (200, 2)),
        np.random.default_rng(4).integers(0, 50, (200, 2)),
        np.empty((0, 3)),
        np.ones((1, 3)),
    ],
    ids=["apart", "repeated", "few values", "special values", "integers", "none", "one"],
)
def test_the_lexical_order_is_that_of_numpy(A):
    assert np.array_equal(lexical_order(A), np.lexsort(A.T))
