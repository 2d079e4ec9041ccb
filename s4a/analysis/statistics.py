"""Statistics of a finished study (6.1): shape model, groups and variables, outliers, classes.

All functions take a study and return a Dataset.  Functions of plain arrays are in
:mod:`s4a.analysis.permutation` and :mod:`s4a.analysis.model`.  Asymmetry, growth, fields, regions
and generalization with new correspondences are in the extension ``s4a_morphometrics``.
"""

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy import stats

from s4a.analysis.inputs import (
    Sample,
    Values,
    displacements_of,
    group_sizes,
    registration_of,
    sample_of,
    with_flagged,
)
from s4a.analysis.model import KEPT, count_components, evaluate, leave_one_out, sample
from s4a.analysis.permutation import (
    Model,
    check_options,
    check_permutations,
    indicators,
    scatter_test,
    standardize,
)
from s4a.geometry.mesh import as_arrays, vertex_normals
from s4a.method.deform import normal_displacement
from s4a.method.pca import gram, principal_components
from s4a.schema import Array, check_choice, check_count, check_type, dataset, in_unit, unit_of
from s4a.seeds import RNG, seed_of

if TYPE_CHECKING:
    from sklearn.base import ClassifierMixin

log = logging.getLogger(__name__)

# level of the test of homogeneous covariance: 2 % false alarms, power 75 to 90 % for groups of
# 10 and 10, or 15 and 5, shapes with 1 and 2 standard deviations
UNEQUAL = 0.02

__all__ = [
    "classify",
    "evaluate",
    "group_map",
    "group_test",
    "outliers",
    "predict",
    "regression",
    "regression_modes",
    "sample",
    "with_flagged",
]


# groups and variables


