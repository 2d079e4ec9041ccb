"""Pairwise registration (4.1): from two meshes to a correspondence."""

import logging
from contextlib import nullcontext
from typing import Any

import numpy as np
import xarray as xr
from joblib import delayed, parallel_config
from threadpoolctl import threadpool_limits

from s4a.input.collection import Mesh, as_meshes
from s4a.input.coordinates import in_one_system
from s4a.method import fmap
from s4a.method.alignment import align_onto, alignment_residual, less_confident
from s4a.method.initial_map import initial_map
from s4a.method.network import in_threads
from s4a.method.refined_eigenfunctions import low_resolution
from s4a.method.register import identity, refine_at_full_resolution, register
from s4a.method.shape import Shape
from s4a.options import Options, given_options
from s4a.schema import check_type, dataset
from s4a.study.processes import limited, workers
from s4a.study.quality_control import check_pair
from s4a.study.tree import stack_registration, template_mesh

log = logging.getLogger(__name__)


def match_pair(
    source: Mesh,
    target: Mesh,
    *,
    preset: str | None = None,
    keep_iterations: bool = False,
    n_jobs: int | None = None,
    **options: Any,
) -> xr.Dataset:
    """Match two shapes at full resolution (4.1).

    If poses differ a lot, the search for an initial map takes 1 to 17 CPU seconds more, and each
    further map that is registered about 5.  For more than two shapes, a network
    (:func:`s4a.analyse`) is more reliable.  Landmarks added by :func:`s4a.with_landmarks` guide
    every step.

    Parameters
    ----------
    source, target : path or xarray.Dataset
        Mesh files, or clean meshes, such as :func:`s4a.read_shape` returns.
    preset : {None, "paper", "fast"}
        ``"paper"`` uses the method of 4.1 without additions; ``"fast"`` sets n_coarse=3000.  None
        uses the defaults of S4A.
    keep_iterations : bool
        Whether to return map and match of every iteration of ZoomOut, and the descriptors of the
        initial map.
    n_jobs : int, optional
        Number of threads, as in joblib: -1 for all cores, None for one.  The result does not depend
        on it.
    **options
        Those of :class:`s4a.Options` that apply to pairs, such as ``n_coarse``, ``k``, ``refine``
        and ``seed`` (or ``rng``); the message about another one lists them.

    Returns
    -------
    xarray.Dataset
        The target takes the role of the template.  The main variables are

        - ``match(vertex)``: matched vertex of the source for each vertex of the target;
        - ``displacement(vertex, xyz)``: from the target to the source after rigid alignment, in the
          unit of the input;
        - ``template_triangle(original_vertex)`` and ``template_barycentric``: inverse match, the
          triangle and barycentric coordinates on the target for each vertex of the source;
        - ``fmap(eigenpair_target, eigenpair_source)``: functional map after ZoomOut;
        - ``fmap_initial``: initial functional map;
        - ``fmap_fitted``: initial functional map before its ZoomOut iteration;
        - ``landmark_of_source(landmark)`` and ``landmark_of_target``: vertices of the landmarks,
          and ``descriptor_energy`` and ``laplacian_energy``, the terms of the fit, if the initial
          map was fitted to landmarks;
        - ``iteration_fmap(iteration, eigenpair_target, eigenpair_source)`` and
          ``iteration_match(iteration, low_vertex)``: map and match of every iteration of ZoomOut,
          with ``keep_iterations=True``.

        :func:`s4a.method.register.register` describes the other variables.  The attributes are

        - ``score``: registration score, lower is better
          (:func:`s4a.method.spectral_icp.registration_score`);
        - ``initialisation``: name of the initialisation with the best score;
        - ``status`` and ``warning``: "flagged" if the registration is probably wrong, else "ok",
          and the reason (:func:`s4a.study.quality_control.check_pair`); a warning is also logged;
        - ``initial_map``: method of the initial map, "landmarks", "dense", "icp", "hks" or "wks";
        - ``note``: the reduced k, if k was reduced.

    Raises
    ------
    ValueError
        If a mesh lacks variables, the coordinate system of one mesh only is known, or an option is
        out of range or contradicts the preset.

    See Also
    --------
    analyse : Analyse a collection.
    compare : Compare matching algorithms on a pair.

    References
    ----------
    S. Melzi, J. Ren, E. Rodolà, A. Sharma, P. Wonka and M. Ovsjanikov (2019), ZoomOut: spectral
    upsampling for efficient shape correspondence, ACM Transactions on Graphics 38(6).

    Examples
    --------
    A shape and its rotation by 90 degrees:

    >>> import s4a
    >>> mesh = s4a.synthetic.ellipsoid(200)
    >>> rotated = mesh.assign(position=mesh["position"][:, [1, 0, 2]] * [-1, 1, 1])
    >>> pair = s4a.match_pair(mesh, rotated, n_coarse=100, k=10, k_init=6)
    >>> pair["fmap"].shape, bool((abs(pair["displacement"]) < 1e-6).all())
    ((10, 10), True)

    Colours of one brain transferred to another:

    >>> brains = s4a.synthetic.brains(2, 3000)["original"]
    >>> source, target = (mesh.to_dataset() for mesh in brains.children.values())
    >>> match = s4a.match_pair(source, target, n_coarse=600, k=40)["match"].values
    >>> colors = s4a.show.draw.position_colors(source["position"].values)
    >>> s4a.show.charts.surfaces(
    ...     {"source": source, "target": target}, {"source": colors, "target": colors[match]}
    ... )
    <TiledFigure ...>
    """
    settings = given_options({"preset": preset, **options}, pair=True)
    settings = settings.changed({"keep_iterations": keep_iterations})
    meshes = as_meshes({"source": source, "target": target}, settings)
    n_threads = limited(n_jobs)
    with nullcontext() if n_jobs is None else parallel_config("threading", n_jobs=n_threads):
        M, N = in_threads(lambda mesh: shape_of(mesh, settings), meshes.values())
        with threadpool_limits(1):
            registration, maps = match_shapes(M, N, settings)
    least = min(M.low.k, N.low.k)
    if least < settings.k:
        note = f"k = {settings.k} reduced to {least}, the eigenfunctions that the smaller mesh has"
        registration.attrs["note"] = note
        log.warning("%s", note)
    log_warning(registration, "the pair")
    maps["match"] = registration["registered_match"].variable
    return maps.merge(registration.drop_vars("registered_match")).assign_attrs(registration.attrs)


