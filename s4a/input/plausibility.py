"""Plausibility (5.1, the data): what looks wrong with a shape beside the others of its collection.

It is named and never changed.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from s4a.input.evidence import COMPACTNESS, ENOUGH, MOMENT, SIZE, excess, in_numbers
from s4a.input.hands import COMMON_HAND, OTHER_HAND, hands

AREA_DROPPED = 0.1
UNITS = {10.0**e: f"10^{e}" for e in (-9, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 9)}
UNITS |= {25.4: "25.4", 1 / 25.4: "1/25.4", 2.54: "2.54", 1 / 2.54: "1/2.54"}  # inches
# of these nobody but the user knows what is meant; an honest outlier is only named
DOUBTFUL = ("mirrored", "unit", "partial", "duplicate", "registration")

# Thresholds, chosen on synthetic brains, cats, faces and ten bodies (docs/plausibility.md)
ODD_SIZE = 1.8  # times the size of the others, or less than one over it
OTHER_SIZE = 3.0  # the same, that no anatomy has
SPREADS = 5.0  # times the usual spread of a size, a boundary or a form: a warning
EXTENT_SPREADS = 7.0  # the same of extents, which poses change
FAR = 8.0  # the same: doubtful
FIT = 0.12  # least spread of the logarithm of the residual
BOUNDARY = 0.12  # least spread of lengths over sqrt(area)
SAME = 1e-4  # largest difference of two files of one scan, of every number below
CROSSING = 0.01  # share of the triangles that pass through others
LATTICE = 0.2  # step of rounded coordinates, of the median edge
MUCH_MORE = 10.0  # times the others' share of crossing triangles, or step
CLOSE = 2.0  # times the usual residual; a part is no mirror image


class Doubt(NamedTuple):
    """What looks wrong with a shape, and whether the shape is doubtful for it.

    Parameters
    ----------
    kind : str
        One word: ``mirrored``, ``unit``, ``size``, ``duplicate``, ``partial``, ``kind``,
        ``spacing``, ``genus``, ``dropped``, ``intersections`` or ``registration``.
    words : str
        What was found, beside what, and what to do.
    doubtful : bool
        Whether it makes the shape doubtful; else it is a warning only.
    """

    kind: str
    words: str
    doubtful: bool


Doubts = dict[str, list[Doubt]]  # name of a shape -> what looks wrong with it


def doubt(kind: str, words: str, doubtful: bool | None = None) -> Doubt:
    """A doubt of a kind; the kind says whether it makes the shape doubtful, unless it is given.

    Examples
    --------
    >>> from s4a.input.plausibility import doubt
    >>> doubt("genus", "genus 1, but 0 in 5 of 6 shapes").doubtful
    False
    """
    return Doubt(kind, words, kind in DOUBTFUL if doubtful is None else bool(doubtful))


def in_words(doubts: list[Doubt]) -> str:
    """The sentences of all doubts about a shape, as they stand in the report's ``warning``."""
    return "; ".join(one.words for one in doubts)


def find_warnings(
    attrs: dict[str, dict[str, Any]], evidence: Mapping[str, xr.Dataset]
) -> tuple[Doubts, list[str]]:
    """What looks wrong with each shape, and, in words, with the collection.

    Parameters
    ----------
    attrs : dict
        Name of every shape that is used -> attributes, as of :func:`s4a.clean`.
    evidence : dict
        Name -> :func:`s4a.input.evidence.compare`; may be empty.

    Returns
    -------
    of_shape : dict of str to list of Doubt
        Every name; an empty list where nothing looks wrong.
    of_all : list of str
    """
    told: Doubts = {name: [] for name in attrs}
    of_all: list[str] = []
    evidence = {name: evidence[name] for name in attrs if name in evidence}
    for name, said in attrs.items():
        if said.get("area_dropped", 0) > AREA_DROPPED:
            words = (
                f"{100 * said['area_dropped']:.0f} % of the area was in dropped components; "
                'components=N or "all" keeps more'
            )
            told[name].append(doubt("dropped", words))
    _compare_sizes(attrs, told, of_all)
    _compare_units(attrs, of_all)
    _compare_genus(attrs, told, of_all)
    if len(evidence) > 1:
        _compare_intersections(evidence, told)
        _compare_duplicates(evidence, told)
        _compare_hands(evidence, told, of_all)
    if len(evidence) >= ENOUGH:
        _compare_boundaries(evidence, told)
        _compare_lattices(evidence, told)
        _compare_forms(evidence, told)
    return told, of_all


