"""Modes of variation (6.1, Fig. 4 and 5): sliders that deform the mean shape."""

from pathlib import Path
from typing import Any

import numpy as np
import traitlets

from s4a.geometry.mesh import vertex_normals
from s4a.input.files import WITH_VALUES, write_mesh
from s4a.method.deform import normal_displacement
from s4a.method.pca import apply_scores, mahalanobis, plausible_scores
from s4a.schema import Array
from s4a.show.browser import MODES, appearance_state, mesh_state, to_bytes
from s4a.show.draw import signed_colors
from s4a.show.surfaces import (
    N_LIVE,
    attribute,
    mode_arrays,
    mode_limits,
    score_state,
    template_coarse,
    unit_text,
)
from s4a.widgets.panel import Panel, dropdown, file_name, row
from s4a.widgets.views import View

LARGE = 40e6  # bytes of the deformations above which the default is the low resolution


class ModesView(View):
    """Sliders, shape and charts in the browser, which sends only the scores to the kernel.

    Attributes
    ----------
    scores : list of float
        Score of each mode of variation, in standard deviations; the shape follows them.
    sample : int
        The shape that was clicked last, -1 for none.
    colors : {"normal", "magnitude", "none", "own"}
    own : bytes
        Colours of the vertices for ``colors="own"``, made by
        :func:`s4a.show.browser.color_bytes`; none by default.
    side_by_side : bool
        If True, the marked mode is shown at -3, 0 and 3 standard deviations.
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
    side_by_side = traitlets.Bool(False).tag(sync=True)
    sample = traitlets.Int(-1).tag(sync=True)
    height = traitlets.Int(420).tag(sync=True)

    def __init__(
        self, mean, triangles, deformation, *, limits, unit, view="corner", up="z", **options
    ):
        self.arrays = mean, triangles, deformation
        super().__init__(
            **mesh_state(mean, triangles, deformation),
            **appearance_state(limits, unit, view, up),
            scores=[0.0] * len(deformation),
            **options,
        )
        self.observe(self.draw_still, ["webgl", "scores", "colors"])

    def change_mesh(self, mean: Array, triangles: Array, deformation: Array) -> None:
        """Replace the mesh by one with other vertices, in one message."""
        self.arrays = mean, triangles, deformation
        with self.hold_sync():
            for name, value in mesh_state(*self.arrays).items():
                self.set_trait(name, value)
        self.draw_still()

    def change_triangles(self, triangles: Array) -> None:
        """Replace the triangles, for example to hide some of them."""
        self.arrays = self.arrays[0], triangles, self.arrays[2]
        self.corner = to_bytes(triangles, "uint32")
        self.draw_still()

    def drawn(self) -> tuple | None:
        """Return the deformed shape, coloured by the displacement along the mean's normals."""
        mean, triangles, deformation = self.arrays
        moved = apply_scores(mean, deformation, self.scores)
        if self.colors == "own" and self.own:
            return moved, triangles, np.frombuffer(self.own, np.uint8).reshape(-1, 3) / 255
        if self.colors != "normal":
            return moved, triangles, None
        along = normal_displacement(moved - mean, vertex_normals(mean, triangles))
        return moved, triangles, signed_colors(along, self.limit)


class Modes(Panel):
    """Sliders, one per mode of variation, that deform the mean shape in the browser.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.
    resolution : {None, "full", "coarse"}
        Resolution of the template; by default full, unless the deformations exceed 40 MB.
    n_modes : int
        Largest number of modes of variation, the first ones.
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    scores : list of float
        Score of each mode of variation, in standard deviations.

    See Also
    --------
    s4a.write_picture, s4a.write_film : modes of variation as a picture or a film.

    References
    ----------
    T. F. Cootes et al. (1995), Active shape models: their training and application, Computer Vision
    and Image Understanding 61(1).
    """

    needs = ("registration/position", "pca/deformation")
    title = "Modes of variation"
    scores = traitlets.List(traitlets.Float())
    python = ("saving the mesh",)

    def build(self, resolution: str | None = None, n_modes: int = N_LIVE) -> list:
        """Return the view with its sliders and charts, and controls of resolution and export."""
        self.n_modes = n_modes
        self.coarse = template_coarse(self.study)
        sizes = {"full": self.study["registration"].sizes["vertex"]}
        if self.coarse is not None:
            sizes["coarse"] = self.coarse.sizes["vertex"]
        if resolution is None:
            deformation = self.study["pca"]["deformation"].isel(component=slice(n_modes))
            resolution = list(sizes)[-1] if deformation.nbytes > LARGE else "full"
        state: dict[str, Any] = score_state(self.study, n_modes) | self.camera
        unit = unit_text(self.study, attribute(self.study, "registration", "template"))
        arrays, limits = self.arrays(resolution), mode_limits(self.study)
        self.view = ModesView(*arrays, limits=limits, unit=unit, **state)
        traitlets.link((self.view, "scores"), (self, "scores"))
        options = [(f"{name}, {size:,} vertices", name) for name, size in sizes.items()]
        self.resolution = dropdown(
            "resolution", "resolution of the deformed mesh", options, value=resolution
        )
        self.on_change(self.resolution, lambda name: self.view.change_mesh(*self.arrays(name)))
        self.path = file_name("shape.ply")
        mesh_help = "the current shape at full resolution"
        self.ply = self.save_button("Save mesh", lambda: self.save_mesh(self.path.value), mesh_help)
        page_help = "one HTML file that needs no kernel, with the name of the mesh"
        self.html = self.save_button("Save page", self.save_page, page_help)
        return [self.view, row(self.resolution, self.path, self.ply, self.html)]

    def arrays(self, resolution: str) -> tuple[Array, Array, Array]:
        """Return mean shape, triangles and deformations at a resolution."""
        return mode_arrays(self.study, None if resolution == "full" else self.coarse, self.n_modes)

    def save_page(self) -> Path:
        """Save a page with the name of the mesh."""
        return self.save_html(Path(self.path.value).with_suffix(".html"))

    def vertices(self, resolution: str = "full") -> Array:
        """Return the vertices ``(n, 3)`` of the current shape, in the unit of the input."""
        mean, _, deformation = self.arrays(resolution)
        return apply_scores(mean, deformation, np.array(self.scores))

    @property
    def distance(self) -> float:
        """Mahalanobis distance of the current shape from the mean."""
        return mahalanobis(np.array(self.scores))

    def random(self, seed: int | None = None) -> list[float]:
        """Draw scores from the normal distribution, set and return them."""
        self.scores = plausible_scores(len(self.scores), seed=seed).tolist()
        return self.scores

    def save_mesh(self, path: Path | str) -> Path:
        """Write the current shape at full resolution, in a format of :func:`s4a.write_mesh`.

        A format with values at the vertices also gets the displacement along the mean's normals.
        """
        path = Path(path)
        mean, T, _ = self.arrays("full")
        X, values = self.vertices(), {}
        if path.suffix.lower() in WITH_VALUES:
            along = normal_displacement(X - mean, vertex_normals(mean, T))
            values["normal_displacement"] = along.astype(np.float32)
        write_mesh(path, X, T, **values)
        return path
