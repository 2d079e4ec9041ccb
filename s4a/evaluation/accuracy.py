"""Accuracy (5.2): how far a registration is from a known truth.

Two simpler ways to the same correspondence stand beside it.
"""

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
from s4a.method.register import match_functions
from s4a.method.shape import Shape
from s4a.study.processes import workers

ICP, ZOOMOUT = "nearest neighbour after ICP", "pairwise ZoomOut"
MATCH, SURFACE = "S4A, matched vertex", "S4A, registered surface"


def simple_matches(source: Shape, target: Shape, *, k_init: int = 20) -> dict[str, np.ndarray]:
    """Matches without the collection: nearest neighbour after ICP, and ZoomOut with eq. 4 (4.1).

    Parameters
    ----------
    source, target : Shape

    Returns
    -------
    dict
        Method -> int ndarray (n_target,), vertices of the source.
    """
    M, N = source.low, target.low
    R, t, _ = align(M.X, M.area, N.X, N.area)
    near = nearest_after_alignment(source.full, target.full, (R, t))
    C = map_after_alignment(M, N, (R, t), k_init=k_init).C
    k = min(M.k, N.k)
    C, _ = fmap.zoomout(M, N, C, k)
    match, *_ = match_functions(source, target, M.Phi[:, :k] @ C.T, N.Phi[:, :k])
    return {ICP: near, ZOOMOUT: match}


def _errors(source, target, registered, image, n_geodesic):
    """Mean errors of all methods on one shape: straight line, and geodesic where asked for."""
    known = np.isfinite(image).all(axis=1)
    (X, T), size = as_arrays(source.original), source.frame[1]
    with threadpool_limits(1):
        matches = simple_matches(source, target) | {MATCH: registered["registered_match"].values}
        R, t, s = (registered[v].values for v in ("rotation", "translation", "scale"))
        moved = target.original["position"].values + registered["displacement"].values
        images = {name: X[match] for name, match in matches.items()}
        images[SURFACE] = (moved - t) @ R / s
        errors = {
            name: [np.linalg.norm(found - image, axis=1)[known].mean() / size, np.nan]
            for name, found in images.items()
        }
        if n_geodesic:
            some = np.flatnonzero(known)[:: max(1, known.sum() // n_geodesic)]
            true = cKDTree(X).query(image[some])[1]
            found = np.concatenate([match[some] for match in matches.values()])
            far = geodesic_error(X, T, found, np.tile(true, len(matches)))
            for name, each in zip(matches, far.reshape(len(matches), -1), strict=True):
                errors[name][1] = each.mean()
    return list(errors.values())


def accuracy(
    study: xr.DataTree,
    image: Callable[[str, str], np.ndarray],
    *,
    n_geodesic: int = 0,
    n_jobs: int | None = None,
) -> xr.Dataset:
    """Mean error of a study's registrations against the truth, beside two baselines.

    Parameters
    ----------
    study : xarray.DataTree
        A finished study.
    image : callable
        ``image(shape, template)`` gives the true position of every template vertex on the shape, in
        the frame of its file, ``(n_template, 3)``; NaN where it has none.
    n_geodesic : int
        On how many vertices the error is measured along the edges of the shape as well (Princeton
        protocol, between the vertex nearest to the truth and the matched one); slow.
    n_jobs : int, optional
        As in joblib.

    Returns
    -------
    xarray.Dataset
        ``error(algorithm, shape)`` in a straight line and ``geodesic_error(algorithm, shape)``,
        both as shares of sqrt(area).  A matched vertex cannot be nearer to the truth than the
        sampling of the shape allows; the registered surface is not bound to vertices.
    """
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    names = [name for name in registration["shape"].values.tolist() if name != template]
    keep = ["registered_match", "displacement", "rotation", "translation", "scale"]

    def shape(name):
        original, coarse = (study[s][name].to_dataset().load() for s in ("original", "coarse"))
        return Shape(original, coarse)

    target = shape(template)
    found = workers(n_jobs)(
        delayed(_errors)(
            shape(name),
            target,
            registration[keep].sel(shape=name).load(),
            np.asarray(image(name, template)),
            n_geodesic,
        )
        for name in names
    )
    both = np.array(found).reshape(len(names), 4, 2).T  # (measure, method, shape)
    note = {"units": "share of sqrt(area)"}
    return xr.Dataset(
        {"error": (("algorithm", "shape"), both[0], note)}
        | {"geodesic_error": (("algorithm", "shape"), both[1], note)},
        {"algorithm": [ICP, ZOOMOUT, MATCH, SURFACE], "shape": names},
    )
