"""Correspondence (eq. 3, 6, 7): colours, texture and points, transferred between two surfaces."""

import ipywidgets
import numpy as np
import traitlets

from s4a.analysis.transfer import correspondence
from s4a.method.steps import latent_match
from s4a.schema import Array
from s4a.show.browser import color_scale
from s4a.show.draw import position_colors, ramp_colors
from s4a.show.surfaces import (
    has,
    labelled,
    mesh_of,
    names_of,
    nearest_corner,
    surface,
    template_vertices,
    transferred_colors,
    unit_text,
)
from s4a.widgets.panel import Panel, columns, dropdown, row
from s4a.widgets.views import extent, round_down

MAPS = [
    ("registration, full resolution", "registered"),
    ("latent basis, low resolution (eq. 3)", "low"),
    ("latent basis, full resolution (eq. 7)", "dense"),
]
SHOWN = [("coordinates", "position"), ("checkerboard", "checker"), ("confidence", "confidence")]
WHICH = "the registered surface, or nearest rows of the latent basis at either resolution"
COLORS = (
    "values that are transferred between the surfaces: coordinates, a checkerboard, or the "
    "registration's confidence from 0 to 1"
)
CELLS = 14  # of the checkerboard along the surface's extent


def inverse(match: Array, n: int) -> Array:
    """Return for each of `n` vertices the first one that is matched to it, -1 for none.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.correspondence import inverse
    >>> inverse(np.array([2, 0, 2]), 4).tolist()
    [1, -1, 0, -1]
    """
    reverse, known = np.full(n, -1), np.flatnonzero(match >= 0)[::-1]
    reverse[match[known]] = known  # the first of several is written last
    return reverse


