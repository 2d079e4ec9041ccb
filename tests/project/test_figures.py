"""A figure that a page quotes has a command that prints it, and `make paper` runs that command."""

import re
import shlex
import tempfile
import time
from pathlib import Path

import pytest
import s4a_morphometrics.synthetic
from paths import DOCS, ROOT, benchmark, script
from PIL import Image

import s4a

figures = script(DOCS / "figures.py")
paper = script(ROOT / "tools" / "paper.py")

# what looks measured: a number with a unit, or a cell of a table with two digits after the point
FIGURE = re.compile(
    r"\d[\d,.]*\s?(?:%(?!\w)|seconds\b|GB\b|GiB\b|CPU s|s\b|mm\b)|\|\s*\**\d+\.\d\d+\**\s*\|"
)
LIMIT = re.compile(r"`[\w/]*test_\w+\.py")  # a figure that a test holds is a limit
# sections whose figures are limits in the code, or measured once, as their page says
EXEMPT = {("docs/plausibility.md", "# What is told of an odd shape, and what cannot be")}
ONCE = "Figures without a command were measured once and are there to plan with."


def sections(page):
    """Title and text of the sections of a page, without what is code or an address."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"\]\([^)]*\)|<!-- /?unpublished -->", "]", paper.FENCE.sub("", text))
    return [(part.split("\n")[0], part) for part in re.split(r"\n(?=## )", text)]


@pytest.mark.parametrize("page", paper.PAGES)
def test_a_section_that_quotes_a_figure_names_a_command_or_the_test_that_holds_it(page):
    if ONCE in (DOCS / "decisions.md").read_text("utf-8") and page == "docs/decisions.md":
        return
    parts = sections(page)
    if paper.commands_in(parts[0][1]) and page.startswith("docs/"):
        return  # the head of the page names what makes its tables
    without = [
        (title, FIGURE.findall(text)[:3])
        for title, text in parts
        if FIGURE.search(text)
        and not paper.commands_in(text)
        and not LIMIT.search(text)
        and (page, title) not in EXEMPT
    ]
    assert without == []


def test_a_figure_without_a_command_is_seen():
    assert FIGURE.search("it takes 12.5 s")
    assert FIGURE.search("| ours | 0.24 |")
    assert not FIGURE.search("| 3.4 | network |")
    assert paper.commands_in("no command, but `s4a demo`") == []


@pytest.mark.parametrize("command", dict.fromkeys((*paper.commands(), *paper.SPEED)), ids=" ".join)
def test_every_command_is_a_script_that_takes_these_words(command):
    name, *words = command
    text = (paper.BENCHMARKS / name).read_text(encoding="utf-8")
    script = benchmark(name.removesuffix(".py"))
    known = {*getattr(script, "PARTS", ()), *getattr(script, "SETS", ())}
    known |= {*getattr(script, "REPORTED", ())}
    for before, word in zip(["", *words], words, strict=False):
        if word.startswith("--"):
            assert f'"{word}"' in text, word
        elif not before.startswith("--") and not word.isdigit():
            found = word in known or hasattr(script, word) or f'"{word}"' in text
            assert found, word


def test_commands_are_found_on_pages_as_they_are_written():
    text = "`python benchmarks/claims.py remesh`, `speed.py whole 51 100000`, `test_x.py`"
    assert paper.commands_in(text) == [
        ("claims.py", "remesh"),
        ("speed.py", "whole", "51", "100000"),
    ]
    assert paper.commands_in("`additions.py --write`\n```sh\n`poses.py`\n```") == [
        ("additions.py",)
    ]


def test_what_a_command_prints_is_kept_with_machine_and_versions_at_its_foot(tmp_path, monkeypatch):
    monkeypatch.setattr(paper, "BENCHMARKS", tmp_path)
    monkeypatch.setattr(paper, "TABLES", tmp_path / "out")
    (tmp_path / "good.py").write_text("import sys; print('| a |', sys.argv[1:])")
    (tmp_path / "bad.py").write_text("raise SystemExit(3)")
    path, code = paper.run(("good.py", "two words"))
    text = path.read_text(encoding="utf-8")
    assert code == 0
    assert "| a | ['two words']" in text
    foot = text.split("\n---\n")[1]
    assert "cores" in foot
    assert re.search(r"S4A [\d.]+.*Python 3\.\d+.*numpy [\d.]+.*xarray [\d.]+", foot)
    path, code = paper.run(("bad.py",))
    assert code == 3
    assert "It ended with 3." in path.read_text(encoding="utf-8")


def test_a_night_that_was_too_short_goes_on_with_what_has_not_ended_well(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "good.py").write_text("print(1)")
    (tmp_path / "bad.py").write_text("raise SystemExit(3)")
    for name in ("ROOT", "BENCHMARKS", "TABLES"):
        monkeypatch.setattr(paper, name, tmp_path)
    monkeypatch.setattr(paper, "commands", lambda: [("good.py",), ("bad.py",)])
    assert paper.main([]) == 1
    capsys.readouterr()
    assert paper.main(["--rest", "--list"]) == 0
    assert capsys.readouterr().out == "bad.py\n"


def test_a_command_that_takes_too_long_is_ended_and_what_stood_there_stays(
    tmp_path, monkeypatch, capsys
):
    for name in ("ROOT", "BENCHMARKS", "TABLES"):
        monkeypatch.setattr(paper, name, tmp_path)
    (tmp_path / "slow.py").write_text("import time\nprint('begun', flush=True)\ntime.sleep(99)\n")
    (tmp_path / "slow.md").write_text("of before")
    monkeypatch.setattr(paper, "commands", lambda: [("slow.py",)])
    began = time.monotonic()
    assert paper.main(["--minutes=0.02"]) == 1
    assert time.monotonic() - began < 60
    assert (tmp_path / "slow.md").read_text() == "of before"
    assert "nothing: not at its end after 1 s" in capsys.readouterr().out


def test_a_folder_of_one_machine_is_in_no_table():
    said = paper.as_markdown(f"study: {tempfile.gettempdir()}/tmp1a/study")
    assert said == "```text\nstudy: FOLDER/study\n```"


def test_every_picture_of_the_pages_is_drawn_by_a_command():
    pages = [ROOT / "README.md", *DOCS.glob("*.md")]
    shown = {
        Path(link).name
        for page in pages
        for link in re.findall(r"!\[[^\]]*\]\((?!http)([^)]+)\)", page.read_text(encoding="utf-8"))
    }
    drawn = {name for name in shown if Path(name).stem in figures.PICTURES}
    assert {Path(name).stem for name in drawn} == set(figures.PICTURES)
    others = {"heads.png": "compare.py", "structure.svg": "structure.py"}
    assert shown - drawn == set(others)
    for name, file in others.items():
        assert f'"{name}"' in (paper.BENCHMARKS / file).read_text(encoding="utf-8")


def test_pictures_of_data_that_are_not_given_away_have_a_command_and_are_not_kept():
    text = "".join(page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    for name in figures.LOCAL:
        assert f"`make figures NAME={name}`" in text
        assert not (DOCS / f"{name}.png").exists()
    folder = figures.LOCAL_FOLDER.relative_to(ROOT).as_posix()
    assert f"/{folder}/" in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()


def test_joint_modes_of_structures_are_drawn_with_both_shares_in_the_title(tmp_path, monkeypatch):
    titles = []
    write = figures.write
    monkeypatch.setattr(
        figures, "write", lambda f, *a, **o: titles.append(f.get_suptitle()) or write(f, *a, **o)
    )
    study = s4a_morphometrics.synthetic.example_structures()
    path = figures.joint_modes(study, "beans", "modes", folder=tmp_path / "new")
    said = re.fullmatch(
        r"6 beans: (\d+) % of the variance between the structures, (\d+) % within", titles[0]
    )
    assert sum(map(int, said.groups())) == pytest.approx(100, abs=1)
    colors = Image.open(path).convert("RGB").getcolors(256)
    far = [sum(n for n, (r, g, b) in colors if sign * (b - r) > 60) for sign in (1, -1)]
    assert min(far) > 5000  # blue and orange


def test_without_the_label_volumes_their_picture_says_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DATA", tmp_path)
    figures.hippocampi.cache_clear()
    with pytest.raises(ValueError, match=r"24 label volumes of hippocampi .*, found 0"):
        figures.hippocampi()


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The study of a few small brains, and a template that is none of them."""
    brains = s4a.synthetic.brains(5, 1500, seed=0)
    meshes = {name: node.to_dataset() for name, node in brains["original"].children.items()}
    template = meshes.pop("brain_05")
    store = tmp_path_factory.mktemp("figures")
    options = {"n_coarse": 400, "k": 20, "k_init": 10, "n_jobs": 1}
    return s4a.analyse(meshes, store=store, **options), template


