"""A panel as one HTML file.

The same scripts, and a recording of what Python shows for the values of its controls.
"""

import base64
import itertools
import json
import math
from contextlib import ExitStack
from html import escape

import ipywidgets
from tqdm.auto import tqdm

from s4a.show.live import MODEL, STYLE, encoded, module, script, widget_html

LIMIT = 24_000_000  # characters of recorded values in a page
LADDER = 24  # values of a slider that are kept
PAGE_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1100px; margin: 0 auto; padding: 1em; }
.row { display: flex; flex-wrap: wrap; gap: 10px; align-items: flex-start; } .row > * { flex: 1 1 320px; min-width: 0; }
.row > .value { flex: 0 1 auto; } .value { color: #444; } .value select { max-width: 24em; font: inherit; }
.value input[type=range] { width: 15em; vertical-align: middle; } [hidden] { display: none !important; }
:focus-visible { outline: 3px solid #d55e00; outline-offset: 1px; } .note { color: #555; font-size: 90%; }
"""
LOCAL = {
    "picked",
    "hovered",
    "webgl",
    "still",
    "sample",
    "spec",
}  # the browser's own; `spec` goes key by key


def parts(widget):
    """A widget and all that is in it."""
    yield widget
    for child in getattr(widget, "children", ()):
        yield from parts(child)


def synced(widget):
    """The traits of a widget that its script reads."""
    return [
        name
        for name in widget.trait_names(sync=True)
        if not name.startswith("_") and name != "layout"
    ]


def state_of(widget):
    """The state that the script of a widget reads."""
    values = {name: getattr(widget, name) for name in synced(widget)}
    if "still" in values:  # for a browser without WebGL2: nobody will be there to draw it
        values["still"] = widget.still or widget.picture()
    return {
        name: value
        for name, value in values.items()
        if isinstance(value, bytes | str | int | float | list | dict)
    }


def shown(widget):
    """What of a widget a recording keeps: name and key -> value."""
    found = {("display", None): widget.layout.display or ""}
    if isinstance(widget, ipywidgets.HTML):
        found["html", None] = widget.value
    if hasattr(widget, "_esm"):
        found |= {
            (name, None): getattr(widget, name) for name in synced(widget) if name not in LOCAL
        }
        found |= {("spec", key): value for key, value in getattr(widget, "spec", {}).items()}
    return found


class Control:
    """A control of a panel, and the values of it that a page can keep.

    Of long sliders two dozen, or `every` one.
    """

    def __init__(self, widget, name, every):
        self.widget, self.id, self.now = widget, f"c-{name}", widget.value
        self.ladder = isinstance(widget, ipywidgets.IntSlider | ipywidgets.SelectionSlider)
        if isinstance(widget, ipywidgets.Checkbox):
            options = [("no", False), ("yes", True)]
        elif isinstance(widget, ipywidgets.IntSlider):
            step = 1 if every else max(1, -(-(widget.max - widget.min + 1) // LADDER))
            options = sorted({*range(widget.min, widget.max + 1, step), self.now, widget.max})
        else:
            options = widget.options
        options = [one if isinstance(one, tuple) else (str(one), one) for one in options]
        self.labels, self.values = map(list, zip(*options, strict=True))
        self.at = self.values.index(self.now)

    def order(self):
        """Places of the values, beginning with the one that is shown."""
        return [self.at, *(i for i in range(len(self.values)) if i != self.at)]

    def html(self, kept):
        """The control in a page; values that are not kept cannot be chosen."""
        name, told = (
            escape(self.widget.description),
            f"<output>{escape(self.labels[self.at])}</output>",
        )
        if len(kept) < 2:
            return f'<span id="{self.id}">{name} <b>{told}</b></span>'
        if isinstance(self.widget, ipywidgets.Checkbox):
            return f'<label><input id="{self.id}" type="checkbox"{" checked" * self.now}> {name}</label>'
        if self.ladder:
            ends = f'min="0" max="{len(kept) - 1}" value="{kept.index(self.at)}"'
            text = f'aria-valuetext="{escape(self.labels[self.at])}"'
            return f'<label>{name} <input id="{self.id}" type="range" {ends} {text}> {told}</label>'
        marks = [
            " selected" * (i == self.at) + " disabled" * (i not in kept)
            for i in range(len(self.labels))
        ]
        options = "".join(
            f'<option value="{i}"{mark}>{escape(text)}</option>'
            for i, (mark, text) in enumerate(zip(marks, self.labels, strict=True))
        )
        return f'<label>{name} <select id="{self.id}">{options}</select></label>'


class Recording:
    """What a panel shows for the values of its controls.

    The values of every group of controls that the panel names in `live` are gone through together,
    the last control slowest; what differs is kept, each different value once, until the page is
    full.
    """

    def __init__(self, panel):
        self.parts = [
            part for part in parts(panel) if part is not panel and part is not panel.message
        ]
        drawn = any(
            hasattr(part, "_esm") for part in self.parts
        )  # or Python would have to draw a picture for each
        live = panel.live if drawn else ()
        names = list(dict.fromkeys(itertools.chain.from_iterable(live)))
        self.controls = {
            name: Control(panel.control(name), name, name in panel.every) for name in names
        }
        self.values, self.place, self.size = [], {}, 0
        with ExitStack() as held:
            for (
                part
            ) in self.parts:  # the notebook's browser is told the end only, which is the beginning
                held.enter_context(part.hold_sync())
            runs = [self.run(group, LIMIT * (i + 1) // len(live)) for i, group in enumerate(live)]
        depends = [differing(*run) for run in runs]
        self.groups = [
            self.group(*run, mine, depends) for run, mine in zip(runs, depends, strict=True)
        ]
        self.open = {}
        for name, control in self.controls.items():
            kept = [
                {key[group.index(name)] for key in states}
                for group, states in runs
                if name in group
            ]
            self.open[name] = [
                i for i in range(len(control.values)) if all(i in places for places in kept)
            ]
        self.clicks = [
            {"id": getattr(panel, chart), "part": part, "control": names.index(name)}
            for chart, part, name in panel.clicks
            if drawn
        ]

    def kept(self, value):
        """The place of a value among those that are kept."""
        key = value if isinstance(value, bytes) else json.dumps(value)
        if key not in self.place:
            self.place[key] = len(self.values)
            if isinstance(value, bytes | str):  # as JSON, which is read when it is first shown
                value = encoded(value)
            self.values.append(value)
            self.size += len(value) if isinstance(value, str) else len(key)
        return self.place[key]

    def run(self, names, limit):
        """Go through the values of some controls.

        Their places -> (part, name, key) -> place of the value.
        """
        controls = [self.controls[name] for name in names]
        states, start = {}, self.size
        orders = [control.order() for control in reversed(controls)]
        total = math.prod(map(len, orders))
        for places in tqdm(itertools.product(*orders), total=total, desc="page", leave=False):
            if self.size > limit and self.size > start:
                break
            places = places[::-1]
            for control, i in zip(controls, places, strict=True):
                control.widget.value = control.values[i]
            states[places] = {
                (i, *slot): self.kept(value)
                for i, part in enumerate(self.parts)
                for slot, value in shown(part).items()
            }
        for control in controls:
            control.widget.value = control.now
        return names, states

    def group(self, names, states, mine, depends):
        """One group for the page.

        Its slots, less those that another group knows in more detail, and their values.
        """
        slots = [
            slot
            for slot in mine
            if not any(mine[slot] < other.get(slot, set()) for other in depends)
        ]
        nothing = self.kept(None)
        return {
            "controls": [list(self.controls).index(name) for name in names],
            "slots": slots,
            "rows": {
                ",".join(map(str, places)): [state.get(slot, nothing) for slot in slots]
                for places, state in states.items()
            },
        }

    def data(self, ids):
        """What the page's script reads: `ids` are those of the widgets.

        Only values that are used.
        """
        used = sorted({i for group in self.groups for row in group["rows"].values() for i in row})
        new = {old: i for i, old in enumerate(used)}
        controls = [
            {
                "id": c.id,
                "labels": c.labels,
                "keys": list(map(json.dumps, c.values)),
                "at": c.at,
                "open": self.open[name],
            }
            for name, c in self.controls.items()
        ]
        groups = [
            group
            | {
                "slots": [(ids[self.parts[i]], name, key) for i, name, key in group["slots"]],
                "rows": {key: [new[i] for i in row] for key, row in group["rows"].items()},
            }
            for group in self.groups
        ]
        clicks = [click | {"id": ids[click["id"]]} for click in self.clicks]
        return {
            "controls": controls,
            "values": [self.values[i] for i in used],
            "groups": groups,
            "clicks": clicks,
        }


def differing(names, states):
    """The slots that differ over the states of a group.

    Slot -> the controls on which it depends.
    """
    depends = {}
    for slot in dict.fromkeys(slot for state in states.values() for slot in state):
        value = {places: state.get(slot) for places, state in states.items()}
        if len(set(value.values())) > 1:
            depends[slot] = {
                name
                for c, name in enumerate(names)
                if len({(p[:c] + p[c + 1 :], v) for p, v in value.items()})
                > len({p[:c] + p[c + 1 :] for p in value})
            }
    return depends


class Page:
    """The HTML of a panel's widgets.

    The script of each kind is collected with the names of its widgets.
    """

    def __init__(self, panel):
        self.recording = Recording(panel)
        self.scripts, self.ids = {}, {}
        self.names = {control.widget: name for name, control in self.recording.controls.items()}
        self.body = self.element(panel)

    def element(self, widget):
        """The HTML of a widget and what is in it."""
        name = self.ids[widget] = f"w{len(self.ids)}"
        hidden = " hidden" if widget.layout.display == "none" else ""
        if hasattr(widget, "_esm"):
            self.scripts.setdefault(str(widget._esm), []).append(name)
            return widget_html(name, state_of(widget)).replace("<div ", f"<div{hidden} ", 1)
        if isinstance(widget, ipywidgets.Box):
            kind = "row" if isinstance(widget, ipywidgets.HBox) else "column"
            return f'<div id="{name}" class="{kind}"{hidden}>{"".join(map(self.element, widget.children))}</div>'
        if isinstance(widget, ipywidgets.HTML):
            return f'<div id="{name}"{hidden}>{widget.value}</div>'
        if isinstance(widget, ipywidgets.Image):
            return f'<img alt="" src="data:image/png;base64,{base64.b64encode(widget.value).decode()}">'
        if widget in self.names:
            control = self.names[widget]
            return f'<div class="value">{self.recording.controls[control].html(self.recording.open[control])}</div>'
        if isinstance(widget, ipywidgets.Button | ipywidgets.Text) or not hasattr(widget, "value"):
            return ""
        if isinstance(widget, ipywidgets.Checkbox):
            text = "yes" if widget.value else "no"
        else:
            text = getattr(widget, "label", None) or widget.value
        return f'<div class="value">{escape(widget.description)} <b>{escape(str(text))}</b></div>'

    def note(self, panel):
        """What of the panel this page can do, and what needs Python."""
        fixed = [
            part.description
            for part in parts(panel)
            if hasattr(part, "value")
            and getattr(part, "description", "")
            and not isinstance(
                part, ipywidgets.Button | ipywidgets.Text | ipywidgets.HTML | ipywidgets.IntProgress
            )
            and len(self.recording.open.get(self.names.get(part), ())) < 2
        ]
        some = [
            f"{c.widget.description} ({len(self.recording.open[name])} of {len(c.values)} are kept here)"
            for name, c in self.recording.controls.items()
            if 1 < len(self.recording.open[name]) < len(c.values)
        ]
        lacking = [*panel.python, *([f"changing {', '.join(fixed)}"] if fixed else []), *some]
        if not lacking:
            return ""
        return f'<p class="note">Needs Python, in a notebook: {escape("; ".join(dict.fromkeys(lacking)))}.</p>'


def page(panel):
    """The HTML of a panel with everything in it, as a str."""
    made = Page(panel)
    modules = "".join(module(text, names) for text, names in made.scripts.items())
    title = escape(panel.title)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{PAGE_STYLE}{STYLE}</style></head><body>\n<h1>{title}</h1>\n{made.note(panel)}{made.body}\n"
        f"<script>{MODEL}{script('replay')}</script>\n{modules}"
        f'<script type="application/json" id="recording">{encoded(made.recording.data(made.ids))}</script>'
        '<script type="module">s4aReplay(JSON.parse(document.getElementById("recording").textContent));</script>'
        "</body></html>\n"
    )
