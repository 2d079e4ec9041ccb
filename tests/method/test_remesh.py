import sys

import igl
import numpy as np
import pytest
from paths import DATA
from scipy.ndimage import gaussian_filter
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from surfaces import assert_oriented_manifold

from s4a import synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, edge_graph, edges, unique_edges, vertex_areas
from s4a.input.clean import clean
from s4a.method.remesh import MOVED, coarsen
from s4a.method.spectral import spectrum


def boundary_vertices(T):
    E, _, count = unique_edges(T)
    return np.unique(E[count == 1])


def plane(n=60):
    """A square grid, whose vertex (i, j) is i * n + j."""
    i, j = np.divmod(np.arange(n * n), n)
    a = np.flatnonzero((i < n - 1) & (j < n - 1))
    T = np.concatenate([np.c_[a, a + n, a + n + 1], np.c_[a, a + n + 1, a + 1]])
    return np.c_[i / n, j / n, 0 * i], T


def sphere(subdivisions=4):
    X = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    T = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    X, T = igl.upsample(X, T, subdivisions)
    return X / np.linalg.norm(X, axis=1, keepdims=True), T


def bumpy(subdivisions=5):
    """A sphere with bumps of no symmetry."""
    X, T = sphere(subdivisions)
    x, y, z = X.T
    return X * (1 + 0.2 * np.sin(3 * x + 1) * np.cos(4 * y + z) + 0.1 * np.sin(5 * z + 2 * x * y))[
        :, None
    ], T


def torus():
    return as_arrays(synthetic.torus(150, 50))


def voxels(solid):
    """Surface of a set of voxels, each face two triangles, facing outwards."""
    full, points, quads = np.pad(solid, 1), [], 0
    for axis in range(3):
        for sign in (1, -1):
            cell = np.argwhere(full & ~np.roll(full, -sign, axis))
            u, v = np.roll(np.eye(3, dtype=int), -axis, axis=0)[1:]
            base = cell + (np.eye(3, dtype=int)[axis] if sign > 0 else 0)
            u, v = (u, v) if sign > 0 else (v, u)
            points.append(np.stack([base, base + u, base + u + v, base + v], axis=1).reshape(-1, 3))
            quads += len(cell)
    X, vertex = np.unique(np.concatenate(points), axis=0, return_inverse=True)
    Q = vertex.reshape(quads, 4)
    return X.astype(float), np.concatenate([Q[:, [0, 1, 2]], Q[:, [0, 2, 3]]])


def double_torus():
    solid = np.ones((50, 30, 10), bool)
    solid[10:20, 10:20] = solid[30:40, 10:20] = False
    return voxels(solid)


def assert_manifold(coarse, pieces=1, euler=None):
    X, T = as_arrays(coarse)
    assert_oriented_manifold(X, T)
    assert (len(boundary_vertices(T)) == 0) == (coarse.attrs["boundary_loops"] == 0)
    assert len(np.unique(np.sort(T, axis=1), axis=0)) == len(T)
    assert connected_components(edge_graph(X, edges(T)), directed=False)[0] == pieces
    assert coarse.attrs["nonmanifold_edges"] == 0
    assert euler in (None, coarse.attrs["euler_characteristic"])


def apply_u(coarse, f):
    return np.einsum(
        "ij,ij...->i...", coarse["coarse_weight"].values, f[coarse["coarse_vertex"].values]
    )


@pytest.mark.parametrize(
    "surface, n_coarse, euler",
    [
        (sphere, 300, 2),
        (bumpy, 800, 2),
        (torus, 300, 0),
        (torus, 60, 0),
        (double_torus, 800, -2),
        (plane, 300, 1),
    ],
)
def test_the_coarse_mesh_is_a_manifold_of_the_same_topology_near_the_size_asked_for(
    surface, n_coarse, euler
):
    coarse = coarsen(as_dataset(*surface()), n_coarse=n_coarse)
    assert coarse.attrs["euler_characteristic_original"] == euler
    assert_manifold(coarse, euler=euler)
    assert 0.9 * n_coarse <= coarse.sizes["vertex"] <= 1.2 * n_coarse


