"""Evaluation of the model of variation.

Compactness, generalization, specificity, permutation baseline (6.1, Fig. 5).

The measures are those of Davies (2002) and Styner et al. (2003), in the unit of the data.  A vertex
distance is the root of the area-weighted mean square distance between corresponding vertices; it
lives in the Gram matrix of the displacements, so that it costs nothing on large meshes.  The
template, the correspondences and the alignment were made from all shapes together; what is left out
here is left out of the model only, and the attribute ``correspondence`` says so.
"""

import igl
import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method.deform import smoother
from s4a.method.pca import synthesize
from s4a.method.register import Scan
from s4a.schema import dataset, in_unit, require, unit_of

KEPT = "kept from the whole collection: optimistic"


def gram(d, area):
    """Inner products of fields (s, n, 3) under the areas scaled to sum 1, ``(s, s)``.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.model import gram
    >>> gram(np.array([[[1.0, 0, 0], [3, 0, 0]]]), np.array([1.0, 1.0])).round(6).tolist()
    [[5.0]]
    """
    X = np.asarray(d, np.float64) * np.sqrt(area / area.sum())[:, None]
    X = X.reshape(len(X), -1)
    return X @ X.T


def centred(K):
    """Gram matrix of the fields less their mean."""
    return K - K.mean(0) - K.mean(1)[:, None] + K.mean()


def principal(K):
    """Variances (c,) (divisor s - 1).

    And eigenvectors (s, c) of a centred Gram matrix, largest first.
    """
    value, V = np.linalg.eigh(K)
    keep = value > 1e-12 * max(value[-1], np.finfo(float).tiny)
    keep[0] = False  # the mean is gone
    return value[keep][::-1] / (len(K) - 1), V[:, keep][:, ::-1]


def left_out(inner, cross, own):
    """A field against the model of others.

    Parameters
    ----------
    inner : float ndarray (n, n)
        Gram matrix of the others.
    cross : float ndarray (n,)
        Inner products of the field and the others.
    own : float
        Of the field with itself.

    Returns
    -------
    error : float ndarray (n,)
        Vertex distance after reconstruction with 0, 1, ... n - 1 components.
    score : float ndarray (n - 1,)
        Scores in standard deviations; NaN where there are fewer components.
    steps : float ndarray (c, n)
        Row c: what component c adds, in terms of the others less their mean.
    """
    n = len(inner)
    error, score = np.zeros(n), np.full(n - 1, np.nan)
    variance, V = principal(centred(inner))
    total = own - 2 * cross.mean() + inner.mean()
    # <x - mean, x_j - mean>
    cross = cross - inner.mean(0) - cross.mean() + inner.mean()
    coefficient = (cross @ V) / np.sqrt(variance * (n - 1))
    left = total - np.concatenate([[0], np.cumsum(coefficient**2)])
    error[:] = np.sqrt(np.maximum(left[-1], 0))
    error[: len(left)] = np.sqrt(np.maximum(left, 0))
    score[: len(variance)] = coefficient / np.sqrt(variance)
    return error, score, (coefficient / np.sqrt(variance * (n - 1)))[:, None] * V.T


def leave_one_out(K):
    """Every field against the model of all others.

    Parameters
    ----------
    K : float ndarray (s, s)
        As of :func:`gram`.

    Returns
    -------
    error : float ndarray (s, s - 1)
        Vertex distance after reconstruction with 0, 1, ... s - 2 components.
    score : float ndarray (s, s - 2)
        Scores in standard deviations of the others' model.
    """
    s = len(K)
    error, score = np.zeros((s, s - 1)), np.full((s, s - 2), np.nan)
    for i in range(s):
        J = np.flatnonzero(np.arange(s) != i)
        error[i], score[i], _ = left_out(K[np.ix_(J, J)], K[i, J], K[i, i])
    return error, score


def specificity(K, n_samples, rng):
    """Vertex distances of random shapes of the model to the nearest shape of the collection.

    Parameters
    ----------
    K : float ndarray (s, s)
    n_samples : int
        Shapes drawn from independent normal scores, the same for every number of components.

    Returns
    -------
    distance : float ndarray (c, n_samples)
        With 1, 2, ... c components.
    nearest : int ndarray (c, n_samples)
    score : float ndarray (n_samples, c)
    """
    variance, V = principal(centred(K))
    own = V * np.sqrt(variance * (len(K) - 1))  # coordinates of the collection
    score = rng.normal(size=(n_samples, len(variance)))
    drawn = score * np.sqrt(variance)
    squared = np.tile((own**2).sum(1), (n_samples, 1))  # to the mean shape
    distance, nearest = [], []
    for c in range(len(variance)):
        squared += drawn[:, c : c + 1] ** 2 - 2 * drawn[:, c : c + 1] * own[:, c]
        distance.append(np.sqrt(np.maximum(squared.min(1), 0)))
        nearest.append(squared.argmin(1))
    return np.array(distance), np.array(nearest), score


