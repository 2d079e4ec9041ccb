"""The methods of the paper's comparison side by side: Table 1 and Fig. 3 (5.2), Table 2 (5.3).

All work on one cleaned input.  What the methods are is in :mod:`s4a.evaluation.methods`.
"""

import io
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from s4a.evaluation import metrics
from s4a.evaluation.methods import (
    BLOCKS,
    INITS,
    METHODS,
    OUR_METHODS,
    PAPER_METHODS,
    Clock,
    Matches,
    Outcome,
    Pair,
    Spaces,
)
from s4a.geometry.align import align, realign, relative_transform
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.collection import Mesh, as_mesh, read_shapes
from s4a.input.raw import content, npy, shown, text_of
from s4a.method import latent, median, network
from s4a.method.initial_map import map_after_alignment
from s4a.method.register import latent_functions, log_area_ratio, match_functions, match_low
from s4a.method.shape import Basis, Shape
from s4a.options import PRESETS as STUDY_PRESETS
from s4a.options import Options, apply_preset
from s4a.schema import check_choice, check_count, check_switch, dataset, variable
from s4a.seeds import RNG, seed_of

log = logging.getLogger(__name__)

__all__ = ["COLLECTION_METHODS", "METHODS", "compare", "compare_collection"]

COLLECTION_METHODS = ("SCALABLE", "RE-MATCH")
COLLECTION_BLOCKS = BLOCKS[0], "basis and initial maps", "consistent ZoomOut", BLOCKS[-1]
DENSE_MATCHES = ("fmap", "latent")
# iterations of RE-MATCH refined, and initial maps of all methods
PRESETS: dict[str | None, dict[str, Any]] = {
    None: {"full_resolution_iterations": 2, "init": "landmarks"},
    "paper": {"full_resolution_iterations": 0, "init": "landmarks"},
}


def check_some(methods: Sequence[str], known: Sequence[str]) -> None:
    """ValueError unless the methods are some of the known ones."""
    wrong = [method for method in methods if method not in known]
    if wrong or not len(methods) or isinstance(methods, str):
        raise ValueError(f"methods must be some of {', '.join(known)}; found {wrong or methods!r}")


def checked_methods(methods: Sequence[str] | None, preset: str | None) -> Sequence[str]:
    """The methods; all by default, of the paper alone with its preset, which has no others."""
    if methods is None:
        return PAPER_METHODS if preset == "paper" else METHODS
    check_some(methods, METHODS)
    added = [method for method in methods if method in OUR_METHODS]
    if preset == "paper" and added:
        raise ValueError(
            f"preset 'paper' has the methods {', '.join(PAPER_METHODS)}; "
            f"found {', '.join(added)}: leave out one of the two"
        )
    return methods


def load_mesh(shape: Mesh, what: str) -> tuple[xr.Dataset, float]:
    """Return a mesh and the seconds that it took to read and clean it; a Dataset takes none."""
    begin = time.process_time()
    mesh = as_mesh(shape, what)
    return mesh, 0.0 if mesh is shape else time.process_time() - begin


def in_mesh(vertices: np.ndarray, mesh: xr.Dataset) -> np.ndarray:
    """Vertices of the mesh that rows of its file became ``(n,)``.

    Rows that are -1, or were dropped, become -1.
    """
    became = mesh["vertex_of_file"].values
    if vertices.max(initial=-1) >= len(became):
        raise ValueError(f"rows of the file, below {len(became)}, needed; found {vertices.max()}")
    return np.where(vertices >= 0, became[np.maximum(vertices, 0)], -1)


def ground_truth_in_meshes(truth: np.ndarray, source: xr.Dataset, target: xr.Dataset) -> np.ndarray:
    """Truth over the rows of the target's file.

    Which are rows of the source's file or positions, for the meshes.

    Parameters
    ----------
    truth : ndarray (n_file_target,) of integers, or (n_file_target, 3)
    source, target : Dataset
        As of :func:`s4a.read_shape`.
    """
    truth, n = np.asarray(truth), target.sizes["file_vertex_index"]
    if truth.shape not in ((n,), (n, 3)) or (truth.ndim == 1 and truth.dtype.kind not in "iu"):
        raise ValueError(
            f"truth needs a row of the source's file (integer, -1 where there is none) or a "
            f"position for each of the {n} vertices of the target's "
            f"file; found {truth.dtype} of shape {truth.shape}"
        )
    truth = truth[target["file_vertex"].values]
    return truth if truth.ndim == 2 else in_mesh(truth, source)


