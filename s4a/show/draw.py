"""A small software renderer of surfaces in NumPy, and the colours of S4A."""

import base64
import io
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, ListedColormap, LogNorm, to_rgb
from matplotlib.path import Path
from PIL import Image
from scipy.ndimage import gaussian_filter

from s4a.geometry.mesh import triangle_normals, vertex_normals
from s4a.schema import Array

Viewpoint = str | tuple[float, float]  # a name of VIEWS, or azimuth and elevation in degrees
VIEWS = {
    "front": (-90, 0),
    "back": (90, 0),
    "left": (180, 0),
    "right": (0, 0),
    "top": (-90, 90),
    "bottom": (-90, -90),
    "corner": (-50, 22),
}
CLAY = (0.80, 0.76, 0.70)
UNKNOWN = (0.6, 0.6, 0.6)
# Okabe and Ito's colours, distinguishable with all common kinds of colour blindness
OKABE_ITO = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7", "#999999")
# red, white, blue, without the ends, which are too dark for shading
SIGNED = ListedColormap(colormaps["RdBu"](np.linspace(0.06, 0.94, 255)), "signed")
# cycle errors, small to large: viridis without its bright end, which is hard to see on white
CYCLE_ERROR = ListedColormap(
    colormaps["viridis_r"](np.linspace(0.15, 1, 256)), "cycle_error"
).with_extremes(bad="#bbbbbb")
RATIO = 2, 100  # smallest and largest ratio of the ends of the scale of cycle errors
LASSO = 600  # samples along the picture that decides which vertices are hidden
CHUNK = 2_000_000  # candidate samples at a time, about 100 MB


def rotation(view: Viewpoint = "corner", up: str = "z") -> Array:
    """Return the rotation ``(3, 3)`` into the picture: rows right, up and towards the viewer.

    Parameters
    ----------
    view : str or (float, float)
        A name of :data:`VIEWS`, or the viewer's azimuth around the up axis and elevation, in
        degrees.
    up : {"x", "y", "z"}
        The axis that points up; the other two follow in cyclic order.

    Examples
    --------
    >>> from s4a.show.draw import rotation
    >>> rotation("top").round().astype(int).tolist()
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    """
    if up not in ("x", "y", "z"):
        raise ValueError(f"up needs x, y or z, found {up!r}")
    a, e = np.deg2rad(_angles(view))
    right = np.array([-np.sin(a), np.cos(a), 0])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    R = np.stack([right, np.cross(towards, right), towards])
    return np.roll(R, "zxy".index(up), axis=1)


def opposite(view: Viewpoint) -> tuple[float, float]:
    """Return the view from the opposite side, as azimuth and elevation.

    Examples
    --------
    >>> from s4a.show.draw import opposite
    >>> opposite("front")
    (90, 0)
    """
    azimuth, elevation = _angles(view)
    return azimuth + 180, -elevation


def _angles(view):
    if isinstance(view, str) and view not in VIEWS:
        raise ValueError(
            f"view needs one of {', '.join(VIEWS)} or (azimuth, elevation), found {view!r}"
        )
    return VIEWS[view] if isinstance(view, str) else view


