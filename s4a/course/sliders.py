"""Figures of the notebooks with sliders, and the summary figure of a lesson."""

import io
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import ipywidgets
    from matplotlib.figure import Figure


def slide(draw: "Callable[..., Figure]", **sliders: "ipywidgets.Widget") -> "ipywidgets.VBox":
    """Return a figure with sliders that redraw it.

    Unlike ``ipywidgets.interact`` it captures no output, which can block programs that run
    notebooks; the picture is the value of an image widget.

    Parameters
    ----------
    draw : callable
        Function of the values of the sliders, by name, that returns a matplotlib Figure.
    **sliders : ipywidgets.Widget
        Widgets with a ``value``; the default description is the name.

    Returns
    -------
    ipywidgets.VBox
        The sliders, the error message if `draw` fails, and the picture.

    See Also
    --------
    takeaway : summary figure of a lesson

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

    from s4a.show.tiled_figure import GROW

    picture = ipywidgets.Image()
    message = ipywidgets.HTML()

    def redraw(change=None):
        try:
            figure = draw(**{name: slider.value for name, slider in sliders.items()})
            picture.value, width = _png(figure)
            picture.layout.width = f"min(100%, {round(GROW * width)}px)"
            message.value = ""
        except Exception as error:  # shown here: a callback has no cell
            message.value = f"<pre>{html.escape(f'{type(error).__name__}: {error}')}</pre>"

    for name, slider in sliders.items():
        slider.description = slider.description or name
        slider.observe(redraw, "value")
    redraw()
    return ipywidgets.VBox([*sliders.values(), message, picture])


MIN_SCALE = 0.8  # of a figure in a take-away


def _png(figure):
    """Return a figure as PNG with two pixels per shown pixel, and its shown width."""
    target = io.BytesIO()
    figure.savefig(target, format="png", dpi=2 * figure.dpi, bbox_inches="tight")
    data = target.getvalue()
    width = int.from_bytes(data[16:20], "big")  # in the header of a PNG
    return data, width // 2


def takeaway(sentence: str, *figures: "Figure") -> "Figure":
    """Return the summary figure of a lesson: a sentence above a row of figures.

    In a narrow cell the figures are below each other.

    Parameters
    ----------
    sentence : str
        Title of the summary figure.
    *figures : matplotlib.figure.Figure
        Figures, which are scaled to one height.

    Returns
    -------
    matplotlib.figure.Figure

    See Also
    --------
    slide : figure with sliders

    Examples
    --------
    >>> from s4a.course import takeaway
    >>> from s4a.show.charts import variance
    >>> summary = takeaway("Few modes explain most of the variance.", variance([0.7, 0.2, 0.1]))
    >>> summary.get_suptitle()
    'Few modes explain most of the variance.'
    """
    from PIL import Image

    from s4a.show.tiled_figure import TiledFigure

    pictures = [np.asarray(Image.open(io.BytesIO(_png(figure)[0]))) for figure in figures]
    ratios = [picture.shape[1] / picture.shape[0] for picture in pictures]
    heights = [
        len(picture) / (2 * figure.dpi) for picture, figure in zip(pictures, figures, strict=True)
    ]
    width, space = 9.5, 0.1
    # a smaller scale would make the text of the figures too small to read
    height = min(3.2, (width - space * len(ratios)) / sum(ratios))
    height = max(height, MIN_SCALE * max(heights))
    summary = TiledFigure(figsize=(height * sum(ratios) + space * (len(ratios) - 1), height + 0.35))
    grid = {"left": 0, "right": 1, "bottom": 0, "top": height / (height + 0.35)}
    grid["wspace"] = space * len(ratios) / summary.get_figwidth()
    axes = summary.subplots(1, len(ratios), squeeze=False, width_ratios=ratios, gridspec_kw=grid)
    for ax, picture in zip(axes.flat, pictures, strict=True):
        ax.imshow(picture, interpolation="lanczos")
        ax.set_axis_off()
    summary.set_dpi(150)
    summary.suptitle(sentence, y=0.99, va="top", fontsize=11, fontweight="bold")
    return summary
