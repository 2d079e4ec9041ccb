"""Exercises of the notebooks.

A cell leaves ``answer = ...`` open, and what the reader puts there is checked.
"""

from typing import Any

import numpy as np


def check(answer: Any, expected: Any, hint: str = "", *, within: float = 0.01) -> str:
    """Check the answer to an exercise.

    Parameters
    ----------
    answer : object
        ``...`` stands for none.
    expected : array_like, str, bool or callable
        The right answer, or a function of the answer that says whether it is right.
    hint : str
        Where to look; said when the answer is missing or wrong.
    within : float
        How far numbers may be from the right ones, as a share of the largest of these.

    Returns
    -------
    str
        That it is right.

    Raises
    ------
    AssertionError
        When there is no answer yet, or another than the right one.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.course import check
    >>> check(6.28, 2 * np.pi)
    'Right.'
    >>> check(3.1, 2 * np.pi, "once around")
    Traceback (most recent call last):
    ...
    AssertionError: Not yet: the answer is 3.1. Hint: once around.
    """
    hint = f" Hint: {hint}{'' if hint.endswith(('.', '?')) else '.'}" if hint else ""
    if answer is ...:
        raise _shown(f"No answer yet: put yours in the place of the dots of `answer = ...`.{hint}")
    if callable(expected):
        right = bool(expected(answer))
    elif np.asarray(expected).dtype.kind in "iuf":
        right = _near(answer, np.asarray(expected, float), within)
    else:
        right = np.array_equal(answer, expected)
    if not right:
        raise _shown(f"Not yet: the answer is {_told(answer)}.{hint}")
    return "Right."


def _shown(message):
    """The error, which IPython shows without the way it took through this file."""
    error = AssertionError(message)
    setattr(error, "_render_traceback_", lambda: [message])  # noqa: B010, IPython looks for it
    return error


def _near(answer, expected, within):
    answer = np.asarray(answer)
    if answer.dtype.kind not in "iuf" or answer.shape != expected.shape:
        return False
    return bool((np.abs(answer - expected) <= within * np.abs(expected).max(initial=0)).all())


def _told(answer):
    """The answer in a few words."""
    shape = np.shape(answer) if not isinstance(answer, str | dict | set) else ()
    return f"an array of shape {shape}" if len(shape) else f"{answer!r:.60}"
