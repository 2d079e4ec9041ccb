"""Landmarks and curves on a surface: where a mesh has what a file of points says (6.2, Fig. 7)."""

import numpy as np

from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays, edge_graph, edges, triangle_areas
from s4a.input.annotations import MIRROR
from s4a.schema import dataset, require

NAMED = ("landmark_name", "landmark_curve", "landmark_closed")
ROUNDS = 12  # halvings of a segment of a curve
FARTHEST_LANDMARK = (
    0.03  # of sqrt(area): a landmark farther from its surface belongs to another mesh or frame
)


def locate(landmarks, mesh, *, farthest=FARTHEST_LANDMARK):
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
        When a landmark is farther from the surface than `farthest`; it names the worst.
    """
    require(landmarks, "landmark_name", "landmark_position", what="landmarks")
    require(mesh, "position", "corner_vertex", what="mesh")
    X, T = as_arrays(mesh)
    limit = farthest * np.sqrt(triangle_areas(X, T).sum())
    P = landmarks["landmark_position"].values.astype(float)
    theirs, ours = (d.attrs.get("coordinate_system", "") for d in (landmarks, mesh))

    def placed(P):
        found = closest_point(P, X, T)
        point = interpolate(X, T, *found)
        return *found, point, np.linalg.norm(point - P, axis=1)

    found = placed(P * MIRROR if theirs and ours and theirs != ours else P)
    if theirs and not ours and found[3].max() > limit:
        found = min(found, placed(P * MIRROR), key=lambda f: f[3].max())
    triangle, weights, point, distance = found
    if distance.max() > limit:
        worst = int(distance.argmax())
        name = str(landmarks["landmark_name"].values[worst])
        raise ValueError(
            f"landmarks within {limit:.4g} of the surface needed ({100 * farthest:g} % of sqrt(area)); "
            f"{name!r} is {distance[worst]:.4g} away: is it of another mesh, unit "
            "or coordinate system (RAS, LPS)?"
        )
    return dataset(
        landmark_position=point,
        landmark_triangle=triangle.astype(np.int32),
        landmark_barycentric=weights,
        landmark_distance=distance,
        **{name: landmarks[name].values for name in NAMED if name in landmarks},
    )


def follow(P, X, T, *, closed=False, spacing):
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
    given : bool ndarray (q,)
        Which of them are those of P.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.landmarks import follow
    >>> X, T = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]])
    >>> points, given = follow(X[:2], X, T, spacing=1.5)
    >>> points[:, 0].tolist(), given.tolist()
    ([0.0, 1.0, 2.0, 3.0, 4.0], [True, False, False, False, True])
    """
    P = np.concatenate([P, P[:1]]) if closed else P
    given = np.ones(len(P), bool)
    for _ in range(ROUNDS):
        long = np.flatnonzero(np.linalg.norm(np.diff(P, axis=0), axis=1) > spacing)
        if not len(long):
            break
        middle = (P[long] + P[long + 1]) / 2
        P = np.insert(P, long + 1, interpolate(X, T, *closest_point(middle, X, T)), axis=0)
        given = np.insert(given, long + 1, False)
    return (P[:-1], given[:-1]) if closed else (P, given)


def traced(marked, mesh):
    """Landmarks of :func:`locate`, with the points in between of every curve.

    A vertex of the polyline for each edge.

    The points in between have no name; their curve is that of their neighbours.
    """
    X, T = as_arrays(mesh)
    spacing = edge_graph(X, edges(T)).data.mean()
    curve, closed = (marked[name].values for name in ("landmark_curve", "landmark_closed"))
    rows = [(np.flatnonzero(curve == ""), marked["landmark_position"].values[curve == ""], None)]
    for name in dict.fromkeys(curve[curve != ""].tolist()):
        own = np.flatnonzero(curve == name)
        points, given = follow(
            marked["landmark_position"].values[own],
            X,
            T,
            closed=bool(closed[own[0]]),
            spacing=spacing,
        )
        rows.append((own[np.cumsum(given) - 1], points, given))
    before = np.concatenate([index for index, *_ in rows])
    points = np.concatenate([P for _, P, _ in rows])
    given = np.concatenate([np.ones(len(i), bool) if g is None else g for i, _, g in rows])
    triangle, weights = closest_point(points, X, T)
    return dataset(
        landmark_name=np.where(given, marked["landmark_name"].values[before], ""),
        landmark_curve=curve[before],
        landmark_closed=closed[before],
        landmark_position=points,
        landmark_triangle=triangle.astype(np.int32),
        landmark_barycentric=weights,
        landmark_distance=np.where(given, marked["landmark_distance"].values[before], 0.0),
    )
