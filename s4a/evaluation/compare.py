"""The methods of the paper's comparison side by side.

Table 1 and Fig. 3 (5.2), Table 2 (5.3), on one cleaned input.

Times are CPU seconds of one core, so that a busy machine does not change them.
"""

import time
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from s4a.evaluation import metrics
from s4a.geometry.align import align, farthest_points, motion_between, realign
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.collection import read_shape, read_shapes
from s4a.method import fmap, joint, latent, median, network
from s4a.method.lift import SPARE, lift
from s4a.method.nearest import nearest_in_cells
from s4a.method.register import Scan, at_full_resolution, intrinsic_match, sharpened
from s4a.method.remesh import coarsen, laplacian
from s4a.method.scalable import Reduced, local_space, spectral_space
from s4a.method.spectral import eigenpairs, spectrum
from s4a.schema import dataset, require, variable

__all__ = ["COLLECTION_METHODS", "METHODS", "collection", "pair", "pairs"]

METHODS = ("kNN", "ZO", "FMAP+ZO", "SCALABLE", "RE-MATCH", "RE-MATCH joint")
BLOCKS = ("load and clean", "align", "sample", "basis", "map", "refine", "full resolution")
COLLECTION_BLOCKS = (
    "load and clean",
    "basis and first maps",
    "consistent ZoomOut",
    "full resolution",
)
COLLECTION_METHODS, HOW = ("SCALABLE", "RE-MATCH"), ("standard", "ours")
SPREAD = 3000  # points of each shape by which it is aligned, and around which full-resolution searches are grouped
N_LANDMARKS = 10


@dataclass
class Shape:
    """A clean mesh and what the methods make of it, each made once.

    ``seconds`` says what it took, by its name.
    """

    mesh: object
    n_coarse: int = 6000
    k: int = 100
    seed: int = 0
    seconds: dict = field(default_factory=dict)

    def timed(self, what, function, *arguments, **options):
        begin = time.process_time()
        found = function(*arguments, **options)
        self.seconds[what] = time.process_time() - begin
        return found

    @cached_property
    def frame(self):
        X, T = as_arrays(self.mesh)
        area = vertex_areas(X, T)
        return area @ X / area.sum(), np.sqrt(area.sum())

    @cached_property
    def X(self):
        """Vertices centred and for unit area ``(n, 3)``."""
        center, size = self.frame
        return (self.mesh["position"].values - center) / size

    @cached_property
    def spread(self):
        """Spread points ``(p, 3)``, their areas of sum 1.

        And the nearest of them for every vertex ``(n,)``.
        """

        def spread():
            X, T = as_arrays(self.mesh)
            some = farthest_points(self.X, SPREAD)
            cell = cKDTree(self.X[some]).query(self.X)[1]
            area = np.bincount(cell, vertex_areas(X, T), len(some))
            return self.X[some], area / area.sum(), cell

        return self.timed("spread", spread)

    @cached_property
    def dense(self):
        """The mesh itself as a space of its first eigenfunctions, U the identity."""

        def dense():
            X, T = as_arrays(self.mesh)
            E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
            eigenvalue, Phi = eigenpairs(E, w, area, self.k)
            area = area / area.sum()
            return Reduced(self.X, area, area, Phi, eigenvalue, None, self.spread[2])

        return self.timed("dense basis", dense)

    @cached_property
    def local(self):
        """The space of SCALABLE."""
        parts = self.timed("local sample", local_space, self.mesh, self.n_coarse, self.seed)
        return self.timed("local basis", spectral_space, *parts, self.k)

    @cached_property
    def low(self):
        """The low-resolution mesh of RE-MATCH, with a few eigenfunctions more than are used."""
        coarse = self.timed(
            "lifted sample", coarsen, self.mesh, n_coarse=self.n_coarse, seed=self.seed
        )
        return self.timed("lifted basis", spectrum, coarse, k=self.k + SPARE)

    @cached_property
    def scan(self):
        """Both resolutions of RE-MATCH."""
        return Scan(self.mesh, self.low.isel(mode=slice(self.k)))

    @cached_property
    def coarse(self):
        """The low-resolution mesh as a space of its own eigenfunctions."""
        scan = self.scan
        return Reduced(
            scan.low.X,
            scan.low.area,
            scan.low.area,
            scan.low.Phi,
            scan.eigenvalue,
            scan.U,
            scan.cell,
        )

    @cached_property
    def lifted(self):
        """The space of RE-MATCH.

        The vertices of the low-resolution mesh, and functions of :mod:`s4a.method.lift`.
        """
        scan = self.scan
        spectral = self.seconds["lifted basis"]
        space = self.timed("lifted basis", lifted_space, scan, self.low, self.k)
        self.seconds["lifted basis"] += spectral
        return space


