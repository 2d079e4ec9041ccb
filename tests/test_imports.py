"""How the modules hang together: imports point one way, and nothing heavy is loaded before it is needed."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import s4a

FOLDER = Path(s4a.__file__).parent
MODULES = {path.stem: path for path in FOLDER.glob("*.py") if not path.stem.startswith("__")}


def imports(path):
    """The modules of s4a that a file imports, also within functions; what is not a module as it stands."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            names = [f"s4a.{alias.name}" for alias in node.names] if node.module == "s4a" else [node.module]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("s4a.")}
    return found


STEPS = "clean remesh spectral align descriptors fmap network latent median nearest deform joint register pca".split()
GRAPH = {name: imports(path) for name, path in MODULES.items()}


def importers(name):
    return {module for module, needs in GRAPH.items() if name in needs}


def test_imports_point_one_way():
    order = list(TopologicalSorter(GRAPH).static_order())  # CycleError where they do not
    assert order.index("schema") < order.index("mesh") < order.index("spectral") < order.index("pipeline")


def test_modules_import_modules_and_not_the_public_names():
    assert {name for needs in GRAPH.values() for name in needs} <= set(MODULES)


def test_the_schema_imports_nothing_of_s4a():
    assert GRAPH["schema"] == set()


def test_only_the_command_line_imports_the_pipeline_and_nothing_imports_the_command_line():
    assert importers("pipeline") <= {"cli", "commands", "compare"}
    assert importers("commands") | importers("tables") <= {"cli", "commands"}
    assert importers("cli") == set()


def test_nothing_imports_the_widgets():
    assert importers("widgets") == set()


def test_a_step_knows_nothing_of_studies_pictures_and_other_orchestration():
    above = set("study pipeline cli commands tables view draw widgets synthetic".split())
    for step in STEPS:
        assert not GRAPH[step] & above, step


def test_importing_s4a_loads_no_widgets_no_pymeshlab_and_no_cluster():
    heavy = ("ipywidgets", "pythreejs", "anywidget", "pymeshlab", "dask", "pyFM")
    code = f"import sys, s4a\nsys.stdout.write(' '.join(m for m in {heavy} if m in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == ""
