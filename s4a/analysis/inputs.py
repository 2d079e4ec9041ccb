"""What an analysis takes of a study (6.1): its registration, and one value per shape."""

import logging
from collections.abc import Sequence

import numpy as np
import xarray as xr

from s4a.analysis.permutation import indicators
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.schema import require

log = logging.getLogger(__name__)

# One value per shape: in the order of the study, by name of the shape, or a column of /subjects.
Values = np.ndarray | Sequence | dict | str


def registration_of(study: xr.DataTree) -> xr.Dataset:
    """``/registration`` of a study; ValueError where it has none."""
    if "registration" not in study:
        raise ValueError(
            f"a registered study is needed; this one has {', '.join(study.children) or 'no nodes'}"
        )
    return study["registration"].to_dataset()


def displacements_of(study: xr.DataTree) -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
    """``/registration``, its displacements ``(s, n, 3)``, and vertex areas of sum 1 ``(n,)``."""
    registration = registration_of(study)
    require(registration, "displacement", "position", "corner_vertex", what="registration")
    if registration.sizes["shape"] < 4:
        raise ValueError(f"statistics need at least 4 shapes, found {registration.sizes['shape']}")
    area = vertex_areas(*as_arrays(registration))
    d = registration["displacement"].transpose("shape", "vertex", "xyz").values
    return registration, d, area / area.sum()


def values_of(study: xr.DataTree, values: Values, what: str) -> np.ndarray:
    """One value per shape, or one row, in the order of the study; `what` they are, for errors."""
    names = registration_of(study)["shape"].values.tolist()
    if isinstance(values, str):
        what = f"{what} {values!r}"
        values = _column(study, values, names, what)
    if isinstance(values, dict):
        missing = [name for name in names if name not in values]
        if missing:
            raise ValueError(f"{what} needs a value for every shape; it lacks {', '.join(missing)}")
        values = [values[name] for name in names]
    values = np.asarray(values)
    if values.ndim == 0 or len(values) != len(names):
        raise ValueError(
            f"{what} needs one value for each of {len(names)} shapes, found shape {values.shape}"
        )
    unknown = _is_unknown(values).reshape(len(names), -1).any(axis=1)
    if unknown.any():
        raise ValueError(
            f"{what} needs a finite value for every shape; leave out of the study, or fill in: "
            f"{', '.join(np.array(names)[unknown])}"
        )
    return values


def _column(study, name, shapes, what):
    """A column of ``/subjects``, in the order of the shapes."""
    table = study["subjects"].to_dataset() if "subjects" in study.children else xr.Dataset()
    if name not in table:
        raise ValueError(
            f"{what} needs a column of that name in /subjects, which has "
            f"{', '.join(table.data_vars) or 'none'}; give a table, or the values themselves"
        )
    missing = [shape for shape in shapes if shape not in table["shape"].values]
    if missing:
        raise ValueError(
            f"{what} needs a row in /subjects for every shape; it lacks {', '.join(missing)}"
        )
    return table[name].sel(shape=shapes).values


def _is_unknown(values):
    """Where a number is not finite, or a text is empty."""
    if values.dtype.kind == "f":
        return ~np.isfinite(values)
    return np.broadcast_to(values == "" if values.dtype.kind in "OU" else False, values.shape)


def groups_of(study: xr.DataTree, group: Values) -> tuple[np.ndarray, str]:
    """The groups of the shapes, and their sizes in words.

    ValueError where one has fewer than 3 shapes, a warning under 10.
    """
    group = values_of(study, group, "group")
    names, count = np.unique(group, return_counts=True)
    sizes = ", ".join(f"{name}: {n}" for name, n in zip(names, count, strict=True))
    if len(names) < 2 or count.min() < 3:
        raise ValueError(
            f"a test needs two groups or more, each of at least 3 shapes; found {sizes}"
        )
    if count.min() < 10:
        log.warning(
            "groups under 10 shapes (%s): only large differences can be found, "
            "effect sizes are uncertain",
            sizes,
        )
    return group, sizes


def covariates_of(
    study: xr.DataTree, covariates: Values | dict[str, Values] | list[str] | None
) -> np.ndarray | None:
    """Columns ``(shape, c)`` of what is accounted for, text as indicators of its values."""
    if covariates is None:
        return None
    shapes = set(registration_of(study)["shape"].values.tolist())
    if isinstance(covariates, list) and all(isinstance(name, str) for name in covariates):
        columns = [values_of(study, name, "covariate") for name in covariates]
    elif isinstance(covariates, dict) and not shapes <= set(covariates):
        columns = [values_of(study, v, f"covariate {name}") for name, v in covariates.items()]
    else:
        columns = [values_of(study, covariates, "covariate")]
    numbers = [indicators(c)[1] if c.dtype.kind in "OU" else c.astype(float) for c in columns]
    return np.column_stack([c.reshape(len(c), -1) for c in numbers])
