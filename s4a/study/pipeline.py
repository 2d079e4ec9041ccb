"""The whole analysis (4, 6.1): the steps of the paper, one after the other, over a collection.

Every step takes the keys of the files that it is made from and gives those of its own.  A key is
a hash of all that a file depends on; the files are in the folder of the run, and what computes one
of them is in :mod:`s4a.study.tasks`.
"""

import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from joblib import effective_n_jobs, parallel_config

from s4a.input.collection import passed_over
from s4a.input.plausibility import median_size
from s4a.input.subjects import read_table
from s4a.method.network import choose_pairs, spectral_distance
from s4a.method.pca import pca
from s4a.study.options import Options, takes_options
from s4a.study.report import write_report
from s4a.study.runner import Run, Task
from s4a.study.sources import Collection, Sources, find_sources
from s4a.study.store import (
    arrays,
    attributes,
    is_done,
    lock,
    read,
    task_key,
    write,
)
from s4a.study.tasks import (
    align_shape,
    clean_shape,
    compare_shape,
    consistent_maps,
    map_pairs,
    register_shape,
    remesh_shape,
)
from s4a.study.tree import open_study, stack_registration, template_mesh

log = logging.getLogger(__name__)

Keys = dict[str, str]  # name of a shape, or file of several -> key of what was computed


@takes_options
def analyse(
    shapes: Collection,
    *,
    store: Path | str | None = None,
    n_jobs: int | None = None,
    **options: Any,
) -> xr.DataTree:
    """From a collection of meshes to a median shape, dense correspondences and modes.

    Parameters
    ----------
    shapes : path, list of paths, dict or xarray.DataTree
        A folder, a glob, files, or meshes in memory: name -> Dataset or (points, triangles), or
        what :func:`s4a.read_shapes` gives.
    n_coarse : int
        Vertices of the low-resolution meshes (4.1).
    n_pairs : int
        Pairs of the network, each with maps both ways; all pairs where there are fewer (5.1).
    k_init, k : int
        Sizes of the first and of the refined maps.
    n_latent : int, optional
        Dimension of the latent space; k by default.
    step : int
        Growth of the maps per round of Consistent ZoomOut.
    init : {"dense", "landmarks"}, optional
        First maps from all nearest neighbours after ICP (default), or the paper's fit on 10
        landmarks.  Of pairs in far poses the former are replaced, see :func:`s4a.match_pair`.
    refine : {"joint", "intrinsic"}, optional
        Registration with joint rounds (default), or the paper's spectral match alone.
    how : {"ours", "standard"}, optional
        Full resolution by eq. 7 (default), or by eq. 3 and 4; with joint rounds that match is one
        candidate among others.
    norm : {"h2", "h1", "frobenius"}
        Norm of eq. 5, see :func:`s4a.method.median.distance_to_identity`.
    scale : bool
        Whether size is taken out of the displacements.
    components, strict, close_holes, intersections, pattern
        See :func:`s4a.read_shapes`.
    wrap : bool
        Whether shapes are wrapped watertight before they are remeshed.
    preset : {None, "paper"}
        ``"paper"`` sets init="landmarks", refine="intrinsic", how="ours"; another value of these is
        refused.
    template : str, optional
        Name of the shape to register to; the median shape by default.
    table : path, optional
        CSV with a column ``shape`` and covariates or groups, see
        :func:`s4a.input.subjects.read_table`; they become ``/subjects``, so that
        :mod:`s4a.analysis.statistics` takes their names.  Nothing else depends on it.  Without one,
        a table given to an earlier run stays.
    store : path, optional
        Folder of the study.  A run that was killed goes on at the first missing file.
    n_jobs : int, optional
        Processes, as in joblib: -1 for all cores given to this process.  The result does not depend
        on it.
    seed : int

    Returns
    -------
    xarray.DataTree
        The study: ``/original``, ``/coarse``, ``/network``, ``/latent``, ``/registration``,
        ``/pca``, ``/report`` and, with a table, ``/subjects``.

    Raises
    ------
    ValueError
        When an option is out of range, or fewer than 2 shapes can be used; the reasons are named.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.analyse(s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3)
    >>> list(study["pca"]["score"].dims), study["registration"].sizes["vertex"]
    (['shape', 'component'], 200)
    """
    if store is None:
        with tempfile.TemporaryDirectory(prefix="s4a-") as folder:
            study = analyse(shapes, store=folder, n_jobs=n_jobs, **options)
            loaded = {n.path: n.to_dataset(inherit=False).load() for n in study.subtree}
            return xr.DataTree.from_dict(loaded)
    settings = Options(**options)
    sources = find_sources(shapes, settings.pattern)
    remarks = passed_over(shapes, settings.pattern)
    settings.check_against(list(sources))
    subjects = None if settings.table is None else read_table(settings.table, list(sources))
    with lock(store) as claim:
        run = Run(claim, n_jobs)
        if subjects is not None:
            write(subjects, run.folder / "subjects.nc")
        run_steps(run, sources, settings, remarks)
    return open_study(store)


