"""One self-contained HTML page of a study: pictures, charts and tables that open offline."""

from pathlib import Path

import numpy as np

from s4a.show import charts, markup
from s4a.show.draw import SIGNED, opposite, position_colors, ramp_colors, render
from s4a.show.live import modes_html
from s4a.show.pictures import (
    N_MODES,
    PANEL,
    SIGMA,
    aligned,
    carried_colors,
    has,
    mesh_of,
    mode_drawer,
    names_of,
    shared_frames,
)


def write_page(study, path, *, title="Shape study", view="corner", up="z"):
    """Write a study as one HTML page, which needs no network and no other file.

    What the run has not computed is said in its place and the rest is shown.

    Parameters
    ----------
    study : xarray.DataTree
    path : str or Path
        The file to write.
    title : str
    view, up
        From where surfaces are seen, and which axis points up; see :func:`s4a.show.draw.rotation`.

    Returns
    -------
    pathlib.Path

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import xarray as xr
    >>> import s4a
    >>> folder = Path(tempfile.mkdtemp())
    >>> s4a.write_page(xr.DataTree(), folder / "empty.html").name
    'empty.html'
    """
    path = Path(path)
    path.write_text(page(study, title=title, view=view, up=up), encoding="utf-8")
    return path


def page(study, *, title="Shape study", view="corner", up="z"):
    """The HTML of a study, as a str; see :func:`write_page`."""
    look = {"view": view, "up": up}
    sections = []
    for heading, needs, show in SECTIONS:
        lacking = [name for name in needs if not has(study, name)]
        reason = (
            _attr(study, "report", "no_modes")
            if any(name.startswith("pca/") for name in lacking)
            else ""
        )
        body = markup.missing(lacking, reason) if lacking else show(study, look)
        sections.append(f"<section><h2>{heading}</h2>\n{body}</section>")
    return markup.document(title, _summary(study), sections)


def _attr(study, node, name):
    return str(study[node].attrs.get(name, "")) if node in study.children else ""


def _index(names, name):
    return names.index(name) if name in names else None


# ---- sections


def _summary(study):
    parts = []
    if has(study, "report/status"):
        status = study["report"]["status"].values.astype(str)
        parts.append(
            f"{len(status)} shapes, {(status == 'repaired').sum()} repaired, {(status == 'excluded').sum()} excluded"
        )
    parts += [
        f"{key} {_attr(study, *where)}" for key, where in _MARKS.items() if _attr(study, *where)
    ]
    if has(study, "pca/explained_variance_ratio"):
        ratio = study["pca"]["explained_variance_ratio"].values[:N_MODES]
        parts.append(f"the first {len(ratio)} components hold {ratio.sum():.0%} of the variance")
    if has(study, "report/seconds"):
        parts.append(f"{study['report']['seconds'].values.sum():.0f} s of computing")
    return "; ".join(parts) + "." if parts else "The study is empty."


_MARKS = {"median": ("latent", "median"), "template": ("registration", "template")}


def _shapes(study, look):
    report = study["report"].dataset
    names = names_of(report)
    status = report["status"].values.astype(str)
    columns = [
        key
        for key in ("reason", "warning", "path")
        if key in report and (report[key].values != "").any()
    ]
    rows = []
    for i, name in enumerate(names):
        mesh = (
            study["original"][name]
            if has(study, "original") and name in study["original"].children
            else None
        )
        size = [mesh.sizes["vertex"], mesh.sizes["triangle"]] if mesh is not None else ["", ""]
        rows.append([name, status[i], *size, *(report[key].values[i] for key in columns)])
    return markup.table(["shape", "status", "vertices", "triangles", *columns], rows, status)


def _gallery(study, look):
    nodes = study["coarse"].children
    meshes = {name: mesh_of(node) for name, node in nodes.items()}
    meshes = {name: (aligned(study, name, X), T) for name, (X, T) in meshes.items()}
    frames = shared_frames([X for X, _ in meshes.values()], look)
    median = _attr(study, "latent", "median")
    figures = [
        markup.picture(
            render(X, T, size=(150, 130), frame=frame, **look),
            f"{name}, the median" if name == median else name,
            marked=name == median,
        )
        for (name, (X, T)), frame in zip(meshes.items(), frames, strict=True)
    ]
    return markup.note("The low-resolution meshes, all at one scale.") + markup.grid(
        figures, "gallery"
    )


