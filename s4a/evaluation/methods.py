"""The methods that 5.2 and 5.3 compare, each as a shape of its own functions, timed by block.

Every method works on a :class:`s4a.method.shape.Shape`: ZO and FMAP+ZO on one whose functions are
the eigenfunctions of the dense mesh, SCALABLE on that of :mod:`s4a.method.scalable`, RE-MATCH on
the coarse mesh with functions of :mod:`s4a.method.lift`.  Times are CPU seconds of one core, so
that a busy machine does not change them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from s4a.geometry.align import Motion, align, farthest_points
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method import fmap, joint
from s4a.method.first_map import landmarks_after_motion, nearest_after_motion
from s4a.method.lift import SPARE, lift
from s4a.method.nearest import (
    as_candidates,
    as_queries,
    nearest_float32,
    nearest_in_cells,
    nearest_rows,
)
from s4a.method.register import register_surface, sharpen_map
from s4a.method.remesh import coarsen, laplacian
from s4a.method.scalable import local_space, spectral_space
from s4a.method.shape import Basis, Shape
from s4a.method.spectral import eigenpairs, spectrum

METHODS = ("kNN", "ZO", "FMAP+ZO", "SCALABLE", "RE-MATCH", "RE-MATCH joint")
BLOCKS = (
    "load and clean",
    "align",
    "sample",
    "basis",
    "map",
    "refine",
    "full resolution",
)  # of Fig. 3
N_SPREAD = 3000  # points of each shape by which it is aligned, and that group dense searches
SHARPEN = 2  # last rounds of RE-MATCH that look among all vertices of the source

Matches = tuple[np.ndarray, np.ndarray]


class Clock:
    """CPU seconds by block."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def __call__(self, block: str, function: Callable, *arguments: Any, **options: Any) -> Any:
        """What a function gives; its seconds go to the block."""
        begin = time.process_time()
        result = function(*arguments, **options)
        self.add(block, time.process_time() - begin)
        return result

    def add(self, block: str, seconds: float) -> None:
        """Seconds that were spent on a block, once more perhaps."""
        self.seconds[block] = self.seconds.get(block, 0.0) + seconds


