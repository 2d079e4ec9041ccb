"""Metrics of a correspondence.

Those of the paper (5.1, eq. 9-11), and those that can see a wrong map.

The plain functions take arrays in any one unit; :func:`evaluate` scales the surfaces to unit area,
so that its lengths are shares of sqrt(area).
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
from s4a.schema import dataset, require

THRESHOLDS = np.linspace(0, 0.25, 101)  # of the error curve, as in Kim et al. (2011), Fig. 6


def gaps(X: np.ndarray, Y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances to the nearest point, both ways: ``(n,)`` from X to Y, ``(p,)`` from Y to X."""
    return cKDTree(Y).query(X)[0], cKDTree(X).query(Y)[0]


def chamfer(X: np.ndarray, Y: np.ndarray) -> float:
    """Chamfer distance of two sets of points (eq. 9).

    Mean distance to the nearest point, both ways, summed.

    It sees how much of one set is far from the other.  It cannot see which point goes where: any
    permutation of the vertices scores 0.  Vertices that nothing is matched to count only as far as
    their neighbours are away.

    Parameters
    ----------
    X : float ndarray (n, 3)
        Vertices of M.
    Y : float ndarray (p, 3)
        Their counterpart: the image of N under the map.

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
    return float(sum(gap.mean() for gap in gaps(X, Y)))


def hausdorff(X: np.ndarray, Y: np.ndarray, formula: str = "standard") -> float:
    """Hausdorff distance of two sets of points (eq. 10): the largest distance to the nearest point.

    It sees the worst place only, and like :func:`chamfer` no permutation.

    Parameters
    ----------
    X, Y : see :func:`chamfer`
    formula : {"standard", "paper"}
        The larger of both ways; or eq. 10 as it is printed, where the second maximum is divided by
        the number of points of Y and added: with thousands of points that is the first way alone.

    Returns
    -------
    float, in the unit of the points

    Raises
    ------
    ValueError
        When the formula is another.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> X, Y = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0], [3, 0, 0]])
    >>> s4a.metrics.hausdorff(X, Y), s4a.metrics.hausdorff(X, Y, "paper")
    (2.0, 2.0)
    """
    if formula not in ("standard", "paper"):
        raise ValueError(f"formula must be 'standard' or 'paper', found {formula!r}")
    forth, back = (gap.max() for gap in gaps(X, Y))
    return float(max(forth, back) if formula == "standard" else forth + back / len(Y))


def dirichlet(f: np.ndarray, E: np.ndarray, w: np.ndarray) -> float:
    """Dirichlet energy f^T A L f of functions on the vertices (eq. 11), summed over the functions.

    With L = A^-1 W it is f^T W f, the sum of w (f_i - f_j)^2 over the edges: the areas cancel, and
    so does the scale of the mesh that carries f.  Of the coordinates of an image it is at least
    twice the area of the image, and exactly that for a conformal map; of an eigenfunction it is its
    eigenvalue.

    It sees how rough a map is.  It cannot see where it goes: a map of everything to one point
    scores 0, and a smooth map to the wrong side scores as well as the right one.

    Parameters
    ----------
    f : float ndarray (n,) or (n, d)
        Functions on the vertices of the mesh that carries them: coordinates of the image, or
        eigenfunctions ``Phi[match]`` carried over a map.
    E : int ndarray (e, 2)
        Edges of that mesh.
    w : float ndarray (e,)
        Their cotan weights, see :func:`s4a.geometry.mesh.cotan_weights`.

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


