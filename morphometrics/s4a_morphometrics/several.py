"""Multi-structure studies (5.1, the data): one study per structure, in one folder and one tree.

Each structure, such as the left hippocampus, has its own template and correspondences in the folder
``structures/<name>``.  Its shapes are named after their subjects.  All structures of a subject are
in the frame of its scan, so they are mirrored together.  :mod:`s4a_morphometrics.poses` analyses
all structures jointly.
"""

import json
import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import s4a
from s4a.input.annotations import write_rows
from s4a.input.chirality import AUTO, to_reflect
from s4a.input.collection import remarks_on_files
from s4a.input.coordinates import CoordinateSystem, common
from s4a.input.files import check_names, files_named, find_meshes, slug, systems_of
from s4a.input.landmarks import SUFFIXES
from s4a.input.raw import shown
from s4a.input.subjects import is_missing, listed, read_cells, subjects
from s4a.options import Options, given_options
from s4a.schema import dataset
from s4a_morphometrics.mirrored import find_mirrored, find_mirrored_new

log = logging.getLogger(__name__)

FOLDER = "structures"  # has one study per structure
NOTES = "structures.json"  # names of the structures, remarks and mirrored subjects
COLUMN, SUBJECT = "structure", "subject"  # columns of a table
EXPECTED = (
    "{subject: {structure: mesh}} needed, or files and table=, with columns 'shape', 'subject' and "
    "'structure', or label volumes and structures="
)
Rows = dict[str, dict[str, str]]  # by shape and column


class Part(NamedTuple):
    """Input of the analysis of one structure; its shapes are named after their subjects."""

    shapes: dict[str, Any]  # meshes or files
    landmarks: dict[str, Path]  # files, for shapes that have one
    rows: Rows  # of the table; empty without a table
    label: int | str | None = None  # in label volumes


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
    """Analyse several structures of each subject: one study per structure.

    Parameters
    ----------
    shapes : dict, path or list of paths
        ``{"subject_1": {"left": mesh, "right": mesh}, ...}``, meshes or files, all structures of a
        subject in one frame; or files and a `table`; or label volumes and `structures`.
    structures : dict, optional
        For label volumes with several structures each: the name of every structure and its label
        or labels, ``{"anterior": 1, "posterior": "2,3"}``.
    table : path, optional
        As in :func:`s4a.analyse`; for files, with columns ``structure`` and ``subject``.
    landmarks : path, optional
        A folder with a folder for each structure, with files named after the subjects, such as
        ``marks/left/subject_1.csv``; or, for files with a table, files with the same names.
    reflect : str or list of str, optional
        As in :func:`s4a.analyse`, for subjects.  ``"auto"`` compares all structures of a subject
        together.  All of them are mirrored, which preserves their relative pose.
    store : path, optional
        Folder of the study, with the study of each structure in ``structures/<name>``.  A run that
        was killed resumes at the first missing file.
    options, n_jobs, **others
        As in :func:`s4a.analyse`.

    Returns
    -------
    xarray.DataTree
        A study of each structure in ``/structures/<name>``, see :func:`of_structure`; ``/report``
        with ``structure_status(shape, structure)`` and, with `reflect`, ``reflected(shape)`` and
        ``mean_chirality(shape)``; its ``remarks`` name the subjects that lack a structure.

    Raises
    ------
    ValueError
        As in :func:`s4a.analyse`, with the name of the structure; if there are fewer than two
        structures, fewer than two subjects have one, the coordinate systems of a subject's
        structures cannot be converted to each other, or some structures of a subject are to be
        mirrored and others are not.

    See Also
    --------
    open_structures : opens the folder again.
    s4a_morphometrics.structures : variation in relative pose and in shape.

    Examples
    --------
    >>> from s4a_morphometrics import analyse_structures
    >>> from s4a_morphometrics.synthetic import subjects
    >>> study = analyse_structures(subjects(4, 200), n_coarse=100, k=10, k_init=6, n_pairs=6)
    >>> list(study["structures"]), study["structures/left/registration"].sizes["shape"]
    (['left', 'right'], 4)
    """
    named = {"table": table, "landmarks": landmarks, "reflect": reflect}
    others |= {name: value for name, value in named.items() if value is not None}
    settings = given_options(others, options)
    if settings.label is not None:
        raise ValueError("structures= gives the labels of each structure: leave out label=")
    parts = parts_of(shapes, structures, settings.table, settings.landmarks, settings.pattern)
    remarks = check_parts(parts, marked=settings.landmarks is not None)
    remarks += remarks_on_files(shapes, settings.pattern, volumes=structures is not None)
    check_systems(parts, settings)
    mirrored, chirality = None, None
    if settings.reflect == AUTO:
        cleaning = {
            name: settings.of("cleaning") | {"label": part.label} for name, part in parts.items()
        }
        given = {name: (part.shapes, cleaning[name]) for name, part in parts.items()}
        chirality, mirrored, lines = find_mirrored(given)
        remarks += lines
    elif settings.reflect is not None:
        mirrored = named_subjects(str(settings.reflect), parts)
    for line in remarks:
        log.warning("%s", line)
    with folder_of(store) as folder:
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        notes: dict[str, Any] = {"structures": list(parts), "remarks": remarks}
        notes |= {"mirrored": mirrored, "chirality": chirality}
        write_notes(folder, notes)
        studies = {}
        for name, part in parts.items():
            log.info("structure %s", name)
            files = {"table": None, "landmarks": None, **write_inputs(part, folder / FOLDER, name)}
            files |= {"label": part.label, "reflect": mirrored_in(mirrored, part)}
            target = None if store is None else folder / FOLDER / name
            try:
                changed = settings.changed(files)
                studies[name] = s4a.analyse(
                    part.shapes, options=changed, store=target, n_jobs=n_jobs
                )
            except ValueError as error:
                raise ValueError(f"structure {name}: {error}") from error
        write_notes(folder, notes | {"keys": keys_of(studies)})
    return tree_of(studies, notes)