def test_readme_opens_with_a_film_below_3_mb():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (first, *_) = re.findall(r"!\[[^\]]*\]\((?!http)([^)]+)\)", text)
    assert first == "docs/modes.gif"
    assert (ROOT / first).stat().st_size < 3e6
    with Image.open(ROOT / first) as film:
        assert (film.n_frames, film.width) == (36, 720)


def test_the_film_of_readme_is_drawn_from_a_study(small, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "HERE", tmp_path)
    with Image.open(figures.film(small[0], n_frames=2)) as film:
        assert (film.n_frames, film.width) == (2, 720)


@pytest.mark.parametrize("name", ["pipeline", "components", "variance", "labels", "landmarks"])
def test_a_figure_of_the_paper_is_drawn_from_a_study(name, small, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "HERE", tmp_path)
    draw = getattr(figures, name)
    path = draw(small if name in ("labels", "landmarks") else small[0])
    assert path.parent == tmp_path, "not over the picture of the page"
    with Image.open(path) as picture:
        assert picture.width > 400
        assert len(picture.convert("RGB").getcolors(256)) > 20


def test_the_brain_that_is_made_higher_has_eigenfunctions_in_another_order(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(figures, "HERE", tmp_path)
    path = figures.swapped(vertices=3000, n_coarse=800)
    assert path.exists()
    assert path.parent == tmp_path, "not over the picture of the page"
    assert "exchanged: [(2, 3)" in capsys.readouterr().out


@pytest.mark.parametrize("folder", [paper.PERFORMANCE, paper.TABLES], ids=lambda path: path.name)
def test_a_page_shows_what_commands_printed_with_machine_and_versions(folder):
    files = {paper.kept(command): command for command in (*paper.SPEED, *paper.commands())}
    there = sorted(folder.glob("*.md"))
    assert there
    for path in there:
        assert path in files, path.name  # another file would be shown nowhere
        text = path.read_text(encoding="utf-8")
        assert text.startswith(f"# `{shlex.join(files[path])}`")
        assert re.search(r"\d{4}-\d\d-\d\d, \d+ s\. .* cores.* S4A [\d.]+", text)
        assert "It ended with" not in text
        assert not re.search(r"/(tmp|root|home)/", text)  # of one machine
