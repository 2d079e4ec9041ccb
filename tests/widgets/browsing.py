"""Selectors and checks of the tests in a browser."""

import contextlib
import json
import time

import numpy as np
import pytest
from paths import NOTEBOOKS, benchmark

axe = pytest.importorskip("axe_playwright_python.sync_playwright")
chromium = benchmark("chromium")
needed = pytest.mark.skipif(chromium.PATH is None, reason=chromium.LACKS)
# JupyterLab's own; the last where cells run while its widget manager asks for all widgets
HARMLESS = ("t.on is not a function", "Unsatisfied version", "widget model not found")
READY = """[...window.jupyterapp.shell.widgets("main")].some(
    (w) => "jupyter.widget" in (w.sessionContext?.session?.kernel?._targetRegistry ?? {}))"""
VIEW = "canvas.s4a-view"
DRAWN = f"[...document.querySelectorAll('{VIEW}')].some((c) => c.offsetParent && c.view.frames > 0)"
SEEN = (
    "[...document.querySelectorAll('canvas.s4a-view')]"
    ".filter((c) => c.offsetParent).map((c) => c.view)"
)
STILLS = (
    "[...document.querySelectorAll('img.s4a-still')]"
    ".filter((i) => i.offsetParent && i.naturalWidth > 100)"
)
IDLE = (
    "[...document.querySelectorAll('.jp-InputPrompt')].every((p) => !p.textContent.includes('*'))"
)
TITLES = ("Modes", "Network", "Functional map", "Median", "Correspondence", "Transfer", "Spectrum")
SMALLEST = """(panel) => {
  const sizes = [], walk = document.createTreeWalker(panel, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const at = walk.currentNode.parentElement, svg = at.ownerSVGElement;
    if (!walk.currentNode.textContent.trim() || !at.getClientRects().length) continue;
    if (at.closest("title, style, script, option")) continue;
    const scale = svg ? svg.getBoundingClientRect().width / svg.viewBox.baseVal.width : 1;
    sizes.push([scale * parseFloat(getComputedStyle(at).fontSize), walk.currentNode.textContent]);
  }
  return sizes.sort((a, b) => a[0] - b[0])[0];
}"""
THEMES = ("JupyterLab Dark", "JupyterLab Dark High Contrast", "JupyterLab Light")
FIELDS = "select, input[type=text], input[type=number]"
NO_TEXTS = "title, style, script, option, :disabled"
CONTRAST = r"""(root, [fields, noTexts]) => {
  const rgba = (text) => {
    const [r, g, b, a = 1] = text.match(/[\d.]+/g).map(Number);
    return [r, g, b, a];
  };
  const over = (top, below) => [0, 1, 2].map((i) => top[3] * top[i] + (1 - top[3]) * below[i]);
  const ground = (at) => {  // of all grounds down to the first that hides what is below
    const layers = [];
    for (; at; at = at.parentElement) {
      layers.push(rgba(getComputedStyle(at).backgroundColor));
      if (layers.at(-1)[3] === 1) break;
    }
    return layers.reverse().reduce((below, layer) => over(layer, below), [255, 255, 255]);
  };
  const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const light = (rgb) => {
    const [r, g, b] = rgb.map((v) => linear(v / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const found = [], walk = document.createTreeWalker(root, NodeFilter.SHOW_ALL);
  while (walk.nextNode()) {
    const node = walk.currentNode, field = node.matches?.(fields);
    const at = field ? node : node.parentElement;
    if (!field && !(node.nodeType === Node.TEXT_NODE && node.textContent.trim())) continue;
    if (!at.getClientRects().length || at.closest(noTexts)) continue;
    const look = getComputedStyle(at), back = ground(at);
    const color = over(rgba(at.ownerSVGElement ? look.fill : look.color), back);
    const [low, high] = [light(color), light(back)].sort((a, b) => a - b);
    found.push([(high + 0.05) / (low + 0.05), node.value ?? node.textContent]);
  }
  return found;
}"""


