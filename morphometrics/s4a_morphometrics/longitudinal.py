"""Growth and repeated measures (6.1): several visits of each subject, change within subjects.

At every vertex and coordinate y_ij = b_0 + b_1 t_ij + z_ij b + u_i + e_ij: visit j of subject i at
time t_ij, covariates z, an intercept u_i of the subject, normal of variance s_u^2, and a residual
of variance s_e^2 (Laird and Ware 1982).  Given the ratio r = s_u^2 / s_e^2 all else has a closed
form; r itself is where the restricted likelihood is largest, by a search along one line for all
vertices at once.  Where all subjects were seen at the same times the slope is that within subjects,
whatever r is.

p values are those of visits permuted within their subjects: what differs between subjects, and so
u_i, is taken from both sides first, and blocks of visits are exchangeable where nothing changes.
"""

import logging
from typing import NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.effects import (
    fields_to_test,
    freed_deviation,
    numbers_of,
    squared_cohen_f,
    vertex_results,
)
from s4a.analysis.inputs import Values, registration_of, sample_of, values_of
from s4a.analysis.model import count_components
from s4a.analysis.permutation import Model, check_options, standardize
from s4a.input.subjects import listed
from s4a.method.pca import gram, principal_components
from s4a.schema import dataset, in_unit
from s4a.seeds import RNG, seed_of
from s4a_morphometrics.fields import field_sample

log = logging.getLogger(__name__)

RATIOS = np.r_[0, np.geomspace(1e-3, 1e6, 37)]  # of variances, where the search begins
STEPS = 60  # of the golden section: 1e-12 of what is between two of them
GOLDEN = (np.sqrt(5) - 1) / 2


class Mixed(NamedTuple):
    """A model of random intercepts: of each of v responses.

    ``slope (p, v)`` of the columns and their standard ``error (p, v)``, ``ratio (v,)`` of the
    variance of the intercepts to that of the residuals, and the latter, ``variance (v,)``.
    """

    slope: np.ndarray
    error: np.ndarray
    ratio: np.ndarray
    variance: np.ndarray


