"""What an analysis takes of a study (6.1): its registration, and one value per shape."""

import logging
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.permutation import indicators, standardize
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.subjects import is_missing, is_plain_number, listed, odd_cells, odd_words
from s4a.method.pca import pca_without
from s4a.options import Options, with_options
from s4a.schema import check_type, require, unit_of
from s4a.study.tree import left_out

log = logging.getLogger(__name__)

# One value per shape: in the order of the study; by name of the shape, in a dict, a pandas object
# with an index or a DataArray with the coordinate shape; or a column of /subjects.
Values = np.ndarray | Sequence[Any] | dict[str, Any] | str

DATE = re.compile(r"\d{4}-\d\d?-\d\d?.*|\d{4}/\d\d?/\d\d?|\d\d?[./-]\d\d?[./-](\d\d){1,2}")
IDENTIFIER = re.compile(r"(\b|_)(id|nr|code)'?$", re.IGNORECASE)  # how names of columns end


class Sample(NamedTuple):
    """The shapes of a test, those with all values, and what the test needs to know of them.

    ``registration``, ``d (s, n, 3)`` and ``area (n,)`` as of :func:`displacements_of`;
    ``values (s,)`` are tested, ``Z (s, c)`` is accounted for, or None; ``said`` are attributes of a
    result: the covariates in words, and which shapes are left out; ``unit`` is that of d.
    """

    registration: xr.Dataset
    d: np.ndarray
    area: np.ndarray
    values: np.ndarray
    Z: np.ndarray | None
    said: dict[str, str]
    unit: str


def sample_of(
    study: xr.DataTree,
    values: Values,
    what: str,
    covariates: Values | dict[str, Values] | list[str] | None = None,
    needed: dict[str, np.ndarray] | None = None,
) -> Sample:
    """The shapes that have all values; those that lack one are left out, with a warning.

    A shape must also have the values ``(s,)`` of `needed`, by what they are, which are not used.

    Raises
    ------
    ValueError
        When values are of no use for a test; it says which, why, and what to do.
    """
    registration, d, area = displacements_of(study)
    tested = f"{what} {values!r}" if isinstance(values, str) else what
    columns = {tested: values_of(study, values, what)}
    columns |= covariates_of(study, covariates)
    names = registration["shape"].values
    unknown = {column: is_unknown(of) for column, of in (columns | (needed or {})).items()}
    for column, of in unknown.items():
        if of.any():
            log.warning(
                "%s has no value for %d of %d shapes, which are left out of the test: %s",
                column,
                of.sum(),
                len(of),
                listed(names[of].tolist()),
            )
    known = ~np.any(list(unknown.values()), axis=0)
    if known.sum() < 4:
        raise ValueError(
            f"a test needs at least 4 shapes with all values, found {known.sum()} of {len(known)}"
        )
    said = {"left_out": ", ".join([*left_out(study), *names[~known]])}
    if not known.all():
        registration, d = registration.isel(shape=known), d[known]
    of_tested = columns.pop(tested)[known]
    Z, said["covariates"] = columns_of({name: of[known] for name, of in columns.items()})
    unit = unit_of(registration["displacement"])
    return Sample(registration, d, area, of_tested, Z, said, unit)


def all_registered(study: xr.DataTree) -> xr.Dataset:
    """``/registration`` of a study, flagged shapes too; ValueError where it has none."""
    check_type(study, xr.DataTree)
    if "registration" not in study:
        raise ValueError(
            f"a registered study is needed; this one has {', '.join(study.children) or 'no nodes'}"
        )
    return study["registration"].to_dataset()


def registration_of(study: xr.DataTree) -> xr.Dataset:
    """``/registration`` of the shapes that enter modes and statistics.

    Those are all but the flagged ones, see :func:`with_flagged`.

    Raises
    ------
    ValueError
        When the study has none.
    """
    registration = all_registered(study)
    flagged = left_out(study)
    if not flagged:
        return registration
    names = registration["shape"].values.tolist()
    return registration.sel(shape=[name for name in names if name not in flagged])


def with_flagged(study: xr.DataTree) -> xr.DataTree:
    """A study whose flagged shapes enter modes and statistics; the study given stays as it is.

    What ``include_flagged=True`` of :func:`s4a.analyse` makes, without another run.

    Parameters
    ----------
    study : DataTree
        With ``/registration`` and ``/report``.

    Returns
    -------
    DataTree
        With the modes of all registered shapes in ``/pca``.

    Raises
    ------
    ValueError
        When the study is not registered, or its shapes have no modes.

    Examples
    --------
    With the ``study`` of six small brains, none of which is flagged:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.statistics.with_flagged(study)["pca"].sizes["shape"]
    6
    """
    check_type(study, xr.DataTree)
    nodes = {node.path: node.to_dataset(inherit=False) for node in study.subtree}
    if "report" in study.children:
        nodes["/report"] = nodes["/report"].assign_attrs(
            with_options(
                nodes["/report"].attrs, {"include_flagged": True, "quality_control": "exclude"}
            )
        )
    registration = all_registered(study)
    template = registration.attrs.get("template", "")
    coarse = nodes.get(f"/coarse/{template}")
    area_weighted = Options.from_report(study).area_weighted
    nodes["/pca"] = pca_without(registration, [], coarse, area_weighted=area_weighted)
    return xr.DataTree.from_dict(nodes, name=study.name)


