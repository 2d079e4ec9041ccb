"""Principal modes of the displacements (6.1).

PCA by the small Gram matrix, synthesis of new shapes.
"""

import numpy as np
import xarray as xr

from s4a.geometry.mesh import vertex_normals
from s4a.method.deform import normal_displacement
from s4a.schema import dataset, in_unit, require, unit_of


def gram_pca(d, area):
    """PCA of vector fields under the inner product of the template's areas.

    Parameters
    ----------
    d : float ndarray (s, n, 3)
        One displacement field per shape.
    area : float ndarray (n,)
        Template vertex areas; their scale does not matter.

    Returns
    -------
    mean : (n, 3)
    deformation : (c, n, 3), one standard deviation along each component
    standard_deviation : (c,), its area-weighted root mean square
    score : (s, c), uncorrelated, of variance 1 (divisor s - 1); signs make the third moment positive
    ratio : (c,), shares of the variance, descending
    """
    s = len(d)
    w = (area / area.sum())[:, None]
    mean = d.mean(axis=0)
    X = (d - mean).astype(np.float64) * np.sqrt(w)
    eigenvalue, V = np.linalg.eigh(np.einsum("inx,jnx->ij", X, X, optimize=True))
    eigenvalue, V = np.maximum(eigenvalue[::-1], 0), V[:, ::-1]
    keep = eigenvalue > 1e-12 * max(eigenvalue[0], np.finfo(float).tiny)
    keep &= np.arange(s) < s - 1
    eigenvalue, V = eigenvalue[keep], V[:, keep]
    V = V * np.where((V**3).sum(0) < 0, -1.0, 1.0)
    deformation = np.einsum("ic,inx->cnx", V, d - mean, optimize=True) / np.sqrt(s - 1)
    total = eigenvalue.sum()
    ratio = eigenvalue / total if total > 0 else eigenvalue
    return mean, deformation, np.sqrt(eigenvalue / (s - 1)), V * np.sqrt(s - 1), ratio


def low_vertices(coarse):
    """For every coarse vertex the original vertex in which U weighs it most ``(n_coarse,)``."""
    vertex, weight = coarse["coarse_vertex"].values, coarse["coarse_weight"].values
    order = np.argsort(weight.ravel(), kind="stable")
    found = np.zeros(coarse.sizes["vertex"], np.int64)
    found[vertex.ravel()[order]] = order // vertex.shape[1]
    return found


def pca(registration, area, *, coarse=None):
    """Principal modes of a registered collection (6.1, Fig. 4 and 5).

    Parameters
    ----------
    registration : xarray.Dataset
        With ``displacement(shape, vertex, xyz)`` in the unit of the input.
    area : float ndarray (vertex,)
        Template vertex areas, the weights of the Gram matrix.
    coarse : xarray.Dataset, optional
        The template's low-resolution mesh; gives the shares of variance at low resolution as well,
        where the registration has ``displacement_low``.  They are of the matches of eq. 6 as they
        are: the smooth displacement, looked at on fewer vertices, would have the shares of the full
        resolution.

    Returns
    -------
    xarray.Dataset
        ``mean_displacement``, ``deformation(component, vertex, xyz)`` of one standard deviation,
        ``standard_deviation(component)``, ``score(shape, component)``, ``explained_variance_ratio``
        and ``explained_variance_ratio_low``.

    Raises
    ------
    ValueError
        With fewer than 3 shapes, or when all displacements are equal: there is no variation to
        analyse.
    """
    require(registration, "displacement", what="registration")
    d = registration["displacement"].transpose("shape", "vertex", "xyz").values
    if len(d) < 3:
        raise ValueError(f"PCA needs at least 3 shapes, found {len(d)}")
    mean, deformation, deviation, score, ratio = gram_pca(d, area)
    size = (
        np.linalg.norm(registration["position"].values.std(axis=0))
        if "position" in registration
        else 1.0
    )
    if not len(ratio) or deviation[0] < 1e-9 * size:
        raise ValueError("PCA needs shapes that differ; all displacements are equal")
    found = dataset(
        mean_displacement=mean.astype(np.float32),
        deformation=deformation.astype(np.float32),
        standard_deviation=deviation,
        score=score,
        explained_variance_ratio=ratio,
    )
    if coarse is not None and "displacement_low" in registration:
        low = registration["displacement_low"].transpose("shape", "low_vertex", "xyz").values
        low = gram_pca(low, coarse["vertex_area"].values)[4]
        padded = np.zeros(len(ratio))
        padded[: len(low)] = low[: len(ratio)]
        found = found.merge(dataset(explained_variance_ratio_low=padded))
    return in_unit(found, unit_of(registration["displacement"])).assign_coords(
        shape=registration["shape"]
    )


