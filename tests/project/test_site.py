"""The documentation as it is built, and in Chromium: accessible, searchable, and not too wide.

What notebooks show there without a kernel, and the slides of the lecture.
"""

import os
import re
import subprocess
import sys

import pytest
from paths import DOCS, NOTEBOOKS, ROOT, benchmark, script

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")
for needed in ("furo", "latex2mathml", "myst_nb", "nbconvert", "sphinx"):
    pytest.importorskip(needed)
slides = script(DOCS / "slides.py")
FAULTS_ONLY = {"resultTypes": ["violations"]}  # of what passes, axe gathers no elements
COLORS_ONLY = FAULTS_ONLY | {"runOnly": ["color-contrast"]}  # all that another scheme changes
# without what takes seconds and changes no warning: the grammar of addresses that jsonschema would
# make, the search of the code for docstrings of attributes, of which there are none, and the search
# for garbage among the nodes of all pages, a quarter of the time
SPHINX = """import gc, sys
gc.disable()
sys.modules["rfc3987_syntax"] = None
from sphinx import pycode
from sphinx.cmd.build import main

def analyze(self):
    raise pycode.PycodeError("not analysed")

pycode.ModuleAnalyzer.analyze = analyze
sys.exit(main(sys.argv[1:]))"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the pages, built without running the lessons."""
    out = tmp_path_factory.mktemp("site")
    options = ["-q", "-W", "--keep-going", "-b", "html", "-d", str(out / "doctrees")]
    command = [sys.executable, "-c", SPHINX, *options, str(DOCS), str(out / "html")]
    env = os.environ | {"S4A_DOCS": "off"}
    run = {"env": env, "cwd": ROOT, "capture_output": True, "text": True, "check": False}
    found = subprocess.run(command, **run)
    assert found.returncode == 0, found.stderr  # a warning is an error
    return out / "html"


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = benchmark("chromium")
    if chromium.PATH is None:
        pytest.skip(chromium.LACKS)
    with playwright.sync_playwright() as driver:
        browser = chromium.launched(driver)
        yield browser
        browser.close()


def test_it_builds_without_a_warning_fetches_nothing_and_names_no_page_twice(site):
    for name in ("index", "glossary"):
        page = (site / f"{name}.html").read_text("utf-8")
        assert not re.search(r"(src|href)=\"https?://[^\"]+\.(js|css)\"", page)
    page = (site / "index.html").read_text("utf-8")
    names = re.findall(r'<li class="toctree-l1[^>]*><a [^>]*>([^<]*)</a>', page)
    assert len(set(names)) == len(names) > 10


def test_pages_have_nothing_serious_for_axe_fit_their_window_and_are_found(site, browser):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    window = browser.new_page(viewport={"width": 800, "height": 700})
    bad = []
    for name in ("index", "method", "claims", "comparison", "api/maps", "course/02_laplacian"):
        window.goto((site / f"{name}.html").as_uri())
        for width in (800, 1280, 1440):
            window.set_viewport_size({"width": width, "height": 700})
            scrolled = window.evaluate("document.documentElement.scrollWidth")
            bad += [(name, width, scrolled)] if scrolled > width else []
        for scheme, options in {"light": FAULTS_ONLY, "dark": COLORS_ONLY}.items():
            window.emulate_media(color_scheme=scheme)
            found = axe.Axe().run(window, options=options).response["violations"]
            bad += [
                (name, scheme, v["id"]) for v in found if v["impact"] in ("serious", "critical")
            ]
    assert bad == []
    window.goto((site / "search.html").as_uri() + "?q=fmap_from_match")
    window.wait_for_selector("#search-results li", timeout=60_000)
    first = window.locator("#search-results li a").first
    assert "s4a.method.fmap.fmap_from_match" in first.get_attribute("href")


def shown(cells, folder):
    """The HTML that the documentation shows of notebook cells, in the order of their outputs."""
    cells = [slides.WITHOUT_KERNEL, *cells]
    notebook = nbformat.v4.new_notebook(cells=[*map(nbformat.v4.new_code_cell, cells)])
    resources = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()
    outputs = [part for cell in notebook.cells for part in cell.outputs if part.get("data")]
    return [part["data"].get("text/html", "") for part in outputs]


NAMES = "drawn = pictured = framed = html_of = tubes = templates = render = None"
SMALL = """import s4a
from s4a.show import panel_page
panel_page.N_VALUES = 3  # recorded values of a slider
study = s4a.open_study({study!r})"""
SCENE = (
    "from s4a.widgets import threejs\nthreejs.renderer(threejs.surface(study['original/brain_01']))"
)
SLOW = ("Functional map", "Median", "Correspondence", "Transfer", "Spectrum")  # to record
EXPLORE = f"""panels = s4a.widgets.explore.PANELS
for title in {SLOW}: del panels[title]
s4a.explore(study)"""
AS_TALL = """() => {
  const frame = document.querySelector("iframe.panel");
  const spare = frame.clientHeight - frame.contentDocument.documentElement.offsetHeight;
  return 0 <= spare && spare < 50;
}"""
HEAD = '<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,"><title>page</title>'


def test_panels_of_a_page_work_without_a_kernel_and_are_as_tall_as_what_is_in_them(
    browser, study_folder, tmp_path
):
    offline = benchmark("offline")
    # a cell may use the names of what shows panels
    small = SMALL.format(study=str(study_folder))
    *scene, median, panels = shown(
        [NAMES, small, SCENE, "s4a.widgets.Median(study)", EXPLORE], tmp_path
    )
    assert any("A scene" in part for part in scene)
    (tmp_path / "page.html").write_text(f"{HEAD}{panels}", encoding="utf-8")
    with offline.served(tmp_path) as base:
        size, errors, hosts, found = offline.looked_at(browser, base, "page.html")
    assert size < offline.MOST
    assert errors == hosts == []
    assert found == {"Modes": "", "Network": ""}  # nothing is wrong with them
    (tmp_path / "page.html").write_text(f"{HEAD}{median}", encoding="utf-8")
    page = browser.new_page(viewport={"width": 1000, "height": 800})
    page.goto((tmp_path / "page.html").as_uri())
    page.frame_locator("iframe.panel").locator("canvas.s4a-view").first.wait_for()
    for width in (1000, 500):
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_function(AS_TALL)  # nothing of it scrolls, and nothing is empty
    page.close()


def test_each_heading_of_a_lecture_begins_a_slide_without_exercises():
    for lesson in slides.LECTURE:
        (path,) = NOTEBOOKS.glob(f"{lesson}_*.ipynb")
        notebook = slides.as_slides(nbformat.read(path, as_version=4))
        kinds = [cell.metadata["slideshow"]["slide_type"] for cell in notebook.cells]
        for cell, kind in zip(notebook.cells, kinds, strict=True):
            assert (kind == "slide") == (cell.cell_type == "markdown" and cell.source[0] == "#")
            assert not re.search(r"answer = \.\.\.|Solution", cell.source)
        page = slides.page(notebook, "lesson", reveal="here/reveal.js")
        assert len(re.findall(r"<h[12] id", page)) == kinds.count("slide") >= 2
        assert page.count("<section>") == 2 * kinds.count("slide") + kinds.count("subslide")
        assert "plt.rcParams" not in page, "what sets up a notebook is not shown"
