"""The comparison of Table 1 and Table 2."""

import shutil

import numpy as np
import pytest
import xarray as xr

from s4a import compare, compare_collection, synthetic
from s4a.cli import main
from s4a.evaluation import comparison
from s4a.evaluation.methods import Pair, Spaces
from s4a.evaluation.metrics import nearest_distances
from s4a.geometry.mesh import as_arrays
from s4a.input.files import write_mesh

SMALL = {"n_coarse": 400, "k": 30, "n_geodesic": 100}


@pytest.fixture(scope="module")
def three_brains(brains, meshes):
    """A source, two targets by name, and where the vertices of the targets truly lie on it."""
    (reference, source), *targets = list(meshes.items())[:3]
    truth = {
        name: np.asarray(
            synthetic.position(brains["truth"], reference, brains["truth"][name]["reference_point"])
        )
        for name, _ in targets
    }
    return source, dict(targets), truth


@pytest.fixture(scope="module")
def found(three_brains):
    source, targets, truth = three_brains
    return compare(source, targets, truth=truth, **SMALL)


def test_every_method_has_every_metric_and_its_time_by_block(found):
    assert found["algorithm"].values.tolist() == list(comparison.METHODS)
    assert found["chamfer"].dims == found["geodesic_error"].dims == ("algorithm", "pair")
    assert found["block_seconds"].dims == ("algorithm", "pair", "block")
    assert found.sizes["pair"] == 2
    names = "geodesic_error euclidean_error chamfer hausdorff dirichlet coverage bijectivity"
    for name in names.split():
        assert set(found[name].dims) == {"algorithm", "pair"}, name
        assert np.isfinite(found[name]).all(), name
    spent = found["block_seconds"].mean("pair")
    assert spent.dims == ("algorithm", "block")
    assert (spent.sel(block="sample").sel(algorithm=["kNN", "ZO", "FMAP+ZO"]) == 0).all()
    assert (spent.sel(block="sample").sel(algorithm=["SCALABLE", "RE-MATCH"]) > 0).all()
    assert (spent.sel(block=["basis", "map", "refine"]).sel(algorithm="FMAP+ZO") > 0).all()
    assert (spent.sel(block="align") > 0).all()
    assert spent.sel(algorithm="registered").sum() > spent.sel(algorithm="RE-MATCH").sum()


def test_nearest_neighbours_in_space_have_the_largest_chamfer_distance_of_the_papers(found):
    chamfer = found["chamfer"].sel(algorithm=list(comparison.PAPER_METHODS))
    assert (chamfer.idxmax("algorithm") == "kNN").all()


def test_holes_in_the_image_of_nearest_neighbours_are_at_most_twice_the_distance_of_the_shapes(
    three_brains,
):
    source, targets, _ = three_brains
    pair = Pair(Spaces(source), Spaces(next(iter(targets.values()))))
    X, Y, (R, t) = pair.source.X, pair.target.X, pair.align_samples[0]
    image = X[pair.run("kNN").match]
    holes, back = nearest_distances(X, image)
    assert (holes <= 2 * nearest_distances(X @ R.T + t, Y)[0] + 1e-12).all()
    assert (back == 0).all(), "the image has vertices of the source only"
    nearest = nearest_distances(Y, X @ R.T + t)[0]
    assert np.allclose(nearest_distances(Y, image @ R.T + t)[0], nearest)


def test_maps_of_low_resolution_take_less_time_than_those_of_dense_meshes(found):
    seconds = found["block_seconds"].sum("block").mean("pair")
    dense = seconds.sel(algorithm=["ZO", "FMAP+ZO"]).min("algorithm")
    assert (seconds.sel(algorithm=["SCALABLE", "RE-MATCH"]) < dense).all()


def test_the_default_is_more_accurate_than_every_other_method(found):
    error = found["euclidean_error"].mean("pair")
    others = error.drop_sel(algorithm=["registered", "registered surface"])
    assert error.sel(algorithm="registered") < 0.9 * others.min()


def test_on_equal_terms_the_default_ends_on_the_source_and_its_surface_between_vertices(found):
    chamfer = found["chamfer"].mean("pair")
    assert chamfer.sel(algorithm="registered") < 1.1 * chamfer.sel(algorithm="RE-MATCH")
    assert chamfer.sel(algorithm="registered surface") > 2 * chamfer.sel(algorithm="registered")
    smooth = found["dirichlet"].mean("pair")
    assert smooth.sel(algorithm="registered surface") < smooth.sel(algorithm="registered")
    for name in ("geodesic_error", "coverage", "bijectivity"):  # of the match, which is one
        matched, surface = found[name].sel(algorithm=["registered", "registered surface"]).values
        assert np.array_equal(matched, surface)


