"""Pictures of the surfaces of a study."""

from pathlib import Path

import numpy as np
from PIL import Image

from s4a.geometry.mesh import vertex_normals
from s4a.show.draw import image_bytes, on_white, plane_box, render, signed_colors

SIGMA = 3  # the modes are shown from -3 to 3 standard deviations
N_MODES = 3
PANEL = (320, 270)  # pixels


def has(study, name):
    """Whether the study holds the node, or the variable ``node/variable``."""
    node, _, variable = name.partition("/")
    if node not in study.children:
        return False
    return variable in study[node].data_vars if variable else bool(study[node].children)


def names_of(data):
    """The shapes of a Dataset, as a list of str."""
    return [str(name) for name in data["shape"].values]


def mesh_of(node):
    """Positions and triangles of a node."""
    return node["position"].values, node["corner_vertex"].values


def aligned(study, name, X):
    """Positions of a shape moved onto the template, where the run has registered it."""
    if not has(study, "registration/rotation") or name not in names_of(study["registration"]):
        return X
    one = study["registration"].dataset.sel(shape=name)
    scale = one["scale"].item() if "scale" in one else 1.0
    return scale * X @ one["rotation"].values.T + one["translation"].values


def shared_frames(surfaces, look):
    """For each surface a frame around itself, all of the size of the largest.

    So that sizes can be compared.
    """
    boxes = [plane_box(X, **look) for X in surfaces]
    half = np.max([box[1] - box[0] for box in boxes], axis=0) / 2
    return [box.mean(0) + np.stack([-half, half]) for box in boxes]


def carried_colors(study, name, colors):
    """Aligned mesh of a shape, with the colours of the template's vertices carried to it.

    None without its mesh.
    """
    if not has(study, "original") or name not in study["original"].children:
        return None
    X, T = mesh_of(study["original"][name])
    registration = study["registration"]
    if name in registration.children and "template_triangle" in registration[name].data_vars:
        corners = registration["corner_vertex"].values[
            registration[name]["template_triangle"].values
        ]
        painted = np.einsum(
            "vc,vcx->vx", registration[name]["template_barycentric"].values, colors[corners]
        )
    else:
        match = registration["registered_match"].sel(shape=name).values
        count = np.bincount(match, minlength=len(X))[:, None]
        painted = np.stack([np.bincount(match, channel, len(X)) for channel in colors.T], axis=1)
        painted = np.where(count > 0, painted / np.maximum(count, 1), np.nan)
    return aligned(study, name, X), T, painted


def mode_drawer(study, look):
    """What draws the first components, all on one colour scale.

    Returns
    -------
    draw : function
        ``draw(mode, s, size=PANEL, **look)`` is the picture of the mean shape moved by s standard
        deviations, coloured by how far it moves along its normal.
    limit : float
        The displacement of the full colours, in the unit of the input.
    """
    pca = study["pca"].dataset
    X, T = mesh_of(study["registration"])
    mean, steps = X + pca["mean_displacement"].values, pca["deformation"].values[:N_MODES]
    along = (steps * vertex_normals(mean, T)).sum(2)
    limit = float(SIGMA * np.quantile(np.abs(along), 0.99)) or 1.0
    extremes = np.concatenate([mean + s * step for step in steps for s in (-SIGMA, SIGMA)])

    def draw(mode, s, size=PANEL, **other):
        seen, colors = {**look, **other}, signed_colors(s * along[mode], limit)
        return render(
            mean + s * steps[mode],
            T,
            colors=colors,
            size=size,
            frame=plane_box(extremes, **seen),
            **seen,
        )

    return draw, limit


def write_animation(
    study, path, *, mode=0, n_frames=24, seconds=4.0, view="corner", up="z", size=(400, 340)
):
    """Write a component as an animated GIF, from -3 to 3 standard deviations and back.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``, or as :func:`s4a.analysis.statistics.regression_modes`
        makes it of a regression.
    path : str or Path
    mode : int
        The component, from 0.
    n_frames : int
        Pictures of one way there and back.
    seconds : float
        That it takes.
    view, up
        See :func:`s4a.show.draw.rotation`.
    size : (int, int)
        Width and height in pixels.

    Returns
    -------
    pathlib.Path
    """
    draw, _ = mode_drawer(study, {"view": view, "up": up})
    steps = -SIGMA * np.cos(2 * np.pi * np.arange(n_frames) / n_frames)
    frames = [
        Image.fromarray(on_white(draw(mode, s, size))).convert("P", palette=Image.Palette.ADAPTIVE)
        for s in steps
    ]
    path = Path(path)
    frames[0].save(
        path,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 * seconds / n_frames),
        loop=0,
    )
    return path


def write_picture(study, path, *, view="corner", up="z", size=(400, 340)):
    """Write the first components, from -3 to 3 standard deviations, as one PNG picture on white.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.
    path : str or Path
    view, up
        See :func:`s4a.show.draw.rotation`.
    size : (int, int)
        Width and height in pixels of each of the three by three pictures.

    Returns
    -------
    pathlib.Path
    """
    draw, _ = mode_drawer(study, {"view": view, "up": up})
    components = range(min(N_MODES, study["pca"].sizes["component"]))
    rows = [[draw(mode, s, size) for s in (-SIGMA, 0, SIGMA)] for mode in components]
    path = Path(path)
    path.write_bytes(
        image_bytes(on_white(np.concatenate([np.concatenate(row, axis=1) for row in rows])), "png")
    )
    return path
