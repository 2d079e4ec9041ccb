"""How the code is built: a picture, a table and a map, made from the modules themselves.

``python tools/structure.py`` prints a table of the subpackages of s4a; ``--write`` (``make
structure``) also writes the picture ``docs/structure.svg``, the table of ``docs/structure.md`` and
the map of the modules in ``CONTRIBUTING.md``.  It needs the standard library only.
"""

import argparse
import ast
import re
import sys
from collections import Counter
from html import escape
from pathlib import Path

from weight import lines_of

ROOT = Path(__file__).resolve().parents[1]
EXTENSION = ROOT / "morphometrics" / "s4a_morphometrics"

# The order in which data flow: each imports only from those before it (tests/project/test_imports)
SUBPACKAGES = (
    "extensions",
    "schema",
    "seeds",
    "options",
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
# outside of that order, as they bring the others together
FRONT = ("__init__", "__main__", "accessor", "course")


def modules_of(folder=ROOT / "s4a"):
    """The modules of a package by dotted name; ``method`` is ``method/__init__.py``."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" and parts[1:] else parts)] = path
    return found


def imports_of(path, package="s4a"):
    """The names below a package that a module imports, also within functions: ``method.fmap``."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {"." * node.level + f"{node.module}"}
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.removeprefix(f"{package}.") for name in found if name.startswith(f"{package}.")}


def arrows(modules):
    """Counter of (subpackage that imports, subpackage that is imported) over all modules."""
    found = Counter()
    for name, path in modules.items():
        for needed in imports_of(path) & {*modules}:
            ends = name.partition(".")[0], needed.partition(".")[0]
            if ends[0] != ends[1] and {*ends} <= {*SUBPACKAGES}:
                found[ends] += 1
    return found


