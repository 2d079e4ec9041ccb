"""The median shape (3.5, 3.6, eq. 5): all shapes ranked by their distance to the limit shape."""

import ipywidgets
import numpy as np
import traitlets

from s4a.method.median import NORMS, distance_to_identity, near_ties
from s4a.show.browser import PARTS
from s4a.show.surfaces import RESOLUTIONS, has, labelled, names_of, surface
from s4a.widgets.panel import Panel, columns, dropdown, int_slider, row
from s4a.widgets.views import Chart

OPERATOR = (
    "the shape difference operator that is compared with the identity: area-based or conformal"
)
NORM = (
    "weights of the eigenfunctions in eq. 5: h2 and h1 damp high frequencies, frobenius does not; "
    "h2_image and h2_both also weight the image"
)
EIGENFUNCTIONS = "number of latent eigenfunctions in the shape differences"
OPERATORS = {"area": "area_difference", "conformal": "conformal_difference"}


class Median(Panel):
    """Shapes ranked by their distance to the limit shape; the median is the nearest (eq. 5).

    A click on a bar shows its shape with the median as a translucent surface.

    Attributes
    ----------
    selected : str
        The shape that is shown.

    See Also
    --------
    s4a.widgets.Network : the maps that the shape differences come from.
    """

    needs = ("latent/area_difference", "latent/latent_eigenvalue")
    title = "Median shape"
    selected = traitlets.Unicode("")
    live = (("operator", "norm", "size", "shape"),)
    clicks = (("bars", "name", "shape"),)
    shares = ("selected",)

    def build(self) -> list[ipywidgets.Widget]:
        """Return the controls, the bars and the view of the surface."""
        latent = self.study["latent"].dataset
        self.names, k = names_of(latent), latent.sizes["latent"]
        norm, options = str(latent.attrs.get("norm", "h2")), labelled(self.study, self.names)
        self.operator = dropdown("operator", OPERATOR, list(OPERATORS))
        self.norm = dropdown("norm", NORM, list(NORMS), value=norm)
        self.size = int_slider("eigenfunctions K", EIGENFUNCTIONS, k, 2, k)
        resolutions = [(text, stage) for text, stage in RESOLUTIONS if has(self.study, stage)]
        self.stage = dropdown("surfaces", "the resolution of the meshes", resolutions)
        self.shape = dropdown("shape", "the shape that is shown", options)
        self.bars, self.ties = Chart(), ipywidgets.HTML()
        self.scene = self.new_scene(420)
        self.on_pick(self.bars, self.pick)
        self.bind(self.shape, "selected")
        self.redraw(self.rank, self.operator, self.norm, self.size)
        self.redraw(self.show, "selected", self.stage)
        self.rank()
        self.selected = self.median
        return [
            row(self.operator, self.norm, self.size),
            row(self.shape, self.stage),
            self.ties,
            columns(self.bars, self.scene),
        ]

    def rank(self) -> None:
        """Compute the distances for the selected operator, norm and number of eigenfunctions."""
        latent, k = self.study["latent"].dataset, self.size.value
        D = latent[OPERATORS[self.operator.value]].values[:, :k, :k]
        eigenvalues = latent["latent_eigenvalue"].values[:k]
        self.distance = distance_to_identity(D, eigenvalues, self.norm.value)
        self.order = np.argsort(self.distance, kind="stable")
        near = [self.names[i] for i in near_ties(self.distance)][1:]
        ties = f"Near ties, at most 5 % larger: {', '.join(near)}." if near else "No near ties."
        self.median, distance = self.names[self.order[0]], f"{self.distance.min():.4g}"
        self.ties.value = PARTS.median(self.median, distance, ties)
        self.draw_bars()
        if self.selected:
            self.show()

    def draw_bars(self) -> None:
        """Draw the bars, nearest first; the median is orange, the selected shape outlined."""
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
        """Select the shape of the clicked bar."""
        self.selected = self.names[self.order[mark["index"]]]

    def show(self) -> None:
        """Show the selected shape with the median as a translucent surface."""
        name = self.selected
        self.draw_bars()
        i = self.names.index(name)
        rank = int(np.flatnonzero(self.order == i)[0]) + 1
        caption = f"rank {rank} of {len(self.names)}, distance {self.distance[i]:.4g}"
        title, ghost, stage = f"{name}, the median", (), self.stage.value
        if name != self.median:
            title = f"{name}, in {self.median}"
            caption += "; translucent blue: the median"
            ghost = surface(self.study, self.median, stage)
        self.scene.show(*surface(self.study, name, stage), title=title)
        self.scene.overlay(*ghost)
        self.scene.caption = caption