@dataclass(frozen=True)
class Lifted(Reduced):
    """The vertices of a low-resolution mesh, with functions ``B (n, k)`` that all vertices have.

    Phi are rows of B.
    """

    B: np.ndarray


def lifted_space(scan, low, k):
    """The functions of :mod:`s4a.method.lift`.

    Made orthonormal for the areas of the low-resolution mesh, as ZoomOut needs it.

    Parameters
    ----------
    scan : Scan
    low : Dataset
        The low-resolution mesh with some eigenfunctions more than k.
    """
    X, T = as_arrays(scan.original)
    eigenvalue, B = lift(X, T, vertex_areas(X, T), scan.U, low, k)
    at = low["sample_vertex"].values.copy()
    cell, some = np.unique(scan.cell, return_index=True)
    at[cell] = np.where(at[cell] < 0, some, at[cell])  # centres of closed openings are no vertices
    area, Phi = scan.low.area, B[at].astype(float)
    turn = np.linalg.inv(np.linalg.cholesky(Phi.T @ (area[:, None] * Phi))).T
    B = B @ turn.astype(B.dtype)
    return Lifted(scan.low.X, area, area, B[at].astype(float), eigenvalue, scan.U, scan.cell, B)


def at_all_vertices(space, C=None):
    """The functions of a space, or Phi C^T, at all vertices of its mesh ``(n, k)``."""
    Phi = space.B if isinstance(space, Lifted) else space.Phi
    F = Phi if C is None else Phi[:, : C.shape[1]] @ C.T.astype(Phi.dtype)
    return F if space.U is None or isinstance(space, Lifted) else space.U @ F.astype(np.float32)


class Clock:
    """CPU seconds by block."""

    def __init__(self):
        self.seconds = dict.fromkeys(BLOCKS, 0.0)

    def __call__(self, block, function, *arguments, **options):
        begin = time.process_time()
        found = function(*arguments, **options)
        self.seconds[block] += time.process_time() - begin
        return found


def default_landmarks(source, target, motion, n=N_LANDMARKS):
    """Steps 2 and 3 of 4.1: spread vertices of the source.

    And the vertices of the target nearest to them.
    """
    some = farthest_points(source.X, n)
    return some, cKDTree(target.X).query(source.X[some] @ motion[0].T + motion[1])[1]


def knn(source, target, motion):
    """Nearest neighbours of the aligned shapes in space.

    Of the target's vertices and of the source's.
    """
    moved = source.X @ motion[0].T + motion[1]
    return cKDTree(moved).query(target.X)[1], cKDTree(target.X).query(moved)[1]


def fit(M, N, landmarks, k):
    """First map from landmarks and wave kernel signatures, in any space ``(k, k)``.

    See `fit_descriptors`.
    """
    ends = [
        (s, mark if s.U is None else s.cell[mark])
        for s, mark in zip((M, N), landmarks, strict=True)
    ]
    meshes = [
        dataset(
            position=s.X,
            corner_vertex=np.zeros(
                (0, 3), np.int32
            ),  # they are for orientation, which is not asked for
            vertex_area=s.area,
            eigenvalue=s.eigenvalue,
            eigenfunction=s.Phi,
        )
        for s, _ in ends
    ]
    return fmap.fit_descriptors(*meshes, k=k, landmarks=[mark for _, mark in ends], oriented=0)[
        "fmap"
    ].values


