"""A surface in three dimensions.

Arrays in, a view that turns, is coloured and can be clicked out.
"""

import ipywidgets
import numpy as np
import traitlets

from s4a.show.draw import checkerboard, image_bytes, on_white, render, rotation, with_balls
from s4a.show.live import STYLE, as_bytes, color_bytes
from s4a.widgets.browser import SCENE, anywidget

SIZE = (460, 360)  # pixels of a still picture


def extent(points):
    """Length of the diagonal of the points' box.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.scene import extent
    >>> extent(np.array([[0, 0, 0], [1, 2, 2.0]]))
    3.0
    """
    return float(np.linalg.norm(np.ptp(points, axis=0)))


class Surfaces:
    """What a view of a surface does, whoever draws it.

    The arrays are kept, and a still picture can be made.
    """

    surface = painted = texture = None
    points = ()

    def show(self, points, triangles, colors=None, title=None):
        """Show a surface ``(n, 3)``, ``(m, 3)`` with colours ``(n, 3)``.

        What was marked is forgotten.
        """
        self.surface = np.asarray(points), np.asarray(triangles)
        self.painted, self.texture = colors, None
        self.radius = extent(self.surface[0]) / 100
        self.unlink()
        if title is not None:
            self.title = title
        self.points = []
        self.draw_surface()

    def paint(self, colors, bar=None, coordinates=None, cell=0.0):
        """Colours of the vertices, and a checkerboard over them.

        Parameters
        ----------
        colors : float ndarray (n, 3)
            None for none.
        bar : dict, optional
            The colour bar that explains them.
        coordinates : float ndarray (n, 3), optional
            Where the checkerboard is evaluated; cubes of the side `cell` are bright and dark in
            turn.
        """
        self.painted, self.texture = (
            colors,
            None if coordinates is None else (np.asarray(coordinates), cell),
        )
        self.bar = bar or {}
        self.draw_colors()

    def mark(self, points, colors=((0.9, 0.6, 0.0),), radius=None):
        """Spheres around some points ``(p, 3)``, in the unit of the data.

        One colour or one for each.

        The radius is by default a hundredth of the surface's extent.
        """
        points = np.asarray(points, float).reshape(-1, 3)
        colors = np.broadcast_to(np.asarray(colors, float), (len(points), 3))
        self.radius = self.radius if radius is None else float(radius)
        self.points = [
            [*p, *c, self.radius] for p, c in zip(points.tolist(), colors.tolist(), strict=True)
        ]

    def picture(self):
        """PNG bytes of the surface from where the view first stands; empty without a surface."""
        if self.surface is None:
            return b""
        turn = np.reshape(self.turn, (3, 3))
        colors = self.painted
        if self.texture is not None:
            colors = np.asarray(colors) * checkerboard(*self.texture)[:, None]
        points, triangles, colors = with_balls(*self.surface, colors, self.points)
        # the rotation is applied here, and the renderer then looks along z from the top
        drawn = render(points @ turn.T, triangles, colors=colors, view="top", size=SIZE)
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
            From where the surface is seen first; see :func:`s4a.show.draw.rotation`.
        height : int
            In pixels.

        Attributes
        ----------
        clickable : bool
            Whether places can be picked: by a click, or with a cursor that the arrow keys move over
            the surface.
        picked, hovered : dict
            The place that was clicked, or is under the pointer (where `hovering` is set):
            ``vertex`` (-1 beside the surface), ``face``, ``weights`` in that triangle, and
            ``point``.
        """

        _esm, _css = SCENE, STYLE
        position, corner, color, coordinate, still = (
            traitlets.Bytes().tag(sync=True) for _ in range(5)
        )
        cell, radius = (traitlets.Float(0.0).tag(sync=True) for _ in range(2))
        link, link_values = (traitlets.Bytes().tag(sync=True) for _ in range(2))
        link_text = traitlets.Unicode("").tag(sync=True)
        clickable = traitlets.Bool(False).tag(sync=True)
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
            self.observe(self.draw_still, ["webgl", "points"])

        def draw_surface(self):
            """Send the surface and its colours, in one message."""
            with self.hold_sync():
                self.corner = as_bytes(self.surface[1], "uint32")
                self.send_colors()
                self.position = as_bytes(self.surface[0], "float32")
            self.draw_still()

        def send_colors(self):
            """Colours and checkerboard as bytes."""
            self.color = b"" if self.painted is None else color_bytes(self.painted)
            self.coordinate = b"" if self.texture is None else as_bytes(self.texture[0], "float32")
            self.cell = 0.0 if self.texture is None else float(self.texture[1])

        def connect(self, link, text, values=None):
            """Let the browser mark on the other view of the group what is picked on this one.

            `link` is a vertex of the other view for each vertex, -1 for none; `text` says so, with
            ``{here}`` and ``{there}`` for the two; `values` from 0 to 1 are the confidence.
            """
            with self.hold_sync():
                self.link, self.link_text = as_bytes(link, "int32"), text
                self.link_values = (
                    b"" if values is None else as_bytes(100 * np.asarray(values) + 0.5, "uint8")
                )

        def unlink(self):
            """Nothing is marked on another view."""
            with self.hold_sync():
                self.link = self.link_values = b""

        def draw_colors(self):
            """Send the colours."""
            with self.hold_sync():
                self.send_colors()
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
    """The view where anywidget is not installed.

    A picture that Python draws again at every change.
    """

    title, caption, radius = traitlets.Unicode(""), traitlets.Unicode(""), traitlets.Float(0.0)
    points, turn = traitlets.List(), traitlets.List()
    bar, picked, hovered = traitlets.Dict(), traitlets.Dict(), traitlets.Dict()
    hovering = traitlets.Bool(False)

    def __init__(self, *, view="corner", up="z", title="", **options):
        self.image, self.text = ipywidgets.Image(format="png"), ipywidgets.HTML()
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

    def connect(self, link, text, values=None):
        """Nothing runs in the browser that could mark a point."""

    def unlink(self):
        """There is nothing to undo."""

    def over(self, points=None, triangles=None):
        """A second surface cannot shine through a picture: nothing is drawn."""


def scene(**options):
    """A view of a surface: :class:`Scene`, or pictures where anywidget is not installed."""
    return StillScene(**options) if anywidget is None else Scene(**options)
