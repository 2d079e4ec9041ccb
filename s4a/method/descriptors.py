"""Descriptors (4.1, step 4): heat and wave kernel signatures, of a shape or around landmarks.

And the operators that a functional map is to commute with.  A signature passes the squared
eigenfunctions through a family of filters of the eigenvalues; around a landmark v it is the sum
over the modes of filter x phi(v) x phi.  Eigenvalues and eigenfunctions are for unit area, modes of
eigenvalue 0 first.
"""

import numpy as np


def heat_filter(eigenvalue: np.ndarray, *others: np.ndarray, n: int = 100) -> np.ndarray:
    """Filters exp(-t lambda) of the heat kernel at n times ``(n, k)``, each of sum 1.

    Of Sun, Ovsjanikov and Guibas (2009).  The times are spaced evenly in their logarithm from 4 ln
    10 / lambda_k to 4 ln 10 / lambda_1; with the spectra of other shapes only as far as all of them
    reach, so that both ends of a pair are filtered alike.

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
    shortest = 4 * np.log(10) / min(s[-1] for s in spectra)
    longest = 4 * np.log(10) / max(s[s > 0][0] for s in spectra)
    time = np.geomspace(shortest, longest, n)
    kernel = np.exp(-time[:, None] * eigenvalue)  # (n, k)
    return kernel / kernel.sum(axis=1, keepdims=True)


def wave_filter(eigenvalue: np.ndarray, *others: np.ndarray, n: int = 100) -> np.ndarray:
    """Filters exp(-(e - log lambda)^2 / 2 s^2) of the wave kernel at n energies ``(n, k)``.

    Each of sum 1, as Aubry, Schlickewei and Cremers (2011) set them: s is 7 n-th parts of the range
    of log lambda, and the energies are spaced evenly in that range less 2 s at both ends.  Modes of
    eigenvalue 0 take no part.

    Parameters
    ----------
    eigenvalue, *others, n : see :func:`heat_filter`
    """
    spectra = (eigenvalue, *others)
    low = max(np.log(s[s > 0][0]) for s in spectra)
    high = min(np.log(s[-1]) for s in spectra)
    sigma = 7 * (high - low) / n
    energy = np.linspace(low + 2 * sigma, high - 2 * sigma, n)
    moving = eigenvalue > 0
    kernel = np.zeros((n, len(eigenvalue)))
    exponent = -((energy[:, None] - np.log(eigenvalue[moving])) ** 2) / (2 * sigma**2)
    exponent -= exponent.max(axis=1, keepdims=True)  # no row vanishes, however far its energy is
    kernel[:, moving] = np.exp(exponent)
    return kernel / kernel.sum(axis=1, keepdims=True)


def signature(Phi: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Signature of every vertex ``(n, f)``: the squared eigenfunctions through f filters.

    It does not change with the signs of the eigenfunctions, nor between the sides of a symmetric
    shape.

    Parameters
    ----------
    Phi : float ndarray (n, k)
    kernel : float ndarray (f, k)
    """
    return Phi**2 @ kernel.T


def landmark_coefficients(Phi: np.ndarray, kernel: np.ndarray, landmark: np.ndarray) -> np.ndarray:
    """Coefficients ``(k, p f)`` of the signatures around p vertices, filter by filter for each."""
    return np.einsum("fk,pk->kpf", kernel, Phi[landmark]).reshape(Phi.shape[1], -1)


def landmark_signature(Phi: np.ndarray, kernel: np.ndarray, landmark: np.ndarray) -> np.ndarray:
    """Signature of every vertex around p vertices ``(n, p f)``; it tells symmetric sides apart."""
    return Phi @ landmark_coefficients(Phi, kernel, landmark)