def spectral_match(way, source, target, motion, landmarks, clock, *, k_init, k, step):
    """ZO, FMAP+ZO, SCALABLE and RE-MATCH: first map, ZoomOut and match at full resolution.

    Returns
    -------
    match : int ndarray (n_target,)
    reverse : callable
        Gives the match the other way, which no method needs.
    low : tuple
        Match at low resolution and functions of both ends, for joint rounds.
    """
    name = {"ZO": "dense", "FMAP+ZO": "dense", "SCALABLE": "local"}.get(way, "lifted")
    M, N = getattr(source, name), getattr(target, name)
    for block in ("sample", "basis"):
        clock.seconds[block] += sum(s.seconds.get(f"{name} {block}", 0.0) for s in (source, target))
    if way == "ZO":
        match = clock("map", lambda: knn(source, target, motion)[0])
        C = clock("map", fmap.fmap_from_match, M.Phi[:, :k_init], N.Phi[:, :k_init], N.mass, match)
    else:
        C = clock("map", fit, M, N, landmarks, k_init)
    nearest = {
        "dense": lambda Q, D: nearest_in_cells(Q, N.cell, D, M.cell)[0],
        "local": fmap.nearest_rows,
        "lifted": lambda Q, D: fmap.nearly_nearest(
            fmap.queries(Q), fmap.searched(D)
        ),  # other searches follow
    }[name]
    C, low = clock("refine", fmap.zoomout, C, M.Phi, N.Phi, N.mass, k, step=step, nearest=nearest)
    if name == "lifted":
        for _ in range(2):
            C = clock("refine", sharpened, C, M.B, N.Phi, N.mass, M.cell)
    F = clock("full resolution", at_all_vertices, M, C), at_all_vertices(N)
    if name == "dense":
        match = low
    else:
        match = clock("full resolution", nearest_in_cells, F[1], N.cell, F[0], M.cell)[0]
    return match, lambda: nearest_in_cells(F[0], M.cell, F[1], N.cell)[0], (low, F)


def joint_match(source, target, motion, low, clock, k):
    """RE-MATCH with joint rounds: match and registered surface at full resolution."""
    M, N = source.scan, target.scan
    starts = {
        "intrinsic": low[0],
        "icp": cKDTree(M.low.X @ motion[0].T + motion[1]).query(N.low.X)[1],
    }
    found = clock("refine", joint.candidates, M.low, N.low, starts, k=k)
    return clock("full resolution", at_full_resolution, M, N, found, low[1])[:2]


def nearest_vertices(mesh, image):
    """The nearest row of an image ``(p, 3)`` for every vertex of a mesh ``(n,)``."""
    return cKDTree(image).query(mesh["position"].values)[1]


def checked_methods(methods):
    """ValueError unless all are some of :data:`METHODS`."""
    wrong = [m for m in methods if m not in METHODS]
    if wrong or not len(methods) or isinstance(methods, str):
        raise ValueError(
            f"methods must be some of {', '.join(METHODS)}; found {wrong or methods!r}"
        )


def loaded(shape, what):
    """A mesh and the seconds it took to read and clean it.

    None for a Dataset, which is taken as clean.
    """
    if isinstance(shape, xr.Dataset):
        require(shape, "position", "corner_vertex", what=what)
        return shape, 0.0
    begin = time.process_time()
    mesh = read_shape(shape)
    return mesh, time.process_time() - begin


def in_mesh(vertices, mesh):
    """Vertices of the mesh that rows of its file became ``(n,)``.

    -1 where they are -1 or were dropped.
    """
    became = mesh["vertex_of_file"].values
    if vertices.max(initial=-1) >= len(became):
        raise ValueError(f"rows of the file, below {len(became)}, needed; found {vertices.max()}")
    return np.where(vertices >= 0, became[np.maximum(vertices, 0)], -1)


