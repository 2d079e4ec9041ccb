"""Bilateral pairs (6.1): partners of the template's vertices, and the symmetrised template.

The mirror image of the template is registered to the template.  This gives the point tau(v) of the
surface that is the partner of vertex v on the other side.
"""

import logging
from typing import NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.closest import closest_facing_point, interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas, vertex_normals
from s4a.input.chirality import MIRROR, mirror_image
from s4a.method.shape import Shape
from s4a.options import Options
from s4a.schema import dataset, in_unit, require, unit_of
from s4a.study.pair import match_shapes, shape_of

log = logging.getLogger(__name__)

ITERATIONS = 5  # of the consensus, and of the involution
# Error of the involution, as a share of sqrt(area), above which the template may be asymmetric
FAR = 0.05


class Mirror(NamedTuple):
    """A plane of reflection: x -> x - 2 normal (normal . (x - center))."""

    center: np.ndarray
    normal: np.ndarray

    def __call__(self, X: np.ndarray) -> np.ndarray:
        """Reflect points ``(..., 3)``."""
        return X - 2 * ((X - self.center) @ self.normal)[..., None] * self.normal

    def reflected(self, vectors: np.ndarray) -> np.ndarray:
        """Reflect vectors ``(..., 3)``."""
        return vectors - 2 * (vectors @ self.normal)[..., None] * self.normal


def plane_between(X: np.ndarray, Y: np.ndarray, area: np.ndarray) -> Mirror:
    """Return the plane whose reflection M best maps points Y to X ``(n, 3)``, weighted by area.

    |x - M y|^2 = |x - y|^2 + 4 (n . x)(n . y) about the common centre.  The normal n is therefore
    the eigenvector of the smallest eigenvalue of the symmetric part of sum w x y^T.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.bilateral_pairs import plane_between
    >>> X = np.array([[1.0, 0, 0], [2, 1, 0], [3, 0, 4]])
    >>> abs(plane_between(X, X * [-1, 1, 1], np.ones(3)).normal).round(6).tolist()
    [1.0, 0.0, 0.0]
    """
    weight = area / area.sum()
    center = weight @ (X + Y) / 2
    products = ((X - center) * weight[:, None]).T @ (Y - center)
    return Mirror(center, np.linalg.eigh(products + products.T)[1][:, 0])


def symmetry(study: xr.DataTree) -> xr.Dataset:
    """Match each vertex of the template to its partner on the other side.

    The mirror image of the template is registered to the template, as a single pair
    (:func:`s4a.match_pair`) with the options of the study.  The map is then made an involution
    iteratively: half of the reflected error e = v - tau(tau(v)) is added to tau(v).

    Parameters
    ----------
    study : DataTree
        With ``/registration``.

    Returns
    -------
    Dataset
        ``partner_triangle(vertex)`` and ``partner_barycentric(vertex, corner)``, the point tau(v);
        ``partner_distance(vertex)``, the remaining distance of tau(tau(v)) and v, in the unit of
        the input.  Attributes: ``involution_error``, its root mean square over the area as a share
        of sqrt(area); ``involution_error_before``, the same before the iterations; and
        ``registration_error`` of the registration.

    See Also
    --------
    s4a_morphometrics.asymmetry : asymmetry of every shape.
    symmetric_template : the template averaged with its mirror image.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> partners = s4a_morphometrics.symmetry(study)
    >>> error, before = (partners.attrs[f"involution_error{when}"] for when in ("", "_before"))
    >>> partners["partner_triangle"].dims, error < before
    (('vertex',), True)
    """
    registration = registration_of(study)
    require(registration, "position", "corner_vertex", what="registration")
    X, T = as_arrays(registration)
    options = Options.from_report(study)
    name = registration.attrs.get("template", "")
    if "coarse" in study.children and name in study["coarse"].children:
        low = study["coarse"][name].to_dataset().load()
        mesh = study["original"][name].to_dataset().load()
        template = Shape(mesh, low, **options.of("projection"))
        image = Shape(mirror_image(mesh), mirror_image(low), **options.of("projection"))
    else:
        mesh = as_dataset(X, T)
        template, image = shape_of(mesh, options), shape_of(mirror_image(mesh), options)
    registered = match_shapes(image, template, options)[0]
    P = image_in_shape(X, registered) * MIRROR  # (n, 3), the partner of each vertex
    points, before, after = involution(P, X, T)
    area = vertex_areas(X, T)
    size = float(np.sqrt(area.sum()))
    attrs = {
        "involution_error": rms(after, area) / size,
        "involution_error_before": rms(before, area) / size,
        "registration_error": float(registered.attrs["score"]),
    }
    if max(attrs["involution_error"], attrs["registration_error"]) > FAR:
        log.warning(
            "the template and its mirror image differ (registration error %.3f, involution error "
            "%.3f of sqrt(area)): is the template symmetric? For left and right shapes, give "
            "subject and side",
            attrs["registration_error"],
            attrs["involution_error"],
        )
    result = dataset(attrs, partner_triangle=points[0], partner_barycentric=points[1])
    result = result.merge(dataset(partner_distance=after))
    return in_unit(result, unit_of(registration["position"]))


