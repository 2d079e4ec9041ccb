"""Several structures of each subject (5.1, the data): which shape is whose, and one study of each.

A structure, such as the left hippocampus, is a collection of its own: it has a template and
correspondences of its own, in the folder ``structures/<name>`` of the study.  What is said of all
together is in :mod:`s4a.analysis.structures`; scans of one subject lie in one frame.
"""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from s4a.input.files import check_names, slug
from s4a.input.subjects import is_missing, listed, read_table
from s4a.schema import dataset
from s4a.study.options import Options
from s4a.study.sources import Collection, Marked, Sources, find_sources
from s4a.study.store import STAGES, STRUCTURES, write
from s4a.study.tree import open_study

log = logging.getLogger(__name__)

COLUMN, SUBJECT = "structure", "subject"  # of the table


class Part(NamedTuple):
    """What the analysis of one structure is given; its shapes are called as their subjects."""

    sources: Sources
    marked: Marked
    subjects: xr.Dataset | None
    options: Options


def is_nested(shapes: Mapping[str, Any]) -> bool:
    """Whether a dict of shapes is one of subjects, each a dict of structures.

    Examples
    --------
    >>> from s4a.study.structures import is_nested
    >>> is_nested({"a": {"left": "a_left.ply"}}), is_nested({"a": "a.ply"})
    (True, False)
    """
    kinds = {_is_plain_dict(of) for of in shapes.values()}
    if kinds == {True, False}:
        flat = [name for name, of in shapes.items() if not _is_plain_dict(of)]
        raise ValueError(
            "every subject needs a dict of its structures, such as {'left': mesh, 'right': mesh}; "
            f"found a single mesh for {listed(flat)}"
        )
    return kinds == {True}


def _is_plain_dict(value):
    return isinstance(value, Mapping) and not isinstance(value, xr.Dataset)


def has_structures(subjects: xr.Dataset | None) -> bool:
    """Whether a table says of which structure each shape is: several, in a column of that name.

    Raises
    ------
    ValueError
        When it does not say whose they are.
    """
    if subjects is None or COLUMN not in subjects:
        return False
    if len(np.unique(subjects[COLUMN].values)) < 2:
        return False  # a column as any other
    if SUBJECT not in subjects:
        raise ValueError(
            f"{subjects.attrs['path']}: the column {COLUMN!r} names several, and needs a column "
            f"{SUBJECT!r} beside it that says whose each is; or give it another name"
        )
    return True


def parts_of_table(
    sources: Sources, marked: Marked, subjects: xr.Dataset, options: Options
) -> dict[str, Part]:
    """The shapes by structure, as the columns ``structure`` and ``subject`` of a table say."""
    if not {COLUMN, SUBJECT} <= set(subjects):
        raise ValueError(
            f"{subjects.attrs['path']}: columns {COLUMN!r} and {SUBJECT!r} needed beside 'shape'; "
            f"found {listed([str(name) for name in subjects.data_vars]) or 'none'}"
        )
    place: dict[str, dict[str, str]] = {}
    for shape in subjects["shape"].values.tolist():
        cells = [str(subjects[column].sel(shape=shape).item()) for column in (COLUMN, SUBJECT)]
        if any(map(is_missing, cells)):
            raise ValueError(
                f"{subjects.attrs['path']}: every shape needs a {COLUMN} and a {SUBJECT}; "
                f"{shape} has {cells[0] or 'none'!r} and {cells[1] or 'none'!r}"
            )
        structure, subject = map(slug, cells)
        of_structure = place.setdefault(structure, {})
        if subject in of_structure:
            raise ValueError(
                f"{subjects.attrs['path']}: one shape of each structure of a subject needed; "
                f"{subject} has two of {structure}: {of_structure[subject]}, {shape}"
            )
        of_structure[subject] = shape
    parts = {}
    for structure in sorted(place):
        shape_of = dict(sorted(place[structure].items()))
        rows = subjects.sel(shape=list(shape_of.values())).assign_coords(shape=list(shape_of))
        parts[structure] = Part(
            {subject: sources[shape] for subject, shape in shape_of.items()},
            {subject: marked[shape] for subject, shape in shape_of.items() if shape in marked},
            rows,
            options,
        )
    return parts


