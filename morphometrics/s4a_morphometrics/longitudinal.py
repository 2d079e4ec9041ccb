"""Growth and repeated measures (6.1): change of shape within subjects with several visits.

At every vertex and coordinate y_ij = b_0 + b_1 t_ij + z_ij b + u_i + e_ij: visit j of subject i at
time t_ij, covariates z, a random intercept u_i of variance s_u^2, and a residual of variance s_e^2
(Laird and Ware 1982).  Given the ratio r = s_u^2 / s_e^2, the other parameters have a closed form.
A line search, for all vertices at once, finds the r that maximises the restricted likelihood.  If
all subjects were measured at the same times, the slope is that within subjects for any r.

For p values, visits are permuted within subjects.  The means of subjects, and thus u_i, are
subtracted first; without change, the visits of a subject are exchangeable.
"""

import logging
from typing import NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.inputs import Values, lacks_value, registration_of, sample_of, values_of
from s4a.analysis.model import count_components
from s4a.analysis.permutation import Model, check_options, standardize
from s4a.analysis.statistics import (
    fields_to_test,
    freed_deviation,
    numbers_of,
    squared_cohen_f,
    vertex_results,
)
from s4a.input.columns import check_column
from s4a.input.subjects import listed
from s4a.method.pca import gram, principal_components
from s4a.schema import dataset, in_unit
from s4a.seeds import RNG, seed_of
from s4a_morphometrics.fields import field_sample

log = logging.getLogger(__name__)

RATIOS = np.r_[0, np.geomspace(1e-3, 1e6, 37)]  # grid of variance ratios for the search
STEPS = 60  # golden-section steps: 1e-12 of a grid interval
GOLDEN = (np.sqrt(5) - 1) / 2


def labels_of(study: xr.DataTree, values: Values, what: str) -> list[str]:
    """Return a subject, side or other label of each shape as text, empty if it is missing."""
    names = registration_of(study)["shape"].values.tolist()
    found = values_of(study, values, what)
    present = ~lacks_value(found)
    kept = [name for name, one in zip(names, present, strict=True) if one]
    check_column(found[present], kept, what, categories=True)
    return [str(x) if one else "" for x, one in zip(found.tolist(), present, strict=True)]


class Mixed(NamedTuple):
    """Fitted random-intercept model of v responses.

    ``slope (p, v)`` of the columns and its standard ``error (p, v)``; ``ratio (v,)`` of the
    variance of the intercepts to the residual variance, and the latter, ``variance (v,)``.
    """

    slope: np.ndarray
    error: np.ndarray
    ratio: np.ndarray
    variance: np.ndarray


