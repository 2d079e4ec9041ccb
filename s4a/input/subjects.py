"""Tables of covariates and groups of the shapes (6.1), for the statistics."""

import itertools
import logging
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from s4a.input.annotations import is_number, table_rows
from s4a.input.files import slug, stem_of, visible
from s4a.input.raw import content, reading, text_of
from s4a.schema import covariate

log = logging.getLogger(__name__)

# cells without a value, in lower case
MISSING = ("", "-", "na", "n/a", "nan", "#n/a", "<na>", "null")
# what looks like Latin letters, straight quotes and the hyphen
_SAME = str.maketrans(
    "аеорсухіѕјкмнтвӏԁɑıɡΑΒΕΖΗΙΚΜΝΟΡΤΥΧαοινρυχ’‘ʼ“”‐‑‒–—−",
    "aeopcyxisjkmhtbldaigABEZHIKMNOPTYXaoivpux'''\"\"------",
)
_DIGITS = str.maketrans("oli|", "0111")  # O and 0, l and 1
_PERSON = re.compile(r"(subject|participant|patient|person)([ _-]?(id|nr|no))?", re.IGNORECASE)


def _head_and_rows(path):
    with reading(path, "a table"):
        rows = table_rows(text_of(content(path)))
    head = rows.pop(next(iter(rows)))
    head = ["shape" if visible(name).lower() == "shape" else visible(name) for name in head]
    head, rows = _without_empty(head, rows)
    if "shape" not in head:
        raise ValueError(
            f"{path}: a column 'shape' with names or files of the shapes needed; found {head}"
        )
    wrong = [name for name in head if not name or "/" in name or head.count(name) > 1]
    if wrong:
        raise ValueError(
            f"{path}: columns need unique names without '/'; found {wrong[0]!r} in {head}"
        )
    for same, variants in look_alikes(head):
        if same:
            raise ValueError(f"{path}: columns need names that differ visibly; found {variants}")
        log.warning("%s: columns differ only in case or similar letters: %s", path, variants)
    ragged = [(line, row) for line, row in rows.items() if len(row) != len(head)]
    if ragged:
        line, row = ragged[0]
        raise ValueError(
            f"{path}: {len(head)} cells in every row needed; found {len(row)} in line {line}"
        )
    return head, list(rows.values())


def _without_empty(head, rows):
    """Drop rows and columns without any text, which spreadsheets write."""
    rows = {line: row for line, row in rows.items() if any(row)}
    every = [head, *rows.values()]
    columns = itertools.zip_longest(*every, fillvalue="")
    filled = [i for i, column in enumerate(columns) if any(column)]
    head, *kept = ([row[i] for i in filled if i < len(row)] for row in every)
    return head, dict(zip(rows, kept, strict=True))


def _shape_of(cell, names):
    """Shape that a cell names, by its name or its file; the cell itself if there is none."""
    cell = visible(cell)
    *folders, file = re.split(r"[/\\]", cell)
    # names of shapes may begin with the names of their folders
    ends = [[*folders[i:], stem_of(file)] for i in range(len(folders) + 1)]
    candidates = (cell, slug(cell), *(slug("/".join(end)) for end in ends))
    return next((name for name in candidates if name in names), cell)


