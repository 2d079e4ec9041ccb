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
from s4a.widgets.correspondence import inverse
from s4a.widgets.panel import WIDE, Panel, dropdown, grid, row
from s4a.widgets.views import extent, iteration_number

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
MOST = 7  # methods side by side
EVENTS = "picked", "hovered"
CELLS = 14  # of the checkerboard along the surface's extent
FULL_ERROR = 0.98  # quantile of the errors of a method that the colours reach, in the median
FULL_AREA = 2.0  # doublings of the area that the colours reach
MARKS = [to_rgb(OKABE_ITO[i]) for i in (5, 4, 2, 6, 0, 1, 7)]


def with_ground_truth(found: xr.Dataset, n_source: int) -> xr.Dataset:
    """What was found on a pair, with the truth as one more method, where it is known."""
    if "true_position" not in found:
        return found
    match = found["true_match"].values
    truth = {
        "algorithm_match": ("vertex", match),
        "algorithm_image": (("vertex", "xyz"), found["true_position"].values),
        "algorithm_reverse": ("source_vertex", inverse(match, n_source)),
        "algorithm_error": ("vertex", np.where(match >= 0, 0.0, np.nan)),
        "algorithm_area_change": ("vertex", np.full(len(match), np.nan)),
    }
    known = xr.Dataset(truth).expand_dims(algorithm=[TRUTH])
    return found.drop_dims("algorithm").merge(xr.concat([found[list(truth)], known], "algorithm"))


