"""The page of how-tos: its cells run as they stand, and each answers with a picture."""

import re

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from paths import DOCS

import s4a

TEXT = (DOCS / "howto.md").read_text(encoding="utf-8")


def cells(text):
    """The code of the page, a cell at a time, less what only a notebook knows."""
    for code in re.findall(r"```\{code-cell\}\n(.*?)```", text, re.DOTALL):
        yield code.replace("%matplotlib inline\n", "").rstrip().removesuffix(";")


def value_of(code, names):
    """Run a cell; the value of its last expression, as a notebook shows it."""
    *lines, last = re.split(r"\n(?=\S)(?!\))", code)
    exec("\n".join(lines), names)
    return eval(last, names)


def test_a_question_is_one_heading_and_one_cell():
    _, *questions = re.split(r"\n## ", TEXT)
    assert len(questions) >= 6
    for question in questions:
        assert question.count("```{code-cell}") == 1, question[:40]


def test_every_cell_runs_and_shows_a_picture(tmp_path, monkeypatch):
    pytest.importorskip("skimage")
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    first, *questions = cells(TEXT)
    names = {}
    exec(first, names)
    for code in questions:
        shown = value_of(code, names)
        assert isinstance(shown, Figure) or names["ax"].lines, code
    mended = names["mended"]["brain_03"].to_dataset()["position"].values
    given = names["brains"]["original/brain_03"].to_dataset()["position"].values
    np.testing.assert_allclose(mended, given, rtol=1e-5, atol=1e-4)
    assert list(names["errors"]) == sorted(names["errors"], reverse=True)
    assert names["test"]["p_value"].item() > 0.05
    file = tmp_path / "mode_1.vtk"
    assert len(s4a.read_mesh(file)[0]) == names["mean"].sizes["vertex"]
    assert b"mode_1" in file.read_bytes()
    assert (tmp_path / "scores.csv").read_text().count("\n") == 9
    with xr.open_dataset(tmp_path / "study" / "pca.nc", engine="h5netcdf") as pca:
        assert pca["score"].sizes["shape"] == 8
