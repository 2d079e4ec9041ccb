"""Functional maps (3.3, 4.1): fit, map <-> match (eq. 2 and 4), ZoomOut.

The source is the paper's M with basis Phi, the target its N with basis Psi.  C carries functions
source -> target; a match holds, for every vertex of the target, a vertex of the source.
"""

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from s4a.geometry.mesh import as_arrays
from s4a.method.descriptors import (
    heat_filter,
    landmark_coefficients,
    landmark_signature,
    multiplication,
    orientation,
    signature,
    wave_filter,
)
from s4a.schema import dataset, require


def fmap_from_match(Phi_source, Phi_target, area_target, match):
    """C = Psi^T A_N Phi[match]: the map of functions that a match gives (eq. 1 in both bases).

    Parameters
    ----------
    Phi_source : float ndarray (n_source, k)
    Phi_target : float ndarray (n_target, k)
    area_target : float ndarray (n_target,), of sum 1, or a sparse mass matrix in which Phi_target is orthonormal
    match : int ndarray (n_target,)

    Returns
    -------
    C : float ndarray (k_target, k_source)
    """
    if sp.issparse(area_target):
        return (area_target @ Phi_target).T @ Phi_source[match]
    return Phi_target.T @ (area_target[:, None] * Phi_source[match])


def nearest_rows(Q, D, *, block=256):
    """For every row of Q the index of the nearest row of D (Euclidean).

    By blocks of one matrix product each.

    The product is of (q, -1) and (d, |d|^2 / 2), largest where the distance is least; its blocks
    stay in the cache. float32 first, which above about 20 dims is faster than a KD-tree; where it
    cannot tell two rows apart, float64 decides.  Of rows that are equally near the first is given.

    Examples
    --------
    >>> nearest_rows(np.array([[0.1], [4.0]]), np.array([[0.0], [5.0]])).tolist()
    [0, 1]
    """
    q, d = queries(Q), searched(D)
    longest = np.sqrt(2 * d[-1].max())
    rounding = (
        16 * np.finfo(np.float32).eps * longest * (np.linalg.norm(q[:, :-1], axis=1) + longest)
    )
    found = np.empty(len(q), np.int64)
    for start, score in products(q, d, block):
        best = score.argmax(axis=1)
        line = np.arange(len(best))
        least = score[line, best] - rounding[start : start + block]
        score[line, best] = -np.inf
        for i in np.flatnonzero(score.max(axis=1) >= least):
            score[i, best[i]] = np.inf
            close = np.flatnonzero(score[i] >= least[i])
            gap = D[close].astype(float) - Q[start + i]
            best[i] = close[np.einsum("ij,ij->i", gap, gap).argmin()]
        found[start : start + block] = best
    return found


def queries(Q):
    """(q, -1) for the rows of Q ``(n, d + 1)`` float32."""
    return np.column_stack([Q, np.full(len(Q), -1)]).astype(np.float32)


def searched(D):
    """(d, |d|^2 / 2) for the rows of D, as columns ``(d + 1, p)`` float32."""
    d = np.asarray(D, np.float32)
    return np.ascontiguousarray(np.column_stack([d, np.einsum("ij,ij->i", d, d) / 2]).T)


def products(q, d, block=256):
    """The products of :func:`queries` and :func:`searched`, block by block in one array.

    (first row, block).
    """
    scores = np.empty((min(block, len(q)), d.shape[1]), np.float32)
    for start in range(0, len(q), block):
        part = q[start : start + block]
        yield start, np.matmul(part, d, out=scores[: len(part)])


def nearly_nearest(q, d):
    """:func:`nearest_rows` up to float32 rounding.

    From :func:`queries` and :func:`searched` made once for many.
    """
    return np.concatenate([score.argmax(axis=1) for _, score in products(q, d)])


def match_from_fmap(C, Phi_source, Phi_target, *, nearest=nearest_rows):
    """Nearest neighbours of the rows of Psi among those of Phi C^T (eq. 2)."""
    k_target, k_source = C.shape
    return nearest(Phi_target[:, :k_target], Phi_source[:, :k_source] @ C.T)