class Correspondence(Panel):
    """Two linked surfaces: a vertex under the pointer, or clicked, is marked with its image.

    With the keyboard, C starts a cursor that the arrow keys move over the surface.

    Attributes
    ----------
    source : str
        The shape on the left: the template, or another shape, which is matched through the
        template.
    shape : str
        The shape on the right.
    vertex, image : int
        The vertex of the source that was clicked last, and its image on the shape; -1 for none.

    See Also
    --------
    s4a.widgets.Comparison : matches of other methods.
    """

    needs = ("registration/position", "registration/registered_match", "original")
    title = "Correspondence"
    source, shape = traitlets.Unicode(""), traitlets.Unicode("")
    vertex, image = traitlets.Int(-1), traitlets.Int(-1)
    live = (("colors", "choice"), ("hover",))
    shares = ("source", "shape")

    def build(self) -> list[ipywidgets.Widget]:
        """Return the controls and the views of the two surfaces."""
        registration = self.study["registration"].dataset
        self.template = str(registration.attrs["template"])
        self.names = [name for name in names_of(registration) if name != self.template]
        latent = has(self.study, "latent/latent_basis") and has(self.study, "coarse")
        latent = latent and self.template in self.study["coarse"].children
        shapes = labelled(self.study, self.names)
        options = [(f"{self.template}, the template", self.template)]
        if self.template in self.study["original"].children and all(
            name in self.study["registration"].children for name in self.names
        ):  # else two shapes cannot be composed
            options += shapes
        self.left = dropdown("source", "the shape on the left", options)
        self.choice = dropdown("shape", "the shape on the right", shapes)
        self.map = dropdown("map", WHICH, MAPS if latent else MAPS[:1], layout={"width": "28em"})
        self.colors = dropdown("colours", COLORS, SHOWN, layout={"width": "24em"})
        self.scenes = [self.new_scene(400, clickable=True) for _ in range(2)]
        self.hover = self.follow()
        self.selected_pair, self.shown = ("", ""), ("", "")
        self.matches, self.points = {}, {}  # by source, shape and map; by source and target
        self.bind(self.left, "source")
        self.bind(self.choice, "shape")
        self.redraw(self.draw, self.map, self.colors)
        for scene, on_pick in zip(self.scenes, (self.to_shape, self.to_source), strict=True):
            self.on_pick(scene, on_pick, "picked", "hovered")
        self.redraw(self.change_pair, "source", "shape")
        self.show_pair(self.template, self.names[0])
        choices = row(self.left, self.choice, self.map)
        return [choices, row(self.colors, self.hover), columns(*self.scenes)]

    def selection(self) -> dict:
        """Return the pair that is shown, in the direction of the other tabs."""
        shown = self.source, self.shape
        same = set(shown) == set(self.selected_pair)
        return {"pair": self.selected_pair if same else shown}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show a pair of registered shapes; the template, if it is in the pair, on the left."""
        self.selected_pair = pair
        source, target = pair if pair[1] != self.template else pair[::-1]
        if source in dict(self.left.options).values() and target in self.names:
            self.show_pair(source, target)

    def show_pair(self, source: str, shape: str) -> None:
        """Show two shapes and draw them once."""
        with self.hold_trait_notifications():
            self.source, self.shape = source, shape

    def change_pair(self) -> None:
        """Draw the pair if it has changed."""
        if self.shown != (self.source, self.shape):
            self.draw()

    @property
    def registered(self) -> bool:
        """True if the match of the registration is shown."""
        return self.map.value == "registered"

    @property
    def source_text(self) -> str:
        """The source as text."""
        return "the template" if self.from_template else self.source

    @property
    def from_template(self) -> bool:
        """True if the template is on the left."""
        return self.source == self.template

    def match(self) -> Array:
        """Return the matched vertex of the shape for each vertex of the source; -1 for none."""
        if self.registered:
            if self.from_template:
                return self.registered_match(self.shape)
            return nearest_corner(*self.points_on(self.source, self.shape))
        key = self.source, self.shape, self.map.value
        if key not in self.matches:
            full = self.map.value == "dense"
            found = latent_match(self.study, self.shape, self.source, full=full)
            self.matches[key] = found["match"].values
        return self.matches[key]

    def reverse_match(self) -> Array:
        """Return the matched vertex of the source for each vertex of the shape; -1 for none."""
        Y = self.pair[1][0]
        if not self.registered:
            return inverse(self.match(), len(Y))
        if not self.from_template:
            return nearest_corner(*self.points_on(self.shape, self.source))
        vertices = template_vertices(self.study, self.shape)
        return inverse(self.registered_match(self.shape), len(Y)) if vertices is None else vertices

    def points_on(self, source: str, target: str) -> tuple[Array, Array]:
        """Return corners and weights ``(n, 3)`` of the images of the source's vertices."""
        if (source, target) not in self.points:
            found = correspondence(self.study, source, target)
            T = mesh_of(self.study["original"][target].dataset)[1]
            corners = T[found["image_triangle"].values]
            self.points[source, target] = corners, found["image_barycentric"].values
        return self.points[source, target]

    def registered_match(self, name: str) -> Array:
        """Return the matched vertex of a shape for each vertex of the template."""
        return self.study["registration"].dataset["registered_match"].sel(shape=name).values

    def transferred(self, values: Array) -> Array | None:
        """Return values of the source's vertices on those of the shape, through the template."""
        if not self.from_template:
            corners, weights = self.points_on(self.shape, self.source)
            return np.einsum("nc,ncx->nx", weights, values[corners])
        transferred = transferred_colors(self.study, self.shape, values)
        return None if transferred is None else transferred[2]

    def confidence(self) -> Array | None:
        """Return the registration's confidence on the template; None for other maps."""
        known = "confidence" in self.study["registration"].data_vars
        if not (known and self.registered and self.from_template):
            return None
        return self.study["registration"].dataset["confidence"].sel(shape=self.shape).values

    def draw(self) -> None:
        """Draw both surfaces and their colours."""
        self.shown = self.source, self.shape
        self.vertex = self.image = -1
        stage = "coarse" if self.map.value == "low" else "original"
        if self.registered and self.from_template:
            source = mesh_of(self.study["registration"].dataset)
        else:
            source = surface(self.study, self.source, stage)
        self.pair = source, surface(self.study, self.shape, stage)
        appearance = self.registered_colors() if self.registered else self.latent_colors()
        colors, coordinates, bar, caption = appearance
        cell = round_down(extent(source[0]) / CELLS)
        if coordinates[0] is not None:
            unit = unit_text(self.study, self.source)
            caption += f"; checkerboard of cubes of {cell:g} ({unit})"
        titles = self.source + ", the template" * self.from_template, self.shape
        for i, scene in enumerate(self.scenes):
            X, T = self.pair[i]
            scene.show(X, T, title=f"{titles[i]}, {len(X):,} vertices")
            scene.paint(colors[i], bar, coordinates[i], cell)
            scene.caption = caption
        # the browser marks the images of vertices without the kernel
        reverse, confidence = self.reverse_match(), self.confidence()
        on_shape = None if confidence is None else confidence[reverse] * (reverse >= 0)
        self.scenes[0].connect(self.match(), self.match_text("{here}", "{there}"), confidence)
        self.scenes[1].connect(reverse, self.match_text("{there}", "{here}"), on_shape)

    def latent_colors(self) -> tuple:
        """Return colours and coordinates of both surfaces, a colour bar and a caption.

        The coordinates of the shape are transferred to the source.
        """
        Y, match = self.pair[1][0], self.match()
        caption = f"the shape's coordinates, transferred to {self.source_text}"
        if self.colors.value == "confidence":
            caption = f"the confidence belongs to the registration; here {caption}"
        colors = position_colors(Y)
        coordinates = (Y[match], Y) if self.colors.value == "checker" else (None, None)
        return (colors[match], colors), coordinates, None, caption

    def registered_colors(self) -> tuple:
        """Return the same for the registration: the source's, transferred to the shape."""
        X, value, shown = self.pair[0][0], self.confidence(), self.colors.value
        colors, coordinates, bar = position_colors(X), (None, None), None
        caption = f"the coordinates of {self.source_text}, transferred to the shape"
        caption += "" if self.from_template else " through the template"
        if shown == "checker":
            on_shape = self.transferred(X)
            coordinates = X, None if on_shape is None else np.nan_to_num(on_shape)
        elif shown == "confidence" and value is None:
            caption = f"the confidence belongs to the registration of the template; here {caption}"
        elif shown == "confidence":
            colors = ramp_colors(value, 0, 1)
            bar = color_scale("viridis", 0, 1, f"confidence, {value.mean():.2f} on average")
            caption = "the registration's confidence, transferred to the shape; among shapes in "
            caption += "similar poses it does not rank the points by their error"
        return (colors, self.transferred(colors)), coordinates, bar, caption

    def match_text(self, vertex: object, image: object) -> str:
        """Return the text for a vertex of the source and its image."""
        left = "template" if self.from_template else self.source
        return f"{left} vertex {vertex} ↔ {self.shape} vertex {image}"

    def to_shape(self, picked: dict) -> None:
        """Mark a picked vertex of the source and its image on the shape."""
        self.vertex, self.image = picked["vertex"], int(self.match()[picked["vertex"]])
        self.mark_pair(self.image, self.shape, f"vertex {self.vertex} of {self.source}")

    def to_source(self, picked: dict) -> None:
        """Mark a picked vertex of the shape and its match on the source."""
        self.vertex, self.image = int(self.reverse_match()[picked["vertex"]]), picked["vertex"]
        self.mark_pair(self.vertex, self.source_text, f"vertex {self.image} of {self.shape}")

    def mark_pair(self, matched: int, other: str, picked: str) -> None:
        """Mark the vertex and its image, or report that nothing is `matched` (-1)."""
        if matched < 0:
            self.show_message(f"no vertex of {other} is matched to {picked}")
            return
        text, confidence = self.match_text(self.vertex, self.image), self.confidence()
        if confidence is not None:
            text += f", confidence {confidence[self.vertex]:.2f}"
        vertices = self.vertex, self.image
        for scene, (X, _), vertex in zip(self.scenes, self.pair, vertices, strict=True):
            scene.mark(X[vertex])
            scene.caption = text
