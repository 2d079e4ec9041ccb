"""Table of all variables of a study: dims, unit and meaning.

Each step makes its output through :func:`variable`, so that names, dims and attributes are the same
everywhere, and checks its input through :func:`require`.  The table is the file ``schema.txt``; a
variable that is not in it does not exist.  Extensions add rows by the entry points
``s4a.variables``.
"""

import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from s4a.extensions import extensions

log = logging.getLogger(__name__)
Array = np.ndarray  # of numbers; its dims and kind stand in the docstring
INPUT = "unit of the input"
POSE = "pose"  # the kind of a flag for an ambiguous pose
INPUT2 = "squared unit of the input"
FIELD_UNIT = "unit of the field"
ONE = "1"
SHARE = "share of sqrt(area)"
UNIT_AREA = "1, for the surface scaled to unit area"
LARGEST_COUNT = 2**31 - 1  # of options that count, and of seeds: what every library takes

_UNITS = {
    "L": INPUT, "L2": INPUT2, "share": SHARE, "unit area": UNIT_AREA, "field": FIELD_UNIT
}  # fmt: skip


def _cells(table, n):
    """Return the rows of a table of ``schema.txt``, each with n cells."""
    rows = (line.split("|", n - 1) for line in table.splitlines() if line[0] != "#")
    return [[cell.strip() for cell in row] for row in rows]


_VARIABLES, _FILES = Path(__file__).with_name("schema.txt").read_text("utf-8").split("\n\n")
_ROWS = _cells(_VARIABLES, 4)
ROWS: dict[str, tuple[str, str, str]] = {
    name: (dims, ONE if " index" in unit else _UNITS.get(unit, unit), meaning)
    for name, dims, unit, meaning in _ROWS
}
# index variables and the dim that they refer to; -1 refers to nothing
POINTS_INTO = {name: unit.split()[0] for name, _, unit, _ in _ROWS if " index" in unit}
NOWHERE = {name for name, _, unit, _ in _ROWS if unit.endswith("-1")}
# required contents of a file of a study: variables, text attributes, numeric attributes, and
# dims with another file and its dim of the same size; {template} is that of the registration
HOLDS = {kind: tuple(contents) for kind, *contents in _cells(_FILES, 5)}


class Table(dict[str, tuple[tuple[str, ...], str, str]]):
    """Map the name of a variable to its dims, unit and meaning.

    The rows of extensions are added when a name is looked up that the core lacks.  They cannot
    change rows of the core or of each other.
    """

    def __init__(self, rows: Mapping[str, tuple[str, str, str]]):
        super().__init__()
        self.extended = False
        self.add(rows)

    def add(self, rows: Mapping[str, tuple[str, str, str]]) -> None:
        """Add rows, whose dims are one string."""
        for name, (dims, unit, long_name) in rows.items():
            row = (tuple(dims.split()), unit, long_name)
            if self.setdefault(name, row) != row:
                log.warning("%s is in the table already; another row of that name is ignored", name)

    def __contains__(self, name: object) -> bool:
        if not super().__contains__(name) and not self.extended:
            self.extended = True
            for rows in extensions("s4a.variables").values():
                self.add(rows)
        return super().__contains__(name)

    def __missing__(self, name: str) -> tuple[tuple[str, ...], str, str]:
        if name in self:
            return self[name]
        raise KeyError(name)


TABLE = Table(ROWS)

OMITTED = ("shape", "pair", "iteration")  # leading dims that a file of one of them lacks
TEXTS = set("source target status reason warning path coordinate_system shape stage".split())