def read_table(path: Path | str, names: list[str]) -> xr.Dataset:
    """Read a table of covariates and groups.

    Parameters
    ----------
    path : path
        CSV with a header, separated by commas, semicolons or tabs, with a row per shape; the column
        ``shape`` has the name of the shape, or its file with or without folders.  A row without
        a shape is ignored; all values of a shape without a row are missing.  A warning names both.
    names : list of str
        Names of the shapes.

    Returns
    -------
    Dataset
        A variable over ``shape`` for every other column, in the order of `names`: integers;
        numbers, with NaN for missing values; or text, empty for missing values.  Missing values are
        empty cells, ``NA``, ``n/a``, ``NaN``, ``-`` or ``null``, in upper or lower case.  A column
        with some cells that are not numbers, as ``?`` or decimal commas, stays text with a warning,
        and tests do not use it.  A column also stays text if different digits would give the same
        number, as ``01`` and ``1``: they are identifiers.

    Raises
    ------
    ValueError
        If the file is not such a table, has two rows for a shape, or no row for any shape.

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
    cells = read_cells(path, names)
    columns = {
        column: _values([cells[name][column] for name in names]) for column in cells[names[0]]
    }
    if not columns:
        raise ValueError(f"{path}: a column in addition to 'shape' needed, found none")
    for name, values in columns.items():
        if values.dtype.kind == "f" and np.isinf(values).any():
            raise ValueError(
                f"{path}: finite numbers, or nothing, needed in the column {name!r}; found {np.inf}"
            )
        if rows := non_numeric_cells(values.tolist()) if values.dtype.kind == "U" else []:
            log.warning("%s: the column %r %s", path, name, non_numeric_text(rows, names, values))
        if _PERSON.fullmatch(name):
            _report_repeated(path, name, values, names)
    return subjects(columns, names, str(path))


def read_cells(path: Path | str, names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Read the cells of a table as text, by shape and column; see :func:`read_table`."""
    head, rows = _head_and_rows(path)
    row_of: dict[str, dict[str, str]] = {}
    for row in rows:
        name = _shape_of(row[head.index("shape")], names)
        if name in row_of:
            raise ValueError(f"{path}: one row for each shape needed; found two for {name!r}")
        row_of[name] = dict(zip(head, row, strict=True))
        del row_of[name]["shape"]
    unknown = [name for name in row_of if name not in names]
    missing = [name for name in names if name not in row_of]
    if len(missing) == len(names):
        raise ValueError(
            f"{path}: names of the shapes ({listed(names)}) needed in the column 'shape'; found "
            f"{listed(unknown) or 'no row'}"
        )
    if unknown:
        log.warning("%s: rows ignored, as no shape has their name: %s", path, listed(unknown))
    if missing:
        log.warning("%s: no row, so all values are missing: %s", path, listed(missing))
    empty = {column: "" for column in head if column != "shape"}
    return {name: row_of.get(name, empty) for name in names}


def _values(cells):
    """Integers or floats if all cells are, else strings."""
    present = [c for c in cells if not is_missing(c)]
    digits = {c for c in present if c.lstrip("+-").isdigit()}
    are_numbers = bool(present) and all(map(is_plain_number, present))
    # 01 and 1, or numbers of 17 digits, would become equal
    if not are_numbers or len({float(c) for c in digits}) < len(digits):
        return np.array(["" if is_missing(c) else c for c in cells])
    numbers = np.array([np.nan if is_missing(c) else float(c) for c in cells])
    whole = all(c in digits for c in cells) and (abs(numbers) < 2**53).all()
    return numbers.astype(np.int64) if whole else numbers


def _report_repeated(path, column, values, names):
    """Warn about several shapes of one person: tests assume independent shapes."""
    shapes_of = {}
    for name, value in zip(names, values.tolist(), strict=True):
        if not is_missing(str(value)):
            shapes_of.setdefault(value, []).append(name)
    repeated = [f"{value}: {', '.join(s)}" for value, s in shapes_of.items() if len(s) > 1]
    if repeated:
        log.warning(
            f"{path}: {len(repeated)} values of the column {column!r} have several shapes "
            f"({listed(repeated, '; ')}); tests assume independent shapes: keep one shape of each, "
            "or use the analysis of growth"
        )


def is_missing(cell: str) -> bool:
    """Return whether a cell stands for a missing value.

    Examples
    --------
    >>> from s4a.input.subjects import is_missing
    >>> [is_missing(cell) for cell in ("NA", " n/a", "-", "none", "0")]
    [True, True, True, False, False]
    """
    return cell.strip().lower() in MISSING


def is_plain_number(cell: str) -> bool:
    """Return whether a cell is a number; 1_000, a number in Python, is not."""
    return is_number(cell) and "_" not in cell


