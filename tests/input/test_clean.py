from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from paths import DATA
from scipy.spatial import ConvexHull
from surfaces import assert_oriented_manifold

from s4a import synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, triangle_areas, volume
from s4a.input.clean import clean, clean_arrays
from s4a.input.collection import read_shape, read_shapes
from s4a.input.files import write_mesh


def cleaned(X, T, **options):
    X, T, file_vertex, _, counts = clean_arrays(X, T, **options)
    assert_oriented_manifold(X, T)
    assert np.isfinite(X).all()
    assert len(file_vertex) == len(X)
    return X, T, counts


def sphere(n=200, seed=0):
    X = np.random.default_rng(seed).normal(size=(n, 3))
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    hull = ConvexHull(X)
    N = np.cross(
        X[hull.simplices[:, 1]] - X[hull.simplices[:, 0]],
        X[hull.simplices[:, 2]] - X[hull.simplices[:, 0]],
    )
    inwards = (N * hull.equations[:, :3]).sum(1) < 0
    return X, np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)


def torus():
    return as_arrays(synthetic.torus(12, 8))


def cube(corner):
    X = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) + corner
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return X, np.array([[a, b, c] for a, b, c, d in quads] + [[a, c, d] for a, b, c, d in quads])


def together(*meshes):
    offsets = np.cumsum([0, *(len(X) for X, _ in meshes)])
    points = np.concatenate([X for X, _ in meshes])
    return points, np.concatenate([T + n for (_, T), n in zip(meshes, offsets, strict=False)])


def triangle_set(X, T):
    """The triangles as points, from their smallest corner on, sorted."""
    points = np.round(X, 4)[T]
    first = (points @ [1e8, 1e4, 1]).argmin(axis=1)
    points = np.take_along_axis(
        points, ((first[:, None] + np.arange(3)) % 3)[:, :, None], 1
    ).reshape(len(T), 9)
    return points[np.lexsort(points.T)]


# what is clean stays


def test_a_clean_surface_stays_as_it_is():
    X, T = sphere()
    mesh = clean(as_dataset(X, T))
    np.testing.assert_array_equal(mesh["position"], X)
    np.testing.assert_array_equal(mesh["corner_vertex"], T)
    np.testing.assert_array_equal(mesh["file_vertex"], np.arange(len(X)))
    assert (mesh.attrs["status"], mesh.attrs["reason"]) == ("ok", "")


def test_cleaning_twice_changes_nothing_more():
    X, T = together(cube([0, 0, 0]), cube([1, 1, 0]), sphere())
    once = cleaned(X, T, components="all")
    twice = cleaned(*once[:2], components="all")
    assert twice[2]["components"] == 3
    np.testing.assert_array_equal(triangle_set(*once[:2]), triangle_set(*twice[:2]))


def test_holes_and_genus_are_counted():
    X, T = torus()
    counts = cleaned(X, T)[2]
    assert (counts["genus"], counts["holes"], counts["euler_characteristic"]) == (1, 0, 0)
    far = np.linalg.norm(X[T].mean(1)[:, None] - X[T].mean(1)[[0, 90]], axis=2).min(axis=1) > 0
    counts = cleaned(X, T[far])[2]
    assert (counts["genus"], counts["holes"], counts["euler_characteristic"]) == (1, 2, -2)


# vertices


def test_a_triangle_unconnected_is_welded():
    X, T = sphere()
    noise = 1e-8 * np.random.default_rng(0).normal(size=(3 * len(T), 3))
    for unconnected in (
        X[T].reshape(-1, 3),
        X[T].reshape(-1, 3) + noise,
        X[T].reshape(-1, 3).astype(np.float32),
    ):
        Y, _, counts = cleaned(unconnected, np.arange(3 * len(T)).reshape(-1, 3))
        assert (len(Y), counts["components"], counts["genus"], counts["holes"]) == (len(X), 1, 0, 0)


def test_a_far_outlier_does_not_weld_the_shape():
    X, T = sphere()
    Y, _, counts = cleaned(
        *together((X, T), (1e9 + cube([0, 0, 0])[0], cube([0, 0, 0])[1])), components="all"
    )
    assert (len(Y), counts["components"]) == (len(X) + 8, 2)


def cracked(distance):
    """A sphere whose triangles have one or the other of two vertices at a small distance."""
    X, T = sphere()
    with_it = np.flatnonzero((T == 0).any(axis=1))[::2]
    T[with_it] = np.where(T[with_it] == 0, len(X), T[with_it])
    return np.concatenate([X, X[:1] + [[0, 0, distance]]]), T


