"""The paper (3.4 to 4.2) from the arrays of a study: equations 3 to 8 again, by brute force.

Nothing here is computed by the functions of the method: matrices are dense, nearest neighbours come
from all distances.
"""

import itertools

import numpy as np
import pytest
import scipy.linalg
from pyFM.FMN import FMN
from pyFM.mesh import TriMesh
from scipy.sparse import diags
from scipy.spatial.distance import cdist
from small import OPTIONS

import s4a
from s4a.evaluation.methods import Pair, Spaces
from s4a.method import latent, network
from s4a.method.shape import Shape
from s4a.options import DECLARED, PRESETS


@pytest.fixture(scope="module")
def paper(brains):
    """The study of the paper, eq. 7, with the iterations of Consistent ZoomOut."""
    return s4a.analyse(brains, preset="paper", keep_iterations=True, **OPTIONS)


@pytest.fixture(scope="module")
def standard(brains):
    """Study with the paper's standard dense match, eq. 3 and 4, and size removed."""
    return s4a.analyse(brains, preset="paper", dense_match="fmap", remove_size=True, **OPTIONS)


def others(study):
    """The template, and every other shape."""
    template = study["registration"].attrs["template"]
    return template, [n for n in study["registration"]["shape"].values.tolist() if n != template]


def low(study, name):
    """Phi, A (of trace 1) and Y of a shape."""
    coarse = study["coarse"][name]
    area = coarse["vertex_area"].values
    Y = study["latent"]["latent_basis"].sel(shape=name).values
    return coarse["eigenfunction"].values, np.diag(area / area.sum()), Y


def projection(study, name):
    """U as a dense matrix."""
    column = study["coarse"][name]["coarse_vertex"].values
    U = np.zeros((len(column), study["coarse"][name].sizes["vertex"]))
    np.add.at(
        U, (np.arange(len(U))[:, None], column), study["coarse"][name]["coarse_weight"].values
    )
    assert np.array_equal(U, s4a.projection_operator(study["coarse"][name]).toarray())
    return U


def frame(study, name):
    """Area centroid and square root of the area of the original mesh."""
    X = study["original"][name]["position"].values
    corners = X[study["original"][name]["corner_vertex"].values]  # (m, 3 corners, 3)
    area = np.linalg.norm(np.cross(*(corners[:, [1, 2]] - corners[:, :1]).swapaxes(0, 1)), axis=1)
    return area @ corners.mean(1) / area.sum(), np.sqrt(area.sum() / 2)


def stored(study, variable, name):
    return study["registration"][variable].sel(shape=name).values


def are_nearest(match, query, among):
    """Whether no row is closer than the matched one, up to single-precision rounding."""
    distance = cdist(query, among)
    return np.allclose(distance[np.arange(len(match)), match], distance.min(1), rtol=1e-4)


def test_the_stored_descriptors_and_map_have_the_stored_energies(paper):
    network = paper["network"].to_dataset()
    values = (network[name].values for name in ("fmap_fitted", "descriptor_of_source"))
    C, F = values
    residual = C @ F - network["descriptor_of_target"].values
    assert network["descriptor_energy"].values == pytest.approx((residual**2).sum((1, 2)), rel=1e-4)
    spectra = {n: c["eigenvalue"].values[:10] for n, c in paper["coarse"].children.items()}
    for p, ends in enumerate(zip(network["source"].values, network["target"].values, strict=True)):
        source, target = (spectra[name] for name in ends)
        commute = ((target[:, None] - source) / max(source[-1], target[-1])) ** 2
        energy = 1e-3 * (F[p] ** 2).sum() * (commute * C[p] ** 2).sum()
        assert network["laplacian_energy"].values[p] == pytest.approx(energy, rel=1e-4)


