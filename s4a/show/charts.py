"""Charts of a study; the functions take arrays and return a matplotlib Figure."""

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, PercentFormatter
from matplotlib.transforms import Bbox

from s4a.geometry.mesh import as_arrays
from s4a.schema import Array
from s4a.show.draw import (
    CYCLE_ERROR,
    SIGNED,
    Viewpoint,
    cycle_error_colors,
    cycle_error_limits,
    plane_box,
    render,
    signed_colors,
)
from s4a.show.tiled_figure import TiledFigure

BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#777777"
PALE = "#bbbbbb"
PART_COLORS = ("#bbbbbb", "#e69f00", "#009e73", BLUE, "#cc79a7", ORANGE, "#56b4e9", "#f0e442")
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.edgecolor": GREY,
    "svg.hashsalt": "s4a",
}


def svg(figure: Figure) -> bytes:
    """Return a Figure as the bytes of an SVG file, which are reproducible.

    Examples
    --------
    >>> from s4a.show.charts import svg, variance
    >>> svg(variance([0.7, 0.3])).startswith(b"<?xml")
    True
    """
    file = io.BytesIO()
    with rc_context(STYLE):
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    return file.getvalue()


def _figure(width, height, columns=1, rows=1, kind=Figure):
    """Return a Figure of a size in inches, and its axes ``(rows, columns)``."""
    with rc_context(STYLE):
        figure = kind(figsize=(width, height), layout="constrained")
        return figure, figure.subplots(rows, columns, squeeze=False)


def on_circle(n: int) -> Array:
    """Return `n` equidistant points ``(n, 2)`` on the unit circle."""
    angle = 2 * np.pi * np.arange(n) / max(n, 1)
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


def reach(values: Array, share: float) -> float:
    """Return the `share` quantile of the absolute values without NaN; 0 if all are NaN.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.charts import reach
    >>> reach(np.array([-2.0, np.nan, 1.0, 0.0]), 0.5)
    1.0
    """
    known = np.abs(values)[~np.isnan(values)]
    return float(np.quantile(known, share)) if known.size else 0.0


def surfaces(
    meshes: dict[str, xr.Dataset],
    values: dict[str, Array] | None = None,
    *,
    limit: float | None = None,
    label: str = "",
    columns: int = 4,
    flat: bool = False,
    one_frame: bool = False,
    view: Viewpoint = "corner",
    up: str = "z",
) -> Figure:
    """Draw surfaces side by side, or below each other in a narrow cell.

    Parameters
    ----------
    meshes : dict of str to Dataset
        Title of each picture and its mesh.
    values : dict of str to float ndarray, optional
        For the same titles, colours ``(vertex, 3)`` or numbers ``(vertex,)``.  Numbers are drawn
        on one scale from -`limit` to `limit`, blue positive, with a colour bar, which begins at 0
        if no number is negative.  NaN is grey.
    limit : float, optional
        By default the largest 99 % quantile of the absolute values.
    label : str
        Label of the colour bar.
    columns : int
        Largest number of pictures in a row.
    flat : bool
        If True, colours are not interpolated within a triangle: for labels.
    one_frame : bool
        If True, all pictures show the same part of space, so that sizes and positions can be
        compared; by default each surface fills its picture.
    view, up
        See :func:`s4a.show.draw.rotation`.

    Returns
    -------
    matplotlib.figure.Figure

    See Also
    --------
    s4a.widgets.threejs.surface : an interactive surface.

    Examples
    --------
    >>> import s4a
    >>> from s4a.show.charts import surfaces
    >>> mesh = s4a.synthetic.sphere(2000)
    >>> height = mesh["position"].values[:, 2]
    >>> surfaces({"height": mesh}, {"height": height}, label="height")
    <TiledFigure ...>
    """
    values = {title: np.asarray(array) for title, array in (values or {}).items()}
    signed = [array for array in values.values() if array.ndim == 1]
    if limit is None:
        limit = max((reach(array, 0.99) for array in signed), default=1.0) or 1.0
    rows, columns = -(-len(meshes) // columns), min(columns, len(meshes))
    width = 2.5 * columns + 0.7 * bool(signed)
    figure, axes = _figure(width, 2.35 * rows, columns, rows, TiledFigure)
    figure.alt = ", ".join(meshes)
    frame = None
    if one_frame:
        corners = np.concatenate([as_arrays(mesh)[0] for mesh in meshes.values()])
        frame = plane_box(corners, view, up)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, mesh) in zip(axes.flat, meshes.items(), strict=False):
        colors = values.get(title)
        if colors is not None and colors.ndim == 1:
            colors = signed_colors(colors, limit)
        X, T = as_arrays(mesh)
        pixels = render(
            X, T, colors=colors, flat=flat, view=view, up=up, size=(360, 300), frame=frame
        )
        ax.imshow(pixels)
        ax.set_title(title, parse_math=False)
    if signed:
        scale = ScalarMappable(Normalize(-limit, limit), SIGNED)
        bar = figure.colorbar(scale, ax=axes, shrink=0.7, label=label, pad=0.01)
        if not any((array < 0).any() for array in signed):  # such as errors
            bar.ax.set_ylim(0, limit)
    return figure


