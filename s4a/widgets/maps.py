"""Maps of a test on the surface (6.1): effects at every vertex, and where they are significant."""

from typing import Any

import ipywidgets
import numpy as np
import traitlets
import xarray as xr

from s4a.geometry.mesh import vertex_areas, vertex_normals
from s4a.schema import unit_of
from s4a.show.browser import color_scale
from s4a.show.draw import SIGNED, ramp_colors, signed_colors
from s4a.show.surfaces import has
from s4a.widgets.panel import WIDE, Panel, dropdown, row

# variable -> what it is called; those of vectors are shown along the normals
SIGNED_MAPS = {
    "effect": "effect, along the normals",
    "field_effect": "effect on the field",
}
POSITIVE_MAPS = {
    "effect_size": "effect size",
    "explained_share": "explained share",
}
EVERYWHERE = "everywhere"
P_VALUES = {
    "p_family_wise": "family-wise",
    "p_false_discovery": "false discovery rate",
    "p_vertex": "each vertex alone",
}
LEVELS = [0.05, 0.01, 0.001]
MAP = "what the colours are; arrows of an effect count as far as they point outwards"
WHERE = "grey where the p value is larger than the level, by which correction for all vertices"
LEVEL = "the p value from which on it is grey"
GREY = (0.82, 0.82, 0.82)
FULL = 0.99  # quantile of the values that the colours reach


class Maps(Panel):
    """What a test found at every vertex, grey where it is not significant.

    A click tells the values there.

    Parameters
    ----------
    study : xarray.DataTree
        That was tested.
    found : xarray.Dataset
        Of :func:`s4a.statistics.group_map` or :func:`s4a.statistics.regression`.
    view, up
        From where the surface is seen first; see :func:`s4a.show.draw.rotation`.

    Raises
    ------
    ValueError
        When the result has no map, or is of another template.

    Examples
    --------
    With the ``study`` of six small brains:

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

    def __init__(self, study: xr.DataTree, found: xr.Dataset, **options: Any):
        self.found, maps = found, self.signed | self.positive
        self.known = [(words, name) for name, words in maps.items() if name in found]
        ready = all(has(study, name) for name in self.needs)
        n = study["registration"].sizes["vertex"] if ready else None
        if ready and (not self.known or found.sizes.get("vertex") != n):
            raise ValueError(
                f"the panel {self.title} needs the maps of a test at the {n} vertices of the "
                f"template; found {', '.join(map(str, found.data_vars)) or 'nothing'} at "
                f"{found.sizes.get('vertex', 'no')}: give what a test such as "
                "statistics.group_map found on this study"
            )
        super().__init__(study, **options)

    def build(self) -> list[ipywidgets.Widget]:
        """Choices and the surface."""
        found, template = self.found, self.study["registration"].dataset
        tests = [(words, name) for name, words in P_VALUES.items() if name in found]
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
        """The positions ``(vertex, xyz)`` of the surface that is shown."""
        return self.study["registration"].dataset["position"]

    def values(self) -> tuple[np.ndarray, bool, str]:
        """The map ``(n,)``, whether it has signs, and its unit."""
        name = self.map.value
        data = self.found[name]
        values = data.values
        if values.ndim == 2:
            values = (values * self.normals).sum(1)
        return values, name in self.signed, unit_of(data)

    def significant(self) -> np.ndarray:
        """Where the p value is at most the level ``(n,)``; everywhere where none is asked for."""
        if self.where.value == EVERYWHERE:
            return np.ones(len(self.X), bool)
        return self.found[self.where.value].values <= self.level.value  # NaN is not

    def paint(self) -> None:
        """The map in colours, grey where it is not significant, and how much of it is."""
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

    def summary(self, shown: np.ndarray) -> str:
        """How much of the area is significant, and p of the whole shape."""
        words = []
        if self.where.value != EVERYWHERE:
            share = 100 * self.area[shown].sum() / self.area.sum()
            least = np.nanmin(self.found[self.where.value].values)
            words.append(
                f"{share:.1f} % of the area at p ≤ {self.level.value:g} ({self.where.label}), "
                f"smallest {least:.3g}"
            )
        if "p_value" in self.found:
            words.append(f"whole shape p = {self.found['p_value'].item():.3g}")
        return "; ".join(words)

    def pick(self, place: dict) -> None:
        """A vertex that was clicked: its value and p values."""
        self.vertex = vertex = place["vertex"]
        values, _, unit = self.values()
        size = f"{values[vertex]:.3g}" + ("" if unit == "1" else f" {unit}")
        said = [
            f"p = {self.found[name].values[vertex]:.3g} ({words})"
            for name, words in P_VALUES.items()
            if name in self.found
        ]
        self.scene.mark(self.X[[vertex]])
        self.scene.caption = "; ".join([f"vertex {vertex}: {self.map.label} {size}", *said])
