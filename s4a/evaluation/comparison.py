"""Comparison of methods: Table 1 and Fig. 3 (5.2), Table 2 (5.3).

All methods use the same cleaned meshes.  :mod:`s4a.evaluation.methods` implements them.
"""

import io
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
    PAPER_METHODS,
    S4A_METHODS,
    Clock,
    Matches,
    Outcome,
    Pair,
    Spaces,
)
from s4a.geometry.align import relative_transform
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.collection import Mesh, as_mesh, read_shapes
from s4a.input.coordinates import in_one_system
from s4a.input.landmarks import locate
from s4a.input.raw import content, npy, reading, text_of
from s4a.method import latent, median, network
from s4a.method.alignment import IDENTITY, pair_transform, transform_onto
from s4a.method.initial_map import map_after_alignment
from s4a.method.register import latent_functions, log_area_ratio, match_functions, match_low
from s4a.method.shape import Basis, Shape
from s4a.options import DECLARED, Options, apply_preset
from s4a.schema import Array, check_choice, check_count, check_rows, check_switch, dataset, variable
from s4a.seeds import RNG, seed_of

log = logging.getLogger(__name__)

__all__ = ["COLLECTION_METHODS", "METHODS", "compare", "compare_collection"]

COLLECTION_METHODS = ("SCALABLE", "RE-MATCH")
COLLECTION_BLOCKS = BLOCKS[0], "basis and initial maps", "consistent ZoomOut", BLOCKS[-1]
DENSE_MATCHES = ("fmap", "latent")
FARTHEST = 0.1  # of a landmark, as a share of sqrt(area): meshes that are compared may be coarse
# iterations of RE-MATCH refined, and initial maps of all methods
PRESETS: dict[str | None, dict[str, Any]] = {
    None: {"full_resolution_iterations": 2, "init": "landmarks"},
    "paper": {"full_resolution_iterations": 0, "init": "landmarks"},
}


