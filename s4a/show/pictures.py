"""Pictures and films as files: of the modes of a study (6.1, Fig. 4), of a mesh, of a panel."""

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
from s4a.show.browser import color_scale, look_state
from s4a.show.charts import reach
from s4a.show.draw import SIGNED, Viewpoint, plane_box, render, rotation, signed_colors
from s4a.show.surfaces import mode_arrays, mode_limits

SIGMA = 3  # the modes are shown from -3 to 3 standard deviations
N_MODES = 3
PANEL = (320, 270)  # pixels
WIDEST = 3840  # pixels, 4K
BAND = 1_000_000  # pixels that are rendered at once, some 500 MB
FILMS = {".gif": "GIF", ".webp": "WEBP", ".apng": "PNG"}


def shared_frames(surfaces: list[np.ndarray], look: dict[str, Any]) -> list[np.ndarray]:
    """Frames ``(2, 2)`` around each of some surfaces, all as large as the largest needs.

    So sizes can be compared.
    """
    boxes = np.array([plane_box(X, **look) for X in surfaces])
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
) -> list[list[np.ndarray]]:
    """Pictures ``(height, width, 4)`` of the first modes, one a row, at scores, one a column.

    All of one frame, which has room for three standard deviations, and one colour scale, that of
    :func:`s4a.show.surfaces.mode_limits`.
    """
    draw = _modes(study, np.arange(1, 1 + n_modes), view, up)
    frame = _frames([draw((-SIGMA, SIGMA))], True)[0]
    look = {"view": "top", "size": size, "frame": frame}
    drawn = [render(c.points, c.triangles, colors=c.colors, **look) for c in draw(scores)]
    return [drawn[i : i + len(scores)] for i in range(0, len(drawn), len(scores))]


class Cell(NamedTuple):
    """A surface in a picture; x to the right, y up and z towards the viewer."""

    title: str
    points: np.ndarray  # (n, 3)
    triangles: np.ndarray
    colors: np.ndarray | None
    bar: dict[str, Any]  # as of color_scale, or empty


