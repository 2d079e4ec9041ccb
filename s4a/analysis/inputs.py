"""Inputs of statistics (6.1): the registration of a study, and one value per shape."""

import itertools
import logging
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from s4a.analysis.permutation import INFLATED, indicators, inflation, standardize
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.columns import check_column
from s4a.input.subjects import (
    is_missing,
    is_plain_number,
    listed,
    non_numeric_cells,
    non_numeric_text,
)
from s4a.method.pca import pca_without
from s4a.options import Options, kept_options, with_options
from s4a.schema import Array, check_type, require, unit_of
from s4a.study.tree import left_out

log = logging.getLogger(__name__)

# One value per shape: in the order of the study; by name of the shape in a dict, a pandas object or
# a DataArray with the coordinate shape; or the name of a column of /subjects.
Values = Array | Sequence[Any] | dict[str, Any] | str

KINDS = {"M": "dates", "m": "durations", "O": "a mixture", "c": "complex numbers"}
DATE = re.compile(r"\d{4}-\d\d?-\d\d?.*|\d{4}/\d\d?/\d\d?|\d\d?[./-]\d\d?[./-](\d\d){1,2}")
IDENTIFIER = re.compile(r"(\b|_)(id|nr|code)'?$", re.IGNORECASE)  # end of a column's name


class Sample(NamedTuple):
    """The data of a test, for the shapes with all values.

    ``registration``, ``d (s, n, 3)`` and ``area (n,)`` of :func:`displacements_of`; the tested
    ``values (s,)``; the covariates ``Z (s, c)`` or None; ``attributes`` of a result: the covariates
    in words, and the excluded shapes; ``unit`` of d.
    """

    registration: xr.Dataset
    d: Array
    area: Array
    values: Array
    Z: Array | None
    attributes: dict[str, str]
    unit: str


def sample_of(
    study: xr.DataTree,
    values: Values,
    what: str,
    covariates: Values | dict[str, Values] | list[str] | None = None,
    needed: dict[str, Array] | None = None,
) -> Sample:
    """Return the data of the shapes with all values; others are excluded, with a warning.

    Shapes also need the values ``(s,)`` of `needed`, a dict by name, which are not used otherwise.

    Raises
    ------
    ValueError
        If values cannot be used in a test.
    """
    registration, d, area = displacements_of(study)
    tested = f"{what} {values!r}" if isinstance(values, str) else what
    columns = {tested: values_of(study, values, what)}
    columns |= covariates_of(study, covariates)
    names = registration["shape"].values
    missing = {column: lacks_value(data) for column, data in (columns | (needed or {})).items()}
    for column, lacking in missing.items():
        if lacking.any():
            log.warning(
                "%s has no value for %d of %d shapes, which are excluded from the test: %s",
                column,
                lacking.sum(),
                len(names),
                listed(names[lacking].tolist()),
            )
    complete = ~np.any(list(missing.values()), axis=0)
    if complete.sum() < 4:
        raise ValueError(
            "a test needs at least 4 shapes with all values; found "
            f"{complete.sum()} of {len(complete)}"
        )
    attributes = {"left_out": ", ".join([*left_out(study), *names[~complete]])}
    if not complete.all():
        registration, d = registration.isel(shape=complete), d[complete]
    columns = {name: data[complete] for name, data in columns.items()}
    for name, data in columns.items():
        categories = name == tested and what == "group"
        check_column(data, names[complete].tolist(), name, categories=categories)
    tested_values = columns.pop(tested)
    Z, attributes["covariates"] = columns_of(columns)
    unit = unit_of(registration["displacement"])
    return Sample(registration, d, area, tested_values, Z, attributes, unit)


def all_registered(study: xr.DataTree) -> xr.Dataset:
    """Return ``/registration`` of a study, with flagged shapes."""
    check_type(study, xr.DataTree)
    if "registration" not in study:
        raise ValueError(
            f"a registered study is needed; this one has {', '.join(study.children) or 'no nodes'}"
        )
    return study["registration"].to_dataset()


def registration_of(study: xr.DataTree) -> xr.Dataset:
    """Return ``/registration`` of a study without flagged shapes, see :func:`with_flagged`.

    Raises
    ------
    ValueError
        If the study has no registration.
    """
    registration = all_registered(study)
    flagged = left_out(study)
    if not flagged:
        return registration
    names = registration["shape"].values.tolist()
    return registration.sel(shape=[name for name in names if name not in flagged])


