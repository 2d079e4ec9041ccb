"""The words that the glossary replaces do not come back."""

import re

from paths import DOCS, LESSONS, NOTEBOOKS, ROOT, TESTS

HEADING = "## Words that S4A does not use"
CODE = ("s4a", "morphometrics", "tests", "benchmarks", "tools", "binder")
PAGES = [*DOCS.glob("[!_]*.md"), *DOCS.glob("*/*.md"), *LESSONS, NOTEBOOKS / "README.md"]
PAGES += [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


def replaced_words():
    """The left column of the table in the glossary, one word or phrase each."""
    section = (DOCS / "glossary.md").read_text(encoding="utf-8").split(HEADING)[1].split("\n\n")[2]
    cells = re.findall(r"^\| ([^|]+) \|", section, re.MULTILINE)
    return [word.strip() for cell in cells[1:] for word in cell.split(",") if word.strip("- ")]


def test_no_replaced_word_is_in_code_or_pages():
    words = replaced_words()
    assert len(words) > 30
    pattern = re.compile(rf"(?<![a-z])({'|'.join(map(re.escape, words))})(?![a-z])", re.IGNORECASE)
    files = [path for name in CODE for path in sorted((ROOT / name).rglob("*.py"))] + PAGES
    left_out = {DOCS / "glossary.md", DOCS / "changelog.md", TESTS / "project/test_vocabulary.py"}
    found = {
        f"{path.relative_to(ROOT)}: {match[1]}"
        for path in files
        if path not in left_out and ".venv" not in path.parts
        for match in pattern.finditer(path.read_text(encoding="utf-8"))
    }
    assert sorted(found) == []
