"""Holes of a surface closed by fans of triangles, for those who want it closed (4.1, the input)."""

import numpy as np

from s4a.geometry.mesh import components, directed_edges


def close_holes(X, T):
    """Every boundary loop of an oriented manifold closed by a fan around a new vertex at its middle.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)

    Returns
    -------
    X : float ndarray (n + h, 3)
        A vertex for each of h loops is appended, at the mean of the loop weighted by the length of
        its edges.
    T : int ndarray (m + b, 3)
        A triangle for each of b boundary edges is appended.
    nearby : int ndarray (h,)
        A vertex of each loop.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.holes import close_holes
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> X, T, nearby = close_holes(X, np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    >>> X[4].round(2).tolist(), T[3:].tolist(), nearby.tolist()
    ([0.35, 0.35, 0.0], [[1, 0, 4], [2, 1, 4], [0, 2, 4]], [0])
    """
    E, n = directed_edges(T), len(X)
    E = E[~np.isin(E @ [n, 1], E[:, ::-1] @ [n, 1])]
    rim, ends = np.unique(E, return_inverse=True)
    ends = ends.reshape(-1, 2)
    loop = components(ends, len(rim))
    of, h = loop[ends[:, 0]], loop.max(initial=-1) + 1
    length = np.linalg.norm(X[E[:, 0]] - X[E[:, 1]], axis=1)
    weight = length / np.bincount(of, length, h)[of] if len(E) else length
    middle = np.stack([np.bincount(of, weight * X[E, i].mean(1), h) for i in range(3)], axis=1)
    fans = np.column_stack([E[:, 1], E[:, 0], n + of])
    nearby = np.full(h, n)
    np.minimum.at(nearby, of, E[:, 0])
    return np.concatenate([X, middle]), np.concatenate([T, fans]), nearby