def rasterise(P: Array, T: Array, width: int, height: int) -> tuple[Array, Array, Array, Array]:
    """Return the visible triangle of each sample of the picture, by a z-buffer.

    Parameters
    ----------
    P : float ndarray (n, 3)
        Columns: x to the right and y down in samples, z towards the viewer.
    T : int ndarray (m, 3)
    width, height : int

    Returns
    -------
    sample : int ndarray (s,)
        The covered samples, as ``y * width + x``.
    triangle : int ndarray (s,)
    weights : float32 ndarray (s, 3)
        Barycentric weights in that triangle.
    depth : float32 ndarray (s,)
    """
    a, b, c = corners = [P[:, :2].take(corner, axis=0) for corner in T.T]  # (m, 2) each
    # the box of the samples whose centres may lie in the triangle
    low = np.ceil(np.minimum(np.minimum(a, b), c) - 0.5)
    low = np.maximum(low, 0).astype(np.int64)
    high = np.floor(np.maximum(np.maximum(a, b), c) - 0.5)
    high = np.minimum(high, (width - 1, height - 1)).astype(np.int64)
    box = np.maximum(high - low + 1, 0)
    samples = box[:, 0] * box[:, 1]
    double_area, slopes, start = _weight_planes(corners, low)
    z = P[:, 2].astype(np.float32)[T]

    nearest = np.full(width * height, -np.inf, np.float32)
    seen = np.full(width * height, -1, np.int64)
    weights = np.zeros((width * height, 3), np.float32)
    drawn = np.flatnonzero((samples > 0) & (np.abs(double_area) > 1e-9))
    total = np.cumsum(samples[drawn])
    ends = np.arange(CHUNK, total[-1] if len(total) else 0, CHUNK)
    for part in np.split(drawn, np.searchsorted(total, ends)):
        count = samples[part]
        owner = np.repeat(part, count)  # the triangle of each sample of its box
        index = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)  # in the box
        dy, dx = np.divmod(index, np.repeat(box[part, 0], count))
        planes = np.repeat(np.c_[start[part], slopes[part]], count, axis=0).T
        wb = planes[0] + planes[2] * dx + planes[3] * dy
        wc = planes[1] + planes[4] * dx + planes[5] * dy
        inside = np.flatnonzero((wb >= 0) & (wc >= 0) & (wb + wc <= 1))
        owner, wb, wc = owner[inside], wb[inside], wc[inside]
        sample = (low[owner, 1] + dy[inside]) * width + low[owner, 0] + dx[inside]
        w = np.stack([1 - wb - wc, wb, wc], axis=1).astype(np.float32)
        depth = np.einsum("sc,sc->s", w, z[owner])
        np.maximum.at(nearest, sample, depth)
        front = np.flatnonzero(depth == nearest[sample])
        seen[sample[front]], weights[sample[front]] = owner[front], w[front]
    sample = np.flatnonzero(seen >= 0)
    return sample, seen[sample], weights[sample], nearest[sample]


def vertices_within(X: Array, T: Array, polygon: Array | list[Any], rotation: Array) -> Array:
    """Return the visible vertices inside a polygon in the picture's plane.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)
    polygon : float ndarray (q, 2)
        In the plane of the view, x right and y up, in the unit of X.
    rotation : float ndarray (3, 3)
        The rotation of the view, its rows x, y and towards the viewer.

    Returns
    -------
    bool ndarray (n,)
        True for vertices inside that face the viewer and are not hidden.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.geometry.mesh import as_arrays
    >>> from s4a.show.draw import vertices_within
    >>> X, T = as_arrays(s4a.synthetic.sphere(2000))
    >>> square = [[0, 0], [2, 0], [2, 2], [0, 2]]
    >>> inside = X[vertices_within(X, T, square, np.eye(3))]
    >>> bool((inside > -0.01).all()), round(len(inside) / len(X), 2)
    (True, 0.12)
    """
    P = X @ np.reshape(rotation, (3, 3)).T
    low, reach = P[:, :2].min(0), np.ptp(P[:, :2], axis=0).max()
    screen = np.c_[(P[:, :2] - low) * (LASSO - 1) / reach, P[:, 2]]
    sample, _, _, depth = rasterise(screen, T, LASSO, LASSO)
    front = np.full(LASSO * LASSO, -np.inf)
    front[sample] = depth
    column, row = screen[:, :2].astype(int).T
    visible = P[:, 2] >= front[row * LASSO + column] - 0.01 * reach
    facing = vertex_normals(P, T)[:, 2] > 0
    return visible & facing & Path(polygon).contains_points(P[:, :2])


