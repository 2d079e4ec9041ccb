"""The course runs: every notebook from a clean kernel.

Its exercises without an answer and with the one of the book.
"""

import ast
import asyncio
import contextlib
import inspect
import json
import math
import multiprocessing
import os
import queue
import re
import subprocess
import time

import pytest
from paths import LESSONS, NOTEBOOKS, ROOT
from small import launch

import s4a
from s4a import course
from s4a.course.exercises import EXERCISES

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
widgets = pytest.importorskip("s4a.widgets")

MEMORY = 1500  # MiB, of the 2 GB that Binder gives
OPEN = "answer = ..."
SPENT = """
import json, resource, sys
own, child = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
unit = 2**20 if sys.platform == "darwin" else 2**10
seconds = sum(r.ru_utime + r.ru_stime for r in (own, child))
json.dumps({"seconds": seconds, "MiB": (own.ru_maxrss + child.ru_maxrss) / unit})
"""
FEWER = {  # what lessons compute of many, here of a few
    'for subject in "ABCDEF"': 'for subject in "ABCD"',
    'zip("ABCDEF", [6, 7, 8, 9, 10, 11]': 'zip("ABCF", [6, 8, 9, 11]',
    "subjects(12, 500": "subjects(8, 200",
    "np.arange(11) < 6": "np.arange(7) < 4",
    "s4a.synthetic.sphere(900)": "s4a.synthetic.sphere(300)",
    "(scans, n_coarse=300": "(scans, n_coarse=150",
    "n_permutations=999": "n_permutations=99",
    "n_permutations=199": "n_permutations=49",
}
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


# what lessons import is loaded once; the kernel of each is a fork of that process
LOADED = ["ipykernel.kernelapp", "matplotlib.pyplot", "ipywidgets", "sklearn.decomposition"]
LOADED += ["s4a.course", "s4a.widgets", "s4a.study.pipeline", "s4a.analysis.statistics"]
LOADED += ["s4a_morphometrics.part", "s4a_morphometrics.structures_panel", "small", "dask.array"]
LOADED += ["ipykernel.debugger", "matplotlib_inline.backend_inline", "IPython.core.pylabtools"]


class Fork:
    """A kernel as jupyter_client knows it, begun in a fork of a process without lessons."""

    pid = -1  # it has no group of processes to be ended with it
    stdin = stdout = stderr = None

    def __init__(self, command, cwd=None, **_):
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(LOADED)
        argv = command[command.index("-f") :]
        self.process = context.Process(target=launch, args=[argv])
        with contextlib.chdir(cwd or os.curdir):  # where the process begins
            self.process.start()

    def poll(self):
        return self.process.exitcode

    def wait(self):
        self.process.join()

    def send_signal(self, number):
        os.kill(self.process.pid, number)


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
            for many, few in FEWER.items() if cell.cell_type == "code" else ():
                cell.source = cell.source.replace(many, few)
            # CellExecutionError where it fails and may not
            await client.async_execute_cell(cell, i)
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


def untracked(folder):
    """Which files that a lesson wrote git would see, had it run in its own folder."""
    names = [
        f"notebooks/{file.relative_to(folder)}" for file in folder.rglob("*") if file.is_file()
    ]
    if not names or not (ROOT / ".git").exists():
        return []
    command = ["git", "check-ignore", "--no-index", *names]
    ignored = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return sorted({*names} - {*ignored.stdout.splitlines()})


@each_notebook
def test_it_runs_and_its_exercises_pass_solved_and_are_no_error_open(
    path, tmp_path, record_property, monkeypatch
):
    monkeypatch.setattr("jupyter_client.provisioning.local_provisioner.launch_kernel", Fork)
    for tries_left in (2, 1, 0):
        try:
            spent = asyncio.run(played(path, tmp_path))
            break
        except nbclient.exceptions.CellTimeoutError:
            # once in many runs a kernel is idle while the client waits for it
            if not tries_left:
                raise
    record_property("notebook", (path.stem, spent["seconds"], spent["MiB"]))
    assert spent["MiB"] < MEMORY
    assert untracked(tmp_path) == []


def exported(module):
    """The names that a package imports as themselves, for its users."""
    nodes = ast.walk(ast.parse(inspect.getsource(module)))
    names = [alias for node in nodes for alias in getattr(node, "names", ())]
    return {alias.name for alias in names if alias.asname == alias.name}


PUBLIC = {  # module -> what a lesson may take of it; None: whatever has no underscore
    "s4a": {*s4a.__all__, "course", "widgets"},
    "s4a.course": exported(course),
    "s4a.widgets": exported(widgets) | {"threejs"},
    **dict.fromkeys(("s4a_morphometrics", "s4a_morphometrics.synthetic")),
    **{f"s4a.{name}": None for name in ("metrics", "statistics", "synthetic")},
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
        return name[0] != "_" if names is None else name in names

    return [
        f"{module}.{name}"
        for module, name in found
        if re.match(r"s4a(_morphometrics)?(\.|$)", module)
        if (module in PUBLIC or "(" not in module) and not allowed(module, name)
    ]


def test_names_that_are_not_public_are_found():
    wrong = "from s4a.method import fmap\nimport s4a.geometry.mesh as m\n%matplotlib inline\ns4a._x"
    assert not_public(wrong) == ["s4a.method.fmap", "s4a.geometry.mesh", "s4a._x"]
    right = (
        "from s4a.widgets import Modes, threejs\ns4a.synthetic.sphere(9).sizes\nimport s4a.widgets"
    )
    assert not_public(right) == []


def faults_of(path):
    """What is wrong with the text of a lesson, and with the cells of its exercises."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    if any(cell.outputs or cell.execution_count is not None for cell in code):
        yield "it is kept with outputs"
    solved = dict(exercises(notebook))
    for source in (*(cell.source for cell in code), *solved.values()):
        yield from not_public(source)
        if re.search(r"\binteract\w*\(|\bOutput\(", source):
            yield "a slider that captures output, for which a client may wait without end"
    numbers = []
    for i in solved:
        call = notebook.cells[i].source.split(OPEN)[1].strip()
        found = re.fullmatch(r'check\(\s*"(\d\d\.\d)", answer((?:, [\w\[\]"./()]+)*),?\s*\)', call)
        numbers.append(found[1] if found else call)
        if "raises-exception" not in tags(notebook.cells[i]):
            yield f"{numbers[-1]} ends the lesson where its answer is wrong"
    if not numbers or numbers != [number for number in EXERCISES if number[:2] == path.name[:2]]:
        yield f"exercises {numbers}"
    if f'quiz("{path.name[:2]}")' not in [cell.source for cell in code]:
        yield "no quiz"
    table = (NOTEBOOKS / "README.md").read_text(encoding="utf-8")
    if f"{path.name})" not in table:
        yield "it is not in the table of the lessons"


def test_lessons_use_public_names_and_have_exercises_that_let_the_others_run():
    assert [(path.name, fault) for path in LESSONS for fault in faults_of(path)] == []
