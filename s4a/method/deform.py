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


def smoother(Phi: Array, area: Array, U: sp.spmatrix | None = None) -> Callable[..., Any]:
    """The A-orthogonal projection d -> B (B^T A B)^-1 B^T A d, B = U Phi.

    The paper's U Phi (U Phi)^+ d, weighted by area.  At full resolution B is not orthonormal:
    projecting as if it were loses detail.  B itself is never formed, as B^T A B =
    Phi^T (U^T A U) Phi with a sparse matrix in the middle.

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
        Takes a field (n, 3), gives its coefficients (k, 3).
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
    """The transform that brings X onto its image, and the displacement that it leaves, smoothed.

    Parameters
    ----------
    X, image : float ndarray (n, 3)
    area : float ndarray (n,)
    coefficients : callable
        Of a field (n, 3), as of :func:`smoother`.
    spectrum : tuple (mass, Phi, eigenvalue), optional
        Where it is given, the transform is not one but that of :func:`rigid_parts`.

    Returns
    -------
    R, t : rotation (3, 3) and translation (3,), or (n, 3, 3) and (n, 3) of the parts
    c : float ndarray (k, 3)
        So that R x + t + B c is the registered shape.
    """
    if spectrum is None:
        R, t, _ = rigid_transform(X, image, area)
        return R, t, coefficients(image - X @ R.T - t)
    R, t = rigid_parts(X, image, *spectrum)
    return R, t, coefficients(image - np.einsum("nij,nj->ni", R, X) - t)


def rigid_parts(
    X: Array,
    image: Array,
    mass: Array | sp.spmatrix,
    Phi: Array,
    eigenvalue: Array,
    *,
    spread: float = 3.0,
) -> tuple[Array, Array]:
    """For every vertex the transform that brings its surroundings closest to their image.

    :func:`s4a.geometry.align.rigid_transform` at every vertex, all others weighted by the heat
    kernel around it: eq. 8 and the line after it move what K functions cannot express, such as
    fingers, with the whole; here they turn with the arm.

    Parameters
    ----------
    X, image : float ndarray (n, 3)
    mass : float ndarray (n,), of sum 1, or sparse matrix (n, n)
        What Phi is orthonormal in.
    Phi, eigenvalue : float ndarray (n, K), (K,)
        Orthonormal eigenfunctions.  Where all eigenvalues are 0, each piece of a surface moves as a
        whole.
    spread : float
        Time of the heat kernel, by the inverse of the last eigenvalue.

    Returns
    -------
    R : float ndarray (n, 3, 3)
    t : float ndarray (n, 3)
        The transforms R x + t.
    """
    largest = max(eigenvalue[-1], np.finfo(float).tiny)
    heat = np.exp(-spread * eigenvalue / largest)[:, None]  # (K, 1)

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
    """Displacement of the template (eq. 8), in the template's frame.

    Image minus template: the paper's with the other sign, so that template + displacement is the
    shape.

    The shape is moved rigidly onto the template before.

    Parameters
    ----------
    X : float ndarray (n, 3)
        Template vertices.
    registered : float ndarray (n, 3)
        Their images in the frame of the shape.
    area : float ndarray (n,)
        Template vertex areas.
    scale : bool
        Whether the shapes' size is taken out as well.

    Returns
    -------
    displacement : float ndarray (n, 3)
    R, t, s : the transform s R x + t from the shape's frame to the template's
    """
    R, t, s = rigid_transform(registered, X, area, scale=scale)
    return s * registered @ R.T + t - X, R, t, s


def normal_displacement(displacement: Array, normals: Array) -> Array:
    """Signed displacement along the outward normals ``(..., n)``: positive is expansion.

    That is blue in Fig. 4.
    """
    return np.einsum("...nx,nx->...n", displacement, normals)


def distortion(X: Array, image: Array, T: Array) -> tuple[Array, Array]:
    """Conformal and area distortion of every triangle that a map carries.

    With s1 >= s2 the singular values of the linear map of a triangle: log(s1 / s2), 0 where angles
    are kept, and log(s1 s2), 0 where the area is kept, positive where it grows.  They see torn,
    sheared and collapsed triangles. They cannot see where a triangle goes or whether it is turned
    over, and a true map between different shapes has distortion, too.

    Parameters
    ----------
    X : float ndarray (n, 3)
        Vertices.
    image : float ndarray (n, 3)
        Where the map takes them.
    T : int ndarray (m, 3)

    Returns
    -------
    conformal : float ndarray (m,)
        Infinite where the image is a line or a point.
    area : float ndarray (m,)
        Minus infinity there.  NaN, both, for triangles without an area of their own.

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
        # trace(G^-1 H) = s1^2 + s2^2 and det = (s1 s2)^2,
        # so that their ratio is 2 cosh(log(s1 / s2))
        trace = (
            G[:, 1, 1] * H[:, 0, 0] + G[:, 0, 0] * H[:, 1, 1] - 2 * G[:, 0, 1] * H[:, 0, 1]
        ) / before**2
        ratio = np.where(after > 0, trace * before / (2 * after), np.inf)
        conformal, area = np.arccosh(np.maximum(ratio, 1)), np.log(after / before)
    flat = before == 0
    return np.where(flat, np.nan, conformal), np.where(flat, np.nan, area)