def write_picture(
    what: Any,
    path: Path | str,
    *,
    mode: int | Sequence[int] | None = None,
    score: float | Sequence[float] = (-SIGMA, 0, SIGMA),
    values: np.ndarray | None = None,
    label: str = "",
    title: str = "",
    view: Viewpoint = "corner",
    up: str = "z",
    width: int = 1200,
    transparent: bool = False,
) -> Path:
    """Write surfaces as a PNG picture with titles and colour bar: modes, a mesh or a panel.

    Parameters
    ----------
    what : xarray.DataTree, xarray.Dataset or panel
        A study with ``/registration`` and ``/pca``; a mesh; or a panel of :mod:`s4a.widgets`, whose
        surfaces are drawn side by side as it shows them first.
    path : str or Path
        Ends in ``.png``.
    mode : int or sequence of int
        Modes of a study, from 1, one a row; by default the first three.
    score : float or sequence of float
        Standard deviations from the mean at which each mode is drawn, one a column.
    values : float ndarray (vertex,) or (vertex, 3), optional
        Of a mesh: numbers, which are coloured from their largest to 0 and to its negative; or
        colours, red, green and blue from 0 to 1.
    label : str
        What the numbers are, with their unit.
    title : str
        A line above the picture.
    view, up
        From where a study or a mesh is seen; see :func:`s4a.show.draw.rotation`.
    width : int
        In pixels, 100 to 3840, which takes up to a minute and 1 GB; the height follows.
    transparent : bool
        Without the white ground.

    Returns
    -------
    pathlib.Path

    Raises
    ------
    ValueError
        For an ending, a width or a mode that does not exist, or where no surface is found.

    See Also
    --------
    write_film : the same while it moves.

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
    draw, _, together = _source(what, mode, values, label, view, up)
    scores = _numbers("score", score)
    cells = draw(scores)
    columns = len(scores) if together else len(cells)
    frames = _frames([cells], together)
    _sheet(cells, frames, columns, width, title, transparent).save(path)
    return path


def write_film(
    what: Any,
    path: Path | str,
    *,
    mode: int | Sequence[int] | None = 1,
    reach: float = SIGMA,
    turn: bool = False,
    score: float = 0.0,
    values: np.ndarray | None = None,
    label: str = "",
    title: str = "",
    view: Viewpoint = "corner",
    up: str = "z",
    width: int = 600,
    n_frames: int = 48,
    seconds: float = 4.0,
) -> Path:
    """Write a film with titles and colour bar: modes of a study to both ends, or one turn.

    Parameters
    ----------
    what : xarray.DataTree, xarray.Dataset or panel
        As of :func:`s4a.write_picture`; a study of a regression, as
        :func:`s4a.analysis.statistics.regression_modes` makes it, has one mode.  A mesh and a panel
        are filmed with ``turn=True``.
    path : str or Path
        Ends in ``.gif``, ``.webp`` or ``.apng``.  WebM is written by *Save film* of the panels, as
        browsers can encode it.
    mode : int or sequence of int
        Modes of a study, from 1, side by side; None for the first three.
    reach : float
        The modes move from minus so many standard deviations to plus as many, and back.
    turn : bool
        Turn the surfaces once around the axis that points up; the modes stand at `score`.
    score : float
        Standard deviations from the mean of a study that is turned.
    values, label, title, view, up
        See :func:`s4a.write_picture`.
    width : int
        In pixels, 100 to 3840.
    n_frames : int
        Pictures of the film, at least 2.
    seconds : float
        How long it takes, before it starts again.

    Returns
    -------
    pathlib.Path

    Raises
    ------
    ValueError
        For an ending, a width or a mode that does not exist, or where nothing moves.

    See Also
    --------
    write_picture : one picture.

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
    draw, axis, together = _source(what, mode, values, label, view, up)
    _whole("n_frames", n_frames, 2, 10_000)
    for name, given, more in (
        ("score", score, ""),
        ("reach", reach, ""),
        ("seconds", seconds, f", at least 0.01 for each of {n_frames} frames"),
    ):
        if _numbers(name, given).size > 1 or (more and given < 0.01 * n_frames):
            raise ValueError(f"{name} needs one number{more}, found {given!r}")
    if not (turn or together):
        raise ValueError(
            f"a study whose modes move is needed, found {type(what).__name__}; "
            "a mesh or a panel is filmed with turn=True"
        )

    def cells(i):
        angle = 2 * np.pi * i / n_frames
        if not turn:
            return draw(np.array([-reach * np.cos(angle)]))
        return [_turned(cell, axis, angle) for cell in draw(np.array([score]))]

    frames = _frames(map(cells, range(n_frames)), together)
    pictures = [
        _sheet(shown, frames, len(shown), width, title, False).convert("RGB")
        for shown in map(cells, range(n_frames))
    ]
    if path.suffix.lower() == ".gif":
        pictures = _few_colors(pictures)
    # ms; GIF has hundredths of a second, and the rounded ones add up to all seconds
    ends = 10 * np.round(100 * seconds * np.arange(n_frames + 1) / n_frames).astype(int)
    pictures[0].save(
        path, FILMS[path.suffix.lower()], save_all=True, append_images=pictures[1:],
        duration=np.diff(ends).tolist(), loop=0,
    )  # fmt: skip
    return path


def _checked(path: Path | str, endings: Iterable[str], width: int) -> Path:
    """The path, if such a file can be written."""
    path = Path(path)
    if path.suffix.lower() not in endings:
        more = "; a panel's Save film writes WebM" if path.suffix == ".webm" else ""
        raise ValueError(f"the file has to end in {' or '.join(endings)}, found {path.name}{more}")
    _whole("width (pixels)", width, 100, WIDEST)
    if not path.parent.is_dir():
        raise ValueError(f"the folder {path.parent} is not there: make it, or give another path")
    return path


def _whole(name, given, low, high):
    """ValueError unless it is a whole number within both ends."""
    if not isinstance(given, int | np.integer) or not low <= given <= high:
        raise ValueError(f"{name} needs a whole number from {low} to {high}, found {given!r}")


