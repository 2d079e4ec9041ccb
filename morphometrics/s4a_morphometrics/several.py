"""Several structures of each subject (5.1, the data): a study of each, in one folder and one tree.

A structure, such as the left hippocampus, is a collection of its own: it has a template and
correspondences of its own, in the folder ``structures/<name>``, and its shapes are called as their
subjects.  All structures of a subject lie in the frame of its scan, so they are mirrored together.
What is said of all of them is in :mod:`s4a_morphometrics.poses`.
"""

import csv
import json
import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import s4a
from s4a.input.chirality import AUTO, to_reflect
from s4a.input.collection import remarks_on_files
from s4a.input.files import check_names, files_named, find_meshes, slug
from s4a.input.landmarks import SUFFIXES
from s4a.input.raw import shown
from s4a.input.subjects import is_missing, listed, read_cells, subjects
from s4a.options import Options, given_options
from s4a.schema import dataset
from s4a_morphometrics.mirrored import find_mirrored, find_mirrored_new

log = logging.getLogger(__name__)

FOLDER = "structures"  # of a study of several, with one of each structure
NOTES = "structures.json"  # beside it: their names, and what concerns all of them
COLUMN, SUBJECT = "structure", "subject"  # of a table
HOW = (
    "{subject: {structure: mesh}} needed, or files and table=, with columns 'shape', 'subject' and "
    "'structure', or label volumes and structures="
)
Rows = dict[str, dict[str, str]]  # by shape and column


class Part(NamedTuple):
    """What the analysis of one structure is given; its shapes are called as their subjects."""

    shapes: dict[str, Any]  # meshes or files
    landmarks: dict[str, Path]  # files, of those that have one
    rows: Rows  # of the table; none where there is no table
    label: int | str | None = None  # of label volumes


def analyse_structures(
    shapes: Any,
    *,
    structures: Mapping[str, int | str] | None = None,
    table: Path | str | None = None,
    landmarks: Path | str | None = None,
    reflect: str | list[str] | None = None,
    options: Options | None = None,
    store: Path | str | None = None,
    n_jobs: int | None = None,
    **others: Any,
) -> xr.DataTree:
    """From several structures of each subject to a study of every structure.

    Parameters
    ----------
    shapes : dict, path or list of paths
        ``{"subject_1": {"left": mesh, "right": mesh}, ...}``, whose meshes or files lie where they
        are to each other; or files and a `table`; or label volumes and `structures`.
    structures : dict, optional
        The files are label volumes that each hold several structures: the name of each, and its
        label or labels: ``{"anterior": 1, "posterior": "2,3"}``.
    table : path, optional
        As of :func:`s4a.analyse`; of files with columns ``structure`` and ``subject``.
    landmarks : path, optional
        A folder with one for each structure, with files named as the subjects, such as
        ``marks/left/subject_1.csv``; or, of files with a table, files named as these.
    reflect : str or list of str, optional
        As of :func:`s4a.analyse`, of subjects.  ``"auto"`` takes all structures of a subject
        together.  All of them are mirrored, so that they lie relative to each other as before.
    store : path, optional
        Folder of the study, with one of each structure in ``structures/<name>``.  A run that was
        killed goes on at the first missing file.
    options, n_jobs, **others
        As of :func:`s4a.analyse`.

    Returns
    -------
    xarray.DataTree
        A study of each structure in ``/structures/<name>``, see :func:`of_structure`; ``/report``
        with ``structure_status(shape, structure)`` and, with `reflect`, ``reflected(shape)`` and
        ``mean_chirality(shape)``; its ``remarks`` say which subject lacks a structure.

    Raises
    ------
    ValueError
        As of :func:`s4a.analyse`, with the name of the structure; when there are fewer than two, or
        fewer than two subjects have one; when some structures of a subject are to be mirrored and
        others are not.

    Examples
    --------
    >>> from s4a_morphometrics import analyse_structures
    >>> from s4a_morphometrics.synthetic import subjects
    >>> study = analyse_structures(subjects(4, 200), n_coarse=100, k=10, k_init=6, n_pairs=6)
    >>> list(study["structures"]), study["structures/left/registration"].sizes["shape"]
    (['left', 'right'], 4)
    """
    shown = {"table": table, "landmarks": landmarks, "reflect": reflect}
    given = {name: value for name, value in shown.items() if value is not None}
    settings = given_options(given | others, options)
    if settings.label is not None:
        raise ValueError("structures= gives the labels of each structure: leave out label=")
    parts = parts_of(shapes, structures, settings.table, settings.landmarks, settings.pattern)
    remarks = check_parts(parts, marked=settings.landmarks is not None)
    remarks += remarks_on_files(shapes, settings.pattern, volumes=structures is not None)
    chosen, hand = None, None
    if settings.reflect == AUTO:
        cleaning = {
            name: settings.of("cleaning") | {"label": of.label} for name, of in parts.items()
        }
        hand, chosen, told = find_mirrored({n: (of.shapes, cleaning[n]) for n, of in parts.items()})
        remarks += told
    elif settings.reflect is not None:
        chosen = named_subjects(str(settings.reflect), parts)
    for line in remarks:
        log.warning("%s", line)
    with folder_of(store) as folder:
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        notes = {"structures": list(parts), "remarks": remarks, "mirrored": chosen, "hand": hand}
        (folder / f"{NOTES}.tmp").write_text(json.dumps(notes))
        (folder / f"{NOTES}.tmp").replace(folder / NOTES)
        studies = {}
        for name, part in parts.items():
            log.info("structure %s", name)
            own = {"table": None, "landmarks": None, **given_files(part, folder / FOLDER, name)}
            own |= {"label": part.label, "reflect": mirrored_of(chosen, part)}
            place = None if store is None else folder / FOLDER / name
            try:
                one = settings.changed(own)
                studies[name] = s4a.analyse(part.shapes, options=one, store=place, n_jobs=n_jobs)
            except ValueError as error:
                raise ValueError(f"structure {name}: {error}") from error
    return tree_of(studies, notes)


