"""Methods side by side (5.2): the matches of several methods between two shapes.

Transferred colours, a checkerboard, the error if there is ground truth, and changes of area.
"""

from typing import Any

import ipywidgets
import numpy as np
import traitlets
import xarray as xr
from matplotlib.colors import to_rgb

from s4a.schema import Array
from s4a.show.browser import color_scale
from s4a.show.draw import OKABE_ITO, SIGNED, position_colors, ramp_colors, signed_colors
from s4a.show.surfaces import mesh_of
from s4a.widgets.correspondence import inverse
from s4a.widgets.panel import WIDE, Panel, dropdown, grid, row
from s4a.widgets.views import extent, round_down

OPTIONS = [
    ("coordinates of the source", "position"),
    ("checkerboard of the source", "checker"),
    ("change of area", "area"),
]
ERROR = ("error", "error")
TRUTH = "truth"
DEFAULT = ("SCALABLE", "RE-MATCH", "registered surface")  # shown by default if available
COLORS = (
    "colours on the target: transferred from the source by the method, its change of area, or its "
    "error"
)
METHOD = "the method whose match is shown in this view"
MOST = 7  # methods side by side
EVENTS = "picked", "hovered"
CELLS = 14  # of the checkerboard along the surface's extent
FULL_ERROR = 0.98  # quantile of a method's errors; the colours end at the median of all methods
FULL_AREA = 2.0  # end of the colours, in doublings of the area
MARKS = [to_rgb(OKABE_ITO[i]) for i in (5, 4, 2, 6, 0, 1, 7)]


def with_ground_truth(result: xr.Dataset, n_source: int) -> xr.Dataset:
    """Return the matches of a pair with the ground truth, if known, as one more method."""
    if "true_position" not in result:
        return result
    match = result["true_match"].values
    truth = {
        "algorithm_match": ("vertex", match),
        "algorithm_image": (("vertex", "xyz"), result["true_position"].values),
        "algorithm_reverse": ("source_vertex", inverse(match, n_source)),
        "algorithm_error": ("vertex", np.where(match >= 0, 0.0, np.nan)),
        "algorithm_area_change": ("vertex", np.full(len(match), np.nan)),
    }
    known = xr.Dataset(truth).expand_dims(algorithm=[TRUTH])
    methods = xr.concat([result[list(truth)], known], "algorithm")
    return result.drop_dims("algorithm").merge(methods)


