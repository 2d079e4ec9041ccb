"""Surfaces as pythreejs objects, for custom scenes.

The functions return pythreejs objects, which can be combined with other lights, sprites, arrows,
cameras and materials; :func:`renderer` puts them into a scene that can be rotated.  The panels use
their own small renderer instead, with one WebGL context for all views of a page, picking, a
keyboard cursor, and small saved pages.  pythreejs bundles three.js of 2018, and a page shows at
most eight scenes.
"""

from collections.abc import Mapping
from pathlib import Path

import anywidget
import numpy as np
import pythreejs as three
import traitlets
import xarray as xr
from ipywidgets import widget_serialization
from matplotlib.colors import Colormap, to_hex, to_rgb
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from s4a.geometry.align import farthest_points
from s4a.geometry.mesh import as_arrays, normal_sums, vertex_normals
from s4a.method.steps import latent_match
from s4a.schema import Array, check_choice, check_rows, require
from s4a.show import draw
from s4a.show.browser import color_scale
from s4a.show.draw import CLAY, SIGNED, Viewpoint
from s4a.show.surfaces import (
    has,
    mode_arrays,
    mode_limits,
    names_of,
    network_limits,
    template_coarse,
)
from s4a.show.surfaces import surface as study_surface

LANDMARK = draw.OKABE_ITO[0]
SCRIPTS = Path(__file__).parent / "scripts"
WIDTH = 2048  # texels in a row of the table of modes: a power of two, so that indices are exact
HUES = "compressed narrowed still widened expanded".split()
HEIGHT = 4096  # rows that every graphics card supports
LIGHTS = (  # uniforms that three.js fills in for a lit shader
    "ambientLightColor directionalLights directionalShadowMap directionalShadowMatrix spotLights "
    "spotShadowMap spotShadowMatrix rectAreaLights ltc_1 ltc_2 pointLights pointShadowMap "
    "pointShadowMatrix hemisphereLights"
).split()


# ---- surfaces


def surface(
    mesh: xr.Dataset,
    field: str | Array | xr.DataArray | None = None,
    cmap: str | Colormap | None = None,
    *,
    limits: tuple[float, float] | None = None,
) -> three.Mesh:
    """Return a mesh Dataset as a smooth pythreejs surface, coloured by a field.

    Parameters
    ----------
    mesh : xarray.Dataset
        With ``position(vertex, xyz)`` and ``corner_vertex(triangle, corner)``.
    field : str or ndarray (vertex,) or (vertex, 3), optional
        A value of each vertex, or the name of such a variable of the mesh.  Integers and booleans
        are labels with a colour each, other numbers are mapped by `cmap`, and three numbers are
        red, green and blue from 0 to 1.  Vertices with non-finite values are grey.
    cmap : str or matplotlib.colors.Colormap, optional
        By default red, white and blue for a signed field, else "viridis".
    limits : (float, float), optional
        Values at the ends of the colour map; by default the 1 % and 99 % quantiles of the field,
        made symmetric for a signed field.

    Returns
    -------
    pythreejs.Mesh

    Raises
    ------
    ValueError
        If a position is not finite, or the field does not have one value for each vertex.

    See Also
    --------
    renderer : a scene of such surfaces.
    s4a.show.charts.surfaces : still pictures.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import threejs
    >>> mesh = s4a.synthetic.sphere(100)
    >>> ball = threejs.surface(mesh, mesh["position"][:, 2], "magma")
    >>> ball.geometry.attributes["color"].array.shape
    (100, 3)
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    X, T = as_arrays(mesh)
    n_wrong = (~np.isfinite(X)).any(1).sum()
    if n_wrong:
        raise ValueError(
            f"finite positions needed, found {n_wrong} vertices that are not; "
            "s4a.clean repairs the mesh"
        )
    return _body(X, T, None if field is None else _field_colors(mesh, field, cmap, limits))


def _field_colors(mesh, field, cmap, limits):
    """Return colours (n, 3) of the `field` argument of a mesh."""
    if isinstance(field, str):
        if field not in mesh:
            raise ValueError(
                f"a variable of the mesh needed, found {field!r}; it has {', '.join(mesh)}"
            )
        field = mesh[field]
    n = mesh.sizes["vertex"]
    values = check_rows("field", field, (n,), (n, 3))
    if values.ndim == 2:
        return np.where(np.isfinite(values), np.clip(values, 0, 1), draw.UNKNOWN)
    if values.dtype.kind in "iub":
        return draw.label_colors(values.astype(int))
    return field_colors(values, cmap, limits)


def field_colors(
    values: Array, cmap: str | Colormap | None = None, limits: tuple[float, float] | None = None
) -> Array:
    """Return colours ``(n, 3)`` of numbers ``(n,)``; see :func:`surface`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.threejs import field_colors
    >>> field_colors(np.array([0.0, 0.5, 1.0]), "gray").round().tolist()
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    values = np.where(np.isfinite(values), values, np.nan)
    known = values[~np.isnan(values)]
    low, high = np.quantile(known, (0.01, 0.99)) if len(known) else (0.0, 1.0)
    signed = low < 0 < high
    if limits is not None:
        low, high = limits
    elif signed:
        low, high = -max(-low, high), max(-low, high)
    colors = draw.ramp_colors(values, low, high, cmap or (SIGNED if signed else "viridis"))
    return np.where(np.isnan(colors), draw.UNKNOWN, colors)


