"""Descriptors (4.1, step 4).

Heat and wave kernel signatures, of a shape or around landmarks, and their operators.

A signature passes the squared eigenfunctions through a family of filters of the eigenvalues; around
a landmark v it is the sum over the modes of filter x phi(v) x phi.  Eigenvalues and eigenfunctions
are for unit area, modes of eigenvalue 0 first.
"""

import numpy as np


def heat_filter(eigenvalue, *others, n=100):
    """Filters exp(-t lambda) of the heat kernel at n times ``(n, k)``, each of sum 1 (Sun.

    Ovsjanikov, Guibas 2009).

    The times are spaced evenly in their logarithm from 4 ln 10 / lambda_k to 4 ln 10 / lambda_1;
    with the spectra of other shapes only as far as all of them reach, so that both ends of a pair
    are filtered alike.

    Parameters
    ----------
    eigenvalue : float ndarray (k,)
    *others : float ndarray (k_2,)
        Spectra of the shapes that it is compared with.
    n : int

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.descriptors import heat_filter
    >>> heat_filter(np.array([0.0, 1.0, 2.0]), n=2).round(3).tolist()
    [[0.99, 0.01, 0.0], [1.0, 0.0, 0.0]]
    """
    spectra = (eigenvalue, *others)
    shortest = 4 * np.log(10) / max(s[-1] for s in spectra)
    longest = 4 * np.log(10) / max(s[s > 0][0] for s in spectra)
    kernel = np.exp(-np.geomspace(shortest, longest, n)[:, None] * eigenvalue)
    return kernel / kernel.sum(axis=1, keepdims=True)


def wave_filter(eigenvalue, *others, n=100):
    """Filters exp(-(e - log lambda)^2 / 2 s^2) of the wave kernel at n energies ``(n, k)``.

    Each of sum 1.

    As Aubry, Schlickewei and Cremers (2011) set them: s is 7 n-th parts of the range of log lambda,
    and the energies are spaced evenly in that range less 2 s at both ends.  Modes of eigenvalue 0
    take no part.

    Parameters
    ----------
    eigenvalue, *others, n : see :func:`heat_filter`
    """
    low, high = zip(
        *((np.log(s[s > 0][0]), np.log(s[-1])) for s in (eigenvalue, *others)), strict=True
    )
    low, high = max(low), min(high)
    sigma = 7 * (high - low) / n
    energy = np.linspace(low + 2 * sigma, high - 2 * sigma, n)
    moving = eigenvalue > 0
    kernel = np.zeros((n, len(eigenvalue)))
    exponent = -((energy[:, None] - np.log(eigenvalue[moving])) ** 2) / (2 * sigma**2)
    kernel[:, moving] = np.exp(
        exponent - exponent.max(axis=1, keepdims=True)
    )  # far from all eigenvalues, too
    return kernel / kernel.sum(axis=1, keepdims=True)


def signature(Phi, kernel):
    """Signature of every vertex ``(n, f)``: the squared eigenfunctions through f filters.

    It does not change with the signs of the eigenfunctions, nor between the sides of a symmetric
    shape.

    Parameters
    ----------
    Phi : float ndarray (n, k)
    kernel : float ndarray (f, k)
    """
    return Phi**2 @ kernel.T


def landmark_coefficients(Phi, kernel, landmark):
    """Coefficients ``(k, p f)`` of the signatures around p vertices.

    All filters of the first landmark come first.
    """
    return np.einsum("fk,pk->kpf", kernel, Phi[landmark]).reshape(Phi.shape[1], -1)


def landmark_signature(Phi, kernel, landmark):
    """Signature of every vertex around each of p landmark vertices ``(n, p f)``.

    It tells symmetric sides apart.
    """
    return Phi @ landmark_coefficients(Phi, kernel, landmark)


def hks(Phi, eigenvalue, *, n=100, landmark=None):
    """Heat kernel signature ``(n_vertices, n)``, or around p landmarks ``(n_vertices, p n)``.

    See :func:`heat_filter`.

    Parameters
    ----------
    Phi : float ndarray (n_vertices, k)
        Eigenfunctions; more than 100 change little.
    eigenvalue : float ndarray (k,)
    n : int
        Times.
    landmark : int ndarray (p,), optional

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.descriptors import hks
    >>> Phi = np.array([[1.0, 1.0], [1.0, -1.0]])
    >>> hks(Phi, np.array([0.0, 9.0]), n=1).round(6).tolist(), hks(Phi, np.array([0.0, 9.0]), n=2, landmark=[0]).shape
    ([[1.0], [1.0]], (2, 2))
    """
    kernel = heat_filter(eigenvalue, n=n)
    return signature(Phi, kernel) if landmark is None else landmark_signature(Phi, kernel, landmark)


def wks(Phi, eigenvalue, *, n=100, landmark=None):
    """Wave kernel signature ``(n_vertices, n)``, or around p landmarks ``(n_vertices, p n)``.

    See :func:`wave_filter`.

    It holds finer detail than :func:`hks`, whose low modes weigh on all times.

    Parameters
    ----------
    Phi, eigenvalue, landmark : see :func:`hks`
    n : int
        Energies.
    """
    kernel = wave_filter(eigenvalue, n=n)
    return signature(Phi, kernel) if landmark is None else landmark_signature(Phi, kernel, landmark)


def multiplication(Phi, area, f):
    """Operators g -> f g in the basis, Phi^T A diag(f) Phi ``(d, k, k)``.

    For d functions (Nogneng & Ovsjanikov 2017).

    Parameters
    ----------
    Phi : float ndarray (n, k)
    area : float ndarray (n,), of sum 1
    f : float ndarray (n, d)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.descriptors import multiplication
    >>> multiplication(np.ones((2, 1)), np.array([0.5, 0.5]), np.array([[1.0, 4.0], [3.0, 4.0]])).ravel().tolist()
    [2.0, 4.0]
    """
    weighted = area[:, None] * Phi
    return np.stack([weighted.T @ (column[:, None] * Phi) for column in f.T])


def orientation(T, Phi, f):
    """Operators g -> <grad f x grad g, normal> in the basis ``(d, k, k)`` (Ren, Poulenard.

    Wonka, Ovsjanikov 2018).

    Of linear functions on a triangle its integral is half the determinant of their differences
    along two sides: the triangle's shape drops out.  The operators change sign where a map turns
    the surface over, which tells the sides of a symmetric shape apart.

    Parameters
    ----------
    T : int ndarray (m, 3)
        Triangles, turned the same way.
    Phi : float ndarray (n, k)
        Basis, orthonormal in the vertex areas.
    f : float ndarray (n, d)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.descriptors import orientation
    >>> orientation(np.array([[0, 1, 2]]), np.eye(3), np.array([[0.0], [1.0], [0.0]])).round(3)[0, 0].tolist()
    [-0.167, 0.0, 0.167]
    """
    mean = Phi[T].mean(axis=1)
    first, second = (Phi[T[:, i]] - Phi[T[:, 0]] for i in (1, 2))
    found = []
    for column in f.T:
        along, across = (column[T[:, i]] - column[T[:, 0]] for i in (1, 2))
        found.append(mean.T @ (along[:, None] * second - across[:, None] * first) / 2)
    return np.stack(found)
