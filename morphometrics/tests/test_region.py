"""The panel in which a region of the template is drawn, without a browser and in one."""

import numpy as np
import pytest

pytest.importorskip("anywidget")

import s4a
from s4a.geometry.mesh import as_arrays
from s4a.show.draw import rotation, vertices_within
from s4a_morphometrics import Region
from s4a_morphometrics import within as within_region
from s4a_morphometrics.region_panel import ADD, REMOVE

WIDE = [[-9e3, -9e3], [9e3, -9e3], [9e3, 9e3], [-9e3, 9e3]]


@pytest.fixture
def panel(study):
    one = Region(study)
    yield one
    one.close()


def draw(panel, polygon, view):
    """What a drag sends."""
    count = panel.scene.drawn_around.get("count", 0) + 1
    rows = rotation(view).ravel().tolist()
    panel.scene.drawn_around = {"polygon": polygon, "rotation": rows, "count": count}


@pytest.mark.parametrize("n", [2000, 60_000])
def test_the_near_side_of_two_plates_is_taken_and_the_wall_behind_is_not(n):
    X, T = as_arrays(s4a.synthetic.ellipsoid(n, (1, 1, 0.02)))
    behind = X - [0, 0, 0.5]
    both, triangles = np.concatenate([X, behind]), np.concatenate([T, T + len(X)])
    square = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    found = vertices_within(both, triangles, square, np.eye(3))
    expected = (abs(X[:, :2]) < 0.5).all(1) & (X[:, 2] > 0)
    assert (found[: len(X)] == expected).mean() > 0.999
    assert not found[len(X) :].any()


def test_drags_add_and_take_away_and_the_region_goes_into_statistics(panel, study):
    assert not panel.region.any()
    panel.lasso.value = True
    assert panel.scene.lasso
    draw(panel, WIDE, "top")
    above = panel.region.copy()
    draw(panel, WIDE, "bottom")
    assert panel.region.sum() > above.sum()
    panel.action.value = REMOVE
    draw(panel, WIDE, "bottom")
    left = panel.region
    assert 0 < left.sum() <= above.sum()
    assert f"{left.sum():,} of" in panel.scene.caption
    within = within_region(study, left)
    assert within["registration"].sizes["vertex"] <= left.sum()
    panel.others.click()
    np.testing.assert_array_equal(panel.region, ~left)
    panel.none.click()
    assert not panel.region.any()


def test_a_drag_beside_the_surface_says_so_and_changes_nothing(panel):
    draw(panel, WIDE, "top")
    before = panel.region.copy()
    draw(panel, [[8e3, 8e3], [9e3, 8e3], [9e3, 9e3]], "top")
    assert "no visible vertex" in panel.message.value
    np.testing.assert_array_equal(panel.region, before)
    panel.action.value = ADD
    draw(panel, WIDE, "top")
    assert panel.message.value == ""


def test_a_label_of_the_template_is_a_region(panel, study):
    label = study["original"][study["registration"].attrs["template"]]["label"].values
    name, number = panel.label.options[2]
    assert panel.label.label == panel.label.options[0][0] == "none"
    assert name == f"{number} {s4a.synthetic.LABELS[number]}"
    panel.label.value = number
    np.testing.assert_array_equal(panel.region, label == number)


def test_the_list_says_the_label_only_while_the_region_is_that_label(panel):
    number = panel.label.options[2][1]
    leave = (panel.none.click, panel.others.click, lambda: draw(panel, WIDE, "top"))
    for act in leave:
        panel.label.value = number
        chosen = panel.region
        act()
        assert panel.label.label == "none"
        panel.label.value = number
        np.testing.assert_array_equal(panel.region, chosen)


@pytest.mark.parametrize("kind", [int, str])
def test_a_label_of_any_value_is_another_than_none(study, kind):
    tree = study.copy()
    node = tree["original"][study["registration"].attrs["template"]]
    label = np.where(node["label"].values == node["label"].values[0], -1, 5).astype(kind)
    node.dataset = node.to_dataset().assign(label=("vertex", label))
    panel = Region(tree)
    assert panel.label.label == "none"
    panel.label.value = kind(-1)
    np.testing.assert_array_equal(panel.region, label == kind(-1))
    assert panel.region.any()
    panel.close()
