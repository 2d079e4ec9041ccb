"""Displacement of the template onto a shape, and its spectral smoothing (eq. 8 and the line after it)."""

import numpy as np
import scipy.linalg

from s4a.align import rigid_transform


def smoother(B, area):
    """The A-orthogonal projection d -> B (B^T A B)^-1 B^T A d: the paper's U Phi (U Phi)^+ d, area-weighted.

    At full resolution B = U Phi is not orthonormal: projecting as if it were loses detail.

    Parameters
    ----------
    B : float ndarray (n, k)
        Basis.
    area : float ndarray (n,)
        Vertex areas.

    Returns
    -------
    callable
        Takes a field (n, 3), gives its coefficients (k, 3).
    """
    factor = scipy.linalg.cho_factor(B.T @ (area[:, None] * B), check_finite=False)
    return lambda d: scipy.linalg.cho_solve(factor, B.T @ (area[:, None] * d), check_finite=False)


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