def test_rematch_is_the_papers_with_and_without_the_preset(three_brains):
    source, targets, _ = three_brains
    target = next(iter(targets.values()))
    two = {"methods": ["RE-MATCH", "RE-MATCH refined"]}
    ours = compare(source, target, **two, **SMALL)
    paper = compare(source, target, preset="paper", methods=["RE-MATCH"], **SMALL)
    assert paper["chamfer"].item() == ours["chamfer"].sel(algorithm="RE-MATCH").item()
    assert paper["chamfer"].item() != ours["chamfer"].sel(algorithm="RE-MATCH refined").item()


def test_every_method_finds_a_shape_in_itself(meshes):
    mesh = meshes["brain_01"]
    same = np.arange(mesh.sizes["vertex"])
    found = compare(mesh, mesh, truth=same, **SMALL)
    exact = [way for way in comparison.METHODS if way not in ("RE-MATCH refined", "SCALABLE")]
    assert (found["geodesic_error"].sel(algorithm=exact) == 0).all()
    assert (found["geodesic_error"] < 0.005).all()
    assert (found["bijectivity"].sel(algorithm=exact) == 0).all()


def test_an_alignment_that_given_landmarks_make_needless_is_not_charged(three_brains):
    source, targets, _ = three_brains
    target = next(iter(targets.values()))
    marks = np.arange(0, 50, 10), np.arange(0, 50, 10)
    found = compare(
        source, target, landmarks=marks, methods=["kNN", "FMAP+ZO", "RE-MATCH"], **SMALL
    )
    align = found["block_seconds"].sel(block="align").isel(pair=0)
    assert align.sel(algorithm="kNN") > 0
    assert (align.sel(algorithm=["FMAP+ZO", "RE-MATCH"]) == 0).all()


def test_given_landmarks_make_up_for_a_rigid_alignment_that_is_wrong():
    mesh = synthetic.ellipsoid(1500, (1.2, 1.1, 1.0))
    wavy = mesh.assign(position=mesh["position"] * (1 + 0.15 * np.cos(5 * mesh["position"][:, 0])))
    turned = wavy.assign(position=wavy["position"] * [-1.0, -1.0, 1.0])
    same = np.arange(1500)
    some = same[::150]
    found = compare(
        wavy, turned, truth=same, landmarks=(some, some), methods=["RE-MATCH"], **SMALL | {"k": 40}
    )
    assert found["geodesic_error"].item() < 0.02
    places = wavy["position"].values[some], turned["position"].values[some]
    again = compare(
        wavy, turned, truth=same, landmarks=places, methods=["RE-MATCH"], **SMALL | {"k": 40}
    )
    assert again["geodesic_error"].item() == found["geodesic_error"].item()


def test_truth_and_landmarks_of_files_count_the_rows_of_the_files(tmp_path):
    X, T = as_arrays(synthetic.brains(2, 800)["original/brain_01"].to_dataset())
    order = np.random.default_rng(0).permutation(len(X))
    rank = np.argsort(order)
    write_mesh(
        tmp_path / "a.ply", np.r_[[[9e3, 0, 0]], X], T + 1
    )  # an idle vertex first: it is dropped
    write_mesh(tmp_path / "b.ply", X[order], rank[T])
    found = compare(
        tmp_path / "a.ply", tmp_path / "b.ply", truth=order + 1, methods=["kNN"], n_geodesic=100
    )
    assert found["geodesic_error"].item() == 0
    assert found["block_seconds"].sel(block="load and clean").item() > 0


def test_what_is_wrong_is_said(three_brains):
    source, targets, _ = three_brains
    target = next(iter(targets.values()))
    with pytest.raises(ValueError, match="methods must be some of kNN"):
        compare(source, target, methods=["ICP"])
    with pytest.raises(ValueError, match=r"the methods kNN.*found RE-MATCH refined, registered"):
        compare(source, target, methods=["kNN", *comparison.METHODS[-3:]], preset="paper")
    with pytest.raises(ValueError, match="preset 'paper' sets full_resolution_iterations=0"):
        compare(source, target, preset="paper", full_resolution_iterations=1)
    with pytest.raises(ValueError, match="init must be one of 'landmarks', 'descriptors'"):
        compare(source, target, init="dense")
    with pytest.raises(ValueError, match="landmarks need two arrays"):
        compare(source, target, landmarks=(np.arange(4), np.arange(5)), methods=["kNN"])
    with pytest.raises(ValueError, match="all paths or all Datasets"):
        compare(source, "b.ply")
    with pytest.raises(ValueError, match="at least 2 shapes"):
        compare_collection({"only": source})
    with pytest.raises(ValueError, match="methods must be some of SCALABLE"):
        compare_collection({"a": source, "b": target}, methods=["kNN"])


def test_both_ways_to_full_resolution_share_all_but_the_last_block(three_brains):
    source, targets, _ = three_brains
    found = compare_collection({"brain_01": source, **targets}, n_coarse=400, k=30)
    assert found["collection_chamfer"].dims == ("algorithm", "dense_match", "shape")
    seconds = found["collection_seconds"]
    shared = seconds.drop_sel(block="full resolution")
    assert (shared.sel(dense_match="fmap") == shared.sel(dense_match="latent")).all()
    for way in found["algorithm"].values:
        template = found["median_shape"].sel(algorithm=way).item()
        known = found["collection_chamfer"].sel(algorithm=way).drop_sel(shape=template)
        assert (known < 0.06).all()
        assert found["distance_to_limit"].sel(algorithm=way).idxmin().item() == template


