"""Left and right of whole subjects (5.1, the data): all of their structures say it together.

Each structure is held against that of other subjects, as it is and mirrored; what the structures of
a subject say is added up.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

import s4a
from s4a.input.chirality import (
    COMMON_SIDE,
    OTHER_SIDE,
    is_mirrored,
    mean_chirality,
    mirrored_shapes,
    rarer_side,
)
from s4a.input.plausibility import examine
from s4a.input.subjects import listed
from s4a.options import Options
from s4a.schema import dataset
from s4a.study.insert import compare_chirality, descriptors_of, read_new

Looks = Mapping[str, Mapping[str, xr.Dataset]]  # structure -> subject -> comparison


def find_mirrored(
    given: Mapping[str, tuple[dict[str, Any], dict[str, Any]]],
) -> tuple[dict[str, float], list[str], list[str]]:
    """The subjects that ``reflect="auto"`` mirrors, see :func:`mirrored_subjects`.

    Parameters
    ----------
    given : dict of str to tuple
        Of each structure its shapes by subject, and the options of :func:`s4a.read_shapes`.
    """
    looks = {}
    for name, (shapes, cleaning) in given.items():
        original = s4a.read_shapes(shapes, compare=False, **cleaning)["original"]
        meshes = {subject: node.to_dataset() for subject, node in original.children.items()}
        looks[name] = examine(meshes, intersections=False) if len(meshes) > 1 else {}
    return mirrored_subjects(looks)


def find_mirrored_new(
    given: Mapping[str, tuple[xr.DataTree, dict[str, Any]]],
) -> tuple[list[str], list[str]]:
    """The new subjects of the other side than those of a study, and what is reported of them.

    Parameters
    ----------
    given : dict of str to tuple
        Of each structure its study, and the new shapes by subject.
    """
    beside = {}
    for name, (study, shapes) in given.items():
        meshes, _ = read_new(shapes, Options.from_report(study))
        beside[name] = compare_chirality(meshes, descriptors_of(study))
    subjects = sorted({subject for _, looks in beside.values() for subject in looks})
    chosen, told = [], []
    for subject in subjects:
        own = {name: looks for name, looks in beside.items() if subject in looks[1]}
        together = seen_together(
            {name: known | {"": looks[subject]} for name, (known, looks) in own.items()}
        )
        look = together.pop("")
        is_other, line = is_mirrored(subject, look, together)
        told += [line] if line else []
        chosen += [subject] if is_other else []
    return chosen, told


def seen_together(looks: Looks) -> dict[str, xr.Dataset]:
    """Combine the chirality of several structures of each subject.

    Returns
    -------
    dict of str to Dataset
        Subject -> ``chirality(reference)``, for :func:`s4a.input.chirality.mean_chirality`: the sum
        over the n structures that both have, over sqrt(n), as noisy as one.  NaN if they have none.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a_morphometrics.mirrored import seen_together
    >>> a = dataset(chirality=[0.6]).assign_coords(reference=["b"])
    >>> both = seen_together({"left": {"a": a}, "right": {"a": a}})
    >>> both["a"]["chirality"].round(2).values.tolist()
    [0.85]
    """
    subjects = sorted({name for of in looks.values() for name in of})
    beside = [look["reference"].values for of in looks.values() for look in of.values()]
    references = sorted({str(one) for names in beside for one in names})
    table = hand_table(looks, subjects, references)
    known = np.isfinite(table)
    n = known.sum(0)
    whole = np.where(n, np.where(known, table, 0).sum(0) / np.sqrt(np.maximum(n, 1)), np.nan)
    return {
        name: dataset(chirality=row).assign_coords(reference=references)
        for name, row in zip(subjects, whole, strict=True)
    }


def hand_table(looks: Looks, subjects: list[str], references: list[str]) -> np.ndarray:
    """``hand`` of every structure ``(structures, subjects, references)``, NaN where not known."""
    table = np.full((len(looks), len(subjects), len(references)), np.nan)
    for k, of in enumerate(looks.values()):
        for name, look in of.items():
            table[k, subjects.index(name)] = look["chirality"].reindex(reference=references).values
    return table


def mirrored_subjects(looks: Looks) -> tuple[dict[str, float], list[str], list[str]]:
    """The subjects of the rarer side, each as a whole.

    Returns
    -------
    hand : dict of str to float
        Of every subject, as of :func:`s4a.input.chirality.mean_chirality`.
    names : list of str
        Those of the rarer side.
    remarks : list of str
        In words, as of :func:`s4a.input.chirality.mirrored_shapes`; and which subjects have
        structures of both hands, and stay as they are: each subject is named once.
    """
    together = seen_together(looks)
    if len(together) < 2:
        return dict.fromkeys(together, np.nan), *mirrored_shapes(together)
    names, mean = list(together), mean_chirality(together)
    hand = dict(zip(names, mean.tolist(), strict=True))
    table = hand_table(looks, names, names) * np.where(mean < 0, -1, 1)
    known = np.isfinite(table)
    each = np.where(known, table, 0).sum(2) / np.maximum(known.sum(2), 1)  # (structures, subjects)
    both = (each <= -OTHER_SIDE).any(0) & (each >= OTHER_SIDE).any(0)
    if np.median(np.abs(mean)) < COMMON_SIDE or both.all():
        return hand, *rarer_side(hand)
    chosen, told = rarer_side({name: hand[name] for name in np.array(names)[~both]})
    for i in np.flatnonzero(both):
        said = [f"{name} {one:+.2f}" for name, one in zip(looks, each[:, i], strict=True)]
        told.append(
            f"reflect='auto': {names[i]} is of both hands ({listed(said)}) and stayed as it is: "
            "was one of its structures mirrored in its file?"
        )
    return hand, chosen, told
