"""Exercises and sliders of the notebooks.

A cell leaves ``answer = ...`` open, and what the reader puts there is checked.
"""

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import ipywidgets
    from matplotlib.figure import Figure


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
        That it is right, or that there is none yet and where to look: an open exercise is no error.

    Raises
    ------
    AssertionError
        When the answer is not the right one.

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
        return f"No answer yet: put yours in the place of the dots of `answer = ...`.{hint}"
    if callable(expected):
        right = bool(expected(answer))
    elif np.asarray(expected).dtype.kind in "iuf":
        right = _near(answer, np.asarray(expected, float), within)
    else:
        right = np.array_equal(answer, expected)
    if not right:
        raise _shown(f"Not yet: the answer is {_told(answer)}.{hint}")
    return "Right."


def slide(draw: "Callable[..., Figure]", **sliders: "ipywidgets.Widget") -> "ipywidgets.VBox":
    """A figure that sliders draw anew.

    Unlike ``ipywidgets.interact`` it captures no output, for which programs that run notebooks may
    wait without end; the picture is the value of an image.

    Parameters
    ----------
    draw : callable
        Takes the values of the sliders by name, and gives a matplotlib Figure.
    **sliders : ipywidgets.Widget
        Each with a ``value``; one without a description gets its name.

    Returns
    -------
    ipywidgets.VBox
        The sliders, the picture and, where `draw` fails, its error.

    Examples
    --------
    >>> import ipywidgets
    >>> from matplotlib.figure import Figure
    >>> from s4a.course import slide
    >>> def line(n):
    ...     figure = Figure(figsize=(2, 1))
    ...     figure.subplots().plot(range(n))
    ...     return figure
    >>> n = ipywidgets.IntSlider(3, 2, 9)
    >>> controls = slide(line, n=n)
    >>> before = controls.children[-1].value
    >>> n.value = 5
    >>> controls.children[-1].value != before
    True
    """
    import html

    import ipywidgets

    picture = ipywidgets.Image(layout={"max_width": "100%"})
    message = ipywidgets.HTML()

    def redraw(change=None):
        try:
            figure = draw(**{name: slider.value for name, slider in sliders.items()})
            picture.value, picture.width = _png(figure)
            message.value = ""
        except Exception as error:  # a callback has no cell to show it
            message.value = f"<pre>{html.escape(f'{type(error).__name__}: {error}')}</pre>"

    for name, slider in sliders.items():
        slider.description = slider.description or name
        slider.observe(redraw, "value")
    redraw()
    return ipywidgets.VBox([*sliders.values(), message, picture])


def _png(figure):
    """A figure as PNG of twice the pixels that it is shown with, and that width."""
    target = io.BytesIO()
    figure.savefig(target, format="png", dpi=2 * figure.dpi, bbox_inches="tight")
    data = target.getvalue()
    width = int.from_bytes(data[16:20], "big")  # of the header of a PNG
    return data, str(width // 2)


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