def _numbers(name, given):
    """Finite numbers as an array, at least one of them."""
    numbers = np.atleast_1d(given)
    if numbers.dtype.kind not in "iuf" or not numbers.size or not np.isfinite(numbers).all():
        raise ValueError(f"{name} needs a finite number, found {given!r}")
    return numbers


def _few_colors(pictures: list[Image.Image]) -> list[Image.Image]:
    """Pictures in 256 colours: the same for all, or plain areas would flicker."""
    step = len(pictures) // 6 + 1
    some = np.concatenate([np.asarray(one)[::2, ::2] for one in pictures[::step]])
    few = Image.fromarray(some).quantize(256, kmeans=1)
    pictures = [one.quantize(palette=few, dither=Image.Dither.NONE) for one in pictures]
    colors = np.reshape(few.getpalette() or [], (-1, 3))
    colors[np.asarray(pictures[0])[0, 0]] = 255  # the ground, as white as the page
    for one in pictures:
        one.putpalette(colors.ravel().tolist())
    return pictures


def _source(what, mode, values, label, view, up):
    """What draws something, scores -> cells; the axis of a turn; whether cells share a frame."""
    R = rotation(view, up)
    axis = R[:, "xyz".index(up)]
    if isinstance(what, xr.DataTree) and {"registration", "pca"} <= set(what.children):
        return _modes(what, mode, view, up), axis, True
    cells = []
    if isinstance(what, xr.Dataset) and "corner_vertex" in what:
        X, T = as_arrays(what)
        if values is not None and np.shape(values) not in ((len(X),), (len(X), 3)):
            raise ValueError(
                f"values need a number or a colour (r, g, b) for each of the {len(X)} vertices, "
                f"found an array of shape {np.shape(values)}"
            )
        cells.append(Cell("", X @ R.T, T, *_painted(values, label)))
    elif hasattr(what, "comm"):  # a widget
        cells, axis = list(_views(what)), np.array([0.0, 1, 0])
    if not cells:
        raise ValueError(
            f"a study with /registration and /pca, a mesh or a panel with a surface is needed, "
            f"found {type(what).__name__}"
        )
    return lambda scores: cells, axis, False


def _modes(study, mode, view, up):
    """What draws modes, one a row, at scores, one a column."""
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
    bar = look_state(limits, unit, view, up)["bars"]["normal"]

    def cell(m, s):
        title = f"mode {m} ({100 * share[m - 1]:.0f} %), {_sigmas(s)}" if s else "mean"
        colors = signed_colors(s * along[m - 1], limits[0])
        return Cell(title, (mean + s * steps[m - 1]) @ R.T, T, colors, bar)

    return lambda scores: [cell(m, s) for m in modes for s in scores]


def _sigmas(score):
    return f"{round(score, 1) + 0.0:+.1f} σ".replace("-", "−")  # no minus before 0.0


