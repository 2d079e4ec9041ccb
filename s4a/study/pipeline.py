"""The whole analysis (4, 6.1): runs the steps over a collection, the only writer of a study."""

import logging
import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import xarray as xr
from joblib import effective_n_jobs, parallel_config
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from s4a.geometry.align import align, cloud, farthest_points, realign
from s4a.geometry.mesh import as_arrays, as_dataset, triangle_areas, vertex_areas
from s4a.input import plausibility
from s4a.input.clean import clean
from s4a.input.collection import passed_over, read_shape, shape_report
from s4a.input.files import find_meshes, slug
from s4a.input.subjects import read_table
from s4a.method import fmap, joint, latent, median, network, register
from s4a.method.first_map import first_map_of
from s4a.method.pca import pca
from s4a.method.remesh import coarsen
from s4a.method.spectral import spectrum
from s4a.schema import dataset, in_unit, require, unit_of
from s4a.study import store as archive
from s4a.study.options import check_against, checked
from s4a.study.report import doubtful, reductions, tied
from s4a.study.runner import Run

log = logging.getLogger(__name__)

SAMPLES = 1000  # vertices per shape whose matches Consistent ZoomOut looks for


def collection(shapes, pattern):
    """What the user gave, as a dict name -> (path or Dataset, key of its content)."""
    if isinstance(shapes, xr.DataTree):
        if "original" not in shapes:
            raise ValueError(
                "the DataTree needs a node /original with one node per shape, as of s4a.read_shapes"
            )
        shapes = {name: node.to_dataset() for name, node in shapes["original"].children.items()}
    if isinstance(shapes, dict):
        wrong = [n for n in shapes if not isinstance(n, str) or slug(n) != n]
        if wrong or not shapes:
            raise ValueError(
                f"shapes need names of letters, digits, _ and -; found {wrong or 'none'}"
            )
        meshes = {
            n: m if isinstance(m, xr.Dataset) else as_dataset(*m) for n, m in sorted(shapes.items())
        }
        for name, mesh in meshes.items():
            require(mesh, "position", "corner_vertex", what=f"shape {name}")
        return {n: (m, content_key(m)) for n, m in meshes.items()}
    found = sorted((name, path) for path, name in find_meshes(shapes, pattern))
    return {name: (str(path), archive.task_key(Path(path).read_bytes())) for name, path in found}


def content_key(mesh):
    """The key of everything a mesh in memory holds, labels and landmarks too."""
    held = {str(name): v.values for name, v in sorted(mesh.variables.items())}
    parts = [v.tolist() if v.dtype.hasobject else v for v in held.values()]
    return archive.task_key(list(held), *parts)


def original_task(source, options):
    """A file read and cleaned, or a mesh in memory cleaned where it is not yet."""
    if isinstance(source, str):
        return read_shape(source, **options)
    if "file_vertex" in source:
        area = float(triangle_areas(*as_arrays(source)).sum())
        mesh = source.assign_attrs({"status": "ok", "reason": "", "area": area} | source.attrs)
    else:
        mesh = clean(source, **options)
    return in_unit(mesh, source.attrs.get("unit"))


def look_task(folder, name, reference, intersections):
    """What :func:`s4a.input.plausibility.look` sees in a shape beside the reference."""
    mesh, other = (archive.read(folder / "original" / f"{n}.nc") for n in (name, reference))
    found = plausibility.look(mesh, plausibility.sample(other), intersections)
    return dataset({n: v for n, v in found.items() if n != "rotation"}, rotation=found["rotation"])


def coarse_task(folder, name, n_coarse, wrap, seed, k):
    """The low-resolution mesh of a shape of the study, its U and its spectrum."""
    mesh = archive.read(folder / "original" / f"{name}.nc")
    low = spectrum(coarsen(mesh, n_coarse=n_coarse, wrap=wrap, seed=seed), k=k)
    return in_unit(low, unit_of(mesh["position"]))


def scan(folder, name):
    """A shape of the study at both resolutions; its arrays are read when they are used."""
    return register.Scan(
        *(archive.read(folder / stage / f"{name}.nc") for stage in ("original", "coarse"))
    )