def test_small_meshes_are_compared_in_as_many_functions_as_they_have_and_a_note_says_so(caplog):
    few, more = synthetic.ellipsoid(60), synthetic.ellipsoid(90, (1.3, 1.1, 1.0))
    for source, target in ((few, more), (more, few)):
        found = compare(source, target, n_geodesic=20)
        assert found["algorithm"].values.tolist() == list(comparison.METHODS)
        assert np.isfinite(found["chamfer"]).all()
        note = "pair: k = 100 reduced to 58, the number of eigenfunctions of the smaller mesh"
        assert found.attrs["note"] == note
        assert note in caplog.text
    itself = compare(few, few, truth=np.arange(60), n_geodesic=20)
    assert (itself["geodesic_error"].sel(algorithm=["ZO", "RE-MATCH", "registered"]) == 0).all()
    enough = compare(few, more, methods=["ZO"], k=20, n_geodesic=20)
    assert "note" not in enough.attrs


def test_a_collection_of_small_meshes_is_compared_in_as_many_functions_as_all_have(caplog):
    found = compare_collection(synthetic.brains(3, 300), n_coarse=100)
    assert found["collection_chamfer"].notnull().sum() == 8
    assert "RE-MATCH: k = 100 reduced to" in found.attrs["note"]
    assert found.attrs["note"] in caplog.text
    few = compare_collection(synthetic.brains(3, 300), n_coarse=100, k=30)
    assert "note" not in few.attrs


def test_the_space_of_a_mesh_itself_has_no_projection():
    dense = Spaces(synthetic.sphere(500), k=9).dense
    assert dense.U is None
    np.testing.assert_allclose(dense.low.eigenvalue[1:4], 8 * np.pi, rtol=0.03)


def test_the_command_writes_table_file_and_figure(tmp_path, capsys):
    meshes = synthetic.brains(3, 700)["original"].children
    for name, node in meshes.items():
        write_mesh(tmp_path / f"{name}.ply", *as_arrays(node.to_dataset()))
    one, two, _ = (str(tmp_path / f"{name}.ply") for name in meshes)
    np.save(tmp_path / "truth.npy", meshes["brain_01"]["position"].values[:700])
    out = tmp_path / "out"
    options = ["--out", str(out), "--n-coarse", "200", "--k", "20"]
    words = ["--methods", "kNN", "RE-MATCH", "--truth", str(tmp_path / "truth.npy")]
    assert main(["compare", one, two, *words, *options]) == 0
    text = capsys.readouterr().out
    assert "RE-MATCH" in text
    assert "CPU seconds" in text
    with xr.open_dataset(out / "compare.nc") as found:
        assert found["algorithm"].values.tolist() == ["kNN", "RE-MATCH"]
        assert "geodesic_error" in found
    assert (out / "compare.png").stat().st_size > 5000

    marks = meshes["brain_01"]["position"].values[:60:10]
    for name, points in (("source", marks), ("target", marks[::-1])):
        rows = "\n".join(f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(points))
        (tmp_path / f"{name}.csv").write_text("name,x,y,z\n" + rows)
    files = [str(tmp_path / f"{name}.csv") for name in ("source", "target")]
    given = ["--methods", "RE-MATCH", "--landmarks", *files]
    assert main(["compare", one, two, *given, *options]) == 0
    assert "RE-MATCH" in capsys.readouterr().out
    assert main(["compare", one, two, *given[:-1], *options]) == 2
    assert "a file for the source and each target" in capsys.readouterr().err
    assert main(["compare", "--collection", str(tmp_path), "--methods", "RE-MATCH", *options]) == 0
    assert "median shape" in capsys.readouterr().out
    truth, options[1] = str(tmp_path / "truth.npy"), str(tmp_path / "again")
    others = [tmp_path / f"{folder} scans" / "head.ply" for folder in "ba"]
    for path in others:
        path.parent.mkdir()
        shutil.copy(two, path)
    last = ["--methods", "kNN", "--truth", truth, truth, *options]
    assert main(["compare", one, *map(str, others), *last]) == 0
    with xr.open_dataset(tmp_path / "again" / "compare.nc") as found:
        assert found["pair"].values.tolist() == ["b_scans_head", "a_scans_head"]
    capsys.readouterr()
    assert main(["compare", one, two, two, *options]) == 2
    assert "every TARGET once needed" in capsys.readouterr().err
    assert main(["compare", one, *options]) == 2
    assert "SOURCE and TARGET" in capsys.readouterr().err
    assert main(["compare", one, "--collection", str(tmp_path), *options]) == 2
