"""Spectra (3.3): eigenvalues of all shapes, eigenfunctions, reconstruction from a few of them."""

from typing import Any

import ipywidgets
import numpy as np
import traitlets

from s4a.method.spectral import reconstruct, weyl
from s4a.schema import Array
from s4a.show.charts import BLUE, GREY, ORANGE
from s4a.show.surfaces import labelled, low_text, surface, unit_text
from s4a.widgets.panel import Panel, columns, dropdown, int_slider, row
from s4a.widgets.views import Chart

MOST = 100  # curves in a chart
FIRST = "number of eigenfunctions from which the surface is reconstructed"


class Spectrum(Panel):
    """Eigenvalues with Weyl's law, an eigenfunction, the surface from its first k coefficients.

    For more than a hundred shapes, only some curves are drawn, and that of the selected shape.

    Attributes
    ----------
    shape : str
        The selected shape.

    See Also
    --------
    s4a.widgets.FunctionalMap : maps between the eigenfunctions of two shapes.

    References
    ----------
    M. Reuter et al. (2006), Laplace-Beltrami spectra as 'Shape-DNA' of surfaces and solids,
    Computer-Aided Design 38(4).
    """

    needs = ("coarse",)
    title = "Spectrum"
    shape = traitlets.Unicode("")
    live = (("index", "choice"), ("k", "choice"))
    every = ("index",)
    clicks = (("curves", "series", "choice"), ("residuals", "series", "choice"))
    shares = ("shape",)

    def build(self) -> list[ipywidgets.Widget]:
        """Return the controls, the curves and the views of two surfaces."""
        nodes = self.study["coarse"].children.items()
        self.eigenvalues: dict[str, Any] = {
            name: node["eigenvalue"].values for name, node in nodes if "eigenvalue" in node
        }
        self.names = list(self.eigenvalues)
        k = min(len(values) for values in self.eigenvalues.values())
        options, tooltip = labelled(self.study, self.names), "index of the displayed eigenfunction"
        self.choice = dropdown("shape", "the shape whose functions are shown", options)
        self.index = int_slider("eigenfunction", tooltip, 1, 0, k - 1, continuous_update=True)
        self.k = int_slider("first k", FIRST, min(20, k), 1, k)
        self.curves, self.residuals = Chart(), Chart()
        self.function, self.reconstruction = self.new_scene(300), self.new_scene(300)
        self.bind(self.choice, "shape")
        for chart in (self.curves, self.residuals):
            self.on_pick(chart, self.pick)
        self.redraw(self.show_eigenfunction, self.index)
        self.redraw(self.show_reconstruction, self.k)
        self.redraw(self.show_shape, "shape")
        self.shape = self.names[0]
        function = ipywidgets.VBox([self.index, self.function])
        surface_of_k = ipywidgets.VBox([self.k, self.reconstruction])
        charts = columns(self.curves, self.residuals)
        return [row(self.choice), charts, columns(function, surface_of_k)]

    def pick(self, mark: dict) -> None:
        """Select the shape of the clicked curve."""
        if mark["series"] in self.names:
            self.shape = mark["series"]

    def show_shape(self) -> None:
        """Show the selected shape."""
        self.mesh = self.study["coarse"][self.shape].to_dataset()
        self.surface = surface(self.study, self.shape)
        self.function.show(*self.surface)
        self.function.caption = low_text(self.mesh)
        self.show_eigenfunction()
        self.show_reconstruction()

    def draw(self) -> None:
        """Draw the eigenvalues of all shapes, and their difference from Weyl's law."""
        law = weyl(max(map(len, self.eigenvalues.values())))
        style = {"name": "Weyl: 4 π k", "x": np.arange(len(law)), "color": GREY, "dash": "6 4"}
        style |= dict.fromkeys(("wide", "legend", "reference"), True)
        drawn = self.names[:: -(-len(self.names) // MOST)]
        drawn = drawn if self.shape in drawn else [*drawn, self.shape]
        part = "" if len(drawn) == len(self.names) else f" ({len(drawn)} of {len(self.names):,})"
        first = f"Eigenvalues: click a curve{part}", "eigenvalue, unit area", "bottom"
        second = "Difference from Weyl's law", "eigenvalue − 4 π k", "left"
        for chart, less, texts in ((self.curves, 0 * law, first), (self.residuals, law, second)):
            title, ylabel, legend = texts
            chart.draw(
                "lines",
                series=[style | {"y": law - less}, *(self.curve(name, less) for name in drawn)],
                title=title,
                ylabel=ylabel,
                legend=legend,
                xlabel="eigenfunction k",
                marker=self.index.value,
            )

    def curve(self, name: str, law: Array) -> dict:
        """Return the curve of a shape's eigenvalues minus `law`."""
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

    def show_eigenfunction(self) -> None:
        """Show an eigenfunction as colours."""
        i = self.index.value
        eigenvalue = self.eigenvalues[self.shape][i]
        self.function.title = f"φ{i} of {self.shape}, eigenvalue {eigenvalue:.2f}"
        self.function.paint_function(self.mesh["eigenfunction"].values[:, i], "eigenfunction")
        self.draw()

    def show_reconstruction(self) -> None:
        """Show the surface from the first k coefficients of its positions."""
        X, T = self.surface
        k = self.k.value
        Y = reconstruct(self.mesh, X, k=k)
        distance = np.linalg.norm(Y - X, axis=1).mean()
        title = f"from {k} of {len(self.eigenvalues[self.shape])} eigenfunctions"
        self.reconstruction.show(Y, T, title=title)
        unit = unit_text(self.study, self.shape)
        self.reconstruction.caption = f"mean distance to the surface {distance:.3g} ({unit})"