def _geometry(X, T, **attributes):
    """Return a geometry with vertices, triangles and vertex attributes, except those of None."""
    known = {"position": X, "normal": vertex_normals(X, T)} | attributes
    arrays = {k: np.ascontiguousarray(v, np.float32) for k, v in known.items() if v is not None}
    index = np.asarray(T, np.uint32).ravel()
    return three.BufferGeometry(
        attributes={k: three.BufferAttribute(v, normalized=False) for k, v in arrays.items()},
        index=three.BufferAttribute(index, normalized=False),
    )


def _body(X, T, colors=None, **options):
    """Return a two-sided matte surface in the vertices' colours, by default that of clay."""
    color = {"color": to_hex(CLAY)} if colors is None else {"vertexColors": "VertexColors"}
    material = three.MeshStandardMaterial(roughness=0.7, metalness=0.05, side="DoubleSide", **color)
    return three.Mesh(_geometry(X, T, color=colors), material, **options)


# ---- modes


class Scores(anywidget.AnyWidget):
    """Sliders for the scores of :func:`modes`; the kernel gets a score when one is released."""

    _esm = SCRIPTS / "scores.js"
    _css = SCRIPTS / "scores.css"
    mesh = traitlets.Instance(three.Mesh).tag(sync=True, **widget_serialization)


class ModesMesh(three.Mesh):
    """A pythreejs mesh deformed along modes of variation by a shader; made by :func:`modes`.

    Attributes
    ----------
    scores : list of float
        Score of each mode of variation, in standard deviations; the shape follows them.
    sliders : Scores
        A slider for each mode; they deform the shape without the kernel.
    """

    scores = traitlets.List(traitlets.Float()).tag(sync=True)

    def __init__(self, geometry, material, **more):
        super().__init__(geometry, material, **more)
        self.sliders = Scores(mesh=self)

    @traitlets.validate("scores")
    def _check_scores(self, proposal):
        n = int(self.material.defines["MODES"])
        if len(proposal["value"]) != n:
            raise traitlets.TraitError(f"{n} scores needed, found {len(proposal['value'])}")
        return proposal["value"]