def zoomout(C, Phi_source, Phi_target, area_target, k, *, step=5, nearest=nearest_rows):
    """ZoomOut (Melzi et al. 2019): C -> match -> a larger C, until it is k x k.

    Parameters
    ----------
    C : float ndarray (k_init, k_init)
    Phi_source, Phi_target : float ndarray (n, >= k)
    area_target : see :func:`fmap_from_match`
    k : int
        Final size.
    step : int
        Growth per round.
    nearest : callable
        As :func:`nearest_rows`, which is it by default.

    Returns
    -------
    C : float ndarray (k, k)
    match : int ndarray (n_target,)
        The match of the final C.
    """
    sizes = [*range(C.shape[0] + step, k, step), k] if k > C.shape[0] else []
    for size in sizes:
        match = match_from_fmap(C, Phi_source, Phi_target, nearest=nearest)
        C = fmap_from_match(Phi_source[:, :size], Phi_target[:, :size], area_target, match)
    return C, match_from_fmap(C, Phi_source, Phi_target, nearest=nearest)


def once_refined(C, Phi_source, Phi_target, area_target):
    """One step of ZoomOut without growth: C -> match -> C of the same size."""
    Phi, Psi = Phi_source[:, : C.shape[1]], Phi_target[:, : len(C)]
    return fmap_from_match(Phi, Psi, area_target, nearly_nearest(queries(Psi), searched(Phi @ C.T)))


def fit(F, G, *, penalty=0.0, operators=(), constant=1.0):
    """The C of least energy that carries constants to constants (step 4 of 4.1.

    Ovsjanikov et al. 2012).

    E(C) = |C F - G|^2 + sum penalty C^2 + sum w |C P - Q C|^2, whose normal equations are solved
    directly: row by row where there are no operators, else all k_target (k_source - 1) unknowns at
    once, a dense system of 50 MB for 50 x 50 and 800 MB for 100 x 100.

    Parameters
    ----------
    F, G : float ndarray (k_source, d), (k_target, d)
        Coefficients of corresponding functions.
    penalty : float ndarray (k_target, k_source)
        On the squared entries: that the Laplacians commute is w (mu_i - lambda_j)^2.
    operators : list of tuple (w, P, Q)
        Weight, and stacks of corresponding operators (p, k_source, k_source) and (p, k_target,
        k_target).
    constant : float
        C[0, 0]: 1 where both first eigenfunctions are positive.

    Returns
    -------
    C : float ndarray (k_target, k_source)
        Its first column is known: `constant`, then zeros.

    Examples
    --------
    >>> F = np.random.default_rng(0).normal(size=(3, 5))
    >>> np.allclose(fit(F, F), np.eye(3))
    True
    """
    k_target, k_source = len(G), len(F)
    C = np.zeros((k_target, k_source))
    C[0, 0] = constant
    FF, GF = F @ F.T, G @ F.T
    penalty = np.broadcast_to(penalty, C.shape)
    if not operators:
        for row, p, g in zip(C, penalty, GF, strict=True):
            row[1:] = np.linalg.solve(FF[1:, 1:] + np.diag(p[1:]), g[1:] - row[0] * FF[0, 1:])
        return C
    H = np.kron(np.eye(k_target), FF) + np.diag(penalty.ravel())
    for w, P, Q in operators:
        right, left = np.einsum("pij,pkj->ik", P, P), np.einsum("pji,pjk->ik", Q, Q)
        mixed = np.tensordot(Q, P, (0, 0)).transpose(0, 2, 1, 3).reshape(H.shape)
        H += w * (
            np.kron(np.eye(k_target), right) + np.kron(left, np.eye(k_source)) - mixed - mixed.T
        )
    free = np.flatnonzero(np.arange(C.size) % k_source)
    b = (GF.ravel() - constant * H[:, 0])[free]
    C.ravel()[free] = scipy.linalg.solve(H[np.ix_(free, free)], b, assume_a="pos")
    return C


