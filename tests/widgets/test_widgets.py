"""Panels without a browser.

What they show equals the arrays, clicks have their effect, closing removes all widgets.
"""

import base64
import json
import logging
import re
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("anywidget")
import ipywidgets
from IPython.core.interactiveshell import ExecutionInfo, InteractiveShell
from ipywidgets.widgets import widget as registry  # the open widgets are counted in it
from matplotlib.colors import to_rgb

import s4a
from s4a.geometry.mesh import as_dataset, vertex_normals
from s4a.method.network import spectral_distance
from s4a.method.shape import Shape
from s4a.show import charts, panel_page
from s4a.show.browser import color_bytes
from s4a.show.charts import PALE
from s4a.show.draw import cycle_error_colors, cycle_error_limits, position_colors
from s4a.show.surfaces import aligned, mesh_of, mode_limits, network_limits
from s4a.study.progress import status
from s4a.widgets import (
    Correspondence,
    Explore,
    FunctionalMap,
    Median,
    Modes,
    Network,
    Progress,
    Spectrum,
    Transfer,
)
from s4a.widgets import explore as explore_module
from s4a.widgets import network as network_module
from s4a.widgets import spectrum as spectrum_module
from s4a.widgets.modes import ModesView
from s4a.widgets.views import Scene


@pytest.fixture
def panel(study, closed_later):
    """Make a panel of the study."""
    return lambda kind, **options: closed_later(kind, study, **options)


def floats(data, columns=3):
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def tetrahedron():
    X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    return X, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


# ---- scene


def test_a_scene_holds_the_arrays_as_float32_and_uint32():
    X, T = tetrahedron()
    view = Scene(title="solid")
    view.show(X, T, position_colors(X))
    assert (floats(view.position) == X.astype(np.float32)).all()
    assert (np.frombuffer(view.corner, "<u4").reshape(-1, 3) == T).all()
    assert len(view.color) == 12
    view.overlay(X + 1, T)
    assert (floats(view.ghost_position) == X + 1).all()
    view.close()


def test_unknown_colours_are_grey():
    assert list(color_bytes([[np.nan] * 3, [0, 0.5, 1]])) == [153, 153, 153, 0, 128, 255]


def test_without_webgl_a_still_picture_is_sent():
    view = Scene()
    view.show(*tetrahedron())
    assert view.still == b""
    view.webgl = "no"
    assert view.still[1:4] == b"PNG"
    first = view.still
    view.paint(np.tile([1.0, 0, 0], (4, 1)))
    assert view.still != first
    view.close()


def test_a_still_picture_has_the_direction_of_the_view():
    X, T = tetrahedron()
    pictures = []
    for direction in ("front", "top"):
        view = Scene(view=direction, webgl="no")
        view.show(X * [1, 2, 3], T)
        pictures.append(view.still)
        view.close()
    assert pictures[0] != pictures[1]


# ---- modes


def test_the_vertices_are_the_mean_plus_the_sum_of_scores_times_modes(study, panel):
    modes = panel(Modes)
    modes.scores = [1.5, -2.0, 0.25]
    expected = s4a.synthesize(study, modes.scores)["position"].values
    np.testing.assert_allclose(modes.vertices(), expected, atol=1e-4)
    assert modes.view.scores == [1.5, -2.0, 0.25]
    assert modes.distance == pytest.approx(np.hypot(np.hypot(1.5, 2), 0.25))


def test_the_browser_gets_mean_and_modes_as_they_are(study, panel):
    modes = panel(Modes, resolution="full")
    X = study["registration"]["position"].values + study["pca"]["mean_displacement"].values
    assert (floats(modes.view.mean) == X.astype(np.float32)).all()
    assert (
        floats(modes.view.deformation) == study["pca"]["deformation"].values.reshape(-1, 3)
    ).all()
    modes.resolution.value = "coarse"
    assert (
        len(floats(modes.view.mean))
        == study["coarse"][study["registration"].attrs["template"]].sizes["vertex"]
    )
    assert len(floats(modes.view.deformation)) == 3 * len(floats(modes.view.mean))


def test_a_random_shape_is_repeatable_and_within_three_standard_deviations(panel):
    modes = panel(Modes)
    assert modes.random(seed=3) == modes.random(seed=3)
    assert max(map(abs, modes.scores)) <= 3


def test_the_mesh_is_saved_with_its_displacement_along_the_normal(study, panel, tmp_path):
    modes = panel(Modes)
    modes.scores = [2.0, 0, 0]
    modes.save_mesh(tmp_path / "shape.ply")
    np.testing.assert_allclose(
        s4a.read_mesh(tmp_path / "shape.ply")[0], modes.vertices(), atol=1e-3
    )
    assert b"normal_displacement" in (tmp_path / "shape.ply").read_bytes()[:1000]
    modes.save_mesh(tmp_path / "shape.obj")
    assert (tmp_path / "shape.obj").exists()


def test_fewer_modes_can_be_shown(panel):
    modes = panel(Modes, n_modes=2)
    assert len(modes.scores) == len(modes.view.ratio) == 2


def test_sliders_at_both_resolutions_and_pictures_have_one_scale(study, panel):
    for resolution in ("full", "coarse"):
        view = panel(Modes, resolution=resolution, n_modes=1).view
        assert (view.limit, view.limit_magnitude) == mode_limits(study)
        assert view.bars["normal"]["high"] == view.limit