@lru_cache(maxsize=1)
def template_scan(folder, name, key):
    """The template as a :func:`scan`, which a worker keeps from shape to shape.

    As long as its `key` is the same.
    """
    return scan(folder, name)


def low_shape(folder, name):
    """The coarse mesh of a shape, centred and for unit area."""
    variables = ("position", "corner_vertex", "vertex_area", "eigenfunction", "eigenvalue")
    X, T, area, Phi, eigenvalue = archive.arrays(folder / "coarse" / f"{name}.nc", *variables)
    w = area / area.sum()
    return joint.Surface((X - w @ X) / np.sqrt(area.sum()), T, w, Phi, eigenvalue=eigenvalue)


def alignment_task(folder, name, reference):
    """Rigid motion of a shape onto the reference, both centred and for unit area."""
    R, t = np.eye(3), np.zeros(3)
    if name != reference:
        M, N = low_shape(folder, name), low_shape(folder, reference)
        R, t, _ = align(M.X, M.area, N.X, N.area)
    return dataset({"reference": reference}, rotation=R, translation=t)


def motion_to_reference(folder, name):
    """R and t of :func:`alignment_task`."""
    return tuple(
        archive.arrays(folder / "network" / f"motion_{name}.nc", "rotation", "translation")
    )


def motion_between(source, target):
    """The motion source -> target from the motions (R, t) of both onto a common reference."""
    (R, t), (R_target, t_target) = source, target
    return R_target.T @ R, R_target.T @ (t - t_target)


def first_maps_task(folder, pairs, k_init, init):
    """First maps of some pairs, in both directions."""
    shapes = {
        name: low_shape(folder, name) for name in sorted({name for pair in pairs for name in pair})
    }
    motions = {name: motion_to_reference(folder, name) for name in shapes}
    clouds = {name: cloud(shape.X, 300) for name, shape in shapes.items()}
    directed, maps = [], []
    for a, b in pairs:
        M, N = shapes[a], shapes[b]
        start = motion_between(motions[a], motions[b])
        R, t = realign(M.X, M.area, N.X, N.area, start, clouds=(clouds[a], clouds[b]))
        first, C, _ = first_map_of(M, N, (R, t), k_init=k_init, init=init)
        if first == init:
            ends = ((s.X, s.area, s.Phi, s.eigenvalue) for s in (N, M))
            back = network.first_map(*ends, (R.T, -R.T @ t), k_init=k_init, init=init)
        else:
            back = fmap.once_refined(C.T, N.Phi, M.Phi, M.area)
        directed += [(a, b), (b, a)]
        maps += [C, back]
    source, target = zip(*directed, strict=True)
    return dataset(source=np.array(source), target=np.array(target), fmap_initial=np.stack(maps))


def consistent_maps(folder, names, first, options, n_jobs):
    """Consistent ZoomOut over the network: the Datasets ``/network`` and ``/latent``."""
    shapes = [low_shape(folder, name) for name in names]
    k = min([options["k"], *(s.Phi.shape[1] for s in shapes)])
    index = {name: i for i, name in enumerate(names)}
    source = np.array([index[s] for s in first["source"].values])
    target = np.array([index[t] for t in first["target"].values])
    eigenvalues = np.stack([s.eigenvalue[:k] for s in shapes])
    C0 = first["fmap_initial"].values
    with threadpool_limits(1), tqdm(total=k - C0.shape[1], desc="consistent ZoomOut") as bar:
        C, weight, _, Y, latent_eigenvalue = latent.consistent_zoomout(
            C0,
            source,
            target,
            [s.Phi for s in shapes],
            [s.area for s in shapes],
            eigenvalues,
            k,
            step=options["step"],
            n_latent=options["n_latent"],
            samples=[farthest_points(s.X, SAMPLES) for s in shapes],
            n_jobs=n_jobs,
            progress=lambda size: bar.update(size - C0.shape[1] - bar.n),
        )
    cycles = network.three_cycles(source.tolist(), target.tolist())
    initial_error = network.cycle_errors(C0, cycles)
    error = network.cycle_errors(C, cycles, k=C0.shape[1])
    net = first.merge(
        dataset(
            fmap=C.astype(np.float32),
            weight=weight,
            cycle_error=error,
            cycle_error_initial=initial_error,
        )
    )
    lat = dataset(latent_basis=Y, latent_eigenvalue=latent_eigenvalue).assign_coords(
        shape=list(names)
    )
    return net, median.median_shape(lat, eigenvalues, norm=options["norm"])