def summary(path):
    """What a module is for: the first paragraph of its docstring, on one line."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return " ".join((ast.get_docstring(tree) or "").split("\n\n")[0].split())


def inside(modules, subpackage):
    """The modules of a subpackage in the order of the reference; those that it lacks by name."""
    folder = ROOT / "docs" / "api"
    pages = re.findall(r"^[a-z_]+$", (folder / "index.md").read_text("utf-8"), re.MULTILINE)
    text = "".join(p.read_text("utf-8") for n in pages if (p := folder / f"{n}.md").exists())
    known = re.findall(r"automodule:: s4a\.([\w.]+)\n", text)
    names = [name for name in modules if name.startswith(f"{subpackage}.")]
    return sorted(names, key=lambda n: (known.index(n) if n in known else len(known), n))


def table(modules):
    """A row for every subpackage: its modules, their lines, and what it imports from others."""
    rows = [
        "| `s4a/` | modules | lines of code | of docstrings | imports from |",
        "|---|--:|--:|--:|---|",
    ]
    uses = arrows(modules)
    for one in SUBPACKAGES:
        lines = [lines_of(path) for n, path in modules.items() if n.partition(".")[0] == one]
        code, words = (sum(map(len, part)) for part in zip(*lines, strict=True))
        needed = ", ".join(f"{to} {uses[one, to]}" for to in SUBPACKAGES if uses[one, to])
        rows.append(f"| `{one}` | {len(lines)} | {code:,} | {words:,} | {needed or '–'} |")
    return "\n".join(rows)


def module_map(modules):
    """The subpackages and their modules as Markdown; the docstring of each says what it does."""
    parts = []
    for one in SUBPACKAGES:
        suffix = ".py" if modules[one].stem == one else "/"
        parts += [f"**`s4a/{one}{suffix}`** {summary(modules[one])}", ""]
        lines = [f"- `{n.partition('.')[2]}`: {summary(modules[n])}" for n in inside(modules, one)]
        parts += [*lines, ""] if lines else []
    extension = modules_of(EXTENSION)
    parts += [f"**`{EXTENSION.relative_to(ROOT)}/`** {summary(extension.pop('__init__'))}", ""]
    return "\n".join(parts + [f"- `{name}`: {summary(path)}" for name, path in extension.items()])


# The picture: a band for every subpackage, its modules as chips, and to the right a line for every
# subpackage that runs down past those that use it.  A disk where it crosses their row holds the
# number of imports; there is no disk above the start of a line, since imports point one way.
#
#     | schema        |
#     | geometry      |<--(1)
#     | input         |<--(4)--(6)
#     | method        |<--(7)-(15)
LEFT, WIDTH, ROW, COLUMN = 24, 640, 27, 38
COLORS = (
    "#86654b #4e6e81 #6d7f8a #3d7ea6 #2a9d8f #d1495b #8f5d9c #c77d1e #7a8b3c #b0577b #4c6ef5 "
    "#5f7d4f #a0522d #6b6b6b"
).split()


def tag(name, text="", **attributes):
    """An element of SVG; underscores in the names of attributes stand for hyphens."""
    said = " ".join(f'{key.replace("_", "-")}="{value}"' for key, value in attributes.items())
    return f"<{name} {said}>{text}</{name}>"


def bands(modules):
    """The bands of all subpackages, the middle of each, and where the last one ends."""
    parts, middle, y = [], {}, 90
    for one, color in zip(SUBPACKAGES, COLORS, strict=True):
        middle[one], begin = y + 19, len(parts)
        x, row = 12, 36
        for name in (name.partition(".")[2] for name in inside(modules, one)):
            width = round(7.25 * len(name) + 16)
            if x + width > WIDTH - 12:
                x, row = 12, row + ROW
            box = {"x": LEFT + x, "y": y + row, "width": width, "height": 22, "rx": 5}
            parts.append(tag("rect", fill="#fff", stroke=color, **box))
            at = {"x": LEFT + x + 8, "y": y + row + 15}
            parts.append(tag("text", name, font_size=12, font_family="monospace", **at))
            x += width + 6
        height = row + ROW + 4 if len(parts) > begin else 36
        box = {"x": LEFT, "y": y, "width": WIDTH, "height": height, "rx": 8}
        parts.insert(begin, tag("rect", fill=color, fill_opacity=0.1, **box))
        head = tag("tspan", one, font_size=16, font_weight="bold", fill=color)
        words = tag(
            "tspan",
            escape(summary(modules[one]).rstrip(".").replace("`", "")),
            dx=12,
            font_size=11.5,
        )
        parts.append(tag("text", head + words, x=LEFT + 16, y=y + 24, fill="#444"))
        y += height + 12
    return parts, middle, y


def lines_between(uses, middle):
    """The line of every subpackage that others use, the disks where they do, and the right end."""
    used = [one for one in SUBPACKAGES if any(to == one for _, to in uses)]
    column = {one: LEFT + WIDTH + 48 + COLUMN * i for i, one in enumerate(used)}
    color = dict(zip(SUBPACKAGES, COLORS, strict=True))
    parts = []
    for one, x in column.items():
        last = 12 + max(middle[user] for user, to in uses if to == one)
        y = middle[one]
        path = f"M{LEFT + WIDTH} {y} H{x - 8} Q{x} {y} {x} {y + 8} V{last}"
        parts.append(tag("path", d=path, fill="none", stroke=color[one], stroke_width=2))
        turned = {"transform": f"rotate(-38 {x} 84)", "font_size": 12}
        parts.append(tag("text", one, x=x, y=84, fill=color[one], **turned))
    for user in SUBPACKAGES:
        ends = [column[to] for one, to in uses if one == user]
        if ends:
            path = f"M{max(ends)} {middle[user] + 12} H{LEFT + WIDTH + 4} l6 -4 m-6 4 l6 4"
            parts.append(tag("path", d=path, stroke="#999", fill="none"))
    for (user, to), count in sorted(uses.items()):
        x, y = column[to], middle[user] + 12
        title = tag("title", f"{user} imports {count} times from {to}")
        parts.append(tag("circle", title, cx=x, cy=y, r=8 + 0.12 * min(count, 30), fill=color[to]))
        text = {"font_size": 10.5, "fill": "#fff", "text_anchor": "middle"}
        parts.append(tag("text", count, x=x, y=y + 4, **text))
    return parts, max(column.values()) + 56


def picture(modules):
    """The subpackages, their modules and the imports between them as an SVG."""
    boxes, middle, height = bands(modules)
    lines, width = lines_between(arrows(modules), middle)
    words = (
        "An import points upwards; a disk counts those of a subpackage from the one of its line."
    )
    text = [
        tag("title", "The subpackages of s4a, their modules, and the imports between them"),
        tag("rect", width=width, height=height, fill="#fff"),
        tag("text", "The subpackages of s4a", x=LEFT, y=38, font_size=22, font_weight="bold"),
        tag("text", words, x=LEFT, y=60, font_size=13, fill="#444"),
    ]
    size = {"width": width, "height": height, "viewBox": f"0 0 {width} {height}"}
    font = {"font_family": "Helvetica, Arial, sans-serif", "xmlns": "http://www.w3.org/2000/svg"}
    return tag("svg", "\n".join(["", *text, *boxes, *lines, ""]), **size, **font) + "\n"


def with_part(path, mark, text):
    """A page with the text between its two comments that bear the mark."""
    page = path.read_text(encoding="utf-8")
    pattern = rf"(<!-- {mark}:[^>]*-->\n).*?(<!-- end of {mark} -->)"
    new, times = re.subn(pattern, lambda m: f"{m[1]}\n{text}\n\n{m[2]}", page, flags=re.DOTALL)
    if times != 1:
        raise ValueError(f"{path} needs the two comments of '{mark}' once, it has them {times}x")
    return new


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write picture, table and map")
    modules = modules_of()
    if parser.parse_args().write:
        (ROOT / "docs" / "structure.svg").write_text(picture(modules), encoding="utf-8")
        page, contributing = ROOT / "docs" / "structure.md", ROOT / "CONTRIBUTING.md"
        page.write_text(with_part(page, "table", table(modules)), encoding="utf-8")
        made = with_part(contributing, "modules", module_map(modules).strip())
        contributing.write_text(made, encoding="utf-8")
    sys.stdout.write(table(modules) + "\n")


if __name__ == "__main__":
    main()
