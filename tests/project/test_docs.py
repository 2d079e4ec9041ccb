"""The documentation holds every public name, every module and every page.

The glossary agrees with the schema.
"""

import ast
import doctest
import importlib
import inspect
import re

import pytest
from matplotlib.figure import Figure
from paths import DOCS, ROOT

import s4a
from s4a.schema import TABLE
from s4a.show import charts

PACKAGE = ROOT / "s4a"
MODULES = sorted(
    path
    for path in PACKAGE.rglob("*.py")
    if not path.stem.startswith("_") and path.parent.name != "widgets"
)


def dotted(path):
    """The name of a module below s4a, such as ``method.latent``."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


PAGES = sorted(DOCS.glob("*.md")) + sorted((DOCS / "api").glob("*.md"))
GLOSSARY = (DOCS / "glossary.md").read_text(encoding="utf-8")
each_module = pytest.mark.parametrize("path", MODULES, ids=lambda path: dotted(path))


def rows(text):
    """The cells of every row of the tables, less their heads."""
    for line in text.splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == 4 and cells[0] != "symbol" and not cells[0].startswith("---"):
            yield cells


def test_every_module_is_in_the_reference_once():
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    found = re.findall(r"automodule:: s4a\.([\w.]+)\n", text)
    assert sorted(found) == sorted([*map(dotted, MODULES), "widgets", "widgets.threejs"])


@each_module
def test_everything_public_has_a_docstring_and_so_stands_in_the_reference(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    public = [
        n
        for n in tree.body
        if isinstance(n, ast.FunctionDef | ast.ClassDef) and not n.name.startswith("_")
    ]
    assert ast.get_docstring(tree)
    assert [node.name for node in public if not ast.get_docstring(node)] == []


def test_every_public_name_is_listed_by_section_of_the_paper():
    listed = re.findall(r":(?:class|func|mod):`(?:s4a\.)?(\w+)`", s4a.__doc__)
    assert sorted(listed) == sorted(s4a.__all__)


def functions():
    """The public functions, and those of the public modules that take options."""
    for name in s4a.__all__:
        found = getattr(s4a, name)
        if callable(found):
            yield name, found
            continue
        for member in getattr(found, "__all__", [n for n in vars(found) if not n.startswith("_")]):
            function = getattr(found, member)
            if inspect.isfunction(function) and (
                hasattr(found, "__all__") or function.__module__ == found.__name__
            ):
                yield f"{name}.{member}", function


@pytest.mark.parametrize("name, function", list(functions()))
def test_a_public_function_says_what_it_takes_and_gives_and_shows_an_example(name, function):
    text = function.__doc__
    if len(inspect.signature(function).parameters) > 2:
        assert "Parameters\n" in text
    if "Parameters\n" in text:
        assert ">>>" in text
    if re.search(r"^    +raise ValueError", inspect.getsource(function), re.MULTILINE):
        assert "Raises\n" in text


# what gives a surface, something at its vertices, or a network of shapes
PICTURED = (
    "build_network",
    "coarsen",
    "complete",
    "insert",
    "latent_map",
    "match_pair",
    "reconstruct",
    "refine_network",
    "spectrum",
    "synthesize",
    "transfer_labels",
    "transfer_landmarks",
    "statistics.group_map",
    "statistics.outliers",
    "statistics.predict",
    "synthetic.brains",
)


@pytest.mark.parametrize("name", PICTURED)
def test_the_example_of_what_is_best_seen_ends_in_a_picture(name):
    text = inspect.getdoc(dict(functions())[name])
    *_, last = doctest.DocTestParser().get_examples(text)
    assert last.want.startswith(("<Figure ", "<Parts "))


def test_the_glossary_has_the_dims_of_the_schema():
    checked = 0
    for _, _, here, dims in rows(GLOSSARY):
        for name in re.findall(r"`/\w+(?:/<shape>)?: (\w+)`", here):
            assert name in TABLE, name
            known = [", ".join(TABLE[name][0])]
            known += [known[0].removeprefix("shape, ")]
            if "edge_vertex" in here or dims not in known:
                others = re.findall(r"`(\w+)`", here)
                assert (
                    any(", ".join(TABLE[n][0]) == dims for n in others if n in TABLE)
                    or dims in known
                ), (name, dims)
            checked += 1
    assert checked > 25


def test_every_function_that_the_glossary_names_exists():
    names = re.findall(r"`s4a\.([\w.]+)`", GLOSSARY)
    assert len(names) > 15
    for name in set(names) - {"schema.TABLE"}:
        module, _, function = name.rpartition(".")
        assert hasattr(importlib.import_module(f"s4a.{module}" if module else "s4a"), function), (
            name
        )


def test_the_glossary_has_every_equation_of_the_paper():
    mentioned = {int(n) for n in re.findall(r"\(eq\. (\d+)\)", GLOSSARY)}
    assert mentioned == set(range(1, 12))


def test_every_page_is_reached_and_every_link_between_pages_leads_somewhere():
    text = (DOCS / "index.md").read_text(encoding="utf-8") + (DOCS / "api" / "index.md").read_text(
        encoding="utf-8"
    )
    inside = set("\n".join(re.findall(r"```\{toctree\}\n(.*?)```", text, re.DOTALL)).split())
    for page in PAGES:
        if page.stem != "index" and not page.stem.startswith("_"):
            assert page.stem in inside, page.name
    for page in [*PAGES, ROOT / "README.md"]:
        for link in re.findall(r"\]\((?!http|#)([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            name = link.removeprefix("course/").replace("index.md", "README.md")
            in_course = link.startswith("course/") and (ROOT / "notebooks" / name).exists()
            assert in_course or (page.parent / link).exists(), (page.name, link)


def test_nothing_is_fetched_to_build_or_to_read_it():
    conf = (DOCS / "conf.py").read_text(encoding="utf-8")
    assert "intersphinx" not in conf
    assert "sphinx.ext.mathjax" not in conf
    assert "nb_ipywidgets_js = {}" in conf


def test_the_examples_of_every_chart_end_in_its_picture(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    examples = importlib.import_module("examples")
    made = {
        name: function
        for name, function in inspect.getmembers(charts, inspect.isfunction)
        if function.__module__ == charts.__name__
        and inspect.signature(function).return_annotation is Figure
    }
    assert len(made) >= 8
    for name, function in made.items():
        path = examples.draw(f"s4a.show.charts.{name}", function.__doc__, tmp_path)
        assert path.read_bytes().startswith(b"<?xml"), name
    assert examples.draw("no.picture", ">>> 1 + 1\n2\n", tmp_path) is None
    with pytest.raises(TypeError, match="needs a figure"):
        examples.draw("no.figure", ">>> 1 + 1\n<Figure ...>\n", tmp_path)
