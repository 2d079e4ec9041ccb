"""Displacement of the template onto a shape.

And its spectral smoothing (eq. 8 and the line after it).
"""

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from s4a.geometry.align import rigid_transform


def smoother(Phi, area, U=None):
    """The A-orthogonal projection d -> B (B^T A B)^-1 B^T A d, B = U Phi.

    The paper's U Phi (U Phi)^+ d, area-weighted.

    At full resolution B is not orthonormal: projecting as if it were loses detail.  B itself is
    never formed, as B^T A B = Phi^T (U^T A U) Phi with a sparse matrix in the middle.

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
    weighted = sp.diags_array(area) if U is None else sp.diags_array(area) @ U
    mass = weighted if U is None else U.T @ weighted
    factor = scipy.linalg.cho_factor(Phi.T @ (mass @ Phi), check_finite=False)
    return lambda d: scipy.linalg.cho_solve(factor, Phi.T @ (weighted.T @ d), check_finite=False)


def onto(X, image, area, coefficients_of, spectrum=None):
    """The motion that brings X onto its image.

    And the coefficients of the displacement that is left.

    Where a `spectrum` is given, the motion is not one but that of :func:`rigid_parts`.

    Returns
    -------
    R, t : rotation (3, 3) and translation (3,), or (n, 3, 3) and (n, 3) of the parts
    c : float ndarray (k, 3)
        So that R x + t + B c is the registered shape.
    """
    if spectrum is None:
        R, t, _ = rigid_transform(X, image, area)
        return R, t, coefficients_of(image - X @ R.T - t)
    R, t = rigid_parts(X, image, area, *spectrum)
    return R, t, coefficients_of(image - np.einsum("nij,nj->ni", R, X) - t)


def rigid_parts(X, image, area, Phi, eigenvalue, *, spread=3.0):
    """For every vertex the motion that brings its surroundings closest to their image.

    :func:`s4a.geometry.align.rigid_transform` at every vertex, all others weighted by the heat
    kernel around it: eq. 8 and the line after it move what K functions cannot express, such as
    fingers, with the whole; here they turn with the arm.

    Parameters
    ----------
    X, image : float ndarray (n, 3)
    area : float ndarray (n,), of sum 1
    Phi, eigenvalue : float ndarray (n, K), (K,)
        Orthonormal eigenfunctions.  Where all eigenvalues are 0, each piece of a surface moves as a
        whole.
    spread : float
        Time of the heat kernel, by the inverse of the last eigenvalue.

    Returns
    -------
    R : float ndarray (n, 3, 3)
    t : float ndarray (n, 3)
        The motions R x + t.
    """
    falling = np.exp(-spread * eigenvalue / max(eigenvalue[-1], np.finfo(float).tiny))[:, None]

    def around(f):
        return Phi @ (falling * (Phi.T @ (area[:, None] * f)))

    p, q = around(X), around(image)
    moment = (
        around(np.einsum("ni,nj->nij", image, X).reshape(-1, 9)).reshape(-1, 3, 3)
        - q[:, :, None] * p[:, None]
    )
    U, _, Vt = np.linalg.svd(moment)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return R, q - np.einsum("nij,nj->ni", R, p)


def displacement_in_template(X, registered, area, *, scale=False):
    """Displacement of the template (eq. 8.

    As image minus template) after the shape is moved rigidly onto it.

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
    R, t, s : the motion s R x + t from the shape's frame to the template's
    """
    R, t, s = rigid_transform(registered, X, area, scale=scale)
    return s * registered @ R.T + t - X, R, t, s


def normal_displacement(displacement, normals):
    """Signed displacement along the outward normals ``(..., n)``.

    Positive is expansion (blue in Fig. 4).
    """
    return np.einsum("...nx,nx->...n", displacement, normals)
