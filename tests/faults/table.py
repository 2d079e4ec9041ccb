"""The page of the documentation on faults, from the entries of the tests.

``python tests/faults/table.py``.
"""

import sys
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
HEAD = """# What becomes of faulty input

A run over a collection goes on with the shapes that can be used. `s4a check`, `s4a run` and `s4a.read_shapes` give
each shape a status (ok, repaired, excluded), a reason (what was found and done) and a warning (what looks wrong and was
left as it is); what concerns several shapes, or files that are no shapes, stands in the remarks below.

This page is made from the entries that the tests run over (`tests/faults`); every row is tested.

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


def page(faults, proofs, said):
    """The page; `said` is the text that the report has for every shape."""
    rows = [
        [
            cell(f.input),
            f.status or "no shape",
            cell(f.outcome),
            cell(said[f.shape]),
            cell(f.change),
        ]
        for f in faults
    ]
    tests = [
        [cell(given), cell(outcome), f"`{file}`: {test}"] for given, outcome, file, test in proofs
    ]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return (
        HEAD
        + "\n".join(lines)
        + "\n"
        + REST
        + "\n".join("| " + " | ".join(r) + " |" for r in tests)
        + "\n"
    )


if __name__ == "__main__":
    import tempfile

    sys.path.insert(0, str(Path(__file__).parents[1]))
    from test_faults import example, found_in

    from faults import shapes, studies

    with tempfile.TemporaryDirectory() as folder:
        report = found_in(shapes.make(Path(folder) / "faults"))
        PAGE.write_text(page(shapes.FAULTS, studies.PROOFS, example(report)), encoding="utf-8")
