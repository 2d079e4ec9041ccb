"""The modes of a collection as sliders that deform the mean shape, in the browser."""

import numpy as np
import traitlets

from s4a.geometry.mesh import vertex_normals
from s4a.method.deform import normal_displacement
from s4a.method.pca import apply_scores
from s4a.show.browser import MODES, look_state, mesh_state, to_bytes
from s4a.show.draw import signed_colors
from s4a.widgets.scene import View


class ModesView(View):
    """Sliders, shape and charts; only the scores come back, some hundred bytes a step.

    Attributes
    ----------
    scores : list of float
        In standard deviations, one for each component; set them and the shape follows.
    sample : int
        The shape that was clicked last, -1 for none.
    colors : {"normal", "magnitude", "none", "own"}
    own : bytes
        Colours of the vertices that are there to choose, as of
        :func:`s4a.show.browser.color_bytes`; none by default.
    beside : bool
        Whether the marked component is shown at -3, 0 and 3 standard deviations, side by side.
    """

    _esm = MODES
    mean = traitlets.Bytes().tag(sync=True)
    corner = traitlets.Bytes().tag(sync=True)
    deformation = traitlets.Bytes().tag(sync=True)
    signed_palette = traitlets.Bytes().tag(sync=True)
    ramp_palette = traitlets.Bytes().tag(sync=True)
    limit = traitlets.Float(1.0).tag(sync=True)
    limit_magnitude = traitlets.Float(1.0).tag(sync=True)
    bars = traitlets.Dict().tag(sync=True)
    scores = traitlets.List().tag(sync=True)
    ratio = traitlets.List().tag(sync=True)
    ratio_low = traitlets.List().tag(sync=True)
    samples = traitlets.List().tag(sync=True)
    names = traitlets.List().tag(sync=True)
    faint = traitlets.List().tag(sync=True)
    colors = traitlets.Enum(["normal", "magnitude", "none", "own"], "normal").tag(sync=True)
    own = traitlets.Bytes().tag(sync=True)
    beside = traitlets.Bool(False).tag(sync=True)
    sample = traitlets.Int(-1).tag(sync=True)
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

    def change_mesh(self, mean: np.ndarray, triangles: np.ndarray, deformation: np.ndarray) -> None:
        """Other vertices of the same shapes, in one message."""
        self.arrays = mean, triangles, deformation
        with self.hold_sync():
            for name, value in mesh_state(mean, triangles, deformation).items():
                self.set_trait(name, value)
        self.draw_still()

    def change_triangles(self, triangles: np.ndarray) -> None:
        """Other triangles of the same vertices, as where a part of them is not seen."""
        mean, _, deformation = self.arrays
        self.arrays = mean, triangles, deformation
        self.corner = to_bytes(triangles, "uint32")
        self.draw_still()

    def drawn(self) -> tuple | None:
        """The shape as the sliders stand, coloured by how far it moved along the mean's normals."""
        mean, triangles, deformation = self.arrays
        moved = apply_scores(mean, deformation, self.scores)
        if self.colors == "own" and self.own:
            return moved, triangles, np.frombuffer(self.own, np.uint8).reshape(-1, 3) / 255
        if self.colors != "normal":
            return moved, triangles, None
        along = normal_displacement(moved - mean, vertex_normals(mean, triangles))
        return moved, triangles, signed_colors(along, self.limit)
