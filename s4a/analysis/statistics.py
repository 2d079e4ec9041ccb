"""Statistics of a finished study (6.1).

Evaluation of its model, groups and variables, outliers, classification.

All take a study and give a Dataset; what works on plain arrays is in
:mod:`s4a.analysis.permutation` and :mod:`s4a.analysis.model`.
"""

import logging

import numpy as np
import xarray as xr
from scipy import stats
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import balanced_accuracy_score
from sklearn.model_selection import StratifiedKFold, permutation_test_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from s4a.analysis import model
from s4a.analysis import permutation as test
from s4a.analysis.generalization import generalization
from s4a.analysis.model import evaluate, registered, sample
from s4a.geometry.mesh import as_arrays, vertex_normals
from s4a.schema import dataset, in_unit, unit_of

log = logging.getLogger(__name__)

__all__ = [
    "classify",
    "evaluate",
    "generalization",
    "group_map",
    "group_test",
    "outliers",
    "predict",
    "regression",
    "regression_modes",
    "sample",
]


def values_of(study, given, what):
    """One value per shape: of an array in the order of the study, a dict of name to value.

    Or a column of /subjects.
    """
    names = study["registration"]["shape"].values.tolist()
    if isinstance(given, str):
        what = f"{what} {given!r}"
        held = study["subjects"].to_dataset() if "subjects" in study.children else xr.Dataset()
        if given not in held:
            raise ValueError(
                f"{what} needs a column of that name in /subjects, which has {', '.join(held.data_vars) or 'none'}; "
                "give a table, or the values themselves"
            )
        lacking = [n for n in names if n not in held["shape"].values]
        if lacking:
            raise ValueError(
                f"{what} needs a row in /subjects for every shape; it lacks {', '.join(lacking)}"
            )
        given = held[given].sel(shape=names).values
    if isinstance(given, dict):
        missing = [n for n in names if n not in given]
        if missing:
            raise ValueError(f"{what} needs a value for every shape; it lacks {', '.join(missing)}")
        given = [given[n] for n in names]
    given = np.asarray(given)
    if given.ndim == 0 or len(given) != len(names):
        raise ValueError(
            f"{what} needs one value for each of {len(names)} shapes, found shape {given.shape}"
        )
    unknown = (
        ~np.isfinite(given)
        if given.dtype.kind == "f"
        else given == ""
        if given.dtype.kind in "OU"
        else False
    )
    unknown = np.broadcast_to(unknown, given.shape).reshape(len(names), -1).any(1)
    if unknown.any():
        lacking = ", ".join(n for n, u in zip(names, unknown, strict=True) if u)
        raise ValueError(
            f"{what} needs a finite value for every shape; leave out of the study, or fill in: {lacking}"
        )
    return given


def groups_of(study, group):
    """The groups of the shapes.

    ValueError where one has fewer than 3 shapes, a warning under 10.
    """
    group = values_of(study, group, "group")
    names, count = np.unique(group, return_counts=True)
    sizes = ", ".join(f"{n}: {c}" for n, c in zip(names, count, strict=True))
    if len(names) < 2 or count.min() < 3:
        raise ValueError(
            f"a test needs two groups or more, each of at least 3 shapes; found {sizes}"
        )
    if count.min() < 10:
        log.warning(
            "groups under 10 shapes (%s): only large differences can be found, effect sizes are uncertain",
            sizes,
        )
    return group, sizes


def _covariates(study, covariates):
    if covariates is None:
        return None
    if isinstance(covariates, list) and all(isinstance(n, str) for n in covariates):
        columns = [values_of(study, name, "covariate") for name in covariates]
    elif isinstance(covariates, dict) and not set(covariates) >= set(
        study["registration"]["shape"].values.tolist()
    ):
        columns = [values_of(study, v, f"covariate {n}") for n, v in covariates.items()]
    else:
        columns = [values_of(study, covariates, "covariate")]
    columns = [
        test.indicators(c)[1] if c.dtype.kind in "OU" else np.asarray(c, float) for c in columns
    ]
    return np.column_stack([c.reshape(len(c), -1) for c in columns])


