"""Landmarks and curves on a surface (6.2, Fig. 7)."""

import itertools
import logging
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays, edge_graph, edges, triangle_areas
from s4a.input.annotations import read_landmarks
from s4a.input.coordinates import CoordinateSystem, file_system, moved, transform, with_system
from s4a.input.raw import shown
from s4a.schema import Array, check_type, dataset, require

log = logging.getLogger(__name__)

NAMED = ("landmark_name", "landmark_curve", "landmark_closed")
ITERATIONS = 12  # halvings of a segment of a curve
# share of sqrt(area): a landmark farther from its surface belongs to another mesh or frame
FARTHEST_LANDMARK = 0.03
# endings of landmark files named after shapes; longer ones first
SUFFIXES = tuple(".landmarks.csv .mrk.json .json .fcsv .csv .tps .pts .pp".split())


def as_landmarks(landmarks: xr.Dataset | Path | str) -> xr.Dataset:
    """Return landmarks given as a Dataset, or read their file if a path is given."""
    if isinstance(landmarks, str | Path):
        return read_landmarks(landmarks)
    read = "a landmark file, or what s4a.input.annotations.read_landmarks returns"
    check_type(landmarks, xr.Dataset | xr.DataTree, "landmarks", read)
    require(landmarks, "landmark_name", "landmark_position", what="landmarks")
    return landmarks


def locate(
    landmarks: xr.Dataset, mesh: xr.Dataset, *, farthest: float = FARTHEST_LANDMARK
) -> xr.Dataset:
    """Project landmarks to the closest points of a surface.

    Landmarks are converted to the coordinate system of the mesh if both are known.  Otherwise the
    interpretation that fits is used: as given, RAS, LPS or the system of the mesh file, with a
    warning unless it is as given.

    Parameters
    ----------
    landmarks : Dataset
        ``landmark_name``, ``landmark_position``, see
        :func:`s4a.input.annotations.read_landmarks`.
    mesh : Dataset
    farthest : float
        Largest distance, as a share of sqrt(area of the mesh).

    Returns
    -------
    Dataset
        ``landmark_name``, ``landmark_position`` on the surface, ``landmark_triangle``,
        ``landmark_barycentric`` and ``landmark_distance``, the distance before the projection.

    Raises
    ------
    ValueError
        If a landmark is not finite, or farther from the surface than `farthest`; the message names
        the worst.
    """
    landmarks = as_landmarks(landmarks)
    require(mesh, "position", "corner_vertex", what="mesh")
    X, T = as_arrays(mesh)
    limit = farthest * np.sqrt(triangle_areas(X, T).sum())
    P = landmarks["landmark_position"].values.astype(float)
    invalid = ~(abs(P - X.mean(0)).max(1) < 1e9 * np.sqrt(triangle_areas(X, T).sum()))  # or NaN
    if invalid.any():
        i = int(invalid.argmax())
        raise ValueError(
            "landmarks need finite positions near the surface; "
            f"{str(landmarks['landmark_name'].values[i])!r} is at {P[i].tolist()}"
        )
    maps = possible_maps(CoordinateSystem.of(landmarks.attrs), mesh)
    found = {name: _project(moved(P, M), X, T) for name, M in maps.items()}
    far = {name: projected[2].max() for name, projected in found.items()}
    given = next(iter(found))
    better = [name for name in far if far[given] > limit / 3 and far[name] < far[given] / 2]
    best = given if given == KNOWN else min(better, key=lambda name: far[name], default=given)
    surface_point, position, distance = found[best]
    others = [
        name
        for name in found
        if name.startswith("a mesh")
        and far[name] < limit
        and np.abs(found[name][1] - position).max() > limit
    ]  # of landmarks from 3D Slicer on a mesh that fits in two directions
    is_guess = best not in (KNOWN, GIVEN)
    limit = limit / 3 if is_guess else limit  # a guess needs more evidence
    if distance.max() > limit:
        worst = int(distance.argmax())
        name = str(landmarks["landmark_name"].values[worst])
        raise ValueError(
            f"landmarks within {limit:.4g} of the surface needed "
            f"({100 * farthest:g} % of sqrt(area)); "
            f"{name!r} is {distance[worst]:.4g} away: is it of another mesh, unit "
            "or coordinate system (RAS, LPS)? Landmarks: "
            f"{CoordinateSystem.of(landmarks.attrs)}; mesh: {CoordinateSystem.of(mesh.attrs)}; "
            "set coordinate_system= and unit= for files that lack them"
        )
    others += better if best == KNOWN else []  # files that state the wrong system
    if is_guess or others:
        log.warning(
            "%sthe coordinate system of the landmarks or of the mesh %s: %s fits, with at most "
            "%.3g from the surface%s; %s",
            f"{shown(mesh.attrs['path'])}: " if mesh.attrs.get("path") else "",
            "may be wrong" if best == KNOWN else "is unknown",
            best,
            distance.max(),
            "".join(f", and {name} with {far[name]:.3g}" for name in others),
            "correct the file if so" if best == KNOWN else "coordinate_system= sets it",
        )
    return _located(
        surface_point,
        landmark_position=position,
        landmark_distance=distance,
        **{name: landmarks[name].values for name in NAMED if name in landmarks},
    )


