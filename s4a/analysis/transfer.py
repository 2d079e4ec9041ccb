"""Transfer of labels, landmarks and scalar fields along a registration (6.2, 4.3; Fig. 6 and 7).

Routes go from the template to a shape, from a shape through the template to another, or from an
external mesh to the template of a study and on to every shape.  A route is a list of links between
a template and a shape, with their directions:

    source shape --up--> template --down--> target shape

Down a link every vertex of the shape takes the values at the closest point of the deformed
template; up, every vertex of the template takes those at the closest point of the shape.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import xarray as xr
from joblib import delayed
from scipy.sparse.linalg import cg
from threadpoolctl import threadpool_limits

from s4a.analysis.inputs import all_registered
from s4a.geometry.closest import (
    closest_facing_point,
    closest_point,
    interpolate,
    interpolation_matrix,
)
from s4a.geometry.mesh import as_arrays, stiffness, vertex_areas, vertex_normals
from s4a.input.collection import Mesh, as_mesh
from s4a.input.landmarks import FARTHEST_LANDMARK, NAMED, as_landmarks, locate, trace_curves
from s4a.method.register import identity, uncertainty
from s4a.method.remesh import laplacian
from s4a.method.shape import Shape
from s4a.options import Options, given_options
from s4a.schema import check_type, dataset, require
from s4a.study.pair import match_shapes, shape_of
from s4a.study.processes import workers
from s4a.study.tree import stack_registration, template_mesh

# how far votes for labels count, by what the study leaves out
BLURS = {None: 1.0, "fast": 1.0, "paper": 0.0}


# Triangle (p,) and barycentric weights (p, 3) of points on a surface, and how sure they are (p,).
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Link:
    """One registration: a template ``X, T``, a shape ``Y, S``, and where one is on the other.

    ``image (n, 3)`` is the registered template in the shape's frame, ``confidence (n,)`` that of
    its vertices; ``triangle (p,)`` and ``weights (p, 3)`` are the places of the shape's vertices on
    the template.
    """

    X: np.ndarray
    T: np.ndarray
    Y: np.ndarray
    S: np.ndarray
    image: np.ndarray
    confidence: np.ndarray
    triangle: np.ndarray
    weights: np.ndarray

    @cached_property
    def down(self) -> tuple[sp.csr_matrix, np.ndarray]:
        """Matrix ``(p, n)`` of values from template to shape, and confidence on the shape."""
        W = interpolation_matrix(self.T, self.triangle, self.weights, len(self.X))
        return W, W @ self.confidence

    @cached_property
    def up(self) -> tuple[sp.csr_matrix, np.ndarray]:
        """Matrix ``(n, p)`` of values from shape to template, and confidence on the template."""
        normals = vertex_normals(self.image, self.T)
        place = closest_facing_point(self.image, normals, self.Y, self.S)
        return interpolation_matrix(self.S, *place, len(self.Y)), self.confidence

    def transfer_down(self, triangle: np.ndarray, weights: np.ndarray) -> Places:
        """Places on the shape of points on the template."""
        place = (self.T, triangle, weights)
        P = interpolate(self.image, *place)
        N = interpolate(vertex_normals(self.image, self.T), *place)
        confidence = interpolate(self.confidence[:, None], *place)[:, 0]
        return *closest_facing_point(P, N, self.Y, self.S), confidence

    def transfer_up(self, triangle: np.ndarray, weights: np.ndarray) -> Places:
        """Places on the template of points on the shape."""
        P = interpolate(self.Y, self.S, triangle, weights)
        N = interpolate(vertex_normals(self.Y, self.S), self.S, triangle, weights)
        place = closest_facing_point(P, N, self.image, self.T)
        return *place, interpolate(self.confidence[:, None], self.T, *place)[:, 0]


Route = list[tuple[Link, str]]  # ends with "down" or "up"


def image_in_shape(X: np.ndarray, registered: xr.Dataset) -> np.ndarray:
    """Positions ``(n, 3)`` of the registered template where the file of the shape has the shape.

    `registered` is the shape's part of ``/registration``, x -> s R x + t its way to the template.
    """
    R, t, s = (registered[name].values for name in ("rotation", "translation", "scale"))
    return (X + registered["displacement"].values - t) @ R / s


def link(template: xr.Dataset, shape: xr.Dataset, registered: xr.Dataset) -> Link:
    """The :class:`Link` of two meshes, by the shape's part of ``/registration``."""
    X, T = as_arrays(template)
    Y, S = as_arrays(shape)
    names = ("confidence", "template_triangle", "template_barycentric")
    return Link(X, T, Y, S, image_in_shape(X, registered), *(registered[n].values for n in names))


