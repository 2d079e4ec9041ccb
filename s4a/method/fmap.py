"""Functional maps (3.3, 4.1): fit, map <-> match (eq. 1 and 2), ZoomOut.

The source is the paper's M with basis Phi, the target N with basis Psi.  C maps functions of the
source to functions of the target; a match holds, for every vertex of the target, a vertex of the
source.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from s4a.method.nearest import as_candidates, as_queries, nearest_float32, nearest_rows
from s4a.method.shape import Basis, common_fields
from s4a.schema import Array


def heat_filter(eigenvalue: Array, *others: Array, n: int = 100) -> Array:
    """Return filters exp(-t lambda) of the heat kernel at n times ``(n, k)``, each of sum 1.

    Times are spaced logarithmically from 4 ln 10 / lambda_k to 4 ln 10 / lambda_1 (Sun, Ovsjanikov
    and Guibas 2009), restricted to the range of all given spectra, so that both shapes of a pair
    have the same filters.

    Parameters
    ----------
    eigenvalue : float ndarray (k,)
    *others : float ndarray (k_2,)
        Eigenvalues of the shapes to compare with.
    n : int

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import heat_filter
    >>> heat_filter(np.array([0.0, 1.0, 2.0]), n=2).round(3).tolist()
    [[0.99, 0.01, 0.0], [1.0, 0.0, 0.0]]
    """
    spectra = (eigenvalue, *others)
    shortest = 4 * np.log(10) / min(s[-1] for s in spectra)
    longest = 4 * np.log(10) / max(s[s > 0][0] for s in spectra)
    time = np.geomspace(shortest, longest, n)
    kernel = np.exp(-time[:, None] * eigenvalue)  # (n, k)
    return kernel / kernel.sum(axis=1, keepdims=True)


def wave_filter(eigenvalue: Array, *others: Array, n: int = 100) -> Array:
    """Return filters exp(-(e - log lambda)^2 / 2 s^2) of the wave kernel at n energies ``(n, k)``.

    Each has the sum 1.  As in Aubry, Schlickewei and Cremers (2011), s is 7/n of the range of
    log lambda, and energies are spaced evenly in that range less 2 s at both ends.  Eigenvalues 0
    are excluded.

    Parameters
    ----------
    eigenvalue, *others, n : see :func:`heat_filter`
    """
    spectra = (eigenvalue, *others)
    low = max(np.log(s[s > 0][0]) for s in spectra)
    high = min(np.log(s[-1]) for s in spectra)
    sigma = 7 * (high - low) / n
    energy = np.linspace(low + 2 * sigma, high - 2 * sigma, n)
    positive = eigenvalue > 0
    kernel = np.zeros((n, len(eigenvalue)))
    exponent = -((energy[:, None] - np.log(eigenvalue[positive])) ** 2) / (2 * sigma**2)
    exponent -= exponent.max(axis=1, keepdims=True)  # no row underflows to zero
    kernel[:, positive] = np.exp(exponent)
    return kernel / kernel.sum(axis=1, keepdims=True)


def signature(Phi: Array, kernel: Array, landmark: Array | None = None) -> Array:
    """Return the signature of every vertex ``(n, f)``: squared eigenfunctions times f filters.

    It does not depend on the signs of the eigenfunctions, and cannot distinguish the sides of a
    symmetric shape.  Signatures around p landmarks ``(n, p f)`` distinguish them.

    Parameters
    ----------
    Phi : float ndarray (n, k)
    kernel : float ndarray (f, k)
    landmark : int ndarray (p,), optional
    """
    if landmark is None:
        return Phi**2 @ kernel.T
    return Phi @ landmark_coefficients(Phi, kernel, landmark)


def landmark_coefficients(Phi: Array, kernel: Array, landmark: Array) -> Array:
    """Return the coefficients ``(k, p f)`` of the signatures around p vertices with f filters."""
    return np.einsum("fk,pk->kpf", kernel, Phi[landmark]).reshape(Phi.shape[1], -1)


def hks(Phi: Array, eigenvalue: Array, *, n: int = 100, landmark: Array | None = None) -> Array:
    """Heat kernel signature ``(n_vertices, n)``, or around p landmarks ``(n_vertices, p n)``.

    The filters are those of :func:`heat_filter`.

    Parameters
    ----------
    Phi : float ndarray (n_vertices, k)
        Eigenfunctions; more than 100 change little.
    eigenvalue : float ndarray (k,)
    n : int
        Number of times.
    landmark : int ndarray (p,), optional

    See Also
    --------
    wks : Wave kernel signature, with finer detail.

    References
    ----------
    Sun, J., Ovsjanikov, M. and Guibas, L. (2009). A concise and provably informative multi-scale
    signature based on heat diffusion. Computer Graphics Forum 28(5).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import hks
    >>> Phi = np.array([[1.0, 1.0], [1.0, -1.0]])
    >>> hks(Phi, np.array([0.0, 9.0]), n=1).round(6).tolist()
    [[1.0], [1.0]]
    >>> hks(Phi, np.array([0.0, 9.0]), n=2, landmark=[0]).shape
    (2, 2)
    """
    return signature(Phi, heat_filter(eigenvalue, n=n), landmark)


def wks(Phi: Array, eigenvalue: Array, *, n: int = 100, landmark: Array | None = None) -> Array:
    """Wave kernel signature ``(n_vertices, n)``, or around p landmarks ``(n_vertices, p n)``.

    The filters are those of :func:`wave_filter`.  It has finer detail than :func:`hks`, where low
    frequencies contribute to all times.

    Parameters
    ----------
    Phi, eigenvalue, landmark : see :func:`hks`
    n : int
        Number of energies.

    See Also
    --------
    hks : Heat kernel signature.

    References
    ----------
    Aubry, M., Schlickewei, U. and Cremers, D. (2011). The wave kernel signature: a quantum
    mechanical approach to shape analysis. ICCV Workshops.
    """
    return signature(Phi, wave_filter(eigenvalue, n=n), landmark)


def mean_curvature(X: Array, normals: Array, area: Array, Phi: Array, eigenvalue: Array) -> Array:
    """Return the signed mean curvature ``(n,)`` of a mesh smoothed to k eigenfunctions.

    Half of <L X, normal> with L X = Phi Lambda Phi^T A X, positive for convex surfaces.  Unlike
    signatures it depends on the embedding, and distinguishes the front of a body from the back.

    Parameters
    ----------
    X, normals : float ndarray (n, 3)
    area : float ndarray (n,), of sum 1
    Phi : float ndarray (n, k)
    eigenvalue : float ndarray (k,)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import mean_curvature
    >>> X = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    >>> mean_curvature(X, X, np.full(6, 1 / 6), 3**0.5 * X, np.full(3, 2.0)).round(6).tolist()
    [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    """
    smooth = Phi @ (eigenvalue[:, None] * (Phi.T @ (area[:, None] * X)))  # L X, (n, 3)
    return np.einsum("nx,nx->n", smooth, normals) / 2


def multiplication(Phi: Array, area: Array, f: Array) -> Array:
    """Return operators g -> f g in the basis: Phi^T A diag(f) Phi for d functions ``(d, k, k)``.

    Multiplication operators of Nogneng and Ovsjanikov (2017).

    Parameters
    ----------
    Phi : float ndarray (n, k)
    area : float ndarray (n,), of sum 1
    f : float ndarray (n, d)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import multiplication
    >>> f = np.array([[1.0, 4.0], [3.0, 4.0]])
    >>> multiplication(np.ones((2, 1)), np.array([0.5, 0.5]), f).ravel().tolist()
    [2.0, 4.0]
    """
    weighted = area[:, None] * Phi
    return np.stack([weighted.T @ (column[:, None] * Phi) for column in f.T])


def orientation(T: Array, Phi: Array, f: Array) -> Array:
    """Return the operators g -> <grad f x grad g, normal> in the basis ``(d, k, k)``.

    Orientation operators of Ren, Poulenard, Wonka and Ovsjanikov (2018).  The integral for linear
    functions on a triangle is half the determinant of their differences along two sides.  The
    operators change sign under orientation-reversing maps, which distinguishes the sides of a
    symmetric shape.

    Parameters
    ----------
    T : int ndarray (m, 3)
        Triangles of consistent orientation.
    Phi : float ndarray (n, k)
        Basis, orthonormal in the vertex areas.
    f : float ndarray (n, d)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import orientation
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


LAPLACIAN = 1e-3  # weight of Laplacian commutativity
EVERY = 5  # every fifth of 100 energies or times is used, as neighbours are nearly equal
_FILTERS = {"wks": wave_filter, "hks": heat_filter}
SCALES = (20, 40, 60, 90)  # numbers of eigenfunctions of the mean curvatures


def fmap_from_match(
    Phi_source: Array,
    Phi_target: Array,
    area_target: Array | sp.sparray | sp.spmatrix,
    match: Array,
) -> Array:
    """Return the functional map of a match, C = Psi^T A_N Phi[match] (eq. 1 in both bases).

    Parameters
    ----------
    Phi_source : float ndarray (n_source, k)
    Phi_target : float ndarray (n_target, k)
    area_target : float ndarray (n_target,), of sum 1, or a sparse matrix
        Mass matrix in which Phi_target is orthonormal.
    match : int ndarray (n_target,)

    Returns
    -------
    C : float ndarray (k_target, k_source)
    """
    if sp.issparse(area_target):
        return (area_target @ Phi_target).T @ Phi_source[match]
    return Phi_target.T @ (area_target[:, None] * Phi_source[match])


def match_from_fmap(
    C: Array, Phi_source: Array, Phi_target: Array, *, nearest: Callable[..., Any] = nearest_rows
) -> Array:
    """Return the match of a functional map: nearest rows of Phi C^T to those of Psi (eq. 2)."""
    k_target, k_source = C.shape
    return nearest(Phi_target[:, :k_target], Phi_source[:, :k_source] @ C.T)


def zoomout(
    source: Basis,
    target: Basis,
    C: Array,
    k: int,
    *,
    step: int = 5,
    nearest: Callable[..., Any] = nearest_rows,
    keep: Callable[..., Any] | None = None,
) -> tuple[Array, Array]:
    """Refine a functional map by ZoomOut (4.1) until it is k x k.

    Parameters
    ----------
    source, target : Basis
        With at least k functions.
    C : float ndarray (k_init, k_init)
    k : int
        Final size.
    step : int
        Growth per iteration.
    nearest : callable
        Nearest-neighbour search with the signature of :func:`s4a.method.nearest.nearest_rows`.
    keep : callable, optional
        Called with the map and the match of each iteration.

    Returns
    -------
    C : float ndarray (k, k)
    match : int ndarray (n_target,)
        The match of the final C.

    See Also
    --------
    s4a.refine_network : Consistent ZoomOut of a collection.

    References
    ----------
    S. Melzi et al. (2019), ZoomOut: spectral upsampling for efficient shape correspondence, ACM
    Transactions on Graphics 38(6).
    """
    sizes = [*range(C.shape[0] + step, k, step), k] if k > C.shape[0] else []
    for size in [*sizes, 0]:
        match = match_from_fmap(C, source.Phi, target.Phi, nearest=nearest)
        if keep:
            keep(C, match)
        if size:
            C = fmap_from_match(source.Phi[:, :size], target.Phi[:, :size], target.mass, match)
    return C, match


def refine_once(source: Basis, target: Basis, C: Array, n_samples: int = 0) -> Array:
    """Apply one step of ZoomOut without growth (4.2): C -> match -> C of the same size.

    With `n_samples` > 0 only as many samples of the target are matched, and C is the least-squares
    solution on them, as in Consistent ZoomOut.  If there are fewer samples than functions, all
    vertices are used.
    """
    Phi = source.Phi[:, : C.shape[1]]
    Psi = target.Phi[:, : len(C)]
    sampled = len(C) <= n_samples < len(Psi)
    rows = target.sample_vertices_of(n_samples) if sampled else slice(None)
    match = nearest_float32(as_queries(Psi[rows]), as_candidates(Phi @ C.T))
    if not sampled:
        return fmap_from_match(Phi, Psi, target.mass, match)
    root = np.sqrt(target.area[rows])[:, None]
    return np.linalg.lstsq(root * Psi[rows], root * Phi[match], rcond=None)[0]


def fit(
    F: Array,
    G: Array,
    *,
    penalty: Array | float = 0.0,
    operators: Sequence[tuple[float, Array, Array]] = (),
    constant: float = 1.0,
) -> Array:
    """Fit a functional map that maps constants to constants by least squares (step 4 of 4.1).

    E(C) = |C F - G|^2 + sum penalty C^2 + sum w |C P - Q C|^2.  The normal equations are solved
    directly: row by row without operators, else for all k_target (k_source - 1) unknowns at once, a
    dense system of 50 MB for 50 x 50 and 800 MB for 100 x 100.

    Parameters
    ----------
    F, G : float ndarray (k_source, d), (k_target, d)
        Coefficients of corresponding functions.
    penalty : float ndarray (k_target, k_source)
        Penalty on the squared entries: w (mu_i - lambda_j)^2 for Laplacian commutativity.
    operators : list of tuple (w, P, Q)
        Weight, and stacks of corresponding operators (p, k_source, k_source) and (p, k_target,
        k_target).
    constant : float
        C[0, 0]: 1 if both first eigenfunctions are positive.

    Returns
    -------
    C : float ndarray (k_target, k_source)
        The first column is given: `constant`, then zeros.

    References
    ----------
    M. Ovsjanikov et al. (2012), Functional maps: a flexible representation of maps between shapes,
    ACM Transactions on Graphics 31(4).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import fit
    >>> F = np.random.default_rng(0).normal(size=(3, 5))
    >>> np.allclose(fit(F, F), np.eye(3))
    True
    """
    k_target, k_source = len(G), len(F)
    C = np.zeros((k_target, k_source))
    C[0, 0] = constant
    FF = F @ F.T  # (k_source, k_source)
    GF = G @ F.T  # (k_target, k_source)
    penalty = np.broadcast_to(penalty, C.shape)
    if not operators:
        for row, p, g in zip(C, penalty, GF, strict=True):
            row[1:] = np.linalg.solve(FF[1:, 1:] + np.diag(p[1:]), g[1:] - row[0] * FF[0, 1:])
        return C
    # the quadratic form of all entries of C, row after row
    H = np.kron(np.eye(k_target), FF) + np.diag(penalty.ravel())
    for weight, P, Q in operators:
        right = np.einsum("pij,pkj->ik", P, P)  # sum of P P^T
        left = np.einsum("pji,pjk->ik", Q, Q)  # sum of Q^T Q
        mixed = np.tensordot(Q, P, (0, 0)).transpose(0, 2, 1, 3).reshape(H.shape)
        H += weight * (
            np.kron(np.eye(k_target), right) + np.kron(left, np.eye(k_source)) - mixed - mixed.T
        )
    free = np.flatnonzero(np.arange(C.size) % k_source)  # all but the first column
    b = (GF.ravel() - constant * H[:, 0])[free]
    C.ravel()[free] = scipy.linalg.solve(H[np.ix_(free, free)], b, assume_a="pos")
    return C


def _commutator(source, target):
    """Weights (mu_i - lambda_j)^2 / lambda_max^2 ``(k_target, k_source)`` of squared entries of C.

    The weighted sum measures how far C is from commuting with the Laplacians.
    """
    return ((target[:, None] - source) / max(source[-1], target[-1])) ** 2


def _constant_to_constant(source, target):
    """C[0, 0] of a map from constants to constants: the product of their signs."""
    return np.sign(source.Phi[0, 0] * target.Phi[0, 0])


def fmap_from_landmarks(
    source: Basis, target: Basis, landmark_source: Array, landmark_target: Array
) -> Array:
    """Fit a functional map to heat kernels around landmark pairs (step 4 of 4.1).

    :func:`fit` with the :func:`landmark_descriptors` and the penalty 0.001 |F|^2 (mu_i -
    lambda_j)^2 / lambda_max^2.

    Parameters
    ----------
    source, target : Basis
        With k functions.
    landmark_source, landmark_target : int ndarray (p,)
        Corresponding vertices.

    Returns
    -------
    C : float ndarray (k, k)
    """
    F, G = landmark_descriptors(source, target, landmark_source, landmark_target)
    return fit_to_landmarks(source, target, F, G)


def fit_to_landmarks(source: Basis, target: Basis, F: Array, G: Array) -> Array:
    """Fit a functional map ``(k, k)`` to the :func:`landmark_descriptors` F and G."""
    penalty = LAPLACIAN * np.trace(F @ F.T) * _commutator(source.eigenvalue, target.eigenvalue)
    return fit(F, G, penalty=penalty, constant=_constant_to_constant(source, target))


def fmap_from_wave_kernels(
    source: Basis, target: Basis, landmark_source: Array, landmark_target: Array, *, k: int = 20
) -> Array:
    """Fit a functional map ``(k, k)`` to wave kernels as pyFM 1.3.1 does.

    Descriptors are the wave kernel signature of each shape and those around the landmarks, of norm
    1.  The energy has the terms of descriptors, of the Laplacians (by their resolvents, Ren et al.
    2019), and of the multiplication operators.  Each term is divided by its mean for orthogonal
    maps, see ``pyFM.optimize.weights.canonical_taus``.

    Parameters
    ----------
    source, target : Basis
        With all eigenfunctions.
    landmark_source, landmark_target : int ndarray (p,)
        Corresponding vertices.
    """
    F, operators, spectra = [], [], []
    n = min(source.k, target.k)
    for shape, landmark in ((source, landmark_source), (target, landmark_target)):
        kernel = wave_filter(shape.eigenvalue[:n])[::EVERY]
        Phi = shape.Phi[:, :n]
        f = np.column_stack([signature(Phi, kernel), signature(Phi, kernel, landmark)])
        f /= np.sqrt(shape.area @ f**2)
        F.append(Phi[:, :k].T @ (shape.area[:, None] * f))  # (k, d)
        operators.append(multiplication(Phi[:, :k], shape.area, f))  # (d, k, k)
        spectra.append(shape.eigenvalue[:k])
    root = np.sqrt(np.abs(spectra) / np.max(spectra))
    resolvent = (root - 1j) / (root**2 + 1)  # of both, (2, k)
    mask = np.abs(resolvent[0] - resolvent[1][:, None]) ** 2  # (k_target, k_source)
    gram = [values[1:].T @ values[1:] for values in F]
    n_independent = np.mean([np.trace(G) ** 2 / (G**2).sum() for G in gram])
    traces = [np.trace(P, axis1=1, axis2=2) for P in operators]
    squares = sum((P**2).sum() for P in operators)
    scales = (
        (F[0][1:] ** 2).sum() / n_independent,  # without the constant
        mask.mean() * k,
        (squares - 2 * (traces[0] @ traces[1]) / k) / n_independent,
    )
    w_descriptor, w_laplacian, w_operator = np.divide((1.0, 1e-2, 1e-1), scales)
    root_w = np.sqrt(w_descriptor)
    constant = _constant_to_constant(source, target)
    operator = [(w_operator, *operators)]
    penalty = w_laplacian * mask
    return fit(root_w * F[0], root_w * F[1], penalty=penalty, operators=operator, constant=constant)


def landmark_descriptors(
    source: Basis, target: Basis, landmark_source: Array, landmark_target: Array
) -> tuple[Array, Array]:
    """Return the coefficients of heat kernels around p landmarks at 8 times, each of norm 1.

    Parameters
    ----------
    source, target, landmark_source, landmark_target : see :func:`fmap_from_landmarks`

    Returns
    -------
    F, G : float ndarray (k, 8 p)
        Of source and target.
    """
    coefficients, landmarks = [], (landmark_source, landmark_target)
    for end, other, landmark in zip((source, target), (target, source), landmarks, strict=True):
        kernel = heat_filter(end.eigenvalue, other.eigenvalue, n=8)  # (8, k)
        F = landmark_coefficients(end.Phi, kernel, landmark)  # (k, 8 p)
        coefficients.append(F / np.linalg.norm(F, axis=0))
    return coefficients[0], coefficients[1]


def landmark_energies(source: Basis, target: Basis, C: Array, F: Array, G: Array) -> Array:
    """Return both terms ``(2,)`` of the energy of :func:`fmap_from_landmarks` for a map C."""
    penalty = LAPLACIAN * (F**2).sum() * _commutator(source.eigenvalue, target.eigenvalue)
    return np.array([((C @ F - G) ** 2).sum(), (penalty * C**2).sum()])


def fmap_from_descriptors(
    source: Basis,
    target: Basis,
    *,
    k: int = 20,
    landmarks: Sequence[Array] | tuple[None, None] = (None, None),
    kind: str = "wks",
    oriented: float = 1.0,
    curvature: float = 0.0,
) -> Array:
    """Fit a functional map ``(k, k)`` to descriptors, with or without landmarks (step 4 of 4.1).

    :func:`fit` of E(C) = |C F - G|^2 / |F|^2 + 1e-3 sum (mu_i - lambda_j)^2 C_ij^2 /
    lambda_max^2 + sum |C P - Q C|^2 / sum |P|^2.  F and G are the coefficients of the descriptors,
    P and Q their multiplication operators; the same term with the weight `oriented` has their
    orientation operators.  Descriptors use all eigenfunctions, are centred, and have norm 1.

    Parameters
    ----------
    source, target : Basis
        With all eigenfunctions; triangles are needed for `oriented`.  Common fields of both are
        descriptors, too.
    k : int
        Size of the map.
    landmarks : tuple of int ndarray (p,)
        Corresponding vertices; descriptors around each are added.
    kind : {"wks", "hks", "hks+wks"}
        Wave or heat kernel signatures, or both.
    oriented : float
        Weight of the orientation term; 0 omits it.
    curvature : float
        Weight of signed mean curvatures at four scales relative to a signature.
    """
    F, products, orientations = [], [], []  # of source and target
    for shape, other, landmark in zip((source, target), (target, source), landmarks, strict=True):
        filters = [_FILTERS[name](shape.eigenvalue, other.eigenvalue) for name in kind.split("+")]
        kernel = np.concatenate([values[::EVERY] for values in filters])
        descriptors = [signature(shape.Phi, kernel)]  # (n, d)
        if landmark is not None:
            descriptors.append(signature(shape.Phi, kernel, landmark))
        descriptors += [shape.fields[name] for name in common_fields(source, target)]
        f = np.column_stack([*descriptors, *(curvatures(shape) if curvature else [])])
        f = f - shape.area @ f
        f /= np.sqrt(shape.area @ f**2)
        if curvature:
            f[:, -len(SCALES) :] *= np.sqrt(curvature)
        Phi = shape.Phi[:, :k]
        F.append(Phi.T @ (shape.area[:, None] * f))  # (k, d)
        products.append(multiplication(Phi, shape.area, f))
        if oriented:
            orientations.append(orientation(shape.T, Phi, f))
    operators = [
        (weight / (pair[0] ** 2).sum(), *pair)
        for weight, pair in ((1.0, products), (oriented, orientations))
        if weight
    ]
    norm = np.linalg.norm(F[0])
    penalty = LAPLACIAN * _commutator(source.eigenvalue[:k], target.eigenvalue[:k])
    constant = _constant_to_constant(source, target)
    return fit(F[0] / norm, F[1] / norm, penalty=penalty, operators=operators, constant=constant)


def curvature_difference(source: Basis, target: Basis, match: Array) -> float:
    """Mean difference of signed mean curvature between matched vertices, relative to its deviation.

    0 for equal curvatures, about 1 for unrelated ones.  It distinguishes the front and back of a
    body, whose intrinsic geometry is nearly the same.

    Parameters
    ----------
    source, target : Basis
    match : int ndarray (n_target,)
    """
    H = curvatures(source)[0][match]
    G = curvatures(target)[0]
    deviation = target.area @ np.abs(G - target.area @ G)
    return float(target.area @ np.abs(H - G) / deviation)


def curvatures(basis: Basis) -> list[Array]:
    """Return signed mean curvatures ``(n,)`` for the numbers of functions :data:`SCALES`."""
    surface = basis.X, basis.normals, basis.area
    return [mean_curvature(*surface, basis.Phi[:, :k], basis.eigenvalue[:k]) for k in SCALES]


def orthogonality_error(C: Array) -> float:
    """Return |C^T C - I|_F / sqrt(k), which is 0 for area-preserving maps."""
    return float(np.linalg.norm(C.T @ C - np.eye(C.shape[1])) / np.sqrt(C.shape[1]))


def off_diagonal_mass(C: Array) -> float:
    """Return the share of the squared entries of C off the diagonal; 0 for isometric shapes.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import off_diagonal_mass
    >>> off_diagonal_mass(np.eye(3)), off_diagonal_mass(np.eye(2)[::-1])
    (0.0, 1.0)
    """
    return float(1 - (np.diag(C) ** 2).sum() / (C**2).sum())


def swapped_blocks(C: Array) -> list[tuple[int, int]]:
    """Find runs of eigenfunctions that a map exchanges (Fig. 2), as on symmetric shapes.

    A run of at most six counts if its diagonal block has at least three quarters of the squared
    entries of its rows and columns, and less than half of that is on the diagonal.  Shorter runs
    have precedence.

    Parameters
    ----------
    C : float ndarray (k, k)

    Returns
    -------
    list of (int, int)
        First and last eigenfunction of each run, ascending, without overlaps.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.fmap import swapped_blocks
    >>> swapped_blocks(np.eye(5)[[0, 2, 1, 3, 4]])
    [(1, 2)]
    """
    S = np.asarray(C, float) ** 2
    runs = []
    used = set()
    for length in range(2, 7):
        for start in range(min(S.shape) - length + 1):
            run = slice(start, start + length)
            block = S[run, run]
            total = (S[run].sum() + S[:, run].sum()) / 2
            closed = total > 0 and block.sum() >= 0.75 * total
            exchanged = np.trace(block) < 0.5 * block.sum()
            indices = range(start, start + length)
            if closed and exchanged and used.isdisjoint(indices):
                runs.append((start, start + length - 1))
                used.update(indices)
    return sorted(runs)
