"""Landmarks and curves on a surface: where a mesh has what a file of points says (6.2, Fig. 7)."""

from collections import Counter
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays, edge_graph, edges, triangle_areas
from s4a.input.annotations import MIRROR, read_landmarks
from s4a.input.raw import shown
from s4a.schema import check_type, dataset, require

NAMED = ("landmark_name", "landmark_curve", "landmark_closed")
ITERATIONS = 12  # halvings of a segment of a curve
# Of sqrt(area): a landmark farther from its surface belongs to another mesh or frame.
FARTHEST_LANDMARK = 0.03
# of files that may be named as a shape; the longer before those that they end with
SUFFIXES = (".landmarks.csv", ".mrk.json", ".json", ".csv", ".pp")


def as_landmarks(landmarks: xr.Dataset | Path | str) -> xr.Dataset:
    """Return landmarks that are given as a Dataset, or read their file if a path is given."""
    if isinstance(landmarks, str | Path):
        return read_landmarks(landmarks)
    read = "a landmark file, or what s4a.input.annotations.read_landmarks returns"
    check_type(landmarks, xr.Dataset | xr.DataTree, "landmarks", read)
    require(landmarks, "landmark_name", "landmark_position", what="landmarks")
    return landmarks


def locate(
    landmarks: xr.Dataset, mesh: xr.Dataset, *, farthest: float = FARTHEST_LANDMARK
) -> xr.Dataset:
    """Landmarks on a surface: the closest point of the surface to each.

    Where landmarks and mesh say their coordinate systems and one is RAS, the other LPS, x and y
    change sign; where the mesh says none, they do so if the landmarks lie on the surface only then.

    Parameters
    ----------
    landmarks : Dataset
        ``landmark_name``, ``landmark_position`` in the unit of the mesh, as of
        :func:`s4a.input.annotations.read_landmarks`.
    mesh : Dataset
    farthest : float
        As a share of sqrt(area of the mesh).

    Returns
    -------
    Dataset
        ``landmark_name``, ``landmark_position`` on the surface, ``landmark_triangle``,
        ``landmark_barycentric`` and ``landmark_distance`` from the surface, before.

    Raises
    ------
    ValueError
        When a landmark is not finite or farther from the surface than `farthest`; it names the
        worst.
    """
    landmarks = as_landmarks(landmarks)
    require(mesh, "position", "corner_vertex", what="mesh")
    X, T = as_arrays(mesh)
    limit = farthest * np.sqrt(triangle_areas(X, T).sum())
    P = landmarks["landmark_position"].values.astype(float)
    away = ~(abs(P - X.mean(0)).max(1) < 1e9 * np.sqrt(triangle_areas(X, T).sum()))  # or NaN
    if away.any():
        first = int(away.argmax())
        raise ValueError(
            "landmarks need finite positions near the surface; "
            f"{str(landmarks['landmark_name'].values[first])!r} is at {P[first].tolist()}"
        )
    theirs = landmarks.attrs.get("coordinate_system", "")
    ours = mesh.attrs.get("coordinate_system", "")
    place, point, distance = _project(P * MIRROR if theirs and ours and theirs != ours else P, X, T)
    if theirs and not ours and distance.max() > limit:
        mirrored = _project(P * MIRROR, X, T)
        if mirrored[2].max() < distance.max():
            place, point, distance = mirrored
    if distance.max() > limit:
        worst = int(distance.argmax())
        name = str(landmarks["landmark_name"].values[worst])
        raise ValueError(
            f"landmarks within {limit:.4g} of the surface needed "
            f"({100 * farthest:g} % of sqrt(area)); "
            f"{name!r} is {distance[worst]:.4g} away: is it of another mesh, unit "
            "or coordinate system (RAS, LPS)?"
        )
    return _located(
        place,
        landmark_position=point,
        landmark_distance=distance,
        **{name: landmarks[name].values for name in NAMED if name in landmarks},
    )


def _project(P, X, T):
    """Place of the closest point of the surface to each P, the point, and its distance."""
    place = closest_point(P, X, T)
    point = interpolate(X, T, *place)
    return place, point, np.linalg.norm(point - P, axis=1)


def _located(place, **variables):
    """A Dataset of landmarks at a place on the surface."""
    triangle, weights = place
    return dataset(
        landmark_triangle=triangle.astype(np.int32), landmark_barycentric=weights, **variables
    )