def geodesic_error(
    X: np.ndarray, T: np.ndarray, found: np.ndarray, true: np.ndarray, *, limit: float = 1.0
) -> np.ndarray:
    """Distances from true to found vertices along the edges, as shares of sqrt(area).

    Cut at `limit`.

    The Princeton protocol (Kim, Lipman, Funkhouser 2011) with paths along edges, which are up to a
    tenth longer than the shortest ones.  It sees every wrong vertex, and how far off it is.  It
    cannot see anything finer than the vertices lie apart, and not whether neighbours stay
    neighbours.

    Parameters
    ----------
    X, T : the mesh that found and true vertices belong to
    found, true : int ndarray (p,)
    limit : float

    Returns
    -------
    float ndarray (p,)
        `limit` where there is no path, or none as short.

    Examples
    --------
    A square of area 1, in two triangles; one vertex of four is a side's length off:

    >>> import numpy as np
    >>> import s4a
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])  # a square
    >>> T = np.array([[0, 1, 2], [0, 2, 3]])
    >>> s4a.metrics.geodesic_error(X, T, np.array([0, 1, 2, 0]), np.arange(4)).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    return path_lengths(
        edge_graph(X / np.sqrt(triangle_areas(X, T).sum()), edges(T)), true, found, limit
    )


def error_curve(error: np.ndarray, thresholds: ArrayLike = THRESHOLDS) -> np.ndarray:
    """Share of the errors that are no larger than each threshold, ``(t,)``.

    It is the cumulative curve of the Princeton protocol.

    It sees what a mean hides: few gross errors or many small ones.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> s4a.metrics.error_curve(np.array([0.0, 0.1, 0.3]), [0.0, 0.1, 0.2]).round(2).tolist()
    [0.33, 0.67, 0.67]
    """
    return np.searchsorted(np.sort(error), thresholds, side="right") / len(error)


def coverage(match: np.ndarray, area: np.ndarray) -> float:
    """Share of the source's area whose vertices are matched to by some vertex of the target.

    It sees a map that collapses.  It cannot see a wrong one: a random permutation scores 1.  With
    fewer vertices on the target than on the source it stays below 1 for the best of maps.

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


def cycle_error(
    X: np.ndarray,
    T: np.ndarray,
    *matches: np.ndarray,
    vertices: np.ndarray | None = None,
    limit: float = 1.0,
) -> np.ndarray:
    """How far vertices are from where they started after a chain of matches that leads back.

    See `geodesic_error`.

    It sees matches that contradict each other, without any truth.  It cannot see errors that
    cancel: a symmetric flip there and back scores 0.

    Parameters
    ----------
    X, T : the mesh where the cycle starts and ends
    *matches : int ndarray
        The first holds on its vertices those of the next shape, and so on; the last holds vertices
        of X.
    vertices : int ndarray (p,), optional
        Where to start; everywhere by default.

    Returns
    -------
    float ndarray (p,)

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])  # a square
    >>> T = np.array([[0, 1, 2], [0, 2, 3]])
    >>> turn = np.array([1, 2, 3, 0])
    >>> s4a.metrics.cycle_error(X, T, turn, turn, turn, turn).tolist()
    [0.0, 0.0, 0.0, 0.0]
    """
    start = np.arange(len(X)) if vertices is None else vertices
    end = start
    for match in matches:
        end = match[end]
    return geodesic_error(X, T, end, start, limit=limit)


def bijectivity(
    X: np.ndarray,
    T: np.ndarray,
    match: np.ndarray,
    reverse: np.ndarray,
    *,
    vertices: np.ndarray | None = None,
    limit: float = 1.0,
) -> np.ndarray:
    """Round trip target -> source -> target, a :func:`cycle_error` of two matches.

    0 for a map and its inverse.

    Parameters
    ----------
    X, T : the target
    match : int ndarray (n_target,)
        Vertices of the source.
    reverse : int ndarray (n_source,)
        Vertices of the target.
    vertices : int ndarray (p,), optional
        Of the target; all by default.

    Returns
    -------
    float ndarray (p,)

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])  # a square
    >>> T = np.array([[0, 1, 2], [0, 2, 3]])
    >>> turn = np.array([1, 2, 3, 0])
    >>> s4a.metrics.bijectivity(X, T, turn, np.argsort(turn)).tolist()
    [0.0, 0.0, 0.0, 0.0]
    """
    return cycle_error(X, T, match, reverse, vertices=vertices, limit=limit)


def label_accuracy(found: ArrayLike, true: ArrayLike, area: np.ndarray | None = None) -> float:
    """Share of the vertices, or of the area, whose label is right.

    It sees gross errors only, as most vertices lie far from any border; :func:`dice` sees small
    regions as well.

    Parameters
    ----------
    found, true : array_like (n,)
        Labels, numbers or names.
    area : float ndarray (n,), optional
        Weights of the vertices; all the same by default.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> label, truth, area = np.array([1, 1, 2]), np.array([1, 2, 2]), np.array([1.0, 1.0, 2.0])
    >>> s4a.metrics.label_accuracy(label, truth, area)
    0.75
    """
    return float(np.average(np.asarray(found) == np.asarray(true), weights=area))


