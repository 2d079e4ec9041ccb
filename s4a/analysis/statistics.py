"""Statistics of a finished study (6.1): shape model, groups and variables, outliers, classes.

All functions take a study and return a Dataset.  Functions of plain arrays are in
:mod:`s4a.analysis.permutation` and :mod:`s4a.analysis.model`; groups and variables are in
:mod:`s4a.analysis.effects`.  Asymmetry, growth, fields, regions and generalization with new
correspondences are in the extension ``s4a_morphometrics``.
"""

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy import stats

from s4a.analysis.effects import (
    group_map,
    group_test,
    predict,
    regression,
    regression_modes,
    scores_of,
)
from s4a.analysis.inputs import (
    Sample,
    Values,
    displacements_of,
    group_sizes,
    sample_of,
    with_flagged,
)
from s4a.analysis.model import KEPT, count_components, evaluate, leave_one_out, sample
from s4a.analysis.permutation import Model, check_permutations, indicators
from s4a.method.pca import gram, principal_components
from s4a.schema import check_count, dataset, in_unit, unit_of
from s4a.seeds import RNG, seed_of

if TYPE_CHECKING:
    from sklearn.base import ClassifierMixin

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
