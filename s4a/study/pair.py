"""One pair of shapes registered on its own (4.1): the steps from two meshes to a correspondence."""

import logging

import numpy as np

from s4a.geometry.align import align
from s4a.method import fmap
from s4a.method.first_map import first_map_of
from s4a.method.register import Scan, registration, sharpened
from s4a.method.remesh import coarsen
from s4a.method.spectral import spectrum
from s4a.schema import dataset, require
from s4a.study.options import checked

log = logging.getLogger(__name__)


def match_pair(
    source, target, *, k_init=20, k=100, init="dense", refine="joint", n_coarse=6000, seed=0
):
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
        vertices to the target; attrs ``score`` (see :func:`s4a.method.joint.badness`), ``method``,
        ``first_map`` ("landmarks", "dense", or of far poses "icp", "hks" or "wks"), and ``note``
        where k had to be reduced.

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
    given = {
        "k_init": k_init,
        "k": k,
        "init": init,
        "refine": refine,
        "n_coarse": n_coarse,
        "seed": seed,
    }
    given = checked(given)
    scans = []
    for mesh, what in ((source, "source"), (target, "target")):
        require(mesh, "position", "corner_vertex", what=what)
        scans.append(Scan(mesh, spectrum(coarsen(mesh, n_coarse=n_coarse, seed=seed), k=k)))
    init, refine, least = given["init"], given["refine"], min(s.low.Phi.shape[1] for s in scans)
    found, C, C0 = match_scans(*scans, k_init=min(k_init, least), k=k, init=init, refine=refine)
    if least < k:
        found.attrs["note"] = (
            f"k = {k} reduced to {least}, the eigenfunctions that the smaller mesh has"
        )
        log.warning("%s", found.attrs["note"])
    maps = dataset(fmap=C, fmap_initial=C0, match=found["registered_match"].values)
    return maps.merge(found.drop_vars("registered_match")).assign_attrs(found.attrs)


def match_scans(source, target, *, k_init=20, k=100, init="dense", refine="joint"):
    """:func:`match_pair` for two :class:`Scan`.

    What :func:`registration` gives, the final and the first map.
    """
    M, N = source, target
    motion = align(M.low.X, M.low.area, N.low.X, N.low.area)[:2]
    first, C0, near = first_map_of(M.low, N.low, motion, k_init=k_init, init=init)
    k = min(k, M.low.Phi.shape[1], N.low.Phi.shape[1])
    C, match_low = fmap.zoomout(C0, M.low.Phi, N.low.Phi, N.low.area, k)
    C = sharpened(
        C,
        M.U.astype(np.float32) @ M.low.Phi[:, :k].astype(np.float32),
        N.low.Phi,
        N.low.area,
        M.cell,
    )
    starts = {"intrinsic": match_low, "icp": near}
    embeddings = M.low.Phi[:, :k] @ C.T, N.low.Phi[:, :k]
    found = registration(M, N, starts, embeddings, k=k, refine=refine)
    return found.assign_attrs(first_map=first), C, C0