def enough_components(ratio, s, share=0.9):
    """How many components hold `share` of the variance, at most half of the shapes.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> s4a.statistics.enough_components(np.array([0.6, 0.3, 0.1]), 20)
    2
    """
    return int(max(1, min(np.searchsorted(np.cumsum(ratio), share - 1e-9) + 1, s // 2, len(ratio))))


def _scores(study, n_components):
    """Scores on the first components in standard deviations ``(s, c)``.

    And all in the unit of the input.
    """
    d, area, _, _ = registered(study)
    variance, V = model.principal(model.centred(model.gram(d - d.mean(0), area)))
    if not len(variance):
        raise ValueError("a test needs shapes that differ; all displacements are equal")
    c = (
        enough_components(variance / variance.sum(), len(d))
        if n_components is None
        else int(n_components)
    )
    if not 1 <= c <= len(variance):
        raise ValueError(f"n_components needs a number from 1 to {len(variance)}, found {c}")
    root = np.sqrt(len(d) - 1)
    return V[:, :c] * root, V * np.sqrt(variance) * root


def group_test(study, group, *, covariates=None, n_components=None, n_permutations=9999, seed=0):
    """Do groups of shapes differ?  Permutation Hotelling T^2 on the scores.

    Covariance shrunk after Ledoit and Wolf.

    Parameters
    ----------
    study : DataTree
    group : array_like (shape,), dict of shape to value, or name in /subjects
    covariates : as `group`, or a dict of name to these, a list of names in /subjects, an array (shape, covariate)
        Accounted for after Freedman and Lane (1983); text as indicators of its values.
    n_components : int, optional
        As many as hold 90 % of the variance by default, at most half of the number of shapes.
    n_permutations : int
    seed : int

    Returns
    -------
    Dataset
        ``statistic``, ``p_value``; attributes ``groups`` (sizes), ``components`` and ``smallest_p``
        that the permutations can reach.

    Raises
    ------
    ValueError
        When a group has fewer than 3 shapes.

    Examples
    --------
    With the ``study`` of six small brains, split at random:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> found = s4a.statistics.group_test(study, ["a", "a", "a", "b", "b", "b"], n_permutations=99)
    >>> found.attrs["groups"], bool(found["p_value"] > 0.05)
    ('a: 3, b: 3', True)
    """
    group, sizes = groups_of(study, group)
    scores, _ = _scores(study, n_components)
    _, x = test.indicators(group)
    Z = _covariates(study, covariates)
    statistic, p = test.permutation_test(
        scores, x, covariates=Z, n_permutations=n_permutations, seed=seed
    )
    least = test.smallest_p(n_permutations, group)
    attrs = {
        "groups": sizes,
        "components": scores.shape[1],
        "smallest_p": least,
        "permutations": n_permutations,
    }
    return dataset(attrs, statistic=statistic, p_value=p)


def _map(study, x, Z, of, n_permutations, seed):
    """Test at every vertex and the effect of the first column of x."""
    d, _, _, data = registered(study)
    if of not in ("vector", "normal"):
        raise ValueError(f"of must be 'vector' or 'normal', found {of!r}")
    fields = (
        d
        if of == "vector"
        else np.einsum("snx,nx->sn", d, vertex_normals(*as_arrays(data)))[..., None]
    )
    share, p, p_max = test.vertex_test(
        fields, x, covariates=Z, n_permutations=n_permutations, seed=seed
    )
    columns = np.column_stack([np.ones(len(d)), x] if Z is None else [np.ones(len(d)), x, Z])
    columns[:, 1:] -= columns[:, 1:].mean(0)
    B = np.linalg.pinv(columns) @ d.reshape(len(d), -1).astype(float)
    found = dataset(
        explained_share=share,
        p_vertex=p,
        p_family_wise=p_max,
        p_false_discovery=test.false_discovery_rate(p),
        effect=B[1].reshape(-1, 3),
        intercept=B[0].reshape(-1, 3),
    )
    return in_unit(found, unit_of(data["displacement"]))


def group_map(study, group, *, covariates=None, of="vector", n_permutations=999, seed=0):
    """Where do groups of shapes differ?  A permutation test at every vertex of the template.

    Parameters
    ----------
    study, group, covariates, seed : see :func:`group_test`
    of : {"vector", "normal"}
        The displacements, or their part along the normals.
    n_permutations : int

    Returns
    -------
    Dataset
        ``explained_share(vertex)``, ``p_vertex``, ``p_family_wise`` (max-T), ``p_false_discovery``
        (Benjamini and Hochberg), ``effect(vertex, xyz)`` = mean of the second group minus that of
        the first, in sorted order, and ``effect_size``: Mahalanobis distance of two groups' means,
        Cohen's f of several.

    Raises
    ------
    ValueError
        When a group has fewer than 3 shapes.

    Examples
    --------
    With the ``study`` of six small brains, split at random:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> found = s4a.statistics.group_map(study, ["a", "a", "a", "b", "b", "b"], n_permutations=99)
    >>> found["effect"].dims, bool((found["p_family_wise"] > 0.05).all())
    (('vertex', 'xyz'), True)
    """
    group, sizes = groups_of(study, group)
    names, x = test.indicators(group)
    Z = _covariates(study, covariates)
    found = _map(study, x, Z, of, n_permutations, seed)
    n, k = len(group), 0 if Z is None else Z.shape[1]
    ratio = found["explained_share"].values / np.maximum(1 - found["explained_share"].values, 1e-12)
    if len(names) == 2:
        ratio = ratio * (n - 2 - k) * (1 / np.unique(group, return_counts=True)[1]).sum()
    least = test.smallest_p(n_permutations, group)
    attrs = {"groups": sizes, "smallest_p": least, "permutations": n_permutations, "of": of}
    return found.merge(dataset(effect_size=np.sqrt(ratio))).assign_attrs(attrs)


def regression(
    study, variable, *, covariates=None, of="vector", n_components=None, n_permutations=999, seed=0
):
    """How does shape change with a continuous variable, such as age?

    Parameters
    ----------
    study : DataTree
    variable : array_like (shape,), dict of shape to value, or name in /subjects
    covariates, n_components, n_permutations, seed : see :func:`group_test`
    of : see :func:`group_map`

    Returns
    -------
    Dataset
        The global test, ``statistic`` and ``p_value``, as of :func:`group_test`; the test at every
        vertex as of :func:`group_map`, ``effect(vertex, xyz)`` per unit of the variable,
        ``effect_size`` = Cohen's f, and ``intercept(vertex, xyz)``; ``standard_score(shape)`` of
        the variable.  Attributes ``mean``, ``standard_deviation``, ``lowest`` and ``highest`` of
        the variable, ``smallest_p``.

    Raises
    ------
    ValueError
        When the variable is constant, not finite, or a combination of the covariates.

    Examples
    --------
    With the ``study`` of six small brains; the score of the first mode itself is what it follows:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> score = study["pca"]["score"].values[:, 0]
    >>> fit = s4a.statistics.regression(study, score, n_permutations=99)
    >>> predicted = s4a.statistics.predict(study, fit, 2.0)["position"]
    >>> bool(abs(predicted - s4a.synthesize(study, [2.0])["position"]).max() < 1e-2)
    True
    """
    x = values_of(study, variable, "variable")
    if x.dtype.kind not in "iufb":
        raise ValueError(
            f"a regression needs a variable of numbers, found {x.dtype}; a group test takes text"
        )
    x = x.astype(float)
    scores, _ = _scores(study, n_components)
    Z = _covariates(study, covariates)
    statistic, p = test.permutation_test(
        scores, x, covariates=Z, n_permutations=n_permutations, seed=seed
    )
    found = _map(study, x, Z, of, n_permutations, seed)
    share = found["explained_share"].values
    attrs = {"mean": float(x.mean()), "lowest": float(x.min()), "highest": float(x.max()), "of": of}
    attrs["standard_deviation"] = float(x.std(ddof=1))
    attrs |= {
        "components": scores.shape[1],
        "smallest_p": test.smallest_p(n_permutations, n=len(x)),
    }
    extra = dataset(
        statistic=statistic,
        p_value=p,
        effect_size=np.sqrt(share / np.maximum(1 - share, 1e-12)),
        standard_score=(x - attrs["mean"]) / attrs["standard_deviation"],
    ).assign_coords(shape=study["registration"]["shape"].values)
    return found.merge(extra).assign_attrs(attrs | {"permutations": n_permutations})


def predict(study, fit, value):
    """The shape at a value of the variable of a :func:`regression`.

    :func:`regression_modes` animates it.

    Parameters
    ----------
    study : DataTree
        That of the regression.
    fit : Dataset
        As :func:`regression` gives it.
    value : float
        Of the variable, in its unit.

    Returns
    -------
    Dataset
        ``position(vertex, xyz)`` and ``corner_vertex``.

    Examples
    --------
    With the ``study`` of six small brains; between the ages of 0 and 5 a shape moves by five times the effect:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> fit = s4a.statistics.regression(study, range(6), n_permutations=99)
    >>> young, old = (s4a.statistics.predict(study, fit, age)["position"] for age in (0, 5))
    >>> bool(np.allclose(old - young, 5 * fit["effect"]))
    True
    """
    template = study["registration"].to_dataset()
    moved = fit["intercept"].values + (value - fit.attrs["mean"]) * fit["effect"].values
    return dataset(
        position=template["position"].values + moved, corner_vertex=template["corner_vertex"].values
    )


def regression_modes(study, fit, name="variable"):
    """A :func:`regression` in the form of a study with one mode, for everything that shows modes.

    ``s4a.explore`` and the panel of the modes play it with a slider, :func:`s4a.write_page` and
    :func:`s4a.show.pictures.write_animation` make it a file; one standard deviation of the mode is
    one of the variable.

    Parameters
    ----------
    study : DataTree
    fit : Dataset
        Of :func:`regression`.
    name : str
        Of the variable.

    Returns
    -------
    DataTree
        ``/registration`` and ``/coarse`` of the study, and ``/pca`` with one component:
        ``deformation`` by the effect of one standard deviation, ``score`` the variable of each
        shape, ``explained_variance_ratio`` the share of the variance of the displacements that it
        explains.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> fit = s4a.statistics.regression(study, range(6), n_permutations=99)
    >>> s4a.statistics.regression_modes(study, fit, "age")["pca"].sizes["component"]
    1
    """
    d, area, names, data = registered(study)
    deviation = fit.attrs["standard_deviation"]
    step = fit["effect"].values * deviation
    size = np.sqrt(np.einsum("nx,nx,n->", step, step, area))
    total = model.gram(d - d.mean(0), area).trace() / (len(d) - 1)
    modes = dataset(
        {"variable": name},
        mean_displacement=fit["intercept"].values.astype(np.float32),
        deformation=step[None].astype(np.float32),
        standard_deviation=np.array([size]),
        score=fit["standard_score"].values[:, None],
        explained_variance_ratio=np.array([size**2 / total]),
    )
    modes = in_unit(modes, unit_of(data["displacement"])).assign_coords(shape=names)
    nodes = {
        n.path: n.to_dataset(inherit=False)
        for n in study.subtree
        if n.path.split("/")[1] in ("coarse", "original")
    }
    return xr.DataTree.from_dict(nodes | {"/registration": data, "/pca": modes}, name=study.name)


def outliers(study, *, n_components=None, level=0.01):
    """Shapes that the model of all others describes badly, or finds far from its mean.

    Parameters
    ----------
    study : DataTree
    n_components : int, optional
        As in :func:`group_test`.
    level : float
        Share of shapes of a normal population whose Mahalanobis distance is called too large.

    Returns
    -------
    Dataset
        Each shape left out of the model: ``mahalanobis(shape)`` of its scores and ``outlier_p`` (F
        distribution of a new observation), ``left_out_error(shape)`` in the unit of the input, and
        ``outlier(shape)``: p under `level`, or the error more than 3.5 robust standard deviations
        over the median (Iglewicz and Hoaglin 1993).

    Raises
    ------
    ValueError
        When n_components is not a number that the shapes allow.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.statistics.outliers(study)["outlier"].values.any()
    np.False_
    """
    d, area, names, data = registered(study)
    s = len(d)
    K = model.gram(d - d.mean(0), area)
    variance, _ = model.principal(model.centred(K))
    c = (
        enough_components(variance / variance.sum(), s)
        if n_components is None
        else int(n_components)
    )
    if not 1 <= c <= s - 3:
        raise ValueError(f"n_components needs a number from 1 to {s - 3}, found {c}")
    error, score = model.leave_one_out(K)
    squared = np.nansum(score[:, :c] ** 2, axis=1)
    n = s - 1
    p = stats.f.sf(squared * n * (n - c) / (c * (n * n - 1)), c, n - c)
    left = error[:, c]
    spread = 1.4826 * np.median(np.abs(left - np.median(left)))
    far = left - np.median(left) > 3.5 * max(spread, 1e-12 * max(left.max(), 1e-300))
    attrs = {"components": c, "correspondence": model.KEPT, "level": level}
    found = dataset(
        attrs,
        mahalanobis=np.sqrt(squared),
        outlier_p=p,
        left_out_error=left,
        outlier=(p < level) | (far & (spread > 0)),
    )
    return in_unit(found, unit_of(data["displacement"])).assign_coords(shape=names)


def classify(
    study, group, estimator=None, *, n_components=None, n_folds=5, n_permutations=99, seed=0
):
    """Can the groups be told from the shapes?  Cross-validated.

    With the modes made inside every fold.

    The coordinates of all shapes on all components are an isometric image of the displacements, so
    that PCA of the training shapes' coordinates is PCA of their displacements; nothing of a
    left-out shape enters the modes, their scaling or the estimator.

    Parameters
    ----------
    study : DataTree
    group : see :func:`group_test`
    estimator : scikit-learn classifier, optional
        Logistic regression by default; it is cloned.
    n_components : int, optional
        As in :func:`group_test`, at most what the training shapes carry.
    n_folds : int
        Stratified; at most the size of the smallest group.
    n_permutations : int
        Of the groups, for the p value.
    seed : int

    Returns
    -------
    Dataset
        ``predicted(shape)``, ``accuracy(fold)`` (balanced), ``p_value``; attributes
        ``balanced_accuracy`` of all predictions, ``chance``, ``smallest_p``, ``correspondence``.

    Examples
    --------
    With the ``study`` of six small brains, split at random:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> found = s4a.statistics.classify(study, ["a", "a", "a", "b", "b", "b"], n_permutations=9)
    >>> found["predicted"].sizes["shape"], found.attrs["chance"]
    (6, 0.5)
    """
    group, sizes = groups_of(study, group)
    names, count = np.unique(group, return_counts=True)
    n_folds = min(n_folds, int(count.min()))
    chosen, coordinates = _scores(study, n_components)
    c = min(chosen.shape[1], len(group) - int(np.ceil(len(group) / n_folds)) - 2)
    steps = make_pipeline(
        PCA(c, svd_solver="full"),
        StandardScaler(),
        LogisticRegression(max_iter=1000) if estimator is None else clone(estimator),
    )
    folds = StratifiedKFold(n_folds, shuffle=True, random_state=seed)
    predicted, accuracy = group.copy(), []
    for train, left_out in folds.split(coordinates, group):
        predicted[left_out] = (
            clone(steps).fit(coordinates[train], group[train]).predict(coordinates[left_out])
        )
        accuracy.append(balanced_accuracy_score(group[left_out], predicted[left_out]))
    attrs = {"permutations": n_permutations, "smallest_p": test.smallest_p(n_permutations, group)}
    p = 1.0
    if n_permutations:
        options = {"cv": folds, "scoring": "balanced_accuracy", "n_permutations": n_permutations}
        *_, p = permutation_test_score(steps, coordinates, group, random_state=seed, **options)
    attrs |= {
        "groups": sizes,
        "balanced_accuracy": float(balanced_accuracy_score(group, predicted)),
        "chance": 1 / len(names),
        "components": c,
        "correspondence": model.KEPT,
    }
    return dataset(
        attrs, predicted=predicted, accuracy=np.array(accuracy), p_value=p
    ).assign_coords(shape=study["registration"]["shape"].values)
