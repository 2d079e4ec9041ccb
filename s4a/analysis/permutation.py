"""Permutation tests on plain arrays (6.1): of a whole shape by its scores, and of every vertex.

The general linear model is Y = Z G + X B + E: Z the intercept and the covariates, X what is tested
(a variable, or the indicators of groups).  After Freedman & Lane (1983) the residuals of Y on Z are
permuted; only the part of X that is orthogonal to Z counts.
"""

import math

import numpy as np
from sklearn.covariance import ledoit_wolf


def design(x: np.ndarray, covariates: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal bases of Z, ``(n, r)``, and of the part of X orthogonal to it, ``(n, q)``.

    Parameters
    ----------
    x : float ndarray (n,) or (n, q)
    covariates : float ndarray (n, c), optional

    Raises
    ------
    ValueError
        When X is a combination of the covariates, or too few shapes are left to estimate anything.
    """
    n = len(x)
    x = np.asarray(x, float).reshape(n, -1)
    Z = np.ones((n, 1)) if covariates is None else np.column_stack([np.ones(n), covariates])
    U, S, _ = np.linalg.svd(Z, full_matrices=False)
    Z = U[:, S > 1e-10 * S[0]]  # (n, r)
    U, S, _ = np.linalg.svd(x - Z @ (Z.T @ x), full_matrices=False)
    Q = U[:, S > 1e-8 * max(float(np.linalg.norm(x - x.mean(0))), 1e-300)]  # (n, q)
    if Q.shape[1] < max(1, np.linalg.matrix_rank(x - x.mean(0))):
        raise ValueError(
            "what is tested is constant or a combination of the covariates; leave one of them out"
        )
    if n - Z.shape[1] - Q.shape[1] < 2:
        raise ValueError(
            f"{n} shapes are too few for {Z.shape[1]} + {Q.shape[1]} columns of the model"
        )
    return Z, Q


def indicators(group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Names of the groups, sorted, and indicator columns of all but the first ``(n, g - 1)``."""
    names, code = np.unique(group, return_inverse=True)
    return names, (code[:, None] == np.arange(1, len(names))).astype(float)


def hotelling(E: np.ndarray, Q: np.ndarray, dof: int) -> float:
    """Hotelling's T^2 (Lawley and Hotelling's trace for several columns of X).

    The covariance is shrunk after Ledoit & Wolf (2004).

    Parameters
    ----------
    E : float ndarray (n, p)
        Residuals of the scores on the covariates.
    Q : float ndarray (n, q)
        As of :func:`design`.
    dof : int
        Degrees of freedom of the error, n - r - q.

    Returns
    -------
    float
    """
    H = Q.T @ E  # (q, p)
    S = ledoit_wolf(E - Q @ H, assume_centered=True)[0] * len(E) / dof  # (p, p)
    return float(np.einsum("qp,pq->", H, np.linalg.solve(S, H.T)))


def smallest_p(n_permutations: int, group: np.ndarray | None = None, n: int | None = None) -> float:
    """The smallest p that a permutation test of groups, or of a variable of n shapes, can reach.

    Bound by the number of permutations drawn, and by how many are different: two that only exchange
    shapes within groups, or groups of equal size, give the same statistic.

    Examples
    --------
    >>> from s4a.analysis.permutation import smallest_p
    >>> smallest_p(999), smallest_p(9999, group=list("aaabbb"))
    (0.001, 0.1)
    """
    drawn = 1 / (n_permutations + 1)
    if group is None:
        return drawn if n is None else max(drawn, 1 / math.factorial(min(n, 20)))
    sizes = np.unique(group, return_counts=True)[1].tolist()
    same = math.prod(math.factorial(sizes.count(s)) for s in set(sizes))
    different = math.factorial(sum(sizes)) // math.prod(map(math.factorial, sizes))
    return max(drawn, same / different)


def permutation_test(
    scores: np.ndarray,
    x: np.ndarray,
    *,
    covariates: np.ndarray | None = None,
    n_permutations: int = 9999,
    seed: int = 0,
) -> tuple[float, float]:
    """Permutation test of Hotelling's T^2 of scores on a variable or on groups.

    Parameters
    ----------
    scores : float ndarray (n, p)
    x : float ndarray (n,) or (n, q)
        A variable, or :func:`indicators`.
    covariates : float ndarray (n, c), optional
    n_permutations : int
    seed : int

    Returns
    -------
    statistic : float
    p : float
        (1 + number of permutations that reach the statistic) / (1 + n_permutations).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.permutation import permutation_test
    >>> scores = np.random.default_rng(0).normal(size=(20, 3))
    >>> x = np.repeat([0.0, 1.0], 10)
    >>> permutation_test(scores + 3 * x[:, None], x, n_permutations=99, seed=1)[1]
    0.01
    """
    Z, Q = design(x, covariates)
    E = scores - Z @ (Z.T @ scores)
    dof = len(E) - Z.shape[1] - Q.shape[1]
    rng = np.random.default_rng(seed)
    statistic = hotelling(E, Q, dof)
    reached = 0
    for _ in range(n_permutations):
        permuted = E[rng.permutation(len(E))]
        reached += hotelling(permuted - Z @ (Z.T @ permuted), Q, dof) >= statistic * (1 - 1e-12)
    return statistic, (1 + reached) / (1 + n_permutations)


def whiten(E: np.ndarray) -> np.ndarray:
    """Residual vectors ``(n, v, d)`` in units of their scatter W at each vertex, W^-1/2 e, or 0."""
    value, V = np.linalg.eigh(np.einsum("nvd,nve->vde", E, E))  # (v, d), (v, d, d)
    largest = value[:, -1:]
    is_zero = value <= 1e-10 * np.where(largest > 0, largest, 1)
    root = np.sqrt(np.where(is_zero, 1, value))
    return np.einsum("nvd,vde,ve->nve", E, V, np.where(is_zero, 0, 1 / root), optimize=True)


def vertex_test(
    d: np.ndarray,
    x: np.ndarray,
    *,
    covariates: np.ndarray | None = None,
    n_permutations: int = 999,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Permutation test at every vertex, with p values corrected for all by the largest (max-T).

    The statistic is Pillai's trace, the share 0..1 of the vectors' scatter that X explains; for one
    column of X, T^2 = dof V / (1 - V).  The scatter is that of the residuals on Z, for every
    permutation its own: with covariates those of permuted residuals scatter less, and beside the
    first scatter their shares would be too small.

    Parameters
    ----------
    d : float ndarray (n, v, k)
        Fields of vectors, or with k = 1 of numbers.
    x, covariates, n_permutations, seed : see :func:`permutation_test`

    Returns
    -------
    share : float ndarray (v,)
    p : float ndarray (v,), of each vertex alone
    p_max : float ndarray (v,), family-wise (Westfall & Young 1993, single step)
    """
    Z, Q = design(x, covariates)
    n, v, k = d.shape
    r, q = Z.shape[1], Q.shape[1]
    E = np.asarray(d, float).reshape(n, -1)  # (n, v k)
    E = whiten((E - Z @ (Z.T @ E)).reshape(n, v, k))
    E = E.transpose(0, 2, 1).reshape(n, -1).astype(np.float32)  # (n, k v)

    def project(columns, per):
        """Products of b times `per` columns ``(n, b per)`` with the residuals: (b, per, k, v)."""
        return (columns.T.astype(np.float32) @ E).reshape(-1, per, k, v)

    rng = np.random.default_rng(seed)
    share = (project(Q, q)[0] ** 2).sum(axis=(0, 1))
    reached = np.zeros(v, np.int64)
    largest = np.empty(0, np.float32)
    block = max(1, int(2e7 // (v * k * (q + r))))  # permutations at once: 80 MB of products
    for first in range(0, n_permutations, block):
        orders = [rng.permutation(n) for _ in range(min(block, n_permutations - first))]
        back = [np.argsort(order) for order in orders]
        # Q^T (I - Z Z^T) P E = (P^T Q)^T E, as Q is orthogonal to Z
        B = project(np.concatenate([Q[order] for order in back], axis=1), q)
        if r == 1:  # Z is the intercept alone, which no permutation moves: the scatter stays 1
            permuted = (B**2).sum(axis=(1, 2))  # (b, v)
        else:
            A = project(np.concatenate([Z[order] for order in back], axis=1), r)
            permuted = explained_share(A, B)
        reached += (permuted >= share * (1 - 1e-6)).sum(0)
        largest = np.append(largest, permuted.max(1))
    beyond = n_permutations - np.searchsorted(np.sort(largest), share * (1 - 1e-6), side="left")
    return share, (1 + reached) / (1 + n_permutations), (1 + beyond) / (1 + n_permutations)


def explained_share(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Pillai's trace of whitened residuals once permuted: tr(B^T B (I - A^T A)^-1), ``(b, v)``.

    Parameters
    ----------
    A : float ndarray (b, r, k, v)
        Z^T P E: what the covariates take of permuted residuals, whose scatter was I.
    B : float ndarray (b, q, k, v)
        Q^T P E.
    """
    k = A.shape[2]
    scatter = {  # of what is left: I - A^T A, its upper triangle
        (i, j): (i == j) - np.einsum("brv,brv->bv", A[:, :, i], A[:, :, j], dtype=float)
        for i in range(k)
        for j in range(i, k)
    }
    B = B.astype(float)
    share = np.zeros(scatter[0, 0].shape)
    for i in range(k):  # elimination: scatter = L D L^T, and B becomes B L^-T
        pivot = np.maximum(scatter[i, i], 1e-9)
        share += (B[:, :, i] ** 2).sum(1) / pivot
        for j in range(i + 1, k):
            factor = scatter[i, j] / pivot  # (b, v)
            B[:, :, j] -= B[:, :, i] * factor[:, None]
            for m in range(j, k):
                scatter[j, m] = scatter[j, m] - factor * scatter[i, m]
    return share
