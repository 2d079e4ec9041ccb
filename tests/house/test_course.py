"""Exercises: what is missing or wrong is told, what is right passes."""

import io
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from s4a.course import check, slide


def test_an_open_exercise_says_what_to_do_and_hints():
    said = check(..., 3, "count them")
    assert re.fullmatch(r"No answer yet: .*dots.* Hint: count them\.", said)


@pytest.mark.parametrize(
    "answer, expected",
    [
        (3.005, 3),
        (np.float32(3), 3),
        ([1, 2.0], np.array([1.0, 2.001])),
        ("brain_01", "brain_01"),
        ([1, 4], [1, 4]),
        (True, True),
        (7, lambda n: n % 7 == 0),
    ],
)
def test_a_right_answer_passes(answer, expected):
    assert check(answer, expected) == "Right."


@pytest.mark.parametrize(
    "answer, expected",
    [
        (3.1, 3),
        ("3", 3),
        (None, 3),
        (np.nan, 3),
        ([1.0, 2.0, 3.0], np.ones(2)),
        (np.ones((2, 1)), np.ones(2)),
        ("brain_02", "brain_01"),
        ([1], [1, 4]),
        (False, True),
        (8, lambda n: n % 7 == 0),
    ],
)
def test_a_wrong_answer_fails_with_itself_and_the_hint(answer, expected):
    with pytest.raises(AssertionError, match=r"Not yet: the answer is .+ Hint: look again\."):
        check(answer, expected, "look again")


def test_an_array_is_told_by_its_shape():
    with pytest.raises(AssertionError, match=r"an array of shape \(2, 3\)"):
        check(np.zeros((2, 3)), np.zeros(3))


def test_a_slider_draws_its_picture_anew_without_a_cell_that_captures():
    ipywidgets = pytest.importorskip("ipywidgets")
    drawn = []

    def draw(n, shade):
        drawn.append((n, shade))
        figure = Figure(figsize=(2, 1))
        figure.subplots().bar(range(n), range(n), color=str(shade))
        return figure

    n = ipywidgets.IntSlider(3, 1, 9)
    shade = ipywidgets.FloatSlider(0.5, min=0, max=1, description="grey")
    box = slide(draw, n=n, shade=shade)
    *sliders, message, picture = box.children
    assert sliders == [n, shade]
    assert (n.description, shade.description) == ("n", "grey")
    before = picture.value
    pixels = Image.open(io.BytesIO(before)).size
    assert int(picture.width) == pixels[0] // 2, "sharp also on dense screens"
    n.value = 5
    assert picture.value != before
    assert drawn == [(3, 0.5), (5, 0.5)]
    n.value = 0 + 1
    shade.value = 0.75
    assert drawn[-1] == (1, 0.75)
    assert message.value == ""
    assert not any(isinstance(part, ipywidgets.Output) for part in box.children)


def test_an_error_of_a_slider_is_shown_and_goes_with_the_next_picture():
    ipywidgets = pytest.importorskip("ipywidgets")

    def draw(n):
        if n > 3:
            raise ValueError("at most <3>")
        return Figure(figsize=(1, 1))

    n = ipywidgets.IntSlider(3, 1, 9)
    _, message, picture = slide(draw, n=n).children
    before = picture.value
    n.value = 5
    assert message.value == "<pre>ValueError: at most &lt;3&gt;</pre>"
    assert picture.value == before
    n.value = 2
    assert message.value == ""