def random_intercepts(
    Y: np.ndarray, X: np.ndarray, subject: np.ndarray, *, restricted: bool = True
) -> Mixed:
    """Fit y = X b + u_subject + e to many responses at once, by restricted likelihood.

    With m_i visits of subject i, V_i^-1 = I - r / (1 + m_i r) 1 1^T.  X^T V^-1 X and similar
    products are therefore sums over the few different m_i; b and the variance follow from r.

    Parameters
    ----------
    Y : float ndarray (n, v)
    X : float ndarray (n, p)
        With a column of ones.
    subject : int ndarray (n,)
    restricted : bool
        Restricted likelihood (REML), or the likelihood.

    Returns
    -------
    Mixed

    Raises
    ------
    ValueError
        If the columns of X are linearly dependent.

    References
    ----------
    N. M. Laird and J. H. Ware (1982), Random-effects models for longitudinal data, Biometrics
    38(4).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.longitudinal import random_intercepts
    >>> age, subject = np.tile([1.0, 2, 3], 4), np.repeat([0, 1, 2, 3], 3)
    >>> Y = 2 * age + 10 * subject + np.tile([0.1, -0.2, 0.1], 4)
    >>> fit = random_intercepts(Y[:, None], np.column_stack([np.ones(12), age]), subject)
    >>> fit.slope[1].round(6).tolist(), bool(fit.ratio[0] > 100)
    ([2.0], True)
    """
    n, p = X.shape
    scale = np.linalg.norm(X, axis=0)
    Q, R = np.linalg.qr(X / np.where(scale > 0, scale, 1))
    if abs(np.diag(R)).min() < 1e-9:
        raise ValueError("columns of the model are linearly dependent: leave one of them out")
    first = Q.T @ Y
    Y = Y - Q @ first  # least-squares residuals, to limit cancellation
    code, sizes = np.unique(subject, return_inverse=True, return_counts=True)[1:]
    indicator = np.zeros((len(sizes), n))
    indicator[code, np.arange(n)] = 1
    sums, totals = indicator @ Q, indicator @ Y  # (s, p), (s, v)
    counts, which = np.unique(sizes, return_inverse=True)  # (m,) different numbers of visits
    masks = [which == i for i in range(len(counts))]
    S = np.stack([sums[mask].T @ sums[mask] for mask in masks])  # (m, p, p)
    U = np.stack([sums[mask].T @ totals[mask] for mask in masks])  # (m, p, v)
    T = np.stack([(totals[mask] ** 2).sum(0) for mask in masks])  # (m, v)
    number = np.array([mask.sum() for mask in masks])
    squared = (Y**2).sum(0)  # (v,)
    floor = 1e-24 * squared.max(initial=0) + np.finfo(float).tiny
    dof = n - p if restricted else n

    def solve(r):
        """A = Q^T V^-1 Q (v, p, p), A^-1 Q^T V^-1 y (v, p) and the weighted residual (v,)."""
        c = r[:, None] / (1 + r[:, None] * counts)  # (v, m)
        A = np.eye(p) - np.einsum("vm,mpq->vpq", c, S)
        b = -np.einsum("vm,mpv->vp", c, U)
        rest = squared - np.einsum("vm,mv->v", c, T)
        solved = np.linalg.solve(A, b[..., None])[..., 0]
        return A, solved, np.maximum(rest - (b * solved).sum(1), floor)

    def deviance(r):
        """-2 log of the likelihood, up to a constant ``(v,)``."""
        A, _, rest = solve(r)
        value = dof * np.log(rest) + np.log1p(r[:, None] * counts) @ number
        return value + np.linalg.slogdet(A)[1] if restricted else value

    v = Y.shape[1]
    grid = np.stack([deviance(np.full(v, r)) for r in RATIOS])  # (g, v)
    best = grid.argmin(0)
    low, high = RATIOS[np.maximum(best - 1, 0)], RATIOS[np.minimum(best + 1, len(RATIOS) - 1)]
    ratio = _golden(deviance, low, high)
    A, solved, rest = solve(ratio)
    variance = rest / dof
    back = np.linalg.inv(R) / np.where(scale > 0, scale, 1)[:, None]  # from Q to columns of X
    covariance = np.einsum("pa,vab,qb->vpq", back, np.linalg.inv(A), back, optimize=True)
    error = np.sqrt(np.einsum("vpp->pv", covariance) * variance)
    return Mixed(back @ (first + solved.T), error, ratio, variance)


def _golden(function, low, high):
    """Minimise independent functions of one variable each between two bounds (golden section)."""
    a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_a, at_b = function(a), function(b)
    for _ in range(STEPS):
        left = at_a < at_b
        high, low = np.where(left, b, high), np.where(left, low, a)
        a_next = np.where(left, high - GOLDEN * (high - low), b)
        b_next = np.where(left, a, low + GOLDEN * (high - low))
        new = function(np.where(left, a_next, b_next))
        at_a, at_b = np.where(left, new, at_b), np.where(left, at_a, new)
        a, b = a_next, b_next
    middle, zero = (low + high) / 2, np.zeros_like(low)
    return np.where(function(zero) <= function(middle), zero, middle)


def within_subjects(values: np.ndarray, subject: np.ndarray) -> np.ndarray:
    """Subtract the mean of each subject from values ``(n, ...)``.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.longitudinal import within_subjects
    >>> within_subjects(np.array([1.0, 3, 7]), np.array([0, 0, 1])).tolist()
    [-1.0, 1.0, 0.0]
    """
    code, sizes = np.unique(subject, return_inverse=True, return_counts=True)[1:]
    flat = np.reshape(values, (len(values), -1)).astype(float)
    sums = np.zeros((len(sizes), flat.shape[1]))
    np.add.at(sums, code, flat)
    left = flat - (sums / sizes[:, None])[code]
    # a mean of equal numbers may differ from them by rounding
    left[abs(left) <= 1e-13 * abs(flat).max(initial=0)] = 0
    return left.reshape(np.shape(values))


