"""Pages of code: how-tos, gallery, questions and what comes from elsewhere run as they stand."""

import re
from importlib.util import find_spec

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from paths import DOCS, ROOT
from small import small_analyses, small_brains, small_pictures, small_searches

import s4a
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import write_landmarks


def cells(page):
    """The code of a page, a cell at a time, without what only a notebook knows."""
    text = (DOCS / page).read_text(encoding="utf-8")
    for code in re.findall(r"```\{code-cell\}\n(.*?)```", text, re.DOTALL):
        yield code.replace("%matplotlib inline\n", "").rstrip().removesuffix(";")


def value_of(code, names):
    """Run a cell; the value of its last expression, as a notebook shows it."""
    *lines, last = re.split(r"\n(?=\S)(?!\))", code)
    exec("\n".join(lines), names)
    return eval(last, names)


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A folder, in which brains and low resolutions have at most so many vertices."""

    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    small_brains(monkeypatch.setattr, 14, 800)
    small_pictures(monkeypatch.setattr, pages=(40, 32))
    small_searches(monkeypatch.setattr)
    small_analyses(monkeypatch.setattr, 250)


def test_every_cell_of_the_gallery_runs_and_shows_a_picture(small):
    pytest.importorskip("skimage")
    pytest.importorskip("anywidget")
    first, *questions = cells("gallery.md")
    names = {}
    exec(first, names)
    assert len(questions) >= 6
    for code in questions:
        shown = value_of(code, names)
        if hasattr(shown, "close"):  # a panel
            shown.close()
        elif not isinstance(shown, Figure):
            assert names["ax"].lines, code
        else:
            canvas = FigureCanvasAgg(shown)
            canvas.draw()
            assert (np.asarray(canvas.buffer_rgba())[..., :3] < 240).mean() > 0.01, code


@pytest.mark.parametrize("page", ["data", "options", "results", "programs"])
def test_every_recipe_is_a_question_and_runs_in_at_most_fifteen_lines(page, small):
    pytest.importorskip("skimage")
    text = (DOCS / "howto" / f"{page}.md").read_text(encoding="utf-8")
    assert [title for title in re.findall("^## (.*)", text, re.MULTILINE) if "?" not in title] == []
    first, *recipes = cells(f"howto/{page}.md")
    assert [code for code in recipes if len(code.strip().splitlines()) > 15] == []
    names = {}
    for code in (first, *recipes):
        exec(code, names)


def test_the_tutorial_finds_the_simulated_group_difference(small):
    names = {}
    for code in cells("tutorial.md"):
        exec(code, names)
    assert names["test"]["p_value"] < 0.05
    assert names["significant"].mean() > 0.2


def test_the_quickstart_of_readme_prints_what_it_shows(tmp_path, monkeypatch, capsys):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    code, printed = re.search(
        r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.DOTALL
    ).groups()
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    assert capsys.readouterr().out == printed
    assert {path.name for path in tmp_path.iterdir()} == {"brains", "larger.ply", "modes.png"}
    assert len(readme.split()) <= 750


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with what the pages name, where analyses take small options by default."""
    shapes = s4a.synthetic.brains(7, 400)["original"]
    meshes = [as_arrays(node.to_dataset()) for node in shapes.children.values()]
    for name in ("heads", "marks"):
        (tmp_path / name).mkdir()
    files = [*(f"heads/head_{i}.ply" for i in range(6)), "new.ply", "a.off", "b.off"]
    for file, mesh in zip(files, [*meshes, *meshes[:2]], strict=True):
        s4a.write_mesh(tmp_path / file, *mesh)
    for i, node in enumerate([*shapes.children.values()][:6]):
        marks = node.to_dataset()[["landmark_name", "landmark_position"]]
        write_landmarks(tmp_path / "marks" / f"head_{i}.csv", marks)
    rows = [f"head_{i},{'abc'[i % 2]},{20 + i * i}" for i in range(6)]
    (tmp_path / "subjects.csv").write_text("\n".join(["shape,group,age", *rows]) + "\n")
    monkeypatch.chdir(tmp_path)
    small = {"n_coarse": 120, "k_init": 8, "k": 12}
    analyse, match_pair = s4a.analyse, s4a.match_pair
    monkeypatch.setattr(s4a, "analyse", lambda *a, **o: analyse(*a, **small, n_pairs=10, **o))
    monkeypatch.setattr(s4a, "match_pair", lambda *a, **o: match_pair(*a, **small | o))


@pytest.mark.filterwarnings("default")  # of the other programs
@pytest.mark.parametrize("page", ["coming.md", "faq.md"])
def test_every_block_of_a_page_runs_one_after_the_other(page, folder):
    text = (DOCS / page).read_text(encoding="utf-8")
    blocks = [*re.finditer(r"```python\n(.*?)```", text, re.DOTALL)]
    names = {}
    for found in blocks:
        if any(other in found[1] and find_spec(other) is None for other in ("meshmonk", "pyFM")):
            continue  # of another program, which is not installed
        line = text[: found.start()].count("\n") + 1
        exec(compile(found[1], f"{page}:{line}", "exec"), names)
    assert len(blocks) > 5
