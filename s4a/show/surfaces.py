"""Arrays and texts of a study for pictures, pages and panels."""

from typing import Any

import numpy as np
import xarray as xr

from s4a.method.pca import color_limits, low_vertices
from s4a.schema import INPUT, Array, unit_of
from s4a.show.draw import cycle_error_limits

N_LIVE = 20  # default number of modes in panels and pages: 0.3 MB each for 20,000 vertices
N_SCALED = 3  # modes that determine the colour scale
FAR = 8  # standard deviations beyond which a flagged shape is outside the charts of scores
RESOLUTIONS = [("low resolution", "coarse"), ("full resolution", "original")]
SAMPLES = "samples of SCALABLE with an edge between adjacent cells"


def has(study: xr.DataTree, name: str) -> bool:
    """Return True if the study has the node with content, or the variable ``node/variable``."""
    node, _, variable = name.partition("/")
    if node not in study.children:
        return False
    found = study[node]
    return variable in found.data_vars if variable else bool(found.children or found.data_vars)


def attribute(study: xr.DataTree, node: str, name: str) -> str:
    """Return an attribute of a node as text; empty if there is none."""
    return str(study[node].attrs.get(name, "")) if node in study.children else ""


def names_of(data: xr.Dataset | xr.DataArray) -> list[str]:
    """Return the names of the shapes of a Dataset or DataArray."""
    return [str(name) for name in data["shape"].values]


def flagged_names(study: xr.DataTree) -> list[str]:
    """Return the shapes that quality control flagged."""
    if not has(study, "report/status"):
        return []
    report = study["report"].dataset
    return names_of(report.sel(shape=report["status"].values == "flagged"))


def labelled(study: xr.DataTree, names: list[str]) -> list[tuple[str, str]]:
    """Return shapes as options of a list: a text, which marks flagged shapes, and the name."""
    flagged = set(flagged_names(study))
    return [(f"{name} (flagged)" if name in flagged else name, name) for name in names]


def label_text(mesh: xr.Dataset, value: Any) -> str:
    """Return a label as text, with its name if the mesh has names of labels."""
    names = mesh["label"].attrs.get("names", [])
    return f"{value} {names[value]}" if value in range(len(names)) else str(value)


def mesh_of(mesh: xr.Dataset) -> tuple[Array, Array]:
    """Return positions and triangles of a mesh."""
    return mesh["position"].values, mesh["corner_vertex"].values


def aligned(study: xr.DataTree, name: str, X: Array) -> Array:
    """Return points ``(n, 3)`` of a shape aligned to the template, if the shape is registered."""
    registration = study["registration"].dataset if has(study, "registration/rotation") else None
    if registration is None or name not in names_of(registration):
        return X
    transform = registration.sel(shape=name)
    scale = transform["scale"].item() if "scale" in transform else 1.0
    return scale * X @ transform["rotation"].values.T + transform["translation"].values


def low_text(mesh: xr.Dataset) -> str:
    """Return a note if SCALABLE's samples replace the low-resolution mesh; else an empty text."""
    return SAMPLES if "local_weight" in mesh else ""


def surface(study: xr.DataTree, name: str, stage: str = "coarse") -> tuple[Array, Array]:
    """Return aligned positions and triangles of a shape at stage ``coarse`` or ``original``."""
    X, T = mesh_of(study[stage][name].dataset)
    return aligned(study, name, X), T


def unit_text(study: xr.DataTree, name: str) -> str:
    """Return the unit of a shape's positions, from its file or from the modes of variation."""
    node = study["original"].children.get(name) if "original" in study.children else None
    if node is not None and node.attrs.get("unit"):
        return str(node.attrs["unit"])
    known = has(study, "pca/mean_displacement")
    return unit_of(study["pca"].dataset["mean_displacement"]) if known else INPUT


def barycentric(study: xr.DataTree, name: str) -> tuple[Array, Array] | None:
    """Return the vertices of a shape on the template: corners and barycentric weights ``(v, 3)``.

    None if the study does not have them.
    """
    registration = study["registration"]
    node = registration.children.get(name)
    if node is None or "template_triangle" not in node.data_vars:
        return None
    data = node.dataset
    corners = registration.dataset["corner_vertex"].values[data["template_triangle"].values]
    return corners, data["template_barycentric"].values