def test_without_webgl_python_deforms(study):
    pca, (X, T) = study["pca"].dataset, mesh_of(study["registration"])
    mean = X + pca["mean_displacement"].values
    view = ModesView(mean, T, pca["deformation"].values, limits=(1.0, 1.0), unit="mm")
    view.webgl = "no"
    still = view.still
    assert still[1:4] == b"PNG"
    view.scores = [0, 2.0, 0]
    assert view.still != still
    points, _, colors = view.drawn()
    np.testing.assert_allclose(points, mean + 2 * pca["deformation"].values[1], atol=1e-5)
    along = ((points - mean) * vertex_normals(mean, T)).sum(1)
    assert colors[along.argmax()][2] > colors[along.argmax()][0], "blue is expansion"
    view.close()


# ---- network, maps


def test_a_clicked_edge_shows_its_map_and_both_meshes(study, panel):
    network = panel(Network)
    network.graph.picked = {"edge": 3, "count": 1}
    assert network.edge == 3
    row = study["network"].dataset.isel(pair=network.edge)
    assert network.matrix.spec["title"].startswith(
        f"{row['source'].item()} → {row['target'].item()}"
    )
    for stage, key in (("cycle_error_initial", "fmap_initial"), ("cycle_error", "fmap")):
        network.stage.value = stage
        shown = np.frombuffer(network.matrix.values, "<f4").reshape(row[key].shape)
        assert (shown == row[key].values.astype(np.float32)).all()
    for view, key in zip(network.scenes, ("source", "target"), strict=True):
        name = row[key].item()
        X = aligned(study, name, study["coarse"][name]["position"].values)
        assert (floats(view.position) == X.astype(np.float32)).all()
    assert network.choice.value == network.edge


def test_a_clicked_node_shows_its_mesh_alone(study, panel):
    network = panel(Network)
    network.edge = 0
    network.graph.picked = {"node": network.names[2], "count": 1}
    assert network.node == network.names[2]
    assert network.edge == -1
    assert network.scenes[0].title == network.names[2]
    assert network.scenes[1].layout.display == "none"


def test_the_edge_budget_shows_the_connectivity(panel):
    network = panel(Network)
    assert "6 pairs" in network.facts.value
    network.budget.value = 3
    assert re.search(r"3 pairs.*: connected, 0 triangles, 4 shapes in none", network.facts.value)
    assert len(network.graph.spec["source"]) == 6
    assert network.graph.spec["edges"] == network.shown


def test_edges_are_coloured_before_and_after_on_one_scale(study, panel):
    network = panel(Network)
    bar = network.bar.value
    both = [study["network"][key].values for key in ("cycle_error_initial", "cycle_error")]
    limits = network_limits(study)
    for key, errors in zip(("cycle_error_initial", "cycle_error"), both, strict=True):
        network.stage.value = key
        assert network.bar.value == bar
        np.testing.assert_allclose(network.graph.spec["values"], errors)
        colors = [to_rgb(color) for color in network.graph.spec["colors"]]
        np.testing.assert_allclose(colors, cycle_error_colors(errors, limits), atol=1 / 255)
        assert f"cycle errors {errors.min():.3f} to {errors.max():.3f}" in network.facts.value
    assert f">{limits[0]:.3g}<" in bar
    assert f">{limits[1]:.3g}<" in bar
    lines = charts.network(
        charts.on_circle(len(network.names)),
        network.names,
        *network.ends.T,
        dict(zip(("before", "after"), both, strict=True)),
    )
    drawn = lines.axes[1].collections[0].get_colors()[:, :3]
    np.testing.assert_allclose(np.sort(drawn, axis=0), np.sort(colors, axis=0), atol=1 / 255)


def test_cycle_errors_that_differ_by_a_tenth_have_different_colours():
    before, after = np.array([0.056, 0.062, 0.080]), np.array([0.0355, 0.039])  # as in lesson 00
    limits = cycle_error_limits(before, after)
    assert limits == (0.0355, 0.080)
    colors = [255 * cycle_error_colors(errors, limits) for errors in (before, after)]
    for several in colors:
        assert np.linalg.norm(np.diff(several, axis=0), axis=1).min() > 15
    distances = np.abs(np.subtract.outer(*(several.sum(1) for several in colors)))
    assert distances.min() > 15, "both stages on one scale"


def with_network(study, network):
    """The study with another network."""
    tree = study.copy()
    tree["network"] = xr.DataTree(network)
    return tree


def test_the_first_pairs_are_those_of_the_study_and_others_are_chosen_as_it_does(study):
    maps = study["network"].to_dataset()
    spectra = [mesh["eigenvalue"].values[:10] for mesh in study["coarse"].children.values()]
    for name in study["coarse"].children:  # stars, of which one at most has the nearest spectra
        star = (maps["source"] == name) | (maps["target"] == name)
        network = Network(with_network(study, maps.isel(pair=star.values)))
        assert network.shown == list(range(6))
        assert re.search(r">3 pairs: connected, 0 triangles", network.facts.value)
        network.budget.value = 4
        network.budget.value = 3
        assert network.shown == list(range(6))
        np.testing.assert_array_equal(network.distance, spectral_distance(spectra))
        network.close()


def test_maps_of_unknown_error_are_grey_and_labelled_in_no_cycle(study):
    maps = study["network"].to_dataset()
    maps["cycle_error"] = maps["cycle_error"].where(np.arange(maps.sizes["pair"]) != 3)
    network = Network(with_network(study, maps))
    network.stage.value = "cycle_error"
    colors = network.graph.spec["colors"]
    assert [i for i, color in enumerate(colors) if color == PALE] == [3]
    network.edge = 3
    assert "cycle error unknown: in no cycle, weight" in network.scenes[1].caption
    network.edge = 4
    assert re.search(r"cycle error 0\.\d+, weight", network.scenes[1].caption)
    network.close()