def truth_in_meshes(truth, source, target):
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
            f"truth needs a row of the source's file (integer, -1 where there is none) or a position for each of the "
            f"{n} vertices of the target's file; found {truth.dtype} of shape {truth.shape}"
        )
    truth = truth[target["file_vertex"].values]
    return truth if truth.ndim == 2 else in_mesh(truth, source)


def read_truth(path):
    """Truth from a file: NPY, or text with a number or three in each row.

    For the vertices of the target's file.
    """
    try:
        found = (
            np.load(path)
            if str(path).endswith(".npy")
            else np.loadtxt(path, delimiter=_delimiter(path))
        )
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as truth: {error}") from error
    whole = found.ndim == 1 and np.array_equal(found, np.round(found))
    return found.astype(np.int64) if whole else found


def _delimiter(path):
    return "," if str(path).endswith(".csv") else None


def pair(source, target, *, truth=None, landmarks=None, **options):
    """Table 1 for one pair: see :func:`pairs`.

    Parameters
    ----------
    source, target : path or Dataset
    truth, landmarks, **options
        As the values of :func:`pairs`, and its other options.

    Returns
    -------
    Dataset
        Of :func:`pairs`, with one `pair`.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> ball = s4a.synthetic.ellipsoid(600)
    >>> found = s4a.compare.pair(ball, ball, methods=["kNN"], truth=np.arange(600))
    >>> float(found["geodesic_error"].sel(way="kNN").item())
    0.0
    """

    def one(value):
        return None if value is None else {"pair": value}

    return pairs(source, {"pair": target}, truth=one(truth), landmarks=one(landmarks), **options)


def pairs(
    source,
    targets,
    *,
    methods=METHODS,
    truth=None,
    landmarks=None,
    n_coarse=6000,
    k_init=20,
    k=100,
    step=5,
    n_geodesic=1000,
    seed=0,
):
    """The five pair methods of Table 1, and joint rounds after the last, on the same cleaned input.

    kNN: nearest neighbour in space after rigid alignment.  ZO: from that match, ZoomOut at full
    resolution.  FMAP+ZO: functional map fitted on landmarks and descriptors at full resolution,
    then ZoomOut.  SCALABLE: the same in the space of :mod:`s4a.method.scalable`.  RE-MATCH: the
    same on the low-resolution mesh, with the eigenfunctions of :mod:`s4a.method.lift` at its
    vertices, and eq. 4; the last two rounds of ZoomOut look among all vertices of the source.
    RE-MATCH joint: joint rounds after that.

    Parameters
    ----------
    source : path or Dataset
        The reference; every match holds its vertices.
    targets : dict
        Name of the pair -> path or Dataset.
    methods : sequence of str
        Some of :data:`METHODS`.
    truth : dict, optional
        Name of the pair -> true vertices or positions, as of
        :func:`s4a.evaluation.metrics.evaluate`; for shapes given as paths all vertices, here and in
        `landmarks`, are those of the files.
    landmarks : dict, optional
        Name of the pair -> corresponding vertices or positions ``(p, 3)`` (of the source, of the
        target); by default 10 spread vertices of the source and the vertices of the target that are
        nearest after alignment (4.1, step 3).
    n_coarse : int
        Vertices of the low-resolution mesh, and samples of SCALABLE.
    k_init, k : int
        Sizes of the first and of the refined map.
    step : int
        Growth of the map per round of ZoomOut, as in :func:`s4a.analyse`.  Steps of 10 take half
        the time of that block of ZO and FMAP+ZO; on a child of 60,000 vertices in two poses they
        end 7 to 9 % farther from the truth.
    n_geodesic : int
        See :func:`s4a.evaluation.metrics.evaluate`.
    seed : int

    Returns
    -------
    Dataset
        Every metric of :func:`s4a.evaluation.metrics.evaluate` over ``(way, pair)``, ``way`` the
        method, and ``block_seconds(way, pair, block)``, the blocks of Fig. 3, in CPU seconds of one
        core.  What two methods share, as the alignment or a basis, is made once and charged to
        both; the alignment only to those that use it, which with given landmarks are kNN, ZO and
        the joint rounds.

    Raises
    ------
    ValueError
        When a method is unknown, a mesh lacks its variables, or truth or landmarks do not fit.

    Examples
    --------
    >>> import s4a
    >>> ball = s4a.synthetic.ellipsoid(300)
    >>> options = {"n_coarse": 100, "k_init": 6, "k": 10}
    >>> found = s4a.compare.pairs(ball, {"itself": ball}, methods=["kNN", "RE-MATCH"], **options)
    >>> found["chamfer"].sel(pair="itself", way="kNN").item()
    0.0
    """
    checked_methods(methods)
    rows = []
    with threadpool_limits(1):
        if any(
            isinstance(t, xr.Dataset) != isinstance(source, xr.Dataset) for t in targets.values()
        ):
            raise ValueError("source and targets need to be all paths or all Datasets")
        mesh, load = loaded(source, "source")
        M = Shape(mesh, n_coarse, k, seed)
        for name, target in tqdm(targets.items(), desc="pairs", disable=len(targets) < 2):
            mesh, seconds = loaded(target, f"target {name}")
            N = Shape(mesh, n_coarse, k, seed)
            given = None if landmarks is None else [np.asarray(v) for v in landmarks[name]]
            truth_here = None if truth is None else truth[name]
            if given is not None:
                given = [
                    landmark_vertices(v, s.mesh, isinstance(target, xr.Dataset))
                    for v, s in zip(given, (M, N), strict=True)
                ]
                check_landmarks(*given, M, N)
            if truth is not None and not isinstance(target, xr.Dataset):
                truth_here = truth_in_meshes(truth_here, M.mesh, N.mesh)
            options = {"k_init": k_init, "k": k, "step": step}
            rows.append(
                one_pair(M, N, methods, given, load + seconds, truth_here, n_geodesic, options)
            )
    found = xr.concat(rows, "pair", combine_attrs="drop_conflicts")
    attrs = {"n_coarse": n_coarse, "k_init": k_init, "k": k, "step": step, "seed": seed}
    return found.assign_coords(pair=list(targets)).transpose("way", "pair", ...).assign_attrs(attrs)