def non_numeric_cells(cells: Sequence[str]) -> list[int]:
    """Rows of cells that are not numbers, in a column of mostly numbers; else an empty list.

    Numbers with a decimal comma count as numbers for "mostly", and are returned.

    Examples
    --------
    >>> from s4a.input.subjects import non_numeric_cells
    >>> non_numeric_cells(["31", "?", "NA", "42"]), non_numeric_cells(["60,5", "61,0"])
    ([1], [0, 1])
    >>> non_numeric_cells(["a1", "b2"])
    []
    """
    present = [i for i, cell in enumerate(cells) if not is_missing(cell)]
    like_numbers = [i for i in present if is_plain_number(cells[i].replace(",", "."))]
    rows = [i for i in present if not is_plain_number(cells[i])]
    return rows if 2 * len(like_numbers) > len(present) else []


def non_numeric_text(rows: Sequence[int], names: Sequence[str], cells: Sequence[str]) -> str:
    """Describe a column with :func:`non_numeric_cells`, and the remedy."""
    found = listed([f"{names[i]}: {str(cells[i])!r}" for i in rows])
    return (
        f"is mostly numbers, but {len(rows)} of {len(cells)} cells are not ({found}): write "
        "numbers with a decimal point and without unit, and NA for missing values; or text in "
        "every cell, if they are names of groups"
    )


def listed(texts: Sequence[str], mark: str = ", ", most: int = 5) -> str:
    """List the first texts, and the number of others.

    Examples
    --------
    >>> from s4a.input.subjects import listed
    >>> listed(["a", "b", "c"], most=2)
    'a, b and 1 more'
    """
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return mark.join(texts[:most]) + more


def subjects(
    columns: Mapping[str, ArrayLike], names: Sequence[str], path: Path | str = ""
) -> xr.Dataset:
    """Make ``/subjects`` from columns, a dict of name to values in the order of the shapes."""
    wrong = [n for n, values in columns.items() if np.shape(values) != (len(names),)]
    if wrong:
        raise ValueError(f"column {wrong[0]!r} needs a value for each of {len(names)} shapes")
    data = {name: covariate(name, values) for name, values in columns.items()}
    return xr.Dataset(data, {"shape": list(names)}, {"path": str(path)})


def with_table(study: xr.DataTree, path: Path | str) -> xr.DataTree:
    """Return a study with ``/subjects`` read from a file; the study given is not changed."""
    report = study["report" if "report" in study else "registration"].to_dataset()
    names = report["shape"].values.tolist()
    nodes = {n.path: n.to_dataset(inherit=False) for n in study.subtree if n.path != "/subjects"}
    return xr.DataTree.from_dict(nodes | {"/subjects": read_table(path, names)}, name=study.name)


def look_alikes(cells: Sequence[str]) -> list[tuple[bool, list[str]]]:
    """Return different texts that look alike, and whether they cannot be distinguished by eye.

    Examples
    --------
    >>> from s4a.input.subjects import look_alikes
    >>> look_alikes(["a", "A", "b", "b\\u200b", "1_1", "11"])
    [(False, ['A', 'a']), (True, ['b', 'b\\u200b'])]
    """
    by_look: dict[str, list[str]] = {}
    for cell in sorted({*cells}):
        by_look.setdefault(look(cell), []).append(cell)
    by_digits: dict[str, list[str]] = {}
    for key in by_look:
        by_digits.setdefault(look(key.translate(_DIGITS)), []).append(key)
    for first, *keys in by_digits.values():
        if re.search(r"[01|]", "".join([first, *keys])):  # not "Ai" and "Al"
            for key in keys:
                by_look[first] += by_look.pop(key)
    several = [variants for variants in by_look.values() if len(variants) > 1]
    return [(len({*map(visible, v)}) < len(v), v) for v in several]


def look(text: str) -> str:
    """Return what texts that look alike have in common: compatible letters in lower case.

    Examples
    --------
    >>> from s4a.input.subjects import look
    >>> look(" Site\\u00a01 ") == look("site 1"), look("01") == look("1.0")
    (True, True)
    """
    text = unicodedata.normalize("NFKC", visible(text).translate(_SAME))
    text = unicodedata.normalize("NFKC", text.casefold().translate(_SAME))
    text = re.sub(r"(?<!\d)[ _]|[ _](?!\d)", "", text)  # not between digits: 1_1 is not 11
    return str(float(text)) if is_plain_number(text) else text