def fit_landmarks(
    Phi_source, Phi_target, ev_source, ev_target, landmark_source, landmark_target, *, commute=1e-3
):
    """Fit of C on landmark pairs (step 4 of 4.1).

    Heat kernels around them preserved, Laplacians commute.

    :func:`fit` with F and G at 8 times and the penalty commute |F|^2 (mu_i - lambda_j)^2 /
    lambda_max^2.

    Parameters
    ----------
    Phi_source, Phi_target : float ndarray (n, k)
    ev_source, ev_target : float ndarray (k,)
    landmark_source, landmark_target : int ndarray (p,)
        Corresponding vertices.

    Returns
    -------
    C : float ndarray (k, k)
    """
    F, G = (
        landmark_coefficients(Phi, heat_filter(ev, other, n=8), landmark)
        for Phi, ev, other, landmark in (
            (Phi_source, ev_source, ev_target, landmark_source),
            (Phi_target, ev_target, ev_source, landmark_target),
        )
    )
    F, G = F / np.linalg.norm(F, axis=0), G / np.linalg.norm(G, axis=0)
    top = max(ev_source[-1], ev_target[-1])
    penalty = commute * np.trace(F @ F.T) * ((ev_target[:, None] - ev_source) / top) ** 2
    return fit(F, G, penalty=penalty, constant=np.sign(Phi_source[0, 0] * Phi_target[0, 0]))


FILTERS = {"wks": wave_filter, "hks": heat_filter}


def fmap_of_descriptors(
    source,
    target,
    *,
    k=20,
    marks=(None, None),
    kind="wks",
    n=100,
    every=5,
    laplacian=1e-3,
    commute=1.0,
    oriented=1.0,
):
    """:func:`fit_descriptors` for plain arrays.

    Parameters
    ----------
    source, target : tuple (eigenvalue, Phi, area, T)
        Eigenvalues (k,), eigenfunctions (n, k), vertex areas of sum 1, triangles.
    marks : tuple of int ndarray (p,)
        Corresponding vertices.

    Returns
    -------
    C : float ndarray (k, k)
    """
    ends = source, target
    F, products, turns = [], [], []
    for (ev, Phi, area, T), (other, *_), mark in zip(ends, ends[::-1], marks, strict=True):
        kernel = FILTERS[kind](ev, other, n=n)[::every]
        f = signature(Phi, kernel)
        if mark is not None:
            f = np.column_stack([f, landmark_signature(Phi, kernel, mark)])
        f = f - area @ f
        f /= np.sqrt(area @ f**2)
        B = Phi[:, :k]
        F.append(B.T @ (area[:, None] * f))
        products.append(multiplication(B, area, f) if commute else None)
        turns.append(orientation(T, B, f) if oriented else None)
    operators = [
        (w / (P**2).sum(), P, Q) for w, (P, Q) in ((commute, products), (oriented, turns)) if w
    ]
    ev, ev_target = (e[0][:k] for e in ends)
    size = np.linalg.norm(F[0])
    penalty = laplacian * ((ev_target[:, None] - ev) / max(ev[-1], ev_target[-1])) ** 2
    constant = np.sign(ends[0][1][0, 0] * ends[1][1][0, 0])
    return fit(F[0] / size, F[1] / size, penalty=penalty, operators=operators, constant=constant)


