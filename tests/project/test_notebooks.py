"""The course runs: every notebook from a clean kernel.

Its exercises without an answer and with the one of the book.
"""

import ast
import asyncio
import json
import math
import queue
import re
import subprocess
import time

import pytest
from paths import DOCS, NOTEBOOKS, ROOT

import s4a
from s4a import course
from s4a.course import quiz
from s4a.course.exercises import EXERCISES

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
widgets = pytest.importorskip("s4a.widgets")

LESSONS = sorted(NOTEBOOKS.glob("*.ipynb"))
MEMORY = 1500  # MiB, of the 2 GB that Binder gives
OPEN = "answer = ..."
SPENT = """
import json, resource, sys
own, child = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
unit = 2**20 if sys.platform == "darwin" else 2**10
seconds = sum(r.ru_utime + r.ru_stime for r in (own, child))
json.dumps({"seconds": seconds, "MiB": (own.ru_maxrss + child.ru_maxrss) / unit})
"""
each_notebook = pytest.mark.parametrize("path", LESSONS, ids=lambda path: path.stem)


def tags(cell):
    return cell.metadata.get("tags", [])


def exercises(notebook):
    """Index of each exercise and the code of its solution, which is in the next cell, folded."""
    for i, cell in enumerate(notebook.cells):
        if "exercise" in tags(cell):
            solution = notebook.cells[i + 1].source
            assert solution.startswith("<details>"), (
                f"no solution after the exercise: {cell.source}"
            )
            yield i, re.search(r"```python\n(.*?)\n```", solution, re.DOTALL)[1]


def listen_in_slices(channel, seconds=5):
    """Let a channel look for its message again and again until the time is over.

    A socket of zmq now and then does not wake the event loop for a message that has come: with one
    look as long as the cell may take, the client waits all of that beside an idle kernel.
    """
    look = channel.get_msg

    async def get_msg(timeout=None):
        end = time.monotonic() + (math.inf if timeout is None else timeout)
        while True:
            left = end - time.monotonic()
            try:
                return await look(timeout=max(0, min(seconds, left)))
            except queue.Empty:
                if left <= seconds:
                    raise

    channel.get_msg = get_msg


def shown(outputs):
    """The value of a cell as text."""
    return "".join(o["data"]["text/plain"] for o in outputs if o.output_type == "execute_result")


async def added(client, source):
    """Run code that is not in the notebook; what it shows as text."""
    cell = nbformat.v4.new_code_cell(source)
    client.nb.cells.append(cell)
    await client.async_execute_cell(cell, len(client.nb.cells) - 1)
    return shown(cell.outputs)