@contextmanager
def folder_of(store: Path | str | None) -> Iterator[Path]:
    """The folder of a study of several structures; a temporary one where it is in memory."""
    if store is None:
        with TemporaryDirectory() as temporary:
            yield Path(temporary)
        return
    folder = Path(store)
    if any(folder.glob("[!.]*")) and not (folder / NOTES).is_file():
        raise ValueError(
            f"{folder} is no study of several structures and is not empty: give a new or an empty "
            "folder"
        )
    yield folder


def given_files(part: Part, folder: Path, name: str) -> dict[str, Any]:
    """The table and the landmarks of one structure, written as :func:`s4a.analyse` takes them."""
    given: dict[str, Any] = {}
    if part.rows:
        given["table"] = folder / f"{name}.csv"
        with given["table"].open("w", newline="", encoding="utf-8") as table:
            columns = list(next(iter(part.rows.values())))
            lines = csv.writer(table)
            lines.writerow(["shape", *columns])
            lines.writerows([shape, *cells.values()] for shape, cells in part.rows.items())
    if part.landmarks:
        given["landmarks"] = marks = folder / f"{name}.landmarks"
        shutil.rmtree(marks, ignore_errors=True)
        marks.mkdir(parents=True)
        for subject, file in part.landmarks.items():
            suffix = next(end for end in SUFFIXES if end in file.name.lower())
            at = file.name.lower().rindex(suffix)  # .gz may follow
            shutil.copy(file, marks / f"{subject}{file.name[at:]}")
    return given


def mirrored_of(chosen: Iterable[str] | None, part: Part) -> list[str] | None:
    """Those of the subjects to mirror that have this structure; None where there are none."""
    return [subject for subject in chosen or () if subject in part.shapes] or None


# ---- which shape is whose


