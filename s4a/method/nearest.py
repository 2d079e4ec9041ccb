"""Exact nearest neighbours between projected bases (eq. 4 and 7).

Coarse to fine over the cells of the coarse meshes.

The rows compared are U_i F_i, F_i = Phi_i Y_i (eq. 7) or Phi_i C^T (eq. 4).  A query is first
compared with the cells around its coarse vertex's own nearest neighbour; the distance found bounds
which other cells can hold anything nearer, by the triangle inequality on cell centres and radii,
and exactly these are searched too.
"""

from dataclasses import dataclass

import numpy as np

BLOCK = 512  # cells of queries whose distances to all other cells are held at once
PAIRS = 2048  # of rows, whose differences stay in the cache


@dataclass(frozen=True)
class Cells:
    """Rows sorted by cell: ``rows[start[c]:start[c + 1]]`` are those of cell c.

    ``order`` their original indices.
    """

    rows: np.ndarray
    order: np.ndarray
    start: np.ndarray
    center: np.ndarray
    radius: np.ndarray


def into_cells(rows, cell):
    """Rows `(n, d)` grouped by their cell number `(n,)`.

    With the centre and radius of every cell in use.
    """
    _, cell = np.unique(cell, return_inverse=True)
    order = np.argsort(cell, kind="stable")
    rows = np.ascontiguousarray(rows[order], np.float32)
    count = np.bincount(cell)
    start = np.concatenate([[0], np.cumsum(count)])
    center = np.add.reduceat(rows, start[:-1], axis=0) / count[:, None].astype(np.float32)
    gap = np.linalg.norm(rows - np.repeat(center, count, axis=0), axis=1)
    return Cells(
        rows, order, start, center, np.maximum.reduceat(gap, start[:-1]) * np.float32(1 + 1e-5)
    )


def squared_distances(A, B):
    """All squared distances ``(a, b)`` of float32 rows by one matrix product."""
    D = A @ B.T
    D *= -2
    D += np.einsum("ij,ij->i", A, A)[:, None]
    D += np.einsum("ij,ij->i", B, B)[None, :]
    return np.maximum(D, 0, out=D)


def search(queries, origin, cells, which, best, index):
    """Compare `queries` with the rows of the cells `which`.

    Update their best squared distances and indices in place.

    `queries` are relative to `origin`, a point near them, and the rows are made so: then small
    distances are exact.
    """
    rows = np.concatenate([cells.rows[cells.start[c] : cells.start[c + 1]] for c in which])
    rows -= origin
    numbers = np.concatenate([cells.order[cells.start[c] : cells.start[c + 1]] for c in which])
    D = squared_distances(queries, rows)
    column = D.argmin(axis=1)
    gap, found = D[np.arange(len(queries)), column], numbers[column]
    nearer = (gap < best) | ((gap == best) & (found < index))
    best[nearer], index[nearer] = gap[nearer], found[nearer]


def least_distances(A, B):
    """Distances ``(a, b)`` of float32 rows, reduced by what rounding may have added."""
    D = squared_distances(A, B)
    largest = np.einsum("ij,ij->i", A, A).max() + np.einsum("ij,ij->i", B, B).max()
    D -= 8 * np.finfo(np.float32).eps * largest
    return np.sqrt(np.maximum(D, 0, out=D), out=D)


def compare_pairs(queries, cells, who, which, best, index):
    """Compare the query ``who[i]`` with the rows of the cell ``which[i]``.

    Update `best` and `index` in place.

    `who` is sorted.
    """
    size = (cells.start[1:] - cells.start[:-1])[which]
    end = np.cumsum(size)
    row = np.arange(end[-1]) + np.repeat(cells.start[which] - (end - size), size)
    query, gap = np.repeat(who, size), np.empty(len(row), np.float32)
    for i in range(0, len(row), PAIRS):
        difference = cells.rows[row[i : i + PAIRS]] - queries[query[i : i + PAIRS]]
        gap[i : i + PAIRS] = np.einsum("ij,ij->i", difference, difference)
    who, head, count = np.unique(query, return_index=True, return_counts=True)
    least = np.minimum.reduceat(gap, head)
    hit = np.flatnonzero(gap == np.repeat(least, count))
    found = np.full(len(queries), np.iinfo(np.int64).max)
    np.minimum.at(found, query[hit], cells.order[row[hit]])
    nearer = (least < best[who]) | ((least == best[who]) & (found[who] < index[who]))
    best[who[nearer]], index[who[nearer]] = least[nearer], found[who[nearer]]


