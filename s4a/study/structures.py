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
from s4a.input.hands import AUTO, to_reflect
from s4a.input.raw import shown
from s4a.input.subjects import is_missing, listed, read_table
from s4a.input.subjects import subjects as table_of
from s4a.options import Options
from s4a.schema import dataset
from s4a.study.sources import Collection, Marked, Sources, find_guides, find_sources
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
    # who is mirrored, and what is told of that; None where the shapes of this structure say
    chosen: tuple[list[str], list[str]] | None = None


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


def parts_of_table(sources: Sources, subjects: xr.Dataset, options: Options) -> dict[str, Part]:
    """The shapes by structure, as the columns ``structure`` and ``subject`` of a table say.

    Landmarks are in files named as the shapes, or as the subjects in a folder for each structure.
    """
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
    folders = {}
    if options.landmarks is not None and any(slug(f.name) in place for f in inner(options)):
        folders = landmark_folders(options, place)
    flat = None if folders else options.landmarks
    marked = {} if folders else find_guides(sources, flat, options.feature_names)
    parts = {}
    for structure in sorted(place):
        shape_of = dict(sorted(place[structure].items()))
        rows = subjects.sel(shape=list(shape_of.values())).assign_coords(shape=list(shape_of))
        own = {subject: sources[shape] for subject, shape in shape_of.items()}
        guides = {subject: marked[shape] for subject, shape in shape_of.items() if shape in marked}
        if folders:
            guides = find_guides(own, folders.get(structure), options.feature_names)
        parts[structure] = Part(own, guides, rows, options)
    return parts