def run_steps(run: Run, sources: Sources, options: Options, remarks: list[str]) -> None:
    """All steps of the paper in turn; each looks up which of its files are done."""
    # what each file is made from; a key holds the keys of all before it:
    #
    #   original/* -> coarse/* -> network/motion_* -> network/first_* -> network, latent
    #       |                                                                  |
    #   network/look_*                               registration/* <- registration
    #                                                     |
    #                                                pca, report
    original = read_and_clean(run, sources, options)
    check_plausibility(run, original, options)
    coarse = remesh(run, original, options)
    spectra = lowest_eigenvalues(run, coarse, options.k_init)
    aligned = align(run, coarse, spectra)
    first = first_maps(run, coarse, spectra, aligned, options)
    latent = consistent_zoomout(run, coarse, first, options)
    registered = register(run, coarse, latent, options)
    why_no_modes = modes(run, registered)
    write_report(run, sources, options, remarks, why_no_modes, registered)


def read_and_clean(run: Run, sources: Sources, options: Options) -> Keys:
    """The shapes, cleaned (5.1): ``/original``."""
    cleaning = {name: getattr(options, name) for name in ("components", "strict", "close_holes")}
    todo = [
        Task(n, f"original/{n}.nc", clean_shape, (source, cleaning), (content, cleaning))
        for n, (source, content) in sources.items()
    ]
    return run.do("read and clean", todo)


def check_plausibility(run: Run, original: Keys, options: Options) -> None:
    """Each shape beside that of median size; the report says what is not plausible."""
    if len(original) < 2:
        return
    areas = {n: attributes(run.folder / f"original/{n}.nc")["area"] for n in original}
    reference = median_size(areas)
    settings = (reference, options.intersections)
    reference_key = task_key(original[reference], *settings)
    todo = [
        Task(
            n,
            f"network/look_{n}.nc",
            compare_shape,
            (run.folder, n, *settings),
            (reference_key, key),
        )
        for n, key in original.items()
    ]
    run.do("compare", todo, each=False)


def remesh(run: Run, original: Keys, options: Options) -> Keys:
    """Low-resolution meshes and their spectra (4.1, step 1): ``/coarse``."""
    settings = (options.n_coarse, options.wrap, options.seed, options.k)
    todo = [
        Task(n, f"coarse/{n}.nc", remesh_shape, (run.folder, n, *settings), (key, settings), (key,))
        for n, key in original.items()
    ]
    coarse = run.do("remesh and spectrum", todo)
    if len(coarse) < 2:
        reasons = "; ".join(f"{name}: {why}" for name, why in run.failures.items())
        raise ValueError(
            f"an analysis needs at least 2 usable shapes, found {len(coarse)} "
            f"({reasons or 'only one was given'})"
        )
    if options.template in run.failures:
        why = run.failures[options.template]
        raise ValueError(f"template {options.template!r} cannot be used: {why}")
    return coarse


def lowest_eigenvalues(run: Run, coarse: Keys, k_init: int) -> np.ndarray:
    """The `k_init` lowest eigenvalues of every shape (n, k_init); fewer where a shape has fewer."""
    spectra = [arrays(run.folder / f"coarse/{name}.nc", "eigenvalue")[0] for name in coarse]
    k_init = min(k_init, *map(len, spectra))
    return np.stack([spectrum[:k_init] for spectrum in spectra])


