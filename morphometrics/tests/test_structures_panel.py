"""The panel of several structures, without a browser."""

import numpy as np
import pytest

pytest.importorskip("anywidget")
from ipywidgets.widgets import widget as registry

import s4a
from s4a.widgets import Explore, Structures
from s4a_morphometrics.synthetic import example_structures


@pytest.fixture(scope="module")
def several():
    return example_structures()


@pytest.fixture
def panel(several):
    """The panel, of which nothing is left after the test."""
    before = len(registry._instances)
    found = s4a.statistics.structures(several, n_permutations=9)
    made = Structures(several, found=found)
    yield made
    made.close()
    assert len(registry._instances) == before


def test_each_level_has_its_sliders_and_one_is_shown(panel, several):
    assert list(panel.views) == ["joint", "between", "within"]
    for level in panel.views:
        panel.level.value = level
        shown = [one for one, view in panel.views.items() if view.layout.display != "none"]
        assert shown == [level]
        of_level = s4a.statistics.structures_modes(several, panel.found, level)
        panel.scores = [2.0, -1.0, 0, 0, 0]
        expected = s4a.synthesize(of_level, [2.0, -1.0])["position"].values
        np.testing.assert_allclose(panel.vertices(), expected, atol=1e-4)
    assert "% of the variance" in panel.level.options[1][0]


def test_a_structure_that_is_not_seen_is_not_drawn(panel):
    view = panel.views["joint"]
    whole = np.frombuffer(view.corner, "<u4").reshape(-1, 3)
    panel.seen["left"].value = False
    rest = np.frombuffer(view.corner, "<u4").reshape(-1, 3)
    assert 0 < len(rest) < len(whole)
    of = panel.found["structure_of_vertex"].values
    assert (of[rest] == 1).all()
    panel.seen["right"].value = False
    assert "tick at least one structure" in panel.message.value


def test_each_structure_has_the_colour_that_is_picked(panel):
    panel.colors["right"].value = "#00ff00"
    own = np.frombuffer(panel.views["within"].own, np.uint8).reshape(-1, 3)
    of = panel.found["structure_of_vertex"].values
    assert (own[of == 1] == [0, 255, 0]).all()
    assert (own[of == 0] == [0x44, 0x77, 0xAA]).all()


def test_without_webgl_the_structures_are_drawn_in_their_colours(panel):
    view = panel.views["joint"]
    view.webgl = "no"
    still = view.still
    assert still[1:4] == b"PNG"
    panel.colors["left"].value = "#000000"
    assert view.still != still


def test_a_page_of_it_has_all_levels(panel, tmp_path):
    text = panel.save_html(tmp_path / "structures.html").read_text(encoding="utf-8")
    assert "within structures: shapes" in text
    assert text.count('"deformation"') >= 3


def test_a_study_of_several_structures_has_a_tab_of_its_own(several):
    tabs = Explore(several)
    assert tabs.tabs.titles == ("Structures",)
    assert isinstance(tabs["Structures"], Structures)
    tabs.close()


def test_a_page_shows_the_colour_of_a_structure_and_not_its_number(panel):
    page = s4a.show.panel_page.panel_html(panel, 2_000_000)
    assert "background:#4477aa" in page
    assert "<b>#4477aa</b>" not in page
