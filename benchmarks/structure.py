"""How the code is built, before and after, and the pages that show it.

``structure.py`` prints a table of measures of the package at a git revision (the parent of the
rooms, or the one given) beside those of the working tree.  ``structure.py --write`` also writes
what is made from the code: the picture ``docs/structure.svg``, the table of ``docs/structure.md``
and the map of the rooms in ``CONTRIBUTING.md``.  It needs the standard library; git for the
revision, ruff for the two rows that name it.
"""

import argparse
import ast
import io
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections import Counter
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
BEFORE = "64f707d"  # the last commit in which all modules lay beside each other
LONG_LINE = 100
LONG_FUNCTION = 60  # lines of code
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)

# The order in which data flow; tests/project/test_imports.py holds every import to it.
ROOMS = (
    "schema",
    "seeds",
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


# --------------------------------------------------------------------------- reading the code


class Module:
    """One file: its text, its tree, and which of its lines hold code."""

    def __init__(self, path: Path, name: str):
        self.path = path
        self.name = name
        self.text = path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text)
        self.docstrings = docstring_nodes(self.tree)
        in_docstring = {
            line for node in self.docstrings for line in range(node.lineno, node.end_lineno + 1)
        }
        self.code, self.comments = code_lines(self.text, in_docstring)

    @property
    def summary(self) -> str:
        """The first paragraph of the docstring on one line."""
        first = (ast.get_docstring(self.tree) or "").split("\n\n")[0]
        return " ".join(first.split())

    @property
    def room(self) -> str:
        return self.name.partition(".")[0]


def docstring_nodes(tree):
    """The docstrings of a module, its classes and its functions."""
    nodes = []
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, *FUNCTION)) and ast.get_docstring(node):
            nodes.append(node.body[0])
    return nodes


def code_lines(text, in_docstring):
    """Numbers of the lines that hold code, and how many hold a comment."""
    layout = {
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENCODING,
        tokenize.ENDMARKER,
    }
    lines = text.splitlines()
    code, comments = set(), set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        first, last = token.start[0], token.end[0]
        if token.type == tokenize.COMMENT:
            comments.add(first)
        elif token.type not in layout:
            code.update(n for n in range(first, last + 1) if lines[n - 1].strip())
    return code - in_docstring, len(comments)


def read_package(folder: Path) -> dict[str, Module]:
    """Every module of a package by its dotted name: ``method.latent``, ``method.__init__``."""
    modules = {}
    for path in sorted(folder.rglob("*.py")):
        name = ".".join(path.relative_to(folder).with_suffix("").parts)
        modules[name] = Module(path, name)
    return modules


def imports_of(modules: dict[str, Module]) -> dict[str, set[str]]:
    """Which modules of the package every module imports, also within functions."""
    graph = {}
    for name, module in modules.items():
        wanted = set()
        for node in ast.walk(module.tree):
            if isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                wanted |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        inside = {w.removeprefix("s4a.") for w in wanted if w.startswith("s4a.")}
        graph[name] = (inside & set(modules)) - {name}
    return graph


# -------------------------------------------------------------------------------- measuring


def assigned_names(module):
    """Every name that an assignment binds, those of unpacked tuples one by one."""
    for node in ast.walk(module.tree):
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            targets = [node.target]
        for target in targets:
            yield from (part.id for part in ast.walk(target) if isinstance(part, ast.Name))


def function_lengths(module):
    """Lines of code of every function, without its docstring and comments."""
    for node in ast.walk(module.tree):
        if isinstance(node, FUNCTION):
            lines = set(range(node.lineno, node.end_lineno + 1))
            yield len(lines & module.code), f"{module.name}.{node.name}"


def statements(module):
    """How many statements a module has, docstrings left out."""
    every = sum(isinstance(node, ast.stmt) for node in ast.walk(module.tree))
    return every - len(module.docstrings)


