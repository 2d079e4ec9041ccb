"""Transfer (6.2, Fig. 6 and 7) of labels and landmarks from one shape to another."""

import itertools
from pathlib import Path

import ipywidgets
import numpy as np
import traitlets
import xarray as xr
from matplotlib.colors import to_hex

from s4a.analysis.transfer import transfer_labels, transfer_landmarks
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import write_landmarks
from s4a.schema import dataset
from s4a.show.browser import PARTS
from s4a.show.draw import label_colors
from s4a.show.surfaces import aligned, label_text, labelled, names_of, unit_text
from s4a.widgets.panel import Panel, checkbox, columns, dropdown, file_name, row
from s4a.widgets.views import extent, round_down

COLUMNS = ["name", "x", "y", "z", "confidence"]
SOURCE, TARGET = "the shape with labels and landmarks", "the shape that they are transferred to"
NAME = "the landmark that the next click on the source places or moves"
REMOVE, SAVE = "remove the named landmark", "write the landmarks on the target"
LEGEND = 24  # labels with different colours


class Transfer(Panel):
    """Labels as colours and landmarks as spheres on two shapes.

    A click on the source places or moves a landmark.  With the keyboard, C on the source starts a
    cursor, the arrow keys move it over the surface, and Enter places the landmark.

    Attributes
    ----------
    source, target : str
        Shapes of the study; the source is initially the template.
    landmark : str
        The landmark that the next click on the source places.

    See Also
    --------
    s4a.transfer_labels, s4a.transfer_landmarks : the same in code.
    """

    needs = ("registration/position", "registration/registered_match")
    title = "Transfer"
    source, target, landmark = (traitlets.Unicode("") for _ in range(3))
    live = (("labels", "target"),)
    python = ("placing landmarks",)

    def build(self) -> list[ipywidgets.Widget]:
        """Return the controls, the views of the two surfaces, the legend and the table."""
        registration = self.study["registration"].dataset
        names, template = names_of(registration), str(registration.attrs["template"])
        added = [template] if template in self.study["original"].children else []
        sources = list(dict.fromkeys([*names, *added]))  # inserted shapes are without the template
        source = template if template in sources else names[0]
        others = [name for name in names if name != source]
        if not others:
            raise ValueError(
                f"the panel {self.title} needs a second shape to transfer to; this study has only "
                f"{source}, without the mesh of its template {template}: add shapes to the study"
            )
        shapes = labelled(self.study, sources), labelled(self.study, names)
        self.choices = {
            "source": dropdown("source", SOURCE, shapes[0], value=source),
            "target": dropdown("target", TARGET, shapes[1]),
        }
        self.labels = checkbox("labels", "colour both surfaces by the labels of the source", True)
        texts = {"description": "landmark", "placeholder": "a name, then click", "tooltip": NAME}
        self.name = ipywidgets.Combobox(**texts)
        self.remove = self.button("Remove", lambda: self.remove_landmark(self.landmark), REMOVE)
        self.radius = ipywidgets.BoundedFloatText(
            round_down(extent(registration["position"].values) / 60),
            min=0,
            max=1e9,
            step=0.5,
            description=f"radius ({unit_text(self.study, template)})",
            style={"description_width": "initial"},
            tooltip="radius of the spheres that mark landmarks",
            layout={"width": "24em"},
        )
        self.path = file_name("landmarks.csv")
        self.csv = self.save_button("Save CSV", lambda: self.save_csv(self.path.value), SAVE)
        self.legend, self.table = ipywidgets.HTML(), ipywidgets.HTML()
        self.scenes = [self.new_scene(380, clickable=True), self.new_scene(380)]
        self.on_change(self, self.load_landmarks, "source")
        for role, choice in self.choices.items():
            self.bind(choice, role)
        self.redraw(self.draw, "source", "target")
        self.redraw(self.paint, self.labels)
        self.redraw(self.draw_landmarks, self.radius)
        traitlets.link((self.name, "value"), (self, "landmark"))
        self.on_pick(self.scenes[0], self.place_landmark)
        with self.hold_trait_notifications():
            self.source, self.target = source, others[0]
        return [
            row(*self.choices.values(), self.labels),
            row(self.name, self.remove, self.radius, self.path, self.csv),
            columns(*self.scenes),
            self.legend,
            self.table,
        ]

    def control(self, name: str) -> ipywidgets.Widget:
        """Return the control of a name in `live`."""
        return self.choices.get(name) or super().control(name)

    def mesh(self, name: str) -> xr.Dataset:
        """Return the mesh of a shape, in its own coordinates."""
        return self.study["original"][name].to_dataset()

    def load_landmarks(self, source: str) -> None:
        """Load the landmarks that the source has in the study."""
        mesh = self.mesh(source)
        self.marks = {}  # name -> position (3,) on the source, in its own coordinates
        if "landmark_position" in mesh:
            names = mesh["landmark_name"].values.astype(str).tolist()
            self.marks = dict(zip(names, mesh["landmark_position"].values, strict=True))

    def draw(self) -> None:
        """Draw both surfaces and their landmarks."""
        if not self.source or not self.target:
            return
        for scene, role in zip(self.scenes, ("source", "target"), strict=True):
            name = getattr(self, role)
            X, T = as_arrays(self.mesh(name))
            title = f"{name}, the {role}, {len(X):,} vertices"
            scene.show(aligned(self.study, name, X), T, title=title)
        self.paint()
        self.draw_landmarks()

    def paint(self) -> None:
        """Colour both surfaces by the source's labels, and draw the legend."""
        mesh = self.mesh(self.source)
        self.legend.value = ""
        if "label" not in mesh:
            self.legend.value = PARTS.paragraph(f"{self.source} has no labels.")
        if "label" not in mesh or not self.labels.value:
            for scene in self.scenes:
                scene.paint(None)
                scene.caption = ""
            return
        here = mesh["label"].values
        on_target = transfer_labels(self.study, here, source=self.source, targets=[self.target])
        self.transferred = on_target[self.target].dataset
        there, confidence = (self.transferred[key].values for key in ("label", "confidence"))
        values = np.unique(here)
        colors = label_colors(values)  # in the order of the values, so that both surfaces agree
        for scene, label in zip(self.scenes, (here, there), strict=True):
            scene.paint(colors[np.searchsorted(values, label)])
        self.scenes[
            1
        ].caption = (
            f"labels transferred from {self.source}, mean confidence {confidence.mean():.2f}"
        )
        labels = [
            {"name": label_text(mesh, value), "color": to_hex(color)}
            | {"here": f"{np.mean(here == value):.1%}", "there": f"{np.mean(there == value):.1%}"}
            for value, color in zip(values, colors, strict=True)
        ]
        self.legend.value = PARTS.legend(labels, len(values) > LEGEND)

    def place_landmark(self, picked: dict) -> None:
        """Place the named landmark, or one with a new name, at a picked point of the source."""
        free = (f"landmark {i}" for i in itertools.count(len(self.marks) + 1))
        name = self.landmark or next(name for name in free if name not in self.marks)
        X, T = as_arrays(self.mesh(self.source))
        self.marks[name] = np.asarray(picked["weights"]) @ X[T[picked["face"]]]
        self.draw_landmarks()

    def remove_landmark(self, name: str) -> None:
        """Remove a landmark."""
        if self.marks.pop(name, None) is None:
            raise ValueError(f"no landmark {name!r}; there are {', '.join(self.marks) or 'none'}")
        self.landmark = ""
        self.draw_landmarks()

    def landmarks(self) -> xr.Dataset | None:
        """Transfer the landmarks to the target (:func:`s4a.transfer_landmarks`); None if none."""
        if not self.marks:
            return None
        positions = np.stack(list(self.marks.values()))
        marked = dataset(landmark_name=list(self.marks), landmark_position=positions)
        tree = transfer_landmarks(self.study, marked, source=self.source, targets=[self.target])
        return tree[self.target].to_dataset()

    def draw_landmarks(self) -> None:
        """Transfer all landmarks, show them on both surfaces, and fill the table."""
        self.name.options = tuple(self.marks)
        transferred = self.landmarks()
        if transferred is None:
            for scene in self.scenes:
                scene.mark([])
            self.table.value = PARTS.paragraph("Click on the source to place a landmark.")
            return
        here, there = np.stack(list(self.marks.values())), transferred["landmark_position"].values
        colors, names = label_colors(np.arange(len(here))), (self.source, self.target)
        for scene, name, points in zip(self.scenes, names, (here, there), strict=True):
            scene.mark(aligned(self.study, name, points), colors, self.radius.value)
        numbers = np.column_stack([there, transferred["landmark_confidence"].values])
        rows = [
            [name, *(f"{number:.2f}" for number in line)]
            for name, line in zip(self.marks, numbers, strict=True)
        ]
        caption = f"Landmarks on {self.target} ({unit_text(self.study, self.target)})"
        self.table.value = PARTS.landmarks(caption, COLUMNS, rows)

    def save_csv(self, path: Path | str) -> Path:
        """Write the landmarks on the target as CSV ``name,x,y,z``, in its coordinates."""
        transferred = self.landmarks()
        if transferred is None:
            raise ValueError("there are no landmarks to save; click on the source to place one")
        write_landmarks(path, transferred)
        return Path(path)
