"""A study of SCALABLE: the same tree on local functions, taken by all that takes a study."""

import shutil

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from small import FLAGS, OPTIONS

import s4a
from s4a.cli import main
from s4a.evaluation import accuracy, metrics
from s4a.method.pca import low_vertices
from s4a.method.scalable import reduce, reduced
from s4a.method.shape import Shape
from s4a.options import Options
from s4a.show.surfaces import SAMPLES
from s4a.study import pair

U = {"coarse_vertex", "coarse_weight"}
LOCAL = {"local_vertex", "local_sample", "local_weight", "sample_cell", "edge_mass"}


@pytest.fixture(scope="module")
def folder(brain_files, tmp_path_factory):
    """The folder of a study of four brains, from the command line."""
    out = tmp_path_factory.mktemp("scalable") / "study"
    words = ["run", *map(str, brain_files), "--out", str(out), "--method", "scalable"]
    assert main([*words, "--template", "brain_01", *FLAGS]) == 0
    return out


@pytest.fixture(scope="module")
def sampled(folder):
    """That study."""
    with s4a.open_study(folder) as tree:
        return tree.load()


@pytest.fixture(scope="module")
def others():
    """Four brains."""
    return s4a.synthetic.brains(4, 1500, seed=2)


@pytest.fixture(scope="module")
def paper(others):
    """The study of the paper: nothing is added to it."""
    return s4a.analyse(others, method="scalable", preset="paper", **OPTIONS)


def contents_of(study):
    """What a study holds: node, variable, dims and unit."""
    return {
        (node.path, name, values.dims, values.attrs["units"])
        for node in study.subtree
        for name, values in node.dataset.data_vars.items()
    }


def test_the_tree_is_that_of_a_study_of_rematch_but_for_the_entries_of_u(
    folder, sampled, study_of_files
):
    assert set(s4a.verify(folder)["state"].values) == {"whole"}
    ours, theirs = contents_of(sampled), contents_of(study_of_files)
    assert {(path.split("/")[1], name) for path, name, *_ in theirs - ours} == {
        ("coarse", name) for name in U
    }
    assert {(path.split("/")[1], name) for path, name, *_ in ours - theirs} == {
        ("coarse", name) for name in LOCAL
    }
    assert Options.from_report(sampled).method == "scalable"


def test_the_low_resolution_is_the_reduced_basis_of_scalable(sampled):
    name = "brain_02"
    mesh, coarse = (sampled[stage][name].to_dataset() for stage in ("original", "coarse"))
    shape, true = Shape(mesh, coarse), reduce(mesh, n_samples=400, k=24)
    assert (shape.cell == true.cell).all()
    assert abs(shape.U - true.U).max() < 1e-12
    assert abs(shape.low.mass - true.low.mass).max() < 1e-12
    assert shape.full.mass is shape.low.mass
    np.testing.assert_allclose(shape.low.X, true.low.X, atol=1e-9)
    np.testing.assert_allclose(shape.low.area, true.low.area, atol=1e-12)
    np.testing.assert_allclose(shape.low.eigenvalue, true.low.eigenvalue, rtol=1e-9)
    np.testing.assert_allclose(shape.low.Phi, true.low.Phi, atol=1e-7)
    X = mesh["position"].values[coarse["sample_vertex"].values]
    assert coarse["position"].values == pytest.approx(X)


def test_the_paper_on_scalable_is_what_table_2_compares(others, paper):
    names = {"n_coarse": 400, "k_init": 10, "k": 24, "methods": ["SCALABLE"]}
    result = s4a.compare_collection(others, preset="paper", **names).isel(algorithm=0)
    assert paper["latent"].attrs["median"] == result["median_shape"].item()
    assert result["distance_to_limit"].values == pytest.approx(
        paper["latent/distance_to_limit"].values, rel=1e-3
    )
    registration = paper["registration"].to_dataset()
    for name in set(registration["shape"].values.tolist()) - {registration.attrs["template"]}:
        X = Shape(paper["original"][name].to_dataset())
        X = X.to_frame(X.original["position"].values)
        match = registration["registered_match"].sel(shape=name).values
        theirs = result["collection_chamfer"].sel(dense_match="latent", shape=name).item()
        assert metrics.chamfer(X, X[match]) == pytest.approx(theirs, rel=0.01)


def test_full_resolution_matches_the_nearest_rows_of_u_phi_y(paper):
    registration = paper["registration"].to_dataset()
    template = registration.attrs["template"]
    rows = {}
    for name in registration["shape"].values.tolist():
        low = paper["coarse"][name].to_dataset()
        entries = low["local_vertex"].values, low["local_sample"].values
        dense = np.zeros((1500, low.sizes["vertex"]))
        dense[entries] = low["local_weight"].values
        Y = paper["latent/latent_basis"].sel(shape=name).values
        rows[name] = dense @ low["eigenfunction"].values @ Y
    for name in set(rows) - {template}:
        distance = cdist(rows[template], rows[name])
        match = registration["registered_match"].sel(shape=name).values
        assert np.allclose(distance[np.arange(1500), match], distance.min(1), rtol=1e-3)