def matrix_along(route: Route, n: int) -> tuple[sp.csr_matrix, np.ndarray]:
    """Matrix and confidence of a route.

    The matrix goes from values on its first mesh, of n vertices, to those on its last, where the
    confidence is.
    """
    if not route:
        return sp.identity(n, format="csr"), np.ones(n)
    steps = [getattr(step, way) for step, way in route]
    W, confidence = steps[0]
    for V, own in steps[1:]:
        W = V @ W
        confidence = own * (V @ confidence)
    return W, confidence


def transfer_along(route: Route, triangle: np.ndarray, weights: np.ndarray) -> Places:
    """Places on the last mesh of points on the first."""
    confidence = np.ones(len(triangle))
    for step, way in route:
        triangle, weights, own = getattr(step, f"transfer_{way}")(triangle, weights)
        confidence = confidence * own
    return triangle, weights, confidence


def blend_routes(routes: list[Route], n: int) -> tuple[sp.csr_matrix, np.ndarray]:
    """The mean of several routes, weighted by their confidence at every vertex.

    Matrix ``(p, n)``, and mean confidence ``(p,)``.
    """
    matrices, confidences = zip(*(matrix_along(route, n) for route in routes), strict=True)
    weight = np.stack(confidences) + 1e-9  # (routes, p), no zero in the sum below
    weight /= weight.sum(0)
    W = sum(sp.diags(w) @ V for w, V in zip(weight, matrices, strict=True))
    return W.tocsr(), np.mean(confidences, axis=0)