@pytest.mark.parametrize("share, welded", [(0.5, 1), (5, 0)])
def test_vertices_are_welded_up_to_1e_7_of_the_diagonal(share, welded):
    X, _ = sphere()
    diagonal = np.linalg.norm(np.ptp(X, axis=0))
    _, _, counts = cleaned(*cracked(share * 1e-7 * diagonal))
    assert counts["welded_vertices"] == welded


@pytest.mark.parametrize("share, welded", [(0.5, 1), (5, 0)])
def test_with_a_far_outlier_vertices_are_welded_up_to_1e_3_of_the_median_side(share, welded):
    X, T = sphere()
    side = np.median(np.linalg.norm(X[T] - X[np.roll(T, 1, axis=1)], axis=2))
    outlier, sides = cube([0, 0, 0])
    parts = cracked(share * 1e-3 * side), (1e5 + outlier, sides)
    _, _, counts = cleaned(*together(*parts), components="all")
    assert counts["welded_vertices"] == welded


def test_crowded_vertices_are_refused_before_memory_runs_out():
    X, T = sphere(2000)
    with pytest.raises(ValueError, match="distinct vertices needed"):
        clean_arrays(*together(*[sphere(30, seed) for seed in range(200)], (X * 1e-9, T)))


def test_vertices_that_are_not_finite_go_with_their_triangles():
    X, T = sphere()
    X[7] = np.nan
    _, S, counts = cleaned(X, T)
    assert (counts["nonfinite_vertices"], counts["holes"]) == (1, 1)
    assert len(S) == (T != 7).all(axis=1).sum()
    with pytest.raises(ValueError, match=r"1 of 200 vertices are not finite"):
        clean_arrays(X, T, strict=True)


def test_the_way_to_the_file_and_back():
    X, T = sphere()
    X = np.concatenate(
        [[[9, 9, 9]], X, X[[5]], [[np.inf, 0, 0]]]
    )  # unused, ..., a copy of file vertex 6, not finite
    T = T + 1
    T[np.flatnonzero((T == 6).any(axis=1))[0]] = np.where(
        T[(T == 6).any(axis=1)][0] == 6, 201, T[(T == 6).any(axis=1)][0]
    )
    Y, _, file_vertex, vertex_of_file, counts = clean_arrays(X, T)
    np.testing.assert_array_equal(Y, X[file_vertex])
    np.testing.assert_array_equal(vertex_of_file[file_vertex], np.arange(len(Y)))
    assert vertex_of_file[[0, 202]].tolist() == [-1, -1]
    assert vertex_of_file[6] == vertex_of_file[201]
    assert (counts["welded_vertices"], counts["unreferenced_vertices"]) == (1, 2)


# triangles


def test_copies_of_triangles_go_whatever_their_winding():
    X, T = sphere()
    Y, S, counts = cleaned(X, np.concatenate([T, T[:3, ::-1], T[5:8, [1, 2, 0]], [[4, 4, 9]]]))
    np.testing.assert_array_equal(triangle_set(Y, S), triangle_set(X, T))
    assert (counts["duplicate_triangles"], counts["degenerate_triangles"]) == (6, 1)


def test_a_double_sided_surface_keeps_one_side():
    X, T = sphere()
    T = T[X[T].mean(1)[:, 2] > 0]
    _, S, counts = cleaned(X, np.concatenate([T, T[:, ::-1]]))
    assert (len(S), counts["holes"]) == (len(T), 1)


def test_solids_glued_face_to_face_become_one():
    X, T = together(cube([0, 0, 0]), (cube([0, 0, 0])[0] * [-1, 1, 1], cube([0, 0, 0])[1][:, ::-1]))
    Y, S, counts = cleaned(X, T)
    assert (counts["components"], counts["holes"], counts["genus"]) == (1, 0, 0)
    assert volume(Y, S) == pytest.approx(2)


def test_a_zero_area_triangle_goes_without_a_crack():
    X, T = sphere()
    p, q, r = T[0]
    X = np.concatenate(
        [X, [(X[p] + X[q]) / 2]]
    )  # on the edge p q, as a corner of the triangle below it only
    T = np.concatenate([T[1:], [[p, len(X) - 1, r], [len(X) - 1, q, r], [p, q, len(X) - 1]]])
    Y, S, counts = cleaned(X, T)
    assert (counts["flipped_edges"], counts["holes"], counts["genus"], len(Y)) == (1, 0, 0, len(X))
    assert triangle_areas(Y, S).min() > 1e-6


