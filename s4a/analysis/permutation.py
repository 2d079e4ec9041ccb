"""Permutation tests on plain arrays (6.1): of a whole shape by its scores, and of every vertex.

The general linear model is Y = Z G + X B + E: Z the intercept and the covariates, X what is tested
(a variable, or the indicators of groups).  After Freedman & Lane (1983) the residuals of Y on Z are
permuted; only the part of X that is orthogonal to Z counts.  Permutations take all shapes as drawn
with one variance.  Where it differs, between groups or with the variable, the signs of the
residuals are changed at random instead (the wild bootstrap: Liu 1988; Winkler et al. 2014): every
shape keeps its own variance, and errors need to be symmetric.  Shapes of one block, as visits of
one subject, change places with each other alone, or their signs together.
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

log = logging.getLogger(__name__)

MOST_PERMUTATIONS = 10_000_000
VARIANCES = ("equal", "unequal")


def check_permutations(n: int) -> None:
    """ValueError unless so many permutations can be drawn."""
    if not 1 <= n <= MOST_PERMUTATIONS:
        raise ValueError(f"n_permutations needs a number from 1 to {MOST_PERMUTATIONS}, found {n}")


def check_options(n_permutations: int, variances: str, seed: int) -> dict[str, Any]:
    """The options of a :class:`Model`, checked before anything is computed."""
    check_permutations(n_permutations)
    if variances not in VARIANCES:
        raise ValueError(f"variances must be 'equal' or 'unequal', found {variances!r}")
    return {"n_permutations": n_permutations, "variances": variances, "seed": seed}


def standardize(columns: np.ndarray) -> tuple[np.ndarray, float]:
    """Columns ``(n, c)`` less their mean and of length 1, or 0, and what of them may be rounding.

    A column is 0 when it varies by no more than rounding does at its size: 0.1 added up ten times
    is not always 1, and 1e9 + 1e-7 is no other number than 1e9.

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


