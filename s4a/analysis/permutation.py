"""Permutation tests of plain arrays (6.1): whole shapes by their scores, and every vertex.

The general linear model is Y = Z G + X B + E, with intercept and covariates Z, and the tested
variable or indicators of groups X.  The residuals of Y on Z are permuted (Freedman & Lane 1983),
and X is orthogonalised to Z.  Permutations assume homogeneous variance.  If it differs between
groups or with the variable, signs of the residuals are flipped at random instead (wild bootstrap:
Liu 1988; Winkler et al. 2014), which assumes symmetric errors.  Shapes of one block, such as visits
of one subject, are permuted within the block, or flipped together.
"""

import itertools
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats

from s4a.schema import Array, check_choice, check_count

log = logging.getLogger(__name__)

# variance inflation factors from which covariates are reported, and a variable cannot be tested
INFLATED, MOST_INFLATED = 10.0, 1e4


def check_permutations(n_permutations: int) -> None:
    """Raise ValueError unless a number of permutations is from 1 to 10 million."""
    check_count("n_permutations", n_permutations, 1, 10_000_000)


def check_options(n_permutations: int, variances: str, seed: int) -> dict[str, Any]:
    """Return the options of a :class:`Model` after a check."""
    check_permutations(n_permutations)
    check_choice("variances", variances, ("equal", "unequal"))
    return {"n_permutations": n_permutations, "variances": variances, "seed": seed}


def standardize(columns: Array) -> tuple[Array, float]:
    """Centre columns ``(n, c)`` and scale them to length 1; return the rounding error, too.

    Columns that vary only by rounding are set to 0: the sum of ten times 0.1 is not always 1.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.permutation import standardize
    >>> standardize(np.array([[0.1, 1e9], [0.1, 1e9 + 2]]))[0].round(3).tolist()
    [[0.0, -0.707], [0.0, 0.707]]
    """
    columns = np.asarray(columns, float)
    scale = np.abs(columns).max(0)
    columns = columns / np.where(scale > 0, scale, 1)
    columns = columns - columns.mean(0)
    length = np.linalg.norm(columns, axis=0)
    rounding = 4 * len(columns) * np.finfo(float).eps
    varies = length > rounding
    least = length[varies].min(initial=1.0)
    return np.where(varies, columns / np.where(varies, length, 1), 0), rounding / least


def design(x: Array, covariates: Array | None = None) -> tuple[Array, Array]:
    """Return orthonormal bases of Z ``(n, r)`` and of the part of X orthogonal to Z ``(n, q)``.

    They do not depend on the unit or origin of a column.

    Parameters
    ----------
    x : float ndarray (n,) or (n, q)
    covariates : float ndarray (n, c), optional

    Raises
    ------
    ValueError
        If X is constant or a combination of the covariates, or there are too few shapes.
    """
    n = len(x)
    X, rounding = standardize(np.reshape(x, (n, -1)))
    Z = np.full((n, 1), 1 / np.sqrt(n))
    if covariates is not None:
        columns, noise = standardize(np.reshape(covariates, (n, -1)))
        rounding = max(rounding, noise)
        U, S, _ = np.linalg.svd(columns, full_matrices=False)
        Z = np.column_stack([Z, U[:, S > max(1e-8, rounding)]])  # (n, r)
    if not X.any(axis=0).all():
        raise ValueError("the tested variable is constant; a test needs values that differ")
    U, S, _ = np.linalg.svd(X - Z @ (Z.T @ X), full_matrices=False)
    Q = U[:, S > max(1e-8, rounding)]  # (n, q)
    r, q = Z.shape[1], Q.shape[1]
    if n - r - q < 2:
        raise ValueError(
            f"{n} shapes are too few for a model of {r + q} columns (mean, {r - 1} covariates, "
            f"{q} tested): use {r + q + 2} shapes or fewer covariates"
        )
    factor = inflation(X, Z)
    if q < np.linalg.matrix_rank(X) or factor > MOST_INFLATED:
        nearly = "" if factor > 1e12 else f" (variance inflation factor {factor:.2g})"
        raise ValueError(
            f"the tested variable is a combination of the covariates{nearly}; omit one of them"
        )
    return Z, Q


