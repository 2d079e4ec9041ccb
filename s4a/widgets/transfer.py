"""Transfer (6.2, Fig. 6 and 7).

Labels and landmarks of one shape, carried to another while they are placed.
"""

import itertools
from html import escape
from pathlib import Path

import ipywidgets
import numpy as np
import traitlets

from s4a.analysis.transfer import transfer_labels, transfer_landmarks
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import write_landmarks
from s4a.schema import dataset
from s4a.show.draw import label_colors
from s4a.show.pictures import aligned, names_of
from s4a.widgets.meshes import camera_group, nice, unit_of
from s4a.widgets.panel import Panel, beside, paragraph, row
from s4a.widgets.scene import extent, scene

COLUMNS = ["name", "x", "y", "z", "confidence"]
LEGEND = 24  # labels that have colours of their own


class Transfer(Panel):
    """Labels in colours and landmarks as spheres on two shapes.

    A click on the source places or moves a landmark.

    The keyboard does the same: C on the source starts a cursor, the arrow keys move it over the
    surface, Enter places.

    Attributes
    ----------
    source, target : str
        Shapes of the study; the source is the template at first.
    landmark : str
        The landmark that the next click on the source places.
    """

    needs = ("registration/position", "registration/registered_match")
    title = "Transfer"
    source, target, landmark = (traitlets.Unicode("") for _ in range(3))
    live = (("labels", "target"),)
    python = ("placing landmarks",)

    def build(self, view="corner", up="z"):
        """Choices, the two surfaces, legend and table."""
        names, template = (
            names_of(self.study["registration"].dataset),
            self.study["registration"].attrs["template"],
        )
        self.choices = {
            "source": ipywidgets.Dropdown(options=names, value=str(template), description="source"),
            "target": ipywidgets.Dropdown(options=names, description="target"),
        }
        self.labels = ipywidgets.Checkbox(
            True, description="labels", indent=False, layout={"width": "auto"}
        )
        self.name = ipywidgets.Combobox(description="landmark", placeholder="a name, then click")
        self.remove = ipywidgets.Button(description="Remove", tooltip="the landmark that is named")
        self.path = ipywidgets.Text("landmarks.csv", description="file", layout={"width": "260px"})
        self.csv = ipywidgets.Button(description="Save CSV", tooltip="the landmarks on the target")
        self.radius = ipywidgets.BoundedFloatText(
            1,
            min=0,
            max=1e9,
            step=0.5,
            description="radius",
            tooltip="of the spheres",
            layout={"width": "180px"},
        )
        self.legend, self.table = ipywidgets.HTML(), ipywidgets.HTML()
        group = camera_group()
        self.scenes = [
            scene(group=group, view=view, up=up, height=380, clickable=not i) for i in range(2)
        ]
        for role, choice in self.choices.items():
            self.on_change(choice, lambda value, role=role: self.set_trait(role, value))
            self.on_change(self, lambda _: self.draw(), role)
        self.on_change(self.labels, lambda _: self.paint())
        self.on_change(self.name, lambda value: self.set_trait("landmark", value))
        self.on_change(self, lambda value: setattr(self.name, "value", value), "landmark")
        self.on_change(self.scenes[0], self.place, "picked")
        self.remove.on_click(self.guarded(lambda _: self.drop(self.landmark)))
        self.csv.on_click(
            self.guarded(lambda _: self.say(f"written: {self.save_csv(self.path.value)}"))
        )
        size = extent(self.study["registration"]["position"].values)
        self.radius.value, self.radius.description = (
            nice(size / 60),
            f"radius ({unit_of(self.study, template)})",
        )
        self.radius.style.description_width = "initial"
        self.on_change(self.radius, lambda _: self.carry())
        with self.hold_trait_notifications():
            self.source = str(template)
            self.target = next(name for name in names if name != template)
        return [
            row(*self.choices.values(), self.labels),
            row(self.name, self.remove, self.radius, self.path, self.csv),
            beside(*self.scenes),
            self.legend,
            self.table,
        ]

    def control(self, name):
        """The control of a name in `live`."""
        return self.choices.get(name) or super().control(name)

    def mesh(self, name):
        """The mesh of a shape, in its own coordinates."""
        return self.study["original"][name].to_dataset()

    def draw(self):
        """Both surfaces; the landmarks that the source has in the study are placed on it."""
        if not self.source or not self.target:
            return
        self.choices["source"].value, self.choices["target"].value = self.source, self.target
        mesh = self.mesh(self.source)
        self.marks = {}
        if "landmark_position" in mesh:
            names = mesh["landmark_name"].values.astype(str)
            self.marks = dict(zip(names.tolist(), mesh["landmark_position"].values, strict=True))
        for view, name, role in zip(
            self.scenes, (self.source, self.target), ("source", "target"), strict=True
        ):
            X, T = as_arrays(self.mesh(name))
            view.show(
                aligned(self.study, name, X), T, title=f"{name}, the {role}, {len(X):,} vertices"
            )
        self.paint()
        self.carry()

    def paint(self):
        """The source's labels on both surfaces, and what their colours are."""
        mesh = self.mesh(self.source)
        self.legend.value = (
            "" if "label" in mesh else paragraph(f"{escape(self.source)} has no labels.")
        )
        if "label" not in mesh or not self.labels.value:
            for view in self.scenes:
                view.paint(None)
            return
        label = mesh["label"].values
        self.carried = transfer_labels(
            self.study, label, source=self.source, targets=[self.target]
        )[self.target]
        found, confidence = self.carried["label"].values, self.carried["confidence"].values.mean()
        values = np.unique(label)
        colors = label_colors(values)  # in the order of the values, so that both surfaces agree
        for view, one in zip(self.scenes, (label, found), strict=True):
            view.paint(colors[np.searchsorted(values, one)])
        self.scenes[
            1
        ].caption = f"labels carried from {self.source}, confidence {confidence:.2f} on average"
        names = "".join(
            f'<span style="white-space:nowrap;margin-right:1em"><span style="display:inline-block;width:1em;height:1em;'
            f'background:rgb({",".join(str(round(255 * c)) for c in color)})"></span> {escape(str(value))}: '
            f"{np.mean(label == value):.1%}, {np.mean(found == value):.1%}</span>"
            for value, color in zip(values, colors, strict=True)
        )
        more = " Colours repeat." if len(values) > LEGEND else ""
        self.legend.value = paragraph(
            f"Labels, shares of the vertices on source and target: {names}{more}"
        )

    def place(self, place):
        """A click on the source: the landmark that is named comes there; a new one gets a name."""
        if place.get("vertex", -1) < 0:
            return
        free = (f"landmark {i}" for i in itertools.count(len(self.marks) + 1))
        name = self.landmark or next(name for name in free if name not in self.marks)
        X, T = as_arrays(self.mesh(self.source))
        self.marks[name] = np.asarray(place["weights"]) @ X[T[place["face"]]]
        self.carry()

    def drop(self, name):
        """Remove a landmark."""
        if self.marks.pop(name, None) is None:
            raise ValueError(f"no landmark {name!r}; there are {', '.join(self.marks) or 'none'}")
        self.landmark = ""
        self.carry()

    def landmarks(self):
        """The landmarks on the target, as :func:`s4a.transfer_landmarks` gives them.

        None without any.
        """
        if not self.marks:
            return None
        marked = dataset(
            landmark_name=list(self.marks), landmark_position=np.stack(list(self.marks.values()))
        )
        found = transfer_landmarks(self.study, marked, source=self.source, targets=[self.target])
        return found[self.target].to_dataset()

    def carry(self):
        """Carry all landmarks over and show them on both surfaces, with their numbers."""
        self.name.options = tuple(self.marks)
        found = self.landmarks()
        here = np.stack(list(self.marks.values())) if self.marks else np.zeros((0, 3))
        there = np.zeros((0, 3)) if found is None else found["landmark_position"].values
        colors = label_colors(np.arange(len(here))) if len(here) else ()
        for view, name, points in zip(
            self.scenes, (self.source, self.target), (here, there), strict=True
        ):
            view.mark(aligned(self.study, name, points), colors, self.radius.value) if len(
                points
            ) else view.mark([])
        if found is None:
            self.table.value = paragraph("Click on the source to place a landmark.")
            return
        values = zip(self.marks, there, found["landmark_confidence"].values, strict=True)
        rows = [[name, *(f"{x:.2f}" for x in point), f"{sure:.2f}"] for name, point, sure in values]
        self.table.value = html_table(f"Landmarks on {self.target}", COLUMNS, rows)

    def save_csv(self, path):
        """Write the landmarks on the target as CSV ``name,x,y,z``, in its coordinates."""
        found = self.landmarks()
        if found is None:
            raise ValueError("there are no landmarks to save; click on the source to place one")
        write_landmarks(path, found)
        return Path(path)


def html_table(caption, columns, rows):
    """A small table, escaped."""
    head = "".join(
        f"<th style='text-align:left;padding-right:1em'>{escape(c)}</th>" for c in columns
    )
    body = "".join(
        "<tr>"
        + "".join(f"<td style='padding-right:1em'>{escape(str(c))}</td>" for c in row)
        + "</tr>"
        for row in rows
    )
    return f"<table style='line-height:1.4'><caption>{escape(caption)}</caption><tr>{head}</tr>{body}</table>"
