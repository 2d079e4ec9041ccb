"""Configuration of the documentation: docstrings, the course, and pages.

No network is needed, to build it or to read it.
"""

import base64
import io
import os
import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path
from types import NoneType
from typing import get_args

import nbformat
from docutils import nodes
from latex2mathml.converter import convert
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import examples
import thumbnails
from slides import WITHOUT_KERNEL

import paper
import s4a
from s4a import cli
from s4a.options import DECLARED, HELP, NOTES
from s4a.schema import TABLE

HERE = Path(__file__).parent
NOTEBOOKS = HERE.parent / "notebooks"
LESSONS = {
    path.name: path
    for folder in (NOTEBOOKS, HERE.parent / "morphometrics" / "notebooks")
    for path in sorted(folder.glob("*.ipynb"))
}
LARGE = 20_000  # characters from which a picture is compressed

project, author = "S4A", "S4A developers"
copyright = author
release = version_of("s4a")
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb"]
extensions += [] if os.environ.get("S4A_DOCS") == "off" else ["sphinx.ext.viewcode"]
exclude_patterns = [
    "_build",
    "_variables.md",
    "_commands.md",
    "_options.md",
    "_performance.md",
    "_tables.md",
]
exclude_patterns += ["performance", "tables"]
root_doc = "index"

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_use_type_comments = False  # there are none
# functions in the contents of their page; a quarter of the time, so that a quick build has none
toc_object_entries = os.environ.get("S4A_DOCS") != "off"
napoleon_google_docstring = False
napoleon_use_param = False  # types are words, not references
napoleon_use_rtype = False
napoleon_preprocess_types = False
default_role = "code"

myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 2
suppress_warnings = ["mystnb.unknown_mime_type"]

# S4A_DOCS=off leaves out the outputs, for a quick build
nb_execution_mode = os.environ.get("S4A_DOCS", "cache")
# S4A_LESSONS="00 04" runs only these lessons
SOME = os.environ.get("S4A_LESSONS", "").split()
if SOME:
    others = {name for name in LESSONS if name[:2] not in SOME}
    nb_execution_excludepatterns = ["gallery.md", *sorted(others)]
nb_execution_cache_path = str(HERE / "_build" / "notebooks")
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_ipywidgets_js = {}  # no script from another server
nb_render_error_lexer = "text"  # for the messages of open exercises
nb_output_stderr = "remove"  # progress bars
nb_mime_priority_overrides = [("html", "text/html", 0)]  # panels as pages without a kernel

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "S4A"
html_static_path = ["_static"]
html_favicon = "_static/favicon.svg"  # otherwise browsers request a missing file
html_css_files = ["s4a.css"]
html_js_files = ["s4a.js"]
html_show_sphinx = False
html_copy_source = False


def show_panels(app, docname, source):
    """Insert the cell that shows panels without a kernel before the first cell of the gallery."""
    if docname == "gallery":
        cell = f"```{{code-cell}}\n:tags: [remove-cell]\n\n{WITHOUT_KERNEL}\n```\n\n"
        source[0] = source[0].replace("```{code-cell}", f"{cell}```{{code-cell}}", 1)


def take_course():
    """Copy the notebooks, each with a cell that shows panels without a kernel."""
    folder = HERE / "course"
    folder.mkdir(exist_ok=True)
    for path in LESSONS.values():
        notebook = nbformat.read(path, as_version=4)
        cell = nbformat.v4.new_code_cell(
            WITHOUT_KERNEL, id="without-kernel", metadata={"tags": ["remove-cell"]}
        )
        notebook.cells.insert(1, cell)
        write(folder / path.name, nbformat.writes(notebook))
    for left in folder.glob("*.ipynb"):
        if left.name not in LESSONS:
            left.unlink()
    lessons = "\n".join(path.stem for path in LESSONS.values())
    words = (NOTEBOOKS / "README.md").read_text(encoding="utf-8")
    words = words.replace("../morphometrics/notebooks/", "")
    write(folder / "index.md", f"{words}\n```{{toctree}}\n:hidden:\n\n{lessons}\n```\n")


def list_variables():
    """Write the table of all variables of a study."""
    rows = [
        f"| `{name}` | {', '.join(dims)} | {unit} | {words.replace('|', chr(92) + '|')} |"
        for name, (dims, unit, words) in TABLE.items()
    ]
    write(
        HERE / "_variables.md",
        "\n".join(["| variable | dims | unit | meaning |", "|---|---|---|---|", *rows]) + "\n",
    )


def list_commands():
    """Write the commands and their flags, as --help prints them."""
    os.environ["COLUMNS"] = "100"
    (commands,) = (
        action for action in cli.parser()._actions if hasattr(action, "choices") and action.choices
    )
    rows = ["| command | |", "|---|---|"]
    for one in commands._choices_actions:
        rows.append(f"| [`s4a {one.dest}`](#s4a-{one.dest}) | {one.help.splitlines()[0]} |")
    parts = ["\n".join(rows) + "\n"]
    for name, sub in commands.choices.items():
        parts.append(f"## s4a {name}\n\n```text\n{sub.format_help()}```\n")
    write(HERE / "_commands.md", "\n".join(parts))