def test_two_shapes_have_a_network_without_cycles(study):
    maps = study["network"].to_dataset()
    ends = maps["source"].values[0], maps["target"].values[0]
    own = np.isin(maps["source"], ends) & np.isin(maps["target"], ends)
    maps = maps.isel(pair=own).assign(cycle_error=("pair", np.full(2, np.nan)))
    maps["cycle_error_initial"] = maps["cycle_error"]
    network = Network(with_network(study, maps))
    assert network.graph.spec["colors"] == [PALE, PALE]
    assert ">0.5<" in network.bar.value
    assert ">1<" in network.bar.value
    assert network.message.value == ""
    network.close()


def test_zoomout_is_that_of_the_step_module(study, panel):
    fmap = panel(FunctionalMap, pair=1)
    fmap.kind.value = "zoomout"
    row = study["network"].dataset.isel(pair=1)
    source, target = (study["coarse"][row[key].item()] for key in ("source", "target"))
    bases = (Shape(coarse=mesh.to_dataset()).low for mesh in (source, target))
    C, _ = s4a.method.fmap.zoomout(*bases, row["fmap_initial"].values, 24)
    np.testing.assert_allclose(fmap.C, C)
    fmap.k.value = 10
    np.testing.assert_array_equal(fmap.C, row["fmap_initial"].values)
    assert "off the diagonal" in fmap.numbers.value


def test_a_clicked_cell_shows_the_two_eigenfunctions(study, panel):
    fmap = panel(FunctionalMap)
    fmap.matrix.picked = {"row": 4, "column": 6, "count": 1}
    assert fmap.cell == (4, 6)
    assert (fmap.matrix.spec["row"], fmap.matrix.spec["column"]) == (4, 6)
    assert (fmap.row.value, fmap.column.value) == (4, 6)
    eigenvalue = study["coarse"][fmap.source[0]]["eigenvalue"].values[6]
    assert fmap.scenes[0].title.endswith(f"eigenvalue {eigenvalue:.2f}")


# ---- median, correspondence, spectrum


def test_bars_are_the_stored_distances_in_ascending_order(study, panel):
    median = panel(Median)
    latent = study["latent"].dataset
    np.testing.assert_allclose(
        median.bars.spec["values"], np.sort(latent["distance_to_limit"].values)
    )
    assert median.median == latent.attrs["median"] == median.selected
    median.bars.picked = {"index": 2, "count": 1}
    assert median.selected == median.bars.spec["names"][2]
    assert len(median.scene.ghost_position) > 0
    assert "rank 3 of 4" in median.scene.caption


def test_the_median_can_be_ranked_by_other_operators_norms_and_sizes(study, panel):
    median = panel(Median)
    values = median.bars.spec["values"]
    median.operator.value, median.size.value = "conformal", 12
    D = study["latent"]["conformal_difference"].values[:, :12, :12]
    expected = s4a.method.median.distance_to_identity(
        D, study["latent"]["latent_eigenvalue"].values[:12]
    )
    np.testing.assert_allclose(median.bars.spec["values"], np.sort(expected))
    assert median.bars.spec["values"] != values
    assert "The median is" in median.ties.value


def test_points_are_mapped_in_both_directions(study, panel):
    both = panel(Correspondence)
    match = study["registration"]["registered_match"].sel(shape=both.shape).values
    both.scenes[0].picked = {"vertex": 17, "count": 1}
    assert both.image == match[17]
    assert both.scenes[1].points[0][:3] == both.pair[1][0][match[17]].tolist()
    both.scenes[1].picked = {"vertex": 40, "count": 2}
    node = study["registration"][both.shape]
    corners = study["registration"]["corner_vertex"].values[node["template_triangle"].values[40]]
    assert both.vertex in corners
    assert both.image == 40


def test_two_shapes_are_matched_through_the_template(study, panel):
    both = panel(Correspondence)
    template, source, shape = both.template, *both.names[:2]
    both.source, both.shape = source, shape
    registered = study["registration"]["registered_match"]
    X, Y = both.pair[0][0], both.pair[1][0]
    assert len(X) == study["original"][source].sizes["vertex"]
    there, back = both.match(), both.reverse_match()
    # a vertex of the template, transferred to both shapes, is one point
    on_source, on_shape = (registered.sel(shape=name).values for name in (source, shape))
    size = np.ptp(Y, axis=0).max()
    assert np.median(np.linalg.norm(Y[there[on_source]] - Y[on_shape], axis=1)) < 0.02 * size
    assert np.median(np.linalg.norm(X[back[there]] - X, axis=1)) < 0.03 * size
    # the surfaces are composed, so only the last point is rounded to a vertex
    image = s4a.correspondence(study, source, shape)["image_position"].values
    Y, T = study["original"][shape]["position"].values, both.pair[1][1]
    longest = max(np.linalg.norm(Y[T[:, i]] - Y[T[:, i - 1]], axis=1).max() for i in range(3))
    assert np.linalg.norm(Y[there] - image, axis=1).max() <= 0.6 * longest
    colors = [np.frombuffer(view.color, np.uint8).reshape(-1, 3) for view in both.scenes]
    assert np.abs(colors[0].astype(int) - colors[1][there]).mean() < 6
    both.scenes[0].picked = {"vertex": 17, "count": 1}
    assert (both.vertex, both.image) == (17, there[17])
    assert both.scenes[0].caption == f"{source} vertex 17 ↔ {shape} vertex {there[17]}"
    both.colors.value = "confidence"
    assert "belongs to the registration" in both.scenes[0].caption
    for kind in ("low", "dense"):
        both.map.value = kind
        assert len(both.match()) == len(both.pair[0][0])
    both.source = template
    assert both.scenes[0].title.startswith(f"{template}, the template")
    assert both.message.value == ""


