"""Transfer of labels, landmarks and scalar fields along a registration (6.2, 4.3; Fig. 6 and 7).

Routes go from the template to a shape, from a shape through the template to another, or from an
external mesh to the template of a study and on to every shape (:mod:`s4a.analysis.link`).
"""

import numpy as np
import scipy.sparse as sp
import xarray as xr
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from s4a.analysis.landmarks import FARTHEST_LANDMARK, NAMED, locate, traced
from s4a.analysis.link import blended, elect, link, point_along
from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method.register import identity
from s4a.method.remesh import coarsen
from s4a.method.shape import Shape
from s4a.method.spectral import spectrum
from s4a.schema import dataset, in_unit, require
from s4a.study import store
from s4a.study.pair import match_shapes


def pair_study(found, source, target):
    """What :func:`s4a.match_pair` found as a registered study of two shapes.

    ``source`` and ``target`` (the template).

    Parameters
    ----------
    found, source, target : Dataset
        The result, and the meshes it was made of.

    Returns
    -------
    DataTree
        ``/original``, ``/registration``: what the functions of this module take.
    """
    data = found.drop_vars(["fmap", "fmap_initial"]).rename(match="registered_match")
    return _tree("target", target, {"source": source}, {"source": data}, {})


def _tree(name, template, shapes, forth, back):
    """A registered study; `back` holds the registrations of the template to each shape as the template."""
    meshes = {name: template, **shapes}
    files = {name: identity(Shape(template)), **forth}
    mesh = as_dataset(
        *as_arrays(template), {"template": name}, vertex_area=vertex_areas(*as_arrays(template))
    )
    mesh = in_unit(mesh, template.attrs.get("unit"))
    nodes = {f"original/{n}": m for n, m in meshes.items()} | store.stack_registration(
        mesh, files, list(meshes)
    )
    return xr.DataTree.from_dict(nodes | {f"reverse/{n}": data for n, data in back.items()})


def _low(mesh, n_coarse, seed, k):
    with threadpool_limits(1):
        return Shape(mesh, spectrum(coarsen(mesh, n_coarse=n_coarse, seed=seed), k=k))


def _both(shape, template, options, both):
    with threadpool_limits(1):
        forth = match_shapes(shape, template, **options)[0]
        return forth, match_shapes(template, shape, **options)[0] if both else None


def register_pairs(
    template,
    shapes,
    *,
    name="template",
    both=True,
    n_coarse=6000,
    k_init=20,
    k=100,
    init="dense",
    n_jobs=None,
    seed=0,
):
    """The template registered to each shape on its own (6.2, the first way).

    A study for transfer, without statistics.

    Parameters
    ----------
    template : Dataset
        Clean mesh, as of :func:`s4a.read_shape`.
    shapes : dict of str to Dataset
    name : str
        Of the template among the shapes.
    both : bool
        Whether each pair is matched both ways; transfer then takes the mean of both.
    n_coarse, k_init, k, init, seed
        See :func:`s4a.match_pair`.
    n_jobs : int, optional
        As in joblib; the result does not depend on it.

    Returns
    -------
    DataTree
        ``/original``, ``/registration`` and, with `both`, ``/reverse``.

    Raises
    ------
    ValueError
        When a shape has the name of the template, or a mesh lacks its variables.

    Examples
    --------
    >>> import s4a
    >>> brains = s4a.synthetic.brains(6, 200)
    >>> source, target = (brains[f"original/{name}"].to_dataset() for name in ("brain_01", "brain_02"))
    >>> pairs = s4a.register_pairs(source, {"brain_02": target}, n_coarse=100, k_init=6, k=10)
    >>> s4a.transfer_labels(pairs, source["label"].values)["brain_02"]["label"].sizes["vertex"]
    200
    """
    if name in shapes or not shapes:
        raise ValueError(
            f"shapes other than the template, {name!r}, needed; found {', '.join(shapes) or 'none'}"
        )
    for what, mesh in {name: template, **shapes}.items():
        require(mesh, "position", "corner_vertex", what=f"mesh {what}")
    low = Parallel(n_jobs=n_jobs)(
        delayed(_low)(m, n_coarse, seed, k) for m in (template, *shapes.values())
    )
    options = {"k_init": k_init, "k": k, "init": init}
    found = Parallel(n_jobs=n_jobs)(
        delayed(_both)(shape, low[0], options, both) for shape in low[1:]
    )
    forth, back = ({n: pair[i] for n, pair in zip(shapes, found, strict=True)} for i in (0, 1))
    return _tree(name, template, shapes, forth, back if both else {})


