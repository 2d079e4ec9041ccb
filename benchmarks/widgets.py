"""What the panels cost, and how they fill a window.

    python benchmarks/widgets.py [VERTICES ...]

at 6,000, 30,000 and 100,000 vertices if none are given.  Bytes, messages and Python's time are
those of one step in a notebook, counted where the widgets hand their messages over; told is what
the browser tells the kernel while the pointer goes over 45 places.  The first picture is that of
the panel's page in Chromium with a software renderer, opened without a kernel, and a frame is one
drawing of all its surfaces from scratch, their arrays uploaded again; a slider is one step of a
mode with its frame.

The second table has the width of the panel and of its narrowest surface, its height and the
smallest text, in pixels, in windows of four widths.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import chromium
import numpy as np
from comm import DummyComm
from playwright.sync_api import sync_playwright

import s4a
from s4a import widgets

SIZES = (6_000, 30_000, 100_000)
STEPS = 6
VIEWS = (
    "[...document.querySelectorAll('canvas.s4a-view')]"
    ".filter((c) => c.offsetParent).map((c) => c.view)"
)
FRAME = f"""() => {{
  const views = {VIEWS}, start = performance.now();
  views.forEach((view) => {{
    view.surfaces.forEach((surface) => {{ surface.stale = true; surface.sent = null; }});
    view.draw();
    view.canvas.getContext("2d").getImageData(0, 0, 1, 1);
  }});
  return performance.now() - start;
}}"""
COLUMNS = (
    "panel",
    "vertices",
    "bytes a step",
    "messages a step",
    "told in 45 hovers",
    "Python (ms)",
    "frame (ms)",
    "slider (ms)",
    "first picture (s)",
    "page (MB)",
)


SLIDER = f"""(step) => {{
  const input = document.querySelector(".s4a-slider input");
  if (!input) return null;
  const views = {VIEWS}, start = performance.now();
  input.value = step / 4;
  input.dispatchEvent(new Event("input"));
  views.forEach((view) => {{
    view.draw();
    view.canvas.getContext("2d").getImageData(0, 0, 1, 1);
  }});
  return performance.now() - start;
}}"""
TOLD = """() => {
  window.told = 0;
  Object.values(s4aModels).forEach((model) => { model.save_changes = () => window.told++; });
}"""
LOOK = """() => {
  const panel = document.getElementById("w0"), box = panel.getBoundingClientRect();
  const seen = (at) => at.getClientRects().length > 0;
  const views = [...panel.querySelectorAll("canvas.s4a-view")].filter(seen);
  const walk = document.createTreeWalker(panel, NodeFilter.SHOW_TEXT);
  let smallest = Infinity;
  while (walk.nextNode()) {
    const at = walk.currentNode.parentElement, svg = at.ownerSVGElement;
    if (!walk.currentNode.textContent.trim() || !seen(at)) continue;
    if (at.closest("title, style, script, option")) continue;
    const scale = svg ? svg.getBoundingClientRect().width / svg.viewBox.baseVal.width : 1;
    smallest = Math.min(smallest, scale * parseFloat(getComputedStyle(at).fontSize));
  }
  const narrowest = Math.min(...views.map((view) => view.getBoundingClientRect().width));
  return [box.width, narrowest, box.height, smallest];
}"""
WINDOWS = ((360, 800), (800, 700), (1366, 680), (1920, 1080))


class Count:
    """Bytes of all messages that widgets send, and how many."""

    def __init__(self):
        self.bytes = self.messages = 0
        DummyComm.publish_msg = self.publish

    def publish(self, kind, data=None, metadata=None, buffers=None, **keys):
        self.messages += 1
        self.bytes += len(json.dumps(data)) + sum(memoryview(b).nbytes for b in buffers or ())


def place(panel, i):
    """A place of the first surface, as the browser tells it."""
    vertex = 1 + i % (len(panel.scenes[0].surface[0]) - 1)
    return {"vertex": vertex, "face": i, "weights": [1.0, 0.0, 0.0], "count": i + 1}


STEP = {  # what the user does, for the i-th time
    "Modes": lambda panel, i: panel.view.set_trait("scores", [0.1 * (i + 1)] * len(panel.scores)),
    "Network": lambda panel, i: panel.graph.set_trait(
        "picked", {"edge": i % len(panel.source), "count": i + 1}
    ),
    "FunctionalMap": lambda panel, i: panel.matrix.set_trait(
        "picked", {"row": i + 2, "column": i + 3}
    ),
    "Median": lambda panel, i: panel.select(panel.names[i % len(panel.names)]),
    "Correspondence": lambda panel, i: panel.scenes[0].set_trait("hovered", place(panel, i)),
    "Transfer": lambda panel, i: panel.scenes[0].set_trait("picked", place(panel, i)),
    "Spectrum": lambda panel, i: setattr(panel.mode, "value", i + 2),
}


def hovers(tab):
    """How often the browser tells the kernel of 45 places under the pointer."""
    tab.evaluate(TOLD)
    box = tab.locator("canvas.s4a-view >> visible=true").first.bounding_box()
    for i in range(45):
        tab.mouse.move(box["x"] + box["width"] * (0.3 + i / 110), box["y"] + box["height"] / 2)
        tab.wait_for_timeout(20)
    tab.wait_for_timeout(200)
    return tab.evaluate("window.told")


def window(tab, width, height):
    """Widths of panel and narrowest surface, height, and smallest text, in a window."""
    tab.set_viewport_size({"width": width, "height": height})
    tab.wait_for_timeout(300)
    return tab.evaluate(LOOK)


def measure(study, browser, count, folder, looks):
    """A row for each panel; `looks` gets how each fills the windows."""
    size = max(node.sizes["vertex"] for node in study["original"].children.values())
    for name, step in STEP.items():
        panel = getattr(widgets, name)(study)
        step(panel, STEPS)
        before, messages, start = count.bytes, count.messages, time.process_time()
        for i in range(STEPS):
            step(panel, i)
        python = (time.process_time() - start) / STEPS
        sent, times = (count.bytes - before) / STEPS, (count.messages - messages) / STEPS
        path = panel.save_html(Path(folder) / f"{name}.html")
        panel.close()
        tab = browser.new_page(viewport={"width": 1280, "height": 1000})
        start = time.monotonic()
        tab.goto(path.as_uri())
        tab.wait_for_function(
            f"{VIEWS}.length && {VIEWS}.every((view) => view.frames > 0)", timeout=120_000
        )
        first = time.monotonic() - start
        frame = np.median([tab.evaluate(FRAME) for _ in range(STEPS)])
        slides = [tab.evaluate(SLIDER, i) for i in range(1, STEPS + 1)]
        told = hovers(tab)
        looks[name] = [window(tab, *size) for size in WINDOWS]
        tab.close()
        yield (
            name,
            f"{size:,}",
            f"{sent:,.0f}",
            f"{times:.1f}",
            str(told),
            f"{1000 * python:.0f}",
            f"{frame:.0f}",
            "" if None in slides else f"{np.median(slides):.0f}",
            f"{first:.1f}",
            f"{path.stat().st_size / 1e6:.1f}",
        )


def main():
    if chromium.PATH is None:
        sys.stdout.write(f"skipped: {chromium.LACKS}\n")
        return
    sizes, looks = [int(size) for size in sys.argv[1:]] or SIZES, {}
    count = Count()
    sys.stdout.write("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|\n")
    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        browser = chromium.launched(driver)
        for size in sizes:
            study = s4a.analyse(s4a.synthetic.brains(3, size, seed=0), n_jobs=-1)
            for row in measure(study, browser, count, folder, looks):
                sys.stdout.write("| " + " | ".join(row) + " |\n")
                sys.stdout.flush()
        browser.close()
    heads = ["panel", *(f"{width} x {height}" for width, height in WINDOWS)]
    sys.stdout.write("\n| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|\n")
    for name, found in looks.items():
        cells = ["{:.0f}, {:.0f}, {:.0f}, {:.1f}".format(*look) for look in found]
        sys.stdout.write("| " + " | ".join([name, *cells]) + " |\n")


if __name__ == "__main__":
    main()