@pytest.mark.parametrize("kind", ["low", "dense"])
def test_the_match_of_the_latent_basis_can_be_shown(panel, kind):
    both = panel(Correspondence)
    both.map.value = kind
    assert both.message.value == ""
    assert len(both.match()) == len(both.pair[0][0])
    colors = np.frombuffer(both.scenes[0].color, np.uint8).reshape(-1, 3)
    shape = np.frombuffer(both.scenes[1].color, np.uint8).reshape(-1, 3)
    assert (colors == shape[both.match()]).all()


def test_confidence_is_shown_with_its_bar(study, panel):
    both = panel(Correspondence)
    both.colors.value = "confidence"
    assert both.scenes[0].bar["label"].startswith("confidence")
    assert len(both.scenes[1].color) == 3 * study["original"][both.shape].sizes["vertex"]


def test_the_checkerboard_is_evaluated_from_the_templates_coordinates(study, panel):
    both = panel(Correspondence)
    both.colors.value = "checker"
    template, shape = (floats(view.coordinate) for view in both.scenes)
    assert (template == study["registration"]["position"].values.astype(np.float32)).all()
    node = study["registration"][both.shape]
    corners = study["registration"]["corner_vertex"].values[node["template_triangle"].values]
    transferred = np.einsum("vc,vcx->vx", node["template_barycentric"].values, template[corners])
    np.testing.assert_allclose(shape, transferred, atol=1e-3)
    assert both.scenes[0].cell == both.scenes[1].cell > 0
    both.map.value = "low"
    template, shape = (floats(view.coordinate) for view in both.scenes)
    assert (template == shape[both.match()]).all()
    both.colors.value = "position"
    assert both.scenes[0].coordinate == b""
    assert both.scenes[0].cell == 0


def test_the_browser_knows_the_image_of_every_vertex(study, panel):
    both = panel(Correspondence)
    there, back = (np.frombuffer(view.link, "<i4") for view in both.scenes)
    assert (there == study["registration"]["registered_match"].sel(shape=both.shape).values).all()
    both.scenes[1].picked = {"vertex": 40, "count": 2}
    assert both.vertex == back[40]
    sure = study["registration"]["confidence"].sel(shape=both.shape).values
    np.testing.assert_allclose(np.frombuffer(both.scenes[0].link_values, "<f4"), sure)
    both.map.value = "low"
    back = np.frombuffer(both.scenes[1].link, "<i4")
    assert set(back[back >= 0]) <= set(range(len(both.match())))
    assert (both.match()[back[back >= 0]] == np.flatnonzero(back >= 0)).all()


def test_landmarks_are_spheres_of_a_radius_in_the_datas_unit(panel):
    both = panel(Transfer)
    both.radius.value = 2.5
    assert {point[6] for view in both.scenes for point in view.points} == {2.5}
    X, T = tetrahedron()
    moved, _, colors = s4a.show.draw.with_balls(X, T, None, [[9, 9, 9, 1, 0, 0, 2.5]])
    np.testing.assert_allclose(np.linalg.norm(moved[4:] - 9, axis=1), 2.5)
    assert (colors[4:] == [1, 0, 0]).all()


def test_labels_and_landmarks_are_transferred_as_by_the_step_module(study, panel, tmp_path):
    both = panel(Transfer)
    source, target = both.source, both.target
    mesh = study["original"][source].to_dataset()
    names = mesh["landmark_name"].values.tolist()
    assert list(both.marks) == names
    expected = s4a.analysis.transfer.transfer_landmarks(
        study, mesh, source=source, targets=[target]
    )[target]
    points = aligned(study, target, expected["landmark_position"].values)
    np.testing.assert_allclose([p[:3] for p in both.scenes[1].points], points)
    label = s4a.transfer_labels(study, mesh["label"].values, source=source, targets=[target])[
        target
    ]["label"]
    shown = np.frombuffer(both.scenes[1].color, np.uint8).reshape(-1, 3)
    here = np.frombuffer(both.scenes[0].color, np.uint8).reshape(-1, 3)
    value = label.values[0]
    assert (shown[0] == here[mesh["label"].values == value]).all()
    assert f"{value} {mesh['label'].attrs['names'][value]}: " in both.legend.value
    assert f"Landmarks on {target} (mm)" in both.table.value


def test_names_of_labels_and_landmarks_are_text_in_panels_and_saved_pages(study, tmp_path):
    bad = "<img src=x onerror=alert()><!--<script>"
    tree = study.copy()
    for node in tree["original"].children.values():
        data = node.to_dataset()
        label = np.array([bad, "b"])[data["label"].values % 2]
        data["label"] = xr.Variable("vertex", label)
        names = data["landmark_name"].values.tolist()
        data["landmark_name"] = xr.Variable("landmark", np.array([bad, *names[1:]]))
        node.dataset = data
    both = Transfer(tree)
    both.landmark = bad
    texts = [
        both.legend.value,
        both.table.value,
        both.save_html(tmp_path / "page.html").read_text(encoding="utf-8"),
    ]
    both.show_message(bad, error=True)
    for text in [*texts, both.message.value]:
        assert "&lt;img src=x" in text
        assert "<img src=x" not in text
        assert "<!--<script" not in text
    both.close()