def _links(study, name):
    """The template and a shape.

    Steps down, and steps up, one of each or (matched both ways) two.
    """
    template = study["registration"].attrs["template"]
    meshes = [study["original"][n].to_dataset() for n in (template, name)]
    registered = study["registration"].to_dataset().sel(shape=name)
    forth = link(*meshes, registered.merge(study["registration"][name].to_dataset(inherit=False)))
    down, up = [(forth, "down")], [(forth, "up")]
    if "reverse" in study.children and name in study["reverse"].children:
        back = link(*meshes[::-1], study["reverse"][name].to_dataset())
        down, up = [*down, (back, "up")], [*up, (back, "down")]
    return down, up


def _entrance(study, mesh):
    """Steps from an external mesh to the study's template, matched both ways."""
    template = study["registration"].attrs["template"]
    coarse = study["coarse"][template].to_dataset().load()
    low = Shape(study["original"][template].to_dataset().load(), coarse)
    k = coarse.sizes["mode"]
    outside = _low(mesh, 6000, 0, k)
    forth, back = _both(low, outside, {"k_init": min(20, k), "k": k}, True)
    return [(link(mesh, low.original, forth), "down"), (link(low.original, mesh, back), "up")]


def plan(study, source, targets):
    """The mesh where the transfer begins, and an iterator of (target, its mesh, routes to it).

    Raises
    ------
    ValueError
        When the study has no registration, or a shape is not in it.
    """
    if "registration" not in study:
        raise ValueError(
            f"a registered study is needed; this one has {', '.join(study.children) or 'no nodes'}"
        )
    template = study["registration"].attrs["template"]
    names = study["registration"]["shape"].values.tolist()
    source = template if source is None else source
    external = isinstance(source, xr.Dataset)
    targets = [n for n in names if external or n != source] if targets is None else list(targets)
    wrong = [
        n
        for n in [*targets, *([] if external or source == template else [source])]
        if n not in names
    ]
    if wrong:
        raise ValueError(
            f"no shape {', '.join(map(repr, wrong))} in the study; it has {', '.join(names)}"
        )
    if external:
        require(source, "position", "corner_vertex", what="source")
        first = _entrance(study, source)
    else:
        first = [] if source == template else _links(study, source)[1]

    def each():
        for name in targets:
            last = [] if name == template else _links(study, name)[0]
            routes = [[a, b] for a in first for b in last] or [[step] for step in (first or last)]
            yield name, study["original"][name].to_dataset(), routes

    return source if external else study["original"][source].to_dataset(), each()


def transfer_labels(study, label, *, source=None, targets=None, votes=False):
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
        template first (template -> median -> every shape).
    targets : list of str, optional
        All other shapes by default.
    votes : bool
        Whether the share of every label is given too.

    Returns
    -------
    DataTree
        For every target ``label(vertex)``, the label with most votes among the corners of the
        triangle that each vertex comes to lie on; ``label_share(vertex)``, its share of the votes;
        ``confidence(vertex)`` of the match; and with `votes` ``label_vote(vertex, label_value)``.

    Raises
    ------
    ValueError
        When the labels do not fit the source, or a shape is not in the study.

    Examples
    --------
    With the ``study`` of six small brains, where the labels of every brain are known:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> given, true = (study[f"original/{name}/label"].values for name in ("brain_01", "brain_02"))
    >>> carried = s4a.transfer_labels(study, given, source="brain_01", targets=["brain_02"])
    >>> bool((carried["brain_02/label"].values == true).mean() > 0.5)
    True
    """
    mesh, each = plan(study, source, targets)
    label = _per_vertex(label, mesh, "label")
    found = {}
    for name, _, routes in each:
        W, confidence = (
            blended(routes) if routes else (sp.identity(len(label)), np.ones(len(label)))
        )
        winner, vote, value = elect(W, label)
        found[name] = dataset(
            label=winner, label_share=vote.max(1), confidence=confidence.astype(np.float32)
        )
        if votes:
            found[name] = (
                found[name].merge(dataset(label_vote=vote)).assign_coords(label_value=value)
            )
    return xr.DataTree.from_dict(found)


def transfer_scalars(study, field, *, source=None, targets=None):
    """A scalar field of one mesh on every shape of a registered study, linear inside triangles.

    Parameters
    ----------
    study, source, targets : see :func:`transfer_labels`
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
    mesh, each = plan(study, source, targets)
    field = _per_vertex(field, mesh, "field").astype(float)
    known = np.isfinite(field).astype(float)
    found = {}
    for name, _, routes in each:
        W, confidence = (
            blended(routes) if routes else (sp.identity(len(field)), np.ones(len(field)))
        )
        weight = W @ known
        value = np.where(
            weight >= 0.5, W @ np.nan_to_num(field) / np.maximum(weight, 1e-12), np.nan
        )
        found[name] = dataset(field=value, confidence=confidence.astype(np.float32))
    return xr.DataTree.from_dict(found)