class Comparison(Panel):
    """The target of a pair as several methods see it, beside the source.

    A place under the pointer, or clicked, is marked in all views; C starts a cursor that the
    arrow keys move over the surface.

    Parameters
    ----------
    found : xarray.DataTree
        Of :func:`s4a.compare` with ``keep=True``, or opened from the ``compare.nc`` of
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
    >>> found = s4a.compare(ball, ball, methods=["kNN"], keep=True)
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

    def build(self, methods: Any = None) -> list[ipywidgets.Widget]:
        """Choices, the source, and the target by each method."""
        self.pairs = {
            name: with_ground_truth(node.to_dataset(), self.study["source"].sizes["vertex"])
            for name, node in self.study["pairs"].children.items()
        }
        each = [one["algorithm"].values.astype(str).tolist() for one in self.pairs.values()]
        known = [way for way in max(each, key=len) if all(way in ways for ways in each)]
        ways = methods
        if methods is None:
            ways = dict.fromkeys([*(way for way in FIRST if way in known), *known])
            ways = list(ways)[: len(FIRST)]
        wrong = [way for way in ways if way not in known]
        if wrong or not 0 < len(ways) <= MOST:
            raise ValueError(
                f"methods must be 1 to {MOST} of {', '.join(known)}; found {', '.join(ways)}"
            )
        looks = [*SHOWN, ERROR] if TRUTH in known else SHOWN
        self.scenes = [self.new_scene(340, clickable=True) for _ in range(1 + len(ways))]
        self.pair = dropdown("pair", "the shapes between which methods match", list(self.pairs))
        self.colors, self.hover = dropdown("colours", COLORS, looks, layout=WIDE), self.follow()
        self.redraw(self.draw, self.pair)
        self.redraw(self.paint, self.colors)
        self.on_pick(self.scenes[0], lambda place: self.choose(-1, place["vertex"]), *EVENTS)
        self.ways = []
        for i, way in enumerate(ways):
            self.ways.append(dropdown(f"method {i + 1}", METHOD, known, value=way, layout=WIDE))
            setattr(self, f"way{i}", self.ways[-1])
            self.on_change(self.ways[-1], lambda _, i=i: self.paint_method(i))
            to = self.scenes[1 + i]
            self.on_pick(to, lambda place: self.choose(place["vertex"], -1), *EVENTS)
        self.live = (*(("colors", f"way{i}", "pair") for i in range(len(ways))), ("hover",))
        self.draw()
        return [row(self.pair, self.colors, self.hover), row(*self.ways), grid(*self.scenes)]

    @property
    def found(self) -> xr.Dataset:
        """What was found on the pair that is shown, with the target's mesh."""
        return self.pairs[self.pair.value]

    def of(self, name: str, way: str) -> np.ndarray:
        """A variable of what a method found: ``way_`` match, image, reverse, error or area."""
        return self.found[f"algorithm_{name}"].sel(algorithm=way).values

    def error(self, way: str) -> np.ndarray | None:
        """The error of every vertex of the target ``(n,)``; None where truth is unknown."""
        return self.of("error", way) if "algorithm_error" in self.found else None

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
        self.cell = iteration_number(extent(X) / CELLS)
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
        image, error = self.of("image", way), self.error(way)
        mean = "" if error is None or way == TRUTH else f", error {100 * np.nanmean(error):.2f} %"
        scene.title = f"{way}{mean}"
        bar = coordinates = None
        if self.colors.value == "error":
            limit, label = self.full_error(), "error (% of √area)"
            colors = ramp_colors(error, 0, limit)
            bar = color_scale("viridis", 0, 100 * limit, label)
        elif self.colors.value == "area":
            label = "share of the area: doublings"
            colors = signed_colors(self.of("area", way) / np.log(2), FULL_AREA)
            bar = color_scale(SIGNED, -FULL_AREA, FULL_AREA, label)
        else:
            colors = position_colors(image, among=X)
            if self.colors.value == "checker":
                coordinates = np.nan_to_num(image)
        scene.paint(np.clip(colors, 0, 1), bar, coordinates, self.cell)
        back, color = self.of("reverse", way), MARKS[i]
        scene.connect(self.of("match", way), self.said(error), error, back=back, color=color)
        self.point()

    def said(self, error: np.ndarray | None, **numbers: Any) -> str:
        """What is said of a vertex of the target; its `numbers` are put in by the browser, too."""
        text = "target vertex {here} → source vertex {there}"
        text += "" if error is None else ", error {value} %"
        return text.format(**numbers) if numbers else text

    def full_error(self) -> float:
        """The error at which colours are full, the same for all methods of the pair."""
        error = self.found["algorithm_error"].drop_sel(algorithm=TRUTH).values
        reached = np.nanquantile(error, FULL_ERROR, axis=1)
        return float(max(np.median(reached), 1e-6))

    def choose(self, vertex: int, source_vertex: int) -> None:
        """A place of the target or of the source, where each method has it on the other."""
        self.vertex, self.source_vertex = vertex, source_vertex
        self.point()

    def point(self) -> None:
        """Mark the vertex that was picked, and where each method has it on the other surface."""
        X, there = self.surfaces[0][0], self.source_vertex
        if there >= 0:
            self.scenes[0].mark(X[there])
        elif self.vertex >= 0:
            ends = np.array([self.of("match", choice.value)[self.vertex] for choice in self.ways])
            colors = np.array(MARKS[: len(ends)])
            self.scenes[0].mark(X[ends[ends >= 0]], colors[ends >= 0])
        else:
            return
        for i, choice in enumerate(self.ways):
            back = self.of("reverse", choice.value)
            self.mark_method(i, int(back[there]) if there >= 0 else self.vertex)

    def mark_method(self, i: int, vertex: int) -> None:
        """Mark a vertex of the target in one view and say where its method puts it; -1 for none."""
        scene, way = self.scenes[1 + i], self.ways[i].value
        scene.mark(self.surfaces[1][0][[vertex]] if vertex >= 0 else [], MARKS[i])
        if vertex < 0:
            scene.caption = "nothing is matched to this vertex"
            return
        there, error = self.of("match", way)[vertex], self.error(way)
        value = np.nan if error is None else 100 * error[vertex]
        value = "unknown" if np.isnan(value) else f"{value:.2f}"
        there = there if there >= 0 else "unknown"
        scene.caption = self.said(error, here=vertex, there=there, value=value)