def parts_of(
    shapes: Any,
    structures: Mapping[str, Any] | None,
    table: Path | str | None,
    landmarks: Path | str | None,
    pattern: str | None = None,
) -> dict[str, Part]:
    """What each structure is given, see :func:`analyse_structures`.

    Examples
    --------
    >>> from s4a_morphometrics.several import parts_of
    >>> two = {"left": "left.ply", "right": "right.ply"}
    >>> {name: of.shapes for name, of in parts_of({"a": two}, None, None, None).items()}
    {'left': {'a': 'left.ply'}, 'right': {'a': 'right.ply'}}
    """
    if structures is None and isinstance(shapes, dict) and is_nested(shapes):
        check_names(shapes)
        names = sorted({str(name) for of in shapes.values() for name in of})
        given = {
            name: {one: of[name] for one, of in shapes.items() if name in of} for name in names
        }
        labels: Mapping[str, Any] = {}
    elif structures is not None:
        volumes = shapes_by_name(shapes, pattern, volumes=True)
        given, labels = dict.fromkeys(map(str, structures), volumes), structures
    elif table is not None:
        return parts_of_table(shapes_by_name(shapes, pattern), table, landmarks)
    else:
        raise ValueError(f"several structures of each subject: {HOW}")
    check_names(given)
    everyone = sorted({subject for of in given.values() for subject in of})
    rows = {} if table is None else read_cells(table, everyone)
    folders = {} if landmarks is None else landmark_folders(landmarks, given)
    return {
        name: Part(
            of,
            files_in(folders.get(name), of),
            {subject: rows[subject] for subject in of} if rows else {},
            labels.get(name),
        )
        for name, of in given.items()
    }


def is_nested(shapes: Mapping[str, Any]) -> bool:
    """Whether a dict of shapes is one of subjects, each a dict of structures."""
    flat = [str(name) for name, of in shapes.items() if not isinstance(of, dict)]
    empty = [str(name) for name, of in shapes.items() if isinstance(of, dict) and not of]
    if flat and len(flat) < len(shapes):
        raise ValueError(
            "every subject needs a dict of its structures, such as {'left': mesh, 'right': mesh}; "
            f"found a single mesh for {listed(flat)}"
        )
    if empty:
        raise ValueError(f"a mesh of a structure needed; {listed(empty)} has none")
    return not flat


def shapes_by_name(shapes: Any, pattern: str | None, *, volumes: bool = False) -> dict[str, Any]:
    """Files that were found, or shapes that were given by name."""
    if isinstance(shapes, xr.DataTree):
        return {name: node.to_dataset() for name, node in shapes["original"].children.items()}
    if isinstance(shapes, dict):
        return shapes
    return {name: path for path, name in find_meshes(shapes, pattern, volumes=volumes)}


def parts_of_table(
    shapes: dict[str, Any], table: Path | str, landmarks: Path | str | None
) -> dict[str, Part]:
    """The shapes by structure, as the columns ``structure`` and ``subject`` of a table say.

    Landmarks are in files named as the shapes, or as the subjects in a folder for each structure.
    """
    rows = read_cells(table, sorted(shapes))
    columns = set().union(*rows.values())
    if not {COLUMN, SUBJECT} <= columns:
        raise ValueError(
            f"{table}: columns {COLUMN!r} and {SUBJECT!r} needed beside 'shape'; found "
            f"{listed(sorted(columns)) or 'none'}"
        )
    place: dict[str, dict[str, str]] = {}
    for shape, cells in sorted(rows.items()):
        if is_missing(cells[COLUMN]) or is_missing(cells[SUBJECT]):
            raise ValueError(
                f"{table}: every shape needs a {COLUMN} and a {SUBJECT}; {shape} has "
                f"{cells[COLUMN]!r} and {cells[SUBJECT]!r}"
            )
        structure, subject = slug(cells[COLUMN]), slug(cells[SUBJECT])
        other = place.setdefault(structure, {}).setdefault(subject, shape)
        if other != shape:
            raise ValueError(
                f"{table}: one shape of each structure of a subject needed; {subject} has two of "
                f"{structure}: {other}, {shape}"
            )
    flat: dict[str, Path] = {}
    folders: dict[str, Path] = {}
    if landmarks is not None and any(slug(f.name) in place for f in inner(landmarks)):
        folders = landmark_folders(landmarks, place)
    elif landmarks is not None:
        flat = files_named(landmarks, shapes, "landmarks", SUFFIXES)
    parts = {}
    for structure, shape_of in sorted(place.items()):
        own = dict(sorted(shape_of.items()))
        marks = files_in(folders.get(structure), own)
        marks |= {subject: flat[shape] for subject, shape in own.items() if shape in flat}
        given = {subject: shapes[shape] for subject, shape in own.items()}
        parts[structure] = Part(given, marks, {one: rows[shape] for one, shape in own.items()})
    return parts


