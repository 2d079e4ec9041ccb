"""Scenes of pythreejs in a real JupyterLab: which pixels are drawn, and what the kernel hears."""

import io

import numpy as np
import pytest
from browsing import IDLE, needed, notebooks, run_notebook, serious, settled, watched
from PIL import Image

import s4a

pytestmark = needed
CELL = """
import ipywidgets
import numpy as np
import pythreejs

import s4a
from s4a.widgets import Modes, threejs

study = s4a.open_study({store!r})
mesh = study["original/brain_01"].to_dataset()
"""
CELLS = [
    """
deforming = threejs.modes(study)
panel = Modes(study)
threejs.renderer(deforming, size=(300, 240), view="front")
""",
    "deforming.sliders",
    """
left = mesh["position"].values[:, [0]] < 0
halves = np.where(left, [[1.0, 0, 0]], [[0, 0, 1.0]])
threejs.renderer(threejs.surface(mesh, halves), size=(300, 240), view="front")
""",
    """
marks = threejs.points(mesh, "#00ff00")
sun = pythreejs.PointLight(color="#00ffff", position=[0, -900, 0], intensity=2)
own = threejs.renderer(threejs.surface(mesh), marks, size=(300, 240), view="front")
own.scene.add(sun)
own
""",
    """
joined = threejs.correspondence(study, "brain_01", "brain_02")
threejs.renderer(joined, size=(480, 240), view="front")
""",
    'threejs.renderer(threejs.network(study), size=(480, 300), view="top")',
    """
ipywidgets.jsdlink((panel.view, "scores"), (deforming, "scores"))
panel
""",
]


LARGE = """
import numpy as np
import xarray as xr

import s4a
from s4a.widgets import threejs

mesh = s4a.synthetic.sphere(20_000)
X = mesh["position"].values
waves = [np.sin((k + 2) * X[:, [k % 3]]) * X / 20 for k in range(10)]
pca = xr.Dataset(
    {
        "mean_displacement": (("vertex", "xyz"), np.zeros_like(X)),
        "deformation": (("component", "vertex", "xyz"), np.array(waves)),
    }
)
study = xr.DataTree.from_dict({"/registration": mesh, "/pca": pca})
deforming = threejs.modes(study)
threejs.renderer(deforming, size=(400, 300))
"""
SCENES = ".jp-OutputArea-output canvas:not(.s4a-view)"
MODES, HALVES, LANDMARKS, PAIR, NETWORK = range(5)


@pytest.fixture(scope="module")
def folder(study_folder, tmp_path_factory):
    scenes = [CELL.format(store=str(study_folder)), *CELLS]
    large = [LARGE, "deforming.sliders"]
    return notebooks(tmp_path_factory.mktemp("scenes"), scenes=scenes, large=large)


def opened(browser, lab, name):
    """A page with an executed notebook; it records errors and messages to the kernel."""
    messages = []
    page = watched(browser.new_page(viewport={"width": 1280, "height": 3600}), messages)
    page.set_default_timeout(180_000)  # a machine may be busy
    page.messages, page.sent = messages, []
    page.on("websocket", lambda socket: socket.on("framesent", lambda text: page.sent.append(text)))
    run_notebook(page, lab, name)
    page.wait_for_function("document.querySelectorAll('.s4a-scores input').length > 0")
    page.wait_for_function(IDLE)
    return page


@pytest.fixture(scope="module")
def page(browser, lab):
    page = opened(browser, lab, "scenes.ipynb")
    for i in range(5):
        drawn(page, i, lambda picture: body(picture).mean() > 0.05)
    return page


def seen(page, i):
    """The pixels of a scene (height, width, 3)."""
    picture = page.locator(SCENES).nth(i).screenshot()
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)


def drawn(page, i, as_wanted):
    """The pixels of a scene as soon as they are as wanted."""
    for _ in range(60):
        picture = seen(page, i)
        if as_wanted(picture):
            return picture
        page.wait_for_timeout(250)
    raise AssertionError(f"scene {i} is not drawn as wanted")


def move(slider, value, *, let_go=False):
    slider.evaluate("(i, v) => { i.value = v; i.dispatchEvent(new Event('input')); }", value)
    if let_go:
        slider.evaluate("(i) => i.dispatchEvent(new Event('change'))")


def comms(page, before):
    """What panels sent after the first `before` messages, without requests of JupyterLab."""
    return [text for text in page.sent[before:] if b"comm_msg" in bytes(text)]


def body(picture):
    return picture.min(2) < 245


def test_a_slider_deforms_the_surface_and_sends_nothing_until_it_is_released(page):
    slider = page.locator(".s4a-scores input").first
    before = seen(page, MODES)
    sent = len(page.sent)
    for value in (0.5, 1, 2, 3):
        move(slider, value)
    drawn(page, MODES, lambda picture: (body(picture) != body(before)).mean() > 0.01)
    assert comms(page, sent) == []
    move(slider, 3, let_go=True)
    settled(page, lambda: comms(page, sent))
    page.wait_for_timeout(300)  # no second one
    assert len(comms(page, sent)) == 1, "one message tells Python where the slider stands"


def test_expansion_is_blue_and_compression_red_and_the_light_falls_on_both(page):
    move(page.locator(".s4a-scores input").first, 3)
    picture = drawn(page, MODES, lambda p: ((p[..., 2] - p[..., 0]) > 60).mean() > 0.01)
    assert ((picture[..., 0] - picture[..., 2]) > 60).mean() > 0.005
    blue = picture[(picture[..., 2] - picture[..., 0]) > 60]
    assert np.ptp(blue.sum(1)) > 100, "shaded, not flat"


