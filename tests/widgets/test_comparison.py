"""The panel of methods side by side, without a browser."""

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("anywidget")
from s4a import compare, synthetic
from s4a.method.register import log_area_ratio
from s4a.show.draw import position_colors
from s4a.widgets import Comparison

METHODS = ["kNN", "RE-MATCH", "registered surface"]
SMALL = {"n_coarse": 200, "k": 20, "k_init": 10, "n_geodesic": 50}


@pytest.fixture(scope="module")
def comparison():
    """Matches of three methods between brains; the ground truth of 100 vertices is unknown."""
    brains = synthetic.brains(3, 700)
    source, *targets = (node.to_dataset() for node in brains["original"].children.values())
    names = list(brains["original"].children)
    truth = {}
    for name in names[1:]:
        reference = brains["truth"][name]["reference_point"]
        truth[name] = np.asarray(synthetic.position(brains["truth"], names[0], reference))
        truth[name][-100:] = np.nan
    pairs = dict(zip(names[1:], targets, strict=True))
    return compare(source, pairs, methods=METHODS, truth=truth, keep=True, **SMALL)


@pytest.fixture
def panel(comparison, closed_later):
    return lambda **options: closed_later(Comparison, comparison, **options)


def floats(data):
    return np.frombuffer(data, "<f4").reshape(-1, 3)


def test_kept_matches_agree_with_the_table(comparison):
    table = comparison["metrics"].to_dataset()
    for name, node in comparison["pairs"].children.items():
        kept, X = node.to_dataset(), comparison["source/position"].values
        metrics = table.sel(pair=name)
        for method in METHODS:
            match, image = (
                kept["algorithm_match"].sel(algorithm=method),
                kept["algorithm_image"].sel(algorithm=method),
            )
            if method != "registered surface":
                np.testing.assert_allclose(image, X[match], atol=1e-4)
            error = kept["algorithm_error"].sel(algorithm=method)
            assert float(error.mean()) == pytest.approx(
                metrics["euclidean_error"].sel(algorithm=method).item()
            )
            Y, T = kept["position"].values, kept["corner_vertex"].values
            expected = log_area_ratio(image.values.astype(float), Y, T)
            np.testing.assert_allclose(
                kept["algorithm_area_change"].sel(algorithm=method), expected, atol=1e-3
            )
        assert np.isnan(kept["true_position"][-100:]).all()
        assert (kept["true_match"][-100:] == -1).all()
        assert np.isnan(kept["algorithm_fmap"].sel(algorithm=["kNN", "registered surface"])).all()
        assert np.isfinite(kept["algorithm_fmap"].sel(algorithm="RE-MATCH")).all()
        assert kept["algorithm_fmap_initial"].shape == (3, 10, 10)


def test_without_keep_there_is_the_table_alone(comparison):
    source, target = comparison["source"].to_dataset(), comparison["pairs/brain_02"].to_dataset()
    alone = compare(source, target[["position", "corner_vertex"]], methods=["kNN"], **SMALL)
    assert isinstance(alone, xr.Dataset)
    with pytest.raises(ValueError, match="keep=True"):
        Comparison(alone)


def test_the_target_has_the_colours_of_the_matched_points(comparison, panel):
    shown = panel(methods=["RE-MATCH", "truth"])
    X = comparison["source/position"].values
    expected = (255 * position_colors(X)).round()
    kept = comparison["pairs/brain_02"].to_dataset()
    colors = [np.frombuffer(scene.color, np.uint8).reshape(-1, 3) for scene in shown.scenes]
    np.testing.assert_allclose(colors[0], expected, atol=1)
    match = kept["algorithm_match"].sel(algorithm="RE-MATCH").values
    np.testing.assert_allclose(colors[1], expected[match], atol=1)
    assert (colors[2][-100:] == 153).all()  # where the truth is unknown
    shown.colors.value = "checker"
    assert (floats(shown.scenes[0].coordinate) == X.astype(np.float32)).all()
    np.testing.assert_allclose(floats(shown.scenes[1].coordinate), X[match], atol=1e-4)
    assert shown.scenes[1].cell == shown.scenes[0].cell > 0
    shown.method0.value = "registered surface"
    image = kept["algorithm_image"].sel(algorithm="registered surface").values
    np.testing.assert_allclose(floats(shown.scenes[1].coordinate), image, atol=1e-4)


def test_errors_have_one_scale_and_the_mean_is_shown(comparison, panel):
    shown = panel()
    assert [choice.value for choice in shown.methods] == ["RE-MATCH", "registered surface", "kNN"]
    shown.colors.value = "error"
    bars = [scene.bar for scene in shown.scenes[1:]]
    assert bars[0] == bars[1] == bars[2]
    errors = 100 * comparison["metrics/euclidean_error"].sel(algorithm="registered surface")
    for shown.pair.value in ("brain_02", "brain_03"):
        mean = errors.sel(pair=shown.pair.value).item()
        assert shown.scenes[2].title == f"registered surface, error {mean:.2f} %"
    shown.colors.value = "area"
    assert shown.scenes[1].bar["high"] == 2
    assert shown.message.value == ""