def landmark_folders(landmarks: Path | str, structures: Iterable[str]) -> dict[str, Path]:
    """The folder of landmarks of every structure that has one, below that of ``landmarks=``.

    Raises
    ------
    ValueError
        When there is none for any, or one that is named as no structure.
    """
    names = list(structures)
    found = {slug(folder.name): folder for folder in inner(landmarks)}
    unknown = [repr(folder.name) for name, folder in found.items() if name not in names]
    if unknown or not found:
        raise ValueError(
            f"landmarks: a folder for each structure ({listed(names)}) needed, with files named as "
            f"the subjects, such as {shown(landmarks)}/{names[0]}/subject_1.csv; found "
            f"{f'a folder {listed(unknown)}' if unknown else 'none'}"
        )
    return found


def inner(landmarks: Path | str) -> list[Path]:
    """The folders in that of ``landmarks=``; hidden ones are none."""
    folder = Path(landmarks)
    if not folder.is_dir():
        raise ValueError(
            f"landmarks: a folder needed, with one for each structure in it; found {shown(folder)}"
        )
    return sorted(f for f in folder.iterdir() if f.is_dir() and not f.name.startswith("."))


def files_in(folder: Path | None, names: Iterable[str]) -> dict[str, Path]:
    """The file of landmarks of each of these subjects that has one."""
    try:
        files = {} if folder is None else files_named(folder, names, "landmarks", SUFFIXES)
    except ValueError:  # of none of them, which check_parts tells
        files = {}
    return {name: files[name] for name in names if name in files}


def check_parts(parts: Mapping[str, Part], *, marked: bool, least: int = 2) -> list[str]:
    """What is missing, in words; ValueError where structures cannot be analysed together."""
    if len(parts) < least:
        raise ValueError(f"several structures needed; found {listed(list(parts)) or 'none'}")
    few = [name for name, part in parts.items() if len(part.shapes) < least]
    if few:
        raise ValueError(
            f"every structure needs at least {least} subjects that have it; {few[0]} has "
            f"{listed(list(parts[few[0]].shapes))} alone"
        )
    unmarked = [name for name, part in parts.items() if not part.landmarks]
    remarks = lacking({name: part.shapes for name, part in parts.items()})
    if marked and len(unmarked) == len(parts) and least > 1:
        raise ValueError("landmarks: no file is named as one of the subjects")
    if marked and unmarked:
        remarks.append(f"no file of landmarks for any {listed(unmarked)}: registered without")
    return remarks


def lacking(subjects_of: Mapping[str, Iterable[str]]) -> list[str]:
    """Which subject has none of some structures, in words.

    Examples
    --------
    >>> from s4a_morphometrics.several import lacking
    >>> lacking({"left": ["a", "b"], "right": ["a"]})
    ['b has no right: it is left out of what is said of all structures together']
    """
    have = {name: set(subjects) for name, subjects in subjects_of.items()}
    missing = {
        subject: [name for name, subjects in have.items() if subject not in subjects]
        for subject in sorted(set().union(*have.values()))
    }
    return [
        f"{subject} has no {listed(names)}: it is left out of what is said of all structures "
        "together"
        for subject, names in missing.items()
        if names
    ]