def dice(found: ArrayLike, true: ArrayLike, area: np.ndarray | None = None) -> dict[Any, float]:
    """Dice's overlap 2 |A n B| / (|A| + |B|) of each label, by vertices or by area.

    It sees each region, small ones as strictly as large ones.  It cannot see errors inside a
    region.

    Parameters
    ----------
    found, true : array_like (n,)
        Labels, numbers or names.
    area : float ndarray (n,), optional
        Weights of the vertices; all the same by default.

    Returns
    -------
    dict
        Label -> overlap in 0..1, for every label of either.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> overlap = s4a.metrics.dice(np.array([1, 1, 2]), np.array([1, 2, 2]))
    >>> [round(overlap[label], 3) for label in (1, 2)]
    [0.667, 0.667]
    """
    found, true = np.asarray(found), np.asarray(true)
    area = np.ones(len(found)) if area is None else area
    overlap = {}
    for label in np.union1d(found, true).tolist():
        here, there = found == label, true == label
        both = 2 * area[here & there].sum()
        overlap[label] = float(both / (area[here].sum() + area[there].sum()))
    return overlap


def landmark_error(found: ArrayLike, true: ArrayLike) -> np.ndarray:
    """Straight distances of found to true landmarks ``(p,)``, in their unit.

    It sees the map at a few places that an expert knows, with the expert's own error in it, and
    nowhere else.
    """
    return np.linalg.norm(np.asarray(found) - np.asarray(true), axis=-1)


def _weighted_median(values, weight):
    if not len(values):
        return np.inf
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return values[order[np.searchsorted(total, total[-1] / 2)]]


def true_positions(truth: ArrayLike, X: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Truth as of :func:`evaluate`, as positions and as vertices of the source.

    Parameters
    ----------
    truth : array_like (n,) of integers, or (n, 3)
    X : float ndarray (n_source, 3)
    n : int
        Vertices of the target.

    Returns
    -------
    position : float ndarray (n, 3)
        NaN where unknown.
    vertex : int ndarray (n,)
        -1 where unknown.

    Raises
    ------
    ValueError
        When it is neither, or names a vertex that the source does not have.

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


def _match_of(match, mesh, other, what):
    match = np.asarray(match)
    n, p = mesh.sizes["vertex"], other.sizes["vertex"]
    low, high = match.min(initial=0), match.max(initial=0)
    if match.shape != (n,) or match.dtype.kind not in "iu" or low < 0 or high >= p:
        raise ValueError(
            f"{what} needs {n} integers from 0 to {p - 1}, one for each vertex; "
            f"found {match.dtype} of shape {match.shape} from {low} to {high}"
        )
    return match


def _some(n, most):
    """At most so many of n rows, evenly spaced."""
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(int))


