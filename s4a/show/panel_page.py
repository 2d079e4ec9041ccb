"""A panel as one HTML file: its scripts, and a recording of what Python shows.

The values of the panel's controls are gone through one by one, and what its widgets then show is
kept; the page shows it again when a control is moved.
"""

import itertools
import json
import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import ipywidgets
from markupsafe import Markup
from tqdm.auto import tqdm

from s4a.show.browser import PARTS, TEMPLATES, to_json

LIMIT = 24_000_000  # characters of recorded values in a page
LADDER = 24  # values of a slider that are kept
# what does nothing in a page, and says nothing there
SILENT = ipywidgets.Button | ipywidgets.ToggleButton | ipywidgets.Text
# what is the browser's own; of a chart `spec` is kept key by key
LOCAL = {"picked", "hovered", "answer", "webgl", "still", "sample", "spec"}

PICKS = ("points", "caption")  # traits of a view that tell of what was picked


def panel_html(panel: Any, limit: int = LIMIT) -> str:
    """The HTML of a panel with everything in it; `limit` is that of the recorded characters."""
    page = PanelPage(panel, limit)
    return TEMPLATES.get_template("panel.html").render(
        title=panel.title,
        lacking=page.lacking(panel),
        body=page.body,
        scripts=page.scripts,
        recording=page.recording.data(page.ids),
    )


def widgets_in(widget: ipywidgets.Widget) -> Iterator[ipywidgets.Widget]:
    """A widget and all that is in it."""
    yield widget
    for child in getattr(widget, "children", ()):
        yield from widgets_in(child)


def synced(widget: ipywidgets.Widget) -> list[str]:
    """The names of the traits of a widget that its script reads."""
    names = widget.trait_names(sync=True)
    return [name for name in names if not name.startswith("_") and name != "layout"]


def state_of(widget: ipywidgets.Widget) -> dict[str, Any]:
    """The state that the script of a widget reads."""
    values = {name: getattr(widget, name) for name in synced(widget)}
    if "still" in values:  # for a browser without WebGL2: nobody will be there to draw it
        values["still"] = widget.still or widget.picture()
    kinds = bytes | str | int | float | list | dict
    return {name: value for name, value in values.items() if isinstance(value, kinds)}


def shown(widget: ipywidgets.Widget) -> dict[tuple[str, str | None], Any]:
    """What of a widget a recording keeps: name and key -> value."""
    values: dict[tuple[str, str | None], Any] = {("display", None): widget.layout.display or ""}
    if isinstance(widget, ipywidgets.HTML):
        values["html", None] = widget.value
    if hasattr(widget, "_esm"):
        names = [name for name in synced(widget) if name not in LOCAL]
        values |= {(name, None): getattr(widget, name) for name in names}
        values |= {("spec", key): value for key, value in getattr(widget, "spec", {}).items()}
    return values


@contextmanager
def unchanged_picks(panel: ipywidgets.Box, widgets: list[ipywidgets.Widget]) -> Iterator[None]:
    """What was picked in a panel, its marks and what is said of it are in the end as before."""
    names = [name for name in panel.trait_names() if name not in ipywidgets.VBox.class_traits()]
    parts = [(panel, name) for name in names]
    parts += [(part, name) for part in widgets for name in PICKS if part.has_trait(name)]
    before = [(part, name, getattr(part, name)) for part, name in parts]
    yield
    for part, name, value in before:
        setattr(part, name, value)


class Control:
    """A control of a panel, and the values of it that a page can keep.

    Of long sliders two dozen, or `every` one.
    """

    def __init__(self, widget, name, every):
        self.widget, self.id, self.now = widget, f"c-{name}", widget.value
        if isinstance(widget, ipywidgets.Checkbox):
            self.kind, options = "checkbox", [("no", False), ("yes", True)]
        elif isinstance(widget, ipywidgets.IntSlider):
            count = widget.max - widget.min + 1
            step = 1 if every else max(1, math.ceil(count / LADDER))
            kept = {*range(widget.min, widget.max + 1, step), self.now, widget.max}
            self.kind, options = "range", sorted(kept)
        else:
            slides = isinstance(widget, ipywidgets.SelectionSlider)
            self.kind, options = "range" if slides else "select", widget.options
        pairs = [one if isinstance(one, tuple) else (str(one), one) for one in options]
        self.labels, self.values = ([pair[i] for pair in pairs] for i in (0, 1))
        self.at = self.values.index(self.now)
        self.open = []  # places of the values that were kept

    def order(self) -> list[int]:
        """Places of the values, beginning with the one that is shown."""
        return [self.at, *(i for i in range(len(self.values)) if i != self.at)]

    def html(self) -> str:
        """The control in a page."""
        kind = self.kind if len(self.open) > 1 else "text"
        name, tooltip = self.widget.description, self.widget.tooltip or ""
        return PARTS.control(self.id, kind, name, self.labels, self.open, self.at, tooltip)