def named_subjects(reflect: str, parts: Mapping[str, Part]) -> list[str]:
    """The subjects that ``reflect=`` names, all structures of each together.

    Raises
    ------
    ValueError
        As of :func:`s4a.input.chirality.to_reflect`; and when structures of one subject have
        different values in the column, as one that is mirrored without the others would no longer
        lie where it lay to them.

    Examples
    --------
    >>> from s4a_morphometrics.several import Part, named_subjects
    >>> femur = Part({"a": "a.ply", "b": "b.ply"}, {}, {"a": {"side": "left"}, "b": {"side": "r"}})
    >>> named_subjects("side=left", {"femur": femur})
    ['a']
    """
    everyone = sorted({subject for part in parts.values() for subject in part.shapes})
    column = reflect.partition("=")[0]
    table: dict[str, list[str]] = {}
    for subject in everyone:
        rows = {name: part.rows[subject] for name, part in parts.items() if subject in part.rows}
        said = {name: row[column] for name, row in rows.items() if column in row}
        if len(set(said.values())) > 1:
            each = [f"{cell!r} ({name})" for name, cell in said.items()]
            raise ValueError(
                f"reflect={reflect!r}: all structures of a subject are mirrored together, so that "
                f"their relative pose is kept, and need one value in the column {column!r}; "
                f"{subject} has {listed(each)}. Structures of both sides as one kind are a study "
                "of one structure: s4a.analyse, without the column 'structure'"
            )
        for name, cell in next(iter(rows.values()), {}).items():
            table.setdefault(name, []).append("" if is_missing(cell) else cell)
    return to_reflect(reflect, everyone, subjects(table, everyone) if table else None)


# ---- one tree


def open_structures(folder: Path | str) -> xr.DataTree:
    """A folder of several structures as one tree, see :func:`analyse_structures`.

    Raises
    ------
    ValueError
        When it is no such folder, a folder in it is a link, or one of a structure is missing.
    """
    folder = Path(folder)
    if not (folder / NOTES).is_file():
        raise ValueError(
            f"{folder} is no study of several structures: it has no {NOTES}; run "
            f"`s4a run-structures ... --out {folder}`"
        )
    try:
        notes = json.loads((folder / NOTES).read_text())
        check_names(notes["structures"])
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{folder / NOTES} cannot be read, run again: {error}") from error
    studies = {}
    for name in notes["structures"]:
        for place in (folder / FOLDER, folder / FOLDER / name):
            if place.is_symlink():
                raise ValueError(
                    f"{place} is a symbolic link, which is not followed within a study: "
                    "put the folder itself in its place"
                )
        studies[name] = s4a.open_study(folder / FOLDER / name)
    return tree_of(studies, notes)


def tree_of(studies: Mapping[str, xr.DataTree], notes: Mapping[str, Any]) -> xr.DataTree:
    """The study of every structure, and ``/report`` of all together, as one tree."""
    given: dict[str, Iterable[str]] = notes.get("given", {})
    status = {name: dict.fromkeys(given.get(name, ()), "excluded") for name in notes["structures"]}
    for name, study in studies.items():
        status[name] |= study["report"]["status"].to_series().to_dict()
    everyone = sorted({subject for of in status.values() for subject in of})
    table = [[of.get(subject, "missing") for of in status.values()] for subject in everyone]
    report = dataset({"remarks": "\n".join(notes["remarks"])}, structure_status=np.array(table))
    if notes["mirrored"] is not None:
        report = report.merge(dataset(reflected=[one in notes["mirrored"] for one in everyone]))
    if notes["hand"] is not None:
        hand = [notes["hand"].get(subject, np.nan) for subject in everyone]
        report = report.merge(dataset(mean_chirality=np.array(hand, float)))
    report = report.assign_coords(shape=everyone, structure=list(status))
    nodes = {f"/{FOLDER}/{name}": study for name, study in studies.items()}
    return xr.DataTree.from_dict({"/report": report, **nodes})


def structure_names(study: xr.DataTree) -> list[str]:
    """The structures of a study of several; ValueError where it has none."""
    if FOLDER not in study.children:
        raise ValueError(
            "a study of several structures needed, as of s4a_morphometrics.analyse_structures; "
            f"this one has {', '.join(study.children) or 'no nodes'}"
        )
    return list(study[FOLDER].children)