def test_a_click_places_or_moves_a_landmark_and_it_is_saved(study, panel, tmp_path):
    both = panel(Transfer)
    count = len(both.marks)
    both.scenes[0].picked = {"vertex": 3, "face": 20, "weights": [0.5, 0.25, 0.25], "count": 1}
    assert len(both.marks) == len(both.scenes[1].points) == count + 1
    X, T = mesh_of(study["original"][both.source])
    np.testing.assert_allclose(both.marks[f"landmark {count + 1}"], [0.5, 0.25, 0.25] @ X[T[20]])
    both.landmark = "vertex"
    before = both.marks["vertex"]
    both.scenes[0].picked = {"vertex": 3, "face": 40, "weights": [1.0, 0, 0], "count": 2}
    assert len(both.marks) == count + 1
    assert (both.marks["vertex"] != before).any()
    lines = both.save_csv(tmp_path / "marks.csv").read_text().splitlines()
    assert lines[0] == "name,x,y,z"
    assert len(lines) == count + 2
    both.remove.click()
    assert "vertex" not in both.marks
    assert both.message.value == ""


def test_landmarks_that_were_placed_stay_until_another_source_is_chosen(panel, tmp_path):
    both = panel(Transfer)
    own = list(both.marks)
    both.landmark = "mine"
    both.scenes[0].picked = {"vertex": 5, "face": 3, "weights": [1 / 3] * 3, "count": 1}
    both.choices["target"].value = both.choices["target"].options[-1][1]
    assert list(both.marks) == [*own, "mine"]
    text = both.save_html(tmp_path / "page.html").read_text(encoding="utf-8")
    assert list(both.marks) == [*own, "mine"]
    assert ">mine<" in both.table.value
    assert ">mine<" in text
    both.source = next(name for name in both.choices["source"].options if name[1] != both.source)[1]
    assert "mine" not in both.marks


def test_saving_a_page_keeps_the_picked_point(panel, tmp_path):
    both = panel(Correspondence)
    both.scenes[0].picked = {"vertex": 5, "count": 1}

    def picked():
        shown = [(scene.points, scene.caption) for scene in both.scenes]
        return both.vertex, both.image, shown

    before = picked()
    assert before[0] == 5
    text = both.save_html(tmp_path / "page.html").read_text(encoding="utf-8")
    assert picked() == before
    assert text.count(before[2][0][1]) >= 2


def test_there_is_no_caption_for_hidden_labels(study, panel):
    both = panel(Transfer)
    assert both.scenes[1].caption.startswith("labels transferred from ")
    both.labels.value = False
    assert [scene.caption for scene in both.scenes] == ["", ""]
    both.labels.value = True
    assert both.scenes[1].caption.startswith("labels transferred from ")
    tree = study.copy()
    tree[f"original/{both.target}"].dataset = (
        tree[f"original/{both.target}"].to_dataset().drop_vars("label")
    )
    bare = Transfer(tree)
    bare.source, bare.target = both.target, both.source
    assert [scene.caption for scene in bare.scenes] == ["", ""]
    bare.close()


def test_the_spectrum_shows_every_shape_and_weyls_law(study, panel):
    spectrum = panel(Spectrum)
    series = {curve["name"]: curve["y"] for curve in spectrum.curves.spec["series"]}
    for name in study["coarse"].children:
        np.testing.assert_allclose(series[name], study["coarse"][name]["eigenvalue"].values)
    assert series["Weyl: 4 π k"][1] == pytest.approx(4 * np.pi)
    spectrum.curves.picked = {"series": "brain_03", "count": 1}
    assert spectrum.shape == "brain_03"
    spectrum.k.value = 24
    all_of_it = float(re.search(r"surface ([\d.e-]+)", spectrum.reconstruction.caption)[1])
    spectrum.k.value = 5
    assert float(re.search(r"surface ([\d.e-]+)", spectrum.reconstruction.caption)[1]) > all_of_it


# ---- many shapes


def test_of_many_shapes_the_graph_has_those_near_the_selected_shape(panel, monkeypatch):
    whole = panel(Network)
    monkeypatch.setattr(network_module, "MOST", 3)
    network = panel(Network)
    other = next(name for name in network.names if name != network.median)
    network.node = other
    spec = network.graph.spec
    assert len(spec["names"]) == 3 < len(network.names)
    assert {other, network.median} <= set(spec["names"])
    assert f"(the nearest 3 of {len(network.names)})" in spec["title"]
    ends = [[spec["names"][i] for i in spec[key]] for key in ("source", "target")]
    assert ends == [[names[e] for e in spec["edges"]] for names in (network.source, network.target)]
    assert network.facts.value == whole.facts.value  # of all
    last = len(network.source) - 1
    network.edge = last  # as by a click: it is no option of the list
    assert {network.source[last], network.target[last]} <= set(network.graph.spec["names"])
    assert network.message.value == ""


