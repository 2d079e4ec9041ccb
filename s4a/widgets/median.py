"""The median shape (3.5, 3.6, eq. 5): every shape ranked by its distance to the limit shape."""

import ipywidgets
import numpy as np
import traitlets

from s4a.method.median import NORMS, distance_to_identity, near_ties
from s4a.show.browser import PARTS
from s4a.show.surfaces import labelled, names_of, resolutions, surface
from s4a.widgets.panel import Panel, columns, dropdown, int_slider, row
from s4a.widgets.views import Chart

OPERATOR = (
    "which shape difference is compared with the identity: of areas, or of angles (conformal)"
)
NORM = (
    "how modes count in the distance to the identity (eq. 5): h2 and h1 damp fine ones, frobenius "
    "none; h2_image and h2_both also weigh the image"
)
MODES = "how many latent functions the shape differences are cut to"
OPERATORS = {"area": "area_difference", "conformal": "conformal_difference"}


class Median(Panel):
    """Ranked distances; a bar that is clicked shows its shape over the median.

    Attributes
    ----------
    selected : str
        The shape that is shown.
    """

    needs = ("latent/area_difference", "latent/latent_eigenvalue")
    title = "Median shape"
    selected = traitlets.Unicode("")
    live = (("operator", "norm", "modes", "shape"),)
    clicks = (("bars", "name", "shape"),)
    shares = ("selected",)

    def build(self) -> list[ipywidgets.Widget]:
        """Choices, bars and the surface."""
        latent = self.study["latent"].dataset
        self.names, n_modes = names_of(latent), latent.sizes["latent"]
        norm, options = str(latent.attrs.get("norm", "h2")), labelled(self.study, self.names)
        self.operator = self.redrawing(dropdown("operator", OPERATOR, list(OPERATORS)), self.rank)
        self.norm = self.redrawing(dropdown("norm", NORM, list(NORMS), value=norm), self.rank)
        self.modes = self.redrawing(int_slider("modes K", MODES, n_modes, 2, n_modes), self.rank)
        stages = dropdown("surfaces", "which meshes are drawn", resolutions(self.study))
        self.stage = self.redrawing(stages, self.show)
        self.shape = dropdown("shape", "what is shown beside the bars", options)
        self.bars, self.ties = Chart(), ipywidgets.HTML()
        self.scene = self.new_scene(420)
        self.on_pick(self.bars, self.pick)
        self.bind(self.shape, "selected")
        self.redraw(self.show, "selected")
        self.rank()
        self.selected = self.median
        return [
            row(self.operator, self.norm, self.modes),
            row(self.shape, self.stage),
            self.ties,
            columns(self.bars, self.scene),
        ]

    def selection(self) -> dict:
        """The shape that is shown."""
        return {"shape": self.selected}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show a shape that is ranked."""
        if shape in self.names:
            self.selected = shape

    def rank(self) -> None:
        """Distances for the operator, norm and number of modes that are chosen."""
        latent, k = self.study["latent"].dataset, self.modes.value
        D = latent[OPERATORS[self.operator.value]].values[:, :k, :k]
        eigenvalues = latent["latent_eigenvalue"].values[:k]
        self.distance = distance_to_identity(D, eigenvalues, self.norm.value)
        self.order = np.argsort(self.distance, kind="stable")
        near = [self.names[i] for i in near_ties(self.distance)][1:]
        others = f"Near ties, at most 5 % farther: {', '.join(near)}."
        self.median, least = self.names[self.order[0]], f"{self.distance.min():.4g}"
        others = others if near else "No other within 5 %."
        self.ties.value = PARTS.median(self.median, least, others)
        self.draw_bars()
        if self.selected:
            self.show()

    def draw_bars(self) -> None:
        """The bars, nearest first; the median is orange, the selected one outlined."""
        names = [self.names[i] for i in self.order]
        self.bars.draw(
            "bars",
            names=names,
            values=self.distance[self.order],
            marked=[0],
            selected=names.index(self.selected) if self.selected in names else -1,
            label="distance to the limit shape",
            title="Click a bar to see the shape",
        )

    def pick(self, mark: dict) -> None:
        """The bar that was clicked."""
        self.selected = self.names[self.order[mark["index"]]]

    def show(self) -> None:
        """The selected shape, with the median shining through around it."""
        name = self.selected
        self.draw_bars()
        i = self.names.index(name)
        rank = int(np.flatnonzero(self.order == i)[0]) + 1
        caption = f"rank {rank} of {len(self.names)}, distance {self.distance[i]:.4g}"
        title, ghost, stage = f"{name}, the median", (), self.stage.value
        if name != self.median:
            title = f"{name}, in {self.median}"
            caption += "; blue, shining through: the median"
            ghost = surface(self.study, self.median, stage)
        self.scene.show(*surface(self.study, name, stage), title=title)
        self.scene.overlay(*ghost)
        self.scene.caption = caption