def write_notes(folder: Path, notes: Mapping[str, Any]) -> None:
    """Write the notes of a multi-structure study to its folder."""
    (folder / f"{NOTES}.tmp").write_text(json.dumps(notes))
    (folder / f"{NOTES}.tmp").replace(folder / NOTES)


def keys_of(studies: Mapping[str, xr.DataTree]) -> dict[str, str]:
    """Return the keys of the latent bases of finished studies, by structure."""
    return {
        name: study["latent"].attrs.get("task_key", "")
        for name, study in studies.items()
        if "latent" in study.children
    }


def check_not_exchanged(studies: Mapping[str, xr.DataTree], keys: Mapping[str, str]) -> None:
    """Raise ValueError if the folder of a structure holds the study of another one."""
    for name, key in keys_of(studies).items():
        held = [other for other, known in keys.items() if known == key]
        if held and name not in held:
            raise ValueError(
                f"the folder {FOLDER}/{name} holds {held[0]}, is named {name}: folders were "
                "exchanged or renamed; give them back their names"
            )


@contextmanager
def folder_of(store: Path | str | None) -> Iterator[Path]:
    """Yield the folder of a multi-structure study; a temporary one for a study in memory."""
    if store is None:
        with TemporaryDirectory() as temporary:
            yield Path(temporary)
        return
    folder = Path(store)
    if any(folder.glob("[!.]*")) and not (folder / NOTES).is_file():
        raise ValueError(
            f"{folder} is not a multi-structure study and is not empty: give a new or an empty "
            "folder"
        )
    yield folder


def write_inputs(part: Part, folder: Path, name: str) -> dict[str, Any]:
    """Write the table and the landmarks of one structure in the form :func:`s4a.analyse` reads."""
    inputs: dict[str, Any] = {}
    if part.rows:
        inputs["table"] = folder / f"{name}.csv"
        head = ["shape", *next(iter(part.rows.values()))]
        write_rows(
            inputs["table"], [head, *([name, *cells.values()] for name, cells in part.rows.items())]
        )
    if part.landmarks:
        inputs["landmarks"] = marks = folder / f"{name}.landmarks"
        shutil.rmtree(marks, ignore_errors=True)
        marks.mkdir(parents=True)
        for subject, file in part.landmarks.items():
            suffix = next(end for end in SUFFIXES if end in file.name.lower())
            start = file.name.lower().rindex(suffix)  # .gz may follow
            shutil.copy(file, marks / f"{subject}{file.name[start:]}")
    return inputs


def mirrored_in(mirrored: Iterable[str] | None, part: Part) -> list[str] | None:
    """Return the subjects to mirror that have this structure, or None if there are none."""
    return [subject for subject in mirrored or () if subject in part.shapes] or None


