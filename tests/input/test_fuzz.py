"""Damaged files of every format (tests/fuzz.py, in short).

Read or refused by name, and nothing worse.
"""

import sys

import fuzz
import pytest

FILES = 150

if sys.platform != "linux":
    pytest.skip("the limits of the child process are Linux's", allow_module_level=True)


def test_whole_files_are_read(tmp_path):
    for name, (suffix, kind, given) in fuzz.seeds().items():
        for content, finish in given:
            path = tmp_path / f"file{suffix}"
            path.write_bytes(finish(content))
            assert fuzz.read(path, kind) == "parsed", name


def test_damaged_files_are_read_or_refused_by_name_in_bounded_time_and_memory():
    names = list(fuzz.seeds())
    totals, failures = fuzz.fuzz(names, FILES, seed=3)
    assert failures == []
    for name in names:
        refused = totals[name].pop("refused")
        assert 0 < refused < FILES
        assert (
            refused + totals[name]["parsed"] + totals[name].get("parsed, not cleaned", 0) == FILES
        )
