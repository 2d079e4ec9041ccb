"""What a type checker sees of S4A in somebody's program."""

import re

import pytest
from paths import ROOT

import s4a

MODULES = ("compare", "metrics", "statistics", "synthetic")
NAMES = [f"s4a.{name}" for name in s4a.__all__ if name not in MODULES]
NAMES += [f"s4a.statistics.{name}" for name in s4a.statistics.__all__]


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """The lines of mypy on a program that names everything public, and a name that is none."""
    api = pytest.importorskip("mypy.api")
    program = tmp_path_factory.mktemp("typed") / "program.py"
    lines = ["import s4a", *(f"reveal_type({name})" for name in NAMES), "s4a.analyze", ""]
    program.write_text("\n".join(lines))
    config = f"--config-file={ROOT / 'pyproject.toml'}"
    found, wrong, _ = api.run([config, f"--cache-dir={ROOT / '.mypy_cache'}", str(program)])
    assert not wrong
    return [line for line in found.splitlines() if line.startswith(str(program))]


def test_every_public_function_has_its_types_in_the_program_of_a_user(said):
    types = [found[1] for line in said if (found := re.search(r'Revealed type is "(.*)"', line))]
    assert len(types) == len(NAMES)
    assert [name for name, type_ in zip(NAMES, types, strict=True) if "def (" not in type_] == []


def test_a_misspelt_name_is_told(said):
    assert 'error: Module has no attribute "analyze"' in said[-1]