class Recording:
    """What a panel shows for the values of its controls.

    The values of every group of controls that the panel names in `live` are gone through together,
    the last control slowest; what differs is kept, each different value once, until the page is
    full.
    """

    def __init__(self, panel, limit):
        own = (panel, panel.message)
        self.widgets = [widget for widget in widgets_in(panel) if widget not in own]
        names = list(dict.fromkeys(itertools.chain.from_iterable(panel.live)))
        self.controls = {
            name: Control(panel.control(name), name, name in panel.every) for name in names
        }
        self.values, self.place, self.size = [], {}, 0
        runs: list[Any] = []
        with ExitStack() as silence:
            panel.recording = True
            silence.callback(setattr, panel, "recording", False)
            # the notebook's browser is told of the end only, which is the beginning
            for widget in self.widgets:
                silence.enter_context(widget.hold_sync())
            # what is shown now is in the page in any case, and counts for nothing
            for value in (v for widget in self.widgets for v in shown(widget).values()):
                self.keep(value)
            self.size = 0
            for i, group in enumerate(panel.live):
                with unchanged_picks(panel, self.widgets):
                    runs.append(self.run(group, limit * (i + 1) // len(panel.live)))
        depends = [differing(*run) for run in runs]
        self.groups = [
            self.group(group, states, slots, depends)
            for (group, states), slots in zip(runs, depends, strict=True)
        ]
        for name, control in self.controls.items():
            within = [(group.index(name), states) for group, states in runs if name in group]
            kept = [{places[i] for places in states} for i, states in within]
            control.open = sorted(set.intersection(*kept))
        self.clicks = [
            {"id": getattr(panel, chart), "part": part, "control": names.index(name)}
            for chart, part, name in panel.clicks
        ]

    def keep(self, value: Any) -> int:
        """Keep a value, if it is not; its place among those that are kept."""
        key = value if isinstance(value, bytes) else json.dumps(value)
        if key not in self.place:
            self.place[key] = len(self.values)
            if isinstance(value, bytes | str):  # as JSON, which is read when it is first shown
                value = to_json(value)
            self.values.append(value)
            self.size += len(value) if isinstance(value, str) else len(key)
        return self.place[key]

    def run(self, names: list[str], limit: int) -> tuple[list[str], dict[tuple, dict]]:
        """Go through the values of some controls, until `limit` characters are kept.

        Gives the names, and for the places of the controls' values where each value that is
        shown is kept: ``{places: {(widget, name, key): place}}``.
        """
        controls = [self.controls[name] for name in names]
        orders = [control.order() for control in reversed(controls)]
        states = {}
        total = math.prod(map(len, orders))
        for places in tqdm(itertools.product(*orders), total=total, desc="page", leave=False):
            if states and self.size >= limit:
                break
            places = places[::-1]
            for control, place in zip(controls, places, strict=True):
                control.widget.value = control.values[place]
            states[places] = {
                (i, *slot): self.keep(value)
                for i, widget in enumerate(self.widgets)
                for slot, value in shown(widget).items()
            }
        for control in controls:
            control.widget.value = control.now
        return names, states

    def group(self, names: list[str], states: dict, own: dict, depends: list) -> dict[str, Any]:
        """One group for the page: its slots and their values.

        Less the slots that another group knows in more detail.
        """
        slots = [
            slot for slot in own if not any(own[slot] < other.get(slot, set()) for other in depends)
        ]
        nothing, order = self.keep(None), list(self.controls)
        rows = {
            ",".join(map(str, places)): [state.get(slot, nothing) for slot in slots]
            for places, state in states.items()
        }
        return {"controls": [order.index(name) for name in names], "slots": slots, "rows": rows}

    def data(self, ids: dict[ipywidgets.Widget, str]) -> dict[str, Any]:
        """What the page's script reads, less values that no group uses; `ids` of the widgets."""
        used = sorted({i for group in self.groups for row in group["rows"].values() for i in row})
        place = {old: new for new, old in enumerate(used)}
        controls = [
            {
                "id": control.id,
                "labels": control.labels,
                "keys": [json.dumps(value) for value in control.values],
                "at": control.at,
                "open": control.open,
            }
            for control in self.controls.values()
        ]
        groups = []
        for group in self.groups:
            slots = [(ids[self.widgets[i]], name, key) for i, name, key in group["slots"]]
            rows = {key: [place[i] for i in row] for key, row in group["rows"].items()}
            groups.append(group | {"slots": slots, "rows": rows})
        return {
            "controls": controls,
            "values": [self.values[i] for i in used],
            "groups": groups,
            "clicks": [click | {"id": ids[click["id"]]} for click in self.clicks],
        }


def differing(names: list[str], states: dict[tuple, dict]) -> dict[tuple, set[str]]:
    """The slots that differ over the states of a group, and the controls on which each depends."""
    depends: dict[tuple, set[str]] = {}
    for slot in dict.fromkeys(slot for state in states.values() for slot in state):
        value = {places: state.get(slot) for places, state in states.items()}
        for c, name in enumerate(names):
            # it depends on a control if the places of the others do not say the value
            others = {places: places[:c] + places[c + 1 :] for places in value}
            pairs = {(others[places], value[places]) for places in value}
            if len(pairs) > len(set(others.values())):
                depends.setdefault(slot, set()).add(name)
        if len(set(value.values())) > 1:
            depends.setdefault(slot, set())
    return depends


class PanelPage:
    """The HTML of a panel's widgets; the scripts of all kinds with the ids of their widgets."""

    def __init__(self, panel, limit):
        self.recording = Recording(panel, limit)
        self.controls = {control.widget: control for control in self.recording.controls.values()}
        self.scripts, self.ids = {}, {}
        self.body = self.element(panel)

    def element(self, widget: ipywidgets.Widget) -> str:
        """The HTML of a widget and what is in it."""
        name = self.ids[widget] = f"w{len(self.ids)}"
        hidden = widget.layout.display == "none"
        if hasattr(widget, "_esm"):
            self.scripts.setdefault(str(widget._esm), []).append(name)
            return PARTS.widget(name, state_of(widget), hidden)
        if isinstance(widget, ipywidgets.Box):
            kinds = {ipywidgets.HBox: "row", ipywidgets.GridBox: "grid"}
            kind = " ".join([kinds.get(type(widget), "column"), *widget._dom_classes])
            return PARTS.box(name, kind, list(map(self.element, widget.children)), hidden)
        if isinstance(widget, ipywidgets.HTML):  # a panel's own text, which is HTML already
            return PARTS.box(name, "text", [Markup(widget.value)], hidden)
        if widget in self.controls:
            return self.controls[widget].html()
        if isinstance(widget, SILENT) or not hasattr(widget, "value"):
            return ""
        if isinstance(widget, ipywidgets.ColorPicker):
            return PARTS.swatch(widget.value, widget.tooltip)
        if isinstance(widget, ipywidgets.Checkbox):
            return PARTS.value(widget.description, "yes" if widget.value else "no")
        return PARTS.value(widget.description, getattr(widget, "label", None) or widget.value)

    def lacking(self, panel: ipywidgets.Box) -> list[str]:
        """What of the panel this page cannot do, as it needs Python."""
        silent = SILENT | ipywidgets.HTML | ipywidgets.IntProgress
        fixed, partly = [], []
        for widget in widgets_in(panel):
            control, name = self.controls.get(widget), getattr(widget, "description", "")
            if not hasattr(widget, "value") or not name or isinstance(widget, silent):
                continue
            kept = len(control.open) if control else 0
            if kept < 2:
                fixed.append(name)
            elif kept < len(control.values):
                partly.append(f"{name} ({kept} of {len(control.values)} are kept here)")
        changing = [f"changing {', '.join(fixed)}"] if fixed else []
        return list(dict.fromkeys([*panel.python, *changing, *partly]))