def random_intercepts(
    Y: np.ndarray, X: np.ndarray, subject: np.ndarray, *, restricted: bool = True
) -> Mixed:
    """Fit y = X b + u_subject + e to many responses at once, by the restricted likelihood.

    With m_i visits of subject i, V_i^-1 = I - r / (1 + m_i r) 1 1^T, so that X^T V^-1 X and its
    like are sums over the few different m_i, and b and the variance follow from r.

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
        When the columns of X depend on each other.

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
        raise ValueError("columns of the model depend on each other: leave one of them out")
    first = Q.T @ Y
    Y = Y - Q @ first  # residuals of least squares: what is left has few digits to lose
    code, sizes = np.unique(subject, return_inverse=True, return_counts=True)[1:]
    of_subject = np.zeros((len(sizes), n))
    of_subject[code, np.arange(n)] = 1
    sums, totals = of_subject @ Q, of_subject @ Y  # (s, p), (s, v)
    counts, which = np.unique(sizes, return_inverse=True)  # (m,) different numbers of visits
    each = [which == i for i in range(len(counts))]
    S = np.stack([sums[of].T @ sums[of] for of in each])  # (m, p, p)
    U = np.stack([sums[of].T @ totals[of] for of in each])  # (m, p, v)
    T = np.stack([(totals[of] ** 2).sum(0) for of in each])  # (m, v)
    number = np.array([of.sum() for of in each])
    squared = (Y**2).sum(0)  # (v,)
    floor = 1e-24 * squared.max(initial=0) + np.finfo(float).tiny
    dof = n - p if restricted else n

    def parts(r):
        """A = Q^T V^-1 Q (v, p, p), Q^T V^-1 y (v, p) and the weighted residual (v,)."""
        c = r[:, None] / (1 + r[:, None] * counts)  # (v, m)
        A = np.eye(p) - np.einsum("vm,mpq->vpq", c, S)
        b = -np.einsum("vm,mpv->vp", c, U)
        rest = squared - np.einsum("vm,mv->v", c, T)
        solved = np.linalg.solve(A, b[..., None])[..., 0]
        return A, solved, np.maximum(rest - (b * solved).sum(1), floor)

    def deviance(r):
        """-2 log of the likelihood, up to a constant ``(v,)``."""
        A, _, rest = parts(r)
        found = dof * np.log(rest) + np.log1p(r[:, None] * counts) @ number
        return found + np.linalg.slogdet(A)[1] if restricted else found

    v = Y.shape[1]
    grid = np.stack([deviance(np.full(v, r)) for r in RATIOS])  # (g, v)
    best = grid.argmin(0)
    low, high = RATIOS[np.maximum(best - 1, 0)], RATIOS[np.minimum(best + 1, len(RATIOS) - 1)]
    ratio = _golden(deviance, low, high)
    A, solved, rest = parts(ratio)
    variance = rest / dof
    back = np.linalg.inv(R) / np.where(scale > 0, scale, 1)[:, None]  # of Q to columns of X
    covariance = np.einsum("pa,vab,qb->vpq", back, np.linalg.inv(A), back, optimize=True)
    error = np.sqrt(np.einsum("vpp->pv", covariance) * variance)
    return Mixed(back @ (first + solved.T), error, ratio, variance)


def _golden(function, low, high):
    """Where a function of many variables, each on its own, is least between two bounds."""
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
    found, at_zero = (low + high) / 2, np.zeros_like(low)
    return np.where(function(at_zero) <= function(found), at_zero, found)


def within_subjects(values: np.ndarray, subject: np.ndarray) -> np.ndarray:
    """Values ``(n, ...)`` less the mean of their subject.

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
    """How does shape change with time, where subjects were seen several times?

    Parameters
    ----------
    study : DataTree
    time : array_like (shape,), dict of shape to value, or name in /subjects
        Age, or time since the first visit.
    subject : as `time`, numbers or text
        Whose each shape is.
    covariates, field, n_components, n_permutations, seed, rng
        See :func:`s4a.statistics.group_test`.  Covariates that are one value for each subject count
        in the slopes, and change no p value.
    of : see :func:`s4a.statistics.group_map`
        Of the test; slopes are of vectors.
    variances : {"equal", "unequal"}
        Visits are permuted within their subjects: a test of no change in anyone.  Or the signs of
        whole subjects are changed, so that each keeps its own slope and variance: a test of no
        change on average, to take where subjects change differently.

    Returns
    -------
    Dataset
        ``effect(vertex, xyz)`` per unit of time, its standard error ``effect_error``, and
        ``intercept(vertex, xyz)`` where time is at its mean, by the restricted likelihood of random
        intercepts for each coordinate; ``within_effect(vertex, xyz)``, the slope within subjects
        alone; ``subject_variance(vertex)`` of the intercepts and ``residual_variance(vertex)``,
        sums over the coordinates, and ``intraclass_correlation(vertex)``.
        The test of change within subjects: of the whole shape ``statistic`` and ``p_value``, at
        every vertex as of :func:`s4a.statistics.group_map`, ``effect_size`` = Cohen's f.
        ``standard_score(shape)`` of time; ``shape_time(shape)``, the time at which the mean shape
        is nearest to each.  Of a field ``field_effect``, ``field_error``, ``field_intercept`` and
        ``field_within_effect`` in place of the first.  Attributes as of
        :func:`s4a.statistics.regression`, and how many ``subjects`` and those seen ``once``.

    Raises
    ------
    ValueError
        When fewer than two subjects were seen at different times, time is text, constant or a
        combination of the covariates, or an option is out of range.

    Notes
    -----
    :func:`s4a.statistics.predict` gives the mean shape at a time, and
    :func:`s4a.statistics.regression_modes` the trajectory for everything that shows modes.  A
    subject that was seen once says something of slopes, and nothing of the test.

    Examples
    --------
    With the ``study`` of six small brains, as of three subjects:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> age, subject = [1, 2, 1, 3, 2, 4], ["a", "a", "b", "b", "c", "c"]
    >>> fit = s4a_morphometrics.growth(study, age, subject, of="normal", n_permutations=99)
    >>> fit["effect"].dims, fit.attrs["subjects"], fit.attrs["smallest_p"]
    (('vertex', 'xyz'), 3, 0.25)
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    of_field = None
    if field is None:
        sample = sample_of(study, time, "time", covariates)
    elif of == "normal":
        raise ValueError("a field has no part along the normals: leave out of='normal'")
    else:
        of_field = field_sample(study, field, time, "time", covariates)
        sample = of_field.sample
    numbers_of(sample.values, "time")
    sample, whose = _with_subjects(study, sample, subject)
    t = sample.values.astype(float)
    seen = _seen(t, whose)
    columns = [np.ones(len(t)), t - t.mean()]
    if sample.Z is not None:
        columns += list(_independent(sample.Z, t).T)
    X = np.column_stack(columns)
    d = sample.d.astype(float)
    mixed = random_intercepts(d.reshape(len(d), -1), X, whose)
    test = _test(sample, t, whose, seen, of, n_components, options)
    test.update(_estimates(sample, mixed, t, whose, seen))
    result = dataset(test.pop("attrs"), **test)
    result = in_unit(result, sample.unit) if of_field is None else of_field.on_template(result)
    shapes = sample.registration["shape"].values
    return result.assign_coords(shape=shapes).assign_attrs(
        mean=float(t.mean()),
        lowest=float(t.min()),
        highest=float(t.max()),
        standard_deviation=float(t.std(ddof=1)),
        freed_deviation=_deviation_within(sample.Z, t, whose),
        of=of,
        subjects=len(np.unique(whose)),
        once=len(np.unique(whose[~seen])),
        **sample.attributes,
    )


def _deviation_within(Z, t, subject):
    """The standard deviation of time within subjects, of what the covariates leave of it there."""
    inside = within_subjects(t[:, None], subject)[:, 0]
    return freed_deviation(inside, None if Z is None else within_subjects(Z, subject))


def _with_subjects(study, sample, subject):
    """The sample of shapes whose subject is known, and a number for the subject of each."""
    shapes = sample.registration["shape"].values
    everyone = values_of(study, subject, "subject")
    names = registration_of(study)["shape"].values.tolist()
    of = dict(zip(names, (str(one) for one in everyone.tolist()), strict=True))
    words = np.array([of[shape] for shape in shapes.tolist()])
    known = (words != "") & (words != "nan")
    if not known.all():
        lacking = shapes[~known].tolist()
        log.warning("no subject, and left out: %s", listed(lacking, most=9))
        said = {**sample.attributes}
        said["left_out"] = ", ".join(filter(None, [said["left_out"], *lacking]))
        sample = sample._replace(
            registration=sample.registration.isel(shape=known),
            d=sample.d[known],
            values=sample.values[known],
            Z=None if sample.Z is None else sample.Z[known],
            said=said,
        )
    return sample, words[known]


def _seen(t, subject):
    """Which visits are of subjects that were seen at different times; says who was seen once."""
    moved = within_subjects(t, subject) != 0
    several = {one for one in np.unique(subject).tolist() if moved[subject == one].any()}
    names = np.unique(subject).tolist()
    once = [one for one in names if one not in several]
    if len(several) < 2:
        raise ValueError(
            "growth needs at least two subjects that were seen at different times, found "
            f"{len(several)} of {len(names)}; for one visit of each, take a regression"
        )
    if once:
        log.warning(
            "seen at one time only, so that the test of change does not have them: %s",
            listed(once, most=9),
        )
    return np.isin(subject, sorted(several))


def _independent(Z, t):
    """The columns of the covariates that are not constant or combinations of those before."""
    columns = standardize(np.column_stack([t, Z]))[0]
    kept = [0]
    for i in range(1, columns.shape[1]):
        rest = (
            columns[:, i]
            - columns[:, kept] @ np.linalg.lstsq(columns[:, kept], columns[:, i], rcond=None)[0]
        )
        if np.linalg.norm(rest) > 1e-8:
            kept.append(i)
    return columns[:, kept[1:]]


def _test(sample, t, subject, seen, of, n_components, options):
    """Change within subjects: of the whole shape, and at every vertex."""
    subject, d = subject[seen], sample.d[seen]
    x = within_subjects(t[seen], subject)
    Z = None
    if sample.Z is not None:
        Z = within_subjects(sample.Z[seen], subject)
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
    found = vertex_results(model.vertex_test(fields))
    variance, V = principal_components(gram(E, sample.area))
    if not len(variance):
        raise ValueError("growth needs shapes that differ within subjects; all visits are equal")
    c = count_components(variance, dof, n_components, most=len(variance))
    statistic, p_value = model.test(V[:, :c] * np.sqrt(len(E) - 1))
    return found | {
        "attrs": {"components": c} | model.attributes(),
        "effect_size": np.sqrt(squared_cohen_f(found["explained_share"])),
        # as many visits as are not taken by the means of subjects are free
        "statistic": statistic * (dof - 1) / (len(x) - 2 - rank),
        "p_value": p_value,
    }


def _estimates(sample, mixed, t, subject, seen):
    """Slopes, their errors, variances, and where on the trajectory each shape is."""
    k = sample.d.shape[2]
    x = within_subjects(t[seen], subject[seen])
    E = within_subjects(sample.d[seen].astype(float), subject[seen]).reshape(len(x), -1)
    columns = [x]
    if sample.Z is not None:
        columns += list(within_subjects(sample.Z[seen], subject[seen]).T)
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