def _weight_planes(corners, low):
    """Return the barycentric weights of corners b and c as linear functions of the position.

    Returns
    -------
    double_area : float ndarray (m,), signed
    slopes : float32 ndarray (m, 4)
        Derivatives of the weight of b by x and y, and of the weight of c.
    start : float32 ndarray (m, 2)
        Both weights at the first sample of the box.
    """
    (ax, ay), (bx, by), (cx, cy) = (corner.T for corner in corners)
    double_area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    scale = 1 / np.where(double_area == 0, 1, double_area)
    slopes = np.stack([cy - ay, ax - cx, ay - by, bx - ax], axis=1) * scale[:, None]
    x, y = low[:, 0] + 0.5 - ax, low[:, 1] + 0.5 - ay
    wb = slopes[:, 0] * x + slopes[:, 1] * y
    wc = slopes[:, 2] * x + slopes[:, 3] * y
    start = np.stack([wb, wc], axis=1)
    return double_area, slopes.astype(np.float32), start.astype(np.float32)


def plane_box(points: Array, view: Viewpoint = "corner", up: str = "z") -> Array:
    """Return the bounding box ``(2, 2)`` of points in the picture's plane, for `render`."""
    plane = np.asarray(points, float).reshape(-1, 3) @ rotation(view, up)[:2].T
    return np.stack([plane.min(0), plane.max(0)])


def render(
    points: Array,
    triangles: Array,
    *,
    colors: Array | None = None,
    flat: bool = False,
    view: Viewpoint = "corner",
    up: str = "z",
    size: tuple[int, int] = (500, 400),
    frame: Array | None = None,
) -> Array:
    """Render a surface: orthographic, softly lit, antialiased, on a transparent background.

    Parameters
    ----------
    points : float ndarray (n, 3)
    triangles : int ndarray (m, 3)
    colors : float ndarray (n, 3), optional
        Red, green and blue of each vertex, 0 to 1; see :func:`signed_colors`, :func:`ramp_colors`
        and :func:`label_colors`.  A row of NaN is grey.
    flat : bool
        Use the colour of the nearest corner, without interpolation: for labels.
    view, up
        See :func:`rotation`.
    size : (int, int)
        Width and height in pixels.
    frame : float ndarray (2, 2), optional
        The part of the picture's plane to show (:func:`plane_box`), so that several pictures have
        one scale; by default the surface fills the picture.

    Returns
    -------
    uint8 ndarray (height, width, 4)
        Red, green, blue and opacity.

    Raises
    ------
    ValueError
        If the surface is empty, or a position is not finite.

    See Also
    --------
    s4a.write_picture : a picture file of a study or a mesh.
    s4a.show.charts.surfaces : several surfaces with titles and a colour bar.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.draw import render
    >>> tetrahedron = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> picture = render(tetrahedron, triangles, size=(60, 40))
    >>> picture.shape, picture[0, 0, 3].item(), picture[20, 30, 3].item()
    ((40, 60, 4), 0, 255)
    """
    X, T = np.asarray(points, float), np.asarray(triangles, np.int64)
    if not len(T) or not np.isfinite(X).all():
        raise ValueError(
            f"render needs triangles and finite positions, found {len(T)} triangles; "
            "clean the mesh first"
        )
    X = X @ rotation(view, up).T
    width, height = 2 * size[0], 2 * size[1]  # two by two samples a pixel
    if frame is None:
        frame = np.stack([X[:, :2].min(0), X[:, :2].max(0)])
    frame = np.asarray(frame)
    extent = np.maximum(frame[1] - frame[0], np.finfo(float).tiny)
    scale = 0.94 * min(width / extent[0], height / extent[1])
    P = (X - [*frame.mean(0), 0]) * [scale, -scale, scale] + [width / 2, height / 2, 0]
    sample, triangle, weights, depth = rasterise(P, T, width, height)
    corners = T[triangle]  # (s, 3)
    N = np.einsum("sc,scx->sx", weights, vertex_normals(X, T).astype(np.float32)[corners])
    # a surface is also lit from behind
    N *= np.where(triangle_normals(X, T)[triangle, 2:] < 0, -1, 1)
    N /= np.maximum(np.linalg.norm(N, axis=1, keepdims=True), 1e-6)
    base = np.asarray(CLAY, np.float32)
    if colors is not None:
        base = _sampled(colors, corners, weights, flat)
    shade = np.zeros((height, width, 4), np.float32)
    shade.reshape(-1, 4)[sample, :3] = _light(N, base, _creases(sample, depth, width, height))
    shade.reshape(-1, 4)[sample, 3] = 1
    pixels = _halved(shade)
    pixels[..., :3] /= np.maximum(pixels[..., 3:], 0.25)  # the mean over the covered samples only
    return (255 * np.clip(pixels, 0, 1) + 0.5).astype(np.uint8)