def with_flagged(study: xr.DataTree) -> xr.DataTree:
    """Return a study that includes its flagged shapes in modes and statistics.

    The result is that of ``include_flagged=True`` of :func:`s4a.analyse`, without another run.

    Parameters
    ----------
    study : DataTree
        A study with ``/registration`` and ``/report``.

    Returns
    -------
    DataTree
        The study, with the modes of all registered shapes in ``/pca``.

    Raises
    ------
    ValueError
        If the study is not registered, or PCA of its shapes is impossible.

    See Also
    --------
    outliers : Detect outliers in the finished study.

    Examples
    --------
    In a study of six small brains without flagged shapes:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.statistics.with_flagged(study)["pca"].sizes["shape"]
    6
    """
    check_type(study, xr.DataTree)
    nodes = {node.path: node.to_dataset(inherit=False) for node in study.subtree}
    if "report" in study.children:
        attrs = nodes["/report"].attrs
        is_stop = kept_options(study).get("quality_control") == "stop"
        given = {"include_flagged": True} | ({"quality_control": "exclude"} if is_stop else {})
        nodes["/report"] = nodes["/report"].assign_attrs(with_options(attrs, given))
    registration = all_registered(study)
    template = registration.attrs.get("template", "")
    coarse = nodes.get(f"/coarse/{template}")
    area_weighted = Options.from_report(study).area_weighted
    nodes["/pca"] = pca_without(registration, [], coarse, area_weighted=area_weighted)
    return xr.DataTree.from_dict(nodes, name=study.name)


def displacements_of(study: xr.DataTree) -> tuple[xr.Dataset, Array, Array]:
    """Return registration, displacements ``(s, n, 3)``, and vertex areas of sum 1 ``(n,)``.

    Flagged shapes are excluded, with a warning.

    Raises
    ------
    ValueError
        If there are fewer than 4 shapes, or displacements are not finite or all equal.
    """
    registration = registration_of(study)
    require(registration, "displacement", "position", "corner_vertex", what="registration")
    flagged = left_out(study)
    if flagged:
        log.warning("flagged shapes are excluded: %s", ", ".join(flagged))
    if registration.sizes["shape"] < 4:
        more = f", and {len(flagged)} flagged: {', '.join(flagged)}" if flagged else ""
        raise ValueError(
            f"statistics need at least 4 shapes; found {registration.sizes['shape']}{more}"
        )
    area = vertex_areas(*as_arrays(registration))
    d = registration["displacement"].transpose("shape", "vertex", "xyz").values
    is_finite = np.isfinite(d).all(axis=(1, 2))
    if not is_finite.all():
        raise ValueError(
            "statistics need finite displacements; exclude or register again: "
            f"{listed(registration['shape'].values[~is_finite].tolist())}"
        )
    if abs(d - d[0]).max() < 1e-9 * abs(registration["position"].values).max():
        raise ValueError("statistics need shapes that differ; all displacements are equal")
    return registration, d, area / area.sum()


def values_of(study: xr.DataTree, values: Values, what: str) -> Array:
    """Return one value or row per shape in the order of the study; errors call them `what`.

    Returns
    -------
    ndarray (s,) or (s, c)
        Numbers, or text; missing values are NaN or empty.
    """
    names = registration_of(study)["shape"].values.tolist()
    if isinstance(values, str):
        what = f"{what} {values!r}"
        values = _column(study, values, what)
    values = np.asarray(_in_order(values, names, what))
    registered = all_registered(study)["shape"].values.tolist()
    if values.ndim and len(values) == len(registered):  # excluded shapes may have values
        values = values[[registered.index(name) for name in names]]
    if values.ndim not in (1, 2) or len(values) != len(names):
        raise ValueError(
            f"{what} needs one value for each of {len(names)} shapes; found shape {values.shape}"
        )
    return _plain(values, names, what)


def _in_order(values, names, what):
    """Values in the order of the shapes, if keys or an index are names of shapes.

    A numeric pandas index is ignored, unless all shapes have numbers as names.
    """
    rows = values
    if isinstance(values, dict):
        labels, rows = list(values), list(values.values())
    elif isinstance(values, xr.DataArray) and "shape" in values.indexes:
        rows = values.transpose("shape", ...).values
        labels = values["shape"].values.tolist()
    elif hasattr(values, "iloc"):
        labels, rows = values.index.tolist(), np.asarray(values)
        if not {*names} <= {*map(str, labels)} and not any(isinstance(x, str) for x in labels):
            return values
    else:
        return values
    labels = list(map(str, labels))
    missing = [name for name in names if name not in labels]
    if missing:
        raise ValueError(f"{what} needs a value for every shape; it lacks {listed(missing)}")
    repeated = [name for name in names if labels.count(name) > 1]
    if repeated:
        raise ValueError(
            f"{what} needs one value for every shape; it has several for {listed(repeated)}"
        )
    return [rows[labels.index(name)] for name in names]


