"""Modes of variation of the displacements (6.1, Fig. 4 and 5): PCA, and shapes from scores.

There are far fewer shapes s than vertices n, so PCA uses the Gram matrix ``(s, s)`` of the
displacements, which is fast for large meshes.  The matrix is summed over blocks of vertices, and
fields in files are read in parts, so memory is little more than that of the modes.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.linalg import eigh

from s4a.geometry.mesh import vertex_normals
from s4a.method.deform import normal_displacement, smoother
from s4a.schema import Array, check_type, dataset, in_unit, require, unit_of

BLOCK = 2**24  # numbers of all fields in a block of vertices: 128 MiB
N_READ = 8  # blocks that are read from files at once, in single precision


class _PrincipalModes(NamedTuple):
    """Modes of variation of s fields: c modes, c at most s - 1.

    ``mean (n, d)``; ``deformation (c, n, d)`` of one standard deviation along each mode;
    ``standard_deviation (c,)``, its area-weighted root mean square; ``score (s, c)``, uncorrelated
    and of variance 1 (divisor s - 1); ``ratio (c,)``, shares of the variance, descending.
    """

    mean: Array
    deformation: Array
    standard_deviation: Array
    score: Array
    ratio: Array


def gram(fields: Array | xr.Variable, area: Array, mean: Array | None = None) -> Array:
    """Return the area-weighted inner products ``(s, s)`` of fields ``(s, n, d)``.

    Parameters
    ----------
    fields : float ndarray or variable (s, n, d)
    area : float ndarray (n,)
        Scaled to sum 1.
    mean : float ndarray (n, d), optional
        Subtracted from each field.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.pca import gram
    >>> gram(np.array([[[1.0, 0, 0], [3, 0, 0]]]), np.array([1.0, 1.0])).round(6).tolist()
    [[5.0]]
    """
    weight = np.sqrt(area / area.sum())[:, None]
    K = np.zeros((len(fields), len(fields)))
    for block, values in parts(fields):
        centered = values if mean is None else values - mean[block]
        rows = np.asarray(centered, np.float64) * weight[block]
        rows = rows.reshape(len(fields), -1)  # (s, b d)
        K += rows @ rows.T
    return K


def blocks(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield the vertices of fields ``(s, n, d)`` in blocks of at most :data:`BLOCK` numbers.

    Examples
    --------
    >>> from s4a.method.pca import blocks
    >>> list(blocks((1000, 10_000, 3)))
    [slice(0, 5592, None), slice(5592, 11184, None)]
    """
    s, n, d = shape
    size = max(1, BLOCK // max(s * d, 1))
    for begin in range(0, n, size):
        yield slice(begin, begin + size)


def parts(fields: Array | xr.Variable) -> Iterator[tuple[slice, Array]]:
    """Yield the :func:`blocks` of fields ``(s, n, d)`` and their values, read in parts."""
    slices = list(blocks(fields.shape))
    for i in range(0, len(slices), N_READ):
        part = slices[i : i + N_READ]
        begin = part[0].start
        values = fields[:, begin : part[-1].stop]
        values = values.values if isinstance(values, xr.Variable) else values
        for block in part:
            yield block, values[:, block.start - begin : block.stop - begin]


def center_gram(K: Array) -> Array:
    """Centre a Gram matrix ``(s, s)``, as if the mean were subtracted from the fields."""
    return K - K.mean(0) - K.mean(1)[:, None] + K.mean(0).mean()


def principal_components(K: Array) -> tuple[Array, Array]:
    """Return variances ``(c,)`` and unit eigenvectors ``(s, c)`` of a Gram matrix, largest first.

    The matrix is centred first.  The divisor of the variances is s - 1; components without variance
    (below 1e-12 of the largest) are omitted.

    See Also
    --------
    sklearn.decomposition.KernelPCA : The same; its import takes longer than a small analysis.
    """
    values, vectors = eigh(center_gram(K))
    order = np.flatnonzero(values > 1e-12 * values[-1])[::-1]
    V = vectors[:, order]
    V *= np.sign(V[np.abs(V).argmax(0), np.arange(len(order))])  # eigenvectors have no sign
    return values[order] / (len(K) - 1), V


def gram_pca(fields: Array | xr.Variable, area: Array) -> _PrincipalModes:
    """PCA of fields under the area-weighted inner product.

    Parameters
    ----------
    fields : float ndarray or variable (s, n, d)
        One displacement field per shape; a variable may be in files.
    area : float ndarray (n,)
        Template vertex areas; their scale does not matter.

    Returns
    -------
    _PrincipalModes
        In the precision of the fields.  Signs are chosen for a positive third moment of the scores.
    """
    s = len(fields)
    mean = np.concatenate([values.mean(axis=0) for _, values in parts(fields)])
    variance, V = principal_components(gram(fields, area, mean))
    V = V * np.where((V**3).sum(0) < 0, -1.0, 1.0)  # (s, c)
    deformation = np.empty((V.shape[1], *mean.shape), np.result_type(fields.dtype, np.float32))
    for block, values in parts(fields):
        modes = np.einsum("sc,snd->cnd", V, values - mean[block], optimize=True)
        modes /= np.sqrt(s - 1)
        deformation[:, block] = modes
    ratio = variance / variance.sum()
    return _PrincipalModes(mean, deformation, np.sqrt(variance), V * np.sqrt(s - 1), ratio)


def low_vertices(coarse: xr.Dataset) -> Array:
    """Return for every coarse vertex the original vertex with its largest weight ``(n_coarse,)``.

    In SCALABLE the vertex of the sample.
    """
    if "local_weight" in coarse:
        return coarse["sample_vertex"].values
    vertex = coarse["coarse_vertex"].values  # (n, 3)
    order = np.argsort(coarse["coarse_weight"].values.ravel(), kind="stable")
    heaviest = np.zeros(coarse.sizes["vertex"], np.int64)
    heaviest[vertex.ravel()[order]] = order // vertex.shape[1]  # the last write wins
    return heaviest


def _smooth_low(d, coarse, *, area_weighted=True):
    """Smoothed low-resolution displacements Phi Phi^+ d ``(s, n_coarse, 3)``.

    The line after eq. 8 without U, so that Fig. 5 compares resolutions with equal smoothing.

    Parameters
    ----------
    d : float ndarray (s, n_coarse, 3)
    coarse : xarray.Dataset
        With ``eigenfunction`` and ``vertex_area``.
    area_weighted : bool
        Whether to weight vertices by area, see :func:`s4a.analyse`.
    """
    Phi, area = coarse["eigenfunction"].values, coarse["vertex_area"].values
    coefficients = smoother(Phi, area / area.sum() if area_weighted else np.ones(len(area)))
    return np.stack([Phi @ coefficients(field) for field in d.astype(float)])


def pca(
    registration: xr.Dataset,
    area: Array,
    *,
    coarse: xr.Dataset | None = None,
    area_weighted: bool = True,
) -> xr.Dataset:
    """Compute the modes of variation of a registered collection (6.1, Fig. 4 and 5).

    Parameters
    ----------
    registration : xarray.Dataset
        With ``displacement(shape, vertex, xyz)`` in the unit of the input.
    area : float ndarray (vertex,)
        Template vertex areas, the weights of the Gram matrix.
    coarse : xarray.Dataset, optional
        The template's low-resolution mesh, for variance shares at low resolution if the
        registration has ``displacement_low``: of the matches of eq. 6, smoothed as at full
        resolution, and unsmoothed.
    area_weighted : bool
        Whether the smoothing weights vertices by area, see :func:`s4a.analyse`.

    Returns
    -------
    xarray.Dataset
        ``mean_displacement``, ``deformation(component, vertex, xyz)`` of one standard deviation,
        ``standard_deviation(component)``, ``score(shape, component)``, ``explained_variance_ratio``
        and with `coarse` ``explained_variance_ratio_low`` and ``explained_variance_ratio_raw``.

    Raises
    ------
    ValueError
        If there are fewer than 3 shapes, or displacements are not finite or all equal.

    See Also
    --------
    s4a.synthesize : Reconstruct a shape from scores.
    project_scores : Scores of other displacements.
    """
    require(registration, "displacement", what="registration")
    d = registration["displacement"].transpose("shape", "vertex", "xyz").variable
    if len(d) < 3:
        raise ValueError(f"PCA needs at least 3 shapes; found {len(d)}")
    invalid = ~np.array([np.isfinite(d[i].values).all() for i in range(len(d))])
    if invalid.any():
        names = ", ".join(map(str, registration["shape"].values[invalid]))
        raise ValueError(f"PCA needs finite displacements; leave out {names}")
    modes = gram_pca(d, area)
    size = 1.0
    if "position" in registration:
        size = float(np.linalg.norm(registration["position"].values.std(axis=0)))
    if not len(modes.ratio) or modes.standard_deviation[0] < 1e-9 * size:
        raise ValueError("PCA needs shapes that differ; all displacements are equal")
    result = dataset(
        mean_displacement=modes.mean.astype(np.float32),
        deformation=modes.deformation.astype(np.float32, copy=False),
        standard_deviation=modes.standard_deviation,
        score=modes.score,
        explained_variance_ratio=modes.ratio,
    )
    if coarse is not None and "displacement_low" in registration:
        low = registration["displacement_low"].transpose("shape", "low_vertex", "xyz").values
        smooth = _smooth_low(low, coarse, area_weighted=area_weighted)
        smooth_ratio, raw_ratio = (
            np.pad(gram_pca(fields, coarse["vertex_area"].values).ratio, (0, len(d)))
            for fields in (smooth, low)
        )
        c = len(modes.ratio)  # as many as at full resolution
        low_ratios = dataset(
            explained_variance_ratio_low=smooth_ratio[:c],
            explained_variance_ratio_raw=raw_ratio[:c],
        )
        result = result.merge(low_ratios)
    result = in_unit(result, unit_of(registration["displacement"]))
    return result.assign_coords(shape=registration["shape"])


def synthesize(study: xr.DataTree, scores: Array) -> xr.Dataset:
    """Synthesise a shape from scores: the mean plus each score times the deformation of its mode.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.
    scores : array_like (c,)
        Scores of the first c components, in standard deviations.

    Returns
    -------
    xarray.Dataset
        A mesh with ``position(vertex, xyz)`` in the unit of the input and ``corner_vertex(triangle,
        corner)``.

    Raises
    ------
    ValueError
        If there are more scores than components, or the study has no PCA.

    See Also
    --------
    s4a.method.pca.pca : Compute the modes.
    s4a.explore : Change the scores interactively.

    References
    ----------
    T. F. Cootes et al. (1995), Active shape models: their training and application, Computer Vision
    and Image Understanding 61(1).

    Examples
    --------
    In a study of six small brains, scores of 0 give the mean shape:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> mean, larger = s4a.synthesize(study, [0.0]), s4a.synthesize(study, [2.0])
    >>> moved = (larger["position"] - mean["position"]) / 2
    >>> bool(abs(moved - study["pca"]["deformation"][0].values).max() < 1e-4)
    True

    The first mode of variation of five larger brains:

    >>> brains = s4a.synthetic.brains(5, 1500)
    >>> larger = s4a.analyse(brains, n_coarse=300, k=30, intersections=False)
    >>> along = {f"{x:+} sd": s4a.synthesize(larger, [float(x)]) for x in (-2, 0, 2)}
    >>> s4a.show.charts.surfaces(along, view="left")
    <TiledFigure ...>
    """
    check_type(study, xr.DataTree)
    scores = np.atleast_1d(np.asarray(scores, float))
    if "pca" not in study.children:
        reason = study["report"].attrs.get("no_modes") if "report" in study.children else ""
        raise ValueError(
            f"a study with /pca is needed; this one has none: {reason or 'it is not finished'}"
        )
    modes = study["pca"].to_dataset()
    require(modes, "deformation", "mean_displacement", what="pca dataset")
    if scores.ndim != 1 or len(scores) > modes.sizes["component"]:
        raise ValueError(
            f"scores need at most {modes.sizes['component']} numbers; found shape {scores.shape}"
        )
    template = study["registration"].to_dataset()
    mean = template["position"].values + modes["mean_displacement"].values
    position = apply_scores(mean, modes["deformation"].values, scores)
    mesh = xr.merge([dataset(position=position), template[["corner_vertex"]]])
    return in_unit(mesh, unit_of(template["position"]))


def apply_scores(mean: Array, deformation: Array, scores: Array) -> Array:
    """Return the mean shape ``(n, 3)`` plus scores ``(c,)`` times deformations ``(c, n, 3)``.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.pca import apply_scores
    >>> deformation = np.array([[[1.0, 0, 0]], [[0, 2.0, 0]]])
    >>> apply_scores(np.zeros((1, 3)), deformation, [0.5, -1]).tolist()
    [[0.5, -2.0, 0.0]]
    """
    scores = np.asarray(scores, float)
    return mean + np.tensordot(scores, deformation[: len(scores)], axes=1)


def mahalanobis(scores: Array) -> float:
    """Return the Mahalanobis distance of a shape from the mean: the norm of its scores.

    Examples
    --------
    >>> from s4a.method.pca import mahalanobis
    >>> mahalanobis([3, -4])
    5.0
    """
    return float(np.linalg.norm(scores))


def plausible_scores(n: int, *, seed: int | None = None, limit: float = 3.0) -> Array:
    """Draw scores ``(n,)`` of a random shape from a normal distribution truncated at the limit.

    Examples
    --------
    >>> from s4a.method.pca import plausible_scores
    >>> bool((abs(plausible_scores(1000, seed=0)) <= 3).all())
    True
    """
    rng = np.random.default_rng(seed)
    scores = rng.standard_normal(n)
    while (beyond := np.abs(scores) > limit).any():
        scores[beyond] = rng.standard_normal(beyond.sum())
    return scores


def color_limits(mean: Array, triangles: Array, deformation: Array) -> tuple[float, float]:
    """Return the colour limits of displacements ``(c, n, 3)``: along the normal, and in length.

    The 95 % quantile over vertices and modes at 3 standard deviations, which is one scale for all
    modes and robust to outlying vertices.
    """
    along = normal_displacement(deformation, vertex_normals(mean, triangles))
    sizes = np.abs(along), np.linalg.norm(deformation, axis=2)
    limit, limit_length = (float(3 * np.quantile(size, 0.95)) or 1.0 for size in sizes)
    return limit, limit_length


def project_scores(
    d: Array, mean: Array, deformation: Array, standard_deviation: Array, area: Array
) -> tuple[Array, Array]:
    """Project displacements onto given modes: scores and residuals.

    Parameters
    ----------
    d : float ndarray (s, n, 3)
    mean : (n, 3), deformation : (c, n, 3), standard_deviation : (c,)
        Modes of :func:`gram_pca`.
    area : float ndarray (n,)

    Returns
    -------
    score : (s, c), in standard deviations
    residual : (s,), area-weighted root mean square of the residual
    """
    w = area / area.sum()
    scores, residuals = [], []
    for field in d:  # separately, so that the last digit does not depend on the other shapes
        x = np.asarray(field, float) - mean
        along = np.einsum("cnx,nx->c", deformation, x * w[:, None], optimize=True)
        score = along / standard_deviation**2
        total = np.einsum("nx,nx,n->", x, x, w, optimize=True)
        squared = total - ((score * standard_deviation) ** 2).sum()
        scores.append(score)
        residuals.append(np.sqrt(max(squared, 0.0)))
    return np.array(scores), np.array(residuals)


def pca_without(
    registration: xr.Dataset,
    excluded: list[str],
    coarse: xr.Dataset | None,
    *,
    area_weighted: bool = True,
) -> xr.Dataset:
    """Compute the modes of variation without some shapes, and the scores of these shapes.

    Parameters
    ----------
    registration : xarray.Dataset
        With ``vertex_area`` and the variables that :func:`pca` needs.
    excluded : list of str
        Shapes that do not contribute to the modes.
    coarse, area_weighted : see :func:`pca`

    Returns
    -------
    xarray.Dataset
        Result of :func:`pca`, with ``score_excluded(shape_excluded, component)`` if shapes are
        excluded.

    Raises
    ------
    ValueError
        As for :func:`pca`.
    """
    area = registration["vertex_area"].values
    names = [name for name in registration["shape"].values.tolist() if name not in excluded]
    try:
        included = registration.sel(shape=names)
        result = pca(included, area, coarse=coarse, area_weighted=area_weighted)
    except ValueError as error:
        if not excluded:
            raise
        raise ValueError(
            f"{error}; {len(excluded)} flagged shapes are excluded: include_flagged=True "
            "includes them"
        ) from error
    if not excluded:
        return result
    mean, deformation = result["mean_displacement"].values, result["deformation"].values
    d, sd = registration["displacement"].sel(shape=excluded), result["standard_deviation"].values
    score, _ = project_scores(d.values, mean, deformation, sd, area)
    return result.merge(dataset(score_excluded=score)).assign_coords(shape_excluded=excluded)
