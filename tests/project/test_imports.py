"""How the house hangs together: rooms in the order of the data, and nothing heavy loaded early."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import s4a

FOLDER = Path(s4a.__file__).parent

# The order in which data flow: a room imports from those before it and from none after it.
ROOMS = (
    "extensions",
    "schema",
    "seeds",
    "options",
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


PANELS = ("ipywidgets", "pythreejs", "anywidget")
OFTEN = ("numpy", "xarray", "pandas", "scipy", "h5py", "joblib", "psutil")
SELDOM = ("matplotlib", "sklearn", "nibabel", "jinja2", "PIL", "pymeshlab", "dask", "pyFM", *PANELS)
HELP = """import contextlib, io
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
    s4a.cli.main(["--help"])"""


def loaded_by(code, modules):
    """Which of these modules Python has when it has run the code."""
    end = f"sys.stdout.write(' '.join(m for m in {modules} if m in sys.modules))"
    code = f"import sys\n{code}\n{end}"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return found.stdout.split()


@pytest.mark.parametrize("code", ["import s4a", f"import s4a.cli\n{HELP}"])
def test_importing_s4a_and_its_help_load_no_other_package(code):
    assert loaded_by(code, (*OFTEN, *SELDOM)) == []


def test_workers_load_what_they_compute_with_and_no_more():
    code = "import s4a.study.runner, s4a.study.tasks"
    assert loaded_by(code, (*OFTEN, *SELDOM, "scipy.stats")) == list(OFTEN)


def test_every_public_name_is_there_and_completion_offers_no_other():
    assert set(s4a.__all__) | {"widgets"} == set(dir(s4a))
    for name in s4a.__all__:
        assert getattr(s4a, name) is not None
    assert callable(s4a.clean)
    assert callable(s4a.insert)


def test_modules_of_rooms_need_no_import_of_their_own():
    code = "import s4a\nassert s4a.geometry.mesh.edges([[0, 1, 2]]).shape == (3, 2)"
    assert loaded_by(code, ["numpy", "s4a.method.fmap"]) == ["numpy"]


def test_panels_are_there_when_they_are_asked_for():
    code = "import s4a\nassert s4a.widgets.Region.__name__ == 'Region'"
    assert loaded_by(code, PANELS[:1]) == ["ipywidgets"]
    assert "widgets" in dir(s4a)


def test_names_that_are_nowhere_are_attribute_errors():
    with pytest.raises(AttributeError, match="No s4a attribute analyze"):
        _ = s4a.analyze
    with pytest.raises(AttributeError, match=r"No s4a\.method attribute fmaps"):
        _ = s4a.method.fmaps


def test_studies_have_their_accessor_with_the_first_public_name():
    code = "import s4a\ns4a.open_study\nimport xarray\nassert xarray.DataTree().s4a.explore"
    assert loaded_by(code, PANELS) == []
