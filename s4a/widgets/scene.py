"""A surface in three dimensions: arrays in, a view that turns, is coloured and can be clicked out."""

import ipywidgets
import numpy as np
import traitlets

from s4a.draw import image_bytes, on_white, render, rotation
from s4a.widgets.browser import SCENE, STYLE, anywidget

SIZE = (460, 360)  # pixels of a still picture


def as_bytes(array, kind):
    """The bytes of an array of numbers, little-endian and contiguous, as the browser reads them.

    Examples
    --------
    >>> as_bytes([1, 256], "uint16")
    b'\\x01\\x00\\x00\\x01'
    """
    return np.ascontiguousarray(array, np.dtype(kind).newbyteorder("<")).tobytes()


def color_bytes(colors):
    """Colours ``(n, 3)`` from 0 to 1 as bytes; rows that are not finite become grey."""
    colors = np.asarray(colors, float)
    return as_bytes(255 * np.where(np.isfinite(colors), np.clip(colors, 0, 1), 0.6) + 0.5, "uint8")


def color_bar(colormap, low, high, label):
    """What the browser draws as a colour bar: eleven colours of a colour map, both ends and a label."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    colors = colormaps.get_cmap(colormap)(np.linspace(0, 1, 11))
    return {"colors": [to_hex(c) for c in colors], "low": float(low), "high": float(high), "label": label}


def table(colormap):
    """The 256 colours of a colour map as bytes."""
    from matplotlib import colormaps

    return color_bytes(colormaps.get_cmap(colormap)(np.linspace(0, 1, 256))[:, :3])


class Surfaces:
    """What a view of a surface does, whoever draws it: the arrays are kept, and a still picture can be made."""

    def show(self, points, triangles, colors=None, title=None):
        """Show a surface ``(n, 3)``, ``(m, 3)`` with colours ``(n, 3)``; what was marked is forgotten."""
        self.surface = np.asarray(points), np.asarray(triangles)
        self.painted = colors
        if title is not None:
            self.title = title
        self.points = []
        self.draw_surface()

    def paint(self, colors, bar=None):
        """Colours of the vertices ``(n, 3)``, None for none, and the colour bar that explains them."""
        self.painted = colors
        self.bar = bar or {}
        self.draw_colors()

    def mark(self, points, colors=((0.9, 0.6, 0.0),), size=12):
        """Discs at some points ``(p, 3)`` of the surface; one colour or one for each."""
        points = np.asarray(points, float).reshape(-1, 3)
        colors = np.broadcast_to(np.asarray(colors, float), (len(points), 3))
        self.points = [[*p, *c, size] for p, c in zip(points.tolist(), colors.tolist(), strict=True)]

    def picture(self):
        """PNG bytes of the surface from where the view first stands; empty without a surface."""
        if self.surface is None:
            return b""
        turn = np.reshape(self.turn, (3, 3))
        points, triangles = self.surface
        # the rotation is applied here, and the renderer then looks along z from the top
        drawn = render(points @ turn.T, triangles, colors=self.painted, view="top", size=SIZE)
        return image_bytes(on_white(drawn), "png")


if anywidget is not None:

    class Scene(Surfaces, anywidget.AnyWidget):
        """A view of one surface in the browser.

        Parameters
        ----------
        title : str
        group : str
            Views of one group turn together.
        view, up
            From where the surface is seen first; see :func:`s4a.draw.rotation`.
        height : int
            In pixels.

        Attributes
        ----------
        picked, hovered : dict
            The place that was clicked, or is under the pointer (where `hovering` is set): ``vertex`` (-1 beside the
            surface), ``face``, ``weights`` in that triangle, and ``point``.
        """

        _esm, _css = SCENE, STYLE
        position, corner, color, still = (traitlets.Bytes().tag(sync=True) for _ in range(4))
        ghost_position, ghost_corner = (traitlets.Bytes().tag(sync=True) for _ in range(2))
        points = traitlets.List().tag(sync=True)
        bar, picked, hovered = (traitlets.Dict().tag(sync=True) for _ in range(3))
        hovering = traitlets.Bool(False).tag(sync=True)
        title, caption, group = (traitlets.Unicode("").tag(sync=True) for _ in range(3))
        webgl = traitlets.Unicode("").tag(sync=True)
        turn = traitlets.List().tag(sync=True)
        height = traitlets.Int(360).tag(sync=True)

        def __init__(self, *, view="corner", up="z", **options):
            super().__init__(turn=rotation(view, up).ravel().tolist(), **options)
            self.surface = self.painted = None
            self.observe(self.draw_still, "webgl")

        def draw_surface(self):
            """Send the surface and its colours, in one message."""
            with self.hold_sync():
                self.corner = as_bytes(self.surface[1], "uint32")
                self.color = b"" if self.painted is None else color_bytes(self.painted)
                self.position = as_bytes(self.surface[0], "float32")
            self.draw_still()

        def draw_colors(self):
            """Send the colours."""
            self.color = b"" if self.painted is None else color_bytes(self.painted)
            self.draw_still()

        def over(self, points=None, triangles=None):
            """A second surface that shines through, None for none."""
            with self.hold_sync():
                self.ghost_corner = b"" if points is None else as_bytes(triangles, "uint32")
                self.ghost_position = b"" if points is None else as_bytes(points, "float32")

        def draw_still(self, change=None):
            """Send a still picture where the browser has no WebGL2."""
            if self.webgl == "no" and self.surface is not None:
                self.still = self.picture()


class StillScene(Surfaces, ipywidgets.VBox):
    """The view where anywidget is not installed: a picture that Python draws again at every change."""

    title, caption = traitlets.Unicode(""), traitlets.Unicode("")
    points, turn = traitlets.List(), traitlets.List()
    bar, picked, hovered = traitlets.Dict(), traitlets.Dict(), traitlets.Dict()
    hovering = traitlets.Bool(False)

    def __init__(self, *, view="corner", up="z", title="", **options):
        self.image, self.text = ipywidgets.Image(format="png"), ipywidgets.HTML()
        self.surface = self.painted = None
        super().__init__([self.text, self.image], turn=rotation(view, up).ravel().tolist())
        self.observe(self.write, ["title", "caption", "bar"])
        self.title = title

    def write(self, change=None):
        """Title, caption and ends of the colour bar as text."""
        from html import escape

        bar = f" (colours from {self.bar['low']:.3g} to {self.bar['high']:.3g})" if self.bar else ""
        self.text.value = f"<b>{escape(self.title)}</b>{bar}<br>{escape(self.caption)}"

    def draw_surface(self):
        """Draw the picture again."""
        self.image.value = self.picture()

    draw_colors = draw_surface

    def over(self, points=None, triangles=None):
        """A second surface cannot shine through a picture: nothing is drawn."""


def scene(**options):
    """A view of a surface: :class:`Scene`, or pictures where anywidget is not installed."""
    return StillScene(**options) if anywidget is None else Scene(**options)
