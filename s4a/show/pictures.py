"""Pictures and films of modes of variation (6.1, Fig. 4) or a mesh as files."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.colors import to_rgb
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from s4a.geometry.mesh import as_arrays, vertex_normals
from s4a.method.deform import normal_displacement
from s4a.schema import Array, check_count, check_rows
from s4a.show.browser import appearance_state, color_scale
from s4a.show.charts import reach
from s4a.show.draw import SIGNED, Viewpoint, plane_box, render, rotation, signed_colors
from s4a.show.surfaces import mode_arrays, mode_limits

SIGMA = 3  # modes are shown from -3 to 3 standard deviations
N_MODES = 3
PANEL = (320, 270)  # pixels
WIDEST = 3840  # pixels, 4K
BAND = 1_000_000  # pixels that are rendered at once, about 500 MB
FILMS = {".gif": "GIF", ".webp": "WEBP", ".apng": "PNG"}


def shared_frames(surfaces: list[Array], camera: dict[str, Any]) -> list[Array]:
    """Return a frame ``(2, 2)`` around each surface, all of one size, so that sizes compare."""
    boxes = np.array([plane_box(X, **camera) for X in surfaces])
    half = (boxes[:, 1] - boxes[:, 0]).max(0) / 2
    return [box.mean(0) + np.stack([-half, half]) for box in boxes]


def mode_pictures(
    study: xr.DataTree,
    scores: Sequence[float],
    n_modes: int = N_MODES,
    *,
    size: tuple[int, int] = PANEL,
    view: Viewpoint = "corner",
    up: str = "z",
) -> list[list[Array]]:
    """Return pictures ``(height, width, 4)``, a row for each mode and a column for each score.

    They have one frame, with room for three standard deviations, and one colour scale
    (:func:`s4a.show.surfaces.mode_limits`).
    """
    draw = _modes(study, np.arange(1, 1 + n_modes), view, up)
    frame = _frame([draw((-SIGMA, SIGMA))])
    options = {"view": "top", "size": size, "frame": frame}
    pictures: list[Array] = []
    for i, cell in enumerate(draw(scores)):
        column = i % len(scores)
        if column < i and scores[column] == 0:  # the mean is the same in all rows
            pictures.append(pictures[column])
        else:
            pictures.append(render(cell.points, cell.triangles, colors=cell.colors, **options))
    return [pictures[i : i + len(scores)] for i in range(0, len(pictures), len(scores))]


class Cell(NamedTuple):
    """A surface in a picture, with axes right, up and towards the viewer."""

    title: str
    points: Array  # (n, 3)
    triangles: Array
    colors: Array | None
    bar: dict[str, Any]  # result of color_scale, or empty


def write_picture(
    data: Any,
    path: Path | str,
    *,
    mode: int | Sequence[int] | None = None,
    score: float | Sequence[float] = (-SIGMA, 0, SIGMA),
    values: Array | None = None,
    label: str = "",
    title: str = "",
    view: Viewpoint = "corner",
    up: str = "z",
    width: int = 1200,
    transparent: bool = False,
) -> Path:
    """Write modes of variation or a mesh as a PNG picture with titles and colour bar.

    Parameters
    ----------
    data : xarray.DataTree or xarray.Dataset
        A study with ``/registration`` and ``/pca``, or a mesh.  *Save picture* of a panel of
        :mod:`s4a.widgets` writes the panel as it is shown.
    path : str or Path
        File with the suffix ``.png``.
    mode : int or sequence of int
        Numbers of modes of variation, from 1, one per row; by default the first three.
    score : float or sequence of float
        Scores at which each mode is drawn, in standard deviations, one per column.
    values : float ndarray (vertex,) or (vertex, 3), optional
        Numbers of a mesh, drawn on a symmetric colour scale; or colours, red, green and blue from
        0 to 1.
    label : str
        Label of the colour bar, with the unit.
    title : str
        Title of the picture.
    view, up
        Direction of view of a study or a mesh; see :func:`s4a.show.draw.rotation`.
    width : int
        Width in pixels, 100 to 3840; the largest takes up to a minute and 1 GB.
    transparent : bool
        If True, the background is transparent instead of white.

    Returns
    -------
    pathlib.Path

    Raises
    ------
    ValueError
        If a suffix, width or mode is not valid, or there is no surface.

    See Also
    --------
    s4a.write_film : the same as a film.
    s4a.write_page : a page with all results of a study.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> path = Path(tempfile.mkdtemp()) / "mode_1.png"
    >>> s4a.write_picture(study, path, mode=1, score=2, width=400).name
    'mode_1.png'
    """
    path = _checked(path, (".png",), width)
    draw = _source(data, mode, values, label, view, up)
    scores = _numbers("score", score)
    cells = draw(scores)
    columns = min(len(scores), len(cells))
    _compose(cells, _frame([cells]), columns, width, title, transparent).save(path)
    return path


def write_film(
    data: Any,
    path: Path | str,
    *,
    mode: int | Sequence[int] | None = 1,
    reach: float = SIGMA,
    turn: bool = False,
    score: float = 0.0,
    values: Array | None = None,
    label: str = "",
    title: str = "",
    view: Viewpoint = "corner",
    up: str = "z",
    width: int = 600,
    n_frames: int = 48,
    seconds: float = 4.0,
) -> Path:
    """Write a film of modes of variation, or of rotating surfaces, with titles and colour bar.

    Parameters
    ----------
    data : xarray.DataTree or xarray.Dataset
        As for :func:`s4a.write_picture`.  A study of a regression
        (:func:`s4a.analysis.statistics.regression_modes`) has one mode.  A mesh needs
        ``turn=True``.
    path : str or Path
        File with the suffix ``.gif``, ``.webp`` or ``.apng``.  *Save film* of the panels writes
        WebM.
    mode : int or sequence of int
        Numbers of modes of variation, from 1, side by side; None for the first three.
    reach : float
        The score goes from -`reach` to `reach` standard deviations and back.
    turn : bool
        If True, the surfaces rotate once around the axis that points up, at a constant `score`.
    score : float
        Score of the modes if ``turn=True``, in standard deviations.
    values, label, title, view, up
        See :func:`s4a.write_picture`.
    width : int
        Width in pixels, 100 to 3840.
    n_frames : int
        Number of pictures, at least 2.
    seconds : float
        Duration of a cycle.

    Returns
    -------
    pathlib.Path

    Raises
    ------
    ValueError
        If a suffix, width or mode is not valid, or nothing moves.

    See Also
    --------
    s4a.write_picture : one picture.
    s4a.widgets.Modes : sliders of the modes in a notebook.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> path = Path(tempfile.mkdtemp()) / "mode_1.gif"
    >>> s4a.write_film(study, path, mode=1, width=200, n_frames=4).name
    'mode_1.gif'
    """
    path = _checked(path, FILMS, width)
    draw = _source(data, mode, values, label, view, up)
    axis = rotation(view, up)[:, "xyz".index(up)]
    check_count("n_frames", n_frames, 2, 10_000)
    for name, given, more in (
        ("score", score, ""),
        ("reach", reach, ""),
        ("seconds", seconds, f", at least 0.01 for each of {n_frames} frames"),
    ):
        if _numbers(name, given).size > 1 or (more and given < 0.01 * n_frames):
            raise ValueError(f"{name} needs one number{more}, found {given!r}")
    if not turn and isinstance(data, xr.Dataset):
        raise ValueError("a study with modes of variation is needed; for a mesh give turn=True")

    def cells(i):
        angle = 2 * np.pi * i / n_frames
        if not turn:
            return draw(np.array([-reach * np.cos(angle)]))
        return [_rotated(cell, axis, angle) for cell in draw(np.array([score]))]

    frame = _frame(map(cells, range(n_frames)))
    pictures = [
        _compose(drawn, frame, len(drawn), width, title, False).convert("RGB")
        for drawn in map(cells, range(n_frames))
    ]
    if path.suffix.lower() == ".gif":
        pictures = _few_colors(pictures)
    # ms; GIF has hundredths of a second, and the rounded durations add up to `seconds`
    ends = 10 * np.round(100 * seconds * np.arange(n_frames + 1) / n_frames).astype(int)
    pictures[0].save(
        path, FILMS[path.suffix.lower()], save_all=True, append_images=pictures[1:],
        duration=np.diff(ends).tolist(), loop=0,
    )  # fmt: skip
    return path


def _checked(path: Path | str, endings: Iterable[str], width: int) -> Path:
    """Return the path if such a file can be written."""
    path = Path(path)
    if path.suffix.lower() not in endings:
        more = "; a panel's Save film writes WebM" if path.suffix == ".webm" else ""
        raise ValueError(f"the file has to end in {' or '.join(endings)}, found {path.name}{more}")
    check_count("width (pixels)", width, 100, WIDEST)
    if not path.parent.is_dir():
        raise ValueError(f"the folder {path.parent} does not exist: make it, or give another path")
    return path


def _numbers(name, given):
    """Return one or more finite numbers as an array."""
    numbers = np.atleast_1d(given)
    if numbers.dtype.kind not in "iuf" or not numbers.size or not np.isfinite(numbers).all():
        raise ValueError(f"{name} needs a finite number, found {given!r}")
    return numbers


def _few_colors(pictures: list[Image.Image]) -> list[Image.Image]:
    """Quantise pictures to one palette of 256 colours, so that uniform areas do not flicker."""
    step = len(pictures) // 6 + 1
    sample = np.concatenate([np.asarray(picture)[::2, ::2] for picture in pictures[::step]])
    reference = Image.fromarray(sample).quantize(256, kmeans=1)
    none = Image.Dither.NONE
    pictures = [picture.quantize(palette=reference, dither=none) for picture in pictures]
    colors = np.reshape(reference.getpalette() or [], (-1, 3))
    colors[np.asarray(pictures[0])[0, 0]] = 255  # a white background
    for picture in pictures:
        picture.putpalette(colors.ravel().tolist())
    return pictures


def _source(data, mode, values, label, view, up):
    """Return a function scores -> cells."""
    if isinstance(data, xr.DataTree) and {"registration", "pca"} <= set(data.children):
        return _modes(data, mode, view, up)
    if not (isinstance(data, xr.Dataset) and "corner_vertex" in data):
        raise ValueError(
            f"a study with /registration and /pca, or a mesh, is needed, found "
            f"{type(data).__name__}; a panel has the buttons Save picture and Save film"
        )
    X, T = as_arrays(data)
    if values is not None:
        check_rows("values", values, (len(X),), (len(X), 3))
    cell = Cell("", X @ rotation(view, up).T, T, *_value_colors(values, label))
    return lambda scores: [cell]


def _modes(study, mode, view, up):
    """Return a function that draws a row of cells for each mode and a column for each score."""
    share = study["pca"]["explained_variance_ratio"].values
    modes = np.arange(1, 1 + min(N_MODES, len(share))) if mode is None else np.atleast_1d(mode)
    if (
        modes.dtype.kind not in "iu"
        or not len(modes)
        or not set(modes) <= {*range(1, 1 + len(share))}
    ):
        raise ValueError(f"mode needs whole numbers from 1 to {len(share)}, found {mode!r}")
    mean, T, steps = mode_arrays(study, n_modes=max(N_MODES, modes.max()))
    along = normal_displacement(steps, vertex_normals(mean, T))
    limits, R = mode_limits(study), rotation(view, up)
    unit = study["pca"]["deformation"].attrs.get("units", "")
    bar = appearance_state(limits, unit, view, up)["bars"]["normal"]

    def cell(m, s):
        sigmas = f"{round(s, 1) + 0.0:+.1f} σ".replace("-", "−")  # no minus before 0.0
        title = f"mode {m} ({100 * share[m - 1]:.0f} %), {sigmas}" if s else "mean"
        colors = signed_colors(s * along[m - 1], limits[0])
        return Cell(title, (mean + s * steps[m - 1]) @ R.T, T, colors, bar)

    return lambda scores: [cell(m, s) for m in modes for s in scores]


def _value_colors(values, label):
    """Return the colours of the values of a mesh, and their colour bar."""
    if values is None or np.ndim(values) == 2:
        return values, {}
    limit = reach(np.asarray(values, float), 0.99) or 1.0
    bar = color_scale(SIGNED, -limit, limit, label)
    if np.nanmin(values) >= 0:  # the upper half of the scale
        bar |= {"low": 0.0, "colors": bar["colors"][len(bar["colors"]) // 2 :]}
    return signed_colors(values, limit), bar


def _rotated(cell, axis, angle):
    """Rotate a cell around an axis through the centre of its bounding box."""
    Q = Rotation.from_rotvec(angle * axis).as_matrix()
    middle = (cell.points.min(0) + cell.points.max(0)) / 2
    return cell._replace(points=(cell.points - middle) @ Q.T + middle)


def _frame(times):
    """Return a frame ``(2, 2)`` around all cells at all times."""
    boxes = np.array([plane_box(cell.points, "top") for cells in times for cell in cells])
    return np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])


def _compose(cells, frame, columns, width, title, transparent):
    """Compose cells to a picture with titles and one colour bar."""
    size = width // columns
    extent = frame[1] - frame[0]
    height = round(size * np.clip(extent[1] / extent[0], 0.4, 1.5))
    text = max(9, min(width // 40, size // 16))  # pixels
    line, bar = 3 * text // 2, 3 * text if cells[0].bar else 0
    top, row = line * bool(title), line + height
    bottom = top + row * -(-len(cells) // columns)
    image = Image.new("RGBA", (width, bottom + bar), (255, 255, 255, 0))
    if not transparent:
        image.paste((255, 255, 255, 255), (0, 0, *image.size))
    _write(image, title, (width / 2, line / 2), text * 1.2, width)
    for i, cell in enumerate(cells):
        x, y = i % columns * size, top + i // columns * row
        _write(image, cell.title, (x + size / 2, y + line / 2), text, 0.96 * size)
        picture = Image.fromarray(_rendered(cell, (size, height), frame))
        image.alpha_composite(picture, (x, y + line))
    _bar(image, cells[0].bar, (width / 2, bottom), text, 0.9 * width)
    return image


def _rendered(cell, size, frame):
    """Return the pixels of a cell, rendered in bands: at once, 4K would take 3 GB."""
    width, height = size
    scale = 0.94 * min(size / (frame[1] - frame[0]))  # pixels per unit, as in render
    rows, more = BAND // width, 0.02 * width  # the shade of creases needs a margin
    bands = []
    for a in range(0, height, rows):
        b = min(a + rows, height)
        top, bottom = max(a - int(more), 0), min(b + int(more), height)
        middle = frame.mean(0) + [0, (height - top - bottom) / 2 / scale]
        half = 0.47 * np.array([width, bottom - top]) / scale
        band = render(
            cell.points, cell.triangles, colors=cell.colors, view="top",
            size=(width, bottom - top), frame=np.stack([middle - half, middle + half]),
        )  # fmt: skip
        bands.append(band[a - top : b - top])
    return np.concatenate(bands)


def _write(image, text, position, size, max_width, anchor="mm"):
    """Write a text, smaller if it is wider than `max_width`."""
    name = findfont("DejaVu Sans")
    font = ImageFont.truetype(name, size)
    font = ImageFont.truetype(name, size * min(1, max_width / max(1, font.getlength(text))))
    ImageDraw.Draw(image).text(position, text, "#222222", font, anchor)


def _bar(image, bar, position, size, max_width):
    """Draw a colour bar below a position, with its end values and label of a font size."""
    if not bar:
        return
    (x, y), width = position, int(min(max_width, 40 * size))
    left, share = int(x - width / 2), np.linspace(0, 1, width)
    known = np.linspace(0, 1, len(bar["colors"]))
    colors = np.array([to_rgb(color) for color in bar["colors"]])
    strip = np.stack([np.interp(share, known, channel) for channel in colors.T], axis=1)
    strip = np.repeat((255 * strip + 0.5).astype(np.uint8)[None], size, axis=0)
    image.paste(Image.fromarray(strip), (left, int(y + 0.3 * size)))
    for end, px, anchor in (("low", left, "lm"), ("high", left + width, "rm")):
        text = f"{bar[end]:.3g}".replace("-", "−")
        _write(image, text, (px, y + 2 * size), size, width, anchor)
    _write(image, bar["label"], (x, y + 2 * size), size, max(width - 10 * size, width / 3))
