"""Eigenfunctions at full resolution from those of the low resolution (3.3, with U of 4.1).

U Phi is linear over the coarse triangles, and what the coarse mesh takes for eigenfunctions.  From
there one step of inverse iteration, W B = A U Phi Lambda with the W and A of the mesh itself,
solved by one cycle of two grids, the coarse mesh being the other, and Rayleigh-Ritz in the span of
B.  No eigenproblem of full size is solved, and what is not in the span of the eigenfunctions falls
to a fifth.
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

SPARE = 10  # functions more than are asked for: the last ones of a span are the least exact
ITERATIONS = 4  # of the smoother
LEAST = 0.05  # it acts in LEAST..1 of its spectrum 0..1; below the coarse mesh does


def smooth(
    S: sp.csr_matrix, R: Array, B: Array, iterations: int = ITERATIONS, least: float = LEAST
) -> Array:
    """Chebyshev iteration for S B = R ``(n, k)``, with eigenvalues of S in 0..1, from B.

    It damps what lies in least..1, and enlarges nothing.

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
        last, ratio = ratio, 1 / (2 * middle / half - ratio)
        rest = S @ B
        np.subtract(R, rest, out=rest)  # in place: the arrays are those of the full resolution
        rest *= np.float32(2 * ratio / half)
        step *= np.float32(ratio * last)
        step += rest
        B += step
    return B


def _inverse_step(W, area, U, W_coarse, area_coarse, Phi, eigenvalue):
    r"""One cycle of two grids for W B = A (U Phi) Lambda, from B = U Phi.

    ::

        smooth -- rest --> U^T         U --> add -- smooth       the mesh
                              \       /
                               W_c^-1                            its coarse mesh

    The smoother is Jacobi's with the row sums of |W| in the place of its diagonal, which obtuse
    triangles do not upset.

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
    shift = 1e-2 * eigenvalue[eigenvalue > 0].min()  # the coarse W alone is singular
    solve_coarse = factor(W_coarse + shift * sp.diags(area_coarse))
    B = smooth(S, R, B)
    rest = U.T @ (rows * (R - S @ B))  # (n_coarse, k)
    B = B + U @ solve_coarse(rest.astype(float)).astype(np.float32)
    return smooth(S, R, B)


def _rayleigh_ritz(W, area, B, k):
    """The k least eigenpairs in the span of B: eigenvalues ``(k,)`` and functions ``(n, k)``."""
    stiff = B.T @ (W.astype(B.dtype) @ B)
    mass = B.T @ (area.astype(B.dtype)[:, None] * B)
    stiff = (stiff + stiff.T).astype(float) / 2  # symmetric in spite of rounding
    mass = (mass + mass.T).astype(float) / 2
    eigenvalue, V = scipy.linalg.eigh(stiff, mass)
    return eigenvalue[:k], B @ V[:, :k].astype(B.dtype)


def refine_eigenfunctions(
    X: Array, T: Array, area: Array, U: sp.csr_matrix, coarse: xr.Dataset, k: int
) -> tuple[Array, Array]:
    """The first k eigenfunctions of a mesh, nearly, from k or more of its coarse mesh.

    Parameters
    ----------
    X, T, area : float ndarray (n, 3), int ndarray (m, 3), float ndarray (n,)
        The mesh and its vertex areas, in any unit.
    U : sparse matrix (n, n_coarse)
    coarse : Dataset
        Of :func:`s4a.spectrum`, best with k + :data:`SPARE` eigenfunctions.
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
    B[:, zero] = U @ Phi[:, zero]  # the constants of the pieces are eigenfunctions as they are
    n_zero = int(zero.sum())
    eigenvalue, B = _rayleigh_ritz(W, area, B, max(k, n_zero))
    eigenvalue[:n_zero] = 0.0  # descriptors would take rounding, 1e-5, for a frequency
    B[:, :n_zero] = with_constant_first(B[:, :n_zero], area)
    eigenvalue, B = eigenvalue[:k], B[:, :k]
    third = np.einsum("n,nk,nk,nk->k", area.astype(B.dtype), B, B, B)  # moments: as in eigenpairs
    B *= np.where(third < 0, -1, 1).astype(B.dtype)
    return np.maximum(eigenvalue, 0.0), B