def signature_lines(module):
    """Numbers of the lines that hold the signatures of functions, up to their first statement."""
    return {
        line
        for node in ast.walk(module.tree)
        if isinstance(node, FUNCTION)
        for line in range(node.lineno, max(node.body[0].lineno, node.lineno + 1))
    }


def public_functions(module):
    """The functions and methods that a reader may call: no part of their name is private."""
    if any(part.startswith("_") for part in module.name.split(".")):
        return
    for node in module.tree.body:
        members = node.body if isinstance(node, ast.ClassDef) else [node]
        if isinstance(node, (ast.ClassDef, *FUNCTION)) and not node.name.startswith("_"):
            for member in members:
                if isinstance(member, FUNCTION) and not member.name.startswith("_"):
                    yield member


def is_annotated(function) -> bool:
    """Whether every argument and the result have a type."""
    rest = [a for a in (function.args.vararg, function.args.kwarg) if a is not None]
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs, *rest]
    needed = [a for a in arguments if a.arg not in ("self", "cls")]
    return function.returns is not None and all(a.annotation is not None for a in needed)


def html_tags(module):
    """How often a tag of HTML opens or closes in a string that is no docstring."""
    documented = {id(node.value) for node in module.docstrings}
    strings = [
        node.value
        for node in ast.walk(module.tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in documented
    ]
    return sum(len(re.findall(r"</?[a-z][a-z0-9]*(?=[\s>/])", text)) for text in strings)


def circles(graph):
    """How many modules lie on a circle of imports."""
    return sum(name in reachable(graph, name) for name in graph)


def reachable(graph, name):
    """The modules that a module imports, and those that these import, and so on."""
    seen, waiting = set(), list(graph[name])
    while waiting:
        needed = waiting.pop()
        if needed not in seen:
            seen.add(needed)
            waiting += graph[needed]
    return seen


def arrows_between_rooms(modules, graph):
    """Counter of (room that imports, room that is imported) over the imports of all modules."""
    arrows = Counter()
    for name, needs in graph.items():
        here = modules[name].room
        for needed in needs:
            there = modules[needed].room
            if here != there and here in ROOMS and there in ROOMS:
                arrows[here, there] += 1
    return arrows


def formatted(folder: Path):
    """The package once more, as ruff formats it at 100 characters; None without ruff."""
    ruff = shutil.which("ruff", path=f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin")
    if ruff is None:
        return None
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / "s4a"
        shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("__pycache__"))
        command = [ruff, "format", "-q", "--isolated", "--line-length", str(LONG_LINE), str(copy)]
        subprocess.run(command, check=True)
        return read_package(copy)


def too_complex(folder: Path):
    """How many functions ruff calls too complex (C901, more than 10 ways); None without ruff."""
    ruff = shutil.which("ruff", path=f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin")
    if ruff is None:
        return None
    limit = "lint.mccabe.max-complexity=10"
    command = [ruff, "check", "--isolated", "--select", "C901", "--config", limit, "-q", folder]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return answer.stdout.count("C901")


def measure(folder: Path) -> dict[str, str]:
    """All measures of a package, as texts."""
    modules = read_package(folder)
    every = list(modules.values())
    graph = imports_of(modules)
    lines = sum(len(module.code) for module in every)
    comments = sum(module.comments for module in every)
    names = [name for module in every for name in assigned_names(module)]
    lengths = [length for module in every for length in function_lengths(module)]
    longest, where = max(lengths)
    functions = [function for module in every for function in public_functions(module)]
    arrows = arrows_between_rooms(modules, graph)
    back = sum(n for (a, b), n in arrows.items() if ROOMS.index(a) < ROOMS.index(b))
    scripts = [p for p in folder.rglob("*") if p.suffix in (".js", ".html", ".css", ".jinja")]
    same_format = formatted(folder)
    same_lines, bodies = "-", "-"
    if same_format is not None:
        same_lines = f"{sum(len(m.code) for m in same_format.values()):,}"
        bodies = f"{sum(len(m.code - signature_lines(m)) for m in same_format.values()):,}"
    complicated = too_complex(folder)
    return {
        "modules": f"{len(every)}",
        "lines of code": f"{lines:,}",
        "lines of code, both formatted by ruff at 100 characters": same_lines,
        "the same without signatures, which types make longer": bodies,
        "statements": f"{sum(map(statements, every)):,}",
        "lines of scripts, styles and templates": (
            f"{sum(len(p.read_text(encoding='utf-8').splitlines()) for p in scripts):,}"
        ),
        "lines over 100 characters": (
            f"{sum(len(row) > LONG_LINE for m in every for row in m.text.splitlines()):,}"
        ),
        "comments per 100 lines of code": f"{100 * comments / lines:.1f}",
        "longest function, lines of code": f"{longest} (`{where}`)",
        "functions of more than 60 lines of code": (
            f"{sum(length > LONG_FUNCTION for length, _ in lengths)}"
        ),
        "functions too complex (ruff C901, 10)": "-" if complicated is None else f"{complicated}",
        "assigned names of one letter": (
            f"{100 * sum(len(n) == 1 and n != '_' for n in names) / len(names):.0f} %"
        ),
        "imports between rooms, along the data": f"{sum(arrows.values()) - back}",
        "imports between rooms, against the data": f"{back}",
        "modules in a circle of imports": f"{circles(graph)}",
        "public functions with all types": (
            f"{sum(map(is_annotated, functions))} of {len(functions)}"
        ),
        "HTML tags in strings of Python": f"{sum(map(html_tags, every))}",
    }


def package_at(revision: str, folder: Path) -> Path | None:
    """The package of a revision, unpacked into a folder; None where git does not have it."""
    command = ["git", "-C", str(ROOT), "archive", revision, "s4a"]
    try:
        archive = subprocess.run(command, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, filter="data")
    return folder / "s4a"


def table(revision: str) -> list[str]:
    """The measures of a revision and of the working tree as rows of Markdown."""
    after = measure(ROOT / "s4a")
    with tempfile.TemporaryDirectory() as temporary:
        package = package_at(revision, Path(temporary))
        before = dict.fromkeys(after, "-") if package is None else measure(package)
    width = max(map(len, after))
    rows = [f"| {'':{width}} | at `{revision}` | now |", f"|{'-' * (width + 2)}|---|---|"]
    return rows + [f"| {name:{width}} | {before[name]} | {after[name]} |" for name in after]


# -------------------------------------------------------------------------- pages from the code


def reference_order() -> list[str]:
    """The modules in the order in which the pages of the reference have them."""
    folder = ROOT / "docs" / "api"
    trees = re.findall(
        r"```\{toctree\}\n(.*?)```", (folder / "index.md").read_text("utf-8"), re.DOTALL
    )
    names = re.findall(r"^[a-z_]+$", "\n".join(trees), re.MULTILINE)
    text = "".join((folder / f"{name}.md").read_text("utf-8") for name in names)
    return re.findall(r"automodule:: s4a\.([\w.]+)\n", text)


def reading_order(modules, room):
    """The modules of a room as the reference has them; those that it lacks by name."""
    known = reference_order()
    inside = [
        name
        for name, module in modules.items()
        if module.room == room and not name.endswith("__init__")
    ]
    rank = {name: i for i, name in enumerate(known)}
    return sorted(inside, key=lambda name: (rank.get(name, len(known)), name))


def room_summary(modules, room):
    """What a room is for: the first paragraph of its docstring."""
    return modules[room if room in modules else f"{room}.__init__"].summary


def room_map(modules: dict[str, Module]) -> str:
    """The rooms and their modules as Markdown: the docstring of each says what it does."""
    parts = []
    for room in ROOMS:
        folder = f"{room}.py" if room in modules else f"{room}/"
        parts.append(f"**`s4a/{folder}`** {room_summary(modules, room)}\n")
        for name in reading_order(modules, room):
            if name != room:
                parts.append(f"- `{name.partition('.')[2]}`: {modules[name].summary}")
        parts.append("")
    return "\n".join(parts).replace("\n\n\n", "\n\n")


# The picture: a band for every room, its modules as chips, and to the right a line for every room
# that runs down past the rooms which may use it.  A disk where it crosses the row of a room holds
# the number of imports; there is no disk above the start of a line, since imports point one way.
#
#     | schema        |
#     | geometry      |<--(1)
#     | input         |<--(4)--(6)
#     | method        |<--(7)-(15)
LEFT, WIDTH, CHIP, ROW, PAD, GAP, COLUMN = 24, 640, 22, 27, 12, 12, 38
COLORS = (
    "#4e6e81 #6d7f8a #3d7ea6 #2a9d8f #d1495b #8f5d9c #c77d1e #7a8b3c #b0577b #4c6ef5 #5f7d4f "
    "#6b6b6b"
).split()


def chips(names):
    """Position in its band and width of the chip of every name, and how many rows they take."""
    placed, x, row = [], PAD, 0
    for name in names:
        width = 7.25 * len(name) + 16
        if x + width > WIDTH - PAD:
            x, row = PAD, row + 1
        placed.append((name, x, row, width))
        x += width + 6
    return placed, row + 1


def svg_text(x, y, text, **style):
    """A line of text; underscores in the names of attributes stand for hyphens."""
    attributes = " ".join(f'{name.replace("_", "-")}="{value}"' for name, value in style.items())
    return f'<text x="{x:.0f}" y="{y:.0f}" {attributes}>{escape(text)}</text>'


def bands(modules):
    """The bands of all rooms as SVG, the middle of each, and where the last one ends."""
    parts, middle, y = [], {}, 96
    for room, color in zip(ROOMS, COLORS, strict=True):
        names = [name.partition(".")[2] for name in reading_order(modules, room)]
        placed, rows = chips([name for name in names if name])
        height = 36 + ROW * rows * bool(placed) + 8 * bool(placed)
        middle[room] = y + 19
        parts += [
            f'<rect x="{LEFT}" y="{y}" width="{WIDTH}" height="{height}" rx="8" fill="{color}" '
            f'fill-opacity="0.10"/>',
            f'<rect x="{LEFT}" y="{y}" width="5" height="{height}" rx="2" fill="{color}"/>',
            f'<text x="{LEFT + 16}" y="{y + 24}"><tspan font-size="16" font-weight="bold" '
            f'fill="{color}">{room}</tspan><tspan dx="12" font-size="11.5" fill="#444">'
            f"{escape(room_summary(modules, room).rstrip('.'))}</tspan></text>",
        ]
        for name, x, row, width in placed:
            top = y + 36 + ROW * row
            parts += [
                f'<rect x="{LEFT + x:.0f}" y="{top}" width="{width:.0f}" height="{CHIP}" rx="5" '
                f'fill="#fff" stroke="{color}" stroke-opacity="0.6"/>',
                svg_text(LEFT + x + 8, top + 15, name, font_size=12, font_family="monospace"),
            ]
        y += height + GAP
    return parts, middle, y


def lines_between(arrows, middle):
    """The line of every room that others use, and the disks where they do."""
    used = [room for room in ROOMS if any(there == room for _, there in arrows)]
    column = {room: LEFT + WIDTH + 48 + COLUMN * i for i, room in enumerate(used)}
    parts = []
    for room, x in column.items():
        color = COLORS[ROOMS.index(room)]
        last = 12 + max(middle[here] for here, there in arrows if there == room)
        parts += [
            f'<path d="M{LEFT + WIDTH} {middle[room]} H{x - 8} Q{x} {middle[room]} {x} '
            f'{middle[room] + 8} V{last}" fill="none" stroke="{color}" stroke-width="2" '
            f'stroke-opacity="0.55"/>',
            svg_text(x, 84, room, fill=color, transform=f"rotate(-38 {x} 84)", font_size=12),
        ]
    for here in ROOMS:
        taps = {there: n for (user, there), n in arrows.items() if user == here}
        if taps:
            y, far = middle[here] + 12, max(column[there] for there in taps)
            parts.append(
                f'<path d="M{far} {y} H{LEFT + WIDTH + 9}" stroke="#999" stroke-width="1.2" '
                f'marker-end="url(#head)"/>'
            )
    for (here, there), count in sorted(arrows.items()):
        x, y = column[there], middle[here] + 12
        radius = 8 + min(count, 30) * 0.12
        parts += [
            f'<circle cx="{x}" cy="{y}" r="{radius:.1f}" fill="{COLORS[ROOMS.index(there)]}">'
            f"<title>{here} imports {count} times from {there}</title></circle>",
            svg_text(x, y + 4, str(count), font_size=10.5, fill="#fff", text_anchor="middle"),
        ]
    return parts, max(column.values())


def picture(modules: dict[str, Module]) -> str:
    """The rooms, their modules and the imports between them as an SVG."""
    graph = imports_of(modules)
    rooms, middle, height = bands(modules)
    lines, right = lines_between(arrows_between_rooms(modules, graph), middle)
    width = right + 56
    head = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height + 8}" '
        f'viewBox="0 0 {width} {height + 8}" font-family="Helvetica, Arial, sans-serif">',
        "<title>The rooms of s4a, their modules, and the imports between them</title>",
        '<defs><marker id="head" markerWidth="8" markerHeight="8" refX="6" refY="4" orient="auto">'
        '<path d="M0 0 L8 4 L0 8 z" fill="#999"/></marker></defs>',
        f'<rect width="{width}" height="{height + 8}" fill="#fff"/>',
        svg_text(LEFT, 38, "The rooms of s4a", font_size=22, font_weight="bold", fill="#222"),
        svg_text(
            LEFT,
            60,
            "Data flow downwards, and a room imports only from those above it.",
            font_size=13,
            fill="#444",
        ),
        svg_text(
            LEFT,
            78,
            "A disk says how many times, on the line of the room that is imported.",
            font_size=13,
            fill="#444",
        ),
    ]
    return "\n".join([*head, *rooms, *lines, "</svg>"]) + "\n"