def check_some(methods: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError unless all methods are known."""
    wrong = [method for method in methods if method not in known]
    if wrong or not len(methods) or isinstance(methods, str):
        raise ValueError(f"methods must be some of {', '.join(known)}; found {wrong or methods!r}")


def _checked_methods(methods, preset):
    """Return the methods, by default all, or those of the paper with its preset."""
    if methods is None:
        return PAPER_METHODS if preset == "paper" else METHODS
    check_some(methods, METHODS)
    added = [method for method in methods if method in S4A_METHODS]
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


def _in_mesh(vertices, mesh):
    """Convert rows of a file to vertices of its clean mesh ``(n,)``.

    Rows that are -1, or were dropped by cleaning, become -1.
    """
    became = mesh["vertex_of_file"].values
    if vertices.max(initial=-1) >= len(became):
        raise ValueError(f"rows of the file must be below {len(became)}; found {vertices.max()}")
    return np.where(vertices >= 0, became[np.maximum(vertices, 0)], -1)


def _ground_truth_in_meshes(truth, source, target):
    """Convert ground truth for the rows of files to ground truth for clean meshes.

    Parameters
    ----------
    truth : ndarray (n_file_target,) of integers, or (n_file_target, 3)
        Rows of the source's file, or positions.
    source, target : Dataset
        From :func:`s4a.read_shape`.
    """
    n = target.sizes["file_vertex_index"]
    truth = check_rows("truth", truth, (n,), (n, 3), of="vertices of the target's file")
    if truth.ndim == 1 and truth.dtype.kind not in "iu":
        raise ValueError(f"truth needs integers, rows of the source's file; found {truth.dtype}")
    truth = truth[target["file_vertex"].values]
    return truth if truth.ndim == 2 else _in_mesh(truth, source)


def read_ground_truth(path: Path | str) -> Array:
    """Read ground truth for the vertices of the target's file.

    NPY, or text with one or three numbers in each row.
    """
    with reading(path, "truth"):
        data, mark = content(path), "," if str(path).endswith(".csv") else None
        is_npy = str(path).endswith(".npy")
        truth = npy(data) if is_npy else np.loadtxt(io.StringIO(text_of(data)), delimiter=mark)
    whole = truth.ndim == 1 and np.array_equal(truth, np.round(truth))
    return truth.astype(np.int64) if whole else truth


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
    """Compare the five methods of Table 1 and three of S4A on one or several pairs of meshes.

    All methods use the same cleaned meshes.

    kNN: nearest neighbour in space after rigid alignment.  ZO: from that match, ZoomOut at full
    resolution.  FMAP+ZO: functional map fitted on landmarks at full resolution, then ZoomOut.
    SCALABLE: the same in the space of :mod:`s4a.method.scalable`.  RE-MATCH: the same on the
    low-resolution mesh, and eq. 4 with U Phi, as ``s4a.match_pair(..., preset="paper")``.  All
    methods share the rigid alignment of ``alignment="search"``.

    S4A adds three methods.  RE-MATCH refined: eigenfunctions of
    :mod:`s4a.method.refined_eigenfunctions` instead of U Phi, and the final iterations of ZoomOut
    search all vertices of the source.  Registered: the matched vertices of the default of
    :func:`s4a.match_pair` after RE-MATCH.  Registered surface: the registered surface itself.

    Parameters
    ----------
    source : path or Dataset
        The reference; matches are indices of its vertices.
    target : path, Dataset, or dict of str to path or Dataset
        One mesh, or several with a name for each pair.
    methods : sequence of str, optional
        Some of :data:`METHODS`; by default all, or the five of the paper with its preset.
    truth : array, or dict of str to array, optional
        Ground truth: vertices or positions of the source, as in
        :func:`s4a.evaluation.metrics.evaluate`; a dict if `target` is a dict.  If shapes are given
        as paths, all vertices, here and in `landmarks`, are those of the files.
    landmarks : tuple, or dict of str to tuple, optional
        Corresponding vertices or positions ``(p, 3)`` (of the source, of the target); a dict if
        `target` is a dict.  By default 10 farthest-point samples of the source and the vertices of
        the target that are nearest after alignment (4.1, step 3).
    n_coarse : int
        Number of vertices of the low-resolution mesh, and of samples of SCALABLE.
    k_init, k : int
        Sizes of the initial and the refined map; at most the number of eigenfunctions.
    step : int
        Growth of the map in each iteration of ZoomOut, as in :func:`s4a.analyse`.
    preset : {None, "paper"}
        ``"paper"`` leaves out the methods of S4A and sets full_resolution_iterations=0 and
        init="landmarks"; other values raise ValueError.
    full_resolution_iterations : int, optional
        ZoomOut iterations of RE-MATCH refined that search all vertices of the source, by default 2.
    init : {"landmarks", "descriptors"}, optional
        Initial maps of all methods except kNN and ZO: from heat kernels around landmarks (default),
        as in :func:`s4a.match_pair` with the preset, or from wave kernels as in pyFM.
    n_geodesic : int
        See :func:`s4a.evaluation.metrics.evaluate`.
    keep : bool
        Whether to return meshes, matches and maps, too, for :class:`s4a.widgets.Comparison`: about
        30 bytes per vertex and method.
    seed : int
        Seed of the random numbers.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.

    Returns
    -------
    Dataset, or DataTree with `keep`
        Every metric of :func:`s4a.metrics.evaluate` over ``(algorithm, pair)``, and
        ``block_seconds(algorithm, pair, block)``, CPU seconds of one core for the blocks of Fig. 3.
        Results that methods share, such as the alignment or a basis, are computed once and charged
        to each method that uses them.  The attribute ``note`` names pairs with a reduced k.

        With `keep`, the metrics are the node ``/metrics`` of a tree; ``/source`` is the mesh of the
        source, and ``/pairs/<pair>`` that of a target with the results of every method.

    Raises
    ------
    ValueError
        If a method is unknown, a mesh lacks variables, or truth or landmarks do not fit.

    See Also
    --------
    compare_collection : Table 2, for a collection.
    s4a.metrics.evaluate : the metrics of one correspondence.

    Examples
    --------
    >>> import s4a
    >>> ball = s4a.synthetic.ellipsoid(300)
    >>> options = {"n_coarse": 100, "k_init": 6, "k": 10}
    >>> table = s4a.compare(ball, ball, methods=["kNN", "RE-MATCH"], **options)
    >>> table["chamfer"].sel(pair="pair", algorithm="kNN").item()
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
    methods = _checked_methods(methods, preset)
    in_memory = isinstance(source, xr.Dataset)
    if any(isinstance(mesh, xr.Dataset) != in_memory for mesh in target.values()):
        raise ValueError("source and targets need to be all paths or all Datasets")
    if keep and any("/" in str(name) for name in target):
        raise ValueError(f"with keep=True, names must not contain '/'; found {', '.join(target)}")
    options: dict[str, Any] = {"k_init": k_init, "k": k, "step": step} | settings
    rows, nodes, notes = [], {}, {}
    with threadpool_limits(1):
        mesh, load_source = load_mesh(source, "source")
        M = Spaces(mesh, n_coarse, k, seed)
        for name, shape in tqdm(target.items(), desc="pairs", disable=len(target) < 2):
            mesh, load_target = load_mesh(shape, f"target {name}")
            mesh = in_one_system({"source": M.mesh, "target": mesh})["target"]
            N = Spaces(mesh, n_coarse, k, seed)
            marks = None if landmarks is None else landmarks_of(landmarks[name], M, N, in_memory)
            true = None if truth is None else truth[name]
            if true is not None and not in_memory:
                true = _ground_truth_in_meshes(true, M.mesh, N.mesh)
            pair = Pair(M, N, marks, **options)
            row, outcomes = metrics_of_pair(
                pair, methods, load_source + load_target, true, n_geodesic
            )
            rows.append(row)
            notes[name] = row.attrs.pop("note", "")
            if keep:
                nodes[f"pairs/{name}"] = _with_results(M.mesh, N.mesh, outcomes, true)
    table = xr.concat(rows, "pair", combine_attrs="drop_conflicts")
    table = table.assign_coords(pair=list(target)).transpose("algorithm", "pair", ...)
    table = table.assign_attrs(options | {"n_coarse": n_coarse, "seed": seed} | _joint_note(notes))
    if not keep:
        return table
    return xr.DataTree.from_dict(
        {"metrics": table, "source": M.mesh.drop_vars(M.mesh.coords), **nodes}
    )


def _note_on_k(k, least):
    """Return a note as an attribute if meshes have fewer eigenfunctions than k."""
    note = f"k = {k} reduced to {least}, the number of eigenfunctions of the smaller mesh"
    return {"note": note} if least < k else {}


def _joint_note(notes):
    """Log the notes of all pairs and return them as one attribute, if there are any."""
    note = "; ".join(f"{name}: {text}" for name, text in notes.items() if text)
    if not note:
        return {}
    log.warning("%s", note)
    return {"note": note}


def _with_results(source, target, outcomes, truth):
    """Return the target's mesh with the results of every method.

    Returns
    -------
    Dataset
        ``algorithm_match(algorithm, vertex)``; ``algorithm_image(algorithm, vertex, xyz)``, the
        target's vertices on the source, in its unit; ``algorithm_reverse(algorithm,
        source_vertex)``, the match in the other direction; ``algorithm_area_change(algorithm,
        vertex)``, the log area ratio of :func:`s4a.method.register.log_area_ratio`.  If any method
        has maps, ``algorithm_fmap(algorithm, eigenpair_target, eigenpair_source)`` and
        ``algorithm_fmap_initial``, NaN for the others.  With ground truth
        ``true_position(vertex, xyz)``, ``true_match(vertex)`` and
        ``algorithm_error(algorithm, vertex)``, the Euclidean error as a share of sqrt(area), NaN if
        unknown.
    """
    (X, T), (Y, S), results = as_arrays(source), as_arrays(target), outcomes.values()
    images = [X[r.match] if r.image is None else r.image for r in results]
    variables: dict[str, ArrayLike] = {
        "algorithm_match": np.stack([r.match for r in results]).astype(np.int32),
        "algorithm_reverse": np.stack([r.reverse for r in results]).astype(np.int32),
        "algorithm_image": np.stack(images).astype(np.float32),
        "algorithm_area_change": np.stack([log_area_ratio(image, Y, S) for image in images]).astype(
            np.float32
        ),
    }
    if any(r.fmap is not None for r in results):
        variables["algorithm_fmap"] = stacked([r.fmap for r in results])
        variables["algorithm_fmap_initial"] = stacked([r.initial for r in results])
    if truth is not None:
        true, vertex = metrics.true_positions(truth, X, len(Y))
        errors = np.linalg.norm(np.stack(images) - true, axis=2) / np.sqrt(vertex_areas(X, T).sum())
        variables |= {"true_position": true, "true_match": vertex.astype(np.int32)}
        variables["algorithm_error"] = errors.astype(np.float32)
    mesh = target.drop_vars(target.coords).merge(dataset(None, **variables))
    return mesh.assign_coords(algorithm=list(outcomes))


def stacked(maps: list[Array | None]) -> Array:
    """Stack maps in one array, padded with NaN.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.evaluation.comparison import stacked
    >>> stacked([None, np.eye(2)]).shape
    (2, 2, 2)
    """
    sizes = [C.shape for C in maps if C is not None]
    stack = np.full((len(maps), *np.max(sizes, axis=0)), np.nan)
    for padded, C in zip(stack, maps, strict=True):
        if C is not None:
            padded[: C.shape[0], : C.shape[1]] = C
    return stack


def landmarks_of(given: Any, source: Spaces, target: Spaces, clean: bool) -> Matches:
    """Return landmarks as vertices of both meshes.

    Positions ``(p, 3)``, or those of a Dataset of :func:`s4a.input.annotations.read_landmarks`,
    give the nearest vertices, rows of files those of the clean meshes.
    """
    ends: list[Array] = []
    for marks, space in zip(given, (source, target), strict=True):
        if isinstance(marks, xr.Dataset):
            marks = locate(marks, space.mesh, farthest=FARTHEST)["landmark_position"]
        v = np.asarray(marks)
        if v.ndim == 2 and v.shape[1] == 3:
            v = cKDTree(space.mesh["position"].values).query(v)[1]
        elif not clean and v.dtype.kind in "iu":
            v = _in_mesh(v, space.mesh)
        ends.append(v)
        good = v.ndim == 1 and v.dtype.kind in "iu" and len(v) >= 3
        if not (good and 0 <= v.min() <= v.max() < len(space.X) and len(v) == len(ends[0])):
            raise ValueError(
                "landmarks need two arrays of at least 3 vertices that the clean meshes have, of "
                f"the source and of the target; found {v.tolist()} of the "
                f"{'target' if len(ends) > 1 else 'source'}"
            )
    return ends[0], ends[1]


def metrics_of_pair(
    pair: Pair, methods: Sequence[str], load: float, truth: Array | None, n_geodesic: int
) -> tuple[xr.Dataset, dict[str, Outcome]]:
    """Run all methods on one pair; return metrics and times, and the outcomes."""
    outcomes = {method: pair.run(method) for method in methods}
    options: dict[str, Any] = {"truth": truth, "n_geodesic": n_geodesic}
    rows, seconds = [], []
    M, N = pair.source.mesh, pair.target.mesh
    for outcome in outcomes.values():
        options |= {"image": outcome.image, "reverse": outcome.reverse}
        rows.append(metrics.evaluate(M, N, outcome.match, **options))
        spent = {**outcome.seconds, BLOCKS[0]: load}
        seconds.append([spent.get(block, 0.0) for block in BLOCKS])
    table = xr.concat(rows, "algorithm", combine_attrs="drop_conflicts")
    table["block_seconds"] = variable("block_seconds", np.array(seconds)[:, None]).isel(pair=0)
    least = min((len(r.fmap) for r in pair.spectral.values()), default=pair.k)
    table.attrs |= _note_on_k(pair.k, least)
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
    """Compare SCALABLE and RE-MATCH on a collection (Table 2).

    Full-resolution matches are computed by functional maps ("standard" in the paper) and by the
    latent bases ("ours").

    Parameters
    ----------
    shapes : path, list of paths, dict or DataTree
        As for :func:`s4a.read_shapes`, or its result.
    methods : sequence of str
        Some of :data:`COLLECTION_METHODS`.
    n_coarse, n_pairs, k_init, k, step, seed, rng
        See :func:`s4a.analyse`.
    preset : {None, "paper"}
        ``"paper"`` sets init="landmarks", n_samples=0, dense_iterations=0 and plain ICP; another
        value of these is refused.
    init, n_samples, dense_iterations
        Options of the initial maps and of Consistent ZoomOut, see :func:`s4a.analyse`.

    Returns
    -------
    Dataset
        ``collection_chamfer(algorithm, dense_match, shape)``, eq. 9 between each shape and the
        image of the median shape, the template, as a share of sqrt(area), NaN for the template;
        ``collection_seconds(algorithm, dense_match, block)``, CPU seconds of one core;
        ``median_shape(algorithm)`` and ``distance_to_limit(algorithm, shape)``.  The attribute
        ``note`` names methods with a reduced k.

    Raises
    ------
    ValueError
        If a method is unknown or fewer than 2 shapes can be used.

    See Also
    --------
    compare : Table 1, for pairs.

    Examples
    --------
    >>> import s4a
    >>> brains = s4a.synthetic.brains(6, 200)
    >>> options = {"n_coarse": 100, "n_pairs": 6, "k_init": 6, "k": 10}
    >>> table = s4a.compare_collection(brains, methods=["RE-MATCH"], **options)
    >>> table["collection_chamfer"].dims
    ('algorithm', 'dense_match', 'shape')
    """
    check_some(methods, COLLECTION_METHODS)
    given = {name: value for name, value in locals().items() if name in DECLARED}
    options = Options(**given | {"seed": seed_of(seed, rng)})
    begin = time.process_time()
    tree = shapes if isinstance(shapes, xr.DataTree) else read_shapes(shapes)
    load = time.process_time() - begin
    nodes = tree["original"].children
    meshes = in_one_system({name: node.to_dataset() for name, node in nodes.items()})
    if len(meshes) < 2:
        raise ValueError(f"a collection needs at least 2 shapes, found {len(meshes)}")
    with threadpool_limits(1):
        bar = tqdm(methods, desc="collection")
        rows = [_run_collection(meshes, method, load, options) for method in bar]
    notes = {m: row.attrs.pop("note", "") for m, row in zip(methods, rows, strict=True)}
    table = xr.concat(rows, "algorithm").assign_coords(algorithm=list(methods))
    return table.assign_attrs(_joint_note(notes))


class LatentCollection(NamedTuple):
    """Latent bases of a collection, its median shape, and CPU seconds of the first three blocks."""

    spaces: list[Spaces]
    shapes: list[Shape]
    Y: Array  # (n_shape, k, m)
    template: int
    distance_to_limit: xr.Variable
    seconds: list[float]

    def functions(self, source: int, target: int, dense_match: str) -> tuple[Array, Array]:
        """Return the functions of both shapes that eq. 4 or eq. 7 compares, at low resolution."""
        ends = self.shapes[source], self.shapes[target], (self.Y[source], self.Y[target])
        if dense_match == DENSE_MATCHES[0]:
            return match_low(*ends, dense_match=dense_match)[1]
        return latent_functions(*ends)

    def match(self, source: int, target: int, dense_match: str) -> Array:
        """Return the matched vertices of the source ``(n_target,)`` by eq. 4 or eq. 7."""
        functions = self.functions(source, target, dense_match)
        return match_functions(self.shapes[source], self.shapes[target], *functions)[0]


def _run_collection(meshes, method, load, options):
    """Compute one row of Table 2."""
    found, names = latent_collection(meshes, method, load, options), list(meshes)
    chamfer, full = zip(*(chamfer_to_template(found, how) for how in DENSE_MATCHES), strict=True)
    measures = {
        "collection_chamfer": np.stack(chamfer),
        "collection_seconds": np.array([[*found.seconds, seconds] for seconds in full]),
        "median_shape": np.array(names[found.template]),
    }
    table = xr.Dataset(
        {name: variable(name, values[None]).isel(algorithm=0) for name, values in measures.items()}
        | {"distance_to_limit": found.distance_to_limit},
        attrs=_note_on_k(options.k, found.Y.shape[1]),
    )
    return table.assign_coords(
        dense_match=list(DENSE_MATCHES), block=list(COLLECTION_BLOCKS), shape=names
    )


def latent_collection(
    meshes: dict[str, xr.Dataset], method: str, load: float, options: Options
) -> LatentCollection:
    """Compute initial maps, Consistent ZoomOut and the median shape of a collection."""
    names, clock = list(meshes), Clock()
    begin = time.process_time()
    spaces = [Spaces(mesh, options.n_coarse, options.k, options.seed) for mesh in meshes.values()]
    shapes = [space.local if method == "SCALABLE" else space.coarse for space in spaces]
    bases = [shape.low for shape in shapes]
    k = min(options.k, *(basis.k for basis in bases))
    source, target, maps = initial_maps(bases, options)
    seconds = [load, time.process_time() - begin]
    samples = [basis.sample_vertices_of(options.n_samples) for basis in bases]
    names_of_growth = "step", "n_latent", "weights", "isometric", "dense_iterations"
    growth: dict[str, Any] = {name: getattr(options, name) for name in names_of_growth}
    growth["samples"] = samples
    ends = source, target, k
    *_, Y, low = clock("latent", latent.consistent_zoomout, bases, maps, *ends, **growth)
    result = dataset(latent_basis=Y, latent_eigenvalue=low).assign_coords(shape=names)
    spectra = np.stack([basis.eigenvalue[:k] for basis in bases])
    result = clock("latent", median.median_shape, result, spectra)
    seconds.append(clock["latent"])
    template = names.index(result.attrs["median"])
    return LatentCollection(
        spaces, shapes, Y, template, result["distance_to_limit"].variable, seconds
    )


def initial_maps(bases: list[Basis], options: Options) -> tuple[Array, Array, Array]:
    """Compute initial maps of a network: sources and targets ``(p,)``, maps ``(p, k, k)``."""
    k_init = min(options.k_init, *(basis.k for basis in bases))
    distance = network.spectral_distance([basis.eigenvalue[:k_init] for basis in bases])
    reference = bases[int(np.argmin(distance.sum(1)))]
    transforms = [
        IDENTITY if M is reference else transform_onto(M, reference, options.alignment)
        for M in bases
    ]
    settings: dict[str, Any] = {"k_init": k_init, "init": options.init}
    settings["n_samples"] = options.n_samples
    ends, maps = [], []
    for i, j in network.choose_pairs(distance, options.n_pairs):
        M, N = bases[i], bases[j]
        start = relative_transform(transforms[i], transforms[j])
        R, t = pair_transform(M, N, start, options.alignment)
        maps.append(map_after_alignment(M, N, (R, t), **settings).C)
        maps.append(map_after_alignment(N, M, (R.T, -R.T @ t), **settings).C)
        ends += [(i, j), (j, i)]
    return *np.array(ends).T, np.stack(maps)


def chamfer_to_template(found: LatentCollection, dense_match: str) -> tuple[Array, float]:
    """Return eq. 9 of each shape and the image of the template ``(n,)``, and CPU seconds."""
    chamfer = np.full(len(found.shapes), np.nan)
    seconds = 0.0
    for i, space in enumerate(found.spaces):
        if i == found.template:
            continue
        begin = time.process_time()
        match = found.match(i, found.template, dense_match)
        seconds += time.process_time() - begin
        chamfer[i] = metrics.chamfer(space.X, space.X[match])
    return chamfer, seconds
