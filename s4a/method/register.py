"""Registration at full resolution (eq. 3, 4, 6 and 7).

One shape onto one template, and the way back.
"""

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from s4a.geometry.closest import closest_point_in_star, feature_tree
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method import fmap, joint
from s4a.method.deform import displacement_in_template
from s4a.method.nearest import nearest_in_cells, nearest_of_few
from s4a.schema import INPUT, dataset, in_unit

log = logging.getLogger(__name__)

CONFIDENCE_LENGTH = 0.02
N_CENTRAL = 25_000  # vertices by which dense rounds move a shape


@dataclass(frozen=True)
class Scan:
    """One shape at both resolutions, centred and scaled to unit area: x -> (x - center) / size."""

    original: object
    coarse: object

    @cached_property
    def frame(self):
        """Area centroid (3,) and the square root of the total area, in the unit of the input."""
        X, T = as_arrays(self.original)
        area = vertex_areas(X, T)
        return area @ X / area.sum(), np.sqrt(area.sum())

    @cached_property
    def U(self):
        """The projection operator of 4.1 as a sparse matrix (n, n_coarse)."""
        columns, weights = self.coarse["coarse_vertex"].values, self.coarse["coarse_weight"].values
        rows = np.repeat(np.arange(len(columns)), columns.shape[1])
        return sp.csr_matrix(
            (weights.ravel(), (rows, columns.ravel())), (len(columns), self.coarse.sizes["vertex"])
        )

    @cached_property
    def cell(self):
        """The coarse vertex that weighs most in each original vertex (n,)."""
        columns, weights = self.coarse["coarse_vertex"].values, self.coarse["coarse_weight"].values
        return columns[np.arange(len(columns)), weights.argmax(1)]

    @cached_property
    def eigenvalue(self):
        """Eigenvalues of the coarse mesh (k,)."""
        return self.coarse["eigenvalue"].values

    @cached_property
    def low(self):
        """The low-resolution :class:`s4a.method.joint.Surface`."""
        X, T = as_arrays(self.coarse)
        area = self.coarse["vertex_area"].values
        center, size = self.frame
        return joint.Surface(
            (X - center) / size,
            T,
            area / area.sum(),
            self.coarse["eigenfunction"].values,
            eigenvalue=self.eigenvalue,
        )

    @cached_property
    def dense(self):
        """The full-resolution :class:`s4a.method.joint.Surface`, with the basis U Phi."""
        X, T = as_arrays(self.original)
        center, size = self.frame
        X = (X - center) / size
        return joint.Surface(X, T, vertex_areas(X, T), self.low.Phi, self.U, self.central)

    @cached_property
    def central(self):
        """The N_CENTRAL original vertices with the largest weights of U.

        Thus nearest to coarse ones; all of few.
        """
        weight = self.coarse["coarse_weight"].values.max(1)
        if len(weight) <= N_CENTRAL:
            return np.arange(len(weight))
        return np.flatnonzero(weight >= np.partition(weight, -N_CENTRAL)[-N_CENTRAL])


def intrinsic_match(source, target, F_source, F_target):
    """Full-resolution match by nearest rows of U F.

    Eq. 7 with F = Phi Y, eq. 4 with F = Phi C^T and Psi.

    Functions that have a row for every original vertex are taken as they are.

    Returns
    -------
    match : int ndarray (n_target,)
    compared, certified : float
        Shares of :func:`s4a.method.nearest.nearest_in_cells`.
    """
    Q, D = (
        F if len(F) == len(end.cell) else end.U @ F.astype(np.float32)
        for end, F in ((target, F_target), (source, F_source))
    )
    return nearest_in_cells(Q, target.cell, D, source.cell)