def shortened(names: list[str], length: int = 16) -> list[str]:
    """Shorten names that are too long, and omit their common prefix and suffix.

    Examples
    --------
    >>> from s4a.show.charts import shortened
    >>> shortened(["brain_01", "brain_02"])
    ['brain_01', 'brain_02']
    >>> shortened(["subject_0001_left_hippocampus", "subject_0020_left_hippocampus"])
    ['…0001…', '…0020…']
    """
    if max(map(len, names), default=0) <= length:
        return list(names)

    def common(texts):
        """Return the length of the common prefix up to a separator."""
        first, last = min(texts), max(texts)
        same = (i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
        return len(re.findall(r"\A(?:.*[_\W])?", first[: next(same, len(first))], re.DOTALL)[0])

    start = common(names)
    stop = common([name[start:][::-1] for name in names])
    left, right = "…" * (start > 0), "…" * (stop > 0)
    cut = [left + name[start : len(name) - stop] + right for name in names]
    half = length // 2
    return [name if len(name) <= length else f"{name[: half - 1]}…{name[-half:]}" for name in cut]


def _write_names(figure, axes, positions, names):
    """Write names next to their points where they overlap nothing, and omit the others.

    The chart must be complete, as the places of points and the sizes of names are in pixels.  Of
    the four corners around a point, those away from the centre are tried first.
    """
    figure.draw_without_rendering()
    outline = withStroke(linewidth=2, foreground="white")  # over edges
    style = {"color": "#333333", "zorder": 4, "parse_math": False, "path_effects": [outline]}
    style |= {"fontsize": 8 if len(names) <= 12 else 6, "textcoords": "offset points"}
    for ax, points in zip(axes, positions, strict=True):
        at = ax.transData.transform(points)
        taken = [Bbox([point - 4, point + 4]) for point in at]
        for i, name in enumerate(shortened(names)):
            outward = np.sign(at[i] - at.mean(0))
            corners = [(3, 3), (-3, 3), (3, -3), (-3, -3)]
            for right, up in sorted(corners, key=lambda corner: -outward @ corner):
                side = {"ha": "left" if right > 0 else "right", "va": "bottom" if up > 0 else "top"}
                text = ax.annotate(name, points[i], (right, up), **side, **style)
                box = text.get_window_extent()
                others = taken[:i] + taken[i + 1 :]  # it may touch its own point
                if ax.bbox.x0 < box.x0 and box.x1 < ax.bbox.x1 and not box.count_overlaps(others):
                    taken.append(box)
                    break
                text.remove()


def network(
    positions: Array,
    names: list[str],
    source: Array,
    target: Array,
    errors: dict[str, Array],
    highlight: int | None = None,
) -> Figure:
    """Draw the network of maps once for each array of edge errors, on one logarithmic scale.

    Parameters
    ----------
    positions : float ndarray (shape, 2)
        Positions of the nodes.
    names : sequence of str
    source, target : int ndarray (pair,)
        Source and target node of each map.
    errors : dict of str to float ndarray (pair,)
        Title of each picture, and the errors that colour its edges; NaN is grey.
    highlight : int, optional
        Index of a node to mark.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.charts import network, on_circle
    >>> source, target = np.array([0, 1, 2, 3]), np.array([1, 2, 3, 0])
    >>> errors = {"before": np.array([0.1, 0.8, 0.3, 0.2]), "after": np.full(4, 0.05)}
    >>> network(on_circle(4), ["a", "b", "c", "d"], source, target, errors, highlight=1)
    <Figure ...>
    """
    figure, (axes,) = _figure(4.6 * len(errors) + 0.6, 4.2, len(errors))
    limits = cycle_error_limits(*errors.values())
    edges = np.stack([positions[source], positions[target]], axis=1)  # (pair, 2, 2)
    for ax, (title, value) in zip(axes, errors.items(), strict=True):
        order = np.argsort(np.nan_to_num(value, nan=-1))  # the largest on top, unknown below
        colors = cycle_error_colors(value[order], limits)
        ax.add_collection(LineCollection(list(edges[order]), colors=list(colors), linewidths=1.2))
        ax.scatter(*positions.T, s=22, color="#333333", zorder=2)
        if highlight is not None:
            ring = {"facecolor": "none", "edgecolor": ORANGE, "linewidth": 2}
            ax.scatter(*positions[highlight], s=90, zorder=3, **ring)
        if np.isfinite(value).any():
            title = f"{title}, median {np.nanmedian(value):.3g}"
        ax.set_title(title)
        ax.margins(0.12)
        ax.set_axis_off()
    scale = ScalarMappable(LogNorm(*limits), CYCLE_ERROR)
    bar = figure.colorbar(scale, ax=list(axes), shrink=0.7, label="cycle error", pad=0.01)
    ticks = np.geomspace(*limits, 5)
    bar.ax.minorticks_off()
    bar.set_ticks(ticks, labels=[f"{tick:.2g}" for tick in ticks])
    _write_names(figure, axes, [positions] * len(axes), names)
    return figure


def matrices(named: dict[str, Array]) -> Figure:
    """Draw functional maps side by side with signed colours from -1 to 1, blue positive.

    Parameters
    ----------
    named : dict of str to float ndarray (rows, columns)
        Title of each matrix and its entries.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.charts import matrices
    >>> Q = np.linalg.qr(np.random.default_rng(0).normal(size=(20, 20)))[0]
    >>> matrices({"identity": np.eye(20), "orthogonal": Q})
    <Figure ...>
    """
    figure, (frames,) = _figure(3.4 * len(named) + 0.7, 3.3, len(named))
    for ax, (title, values) in zip(frames, named.items(), strict=True):
        image = ax.imshow(values, cmap=SIGNED, vmin=-1, vmax=1, interpolation="nearest")
        ax.set(title=title, xlabel="eigenfunction of the source")
        ax.set_ylabel("eigenfunction of the target")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(5, integer=True))
    figure.colorbar(image, ax=list(frames), shrink=0.8, pad=0.01)
    return figure