def synthesize(study, scores):
    """The shape with given scores: template + mean displacement + sum of score times deformation.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.
    scores : array_like (c,)
        In standard deviations, for the first c components.

    Returns
    -------
    xarray.Dataset
        A mesh with ``position(vertex, xyz)`` in the unit of the input and ``corner_vertex(triangle,
        corner)``.

    Raises
    ------
    ValueError
        When there are more scores than components, or the study has no modes.

    Examples
    --------
    With the ``study`` of six small brains; scores of 0 give the mean shape:

    >>> mean, larger = synthesize(study, [0.0]), synthesize(study, [2.0])
    >>> moved = (larger["position"] - mean["position"]) / 2
    >>> bool(abs(moved - study["pca"]["deformation"][0].values).max() < 1e-4)
    True
    """
    scores = np.atleast_1d(np.asarray(scores, float))
    if "pca" not in study.children:
        reason = study["report"].attrs.get("no_modes") if "report" in study.children else ""
        raise ValueError(
            f"a study with modes is needed; this one has none: {reason or 'it is not finished'}"
        )
    pca, template = study["pca"].to_dataset(), study["registration"].to_dataset()
    require(pca, "deformation", "mean_displacement", what="pca dataset")
    if scores.ndim != 1 or len(scores) > pca.sizes["component"]:
        raise ValueError(
            f"scores need at most {pca.sizes['component']} numbers, found shape {scores.shape}"
        )
    moved = np.tensordot(scores, pca["deformation"].values[: len(scores)], axes=1)
    position = template["position"].values + pca["mean_displacement"].values + moved
    mesh = xr.merge([dataset(position=position), template[["corner_vertex"]]])
    return in_unit(mesh, unit_of(template["position"]))


def deformed(mean, deformation, scores):
    """The mean shape ``(n, 3)`` moved by the scores ``(c,)`` along the deformations ``(c, n, 3)``.

    Examples
    --------
    >>> deformed(np.zeros((1, 3)), np.array([[[1.0, 0, 0]], [[0, 2.0, 0]]]), [0.5, -1]).tolist()
    [[0.5, -2.0, 0.0]]
    """
    scores = np.asarray(scores, float)
    return mean + np.tensordot(scores, deformation[: len(scores)], axes=1)


def mahalanobis(scores):
    """Mahalanobis distance of a shape from the mean.

    The length of its scores, which have unit variance.

    Examples
    --------
    >>> mahalanobis([3, -4])
    5.0
    """
    return float(np.linalg.norm(scores))


def plausible_scores(n, *, seed=None, limit=3.0):
    """Scores ``(n,)`` of a random shape: normal, those beyond the limit drawn again.

    Examples
    --------
    >>> bool((abs(plausible_scores(1000, seed=0)) <= 3).all())
    True
    """
    rng = np.random.default_rng(seed)
    scores = rng.standard_normal(n)
    while (beyond := np.abs(scores) > limit).any():
        scores[beyond] = rng.standard_normal(beyond.sum())
    return scores


def color_limits(mean, triangles, deformation, *, sigma=3, n_modes=3):
    """Displacements of the full colours: along the normal, and in length.

    The 95 % quantile over the vertices and the first modes at `sigma` standard deviations: one
    scale for all modes, on which a few outlying vertices do not count.

    Returns
    -------
    (float, float)
    """
    steps = deformation[:n_modes]
    along = np.quantile(np.abs(normal_displacement(steps, vertex_normals(mean, triangles))), 0.95)
    length = np.quantile(np.linalg.norm(steps, axis=2), 0.95)
    return float(sigma * along) or 1.0, float(sigma * length) or 1.0