def test_a_vertex_is_marked_with_its_match_by_each_method(comparison, panel):
    shown = panel(methods=["kNN", "registered surface"])
    kept = comparison["pairs/brain_02"].to_dataset()
    X, Y = comparison["source/position"].values, kept["position"].values
    shown.scenes[2].picked = {"vertex": 17, "count": 1}
    match = kept["algorithm_match"].sel(algorithm=["kNN", "registered surface"]).values[:, 17]
    marks = np.array([mark[:3] for mark in shown.scenes[0].points])
    np.testing.assert_allclose(marks, X[match])
    assert shown.scenes[1].points[0][:3] == Y[17].tolist()
    error = 100 * kept["algorithm_error"].sel(algorithm="registered surface").values[17]
    assert shown.scenes[2].caption == (
        f"target vertex 17 → source vertex {match[1]}, error {error:.2f} %"
    )
    shown.scenes[0].picked = {"vertex": 40, "count": 1}
    back = kept["algorithm_reverse"].sel(algorithm="kNN").values[40]
    assert shown.scenes[1].points[0][:3] == Y[back].tolist()
    shown.scenes[1].picked = {"vertex": 650, "count": 1}
    assert shown.scenes[1].caption.endswith("error unknown %")


def test_a_vertex_of_the_source_is_marked_again_for_another_method(comparison, panel):
    shown = panel(methods=["kNN", "RE-MATCH"])
    kept = comparison["pairs/brain_02"].to_dataset()
    reverse = kept["algorithm_reverse"].sel(algorithm="registered surface").values
    vertex = int(np.argmax(reverse >= 0))
    shown.scenes[0].picked = {"vertex": vertex, "count": 1}
    shown.method0.value = "registered surface"
    assert shown.scenes[1].points[0][:3] == kept["position"].values[reverse[vertex]].tolist()
    assert shown.scenes[1].caption.startswith(f"target vertex {reverse[vertex]} → ")
    assert shown.scenes[0].points[0][:3] == comparison["source/position"].values[vertex].tolist()


@pytest.mark.parametrize("side", [0, 1])
def test_marks_and_captions_are_removed_for_another_pair(panel, side):
    shown = panel(methods=["kNN", "truth"])
    shown.scenes[side].picked = {"vertex": 17, "count": 1}
    assert "vertex" in shown.scenes[1].caption
    shown.pair.value = "brain_03"
    assert [scene.points for scene in shown.scenes] == [[], [], []]
    assert [scene.caption for scene in shown.scenes] == ["coordinates as colours", "", ""]


def test_saving_a_page_keeps_the_picked_vertex(panel, tmp_path):
    shown = panel(methods=["kNN", "truth"])
    shown.scenes[0].picked = {"vertex": 17, "count": 1}
    before = [(scene.points, scene.caption) for scene in shown.scenes]
    shown.save_html(tmp_path / "page.html")
    assert [(scene.points, scene.caption) for scene in shown.scenes] == before
    assert shown.source_vertex == 17


def test_the_browser_gets_both_matches_and_the_errors(comparison, panel):
    scene = panel(methods=["RE-MATCH"]).scenes[1]
    kept = comparison["pairs/brain_02"].to_dataset().sel(algorithm="RE-MATCH")
    assert (np.frombuffer(scene.link, "<i4") == kept["algorithm_match"]).all()
    assert (np.frombuffer(scene.link_back, "<i4") == kept["algorithm_reverse"]).all()
    np.testing.assert_array_equal(np.frombuffer(scene.link_values, "<f4"), kept["algorithm_error"])


def test_without_ground_truth_there_is_no_error(comparison, panel):
    source, target = comparison["source"].to_dataset(), comparison["pairs/brain_02"].to_dataset()
    mesh = target[["position", "corner_vertex"]]
    shown = Comparison(compare(source, mesh, methods=["kNN"], keep=True, **SMALL))
    assert "error" not in [value for _, value in shown.colors.options]
    assert shown.scenes[1].title == "kNN"
    shown.scenes[1].picked = {"vertex": 3, "count": 1}
    assert "error" not in shown.scenes[1].caption
    shown.close()


def test_unknown_methods_are_refused(comparison):
    with pytest.raises(
        ValueError, match="methods must be 1 to 7 of kNN, RE-MATCH, registered surface, truth"
    ):
        Comparison(comparison, methods=["ZO"])
    with pytest.raises(ValueError, match="methods must be 1 to 7"):
        Comparison(comparison, methods=["kNN"] * 8)


def test_the_result_of_the_command_can_be_shown(comparison, tmp_path):
    comparison.to_netcdf(tmp_path / "compare.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "compare.nc", engine="h5netcdf") as opened:
        panel = Comparison(opened, methods=["registered surface"])
        assert panel.scenes[1].title.startswith("registered surface, error")
        panel.close()