def modes(
    study: xr.DataTree, *, n_modes: int | None = 10, resolution: str = "full", colored: bool = True
) -> ModesMesh:
    """Return the mean shape of a study, deformed in the browser by its scores (6.1).

    A shader computes X + sum_k score_k mode_k.  The modes of variation are sent once, and sliders
    need no message to the kernel.  Normals are exact to first order.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.
    n_modes : int, optional
        Largest number of modes of variation; None for all.
    resolution : {"full", "coarse"}
        Resolution of the template.
    colored : bool
        If True, colours show the displacement along the mean's normals: blue for expansion, red
        for compression.

    Returns
    -------
    ModesMesh
        A pythreejs Mesh with ``scores``, and ``sliders`` to display with its scene.
        ``ipywidgets.jsdlink((panel.view, "scores"), (mesh, "scores"))`` links it in the browser
        to a :class:`s4a.widgets.Modes` with as many modes.  A pythreejs Picker picks points of
        the mean shape.

    Raises
    ------
    ValueError
        If the study has no modes of variation, or they do not fit into a texture.

    See Also
    --------
    s4a.widgets.Modes : the panel.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import threejs
    >>> mesh = threejs.modes(s4a.synthetic.example_study())
    >>> mesh.scores = [2.0, *mesh.scores[1:]]
    >>> view = threejs.renderer(mesh)  # in a notebook, display(view, mesh.sliders)
    """
    if not (has(study, "registration/position") and has(study, "pca/deformation")):
        raise ValueError("a study with /registration and /pca needed; run s4a.analyse")
    check_choice("resolution", resolution, ("full", "coarse"))
    coarse = template_coarse(study) if resolution == "coarse" else None
    if resolution == "coarse" and coarse is None:
        raise ValueError("the study has no low resolution of its template; use resolution='full'")
    mean, T, deformation = mode_arrays(study, coarse, n_modes)
    table, bends = mode_table(mean, T, deformation)
    limit, _ = mode_limits(study)
    hues = dict(zip(HUES, map(to_hex, SIGNED(np.linspace(0, 1, len(HUES)))), strict=True))
    slots = -(-len(deformation) // 5) * 5  # pythreejs takes lists of 2, 3, 4, 9 and 16 for vectors
    uniforms = hues | {
        "size": [WIDTH, len(table)],
        "scores": [0.0] * slots,
        "bends": [*bends.tolist(), *[0.0] * (slots - len(bends))],
        "limit": limit,
        "colored": float(colored),
        "diffuse": to_hex(CLAY),
        "specular": "#111111",
        "emissive": "#000000",
        "shininess": 30.0,
        "opacity": 1.0,
        # pythreejs gives its textures, whatever their names, to the last uniform
        "table": three.DataTexture(table, format="RGBAFormat", type="FloatType"),
    }
    material = three.ShaderMaterial(
        uniforms={name: {"value": None} for name in LIGHTS}
        | {name: {"value": value} for name, value in uniforms.items()},
        vertexShader=(SCRIPTS / "modes.vert").read_text(encoding="utf-8"),
        fragmentShader=(SCRIPTS / "modes.frag").read_text(encoding="utf-8"),
        defines={"MODES": str(len(deformation)), "SLOTS": str(slots)},
        lights=True,
        side="DoubleSide",
    )
    geometry = _geometry(mean, T, row=np.arange(len(mean)))
    return ModesMesh(geometry, material, scores=[0.0] * len(deformation), frustumCulled=False)


def mode_table(mean: Array, T: Array, deformation: Array) -> tuple[Array, Array]:
    """Return a texture (rows, 2048, 4) of displacements and normal changes, and `bends` (c,).

    The change of a normal is the derivative of the sum of triangle normals by the score, relative
    to the length of that sum.  It is quantised in 127 steps of both signs up to `bends`.
    """
    c, n = deformation.shape[:2]
    rows = -(-n * c // WIDTH)
    if rows > HEIGHT:
        raise ValueError(
            f"at most {WIDTH * HEIGHT // n} modes of {n} vertices fit into a texture, found {c}; "
            "give n_modes, or resolution='coarse'"
        )
    area = np.linalg.norm(normal_sums(mean, T), axis=1)[:, None]
    area = np.maximum(area, np.finfo(float).tiny)
    table = np.zeros((rows * WIDTH, 4), np.float32)
    bends = np.empty(c)
    for k, step in enumerate(deformation):
        change = normal_sums(mean + step, T) - normal_sums(mean - step, T)  # exact: quadratic
        change /= 2 * area
        bends[k] = np.quantile(np.abs(change).max(1), 0.999) or 1.0
        levels = np.clip(np.round(127 * change / bends[k]), -127, 127) + 127  # 0 .. 254
        table[k : n * c : c, :3] = step
        table[k : n * c : c, 3] = levels @ [1, 256, 65536]
    return table.reshape(rows, WIDTH, 4), bends


# ---- points, correspondences, networks


def points(
    positions: xr.Dataset | Mapping[str, Array] | Array,
    color: str = LANDMARK,
    *,
    radius: float | None = None,
    names: bool = True,
) -> three.Group:
    """Return landmarks as spheres with their names.

    Parameters
    ----------
    positions : Dataset, dict of str to (3,), or ndarray (p, 3)
        A Dataset has ``landmark_position(landmark, xyz)`` and optionally ``landmark_name``.
    color : str
        Matplotlib colour of all spheres.
    radius : float, optional
        In the unit of the positions; by default 1/50 of the diagonal of their bounding box.
    names : bool
        If True, the names are shown next to the spheres.

    Returns
    -------
    pythreejs.Group

    Examples
    --------
    >>> from s4a.widgets import threejs
    >>> [part.name for part in threejs.points({"nose": [0, -1, 0], "chin": [0, -1, -1]}).children]
    ['nose', 'chin']
    """
    labels: list[str] = []
    if isinstance(positions, xr.Dataset):
        require(positions, "landmark_position", what="dataset")
        if "landmark_name" in positions:
            labels = positions["landmark_name"].values.astype(str).tolist()
        positions = positions["landmark_position"].values
    elif isinstance(positions, Mapping):
        labels, positions = list(positions), np.array(list(positions.values()))
    X = np.asarray(positions, float)
    labels = labels or [""] * len(X)
    if X.ndim != 2 or X.shape[1] != 3 or not len(X) or not np.isfinite(X).all():
        raise ValueError(f"finite points (p, 3) needed, found an array of shape {X.shape}")
    size = radius or float(np.linalg.norm(np.ptp(X, axis=0))) / 50 or 1.0
    ball = three.SphereBufferGeometry(radius=size, widthSegments=20, heightSegments=14)
    material = three.MeshStandardMaterial(color=to_hex(color), roughness=0.5)
    group, middle = three.Group(), X.mean(0)
    for name, x in zip(labels, X, strict=True):
        group.add(three.Mesh(ball, material, position=x.tolist(), name=name))
        if names and name:
            outwards = (x - middle) / (np.linalg.norm(x - middle) or 1.0)
            group.children[-1].add(_name(name, 3.5 * size * outwards, 2.4 * size))
    return group


def _name(text, position, height, *, hidden=True):
    """Return a text that faces the viewer; where not `hidden`, it is drawn over all surfaces."""
    letters = three.TextTexture(
        string=text, color="black", size=64, fontFace="monospace", squareTexture=False
    )
    material = three.SpriteMaterial(map=letters, transparent=True, depthTest=hidden)
    width = 0.6 * height * len(text)  # of a monospaced font
    return three.Sprite(material, position=np.asarray(position).tolist(), scale=[width, height, 1])


def correspondence(
    pair: xr.Dataset | xr.DataTree | Array,
    source: xr.Dataset | str,
    target: xr.Dataset | str,
    *,
    n_lines: int = 60,
) -> three.Group:
    """Return two surfaces side by side in matching colours, with lines between sampled matches.

    Parameters
    ----------
    pair : xarray.Dataset, xarray.DataTree or int ndarray (vertex,)
        Result of :func:`s4a.match_pair`, or its ``match(vertex)``: a vertex of the source for each
        vertex of the target; or a study, whose latent basis matches two of its shapes (eq. 3).
    source, target : xarray.Dataset or str
        The meshes of the pair, or the names of two shapes of the study.
    n_lines : int
        Number of matches that are drawn, farthest-point samples of the target.

    Returns
    -------
    pythreejs.Group
        Its children are the source, the shifted target, and the lines.

    Raises
    ------
    ValueError
        If the match does not belong to these meshes.

    See Also
    --------
    s4a.widgets.Correspondence : the panel.

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
            check_choice("shape", name, pair["coarse"].children)
        match = latent_match(pair, source, target, full=False)["match"].values
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
    colors = draw.position_colors(X)
    sample = farthest_points(Y, min(n_lines, len(Y)))
    segments = _segments(X[match[sample]], Y[sample], colors[match[sample]])
    points = np.concatenate([X, Y])
    return three.Group(
        # around the origin, where pythreejs looks initially, whatever the target of its controls
        position=(-(points.max(0) + points.min(0)) / 2).tolist(),
        children=[_body(X, S, colors), _body(Y, T, colors[match]), segments],
    )


def _segments(begin, end, colors, width=2):
    """Return line segments between points (p, 3), each of one colour."""
    geometry = three.LineSegmentsGeometry(
        positions=np.stack([begin, end], axis=1).astype(np.float32),
        colors=np.stack([colors, colors], axis=1).astype(np.float32),
    )
    material = three.LineMaterial(linewidth=width, vertexColors="VertexColors")
    return three.LineSegments2(geometry, material)


def network(study: xr.DataTree, *, names: bool = True) -> three.Group:
    """Return the network of maps (3.4), with nodes placed by their shape differences (3.5).

    Parameters
    ----------
    study : xarray.DataTree
        With ``/coarse``, ``/network`` and ``/latent``.
    names : bool
        If True, the names are shown above the shapes.

    Returns
    -------
    pythreejs.Group
        A surface for each node, the names, and finally the edges, coloured by the mean cycle error
        of the two maps of a pair as in the panel.  ``bar`` is the colour bar, which
        :func:`renderer` shows.

    Raises
    ------
    ValueError
        If the study has no network or no shape differences.

    See Also
    --------
    s4a.widgets.Network : the panel.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import threejs
    >>> group = threejs.network(s4a.synthetic.example_study(), names=False)
    >>> type(group.children[-1]).__name__
    'LineSegments2'
    """
    needed = "network/cycle_error", "latent/area_score", "coarse"
    missing = [name for name in needed if not has(study, name)]
    if missing:
        raise ValueError(f"a study with {', '.join(missing)} needed; run s4a.analyse")
    scores = study["latent"].dataset["area_score"]
    shapes = names_of(scores)
    surfaces = {name: study_surface(study, name) for name in shapes}
    size = max(np.ptp(X, axis=0).max() for X, _ in surfaces.values())
    positions = np.zeros((len(shapes), 3))
    known = scores.values[:, :3]
    positions[:, : known.shape[1]] = known
    # a tenth of the distances may be smaller than 1.3 times the extent of the shapes
    positions *= 1.3 * size / max(np.quantile(pdist(positions), 0.1), np.finfo(float).tiny)
    group = three.Group()
    for position, (name, (X, T)) in zip(positions, surfaces.items(), strict=True):
        centred = X - (X.max(0) + X.min(0)) / 2
        body = _body(centred, T, position=position.tolist(), name=name)
        if names:
            body.add(_name(name, [0, 0, 0.7 * size], 0.15 * size, hidden=False))
        group.add(body)
    maps, limits = study["network"].dataset, network_limits(study)
    shape_of = [[shapes.index(name) for name in maps[key].values] for key in ("source", "target")]
    ends, pair = np.unique(np.sort(shape_of, axis=0), axis=1, return_inverse=True)
    error = maps["cycle_error"].to_series().groupby(pair.ravel()).mean()
    colors = draw.cycle_error_colors(error.to_numpy(), limits)
    group.add(_segments(positions[ends[0]], positions[ends[1]], colors, width=3))
    group.bar = color_scale(draw.CYCLE_ERROR, *limits, "cycle error (logarithmic)")
    return group


def _color_bar(bar):
    """Return a colour bar of width 1 (:func:`s4a.show.browser.color_scale`), drawn over all."""
    colors = np.array([to_rgb(color) for color in bar["colors"]])
    known, shares = np.linspace(0, 1, len(colors)), np.linspace(0, 1, 256)
    texels = np.full((1, 256, 4), 255, np.uint8)
    texels[0, :, :3] = np.transpose([255 * np.interp(shares, known, c) for c in colors.T])
    texture = three.DataTexture(texels)
    strip = three.SpriteMaterial(map=texture, transparent=True, depthTest=False)
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
    """Return a pythreejs renderer of objects, lit from the viewer, with controls of the camera.

    Parameters
    ----------
    *objects : pythreejs.Object3D
        Objects made by this module or by other code; the camera sees all of them.  Their colour
        bar is at the lower edge.
    size : (int, int)
        Width and height in pixels.
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.

    Returns
    -------
    pythreejs.Renderer
        Its ``scene`` takes more: ``view.scene.add(pythreejs.AxesHelper(50))``.
    """
    corners = np.concatenate([np.empty((0, 3)), *map(_corners, objects)])
    if not len(corners):
        raise ValueError("a renderer needs at least one object with vertices, found none")
    low, high = corners.min(0), corners.max(0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    aspect, fov = size[0] / size[1], 40
    half = np.deg2rad(fov) / 2
    R = draw.rotation(view, up)
    # round objects have room to rotate; long ones fill the picture in the initial view
    around = 0.85 * radius / np.sin(min(half, np.arctan(aspect * np.tan(half))))
    box = np.array([corner for corner in np.ndindex(3, 3, 3) if corner != (1, 1, 1)]) - 1
    ellipsoid = box / np.linalg.norm(box, axis=1, keepdims=True)
    nearest = []  # distances from which the inscribed ellipsoid, and the whole box, are visible
    for points in (ellipsoid, box):
        x, y, z = R @ (points * (high - low) / 2).T
        nearest.append(float((z + np.maximum(np.abs(x) / aspect, np.abs(y)) / np.tan(half)).max()))
    distance = min(max(around, 1.05 * nearest[0]), 1.05 * nearest[1])
    bars = [item.bar for item in objects if hasattr(item, "bar")]
    distance *= 1.2 if bars else 1  # room for the bars below
    camera = three.PerspectiveCamera(
        position=(middle + distance * R[2]).tolist(),
        up=np.eye(3)["xyz".index(up)].tolist(),
        fov=fov,
        aspect=aspect,
        near=radius / 100,
        far=radius * 20,
        children=[three.DirectionalLight(position=[0, 0, 1], intensity=0.55)],
    )
    for bar in bars:
        group, depth = _color_bar(bar), radius / 20  # near the camera, with which it moves
        bottom = depth * np.tan(half)
        width = 1.2 * min(aspect, 2) * bottom
        group.scale = [width] * 3
        group.position = [0, 0.08 * width - bottom, -depth]
        camera.add(group)
    camera.lookAt(middle.tolist())
    controls = three.OrbitControls(controlling=camera, target=middle.tolist())
    scene = three.Scene(
        children=[*objects, camera, three.AmbientLight(intensity=0.4)], background="#ffffff"
    )
    width, height = size
    return three.Renderer(
        scene=scene, camera=camera, controls=[controls], width=width, height=height, antialias=True
    )


def _corners(item):
    """Return the corners ``(p, 3)`` of the bounding boxes of an object and its children."""
    geometry, X = getattr(item, "geometry", None), np.empty((0, 3))
    if isinstance(geometry, three.BufferGeometry) and "position" in geometry.attributes:
        X = geometry.attributes["position"].array
    elif isinstance(geometry, three.LineSegmentsGeometry):
        X = geometry.positions.reshape(-1, 3)
    elif hasattr(geometry, "radius"):
        X = np.array([[-geometry.radius], [geometry.radius]]) * np.ones(3)
    if len(X):
        X = np.stack(np.meshgrid(*zip(X.min(0), X.max(0), strict=True)), -1).reshape(-1, 3)
    X = np.concatenate([X, *map(_corners, getattr(item, "children", ()))])
    return X * item.scale @ Rotation.from_quat(item.quaternion).as_matrix().T + item.position
