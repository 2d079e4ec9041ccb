"""Pictures of the notebooks that sliders draw again, and those that sum up a lesson."""

import io
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import ipywidgets
    from matplotlib.figure import Figure


def slide(draw: "Callable[..., Figure]", **sliders: "ipywidgets.Widget") -> "ipywidgets.VBox":
    """A figure that sliders draw again.

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

    from s4a.show.parts import GROW

    picture = ipywidgets.Image()
    message = ipywidgets.HTML()

    def redraw(change=None):
        try:
            figure = draw(**{name: slider.value for name, slider in sliders.items()})
            picture.value, width = _png(figure)
            picture.layout.width = f"min(100%, {round(GROW * width)}px)"
            message.value = ""
        except Exception as error:  # a callback has no cell to show it
            message.value = f"<pre>{html.escape(f'{type(error).__name__}: {error}')}</pre>"

    for name, slider in sliders.items():
        slider.description = slider.description or name
        slider.observe(redraw, "value")
    redraw()
    return ipywidgets.VBox([*sliders.values(), message, picture])


LEAST = 0.8  # of the size of a figure in a take-away


def _png(figure):
    """A figure as PNG of twice the pixels that it is shown with, and that width."""
    target = io.BytesIO()
    figure.savefig(target, format="png", dpi=2 * figure.dpi, bbox_inches="tight")
    data = target.getvalue()
    width = int.from_bytes(data[16:20], "big")  # of the header of a PNG
    return data, width // 2


def takeaway(sentence: str, *figures: "Figure") -> "Figure":
    """What to remember of a lesson: some figures in a row, below a sentence.

    In a narrow cell the figures stand below each other.

    Parameters
    ----------
    sentence : str
        Written above the pictures.
    *figures : matplotlib.figure.Figure
        Drawn as they are, all of one height.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> from s4a.course import takeaway
    >>> from s4a.show.charts import variance
    >>> whole = takeaway("Few modes hold most of it.", variance([0.7, 0.2, 0.1]))
    >>> whole.get_suptitle()
    'Few modes hold most of it.'
    """
    from PIL import Image

    from s4a.show.parts import Parts

    pictures = [np.asarray(Image.open(io.BytesIO(_png(figure)[0]))) for figure in figures]
    shares = [picture.shape[1] / picture.shape[0] for picture in pictures]
    natural = [len(one) / (2 * of.dpi) for one, of in zip(pictures, figures, strict=True)]
    width, gap = 9.5, 0.1
    # smaller than they are drawn only so far as their words can still be read
    height = min(3.2, (width - gap * len(shares)) / sum(shares))
    height = max(height, LEAST * max(natural))
    whole = Parts(figsize=(height * sum(shares) + gap * (len(shares) - 1), height + 0.35))
    room = {"left": 0, "right": 1, "bottom": 0, "top": height / (height + 0.35)}
    room["wspace"] = gap * len(shares) / whole.get_figwidth()
    axes = whole.subplots(1, len(shares), squeeze=False, width_ratios=shares, gridspec_kw=room)
    for ax, picture in zip(axes.flat, pictures, strict=True):
        ax.imshow(picture, interpolation="lanczos")
        ax.set_axis_off()
    whole.set_dpi(150)
    whole.suptitle(sentence, y=0.99, va="top", fontsize=11, fontweight="bold")
    return whole