def _sampled(colors, corners, weights, flat):
    """Interpolate the colours of the corners at every sample."""
    colors = np.asarray(colors, np.float32)
    colors = np.where(np.isfinite(colors), colors, np.array(UNKNOWN, np.float32))
    if flat:
        return colors[np.take_along_axis(corners, weights.argmax(1)[:, None], axis=1)[:, 0]]
    return np.einsum("sc,scx->sx", weights, colors[corners])


def _creases(sample, depth, width, height):
    """Return the darkness ``(s,)`` of samples that are deeper than their surroundings.

    This is an unsharp mask of the depth.
    """
    flat = np.zeros((2, height * width), np.float32)
    flat[0, sample], flat[1, sample] = depth, 1
    sigma = 0.004 * (width + height)
    layers = [_halved(layer.reshape(height, width)) for layer in flat]
    total, cover = (gaussian_filter(layer, sigma, truncate=2.5) for layer in layers)
    around = total / np.maximum(cover, 1e-3)
    y, x = np.divmod(sample, width)
    return np.clip((around[y // 2, x // 2] - depth) / (5 * sigma), 0, 1)


def _halved(samples):
    """Return the mean of each two by two samples."""
    return (samples[::2, ::2] + samples[1::2, ::2] + samples[::2, 1::2] + samples[1::2, 1::2]) / 4


def _light(N, base, crease):
    """Return colours ``(s, 3)`` under a key light from the upper left, a soft sky and gloss."""
    key = np.array([-0.42, 0.55, 0.72], np.float32)
    key /= np.linalg.norm(key)
    gloss = key + [0, 0, 1]
    gloss = (gloss / np.linalg.norm(gloss)).astype(np.float32)
    wrap = np.clip((N @ key + 0.3) / 1.3, 0, 1)
    sky = 0.5 + 0.5 * N[:, 1]
    silhouette = np.clip(1 - N[:, 2], 0, 1) ** 3
    light = (0.47 + 0.15 * sky + 0.48 * wrap) * (1 - 0.5 * crease) * (1 - 0.3 * silhouette)
    shine = 0.10 * np.clip(N @ gloss, 0, 1) ** 40 * (1 - crease)
    return np.clip(base * light[:, None] + shine[:, None], 0, 1)


def signed_colors(values: Array, limit: float) -> Array:
    """Return colours ``(n, 3)`` of signed values, white at 0.

    Blue is positive (expansion), red is negative (compression).

    Parameters
    ----------
    values : float ndarray (n,)
    limit : float
        The absolute value at the ends of the colour scale.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.draw import signed_colors
    >>> red, white, blue = signed_colors(np.array([-2.0, 0.0, 2.0]), limit=2)
    >>> bool(red[0] > red[2]), bool(white.min() > 0.9), bool(blue[2] > blue[0])
    (True, True, True)
    """
    return ramp_colors(values, -limit, limit, SIGNED)


def ramp_colors(
    values: Array,
    low: float | None = None,
    high: float | None = None,
    colormap: str | Colormap = "viridis",
) -> Array:
    """Return colours ``(n, 3)`` of values from `low` to `high`, by default their range.

    NaN stays NaN.
    """
    values = np.asarray(values, float)
    low = np.nanmin(values) if low is None else low
    high = np.nanmax(values) if high is None else high
    span = high - low if high > low else 1.0
    colors = colormaps.get_cmap(colormap)(np.nan_to_num((values - low) / span))[..., :3]
    return np.where(np.isnan(values)[..., None], np.nan, colors)


def label_colors(labels: Array) -> Array:
    """Return colours ``(n, 3)`` of integer labels: Okabe and Ito's, then darker and lighter ones.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.draw import label_colors
    >>> len(np.unique(label_colors(np.arange(24)), axis=0))
    24
    >>> import s4a
    >>> brain = s4a.synthetic.brains(1, 3000)["original/brain_01"].to_dataset()
    >>> colors = {"regions": label_colors(brain["label"].values)}
    >>> s4a.show.charts.surfaces({"regions": brain}, colors, flat=True)
    <TiledFigure ...>
    """
    palette = np.array([to_rgb(color) for color in OKABE_ITO])
    palette = np.concatenate([palette, 0.55 * palette, 0.45 + 0.55 * palette])
    _, index = np.unique(labels, return_inverse=True)
    return palette[index.reshape(np.shape(labels)) % len(palette)]


def cycle_error_limits(*errors: Array) -> tuple[float, float]:
    """Return the ends of the colour scale of cycle errors, from the errors of all stages.

    A study has one scale: maps before and after Consistent ZoomOut can be compared, and an error
    has the same colour in panels, charts and scenes.

    Parameters
    ----------
    *errors : float ndarray (pair,)
        Errors of each stage; NaN for maps in no cycle.

    Returns
    -------
    (float, float)
        Smallest and largest known error, with a ratio of at least 2, so that similar errors have
        similar colours, and at most 100: smaller errors have the colour of the lower end.
        (0.5, 1) if all errors are 0 or unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.draw import cycle_error_limits
    >>> cycle_error_limits(np.array([0.08, np.nan, 0.06]), np.array([0.035, 0.04]))
    (0.035, 0.08)
    >>> cycle_error_limits(np.array([0.0, 1.0])), cycle_error_limits(np.array([1.0, 0.9]))
    ((0.01, 1.0), (0.5, 1.0))
    """
    known = np.concatenate([np.ravel(values)[np.isfinite(np.ravel(values))] for values in errors])
    high = float(known.max(initial=0)) or 1.0
    smallest, largest = RATIO
    return float(np.clip(known.min(initial=high), high / largest, high / smallest)), high


def cycle_error_colors(errors: Array, limits: tuple[float, float]) -> Array:
    """Return colours ``(pair, 3)`` of cycle errors on a logarithmic scale, yellow-green to violet.

    Parameters
    ----------
    errors : float ndarray (pair,)
        NaN, for maps in no cycle, is grey.
    limits : (float, float)
        Result of :func:`cycle_error_limits`.

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.colors import to_hex
    >>> from s4a.show.draw import cycle_error_colors
    >>> colors = cycle_error_colors(np.array([0.01, 0.1, 1.0, np.nan]), (0.01, 1.0))
    >>> [to_hex(color) for color in colors]
    ['#9bd93c', '#277e8e', '#440154', '#bbbbbb']
    """
    share = LogNorm(*limits, clip=True)(np.ma.masked_invalid(errors))
    return np.asarray(CYCLE_ERROR(share))[..., :3]


def position_colors(points: Array, among: Array | None = None) -> Array:
    """Return colours ``(n, 3)`` of positions: the coordinates as red, green and blue.

    The scale is that of the points `among`, by default the points themselves; NaN stays NaN.

    Examples
    --------
    >>> import s4a
    >>> from s4a.show.draw import position_colors
    >>> ball = s4a.synthetic.sphere(2000)
    >>> colors = {"positions": position_colors(ball["position"].values)}
    >>> s4a.show.charts.surfaces({"positions": ball}, colors)
    <TiledFigure ...>
    """
    points = np.asarray(points, float)
    box = points if among is None else np.asarray(among, float)
    low, high = box.min(0), box.max(0)
    return 0.12 + 0.83 * (points - low) / np.maximum(high - low, np.finfo(float).tiny)


def checkerboard(coordinates: Array, cell: float) -> Array:
    """Return the brightness ``(n,)`` of a checkerboard of cubes of side `cell`: 1 or 0.5.

    NaN stays NaN.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.draw import checkerboard
    >>> checkerboard(np.array([[0.1, 0.1, 0.1], [1.1, 0.1, 0.1], [1.1, 1.9, 0.1]]), 1.0)
    array([1. , 0.5, 1. ])
    >>> import s4a
    >>> ball = s4a.synthetic.sphere(30_000)
    >>> grey = checkerboard(ball["position"].values, 0.4)[:, None] * np.ones(3)
    >>> s4a.show.charts.surfaces({"cubes of 0.4": ball}, {"cubes of 0.4": grey})
    <TiledFigure ...>
    """
    return 1 - 0.5 * (np.floor(np.asarray(coordinates) / cell).sum(1) % 2)


def with_balls(
    points: Array, triangles: Array, colors: Array | None, balls: list[list[float]]
) -> tuple[Array, Array, Array | None]:
    """Add spheres to a surface: return points, triangles and colours of both.

    A ball is x, y, z, red, green, blue, radius.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.draw import with_balls
    >>> ball = [5, 0, 0, 1, 0, 0, 2.0]
    >>> X, T, colors = with_balls(np.zeros((3, 3)), np.array([[0, 1, 2]]), None, [ball])
    >>> float(X[:, 0].min()), float(X[:, 0].max()), colors[-1].tolist()
    (0.0, 7.0, [1.0, 0.0, 0.0])
    """
    if not len(balls):
        return points, triangles, colors
    rings, around = 10, 16
    polar, azimuth = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, around + 1)
    a, b = np.meshgrid(polar, azimuth, indexing="ij")
    unit = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], -1).reshape(-1, 3)
    # two triangles of each patch between two rings
    above = (np.arange(rings)[:, None] * (around + 1) + np.arange(around)).ravel()
    below = above + around + 1
    T = np.concatenate([
        np.stack([above, below, above + 1], 1), np.stack([above + 1, below, below + 1], 1)
    ])  # fmt: skip
    table = np.asarray(balls, float)  # (ball, 7)
    centre, color, radius = table[:, None, :3], table[:, 3:6], table[:, 6, None, None]
    first = len(points) + len(unit) * np.arange(len(balls))
    if colors is None:
        colors = np.tile(CLAY, (len(points), 1))
    return (
        np.concatenate([points, (centre + radius * unit).reshape(-1, 3)]),
        np.concatenate([triangles, (T + first[:, None, None]).reshape(-1, 3)]),
        np.concatenate([colors, np.repeat(color, len(unit), axis=0)]),
    )


def image_bytes(picture: Array, kind: str = "webp") -> bytes:
    """Return a picture ``(height, width, 4)`` as an image file: small ``webp`` or exact ``png``.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.show.draw import image_bytes
    >>> image_bytes(np.zeros((2, 2, 4), np.uint8), "png")[1:4]
    b'PNG'
    """
    file = io.BytesIO()
    Image.fromarray(picture).save(file, kind, quality=88, optimize=True)
    return file.getvalue()


def on_white(picture: Array) -> Array:
    """Blend a picture ``(height, width, 4)`` with white to ``(height, width, 3)``."""
    opacity = picture[..., 3:] / 255
    return (picture[..., :3] * opacity + 255 * (1 - opacity) + 0.5).astype(np.uint8)


def data_uri(content: bytes, kind: str = "image/webp") -> str:
    """Return bytes as a data URI for a page."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
