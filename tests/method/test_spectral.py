"""The spectrum (3.3): known eigenvalues, orthonormality, the same answer every time."""

import numpy as np
import pytest

import s4a
from s4a import coarsen, reconstruct, spectrum, synthetic
from s4a.geometry.mesh import as_dataset, cotan_weights, vertex_areas
from s4a.method import spectral
from s4a.method.refined_eigenfunctions import low_resolution
from s4a.schema import dataset

SPHERE = np.repeat([0.0, 2.0, 6.0, 12.0], [1, 3, 5, 7]) * 4 * np.pi  # l (l + 1), for unit area


def prepared(X, T):
    """A mesh in the form that `spectrum` needs, without coarsening."""
    E, w = cotan_weights(X, T)
    return dataset(
        position=X, corner_vertex=T, vertex_area=vertex_areas(X, T), edge_vertex=E, cotan_weight=w
    )


def arrays(mesh):
    return mesh["position"].values, mesh["corner_vertex"].values


@pytest.fixture(scope="module")
def ellipsoid():
    return spectrum(prepared(*arrays(synthetic.ellipsoid(900))), k=20)


def test_the_spectrum_of_the_sphere_is_0_three_times_2_five_times_6_and_converges():
    worst = []
    for n in (300, 1200, 4800):
        eigenvalue = spectrum(prepared(*arrays(synthetic.sphere(n, radius=3.0))), k=16)[
            "eigenvalue"
        ].values
        assert eigenvalue[0] == 0
        worst.append(np.abs(eigenvalue[1:] / SPHERE[1:] - 1).max())
    assert worst[0] < 0.05
    assert worst[2] < 0.004
    assert worst[0] / worst[1] > 3  # of second order: a quarter with four times the vertices
    assert worst[1] / worst[2] > 3


def test_the_coarse_mesh_of_a_fine_sphere_has_the_spectrum_of_the_sphere():
    mesh = spectrum(coarsen(synthetic.sphere(8000, radius=70.0), n_coarse=1500), k=9)
    assert mesh["eigenvalue"].values == pytest.approx(SPHERE[:9], rel=0.02)


def test_eigenfunctions_are_orthonormal_in_the_areas(ellipsoid):
    Phi, a = ellipsoid["eigenfunction"].values, spectral.unit_area(ellipsoid)
    assert Phi.T @ (a[:, None] * Phi) == pytest.approx(np.eye(20), abs=1e-9)
    assert (Phi[:, 0] == 1).all()


def test_eigenpairs_solve_their_equation(ellipsoid):
    W = spectral.stiffness(ellipsoid["edge_vertex"].values, ellipsoid["cotan_weight"].values, 900)
    Phi, a = ellipsoid["eigenfunction"].values, spectral.unit_area(ellipsoid)
    right = a[:, None] * Phi * ellipsoid["eigenvalue"].values
    assert np.abs(W @ Phi - right).max() < 1e-8 * np.abs(right).max()


def test_the_spectrum_does_not_depend_on_unit_or_motion(ellipsoid):
    X, T = arrays(synthetic.ellipsoid(900))
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    other = spectrum(prepared(1000 * X @ turn.T + 50, T), k=20)
    assert other["eigenvalue"].values == pytest.approx(
        ellipsoid["eigenvalue"].values, rel=1e-8, abs=1e-8
    )


def test_the_same_mesh_gives_the_same_bits(ellipsoid):
    assert spectrum(prepared(*arrays(synthetic.ellipsoid(900))), k=20).identical(ellipsoid)


def test_the_sign_of_an_eigenfunction_makes_its_third_moment_positive(low_brain):
    Phi = low_brain["eigenfunction"].values
    assert (spectral.unit_area(low_brain) @ Phi[:, 1:] ** 3 > 0).all()


def test_renumbered_vertices_give_the_same_functions_on_a_shape_without_symmetry(low_brain):
    X, T = arrays(low_brain)
    order = np.random.default_rng(1).permutation(len(X))
    one = spectrum(prepared(X, T), k=15)
    two = spectrum(prepared(X[order], np.argsort(order)[T]), k=15)
    assert two["eigenvalue"].values == pytest.approx(one["eigenvalue"].values, abs=1e-7)
    assert two["eigenfunction"].values == pytest.approx(
        one["eigenfunction"].values[order], abs=1e-6
    )


def test_renumbered_vertices_give_the_same_eigenspaces_of_the_sphere():
    X, T = arrays(synthetic.sphere(600))
    order = np.random.default_rng(1).permutation(len(X))
    one = spectrum(prepared(X, T), k=9)["eigenfunction"].values[order]
    two = spectrum(prepared(X[order], np.argsort(order)[T]), k=9)["eigenfunction"].values
    for block in (slice(0, 1), slice(1, 4), slice(4, 9)):
        assert (
            np.abs(two[:, block] @ two[:, block].T - one[:, block] @ one[:, block].T).max() < 1e-5
        )


