"""Methods side by side (5.2): one pair of shapes, and what each method carries from one to other.

Colours, a checkerboard, the error where there is truth, and what a method does to areas.
"""

from typing import Any

import ipywidgets
import numpy as np
import traitlets
import xarray as xr
from matplotlib.colors import to_rgb

from s4a.show.browser import color_scale
from s4a.show.draw import OKABE_ITO, SIGNED, position_colors, ramp_colors, signed_colors
from s4a.show.surfaces import mesh_of
from s4a.widgets.panel import WIDE, Panel, check, dropdown, grid, row
from s4a.widgets.scene import Scene, camera_group, extent, round_number

SHOWN = [
    ("coordinates of the source", "place"),
    ("checkerboard of the source", "checker"),
    ("change of area", "area"),
]
ERROR = ("error", "error")
TRUTH = "truth"
FIRST = ("SCALABLE", "RE-MATCH", "registered surface")  # what is shown first, where it is there
COLORS = (
    "what is seen on the target: what a method carries from the source, what it does to areas, or "
    "how far it is from the truth"
)
METHOD = "which method's match is shown in this view"
FOLLOW = "mark what is under the pointer in all views, and not only what is clicked"
MOST = 7  # methods side by side
CELLS = 14  # of the checkerboard along the surface's extent
FULL_ERROR = 0.98  # quantile of the errors of a method that the colours reach, in the median
FULL_AREA = 2.0  # doublings of the area that the colours reach
MARKS = [to_rgb(OKABE_ITO[i]) for i in (5, 4, 2, 6, 0, 1, 7)]


