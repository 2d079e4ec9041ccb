"""The main notebook in a real JupyterLab, driven in Chromium: what is seen and clicked.

Pages without a kernel.
"""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from browsing import (
    DRAWN,
    IDLE,
    SEEN,
    SMALLEST,
    STILLS,
    THEMES,
    TITLES,
    VIEW,
    barriers,
    check_read,
    check_themes,
    chosen,
    contrasts,
    cursor,
    faint,
    lay_out,
    move,
    needed,
    notebooks,
    open_tab,
    pixels,
    run_notebook,
    serious,
    settled,
    vertices,
    visible,
    watched,
)
from paths import NOTEBOOKS
from small import small_pictures

import s4a
from s4a.show import panel_page
from s4a.show.draw import vertices_within
from s4a_morphometrics.region_panel import Region

pytest.importorskip("playwright.sync_api")
pytest.importorskip("jupyterlab")
widgets = pytest.importorskip("s4a.widgets")

pytestmark = needed
NOTEBOOK = NOTEBOOKS / "00_explore.ipynb"


PROGRESS = """
import s4a
from s4a.widgets import Progress

Progress(s4a.synthetic.brains(5, 8000, seed=1), {store!r}, n_coarse=300, k=12, k_init=6, n_jobs=1)
"""


SIZES = """
from IPython.display import display

for options in ({"width": 360}, {"width": 1000}, {"font": 20}, {}):
    tabs = study.s4a.explore(**options)
    panel, name = tabs["Transfer"], "radius (unit of the input)"  # where none is known
    panel.radius.description, panel.frame.help = name, {**panel.frame.help, name: "of the spheres"}
    tabs["Modes"]
    display(tabs)
"""
# every message to and from the kernel takes a quarter of a second; counted are those to it
DELAYED = """
const Real = WebSocket;
window.sent = [];
window.WebSocket = class extends Real {
  send(data) {
    const text = typeof data === "string" ? data : new TextDecoder().decode(data);
    window.sent.push(text);
    setTimeout(() => super.send(data), 250);
  }
  set onmessage(act) { super.onmessage = (event) => setTimeout(() => act(event), 250); }
};
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    options = {"n_coarse": 500, "k": 24, "k_init": 10, "n_jobs": 1}
    options["template"] = "brain_01"  # in the pair that is shown first
    return s4a.analyse(s4a.synthetic.brains(5, 2000, seed=1), store=folder, **options)


@pytest.fixture(scope="module")
def folder(study, tmp_path_factory):
    """A folder with the main notebook, in which this study takes the place of the analysis."""
    folder = tmp_path_factory.mktemp("lab")
    store = Path(study["coarse/brain_01"].to_dataset().encoding["source"]).parent.parent
    opened = f"import s4a\n\nstudy = s4a.open_study({str(store)!r})"
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    cell = next(c for c in notebook["cells"] if "s4a.analyse" in "".join(c["source"]))
    cell["source"] = opened
    (folder / NOTEBOOK.name).write_text(json.dumps(notebook), encoding="utf-8")
    small, sizes = f"{opened}\nstudy.s4a.explore()", f"{opened}\n{SIZES}"
    run = PROGRESS.format(store=str(folder / "run"))
    return notebooks(folder, small=[small], sizes=[sizes], progress=[run])


@pytest.fixture(scope="module")
def page(browser, lab, messages):
    """The notebook, after all of its cells ran."""
    page = watched(browser.new_page(viewport={"width": 1280, "height": 1300}), messages)
    page.set_default_timeout(60_000)
    run_notebook(page, lab, NOTEBOOK.name)
    page.wait_for_function(DRAWN, timeout=120_000)
    page.wait_for_function(IDLE)
    return page


def check_sliders(page, study):
    """Every slider moves the shape to mean + sum of score times deformation.

    And other pixels are seen.
    """
    canvas, sliders = visible(page, VIEW).first, visible(page, ".s4a-slider input")
    pca = study["pca"].dataset
    mean = study["registration"]["position"].values + pca["mean_displacement"].values
    scores = np.zeros(pca.sizes["component"])
    assert sliders.count() == len(scores)
    for mode in range(len(scores)):
        move(sliders.nth(mode), 0)
    for mode in range(len(scores)):
        before = pixels(canvas)
        scores[mode] = 2.5 - mode
        move(sliders.nth(mode), scores[mode])
        expected = mean + np.tensordot(scores, pca["deformation"].values, axes=1)
        np.testing.assert_allclose(
            vertices(canvas), expected, rtol=0, atol=4e-7 * np.abs(expected).max()
        )
        assert pixels(canvas) != before
    return scores


def test_every_slider_moves_the_shape_along_its_mode(page, study):
    scores = check_sliders(page, study)
    visible(page, ".s4a-readout").filter(
        has_text=f"Mahalanobis distance {np.linalg.norm(scores):.2f}"
    ).wait_for()


def test_arrow_keys_move_a_slider_and_not_the_notebook(page):
    slider = visible(page, ".s4a-slider input").first
    move(slider, 0)
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert float(slider.input_value()) == pytest.approx(0.05)
    assert slider.evaluate("(i) => document.activeElement === i")


def test_a_clicked_sample_gives_its_scores(page, study):
    visible(page, "circle.s4a-mark").nth(2).click(force=True)
    score = study["pca"]["score"].values[2]
    shown = visible(page, ".s4a-slider output").all_inner_texts()
    assert shown == [f"{'−' if s < 0 else '+'}{abs(s):.2f} σ" for s in score]


def test_both_ends_of_a_mode_side_by_side(page):
    button = page.get_by_role("button", name="−3 · mean · +3")
    button.click()
    assert visible(page, VIEW).count() == 3
    page.wait_for_function(
        f"[...document.querySelectorAll('{VIEW}')].every((c) => !c.offsetParent || c.view.frames)"
    )
    shown = visible(page, VIEW)
    assert len({pixels(shown.nth(i)) for i in range(3)}) == 3
    rotation = "(c) => [...c.view.camera.rotation]"
    turned = shown.nth(2).evaluate(rotation)
    shown.nth(0).focus()
    page.keyboard.press("ArrowLeft")
    assert shown.nth(2).evaluate(rotation) != turned, "cameras are linked"
    button.click()


def test_a_clicked_edge_shows_its_map(page, study):
    open_tab(page, "Network")
    edge = visible(page, ".s4a-edge").nth(6)
    source, target = re.match(r"(\w+) → (\w+)", edge.get_attribute("aria-label")).groups()
    edge.dispatch_event("click")
    visible(page, ".s4a-title").filter(has_text=f"{source} → {target}").wait_for()
    visible(page, ".s4a-title").filter(has_text=f"{target}, the target").wait_for()
    net = study["network"].dataset
    own = (net["source"].values == source) & (net["target"].values == target)
    C = net["fmap_initial"].values[own][0]
    matrix = visible(page, ".s4a-matrix canvas").first
    matrix.scroll_into_view_if_needed()
    box = matrix.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 3.5 / len(C), box["y"] + box["height"] * 2.5 / len(C))
    text = visible(page, ".s4a-readout").filter(has_text="C[2, 3]").inner_text()
    assert float(re.search(r"= (\S+)", text)[1]) == pytest.approx(C[2, 3], rel=6e-3)
    open_tab(page, "Functional map")
    visible(page, ".s4a-title").filter(has_text=f"φ1 on {source}").wait_for()
    visible(page, ".s4a-title").filter(has_text=f"ψ1 on {target}").wait_for()
    open_tab(page, "Correspondence")
    for name in (source, target):
        visible(page, ".s4a-title").filter(has_text=re.compile(f"^{name},")).wait_for()


def test_a_landmark_is_placed_and_transferred(page, study):
    open_tab(page, "Transfer")
    canvas = visible(page, VIEW).first
    box, count = canvas.bounding_box(), study["original/brain_01"].sizes["landmark"]
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    visible(page, "td").filter(has_text=f"landmark {count + 1}").wait_for()
    assert visible(page, VIEW).nth(1).evaluate("(c) => c.view.points.length") == count + 1


def test_the_keyboard_places_a_landmark(page, study):
    canvas = visible(page, VIEW).first
    count = canvas.evaluate("(c) => c.view.points.length")
    start, moved = cursor(canvas), cursor(canvas, *["ArrowRight"] * 4)
    X = vertices(canvas)
    right = canvas.evaluate("(c) => c.view.camera.rotation.slice(0, 3)")
    assert (X[moved] - X[start]) @ right > 0.05 * np.ptp(X, axis=0).max(), (
        "the arrow keys move the cursor"
    )
    canvas.press("Enter")
    visible(page, "td").filter(has_text=f"landmark {count + 1}").wait_for()
    placed = np.array(canvas.evaluate("(c) => c.view.points.at(-1)"))
    np.testing.assert_allclose(placed[:3], X[moved], rtol=1e-4, atol=1e-3)
    canvas.press("Escape")
    assert canvas.evaluate("(c) => c.view.cursor") == -1


def test_a_landmark_is_a_lit_sphere_of_its_radius_in_the_datas_unit(page):
    canvas = visible(page, VIEW).first
    before, radius = pixels(canvas), canvas.evaluate("(c) => c.view.points[0][6]")
    field = visible(page, ".widget-text input[type=number]").first
    field.fill(str(2 * radius))
    field.press("Enter")
    page.wait_for_function(
        f"(r) => {SEEN}.some((view) => view.points[0]?.[6] === r)", arg=2 * radius
    )
    assert pixels(canvas) != before


def test_the_keyboard_maps_points_to_the_shape(page, study):
    open_tab(page, "Correspondence")
    canvas = visible(page, VIEW).first
    at = cursor(canvas, "ArrowUp", "ArrowUp")
    readout = visible(page, ".s4a-readout").filter(has_text=f"template vertex {at} ").first
    readout.wait_for()
    shape, image = re.search(r"↔ (\w+) vertex (\d+)", readout.inner_text()).groups()
    assert study["registration"]["registered_match"].sel(shape=shape).values[at] == int(image)
    canvas.press("Escape")


def test_marks_and_captions_of_the_previous_shape_are_removed(page):
    shapes = page.get_by_label("shape", exact=True).filter(visible=True)
    *_, one, other = shapes.locator("option").all_inner_texts()
    canvas, said = visible(page, VIEW).first, visible(page, ".s4a-readout")
    marks = f"{SEEN}.map((view) => view.points.length).join()"
    for name in (one, other):
        shapes.select_option(name)
        said.filter(has_text="transferred to the shape").nth(1).wait_for()
        page.wait_for_function(f"{marks} === '0,0'")
        cursor(canvas, "ArrowUp")
        said.filter(has_text=f"↔ {name} vertex").nth(1).wait_for()
    canvas.press("Escape")


def test_the_checkerboard_is_drawn(page):
    canvas = visible(page, VIEW).nth(1)
    before = pixels(canvas)
    visible(page, "select").filter(has_text="checkerboard").select_option("checkerboard")
    page.wait_for_function(f"{SEEN}.every((view) => view.surfaces[0].cell > 0)")
    assert pixels(canvas) != before


def test_whatever_can_be_clicked_has_a_name_and_is_reached_by_the_keyboard(page):
    for title in ("Correspondence", "Network", "Modes"):
        open_tab(page, title)
        for canvas in visible(page, VIEW).all():
            assert canvas.get_attribute("tabindex") == "0"
            assert "arrow keys rotate" in canvas.get_attribute("aria-label")
        unnamed = page.evaluate(
            "[...document.querySelectorAll("
            "'.s4a input, .s4a select, .s4a button, .s4a [role=button]')]"
            ".filter((e) => e.offsetParent)"
            ".filter((e) => !(e.ariaLabel || e.textContent.trim() || e.labels?.length)).length"
        )
        assert unnamed == 0
    visible(page, ".s4a-slider input").first.focus()
    page.keyboard.press("Tab")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid", (
        "focus is seen"
    )


def test_nothing_scrolls_sideways_and_charts_are_visible_next_to_the_files(page):
    """On a screen of 1366 by 768 pixels, with the file browser open."""
    page.set_viewport_size({"width": 1366, "height": 768})
    wide = """() => [...document.querySelectorAll(".jp-Notebook, .jp-Notebook *")]
      .filter((e) => e.getClientRects().length && e.scrollWidth > e.clientWidth)
      .filter((e) => /auto|scroll/.test(getComputedStyle(e).overflowX)).map((e) => e.className)"""
    assert page.locator(".jp-FileBrowser").is_visible()
    for title in reversed(TITLES):
        open_tab(page, title)
        settled(page, lambda: page.evaluate(wide) == [])

    def seen_at_once():
        page.locator(".s4a-tabs").evaluate("(e) => e.scrollIntoView()")
        window = page.locator(".jp-WindowedPanel-outer").bounding_box()
        for part in (VIEW, ".s4a-slider", "svg.s4a-chart"):
            assert visible(page, part).count() > 0
            for one in visible(page, part).all():
                box = one.bounding_box()
                assert window["y"] <= box["y"]
                assert box["y"] + box["height"] <= window["y"] + window["height"], part

    settled(page, seen_at_once)


# ---- any width


@pytest.fixture(scope="module")
def sizes(browser, lab, messages):
    """A notebook with the tabs of 360 and 1,000 pixels, of a large text, and as wide as it is."""
    page = watched(browser.new_page(viewport={"width": 1920, "height": 1080}), messages)
    page.set_default_timeout(60_000)
    run_notebook(page, lab, "sizes.ipynb")
    page.keyboard.press("Control+b")  # hide the files next to the notebook
    page.wait_for_function(f"{SEEN}.length === 4 && {SEEN}.every((view) => view.frames > 0)")
    yield page
    page.close()


def tabs_of(page, i, title="Modes"):
    """The i-th tabs of a page, with a panel opened and drawn."""
    tabs = page.locator(".s4a-tabs").nth(i)
    tabs.locator(".lm-TabBar-tabLabel", has_text=title).click()
    tabs.locator(f".s4a-panel >> visible=true >> {VIEW} >> visible=true").first.wait_for()
    page.wait_for_function(DRAWN)
    lay_out(page)
    return tabs


def panel_of(tabs):
    return tabs.locator(".s4a-panel").filter(visible=True)


@pytest.mark.parametrize("title", TITLES)
def test_a_panel_is_read_and_uncut_in_a_cell_of_360_pixels_and_from_afar(sizes, title):
    tabs = tabs_of(sizes, 0, title)
    assert tabs.bounding_box()["width"] <= 360
    check_read(panel_of(tabs), 11, width=360)
    check_read(panel_of(tabs_of(sizes, 3, title)), 16)


def test_the_size_of_the_text_can_be_given(sizes):
    panel = panel_of(tabs_of(sizes, 2))
    assert panel.locator(".s4a-title").first.evaluate("(e) => getComputedStyle(e).fontSize") == (
        "20px"
    )


def test_a_panel_fills_the_screen(sizes):
    panel = panel_of(tabs_of(sizes, 1, "Median"))
    panel.get_by_role("button", name="Full screen").click()
    sizes.wait_for_function("document.fullscreenElement?.matches('.s4a-panel')")
    assert panel.bounding_box()["width"] == 1920
    assert panel.evaluate(SMALLEST)[0] >= 18
    panel.get_by_role("button", name="Leave full screen").click()
    sizes.wait_for_function("!document.fullscreenElement")
    assert panel.bounding_box()["width"] < 1000


def test_a_field_has_room_for_its_number_and_a_long_name(sizes):
    for i in (0, 1):
        field = panel_of(tabs_of(sizes, i, "Transfer")).locator("input[type=number]")
        assert field.bounding_box()["width"] > 60


# ---- one glance


def test_seven_tabs_are_in_one_row_of_1000_pixels(sizes):
    tabs = tabs_of(sizes, 1).locator(".lm-TabBar-tab")
    assert tabs.count() == 7
    assert len({tab.bounding_box()["y"] for tab in tabs.all()}) == 1
    for label in tabs.locator(".lm-TabBar-tabLabel").all():
        assert label.evaluate("(e) => e.scrollWidth <= e.clientWidth + 1"), label.inner_text()


@pytest.mark.parametrize("title", ["Network", "Functional map"])
def test_graph_matrix_and_both_surfaces_are_seen_at_once(sizes, title):
    sizes.set_viewport_size({"width": 1366, "height": 680})
    panel = panel_of(tabs_of(sizes, 3, title))
    if title == "Network":
        panel.locator(".s4a-edge").nth(6).dispatch_event("click")
        panel.locator(".s4a-title", has_text="the target").wait_for()

    def seen_at_once():
        assert panel.locator(VIEW).filter(visible=True).count() == 2
        assert panel.locator(".s4a-matrix").is_visible()
        box = panel.bounding_box()
        assert box["width"] <= 1366
        assert box["height"] <= 680

    settled(sizes, seen_at_once)
    sizes.set_viewport_size({"width": 1920, "height": 1080})


def test_both_ends_of_a_mode_take_the_full_width_and_stay_in_the_picture(sizes):
    panel = panel_of(tabs_of(sizes, 1))
    panel.get_by_role("button", name="−3 · mean · +3").click()
    shown = panel.locator(VIEW)
    shown.nth(2).wait_for()
    sizes.wait_for_function(f"{SEEN}.every((view) => view.frames > 0)")
    boxes = [canvas.bounding_box() for canvas in shown.all()]
    assert boxes[-1]["x"] + boxes[-1]["width"] - boxes[0]["x"] > (
        0.96 * panel.bounding_box()["width"]
    )
    outside = """(c) => {
      const view = c.view, { w, h, scale } = view.placement(), P = view.surfaces[0].position;
      const R = view.camera.rotation, m = view.frame.centre;
      let most = 0;
      for (let i = 0; i < P.length; i += 3) {
        const p = [0, 1, 2].map((k) => P[i + k] - m[k]);
        const at = (k) => scale * Math.abs(R[k] * p[0] + R[k + 1] * p[1] + R[k + 2] * p[2]);
        most = Math.max(most, (2 * at(0)) / w, (2 * at(3)) / h);
      }
      return most;
    }"""
    for mode in panel.locator(".s4a-slider input").all():
        mode.focus()
        assert all(canvas.evaluate(outside) <= 1 for canvas in shown.all())
    panel.get_by_role("button", name="−3 · mean · +3").click()


@pytest.mark.parametrize("title", TITLES)
def test_every_control_has_a_tooltip(sizes, title):
    panel = panel_of(tabs_of(sizes, 1, title))
    unsaid = panel.evaluate(
        "(e) => [...e.querySelectorAll('input, select, button, [role=slider]')]"
        ".filter((c) => c.getClientRects().length)"
        ".filter((c) => [undefined, c.labels?.[0]?.textContent.trim()]"
        ".includes(c.closest('[title]')?.title || undefined))"
        ".map((c) => c.outerHTML)"
    )
    assert unsaid == []


def test_sliders_keep_their_arrow_keys_in_notebook_7(sizes):
    """Notebook 7 handles keys before the page, unless the focused element prevents that."""
    sizes.evaluate("""() => document.addEventListener("keydown", (event) => {
      if (event.target.hasAttribute("data-lm-suppress-shortcuts")) return;
      event.preventDefault();
      event.stopPropagation();
    }, true)""")
    slider = panel_of(tabs_of(sizes, 3)).locator(".s4a-slider input").first
    move(slider, 0)
    slider.focus()
    sizes.keyboard.press("ArrowRight")
    assert float(slider.input_value()) == pytest.approx(0.05)
    handle = panel_of(tabs_of(sizes, 3, "Spectrum")).locator("[role=slider]").first
    assert handle.get_attribute("aria-label") == "eigenfunction"
    before = float(handle.get_attribute("aria-valuenow"))
    handle.focus()
    sizes.keyboard.press("ArrowRight")
    assert float(handle.get_attribute("aria-valuenow")) == before + 1


def test_a_slider_is_hit_within_24_pixels(sizes):
    panel = panel_of(tabs_of(sizes, 3, "Spectrum"))
    handle, track = panel.locator("[role=slider]").first, panel.locator(".noUi-base").first
    panel.get_by_text("first k").scroll_into_view_if_needed()

    def value():
        return float(handle.get_attribute("aria-valuenow"))

    for share, off in ((0.7, 11), (0.4, -11)):
        before = value()

        def click(share=share, off=off):
            box = track.bounding_box()
            y = box["y"] + box["height"] / 2 + off
            sizes.mouse.click(box["x"] + share * box["width"], y)

        settled(sizes, lambda before=before: value() != before, click)


# ---- far kernels


@pytest.fixture(scope="module")
def far(browser, lab, messages):
    """A notebook whose kernel is a quarter of a second away."""
    page = watched(browser.new_page(viewport={"width": 1280, "height": 1300}), messages)
    page.add_init_script(DELAYED)
    page.set_default_timeout(60_000)
    run_notebook(page, lab, "small.ipynb")
    page.wait_for_function(DRAWN, timeout=120_000)
    yield page
    page.close()


WATCH = """(all) => {
  window.places = [];
  const look = () => {
    const now = JSON.stringify(all.map((c) => c.view.points.map((p) => p.slice(0, 3))));
    if (now !== window.places.at(-1)) window.places.push(now);
  };
  clearInterval(window.watching);
  window.watching = setInterval(look, 5);
}"""


UNDER = """(c, [x, y]) => {
  const found = x.map((at) => c.view.pick({ clientX: at, clientY: y })?.vertex ?? -1);
  return found.filter((vertex, i) => vertex !== found[i - 1]);
}"""


def returns(places):
    """The places that were left and come back to, by when and when again."""
    return [(places.index(p), i) for i, p in enumerate(places) if places.index(p) < i]


def test_a_marker_never_returns_to_an_older_point_with_a_slow_kernel(far):
    open_tab(far, "Correspondence")
    canvases = visible(far, VIEW)
    canvases.nth(1).wait_for()
    far.wait_for_function(f"{SEEN}.length === 2 && {SEEN}.every((v) => v.frames && v.camera)")
    far.wait_for_timeout(1000)
    canvases.evaluate_all(WATCH)
    box = canvases.first.bounding_box()
    sent = far.evaluate("window.sent.length")
    x = [box["x"] + box["width"] * (0.32 + 0.008 * i) for i in range(45)]
    # a row of the picture in which no vertex is the nearest one twice
    for share in np.linspace(0.3, 0.7, 41):
        y = box["y"] + box["height"] * share
        path = canvases.first.evaluate(UNDER, [x, y])
        if -1 not in path and len(path) > 9 and returns(path) == []:
            break
    assert returns(path) == []
    for i in range(45):
        far.mouse.move(x[i], y)
        far.wait_for_timeout(30)
        if i == 20:
            heard = far.evaluate("(n) => window.sent.slice(n)", sent)
            assert [text for text in heard if "hovered" in text] == [], "the browser knows it all"
        if i in (21, 23, 25):  # clicks, whose answers come when the pointer is elsewhere
            far.mouse.down()
            far.mouse.up()
    picks = "window.sent.filter((text) => text.includes('\"picked\"')).length >= 2"
    far.wait_for_function(picks)
    far.wait_for_timeout(1500)  # for all answers, whose effect is to be none
    places = far.evaluate("window.places")
    assert len(places) > 8
    assert returns(places) == [], len(places)


def test_the_answer_to_the_last_click_is_shown(far, study):
    canvas = visible(far, VIEW).first
    box = canvas.bounding_box()
    far.mouse.move(box["x"] + 3, box["y"] + 3)
    for dx in (0.45, 0.55):
        far.mouse.click(box["x"] + box["width"] * dx, box["y"] + box["height"] / 2)
    last = canvas.evaluate(
        "(c, [x, y]) => c.view.pick({ clientX: x, clientY: y }).vertex",
        [box["x"] + box["width"] * dx, box["y"] + box["height"] / 2],
    )
    visible(far, ".s4a-readout").filter(has_text=f"template vertex {last} ").first.wait_for()
    picked = canvas.evaluate("(c) => c.view.points[0].slice(0, 3)")
    np.testing.assert_allclose(picked, vertices(canvas)[last], atol=1e-3)
    far.get_by_label("colours").filter(visible=True).select_option("checkerboard")
    far.wait_for_function(f"{SEEN}.every((v) => v.surfaces[0].cell > 0 && !v.points.length)")


def test_the_cursor_of_a_matrix_never_returns(far):
    open_tab(far, "Functional map")
    matrix = visible(far, ".s4a-matrix canvas").first
    matrix.wait_for()
    far.evaluate("""() => {
      window.cells = [];
      const look = () => {
        const at = [...document.querySelectorAll('.s4a-matrix')].find((m) => m.offsetParent)
          ?.querySelector('svg rect:last-child');
        const now = at && `${at.getAttribute('x')},${at.getAttribute('y')}`;
        if (now && now !== window.cells.at(-1)) window.cells.push(now);
      };
      setInterval(look, 5);
    }""")
    far.wait_for_function("window.cells.length === 1")  # where it is before the first click
    box = matrix.bounding_box()
    for i in (4, 6, 8, 10, 12):
        far.mouse.click(box["x"] + box["width"] * i / 24.5, box["y"] + box["height"] * i / 24.5)
        far.wait_for_timeout(120)  # the answers come between the clicks
    visible(far, ".s4a-title").filter(has_text="φ11 on").first.wait_for()
    far.wait_for_timeout(500)
    cells = far.evaluate("window.cells")
    assert len(cells) == 6
    assert returns(cells) == [], cells


def test_without_webgl_the_notebook_shows_still_pictures(flat, lab, study):
    messages = []
    page = watched(flat.new_page(viewport={"width": 1280, "height": 1300}), messages)
    page.set_default_timeout(60_000)
    run_notebook(page, lab, "small.ipynb")
    page.wait_for_function(f"{STILLS}.length > 0", timeout=120_000)
    assert visible(page, VIEW).count() == 0
    first = visible(page, "img.s4a-still").first.get_attribute("src")
    move(visible(page, ".s4a-slider input").first, 3)
    page.wait_for_function(f"(old) => {STILLS}.some((i) => i.src !== old)", arg=first)
    page.locator(".jupyter-widgets .lm-TabBar-tabLabel", has_text="Correspondence").first.click()
    page.wait_for_function(f"{STILLS}.length === 2")
    assert serious(messages) == []
    page.close()


def test_an_analysis_is_opened_while_it_runs_and_cancelled_and_resumed(
    browser, lab, folder, messages
):
    page = watched(browser.new_page(viewport={"width": 1280, "height": 1300}), messages)
    page.set_default_timeout(60_000)
    run_notebook(page, lab, "progress.ipynb")
    page.wait_for_function(
        "document.querySelectorAll('.progress-bar-success').length >= 2", timeout=120_000
    )
    page.get_by_role("button", name="Open", exact=True).click()
    page.locator(".jupyter-widgets .lm-TabBar-tabLabel", has_text="Spectrum").first.click()
    page.wait_for_function(DRAWN)
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.wait_for_selector("text=cancelled; press Resume")
    kept = {path: path.stat().st_mtime_ns for path in (folder / "run" / "coarse").glob("*.nc")}
    assert kept, "remeshed before the button came; how many, the machine's speed decides"
    page.get_by_role("button", name="Resume", exact=True).click()
    page.wait_for_selector("text=/finished, \\d/", timeout=180_000)
    assert (folder / "run" / "pca.nc").exists()
    assert {path: path.stat().st_mtime_ns for path in kept} == kept, (
        "what was done is not done again"
    )
    page.locator(".jupyter-widgets .lm-TabBar-tabLabel", has_text="Modes").first.click()
    page.wait_for_selector(".s4a-slider >> visible=true")
    page.close()


def test_the_console_has_no_errors(page, messages):
    assert serious(messages) == []


# ---- for readers of screens, with axe-core


# ---- every theme


def test_contrast_is_measured_as_wcag_defines_it(browser):
    page = browser.new_page()
    page.set_content("<p style='color:#777'>grey</p><p style='background:#000;color:#fff'>white")
    ratios = {text: ratio for ratio, text in contrasts(page.locator("body"))}
    assert ratios["grey"] == pytest.approx(4.48, abs=0.01)
    assert ratios["white"] == pytest.approx(21)
    assert faint(page.locator("body")) == (2, [(4.5, "grey")])
    page.close()


@pytest.mark.parametrize("theme", THEMES)
def test_every_text_of_every_tab_is_read_in_every_theme(sizes, theme):
    def shown(title):
        tabs = tabs_of(sizes, 3, title)
        if title == "Network":
            panel_of(tabs).locator(".s4a-edge").nth(6).dispatch_event("click")
            panel_of(tabs).locator(".s4a-title", has_text="the target").wait_for()
        assert panel_of(tabs).get_attribute("role") == "region", "a landmark"
        return tabs

    check_themes(sizes, theme, {title: lambda title=title: shown(title) for title in TITLES}, 20)


# ---- without a kernel


def test_the_page_deforms_without_kernel_and_network(show, study):
    page = show(widgets.Modes(study))
    assert barriers(page) == []
    check_sliders(page, study)


def test_one_mode_has_no_chart_of_the_variance_of_many(show, study):
    some = study.copy()
    some["pca"] = type(study)(study["pca"].to_dataset().isel(component=slice(1)))
    page = show(widgets.Modes(some))
    assert page.get_by_text("Scores: click").count() == 1
    assert page.get_by_text("Explained variance").count() == 0


def test_a_lasso_selects_the_visible_vertices_inside(show, study):
    panel = Region(study, view="top")
    panel.lasso.value = True
    X, T = panel.X, panel.T
    page = show(panel)
    box = visible(page, VIEW).first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y - 150)
    page.mouse.down()
    for dx, dy in ((400, -150), (400, 150), (0, 150)):  # the right half
        page.mouse.move(x + dx, y + dy, steps=5)
    assert page.evaluate(f"{SEEN}[0].path.length") > 10
    page.mouse.up()
    drawn = page.evaluate(
        "Object.values(s4aModels).map((m) => m.get('drawn_around')).find((d) => d && d.polygon)"
    )
    found = vertices_within(X, T, drawn["polygon"], drawn["rotation"])
    middle = (X[:, 0].max() + X[:, 0].min()) / 2
    assert found.mean() > 0.15
    assert X[found, 0].min() > middle - 3
    # without the lasso the same drag turns the surface
    before = page.evaluate(f"{SEEN}[0].camera.rotation")
    assert np.allclose(before, drawn["rotation"])
    page.evaluate(f"{SEEN}[0].lasso = false")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y, steps=4)
    page.mouse.up()
    assert not np.allclose(page.evaluate(f"{SEEN}[0].camera.rotation"), before)


SMOOTH = "(c) => c.view.smooth"


def test_full_resolution_is_drawn_once_after_a_drag(show, study):
    page = show(widgets.Modes(study))
    page.wait_for_function(f"{SEEN}[0].smooth > 0")
    canvas = visible(page, VIEW).first
    before, box = canvas.evaluate(SMOOTH), canvas.bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    for step in range(2):
        page.mouse.move(box["x"] + 110 + 10 * step, box["y"] + 120)
        page.wait_for_timeout(600)
    assert canvas.evaluate(SMOOTH) == before
    page.mouse.up()
    settled(page, lambda: canvas.evaluate(SMOOTH) > before)
    page.wait_for_timeout(600)
    assert canvas.evaluate(SMOOTH) == before + 1
    # after a long frame it waits for four times as long
    waited = canvas.evaluate("""async (c) => {
      const start = performance.now(), before = c.view.smooth;
      c.view.waiting = 1;  // no other frame in between
      c.view.took = 200;
      c.view.redraw();
      while (c.view.smooth === before) await new Promise((done) => setTimeout(done, 5));
      return performance.now() - start;
    }""")
    assert waited >= 800


@pytest.fixture(scope="module")
def study_page(study, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        small_pictures(patch.setattr, pages=(120, 100))
        return s4a.write_page(study, tmp_path_factory.mktemp("page") / "study.html")


@pytest.mark.parametrize("width, height", [(1366, 680), (1920, 1080)])
def test_the_page_of_a_study_fills_a_wide_screen_one_idea_at_a_time(
    show, study_page, width, height
):
    page = show(study_page)
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_function(DRAWN)
    wide, tall, text = page.evaluate("""() => {
      const panel = document.getElementById("modes"), box = panel.getBoundingClientRect();
      const words = parseFloat(getComputedStyle(panel.querySelector(".s4a-title")).fontSize);
      return [box.width, box.height, words];
    }""")
    sizes = f"{wide:.0f} x {tall:.0f}, text {text:.1f}"
    assert wide >= 0.8 * width, sizes
    assert tall <= height, sizes
    box = visible(page, VIEW).first.bounding_box()
    assert 0.75 < box["height"] / box["width"] < 1.3, "a shape is as wide as the smaller of both"
    assert text >= (16 if width >= 1920 else 13), sizes


def test_the_page_of_a_study_has_live_sliders(show, study, study_page):
    page = show(study_page)
    check_sliders(page, study)
    assert not page.locator("#modes-fallback").is_visible()


def test_the_page_of_a_study_has_no_serious_barrier_and_one_screen_an_idea(show, study_page):
    page = show(study_page)
    page.set_viewport_size({"width": 1366, "height": 768})
    page.wait_for_function(DRAWN)
    assert barriers(page) == []
    heights = page.evaluate(
        "[...document.querySelectorAll('section')].map((s) => s.getBoundingClientRect().height)"
    )
    assert max(heights) <= 768
    page.get_by_role("link", name="Gallery").click()
    page.wait_for_function(
        "Math.abs(document.querySelector('h2:target').getBoundingClientRect().top) < 300"
    )
    assert page.locator("h2:target").inner_text() == "Gallery"


def test_the_page_of_the_network_shows_the_clicked_map(show, study):
    page = show(widgets.Network(study), limit=200_000)
    assert barriers(page) == []
    edge = visible(page, ".s4a-edge").nth(6)
    source, target = re.match(r"(\w+) → (\w+)", edge.get_attribute("aria-label")).groups()
    edge.dispatch_event("click")
    visible(page, ".s4a-title").filter(has_text=f"{source} → {target}").wait_for()
    visible(page, ".s4a-title").filter(has_text=f"{target}, the target").wait_for()
    assert page.locator("#c-choice option:checked").inner_text() == f"{source} → {target}"
    net = study["network"].dataset
    own = (net["source"].values == source) & (net["target"].values == target)
    C = net["fmap_initial"].values[own][0]
    page.locator(".s4a-matrix canvas").focus()
    page.keyboard.press("ArrowRight")
    text = visible(page, ".s4a-readout").filter(has_text="C[0, 1]").inner_text()
    assert float(re.search(r"= (\S+)", text)[1]) == pytest.approx(C[0, 1], rel=6e-3)
    move(page.locator("#c-budget"), 0)
    page.wait_for_selector("text=/4 pairs.*: connected/")
    assert visible(page, ".s4a-edge").count() == 8
    chosen(page, "stage", "after Consistent ZoomOut")
    visible(page, ".s4a-title").filter(has_text="24 × 24").wait_for()
    visible(page, "[data-node]").nth(1).dispatch_event("click")
    visible(page, ".s4a-title").filter(has_text=re.compile("^brain_02$")).wait_for()
    assert visible(page, VIEW).count() == 1


@pytest.fixture(scope="module")
def map_page(study, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.html"
    few, maps = study.copy(), study["network"].to_dataset()
    pairs = [{"brain_01", "brain_02"}, {"brain_02", "brain_03"}]
    ends = zip(maps["source"].values, maps["target"].values, strict=True)
    few["network"] = type(study)(maps.isel(pair=[{*pair} in pairs for pair in ends]))
    panel = widgets.FunctionalMap(few)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(panel_page, "N_VALUES", 4)
        panel.save_html(path)
    panel.close()
    return path


def test_the_page_of_a_map_replays_zoomout_and_shows_its_eigenfunctions(show, map_page):
    page = show(map_page)
    before = pixels(visible(page, VIEW).first)
    move(page.locator("#c-k"), 1)
    visible(page, ".s4a-title").filter(has_text="15 × 15").wait_for()
    page.locator(".s4a-matrix canvas").focus()
    for key in ("ArrowDown", "ArrowRight", "ArrowRight", "Enter"):
        page.keyboard.press(key)
    visible(page, ".s4a-title").filter(has_text="source φ3").wait_for()
    visible(page, ".s4a-title").filter(has_text="target ψ2").wait_for()
    assert pixels(visible(page, VIEW).first) != before
    chosen(page, "choice", "brain_02 → brain_03")
    visible(page, ".s4a-title").filter(has_text="φ3 on brain_02").wait_for()


@pytest.mark.parametrize("width", [300, 1366])
def test_the_axes_of_a_matrix_number_its_cells_and_nothing_overlaps(show, map_page, width):
    page = show(map_page)
    page.set_viewport_size({"width": width, "height": 800})
    page.wait_for_function(DRAWN)
    frame = page.locator(".s4a-matrix-frame")
    assert frame.locator(".s4a-xlabel").inner_text() == "eigenfunction of the source"
    assert frame.locator(".s4a-ylabel").inner_text() == "eigenfunction of the target"
    assert frame.locator(".s4a-numbers span").all_inner_texts() == [
        "-1",
        "entry of the matrix",
        "1",
    ]
    assert "b = C a" in page.locator(".s4a-note").inner_text()
    cells = frame.locator("canvas").bounding_box()
    for axis, length in (("x", "width"), ("y", "height")):
        for tick in frame.locator(f".s4a-{axis}ticks span").all():
            box, number = tick.bounding_box(), int(tick.inner_text())
            at = (box[axis] + box[length] / 2 - cells[axis]) / cells[length] * 24
            assert at == pytest.approx(number + 0.5, abs=0.3), axis
    parts = (
        ".s4a-ylabel, .s4a-yticks span, canvas, .s4a-xticks span, .s4a-xlabel, .s4a-numbers span"
    )
    found = [*frame.locator(parts).all(), page.locator(".s4a-note")]
    found += [page.locator(".s4a-title").first, page.locator(".s4a-readout").first]
    boxes = [part.bounding_box() for part in found]
    assert len(boxes) > 12
    for a, b in itertools.combinations(boxes, 2):
        across = min(a["x"] + a["width"], b["x"] + b["width"]) - max(a["x"], b["x"])
        down = min(a["y"] + a["height"], b["y"] + b["height"]) - max(a["y"], b["y"])
        assert min(across, down) < 1, (a, b)
    assert max(box["x"] + box["width"] for box in boxes) <= width


def test_the_page_of_correspondences_follows_the_pointer_and_the_keyboard(show, study):
    panel = widgets.Correspondence(study)
    page = show(panel)
    chosen(page, "choice", "brain_04")
    chosen(page, "colors", "checkerboard")
    at = cursor(visible(page, VIEW).first, "ArrowRight")
    readout = (
        visible(page, ".s4a-readout").filter(has_text=f"template vertex {at} ↔ brain_04").first
    )
    image = int(re.search(r"brain_04 vertex (\d+)", readout.inner_text())[1])
    assert study["registration"]["registered_match"].sel(shape="brain_04").values[at] == image
    shape = visible(page, VIEW).nth(1)
    np.testing.assert_allclose(
        shape.evaluate("(c) => c.view.points[0].slice(0, 3)"), vertices(shape)[image]
    )
    assert shape.evaluate("(c) => c.view.surfaces[0].cell") > 0


@pytest.fixture(scope="module")
def compared():
    """Matches of two methods between two brains, with the ground truth."""
    brains = s4a.synthetic.brains(2, 900)
    one, two = (node.to_dataset() for node in brains["original"].children.values())
    reference = brains["truth/brain_02/reference_point"].values
    truth = np.asarray(s4a.synthetic.position(brains["truth"], "brain_01", reference))
    options = {"n_coarse": 200, "k": 20, "k_init": 10, "n_geodesic": 50, "keep": True}
    return s4a.compare(one, two, truth=truth, methods=["kNN", "RE-MATCH"], **options)


def test_the_page_of_methods_marks_a_vertex_in_all_views(show, compared):
    panel = widgets.Comparison(compared, methods=["kNN", "RE-MATCH", "truth"])
    page = show(panel)
    assert barriers(page) == []
    for width, columns in ((1920, 4), (800, 2)):
        page.set_viewport_size({"width": width, "height": 1000})
        boxes = [canvas.bounding_box() for canvas in visible(page, VIEW).all()]
        assert len(boxes) == 4
        assert len({round(box["x"]) for box in boxes}) == columns
        assert max(box["x"] + box["width"] for box in boxes) <= width
    chosen(page, "colors", "error")
    chosen(page, "method1", "truth")
    visible(page, ".s4a-title").filter(has_text=re.compile("^truth$")).nth(1).wait_for()
    chosen(page, "method1", "RE-MATCH")

    at = cursor(visible(page, VIEW).nth(1), "ArrowRight")
    kept = compared["pairs/pair"].dataset
    match = [*kept["algorithm_match"].values[:, at], kept["true_match"].values[at]]
    views = visible(page, VIEW)
    there = views.first.evaluate("(c) => c.view.points.map((p) => p.slice(0, 3))")
    np.testing.assert_allclose(there, compared["source/position"].values[match], rtol=1e-5)
    texts = [text.inner_text() for text in visible(page, ".s4a-readout").all()[1:]]
    error = 100 * kept["algorithm_error"].values[1, at]
    assert texts[1] == f"target vertex {at} → source vertex {match[1]}, error {error:.2f} %"
    assert texts[2] == f"target vertex {at} → source vertex {match[2]}, error 0.00 %"

    at = cursor(views.first, "ArrowLeft")
    back = kept["algorithm_reverse"].values[:, at]
    for i in range(2):
        there = views.nth(1 + i).evaluate("(c) => c.view.points[0].slice(0, 3)")
        np.testing.assert_allclose(there, kept["position"].values[back[i]], rtol=1e-5)


def test_the_page_of_a_transfer_says_what_needs_python(show, study):
    page = show(widgets.Transfer(study))
    assert barriers(page) == []
    assert "placing landmarks" in page.locator(".note:not(#not-recorded)").inner_text()
    chosen(page, "target", "brain_05")
    visible(page, ".s4a-title").filter(has_text="brain_05, the target").wait_for()
    page.wait_for_selector("text=Landmarks on brain_05")


def test_without_webgl_pages_have_still_pictures(show, flat, study, study_page):
    for what in (widgets.Modes(study), study_page):
        page = show(what, flat, drawn=False)
        page.wait_for_function(
            "[...document.querySelectorAll('img')].some((i) => i.naturalWidth > 100)"
        )
        assert visible(page, VIEW).count() == 0
    assert page.locator("#modes-fallback").is_visible(), "it names the pictures of the modes"
