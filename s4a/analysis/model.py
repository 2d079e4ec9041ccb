"""Quality of the shape model: compactness, generalization, specificity, chance (6.1, Fig. 5).

The measures are those of Davies (2002) and Styner et al. (2003), in the unit of the data.  A vertex
distance is the root of the area-weighted mean square distance between corresponding vertices.  It
is computed from the Gram matrix of the displacements, which is fast for large meshes.  Template,
correspondences and alignment depend on all shapes; a left-out shape is left out of the model only,
as the attribute ``correspondence`` records.
"""

import numpy as np
import xarray as xr
from scipy import stats
from scipy.linalg.lapack import dlasd4

from s4a.analysis.inputs import displacements_of
from s4a.analysis.permutation import check_permutations
from s4a.geometry.closest import distance_to_surface
from s4a.geometry.mesh import as_arrays
from s4a.method.deform import smoother
from s4a.method.pca import center_gram, gram, principal_components, synthesize
from s4a.method.shape import Shape
from s4a.schema import Array, check_count, check_type, dataset, in_unit, unit_of
from s4a.seeds import RNG, seed_of

KEPT = "kept from the whole collection: optimistic"


def describe_by_others(
    inner: Array, cross: Array, squared_norm: float
) -> tuple[Array, Array, Array]:
    """Reconstruct a field by the model of other fields.

    Parameters
    ----------
    inner : float ndarray (n, n)
        Gram matrix of the others.
    cross : float ndarray (n,)
        Inner products of the field and the others.
    squared_norm : float
        Inner product of the field with itself.

    Returns
    -------
    error : float ndarray (n,)
        Vertex distance after reconstruction with 0, 1, ... n - 1 components.
    score : float ndarray (n - 1,)
        Scores in standard deviations; NaN if there are fewer components.
    steps : float ndarray (c, n)
        Row c: the part of component c, as coefficients of the centred others.
    """
    n = len(inner)
    variance, V = principal_components(inner)
    c = len(variance)
    deviation = np.sqrt(variance)
    length = np.sqrt(variance * (n - 1))  # of the components, as sums of the others
    # with m the mean of the others: <x - m, x - m>, and <x - m, x_j - m>
    total = squared_norm - 2 * cross.mean() + inner.mean()
    cross = cross - inner.mean(0) - cross.mean() + inner.mean()
    coefficient = (cross @ V) / length  # (c,)
    squared = total - np.concatenate([[0], np.cumsum(coefficient**2)])  # (c + 1,)
    error = np.sqrt(np.maximum(squared, 0))
    return (
        np.pad(error, (0, n - 1 - c), mode="edge"),
        np.pad(coefficient / deviation, (0, n - 1 - c), constant_values=np.nan),
        (coefficient / length)[:, None] * V.T,
    )


def leave_one_out(K: Array) -> tuple[Array, Array]:
    """Reconstruct every field by the model of all others, see :func:`describe_by_others`.

    The scatter of the others is a rank-one downdate of that of all, S - s / (s - 1) x x^T with the
    centred field x.  Its components are updated in O(s^2) for each field (Golub 1973).

    Parameters
    ----------
    K : float ndarray (s, s)
        Gram matrix of :func:`s4a.method.pca.gram`.

    Returns
    -------
    error : float ndarray (s, s - 1)
        Vertex distance after reconstruction with 0, 1, ... s - 2 components.
    score : float ndarray (s, s - 2)
        Absolute scores in standard deviations of the model of the others.
    """
    s = len(K)
    centred = center_gram(K)
    variance, V = principal_components(centred)
    scatter = variance * (s - 1)
    ratio = s / (s - 1)  # deviation from the mean of the others by that from the mean of all
    error, score = np.zeros((s, s - 1)), np.full((s, s - 2), np.nan)
    if not len(scatter):  # equal fields
        return error, score
    for i in range(s):
        eigenvalue, coefficient = downdate(scatter, V[i] * np.sqrt(scatter), ratio)
        least = max(1e-12 * eigenvalue[0], s * np.finfo(float).eps * scatter[0])
        n = min((eigenvalue > least).sum(), s - 2)
        eigenvalue, coefficient = eigenvalue[:n], coefficient[:n]
        explained = np.concatenate([[0], np.cumsum(coefficient**2)])
        residual = np.sqrt(np.maximum(ratio**2 * centred[i, i] - explained, 0))
        error[i] = np.pad(residual, (0, s - 1 - len(residual)), mode="edge")
        score[i, :n] = coefficient / np.sqrt(eigenvalue / (s - 2))
    return error, score