class Comparison(Panel):
    """The target of a pair as several methods see it, beside the source.

    A place under the pointer, or clicked, is marked in all views; C starts a cursor that the
    arrow keys move over the surface.

    Parameters
    ----------
    found : xarray.DataTree
        Of :func:`s4a.compare.pairs` with ``keep=True``, or opened from the ``compare.nc`` of
        ``s4a compare --keep``.
    methods : sequence of str, optional
        At most seven methods of it, shown first; SCALABLE, RE-MATCH and registered surface by
        default.  "truth" is one where it is known.
    view, up
        From where the surfaces are seen first; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    vertex, source_vertex : int
        The vertex of the target, or of the source, that was picked last; -1 for none.

    Raises
    ------
    ValueError
        When meshes and matches were not kept, or a method is none of the result's.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import Comparison
    >>> ball = s4a.synthetic.ellipsoid(300)
    >>> found = s4a.compare.pair(ball, ball, methods=["kNN"], keep=True)
    >>> panel = Comparison(found)
    >>> [scene.title for scene in panel.scenes[1:]]
    ['kNN']
    >>> panel.close()
    """

    title = "Methods side by side"
    vertex, source_vertex = traitlets.Int(-1), traitlets.Int(-1)

    def __init__(self, found: xr.DataTree, **options: Any):
        kept = isinstance(found, xr.DataTree) and {"source", "pairs"} <= found.children.keys()
        if not kept:
            raise ValueError(
                f"the panel {self.title} needs the meshes and matches of a comparison; found a "
                "result without them: give s4a.compare.pair or pairs keep=True, s4a compare --keep"
            )
        super().__init__(found, **options)

    def build(
        self, methods: Any = None, view: str = "corner", up: str = "z"
    ) -> list[ipywidgets.Widget]:
        """Choices, the source, and the target by each method."""
        self.pairs = {
            name: node.to_dataset() for name, node in self.study["pairs"].children.items()
        }
        known = [str(way) for way in next(iter(self.pairs.values()))["way"].values]
        if all("true_position" in one for one in self.pairs.values()):
            known.append(TRUTH)
        ways = self.first(known) if methods is None else list(methods)
        wrong = [way for way in ways if way not in known]
        if wrong or not 0 < len(ways) <= MOST:
            raise ValueError(
                f"methods must be 1 to {MOST} of {', '.join(known)}; found {', '.join(ways)}"
            )
        self.pair = dropdown("pair", "the shapes between which methods match", list(self.pairs))
        looks = [*SHOWN, ERROR] if TRUTH in known else SHOWN
        self.colors = dropdown("colours", COLORS, looks, layout=WIDE)
        self.hover = check("follow the pointer", FOLLOW, True)
        self.ways = []
        for i, way in enumerate(ways):
            self.ways.append(dropdown(f"method {i + 1}", METHOD, known, value=way, layout=WIDE))
            setattr(self, f"way{i}", self.ways[-1])
        self.live = (*(("colors", f"way{i}", "pair") for i in range(len(ways))), ("hover",))
        look = {"group": camera_group(), "view": view, "up": up, "height": 340, "clickable": True}
        self.scenes = [Scene(**look) for _ in range(1 + len(ways))]
        self.redraw(self.draw, self.pair)
        self.redraw(self.paint, self.colors)
        for i, choice in enumerate(self.ways):
            self.on_change(choice, lambda _, i=i: self.paint_method(i))
        self.on_change(self.hover, self.follow)
        for i, scene in enumerate(self.scenes):
            self.on_pick(scene, self.from_target if i else self.from_source, "picked", "hovered")
        self.draw()
        self.follow(True)
        return [row(self.pair, self.colors, self.hover), row(*self.ways), grid(*self.scenes)]

    def first(self, known: list[str]) -> list[str]:
        """The methods that are shown first."""
        return list(dict.fromkeys([*(way for way in FIRST if way in known), *known]))[: len(FIRST)]

    @property
    def found(self) -> xr.Dataset:
        """What was found on the pair that is shown, with the target's mesh."""
        return self.pairs[self.pair.value]

    def follow(self, on: bool) -> None:
        """Whether points under the pointer are marked, and not only clicked ones."""
        for scene in self.scenes:
            scene.hovering = bool(on)

    def image(self, way: str) -> np.ndarray:
        """Where a method puts the vertices of the target ``(n, 3)``, NaN where unknown."""
        if way == TRUTH:
            return self.found["true_position"].values
        return self.found["way_image"].sel(way=way).values.astype(float)

    def match(self, way: str) -> np.ndarray:
        """On each vertex of the target a vertex of the source ``(n,)``, -1 where unknown."""
        if way == TRUTH:
            return self.found["true_match"].values
        return self.found["way_match"].sel(way=way).values

    def way_back(self, way: str) -> np.ndarray:
        """On each vertex of the source a vertex of the target, -1 for none."""
        if way != TRUTH:
            return self.found["way_reverse"].sel(way=way).values
        match = self.match(way)
        back = np.full(self.study["source"].sizes["vertex"], -1)
        known = np.flatnonzero(match >= 0)[::-1]  # the first of several stays
        back[match[known]] = known
        return back

    def error(self, way: str) -> np.ndarray | None:
        """The error of every vertex of the target ``(n,)``; None where truth is unknown."""
        if "way_error" not in self.found:
            return None
        if way == TRUTH:
            return np.where(self.match(way) >= 0, 0.0, np.nan)
        return self.found["way_error"].sel(way=way).values

    def draw(self) -> None:
        """Both surfaces of a pair, and their colours."""
        self.vertex = self.source_vertex = -1
        self.surfaces = mesh_of(self.study["source"].dataset), mesh_of(self.found)
        count = len(self.surfaces[0][0])
        self.scenes[0].show(*self.surfaces[0], title=f"the source, {count:,} vertices")
        for scene in self.scenes[1:]:
            scene.show(*self.surfaces[1])
            scene.caption = ""
        self.paint()

    def paint(self) -> None:
        """The colours of all views."""
        X, _ = self.surfaces[0]
        self.cell = round_number(extent(X) / CELLS)
        checker = self.colors.value == "checker"
        plain = self.colors.value in ("area", "error")
        colors = None if plain else position_colors(X)
        self.scenes[0].paint(colors, None, X if checker else None, self.cell)
        unit = self.study["source"].attrs.get("unit") or "unit of the input"
        said = f"checkerboard of cubes of {self.cell:g} ({unit})" if checker else ""
        self.scenes[0].caption = "" if plain else said or "colours are coordinates"
        for i in range(len(self.ways)):
            self.paint_method(i)

    def paint_method(self, i: int) -> None:
        """The target in the colours of the method that is chosen for view `i`."""
        way, scene = self.ways[i].value, self.scenes[1 + i]
        X, _ = self.surfaces[0]
        image, error = self.image(way), self.error(way)
        mean = "" if error is None or way == TRUTH else f", error {100 * np.nanmean(error):.2f} %"
        scene.title = f"{way}{mean}"
        bar = coordinates = None
        if self.colors.value == "error":
            limit = self.full_error()
            label = "error (% of √area)"
            colors, bar = (
                ramp_colors(error, 0, limit),
                color_scale("viridis", 0, 100 * limit, label),
            )
        elif self.colors.value == "area":
            doublings = self.area(way) / np.log(2)
            colors = signed_colors(doublings, FULL_AREA)
            label = "share of the area: doublings"
            bar = color_scale(SIGNED, -FULL_AREA, FULL_AREA, label)
        else:
            colors = position_colors(image, among=X)
            if self.colors.value == "checker":
                coordinates = np.nan_to_num(image)
        scene.paint(np.clip(colors, 0, 1), bar, coordinates, self.cell)
        value = "" if error is None else ", error {value} %"
        text = f"target vertex {{here}} → source vertex {{there}}{value}"
        scene.compare(self.match(way), self.way_back(way), text, MARKS[i], error)
        self.point()

    def full_error(self) -> float:
        """The error at which colours are full, the same for all methods of the pair."""
        reached = np.nanquantile(self.found["way_error"].values, FULL_ERROR, axis=1)
        return float(max(np.median(reached), 1e-6))

    def area(self, way: str) -> np.ndarray:
        """Log of the share of area that every vertex gets, by that which it has; NaN for truth."""
        if way == TRUTH:
            return np.full(self.found.sizes["vertex"], np.nan)
        return self.found["way_area"].sel(way=way).values.astype(float)

    def from_target(self, place: dict) -> None:
        """A place of the target: where each method puts it."""
        if place.get("vertex", -1) >= 0:
            self.vertex, self.source_vertex = place["vertex"], -1
            self.point()

    def from_source(self, place: dict) -> None:
        """A place of the source: where each method finds it on the target."""
        if place.get("vertex", -1) >= 0:
            self.vertex, self.source_vertex = -1, place["vertex"]
            self.point()

    def point(self) -> None:
        """Mark the vertex that was picked, and where each method has it on the other surface."""
        if self.source_vertex >= 0:
            self.scenes[0].mark(self.surfaces[0][0][self.source_vertex])
            for i, choice in enumerate(self.ways):
                self.mark_method(i, int(self.way_back(choice.value)[self.source_vertex]))
        if self.vertex < 0:
            return
        ends = np.array([self.match(choice.value)[self.vertex] for choice in self.ways])
        colors = np.array(MARKS[: len(ends)])
        self.scenes[0].mark(self.surfaces[0][0][ends[ends >= 0]], colors[ends >= 0])
        for i in range(len(self.ways)):
            self.mark_method(i, self.vertex)

    def mark_method(self, i: int, vertex: int) -> None:
        """Mark a vertex of the target in one view and say where its method puts it; -1 for none."""
        scene, way = self.scenes[1 + i], self.ways[i].value
        scene.mark(self.surfaces[1][0][[vertex]] if vertex >= 0 else [], MARKS[i])
        if vertex < 0:
            scene.caption = "nothing is matched to this vertex"
            return
        there, error = self.match(way)[vertex], self.error(way)
        text = f"target vertex {vertex} → source vertex {there if there >= 0 else 'unknown'}"
        if error is not None:
            known = "unknown" if np.isnan(error[vertex]) else f"{100 * error[vertex]:.2f}"
            text += f", error {known} %"
        scene.caption = text