async def played(path, folder):
    """Run a notebook from a clean kernel, every exercise open and solved.

    Its seconds of CPU and peak memory in MiB.
    """
    notebook = nbformat.read(path, as_version=4)
    solutions = dict(exercises(notebook))
    client = nbclient.NotebookClient(
        notebook, timeout=150, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    async with client.async_setup_kernel():
        listen_in_slices(client.kc.shell_channel)
        for i, cell in enumerate(list(notebook.cells)):
            await client.async_execute_cell(
                cell, i
            )  # CellExecutionError where it fails and may not
            outputs = cell.get("outputs", [])
            told = [
                o
                for o in outputs
                if o.output_type == "stream" and o.name == "stderr" and "Warning" in o.text
            ]
            assert not told, told
            if i in solutions:
                assert not [o for o in outputs if o.output_type == "error"], cell.source
                assert re.match("['\"]No answer yet: .*Hint: .{10,}", shown(outputs)), cell.source
                assert cell.source.count(OPEN) == 1
                assert await added(client, cell.source.replace(OPEN, solutions[i])) == "'Right.'"
        return json.loads((await added(client, SPENT)).strip("'"))


PUBLIC = {  # module -> what a lesson may take of it; None: whatever has no underscore
    "s4a": {*s4a.__all__, "course", "widgets"},
    "s4a.course": {*course.__all__},
    "s4a.widgets": {*widgets.__all__, "threejs"},
    **{f"s4a.{name}": None for name in ("compare", "metrics", "statistics", "synthetic")},
}


def not_public(source):
    """The names of s4a that code imports or looks up, and that are not public."""
    found = []  # (module, name)
    for node in ast.walk(ast.parse(re.sub(r"^ *[%!].*$", "", source, flags=re.MULTILINE))):
        if isinstance(node, ast.Import):
            found += [alias.name.rpartition(".")[::2] for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [(node.module or "", alias.name) for alias in node.names]
        elif isinstance(node, ast.Attribute):
            found += [(ast.unparse(node.value), node.attr)]

    def allowed(module, name):
        names = PUBLIC.get(module, ())
        return not name.startswith("_") if names is None else name in names

    return [
        f"{module}.{name}"
        for module, name in found
        if re.match(r"s4a(\.|$)", module) and (module in PUBLIC or "(" not in module)
        if not allowed(module, name)
    ]


def untracked(folder):
    """Which files that a lesson wrote git would see, had it run in its own folder."""
    names = [
        f"notebooks/{file.relative_to(folder)}" for file in folder.rglob("*") if file.is_file()
    ]
    if not names or not (ROOT / ".git").exists():
        return []
    ignored = subprocess.run(
        ["git", "check-ignore", "--no-index", *names],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return sorted({*names} - {*ignored.stdout.splitlines()})


@each_notebook
def test_it_runs_and_its_exercises_pass_solved_and_are_no_error_open(
    path, tmp_path, record_property
):
    for tries_left in (2, 1, 0):
        try:
            spent = asyncio.run(played(path, tmp_path))
            break
        except (
            nbclient.exceptions.CellTimeoutError
        ):  # once in many runs a kernel is idle while the client waits for it
            if not tries_left:
                raise
    record_property("notebook", (path.stem, spent["seconds"], spent["MiB"]))
    assert spent["MiB"] < MEMORY
    assert untracked(tmp_path) == []


@each_notebook
def test_it_is_kept_without_outputs_and_with_an_exercise_that_lets_the_others_run(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in notebook.cells:
        assert cell.cell_type != "code" or (not cell.outputs and cell.execution_count is None)
    found = [i for i, _ in exercises(notebook)]
    assert found
    assert all("raises-exception" in tags(notebook.cells[i]) for i in found)


@pytest.mark.parametrize(
    "source, names",
    [
        ("from s4a.method import fmap", ["s4a.method.fmap"]),
        ("import s4a.geometry.mesh as m", ["s4a.geometry.mesh"]),
        ("%matplotlib inline\ns4a.show.render(1)", ["s4a.show.render", "s4a.show"]),
        ("from s4a.course.exercises import judge", ["s4a.course.exercises.judge"]),
        ("from s4a.widgets import Modes, threejs\ns4a.synthetic.sphere(9).sizes", []),
        ("import s4a.widgets\nfrom s4a import metrics\ns4a.widgets.Median(1).children", []),
    ],
)
def test_names_that_are_not_public_are_found(source, names):
    assert not_public(source) == names


@each_notebook
def test_its_code_and_its_solutions_use_public_names_only(path):
    notebook = nbformat.read(path, as_version=4)
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    code += dict(exercises(notebook)).values()
    assert [name for source in code for name in not_public(source)] == []


@each_notebook
def test_no_slider_captures_output_for_which_a_client_may_wait_without_end(path):
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert not re.search(r"\binteract\w*\(|\bOutput\(", cell.source), "s4a.course.slide"


def lesson(path):
    """Its number, as its name begins."""
    return path.name[:2]


def prose(notebook):
    """What is read of a lesson: its text without solutions, formulas, code and addresses."""
    texts = [
        cell.source
        for cell in notebook.cells
        if cell.cell_type == "markdown" and "solution" not in tags(cell)
    ]
    text = re.sub(r"\$\$.*?\$\$", " ", "\n\n".join(texts), flags=re.DOTALL)
    text = re.sub(r"\$[^$]+\$|`[^`]+`", "x", text)
    return re.sub(r"\]\([^)]*\)", "]", text)


@each_notebook
def test_it_is_read_in_a_lesson_and_in_short_sentences(path):
    text = prose(nbformat.read(path, as_version=4))
    asked = repr(quiz(lesson(path))).replace("( )", "")
    n_words = len(re.findall(r"\w[\w'’-]*", f"{text} {asked}"))
    assert 600 <= n_words <= 900, n_words
    parts = re.split(r"(?<=[.:?!;])[\s*_)]+|\n\s*\n|\n(?:- |\d\. )", text)
    long = [part for part in parts if len(re.findall(r"\w[\w'’-]*", part)) > 25]
    assert long == []


@each_notebook
def test_it_sums_up_asks_and_has_something_to_turn(path):
    cells = nbformat.read(path, as_version=4).cells
    heads = [re.match(r"## .*", cell.source)[0] for cell in cells if cell.source[:3] == "## "]
    assert heads[-4:] == ["## In three lines", "## Quiz", "## Exercises", "## Where next"]
    [summary] = [i for i, cell in enumerate(cells) if cell.source.startswith(heads[-4])]
    assert cells[summary].source.count("\n- ") == 3
    assert "takeaway(" in cells[summary + 1].source
    assert cells[summary + 3].source == f'quiz("{lesson(path)}")'
    code = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    turns = r"threejs\.renderer\(|\b(Modes|Median|Transfer|Correspondence)\(|\.explore\("
    assert re.search(turns, code)


@each_notebook
def test_the_cell_of_an_exercise_does_not_tell_its_answer(path):
    notebook = nbformat.read(path, as_version=4)
    numbers = []
    for i, _ in exercises(notebook):
        call = notebook.cells[i].source.split(OPEN)[1].strip()
        found = re.fullmatch(r'check\(\s*"(\d\d\.\d)", answer((?:, [\w\[\]"./()]+)*),?\s*\)', call)
        assert found, call
        numbers.append(found[1])
    asked = [number for number in EXERCISES if number.startswith(lesson(path))]
    assert numbers == asked


@each_notebook
def test_the_page_for_teachers_has_its_minutes(path):
    head = nbformat.read(path, as_version=4).cells[0].source
    minutes = re.search(r"lesson: (\d+) minutes", head)[1]
    page = (DOCS / "teaching.md").read_text(encoding="utf-8")
    assert re.search(rf"^\| {lesson(path)} [^|]+ \| {minutes} \| \d+ \|", page, re.MULTILINE)


@each_notebook
def test_the_table_of_lessons_has_it(path):
    assert f"({path.name})" in (NOTEBOOKS / "README.md").read_text(encoding="utf-8")


def test_every_exam_question_has_its_solution():
    page = (DOCS / "teaching.md").read_text(encoding="utf-8")
    questions = page[page.index("## Exam questions") :].split("\n**")[1:]
    assert [int(question.split(".")[0]) for question in questions] == [*range(1, 16)]
    for question in questions:
        assert re.search(r"<summary>Solution</summary>\n\n.{20,}", question), question
