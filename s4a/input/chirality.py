"""Left and right sides (5.1, the data): detect and mirror shapes of the less common side.

Each shape was compared with several references, as it is and mirrored
(:mod:`s4a.input.plausibility`).  The signs that agree best with all pairs are those of the leading
eigenvector of the matrix of comparisons, so that no single shape decides.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from s4a.input.columns import check_column
from s4a.input.coordinates import CoordinateSystem, file_system, map_between, moved, transformed
from s4a.input.subjects import listed
from s4a.schema import Array

MIRROR = np.array([-1.0, 1.0, 1.0])
COMMON_SIDE, OTHER_SIDE = 0.8, 0.5  # least |mean chirality|: median of all shapes, of one shape
# largest ICP residual of a mirror image, as a share of that of the shape: 0.7 to 0.8 for femurs of
# the other side, 0.87 or more for nearly symmetric faces with meshes of their own
CLEARLY = 0.85
AUTO = "auto"
PLURAL = ("they are", "them", "all that are")
YES, NO = ("1", "1.0", "true", "yes"), ("0", "0.0", "false", "no")


def mirror_image(mesh: xr.Dataset) -> xr.Dataset:
    """Reflect a mesh and its landmarks in x = 0; normals stay outward.

    The attributes ``reflected`` and ``reason`` record it.

    Examples
    --------
    >>> import s4a
    >>> from s4a.geometry.mesh import as_arrays, volume
    >>> from s4a.input.chirality import mirror_image
    >>> mesh = s4a.synthetic.sphere(100)
    >>> image = mirror_image(mesh)
    >>> bool((image["position"][:, 0] == -mesh["position"][:, 0]).all())
    True
    >>> abs(volume(*as_arrays(image)) - volume(*as_arrays(mesh))) < 1e-9
    True
    """
    image = transformed(mesh, np.diag([*MIRROR, 1.0]))
    reasons = [mesh.attrs.get("reason", ""), "mirrored by reflect="]
    reflected = 1 - mesh.attrs.get("reflected", 0)
    return image.assign_attrs(reflected=reflected, reason="; ".join(filter(None, reasons)))


def map_to_file(attrs: Mapping[Any, Any]) -> Array:
    """Return the map (4, 4) of a mesh with these attributes to the coordinates of its file."""
    M = np.diag([*MIRROR, 1.0]) if attrs.get("reflected") else np.eye(4)
    return map_between(CoordinateSystem.of(attrs), file_system(attrs), "a mesh") @ M


def in_file(mesh: xr.Dataset, X: Array, *, back: bool = False) -> Array:
    """Transform points ``(n, 3)`` of a mesh to the coordinates of its file, or back."""
    M = map_to_file(mesh.attrs)
    return moved(X, np.linalg.inv(M) if back else M)


def mean_chirality(comparisons: Mapping[str, xr.Dataset]) -> Array:
    """Mean chirality of each shape ``(n,)``, positive on the more common side.

    On a tie, the side of the first shape is positive.

    Parameters
    ----------
    comparisons : dict of str to Dataset
        Name -> :func:`s4a.input.plausibility.compare`.

    Returns
    -------
    ndarray
        Mean over the references of ``chirality`` times the sign of the reference; near zero if the
        side cannot be determined.
    """
    names = list(comparisons)
    references = next(iter(comparisons.values()))["reference"].values.tolist()
    chirality = np.array([data["chirality"].values for data in comparisons.values()])  # (n, refs)
    is_shape = [name in names for name in references]
    index = [names.index(name) for name in references if name in names]
    pairs = np.full((len(names), len(names)), np.nan)
    pairs[:, index] = chirality[:, is_shape]
    sign = signs(pairs)
    # a reference that is not among the shapes has the sign that they agree on
    reference_sign = np.where(np.nan_to_num(chirality.T) @ sign < 0, -1, 1)
    reference_sign[is_shape] = sign[index]
    known = np.isfinite(chirality).sum(1)
    mean = np.nansum(chirality * reference_sign, axis=1) / np.maximum(known, 1)
    negative, positive = (mean < 0).sum(), (mean > 0).sum()
    return -mean if (negative, mean[0] < 0) > (positive, mean[0] > 0) else mean


def signs(similarity: Array) -> Array:
    """Signs ``(n,)`` that agree best with pairwise similarities, by the leading eigenvector.

    Parameters
    ----------
    similarity : float ndarray (n, n)
        Positive for two shapes of the same side, negative for opposite sides, NaN if unknown. Both
        directions of a pair are averaged.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.chirality import signs
    >>> signs(np.array([[np.nan, -2, 1], [-2, np.nan, np.nan], [1, -0.1, np.nan]])).tolist()
    [1, -1, 1]
    """
    is_known = np.isfinite(similarity)
    values = np.where(is_known, similarity, 0)
    symmetric = (values + values.T) / np.maximum(is_known.astype(int) + is_known.T, 1)
    leading = np.linalg.eigh(symmetric)[1][:, -1]
    sign = np.where(leading < 0, -1, 1)
    return sign * sign[0]


def fits_mirrored(
    comparisons: Mapping[str, xr.Dataset], mirrored: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Median ICP residuals of `mirrored` shapes to references of the common side.

    Returns
    -------
    dict of str to tuple (fit, fit_mirrored)
        Residuals of the shape as it is and reflected.  Only if the latter is below ``CLEARLY``
        times the former is the side clear: symmetric shapes differ from their mirror images by less
        than two meshes of one shape do.
    """
    fits = {}
    for name in mirrored:
        data = comparisons[name]
        common = ~np.isin(data["reference"].values, mirrored)
        common |= not common.any()
        fit, fit_mirrored = (
            float(np.nanmedian(data[key].values[common])) for key in ("fit", "fit_mirrored")
        )
        fits[name] = fit, fit_mirrored
    return fits


