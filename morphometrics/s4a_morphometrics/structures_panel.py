"""Several structures of each subject (6.1): how they lie, their shapes, and both, on sliders."""

import ipywidgets
import numpy as np
import xarray as xr
from matplotlib.colors import to_rgb

from s4a.method.pca import apply_scores
from s4a.schema import unit_of
from s4a.show.browser import color_bytes
from s4a.show.surfaces import mode_arrays, mode_limits, score_state
from s4a.widgets.modes import ModesView
from s4a.widgets.panel import Panel, checkbox, dropdown, row, unbroken_row
from s4a_morphometrics.poses import LEVELS, structures, structures_modes

WORDS = {
    "joint": "poses and shapes",
    "between": "between structures: poses",
    "within": "within structures: shapes",
}
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")
N_MODES = 6


class Structures(Panel):
    """Sliders that move and deform all structures of the mean subject, each in a colour of its own.

    Parameters
    ----------
    study : xarray.DataTree
        Of several structures, see :func:`s4a_morphometrics.analyse_structures`.
    found : xarray.Dataset, optional
        Of :func:`s4a_morphometrics.structures`, which is computed by default.
    level : {"joint", "between", "within"}
        Whose modes are on the sliders first: of poses and shapes, of poses, of shapes.
    n_modes : int
        How many modes of each level, the first, where there are as many.
    view, up
        From where they are seen first; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    views : dict of str to ModesView
        Of every level that varies.
    seen, colors : dict of str to widget
        For each structure whether it is seen, and its colour.
    """

    needs = ("structures",)
    title = "Structures"
    live = (("level",),)
    python = ("hiding structures, and their colours",)

    def build(
        self,
        found: xr.Dataset | None = None,
        level: str = "joint",
        n_modes: int = N_MODES,
    ) -> list:
        """A list of levels, a box and a colour for each structure, and the sliders."""
        self.found = structures(self.study) if found is None else found
        variance = self.found["level_variance"].sum("structure").to_series()
        varying = [one for one in LEVELS if one == "joint" or variance[one] > 0]
        names = self.found["structure"].values.tolist()
        self.seen = {name: checkbox(name, f"whether {name} is seen", on=True) for name in names}
        self.colors = {
            name: ipywidgets.ColorPicker(
                value=COLORS[k % len(COLORS)],
                concise=True,
                tooltip=f"the colour of {name}",
                layout={"width": "auto"},
            )
            for k, name in enumerate(names)
        }
        self.views = {one: self.view_of(one, n_modes) for one in varying}
        share = 100 * variance / variance.sum()
        options = [
            (WORDS[one] + ("" if one == "joint" else f", {share[one]:.0f} % of the variance"), one)
            for one in varying
        ]
        self.level = dropdown(
            "modes", "what the sliders change", options, value=level, layout={"width": "32em"}
        )
        self.on_change(self.level, self.show_level)
        self.redraw(self.show_structures, *self.seen.values())
        self.redraw(self.paint, *self.colors.values())
        self.show_level(level)
        self.paint()
        pairs = [unbroken_row(self.seen[name], self.colors[name]) for name in names]
        return [row(self.level, *pairs), *self.views.values()]

    def view_of(self, level: str, n_modes: int) -> ModesView:
        """The sliders of a level."""
        study = structures_modes(self.study, self.found, level)
        mean, triangles, deformation = mode_arrays(study, None, n_modes)
        return ModesView(
            mean,
            triangles,
            deformation,
            limits=mode_limits(study),
            unit=unit_of(self.found["position"]),
            **score_state(study, n_modes),
            **self.camera,
            colors="own",
        )

    def show_level(self, level: str) -> None:
        """Show the sliders of a level, and no others."""
        for one, view in self.views.items():
            view.layout.display = None if one == level else "none"

    def visible(self) -> np.ndarray:
        """The triangles ``(m, 3)`` of the structures that are seen."""
        triangles = self.found["corner_vertex"].values
        of = self.found["structure_of_vertex"].values[triangles[:, 0]]
        seen = np.array([box.value for box in self.seen.values()])
        return triangles[seen[of]]

    def show_structures(self) -> None:
        """Draw the structures that are seen, on all levels."""
        triangles = self.visible()
        if not len(triangles):
            raise ValueError("tick at least one structure")
        for view in self.views.values():
            view.change_triangles(triangles)

    def paint(self) -> None:
        """Give each structure its colour."""
        colors = np.array([to_rgb(picker.value) for picker in self.colors.values()])
        own = color_bytes(colors[self.found["structure_of_vertex"].values])
        for view in self.views.values():
            view.own = own
            view.draw_still()

    @property
    def scores(self) -> list[float]:
        """Of the level that is shown, in standard deviations, one for each mode."""
        return self.views[self.level.value].scores

    @scores.setter
    def scores(self, scores: list[float]) -> None:
        self.views[self.level.value].scores = list(scores)

    def vertices(self) -> np.ndarray:
        """Vertices ``(n, 3)`` of all structures as the sliders stand, in the unit of the input."""
        mean, _, deformation = self.views[self.level.value].arrays
        return apply_scores(mean, deformation, np.array(self.scores))
