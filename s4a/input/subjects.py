"""Covariates and groups of the shapes (6.1): a table on which only the statistics depend."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from s4a.input.annotations import is_number, table_rows
from s4a.input.bounded import content
from s4a.input.files import slug
from s4a.schema import covariate


def _head_and_rows(path):
    try:
        head, *rows = table_rows(content(path))
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} cannot be read as a table: {error}") from error
    if "shape" not in head:
        raise ValueError(
            f"{path}: a column 'shape' with the names or files of the shapes needed; found {head}"
        )
    wrong = [name for name in head if not name or "/" in name or head.count(name) > 1]
    if wrong:
        raise ValueError(
            f"{path}: columns need names of their own without '/'; found {wrong[0]!r} in {head}"
        )
    ragged = [(i, row) for i, row in enumerate(rows, 2) if len(row) != len(head)]
    if ragged:
        number, row = ragged[0]
        raise ValueError(
            f"{path}: {len(head)} cells in every row needed; row {number} has {len(row)}"
        )
    return head, rows


def _shape_of(cell, names):
    """The shape that a cell names, by its name or its file; the cell itself where there is none."""
    return next((n for n in (cell, slug(cell), slug(Path(cell).stem)) if n in names), cell)


def read_table(path: Path | str, names: list[str]) -> xr.Dataset:
    """Covariates and groups from a file.

    Parameters
    ----------
    path : path
        CSV with a header, separated by commas, semicolons or tabs, a row per shape; the column
        ``shape`` has the name of the shape or that of its file.
    names : list of str
        The shapes.

    Returns
    -------
    Dataset
        A variable over ``shape`` for every other column, in the order of `names`: whole numbers,
        numbers (NaN where the cell is empty, ``NA`` or ``nan``), or text where one cell is no
        number.

    Raises
    ------
    ValueError
        When the file is no such table, or has not one row for each shape; shapes and columns are
        named.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from s4a.input.subjects import read_table
    >>> file = Path(tempfile.mkdtemp()) / "subjects.csv"
    >>> _ = file.write_text("shape,sex,age\\nb.ply,f,31\\na,m,NA\\n")
    >>> table = read_table(file, ["a", "b"])
    >>> table["age"].values.tolist(), table["sex"].values.tolist()
    ([nan, 31.0], ['m', 'f'])
    """
    path = Path(path)
    head, rows = _head_and_rows(path)
    row_of = {}
    for row in rows:
        name = _shape_of(row[head.index("shape")], names)
        if name in row_of:
            raise ValueError(f"{path}: one row for each shape needed; found two for {name!r}")
        row_of[name] = row
    unknown = [name for name in row_of if name not in names]
    missing = [name for name in names if name not in row_of]
    if unknown or missing:
        said = [f"no shape is called {', '.join(map(repr, unknown))}"] if unknown else []
        said += [f"no row for {', '.join(missing)}"] if missing else []
        raise ValueError(
            f"{path}: a row for every shape and no other needed in the column 'shape'; "
            + "; ".join(said)
        )
    columns = {
        column: _values([row_of[name][i] for name in names])
        for i, column in enumerate(head)
        if column != "shape"
    }
    if not columns:
        raise ValueError(f"{path}: a column beside 'shape' needed, found none")
    for name, values in columns.items():
        if values.dtype.kind == "f" and np.isinf(values).any():
            raise ValueError(
                f"{path}: finite numbers, or nothing, needed in the column {name!r}; found {np.inf}"
            )
    return subjects(columns, names, str(path))


def _values(cells):
    """Integers, floats or strings, whatever all cells are."""
    known = [c for c in cells if c.lower() not in ("", "na", "nan")]
    if not known or not all(map(is_number, known)):
        return np.array(cells)
    numbers = np.array([float(c) if c in known else np.nan for c in cells])
    whole = (
        len(known) == len(cells)
        and all(c.lstrip("+-").isdigit() for c in cells)
        and (abs(numbers) < 2**53).all()
    )
    return numbers.astype(np.int64) if whole else numbers


def subjects(
    columns: Mapping[str, ArrayLike], names: Sequence[str], path: Path | str = ""
) -> xr.Dataset:
    """The Dataset ``/subjects`` of columns, a dict of name to values in the order of the shapes."""
    wrong = [n for n, values in columns.items() if np.shape(values) != (len(names),)]
    if wrong:
        raise ValueError(f"column {wrong[0]!r} needs a value for each of {len(names)} shapes")
    data = {name: covariate(name, values) for name, values in columns.items()}
    return xr.Dataset(data, {"shape": list(names)}, {"path": str(path)})


def with_table(study: xr.DataTree, path: Path | str) -> xr.DataTree:
    """A study with ``/subjects`` read from a file.

    The tables are shared, the study given stays as it is.
    """
    names = study["report" if "report" in study else "registration"]["shape"].values.tolist()
    nodes = {n.path: n.to_dataset(inherit=False) for n in study.subtree if n.path != "/subjects"}
    return xr.DataTree.from_dict(nodes | {"/subjects": read_table(path, names)}, name=study.name)