def _compare_sizes(attrs, told, of_all):
    size = {n: np.log(said["area"]) / 2 for n, said in attrs.items() if said.get("area", 0) > 0}
    names, values = list(size), np.array(list(size.values()))
    if len(names) < 2:
        return
    group = _two_sizes(values)
    if group.any():
        others = np.median(values[~group])
        of_all.append(
            f"two sizes, {np.exp(abs(others - np.median(values[group]))):.3g} times apart: "
            f"{_listed([n for n, odd in zip(names, group, strict=True) if odd])}, and the others; "
            "no size was changed: scale the files of one of them if their units differ"
        )
    far = np.abs(excess(values, SIZE)) if len(names) >= ENOUGH else np.zeros(len(names))
    for i, name in enumerate(names):
        usual = np.median(values[~group] if len(names) > 2 else np.delete(values, i))
        ratio = np.exp(values[i] - usual)
        off = max(ratio, 1 / ratio)
        if group.any() and not group[i]:
            continue
        if off < OTHER_SIZE and not (off > ODD_SIZE and (far[i] > SPREADS or group[i])):
            continue
        unit = next((text for factor, text in UNITS.items() if _near(ratio, factor)), None)
        guess = f", near {unit}: another unit, such as mm for m?" if unit else ";"
        words = (
            f"{ratio:.3g} times the size of the others{guess}"
            " its size was kept; scale the file if that is wrong"
        )
        told[name].append(doubt("unit" if unit else "size", words, off > OTHER_SIZE or bool(unit)))


def _near(ratio, factor):
    within = 1.4 if max(factor, 1 / factor) > 5 else 1.15  # 2.54 is near what anatomies differ by
    return 1 / within < ratio / factor < within


def _two_sizes(values):
    """Those of the smaller of two groups of sizes far apart, of two shapes or more each, (n,)."""
    order = np.argsort(values, kind="stable")
    step = np.diff(values[order])
    none = np.zeros(len(values), bool)
    if len(values) < 4:
        return none
    cut = 1 + int(np.argmax(step))
    low, high = order[:cut], order[cut:]
    within = max(np.ptp(values[low]), np.ptp(values[high]))
    if min(len(low), len(high)) < 2 or step[cut - 1] < max(np.log(ODD_SIZE), 2 * within):
        return none
    odd = low if (len(low), 0 in low) < (len(high), 0 in high) else high  # the first name stays
    none[odd] = True
    return none


def _compare_units(attrs, of_all):
    for key in ("unit", "coordinate_system"):
        values = {name: said[key] for name, said in attrs.items() if said.get(key)}
        if len(set(values.values())) > 1:
            of_all.append(
                f"the files name different {key.replace('_', ' ')}s, and none was converted "
                f"({_names_by(values)})"
            )


def _compare_genus(attrs, told, of_all):
    genus = {name: said["genus"] for name, said in attrs.items() if "genus" in said}
    count = Counter(genus.values())
    if len(count) < 2:
        return
    of_all.append(f"the shapes differ in genus ({_names_by(genus, 'genus ')})")
    usual, number = count.most_common(1)[0]
    for name, g in genus.items():
        if g != usual and number > len(genus) / 2:
            words = (
                f"genus {g}, but {usual} in {number} of {len(genus)} shapes; "
                "wrap=True closes tunnels"
            )
            told[name].append(doubt("genus", words))


def _compare_intersections(evidence, told):
    for name, share, usual in _much_more("intersecting", CROSSING, evidence):
        words = (
            f"{evidence[name].attrs['self_intersections']} triangles pass through others, "
            f"{100 * share:.1f} % (in the others {100 * usual:.1f} %); "
            "wrap=True makes a surface that does not"
        )
        told[name].append(doubt("intersections", words))


def _compare_lattices(evidence, told):
    for name, step, usual in _much_more("lattice", LATTICE, evidence):
        words = (
            f"its coordinates are rounded, to {step:.2f} of an edge (in the others "
            f"{usual:.2f}); export it with more digits"
        )
        told[name].append(doubt("spacing", words))


def _much_more(attr, least, evidence):
    """Names with more than the least and many times the usual of the others; with both numbers."""
    values = np.array([seen.attrs[attr] for seen in evidence.values()])
    for i, name in enumerate(evidence):
        usual = max(float(np.median(np.delete(values, i))), 0.0)
        if values[i] > max(least, MUCH_MORE * usual):
            yield name, values[i], usual


