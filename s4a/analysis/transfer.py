"""Transfer of labels, landmarks and scalar fields along a registration (6.2, 4.3; Fig. 6 and 7).

Routes go from the template to a shape, from a shape through the template to another, or from an
external mesh through the template of a study to every shape.  A route is a list of links between a
template and a shape, with their directions:

    source shape --up--> template --down--> target shape

Down a link, every vertex of the shape gets the value at the closest point of the deformed template;
up, every vertex of the template gets the value at the closest point of the shape.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import xarray as xr
from scipy.sparse.linalg import cg

from s4a.analysis.inputs import all_registered
from s4a.geometry.closest import (
    closest_facing_point,
    closest_point,
    interpolate,
    interpolation_matrix,
)
from s4a.geometry.mesh import as_arrays, stiffness, vertex_areas, vertex_normals
from s4a.input.coordinates import CoordinateSystem, in_one_system
from s4a.input.landmarks import FARTHEST_LANDMARK, NAMED, as_landmarks, locate, trace_curves
from s4a.input.subjects import listed
from s4a.method.register import common_unit, identity, uncertainty
from s4a.method.remesh import laplacian
from s4a.method.shape import Shape
from s4a.options import Options, given_options
from s4a.schema import Array, check_choice, check_rows, dataset, in_unit, require
from s4a.study.pair import log_warning, match_both, shape_of

BLURS = {None: 1.0, "fast": 1.0, "paper": 0.0}  # default of `blur` by preset

# Triangles (p,) and barycentric weights (p, 3) of points on a surface, and their confidence (p,).
Points = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Link:
    """One registration: a template ``X, T``, a shape ``Y, S``, and their correspondence.

    ``image (n, 3)`` is the registered template in the frame of the shape, ``confidence (n,)`` that
    of its vertices; ``triangle (p,)`` and ``weights (p, 3)`` are the barycentric coordinates of the
    shape's vertices on the template.
    """

    X: Array
    T: Array
    Y: Array
    S: Array
    image: Array
    confidence: Array
    triangle: Array
    weights: Array

    @cached_property
    def down(self) -> tuple[sp.csr_matrix, Array]:
        """Matrix ``(p, n)`` of values from template to shape, and confidence on the shape."""
        W = interpolation_matrix(self.T, self.triangle, self.weights, len(self.X))
        return W, W @ self.confidence

    @cached_property
    def up(self) -> tuple[sp.csr_matrix, Array]:
        """Matrix ``(n, p)`` of values from shape to template, and confidence on the template."""
        normals = vertex_normals(self.image, self.T)
        triangle, weights = closest_facing_point(self.image, normals, self.Y, self.S)
        return interpolation_matrix(self.S, triangle, weights, len(self.Y)), self.confidence

    def transfer_down(self, triangle: Array, weights: Array) -> Points:
        """Transfer points on the template to the shape."""
        points = (self.T, triangle, weights)
        P = interpolate(self.image, *points)
        N = interpolate(vertex_normals(self.image, self.T), *points)
        confidence = interpolate(self.confidence[:, None], *points)[:, 0]
        return *closest_facing_point(P, N, self.Y, self.S), confidence

    def transfer_up(self, triangle: Array, weights: Array) -> Points:
        """Transfer points on the shape to the template."""
        P = interpolate(self.Y, self.S, triangle, weights)
        N = interpolate(vertex_normals(self.Y, self.S), self.S, triangle, weights)
        triangle, weights = closest_facing_point(P, N, self.image, self.T)
        confidence = interpolate(self.confidence[:, None], self.T, triangle, weights)[:, 0]
        return triangle, weights, confidence


Route = list[tuple[Link, str]]  # links with their directions, "down" or "up"


def image_in_shape(X: Array, registered: xr.Dataset) -> Array:
    """Return the registered template ``(n, 3)`` in the coordinates of the shape's file.

    `registered` is the shape's part of ``/registration``, with the alignment s R x + t.
    """
    R, t, s = (registered[name].values for name in ("rotation", "translation", "scale"))
    return (X + registered["displacement"].values - t) @ R / s


def link(template: xr.Dataset, shape: xr.Dataset, registered: xr.Dataset) -> Link:
    """Return the :class:`Link` of two meshes from the shape's part of ``/registration``."""
    X, T = as_arrays(template)
    Y, S = as_arrays(shape)
    names = ("confidence", "template_triangle", "template_barycentric")
    return Link(X, T, Y, S, image_in_shape(X, registered), *(registered[n].values for n in names))


