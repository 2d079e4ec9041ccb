"""What panels are made of: surfaces that turn, and charts; both can be clicked.

Arrays in, places and marks out.  Where the browser has no WebGL2 it says so, and is sent a still
picture of the surface at every change.
"""

from typing import Any
from uuid import uuid4

import anywidget
import numpy as np
import traitlets

from s4a.show.browser import (
    CHART,
    SCENE,
    STYLE,
    color_bytes,
    color_scale,
    palette,
    to_bytes,
)
from s4a.show.draw import (
    SIGNED,
    checkerboard,
    image_bytes,
    on_white,
    render,
    rotation,
    signed_colors,
    with_balls,
)

SIZE = (460, 360)  # pixels of a still picture
MARK = (0.9, 0.6, 0.0)  # the colour of a marked point


def extent(points: np.ndarray) -> float:
    """Length of the diagonal of the points' box.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.views import extent
    >>> extent(np.array([[0, 0, 0], [1, 2, 2.0]]))
    3.0
    """
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def iteration_number(x: float) -> float:
    """The next number below that is 1, 2 or 5 times a power of ten.

    Examples
    --------
    >>> from s4a.widgets.views import iteration_number
    >>> iteration_number(17.3), iteration_number(0.6)
    (10.0, 0.5)
    """
    power = 10.0 ** np.floor(np.log10(x))
    return float(power * max(m for m in (1, 2, 5) if m * power <= x * (1 + 1e-9)))


def signed_limit(values: np.ndarray) -> float:
    """The size at which the colours of a signed function ``(n,)`` are full: its 99 % quantile.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.views import signed_limit
    >>> signed_limit(np.array([-2.0, 2.0]))
    2.0
    """
    return float(np.quantile(np.abs(values), 0.99))


def camera_group() -> str:
    """A name that no other panel has: the views of one panel turn together, those of two do not."""
    return uuid4().hex


class View(anywidget.AnyWidget):
    """What views of surfaces share: from where they look, and pictures for want of WebGL2.

    Attributes
    ----------
    turn : list of float
        Rows of the rotation with which the view first stands.
    group : str
        Views of one group turn together.
    webgl : {"", "yes", "no"}
        Whether the browser has WebGL2; it says so once it draws.
    """

    _css = STYLE
    still = traitlets.Bytes().tag(sync=True)
    webgl = traitlets.Unicode("").tag(sync=True)
    group = traitlets.Unicode("").tag(sync=True)
    turn = traitlets.List().tag(sync=True)
    height = traitlets.Int(360).tag(sync=True)  # pixels

    def drawn(self) -> tuple | None:
        """Points, triangles and colours of what is seen, None for nothing."""
        raise NotImplementedError

    def picture(self) -> bytes:
        """PNG bytes of what is seen from where the view first stands; empty for nothing."""
        drawn = self.drawn()
        if drawn is None:
            return b""
        points, triangles, colors = drawn
        # the rotation is applied here, and the renderer then looks along z from the top
        turned, look = points @ np.reshape(self.turn, (3, 3)).T, {"view": "top", "size": SIZE}
        return image_bytes(on_white(render(turned, triangles, colors=colors, **look)), "png")

    def draw_still(self, change: object = None) -> None:
        """Send a still picture where the browser has no WebGL2."""
        if self.webgl == "no":
            self.still = self.picture()


