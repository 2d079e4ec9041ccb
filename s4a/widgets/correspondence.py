"""Correspondence (eq. 3, 6, 7).

The template and a shape, with the colours, texture and points that the map carries.
"""

import ipywidgets
import numpy as np
import traitlets

from s4a.method.register import match_functions, match_latent
from s4a.method.shape import Shape
from s4a.show.draw import position_colors, ramp_colors
from s4a.show.live import color_bar
from s4a.show.pictures import carried_colors, has, mesh_of, names_of
from s4a.widgets.meshes import camera_group, nice, surface, unit_of
from s4a.widgets.panel import Panel, beside, row
from s4a.widgets.scene import extent, scene

MAPS = [
    ("registration, full resolution", "registered"),
    ("latent basis, low resolution (eq. 3)", "low"),
    ("latent basis, full resolution (eq. 7)", "dense"),
]
SHOWN = [("coordinates", "place"), ("checkerboard", "checker"), ("confidence", "confidence")]
CELLS = 14  # of the checkerboard along the surface's extent


class Correspondence(Panel):
    """Two linked surfaces; a point under the pointer, or clicked.

    Is shown at its image on the other.

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

    def build(self, view="corner", up="z"):
        """Choices and the two surfaces."""
        registration = self.study["registration"]
        self.template = str(registration.attrs["template"])
        names = [name for name in names_of(registration.dataset) if name != self.template]
        latent = has(self.study, "latent/latent_basis") and "coarse" in self.study.children
        self.choice = ipywidgets.Dropdown(options=names, description="shape")
        self.map = ipywidgets.Dropdown(
            options=MAPS if latent else MAPS[:1], description="map", layout={"width": "360px"}
        )
        self.colors = ipywidgets.Dropdown(
            options=SHOWN, description="colours", layout={"width": "320px"}
        )
        self.hover = ipywidgets.Checkbox(True, description="follow the pointer", indent=False)
        group = camera_group()
        self.scenes = [
            scene(group=group, view=view, up=up, height=400, clickable=True) for _ in range(2)
        ]
        self.matches = {}
        self.on_change(self.choice, lambda value: self.set_trait("shape", value))
        self.on_change(self.map, lambda _: self.draw())
        self.on_change(self.colors, lambda _: self.draw())
        self.on_change(self.hover, self.follow)
        for view, carry in zip(self.scenes, (self.to_shape, self.to_template), strict=True):
            for event in ("picked", "hovered"):
                self.on_change(view, carry, event)
        self.on_change(self, lambda _: self.draw(), "shape")
        self.shape = names[0]
        self.follow(True)
        return [row(self.choice, self.map), row(self.colors, self.hover), beside(*self.scenes)]

    def follow(self, on):
        """Whether points under the pointer are carried, and not only clicked ones."""
        for view in self.scenes:
            view.hovering = bool(on)

    def match(self):
        """On each vertex of the template that is shown.

        The matched vertex of the shape that is shown.
        """
        key = self.shape, self.map.value
        if key[1] == "registered":
            return self.study["registration"]["registered_match"].sel(shape=self.shape).values
        if key not in self.matches:
            names = self.shape, self.template
            shapes = [
                Shape(*(self.study[stage][n].to_dataset() for stage in ("original", "coarse")))
                for n in names
            ]
            Y = self.study["latent"]["latent_basis"]
            match, functions = match_latent(*shapes, [Y.sel(shape=n).values for n in names])
            if key[1] != "low":
                match = match_functions(*shapes, *functions)[0]
            self.matches[key] = match
        return self.matches[key]

    def draw(self):
        """Both surfaces with their colours."""
        self.choice.value = self.shape
        self.vertex = self.image = -1
        stage = "coarse" if self.map.value == "low" else "original"
        self.pair = (
            surface(self.study, self.template, stage),
            surface(self.study, self.shape, stage),
        )
        if self.map.value == "registered":
            self.pair = mesh_of(self.study["registration"]), self.pair[1]
        colors, coordinates, bar, note = self.painted()
        cell = nice(extent(self.pair[0][0]) / CELLS)
        if coordinates[0] is not None:
            note += f"; checkerboard of cubes of {cell:g} ({unit_of(self.study, self.template)})"
        names = f"{self.template}, the template", self.shape
        for i, (view, name) in enumerate(zip(self.scenes, names, strict=True)):
            view.show(*self.pair[i], title=f"{name}, {len(self.pair[i][0]):,} vertices")
            view.paint(colors[i], bar, coordinates[i], cell)
            view.caption = note
        self.connect()

    def painted(self):
        """Of both surfaces the colours and the coordinates of a checkerboard.

        Their colour bar and what they are.
        """
        (X, _), (Y, _) = self.pair
        kind = self.colors.value
        if self.map.value != "registered":
            match, note = self.match(), "the shape's coordinates, pulled to the template"
            colors = position_colors(Y)
            if kind == "confidence":
                note = f"the confidence belongs to the registration; here {note}"
            return (
                (colors[match], colors),
                (Y[match], Y) if kind == "checker" else (None, None),
                None,
                note,
            )
        bar, coordinates, note = (
            None,
            (None, None),
            "the template's coordinates, carried to the shape",
        )
        colors = position_colors(X)
        if kind == "confidence":
            value = self.study["registration"]["confidence"].sel(shape=self.shape).values
            colors, note = (
                ramp_colors(value, 0, 1),
                "the registration's confidence, carried to the shape",
            )
            bar = color_bar("viridis", 0, 1, f"confidence, {value.mean():.2f} on average")
        if kind == "checker":
            carried = carried_colors(self.study, self.shape, X)
            coordinates = X, None if carried is None else np.nan_to_num(carried[2])
        carried = carried_colors(self.study, self.shape, colors)
        return (colors, None if carried is None else carried[2]), coordinates, bar, note

    def connect(self):
        """Give the browser the images of all vertices, so that it marks them by itself."""
        match, sure, back = self.match(), None, self.way_back()
        if self.map.value == "registered" and "confidence" in self.study["registration"].data_vars:
            sure = self.study["registration"]["confidence"].sel(shape=self.shape).values
        there = None if sure is None else sure[back] * (back >= 0)
        text = f"template vertex {{}} ↔ {self.shape} vertex {{}}"
        self.scenes[0].connect(match, text.format("{here}", "{there}"), sure)
        self.scenes[1].connect(back, text.format("{there}", "{here}"), there)

    def way_back(self):
        """On each vertex of the shape the vertex of the template that lies there, -1 for none."""
        node = self.study["registration"].children.get(self.shape)
        if (
            self.map.value == "registered"
            and node is not None
            and "template_triangle" in node.data_vars
        ):
            corners = self.pair[0][1][node["template_triangle"].values]
            return np.take_along_axis(
                corners, node["template_barycentric"].values.argmax(1)[:, None], axis=1
            )[:, 0]
        match = self.match()
        back = np.full(len(self.pair[1][0]), -1)
        back[match[::-1]] = np.arange(len(match))[::-1]
        return back

    def to_shape(self, place):
        """A place of the template: its image on the shape."""
        if place.get("vertex", -1) < 0:
            return
        self.vertex = place["vertex"]
        self.image = int(self.match()[self.vertex])
        self.point(self.pair[0][0][self.vertex], self.pair[1][0][self.image])

    def to_template(self, place):
        """A place of the shape: where it lies on the template."""
        vertex = place.get("vertex", -1)
        if vertex < 0:
            return
        self.vertex, self.image = int(self.way_back()[vertex]), vertex
        if self.vertex < 0:
            return self.say(
                f"no vertex of the template is matched to vertex {vertex} of {self.shape}"
            )
        self.point(self.pair[0][0][self.vertex], self.pair[1][0][vertex])

    def point(self, on_template, on_shape):
        """Mark two corresponding points and say which they are."""
        for view, place in zip(self.scenes, (on_template, on_shape), strict=True):
            view.mark([place])
        text = f"template vertex {self.vertex} ↔ {self.shape} vertex {self.image}"
        if self.map.value == "registered" and "confidence" in self.study["registration"].data_vars:
            value = (
                self.study["registration"]["confidence"].sel(shape=self.shape).values[self.vertex]
            )
            text += f", confidence {value:.2f}"
        self.scenes[0].caption = self.scenes[1].caption = text