def read_ground_truth(path: Path | str) -> np.ndarray:
    """Truth from a file, for the vertices of the target's file.

    NPY, or text with a number or three in each row.
    """
    try:
        data = content(path)
        delimiter = "," if str(path).endswith(".csv") else None
        as_text = not str(path).endswith(".npy")
        found = (
            np.loadtxt(io.StringIO(text_of(data)), delimiter=delimiter) if as_text else npy(data)
        )
    except ValueError as error:
        raise ValueError(f"{shown(path)} cannot be read as truth: {shown(error)}") from error
    whole = found.ndim == 1 and np.array_equal(found, np.round(found))
    return found.astype(np.int64) if whole else found


def compare(
    source: Mesh,
    target: Any,
    *,
    methods: Sequence[str] | None = None,
    truth: Any = None,
    landmarks: Any = None,
    n_coarse: int = 6000,
    k_init: int = 20,
    k: int = 100,
    step: int = 5,
    preset: str | None = None,
    full_resolution_iterations: int | None = None,
    init: str | None = None,
    n_geodesic: int = 1000,
    keep: bool = False,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset | xr.DataTree:
    """Compare the five methods of Table 1, and three of S4A, on one pair of meshes or several.

    All methods take the same cleaned meshes.

    kNN: nearest neighbour in space after rigid alignment.  ZO: from that match, ZoomOut at full
    resolution.  FMAP+ZO: functional map fitted on landmarks at full resolution, then ZoomOut.
    SCALABLE: the same in the space of :mod:`s4a.method.scalable`.  RE-MATCH: the same on the
    low-resolution mesh, and eq. 4 with U Phi, as ``s4a.match_pair(..., preset="paper")``.

    Ours are RE-MATCH refined: with the eigenfunctions of :mod:`s4a.method.refined_eigenfunctions`
    in the place of U Phi, and the last two iterations of ZoomOut look among all vertices of the
    source; registered: the default of ``s4a.match_pair`` after RE-MATCH, of which the matched
    vertices are compared, as of all others; and registered surface: the same, of which the surface
    is.

    Parameters
    ----------
    source : path or Dataset
        The reference; every match holds its vertices.
    target : path, Dataset, or dict of str to path or Dataset
        One mesh, or several with a name for each pair.
    methods : sequence of str, optional
        Some of :data:`METHODS`; all by default, the paper's five with the preset.
    truth : array, or dict of str to array, optional
        Ground truth: vertices or positions of the source, as in
        :func:`s4a.evaluation.metrics.evaluate`; a dict if `target` is one.  If shapes are given as
        paths, all vertices, here and in `landmarks`, are those of the files.
    landmarks : tuple, or dict of str to tuple, optional
        Corresponding vertices or positions ``(p, 3)`` (of the source, of the target); a dict if
        `target` is one.  By default 10 farthest-point samples of the source and the vertices of the
        target that are nearest after alignment (4.1, step 3).
    n_coarse : int
        Vertices of the low-resolution mesh, and samples of SCALABLE.
    k_init, k : int
        Sizes of the first and of the refined map; as many as the meshes have functions, where these
        are fewer.
    step : int
        Growth of the map per round of ZoomOut, as in :func:`s4a.analyse`.  Steps of 10 take half
        the time of that block of ZO and FMAP+ZO; on a child of 60,000 vertices in two poses they
        end 7 to 9 % farther from the truth.
    preset : {None, "paper"}
        ``"paper"`` leaves out our methods and sets full_resolution_iterations=0 and
        init="landmarks"; another value of these is refused.
    full_resolution_iterations : int, optional
        Rounds of ZoomOut of RE-MATCH refined that look among all vertices of the source, 2 by
        default.
    init : {"landmarks", "descriptors"}, optional
        Initial maps of all methods but kNN and ZO from heat kernels around landmarks (default), as
        in :func:`s4a.match_pair` with the preset, or from wave kernels of the shapes and around
        landmarks, as pyFM has them.
    n_geodesic : int
        See :func:`s4a.evaluation.metrics.evaluate`.
    keep : bool
        Whether the meshes, matches and maps are returned, too, as
        :class:`s4a.widgets.Comparison` shows them: some 30 bytes a vertex and method.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset, or DataTree with `keep`
        Every metric of :func:`s4a.evaluation.metrics.evaluate` over ``(way, pair)``, ``way`` the
        method, and ``block_seconds(algorithm, pair, block)``, the blocks of Fig. 3, in CPU seconds
        of one core.  What two methods share, as the alignment or a basis, is made once and charged
        to both; the alignment only to those that use it, which with given landmarks are kNN, ZO and
        registered.  The attribute ``note`` says where k had to be reduced.

        With `keep` this is ``/metrics`` of a tree, whose ``/source`` is the source's mesh and
        ``/pairs/<pair>`` the target's, with what :func:`kept` says.

    Raises
    ------
    ValueError
        When a method is unknown, a mesh lacks its variables, or truth or landmarks do not fit.

    Examples
    --------
    >>> import s4a
    >>> ball = s4a.synthetic.ellipsoid(300)
    >>> options = {"n_coarse": 100, "k_init": 6, "k": 10}
    >>> found = s4a.compare(ball, ball, methods=["kNN", "RE-MATCH"], **options)
    >>> found["chamfer"].sel(pair="pair", algorithm="kNN").item()
    0.0
    """
    if not isinstance(target, dict):
        target = {"pair": target}
        truth, landmarks = (x if x is None else {"pair": x} for x in (truth, landmarks))
    settings = apply_preset(
        preset, {"full_resolution_iterations": full_resolution_iterations, "init": init}, PRESETS
    )
    seed = seed_of(seed, rng)
    check_count("full_resolution_iterations", settings["full_resolution_iterations"])
    check_choice("init", settings["init"], INITS)
    check_switch("keep", keep)
    methods = checked_methods(methods, preset)
    in_memory = isinstance(source, xr.Dataset)
    if any(isinstance(mesh, xr.Dataset) != in_memory for mesh in target.values()):
        raise ValueError("source and targets need to be all paths or all Datasets")
    if keep and any("/" in str(name) for name in target):
        raise ValueError(f"with keep=True names of pairs hold no '/'; found {', '.join(target)}")
    options: dict[str, Any] = {"k_init": k_init, "k": k, "step": step} | settings
    rows, nodes, notes = [], {}, {}
    with threadpool_limits(1):
        mesh, load_source = load_mesh(source, "source")
        M = Spaces(mesh, n_coarse, k, seed)
        for name, shape in tqdm(target.items(), desc="pairs", disable=len(target) < 2):
            mesh, load_target = load_mesh(shape, f"target {name}")
            N = Spaces(mesh, n_coarse, k, seed)
            marks = None if landmarks is None else landmarks_of(landmarks[name], M, N, in_memory)
            true = None if truth is None else truth[name]
            if true is not None and not in_memory:
                true = ground_truth_in_meshes(true, M.mesh, N.mesh)
            both = Pair(M, N, marks, **options)
            row, outcomes = metrics_of_pair(
                both, methods, load_source + load_target, true, n_geodesic
            )
            rows.append(row)
            notes[name] = row.attrs.pop("note", "")
            if keep:
                nodes[f"pairs/{name}"] = kept(M.mesh, N.mesh, outcomes, true)
    table = xr.concat(rows, "pair", combine_attrs="drop_conflicts")
    table = table.assign_coords(pair=list(target)).transpose("algorithm", "pair", ...)
    table = table.assign_attrs(options | {"n_coarse": n_coarse, "seed": seed} | told(notes))
    if not keep:
        return table
    return xr.DataTree.from_dict({"metrics": table, "source": without_coords(M.mesh), **nodes})


def note_on_k(k: int, least: int) -> dict[str, str]:
    """What is told, as an attribute, where meshes have fewer functions than k."""
    note = f"k = {k} reduced to {least}, the eigenfunctions that the smaller mesh has"
    return {"note": note} if least < k else {}


def told(notes: Mapping[str, str]) -> dict[str, str]:
    """Notes by what they are on, as an attribute and in the log; nothing where all are empty."""
    note = "; ".join(f"{name}: {text}" for name, text in notes.items() if text)
    if not note:
        return {}
    log.warning("%s", note)
    return {"note": note}


def without_coords(mesh: xr.Dataset) -> xr.Dataset:
    """A mesh without the coordinates that it has of a tree, which may not be those of another."""
    return mesh.drop_vars(list(mesh.coords))


def kept(
    source: xr.Dataset, target: xr.Dataset, outcomes: dict[str, Outcome], truth: ArrayLike | None
) -> xr.Dataset:
    """The target's mesh, and what every method found on it.

    Returns
    -------
    Dataset
        ``algorithm_match(algorithm, vertex)``, ``algorithm_image(algorithm, vertex, xyz)``, where
        the vertices of the target lie on the source, in its unit, ``algorithm_reverse(algorithm,
        source_vertex)``, the match the other way, and ``algorithm_area_change(algorithm, vertex)``,
        the log area ratio of :func:`s4a.method.register.log_area_ratio`; where a method of them has
        maps, ``algorithm_fmap(algorithm, eigenpair_target, eigenpair_source)`` and
        ``algorithm_fmap_initial``, NaN for the others; with truth ``true_position(vertex, xyz)``,
        ``true_match(vertex)`` and ``algorithm_error(algorithm, vertex)``, the distance to it in a
        straight line as a share of sqrt(area), NaN where it is unknown.
    """
    (X, T), (Y, S), each = as_arrays(source), as_arrays(target), outcomes.values()
    images = [X[one.match] if one.image is None else one.image for one in each]
    found: dict[str, ArrayLike] = {
        "algorithm_match": np.stack([one.match for one in each]).astype(np.int32),
        "algorithm_reverse": np.stack([one.reverse for one in each]).astype(np.int32),
        "algorithm_image": np.stack(images).astype(np.float32),
        "algorithm_area_change": np.stack([log_area_ratio(image, Y, S) for image in images]).astype(
            np.float32
        ),
    }
    if any(one.fmap is not None for one in each):
        found["algorithm_fmap"] = stacked([one.fmap for one in each])
        found["algorithm_fmap_initial"] = stacked([one.first for one in each])
    if truth is not None:
        true, vertex = metrics.true_positions(truth, X, len(Y))
        errors = np.linalg.norm(np.stack(images) - true, axis=2) / np.sqrt(vertex_areas(X, T).sum())
        found |= {"true_position": true, "true_match": vertex.astype(np.int32)}
        found["algorithm_error"] = errors.astype(np.float32)
    return (
        without_coords(target).merge(dataset(None, **found)).assign_coords(algorithm=list(outcomes))
    )


def stacked(maps: list[np.ndarray | None]) -> np.ndarray:
    """Maps as one array, with NaN where one is smaller than others or there is none.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.evaluation.comparison import stacked
    >>> stacked([None, np.eye(2)]).shape
    (2, 2, 2)
    """
    sizes = [C.shape for C in maps if C is not None]
    found = np.full((len(maps), *np.max(sizes, axis=0)), np.nan)
    for place, C in zip(found, maps, strict=True):
        if C is not None:
            place[: C.shape[0], : C.shape[1]] = C
    return found


def landmarks_of(given: Any, source: Spaces, target: Spaces, clean: bool) -> Matches:
    """Vertices of both meshes that landmarks mean.

    The nearest ones to positions ``(p, 3)``, or those that rows of their files became.
    """
    ends: list[np.ndarray] = []
    for marks, space in zip(given, (source, target), strict=True):
        at = np.asarray(marks)
        if at.ndim == 2 and at.shape[1] == 3:
            at = cKDTree(space.mesh["position"].values).query(at)[1]
        elif not clean and at.dtype.kind in "iu":
            at = in_mesh(at, space.mesh)
        ends.append(at)
        good = at.ndim == 1 and at.dtype.kind in "iu" and len(at) >= 3
        if not (good and 0 <= at.min() <= at.max() < len(space.X) and len(at) == len(ends[0])):
            raise ValueError(
                "landmarks need two arrays of at least 3 vertices that the clean meshes have, of "
                f"the source and of the target; found {at.tolist()} of the "
                f"{'target' if len(ends) > 1 else 'source'}"
            )
    return ends[0], ends[1]


def metrics_of_pair(
    both: Pair, methods: Sequence[str], load: float, truth: np.ndarray | None, n_geodesic: int
) -> tuple[xr.Dataset, dict[str, Outcome]]:
    """All methods on one pair: metrics and times over ``way``, and what each has found."""
    outcomes = {method: both.run(method) for method in methods}
    options: dict[str, Any] = {"truth": truth, "n_geodesic": n_geodesic}
    rows, seconds = [], []
    for one in outcomes.values():
        found: dict[str, Any] = {"image": one.image, "reverse": one.reverse}
        M, N = both.source.mesh, both.target.mesh
        rows.append(metrics.evaluate(M, N, one.match, **found, **options))
        spent = {**one.seconds, BLOCKS[0]: load}
        seconds.append([spent.get(block, 0.0) for block in BLOCKS])
    table = xr.concat(rows, "algorithm", combine_attrs="drop_conflicts")
    table["block_seconds"] = variable("block_seconds", np.array(seconds)[:, None]).isel(pair=0)
    least = min((len(one.fmap) for one in both.spectral.values()), default=both.k)
    table.attrs |= note_on_k(both.k, least)
    return table.assign_coords(algorithm=list(methods), block=list(BLOCKS)), outcomes


def compare_collection(
    shapes: Any,
    *,
    methods: Sequence[str] = COLLECTION_METHODS,
    n_coarse: int = 6000,
    n_pairs: int = 500,
    k_init: int = 20,
    k: int = 100,
    step: int = 5,
    preset: str | None = None,
    init: str | None = None,
    n_samples: int | None = None,
    dense_iterations: int | None = None,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Table 2: the collection in the space of SCALABLE and of RE-MATCH.

    Full resolution is reached the standard way and ours.

    Parameters
    ----------
    shapes : path, list of paths, dict or DataTree
        As of :func:`s4a.read_shapes`, or what it gives.
    methods : sequence of str
        Some of :data:`COLLECTION_METHODS`.
    n_coarse, n_pairs, k_init, k, step, seed, rng
        See :func:`s4a.analyse`.
    preset : {None, "paper"}
        ``"paper"`` sets init="landmarks", n_samples=0 and dense_iterations=0; another value of
        these is refused.
    init, n_samples, dense_iterations
        Initial maps, those of nearest neighbours after alignment by default, and Consistent
        ZoomOut, see :func:`s4a.analyse`.

    Returns
    -------
    Dataset
        ``collection_chamfer(algorithm, dense_match, shape)``, eq. 9 between each shape and the
        image of the median shape, the template, as a share of sqrt(area), NaN for the template;
        ``collection_seconds(algorithm, dense_match, block)``, CPU seconds of one core, full
        resolution alone differing by ``dense_match``; ``median_shape(algorithm)`` and
        ``distance_to_limit(algorithm, shape)``.  The attribute ``note`` says where k had to be
        reduced.

    Raises
    ------
    ValueError
        When a method is unknown or fewer than 2 shapes can be used.

    Examples
    --------
    >>> import s4a
    >>> brains = s4a.synthetic.brains(6, 200)
    >>> options = {"n_coarse": 100, "n_pairs": 6, "k_init": 6, "k": 10}
    >>> found = s4a.compare_collection(brains, methods=["RE-MATCH"], **options)
    >>> found["collection_chamfer"].dims
    ('algorithm', 'dense_match', 'shape')
    """
    check_some(methods, COLLECTION_METHODS)
    given: dict[str, Any] = {
        "init": init,
        "n_samples": n_samples,
        "dense_iterations": dense_iterations,
    }
    presets = {name: {key: STUDY_PRESETS[name][key] for key in given} for name in (None, "paper")}
    given = apply_preset(preset, given, presets) | {"seed": seed_of(seed, rng)}
    given |= {"n_coarse": n_coarse, "n_pairs": n_pairs, "k_init": k_init, "k": k, "step": step}
    options = Options(**given)
    begin = time.process_time()
    tree = shapes if isinstance(shapes, xr.DataTree) else read_shapes(shapes)
    load = time.process_time() - begin
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    if len(meshes) < 2:
        raise ValueError(f"a collection needs at least 2 shapes, found {len(meshes)}")
    with threadpool_limits(1):
        bar = tqdm(methods, desc="collection")
        rows = [one_collection(meshes, way, load, options) for way in bar]
    notes = {way: row.attrs.pop("note", "") for way, row in zip(methods, rows, strict=True)}
    table = xr.concat(rows, "algorithm").assign_coords(algorithm=list(methods))
    return table.assign_attrs(told(notes))


def one_collection(
    meshes: dict[str, xr.Dataset], way: str, load: float, options: Options
) -> xr.Dataset:
    """One row of Table 2."""
    names, clock = list(meshes), Clock()
    begin = time.process_time()
    spaces = [Spaces(mesh, options.n_coarse, options.k, options.seed) for mesh in meshes.values()]
    shapes = [space.local if way == "SCALABLE" else space.coarse for space in spaces]
    bases = [shape.low for shape in shapes]
    k = min(options.k, *(basis.k for basis in bases))
    source, target, maps = initial_maps(bases, options)
    shared = [load, time.process_time() - begin]
    samples = [basis.sample_vertices_of(options.n_samples) for basis in bases]
    growth: dict[str, Any] = {
        "step": options.step,
        "samples": samples,
        "dense_iterations": options.dense_iterations,
    }
    ends = source, target, k
    *_, Y, low = clock("latent", latent.consistent_zoomout, bases, maps, *ends, **growth)
    found = dataset(latent_basis=Y, latent_eigenvalue=low).assign_coords(shape=names)
    spectra = np.stack([basis.eigenvalue[:k] for basis in bases])
    found = clock("latent", median.median_shape, found, spectra)
    shared.append(clock["latent"])
    template = names.index(found.attrs["median"])
    chamfer, full = zip(
        *(chamfer_to_template(spaces, shapes, Y, template, how) for how in DENSE_MATCHES),
        strict=True,
    )
    measures = {
        "collection_chamfer": np.stack(chamfer),
        "collection_seconds": np.array([[*shared, seconds] for seconds in full]),
        "median_shape": np.array(names[template]),
    }
    table = xr.Dataset(
        {name: variable(name, values[None]).isel(algorithm=0) for name, values in measures.items()}
        | {"distance_to_limit": found["distance_to_limit"].variable},
        attrs=note_on_k(options.k, k),
    )
    return table.assign_coords(
        dense_match=list(DENSE_MATCHES), block=list(COLLECTION_BLOCKS), shape=names
    )


def initial_maps(bases: list[Basis], options: Options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Initial maps of a network, both ways: sources and targets ``(p,)``, maps ``(p, k, k)``."""
    k_init = min(options.k_init, *(basis.k for basis in bases))
    distance = network.spectral_distance([basis.eigenvalue[:k_init] for basis in bases])
    reference = bases[int(np.argmin(distance.sum(1)))]
    still = np.eye(3), np.zeros(3)
    transforms = [
        still if M is reference else align(M.X, M.area, reference.X, reference.area)[:2]
        for M in bases
    ]
    settings: dict[str, Any] = {"k_init": k_init, "init": options.init}
    settings["n_samples"] = options.n_samples
    ends, maps = [], []
    for i, j in network.choose_pairs(distance, options.n_pairs):
        M, N = bases[i], bases[j]
        R, t = realign(M.cloud, N.cloud, relative_transform(transforms[i], transforms[j]))
        maps.append(map_after_alignment(M, N, (R, t), **settings).C)
        maps.append(map_after_alignment(N, M, (R.T, -R.T @ t), **settings).C)
        ends += [(i, j), (j, i)]
    return *np.array(ends).T, np.stack(maps)


def chamfer_to_template(
    spaces: list[Spaces], shapes: list[Shape], Y: np.ndarray, template: int, dense_match: str
) -> tuple[np.ndarray, float]:
    """Eq. 9 of each shape and the image of the template ``(n,)``, NaN for it; CPU seconds."""
    chamfer = np.full(len(shapes), np.nan)
    seconds = 0.0
    for i, (space, shape) in enumerate(zip(spaces, shapes, strict=True)):
        if i == template:
            continue
        begin = time.process_time()
        ends = shape, shapes[template], (Y[i], Y[template])
        functions = (
            match_low(*ends, dense_match=dense_match)[1]
            if dense_match == DENSE_MATCHES[0]
            else latent_functions(*ends)
        )
        match, *_ = match_functions(shape, shapes[template], *functions)
        seconds += time.process_time() - begin
        chamfer[i] = metrics.chamfer(space.X, space.X[match])
    return chamfer, seconds