def variable(name: str, data: ArrayLike, **attrs: str | float | list[str]) -> xr.Variable:
    """Return a variable of the table with its dims, unit and meaning.

    Parameters
    ----------
    name : str
        A name of :data:`TABLE`.
    data : array_like
        Values.  The number of axes must be that of the table, or one less if the table starts
        with ``shape``.
    **attrs
        Further attributes: str, int, float or lists of str, the types of netCDF.

    Returns
    -------
    xarray.Variable

    Raises
    ------
    ValueError
        If the name is not in the table, or the number of axes differs.

    Examples
    --------
    >>> from s4a.schema import variable
    >>> variable("position", [[0.0, 0.0, 1.0]]).dims
    ('vertex', 'xyz')
    """
    if name not in TABLE:
        raise ValueError(
            f"no variable {name!r} in the schema; add a row to s4a/schema.txt, or to the entry "
            "point s4a.variables of an extension"
        )
    dims, unit, long_name = TABLE[name]
    data = np.asarray(data)
    if data.ndim == len(dims) - 1 and dims[0] in OMITTED:
        dims = dims[1:]
    if data.ndim != len(dims):
        raise ValueError(f"{name} needs the dims {dims}, found an array of shape {data.shape}")
    return xr.Variable(dims, data, {"units": unit, "long_name": long_name, **attrs})


def covariate(name: str, data: ArrayLike) -> xr.Variable:
    """Return a column of the user's table as a variable.

    Examples
    --------
    >>> from s4a.schema import covariate
    >>> covariate("age", [31, 42]).attrs["long_name"]
    "column 'age' of the table of the shapes"
    """
    return xr.Variable(
        ("shape",),
        np.asarray(data),
        {"units": "as in the table", "long_name": f"column {name!r} of the table of the shapes"},
    )


def dataset(attrs: Mapping[str, Any] | None = None, **variables: ArrayLike) -> xr.Dataset:
    """Return a Dataset of variables of the table: ``dataset(position=X, corner_vertex=T)``."""
    return xr.Dataset({name: variable(name, data) for name, data in variables.items()}, attrs=attrs)


def unit_of(values: xr.DataArray | xr.Dataset) -> str:
    """Return the unit of length of a variable or mesh, or "unit of the input" if unknown.

    Examples
    --------
    >>> from s4a.schema import dataset, in_unit, unit_of
    >>> unit_of(in_unit(dataset(position=[[0.0, 0.0, 1.0]]), "mm")["position"])
    'mm'
    """
    return str(values.attrs.get("units") or values.attrs.get("unit") or INPUT)


def in_unit(data: xr.Dataset, unit: str | None, *, of: str = INPUT) -> xr.Dataset:
    """Return a Dataset with its unit in place of "unit of the input", or of `of`.

    Examples
    --------
    >>> from s4a.schema import dataset, in_unit
    >>> in_unit(dataset(vertex_area=[1.0]), "mm")["vertex_area"].attrs["units"]
    'mm^2'
    """
    if not unit or unit == of:
        return data
    units = {INPUT: unit, INPUT2: f"{unit}^2"} if of == INPUT else {of: unit}
    data = data.copy()
    for values in data.data_vars.values():
        before = values.attrs.get("units", ONE)
        values.attrs["units"] = units.get(before, before)
    return data


EXPECTED: dict[type, str] = {
    xr.Dataset: "a Dataset, such as a mesh that s4a.read_shape returns",
    xr.DataTree: "a DataTree, such as s4a.analyse or s4a.open_study returns",
    dict: "a dict of names to meshes",
}


def check_type(value: object, kind: Any, what: str = "study", expected: str = "") -> None:
    """Raise TypeError unless an argument is of a type; it says what is `expected`.

    Examples
    --------
    >>> import xarray as xr
    >>> from s4a.schema import check_type
    >>> check_type("brains", xr.DataTree)
    Traceback (most recent call last):
    TypeError: study must be a DataTree, such as s4a.analyse or s4a.open_study returns; found str
    """
    if not isinstance(value, kind):
        expected = expected or EXPECTED[kind]
        raise TypeError(f"{what} must be {expected}; found {type(value).__name__}")


