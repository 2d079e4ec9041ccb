r"""KnnSearch: exact nearest neighbours at low (eq. 2, 3, 6) and at full resolution (eq. 4, 7).

At low resolution all rows are compared (:func:`nearest_rows`).  At full resolution the rows are
U_i F_i, with F_i = Phi_i Y_i (eq. 7) or Phi_i C^T (eq. 4), and are grouped into the cells of the
coarse vertices (:func:`nearest_in_cells`).  A query is first compared with the cells whose centres
are nearest to that of its own.  By the triangle inequality the distance excludes most other cells,
and the rest are searched, too::

      .---------.                          .---------.
     /   q       \        distance        /           \      no row of cell b is closer to
    |      a------+----------------------+------b      |     a query of cell a than
     \           /                        \           /      distance - radius a - radius b
      '---------'                          '---------'
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from s4a.geometry.mesh import counting_sort
from s4a.schema import Array

BLOCK = 512  # cells of queries whose distances to all other cells are in memory at once
PAIRS = 2048  # pairs of rows at a time: their differences, 0.8 MB in 100 dims, fit into the cache
_BLOCK_OF_ROWS = 1 << 13  # rows that are sorted at a time
_AROUND = 128  # queries whose candidates are gathered at once: 1.6 MB for 32 each in 100 dims
_SLACK = 1 + 1e-5  # factor on bounds, for float32 rounding


def nearest_rows(Q: Array, D: Array, *, block: int = 256) -> Array:
    """Return the index of the nearest row of D for every row of Q: KnnSearch of eq. 2, 3, 6.

    All rows are compared by matrix products of (q, -1) and (d, |d|^2 / 2), which are largest for
    the least Euclidean distance, in blocks that fit into the cache.  Above about 20 dims float32
    products are faster than a KD-tree; float64 decides between rows within rounding.  Ties give the
    first row.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import nearest_rows
    >>> nearest_rows(np.array([[0.1], [4.0]]), np.array([[0.0], [5.0]])).tolist()
    [0, 1]
    """
    q = as_queries(Q)
    d = as_candidates(D)
    max_norm = np.sqrt(2 * d[-1].max())
    norm = np.linalg.norm(q[:, :-1], axis=1)
    rounding = 16 * np.finfo(np.float32).eps * max_norm * (norm + max_norm)
    nearest = np.empty(len(q), np.int64)
    for start, score in _scores_in_blocks(q, d, block):
        best = score.argmax(axis=1)
        row = np.arange(len(best))
        least = score[row, best] - rounding[start : start + block]
        score[row, best] = -np.inf
        for i in np.flatnonzero(score.max(axis=1) >= least):  # the second is within rounding
            score[i, best[i]] = np.inf
            close = np.flatnonzero(score[i] >= least[i])
            difference = D[close].astype(float) - Q[start + i]
            best[i] = close[np.einsum("ij,ij->i", difference, difference).argmin()]
        nearest[start : start + block] = best
    return nearest


def as_queries(Q: Array) -> Array:
    """Return (q, -1) for the rows of Q ``(n, d + 1)`` in single precision."""
    return np.column_stack([Q, np.full(len(Q), -1)]).astype(np.float32)


def as_candidates(D: Array) -> Array:
    """Return (d, |d|^2 / 2) for the rows of D as columns ``(d + 1, p)`` in single precision."""
    d = np.asarray(D, np.float32)
    return np.ascontiguousarray(np.column_stack([d, np.einsum("ij,ij->i", d, d) / 2]).T)


def _scores_in_blocks(q, d, block=256):
    """Yield the matrix product q d in blocks with their first row, all in one buffer."""
    scores = np.empty((min(block, len(q)), d.shape[1]), np.float32)
    for start in range(0, len(q), block):
        part = q[start : start + block]
        yield start, np.matmul(part, d, out=scores[: len(part)])


def nearest_float32(q: Array, d: Array) -> Array:
    """Return nearest rows, of :func:`as_queries` and :func:`as_candidates`, in single precision."""
    return np.concatenate([score.argmax(axis=1) for _, score in _scores_in_blocks(q, d)])


def nearest_bidirectional(q: Array, d: Array) -> tuple[Array, Array]:
    """Return the nearest of d for every row of q and vice versa, from one matrix product.

    Its entries are -|q - d|^2 / 2, with one more term than those of :func:`nearest_float32`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import as_candidates, as_queries, nearest_bidirectional
    >>> Q, D = np.array([[0.1], [4.0]]), np.array([[0.0], [5.0], [0.3]])
    >>> [rows.tolist() for rows in nearest_bidirectional(as_queries(Q), as_candidates(D))]
    [[0, 1], [0, 1, 0]]
    """
    half = np.einsum("ij,ij->i", q[:, :-1], q[:, :-1]) / 2
    q, d = np.column_stack([q, -half]), np.vstack([d, np.ones(d.shape[1], d.dtype)])
    forth, back = np.empty(len(q), np.int64), np.zeros(d.shape[1], np.int64)
    highest = np.full(d.shape[1], -np.inf, np.float32)
    for start, score in _scores_in_blocks(q, d):
        forth[start : start + len(score)] = score.argmax(axis=1)
        value = score.max(axis=0)  # argmax takes three times as long along columns
        closer = value > highest
        np.maximum(highest, value, out=highest)
        row, column = np.divmod(np.flatnonzero(score == value)[::-1], len(closer))
        new = closer[column]
        back[column[new]] = start + row[new]  # of equal rows the first, which is written last
    return forth, back


def nearest_around(q: Array, rows: Array, near: Array) -> Array:
    """Return the nearest of a few candidate rows for each query.

    Parameters
    ----------
    q : float32 ndarray (n, m + 1)
        Result of :func:`as_queries`.
    rows : float32 ndarray (p, m + 1)
        Result of :func:`as_candidates`, transposed.
    near : int ndarray (n, w)
        Candidates of each query.

    Returns
    -------
    int ndarray (n,)
        Rows.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import as_candidates, as_queries, nearest_around
    >>> rows = np.ascontiguousarray(as_candidates(np.arange(9.0)[:, None]).T)
    >>> near = np.array([[0, 1, 2], [6, 7, 8]])
    >>> nearest_around(as_queries(np.array([[1.9], [5.8]])), rows, near).tolist()
    [2, 6]
    """
    nearest = np.empty(len(q), np.int64)
    for start in range(0, len(q), _AROUND):
        columns = near[start : start + _AROUND]
        score = rows.take(columns, axis=0) @ q[start : start + _AROUND, :, None]  # (AROUND, w, 1)
        best = score[:, :, 0].argmax(axis=1)
        nearest[start : start + _AROUND] = columns[np.arange(len(columns)), best]
    return nearest


@dataclass(frozen=True)
class Product:
    """Rows of a matrix product U F, computed when they are asked for.

    Examples
    --------
    >>> import numpy as np
    >>> import scipy.sparse as sp
    >>> from s4a.method.nearest import Product
    >>> U = sp.csr_matrix([[1.0, 0], [0.5, 0.5], [0, 1]])
    >>> Product(U, np.array([[2.0], [4.0]]))[np.array([1])].tolist()
    [[3.0]]
    """

    U: sp.csr_matrix  # (n, n_low)
    F: Array  # (n_low, d)

    def __len__(self) -> int:
        return self.U.shape[0]

    def __getitem__(self, rows: Array) -> Array:
        return self.U[rows] @ self.F

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return self.U.shape[0], self.F.shape[1]

    def mean(self, axis: int = 0) -> Array:
        """Mean of the rows ``(d,)``."""
        return np.asarray(self.U.mean(axis)).ravel() @ self.F


Rows = Array | Product


@dataclass(frozen=True)
class Cells:
    """Rows sorted by cell: ``rows[start[c]:start[c + 1]]`` are those of cell c."""

    rows: Array  # (n, d) float32
    order: Array  # (n,) original index of each row
    start: Array  # (cells + 1,)
    center: Array  # (cells, d)
    radius: Array  # (cells,) largest distance of a row to the centre

    @property
    def size(self) -> Array:
        """Number of rows of each cell."""
        return np.diff(self.start)


def into_cells(rows: Rows, cell: Array, middle: Array | float = 0.0) -> Cells:
    """Group rows `(n, d)`, less `middle`, by their cell numbers `(n,)`, without empty cells."""
    _, cell = np.unique(cell, return_inverse=True)
    count = np.bincount(cell)
    order, start = counting_sort(cell, len(count))
    in_order = np.empty(rows.shape, np.float32)
    for i in range(0, len(order), _BLOCK_OF_ROWS):  # no second copy of all rows
        some = slice(i, i + _BLOCK_OF_ROWS)
        np.subtract(rows[order[some]], middle, out=in_order[some], casting="same_kind")
    ones = np.ones(len(order), np.float32)
    sums = sp.csr_matrix((ones, np.arange(len(order)), start), (len(count), len(order))) @ in_order
    center = sums / count[:, None].astype(np.float32)
    distance, cell = np.empty(len(order), np.float32), np.sort(cell)
    for i in range(0, len(order), _BLOCK_OF_ROWS):
        some = slice(i, i + _BLOCK_OF_ROWS)
        distance[some] = np.linalg.norm(in_order[some] - center.take(cell[some], axis=0), axis=1)
    radius = np.maximum.reduceat(distance, start[:-1]) * _SLACK
    return Cells(in_order, order.astype(np.int64), start, center, radius)


def _squared_distances(A, B):
    """All squared distances ``(a, b)`` of float32 rows by one matrix product."""
    D = A @ B.T
    D *= -2
    D += np.einsum("ij,ij->i", A, A)[:, None]
    D += np.einsum("ij,ij->i", B, B)[None, :]
    return np.maximum(D, 0, out=D)


def _least_distances(A, B):
    """Lower bounds of the distances ``(a, b)`` of float32 rows in spite of rounding."""
    D = _squared_distances(A, B)
    largest = np.einsum("ij,ij->i", A, A).max() + np.einsum("ij,ij->i", B, B).max()
    D -= 8 * np.finfo(np.float32).eps * largest
    return np.sqrt(np.maximum(D, 0, out=D), out=D)


def _search_cells(queries, origin, cells, which):
    """Nearest row in the cells `which` for each query, by all pairs.

    Queries are relative to `origin`, a point near them, so that small distances are exact.

    Returns
    -------
    squared : float32 ndarray (q,)
        Squared distance.
    index : int ndarray (q,)
    """
    rows = np.concatenate([cells.rows[cells.start[c] : cells.start[c + 1]] for c in which])
    rows -= origin
    order = np.concatenate([cells.order[cells.start[c] : cells.start[c + 1]] for c in which])
    D = _squared_distances(queries, rows)  # (q, rows)
    column = D.argmin(axis=1)
    return D[np.arange(len(queries)), column], order[column]


def _search_pairs(queries, cells, selected, which):
    """Compare the query ``selected[i]``, sorted, with the rows of the cell ``which[i]``.

    Returns
    -------
    selected : int ndarray (w,)
        The queries, each once.
    squared : float32 ndarray (w,)
        Squared distance to the nearest row.
    index : int ndarray (w,)
    """
    size = cells.size[which]
    end = np.cumsum(size)
    row = np.arange(end[-1]) + np.repeat(cells.start[which] - (end - size), size)  # (pairs,)
    query, squared = np.repeat(selected, size), np.empty(len(row), np.float32)
    for i in range(0, len(row), PAIRS):
        difference = cells.rows[row[i : i + PAIRS]] - queries[query[i : i + PAIRS]]
        squared[i : i + PAIRS] = np.einsum("ij,ij->i", difference, difference)
    selected, head, count = np.unique(query, return_index=True, return_counts=True)
    least = np.minimum.reduceat(squared, head)
    nearest = squared == np.repeat(least, count)
    index = np.where(nearest, cells.order[row], np.iinfo(np.int64).max)
    return selected, least, np.minimum.reduceat(index, head)


def _update_nearest(best, index, selected, squared, new):
    """Update distances and indices of selected queries in place; ties keep the lower index."""
    closer = (squared < best[selected]) | ((squared == best[selected]) & (new < index[selected]))
    best[selected[closer]] = squared[closer]
    index[selected[closer]] = new[closer]


def nearest_of_few(Q: Array, D: Rows, cell_d: Array, *, block: int = 256) -> Array:
    """Return :func:`nearest_in_cells` for a few distant queries, such as one in every cell.

    If the bound excludes nothing, all pairs of a block are compared at once: 1 GB for 60,000
    unstructured rows.

    Parameters
    ----------
    Q : float ndarray (n, d)
    D : float ndarray (p, d)
    cell_d : int ndarray (p,)
    block : int
        Queries whose distances to all cells are in memory at once.

    Returns
    -------
    index : int ndarray (n,)
        Ties give the first row.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import nearest_of_few
    >>> rows = np.random.default_rng(0).normal(size=(300, 5))
    >>> bool((nearest_of_few(rows[:20], rows, np.arange(300) % 7) == np.arange(20)).all())
    True
    """
    middle = D.mean(axis=0)
    Q, cells = np.asarray(Q - middle, np.float32), into_cells(D, cell_d, middle)
    best, index = np.full(len(Q), np.inf, np.float32), np.full(len(Q), len(D))
    for i in range(0, len(Q), block):
        queries = np.arange(i, min(i + block, len(Q)))
        bound = _least_distances(Q[queries], cells.center)  # (block, cells)
        near = bound.argmin(axis=1)
        _update_nearest(best, index, *_search_pairs(Q, cells, queries, near))
        bound -= cells.radius  # no row of the cell is closer
        bound[np.arange(len(queries)), near] = np.inf
        possible = bound <= np.sqrt(best[queries])[:, None] * _SLACK
        row, which = np.divmod(np.flatnonzero(possible), len(cells.center))
        if len(row):
            _update_nearest(best, index, *_search_pairs(Q, cells, queries[row], which))
    return index


def nearest_in_cells(
    Q: Rows, cell_q: Array, D: Rows, cell_d: Array, *, n_initial: int = 12
) -> tuple[Array, float, float]:
    """Return the index of the nearest row of D for every row of Q, exact up to float32 rounding.

    Ties give one of the rows.

    Parameters
    ----------
    Q : float ndarray (n, d)
        Queries, for example U_T F_T.
    cell_q : int ndarray (n,)
        Cell (coarse vertex) of each query.
    D : float ndarray (p, d)
        Rows that are searched.
    cell_d : int ndarray (p,)
    n_initial : int
        Cells with the nearest centres, which are searched to compute the bound.

    Returns
    -------
    index : int ndarray (n,)
    compared : float
        Share of all pairs of rows that were compared; 1 is exhaustive search.
    certified : float
        Share of the queries for which the bound excluded all other cells.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import nearest_in_cells
    >>> rows = np.random.default_rng(0).normal(size=(300, 5))
    >>> index, _, _ = nearest_in_cells(rows, np.arange(300) % 10, rows, np.arange(300) % 7)
    >>> bool((index == np.arange(300)).all())
    True
    """
    middle = D.mean(axis=0)
    queries, cells = into_cells(Q, cell_q, middle), into_cells(D, cell_d, middle)
    index = np.empty(len(Q), np.int64)
    n_initial = min(n_initial, len(cells.center))
    size = cells.size
    compared = uncertified = 0
    for c, origin in enumerate(queries.center):
        if c % BLOCK == 0:
            distances = _least_distances(queries.center[c : c + BLOCK], cells.center)
        distance = distances[c % BLOCK]  # (cells,)
        cell = slice(queries.start[c], queries.start[c + 1])
        rows = queries.rows[cell] - origin  # (q, d)
        near = np.argpartition(distance, n_initial - 1)[:n_initial]
        best, nearest = _search_cells(rows, origin, cells, near)
        compared += len(rows) * size[near].sum()
        least = distance - queries.radius[c] - cells.radius  # the bound of the figure
        least[near] = np.inf
        selected, which = _not_excluded(rows, origin, cells, least, np.sqrt(best) * _SLACK)
        if len(which):
            squared, new = _search_cells(rows[selected], origin, cells, which)
            _update_nearest(best, nearest, selected, squared, new)
            compared += len(selected) * size[which].sum()
            uncertified += len(selected)
        index[queries.order[cell]] = nearest
    return index, float(compared) / (len(Q) * len(D)), 1 - float(uncertified) / len(Q)


def _not_excluded(rows, origin, cells, least, bound):
    """Queries that may have a row closer than their `bound`, and the cells that may contain it.

    `least` is the least distance of each cell to any query; the distance of each query to the
    centre excludes more.
    """
    which = np.flatnonzero(least <= bound.max())
    if len(which) == 0:
        return which, which
    distance = _least_distances(rows, cells.center[which] - origin)  # (q, cells)
    possible = distance - cells.radius[which] <= bound[:, None]
    return np.flatnonzero(possible.any(1)), which[possible.any(0)]