def test_of_many_shapes_some_spectra_and_the_selected_one_are_drawn(panel, monkeypatch):
    monkeypatch.setattr(spectrum_module, "MOST", 2)
    spectrum = panel(Spectrum)
    spectrum.shape = spectrum.names[1]
    shown = [series["name"] for series in spectrum.curves.spec["series"][1:]]
    assert len(shown) < len(spectrum.names)
    assert shown[-1] == spectrum.names[1]
    assert len(set(shown)) == len(shown)
    assert f" of {len(spectrum.names)})" in spectrum.curves.spec["title"]


# ---- progress


def ended(panel, seconds=400):
    panel.process.join(seconds)
    for _ in range(1000):
        if panel.stop.disabled:
            return panel.state
        time.sleep(0.05)
    raise TimeoutError(panel.total.value)


def test_an_analysis_shows_its_progress_and_its_panels(tmp_path):
    before = len(registry._instances)
    meshes = s4a.synthetic.brains(3, 500, seed=1)["original"].children.items()
    shapes = {name: mesh.to_dataset() for name, mesh in meshes}
    shapes["speck"] = as_dataset(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    panel = Progress(shapes, tmp_path / "study", n_coarse=200, k=12, k_init=6, n_jobs=1)
    assert ended(panel) == "finished", panel.message.value
    assert "left out speck: " in panel.total.value
    stages = status(tmp_path / "study").stages
    assert list(panel.bars) == list(stages)
    assert [bar.value for bar in panel.bars.values()] == [bar.max for bar in panel.bars.values()]
    assert panel.bars["registration"].max == stages["registration"].all == 3
    assert panel.texts["read and clean"].value.startswith("4 of 4, 0:0")
    assert "MiB" in panel.texts["read and clean"].value
    assert {bar.bar_style for bar in panel.bars.values()} == {"success"}
    panel.view.click()
    assert panel.explored["Network"].names == ["brain_01", "brain_02", "brain_03"]
    network = panel.explored["Network"]
    panel.explored.extend(panel.explored.study)
    assert panel.explored["Network"] is network
    panel.view.click()
    assert panel.explored["Network"] is not network
    assert panel.message.value == ""
    panel.close()
    assert len(registry._instances) == before


def test_a_failed_analysis_shows_the_error(tmp_path):
    panel = Progress({"one": tetrahedron()}, tmp_path / "study", n_jobs=1)
    assert ended(panel) == "failed"
    assert "at least 2" in panel.message.value
    panel.close()


def test_a_cancelled_analysis_ends_and_a_resumed_one_is_not_called_cancelled(tmp_path):
    panel = Progress(s4a.synthetic.brains(3, 500, seed=1), tmp_path / "study", n_jobs=1)
    assert panel.view.disabled, "nothing is there to open"
    panel.stop.click()
    assert panel.state == "cancelled"
    assert "cancelled" in panel.message.value
    assert ended(panel, 20) == "cancelled"
    assert not panel.process.is_alive()
    panel.resume.click()
    assert panel.state == "running"
    assert panel.message.value == ""
    assert panel.view.disabled == (not panel.ready())
    panel.close()


# ---- all of it


def test_a_cell_that_runs_again_closes_its_previous_tabs(study, monkeypatch):
    before = len(registry._instances)
    shell = InteractiveShell()
    monkeypatch.setattr(explore_module, "get_ipython", lambda: shell)

    def run(cell):
        """Run a cell as IPython does, and return its tabs."""
        shell.events.trigger("pre_run_cell", ExecutionInfo("", True, False, True, cell))
        monkeypatch.setattr(explore_module, "running_cell", lambda: cell)
        return s4a.explore(study)

    first, other = run("cell"), run("other")
    count = (len(registry._instances) - before) // 2
    second = s4a.explore(study)  # a second of the same run
    third = run("cell")
    assert [tabs.comm is None for tabs in (first, other, second, third)] == [
        True,
        False,
        False,
        False,
    ]
    assert len(registry._instances) == before + 3 * count
    for tabs in (other, second, third):
        tabs.close()
    assert len(registry._instances) == before
    assert not any(
        isinstance(getattr(function, "__self__", None), Explore)
        for function in shell.events.callbacks["pre_run_cell"]
    )


def test_no_cell_runs_outside_of_a_notebook():
    assert explore_module.running_cell() is None


def test_tabs_are_built_when_opened_and_closed_without_remains(study):
    before = len(registry._instances)
    for _ in range(2):
        tabs = study.s4a.explore()
        assert list(tabs.panels) == ["Modes"]
        for title in tabs.tabs.titles:
            assert tabs[title].title
        tabs.refresh(study)
        tabs.close()
    assert len(registry._instances) == before


def drawings(tabs, monkeypatch):
    """The titles of tabs that draw from now on, in their order."""
    drawn = []
    for title, panel in tabs.panels.items():
        for view in panel.scenes if hasattr(panel, "scenes") else []:
            monkeypatch.setattr(
                view,
                "show",
                lambda *a, title=title, show=view.show, **k: (drawn.append(title), show(*a, **k)),
            )
    return drawn


def test_a_pair_is_chosen_in_all_tabs_that_are_opened_before_or_later(study, monkeypatch):
    tabs = Explore(study)
    network = tabs["Network"]
    maps = tabs["Functional map"]
    assert maps.pair == 0, "nothing is chosen yet"
    tabs["Network"].graph.picked = {"edge": 7, "count": 1}
    source, target = tabs.pair
    assert (source, target) == (network.source[7], network.target[7])
    drawn = drawings(tabs, monkeypatch)
    assert tabs["Functional map"] is maps  # opened before
    assert maps.names() == (source, target)
    assert drawn == 2 * ["Functional map"], "once on each surface, and no other tab"
    both = tabs["Correspondence"]  # opened later
    assert {both.source, both.shape} == {source, target}
    assert tabs.pair == (source, target), "the direction stays"
    tabs["Functional map"].choice.value = 2
    assert tabs["Network"].edge == 2
    assert f"{maps.source[2]} → {maps.target[2]}" in network.matrix.spec["title"]
    both = tabs["Correspondence"]
    assert {both.source, both.shape} == {maps.source[2], maps.target[2]}
    other = next(name for name in both.names if name not in tabs.pair)
    both.choice.value = other
    assert tabs.pair == (both.source, other)
    assert tabs["Functional map"].names() == tabs.pair
    tabs.pair = (str(maps.source[5]), str(maps.target[5]))  # by a program, in the tab that is seen
    assert maps.pair == 5
    tabs.pair = ("nobody", "brain_01")
    assert maps.pair == 5
    assert all(panel.message.value == "" for panel in tabs.panels.values())
    tabs.close()


def test_a_page_of_one_panel_does_not_change_the_other_tabs(study, tmp_path):
    tabs = Explore(study)
    network = tabs["Network"]
    chosen = tabs.pair, tabs.shape
    network.save_html(tmp_path / "network.html", limit=100_000)
    assert (tabs.pair, tabs.shape) == chosen
    tabs.close()


def test_a_shape_is_chosen_in_all_tabs(study):
    tabs = Explore(study)
    spectrum = tabs["Spectrum"]
    assert spectrum.shape == tabs.shape == study["latent"].attrs["median"]
    tabs["Median"].bars.picked = {"index": 2, "count": 1}
    chosen = tabs.shape
    assert chosen == tabs["Median"].selected != study["latent"].attrs["median"]
    assert tabs["Spectrum"].shape == chosen
    assert tabs["Network"].node == chosen
    other = next(name for name in spectrum.names if name != chosen)
    tabs["Spectrum"].curves.picked = {"series": other, "count": 1}
    assert tabs["Median"].selected == other
    network = tabs["Network"]
    network.graph.picked = {"edge": 1, "count": 1}
    tabs["Spectrum"].choice.value = chosen
    assert tabs["Network"].edge == 1, "a pair that is chosen stays"
    network.graph.picked = {"node": other, "count": 2}
    assert (network.node, network.edge) == (other, -1)
    assert tabs.pair == ("", "")
    assert tabs["Spectrum"].shape == tabs["Median"].selected == other
    tabs.close()


def test_the_tabs_of_an_unfinished_study_show_what_is_missing(study, monkeypatch):
    started = xr.DataTree.from_dict(
        {f"coarse/{n}": c.to_dataset() for n, c in study["coarse"].children.items()}
    )
    tabs = Explore(started)
    assert "pca/deformation" in tabs.tabs.children[0].children[0].value
    assert tabs["Spectrum"].names == list(study["coarse"].children)
    with pytest.raises(ValueError, match="network/source"):
        Network(started)
    with pytest.raises(ValueError, match=r"'Modes' has no panel: .* pca/.*; there are Spectrum$"):
        tabs["Modes"]
    with pytest.raises(ValueError, match=r"no tab 'Mode'; there are Modes, Network"):
        tabs["Mode"]
    table = type("Table", (s4a.widgets.Panel,), {"needs": ("subjects",)})
    monkeypatch.setitem(explore_module.PANELS, "Table", table)
    with pytest.raises(ValueError, match=r"no tab 'Table', as the study lacks subjects;"):
        tabs["Table"]
    started["subjects"] = xr.Dataset({"age": ("shape", [31.0])})
    assert "Table" in explore_module.kinds_of(started)
    tabs.refresh(study)
    assert tabs["Modes"].scores == [0.0] * 3
    tabs.close()


def test_a_tab_shows_any_error_of_its_panel(study, monkeypatch, caplog):
    def broken(study):
        raise KeyError("gone")

    broken.needs = ()
    monkeypatch.setitem(explore_module.PANELS, "Median", broken)
    tabs = Explore(study)
    tabs.tabs.selected_index = list(tabs.kinds).index("Median")
    assert "KeyError: " in tabs.tabs.children[tabs.tabs.selected_index].children[0].value
    assert caplog.records
    tabs.close()


@pytest.fixture(scope="module")
def inserted(example_study):
    """A study of six brains, and one with a new brain inserted."""
    mesh = s4a.synthetic.brains(7, 200)["original/brain_07"].to_dataset()
    return s4a.insert(example_study, {"brain_07": mesh})


def test_of_an_inserted_shape_every_tab_is_shown_that_has_its_stage(inserted, caplog):
    tabs = Explore(inserted)
    for title in tabs.kinds:
        tabs.tabs.selected_index = list(tabs.kinds).index(title)
    assert list(tabs.panels) == ["Modes", "Median", "Correspondence", "Transfer", "Spectrum"]
    assert not caplog.records
    tabs.close()


def test_labels_of_the_template_are_transferred_to_an_inserted_shape(inserted, tmp_path):
    both = Transfer(inserted)
    template = inserted["registration"].attrs["template"]
    assert (both.source, both.target) == (template, "brain_07")
    label = inserted[f"original/{template}"]["label"].values
    expected = s4a.transfer_labels(inserted, label, source=template, targets=["brain_07"])
    assert (both.transferred["label"].values == expected["brain_07"]["label"].values).all()
    assert [value for _, value in both.choices["target"].options] == ["brain_07"]
    both.save_html(tmp_path / "page.html")
    assert both.message.value == ""
    both.close()


def test_a_correspondence_has_no_map_for_which_the_template_lacks_its_low_resolution(inserted):
    both = Correspondence(inserted)
    assert [value for _, value in both.map.options] == ["registered"]
    both.close()


@pytest.mark.parametrize("lost", ["original", "original/{template}", "registration/brain_07"])
def test_shapes_without_what_composing_needs_are_matched_from_the_template_alone(inserted, lost):
    template = inserted["registration"].attrs["template"]
    nodes = {node.path: node.to_dataset(inherit=False) for node in inserted.subtree}
    path = "/" + lost.format(template=template)
    part = xr.DataTree.from_dict(
        {name: nodes[name] for name in nodes if not f"{name}/".startswith(f"{path}/")}
    )
    if lost == "original":
        with pytest.raises(ValueError, match="needs original, which"):
            Correspondence(part)
        return
    both = Correspondence(part)
    assert [value for _, value in both.left.options] == [template]
    both.adopt(("brain_07", "brain_07"), "brain_07")
    assert (both.source, both.message.value) == (template, "")
    both.close()


def test_a_study_without_a_second_shape_is_refused(inserted):
    template = inserted["registration"].attrs["template"]
    nodes = {node.path: node.to_dataset(inherit=False) for node in inserted.subtree}
    del nodes[f"/original/{template}"]
    alone = xr.DataTree.from_dict(nodes)
    with pytest.raises(ValueError, match="needs a second shape to transfer to"):
        Transfer(alone)


def test_errors_in_callbacks_are_shown_and_logged(panel, caplog):
    modes = panel(Modes)
    modes.path.value = "shape.docx"
    with caplog.at_level(logging.ERROR):
        modes.ply.click()
    assert "shape.docx" in modes.message.value
    assert caplog.records


def test_a_page_is_self_contained(panel, tmp_path, monkeypatch):
    monkeypatch.setattr(panel_page, "N_VALUES", 2)
    for kind in (Modes, Network, FunctionalMap, Median, Correspondence, Transfer, Spectrum):
        path = panel(kind).save_html(tmp_path / "page.html", limit=100_000)
        text = path.read_text(encoding="utf-8")
        links = set(re.findall(r"(?:src|href)=[\"']?([^\"'> ]{1,12})|https?://[^\"'` )]+", text))
        assert {link for link in links if link and not link.startswith("data:")} == set()
        for state in re.findall(
            r'<script type="application/json"[^>]*>(.*?)</script>', text, re.DOTALL
        ):
            json.loads(state)


def recording(text):
    return json.loads(re.search(r'id="recording">(.*?)</script>', text, re.DOTALL)[1])


def test_a_page_records_the_output_for_every_value_of_its_controls(study, panel, tmp_path):
    fmap = panel(FunctionalMap, pair=3)
    before = fmap.matrix.values, fmap.scenes[0].color
    data = recording(fmap.save_html(tmp_path / "page.html").read_text(encoding="utf-8"))
    assert (fmap.matrix.values, fmap.scenes[0].color) == before
    labels = [control["id"] for control in data["controls"]]
    group = data["groups"][0]
    order = [labels[i] for i in group["controls"]]
    slot = next(i for i, (_, name, key) in enumerate(group["slots"]) if name == "values")
    choice = {"c-k": fmap.k.options.index(15), "c-kind": 1, "c-block": 0, "c-choice": 7}
    recorded = data["values"][group["rows"][",".join(str(choice[name]) for name in order)][slot]]
    fmap.pair, fmap.kind.value, fmap.k.value = 7, "zoomout", 15
    assert base64.b64decode(json.loads(recorded)["base64"]) == fmap.matrix.values


def test_of_a_long_slider_some_values_both_ends_and_the_current_one_are_recorded(monkeypatch):
    monkeypatch.setattr(panel_page, "N_VALUES", 3)
    slider = ipywidgets.IntSlider(5, 0, 10)
    assert panel_page.Control(slider, "k", every=False).values == [0, 4, 5, 8, 10]
    assert panel_page.Control(slider, "k", every=True).values == [*range(11)]
    slider.close()


def test_a_full_page_lists_what_is_not_recorded(panel, tmp_path):
    path = panel(Spectrum).save_html(tmp_path / "page.html", limit=60_000)
    text = path.read_text(encoding="utf-8")
    data = recording(text)
    shapes = next(control for control in data["controls"] if control["id"] == "c-choice")
    assert shapes["recorded"] == [0]
    assert "Only in a notebook" in text
    assert "changing shape" in text


def test_a_page_holds_stills_for_browsers_without_webgl(panel, tmp_path):
    for kind in (Modes, Correspondence):
        text = panel(kind).save_html(tmp_path / "page.html").read_text(encoding="utf-8")
        states = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', text, re.DOTALL)
        stills = [json.loads(state)["still"]["base64"] for state in states if '"still"' in state]
        assert stills
        assert all(base64.b64decode(still)[1:4] == b"PNG" for still in stills)


@pytest.mark.parametrize("missing", ["ipywidgets", "anywidget"])
def test_the_error_names_what_to_install(missing):
    code = (
        f"import sys; sys.modules[{missing!r}] = None\n"
        "import s4a\n"
        "try: s4a.explore(None)\n"
        "except ImportError as error: sys.stdout.write(str(error))"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert "pip install s4a[notebook]" in out
