"""Methods compared in 5.2 and 5.3, with CPU seconds by block.

Every method works on a :class:`s4a.method.shape.Shape`: ZO and FMAP+ZO with the eigenfunctions of
the dense mesh, SCALABLE with those of :mod:`s4a.method.scalable`, RE-MATCH with U Phi of the coarse
mesh, as in the paper.  S4A adds RE-MATCH refined, with the functions of
:mod:`s4a.method.refined_eigenfunctions`; registered, the matched vertices after the registration of
:mod:`s4a.method.register`; and registered surface, the smooth registered surface itself.  Times are
CPU seconds of one core, so other processes hardly affect them.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from s4a.geometry.align import N_PAIRED, RigidTransform, align, cloud, farthest_points
from s4a.geometry.closest import match_surfaces
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method import fmap
from s4a.method.initial_map import landmarks_after_alignment, nearest_after_alignment
from s4a.method.nearest import (
    as_candidates,
    as_queries,
    nearest_float32,
    nearest_in_cells,
    nearest_rows,
)
from s4a.method.refined_eigenfunctions import SPARE, with_refined_eigenfunctions
from s4a.method.register import find_candidates, refine_at_full_resolution, register_surface
from s4a.method.remesh import coarsen, laplacian
from s4a.method.scalable import local_space, spectral_space
from s4a.method.shape import Basis, Shape
from s4a.method.spectral import eigenpairs, spectrum
from s4a.schema import Array

PAPER_METHODS = ("kNN", "ZO", "FMAP+ZO", "SCALABLE", "RE-MATCH")
S4A_METHODS = ("RE-MATCH refined", "registered", "registered surface")
METHODS = (*PAPER_METHODS, *S4A_METHODS)
# attribute of Spaces with the functions of a method; registration begins with RE-MATCH
KINDS = {"ZO": "dense", "FMAP+ZO": "dense", "SCALABLE": "local", "RE-MATCH": "coarse"}
KINDS |= {"RE-MATCH refined": "refined", "registered": "coarse", "registered surface": "coarse"}
# blocks of Fig. 3
BLOCKS = ("load and clean", "align", "sample", "basis", "map", "refine", "full resolution")
N_SAMPLES = 3000  # samples of each shape for alignment and for grouping dense searches
INITS = ("landmarks", "descriptors")  # kinds of initial maps

Matches = tuple[Array, Array]


class Clock(defaultdict[str, float]):
    """CPU seconds by block."""

    def __init__(self) -> None:
        super().__init__(float)

    def __call__(
        self, block: str, function: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Any:
        """Call a function, add its seconds to the block, and return its result."""
        begin = time.process_time()
        result = function(*arguments, **options)
        self[block] += time.process_time() - begin
        return result

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add seconds to the blocks."""
        for block, spent in seconds.items():
            self[block] += spent


@dataclass
class Spaces:
    """Clean mesh and the shapes that the methods need, each computed once.

    A mesh with too few vertices for k functions has fewer.  ``clock`` has the seconds for the
    ``sample`` and the ``basis`` of each shape.
    """

    mesh: xr.Dataset
    n_coarse: int = 6000
    k: int = 100
    seed: int = 0
    clock: Clock = field(default_factory=Clock)

    @cached_property
    def X(self) -> Array:
        """Vertices centred and for unit area ``(n, 3)``."""
        return Shape(self.mesh).to_frame(self.mesh["position"].values)

    @cached_property
    def samples(self) -> tuple[Array, Array, Array]:
        """Samples ``(p, 3)``, their areas, which sum to 1, and the nearest one of each vertex."""
        return self.clock("samples", self._samples)

    def _samples(self):
        X, T = as_arrays(self.mesh)
        sample = farthest_points(self.X, N_SAMPLES)
        cell = cKDTree(self.X[sample]).query(self.X)[1]
        area = np.bincount(cell, vertex_areas(X, T), len(sample))
        return self.X[sample], area / area.sum(), cell

    @cached_property
    def dense(self) -> Shape:
        """Dense mesh and its first eigenfunctions; U is the identity."""
        return self.clock("dense basis", self._dense)

    def _dense(self):
        X, T = as_arrays(self.mesh)
        E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
        eigenvalue, Phi = eigenpairs(E, w, area, min(self.k, len(X) - 2))
        basis = Basis(self.X, T, area / area.sum(), Phi, eigenvalue)
        return Shape.of(self.mesh, low=basis, full=basis, U=None, cell=self.samples[2])

    @cached_property
    def local(self) -> Shape:
        """Samples and local functions of SCALABLE."""
        space = self.clock("local sample", local_space, self.mesh, self.n_coarse, self.seed)
        k = min(self.k, len(space[0]) - 2)
        return self.clock("local basis", spectral_space, self.mesh, *space, k)

    @cached_property
    def sampled(self) -> xr.Dataset:
        """Low-resolution mesh."""
        options = {"n_coarse": self.n_coarse, "seed": self.seed}
        return self.clock("remeshed sample", coarsen, self.mesh, **options)

    @cached_property
    def coarse(self) -> Shape:
        """Low-resolution mesh and its eigenfunctions, U Phi at all vertices."""
        return Shape(self.mesh, self.clock("coarse basis", spectrum, self.sampled, k=self.k))

    @cached_property
    def refined(self) -> Shape:
        """Low-resolution mesh with refined eigenfunctions."""
        return Shape(self.mesh, self.clock("refined basis", self._refined))

    def _refined(self):
        return with_refined_eigenfunctions(
            self.mesh, spectrum(self.sampled, k=self.k + SPARE), self.k
        )