def parts_of_dict(shapes: Mapping[str, Mapping[str, Any]], options: Options) -> dict[str, Part]:
    """The meshes or files by structure, of a dict of subjects with a dict of structures each.

    Examples
    --------
    >>> import s4a
    >>> from s4a.options import Options
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
    folders = landmark_folders(options, names)
    parts = {}
    for name in names:
        meshes = {subject: of[name] for subject, of in shapes.items() if name in of}
        rows = None if subjects is None else subjects.sel(shape=sorted(meshes))
        sources = find_sources(meshes)
        marked = find_guides(sources, folders.get(name), options.feature_names)
        parts[name] = Part(sources, marked, rows, options)
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
    folders = landmark_folders(options, structures)
    return {
        name: Part(
            sources,
            find_guides(sources, folders.get(name)),
            subjects,
            replace(options, label=label),
        )
        for name, label in structures.items()
    }


def landmark_folders(options: Options, structures: Iterable[str]) -> dict[str, Path]:
    """The folder of landmarks of every structure that has one, below that of ``landmarks=``.

    Raises
    ------
    ValueError
        When there is none for any, or one that is named as no structure.
    """
    if options.landmarks is None:
        return {}
    names = list(structures)
    found = {slug(folder.name): folder for folder in inner(options)}
    unknown = [repr(folder.name) for name, folder in found.items() if name not in names]
    if unknown or not found:
        first = names[0] if names else "left"
        raise ValueError(
            f"landmarks: a folder for each structure ({listed(names)}) needed, with files named as "
            f"the subjects, such as {shown(options.landmarks)}/{first}/subject_1.csv; found "
            f"{f'a folder {listed(unknown)}' if unknown else 'none'}"
        )
    return found


def inner(options: Options) -> list[Path]:
    """The folders in that of ``landmarks=``; hidden ones are none."""
    folder = Path(str(options.landmarks))
    if not folder.is_dir():
        raise ValueError(
            f"landmarks: a folder needed, with one for each structure in it; found {shown(folder)}"
        )
    return sorted(f for f in folder.iterdir() if f.is_dir() and not f.name.startswith("."))


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
    unmarked = [name for name, part in parts.items() if not _has_landmarks(part)]
    told = [
        f"{line}: it is in the modes of its other structures, and not in what is said of all "
        "together"
        for line in lacking({name: part.sources for name, part in parts.items()})
    ]
    if unmarked and options.landmarks is not None:
        told.append(f"no file of landmarks for any {listed(unmarked)}: registered without")
    return told


def _has_landmarks(part):
    return any(guides.landmarks for guides in part.marked.values())


def named_subjects(parts: Mapping[str, Part], options: Options) -> list[str]:
    """The subjects that ``reflect=`` names, but for ``"auto"``."""
    if options.reflect is None or options.reflect == AUTO:
        return []
    subjects_of = {name: list(part.sources) for name, part in parts.items()}
    tables = {name: part.subjects for name, part in parts.items()}
    return to_mirror(str(options.reflect), subjects_of, tables)


def to_mirror(
    reflect: str,
    subjects_of: Mapping[str, Iterable[str]],
    tables: Mapping[str, xr.Dataset | None],
    *,
    beside: bool = False,
) -> list[str]:
    """The subjects that ``reflect=`` names, all structures of each together.

    Parameters
    ----------
    reflect : str
        As of :func:`s4a.input.hands.to_reflect`.
    subjects_of : dict of str to iterable of str
        By structure.
    tables : dict of str to Dataset
        ``/subjects`` of each structure, where there is a table.
    beside : bool
        Whether they come beside others, so that all of them may be mirrored.

    Raises
    ------
    ValueError
        As there; and when structures of one subject have different values in the column, as one
        mirrored without the others would no longer lie where it lay to them.

    Examples
    --------
    >>> from s4a.input.subjects import subjects
    >>> from s4a.study.structures import to_mirror
    >>> table = subjects({"side": ["left", "right"]}, ["a", "b"])
    >>> to_mirror("side=left", {"femur": ["a", "b"]}, {"femur": table})
    ['a']
    """
    everyone = sorted({subject for of in subjects_of.values() for subject in of})
    column = reflect.partition("=")[0]
    there = [table for table in tables.values() if table is not None]
    columns = sorted({str(column) for table in there for column in table.data_vars})
    values: dict[str, Any] = {}
    for subject in everyone if column in columns else ():
        cells = {
            name: table[column].sel(shape=subject).item()
            for name, table in tables.items()
            if table is not None and column in table and subject in table["shape"].values
        }
        if len({str(cell) for cell in cells.values()}) > 1:
            said = [f"{cell!r} ({name})" for name, cell in cells.items()]
            raise ValueError(
                f"reflect={reflect!r}: all structures of a subject are mirrored together, so that "
                f"they lie to each other as before, and need one value in the column {column!r}; "
                f"{subject} has {listed(said)}. Structures of both sides as one kind are a study "
                "of one structure: leave out the column 'structure'"
            )
        if not cells:
            raise ValueError(f"reflect={reflect!r}: {subject} is in no table with that column")
        values[subject] = next(iter(cells.values()))
    # for messages alone
    others = {name: [""] * len(everyone) for name in columns if name != column}
    own = {column: [values[subject] for subject in everyone]} if values else {}
    table = table_of(own | others, everyone) if columns else None
    return to_reflect(reflect, everyone, table, what="subjects", beside=beside)


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
    """``structures.nc``: what became of every structure of every subject, and who is mirrored."""
    studies = {name: open_study(folder / STRUCTURES / name) for name in names}
    status = {name: status_of(study) for name, study in studies.items()}
    write(contents_of(status, mirrored_in(studies.values())), folder / f"{STRUCTURES}.nc")


def status_of(study: xr.DataTree) -> dict[str, str]:
    """What became of every shape of one structure."""
    report = study["report"].to_dataset()
    return dict(zip(report["shape"].values.tolist(), report["status"].values.tolist(), strict=True))


def mirrored_in(studies: Iterable[xr.DataTree]) -> set[str] | None:
    """The subjects that ``reflect=`` mirrored; None where nobody asked for it."""
    reports = [study["report"].to_dataset() for study in studies]
    if not any("reflected" in report for report in reports):
        return None
    return {
        str(name)
        for report in reports
        for name in report["shape"].values[report["reflected"].values.astype(bool)]
    }


def contents_of(
    status: Mapping[str, Mapping[str, str]], mirrored: set[str] | None = None
) -> xr.Dataset:
    """``structure_status(shape, structure)``, and ``reflected(shape)`` where some are mirrored."""
    everyone = sorted({subject for of in status.values() for subject in of})
    table = [[of.get(subject, "missing") for of in status.values()] for subject in everyone]
    data = dataset(structure_status=np.array(table))
    if mirrored is not None:
        data = data.merge(dataset(reflected=[name in mirrored for name in everyone]))
    return data.assign_coords(shape=everyone, structure=list(status))
