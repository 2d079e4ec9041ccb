"""First cell of every notebook of the documentation.

Panels and sliders as HTML that needs no kernel.
"""

import base64
import contextlib
import gzip
import io
import itertools
import math

import ipywidgets
import numpy as np
import pythreejs
from IPython import get_ipython
from IPython.display import HTML, display
from jinja2 import Environment
from markupsafe import Markup
from matplotlib.colors import to_rgb
from tqdm.notebook import tqdm as bar

import s4a.course
from s4a.geometry.mesh import as_arrays
from s4a.show.browser import PARTS
from s4a.show.draw import CLAY, data_uri, image_bytes, on_white, render
from s4a.show.panel_page import panel_html
from s4a.show.tiled_figure import TiledFigure
from s4a.widgets import threejs
from s4a.widgets.explore import Explore
from s4a.widgets.panel import KernelWidget

LIMIT = 1_500_000  # recorded characters of all panels of a cell
MOST = 3_700_000  # characters of their compressed pages; with pictures a page has less than 5 MB
N_VALUES = 5  # recorded values of a slider
# a panel is decompressed when it is first shown, and as high as its content
PANELS = """
<div class="panels">
<style>
.panels button { font: inherit; padding: 0.3em 0.8em; }
.panels button[aria-pressed=true] { font-weight: bold; border-bottom: 3px solid #0072b2; }
</style>
{% if pages | length > 1 %}
<div role="group" aria-label="Panels">
{% for title, _ in pages %}
<button type="button" aria-pressed="false">{{ title }}</button>
{% endfor %}
</div>
{% endif %}
{% for title, page in pages %}
<iframe class="panel" title="{{ title }}" data-page="{{ page }}" hidden></iframe>
{% endfor %}
<script>
{
  const box = document.currentScript.parentNode;
  const frames = [...box.querySelectorAll("iframe")];
  const buttons = [...box.querySelectorAll("button")];
  const fit = (frame) => {
    const page = frame.contentDocument.documentElement;
    frame.style.height = page.offsetHeight + 8 + "px";
  };
  const unpacked = (text) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };
  const show = async (i) => {
    frames.forEach((frame, j) => { frame.hidden = i !== j; });
    buttons.forEach((button, j) => button.setAttribute("aria-pressed", i === j));
    const frame = frames[i], packed = frame.dataset.page;
    if (!packed) return;
    delete frame.dataset.page;
    const page = await unpacked(packed);
    frame.addEventListener("load", () => {
      new ResizeObserver(() => fit(frame)).observe(frame.contentDocument.documentElement);
    });
    frame.srcdoc = page;
  };
  buttons.forEach((button, i) => button.addEventListener("click", () => show(i)));
  show(0);
}
</script>
</div>
"""
# the frames of a slider are a stride apart in the list of all frames
SLIDERS = """
<div class="moved">
{% for name, labels, at, stride in sliders %}
<label>{{ name }} <input type="range" min="0" max="{{ labels | length - 1 }}" value="{{ at }}"
data-stride="{{ stride }}" data-labels="{{ labels | tojson | forceescape }}"
oninput="
const all = this.closest('.moved'), inputs = [...all.querySelectorAll('input')];
const at = inputs.reduce((sum, input) => sum + input.value * input.dataset.stride, 0);
all.querySelectorAll('.frame').forEach((frame, i) => frame.hidden = i != at);
const told = this.parentNode.querySelector('output');
told.value = JSON.parse(this.dataset.labels)[this.value];
"> <output>{{ labels[at] }}</output></label>
{% endfor %}
{% for shown, told in frames %}
<div class="frame"{% if loop.index0 != start %} hidden{% endif %}>{{ shown }}
{% if told %}<pre>{{ told }}</pre>{% endif %}
</div>
{% endfor %}
</div>
"""
templates = Environment(autoescape=True)
format_of = get_ipython().display_formatter


def framed(panel):
    """Show a panel as a page within the page; tabs become buttons."""
    if isinstance(panel, Explore):
        panels = {}
        for title in panel.kinds:
            with contextlib.suppress(ValueError):  # the study lacks the data of the panel
                panels[title] = panel[title]
        panel.tabs.selected_index = 0
    else:
        panels = {panel.title: panel}
    limit = LIMIT if len(panels) == 1 else 2 * LIMIT // len(panels)
    while True:  # fine surfaces need fewer values of the controls
        pages = [(title, packed(one, limit)) for title, one in panels.items()]
        if sum(len(page) for _, page in pages) <= MOST or limit == 0:
            break
        limit = limit // 2 if limit > LIMIT // 100 else 0
    return templates.from_string(PANELS).render(pages=pages).strip()


def packed(panel, limit):
    """Compressed page of a panel, as text."""
    html = panel_html(panel, limit).encode()
    return base64.b64encode(gzip.compress(html, mtime=0)).decode()


KernelWidget.without_kernel = framed
begin_bar = bar.__init__


def no_bar(self, *values, **options):
    """Show no progress bars, which are widgets, too."""
    begin_bar(self, *values, **options | {"disable": True})


bar.__init__ = no_bar


def tubes(begin, end, colors, radius):
    """Prisms along lines ``(n, 3)`` to ``(n, 3)``: points, triangles, colours."""
    along = end - begin
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(1)])
    side *= radius / np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side) / np.linalg.norm(along, axis=1, keepdims=True)
    around = [np.cos(a) * side + np.sin(a) * other for a in 2 * np.pi * np.arange(3) / 3]
    X = np.stack([at + way for at in (begin, end) for way in around], axis=1)  # (n, 6, 3)
    T = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]])
    T = T + 6 * np.arange(len(X))[:, None, None]
    return X.reshape(-1, 3), T.reshape(-1, 3), np.repeat(colors, 6, axis=0)


