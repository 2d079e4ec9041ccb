"""Displacement (4.2, eq. 8) of the template onto a shape, and its spectral smoothing.

The smoothing is the line after eq. 8: projection onto the first functions U Phi.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from s4a.geometry.align import rigid_transform
from s4a.geometry.mesh import triangle_areas
from s4a.method.spectral import project
from s4a.schema import Array

_TIME = 3.0  # of the heat kernel of rigid parts, times the last eigenvalue


def smoother(Phi: Array, area: Array, U: sp.spmatrix | None = None) -> Callable[..., Any]:
    """Return the A-orthogonal projection d -> (B^T A B)^-1 B^T A d onto B = U Phi.

    The paper's (U Phi)^+ d, weighted by area.  At full resolution B is not orthonormal, and B^T A d
    would lose detail.  B is never formed: B^T A B = Phi^T (U^T A U) Phi with a sparse U^T A U.

    Parameters
    ----------
    Phi : float ndarray (n_coarse, k)
        Basis.
    area : float ndarray (n,)
        Vertex areas.
    U : sparse matrix (n, n_coarse), optional
        Projection operator; the identity by default.

    Returns
    -------
    callable
        Maps a field (n, 3) to its coefficients (k, 3).
    """
    A = sp.diags_array(area)
    weighted = A if U is None else A @ U  # (n, n_coarse)
    mass = weighted if U is None else U.T @ weighted  # (n_coarse, n_coarse)
    factor = scipy.linalg.cho_factor(Phi.T @ (mass @ Phi), check_finite=False)

    def coefficients(d):
        return scipy.linalg.cho_solve(factor, Phi.T @ (weighted.T @ d), check_finite=False)

    return coefficients


def onto(
    X: Array,
    image: Array,
    area: Array,
    coefficients: Callable[..., Any],
    spectrum: tuple[Array | sp.spmatrix, Array, Array] | None = None,
) -> tuple[Array, Array, Array]:
    """Fit a rigid transform of X to its image, and smooth the residual displacement.

    Parameters
    ----------
    X, image : float ndarray (n, 3)
    area : float ndarray (n,)
    coefficients : callable
        Projection of a field (n, 3), see :func:`smoother`.
    spectrum : tuple (mass, Phi, eigenvalue), optional
        If given, the transform is that of :func:`rigid_parts` at every vertex.

    Returns
    -------
    R, t : rotation (3, 3) and translation (3,), or (n, 3, 3) and (n, 3) of the parts
    c : float ndarray (k, 3)
        Coefficients; R x + t + B c is the registered shape.
    """
    if spectrum is None:
        R, t, _ = rigid_transform(X, image, area)
        return R, t, coefficients(image - X @ R.T - t)
    R, t = rigid_parts(X, image, *spectrum)
    return R, t, coefficients(image - np.einsum("nij,nj->ni", R, X) - t)


def rigid_parts(
    X: Array, image: Array, mass: Array | sp.spmatrix, Phi: Array, eigenvalue: Array
) -> tuple[Array, Array]:
    """Fit a rigid transform around every vertex: a smooth, piecewise rigid transform.

    :func:`s4a.geometry.align.rigid_transform` with weights of the heat kernel around the vertex.
    Details that K functions cannot express, such as fingers, then rotate with the arm.

    Parameters
    ----------
    X, image : float ndarray (n, 3)
    mass : float ndarray (n,), of sum 1, or sparse matrix (n, n)
        Mass matrix in which Phi is orthonormal.
    Phi, eigenvalue : float ndarray (n, K), (K,)
        Orthonormal eigenfunctions.  If all eigenvalues are 0, each component moves rigidly.

    Returns
    -------
    R : float ndarray (n, 3, 3)
    t : float ndarray (n, 3)
        The transforms R x + t.
    """
    largest = max(eigenvalue[-1], np.finfo(float).tiny)
    heat = np.exp(-_TIME * eigenvalue / largest)[:, None]  # (K, 1)

    def around(f):
        """Mean of a function around every vertex, weighted by the heat kernel."""
        return Phi @ (heat * project(Phi, mass, f))

    p = around(X)  # (n, 3)
    q = around(image)  # (n, 3)
    products = np.einsum("ni,nj->nij", image, X).reshape(-1, 9)
    covariance = around(products).reshape(-1, 3, 3) - q[:, :, None] * p[:, None]
    U, _, Vt = np.linalg.svd(covariance)  # Kabsch's solution, at every vertex
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return R, q - np.einsum("nij,nj->ni", R, p)


def displacement_in_template(
    X: Array, registered: Array, area: Array, *, scale: bool = False
) -> tuple[Array, Array, Array, float]:
    """Return the displacement of the template (eq. 8) after rigid alignment of the shape.

    Image minus template, the opposite sign of the paper, so that template + displacement is the
    shape.

    Parameters
    ----------
    X : float ndarray (n, 3)
        Template vertices.
    registered : float ndarray (n, 3)
        Their images in the frame of the shape.
    area : float ndarray (n,)
        Template vertex areas.
    scale : bool
        Whether to remove size.

    Returns
    -------
    displacement : float ndarray (n, 3)
        In the frame of the template.
    R, t, s : the transform s R x + t from the frame of the shape to that of the template
    """
    R, t, s = rigid_transform(registered, X, area, scale=scale)
    return s * registered @ R.T + t - X, R, t, s


def normal_displacement(displacement: Array, normals: Array) -> Array:
    """Return displacements along outward normals ``(..., n)``; positive (blue) is expansion."""
    return np.einsum("...nx,nx->...n", displacement, normals)


def distortion(X: Array, image: Array, T: Array) -> tuple[Array, Array]:
    """Return the conformal and area distortion of every triangle under a map.

    With s1 >= s2 the singular values of the linear map of a triangle: log(s1 / s2), 0 if angles are
    preserved, and log(s1 s2), 0 if area is preserved, positive if it grows.  They see stretched,
    sheared and collapsed triangles.  They cannot see a wrong position or a flipped triangle, and
    correct maps between different shapes have distortion, too.

    Parameters
    ----------
    X : float ndarray (n, 3)
        Vertices.
    image : float ndarray (n, 3)
        Images of the vertices.
    T : int ndarray (m, 3)

    Returns
    -------
    conformal : float ndarray (m,)
        Infinite if the image is degenerate.
    area : float ndarray (m,)
        Minus infinity if the image is degenerate.  Both are NaN for degenerate triangles.

    See Also
    --------
    s4a.method.register.stretch : Both distortions in one number per vertex.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> X, T = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    >>> conformal, area = s4a.metrics.distortion(X, X * [2.0, 4.0, 1.0], T)
    >>> bool(np.isclose(conformal[0], np.log(2))), bool(np.isclose(area[0], np.log(8)))
    (True, True)
    """

    def gram(P):
        sides = np.stack([P[T[:, 1]] - P[T[:, 0]], P[T[:, 2]] - P[T[:, 0]]], axis=1)
        return np.einsum("mix,mjx->mij", sides, sides)

    G, H = gram(X), gram(image)
    before, after = 2 * triangle_areas(X, T), 2 * triangle_areas(image, T)
    with np.errstate(divide="ignore", invalid="ignore"):
        # trace(G^-1 H) = s1^2 + s2^2 and det = (s1 s2)^2: their ratio is 2 cosh(log(s1 / s2))
        trace = (
            G[:, 1, 1] * H[:, 0, 0] + G[:, 0, 0] * H[:, 1, 1] - 2 * G[:, 0, 1] * H[:, 0, 1]
        ) / before**2
        ratio = np.where(after > 0, trace * before / (2 * after), np.inf)
        conformal, area = np.arccosh(np.maximum(ratio, 1)), np.log(after / before)
    flat = before == 0
    return np.where(flat, np.nan, conformal), np.where(flat, np.nan, area)
