"""A region of the template (6.1), selected on its surface, for statistics within it."""

import ipywidgets
import numpy as np

from s4a.geometry.mesh import vertex_areas
from s4a.show.draw import CLAY, vertices_within
from s4a.show.surfaces import label_text
from s4a.widgets.panel import WIDE, Panel, dropdown, row
from s4a.widgets.views import MARK

ADD, REMOVE = "add", "remove"
LASSO = "select vertices by dragging around them, instead of rotating the surface"
ACTION = "add the visible vertices inside the lasso to the region, or remove them"
NO_LABEL = ()  # the value of "none" in the list, which cannot hold None
LABEL = "replace the region by a label of the template"


class Region(Panel):
    """A region of the template, selected with a lasso or by a label.

    Parameters
    ----------
    study : xarray.DataTree
        With a registration.
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.

    Attributes
    ----------
    region : bool ndarray (vertex,)
        Mask of the selected vertices of the template, for :func:`s4a_morphometrics.within`.

    See Also
    --------
    s4a_morphometrics.within : a study restricted to a region.

    Examples
    --------
    With a study of six small brains; the square is a lasso selection:

    >>> import s4a
    >>> from s4a_morphometrics import Region, within
    >>> study = s4a.synthetic.example_study()
    >>> panel = Region(study, view="top")
    >>> square = [[0, -99], [99, -99], [99, 99], [0, 99]]
    >>> panel.scene.drawn_around = {"polygon": square, "rotation": panel.scene.rotation, "count": 1}
    >>> right = within(study, panel.region)
    >>> bool(right["registration"]["position"].values[:, 0].min() >= 0)
    True
    >>> panel.close()
    """

    needs = ("registration/position",)
    title = "Region"
    python = ("drawing a region",)

    def build(self) -> list[ipywidgets.Widget]:
        """Return the controls and the view of the surface."""
        template = self.study["registration"].dataset
        self.X, self.T = template["position"].values, template["corner_vertex"].values
        self.area = vertex_areas(self.X, self.T)
        self.action, auto = dropdown("action", ACTION, [ADD, REMOVE]), {"layout": {"width": "auto"}}
        self.lasso = ipywidgets.ToggleButton(description="lasso", tooltip=LASSO, **auto)
        self.none = self.button("clear", self.clear, "select no vertex", **auto)
        self.others = self.button("invert", self.invert, "select all other vertices", **auto)
        controls = [self.lasso, self.action, self.none, self.others]
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
        """Return a list of the template's labels; None if it has none."""
        mesh = self.study["original"].get(name)
        if mesh is None or "label" not in mesh:
            return None
        self.labels = mesh["label"].values
        labels = [(label_text(mesh, label), label) for label in np.unique(self.labels).tolist()]
        options = [("none", NO_LABEL), *labels]
        return dropdown("label", LABEL, options, value=NO_LABEL, layout=WIDE)

    def take_label(self, label: object) -> None:
        """Select the vertices of a label."""
        if label != NO_LABEL:
            self.set_region(self.labels == label)

    def take_drawn(self, drawn: dict) -> None:
        """Add or remove the vertices inside the lasso."""
        within = vertices_within(self.X, self.T, drawn["polygon"], drawn["rotation"])
        if not within.any():
            self.show_message("no visible vertex is inside the lasso; draw around some vertices")
            return
        self.show_message("")
        added = self.action.value == ADD
        self.set_region(self.region | within if added else self.region & ~within, NO_LABEL)

    def clear(self) -> None:
        """Select no vertex."""
        self.set_region(np.zeros(len(self.X), bool), NO_LABEL)

    def invert(self) -> None:
        """Select all other vertices."""
        self.set_region(~self.region, NO_LABEL)

    def set_region(self, region: np.ndarray, label: object = None) -> None:
        """Set and show the region, a mask ``(n,)``; `label` is NO_LABEL if it is not a label's."""
        if self.label is not None and label is not None:
            self.label.value = label
        self.region = region
        self.scene.paint(np.where(region[:, None], MARK, CLAY))
        share = self.area[region].sum() / self.area.sum()
        self.scene.caption = (
            f"{region.sum():,} of {len(region):,} vertices, {share:.1%} of the area: "
            "s4a_morphometrics.within(study, panel.region)"
        )
