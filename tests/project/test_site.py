"""The documentation as it is built, and in Chromium: accessible, searchable, and not too wide."""

import re

import pytest
from paths import DOCS, benchmark, script


def test_it_builds_without_a_warning(site):
    found, pages = site
    assert found.returncode == 0, found.stderr
    assert not re.search(
        r"(src|href)=\"https?://[^\"]+\.(js|css)\"",
        (pages / "glossary.html").read_text("utf-8"),
    )


def test_no_name_stands_twice_in_the_contents(site):
    text = (site[1] / "index.html").read_text("utf-8")
    names = re.findall(r'<li class="toctree-l1[^>]*><a [^>]*>([^<]*)</a>', text)
    assert "Every table, as it was printed" in names
    assert len(set(names)) == len(names)


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


@pytest.fixture(scope="module")
def window(site, browser):
    """A browser window for the pages; nothing is fetched."""
    return browser.new_page(viewport={"width": 800, "height": 700})


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious_on_the_pages(site, window, scheme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    window.emulate_media(color_scheme=scheme)
    for name in ("index", "method", "claims", "comparison", "citing", "course/02_laplacian"):
        window.goto((site[1] / f"{name}.html").as_uri())
        found = axe.Axe().run(window).response["violations"]
        bad = [v["id"] for v in found if v["impact"] in ("serious", "critical")]
        assert bad == [], name


def test_the_search_finds_functions_by_their_names(site, window):
    window.goto((site[1] / "search.html").as_uri() + "?q=fmap_from_match")
    window.wait_for_selector("#search-results li", timeout=60_000)
    first = window.locator("#search-results li a").first
    assert "s4a.method.fmap.fmap_from_match" in first.get_attribute("href")


def test_no_page_is_wider_than_a_narrow_window(site, window):
    for name in ("index", "method", "comparison", "api/maps"):
        window.goto((site[1] / f"{name}.html").as_uri())
        assert window.evaluate("document.documentElement.scrollWidth") <= 800, name


def shown(cells, folder):
    """The HTML that the documentation shows of notebook cells, in the order of their outputs."""
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    pytest.importorskip("nbconvert")
    cells = [script(DOCS / "slides.py").WITHOUT_KERNEL, *cells]
    notebook = nbformat.v4.new_notebook(cells=[*map(nbformat.v4.new_code_cell, cells)])
    resources = {"metadata": {"path": str(folder)}}
    client.NotebookClient(notebook, timeout=300, resources=resources).execute()
    outputs = [part for cell in notebook.cells for part in cell.outputs if part.get("data")]
    return [part["data"].get("text/html", "") for part in outputs]


STRUCTURES = """
from s4a_morphometrics.synthetic import example_structures
import s4a; s4a.explore(example_structures())
"""
SMALL = """
import s4a
study = s4a.synthetic.example_study()
"""
SLOW = ("Functional map", "Median", "Correspondence", "Transfer", "Spectrum")  # to record


def test_a_cell_may_use_the_names_of_what_shows_panels(tmp_path):
    names = "drawn = pictured = framed = html_of = tubes = templates = render = None"
    scene = "threejs.renderer(threejs.surface(study['original/brain_01']))"
    scene = f"from s4a.widgets import threejs; {scene}"
    html = shown([names, SMALL, scene], tmp_path)
    assert any("A scene" in part for part in html)


def test_a_page_shows_the_first_panel_of_a_study_that_has_no_modes(tmp_path):
    html = shown([STRUCTURES], tmp_path)
    assert any('class="panel"' in part and 'title="Structures"' in part for part in html)


def test_two_panels_of_a_page_work_without_a_kernel_and_from_plain_files(browser, tmp_path):
    offline = benchmark("offline")
    two = f"panels = s4a.widgets.explore.PANELS\nfor title in {SLOW}: del panels[title]"
    parts = shown([SMALL, two, "s4a.explore(study)"], tmp_path)
    (html,) = [part for part in parts if 'class="panel"' in part]
    head = '<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,"><title>page</title>'
    (tmp_path / "page.html").write_text(f"{head}{html}", encoding="utf-8")
    with offline.served(tmp_path) as base:
        size, errors, hosts, panels = offline.looked_at(browser, base, "page.html")
    assert size < offline.MOST
    assert errors == hosts == []
    assert panels == {"Modes": "", "Network": ""}  # nothing is wrong with them


def test_a_panel_is_as_tall_as_what_is_in_it(browser, tmp_path):
    (html,) = shown([SMALL, "s4a.widgets.Median(study)"], tmp_path)
    path = tmp_path / "page.html"
    path.write_text(f"<!DOCTYPE html><title>page</title>{html}", encoding="utf-8")
    page = browser.new_page(viewport={"width": 1000, "height": 800})
    page.goto(path.as_uri())
    page.frame_locator("iframe.panel").locator("canvas.s4a-view").first.wait_for()
    page.wait_for_timeout(500)
    for width in (1000, 500):
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_timeout(300)
        tall = page.locator("iframe.panel").evaluate(
            "(e) => e.clientHeight - e.contentDocument.documentElement.offsetHeight"
        )
        assert 0 <= tall < 50, "nothing of it scrolls, and nothing is empty"
    page.close()


@pytest.mark.parametrize("width", [1280, 1366, 1440, 1600])
def test_text_and_contents_stand_beside_each_other_in_a_wide_window(site, window, width):
    narrow = window.viewport_size
    window.set_viewport_size({"width": width, "height": 700})
    window.goto((site[1] / "course/02_laplacian.html").as_uri())
    assert window.evaluate("document.documentElement.scrollWidth") <= width
    window.set_viewport_size(narrow)