KNOWN, GIVEN = "the conversion", "the position as given"


def possible_maps(landmarks: CoordinateSystem, mesh: xr.Dataset) -> dict[str, Array]:
    """Return the maps (4, 4) that can take landmarks to a mesh, by what they assume.

    If both systems are known, the first is used.  An unknown unit is that of the other.
    """
    system = CoordinateSystem.of(mesh.attrs)
    known = transform(landmarks, system)
    if known is not None and landmarks.axes:
        return {KNOWN: known, GIVEN: np.eye(4)}
    unit = landmarks.unit or system.unit
    L, S = replace(landmarks, unit=unit), replace(system, unit=system.unit or unit)
    if L.axes and S.axes:
        found = {"a common origin": transform(L, S, origin=False)}
    else:
        found = {GIVEN: transform(CoordinateSystem(unit=L.unit), CoordinateSystem(unit=S.unit))}
    for text in ("RAS", "LPS"):
        guess = CoordinateSystem(text, "", unit)
        if S.axes and not L.axes:
            found[f"landmarks in {text}"] = transform(guess, S)
        elif L.axes and not S.axes:
            found[f"a mesh in {text}"] = transform(L, guess)
    if not L.axes:
        found["the coordinates of the file"] = transform(file_system(mesh.attrs), S)
    return {name: M for name, M in found.items() if M is not None} or {GIVEN: np.eye(4)}


def _project(P, X, T):
    """Closest surface point (triangle, weights) of each P, its position, and its distance."""
    surface_point = closest_point(P, X, T)
    position = interpolate(X, T, *surface_point)
    return surface_point, position, np.linalg.norm(position - P, axis=1)


def _located(surface_point, **variables):
    """Dataset of landmarks at surface points (triangle, weights)."""
    triangle, weights = surface_point
    return dataset(
        landmark_triangle=triangle.astype(np.int32), landmark_barycentric=weights, **variables
    )