def test_samples_and_u_of_a_surface_on_a_grid_with_thin_handles_do_not_depend_on_its_pose():
    marching_cubes = pytest.importorskip("skimage.measure").marching_cubes
    noise = np.random.default_rng(0).normal(size=(30, 30, 30))
    radius = np.linalg.norm(np.indices(noise.shape) - 14.5, axis=0)
    solid = (radius < 12) & ((gaussian_filter(noise, 1) < 0.25) | (radius < 7.5))
    X, T = marching_cubes(np.pad(solid, 1).astype(float), 0.5)[:2]
    X, T = as_arrays(clean(as_dataset(X.astype(float), T)))
    R = Rotation.random(random_state=0).as_matrix()
    one, other = (coarsen(as_dataset(P, T), n_coarse=100) for P in (X, np.float32(X @ R.T)))
    assert one.attrs["vertices_cut"] > 100
    assert {*one["sample_vertex"].values} == {*other["sample_vertex"].values}
    center = X.mean(0), np.float32(X @ R.T).mean(0)
    f, g = (
        apply_u(c, np.linalg.norm(c["position"].values - x, axis=1))
        for c, x in zip((one, other), center, strict=True)
    )
    assert np.abs(f - g).max() < 1e-4


@pytest.mark.parametrize("surface", [bumpy, torus, double_torus, plane])
def test_rows_of_u_are_convex_weights_and_samples_carry_themselves(surface):
    X, T = surface()
    coarse = coarsen(as_dataset(X, T), n_coarse=400)
    weight, sample = coarse["coarse_weight"].values, coarse["sample_vertex"].values
    assert weight.min() >= 0
    np.testing.assert_allclose(weight.sum(1), 1, atol=1e-12)
    np.testing.assert_array_equal(
        apply_u(coarse, np.arange(len(sample)))[sample], np.arange(len(sample))
    )
    np.testing.assert_array_equal(coarse["position"], X[sample])
    np.testing.assert_allclose(coarse["vertex_area"].sum(), vertex_areas(X, T).sum(), rtol=1e-6)


def test_linear_functions_on_a_plane_come_back_but_where_a_cell_leaves_its_star():
    X, T = plane()
    coarse = coarsen(as_dataset(X, T), n_coarse=300)
    inside = ((X[:, :2] > 0.1) & (X[:, :2] < 0.9)).all(1)
    f = X @ [2.0, -3.0, 1.0] + 5
    error = np.abs(apply_u(coarse, f[coarse["sample_vertex"].values]) - f)
    assert (error[inside] < 4 * MOVED).mean() > 0.99  # the gradient is 3.7, the radius below 1
    assert error.max() < 0.05  # the spacing is 0.06, the gradient 3.6


def test_no_weight_crosses_a_thin_wall():
    X, T = voxels(np.ones((80, 80, 1), bool))
    X = X * [1 / 80, 1 / 80, 0.004]  # far thinner than the spacing of the samples, about 0.08
    coarse = coarsen(as_dataset(X, T), n_coarse=400)
    assert_manifold(coarse, euler=2)
    top, vertex = X[:, 2] > 0.002, coarse["coarse_vertex"].values
    across = (
        coarse["coarse_weight"].values
        * (top[coarse["sample_vertex"].values][vertex] != top[:, None])
    ).sum(1)
    inside = ((X[:, :2] > 0.12) & (X[:, :2] < 0.88)).all(1)
    assert inside.sum() > 5000
    assert across[inside].max() == 0


def test_boundaries_are_kept_where_they_are():
    X, T = plane(80)
    centre = X[T].mean(1)[:, :2] - 0.5
    T = T[np.hypot(*centre.T) > 0.15]
    used, T = np.unique(T, return_inverse=True)
    X, T = X[used], T.reshape(-1, 3)
    coarse = coarsen(as_dataset(X, T), n_coarse=500)
    assert_manifold(coarse, euler=0)
    assert coarse.attrs["boundary_loops"] == coarse.attrs["boundary_loops_original"] == 2
    boundary = boundary_vertices(coarse["corner_vertex"].values)
    assert np.isin(coarse["sample_vertex"].values[boundary], boundary_vertices(T)).mean() > 0.95
    Y, C = as_arrays(coarse)
    assert abs(vertex_areas(Y, C).sum() / vertex_areas(X, T).sum() - 1) < 0.02


