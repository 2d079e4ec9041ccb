"""Principal modes of variation (6.1, Fig. 4 and 5): sliders that deform the mean shape."""

from pathlib import Path

import ipywidgets
import numpy as np
import traitlets

from s4a.geometry.mesh import vertex_normals
from s4a.input.files import write_mesh
from s4a.method.deform import normal_displacement
from s4a.method.pca import apply_scores, color_limits, mahalanobis, plausible_scores
from s4a.show.live import mode_arrays, study_state, template_coarse
from s4a.widgets.meshes import camera_group, unit_of
from s4a.widgets.modes_view import modes_view
from s4a.widgets.panel import Panel, row

LARGE = 40e6  # bytes of modes from which the low resolution is shown first


class Modes(Panel):
    """A slider per mode, in standard deviations, that deforms the mean shape in the browser.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.
    resolution : {None, "full", "coarse"}
        Which vertices of the template; by default the full resolution, unless its modes are more
        than 40 MB.
    n_modes : int, optional
        How many modes; all by default.
    view, up
        From where the shape is seen first; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    scores : list of float
        One for each mode, in standard deviations.
    """

    needs = ("registration/position", "pca/deformation")
    title = "Modes of variation"
    scores = traitlets.List(traitlets.Float())
    python = ("saving the mesh",)

    def build(self, resolution=None, n_modes=None, view="corner", up="z"):
        """Sliders, shape and charts in the browser; below them resolution and export."""
        pca, self.n_modes = self.study["pca"].dataset, n_modes
        template = str(self.study["registration"].attrs.get("template", ""))
        self.coarse = template_coarse(self.study)
        size = pca["deformation"].isel(component=slice(n_modes)).nbytes
        small = self.coarse is not None and size > LARGE
        resolution = resolution or ("coarse" if small else "full")
        self.view = modes_view(
            *self.arrays(resolution),
            limits=color_limits(*self.arrays("full" if self.coarse is None else "coarse")),
            unit=unit_of(self.study, template),
            **study_state(self.study, n_modes),
            group=camera_group(),
            view=view,
            up=up,
        )
        traitlets.link((self.view, "scores"), (self, "scores"))
        sizes = [(f"full, {self.study['registration'].sizes['vertex']:,} vertices", "full")]
        if self.coarse is not None:
            sizes.append((f"coarse, {self.coarse.sizes['vertex']:,} vertices", "coarse"))
        self.resolution = ipywidgets.Dropdown(
            options=sizes, value=resolution, description="resolution"
        )
        self.path = ipywidgets.Text("shape.ply", description="file", layout={"width": "260px"})
        self.ply = ipywidgets.Button(
            description="Save mesh", tooltip="the shape as it stands, at full resolution"
        )
        self.html = ipywidgets.Button(
            description="Save page", tooltip="one HTML file with these sliders, for offline"
        )
        self.on_change(self.resolution, lambda value: self.view.change_mesh(*self.arrays(value)))
        self.ply.on_click(
            self.guarded(lambda _: self.say(f"written: {self.save_mesh(self.path.value)}"))
        )
        self.html.on_click(
            self.guarded(lambda _: self.say(f"written: {self.save_html(self.page_path())}"))
        )
        return [self.view, row(self.resolution, self.path, self.ply, self.html)]

    def arrays(self, resolution):
        """Mean shape, triangles and deformations at the resolution."""
        return mode_arrays(self.study, None if resolution == "full" else self.coarse, self.n_modes)

    def page_path(self):
        """The name of the page beside that of the mesh."""
        return Path(self.path.value).with_suffix(".html")

    def vertices(self, resolution="full"):
        """Vertices ``(n, 3)`` of the shape as the sliders stand, in the unit of the input."""
        mean, _, deformation = self.arrays(resolution)
        return apply_scores(mean, deformation, self.scores)

    @property
    def distance(self):
        """Mahalanobis distance of the shape from the mean."""
        return mahalanobis(self.scores)

    def random(self, seed=None):
        """A plausible shape: set scores drawn from the normal distribution, and give them."""
        self.scores = plausible_scores(len(self.scores), seed=seed).tolist()
        return self.scores

    def save_mesh(self, path):
        """Write the shape as the sliders stand, at full resolution.

        In any format of :func:`s4a.write_mesh`.
        """
        mean, T, _ = self.arrays("full")
        X, path = self.vertices(), Path(path)
        values = (
            {}
            if path.suffix.lower() in (".obj", ".off", ".stl")
            else {
                "normal_displacement": normal_displacement(
                    X - mean, vertex_normals(mean, T)
                ).astype(np.float32)
            }
        )
        write_mesh(path, X, T, **values)
        return path