def displacements_of(study: xr.DataTree) -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
    """:func:`registration_of`, its displacements ``(s, n, 3)``, and vertex areas of sum 1 ``(n,)``.

    The log names the shapes that are left out as flagged.

    Raises
    ------
    ValueError
        When there are fewer than 4 shapes, all are equal, or a displacement is not finite.
    """
    registration = registration_of(study)
    require(registration, "displacement", "position", "corner_vertex", what="registration")
    flagged = left_out(study)
    if flagged:
        log.warning("flagged and left out: %s; see with_flagged", ", ".join(flagged))
    if registration.sizes["shape"] < 4:
        more = f", and {len(flagged)} flagged: {', '.join(flagged)}" if flagged else ""
        raise ValueError(
            f"statistics need at least 4 shapes, found {registration.sizes['shape']}{more}"
        )
    area = vertex_areas(*as_arrays(registration))
    d = registration["displacement"].transpose("shape", "vertex", "xyz").values
    is_finite = np.isfinite(d).all(axis=(1, 2))
    if not is_finite.all():
        raise ValueError(
            "statistics need finite displacements; leave out of the study, or register again: "
            f"{listed(registration['shape'].values[~is_finite].tolist())}"
        )
    if abs(d - d[0]).max() < 1e-9 * abs(registration["position"].values).max():
        raise ValueError("statistics need shapes that differ; all displacements are equal")
    return registration, d, area / area.sum()


def values_of(study: xr.DataTree, values: Values, what: str) -> np.ndarray:
    """One value per shape, or one row, in the order of the study; `what` they are, for errors.

    Returns
    -------
    ndarray (s,) or (s, c)
        Numbers, NaN where one is missing; or text, empty where one is missing.
    """
    names = registration_of(study)["shape"].values.tolist()
    if isinstance(values, str):
        what = f"{what} {values!r}"
        values = _column(study, values, what)
    values = np.asarray(_in_order(values, names, what))
    everyone = all_registered(study)["shape"].values.tolist()
    if values.ndim and len(values) == len(everyone):  # those that are left out may have one too
        values = values[[everyone.index(name) for name in names]]
    if values.ndim not in (1, 2) or len(values) != len(names):
        raise ValueError(
            f"{what} needs one value for each of {len(names)} shapes, found shape {values.shape}"
        )
    return _plain(values, names, what)


def _in_order(values, names, what):
    """Values in the order of the shapes, where keys or an index have their names.

    A pandas index of numbers is none of names, unless all shapes are called by numbers.
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
    words = list(map(str, labels))
    missing = [name for name in names if name not in words]
    if missing:
        raise ValueError(f"{what} needs a value for every shape; it lacks {listed(missing)}")
    twice = [name for name in names if words.count(name) > 1]
    if twice:
        raise ValueError(f"{what} needs one value for every shape; it has more of {listed(twice)}")
    return [rows[words.index(name)] for name in names]


def _plain(values, names, what):
    """Numbers that are finite or NaN, or text, of whatever the user gave."""
    if values.dtype.kind == "O":
        gaps = np.array([_is_gap(value) for value in values.ravel()]).reshape(values.shape)
        kinds = {np.asarray(value).dtype.kind for value in values[~gaps].tolist()}
        if kinds <= set("iufb"):
            values = np.where(gaps, np.nan, values).astype(float)
        elif kinds <= set("US"):
            values = np.where(gaps, "", values).astype(str)
    if values.dtype.kind not in "iufbUS":
        raise ValueError(
            f"{what} needs numbers alone or text alone, found {_kind(values)}; a date can be given "
            "as a number, such as years since the first"
        )
    if values.dtype.kind in "US":
        cells = [cell.strip() for cell in values.astype(str).ravel().tolist()]
        values = np.array(["" if is_missing(cell) else cell for cell in cells])
        odd = odd_cells(cells) if len(cells) == len(names) else []
        if odd:
            raise ValueError(f"{what} {odd_words(odd, names, cells)}")
        if len(cells) != len(names):
            raise ValueError(f"{what} needs numbers where it has several columns; found text")
    elif np.isinf(values).any():
        infinite = np.isinf(values).reshape(len(names), -1).any(axis=1)
        raise ValueError(
            f"{what} needs finite numbers; found infinite ones for "
            f"{listed(np.array(names)[infinite].tolist())}"
        )
    return values


def _is_gap(value):
    """Whether one of several objects stands for no value: None, NaN, pandas' NA, or text."""
    return value is None or str(value) in ("nan", "<NA>", "NaT") or is_missing(str(value))