def variance_baseline(features, n_permutations, rng):
    """Shares of variance when every feature is permuted over the shapes by itself (parallel analysis, Horn 1965).

    Parameters
    ----------
    features : float ndarray (s, f)
        In a basis that is orthonormal, so that the permuted fields are as smooth as the true ones.

    Returns
    -------
    float ndarray (n_permutations, s - 1)
        Descending.
    """
    s = len(features)
    X = features - features.mean(0)
    ratio = np.zeros((n_permutations, s - 1))
    for row in ratio:
        P = rng.permuted(X, axis=0)
        variance = np.linalg.eigvalsh(P @ P.T)[::-1][: s - 1]
        row[:] = np.maximum(variance, 0) / max(variance.sum(), np.finfo(float).tiny)
    return ratio


def registered(study):
    """Displacements (s, n, 3), template areas (n,) of sum 1, names (s,) and the template's mesh.

    Of a study.
    """
    if "registration" not in study:
        raise ValueError(
            f"a registered study is needed; this one has {', '.join(study.children) or 'no nodes'}"
        )
    data = study["registration"].to_dataset()
    require(data, "displacement", "position", "corner_vertex", what="registration")
    if data.sizes["shape"] < 4:
        raise ValueError(f"statistics need at least 4 shapes, found {data.sizes['shape']}")
    area = vertex_areas(*as_arrays(data))
    d = data["displacement"].transpose("shape", "vertex", "xyz").values
    return d, area / area.sum(), data["shape"].values.tolist(), data


def evaluate(study, *, n_samples=1000, n_permutations=100, n_points=500, n_surface=20, seed=0):
    """Compactness, generalization and specificity for every number of components.

    And a baseline of the variance.

    Parameters
    ----------
    study : DataTree
    n_samples : int
        Random shapes for specificity.
    n_permutations : int
        Of the baseline: every coefficient of the displacements in the template's eigenfunctions
        permuted over the shapes by itself (Horn 1965), so that fields stay as smooth as they are.
    n_points : int
        Vertices from which distances to surfaces are measured; 0 leaves these out.
    n_surface : int
        Random shapes whose distances to surfaces are measured.
    seed : int

    Returns
    -------
    Dataset
        ``compactness(component)`` = sum of the variances, standard error sqrt(2 / s) times it
        (Davies 2002); ``generalization(component)``, leave-one-out with the correspondences kept,
        therefore optimistic (:func:`s4a.analysis.statistics.generalization` recomputes them), NaN
        for the last component; ``specificity(component)``; each with its standard error, as root
        mean square over the area between vertices, and ``_surface`` as mean distance from points to
        the surface, all in the unit of the input; ``variance_ratio``, ``variance_ratio_null``,
        ``variance_ratio_null_95``.  The attribute ``generalization_0`` is that of the mean shape
        alone.

    Raises
    ------
    ValueError
        When the study is not registered or has fewer than 4 shapes.

    Examples
    --------
    With the ``study`` of six small brains; more modes describe a left-out shape better:

    >>> import s4a
    >>> from s4a.analysis.model import evaluate
    >>> study = s4a.synthetic.example_study()
    >>> found = evaluate(study)
    >>> bool(found["generalization"][0] > found["generalization"][3])
    True
    """
    d, area, _, data = registered(study)
    s, rng = len(d), np.random.default_rng(seed)
    K = gram(d - d.mean(0), area)
    variance, _ = principal(centred(K))
    c = len(variance)
    error, _ = leave_one_out(K)
    drawn, nearest, score = specificity(K, n_samples, rng)
    compactness = np.cumsum(variance)

    def per_component(values):
        out = np.full(c, np.nan)
        out[: min(c, len(values))] = values[:c]
        return out

    found = dataset(
        {"correspondence": KEPT, "shapes": s, "generalization_0": float(error[:, 0].mean())},
        compactness=compactness,
        compactness_error=np.sqrt(2 / s) * compactness,
        generalization=per_component(error[:, 1:].mean(0)),
        generalization_error=per_component(error[:, 1:].std(0, ddof=1) / np.sqrt(s)),
        specificity=drawn.mean(1),
        specificity_error=drawn.std(1, ddof=1) / np.sqrt(n_samples),
    )
    X, T = as_arrays(data)
    if n_points:
        points = np.sort(rng.choice(len(X), min(n_points, len(X)), replace=False, p=area))
        kept, drawn = _surface_distances(
            X, T, d, K, points, score[:n_surface], nearest[:, :n_surface]
        )
        found = found.merge(
            dataset(
                generalization_surface=per_component(kept.mean(0)),
                generalization_surface_error=per_component(standard_error(kept)),
                specificity_surface=drawn.mean(1),
                specificity_surface_error=standard_error(drawn, 1),
            )
        )
    found = in_unit(found, unit_of(data["displacement"]))
    features = _coefficients(study, d, area)
    own = np.linalg.svd(features - features.mean(0), compute_uv=False)[:c] ** 2
    null = variance_baseline(features, n_permutations, rng)[:, :c]
    return found.merge(
        dataset(
            variance_ratio=own / own.sum(),
            variance_ratio_null=null.mean(0),
            variance_ratio_null_95=np.quantile(null, 0.95, axis=0),
        )
    )


