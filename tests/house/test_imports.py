"""How the house hangs together: rooms in the order of the data, and nothing heavy loaded early."""

import ast
import importlib
import subprocess
import sys
import warnings
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import s4a
from s4a import _moved

FOLDER = Path(s4a.__file__).parent

# The order in which data flow: a room imports from those before it and from none after it.
ROOMS = (
    "schema",
    "geometry",
    "input",
    "method",
    "study",
    "analysis",
    "datasets",
    "evaluation",
    "show",
    "widgets",
    "cli",
)
FRONT_DOOR = (
    "__init__",
    "__main__",
    "_moved",
    "accessor",
    "course",
)  # they stand outside of the order


def name_of(path):
    """The dotted name of a module below s4a: ``method.latent``; ``method`` for an ``__init__``."""
    parts = path.relative_to(FOLDER).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


MODULES = {name_of(path): path for path in sorted(FOLDER.rglob("*.py"))}


def imports(path):
    """The modules of s4a that a file imports, also within functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            names = [f"{node.module}.{alias.name}" for alias in node.names] + [node.module]
        else:
            continue
        inside = {name.removeprefix("s4a.") for name in names if name.startswith("s4a.")}
        found |= inside & set(MODULES)
    return found - {name_of(path)}


GRAPH = {name: imports(path) for name, path in MODULES.items()}


def room(name):
    return name.partition(".")[0]


def test_every_module_stands_in_a_room():
    assert {room(name) for name in MODULES} == {*ROOMS, *FRONT_DOOR}


@pytest.mark.parametrize("name", [name for name in MODULES if room(name) not in FRONT_DOOR])
def test_a_room_imports_from_those_before_it(name):
    after = ROOMS[ROOMS.index(room(name)) + 1 :]
    assert {needed for needed in GRAPH[name] if room(needed) in (*after, *FRONT_DOOR)} == set()


def test_modules_of_a_room_import_in_no_circle():
    graph = {name: needs - {room(name)} for name, needs in GRAPH.items()}
    assert len(list(TopologicalSorter(graph).static_order())) == len(MODULES)  # CycleError if so


def test_no_module_takes_the_public_names():
    named = {name for name, needs in GRAPH.items() if "__init__" in needs}
    assert named == set()


def test_importing_s4a_loads_no_widgets_no_pymeshlab_and_no_cluster():
    heavy = ("ipywidgets", "pythreejs", "anywidget", "pymeshlab", "dask", "pyFM")
    code = f"import sys, s4a\nsys.stdout.write(' '.join(m for m in {heavy} if m in sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == ""


@pytest.mark.parametrize("old, new", _moved.MOVED.items())
def test_an_old_name_of_a_module_is_the_new_module(old, new):
    expected = importlib.import_module(f"s4a.{new}")
    spec = expected.__spec__
    sys.modules.pop(f"s4a.{old}", None)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert importlib.import_module(f"s4a.{old}") is expected
    messages = [str(w.message) for w in said if w.category is DeprecationWarning]
    assert messages == ([] if old in _moved.PUBLIC else [f"s4a.{old} is now s4a.{new}"])
    assert expected.__spec__ is spec


def test_functions_that_share_an_old_name_with_a_module_stay_functions():
    assert callable(s4a.clean)
    assert callable(s4a.insert)