def hks(
    Phi: np.ndarray, eigenvalue: np.ndarray, *, n: int = 100, landmark: np.ndarray | None = None
) -> np.ndarray:
    """Heat kernel signature ``(n_vertices, n)``, or around p landmarks ``(n_vertices, p n)``.

    Its filters are those of :func:`heat_filter`.

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
    >>> hks(Phi, np.array([0.0, 9.0]), n=1).round(6).tolist()
    [[1.0], [1.0]]
    >>> hks(Phi, np.array([0.0, 9.0]), n=2, landmark=[0]).shape
    (2, 2)
    """
    kernel = heat_filter(eigenvalue, n=n)
    return signature(Phi, kernel) if landmark is None else landmark_signature(Phi, kernel, landmark)


def wks(
    Phi: np.ndarray, eigenvalue: np.ndarray, *, n: int = 100, landmark: np.ndarray | None = None
) -> np.ndarray:
    """Wave kernel signature ``(n_vertices, n)``, or around p landmarks ``(n_vertices, p n)``.

    Its filters are those of :func:`wave_filter`.  It holds finer detail than :func:`hks`, whose low
    modes weigh on all times.

    Parameters
    ----------
    Phi, eigenvalue, landmark : see :func:`hks`
    n : int
        Energies.
    """
    kernel = wave_filter(eigenvalue, n=n)
    return signature(Phi, kernel) if landmark is None else landmark_signature(Phi, kernel, landmark)


def mean_curvature(
    X: np.ndarray, normals: np.ndarray, area: np.ndarray, Phi: np.ndarray, eigenvalue: np.ndarray
) -> np.ndarray:
    """Signed mean curvature ``(n,)`` of the surface that k eigenfunctions keep of a mesh.

    Half of <L X, normal>, L X = Phi Lambda Phi^T A X: positive where the surface bulges outwards.
    Unlike signatures it changes with the embedding, and tells the front of a body from its back.

    Parameters
    ----------
    X, normals : float ndarray (n, 3)
    area : float ndarray (n,), of sum 1
    Phi : float ndarray (n, k)
    eigenvalue : float ndarray (k,)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.descriptors import mean_curvature
    >>> X = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    >>> mean_curvature(X, X, np.full(6, 1 / 6), 3**0.5 * X, np.full(3, 2.0)).round(6).tolist()
    [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    """
    smooth = Phi @ (eigenvalue[:, None] * (Phi.T @ (area[:, None] * X)))  # L X, (n, 3)
    return np.einsum("nx,nx->n", smooth, normals) / 2


def multiplication(Phi: np.ndarray, area: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Operators g -> f g in the basis: Phi^T A diag(f) Phi for d functions ``(d, k, k)``.

    After Nogneng and Ovsjanikov (2017).

    Parameters
    ----------
    Phi : float ndarray (n, k)
    area : float ndarray (n,), of sum 1
    f : float ndarray (n, d)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.descriptors import multiplication
    >>> f = np.array([[1.0, 4.0], [3.0, 4.0]])
    >>> multiplication(np.ones((2, 1)), np.array([0.5, 0.5]), f).ravel().tolist()
    [2.0, 4.0]
    """
    weighted = area[:, None] * Phi
    return np.stack([weighted.T @ (column[:, None] * Phi) for column in f.T])


def orientation(T: np.ndarray, Phi: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Operators g -> <grad f x grad g, normal> in the basis ``(d, k, k)``.

    Of Ren, Poulenard, Wonka and Ovsjanikov (2018).  Of linear functions on a triangle its integral
    is half the determinant of their differences along two sides: the triangle's shape drops out.
    The operators change sign where a map turns the surface over, which tells the sides of a
    symmetric shape apart.

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
    >>> f = np.array([[0.0], [1.0], [0.0]])
    >>> orientation(np.array([[0, 1, 2]]), np.eye(3), f).round(3)[0, 0].tolist()
    [-0.167, 0.0, 0.167]
    """
    a, b, c = T.T
    mean = Phi[T].mean(axis=1)  # (m, k)
    along_b, along_c = Phi[b] - Phi[a], Phi[c] - Phi[a]
    operators = []
    for column in f.T:
        f_b, f_c = column[b] - column[a], column[c] - column[a]
        determinant = f_b[:, None] * along_c - f_c[:, None] * along_b  # (m, k)
        operators.append(mean.T @ determinant / 2)
    return np.stack(operators)