def landmark_vertices(given, mesh, clean):
    """Vertices of the mesh: the nearest ones to positions ``(p, 3)``.

    Or those that rows of its file became.
    """
    if given.ndim == 2 and given.shape[1] == 3:
        return cKDTree(mesh["position"].values).query(given)[1]
    return given if clean or given.dtype.kind not in "iu" else in_mesh(given, mesh)


def check_landmarks(at_source, at_target, source, target):
    """ValueError unless they are pairs of vertices of both shapes."""
    ends = ((at_source, source), (at_target, target))
    good = all(v.ndim == 1 and v.dtype.kind in "iu" and v.min(initial=0) >= 0 for v, _ in ends)
    if (
        not good
        or len(at_source) != len(at_target)
        or len(at_source) < 3
        or any(v.max() >= len(s.X) for v, s in ends)
    ):
        raise ValueError(
            "landmarks need two arrays of at least 3 vertices that the clean meshes have, of the source and of the "
            f"target; found {at_source.tolist()} and {at_target.tolist()}"
        )


def motion_and_landmarks(source, target, landmarks, low, clock):
    """Steps 2 and 3 of 4.1: by the low-resolution meshes, as RE-MATCH has them.

    Or else by spread points.
    """
    ends = [(s.scan.low.X, s.scan.low.area) if low else s.spread[:2] for s in (source, target)]
    motion = clock("align", align, *ends[0], *ends[1])[:2]
    if landmarks is None:
        landmarks = clock("align", default_landmarks, source, target, motion)
    return motion, landmarks


