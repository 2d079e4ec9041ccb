"""Correspondence (eq. 3, 6, 7): the template and a shape, with the colours and points that the map carries."""

import ipywidgets
import numpy as np
import traitlets

from s4a.draw import position_colors, ramp_colors
from s4a.fmap import nearest_rows
from s4a.picture import carried_colors, has, mesh_of, names_of
from s4a.register import Scan, intrinsic_match
from s4a.widgets.meshes import camera_group, surface
from s4a.widgets.panel import Panel, beside, row
from s4a.widgets.scene import color_bar, scene

MAPS = [
    ("registration, full resolution", "registered"),
    ("latent basis, low resolution (eq. 3)", "low"),
    ("latent basis, full resolution (eq. 7)", "dense"),
]
SHOWN = [("coordinates of the template", "place"), ("confidence", "confidence")]


class Correspondence(Panel):
    """Two linked surfaces; a point under the pointer, or clicked, is shown at its image on the other.

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
        self.colors = ipywidgets.Dropdown(options=SHOWN, description="colours", layout={"width": "320px"})
        self.hover = ipywidgets.Checkbox(True, description="follow the pointer", indent=False)
        group = camera_group()
        self.scenes = [scene(group=group, view=view, up=up, height=400) for _ in range(2)]
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
        """On each vertex of the template that is shown, the matched vertex of the shape that is shown."""
        key = self.shape, self.map.value
        if key[1] == "registered":
            return self.study["registration"]["registered_match"].sel(shape=self.shape).values
        if key not in self.matches:
            names = self.shape, self.template
            coarse = [self.study["coarse"][name].to_dataset() for name in names]
            basis = self.study["latent"]["latent_basis"]
            F = [c["eigenfunction"].values[:, : basis.sizes["mode"]] @ basis.sel(shape=n).values
                 for n, c in zip(names, coarse, strict=True)]  # fmt: skip
            if key[1] == "low":
                self.matches[key] = nearest_rows(F[1], F[0])
            else:
                scans = [Scan(self.study["original"][n].to_dataset(), c) for n, c in zip(names, coarse, strict=True)]
                self.matches[key] = intrinsic_match(*scans, *F)[0]
        return self.matches[key]

    def draw(self):
        """Both surfaces with their colours."""
        self.choice.value = self.shape
        self.vertex = self.image = -1
        stage = "coarse" if self.map.value == "low" else "original"
        self.pair = surface(self.study, self.template, stage), surface(self.study, self.shape, stage)
        if self.map.value == "registered":
            self.pair = mesh_of(self.study["registration"]), self.pair[1]
        colors, bar, note = self.painted()
        names = f"{self.template}, the template", self.shape
        for view, (X, T), color, name in zip(self.scenes, self.pair, colors, names, strict=True):
            view.show(X, T, title=f"{name}, {len(X):,} vertices")
            view.paint(color, bar)
            view.caption = note

    def painted(self):
        """Colours of both surfaces, their colour bar and what they are."""
        (X, _), (Y, _) = self.pair
        if self.map.value != "registered":
            colors = position_colors(Y)
            return (colors[self.match()], colors), None, "the shape's coordinates, pulled to the template"
        if self.colors.value == "confidence":
            value = self.study["registration"]["confidence"].sel(shape=self.shape).values
            colors = ramp_colors(value, 0, 1)
            bar = color_bar("viridis", 0, 1, f"confidence, {value.mean():.2f} on average")
        else:
            colors, bar = position_colors(X), None
        carried = carried_colors(self.study, self.shape, colors)
        return (colors, None if carried is None else carried[2]), bar, "the template's colours, carried to the shape"

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
        node = self.study["registration"].children.get(self.shape)
        X, T = self.pair[0]
        if self.map.value == "registered" and node is not None and "template_triangle" in node.data_vars:
            corners = T[node["template_triangle"].values[vertex]]
            weights = node["template_barycentric"].values[vertex]
            self.vertex, point = int(corners[weights.argmax()]), weights @ X[corners]
        else:
            from_here = np.flatnonzero(self.match() == vertex)
            if not len(from_here):
                return self.say(f"no vertex of the template is matched to vertex {vertex} of {self.shape}")
            self.vertex, point = int(from_here[0]), X[from_here[0]]
        self.image = vertex
        self.point(point, self.pair[1][0][vertex])

    def point(self, on_template, on_shape):
        """Mark two corresponding points and say which they are."""
        for view, place in zip(self.scenes, (on_template, on_shape), strict=True):
            view.mark([place])
        text = f"template vertex {self.vertex} ↔ {self.shape} vertex {self.image}"
        if self.map.value == "registered" and "confidence" in self.study["registration"].data_vars:
            value = self.study["registration"]["confidence"].sel(shape=self.shape).values[self.vertex]
            text += f", confidence {value:.2f}"
        self.scenes[0].caption = self.scenes[1].caption = text