def downdate(d: Array, z: Array, rho: float) -> tuple[Array, Array]:
    """Return the eigenvalues of diag(d) - rho z z^T, and |rho z| along each eigenvector.

    Parameters
    ----------
    d : float ndarray (c,)
        Positive, descending.
    z : float ndarray (c,)
    rho : float
        Positive; the matrix must be semi-definite up to rounding.

    Returns
    -------
    eigenvalue : float ndarray (c,)
        Descending.
    along : float ndarray (c,)
        Not negative.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.model import downdate
    >>> eigenvalue, along = downdate(np.array([3.0, 2.0]), np.array([1.0, 0.0]), 0.5)
    >>> eigenvalue.round(6).tolist(), along.round(6).tolist()
    ([2.5, 2.0], [0.5, 0.0])
    """
    # deflation of equal eigenvalues and of zero entries of z (Dongarra & Sorensen 1987)
    least = 8 * np.finfo(float).eps * d[0]
    group = np.cumsum(np.r_[False, d[:-1] - d[1:] > least])
    w = np.zeros(len(d))
    w[np.unique(group, return_index=True)[1]] = rho * np.bincount(group, z**2)
    changes = np.sqrt(w * w.sum()) > least
    eigenvalue, along = d.copy(), np.zeros(len(d))
    if changes.any():
        w, far = w[changes], np.sqrt(d[changes][0] - d[changes])
        size = w.sum()
        # LAPACK has the eigenvalues root^2 of far^2 + size z z^T; difference is far - root
        found = (dlasd4(j, far, np.sqrt(w / size), size) for j in range(len(far)))
        difference, root, total, failed = map(np.array, zip(*found, strict=True))
        if failed.any():
            raise ArithmeticError(f"{failed.sum()} of {len(far)} eigenvalues were not found")
        gap = difference * total if len(far) > 1 else -size
        eigenvalue[changes] = d[changes][0] - root**2
        along[changes] = np.sqrt(rho / (w / gap**2).sum(-1))
    order = np.argsort(-eigenvalue, kind="stable")
    return eigenvalue[order], along[order]


