"""Tests of groups and variables (6.1) on a scalar field of the shapes, instead of displacements."""

from typing import TYPE_CHECKING

import xarray as xr

from s4a.analysis.inputs import Values
from s4a.analysis.permutation import check_options
from s4a.analysis.statistics import classify_sample, compare_groups, map_groups, regress
from s4a.seeds import RNG, seed_of
from s4a_morphometrics.fields import field_sample

if TYPE_CHECKING:
    from sklearn.base import ClassifierMixin


def field_group_test(
    study: xr.DataTree,
    field: str,
    group: Values,
    *,
    covariates: Values | None = None,
    n_components: int | None = None,
    n_permutations: int = 9999,
    variances: str = "equal",
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Test groups for a difference in the mean of a field.

    Parameters
    ----------
    study : DataTree
    field : str
        Name in ``/fields``, see :func:`s4a_morphometrics.with_field`.
    group, covariates, n_components, n_permutations, variances, seed, rng
        See :func:`s4a.statistics.group_test`.

    Returns
    -------
    Dataset
        As returned by :func:`s4a.statistics.group_test`.

    Raises
    ------
    ValueError
        If the study has no such field, the field does not vary, or a group has fewer than 3 shapes.

    See Also
    --------
    s4a.statistics.group_test : the test of displacements.
    field_group_map : the test at every vertex.

    Examples
    --------
    With the ``study`` of six small brains, split at random:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height)
    >>> group = ["a", "a", "a", "b", "b", "b"]
    >>> test = s4a_morphometrics.field_group_test(study, "height", group, n_permutations=99)
    >>> test.attrs["groups"]
    'a: 3, b: 3'
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    on_field = field_sample(study, field, group, "group", covariates)
    return compare_groups(on_field.sample, options, n_components)


def field_group_map(
    study: xr.DataTree,
    field: str,
    group: Values,
    *,
    covariates: Values | None = None,
    n_permutations: int = 999,
    variances: str = "equal",
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Test groups for a difference in the mean of a field at every vertex.

    Parameters
    ----------
    study, field, group, covariates, n_permutations, variances, seed, rng
        See :func:`field_group_test`.

    Returns
    -------
    Dataset
        As returned by :func:`s4a.statistics.group_map`, with ``field_effect(vertex)`` and
        ``field_intercept`` in place of ``effect`` and ``intercept``; NaN at vertices where a shape
        lacks the field.

    Raises
    ------
    ValueError
        See :func:`field_group_test`.

    See Also
    --------
    s4a.statistics.group_map : the test of displacements.

    Examples
    --------
    With the ``study`` of six small brains, split at random:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height)
    >>> group = ["a", "a", "a", "b", "b", "b"]
    >>> result = s4a_morphometrics.field_group_map(study, "height", group, n_permutations=99)
    >>> result["field_effect"].dims
    ('vertex',)
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    on_field = field_sample(study, field, group, "group", covariates)
    return on_field.on_template(map_groups(on_field.sample, options))


def field_regression(
    study: xr.DataTree,
    field: str,
    variable: Values,
    *,
    covariates: Values | None = None,
    n_components: int | None = None,
    n_permutations: int = 999,
    variances: str = "equal",
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Regress a field on a continuous variable, such as age.

    Parameters
    ----------
    study : DataTree
    field : str
        Name in ``/fields``, see :func:`s4a_morphometrics.with_field`.
    variable, covariates, n_components, n_permutations, variances, seed, rng
        See :func:`s4a.statistics.regression`.

    Returns
    -------
    Dataset
        As returned by :func:`s4a.statistics.regression`, with ``field_effect(vertex)`` and
        ``field_intercept`` in place of ``effect`` and ``intercept``.

    Raises
    ------
    ValueError
        If the study has no such field, the field does not vary, or the variable is text, constant
        or a combination of the covariates.

    See Also
    --------
    s4a.statistics.regression : the regression of displacements.
    s4a_morphometrics.growth : several visits of each subject.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height)
    >>> fit = s4a_morphometrics.field_regression(study, "height", range(6), n_permutations=99)
    >>> fit["field_effect"].dims
    ('vertex',)
    """
    options = check_options(n_permutations, variances, seed_of(seed, rng))
    on_field = field_sample(study, field, variable, "variable", covariates)
    return on_field.on_template(regress(on_field.sample, options, n_components))


def field_classify(
    study: xr.DataTree,
    field: str,
    group: Values,
    estimator: "ClassifierMixin | None" = None,
    *,
    n_components: int | None = None,
    n_folds: int = 5,
    n_permutations: int = 99,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Classify shapes by a field.

    Parameters
    ----------
    study : DataTree
    field : str
        Name in ``/fields``, see :func:`s4a_morphometrics.with_field`.
    group, estimator, n_components, n_folds, n_permutations, seed, rng
        See :func:`s4a.statistics.classify`.

    Returns
    -------
    Dataset
        As returned by :func:`s4a.statistics.classify`.

    Raises
    ------
    ValueError
        If the study has no such field, the field does not vary, or a group has fewer than 3 shapes.

    See Also
    --------
    s4a.statistics.classify : classification by displacements.

    Examples
    --------
    With the ``study`` of six small brains, split at random:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height)
    >>> group = ["a", "a", "a", "b", "b", "b"]
    >>> result = s4a_morphometrics.field_classify(study, "height", group, n_permutations=9)
    >>> result.attrs["chance"]
    0.5
    """
    on_field = field_sample(study, field, group, "group")
    return classify_sample(
        on_field.sample, estimator, n_components, n_folds, n_permutations, seed_of(seed, rng)
    )
