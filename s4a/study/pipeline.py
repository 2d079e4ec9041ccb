"""The whole analysis (4, 6.1): the steps of the paper, one after the other, over a collection.

Every step takes the keys of the files that it is made from and gives those of its own.  A key is
a hash of all that a file depends on; the files are in the folder of the run, and what computes one
of them is in :mod:`s4a.study.tasks`.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from joblib import effective_n_jobs, parallel_config

from s4a.input.chirality import AUTO, mean_chirality, mirrored_shapes, to_reflect
from s4a.input.collection import remarks_on_files
from s4a.input.plausibility import Flags
from s4a.input.subjects import read_table
from s4a.method.network import choose_pairs, spectral_distance
from s4a.method.pca import pca_without
from s4a.method.remesh import check_wrap
from s4a.options import Options, given_options
from s4a.schema import dataset
from s4a.study.netcdf import arrays, attributes, is_done, open_file, read
from s4a.study.processes import temporary_folder
from s4a.study.quality_control import (
    check_plausibility,
    check_registrations,
    check_usable,
    comparisons_of,
    exclude_flagged,
    stop_if_flagged,
)
from s4a.study.report import write_report
from s4a.study.runner import Keys, Run, Task
from s4a.study.sources import (
    Collection,
    Marked,
    Sources,
    check_one_structure,
    find_guides,
    find_sources,
    kept_table,
    of_contents,
    remarks_on_guides,
)
from s4a.study.store import lock, task_key, write
from s4a.study.tasks import (
    align_shape,
    clean_shape,
    consistent_maps,
    last_template,
    map_pairs,
    place_shape,
    register_shape,
    remesh_shape,
)
from s4a.study.tree import open_study, stack_registration, template_mesh

log = logging.getLogger(__name__)

CHOICE = "network/chirality.nc"


def analyse(
    shapes: Collection,
    *,
    preset: str | None = None,
    n_coarse: int | None = None,
    n_pairs: int | None = None,
    k: int | None = None,
    label: int | str | None = None,
    reflect: str | list[str] | None = None,
    table: Path | str | None = None,
    landmarks: Path | str | None = None,
    template: str | None = None,
    remove_size: bool | None = None,
    options: Options | None = None,
    store: Path | str | None = None,
    n_jobs: int | None = None,
    **others: Any,
) -> xr.DataTree:
    """From a collection of meshes to a median shape, dense correspondences and modes.

    Parameters
    ----------
    shapes : path, list of paths, dict or xarray.DataTree
        A folder, a glob, files, or by name a file or a mesh in memory, a Dataset or (points,
        triangles), or what :func:`s4a.read_shapes` gives.
    preset, n_coarse, n_pairs, k, label, reflect, table, landmarks, template, scale
        The options that people change; one that is not given, or as None, is that of `options`, or
        its default.  See :class:`s4a.Options`.
    options : Options, optional
        In place of the defaults.
    **others
        Every other option, by the name that it has in :class:`s4a.Options`; ``rng`` for ``seed``.
    store : path, optional
        Folder of the study.  A run that was killed goes on at the first missing file.
    n_jobs : int, optional
        Processes, as in joblib: -1 for all cores given to this process.  The result does not depend
        on it.

    Returns
    -------
    xarray.DataTree
        The study: ``/original``, ``/coarse``, ``/network``, ``/latent``, ``/registration``,
        ``/pca``, ``/report`` and, with a table, ``/subjects``.

    Raises
    ------
    ValueError
        When an option is out of range, or fewer than 2 shapes can be used; the reasons are named.
        With ``quality_control="stop"``, when a shape is flagged.
    TypeError
        When an option is given that there is not.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.analyse(s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3)
    >>> list(study["pca"]["score"].dims), study["registration"].sizes["vertex"]
    (['shape', 'component'], 200)

    The paper, and elastic iterations alone added to it:

    >>> from s4a.options import PRESETS
    >>> small = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 3}
    >>> brains = s4a.synthetic.brains(3, 200)
    >>> paper = s4a.analyse(brains, preset="paper", **small)
    >>> elastic = s4a.analyse(brains, **PRESETS["paper"] | {"refine": "elastic"}, **small)
    """
    shown = {
        "preset": preset,
        "n_coarse": n_coarse,
        "n_pairs": n_pairs,
        "k": k,
        "label": label,
        "reflect": reflect,
        "table": table,
        "landmarks": landmarks,
        "template": template,
        "remove_size": remove_size,
    }
    given = {name: value for name, value in shown.items() if value is not None}
    settings = given_options(given | others, options)
    if store is None:
        with temporary_folder() as folder:
            study = analyse(shapes, options=settings, store=folder, n_jobs=n_jobs)
            loaded = {n.path: n.to_dataset(inherit=False).load() for n in study.subtree}
            return xr.DataTree.from_dict(loaded)
    settings.check_n_samples()
    if settings.wrap:
        check_wrap()
    volumes = settings.label is not None
    sources = find_sources(shapes, settings.pattern, volumes=volumes)
    remarks = remarks_on_files(shapes, settings.pattern, volumes=volumes)
    subjects = None if settings.table is None else read_table(settings.table, list(sources))
    if subjects is not None:
        check_one_structure(subjects)
    settings.check_against(list(sources))
    marked = find_guides(sources, settings.landmarks, settings.feature_names)
    with lock(store) as claim:
        run = Run(claim, n_jobs)
        if subjects is not None:
            write(of_contents(subjects, sources), run.folder / "subjects.nc")
        else:
            remarks = remarks + kept_table(run.folder / "subjects.nc", sources)
        remarks = remarks + remarks_on_guides(sources, marked, settings.feature_names)
        with run.report_unforeseen():
            run_steps(run, sources, marked, settings, remarks)
    return open_study(store)


def run_steps(
    run: Run, sources: Sources, marked: Marked, options: Options, remarks: list[str]
) -> None:
    """All steps of the paper in turn; each looks up which of its files are done."""
    # what each file is made from; a key holds the keys of all before it:
    #
    #   original/* -> coarse/* -> network/alignment_* -> network/initial_* -> network, latent
    #       |                                                                  |
    #   network/descriptor_*, look_*  latent/* of those apart -> registration/* <- registration
    #                                                     |
    #                                                pca, report
    reflected, chirality_evidence = choose_reflected(run, sources, marked, options)
    original = read_and_clean(run, sources, marked, options, reflected)
    original, flags, told = check_plausibility(run, original, options)
    stop_if_flagged(flags, options)
    coarse = remesh(run, original, options)
    flags, coarse, apart, alone = exclude_flagged(run, coarse, flags, options)
    coarse, reference, aligned = align(run, coarse, options)
    first = initial_maps(run, coarse, aligned, options)
    latent = consistent_zoomout(run, coarse, first, options)
    placed = place(run, apart, reference, latent, options)
    registered = register(run, coarse | apart, placed, latent, options)
    failed, of_all = check_registrations(run, registered, placed)
    flags = {name: [*flags.get(name, []), *failed.get(name, [])] for name in registered}
    why_no_modes = modes(run, registered, flags, options)
    remarks = [*chirality_evidence, *alone, *told, *of_all, *remarks]
    write_report(run, sources, options, remarks, why_no_modes, registered, flags)


def read_and_clean(
    run: Run, sources: Sources, marked: Marked, options: Options, reflected: list[str]
) -> Keys:
    """The shapes, cleaned, with landmarks, some of them mirrored (5.1): ``/original``."""
    cleaning = options.of("cleaning")
    todo = []
    for n, (source, content) in sources.items():
        also: dict[str, Any] = {"reflected": True} if n in reflected else {}
        key = (content, cleaning, *also.values())
        if n in marked:
            also["guides"] = landmarks, features = marked[n]
            # wherever the files lie
            key = (*key, *([landmarks[1]] if landmarks else []))
            key = (*key, *((name, content) for name, (_, content) in features.items()))
        given = (source, content, cleaning, also)
        todo.append(Task(n, f"original/{n}.nc", clean_shape, given, key))
    return run.do("read and clean", todo)


def choose_reflected(
    run: Run, sources: Sources, marked: Marked, options: Options
) -> tuple[list[str], list[str]]:
    """The shapes whose mirror images are taken, and what is told of the choice.

    Where the shapes themselves shall say (``reflect="auto"``), they are looked at as they are
    first; ``network/chirality`` keeps the choice.
    """
    if options.reflect is None:
        return [], []
    if options.reflect != AUTO:
        table = run.folder / "subjects.nc"
        subjects = read(table) if table.is_file() else None
        reflected = to_reflect(str(options.reflect), list(sources), subjects)
        is_all = len(reflected) == len(sources)
        return reflected, ["reflect= mirrors all: nothing changes among them"] if is_all else []
    file = run.folder / CHOICE
    contents = [content for _, content in sources.values()]
    key = task_key(list(sources), contents, options.of("cleaning"), options.k, AUTO)
    if not is_done(file, key):
        original = read_and_clean(run, sources, marked, options, [])
        looks = comparisons_of(run, original, options) if len(original) > 1 else {}
        reflected, told = mirrored_shapes(looks)
        choice = dataset(
            {"told": "\n".join(told)},
            mean_chirality=mean_chirality(looks) if looks else np.zeros(0),
            reflected=np.array([name in reflected for name in looks], int),
        )
        write(choice.assign_coords(shape=list(looks)), file, key)
    choice = read(file)
    told = choice.attrs["told"].splitlines()
    for line in told:
        log.warning("%s", line)
    return choice["shape"].values[choice["reflected"].values.astype(bool)].tolist(), told


def remesh(run: Run, original: Keys, options: Options) -> Keys:
    """Low-resolution meshes and their spectra (4.1, step 1): ``/coarse``."""
    settings: tuple[Any, ...] = (options.n_coarse, options.wrap, options.seed, options.k)
    if options.refined_eigenfunctions:
        settings = (*settings, "refined eigenfunctions")
    if options.method != "rematch":
        settings = (*settings, options.method)
    todo = [
        Task(n, f"coarse/{n}.nc", remesh_shape, (run.folder, n, options), (key, settings), (key,))
        for n, key in original.items()
    ]
    coarse = run.do("remesh and spectrum", todo)
    check_usable(run, coarse, options)
    return coarse


def lowest_eigenvalues(run: Run, coarse: Keys, k_init: int) -> np.ndarray:
    """The `k_init` lowest eigenvalues of every shape (n, k_init); fewer where a shape has fewer."""
    spectra = [arrays(run.folder / f"coarse/{name}.nc", "eigenvalue")[0] for name in coarse]
    k_init = min(k_init, *map(len, spectra))
    return np.stack([spectrum[:k_init] for spectrum in spectra])


def align(run: Run, coarse: Keys, options: Options) -> tuple[Keys, tuple[str, str], str]:
    """All shapes moved onto the one whose spectrum is nearest to all others (4.1, step 2).

    Returns
    -------
    coarse : dict of str to str
        Keys of the shapes that could be moved.
    reference : tuple (name, key)
        The shape that they were moved onto.
    aligned : str
        The key that all transforms depend on.
    """
    names = list(coarse)
    spectra = lowest_eigenvalues(run, coarse, options.k_init)
    reference = names[int(np.argmin(spectral_distance(spectra).sum(1)))]
    aligned = task_key(list(coarse.values()), names, reference)
    todo = [
        Task(n, f"network/alignment_{n}.nc", align_shape, (run.folder, n, reference), (aligned, n))
        for n in names
    ]
    moved = {name: coarse[name] for name in run.do("align", todo)}
    check_usable(run, moved, options)
    return moved, (reference, coarse[reference]), aligned


def initial_maps(run: Run, coarse: Keys, aligned: str, options: Options) -> Keys:
    """The pairs of the network, of like spectra, and their initial maps (4.1, steps 3 and 4)."""
    spectra = lowest_eigenvalues(run, coarse, options.k_init)
    names, k_init = list(coarse), spectra.shape[1]
    pairs = choose_pairs(spectral_distance(spectra), options.n_pairs)
    batches = in_batches([[names[i], names[j]] for i, j in pairs])
    settings = (k_init, options.of("initial maps"))
    files = {f"network/initial_{i:03d}.nc": batch for i, batch in enumerate(batches)}
    todo = [
        Task(f, f, map_pairs, (run.folder, batch, *settings), (aligned, batch, *settings))
        for f, batch in files.items()
    ]
    return run.do("initial maps", todo, each=False)


def in_batches(pairs: Sequence[Any]) -> list[Any]:
    """The pairs in batches for the tasks of the initial maps: four in each, or 64 batches.

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
    iteration_settings = (
        options.weights,
        options.n_samples,
        options.dense_iterations,
        options.keep_iterations,
    )
    key = task_key(list(first.values()), *settings, *iteration_settings)
    kept = list((run.folder / "iterations").glob("k_*.nc")) if options.keep_iterations else []
    files = [run.folder / "network.nc", run.folder / "latent.nc", *kept]
    done = bool(kept) == options.keep_iterations and all(is_done(file, key) for file in files)
    with run.stage("consistent ZoomOut and median", share=float(not done), done=int(done)):
        if done:
            return key
        maps = xr.concat([read(run.folder / file) for file in first], dim="pair")
        with parallel_config(backend="threading"):  # here, whatever backend the tasks run on
            n_threads = effective_n_jobs(run.n_jobs)
        tree = consistent_maps(run, list(coarse), maps, options, n_threads)
        for old in (run.folder / "iterations").glob("k_*.nc"):  # of other maps
            old.unlink()
        iterations = (
            [f"iterations/{name}" for name in tree["iterations"].children]
            if "iterations" in tree
            else []
        )
        for node in [*iterations, "network", "latent"]:
            write(tree[node].to_dataset(), run.folder / f"{node}.nc", key, coarse.values())
    return key