def sharpened(C, B_source, Phi_target, area_target, cell_source):
    """One more round of ZoomOut in which the target's coarse vertices look among all vertices of the source.

    ZoomOut on the coarse meshes can only match coarse vertices, half their spacing off; that noise
    is in its C.

    Parameters
    ----------
    C : float ndarray (k_target, k_source)
    B_source : float ndarray (n_source, >= k_source)
        The source's basis at all its vertices, as U Phi.
    Phi_target : float ndarray (n_coarse_target, >= k_target)
    area_target : float ndarray (n_coarse_target,), of sum 1
    cell_source : int ndarray (n_source,)

    Returns
    -------
    C : float ndarray (k_target, k_source)
    """
    k_target, k_source = C.shape
    B, Psi = B_source[:, :k_source], Phi_target[:, :k_target]
    return fmap.fmap_from_match(
        B, Psi, area_target, nearest_of_few(Psi, B @ C.T.astype(B.dtype), cell_source)
    )


def register(source, target, match_low, embeddings, *, k=100, refine="joint"):
    """Registers the target (the template) to the source at full resolution.

    Parameters
    ----------
    source, target : Scan
    match_low : dict
        Name -> match (n_target_coarse,): starts at low resolution; "intrinsic" must be among them.
    embeddings : tuple (F_source, F_target)
        Functions on both coarse meshes for the dense intrinsic match.
    refine : {"joint", "intrinsic"}

    Returns
    -------
    match : int ndarray (n_target,)
    image : float ndarray (n_target, 3)
        Registered template in the frame and unit of the source, smooth.
    info : dict
        ``method`` (the candidate kept), ``score`` (its badness at full resolution),
        ``score_<candidate>`` of each at low resolution.
    """
    low = {} if refine == "intrinsic" else joint.candidates(source.low, target.low, match_low, k=k)
    return at_full_resolution(source, target, low, embeddings)


def at_full_resolution(source, target, low, embeddings):
    """Second half of :func:`register`.

    From the candidates `low` of :func:`s4a.method.joint.candidates`, or none.
    """
    info = {f"score_{name}": score for name, (score, *_) in low.items()}
    M, N, dense = source.dense, target.dense, {}
    for name in joint.finalists(low) if low else ["intrinsic"]:
        if name == "intrinsic":
            match, info["compared_share"], info["certified_share"] = intrinsic_match(
                source, target, *embeddings
            )
            motion = joint.fitted(M, N, match[N.some])
            dense[name] = joint.badness(M, N, match[N.some], motion), motion
        else:
            dense[name] = (
                joint.badness(M, N, *(found := joint.dense_rounds(M, N, low[name][2]))),
                found[1],
            )
    method = min(dense, key=lambda name: dense[name][0])
    score, motion = dense[method]
    X = joint.registered(N, motion)
    if method != "intrinsic":
        match = joint.search(M, N, X)
    info |= {"method": method, "score": score}
    center, size = source.frame
    return match, X * size + center, info


def way_back(source, target, image):
    """For every vertex of the source the closest point of the registered template.

    With agreeing normal.

    The nearest template vertex in position and normal is looked up first, then the closest point on
    the triangles around it.

    Returns
    -------
    triangle : int ndarray (n_source,)
    barycentric : float ndarray (n_source, 3)
    """
    center, size = source.frame
    X, T = (image - center) / size, target.dense.T
    nearest = feature_tree(X, T).query(source.dense.tree.data)[1]
    return closest_point_in_star(source.dense.X, nearest, X, T)


def round_trip(target, match, triangle, barycentric):
    """Length of the way template -> shape -> template ``(n_target,)`` as a share of sqrt(area).

    The cycle error.
    """
    X, T = target.dense.X, target.dense.T
    back = np.einsum("nc,ncx->nx", barycentric[match], X[T[triangle[match]]])
    return np.linalg.norm(back - X, axis=1)


def confidence(source, target, match, image, triangle, barycentric):
    """exp(-(r + g) / 0.02) for every template vertex ``(n_target,)``, in 0..1.

    r is :func:`round_trip`, g the gap between the registered template and the matched vertex, both
    as shares of sqrt(area).
    """
    center, size = source.frame
    gap = np.linalg.norm((image - center) / size - source.dense.X[match], axis=1)
    return np.exp(-(round_trip(target, match, triangle, barycentric) + gap) / CONFIDENCE_LENGTH)