def test_functions_in_the_span_are_reconstructed_exactly(ellipsoid):
    f = ellipsoid["eigenfunction"].values @ np.random.default_rng(2).normal(size=(20, 9))
    for given in (f, f[:, 0], f.reshape(900, 3, 3)):
        assert reconstruct(ellipsoid, given) == pytest.approx(given, abs=1e-9)
    assert reconstruct(ellipsoid, np.full(900, 7.0), k=1) == pytest.approx(np.full(900, 7.0))


def test_reconstruction_from_more_functions_is_nearer(ellipsoid):
    X = ellipsoid["position"].values
    error = [np.linalg.norm(reconstruct(ellipsoid, X, k=k) - X) for k in (1, 4, 20)]
    assert error[0] > 5 * error[1] > 10 * error[2]


def test_two_pieces_have_two_zero_eigenvalues_and_the_mesh_says_so():
    X, T = arrays(synthetic.sphere(200))
    two = spectrum(prepared(np.concatenate([X, X + 5]), np.concatenate([T, T + 200])), k=8)
    assert two.attrs["zero_eigenvalues"] == 2


def pieces(*places, n=150):
    """Ellipsoids of several sizes at several places, as one mesh."""
    X, T = arrays(synthetic.ellipsoid(n))
    X = [X * (1 + 0.2 * i) + [place, 0, 0] for i, place in enumerate(places)]
    return as_dataset(np.concatenate(X), np.concatenate([T + i * n for i in range(len(places))]))


@pytest.mark.parametrize("options", [{}, {"method": "scalable"}, {"refined_eigenfunctions": True}])
@pytest.mark.parametrize("k", [2, 10])
def test_the_first_function_of_several_pieces_is_the_constant_whatever_the_space(options, k):
    low = low_resolution(pieces(0, 4, 9), n_coarse=300, k=k, **options)
    Phi, A = low["eigenfunction"].values, spectral.unit_mass(low)
    assert low["eigenvalue"].values[:2].tolist() == [0, 0]
    assert Phi[:, 0] == pytest.approx(np.ones(len(Phi)), abs=1e-4)
    A = A if A.ndim == 2 else np.diag(A)
    assert Phi.T @ (A @ Phi) == pytest.approx(np.eye(k), abs=1e-4)


def test_landmark_maps_of_shapes_of_several_pieces_carry_constants_to_constants():
    shapes = {"a": pieces(0, 4), "b": pieces(0, 5)}
    coarse = {n: spectrum(coarsen(mesh, n_coarse=200), k=10) for n, mesh in shapes.items()}
    of_one = {  # coefficients of the function 1
        n: spectral.unit_area(mesh) @ mesh["eigenfunction"].values[:, :6]
        for n, mesh in coarse.items()
    }
    network = s4a.build_network(coarse, k_init=6, init="landmarks", initial_refinement=False)
    for i, j, C in zip(
        *(network[name].values for name in ("source", "target", "fmap_initial")), strict=True
    ):
        assert C @ of_one[i] == pytest.approx(of_one[j], abs=1e-9)


def test_a_mesh_with_fewer_vertices_than_k_gives_what_it_can_and_says_so(caplog):
    mesh = spectrum(prepared(*arrays(synthetic.sphere(30))), k=100)
    assert mesh.sizes["eigenpair"] == 28
    assert mesh.attrs["k_reduced_from"] == 100
    assert "28" in caplog.text


def test_a_spectrum_asked_for_again_replaces_the_one_before():
    mesh = prepared(*arrays(synthetic.sphere(30)))
    again = spectrum(spectrum(mesh, k=100), k=5)
    assert again.identical(spectrum(mesh, k=5))
    assert spectrum(again, k=12).identical(spectrum(mesh, k=12))


def test_samples_of_scalable_keep_the_spectrum_that_they_come_with():
    low = low_resolution(synthetic.sphere(200), method="scalable", n_coarse=100, k=5)
    with pytest.raises(ValueError, match="samples of SCALABLE have a spectrum"):
        spectrum(low, k=6)


@pytest.mark.parametrize("k", [0, -3, 2.5])
def test_k_out_of_range_is_refused(ellipsoid, k):
    with pytest.raises(ValueError, match="k must be an integer of at least 1"):
        spectrum(ellipsoid.drop_vars(["eigenvalue", "eigenfunction"]), k=k)
    with pytest.raises(ValueError, match="k must be an integer of at least 1"):
        reconstruct(ellipsoid, np.ones(900), k=k)


def test_a_mesh_without_weights_is_refused_by_name():
    with pytest.raises(ValueError, match="cotan_weight"):
        spectrum(synthetic.sphere(100))
