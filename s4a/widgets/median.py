"""The median shape (3.5, 3.6, eq. 5): every shape ranked by its distance to the limit shape."""

from html import escape

import ipywidgets
import numpy as np
import traitlets

from s4a.method.median import NORMS, distance_to_identity, near_ties
from s4a.show.pictures import names_of
from s4a.widgets.chart import chart
from s4a.widgets.meshes import available, camera_group, surface
from s4a.widgets.panel import Panel, beside, paragraph, row
from s4a.widgets.scene import scene

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

    def build(self, view="corner", up="z"):
        """Choices, bars and the surface."""
        latent = self.study["latent"].dataset
        self.names, modes = names_of(latent), latent.sizes["latent"]
        self.operator = ipywidgets.Dropdown(options=list(OPERATORS), description="operator")
        norm = str(latent.attrs.get("norm", "h2"))
        self.norm = ipywidgets.Dropdown(options=list(NORMS), value=norm, description="norm")
        self.modes = ipywidgets.IntSlider(
            modes,
            min=2,
            max=modes,
            description="modes K",
            continuous_update=False,
            layout={"width": "330px"},
        )
        self.stage = ipywidgets.Dropdown(options=available(self.study), description="surfaces")
        self.shape = ipywidgets.Dropdown(options=self.names, description="shape")
        self.bars, self.scene = chart(), scene(group=camera_group(), view=view, up=up, height=420)
        self.ties = ipywidgets.HTML()
        for choice in (self.operator, self.norm, self.modes):
            self.on_change(choice, lambda _: self.rank())
        self.on_change(self.stage, lambda _: self.show())
        self.on_change(
            self.bars, lambda mark: self.select(self.names[self.order[mark["index"]]]), "picked"
        )
        self.on_change(self.shape, self.select)
        self.on_change(self, lambda _: self.show(), "selected")
        self.rank()
        self.selected = self.median
        return [
            row(self.operator, self.norm, self.modes),
            row(self.shape, self.stage),
            self.ties,
            beside(self.bars, self.scene),
        ]

    def rank(self):
        """Distances for the operator, norm and number of modes that are chosen."""
        latent, k = self.study["latent"].dataset, self.modes.value
        D = latent[OPERATORS[self.operator.value]].values[:, :k, :k]
        self.distance = distance_to_identity(
            D, latent["latent_eigenvalue"].values[:k], self.norm.value
        )
        self.order = np.argsort(self.distance, kind="stable")
        self.median = self.names[self.order[0]]
        near = [self.names[i] for i in near_ties(self.distance)]
        others = (
            f"Near ties, at most 5 % farther: {', '.join(near[1:])}."
            if near[1:]
            else "No other within 5 %."
        )
        least = f"<b>The median is {escape(self.median)}</b>, at {self.distance.min():.4g}."
        self.ties.value = paragraph(f"{least} {escape(others)}")
        self.draw_bars()
        if self.selected:
            self.show()

    def draw_bars(self):
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

    def select(self, name):
        """Show a shape."""
        self.selected = name

    def show(self):
        """The selected shape, with the median shining through around it."""
        self.shape.value = self.selected
        self.draw_bars()
        text = (
            f"{self.selected}, the median"
            if self.selected == self.median
            else f"{self.selected}, in {self.median}"
        )
        self.scene.show(*surface(self.study, self.selected, self.stage.value), title=text)
        same = self.selected == self.median
        self.scene.over(*(() if same else surface(self.study, self.median, self.stage.value)))
        place = self.names.index(self.selected)
        rank = int(np.flatnonzero(self.order == place)[0]) + 1
        self.scene.caption = (
            f"rank {rank} of {len(self.names)}, distance {self.distance[place]:.4g}"
            + ("" if same else "; blue, shining through: the median")
        )
