"""The documentation: what a page names exists, and a figure that it quotes has a command."""

import importlib
import pkgutil
import re
from pathlib import Path

from matplotlib.figure import Figure
from paths import DOCS, LESSONS, NOTEBOOKS, ROOT, TESTS, benchmark, script
from PIL import Image

from s4a.options import PRESETS, Options
from s4a.schema import TABLE

figures = script(DOCS / "figures.py")
paper = script(ROOT / "tools" / "paper.py")
KINDS = (".", "api", "explanation", "howto")
PAGES = [page for kind in KINDS for page in sorted((DOCS / kind).glob("[!_]*.md"))]
READ = [*PAGES, NOTEBOOKS / "README.md", *LESSONS, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
CODE = [ROOT / "s4a", ROOT / "morphometrics", TESTS, ROOT / "benchmarks"]


def text(path):
    return path.read_text(encoding="utf-8")


def test_every_page_is_reached_and_every_link_between_pages_leads_somewhere():
    lists = ("index.md", "api/index.md", "howto/index.md", "method.md")
    contents = "".join(text(DOCS / name) for name in lists)
    inside = "\n".join(re.findall(r"```\{toctree\}\n(.*?)```", contents, re.DOTALL))
    inside = inside.replace("explanation/", "").split()
    apart = [page.name for page in PAGES if page.stem not in ("index", *inside)]
    assert apart == []
    broken, lessons = [], {path.name for path in LESSONS}
    for page in [*PAGES, ROOT / "README.md"]:
        for link in re.findall(r"\]\((?!http|#)([^)#]+)[^)]*\)", text(page)):
            name = link.rpartition("course/")[2].replace("index.md", "README.md")
            if not (
                (page.parent / link).exists() or (NOTEBOOKS / name).exists() or name in lessons
            ):
                broken.append((page.name, link))
    assert broken == []


def exists(name):
    """Whether a dotted name is a module or in one."""
    try:
        return bool(pkgutil.resolve_name(name))
    except (ImportError, AttributeError):
        return False


def test_every_file_and_every_name_of_s4a_that_a_page_names_exists():
    folders = "s4a|morphometrics|tests|benchmarks|tools|docs|binder|notebooks"
    file = re.compile(rf"\b(?:{folders})/[\w/]*\w\.(?:py|md|svg|ipynb)")
    name = re.compile(r"`(s4a(?:_morphometrics)?(?:\.[a-zA-Z]\w*)+)")
    groups = ("s4a.commands", "s4a.panels", "s4a.variables", "s4a.widgets.Size")  # of extensions
    wrong = []
    for page in READ:
        wrong += [(page.name, one) for one in file.findall(text(page)) if not (ROOT / one).exists()]
        names = {*name.findall(text(page))} - {*groups}
        wrong += [(page.name, one) for one in names if not exists(one)]
    assert wrong == []


def test_the_names_in_how_to_add_are_in_the_code():
    page = text(ROOT / "CONTRIBUTING.md")
    recipes = page[page.index("## How to add") : page.index("## The rules of the project")]
    code = "".join(text(path) for folder in CODE for path in folder.rglob("*.py"))
    names = {*re.findall(r"`([A-Za-z]\w+)`", recipes)} - {"_read_x", "_x_bytes"}
    assert len(names) > 15
    assert [name for name in sorted(names) if not re.search(rf"\b{name}\b", code)] == []


def words_that_are_unknown(command):
    """The words of a command that its script does not take."""
    name, *words = command
    code, known = text(paper.BENCHMARKS / name), vars(benchmark(name.removesuffix(".py")))
    listed = {word for group in ("PARTS", "SETS", "REPORTED") for word in known.get(group, ())}
    for before, word in zip(["", *words], words, strict=False):
        free = before.startswith("--") or word.isdigit()
        if f'"{word}"' not in code and not free and word not in (*listed, *known):
            yield f"{name} {word}"


# what looks measured: a number with a unit, or a cell of a table with two digits after the point
FIGURE = re.compile(
    r"\d[\d,.]*\s?(?:%(?!\w)|seconds\b|GB\b|GiB\b|CPU s|s\b|mm\b)|\|\s*\**\d+\.\d\d+\**\s*\|"
)
LIMIT = re.compile(r"`[\w/]*test_\w+\.py")  # a figure that a test holds is a limit
# sections whose figures are limits in the code, or measured once, as their page says
EXEMPT = {("docs/plausibility.md", "# Validation of quality control")}


def test_a_section_that_quotes_a_figure_names_a_command_or_the_test_that_holds_it():
    without = []
    for page in paper.PAGES:
        said = re.sub(
            r"\]\([^)]*\)|<!-- /?unpublished -->", "]", paper.FENCE.sub("", text(ROOT / page))
        )
        head, *others = [(part.split("\n")[0], part) for part in re.split(r"\n(?=## )", said)]
        if page == "docs/decisions.md" or (paper.commands_in(head[1]) and page[:5] == "docs/"):
            continue  # the head of the page says where its figures come from
        for title, part in [head, *others]:
            named = paper.commands_in(part) or LIMIT.search(part) or (page, title) in EXEMPT
            without += [] if named or not FIGURE.search(part) else [(page, title)]
    assert without == []


def test_every_command_on_a_page_is_a_script_that_takes_these_words():
    commands = {*paper.commands(), *paper.SPEED}
    assert len(commands) > 30
    assert [word for command in commands for word in words_that_are_unknown(command)] == []
    found = paper.commands_in(
        "`python benchmarks/claims.py remesh`, `additions.py --write`, `s4a demo`"
    )
    assert found == [("claims.py", "remesh"), ("additions.py",)]


def test_every_claim_of_the_paper_has_a_verdict_and_the_test_that_guards_it():
    wrong = []
    rows = [
        line.strip("|\n").split(" | ")
        for line in text(DOCS / "claims.md").splitlines()
        if line[:2] == "| "
    ]
    for section, claim, verdict, _, command, guard in rows[2:]:
        verdicts = ("holds", "holds in part", "does not hold", "not tested")
        wrong += [] if section and verdict in verdicts else [(claim, verdict)]
        wrong += (
            [] if "`" in command + guard or verdict == "not tested" else [(claim, "no command")]
        )
        for file, test in re.findall(r"`(test_\w+\.py)::(test_\w+)`", guard):
            there = any(f"def {test}(" in text(path) for path in TESTS.rglob(file))
            wrong += [] if there else [(claim, f"{file}::{test}")]
    assert wrong == []
    sections = {part for row in rows for part in row[0].strip("| ").split(", ")}
    assert {"abstract", "4.1", "4.2", "5.2", "5.3", "6.1", "6.2"} <= sections


def test_every_switch_of_the_preset_is_on_the_page_of_differences_and_every_row_is_an_analysis():
    differences, additions = benchmark("differences"), benchmark("additions")
    page = differences.page(differences.results())
    for name, value in PRESETS["paper"].items():
        own = differences.quoted(getattr(Options(), name))
        assert f"| `{name}`: {own}, {differences.quoted(value)}" in page
    rows = additions.study_rows() | additions.pair_rows()
    for options in rows.values():
        assert Options(**{name: value for name, value in options.items() if name != "template"})
    assert {row for _, row in differences.results()} <= {*rows}


def test_what_a_command_prints_is_kept_with_its_machine_and_one_that_takes_too_long_is_ended(
    tmp_path, monkeypatch, capsys
):
    for name in ("ROOT", "BENCHMARKS", "TABLES"):
        monkeypatch.setattr(paper, name, tmp_path)
    (tmp_path / "good.py").write_text("print('| a |')")
    (tmp_path / "slow.py").write_text("import time\nprint('begun', flush=True)\ntime.sleep(99)\n")
    (tmp_path / "slow.md").write_text("of before\n\nIt ended with 1.")
    monkeypatch.setattr(paper, "commands", lambda: [("good.py",), ("slow.py",)])
    assert paper.main(["--minutes=0.02"]) == 1
    assert "nothing: not at its end after 1 s" in capsys.readouterr().out
    assert text(tmp_path / "slow.md").startswith("of before")
    printed, foot = text(tmp_path / "good.md").split("\n---\n")
    assert "| a |" in printed
    assert re.search(r"cores.*S4A [\d.]+.*Python 3\.\d+.*numpy [\d.]+.*xarray [\d.]+", foot)
    assert paper.main(["--rest", "--list"]) == 0
    assert capsys.readouterr().out == "slow.py\n", "a night goes on with what has not ended well"


def test_every_picture_of_the_pages_is_drawn_by_a_command_and_the_film_is_small():
    pages = [ROOT / "README.md", *PAGES]
    links = [
        link for page in pages for link in re.findall(r"!\[[^\]]*\]\((?!http)([^)]+)\)", text(page))
    ]
    assert {Path(link).stem for link in links} == {*figures.PICTURES, "heads", "structure"}
    assert links[0] == "docs/modes.gif"
    assert (ROOT / links[0]).stat().st_size < 3e6
    # of data that are not given away, only the command is kept
    said = "".join(map(text, DOCS.glob("*.md")))
    for name in figures.LOCAL:
        assert f"`make figures NAME={name}`" in said
        assert not (DOCS / f"{name}.png").exists()
    folder = figures.LOCAL_FOLDER.relative_to(ROOT).as_posix()
    assert f"/{folder}/" in text(ROOT / ".gitignore").splitlines()


def test_the_figures_of_the_paper_are_drawn_from_a_study(study_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "HERE", tmp_path)
    study = importlib.import_module("s4a").open_study(study_folder)
    figure = Figure(figsize=(11, 7))
    above, below = figure.subfigures(2)
    figures.pipeline(above, study)
    figures.components(below, study)
    for path in (figures.write(figure, "figure_1"), figures.variance(study)):
        with Image.open(path) as picture:
            assert picture.width > 400
            assert len(picture.convert("RGB").getcolors(256)) > 20
    with Image.open(figures.film(study, n_frames=2)) as film:
        assert (film.n_frames, film.width) == (2, 720)
    assert len([*tmp_path.iterdir()]) == 3, "not over the pictures of the pages"


def test_every_public_name_is_in_the_table_of_names():
    public = re.findall(r"import (\w+) as \1$", text(ROOT / "s4a/__init__.pyi"), re.MULTILINE)
    packages = {path.parent.name for path in (ROOT / "s4a").glob("*/__init__.py")}
    page = text(DOCS / "names.md")
    assert [n for n in public if f"`s4a.{n}`" not in page and n not in packages] == []


def test_the_drawing_of_a_study_agrees_with_the_schema():
    units = {"L": "unit of the input", "√area": "share of sqrt(area)"}
    rows = re.findall(r"^[│ ]+(\w+) +\((.*?)\) +(\S+)", text(DOCS / "data_model.md"), re.MULTILINE)
    for name, dims, unit in rows:
        assert TABLE[name][0] == tuple(dims.split(", ")), name
        assert TABLE[name][1].split(",")[0] == units.get(unit, unit), name
    assert len(rows) > 30


def test_the_glossary_agrees_with_the_schema_and_has_every_equation():
    page, wrong, checked = text(DOCS / "glossary.md"), [], 0
    for line in page.splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for name in re.findall(r"`/\w+(?:/<shape>)?: (\w+)`", cells[2] if len(cells) == 4 else ""):
            others = [n for n in re.findall(r"`(\w+)`", cells[2]) if n in TABLE]
            known = [", ".join(TABLE[n][0]) for n in (name, *others) if n in TABLE]
            known += [dims.removeprefix("shape, ") for dims in known]
            wrong += [] if name in TABLE and cells[3] in known else [(name, cells[3], known)]
            checked += 1
    assert wrong == []
    assert checked > 25
    assert {int(n) for n in re.findall(r"\(eq\. (\d+)\)", page)} == {*range(1, 12)}
