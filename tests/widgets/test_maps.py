"""The panel of maps, without a browser."""

import logging

import numpy as np
import pytest

pytest.importorskip("anywidget")
from s4a import statistics
from s4a.geometry.mesh import as_arrays, vertex_areas, vertex_normals
from s4a.schema import dataset
from s4a.show.draw import signed_colors
from s4a.widgets import Maps
from s4a.widgets.maps import GREY


@pytest.fixture(scope="module")
def result(study):
    """A regression, with p values that are given: small on a third of the vertices."""
    result = statistics.regression(study, [3, 1, 4, 2], of="normal", n_permutations=15)
    p = np.where(np.arange(result.sizes["vertex"]) % 3, 0.4, 0.02)
    return result.assign(p_family_wise=result["p_family_wise"].copy(data=p))


@pytest.fixture
def panel(study, result, closed_later):
    return lambda values=result, **options: closed_later(Maps, study, values, **options)


def test_it_is_grey_where_it_is_not_significant_and_shows_the_significant_share(
    panel, result, study
):
    shown = panel()
    significant = result["p_family_wise"].values <= 0.05
    X, T = as_arrays(study["registration"].to_dataset())
    values = (result["effect"].values * vertex_normals(X, T)).sum(1)
    limit = np.quantile(abs(values), 0.99)
    assert (shown.scene.colors[~significant] == GREY).all()
    expected = np.clip(signed_colors(values, limit), 0, 1)
    np.testing.assert_allclose(shown.scene.colors[significant], expected[significant], atol=1e-6)
    area = vertex_areas(X, T)
    share = 100 * area[significant].sum() / area.sum()
    assert f"{share:.1f} % of the area at p ≤ 0.05 (family-wise), smallest p 0.02" in (
        shown.scene.caption
    )
    shown.level.value = 0.01
    assert (shown.scene.colors == GREY).all()
    assert shown.scene.caption.startswith("0.0 % of the area")
    shown.where.value = "everywhere"
    assert not (shown.scene.colors == GREY).all(1).any()


def test_a_click_shows_the_values_at_a_vertex(panel, result):
    shown = panel()
    shown.scene.picked = {"vertex": 6, "count": 1}
    assert shown.scene.caption.startswith(
        f"vertex 6: effect, along the normals {shown.values()[0][6]:.3g}"
    )
    assert len(shown.scene.points) == 1
    assert shown.scene.answer == 1


def test_the_map_of_groups_is_shown_too(panel, study):
    X, T = as_arrays(study["registration"].to_dataset())
    size = np.linspace(-1, 1, len(X))
    p = dataset(p_family_wise=np.where(size > 0, 0.01, np.nan), p_value=0.2)
    shown = panel(p.merge(dataset(effect=size[:, None] * vertex_normals(X, T))))
    np.testing.assert_allclose(shown.values()[0], size, atol=1e-12)
    assert (shown.scene.colors[size <= 0] == GREY).all()  # without a p value it is not significant
    assert shown.map.label == "effect, along the normals"
    np.testing.assert_array_equal(shown.scene.surface[0], X)


def test_a_result_without_maps_or_of_another_template_is_refused(panel, study, result):
    for values, words in {
        "none": (result[["p_value"]], "found p_value at no vertices: give the result"),
        "other": (result.isel(vertex=slice(10)), "at the 1500 vertices of the template; .* at 10"),
    }.values():
        with pytest.raises(ValueError, match=words):
            Maps(study, values)


def test_a_saved_page_has_every_choice(panel, tmp_path, caplog):
    shown = panel()
    with caplog.at_level(logging.WARNING):
        page = shown.save_html(tmp_path / "map.html").read_text(encoding="utf-8")
    for words in ("effect size", "effect, along the normals", "family-wise"):
        assert words in page


def test_saving_a_page_keeps_the_clicked_vertex(panel, tmp_path):
    shown = panel()
    shown.scene.picked = {"vertex": 7, "count": 1}
    before = shown.scene.points, shown.scene.caption
    text = shown.save_html(tmp_path / "page.html").read_text(encoding="utf-8")
    assert (shown.scene.points, shown.scene.caption) == before
    assert shown.vertex == 7
    assert "vertex 7: " in text