# ---- shapes by structure and subject


def parts_of(
    shapes: Any,
    structures: Mapping[str, Any] | None,
    table: Path | str | None,
    landmarks: Path | str | None,
    pattern: str | None = None,
) -> dict[str, Part]:
    """Return the input of each structure, see :func:`analyse_structures`.

    Examples
    --------
    >>> from s4a_morphometrics.several import parts_of
    >>> two = {"left": "left.ply", "right": "right.ply"}
    >>> {name: part.shapes for name, part in parts_of({"a": two}, None, None, None).items()}
    {'left': {'a': 'left.ply'}, 'right': {'a': 'right.ply'}}
    """
    if structures is None and isinstance(shapes, dict) and is_nested(shapes):
        check_names(shapes)
        names = sorted({str(name) for meshes in shapes.values() for name in meshes})
        shapes_of = {
            name: {subject: meshes[name] for subject, meshes in shapes.items() if name in meshes}
            for name in names
        }
        labels: Mapping[str, Any] = {}
    elif structures is not None:
        volumes = shapes_by_name(shapes, pattern, volumes=True)
        shapes_of, labels = dict.fromkeys(map(str, structures), volumes), structures
    elif table is not None:
        return parts_of_table(shapes_by_name(shapes, pattern), table, landmarks)
    else:
        raise ValueError(f"several structures of each subject: {EXPECTED}")
    check_names(shapes_of)
    everyone = sorted({subject for meshes in shapes_of.values() for subject in meshes})
    rows = {} if table is None else read_cells(table, everyone)
    folders = {} if landmarks is None else landmark_folders(landmarks, shapes_of)
    return {
        name: Part(
            meshes,
            files_in(folders.get(name), meshes),
            {subject: rows[subject] for subject in meshes} if rows else {},
            labels.get(name),
        )
        for name, meshes in shapes_of.items()
    }


def is_nested(shapes: Mapping[str, Any]) -> bool:
    """Return True for a dict of subjects, each a dict of structures."""
    flat = [str(name) for name, value in shapes.items() if not isinstance(value, dict)]
    empty = [str(name) for name, value in shapes.items() if isinstance(value, dict) and not value]
    if flat and len(flat) < len(shapes):
        raise ValueError(
            "every subject needs a dict of its structures, such as {'left': mesh, 'right': mesh}; "
            f"found a single mesh for {listed(flat)}"
        )
    if empty:
        raise ValueError(f"a mesh of a structure needed; {listed(empty)} has none")
    return not flat


def shapes_by_name(shapes: Any, pattern: str | None, *, volumes: bool = False) -> dict[str, Any]:
    """Return files or shapes by name."""
    if isinstance(shapes, xr.DataTree):
        return {name: node.to_dataset() for name, node in shapes["original"].children.items()}
    if isinstance(shapes, dict):
        return shapes
    return {name: path for path, name in find_meshes(shapes, pattern, volumes=volumes)}


def parts_of_table(
    shapes: dict[str, Any], table: Path | str, landmarks: Path | str | None
) -> dict[str, Part]:
    """Return the input of each structure by the columns ``structure`` and ``subject`` of a table.

    Landmark files are named after the shapes, or after the subjects in a folder per structure.
    """
    rows = read_cells(table, sorted(shapes))
    columns = set().union(*rows.values())
    if not {COLUMN, SUBJECT} <= columns:
        raise ValueError(
            f"{table}: columns {COLUMN!r} and {SUBJECT!r} needed in addition to 'shape'; found "
            f"{listed(sorted(columns)) or 'none'}"
        )
    shape_of: dict[str, dict[str, str]] = {}
    for shape, cells in sorted(rows.items()):
        if is_missing(cells[COLUMN]) or is_missing(cells[SUBJECT]):
            raise ValueError(
                f"{table}: every shape needs a {COLUMN} and a {SUBJECT}; {shape} has "
                f"{cells[COLUMN]!r} and {cells[SUBJECT]!r}"
            )
        structure, subject = slug(cells[COLUMN]), slug(cells[SUBJECT])
        other = shape_of.setdefault(structure, {}).setdefault(subject, shape)
        if other != shape:
            raise ValueError(
                f"{table}: one shape of each structure of a subject needed; {subject} has two of "
                f"{structure}: {other}, {shape}"
            )
    flat: dict[str, Path] = {}
    folders: dict[str, Path] = {}
    if landmarks is not None and any(slug(f.name) in shape_of for f in subfolders(landmarks)):
        folders = landmark_folders(landmarks, shape_of)
    elif landmarks is not None:
        flat = files_named(landmarks, shapes, "landmarks", SUFFIXES)
    parts = {}
    for structure, by_subject in sorted(shape_of.items()):
        by_subject = dict(sorted(by_subject.items()))
        marks = files_in(folders.get(structure), by_subject)
        marks |= {subject: flat[shape] for subject, shape in by_subject.items() if shape in flat}
        meshes = {subject: shapes[shape] for subject, shape in by_subject.items()}
        cells_of = {subject: rows[shape] for subject, shape in by_subject.items()}
        parts[structure] = Part(meshes, marks, cells_of)
    return parts


