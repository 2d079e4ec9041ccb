"""Accuracy of registrations with known ground truth (5.2), compared with two baselines."""

from collections.abc import Callable

import numpy as np
import xarray as xr
from joblib import delayed
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from s4a.evaluation.metrics import geodesic_error
from s4a.geometry.align import align
from s4a.geometry.mesh import as_arrays
from s4a.method import fmap
from s4a.method.initial_map import map_after_alignment, nearest_after_alignment
from s4a.method.nearest import nearest_of_few
from s4a.method.shape import Shape
from s4a.schema import Array
from s4a.study.processes import workers

ICP, ZOOMOUT = "nearest neighbour after ICP", "pairwise ZoomOut"
MATCH, SURFACE = "S4A, matched vertex", "S4A, registered surface"


def simple_matches(
    source: Shape, target: Shape, vertex: Array, *, k_init: int = 20
) -> dict[str, Array]:
    """Return baseline matches: nearest neighbour after ICP, and ZoomOut with eq. 4 (4.1).

    Parameters
    ----------
    source, target : Shape
    vertex : int ndarray (v,)
        Vertices of the target to match.

    Returns
    -------
    dict
        Method -> int ndarray (v,), vertices of the source.
    """
    M, N = source.low, target.low
    R, t, _ = align(M.cloud, N.cloud)
    near = nearest_after_alignment(source.full, target.full, (R, t))
    C = map_after_alignment(M, N, (R, t), k_init=k_init).C
    k = min(M.k, N.k)
    C, _ = fmap.zoomout(M, N, C, k)
    queries, rows = target.full.extend(N.Phi[:, :k]), source.full.extend(M.Phi[:, :k] @ C.T)
    return {ICP: near[vertex], ZOOMOUT: nearest_of_few(queries[vertex], rows, source.cell)}


def _errors(source, target, registered, image, n_vertices, n_geodesic):
    """Mean Euclidean errors of all methods on one shape, and geodesic ones if requested."""
    known = np.flatnonzero(np.isfinite(image).all(axis=1))
    vertex = known[:: max(1, len(known) // (n_vertices or len(image)))]
    image = image[vertex]
    (X, T), size = as_arrays(source.original), source.frame[1]
    with threadpool_limits(1):
        matches = simple_matches(source, target, vertex)
        matches[MATCH] = registered["registered_match"].values[vertex]
        R, t, s = (registered[v].values for v in ("rotation", "translation", "scale"))
        moved = target.original["position"].values + registered["displacement"].values
        images = {name: X[match] for name, match in matches.items()}
        images[SURFACE] = (moved[vertex] - t) @ R / s
        errors = {
            name: [np.linalg.norm(X_image - image, axis=1).mean() / size, np.nan]
            for name, X_image in images.items()
        }
        if n_geodesic:
            sample = np.arange(0, len(vertex), max(1, len(vertex) // n_geodesic))
            true = cKDTree(X).query(image[sample])[1]
            matched = np.concatenate([match[sample] for match in matches.values()])
            error = geodesic_error(X, T, matched, np.tile(true, len(matches)))
            for name, row in zip(matches, error.reshape(len(matches), -1), strict=True):
                errors[name][1] = row.mean()
    return list(errors.values())


def accuracy(
    study: xr.DataTree,
    image: Callable[[str, str], Array],
    *,
    n_vertices: int | None = None,
    n_geodesic: int = 0,
    n_jobs: int | None = None,
) -> xr.Dataset:
    """Return mean errors of a study's registrations, compared with two baselines.

    Parameters
    ----------
    study : xarray.DataTree
        A finished study.
    image : callable
        ``image(shape, template)`` gives the true position of every template vertex on the shape, in
        the frame of its file, ``(n_template, 3)``; NaN if unknown.
    n_vertices : int, optional
        Number of vertices, evenly spaced in their order, whose errors are averaged; all by default.
    n_geodesic : int
        Number of vertices at which geodesic errors along edges are computed as well (Princeton
        protocol, between the vertex nearest to the true position and the matched one); slow.
    n_jobs : int, optional
        As in joblib.

    Returns
    -------
    xarray.Dataset
        Euclidean ``error(algorithm, shape)`` and ``geodesic_error(algorithm, shape)``, both as
        shares of sqrt(area).  A vertex-to-vertex match cannot be more accurate than the vertex
        spacing; the registered surface can.

    See Also
    --------
    s4a.metrics.evaluate : all metrics of one correspondence.
    """
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    names = [name for name in registration["shape"].values.tolist() if name != template]
    keep = ["registered_match", "displacement", "rotation", "translation", "scale"]

    def shape(name):
        original, coarse = (study[s][name].to_dataset().load() for s in ("original", "coarse"))
        return Shape(original, coarse)

    target = shape(template)
    errors = workers(n_jobs)(
        delayed(_errors)(
            shape(name),
            target,
            registration[keep].sel(shape=name).load(),
            np.asarray(image(name, template)),
            n_vertices,
            n_geodesic,
        )
        for name in names
    )
    error, geodesic = np.array(errors).reshape(len(names), 4, 2).T  # (algorithm, shape) each
    note = {"units": "share of sqrt(area)"}
    return xr.Dataset(
        {"error": (("algorithm", "shape"), error, note)}
        | {"geodesic_error": (("algorithm", "shape"), geodesic, note)},
        {"algorithm": [ICP, ZOOMOUT, MATCH, SURFACE], "shape": names},
    )
