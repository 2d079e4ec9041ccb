"""The surfaces of a study, and what stands beside them, as pictures, pages and panels show them."""

from typing import Any

import numpy as np
import xarray as xr

from s4a.method.pca import color_limits, low_vertices
from s4a.method.register import match_functions, match_low
from s4a.method.shape import Shape
from s4a.method.steps import Study, latent_bases
from s4a.schema import INPUT, unit_of
from s4a.show.draw import cycle_error_limits

N_LIVE = 20  # modes that panels and pages move, unless asked: of 20,000 vertices 0.3 MB each
N_SCALED = 3  # modes that set the scale of colours
FAR = 8  # standard deviations beyond which charts of scores leave a flagged shape out
RESOLUTIONS = [("low resolution", "coarse"), ("full resolution", "original")]
SAMPLES = "samples of SCALABLE, joined where their cells meet"


def has(study: xr.DataTree, name: str) -> bool:
    """Whether the study holds the node, or the variable ``node/variable``."""
    node, _, variable = name.partition("/")
    if node not in study.children:
        return False
    return variable in study[node].data_vars if variable else bool(study[node].children)


def attribute(study: xr.DataTree, node: str, name: str) -> str:
    """An attribute of a node as text; empty where there is none."""
    return str(study[node].attrs.get(name, "")) if node in study.children else ""


def names_of(data: xr.Dataset | xr.DataArray) -> list[str]:
    """The shapes of a Dataset or one of its variables."""
    return [str(name) for name in data["shape"].values]


def flagged_names(study: xr.DataTree) -> list[str]:
    """The shapes that the report calls flagged."""
    if not has(study, "report/status"):
        return []
    report = study["report"].dataset
    return names_of(report.sel(shape=report["status"].values == "flagged"))


def labelled(study: xr.DataTree, names: list[str]) -> list[tuple[str, str]]:
    """Shapes as options of a list: what is shown, which marks flagged ones, and the name."""
    flagged = set(flagged_names(study))
    return [(f"{name} (flagged)" if name in flagged else name, name) for name in names]


def label_text(mesh: xr.Dataset, value: Any) -> str:
    """A label of the vertices as text, with its name where the mesh has names of its labels."""
    names = mesh["label"].attrs.get("names", [])
    return f"{value} {names[value]}" if value in range(len(names)) else str(value)