def test_it_is_as_near_to_the_truth_as_a_study_of_rematch(sampled, study_of_files, brains):
    truth = brains["truth"]

    def image(shape, template):
        return s4a.synthetic.position(truth, shape, truth[template]["reference_point"].values)

    errors = [accuracy.accuracy(tree, image)["error"] for tree in (sampled, study_of_files)]
    ours, theirs = (error.sel(algorithm=accuracy.SURFACE).mean().item() for error in errors)
    assert ours < 1.5 * theirs
    assert ours < 0.7 * errors[0].sel(algorithm=accuracy.ICP).mean()


def test_the_commands_take_it(folder, brain_files, sampled, tmp_path, no_pictures):
    assert main(["view", str(folder), "--page", str(tmp_path / "page.html")]) == 0
    assert SAMPLES in (tmp_path / "page.html").read_text(encoding="utf-8")
    few = ["--permutations", "9", "--out", str(tmp_path / "statistics")]
    assert main(["statistics", str(folder), *few]) == 0
    new = shutil.copy(brain_files[3], tmp_path / "new.ply")
    out = ["--out", str(tmp_path / "inserted"), "--n-jobs", "1"]
    assert main(["insert", str(folder), str(new), *out]) == 0
    x = sampled["original/brain_04"]["position"].values[:, 0]
    np.save(tmp_path / "labels.npy", np.digitize(x, np.quantile(x, [0.2, 0.4, 0.6, 0.8])))
    labels = ["--labels", str(tmp_path / "labels.npy"), "--out", str(tmp_path), "--n-jobs", "1"]
    assert main(["transfer", str(new), str(folder), *labels]) == 0
    first = np.load(tmp_path / "brain_02.labels.npy")
    assert main(["transfer", str(new), str(folder), *labels, "--method", "rematch"]) == 0
    second = np.load(tmp_path / "brain_02.labels.npy")
    assert 0 < (first != second).mean() < 0.1  # by other functions, to nearly the same places


def test_a_new_shape_comes_in_by_local_functions_too(paper, others):
    new = s4a.insert(paper, {"new": others["original/brain_04"].to_dataset()}, compare=False)
    assert new["coarse/new"].attrs["method"] == "scalable"
    Y = paper["latent/latent_basis"].sel(shape="brain_04").values
    own = new["latent/latent_basis"].values[0]
    assert np.linalg.norm(own - Y) < 0.4 * np.linalg.norm(Y)


def test_pairs_are_matched_by_it(meshes):
    source, target, *_ = meshes.values()
    small = {name: OPTIONS[name] for name in ("n_coarse", "k_init", "k")}
    result = s4a.match_pair(source, source, method="scalable", **small)
    assert (result["match"].values == np.arange(1500)).all()
    study = s4a.register_pairs(
        source, {"other": target}, method="scalable", bidirectional=False, **small
    )
    assert study["registration"].sizes["shape"] == 2


def test_an_external_mesh_is_matched_by_it(paper, meshes, monkeypatch):
    calls = []
    match = pair.match_shapes

    def watched(source, target, options):
        calls.append((source.is_sampled, target.is_sampled, options.method))
        return match(source, target, options)

    monkeypatch.setattr(pair, "match_shapes", watched)
    external = meshes["brain_03"]
    s4a.transfer_labels(paper, external["label"].values, source=external, targets=["brain_01"])
    assert calls == [(True, True, "scalable")]


def test_what_it_cannot_have_is_refused_by_name(brain_files, tmp_path, capsys):
    with pytest.raises(ValueError, match="method must be one of 'rematch', 'scalable'; found 'zo'"):
        Options(method="zo")
    with pytest.raises(
        ValueError, match="no coarse mesh, and refined_eigenfunctions=True refines its"
    ):
        Options(method="scalable", refined_eigenfunctions=True)
    words = ["run", str(brain_files[0]), "--out", str(tmp_path / "no"), "--method", "scalable"]
    assert main([*words, "--wrap"]) == 2
    assert "has no coarse mesh, and --wrap remeshes another surface" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*words[:-1], "zo"])
    assert Options(method="scalable", preset="paper").refine == "intrinsic"


def test_fields_are_projected_by_the_vertices_nearest_to_samples(brain):
    low = reduced(brain, n_coarse=300, k=8)
    near = Shape(brain, low, n_projected=600).near_coarse
    X = brain["position"].values
    gap = np.linalg.norm(X - X[low["sample_vertex"].values[low["sample_cell"].values]], axis=1)
    assert len(near) == 600
    assert set(np.argsort(gap)[:300]) <= set(near)
    assert gap[near].max() <= np.sort(gap)[600]
    assert (low_vertices(low) == low["sample_vertex"].values).all()
