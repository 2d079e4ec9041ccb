"""New shapes in a finished study (4.2, 6.1), of one structure or of several of each subject.

All others stay as they are.  What is done with one shape is in :mod:`s4a.study.newcomers`.
"""

import logging
from pathlib import Path
from typing import Any

import xarray as xr

from s4a.input.subjects import listed, read_table
from s4a.study.newcomers import insert_shapes
from s4a.study.options import Options
from s4a.study.sources import find_sources
from s4a.study.store import STRUCTURES
from s4a.study.structures import contents_of, is_nested, lacking, parts_of_table, status_of
from s4a.study.tree import nodes_of_structure, of_structure, structure_names

log = logging.getLogger(__name__)


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
        Folder with a file of landmarks for some or all of them, see :func:`s4a.analyse`; like
        `reflect` for shapes of one structure alone.
    reflect : str or list of str, optional
        New shapes to mirror, as ``reflect=`` of :func:`s4a.analyse` did it: their names, with
        commas between them, or ``"auto"``, those of the other hand than the shapes of the study as
        they are in it.  Without it none is mirrored, and `compare` tells those of the other hand.
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
        ``structure_status(shape, structure)``; its ``remarks`` name subjects without a structure,
        and a structure of which no new shape can be used.

    Raises
    ------
    ValueError
        When the study is not finished, no shape can be used, one has the name of the template, or
        `reflect` names none of them; when several structures are given other than above, or
        `landmarks` or `reflect` with them, or a `table` for a study of one.

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
        if landmarks is not None or reflect is not None:
            raise ValueError(
                "landmarks= and reflect= are of shapes of one structure: insert them into "
                "s4a.statistics.of_structure(study, name), or STUDY/structures/NAME; "
                "s4a.with_landmarks gives landmarks to meshes in memory"
            )
        return insert_several(study, given_structures(study, shapes, table), compare, n_jobs)
    if table is not None:
        raise ValueError("table= says of which structure a shape is; this study has one alone")
    return insert_shapes(study, shapes, landmarks, reflect, compare, n_jobs)


def given_structures(
    study: xr.DataTree, shapes: Any, table: Path | str | None
) -> dict[str, dict[str, Any]]:
    """The new shapes of each structure that are given, called as their subjects."""
    names = structure_names(study)
    labels = [Options.from_report(of_structure(study, name)).label for name in names]
    volumes = None not in labels
    nested = isinstance(shapes, dict) and is_nested(shapes)
    given: dict[str, dict[str, Any]] = {}
    if nested and table is None:
        empty = [subject for subject, of in shapes.items() if not of]
        if empty:
            raise ValueError(f"a mesh of a structure needed; {listed(empty)} has none")
        for subject, of in shapes.items():
            for name, mesh in of.items():
                given.setdefault(name, {})[subject] = mesh
    elif table is not None and not nested:
        sources = find_sources(shapes, volumes=volumes)
        parts = parts_of_table(sources, {}, read_table(table, list(sources)), Options())
        for name, part in parts.items():
            given[name] = {subject: source for subject, (source, _) in part.sources.items()}
    elif volumes and len(set(labels)) == len(labels) and _are_files(shapes):
        files = {name: file for name, (file, _) in find_sources(shapes, volumes=True).items()}
        given = dict.fromkeys(names, files)
    else:
        raise ValueError(
            f"the study has several structures ({listed(names)}): {{subject: {{structure: mesh}}}} "
            "needed, or files and table=, with columns 'shape', 'subject' and 'structure'; or "
            "label volumes, where it was made of these"
        )
    unknown = [repr(name) for name in given if name not in names]
    if unknown:
        raise ValueError(f"the study has no structure {listed(unknown)}; it has {listed(names)}")
    for name, new in given.items():
        template = study[f"{STRUCTURES}/{name}/registration"].attrs["template"]
        if template in new:
            raise ValueError(
                f"structure {name}: new shapes need other names than the template, {template!r}; "
                "rename it"
            )
    return given


def _are_files(shapes):
    """Whether shapes are given by their files alone."""
    each = shapes.values() if isinstance(shapes, dict) else shapes
    each = [each] if isinstance(each, str | Path) else each
    return isinstance(shapes, dict | list | str | Path) and all(
        isinstance(one, str | Path) for one in each
    )


def insert_several(
    study: xr.DataTree, given: dict[str, dict[str, Any]], compare: bool, n_jobs: int | None
) -> xr.DataTree:
    """The new shapes of each structure, in the study of that structure.

    A structure of which none can be used is told, and costs the others nothing.
    """
    names = structure_names(study)
    lines = lacking({name: given.get(name, ()) for name in names})
    nodes, status, failed = {}, {}, []
    for name in names:
        shapes = given.get(name, {})
        status[name] = dict.fromkeys(shapes, "excluded")
        if not shapes:
            continue
        try:
            new = insert_shapes(of_structure(study, name), shapes, None, None, compare, n_jobs)
        except ValueError as error:
            failed.append(f"structure {name}: {error}")
            continue
        status[name] = status_of(new)
        nodes |= nodes_of_structure(name, new)
    if not nodes:
        raise ValueError("; ".join(failed))
    remarks = [*(f"{line}: it is inserted without" for line in lines), *failed]
    for line in remarks:
        log.warning("%s", line)
    nodes["/report"] = contents_of(status).assign_attrs(remarks="\n".join(remarks))
    return xr.DataTree.from_dict(nodes)
