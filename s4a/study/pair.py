"""One pair of shapes registered on its own (4.1): the steps from two meshes to a correspondence."""

import logging

import numpy as np
import xarray as xr

from s4a.geometry.align import align
from s4a.method import fmap
from s4a.method.first_map import first_map
from s4a.method.register import register, sharpen_map
from s4a.method.remesh import coarsen
from s4a.method.shape import Shape
from s4a.method.spectral import spectrum
from s4a.schema import dataset, require
from s4a.study.options import Options

log = logging.getLogger(__name__)


def match_pair(
    source: xr.Dataset,
    target: xr.Dataset,
    *,
    k_init: int = 20,
    k: int = 100,
    init: str = "dense",
    refine: str = "joint",
    n_coarse: int = 6000,
    seed: int = 0,
) -> xr.Dataset:
    """Correspondence of two shapes at full resolution (4.1).

    Parameters
    ----------
    source, target : xarray.Dataset
        Clean meshes (``position``, ``corner_vertex``), as of :func:`s4a.read_shapes` or
        :func:`s4a.clean`.
    k_init, k : int
        Sizes of the first and of the refined functional map.
    init : {"dense", "landmarks"}
        First map from all nearest neighbours after ICP, or the paper's fit on 10 landmarks.  Where
        the former say that poses are far apart, :func:`s4a.method.first_map.best_first_map` is
        taken, which costs about 2 s more.
    refine : {"joint", "intrinsic"}
        Joint rounds after ZoomOut (default), or the paper's ZoomOut alone and eq. 4.
    n_coarse : int
        Vertices of the low-resolution meshes.
    seed : int

    Returns
    -------
    xarray.Dataset
        ``fmap(mode_target, mode_source)`` after ZoomOut, ``fmap_initial``, ``match(vertex)`` = on
        each vertex of the target the matched vertex of the source, ``displacement(vertex, xyz)``
        from the target to the source after rigid alignment (unit of the input),
        ``confidence(vertex)``, ``round_trip``, ``distortion``; ``rotation``, ``translation``,
        ``scale`` of that alignment of the source; the way back,
        ``template_triangle(original_vertex)`` and ``template_barycentric``, from the source's
        vertices to the target; attrs ``score`` (:func:`s4a.method.joint.registration_score`),
        ``method``, ``first_map`` ("landmarks", "dense", or of far poses "icp", "hks" or "wks"), and
        ``note`` where k had to be reduced.

    Raises
    ------
    ValueError
        When a mesh lacks its variables or an option is outside its range, see :func:`s4a.analyse`.

    Examples
    --------
    A shape and the same after a turn by 90 degrees:

    >>> import s4a
    >>> mesh = s4a.synthetic.ellipsoid(200)
    >>> turned = mesh.assign(position=mesh["position"][:, [1, 0, 2]] * [-1, 1, 1])
    >>> found = s4a.match_pair(mesh, turned, n_coarse=100, k=10, k_init=6)
    >>> found["fmap"].shape, bool((abs(found["displacement"]) < 1e-6).all())
    ((10, 10), True)
    """
    options = Options(k_init=k_init, k=k, init=init, refine=refine, n_coarse=n_coarse, seed=seed)
    for mesh, what in ((source, "source"), (target, "target")):
        require(mesh, "position", "corner_vertex", what=what)
    M, N = (
        Shape(mesh, spectrum(coarsen(mesh, n_coarse=n_coarse, seed=seed), k=k))
        for mesh in (source, target)
    )
    least = min(M.low.k, N.low.k)
    registration, C, C_initial = match_shapes(
        M,
        N,
        k_init=min(k_init, least),
        k=k,
        init=options.init,
        refine=options.refine,
    )
    if least < k:
        note = f"k = {k} reduced to {least}, the eigenfunctions that the smaller mesh has"
        registration.attrs["note"] = note
        log.warning("%s", note)
    match = registration["registered_match"].values
    maps = dataset(fmap=C, fmap_initial=C_initial, match=match)
    return maps.merge(registration.drop_vars("registered_match")).assign_attrs(registration.attrs)


def match_shapes(
    source: Shape,
    target: Shape,
    *,
    k_init: int = 20,
    k: int = 100,
    init: str = "dense",
    refine: str = "joint",
) -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
    """:func:`match_pair` for two shapes: steps 2 to 4 of 4.1, ZoomOut and eq. 4, joint rounds.

    Returns
    -------
    registration : Dataset
        As of :func:`s4a.method.register.register`.
    C, C_initial : float ndarray
        The final and the first functional map.
    """
    M = source.low
    N = target.low
    R, t, _ = align(M.X, M.area, N.X, N.area)
    name, C_initial, near = first_map(M, N, (R, t), k_init=k_init, init=init)
    k = min(k, M.k, N.k)
    C, match = fmap.zoomout(M, N, C_initial, k)
    C = sharpen_map(source, target, C)
    starts = {"intrinsic": match, "icp": near}
    functions = M.Phi[:, :k] @ C.T, N.Phi[:, :k]  # rows of both are compared (eq. 4)
    registration = register(source, target, starts, functions, k=k, refine=refine)
    return registration.assign_attrs(first_map=name), C, C_initial