def matrix_along(route: Route, n: int) -> tuple[sp.csr_matrix, Array]:
    """Return the matrix of a route from n vertices, and the confidence on the last mesh."""
    if not route:
        return sp.identity(n, format="csr"), np.ones(n)
    steps = [getattr(step, direction) for step, direction in route]
    W, confidence = steps[0]
    for V, confidence_of_step in steps[1:]:
        W = V @ W
        confidence = confidence_of_step * (V @ confidence)
    return W, confidence


def transfer_along(route: Route, triangle: Array, weights: Array) -> Points:
    """Transfer points from the first mesh of a route to the last."""
    confidence = np.ones(len(triangle))
    for step, direction in route:
        transfer = step.transfer_down if direction == "down" else step.transfer_up
        triangle, weights, confidence_of_step = transfer(triangle, weights)
        confidence = confidence * confidence_of_step
    return triangle, weights, confidence


def blend_routes(routes: list[Route], n: int) -> tuple[sp.csr_matrix, Array]:
    """Average routes, weighted by confidence: matrix ``(p, n)`` and mean confidence ``(p,)``."""
    matrices, confidences = zip(*(matrix_along(route, n) for route in routes), strict=True)
    weight = np.stack(confidences) + 1e-9  # (routes, p), no zero in the sum below
    weight /= weight.sum(0)
    W = sum(sp.diags(w) @ V for w, V in zip(weight, matrices, strict=True))
    return W.tocsr(), np.mean(confidences, axis=0)


