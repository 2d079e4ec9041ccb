"""The first cell of every notebook of the documentation.

Panels and sliders as HTML that needs no kernel.
"""

import base64
import contextlib
import io
import itertools
import json
import math
from html import escape

import ipywidgets
import numpy as np
from IPython import get_ipython
from IPython.display import HTML, display

from s4a.widgets import explore, page
from s4a.widgets.panel import Panel

page.LIMIT = 1_500_000  # characters of a panel
N_VALUES = 5  # of a slider
FIT = "this.style.height = this.contentDocument.documentElement.scrollHeight + 8 + 'px'"
MOVE = (
    "const all = this.closest('.moved'), inputs = [...all.querySelectorAll('input')];"
    " const at = inputs.reduce((sum, input) => sum + input.value * input.dataset.stride, 0);"
    " all.querySelectorAll('.frame').forEach((frame, i) => frame.hidden = i != at);"
    " this.parentNode.querySelector('output').value = JSON.parse(this.dataset.labels)[this.value]"
)
format_of = get_ipython().display_formatter


def framed(panel):
    """A panel as a page within the page; of tabs the first."""
    if isinstance(panel, explore.Explore):
        panel = panel["Modes"]
    text = escape(page.page(panel), quote=True)
    return f'<iframe class="panel" title="{escape(panel.title)}" onload="{FIT}" srcdoc="{text}"></iframe>'


for kind in (Panel, explore.Explore):
    format_of.formatters["text/html"].for_type(kind, framed)
format_of.formatters["text/html"].for_type(ipywidgets.HTML, lambda widget: widget.value)


def html_of(value):
    """What a cell would show of a value, as HTML."""
    found = format_of.format(value)[0] if value is not None else {}
    for mime in ("image/png", "image/svg+xml"):
        if mime in found:
            data = found[mime]
            data = data.encode() if isinstance(data, str) and mime == "image/svg+xml" else data
            text = data if isinstance(data, str) else base64.b64encode(data).decode()
            return f'<img alt="" src="data:{mime};base64,{text.strip()}">'
    return found.get("text/html") or f"<pre>{escape(found.get('text/plain', ''))}</pre>" * bool(
        found
    )


def values_of(slider, n):
    """About n values of a slider, and the place among them of the one where it stands."""
    if hasattr(slider, "options"):
        options = list(slider.options)
    else:
        options = list(np.arange(slider.min, slider.max + slider.step / 2, slider.step).round(6))
    here = int(np.argmin([abs(value - slider.value) for value in options]))
    kept = sorted({here, *np.linspace(0, len(options) - 1, n).round().astype(int).tolist()})
    return [type(slider.value)(options[i]) for i in kept], kept.index(here)


def interact(function, **sliders):
    """In place of that of ipywidgets.

    The results for some values, and sliders that choose among them.
    """
    found = [values_of(slider, N_VALUES if len(sliders) == 1 else 3) for slider in sliders.values()]
    strides = [math.prod(len(values) for values, _ in found[i + 1 :]) for i in range(len(found))]
    start, frames, controls = (
        sum(at * stride for (_, at), stride in zip(found, strides, strict=True)),
        [],
        [],
    )
    for i, chosen in enumerate(itertools.product(*(values for values, _ in found))):
        with contextlib.redirect_stdout(io.StringIO()) as told:
            shown = html_of(function(**dict(zip(sliders, chosen, strict=True))))
        text = f"<pre>{escape(told.getvalue())}</pre>" * bool(told.getvalue())
        frames.append(f'<div class="frame"{" hidden" * (i != start)}>{shown}{text}</div>')
    for name, (values, at), stride in zip(sliders, found, strides, strict=True):
        labels = escape(json.dumps([f"{value:g}" for value in values]), quote=True)
        ends = f'min="0" max="{len(values) - 1}" value="{at}" data-stride="{stride}" data-labels="{labels}"'
        control = f'<input type="range" {ends} oninput="{escape(MOVE, quote=True)}">'
        controls.append(f"<label>{escape(name)} {control} <output>{values[at]:g}</output></label>")
    display(HTML(f'<div class="moved">{" ".join(controls)}{"".join(frames)}</div>'))


ipywidgets.interact = interact
