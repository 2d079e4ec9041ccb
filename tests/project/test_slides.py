"""Slides made from the notebooks: what begins one, and what is left out."""

import re

import pytest
from paths import DOCS, NOTEBOOKS, ROOT, script

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
pytest.importorskip("nbconvert")

slides = script(DOCS / "slides.py")


def deck(lesson):
    (path,) = NOTEBOOKS.glob(f"{lesson}_*.ipynb")
    return slides.as_slides(nbformat.read(path, as_version=4))


@pytest.mark.parametrize("lesson", slides.LECTURE)
def test_each_heading_begins_a_slide_and_no_exercise_is_among_them(lesson):
    notebook = deck(lesson)
    for cell in notebook.cells:
        kind = cell.metadata["slideshow"]["slide_type"]
        assert (kind == "slide") == (cell.cell_type == "markdown" and cell.source[0] == "#")
        assert "answer = ..." not in cell.source
        assert "Solution" not in cell.source
    page = slides.page(notebook, "lesson", reveal="here/reveal.js")
    kinds = [cell.metadata["slideshow"]["slide_type"] for cell in notebook.cells]
    assert len(re.findall(r"<h[12] id", page)) == kinds.count("slide") >= 2
    assert page.count("<section>") == 2 * kinds.count("slide") + kinds.count("subslide")
    assert 'href="here/reveal.js' in page
    assert "plt.rcParams" not in page, "what sets up a notebook is not shown"


def test_a_slide_has_the_outputs_and_no_widget_that_needs_a_kernel():
    cells = ["# One", "import ipywidgets\nipywidgets.HTML('<b>seen</b>')"]
    kinds = (nbformat.v4.new_markdown_cell, nbformat.v4.new_code_cell)
    notebook = nbformat.v4.new_notebook(
        cells=[kind(source) for kind, source in zip(kinds, cells, strict=True)]
    )
    page = slides.page(slides.executed(slides.as_slides(notebook)), "one")
    assert "<b>seen</b>" in page
    assert "widget-view" not in page


def test_make_slides_makes_them():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "\nslides: $(VENV)/.docs\n\t$(BIN)/python docs/slides.py\n" in makefile
