"""How-tos and gallery: their cells run as they stand, and each shows a picture."""

import inspect
import io
import re

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from paths import DOCS
from PIL import Image

import s4a
from s4a.show import charts

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


def png(figure):
    """A figure as the bytes of a PNG."""
    target = io.BytesIO()
    figure.savefig(target, format="png")
    return target.getvalue()


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
    hands = {title: node["position"].values for title, node in names["sides"].items()}
    assert abs(hands["mended"].mean(0) - hands["another"].mean(0)).max() < 1
    np.testing.assert_allclose(hands["mended"], hands["mirrored"] * [-1, 1, 1], atol=1e-4)
    assert list(names["errors"]) == sorted(names["errors"], reverse=True)
    assert names["test"]["p_value"].item() > 0.05
    file = tmp_path / "mode_1.vtk"
    assert len(s4a.read_mesh(file)[0]) == names["mean"].sizes["vertex"]
    assert b"mode_1" in file.read_bytes()
    with Image.open(tmp_path / "mode_1.gif") as film:
        assert film.n_frames == 12
    assert (tmp_path / "scores.csv").read_text().count("\n") == 9
    with xr.open_dataset(tmp_path / "study" / "pca.nc", engine="h5netcdf") as pca:
        assert pca["score"].sizes["shape"] == 8


def test_every_cell_of_the_gallery_shows_a_picture_and_most_charts_stand_in_it(
    tmp_path, monkeypatch
):
    pytest.importorskip("anywidget")
    monkeypatch.chdir(tmp_path)
    text = (DOCS / "gallery.md").read_text(encoding="utf-8")
    first, *others = cells(text)
    names = {}
    exec(first, names)
    for code in others:
        shown = value_of(code, names)
        if hasattr(shown, "close"):  # a panel
            shown.close()
            continue
        assert isinstance(shown, Figure), code
        pixels = np.asarray(Image.open(io.BytesIO(png(shown))).convert("L"))
        assert np.mean(pixels < 240) > 0.01, code
        assert pixels.shape[1] >= 250
    public = [name for name, made in vars(charts).items() if inspect.isfunction(made)]
    drawing = {n for n in public if n[0] != "_" and vars(charts)[n].__module__ == charts.__name__}
    left_out = {name for name in drawing if f"charts.{name}(" not in text}
    assert left_out == {"svg", "brief", "color_bar", "reach"}