def one_pair(source, target, methods, landmarks, load, truth, n_geodesic, options):
    """All methods on one pair: metrics and times over ``way``."""
    aligned = {}
    for low in (False, True):
        common = Clock()
        if any(way.startswith("RE-MATCH") == low for way in methods):
            aligned[low] = (
                motion_and_landmarks(source, target, landmarks, low, common),
                common.seconds,
            )
    done, rows, times = {}, [], []
    for way in methods:
        clock, image, reverse = Clock(), None, None
        remeshed = way.startswith("RE-MATCH")
        (motion, marks), spent = aligned[remeshed]
        clock.seconds["load and clean"] = load
        aligns = landmarks is None or way in ("kNN", "ZO", "RE-MATCH joint")
        clock.seconds["align"] = spent["align"] * aligns
        if not remeshed and (aligns or way == "FMAP+ZO"):
            clock.seconds["align" if aligns else "refine"] += (
                source.seconds["spread"] + target.seconds["spread"]
            )
        if way == "kNN":
            match, back = clock("full resolution", knn, source, target, motion)
            reverse = partial(np.asarray, back)
        else:
            stem = way.removesuffix(" joint")
            if stem not in done:
                shared = Clock()
                done[stem] = (
                    *spectral_match(stem, source, target, motion, marks, shared, **options),
                    shared.seconds,
                )
            match, reverse, low, spent = done[stem]
            for block, seconds in spent.items():
                clock.seconds[block] += seconds
            if way != stem:
                match, image = joint_match(source, target, motion, low, clock, options["k"])
                reverse = partial(nearest_vertices, source.mesh, image)
        found = metrics.evaluate(
            source.mesh,
            target.mesh,
            match,
            image=image,
            reverse=reverse(),
            truth=truth,
            n_geodesic=n_geodesic,
        )
        rows.append(found)
        times.append([clock.seconds[block] for block in BLOCKS])
    found = xr.concat(rows, "way", combine_attrs="drop_conflicts")
    found["block_seconds"] = variable("block_seconds", np.array(times)[:, None]).isel(pair=0)
    return found.assign_coords(way=list(methods), block=list(BLOCKS))


def collection(
    shapes,
    *,
    methods=COLLECTION_METHODS,
    n_coarse=6000,
    n_pairs=500,
    k_init=20,
    k=100,
    step=5,
    seed=0,
):
    """Table 2: the collection in the space of SCALABLE and of RE-MATCH.

    To full resolution the standard way and ours.

    Parameters
    ----------
    shapes : path, list of paths, dict or DataTree
        As of :func:`s4a.read_shapes`, or what it gives.
    methods : sequence of str
        Some of :data:`COLLECTION_METHODS`.
    n_coarse, n_pairs, k_init, k, step, seed
        See :func:`s4a.analyse`; first maps are those of nearest neighbours after alignment.

    Returns
    -------
    Dataset
        ``collection_chamfer(way, how, shape)``, eq. 9 between each shape and the image of the
        median shape, the template, as a share of sqrt(area), NaN for the template;
        ``collection_seconds(way, how, block)``, CPU seconds of one core, full resolution alone
        differing by ``how``; ``median_shape(way)`` and ``distance_to_median(way, shape)``.

    Raises
    ------
    ValueError
        When a method is unknown or fewer than 2 shapes can be used.

    Examples
    --------
    >>> import s4a
    >>> brains = s4a.synthetic.brains(6, 200)
    >>> options = {"n_coarse": 100, "n_pairs": 6, "k_init": 6, "k": 10}
    >>> found = s4a.compare.collection(brains, methods=["RE-MATCH"], **options)
    >>> found["collection_chamfer"].dims
    ('way', 'how', 'shape')
    """
    wrong = [m for m in methods if m not in COLLECTION_METHODS]
    if wrong or not len(methods):
        raise ValueError(
            f"methods must be some of {', '.join(COLLECTION_METHODS)}; found {wrong or methods!r}"
        )
    begin = time.process_time()
    tree = shapes if isinstance(shapes, xr.DataTree) else read_shapes(shapes)
    load = time.process_time() - begin
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    if len(meshes) < 2:
        raise ValueError(f"a collection needs at least 2 shapes, found {len(meshes)}")
    with threadpool_limits(1):
        rows = [
            one_collection(meshes, way, load, n_coarse, n_pairs, k_init, k, step, seed)
            for way in tqdm(methods, desc="collection")
        ]
    return xr.concat(rows, "way").assign_coords(way=list(methods))


