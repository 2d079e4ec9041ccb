r"""KnnSearch: exact nearest neighbours at low (eq. 2, 3, 6) and at full resolution (eq. 4, 7).

At low resolution all rows are compared (:func:`nearest_rows`).  At full resolution the rows are U_i
F_i, with F_i = Phi_i Y_i (eq. 7) or Phi_i C^T (eq. 4), and go cell by cell, the cells being those
of the coarse vertices (:func:`nearest_in_cells`).  A query is first compared with the cells around
its own cell's nearest; the distance found bounds which other cells can hold anything nearer, and
exactly these are searched too::

      .---------.                          .---------.
     /   q       \           gap          /           \      no row of the cell b is nearer
    |      a------+----------------------+------b      |     to any query of the cell a than
     \           /                        \           /      gap - radius of a - radius of b
      '---------'                          '---------'
"""

from dataclasses import dataclass

import numpy as np

from s4a.geometry.mesh import counting_order
from s4a.schema import Array

BLOCK = 512  # cells of queries whose distances to all other cells are held at once
PAIRS = 2048  # pairs of rows at a time: their differences, 0.8 MB in 100 dims, stay in the cache
_AROUND = 128  # queries whose rows around are gathered at once, 1.6 MB of 32 in 100 dims
_SLACK = 1 + 1e-5  # factor on bounds, for what float32 iterations away


def nearest_rows(Q: Array, D: Array, *, block: int = 256) -> Array:
    """For every row of Q the index of the nearest row of D (Euclidean): KnnSearch of eq. 2, 3, 6.

    All are compared, by blocks of one matrix product each.  The product is of (q, -1) and
    (d, |d|^2 / 2), largest where the distance is least; its blocks stay in the cache.  float32
    first, which above about 20 dims is faster than a KD-tree; where it cannot tell two rows apart,
    float64 decides.  Of rows that are equally near the first is given.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import nearest_rows
    >>> nearest_rows(np.array([[0.1], [4.0]]), np.array([[0.0], [5.0]])).tolist()
    [0, 1]
    """
    q = as_queries(Q)
    d = as_candidates(D)
    longest = np.sqrt(2 * d[-1].max())
    length = np.linalg.norm(q[:, :-1], axis=1)
    rounding = 16 * np.finfo(np.float32).eps * longest * (length + longest)
    nearest = np.empty(len(q), np.int64)
    for start, score in _scores_in_blocks(q, d, block):
        best = score.argmax(axis=1)
        line = np.arange(len(best))
        least = score[line, best] - rounding[start : start + block]
        score[line, best] = -np.inf
        for i in np.flatnonzero(score.max(axis=1) >= least):  # where the second is as good
            score[i, best[i]] = np.inf
            close = np.flatnonzero(score[i] >= least[i])
            gap = D[close].astype(float) - Q[start + i]
            best[i] = close[np.einsum("ij,ij->i", gap, gap).argmin()]
        nearest[start : start + block] = best
    return nearest


def as_queries(Q: Array) -> Array:
    """(q, -1) for the rows of Q ``(n, d + 1)`` in single precision."""
    return np.column_stack([Q, np.full(len(Q), -1)]).astype(np.float32)


def as_candidates(D: Array) -> Array:
    """(d, |d|^2 / 2) for the rows of D, as columns ``(d + 1, p)`` in single precision."""
    d = np.asarray(D, np.float32)
    return np.ascontiguousarray(np.column_stack([d, np.einsum("ij,ij->i", d, d) / 2]).T)


def _scores_in_blocks(q, d, block=256):
    """The matrix product q d block by block: first row, and block; all in one array."""
    scores = np.empty((min(block, len(q)), d.shape[1]), np.float32)
    for start in range(0, len(q), block):
        part = q[start : start + block]
        yield start, np.matmul(part, d, out=scores[: len(part)])


def nearest_float32(q: Array, d: Array) -> Array:
    """:func:`nearest_rows` up to the rounding of single precision, for matrices made once.

    They are those of :func:`as_queries` and :func:`as_candidates`.
    """
    return np.concatenate([score.argmax(axis=1) for _, score in _scores_in_blocks(q, d)])


def nearest_bidirectional(q: Array, d: Array) -> tuple[Array, Array]:
    """For every row of q the nearest of d, and the other way, from one matrix product.

    The first as of :func:`nearest_float32`; of the second, d's term of the distance is the same for
    all rows of q, and q's is taken off each block.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import as_candidates, as_queries, nearest_bidirectional
    >>> Q, D = np.array([[0.1], [4.0]]), np.array([[0.0], [5.0], [0.3]])
    >>> [found.tolist() for found in nearest_bidirectional(as_queries(Q), as_candidates(D))]
    [[0, 1], [0, 1, 0]]
    """
    half = np.einsum("ij,ij->i", q[:, :-1], q[:, :-1]) / 2
    of_q, of_d = np.empty(len(q), np.int64), np.zeros(d.shape[1], np.int64)
    highest = np.full(d.shape[1], -np.inf, np.float32)
    column = np.arange(d.shape[1])
    for start, score in _scores_in_blocks(q, d):
        end = start + len(score)
        of_q[start:end] = score.argmax(axis=1)
        score -= half[start:end, None]
        best = score.argmax(axis=0)
        value = score[best, column]
        nearer = value > highest
        of_d[nearer], highest[nearer] = start + best[nearer], value[nearer]
    return of_q, of_d


