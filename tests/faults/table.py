"""The page of the documentation on faults: its first table from the entries of the tests.

``python tests/faults/table.py``.
"""

import re
import sys
import tempfile
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from paths import DOCS

from faults.shapes import FAULTS, make
from s4a import read_shapes
from s4a.input.formats import FORMATS

PAGE = DOCS / "faults.md"
HEAD = """# Faulty input: meshes, tables, options and studies

This page lists the faults that S4A handles: what is done, what the report says, and how to change
it. The page is written from the entries that the tests use (`tests/faults`); every row is tested.

A run over a collection continues with the shapes that can be used. `s4a check`, `s4a run` and
`s4a.read_shapes` give each shape a status (ok, repaired, flagged, excluded), a reason (what was
found and done) and a warning (what looks wrong and was not changed). Messages about several
shapes, or about files that are not shapes, are in the remarks. [Flagged
shapes](quality_control.md) are registered but do not affect the results of the others.

## Meshes

| input | status | what is done | the report says | how to change it |
|---|---|---|---|---|
"""
REST = """
## Collections, options and studies

| input | outcome | test |
|---|---|---|
"""


def cell(text):
    """Text that a cell of a table can hold."""
    return text.replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


def report_of(folder):
    """The report on the faulty files of a folder."""
    return read_shapes(folder)["report"].to_dataset()


def sentences(report):
    """What the report says of every faulty shape, without the paths of this machine."""
    texts = {}
    for fault in FAULTS:
        if fault.where == "remarks":
            lines = report.attrs["remarks"].splitlines()
            lines = [line for line in lines if fault.file in line]
        else:
            lines = report[fault.where].sel(shape=fault.shape).item().splitlines()
        text = re.sub(r"\S*/(?=[^/\s]+)", "", " ".join(lines))
        texts[fault.shape] = text.replace(", ".join(FORMATS), "PLY, OBJ, ...")
    return texts


def page(texts):
    """The page; `texts` is what the report says of every shape.

    The second table, of collections, options and studies, is kept as it stands.
    """
    rows = [
        (fault.input, fault.status or "no shape", fault.outcome, texts[fault.shape], fault.change)
        for fault in FAULTS
    ]
    lines = ["| " + " | ".join(map(cell, row)) + " |" for row in rows]
    _, heading, rest = PAGE.read_text(encoding="utf-8").partition(REST)
    return HEAD + "\n".join(lines) + "\n" + heading + rest


def proofs():
    """File and name of the test of each row of the second table."""
    _, _, rest = PAGE.read_text(encoding="utf-8").partition(REST)
    return re.findall(r"`(test_\w+\.py)`: (test_\w+) \|$", rest, re.MULTILINE)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        report = report_of(make(Path(folder) / "faults"))
        PAGE.write_text(page(sentences(report)), encoding="utf-8")
