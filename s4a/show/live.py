"""Surfaces and sliders in a page without Python.

The scripts that draw them, and the numbers that these need.
"""

import base64
import json
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from s4a.method.pca import color_limits, low_vertices
from s4a.show.draw import SIGNED, rotation
from s4a.show.pictures import has, mesh_of, names_of

FOLDER = Path(__file__).parent / "esm"
LARGE = 20_000  # vertices from which a page moves the low-resolution mesh


def script(*names):
    """The text of some scripts, one after the other, as one module."""
    return "\n".join((FOLDER / f"{name}.js").read_text(encoding="utf-8") for name in names)


STYLE = (FOLDER / "style.css").read_text(encoding="utf-8")
MODES = script("dom", "surface", "view", "chart", "modes_widget")
MODEL = script("model")


def as_bytes(array, kind):
    """The bytes of an array of numbers, little-endian and contiguous, as the browser reads them.

    Examples
    --------
    >>> from s4a.show.live import as_bytes
    >>> as_bytes([1, 256], "uint16")
    b'\\x01\\x00\\x00\\x01'
    """
    return np.ascontiguousarray(array, np.dtype(kind).newbyteorder("<")).tobytes()


def color_bytes(colors):
    """Colours ``(n, 3)`` from 0 to 1 as bytes; rows that are not finite become grey."""
    colors = np.asarray(colors, float)
    return as_bytes(255 * np.where(np.isfinite(colors), np.clip(colors, 0, 1), 0.6) + 0.5, "uint8")


def color_bar(colormap, low, high, label):
    """What the browser draws as a colour bar.

    Eleven colours of a colour map, both ends and a label.
    """
    colors = colormaps.get_cmap(colormap)(np.linspace(0, 1, 11))
    return {
        "colors": [to_hex(c) for c in colors],
        "low": float(low),
        "high": float(high),
        "label": label,
    }


def table(colormap):
    """The 256 colours of a colour map as bytes."""
    return color_bytes(colormaps.get_cmap(colormap)(np.linspace(0, 1, 256))[:, :3])


def bars(limit, limit_magnitude, unit):
    """The colour bars of the three kinds of colours of the modes."""
    return {
        "normal": color_bar(
            SIGNED, -limit, limit, f"compression · normal displacement ({unit}) · expansion"
        ),
        "magnitude": color_bar("viridis", 0, limit_magnitude, f"distance from the mean ({unit})"),
        "none": {},
    }


def mesh_state(mean, triangles, deformation):
    """The bytes of a mean shape ``(n, 3)``, its triangles and deformations ``(c, n, 3)``."""
    return {
        "mean": as_bytes(mean, "float32"),
        "corner": as_bytes(triangles, "uint32"),
        "deformation": as_bytes(deformation, "float32"),
    }


def look_state(limits, unit, view, up):
    """Colours of the modes, and from where they are seen first."""
    return {
        "signed_table": table(SIGNED),
        "ramp_table": table("viridis"),
        "limit": limits[0],
        "limit_magnitude": limits[1],
        "bars": bars(*limits, unit),
        "turn": rotation(view, up).ravel().tolist(),
    }


def study_state(study, n_modes=None):
    """Shares of variance, scores and names of a study's modes."""
    pca = study["pca"].dataset.isel(component=slice(n_modes))
    low = "explained_variance_ratio_low" in pca
    return {
        "ratio": pca["explained_variance_ratio"].values.tolist(),
        "ratio_low": pca["explained_variance_ratio_low"].values.tolist() if low else [],
        "samples": pca["score"].values.tolist(),
        "names": names_of(pca),
    }


def template_coarse(study):
    """The low-resolution mesh of the template; None where the study has none with its vertices."""
    template = str(study["registration"].attrs.get("template", ""))
    if not has(study, "coarse") or template not in study["coarse"].children:
        return None
    coarse = study["coarse"][template].to_dataset()
    return coarse if "coarse_vertex" in coarse else None


def mode_arrays(study, coarse=None, n_modes=None):
    """Mean shape, triangles and deformations.

    On the vertices of the low-resolution mesh where it is given.
    """
    X, T = mesh_of(study["registration"])
    pca = study["pca"].dataset.isel(component=slice(n_modes))
    mean, deformation = X + pca["mean_displacement"].values, pca["deformation"].values
    if coarse is None:
        return mean, T, deformation
    kept = low_vertices(coarse)
    return mean[kept], coarse["corner_vertex"].values, deformation[:, kept]


def encoded(value):
    """A value as JSON; bytes in base 64, as ``{"base64": ...}``.

    Examples
    --------
    >>> from s4a.show.live import encoded
    >>> encoded({"n": 1, "b": b"abc"})
    '{"n": 1, "b": {"base64": "YWJj"}}'
    """

    def known(it):
        if isinstance(it, bytes):
            return {"base64": base64.b64encode(it).decode()}
        raise TypeError(f"{type(it).__name__} cannot be kept in a page")

    return json.dumps(value, default=known, ensure_ascii=False).replace("<", "\\u003c")


def widget_html(name, state):
    """The place of a widget in a page, and its state."""
    return f'<div id="{name}"></div><script type="application/json" id="{name}-state">{encoded(state)}</script>'


def module(text, names):
    """A script as a module of a page that draws the widgets of some names."""
    text = text.replace("export default", "const widget =").replace("</", "<\\/")
    each = "widget.render({ model: s4aModel(id), el: document.getElementById(id) });"
    return f'<script type="module">{text}\nfor (const id of {json.dumps(names)}) {each}</script>\n'


def modes_html(study, instead, view="corner", up="z"):
    """Sliders that move the mean shape of a study in the browser, as a part of a page.

    What they need is in it.

    The low-resolution mesh is moved where the template has more than 20,000 vertices.  `instead` is
    the HTML that is seen where there are no scripts or no WebGL2.
    """
    coarse = template_coarse(study)
    large = coarse is not None and study["registration"].sizes["vertex"] > LARGE
    arrays = mode_arrays(study, coarse if large else None)
    state = {
        **mesh_state(*arrays),
        **look_state(
            color_limits(*arrays), study["pca"]["deformation"].attrs.get("units", ""), view, up
        ),
        **study_state(study),
        "scores": [0.0] * len(arrays[2]),
        "colors": "normal",
        "beside": False,
        "sample": -1,
        "group": "",
        "height": 420,
        "webgl": "",
        "still": b"",
    }
    size = f"{len(arrays[0]):,} vertices" + (", low resolution" if large else "")
    swap = (
        '<script type="module">if (s4aModels.modes.get("webgl") === "yes") '
        'document.getElementById("modes-instead").hidden = true; else document.getElementById("modes").hidden = true;'
        "</script>"
    )
    note = f"<p class='note'>{size}</p><div id='modes-instead'>{instead}</div>"
    scripts = f"<script>{MODEL}</script>{module(MODES, ['modes'])}{swap}"
    return f"<style>{STYLE}</style>{widget_html('modes', state)}{note}{scripts}"