def follow(
    P: np.ndarray, X: np.ndarray, T: np.ndarray, *, closed: bool = False, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """A polyline on a surface: through points, with further ones in between.

    Every segment that is longer than `spacing` is halved, and its middle moved to the closest point
    of the surface.

    Parameters
    ----------
    P : float ndarray (p, 3)
        In order along the curve, on the surface.
    X, T : the mesh
    closed : bool
        Whether a segment leads from the last point to the first.
    spacing : float
        In the unit of the mesh.

    Returns
    -------
    points : float ndarray (q, 3)
    is_given : bool ndarray (q,)
        Which of them are those of P.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.landmarks import follow
    >>> X, T = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]])
    >>> points, is_given = follow(X[:2], X, T, spacing=1.5)
    >>> points[:, 0].tolist(), is_given.tolist()
    ([0.0, 1.0, 2.0, 3.0, 4.0], [True, False, False, False, True])
    """
    P = np.concatenate([P, P[:1]]) if closed else P
    is_given = np.ones(len(P), bool)
    for _ in range(ITERATIONS):
        long = np.flatnonzero(np.linalg.norm(np.diff(P, axis=0), axis=1) > spacing)
        if not len(long):
            break
        middle = (P[long] + P[long + 1]) / 2
        P = np.insert(P, long + 1, interpolate(X, T, *closest_point(middle, X, T)), axis=0)
        is_given = np.insert(is_given, long + 1, False)
    return (P[:-1], is_given[:-1]) if closed else (P, is_given)


def trace_curves(landmarks: xr.Dataset, mesh: xr.Dataset) -> xr.Dataset:
    """Landmarks of :func:`locate`, and points in between along every curve, an edge's length apart.

    The points in between have no name; their curve is that of their neighbours.
    """
    X, T = as_arrays(mesh)
    spacing = edge_graph(X, edges(T)).data.mean()
    P = landmarks["landmark_position"].values
    curve = landmarks["landmark_curve"].values
    closed = landmarks["landmark_closed"].values
    alone = np.flatnonzero(curve == "")
    points = [P[alone]]
    is_given = [np.ones(len(alone), bool)]
    before = [alone]  # the landmark that each point is, or comes after
    for name in dict.fromkeys(curve[curve != ""].tolist()):
        own = np.flatnonzero(curve == name)
        line, on_line = follow(P[own], X, T, closed=bool(closed[own[0]]), spacing=spacing)
        points.append(line)
        is_given.append(on_line)
        before.append(own[np.cumsum(on_line) - 1])
    point = np.concatenate(points)
    given = np.concatenate(is_given)
    origin = np.concatenate(before)
    return _located(
        closest_point(point, X, T),
        landmark_position=point,
        landmark_distance=np.where(given, landmarks["landmark_distance"].values[origin], 0.0),
        landmark_name=np.where(given, landmarks["landmark_name"].values[origin], ""),
        landmark_curve=curve[origin],
        landmark_closed=closed[origin],
    )


def with_landmarks(mesh: xr.Dataset, landmarks: xr.Dataset | Path | str) -> xr.Dataset:
    """A mesh that knows its landmarks, so that registration holds them together.

    Landmarks are paired by name: those that two shapes have guide the rigid transform and, in far
    poses, the initial map, and pull the elastic iterations (:mod:`s4a.method.elastic`).  Points of
    curves have no partner and are left out.

    Parameters
    ----------
    mesh : Dataset
        Clean, as of :func:`s4a.read_shape` or :func:`s4a.clean`.
    landmarks : Dataset or path
        As of :func:`s4a.input.annotations.read_landmarks`, or a file that it reads.

    Returns
    -------
    Dataset
        The mesh, and what :func:`locate` says as ``guide_name(guide)``, ``guide_position`` and so
        on.  Landmarks without them (``landmark_name``) are carried over and compared, and guide
        nothing.

    Raises
    ------
    ValueError
        When the file cannot be read, no landmark is left, two have one name, or one is farther from
        the surface than 3 % of sqrt(area).

    Examples
    --------
    >>> import s4a
    >>> from s4a.schema import dataset
    >>> mesh = s4a.synthetic.ellipsoid(200)
    >>> top = dataset(landmark_name=["top"], landmark_position=mesh["position"].values[:1])
    >>> s4a.with_landmarks(mesh, top)["guide_name"].values.tolist()
    ['top']
    """
    given = as_landmarks(landmarks)
    where = "landmarks" if isinstance(landmarks, xr.Dataset) else shown(landmarks)
    if "landmark_curve" in given:
        given = given.isel(landmark=given["landmark_curve"].values == "")
        given = given.drop_vars(["landmark_curve", "landmark_closed"])
    names = given["landmark_name"].values.tolist()
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice or not names:
        raise ValueError(
            f"{where}: landmarks of different names needed, found "
            + (f"{twice[0]!r} {names.count(twice[0])} times" if twice else "none")
        )
    there = locate(given, mesh)
    guides = {str(name).replace("landmark", "guide"): there[name].values for name in there}
    return mesh.drop_dims("guide", errors="ignore").merge(dataset(None, **guides))


def guides_of(mesh: xr.Dataset) -> xr.Dataset:
    """The landmarks that guide the registration of a mesh, as :func:`with_landmarks` takes them."""
    return dataset(
        landmark_name=mesh["guide_name"].values, landmark_position=mesh["guide_position"].values
    )
