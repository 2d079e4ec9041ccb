"""The pages for those who come from elsewhere: every block of Python on them runs as it stands."""

import re
from importlib.util import find_spec

import numpy as np
import pytest
from paths import DOCS

import s4a
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import write_landmarks

PAGES = ("coming.md", "faq.md")
# what a page's options are made small with; the defaults are those of real meshes
SMALL = {"n_coarse": 200, "k_init": 8, "k": 12, "n_pairs": 10}


def blocks(page):
    """The blocks of Python of a page, each with the line of the page where it begins."""
    text = (DOCS / page).read_text(encoding="utf-8")
    for found in re.finditer(r"```python\n(.*?)```", text, re.DOTALL):
        yield text[: found.start()].count("\n") + 1, found[1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with what the pages name, where `s4a.analyse` takes small options by default."""
    (tmp_path / "heads").mkdir()
    shapes = s4a.synthetic.brains(7, 600)["original"]
    meshes = [as_arrays(node.to_dataset()) for node in shapes.children.values()]
    for i, mesh in enumerate(meshes[:6]):
        s4a.write_mesh(tmp_path / "heads" / f"head_{i}.ply", *mesh)
    s4a.write_mesh(tmp_path / "new.ply", *meshes[6])
    s4a.write_mesh(tmp_path / "a.off", *meshes[0])
    s4a.write_mesh(tmp_path / "b.off", *meshes[1])
    (tmp_path / "marks").mkdir()
    for name, node in list(shapes.children.items())[:6]:
        marks = node.to_dataset()[["landmark_name", "landmark_position"]]
        write_landmarks(tmp_path / "marks" / f"head_{int(name[-2:]) - 1}.csv", marks)
    rows = [f"head_{i},{'abc'[i % 2]},{20 + i * i}" for i in range(6)]
    (tmp_path / "subjects.csv").write_text("\n".join(["shape,group,age", *rows]) + "\n")
    monkeypatch.chdir(tmp_path)
    analyse, match_pair = s4a.analyse, s4a.match_pair
    monkeypatch.setattr(s4a, "analyse", lambda *a, **o: analyse(*a, **SMALL | o))
    pair = {name: value for name, value in SMALL.items() if name != "n_pairs"}
    monkeypatch.setattr(s4a, "match_pair", lambda *a, **o: match_pair(*a, **pair | o))
    return tmp_path


@pytest.mark.filterwarnings("default")  # of the other programs
@pytest.mark.parametrize("page", PAGES)
def test_every_block_of_a_page_runs_one_after_the_other(page, folder):
    names = {}
    for line, block in blocks(page):
        if any(other in block and find_spec(other) is None for other in ("meshmonk", "pyFM")):
            continue  # of another program, which is not installed
        exec(compile(block, f"{page}:{line}", "exec"), names)
    if page == "faq.md":
        assert names["new"]["pca"]["score"].sizes["shape"] == 1
        assert len(names["paths"]) >= 6
        assert float(names["worst"].max()) > 0
        assert names["number_in_file"].max() < 600
    else:
        assert np.isfinite(names["warped_here"].values).all()
        assert names["random"].sizes["vertex"] == 600


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_names_of_s4a_exists(page):
    text = (DOCS / page).read_text(encoding="utf-8")
    assert "s4a." in text
    for name in re.findall(r"`(s4a(?:\.\w+)+)", text):
        found = s4a
        for part in name.split(".")[1:]:
            found = getattr(found, part)


def test_every_question_has_a_thread_and_an_answer_that_runs():
    text = (DOCS / "faq.md").read_text(encoding="utf-8")
    for question in text.split("\n## ")[1:]:
        assert re.search(r"\]\(https://github\.com/[\w.-]+/[\w.-]+/(issues|pull)/\d+\)", question)
        assert "```python" in question
