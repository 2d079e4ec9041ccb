"""Displacement of the template onto a shape, and its spectral smoothing (eq. 8 and the line after it)."""

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from s4a.align import rigid_transform


def smoother(Phi, area, U=None):
    """The A-orthogonal projection d -> B (B^T A B)^-1 B^T A d, B = U Phi: the paper's U Phi (U Phi)^+ d, area-weighted.

    At full resolution B is not orthonormal: projecting as if it were loses detail.  B itself is never formed, as
    B^T A B = Phi^T (U^T A U) Phi with a sparse matrix in the middle.

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


def onto(X, image, area, coefficients_of):
    """The motion that brings X onto its image, and the coefficients of the displacement that is left.

    Returns
    -------
    R, t : rotation (3, 3) and translation (3,)
    c : float ndarray (k, 3)
        So that R x + t + B c is the registered shape.
    """
    R, t, _ = rigid_transform(X, image, area)
    return R, t, coefficients_of(image - X @ R.T - t)


def displacement_in_template(X, registered, area, *, scale=False):
    """Displacement of the template (eq. 8, as image minus template) after the shape is moved rigidly onto it.

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
    """Signed displacement along the outward normals ``(..., n)``: positive is expansion (blue in Fig. 4)."""
    return np.einsum("...nx,nx->...n", displacement, normals)
