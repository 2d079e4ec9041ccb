"""A panel as one HTML file: its scripts, and a recording of the output of Python.

The controls of the panel are set to their values one by one, and the state of its widgets is
recorded; the page shows a recorded state when a control is moved.
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
N_VALUES = 24  # recorded values of a slider
# widgets that a page omits
OMITTED = ipywidgets.Button | ipywidgets.ToggleButton | ipywidgets.Text
# traits that the browser sets; `spec` of a chart is recorded key by key
LOCAL = {"picked", "hovered", "answer", "webgl", "still", "sample", "spec"}

PICKS = ("points", "caption")  # traits of a view that show a picked point


def panel_html(panel: Any, limit: int = LIMIT) -> str:
    """Return the self-contained HTML of a panel, with at most `limit` recorded characters."""
    page = PanelPage(panel, limit)
    return TEMPLATES.get_template("panel.html").render(
        title=panel.title,
        lacking=page.lacking(panel),
        body=page.body,
        scripts=page.scripts,
        recording=page.recording.data(page.ids),
    )


def widgets_in(widget: ipywidgets.Widget) -> Iterator[ipywidgets.Widget]:
    """Yield a widget and its descendants."""
    yield widget
    for child in getattr(widget, "children", ()):
        yield from widgets_in(child)


def synced(widget: ipywidgets.Widget) -> list[str]:
    """Return the names of the traits that a widget's script reads."""
    names = widget.trait_names(sync=True)
    return [name for name in names if not name.startswith("_") and name != "layout"]


def state_of(widget: ipywidgets.Widget) -> dict[str, Any]:
    """Return the state that a widget's script reads."""
    values = {name: getattr(widget, name) for name in synced(widget)}
    if "still" in values:  # for a browser without WebGL2: there is no kernel to draw it
        values["still"] = widget.still or widget.picture()
    kinds = bytes | str | int | float | list | dict
    return {name: value for name, value in values.items() if isinstance(value, kinds)}


def recorded_state(widget: ipywidgets.Widget) -> dict[tuple[str, str | None], Any]:
    """Return the recorded state of a widget: name and key -> value."""
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
    """Restore the picked points of a panel, their marks and captions at the end."""
    names = [name for name in panel.trait_names() if name not in ipywidgets.VBox.class_traits()]
    parts = [(panel, name) for name in names]
    parts += [(part, name) for part in widgets for name in PICKS if part.has_trait(name)]
    before = [(part, name, getattr(part, name)) for part, name in parts]
    yield
    for part, name, value in before:
        setattr(part, name, value)


class Control:
    """A control of a panel and its recorded values: all, or of a long slider 24 or `every` one."""

    def __init__(self, widget, name, every):
        self.widget, self.id, self.now = widget, f"c-{name}", widget.value
        if isinstance(widget, ipywidgets.Checkbox):
            self.kind, options = "checkbox", [("no", False), ("yes", True)]
        elif isinstance(widget, ipywidgets.IntSlider):
            count = widget.max - widget.min + 1
            step = 1 if every else max(1, math.ceil(count / N_VALUES))
            kept = {*range(widget.min, widget.max + 1, step), self.now, widget.max}
            self.kind, options = "range", sorted(kept)
        else:
            is_slider = isinstance(widget, ipywidgets.SelectionSlider)
            self.kind, options = "range" if is_slider else "select", widget.options
        pairs = [item if isinstance(item, tuple) else (str(item), item) for item in options]
        self.labels, self.values = ([pair[i] for pair in pairs] for i in (0, 1))
        self.at = self.values.index(self.now)
        self.recorded = []  # indices of the recorded values

    def order(self) -> list[int]:
        """Return the indices of the values, beginning with the current one."""
        return [self.at, *(i for i in range(len(self.values)) if i != self.at)]

    def html(self) -> str:
        """Return the HTML of the control."""
        kind = self.kind if len(self.recorded) > 1 else "text"
        name, tooltip = self.widget.description, self.widget.tooltip or ""
        return PARTS.control(self.id, kind, name, self.labels, self.recorded, self.at, tooltip)


