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
    back = np.full(n, -1)
    back[match[::-1]] = np.arange(len(match))[::-1]  # the first of several stays
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

    def build(self, view: str = "corner", up: str = "z") -> list[ipywidgets.Widget]:
        """Choices and the two surfaces."""
        registration = self.study["registration"].dataset
        self.template = str(registration.attrs["template"])
        names = [name for name in names_of(registration) if name != self.template]
        latent = has(self.study, "latent/latent_basis") and has(self.study, "coarse")
        latent = latent and self.template in self.study["coarse"].children
        options = [(f"{self.template}, the template", self.template), *labelled(self.study, names)]
        self.left = dropdown("source", "the shape on the left", options)
        self.choice = dropdown("shape", "the shape on the right", labelled(self.study, names))
        self.names, self.pair_of_tabs, self.shown = names, ("", ""), ("", "")
        self.map = dropdown("map", WHICH, MAPS if latent else MAPS[:1], layout={"width": "28em"})
        self.colors = dropdown("colours", COLORS, SHOWN, layout={"width": "24em"})
        self.hover = check("follow the pointer", FOLLOW, True)
        look = {"group": camera_group(), "view": view, "up": up, "height": 400, "clickable": True}
        self.scenes = [Scene(**look), Scene(**look)]
        self.matches = {}  # (shape, map) -> match
        self.on_change(self.left, lambda value: self.set_trait("source", value))
        self.on_change(self.choice, lambda value: self.set_trait("shape", value))
        self.redraw(self.draw, self.map, self.colors)
        self.on_change(self.hover, self.follow)
        for scene, carry in zip(self.scenes, (self.to_shape, self.to_source), strict=True):
            self.on_pick(scene, carry, "picked", "hovered")
        for name in ("source", "shape"):
            self.on_change(self, lambda _: self.change_pair(), name)
        self.show_pair(self.template, names[0])
        self.follow(True)
        choices = row(self.left, self.choice, self.map)
        return [choices, row(self.colors, self.hover), beside(*self.scenes)]

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

    def follow(self, on: bool) -> None:
        """Whether points under the pointer are carried, and not only clicked ones."""
        for scene in self.scenes:
            scene.hovering = bool(on)

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
        carried = carried_colors(self.study, self.shape, values)
        return None if carried is None else carried[2]

    def confidence(self) -> np.ndarray | None:
        """The registration's confidence on the vertices of the template; None for other maps."""
        known = "confidence" in self.study["registration"].data_vars
        if not (known and self.registered and self.from_template):
            return None
        return self.study["registration"].dataset["confidence"].sel(shape=self.shape).values

    def draw(self) -> None:
        """Both surfaces with their colours."""
        self.shown = self.left.value, self.choice.value = self.source, self.shape
        self.vertex = self.image = -1
        stage = "coarse" if self.map.value == "low" else "original"
        source = surface(self.study, self.source, stage)
        if self.registered and self.from_template:
            source = mesh_of(self.study["registration"].dataset)
        self.pair = source, surface(self.study, self.shape, stage)
        colors, coordinates, bar, caption = (
            self.registered_look() if self.registered else self.latent_look()
        )
        cell = round_number(extent(source[0]) / CELLS)
        if coordinates[0] is not None:
            unit = unit_text(self.study, self.source)
            caption += f"; checkerboard of cubes of {cell:g} ({unit})"
        titles = self.source + ", the template" * self.from_template, self.shape
        for i, scene in enumerate(self.scenes):
            X, T = self.pair[i]
            scene.show(X, T, title=f"{titles[i]}, {len(X):,} vertices")
            scene.paint(colors[i], bar, coordinates[i], cell)
            scene.caption = caption
        self.connect()

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
        X, value = self.pair[0][0], self.confidence()
        colors, coordinates, bar = position_colors(X), (None, None), None
        caption = f"the coordinates of {self.on_left}, transferred to the shape"
        caption += "" if self.from_template else " by way of the template"
        if self.colors.value == "confidence" and value is None:
            caption = f"the confidence belongs to the registration of the template; here {caption}"
        elif self.colors.value == "confidence":
            colors = ramp_colors(value, 0, 1)
            bar = color_scale("viridis", 0, 1, f"confidence, {value.mean():.2f} on average")
            caption = "the registration's confidence, transferred to the shape"
        if self.colors.value == "checker":
            carried = self.carried(X)
            coordinates = X, None if carried is None else np.nan_to_num(carried)
        return (colors, self.carried(colors)), coordinates, bar, caption

    def linked(self, here: object, there: object) -> str:
        """A vertex of the source and its image in words."""
        left = "template" if self.from_template else self.source
        return f"{left} vertex {here} ↔ {self.shape} vertex {there}"

    def connect(self) -> None:
        """Give the browser the images of all vertices, so that it marks them by itself."""
        back, sure = self.way_back(), self.confidence()
        sure_back = None if sure is None else sure[back] * (back >= 0)
        self.scenes[0].connect(self.match(), self.linked("{here}", "{there}"), sure)
        self.scenes[1].connect(back, self.linked("{there}", "{here}"), sure_back)

    def to_shape(self, place: dict) -> None:
        """A place of the source: its image on the shape."""
        vertex = place.get("vertex", -1)
        if vertex < 0:
            return
        self.vertex, self.image = vertex, int(self.match()[vertex])
        if self.image < 0:
            self.say(f"no vertex of {self.shape} is matched to vertex {vertex} of {self.source}")
        else:
            self.point()

    def to_source(self, place: dict) -> None:
        """A place of the shape: where it lies on the source."""
        vertex = place.get("vertex", -1)
        if vertex < 0:
            return
        self.vertex, self.image = int(self.way_back()[vertex]), vertex
        if self.vertex < 0:
            self.say(f"no vertex of {self.on_left} is matched to vertex {vertex} of {self.shape}")
        else:
            self.point()

    def point(self) -> None:
        """Mark the vertex and its image, and say which they are."""
        text = self.linked(self.vertex, self.image)
        sure = self.confidence()
        if sure is not None:
            text += f", confidence {sure[self.vertex]:.2f}"
        vertices = self.vertex, self.image
        for scene, (X, _), vertex in zip(self.scenes, self.pair, vertices, strict=True):
            scene.mark(X[vertex])
            scene.caption = text
