"""The HTML of a page: pictures, charts, tables and sliders, everything inlined and escaped."""

import json
from html import escape

import numpy as np

from s4a.show.charts import svg
from s4a.show.draw import data_uri, image_bytes

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 1000px; margin: 0 auto; padding: 1em; }
h1 { margin-bottom: 0; } h2 { margin-top: 2em; border-bottom: 1px solid #ddd; }
.summary, figcaption, .note { color: #555; } .note { font-size: 90%; }
.missing { color: #777; background: #f5f5f5; padding: .6em 1em; border-left: 4px solid #ccc; }
figure { margin: 0; text-align: center; } figcaption { font-size: 80%; overflow-wrap: anywhere; }
img { max-width: 100%; height: auto; }
.row { display: grid; gap: .6em; grid-template-columns: repeat(3, 1fr); align-items: start; }
.four { grid-template-columns: repeat(4, 1fr); }
.gallery { display: grid; gap: .4em; grid-template-columns: repeat(auto-fill, minmax(140px, 1fr)); align-items: start; }
.marked { outline: 3px solid #d55e00; border-radius: 6px; } .marked figcaption { color: #d55e00; font-weight: bold; }
.table { max-height: 30em; overflow: auto; } input[type=range] { width: 90%; }
table { border-collapse: collapse; font-size: 85%; } th, td { text-align: left; padding: .2em .8em .2em 0; }
td { border-top: 1px solid #eee; vertical-align: top; overflow-wrap: anywhere; } td.number { text-align: right; }
td:nth-child(-n+2) { white-space: nowrap; }
tr.excluded td { background: #fbe9e0; } tr.repaired td { background: #fdf6dd; }
"""
SCRIPT = """
for (const slider of document.querySelectorAll("input[data-mode]")) {
  const figure = slider.closest("figure"), image = figure.querySelector("img"), text = figure.querySelector("output");
  const mode = JSON.parse(document.getElementById(slider.dataset.mode).textContent);
  slider.addEventListener("input", () => {
    image.src = mode.frames[slider.value];
    text.textContent = mode.labels[slider.value];
  });
}
"""


def document(title, summary, sections):
    """A whole page of sections, each a str of HTML."""
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<style>{STYLE}</style></head><body>\n<h1>{escape(title)}</h1>\n<p class="summary">{escape(summary)}</p>\n'
        + "\n".join(sections)
        + f"\n<script>{SCRIPT}</script></body></html>\n"
    )


def note(text):
    """A line of explanation."""
    return f'<p class="note">{escape(text)}</p>'


def grid(figures, kind="row"):
    """Figures side by side: three in a ``row``, or as many as fit in a ``gallery``."""
    return f'<div class="{kind}">{"".join(figures)}</div>'


def missing(names, reason=""):
    """A box that says what the run lacks, and why."""
    text = f"Not there: this run has no {', '.join(names)}" + (
        f", because of this: {reason}" if reason else ""
    )
    return f'<p class="missing">{escape(text)}.</p>'


def chart(figure, text):
    """A matplotlib Figure; `text` stands for it where it cannot be seen."""
    return f'<figure><img alt="{escape(text)}" src="{data_uri(svg(figure), "image/svg+xml")}"></figure>'


def picture(pixels, caption, *, marked=False):
    """A rendered surface over its caption."""
    height, width = pixels.shape[:2]
    return (
        f'<figure{" class=marked" if marked else ""}><img width="{width}" height="{height}" alt="{escape(caption)}" '
        f'src="{data_uri(image_bytes(pixels))}"><figcaption>{escape(caption)}</figcaption></figure>'
    )


def table(head, rows, classes=None):
    """A table of numbers and text, with a CSS class for each row."""

    def cell(value):
        number = isinstance(value, int | float | np.number)
        text = (
            f"{value:,}"
            if isinstance(value, int | np.integer)
            else f"{value:,.1f}"
            if number
            else str(value)
        )
        return f"<td{' class=number' if number else ''}>{escape(text)}</td>"

    classes = [""] * len(rows) if classes is None else classes
    body = (
        f'<tr class="{escape(c)}">{"".join(map(cell, row))}</tr>'
        for row, c in zip(rows, classes, strict=True)
    )
    head = "".join(f"<th>{escape(name)}</th>" for name in head)
    return f'<div class="table"><table><tr>{head}</tr>{"".join(body)}</table></div>'


def slider(mode, frames, labels, note):
    """A picture whose slider goes through frames drawn in advance."""
    uris, middle = [data_uri(image_bytes(frame)) for frame in frames], len(frames) // 2
    data = json.dumps({"frames": uris, "labels": labels}).replace("<", "\\u003c")
    return (
        f'<figure><img alt="{labels[middle]}" src="{uris[middle]}"><input type="range" data-mode="mode{mode}" min="0" '
        f'max="{len(frames) - 1}" value="{middle}" aria-label="component {mode + 1}">'
        f"<figcaption><output>{labels[middle]}</output><br>{note}</figcaption></figure>"
        f'<script type="application/json" id="mode{mode}">{data}</script>'
    )
