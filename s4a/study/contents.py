"""What each file of a study holds (4), by the schema, and how the files of one study fit together.

A file may be of a stranger, of another version or by hand.  What the steps and the pictures take
from it is checked when it is opened; no larger variable is read for that.
"""

from collections.abc import Mapping

import numpy as np
import xarray as xr

from s4a.input.files import slug
from s4a.schema import HOLDS, POINTS_INTO, TABLE, TEXTS

SIZES = {"xyz": 3, "xyz_2": 3, "corner": 3, "end": 2}
# a dim of a file, and the file and its dim of the same size; {template} is that of registration
FIT = {
    "coarse/shape": [("original_vertex", "original/{shape}", "vertex")],
    "registration": [
        ("vertex", "original/{template}", "vertex"),
        ("triangle", "original/{template}", "triangle"),
    ],
    "registration/shape": [
        ("original_vertex", "original/{shape}", "vertex"),
        ("vertex", "registration", "vertex"),
        ("low_vertex", "coarse/{template}", "vertex"),
    ],
    "pca": [("vertex", "registration", "vertex")],
    "fields": [("vertex", "registration", "vertex")],
}


def kind_of(name: str) -> str:
    """The row of :data:`s4a.schema.HOLDS` for a file of this name.

    Examples
    --------
    >>> from s4a.study.contents import kind_of
    >>> kind_of("network/comparison_brain_01"), kind_of("registration/a"), kind_of("pca")
    ('network/comparison', 'registration/shape', 'pca')
    """
    stage, _, shape = name.partition("/")
    if shape and stage == "network":
        return f"network/{shape.partition('_')[0]}"
    return f"{stage}/shape" if shape and f"{stage}/shape" in HOLDS else stage


def check_contents(name: str, data: xr.Dataset) -> None:
    """ValueError unless a file has the variables and attributes that a file of its name has.

    Parameters
    ----------
    name : str
        As ``coarse/brain_01``: its path in the folder of the study, without the suffix.
    data : Dataset
        Of :func:`s4a.study.netcdf.open_file`.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.contents import check_contents
    >>> check_contents("pca", dataset(score=[[1.0]]))
    Traceback (most recent call last):
    ...
    ValueError: it lacks shape, mean_displacement, deformation, ...
    """
    kind = kind_of(name)
    if kind not in HOLDS:
        raise ValueError("no file of a study has this name")
    if kind == "coarse/shape" and data.attrs.get("method") == "scalable":
        kind = "coarse/scalable"
    needed, texts, numbers = (words.split() for words in HOLDS[kind])
    check_names(data)
    missing = [one for one in needed if one not in data.variables]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    for attrs, kinds, what in ((texts, str, "text"), (numbers, (int, float), "number")):
        wrong = [attr for attr in attrs if not isinstance(data.attrs.get(attr), kinds)]
        if wrong:
            raise ValueError(
                f"the attribute {wrong[0]} needs a {what}, found {data.attrs.get(wrong[0])!r:.40}"
            )
    for one, values in data.variables.items():
        if kind != "subjects":
            check_variable(str(one), values, str(one) in needed)
        elif values.dims != ("shape",):
            raise ValueError(f"the column {one} needs the dim shape, found {values.dims}")
    for dim, size in data.sizes.items():
        if SIZES.get(str(dim), size) != size:
            raise ValueError(f"{dim} needs {SIZES[str(dim)]} entries, found {size}")


def check_variable(name: str, values: xr.Variable, needed: bool) -> None:
    """ValueError unless a variable has the dims of the table and, where needed, is of its kind."""
    is_coordinate = name in values.dims
    if not is_coordinate and name not in TABLE:
        raise ValueError(f"no variable of a study is called {name}")
    dims = (name,) if is_coordinate else TABLE[name][0]
    of_one = dims[1:] if dims[0:1] in (("shape",), ("pair",)) and not is_coordinate else dims
    if values.dims not in (dims, of_one):
        raise ValueError(f"{name} needs the dims {dims}, found {values.dims}")
    kinds, what = "iuf", "numbers"
    if name in TEXTS:
        kinds, what = "U", "text"
    elif name in POINTS_INTO:
        kinds, what = "iu", "integers"
    if (needed or name in POINTS_INTO) and values.dtype.kind not in kinds:
        raise ValueError(f"{name} needs {what}, found {values.dtype}")


def check_names(data: xr.Dataset) -> None:
    """ValueError where a shape or stage is there twice, or a name would lead out of the folder."""
    for name in ("shape", "stage"):
        if name in data.coords:
            each, counts = np.unique(data.coords[name].values.astype(str), return_counts=True)
            if (counts > 1).any():
                twice = each[counts > 1].tolist()
                raise ValueError(f"{name} needs names that differ, found {twice} more than once")
    names = [str(data.attrs[attr]) for attr in ("template", "median") if attr in data.attrs]
    names += str(data.attrs.get("excluded", "")).split()
    names += data.coords["shape"].values.astype(str).tolist() if "shape" in data.coords else []
    wrong = [name for name in names if slug(name) != name]
    if wrong:
        raise ValueError(f"shapes need names of letters, digits, _ and -; found {wrong}")


def check_fit(name: str, data: xr.Dataset, others: Mapping[str, xr.Dataset]) -> None:
    """ValueError where a file does not fit to those of the study that it was made from.

    Parameters
    ----------
    name : str
        As in :func:`check_contents`.
    data : Dataset
    others : dict of str to Dataset
        By name, those that were read before.
    """
    template = others.get("registration", data).attrs.get("template", "")
    for dim, place, of_place in FIT.get(kind_of(name), ()):
        other = place.format(shape=name.partition("/")[2], template=template)
        if other in others and dim in data.sizes:
            size, found = others[other].sizes[of_place], data.sizes[dim]
            if size != found:
                raise ValueError(f"{dim} needs {size} entries as in {other}, found {found}")
