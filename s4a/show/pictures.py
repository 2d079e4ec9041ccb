"""Pictures of the modes of a study (6.1, Fig. 4): as files, and the renderer of one of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from PIL import Image

from s4a.geometry.mesh import vertex_normals
from s4a.method.deform import normal_displacement
from s4a.show.draw import Viewpoint, image_bytes, on_white, plane_box, render, signed_colors
from s4a.show.surfaces import mode_arrays, mode_limits

SIGMA = 3  # the modes are shown from -3 to 3 standard deviations
N_MODES = 3
PANEL = (320, 270)  # pixels


def shared_frames(surfaces: list[np.ndarray], look: dict[str, Any]) -> list[np.ndarray]:
    """Frames ``(2, 2)`` around each of some surfaces, all as large as the largest needs.

    So sizes can be compared.
    """
    boxes = [plane_box(X, **look) for X in surfaces]
    half = np.max([box[1] - box[0] for box in boxes], axis=0) / 2
    return [box.mean(0) + np.stack([-half, half]) for box in boxes]


def mode_drawer(
    study: xr.DataTree, look: dict[str, Any]
) -> tuple[Callable[..., np.ndarray], float]:
    """What draws the first components, all on one colour scale.

    Returns
    -------
    draw : function
        ``draw(mode, s, size=PANEL, **look)`` is the picture of the mean shape moved by s standard
        deviations, coloured by how far it moves along its normal.
    limit : float
        The displacement of the full colours, in the unit of the input; see
        :func:`s4a.show.surfaces.mode_limits`.
    """
    mean, T, steps = mode_arrays(study, n_modes=N_MODES)
    along = normal_displacement(steps, vertex_normals(mean, T))
    limit, _ = mode_limits(study)
    extremes = np.concatenate([mean + s * step for step in steps for s in (-SIGMA, SIGMA)])

    def draw(mode, s, size=PANEL, **other):
        seen = {**look, **other}
        colors = signed_colors(s * along[mode], limit)
        frame = plane_box(extremes, **seen)
        return render(mean + s * steps[mode], T, colors=colors, size=size, frame=frame, **seen)

    return draw, limit


def write_animation(
    study: xr.DataTree,
    path: Path | str,
    *,
    mode: int = 0,
    n_frames: int = 24,
    seconds: float = 4.0,
    view: Viewpoint = "corner",
    up: str = "z",
    size: tuple[int, int] = (400, 340),
) -> Path:
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
    path = Path(path)
    frames = []
    for s in -SIGMA * np.cos(2 * np.pi * np.arange(n_frames) / n_frames):
        image = Image.fromarray(on_white(draw(mode, s, size)))
        frames.append(image.convert("P", palette=Image.Palette.ADAPTIVE))
    lasts = round(1000 * seconds / n_frames)  # milliseconds
    rest = frames[1:]
    frames[0].save(path, "GIF", save_all=True, append_images=rest, duration=lasts, loop=0)
    return path


def write_picture(
    study: xr.DataTree,
    path: Path | str,
    *,
    view: Viewpoint = "corner",
    up: str = "z",
    size: tuple[int, int] = (400, 340),
) -> Path:
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
    path = Path(path)
    rows = []
    for mode in range(min(N_MODES, study["pca"].sizes["component"])):
        rows.append(np.concatenate([draw(mode, s, size) for s in (-SIGMA, 0, SIGMA)], axis=1))
    path.write_bytes(image_bytes(on_white(np.concatenate(rows)), "png"))
    return path