class Comparison(Panel):
    """The source of a pair next to the target with the match of several methods.

    A vertex under the pointer, or clicked, is marked in all views.  C starts a cursor that the
    arrow keys move over the surface.

    Parameters
    ----------
    comparison : xarray.DataTree
        Result of :func:`s4a.compare` with ``keep=True``, or opened from the ``compare.nc`` of
        ``s4a compare --keep``.
    methods : sequence of str, optional
        At most seven methods of the comparison; by default SCALABLE, RE-MATCH and registered
        surface.  "truth" is the ground truth, if it is known.
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    vertex, source_vertex : int
        The last picked vertex of the target, or of the source; -1 for none.

    Raises
    ------
    ValueError
        If meshes and matches were not kept, or a method is not in the comparison.

    See Also
    --------
    s4a.compare : the methods and their errors.
    s4a.widgets.Correspondence : correspondence of two shapes of a study.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import Comparison
    >>> ball = s4a.synthetic.ellipsoid(300)
    >>> comparison = s4a.compare(ball, ball, methods=["kNN"], keep=True)
    >>> panel = Comparison(comparison)
    >>> [scene.title for scene in panel.scenes[1:]]
    ['kNN']
    >>> panel.close()
    """

    title = "Methods side by side"
    vertex, source_vertex = traitlets.Int(-1), traitlets.Int(-1)

    def __init__(self, comparison: xr.DataTree, **options: Any):
        is_tree = isinstance(comparison, xr.DataTree)
        if not (is_tree and {"source", "pairs"} <= comparison.children.keys()):
            raise ValueError(
                f"the panel {self.title} needs the meshes and matches of a comparison; found a "
                "result without them: compare again with keep=True, or with s4a compare --keep"
            )
        super().__init__(comparison, **options)

    def build(self, methods: Any = None) -> list[ipywidgets.Widget]:
        """Return the controls, the view of the source, and a view of the target per method."""
        self.pairs = {
            name: with_ground_truth(node.to_dataset(), self.study["source"].sizes["vertex"])
            for name, node in self.study["pairs"].children.items()
        }
        each = [pair["algorithm"].values.astype(str).tolist() for pair in self.pairs.values()]
        known = [name for name in max(each, key=len) if all(name in names for names in each)]
        if methods is None:
            ordered = dict.fromkeys([*(name for name in DEFAULT if name in known), *known])
            methods = list(ordered)[: len(DEFAULT)]
        unknown = [name for name in methods if name not in known]
        if unknown or not 0 < len(methods) <= MOST:
            raise ValueError(
                f"methods must be 1 to {MOST} of {', '.join(known)}; found {', '.join(methods)}"
            )
        options = [*OPTIONS, ERROR] if TRUTH in known else OPTIONS
        self.scenes = [self.new_scene(340, clickable=True) for _ in range(1 + len(methods))]
        self.pair = dropdown("pair", "the source and target shapes", list(self.pairs))
        self.colors, self.hover = dropdown("colours", COLORS, options, layout=WIDE), self.follow()
        self.redraw(self.draw, self.pair)
        self.redraw(self.paint, self.colors)
        self.on_pick(self.scenes[0], lambda picked: self.choose(-1, picked["vertex"]), *EVENTS)
        self.methods = []
        for i, name in enumerate(methods):
            control = dropdown(f"method {i + 1}", METHOD, known, value=name, layout=WIDE)
            self.methods.append(control)
            setattr(self, f"method{i}", control)
            self.on_change(control, lambda _, i=i: self.paint_method(i))
            scene = self.scenes[1 + i]
            self.on_pick(scene, lambda picked: self.choose(picked["vertex"], -1), *EVENTS)
        self.live = (*(("colors", f"method{i}", "pair") for i in range(len(methods))), ("hover",))
        self.draw()
        return [row(self.pair, self.colors, self.hover), row(*self.methods), grid(*self.scenes)]

    @property
    def result(self) -> xr.Dataset:
        """The matches of the pair that is shown, with the target's mesh."""
        return self.pairs[self.pair.value]

    def values(self, name: str, method: str) -> Array:
        """Return the variable ``algorithm_<name>`` of a method."""
        return self.result[f"algorithm_{name}"].sel(algorithm=method).values

    def error(self, method: str) -> Array | None:
        """Return the error of every vertex of the target ``(n,)``; None without ground truth."""
        return self.values("error", method) if "algorithm_error" in self.result else None

    def draw(self) -> None:
        """Draw both surfaces of the pair and their colours."""
        self.vertex = self.source_vertex = -1
        self.surfaces = mesh_of(self.study["source"].dataset), mesh_of(self.result)
        count = len(self.surfaces[0][0])
        self.scenes[0].show(*self.surfaces[0], title=f"the source, {count:,} vertices")
        for scene in self.scenes[1:]:
            scene.show(*self.surfaces[1])
            scene.caption = ""
        self.paint()

    def paint(self) -> None:
        """Colour all views."""
        X, _ = self.surfaces[0]
        self.cell = round_down(extent(X) / CELLS)
        checker = self.colors.value == "checker"
        plain = self.colors.value in ("area", "error")
        colors = None if plain else position_colors(X)
        self.scenes[0].paint(colors, None, X if checker else None, self.cell)
        unit = self.study["source"].attrs.get("unit") or "unit of the input"
        caption = f"checkerboard of cubes of {self.cell:g} ({unit})" if checker else ""
        self.scenes[0].caption = "" if plain else caption or "coordinates as colours"
        for i in range(len(self.methods)):
            self.paint_method(i)

    def paint_method(self, i: int) -> None:
        """Colour the target in view `i` by the method selected for it."""
        method, scene = self.methods[i].value, self.scenes[1 + i]
        X, _ = self.surfaces[0]
        image, error = self.values("image", method), self.error(method)
        has_error = error is not None and method != TRUTH
        scene.title = f"{method}, error {100 * np.nanmean(error):.2f} %" if has_error else method
        bar = coordinates = None
        if self.colors.value == "error":
            limit, label = self.full_error(), "error (% of √area)"
            colors = ramp_colors(error, 0, limit)
            bar = color_scale("viridis", 0, 100 * limit, label)
        elif self.colors.value == "area":
            label = "change of area (log2)"
            colors = signed_colors(self.values("area_change", method) / np.log(2), FULL_AREA)
            bar = color_scale(SIGNED, -FULL_AREA, FULL_AREA, label)
        else:
            colors = position_colors(image, among=X)
            if self.colors.value == "checker":
                coordinates = np.nan_to_num(image)
        scene.paint(np.clip(colors, 0, 1), bar, coordinates, self.cell)
        match, back = self.values("match", method), self.values("reverse", method)
        scene.connect(match, self.caption(error), error, back=back, color=MARKS[i])
        self.point()

    def caption(self, error: Array | None, **numbers: Any) -> str:
        """Return the caption of a vertex of the target; the browser also fills in `numbers`."""
        text = "target vertex {here} → source vertex {there}"
        text += "" if error is None else ", error {value} %"
        return text.format(**numbers) if numbers else text

    def full_error(self) -> float:
        """Return the end of the colour scale of errors, the same for all methods of the pair."""
        error = self.result["algorithm_error"].drop_sel(algorithm=TRUTH).values
        reached = np.nanquantile(error, FULL_ERROR, axis=1)
        return float(max(np.median(reached), 1e-6))

    def choose(self, vertex: int, source_vertex: int) -> None:
        """Select a vertex of the target or of the source; -1 for none."""
        self.vertex, self.source_vertex = vertex, source_vertex
        self.point()

    def point(self) -> None:
        """Mark the picked vertex, and its match by each method on the other surface."""
        X, there = self.surfaces[0][0], self.source_vertex
        if there >= 0:
            self.scenes[0].mark(X[there])
        elif self.vertex >= 0:
            images = np.array(
                [self.values("match", control.value)[self.vertex] for control in self.methods]
            )
            colors = np.array(MARKS[: len(images)])
            self.scenes[0].mark(X[images[images >= 0]], colors[images >= 0])
        else:
            return
        for i, control in enumerate(self.methods):
            back = self.values("reverse", control.value)
            self.mark_method(i, int(back[there]) if there >= 0 else self.vertex)

    def mark_method(self, i: int, vertex: int) -> None:
        """Mark a vertex of the target in view `i`, with its match as caption; -1 for no vertex."""
        scene, method = self.scenes[1 + i], self.methods[i].value
        scene.mark(self.surfaces[1][0][[vertex]] if vertex >= 0 else [], MARKS[i])
        if vertex < 0:
            scene.caption = "no vertex is matched to this one"
            return
        there, error = self.values("match", method)[vertex], self.error(method)
        value = np.nan if error is None else 100 * error[vertex]
        value = "unknown" if np.isnan(value) else f"{value:.2f}"
        there = there if there >= 0 else "unknown"
        scene.caption = self.caption(error, here=vertex, there=there, value=value)