def _compare_duplicates(evidence, told):
    """Shapes with the same numbers, which no motion, no order of vertices and no format changes.

    A reflection changes the sign of the chirality, which of a symmetric shape is none.
    """
    chirality = [seen.attrs["chirality"] for seen in evidence.values()]
    numbers = np.column_stack([in_numbers(list(evidence.values())), chirality])
    names = list(evidence)
    first: dict[int, int] = {}
    for i, j in sorted(cKDTree(numbers).query_pairs(SAME, p=np.inf)):
        first.setdefault(j, i)
    for j, i in first.items():
        is_symmetric = abs(chirality[i] + chirality[j]) < SAME
        mirrored = " (or its mirror image)" if is_symmetric else ""
        words = (
            f"the same surface as {names[i]}, under two names{mirrored}; leave one of them out, "
            "or it counts twice"
        )
        told[names[j]].append(doubt("duplicate", words))


def _compare_hands(evidence, told, of_all):
    """Those of the rarer hand, where the collection has a hand."""
    names = list(evidence)
    mean = hands(evidence)
    fit, fit_mirrored = (
        np.array([np.nanmedian(seen[which]) for seen in evidence.values()])
        for which in ("fit", "fit_mirrored")
    )
    usual = np.median(np.minimum(fit, fit_mirrored))
    close = (fit_mirrored < CLOSE * usual) | (fit_mirrored < fit / CLOSE)
    other = (mean < -OTHER_HAND) & close
    if np.median(np.abs(mean)) < COMMON_HAND or not other.any():
        return
    minority = [name for name, odd in zip(names, other, strict=True) if odd]
    majority = [name for name, odd in zip(names, other, strict=True) if not odd]
    if len(minority) == len(majority):
        of_all.append(
            f"mirror images of each other, by ICP: {_listed(majority)} and {_listed(minority)}; "
            "kept as they are"
        )
    if len(names) == 2:
        return
    for name in minority:
        seen = evidence[name]
        beside = ~np.isin(seen["reference"].values, minority)
        beside |= not beside.any()
        as_is, reflected = (
            np.nanmedian(seen[which].values[beside]) for which in ("fit", "fit_mirrored")
        )
        words = (
            f"fits as a mirror image (ICP residual beside most others {as_is:.3f} as it is, "
            f"{reflected:.3f} reflected): left for right? It is as its file has it; "
            "reflect= mirrors it"
        )
        told[name].append(doubt("mirrored", words))


def _compare_boundaries(evidence, told):
    length = np.array([seen.attrs["open_boundary"] for seen in evidence.values()])
    for i, (name, more) in enumerate(zip(evidence, excess(length, BOUNDARY), strict=True)):
        if more > SPREADS:
            words = (
                f"its holes are {length[i]:.2g} of sqrt(area) long, of the others "
                f"{np.median(np.delete(length, i)):.2g}: is a part cut off? Complete the scan, "
                "leave it out, or close_holes=True where it only has holes"
            )
            told[name].append(doubt("partial", words))


def _compare_forms(evidence, told):
    """Those unlike the others; where something is told already, that may be the reason."""
    seen = list(evidence.values())
    fit = np.log([max(float(np.nanmedian(one["fit"])), 1e-9) for one in seen])
    _, compactness, *moment = in_numbers(seen).T
    # of extents: poses change them most, so that they need more
    extents = np.abs(excess(np.array(moment).T, MOMENT)).max(1) * SPREADS / EXTENT_SPREADS
    far = {
        "its distance from them after alignment": excess(fit, FIT),
        "its volume for its area": np.abs(excess(compactness, COMPACTNESS)),
        "its extents": extents,
    }
    for i, name in enumerate(evidence):
        if any(one.kind in ("partial", "duplicate") for one in told[name]):
            continue
        odd = {what: values[i] for what, values in far.items() if values[i] > SPREADS}
        if odd:
            most = max(odd, key=lambda what: odd[what])
            words = (
                f"unlike the others: {most} {'are' if most.endswith('s') else 'is'} "
                f"{odd[most]:.0f} times the usual spread away; another kind of shape, stretched, "
                "or a part? Look at it, and leave it out if it does not belong"
            )
            told[name].append(doubt("kind", words, odd[most] > FAR))


def _names_by(values, prefix=""):
    """The shapes of each value: ``m: a; mm: b, c``."""
    groups = {v: [name for name in values if values[name] == v] for v in set(values.values())}
    return "; ".join(f"{prefix}{v}: {_listed(groups[v])}" for v in sorted(groups))


def _listed(names, most=6):
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