def with_part(path: Path, mark: str, text: str) -> str:
    """A page with the text between its two comments that bear the mark."""
    page = path.read_text(encoding="utf-8")
    pattern = rf"(<!-- {mark}:[^>]*-->\n).*?(<!-- end of {mark} -->)"
    new, times = re.subn(
        pattern, lambda m: f"{m[1]}\n{text.strip()}\n\n{m[2]}", page, flags=re.DOTALL
    )
    if times != 1:
        raise ValueError(f"{path} needs the two comments of '{mark}' once, it has them {times}x")
    return new


def pages() -> dict[Path, str]:
    """What is made from the code alone: the picture and the map of the rooms."""
    modules = read_package(ROOT / "s4a")
    contributing = ROOT / "CONTRIBUTING.md"
    return {
        ROOT / "docs" / "structure.svg": picture(modules),
        contributing: with_part(contributing, "rooms", room_map(modules)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("revision", nargs="?", default=BEFORE)
    parser.add_argument("--write", action="store_true", help="writes the pages made from the code")
    options = parser.parse_args()
    if options.write:
        for path, text in pages().items():
            path.write_text(text, encoding="utf-8")
    rows = "\n".join(table(options.revision))
    sys.stdout.write(rows + "\n")
    if options.write:
        page = ROOT / "docs" / "structure.md"
        page.write_text(with_part(page, "measures", rows), encoding="utf-8")


if __name__ == "__main__":
    main()