def votes_of(W: sp.csr_matrix, label: Array) -> tuple[Array, Array]:
    """Return the votes of the source vertices for every label at every target vertex.

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


def diffuse_votes(vote: Array, X: Array, T: Array, radius: Array) -> Array:
    """Diffuse votes by an implicit heat step, (A + W) v = A v0, over the uncertainty of the match.

    A are the vertex areas, W is the stiffness matrix times t = area radius^2 / 4.  In the plane the
    kernel of one step has a mean squared radius of 4 t.

    Parameters
    ----------
    vote : float32 ndarray (p, l)
    X, T : ndarray (p, 3), (q, 3)
        The target.
    radius : ndarray (p,)
        Root mean squared radius, as a share of sqrt(area).

    Returns
    -------
    float32 ndarray (p, l)
        Rows sum to 1.
    """
    E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
    t = area.sum() * radius**2 / 4
    # negative weights of edges between obtuse corners would give negative votes
    W = stiffness(E, np.maximum(w, 0) * t[E].mean(axis=1), len(X))
    system = sp.diags(area) + W  # (p, p), positive definite
    jacobi = sp.diags(1 / system.diagonal())
    diffused = vote.copy()
    for column in diffused.T:
        v = column.astype(float)
        column[:] = cg(system, area * v, x0=v, rtol=1e-5, M=jacobi)[0]
    np.clip(diffused, 0, 1, out=diffused)  # as conjugate gradients are exact to 1e-5
    diffused /= diffused.sum(axis=1, keepdims=True)
    return diffused


def majority(vote: Array, value: Array) -> Array:
    """Return the label with most votes at every vertex; ties give the first in sorted order.

    Examples
    --------
    >>> import numpy as np
    >>> import scipy.sparse as sp
    >>> from s4a.analysis.transfer import majority, votes_of
    >>> majority(*votes_of(sp.csr_matrix([[0.5, 0.2, 0.3]]), np.array([4, 7, 7]))).tolist()
    [4]
    """
    return value[vote.round(6).argmax(1)]  # votes within six digits are ties


def _preset(study: xr.DataTree, given: dict[str, Any]) -> str | None:
    """Preset of a transfer: the given one, else that of the study or of its pairs."""
    if "preset" in given:
        return given["preset"]
    if "report" in study.children:
        return Options.from_report(study).preset
    return study["registration"].attrs.get("preset") or None


def _routes(study: xr.DataTree, name: str) -> tuple[list[Route], list[Route]]:
    """Routes from the template down to a shape, and up from the shape.

    One in each direction, or two if the pair was matched in both directions.
    """
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    if name == template:
        return [[]], [[]]
    mesh = study["original"][template].to_dataset()
    shape = study["original"][name].to_dataset()
    points = study["registration"].children[name].to_dataset(inherit=False)
    forth = link(mesh, shape, registration.sel(shape=name).merge(points))
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
    """Routes from an external mesh to the template of a study, with its options and given ones."""
    name = study["registration"].attrs["template"]
    if "coarse" not in study.children:
        raise ValueError(
            f"an external source is matched to the template {name!r}, which needs /coarse; this "
            "study of pairs has none: give one of its shapes as source"
        )
    template = study["original"][name].to_dataset().load()
    of_study = Options.from_report(study)
    options = given_options(given, of_study, pair=True)
    if options.of("low resolution") == of_study.of("low resolution"):
        inside = Shape(
            template, study["coarse"][name].to_dataset().load(), **options.of("projection")
        )
    else:
        inside = shape_of(template, options)
    outside = shape_of(mesh, options)
    forth, back = match_both(inside, outside, options)
    log_warning(forth, f"the registration of {name!r} to the external source")
    routes: list[Route] = [[(link(mesh, template, forth), "down")]]
    if back is not None:
        routes.append([(link(template, mesh, back), "up")])
    return routes


def plan(
    study: xr.DataTree,
    given: Any,
    source: str | xr.Dataset | None,
    targets: list[str] | None,
    options: dict[str, Any] | None = None,
) -> tuple[list[tuple[xr.Dataset, Any]], Iterator[tuple[str, xr.Dataset, list[list[Route]]]]]:
    """Return (mesh, values) of every source, and an iterator of (target, mesh, routes by source).

    Parameters
    ----------
    study, source, targets : see :func:`transfer_labels`
    given : object or dict
        Values of one `source`, or a dict of names of sources to their values.
    options : dict, optional
        Options of the match of an external source, which replace those of the study.

    Raises
    ------
    ValueError
        If the study has no registration or lacks a shape, there is no source, or options are given
        without an external source.
    """
    if isinstance(given, dict) and (source is not None or not given):
        raise ValueError(
            f"a dict of sources to their values replaces source=; found {len(given)} sources and "
            f"source={source if isinstance(source, str) or source is None else 'a mesh'!r}"
        )
    registration = all_registered(study)
    template, names = registration.attrs["template"], registration["shape"].values.tolist()
    pairs = [*given.items()] if isinstance(given, dict) else [(source, given)]
    pairs = [(template if one is None else one, values) for one, values in pairs]
    inside = [one for one, _ in pairs if not isinstance(one, xr.Dataset)]
    targets = [n for n in names if n not in inside] if targets is None else list(targets)
    for name in targets:
        check_choice("target", name, names)
    for one in inside:
        check_choice("source", one, [*names, template])
    meshes = study["original"].children if "original" in study.children else ()
    needed = dict.fromkeys([template, *inside, *targets])
    if absent := [name for name in needed if name not in meshes]:
        raise ValueError(f"the meshes of the shapes are needed; /original lacks {listed(absent)}")
    starts = [_start(study, one, options or {}) for one, _ in pairs]

    def routes_to_targets():
        for name in targets:
            down, _ = _routes(study, name)
            routes = [[a + b for a in up for b in down] for _, up in starts]
            yield name, study["original"][name].to_dataset(), routes

    sources = [(mesh, values) for (mesh, _), (_, values) in zip(starts, pairs, strict=True)]
    return sources, routes_to_targets()


def _start(study, source, options):
    """Mesh of a source, a shape or an external mesh, and its routes up to the template."""
    if isinstance(source, xr.Dataset):
        require(source, "position", "corner_vertex", what="source")
        template = study["original"][study["registration"].attrs["template"]].to_dataset()
        mesh = in_one_system({"template": template, "source": source})["source"]
        return mesh, _routes_from_outside(study, mesh, options)
    if options:
        raise ValueError(
            f"options {', '.join(options)} need an external source, which is matched to the "
            f"template; found the shape {source!r}, which is registered: leave them out"
        )
    return study["original"][source].to_dataset(), _routes(study, source)[1]


def transfer_labels(
    study: xr.DataTree,
    label: Any,
    *,
    source: str | xr.Dataset | None = None,
    targets: list[str] | None = None,
    votes: bool = False,
    blur: float | None = None,
    **options: Any,
) -> xr.DataTree:
    """Transfer labels of one or several meshes to every shape of a study (6.2, Fig. 6).

    Parameters
    ----------
    study : DataTree
        A finished study, or a result of :func:`s4a.register_pairs` or
        :func:`s4a.study.pair.pair_study`.
    label : array_like (vertex,), or dict of str to array_like
        Numbers or names at the vertices of the source in ``/original`` (see
        :func:`s4a.input.annotations.labels_of_mesh`); or a dict of several sources to their labels,
        which have equal votes.
    source : str or Dataset, optional
        Name of a shape of the study, by default the template; or an external mesh.  An external
        mesh is first matched to the template with the options of the study.
    targets : list of str, optional
        Names of the shapes that receive the labels; by default all that are not a source.
    votes : bool
        Also return the share of the votes for every label.
    blur : float, optional
        Radius over which votes are diffused, as a multiple of the estimated match error at each
        vertex (:func:`s4a.method.register.uncertainty`).  Diffusion smooths label borders where the
        match is uncertain.  A label that diffusion would remove keeps its vertices.  0, as in the
        paper, disables diffusion.  The default is 1, or 0 with ``preset="paper"`` of the study or
        of an external source.
    **options
        Options of :func:`s4a.register_pairs` for an external source, including ``preset``.  They
        replace the options of the study.

    Returns
    -------
    DataTree
        A node for every target, with the variables

        - ``label(vertex)``: label with most votes among the corners of the corresponding triangle
          of the source and their neighbourhood;
        - ``label_share(vertex)``: share of the votes for that label, from 0 to 1;
        - ``confidence(vertex)``: confidence of the match, from 0 to 1;
        - ``label_vote(vertex, label_value)``, with `votes`: share of the votes for every label.

    Raises
    ------
    ValueError
        If the labels do not fit the source, a shape is not in the study, `blur` is not between 0
        and 10, or an option is out of range, contradicts the preset, or is given without an
        external source.

    See Also
    --------
    s4a.transfer_scalars : Scalar fields.
    s4a.transfer_landmarks : Landmarks.
    s4a_morphometrics.write_label_volumes : Labels as volumes.

    Examples
    --------
    In a study of six small brains with known labels:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> label, true = (study[f"original/{name}/label"].values for name in ("brain_01", "brain_02"))
    >>> result = s4a.transfer_labels(study, label, source="brain_01", targets=["brain_02"])
    >>> bool((result["brain_02/label"].values == true).mean() > 0.5)
    True

    Labels of one brain on another, in colours:

    >>> brains = s4a.synthetic.brains(2, 3000)["original"]
    >>> source, target = (mesh.to_dataset() for mesh in brains.children.values())
    >>> pairs = s4a.register_pairs(source, {"b": target}, n_coarse=600, k=40)
    >>> label = source["label"].values
    >>> transferred = s4a.transfer_labels(pairs, label)["b/label"].values
    >>> colors = s4a.show.draw.label_colors(np.arange(label.max() + 1))
    >>> s4a.show.charts.surfaces(
    ...     {"template": source, "transferred": target},
    ...     {"template": colors[label], "transferred": colors[transferred]},
    ...     flat=True,
    ... )
    <TiledFigure ...>
    """
    if blur is not None and not 0 <= blur <= 10:
        raise ValueError(f"blur needs a factor from 0 to 10; found {blur}")
    sources, routes_to_targets = plan(study, label, source, targets, options)
    blur = BLURS[_preset(study, options)] if blur is None else blur
    labels = [
        check_rows("labels of the source", one, (mesh.sizes["vertex"],)) for mesh, one in sources
    ]
    transferred = {}
    for name, target, routes in routes_to_targets:
        blended = [blend_routes(r, len(one)) for r, one in zip(routes, labels, strict=True)]
        W = sp.hstack([W for W, _ in blended]).tocsr() / len(blended)
        confidence = np.mean([confidence for _, confidence in blended], axis=0)
        vote, value = votes_of(W, np.concatenate(labels))
        winner = majority(vote, value)
        # the source itself has an empty route, without uncertainty
        if blur and any(map(any, routes)):
            vote = diffuse_votes(vote, *as_arrays(target), blur * uncertainty(confidence))
            diffused = majority(vote, value)
            lost = np.setdiff1d(winner, diffused)
            winner = np.where(np.isin(winner, lost), winner, diffused)
        share = vote[np.arange(len(vote)), np.searchsorted(value, winner)]
        transferred[name] = dataset(
            label=winner, label_share=share, confidence=confidence.astype(np.float32)
        )
        if votes:
            shares = dataset(label_vote=vote)
            transferred[name] = transferred[name].merge(shares).assign_coords(label_value=value)
    return xr.DataTree.from_dict(transferred)


def transfer_scalars(
    study: xr.DataTree,
    field: Array,
    *,
    source: str | xr.Dataset | None = None,
    targets: list[str] | None = None,
    **options: Any,
) -> xr.DataTree:
    """Transfer a scalar field of one mesh to every shape of a study, linearly within triangles.

    Parameters
    ----------
    study, source, targets, **options
        As in :func:`transfer_labels`: the study, the shape that the field belongs to, the shapes
        that receive the field, and options for an external source.
    field : array_like (vertex,)
        Numbers at the vertices of the source, in any unit.  NaN has no weight.

    Returns
    -------
    DataTree
        A node for every target, with the variables

        - ``field(vertex)``: transferred field in its unit, NaN if more than half of the weight is
          on NaN;
        - ``confidence(vertex)``: confidence of the match, from 0 to 1.

    See Also
    --------
    s4a.transfer_labels : Labels.
    s4a.transfer_landmarks : Landmarks.

    Examples
    --------
    In a study of six small brains, a constant field stays constant:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> result = s4a.transfer_scalars(study, np.ones(200), targets=["brain_02"])
    >>> bool(np.allclose(result["brain_02/field"], 1))
    True
    """
    [(mesh, _)], routes_to_targets = plan(study, None, source, targets, options)
    field = check_rows("field of the source", field, (mesh.sizes["vertex"],)).astype(float)
    transferred = {}
    for name, _, [routes] in routes_to_targets:
        value, confidence = _blend_field(routes, field)
        transferred[name] = dataset(field=value, confidence=confidence.astype(np.float32))
    return xr.DataTree.from_dict(transferred)


def on_template(study: xr.DataTree, name: str, field: Array) -> Array:
    """Transfer a scalar field of a shape ``(vertex,)`` to the template.

    As :func:`transfer_scalars`; a field of the template is unchanged.
    """
    return _blend_field(_routes(study, name)[1], field)[0]


def _blend_field(routes, field):
    """Transferred field, NaN if over half of the weight is on NaN, and confidence."""
    finite = np.isfinite(field).astype(float)
    W, confidence = blend_routes(routes, len(field))
    weight = W @ finite
    value = W @ np.nan_to_num(field) / np.maximum(weight, 1e-12)
    value[weight < 0.5] = np.nan
    return value, confidence


def transfer_landmarks(
    study: xr.DataTree,
    landmarks: xr.Dataset | Path | str | dict[str, xr.Dataset | Path | str],
    *,
    source: str | xr.Dataset | None = None,
    targets: list[str] | None = None,
    farthest: float = FARTHEST_LANDMARK,
    **options: Any,
) -> xr.DataTree:
    """Transfer landmarks of one or several meshes to every shape of a study (6.2, Fig. 7).

    Curves of landmarks (``landmark_curve``, see :func:`s4a.input.annotations.read_landmarks`) are
    sampled along the surface of the source at the mean edge length, and become polylines.

    Parameters
    ----------
    study, source, targets, **options
        As in :func:`transfer_labels`: the study, the shape that the landmarks belong to, the shapes
        that receive them, and options for an external source.
    landmarks : path or Dataset, or dict of str to path or Dataset
        A landmark file, or a result of :func:`s4a.input.annotations.read_landmarks`; or a dict of
        several sources to theirs, with the same names.  Their images are averaged.
    farthest : float
        Largest valid distance of a landmark from the surface of the source, as a share of
        sqrt(area).

    Returns
    -------
    DataTree
        A node for every target, with the variables

        - ``landmark_name(landmark)``: names, empty for points added along a curve;
        - ``landmark_position(landmark, xyz)``: points on the surface of the target, in the
          coordinates of its mesh;
        - ``landmark_triangle(landmark)`` and ``landmark_barycentric(landmark, corner)``: triangle
          and barycentric coordinates of these points;
        - ``landmark_confidence(landmark)``: confidence of the match, from 0 to 1.  It finds failed
          regions of shapes in different poses; among shapes in similar poses it is an average of
          the group and does not rank the points by their error;
        - ``landmark_disagreement(landmark)``, if several sources or matches are averaged: largest
          distance of one of their results from the mean;
        - ``landmark_curve`` and ``landmark_closed``, with curves: name of the curve of each point,
          and True if the curve is closed.

    Raises
    ------
    ValueError
        If a landmark is not on the source, a shape is not in the study, or an option is invalid.

    See Also
    --------
    s4a.transfer_labels : Labels.
    s4a.transfer_scalars : Scalar fields.

    Examples
    --------
    In a study of six small brains:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> source = study["original/brain_01"].to_dataset()
    >>> landmarks = source[["landmark_name", "landmark_position"]]
    >>> result = s4a.transfer_landmarks(study, landmarks, source="brain_01", targets=["brain_02"])
    >>> result["brain_02/landmark_position"].dims
    ('landmark', 'xyz')

    The landmarks of the source, and their transfer to the target:

    >>> from s4a.show.draw import label_colors, with_balls
    >>> shown, colors = {}, {}
    >>> for name, marks in (("brain_01", landmarks), ("brain_02", result["brain_02"])):
    ...     X, T = s4a.geometry.mesh.as_arrays(study[f"original/{name}"].to_dataset())
    ...     points = marks["landmark_position"].values
    ...     hues, radii = label_colors(np.arange(len(points))), np.full(len(points), 5.0)
    ...     Y, S, colors[name] = with_balls(X, T, None, np.c_[points, hues, radii].tolist())
    ...     shown[name] = s4a.geometry.mesh.as_dataset(Y, S)
    >>> s4a.show.charts.surfaces(shown, colors)
    <TiledFigure ...>
    """
    sources, routes_to_targets = plan(study, landmarks, source, targets, options)
    marked = [_located(marks, mesh, farthest) for mesh, marks in sources]
    marked = [marked[0], *(_in_order_of(marked[0], one) for one in marked[1:])]
    named = marked[0][[name for name in NAMED if name in marked[0]]]
    transferred = {}
    for name, target, routes in routes_to_targets:
        image = _transfer_landmarks(marked, target, routes).merge(named)
        transferred[name] = image.assign_attrs(CoordinateSystem.of(target.attrs).attrs)
    return xr.DataTree.from_dict(transferred)


def _located(landmarks, mesh, farthest):
    """Landmarks and points along curves on the surface of a mesh."""
    landmarks = as_landmarks(landmarks)
    marked = locate(landmarks, mesh, farthest=farthest)
    return trace_curves(marked, mesh) if "landmark_curve" in landmarks else marked


def _in_order_of(first, marked):
    """Landmarks in the order of the names of the first source; they must be the same."""
    names, others = (one["landmark_name"].values.astype(str).tolist() for one in (first, marked))
    if sorted(names) != sorted(others) or len(set(names)) < len(names):
        wrong = sorted(set(names) ^ set(others)) or "names that occur twice"
        raise ValueError(
            f"several sources need the same landmarks with different names, and no curves; "
            f"found in some only: {wrong}"
        )
    return marked.isel(landmark=[others.index(name) for name in names])


def correspondence(study: xr.DataTree, source: str, target: str) -> xr.Dataset:
    """Return the point of one shape for every vertex of another, through the template (4.2, 6.2).

    Two registered surfaces are composed, without rounding to vertices of the template or of the
    target: from the vertex to the closest point of the template registered to the source, and from
    that point of the template registered to the target to the closest point of the target.

    Parameters
    ----------
    study : DataTree
        A finished study, or a result of :func:`s4a.register_pairs` or
        :func:`s4a.study.pair.pair_study`.
    source, target : str
        Names of two shapes of the study; either may be the template.

    Returns
    -------
    Dataset
        The variables are

        - ``image_triangle(vertex)`` and ``image_barycentric(vertex, corner)``: triangle of the
          target and barycentric weights for each vertex of the source;
        - ``image_position(vertex, xyz)``: the point, in the coordinates of the target;
        - ``confidence(vertex)``: confidence of the match, from 0 to 1.

    Raises
    ------
    ValueError
        If the study has no registration, or a shape is not in it.

    See Also
    --------
    s4a.transfer_labels, s4a.transfer_scalars, s4a.transfer_landmarks : Values along this map.
    s4a.latent_match : Vertices that correspond by the latent bases alone.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> found = s4a.correspondence(study, "brain_01", "brain_02")
    >>> found["image_position"].shape, bool((found["image_barycentric"].sum("corner") > 0.99).all())
    ((200, 3), True)
    """
    [(mesh, _)], [(_, shape, [routes])] = plan(study, None, source, [target])
    vertices = identity(Shape(mesh))
    points = vertices["template_triangle"].values, vertices["template_barycentric"].values
    paths = [(points, route) for route in routes]
    position, (triangle, weights), confidence, _ = _blend_points(paths, shape)
    image = dataset(
        image_triangle=triangle.astype(np.int32),
        image_barycentric=weights,
        image_position=position,
        confidence=confidence.mean(0).astype(np.float32),
    )
    return in_unit(image, common_unit(shape)).assign_attrs(source=source, target=target)


def _transfer_landmarks(marked, target, routes):
    """Mean of the landmarks of all sources and routes, weighted by confidence, on the surface."""
    paths = [
        ((one["landmark_triangle"].values, one["landmark_barycentric"].values), route)
        for one, of_source in zip(marked, routes, strict=True)
        for route in of_source
    ]
    position, (triangle, weights), confidence, distance = _blend_points(paths, target)
    disagreement = {} if distance is None else {"landmark_disagreement": distance}
    return dataset(
        landmark_position=position,
        landmark_triangle=triangle.astype(np.int32),
        landmark_barycentric=weights,
        landmark_confidence=confidence.mean(0),
        **disagreement,
    )


def _blend_points(paths, target):
    """Mean of points, each along its route, weighted by confidence, on the surface of the target.

    Position ``(p, 3)``, triangle and weights, confidences ``(routes, p)``, and the largest distance
    of a route from the mean ``(p,)``, None for one route.
    """
    X, T = as_arrays(target)
    results = [transfer_along(route, *points) for points, route in paths]
    confidence = np.stack([result[2] for result in results])  # (routes, p)
    on_surface = results[0][:2]
    distance = None
    if len(results) > 1:
        positions = np.stack([interpolate(X, T, t, w) for t, w, _ in results])  # (routes, p, 3)
        share = confidence + 1e-9
        mean = np.einsum("rp,rpx->px", share, positions) / share.sum(0)[:, None]
        on_surface = closest_point(mean, X, T)
        distance = np.linalg.norm(positions - mean, axis=2).max(0)
    return interpolate(X, T, *on_surface), on_surface, confidence, distance
