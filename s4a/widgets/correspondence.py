"""Correspondence (eq. 3, 6, 7): colours, texture and points, carried between two surfaces."""

import ipywidgets
import numpy as np
import traitlets

from s4a.show.browser import color_scale
from s4a.show.draw import position_colors, ramp_colors
from s4a.show.surfaces import (
    has,
    labelled,
    latent_match,
    mesh_of,
    names_of,
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
SHOWN = [("coordinates", "place"), ("checkerboard", "checker"), ("confidence", "confidence")]
WHICH = "the registered surface, or nearest rows of the latent basis at either resolution"
COLORS = (
    "what is carried between the surfaces: coordinates, a checkerboard, or the registration's "
    "confidence from 0 to 1"
)
CELLS = 14  # of the checkerboard along the surface's extent


def chain(first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """One match after another, -1 where the first has none.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.correspondence import chain
    >>> chain(np.array([1, -1, 0]), np.array([7, 8])).tolist()
    [8, -1, 7]
    """
    return np.where(first < 0, -1, then[first])


def inverse(match: np.ndarray, n: int) -> np.ndarray:
    """For each of `n` vertices the first that is matched to it, -1 for none.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.correspondence import inverse
    >>> inverse(np.array([2, 0, 2]), 4).tolist()
    [1, -1, 0, -1]
    """
    back, known = np.full(n, -1), np.flatnonzero(match >= 0)[::-1]
    back[match[known]] = known  # the first of several stays
    return back


class Correspondence(Panel):
    """Two linked surfaces: a point under the pointer, or clicked, is shown at its image.

    The keyboard does the same: C starts a cursor that the arrow keys move over the surface.

    Attributes
    ----------
    source : str
        The shape on the left: the template, or another one, whose registered match leads by way of
        the template.
    shape : str
        The shape on the right.
    vertex, image : int
        The vertex of the source that was clicked last, and its image on the shape; -1 for none.
    """

    needs = ("registration/position", "registration/registered_match")
    title = "Correspondence"
    source, shape = traitlets.Unicode(""), traitlets.Unicode("")
    vertex, image = traitlets.Int(-1), traitlets.Int(-1)
    live = (("colors", "choice"), ("hover",))
    shares = ("source", "shape")

    def build(self) -> list[ipywidgets.Widget]:
        """Choices and the two surfaces."""
        registration = self.study["registration"].dataset
        self.template = str(registration.attrs["template"])
        self.names = [name for name in names_of(registration) if name != self.template]
        latent = has(self.study, "latent/latent_basis") and has(self.study, "coarse")
        latent = latent and self.template in self.study["coarse"].children
        shapes = labelled(self.study, self.names)
        options = [(f"{self.template}, the template", self.template), *shapes]
        self.left = dropdown("source", "the shape on the left", options)
        self.choice = dropdown("shape", "the shape on the right", shapes)
        self.map = dropdown("map", WHICH, MAPS if latent else MAPS[:1], layout={"width": "28em"})
        self.colors = dropdown("colours", COLORS, SHOWN, layout={"width": "24em"})
        self.scenes = [self.new_scene(400, clickable=True) for _ in range(2)]
        self.hover = self.follow()
        self.pair_of_tabs, self.shown = ("", ""), ("", "")
        self.matches = {}  # (shape, map) -> match
        self.bind(self.left, "source")
        self.bind(self.choice, "shape")
        self.redraw(self.draw, self.map, self.colors)
        for scene, carry in zip(self.scenes, (self.to_shape, self.to_source), strict=True):
            self.on_pick(scene, carry, "picked", "hovered")
        self.redraw(self.change_pair, "source", "shape")
        self.show_pair(self.template, self.names[0])
        choices = row(self.left, self.choice, self.map)
        return [choices, row(self.colors, self.hover), columns(*self.scenes)]

    def selection(self) -> dict:
        """The pair that is shown, in the direction in which another tab has it."""
        shown = self.source, self.shape
        same = set(shown) == set(self.pair_of_tabs)
        return {"pair": self.pair_of_tabs if same else shown}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show a pair of registered shapes, the template on the left where it is one of them."""
        self.pair_of_tabs = pair
        source, target = pair if pair[1] != self.template else pair[::-1]
        if source in (self.template, *self.names) and target in self.names:
            self.show_pair(source, target)

    def show_pair(self, source: str, shape: str) -> None:
        """Show two shapes, drawn once."""
        with self.hold_trait_notifications():
            self.source, self.shape = source, shape

    def change_pair(self) -> None:
        """Draw the pair, where it is another one."""
        if self.shown != (self.source, self.shape):
            self.draw()

    @property
    def registered(self) -> bool:
        """Whether the match of the registration is shown."""
        return self.map.value == "registered"

    @property
    def on_left(self) -> str:
        """The source in words."""
        return "the template" if self.from_template else self.source

    @property
    def from_template(self) -> bool:
        """Whether the template is on the left."""
        return self.source == self.template

    def match(self) -> np.ndarray:
        """On each vertex of the source that is shown, the vertex of the shape; -1 for none."""
        if self.registered:
            match = self.registered_match(self.shape)
            if not self.from_template:
                match = chain(self.onto_template(self.source, self.pair[0][0]), match)
            return match
        key = self.source, self.shape, self.map.value
        if key not in self.matches:
            dense = self.map.value == "dense"
            self.matches[key] = latent_match(self.study, self.shape, self.source, dense=dense)
        return self.matches[key]

    def way_back(self) -> np.ndarray:
        """On each vertex of the shape the vertex of the source that lies there, -1 for none."""
        Y = self.pair[1][0]
        if not self.registered:
            return inverse(self.match(), len(Y))
        back = self.onto_template(self.shape, Y)
        return back if self.from_template else chain(back, self.registered_match(self.source))

    def registered_match(self, name: str) -> np.ndarray:
        """On each vertex of the template the vertex of a shape that is registered to it."""
        return self.study["registration"].dataset["registered_match"].sel(shape=name).values

    def onto_template(self, name: str, X: np.ndarray) -> np.ndarray:
        """On each vertex of a shape, which are `X`, that of the template there; -1 for none."""
        vertices = template_vertices(self.study, name)
        return inverse(self.registered_match(name), len(X)) if vertices is None else vertices

    def carried(self, values: np.ndarray) -> np.ndarray | None:
        """Values of the source's vertices on those of the shape, by way of the template."""
        if not self.from_template:
            values = values[self.registered_match(self.source)]
        carried = transferred_colors(self.study, self.shape, values)
        return None if carried is None else carried[2]

    def confidence(self) -> np.ndarray | None:
        """The registration's confidence on the vertices of the template; None for other maps."""
        known = "confidence" in self.study["registration"].data_vars
        if not (known and self.registered and self.from_template):
            return None
        return self.study["registration"].dataset["confidence"].sel(shape=self.shape).values

    def draw(self) -> None:
        """Both surfaces with their colours."""
        self.shown = self.source, self.shape
        self.vertex = self.image = -1
        stage = "coarse" if self.map.value == "low" else "original"
        source = surface(self.study, self.source, stage)
        if self.registered and self.from_template:
            source = mesh_of(self.study["registration"].dataset)
        self.pair = source, surface(self.study, self.shape, stage)
        look = self.registered_look() if self.registered else self.latent_look()
        colors, coordinates, bar, caption = look
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
        # the browser marks the images of vertices by itself
        back, sure = self.way_back(), self.confidence()
        sure_back = None if sure is None else sure[back] * (back >= 0)
        self.scenes[0].connect(self.match(), self.linked("{here}", "{there}"), sure)
        self.scenes[1].connect(back, self.linked("{there}", "{here}"), sure_back)

    def latent_look(self) -> tuple:
        """Colours and coordinates of both surfaces, the colour bar, and what they are.

        Those of the shape are pulled to the source.
        """
        Y, match = self.pair[1][0], self.match()
        caption = f"the shape's coordinates, pulled to {self.on_left}"
        if self.colors.value == "confidence":
            caption = f"the confidence belongs to the registration; here {caption}"
        colors = position_colors(Y)
        coordinates = (Y[match], Y) if self.colors.value == "checker" else (None, None)
        return (colors[match], colors), coordinates, None, caption

    def registered_look(self) -> tuple:
        """The same of the registration: the source's, transferred to the shape."""
        X, value, shown = self.pair[0][0], self.confidence(), self.colors.value
        colors, coordinates, bar = position_colors(X), (None, None), None
        caption = f"the coordinates of {self.on_left}, transferred to the shape"
        caption += "" if self.from_template else " by way of the template"
        if shown == "checker":
            carried = self.carried(X)
            coordinates = X, None if carried is None else np.nan_to_num(carried)
        elif shown == "confidence" and value is None:
            caption = f"the confidence belongs to the registration of the template; here {caption}"
        elif shown == "confidence":
            colors = ramp_colors(value, 0, 1)
            bar = color_scale("viridis", 0, 1, f"confidence, {value.mean():.2f} on average")
            caption = "the registration's confidence, transferred to the shape"
        return (colors, self.carried(colors)), coordinates, bar, caption

    def linked(self, here: object, there: object) -> str:
        """A vertex of the source and its image in words."""
        left = "template" if self.from_template else self.source
        return f"{left} vertex {here} ↔ {self.shape} vertex {there}"

    def to_shape(self, place: dict) -> None:
        """A place of the source: its image on the shape."""
        self.vertex, self.image = place["vertex"], int(self.match()[place["vertex"]])
        self.point(self.image, self.shape, f"vertex {self.vertex} of {self.source}")

    def to_source(self, place: dict) -> None:
        """A place of the shape: where it lies on the source."""
        self.vertex, self.image = int(self.way_back()[place["vertex"]]), place["vertex"]
        self.point(self.vertex, self.on_left, f"vertex {self.image} of {self.shape}")

    def point(self, found: int, other: str, place: str) -> None:
        """Mark the vertex and its image, and say which they are, or that nothing was `found`."""
        if found < 0:
            self.show_message(f"no vertex of {other} is matched to {place}")
            return
        text, sure = self.linked(self.vertex, self.image), self.confidence()
        if sure is not None:
            text += f", confidence {sure[self.vertex]:.2f}"
        vertices = self.vertex, self.image
        for scene, (X, _), vertex in zip(self.scenes, self.pair, vertices, strict=True):
            scene.mark(X[vertex])
            scene.caption = text