def _plain(values, names, what):
    """Convert values to numbers, finite or NaN, or text."""
    if values.dtype.kind == "O":
        marks = [x is None or str(x) == "NaT" or is_missing(str(x)) for x in values.ravel()]
        missing = np.reshape(np.array(marks, bool), values.shape)
        kinds = {np.asarray(value).dtype.kind for value in values[~missing].tolist()}
        if kinds <= set("iufb"):
            values = np.where(missing, np.nan, values).astype(float)
        elif kinds <= set("US"):
            values = np.where(missing, "", values).astype(str)
    if values.dtype.kind not in "iufbUS":
        raise ValueError(
            f"{what} needs only numbers or only text; found "
            f"{KINDS.get(values.dtype.kind, values.dtype)}: give a date as a number, such as years "
            "since the first"
        )
    if values.dtype.kind in "US":
        cells = [cell.strip() for cell in values.astype(str).ravel().tolist()]
        values = np.array(["" if is_missing(cell) else cell for cell in cells])
        odd = non_numeric_cells(cells) if len(cells) == len(names) else []
        if odd:
            raise ValueError(f"{what} {non_numeric_text(odd, names, cells)}")
        if len(cells) != len(names):
            raise ValueError(f"{what} with several columns needs numbers; found text")
    elif np.isinf(values).any():
        infinite = np.isinf(values).reshape(len(names), -1).any(axis=1)
        raise ValueError(
            f"{what} needs finite numbers; found infinite ones for "
            f"{listed(np.array(names)[infinite].tolist())}"
        )
    return values


def _column(study, name, what):
    """Return a column of ``/subjects`` by shape; the value of a shape without a row is missing."""
    table = study["subjects"].to_dataset() if "subjects" in study.children else xr.Dataset()
    if name not in table:
        raise ValueError(
            f"{what} needs a column of that name in /subjects, which has "
            f"{', '.join(map(str, table.data_vars)) or 'none'}; "
            "give a table, or the values themselves"
        )
    rows = dict(zip(table["shape"].values.tolist(), table[name].values.tolist(), strict=True))
    return {shape: rows.get(shape) for shape in all_registered(study)["shape"].values.tolist()}


def lacks_value(values: Array) -> Array:
    """Return a mask of the shapes ``(s,)`` with a missing value."""
    missing = values == "" if values.dtype.kind == "U" else np.isnan(values.astype(float))
    return missing.reshape(len(values), -1).any(axis=1)


def group_sizes(group: Array) -> str:
    """Return the sizes of groups in words, with a warning for groups under 10 shapes.

    Raises ValueError if there is only one group, or one has fewer than 3 shapes.
    """
    names, count = np.unique(group, return_counts=True)
    sizes = [f"{name}: {n}" for name, n in zip(names, count, strict=True)]
    if len(names) < 2 or count.min() < 3:
        raise ValueError(
            "a test needs two groups or more, each of at least 3 shapes; found "
            f"{listed(sizes, most=10)}"
        )
    if count.min() < 10:
        log.warning(
            "groups under 10 shapes (%s): only large differences can be detected, "
            "and effect sizes are uncertain",
            ", ".join(sizes),
        )
    return ", ".join(sizes)


def covariates_of(
    study: xr.DataTree, covariates: Values | dict[str, Values] | list[str] | None
) -> dict[str, Array]:
    """Return the covariates by name, with values ``(shape,)`` or ``(shape, c)``."""
    if covariates is None:
        return {}
    shapes = set(registration_of(study)["shape"].values.tolist())
    if isinstance(covariates, str):
        covariates = [covariates]
    is_names = isinstance(covariates, list) and all(isinstance(name, str) for name in covariates)
    if is_names:
        table = study["subjects"] if "subjects" in study.children else ()
        words = [[word] if word in table else word.split(",") for word in covariates]
        covariates = {name: name for name in map(str.strip, itertools.chain(*words)) if name}
    elif not isinstance(covariates, dict) or shapes <= set(covariates):
        covariates = {"": covariates}
    columns = {}
    for name, values in covariates.items():
        what = f"covariate {name!r}" if name else "covariate"
        columns[what] = values_of(study, values, "covariate" if is_names else what)
    return columns