def clearly_mirrored(comparisons: Mapping[str, xr.Dataset], names: Sequence[str]) -> list[str]:
    """Return those of the `names` that fit the common side clearly better if they are reflected."""
    fits = fits_mirrored(comparisons, names)
    return [name for name in names if fits[name][1] < CLEARLY * fits[name][0]]


def _unclear(weak):
    they, them, which = ("it is", "it", "it if it is") if len(weak) == 1 else PLURAL
    return (
        f"reflect='auto' cannot determine the side of {listed(weak, most=20)}, left as {they}: "
        f"look at {them}, and name {which} to be mirrored"
    )


def mirrored_shapes(comparisons: Mapping[str, xr.Dataset]) -> tuple[list[str], list[str]]:
    """Return the shapes that ``reflect="auto"`` mirrors, those of the less common side.

    Returns
    -------
    names : list of str
        Empty if the shapes are nearly mirror-symmetric.
    remarks : list of str
        Shapes whose side is not clear; they are not mirrored.
    """
    if len(comparisons) < 2:
        return [], ["reflect='auto' needs at least two shapes to compare"]
    names, remarks = rarer_side(
        dict(zip(comparisons, mean_chirality(comparisons).tolist(), strict=True))
    )
    clear = clearly_mirrored(comparisons, names)
    unclear = [name for name in names if name not in clear]
    return clear, [*remarks, *([_unclear(unclear)] if unclear else [])]


def rarer_side(chirality: Mapping[str, float]) -> tuple[list[str], list[str]]:
    """Shapes of the less common side, by the :func:`mean_chirality` of each, and remarks."""
    median = float(np.median(np.abs(list(chirality.values()))))
    if median < COMMON_SIDE:
        return [], [
            "reflect='auto' mirrored no shape: the shapes are too symmetric to distinguish left "
            f"and right (median |mean_chirality| {median:.2f}, {COMMON_SIDE} needed); name those "
            "to mirror"
        ]
    weak = [name for name, value in chirality.items() if abs(value) < OTHER_SIDE]
    mirrored = [name for name, value in chirality.items() if value <= -OTHER_SIDE]
    return mirrored, [_unclear(weak)] * bool(weak)