def test_holes_inside_a_cell_are_closed():
    X, T = bumpy()
    coarse = coarsen(as_dataset(X, np.delete(T, np.arange(0, len(T), 400), axis=0)), n_coarse=300)
    assert coarse.attrs["boundary_loops_original"] == 21
    assert coarse.attrs["boundary_loops"] < 4
    assert_manifold(coarse)


def test_pin_holes_through_a_wall_are_cut_where_samples_do_not_suffice():
    solid = np.ones((70, 70, 2), bool)
    solid[5:65:4, 5:65:4] = False
    X, T = voxels(solid)
    coarse = coarsen(as_dataset(X, T), n_coarse=700)
    assert coarse.attrs["euler_characteristic_original"] == 2 - 2 * 225
    assert coarse.attrs["euler_characteristic"] > -60
    assert coarse.sizes["vertex"] < 800
    assert_manifold(coarse)
    assert spectrum(coarse, k=10).attrs["zero_eigenvalues"] == 1


def test_a_thin_neck_is_never_cut_when_it_holds_the_surface_together():
    solid = np.zeros((50, 20, 20), bool)
    solid[:20] = solid[30:] = True
    solid[20:30, 10, 10] = True
    coarse = coarsen(as_dataset(*voxels(solid)), n_coarse=100)
    assert_manifold(coarse, euler=2)


def test_every_component_gets_samples_by_its_area():
    (X, T), n = sphere(5), len(sphere(5)[0])
    parts = [X, 0.5 * X + [3, 0, 0], 0.01 * X + [0, 3, 0]]
    coarse = coarsen(
        as_dataset(np.concatenate(parts), np.concatenate([T, T + n, T + 2 * n])), n_coarse=1000
    )
    share = np.bincount(coarse["sample_vertex"].values // n)
    assert_manifold(coarse, pieces=3, euler=6)
    assert 3 < share[0] / share[1] < 5
    assert share[2] >= 4


def test_numbering_does_not_matter():
    X, T = bumpy()
    rng = np.random.default_rng(0)
    order, shuffled = rng.permutation(len(X)), np.empty(len(X), int)
    shuffled[order] = np.arange(len(X))
    U = np.take_along_axis(
        shuffled[T], (rng.integers(0, 3, (len(T), 1)) + np.arange(3)) % 3, axis=1
    )
    one = coarsen(as_dataset(X, T), n_coarse=500)
    other = coarsen(as_dataset(X[order], rng.permutation(U)), n_coarse=500)
    for name in ("position", "corner_vertex", "cotan_weight", "edge_vertex"):
        np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_array_equal(order[other["sample_vertex"]], one["sample_vertex"])
    np.testing.assert_array_equal(other["coarse_weight"], one["coarse_weight"].values[order])
    np.testing.assert_array_equal(other["coarse_vertex"], one["coarse_vertex"].values[order])


def test_rigid_motion_and_scale_keep_the_samples():
    X, T = bumpy()
    Q = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    Q[:, 0] *= np.linalg.det(Q)
    one = coarsen(as_dataset(X, T), n_coarse=500)
    other = coarsen(as_dataset(3 * X @ Q.T + [10, -20, 30], T), n_coarse=500)
    assert (
        len(np.intersect1d(one["sample_vertex"], other["sample_vertex"]))
        >= 0.98 * one.sizes["vertex"]
    )
    first, second = spectrum(one, k=20)["eigenvalue"], spectrum(other, k=20)["eigenvalue"]
    np.testing.assert_allclose(first, second, rtol=2e-3, atol=1e-6)


def test_the_same_call_gives_the_same_result_and_leaves_its_input():
    mesh = as_dataset(*bumpy(4))
    before = mesh.copy(deep=True)
    assert coarsen(mesh, n_coarse=300).identical(coarsen(mesh, n_coarse=300))
    assert mesh.identical(before)
    assert not coarsen(mesh, n_coarse=300, seed=1).identical(coarsen(mesh, n_coarse=300))


def test_a_mesh_that_is_small_enough_is_kept():
    X, T = sphere(3)
    coarse = coarsen(as_dataset(X, T), n_coarse=300)
    assert coarse.attrs["kept_whole"] == 1
    np.testing.assert_array_equal(apply_u(coarse, coarse["position"].values), X)
    np.testing.assert_allclose(np.sort(coarse["vertex_area"]), np.sort(vertex_areas(X, T)))


def test_degenerate_coarse_triangles_go_through_the_robust_laplacian():
    X, T = voxels(np.ones((20, 20, 20), bool))
    X[X[:, 2] == 20, :2] = (
        np.round(X[X[:, 2] == 20, :2] / 20, 3) * 1e-9 + 10
    )  # the lid is shrunk to nothing
    coarse = coarsen(as_dataset(X, T), n_coarse=4000)
    assert coarse.attrs["laplacian"] == "robust"
    assert spectrum(coarse, k=5).attrs["zero_eigenvalues"] == 1


@pytest.mark.parametrize(
    "X, T, options, message",
    [
        (np.eye(3), [[0, 1, 3]], {}, "valid indices"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], {}, "finite"),
        (np.eye(4, 3), [[0, 1, 2]], {}, "1 vertices without triangle"),
        (
            np.random.default_rng(0).random((5, 3)),
            [[0, 1, 2], [0, 1, 3], [0, 1, 4]],
            {},
            "1 edges of three",
        ),
        (np.eye(3), [[0, 1, 2]], {"n_coarse": 3}, "at least 4"),
    ],
)
def test_what_is_not_clean_is_refused(X, T, options, message):
    with pytest.raises(ValueError, match=message):
        coarsen(as_dataset(X, T), **options)