def test_every_iteration_of_consistent_zoomout_is_equation_3_and_a_larger_map(paper):
    iterations = list(paper["iterations"].children.values())
    assert [node.sizes["eigenpair"] for node in iterations] == [10, 15, 20, 24]
    network = paper["network"]
    for now, following in itertools.pairwise(iterations):
        size, larger = now.sizes["eigenpair"], following.sizes["eigenpair"]
        for p, (i, j) in enumerate(
            zip(network["source"].values, network["target"].values, strict=True)
        ):
            (Phi, _, _), (Psi, A, _) = low(paper, i), low(paper, j)
            Y_i, Y_j = (now["latent_basis"].sel(shape=name).values for name in (i, j))
            match = cdist(Psi[:, :size] @ Y_j, Phi[:, :size] @ Y_i).argmin(1)  # eq. 3
            C = Psi[:, :larger].T @ A @ Phi[match, :larger]
            assert following["fmap"].values[p] == pytest.approx(C, abs=1e-3)
            ends = np.cumsum(now["matched_count"].values)[[p - 1, p]] * [p > 0, 1]
            assert (now["matched_source"].values[slice(*ends)] == match).mean() > 0.999
            assert (now["matched_target"].values[slice(*ends)] == np.arange(len(match))).all()
    assert network["iteration_size"].values.tolist() == [10, 15, 20, 24]
    assert np.array_equal(network["iteration_weight"][-1], network["weight"])
    assert np.array_equal(network["iteration_cycle_error"][0], network["cycle_error_initial"])
    assert np.array_equal(iterations[-1]["fmap"], network["fmap"])
    assert np.array_equal(iterations[-1]["latent_basis"], paper["latent"]["latent_basis"])


def test_the_median_has_the_least_energy_of_equation_5(paper):
    node = paper["latent"]
    inverse = np.r_[0, 1 / node["latent_eigenvalue"].values[1:]]
    energy = []
    for Y in node["latent_basis"].values:
        D = Y.T @ Y
        energy.append(np.linalg.norm(((D - np.eye(len(D))) * inverse)[1:, 1:]))
    assert node["distance_to_limit"].values == pytest.approx(energy)
    assert node["distance_by_norm"].sel(norm="h2").values == pytest.approx(energy)
    assert node.attrs["median"] == node["shape"].values[np.argmin(energy)]


def test_equation_3_holds_between_any_two_shapes_and_gives_their_map(paper):
    names = paper["latent"]["shape"].values.tolist()
    (Phi, _, Y_i), (Psi, _, Y_j) = (low(paper, name) for name in names[1:3])
    match = s4a.latent_match(paper, *names[1:3], full=False)["match"].values
    assert are_nearest(match, Psi @ Y_j, Phi @ Y_i)
    C = s4a.latent_map(paper, *names[1:3])["fmap"].values
    assert C == pytest.approx(np.linalg.lstsq(Y_i.T, Y_j.T)[0].T)


@pytest.mark.parametrize("fixture", ["paper", "standard"])
def test_the_match_of_equation_6_is_kept_however_full_resolution_is_reached(fixture, request):
    study = request.getfixturevalue(fixture)
    template, names = others(study)
    Psi, _, Y_template = low(study, template)
    for name in names:
        Phi, _, Y = low(study, name)
        match = stored(study, "registered_match_low", name)
        assert are_nearest(match, Psi @ Y_template, Phi @ Y)
        assert not are_nearest(match, Psi @ Y, Phi @ Y_template)  # bases exchanged


def test_the_standard_match_is_that_of_equation_4(standard):
    template, names = others(standard)
    Psi, A, _ = low(standard, template)
    for name in names:
        Phi, _, _ = low(standard, name)
        C = Psi.T @ A @ Phi[stored(standard, "registered_match_low", name)]
        match = stored(standard, "registered_match", name)
        query = projection(standard, template) @ Psi
        assert are_nearest(match, query, projection(standard, name) @ (Phi @ C.T))
        assert not are_nearest(match, query, projection(standard, name) @ (Phi @ C))


@pytest.mark.parametrize("fixture", ["paper", "standard"])
def test_the_displacement_is_that_of_equation_8_after_icp_alone(fixture, request):
    study = request.getfixturevalue(fixture)
    template, names = others(study)
    X = study["original"][template]["position"].values
    center, size = frame(study, template)
    for name in names:
        own_center, own_size = frame(study, name)
        s = size / own_size if fixture == "standard" else 1.0
        R = stored(study, "icp_rotation", name)
        image = study["original"][name]["position"].values[stored(study, "registered_match", name)]
        placed = s * (image - own_center) @ R.T + size * stored(study, "icp_translation", name)
        raw = placed + center - X  # minus d of the paper
        assert stored(study, "displacement_raw", name) == pytest.approx(raw, abs=1e-4)
        assert np.array_equal(stored(study, "rotation", name), R)
        assert stored(study, "scale", name) == pytest.approx(s)