def _per_vertex(values, mesh, what):
    values = np.asarray(values)
    if values.shape != (mesh.sizes["vertex"],):
        raise ValueError(
            f"{what} needs one value for each of the {mesh.sizes['vertex']} vertices of the source, "
            f"found shape {values.shape}"
        )
    return values


def transfer_landmarks(study, landmarks, *, source=None, targets=None, farthest=FARTHEST_LANDMARK):
    """Landmarks of one mesh on every shape of a registered study.

    At points inside triangles (6.2, Fig. 7).

    Where the landmarks have curves (``landmark_curve``, see
    :func:`s4a.input.annotations.read_landmarks`), points in between are added along the surface of
    the source, an edge's length apart, and all carried over: curves come out as polylines.

    Parameters
    ----------
    study, source, targets : see :func:`transfer_labels`
    landmarks, farthest : see :func:`s4a.analysis.landmarks.locate`

    Returns
    -------
    DataTree
        For every target ``landmark_name``, ``landmark_position(landmark, xyz)`` on its surface, in
        its coordinates, ``landmark_triangle``, ``landmark_barycentric(landmark, corner)``,
        ``landmark_confidence`` and, where there are several routes, ``landmark_spread``, the
        largest distance of one from their mean; with curves ``landmark_curve`` and
        ``landmark_closed``, and no name for the points in between.

    Raises
    ------
    ValueError
        When a landmark is not on the source, or a shape is not in the study.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> source = study["original/brain_01"].to_dataset()
    >>> landmarks = source[["landmark_name", "landmark_position"]]
    >>> carried = s4a.transfer_landmarks(study, landmarks, source="brain_01", targets=["brain_02"])
    >>> carried["brain_02/landmark_position"].dims
    ('landmark', 'xyz')
    """
    mesh, each = plan(study, source, targets)
    marked = locate(landmarks, mesh, farthest=farthest)
    if "landmark_curve" in landmarks:
        marked = traced(marked, mesh)
    start = marked["landmark_triangle"].values, marked["landmark_barycentric"].values
    found = {}
    for name, target, routes in each:
        X, T = as_arrays(target)
        ends = [point_along(route, *start) for route in routes or [[]]]
        points = np.stack([interpolate(X, T, triangle, weights) for triangle, weights, _ in ends])
        confidence = np.stack([c for *_, c in ends])
        mean = (
            np.einsum("rp,rpx->px", confidence + 1e-9, points) / (confidence + 1e-9).sum(0)[:, None]
        )
        triangle, weights = closest_point(mean, X, T) if len(ends) > 1 else ends[0][:2]
        found[name] = dataset(
            **{v: marked[v].values for v in NAMED if v in marked},
            landmark_position=interpolate(X, T, triangle, weights),
            landmark_triangle=triangle.astype(np.int32),
            landmark_barycentric=weights,
            landmark_confidence=confidence.mean(0),
        )
        if len(ends) > 1:
            found[name] = found[name].merge(
                dataset(landmark_spread=np.linalg.norm(points - mean, axis=2).max(0))
            )
    return xr.DataTree.from_dict(found)
