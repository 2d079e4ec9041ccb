"""The panels other than the tabs, in a real JupyterLab: as wide as their cells, and clicked.

Also as pages without a kernel.
"""

import re

import numpy as np
import pytest
from browsing import (
    DRAWN,
    IDLE,
    THEMES,
    VIEW,
    barriers,
    check_read,
    check_themes,
    lay_out,
    needed,
    notebooks,
    pixels,
    redrawn,
    run_notebook,
    serious,
    settled,
    visible,
    watched,
)

import s4a
from s4a.show import charts
from s4a.widgets import Median, Modes
from s4a_morphometrics import open_structures
from s4a_morphometrics.region_panel import Region
from s4a_morphometrics.structures_panel import Structures

pytestmark = needed
KINDS = ("Maps", "Region", "Structures", "Comparison", "Progress")
CELL = """
import ipywidgets
import numpy as np
from IPython.display import display

import s4a
from s4a_morphometrics.region_panel import Region
from s4a_morphometrics.structures_panel import Structures
from s4a_morphometrics import open_structures
from s4a.widgets import Comparison, Maps, Progress

study = s4a.open_study({study!r})
found = s4a.statistics.regression(study, range(4), of="normal", n_permutations=15)
p = np.where(np.arange(found.sizes["vertex"]) % 3, 0.4, 0.02)
found = found.assign(p_family_wise=found["p_family_wise"].copy(data=p))
several = open_structures({several!r}).load()
ball = s4a.synthetic.ellipsoid(300)
compared = s4a.compare(ball, ball, methods=["kNN"], keep=True)
brains = s4a.synthetic.brains(3, 300, seed=1)
make = {{
    "Maps": lambda: Maps(study, found),
    "Region": lambda: Region(study, view="top"),
    "Structures": lambda: Structures(several),
    "Comparison": lambda: Comparison(compared),
    "Progress": lambda: Progress(brains, {run!r}, n_coarse=100, k=10, k_init=6, n_jobs=1),
}}
for kind in {kinds!r}:
    for width in ("360px", "100%"):
        display(ipywidgets.VBox([make[kind]()], layout={{"width": width}}))
"""