def test_a_pymeshlab_that_does_not_import_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "pymeshlab.py").write_text("raise ImportError('libGL.so.1: no such file')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pymeshlab", raising=False)
    with pytest.raises(ValueError, match=r"libGL.so.1.*libgl1 and libopengl0"):
        coarsen(as_dataset(*bumpy()), n_coarse=1000, wrap=True)


def test_wrapping_gives_a_closed_surface_and_weights_for_the_original(capfd):
    pymeshlab = pytest.importorskip("pymeshlab")
    if not hasattr(pymeshlab.MeshSet, "generate_alpha_wrap"):
        pytest.skip("needs libgl1 and libopengl0")
    X, T = bumpy()
    T = np.delete(T, np.arange(0, len(T), 400), axis=0)
    coarse = coarsen(as_dataset(X, T), n_coarse=1000, wrap=True)
    assert_manifold(coarse)
    assert coarse.attrs["boundary_loops"] == 0
    assert coarse.attrs["wrapped"] == 1
    assert (coarse["sample_vertex"] == -1).all()
    np.testing.assert_allclose(coarse["coarse_weight"].sum("corner"), 1)
    assert np.linalg.norm(apply_u(coarse, coarse["position"].values) - X, axis=1).mean() < 0.03
    assert capfd.readouterr() == ("", "")


def test_a_real_head_becomes_a_closed_connected_manifold():
    files = sorted((DATA / "synthseg_brains").glob("icv_mc_*.npz"))
    if not files:
        pytest.skip("the shared heads are absent")
    with np.load(files[0]) as head:
        mesh = clean(as_dataset(head["V"], head["F"]))
    coarse = coarsen(mesh)
    assert_manifold(coarse)
    assert coarse.attrs["boundary_loops"] == 0
    assert 5500 < coarse.sizes["vertex"] < 7000
    assert spectrum(coarse, k=20).attrs["zero_eigenvalues"] == 1
    X = mesh["position"].values
    error = apply_u(coarse, coarse["position"].values) - X
    assert np.sqrt((error**2).sum(1).mean() / coarse["vertex_area"].values.sum()) < 0.003