def design(x: np.ndarray, covariates: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal bases of Z, ``(n, r)``, and of the part of X orthogonal to it, ``(n, q)``.

    Neither the unit nor the origin of a column changes them.

    Parameters
    ----------
    x : float ndarray (n,) or (n, q)
    covariates : float ndarray (n, c), optional

    Raises
    ------
    ValueError
        When X is constant or a combination of the covariates, or too few shapes are left to
        estimate anything.
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
        raise ValueError("what is tested is constant; a test needs values that differ")
    U, S, _ = np.linalg.svd(X - Z @ (Z.T @ X), full_matrices=False)
    Q = U[:, S > max(1e-8, rounding)]  # (n, q)
    r, q = Z.shape[1], Q.shape[1]
    if n - r - q < 2:
        raise ValueError(
            f"{n} shapes are too few for a model of {r + q} columns (the mean, {r - 1} of the "
            f"covariates, {q} of what is tested): {r + q + 2} shapes needed, or fewer covariates"
        )
    if q < np.linalg.matrix_rank(X):
        raise ValueError("what is tested is a combination of the covariates; leave one of them out")
    return Z, Q


def indicators(group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Names of the groups, sorted, and indicator columns of all but the first ``(n, g - 1)``."""
    names, code = np.unique(group, return_inverse=True)
    return names, (code[:, None] == np.arange(1, len(names))).astype(float)


def shrunk_covariance(R: np.ndarray) -> np.ndarray:
    """Covariances ``(..., p, p)`` of centred samples ``(..., n, p)``, after Ledoit & Wolf (2004).

    As :func:`sklearn.covariance.ledoit_wolf`, of many samples at once.

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
    far = squared / p - size**2  # squared distance to the sphere of the same size
    fourth = ((R**2).sum(-1) ** 2).sum(-1)
    uncertain = (fourth / n - squared) / (p * n)
    share = np.clip(uncertain / np.where(far > 0, far, 1), 0, 1) * (far > 0)
    share, size = share[..., None, None], size[..., None, None]
    return (1 - share) * S + share * size * np.eye(p)


def hotelling(E: np.ndarray, Q: np.ndarray, dof: int) -> np.ndarray:
    """Hotelling's T^2 (Lawley and Hotelling's trace for several columns of X), ``(...,)``.

    Parameters
    ----------
    E : float ndarray (..., n, p)
        Residuals of the scores on the covariates.
    Q : float ndarray (n, q)
        As of :func:`design`.
    dof : int
        Degrees of freedom of the error, n - r - q.
    """
    n, p = E.shape[-2:]
    H = Q.T @ E  # (..., q, p)
    S = shrunk_covariance(E - Q @ H) * n / dof  # (..., p, p)
    # where nothing is left unexplained the statistic is large, and a number
    least = 1e-12 * (E**2).mean((-2, -1)) + np.finfo(float).tiny
    S = S + least[..., None, None] * np.eye(p)
    return np.einsum("...qp,...pq->...", H, np.linalg.solve(S, H.swapaxes(-1, -2)))


@dataclass(frozen=True)
class Model:
    """What a permutation test is of, and how residuals are rearranged in it.

    Parameters
    ----------
    x : float ndarray (n,) or (n, q)
        What is tested: a variable, or :func:`indicators`.
    covariates : float ndarray (n, c), optional
    variances : {"equal", "unequal"}
        Residuals are permuted, or have their signs changed.
    blocks : ndarray (n,), optional
        Residuals are permuted within these, or change their signs with all of their block; x,
        covariates and what is tested have mean zero in every block then.
    n_permutations, seed : int
    intercept : bool
        Whether the mean is accounted for; without it x = 1 tests whether it is zero.

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

    x: np.ndarray
    covariates: np.ndarray | None = None
    variances: str = "equal"
    blocks: np.ndarray | None = None
    n_permutations: int = 999
    seed: int = 0
    intercept: bool = True

    @classmethod
    def of_mean(cls, n: int, n_permutations: int = 999, seed: int = 0) -> "Model":
        """Whether the mean of n shapes is zero, by changes of their signs."""
        ones = np.ones(n)
        return cls(ones, None, "unequal", None, n_permutations, seed, intercept=False)

    @cached_property
    def bases(self) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal bases of Z and of what is tested, see :func:`design`."""
        if self.intercept:
            return design(self.x, self.covariates)
        X = np.reshape(self.x, (len(self.x), -1))
        return np.empty((len(X), 0)), X / np.linalg.norm(X, axis=0)

    @property
    def rows(self) -> np.ndarray:
        """The columns of each shape: what is tested, and the covariates ``(n, q + c)``."""
        x = np.reshape(self.x, (len(self.x), -1))
        return x if self.covariates is None else np.column_stack([x, self.covariates])

    @property
    def places(self) -> list[np.ndarray]:
        """Where each block of exchangeable shapes stands; all are one where none is named."""
        if self.blocks is None:
            return [np.arange(len(self.x))]
        return [np.flatnonzero(self.blocks == one) for one in np.unique(self.blocks)]

    @property
    def n_rearrangements(self) -> int:
        """How many orders of the shapes differ, or signs of their residuals; as given is one.

        Shapes of equal values of all columns take each other's place without a difference.
        """
        if self.variances == "unequal":  # the same signs but turned give the same statistic
            return 2 ** ((len(self.x) if self.blocks is None else len(self.places)) - 1)
        return math.prod(_count_orders(self.rows[of]) for of in self.places)

    @property
    def smallest_p(self) -> float:
        """The smallest p that the test can reach.

        Bound by the number of permutations drawn, and by how many are different: two that only
        exchange shapes of equal values, or groups of equal size, or turn round a variable that is
        symmetric about its mean, give the same statistic.
        """
        return max(1 / (self.n_permutations + 1), self._n_alike() / self.n_rearrangements)

    def _n_alike(self) -> int:
        """How many rearrangements give the same statistic as any one does."""
        # a covariate that is constant is in the mean, and changes nothing
        if self.covariates is not None and np.ptp(self.covariates, axis=0).any():
            return 1
        if self.variances == "unequal":
            return 1
        rows = np.reshape(self.x, (len(self.x), -1))
        if rows.shape[1] == 1:
            sides, size = [np.sort(rows[of, 0]) for of in self.places], np.ptp(rows)
            # the order of all turned round changes but the sign of a slope
            return 1 + all(np.ptp(one + one[::-1]) <= 1e-9 * size for one in sides)
        sizes = np.unique(rows, axis=0, return_counts=True)[1].tolist()
        if self.blocks is not None or len(sizes) != rows.shape[1] + 1:
            return 1
        return math.prod(math.factorial(sizes.count(s)) for s in set(sizes))  # groups change places

    def said(self) -> dict[str, str | int | float]:
        """Attributes of a result; the log says where shapes are too few for any small p."""
        least = self.smallest_p
        if least > 0.05:
            of = "" if self.blocks is None else f" of {len(self.places)} subjects"
            log.warning(
                "%d shapes%s allow no p value below %.2g, whatever they are like: more are needed, "
                "or more permutations",
                len(self.x),
                of,
                least,
            )
        return {
            "variances": self.variances,
            "permutations": min(self.n_rearrangements - 1, self.n_permutations),
            "smallest_p": least,
        }

    def rearrangements(self) -> tuple[Iterator[np.ndarray], int]:
        """What is done to the residuals: orders, or signs; all others where there are no more.

        Returns
        -------
        rearrangements : iterator of ndarray (n,)
            Integers, the residual that comes to each place; or with unequal variances 1.0 and -1.0.
        n_rearrangements : int
            `n_permutations`, or the number of all that differ from what is given and each other.
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

    def _code(self) -> np.ndarray:
        """The number of the block of each shape, whose signs are changed together."""
        if self.blocks is None:
            return np.arange(len(self.x))
        return np.unique(self.blocks, return_inverse=True)[1]

    def _all(self) -> Iterator[np.ndarray]:
        """Every rearrangement once, as is first."""
        if self.variances == "unequal":
            code = self._code()
            every = itertools.product([1.0, -1.0], repeat=int(code.max()))
            return (np.array([1.0, *row])[code] for row in every)
        if self.blocks is None:
            return _all_orders(self.rows)
        return _orders_within(self.rows, self.places)

    def p_values(
        self, statistic: Callable[[list[np.ndarray]], np.ndarray], least: Any, at_once: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The p of statistics of residuals rearranged; exact where all rearrangements are drawn.

        Parameters
        ----------
        statistic : callable
            Of a list of b rearrangements: ndarray (b, ...).
        least : ndarray (...)
            What counts as reaching the statistic of the shapes as they are.
        at_once : int
            Rearrangements in a list.

        Returns
        -------
        p : ndarray (...)
            (1 + number that reach the statistic) / (1 + number of all).
        p_max : ndarray (...)
            Family-wise, by the largest statistic (Westfall & Young 1993, single step).
        """
        others, n_others = self.rearrangements()
        return p_values(others, n_others, statistic, least, at_once)

    def test(self, scores: np.ndarray) -> tuple[float, float]:
        """Permutation test of Hotelling's T^2 of scores ``(n, p)``: the statistic and its p.

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

        def of(batch):
            permuted = np.stack([rearranged(E, by) for by in batch])  # (b, n, p)
            return hotelling(permuted - Z @ (Z.T @ permuted), Q, dof)

        p, _ = self.p_values(of, statistic * (1 - 1e-9), max(1, 1_000_000 // E.size))
        return statistic, float(p)

    def vertex_test(
        self, d: np.ndarray, floor: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Permutation test at every vertex, with p values corrected for all by the largest (max-T).

        The statistic is Pillai's trace, the share 0..1 of the vectors' scatter that X explains; for
        one column of X, T^2 = dof V / (1 - V).  The scatter is that of the residuals on Z, for
        every permutation its own: with covariates those of permuted residuals scatter less, and
        beside the first scatter their shares would be too small.

        Parameters
        ----------
        d : float ndarray (n, v, k)
            Fields of vectors, or with k = 1 of numbers.
        floor : float ndarray (v,), optional
            A standard error of the mean that is added to that of the fields, so that where they
            hardly scatter a mean as small does not count.

        Returns
        -------
        share : float ndarray (v,)
        p : float ndarray (v,), of each vertex alone
        p_max : float ndarray (v,), family-wise

        Raises
        ------
        ValueError
            When X explains nothing that the covariates leave, or there are too few shapes.
        """
        Z, Q = self.bases
        n, v, k = d.shape
        r, q = Z.shape[1], Q.shape[1]
        if n - r <= k:  # the residuals fill all dimensions: what is tested explains all of them
            raise ValueError(
                f"{n} shapes are too few for a test of {k} coordinates at a vertex with {r} "
                f"columns of mean and covariates: {r + k + 1} needed, or fewer covariates, or "
                "of='normal'"
            )
        E = np.asarray(d, float).reshape(n, -1)  # (n, v k)
        rounding = 1e-12 * abs(E).max()
        E = (E - Z @ (Z.T @ E)).reshape(n, v, k)
        E[:, abs(E).max((0, 2)) <= rounding] = 0  # where nothing varies nothing is to be explained
        scatter = (E**2).sum((0, 2))
        E = whiten(E)
        if floor is not None:
            whole = scatter + (n * floor) ** 2
            E = E * np.sqrt(scatter / np.where(whole > 0, whole, 1))[:, None]
        E = E.transpose(0, 2, 1).reshape(n, -1).astype(np.float32)  # (n, k v)

        def project(columns, per):
            """Products of b times `per` columns ``(n, b per)`` with residuals: (b, per, k, v)."""
            return (columns.T.astype(np.float32) @ E).reshape(-1, per, k, v)

        def of(batch):
            # Q^T (I - Z Z^T) P E = (P^T Q)^T E, as Q is orthogonal to Z; P^T is the order back, or
            # the same signs again
            back = [np.argsort(by) if by.dtype.kind == "i" else by for by in batch]
            B = project(np.concatenate([rearranged(Q, by) for by in back], axis=1), q)
            if r == 0 or (r == 1 and self.variances == "equal"):
                # the intercept is moved by no permutation, and no sign is with none: the scatter
                # stays 1
                return (B**2).sum(axis=(1, 2))  # (b, v)
            A = project(np.concatenate([rearranged(Z, by) for by in back], axis=1), r)
            return explained_share(A, B)

        share = (project(Q, q)[0] ** 2).sum(axis=(0, 1))
        least = share * (1 - 1e-6) - (1e-7 if r else 0)  # of an equal share, in single precision
        at_once = max(1, int(2e7 // (v * k * (q + r))))  # 80 MB of products
        return share, *self.p_values(of, least, at_once)


def p_values(
    others: Iterator[np.ndarray],
    n_others: int,
    statistic: Callable[[list[np.ndarray]], np.ndarray],
    least: Any,
    at_once: int,
) -> tuple[np.ndarray, np.ndarray]:
    """As :meth:`Model.p_values`, of rearrangements that are given, and how many these are."""
    reached = np.zeros(np.shape(least), np.int64)
    largest = [np.empty(0, np.float32)]
    for batch in batched(others, at_once):
        found = statistic(batch)
        reached += (found >= least).sum(0)
        largest.append(found.reshape(len(found), -1).max(1))
    beyond = n_others - np.searchsorted(np.sort(np.concatenate(largest)), least, side="left")
    return (1 + reached) / (1 + n_others), (1 + beyond) / (1 + n_others)


def _count_orders(rows):
    """How many orders of rows differ."""
    same = np.unique(rows, axis=0, return_counts=True)[1].tolist()
    return math.factorial(len(rows)) // math.prod(map(math.factorial, same))


def _orders_within(rows, places):
    """Every order once that leaves each shape in its block, as is first."""
    each = [[of[order] for order in _all_orders(rows[of])] for of in places]
    for chosen in itertools.product(*each):
        order = np.empty(len(rows), int)
        order[np.concatenate(places)] = np.concatenate(chosen)
        yield order


def _drawn_within(blocks, rng):
    """An order that leaves each shape in its block."""
    code = np.unique(blocks, return_inverse=True)[1]
    order = np.empty(len(code), int)
    order[np.argsort(code, kind="stable")] = np.lexsort((rng.random(len(code)), code))
    return order


def _all_orders(rows):
    """Every order once in which other residuals come to the places of some row, as is first."""
    code = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    places = np.argsort(code, kind="stable")  # the places of one row after those of another

    def fill(left, counts):
        """All ways to put what is left, in order, into the places of each row."""
        if not counts:
            yield []
            return
        for chosen in itertools.combinations(left, counts[0]):
            rest = [i for i in left if i not in chosen]
            for others in fill(rest, counts[1:]):
                yield [*chosen, *others]

    for residuals in fill(places.tolist(), np.bincount(code).tolist()):
        order = np.empty(len(rows), int)
        order[places] = residuals
        yield order


def rearranged(rows: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Rows ``(n, ...)`` in another order, or with other signs."""
    if by.dtype.kind == "i":
        return rows[by]
    return rows * by.reshape(-1, *[1] * (rows.ndim - 1))


def scatter_test(
    coordinates: np.ndarray, x: np.ndarray, *, covariates: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Whether shapes scatter differently with x: a test of Levene's kind (Anderson 2006).

    Parameters
    ----------
    coordinates : float ndarray (n, p)
        Of the shapes on all components, in the unit of the input.
    x, covariates : see :class:`Model`

    Returns
    -------
    distance : float ndarray (n,)
        Of each shape from what the model expects of it, as if the model did not know the shape.
    p : float
        Of the F test of these distances on x; 1 where the model leaves nothing to compare.

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
    left = coordinates - model @ (model.T @ coordinates)
    distance = np.linalg.norm(left, axis=1) / np.sqrt(1 - leverage)
    if distance.max() < 1e-9 * np.linalg.norm(coordinates, axis=1).max():
        return distance, 1.0
    _, Q = design(x)
    q = Q.shape[1]
    around = distance - distance.mean()
    explained = ((Q.T @ around) ** 2).sum()
    rest = max(around @ around - explained, 1e-12 * (distance @ distance))
    dof = len(around) - 1 - q
    return distance, float(stats.f.sf(explained / q / (rest / dof), q, dof))


def whiten(E: np.ndarray) -> np.ndarray:
    """Residual vectors ``(n, v, d)`` in units of their scatter W at each vertex, W^-1/2 e, or 0."""
    value, V = np.linalg.eigh(np.einsum("nvd,nve->vde", E, E))  # (v, d), (v, d, d)
    largest = value[:, -1:]
    is_zero = value <= 1e-10 * np.where(largest > 0, largest, 1)
    root = np.sqrt(np.where(is_zero, 1, value))
    return np.einsum("nvd,vde,ve->nve", E, V, np.where(is_zero, 0, 1 / root), optimize=True)


def batched(items: Iterator[Any], size: int) -> Iterator[list[Any]]:
    """The items in lists of at most `size`."""
    while batch := list(itertools.islice(items, size)):
        yield batch


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
