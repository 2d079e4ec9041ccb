"""Decisions (5.1, the data): what only the user can say of a collection, kind by kind, and how.

Whether a mirrored shape is a mistake or a left hand no program knows.  A report says which shapes
are doubtful and why; here the reasons are counted, and each is put beside what to do about it.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import xarray as xr

# kind of a doubt: what to do about it, with the flags of `s4a run`
REMEDIES = {
    "mirrored": "--reflect mirrors them, if left and right are exchanged",
    "unit": "scale the files to the unit of the others",
    "size": "scale the files, if their size is wrong",
    "kind": "take the files away, if of another kind",
    "partial": "scan again, or take the files away",
    "duplicate": "keep one file of each shape",
    "spacing": "export the files with more digits",
    "registration": "look at the page; a larger --n-coarse may help",
    "genus": "--wrap closes tunnels",
    "dropped": "--components all keeps more of them",
    "intersections": "--wrap makes surfaces without",
}
OTHERWISE = "look at the page"


class Decision(NamedTuple):
    """Shapes with a doubt of one kind, and what to do about it."""

    kind: str
    names: list[str]
    remedy: str


def by_kind(kinds: dict[str, str]) -> list[Decision]:
    """One decision for each kind, that of most shapes first.

    Parameters
    ----------
    kinds : dict of str to str
        Name of a shape -> the kinds of its doubts, with blanks between them.

    Examples
    --------
    >>> from s4a.input.decisions import by_kind
    >>> [(one.kind, one.names) for one in by_kind({"a": "unit", "b": "mirrored unit", "c": ""})]
    [('unit', ['a', 'b']), ('mirrored', ['b'])]
    """
    names: dict[str, list[str]] = {}
    for name, words in kinds.items():
        for kind in words.split():
            names.setdefault(kind, []).append(name)
    order = sorted(names, key=lambda kind: -len(names[kind]))
    return [Decision(kind, names[kind], REMEDIES.get(kind, OTHERWISE)) for kind in order]


def decisions(report: xr.Dataset) -> list[Decision]:
    """What is to decide on the doubtful shapes of a report."""
    return by_kind(column(report, "doubtful_kinds"))


def notices(report: xr.Dataset) -> list[Decision]:
    """What else looks wrong with shapes, and makes none of them doubtful."""
    return by_kind(column(report, "warning_kinds"))


def column(report: xr.Dataset, name: str) -> dict[str, str]:
    """A column of text of a report by the names of the shapes; empty where it has none."""
    if name not in report:
        return {}
    return dict(zip(report["shape"].values.tolist(), report[name].values.tolist(), strict=True))


def doubtful_lines(kinds: dict[str, str]) -> list[str]:
    """A line for each kind: how many shapes, which, what to do.

    Examples
    --------
    >>> from s4a.input.decisions import doubtful_lines
    >>> doubtful_lines({"a": "unit", "b": "unit"})
    ['2 unit: a, b (scale the files to the unit of the others)']
    """
    return [
        f"{len(one.names)} {one.kind}: {listed(one.names, 50)} ({one.remedy})"
        for one in by_kind(kinds)
    ]


def listed(names: Sequence[str], room: int, longest: int = 24) -> str:
    """As many names as the room has letters, one at least, and how many more there are.

    Examples
    --------
    >>> from s4a.input.decisions import listed
    >>> listed(["brain_01", "brain_02", "brain_03"], 26)
    'brain_01, brain_02, 1 more'
    """
    names = list(shortened(names, longest))
    text = ", ".join(names)
    shown = len(names)
    while len(text) > room and shown > 1:
        shown -= 1
        text = ", ".join([*names[:shown], f"{len(names) - shown} more"])
    return text


def shortened(texts: Iterable[str], longest: int) -> list[str]:
    """Texts of at most so many letters; of a longer one the middle is left out.

    Examples
    --------
    >>> from s4a.input.decisions import shortened
    >>> shortened(["subject_0001_left_hippocampus", "b"], 15)
    ['subject…ocampus', 'b']
    """
    half = (longest - 1) // 2
    return [t if len(t) <= longest else f"{t[:half]}…{t[-half:]}" for t in texts]