def test_a_row_of_collinear_vertices_is_flipped_away():
    X, T = sphere()
    p, q, r = T[0]
    t = np.linspace(0, 1, 7)[1:-1, None]
    line = [p, *range(len(X), len(X) + 5), q]
    X = np.concatenate([X, (1 - t) * X[p] + t * X[q]])
    fan = [[a, b, r] for a, b in pairwise(line)]
    flat = [[q, b, a] for a, b in pairwise(line[:-1])]
    Y, S, counts = cleaned(X, np.concatenate([T[1:], fan, flat]))
    assert (counts["holes"], counts["genus"], len(Y)) == (0, 0, len(X))
    assert triangle_areas(Y, S).min() > 1e-6


def test_a_zero_area_triangle_at_the_boundary_is_dropped():
    X = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [1, 1, 0]], float)
    _, S, counts = cleaned(X, np.array([[0, 2, 3], [2, 1, 3], [0, 1, 2]]))
    assert (len(S), counts["flat_triangles"], counts["holes"]) == (2, 1, 1)


# topology


def test_solids_that_touch_in_an_edge_or_a_vertex_are_separated():
    for shift in ([1, 1, 0], [1, 1, 1]):
        Y, S, counts = cleaned(*together(cube([0, 0, 0]), cube(shift)), components="all")
        assert (counts["components"], counts["holes"], counts["genus"], len(Y)) == (2, 0, 0, 16)
        assert volume(Y, S) == pytest.approx(2)


def test_a_surface_that_touches_itself_in_an_edge_stays_closed():
    # the first two cubes touch in an edge
    ring = [[0, 0, 0], [1, 1, 0], [1, 1, 1], [0, 1, 1], [0, 0, 1]]
    X, T = together(*[cube(corner) for corner in ring])
    _, _, counts = cleaned(X, T)
    assert counts["nonmanifold_edges"] > 0
    assert (counts["components"], counts["holes"], counts["cut_edges"]) == (1, 0, 0)


def test_a_fin_is_cut_off():
    X, T = sphere()
    fin = [T[0, 0], T[0, 1], len(X)]
    Y, S, counts = cleaned(
        np.concatenate([X, [2 * X[T[0, 0]]]]), np.concatenate([T, [fin]]), components="largest"
    )
    assert (counts["nonmanifold_edges"], counts["cut_edges"], counts["dropped_components"]) == (
        1,
        1,
        1,
    )
    np.testing.assert_array_equal(triangle_set(Y, S), triangle_set(X, T))


def test_random_winding_is_made_consistent_and_outwards():
    X, T = torus()
    turned = np.random.default_rng(0).random(len(T)) < 0.5
    for T_file in (np.where(turned[:, None], T[:, ::-1], T), T[:, ::-1]):
        Y, S, counts = cleaned(X, T_file)
        assert volume(Y, S) > 0
        assert counts["reoriented_triangles"] > 0
        np.testing.assert_array_equal(triangle_set(Y, S), triangle_set(X, T))


def test_an_open_shape_faces_outwards_too():
    X, T = sphere()
    T = T[X[T].mean(1)[:, 2] > -0.8]
    np.testing.assert_array_equal(
        triangle_set(*cleaned(X + 100, T[:, ::-1])[:2]), triangle_set(X + 100, T)
    )


def test_a_moebius_strip_is_cut_into_one_that_has_two_sides():
    n = 20
    u = 2 * np.pi * np.arange(n) / n
    s = np.repeat([-1, 1], n)  # the two sides of the strip
    r, u = 3 + s * np.cos(np.tile(u, 2) / 2), np.tile(u, 2)
    boundary = np.stack([r * np.cos(u), r * np.sin(u), s * np.sin(u / 2)], axis=1)
    a, b = np.arange(n), n + np.arange(n)
    c, d = np.r_[a[1:], b[0]], np.r_[b[1:], a[0]]
    T = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])
    _, S, counts = cleaned(boundary, T)
    assert len(S) == 2 * n
    assert counts["components"] == counts["holes"] == counts["euler_characteristic"] == 1


def test_an_edge_with_very_many_triangles_is_cut():
    n = 1000
    u = 2 * np.pi * np.arange(n) / n
    X = np.concatenate([[[0, 0, 0], [0, 0, 1]], np.stack([np.cos(u), np.sin(u), np.zeros(n)], 1)])
    book = np.stack([np.zeros(n, int), np.ones(n, int), 2 + np.arange(n)], axis=1)
    assert cleaned(X, book, components="all")[2]["components"] == n


# components