@pytest.fixture(scope="module")
def folder(study_folder, structures_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("panels")
    named = {"study": str(study_folder), "several": str(structures_folder)}
    source = CELL.format(**named, run=str(folder / "run"), kinds=KINDS)
    return notebooks(folder, panels=[source])


@pytest.fixture(scope="module")
def page(browser, lab, messages):
    """A notebook with every panel, in a cell of 360 pixels and in a wide one."""
    page = watched(browser.new_page(viewport={"width": 1920, "height": 1080}), messages)
    page.set_default_timeout(60_000)
    run_notebook(page, lab, "panels.ipynb")
    page.keyboard.press("Control+b")  # hide the files next to the notebook
    n = 2 * len(KINDS)
    page.wait_for_function(f"document.querySelectorAll('.s4a-panel').length === {n}", timeout=2e5)
    page.wait_for_function(IDLE)
    page.wait_for_function(DRAWN)
    yield page
    page.close()


def panel_of(page, kind, *, wide):
    """A panel, where it is seen."""
    panel = page.locator(".s4a-panel").nth(2 * KINDS.index(kind) + wide)
    panel.scroll_into_view_if_needed()
    return panel


def views(panel):
    return panel.locator(VIEW).filter(visible=True)


@pytest.mark.parametrize("kind", KINDS)
def test_a_panel_is_read_and_uncut_in_a_cell_of_360_pixels_and_from_afar(page, kind):
    panel = panel_of(page, kind, wide=False)
    check_read(panel, 11, width=360)
    assert (views(panel).count() == 0) == (kind == "Progress")
    right = panel.bounding_box()["x"] + panel.bounding_box()["width"]
    for part in panel.locator("input, select, button, progress, .progress").all():
        if part.is_visible():
            assert part.bounding_box()["x"] + part.bounding_box()["width"] <= right + 1
    check_read(panel_of(page, kind, wide=True), 16)


# controls whose tooltip is missing, is their name again, or is that of another one
UNSAID = """(panel) => {
  const controls = [...panel.querySelectorAll('input, select, button, [role=slider]')];
  const told = new Map();
  return controls.filter((c) => c.getClientRects().length).filter((c) => {
    const text = c.closest('[title]')?.title, name = c.labels?.[0]?.textContent.trim();
    const again = told.has(text);
    told.set(text, c);
    return !text || text === name || again;
  }).map((c) => c.outerHTML);
}"""


def test_every_panel_is_a_landmark_and_every_control_has_its_own_name_and_tooltip(page):
    for kind in KINDS:
        panel = panel_of(page, kind, wide=True)
        assert panel.get_attribute("role") == "region", kind
        assert panel.evaluate(UNSAID) == [], kind


@pytest.mark.parametrize("theme", THEMES)
def test_every_text_of_every_panel_is_read_in_every_theme(page, theme):
    panels = {kind: lambda kind=kind: panel_of(page, kind, wide=True) for kind in KINDS}
    check_themes(page, theme, panels, 5)


def test_a_level_makes_the_map_grey_and_a_click_shows_the_values(page):
    panel = panel_of(page, "Maps", wide=True)
    canvas = views(panel).first
    before = pixels(canvas)
    panel.get_by_label("level").select_option("0.01")
    panel.locator(".s4a-readout").filter(has_text="0.0 % of the area").wait_for()
    assert pixels(canvas) != before
    box = canvas.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    said = panel.locator(".s4a-readout").filter(has_text="effect, along the normals")
    said.wait_for()
    assert re.match(r"vertex \d+: effect, along the normals .*; p = ", said.inner_text())


def test_the_controls_of_a_region_stand_in_one_row_of_a_wide_screen(page):
    panel = panel_of(page, "Region", wide=True)
    controls = panel.locator("select, .jupyter-button").all()
    assert len(controls) == 5
    middles = [c.bounding_box()["y"] + c.bounding_box()["height"] / 2 for c in controls]
    assert np.ptp(middles) < 10


def test_structures_are_hidden_and_coloured_and_their_poses_moved(page):
    panel = panel_of(page, "Structures", wide=True)
    before = pixels(views(panel).first)
    panel.get_by_label("right", exact=True).uncheck()
    hidden = redrawn(views(panel).first, before)
    panel.get_by_label("colour of left").evaluate(
        "(i) => { i.value = '#00ff00'; i.dispatchEvent(new Event('change', { bubbles: true })); }"
    )
    coloured = redrawn(views(panel).first, hidden)
    panel.get_by_label("modes", exact=True).select_option(index=1)
    still = redrawn(views(panel).first, coloured)
    assert views(panel).count() == 1
    slider = panel.locator(".s4a-slider input").filter(visible=True).first
    slider.focus()
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    redrawn(views(panel).first, still)


def test_the_console_has_no_errors(page, messages):
    assert serious(messages) == []


# ---- without a kernel


def test_the_page_of_structures_has_every_level_and_no_control_that_does_nothing(
    show, structures_folder
):
    page = show(Structures(open_structures(structures_folder).load()))
    assert page.get_by_text("#4477aa").count() == 0
    before = np.array(visible(page, VIEW).first.evaluate("(c) => [...c.view.surfaces[0].position]"))
    for level in (1, 2):
        page.locator("#c-level").select_option(index=level)
        page.wait_for_function(DRAWN)
        slider = visible(page, ".s4a-slider input").first
        slider.evaluate("(i) => { i.value = 2; i.dispatchEvent(new Event('input')); }")
        moved = visible(page, VIEW).first.evaluate("(c) => [...c.view.surfaces[0].position]")
        assert np.abs(np.array(moved) - before).max() > 0.5
    assert barriers(page) == []


def test_the_page_of_a_region_says_that_drawing_needs_python(show, study):
    page = show(Region(study))
    assert "drawing a region" in page.locator(".note:not(#not-recorded)").inner_text()
    assert page.get_by_text("lasso").count() == 0
    assert barriers(page) == []


def test_the_numbers_of_bars_are_not_cut_in_a_narrow_panel(show, study):
    page = show(Median(study))
    svg = visible(page, "svg.s4a-chart").first

    def uncut():
        right = svg.bounding_box()["x"] + svg.bounding_box()["width"]
        ends = [box["x"] + box["width"] for box in boxes_of(svg.locator("rect ~ text"))]
        assert len(ends) >= 4
        assert max(ends) <= right

    for width in (380, 700):
        page.set_viewport_size({"width": width, "height": 900})
        lay_out(page)
        settled(page, uncut)
        numbers = [text for text in svg.locator("rect ~ text").all_text_contents() if "." in text]
        assert len({len(text.partition(".")[2]) for text in numbers}) == 1, numbers


def boxes_of(locator):
    return [one.bounding_box() for one in locator.all()]


def test_no_name_of_a_shape_lies_under_the_cross_of_the_sliders(show, study):
    tree = study.copy()
    pca = tree["pca"].to_dataset()
    score = pca["score"].values.copy()
    score[0, :2] = [-0.3, -0.15]  # its name would reach over the mean
    tree["pca"].dataset = pca.assign(score=(pca["score"].dims, score, pca["score"].attrs))
    page = show(Modes(tree))
    page.locator(".s4a-cross").wait_for(state="visible")
    cross = page.locator(".s4a-cross").bounding_box()
    names = boxes_of(page.locator(".s4a-cross").locator("xpath=..").locator("text.s4a-small"))
    assert len(names) >= 2
    for name in names:
        beside = name["x"] > cross["x"] + cross["width"] or name["x"] + name["width"] < cross["x"]
        above = name["y"] + name["height"] < cross["y"] + 3
        assert beside or above or name["y"] > cross["y"] + cross["height"] - 3


def test_pictures_side_by_side_are_of_one_size_however_many_lines_they_take(show, tmp_path):
    ball = s4a.synthetic.sphere(100)
    titles = ["one", "two", "three", "four"]
    heights = dict.fromkeys(titles, ball["position"].values[:, 2])
    html = charts.surfaces(dict.fromkeys(titles, ball), heights, label="height").html()
    (tmp_path / "parts.html").write_text(f"<body>{html}</body>", encoding="utf-8")
    page = show(tmp_path / "parts.html", drawn=False)
    lines, shares = [], []
    for width in (2000, 1000, 640, 330):
        page.set_viewport_size({"width": width, "height": 900})
        *pictures, scale = boxes_of(page.locator("img"))
        widths = [picture["width"] for picture in pictures]
        assert max(widths) - min(widths) < 2
        assert max(widths) <= width - 16
        shares.append(scale["height"] / pictures[-1]["height"])
        lines.append(len({round(picture["y"]) for picture in pictures}))
    assert lines == [1, 1, 2, 4]
    assert shares == pytest.approx([shares[0]] * 4, rel=0.02), "of one scale"