def registration_task(folder, name, template_key, template, how, refine, scale):
    """One shape registered to the template (eq. 6 at low resolution, then eq. 7, or eq. 3 and 4.

    Then joint rounds).
    """
    target = template_scan(folder, template, template_key)
    if name == template:
        return register.identity(target)
    source = scan(folder, name)
    basis = archive.read(folder / "latent.nc")["latent_basis"]
    k = basis.sizes["mode"]
    F_source, F_target = (
        s.low.Phi[:, :k] @ basis.sel(shape=n).values
        for s, n in ((source, name), (target, template))
    )
    match = fmap.nearest_rows(F_target, F_source)
    if how == "standard":
        C = fmap.fmap_from_match(
            source.low.Phi[:, :k], target.low.Phi[:, :k], target.low.area, match
        )
        F_source, F_target = source.low.Phi[:, :k] @ C.T, target.low.Phi[:, :k]
        match = fmap.nearest_rows(F_target, F_source)
    motion = motion_between(*(motion_to_reference(folder, n) for n in (name, template)))
    R, t = realign(source.low.X, source.low.area, target.low.X, target.low.area, motion)
    starts = {"intrinsic": match, "icp": cKDTree(source.low.X @ R.T + t).query(target.low.X)[1]}
    return register.registration(
        source, target, starts, (F_source, F_target), k=k, refine=refine, scale=scale
    )