def nearest_around(q: Array, rows: Array, near: Array) -> Array:
    """The nearest of a few rows, others for each query.

    Parameters
    ----------
    q : float32 ndarray (n, m + 1)
        As of :func:`as_queries`.
    rows : float32 ndarray (p, m + 1)
        As of :func:`as_candidates`, transposed.
    near : int ndarray (n, w)
        The rows that each query is compared with.

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
class Cells:
    """Rows sorted by cell: ``rows[start[c]:start[c + 1]]`` are those of cell c."""

    rows: Array  # (n, d) float32
    order: Array  # (n,) original index of each row
    start: Array  # (cells + 1,)
    center: Array  # (cells, d)
    radius: Array  # (cells,) greatest distance of a row to the centre

    @property
    def size(self) -> Array:
        """Number of rows of each cell."""
        return np.diff(self.start)


def into_cells(rows: Array, cell: Array) -> Cells:
    """Rows `(n, d)` grouped by their cell number `(n,)`; cells are those in use."""
    _, cell = np.unique(cell, return_inverse=True)
    count = np.bincount(cell)
    order = counting_order(cell, len(count))
    rows = np.asarray(rows, np.float32).take(order, axis=0)
    start = np.concatenate([[0], np.cumsum(count)])
    center = np.add.reduceat(rows, start[:-1], axis=0) / count[:, None].astype(np.float32)
    gap = np.linalg.norm(rows - np.repeat(center, count, axis=0), axis=1)  # (n,)
    return Cells(rows, order, start, center, np.maximum.reduceat(gap, start[:-1]) * _SLACK)


def _squared_distances(A, B):
    """All squared distances ``(a, b)`` of float32 rows by one matrix product."""
    D = A @ B.T
    D *= -2
    D += np.einsum("ij,ij->i", A, A)[:, None]
    D += np.einsum("ij,ij->i", B, B)[None, :]
    return np.maximum(D, 0, out=D)


def _least_distances(A, B):
    """Distances ``(a, b)`` of float32 rows, reduced by what rounding may have added."""
    D = _squared_distances(A, B)
    largest = np.einsum("ij,ij->i", A, A).max() + np.einsum("ij,ij->i", B, B).max()
    D -= 8 * np.finfo(np.float32).eps * largest
    return np.sqrt(np.maximum(D, 0, out=D), out=D)


def _search_cells(queries, origin, cells, which):
    """The nearest row of the cells `which` for each of `queries`, all compared with all.

    `queries` are relative to `origin`, a point near them, and the rows are made so: then small
    distances are exact.

    Returns
    -------
    gap : float32 ndarray (q,)
        Squared distance.
    index : int ndarray (q,)
    """
    rows = np.concatenate([cells.rows[cells.start[c] : cells.start[c + 1]] for c in which])
    rows -= origin
    order = np.concatenate([cells.order[cells.start[c] : cells.start[c + 1]] for c in which])
    D = _squared_distances(queries, rows)  # (q, rows)
    column = D.argmin(axis=1)
    return D[np.arange(len(queries)), column], order[column]


def _search_pairs(queries, cells, who, which):
    """Compare the query ``who[i]`` with the rows of the cell ``which[i]``; `who` is sorted.

    Returns
    -------
    who : int ndarray (w,)
        The queries, each once.
    gap : float32 ndarray (w,)
        Squared distance to the nearest row.
    index : int ndarray (w,)
    """
    size = cells.size[which]
    end = np.cumsum(size)
    row = np.arange(end[-1]) + np.repeat(cells.start[which] - (end - size), size)  # (pairs,)
    query, gap = np.repeat(who, size), np.empty(len(row), np.float32)
    for i in range(0, len(row), PAIRS):
        difference = cells.rows[row[i : i + PAIRS]] - queries[query[i : i + PAIRS]]
        gap[i : i + PAIRS] = np.einsum("ij,ij->i", difference, difference)
    who, head, count = np.unique(query, return_index=True, return_counts=True)
    least = np.minimum.reduceat(gap, head)
    nearest = gap == np.repeat(least, count)
    index = np.where(nearest, cells.order[row], np.iinfo(np.int64).max)
    return who, least, np.minimum.reduceat(index, head)


def _keep_nearer(best, index, who, gap, found):
    """Write in place what is nearer, or as near with a lower index, for the queries `who`."""
    nearer = (gap < best[who]) | ((gap == best[who]) & (found < index[who]))
    best[who[nearer]] = gap[nearer]
    index[who[nearer]] = found[nearer]


def nearest_of_few(Q: Array, D: Array, cell_d: Array, *, block: int = 256) -> Array:
    """:func:`nearest_in_cells` for queries that are few and far apart, as one in every cell.

    All at once, in pairs.  Where the bound leaves nothing out, all pairs of a block are compared: 1
    GB for 60,000 rows without any structure.

    Parameters
    ----------
    Q : float ndarray (n, d)
    D : float ndarray (p, d)
    cell_d : int ndarray (p,)
    block : int
        Queries whose distances to all cells are held at once.

    Returns
    -------
    index : int ndarray (n,)
        Of rows that are equally near the first.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import nearest_of_few
    >>> rows = np.random.default_rng(0).normal(size=(300, 5))
    >>> bool((nearest_of_few(rows[:20], rows, np.arange(300) % 7) == np.arange(20)).all())
    True
    """
    middle = np.mean(D, axis=0)
    Q, cells = np.asarray(Q - middle, np.float32), into_cells(D - middle, cell_d)
    best, index = np.full(len(Q), np.inf, np.float32), np.full(len(Q), len(D))
    for i in range(0, len(Q), block):
        who = np.arange(i, min(i + block, len(Q)))
        gap = _least_distances(Q[who], cells.center)  # (block, cells)
        near = gap.argmin(axis=1)
        _keep_nearer(best, index, *_search_pairs(Q, cells, who, near))
        gap -= cells.radius  # no row of the cell is nearer
        gap[np.arange(len(who)), near] = np.inf
        reached = gap <= np.sqrt(best[who])[:, None] * _SLACK
        at, which = np.divmod(np.flatnonzero(reached), len(cells.center))
        if len(at):
            _keep_nearer(best, index, *_search_pairs(Q, cells, who[at], which))
    return index


def nearest_in_cells(
    Q: Array, cell_q: Array, D: Array, cell_d: Array, *, first: int = 12
) -> tuple[Array, float, float]:
    """For every row of Q the index of the nearest row of D, exactly up to float32 rounding.

    Where several rows are equally near, one of them is given.

    Parameters
    ----------
    Q : float ndarray (n, d)
        Queries, for example U_T F_T.
    cell_q : int ndarray (n,)
        Cell (coarse vertex) of each query.
    D : float ndarray (p, d)
        Rows that are searched.
    cell_d : int ndarray (p,)
    first : int
        Cells around the nearest cell centre that are searched before any bound is known.

    Returns
    -------
    index : int ndarray (n,)
    compared : float
        Share of all comparisons of rows that had to be made; 1 would be exhaustive search.
    certified : float
        Share of the queries whose answer in the `first` cells the bound certified; the others were
        compared with every cell that could hold a nearer row.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.nearest import nearest_in_cells
    >>> rows = np.random.default_rng(0).normal(size=(300, 5))
    >>> index, _, _ = nearest_in_cells(rows, np.arange(300) % 10, rows, np.arange(300) % 7)
    >>> bool((index == np.arange(300)).all())
    True
    """
    middle = np.mean(D, axis=0)
    queries, cells = into_cells(Q - middle, cell_q), into_cells(D - middle, cell_d)
    index = np.empty(len(Q), np.int64)
    first = min(first, len(cells.center))
    size = cells.size
    compared = unsure = 0
    for c, origin in enumerate(queries.center):
        if c % BLOCK == 0:
            gaps = _least_distances(queries.center[c : c + BLOCK], cells.center)
        gap = gaps[c % BLOCK]  # (cells,)
        here = slice(queries.start[c], queries.start[c + 1])
        rows = queries.rows[here] - origin  # (q, d)
        near = np.argpartition(gap, first - 1)[:first]
        best, found = _search_cells(rows, origin, cells, near)
        compared += len(rows) * size[near].sum()
        reach = gap - queries.radius[c] - cells.radius  # the bound of the figure
        reach[near] = np.inf
        who, which = _not_excluded(rows, origin, cells, reach, np.sqrt(best) * _SLACK)
        if len(which):
            _keep_nearer(best, found, who, *_search_cells(rows[who], origin, cells, which))
            compared += len(who) * size[which].sum()
            unsure += len(who)
        index[queries.order[here]] = found
    return index, float(compared) / (len(Q) * len(D)), 1 - float(unsure) / len(Q)


def _not_excluded(rows, origin, cells, reach, bound):
    """Queries for which a row nearer than their `bound` is possible, and the cells it can be in.

    `reach` is the least distance of each cell to any query; each query's own distance to the centre
    excludes more.
    """
    which = np.flatnonzero(reach <= bound.max())
    if len(which) == 0:
        return which, which
    gap = _least_distances(rows, cells.center[which] - origin)  # (q, cells)
    possible = gap - cells.radius[which] <= bound[:, None]
    return np.flatnonzero(possible.any(1)), which[possible.any(0)]