def list_options():
    """Write the table of the options of an analysis."""
    lines, group = [], None
    for name, one in DECLARED.items():
        known = one.metadata
        if known["group"] != group:
            group = known["group"]
            head = "| option | default | values | meaning |\n|---|---|---|---|"
            lines.append(f"\n## {group.capitalize()}\n\n{head}")
        kinds = get_args(one.type) or (one.type,)
        kinds = [getattr(kind, "__name__", "list of str") for kind in kinds if kind is not NoneType]
        values = [f"`{value}`" for value in known["choices"]] or kinds
        presets = "".join(f"; {preset}: `{value}`" for preset, value in known["presets"].items())
        text = f"{HELP[name]}. {NOTES[name]}".strip().replace("|", "\\|").replace("``", "`")
        text = re.sub(r":\w+:`", "`", f"{text[0].upper()}{text[1:]}").replace("*", r"\*")
        lines.append(
            f"| `{name}` | `{known['default']}`{presets} | {' or '.join(values)} | {text} |"
        )
    write(HERE / "_options.md", "\n".join(lines) + "\n")


def list_tables():
    """Write the latest output of the commands of speed, and of those that the pages name."""
    others = [command for command in paper.commands() if command not in paper.SPEED]
    for name, commands in (("performance", paper.SPEED), ("tables", others)):
        files = [paper.kept(command) for command in commands]
        texts = [path.read_text(encoding="utf-8") for path in files if path.exists()]
        # headings of the output are below that of the command
        texts = [re.sub("^#(?=#* )", "###", text, flags=re.MULTILINE) for text in texts]
        text = "\n".join(text.replace("### `", "## `", 1) for text in texts)
        write(HERE / f"_{name}.md", text)


def write(path, text):
    """Write a file if its text has changed, so that Sphinx does not build it again."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def bars(app, what, name, obj, options, lines):
    """Escape the bars of norms, which mark substitutions in reStructuredText."""
    for i, line in enumerate(lines):
        if not re.match(r"\s*(>>>|\.\.\.) ", line):
            lines[i] = re.sub(
                r"``.*?``|:math:`.*?`|(\|)", lambda found: "\\|" if found[1] else found[0], line
            )


def pictures(app, what, name, obj, options, lines):
    """Insert the figure below examples that end in one."""
    if nb_execution_mode == "off" or SOME or what in ("module", "class"):
        return
    if f"{getattr(obj, '__module__', '')}.{getattr(obj, '__name__', '')}" != name:
        return  # imported; it is documented in its own module
    path = examples.draw(name, "\n".join(lines), HERE / "_examples")
    if path is not None:
        words = f"What the last example of {name} shows"
        lines += ["", f".. image:: /_examples/{path.name}", f"   :alt: {words}", ""]


def smaller(found):
    """Convert a picture of a page to WebP: lossless, or lossy if that is too large."""
    picture, small = Image.open(io.BytesIO(base64.b64decode(found[1]))), io.BytesIO()
    picture.save(small, "webp", lossless=True)
    if small.tell() > LARGE:
        small = io.BytesIO()
        picture.save(small, "webp", quality=90)
    return f"data:image/webp;base64,{base64.b64encode(small.getvalue()).decode()}"


STATE = "application/vnd.jupyter.widget-state+json"


def pack_page(app, pagename, templatename, context, doctree):
    """Compress the pictures of a page, remove the states of widgets, give captions a level."""
    scripts = context.get("script_files", [])
    scripts[:] = [one for one in scripts if getattr(one, "attributes", {}).get("type") != STATE]
    tree = context.get("furo_navigation_tree", "")
    context["furo_navigation_tree"] = tree.replace(
        'role="heading"', 'role="heading" aria-level="2"'
    )
    pattern = rf"data:image/png;base64,([A-Za-z0-9+/]{{{LARGE},}}=*)"
    if "body" in context:
        context["body"] = re.sub(pattern, smaller, context["body"])


def front_door(app, env, node, content):
    """Resolve a public name, such as `s4a.analyse`, to the page of its module."""
    name = node.get("reftarget", "").removeprefix("s4a.")
    found = getattr(s4a, name, None) if "." not in name else None
    module = getattr(found, "__module__", None)
    if module is None or node.get("refdomain") != "py":
        return None
    return env.get_domain("py").resolve_xref(
        env, node["refdoc"], app.builder, "func", f"{module}.{name}", node, content
    )


def script(letter):
    """Script character of a letter, because browsers ignore the style."""
    older = {"B": "ℬ", "E": "ℰ", "F": "ℱ", "H": "ℋ", "I": "ℐ", "L": "ℒ", "M": "ℳ", "R": "ℛ"}
    return older.get(letter, chr(0x1D49C + ord(letter) - ord("A")))


def formula(translator, node):
    """Write a formula as MathML, which browsers draw without a script."""
    display = "inline" if isinstance(node, nodes.math) else "block"
    text = node.astext().replace(r"\lVert", r"\|").replace(r"\rVert", r"\|")
    text = re.sub(
        r"\\mathcal\s*(?:\{([A-Z])\}|([A-Z]))", lambda found: script(found[1] or found[2]), text
    )
    text = re.sub(r"\\mathbb\s*\{?R\}?", "ℝ", text)
    text = convert(text, display=display)
    translator.body.append(text if display == "inline" else f'<div class="math">{text}</div>')
    raise nodes.SkipNode


def setup(app):
    """Set up the build; Sphinx calls this before it reads the pages."""
    take_course()
    list_variables()
    list_commands()
    list_options()
    list_tables()
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
    app.connect("source-read", show_panels)
    app.connect("doctree-resolved", thumbnails.add)
    app.connect("autodoc-process-docstring", pictures, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", bars)
    app.connect("missing-reference", front_door)
    app.connect("html-page-context", pack_page, priority=900)  # after myst_nb