def inflation(X: Array, Z: Array, n_parameters: int = 0) -> float:
    """Return the variance inflation factor of columns, the largest one.

    Parameters
    ----------
    X : float ndarray (n, q)
        Columns of length 1, or 0, see :func:`standardize`.
    Z : float ndarray (n, r)
        Orthonormal basis of other columns.
    n_parameters : int
        Number of the other columns, to adjust the explained shares of the variance for it.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.permutation import inflation
    >>> round(inflation(np.array([[0.6], [0.8]]), np.array([[0.0], [1.0]])), 2)
    2.78
    """
    share = ((X - Z @ (Z.T @ X)) ** 2).sum(0)[X.any(0)].min(initial=1.0)
    n = len(X) - 1
    return float((n - n_parameters) / n / max(share, 1e-30))


def indicators(group: Array) -> tuple[Array, Array]:
    """Return sorted names of groups, and indicator columns without the first ``(n, g - 1)``."""
    names, code = np.unique(group, return_inverse=True)
    return names, (code[:, None] == np.arange(1, len(names))).astype(float)


def shrunk_covariance(R: Array) -> Array:
    """Return Ledoit-Wolf covariances ``(..., p, p)`` of centred samples ``(..., n, p)``.

    As :func:`sklearn.covariance.ledoit_wolf` (Ledoit & Wolf 2004), vectorised over samples.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.covariance import ledoit_wolf
    >>> from s4a.analysis.permutation import shrunk_covariance
    >>> R = np.random.default_rng(0).normal(size=(9, 3))
    >>> bool(np.allclose(shrunk_covariance(R), ledoit_wolf(R, assume_centered=True)[0]))
    True
    """
    n, p = R.shape[-2:]
    S = R.swapaxes(-1, -2) @ R / n
    size = np.trace(S, axis1=-2, axis2=-1) / p
    squared = (S**2).sum((-2, -1))
    distance = squared / p - size**2  # squared distance to the scaled identity
    fourth = ((R**2).sum(-1) ** 2).sum(-1)
    error = (fourth / n - squared) / (p * n)
    share = np.clip(error / np.where(distance > 0, distance, 1), 0, 1) * (distance > 0)
    share, size = share[..., None, None], size[..., None, None]
    return (1 - share) * S + share * size * np.eye(p)


def hotelling(E: Array, Q: Array, dof: int) -> Array:
    """Return Hotelling's T^2 ``(...,)``, the Lawley-Hotelling trace for several columns of X.

    Parameters
    ----------
    E : float ndarray (..., n, p)
        Residuals of the scores on the covariates.
    Q : float ndarray (n, q)
        Basis of X of :func:`design`.
    dof : int
        Degrees of freedom of the error, n - r - q.
    """
    n, p = E.shape[-2:]
    H = Q.T @ E  # (..., q, p)
    S = shrunk_covariance(E - Q @ H) * n / dof  # (..., p, p)
    # keeps the statistic finite if X explains everything
    least = 1e-12 * (E**2).mean((-2, -1)) + np.finfo(float).tiny
    S = S + least[..., None, None] * np.eye(p)
    return np.einsum("...qp,...pq->...", H, np.linalg.solve(S, H.swapaxes(-1, -2)))


