"""New shapes in a finished study (4.2, 6.1), of one structure or of several of each subject.

All others stay as they are.  What is done with one shape is in :mod:`s4a.study.newcomers`.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from s4a.input.files import files_named
from s4a.input.hands import AUTO, is_of_other_hand, seen_together
from s4a.input.landmarks import SUFFIXES
from s4a.input.subjects import listed, read_table
from s4a.options import Options
from s4a.study.newcomers import (
    New,
    hands_beside,
    insert_meshes,
    insert_shapes,
    named,
    read_beside,
)
from s4a.study.sources import Sources, find_sources
from s4a.study.store import STRUCTURES
from s4a.study.structures import (
    contents_of,
    is_nested,
    lacking,
    landmark_folders,
    mirrored_in,
    parts_of_table,
    status_of,
    to_mirror,
)
from s4a.study.tree import nodes_of_structure, of_structure, structure_names

log = logging.getLogger(__name__)


class Given(NamedTuple):
    """The new shapes of one structure, called as their subjects."""

    shapes: dict[str, Any]  # meshes or files
    landmarks: dict[str, Path]  # files, of those that have one
    subjects: xr.Dataset | None = None  # their rows of the table


def insert(
    study: xr.DataTree,
    shapes: Path | str | list[Any] | dict[str, Any] | xr.Dataset,
    *,
    landmarks: Path | str | None = None,
    reflect: str | list[str] | None = None,
    table: Path | str | None = None,
    compare: bool = True,
    n_jobs: int | None = None,
) -> xr.DataTree:
    """New shapes placed into a finished study, which stays as it is, with its options.

    Each new shape is remeshed, aligned and mapped to the template and the five shapes of the study
    with the most alike spectra; its latent basis solves eq. 3 with theirs frozen; it is registered
    to the frozen template, and its displacement measured along the frozen modes.  What comes out
    for one shape does not depend on the others given.

    Parameters
    ----------
    study : DataTree
        Of :func:`s4a.analyse` or :func:`s4a.open_study`.
    shapes : path, list of paths, dict or Dataset
        See :func:`s4a.read_shapes`; a single mesh Dataset is named ``new``.  Into a study of
        several structures: ``{subject: {structure: mesh}}``, files with a `table`, or label volumes
        where it was made of these.
    landmarks : path, optional
        Folder with a file of landmarks for some or all of them, see :func:`s4a.analyse`.
    reflect : str or list of str, optional
        New shapes to mirror, as ``reflect=`` of :func:`s4a.analyse` did it: their names, with
        commas between them, or ``"auto"``, those of the other hand than the shapes of the study as
        they are in it.  Without it none is mirrored, and `compare` tells those of the other hand.
        Of several structures names of subjects, or a column of the `table`; all structures of a
        subject are mirrored together.
    table : path, optional
        CSV with columns ``shape``, ``subject`` and ``structure`` and a row for every new shape, as
        of :func:`s4a.analyse`.
    compare : bool
        Whether each new shape is compared with those of the study: unit, handedness, pose, genus,
        as :func:`s4a.read_shapes` does it; what looks wrong is named in ``/report`` and left as it
        is.
    n_jobs : int, optional
        As in joblib; the result does not depend on it.

    Returns
    -------
    DataTree
        As a study of the new shapes alone: ``/original``, ``/coarse``, ``/registration`` to the
        frozen template with ``confidence(shape, vertex)``; in ``/latent`` ``latent_basis(shape,
        mode, latent)``, shape differences and ``distance_to_median(shape)``; in ``/pca``
        ``score(shape, component)`` on the frozen modes, these, and ``reconstruction_error(shape)``;
        ``/report``.  ``/original`` has the template's mesh too, so that labels can be transferred.
        Of several structures that of each below ``/structures``, and ``/report`` with
        ``structure_status(shape, structure)`` and, with `reflect`, ``reflected(shape)``; its
        ``remarks`` name subjects without a structure, and a structure of which no new shape can be
        used.

    Raises
    ------
    ValueError
        When the study is not finished, no shape can be used, one has the name of the template, or
        `reflect` names none of them; when several structures are given other than above, or a
        `table` for a study of one.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> brains = s4a.synthetic.brains(4, 1500)["original"]
    >>> brains = {name: mesh.to_dataset() for name, mesh in brains.children.items()}
    >>> last = brains.pop("brain_04")
    >>> study = s4a.analyse(brains, n_coarse=300, k_init=8, k=12)
    >>> s4a.insert(study, {"brain_04": last})["pca"]["score"].sizes["component"]
    2
    >>> both = [study["pca"], s4a.insert(study, {"brain_04": last})["pca"]]
    >>> names = [str(name) for pca in both for name in pca["shape"].values]
    >>> score = np.concatenate([pca["score"].values for pca in both])
    >>> s4a.show.charts.scores(score, names, highlight=names.index("brain_04"))
    <Figure ...>
    """
    if STRUCTURES in study.children:
        given = given_structures(study, shapes, table, landmarks)
        marked = landmarks is not None
        return insert_several(study, given, reflect, compare, n_jobs, marked=marked)
    if table is not None:
        raise ValueError("table= says of which structure a shape is; this study has one alone")
    return insert_shapes(study, shapes, landmarks, reflect, compare, n_jobs)


def given_structures(
    study: xr.DataTree,
    shapes: Any,
    table: Path | str | None,
    landmarks: Path | str | None = None,
) -> dict[str, Given]:
    """The new shapes of each structure that are given, and their files of landmarks."""
    names = structure_names(study)
    labels = [Options.from_report(of_structure(study, name)).label for name in names]
    volumes = None not in labels
    nested = isinstance(shapes, dict) and is_nested(shapes)
    options = Options(landmarks=landmarks)
    if table is not None and not nested:
        given = given_by_table(find_sources(shapes, volumes=volumes), table, options)
    else:
        of_each = given_by_name(study, shapes, nested=nested and table is None, labels=labels)
        folders = landmark_folders(options, names)
        given = {}
        for name, of in of_each.items():
            folder = folders.get(name)
            try:
                files = {} if folder is None else files_named(folder, of, "landmarks", SUFFIXES)
            except ValueError:  # none of these shapes has any: told with those without a folder
                files = {}
            given[name] = Given(of, {one: files[one] for one in of if one in files})
    unknown = [repr(name) for name in given if name not in names]
    if unknown:
        raise ValueError(f"the study has no structure {listed(unknown)}; it has {listed(names)}")
    for name, one in given.items():
        template = study[f"{STRUCTURES}/{name}/registration"].attrs["template"]
        if template in one.shapes:
            raise ValueError(
                f"structure {name}: new shapes need other names than the template, {template!r}; "
                "rename it"
            )
    return given


def given_by_table(sources: Sources, table: Path | str, options: Options) -> dict[str, Given]:
    """The new shapes of each structure, as the columns ``structure`` and ``subject`` say."""
    given = {}
    for name, part in parts_of_table(sources, read_table(table, list(sources)), options).items():
        files = {
            subject: Path(guides.landmarks[0])
            for subject, guides in part.marked.items()
            if guides.landmarks
        }
        shapes = {subject: source for subject, (source, _) in part.sources.items()}
        given[name] = Given(shapes, files, part.subjects)
    return given


def given_by_name(
    study: xr.DataTree, shapes: Any, *, nested: bool, labels: list[int | str | None]
) -> dict[str, dict[str, Any]]:
    """The new shapes of each structure, of a dict of dicts or of label volumes."""
    names = structure_names(study)
    if nested:
        empty = [subject for subject, of in shapes.items() if not of]
        if empty:
            raise ValueError(f"a mesh of a structure needed; {listed(empty)} has none")
        given: dict[str, dict[str, Any]] = {}
        for subject, of in shapes.items():
            for name, mesh in of.items():
                given.setdefault(name, {})[subject] = mesh
        return given
    if None not in labels and len(set(labels)) == len(labels) and _are_files(shapes):
        files = {name: file for name, (file, _) in find_sources(shapes, volumes=True).items()}
        return dict.fromkeys(names, files)
    raise ValueError(
        f"the study has several structures ({listed(names)}): {{subject: {{structure: mesh}}}} "
        "needed, or files and table=, with columns 'shape', 'subject' and 'structure'; or "
        "label volumes, where it was made of these"
    )


def _are_files(shapes):
    """Whether shapes are given by their files alone."""
    each = shapes.values() if isinstance(shapes, dict) else shapes
    each = [each] if isinstance(each, str | Path) else each
    return isinstance(shapes, dict | list | str | Path) and all(
        isinstance(one, str | Path) for one in each
    )


def insert_several(
    study: xr.DataTree,
    given: dict[str, Given],
    reflect: str | list[str] | None,
    compare: bool,
    n_jobs: int | None,
    *,
    marked: bool = False,
) -> xr.DataTree:
    """The new shapes of each structure, in the study of that structure.

    A structure of which none can be used is told, and costs the others nothing; so are, where some
    are to be `marked`, those without any file of landmarks.
    """
    names = structure_names(study)
    have = {name: given[name].shapes if name in given else {} for name in names}
    lines = lacking(have)
    unmarked = [name for name, of in given.items() if not of.landmarks]
    remarks = [f"{line}: it is inserted without" for line in lines]
    if marked and unmarked:
        remarks.append(f"no file of landmarks for any {listed(unmarked)}: inserted without")
    mirrored = None if reflect is None else named_new(reflect, given)
    status: dict[str, dict[str, str]] = {}
    read: dict[str, New] = {}
    failed = []
    for name in names:
        of = given.get(name, Given({}, {}))
        status[name] = dict.fromkeys(of.shapes, "excluded")
        if of.shapes:
            try:
                read[name] = read_beside(
                    of_structure(study, name),
                    of.shapes,
                    of.landmarks,
                    seen=compare or reflect == AUTO,
                )
            except ValueError as error:
                failed.append(f"structure {name}: {error}")
    told: list[str] = []
    if reflect == AUTO:
        mirrored, told = of_other_hand_beside(read)
    inserted = {}
    for name, new in read.items():
        part = of_structure(study, name)
        try:
            inserted[name] = insert_meshes(part, new, mirrored, told, compare, n_jobs)
        except ValueError as error:
            failed.append(f"structure {name}: {error}")
            continue
        status[name] = status_of(inserted[name])
    if not inserted:
        raise ValueError("; ".join(failed))
    for line in [*remarks, *failed, *told]:
        log.warning("%s", line)
    nodes = {}
    for name, part in inserted.items():
        nodes |= nodes_of_structure(name, part)
    report = contents_of(status, mirrored_in(inserted.values()))
    nodes["/report"] = report.assign_attrs(remarks="\n".join([*remarks, *failed, *told]))
    return xr.DataTree.from_dict(nodes)


def named_new(reflect: str | list[str], given: Mapping[str, Given]) -> list[str]:
    """The new subjects that ``reflect=`` names, but for ``"auto"``."""
    if reflect == AUTO:
        return []
    return to_mirror(
        ",".join(named(reflect)),
        {name: of.shapes for name, of in given.items()},
        {name: of.subjects for name, of in given.items()},
        beside=True,
    )


def of_other_hand_beside(read: Mapping[str, New]) -> tuple[list[str], list[str]]:
    """The new subjects of the other hand than those of the study, and what is told of them.

    All structures of a subject say so together, see :func:`s4a.input.hands.seen_together`.
    """
    beside = {name: hands_beside(new) for name, new in read.items()}
    subjects = sorted({subject for _, looks in beside.values() for subject in looks})
    chosen, told = [], []
    for subject in subjects:
        own = {name: looks for name, looks in beside.items() if subject in looks[1]}
        together = seen_together(
            {name: known | {"": looks[subject]} for name, (known, looks) in own.items()}
        )
        look = together.pop("")
        is_other, line = is_of_other_hand(subject, look, together)
        told += [line] if line else []
        chosen += [subject] if is_other else []
    return chosen, told