def match_in_space(source: Spaces, target: Spaces, transform: tuple[Array, Array]) -> Matches:
    """Match aligned shapes by nearest neighbours in space (kNN), in both directions."""
    R, t = transform
    moved = source.X @ R.T + t
    return cKDTree(moved).query(target.X)[1], cKDTree(target.X).query(moved)[1]


def at_low_resolution(M: Shape, N: Shape, landmarks: Matches) -> list[Array]:
    """Return landmarks as vertices of the low-resolution shapes, if there are any."""
    return [
        mark if shape.U is None else shape.cell[mark]
        for shape, mark in zip((M, N), landmarks, strict=True)
    ]


def fit_map(M: Shape, N: Shape, landmarks: Matches, k: int) -> Array:
    """Fit the initial map ``(k, k)`` to wave kernels, see :func:`fmap.fmap_from_descriptors`."""
    at_source, at_target = at_low_resolution(M, N, landmarks)
    bases = [replace(shape.low, area=shape.low.area / shape.low.area.sum()) for shape in (M, N)]
    return fmap.fmap_from_descriptors(*bases, k=k, landmarks=(at_source, at_target), oriented=0)


class Outcome(NamedTuple):
    """Result of one method on one pair; spectral methods also have maps and functions."""

    match: Array  # (n_target,)
    image: Array | None  # (n_target, 3), if the method gives positions between vertices
    reverse: Any  # (n_source,), match in the other direction
    seconds: dict[str, float]
    initial: Array | None = None  # (k_init, k_init), the initial map
    fmap: Any = None  # (k, k), the refined one
    functions: Any = None  # at all vertices, of source and target
    low_match: Any = None  # (n_low_target,)