def votes_of(W: sp.csr_matrix, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Votes of the source's vertices for every label at every target vertex.

    Parameters
    ----------
    W : sparse matrix (p, n)
        Rows sum to 1.
    label : ndarray (n,)

    Returns
    -------
    vote : float32 ndarray (p, l)
    value : ndarray (l,), the labels, sorted
    """
    value, code = np.unique(label, return_inverse=True)
    one_hot = sp.csr_matrix((np.ones(len(code), np.float32), code, np.arange(len(code) + 1)))
    return (W @ one_hot).toarray().astype(np.float32), value


def spread_votes(vote: np.ndarray, X: np.ndarray, T: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Votes after a short step of heat: (A + W) v = A v0, W stiffness with t = area radius^2 / 4.

    What votes at a vertex votes around it, too, as far as its match may be wrong; A has the areas
    of the vertices.  The kernel of one implicit step has a mean squared radius of 4 t in the plane.

    Parameters
    ----------
    vote : float32 ndarray (p, l)
    X, T : ndarray (p, 3), (q, 3)
        The target.
    radius : ndarray (p,)
        Root of the mean squared radius, as a share of sqrt(area).

    Returns
    -------
    float32 ndarray (p, l)
        Rows sum to 1.
    """
    E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
    t = area.sum() * radius**2 / 4
    # edges between obtuse corners, whose weights are negative, would make votes so
    W = stiffness(E, np.maximum(w, 0) * t[E].mean(axis=1), len(X))
    system = sp.diags(area) + W  # (p, p), positive definite
    jacobi = sp.diags(1 / system.diagonal())
    spread = vote.copy()
    for column in spread.T:
        v = column.astype(float)
        column[:] = cg(system, area * v, x0=v, rtol=1e-5, M=jacobi)[0]
    np.clip(spread, 0, 1, out=spread)  # as conjugate gradients are exact to 1e-5
    spread /= spread.sum(axis=1, keepdims=True)
    return spread


def elect(vote: np.ndarray, value: np.ndarray) -> np.ndarray:
    """The label with most votes at every vertex; the first in sorted order among equals.

    Examples
    --------
    >>> import numpy as np
    >>> import scipy.sparse as sp
    >>> from s4a.analysis.transfer import elect, votes_of
    >>> elect(*votes_of(sp.csr_matrix([[0.5, 0.2, 0.3]]), np.array([4, 7, 7]))).tolist()
    [4]
    """
    return value[vote.round(6).argmax(1)]  # equal votes are equal to six digits


def pair_study(result: xr.Dataset, source: xr.Dataset, target: xr.Dataset) -> xr.DataTree:
    """The result of :func:`s4a.match_pair` as a study of ``source`` and ``target``, the template.

    Parameters
    ----------
    result, source, target : Dataset
        The result, and the meshes it was made of.

    Returns
    -------
    DataTree
        ``/original``, ``/registration``: what the functions of this module take.
    """
    registered = result.rename(match="registered_match")
    return _study_of("target", target, {"source": source}, {"source": registered}, {})


def _study_of(name, template, shapes, forth, back):
    """A registered study; `forth` has the registrations of the shapes, `back` of the template."""
    meshes = {name: template, **shapes}
    nodes = {f"original/{n}": mesh for n, mesh in meshes.items()}
    files = {name: identity(Shape(template)), **forth}
    nodes |= stack_registration(template_mesh(template, name), files, list(meshes))
    return xr.DataTree.from_dict(nodes | {f"reverse/{n}": data for n, data in back.items()})


def _shape_of(mesh, options):
    """The shape of a mesh, with its low resolution and spectrum."""
    with threadpool_limits(1):
        return shape_of(mesh, options)


def _match_both(shape, template, options):
    """The shape registered to the template and, with `bidirectional`, the template to the shape."""
    with threadpool_limits(1):
        forth = match_shapes(shape, template, options)[0]
        return forth, match_shapes(template, shape, options)[0] if options.bidirectional else None


def register_pairs(
    template: Mesh,
    shapes: dict[str, Mesh],
    *,
    name: str = "template",
    n_jobs: int | None = None,
    preset: str | None = None,
    **options: Any,
) -> xr.DataTree:
    """The template registered to each shape on its own (6.2, the first way): a study for transfer.

    Parameters
    ----------
    template : path or Dataset
        Mesh file, or clean mesh, such as :func:`s4a.read_shape` returns.
    shapes : dict of str to path or Dataset
    name : str
        Of the template among the shapes.
    n_jobs : int, optional
        As in joblib; the result does not depend on it.
    preset : {None, "paper", "fast"}
        As of :func:`s4a.match_pair`; ``"paper"`` sets bidirectional=False, too, and blur=0 of
        :func:`s4a.transfer_labels`.
    **options
        Those of :func:`s4a.match_pair`, and ``bidirectional``: whether each pair is matched both
        ways, as by default; transfer then takes the mean of both.  See :class:`s4a.Options`.

    Returns
    -------
    DataTree
        ``/original``, ``/registration`` and, with `bidirectional`, ``/reverse``.

    Raises
    ------
    ValueError
        When a shape has the name of the template, a mesh lacks its variables, or an option is
        outside its range or contradicts the preset.

    Examples
    --------
    >>> import s4a
    >>> brains = s4a.synthetic.brains(6, 200)
    >>> source = brains["original/brain_01"].to_dataset()
    >>> target = brains["original/brain_02"].to_dataset()
    >>> pairs = s4a.register_pairs(source, {"brain_02": target}, n_coarse=100, k_init=6, k=10)
    >>> s4a.transfer_labels(pairs, source["label"].values)["brain_02"]["label"].sizes["vertex"]
    200
    """
    check_type(shapes, dict, "shapes")
    if name in shapes or not shapes:
        raise ValueError(
            f"shapes other than the template, {name!r}, needed; found {', '.join(shapes) or 'none'}"
        )
    meshes = {n: as_mesh(mesh, f"mesh {n}") for n, mesh in {name: template, **shapes}.items()}
    settings = given_options({"preset": preset, **options}, pair=True)
    parallel = workers(n_jobs)
    inside, *others = parallel(delayed(_shape_of)(mesh, settings) for mesh in meshes.values())
    pairs = parallel(delayed(_match_both)(shape, inside, settings) for shape in others)
    forth = {n: pair[0] for n, pair in zip(shapes, pairs, strict=True)}
    back = (
        {n: pair[1] for n, pair in zip(shapes, pairs, strict=True)}
        if settings.bidirectional
        else {}
    )
    study = _study_of(name, meshes.pop(name), meshes, forth, back)
    study["registration"].attrs["preset"] = settings.preset or ""
    return study


def _preset(study: xr.DataTree, given: dict[str, Any]) -> str | None:
    """The preset of a transfer: the given one, else that of the study or of its pairs."""
    if "preset" in given:
        return given["preset"]
    if "report" in study.children:
        return Options.from_report(study).preset
    return study["registration"].attrs.get("preset") or None


def _routes(study: xr.DataTree, name: str) -> tuple[list[Route], list[Route]]:
    """Routes from the template down to a shape, and from the shape up to it.

    One each way, or two where the pair was matched both ways.
    """
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    if name == template:
        return [[]], [[]]
    mesh = study["original"][template].to_dataset()
    shape = study["original"][name].to_dataset()
    places = study["registration"].children[name].to_dataset(inherit=False)
    forth = link(mesh, shape, registration.sel(shape=name).merge(places))
    down: list[Route] = [[(forth, "down")]]
    up: list[Route] = [[(forth, "up")]]
    if "reverse" in study.children and name in study["reverse"].children:
        back = link(shape, mesh, study["reverse"][name].to_dataset())
        down.append([(back, "up")])
        up.append([(back, "down")])
    return down, up


def _routes_from_outside(
    study: xr.DataTree, mesh: xr.Dataset, given: dict[str, Any]
) -> list[Route]:
    """Routes from an external mesh to the study's template, by its options and those given."""
    name = study["registration"].attrs["template"]
    if "coarse" not in study.children:
        raise ValueError(
            f"a source that is none of the shapes is matched to the template {name!r}, which needs "
            "/coarse; this study of pairs has none: give one of its shapes"
        )
    template = study["original"][name].to_dataset().load()
    own = Options.from_report(study)
    options = given_options(given, own, pair=True)
    if options.of("low resolution") == own.of("low resolution"):
        inside = Shape(
            template, study["coarse"][name].to_dataset().load(), **options.of("projection")
        )
    else:
        inside = _shape_of(template, options)
    outside = _shape_of(mesh, options)
    forth, back = _match_both(inside, outside, options)
    routes: list[Route] = [[(link(mesh, template, forth), "down")]]
    if back is not None:
        routes.append([(link(template, mesh, back), "up")])
    return routes


Targets = Iterator[tuple[str, xr.Dataset, list[Route]]]


def plan(
    study: xr.DataTree,
    source: str | xr.Dataset | None,
    targets: list[str] | None,
    options: dict[str, Any] | None = None,
) -> tuple[xr.Dataset, Targets]:
    """The mesh where the transfer begins, and an iterator of (target, its mesh, routes to it).

    Parameters
    ----------
    study, source, targets : see :func:`transfer_labels`
    options : dict, optional
        Of a pair, by which an external source is matched, beside those of the study.

    Raises
    ------
    ValueError
        When the study has no registration, a shape is not in it, or there are options and nothing
        is matched.
    """
    registration = all_registered(study)
    template = registration.attrs["template"]
    names = registration["shape"].values.tolist()
    source = template if source is None else source
    external = isinstance(source, xr.Dataset)
    targets = [n for n in names if external or n != source] if targets is None else list(targets)
    asked = targets if external or source == template else [*targets, source]
    wrong = [n for n in asked if n not in names]
    if wrong:
        raise ValueError(
            f"no shape {', '.join(map(repr, wrong))} in the study; it has {', '.join(names)}"
        )
    if isinstance(source, xr.Dataset):
        require(source, "position", "corner_vertex", what="source")
        mesh, first = source, _routes_from_outside(study, source, options or {})
    elif options:
        raise ValueError(
            f"options {', '.join(options)} need a source that is none of the shapes, which is "
            f"matched to the template; found the shape {source!r}, which is registered: leave "
            "them out"
        )
    else:
        mesh, first = study["original"][source].to_dataset(), _routes(study, source)[1]

    def each():
        for name in targets:
            last, _ = _routes(study, name)
            yield name, study["original"][name].to_dataset(), [a + b for a in first for b in last]

    return mesh, each()


def transfer_labels(
    study: xr.DataTree,
    label: np.ndarray,
    *,
    source: str | xr.Dataset | None = None,
    targets: list[str] | None = None,
    votes: bool = False,
    blur: float | None = None,
    **options: Any,
) -> xr.DataTree:
    """Labels of one mesh on every shape of a registered study (6.2, Fig. 6).

    Parameters
    ----------
    study : DataTree
        A finished study, or what :func:`register_pairs` or :func:`pair_study` gives.
    label : array_like (vertex,)
        Of the vertices of the source in ``/original`` (see
        :func:`s4a.input.annotations.labels_of_mesh`); numbers or names.
    source : str or Dataset, optional
        A shape of the study, by default its template; or an external mesh, which is matched to the
        template first (template -> median -> every shape), by the options of the study.
    targets : list of str, optional
        All other shapes by default.
    votes : bool
        Whether the share of every label is given too.
    blur : float, optional
        How far votes count around the place where they fall, in multiples of how far the match may
        be wrong there by its confidence (:func:`s4a.method.register.uncertainty`): where it is
        sure, borders between labels stay where they fall, elsewhere they come out smooth.  A label
        that would win nowhere for it keeps the vertices that it has without.  With 0, as in the
        paper, votes count where they fall.  By default 1, and 0 where the study, or the source that
        is matched to it, has ``preset="paper"``.
    **options
        Of an external source alone: those of :func:`register_pairs`, ``preset`` among them, in the
        place of the study's.

    Returns
    -------
    DataTree
        For every target ``label(vertex)``, the label with most votes among the corners of the
        triangle that each vertex comes to lie on, and those around; ``label_share(vertex)``, its
        share of the votes;
        ``confidence(vertex)`` of the match; and with `votes` ``label_vote(vertex, label_value)``.

    Raises
    ------
    ValueError
        When the labels do not fit the source, a shape is not in the study, the blur is below 0 or
        above 10, or an option is given where nothing is matched, is outside its range or
        contradicts the preset.

    Examples
    --------
    With the ``study`` of six small brains, where the labels of every brain are known:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> label, true = (study[f"original/{name}/label"].values for name in ("brain_01", "brain_02"))
    >>> carried = s4a.transfer_labels(study, label, source="brain_01", targets=["brain_02"])
    >>> bool((carried["brain_02/label"].values == true).mean() > 0.5)
    True

    Labels of one brain on another, in colours:

    >>> brains = s4a.synthetic.brains(2, 3000)["original"]
    >>> source, target = (mesh.to_dataset() for mesh in brains.children.values())
    >>> pairs = s4a.register_pairs(source, {"b": target}, n_coarse=600, k=40)
    >>> label = source["label"].values
    >>> found = s4a.transfer_labels(pairs, label)["b/label"].values
    >>> colors = s4a.show.draw.label_colors(np.arange(label.max() + 1))
    >>> s4a.show.charts.surfaces(
    ...     {"template": source, "carried": target},
    ...     {"template": colors[label], "carried": colors[found]},
    ...     flat=True,
    ... )
    <TiledFigure ...>
    """
    if blur is not None and not 0 <= blur <= 10:
        raise ValueError(f"blur needs a factor from 0 to 10; found {blur}")
    mesh, each = plan(study, source, targets, options)
    blur = BLURS[_preset(study, options)] if blur is None else blur
    label = _per_vertex(label, mesh, "label")
    carried = {}
    for name, target, routes in each:
        W, confidence = blend_routes(routes, len(label))
        vote, value = votes_of(W, label)
        winner = elect(vote, value)
        if blur and any(routes):  # to the source itself there is no way, nor flag
            vote = spread_votes(vote, *as_arrays(target), blur * uncertainty(confidence))
            spread = elect(vote, value)
            lost = np.setdiff1d(winner, spread)
            winner = np.where(np.isin(winner, lost), winner, spread)
        share = vote[np.arange(len(vote)), np.searchsorted(value, winner)]
        carried[name] = dataset(
            label=winner, label_share=share, confidence=confidence.astype(np.float32)
        )
        if votes:
            shares = dataset(label_vote=vote)
            carried[name] = carried[name].merge(shares).assign_coords(label_value=value)
    return xr.DataTree.from_dict(carried)


def transfer_scalars(
    study: xr.DataTree,
    field: np.ndarray,
    *,
    source: str | xr.Dataset | None = None,
    targets: list[str] | None = None,
    **options: Any,
) -> xr.DataTree:
    """A scalar field of one mesh on every shape of a registered study, linear inside triangles.

    Parameters
    ----------
    study, source, targets, **options : see :func:`transfer_labels`
    field : array_like (vertex,)
        In any unit; where it is NaN only the other corners of a triangle count.

    Returns
    -------
    DataTree
        For every target ``field(vertex)``, NaN where over half of the weight is on NaN, and
        ``confidence(vertex)``.

    Examples
    --------
    With the ``study`` of six small brains; what is constant stays so:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> carried = s4a.transfer_scalars(study, np.ones(200), targets=["brain_02"])
    >>> bool(np.allclose(carried["brain_02/field"], 1))
    True
    """
    mesh, each = plan(study, source, targets, options)
    field = _per_vertex(field, mesh, "field").astype(float)
    carried = {}
    for name, _, routes in each:
        value, confidence = _blend_field(routes, field)
        carried[name] = dataset(field=value, confidence=confidence.astype(np.float32))
    return xr.DataTree.from_dict(carried)


def on_template(study: xr.DataTree, name: str, field: np.ndarray) -> np.ndarray:
    """A scalar field of a shape ``(vertex,)`` on the vertices of the template.

    As :func:`transfer_scalars` from the shape to the template; of the template, it stays.
    """
    return _blend_field(_routes(study, name)[1], field)[0]


def _blend_field(routes, field):
    """A field at the end of routes, NaN where over half of the weight is on NaN; confidence."""
    known = np.isfinite(field).astype(float)
    W, confidence = blend_routes(routes, len(field))
    weight = W @ known  # of the corners that are not NaN
    value = W @ np.nan_to_num(field) / np.maximum(weight, 1e-12)
    value[weight < 0.5] = np.nan
    return value, confidence


def _per_vertex(values, mesh, what):
    values = np.asarray(values)
    if values.shape != (mesh.sizes["vertex"],):
        raise ValueError(
            f"{what} needs one value for each of the {mesh.sizes['vertex']} vertices of the "
            f"source, found shape {values.shape}"
        )
    return values


def transfer_landmarks(
    study: xr.DataTree,
    landmarks: xr.Dataset | Path | str,
    *,
    source: str | xr.Dataset | None = None,
    targets: list[str] | None = None,
    farthest: float = FARTHEST_LANDMARK,
    **options: Any,
) -> xr.DataTree:
    """Landmarks of one mesh on every shape of a registered study, inside triangles (6.2, Fig. 7).

    Where the landmarks have curves (``landmark_curve``, see
    :func:`s4a.input.annotations.read_landmarks`), points in between are added along the surface of
    the source, an edge's length apart, and all carried over: curves come out as polylines.

    Parameters
    ----------
    study, source, targets, **options : see :func:`transfer_labels`
    landmarks : path or Dataset
        A landmark file, or what :func:`s4a.input.annotations.read_landmarks` returns.
    farthest : float
        See :func:`s4a.input.landmarks.locate`.

    Returns
    -------
    DataTree
        For every target ``landmark_name``, ``landmark_position(landmark, xyz)`` on its surface, in
        its coordinates, ``landmark_triangle``, ``landmark_barycentric(landmark, corner)``,
        ``landmark_confidence`` and, where there are several routes, ``landmark_disagreement``, the
        largest distance of one from their mean; with curves ``landmark_curve`` and
        ``landmark_closed``, and no name for the points in between.

    Raises
    ------
    ValueError
        When a landmark is not on the source, a shape is not in the study, or an option does not
        fit, as in :func:`transfer_labels`.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> source = study["original/brain_01"].to_dataset()
    >>> landmarks = source[["landmark_name", "landmark_position"]]
    >>> carried = s4a.transfer_landmarks(study, landmarks, source="brain_01", targets=["brain_02"])
    >>> carried["brain_02/landmark_position"].dims
    ('landmark', 'xyz')

    Those of the one, and on the other where they were carried:

    >>> from s4a.show.draw import label_colors, with_balls
    >>> shown, colors = {}, {}
    >>> for name, found in (("brain_01", landmarks), ("brain_02", carried["brain_02"])):
    ...     X, T = s4a.geometry.mesh.as_arrays(study[f"original/{name}"].to_dataset())
    ...     places = found["landmark_position"].values
    ...     hues, radii = label_colors(np.arange(len(places))), np.full(len(places), 5.0)
    ...     Y, S, colors[name] = with_balls(X, T, None, np.c_[places, hues, radii].tolist())
    ...     shown[name] = s4a.geometry.mesh.as_dataset(Y, S)
    >>> s4a.show.charts.surfaces(shown, colors)
    <TiledFigure ...>
    """
    mesh, each = plan(study, source, targets, options)
    landmarks = as_landmarks(landmarks)
    marked = locate(landmarks, mesh, farthest=farthest)
    if "landmark_curve" in landmarks:
        marked = trace_curves(marked, mesh)
    named = marked[[name for name in NAMED if name in marked]]
    carried = {}
    for name, target, routes in each:
        carried[name] = _transfer_landmarks(marked, target, routes).merge(named)
    return xr.DataTree.from_dict(carried)


def _transfer_landmarks(marked, target, routes):
    """Landmarks at the mean of where the routes lead, weighted by confidence, on the surface."""
    X, T = as_arrays(target)
    start = marked["landmark_triangle"].values, marked["landmark_barycentric"].values
    ends = [transfer_along(route, *start) for route in routes]
    confidence = np.stack([own for *_, own in ends])  # (routes, p)
    triangle, weights, _ = ends[0]
    spread = {}
    if len(ends) > 1:
        points = np.stack([interpolate(X, T, *place) for *place, _ in ends])  # (routes, p, 3)
        share = confidence + 1e-9
        mean = np.einsum("rp,rpx->px", share, points) / share.sum(0)[:, None]
        triangle, weights = closest_point(mean, X, T)
        spread["landmark_disagreement"] = np.linalg.norm(points - mean, axis=2).max(0)
    return dataset(
        landmark_position=interpolate(X, T, triangle, weights),
        landmark_triangle=triangle.astype(np.int32),
        landmark_barycentric=weights,
        landmark_confidence=confidence.mean(0),
        **spread,
    )