def columns_of(covariates: dict[str, Array]) -> tuple[Array | None, str]:
    """Return covariates as columns of numbers ``(s, c)``, text as indicators, and in words.

    Warns about columns that are constant, nearly a combination of others, or number the shapes.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.inputs import columns_of
    >>> site = np.array(["Bern", "Basel", "Chur", "Chur", "Bern", "Basel"])
    >>> age = np.array([31, 40, 22, 35, 31, 58])
    >>> Z, words = columns_of({"covariate 'age'": age, "covariate 'site'": site})
    >>> Z.shape, words
    ((6, 3), "covariate 'age', covariate 'site' as indicators of Bern, Chur against Basel")
    """
    if not covariates:
        return None, ""
    columns, names, words = [], [], []
    for name, values in covariates.items():
        if values.dtype.kind == "U" and not all(map(is_plain_number, values)):
            groups, numbers = _indicators_of(values, name)
            names += [f"{name} = {group}" for group in groups[1:]]
            against = f" against {groups[0]}" if len(groups) > 1 else ""
            words.append(f"{name} as indicators of {listed(groups[1:])}{against}")
        else:
            numbers = values.astype(float).reshape(len(values), -1)
            several = numbers.shape[1] > 1
            names += [f"{name} {i + 1}" if several else name for i in range(numbers.shape[1])]
            words.append(f"{name}, {numbers.shape[1]} columns" if several else name)
        columns.append(numbers)
    Z = np.column_stack(columns)
    terms = np.repeat(np.arange(len(columns)), [column.shape[1] for column in columns])
    for line in redundant(Z, names, terms):
        log.warning("%s", line)
    for name, values in zip(names, Z.T, strict=True):
        if numbers_shapes(name, values):
            log.warning(
                "%s has a different integer for each shape, %.0f to %.0f: omit it if it only "
                "numbers the shapes",
                name,
                values.min(),
                values.max(),
            )
    return Z, ", ".join(words)


def numbers_shapes(name: str, values: Array) -> bool:
    """Return whether a column seems to number the shapes.

    Its integers are distinct, and consecutive or called identifiers.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.inputs import numbers_shapes
    >>> numbers_shapes("order", np.array([3, 1, 2, 4])), numbers_shapes("age", np.array([31, 40]))
    (True, False)
    """
    if (values % 1).any() or len(np.unique(values)) < len(values):
        return False
    return bool(np.ptp(values) == len(values) - 1 or IDENTIFIER.search(name))


def _indicators_of(values, name):
    groups, numbers = indicators(values)
    if len(values) and all(DATE.fullmatch(value) for value in groups):
        raise ValueError(
            f"{name} has dates, such as {groups[0]}; give them as a number, such as years since "
            "the first"
        )
    if 2 * len(groups) > len(values):
        raise ValueError(
            f"{name} is text with {len(groups)} different values for {len(values)} shapes, such as "
            f"{listed(groups.tolist(), most=3)}: it names shapes, not groups, and cannot be a "
            "covariate"
        )
    return groups.tolist(), numbers


def redundant(Z: Array, names: list[str], terms: ArrayLike | None = None) -> list[str]:
    """List the columns ``(s, c)`` that are constant or combinations of earlier ones, in words.

    Columns of one term ``(c,)``, such as indicators of the same groups, may be correlated.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.inputs import redundant
    >>> Z = np.array([[1.0, 2, 5], [2, 5, 5], [4, 9, 5], [3, 7, 5]])
    >>> for line in redundant(np.column_stack([Z, Z[:, 0] - Z[:, 1]]), ["a", "b", "c", "d"]):
    ...     print(line)
    b is nearly a linear combination of a (variance inflation factor 59): omit one of them
    c is constant and changes nothing
    d is a linear combination of a, b and changes nothing
    """
    columns, rounding = standardize(Z)
    terms = np.arange(len(names)) if terms is None else np.asarray(terms)
    independent: list[int] = []
    lines = []
    for i, name in enumerate(names):
        if not columns[:, i].any():
            lines.append(f"{name} is constant and changes nothing")
            continue
        before = columns[:, independent]
        weight = np.linalg.lstsq(before, columns[:, i], rcond=None)[0]
        if np.linalg.norm(columns[:, i] - before @ weight) <= max(1e-8, rounding):
            others = [names[k] for k, w in zip(independent, weight, strict=True) if abs(w) > 1e-6]
            lines.append(f"{name} is a linear combination of {listed(others)} and changes nothing")
            continue
        other_terms = [k for k in independent if terms[k] != terms[i]]
        basis = np.linalg.qr(columns[:, other_terms])[0]
        factor = inflation(columns[:, [i]], basis, len(other_terms))
        if factor > INFLATED:
            others = [names[k] for k in other_terms]
            lines.append(
                f"{name} is nearly a linear combination of {listed(others)} "
                f"(variance inflation factor {factor:.2g}): omit one of them"
            )
        independent.append(i)
    return lines
