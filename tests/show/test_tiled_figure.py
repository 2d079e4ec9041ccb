"""Tiled figures in a notebook, and the colour bar next to surfaces."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

import s4a
from s4a.show import charts
from s4a.show.tiled_figure import TiledFigure


def pictures(figure):
    """The picture of each tile (height, width, 3)."""
    encoded = re.findall(r"base64,([^\"]+)", figure.html())
    return [
        np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")) for data in encoded
    ]


def test_no_tile_shows_a_text_of_its_neighbour():
    figure = TiledFigure(figsize=(4, 2))
    wide, plain = figure.subplots(1, 2)
    for ax in (wide, plain):
        ax.imshow(np.ones((4, 4)), cmap="gray", vmin=0, vmax=1)
        ax.set_axis_off()
    wide.text(0, 0, "words that reach far over into the picture of the neighbour", clip_on=False)
    first, second = pictures(figure)
    assert first.min() < 100  # the words
    assert second.min() > 250
    assert all(ax.get_visible() for ax in figure.axes)


def test_no_tile_is_cut_next_to_long_titles_and_a_colour_bar():
    ball = s4a.synthetic.sphere(100)
    height = ball["position"].values[:, 2]
    titles = ["one", "two\nlines", "a title that is much wider than its ball"]
    for shown in (titles, titles[2:]):
        figure = charts.surfaces(
            dict.fromkeys(shown, ball), dict.fromkeys(shown, height), label="height"
        )
        for picture in pictures(figure):
            edges = [picture[0], picture[-1], picture[:, 0], picture[:, -1]]
            assert min(edge.min() for edge in edges) > 250


@pytest.mark.parametrize(("least", "begins"), [(0.0, 0.0), (-1.0, -2.0)])
def test_the_scale_of_errors_begins_at_zero(least, begins):
    ball = s4a.synthetic.sphere(100)
    values = np.linspace(least, 2, 100)
    figure = charts.surfaces({"ball": ball}, {"ball": values}, limit=2, label="error")
    assert figure.axes[-1].get_ylim() == (begins, 2)
