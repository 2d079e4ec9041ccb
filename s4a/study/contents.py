"""Check the files of a study (4) against the schema and against each other.

Files may be untrusted, of another version or edited.  They are checked when they are opened,
without reading larger variables.
"""

from collections.abc import Mapping

import numpy as np
import xarray as xr

from s4a.input.files import slug
from s4a.schema import HOLDS, OMITTED, POINTS_INTO, TABLE, TEXTS

SIZES = {"xyz": 3, "xyz_2": 3, "corner": 3, "end": 2}
# kind of file -> (dim, other file, dim of the same size there); {template} is that of registration
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
    """Return the key in :data:`s4a.schema.HOLDS` for the name of a file.

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


def shape_of(name: str) -> str:
    """Return the shape of a file, or the name itself if the file is of all shapes.

    Examples
    --------
    >>> from s4a.study.contents import shape_of
    >>> shape_of("network/comparison_brain_01"), shape_of("registration/a"), shape_of("pca")
    ('brain_01', 'a', 'pca')
    """
    stage, _, shape = name.partition("/")
    return shape.partition("_")[2] or shape if stage == "network" and shape else shape or name


def check_name(name: str, data: xr.Dataset) -> None:
    """Raise ValueError unless a file has the name under which it was written.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.contents import check_name
    >>> check_name("coarse/a", dataset({"file": "coarse/b"}))
    Traceback (most recent call last):
    ...
    ValueError: it holds b, is named a: files were exchanged or renamed
    """
    stored = data.attrs.get("file")
    if not isinstance(stored, str):
        raise ValueError("it has no name of its own: another version of s4a wrote it")
    if stored != name:
        of_kind = kind_of(stored) == kind_of(name)
        held, named = map(shape_of, (stored, name)) if of_kind else (stored, name)
        raise ValueError(f"it holds {held}, is named {named}: files were exchanged or renamed")


def check_contents(name: str, data: xr.Dataset) -> None:
    """Raise ValueError unless a file has the variables and attributes of its kind.

    Parameters
    ----------
    name : str
        Path in the folder of the study without the suffix, as ``coarse/brain_01``.
    data : Dataset
        See :func:`s4a.study.netcdf.open_file`.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.contents import check_contents
    >>> check_contents("pca", dataset(score=[[1.0]]))
    Traceback (most recent call last):
    ...
    ValueError: missing variables shape, mean_displacement, deformation, ...
    """
    kind = kind_of(name)
    if kind not in HOLDS:
        raise ValueError("not the name of a file of a study")
    if kind == "coarse/shape" and data.attrs.get("method") == "scalable":
        kind = "coarse/scalable"
    needed, texts, numbers = (words.split() for words in HOLDS[kind])
    check_names(data)
    missing = [variable for variable in needed if variable not in data.variables]
    if missing:
        raise ValueError(f"missing variables {', '.join(missing)}")
    for attrs, kinds, what in ((texts, str, "text"), (numbers, (int, float), "number")):
        wrong = [attr for attr in attrs if not isinstance(data.attrs.get(attr), kinds)]
        if wrong:
            raise ValueError(
                f"the attribute {wrong[0]} needs a {what}, found {data.attrs.get(wrong[0])!r:.40}"
            )
    for variable, values in data.variables.items():
        if kind != "subjects":
            check_variable(str(variable), values, str(variable) in needed)
        elif values.dims != ("shape",):
            raise ValueError(f"the column {variable} needs the dim shape, found {values.dims}")
    for dim, size in data.sizes.items():
        if SIZES.get(str(dim), size) != size:
            raise ValueError(f"{dim} needs {SIZES[str(dim)]} entries, found {size}")


def check_variable(name: str, values: xr.Variable, needed: bool) -> None:
    """Raise ValueError unless a variable has the dims and, if needed, the type of the schema."""
    is_coordinate = name in values.dims
    if not is_coordinate and name not in TABLE:
        raise ValueError(f"{name} is not a variable of a study")
    dims = (name,) if is_coordinate else TABLE[name][0]
    of_shape = dims[1:] if dims and dims[0] in OMITTED and not is_coordinate else dims
    if values.dims not in (dims, of_shape):
        raise ValueError(f"{name} needs the dims {dims}, found {values.dims}")
    kinds, what = "iuf", "numbers"
    if name in TEXTS:
        kinds, what = "U", "text"
    elif name in POINTS_INTO:
        kinds, what = "iu", "integers"
    if (needed or name in POINTS_INTO) and values.dtype.kind not in kinds:
        raise ValueError(f"{name} needs {what}, found {values.dtype}")


def check_names(data: xr.Dataset) -> None:
    """Raise ValueError if a shape or stage is repeated, or a name could leave the folder."""
    for name in ("shape", "stage"):
        if name in data.coords:
            unique, counts = np.unique(data.coords[name].values.astype(str), return_counts=True)
            if (counts > 1).any():
                repeated = unique[counts > 1].tolist()
                raise ValueError(f"{name} needs unique names, found {repeated} more than once")
    names = [str(data.attrs[attr]) for attr in ("template", "median") if attr in data.attrs]
    names += str(data.attrs.get("excluded", "")).split()
    names += data.coords["shape"].values.astype(str).tolist() if "shape" in data.coords else []
    wrong = [name for name in names if slug(name) != name]
    if wrong:
        raise ValueError(f"shapes need names of letters, digits, _ and -; found {wrong}")


def check_fit(name: str, data: xr.Dataset, others: Mapping[str, xr.Dataset]) -> None:
    """Raise ValueError if the sizes of a file do not match those of the files it was made from.

    Parameters
    ----------
    name : str
        As in :func:`check_contents`.
    data : Dataset
    others : dict of str to Dataset
        Files that were read before, by name.
    """
    template = others.get("registration", data).attrs.get("template", "")
    for dim, pattern, other_dim in FIT.get(kind_of(name), ()):
        other = pattern.format(shape=name.partition("/")[2], template=template)
        if other in others and dim in data.sizes:
            expected, size = others[other].sizes[other_dim], data.sizes[dim]
            if expected != size:
                raise ValueError(f"{dim} needs {expected} entries as in {other}, found {size}")
