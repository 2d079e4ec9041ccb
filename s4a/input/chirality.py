"""Left and right (5.1, the data): which shapes are mirror images of the others, and their mirror.

Each shape was held against several others, as it is and mirrored
(:mod:`s4a.input.plausibility`).  The signs that agree best with all of these pairs are those of the
leading eigenvector of their matrix: no shape is the one that all others are held against.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from s4a.input.subjects import listed

MIRROR = np.array([-1.0, 1.0, 1.0])
COMMON_SIDE, OTHER_SIDE = 0.8, 0.5  # of the mean of `hand` over the references
AUTO = "auto"
MANY = ("they are", "them", "all that are")
YES, NO = ("1", "1.0", "true", "yes"), ("0", "0.0", "false", "no")


def mirror_image(mesh: xr.Dataset) -> xr.Dataset:
    """A mesh with x in place of -x, its triangles turned over so that normals stay outward.

    Its landmarks go with it, and ``reason`` says so.

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
    image = mesh.copy()
    for name in ("position", "landmark_position", "guide_position"):
        if name in mesh:
            image[name] = mesh[name].copy(data=mesh[name].values * MIRROR)
    for name in ("landmark_barycentric", "guide_barycentric"):
        if name in mesh:
            image[name] = mesh[name].copy(data=mesh[name].values[:, ::-1])
    turned = np.ascontiguousarray(mesh["corner_vertex"].values[:, ::-1])
    image["corner_vertex"] = mesh["corner_vertex"].copy(data=turned)
    reasons = [mesh.attrs.get("reason", ""), "mirrored, as reflect= says"]
    reflected = 1 - mesh.attrs.get("reflected", 0)
    return image.assign_attrs(reflected=reflected, reason="; ".join(filter(None, reasons)))


def in_file(mesh: xr.Dataset, X: np.ndarray) -> np.ndarray:
    """Points ``(n, 3)`` on a mesh where its file has them, and the other way round."""
    return X * MIRROR if mesh.attrs.get("reflected") else X


def hands(evidence: Mapping[str, xr.Dataset]) -> np.ndarray:
    """Of which hand each shape is ``(n,)``: positive as most, or as the first where both are equal.

    Parameters
    ----------
    evidence : dict of str to Dataset
        Name -> :func:`s4a.input.plausibility.compare`.

    Returns
    -------
    ndarray
        Mean over the references of ``hand`` times their sign; near zero where both could be.
    """
    names = list(evidence)
    references = next(iter(evidence.values()))["reference"].values.tolist()
    hand = np.array([seen["chirality"].values for seen in evidence.values()])  # (n, references)
    of_all = np.full((len(names), len(names)), np.nan)
    place = [names.index(name) for name in references if name in names]
    of_all[:, place] = hand[:, [name in names for name in references]]
    sign = signs(of_all)
    # of a reference that is none of the shapes: as these see it
    seen_by = np.nan_to_num(hand.T) @ sign
    beside = np.where(seen_by < 0, -1, 1)
    beside[[name in names for name in references]] = sign[place]
    mean = _mean(hand * beside)
    other, this = (mean < 0).sum(), (mean > 0).sum()
    return -mean if (other, mean[0] < 0) > (this, mean[0] > 0) else mean


def signs(likeness: np.ndarray) -> np.ndarray:
    """Signs ``(n,)`` that agree best with how alike pairs are: of the leading eigenvector.

    Parameters
    ----------
    likeness : float ndarray (n, n)
        Positive where two are of one hand, negative where not, NaN where it is not known; what is
        known both ways counts as its mean.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.chirality import signs
    >>> signs(np.array([[np.nan, -2, 1], [-2, np.nan, np.nan], [1, -0.1, np.nan]])).tolist()
    [1, -1, 1]
    """
    known = np.isfinite(likeness)
    whole = np.where(known, likeness, 0)
    both = (whole + whole.T) / np.maximum(known.astype(int) + known.T, 1)
    leading = np.linalg.eigh(both)[1][:, -1]
    sign = np.where(leading < 0, -1, 1)
    return sign * sign[0]


def _mean(hand):
    known = np.isfinite(hand)
    return np.where(known, hand, 0).sum(1) / np.maximum(known.sum(1), 1)


