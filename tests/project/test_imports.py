"""The code: imports along the data, nothing heavy early, types, docstrings, seeds."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from graphlib import TopologicalSorter

import pytest
from paths import DOCS, ROOT, script

import s4a
from s4a.geometry.compiled import PACKAGES

structure = script(ROOT / "tools" / "structure.py")
MODULES = structure.modules_of()
# what the extension may use: docs/extensions.md names the modules, all without an underscore
PUBLIC = re.compile(
    r"(schema|seeds|extensions|cli(\.(commands|flags|tables))?|(geometry|input|method|analysis|evaluation|show|widgets"
    r"|datasets)(\.\w+)*|options|study\.(tree|insert|netcdf|pair|pipeline|processes|store))(\.\w+)?"
)


def text(path):
    return path.read_text(encoding="utf-8")


def test_a_module_imports_only_from_subpackages_before_its_own_and_in_no_circle():
    order = {name: i for i, name in enumerate(structure.SUBPACKAGES)}
    order |= {name: len(order) for name in structure.FRONT}
    levels = {name: order[name.partition(".")[0]] for name in MODULES}
    used = {n: structure.imports_of(path) & {*MODULES} - {n} for n, path in MODULES.items()}
    against = [(a, b) for a, needs in used.items() for b in needs if levels[b] > levels[a]]
    assert against == []
    # the front imports from all; `import s4a` itself is no import of the package's public names
    assert [name for name, needs in used.items() if "__init__" in needs] == []
    graph = {name: needs - {name.partition(".")[0]} for name, needs in used.items()}
    assert len([*TopologicalSorter(graph).static_order()]) == len(MODULES)  # CycleError if so
    relative = [
        name for name, path in MODULES.items() if re.search(r"^\s*from \.", text(path), re.M)
    ]
    assert relative == []


def test_an_import_against_the_data_is_seen(tmp_path):
    (tmp_path / "store.py").write_text(
        "def f():\n    from s4a.cli import main\nimport s4a.study.tree"
    )
    assert structure.imports_of(tmp_path / "store.py") == {"cli", "cli.main", "study.tree"}


def test_the_extension_imports_public_names_of_s4a_only():
    wrong = []
    for path in sorted(structure.EXTENSION.rglob("*.py")):
        names = structure.imports_of(path)
        wrong += [
            f"{path.name}: s4a.{name}"
            for name in sorted(names)
            if (not PUBLIC.fullmatch(name) and name not in s4a.__all__)
            or any(part.startswith("_") for part in name.split("."))
        ]
    assert wrong == []


def test_one_module_imports_a_package_that_a_browser_lacks():
    pattern = rf"^\s*(?:import|from) ({'|'.join(PACKAGES)})\b"
    found = [name for name, path in MODULES.items() if re.search(pattern, text(path), re.MULTILINE)]
    assert found == []  # s4a.geometry.compiled gets them by name


def calls_of_hdf5(text):
    """Calls that open HDF5 or netCDF files, other than for writing, in Python code."""
    names = {"File", "open_dataset", "load_dataset", "open_datatree", "open_dataarray",
             "load_dataarray", "open_mfdataset", "load_datatree", "open_groups"}  # fmt: skip
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            call, arguments = ast.unparse(node.func), [ast.unparse(one) for one in node.args]
            is_written = call == "h5py.File" and arguments[1:] == ["'w'"]
            if (node.func.attr in names or call == "h5f.open") and not is_written:
                yield call
        if isinstance(node, ast.ImportFrom | ast.Import):
            imported = [alias.name for alias in node.names]
            yield from sorted(names & {*imported} | {"netCDF4", "h5netcdf"} & {*imported})


def test_one_function_opens_hdf5_files():
    found = {
        f"{path.stem}: {call}"
        for path in [*MODULES.values(), *structure.EXTENSION.rglob("*.py")]
        for call in calls_of_hdf5(text(path))
    }
    assert found == {"netcdf: h5f.open", "netcdf: xr.open_dataset"}  # the second in `open_plain`
    seen = "import h5py\nh5py.File(a)\nh5py.File(a, 'w')\nxr.load_dataset(a)\nimport netCDF4"
    assert sorted(calls_of_hdf5(seen)) == ["h5py.File", "netCDF4", "xr.load_dataset"]


PANELS = ("ipywidgets", "pythreejs", "anywidget")
OFTEN = ("numpy", "xarray", "pandas", "scipy", "h5py", "joblib", "psutil")
SELDOM = ("matplotlib", "sklearn", "nibabel", "jinja2", "PIL", "pymeshlab", "dask", "pyFM", *PANELS)
HELP = """import contextlib, io, s4a.cli
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
    s4a.cli.main(["--help"])"""
LOADED = {  # code -> the packages that it loads, of those above
    f"import s4a\n{HELP}": [],
    "import s4a\ns4a.open_study\nimport xarray\nassert xarray.DataTree().s4a.explore": OFTEN,
    "import s4a\nassert s4a.geometry.mesh.edges([[0, 1, 2]]).shape == (3, 2)": OFTEN[:4],
    "import s4a.study.tasks": OFTEN,
}


@pytest.mark.parametrize("code", LOADED, ids=["help", "tree", "module", "worker"])
def test_no_package_is_loaded_before_it_is_needed(code):
    watched = (*OFTEN, *SELDOM)
    # the type of a module that waits to be loaded is another one
    loaded = "type(sys.modules.get(m)) is type(sys)"
    end = f"sys.stdout.write(' '.join(m for m in {watched} if {loaded}))"
    run = [sys.executable, "-c", f"import sys\n{code}\n{end}"]
    found = subprocess.run(run, capture_output=True, text=True, check=True).stdout.split()
    assert set(found) <= set(LOADED[code])


def test_every_public_name_is_there_and_in_the_table_of_the_docstring():
    assert [name for name in s4a.__all__ if not hasattr(s4a, name)] == []
    others = [name for name in dir(s4a) if name not in s4a.__all__]
    assert all(inspect.ismodule(getattr(s4a, name)) for name in others)
    listed = re.findall(r":(?:class|func|mod):`(?:s4a\.)?(\w+)`", s4a.__doc__)
    subpackages = {name for name in s4a.__all__ if (ROOT / "s4a" / name).is_dir()}
    assert {*s4a.__all__} - {*listed} - subpackages == set()
    for name in ("analyze", "method.fmaps"):
        with pytest.raises(AttributeError, match=name.split(".")[-1]):
            importlib.import_module("operator").attrgetter(name)(s4a)


def functions():
    """The public functions, and those of the public modules that take options."""
    for name in s4a.__all__:
        found = getattr(s4a, name)
        if inspect.ismodule(found):
            for member in getattr(found, "__all__", [n for n in vars(found) if n[0] != "_"]):
                function = getattr(found, member)
                if inspect.isfunction(function) and (
                    hasattr(found, "__all__") or function.__module__ == found.__name__
                ):
                    yield f"{name}.{member}", function
        elif callable(found):
            yield name, found


def test_a_public_function_says_what_it_takes_gives_and_raises_and_shows_an_example():
    lacking = []
    for name, function in functions():
        said = function.__doc__ or ""
        needs = {
            "Parameters\n": len(inspect.signature(function).parameters) > 2,
            ">>>": "Parameters\n" in said,
            "Raises\n": re.search(r"^    +raise ValueError", inspect.getsource(function), re.M),
        }
        lacking += [(name, part.strip()) for part, needed in needs.items() if needed]
        lacking = [(n, part) for n, part in lacking if n != name or part not in said]
    assert lacking == []


def test_a_public_function_that_takes_a_seed_takes_rng_by_name_alone():
    seeded = [(n, f) for n, f in functions() if "seed" in inspect.signature(f).parameters]
    seeded = [(n, f) for n, f in seeded if n != "Options"]  # which keep the number on record
    assert {"coarsen", "statistics.group_test"} <= {n for n, _ in seeded}
    wrong = []
    for name, function in seeded:
        rng = inspect.signature(function).parameters.get("rng")
        if rng is None or rng.default is not None or rng.kind is not rng.KEYWORD_ONLY:
            wrong.append(name)
    assert wrong == []


def undocumented(tree):
    """The public functions and classes of a module without a docstring."""
    made = (ast.FunctionDef, ast.ClassDef)
    public = [n for n in tree.body if isinstance(n, made) and n.name[0] != "_"]
    return [node.name for node in [tree, *public] if not ast.get_docstring(node)]


def untyped(tree):
    """The public functions and methods of a module that lack a type."""
    classes = [n for n in tree.body if isinstance(n, ast.ClassDef) and n.name[0] != "_"]
    nodes = [*tree.body, *(node for one in classes for node in one.body)]
    for node in nodes:
        if isinstance(node, ast.FunctionDef) and node.name[0] != "_":
            a = node.args
            given = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
            types = [one.annotation for one in given if one.arg not in ("self", "cls")]
            if None in (*types, node.returns):
                yield node.name


def test_what_is_public_has_docstrings_and_types():
    lacking = []
    for name, path in [*MODULES.items(), *structure.modules_of(structure.EXTENSION).items()]:
        tree = ast.parse(text(path))
        if not any(part[0] == "_" for part in name.split(".")):
            lacking += [f"{name}.{of}" for of in (*undocumented(tree), *untyped(tree))]
    assert lacking == []


def test_every_module_is_in_the_reference_once():
    pages = "".join(text(page) for page in (DOCS / "api").glob("*.md"))
    found = re.findall(r"automodule:: s4a\.([\w.]+)\n", pages)
    packages = {name for name, path in MODULES.items() if path.stem == "__init__"}
    expected = {n for n in MODULES if n[0] != "_" and not n.startswith("widgets.")} - packages
    assert sorted({*found} - packages - {"widgets.threejs"}) == sorted(expected)
    assert len({*found}) == len(found)


def test_a_type_checker_sees_the_types_of_every_public_function_and_a_misspelt_name(tmp_path):
    api = pytest.importorskip("mypy.api")
    names = [f"s4a.{n}" for n in s4a.__all__ if not inspect.ismodule(getattr(s4a, n))]
    names += [f"s4a.statistics.{name}" for name in s4a.statistics.__all__]
    program = tmp_path / "program.py"
    program.write_text(
        "\n".join(["import s4a", *(f"reveal_type({n})" for n in names), "s4a.analyze"])
    )
    config = f"--config-file={ROOT / 'pyproject.toml'}"
    said, wrong, _ = api.run([config, f"--cache-dir={ROOT / '.mypy_cache'}", str(program)])
    assert not wrong
    types = re.findall(r'Revealed type is "(.*)"', said)
    assert len(types) == len(names)
    assert [name for name, type_ in zip(names, types, strict=True) if "Any" == type_] == []
    assert 'error: Module has no attribute "analyze"' in said