def _stage(pairs, dim):
    """When a map was made, and its size."""
    when = "before" if dim.endswith("initial") else "after"
    return f"{when} Consistent ZoomOut" + (
        f", {pairs.sizes[dim]} modes" if dim in pairs.sizes else ""
    )


def _network(study, look):
    pairs = study["network"].dataset
    source, target = (pairs[key].values.astype(str) for key in ("source", "target"))
    names = list(np.unique(np.r_[source, target]))
    scores = study["latent"].dataset.get("area_score") if "latent" in study.children else None
    usable = (
        scores is not None
        and scores.sizes["difference_component"] > 1
        and set(names) <= set(names_of(scores))
    )
    places = scores.sel(shape=names).values[:, :2] if usable else charts.on_circle(len(names))
    where = (
        "placed by the first two components of their area-based shape differences"
        if usable
        else "on a circle"
    )
    kinds = {"cycle_error_initial": "before", "cycle_error": "after"}
    errors = {
        f"{when} Consistent ZoomOut": pairs[key].values
        for key, when in kinds.items()
        if key in pairs
    }
    figure = charts.network(
        places,
        names,
        np.searchsorted(names, source),
        np.searchsorted(names, target),
        errors,
        _index(names, _attr(study, "latent", "median")),
    )
    note = f"{len(source)} maps among {len(names)} shapes, {where}; the median is circled. "
    note += "Both errors are of the first modes, as many as the maps had before."
    return markup.note(note) + markup.chart(figure, "the network of maps, coloured by cycle error")


