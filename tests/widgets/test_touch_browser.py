"""Panels under fingers and under the keyboard: saved pages on an emulated phone, and on a desk."""

import numpy as np
import pytest
from browsing import DRAWN, VIEW, needed, settled, visible, watched

from s4a import widgets

pytestmark = needed
pytest.importorskip("playwright.sync_api")

WIDTH, HEIGHT = 390, 844
CAMERA = "(c) => ({ rotation: [...c.view.camera.rotation], zoom: c.view.camera.zoom })"
PICKED = "(c, [x, y]) => c.view.pick({ clientX: x, clientY: y })?.point"


@pytest.fixture(scope="module")
def phone(browser):
    """A browser with fingers and no mouse."""
    context = browser.new_context(
        viewport={"width": WIDTH, "height": HEIGHT}, has_touch=True, is_mobile=True, offline=True
    )
    yield context
    context.close()


@pytest.fixture(scope="module")
def matches(phone, study, tmp_path_factory):
    """The page of correspondences on the phone, where all places of a surface can be picked."""
    path, panel = tmp_path_factory.mktemp("touch") / "page.html", widgets.Correspondence(study)
    panel.save_html(path)
    panel.close()
    errors = []
    page = watched(phone.new_page(), errors)
    page.goto(path.as_uri())
    page.wait_for_function(DRAWN)
    yield page
    page.close()
    assert errors == []


def touch(page, *paths, steps=10):
    """Fingers that go down, along a path of two points each, and up."""
    session = page.context.new_cdp_session(page)

    def tell(kind, share=None):
        at = (
            []
            if share is None
            else [(1 - share) * np.array(a) + share * np.array(b) for a, b in paths]
        )
        points = [{"x": float(x), "y": float(y), "id": i} for i, (x, y) in enumerate(at)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    tell("touchStart", 0)
    for step in range(steps):
        tell("touchMove", (step + 1) / steps)
    tell("touchEnd")
    session.detach()


@pytest.fixture
def surface(matches):
    """The first surface in the middle of the screen, as it was at first; and its middle."""
    canvas = visible(matches, VIEW).first
    canvas.evaluate("(c) => { c.view.reset(); scrollTo(0, 0); }")
    matches.wait_for_timeout(200)
    box = canvas.bounding_box()
    return canvas, np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])


def test_one_finger_scrolls_the_page_until_it_is_set_to_rotate(matches, surface):
    canvas, middle = surface
    before = canvas.evaluate(CAMERA)
    button = matches.get_by_role("button", name="one finger rotates the surface").first

    def drag():
        touch(matches, (middle + [0, 60], middle - [0, 120]))

    def tap(pressed):
        settled(matches, lambda: button.get_attribute("aria-pressed") == pressed, button.tap)

    settled(matches, lambda: matches.evaluate("scrollY") > 50, drag)
    assert canvas.evaluate(CAMERA) == before

    matches.evaluate("scrollTo(0, 0)")
    tap("true")
    matches.evaluate("scrollTo(0, 0)")
    settled(
        matches,
        lambda: not np.allclose(canvas.evaluate(CAMERA)["rotation"], before["rotation"]),
        drag,
    )
    assert matches.evaluate("scrollY") == 0
    tap("false")


def test_what_two_fingers_hold_stays_under_them(matches, surface):
    canvas, middle = surface
    before = canvas.evaluate(CAMERA)
    start, end = middle + [20, 10], middle + [-15, 40]
    held = canvas.evaluate(PICKED, start.tolist())
    size = np.ptp(canvas.evaluate("(c) => [...c.view.surfaces[0].position]"))
    fingers = [(start + s * np.array([30, 0]), end + s * np.array([60, 0])) for s in (-1, 1)]

    def spread():
        canvas.evaluate("(c) => c.view.reset()")
        touch(matches, *fingers)

    def held_under_them():
        after = canvas.evaluate(CAMERA)
        assert after["zoom"] == pytest.approx(2 * before["zoom"], rel=0.02)
        assert after["rotation"] == before["rotation"]
        there = canvas.evaluate(PICKED, end.tolist())
        np.testing.assert_allclose(there, held, atol=0.02 * size)

    settled(matches, held_under_them, spread)
    assert matches.evaluate("[scrollY, visualViewport.scale]") == [0, 1], "not the page"


