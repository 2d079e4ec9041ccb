"""Correspondence (eq. 3, 6, 7): colours, texture and points, carried between two surfaces."""

import ipywidgets
import numpy as np
import traitlets

from s4a.show.browser import color_scale
from s4a.show.draw import position_colors, ramp_colors
from s4a.show.surfaces import (
    carried_colors,
    has,
    labelled,
    latent_match,
    mesh_of,
    names_of,
    surface,
    template_vertices,
    unit_text,
)
from s4a.widgets.panel import Panel, beside, check, dropdown, row
from s4a.widgets.scene import Scene, camera_group, extent, round_number

MAPS = [
    ("registration, full resolution", "registered"),
    ("latent basis, low resolution (eq. 3)", "low"),
    ("latent basis, full resolution (eq. 7)", "dense"),
]
SHOWN = [("coordinates", "place"), ("checkerboard", "checker"), ("confidence", "confidence")]
WHICH = "the registered surface, or nearest rows of the latent basis at either resolution"
COLORS = (
    "what is carried between the surfaces: coordinates, a checkerboard, or the registration's "
    "confidence from 0 to 1"
)
FOLLOW = "mark what is under the pointer on the other surface too, and not only what is clicked"
CELLS = 14  # of the checkerboard along the surface's extent


class Correspondence(Panel):
    """Two linked surfaces: a point under the pointer, or clicked, is shown at its image.

    The keyboard does the same: C starts a cursor that the arrow keys move over the surface.

    Attributes
    ----------
    shape : str
        The shape beside the template.
    vertex, image : int
        The vertex of the template that was clicked last, and its image on the shape; -1 for none.
    """

    needs = ("registration/position", "registration/registered_match")
    title = "Correspondence"
    shape = traitlets.Unicode("")
    vertex, image = traitlets.Int(-1), traitlets.Int(-1)
    live = (("colors", "choice"), ("hover",))

    def build(self, view: str = "corner", up: str = "z") -> list[ipywidgets.Widget]:
        """Choices and the two surfaces."""
        registration = self.study["registration"].dataset
        self.template = str(registration.attrs["template"])
        names = [name for name in names_of(registration) if name != self.template]
        latent = has(self.study, "latent/latent_basis") and has(self.study, "coarse")
        latent = latent and self.template in self.study["coarse"].children
        self.choice = dropdown(
            "shape", "the shape beside the template", labelled(self.study, names)
        )
        self.map = dropdown("map", WHICH, MAPS if latent else MAPS[:1], layout={"width": "28em"})
        self.colors = dropdown("colours", COLORS, SHOWN, layout={"width": "24em"})
        self.hover = check("follow the pointer", FOLLOW, True)
        look = {"group": camera_group(), "view": view, "up": up, "height": 400, "clickable": True}
        self.scenes = [Scene(**look), Scene(**look)]
        self.matches = {}  # (shape, map) -> match
        self.on_change(self.choice, lambda value: self.set_trait("shape", value))
        self.redraw(self.draw, self.map, self.colors)
        self.on_change(self.hover, self.follow)
        for scene, carry in zip(self.scenes, (self.to_shape, self.to_template), strict=True):
            self.on_pick(scene, carry, "picked", "hovered")
        self.on_change(self, lambda _: self.draw(), "shape")
        self.shape = names[0]
        self.follow(True)
        return [row(self.choice, self.map), row(self.colors, self.hover), beside(*self.scenes)]

    def follow(self, on: bool) -> None:
        """Whether points under the pointer are carried, and not only clicked ones."""
        for scene in self.scenes:
            scene.hovering = bool(on)

    @property
    def registered(self) -> bool:
        """Whether the match of the registration is shown."""
        return self.map.value == "registered"

    def match(self) -> np.ndarray:
        """On each vertex of the template that is shown, the vertex of the shape matched to it."""
        if self.registered:
            return (
                self.study["registration"].dataset["registered_match"].sel(shape=self.shape).values
            )
        key = self.shape, self.map.value
        if key not in self.matches:
            dense = self.map.value == "dense"
            self.matches[key] = latent_match(self.study, self.shape, self.template, dense=dense)
        return self.matches[key]

    def way_back(self) -> np.ndarray:
        """On each vertex of the shape the vertex of the template that lies there, -1 for none."""
        if self.registered:
            vertices = template_vertices(self.study, self.shape)
            if vertices is not None:
                return vertices
        match = self.match()
        back = np.full(len(self.pair[1][0]), -1)
        back[match[::-1]] = np.arange(len(match))[::-1]  # the first of several stays
        return back

    def confidence(self) -> np.ndarray | None:
        """The registration's confidence on the vertices of the template; None for other maps."""
        if not self.registered or "confidence" not in self.study["registration"].data_vars:
            return None
        return self.study["registration"].dataset["confidence"].sel(shape=self.shape).values

    def draw(self) -> None:
        """Both surfaces with their colours."""
        self.choice.value = self.shape
        self.vertex = self.image = -1
        stage = "coarse" if self.map.value == "low" else "original"
        template = surface(self.study, self.template, stage)
        if self.registered:
            template = mesh_of(self.study["registration"].dataset)
        self.pair = template, surface(self.study, self.shape, stage)
        colors, coordinates, bar, caption = (
            self.registered_look() if self.registered else self.latent_look()
        )
        cell = round_number(extent(template[0]) / CELLS)
        if coordinates[0] is not None:
            unit = unit_text(self.study, self.template)
            caption += f"; checkerboard of cubes of {cell:g} ({unit})"
        titles = f"{self.template}, the template", self.shape
        for i, scene in enumerate(self.scenes):
            X, T = self.pair[i]
            scene.show(X, T, title=f"{titles[i]}, {len(X):,} vertices")
            scene.paint(colors[i], bar, coordinates[i], cell)
            scene.caption = caption
        self.connect()

    def latent_look(self) -> tuple:
        """Colours and coordinates of both surfaces, the colour bar, and what they are.

        Those of the shape are pulled to the template.
        """
        Y, match = self.pair[1][0], self.match()
        caption = "the shape's coordinates, pulled to the template"
        if self.colors.value == "confidence":
            caption = f"the confidence belongs to the registration; here {caption}"
        colors = position_colors(Y)
        coordinates = (Y[match], Y) if self.colors.value == "checker" else (None, None)
        return (colors[match], colors), coordinates, None, caption

    def registered_look(self) -> tuple:
        """The same of the registration: the template's, carried to the shape."""
        X = self.pair[0][0]
        colors, coordinates, bar = position_colors(X), (None, None), None
        caption = "the template's coordinates, carried to the shape"
        if self.colors.value == "confidence":
            value = self.study["registration"].dataset["confidence"].sel(shape=self.shape).values
            colors = ramp_colors(value, 0, 1)
            bar = color_scale("viridis", 0, 1, f"confidence, {value.mean():.2f} on average")
            caption = "the registration's confidence, carried to the shape"
        if self.colors.value == "checker":
            carried = carried_colors(self.study, self.shape, X)
            coordinates = X, None if carried is None else np.nan_to_num(carried[2])
        carried = carried_colors(self.study, self.shape, colors)
        return (colors, None if carried is None else carried[2]), coordinates, bar, caption

    def connect(self) -> None:
        """Give the browser the images of all vertices, so that it marks them by itself."""
        back, sure = self.way_back(), self.confidence()
        sure_back = None if sure is None else sure[back] * (back >= 0)
        text = f"template vertex {{}} ↔ {self.shape} vertex {{}}"
        self.scenes[0].connect(self.match(), text.format("{here}", "{there}"), sure)
        self.scenes[1].connect(back, text.format("{there}", "{here}"), sure_back)

    def to_shape(self, place: dict) -> None:
        """A place of the template: its image on the shape."""
        if place.get("vertex", -1) >= 0:
            self.vertex = place["vertex"]
            self.image = int(self.match()[self.vertex])
            self.point()

    def to_template(self, place: dict) -> None:
        """A place of the shape: where it lies on the template."""
        vertex = place.get("vertex", -1)
        if vertex < 0:
            return
        self.vertex, self.image = int(self.way_back()[vertex]), vertex
        if self.vertex < 0:
            self.say(f"no vertex of the template is matched to vertex {vertex} of {self.shape}")
        else:
            self.point()

    def point(self) -> None:
        """Mark the vertex and its image, and say which they are."""
        text = f"template vertex {self.vertex} ↔ {self.shape} vertex {self.image}"
        sure = self.confidence()
        if sure is not None:
            text += f", confidence {sure[self.vertex]:.2f}"
        vertices = self.vertex, self.image
        for scene, (X, _), vertex in zip(self.scenes, self.pair, vertices, strict=True):
            scene.mark(X[vertex])
            scene.caption = text