def shape_of(mesh: xr.Dataset, options: Options) -> Shape:
    """Make the shape of a mesh, with low resolution and eigenfunctions."""
    with threadpool_limits(1):  # matrices are small: more BLAS threads take longer
        low = low_resolution(mesh, **options.of("low resolution"))
        return Shape(mesh, low, **options.of("projection"))


def match_shapes(source: Shape, target: Shape, options: Options) -> tuple[xr.Dataset, xr.Dataset]:
    """Match two shapes: steps 2 to 4 of 4.1, ZoomOut, eq. 4 and elastic iterations.

    Returns
    -------
    registration : Dataset
        See :func:`s4a.method.register.register`.
    maps : Dataset
        ``fmap``, ``fmap_initial``, ``fmap_fitted`` and landmarks, if any.
    """
    M = source.low
    N = target.low
    k = min(options.k, M.k, N.k)
    k_init = min(options.k_init, k)
    aligned = align_onto(M, N, options.alignment)
    transform = aligned.transform
    given: dict[str, Any] = {"k_init": k_init, "init": options.init, "alignment": options.alignment}
    given["initial_refinement"] = options.initial_refinement == "always"
    initial = initial_map(M, N, transform, search=True, **given)
    # of several initial maps the one with the lowest product of its score and the final one
    registration, C, kept, initial = min(
        (
            (*_complete(source, target, one, transform, k, options), one)
            for one in (initial, *initial.others)
        ),
        key=lambda found: found[0].attrs["score"] * found[-1].score,
    )
    if aligned.ambiguity:
        log.warning("%s", aligned.ambiguity)
    registration = less_confident(registration, len(aligned.fits))
    residual = alignment_residual(M, N, transform)
    maps = dataset(
        fmap=C, fmap_initial=initial.C, fmap_fitted=initial.fitted, icp_residual=residual
    )
    if initial.landmarks is not None:
        at_source, at_target = initial.landmarks
        maps = maps.merge(dataset(landmark_of_source=at_source, landmark_of_target=at_target))
        maps = maps.merge(initial.fit_to_landmarks(options.keep_iterations))
    if kept:
        sizes = [len(c) for c, _ in kept]
        padded = [np.pad(c, (0, k - len(c)), constant_values=np.nan) for c, _ in kept]
        matches = np.stack([match for _, match in kept]).astype(np.int32)
        iterations = dataset(
            iteration_size=sizes, iteration_fmap=np.stack(padded), iteration_match=matches
        )
        maps = maps.merge(iterations)
    attrs = {"initial_map": initial.name, "ambiguity": aligned.ambiguity}
    distortion = float(np.abs(registration["distortion"].values).mean())
    n = min(len(source.full.X), len(target.full.X))
    attrs |= check_pair(registration.attrs["score"], distortion, n, options)
    return registration.assign_attrs(attrs), maps


def _complete(source, target, initial, transform, k, options):
    """Registration from an initial map, functional map ``(k, k)``, and those of all iterations."""
    M, N = source.low, target.low
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    keep = (lambda *pair: kept.append(pair)) if options.keep_iterations else None
    C, match = fmap.zoomout(M, N, initial.C, k, step=options.step, keep=keep)

    def refined(C):
        for _ in range(options.full_resolution_iterations):
            C = refine_at_full_resolution(
                source, target, C, source.full.Phi if source.has_refined_eigenfunctions else None
            )
        return C

    def registered(C):
        matches = {"intrinsic": match, "icp": initial.near}
        functions = source.functions(C.T), target.functions(np.eye(k))  # eq. 4: rows of both
        given = options.of("registration")
        return register(source, target, matches, functions, transform, k=k, **given)

    if options.refine == "elastic":  # without the functions of the refined map
        C, registration = in_threads(lambda step: step(C), (refined, registered))
    else:
        C = refined(C)
        registration = registered(C)
    return registration, C, kept


