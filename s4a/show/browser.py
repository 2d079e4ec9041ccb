"""Templates and scripts for the browser, and the encoding of numbers as bytes and JSON.

The jinja2 templates escape all values except :class:`Markup`, such as another part of a page.
"""

import base64
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from matplotlib import colormaps
from matplotlib.colors import Colormap, to_hex
from matplotlib.figure import Figure

from s4a.schema import Array
from s4a.show import charts
from s4a.show.draw import SIGNED, UNKNOWN, Viewpoint, data_uri, image_bytes, rotation

FOLDER = Path(__file__).parent


def script(*names: str) -> str:
    """Concatenate scripts to one module."""
    files = [FOLDER / "esm" / f"{name}.js" for name in names]
    return "\n".join(file.read_text(encoding="utf-8") for file in files)


STYLE = (FOLDER / "esm" / "style.css").read_text(encoding="utf-8")
SCENE = script("dom", "surface", "view", "gif", "save", "scene_widget")
CHART = script("dom", "chart", "chart_widget")
MODES = script("dom", "surface", "view", "gif", "save", "chart", "modes_widget")
FRAME = script("dom", "frame_widget")


# ---- numbers for the scripts


def to_bytes(array: Array | list[Any], kind: str) -> bytes:
    """Return an array as contiguous little-endian bytes.

    Examples
    --------
    >>> from s4a.show.browser import to_bytes
    >>> to_bytes([1, 256], "uint16")
    b'\\x01\\x00\\x00\\x01'
    """
    return np.ascontiguousarray(array, np.dtype(kind).newbyteorder("<")).tobytes()


def color_bytes(colors: Array | list[Any]) -> bytes:
    """Return colours ``(n, 3)`` from 0 to 1 as bytes; non-finite rows are grey."""
    colors = np.asarray(colors, float)
    known = np.where(np.isfinite(colors), np.clip(colors, 0, 1), UNKNOWN)
    return to_bytes(255 * known + 0.5, "uint8")


def palette(colormap: str | Colormap) -> bytes:
    """Return 256 colours of a colour map as bytes."""
    return color_bytes(colormaps.get_cmap(colormap)(np.linspace(0, 1, 256))[:, :3])


def color_scale(colormap: str | Colormap, low: float, high: float, label: str) -> dict[str, Any]:
    """Return a colour bar for the browser: eleven colours, the values at both ends, a label."""
    colors = colormaps.get_cmap(colormap)(np.linspace(0, 1, 11))
    return {
        "colors": [to_hex(color) for color in colors],
        "low": float(low),
        "high": float(high),
        "label": label,
    }


def mesh_state(mean: Array, triangles: Array, deformation: Array) -> dict[str, Any]:
    """Return a mean shape ``(n, 3)``, its triangles and deformations ``(c, n, 3)`` as bytes."""
    return {
        "mean": to_bytes(mean, "float32"),
        "corner": to_bytes(triangles, "uint32"),
        "deformation": to_bytes(deformation, "float32"),
    }


def appearance_state(
    limits: tuple[float, float], unit: str, view: Viewpoint, up: str
) -> dict[str, Any]:
    """Return the colour scales of modes, which end at the two `limits`, and the initial view."""
    along, distance = limits
    signed = f"compression · normal displacement ({unit}) · expansion"
    scales = {
        "normal": color_scale(SIGNED, -along, along, signed),
        "magnitude": color_scale("viridis", 0, distance, f"distance from the mean ({unit})"),
        "none": {},
    }
    return {
        "signed_palette": palette(SIGNED),
        "ramp_palette": palette("viridis"),
        "limit": along,
        "limit_magnitude": distance,
        "bars": scales,
        "rotation": rotation(view, up).ravel().tolist(),
    }


def to_json(value: object) -> Markup:
    """Return a value as JSON for a page; bytes are encoded as ``{"base64": ...}``.

    Examples
    --------
    >>> from s4a.show.browser import to_json
    >>> print(to_json({"n": 1, "b": b"abc", "text": "</script>"}))
    {"n": 1, "b": {"base64": "YWJj"}, "text": "\\u003c/script\\u003e"}
    """

    def encode(other):
        if isinstance(other, bytes):
            return {"base64": base64.b64encode(other).decode()}
        raise TypeError(f"{type(other).__name__} cannot be stored in a page")

    return htmlsafe_json_dumps(value, default=encode, ensure_ascii=False)


# ---- templates


def numeral(value: object) -> str:
    """Format a number with thousands separators, and one decimal unless it is an integer.

    Examples
    --------
    >>> from s4a.show.browser import numeral
    >>> numeral(1200), numeral(1.25), numeral("ok")
    ('1,200', '1.2', 'ok')
    """
    if isinstance(value, Markup):
        return value
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    return f"{value:,.1f}" if isinstance(value, float | np.floating) else str(value)


def webp_uri(pixels: Array) -> str:
    """Return a rendered picture as a data URI."""
    return data_uri(image_bytes(pixels))


def svg_uri(figure: Figure) -> str:
    """Return a matplotlib Figure as a data URI."""
    return data_uri(charts.svg(figure), "image/svg+xml")


def for_page(text: str) -> Markup:
    """Return a widget's script for a page, as the constant ``widget``."""
    return Markup(text.replace("export default", "const widget =").replace("</", "<\\/"))


TEMPLATES = Environment(
    loader=FileSystemLoader(FOLDER / "templates"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.filters |= {
    function.__name__: function for function in (for_page, numeral, svg_uri, to_json, webp_uri)
}
TEMPLATES.globals |= {"script": lambda *names: Markup(script(*names)), "style": Markup(STYLE)}
# its macros are functions that return Markup
PARTS: Any = TEMPLATES.get_template("parts.html").module
