"""One self-contained HTML page of a study: pictures, charts and tables that open offline."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from markupsafe import Markup

from s4a.input.plausibility import decisions, notices
from s4a.options import kept_options
from s4a.schema import check_type
from s4a.show import charts
from s4a.show.browser import MODES, PARTS, TEMPLATES, look_state, mesh_state, webp_uri
from s4a.show.draw import SIGNED, Viewpoint, opposite, position_colors, ramp_colors, render
from s4a.show.pictures import N_MODES, PANEL, SIGMA, mode_pictures, shared_frames
from s4a.show.surfaces import (
    N_LIVE,
    attribute,
    has,
    labelled,
    low_text,
    mesh_of,
    mode_arrays,
    mode_limits,
    names_of,
    network_places,
    score_state,
    surface,
    template_coarse,
    transferred_colors,
)
from s4a.study.tree import left_out, seconds_of

LARGE = 20_000  # vertices from which a page moves the low-resolution mesh
N_TRANSFERRED = 5  # shapes to which the template's colours are carried


def write_page(
    study: xr.DataTree,
    path: Path | str,
    *,
    title: str = "Shape study",
    view: Viewpoint = "corner",
    up: str = "z",
) -> Path:
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
    path.write_text(study_html(study, title=title, view=view, up=up), encoding="utf-8")
    return path


def study_html(
    study: xr.DataTree,
    *,
    title: str = "Shape study",
    view: Viewpoint = "corner",
    up: str = "z",
) -> str:
    """The HTML of a study; see :func:`write_page`."""
    check_type(study, xr.DataTree)
    sections = []
    for heading, needs, section in SECTIONS:
        lacking = [name for name in needs if not has(study, name)]
        if lacking:
            modes_lack = any(name.startswith("pca/") for name in lacking)
            reason = attribute(study, "report", "no_modes") if modes_lack else ""
            sections.append((heading, PARTS.missing(lacking, reason)))
        else:
            sections.append((heading, section(study, {"view": view, "up": up})))
    template = TEMPLATES.get_template("study.html")
    facts = {"summary": _summary(study), "warnings": _warnings(study)}
    return template.render(title=title, sections=sections, **facts)


def _pictures(study):
    """The place in the page of every shape's picture, by its name."""
    names = study["coarse"].children if has(study, "coarse") else ()
    return {name: f"shape-{i}" for i, name in enumerate(names)}


def _linked(names, places):
    """Names of shapes, as links to their pictures where there are any."""
    return [PARTS.link(name, places[name]) if name in places else name for name in names]


def _index(names, name):
    return names.index(name) if name in names else None


# ---- sections


def _summary(study):
    facts = []
    if has(study, "report/status"):
        status = study["report"]["status"].values.astype(str)
        count = {kind: (status == kind).sum() for kind in ("repaired", "flagged", "excluded")}
        counts = [f"{number} {kind}" for kind, number in count.items()]
        facts.append(f"{len(status)} shapes, {', '.join(counts)}")
    for node, key in (("latent", "median"), ("registration", "template")):
        if name := attribute(study, node, key):
            facts.append(f"{key} {name}")
    if has(study, "pca/explained_variance_ratio"):
        ratio = _ratio(study)
        facts.append(f"the first {len(ratio)} components hold {ratio.sum():.0%} of the variance")
    if has(study, "report/seconds"):
        facts.append(seconds_of(study["report"].to_dataset()))
    return "; ".join(facts) + "." if facts else "The study is empty."


def _warnings(study):
    """What of the report a reader should know first: shapes left out, flagged, odd; or nothing."""
    if not has(study, "report/status"):
        return Markup("")
    report, places = study["report"].dataset, _pictures(study)
    status, names = report["status"].values.astype(str), np.array(names_of(report))
    lines = []
    if (status == "excluded").any():
        left = _linked(names[status == "excluded"], places)
        lines.append(("excluded", "left out, for the reasons in the table of shapes", left))
    for kind, found in (("flagged", decisions(report)), ("odd", notices(report))):
        for one in found:
            lines.append((kind, f"{one.kind} ({one.remedy})", _linked(one.names, places)))
    if not lines:
        return Markup("")
    become = "Flagged shapes are registered, and in no modes, no statistics and no median; "
    become += "s4a run ... --include-flagged takes all of them in."
    if kept_options(report).get("include_flagged"):
        become = "Flagged shapes were taken into modes and statistics by include_flagged."
    note = PARTS.note(become) if (status == "flagged").any() else Markup("")
    return PARTS.warnings(lines) + note


