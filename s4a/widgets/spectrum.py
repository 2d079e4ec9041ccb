"""Spectra (3.3): the eigenvalues of all shapes, their eigenfunctions.

And what a few of them can say of a shape.
"""

import ipywidgets
import numpy as np
import traitlets

from s4a.method.spectral import reconstruct, weyl
from s4a.show.draw import SIGNED, signed_colors
from s4a.show.live import color_bar
from s4a.widgets.chart import chart
from s4a.widgets.meshes import camera_group, surface, unit_of
from s4a.widgets.panel import Panel, beside, row
from s4a.widgets.scene import scene

TITLES = ("Eigenvalues: click a curve", "The same, less Weyl's law")


class Spectrum(Panel):
    """Eigenvalues with Weyl's line; one eigenfunction on the surface.

    The surface from its first k coefficients.

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

    def build(self, view="corner", up="z"):
        """Choices, curves and two surfaces."""
        self.names = [
            name
            for name, node in self.study["coarse"].children.items()
            if "eigenvalue" in node.data_vars
        ]
        self.values = [self.study["coarse"][name]["eigenvalue"].values for name in self.names]
        k = min(len(values) for values in self.values)
        self.choice = ipywidgets.Dropdown(options=self.names, description="shape")
        wide = {"width": "340px"}
        self.mode = ipywidgets.IntSlider(1, min=0, max=k - 1, description="mode", layout=wide)
        self.k = ipywidgets.IntSlider(
            min(20, k), min=1, max=k, description="first k", continuous_update=False, layout=wide
        )
        self.curves, self.gaps = chart(), chart()
        group = camera_group()
        self.function = scene(group=group, view=view, up=up, height=300)
        self.rebuilt = scene(group=group, view=view, up=up, height=300)
        self.on_change(self.choice, lambda value: self.set_trait("shape", value))
        self.on_change(self.curves, self.pick, "picked")
        self.on_change(self.gaps, self.pick, "picked")
        self.on_change(self.mode, lambda _: self.show_mode())
        self.on_change(self.k, lambda _: self.show_rebuilt())
        self.on_change(self, lambda _: self.take(), "shape")
        self.shape = self.names[0]
        return [
            row(self.choice),
            beside(self.curves, self.gaps),
            beside(
                ipywidgets.VBox([self.mode, self.function]), ipywidgets.VBox([self.k, self.rebuilt])
            ),
        ]

    def pick(self, mark):
        """The curve that was clicked."""
        if mark["series"] in self.names:
            self.shape = mark["series"]

    def take(self):
        """Another shape."""
        self.choice.value = self.shape
        self.mesh = self.study["coarse"][self.shape].to_dataset()
        self.surface = surface(self.study, self.shape)
        self.function.show(*self.surface)
        self.draw()
        self.show_mode()
        self.show_rebuilt()

    def draw(self):
        """The eigenvalues of all shapes, as they are and as they differ from Weyl's law."""
        longest = max(len(values) for values in self.values)
        line = {
            "name": "Weyl: 4 π k",
            "x": np.arange(longest),
            "color": "#777777",
            "dash": "6 4",
            "legend": True,
        }
        order = sorted(
            range(len(self.names)), key=lambda i: self.names[i] == self.shape
        )  # the chosen one on top
        for view, away, label in (
            (self.curves, False, "eigenvalue, unit area"),
            (self.gaps, True, "eigenvalue − 4 π k"),
        ):
            series = [line | {"wide": True, "y": weyl(longest) * (not away)}]
            series += [self.curve(i, away) for i in order]
            view.draw(
                "lines",
                series=series,
                marker=self.mode.value,
                xlabel="mode k",
                ylabel=label,
                title=TITLES[away],
                legend="left" if away else "bottom",
            )

    def curve(self, i, away):
        """The curve of a shape; from Weyl's law where it is drawn `away` from it."""
        name, values, chosen = self.names[i], self.values[i], self.names[i] == self.shape
        return {
            "name": name,
            "x": np.arange(len(values)),
            "y": values - weyl(len(values)) * away,
            "text": f"{name}: the second eigenvalue is {values[1]:.2f}, number {len(values) - 1} is {values[-1]:.1f}",
            "wide": chosen,
            "color": "#d55e00" if chosen else "#0072b2",
            "legend": chosen,
        }

    def show_mode(self):
        """One eigenfunction as colours."""
        mode = self.mode.value
        function = self.mesh["eigenfunction"].values[:, mode]
        limit = float(np.quantile(np.abs(function), 0.99))
        self.function.title = (
            f"φ{mode} of {self.shape}, eigenvalue {self.mesh['eigenvalue'].values[mode]:.2f}"
        )
        self.function.paint(
            signed_colors(function, limit), color_bar(SIGNED, -limit, limit, "eigenfunction")
        )
        self.draw()

    def show_rebuilt(self):
        """The surface from the first k coefficients of its positions."""
        X, T = self.surface
        rebuilt = reconstruct(self.mesh, X, k=self.k.value)
        gap = np.linalg.norm(rebuilt - X, axis=1)
        unit = unit_of(self.study, self.shape)
        self.rebuilt.show(
            rebuilt,
            T,
            title=f"from {self.k.value} of {len(self.mesh['eigenvalue'])} eigenfunctions",
        )
        self.rebuilt.caption = f"mean distance to the surface {gap.mean():.3g} ({unit})"
