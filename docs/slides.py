"""Slides of a lecture, made from the notebooks: ``make slides``, ``python docs/slides.py 02 05``.

Each notebook is run, and becomes one page of reveal.js in ``docs/_build/slides``: a heading begins
a slide, what follows stands below it, long code and the exercises are left out.  Panels and sliders
move without a kernel, as in the documentation.  reveal.js comes from the network; a copy of it can
be named: ``--reveal reveal.js``.
"""

import argparse
import sys
from pathlib import Path

import nbclient
import nbformat
from nbconvert import SlidesExporter

DOCS = Path(__file__).resolve().parent
NOTEBOOKS = DOCS.parent / "notebooks"
MORE = DOCS.parent / "morphometrics" / "notebooks"
# First cell of a notebook, in its own namespace, so that no cell hides its names:
# panels are shown as pages, and sliders for some of their values.
WITHOUT_KERNEL = f"exec({(DOCS / 'without_kernel.py').read_text(encoding='utf-8')!r}, {{}})"
LECTURE = ("00", "04", "09")  # 45 minutes
SHORT = 8  # lines of code, at most, that a slide shows


def as_slides(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Return the notebook with the shown cells, each with its kind of slide."""
    shown, in_exercises = [], False
    for cell in notebook.cells:
        heading = cell.cell_type == "markdown" and cell.source.startswith("#")
        if heading:
            in_exercises = cell.source.startswith("## Exercises")
        if in_exercises or cell.source.startswith("<details>"):
            continue
        kind = "-"
        if heading:
            kind = "slide"
        elif cell.cell_type == "markdown":
            kind = "subslide"
        cell.metadata["slideshow"] = {"slide_type": kind}
        if cell.cell_type == "code":
            set_up = cell.source.startswith("%matplotlib")
            if set_up or len(cell.source.splitlines()) > SHORT:
                cell.metadata["transient"] = {"remove_source": True}
        shown.append(cell)
    notebook.cells = shown
    return notebook


def executed(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Run a notebook; outputs of panels and sliders are HTML."""
    notebook.cells.insert(0, nbformat.v4.new_code_cell(WITHOUT_KERNEL))
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    del notebook.cells[0]
    notebook.metadata.pop("widgets", None)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if "text/html" in output.get("data", {}):
                output["data"].pop("application/vnd.jupyter.widget-view+json", None)
    return notebook


def page(notebook: nbformat.NotebookNode, title: str, reveal: str = "") -> str:
    """Slides as HTML."""
    exporter = SlidesExporter()
    exporter.reveal_scroll = True
    exporter.reveal_transition = "none"
    if reveal:
        exporter.reveal_url_prefix = reveal
    return exporter.from_notebook_node(notebook, {"metadata": {"name": title}})[0]


def main() -> None:
    """Write the slides of the lecture, or of the given lessons."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lessons", nargs="*", default=LECTURE, help="how their names begin")
    parser.add_argument("--reveal", default="", help="address of a copy of reveal.js")
    options = parser.parse_args()
    folder = DOCS / "_build" / "slides"
    folder.mkdir(parents=True, exist_ok=True)
    for path in [*sorted(NOTEBOOKS.glob("*.ipynb")), *sorted(MORE.glob("*.ipynb"))]:
        if path.name.startswith(tuple(options.lessons)):
            notebook = executed(as_slides(nbformat.read(path, as_version=4)))
            file = folder / f"{path.stem}.html"
            file.write_text(page(notebook, path.stem, options.reveal), encoding="utf-8")
            sys.stdout.write(f"{file}\n")


if __name__ == "__main__":
    main()