def _shapes(study, look):
    report = study["report"].dataset
    status = report["status"].values.astype(str)
    texts = [
        key
        for key in ("reason", "warning", "path")
        if key in report and (report[key].values != "").any()
    ]
    meshes = study["original"].children if has(study, "original") else {}
    names = names_of(report)
    rows, linked = [], _linked(names, _pictures(study))
    for i, name in enumerate(names):
        size = ["", ""]
        if name in meshes:
            size = [meshes[name].sizes[kind] for kind in ("vertex", "triangle")]
        rows.append([linked[i], status[i], *size, *(report[key].values[i] for key in texts)])
    head = ["shape", "status", "vertices", "triangles", *texts]
    return PARTS.table(head, rows, status.tolist(), name="the shapes")


def _gallery(study, look):
    names = list(study["coarse"].children)
    texts = {name: text for text, name in labelled(study, names)}
    meshes = [surface(study, name) for name in names]
    frames = shared_frames([X for X, _ in meshes], look)
    median, places = attribute(study, "latent", "median"), _pictures(study)
    figures = []
    for name, (X, T), frame in zip(names, meshes, frames, strict=True):
        pixels = render(X, T, size=(150, 130), frame=frame, **look)
        caption = f"{texts[name]}, the median" if name == median else texts[name]
        figures.append(PARTS.picture(pixels, caption, name == median, places[name]))
    kinds = {low_text(study["coarse"][name].dataset) or "low-resolution meshes" for name in names}
    note = PARTS.note(f"The {' and '.join(sorted(kinds))}, all at one scale.")
    return note + PARTS.grid(figures, "gallery")


def _network(study, look):
    pairs = study["network"].dataset
    source, target = (pairs[key].values.astype(str) for key in ("source", "target"))
    names = np.unique(np.r_[source, target]).tolist()
    places = network_places(study, names)
    where = "placed by the first two components of their area-based shape differences"
    if places is None:
        places, where = charts.on_circle(len(names)), "on a circle"
    errors = {}
    for key, when in (("cycle_error_initial", "before"), ("cycle_error", "after")):
        if key in pairs:
            errors[f"{when} Consistent ZoomOut"] = pairs[key].values
    ends = np.searchsorted(names, source), np.searchsorted(names, target)
    median = _index(names, attribute(study, "latent", "median"))
    figure = charts.network(places, names, *ends, errors, median)
    note = f"{len(source)} maps among {len(names)} shapes, {where}; the median is circled. "
    note += "Both errors are of the first modes, as many as the maps had before."
    if any(np.isnan(values).any() for values in errors.values()):
        note += " Grey maps are in no cycle: their error is unknown."
    return PARTS.note(note) + PARTS.drawing(figure, "the network of maps, coloured by cycle error")


