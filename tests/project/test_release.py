"""The public address comes from one value, and nothing is released that still lacks it."""

import re
import shutil
import tomllib
from pathlib import Path

import pytest
from paths import ROOT, script

release = script(ROOT / "tools" / "release.py")


@pytest.fixture
def copy(tmp_path):
    """The files with the address and the version, elsewhere."""
    for file in {*release.PLACES, "CHANGELOG.md", "conda/recipe.yaml"}:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    return tmp_path


def files_of(folder):
    return [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]


@pytest.mark.parametrize("file", release.PLACES)
def test_every_place_has_the_address_of_the_one_value(file):
    text = (ROOT / file).read_text(encoding="utf-8")
    name = release.repository()
    assert re.search(release.PLACES[file], text, re.MULTILINE)
    assert release.with_address(text, release.PLACES[file], name) == text


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="asks git for the files")
def test_the_address_is_said_in_no_other_file():
    name = re.escape(release.repository())
    spared = {"tests/project/test_release.py", "tools/release.py"}
    for file in release.tracked():
        if file.as_posix() in {*release.PLACES, *spared} or not (ROOT / file).is_file():
            continue
        text = (ROOT / file).read_bytes().decode("utf-8", errors="replace")
        assert not re.search(rf"(github\.com|v2/gh)/{name}", text), file


def test_another_address_comes_into_every_place_and_what_was_said_until_then_goes(copy):
    release.write_address("someone/shapes-4a", copy)
    urls = tomllib.loads((copy / "pyproject.toml").read_text())["project"]["urls"]
    assert all(url.startswith("https://github.com/someone/shapes-4a") for url in urls.values())
    assert list(release.says_unknown(files_of(copy), copy)) == []
    readme = (copy / "README.md").read_text(encoding="utf-8")
    assert "after publication" not in readme
    assert readme.count("mybinder.org/v2/gh/someone/shapes-4a/HEAD?urlpath=") == 2


def test_a_release_with_an_unknown_address_or_differing_versions_is_refused(copy):
    version = tomllib.loads((copy / "pyproject.toml").read_text())["project"]["version"]
    found = release.faults(version, copy, files_of(copy))
    assert any(line.startswith("README.md:") for line in found) == (
        release.repository(copy).startswith(release.UNKNOWN)
    )
    other = release.faults("99.0", copy, files_of(copy))
    assert f"pyproject.toml: version {version}, not 99.0" in other
    assert f"conda/recipe.yaml: version {version}, not 99.0" in other


def test_a_release_with_all_that_it_needs_is_not_refused(copy):
    release.write_address("someone/s4a", copy)
    version = tomllib.loads((copy / "pyproject.toml").read_text())["project"]["version"]
    cff, log = copy / "CITATION.cff", copy / "CHANGELOG.md"
    cff.write_text(cff.read_text(encoding="utf-8") + "date-released: 2026-12-01\n", "utf-8")
    text = re.sub(r"\n## .*\n", f"\n## {version}, 2026-12-01\n", log.read_text("utf-8"), count=1)
    log.write_text(text, encoding="utf-8")
    assert release.faults(version, copy, files_of(copy)) == []


def test_where_it_does_not_resolve_yet_the_readme_says_so():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert ("after publication" in readme) == release.repository().startswith(release.UNKNOWN)


def test_the_citation_is_of_this_version_and_licence():
    project = tomllib.loads(Path(ROOT / "pyproject.toml").read_text())["project"]
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {project['version']}\n" in text
    assert f"\nlicense: {project['license']}\n" in text


@pytest.mark.parametrize("paper", release.PAPERS)
def test_a_paper_lacks_only_what_its_authors_have_to_say(paper):
    found = list(release.lacking(paper))
    assert all(re.match("names of people|date|AI usage", line) for line in found), found


def test_a_paper_without_a_section_or_with_too_many_words_is_not_ready(tmp_path):
    text = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8")
    (tmp_path / "paper").mkdir()
    place = tmp_path / "paper" / "paper.md"
    done = re.sub(r"To be stated by the authors.*", "None.", text)
    done = done.replace("S4A developers", "A Name").replace("see CITATION.cff", "A Place")
    place.write_text(done.replace("bibliography:", "date: 1 May 2027\nbibliography:"), "utf-8")
    assert list(release.lacking("paper/paper.md", tmp_path)) == []
    place.write_text(done.replace("# Software design", "# Design") + "word " * 2000, "utf-8")
    found = " ".join(release.lacking("paper/paper.md", tmp_path))
    assert "sections Summary" in found
    assert "date" in found
    assert "750 to 1750 words" in found