def follow(
    P: Array, X: Array, T: Array, *, closed: bool = False, spacing: float
) -> tuple[Array, Array]:
    """Refine a polyline on a surface.

    Segments longer than `spacing` are halved repeatedly, and midpoints moved to the closest point
    of the surface.

    Parameters
    ----------
    P : float ndarray (p, 3)
        Points on the surface, in order along the curve.
    X, T : the mesh
    closed : bool
        Connect the last point to the first.
    spacing : float
        Longest segment, in the unit of the mesh.

    Returns
    -------
    points : float ndarray (q, 3)
    is_given : bool ndarray (q,)
        Mask of the points of P.

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
    """Refine the curves among landmarks of :func:`locate` to the mean edge length.

    The added points have no name; their curve is that of their neighbours.
    """
    X, T = as_arrays(mesh)
    spacing = edge_graph(X, edges(T)).data.mean()
    P = landmarks["landmark_position"].values
    curve = landmarks["landmark_curve"].values
    closed = landmarks["landmark_closed"].values
    no_curve = np.flatnonzero(curve == "")
    points = [P[no_curve]]
    is_given = [np.ones(len(no_curve), bool)]
    origins = [no_curve]  # the landmark that each point is, or comes after
    for name in dict.fromkeys(curve[curve != ""].tolist()):
        index = np.flatnonzero(curve == name)
        line, on_line = follow(P[index], X, T, closed=bool(closed[index[0]]), spacing=spacing)
        points.append(line)
        is_given.append(on_line)
        origins.append(index[np.cumsum(on_line) - 1])
    point = np.concatenate(points)
    given = np.concatenate(is_given)
    origin = np.concatenate(origins)
    return _located(
        closest_point(point, X, T),
        landmark_position=point,
        landmark_distance=np.where(given, landmarks["landmark_distance"].values[origin], 0.0),
        landmark_name=np.where(given, landmarks["landmark_name"].values[origin], ""),
        landmark_curve=curve[origin],
        landmark_closed=closed[origin],
    )


def with_landmarks(
    mesh: xr.Dataset,
    landmarks: xr.Dataset | Path | str,
    *,
    coordinate_system: str | None = None,
    unit: str | None = None,
) -> xr.Dataset:
    """Add landmarks that guide the registration of a mesh.

    Landmarks of two shapes are paired by name.  They guide the rigid alignment, the initial map for
    large pose differences, and the elastic iterations (:mod:`s4a.method.elastic`).  Points of
    curves are not paired and are ignored.

    Parameters
    ----------
    mesh : Dataset
        Clean mesh, see :func:`s4a.read_shape` and :func:`s4a.clean`.
    landmarks : Dataset or path
        A landmark file, or what :func:`s4a.input.annotations.read_landmarks` returns.
    coordinate_system, unit : str, optional
        For landmarks that state none (:mod:`s4a.input.coordinates`).

    Returns
    -------
    Dataset
        The mesh with the variables of :func:`locate`, named ``guide_name(guide)``,
        ``guide_position`` and so on.  Landmarks named ``landmark_name`` are transferred and
        compared, and do not guide.

    Raises
    ------
    ValueError
        If the file cannot be read, there is no landmark, two have the same name, or one is farther
        from the surface than 3 % of sqrt(area).

    See Also
    --------
    with_features : guide the registration by scalar fields.
    transfer_landmarks : transfer landmarks to all shapes of a study.

    Examples
    --------
    >>> import s4a
    >>> from s4a.schema import dataset
    >>> mesh = s4a.synthetic.ellipsoid(200)
    >>> top = dataset(landmark_name=["top"], landmark_position=mesh["position"].values[:1])
    >>> s4a.with_landmarks(mesh, top)["guide_name"].values.tolist()
    ['top']
    """
    points = with_system(as_landmarks(landmarks), coordinate_system, unit)
    what = "landmarks" if isinstance(landmarks, xr.Dataset) else shown(landmarks)
    if "landmark_curve" in points:
        points = points.isel(landmark=points["landmark_curve"].values == "")
        points = points.drop_vars(["landmark_curve", "landmark_closed"])
    names = points["landmark_name"].values.tolist()
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated or not names:
        raise ValueError(
            f"{what}: landmarks with unique names needed, found "
            + (f"{repeated[0]!r} {names.count(repeated[0])} times" if repeated else "none")
        )
    located = locate(points, mesh)
    guides = {str(name).replace("landmark", "guide"): located[name].values for name in located}
    return mesh.drop_dims("guide", errors="ignore").merge(dataset(None, **guides))


def unpaired(meshes: Mapping[str, xr.Dataset], known: Iterable[str] | None = None) -> list[str]:
    """Remarks on guiding landmarks with a name that no other mesh, or none of `known`, has."""
    names = {n: m["guide_name"].values.tolist() for n, m in meshes.items() if "guide_name" in m}
    count = Counter(itertools.chain(*names.values()))
    paired = {x for x in count if count[x] > 1} if known is None else {*known}
    alone = {n: ", ".join(x for x in found if x not in paired) for n, found in names.items()}
    texts = "; ".join(f"{n}: {found}" for n, found in alone.items() if found)
    return [f"landmarks without a partner of that name are ignored ({texts})"] if texts else []


def guides_of(mesh: xr.Dataset) -> xr.Dataset:
    """Return the landmarks that guide the registration of a mesh, for :func:`with_landmarks`."""
    return dataset(
        landmark_name=mesh["guide_name"].values, landmark_position=mesh["guide_position"].values
    )
