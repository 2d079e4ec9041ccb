"""Building blocks of panels: surfaces that can be rotated, and charts; both can be clicked.

They take arrays and return the picked point or mark.  A browser without WebGL2 reports that, and
gets a still picture of the surface at every change.
"""

from typing import Any

import anywidget
import numpy as np
import traitlets

from s4a.schema import Array
from s4a.show.browser import CHART, SCENE, STYLE, color_bytes, color_scale, palette, to_bytes
from s4a.show.charts import reach
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
MARK = (0.9, 0.6, 0.0)  # colour of a marked point


def extent(points: Array) -> float:
    """Return the diagonal of the bounding box.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.views import extent
    >>> extent(np.array([[0, 0, 0], [1, 2, 2.0]]))
    3.0
    """
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def round_down(x: float) -> float:
    """Return the largest number up to `x` that is 1, 2 or 5 times a power of ten.

    Examples
    --------
    >>> from s4a.widgets.views import round_down
    >>> round_down(17.3), round_down(0.6)
    (10.0, 0.5)
    """
    power = 10.0 ** np.floor(np.log10(x))
    return float(power * max(m for m in (1, 2, 5) if m * power <= x * (1 + 1e-9)))


class View(anywidget.AnyWidget):
    """Base class of views of surfaces: the camera, and still pictures without WebGL2.

    Attributes
    ----------
    rotation : list of float
        Rows of the initial rotation.
    group : str
        Views of one group rotate together.
    webgl : {"", "yes", "no"}
        Availability of WebGL2, which the browser reports once it draws.
    """

    _css = STYLE
    still = traitlets.Bytes().tag(sync=True)
    webgl = traitlets.Unicode("").tag(sync=True)
    group = traitlets.Unicode("").tag(sync=True)
    rotation = traitlets.List().tag(sync=True)
    height = traitlets.Int(360).tag(sync=True)  # pixels

    def drawn(self) -> tuple | None:
        """Return points, triangles and colours of the visible surface; None if there is none."""
        raise NotImplementedError

    def picture(self) -> bytes:
        """Return a PNG of the surface in the initial view; empty if there is none."""
        drawn = self.drawn()
        if drawn is None:
            return b""
        points, triangles, colors = drawn
        # the rotation is applied here; the renderer looks along z from the top
        rotated = points @ np.reshape(self.rotation, (3, 3)).T
        pixels = render(rotated, triangles, colors=colors, view="top", size=SIZE)
        return image_bytes(on_white(pixels), "png")

    def draw_still(self, change: object = None) -> None:
        """Send a still picture if the browser has no WebGL2."""
        if self.webgl == "no":
            self.still = self.picture()


