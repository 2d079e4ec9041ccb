"""Metrics of a correspondence: those of the paper (5.1, eq. 9-11), and errors of a map.

The plain functions take arrays in any unit; :func:`evaluate` scales the surfaces to unit area, so
its lengths are shares of sqrt(area).
"""

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import (
    as_arrays,
    cotan_weights,
    edge_graph,
    edges,
    path_lengths,
    triangle_areas,
    vertex_areas,
)
from s4a.method.deform import distortion as distortion
from s4a.schema import Array, check_choice, check_rows, dataset, require

THRESHOLDS = np.linspace(0, 0.25, 101)  # of the error curve, as in Kim et al. (2011), Fig. 6


def nearest_distances(X: Array, Y: Array) -> tuple[Array, Array]:
    """Return distances to the nearest point: ``(n,)`` from X to Y, ``(p,)`` from Y to X."""
    return cKDTree(Y).query(X)[0], cKDTree(X).query(Y)[0]


def chamfer(X: Array, Y: Array) -> float:
    """Chamfer distance of two point sets (eq. 9).

    Sum of the mean distances to the nearest point in both directions.

    It sees how much of one set is far from the other.  It cannot see which point is matched to
    which: any permutation of the vertices scores 0.  Vertices without a match count only by the
    distance to their neighbours.

    Parameters
    ----------
    X : float ndarray (n, 3)
        Vertices of M.
    Y : float ndarray (p, 3)
        Image of N under the map.

    Returns
    -------
    float, in the unit of the points

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> s4a.metrics.chamfer(np.zeros((2, 3)), np.array([[3.0, 4.0, 0.0]]))
    10.0
    """
    return float(sum(distance.mean() for distance in nearest_distances(X, Y)))


def hausdorff(X: Array, Y: Array, formula: str = "standard") -> float:
    """Hausdorff distance of two point sets (eq. 10): largest distance to the nearest point.

    It sees only the worst point, and like :func:`chamfer` it cannot see permutations.

    Parameters
    ----------
    X, Y : see :func:`chamfer`
    formula : {"standard", "paper"}
        The maximum over both directions; or eq. 10 as printed, where the second maximum is divided
        by the number of points of Y and added, so that it hardly counts with thousands of points.

    Returns
    -------
    float, in the unit of the points

    Raises
    ------
    ValueError
        If the formula is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> X, Y = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0], [3, 0, 0]])
    >>> s4a.metrics.hausdorff(X, Y), s4a.metrics.hausdorff(X, Y, "paper")
    (2.0, 2.0)
    """
    check_choice("formula", formula, ("standard", "paper"))
    forth, back = (distance.max() for distance in nearest_distances(X, Y))
    return float(max(forth, back) if formula == "standard" else forth + back / len(Y))


def dirichlet(f: Array, E: Array, w: Array) -> float:
    """Dirichlet energy f^T A L f of functions on the vertices (eq. 11), summed over functions.

    With L = A^-1 W it is f^T W f, the sum of w (f_i - f_j)^2 over the edges: the areas cancel, and
    so does the scale of the mesh.  For the coordinates of an image it is at least twice the area of
    the image, with equality for a conformal map; for an eigenfunction it is the eigenvalue.

    It sees how rough a map is.  It cannot see its target: a map to one point scores 0, and a smooth
    map to the wrong side scores like the correct one.

    Parameters
    ----------
    f : float ndarray (n,) or (n, d)
        Functions on the vertices of a mesh: coordinates of the image, or transferred eigenfunctions
        ``Phi[match]``.
    E : int ndarray (e, 2)
        Edges of that mesh.
    w : float ndarray (e,)
        Cotangent weights, see :func:`s4a.geometry.mesh.cotan_weights`.

    Returns
    -------
    float, in the squared unit of f

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.geometry.mesh import cotan_weights
    >>> X, T = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    >>> s4a.metrics.dirichlet(X, *cotan_weights(X, T))  # twice the area of the triangle
    1.0
    """
    difference = (f[E[:, 0]] - f[E[:, 1]]).reshape(len(E), -1)
    return float(w @ (difference**2).sum(axis=1))


