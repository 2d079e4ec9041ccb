"""Panel of multi-structure studies (6.1): modes of relative poses, of shapes, and of both."""

import ipywidgets
import numpy as np
import xarray as xr
from matplotlib.colors import to_rgb

from s4a.method.pca import apply_scores
from s4a.schema import unit_of
from s4a.show.browser import color_bytes
from s4a.show.surfaces import mode_arrays, mode_limits, score_state
from s4a.widgets.modes import ModesView
from s4a.widgets.panel import Panel, checkbox, dropdown, row
from s4a_morphometrics.poses import LEVELS, structures, structures_modes

LABELS = {
    "joint": "poses and shapes",
    "between": "between structures: poses",
    "within": "within structures: shapes",
}
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")
N_MODES = 6


def unbroken_row(*widgets: ipywidgets.Widget) -> ipywidgets.HBox:
    """Return a row of widgets that does not wrap."""
    layout = {"align_items": "center", "flex": "none", "margin": "0 1em 0 0"}
    return ipywidgets.HBox(widgets, layout=layout)


class Structures(Panel):
    """Sliders that move and deform all structures of the mean subject, coloured by structure.

    Parameters
    ----------
    study : xarray.DataTree
        From :func:`s4a_morphometrics.analyse_structures`.
    result : xarray.Dataset, optional
        From :func:`s4a_morphometrics.structures`; computed by default.
    level : {"joint", "between", "within"}
        Initial level of the sliders: poses and shapes, poses, or shapes.
    n_modes : int
        Largest number of modes of each level.
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    views : dict of str to ModesView
        One for each level that varies.
    visible, colors : dict of str to widget
        Checkbox and colour of each structure.
    """

    needs = ("structures",)
    title = "Structures"
    live = (("level",),)
    python = ("hiding structures, and their colours",)

    def build(
        self,
        result: xr.Dataset | None = None,
        level: str = "joint",
        n_modes: int = N_MODES,
    ) -> list:
        """Return the controls of levels and structures, and the sliders."""
        self.result = structures(self.study) if result is None else result
        variance = self.result["level_variance"].sum("structure").to_series()
        varying = [level for level in LEVELS if level == "joint" or variance[level] > 0]
        names = self.result["structure"].values.tolist()
        self.visible = {name: checkbox(name, f"show {name}", on=True) for name in names}
        self.colors = {
            name: ipywidgets.ColorPicker(
                value=COLORS[k % len(COLORS)],
                concise=True,
                tooltip=f"colour of {name}",
                layout={"width": "auto"},
            )
            for k, name in enumerate(names)
        }
        self.views = {name: self.view_of(name, n_modes) for name in varying}
        share = 100 * variance / variance.sum()
        options = [
            (LABELS[k] + ("" if k == "joint" else f", {share[k]:.0f} % of the variance"), k)
            for k in varying
        ]
        self.level = dropdown(
            "modes",
            "variation that the sliders show",
            options,
            value=level,
            layout={"width": "32em"},
        )
        self.on_change(self.level, self.show_level)
        self.redraw(self.show_structures, *self.visible.values())
        self.redraw(self.paint, *self.colors.values())
        self.show_level(level)
        self.paint()
        pairs = [unbroken_row(self.visible[name], self.colors[name]) for name in names]
        return [row(self.level, *pairs), *self.views.values()]

    def view_of(self, level: str, n_modes: int) -> ModesView:
        """Return the sliders of a level."""
        study = structures_modes(self.study, self.result, level)
        mean, triangles, deformation = mode_arrays(study, None, n_modes)
        return ModesView(
            mean,
            triangles,
            deformation,
            limits=mode_limits(study),
            unit=unit_of(self.result["position"]),
            **score_state(study, n_modes),
            **self.camera,
            colors="own",
        )

    def show_level(self, level: str) -> None:
        """Show the sliders of one level."""
        for name, view in self.views.items():
            view.layout.display = None if name == level else "none"

    def visible_triangles(self) -> np.ndarray:
        """Return the triangles ``(m, 3)`` of the visible structures."""
        triangles = self.result["corner_vertex"].values
        structure = self.result["structure_of_vertex"].values[triangles[:, 0]]
        visible = np.array([box.value for box in self.visible.values()])
        return triangles[visible[structure]]

    def show_structures(self) -> None:
        """Draw the visible structures, on all levels."""
        triangles = self.visible_triangles()
        if not len(triangles):
            raise ValueError("tick at least one structure")
        for view in self.views.values():
            view.change_triangles(triangles)

    def paint(self) -> None:
        """Colour each structure."""
        colors = np.array([to_rgb(picker.value) for picker in self.colors.values()])
        rgb = color_bytes(colors[self.result["structure_of_vertex"].values])
        for view in self.views.values():
            view.own = rgb
            view.draw_still()

    @property
    def scores(self) -> list[float]:
        """Scores of the displayed level, in standard deviations, one for each mode."""
        return self.views[self.level.value].scores

    @scores.setter
    def scores(self, scores: list[float]) -> None:
        self.views[self.level.value].scores = list(scores)

    def vertices(self) -> np.ndarray:
        """Return the displayed vertices ``(n, 3)`` of all structures, in the unit of the input."""
        mean, _, deformation = self.views[self.level.value].arrays
        return apply_scores(mean, deformation, np.array(self.scores))
