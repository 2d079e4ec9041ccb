"""Scalar fields of the shapes (6.1, 6.2), such as thickness, transferred to the template.

Every vertex of the template takes the value at the point of the shape that it was registered to,
linear inside triangles (:mod:`s4a.analysis.transfer`), so that the fields of all shapes can be
compared vertex by vertex: :mod:`s4a_morphometrics.field_tests`.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.inputs import Sample, Values, all_registered, registration_of, sample_of
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

# what a test calls the effect on displacements, and what on a field
NAMES = {
    "effect": "field_effect",
    "effect_error": "field_error",
    "within_effect": "field_within_effect",
    "intercept": "field_intercept",
    "subject_variance": "field_subject_variance",
    "residual_variance": "field_residual_variance",
}


def with_field(
    study: xr.DataTree,
    name: str,
    values: Fields,
    *,
    unit: str | None = None,
    partial: bool = False,
) -> xr.DataTree:
    """Return the study with a scalar field of every shape, transferred to the template.

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
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> meshes = study["original"].children.items()
    >>> height = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    >>> study = s4a_morphometrics.with_field(study, "height", height, unit="mm")
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
    """Write a field of :func:`with_field` to the folder of its study.

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
    >>> from s4a_morphometrics.fields import with_field, write_field
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
        raise ValueError(f"the study has no field {name!r}; with_field adds one")
    field = study["fields"][name].to_dataset()
    registered = study["registration"].children
    keys = [registered[one].attrs.get("task_key", "") for one in field["shape"].values.tolist()]
    path = Path(folder) / "fields" / f"{name}.nc"
    with lock(folder) as claim:
        write(field, path, task_key(field["transferred_field"].values, *keys), keys, claim)
    return path


class FieldSample(NamedTuple):
    """The shapes of a test that have a field.

    ``sample`` has the field as ``d (s, m, 1)`` and ``area (m,)``, at the vertices ``keep (n,)`` of
    the template where all shapes have it; ``shape (s, n, 3)`` are their displacements, and
    ``shape_area (n,)`` the areas of all vertices.
    """

    sample: Sample
    keep: np.ndarray
    shape: np.ndarray
    shape_area: np.ndarray

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Values ``(..., m)`` at all vertices ``(..., n)``, NaN where not all shapes have some."""
        if self.keep.all():
            return values
        found = np.full((*values.shape[:-1], len(self.keep)), np.nan)
        found[..., self.keep] = values
        return found

    def on_template(self, result: xr.Dataset) -> xr.Dataset:
        """A result at all vertices of the template, its effects as those of a field."""
        found = {}
        for name, values in result.items():
            data = values.values
            if values.dims == ("vertex", "xyz"):
                data = data[:, 0]
            if "vertex" in values.dims:
                data = self.whole(data)
            found[NAMES.get(str(name), str(name))] = data
        of_field = dataset(result.attrs, **found).assign_coords(result.coords)
        return in_unit(of_field, self.sample.unit, of=FIELD_UNIT)


def field_of(study: xr.DataTree, name: str, shapes: Sequence[str]) -> tuple[np.ndarray, str]:
    """A field of ``/fields`` of these shapes ``(s, n)``, NaN where one has none, and its unit.

    Raises
    ------
    ValueError
        When the study has no field of that name; those that it has are named.
    """
    there = list(study["fields"].children) if "fields" in study.children else []
    if name not in there:
        raise ValueError(
            f"the study has no field {name!r}; it has {listed(there) or 'none'}: "
            "s4a_morphometrics.with_field, or s4a fields, adds one"
        )
    values = study["fields"][name].to_dataset()["transferred_field"]
    return values.reindex(shape=list(shapes)).values, str(values.attrs["units"])


def field_sample(
    study: xr.DataTree,
    field: str,
    values: Values,
    what: str,
    covariates: Values | dict[str, Values] | list[str] | None = None,
) -> FieldSample:
    """Return the shapes of a test that have a field, see :func:`s4a.analysis.inputs.sample_of`."""
    names = registration_of(study)["shape"].values.tolist()
    of_field, unit = field_of(study, field, names)
    has = np.where(np.isnan(of_field).all(1), np.nan, 0.0)
    sample = sample_of(study, values, what, covariates, {f"field {field!r}": has})
    known = np.isin(names, sample.registration["shape"].values)
    d, keep = _everywhere(of_field[known], field)
    area = sample.area[keep] / sample.area[keep].sum()
    return FieldSample(sample._replace(d=d, area=area, unit=unit), keep, sample.d, sample.area)


def _everywhere(values, field):
    """A field ``(s, m, 1)`` at the vertices ``(n,)`` where all shapes have it."""
    keep = np.isfinite(values).all(0)
    if not keep.any():
        raise ValueError(f"the field {field!r} has no vertex of the template in all shapes")
    if not keep.all():
        log.warning(
            "the field %r lacks in some shape at %d of %d vertices, which are not tested",
            field,
            (~keep).sum(),
            len(keep),
        )
    values = values[:, keep]
    if np.ptp(values, axis=0).max() <= 1e-12 * abs(values).max():
        raise ValueError(f"the field {field!r} is the same in all shapes: there is nothing to test")
    return values[..., None], keep