@dataclass
class Spaces:
    """A clean mesh and the shapes that the methods make of it, each made once.

    ``clock`` holds what was spent on the ``sample`` and the ``basis`` of each.
    """

    mesh: xr.Dataset
    n_coarse: int = 6000
    k: int = 100
    seed: int = 0
    clock: Clock = field(default_factory=Clock)

    @cached_property
    def X(self) -> np.ndarray:
        """Vertices centred and for unit area ``(n, 3)``."""
        return Shape(self.mesh).to_frame(self.mesh["position"].values)

    @cached_property
    def spread(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Spread points ``(p, 3)``, their areas of sum 1, and the nearest to every vertex."""
        return self.clock("spread", self._spread)

    def _spread(self):
        X, T = as_arrays(self.mesh)
        sample = farthest_points(self.X, N_SPREAD)
        cell = cKDTree(self.X[sample]).query(self.X)[1]
        area = np.bincount(cell, vertex_areas(X, T), len(sample))
        return self.X[sample], area / area.sum(), cell

    @cached_property
    def dense(self) -> Shape:
        """The mesh itself and its own first eigenfunctions; U is the identity."""
        return self.clock("dense basis", self._dense)

    def _dense(self):
        X, T = as_arrays(self.mesh)
        E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
        eigenvalue, Phi = eigenpairs(E, w, area, self.k)
        basis = Basis(self.X, T, area / area.sum(), Phi, eigenvalue)
        return Shape.of(self.mesh, low=basis, full=basis, U=None, cell=self.spread[2])

    @cached_property
    def local(self) -> Shape:
        """The samples of SCALABLE and its local functions."""
        parts = self.clock("local sample", local_space, self.mesh, self.n_coarse, self.seed)
        return self.clock("local basis", spectral_space, self.mesh, *parts, self.k)

    @cached_property
    def low(self) -> xr.Dataset:
        """The low-resolution mesh, with a few eigenfunctions more than are used."""
        options = {"n_coarse": self.n_coarse, "seed": self.seed}
        coarse = self.clock("lifted sample", coarsen, self.mesh, **options)
        return self.clock("lifted basis", spectrum, coarse, k=self.k + SPARE)

    @cached_property
    def coarse(self) -> Shape:
        """The low-resolution mesh and its own eigenfunctions."""
        return Shape(self.mesh, self.low.isel(mode=slice(self.k)))

    @cached_property
    def lifted(self) -> Shape:
        """The low-resolution mesh with functions that were brought to all vertices and back."""
        return self.clock("lifted basis", lifted_shape, self.coarse, self.low, self.k)


def lifted_shape(shape: Shape, low: xr.Dataset, k: int) -> Shape:
    """A shape with the functions of :mod:`s4a.method.lift`, at all vertices and at coarse ones.

    They are orthonormal for the areas of the low-resolution mesh, as ZoomOut needs it.

    Parameters
    ----------
    shape : Shape
    low : Dataset
        The low-resolution mesh with some eigenfunctions more than k.
    """
    X, T = as_arrays(shape.original)
    area_full = vertex_areas(X, T)
    eigenvalue, B = lift(X, T, area_full, shape.U, low, k)  # (n, k)
    vertex = low["sample_vertex"].values.copy()
    cell, nearest = np.unique(shape.cell, return_index=True)
    # the centres of closed openings are no vertices: the first of their cells stands for them
    vertex[cell] = np.where(vertex[cell] < 0, nearest, vertex[cell])
    area = shape.low.area
    Phi = B[vertex].astype(float)
    turn = np.linalg.inv(np.linalg.cholesky(Phi.T @ (area[:, None] * Phi))).T
    B = B @ turn.astype(B.dtype)
    return Shape.of(
        shape.original,
        low=replace(shape.low, Phi=B[vertex].astype(float), eigenvalue=eigenvalue),
        full=Basis(shape.to_frame(X), T, area_full / area_full.sum(), B, eigenvalue),
        U=shape.U,
        cell=shape.cell,
    )


def functions_at_all_vertices(shape: Shape, C: np.ndarray | None = None) -> np.ndarray:
    """The functions of a shape, or Phi C^T, at all its vertices ``(n, k)``."""
    Phi = shape.full.Phi
    F = Phi if C is None else Phi[:, : C.shape[1]] @ C.T.astype(Phi.dtype)
    return shape.full.extend(F)


def match_in_space(
    source: Spaces, target: Spaces, motion: tuple[np.ndarray, np.ndarray]
) -> Matches:
    """kNN: nearest neighbours of the aligned shapes in space, for the target and for the source."""
    R, t = motion
    moved = source.X @ R.T + t
    return cKDTree(moved).query(target.X)[1], cKDTree(target.X).query(moved)[1]


def fit_map(M: Shape, N: Shape, landmarks: Matches, k: int) -> np.ndarray:
    """First map ``(k, k)`` from landmarks and wave kernels, see `fmap.fit_descriptors`."""
    at_source, at_target = (
        mark if shape.U is None else shape.cell[mark]
        for shape, mark in zip((M, N), landmarks, strict=True)
    )
    bases = [replace(shape.low, area=shape.low.area / shape.low.area.sum()) for shape in (M, N)]
    return fmap.fmap_from_descriptors(*bases, k=k, landmarks=(at_source, at_target), oriented=0)


class SpectralMatch(NamedTuple):
    """What a spectral method finds: the match, the functions behind it, and the coarse match."""

    match: np.ndarray  # (n_target,)
    functions: tuple[np.ndarray, np.ndarray]  # at all vertices, of source and target
    low_match: np.ndarray  # (n_low_target,)
    seconds: dict[str, float]


class Outcome(NamedTuple):
    """One method on one pair."""

    match: np.ndarray  # (n_target,)
    image: np.ndarray | None  # (n_target, 3), where the method gives more than vertices
    reverse: np.ndarray  # (n_source,), the match the other way
    seconds: dict[str, float]


@dataclass
class Pair:
    """Two meshes on which methods are run; what several share is made once and charged to each.

    Parameters
    ----------
    source, target : Spaces
    landmarks : tuple of int ndarray, optional
        Corresponding vertices; by default those of 4.1, step 3.
    k_init, k, step : int
        Of the maps.
    """

    source: Spaces
    target: Spaces
    landmarks: Matches | None = None
    k_init: int = 20
    k: int = 100
    step: int = 5
    spectral: dict[str, SpectralMatch] = field(default_factory=dict)

    def run(self, method: str) -> Outcome:
        """A method of :data:`METHODS`."""
        clock = Clock()
        remeshed = method.startswith("RE-MATCH")
        motion, landmarks, align_seconds = self.align_remeshed if remeshed else self.align_spread
        aligned = self.landmarks is None or method in ("kNN", "ZO", "RE-MATCH joint")
        if aligned:
            clock.add("align", align_seconds)
        if not remeshed and (aligned or method == "FMAP+ZO"):
            # spread points align, and group the searches of the dense methods
            spent = sum(end.clock.seconds["spread"] for end in (self.source, self.target))
            clock.add("align" if aligned else "refine", spent)
        if method == "kNN":
            match, reverse = clock(
                "full resolution", match_in_space, self.source, self.target, motion
            )
            return Outcome(match, None, reverse, clock.seconds)

        spectral = self.match_spectrally(method.removesuffix(" joint"), motion, landmarks)
        for block, seconds in spectral.seconds.items():
            clock.add(block, seconds)
        if method == "RE-MATCH joint":
            match, image = self.refine_jointly(spectral, motion, clock)
            reverse = cKDTree(image).query(self.source.mesh["position"].values)[1]
            return Outcome(match, image, reverse, clock.seconds)
        M, N = self.shapes(method)
        F, G = spectral.functions
        reverse = nearest_in_cells(F, M.cell, G, N.cell)[0]
        return Outcome(spectral.match, None, reverse, clock.seconds)

    def shapes(self, method: str) -> tuple[Shape, Shape]:
        """Source and target in the functions of a method."""
        kind = {"ZO": "dense", "FMAP+ZO": "dense", "SCALABLE": "local"}.get(method, "lifted")
        return getattr(self.source, kind), getattr(self.target, kind)

    @cached_property
    def align_spread(self) -> tuple[Motion, Matches, float]:
        """Motion and landmarks by spread points of both, and the seconds that they took."""
        (X, area, _), (Y, area_target, _) = self.source.spread, self.target.spread
        return self._align(X, area, Y, area_target)

    @cached_property
    def align_remeshed(self) -> tuple[Motion, Matches, float]:
        """The same by the low-resolution meshes."""
        M, N = self.source.coarse.low, self.target.coarse.low
        return self._align(M.X, M.area, N.X, N.area)

    def _align(self, X, area, Y, area_target):
        clock = Clock()
        R, t, _ = clock("align", align, X, area, Y, area_target)
        landmarks = self.landmarks
        if landmarks is None:
            landmarks = clock("align", landmarks_after_motion, self.source.X, self.target.X, (R, t))
        return (R, t), landmarks, clock.seconds["align"]

    def match_spectrally(self, method: str, motion: Motion, landmarks: Matches) -> SpectralMatch:
        """ZO, FMAP+ZO, SCALABLE or RE-MATCH: first map, ZoomOut and match at full resolution."""
        if method not in self.spectral:
            self.spectral[method] = self._match_spectrally(method, motion, landmarks)
        return self.spectral[method]

    def _match_spectrally(self, method, motion, landmarks):
        clock = Clock()
        M, N = self.shapes(method)
        kind = {"ZO": "dense", "FMAP+ZO": "dense", "SCALABLE": "local"}.get(method, "lifted")
        for block in ("sample", "basis"):
            for end in (self.source, self.target):
                clock.add(block, end.clock.seconds.get(f"{kind} {block}", 0.0))
        if method == "ZO":
            match, _ = clock("map", match_in_space, self.source, self.target, motion)
            Phi, Psi = M.low.Phi[:, : self.k_init], N.low.Phi[:, : self.k_init]
            C = clock("map", fmap.fmap_from_match, Phi, Psi, N.low.mass, match)
        else:
            C = clock("map", fit_map, M, N, landmarks, self.k_init)
        nearest = {
            "dense": lambda Q, D: nearest_in_cells(Q, N.cell, D, M.cell)[0],
            "local": nearest_rows,
            # other searches follow, so that near ties do not matter
            "lifted": lambda Q, D: nearest_float32(as_queries(Q), as_candidates(D)),
        }[kind]
        C, low_match = clock(
            "refine", fmap.zoomout, M.low, N.low, C, self.k, step=self.step, nearest=nearest
        )
        if kind == "lifted":
            for _ in range(SHARPEN):
                C = clock("refine", sharpen_map, M, N, C, M.full.Phi)
        F = clock("full resolution", functions_at_all_vertices, M, C)
        G = functions_at_all_vertices(N)
        match = low_match
        if kind != "dense":
            match, *_ = clock("full resolution", nearest_in_cells, G, N.cell, F, M.cell)
        return SpectralMatch(match, (F, G), low_match, clock.seconds)

    def refine_jointly(self, spectral: SpectralMatch, motion: Motion, clock: Clock) -> Matches:
        """RE-MATCH with joint rounds: match and registered surface at full resolution."""
        M, N = self.source.coarse, self.target.coarse
        starts = {
            "intrinsic": spectral.low_match,
            "icp": nearest_after_motion(M.low, N.low, motion),
        }
        tried = clock("refine", joint.candidates, M.low, N.low, starts, k=self.k)
        match, image, _ = clock(
            "full resolution", register_surface, M, N, tried, spectral.functions
        )
        return match, image
