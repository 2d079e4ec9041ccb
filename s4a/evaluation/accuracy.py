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
from s4a.method import fmap
from s4a.method.first_map import map_after_motion, nearest_after_motion
from s4a.method.register import match_functions
from s4a.method.shape import Shape
from s4a.study.processes import workers

ICP, ZOOMOUT, MATCH, SURFACE = (
    "nearest neighbour after ICP",
    "pairwise ZoomOut",
    "S4A, matched vertex",
    "S4A, registered surface",
)


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
    M = source.low
    N = target.low
    R, t, _ = align(M.X, M.area, N.X, N.area)
    near = nearest_after_motion(source.full, target.full, (R, t))
    C = map_after_motion(M, N, (R, t), k_init=k_init)
    k = min(M.k, N.k)
    C, _ = fmap.zoomout(M, N, C, k)
    match, *_ = match_functions(source, target, M.Phi[:, :k] @ C.T, N.Phi[:, :k])
    return {ICP: near, ZOOMOUT: match}


def _errors(source, target, registered, image, n_geodesic):
    """Mean errors of all methods on one shape: straight line, and geodesic where asked for."""
    with threadpool_limits(1):
        known = np.isfinite(image).all(axis=1)
        X, size = source.original["position"].values, source.frame[1]
        matches = simple_matches(source, target) | {MATCH: registered["registered_match"].values}
        straight = {
            name: np.linalg.norm(X[m] - image, axis=1)[known].mean() / size
            for name, m in matches.items()
        }
        R, t, s = (registered[v].values for v in ("rotation", "translation", "scale"))
        moved = target.original["position"].values + registered["displacement"].values
        moved = (moved - t) @ R / s
        straight[SURFACE] = np.linalg.norm(moved - image, axis=1)[known].mean() / size
        geodesic = dict.fromkeys(straight, np.nan)
        if n_geodesic:
            some = np.flatnonzero(known)[:: max(1, known.sum() // n_geodesic)]
            true = cKDTree(X).query(image[some])[1]
            T = source.original["corner_vertex"].values
            found = {name: m[some] for name, m in matches.items()}
            every = geodesic_error(
                X, T, np.concatenate([*found.values()]), np.tile(true, len(found))
            )
            geodesic |= dict(zip(found, every.reshape(len(found), -1).mean(1), strict=True))
        return straight, geodesic


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
        ``error(way, shape)`` in a straight line and ``geodesic_error(way, shape)``, both as shares
        of sqrt(area).  A matched vertex cannot be nearer to the truth than the sampling of the
        shape allows; the registered surface is not bound to vertices.
    """
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    shapes = [s for s in registration["shape"].values.tolist() if s != template]

    def shape(name):
        original, coarse = (study[s][name].to_dataset().load() for s in ("original", "coarse"))
        return Shape(original, coarse)

    keep = ["registered_match", "displacement", "rotation", "translation", "scale"]
    target = shape(template)
    found = workers(n_jobs)(
        delayed(_errors)(
            shape(s),
            target,
            registration[keep].sel(shape=s).load(),
            np.asarray(image(s, template)),
            n_geodesic,
        )
        for s in shapes
    )
    methods = [ICP, ZOOMOUT, MATCH, SURFACE]
    note = {"units": "share of sqrt(area)"}
    return xr.Dataset(
        {
            name: (("way", "shape"), [[pair[i][m] for pair in found] for m in methods], note)
            for i, name in enumerate(("error", "geodesic_error"))
        },
        {"way": methods, "shape": shapes},
    )
