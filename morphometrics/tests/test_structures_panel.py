"""The panel of multi-structure studies, without a browser."""

import numpy as np
import pytest

pytest.importorskip("anywidget")
from ipywidgets.widgets import widget as registry

import s4a
from s4a.widgets import Explore
from s4a_morphometrics import structures, structures_modes
from s4a_morphometrics.structures_panel import Structures


@pytest.fixture
def panel(several):
    """The panel; all its widgets are closed after the test."""
    before = len(registry._instances)
    made = Structures(several, result=structures(several, n_permutations=9))
    yield made
    made.close()
    assert len(registry._instances) == before


def test_each_level_has_its_sliders_and_one_is_shown(panel, several):
    assert list(panel.views) == ["joint", "between", "within"]
    for level in panel.views:
        panel.level.value = level
        shown = [one for one, view in panel.views.items() if view.layout.display != "none"]
        assert shown == [level]
        level_study = structures_modes(several, panel.result, level)
        panel.scores = [2.0, -1.0, 0, 0, 0]
        expected = s4a.synthesize(level_study, [2.0, -1.0])["position"].values
        np.testing.assert_allclose(panel.vertices(), expected, atol=1e-4)
    assert "% of the variance" in panel.level.options[1][0]


def test_structures_are_hidden_and_coloured(panel):
    structure = panel.result["structure_of_vertex"].values
    view = panel.views["joint"]
    panel.colors["right"].value = "#00ff00"
    own = np.frombuffer(view.own, np.uint8).reshape(-1, 3)
    assert (own[structure == 1] == [0, 255, 0]).all()
    assert (own[structure == 0] == [0x44, 0x77, 0xAA]).all()
    view.webgl = "no"
    still = view.still
    panel.colors["left"].value = "#000000"
    assert still[1:4] == b"PNG"
    assert view.still != still
    panel.visible["left"].value = False
    rest = np.frombuffer(view.corner, "<u4").reshape(-1, 3)
    assert len(rest)
    assert (structure[rest] == 1).all()
    panel.visible["right"].value = False
    assert "tick at least one structure" in panel.message.value


def test_a_page_has_all_levels_and_shows_colours(panel, tmp_path):
    text = panel.save_html(tmp_path / "structures.html").read_text(encoding="utf-8")
    assert "within structures: shapes" in text
    assert text.count('"deformation"') >= 3
    assert "background:#4477aa" in text
    assert "<b>#4477aa</b>" not in text


def test_a_study_of_several_structures_has_a_tab_of_its_own(several):
    tabs = Explore(several)
    assert tabs.tabs.titles == ("Structures",)
    assert isinstance(tabs["Structures"], Structures)
    tabs.close()
