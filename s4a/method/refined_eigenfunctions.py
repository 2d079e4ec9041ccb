"""Eigenfunctions at full resolution from those of the low resolution (3.3, with U of 4.1).

U Phi are eigenfunctions of the coarse mesh, linear over its triangles.  One step of inverse
iteration, W B = A U Phi Lambda with W and A of the full mesh, is solved by a two-grid cycle with
the coarse mesh, followed by Rayleigh-Ritz in the span of B.  No eigenproblem of full size is
solved, and the part outside the span of the eigenfunctions falls to a fifth.
"""

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import xarray as xr

from s4a.geometry.mesh import as_arrays, stiffness, vertex_areas
from s4a.method.remesh import coarsen, laplacian
from s4a.method.scalable import reduced
from s4a.method.shape import Shape, features_of, vertices_of_landmarks
from s4a.method.spectral import factor, spectrum, with_constant_first
from s4a.schema import Array, dataset

SPARE = 10  # additional functions, as the last ones of a span are the least accurate
ITERATIONS = 4  # of the smoother
LEAST = 0.05  # eigenvalue of the smoother, in 0..1, below which the coarse mesh corrects


def smooth(
    S: sp.csr_matrix, R: Array, B: Array, iterations: int = ITERATIONS, least: float = LEAST
) -> Array:
    """Apply Chebyshev iterations for S B = R ``(n, k)``, with eigenvalues of S in 0..1, to B.

    Errors with eigenvalues in least..1 are damped, and no others amplified.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.refined_eigenfunctions import smooth
    >>> B = smooth(np.eye(2), np.ones((2, 1)), np.zeros((2, 1)), iterations=9, least=0.5)
    >>> B.round(6).ravel().tolist()
    [1.0, 1.0]
    """
    middle, half = (1 + least) / 2, (1 - least) / 2
    ratio = half / middle
    step = (R - S @ B) / np.float32(middle)
    B = B + step
    for _ in range(iterations - 1):
        previous, ratio = ratio, 1 / (2 * middle / half - ratio)
        residual = S @ B
        np.subtract(R, residual, out=residual)  # in place, as the arrays are large
        residual *= np.float32(2 * ratio / half)
        step *= np.float32(ratio * previous)
        step += residual
        B += step
    return B


def _inverse_step(W, area, U, W_coarse, area_coarse, Phi, eigenvalue):
    r"""Two-grid cycle for W B = A (U Phi) Lambda, from B = U Phi.

    ::

        smooth -- residual --> U^T         U --> add -- smooth       full mesh
                                  \       /
                                   W_c^-1                            coarse mesh

    The smoother is Jacobi iteration with the row sums of |W| instead of the diagonal, which is
    stable for obtuse triangles.

    Parameters
    ----------
    W : sparse matrix (n, n)
    area : float ndarray (n,), of sum 1
    U : sparse matrix (n, n_coarse)
    W_coarse, area_coarse : sparse matrix (n_coarse, n_coarse), float ndarray (n_coarse,)
    Phi, eigenvalue : float ndarray (n_coarse, k), (k,)

    Returns
    -------
    B : float32 ndarray (n, k)
    """
    rows = np.asarray(abs(W).sum(axis=1)).ravel()  # (n,)
    S = (sp.diags(1 / rows) @ W).astype(np.float32).tocsr()
    rows = rows.astype(np.float32)[:, None]
    U = U.astype(np.float32).tocsr()
    B = U @ Phi.astype(np.float32)  # (n, k)
    R = area.astype(np.float32)[:, None] / rows * (B * eigenvalue.astype(np.float32))
    shift = 1e-2 * eigenvalue[eigenvalue > 0].min()  # as the coarse W is singular
    solve_coarse = factor(W_coarse + shift * sp.diags(area_coarse))
    B = smooth(S, R, B)
    residual = U.T @ (rows * (R - S @ B))  # (n_coarse, k)
    B = B + U @ solve_coarse(residual.astype(float)).astype(np.float32)
    return smooth(S, R, B)


def _rayleigh_ritz(W, area, B, k):
    """The k smallest eigenpairs in the span of B: eigenvalues ``(k,)`` and functions ``(n, k)``."""
    stiff = B.T @ (W.astype(B.dtype) @ B)
    mass = B.T @ (area.astype(B.dtype)[:, None] * B)
    stiff = (stiff + stiff.T).astype(float) / 2  # exactly symmetric
    mass = (mass + mass.T).astype(float) / 2
    eigenvalue, V = scipy.linalg.eigh(stiff, mass)
    return eigenvalue[:k], B @ V[:, :k].astype(B.dtype)