def _maps(study, look):
    pairs = study["network"].dataset
    order = (
        np.argsort(pairs["cycle_error"].values)
        if "cycle_error" in pairs
        else np.arange(pairs.sizes["pair"])
    )
    pair = pairs.isel(pair=order[len(order) // 2])
    kinds = {"fmap_initial": "mode_source_initial", "fmap": "mode_source"}
    figure = charts.matrices(
        {_stage(pairs, dim): pair[key].values for key, dim in kinds.items() if key in pair}
    )
    text = f"{pair['source'].item()} → {pair['target'].item()}, a pair of median cycle error"
    return markup.note(text) + markup.chart(figure, text)


def _distances(study, look):
    distance = study["latent"]["distance_to_median"]
    names = names_of(distance)
    median = _index(names, _attr(study, "latent", "median"))
    figure = charts.ranked(names, distance.values, "distance to the limit shape", median)
    return markup.note(
        "The median (eq. 5) is the shape nearest to the limit shape."
    ) + markup.chart(figure, "the shapes ranked by their distance to the limit shape")


def _modes(study, look):
    draw, limit = mode_drawer(study, look)
    unit = study["pca"]["deformation"].attrs.get("units", "")
    sigmas = np.linspace(-SIGMA, SIGMA, 13 if study["registration"].sizes["vertex"] < 50_000 else 7)
    rows, sliders = [], []
    for mode, ratio in enumerate(study["pca"]["explained_variance_ratio"].values[:N_MODES]):
        frames = [draw(mode, s) for s in sigmas]
        name = f"component {mode + 1}"
        labels = [f"{name}, {s:+.3g} σ".replace("-", "−") if s else f"{name}, mean" for s in sigmas]
        rows += [markup.picture(frames[i], labels[i]) for i in (0, len(frames) // 2, -1)]
        behind = draw(mode, SIGMA, view=opposite(look["view"]))
        rows.append(markup.picture(behind, f"{labels[-1]}, from behind"))
        sliders.append(markup.slider(mode, frames, labels, f"{ratio:.1%} of the variance"))
    bar = charts.color_bar(SIGNED, -limit, limit, f"displacement along the normal ({unit})")
    note = markup.note(
        "Blue is expansion, red is compression, against the mean; one colour scale for all."
    )
    sliders = "<h3>Move along the components</h3>" + modes_html(study, markup.grid(sliders), **look)
    return f"{note}{markup.grid(rows, 'row four')}{markup.chart(bar, 'colour bar')}\n{sliders}"


def _variance(study, look):
    pca = study["pca"].dataset
    low = (
        pca["explained_variance_ratio_low"].values
        if "explained_variance_ratio_low" in pca
        else None
    )
    return markup.chart(
        charts.variance(pca["explained_variance_ratio"].values, low),
        "cumulative explained variance",
    )


def _scores(study, look):
    score = study["pca"]["score"]
    names = names_of(score)
    template = _index(names, _attr(study, "registration", "template"))
    return markup.chart(
        charts.scores(score.values, names, template), "scores of the shapes; the template is orange"
    )


def _correspondence(study, look):
    registration = study["registration"]
    X, T = mesh_of(registration)
    colors, template = position_colors(X), registration.attrs.get("template", "")
    surfaces = {f"{template}, the template": (X, T, colors)}
    for name in [name for name in names_of(registration) if name != template][:5]:
        if (carried := carried_colors(study, name, colors)) is not None:
            surfaces[name] = carried
    frames = shared_frames([surface[0] for surface in surfaces.values()], look)
    figures = [
        markup.picture(render(X, T, colors=colors, size=PANEL, frame=frame, **look), name)
        for (name, (X, T, colors)), frame in zip(surfaces.items(), frames, strict=True)
    ]
    note = "The template's coordinates as colours, carried to other shapes: the same colour is the same place."
    return markup.note(note) + markup.grid(figures)


def _confidence(study, look):
    registration = study["registration"].dataset
    X, T = mesh_of(registration)
    confidence = registration["confidence"]
    mean, names = confidence.mean("vertex").values, names_of(registration)
    surfaces = {"mean over the shapes, on the template": (X, confidence.mean("shape").values)}
    for i in np.argsort(mean)[:2]:
        moved = X + registration["displacement"].isel(shape=i).values
        surfaces[f"{names[i]}: {mean[i]:.2f} on average"] = (moved, confidence.isel(shape=i).values)
    figures = [
        markup.picture(render(X, T, colors=ramp_colors(value, 0, 1), size=PANEL, **look), caption)
        for caption, (X, value) in surfaces.items()
    ]
    bar = markup.chart(charts.color_bar("viridis", 0, 1, "confidence"), "colour bar")
    for name, words in (
        ("round_trip", "cycle error, shares of sqrt(area)"),
        ("distortion", "distortion |log(area ratio)|"),
    ):
        if name in registration:
            value = np.abs(registration[name]).mean("shape").values
            limit = float(np.quantile(value, 0.95)) or 1.0
            picture = render(X, T, colors=ramp_colors(value, 0, limit), size=PANEL, **look)
            figures.append(
                markup.picture(picture, f"{words}, from 0 to {limit:.2g}; mean over the shapes")
            )
    note = (
        "Everywhere, and the shapes where it is lowest; what the registration does to the surface."
    )
    return markup.note(note) + markup.grid(figures) + bar


def _resources(study, look):
    report = study["report"].dataset
    columns = {"seconds": "seconds", "peak_memory": "peak memory (MiB)"}
    columns = {key: head for key, head in columns.items() if key in report}
    stages = report["seconds"]["stage"].values
    rows = [
        [str(stage), *(float(report[key].values[i]) for key in columns)]
        for i, stage in enumerate(stages)
    ]
    return markup.table(["stage", *columns.values()], rows)


def _parameters(study, look):
    rows = [[key, value] for key, value in study["report"].attrs.items() if str(value)]
    return markup.table(["parameter", "value"], rows) if rows else markup.missing(["parameters"])


SECTIONS = (
    ("Shapes", ["report/status"], _shapes),
    ("Gallery", ["coarse"], _gallery),
    ("Network of maps", ["network/source", "network/target", "network/cycle_error"], _network),
    ("Functional maps", ["network/fmap"], _maps),
    ("Distance to the limit shape", ["latent/distance_to_median"], _distances),
    ("Modes of variation", ["registration/position", "pca/deformation"], _modes),
    ("Explained variance", ["pca/explained_variance_ratio"], _variance),
    ("Scores", ["pca/score"], _scores),
    ("Correspondence", ["registration/position", "registration/registered_match"], _correspondence),
    (
        "Confidence",
        ["registration/position", "registration/confidence", "registration/displacement"],
        _confidence,
    ),
    ("Time and memory", ["report/seconds"], _resources),
    ("Parameters", ["report/status"], _parameters),
)