def one_collection(meshes, way, load, n_coarse, n_pairs, k_init, k, step, seed):
    """One row of Table 2."""
    names, begin = list(meshes), time.process_time()
    given = {n: Shape(mesh, n_coarse, k, seed) for n, mesh in meshes.items()}
    spaces = {n: shape.local if way == "SCALABLE" else shape.coarse for n, shape in given.items()}
    eigenvalues = np.stack([s.eigenvalue for s in spaces.values()])
    distance = network.spectral_distance(eigenvalues[:, :k_init])
    reference = names[int(np.argmin(distance.sum(1)))]
    to_reference = {n: (np.eye(3), np.zeros(3)) for n in names}
    for n in names:
        if n != reference:
            to_reference[n] = align(
                spaces[n].X, spaces[n].area, spaces[reference].X, spaces[reference].area
            )[:2]
    source, target, maps = [], [], []
    for i, j in network.choose_pairs(distance, n_pairs):
        M, N = spaces[names[i]], spaces[names[j]]
        R, t = realign(
            M.X, M.area, N.X, N.area, motion_between(to_reference[names[i]], to_reference[names[j]])
        )
        for a, b, motion in ((i, j, (R, t)), (j, i, (R.T, -R.T @ t))):
            ends = [
                (s.X, s.mass, s.Phi, s.eigenvalue) for s in (spaces[names[a]], spaces[names[b]])
            ]
            maps.append(network.first_map(*ends, motion, k_init=k_init))
            source.append(a)
            target.append(b)
    spent = {"load and clean": load, "basis and first maps": time.process_time() - begin}

    begin = time.process_time()
    _, _, _, Y, latent_eigenvalue = latent.consistent_zoomout(
        np.stack(maps),
        np.array(source),
        np.array(target),
        [s.Phi for s in spaces.values()],
        [s.area for s in spaces.values()],
        eigenvalues,
        k,
        step=step,
        samples=[farthest_points(s.X, latent.SAMPLES) for s in spaces.values()],
    )
    found = dataset(latent_basis=Y, latent_eigenvalue=latent_eigenvalue).assign_coords(shape=names)
    found = median.median_shape(found, eigenvalues)
    spent["consistent ZoomOut"] = time.process_time() - begin

    template = found.attrs["median"]
    N, others = spaces[template], [n for n in names if n != template]
    chamfer, seconds = np.full((len(HOW), len(names)), np.nan), []
    for h, how in enumerate(HOW):
        total = 0.0
        for n in others:
            begin, M = time.process_time(), spaces[n]
            F = M.Phi @ Y[names.index(n)], N.Phi @ Y[names.index(template)]
            if how == "standard":
                C = fmap.fmap_from_match(M.Phi, N.Phi, N.mass, fmap.nearest_rows(F[1], F[0]))
                F = M.Phi @ C.T, N.Phi
            match = intrinsic_match(M, N, *F)[0]
            total += time.process_time() - begin
            X = given[n].X
            chamfer[h, names.index(n)] = metrics.chamfer(X, X[match])
        seconds.append([*spent.values(), total])
    row = xr.Dataset(
        {
            "collection_chamfer": variable("collection_chamfer", chamfer[None]).isel(way=0),
            "collection_seconds": variable("collection_seconds", np.array(seconds)[None]).isel(
                way=0
            ),
            "median_shape": variable("median_shape", np.array([template])).isel(way=0),
            "distance_to_median": found["distance_to_median"].variable,
        }
    )
    return row.assign_coords(how=list(HOW), block=list(COLLECTION_BLOCKS), shape=names)