@pytest.mark.parametrize("fixture", ["paper", "standard"])
def test_the_smooth_displacement_is_the_projection_as_printed(fixture, request):
    study = request.getfixturevalue(fixture)
    template, names = others(study)
    B = projection(study, template) @ low(study, template)[0]
    for name in names:
        raw = stored(study, "displacement_raw", name)
        coefficient = np.linalg.pinv(B) @ raw
        assert stored(study, "displacement_coefficient", name) == pytest.approx(
            coefficient, abs=1e-3
        )
        assert stored(study, "displacement", name) == pytest.approx(B @ coefficient, abs=1e-3)


@pytest.mark.parametrize("isometric", [False, True])
def test_consistent_zoomout_is_that_of_pyfm_where_weights_are_equal(paper, isometric):
    """Same subspaces and matches from the same maps, in both readings (pyfmaps 1.3.1)."""
    names = paper["latent"]["shape"].values.tolist()
    bases = [Shape(coarse=paper["coarse"][name].to_dataset()).low for name in names]
    source, target = (
        np.array([names.index(name) for name in paper["network"][end].values])
        for end in ("source", "target")
    )
    first = paper["network"]["fmap_initial"].values  # (p, 10, 10)

    meshes = []
    for basis in bases:
        mesh = TriMesh(basis.X, basis.T)
        mesh.eigenvalues, mesh.eigenvectors = basis.eigenvalue, basis.Phi
        mesh.A = diags(basis.area)
        meshes.append(mesh)
    edges = list(zip(source.tolist(), target.tolist(), strict=True))
    other = FMN(meshes, dict(zip(edges, first, strict=True)))
    other.zoomout_refine(
        nit=2, step=5, subsample=None, isometric=isometric, weight_type="adjacency", cclb_ratio=1.0
    )
    if isometric:
        other.set_isometries(M=20)  # before the last basis, too
    C, _, _, Y, eigenvalue = latent.consistent_zoomout(
        bases, first, source, target, 20, step=5, weights="equal", isometric=isometric
    )
    assert np.stack([other.maps[edge] for edge in edges]) == pytest.approx(C, abs=1e-3)

    other.compute_W(M=20)
    other.compute_CLB()
    other.compute_CCLB(20, verbose=False)
    other.compute_p2p()
    n, k, m = Y.shape
    angles = scipy.linalg.subspace_angles(other.CCLB.reshape(n * k, m), Y.reshape(n * k, m))
    assert angles.max() < 1e-2
    assert other.cclb_eigenvalues[1:] == pytest.approx(eigenvalue[1:], rel=1e-3)
    for i, j in edges:
        match = cdist(bases[j].Phi[:, :20] @ Y[j], bases[i].Phi[:, :20] @ Y[i]).argmin(1)
        assert (other.p2p[i, j] == match).mean() > 0.99


def test_errors_by_the_linear_program_are_those_of_pyfm_with_maps_in_the_order_of_the_cycle(paper):
    """PyFM multiplies C_ij C_jk C_ki, so the keys of its maps are reversed here."""
    node = paper["network"]
    names = paper["latent"]["shape"].values.tolist()
    source, target = ([names.index(n) for n in node[end].values] for end in ("source", "target"))
    C = node["fmap_initial"].values
    peer = FMN([None] * len(names), dict(zip(zip(target, source, strict=True), C, strict=True)))
    peer.extract_3_cycles()
    peer.compute_Amat()
    errors = dict(zip(peer.edges, peer.optimize_icsm(), strict=True))
    found = network.program_errors(C, network.three_cycles(source, target))
    ends = zip(target, source, strict=True)
    assert found == pytest.approx(np.array([errors[edge] for edge in ends]), rel=1e-3)


def test_table_1_and_a_pair_have_the_same_rematch(meshes):
    source, target, *_ = meshes.values()
    small = {"n_coarse": 400, "k": 24, "k_init": 10}
    row = Pair(*(Spaces(mesh, 400, 24) for mesh in (source, target)), k_init=10, k=24)
    row = row.run("RE-MATCH")
    paper = {n: v for n, v in PRESETS["paper"].items() if DECLARED[n].metadata["pair"]}
    found = s4a.match_pair(source, target, **paper | {"alignment": "search"} | small)
    assert np.array_equal(found["match"], row.match)
    assert np.array_equal(found["fmap_fitted"], found["fmap_initial"])  # no step ahead in 4.1
