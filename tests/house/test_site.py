"""The built documentation in Chromium: accessible, searchable, and not too wide."""

import pytest
from paths import DOCS, benchmark


@pytest.fixture(scope="module")
def window(site):
    """A browser window for the pages; nothing is fetched."""
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = benchmark("chromium")
    if chromium.PATH is None:
        pytest.skip(chromium.LACKS)
    with playwright.sync_playwright() as driver:
        browser = chromium.launched(driver)
        yield browser.new_page(viewport={"width": 800, "height": 700})
        browser.close()


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


def test_a_page_shows_the_first_panel_of_a_study_that_has_no_modes(tmp_path):
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    cells = [
        (DOCS / "without_kernel.py").read_text(encoding="utf-8"),
        "from s4a.datasets.structures import example_structures",
        "import s4a; s4a.explore(example_structures())",
    ]
    notebook = nbformat.v4.new_notebook(cells=[*map(nbformat.v4.new_code_cell, cells)])
    resources = {"metadata": {"path": str(tmp_path)}}
    client.NotebookClient(notebook, timeout=300, resources=resources).execute()
    shown = [
        part["data"].get("text/html", "") for part in notebook.cells[-1].outputs if part.get("data")
    ]
    assert any('class="panel"' in html and 'title="Structures"' in html for html in shown)