def geodesic_error(X: Array, T: Array, match: Array, true: Array, *, limit: float = 1.0) -> Array:
    """Return distances from true to matched vertices along edges, as shares of sqrt(area).

    Princeton protocol with paths along edges, which are up to 10 % longer than geodesics.  It sees
    every wrong vertex and its error.  It cannot see errors below the vertex spacing, nor whether
    neighbours stay neighbours.

    Parameters
    ----------
    X, T : mesh of the matched and true vertices
    match, true : int ndarray (p,)
    limit : float
        Largest distance.

    Returns
    -------
    float ndarray (p,)
        `limit` if there is no shorter path.

    References
    ----------
    V. Kim, Y. Lipman and T. Funkhouser (2011), Blended intrinsic maps, ACM TOG 30(4).

    Examples
    --------
    A square of area 1 with one of four vertices matched to its neighbour:

    >>> import numpy as np
    >>> import s4a
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])  # a square
    >>> T = np.array([[0, 1, 2], [0, 2, 3]])
    >>> s4a.metrics.geodesic_error(X, T, np.array([0, 1, 2, 0]), np.arange(4)).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    return path_lengths(
        edge_graph(X / np.sqrt(triangle_areas(X, T).sum()), edges(T)), true, match, limit
    )


def error_curve(error: Array, thresholds: ArrayLike = THRESHOLDS) -> Array:
    """Return the share of errors up to each threshold ``(t,)``.

    The cumulative curve of the Princeton protocol distinguishes few gross errors from many small
    ones, which a mean cannot.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> s4a.metrics.error_curve(np.array([0.0, 0.1, 0.3]), [0.0, 0.1, 0.2]).round(2).tolist()
    [0.33, 0.67, 0.67]
    """
    return np.searchsorted(np.sort(error), thresholds, side="right") / len(error)


def coverage(match: Array, area: Array) -> float:
    """Return the share of the source's area whose vertices are matched by the target.

    It sees a map that collapses.  It cannot see a wrong map: a random permutation scores 1.  If the
    target has fewer vertices than the source, it is below 1 for any map.

    Parameters
    ----------
    match : int ndarray (n_target,)
    area : float ndarray (n_source,)

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> s4a.metrics.coverage(np.array([0, 0, 2]), np.array([1.0, 2.0, 1.0]))
    0.5
    """
    return float(area[np.unique(match)].sum() / area.sum())


def cycle_error(X: Array, T: Array, *matches: Array, vertices: Array | None = None) -> Array:
    """Return the distance of vertices from their images under a cycle of matches.

    It sees inconsistent matches without ground truth.  It cannot see errors that cancel: a
    symmetric flip and its inverse score 0.

    Parameters
    ----------
    X, T : mesh at which the cycle starts and ends
    *matches : int ndarray
        The first match maps vertices of X to those of the next shape, and so on; the last maps to
        vertices of X.
    vertices : int ndarray (p,), optional
        Vertices at which to start; by default all.

    Returns
    -------
    float ndarray (p,)
        See :func:`geodesic_error`.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])  # a square
    >>> T = np.array([[0, 1, 2], [0, 2, 3]])
    >>> rotate = np.array([1, 2, 3, 0])
    >>> s4a.metrics.cycle_error(X, T, rotate, rotate, rotate, rotate).tolist()
    [0.0, 0.0, 0.0, 0.0]
    """
    start = np.arange(len(X)) if vertices is None else vertices
    end = start
    for match in matches:
        end = match[end]
    return geodesic_error(X, T, end, start)


def label_accuracy(label: ArrayLike, true: ArrayLike, area: Array | None = None) -> float:
    """Return the share of the vertices, or of the area, with the correct label.

    It sees gross errors only, as most vertices are far from any border; :func:`dice` also sees
    small regions.

    Parameters
    ----------
    label, true : array_like (n,)
        Labels, numbers or names.
    area : float ndarray (n,), optional
        Weights of the vertices; equal by default.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> label, truth, area = np.array([1, 1, 2]), np.array([1, 2, 2]), np.array([1.0, 1.0, 2.0])
    >>> s4a.metrics.label_accuracy(label, truth, area)
    0.75
    """
    return float(np.average(np.asarray(label) == np.asarray(true), weights=area))


def dice(label: ArrayLike, true: ArrayLike, area: Array | None = None) -> dict[Any, float]:
    """Return the Dice coefficient 2 |A n B| / (|A| + |B|) of each label, by vertices or area.

    It sees each region, small ones like large ones.  It cannot see errors inside a region.

    Parameters
    ----------
    label, true : array_like (n,)
        Labels, numbers or names.
    area : float ndarray (n,), optional
        Weights of the vertices; equal by default.

    Returns
    -------
    dict
        Label -> Dice coefficient in 0..1, for every label of either array.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> overlap = s4a.metrics.dice(np.array([1, 1, 2]), np.array([1, 2, 2]))
    >>> [round(overlap[label], 3) for label in (1, 2)]
    [0.667, 0.667]
    """
    label, true = np.asarray(label), np.asarray(true)
    area = np.ones(len(label)) if area is None else area
    overlap = {}
    for value in np.union1d(label, true).tolist():
        a, b = label == value, true == value
        common = 2 * area[a & b].sum()
        overlap[value] = float(common / (area[a].sum() + area[b].sum()))
    return overlap


def landmark_error(position: ArrayLike, true: ArrayLike) -> Array:
    """Return Euclidean distances of landmarks from the true ones ``(p,)``, in their unit.

    It sees the map at a few points that an expert has marked, including the expert's error, and
    nowhere else.
    """
    return np.linalg.norm(np.asarray(position) - np.asarray(true), axis=-1)


def _median(values, weight):
    """Weighted median; infinite without values."""
    weighted = {"weights": weight, "method": "inverted_cdf"}
    return np.quantile(values, 0.5, **weighted) if len(values) else np.inf


def true_positions(truth: ArrayLike, X: Array, n: int) -> tuple[Array, Array]:
    """Convert ground truth of :func:`evaluate` to positions and to vertices of the source.

    Parameters
    ----------
    truth : array_like (n,) of integers, or (n, 3)
    X : float ndarray (n_source, 3)
    n : int
        Number of vertices of the target.

    Returns
    -------
    position : float ndarray (n, 3)
        NaN where unknown.
    vertex : int ndarray (n,)
        -1 where unknown.

    Raises
    ------
    ValueError
        If truth has another form, or refers to a vertex that the source lacks.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.evaluation.metrics import true_positions
    >>> position, vertex = true_positions(np.array([1, -1]), np.eye(3), 2)
    >>> position[0].tolist(), vertex.tolist()
    ([0.0, 1.0, 0.0], [1, -1])
    """
    truth = np.asarray(truth)
    if truth.shape == (n,) and truth.dtype.kind in "iu":
        if truth.max(initial=-1) >= len(X):
            raise ValueError(
                f"truth must hold vertices of the source, below {len(X)}; found {truth.max()}"
            )
        return np.where(truth[:, None] >= 0, X[truth], np.nan), truth
    if truth.shape != (n, 3):
        raise ValueError(
            f"truth needs, for each of the {n} vertices of the target, a vertex of the source "
            f"(integers, -1 where unknown) or a position (n, 3); "
            f"found {truth.dtype} of shape {truth.shape}"
        )
    known = np.isfinite(truth).all(axis=1)
    vertex = np.full(n, -1)
    vertex[known] = cKDTree(X).query(truth[known])[1]
    return truth, vertex


def _check_match(match, mesh, other, what):
    match = np.asarray(match)
    n, p = mesh.sizes["vertex"], other.sizes["vertex"]
    low, high = match.min(initial=0), match.max(initial=0)
    if match.shape != (n,) or match.dtype.kind not in "iu" or low < 0 or high >= p:
        raise ValueError(
            f"{what} needs {n} integers from 0 to {p - 1}, one for each vertex; "
            f"found {match.dtype} of shape {match.shape} from {low} to {high}"
        )
    return match


def _evenly_spaced(n, most):
    """Return at most `most` of n rows, evenly spaced."""
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(int))


def evaluate(
    source: xr.Dataset,
    target: xr.Dataset,
    match: Array,
    *,
    image: Array | None = None,
    reverse: Array | None = None,
    truth: ArrayLike | None = None,
    n_geodesic: int = 1000,
    thresholds: ArrayLike = THRESHOLDS,
) -> xr.Dataset:
    """Compute all metrics of a correspondence that the inputs allow.

    Lengths are shares of sqrt(area) of their surface.

    Parameters
    ----------
    source, target : Dataset
        Meshes.  Labels, and landmarks of the same ``landmark_name``, are transferred and compared
        if both meshes have them.
    match : int array_like (n_target,)
        Matched vertex of the source for each vertex of the target.
    image : float array_like (n_target, 3), optional
        Positions on the source, in its frame and unit; by default those of the matched vertices.
        For two shapes of a study, ``image_position`` of
        ``s4a.correspondence(study, target, source)``.
    reverse : int array_like (n_source,), optional
        Match in the other direction.
    truth : array_like, optional
        True vertex of the source for each vertex of the target ``(n_target,)``, -1 if unknown, or
        true position ``(n_target, 3)``, NaN if unknown.
    n_geodesic : int
        Number of vertices of the target, evenly spaced in their order, for geodesic distances.
    thresholds : array_like (t,)
        Thresholds of the error curve.

    Returns
    -------
    Dataset
        The variables are

        - ``chamfer``, ``hausdorff``, ``hausdorff_paper``, ``dirichlet``, ``coverage`` and
          ``collapsed_share``;
        - ``conformal_distortion`` and ``area_distortion``: medians by area over the triangles that
          do not collapse;
        - with `reverse`: ``bijectivity``;
        - with `truth`: ``geodesic_error`` of the matched vertices, ``euclidean_error`` of the image
          and ``error_curve(threshold)``;
        - with labels: ``label_accuracy`` by area, and ``label_dice``, the mean over the labels of
          the target;
        - with landmarks: ``landmark_error``, the mean over the landmarks.

        Results stack with ``xarray.concat`` along a new dim, such as ``algorithm`` (``method`` is
        a keyword of ``sel``).

    Raises
    ------
    ValueError
        If the arrays do not fit the meshes.

    See Also
    --------
    s4a.compare : these metrics for several methods.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> ball = s4a.synthetic.sphere(162)
    >>> same = np.arange(162)
    >>> result = s4a.metrics.evaluate(ball, ball, same, reverse=same, truth=same)
    >>> float(result["coverage"]), float(result["geodesic_error"])
    (1.0, 0.0)
    >>> round(float(result["dirichlet"]), 6)
    2.0
    """
    for mesh, what in ((source, "source"), (target, "target")):
        require(mesh, "position", "corner_vertex", what=what)
    (X, T), (Y, S) = as_arrays(source), as_arrays(target)
    match = _check_match(match, target, source, "match")
    area, area_target = vertex_areas(X, T), vertex_areas(Y, S)
    size, size_target = np.sqrt(area.sum()), np.sqrt(area_target.sum())
    image = X[match] if image is None else check_rows("image", image, Y.shape).astype(float)
    forth, back = nearest_distances(X / size, image / size)
    conformal, growth = distortion(Y / size_target, image / size, S)
    weight = triangle_areas(Y, S)
    regular, collapsed = np.isfinite(growth), np.isneginf(growth)
    result = {
        "chamfer": forth.mean() + back.mean(),
        "hausdorff": max(forth.max(), back.max()),
        "hausdorff_paper": forth.max() + back.max() / len(image),
        "dirichlet": dirichlet(image / size, *cotan_weights(Y, S)),
        "coverage": coverage(match, area),
        "conformal_distortion": _median(conformal[regular], weight[regular]),
        "area_distortion": _median(np.abs(growth[regular]), weight[regular]),
        "collapsed_share": weight[collapsed].sum() / weight.sum(),
    }
    if reverse is not None:
        reverse = _check_match(reverse, source, target, "reverse")
        sample = _evenly_spaced(len(Y), n_geodesic)
        result["bijectivity"] = cycle_error(Y, S, match, reverse, vertices=sample).mean()
    coords = {}
    if truth is not None:
        position, vertex = true_positions(truth, X, len(Y))
        known = np.flatnonzero(vertex >= 0)
        if not len(known):
            raise ValueError(
                "truth is unknown at every vertex of the target; give at least one, or leave it out"
            )
        sample = known[_evenly_spaced(len(known), n_geodesic)]
        error = geodesic_error(X, T, match[sample], vertex[sample])
        result |= {
            "geodesic_error": error.mean(),
            "euclidean_error": np.linalg.norm(image[known] - position[known], axis=1).mean() / size,
            "error_curve": error_curve(error, thresholds),
        }
        coords["threshold"] = np.asarray(thresholds, float)
    if "label" in source and "label" in target:
        label, true = source["label"].values[match], target["label"].values
        overlap = dice(label, true, area_target)
        result["label_accuracy"] = label_accuracy(label, true, area_target)
        result["label_dice"] = np.mean([overlap[value] for value in np.unique(true).tolist()])
    if "landmark_name" in source and "landmark_name" in target:
        at_source, at_target = map(_landmarks, (source, target))
        shared = [name for name in at_target if name in at_source]
        if shared:
            point = closest_point(np.array([at_target[name] for name in shared]), Y, S)
            true = np.array([at_source[name] for name in shared])
            error = landmark_error(interpolate(image, S, *point), true)
            result["landmark_error"] = error.mean() / size
    return dataset(**result).assign_coords(coords)


def _landmarks(mesh):
    """Return the positions of a mesh's landmarks by name."""
    names = mesh["landmark_name"].values.tolist()
    return dict(zip(names, mesh["landmark_position"].values, strict=True))
