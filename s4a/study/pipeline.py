"""Analysis of a collection (4, 6.1): all steps of the paper.

Every step takes the keys of its input files and returns those of its output.  A key is a hash of
everything that a file depends on.  Files are in the folder of the run, and computed by the
functions of :mod:`s4a.study.tasks`.
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
from s4a.input.landmarks import unpaired
from s4a.input.plausibility import Flags
from s4a.input.subjects import read_table
from s4a.method.alignment import N_VOTERS
from s4a.method.network import choose_pairs, spectral_distance
from s4a.method.pca import pca_without
from s4a.method.remesh import check_wrap
from s4a.options import DECLARED, Options, given_options
from s4a.schema import POSE, dataset
from s4a.study.netcdf import arrays, attributes, is_done, open_file, read
from s4a.study.processes import limited, temporary_folder
from s4a.study.quality_control import (
    check_modes,
    check_plausibility,
    check_registrations,
    check_usable,
    comparisons_of,
    exclude_ambiguous,
    exclude_flagged,
    flag_poses,
    stop_if_flagged,
    unflagged,
)
from s4a.study.report import write_report
from s4a.study.runner import Keys, Run, Task, names_and_keys
from s4a.study.sources import (
    Collection,
    Marked,
    Sources,
    check_one_structure,
    common_system,
    find_guides,
    find_sources,
    remarks_on_guides,
    remarks_on_table,
    with_contents,
)
from s4a.study.store import lock, task_key, write
from s4a.study.tasks import (
    align_shape,
    align_voters,
    clean_shape,
    consistent_maps,
    insert_shape,
    last_template,
    map_pairs,
    register_shape,
    remesh_shape,
    voters_in,
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
    """Analyse a collection of meshes: median shape, dense correspondences, modes of variation.

    The steps are those of Maccarone et al. with several additions, mainly elastic registration;
    ``preset="paper"`` switches all additions off.

    Parameters
    ----------
    shapes : path, list of paths, dict or xarray.DataTree
        A folder, a glob pattern or a list of files; a dict from names to files, Datasets or
        ``(points, triangles)``; or the tree that :func:`s4a.read_shapes` returns.
    preset, n_coarse, n_pairs, k, label, reflect, table, landmarks, template, remove_size
        The most used options.  :class:`s4a.Options` describes them.  None means the value in
        `options`, or the default.
    options : Options, optional
        Options that replace the defaults.
    **others
        All other options of :class:`s4a.Options`.  ``rng`` can replace ``seed``.
    store : path, optional
        Folder of the study.  A run that was interrupted resumes at the first missing file.  By
        default nothing is stored.
    n_jobs : int, optional
        Number of parallel processes, as in joblib: -1 for all cores, None for one.  The result does
        not depend on it.

    Returns
    -------
    xarray.DataTree
        The study, with the nodes

        - ``/original``: clean meshes;
        - ``/coarse``: low-resolution meshes with their eigenfunctions;
        - ``/network``: functional maps between pairs of shapes;
        - ``/latent``: latent bases, shape differences and the median shape;
        - ``/registration``: displacement of the template to every shape;
        - ``/pca``: modes of variation and scores;
        - ``/report``: status, warnings and run times;
        - ``/subjects``: columns of the table, if there is a table.

    Raises
    ------
    ValueError
        If an option is out of range, or fewer than 2 shapes can be used; the message gives the
        reasons.  With ``quality_control="stop"``, if a shape is flagged.
    TypeError
        If an option does not exist.

    See Also
    --------
    read_shapes : Read and check a collection only.
    open_study : Open the folder of a study.
    insert : Insert new shapes into a study.
    match_pair : Match a pair of shapes.

    References
    ----------
    Maccarone et al., S4A: Scalable Spectral Statistical Shape Analysis.
    R. Huang, J. Ren, P. Wonka and M. Ovsjanikov (2020), Consistent ZoomOut: efficient spectral map
    synchronization, Computer Graphics Forum 39(5).

    Examples
    --------
    >>> import s4a
    >>> study = s4a.analyse(s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3)
    >>> list(study["pca"]["score"].dims), study["registration"].sizes["vertex"]
    (['shape', 'component'], 200)

    The method of the paper, with and without elastic iterations:

    >>> from s4a.options import PRESETS
    >>> small = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 3}
    >>> brains = s4a.synthetic.brains(3, 200)
    >>> paper = s4a.analyse(brains, preset="paper", **small)
    >>> elastic = s4a.analyse(brains, **PRESETS["paper"] | {"refine": "elastic"}, **small)
    """
    named = {name: value for name, value in locals().items() if name in DECLARED}
    given = {name: value for name, value in named.items() if value is not None}
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
    system, on_systems = common_system(sources, settings)
    settings.check_against(list(sources))
    marked = find_guides(sources, settings.landmarks, settings.feature_names)
    with lock(store) as claim:
        n = len(sources)
        n_tasks = max(n, n * (n - 1) // 8)  # of shapes, or of four pairs each
        run = Run(claim, limited(limited(n_jobs), n_tasks), system)
        if subjects is not None:
            write(with_contents(subjects, sources), run.folder / "subjects.nc", name="subjects")
        else:
            remarks = remarks + remarks_on_table(run.folder / "subjects.nc", sources)
        remarks = remarks + remarks_on_guides(sources, marked, settings.feature_names)
        with run.report_unforeseen():
            run_steps(run, sources, marked, settings, [*on_systems, *remarks])
    return open_study(store)


def run_steps(
    run: Run, sources: Sources, marked: Marked, options: Options, remarks: list[str]
) -> None:
    """Run all steps of the paper; each skips files that are done."""
    # dependencies of the files; a key contains those of all files before it:
    #
    #   original/* -> coarse/* -> network/alignment_* -> network/initial_* -> network, latent
    #       |                                                                  |
    #   network/descriptor_*, comparison_*    latent/* of excluded -> registration/* <- registration
    #                                                     |
    #                                                pca, report
    reflected, on_chirality = choose_reflected(run, sources, marked, options)
    original = read_and_clean(run, sources, marked, options, reflected)
    remarks = unpaired({n: open_file(run.folder / f"original/{n}.nc") for n in original}) + remarks
    original, flags, on_shapes = check_plausibility(run, original, options)
    stop_if_flagged(flags, options)
    coarse = remesh(run, original, options)
    flags, coarse, excluded, on_exclusion = exclude_flagged(run, coarse, flags, options)
    coarse, reference, aligned = align(run, coarse, options)
    flags, coarse, ambiguous, on_poses = exclude_ambiguous(run, coarse, flags, options)
    stop_if_flagged(flags, options)
    initial = initial_maps(run, coarse, aligned, options)
    latent = consistent_zoomout(run, coarse, initial, options)
    moved = align_excluded(run, excluded, reference, options)
    flags = flag_poses(run, excluded, flags)
    inserted = insert_excluded(run, moved | ambiguous, excluded | ambiguous, latent, options)
    registered = register(run, coarse | excluded | ambiguous, inserted, latent, options)
    failed, on_registrations = check_registrations(run, registered, inserted)
    flags = {name: [*flags.get(name, []), *failed.get(name, [])] for name in registered}
    flags = unflagged(flags) if options.quality_control == "off" else flags
    why_no_modes, flags = modes(run, registered, flags, options, bool(on_poses))
    remarks = [*on_chirality, *on_exclusion, *on_poses, *on_shapes, *on_registrations, *remarks]
    write_report(run, sources, options, remarks, why_no_modes, registered, flags, bool(on_poses))


def read_and_clean(
    run: Run, sources: Sources, marked: Marked, options: Options, reflected: list[str]
) -> Keys:
    """Read and clean the shapes, add landmarks and fields, mirror some (5.1): ``/original``."""
    cleaning = options.of("cleaning")
    todo = []
    for n, (source, content) in sources.items():
        also: dict[str, Any] = {"reflected": True} if n in reflected else {}
        also |= {"system": run.system} if run.system else {}
        key = (content, cleaning, *also.values())
        if n in marked:
            also["guides"] = landmarks, features = marked[n]
            # the contents, not the paths
            key = (*key, *([landmarks[1]] if landmarks else []))
            key = (*key, *((name, content) for name, (_, content) in features.items()))
        arguments = (source, content, cleaning, also)
        todo.append(Task(n, f"original/{n}.nc", clean_shape, arguments, key))
    return run.do("read and clean", todo)


def choose_reflected(
    run: Run, sources: Sources, marked: Marked, options: Options
) -> tuple[list[str], list[str]]:
    """Choose the shapes to mirror; return their names, and remarks.

    With ``reflect="auto"`` the shapes are first compared as they are; the choice is stored in
    ``network/chirality``.
    """
    if options.reflect is None:
        return [], []
    if options.reflect != AUTO:
        table = run.folder / "subjects.nc"
        subjects = read(table) if table.is_file() else None
        reflected = to_reflect(str(options.reflect), list(sources), subjects)
        is_all = len(reflected) == len(sources)
        return reflected, ["reflect= mirrors all shapes, with no effect"] if is_all else []
    file = run.folder / CHOICE
    contents = [content for _, content in sources.values()]
    key = task_key(list(sources), contents, options.of("cleaning"), run.system, options.k, AUTO)
    if not is_done(file, key):
        original = read_and_clean(run, sources, marked, options, [])
        comparisons = comparisons_of(run, original, options) if len(original) > 1 else {}
        reflected, remarks = mirrored_shapes(comparisons)
        choice = dataset(
            {"remarks": "\n".join(remarks)},
            mean_chirality=mean_chirality(comparisons) if comparisons else np.zeros(0),
            reflected=np.array([name in reflected for name in comparisons], int),
        )
        write(choice.assign_coords(shape=list(comparisons)), file, key, name="network/chirality")
    choice = read(file)
    remarks = choice.attrs["remarks"].splitlines()
    for remark in remarks:
        log.warning("%s", remark)
    return choice["shape"].values[choice["reflected"].values.astype(bool)].tolist(), remarks


def remesh(run: Run, original: Keys, options: Options) -> Keys:
    """Remesh the shapes and compute their spectra (4.1, step 1): ``/coarse``."""
    settings = options.of("low resolution")
    todo = []
    for n, key in original.items():
        arguments, made_from = (run.folder, n, options), names_and_keys("original", {n: key})
        todo.append(Task(n, f"coarse/{n}.nc", remesh_shape, arguments, (key, settings), made_from))
    coarse = run.do("remesh and spectrum", todo)
    check_usable(run, coarse, options)
    return coarse


def lowest_eigenvalues(run: Run, coarse: Keys, k_init: int) -> np.ndarray:
    """Read the lowest eigenvalues of every shape ``(n, k_init)``; fewer if a shape has fewer."""
    spectra = [arrays(run.folder / f"coarse/{name}.nc", "eigenvalue")[0] for name in coarse]
    k_init = min(k_init, *map(len, spectra))
    return np.stack([spectrum[:k_init] for spectrum in spectra])


def align(run: Run, coarse: Keys, options: Options) -> tuple[Keys, tuple[str, str], str]:
    """Align all shapes to the one with the smallest spectral distances (4.1, step 2).

    Returns
    -------
    coarse : dict of str to str
        Keys of the shapes that could be aligned.
    reference : tuple (name, key)
        The shape that they were aligned to.
    aligned : str
        The key of all transforms.
    """
    names = list(coarse)
    spectra = lowest_eigenvalues(run, coarse, options.k_init)
    reference = names[int(np.argmin(spectral_distance(spectra).sum(1)))]
    aligned = task_key(list(coarse.values()), names, reference, options.alignment)
    voting = [reference, *(name for name in names if name != reference)][: N_VOTERS + 2]
    settings = (run.folder, voting, reference, options.alignment)
    task = Task("voters", "network/voters.nc", align_voters, settings, (aligned,))
    run.do("align", [task], each=False)
    todo = [align_task(run, n, reference, options, (aligned, n)) for n in names]
    moved = {name: coarse[name] for name in run.do("align", todo)}
    voters_in.cache_clear()  # of this process, if it aligned shapes itself
    check_usable(run, moved, options)
    return moved, (reference, coarse[reference]), aligned


def align_task(
    run: Run, name: str, reference: str, options: Options, inputs: tuple[str, ...]
) -> Task:
    """Make the task that aligns a shape to the reference."""
    arguments = (run.folder, name, reference, options.alignment)
    return Task(name, f"network/alignment_{name}.nc", align_shape, arguments, inputs)


def initial_maps(run: Run, coarse: Keys, aligned: str, options: Options) -> Keys:
    """Choose pairs of similar spectra, and compute initial maps (4.1, steps 3 and 4)."""
    spectra = lowest_eigenvalues(run, coarse, options.k_init)
    names, k_init = list(coarse), spectra.shape[1]
    pairs = choose_pairs(spectral_distance(spectra), options.n_pairs)
    batches = in_batches([[names[i], names[j]] for i, j in pairs])
    settings = (k_init, options.of("initial maps"), options.keep_iterations)
    files = {f"network/initial_{i:03d}.nc": batch for i, batch in enumerate(batches)}
    todo = [
        Task(f, f, map_pairs, (run.folder, batch, *settings), (aligned, batch, *settings))
        for f, batch in files.items()
    ]
    return run.do("initial maps", todo, each=False)


def in_batches(pairs: Sequence[Any]) -> list[Any]:
    """Split pairs into batches, one per task: four pairs each, or 64 batches.

    Examples
    --------
    >>> from s4a.study.pipeline import in_batches
    >>> [len(batch) for batch in in_batches(range(10))]
    [4, 4, 2]
    """
    size = max(4, -(-len(pairs) // 64))
    return [pairs[i : i + size] for i in range(0, len(pairs), size)]


def consistent_zoomout(run: Run, coarse: Keys, initial: Keys, options: Options) -> str:
    """Consistent ZoomOut and median shape (4.2, eq. 5): ``/network`` and ``/latent``.

    Returns
    -------
    str
        The key of both files.
    """
    settings = (options.k, options.n_samples, options.of("Consistent ZoomOut"))
    key = task_key(list(initial.values()), *settings)
    old_files = list((run.folder / "iterations").glob("k_*.nc")) if options.keep_iterations else []
    files = [run.folder / "network.nc", run.folder / "latent.nc", *old_files]
    done = bool(old_files) == options.keep_iterations and all(is_done(file, key) for file in files)
    with run.stage("consistent ZoomOut and median", share=float(not done), done=int(done)):
        if done:
            return key
        maps = xr.concat([read(run.folder / file) for file in initial], dim="pair")
        with parallel_config(backend="threading"):  # here, whatever backend the tasks run on
            n_threads = effective_n_jobs(run.n_jobs)
        tree = consistent_maps(run, list(coarse), maps, options, n_threads)
        for old in (run.folder / "iterations").glob("k_*.nc"):  # of an earlier run
            old.unlink()
        made_from = names_and_keys("coarse", coarse)
        iterations = [
            node.path[1:] for node in tree.subtree if node.path.startswith("/iterations/")
        ]
        for node in [*iterations, "network", "latent"]:
            file = run.folder / f"{node}.nc"
            write(tree[node].to_dataset(), file, key, made_from, run.claim, name=node)
    return key


def align_excluded(run: Run, excluded: Keys, reference: tuple[str, str], options: Options) -> Keys:
    """Align the shapes that are excluded from the network to the reference.

    Parameters
    ----------
    excluded : dict of str to str
        Keys of the low-resolution meshes.
    reference : tuple (name, key)
    """
    name, reference_key = reference
    todo = []
    for n, key in excluded.items():
        inputs = (reference_key, key, options.alignment)
        todo.append(align_task(run, n, name, options, inputs))
    return run.do("align flagged shapes", todo) if excluded else {}


def insert_excluded(run: Run, aligned: Keys, excluded: Keys, latent: str, options: Options) -> Keys:
    """Insert the shapes that are excluded from the network (eq. 3): ``/latent/<shape>``.

    Each shape is mapped to some shapes of the network; its latent basis is solved for with their
    bases fixed.

    Parameters
    ----------
    aligned, excluded : dict of str to str
        Keys of the alignments and of the low-resolution meshes.
    """
    settings = (options.k_init, options.of("initial maps"), options.step, options.norm)
    todo = []
    for n, key in aligned.items():
        inputs = (latent, excluded[n], key, settings)
        made_from = (f"latent={latent}", f"coarse/{n}={excluded[n]}")
        arguments = (run.folder, n, options)
        todo.append(Task(n, f"latent/{n}.nc", insert_shape, arguments, inputs, made_from))
    return run.do("insert flagged shapes", todo) if aligned else {}


def register(run: Run, coarse: Keys, inserted: Keys, latent: str, options: Options) -> Keys:
    """Register every shape to the template, the median shape by default (4.2, eq. 6 to 8)."""
    template = options.template or attributes(run.folder / "latent.nc")["median"]
    settings = (options.dense_match, options.alignment)
    of_steps = (options.of("registration"), options.of("projection"))
    template_key = task_key(latent, template, *settings, *of_steps)
    mesh = template_mesh(read(run.folder / f"original/{template}.nc"), template)
    if inserted:
        mesh.attrs["excluded"] = " ".join(inserted)
    made_from = [f"latent={latent}"]
    write(mesh, run.folder / "registration.nc", template_key, made_from, name="registration")
    todo = []
    for n, key in sorted(coarse.items()):
        if n in run.failures:
            continue
        of_latent = {n: inserted[n]} if n in inserted else {}
        inputs = (template_key, key, *of_latent.values())
        made_from = [f"registration={template_key}", *names_and_keys("coarse", {n: key})]
        made_from += names_and_keys("latent", of_latent)
        arguments = (run.folder, n, template, options)
        file = f"registration/{n}.nc"
        todo.append(Task(n, file, register_shape, arguments, inputs, tuple(made_from)))
    registered = run.do("registration", todo)
    last_template.clear()  # of this process, if it registered shapes itself
    return registered


def modes(
    run: Run, registered: Keys, flags: Flags, options: Options, ambiguous: bool = False
) -> tuple[str, Flags]:
    """Compute the modes of variation (6.1), ``/pca``.

    Flagged shapes are excluded; their scores are computed along the modes of the others.  With
    `ambiguous`, shapes whose pose alone is ambiguous are included.

    Returns
    -------
    why_no_modes : str
        The reason if there are none.
    flags : dict of str to list of Flag
        Flags of the registered shapes, with the warnings of :func:`check_modes`.
    """
    with run.stage("modes"):
        mesh = read(run.folder / "registration.nc")
        template = mesh.attrs["template"]
        files = {name: open_file(run.folder / f"registration/{name}.nc") for name in registered}
        data = stack_registration(mesh, files, list(files), lazily=True)["registration"]
        excluded = [
            name
            for name in registered
            if name != template
            and any(flag.flagged and not (ambiguous and flag.kind == POSE) for flag in flags[name])
        ]
        excluded = [] if options.include_flagged else excluded
        coarse = read(run.folder / f"coarse/{template}.nc")
        keys = list(registered.values())
        try:
            result = pca_without(data, excluded, coarse, area_weighted=options.area_weighted)
        except ValueError as error:
            log.warning("no modes: %s", error)
            (run.folder / "pca.nc").unlink(missing_ok=True)
            return str(error), flags
        made_from = names_and_keys("registration", registered)
        write(result, run.folder / "pca.nc", task_key(keys), made_from, name="pca")
        warned = check_modes(result, float(data["vertex_area"].sum()))
    return "", {name: [*flags[name], *warned.get(name, [])] for name in flags}
