"""Functional maps (3.3, 4.1): fit, map <-> match (eq. 2 and 4), ZoomOut.

The source is the paper's M with basis Phi, the target its N with basis Psi.  C carries functions source -> target;
a match holds, for every vertex of the target, a vertex of the source.
"""

import numpy as np


def fmap_from_match(Phi_source, Phi_target, area_target, match):
    """C = Psi^T A_N Phi[match]: the map of functions that a match gives (eq. 1 in both bases).

    Parameters
    ----------
    Phi_source : float ndarray (n_source, k)
    Phi_target : float ndarray (n_target, k)
    area_target : float ndarray (n_target,), of sum 1
    match : int ndarray (n_target,)

    Returns
    -------
    C : float ndarray (k_target, k_source)
    """
    return Phi_target.T @ (area_target[:, None] * Phi_source[match])


def nearest_rows(Q, D, *, block=2048):
    """For every row of Q the index of the nearest row of D (Euclidean), by blocks of one matrix product each.

    float32 throughout: above about 20 dims this is faster than a KD-tree; ties and differences below float32's
    precision go to the lowest index among the equal ones.

    Examples
    --------
    >>> nearest_rows(np.array([[0.1], [4.0]]), np.array([[0.0], [5.0]])).tolist()
    [0, 1]
    """
    Q, D = np.ascontiguousarray(Q, np.float32), np.ascontiguousarray(D, np.float32)
    half = 0.5 * np.einsum("ij,ij->i", D, D)
    found = np.empty(len(Q), np.int64)
    for start in range(0, len(Q), block):
        score = Q[start : start + block] @ D.T
        score -= half
        found[start : start + block] = score.argmax(axis=1)
    return found


def match_from_fmap(C, Phi_source, Phi_target):
    """Nearest neighbours of the rows of Psi among those of Phi C^T (eq. 2)."""
    k_target, k_source = C.shape
    return nearest_rows(Phi_target[:, :k_target], Phi_source[:, :k_source] @ C.T)


def zoomout(C, Phi_source, Phi_target, area_target, k, *, step=5):
    """ZoomOut (Melzi et al. 2019): C -> match -> a larger C, until it is k x k.

    Parameters
    ----------
    C : float ndarray (k_init, k_init)
    Phi_source, Phi_target : float ndarray (n, >= k)
    area_target : float ndarray (n_target,), of sum 1
    k : int
        Final size.
    step : int
        Growth per round.

    Returns
    -------
    C : float ndarray (k, k)
    match : int ndarray (n_target,)
        The match of the final C.
    """
    sizes = [*range(C.shape[0] + step, k, step), k] if k > C.shape[0] else []
    for size in sizes:
        match = match_from_fmap(C, Phi_source, Phi_target)
        C = fmap_from_match(Phi_source[:, :size], Phi_target[:, :size], area_target, match)
    return C, match_from_fmap(C, Phi_source, Phi_target)


def heat_features(Phi, eigenvalue, vertices, times):
    """Heat kernels sum exp(-t lambda) phi(x) phi(v) around landmark vertices v, as coefficients ``(k, v * t)``."""
    decay = np.exp(-np.asarray(times)[:, None] * eigenvalue[None, :])
    columns = np.einsum("tk,vk->kvt", decay, Phi[vertices]).reshape(Phi.shape[1], -1)
    return columns / np.linalg.norm(columns, axis=0)


def fit_landmarks(Phi_source, Phi_target, ev_source, ev_target, landmark_source, landmark_target, *, commute=1e-3):
    """Fit of C on landmark pairs (step 4 of 4.1): descriptors preserved, Laplacians commute.

    min |C F - G|^2 + commute |F|^2 |C Lambda_source - Lambda_target C|^2 / lambda_max^2 over the C that carry
    constants to constants, where F and G are heat kernels around the landmarks at several times.  The second term is
    diagonal in C, so each row of C has normal equations of its own, solved directly (Ovsjanikov et al. 2012).

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
    top = max(ev_source[-1], ev_target[-1])
    times = np.geomspace(4 * np.log(10) / top, 4 * np.log(10) / max(ev_source[1], ev_target[1]), 8)
    F = heat_features(Phi_source, ev_source, landmark_source, times)
    G = heat_features(Phi_target, ev_target, landmark_target, times)
    constant = np.zeros(len(G))  # constants go to constants: this column of C is known
    constant[0] = np.sign(Phi_source[0, 0] * Phi_target[0, 0])
    FF, GF = F[1:] @ F[1:].T, (G - np.outer(constant, F[0])) @ F[1:].T
    penalty = commute * np.trace(F @ F.T) * ((ev_target[:, None] - ev_source[None, 1:]) / top) ** 2
    rest = [np.linalg.solve(FF + np.diag(p), g) for p, g in zip(penalty, GF, strict=True)]
    return np.column_stack([constant, np.stack(rest)])


def orthogonality_error(C):
    """|C^T C - I|_F / sqrt(k): 0 for a map that preserves areas."""
    return float(np.linalg.norm(C.T @ C - np.eye(C.shape[1])) / np.sqrt(C.shape[1]))


def off_diagonal_mass(C):
    """Share of the squared entries of C that is not on its diagonal: 0 for a map between equal spectra.

    Examples
    --------
    >>> off_diagonal_mass(np.eye(3)), off_diagonal_mass(np.eye(2)[::-1])
    (0.0, 1.0)
    """
    return float(1 - (np.diag(C) ** 2).sum() / (C**2).sum())


def swapped_blocks(C, *, longest=6, inside=0.75, diagonal=0.5):
    """Runs of modes that the map exchanges among each other, as near-equal eigenvalues of symmetric shapes do (Fig. 2).

    A run counts when at least the share `inside` of the squared entries of its rows and columns lies in its
    diagonal block, and less than the share `diagonal` of that on the diagonal itself; the shortest runs come first.

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
            if closed and np.trace(block) < diagonal * block.sum() and taken.isdisjoint(range(a, a + length)):
                found.append((a, a + length - 1))
                taken.update(range(a, a + length))
    return sorted(found)