def evaluate(
    source: xr.Dataset,
    target: xr.Dataset,
    match: np.ndarray,
    *,
    image: np.ndarray | None = None,
    reverse: np.ndarray | None = None,
    truth: ArrayLike | None = None,
    n_geodesic: int = 1000,
    thresholds: ArrayLike = THRESHOLDS,
) -> xr.Dataset:
    """Every metric of a correspondence that the inputs allow, as scalars of a Dataset.

    Lengths are shares of sqrt(area) of the surface on which they are measured.

    Parameters
    ----------
    source, target : Dataset
        Meshes.  Where both have ``label``, and where both have landmarks of the same
        ``landmark_name``, these are carried over and compared, too.
    match : int array_like (n_target,)
        On each vertex of the target the matched vertex of the source.
    image : float array_like (n_target, 3), optional
        Positions on the source, in its frame and unit, where the method gives more than vertices;
        by default the positions of the matched vertices.
    reverse : int array_like (n_source,), optional
        The match the other way.
    truth : array_like, optional
        True vertex of the source for every vertex of the target ``(n_target,)``, -1 where there is
        none, or true position ``(n_target, 3)``, NaN where there is none.
    n_geodesic : int
        On how many vertices of the target, evenly spaced in their order, distances are measured
        along edges.
    thresholds : array_like (t,)
        Of the error curve.

    Returns
    -------
    Dataset
        Always ``chamfer``, ``hausdorff``, ``hausdorff_paper``, ``dirichlet``, ``coverage``,
        ``collapsed_share``, ``conformal_distortion`` and ``area_distortion`` (medians by area over
        the triangles that do not collapse). With `reverse` also ``bijectivity``; with `truth`
        ``geodesic_error`` (of the matched vertices), ``euclidean_error`` (of the image) and
        ``error_curve(threshold)``; with labels ``label_accuracy`` (by area) and ``label_dice``
        (mean over the labels of the target); with landmarks ``landmark_error`` (mean).

        Several stack with ``xarray.concat``; ``way`` is a good name for the new dim, as
        ``.sel(method=...)`` is taken by xarray itself.

    Raises
    ------
    ValueError
        When the arrays do not fit the meshes.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> ball = s4a.synthetic.sphere(162)
    >>> same = np.arange(162)
    >>> found = s4a.metrics.evaluate(ball, ball, same, reverse=same, truth=same)
    >>> float(found["coverage"]), float(found["geodesic_error"])
    (1.0, 0.0)
    >>> round(float(found["dirichlet"]), 6)
    2.0
    """
    for mesh, what in ((source, "source"), (target, "target")):
        require(mesh, "position", "corner_vertex", what=what)
    (X, T), (Y, S) = as_arrays(source), as_arrays(target)
    match = _match_of(match, target, source, "match")
    area, area_target = vertex_areas(X, T), vertex_areas(Y, S)
    size, size_target = np.sqrt(area.sum()), np.sqrt(area_target.sum())
    image = X[match] if image is None else np.asarray(image, float)
    if image.shape != Y.shape:
        raise ValueError(
            f"image needs a position for each vertex of the target, {Y.shape}; found {image.shape}"
        )
    forth, back = gaps(X / size, image / size)
    conformal, growth = distortion(Y / size_target, image / size, S)
    weight = triangle_areas(Y, S)
    kept, collapsed = np.isfinite(growth), np.isneginf(growth)
    found = {
        "chamfer": forth.mean() + back.mean(),
        "hausdorff": max(forth.max(), back.max()),
        "hausdorff_paper": forth.max() + back.max() / len(image),
        "dirichlet": dirichlet(image / size, *cotan_weights(Y, S)),
        "coverage": coverage(match, area),
        "conformal_distortion": _weighted_median(conformal[kept], weight[kept]),
        "area_distortion": _weighted_median(np.abs(growth[kept]), weight[kept]),
        "collapsed_share": weight[collapsed].sum() / weight.sum(),
    }
    if reverse is not None:
        reverse = _match_of(reverse, source, target, "reverse")
        sample = _some(len(Y), n_geodesic)
        found["bijectivity"] = bijectivity(Y, S, match, reverse, vertices=sample).mean()
    coords = {}
    if truth is not None:
        position, vertex = true_positions(truth, X, len(Y))
        known = np.flatnonzero(vertex >= 0)
        if not len(known):
            raise ValueError(
                "truth is unknown at every vertex of the target; leave it out, or give some"
            )
        some = known[_some(len(known), n_geodesic)]
        error = geodesic_error(X, T, match[some], vertex[some])
        found |= {
            "geodesic_error": error.mean(),
            "euclidean_error": np.linalg.norm(image[known] - position[known], axis=1).mean() / size,
            "error_curve": error_curve(error, thresholds),
        }
        coords["threshold"] = np.asarray(thresholds, float)
    if "label" in source and "label" in target:
        carried, true = source["label"].values[match], target["label"].values
        overlap = dice(carried, true, area_target)
        found["label_accuracy"] = label_accuracy(carried, true, area_target)
        found["label_dice"] = np.mean([overlap[label] for label in np.unique(true).tolist()])
    if "landmark_name" in source and "landmark_name" in target:
        ours, theirs = map(_landmarks, (source, target))
        shared = [name for name in theirs if name in ours]
        if shared:
            place = closest_point(np.array([theirs[name] for name in shared]), Y, S)
            true = np.array([ours[name] for name in shared])
            error = landmark_error(interpolate(image, S, *place), true)
            found["landmark_error"] = error.mean() / size
    return dataset(**found).assign_coords(coords)


def _landmarks(mesh):
    """The positions of a mesh's landmarks by name."""
    names = mesh["landmark_name"].values.tolist()
    return dict(zip(names, mesh["landmark_position"].values, strict=True))