def refine_eigenfunctions(
    X: Array, T: Array, area: Array, U: sp.csr_matrix, coarse: xr.Dataset, k: int
) -> tuple[Array, Array]:
    """Approximate the first k eigenfunctions of a mesh from those of its coarse mesh.

    Parameters
    ----------
    X, T, area : float ndarray (n, 3), int ndarray (m, 3), float ndarray (n,)
        The mesh and its vertex areas, in any unit.
    U : sparse matrix (n, n_coarse)
    coarse : Dataset
        Result of :func:`s4a.spectrum`, preferably with k + :data:`SPARE` eigenfunctions.
    k : int

    Returns
    -------
    eigenvalue : float ndarray (<= k,)
        For unit area.
    B : float32 ndarray (n, <= k)
        Orthonormal for areas of sum 1.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.geometry.mesh import as_arrays, vertex_areas
    >>> from s4a.method.refined_eigenfunctions import refine_eigenfunctions
    >>> from s4a.method.shape import Shape
    >>> ball = s4a.synthetic.sphere(2000)
    >>> shape = Shape(ball, s4a.spectrum(s4a.coarsen(ball, n_coarse=300), k=16))
    >>> X, T = as_arrays(ball)
    >>> eigenvalue, _ = refine_eigenfunctions(X, T, vertex_areas(X, T), shape.U, shape.coarse, 9)
    >>> (eigenvalue / (4 * np.pi)).round(1).tolist()
    [0.0, 2.0, 2.0, 2.0, 6.0, 6.0, 6.0, 6.0, 6.0]
    """
    E, w, area, _ = laplacian(X, T, area)
    W, area = stiffness(E, w, len(X)), area / area.sum()
    E, w, a = (coarse[name].values for name in ("edge_vertex", "cotan_weight", "vertex_area"))
    Phi, eigenvalue = coarse["eigenfunction"].values, coarse["eigenvalue"].values
    B = _inverse_step(W, area, U, stiffness(E, w, len(a)), a / a.sum(), Phi, eigenvalue)
    zero = eigenvalue == 0
    B[:, zero] = U @ Phi[:, zero]  # constants on components are exact eigenfunctions
    n_zero = int(zero.sum())
    eigenvalue, B = _rayleigh_ritz(W, area, B, max(k, n_zero))
    eigenvalue[:n_zero] = 0.0  # else descriptors would use the rounding error, 1e-5
    B[:, :n_zero] = with_constant_first(B[:, :n_zero], area)
    eigenvalue, B = eigenvalue[:k], B[:, :k]
    moment = np.einsum("n,nk,nk,nk->k", area.astype(B.dtype), B, B, B)  # signs as in eigenpairs
    B *= np.where(moment < 0, -1, 1).astype(B.dtype)
    return np.maximum(eigenvalue, 0.0), B


def with_refined_eigenfunctions(mesh: xr.Dataset, low: xr.Dataset, k: int) -> xr.Dataset:
    """Replace the eigenfunctions of a low-resolution mesh by k refined ones.

    They are orthonormal for the areas of the low-resolution mesh, as ZoomOut requires.

    Parameters
    ----------
    mesh : Dataset
        The full mesh.
    low : Dataset
        Result of :func:`s4a.spectrum`, preferably with k + :data:`SPARE` eigenfunctions.
    k : int

    Returns
    -------
    Dataset
        `low` with other ``eigenvalue(eigenpair)`` and ``eigenfunction(vertex, eigenpair)``, and
        with ``refined_eigenfunction(original_vertex, eigenpair)``.
    """
    shape = Shape(mesh, low)
    X, T = as_arrays(mesh)
    eigenvalue, B = refine_eigenfunctions(X, T, vertex_areas(X, T), shape.U, low, k)  # (n, k)
    vertex = low["sample_vertex"].values.copy()
    cell, nearest = np.unique(shape.cell, return_index=True)
    # centres of closed openings are not vertices: the first vertex of the cell replaces them
    vertex[cell] = np.where(vertex[cell] < 0, nearest, vertex[cell])
    area = low["vertex_area"].values
    area = area / area.sum()
    Phi = B[vertex].astype(float)
    orthonormalise = np.linalg.inv(np.linalg.cholesky(Phi.T @ (area[:, None] * Phi))).T
    B = B @ orthonormalise.astype(B.dtype)
    functions = dataset(
        eigenvalue=eigenvalue, eigenfunction=B[vertex].astype(float), refined_eigenfunction=B
    )
    mesh_alone = low.drop_vars(["eigenvalue", "eigenfunction"])
    return mesh_alone.merge(functions).assign_attrs(low.attrs)


def low_resolution(
    mesh: xr.Dataset,
    *,
    method: str = "rematch",
    n_coarse: int = 6000,
    k: int = 100,
    refined_eigenfunctions: bool = False,
    sampling: str = "normals",
    wrap: bool = False,
    seed: int = 0,
) -> xr.Dataset:
    """Return the low-resolution mesh with spectrum, landmarks and fields.

    :func:`s4a.coarsen`, :func:`s4a.spectrum` and, with `refined_eigenfunctions`,
    :func:`with_refined_eigenfunctions`; with ``method="scalable"``
    :func:`s4a.method.scalable.reduced`, without refinement or wrapping.  ``guide_vertex`` are the
    coarse vertices with the largest weight in U at landmarks.  Fields are averaged with the weights
    of U.
    """
    if method == "scalable":
        low = reduced(mesh, n_coarse=n_coarse, k=k, seed=seed)
    else:
        coarse = coarsen(mesh, n_coarse=n_coarse, sampling=sampling, wrap=wrap, seed=seed)
        low = spectrum(coarse, k=k + SPARE) if refined_eigenfunctions else spectrum(coarse, k=k)
        low = with_refined_eigenfunctions(mesh, low, k) if refined_eigenfunctions else low
    shape, landmarks, fields = Shape(mesh, low), vertices_of_landmarks(mesh), features_of(mesh)
    if landmarks:
        vertex = shape.cell[list(landmarks.values())]
        low = low.merge(dataset(guide_name=list(landmarks), guide_vertex=vertex))
    if fields:
        values = np.stack([_mean_over_cells(shape, field) for field in fields.values()], axis=1)
        weights = mesh["feature_weight"].values
        names = list(fields)
        low = low.merge(dataset(feature_name=names, feature_value=values, feature_weight=weights))
    return low


def _mean_over_cells(shape, values):
    """Means ``(n_coarse,)`` of a field ``(n,)`` with the weights of U, NaN if it is NaN."""
    finite = np.isfinite(values)
    area = np.where(finite, vertex_areas(*as_arrays(shape.original)), 0)
    total = shape.U.T @ area
    with np.errstate(invalid="ignore", divide="ignore"):
        return (shape.U.T @ (area * np.where(finite, values, 0))) / total