def is_mirrored(
    name: str, comparison: xr.Dataset, others: Mapping[str, xr.Dataset]
) -> tuple[bool, str]:
    """Return whether a shape is of the less common side, and a remark if that is not clear.

    Parameters
    ----------
    name : str
    comparison : Dataset
        See :func:`s4a.input.plausibility.compare`.
    others : dict of str to Dataset
        Comparisons of the other shapes.
    """
    *chirality, this = mean_chirality({**others, "": comparison})
    median = float(np.median(np.abs(chirality)))
    if median < COMMON_SIDE:
        return False, (
            f"reflect='auto' left {name} as it is: the shapes of the study are too symmetric to "
            f"distinguish left and right (median |mean_chirality| {median:.2f}, {COMMON_SIDE} "
            "needed)"
        )
    is_clear = this > 0 or clearly_mirrored({name: comparison}, [name])
    if abs(this) < OTHER_SIDE or not is_clear:
        return False, _unclear([name])
    return bool(this <= -OTHER_SIDE), ""


def to_reflect(reflect: str, names: Sequence[str], table: xr.Dataset | None) -> list[str]:
    """Return the shapes that ``reflect=`` selects, other than ``"auto"``.

    Parameters
    ----------
    reflect : str
        ``"COLUMN=VALUE"``, a column of yes and no (1 and 0) of the table, or names of shapes
        separated by commas.
    names : list of str
        Names of all shapes.
    table : Dataset, optional
        ``/subjects``.

    Raises
    ------
    ValueError
        If a name is not a shape, a column is missing or lacks a value, or no shape is selected.

    Examples
    --------
    >>> from s4a.input.chirality import to_reflect
    >>> from s4a.input.subjects import subjects
    >>> table = subjects({"side": ["left", "right"]}, ["a", "b"])
    >>> to_reflect("side=left", ["a", "b"], table), to_reflect("b", ["a", "b"], None)
    (['a'], ['b'])
    """
    columns = [] if table is None else list(map(str, table.data_vars))
    column, is_value, value = reflect.partition("=")
    if column in columns and table is not None:
        chosen = _rows_of(table, column, value if is_value else None)
    elif is_value:
        raise ValueError(
            f"reflect={reflect!r} needs a table with the column {column!r}; found "
            f"{', '.join(columns) or 'no table: give table= (--table FILE)'}"
        )
    else:
        chosen = [name.strip() for name in reflect.split(",")]
    unknown = [name for name in chosen if name not in names]
    if unknown:
        raise ValueError(
            f"reflect={reflect!r}: {listed(list(map(repr, unknown)))} is not a shape "
            f"({listed(list(names), most=8)}) or a column of the table "
            f"({', '.join(columns) or 'no table'})"
        )
    if not chosen:
        raise ValueError(f"reflect={reflect!r} selects none of the {len(names)} shapes")
    return [name for name in names if name in chosen]


def _rows_of(table, column, value):
    """Shapes whose cell in a column is the value, or yes."""
    cells = dict(zip(table["shape"].values.tolist(), table[column].values.tolist(), strict=True))
    words = {name: str(cell).strip() for name, cell in cells.items()}
    missing = [name for name, word in words.items() if word in ("", "nan")]
    if missing:
        raise ValueError(f"reflect: the column {column!r} has no value for {listed(missing)}")
    if value is not None:
        texts = np.array(list(words.values()))
        check_column(texts, list(words), f"reflect, column {column!r}", categories=True)
        if value not in words.values():
            raise ValueError(
                f"reflect: no shape has {value!r} in the column {column!r}, which has "
                f"{listed(sorted(set(words.values())))}"
            )
        return [name for name, word in words.items() if word == value]
    invalid = [word for word in words.values() if word.lower() not in (*YES, *NO)]
    if invalid:
        raise ValueError(
            f"reflect={column!r} needs a column of 1 and 0, or a value, {column}={invalid[0]}; "
            f"found {listed(sorted(set(invalid)))}"
        )
    return [name for name, word in words.items() if word.lower() in YES]
