"""The modes of a collection as sliders that deform the mean shape.

In the browser, or in Python without anywidget.
"""

import ipywidgets
import numpy as np
import traitlets

from s4a.geometry.mesh import vertex_normals
from s4a.method.pca import apply_scores
from s4a.show.draw import signed_colors
from s4a.show.live import MODES, STYLE, bars, look_state, mesh_state
from s4a.widgets.browser import anywidget
from s4a.widgets.scene import Surfaces, scene

if anywidget is not None:

    class ModesView(Surfaces, anywidget.AnyWidget):
        """Sliders, shape and charts in the browser.

        Only the scores come back, some hundred bytes a step.

        Attributes
        ----------
        scores : list of float
            In standard deviations, one for each component; set them and the shape follows.
        sample : int
            The shape that was clicked last, -1 for none.
        colors : {"normal", "magnitude", "none"}
        beside : bool
            Whether the marked component is shown at -3, 0 and 3 standard deviations, side by side.
        """

        _esm, _css = MODES, STYLE
        mean, corner, deformation, still = (traitlets.Bytes().tag(sync=True) for _ in range(4))
        signed_table, ramp_table = (traitlets.Bytes().tag(sync=True) for _ in range(2))
        limit, limit_magnitude = (traitlets.Float(1.0).tag(sync=True) for _ in range(2))
        scores, ratio, ratio_low, samples, names, turn = (
            traitlets.List().tag(sync=True) for _ in range(6)
        )
        bars = traitlets.Dict().tag(sync=True)
        colors = traitlets.Enum(["normal", "magnitude", "none"], "normal").tag(sync=True)
        beside = traitlets.Bool(False).tag(sync=True)
        sample = traitlets.Int(-1).tag(sync=True)
        group, webgl = (traitlets.Unicode("").tag(sync=True) for _ in range(2))
        height = traitlets.Int(420).tag(sync=True)

        def __init__(
            self, mean, triangles, deformation, *, limits, unit, view="corner", up="z", **options
        ):
            self.arrays = mean, triangles, deformation
            super().__init__(
                **mesh_state(mean, triangles, deformation),
                **look_state(limits, unit, view, up),
                scores=[0.0] * len(deformation),
                **options,
            )
            self.observe(self.draw_still, ["webgl", "scores", "colors"])

        def change_mesh(self, mean, triangles, deformation):
            """Other vertices of the same shapes, in one message."""
            self.arrays = mean, triangles, deformation
            with self.hold_sync():
                for name, value in mesh_state(*self.arrays).items():
                    setattr(self, name, value)
            self.draw_still()

        def draw_still(self, change=None):
            """Send a still picture where the browser has no WebGL2."""
            if self.webgl == "no":
                self.still = self.picture()

        def picture(self):
            """PNG bytes of the shape as the sliders stand."""
            self.surface, self.painted = painted(self)
            return super().picture()


def painted(view):
    """Surface and signed colours of the scores of a view."""
    mean, triangles, deformation = view.arrays
    moved = apply_scores(mean, deformation, view.scores)
    if view.colors != "normal":
        return (moved, triangles), None
    along = ((moved - mean) * vertex_normals(mean, triangles)).sum(1)
    return (moved, triangles), signed_colors(along, view.limit)


class StillModes(ipywidgets.VBox):
    """Sliders where anywidget is not installed: Python deforms the shape and draws it again."""

    scores, sample = traitlets.List(), traitlets.Int(-1)
    colors, beside = traitlets.Unicode("normal"), traitlets.Bool(False)

    def __init__(
        self,
        mean,
        triangles,
        deformation,
        *,
        limits,
        ratio,
        samples,
        names,
        unit,
        view,
        up,
        **options,
    ):
        self.arrays, self.limit, self.samples = (mean, triangles, deformation), limits[0], samples
        self.shape = scene(title="mean + Σ score · deformation", view=view, up=up)
        self.shape.bar = bars(*limits, unit)["normal"]
        self.sliders = [
            ipywidgets.FloatSlider(
                0, min=-3, max=3, step=0.05, description=f"PC{i + 1} · {share:.1%}"
            )
            for i, share in enumerate(ratio)
        ]
        self.choice = ipywidgets.Dropdown(
            options=[("mean", -1), *((n, i) for i, n in enumerate(names))]
        )
        super().__init__(
            [ipywidgets.HBox([self.shape, ipywidgets.VBox([self.choice, *self.sliders])])]
        )
        self.scores = [0.0] * len(deformation)
        for slider in self.sliders:
            slider.observe(self.collect, "value")
        self.choice.observe(self.choose, "value")

    def collect(self, change):
        """The scores as the sliders stand."""
        self.scores = [slider.value for slider in self.sliders]

    def choose(self, change):
        """The scores of the sample that was chosen."""
        self.sample = change["new"]
        self.scores = (
            [0.0] * len(self.scores) if self.sample < 0 else list(self.samples[self.sample])
        )

    def change_mesh(self, mean, triangles, deformation):
        """Other vertices of the same shapes."""
        self.arrays = mean, triangles, deformation
        self.redraw()

    @traitlets.observe("scores")
    def redraw(self, change=None):
        """Deform, colour and draw."""
        (points, triangles), colors = painted(self)
        self.shape.show(points, triangles, colors)
        for slider, score in zip(self.sliders, self.scores, strict=True):
            slider.unobserve(self.collect, "value")
            slider.value = float(np.clip(score, -3, 3))
            slider.observe(self.collect, "value")


def modes_view(*arrays, **options):
    """The sliders: :class:`ModesView`, or :class:`StillModes` where anywidget is not installed."""
    return (StillModes if anywidget is None else ModesView)(*arrays, **options)
