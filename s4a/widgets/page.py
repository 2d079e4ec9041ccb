"""A panel as one HTML file: the same scripts, with a small stand-in for the kernel's model."""

import base64
import json
from html import escape

import ipywidgets

from s4a.widgets.browser import STYLE

PAGE_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1100px; margin: 0 auto; padding: 1em; }
.row { display: flex; flex-wrap: wrap; gap: 10px; align-items: flex-start; } .row > * { flex: 1 1 320px; min-width: 0; }
.value { flex: 0 1 auto; color: #444; }
"""
# what a script needs of the notebook's model: get, set and events of changes
MODEL = """
globalThis.s4aModel = (id) => {
  const state = JSON.parse(document.getElementById(id + "-state").textContent, (key, value) => {
    if (!value || typeof value.base64 !== "string") return value;
    const text = atob(value.base64), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return new DataView(bytes.buffer);
  });
  const heard = {};
  return {
    get: (name) => state[name],
    set: (name, value) => { state[name] = value; (heard["change:" + name] || []).forEach((act) => act()); },
    on: (event, act) => { (heard[event] ||= []).push(act); },
    off: (event, act) => { heard[event] = (heard[event] || []).filter((other) => other !== act); },
    save_changes: () => {},
  };
};
"""


def state_of(widget):
    """The state of a widget as JSON, bytes in base 64."""
    names = [name for name in widget.trait_names(sync=True) if not name.startswith("_") and name != "layout"]
    values = {name: getattr(widget, name) for name in names}
    if "still" in values:  # for a browser without WebGL2: nobody will be there to draw it
        values["still"] = widget.still or widget.picture()
    values = {
        name: {"base64": base64.b64encode(value).decode()} if isinstance(value, bytes) else value
        for name, value in values.items()
        if isinstance(value, bytes | str | int | float | list | dict | bool)
    }
    return json.dumps(values).replace("</", "<\\/")


def element(widget, scripts):
    """The HTML of a widget and what is in it; the script of each kind is collected in `scripts`."""
    if hasattr(widget, "_esm"):
        name = f"w{sum(len(ids) for ids in scripts.values())}"
        scripts.setdefault(str(widget._esm), []).append(name)
        return f'<div id="{name}"></div><script type="application/json" id="{name}-state">{state_of(widget)}</script>'
    if isinstance(widget, ipywidgets.Box):
        kind = "row" if isinstance(widget, ipywidgets.HBox) else "column"
        shown = [child for child in widget.children if child.layout.display != "none"]
        return f'<div class="{kind}">{"".join(element(child, scripts) for child in shown)}</div>'
    if isinstance(widget, ipywidgets.HTML):
        return f"<div>{widget.value}</div>"
    if isinstance(widget, ipywidgets.Image):
        return f'<img alt="" src="data:image/png;base64,{base64.b64encode(widget.value).decode()}">'
    if isinstance(widget, ipywidgets.Button | ipywidgets.Text) or not hasattr(widget, "value"):
        return ""
    shown = getattr(widget, "label", None) or widget.value
    return f'<div class="value">{escape(getattr(widget, "description", ""))} <b>{escape(str(shown))}</b></div>'


def page(widget, title):
    """The HTML of one widget with everything in it, as a str."""
    scripts = {}
    body = element(widget, scripts)
    modules = "".join(
        '<script type="module">'
        + text.replace("export default", "const widget =").replace("</", "<\\/")
        + f"\nfor (const id of {json.dumps(names)}) "
        + "widget.render({ model: s4aModel(id), el: document.getElementById(id) });</script>\n"
        for text, names in scripts.items()
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{PAGE_STYLE}{STYLE}</style></head><body>\n<h1>{escape(title)}</h1>\n{body}\n"
        f"<script>{MODEL}</script>\n{modules}</body></html>\n"
    )