def landmark_folders(landmarks: Path | str, structures: Iterable[str]) -> dict[str, Path]:
    """Return the folder of landmarks of each structure, inside the folder ``landmarks=``.

    Raises
    ------
    ValueError
        If there is none, or one without a structure of its name.
    """
    names = list(structures)
    folders = {slug(folder.name): folder for folder in subfolders(landmarks)}
    unknown = [repr(folder.name) for name, folder in folders.items() if name not in names]
    if unknown or not folders:
        raise ValueError(
            f"landmarks: a folder for each structure ({listed(names)}) needed, with files named "
            f"after the subjects, such as {shown(landmarks)}/{names[0]}/subject_1.csv; found "
            f"{f'a folder {listed(unknown)}' if unknown else 'none'}"
        )
    return folders


def subfolders(landmarks: Path | str) -> list[Path]:
    """Return the folders inside ``landmarks=``, without hidden ones."""
    folder = Path(landmarks)
    if not folder.is_dir():
        raise ValueError(
            f"landmarks: a folder needed, with one for each structure in it; found {shown(folder)}"
        )
    return sorted(f for f in folder.iterdir() if f.is_dir() and not f.name.startswith("."))


def files_in(folder: Path | None, names: Iterable[str]) -> dict[str, Path]:
    """Return the landmark file of each subject that has one."""
    try:
        files = {} if folder is None else files_named(folder, names, "landmarks", SUFFIXES)
    except ValueError:  # no subject has one; check_parts reports it
        files = {}
    return {name: files[name] for name in names if name in files}


def check_parts(parts: Mapping[str, Part], *, marked: bool, least: int = 2) -> list[str]:
    """Return remarks on missing data; ValueError if the structures cannot be analysed together."""
    if len(parts) < least:
        raise ValueError(f"several structures needed; found {listed(list(parts)) or 'none'}")
    few = [name for name, part in parts.items() if len(part.shapes) < least]
    if few:
        raise ValueError(
            f"every structure needs at least {least} subjects that have it; {few[0]} has "
            f"only {listed(list(parts[few[0]].shapes))}"
        )
    unmarked = [name for name, part in parts.items() if not part.landmarks]
    remarks = lacking({name: part.shapes for name, part in parts.items()})
    if marked and len(unmarked) == len(parts) and least > 1:
        raise ValueError("landmarks: no file is named after one of the subjects")
    if marked and unmarked:
        remarks.append(f"no landmark file for any {listed(unmarked)}: registered without landmarks")
    return remarks


def check_systems(parts: Mapping[str, Part], options: Options) -> None:
    """Raise ValueError if structures of a subject cannot be converted to one coordinate system."""
    given = CoordinateSystem.of(vars(options))
    subject_systems(
        {n: systems_of(part.shapes, given) for n, part in parts.items() if part.label is None}
    )


def subject_systems(
    systems: Mapping[str, Mapping[str, CoordinateSystem]],
) -> dict[str, CoordinateSystem]:
    """Return a coordinate system for all structures of each subject, of the same axes and unit.

    Parameters
    ----------
    systems : dict of str to dict
        By structure and subject.

    Raises
    ------
    ValueError
        See :func:`s4a.input.coordinates.common`.
    """
    by_subject: dict[str, dict[str, CoordinateSystem]] = {}
    for name, of_structure in systems.items():
        for subject, system in of_structure.items():
            by_subject.setdefault(subject, {})[f"{subject} ({name})"] = system
    all_of_them = {name: s for own in by_subject.values() for name, s in own.items()}
    shared = common(all_of_them)
    return {
        subject: replace(common(own, origin=True), axes=shared.axes, unit=shared.unit)
        for subject, own in by_subject.items()
    }