def test_components_are_kept_as_asked():
    ball = sphere()
    X, T = together(ball, (0.3 * ball[0] + 3, ball[1]), (0.2 * ball[0] - 3, ball[1]))
    for asked, kept in (("largest", 1), (2, 2), ("all", 3), (7, 3)):
        Y, _, counts = cleaned(X, T, components=asked)
        assert (len(Y), counts["components"], counts["dropped_components"]) == (
            kept * len(ball[0]),
            3,
            3 - kept,
        )
    assert cleaned(X, T)[2]["area_dropped"] == pytest.approx(0.13 / 1.13)


def test_a_largest_component_under_half_is_an_error_with_the_way_out():
    X, T = together(cube([0, 0, 0]), cube([5, 0, 0]), cube([0, 5, 0]))
    with pytest.raises(
        ValueError, match=r"largest of 3 components has 33\.3 %.*components=3 keeps 90 %"
    ):
        clean_arrays(X, T)
    assert cleaned(X, T, components=1)[2]["dropped_components"] == 2


# input that is no mesh


@pytest.mark.parametrize(
    "triangles, message",
    [
        ([[0, 1, 9]], r"0\.\.3, as there are 4 vertices; found 0\.\.9, 1 triangles out of range"),
        ([[0, 1, -1]], r"found -1\.\.1"),
        ([[0.0, 1.0, 2.0]], r"integer"),
        (np.empty((0, 3), int), r"found \(4, 3\) and \(0, 3\)"),
        ([[0, 1]], r"found \(4, 3\) and \(1, 2\)"),
        ([[0, 1, 1]], r"triangles with area"),
        ([[0, 1, 3]], r"triangles with area"),
        ([[0, 0, 0]], "triangles are points"),
    ],
)
def test_what_is_no_surface_is_refused(triangles, message):
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]])
    with pytest.raises(ValueError, match=message):
        clean_arrays(X, np.array(triangles))
    with pytest.raises(ValueError, match=r"components needs"):
        clean_arrays(X, np.array([[0, 1, 2]]), components=0)


def test_any_heap_of_triangles_becomes_a_manifold_or_an_error():
    rng = np.random.default_rng(0)
    manifolds = 0
    for i in range(60):
        n, m = rng.integers(3, 12), rng.integers(1, 40)
        X = (
            rng.normal(size=(n, 3))
            if i % 3 == 0
            else rng.integers(0, 3, (n, 3)) + (i % 3 - 1) * 1e-8 * rng.random((n, 3))
        )
        X[rng.random(n) < 0.02] = np.nan
        T = rng.integers(0, n, (m, 3))
        try:
            counts = cleaned(X, T, components="all")[2]
        except ValueError:
            continue
        assert counts["genus"] >= 0
        manifolds += 1
    assert manifolds > 40


def shuffled(X, T, seed=0):
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(X))
    T = np.argsort(order)[T][rng.permutation(len(T))]
    return X[order], np.take_along_axis(
        T, (rng.integers(0, 3, len(T))[:, None] + np.arange(3)) % 3, 1
    )


def test_the_order_of_vertices_and_triangles_does_not_matter():
    X, T = together(
        *[cube(c) for c in ([0, 0, 0], [1, 1, 0], [1, 1, 1], [0, 1, 1], [0, 0, 1])], torus()
    )
    expected = triangle_set(*cleaned(X, T, components="all")[:2])
    for seed in range(5):
        np.testing.assert_array_equal(
            triangle_set(*cleaned(*shuffled(X, T, seed), components="all")[:2]), expected
        )


# real files


@pytest.fixture(params=["C57BL6_J", "DBA_2J", "WSB"])
def skull(request):
    path = DATA / "mouse_skulls" / f"{request.param}.ply"
    if not path.exists():
        pytest.skip("needs the shared data")
    return path


def test_skulls_become_closed_manifolds(skull):
    mesh = read_shape(skull)
    assert_oriented_manifold(mesh["position"].values, mesh["corner_vertex"].values)
    assert mesh.attrs["nonmanifold_edges"] > 50
    assert (mesh.attrs["holes"], mesh.attrs["coordinate_system"]) == (0, "LPS")
    assert mesh.attrs["area_dropped"] < 0.02
    assert mesh.attrs["nonfinite_vertices"] == (2 if skull.stem == "WSB" else 0)


def packed(name):
    path = DATA / name
    if not path.exists():
        pytest.skip("needs the shared data")
    return read_shape(path)