def symmetric_template(study: xr.DataTree, partners: xr.Dataset | None = None) -> xr.Dataset:
    """Average the template with its mirror image, each vertex with its partner.

    With M the best reflection, the vertices are (x(v) + M x(tau(v))) / 2, on the triangles of the
    template.  The mean of all shapes and their mirror images is ``symmetric_position`` of
    :func:`s4a_morphometrics.asymmetry`.

    Parameters
    ----------
    study : DataTree
        With ``/registration``.
    partners : Dataset, optional
        From :func:`symmetry`; computed by default.

    Returns
    -------
    Dataset
        ``position(vertex, xyz)`` in the unit of the input, ``corner_vertex(triangle, corner)``.
        Attributes: ``moved``, root mean square distance from the template as a share of sqrt(area);
        ``involution_error`` of :func:`symmetry`, which is the remaining asymmetry.

    See Also
    --------
    s4a.write_mesh : writes the mesh to a file.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> mesh = s4a_morphometrics.symmetric_template(study)
    >>> mesh["position"].dims, 0 < mesh.attrs["moved"] < 0.1
    (('vertex', 'xyz'), True)
    """
    registration = registration_of(study)
    partners = symmetry(study) if partners is None else partners
    require(partners, "partner_triangle", "partner_barycentric", what="symmetry")
    X, T = as_arrays(registration)
    area = vertex_areas(X, T)
    points = partners["partner_triangle"].values, partners["partner_barycentric"].values
    X_partner = interpolate(X, T, *points)
    S = (X + plane_between(X, X_partner, area)(X_partner)) / 2
    moved = rms(np.linalg.norm(S - X, axis=1), area) / float(np.sqrt(area.sum()))
    error = partners.attrs.get("involution_error", np.nan)
    attrs = {"moved": moved, "involution_error": error}
    return in_unit(as_dataset(S, T, attrs), unit_of(registration["position"]))


def rms(values: np.ndarray, area: np.ndarray) -> float:
    """Return the area-weighted root mean square of values ``(n,)``."""
    return float(np.sqrt(area @ values**2 / area.sum()))


def involution(
    P: np.ndarray, X: np.ndarray, T: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Make a map of vertices to points P ``(n, 3)`` on the other side an involution tau.

    Returns
    -------
    points : tuple
        Triangle ``(n,)`` and barycentric weights ``(n, 3)`` of tau(v) on the surface.
    before, after : float ndarray (n,)
        Distance of tau(tau(v)) and v, for the points nearest to P, and finally.
    """
    area = vertex_areas(X, T)
    N = vertex_normals(X, T)

    def on_surface(positions):
        plane = plane_between(X, positions, area)
        return closest_facing_point(positions, plane.reflected(N), X, T), plane

    points, plane = on_surface(P)
    distances = []
    best = points
    for _ in range(ITERATIONS):
        X_partner = interpolate(X, T, *points)
        e = X - interpolate(X_partner, T, *points)  # v - tau(tau(v))
        distances.append(np.linalg.norm(e, axis=1))
        if rms(distances[-1], area) <= min(rms(distance, area) for distance in distances):
            best = points
        points, plane = on_surface(X_partner + plane.reflected(e) / 2)
    smallest = min(distances, key=lambda distance: rms(distance, area))
    return best, distances[0], smallest