class Scene(View):
    """A view of one surface.

    Parameters
    ----------
    view, up
        From where the surface is seen first; see :func:`s4a.show.draw.rotation`.
    **options
        Of the traits, such as ``title``, ``group``, ``height`` and ``clickable``.

    Attributes
    ----------
    clickable : bool
        Whether places can be picked: by a click, or with a cursor that the arrow keys move over
        the surface.
    picked, hovered : dict
        The place that was clicked, or is under the pointer (where `hovering` is set): ``vertex``
        (-1 beside the surface), ``face``, ``weights`` in that triangle, ``point``, and its number
        `count`.  A place that the browser carries to the other view by itself is hovered unheard.
    lasso : bool
        Whether a drag draws around vertices, and does not turn the surface.
    drawn_around : dict
        What was drawn: its ``polygon (q, 2)`` in the plane of the view, in the unit of the surface,
        the rotation ``turn`` of that view, and its number `count`.
    answer : int
        The number of the place to which marks and caption answer; -1 for none.  An answer to a
        place older than the last, of any view of the group, is not shown.
    """

    _esm = SCENE
    position = traitlets.Bytes().tag(sync=True)
    corner = traitlets.Bytes().tag(sync=True)
    color = traitlets.Bytes().tag(sync=True)
    coordinate = traitlets.Bytes().tag(sync=True)  # in which the checkerboard is evaluated
    cell = traitlets.Float(0.0).tag(sync=True)  # its side
    ghost_position = traitlets.Bytes().tag(sync=True)
    ghost_corner = traitlets.Bytes().tag(sync=True)
    points = traitlets.List().tag(sync=True)  # [x, y, z, red, green, blue, radius] each
    radius = traitlets.Float(0.0).tag(sync=True)
    link = traitlets.Bytes().tag(sync=True)
    link_values = traitlets.Bytes().tag(sync=True)
    link_back = traitlets.Bytes().tag(sync=True)
    link_color = traitlets.List().tag(sync=True)
    link_text = traitlets.Unicode("").tag(sync=True)
    bar = traitlets.Dict().tag(sync=True)
    title = traitlets.Unicode("").tag(sync=True)
    caption = traitlets.Unicode("").tag(sync=True)
    clickable = traitlets.Bool(False).tag(sync=True)
    hovering = traitlets.Bool(False).tag(sync=True)
    answer = traitlets.Int(-1).tag(sync=True)
    picked = traitlets.Dict().tag(sync=True)
    hovered = traitlets.Dict().tag(sync=True)
    lasso = traitlets.Bool(False).tag(sync=True)
    drawn_around = traitlets.Dict().tag(sync=True)

    surface = colors = coordinates = None  # what is seen, as arrays

    def __init__(self, *, view="corner", up="z", **options):
        super().__init__(turn=rotation(view, up).ravel().tolist(), **options)
        self.observe(self.draw_still, ["webgl", "points"])

    def show(
        self,
        points: np.ndarray,
        triangles: np.ndarray,
        colors: np.ndarray | None = None,
        title: str | None = None,
    ) -> None:
        """Show a surface ``(n, 3)``, ``(m, 3)`` with colours ``(n, 3)``; marks are forgotten."""
        self.surface = np.asarray(points), np.asarray(triangles)
        with self.hold_sync():
            self._send_colors(colors, None, 0.0)
            self.radius = extent(points) / 100
            self.points = []
            self.link = self.link_values = self.link_back = b""
            if title is not None:
                self.title = title
            self.corner = to_bytes(triangles, "uint32")
            self.position = to_bytes(points, "float32")
        self.draw_still()

    def paint(
        self,
        colors: np.ndarray | None,
        bar: dict | None = None,
        coordinates: np.ndarray | None = None,
        cell: float = 0.0,
    ) -> None:
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
        with self.hold_sync():
            self.bar = bar or {}
            self._send_colors(colors, coordinates, cell)
        self.draw_still()

    def paint_function(self, values: np.ndarray, label: str, limit: float | None = None) -> None:
        """A signed function ``(n,)`` as colours, full at `limit` or :func:`signed_limit`."""
        limit = signed_limit(values) if limit is None else limit
        self.paint(signed_colors(values, limit), color_scale(SIGNED, -limit, limit, label))

    def _send_colors(self, colors, coordinates, cell):
        self.answer = -1
        self.colors, self.coordinates = colors, coordinates
        self.color = b"" if colors is None else color_bytes(colors)
        self.coordinate = b"" if coordinates is None else to_bytes(coordinates, "float32")
        self.cell = 0.0 if coordinates is None else float(cell)

    def mark(
        self, points: np.ndarray, colors: np.ndarray | tuple = (MARK,), radius: float | None = None
    ) -> None:
        """Spheres around some points ``(p, 3)``, of one colour or one for each.

        The radius, in the unit of the data, is by default a hundredth of the surface's extent.
        """
        points = np.asarray(points, float).reshape(-1, 3)
        colors = np.broadcast_to(np.asarray(colors, float).reshape(-1, 3), points.shape)
        self.radius = self.radius if radius is None else float(radius)
        places = np.concatenate([points, colors], axis=1).tolist()
        with self.hold_sync():
            self.answer = -1
            self.points = [[*place, self.radius] for place in places]

    def connect(
        self,
        link: np.ndarray,
        text: str,
        values: np.ndarray | None = None,
        *,
        back: np.ndarray | None = None,
        color: tuple = (),
    ) -> None:
        """Let the browser mark on the other view of the group what is picked on this one.

        With `back` it compares this view with others of the same surface and the group: a vertex
        that is picked is marked on all of them, and on the view of the other surface where each of
        them has it, in its colour; one picked there is marked on each where it has that.

        Parameters
        ----------
        link : int ndarray (n,)
            A vertex of the other surface for each vertex, -1 for none.
        text : str
            What is said of them, with ``{here}`` and ``{there}`` for the two, and ``{value}``.
        values : float ndarray (n,), optional
            The confidence, from 0 to 1; of views that are compared what is said in percent, NaN
            where unknown.
        back : int ndarray (m,), optional
            A vertex of this surface for each of the other, -1 for none.
        color : tuple of 3 floats
        """
        with self.hold_sync():
            self.link_text, self.link_color = text, list(color)
            self.link_values = b"" if values is None else to_bytes(values, "float32")
            self.link_back = b"" if back is None else to_bytes(back, "int32")
            self.link = to_bytes(link, "int32")

    def over(self, points: np.ndarray | None = None, triangles: np.ndarray | None = None) -> None:
        """A second surface that shines through, None for none."""
        with self.hold_sync():
            self.ghost_corner = b"" if triangles is None else to_bytes(triangles, "uint32")
            self.ghost_position = b"" if points is None else to_bytes(points, "float32")

    def drawn(self) -> tuple | None:
        """The surface with its checkerboard and its marked points."""
        if self.surface is None:
            return None
        colors = self.colors
        if self.coordinates is not None:
            colors = np.asarray(colors) * checkerboard(self.coordinates, self.cell)[:, None]
        return with_balls(*self.surface, colors, self.points)