class Scene(View):
    """A view of one surface.

    Parameters
    ----------
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.
    **options
        Values of the traits, such as ``title``, ``group``, ``height`` and ``clickable``.

    Attributes
    ----------
    clickable : bool
        If True, points can be picked: by a click, or with a cursor that the arrow keys move over
        the surface.
    picked, hovered : dict
        The clicked point, or the point under the pointer (if `hovering`): ``vertex`` (-1 outside
        the surface), triangle ``face``, barycentric ``weights``, ``point``, and its number
        `count`.  The kernel does not get points that the browser can mark on the other view itself.
    lasso : bool
        If True, a drag selects vertices instead of rotating the surface.
    drawn_around : dict
        The lasso selection: its ``polygon (q, 2)`` in the plane of the view, in the unit of the
        surface, the ``rotation`` of that view, and its number `count`.
    answer : int
        Number of the pick to which marks and caption belong; -1 for none.  If a later pick exists
        in any view of the group, they are not shown.
    """

    _esm = SCENE
    position = traitlets.Bytes().tag(sync=True)
    corner = traitlets.Bytes().tag(sync=True)
    color = traitlets.Bytes().tag(sync=True)
    coordinate = traitlets.Bytes().tag(sync=True)  # where the checkerboard is evaluated
    cell = traitlets.Float(0.0).tag(sync=True)  # side of its cubes
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

    surface = colors = coordinates = None  # the traits as arrays

    def __init__(self, *, view="corner", up="z", **options):
        super().__init__(rotation=rotation(view, up).ravel().tolist(), **options)
        self.observe(self.draw_still, ["webgl", "points"])

    def show(
        self, points: Array, triangles: Array, colors: Array | None = None, title: str | None = None
    ) -> None:
        """Show a surface ``(n, 3)``, ``(m, 3)`` with colours ``(n, 3)``, and remove all marks."""
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
        colors: Array | None,
        bar: dict | None = None,
        coordinates: Array | None = None,
        cell: float = 0.0,
    ) -> None:
        """Set the colours of the vertices, and optionally a checkerboard over them.

        Parameters
        ----------
        colors : float ndarray (n, 3)
            None for no colours.
        bar : dict, optional
            Colour bar, as :func:`s4a.show.browser.color_scale` returns it.
        coordinates : float ndarray (n, 3), optional
            Points at which the checkerboard is evaluated.
        cell : float
            Side of its cubes, alternately bright and dark.
        """
        with self.hold_sync():
            self.bar = bar or {}
            self._send_colors(colors, coordinates, cell)
        self.draw_still()

    def paint_function(self, values: Array, label: str, limit: float | None = None) -> None:
        """Colour a signed function ``(n,)`` from -`limit` to `limit`, the 99 % quantile."""
        limit = reach(values, 0.99) if limit is None else limit
        self.paint(signed_colors(values, limit), color_scale(SIGNED, -limit, limit, label))

    def _send_colors(self, colors, coordinates, cell):
        self.answer = -1
        self.colors, self.coordinates = colors, coordinates
        self.color = b"" if colors is None else color_bytes(colors)
        self.coordinate = b"" if coordinates is None else to_bytes(coordinates, "float32")
        self.cell = 0.0 if coordinates is None else float(cell)

    def mark(
        self, points: Array, colors: Array | tuple = (MARK,), radius: float | None = None
    ) -> None:
        """Mark points ``(p, 3)`` by spheres of one colour, or of one colour each.

        The default radius is a hundredth of the surface's extent, in the unit of the data.
        """
        points = np.asarray(points, float).reshape(-1, 3)
        colors = np.broadcast_to(np.asarray(colors, float).reshape(-1, 3), points.shape)
        self.radius = self.radius if radius is None else float(radius)
        marks = np.concatenate([points, colors], axis=1).tolist()
        with self.hold_sync():
            self.answer = -1
            self.points = [[*mark, self.radius] for mark in marks]

    def connect(
        self,
        link: Array,
        text: str,
        values: Array | None = None,
        *,
        back: Array | None = None,
        color: tuple = (),
    ) -> None:
        """Let the browser mark the match of a picked vertex on the other view of the group.

        With `back`, several views show the same surface with the match of one method each.  A
        vertex picked on one of them is marked on all, and its match by each method on the other
        surface, in the colour of the method.  A vertex picked there is marked on each view.

        Parameters
        ----------
        link : int ndarray (n,)
            Matched vertex of the other surface for each vertex, -1 for none.
        text : str
            Caption with ``{here}`` and ``{there}`` for the two vertices, and ``{value}``.
        values : float ndarray (n,), optional
            The confidence from 0 to 1, or with `back` an error shown in percent; NaN if unknown.
        back : int ndarray (m,), optional
            Matched vertex of this surface for each vertex of the other, -1 for none.
        color : tuple of 3 floats
        """
        with self.hold_sync():
            self.link_text, self.link_color = text, list(color)
            self.link_values = b"" if values is None else to_bytes(values, "float32")
            self.link_back = b"" if back is None else to_bytes(back, "int32")
            self.link = to_bytes(link, "int32")

    def overlay(self, points: Array | None = None, triangles: Array | None = None) -> None:
        """Show a second, translucent surface; None removes it."""
        with self.hold_sync():
            self.ghost_corner = b"" if triangles is None else to_bytes(triangles, "uint32")
            self.ghost_position = b"" if points is None else to_bytes(points, "float32")

    def drawn(self) -> tuple | None:
        """Return the surface with its checkerboard and marked points."""
        if self.surface is None:
            return None
        colors = self.colors
        if self.coordinates is not None:
            colors = np.asarray(colors) * checkerboard(self.coordinates, self.cell)[:, None]
        return with_balls(*self.surface, colors, self.points)


AXES = "eigenfunction of the source", "eigenfunction of the target"  # columns, rows
DIRECTION = (
    "C transfers functions from source to target: it maps the coefficients a on the source "
    "(columns) to b = C a on the target (rows)."
)


def plain(value: object) -> object:
    """Convert NumPy numbers and arrays to Python numbers and lists, and NaN to None.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.views import plain
    >>> plain({"x": np.array([1.0, np.nan]), "n": np.int64(3)})
    {'x': [1.0, None], 'n': 3}
    """
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | Array):
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
        The clicked mark: an index, node, edge, or row and column, and its number `count`.
    answer : int
        Number of the click that the chart answers; -1 for none.  If a later click exists, the
        answer is not drawn.
    """

    _esm, _css = CHART, STYLE
    spec = traitlets.Dict().tag(sync=True)
    picked = traitlets.Dict().tag(sync=True)
    answer = traitlets.Int(-1).tag(sync=True)
    values = traitlets.Bytes().tag(sync=True)
    palette = traitlets.Bytes(palette(SIGNED)).tag(sync=True)

    def draw(self, kind: str, **spec: Any) -> None:
        """Draw a chart of arrays and texts; chart.js has further keys.

        Parameters
        ----------
        kind : {"scatter", "bars", "lines", "graph"}
        **spec
            ``title`` of all, and

            - scatter: ``x``, ``y``, ``names``, ``xlabel``, ``ylabel``; ``selected``, an index;
            - bars: ``names``, ``values``, ``label``; ``selected``; ``marked``, a list of indices;
            - lines: ``xlabel``, ``ylabel``, and ``series``, dicts of ``x``, ``y``, ``name``, and
              optionally ``color``, ``dots``, ``legend``;
            - graph: ``x``, ``y``, ``names`` of the nodes, and ``source``, ``target``, ``colors``,
              ``values``, ``edges``, ``label`` of the edges.
        """
        with self.hold_sync():
            self.answer = -1
            self.spec = plain({"kind": kind, **spec})

    def matrix(self, values: Array, limit: float = 1.0, **spec: Any) -> None:
        """Draw a functional map ``(rows, columns)`` with colours from -`limit` to `limit`."""
        rows, columns = np.shape(values)
        with self.hold_sync():
            self.values = to_bytes(values, "float32")
            self.draw("matrix", rows=rows, columns=columns, limit=limit, axes=AXES, **spec)
