"""A region of the template (6.1), drawn around on its surface, for statistics within it."""

import ipywidgets
import numpy as np

from s4a.geometry.mesh import vertex_areas
from s4a.show.draw import CLAY, vertices_within
from s4a.show.surfaces import label_text
from s4a.widgets.panel import WIDE, Panel, dropdown, row
from s4a.widgets.views import MARK

ADD, REMOVE = "add", "take away"
LASSO = "while it is pressed a drag draws around vertices, and does not turn the surface"
HOW = "what happens to the vertices that are drawn around, of those that are seen"
NO_LABEL = ()  # the value of "none" in the list, which cannot hold None
LABEL = "the region of a label of the template, to begin with"


class Region(Panel):
    """A region of the template: draw around vertices, or take a label.

    Parameters
    ----------
    study : xarray.DataTree
        With a registration.
    view, up
        From where the surface is seen first; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    region : bool ndarray (vertex,)
        The chosen vertices of the template, as :func:`s4a_morphometrics.within` takes them.

    Examples
    --------
    With the ``study`` of six small brains; the square is what a drag draws:

    >>> import s4a
    >>> from s4a_morphometrics import Region, within
    >>> study = s4a.synthetic.example_study()
    >>> panel = Region(study, view="top")
    >>> square = [[0, -99], [99, -99], [99, 99], [0, 99]]
    >>> panel.scene.drawn_around = {"polygon": square, "turn": panel.scene.turn, "count": 1}
    >>> right = within(study, panel.region)
    >>> bool(right["registration"]["position"].values[:, 0].min() >= 0)
    True
    >>> panel.close()
    """

    needs = ("registration/position",)
    title = "Region"
    python = ("drawing a region",)

    def build(self) -> list[ipywidgets.Widget]:
        """The surface, and what a drag does."""
        template = self.study["registration"].dataset
        self.X, self.T = template["position"].values, template["corner_vertex"].values
        self.area = vertex_areas(self.X, self.T)
        self.how, own = dropdown("drawn", HOW, [ADD, REMOVE]), {"layout": {"width": "auto"}}
        self.lasso = ipywidgets.ToggleButton(description="lasso", tooltip=LASSO, **own)
        self.none = self.button("nothing", self.clear, "choose no vertex", **own)
        self.others = self.button("others", self.invert, "choose all other vertices", **own)
        controls = [self.lasso, self.how, self.none, self.others]
        self.label = self._labels(template.attrs["template"])
        if self.label is not None:
            controls.insert(0, self.label)
            self.on_change(self.label, self.take_label)
        title = f"{template.attrs['template']}, the template"
        self.scene = self.new_scene(420, title=title)
        self.scene.show(self.X, self.T)
        ipywidgets.link((self.lasso, "value"), (self.scene, "lasso"))
        self.on_change(self.scene, self.take_drawn, "drawn_around")
        self.clear()
        return [row(*controls), self.scene]

    def _labels(self, name):
        """A list of the template's labels; None where it has none."""
        mesh = self.study["original"].get(name)
        if mesh is None or "label" not in mesh:
            return None
        self.labels = mesh["label"].values
        labels = [(label_text(mesh, one), one) for one in np.unique(self.labels).tolist()]
        options = [("none", NO_LABEL), *labels]
        return dropdown("label", LABEL, options, value=NO_LABEL, layout=WIDE)

    def take_label(self, label: object) -> None:
        """The vertices of a label that was chosen from the list."""
        if label != NO_LABEL:
            self.take(self.labels == label)

    def take_drawn(self, drawn: dict) -> None:
        """The vertices that were drawn around are added, or taken away."""
        within = vertices_within(self.X, self.T, drawn["polygon"], drawn["turn"])
        if not within.any():
            self.say("no vertex is seen within what was drawn")
            return
        self.say("")
        self.take(
            self.region | within if self.how.value == ADD else self.region & ~within, NO_LABEL
        )

    def clear(self) -> None:
        """Choose no vertex."""
        self.take(np.zeros(len(self.X), bool), NO_LABEL)

    def invert(self) -> None:
        """Choose all other vertices."""
        self.take(~self.region, NO_LABEL)

    def take(self, region: np.ndarray, label: object = None) -> None:
        """Make these vertices ``(n,)`` the region, and show it; `label` where it is of none."""
        if self.label is not None and label is not None:
            self.label.value = label
        self.region = region
        self.scene.paint(np.where(region[:, None], MARK, CLAY))
        share = self.area[region].sum() / self.area.sum()
        self.scene.caption = (
            f"{region.sum():,} of {len(region):,} vertices, {share:.1%} of the area: "
            "s4a_morphometrics.within(study, panel.region)"
        )
