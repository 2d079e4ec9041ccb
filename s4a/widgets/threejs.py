"""Surfaces as pythreejs objects, for scenes of your own.

Every function gives pythreejs objects, which take lights, sprites, arrows, cameras and materials
of your own; :func:`renderer` puts them into a scene that can be turned.  The panels keep a small
renderer of their own: one WebGL context for all views of a page, picking, a keyboard cursor, and
saved pages of some kB.  pythreejs bundles three.js of 2018, and a page shows eight scenes at once.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import pythreejs as three
import xarray as xr
from matplotlib.colors import to_hex, to_rgb
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from s4a.geometry.align import farthest_points
from s4a.geometry.mesh import as_arrays
from s4a.schema import require
from s4a.show.browser import color_scale
from s4a.show.draw import (
    CYCLE_ERROR,
    OKABE_ITO,
    Viewpoint,
    cycle_error_colors,
    position_colors,
    rotation,
)
from s4a.show.surfaces import has, latent_match, names_of, network_limits
from s4a.show.surfaces import surface as study_surface
from s4a.widgets.three_modes import ModesMesh, Scores, modes
from s4a.widgets.three_surfaces import field_colors, smooth_geometry, standard_material, surface

__all__ = [
    "ModesMesh",
    "Scores",
    "correspondence",
    "field_colors",
    "modes",
    "network",
    "points",
    "renderer",
    "surface",
]
LANDMARK = OKABE_ITO[0]


# ---- points, correspondences, networks


def points(
    places: xr.Dataset | Mapping[str, np.ndarray] | np.ndarray,
    color: str = LANDMARK,
    *,
    radius: float | None = None,
    names: bool = True,
) -> three.Group:
    """Landmarks as spheres, with their names.

    Parameters
    ----------
    places : Dataset, dict of str to (3,), or ndarray (p, 3)
        A Dataset with ``landmark_position(landmark, xyz)``, and ``landmark_name`` if they have any.
    color : str
        Of all, as matplotlib knows it.
    radius : float, optional
        In the unit of the places; by default a fiftieth of the diagonal of their box.
    names : bool
        Whether the names stand beside the spheres.

    Returns
    -------
    pythreejs.Group

    Examples
    --------
    >>> from s4a.widgets import threejs
    >>> [part.name for part in threejs.points({"nose": [0, -1, 0], "chin": [0, -1, -1]}).children]
    ['nose', 'chin']
    """
    if isinstance(places, xr.Dataset):
        require(places, "landmark_position", what="dataset")
        where = places["landmark_position"].values
        labels = [""] * len(where)
        if "landmark_name" in places:
            labels = [str(name) for name in places["landmark_name"].values]
    elif isinstance(places, Mapping):
        labels, where = list(places), np.array(list(places.values()), float)
    else:
        where = np.asarray(places, float)
        labels = [""] * len(where)
    if where.ndim != 2 or where.shape[1] != 3 or not len(where) or not np.isfinite(where).all():
        raise ValueError(f"finite points (p, 3) needed, found an array of shape {where.shape}")
    size = radius or float(np.linalg.norm(np.ptp(where, axis=0))) / 50 or 1.0
    ball = three.SphereBufferGeometry(radius=size, widthSegments=20, heightSegments=14)
    material = three.MeshStandardMaterial(color=to_hex(color), roughness=0.5)
    group, middle = three.Group(), where.mean(0)
    for name, place in zip(labels, where, strict=True):
        group.add(three.Mesh(ball, material, position=place.tolist(), name=name))
        if names and name:
            outwards = (place - middle) / (np.linalg.norm(place - middle) or 1.0)
            group.children[-1].add(_name(name, 3.5 * size * outwards, 2.4 * size))
    return group


def _name(text, place, height, *, hidden=True):
    """A text that always faces the viewer; where not `hidden`, nothing stands before it."""
    letters = three.TextTexture(
        string=text, color="black", size=64, fontFace="monospace", squareTexture=False
    )
    material = three.SpriteMaterial(map=letters, transparent=True, depthTest=hidden)
    width = 0.6 * height * len(text)  # of a monospaced font
    return three.Sprite(material, position=np.asarray(place).tolist(), scale=[width, height, 1])


def correspondence(
    pair: xr.Dataset | xr.DataTree | np.ndarray,
    source: xr.Dataset | str,
    target: xr.Dataset | str,
    *,
    n_lines: int = 60,
) -> three.Group:
    """Two surfaces side by side in matching colours, and lines between sampled matches.

    Parameters
    ----------
    pair : xarray.Dataset, xarray.DataTree or int ndarray (vertex,)
        With ``match(vertex)``, as of :func:`s4a.match_pair`, or this match: on each vertex of the
        target one of the source; or a study, whose latent basis matches two of its shapes (eq. 3).
    source, target : xarray.Dataset or str
        The meshes of the pair, or the names of two shapes of the study.
    n_lines : int
        How many matches are drawn, spread over the target.

    Returns
    -------
    pythreejs.Group
        Its children are the source, the target, moved to the side, and the lines.

    Raises
    ------
    ValueError
        When the match is not one of these meshes.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.widgets import threejs
    >>> ball, egg = s4a.synthetic.sphere(200), s4a.synthetic.ellipsoid(200)
    >>> pair = s4a.match_pair(ball, egg, n_coarse=100, k=10, k_init=6)
    >>> len(threejs.correspondence(pair, ball, egg).children)
    3
    """
    if isinstance(pair, xr.DataTree):
        for name in (source, target):
            if name not in pair["coarse"].children:
                raise ValueError(f"two shapes of the study needed, found {name!r}")
        match = latent_match(pair, source, target, dense=False)
        (X, S), (Y, T) = (study_surface(pair, name) for name in (source, target))
    else:
        if isinstance(pair, xr.Dataset):
            require(pair, "match", what="pair")
            pair = pair["match"].values
        match, (X, S), (Y, T) = np.asarray(pair), as_arrays(source), as_arrays(target)
    if len(match) != len(Y) or match.max() >= len(X):
        raise ValueError(
            f"a match of {len(Y)} vertices of the target to {len(X)} of the source needed, "
            f"found {len(match)} up to {match.max()}"
        )
    middle = (X.max(0) + X.min(0)) / 2
    aside = middle - (Y.max(0) + Y.min(0)) / 2
    aside[0] += 0.65 * (np.ptp(X[:, 0]) + np.ptp(Y[:, 0]))
    Y = Y + aside
    colors = position_colors(X)
    here = farthest_points(Y, min(n_lines, len(Y)))
    lines = _lines(X[match[here]], Y[here], colors[match[here]])
    both = np.concatenate([X, Y])
    return three.Group(
        # around the origin, where pythreejs first looks, whatever the target of its controls
        position=(-(both.max(0) + both.min(0)) / 2).tolist(),
        children=[
            three.Mesh(smooth_geometry(X, S, color=colors), standard_material(True)),
            three.Mesh(smooth_geometry(Y, T, color=colors[match]), standard_material(True)),
            lines,
        ],
    )


def _lines(begin, end, colors, width=2):
    """Segments from some points (p, 3) to others, each of one colour."""
    geometry = three.LineSegmentsGeometry(
        positions=np.stack([begin, end], axis=1).astype(np.float32),
        colors=np.stack([colors, colors], axis=1).astype(np.float32),
    )
    material = three.LineMaterial(linewidth=width, vertexColors="VertexColors")
    return three.LineSegments2(geometry, material)


def network(study: xr.DataTree, *, names: bool = True) -> three.Group:
    """Shapes at their places in the space of shape differences, joined by their maps (3.4, 3.5).

    Parameters
    ----------
    study : xarray.DataTree
        With ``/coarse``, ``/network`` and ``/latent``.
    names : bool
        Whether the shapes' names stand above them.

    Returns
    -------
    pythreejs.Group
        A surface for each shape, named after it, their names, and last the lines: each in the
        colour of the mean cycle error of a pair's two maps, as in the panel
        :class:`s4a.widgets.Network`.  Its ``bar`` is the colour bar, which :func:`renderer` shows.

    Raises
    ------
    ValueError
        When the study has no network or no shape differences.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import threejs
    >>> group = threejs.network(s4a.synthetic.example_study(), names=False)
    >>> type(group.children[-1]).__name__
    'LineSegments2'
    """
    missing = [
        name
        for name in ("network/cycle_error", "latent/area_score", "coarse")
        if not has(study, name)
    ]
    if missing:
        raise ValueError(f"a study with {', '.join(missing)} needed, as of s4a.analyse")
    scores = study["latent"].dataset["area_score"]
    shapes = names_of(scores)
    surfaces = {name: study_surface(study, name) for name in shapes}
    size = max(np.ptp(X, axis=0).max() for X, _ in surfaces.values())
    places = np.zeros((len(shapes), 3))
    flat = scores.values[:, :3]
    places[:, : flat.shape[1]] = flat
    # a tenth of the pairs may lie nearer to each other than the shapes are long
    places *= 1.3 * size / max(np.quantile(pdist(places), 0.1), np.finfo(float).tiny)
    group = three.Group()
    for place, (name, (X, T)) in zip(places, surfaces.items(), strict=True):
        centred = X - (X.max(0) + X.min(0)) / 2
        body = three.Mesh(
            smooth_geometry(centred, T),
            standard_material(False),
            position=place.tolist(),
            name=name,
        )
        if names:
            body.add(_name(name, [0, 0, 0.7 * size], 0.15 * size, hidden=False))
        group.add(body)
    net = study["network"].dataset
    sums: dict[tuple, list[float]] = {}
    maps = zip(*(net[key].values for key in ("source", "target", "cycle_error")), strict=True)
    for source, target, error in maps:
        pair = tuple(sorted(shapes.index(str(name)) for name in (source, target)))
        sums.setdefault(pair, []).append(float(error))
    known = np.array([np.nan if np.isnan(e).all() else np.nanmean(e) for e in sums.values()])
    limits = network_limits(study)
    colors = cycle_error_colors(known, limits)
    ends = np.array(list(sums))
    group.add(_lines(places[ends[:, 0]], places[ends[:, 1]], colors, width=3))
    group.bar = color_scale(CYCLE_ERROR, *limits, "cycle error (logarithmic)")
    return group


def _color_bar(bar):
    """A colour bar of width 1, as of :func:`s4a.show.browser.color_scale`, over all else."""
    colors = np.array([to_rgb(color) for color in bar["colors"]])
    places, shares = np.linspace(0, 1, len(colors)), np.linspace(0, 1, 256)
    texels = np.full((1, 256, 4), 255, np.uint8)
    texels[0, :, :3] = np.transpose([255 * np.interp(shares, places, c) for c in colors.T])
    look = {"transparent": True, "depthTest": False}
    strip = three.SpriteMaterial(map=three.DataTexture(texels), **look)
    height = 0.045  # of the text
    group = three.Group(name="colour bar", children=[three.Sprite(strip, scale=[1, 0.04, 1])])
    for text, side in ((f"{bar['low']:.2g}", -1), (bar["label"], 0), (f"{bar['high']:.2g}", 1)):
        width = 0.6 * height * len(text)
        group.add(_name(text, [side * (1 - width) / 2, -0.05, 0], height, hidden=False))
    for part in group.children:
        part.renderOrder = 1
    return group


# ---- scenes


def renderer(
    *objects: three.Object3D,
    size: tuple[int, int] = (600, 450),
    view: Viewpoint = "corner",
    up: str = "z",
) -> three.Renderer:
    """A pythreejs renderer around objects, lit from the viewer, with controls to turn and zoom.

    Parameters
    ----------
    *objects : pythreejs.Object3D
        Of the functions of this module, or of your own; the camera is set to see all of them.  A
        colour bar of theirs stands at the lower edge.
    size : (int, int)
        Width and height in pixels.
    view, up
        From where they are seen first; see :func:`s4a.show.draw.rotation`.

    Returns
    -------
    pythreejs.Renderer
        Its ``scene`` takes more: ``view.scene.add(pythreejs.AxesHelper(50))``.
    """
    corners = [corner for item in objects for corner in _extent(item)]
    if not corners:
        raise ValueError("a renderer needs at least one surface to look at")
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    aspect, fov = size[0] / size[1], 40
    half = np.deg2rad(fov) / 2
    turn = rotation(view, up)
    # what is as deep as wide has room to turn; what is long fills the picture as it is seen first
    around = 0.85 * radius / np.sin(min(half, np.arctan(aspect * np.tan(half))))
    box = np.array([place for place in np.ndindex(3, 3, 3) if place != (1, 1, 1)]) - 1
    ellipsoid = box / np.linalg.norm(box, axis=1, keepdims=True)
    nearest = []  # from where all of the ellipsoid in the box is seen, and all of the box
    for points in (ellipsoid, box):
        x, y, z = turn @ (points * (high - low) / 2).T
        nearest.append(float((z + np.maximum(np.abs(x) / aspect, np.abs(y)) / np.tan(half)).max()))
    distance = min(max(around, 1.05 * nearest[0]), 1.05 * nearest[1])
    bars = [item.bar for item in objects if hasattr(item, "bar")]
    distance *= 1.2 if bars else 1  # room for them below
    camera = three.PerspectiveCamera(
        position=(middle + distance * turn[2]).tolist(),
        up=np.eye(3)["xyz".index(up)].tolist(),
        fov=fov,
        aspect=aspect,
        near=radius / 100,
        far=radius * 20,
        children=[three.DirectionalLight(position=[0, 0, 1], intensity=0.55)],
    )
    for bar in bars:
        drawn, away = _color_bar(bar), radius / 20  # just before the camera, with which it moves
        bottom = away * np.tan(half)
        width = 1.2 * min(aspect, 2) * bottom
        drawn.scale = [width] * 3
        drawn.position = [0, 0.08 * width - bottom, -away]
        camera.add(drawn)
    camera.lookAt(middle.tolist())
    controls = three.OrbitControls(controlling=camera, target=middle.tolist())
    scene = three.Scene(
        children=[*objects, camera, three.AmbientLight(intensity=0.4)], background="#ffffff"
    )
    width, height = size
    return three.Renderer(
        scene=scene, camera=camera, controls=[controls], width=width, height=height, antialias=True
    )


def _extent(item: three.Object3D) -> Iterator[np.ndarray]:
    """Both corners of the box of each thing that is seen of an object and of what is in it."""
    geometry = getattr(item, "geometry", None)
    boxes = []
    if isinstance(geometry, three.BufferGeometry) and "position" in geometry.attributes:
        X = geometry.attributes["position"].array
        boxes.append((X.min(0), X.max(0)))
    elif isinstance(geometry, three.LineSegmentsGeometry):
        X = geometry.positions.reshape(-1, 3)
        boxes.append((X.min(0), X.max(0)))
    elif hasattr(geometry, "radius"):
        boxes.append((np.full(3, -geometry.radius), np.full(3, geometry.radius)))
    for child in getattr(item, "children", ()):
        corners = list(_extent(child))
        boxes += zip(corners[::2], corners[1::2], strict=True)
    turn = Rotation.from_quat(item.quaternion).as_matrix()
    for low, high in boxes:
        corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
        moved = corners * item.scale @ turn.T + item.position
        yield moved.min(0)
        yield moved.max(0)
