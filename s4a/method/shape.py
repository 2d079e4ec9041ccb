"""A shape (3.1, 3.3, 4.1): a surface at two resolutions, in one frame, with eigenfunctions and U.

The steps of the method use shapes, or the :class:`Basis` of a shape at one resolution.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import xarray as xr
from scipy.spatial import cKDTree

from s4a.geometry import mesh as surface
from s4a.geometry.align import (
    N_PAIRED,
    Cloud,
    cloud,
    farthest_points,
    many_farthest_points,
    rigid_transform,
)
from s4a.geometry.closest import FeatureTree, Stars, features, interpolation_matrix, stars
from s4a.geometry.mesh import as_arrays, vertex_areas, vertex_normals
from s4a.method.deform import smoother
from s4a.method.nearest import Product
from s4a.method.remesh import laplacian
from s4a.method.spectral import Diffusion, project, unit_area, unit_mass
from s4a.options import N_CENTRAL, N_SAMPLES
from s4a.schema import Array, require

# of one standard deviation of a field, relative to positions times POSITION_WEIGHT: as much as 2 %
# of sqrt(area).  With twice the weight, labels of cortex are transferred less accurately
FIELD_WEIGHT = 0.1


@dataclass(frozen=True)
class Basis:
    """A surface of unit area at one resolution, with the basis of functional maps.

    Parameters
    ----------
    X : float ndarray (n, 3)
        Vertices, in the frame of the shape.
    T : int ndarray (m, 3)
        Triangles; empty for samples of :func:`s4a.method.scalable.reduce`.
    area : float ndarray (n,)
        Vertex areas, of sum 1.
    Phi : float ndarray (p, k)
        Functions on the vertices, p = n; with U, functions on the low-resolution vertices.
    eigenvalue : float ndarray (k,)
        Eigenvalues for unit area, if needed.
    mass : float ndarray (p,) or sparse matrix (p, p), optional
        Mass matrix in which Phi is orthonormal; the areas by default.
    U : sparse matrix (n, p), optional
        Projection of functions from the low resolution to the n vertices.  U Phi is never formed.
    near_coarse : int ndarray (s,), optional
        Vertices used to project fields, and in iterations of registration; all by default.
    area_weighted : bool
        Whether to weight these vertices by area when a field is projected.
    refined : bool
        Whether Phi has a row for each of the n vertices, although U is given.
    surface_normals : float ndarray (n, 3), optional
        Unit normals of a finer surface at the vertices; by default those of the mesh.
    landmarks : dict of str to int
        Nearest vertex of each landmark.
    fields : dict of str to float ndarray (n,)
        Fields that guide the registration, see ``_smooth_fields``.
    """

    X: Array
    T: Array
    area: Array
    Phi: Array
    eigenvalue: Array = field(default_factory=lambda: np.empty(0))
    mass: Array | sp.sparray | sp.spmatrix | None = None
    U: sp.csr_matrix | None = None
    near_coarse: Array | slice | None = None
    area_weighted: bool = True
    refined: bool = False
    surface_normals: Array | None = None
    landmarks: dict[str, int] = field(default_factory=dict)
    fields: dict[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.mass is None:
            object.__setattr__(self, "mass", self.area)
        if self.near_coarse is None:
            object.__setattr__(self, "near_coarse", slice(None))

    @property
    def k(self) -> int:
        """Number of functions."""
        return self.Phi.shape[1]

    def truncated(self, k: int) -> "Basis":
        """Return the surface with its first k functions."""
        return replace(self, Phi=self.Phi[:, :k], eigenvalue=self.eigenvalue[:k])

    def moved_to(self, X: Array) -> "Basis":
        """Return the surface with vertices moved to X ``(n, 3)``, as registered."""
        moved = replace(self, X=X, surface_normals=None)
        vars(moved)["order"] = self.order  # replaces the cached property
        return moved

    def extend(self, F: Array) -> Array | Product:
        """Extend functions of the low resolution to all vertices: U F ``(n, q)``, by rows.

        Functions with a row for every vertex are returned unchanged.
        """
        if self.U is None or len(F) == len(self.X):
            return F
        return Product(self.U, F.astype(np.float32).astype(float))

    def field(self, c: Array) -> Array:
        """Return the field U Phi c ``(n, 3)`` with coefficients c ``(q, 3)``."""
        low = self.Phi[:, : len(c)] @ c
        return low if self.U is None or self.refined else self.U @ low

    @cached_property
    def coefficients(self) -> Callable[..., Any]:
        """Projection of a field at the vertices near coarse ones, see :func:`smoother`."""
        area = self.area[self.near_coarse]
        weight = area if self.area_weighted else np.ones_like(area)
        if self.U is None or self.refined:
            return smoother(self.Phi[self.near_coarse], weight)
        return smoother(self.Phi, weight, self.U[self.near_coarse])

    def sample_vertices_of(self, n: int = N_SAMPLES) -> Array:
        """Return farthest-point samples ``(<= n,)``; all vertices in that order if n is 0."""
        if N_SAMPLES < len(self.X) and 0 < n <= N_SAMPLES:
            return self._samples[:n]
        return farthest_points(self.X, n or len(self.X))

    @cached_property
    def _samples(self) -> Array:
        return many_farthest_points(self.X, N_SAMPLES, center=self.X.mean(0))

    @cached_property
    def cloud(self) -> Cloud:
        """The vertices in the form that rigid alignment needs; samples have no normals."""
        normals = self.normals if len(self.T) else None
        return cloud(self.X, self.area, self.sample_vertices_of(N_PAIRED), normals)

    @cached_property
    def tree(self) -> FeatureTree:
        """KD-tree over position and normal of the vertices, 6 dims."""
        return FeatureTree(features(self.X, self.normals), self.order)

    def guided_tree(self, names: tuple[str, ...]) -> FeatureTree:
        """Return the KD-tree over position, normal and some fields, 6 dims and one for each."""
        if names not in self._trees:
            rows = np.concatenate([self.tree.data, field_columns(self, names)], axis=1)
            self._trees[names] = FeatureTree(rows, self.order)
        return self._trees[names]

    @cached_property
    def _trees(self) -> dict[tuple[str, ...], FeatureTree]:
        return {(): self.tree}

    @cached_property
    def normals(self) -> Array:
        """Unit normals of the vertices ``(n, 3)``."""
        return self._normals_and_areas[0]

    def normals_at(self, X: Array) -> Array:
        """Return unit normals ``(n, 3)`` after moving the vertices to X.

        Normals of a finer surface are rotated with the mesh, then like its normals.
        """
        moved = vertex_normals(X, self.T)
        if self.surface_normals is None:
            return moved
        R, _, _ = rigid_transform(self.X, X, self.area)
        return surface.rotated(self.surface_normals @ R.T, self.normals @ R.T, moved)

    @cached_property
    def log_area_shares(self) -> Array:
        """Logarithms of the shares of the vertices in the area ``(n,)``."""
        return surface.log_shares(self._normals_and_areas[1])

    @cached_property
    def _normals_and_areas(self) -> tuple[Array, Array]:
        return surface.normals_and_areas(self.X, self.T)

    @cached_property
    def stars(self) -> Stars:
        """The triangles around every vertex."""
        return stars(self.T, len(self.X))

    @cached_property
    def boundary(self) -> Array:
        """Boundary edges ``(r, 2)``, oriented like their triangles."""
        _, edge_of, count = surface.unique_edges(self.T, len(self.X))
        return surface.directed_edges(self.T)[count[edge_of] == 1]

    @cached_property
    def boundary_tree(self) -> cKDTree:
        """KD-tree over the positions of boundary vertices."""
        return cKDTree(self.X[np.unique(self.boundary)])

    @cached_property
    def graph(self) -> sp.csr_matrix:
        """Lengths of the edges as a sparse matrix ``(n, n)``."""
        return surface.edge_graph(self.X, surface.edges(self.T))

    @cached_property
    def order(self) -> Array:
        """Order of the vertices in space, as :func:`s4a.geometry.mesh.order_in_space`."""
        return surface.order_in_space(self.X)

    @cached_property
    def outwards(self) -> Array:
        """Rows of the vertices near coarse ones, sorted by distance from the centre.

        The order does not depend on pose or numbering.
        """
        from_center = self.X[self.near_coarse] - self.area @ self.X
        return np.argsort((from_center**2).sum(1), kind="stable")


@dataclass(frozen=True)
class Shape:
    """A shape at both resolutions, read and computed on access.

    The frame is x -> (x - center) / size with the area centroid and the square root of the total
    area of the original mesh, or of the coarse mesh if the original is not given.

    Parameters
    ----------
    original : xarray.Dataset, optional
        The clean mesh: ``position``, ``corner_vertex``; may be empty if no step needs it.
    coarse : xarray.Dataset, optional
        Low-resolution mesh of :func:`s4a.coarsen` and :func:`s4a.spectrum`, of
        :func:`s4a.method.refined_eigenfunctions.with_refined_eigenfunctions`, or samples of
        :func:`s4a.method.scalable.reduced`.
    n_projected : int
        Vertices of ``full`` used to project fields, those nearest to coarse ones; 0 for all.
    area_weighted : bool
        Whether to weight them by area.
    """

    original: xr.Dataset = field(default_factory=xr.Dataset)
    coarse: xr.Dataset = field(default_factory=xr.Dataset)
    n_projected: int = N_CENTRAL
    area_weighted: bool = True

    @classmethod
    def of(cls, original: xr.Dataset, **parts: Any) -> "Shape":
        """Return a shape with given ``low``, ``full``, ``U`` and ``cell``."""
        shape = cls(original)
        vars(shape).update(parts)  # replaces the cached properties
        return shape

    @cached_property
    def frame(self) -> tuple[Array, float]:
        """Centre ``(3,)`` and size, in the unit of the input."""
        if not self.original:
            area, X = self.coarse["vertex_area"].values, self.coarse["position"].values
            return area / area.sum() @ X, np.sqrt(area.sum())
        X, area = self.original["position"].values, self._area
        return area @ X / area.sum(), np.sqrt(area.sum())

    @cached_property
    def _area(self) -> Array:
        return vertex_areas(*as_arrays(self.original))

    def to_frame(self, points: Array) -> Array:
        """Convert points ``(p, 3)`` from the unit of the input to the frame."""
        center, size = self.frame
        return (points - center) / size

    def from_frame(self, points: Array) -> Array:
        """Convert points ``(p, 3)`` from the frame to the unit of the input."""
        center, size = self.frame
        return points * size + center

    @cached_property
    def U(self) -> sp.csr_matrix:
        """Projection operator of 4.1 ``(n, n_coarse)``: three barycentric weights per row.

        In SCALABLE the local functions, with rows of sum 1.
        """
        return projection_operator(self.coarse)

    @cached_property
    def landmarks(self) -> tuple[list[str], sp.csr_matrix]:
        """Names of the guiding landmarks, and their barycentric weights ``(l, n)``."""
        mesh = self.original
        if "guide_triangle" not in mesh:
            return [], sp.csr_matrix((0, mesh.sizes["vertex"]))
        _, T = as_arrays(mesh)
        names = mesh["guide_name"].values.tolist()
        triangle, weights = mesh["guide_triangle"].values, mesh["guide_barycentric"].values
        return names, interpolation_matrix(T, triangle, weights, mesh.sizes["vertex"])

    @cached_property
    def cell(self) -> Array:
        """Coarse vertex with the largest weight at each original vertex ``(n,)``.

        In SCALABLE the nearest sample along edges.
        """
        if self.is_sampled:
            return self.coarse["sample_cell"].values
        columns = self.coarse["coarse_vertex"].values
        heaviest = self.coarse["coarse_weight"].values.argmax(1)
        return columns[np.arange(len(columns)), heaviest]

    @cached_property
    def low(self) -> Basis:
        """The coarse mesh and its eigenfunctions."""
        X, T = as_arrays(self.coarse)
        Phi, eigenvalue = (self.coarse[f"eigen{part}"].values for part in ("function", "value"))
        mass = unit_mass(self.coarse) if self.is_sampled else None
        low = Basis(self.to_frame(X), T, unit_area(self.coarse), Phi, eigenvalue, mass)
        low = replace(low, landmarks=vertices_of_landmarks(self.coarse))
        return replace(low, fields=_smooth_fields(self.coarse, low))

    @cached_property
    def W(self) -> sp.csr_matrix:
        """Stiffness matrix at low resolution ``(n_coarse, n_coarse)``; in SCALABLE U^T W U.

        Computed again if a reduced study lacks it.
        """
        if "cotan_weight" in self.coarse:
            E, w = (self.coarse[name].values for name in ("edge_vertex", "cotan_weight"))
        else:
            E, w, *_ = laplacian(*as_arrays(self.coarse), self.coarse["vertex_area"].values)
        return surface.stiffness(E, w, self.coarse.sizes["vertex"])

    @cached_property
    def diffusion(self) -> Diffusion:
        """Heat diffusion at low resolution."""
        return Diffusion(self.low.area, self.W)

    @cached_property
    def low_on_surface(self) -> Basis:
        """The coarse mesh with the normals of the original mesh.

        With the normals of the coarse mesh, nearest points in position and normal would be biased,
        and a shape registered to itself would move.
        """
        low = self.low
        vertex = self.coarse["sample_vertex"].values  # (n_coarse,), -1 if not an original vertex
        normals = self.full.normals[vertex]
        normals[vertex < 0] = low.normals[vertex < 0]
        return replace(low, surface_normals=normals)

    @cached_property
    def full(self) -> Basis:
        """The original mesh with areas of sum 1, and the functions U Phi or refined ones."""
        (X, T), low, refined = as_arrays(self.original), self.low, self.has_refined_eigenfunctions
        X, area = self.to_frame(X), self._area / self._area.sum()
        Phi = self.coarse["refined_eigenfunction"].values if refined else low.Phi
        functions = Phi, low.eigenvalue, low.mass, self.U, self.near_coarse
        full = Basis(X, T, area, *functions, self.area_weighted, refined)
        fields = {name: self.U @ values for name, values in low.fields.items()}
        return replace(full, landmarks=vertices_of_landmarks(self.original), fields=fields)

    @property
    def is_sampled(self) -> bool:
        """Whether the low resolution has samples of :mod:`s4a.method.scalable`."""
        return "local_weight" in self.coarse

    @property
    def has_refined_eigenfunctions(self) -> bool:
        """Whether the functions of ``full`` are refined instead of U Phi."""
        return "refined_eigenfunction" in self.coarse

    def functions(self, A: Array) -> Array:
        """Return the functions Phi A for the match at full resolution, A ``(k, m)``.

        At coarse vertices; refined eigenfunctions at all vertices.
        """
        basis = self.full if self.has_refined_eigenfunctions else self.low
        return basis.Phi[:, : len(A)] @ A.astype(basis.Phi.dtype)

    @cached_property
    def near_coarse(self) -> Array:
        """Original vertices nearest to coarse ones, by weight in U; all of a small mesh.

        In SCALABLE by distance, as weights also depend on the sample density.
        """
        n = self.n_projected
        if n == 0 or self.coarse.sizes["original_vertex"] <= n:
            return np.arange(self.coarse.sizes["original_vertex"])
        if self.is_sampled:
            X = self.original["position"].values
            near = -np.linalg.norm(X - self.coarse["position"].values[self.cell], axis=1)
        else:
            near = self.coarse["coarse_weight"].values.max(1)
        return np.flatnonzero(near >= np.partition(near, -n)[-n])


def projection_operator(coarse: xr.Dataset) -> sp.csr_matrix:
    """Return the projection operator U of a low-resolution mesh as a sparse matrix (4.1, eq. 4, 7).

    Parameters
    ----------
    coarse : xarray.Dataset
        Mesh of :func:`s4a.coarsen`, such as ``study["coarse/brain_01"]``.

    Returns
    -------
    scipy.sparse.csr_matrix (n, n_coarse)
        U f are the values of a function f ``(n_coarse,)`` at the n original vertices.  Each row has
        three barycentric weights of sum 1; with ``method="scalable"`` the values of the local
        functions.

    Raises
    ------
    ValueError
        If the mesh has no U.

    See Also
    --------
    s4a.coarsen : Compute the low-resolution mesh and U.

    Examples
    --------
    The basis U Phi at full resolution:

    >>> import s4a
    >>> coarse = s4a.synthetic.example_study()["coarse/brain_01"]
    >>> U = s4a.projection_operator(coarse)
    >>> U.shape, (U @ coarse["eigenfunction"].values).shape
    ((200, 95), (200, 10))
    """
    require(coarse, what="low-resolution mesh")
    if "local_weight" in coarse:
        entries = (coarse[f"local_{part}"].values for part in ("weight", "vertex", "sample"))
        weight, row, column = entries
        shape = coarse.sizes["original_vertex"], coarse.sizes["vertex"]
        return sp.csr_matrix((weight, (row, column)), shape)
    require(coarse, "coarse_vertex", "coarse_weight", what="low-resolution mesh")
    corners, weights = coarse["coarse_vertex"].values, coarse["coarse_weight"].values  # (n, 3)
    return interpolation_matrix(corners, np.arange(len(corners)), weights, coarse.sizes["vertex"])


def vertices_of_landmarks(mesh: xr.Dataset) -> dict[str, int]:
    """Return name -> vertex of the guiding landmarks; within a triangle its nearest corner."""
    if "guide_name" not in mesh:
        return {}
    if "guide_vertex" in mesh:
        vertex = mesh["guide_vertex"].values
    else:
        _, T = as_arrays(mesh)
        heaviest = mesh["guide_barycentric"].values.argmax(1)
        vertex = T[mesh["guide_triangle"].values, heaviest]
    return dict(zip(mesh["guide_name"].values.tolist(), vertex.tolist(), strict=True))


def features_of(mesh: xr.Dataset) -> dict[str, Array]:
    """Return the fields of :func:`s4a.with_features` by name ``(n,)``."""
    if "feature_name" not in mesh:
        return {}
    names = mesh["feature_name"].values.tolist()
    return dict(zip(names, mesh["feature_value"].values.T, strict=True))


def _smooth_fields(coarse, low):
    """Guiding fields, standardised, times their weights, and projected onto the eigenfunctions.

    The projection removes noise, which would bias matches.  NaN is replaced by the mean; constant
    fields are omitted.
    """
    fields = {}
    for i, (name, values) in enumerate(features_of(coarse).items()):
        finite = np.isfinite(values)
        share = np.where(finite, low.area, 0) / low.area[finite].sum()
        centered = np.where(finite, values - share @ np.where(finite, values, 0), 0)
        deviation = np.sqrt(share @ centered**2)
        if deviation > 1e-12 * abs(values[finite]).max():
            centered *= coarse["feature_weight"].values[i] / deviation
            fields[name] = low.Phi @ project(low.Phi, low.mass, centered)
    return fields


def common_fields(source: Basis, target: Basis) -> tuple[str, ...]:
    """Return the names of the guiding fields of both shapes."""
    return tuple(name for name in target.fields if name in source.fields)


def field_columns(basis: Basis, names: tuple[str, ...]) -> Array:
    """Return weighted fields ``(n, f)`` as columns for the nearest-neighbour search."""
    return FIELD_WEIGHT * np.stack([basis.fields[name] for name in names], axis=1)


def corresponding_landmarks(source: Basis, target: Basis) -> tuple[Array, Array]:
    """Return the vertices of source and target ``(l,)`` at landmarks of the same name."""
    names = [name for name in target.landmarks if name in source.landmarks]
    at_source, at_target = (
        np.array([basis.landmarks[name] for name in names], int) for basis in (source, target)
    )
    return at_source, at_target
