"""The main notebook in a real JupyterLab, driven in Chromium: what is seen and clicked; pages without a kernel."""

import contextlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

import s4a

playwright = pytest.importorskip("playwright.sync_api")
pytest.importorskip("jupyterlab")
widgets = pytest.importorskip("s4a.widgets")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
NOTEBOOK = Path(__file__).parent.parent / "notebooks" / "00_explore.ipynb"
SWITCHES = (
    "--no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic "
    "--disable-background-networking --no-first-run --disable-component-update --disable-sync"
).split()
HARMLESS = ("t.on is not a function", "Unsatisfied version")  # both are JupyterLab's own
VIEW = "canvas.s4a-view"
DRAWN = f"[...document.querySelectorAll('{VIEW}')].some((c) => c.offsetParent && c.view.frames > 0)"
NO_WEBGL = """
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind === "webgl2" ? null : get.call(this, kind, ...rest);
};
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return s4a.analyse(s4a.synthetic.brains(5, 2000, seed=1), n_coarse=500, k=24, k_init=10, store=folder, n_jobs=1)


@pytest.fixture(scope="module")
def folder(study, tmp_path_factory):
    """A folder with the main notebook, in which the study of this test takes the place of the analysis."""
    folder = tmp_path_factory.mktemp("lab")
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    cell = next(c for c in notebook["cells"] if "s4a.analyse" in "".join(c["source"]))
    store = Path(study["coarse/brain_01"].to_dataset().encoding["source"]).parent.parent
    cell["source"] = f"import s4a\n\nstudy = s4a.open_study({str(store)!r})"
    (folder / NOTEBOOK.name).write_text(json.dumps(notebook), encoding="utf-8")
    (folder / "app").mkdir()
    news = {"@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": False}}
    (folder / "app" / "overrides.json").write_text(json.dumps(news), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def lab(folder):
    """The address of a JupyterLab of its own."""
    with contextlib.closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {f"JUPYTER_{name}_DIR": str(folder / name.lower()) for name in ("CONFIG", "DATA", "RUNTIME")}
    options = {
        "ServerApp.port": port,
        "ServerApp.root_dir": folder,
        "ServerApp.open_browser": False,
        "IdentityProvider.token": "",
        "LabApp.app_settings_dir": folder / "app",
    }
    command = [sys.executable, "-m", "jupyterlab", "--allow-root", *(f"--{k}={v}" for k, v in options.items())]
    with open(folder / "lab.log", "w") as log:
        process = subprocess.Popen(
            command, env=os.environ | own | {"IPYTHONDIR": str(folder / "ipython")}, stdout=log, stderr=log
        )
        try:
            wait_for(f"http://127.0.0.1:{port}/api", folder / "lab.log")
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()
            process.wait(20)


def wait_for(address, log, seconds=60):
    for _ in range(4 * seconds):
        with contextlib.suppress(OSError), urllib.request.urlopen(address):
            return
        time.sleep(0.25)
    raise TimeoutError(log.read_text())


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def messages():
    return []


@pytest.fixture(scope="module")
def page(browser, lab, messages):
    """The notebook, after all of its cells ran."""
    page = browser.new_page(viewport={"width": 1280, "height": 1300})
    page.on("console", lambda m: m.type == "error" and messages.append(m.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.goto(f"{lab}/lab/tree/{NOTEBOOK.name}?reset")
    page.wait_for_selector(".jp-Notebook .jp-Cell", timeout=60_000)
    page.wait_for_selector("text=Python 3 (ipykernel) | Idle", timeout=60_000)
    page.get_by_role("menuitem", name="Run", exact=True).click()
    page.get_by_role("menuitem", name="Run All Cells", exact=True).click()
    page.wait_for_function(DRAWN, timeout=60_000)
    page.wait_for_function(
        "[...document.querySelectorAll('.jp-InputPrompt')].every((p) => !p.textContent.includes('*'))"
    )
    return page


def open_tab(page, title):
    page.locator(".jupyter-widgets .lm-TabBar-tabLabel", has_text=title).first.click()
    page.wait_for_function(DRAWN)


def visible(page, selector):
    return page.locator(selector).filter(visible=True)


def pixels(canvas):
    return canvas.evaluate("(c) => { c.view.draw(); return c.toDataURL(); }")


def vertices(canvas):
    return np.array(canvas.evaluate("(c) => Array.from(c.view.surfaces[0].position)"), np.float32).reshape(-1, 3)


def move(slider, value):
    slider.evaluate("(i, v) => { i.value = v; i.dispatchEvent(new Event('input')); }", value)


def check_sliders(page, study):
    """Every slider moves the shape to mean + sum of score times deformation, and other pixels are seen."""
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
        np.testing.assert_allclose(vertices(canvas), expected, rtol=0, atol=4e-7 * np.abs(expected).max())
        assert pixels(canvas) != before
    return scores


def test_every_slider_moves_the_shape_along_its_mode(page, study):
    scores = check_sliders(page, study)
    visible(page, ".s4a-readout").filter(has_text=f"Mahalanobis distance {np.linalg.norm(scores):.2f}").wait_for()


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
    page.wait_for_function(f"[...document.querySelectorAll('{VIEW}')].every((c) => !c.offsetParent || c.view.frames)")
    shown = visible(page, VIEW)
    assert len({pixels(shown.nth(i)) for i in range(3)}) == 3
    turned = shown.nth(2).evaluate("(c) => [...c.view.camera.turn]")
    shown.nth(0).focus()
    page.keyboard.press("ArrowLeft")
    assert shown.nth(2).evaluate("(c) => [...c.view.camera.turn]") != turned, "cameras are linked"
    button.click()


def test_a_clicked_edge_shows_its_map(page, study):
    open_tab(page, "Network")
    edge = visible(page, ".s4a-edge").nth(6)
    source, target = re.match(r"(\w+) → (\w+)", edge.get_attribute("aria-label")).groups()
    edge.dispatch_event("click")
    visible(page, ".s4a-title").filter(has_text=f"{source} → {target}").wait_for()
    visible(page, ".s4a-title").filter(has_text=f"{target}, the target").wait_for()
    net = study["network"].dataset
    C = net["fmap"].values[(net["source"].values == source) & (net["target"].values == target)][0]
    matrix = visible(page, ".s4a-matrix canvas").first
    box = matrix.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 3.5 / len(C), box["y"] + box["height"] * 2.5 / len(C))
    text = visible(page, ".s4a-readout").filter(has_text="C[2, 3]").inner_text()
    assert float(re.search(r"= (\S+)", text)[1]) == pytest.approx(C[2, 3], rel=6e-3)


def test_a_clicked_bar_shows_its_shape(page):
    open_tab(page, "Median")
    bar = visible(page, "rect.s4a-mark").nth(3)
    name = bar.get_attribute("aria-label").split(":")[0]
    bar.click()
    visible(page, ".s4a-title").filter(has_text=f"{name}, in ").wait_for()
    visible(page, ".s4a-readout").filter(has_text="rank 4 of 5").wait_for()


def test_a_clicked_point_is_carried_to_the_shape(page, study):
    open_tab(page, "Correspondence")
    canvas = visible(page, VIEW).first
    box = canvas.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    readout = visible(page, ".s4a-readout").filter(has_text="template vertex").first
    readout.wait_for()
    vertex, shape, image = re.search(r"vertex (\d+) ↔ (\w+) vertex (\d+)", readout.inner_text()).groups()
    assert study["registration"]["registered_match"].sel(shape=shape).values[int(vertex)] == int(image)


def test_a_landmark_is_placed_and_carried_over(page, study):
    open_tab(page, "Transfer")
    canvas = visible(page, VIEW).first
    box, count = canvas.bounding_box(), study["original/brain_01"].sizes["landmark"]
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    visible(page, "td").filter(has_text=f"landmark {count + 1}").wait_for()
    assert visible(page, VIEW).nth(1).evaluate("(c) => c.view.points.length") == count + 1


@pytest.mark.parametrize("title", ["Functional map", "Spectrum"])
def test_the_other_tabs_draw(page, title):
    open_tab(page, title)
    assert visible(page, VIEW).count() == 2


def test_nothing_is_cut_off_at_800_pixels(page):
    page.set_viewport_size({"width": 800, "height": 1300})
    for title in ("Network", "Modes"):
        open_tab(page, title)
        page.wait_for_timeout(300)
        assert visible(page, ".s4a").count() > 0
        for part in visible(page, ".s4a").all():
            assert part.evaluate("(e) => e.scrollWidth <= e.clientWidth + 2")
            assert part.bounding_box()["x"] + part.bounding_box()["width"] <= 800


def test_the_console_has_no_errors(page, messages):
    assert [text for text in messages if not any(known in text for known in HARMLESS)] == []


# ---- without a kernel


@pytest.fixture(scope="module")
def offline(browser):
    context = browser.new_context(offline=True)
    yield context
    context.close()


def opened(context, panel, path):
    panel.save_html(path)
    panel.close()
    page, errors = context.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    return page, errors


def test_the_page_deforms_without_kernel_and_network(offline, study, tmp_path):
    page, errors = opened(offline, widgets.Modes(study), tmp_path / "modes.html")
    page.wait_for_function(DRAWN)
    check_sliders(page, study)
    assert errors == []


def test_other_panels_are_pages_too(offline, study, tmp_path):
    panel = widgets.Network(study)
    panel.edge = 2
    page, errors = opened(offline, panel, tmp_path / "network.html")
    page.wait_for_function(DRAWN)
    assert visible(page, VIEW).count() == 2
    assert errors == []


def test_without_webgl_there_is_a_still_picture(offline, study, tmp_path):
    offline.add_init_script(NO_WEBGL)
    page, errors = opened(offline, widgets.Modes(study), tmp_path / "still.html")
    page.wait_for_function("document.querySelector('img.s4a-still').naturalWidth > 100")
    assert visible(page, "img.s4a-still").count() == 1
    assert visible(page, VIEW).count() == 0
    assert errors == []