def of_structure(study: xr.DataTree, name: str) -> xr.DataTree:
    """The study of one structure, for all that takes a study.

    Examples
    --------
    With a ``study`` of two small structures of six subjects:

    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> study = example_structures()
    >>> s4a_morphometrics.of_structure(study, "left")["pca"].sizes["shape"]
    6
    """
    names = structure_names(study)
    if name not in names:
        raise ValueError(f"the study has no structure {name!r}; it has {listed(names)}")
    return study[FOLDER].children[name].copy()


# ---- new subjects


def insert_structures(
    study: xr.DataTree,
    shapes: Any,
    *,
    landmarks: Path | str | None = None,
    reflect: str | list[str] | None = None,
    table: Path | str | None = None,
    compare: bool = True,
    n_jobs: int | None = None,
) -> xr.DataTree:
    """New subjects in the studies of all structures, which stay as they are.

    A structure of which none can be used is reported, and costs the others nothing.

    Parameters
    ----------
    study : DataTree
        Of :func:`analyse_structures` or :func:`open_structures`.
    shapes : dict, path or list of paths
        As of :func:`analyse_structures`; label volumes where the study was made of these.
    landmarks, table : path, optional
        As there.
    reflect : str or list of str, optional
        New subjects to mirror: names, a column of the table, or ``"auto"``, those of the other side
        than the subjects of the study; all structures of a subject are mirrored together.
    compare, n_jobs : see :func:`s4a.insert`

    Returns
    -------
    DataTree
        As of :func:`analyse_structures`, with what :func:`s4a.insert` gives for each structure.

    Raises
    ------
    ValueError
        When no new shape can be used, or the study has no such structure.

    Examples
    --------
    >>> from s4a_morphometrics import insert_structures
    >>> from s4a_morphometrics.synthetic import example_structures, subjects
    >>> new = {"new": subjects(1, 200, seed=1)["subject_1"]}
    >>> inserted = insert_structures(example_structures(), new)
    >>> inserted["report"]["structure_status"].values.tolist()
    [['ok', 'ok']]
    """
    names = structure_names(study)
    studies = {name: of_structure(study, name) for name in names}
    labels = {name: Options.from_report(one).label for name, one in studies.items()}
    flat = table is None and not (isinstance(shapes, dict) and is_nested(shapes))
    if flat and (None in labels.values() or isinstance(shapes, dict | xr.DataTree)):
        raise ValueError(f"the study has several structures ({listed(names)}): {HOW}")
    parts = parts_of(shapes, labels if flat else None, table, landmarks)
    unknown = [repr(name) for name in parts if name not in names]
    if unknown:
        raise ValueError(f"the study has no structure {listed(unknown)}; it has {listed(names)}")
    parts = {name: parts.get(name, Part({}, {}, {})) for name in names}
    remarks = check_parts(parts, marked=landmarks is not None, least=0)
    chosen, told = None, []
    if reflect == AUTO:
        given = {name: (studies[name], part.shapes) for name, part in parts.items() if part.shapes}
        chosen, told = find_mirrored_new(given)
    elif reflect is not None:
        chosen = named_subjects(str(Options(reflect=reflect).reflect), parts)
    inserted, failed = {}, []
    with TemporaryDirectory() as folder:
        for name, part in parts.items():
            if not part.shapes:
                continue
            own = given_files(part._replace(rows={}), Path(folder), name)
            own |= {"reflect": mirrored_of(chosen, part), "compare": compare, "n_jobs": n_jobs}
            try:
                inserted[name] = s4a.insert(studies[name], part.shapes, **own)
            except ValueError as error:
                failed.append(f"structure {name}: {error}")
    if not inserted:
        raise ValueError("; ".join(failed))
    remarks = [*remarks, *failed, *told]
    for line in remarks:
        log.warning("%s", line)
    given_to = {name: list(part.shapes) for name, part in parts.items()}
    notes = {"structures": names, "remarks": remarks, "mirrored": chosen, "hand": None}
    return tree_of(inserted, notes | {"given": given_to})