def with_refined_eigenfunctions(mesh: xr.Dataset, low: xr.Dataset, k: int) -> xr.Dataset:
    """Low-resolution mesh with k refined eigenfunctions, at coarse and at all vertices.

    They are orthonormal for the areas of the low-resolution mesh, as ZoomOut needs it.

    Parameters
    ----------
    mesh : Dataset
        The mesh itself.
    low : Dataset
        Of :func:`s4a.spectrum`, best with k + :data:`SPARE` eigenfunctions.
    k : int

    Returns
    -------
    Dataset
        `low` with ``eigenvalue(eigenpair)`` and ``eigenfunction(vertex, eigenpair)`` in the place
        of its own, and ``refined_eigenfunction(original_vertex, eigenpair)``.
    """
    shape = Shape(mesh, low)
    X, T = as_arrays(mesh)
    eigenvalue, B = refine_eigenfunctions(X, T, vertex_areas(X, T), shape.U, low, k)  # (n, k)
    vertex = low["sample_vertex"].values.copy()
    cell, nearest = np.unique(shape.cell, return_index=True)
    # the centres of closed openings are no vertices: the first of their cells stands for them
    vertex[cell] = np.where(vertex[cell] < 0, nearest, vertex[cell])
    area = low["vertex_area"].values
    area = area / area.sum()
    Phi = B[vertex].astype(float)
    turn = np.linalg.inv(np.linalg.cholesky(Phi.T @ (area[:, None] * Phi))).T
    B = B @ turn.astype(B.dtype)
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
    wrap: bool = False,
    seed: int = 0,
) -> xr.Dataset:
    """The low-resolution mesh with its functions: :func:`s4a.coarsen`, :func:`s4a.spectrum`.

    With `refined_eigenfunctions` also :func:`with_refined_eigenfunctions`.  With
    ``method="scalable"`` :func:`s4a.method.scalable.reduced` is in their place, which can neither
    be refined nor wrapped.  Of landmarks that guide it has ``guide_vertex``, the coarse vertices
    that weigh most in U there; of fields that guide their means by the weights of U.
    """
    if method == "scalable":
        low = reduced(mesh, n_coarse=n_coarse, k=k, seed=seed)
    else:
        coarse = coarsen(mesh, n_coarse=n_coarse, wrap=wrap, seed=seed)
        low = spectrum(coarse, k=k + SPARE) if refined_eigenfunctions else spectrum(coarse, k=k)
        low = with_refined_eigenfunctions(mesh, low, k) if refined_eigenfunctions else low
    shape, landmarks, fields = Shape(mesh, low), vertices_of_landmarks(mesh), features_of(mesh)
    if landmarks:
        vertex = shape.cell[list(landmarks.values())]
        low = low.merge(dataset(guide_name=list(landmarks), guide_vertex=vertex))
    if fields:
        values = np.stack([_mean_over_cells(shape, one) for one in fields.values()], axis=1)
        weights = mesh["feature_weight"].values
        names = list(fields)
        low = low.merge(dataset(feature_name=names, feature_value=values, feature_weight=weights))
    return low


def _mean_over_cells(shape, values):
    """Means of a field ``(n,)`` by the weights of U ``(n_coarse,)``; NaN where none is known."""
    known = np.isfinite(values)
    area = np.where(known, vertex_areas(*as_arrays(shape.original)), 0)
    total = shape.U.T @ area
    with np.errstate(invalid="ignore", divide="ignore"):
        return (shape.U.T @ (area * np.where(known, values, 0))) / total