def place(run: Run, apart: Keys, reference: tuple[str, str], latent: str, options: Options) -> Keys:
    """The shapes that stand apart, beside the network as it is (eq. 3): ``/latent/<shape>``.

    Each is aligned to the reference of the network, and its latent basis solves for its maps to
    some shapes of the network, whose bases stay.

    Parameters
    ----------
    apart : dict of str to str
        Keys of their low-resolution meshes.
    reference : tuple (name, key)
    """
    name, reference_key = reference
    todo = [
        Task(
            n, f"network/alignment_{n}.nc", align_shape, (run.folder, n, name), (reference_key, key)
        )
        for n, key in apart.items()
    ]
    aligned = run.do("align flagged shapes", todo) if apart else {}
    settings = (options.k_init, options.of("initial maps"), options.step, options.norm)
    todo = [
        Task(
            n,
            f"latent/{n}.nc",
            place_shape,
            (run.folder, n, options),
            (latent, apart[n], key, settings),
            (latent, apart[n]),
        )
        for n, key in aligned.items()
    ]
    return run.do("place flagged shapes", todo) if aligned else {}


def register(run: Run, coarse: Keys, placed: Keys, latent: str, options: Options) -> Keys:
    """Every shape registered to the template, the median shape by default (4.2, eq. 6 to 8)."""
    template = options.template or attributes(run.folder / "latent.nc")["median"]
    projection = (options.area_weighted, options.n_projected)
    way = (template, options.dense_match, options.of("registration"), projection)
    template_key = task_key(latent, way)
    mesh = template_mesh(read(run.folder / f"original/{template}.nc"), template)
    if placed:
        mesh.attrs["excluded"] = " ".join(placed)
    write(mesh, run.folder / "registration.nc", template_key, [latent])
    todo = []
    for n, key in sorted(coarse.items()):
        if n in run.failures:
            continue
        own = (placed[n],) if n in placed else ()
        todo.append(
            Task(
                n,
                f"registration/{n}.nc",
                register_shape,
                (run.folder, n, template, options),
                (template_key, key, *own),
                (template_key, *own),
            )
        )
    registered = run.do("registration", todo)
    last_template.clear()  # of this process, where it registered itself
    return registered


def modes(run: Run, registered: Keys, flags: Flags, options: Options) -> str:
    """The modes of the displacements (6.1): ``/pca``; the reason where there can be none.

    They are made without the flagged shapes, whose scores are measured along them.
    """
    with run.stage("modes"):
        mesh = read(run.folder / "registration.nc")
        template = mesh.attrs["template"]
        files = {name: open_file(run.folder / f"registration/{name}.nc") for name in registered}
        data = stack_registration(mesh, files, list(files), lazily=True)["registration"]
        apart = [
            name
            for name in registered
            if name != template and any(flag.flagged for flag in flags[name])
        ]
        apart = [] if options.include_flagged else apart
        coarse = read(run.folder / f"coarse/{template}.nc")
        keys = list(registered.values())
        try:
            result = pca_without(data, apart, coarse, area_weighted=options.area_weighted)
        except ValueError as error:
            log.warning("no modes: %s", error)
            (run.folder / "pca.nc").unlink(missing_ok=True)
            return str(error)
        write(result, run.folder / "pca.nc", task_key(keys), keys)
    return ""