def _painted(values, label):
    """Colours of the values of a mesh, and their bar."""
    if values is None or np.ndim(values) == 2:
        return values, {}
    limit = reach(np.asarray(values, float), 0.99) or 1.0
    bar = color_scale(SIGNED, -limit, limit, label)
    if np.nanmin(values) >= 0:  # the half that there is
        bar |= {"low": 0.0, "colors": bar["colors"][len(bar["colors"]) // 2 :]}
    return signed_colors(values, limit), bar


def _views(widget):
    """The surfaces that a panel shows, from where they are seen first."""
    from s4a.show.panel_page import widgets_in

    if hasattr(widget, "tabs"):  # of explore: the one that is seen
        widget = widget.tabs.children[widget.tabs.selected_index or 0]
    for part in widgets_in(widget):
        drawn = part.drawn() if hasattr(part, "drawn") else None
        if drawn is not None and part.layout.display != "none":
            X, T, colors = drawn
            bar = part.bar if part.has_trait("bar") else part.bars.get(part.colors, {})
            scores = [
                f"mode {m} {_sigmas(s)}" for m, s in enumerate(getattr(part, "scores", ()), 1) if s
            ]
            title = getattr(part, "title", ", ".join(scores) or "mean")
            yield Cell(title, X @ np.reshape(part.turn, (3, 3)).T, T, colors, bar)


def _turned(cell, axis, angle):
    """The cell turned around the axis through the middle of its box."""
    Q = Rotation.from_rotvec(angle * axis).as_matrix()
    middle = (cell.points.min(0) + cell.points.max(0)) / 2
    return cell._replace(points=(cell.points - middle) @ Q.T + middle)


def _frames(times, together):
    """Frames ``(cell, 2, 2)`` of one size, around cells at all times; `together` one of all."""
    boxes = np.array([[plane_box(cell.points, "top") for cell in cells] for cells in times])
    low, high = boxes[:, :, 0].min(0), boxes[:, :, 1].max(0)  # (cell, 2)
    if together:
        low, high = np.full_like(low, low.min(0)), np.full_like(high, high.max(0))
    half, middle = (high - low).max(0) / 2, (low + high) / 2
    return np.stack([middle - half, middle + half], axis=1)


def _sheet(cells, frames, columns, width, title, transparent):
    """The picture of some cells: titles above them, below each its colour bar, or one below all."""
    size = width // columns
    extent = frames[0, 1] - frames[0, 0]
    tall = round(size * np.clip(extent[1] / extent[0], 0.4, 1.5))
    text = max(9, min(width // 40, size // 16))  # pixels
    one = all(cell.bar == cells[0].bar for cell in cells)
    line, bar = 3 * text // 2, 3 * text if any(cell.bar for cell in cells) else 0
    top, row = line * bool(title), line + tall + bar * (not one)
    n_rows = -(-len(cells) // columns)
    sheet = Image.new("RGBA", (width, top + n_rows * row + bar * one), (255, 255, 255, 0))
    if not transparent:
        sheet.paste((255, 255, 255, 255), (0, 0, *sheet.size))
    _write(sheet, title, (width / 2, line / 2), text * 1.2, width)
    for i, (cell, frame) in enumerate(zip(cells, frames, strict=True)):
        x, y = i % columns * size, top + i // columns * row
        _write(sheet, cell.title, (x + size / 2, y + line / 2), text, 0.96 * size)
        picture = Image.fromarray(_rendered(cell, (size, tall), frame))
        sheet.alpha_composite(picture, (x, y + line))
        if not one:
            _bar(sheet, cell.bar, (x + size / 2, y + line + tall), text, 0.9 * size)
    if one:
        _bar(sheet, cells[0].bar, (width / 2, top + n_rows * row), text, 0.9 * width)
    return sheet


def _rendered(cell, size, frame):
    """The pixels of a cell, rendered in bands, as a picture of 4K would take 3 GB at once."""
    width, height = size
    scale = 0.94 * min(size / (frame[1] - frame[0]))  # pixels a unit, as in render
    rows, more = BAND // width, 0.02 * width  # the shade of creases needs what is around
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


def _write(sheet, words, middle, size, room, anchor="mm"):
    """Words on a sheet, smaller where they would not have room."""
    name = findfont("DejaVu Sans")
    font = ImageFont.truetype(name, size)
    font = ImageFont.truetype(name, size * min(1, room / max(1, font.getlength(words))))
    ImageDraw.Draw(sheet).text(middle, words, "#222222", font, anchor)


def _bar(sheet, bar, at, text, room):
    """A colour bar below a place, with its numbers and its label."""
    if not bar:
        return
    (x, y), wide = at, int(min(room, 40 * text))
    left, place = int(x - wide / 2), np.linspace(0, 1, wide)
    known = np.linspace(0, 1, len(bar["colors"]))
    colors = np.array([to_rgb(color) for color in bar["colors"]])
    strip = np.stack([np.interp(place, known, channel) for channel in colors.T], axis=1)
    strip = np.repeat((255 * strip + 0.5).astype(np.uint8)[None], text, axis=0)
    sheet.paste(Image.fromarray(strip), (left, int(y + 0.3 * text)))
    for words, px, anchor in (("low", left, "lm"), ("high", left + wide, "rm")):
        _write(sheet, f"{bar[words]:.3g}".replace("-", "−"), (px, y + 2 * text), text, wide, anchor)
    _write(sheet, bar["label"], (x, y + 2 * text), text, max(wide - 10 * text, wide / 3))
