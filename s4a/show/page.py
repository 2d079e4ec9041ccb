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
from s4a.show.browser import MODES, PARTS, TEMPLATES, appearance_state, color_scale, mesh_state
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
    network_positions,
    score_state,
    surface,
    template_coarse,
    transferred_colors,
)
from s4a.study.tree import left_out, seconds_of

LARGE = 20_000  # vertices above which a page deforms the low-resolution mesh
N_TRANSFERRED = 5  # shapes to which the template's colours are transferred


def write_page(
    study: xr.DataTree,
    path: Path | str,
    *,
    title: str = "Shape study",
    view: Viewpoint = "corner",
    up: str = "z",
) -> Path:
    """Write a study as one self-contained HTML page.

    A section whose data are missing says what is missing.

    Parameters
    ----------
    study : xarray.DataTree
    path : str or Path
        The file to write.
    title : str
    view, up
        Direction of view, and the axis that points up; see :func:`s4a.show.draw.rotation`.

    Returns
    -------
    pathlib.Path

    See Also
    --------
    s4a.explore : the panels in a notebook.
    s4a.write_picture, s4a.write_film : modes of variation as files.

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
    study: xr.DataTree, *, title: str = "Shape study", view: Viewpoint = "corner", up: str = "z"
) -> str:
    """Return the HTML page of a study; see :func:`write_page`."""
    check_type(study, xr.DataTree)
    sections = []
    for heading, needs, section in SECTIONS:
        lacking = [name for name in needs if not has(study, name)]
        if lacking:
            no_modes = any(name.startswith("pca/") for name in lacking)
            reason = attribute(study, "report", "no_modes") if no_modes else ""
            sections.append((heading, PARTS.missing(lacking, reason)))
        else:
            sections.append((heading, section(study, {"view": view, "up": up})))
    template = TEMPLATES.get_template("study.html")
    facts = {"summary": _summary(study), "warnings": _warnings(study)}
    return template.render(title=title, sections=sections, **facts)


def _picture_ids(study):
    """Return shape -> HTML id of its picture."""
    names = study["coarse"].children if has(study, "coarse") else ()
    return {name: f"shape-{i}" for i, name in enumerate(names)}


def _linked(names, ids):
    """Return names of shapes as links to their pictures, if they have one."""
    return [PARTS.link(name, ids[name]) if name in ids else name for name in names]


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
        facts.append(f"the first {len(ratio)} modes explain {ratio.sum():.0%} of the variance")
    if has(study, "report/seconds"):
        facts.append(seconds_of(study["report"].to_dataset()))
    return "; ".join(facts) + "." if facts else "The study is empty."


def _warnings(study):
    """Return the warnings at the top of the page: shapes left out, flagged or unusual."""
    if not has(study, "report/status"):
        return Markup("")
    report, ids = study["report"].dataset, _picture_ids(study)
    status, names = report["status"].values.astype(str), np.array(names_of(report))
    warnings = []
    if (status == "excluded").any():
        left = _linked(names[status == "excluded"], ids)
        warnings.append(("excluded", "left out, for the reasons in the table of shapes", left))
    for kind, findings in (("flagged", decisions(report)), ("odd", notices(report))):
        for finding in findings:
            text = f"{finding.kind} ({finding.remedy})"
            warnings.append((kind, text, _linked(finding.names, ids)))
    if not warnings:
        return Markup("")
    text = "Flagged shapes are registered, but not used for modes, statistics and the median; "
    text += "s4a run ... --include-flagged includes them."
    if kept_options(report).get("include_flagged"):
        text = "Flagged shapes are included in modes and statistics (include_flagged)."
    note = PARTS.note(text) if (status == "flagged").any() else Markup("")
    return PARTS.warnings(warnings) + note


def _shapes(study, camera):
    report = study["report"].dataset
    status = report["status"].values.astype(str)
    texts = [
        key
        for key in ("reason", "warning", "path")
        if key in report and (report[key].values != "").any()
    ]
    meshes = study["original"].children if has(study, "original") else {}
    names = names_of(report)
    rows, linked = [], _linked(names, _picture_ids(study))
    for i, name in enumerate(names):
        size = ["", ""]
        if name in meshes:
            size = [meshes[name].sizes[kind] for kind in ("vertex", "triangle")]
        rows.append([linked[i], status[i], *size, *(report[key].values[i] for key in texts)])
    head = ["shape", "status", "vertices", "triangles", *texts]
    return PARTS.table(head, rows, status.tolist(), name="the shapes")


def _gallery(study, camera):
    names = list(study["coarse"].children)
    texts = {name: text for text, name in labelled(study, names)}
    meshes = [surface(study, name) for name in names]
    frames = shared_frames([X for X, _ in meshes], camera)
    median, ids = attribute(study, "latent", "median"), _picture_ids(study)
    figures = []
    for name, (X, T), frame in zip(names, meshes, frames, strict=True):
        pixels = render(X, T, size=(150, 130), frame=frame, **camera)
        caption = f"{texts[name]}, the median" if name == median else texts[name]
        figures.append(PARTS.picture(pixels, caption, name == median, ids[name]))
    kinds = {low_text(study["coarse"][name].dataset) or "low-resolution meshes" for name in names}
    note = PARTS.note(f"The {' and '.join(sorted(kinds))}, at one scale.")
    return note + PARTS.grid(figures, "gallery")


def _network(study, camera):
    pairs = study["network"].dataset
    source, target = (pairs[key].values.astype(str) for key in ("source", "target"))
    names = np.unique(np.r_[source, target]).tolist()
    positions = network_positions(study, names)
    layout = "placed by the first two principal components of the area-based shape differences"
    if positions is None:
        positions, layout = charts.on_circle(len(names)), "on a circle"
    errors = {}
    for key, when in (("cycle_error_initial", "before"), ("cycle_error", "after")):
        if key in pairs:
            errors[f"{when} Consistent ZoomOut"] = pairs[key].values
    ends = np.searchsorted(names, source), np.searchsorted(names, target)
    median = _index(names, attribute(study, "latent", "median"))
    figure = charts.network(positions, names, *ends, errors, median)
    note = f"{len(source)} maps among {len(names)} shapes, {layout}; the median is circled. "
    note += "Both errors are those of the eigenfunctions of the initial maps."
    if any(np.isnan(values).any() for values in errors.values()):
        note += " Grey maps are in no cycle, so their error is unknown."
    return PARTS.note(note) + PARTS.drawing(figure, "the network of maps, coloured by cycle error")


def _maps(study, camera):
    pairs = study["network"].dataset
    order = np.arange(pairs.sizes["pair"])
    if "cycle_error" in pairs:
        order = np.argsort(pairs["cycle_error"].values)
    pair = pairs.isel(pair=order[len(order) // 2])
    matrices = {}
    for key, when in (("fmap_initial", "before"), ("fmap", "after")):
        if key in pair:
            C = pair[key].values
            matrices[f"{when} Consistent ZoomOut, {C.shape[1]} eigenfunctions"] = C
    text = f"{pair['source'].item()} → {pair['target'].item()}, the pair of median cycle error"
    return PARTS.note(text) + PARTS.drawing(charts.matrices(matrices), text)


def _distances(study, camera):
    distance = study["latent"].dataset["distance_to_limit"]
    names = names_of(distance)
    median = _index(names, attribute(study, "latent", "median"))
    figure = charts.ranked(names, distance.values, "distance to the limit shape", median)
    note = PARTS.note("The median (eq. 5) is the shape nearest to the limit shape.")
    return note + PARTS.drawing(figure, "the shapes ranked by their distance to the limit shape")


def _ratio(study):
    """Return the explained variance ratios of the modes that are drawn."""
    return study["pca"]["explained_variance_ratio"].values[:N_MODES]


def _modes(study, camera):
    limit, unit = mode_limits(study)[0], study["pca"]["deformation"].attrs.get("units", "")
    ratio, pictures = _ratio(study), []
    behind = mode_pictures(
        study, [SIGMA], len(ratio), **camera | {"view": opposite(camera["view"])}
    )
    for mode, drawn in enumerate(mode_pictures(study, (-SIGMA, 0, SIGMA), len(ratio), **camera)):
        scores = f"−{SIGMA} σ", "mean", f"+{SIGMA} σ", f"+{SIGMA} σ, from behind"
        texts = [f"mode {mode + 1}, {score}" for score in scores]
        texts[1] += f", {ratio[mode]:.1%} of the variance"
        pictures += map(PARTS.picture, [*drawn, *behind[mode]], texts)
    note = "Blue is expansion and red is compression relative to the mean, on the colour scale of "
    note += "the sliders. Larger displacements have the colours at the ends."
    bar = color_scale(SIGNED, -limit, limit, f"displacement along the normal ({unit})")
    return PARTS.note(note) + PARTS.grid(pictures, "row four") + PARTS.color_bar(bar)


def _sliders(study, camera):
    """Return sliders that deform the mean shape in the browser, at low resolution if large."""
    coarse = template_coarse(study)
    if study["registration"].sizes["vertex"] <= LARGE:
        coarse = None
    mean, T, deformation = mode_arrays(study, coarse, N_LIVE)
    unit = study["pca"]["deformation"].attrs.get("units", "")
    state = {
        **mesh_state(mean, T, deformation),
        **appearance_state(mode_limits(study), unit, **camera),
        **score_state(study, N_LIVE),
        "scores": [0.0] * len(deformation),
        "colors": "normal",
        "side_by_side": False,
        "sample": -1,
        "group": "",
        "height": 500,
        "webgl": "",
        "still": b"",
    }
    size = f"{len(mean):,} vertices" + ("" if coarse is None else ", low resolution")
    if study["pca"].sizes["component"] > N_LIVE:
        size += f", the first {N_LIVE} modes"
    return PARTS.modes(state, MODES, size)


def _variance(study, camera):
    pca = study["pca"].dataset
    low = pca.get("explained_variance_ratio_low")
    figure = charts.variance(pca["explained_variance_ratio"].values, low)
    return PARTS.drawing(figure, "cumulative explained variance")


def _scores(study, camera):
    pca = study["pca"].dataset
    state = score_state(study)
    names, faint = state["names"], state["faint"]
    template = _index(names, attribute(study, "registration", "template"))
    figure = charts.scores(np.array(state["samples"]), names, template, faint)
    text = "scores of the shapes; the template is orange"
    if any(faint):
        text += ", flagged shapes are grey"
    n_hidden = pca.sizes.get("shape_excluded", 0) - sum(name not in names_of(pca) for name in names)
    note = ""
    if n_hidden:
        note = PARTS.note(f"{n_hidden} flagged shapes are outside the chart.")
    return Markup(note) + PARTS.drawing(figure, text)


def _correspondence(study, camera):
    registration = study["registration"].dataset
    X, T = mesh_of(registration)
    colors = position_colors(X)
    template = registration.attrs.get("template", "")
    surfaces: dict[str, Any] = {f"{template}, the template": (X, T, colors)}
    others = [name for name in names_of(registration) if name != template]
    surfaces |= {name: transferred_colors(study, name, colors) for name in others[:N_TRANSFERRED]}
    surfaces = {name: arrays for name, arrays in surfaces.items() if arrays is not None}
    frames = shared_frames([X for X, _, _ in surfaces.values()], camera)
    figures = []
    for (name, (X, T, colors)), frame in zip(surfaces.items(), frames, strict=True):
        pixels = render(X, T, colors=colors, size=PANEL, frame=frame, **camera)
        figures.append(PARTS.picture(pixels, name))
    note = "The template's coordinates as colours, transferred to other shapes: "
    note += "corresponding points have the same colour."
    return PARTS.note(note) + PARTS.grid(figures)


def _confidence(study, camera):
    registration = study["registration"].dataset
    X, T = mesh_of(registration)
    excluded = left_out(study)
    names = [name for name in names_of(registration) if name not in excluded]
    registration = registration.sel(shape=names)
    confidence = registration["confidence"]
    mean, names = confidence.mean("vertex").values, names_of(registration)

    def painted(caption, X, values, high):
        colors = ramp_colors(values, 0, high)
        return PARTS.picture(render(X, T, colors=colors, size=PANEL, **camera), caption)

    caption = "mean over the shapes, on the template"
    figures = [painted(caption, X, confidence.mean("shape").values, 1)]
    for i in np.argsort(mean)[:2]:
        moved = X + registration["displacement"].isel(shape=i).values
        caption = f"{names[i]}: {mean[i]:.2f} on average"
        figures.append(painted(caption, moved, confidence.isel(shape=i).values, 1))
    others = {
        "round_trip": "cycle error in units of sqrt(area)",
        "distortion": "distortion |log(area ratio)|",
    }
    for key, text in others.items():
        if key in registration:
            value = np.abs(registration[key]).mean("shape").values
            limit = charts.reach(value, 0.95) or 1.0
            caption = f"{text}, from 0 to {limit:.2g}; mean over the shapes"
            figures.append(painted(caption, X, value, limit))
    note = "Mean confidence on the template, the two shapes with the lowest confidence, and the "
    note += "distortion by the registration. Among shapes in similar poses the confidence is an "
    note += "average of the group and does not rank the points by their error."
    bar = PARTS.color_bar(color_scale("viridis", 0, 1, "confidence"))
    return PARTS.note(note) + PARTS.grid(figures) + bar


def _resources(study, camera):
    report = study["report"].dataset
    heads = {"seconds": "seconds", "peak_memory": "peak memory (MiB)"}
    heads = {key: head for key, head in heads.items() if key in report}
    rows = []
    for i, stage in enumerate(report["stage"].values):
        rows.append([str(stage), *(float(report[key].values[i]) for key in heads)])
    return PARTS.table(["stage", *heads.values()], rows, name="time and memory")


def _parameters(study, camera):
    attrs = study["report"].attrs
    rows = [[name, str(value)] for name, value in kept_options(study).items()]
    # the names and keys of files are not parameters, and too long for a page
    others = [[key, value] for key, value in attrs.items() if str(value)]
    rows += [row for row in others if row[0] not in ("file", "made_from", "options")]
    if not rows:
        return PARTS.missing(["parameters"])
    return PARTS.table(["parameter", "value"], rows, name="parameters")


# heading, required variables, and the function that writes the section
SECTIONS = (
    ("Explore the modes of variation", ["registration/position", "pca/deformation"], _sliders),
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