def nearest_of_few(Q, D, cell_d, *, block=256):
    """:func:`nearest_in_cells` for queries that are few and far apart, as one in every cell.

    All at once, in pairs.

    For the vertices of a coarse mesh among all of 60,000 or 150,000, 100 dims, it takes 0.3 to 0.45
    of the time.  Where the bound leaves nothing out, all pairs of a block are compared at once: 1
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
        gap = least_distances(Q[who], cells.center)
        near = gap.argmin(axis=1)
        compare_pairs(Q, cells, who, near, best, index)
        gap -= cells.radius  # no row of the cell is nearer
        gap[np.arange(len(who)), near] = np.inf
        reached = gap <= np.sqrt(best[who])[:, None] * np.float32(1 + 1e-5)
        at, which = np.divmod(np.flatnonzero(reached), len(cells.center))
        if len(at):
            compare_pairs(Q, cells, who[at], which, best, index)
    return index


def nearest_in_cells(Q, cell_q, D, cell_d, *, first=12):
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
    >>> index, compared, certified = nearest_in_cells(rows, np.arange(300) % 10, rows, np.arange(300) % 7)
    >>> bool((index == np.arange(300)).all())
    True
    """
    middle = np.mean(D, axis=0)
    queries, cells = into_cells(Q - middle, cell_q), into_cells(D - middle, cell_d)
    index = np.empty(len(Q), np.int64)
    first = min(first, len(cells.center))
    size = np.diff(cells.start)
    compared = unsure = 0
    for c, origin in enumerate(queries.center):
        if c % BLOCK == 0:
            gaps = least_distances(queries.center[c : c + BLOCK], cells.center)
        gap = gaps[c % BLOCK]
        rows = queries.rows[queries.start[c] : queries.start[c + 1]] - origin
        best, found = np.full(len(rows), np.inf, np.float32), np.full(len(rows), len(D))
        near = np.argpartition(gap, first - 1)[:first]
        search(rows, origin, cells, near, best, found)
        compared += len(rows) * size[near].sum()
        bound = np.sqrt(best) * (1 + 1e-5)
        reach = (
            gap - queries.radius[c] - cells.radius
        )  # no row of the cell is nearer to any query of this one
        reach[near] = np.inf
        open_cells = np.flatnonzero(reach <= bound.max())
        if len(open_cells):
            possible = (
                least_distances(rows, cells.center[open_cells] - origin) - cells.radius[open_cells]
                <= bound[:, None]
            )
            who, which = possible.any(1), open_cells[possible.any(0)]
            if len(which):
                part_best, part_found = best[who], found[who]
                search(rows[who], origin, cells, which, part_best, part_found)
                compared += who.sum() * size[which].sum()
                unsure += who.sum()
                found[who] = part_found
        index[queries.order[queries.start[c] : queries.start[c + 1]]] = found
    return index, float(compared) / (len(Q) * len(D)), 1 - float(unsure) / len(Q)


def nearest_rows(Q: np.ndarray, D: np.ndarray, *, block: int = 256) -> np.ndarray:
    """For every row of Q the index of the nearest row of D (Euclidean): KnnSearch of eq. 2, 3, 6.

    All are compared, by blocks of one matrix product each.  The product is of (q, -1) and
    (d, |d|^2 / 2), largest where the distance is least; its blocks stay in the cache.  float32
    first, which above about 20 dims is faster than a KD-tree; where it cannot tell two rows apart,
    float64 decides.  Of rows that are equally near the first is given.

    Examples
    --------
    >>> nearest_rows(np.array([[0.1], [4.0]]), np.array([[0.0], [5.0]])).tolist()
    [0, 1]
    """
    q = rows_with_minus_one(Q)
    d = columns_with_norm(D)
    longest = np.sqrt(2 * d[-1].max())
    length = np.linalg.norm(q[:, :-1], axis=1)
    rounding = 16 * np.finfo(np.float32).eps * longest * (length + longest)
    nearest = np.empty(len(q), np.int64)
    for start, score in scores_in_blocks(q, d, block):
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


def rows_with_minus_one(Q: np.ndarray) -> np.ndarray:
    """(q, -1) for the rows of Q ``(n, d + 1)`` in single precision."""
    return np.column_stack([Q, np.full(len(Q), -1)]).astype(np.float32)


def columns_with_norm(D: np.ndarray) -> np.ndarray:
    """(d, |d|^2 / 2) for the rows of D, as columns ``(d + 1, p)`` in single precision."""
    d = np.asarray(D, np.float32)
    return np.ascontiguousarray(np.column_stack([d, np.einsum("ij,ij->i", d, d) / 2]).T)


def scores_in_blocks(q: np.ndarray, d: np.ndarray, block: int = 256):
    """The matrix product q d block by block: first row, and block; all in one array."""
    scores = np.empty((min(block, len(q)), d.shape[1]), np.float32)
    for start in range(0, len(q), block):
        part = q[start : start + block]
        yield start, np.matmul(part, d, out=scores[: len(part)])


def nearest_in_single(q: np.ndarray, d: np.ndarray) -> np.ndarray:
    """:func:`nearest_rows` up to the rounding of single precision, for matrices made once.

    They are those of :func:`rows_with_minus_one` and :func:`columns_with_norm`.
    """
    return np.concatenate([score.argmax(axis=1) for _, score in scores_in_blocks(q, d)])