@dataclass
class Pair:
    """Pair of meshes for all methods; shared results are computed once and charged to each.

    Parameters
    ----------
    source, target : Spaces
    landmarks : tuple of int ndarray, optional
        Corresponding vertices; by default as in 4.1, step 3.
    k_init, k, step : int
        Sizes and growth of the maps.
    full_resolution_iterations : int
        Final iterations of RE-MATCH refined that search all vertices.
    init : {"landmarks", "descriptors"}
        Initial maps by :func:`s4a.method.fmap.fmap_from_landmarks`, or from wave kernels of the
        shapes and around landmarks.
    """

    source: Spaces
    target: Spaces
    landmarks: Matches | None = None
    k_init: int = 20
    k: int = 100
    step: int = 5
    full_resolution_iterations: int = 2
    init: str = "landmarks"
    spectral: dict[str, Outcome] = field(default_factory=dict)

    def run(self, method: str) -> Outcome:
        """Run a method of :data:`METHODS`."""
        clock = Clock()
        remeshed = KINDS.get(method) in ("coarse", "refined")
        transform, landmarks, align_seconds = (
            self.align_remeshed if remeshed else self.align_samples
        )
        registers = method.startswith("registered")
        aligned = self.landmarks is None or method in ("kNN", "ZO") or registers
        if aligned:
            clock["align"] += align_seconds
        if not remeshed and (aligned or method == "FMAP+ZO"):
            # samples are used for alignment and for grouping dense searches
            spent = sum(end.clock["samples"] for end in (self.source, self.target))
            clock["align" if aligned else "refine"] += spent
        if method == "kNN":
            ends = self.source, self.target
            match, reverse = clock("full resolution", match_in_space, *ends, transform)
            return Outcome(match, None, reverse, clock)
        spectral = self.match_spectrally("RE-MATCH" if registers else method, transform, landmarks)
        clock.add(spectral.seconds)
        if registers:
            outcome = self.registered
            clock.add(outcome.seconds)
            image = outcome.image if method == "registered surface" else None
            return outcome._replace(image=image, seconds=clock)
        M, N = self.shapes(method)
        F, G = spectral.functions
        return spectral._replace(reverse=nearest_in_cells(F, M.cell, G, N.cell)[0], seconds=clock)

    def shapes(self, method: str) -> tuple[Shape, Shape]:
        """Return source and target with the functions of a method."""
        kind = KINDS[method]
        return getattr(self.source, kind), getattr(self.target, kind)

    @cached_property
    def align_samples(self) -> tuple[RigidTransform, Matches, float]:
        """Rigid transform and landmarks from samples of both shapes, and the seconds spent."""
        (X, area, _), (Y, area_target, _) = self.source.samples, self.target.samples
        return self._align(cloud(X, area, N_PAIRED), cloud(Y, area_target, N_PAIRED))

    @cached_property
    def align_remeshed(self) -> tuple[RigidTransform, Matches, float]:
        """Rigid transform and landmarks from the low-resolution meshes, and the seconds spent."""
        M, N = self.source.coarse.low, self.target.coarse.low
        return self._align(M.cloud, N.cloud)

    def _align(self, source, target):
        clock = Clock()
        R, t, _ = clock("align", align, source, target)
        landmarks = self.landmarks
        if landmarks is None:
            landmarks = clock(
                "align", landmarks_after_alignment, self.source.X, self.target.X, (R, t)
            )
        return (R, t), landmarks, clock["align"]

    def match_spectrally(
        self, method: str, transform: RigidTransform, landmarks: Matches
    ) -> Outcome:
        """Run a spectral method: initial map, ZoomOut and match at full resolution."""
        if method not in self.spectral:
            self.spectral[method] = self._match_spectrally(method, transform, landmarks)
        return self.spectral[method]

    def _match_spectrally(self, method, transform, landmarks):
        clock = Clock()
        M, N = self.shapes(method)
        k = min(self.k, M.low.k, N.low.k)
        k_init = min(self.k_init, k)
        kind = KINDS[method]
        parts = ("remeshed", kind) if kind in ("coarse", "refined") else (kind,)
        for block in ("sample", "basis"):
            for end in (self.source, self.target):
                clock[block] += sum(end.clock.get(f"{part} {block}", 0.0) for part in parts)
        if method == "ZO":
            match, _ = clock("map", match_in_space, self.source, self.target, transform)
            Phi, Psi = M.low.Phi[:, :k_init], N.low.Phi[:, :k_init]
            C = clock("map", fmap.fmap_from_match, Phi, Psi, N.low.mass, match)
        elif self.init == "landmarks":
            if self.landmarks is None:  # of the meshes that the map is computed on
                landmarks = clock("map", landmarks_after_alignment, M.low.X, N.low.X, transform)
            else:
                landmarks = at_low_resolution(M, N, landmarks)
            ends = M.low.truncated(k_init), N.low.truncated(k_init)
            C = clock("map", fmap.fmap_from_landmarks, *ends, *landmarks)
        else:
            C = clock("map", fit_map, M, N, landmarks, k_init)
        nearest = {
            "dense": lambda Q, D: nearest_in_cells(Q, N.cell, D, M.cell)[0],
            "local": nearest_rows,
            "coarse": nearest_rows,
            # later searches make near ties irrelevant
            "refined": lambda Q, D: nearest_float32(as_queries(Q), as_candidates(D)),
        }[kind]
        initial, options = C, {"step": self.step, "nearest": nearest}
        C, low_match = clock("refine", fmap.zoomout, M.low, N.low, C, k, **options)
        if kind == "refined":
            for _ in range(self.full_resolution_iterations):
                C = clock("refine", refine_at_full_resolution, M, N, C, M.full.Phi)
        F = clock("full resolution", lambda: M.full.extend(M.functions(C.T)))
        G = N.full.extend(N.full.Phi[:, :k])
        match = low_match
        if kind != "dense":
            match, *_ = clock("full resolution", nearest_in_cells, G, N.cell, F, M.cell)
        return Outcome(match, None, None, clock, initial, C, (F, G), low_match)

    @cached_property
    def registered(self) -> Outcome:
        """Default registration after RE-MATCH; the image is the registered surface."""
        clock = Clock()
        M, N = self.shapes("registered")
        transform, landmarks, _ = self.align_remeshed
        spectral = self.match_spectrally("RE-MATCH", transform, landmarks)
        icp = nearest_after_alignment(M.low, N.low, transform)
        initialisations = {"intrinsic": spectral.low_match, "icp": icp}
        candidates = clock("refine", find_candidates, M, N, initialisations, k=len(spectral.fmap))
        ends = M, N, candidates, spectral.functions
        match, moved, _ = clock("full resolution", register_surface, *ends, elastic=True)
        reverse = match_surfaces(M.full.X, M.full.normals, moved.X, moved.normals)
        return Outcome(match, M.from_frame(moved.X), reverse, clock)
