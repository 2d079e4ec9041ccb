"""How much there is of S4A: modules, lines, options, names, tests, bytes of the wheel.

``python tools/weight.py [REVISION] [--count]``, or ``make weight REVISION=...``, prints a table of
the working tree and, where a revision of git is named, of that one next to it. Lines of code are
those without docstrings, comments and blank lines. ``--count`` lets pytest count the tests (slow).
"""

import argparse
import ast
import io
import os
import re
import subprocess
import sys
import tempfile
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# distribution -> folder of its project, package, folder of its tests
PARTS = {
    "s4a": (".", "s4a", "tests"),
    "s4a-morphometrics": (
        "morphometrics",
        "morphometrics/s4a_morphometrics",
        "morphometrics/tests",
    ),
}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
SILENT = {getattr(tokenize, name) for name in "COMMENT NL NEWLINE INDENT DEDENT ENDMARKER".split()}
OPTIONS = """import inspect
try:
    from s4a.options import Options
except ImportError:  # of revisions before
    from s4a.study.options import Options
print(len(inspect.signature(Options).parameters))"""
NAMES = """import s4a, pathlib
folder = pathlib.Path(s4a.__file__).parent
print(sum(not (folder / name).is_dir() for name in s4a.__all__))"""
WHEEL = "import hatchling.build as b, sys; print(b.build_wheel(sys.argv[1]))"


def lines_of(path):
    """The lines of a module that are code, and those of its docstrings."""
    source = path.read_text(encoding="utf-8")
    words = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node):
            words |= {*range(node.body[0].lineno, node.body[0].end_lineno + 1)}
    code = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in SILENT:
            code |= {*range(token.start[0], token.end[0] + 1)}
    return code - words, words


def public_names(path):
    """The functions, classes and constants of a module without an underscore."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [node]
        names = [getattr(one, "name", getattr(one, "id", "_")) for one in targets]
        yield from (name for name in names if name[0] != "_")


def printed(root, folder, code, *words):
    """What Python prints in a folder, with the packages of this tree; "" if it fails."""
    paths = os.pathsep.join(str(root / part[0]) for part in PARTS.values())
    command = [sys.executable, *(["-c", code] if code else []), *words]
    env = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def bytes_of_wheel(root, folder):
    """The bytes of the wheel of a project."""
    with tempfile.TemporaryDirectory() as out:
        printed(root, folder, WHEEL, out)
        return sum(wheel.stat().st_size for wheel in Path(out).glob("*.whl"))


def measures(root, count=False):
    """Name of each measure -> its value, of the tree in a folder."""
    found = {}
    for name, (project, package, tests) in PARTS.items():
        modules = sorted((root / package).rglob("*.py"))
        if not modules:
            continue
        lines = [lines_of(path) for path in modules]
        with open(root / project / "pyproject.toml", "rb") as file:
            needed = tomllib.load(file)["project"].get("dependencies", [])
        checks = [path for path in (root / tests).rglob("*.py") if "benchmarks" not in path.parts]
        found |= {
            f"{name}: modules": len(modules),
            f"{name}: lines of code": sum(len(code) for code, _ in lines),
            f"{name}: lines of docstrings": sum(len(words) for _, words in lines),
            f"{name}: public names in modules": sum(len([*public_names(p)]) for p in modules),
            f"{name}: lines of tests": sum(p.read_text("utf-8").count("\n") for p in checks),
            f"{name}: bytes of the wheel": bytes_of_wheel(root, root / project),
            f"{name}: dependencies": len(needed),
        }
    found["s4a: public names of the package"] = printed(root, root, NAMES)
    found["s4a: options"] = printed(root, root, OPTIONS)
    if count:
        said = printed(root, root, "", "-m", "pytest", "--collect-only", "-q")
        found["tests, collected"] = (re.findall(r"^(\d+)(?:/\d+)? tests", said, re.M) or [""])[-1]
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("revision", nargs="?", help="of git, such as HEAD~10, to print as well")
    parser.add_argument("--count", action="store_true", help="let pytest count the tests (slow)")
    options = parser.parse_args()
    columns = {"now": measures(ROOT, options.count)}
    if options.revision:
        with tempfile.TemporaryDirectory() as folder:
            archive = ["git", "archive", "--format=tar", options.revision]
            tar = subprocess.run(archive, cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
            subprocess.run(["tar", "-x", "-C", folder], input=tar, check=True)
            columns[options.revision] = measures(Path(folder), options.count)
    rows = dict.fromkeys(name for column in columns.values() for name in column)
    lines = [f"| | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name in sorted(rows, key=lambda name: name.partition(":")[0]):
        values = [str(column.get(name, "")) for column in columns.values()]
        lines.append(f"| {name} | {' | '.join(f'{int(v):,}' if v else '–' for v in values)} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