def ranked(names: list[str], values: Array, label: str, highlight: int | None = None) -> Figure:
    """Draw bars in ascending order; `highlight` is the index of a shape to mark.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.charts import ranked
    >>> ranked(["a", "b", "c"], np.array([0.3, 0.1, 0.2]), "distance (eq. 5)", highlight=1)
    <Figure ...>
    """
    order = np.argsort(values)
    figure, ((ax,),) = _figure(7.5, max(1.4, 0.5 + 0.17 * len(values)))
    y = np.arange(len(order))
    colors = np.where(order == highlight, ORANGE, BLUE)
    ax.barh(y, values[order], color=colors, height=0.75)
    ax.set_yticks(y, np.array(shortened(names), object)[order], fontsize=7, parse_math=False)
    ax.invert_yaxis()
    ax.margins(y=0.01)
    ax.set_xlabel(label)
    return figure


def stacked(names: list[str], parts: list[str], seconds: Array) -> Figure:
    """Draw a stacked bar of seconds for each name, with the total at its end (Fig. 3).

    Parameters
    ----------
    names, parts : sequence of str
    seconds : float ndarray (name, part)

    Examples
    --------
    >>> from s4a.show.charts import stacked
    >>> stacked(["method A", "method B"], ["maps", "matches"], [[3.0, 1.0], [1.0, 2.0]])
    <Figure ...>
    """
    figure, ((ax,),) = _figure(8, 0.45 * len(names) + 1.4)
    y, left = np.arange(len(names)), np.zeros(len(names))
    for i, (part, length) in enumerate(zip(parts, np.transpose(seconds), strict=True)):
        color = PART_COLORS[i % len(PART_COLORS)]
        ax.barh(y, length, left=left, height=0.65, label=part, color=color)
        left = left + length
    options = {"textcoords": "offset points", "va": "center", "fontsize": 8}
    for i, total in enumerate(left):
        ax.annotate(f"{total:.3g} s", (total, i), (4, 0), **options)
    ax.set_yticks(y, names, parse_math=False)
    ax.invert_yaxis()
    ax.set(xlabel="CPU time (s)", xlim=(0, 1.12 * left.max(initial=0) or 1))
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure


def variance(high: Array | list[Any], low: Array | list[Any] | None = None) -> Figure:
    """Draw the cumulative explained variance at both resolutions (Fig. 5).

    Examples
    --------
    >>> from s4a.show.charts import variance
    >>> variance([0.5, 0.3, 0.1, 0.1], [0.52, 0.3, 0.1, 0.08])
    <Figure ...>
    """
    figure, ((ax,),) = _figure(5.2, 3.2)
    curves = (  # rings around dots: both are visible where they agree
        (low, "low resolution", ORANGE, {"ms": 8, "mfc": "none"}),
        (high, "high resolution", BLUE, {"ms": 4}),
    )
    for values, label, color, marker in curves:
        if values is not None:
            share = np.cumsum(np.asarray(values)[:20])
            count = np.arange(1, len(share) + 1)
            ax.plot(count, share, "o-", color=color, label=label, **marker)
    ax.set(xlabel="number of modes", ylabel="explained variance", ylim=(0, 1.03))
    ax.yaxis.set_major_formatter(PercentFormatter(1))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(axis="y", color="#dddddd")
    ax.legend(frameon=False, loc="lower right")
    return figure


def scores(
    score: Array,
    names: list[str],
    highlight: int | None = None,
    faint: Sequence[bool] | None = None,
) -> Figure:
    """Draw the scores of the shapes on the first modes of variation, in standard deviations.

    Shapes that are `faint` are grey.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.charts import scores
    >>> score = np.random.default_rng(0).normal(size=(8, 3))
    >>> scores(score, list("abcdefgh"), highlight=2, faint=[False] * 7 + [True])
    <Figure ...>
    """
    planes = [[a, b] for a, b in ((0, 1), (0, 2)) if b < score.shape[1]] or [[0, 0]]
    figure, (axes,) = _figure(4.2 * len(planes), 3.8, len(planes))
    colors = np.where(np.arange(len(score)) == highlight, ORANGE, BLUE)
    colors = np.where(np.zeros(len(score), bool) if faint is None else faint, PALE, colors)
    for ax, (a, b) in zip(axes, planes, strict=True):
        ax.axhline(0, color="#dddddd", lw=1)
        ax.axvline(0, color="#dddddd", lw=1)
        ax.scatter(score[:, a], score[:, b], color=colors, s=20, zorder=2)
        ax.set(xlabel=f"PC{a + 1} (sd)", ylabel=f"PC{b + 1} (sd)")
        ax.margins(0.12)
    _write_names(figure, axes, [score[:, plane] for plane in planes], names)
    return figure