@dataclass(frozen=True)
class Model:
    """General linear model of a permutation test.

    Parameters
    ----------
    x : float ndarray (n,) or (n, q)
        Tested variable, or :func:`indicators` of groups.
    covariates : float ndarray (n, c), optional
    variances : {"equal", "unequal"}
        Permute residuals, or flip their signs.
    blocks : ndarray (n,), optional
        Permute residuals within blocks, or flip the signs of whole blocks; x, covariates and data
        must have mean zero in every block.
    n_permutations, seed : int
    intercept : bool
        Whether the model has an intercept; without it x = 1 tests whether the mean is zero.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.permutation import Model, indicators
    >>> model = Model(indicators(list("aaabbb"))[1])
    >>> model.n_rearrangements, model.smallest_p
    (20, 0.1)
    >>> others, n = model.rearrangements()
    >>> n, next(others).tolist()
    (19, [0, 1, 3, 2, 4, 5])
    """

    x: Array
    covariates: Array | None = None
    variances: str = "equal"
    blocks: Array | None = None
    n_permutations: int = 999
    seed: int = 0
    intercept: bool = True

    @classmethod
    def one_sample(cls, n: int, n_permutations: int = 999, seed: int = 0) -> "Model":
        """Return the model of a test of zero mean of n shapes, by sign flips."""
        ones = np.ones(n)
        return cls(ones, None, "unequal", None, n_permutations, seed, intercept=False)

    @cached_property
    def bases(self) -> tuple[Array, Array]:
        """Orthonormal bases of Z and X, see :func:`design`."""
        if self.intercept:
            return design(self.x, self.covariates)
        X = np.reshape(self.x, (len(self.x), -1))
        return np.empty((len(X), 0)), X / np.linalg.norm(X, axis=0)

    @property
    def rows(self) -> Array:
        """Columns of x and covariates ``(n, q + c)``, a row per shape."""
        x = np.reshape(self.x, (len(self.x), -1))
        return x if self.covariates is None else np.column_stack([x, self.covariates])

    @property
    def block_rows(self) -> list[Array]:
        """Rows of each block of exchangeable shapes; one block by default."""
        if self.blocks is None:
            return [np.arange(len(self.x))]
        return [np.flatnonzero(self.blocks == block) for block in np.unique(self.blocks)]

    @property
    def n_rearrangements(self) -> int:
        """Number of distinct permutations or sign flips, including the identity.

        Permutations of shapes with equal values are not distinct.
        """
        if self.variances == "unequal":  # opposite signs give the same statistic
            return 2 ** ((len(self.x) if self.blocks is None else len(self.block_rows)) - 1)
        return math.prod(_count_orders(self.rows[rows]) for rows in self.block_rows)

    @property
    def smallest_p(self) -> float:
        """Smallest p value of the test.

        Limited by the numbers of drawn and of distinct permutations.  Permutations that exchange
        groups of equal size, or reverse a variable that is symmetric about its mean, give the same
        statistic.
        """
        return max(1 / (self.n_permutations + 1), self._n_equivalent() / self.n_rearrangements)

    def _n_equivalent(self) -> int:
        """Number of rearrangements with the same statistic."""
        # a constant covariate has no effect
        if self.covariates is not None and np.ptp(self.covariates, axis=0).any():
            return 1
        if self.variances == "unequal":
            return 1
        x = np.reshape(self.x, (len(self.x), -1))
        if x.shape[1] == 1:
            blocks, size = [np.sort(x[rows, 0]) for rows in self.block_rows], np.ptp(x)
            # reversing the order only changes the sign of the slope
            return 1 + all(np.ptp(block + block[::-1]) <= 1e-9 * size for block in blocks)
        sizes = np.unique(x, axis=0, return_counts=True)[1].tolist()
        if self.blocks is not None or len(sizes) != x.shape[1] + 1:
            return 1
        return math.prod(math.factorial(sizes.count(s)) for s in set(sizes))  # exchanged groups

    def attributes(self) -> dict[str, str | int | float]:
        """Return the attributes of a result; warn if the test has little power.

        Either no p value below 0.05 is possible, or the covariates explain the tested variable.
        """
        least = self.smallest_p
        Z, X = self.bases[0], standardize(np.reshape(self.x, (len(self.x), -1)))[0]
        factor = inflation(X, Z, Z.shape[1] - 1) if self.covariates is not None else 1.0
        if factor > INFLATED:
            log.warning(
                "the covariates explain most of the tested variable (variance inflation factor "
                "%.2g): effects of the two cannot be separated; omit covariates that measure the "
                "same",
                factor,
            )
        if least > 0.05:
            subjects = "" if self.blocks is None else f" of {len(self.block_rows)} subjects"
            log.warning(
                "%d shapes%s allow no p value below %.2g: use more shapes or more permutations",
                len(self.x),
                subjects,
                least,
            )
        return {
            "variances": self.variances,
            "permutations": min(self.n_rearrangements - 1, self.n_permutations),
            "smallest_p": least,
        }

    def rearrangements(self) -> tuple[Iterator[Array], int]:
        """Return random permutations or sign flips, or all of them if there are few.

        Returns
        -------
        rearrangements : iterator of ndarray (n,)
            Integers, an order of the residuals; with unequal variances 1.0 and -1.0.
        n_rearrangements : int
            `n_permutations`, or the number of all distinct ones without the identity.
        """
        rng = np.random.default_rng(self.seed)
        n, n_others = len(self.x), self.n_rearrangements - 1
        if n_others <= self.n_permutations:
            return itertools.islice(self._all(), 1, None), n_others
        if self.variances == "unequal":
            code = self._code()
            drawn = (rng.choice([-1.0, 1.0], code.max() + 1)[code] for _ in itertools.count())
        elif self.blocks is not None:
            drawn = (_drawn_within(self.blocks, rng) for _ in itertools.count())
        else:
            drawn = (rng.permutation(n) for _ in itertools.count())
        return itertools.islice(drawn, self.n_permutations), self.n_permutations

    def _code(self) -> Array:
        """Block number of each shape."""
        if self.blocks is None:
            return np.arange(len(self.x))
        return np.unique(self.blocks, return_inverse=True)[1]

    def _all(self) -> Iterator[Array]:
        """All rearrangements, the identity first."""
        if self.variances == "unequal":
            code = self._code()
            signs = itertools.product([1.0, -1.0], repeat=int(code.max()))
            return (np.array([1.0, *row])[code] for row in signs)
        blocks = self.block_rows
        orders = [[rows[order] for order in _all_orders(self.rows[rows])] for rows in blocks]
        place = np.argsort(np.concatenate(blocks))
        return (np.concatenate(chosen)[place] for chosen in itertools.product(*orders))

    def p_values(
        self, statistic: Callable[[list[Array]], Array], least: Any, at_once: int
    ) -> tuple[Array, Array]:
        """Return p values by rearrangement of residuals; exact if all rearrangements are used.

        Parameters
        ----------
        statistic : callable
            Maps a list of b rearrangements to statistics, ndarray (b, ...).
        least : ndarray (...)
            Values that count as at least the observed statistic.
        at_once : int
            Rearrangements in a list.

        Returns
        -------
        p : ndarray (...)
            (1 + number of statistics at least as large) / (1 + number of rearrangements).
        p_max : ndarray (...)
            Family-wise, by the largest statistic (Westfall & Young 1993, single step).
        """
        others, n_others = self.rearrangements()
        return p_values(others, n_others, statistic, least, at_once)

    def test(self, scores: Array) -> tuple[float, float]:
        """Test scores ``(n, p)`` by Hotelling's T^2; return statistic and p value.

        Examples
        --------
        >>> import numpy as np
        >>> from s4a.analysis.permutation import Model
        >>> scores = np.random.default_rng(0).normal(size=(20, 3))
        >>> x = np.repeat([0.0, 1.0], 10)
        >>> Model(x, n_permutations=99, seed=1).test(scores + 3 * x[:, None])[1]
        0.01
        """
        Z, Q = self.bases
        E = scores - Z @ (Z.T @ scores)
        dof = len(E) - Z.shape[1] - Q.shape[1]
        statistic = float(hotelling(E, Q, dof))

        def statistics_of(batch):
            permuted = np.stack([rearranged(E, by) for by in batch])  # (b, n, p)
            return hotelling(permuted - Z @ (Z.T @ permuted), Q, dof)

        p, _ = self.p_values(statistics_of, statistic * (1 - 1e-9), max(1, 1_000_000 // E.size))
        return statistic, float(p)

    def vertex_test(self, d: Array, floor: Array | None = None) -> tuple[Array, Array, Array]:
        """Test every vertex, with p values corrected for multiple comparisons (max-T).

        The statistic is Pillai's trace V, the explained share of the vectors' scatter; for one
        column of X, T^2 = dof V / (1 - V).  The scatter is that of the permuted residuals on Z, as
        covariates reduce it.

        Parameters
        ----------
        d : float ndarray (n, v, k)
            Vector fields, or scalar fields with k = 1.
        floor : float ndarray (v,), optional
            Standard error of the mean that is added to that of the fields, so that small means at
            vertices with little variation are not significant.

        Returns
        -------
        share : float ndarray (v,)
        p : float ndarray (v,), of each vertex alone
        p_max : float ndarray (v,), family-wise

        Raises
        ------
        ValueError
            If X is a combination of the covariates, or there are too few shapes.
        """
        Z, Q = self.bases
        n, v, k = d.shape
        r, q = Z.shape[1], Q.shape[1]
        if n - r <= k:  # X would explain all of the residuals
            raise ValueError(
                f"{n} shapes are too few for a test of {k} coordinates at a vertex with {r} "
                f"columns of mean and covariates: use {r + k + 1} shapes, fewer covariates, or "
                "of='normal'"
            )
        E = np.asarray(d, float).reshape(n, -1)  # (n, v k)
        rounding = 1e-12 * abs(E).max()
        E = (E - Z @ (Z.T @ E)).reshape(n, v, k)
        E[:, abs(E).max((0, 2)) <= rounding] = 0  # no variation
        scatter = (E**2).sum((0, 2))
        E = whiten(E)
        if floor is not None:
            total = scatter + (n * floor) ** 2
            E = E * np.sqrt(scatter / np.where(total > 0, total, 1))[:, None]
        E = E.transpose(0, 2, 1).reshape(n, -1).astype(np.float32)  # (n, k v)

        def project(columns, per):
            """Multiply b times `per` columns ``(n, b per)`` with residuals: (b, per, k, v)."""
            return (columns.T.astype(np.float32) @ E).reshape(-1, per, k, v)

        def statistics_of(batch):
            # Q^T (I - Z Z^T) P E = (P^T Q)^T E, as Q is orthogonal to Z; P^T is the inverse order,
            # or the same signs
            inverse = [np.argsort(by) if by.dtype.kind == "i" else by for by in batch]
            B = project(np.concatenate([rearranged(Q, by) for by in inverse], axis=1), q)
            if r == 0 or (r == 1 and self.variances == "equal"):
                # permutations leave the intercept unchanged: the scatter stays 1
                return (B**2).sum(axis=(1, 2))  # (b, v)
            A = project(np.concatenate([rearranged(Z, by) for by in inverse], axis=1), r)
            return explained_share(A, B)

        share = (project(Q, q)[0] ** 2).sum(axis=(0, 1))
        least = share * (1 - 1e-6) - (1e-7 if r else 0)  # single-precision tolerance
        at_once = max(1, int(2e7 // (v * k * (q + r))))  # 80 MB of products
        return share, *self.p_values(statistics_of, least, at_once)


def p_values(
    others: Iterator[Array],
    n_others: int,
    statistic: Callable[[list[Array]], Array],
    least: Any,
    at_once: int,
) -> tuple[Array, Array]:
    """Return p values of given rearrangements, see :meth:`Model.p_values`."""
    count = np.zeros(np.shape(least), np.int64)
    largest = [np.empty(0, np.float32)]
    for batch in batched(others, at_once):
        values = statistic(batch)
        count += (values >= least).sum(0)
        largest.append(values.reshape(len(values), -1).max(1))
    count_max = n_others - np.searchsorted(np.sort(np.concatenate(largest)), least, side="left")
    return (1 + count) / (1 + n_others), (1 + count_max) / (1 + n_others)


def _count_orders(rows):
    """Number of distinct orders of rows."""
    counts = np.unique(rows, axis=0, return_counts=True)[1].tolist()
    return math.factorial(len(rows)) // math.prod(map(math.factorial, counts))


def _drawn_within(blocks, rng):
    """Random order that leaves each shape in its block."""
    code = np.unique(blocks, return_inverse=True)[1]
    order = np.empty(len(code), int)
    order[np.argsort(code, kind="stable")] = np.lexsort((rng.random(len(code)), code))
    return order


def _all_orders(rows):
    """All orders that are distinct for rows with repetitions, the identity first."""
    code = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    positions = np.argsort(code, kind="stable")  # sorted by row value

    def fill(remaining, counts):
        """Partitions of the remaining indices into groups of the given sizes."""
        if not counts:
            yield []
            return
        for chosen in itertools.combinations(remaining, counts[0]):
            rest = [i for i in remaining if i not in chosen]
            for others in fill(rest, counts[1:]):
                yield [*chosen, *others]

    for residuals in fill(positions.tolist(), np.bincount(code).tolist()):
        order = np.empty(len(rows), int)
        order[positions] = residuals
        yield order


def rearranged(rows: Array, by: Array) -> Array:
    """Return rows ``(n, ...)`` in another order, or with other signs."""
    if by.dtype.kind == "i":
        return rows[by]
    return rows * by.reshape(-1, *[1] * (rows.ndim - 1))


def scatter_test(
    coordinates: Array, x: Array, *, covariates: Array | None = None
) -> tuple[Array, float]:
    """Test homogeneity of covariance by distances to the fitted values (Anderson 2006).

    A multivariate Levene test.

    Parameters
    ----------
    coordinates : float ndarray (n, p)
        Scores of the shapes on all components, in the unit of the input.
    x, covariates : see :class:`Model`

    Returns
    -------
    distance : float ndarray (n,)
        Norm of the leave-one-out residual of each shape.
    p : float
        p value of the F test of these distances on x; 1 without residuals.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.permutation import scatter_test
    >>> x = np.repeat([0.0, 1.0], 10)
    >>> scores = np.random.default_rng(0).normal(size=(20, 3))
    >>> scatter_test(scores, x)[1] > 0.05, scatter_test(scores * (1 + 2 * x[:, None]), x)[1] < 0.01
    (True, True)
    """
    model = np.column_stack(design(x, covariates))  # (n, r + q)
    leverage = np.minimum((model**2).sum(1), 1 - 1e-9)
    residual = coordinates - model @ (model.T @ coordinates)
    distance = np.linalg.norm(residual, axis=1) / np.sqrt(1 - leverage)
    if distance.max() < 1e-9 * np.linalg.norm(coordinates, axis=1).max():
        return distance, 1.0
    _, Q = design(x)
    q = Q.shape[1]
    centered = distance - distance.mean()
    explained = ((Q.T @ centered) ** 2).sum()
    unexplained = max(centered @ centered - explained, 1e-12 * (distance @ distance))
    dof = len(centered) - 1 - q
    return distance, float(stats.f.sf(explained / q / (unexplained / dof), q, dof))


def whiten(E: Array) -> Array:
    """Whiten residual vectors ``(n, v, d)`` by their scatter W at each vertex: W^-1/2 e, or 0."""
    value, V = np.linalg.eigh(np.einsum("nvd,nve->vde", E, E))  # (v, d), (v, d, d)
    largest = value[:, -1:]
    is_zero = value <= 1e-10 * np.where(largest > 0, largest, 1)
    root = np.sqrt(np.where(is_zero, 1, value))
    return np.einsum("nvd,vde,ve->nve", E, V, np.where(is_zero, 0, 1 / root), optimize=True)


def batched(items: Iterator[Any], size: int) -> Iterator[list[Any]]:
    """Yield items in lists of at most `size`."""
    while batch := list(itertools.islice(items, size)):
        yield batch


def explained_share(A: Array, B: Array) -> Array:
    """Return Pillai's trace of permuted, whitened residuals: tr(B^T B (I - A^T A)^-1), ``(b, v)``.

    Parameters
    ----------
    A : float ndarray (b, r, k, v)
        Z^T P E: the part of permuted residuals that the covariates explain.
    B : float ndarray (b, q, k, v)
        Q^T P E.
    """
    k = A.shape[2]
    scatter = {  # upper triangle of I - A^T A
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
