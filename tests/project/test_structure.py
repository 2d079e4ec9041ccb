"""What is made from the code agrees with the code: the picture, the map of the rooms, the paths.

``make structure`` writes the pages anew.
"""

import re

import pytest
from paths import DOCS, NOTEBOOKS, ROOT, benchmark

structure = benchmark("structure")
WORDS = [
    *sorted(DOCS.glob("*.md")),
    *sorted((DOCS / "api").glob("*.md")),
    *sorted(NOTEBOOKS.glob("*.ipynb")),
    *sorted(NOTEBOOKS.glob("*.md")),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
]
each_page = pytest.mark.parametrize("path", WORDS, ids=lambda path: path.name)


@pytest.mark.parametrize("name", ["structure.svg", "CONTRIBUTING.md"])
def test_what_is_made_from_the_code_is_as_the_code_is(name):
    (text,) = (text for path, text in structure.pages().items() if path.name == name)
    (path,) = (path for path in structure.pages() if path.name == name)
    assert path.read_text(encoding="utf-8") == text, "make structure"


def test_public_functions_have_types():
    modules = structure.read_package(ROOT / "s4a")
    lacking = {
        f"{name}.{function.name}"
        for name, module in modules.items()
        for function in structure.public_functions(module)
        if not structure.is_annotated(function)
    }
    assert lacking == set()


@each_page
def test_every_path_of_the_repository_that_a_page_names_is_there(path):
    text = path.read_text(encoding="utf-8")
    named = re.findall(
        r"\b(?:s4a|tests|benchmarks|docs|binder|notebooks)/[\w/]*\w\.(?:py|md|svg|ipynb)", text
    )
    assert [file for file in named if not (ROOT / file).exists()] == []


def test_every_module_of_the_table_in_the_readme_is_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = text[text.index("| paper | in `s4a/` | |") : text.index("Beyond the paper")]
    cells = [line.split("|")[2] for line in table.splitlines()[2:] if line.startswith("|")]
    assert len(cells) > 15
    for cell in cells:
        room = None
        for name in re.findall(r"`([\w/]+)`", cell):
            room, _, module = name.rpartition("/") if "/" in name else (room, "", name)
            assert (ROOT / "s4a" / room / f"{module}.py").exists(), name


def test_lines_of_code_are_neither_blank_nor_comment_nor_docstring(tmp_path):
    lines = ['"""Words."""', "", "# why", "x = [", "    1,  # one", "]", "", "", "def f():"]
    lines += ['    """Two', "    lines.", '    """', "    return x"]
    file = tmp_path / "module.py"
    file.write_text("\n".join(lines) + "\n")
    module = structure.Module(file, "module")
    assert sorted(module.code) == [4, 5, 6, 9, 13]
    assert module.comments == 2


def test_an_import_against_the_data_and_a_circle_are_counted(tmp_path):
    for name, text in {
        "geometry/mesh.py": "from s4a.study import store\n",
        "study/store.py": "from s4a.geometry.mesh import area\n",
        "input/files.py": "import s4a.geometry.mesh\n",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    modules = structure.read_package(tmp_path)
    graph = structure.imports_of(modules)
    arrows = structure.arrows_between_rooms(modules, graph)
    assert arrows == {("geometry", "study"): 1, ("study", "geometry"): 1, ("input", "geometry"): 1}
    assert structure.circles(graph) == 2


def test_the_names_in_how_to_add_are_in_the_code():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    recipes = text[text.index("## How to add") : text.index("## The rules of the house")]
    code = "".join(path.read_text("utf-8") for path in (ROOT / "s4a").rglob("*.py"))
    code += (ROOT / "tests" / "fuzz.py").read_text(encoding="utf-8")
    names = set(re.findall(r"`([A-Za-z]\w+)`", recipes)) - {"_read_x", "_x_bytes"}
    assert len(names) > 20
    assert [name for name in sorted(names) if not re.search(rf"\b{name}\b", code)] == []