def _maps(study, look):
    pairs = study["network"].dataset
    order = np.arange(pairs.sizes["pair"])
    if "cycle_error" in pairs:
        order = np.argsort(pairs["cycle_error"].values)
    pair = pairs.isel(pair=order[len(order) // 2])
    matrices = {}
    for key, when in (("fmap_initial", "before"), ("fmap", "after")):
        if key in pair:
            C = pair[key].values
            matrices[f"{when} Consistent ZoomOut, {C.shape[1]} modes"] = C
    text = f"{pair['source'].item()} → {pair['target'].item()}, a pair of median cycle error"
    return PARTS.note(text) + PARTS.drawing(charts.matrices(matrices), text)


def _distances(study, look):
    distance = study["latent"].dataset["distance_to_limit"]
    names = names_of(distance)
    median = _index(names, attribute(study, "latent", "median"))
    figure = charts.ranked(names, distance.values, "distance to the limit shape", median)
    note = PARTS.note("The median (eq. 5) is the shape nearest to the limit shape.")
    return note + PARTS.drawing(figure, "the shapes ranked by their distance to the limit shape")


def _moved(study, look):
    """Sliders that move the mean shape; pictures drawn in advance where they cannot."""
    n_frames = 13 if study["registration"].sizes["vertex"] < 50_000 else 7
    sigmas, ratio = np.linspace(-SIGMA, SIGMA, n_frames).tolist(), _ratio(study)
    sliders = []
    for mode, drawn in enumerate(mode_pictures(study, sigmas, len(ratio), **look)):
        frames, labels = list(map(webp_uri, drawn)), [_label(mode, s) for s in sigmas]
        sliders.append(PARTS.slider(mode, frames, labels, f"{ratio[mode]:.1%} of the variance"))
    return _live_modes(study, PARTS.grid(sliders), look)


def _ratio(study):
    """Shares of variance of the first modes, which are drawn."""
    return study["pca"]["explained_variance_ratio"].values[:N_MODES]


def _label(mode, sigma):
    amount = f"{sigma:+.3g} σ".replace("-", "−") if sigma else "mean"
    return f"component {mode + 1}, {amount}"


def _modes(study, look):
    limit, unit = mode_limits(study)[0], study["pca"]["deformation"].attrs.get("units", "")
    scores, n_modes, pictures = (-SIGMA, 0, SIGMA), len(_ratio(study)), []
    behind = mode_pictures(study, [SIGMA], n_modes, **look | {"view": opposite(look["view"])})
    for mode, drawn in enumerate(mode_pictures(study, scores, n_modes, **look)):
        texts = [_label(mode, score) for score in scores]
        pictures += map(PARTS.picture, drawn, texts)
        pictures.append(PARTS.picture(behind[mode][0], f"{texts[-1]}, from behind"))
    note = "Blue is expansion, red is compression, against the mean; one colour scale for all, "
    note += "that of the sliders. What moves farther has the full colour."
    bar = charts.color_bar(SIGNED, -limit, limit, f"displacement along the normal ({unit})")
    grid = PARTS.grid(pictures, "row four")
    return PARTS.note(note) + grid + PARTS.drawing(bar, "colour bar")


def _live_modes(study, instead, look):
    """Sliders that move the mean shape in the browser, on low resolution where it is large."""
    coarse = template_coarse(study)
    if study["registration"].sizes["vertex"] <= LARGE:
        coarse = None
    mean, T, deformation = mode_arrays(study, coarse, N_LIVE)
    unit = study["pca"]["deformation"].attrs.get("units", "")
    state = {
        **mesh_state(mean, T, deformation),
        **look_state(mode_limits(study), unit, **look),
        **score_state(study, N_LIVE),
        "scores": [0.0] * len(deformation),
        "colors": "normal",
        "beside": False,
        "sample": -1,
        "group": "",
        "height": 500,
        "webgl": "",
        "still": b"",
    }
    size = f"{len(mean):,} vertices" + ("" if coarse is None else ", low resolution")
    if study["pca"].sizes["component"] > N_LIVE:
        size += f", the first {N_LIVE} components"
    return PARTS.modes(state, MODES, size, instead)


def _variance(study, look):
    pca = study["pca"].dataset
    low = pca.get("explained_variance_ratio_low")
    figure = charts.variance(pca["explained_variance_ratio"].values, low)
    return PARTS.drawing(figure, "cumulative explained variance")


def _scores(study, look):
    pca = study["pca"].dataset
    state = score_state(study)
    names, faint = state["names"], state["faint"]
    template = _index(names, attribute(study, "registration", "template"))
    figure = charts.scores(np.array(state["samples"]), names, template, faint)
    text = "scores of the shapes; the template is orange"
    if any(faint):
        text += ", flagged shapes are grey"
    beyond = pca.sizes.get("shape_excluded", 0) - sum(name not in names_of(pca) for name in names)
    note = ""
    if beyond:
        note = PARTS.note(f"{beyond} flagged shapes lie too far away to be drawn.")
    return Markup(note) + PARTS.drawing(figure, text)


def _correspondence(study, look):
    registration = study["registration"].dataset
    X, T = mesh_of(registration)
    colors = position_colors(X)
    template = registration.attrs.get("template", "")
    surfaces: dict[str, Any] = {f"{template}, the template": (X, T, colors)}
    others = [name for name in names_of(registration) if name != template]
    surfaces |= {name: transferred_colors(study, name, colors) for name in others[:N_TRANSFERRED]}
    surfaces = {name: one for name, one in surfaces.items() if one is not None}
    frames = shared_frames([X for X, _, _ in surfaces.values()], look)
    figures = []
    for (name, (X, T, colors)), frame in zip(surfaces.items(), frames, strict=True):
        pixels = render(X, T, colors=colors, size=PANEL, frame=frame, **look)
        figures.append(PARTS.picture(pixels, name))
    note = "The template's coordinates as colours, carried to other shapes: "
    note += "the same colour is the same place."
    return PARTS.note(note) + PARTS.grid(figures)


def _confidence(study, look):
    registration = study["registration"].dataset
    X, T = mesh_of(registration)
    apart = left_out(study)
    names = [name for name in names_of(registration) if name not in apart]
    registration = registration.sel(shape=names)
    confidence = registration["confidence"]
    mean, names = confidence.mean("vertex").values, names_of(registration)

    def painted(caption, X, values, high):
        colors = ramp_colors(values, 0, high)
        return PARTS.picture(render(X, T, colors=colors, size=PANEL, **look), caption)

    caption = "mean over the shapes, on the template"
    figures = [painted(caption, X, confidence.mean("shape").values, 1)]
    for i in np.argsort(mean)[:2]:
        moved = X + registration["displacement"].isel(shape=i).values
        caption = f"{names[i]}: {mean[i]:.2f} on average"
        figures.append(painted(caption, moved, confidence.isel(shape=i).values, 1))
    others = {
        "round_trip": "cycle error, shares of sqrt(area)",
        "distortion": "distortion |log(area ratio)|",
    }
    for key, words in others.items():
        if key in registration:
            value = np.abs(registration[key]).mean("shape").values
            limit = charts.reach(value, 0.95) or 1.0
            caption = f"{words}, from 0 to {limit:.2g}; mean over the shapes"
            figures.append(painted(caption, X, value, limit))
    note = "Everywhere, and the shapes where it is lowest; "
    note += "what the registration does to the surface."
    bar = charts.color_bar("viridis", 0, 1, "confidence")
    return PARTS.note(note) + PARTS.grid(figures) + PARTS.drawing(bar, "colour bar")


def _resources(study, look):
    report = study["report"].dataset
    heads = {"seconds": "seconds", "peak_memory": "peak memory (MiB)"}
    heads = {key: head for key, head in heads.items() if key in report}
    rows = []
    for i, stage in enumerate(report["stage"].values):
        rows.append([str(stage), *(float(report[key].values[i]) for key in heads)])
    return PARTS.table(["stage", *heads.values()], rows, name="time and memory")


def _parameters(study, look):
    attrs = study["report"].attrs
    rows = [[name, str(value)] for name, value in kept_options(study).items()]
    # the keys of all that was registered are no parameter, and wider than any page
    others = [[key, value] for key, value in attrs.items() if str(value)]
    rows += [row for row in others if row[0] not in ("made_from", "options")]
    if not rows:
        return PARTS.missing(["parameters"])
    return PARTS.table(["parameter", "value"], rows, name="parameters")


# heading, what of the study it needs, and what writes it
SECTIONS = (
    ("Move the modes", ["registration/position", "pca/deformation"], _moved),
    ("Modes of variation", ["registration/position", "pca/deformation"], _modes),
    ("Shapes", ["report/status"], _shapes),
    ("Gallery", ["coarse"], _gallery),
    ("Network of maps", ["network/source", "network/target", "network/cycle_error"], _network),
    ("Functional maps", ["network/fmap"], _maps),
    ("Distance to the limit shape", ["latent/distance_to_limit"], _distances),
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
