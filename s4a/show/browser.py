"""What a browser gets: templates of pages, the scripts that draw, numbers as bytes and JSON.

Templates are jinja2's and escape whatever is put into them; only what is :class:`Markup` already,
such as another part of a page, goes in as it is.
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

from s4a.show import charts
from s4a.show.draw import SIGNED, UNKNOWN, Viewpoint, data_uri, image_bytes, rotation

FOLDER = Path(__file__).parent


def script(*names: str) -> str:
    """The text of some scripts, one after the other, as one module."""
    files = [FOLDER / "esm" / f"{name}.js" for name in names]
    return "\n".join(file.read_text(encoding="utf-8") for file in files)


STYLE = (FOLDER / "esm" / "style.css").read_text(encoding="utf-8")
SCENE = script("dom", "surface", "view", "gif", "save", "scene_widget")
CHART = script("dom", "chart", "chart_widget")
MODES = script("dom", "surface", "view", "gif", "save", "chart", "modes_widget")
FRAME = script("dom", "frame_widget")


# ---- numbers for the scripts


def to_bytes(array: np.ndarray | list[Any], kind: str) -> bytes:
    """The bytes of an array of numbers, little-endian and contiguous, as the browser reads them.

    Examples
    --------
    >>> from s4a.show.browser import to_bytes
    >>> to_bytes([1, 256], "uint16")
    b'\\x01\\x00\\x00\\x01'
    """
    return np.ascontiguousarray(array, np.dtype(kind).newbyteorder("<")).tobytes()


def color_bytes(colors: np.ndarray | list[Any]) -> bytes:
    """Colours ``(n, 3)`` from 0 to 1 as bytes; rows that are not finite become grey."""
    colors = np.asarray(colors, float)
    known = np.where(np.isfinite(colors), np.clip(colors, 0, 1), UNKNOWN)
    return to_bytes(255 * known + 0.5, "uint8")


def palette(colormap: str | Colormap) -> bytes:
    """The 256 colours of a colour map as bytes."""
    return color_bytes(colormaps.get_cmap(colormap)(np.linspace(0, 1, 256))[:, :3])


def color_scale(colormap: str | Colormap, low: float, high: float, label: str) -> dict[str, Any]:
    """What the browser draws as a colour bar: eleven colours, the numbers of both ends, a label."""
    colors = colormaps.get_cmap(colormap)(np.linspace(0, 1, 11))
    return {
        "colors": [to_hex(color) for color in colors],
        "low": float(low),
        "high": float(high),
        "label": label,
    }


def mesh_state(mean: np.ndarray, triangles: np.ndarray, deformation: np.ndarray) -> dict[str, Any]:
    """The bytes of a mean shape ``(n, 3)``, its triangles and deformations ``(c, n, 3)``."""
    return {
        "mean": to_bytes(mean, "float32"),
        "corner": to_bytes(triangles, "uint32"),
        "deformation": to_bytes(deformation, "float32"),
    }


def look_state(limits: tuple[float, float], unit: str, view: Viewpoint, up: str) -> dict[str, Any]:
    """Colours of the modes, full at the two `limits`, and from where they are seen first."""
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
        "turn": rotation(view, up).ravel().tolist(),
    }


def to_json(value: object) -> Markup:
    """A value as JSON that may stand in a page; bytes in base 64, as ``{"base64": ...}``.

    Examples
    --------
    >>> from s4a.show.browser import to_json
    >>> print(to_json({"n": 1, "b": b"abc", "text": "</script>"}))
    {"n": 1, "b": {"base64": "YWJj"}, "text": "\\u003c/script\\u003e"}
    """

    def of_bytes(other):
        if isinstance(other, bytes):
            return {"base64": base64.b64encode(other).decode()}
        raise TypeError(f"{type(other).__name__} cannot be kept in a page")

    return htmlsafe_json_dumps(value, default=of_bytes, ensure_ascii=False)


# ---- templates


def numeral(value: object) -> str:
    """A number with commas between its thousands, and one decimal if it is no integer; or text.

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


def webp_uri(pixels: np.ndarray) -> str:
    """A rendered picture as the address of an image inside a page."""
    return data_uri(image_bytes(pixels))


def svg_uri(figure: Figure) -> str:
    """A matplotlib Figure as the address of an image inside a page."""
    return data_uri(charts.svg(figure), "image/svg+xml")


def for_page(text: str) -> Markup:
    """A widget's script as a part of a page, where the widget is called ``widget``."""
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
# its macros are functions that give Markup
PARTS: Any = TEMPLATES.get_template("parts.html").module