def test_a_tap_picks_a_vertex(matches, surface):
    canvas, middle = surface
    picked = f"document.querySelector('{VIEW}').view.points.length === 1"
    settled(matches, lambda: matches.evaluate(picked), lambda: matches.touchscreen.tap(*middle))
    point = canvas.evaluate("(c) => c.view.points[0].slice(0, 3)")
    vertex = canvas.evaluate(
        "(c, [x, y]) => c.view.pick({ clientX: x, clientY: y }).vertex", middle.tolist()
    )
    np.testing.assert_allclose(canvas.evaluate("(c, i) => c.view.at(i)", vertex), point)


def test_every_surface_has_buttons_that_zoom_in_and_out_and_reset(matches, surface):
    canvas, _ = surface
    home = canvas.evaluate(CAMERA)
    n = visible(matches, VIEW).count()
    names = ("zoom in: ", "zoom out: ", "reset the view: ")
    zoom_in, zoom_out, reset = (visible(matches, f"[aria-label^='{name}']") for name in names)
    assert [zoom_in.count(), zoom_out.count(), reset.count()] == [n, n, n]

    def zoom():
        return canvas.evaluate(CAMERA)["zoom"] / home["zoom"]

    settled(matches, lambda: zoom() > 1.4, zoom_in.first.tap)
    settled(matches, lambda: zoom() < 1.1, zoom_out.first.tap)
    assert zoom() == pytest.approx(1)
    settled(matches, lambda: zoom() < 0.9, zoom_out.first.tap)
    settled(matches, lambda: canvas.evaluate(CAMERA) == home, reset.first.tap)


# the controls of a page that are smaller than a finger needs
SMALL = """() => [...document.querySelectorAll("button, select, input:not([type=checkbox])")]
  .filter((e) => e.getClientRects().length)
  .map((e) => [e.getBoundingClientRect(), e.outerHTML])
  .filter(([box]) => box.height < 24 || box.width < 24)"""


@pytest.mark.parametrize("kind", ["Modes", "Network", "Spectrum"])
def test_controls_are_24_pixels_high_and_nothing_is_wider_than_the_phone(show, phone, study, kind):
    page = show(getattr(widgets, kind)(study), phone)
    assert page.locator("input[type=range]").count() > 0
    assert page.evaluate(SMALL) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= WIDTH


FOCUSED = "document.activeElement.getAttribute('aria-label')"
AGAIN = """(old) => {
  const at = document.activeElement;
  return at.isConnected && at !== window.clicked && at.matches(".s4a-mark");
}"""


@pytest.mark.parametrize("kind, marks", [("Median", "rect.s4a-mark"), ("Network", "[data-node]")])
def test_a_clicked_mark_keeps_the_focus_and_the_arrow_keys_go_on_from_it(show, study, kind, marks):
    page = show(getattr(widgets, kind)(study), limit=800_000)
    mark = visible(page, marks).nth(2)
    name = mark.get_attribute("aria-label").split(":")[0].split(",")[0]
    mark.evaluate("(at) => (window.clicked = at)")
    mark.locator("circle").last.click() if kind == "Network" else mark.click()
    page.wait_for_function(AGAIN)
    assert page.evaluate(FOCUSED).startswith(name)
    next_name = visible(page, marks).nth(3).get_attribute("aria-label")
    page.keyboard.press("ArrowRight")
    assert page.evaluate(FOCUSED) == next_name
    page.evaluate("window.clicked = document.activeElement")
    page.keyboard.press("Enter")
    page.wait_for_function(AGAIN)
    assert page.evaluate(FOCUSED).startswith(next_name.split(":")[0].split(",")[0])
    stops = page.evaluate(
        "document.activeElement.closest('svg').querySelectorAll('[tabindex=\"0\"]').length"
    )
    assert stops == 1, "one tab stop"
