"""Left and right sides of whole subjects (5.1, the data), from all of their structures together.

Each structure is compared with that of other subjects, as it is and mirrored; the results of all
structures of a subject are added.
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

Comparisons = Mapping[str, Mapping[str, xr.Dataset]]  # structure -> subject -> comparison


def find_mirrored(
    given: Mapping[str, tuple[dict[str, Any], dict[str, Any]]],
) -> tuple[dict[str, float], list[str], list[str]]:
    """Return the subjects that ``reflect="auto"`` mirrors, see :func:`mirrored_subjects`.

    Parameters
    ----------
    given : dict of str to tuple
        For each structure its shapes by subject, and the options of :func:`s4a.read_shapes`.
    """
    comparisons = {}
    for name, (shapes, cleaning) in given.items():
        original = s4a.read_shapes(shapes, compare=False, **cleaning)["original"]
        meshes = {subject: node.to_dataset() for subject, node in original.children.items()}
        comparisons[name] = examine(meshes, intersections=False) if len(meshes) > 1 else {}
    return mirrored_subjects(comparisons)


def find_mirrored_new(
    given: Mapping[str, tuple[xr.DataTree, dict[str, Any]]],
) -> tuple[list[str], list[str]]:
    """Return the new subjects of the other side than those of a study, and remarks.

    Parameters
    ----------
    given : dict of str to tuple
        For each structure its study, and the new shapes by subject.
    """
    compared = {}
    for name, (study, shapes) in given.items():
        meshes, _ = read_new(shapes, Options.from_report(study))
        compared[name] = compare_chirality(meshes, descriptors_of(study))
    subjects = sorted({subject for _, of_new in compared.values() for subject in of_new})
    mirrored, remarks = [], []
    for subject in subjects:
        combined = combine(
            {
                name: of_study | {"": of_new[subject]}
                for name, (of_study, of_new) in compared.items()
                if subject in of_new
            }
        )
        is_other, line = is_mirrored(subject, combined.pop(""), combined)
        remarks += [line] if line else []
        mirrored += [subject] if is_other else []
    return mirrored, remarks


def combine(comparisons: Comparisons) -> dict[str, xr.Dataset]:
    """Combine the chirality of several structures of each subject.

    Returns
    -------
    dict of str to Dataset
        Subject -> ``chirality(reference)``, for :func:`s4a.input.chirality.mean_chirality`: the sum
        over the n common structures, divided by sqrt(n), which keeps the variance of the noise.
        ``fit`` and ``fit_mirrored`` are means.  NaN without common structures.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a_morphometrics.mirrored import combine
    >>> a = dataset(chirality=[0.6]).assign_coords(reference=["b"])
    >>> combined = combine({"left": {"a": a}, "right": {"a": a}})
    >>> combined["a"]["chirality"].round(2).values.tolist()
    [0.85]
    """
    subjects = sorted({name for by_subject in comparisons.values() for name in by_subject})
    references = sorted(
        {
            str(reference)
            for by_subject in comparisons.values()
            for comparison in by_subject.values()
            for reference in comparison["reference"].values
        }
    )
    total = {}
    for key, power in ("chirality", 0.5), ("fit", 1), ("fit_mirrored", 1):
        table = table_of(key, comparisons, subjects, references)
        n = np.isfinite(table).sum(0)
        total[key] = np.where(n, np.nansum(table, axis=0) / np.maximum(n, 1) ** power, np.nan)
    return {
        name: dataset(**{key: rows[i] for key, rows in total.items()}).assign_coords(
            reference=references
        )
        for i, name in enumerate(subjects)
    }


def table_of(
    key: str, comparisons: Comparisons, subjects: list[str], references: list[str]
) -> np.ndarray:
    """Return a variable of every structure ``(structures, subjects, references)``, or NaN."""
    table = np.full((len(comparisons), len(subjects), len(references)), np.nan)
    for k, by_subject in enumerate(comparisons.values()):
        for name, comparison in by_subject.items():
            if key in comparison:
                row = comparison[key].reindex(reference=references)
                table[k, subjects.index(name)] = row.values
    return table


def mirrored_subjects(
    comparisons: Comparisons,
) -> tuple[dict[str, float], list[str], list[str]]:
    """Return the subjects of the rarer side, each with all of its structures.

    Returns
    -------
    chirality : dict of str to float
        Mean chirality of every subject, see :func:`s4a.input.chirality.mean_chirality`.
    names : list of str
        Subjects of the rarer side.
    remarks : list of str
        As from :func:`s4a.input.chirality.mirrored_shapes`; they also name the subjects with
        structures of both sides, which are not mirrored.  Each subject is named once.
    """
    combined = combine(comparisons)
    if len(combined) < 2:
        return dict.fromkeys(combined, np.nan), *mirrored_shapes(combined)
    names, mean = list(combined), mean_chirality(combined)
    chirality = dict(zip(names, mean.tolist(), strict=True))
    table = table_of("chirality", comparisons, names, names) * np.where(mean < 0, -1, 1)
    valid = np.isfinite(table)
    each = np.where(valid, table, 0).sum(2) / np.maximum(valid.sum(2), 1)  # (structures, subjects)
    mixed = (each <= -OTHER_SIDE).any(0) & (each >= OTHER_SIDE).any(0)
    if np.median(np.abs(mean)) < COMMON_SIDE or mixed.all():
        return chirality, *rarer_side(chirality)
    rarer, remarks = rarer_side({name: chirality[name] for name in np.array(names)[~mixed]})
    for i in np.flatnonzero(mixed):
        values = [f"{name} {c:+.2f}" for name, c in zip(comparisons, each[:, i], strict=True)]
        remarks.append(
            f"reflect='auto': {names[i]} has structures of both sides ({listed(values)}) and was "
            "not mirrored: was one of its structures mirrored in its file?"
        )
    return chirality, rarer, remarks