def distortion(image, X, T):
    """log(a / A) for every vertex ``(n,)``.

    Its share of the area on the registered template, by that on the template.

    0 where nothing is stretched but the size as a whole.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.register import distortion
    >>> X, T = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    >>> (distortion(2 * X, X, T) + 0.0).tolist()
    [0.0, 0.0, 0.0]
    """
    share = [
        np.maximum(a / a.sum(), np.finfo(np.float32).tiny)
        for a in (vertex_areas(image, T), vertex_areas(X, T))
    ]
    return np.log(share[0]) - np.log(share[1])


def common_unit(*meshes):
    """The unit that all meshes say; "unit of the input" where they do not."""
    units = {mesh.attrs.get("unit") or INPUT for mesh in meshes}
    return units.pop() if len(units) == 1 else INPUT


def registration(source, target, match_low, embeddings, *, k=100, refine="joint", scale=False):
    """One shape's file of ``/registration``.

    Match, displacement, motion, confidence and the way back.

    Parameters
    ----------
    source : Scan
        The shape.
    target : Scan
        The template.
    match_low, embeddings, k, refine : see :func:`register`
    scale : bool
        Whether size is taken out of the displacement.

    Returns
    -------
    xarray.Dataset
        ``registered_match(vertex)``, ``displacement(vertex, xyz)``, ``displacement_raw``,
        ``displacement_low(low_vertex, xyz)`` of the match of eq. 6 as it is, ``rotation``,
        ``translation``, ``scale``, ``confidence(vertex)``, ``round_trip``, ``distortion``,
        ``template_triangle(original_vertex)``, ``template_barycentric``; displacements in the unit
        of the input, in the template's frame.
    """
    match, image, info = register(source, target, match_low, embeddings, k=k, refine=refine)
    triangle, barycentric = way_back(source, target, image)
    X, T = as_arrays(target.original)
    displacement, R, t, s = displacement_in_template(X, image, target.dense.area, scale=scale)
    raw = s * source.original["position"].values[match] @ R.T + t - X
    low = (
        s * source.coarse["position"].values[match_low["intrinsic"]] @ R.T
        + t
        - target.coarse["position"].values
    )
    sure = confidence(source, target, match, image, triangle, barycentric)
    trip = round_trip(target, match, triangle, barycentric)
    found = dataset(
        info,
        registered_match=match.astype(np.int32),
        displacement=displacement.astype(np.float32),
        displacement_raw=raw.astype(np.float32),
        displacement_low=low.astype(np.float32),
        rotation=R,
        translation=t,
        scale=np.array(s),
        confidence=sure.astype(np.float32),
        round_trip=trip.astype(np.float32),
        distortion=distortion(image, X, T).astype(np.float32),
        template_triangle=triangle.astype(np.int32),
        template_barycentric=barycentric,
    )
    return in_unit(found, common_unit(source.original, target.original))


def identity(target):
    """The template's own file of ``/registration``: every vertex matches itself, nothing moves."""
    X, T = as_arrays(target.original)
    corner = np.argsort(T.ravel(), kind="stable")[
        np.cumsum(np.bincount(T.ravel(), minlength=len(X))) - 1
    ]
    zero = np.zeros(X.shape, np.float32)
    low = (
        {}
        if target.coarse is None
        else {"displacement_low": np.zeros(target.coarse["position"].shape, np.float32)}
    )
    found = dataset(
        {"method": "template", "score": 0.0},
        registered_match=np.arange(len(X), dtype=np.int32),
        displacement=zero,
        displacement_raw=zero,
        rotation=np.eye(3),
        translation=np.zeros(3),
        scale=np.array(1.0),
        confidence=np.ones(len(X), np.float32),
        round_trip=zero[:, 0],
        distortion=zero[:, 0],
        template_triangle=(corner // 3).astype(np.int32),
        template_barycentric=np.eye(3)[corner % 3],
        **low,
    )
    return in_unit(found, common_unit(target.original))