def _coefficients(study, d, area):
    """Displacements in an orthonormal basis of the template's smooth functions (s, f).

    In all vertices without one.
    """
    template = study["registration"].attrs["template"]
    if "coarse" in study and template in study["coarse"].children:
        scan = Scan(
            study["original"][template].to_dataset(), study["coarse"][template].to_dataset()
        )
        B = scan.U @ scan.low.Phi
        B = B @ np.linalg.inv(np.linalg.cholesky(B.T @ (area[:, None] * B))).T
        return np.stack([smoother(B, area)(field) for field in d.astype(float)]).reshape(len(d), -1)
    return (d * np.sqrt(area)[:, None]).reshape(len(d), -1).astype(float)


def _surface_distances(X, T, d, K, points, score, nearest):
    """Distances from points of the reconstructions to each left-out shape.

    And of random shapes to the nearest.
    """
    s, c = len(d), len(nearest)
    at = (X + d)[:, points].astype(float)
    _, V = principal(centred(K))
    modes = np.einsum("sc,spx->cpx", V, at - at.mean(0)) / np.sqrt(s - 1)
    drawn = at.mean(0) + np.cumsum(
        score[:, :, None, None] * modes, axis=1
    )  # sample, component, point, xyz
    kept, random = np.full((s, max(s - 2, 1)), np.nan), np.zeros(nearest.shape)
    for i in range(s):
        gap = distance_to(X + d[i], T)
        which = np.argwhere(nearest == i)
        if len(which):
            random[which[:, 0], which[:, 1]] = gap(drawn[which[:, 1], which[:, 0]])
        J = np.flatnonzero(np.arange(s) != i)
        *_, steps = left_out(K[np.ix_(J, J)], K[i, J], K[i, i])
        distance = gap(reconstructed(at[J], steps))
        kept[i] = distance[-1]
        kept[i, : len(distance)] = distance
    return kept[:, :c], random


def distance_to(X, T):
    """Function of points (..., p, 3): their mean distance to a surface (...)."""
    X, T = np.ascontiguousarray(X, np.float64), np.ascontiguousarray(T, np.int64)
    tree = igl.AABB()
    tree.init(X, T)

    def gap(P):
        squared = tree.squared_distance(X, T, np.ascontiguousarray(P.reshape(-1, 3)))[0]
        return np.sqrt(np.maximum(squared, 0)).reshape(P.shape[:-1]).mean(-1)

    return gap


def reconstructed(at, steps):
    """Points of a field with 1, 2, ... components of others ``(c, p, 3)``.

    Theirs ``(n, p, 3)``, :func:`left_out`.
    """
    return at.mean(0) + np.cumsum(np.einsum("cn,npx->cpx", steps, at - at.mean(0)), axis=0)


def standard_error(values, axis=0):
    """Of the mean along an axis."""
    return values.std(axis, ddof=1) / np.sqrt(values.shape[axis])


def sample(study, n, *, n_components=None, seed=0):
    """New shapes from the model: normal scores on the first components.

    Parameters
    ----------
    study : DataTree
    n : int
    n_components : int, optional
        All by default.
    seed : int

    Returns
    -------
    DataTree
        ``/sample_1`` ... with a mesh each, and at the root ``score(shape, component)``.

    Raises
    ------
    ValueError
        When there are not as many components.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> from s4a.analysis.model import sample
    >>> study = s4a.synthetic.example_study()
    >>> sample(study, 2)["score"].dims
    ('shape', 'component')
    """
    c = study["pca"].sizes["component"]
    c = c if n_components is None else n_components
    if not 1 <= c <= study["pca"].sizes["component"]:
        raise ValueError(
            f"n_components needs a number from 1 to {study['pca'].sizes['component']}, found {c}"
        )
    score = np.random.default_rng(seed).normal(size=(n, c))
    names = [f"sample_{i + 1:0{len(str(n))}d}" for i in range(n)]
    nodes = {name: synthesize(study, row) for name, row in zip(names, score, strict=True)}
    return xr.DataTree.from_dict({"/": dataset(score=score).assign_coords(shape=names), **nodes})