def require(data: xr.Dataset, *names: str, what: str = "dataset") -> None:
    """Raise an error unless `data` is a Dataset with these variables and the dims of the table.

    Examples
    --------
    >>> from s4a.schema import dataset, require
    >>> require(dataset(position=[[0.0, 0.0, 1.0]]), "position")
    """
    check_type(data, xr.Dataset | xr.DataTree, what, EXPECTED[xr.Dataset])
    missing = [name for name in names if name not in data]
    if missing:
        raise ValueError(
            f"the {what} needs the variables {', '.join(names)}; it lacks {', '.join(missing)} "
            f"and has {', '.join(map(str, data.data_vars)) or 'none'}"
        )
    for name in names:
        dims = TABLE[name][0]
        if set(data[name].dims) not in (set(dims), set(dims[1:])):
            raise ValueError(f"{name} of the {what} needs the dims {dims}, found {data[name].dims}")


def check_indices(name: str, values: np.ndarray, sizes: Mapping[str, int]) -> None:
    """Raise ValueError if an index variable of :data:`POINTS_INTO` is out of range.

    Parameters
    ----------
    name : str
    values : ndarray
    sizes : dict of str to int
        Sizes of the dims; a dim that is missing has no upper limit.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.schema import check_indices
    >>> check_indices("corner_vertex", np.array([[0, 1, 2]]), {"vertex": 3})
    """
    if name not in POINTS_INTO or not values.size:
        return
    dim, least = POINTS_INTO[name], -1 if name in NOWHERE else 0
    low, high, size = int(values.min()), int(values.max()), sizes.get(dim)
    if low < least or (size is not None and high >= size):
        end = "" if size is None else size - 1
        raise ValueError(f"{name} needs indices {least}..{end} of {dim}, found {low}..{high}")


def check_rows(
    name: str, values: ArrayLike, *shapes: tuple[int, ...], of: str = "vertices"
) -> Array:
    """Return values as an array; raise ValueError unless it has one of the shapes.

    Examples
    --------
    >>> from s4a.schema import check_rows
    >>> check_rows("label", [1, 2], (3,))
    Traceback (most recent call last):
    ValueError: label needs a value for each of the 3 vertices, shape (3,); found shape (2,)
    """
    values = np.asarray(values)
    if values.shape not in shapes:
        needed = f"the {shapes[0][0]} {of}, shape {' or '.join(map(str, dict.fromkeys(shapes)))}"
        raise ValueError(f"{name} needs a value for each of {needed}; found shape {values.shape}")
    return values


def check_switch(name: str, value: object) -> None:
    """Raise ValueError unless an option is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False; found {value!r}")


def check_choice(name: str, value: object, legal: Collection[object]) -> None:
    """Raise ValueError unless an option is one of the legal choices.

    Examples
    --------
    >>> from s4a.schema import check_choice
    >>> check_choice("init", "landmark", ("dense", "landmarks"))
    Traceback (most recent call last):
    ValueError: init must be one of 'dense', 'landmarks'; found 'landmark'
    """
    if value not in legal:
        choices = ", ".join(map(repr, legal))
        raise ValueError(f"{name} must be one of {choices}; found {value!r}")


def check_count(name: str, value: object, least: int = 0, most: int = LARGEST_COUNT) -> None:
    """Raise ValueError unless an option is an integer from `least` to `most`.

    Examples
    --------
    >>> from s4a.schema import check_count
    >>> check_count("n_pairs", 10**22)
    Traceback (most recent call last):
    ValueError: n_pairs must be an integer of at most 2147483647; found a larger one
    """
    if isinstance(value, int | np.integer) and value > most:
        raise ValueError(f"{name} must be an integer of at most {most}; found a larger one")
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}; found {value!r}")


def check_text(name: str, value: object) -> None:
    """Raise ValueError unless an option is a text or None."""
    if not isinstance(value, str | None):
        raise ValueError(f"{name} must be a text or None; found {value!r}")
