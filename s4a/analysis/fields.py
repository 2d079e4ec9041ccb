"""Scalar fields of the shapes (6.1, 6.2), such as thickness: carried to the template, and kept.

Every vertex of the template takes the value at the place of the shape that it was registered to,
linear inside triangles (:mod:`s4a.analysis.transfer`), so that the fields of all shapes can be
compared vertex by vertex.  Tests take a field by its name: ``field=`` of
:mod:`s4a.analysis.effects`.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.analysis.inputs import all_registered
from s4a.analysis.transfer import on_template
from s4a.input.annotations import SUFFIXES, of_vertices, read_scalars
from s4a.input.files import files_named, slug
from s4a.input.subjects import listed
from s4a.schema import FIELD_UNIT, dataset, in_unit
from s4a.study.store import lock, task_key, write
from s4a.study.tree import left_out

log = logging.getLogger(__name__)

# One array for each shape, by name or in the order of the study; or a folder of files.
Fields = dict[str, Any] | Sequence[Any] | np.ndarray | Path | str


def with_field(
    study: xr.DataTree,
    name: str,
    values: Fields,
    *,
    unit: str | None = None,
    partial: bool = False,
) -> xr.DataTree:
    """A study with a scalar field of every shape, carried to the template.

    Parameters
    ----------
    study : DataTree
        Registered, with ``/original``.
    name : str
        Of the field, such as ``thickness``: letters, digits, _ and -.
    values : dict of str to array_like (vertex,), sequence of these, or path
        A number for each vertex of the file of a shape, or of its mesh in ``/original``; NaN where
        there is none.  By shape, or in the order of the study.  Or a folder of files named as the
        shapes (:func:`s4a.input.annotations.read_scalars`).
    unit : str, optional
        Of the numbers, such as ``mm``.
    partial : bool
        Whether shapes may lack the field; tests of it leave them out.

    Returns
    -------
    DataTree
        With ``/fields/<name>``: ``transferred_field(shape, vertex)`` on the vertices of the
        template, NaN where over half of the weight is on NaN, and for shapes without the field.

    Raises
    ------
    ValueError
        When a shape lacks the field, has another number of vertices, or numbers that are infinite
        or all missing; shapes are named.

    Examples
    --------
    With the ``study`` of six small brains; the height of every vertex:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a.with_field(study, "height", height, unit="mm")
    >>> study["fields/height/transferred_field"].sizes["shape"]
    6
    """
    if slug(name) != name:
        raise ValueError(
            f"a field needs a name of letters, digits, _ and -; found {name!r}, give {slug(name)!r}"
        )
    registration = all_registered(study)
    shapes = registration["shape"].values.tolist()
    given = _by_shape(values, shapes, name, study)
    missing = [one for one in shapes if given.get(one) is None]
    needed = [one for one in missing if one not in left_out(study)]
    if needed and not partial:
        raise ValueError(
            f"the field {name!r} needs values for every shape; it lacks {listed(needed, most=9)}: "
            "give them, or partial=True (--partial) to leave these shapes out of its tests"
        )
    if missing:
        log.warning("no field %r, and left out of its tests: %s", name, listed(missing, most=9))
    if len(missing) == len(shapes):
        raise ValueError(f"no shape of the study has a field {name!r}; it has {listed(shapes)}")
    carried = np.full((len(shapes), registration.sizes["vertex"]), np.nan)
    for i, one in enumerate(shapes):
        if one not in missing:
            mesh = study["original"][one].to_dataset()
            field = of_vertices(given[one], mesh, f"the field {name!r} of {one}")
            carried[i] = on_template(study, one, field)
    template = registration.attrs.get("template", "")
    of_all = dataset({"template": template}, transferred_field=carried).assign_coords(shape=shapes)
    of_all = in_unit(of_all, unit, of=FIELD_UNIT)
    nodes = {node.path: node.to_dataset(inherit=False) for node in study.subtree}
    return xr.DataTree.from_dict(nodes | {f"/fields/{name}": of_all}, name=study.name)


def _by_shape(values, shapes, name, study):
    """The field of each shape that has one, by name."""
    if isinstance(values, str | Path):
        files = files_named(values, shapes, f"the field {name!r}", SUFFIXES, name)
        return {one: read_scalars(file, name) for one, file in files.items()}
    if isinstance(values, dict):
        unknown = sorted(set(map(str, values)) - set(shapes))
        if unknown:
            raise ValueError(
                f"the field {name!r} has values for {listed(unknown)}, which are no shapes of the "
                f"study; it has {listed(shapes)}"
            )
        return values
    if len(values) != len(shapes):
        raise ValueError(
            f"the field {name!r} needs one array for each of {len(shapes)} shapes, found "
            f"{len(values)}; or give a dict of shape to array"
        )
    return dict(zip(shapes, values, strict=True))


def write_field(study: xr.DataTree, name: str, folder: Path | str) -> Path:
    """Keep a field of :func:`with_field` in the folder of its study.

    :func:`s4a.open_study` has it in ``/fields`` as long as the registrations are those that it was
    carried along.

    Parameters
    ----------
    study : DataTree
    name : str
    folder : path
        Of the study.

    Returns
    -------
    Path
        ``fields/<name>.nc`` in the folder.

    Raises
    ------
    ValueError
        When the study has no such field, or another run is working on the folder.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.analysis.fields import with_field, write_field
    >>> store = tempfile.mkdtemp()
    >>> study = s4a.analyse(
    ...     s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3, store=store
    ... )
    >>> study = with_field(study, "noise", list(np.random.default_rng(0).normal(size=(3, 200))))
    >>> _ = write_field(study, "noise", store)
    >>> s4a.open_study(store)["fields/noise/transferred_field"].shape
    (3, 200)
    """
    if "fields" not in study.children or name not in study["fields"].children:
        raise ValueError(f"the study has no field {name!r}; with_field carries one")
    field = study["fields"][name].to_dataset()
    registered = study["registration"].children
    keys = [registered[one].attrs.get("task_key", "") for one in field["shape"].values.tolist()]
    path = Path(folder) / "fields" / f"{name}.nc"
    with lock(folder) as claim:
        write(field, path, task_key(field["transferred_field"].values, *keys), keys, claim)
    return path
