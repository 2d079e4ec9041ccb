"""What the panels cost: bytes per interaction, time to the first picture, time per step, at 6k.

30k and 100k vertices.

Bytes and Python's time are those of one step in a notebook, counted where the widgets hand their
messages over.  The first picture is that of the panel's page in Chromium with a software renderer,
opened without a kernel, and a frame is one drawing of all its surfaces from scratch, their arrays
uploaded again.
"""

import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from comm import DummyComm

import s4a
from s4a import widgets

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
SWITCHES = [
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
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
    "Python (ms)",
    "frame (ms)",
    "first picture (s)",
    "page (MB)",
)


class Count:
    """Bytes of all messages that widgets send."""

    def __init__(self):
        self.bytes = 0
        DummyComm.publish_msg = self.publish

    def publish(self, kind, data=None, metadata=None, buffers=None, **keys):
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


def measure(study, browser, count, folder):
    """A row for each panel."""
    size = max(node.sizes["vertex"] for node in study["original"].children.values())
    for name, step in STEP.items():
        panel = getattr(widgets, name)(study)
        step(panel, STEPS)
        before, start = count.bytes, time.process_time()
        for i in range(STEPS):
            step(panel, i)
        python = (time.process_time() - start) / STEPS
        sent = (count.bytes - before) / STEPS
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
        tab.close()
        yield (
            name,
            f"{size:,}",
            f"{sent:,.0f}",
            f"{1000 * python:.0f}",
            f"{frame:.0f}",
            f"{first:.1f}",
            f"{path.stat().st_size / 1e6:.1f}",
        )


def main():
    if CHROMIUM is None:
        sys.stdout.write("skipped: Chromium is not installed\n")
        return
    from playwright.sync_api import sync_playwright

    count = Count()
    sys.stdout.write("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|\n")
    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        for size in SIZES:
            study = s4a.analyse(s4a.synthetic.brains(3, size, seed=0), n_jobs=-1)
            for row in measure(study, browser, count, folder):
                sys.stdout.write("| " + " | ".join(row) + " |\n")
                sys.stdout.flush()
        browser.close()


if __name__ == "__main__":
    main()
