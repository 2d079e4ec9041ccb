"""Maps of a test on the surface (6.1): effects at every vertex, and where they are significant."""

from typing import Any

import ipywidgets
import numpy as np
import traitlets
import xarray as xr

from s4a.geometry.mesh import vertex_areas, vertex_normals
from s4a.schema import Array, unit_of
from s4a.show.browser import color_scale
from s4a.show.draw import SIGNED, ramp_colors, signed_colors
from s4a.show.surfaces import has
from s4a.widgets.panel import WIDE, Panel, dropdown, row

# variable -> its name; of vectors the normal component is shown
SIGNED_MAPS = {"effect": "effect, along the normals", "field_effect": "effect on the field"}
POSITIVE_MAPS = {"effect_size": "effect size", "explained_share": "explained share of the variance"}
EVERYWHERE = "everywhere"
P_VALUES = {
    "p_family_wise": "family-wise",
    "p_false_discovery": "false discovery rate",
    "p_vertex": "each vertex alone",
}
LEVELS = [0.05, 0.01, 0.001]
MAP = "the quantity shown as colours; of vectors the component along the outward normals"
WHERE = "correction for multiple comparisons; vertices with p above the level are grey"
LEVEL = "significance level"
GREY = (0.82, 0.82, 0.82)
FULL = 0.99  # quantile of the values at which the colour scale ends


class Maps(Panel):
    """Result of a test at every vertex, grey where it is not significant.

    A click shows the values at a vertex.

    Parameters
    ----------
    study : xarray.DataTree
        The study that was tested.
    result : xarray.Dataset
        Result of :func:`s4a.statistics.group_map` or :func:`s4a.statistics.regression`.
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.

    Raises
    ------
    ValueError
        If the result has no values at the vertices, or belongs to another template.

    See Also
    --------
    s4a.statistics : the tests.

    Examples
    --------
    With a study of six small brains:

    >>> import s4a
    >>> from s4a.widgets import Maps
    >>> study = s4a.synthetic.example_study()
    >>> panel = Maps(study, s4a.statistics.regression(study, range(6), n_permutations=19))
    >>> panel.map.label, panel.where.label
    ('effect, along the normals', 'family-wise')
    >>> panel.close()
    """

    needs = ("registration/position",)
    title = "Map"
    signed, positive = SIGNED_MAPS, POSITIVE_MAPS
    vertex = traitlets.Int(-1)
    live = (("map", "where", "level"),)

    def __init__(self, study: xr.DataTree, result: xr.Dataset, **options: Any):
        self.result, maps = result, self.signed | self.positive
        self.known = [(text, name) for name, text in maps.items() if name in result]
        ready = all(has(study, name) for name in self.needs)
        n = study["registration"].sizes["vertex"] if ready else None
        if ready and (not self.known or result.sizes.get("vertex") != n):
            raise ValueError(
                f"the panel {self.title} needs the maps of a test at the {n} vertices of the "
                f"template; found {', '.join(map(str, result.data_vars)) or 'nothing'} at "
                f"{result.sizes.get('vertex', 'no')} vertices: give the result of a test such as "
                "s4a.statistics.group_map on this study"
            )
        super().__init__(study, **options)

    def build(self) -> list[ipywidgets.Widget]:
        """Return the controls and the view of the surface."""
        result, template = self.result, self.study["registration"].dataset
        tests = [(text, name) for name, text in P_VALUES.items() if name in result]
        self.map = dropdown("map", MAP, self.known, layout=WIDE)
        self.where = dropdown("where", WHERE, [*tests, (EVERYWHERE, EVERYWHERE)], layout=WIDE)
        self.level = dropdown("level", LEVEL, LEVELS)
        self.scene = self.new_scene(420, clickable=True)
        self.T = template["corner_vertex"].values
        self.X = self.surface().values
        self.normals = vertex_normals(self.X, self.T)
        self.area = vertex_areas(self.X, self.T)
        self.scene.show(self.X, self.T)
        self.redraw(self.paint, self.map, self.where, self.level)
        self.on_pick(self.scene, self.pick)
        self.paint()
        return [row(self.map), row(self.where, self.level), self.scene]

    def surface(self) -> xr.DataArray:
        """Return the positions ``(vertex, xyz)`` of the surface that is shown."""
        return self.study["registration"].dataset["position"]

    def values(self) -> tuple[Array, bool, str]:
        """Return the map ``(n,)``, True if it is signed, and its unit."""
        name = self.map.value
        data = self.result[name]
        values = data.values
        if values.ndim == 2:
            values = (values * self.normals).sum(1)
        return values, name in self.signed, unit_of(data)

    def significant(self) -> Array:
        """Return a mask ``(n,)`` of the vertices with p up to the level, or of all vertices."""
        if self.where.value == EVERYWHERE:
            return np.ones(len(self.X), bool)
        return self.result[self.where.value].values <= self.level.value  # False for NaN

    def paint(self) -> None:
        """Colour the surface by the map, grey where it is not significant."""
        values, is_signed, unit = self.values()
        shown = self.significant() & np.isfinite(values)
        limit = float(np.nanquantile(np.abs(values), FULL)) or 1.0
        known = np.nan_to_num(values)
        label = self.map.label if unit == "1" else f"{self.map.label} ({unit})"
        if is_signed:
            colors, bar = signed_colors(known, limit), color_scale(SIGNED, -limit, limit, label)
        else:
            colors, bar = ramp_colors(known, 0, limit), color_scale("viridis", 0, limit, label)
        self.scene.title = self.map.label
        self.scene.paint(np.where(shown[:, None], np.clip(colors, 0, 1), GREY), bar)
        self.scene.mark([])
        self.vertex = -1
        self.scene.caption = self.summary(shown)

    def summary(self, shown: Array) -> str:
        """Return the significant share of the area, and p of the whole shape, as text."""
        parts = []
        if self.where.value != EVERYWHERE:
            share = 100 * self.area[shown].sum() / self.area.sum()
            smallest = np.nanmin(self.result[self.where.value].values)
            parts.append(
                f"{share:.1f} % of the area at p ≤ {self.level.value:g} ({self.where.label}), "
                f"smallest p {smallest:.3g}"
            )
        if "p_value" in self.result:
            parts.append(f"whole shape p = {self.result['p_value'].item():.3g}")
        return "; ".join(parts)

    def pick(self, picked: dict) -> None:
        """Show the value and p values at a clicked vertex."""
        self.vertex = vertex = picked["vertex"]
        values, _, unit = self.values()
        size = f"{values[vertex]:.3g}" + ("" if unit == "1" else f" {unit}")
        p_values = [
            f"p = {self.result[name].values[vertex]:.3g} ({text})"
            for name, text in P_VALUES.items()
            if name in self.result
        ]
        self.scene.mark(self.X[[vertex]])
        self.scene.caption = "; ".join([f"vertex {vertex}: {self.map.label} {size}", *p_values])
