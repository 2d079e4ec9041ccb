"""Links between a template and a shape (6.2): where every vertex and point of one is on the other.

Down a link, from the template to the shape, every vertex of the shape takes the values at the
closest point of the deformed template; up, every vertex of the template takes those at the closest
point of the shape.  A route is a list of links with their directions:

    source shape --up--> template --down--> target shape
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import xarray as xr
from scipy.sparse.linalg import cg

from s4a.geometry.closest import closest_facing_point, interpolate, interpolation_matrix
from s4a.geometry.mesh import as_arrays, stiffness, vertex_areas, vertex_normals
from s4a.method.remesh import laplacian

# Triangle (p,) and barycentric weights (p, 3) of points on a surface, and how sure they are (p,).
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Link:
    """One registration: a template ``X, T``, a shape ``Y, S``, and where one is on the other.

    ``image (n, 3)`` is the registered template in the shape's frame, ``confidence (n,)`` that of
    its vertices; ``triangle (p,)`` and ``weights (p, 3)`` are the places of the shape's vertices on
    the template.
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
    def down(self) -> tuple[sp.csr_matrix, np.ndarray]:
        """Matrix ``(p, n)`` of values from template to shape, and confidence on the shape."""
        W = interpolation_matrix(self.T, self.triangle, self.weights, len(self.X))
        return W, W @ self.confidence

    @cached_property
    def up(self) -> tuple[sp.csr_matrix, np.ndarray]:
        """Matrix ``(n, p)`` of values from shape to template, and confidence on the template."""
        normals = vertex_normals(self.image, self.T)
        place = closest_facing_point(self.image, normals, self.Y, self.S)
        return interpolation_matrix(self.S, *place, len(self.Y)), self.confidence

    def carry_down(self, triangle: np.ndarray, weights: np.ndarray) -> Places:
        """Places on the shape of points on the template."""
        place = (self.T, triangle, weights)
        P = interpolate(self.image, *place)
        N = interpolate(vertex_normals(self.image, self.T), *place)
        confidence = interpolate(self.confidence[:, None], *place)[:, 0]
        return *closest_facing_point(P, N, self.Y, self.S), confidence

    def carry_up(self, triangle: np.ndarray, weights: np.ndarray) -> Places:
        """Places on the template of points on the shape."""
        P = interpolate(self.Y, self.S, triangle, weights)
        N = interpolate(vertex_normals(self.Y, self.S), self.S, triangle, weights)
        place = closest_facing_point(P, N, self.image, self.T)
        return *place, interpolate(self.confidence[:, None], self.T, *place)[:, 0]


Route = list[tuple[Link, str]]  # ends with "down" or "up"


def image_in_shape(X: np.ndarray, registered: xr.Dataset) -> np.ndarray:
    """Positions ``(n, 3)`` of the registered template where the file of the shape has the shape.

    `registered` is the shape's part of ``/registration``, x -> s R x + t its way to the template.
    """
    R, t, s = (registered[name].values for name in ("rotation", "translation", "scale"))
    return (X + registered["displacement"].values - t) @ R / s


def link(template: xr.Dataset, shape: xr.Dataset, registered: xr.Dataset) -> Link:
    """The :class:`Link` of two meshes, by the shape's part of ``/registration``."""
    X, T = as_arrays(template)
    Y, S = as_arrays(shape)
    names = ("confidence", "template_triangle", "template_barycentric")
    return Link(X, T, Y, S, image_in_shape(X, registered), *(registered[n].values for n in names))


def matrix_along(route: Route, n: int) -> tuple[sp.csr_matrix, np.ndarray]:
    """Matrix and confidence of a route.

    The matrix goes from values on its first mesh, of n vertices, to those on its last, where the
    confidence is.
    """
    if not route:
        return sp.identity(n, format="csr"), np.ones(n)
    steps = [getattr(step, way) for step, way in route]
    W, confidence = steps[0]
    for V, own in steps[1:]:
        W = V @ W
        confidence = own * (V @ confidence)
    return W, confidence


def carry_along(route: Route, triangle: np.ndarray, weights: np.ndarray) -> Places:
    """Places on the last mesh of points on the first."""
    confidence = np.ones(len(triangle))
    for step, way in route:
        triangle, weights, own = getattr(step, f"carry_{way}")(triangle, weights)
        confidence = confidence * own
    return triangle, weights, confidence


def blend_routes(routes: list[Route], n: int) -> tuple[sp.csr_matrix, np.ndarray]:
    """The mean of several routes, weighted by their confidence at every vertex.

    Matrix ``(p, n)``, and mean confidence ``(p,)``.
    """
    matrices, confidences = zip(*(matrix_along(route, n) for route in routes), strict=True)
    weight = np.stack(confidences) + 1e-9  # (routes, p), no zero in the sum below
    weight /= weight.sum(0)
    W = sum(sp.diags(w) @ V for w, V in zip(weight, matrices, strict=True))
    return W.tocsr(), np.mean(confidences, axis=0)


def votes_of(W: sp.csr_matrix, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Votes of the source's vertices for every label at every target vertex.

    Parameters
    ----------
    W : sparse matrix (p, n)
        Rows sum to 1.
    label : ndarray (n,)

    Returns
    -------
    vote : float32 ndarray (p, l)
    value : ndarray (l,), the labels, sorted
    """
    value, code = np.unique(label, return_inverse=True)
    one_hot = sp.csr_matrix((np.ones(len(code), np.float32), code, np.arange(len(code) + 1)))
    return (W @ one_hot).toarray().astype(np.float32), value


def spread_votes(vote: np.ndarray, X: np.ndarray, T: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Votes after a short step of heat: (A + W) v = A v0, W stiffness with t = area radius^2 / 4.

    What votes at a vertex votes around it, too, as far as its match may be wrong; A has the areas
    of the vertices.  The kernel of one implicit step has a mean squared radius of 4 t in the plane.

    Parameters
    ----------
    vote : float32 ndarray (p, l)
    X, T : ndarray (p, 3), (q, 3)
        The target.
    radius : ndarray (p,)
        Root of the mean squared radius, as a share of sqrt(area).

    Returns
    -------
    float32 ndarray (p, l)
        Rows sum to 1.
    """
    E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
    t = area.sum() * radius**2 / 4
    # edges between obtuse corners, whose weights are negative, would make votes so
    W = stiffness(E, np.maximum(w, 0) * t[E].mean(axis=1), len(X))
    system = sp.diags(area) + W  # (p, p), positive definite
    jacobi = sp.diags(1 / system.diagonal())
    spread = vote.copy()
    for column in spread.T:
        v = column.astype(float)
        column[:] = cg(system, area * v, x0=v, rtol=1e-5, M=jacobi)[0]
    np.clip(spread, 0, 1, out=spread)  # as conjugate gradients are exact to 1e-5
    spread /= spread.sum(axis=1, keepdims=True)
    return spread


def elect(vote: np.ndarray, value: np.ndarray) -> np.ndarray:
    """The label with most votes at every vertex; the first in sorted order among equals.

    Examples
    --------
    >>> import numpy as np
    >>> import scipy.sparse as sp
    >>> from s4a.analysis.link import elect, votes_of
    >>> elect(*votes_of(sp.csr_matrix([[0.5, 0.2, 0.3]]), np.array([4, 7, 7]))).tolist()
    [4]
    """
    return value[vote.round(6).argmax(1)]  # equal votes are equal to six digits