def watched(page, messages):
    """Return a page that collects its errors, also those of the console."""
    page.on("console", lambda m: m.type == "error" and messages.append(m.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    return page


def serious(messages):
    return [text for text in messages if not any(known in text for known in HARMLESS)]


def run_notebook(page, lab, name):
    """Open a notebook and run all of its cells."""
    page.goto(f"{lab}/lab/tree/{name}?reset")
    page.wait_for_selector(".jp-Notebook .jp-Cell", timeout=120_000)
    page.wait_for_selector("text=Python 3 (ipykernel) | Idle", timeout=120_000)
    page.wait_for_function(READY, timeout=120_000)  # else the first widgets are lost
    page.get_by_role("menuitem", name="Run", exact=True).click()
    page.get_by_role("menuitem", name="Run All Cells", exact=True).click()


def open_tab(page, title):
    page.locator(".jupyter-widgets .lm-TabBar-tabLabel", has_text=title).first.click()
    page.wait_for_function(DRAWN)
    lay_out(page)


def visible(page, selector):
    return page.locator(selector).filter(visible=True)


def pixels(canvas):
    return canvas.evaluate("(c) => { c.view.draw(); return c.toDataURL(); }")


def lay_out(page):
    """Let two frames pass, in which charts follow the width."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def settled(page, check, act=lambda: None, seconds=30):
    """Return the result of a check once it holds; repeat an action that a busy browser may lose.

    A check that is False or raises an AssertionError is asked again.
    """
    end = time.monotonic() + seconds
    while True:
        act()
        for _ in range(10):
            late = time.monotonic() > end
            try:
                if (found := check()) is None or found:
                    return found
                assert not late, "it never holds"
            except AssertionError:
                if late:
                    raise
            page.wait_for_timeout(50)


def redrawn(canvas, before):
    """Return the pixels of a view once they have changed and are stable."""
    seen = [before]

    def rests():
        seen.append(pixels(canvas))
        return seen[-1] == seen[-2] != before

    settled(canvas.page, rests)
    return seen[-1]


def vertices(canvas):
    return np.array(
        canvas.evaluate("(c) => Array.from(c.view.surfaces[0].position)"), np.float32
    ).reshape(-1, 3)


def move(slider, value):
    slider.evaluate("(i, v) => { i.value = v; i.dispatchEvent(new Event('input')); }", value)


def cursor(canvas, *keys):
    """Start the cursor on a view and press keys; return its vertex."""
    canvas.focus()
    for key in ("c", *keys):
        canvas.press(key)
    return int(canvas.get_attribute("data-cursor"))


def barriers(page, context=None):
    """Return the serious and critical findings of axe: rule, element and reason."""
    options = {"resultTypes": ["violations"]}  # of what passes, no elements are gathered
    found = axe.Axe().run(page, context, options).response["violations"]
    return [
        (rule["id"], node["html"], node["failureSummary"])
        for rule in found
        if rule["impact"] in ("serious", "critical")
        for node in rule["nodes"]
    ]


def change_theme(page, theme):
    """Select a theme of JupyterLab, and wait until it is applied."""
    page.evaluate(
        "(theme) => jupyterapp.commands.execute('apputils:change-theme', { theme })", theme
    )
    page.wait_for_function(
        "(theme) => document.body.dataset.jpThemeName === theme"
        " && !document.getElementById('jupyterlab-splash')",
        arg=theme,
    )


@contextlib.contextmanager
def themed(page, theme):
    """Show the page in a theme of JupyterLab, and restore the light theme afterwards."""
    try:
        change_theme(page, theme)
        yield
    finally:
        change_theme(page, THEMES[-1])


def contrasts(part):
    """Return contrast and text of all texts in a part of a page."""
    return part.evaluate(CONTRAST, [FIELDS, NO_TEXTS])


def faint(part):
    """Return the number of texts in a part of a page, and the texts with too little contrast."""
    found = contrasts(part)
    return len(found), [(round(ratio, 1), text) for ratio, text in found if ratio < 4.5]


def chosen(page, control, label):
    """Select a value of a control of a page."""
    page.locator(f"#c-{control}").select_option(label)


def notebooks(folder, **cells):
    """Write notebooks with some cells of code, by name, into the folder of a JupyterLab."""
    first = json.loads((NOTEBOOKS / "00_explore.ipynb").read_text(encoding="utf-8"))
    cell = next(c for c in first["cells"] if c["cell_type"] == "code")
    for name, sources in cells.items():
        made = [cell | {"source": text, "id": f"cell{i}"} for i, text in enumerate(sources)]
        content = json.dumps(first | {"cells": made})
        (folder / f"{name}.ipynb").write_text(content, encoding="utf-8")
    (folder / "app").mkdir(exist_ok=True)
    news = {"fetchNews": "false", "checkForUpdates": False}
    settings = json.dumps({"@jupyterlab/apputils-extension:notification": news})
    (folder / "app" / "overrides.json").write_text(settings, encoding="utf-8")
    return folder


def check_read(panel, least, width=None):
    """Check that the smallest text of a panel has enough pixels, and nothing is cut off."""
    lay_out(panel.page)
    settled(panel.page, lambda: assert_read(panel, least, width))


def assert_read(panel, least, width):
    smallest, text = panel.evaluate(SMALLEST)
    assert smallest >= least, text
    if width is None:
        assert panel.bounding_box()["width"] >= 1500
        return
    assert panel.bounding_box()["width"] <= width
    for canvas in panel.locator(VIEW).filter(visible=True).all():
        assert canvas.bounding_box()["width"] >= 300
    assert panel.evaluate("(e) => e.scrollWidth <= e.clientWidth + 2"), "nothing is cut off"


def check_barriers(page, part):
    """Check that axe finds nothing serious in a part of a page."""
    part.evaluate("(e) => (e.id = 'looked-at')")
    assert barriers(page, "#looked-at") == []
    part.evaluate("(e) => e.removeAttribute('id')")


def check_themes(page, theme, parts, least):
    """Check the contrast of every text of the `parts` (by name) in a theme."""
    with themed(page, theme):
        for name, make in parts.items():
            part = make()
            n, unread = faint(part)
            assert n > least
            assert unread == [], name
            if theme == "JupyterLab Dark":
                check_barriers(page, part)