def test_the_mean_is_drawn_again_by_a_double_click(page):
    slider = page.locator(".s4a-scores input").first
    move(slider, 3)
    drawn(page, MODES, lambda p: ((p[..., 2] - p[..., 0]) > 60).mean() > 0.01)
    slider.dispatch_event("dblclick")
    drawn(page, MODES, lambda p: ((p[..., 2] - p[..., 0]) > 60).mean() < 0.001)
    assert page.locator(".s4a-scores output").first.inner_text() == "+0.00 σ"


def test_the_deformed_surface_is_where_the_sum_of_modes_puts_it(page, study):
    """Compare its outline with that of a surface with vertices deformed by NumPy."""
    scores = [2.0, -1.5, 1.0]
    shape = s4a.synthesize(study, scores)["position"].values
    mean = s4a.synthesize(study, [0.0] * 3)["position"].values
    width = np.ptp(shape[:, 0]) / np.ptp(mean[:, 0])
    height = np.ptp(shape[:, 2]) / np.ptp(mean[:, 2])

    def outline(picture):
        rows, columns = np.nonzero(body(picture))
        return np.ptp(columns), np.ptp(rows)

    def outline_at(values):
        before = seen(page, MODES)
        for i, value in enumerate(values):
            move(page.locator(".s4a-scores input").nth(i), value)
        picture = drawn(page, MODES, lambda picture: (picture != before).any())
        while (before != picture).any():  # until it is at rest
            page.wait_for_timeout(300)
            before, picture = picture, seen(page, MODES)
        return outline(picture)

    moved, still = outline_at(scores), outline_at([0, 0, 0])
    assert moved[0] / still[0] == pytest.approx(width, abs=0.04)
    assert moved[1] / still[1] == pytest.approx(height, abs=0.04)


def test_a_panel_moves_the_scene_that_is_linked_to_it(page):
    before = seen(page, MODES)
    move(page.locator(".s4a-slider input").first, -3)
    drawn(page, MODES, lambda picture: (body(picture) != body(before)).mean() > 0.005)
    assert page.locator(".s4a-scores output").first.inner_text() == "−3.00 σ"
    move(page.locator(".s4a-slider input").first, 0)


def test_the_colours_of_a_field_are_where_its_values_are(page):
    picture = seen(page, HALVES)
    red = (picture[..., 0] > 90) & (picture[..., 2] < 60)
    blue = (picture[..., 2] > 90) & (picture[..., 0] < 60)
    assert red.mean() > 0.04
    assert blue.mean() > 0.04
    assert np.nonzero(red)[1].max() < np.nonzero(blue)[1].mean()


def test_landmarks_are_drawn_and_a_light_of_ones_own_shines_on_the_surface(page):
    picture = seen(page, LANDMARKS)
    green = (picture[..., 1] > 120) & (picture[..., 0] < 60) & (picture[..., 2] < 60)
    assert green.sum() > 30
    lit = body(picture) & (picture[..., 2] - picture[..., 0] > 20)
    assert lit.mean() > 0.03, "cyan"


def test_segments_join_the_two_surfaces_of_a_correspondence(page):
    picture = seen(page, PAIR)
    columns = body(picture).any(0)
    covered = np.nonzero(columns)[0]
    assert columns[covered.min() : covered.max()].all(), "no gap between them"
    middle = body(picture)[:, (covered.min() + covered.max()) // 2]
    assert 4 <= np.count_nonzero(np.diff(middle.astype(int)) == 1), "several lines, no surface"


def green(picture):
    return (picture[..., 1] - picture[..., 0] > 30) & (picture[..., 1] - picture[..., 2] > 30)


def test_the_network_shows_its_nodes_and_edges_in_the_colours_of_their_errors(page):
    picture = seen(page, NETWORK)
    clay = body(picture) & (np.ptp(picture, axis=2) < 40) & (picture.min(2) > 80)
    assert clay.mean() > 0.03
    lines, bar = np.split(picture, [4 * len(picture) // 5])
    assert (np.ptp(lines.astype(int), axis=2) > 60).sum() > 60, "edges are coloured"
    assert green(bar).sum() > 60, "the colour bar begins with the smallest error of all maps"
    violet = (bar[..., 2] - bar[..., 1] > 40) & (bar[..., 0] < 110)
    assert violet.sum() > 60, "and ends with the largest, before Consistent ZoomOut"


FRAMES = """
async (steps) => {
  const input = document.querySelector(".s4a-scores input");
  const frame = () => new Promise((drawn) => requestAnimationFrame(drawn));
  const begin = performance.now();
  for (let step = 0; step < steps; step++) {
    input.value = 3 * Math.sin(step);
    input.dispatchEvent(new Event("input"));
    await frame();
    const gl = document.querySelector("canvas:not(.s4a-view)").getContext("webgl2");
    gl?.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
  await frame();
  return (performance.now() - begin) / steps;
}
"""


def test_ten_modes_of_20000_vertices_move_without_the_kernel(browser, lab, record_property):
    page = opened(browser, lab, "large.ipynb")
    before = drawn(page, 0, lambda picture: body(picture).mean() > 0.05)
    assert page.locator(".s4a-scores input").count() == 10
    page.wait_for_timeout(500)
    sent = len(page.sent)
    record_property("ms a frame", page.evaluate(FRAMES, 8))
    move(page.locator(".s4a-scores input").nth(9), 3)
    drawn(page, 0, lambda picture: (picture != before).mean() > 0.02)
    assert comms(page, sent) == []
    # anywidget says so of a model that takes two seconds, as on a busy machine; it moved
    late = "[anywidget] Failed to initialize model."
    assert [text for text in serious(page.messages) if late not in text] == []
    page.close()


def test_nothing_went_wrong_in_the_browser(page):
    assert serious(page.messages) == []