def fit_descriptors(
    source,
    target,
    *,
    k=20,
    landmarks=None,
    kind="wks",
    n=100,
    every=5,
    laplacian=1e-3,
    commute=1.0,
    oriented=1.0,
):
    """Fit of a functional map on descriptors, with or without landmarks (step 4 of 4.1).

    :func:`fit` of E(C) = |C F - G|^2 / |F|^2 + laplacian sum (mu_i - lambda_j)^2 C_ij^2 /
    lambda_max^2 + commute sum |C P - Q C|^2 / sum |P|^2, where F and G are the coefficients of the
    descriptors, P and Q the products with them, and the same once more with `oriented` for the
    operators that a mirror image turns over.  Descriptors are taken with all eigenfunctions that
    the meshes have, less their mean, scaled to norm 1.

    Mean geodesic error after ZoomOut to 100, in % of sqrt(area), at 5,700 vertices (three pairs of
    poses of a child, two of a cat, two faces):

    ======================================  ==================  ============  ============
    first map, 20 x 20                      child               cat           face
    ======================================  ==================  ============  ============
    nearest neighbours after ICP            0.96, 10.1, 64.9    4.73, 1.33    0.12, 0.15
    10 landmarks found by ICP               2.28, 21.2, 64.1    6.08, 4.67    0.12, 0.15
    10 true landmarks                       0.89, 1.41, 4.46    2.20, 1.14    0.12, 0.15
    wave kernels                            0.84, 10.5, 4.52    2.38, 1.11    0.12, 0.15
    wave kernels, ``oriented=0``            0.84, 35.8, 4.48    18.3, 3.14    0.12, 22.2
    heat kernels                            0.83, 1.49, 4.51    2.48, 1.14    0.12, 0.15
    wave kernels and 10 true landmarks      0.85, 1.49, 4.50    2.22, 1.12    0.12, 0.15
    ======================================  ==================  ============  ============

    Parameters
    ----------
    source, target : Dataset
        Meshes with their spectrum, as of :func:`s4a.spectrum`; at either resolution.
    k : int
        Size of the map.
    landmarks : tuple of int array_like (p,), optional
        Corresponding vertices of source and target; descriptors around each are added to those of
        the shapes.
    kind : {"wks", "hks"}
    n, every : int
        Of n energies or times every `every`-th is used: neighbours are nearly equal.
    laplacian, commute, oriented : float
        Weights against that of preserving the descriptors; 0 leaves a term out.

    Returns
    -------
    Dataset
        ``fmap(mode_target, mode_source)``, k x k.

    Raises
    ------
    ValueError
        When a mesh lacks its spectrum or has fewer than k eigenfunctions, or the options are not as
        above.
    """
    if kind not in FILTERS:
        raise ValueError(f"kind must be 'wks' or 'hks', found {kind!r}")
    ends = []
    for mesh, what in ((source, "source"), (target, "target")):
        require(
            mesh,
            "position",
            "corner_vertex",
            "vertex_area",
            "eigenvalue",
            "eigenfunction",
            what=what,
        )
        if mesh.sizes["mode"] < k:
            raise ValueError(
                f"the {what} needs {k} eigenfunctions, found {mesh.sizes['mode']}: give a smaller k"
            )
        area = mesh["vertex_area"].values
        ends.append(
            (
                mesh["eigenvalue"].values,
                mesh["eigenfunction"].values,
                area / area.sum(),
                as_arrays(mesh)[1],
            )
        )
    marks = (None, None) if landmarks is None else [np.asarray(v) for v in landmarks]
    if landmarks is not None and (
        len(marks) != 2 or marks[0].shape != marks[1].shape or marks[0].ndim != 1
    ):
        raise ValueError(
            f"landmarks need as many vertices of the source as of the target, found {landmarks!r}"
        )
    C = fmap_of_descriptors(
        *ends,
        k=k,
        marks=marks,
        kind=kind,
        n=n,
        every=every,
        laplacian=laplacian,
        commute=commute,
        oriented=oriented,
    )
    return dataset(fmap=C)


def orthogonality_error(C):
    """|C^T C - I|_F / sqrt(k): 0 for a map that preserves areas."""
    return float(np.linalg.norm(C.T @ C - np.eye(C.shape[1])) / np.sqrt(C.shape[1]))


def off_diagonal_mass(C):
    """Share of the squared entries of C that is not on its diagonal.

    0 for a map between equal spectra.

    Examples
    --------
    >>> off_diagonal_mass(np.eye(3)), off_diagonal_mass(np.eye(2)[::-1])
    (0.0, 1.0)
    """
    return float(1 - (np.diag(C) ** 2).sum() / (C**2).sum())


def swapped_blocks(C, *, longest=6, inside=0.75, diagonal=0.5):
    """Runs of modes that the map exchanges among each other.

    As near-equal eigenvalues of symmetric shapes do (Fig. 2).

    A run counts when at least the share `inside` of the squared entries of its rows and columns
    lies in its diagonal block, and less than the share `diagonal` of that on the diagonal itself;
    the shortest runs come first.

    Parameters
    ----------
    C : float ndarray (k, k)
    longest : int
        Modes in the longest run that is looked for.

    Returns
    -------
    list of (int, int)
        First and last mode of each run, ascending; runs do not overlap.

    Examples
    --------
    >>> swapped_blocks(np.eye(5)[[0, 2, 1, 3, 4]])
    [(1, 2)]
    """
    S, taken, found = np.asarray(C, float) ** 2, set(), []
    for length in range(2, longest + 1):
        for a in range(min(S.shape) - length + 1):
            run = slice(a, a + length)
            block, around = S[run, run], (S[run].sum() + S[:, run].sum()) / 2
            closed = around > 0 and block.sum() >= inside * around
            if (
                closed
                and np.trace(block) < diagonal * block.sum()
                and taken.isdisjoint(range(a, a + length))
            ):
                found.append((a, a + length - 1))
                taken.update(range(a, a + length))
    return sorted(found)