def lacking(subjects_of: Mapping[str, Iterable[str]]) -> list[str]:
    """Return a remark for each subject that lacks a structure.

    Examples
    --------
    >>> from s4a_morphometrics.several import lacking
    >>> lacking({"left": ["a", "b"], "right": ["a"]})
    ['b has no right: it is left out of the joint analysis of all structures']
    """
    having = {name: set(subjects) for name, subjects in subjects_of.items()}
    missing = {
        subject: [name for name, subjects in having.items() if subject not in subjects]
        for subject in sorted(set().union(*having.values()))
    }
    return [
        f"{subject} has no {listed(names)}: it is left out of the joint analysis of all structures"
        for subject, names in missing.items()
        if names
    ]


def named_subjects(reflect: str, parts: Mapping[str, Part]) -> list[str]:
    """Return the subjects that ``reflect=`` names, each with all of its structures.

    Raises
    ------
    ValueError
        As in :func:`s4a.input.chirality.to_reflect`; and if structures of one subject have
        different values in the column: mirroring only some of them would change their relative
        pose.

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
        values = {name: row[column] for name, row in rows.items() if column in row}
        if len(set(values.values())) > 1:
            cells = [f"{cell!r} ({name})" for name, cell in values.items()]
            raise ValueError(
                f"reflect={reflect!r}: all structures of a subject are mirrored together, so that "
                f"their relative pose is kept, and need one value in the column {column!r}; "
                f"{subject} has {listed(cells)}. To pool both sides as one structure, use "
                "s4a.analyse, without the column 'structure'"
            )
        for name, cell in next(iter(rows.values()), {}).items():
            table.setdefault(name, []).append("" if is_missing(cell) else cell)
    return to_reflect(reflect, everyone, subjects(table, everyone) if table else None)


# ---- one tree


def open_structures(folder: Path | str) -> xr.DataTree:
    """Open the folder of a multi-structure study as one tree.

    Parameters
    ----------
    folder : path
        The ``store`` of :func:`analyse_structures`.

    Returns
    -------
    DataTree
        As returned by :func:`analyse_structures`.

    Raises
    ------
    ValueError
        If it is not such a folder, a folder in it is a link, or that of a structure is missing.

    See Also
    --------
    s4a.open_study : opens a study of one structure.
    """
    folder = Path(folder)
    if not (folder / NOTES).is_file():
        raise ValueError(
            f"{folder} is not a multi-structure study: it has no {NOTES}; run "
            f"`s4a run-structures ... --out {folder}`"
        )
    try:
        notes = json.loads((folder / NOTES).read_text())
        check_names(notes["structures"])
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{folder / NOTES} cannot be read, run again: {error}") from error
    studies = {}
    for name in notes["structures"]:
        for path in (folder / FOLDER, folder / FOLDER / name):
            if path.is_symlink():
                raise ValueError(
                    f"{path} is a symbolic link, which is not followed within a study: "
                    "replace it by the folder itself"
                )
        studies[name] = s4a.open_study(folder / FOLDER / name)
    check_not_exchanged(studies, notes.get("keys", {}))
    return tree_of(studies, notes)


def tree_of(studies: Mapping[str, xr.DataTree], notes: Mapping[str, Any]) -> xr.DataTree:
    """Return the studies of all structures, with a joint ``/report``, as one tree."""
    given: dict[str, Iterable[str]] = notes.get("given", {})
    status = {name: dict.fromkeys(given.get(name, ()), "excluded") for name in notes["structures"]}
    for name, study in studies.items():
        status[name] |= study["report"]["status"].to_series().to_dict()
    everyone = sorted({subject for by_subject in status.values() for subject in by_subject})
    table = [[column.get(subject, "missing") for column in status.values()] for subject in everyone]
    report = dataset({"remarks": "\n".join(notes["remarks"])}, structure_status=np.array(table))
    if notes["mirrored"] is not None:
        reflected = [subject in notes["mirrored"] for subject in everyone]
        report = report.merge(dataset(reflected=reflected))
    if notes["chirality"] is not None:
        chirality = [notes["chirality"].get(subject, np.nan) for subject in everyone]
        report = report.merge(dataset(mean_chirality=np.array(chirality, float)))
    report = report.assign_coords(shape=everyone, structure=list(status))
    nodes = {f"/{FOLDER}/{name}": study for name, study in studies.items()}
    return xr.DataTree.from_dict({"/report": report, **nodes})


def structure_names(study: xr.DataTree) -> list[str]:
    """Return the names of the structures; ValueError if the study has none."""
    if FOLDER not in study.children:
        raise ValueError(
            "a multi-structure study needed, as from s4a_morphometrics.analyse_structures; "
            f"this one has {', '.join(study.children) or 'no nodes'}"
        )
    return list(study[FOLDER].children)


def of_structure(study: xr.DataTree, name: str) -> xr.DataTree:
    """Return the study of one structure.

    Parameters
    ----------
    study : DataTree
        From :func:`analyse_structures` or :func:`open_structures`.
    name : str
        Name of the structure.

    Returns
    -------
    DataTree
        As returned by :func:`s4a.analyse`.

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
    coordinate_system: str | None = None,
    unit: str | None = None,
    compare: bool = True,
    n_jobs: int | None = None,
) -> xr.DataTree:
    """Register new subjects to the studies of all structures, which stay unchanged.

    If no new shape of a structure can be used, this is reported and the others are still inserted.

    Parameters
    ----------
    study : DataTree
        From :func:`analyse_structures` or :func:`open_structures`.
    shapes : dict, path or list of paths
        As in :func:`analyse_structures`; label volumes if the study was made from label volumes.
    landmarks, table : path, optional
        As in :func:`analyse_structures`.
    reflect : str or list of str, optional
        New subjects to mirror: names, a column of the table, or ``"auto"`` for those of the other
        side than the subjects of the study; all structures of a subject are mirrored together.
    coordinate_system, unit, compare, n_jobs : see :func:`s4a.insert`

    Returns
    -------
    DataTree
        As returned by :func:`analyse_structures`, with the result of :func:`s4a.insert` for each
        structure.

    Raises
    ------
    ValueError
        If no new shape can be used, or the study has no such structure.

    See Also
    --------
    s4a.insert : the same for one structure.
    s4a_morphometrics.structures_of_new : poses and shapes of the new subjects.

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
    labels = {name: Options.from_report(structure).label for name, structure in studies.items()}
    flat = table is None and not (isinstance(shapes, dict) and is_nested(shapes))
    if flat and (None in labels.values() or isinstance(shapes, dict | xr.DataTree)):
        raise ValueError(f"the study has several structures ({listed(names)}): {EXPECTED}")
    parts = parts_of(shapes, labels if flat else None, table, landmarks)
    unknown = [repr(name) for name in parts if name not in names]
    if unknown:
        raise ValueError(f"the study has no structure {listed(unknown)}; it has {listed(names)}")
    parts = {name: parts.get(name, Part({}, {}, {})) for name in names}
    remarks = check_parts(parts, marked=landmarks is not None, least=0)
    system = {"coordinate_system": coordinate_system, "unit": unit}
    system = {name: value for name, value in system.items() if value is not None}
    check_systems(parts, Options.from_report(studies[names[0]]).changed(system))
    mirrored, lines = None, []
    if reflect == AUTO:
        given = {name: (studies[name], part.shapes) for name, part in parts.items() if part.shapes}
        mirrored, lines = find_mirrored_new(given)
    elif reflect is not None:
        mirrored = named_subjects(str(Options(reflect=reflect).reflect), parts)
    inserted, failed = {}, []
    with TemporaryDirectory() as folder:
        for name, part in parts.items():
            if not part.shapes:
                continue
            inputs = write_inputs(part._replace(rows={}), Path(folder), name)
            inputs |= {"reflect": mirrored_in(mirrored, part), "compare": compare, "n_jobs": n_jobs}
            inputs |= system
            try:
                inserted[name] = s4a.insert(studies[name], part.shapes, **inputs)
            except ValueError as error:
                failed.append(f"structure {name}: {error}")
    if not inserted:
        raise ValueError("; ".join(failed))
    remarks = [*remarks, *failed, *lines]
    for line in remarks:
        log.warning("%s", line)
    given_to = {name: list(part.shapes) for name, part in parts.items()}
    notes = {"structures": names, "remarks": remarks, "mirrored": mirrored, "chirality": None}
    return tree_of(inserted, notes | {"given": given_to})