def specificity(K: Array, n_samples: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return vertex distances of random shapes of the model to the nearest shape of the collection.

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
    variance, V = principal_components(K)
    shapes = V * np.sqrt(variance * (len(K) - 1))  # (s, c), coordinates of the collection
    score = rng.normal(size=(n_samples, len(variance)))
    samples = score * np.sqrt(variance)  # (n_samples, c)
    # |a - b|^2 from sample a to shape b is |b|^2 at the mean, a = 0, and each component of a adds
    # a_c^2 - 2 a_c b_c
    squared = np.tile((shapes**2).sum(1), (n_samples, 1))  # (n_samples, s)
    distance, nearest = [], []
    for c in range(len(variance)):
        a = samples[:, c : c + 1]
        squared += a**2 - 2 * a * shapes[:, c]
        distance.append(np.sqrt(np.maximum(squared.min(1), 0)))
        nearest.append(squared.argmin(1))
    return np.array(distance), np.array(nearest), score


def variance_baseline(features: Array, n_permutations: int, rng: np.random.Generator) -> Array:
    """Return variance shares under the null hypothesis of independent features (Horn 1965).

    Every feature is permuted over the shapes.

    Parameters
    ----------
    features : float ndarray (s, f)
        Coefficients in an orthonormal basis, so that permuted fields are as smooth as the data.

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


def count_components(
    variance: Array, s: int, n_components: int | None, *, most: int, at_most: int | None = None
) -> int:
    """Return the number of components of a test of s shapes; ValueError if it exceeds `most`.

    By default the components of 90 % of the variance, at most half of the shapes or `at_most`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.model import count_components
    >>> count_components(np.array([6.0, 3.0, 1.0]), 20, None, most=3)
    2
    """
    if n_components is None:
        explained = np.cumsum(variance / variance.sum())
        enough = int(np.searchsorted(explained, 0.9 - 1e-9)) + 1
        limit = s // 2 if at_most is None else at_most
        n_components = max(1, min(enough, limit, len(variance), most))
    check_count("n_components", n_components, 1, most)
    return int(n_components)


def mean_distance(P: Array, X: Array, T: Array) -> Array:
    """Return the mean distance of points ``(..., p, 3)`` to a surface ``(...)``."""
    return distance_to_surface(P.reshape(-1, 3), X, T).reshape(P.shape[:-1]).mean(-1)


def surface_error(points: Array, steps: Array, X: Array, T: Array) -> Array:
    """Return mean distances of reconstructions of a left-out shape to its surface X, T.

    Parameters
    ----------
    points : float ndarray (n, p, 3)
        Corresponding points on all other shapes.
    steps : float ndarray (c, n)
        Result of :func:`describe_by_others`.

    Returns
    -------
    float ndarray (n,)
        With 0, 1, ... n - 1 components.
    """
    mean = points.mean(0)
    added = np.einsum("cn,npx->cpx", steps, points - mean)  # by each component
    P = np.concatenate([mean[None], mean + np.cumsum(added, axis=0)])  # (c + 1, p, 3)
    return np.pad(mean_distance(P, X, T), (0, len(points) - len(P)), mode="edge")


def draw_points(area: Array, n: int, rng: np.random.Generator) -> Array:
    """Draw vertices ``(n,)`` with probability by area (of sum 1), sorted."""
    return np.sort(rng.choice(len(area), min(n, len(area)), replace=False, p=area))


def evaluate(
    study: xr.DataTree,
    *,
    n_samples: int = 1000,
    n_permutations: int = 100,
    n_points: int = 500,
    n_surface: int = 20,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Measure compactness, generalization and specificity for every number of components.

    Parameters
    ----------
    study : DataTree
        A finished study, from :func:`s4a.analyse` or :func:`s4a.open_study`.
    n_samples : int
        Number of random shapes for specificity.
    n_permutations : int
        Number of permutations of the baseline (parallel analysis, Horn 1965).  Every coefficient of
        the displacements in the template's eigenfunctions is permuted over the shapes, so that
        fields stay smooth.
    n_points : int
        Number of vertices from which distances to surfaces are measured; 0 omits these measures.
    n_surface : int
        Number of random shapes whose distances to surfaces are measured.
    seed : int
        Seed of the random numbers.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.

    Returns
    -------
    Dataset
        All variables are measured with 1, 2, ... components:

        - ``compactness(component)``: cumulative variance of the first components.  Its standard
          error for s shapes is sqrt(2 / s) times the compactness (Davies 2002);
        - ``generalization(component)``: leave-one-out reconstruction error, NaN for the last
          component.  It is optimistic, as the correspondences are not recomputed;
        - ``specificity(component)``: distance of random shapes to the nearest shape of the study;
        - ``generalization_surface`` and ``specificity_surface``: the same as mean point-to-surface
          distances;
        - ``variance_ratio(component)``: share of the variance of each component;
        - ``variance_ratio_null`` and ``variance_ratio_null_95``: mean and 95 % quantile of that
          share in the baseline.

        Generalization and specificity are area-weighted root mean square vertex distances, in the
        unit of the input.  Each has a standard error.  The attribute ``generalization_0`` is the
        error of the mean shape alone.

    Raises
    ------
    ValueError
        If the study is not registered or has fewer than 4 shapes, or a number is out of range.

    See Also
    --------
    outliers : Detect outliers by the leave-one-out error of each shape.
    sample : Draw random shapes of the model.

    References
    ----------
    R. H. Davies (2002), Learning shape: optimal models for analysing natural variability, PhD
    thesis, University of Manchester.
    M. Styner et al. (2003), Evaluation of 3D correspondence methods for model building, IPMI.
    J. L. Horn (1965), A rationale and test for the number of factors in factor analysis,
    Psychometrika 30(2).

    Examples
    --------
    In a study of six small brains, more modes reconstruct a left-out shape better:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> quality = s4a.statistics.evaluate(study)
    >>> bool(quality["generalization"][0] > quality["generalization"][3])
    True
    """
    check_permutations(n_permutations)
    check_count("n_samples", n_samples, 2)
    check_count("n_points", n_points)
    check_count("n_surface", n_surface, 2)
    registration, d, area = displacements_of(study)
    s = len(d)
    generator = np.random.default_rng(seed_of(seed, rng))
    K = gram(d - d.mean(0), area)
    error, _ = leave_one_out(K)
    distance, nearest, score = specificity(K, n_samples, generator)
    variance, _ = principal_components(K)
    c = len(variance)
    compactness = np.cumsum(variance)
    quality = dataset(
        {"correspondence": KEPT, "shapes": s, "generalization_0": float(error[:, 0].mean())},
        compactness=compactness,
        compactness_error=np.sqrt(2 / s) * compactness,
        generalization=_per_component(error[:, 1:].mean(0), c),
        generalization_error=_per_component(stats.sem(error[:, 1:]), c),
        specificity=distance.mean(1),
        specificity_error=stats.sem(distance, axis=1),
    )
    if n_points:
        points = draw_points(area, n_points, generator)
        P = registration["position"].values[points] + d[:, points]  # (s, p, 3)
        samples = score[:n_surface], nearest[:, :n_surface]
        quality = quality.merge(_measure_surfaces(registration, d, K, P, *samples))
    quality = in_unit(quality, unit_of(registration["displacement"]))
    features = _coefficients(study, d, area)
    return quality.merge(_compare_with_chance(features, c, n_permutations, generator))


def _per_component(values, c):
    """Values for 1, 2, ... components ``(c,)``, NaN beyond the components of left-out models."""
    return np.pad(values, (0, c), constant_values=np.nan)[:c]


def _measure_surfaces(registration, d, K, P, score, nearest):
    """Generalization and specificity as mean distances of points P ``(s, p, 3)`` to surfaces."""
    X, T = as_arrays(registration)
    _, V = principal_components(K)
    c = V.shape[1]
    rows = []
    for i in range(len(d)):
        others = np.delete(np.arange(len(d)), i)
        *_, steps = describe_by_others(K[np.ix_(others, others)], K[i, others], K[i, i])
        rows.append(surface_error(P[others], steps, X + d[i], T))
    error = np.stack(rows)  # (s, s - 1)
    modes = np.einsum("sc,spx->cpx", V, P - P.mean(0)) / np.sqrt(len(d) - 1)
    samples = P.mean(0) + np.cumsum(score[:, :, None, None] * modes, axis=1)  # (n_samples, c, p, 3)
    distance = np.zeros(nearest.shape)  # (c, n_samples)
    for i in np.unique(nearest):
        component, sample = np.nonzero(nearest == i)
        distance[component, sample] = mean_distance(samples[sample, component], X + d[i], T)
    return dataset(
        generalization_surface=_per_component(error[:, 1:].mean(0), c),
        generalization_surface_error=_per_component(stats.sem(error[:, 1:]), c),
        specificity_surface=distance.mean(1),
        specificity_surface_error=stats.sem(distance, axis=1),
    )


def _compare_with_chance(features, c, n_permutations, rng):
    """Variance shares of the first c components, of the data and of permuted features."""
    ratio = np.linalg.svd(features - features.mean(0), compute_uv=False)[:c] ** 2
    null = variance_baseline(features, n_permutations, rng)[:, :c]
    return dataset(
        variance_ratio=ratio / ratio.sum(),
        variance_ratio_null=null.mean(0),
        variance_ratio_null_95=np.quantile(null, 0.95, axis=0),
    )


def _coefficients(study, d, area):
    """Coefficients ``(s, f)`` of displacements in an orthonormal basis of the eigenfunctions.

    Without eigenfunctions, in the basis of the vertices.
    """
    template = study["registration"].attrs.get("template", "")  # empty if it is not a shape
    if "coarse" not in study or template not in study["coarse"].children:
        return (d * np.sqrt(area)[:, None]).reshape(len(d), -1).astype(float)
    shape = Shape(study["original"][template].to_dataset(), study["coarse"][template].to_dataset())
    B = shape.U @ shape.low.Phi  # (n, k)
    B = B @ np.linalg.inv(np.linalg.cholesky(B.T @ (area[:, None] * B))).T
    return np.stack([smoother(B, area)(field) for field in d.astype(float)]).reshape(len(d), -1)


def sample(
    study: xr.DataTree,
    n: int,
    *,
    n_components: int | None = None,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.DataTree:
    """Draw random shapes of the model, with normal scores on the first components.

    Parameters
    ----------
    study : DataTree
        A finished study, from :func:`s4a.analyse` or :func:`s4a.open_study`.
    n : int
        Number of shapes.
    n_components : int, optional
        Number of components with random scores; by default all.
    seed : int
        Seed of the random numbers.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.

    Returns
    -------
    DataTree
        The nodes ``/sample_1``, ``/sample_2`` and so on, each with a mesh.  The root has
        ``score(shape, component)``, in standard deviations.

    Raises
    ------
    ValueError
        If the study has fewer than `n_components` components.

    See Also
    --------
    s4a.synthesize : Synthesise the shape of given scores.

    Examples
    --------
    In a study of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.statistics.sample(study, 2)["score"].dims
    ('shape', 'component')
    """
    check_type(study, xr.DataTree)
    check_count("n", n)
    most = study["pca"].sizes["component"]
    c = most if n_components is None else n_components
    check_count("n_components", c, 1, most)
    score = np.random.default_rng(seed_of(seed, rng)).normal(size=(n, c))
    names = [f"sample_{i + 1:0{len(str(n))}d}" for i in range(n)]
    meshes = {name: synthesize(study, row) for name, row in zip(names, score, strict=True)}
    return xr.DataTree.from_dict({"/": dataset(score=score).assign_coords(shape=names), **meshes})
