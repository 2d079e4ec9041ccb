"""Exercises: what is missing or wrong is told, what is right passes."""

import numpy as np
import pytest

from s4a.course import check


def test_an_open_exercise_says_what_to_do_and_hints():
    with pytest.raises(AssertionError, match=r"No answer yet: .*dots.* Hint: count them\."):
        check(..., 3, "count them")


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