def transferred_colors(
    study: xr.DataTree, name: str, colors: Array
) -> tuple[Array, Array, Array] | None:
    """Return the aligned mesh of a shape, with colours transferred from the template's vertices.

    None without its mesh; vertices without a colour are NaN.
    """
    if not has(study, "original") or name not in study["original"].children:
        return None
    X, T = mesh_of(study["original"][name].dataset)
    located = barycentric(study, name)
    if located is not None:
        corners, weights = located
        transferred = np.einsum("vc,vcx->vx", weights, colors[corners])
    else:  # the mean over the template's vertices that are matched to the vertex
        match = study["registration"].dataset["registered_match"].sel(shape=name).values
        count = np.bincount(match, minlength=len(X))[:, None]
        sums = np.stack([np.bincount(match, channel, len(X)) for channel in colors.T], axis=1)
        transferred = np.where(count > 0, sums / np.maximum(count, 1), np.nan)
    return aligned(study, name, X), T, transferred


def template_vertices(study: xr.DataTree, name: str) -> Array | None:
    """Return for each vertex of a shape the nearest vertex of the template.

    None if the study does not have the registration of the shape.
    """
    located = barycentric(study, name)
    if located is None:
        return None
    return nearest_corner(*located)


def nearest_corner(corners: Array, weights: Array) -> Array:
    """Return the vertex nearest to each point, given corners and barycentric weights ``(n, 3)``."""
    return np.take_along_axis(corners, weights.argmax(1)[:, None], axis=1)[:, 0]


def template_coarse(study: xr.DataTree) -> xr.Dataset | None:
    """Return the low-resolution mesh of the template; None if there is none with its vertices."""
    template = attribute(study, "registration", "template")
    if not has(study, "coarse") or template not in study["coarse"].children:
        return None
    coarse = study["coarse"][template].to_dataset()
    return coarse if "coarse_vertex" in coarse or "local_weight" in coarse else None


def mode_arrays(
    study: xr.DataTree, coarse: xr.Dataset | None = None, n_modes: int | None = None
) -> tuple[Array, Array, Array]:
    """Return mean shape ``(n, 3)``, triangles and deformations ``(c, n, 3)``.

    If the low-resolution mesh `coarse` is given, they are those of its vertices.
    """
    X, T = mesh_of(study["registration"].dataset)
    pca = study["pca"].dataset.isel(component=slice(n_modes))
    mean, deformation = X + pca["mean_displacement"].values, pca["deformation"].values
    if coarse is None:
        return mean, T, deformation
    vertex = low_vertices(coarse)
    return mean[vertex], coarse["corner_vertex"].values, deformation[:, vertex]


def mode_limits(study: xr.DataTree) -> tuple[float, float]:
    """Return the ends of the colour scales of a study's modes: normal displacement and length.

    Sliders, pictures and scenes have one scale, computed from the first modes at full resolution;
    see :func:`s4a.method.pca.color_limits`.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.

    Returns
    -------
    (float, float)
        In the unit of the input.
    """
    return color_limits(*mode_arrays(study, n_modes=N_SCALED))


def score_state(study: xr.DataTree, n_modes: int | None = None) -> dict[str, Any]:
    """Return explained variance ratios, scores and names of shapes for the browser."""
    pca = study["pca"].dataset.isel(component=slice(n_modes))
    low = pca.get("explained_variance_ratio_low")
    scores = dict(zip(names_of(pca), pca["score"].values.tolist(), strict=True))
    scores |= near_excluded(pca)
    return {
        "ratio": pca["explained_variance_ratio"].values.tolist(),
        "ratio_low": [] if low is None else low.values.tolist(),
        "samples": list(scores.values()),
        "names": list(scores),
        "faint": [name in flagged_names(study) for name in scores],
    }


def near_excluded(pca: xr.Dataset) -> dict[str, list[float]]:
    """Return the scores of excluded shapes, without those outside a chart."""
    if "score_excluded" not in pca:
        return {}
    near = pca.sel(shape_excluded=(np.abs(pca["score_excluded"][:, :3].values) < FAR).all(axis=1))
    names = [str(name) for name in near["shape_excluded"].values]
    return dict(zip(names, near["score_excluded"].values.tolist(), strict=True))


def network_positions(study: xr.DataTree, names: list[str]) -> Array | None:
    """Return positions ``(n, 2)``: first two components of the area-based shape differences.

    None if the study does not have both for all shapes.
    """
    if not has(study, "latent/area_score"):
        return None
    scores = study["latent"].dataset["area_score"]
    if scores.sizes["difference_component"] < 2 or not set(names) <= set(names_of(scores)):
        return None
    return scores.sel(shape=names).values[:, :2]


def network_limits(study: xr.DataTree) -> tuple[float, float]:
    """Return the ends of the scale of cycle errors, from the maps before and after refinement."""
    network = study["network"].dataset
    keys = ("cycle_error_initial", "cycle_error")
    return cycle_error_limits(*(network[key].values for key in keys if key in network))