def test_a_head_keeps_its_surface_and_its_tunnels():
    mesh = packed("synthseg_brains/icv_mc_01.npz")
    assert_oriented_manifold(mesh["position"].values, mesh["corner_vertex"].values)
    assert (mesh.attrs["euler_characteristic"], mesh.attrs["holes"], mesh.attrs["components"]) == (
        -242,
        0,
        824,
    )
    assert mesh.attrs["reason"] == "823 components dropped (4.6 % of the area)"


def test_a_template_brain_is_repaired_in_any_order():
    mesh = packed("brain_templates/mni152_2009mini.npz")
    X, T = mesh["position"].values, mesh["corner_vertex"].values
    assert_oriented_manifold(X, T)
    with np.load(DATA / "brain_templates/mni152_2009mini.npz") as raw:
        again = cleaned(*shuffled(raw["V"].astype(float), raw["F"]))
    np.testing.assert_array_equal(triangle_set(X, T), triangle_set(*again[:2]))
    assert mesh.attrs["holes"] == 0


# collections


def test_a_bad_file_is_excluded_with_its_reason_and_the_others_are_read(tmp_path):
    X, T = sphere()
    write_mesh(tmp_path / "good.ply", X, T)
    write_mesh(tmp_path / "twice.stl", X * [1, 1, 1.2], np.concatenate([T, T[:1]]))
    (tmp_path / "cut.ply").write_bytes((tmp_path / "good.ply").read_bytes()[:-100])
    (tmp_path / "good.ply").rename(tmp_path / "named.obj")
    shapes = read_shapes(tmp_path)
    report = shapes["report"].to_dataset()
    assert report["shape"].values.tolist() == ["cut", "named", "twice"]
    assert report["status"].values.tolist() == ["excluded", "ok", "repaired"]
    cut, named, twice = report["reason"].values.tolist()
    assert "cut.ply" in cut
    assert "expected 396 rows of face" in cut
    assert (named, twice) == (
        "named .obj but read as PLY by its content; rename the file",
        "1 duplicate triangle dropped",
    )
    assert report["file_vertices"].values.tolist() == [-1, 200, 200]
    assert list(shapes["original"]) == ["named", "twice"]
    assert not shapes["original"].to_dataset().variables


def test_a_collection_goes_through_a_netcdf_file(tmp_path):
    shapes = read_shapes({"a": sphere(), "b": as_dataset(*torus())})
    shapes.to_netcdf(tmp_path / "shapes.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "shapes.nc", engine="h5netcdf") as back:
        xr.testing.assert_identical(
            back["original/b"].to_dataset().load(), shapes["original/b"].to_dataset()
        )
        assert back["report"]["genus"].values.tolist() == [0, 1]


def test_nothing_usable_is_an_error_with_every_reason(tmp_path):
    (tmp_path / "a.ply").write_text("no mesh")
    (tmp_path / "b.off").write_text("OFF\n1 0 0\n0 0 0\n")
    with pytest.raises(ValueError, match=r"none of 2 shapes can be used \(a: .*; b: .*\)"):
        read_shapes(tmp_path)
    with pytest.raises(ValueError, match=r"letters, digits"):
        read_shapes({"a/b": sphere()})


def ball(factor=1.0, offset=0.0, kind=float):
    X, T = as_arrays(synthetic.sphere(100))
    return (factor * X + offset).astype(kind).astype(float), T


@pytest.mark.parametrize("factor", [1e16, 1e37, 1e60, 1e300])
def test_coordinates_too_large_to_compute_with_are_refused(factor):
    X, T = ball(factor)
    with pytest.raises(
        ValueError, match=r"coordinates of at most 1e\+15 needed, found \d.*: scale the file"
    ):
        clean_arrays(X, T)
    X, T = ball()
    X[0] *= factor  # one is enough
    with pytest.raises(ValueError, match=r"coordinates of at most 1e\+15 needed"):
        clean_arrays(X, T)


@pytest.mark.parametrize("factor", [1e-16, 1e-60, 1e-300, 5e-324])
def test_shapes_too_small_to_compute_with_are_refused(factor):
    with pytest.raises(ValueError, match=r"an extent of at least 1e-15 needed, found"):
        clean_arrays(*ball(factor))


def test_shapes_lost_in_the_rounding_of_their_offset_are_refused():
    for offset, kind in ((1e6, np.float32), (1e12, float)):
        with pytest.raises(ValueError, match=r"lost in rounding: .*subtract the offset"):
            clean_arrays(*ball(1.0, offset, kind))
    for offset, kind in ((1e4, np.float32), (1e10, float)):
        assert clean_arrays(*ball(1.0, offset, kind))[-1]["genus"] == 0
