"""Spectra (3.3): eigenvalues of all shapes, eigenfunctions, what a few of them say of a shape."""

from typing import Any

import ipywidgets
import numpy as np
import traitlets

from s4a.method.spectral import reconstruct, weyl
from s4a.show.charts import BLUE, GREY, ORANGE
from s4a.show.surfaces import labelled, low_text, surface, unit_text
from s4a.widgets.panel import Panel, columns, dropdown, int_slider, row
from s4a.widgets.views import Chart

MOST = 100  # curves in a chart
FIRST = "how many eigenfunctions the surface is put together from"


class Spectrum(Panel):
    """Eigenvalues with Weyl's line, an eigenfunction, the surface from its first k coefficients.

    Of more than a hundred shapes the curves are those of every second, third and so on, and of the
    one that is chosen.

    Attributes
    ----------
    shape : str
    """

    needs = ("coarse",)
    title = "Spectrum"
    shape = traitlets.Unicode("")
    live = (("mode", "choice"), ("k", "choice"))
    every = ("mode",)
    clicks = (("curves", "series", "choice"), ("gaps", "series", "choice"))
    shares = ("shape",)

    def build(self) -> list[ipywidgets.Widget]:
        """Choices, curves and two surfaces."""
        nodes = self.study["coarse"].children.items()
        self.eigenvalues: dict[str, Any] = {
            name: node["eigenvalue"].values for name, node in nodes if "eigenvalue" in node
        }
        self.names = list(self.eigenvalues)
        k = min(len(values) for values in self.eigenvalues.values())
        options, which = labelled(self.study, self.names), "which eigenfunction is shown"
        self.choice = dropdown("shape", "whose functions are shown", options)
        self.mode = int_slider("mode", which, 1, 0, k - 1, continuous_update=True)
        self.k = int_slider("first k", FIRST, min(20, k), 1, k)
        self.curves, self.gaps = Chart(), Chart()
        self.function, self.rebuilt = self.new_scene(300), self.new_scene(300)
        self.bind(self.choice, "shape")
        for chart in (self.curves, self.gaps):
            self.on_pick(chart, self.pick)
        self.redraw(self.show_mode, self.mode)
        self.redraw(self.show_rebuilt, self.k)
        self.redraw(self.take, "shape")
        self.shape = self.names[0]
        modes = ipywidgets.VBox([self.mode, self.function])
        rebuilt = ipywidgets.VBox([self.k, self.rebuilt])
        return [row(self.choice), columns(self.curves, self.gaps), columns(modes, rebuilt)]

    def selection(self) -> dict:
        """The shape whose functions are shown."""
        return {"shape": self.shape}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show the functions of a shape that has any."""
        if shape in self.names:
            self.shape = shape

    def pick(self, mark: dict) -> None:
        """The curve that was clicked."""
        if mark["series"] in self.names:
            self.shape = mark["series"]

    def take(self) -> None:
        """Another shape."""
        self.mesh = self.study["coarse"][self.shape].to_dataset()
        self.surface = surface(self.study, self.shape)
        self.function.show(*self.surface)
        self.function.caption = low_text(self.mesh)
        self.show_mode()
        self.show_rebuilt()

    def draw(self) -> None:
        """The eigenvalues of all shapes, as they are and as they differ from Weyl's law."""
        law = weyl(max(map(len, self.eigenvalues.values())))
        look = {"name": "Weyl: 4 π k", "x": np.arange(len(law)), "color": GREY, "dash": "6 4"}
        look |= dict.fromkeys(("wide", "legend", "reference"), True)
        some = self.names[:: -(-len(self.names) // MOST)]  # of equal distances in the list
        some = some if self.shape in some else [*some, self.shape]
        part = "" if len(some) == len(self.names) else f" ({len(some)} of {len(self.names):,})"
        first = f"Eigenvalues: click a curve{part}", "eigenvalue, unit area", "bottom"
        second = "The same, less Weyl's law", "eigenvalue − 4 π k", "left"
        for chart, less, words in ((self.curves, 0 * law, first), (self.gaps, law, second)):
            title, ylabel, legend = words
            chart.draw(
                "lines",
                series=[look | {"y": law - less}, *(self.curve(name, less) for name in some)],
                title=title,
                ylabel=ylabel,
                legend=legend,
                xlabel="mode k",
                marker=self.mode.value,
            )

    def curve(self, name: str, law: np.ndarray) -> dict:
        """The curve of a shape's eigenvalues less `law`."""
        values, chosen = self.eigenvalues[name], name == self.shape
        last = f"number {len(values) - 1} is {values[-1]:.1f}"
        return {
            "name": name,
            "x": np.arange(len(values)),
            "y": values - law[: len(values)],
            "text": f"{name}: the second eigenvalue is {values[1]:.2f}, {last}",
            "color": ORANGE if chosen else BLUE,
            "wide": chosen,
            "legend": chosen,
        }

    def show_mode(self) -> None:
        """One eigenfunction as colours."""
        mode = self.mode.value
        eigenvalue = self.eigenvalues[self.shape][mode]
        self.function.title = f"φ{mode} of {self.shape}, eigenvalue {eigenvalue:.2f}"
        self.function.paint_function(self.mesh["eigenfunction"].values[:, mode], "eigenfunction")
        self.draw()

    def show_rebuilt(self) -> None:
        """The surface from the first k coefficients of its positions."""
        X, T = self.surface
        k = self.k.value
        rebuilt = reconstruct(self.mesh, X, k=k)
        gap = np.linalg.norm(rebuilt - X, axis=1).mean()
        title = f"from {k} of {len(self.eigenvalues[self.shape])} eigenfunctions"
        self.rebuilt.show(rebuilt, T, title=title)
        unit = unit_text(self.study, self.shape)
        self.rebuilt.caption = f"mean distance to the surface {gap:.3g} ({unit})"