def mirrored_shapes(evidence: Mapping[str, xr.Dataset]) -> tuple[list[str], list[str]]:
    """The shapes that ``reflect="auto"`` mirrors: those of the rarer hand; and what is told.

    Returns
    -------
    names : list of str
        None where shapes are nearly their own mirror image.
    remarks : list of str
        In words: which shapes have too weak an evidence, and stay as they are.
    """
    if len(evidence) < 2:
        return [], ["reflect='auto' needs two shapes or more to hold against each other"]
    return rarer_side(dict(zip(evidence, hands(evidence).tolist(), strict=True)))


def rarer_side(hand: Mapping[str, float]) -> tuple[list[str], list[str]]:
    """Those of the rarer hand, by :func:`hands` of each, and what is told."""
    clear = float(np.median(np.abs(list(hand.values()))))
    if clear < COMMON_SIDE:
        return [], [
            "reflect='auto' mirrored none: the shapes are too like their own mirror images to tell "
            f"(mean hand {clear:.2f}, {COMMON_SIDE} needed); name those to mirror"
        ]
    weak = [name for name, one in hand.items() if abs(one) < OTHER_SIDE]
    they, them, which = ("it is", "it", "it if it is") if len(weak) == 1 else MANY
    remark = (
        f"reflect='auto' cannot tell the hand of {listed(weak, most=20)}, which stayed as {they}: "
        f"look at {them}, and name {which} to be mirrored"
    )
    return [name for name, one in hand.items() if one <= -OTHER_SIDE], [remark] * bool(weak)


def is_mirrored(name: str, look: xr.Dataset, known: Mapping[str, xr.Dataset]) -> tuple[bool, str]:
    """Whether one shape is of the rarer hand beside others, and what is told where it is not known.

    Parameters
    ----------
    name : str
    look : Dataset
        Of :func:`s4a.input.plausibility.compare`.
    known : dict of str to Dataset
        The same of the others.
    """
    *others, own = hands({**known, "": look})
    common = float(np.median(np.abs(others)))
    if common < COMMON_SIDE:
        return False, (
            f"reflect='auto' left {name} as it is: the shapes of the study are too like their own "
            f"mirror images to tell (mean hand {common:.2f}, {COMMON_SIDE} needed)"
        )
    if abs(own) < OTHER_SIDE:
        return False, (
            f"reflect='auto' cannot tell the hand of {name}, which stayed as it is: look at it, "
            "and name it if it is to be mirrored"
        )
    return bool(own <= -OTHER_SIDE), ""


def to_reflect(reflect: str, names: Sequence[str], table: xr.Dataset | None) -> list[str]:
    """The shapes that ``reflect=`` names, but for ``"auto"``.

    Parameters
    ----------
    reflect : str
        ``"COLUMN=VALUE"`` or a column of yes and no (1 and 0) of the table, or names of shapes
        with commas between them.
    names : list of str
        Of all shapes.
    table : Dataset, optional
        ``/subjects``.

    Raises
    ------
    ValueError
        When a name is none of the shapes, a column is not in the table or lacks a value, or no
        shape would be mirrored.

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
            f"reflect={reflect!r} needs a table with the column {column!r}; it has "
            f"{', '.join(columns) or 'none: give table= (--table FILE)'}"
        )
    else:
        chosen = [name.strip() for name in reflect.split(",")]
    unknown = [name for name in chosen if name not in names]
    if unknown:
        raise ValueError(
            f"reflect names {listed(list(map(repr, unknown)))}, none of the shapes "
            f"({listed(list(names), most=8)}), and no column of the table "
            f"({', '.join(columns) or 'there is none'})"
        )
    if not chosen:
        raise ValueError(f"reflect={reflect!r} mirrors none of the {len(names)} shapes")
    return [name for name in names if name in chosen]


def _rows_of(table, column, value):
    """The shapes whose cell in a column is the value, or yes."""
    cells = dict(zip(table["shape"].values.tolist(), table[column].values.tolist(), strict=True))
    words = {name: str(cell).strip() for name, cell in cells.items()}
    missing = [name for name, word in words.items() if word in ("", "nan")]
    if missing:
        raise ValueError(f"reflect: the column {column!r} has no value for {listed(missing)}")
    if value is not None:
        if value not in words.values():
            raise ValueError(
                f"reflect: no shape has {value!r} in the column {column!r}, which has "
                f"{listed(sorted(set(words.values())))}"
            )
        return [name for name, word in words.items() if word == value]
    odd = [word for word in words.values() if word.lower() not in (*YES, *NO)]
    if odd:
        raise ValueError(
            f"reflect={column!r} needs a column of 1 and 0, or a value as {column}={odd[0]}; "
            f"found {listed(sorted(set(odd)))}"
        )
    return [name for name, word in words.items() if word.lower() in YES]
