"""The page of what differs from the paper: every switch, every result, no figure by hand."""

import importlib
import re

import pytest
from paths import benchmark

from s4a.method.median import NORMS
from s4a.options import PRESETS, Options

PAPER = PRESETS["paper"]
differences = benchmark("differences")
additions = benchmark("additions")


def test_the_page_is_what_the_command_makes_from_the_results():
    made = differences.page(differences.results())
    assert differences.PAGE.read_text(encoding="utf-8") == made, "differences.py --write"


def test_every_switch_of_the_preset_has_a_row_with_both_values():
    page = differences.PAGE.read_text(encoding="utf-8")
    for name, value in PAPER.items():
        row = next(line for line in page.splitlines() if f"| `{name}`: " in line)
        own = getattr(Options(), name)
        assert f"`{name}`: {differences.quoted(own)}, {differences.quoted(value)}" in row


def test_every_norm_has_a_row():
    assert list(differences.NORMS) == list(NORMS) == list(additions.NORMS)


@pytest.mark.parametrize("which", differences.SETS)
def test_every_row_is_shown_and_no_other_is_measured(which):
    rows = {**additions.study_rows(), **additions.pair_rows()}
    measured = {row for one, row in differences.results() if one == which}
    assert measured <= set(rows)
    assert list(additions.SETS) == list(differences.SETS)
    shown = {"paper", "default", "default, joint", "default, lift", *differences.PAIRS}
    shown |= {f"default without {name}" for name in ("init", "parts")}
    shown |= set(differences.additions())
    shown |= {f"paper, {row}" for reading in differences.READINGS for row in reading.rows}
    shown |= {f"paper, norm={name}" for name in NORMS}
    assert set(rows) <= shown


def test_a_row_that_was_not_measured_is_shown_without_a_figure():
    found = {key: line for key, line in differences.results().items() if key[1] != "paper"}
    (row,) = re.findall(r"\| the paper alone \|.*", differences.page(found))
    assert not re.search(r"\d", row)
    assert row.count(differences.LACKING) == 2 * len(differences.SETS)


def test_a_row_of_the_results_is_replaced_and_the_others_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(differences, "RESULTS", tmp_path / "results.csv")
    for row, match in (("paper", "1"), ("default", "2"), ("paper", "3")):
        differences.keep("brains", row, [match, "1", "", "1", "a"])
    found = differences.results()
    assert [(row, line["matched"]) for (_, row), line in found.items()] == [
        ("paper", "3"),
        ("default", "2"),
    ]


@pytest.mark.parametrize("row", [*additions.study_rows(), *additions.pair_rows()])
def test_a_row_is_the_paper_or_the_default_with_one_thing_changed(row):
    options = {**additions.study_rows(), **additions.pair_rows()}[row]
    options = {name: value for name, value in options.items() if name != "template"}
    beside = PAPER if "paper" in row else {}
    changed = {
        name for name, value in options.items() if name not in beside or value != PAPER[name]
    }
    with_its_need = {"paper, parts": 2, "paper, wide": 2}
    unchanged = row.split(", ")[-1] in ("paper", "default", "pairs: paper", "pairs: default")
    in_place = row.removeprefix("paper, ") in additions.INSTEAD
    expected = 0 if unchanged or in_place else with_its_need.get(row, 1)
    assert len(changed) == expected
    assert Options(**options)


@pytest.mark.parametrize(
    "name", sorted({n for of_row in additions.INSTEAD.values() for n in of_row})
)
def test_what_is_put_in_the_place_of_ours_is_there(name):
    module, _, function = name.rpartition(".")
    assert callable(getattr(importlib.import_module(module), function))
