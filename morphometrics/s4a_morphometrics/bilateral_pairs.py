"""The other side (6.1): partners of the template's vertices, and the template made symmetric.

The mirror image of the template is registered onto it, which gives each vertex v the place tau(v)
of its partner.
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
# Mean gap of the involution, of sqrt(area), from which the template is reported as asymmetric
FAR = 0.05


class Mirror(NamedTuple):
    """A plane of reflection: x -> x - 2 normal (normal . (x - center))."""

    center: np.ndarray
    normal: np.ndarray

    def __call__(self, X: np.ndarray) -> np.ndarray:
        """Points ``(..., 3)`` reflected."""
        return X - 2 * ((X - self.center) @ self.normal)[..., None] * self.normal

    def turned(self, vectors: np.ndarray) -> np.ndarray:
        """Vectors ``(..., 3)`` reflected."""
        return vectors - 2 * (vectors @ self.normal)[..., None] * self.normal


def plane_between(X: np.ndarray, Y: np.ndarray, area: np.ndarray) -> Mirror:
    """The plane whose reflection brings points Y nearest to X ``(n, 3)``, by area.

    |x - M y|^2 = |x - y|^2 + 4 (n . x)(n . y) about the common centre, so that the normal n is the
    last eigenvector of the symmetric part of sum w x y^T.

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
    """Where each vertex of the template has its partner on the other side.

    The mirror image of the template is registered onto it, as a pair on its own
    (:func:`s4a.match_pair`) with the options of the study.  The map is then made an involution:
    where tau(tau(v)) misses v by e, half of e, reflected, is added to tau(v), some times.

    Parameters
    ----------
    study : DataTree
        With ``/registration``.

    Returns
    -------
    Dataset
        ``partner_triangle(vertex)`` and ``partner_barycentric(vertex, corner)``, the place of
        tau(v); ``partner_distance(vertex)``, the distance of tau(tau(v)) and v that is left, in the
        unit of the input.  Attributes ``gap``, its root mean square over the area as a share of
        sqrt(area), ``gap_before`` as the registration gave it, and ``registration_error`` of the
        registration.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> halves = s4a_morphometrics.symmetry(study)
    >>> halves["partner_triangle"].dims, halves.attrs["gap"] < halves.attrs["gap_before"]
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
    found = match_shapes(image, template, options)[0]
    P = image_in_shape(X, found) * MIRROR  # (n, 3), the partner of each vertex
    place, gap_before, gap = involution(P, X, T)
    area = vertex_areas(X, T)
    size = float(np.sqrt(area.sum()))
    attrs = {
        "gap": rms(gap, area) / size,
        "gap_before": rms(gap_before, area) / size,
        "registration_error": float(found.attrs["score"]),
    }
    if max(attrs["gap"], attrs["registration_error"]) > FAR:
        log.warning(
            "the template and its mirror image differ (registration error %.3f, involution "
            "to %.3f of sqrt(area)): is it symmetric? Of left and right shapes give subject and "
            "side",
            attrs["registration_error"],
            attrs["gap"],
        )
    result = dataset(attrs, partner_triangle=place[0], partner_barycentric=place[1])
    result = result.merge(dataset(partner_distance=gap))
    return in_unit(result, unit_of(registration["position"]))


def symmetric_template(study: xr.DataTree, halves: xr.Dataset | None = None) -> xr.Dataset:
    """The template averaged with its mirror image, each vertex with its partner.

    With M the reflection that fits best, its vertices are (x(v) + M x(tau(v))) / 2, on the same
    triangles, so that it takes the place of the template's mesh; :func:`s4a.write_mesh` writes it.
    The mean of all shapes and their mirror images is ``symmetric_position`` of
    :func:`s4a_morphometrics.asymmetry`.

    Parameters
    ----------
    study : DataTree
        With ``/registration``.
    halves : Dataset, optional
        Of :func:`symmetry`, where it is there already.

    Returns
    -------
    Dataset
        ``position(vertex, xyz)`` in the unit of the input, ``corner_vertex(triangle, corner)``, and
        the attributes ``moved``, root mean square distance from the template as a share of
        sqrt(area), and ``gap`` of :func:`symmetry`, what it is still from being symmetric.

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
    halves = symmetry(study) if halves is None else halves
    require(halves, "partner_triangle", "partner_barycentric", what="symmetry")
    X, T = as_arrays(registration)
    area = vertex_areas(X, T)
    place = halves["partner_triangle"].values, halves["partner_barycentric"].values
    there = interpolate(X, T, *place)
    S = (X + plane_between(X, there, area)(there)) / 2
    moved = rms(np.linalg.norm(S - X, axis=1), area) / float(np.sqrt(area.sum()))
    attrs = {"moved": moved, "gap": halves.attrs.get("gap", np.nan)}
    return in_unit(as_dataset(S, T, attrs), unit_of(registration["position"]))


def rms(values: np.ndarray, area: np.ndarray) -> float:
    """Root mean square over the area of numbers ``(n,)``."""
    return float(np.sqrt(area @ values**2 / area.sum()))


def involution(
    P: np.ndarray, X: np.ndarray, T: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Partners of vertices, near points P ``(n, 3)``, so that the partner's partner is the vertex.

    Returns
    -------
    place : tuple
        Triangle ``(n,)`` and barycentric weights ``(n, 3)`` of tau(v) on the surface.
    before, after : float ndarray (n,)
        Distance of tau(tau(v)) and v, of the nearest points to P, and in the end.
    """
    area = vertex_areas(X, T)
    N = vertex_normals(X, T)

    def on_surface(points):
        plane = plane_between(X, points, area)
        place = closest_facing_point(points, plane.turned(N), X, T)
        return place, plane

    place, plane = on_surface(P)
    misses = []
    best = place
    for _ in range(ITERATIONS):
        there = interpolate(X, T, *place)
        miss = X - interpolate(there, T, *place)  # e = v - tau(tau(v))
        misses.append(np.linalg.norm(miss, axis=1))
        if rms(misses[-1], area) <= min(rms(one, area) for one in misses):
            best = place
        place, plane = on_surface(there + plane.turned(miss) / 2)
    least = min(misses, key=lambda one: rms(one, area))
    return best, misses[0], least
