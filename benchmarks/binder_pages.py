"""What a student sees on Binder, in Chromium: lesson 00 in JupyterLab, and the page of the sliders.

    python benchmarks/binder_pages.py [--pictures FOLDER]

Started in a clone, as ``binder/try.sh`` does: one JupyterLab serves both addresses of the buttons
in the README. Looked at is whether every cell has run without an error, whether the surface is
drawn, and whether a slider deforms it; seconds are of the wall clock. It ends with 1 where one
does not hold.
"""

import argparse
import sys
import time
from pathlib import Path

import chromium
from frontends import DRAWN, HARMLESS, MOVE, SHOT, served, waited
from playwright.sync_api import sync_playwright

COURSE, SLIDERS = "lab/tree/notebooks/00_explore.ipynb", "voila/render/binder/pca.ipynb"
RUN = "void window.jupyterapp.commands.execute('notebook:run-all-cells')"
# code cells: how many, how many have run, what they said of errors, which one has the panel; an
# exercise without an answer may raise
CELLS = """() => {
  const cells = window.jupyterapp.shell.currentWidget.content.widgets
    .map((cell, i) => ({i, ...cell.model.toJSON(), n: cell.model.executionCount}))
    .filter((cell) => cell.cell_type === "code");
  const failed = cells.filter((cell) => !(cell.metadata.tags || []).includes("raises-exception"))
    .flatMap((cell) => cell.outputs).filter((output) => output.output_type === "error");
  return {
    cells: cells.length, run: cells.filter((cell) => cell.n).length,
    errors: failed.map((output) => output.ename + ": " + output.evalue),
    panel: cells.find((cell) => [cell.source].flat().join("").includes(".explore(")).i,
  };
}"""
SHOW = "(i) => window.jupyterapp.shell.currentWidget.content.scrollToItem(i, 'start')"


def moves(page):
    """Whether the first surface is drawn, and a slider deforms it."""
    canvas = page.locator("canvas.s4a-view").first
    canvas.wait_for(state="attached")
    if not waited(page, lambda: canvas.evaluate(DRAWN)):
        return False
    before = canvas.evaluate(SHOT)
    canvas.scroll_into_view_if_needed()
    page.locator(".s4a-slider input").first.evaluate(MOVE)
    return waited(page, lambda: canvas.evaluate(SHOT) != before)


def opened(browser, address):
    """A page, and the list that gets what it says of errors."""
    page, messages = browser.new_page(viewport={"width": 1366, "height": 768}), []
    page.set_default_timeout(180_000)
    page.on("console", lambda m: m.type == "error" and messages.append(m.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.goto(address)
    return page, messages


def lesson(browser, address):
    """Run all cells of lesson 00 in JupyterLab: the page, and what does not hold."""
    page, messages = opened(browser, address + COURSE)
    page.wait_for_selector(".jp-Cell")
    ready = "!!window.jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel"
    page.wait_for_function(ready)
    page.wait_for_timeout(3000)
    page.evaluate(RUN)
    waited(page, lambda: (found := page.evaluate(CELLS))["run"] == found["cells"], 300)
    found = page.evaluate(CELLS)
    faults = list(found["errors"])
    if found["run"] < found["cells"]:
        faults.append(f"{found['run']} of {found['cells']} cells have run")
    page.evaluate(SHOW, found["panel"])
    if not moves(page):
        faults.append("its panel shows no surface that a slider deforms")
    return page, faults + messages


def sliders(browser, address):
    """The page of the sliders by Voila: the page, and what does not hold."""
    page, messages = opened(browser, address + SLIDERS)
    faults = [] if moves(page) else ["it shows no surface that a slider deforms"]
    return page, faults + messages


def main(pictures):
    if chromium.PATH is None:
        sys.exit(chromium.LACKS)
    faults = {}
    with sync_playwright() as driver, served("jupyterlab", Path(), "") as address:
        browser = chromium.launched(driver)
        for name, look in (("lesson 00 in JupyterLab", lesson), ("sliders by Voila", sliders)):
            begin = time.monotonic()
            page, said = look(browser, address)
            faults[name] = [one for one in said if not any(h in one for h in HARMLESS)]
            held = "; ".join(faults[name]) or "a slider deforms the surface"
            sys.stdout.write(f"{name:32}{time.monotonic() - begin:8.0f} s  {held}\n")
            if pictures:
                pictures.mkdir(parents=True, exist_ok=True)
                page.screenshot(path=pictures / f"{name.replace(' ', '_')}.png")
            page.close()
        browser.close()
    return int(any(faults.values()))


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--pictures", type=Path, metavar="FOLDER", help="screenshots, as PNG")
    sys.exit(main(options.parse_args().pictures))
