"""The panel of maps, without a browser."""

import logging

import numpy as np
import pytest

pytest.importorskip("anywidget")
from ipywidgets.widgets import widget as registry  # the open widgets are counted in it

from s4a import statistics
from s4a.geometry.mesh import as_arrays, vertex_areas, vertex_normals
from s4a.schema import dataset
from s4a.show.draw import signed_colors
from s4a.widgets import Maps
from s4a.widgets.maps import GREY


@pytest.fixture(scope="module")
def found(study):
    """A regression, with p values that are given: small on a third of the vertices."""
    found = statistics.regression(study, [3, 1, 4, 2], of="normal", n_permutations=15)
    p = np.where(np.arange(found.sizes["vertex"]) % 3, 0.4, 0.02)
    return found.assign(p_family_wise=found["p_family_wise"].copy(data=p))


@pytest.fixture
def panel(study, found):
    before, made = len(registry._instances), []

    def make(result=found, **options):
        made.append(Maps(study, result, **options))
        return made[-1]

    yield make
    for one in made:
        one.close()
    assert len(registry._instances) == before


def test_it_is_grey_where_nothing_is_significant_and_says_how_much_is(panel, found, study):
    one = panel()
    significant = found["p_family_wise"].values <= 0.05
    X, T = as_arrays(study["registration"].to_dataset())
    values = (found["effect"].values * vertex_normals(X, T)).sum(1)
    limit = np.quantile(abs(values), 0.99)
    assert (one.scene.colors[~significant] == GREY).all()
    expected = np.clip(signed_colors(values, limit), 0, 1)
    np.testing.assert_allclose(one.scene.colors[significant], expected[significant], atol=1e-6)
    area = vertex_areas(X, T)
    share = 100 * area[significant].sum() / area.sum()
    assert f"{share:.1f} % of the area at p ≤ 0.05 (family-wise), smallest p 0.02" in (
        one.scene.caption
    )
    one.level.value = 0.01
    assert (one.scene.colors == GREY).all()
    assert one.scene.caption.startswith("0.0 % of the area")
    one.where.value = "everywhere"
    assert not (one.scene.colors == GREY).all(1).any()


def test_a_click_tells_the_values_there(panel, found):
    one = panel()
    one.scene.picked = {"vertex": 6, "count": 1}
    assert one.scene.caption.startswith(
        f"vertex 6: effect, along the normals {one.values()[0][6]:.3g}"
    )
    assert len(one.scene.points) == 1
    assert one.scene.answer == 1


def test_the_map_of_groups_is_shown_too(panel, study):
    X, T = as_arrays(study["registration"].to_dataset())
    size = np.linspace(-1, 1, len(X))
    p = dataset(p_family_wise=np.where(size > 0, 0.01, np.nan), p_value=0.2)
    one = panel(p.merge(dataset(effect=size[:, None] * vertex_normals(X, T))))
    np.testing.assert_allclose(one.values()[0], size, atol=1e-12)
    assert (one.scene.colors[size <= 0] == GREY).all()  # without a p value it is not significant
    assert one.map.label == "effect, along the normals"
    np.testing.assert_array_equal(one.scene.surface[0], X)


def test_a_result_without_maps_or_of_another_template_is_refused(panel, study, found):
    for result, words in {
        "none": (found[["p_value"]], "found p_value at no vertices: give the result"),
        "other": (found.isel(vertex=slice(10)), "at the 1500 vertices of the template; .* at 10"),
    }.values():
        with pytest.raises(ValueError, match=words):
            Maps(study, result)


def test_a_saved_page_has_every_choice(panel, tmp_path, caplog):
    one = panel()
    with caplog.at_level(logging.WARNING):
        page = one.save_html(tmp_path / "map.html").read_text(encoding="utf-8")
    for words in ("effect size", "effect, along the normals", "family-wise"):
        assert words in page


def test_a_saved_page_leaves_the_vertex_that_was_clicked(panel, tmp_path):
    one = panel()
    one.scene.picked = {"vertex": 7, "count": 1}
    before = one.scene.points, one.scene.caption
    text = one.save_html(tmp_path / "page.html").read_text(encoding="utf-8")
    assert (one.scene.points, one.scene.caption) == before
    assert one.vertex == 7
    assert "vertex 7: " in text
