"""The extension that docs/extensions.md writes, in the files that it shows."""

import os
import re
import subprocess
import sys
import tomllib

import pytest
from paths import DOCS

from s4a.extensions import GROUPS, extensions
from s4a.schema import Table

CODE = """
import s4a
from s4a.cli import main
assert main(["size", {study!r}, "--variable", "age", "--table", {table!r}, "--out", "out"]) == 0
study = s4a.open_study({study!r})
tabs = s4a.explore(study)
assert len(tabs["Size"].bars.spec["names"]) == 4
assert s4a.widgets.Size.title == "Size"
try:
    main(["--help"])
except SystemExit:
    pass
"""

WRONG = {
    "__init__": "SIZE = print\nROWS = {'size': ('shape', 'mm')}\n",
    "panel": "def Size(study):\n    return study\n",
}


@pytest.fixture
def extension(tmp_path):
    """The four files of the page, and what an installation makes of them."""
    page = (DOCS / "extensions.md").read_text(encoding="utf-8")
    files = re.findall(
        r"`(pyproject\.toml|s4a_size/\w+\.py)`.*?\n```\w+\n(.*?)```", page, re.DOTALL
    )
    assert len(files) == 4
    for name, text in files:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    project = tomllib.loads(dict(files)["pyproject.toml"])["project"]
    info = tmp_path / "s4a_size-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        line
        for group, entries in project["entry-points"].items()
        for line in [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return tmp_path


def run(folder, code):
    paths = [str(folder), *sys.path]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    options = {"capture_output": True, "text": True, "cwd": folder, "env": environment}
    return subprocess.run([sys.executable, "-c", code], check=False, **options)


def test_the_extension_of_the_page_has_its_command_its_tab_and_its_variable(
    extension, study_folder, study
):
    names = study["registration"]["shape"].values.tolist()
    table = extension / "table.csv"
    table.write_text("\n".join(["shape,age", *(f"{n},{i * i}" for i, n in enumerate(names))]))
    done = run(extension, CODE.format(study=str(study_folder), table=str(table)))
    assert done.returncode == 0, done.stderr
    assert "size on age: p = " in done.stdout
    assert "Test whether the size of shapes" in done.stdout  # of --help
    head = (extension / "out" / "size.shape.csv").read_text().splitlines()[0]
    assert head == "shape,centroid_size"


def test_a_row_of_another_extension_is_not_replaced_and_a_warning_names_it(caplog):
    table = Table({"size": ("shape", "1", "a size")})
    table.add({"size": ("shape", "mm", "another size"), "area": ("", "mm2", "an area")})
    assert table["size"] == (("shape",), "1", "a size")
    assert "size is in the table already" in caplog.text
    assert "area" in table


def test_an_extension_with_other_objects_is_named_and_left_out(extension, monkeypatch, caplog):
    for name, text in WRONG.items():
        (extension / "s4a_size" / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(extension)
    found = {group: extensions.__wrapped__(group) for group in GROUPS}
    sys.modules.pop("s4a_size.panel"), sys.modules.pop("s4a_size")
    assert all("size" not in map(str.lower, objects) for objects in found.values())
    for what, _ in GROUPS.values():
        assert f"of s4a-size cannot be used, and is left out: {what} expected, found" in caplog.text


def test_an_extension_that_cannot_be_imported_is_named_and_left_out(extension):
    (extension / "s4a_size" / "__init__.py").write_text("import nothing_of_that_name\n")
    done = run(extension, "import sys\nfrom s4a.cli import main\nsys.exit(main(['--help']))")
    assert done.returncode == 0
    assert "size of s4a-size cannot be used, and is left out" in done.stderr
    assert "statistics" in done.stdout