def growth(
    study: xr.DataTree,
    time: Values,
    subject: Values,
    *,
    covariates: Values | None = None,
    field: str | None = None,
    of: str = "vector",
    n_components: int | None = None,
    n_permutations: int = 999,
    variances: str = "equal",
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Estimate and test the change of shape with time, for subjects with several visits.

    Parameters
    ----------
    study : DataTree
    time : array_like (shape,), dict of shape to value, or name in /subjects
        Age, or time since the first visit.
    subject : as `time`, numbers or text
        Subject of each shape.
    covariates, field, n_components, n_permutations, seed, rng
        See :func:`s4a.statistics.group_test`.  Covariates with one value per subject affect the
        slopes, but no p value.
    of : see :func:`s4a.statistics.group_map`
        Quantity of the test; slopes are vectors.
    variances : {"equal", "unequal"}
        "equal" permutes visits within subjects: the null hypothesis is no change in any subject.
        "unequal" changes signs of whole subjects: the null hypothesis is no change on average, and
        subjects may have different slopes and variances.

    Returns
    -------
    Dataset
        ``effect(vertex, xyz)`` per unit of time, its standard error ``effect_error``, and
        ``intercept(vertex, xyz)`` at the mean time, by restricted likelihood with random intercepts
        for each coordinate; ``within_effect(vertex, xyz)``, the slope within subjects only;
        ``subject_variance(vertex)`` of the intercepts and ``residual_variance(vertex)``, sums over
        the coordinates, and ``intraclass_correlation(vertex)``.
        Test of change within subjects: ``statistic`` and ``p_value`` of the whole shape, at every
        vertex as in :func:`s4a.statistics.group_map`, ``effect_size`` = Cohen's f.
        ``standard_score(shape)`` of time; ``shape_time(shape)``, the time at which the mean shape
        is closest to each.  For a field, ``field_effect``, ``field_error``, ``field_intercept`` and
        ``field_within_effect`` replace the first four.  Attributes as in
        :func:`s4a.statistics.regression`, and the numbers of ``subjects`` and of those with one
        visit only, ``once``.

    Raises
    ------
    ValueError
        If fewer than two subjects were measured at different times, time is text, constant or a
        combination of the covariates, or an option is out of range.

    See Also
    --------
    s4a.statistics.predict : mean shape at a time.
    s4a.statistics.regression_modes : the trajectory as a mode of variation.

    Notes
    -----
    A subject with one visit contributes to the slopes, but not to the test.

    References
    ----------
    N. M. Laird and J. H. Ware (1982), Random-effects models for longitudinal data, Biometrics
    38(4).

    Examples
    --------
    With the ``study`` of six small brains, as visits of three subjects:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> age, subject = [1, 2, 1, 3, 2, 4], ["a", "a", "b", "b", "c", "c"]
    >>> fit = s4a_morphometrics.growth(study, age, subject, of="normal", n_permutations=99)
    >>> fit["effect"].dims, fit.attrs["subjects"], fit.attrs["smallest_p"]
    (('vertex', 'xyz'), 3, 0.25)
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    on_field = None
    if field is None:
        sample = sample_of(study, time, "time", covariates)
    elif of == "normal":
        raise ValueError("a field has no normal component: leave out of='normal'")
    else:
        on_field = field_sample(study, field, time, "time", covariates)
        sample = on_field.sample
    numbers_of(sample.values, "time")
    sample, subjects = _with_subjects(study, sample, subject)
    t = sample.values.astype(float)
    repeated = _repeated(t, subjects)
    columns = [np.ones(len(t)), t - t.mean()]
    if sample.Z is not None:
        columns += list(_independent(sample.Z, t).T)
    X = np.column_stack(columns)
    d = sample.d.astype(float)
    mixed = random_intercepts(d.reshape(len(d), -1), X, subjects)
    test = _test(sample, t, subjects, repeated, of, n_components, options)
    test.update(_estimates(sample, mixed, t, subjects, repeated))
    result = dataset(test.pop("attrs"), **test)
    result = in_unit(result, sample.unit) if on_field is None else on_field.on_template(result)
    shapes = sample.registration["shape"].values
    return result.assign_coords(shape=shapes).assign_attrs(
        mean=float(t.mean()),
        lowest=float(t.min()),
        highest=float(t.max()),
        standard_deviation=float(t.std(ddof=1)),
        freed_deviation=_deviation_within(sample.Z, t, subjects),
        of=of,
        subjects=len(np.unique(subjects)),
        once=len(np.unique(subjects[~repeated])),
        **sample.attributes,
    )


def _deviation_within(Z, t, subject):
    """Return the standard deviation of time within subjects, adjusted for the covariates."""
    inside = within_subjects(t[:, None], subject)[:, 0]
    return freed_deviation(inside, None if Z is None else within_subjects(Z, subject))


def _with_subjects(study, sample, subject):
    """Return the sample of shapes with a subject, and the subject of each."""
    shapes = sample.registration["shape"].values
    names = registration_of(study)["shape"].values.tolist()
    subject_of = dict(zip(names, labels_of(study, subject, "subject"), strict=True))
    subjects = np.array([subject_of[shape] for shape in shapes.tolist()])
    present = subjects != ""
    if not present.all():
        lacking = shapes[~present].tolist()
        log.warning("left out, because the subject is missing: %s", listed(lacking, most=9))
        attributes = {**sample.attributes}
        attributes["left_out"] = ", ".join(filter(None, [attributes["left_out"], *lacking]))
        sample = sample._replace(
            registration=sample.registration.isel(shape=present),
            d=sample.d[present],
            values=sample.values[present],
            Z=None if sample.Z is None else sample.Z[present],
            attributes=attributes,
        )
    return sample, subjects[present]


def _repeated(t, subject):
    """Return a mask of visits of subjects with different times; a warning names the others."""
    differs = within_subjects(t, subject) != 0
    names = np.unique(subject).tolist()
    several = {name for name in names if differs[subject == name].any()}
    once = [name for name in names if name not in several]
    if len(several) < 2:
        raise ValueError(
            "growth needs at least two subjects with visits at different times, found "
            f"{len(several)} of {len(names)}; for one visit of each, use a regression"
        )
    if once:
        log.warning(
            "visits at one time only, left out of the test of change: %s", listed(once, most=9)
        )
    return np.isin(subject, sorted(several))


def _independent(Z, t):
    """Return the linearly independent columns of the covariates."""
    columns = standardize(np.column_stack([t, Z]))[0]
    independent = [0]
    for i in range(1, columns.shape[1]):
        basis = columns[:, independent]
        rest = columns[:, i] - basis @ np.linalg.lstsq(basis, columns[:, i], rcond=None)[0]
        if np.linalg.norm(rest) > 1e-8:
            independent.append(i)
    return columns[:, independent[1:]]


def _test(sample, t, subject, repeated, of, n_components, options):
    """Test change within subjects, of the whole shape and at every vertex."""
    subject, d = subject[repeated], sample.d[repeated]
    x = within_subjects(t[repeated], subject)
    Z = None
    if sample.Z is not None:
        Z = within_subjects(sample.Z[repeated], subject)
        Z = Z if Z.any() else None
    E = within_subjects(d, subject)
    fields = fields_to_test(E, sample.registration, of)
    n_subjects = len(np.unique(subject))
    rank = 0 if Z is None else int(np.linalg.matrix_rank(standardize(Z)[0]))
    dof = len(x) - n_subjects - rank  # of visits
    if dof < fields.shape[2] + 1:
        raise ValueError(
            f"{len(x)} visits of {n_subjects} subjects are too few for a test of "
            f"{fields.shape[2]} coordinates at a vertex: more visits needed, or of='normal'"
        )
    model = Model(x, Z, blocks=subject, **options)
    at_vertices = vertex_results(model.vertex_test(fields))
    variance, V = principal_components(gram(E, sample.area))
    if not len(variance):
        raise ValueError("growth needs shapes that differ within subjects; all visits are equal")
    c = count_components(variance, dof, n_components, most=len(variance))
    statistic, p_value = model.test(V[:, :c] * np.sqrt(len(E) - 1))
    return at_vertices | {
        "attrs": {"components": c} | model.attributes(),
        "effect_size": np.sqrt(squared_cohen_f(at_vertices["explained_share"])),
        # the means of subjects take degrees of freedom
        "statistic": statistic * (dof - 1) / (len(x) - 2 - rank),
        "p_value": p_value,
    }


def _estimates(sample, mixed, t, subject, repeated):
    """Return slopes, their errors, variances, and the time of each shape on the trajectory."""
    k = sample.d.shape[2]
    subject = subject[repeated]
    x = within_subjects(t[repeated], subject)
    E = within_subjects(sample.d[repeated].astype(float), subject).reshape(len(x), -1)
    columns = [x]
    if sample.Z is not None:
        columns += list(within_subjects(sample.Z[repeated], subject).T)
    C, scale = np.column_stack(columns), np.linalg.norm(np.column_stack(columns), axis=0)
    scale[scale == 0] = 1
    within = (np.linalg.pinv(C / scale, rcond=1e-10) @ E)[0] / scale[0]
    slope, intercept = mixed.slope[1], mixed.slope[0]
    weight = np.repeat(sample.area, k)
    around = sample.d.reshape(len(t), -1) - intercept
    size = (slope**2) @ weight
    shape_time = t.mean() + (around * slope) @ weight / (size if size > 0 else 1)
    residual = mixed.variance.reshape(-1, k).sum(1)
    between = (mixed.ratio * mixed.variance).reshape(-1, k).sum(1)
    share = between / np.where(between + residual > 0, between + residual, 1)
    named = {"effect": slope, "effect_error": mixed.error[1], "within_effect": within}
    named["intercept"] = intercept
    return {name: values.reshape(-1, k) for name, values in named.items()} | {
        "subject_variance": between,
        "residual_variance": residual,
        "intraclass_correlation": share,
        "standard_score": (t - t.mean()) / t.std(ddof=1),
        "shape_time": shape_time,
    }