def _kind(values):
    return {"M": "dates", "m": "durations", "O": "a mixture", "c": "complex numbers"}.get(
        values.dtype.kind, str(values.dtype)
    )


def _column(study, name, what):
    """Return a column of ``/subjects`` by shape; the value of a shape without a row is missing."""
    table = study["subjects"].to_dataset() if "subjects" in study.children else xr.Dataset()
    if name not in table:
        raise ValueError(
            f"{what} needs a column of that name in /subjects, which has "
            f"{', '.join(map(str, table.data_vars)) or 'none'}; "
            "give a table, or the values themselves"
        )
    everyone = all_registered(study)["shape"].values.tolist()
    known = dict(zip(table["shape"].values.tolist(), table[name].values.tolist(), strict=True))
    return {shape: known.get(shape) for shape in everyone}


def is_unknown(values: np.ndarray) -> np.ndarray:
    """Which shapes ``(s,)`` lack a value."""
    unknown = values == "" if values.dtype.kind == "U" else np.isnan(values.astype(float))
    return unknown.reshape(len(values), -1).any(axis=1)


def group_sizes(group: np.ndarray) -> str:
    """The sizes of groups in words.

    ValueError where there is one group only or one has fewer than 3 shapes, a warning under 10.
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
            "groups under 10 shapes (%s): only large differences can be found, "
            "effect sizes are uncertain",
            ", ".join(sizes),
        )
    return ", ".join(sizes)


def covariates_of(
    study: xr.DataTree, covariates: Values | dict[str, Values] | list[str] | None
) -> dict[str, np.ndarray]:
    """What is accounted for: name -> values ``(shape,)`` or ``(shape, c)``."""
    if covariates is None:
        return {}
    shapes = set(registration_of(study)["shape"].values.tolist())
    if isinstance(covariates, str):
        covariates = [covariates]
    is_names = isinstance(covariates, list) and all(isinstance(name, str) for name in covariates)
    if is_names:
        covariates = {name: name for name in covariates}
    elif not isinstance(covariates, dict) or shapes <= set(covariates):
        covariates = {"": covariates}
    found = {}
    for name, values in covariates.items():
        what = f"covariate {name!r}" if name else "covariate"
        found[what] = values_of(study, values, "covariate" if is_names else what)
    return found


def columns_of(covariates: dict[str, np.ndarray]) -> tuple[np.ndarray | None, str]:
    """Columns of numbers ``(s, c)`` of covariates, text as indicators, and the same in words.

    A column that is constant, or a combination of others, changes no test and is named in a
    warning; so is one that numbers the shapes.

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
    for line in redundant(Z, names):
        log.warning("%s", line)
    for name, values in zip(names, Z.T, strict=True):
        if numbers_shapes(name, values):
            log.warning(
                "%s has another whole number for each shape, %.0f to %.0f: leave it out if it "
                "numbers the shapes, as it then measures nothing of them",
                name,
                values.min(),
                values.max(),
            )
    return Z, ", ".join(words)


def numbers_shapes(name: str, values: np.ndarray) -> bool:
    """Whether a column seems to number the shapes, and to measure nothing of them.

    Its whole numbers all differ, and have no gaps or the name of identifiers.

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
            f"{name} holds dates, such as {groups[0]}; give them as a number, such as years since "
            "the first"
        )
    if 2 * len(groups) > len(values):
        raise ValueError(
            f"{name} is text with {len(groups)} different values for {len(values)} shapes, such as "
            f"{listed(groups.tolist(), most=3)}: it names shapes, not groups of them, and cannot "
            "be accounted for"
        )
    return groups.tolist(), numbers


def redundant(Z: np.ndarray, names: list[str]) -> list[str]:
    """Which columns ``(s, c)`` are constant or combinations of those before them, in words.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.inputs import redundant
    >>> Z = np.array([[1.0, 2, 5], [2, 5, 5], [4, 9, 5], [3, 7, 5]])
    >>> for line in redundant(np.column_stack([Z, Z[:, 0] - Z[:, 1]]), ["a", "b", "c", "d"]):
    ...     print(line)
    c is constant and changes nothing
    d is a linear combination of a, b and changes nothing
    """
    columns, rounding = standardize(Z)
    kept: list[int] = []
    lines = []
    for i, name in enumerate(names):
        before = columns[:, kept]
        weight = np.linalg.lstsq(before, columns[:, i], rcond=None)[0]
        if not columns[:, i].any():
            lines.append(f"{name} is constant and changes nothing")
        elif np.linalg.norm(columns[:, i] - before @ weight) <= max(1e-8, rounding):
            others = [names[k] for k, w in zip(kept, weight, strict=True) if abs(w) > 1e-6]
            lines.append(f"{name} is a linear combination of {listed(others)} and changes nothing")
        else:
            kept.append(i)
    return lines