class Recording:
    """States of a panel for the values of its controls.

    A group of controls in the panel's `live` is set to all combinations of values, the last control
    slowest.  States that differ are recorded, each different value once, up to a size.
    """

    def __init__(self, panel, limit):
        own = (panel, panel.message)
        self.widgets = [widget for widget in widgets_in(panel) if widget not in own]
        names = list(dict.fromkeys(itertools.chain.from_iterable(panel.live)))
        self.controls = {
            name: Control(panel.control(name), name, name in panel.every) for name in names
        }
        self.values, self.index, self.size = [], {}, 0
        runs: list[Any] = []
        with ExitStack() as stack:
            panel.recording = True
            stack.callback(setattr, panel, "recording", False)
            # the notebook's browser gets the final state only, which is the initial one
            for widget in self.widgets:
                stack.enter_context(widget.hold_sync())
            # the current state is in the page in any case, and does not count
            for value in (v for widget in self.widgets for v in recorded_state(widget).values()):
                self.record(value)
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
            indices = [{at[i] for at in states} for i, states in within]
            control.recorded = sorted(set.intersection(*indices))
        self.clicks = [
            {"id": getattr(panel, chart), "part": part, "control": names.index(name)}
            for chart, part, name in panel.clicks
        ]

    def record(self, value: Any) -> int:
        """Record a value, and return its index among the different values."""
        key = value if isinstance(value, bytes) else json.dumps(value)
        if key not in self.index:
            self.index[key] = len(self.values)
            if isinstance(value, bytes | str):  # as JSON, decoded when it is first shown
                value = to_json(value)
            self.values.append(value)
            self.size += len(value) if isinstance(value, str) else len(key)
        return self.index[key]

    def run(self, names: list[str], limit: int) -> tuple[list[str], dict[tuple, dict]]:
        """Set some controls to their values, until `limit` characters are recorded.

        Returns the names, and for the indices of the controls' values the indices of the recorded
        state: ``{indices: {(widget, name, key): index}}``.
        """
        controls = [self.controls[name] for name in names]
        orders = [control.order() for control in reversed(controls)]
        states = {}
        total = math.prod(map(len, orders))
        for indices in tqdm(itertools.product(*orders), total=total, desc="page", leave=False):
            if states and self.size >= limit:
                break
            indices = indices[::-1]
            for control, index in zip(controls, indices, strict=True):
                control.widget.value = control.values[index]
            states[indices] = {
                (i, *slot): self.record(value)
                for i, widget in enumerate(self.widgets)
                for slot, value in recorded_state(widget).items()
            }
        for control in controls:
            control.widget.value = control.now
        return names, states

    def group(self, names: list[str], states: dict, own: dict, depends: list) -> dict[str, Any]:
        """Return a group for the page: its slots and their values.

        Slots that depend on more controls in another group are omitted.
        """
        slots = [
            slot for slot in own if not any(own[slot] < other.get(slot, set()) for other in depends)
        ]
        nothing, order = self.record(None), list(self.controls)
        rows = {
            ",".join(map(str, indices)): [state.get(slot, nothing) for slot in slots]
            for indices, state in states.items()
        }
        return {"controls": [order.index(name) for name in names], "slots": slots, "rows": rows}

    def data(self, ids: dict[ipywidgets.Widget, str]) -> dict[str, Any]:
        """Return the data for the page's script, without unused values; `ids` of the widgets."""
        used = sorted({i for group in self.groups for row in group["rows"].values() for i in row})
        index = {old: new for new, old in enumerate(used)}
        controls = [
            {
                "id": control.id,
                "labels": control.labels,
                "keys": [json.dumps(value) for value in control.values],
                "at": control.at,
                "recorded": control.recorded,
            }
            for control in self.controls.values()
        ]
        groups = []
        for group in self.groups:
            slots = [(ids[self.widgets[i]], name, key) for i, name, key in group["slots"]]
            rows = {key: [index[i] for i in row] for key, row in group["rows"].items()}
            groups.append(group | {"slots": slots, "rows": rows})
        return {
            "controls": controls,
            "values": [self.values[i] for i in used],
            "groups": groups,
            "clicks": [click | {"id": ids[click["id"]]} for click in self.clicks],
        }


def differing(names: list[str], states: dict[tuple, dict]) -> dict[tuple, set[str]]:
    """Return the slots that differ between the states, and the controls on which each depends."""
    depends: dict[tuple, set[str]] = {}
    for slot in dict.fromkeys(slot for state in states.values() for slot in state):
        value = {indices: state.get(slot) for indices, state in states.items()}
        for c, name in enumerate(names):
            # a slot depends on a control if the other controls do not determine its value
            others = {indices: indices[:c] + indices[c + 1 :] for indices in value}
            pairs = {(others[indices], value[indices]) for indices in value}
            if len(pairs) > len(set(others.values())):
                depends.setdefault(slot, set()).add(name)
        if len(set(value.values())) > 1:
            depends.setdefault(slot, set())
    return depends


class PanelPage:
    """HTML of a panel's widgets, and script -> ids of the widgets that use it."""

    def __init__(self, panel, limit):
        self.recording = Recording(panel, limit)
        self.controls = {control.widget: control for control in self.recording.controls.values()}
        self.scripts, self.ids = {}, {}
        self.body = self.element(panel)

    def element(self, widget: ipywidgets.Widget) -> str:
        """Return the HTML of a widget and its descendants."""
        name = self.ids[widget] = f"w{len(self.ids)}"
        hidden = widget.layout.display == "none"
        if hasattr(widget, "_esm"):
            self.scripts.setdefault(str(widget._esm), []).append(name)
            return PARTS.widget(name, state_of(widget), hidden)
        if isinstance(widget, ipywidgets.Box):
            kinds = {ipywidgets.HBox: "row", ipywidgets.GridBox: "grid"}
            kind = " ".join([kinds.get(type(widget), "column"), *widget._dom_classes])
            return PARTS.box(name, kind, list(map(self.element, widget.children)), hidden)
        if isinstance(widget, ipywidgets.HTML):  # a panel's own text
            return PARTS.box(name, "text", [Markup(widget.value)], hidden)
        if widget in self.controls:
            return self.controls[widget].html()
        if isinstance(widget, OMITTED) or not hasattr(widget, "value"):
            return ""
        if isinstance(widget, ipywidgets.ColorPicker):
            return PARTS.swatch(widget.value, widget.tooltip)
        if isinstance(widget, ipywidgets.Checkbox):
            return PARTS.value(widget.description, "yes" if widget.value else "no")
        return PARTS.value(widget.description, getattr(widget, "label", None) or widget.value)

    def lacking(self, panel: ipywidgets.Box) -> list[str]:
        """Return the actions of the panel that need Python."""
        ignored = OMITTED | ipywidgets.HTML | ipywidgets.IntProgress
        fixed, partly = [], []
        for widget in widgets_in(panel):
            control, name = self.controls.get(widget), getattr(widget, "description", "")
            if not hasattr(widget, "value") or not name or isinstance(widget, ignored):
                continue
            n_recorded = len(control.recorded) if control else 0
            if n_recorded < 2:
                fixed.append(name)
            elif n_recorded < len(control.values):
                partly.append(
                    f"{name} (this page has {n_recorded} of {len(control.values)} values)"
                )
        changing = [f"changing {', '.join(fixed)}"] if fixed else []
        return list(dict.fromkeys([*panel.python, *changing, *partly]))