def parts_of_dict(shapes: Mapping[str, Mapping[str, Any]], options: Options) -> dict[str, Part]:
    """The meshes or files by structure, of a dict of subjects with a dict of structures each.

    Examples
    --------
    >>> import s4a
    >>> from s4a.study.options import Options
    >>> from s4a.study.structures import parts_of_dict
    >>> two = {"left": s4a.synthetic.sphere(9), "right": s4a.synthetic.sphere(12)}
    >>> parts = parts_of_dict({"a": two, "b": two}, Options())
    >>> {name: list(part.sources) for name, part in parts.items()}
    {'left': ['a', 'b'], 'right': ['a', 'b']}
    """
    check_names(shapes)
    names = sorted({str(name) for of in shapes.values() for name in of})
    check_names(names)
    subjects = None if options.table is None else read_table(options.table, sorted(shapes))
    parts = {}
    for name in names:
        meshes = {subject: of[name] for subject, of in shapes.items() if name in of}
        rows = None if subjects is None else subjects.sel(shape=sorted(meshes))
        parts[name] = Part(find_sources(meshes), _no_guides(options), rows, options)
    return parts


def parts_of_labels(
    shapes: Collection, structures: Mapping[str, int | str], options: Options
) -> dict[str, Part]:
    """The same label volumes for every structure, each of other labels."""
    if options.label is not None:
        raise ValueError("structures= says the labels of each structure: leave out label=")
    check_names(structures)
    sources = find_sources(shapes, options.pattern, volumes=True)
    subjects = None if options.table is None else read_table(options.table, list(sources))
    return {
        name: Part(sources, _no_guides(options), subjects, replace(options, label=label))
        for name, label in structures.items()
    }


def _no_guides(options: Options) -> Marked:
    if options.landmarks is not None:
        raise ValueError(
            "landmarks= has a file for each shape, which are named by a table with columns "
            "'structure' and 'subject'; to meshes in memory s4a.with_landmarks gives them"
        )
    if options.feature_names:
        raise ValueError(
            "features= are files beside those of the shapes, which are named by a table with "
            "columns 'structure' and 'subject'; to meshes in memory s4a.with_features gives them"
        )
    return {}


def check_parts(parts: dict[str, Part], options: Options) -> list[str]:
    """What is missing, in words; ValueError where structures cannot be analysed together."""
    if len(parts) < 2:
        raise ValueError(f"several structures needed; found {listed(list(parts)) or 'none'}")
    few = [name for name, part in parts.items() if len(part.sources) < 2]
    if few:
        raise ValueError(
            f"every structure needs at least 2 subjects that have it; {few[0]} has "
            f"{listed(list(parts[few[0]].sources))} alone"
        )
    if options.reflect is not None:
        raise ValueError(
            "reflect= would put mirrored structures into another frame than the others of their "
            "subject, and each has a template of its own: leave it out"
        )
    return [
        f"{line}: it is in the modes of its other structures, and not in what is said of all "
        "together"
        for line in lacking({name: part.sources for name, part in parts.items()})
    ]


def lacking(subjects_of: Mapping[str, Iterable[str]]) -> list[str]:
    """Which subject has none of some structures, in words.

    Examples
    --------
    >>> from s4a.study.structures import lacking
    >>> lacking({"left": ["a", "b"], "right": ["a"]})
    ['b has no right']
    """
    have = {name: set(subjects) for name, subjects in subjects_of.items()}
    missing = {
        subject: [name for name, subjects in have.items() if subject not in subjects]
        for subject in sorted(set().union(*have.values()))
    }
    return [f"{subject} has no {listed(names)}" for subject, names in missing.items() if names]


def check_one_kind(folder: Path | str, several: bool) -> None:
    """ValueError where a folder has a study of one structure and is given several, or reverse."""
    there = Path(folder)
    if several and (there / STAGES[0]).is_dir():
        raise ValueError(f"{folder} has a study of one structure: give another folder for several")
    if not several and (there / STRUCTURES).is_dir():
        raise ValueError(f"{folder} has a study of several structures: give another folder")


def write_contents(folder: Path, names: list[str]) -> None:
    """``structures.nc``: what became of every structure of every subject."""
    status = {name: status_of(open_study(folder / STRUCTURES / name)) for name in names}
    write(contents_of(status), folder / f"{STRUCTURES}.nc")


def status_of(study: xr.DataTree) -> dict[str, str]:
    """What became of every shape of one structure."""
    report = study["report"].to_dataset()
    return dict(zip(report["shape"].values.tolist(), report["status"].values.tolist(), strict=True))


def contents_of(status: Mapping[str, Mapping[str, str]]) -> xr.Dataset:
    """``structure_status(shape, structure)``: what became of every structure of every subject."""
    everyone = sorted({subject for of in status.values() for subject in of})
    table = [[of.get(subject, "missing") for of in status.values()] for subject in everyone]
    data = dataset(structure_status=np.array(table))
    return data.assign_coords(shape=everyone, structure=list(status))