def group_test(
    study: xr.DataTree,
    group: Values,
    *,
    covariates: Values | None = None,
    n_components: int | None = None,
    n_permutations: int = 9999,
    variances: str = "equal",
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Test whether the mean shapes of groups differ: permutation Hotelling T^2 test of the scores.

    With ``variances="equal"``, the null hypothesis is that the distribution of shape, given the
    covariates, is the same in all groups.  With ``"unequal"``, it is that the means are equal and
    the errors are symmetric about zero.  The covariance is shrunk (Ledoit and Wolf 2004).  For more
    than two groups the statistic is the Lawley-Hotelling trace.

    Parameters
    ----------
    study : DataTree
        A finished study, from :func:`s4a.analyse` or :func:`s4a.open_study`.
    group : array_like (shape,), dict of shape to value, or str
        Group of each shape, as numbers or text; or the name of a column of ``/subjects``.  Shapes
        without a value are excluded, with a warning.
    covariates : array_like (shape,) or (shape, covariate), dict, str or list of str, optional
        Confounders to adjust for (Freedman and Lane 1983): values in any form of `group`, a dict of
        name to such values, or names of columns of ``/subjects``.  Text is dummy-coded.  None by
        default.
    n_components : int, optional
        Number of principal components whose scores are tested.  By default the first components
        that explain 90 % of the variance, at most half of the number of shapes.
    n_permutations : int
        Number of permutations.  If there are fewer distinct permutations, each is used once.  With
        covariates the test is approximate.
    variances : {"equal", "unequal"}
        "equal" permutes shapes and assumes homogeneous covariance.  "unequal" flips signs of the
        residuals; it allows groups of different covariance and assumes symmetric errors.
    seed : int
        Seed of the random numbers.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.

    Returns
    -------
    Dataset
        The variables are

        - ``statistic``: test statistic;
        - ``p_value``: permutation p value.

        The attributes are

        - ``groups``: names and sizes of the groups;
        - ``components`` and ``permutations``: their numbers;
        - ``smallest_p``: smallest attainable p value;
        - ``covariates``: description of the covariates;
        - ``left_out``: names of the excluded shapes.

    Raises
    ------
    ValueError
        If a group has fewer than 3 shapes, or a covariate cannot be used.  Dates, names of shapes
        and numbers mixed with text cannot be used.

    See Also
    --------
    group_map : Test where on the surface groups differ.
    regression : Test the effect of a continuous variable.

    References
    ----------
    D. Freedman and D. Lane (1983), A nonstochastic interpretation of reported significance levels,
    Journal of Business and Economic Statistics 1(4).
    O. Ledoit and M. Wolf (2004), A well-conditioned estimator for large-dimensional covariance
    matrices, Journal of Multivariate Analysis 88(2).

    Examples
    --------
    In a study of six small brains, with random groups:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> test = s4a.statistics.group_test(study, ["a", "a", "a", "b", "b", "b"], n_permutations=99)
    >>> test.attrs["groups"], bool(test["p_value"] > 0.05)
    ('a: 3, b: 3', True)
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    return compare_groups(sample_of(study, group, "group", covariates), options, n_components)


def compare_groups(
    sample: Sample, options: dict[str, Any], n_components: int | None = None
) -> xr.Dataset:
    """Test groups of a sample, see :func:`group_test`, with `options` of a :class:`Model`."""
    sizes = group_sizes(sample.values)
    model = Model(indicators(sample.values)[1], sample.Z, **options)
    test = _test_scores(sample, model, n_components)
    return test.assign_attrs(groups=sizes, **sample.attributes, **model.attributes())


def group_map(
    study: xr.DataTree,
    group: Values,
    *,
    covariates: Values | None = None,
    of: str = "vector",
    n_permutations: int = 999,
    variances: str = "equal",
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Test where the mean shapes of groups differ, at every vertex of the template.

    Parameters
    ----------
    study, group, covariates, n_permutations, variances, seed, rng
        As in :func:`group_test`: a finished study, the group of each shape, confounders, and
        options of the permutation test.
    of : {"vector", "normal"}
        Test the displacements, or their components along the vertex normals.

    Returns
    -------
    Dataset
        The variables are

        - ``explained_share(vertex)``: share of the variance that the groups explain;
        - ``p_vertex(vertex)``: p value of each vertex, not corrected;
        - ``p_family_wise(vertex)``: corrected for the family-wise error (max-T);
        - ``p_false_discovery(vertex)``: corrected for the false discovery rate (Benjamini and
          Hochberg);
        - ``effect(vertex, xyz)``: mean of the second group minus mean of the first, in sorted
          order, in the unit of the input;
        - ``effect_size(vertex)``: Mahalanobis distance between the means of two groups, or Cohen's
          f of more groups.

        For two groups the attribute ``difference`` names the direction of the effect, such as
        "patient minus control".

    Raises
    ------
    ValueError
        If a group has fewer than 3 shapes.

    See Also
    --------
    group_test : Test the whole shape once.

    References
    ----------
    P. H. Westfall and S. S. Young (1993), Resampling-based multiple testing, Wiley.
    Y. Benjamini and Y. Hochberg (1995), Controlling the false discovery rate, Journal of the Royal
    Statistical Society B 57(1).

    Examples
    --------
    In a study of six small brains, with random groups:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> result = s4a.statistics.group_map(study, ["a", "a", "a", "b", "b", "b"], n_permutations=99)
    >>> result["effect"].dims, bool((result["p_family_wise"] > 0.05).all())
    (('vertex', 'xyz'), True)

    The normal component of the effect:

    >>> mean = s4a.synthesize(study, [0.0])
    >>> X, T = s4a.geometry.mesh.as_arrays(mean)
    >>> normal = (result["effect"].values * s4a.geometry.mesh.vertex_normals(X, T)).sum(1)
    >>> s4a.show.charts.surfaces({"b minus a": mean}, {"b minus a": normal}, label="mm")
    <TiledFigure ...>
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    return map_groups(sample_of(study, group, "group", covariates), options, of)


def map_groups(sample: Sample, options: dict[str, Any], of: str = "vector") -> xr.Dataset:
    """Test groups of a sample at every vertex, see :func:`group_map`."""
    sizes = group_sizes(sample.values)
    names, x = indicators(sample.values)
    model = Model(x, sample.Z, **options)
    effect_map = _test_vertices(sample, model, of)
    squared = squared_cohen_f(effect_map["explained_share"].values)
    if len(names) == 2:  # squared Mahalanobis distance of the means: T^2 (1 / n_1 + 1 / n_2)
        dof = len(x) - sum(basis.shape[1] for basis in model.bases)
        squared = squared * dof * (1 / np.unique(sample.values, return_counts=True)[1]).sum()
    return effect_map.merge(dataset(effect_size=np.sqrt(squared))).assign_attrs(
        groups=sizes,
        difference=f"{names[1]} minus {names[0]}" if len(names) == 2 else "",
        of=of,
        **sample.attributes,
        **model.attributes(),
    )


def regression(
    study: xr.DataTree,
    variable: Values,
    *,
    covariates: Values | None = None,
    of: str = "vector",
    n_components: int | None = None,
    n_permutations: int = 999,
    variances: str = "equal",
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Regress shape on a continuous variable, such as age, and test the effect.

    Parameters
    ----------
    study : DataTree
        A finished study, from :func:`s4a.analyse` or :func:`s4a.open_study`.
    variable : array_like (shape,), dict of shape to value, or str
        Number of each shape, in any unit; or the name of a column of ``/subjects``.
    covariates, n_components, n_permutations, variances, seed, rng
        As in :func:`group_test`: confounders, the number of principal components of the test of the
        whole shape, and options of the permutation tests.
    of : {"vector", "normal"}
        Test the displacements at every vertex, or their components along the vertex normals.

    Returns
    -------
    Dataset
        The variables are

        - ``statistic`` and ``p_value``: test of the whole shape, see :func:`group_test`;
        - ``explained_share``, ``p_vertex``, ``p_family_wise`` and ``p_false_discovery``: test at
          every vertex, see :func:`group_map`;
        - ``effect(vertex, xyz)``: displacement per unit of the variable, in the unit of the input;
        - ``effect_size(vertex)``: Cohen's f;
        - ``intercept(vertex, xyz)``: displacement at the mean of the variable;
        - ``standard_score(shape)``: standardised variable.

        The attributes are those of :func:`group_test`, and

        - ``mean``, ``standard_deviation``, ``lowest`` and ``highest`` of the variable;
        - ``freed_deviation``: standard deviation of the variable, adjusted for the covariates.

    Raises
    ------
    ValueError
        If the variable is text, constant, infinite, or a combination of the covariates.

    See Also
    --------
    predict : Predict the shape at a value of the variable.
    regression_modes : Convert the regression to a mode of variation.

    Examples
    --------
    In a study of six small brains, with the first score as variable:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> score = study["pca"]["score"].values[:, 0]
    >>> fit = s4a.statistics.regression(study, score, n_permutations=99)
    >>> predicted = s4a.statistics.predict(study, fit, 2.0)["position"]
    >>> bool(abs(predicted - s4a.synthesize(study, [2.0])["position"]).max() < 1e-2)
    True
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    sample = sample_of(study, variable, "variable", covariates)
    return regress(sample, options, n_components, of)


def regress(
    sample: Sample, options: dict[str, Any], n_components: int | None = None, of: str = "vector"
) -> xr.Dataset:
    """Regress a sample, see :func:`regression`, with `options` of a :class:`Model`."""
    x = numbers_of(sample.values)
    model = Model(x, sample.Z, **options)
    test = _test_scores(sample, model, n_components)
    effect_map = _test_vertices(sample, model, of)
    mean = float(x.mean())
    deviation = float(x.std(ddof=1))
    sizes = dataset(
        effect_size=np.sqrt(squared_cohen_f(effect_map["explained_share"].values)),
        standard_score=(x - mean) / deviation,
    ).assign_coords(shape=sample.registration["shape"].values)
    return (
        effect_map.merge(test)
        .merge(sizes)
        .assign_attrs(
            mean=mean,
            lowest=float(x.min()),
            highest=float(x.max()),
            of=of,
            standard_deviation=deviation,
            freed_deviation=freed_deviation(x, sample.Z),
            components=test.attrs["components"],
            **sample.attributes,
            **model.attributes(),
        )
    )


def freed_deviation(x: Array, Z: Array | None) -> float:
    """Return the standard deviation of a variable ``(s,)`` adjusted for covariates ``(s, c)``."""
    if Z is None:
        return float(x.std(ddof=1))
    residual = x - x.mean()
    columns = standardize(Z)[0]
    residual = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
    return float(np.sqrt(residual @ residual / (len(x) - 1)))


def numbers_of(values: Array, what: str = "variable") -> Array:
    """Return the variable of a regression as floats ``(s,)`` after a check."""
    if values.dtype.kind == "U":
        raise ValueError(
            f"a regression needs a {what} of numbers; found text such as {str(values[0])!r}: use a "
            "group test for text"
        )
    if values.ndim > 1:
        raise ValueError(f"a regression needs one number for each shape; found {values.shape}")
    x = values.astype(float)
    if not 1e-30 < abs(x).max() < 1e30 and x.any():
        raise ValueError(
            f"a regression needs a {what} between 1e-30 and 1e30; found {x.max():.3g}: give it in "
            "another unit"
        )
    return x


def predict(study: xr.DataTree, fit: xr.Dataset, value: float) -> xr.Dataset:
    """Predict the shape at a value of the variable of a :func:`regression`.

    Parameters
    ----------
    study : DataTree
        The study of the regression.
    fit : Dataset
        Result of :func:`regression`.
    value : float
        Value of the variable, in the unit of the variable.

    Returns
    -------
    Dataset
        A mesh with ``position(vertex, xyz)`` in the unit of the input and ``corner_vertex(triangle,
        corner)``.

    See Also
    --------
    regression_modes : Convert the regression to a study, to animate these shapes.

    Examples
    --------
    In a study of six small brains, from age 0 to 5 a shape moves by five times the effect:

    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> fit = s4a.statistics.regression(study, range(6), n_permutations=99)
    >>> young, old = (s4a.statistics.predict(study, fit, age)["position"] for age in (0, 5))
    >>> bool(np.allclose(old - young, 5 * fit["effect"]))
    True
    >>> shapes = {f"age {age}": s4a.statistics.predict(study, fit, age) for age in (-5, 2.5, 10)}
    >>> s4a.show.charts.surfaces(shapes)
    <TiledFigure ...>
    """
    check_moves(fit)
    template = study["registration"].to_dataset()
    displacement = fit["intercept"].values + (value - fit.attrs["mean"]) * fit["effect"].values
    return dataset(
        position=template["position"].values + displacement,
        corner_vertex=template["corner_vertex"].values,
    )


def regression_modes(study: xr.DataTree, fit: xr.Dataset, name: str = "variable") -> xr.DataTree:
    """Convert a :func:`regression` to a study with one mode of variation, to show it.

    :func:`s4a.explore` shows the mode with a slider.  :func:`s4a.write_page` and
    :func:`s4a.write_film` write it to a file.  One standard deviation of the mode is one standard
    deviation of the variable.

    Parameters
    ----------
    study : DataTree
        The study of the regression.
    fit : Dataset
        Result of :func:`regression`.
    name : str
        Name of the variable.

    Returns
    -------
    DataTree
        ``/registration`` and ``/coarse`` of the study, and ``/pca`` with one component.  The
        variables of ``/pca`` are

        - ``deformation``: effect of one standard deviation, in the unit of the input;
        - ``score``: standardised variable of each shape;
        - ``explained_variance_ratio``: share of the variance of the displacements that the variable
          explains.

    See Also
    --------
    predict : Predict the shape at one value.

    Examples
    --------
    In a study of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> fit = s4a.statistics.regression(study, range(6), n_permutations=99)
    >>> s4a.statistics.regression_modes(study, fit, "age")["pca"].sizes["component"]
    1
    """
    check_moves(fit)
    registration, d, area = displacements_of(study)
    d = d[registration["shape"].isin(fit["shape"]).values]
    step = fit["effect"].values * fit.attrs["standard_deviation"]  # (n, 3)
    size = np.sqrt(np.einsum("nx,nx,n->", step, step, area))
    # the slope explains variation with the adjusted variable
    adjusted = fit.attrs.get("freed_deviation", fit.attrs["standard_deviation"])
    explained = size * adjusted / fit.attrs["standard_deviation"]
    total = gram(d - d.mean(0), area).trace() / (len(d) - 1)
    return modes_study(
        study,
        fit["shape"],
        name=name,
        mean=fit["intercept"].values,
        deformation=step[None],
        standard_deviation=np.array([size]),
        score=fit["standard_score"].values[:, None],
        explained_variance_ratio=np.array([explained**2 / total]),
    )


def modes_study(
    study: xr.DataTree,
    shapes: xr.DataArray,
    *,
    name: str,
    deformation: Array,
    mean: Array | None = None,
    **modes: Array,
) -> xr.DataTree:
    """Return a study of some shapes with given modes in ``/pca``, to show them.

    Parameters
    ----------
    study : DataTree
    shapes : DataArray (shape,)
    name : str
        Name of the modes.
    deformation : float ndarray (component, vertex, xyz)
    mean : float ndarray (vertex, xyz), optional
        Mean displacement; by default computed.
    **modes : float ndarray
        Other variables of ``/pca``.
    """
    registration = registration_of(study)
    registration = registration.isel(shape=registration["shape"].isin(shapes).values)
    mean = registration["displacement"].values.mean(0) if mean is None else mean
    pca = dataset(
        {"variable": name},
        mean_displacement=mean.astype(np.float32),
        deformation=deformation.astype(np.float32),
        **modes,
    )
    pca = in_unit(pca, unit_of(registration["displacement"]))
    nodes = {
        "/registration": registration,
        "/pca": pca.assign_coords(shape=registration["shape"].values),
    }
    for node in study.subtree:
        if node.path.split("/")[1] in ("coarse", "original"):
            nodes[node.path] = node.to_dataset(inherit=False)
    return xr.DataTree.from_dict(nodes, name=study.name)


# outliers and classes


def outliers(
    study: xr.DataTree, *, n_components: int | None = None, level: float = 0.01
) -> xr.Dataset:
    """Detect outliers by the leave-one-out error and the Mahalanobis distance of each shape.

    Parameters
    ----------
    study : DataTree
        A finished study, from :func:`s4a.analyse` or :func:`s4a.open_study`.
    n_components : int, optional
        Number of principal components of the Mahalanobis distance.  By default the first components
        that explain 90 % of the variance, at most a tenth of the number of shapes.  With more
        components, the variances of a sample overestimate those of the population.
    level : float
        Significance level of the Mahalanobis distance.

    Returns
    -------
    Dataset
        Each shape is compared with the model of all other shapes.  The variables are

        - ``mahalanobis(shape)``: Mahalanobis distance of the scores;
        - ``outlier_p(shape)``: its p value, by the F distribution of a new observation.  It is
          exact for a population with `n_components` components, and conservative for more;
        - ``left_out_error(shape)``: reconstruction error, in the unit of the input;
        - ``outlier(shape)``: True if the p value is below `level`, or if the error is more than 3.5
          robust standard deviations above the median.

    Raises
    ------
    ValueError
        If n_components is out of range.

    See Also
    --------
    evaluate : Measure the quality of the whole model.

    References
    ----------
    B. Iglewicz and D. C. Hoaglin (1993), How to detect and handle outliers, ASQC Quality Press.

    Examples
    --------
    In a study of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> result = s4a.statistics.outliers(study)
    >>> result["outlier"].values.any()
    np.False_
    >>> names, error = result["shape"].values.tolist(), result["left_out_error"].values
    >>> s4a.show.charts.ranked(names, error, "left-out error (mm)", int(error.argmax()))
    <Figure ...>
    """
    registration, d, area = displacements_of(study)
    s = len(d)
    K = gram(d - d.mean(0), area)
    variance, _ = principal_components(K)
    c = count_components(variance, s, n_components, most=s - 3, at_most=s // 10)
    error, score = leave_one_out(K)
    error = error[:, c]
    squared = np.nansum(score[:, :c] ** 2, axis=1)
    n = s - 1
    p = stats.f.sf(squared * n * (n - c) / (c * (n * n - 1)), c, n - c)
    deviation = stats.median_abs_deviation(error, scale="normal")
    limit = 3.5 * max(deviation, 1e-12 * error.max())
    has_large_error = (deviation > 0) & (error - np.median(error) > limit)
    result = dataset(
        {"components": c, "correspondence": KEPT, "level": level},
        mahalanobis=np.sqrt(squared),
        outlier_p=p,
        left_out_error=error,
        outlier=(p < level) | has_large_error,
    )
    result = in_unit(result, unit_of(registration["displacement"]))
    return result.assign_coords(shape=registration["shape"].values)


def classify(
    study: xr.DataTree,
    group: Values,
    estimator: "ClassifierMixin | None" = None,
    *,
    n_components: int | None = None,
    n_folds: int = 5,
    n_permutations: int = 99,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Classify shapes into groups, with cross-validation and a permutation test.

    PCA, scaling and estimator are fitted to the training shapes of each fold.  PCA uses the scores
    on all components.  Its result equals PCA of the displacements, as the scores are isometric.

    Parameters
    ----------
    study : DataTree
        A finished study, from :func:`s4a.analyse` or :func:`s4a.open_study`.
    group : array_like (shape,), dict of shape to value, or str
        Group of each shape, as numbers or text; or the name of a column of ``/subjects``.
    estimator : scikit-learn classifier, optional
        Logistic regression by default.  The estimator is cloned.
    n_components : int, optional
        Number of principal components, at most the number of training shapes minus 2.  The default
        is that of :func:`group_test`.
    n_folds : int
        Number of stratified folds, at most the size of the smallest group.
    n_permutations : int
        Number of permutations of the groups for the p value.
    seed : int
        Seed of the random numbers.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.

    Returns
    -------
    Dataset
        The variables are

        - ``predicted(shape)``: predicted group of each shape in the test fold;
        - ``accuracy(fold)``: balanced accuracy, from 0 to 1;
        - ``p_value``: permutation p value.

        The attributes are

        - ``balanced_accuracy``: balanced accuracy of all predictions;
        - ``chance``: expected accuracy of a random prediction;
        - ``smallest_p``: smallest attainable p value;
        - ``correspondence``: a note that the correspondences depend on all shapes.

    Raises
    ------
    ValueError
        If a group has fewer than 3 shapes, or an option is out of range.

    See Also
    --------
    group_test : Test whether the means of groups differ.

    Examples
    --------
    In a study of six small brains, with random groups:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> classes = s4a.statistics.classify(study, ["a", "a", "a", "b", "b", "b"], n_permutations=9)
    >>> classes["predicted"].sizes["shape"], classes.attrs["chance"]
    (6, 0.5)
    """
    sample, seed = sample_of(study, group, "group"), seed_of(seed, rng)
    return classify_sample(sample, estimator, n_components, n_folds, n_permutations, seed)


def classify_sample(
    sample: Sample,
    estimator: "ClassifierMixin | None",
    n_components: int | None,
    n_folds: int,
    n_permutations: int,
    seed: int,
) -> xr.Dataset:
    """Classify a sample, see :func:`classify`."""
    # imported here, as nothing else needs scikit-learn
    from sklearn.base import clone
    from sklearn.decomposition import PCA
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import balanced_accuracy_score
    from sklearn.model_selection import StratifiedKFold, cross_val_predict, permutation_test_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    check_permutations(n_permutations)
    check_count("n_folds", n_folds, 2)
    group, sizes = sample.values, group_sizes(sample.values)
    names, count = np.unique(group, return_counts=True)
    n_folds = min(n_folds, int(count.min()))
    folds = StratifiedKFold(n_folds, shuffle=True, random_state=seed)
    scores, coordinates = scores_of(sample, n_components)
    n_training = len(group) - int(np.ceil(len(group) / n_folds))
    c = min(scores.shape[1], n_training - 2)
    steps = make_pipeline(
        PCA(c, svd_solver="full"),
        StandardScaler(),
        LogisticRegression(max_iter=1000) if estimator is None else clone(estimator),
    )
    predicted = cross_val_predict(steps, coordinates, group, cv=folds)
    accuracy = [
        balanced_accuracy_score(group[left_out], predicted[left_out])
        for _, left_out in folds.split(coordinates, group)
    ]
    options = {"cv": folds, "scoring": "balanced_accuracy", "n_permutations": n_permutations}
    *_, p = permutation_test_score(steps, coordinates, group, random_state=seed, **options)
    attrs = {
        "permutations": n_permutations,
        "smallest_p": Model(indicators(group)[1], n_permutations=n_permutations).smallest_p,
        "groups": sizes,
        "left_out": sample.attributes["left_out"],
        "balanced_accuracy": float(balanced_accuracy_score(group, predicted)),
        "chance": 1 / len(names),
        "components": c,
        "correspondence": KEPT,
    }
    result = dataset(attrs, predicted=predicted, accuracy=np.array(accuracy), p_value=p)
    return result.assign_coords(shape=sample.registration["shape"].values)


# shared functions


def check_moves(fit: xr.Dataset) -> None:
    """Raise ValueError unless a result has an effect that moves vertices."""
    check_type(fit, xr.Dataset, "fit", "a Dataset, such as s4a.statistics.regression returns")
    if "effect" not in fit:
        raise ValueError(
            "a regression of displacements is needed; found "
            f"{', '.join(map(str, fit)) or 'nothing'}: show the field_effect of a field as colours"
        )


def scores_of(sample: Sample, n_components: int | None) -> tuple[Array, Array]:
    """Return standardised scores ``(s, c)``, and all scores in the unit of the input."""
    d = sample.d
    variance, V = principal_components(gram(d - d.mean(0), sample.area))
    if not len(variance):
        raise ValueError("a test needs shapes that differ; all displacements are equal")
    c = count_components(variance, len(d), n_components, most=len(variance))
    root = np.sqrt(len(d) - 1)
    return V[:, :c] * root, V * np.sqrt(variance) * root


def _test_scores(sample, model, n_components):
    """Test of the whole shape: Hotelling's T^2 of the scores on x, adjusted for Z."""
    scores, coordinates = scores_of(sample, n_components)
    statistic, p = model.test(scores)
    if model.variances == "equal":
        _report_unequal_variances(coordinates, model.x, sample)
    return dataset({"components": scores.shape[1]}, statistic=statistic, p_value=p)


def _report_unequal_variances(coordinates, x, sample):
    """Warn if the covariance differs between groups or with the variable."""
    distance, p = scatter_test(coordinates, x, covariates=sample.Z)
    if p >= UNEQUAL:
        return
    details = "with the variable"
    bias = "too small or too large"
    groups = np.unique(sample.values)
    if len(groups) == len(np.unique(x, axis=0)) and len(groups) < len(x) / 2:
        details = ", ".join(
            f"{group}: {np.sqrt((distance[sample.values == group] ** 2).mean()):.3g} {sample.unit}"
            for group in groups
        )
        bias = "too small if a small group varies more, too large if a large one does"
    log.warning(
        "the variance differs (%s; p = %.2g), but p values assume equal variances and are %s: "
        "use variances='unequal' (--variances unequal)",
        details,
        p,
        bias,
    )


def fields_to_test(d: Array, registration: xr.Dataset, of: str) -> Array:
    """Return the fields ``(s, n, k)`` of a test at every vertex: vectors or normal components."""
    check_choice("of", of, ("vector", "normal"))
    if of == "vector":
        return d
    return normal_displacement(d, vertex_normals(*as_arrays(registration)))[..., None]


def vertex_results(test: tuple[Array, Array, Array]) -> dict[str, Array]:
    """Return the variables of a test at every vertex by name."""
    share, p, p_max = test
    return {
        "explained_share": share,
        "p_vertex": p,
        "p_family_wise": p_max,
        "p_false_discovery": stats.false_discovery_control(p),
    }


def _test_vertices(sample, model, of):
    """Test at every vertex, with the effect of the first column of x on the displacement."""
    d, k = sample.d, sample.d.shape[2]
    test = model.vertex_test(fields_to_test(d, sample.registration, of))
    columns = np.column_stack([np.ones(len(d)), model.rows])
    columns[:, 1:] -= columns[:, 1:].mean(0)  # so that the intercept is at the mean of x
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1
    B = np.linalg.pinv(columns / size, rcond=1e-10) @ d.reshape(len(d), -1).astype(float)
    intercept, slope = (B / size[:, None])[:2].reshape(2, -1, k)
    result = dataset(None, **vertex_results(test), effect=slope, intercept=intercept)
    return in_unit(result, sample.unit)


def squared_cohen_f(share: Array) -> Array:
    """Return Cohen's f^2 at every vertex ``(n,)``: explained over unexplained variance."""
    return share / np.maximum(1 - share, 1e-12)
