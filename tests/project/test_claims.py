"""The page of the paper's claims: every row has a verdict, and what it names exists."""

import re

import pytest
from paths import DOCS, NOTEBOOKS, ROOT, TESTS, benchmark

PAGE = DOCS / "claims.md"
VERDICTS = ("holds", "holds in part", "does not hold", "not tested")
ROWS = [
    [cell.strip() for cell in line.strip("|\n").split(" | ")]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and not line.startswith(("| section", "| ---"))
]
each_row = pytest.mark.parametrize("row", ROWS, ids=lambda row: row[1][:60])


def test_every_section_that_claims_something_has_rows():
    sections = {part for row in ROWS for part in row[0].split(", ")}
    assert {"abstract", "4.1", "4.2", "5.2", "5.3", "6.1", "6.2"} <= sections


@each_row
def test_a_row_has_its_six_cells_and_one_of_the_verdicts(row):
    section, claim, verdict, what, command, guard = row
    assert section
    assert claim
    assert what
    assert verdict in VERDICTS
    assert "`" in command or "`" in guard or verdict == "not tested"


@each_row
def test_every_command_is_a_script_and_every_word_one_that_it_takes(row):
    for command in re.findall(r"`([^`]+)`", row[4]):
        name, *words = command.split()
        assert (ROOT / "benchmarks" / name).is_file(), command
        script = benchmark(name.removesuffix(".py"))
        for word in words:
            known = {*getattr(script, "PARTS", ()), *getattr(script, "SETS", ())}
            known |= {name for name, value in vars(script).items() if callable(value)}
            assert word in known or word.isdigit(), command


@each_row
def test_every_test_that_a_row_names_exists(row):
    guards = re.findall(r"`(test_\w+\.py)::(test_\w+)`", row[5])
    assert guards or row[5] == "none"
    for file, test in guards:
        (path,) = TESTS.rglob(file)
        assert f"def {test}(" in path.read_text(encoding="utf-8")


def test_readme_index_and_the_lesson_on_methods_lead_to_the_page():
    assert "(docs/claims.md)" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert "(claims.md)" in (DOCS / "index.md").read_text(encoding="utf-8")
    assert "docs/claims.md" in (NOTEBOOKS / "10_comparing.ipynb").read_text(encoding="utf-8")