def mesh_of(mesh: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Positions and triangles of a mesh."""
    return mesh["position"].values, mesh["corner_vertex"].values


def aligned(study: xr.DataTree, name: str, X: np.ndarray) -> np.ndarray:
    """Points ``(n, 3)`` of a shape moved onto the template, where the run has registered it."""
    registration = study["registration"].dataset if has(study, "registration/rotation") else None
    if registration is None or name not in names_of(registration):
        return X
    transform = registration.sel(shape=name)
    scale = transform["scale"].item() if "scale" in transform else 1.0
    return scale * X @ transform["rotation"].values.T + transform["translation"].values


def low_text(mesh: xr.Dataset) -> str:
    """What stands for a low-resolution mesh where there is none, with SCALABLE; empty elsewhere."""
    return SAMPLES if "local_weight" in mesh else ""


def surface(study: xr.DataTree, name: str, stage: str = "coarse") -> tuple[np.ndarray, np.ndarray]:
    """Aligned positions and triangles of a shape at the stage ``coarse`` or ``original``."""
    X, T = mesh_of(study[stage][name].dataset)
    return aligned(study, name, X), T


def resolutions(study: xr.DataTree) -> list[tuple[str, str]]:
    """The resolutions that the study holds, as the options of a switch: text and stage."""
    return [(text, stage) for text, stage in RESOLUTIONS if has(study, stage)]


def unit_text(study: xr.DataTree, name: str) -> str:
    """The unit of a shape's positions where its file or the modes say it, or that of the input."""
    node = study["original"].children.get(name) if "original" in study.children else None
    if node is not None and node.attrs.get("unit"):
        return str(node.attrs["unit"])
    known = has(study, "pca/mean_displacement")
    return unit_of(study["pca"].dataset["mean_displacement"]) if known else INPUT


def barycentric_place(study: xr.DataTree, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Where each vertex of a shape lies on the template: corners ``(v, 3)`` and weights ``(v, 3)``.

    None where the study does not say it.
    """
    registration = study["registration"]
    node = registration.children.get(name)
    if node is None or "template_triangle" not in node.data_vars:
        return None
    place = node.dataset
    corners = registration.dataset["corner_vertex"].values[place["template_triangle"].values]
    return corners, place["template_barycentric"].values


def transferred_colors(
    study: xr.DataTree, name: str, colors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Aligned mesh of a shape, with the colours of the template's vertices carried to it.

    None without its mesh; a vertex to which nothing is carried is NaN.
    """
    if not has(study, "original") or name not in study["original"].children:
        return None
    X, T = mesh_of(study["original"][name].dataset)
    place = barycentric_place(study, name)
    if place is not None:
        corners, weights = place
        carried = np.einsum("vc,vcx->vx", weights, colors[corners])
    else:  # the mean of the template's vertices that are matched to the vertex
        match = study["registration"].dataset["registered_match"].sel(shape=name).values
        count = np.bincount(match, minlength=len(X))[:, None]
        sums = np.stack([np.bincount(match, channel, len(X)) for channel in colors.T], axis=1)
        carried = np.where(count > 0, sums / np.maximum(count, 1), np.nan)
    return aligned(study, name, X), T, carried


def template_vertices(study: xr.DataTree, name: str) -> np.ndarray | None:
    """For each vertex of a shape the template's vertex nearest to where it lies.

    None where the study does not say it.
    """
    place = barycentric_place(study, name)
    if place is None:
        return None
    corners, weights = place
    return np.take_along_axis(corners, weights.argmax(1)[:, None], axis=1)[:, 0]


def template_coarse(study: xr.DataTree) -> xr.Dataset | None:
    """The low-resolution mesh of the template; None where the study has none with its vertices."""
    template = attribute(study, "registration", "template")
    if not has(study, "coarse") or template not in study["coarse"].children:
        return None
    coarse = study["coarse"][template].to_dataset()
    return coarse if "coarse_vertex" in coarse or "local_weight" in coarse else None


def mode_arrays(
    study: xr.DataTree, coarse: xr.Dataset | None = None, n_modes: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean shape ``(n, 3)``, triangles and deformations ``(c, n, 3)``.

    On the vertices of the low-resolution mesh `coarse` where it is given.
    """
    X, T = mesh_of(study["registration"].dataset)
    pca = study["pca"].dataset.isel(component=slice(n_modes))
    mean, deformation = X + pca["mean_displacement"].values, pca["deformation"].values
    if coarse is None:
        return mean, T, deformation
    vertex = low_vertices(coarse)
    return mean[vertex], coarse["corner_vertex"].values, deformation[:, vertex]


def mode_limits(study: xr.DataTree) -> tuple[float, float]:
    """Displacements of the full colours of a study's modes: along the normal, and in length.

    The scale of sliders, pictures and scenes alike: it is that of the full resolution and of the
    first modes, however many modes and whichever vertices are shown.  See
    :func:`s4a.method.pca.color_limits`.

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
    """Shares of variance, scores and names of a study's modes, as the browser shows them."""
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
    """Scores of the shapes that the modes are made without, where a chart can show them."""
    if "score_excluded" not in pca:
        return {}
    near = pca.sel(shape_excluded=(np.abs(pca["score_excluded"][:, :3].values) < FAR).all(axis=1))
    names = [str(name) for name in near["shape_excluded"].values]
    return dict(zip(names, near["score_excluded"].values.tolist(), strict=True))


def network_positions(study: xr.DataTree, names: list[str]) -> np.ndarray | None:
    """Places ``(n, 2)`` of shapes: the first two components of their area-based differences.

    None where the study has not both for each of them.
    """
    if not has(study, "latent/area_score"):
        return None
    scores = study["latent"].dataset["area_score"]
    if scores.sizes["difference_component"] < 2 or not set(names) <= set(names_of(scores)):
        return None
    return scores.sel(shape=names).values[:, :2]


def network_limits(study: xr.DataTree) -> tuple[float, float]:
    """Smallest and largest cycle error of a study's colours, from its maps before and after."""
    network = study["network"].dataset
    keys = ("cycle_error_initial", "cycle_error")
    return cycle_error_limits(*(network[key].values for key in keys if key in network))


def latent_match(study: xr.DataTree, source: str, target: str, *, dense: bool) -> np.ndarray:
    """On each vertex of `target` the vertex of `source` that the latent basis matches to it.

    By nearest rows of Phi Y on the coarse meshes (eq. 3), or of U Phi Y on all vertices where
    `dense` (eq. 7).
    """
    M, N = (
        Shape(study["original"][name].to_dataset(), study["coarse"][name].to_dataset())
        for name in (source, target)
    )
    basis_source, basis_target = latent_bases(Study(study), source, target)
    match, (F_source, F_target) = match_low(M, N, (basis_source, basis_target))
    return match_functions(M, N, F_source, F_target)[0] if dense else match