def match_both(
    shape: Shape, template: Shape, options: Options
) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Register a shape to a template and, with `bidirectional`, the template to the shape."""
    with threadpool_limits(1):
        forth = match_shapes(shape, template, options)[0]
        return forth, match_shapes(template, shape, options)[0] if options.bidirectional else None


def log_warning(registration: xr.Dataset, name: str) -> None:
    """Log the warning of a registration of :func:`match_shapes`, if it has one."""
    if registration.attrs["warning"]:
        log.warning(
            "%s is %s: %s", name, registration.attrs["status"], registration.attrs["warning"]
        )


def register_pairs(
    template: Mesh,
    shapes: dict[str, Mesh],
    *,
    name: str = "template",
    n_jobs: int | None = None,
    preset: str | None = None,
    **options: Any,
) -> xr.DataTree:
    """Register a template to each shape without a network (6.2), for transfer.

    Parameters
    ----------
    template : path or Dataset
        Mesh file, or clean mesh, such as :func:`s4a.read_shape` returns.
    shapes : dict of str to path or Dataset
        Name -> mesh file, or clean mesh.
    name : str
        Name of the template.
    n_jobs : int, optional
        Number of parallel processes, as in joblib: -1 for all cores, None for one.  The result does
        not depend on it.
    preset : {None, "paper", "fast"}
        Presets of :func:`s4a.match_pair`.  ``"paper"`` also sets bidirectional=False, and blur=0 in
        :func:`s4a.transfer_labels`.
    **options
        Options of :func:`s4a.match_pair`, and ``bidirectional``.  By default, each pair is matched
        in both directions, and a transfer averages both.  :class:`s4a.Options` describes them.

    Returns
    -------
    DataTree
        A study with the nodes

        - ``/original``: meshes of the template and of the shapes;
        - ``/registration``: registration of each shape to the template; the attributes ``status``
          and ``warning`` of ``/registration/NAME`` flag registrations that are probably wrong, as
          in :func:`s4a.match_pair`;
        - ``/reverse``: registration of the template to each shape, with `bidirectional`.

    Raises
    ------
    ValueError
        If a shape has the name of the template, a mesh lacks a variable, the coordinate systems of
        some meshes only are known, or an option is out of range or contradicts the preset.

    See Also
    --------
    match_pair : Match one pair.
    s4a.analyse : Register a collection by a network.
    s4a.transfer_labels, s4a.transfer_scalars, s4a.transfer_landmarks : Use the registrations.

    Examples
    --------
    >>> import s4a
    >>> brains = s4a.synthetic.brains(6, 200)
    >>> source = brains["original/brain_01"].to_dataset()
    >>> target = brains["original/brain_02"].to_dataset()
    >>> pairs = s4a.register_pairs(source, {"brain_02": target}, n_coarse=100, k_init=6, k=10)
    >>> s4a.transfer_labels(pairs, source["label"].values)["brain_02"]["label"].sizes["vertex"]
    200
    """
    check_type(shapes, dict, "shapes")
    if name in shapes or not shapes:
        raise ValueError(
            f"shapes other than the template {name!r} are needed; found "
            f"{', '.join(shapes) or 'none'}"
        )
    settings = given_options({"preset": preset, **options}, pair=True)
    meshes = as_meshes({name: template, **shapes}, settings)
    parallel = workers(n_jobs)
    inside, *others = parallel(delayed(shape_of)(mesh, settings) for mesh in meshes.values())
    pairs = parallel(delayed(match_both)(shape, inside, settings) for shape in others)
    forth, back = (dict(zip(shapes, side, strict=True)) for side in zip(*pairs, strict=True))
    back = back if settings.bidirectional else {}
    for words, side in (("", forth), (" in reverse", back)):
        for n, registration in side.items():
            log_warning(registration, f"{n}{words}")
    study = _study_of(name, meshes.pop(name), meshes, forth, back)
    study["registration"].attrs["preset"] = settings.preset or ""
    return study


def pair_study(result: xr.Dataset, source: xr.Dataset, target: xr.Dataset) -> xr.DataTree:
    """Convert a result of :func:`s4a.match_pair` to a study, with the target as template.

    Parameters
    ----------
    result, source, target : Dataset
        The result, and the two meshes.

    Returns
    -------
    DataTree
        ``/original``, ``/registration``, for :mod:`s4a.analysis.transfer`.
    """
    registered = result.rename(match="registered_match")
    meshes = in_one_system({"source": source, "target": target})  # as the result
    return _study_of("target", meshes.pop("target"), meshes, {"source": registered}, {})


def _study_of(name, template, shapes, forth, back):
    """Registered study; `forth` are registrations of the shapes, `back` of the template."""
    meshes = {name: template, **shapes}
    nodes = {f"original/{n}": mesh for n, mesh in meshes.items()}
    files = {name: identity(Shape(template)), **forth}
    nodes |= stack_registration(template_mesh(template, name), files, list(meshes))
    return xr.DataTree.from_dict(nodes | {f"reverse/{n}": data for n, data in back.items()})