def analyse(
    shapes,
    *,
    n_coarse=6000,
    n_pairs=500,
    k_init=20,
    k=100,
    n_latent=None,
    step=5,
    init=None,
    refine=None,
    how=None,
    norm="h2",
    scale=False,
    components="largest",
    strict=False,
    close_holes=False,
    wrap=False,
    intersections=True,
    pattern=None,
    preset=None,
    template=None,
    table=None,
    store=None,
    n_jobs=None,
    seed=0,
):
    """From a collection of meshes to a median shape, dense correspondences and modes.

    The whole of S4A.

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
        Full resolution by eq. 7 (default), or by eq. 3 and 4.
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
    options = {n: v for n, v in locals().items() if n not in ("shapes", "store", "n_jobs")}
    options = checked(options)
    options["table"] = None if table is None else str(table)
    given, remarks = collection(shapes, pattern), passed_over(shapes, pattern)
    check_against(options, list(given))
    subjects = None if table is None else read_table(table, list(given))
    if store is None:
        with tempfile.TemporaryDirectory(prefix="s4a-") as folder:
            with archive.lock(folder) as claim:
                run_stages(Run(claim, n_jobs), given, options, remarks, subjects)
            tree = archive.open_study(folder)
            return xr.DataTree.from_dict(
                {n.path: n.to_dataset(inherit=False).load() for n in tree.subtree}
            )
    with archive.lock(store) as claim:
        run_stages(Run(claim, n_jobs), given, options, remarks, subjects)
    return archive.open_study(store)


def run_stages(run, given, options, remarks, subjects=None):
    """All stages in turn; each looks up which of its files are done."""
    folder, o = run.folder, options
    if subjects is not None:
        archive.write(subjects, folder / "subjects.nc")
    cleaning = {n: o[n] for n in ("components", "strict", "close_holes")}
    key_of = {n: archive.task_key(content, cleaning) for n, (_, content) in given.items()}
    run.tasks(
        "read and clean",
        original_task,
        [
            (n, f"original/{n}.nc", key_of[n], (source, cleaning))
            for n, (source, _) in given.items()
        ],
    )
    settings = (o["n_coarse"], o["wrap"], o["seed"], o["k"])
    names = [n for n in given if n not in run.failures]
    if len(names) > 1:
        areas = {n: archive.attributes(folder / "original" / f"{n}.nc")["area"] for n in names}
        reference = plausibility.median_size(areas)
        key = archive.task_key(key_of[reference], reference, o["intersections"])
        run.tasks(
            "compare",
            look_task,
            [
                (
                    n,
                    f"network/look_{n}.nc",
                    archive.task_key(key, key_of[n]),
                    (folder, n, reference, o["intersections"]),
                )
                for n in names
            ],
            each=False,
        )
    key_of_original, key_of = key_of, {n: archive.task_key(key_of[n], settings) for n in names}
    run.tasks(
        "remesh and spectrum",
        coarse_task,
        [(n, f"coarse/{n}.nc", key_of[n], (folder, n, *settings)) for n in names],
        made_from={n: [key_of_original[n]] for n in names},
    )
    names = [n for n in names if n not in run.failures]
    if len(names) < 2:
        reasons = (
            "; ".join(f"{n}: {why}" for n, why in run.failures.items()) or "only one was given"
        )
        raise ValueError(
            f"an analysis needs at least 2 usable shapes, found {len(names)} ({reasons})"
        )
    if o["template"] in run.failures:
        raise ValueError(
            f"template {o['template']!r} cannot be used: {run.failures[o['template']]}"
        )

    eigenvalues = [archive.arrays(folder / "coarse" / f"{n}.nc", "eigenvalue")[0] for n in names]
    k_signature = min(o["k_init"], *(len(e) for e in eigenvalues))
    distance = network.spectral_distance([e[:k_signature] for e in eigenvalues])
    pairs = [[names[i], names[j]] for i, j in network.choose_pairs(distance, o["n_pairs"])]
    reference = names[int(np.argmin(distance.sum(1)))]
    key = archive.task_key([key_of[n] for n in names], names, reference)
    run.tasks(
        "align",
        alignment_task,
        [
            (n, f"network/motion_{n}.nc", archive.task_key(key, n), (folder, n, reference))
            for n in names
        ],
        each=False,
    )

    k_init = min(o["k_init"], k_signature)
    batches = in_batches(pairs)
    files = [f"network/first_{i:03d}.nc" for i in range(len(batches))]
    keys = [archive.task_key(key, batch, k_init, o["init"]) for batch in batches]
    run.tasks(
        "first maps",
        first_maps_task,
        [
            (f, f, q, (folder, batch, k_init, o["init"]))
            for f, q, batch in zip(files, keys, batches, strict=True)
        ],
        each=False,
    )

    key = archive.task_key(keys, o["k"], o["step"], o["n_latent"], o["norm"])
    if not all(archive.is_done(folder / f, key) for f in ("network.nc", "latent.nc")):
        with run.stage("consistent ZoomOut and median"):
            first = xr.concat([archive.read(folder / f) for f in files], dim="pair")
            with parallel_config(
                backend="threading"
            ):  # these run here, whatever backend the tasks run on
                n_threads = effective_n_jobs(run.n_jobs)
            net, lat = consistent_maps(folder, names, first, o, n_threads)
            archive.write(net, folder / "network.nc", key, list(key_of.values()))
            archive.write(lat, folder / "latent.nc", key, list(key_of.values()))

    template = o["template"] or archive.read(folder / "latent.nc").attrs["median"]
    settings = (template, o["how"], o["refine"], o["scale"])
    original = archive.read(folder / "original" / f"{template}.nc")
    X, T = as_arrays(original)
    mesh = as_dataset(X, T, {"template": template}, vertex_area=vertex_areas(X, T))
    mesh = in_unit(mesh, unit_of(original["position"]))
    template_key = archive.task_key(key, settings)
    archive.write(mesh, folder / "registration.nc", template_key, [key])
    key_of = {n: archive.task_key(template_key, key_of[n]) for n in names}
    run.tasks(
        "registration",
        registration_task,
        [
            (n, f"registration/{n}.nc", key_of[n], (folder, n, template_key, *settings))
            for n in names
        ],
        made_from={n: [template_key] for n in names},
    )
    template_scan.cache_clear()  # of this process, where it did tasks itself
    with run.stage("modes"):
        names = [n for n in names if n not in run.failures]
        no_modes = write_modes(folder, names, mesh, template, [key_of[n] for n in names])
    write_report(
        run, given, options | {"template": template}, remarks, no_modes, [key_of[n] for n in names]
    )


def in_batches(pairs):
    """The pairs in batches for the tasks of the first maps: four in each, or 64 batches.

    Examples
    --------
    >>> from s4a.study.pipeline import in_batches
    >>> [len(batch) for batch in in_batches(range(10))]
    [4, 4, 2]
    """
    size = max(4, -(-len(pairs) // 64))
    return [pairs[i : i + size] for i in range(0, len(pairs), size)]


def write_modes(folder, names, mesh, template, made_from):
    """Write ``/pca``; returns the reason where there can be none."""
    files = {n: archive.read(folder / "registration" / f"{n}.nc") for n in names}
    data = archive.stack_registration(mesh, files, names)["registration"]
    try:
        modes = pca(
            data,
            mesh["vertex_area"].values,
            coarse=archive.read(folder / "coarse" / f"{template}.nc"),
        )
    except ValueError as error:
        log.warning("no modes: %s", error)
        (folder / "pca.nc").unlink(missing_ok=True)
        return str(error)
    archive.write(modes, folder / "pca.nc", archive.task_key(made_from), made_from)
    return ""


def write_report(run, given, options, remarks, no_modes, made_from):
    """Write ``/report``: status and counts of every shape, times and memory of every stage.

    The options.
    """
    attrs, looks, badness, functions = {}, {}, {}, {}
    for name, (source, _) in given.items():
        if name in run.failures:
            path = source if isinstance(source, str) else ""
            attrs[name] = {"status": "excluded", "reason": run.failures[name], "path": path}
        else:
            mesh, coarse = (
                archive.attributes(run.folder / stage / f"{name}.nc")
                for stage in ("original", "coarse")
            )
            done = [
                mesh["reason"],
                "wrapped watertight before remeshing" if coarse["wrapped"] else "",
                f"all vertices are used, as there are fewer than n_coarse = {options['n_coarse']}"
                if coarse["kept_whole"]
                else "",
                "not manifold at low resolution: robust Laplacian"
                if coarse["laplacian"] == "robust"
                else "",
            ]
            attrs[name] = mesh | {"reason": "; ".join(filter(None, done))}
            if isinstance(source, str):
                attrs[name]["path"] = source  # the file may have moved since it was read
            found = archive.read(run.folder / "network" / f"look_{name}.nc")
            looks[name] = found.attrs | {"rotation": found["rotation"].values}
            badness[name] = archive.attributes(run.folder / "registration" / f"{name}.nc")["score"]
            functions[name] = len(
                archive.arrays(run.folder / "coarse" / f"{name}.nc", "eigenvalue")[0]
            )
    net, lat = (archive.read(run.folder / f"{stage}.nc") for stage in ("network", "latent"))
    doubts, of_all = doubtful(badness)
    remarks = [
        *remarks,
        *of_all,
        *reductions(options, list(badness), net.sizes["pair"] // 2, lat.sizes["mode"], functions),
        *tied(lat["shape"].values.tolist(), lat["distance_to_median"].values),
    ]
    stages = list(run.costs)
    costs = dataset(
        {"no_modes": no_modes, **{n: str(v) for n, v in options.items()}},
        seconds=np.array([run.costs[s][0] for s in stages]),
        peak_memory=np.array([run.costs[s][1] for s in stages]),
    ).assign_coords(stage=stages)
    report = shape_report(attrs, looks, remarks, doubts)
    report = report.assign(costs.variables).assign_attrs(costs.attrs)
    template = options["template"]
    warning = report["warning"].sel(shape=template).item()
    if warning:
        report.attrs["remarks"] += (
            f"\nthe template {template} is itself doubtful ({warning}): give template=NAME"
        )
    archive.write(report, run.folder / "report.nc", made_from=made_from)