def drawn(part, radius):
    """Points, triangles and colours of a mesh, or of wires and lines with a radius."""
    known = part.geometry
    if isinstance(known, pythreejs.LineSegmentsGeometry):
        begin, end = np.asarray(known.positions, float).transpose(1, 0, 2)
        return tubes(begin, end, np.asarray(known.colors)[:, 0], radius)
    if isinstance(known, pythreejs.SphereBufferGeometry):
        X, T = as_arrays(s4a.synthetic.sphere(200))
        color = np.tile(to_rgb(part.material.color), (len(X), 1))
        return X * known.radius + np.array(part.position), T, color
    X, T = known.attributes["position"].array + np.array(part.position), known.index.array
    T = T.reshape(-1, 3)
    if part.material.wireframe:
        edges = np.unique(np.sort(np.concatenate([T[:, :2], T[:, 1:], T[:, ::2]]), axis=1), axis=0)
        color = np.tile(to_rgb(part.material.color), (len(edges), 1))
        return tubes(*X[edges].transpose(1, 0, 2).astype(float), color, radius)
    clay = np.tile(to_rgb(CLAY), (len(X), 1))
    return X, T, known.attributes["color"].array if "color" in known.attributes else clay


def pictured(scene):
    """Picture of the surfaces and lines of a scene, which rotates in the notebook only."""
    parts = list(scene.scene.children)
    parts += [
        part for group in parts if isinstance(group, pythreejs.Group) for part in group.children
    ]
    meshes = [part for part in parts if hasattr(getattr(part, "geometry", None), "attributes")]
    corners = np.concatenate([mesh.geometry.attributes["position"].array for mesh in meshes])
    radius = 0.002 * np.linalg.norm(np.ptp(corners, axis=0))
    meshes += [
        part
        for part in parts
        if isinstance(getattr(part, "geometry", None), pythreejs.SphereBufferGeometry)
    ]
    points, triangles, colors = [], [], []
    for part in [*meshes, *(part for part in parts if isinstance(part, pythreejs.LineSegments2))]:
        X, T, color = drawn(part, radius)
        triangles.append(T + sum(map(len, points)))
        points.append(X)
        colors.append(color)
    camera = np.subtract(scene.camera.position, scene.controls[0].target)
    azimuth, height = np.arctan2(camera[1], camera[0]), np.hypot(*camera[:2])
    view = (float(np.rad2deg(azimuth)), float(np.rad2deg(np.arctan2(camera[2], height))))
    pixels = render(
        *map(np.concatenate, (points, triangles)),
        colors=np.concatenate(colors),
        view=view,
        size=(int(scene.width), int(scene.height)),
    )
    address = data_uri(image_bytes(on_white(pixels), "png"), "image/png")
    bars = [PARTS.color_bar(bar) for bar in (part.bar for part in parts if hasattr(part, "bar"))]
    return (
        f'<figure style="margin: 0"><img alt="A scene" src="{address}">{"".join(bars)}'
        "<figcaption>A picture: the scene itself turns in the notebook.</figcaption></figure>"
    )


format_of.formatters["text/html"].for_type(pythreejs.Renderer, pictured)
format_of.formatters["text/html"].for_type(threejs.Scores, lambda sliders: "")
format_of.formatters["text/html"].for_type(ipywidgets.HTML, lambda widget: widget.value)


def html_of(value):
    """Output of a value in a cell, as HTML."""
    if value is None:
        return ""
    if isinstance(value, TiledFigure):
        return Markup(value.html())
    shown, _ = format_of.format(value)
    if "image/png" in shown:
        data = shown["image/png"]
        address = (
            f"data:image/png;base64,{data.strip()}"
            if isinstance(data, str)
            else data_uri(data, "image/png")
        )
        return Markup('<img alt="" src="{}">').format(address)
    if "image/svg+xml" in shown:
        address = data_uri(shown["image/svg+xml"].encode(), "image/svg+xml")
        return Markup('<img alt="" src="{}">').format(address)
    if "text/html" in shown:
        return Markup(shown["text/html"])
    return Markup("<pre>{}</pre>").format(shown.get("text/plain", ""))


def values_of(slider, n):
    """Return about n values of a slider, and the index of its current value."""
    if hasattr(slider, "options"):
        options = list(slider.options)
    else:
        options = np.arange(slider.min, slider.max + slider.step / 2, slider.step).round(6)
        options = list(options + 0)  # no -0
    here = int(np.argmin([abs(value - slider.value) for value in options]))
    places = sorted({here, *np.linspace(0, len(options) - 1, n).round().astype(int).tolist()})
    return [type(slider.value)(options[i]) for i in places], places.index(here)


def slide(function, **sliders):
    """Replace the function of the course: record some values, and show them with sliders."""
    n = N_VALUES if len(sliders) == 1 else 3
    values, places = zip(*(values_of(slider, n) for slider in sliders.values()), strict=True)
    strides = [math.prod(map(len, values[i + 1 :])) for i in range(len(values))]
    frames = []
    for arguments in itertools.product(*values):
        with contextlib.redirect_stdout(io.StringIO()) as told:
            shown = html_of(function(**dict(zip(sliders, arguments, strict=True))))
        frames.append((shown, told.getvalue()))
    labels = [[f"{value:g}" for value in of_slider] for of_slider in values]
    page = templates.from_string(SLIDERS).render(
        sliders=list(zip(sliders, labels, places, strides, strict=True)),
        frames=frames,
        start=int(np.dot(places, strides)),
    )
    display(HTML(page))


s4a.course.slide = slide