AXES = "eigenfunction of the source", "eigenfunction of the target"  # of columns, and of rows
DIRECTION = (
    "C transfers functions from the source to the target: of their coefficients a on the source "
    "(columns) it makes b = C a on the target (rows)."
)


def plain(value: object) -> object:
    """NumPy numbers and arrays as Python's own, NaN as None, so that they can be sent.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.views import plain
    >>> plain({"x": np.array([1.0, np.nan]), "n": np.int64(3)})
    {'x': [1.0, None], 'n': 3}
    """
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


class Chart(anywidget.AnyWidget):
    """A chart in the browser.

    Attributes
    ----------
    spec : dict
        The ``kind`` of chart, its numbers and names.
    picked : dict
        The mark that was clicked: an index, node, edge, or row and column, and its number `count`.
    answer : int
        The number of the mark to which the chart answers as it is; -1 for none.  Answers to marks
        older than the last are not drawn.
    """

    _esm, _css = CHART, STYLE
    spec = traitlets.Dict().tag(sync=True)
    picked = traitlets.Dict().tag(sync=True)
    answer = traitlets.Int(-1).tag(sync=True)
    values = traitlets.Bytes().tag(sync=True)
    palette = traitlets.Bytes(palette(SIGNED)).tag(sync=True)

    def draw(self, kind: str, **spec: Any) -> None:
        """Draw ``scatter``, ``bars``, ``lines`` or ``graph``: numbers as chart.js names them."""
        with self.hold_sync():
            self.answer = -1
            self.spec = plain({"kind": kind, **spec})

    def matrix(self, values: np.ndarray, limit: float = 1.0, **spec: Any) -> None:
        """Draw a functional map ``(rows, columns)`` with signed colours from -limit to limit."""
        rows, columns = np.shape(values)
        with self.hold_sync():
            self.values = to_bytes(values, "float32")
            self.draw("matrix", rows=rows, columns=columns, limit=limit, axes=AXES, **spec)
