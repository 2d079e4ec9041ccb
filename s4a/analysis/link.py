"""Links between a template and a shape (6.2).

Where every vertex and point of one lies on the other.

Down a link, from the template to the shape, every vertex of the shape takes the values at the
closest point of the deformed template; up, every vertex of the template takes those at the closest
point of the shape.  A route is a chain of links with their directions.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from s4a.geometry.closest import closest_facing_point, interpolate, interpolation_matrix
from s4a.geometry.mesh import as_arrays, vertex_normals


@dataclass(frozen=True)
class Link:
    """One registration: template ``X, T``, shape ``Y, S``.

    The registered template ``image`` in the shape's frame.

    ``confidence (n,)`` on the template's vertices; ``triangle (p,)`` and ``weights (p, 3)`` of the
    shape's vertices on the template.
    """

    X: np.ndarray
    T: np.ndarray
    Y: np.ndarray
    S: np.ndarray
    image: np.ndarray
    confidence: np.ndarray
    triangle: np.ndarray
    weights: np.ndarray

    @cached_property
    def down(self):
        """Matrix from the template's vertices to the shape's, and its confidence on the shape."""
        W = interpolation_matrix(self.T, self.triangle, self.weights, len(self.X))
        return W, W @ self.confidence

    @cached_property
    def up(self):
        """Matrix from the shape's vertices to the template's.

        And its confidence on the template.
        """
        found = closest_facing_point(self.image, vertex_normals(self.image, self.T), self.Y, self.S)
        return interpolation_matrix(self.S, *found, len(self.Y)), self.confidence

    def point_down(self, triangle, weights):
        """Points on the template -> triangle and weights of their places on the shape.

        And confidence.
        """
        P, N, confidence = (
            interpolate(values, self.T, triangle, weights)
            for values in (self.image, vertex_normals(self.image, self.T), self.confidence[:, None])
        )
        return *closest_facing_point(P, N, self.Y, self.S), confidence[:, 0]

    def point_up(self, triangle, weights):
        """Points on the shape -> triangle and weights of their places on the template.

        And confidence.
        """
        P, N = (
            interpolate(values, self.S, triangle, weights)
            for values in (self.Y, vertex_normals(self.Y, self.S))
        )
        found = closest_facing_point(P, N, self.image, self.T)
        return *found, interpolate(self.confidence[:, None], self.T, *found)[:, 0]


def link(template, shape, registered):
    """The :class:`Link` of a shape from the mesh of the template, its own.

    And its part of ``/registration``.
    """
    (X, T), (Y, S) = as_arrays(template), as_arrays(shape)
    R, t, s = (registered[name].values for name in ("rotation", "translation", "scale"))
    image = (X + registered["displacement"].values - t) @ R / s
    return Link(
        X,
        T,
        Y,
        S,
        image,
        *(
            registered[n].values
            for n in ("confidence", "template_triangle", "template_barycentric")
        ),
    )


def along(route):
    """Matrix of a route from the values on its first mesh to those on its last.

    And the confidence on the last.
    """
    W, confidence = None, None
    for step, way in route:
        V, c = getattr(step, way)
        W, confidence = (V, c) if W is None else (V @ W, c * (V @ confidence))
    return W, confidence


def point_along(route, triangle, weights):
    """Places on the last mesh of points on the first: triangle, weights and confidence."""
    confidence = np.ones(len(triangle))
    for step, way in route:
        triangle, weights, c = getattr(step, f"point_{way}")(triangle, weights)
        confidence = confidence * c
    return triangle, weights, confidence


def blended(routes):
    """The mean of several routes, weighted by their confidence at every vertex.

    Matrix, and mean confidence.
    """
    parts = [along(route) for route in routes]
    weight = np.stack([c for _, c in parts]) + 1e-9
    weight /= weight.sum(0)
    W = sum(sp.diags(w) @ V for w, (V, _) in zip(weight, parts, strict=True))
    return W.tocsr(), np.mean([c for _, c in parts], axis=0)


def elect(W, label):
    """Votes of the source's vertices for a label at every target vertex.

    Parameters
    ----------
    W : sparse matrix (p, n)
        Rows sum to 1.
    label : ndarray (n,)

    Returns
    -------
    winner : ndarray (p,), the label with most votes; the first in sorted order among equals
    vote : float32 ndarray (p, l)
    value : ndarray (l,), the labels, sorted

    Examples
    --------
    >>> import numpy as np
    >>> import scipy.sparse as sp
    >>> from s4a.analysis.link import elect
    >>> elect(sp.csr_matrix([[0.5, 0.2, 0.3]]), np.array([4, 7, 7]))[0].tolist()
    [4]
    """
    value, code = np.unique(label, return_inverse=True)
    one_hot = sp.csr_matrix(
        (np.ones(len(code), np.float32), (np.arange(len(code)), code)), (len(code), len(value))
    )
    vote = (W @ one_hot).toarray().astype(np.float32)
    return value[vote.round(6).argmax(1)], vote, value
