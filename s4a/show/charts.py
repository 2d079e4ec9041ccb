"""Charts of a study's numbers; every function takes arrays and gives a matplotlib Figure."""

import io
import re

import numpy as np
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from s4a.geometry.mesh import as_arrays
from s4a.show.draw import SIGNED, render, signed_colors

BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#777777"
PARTS = ("#bbbbbb", "#e69f00", "#009e73", BLUE, "#cc79a7", ORANGE, "#56b4e9", "#f0e442")
LOOK = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.edgecolor": GREY,
    "svg.hashsalt": "s4a",
}


def svg(figure):
    """The bytes of an SVG file of a Figure, the same for the same figure.

    Examples
    --------
    >>> from s4a.show.charts import svg, variance
    >>> svg(variance([0.7, 0.3])).startswith(b"<?xml")
    True
    """
    file = io.BytesIO()
    with rc_context(LOOK):
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    return file.getvalue()


def _figure(width, height, columns=1, **options):
    with rc_context(LOOK):
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, figure.subplots(1, columns, squeeze=False, **options)[0]


def on_circle(n):
    """Places ``(n, 2)`` spread evenly over the unit circle."""
    angle = 2 * np.pi * np.arange(n) / max(n, 1)
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


def surfaces(
    meshes, values=None, *, limit=None, label="", columns=4, flat=False, view="corner", up="z"
):
    """Pictures of surfaces side by side.

    Parameters
    ----------
    meshes : dict of str to Dataset
        Title of each picture and its mesh.
    values : dict of str to float ndarray, optional
        For the same titles colours ``(vertex, 3)``, or signed numbers ``(vertex,)``: these are
        drawn on one scale from -`limit` to `limit`, blue positive, with a colour bar.
    limit : float, optional
        By default the largest 99 % quantile of the absolute numbers.
    label : str
        Of the colour bar.
    columns : int
        Most pictures in a row.
    flat : bool
        Colours of labels: they are not mixed within a triangle.
    view, up
        See :func:`s4a.show.draw.rotation`.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> import s4a
    >>> from s4a.show.charts import surfaces
    >>> mesh = s4a.synthetic.sphere(100)
    >>> [ax.get_title() for ax in surfaces({"height": mesh}, {"height": mesh["position"].values[:, 2]}).axes]
    ['height', '']
    """
    values = {} if values is None else {title: np.asarray(v) for title, v in values.items()}
    signed = [v for v in values.values() if v.ndim == 1]
    if limit is None:
        limit = max((float(np.quantile(np.abs(v), 0.99)) for v in signed), default=1.0) or 1.0
    rows = -(-len(meshes) // columns)
    wide = min(columns, len(meshes))
    with rc_context(LOOK):
        figure = Figure(
            figsize=(2.5 * wide + 0.7 * bool(signed), 2.35 * rows), layout="constrained"
        )
        axes = figure.subplots(rows, wide, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, mesh) in zip(axes.flat, meshes.items(), strict=False):
        colors = values.get(title)
        if colors is not None and colors.ndim == 1:
            colors = signed_colors(colors, limit)
        ax.imshow(
            render(*as_arrays(mesh), colors=colors, flat=flat, view=view, up=up, size=(360, 300))
        )
        ax.set_title(title, parse_math=False)
    if signed:
        scale = ScalarMappable(Normalize(-limit, limit), SIGNED)
        figure.colorbar(scale, ax=axes, shrink=0.7, label=label, pad=0.01)
    return figure


def brief(names, room=16):
    """Names as short as they can be told apart.

    What all share at both ends is left out where one is long.

    Examples
    --------
    >>> from s4a.show.charts import brief
    >>> brief(["brain_01", "brain_02"]), brief(["subject_0001_left_hippocampus", "subject_0020_left_hippocampus"])
    (['brain_01', 'brain_02'], ['…0001…', '…0020…'])
    """
    if max(map(len, names), default=0) <= room:
        return list(names)

    def shared(texts):
        low, high = min(texts), max(texts)
        n = next((i for i, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), len(low))
        return len(re.match(r"(.*[_\W])?", low[:n], re.DOTALL)[0])  # up to a separator

    start = shared(names)
    stop = shared([name[start:][::-1] for name in names])
    found = [
        "…" * (start > 0) + name[start : len(name) - stop] + "…" * (stop > 0) for name in names
    ]
    return [
        name if len(name) <= room else f"{name[: room // 2 - 1]}…{name[-room // 2 :]}"
        for name in found
    ]


def _names(ax, places, names, size=6):
    """Names beside their points, each where it hides no other.

    One that finds no place is left out.
    """
    figure = ax.figure.get_size_inches() * 72 / [len(ax.figure.axes), 1]  # in points, as fonts are
    span = np.ptp(places, axis=0)
    at = (places - places.min(0)) / np.where(span > 0, span, 1) * 0.68 * figure
    room = (-0.06 * figure[0], 0.74 * figure[0])
    taken = [(x - 3, y - 3, x + 3, y + 3) for x, y in at]
    for i, (name, (x, y)) in enumerate(zip(brief(names), at, strict=True)):
        wide = 0.58 * size * len(name)
        for left, down in ((3, 3), (-3 - wide, 3), (3, -3 - size), (-3 - wide, -3 - size)):
            a, b, c, d = x + left, y + down, x + left + wide, y + down + size
            inside = room[0] <= a and c <= room[1]
            if inside and all(
                j == i or c < p or r < a or d < q or s < b for j, (p, q, r, s) in enumerate(taken)
            ):
                taken.append((a, b, c, d))
                look = {"fontsize": size, "color": "#333333", "zorder": 4, "parse_math": False}
                side = "left" if left > 0 else "right"
                ax.annotate(
                    name,
                    places[i],
                    (np.copysign(3, left), down),
                    textcoords="offset points",
                    ha=side,
                    **look,
                )
                break


def network(places, names, source, target, errors, highlight=None):
    """The graph of maps, once for each named array of edge errors, on one colour scale.

    Parameters
    ----------
    places : float ndarray (shape, 2)
    names : sequence of str
    source, target : int ndarray (pair,)
        Which shape each map takes and gives.
    errors : dict of str to float ndarray (pair,)
        Title of each picture and the value that colours its edges.
    highlight : int, optional
        The shape to mark.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, axes = _figure(4.6 * len(errors) + 0.6, 4.2, len(errors))
    finite = np.concatenate([value[np.isfinite(value)] for value in errors.values()])
    scale = ScalarMappable(Normalize(0, finite.max(initial=0) or 1), "viridis_r")
    for ax, (title, value) in zip(axes, errors.items(), strict=True):
        order = np.argsort(value)  # the worst on top
        lines = np.stack([places[source], places[target]], axis=1)[order]
        ax.add_collection(
            LineCollection(lines, colors=scale.to_rgba(value[order]), linewidths=1, alpha=0.8)
        )
        ax.scatter(*places.T, s=22, color="#333333", zorder=2)
        if highlight is not None:
            ax.scatter(
                *places[highlight], s=90, facecolor="none", edgecolor=ORANGE, linewidth=2, zorder=3
            )
        _names(ax, places, names)
        ax.set_title(
            f"{title}, median {np.nanmedian(value):.3g}" if np.isfinite(value).any() else title
        )
        ax.margins(0.12)
        ax.set_axis_off()
    figure.colorbar(scale, ax=list(axes), shrink=0.7, label="cycle error", pad=0.01)
    return figure


def matrices(named, limit=1.0):
    """Matrices side by side with signed colours, blue positive; `named` maps titles to arrays."""
    figure, axes = _figure(3.4 * len(named) + 0.7, 3.3, len(named))
    for ax, (title, values) in zip(axes, named.items(), strict=True):
        image = ax.imshow(values, cmap=SIGNED, vmin=-limit, vmax=limit, interpolation="nearest")
        ax.set(title=title, xlabel="mode of the source", ylabel="mode of the target")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(5, integer=True))
    figure.colorbar(image, ax=list(axes), shrink=0.8, pad=0.01)
    return figure


def ranked(names, values, label, highlight=None):
    """Bars in rising order; `highlight` is the index of a shape to mark."""
    order = np.argsort(values)
    figure, (ax,) = _figure(7.5, max(1.4, 0.5 + 0.17 * len(values)))
    place = np.arange(len(order))
    ax.barh(
        place, values[order], color=[ORANGE if i == highlight else BLUE for i in order], height=0.75
    )
    ax.set_yticks(place, np.array(brief(names), object)[order], fontsize=7, parse_math=False)
    ax.invert_yaxis()
    ax.margins(y=0.01)
    ax.set_xlabel(label)
    return figure


def stacked(names, parts, seconds):
    """Bars of seconds stacked by part, one for each name, the total at their end (Fig. 3).

    Parameters
    ----------
    names, parts : sequence of str
    seconds : float ndarray (name, part)
    """
    figure, (ax,) = _figure(8, 0.45 * len(names) + 1.4)
    left = np.zeros(len(names))
    for i, (part, length) in enumerate(zip(parts, np.transpose(seconds), strict=True)):
        ax.barh(
            np.arange(len(names)),
            length,
            left=left,
            height=0.65,
            label=part,
            color=PARTS[i % len(PARTS)],
        )
        left = left + length
    for place, total in enumerate(left):
        ax.annotate(
            f"{total:.3g} s",
            (total, place),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    ax.set_yticks(np.arange(len(names)), names, parse_math=False)
    ax.invert_yaxis()
    ax.set(xlabel="CPU time (s)", xlim=(0, 1.12 * left.max(initial=0) or 1))
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure


def variance(high, low=None):
    """Cumulative share of variance over the number of components.

    At high and low resolution (Fig. 5).
    """
    figure, (ax,) = _figure(5.2, 3.2)
    curves = (
        (low, "low resolution", ORANGE, {"ms": 8, "mfc": "none"}),
        (high, "high resolution", BLUE, {"ms": 4}),
    )
    for values, label, color, marker in curves:  # rings around dots: both are seen where they agree
        if values is not None:
            ratio = np.asarray(values)[:20]
            ax.plot(
                np.arange(1, len(ratio) + 1),
                np.cumsum(ratio),
                "o-",
                color=color,
                label=label,
                **marker,
            )
    ax.set(xlabel="number of components", ylabel="explained variance", ylim=(0, 1.03))
    ax.yaxis.set_major_formatter(PercentFormatter(1))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(axis="y", color="#dddddd")
    ax.legend(frameon=False, loc="lower right")
    return figure


def scores(score, names, highlight=None):
    """Scores of the shapes on the first components, two by two, in standard deviations."""
    planes = [(a, b) for a, b in ((0, 1), (0, 2)) if b < score.shape[1]] or [(0, 0)]
    figure, axes = _figure(4.2 * len(planes), 3.8, len(planes))
    for ax, (a, b) in zip(axes, planes, strict=True):
        ax.axhline(0, color="#dddddd", lw=1)
        ax.axvline(0, color="#dddddd", lw=1)
        colors = [ORANGE if i == highlight else BLUE for i in range(len(score))]
        ax.scatter(score[:, a], score[:, b], color=colors, s=20, zorder=2)
        _names(ax, score[:, [a, b]], names)
        ax.set(xlabel=f"component {a + 1} (sd)", ylabel=f"component {b + 1} (sd)")
        ax.margins(0.12)
    return figure


def color_bar(colormap, low, high, label):
    """A horizontal colour bar."""
    figure, (ax,) = _figure(4.2, 0.62)
    figure.colorbar(
        ScalarMappable(Normalize(low, high), colormap),
        cax=ax,
        orientation="horizontal",
        label=label,
    )
    return figure


def from_spec(spec, values=()):
    """A chart of a notebook panel as a Figure.

    ``scatter``, ``bars``, ``lines``, ``graph`` or ``matrix``.

    Parameters
    ----------
    spec : dict
        ``kind`` and its numbers, as :class:`s4a.widgets.chart.Chart` sends them to the browser.
    values : float ndarray
        The entries of a matrix, row by row.
    """
    kind = spec["kind"]
    if kind == "matrix":
        return matrices(
            {spec["title"]: np.reshape(values, (spec["rows"], spec["columns"]))}, spec["limit"]
        )
    figure, (ax,) = _figure(5, 3.6)
    if kind == "bars":
        place = np.arange(len(spec["names"]))
        ax.barh(place, spec["values"], color=BLUE)
        ax.set_yticks(place, brief(spec["names"]), parse_math=False)
        ax.invert_yaxis()
    if kind == "lines":
        for one in spec["series"]:
            ax.plot(one["x"], one["y"], color=one.get("color", BLUE), lw=1)
    if kind == "graph":
        places = np.stack([spec["x"], spec["y"]], axis=1)
        lines = np.stack([places[spec["source"]], places[spec["target"]]], axis=1)
        ax.add_collection(LineCollection(lines, colors=spec["colors"]))
        ax.set_axis_off()
    if kind in ("graph", "scatter"):
        ax.scatter(spec["x"], spec["y"], color=BLUE, zorder=2)
        _names(ax, np.stack([spec["x"], spec["y"]], axis=1), spec["names"])
    ax.set(
        title=spec.get("title", ""),
        xlabel=spec.get("xlabel", spec.get("label", "")),
        ylabel=spec.get("ylabel", ""),
    )
    return figure