def align(run: Run, coarse: Keys, spectra: np.ndarray) -> str:
    """All shapes moved onto the one whose spectrum is nearest to all others (4.1, step 2).

    Returns
    -------
    str
        The key that all motions depend on.
    """
    names = list(coarse)
    reference = names[int(np.argmin(spectral_distance(spectra).sum(1)))]
    aligned = task_key(list(coarse.values()), names, reference)
    todo = [
        Task(n, f"network/motion_{n}.nc", align_shape, (run.folder, n, reference), (aligned, n))
        for n in names
    ]
    run.do("align", todo, each=False)
    return aligned


def first_maps(run: Run, coarse: Keys, spectra: np.ndarray, aligned: str, options: Options) -> Keys:
    """The pairs of the network, of like spectra, and their first maps (4.1, steps 3 and 4)."""
    names, k_init = list(coarse), spectra.shape[1]
    pairs = choose_pairs(spectral_distance(spectra), options.n_pairs)
    batches = in_batches([[names[i], names[j]] for i, j in pairs])
    settings = (k_init, options.init)
    files = {f"network/first_{i:03d}.nc": batch for i, batch in enumerate(batches)}
    todo = [
        Task(f, f, map_pairs, (run.folder, batch, *settings), (aligned, batch, *settings))
        for f, batch in files.items()
    ]
    return run.do("first maps", todo, each=False)


def in_batches(pairs: Sequence) -> list:
    """The pairs in batches for the tasks of the first maps: four in each, or 64 batches.

    Examples
    --------
    >>> from s4a.study.pipeline import in_batches
    >>> [len(batch) for batch in in_batches(range(10))]
    [4, 4, 2]
    """
    size = max(4, -(-len(pairs) // 64))
    return [pairs[i : i + size] for i in range(0, len(pairs), size)]


def consistent_zoomout(run: Run, coarse: Keys, first: Keys, options: Options) -> str:
    """Consistent ZoomOut and the median shape (4.2, eq. 5): ``/network`` and ``/latent``.

    Returns
    -------
    str
        The key of both.
    """
    settings = (options.k, options.step, options.n_latent, options.norm)
    key = task_key(list(first.values()), *settings)
    if is_done(run.folder / "network.nc", key) and is_done(run.folder / "latent.nc", key):
        return key
    with run.stage("consistent ZoomOut and median"):
        maps = xr.concat([read(run.folder / file) for file in first], dim="pair")
        with parallel_config(backend="threading"):  # here, whatever backend the tasks run on
            n_threads = effective_n_jobs(run.n_jobs)
        net, latent = consistent_maps(run.folder, list(coarse), maps, options, n_threads)
        write(net, run.folder / "network.nc", key, coarse.values())
        write(latent, run.folder / "latent.nc", key, coarse.values())
    return key


def register(run: Run, coarse: Keys, latent: str, options: Options) -> Keys:
    """Every shape registered to the template, the median shape by default (4.2, eq. 6 to 8)."""
    template = options.template or attributes(run.folder / "latent.nc")["median"]
    way = (template, options.how, options.refine, options.scale)
    template_key = task_key(latent, way)
    mesh = template_mesh(read(run.folder / f"original/{template}.nc"), template)
    write(mesh, run.folder / "registration.nc", template_key, [latent])
    todo = [
        Task(
            n,
            f"registration/{n}.nc",
            register_shape,
            (run.folder, n, *way),
            (template_key, key),
            (template_key,),
        )
        for n, key in coarse.items()
    ]
    return run.do("registration", todo)


def modes(run: Run, registered: Keys) -> str:
    """The modes of the displacements (6.1): ``/pca``; the reason where there can be none."""
    with run.stage("modes"):
        mesh = read(run.folder / "registration.nc")
        files = {name: read(run.folder / f"registration/{name}.nc") for name in registered}
        data = stack_registration(mesh, files, list(files))["registration"]
        coarse = read(run.folder / f"coarse/{mesh.attrs['template']}.nc")
        keys = list(registered.values())
        try:
            result = pca(data, mesh["vertex_area"].values, coarse=coarse)
        except ValueError as error:
            log.warning("no modes: %s", error)
            (run.folder / "pca.nc").unlink(missing_ok=True)
            return str(error)
        write(result, run.folder / "pca.nc", task_key(keys), keys)
    return ""
