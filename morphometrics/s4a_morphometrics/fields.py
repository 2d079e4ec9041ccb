"""Scalar fields of the shapes (6.1, 6.2), such as thickness, transferred to the template.

Every vertex of the template takes the value at the point of the shape that it was registered to,
linear inside triangles (:mod:`s4a.analysis.transfer`).  The fields of all shapes can then be
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

# variables of a test of displacements -> variables of a test of a field
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
        Name of the field, such as ``thickness``: letters, digits, _ and -.
    values : dict of str to array_like (vertex,), sequence of these, or path
        A number for each vertex of the file of a shape, or of its mesh in ``/original``; NaN if
        missing.  By shape, or in the order of the study.  Or a folder of files named after the
        shapes (:func:`s4a.input.annotations.read_scalars`).
    unit : str, optional
        Unit of the numbers, such as ``mm``.
    partial : bool
        Allow shapes without the field; tests of the field leave these shapes out.

    Returns
    -------
    DataTree
        With ``/fields/<name>``: ``transferred_field(shape, vertex)`` on the vertices of the
        template; NaN if over half of the weight is on NaN, and for shapes without the field.

    Raises
    ------
    ValueError
        If a shape lacks the field, has another number of vertices, or values that are infinite or
        all missing; the message names the shapes.

    See Also
    --------
    write_field : writes the field to the folder of the study.
    s4a_morphometrics.field_group_test, s4a_morphometrics.field_regression : test it.
    s4a_morphometrics.covariation : covariation of the field with shape.

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
    missing = [shape for shape in shapes if given.get(shape) is None]
    needed = [shape for shape in missing if shape not in left_out(study)]
    if needed and not partial:
        raise ValueError(
            f"the field {name!r} needs values for every shape; it lacks {listed(needed, most=9)}: "
            "give them, or partial=True (--partial) to leave these shapes out of its tests"
        )
    if missing:
        log.warning(
            "left out of tests of the field %r: no values for %s", name, listed(missing, most=9)
        )
    if len(missing) == len(shapes):
        raise ValueError(f"no shape of the study has a field {name!r}; it has {listed(shapes)}")
    fields = np.full((len(shapes), registration.sizes["vertex"]), np.nan)
    for i, shape in enumerate(shapes):
        if shape not in missing:
            mesh = study["original"][shape].to_dataset()
            field = of_vertices(given[shape], mesh, f"the field {name!r} of {shape}")
            fields[i] = on_template(study, shape, field)
    template = registration.attrs.get("template", "")
    result = dataset({"template": template}, transferred_field=fields).assign_coords(shape=shapes)
    result = in_unit(result, unit, of=FIELD_UNIT)
    nodes = {node.path: node.to_dataset(inherit=False) for node in study.subtree}
    return xr.DataTree.from_dict(nodes | {f"/fields/{name}": result}, name=study.name)


def _by_shape(values, shapes, name, study):
    """Return the field of each shape that has one, by name."""
    if isinstance(values, str | Path):
        files = files_named(values, shapes, f"the field {name!r}", SUFFIXES, name)
        return {shape: read_scalars(file, name) for shape, file in files.items()}
    if isinstance(values, dict):
        unknown = sorted(set(map(str, values)) - set(shapes))
        if unknown:
            raise ValueError(
                f"the field {name!r} has values for {listed(unknown)}, which are not shapes of the "
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

    :func:`s4a.open_study` reads it into ``/fields`` as long as the registrations are unchanged.

    Parameters
    ----------
    study : DataTree
        With the field.
    name : str
        Name of the field.
    folder : path
        Folder of the study.

    Returns
    -------
    Path
        ``fields/<name>.nc`` in the folder.

    Raises
    ------
    ValueError
        If the study has no such field, or another run is working on the folder.

    See Also
    --------
    with_field : adds a field to a study.

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
    names = field["shape"].values.tolist()
    keys = [registered[shape].attrs.get("task_key", "") for shape in names]
    made_from = [f"registration/{shape}={key}" for shape, key in zip(names, keys, strict=True)]
    path = Path(folder) / "fields" / f"{name}.nc"
    with lock(folder) as claim:
        key = task_key(field["transferred_field"].values, *keys)
        write(field, path, key, made_from, claim, name=f"fields/{name}")
    return path


class FieldSample(NamedTuple):
    """The data of a test of a field, for the shapes that have it.

    ``sample`` has the field as ``d (s, m, 1)`` and ``area (m,)``, at the vertices ``keep (n,)`` of
    the template where all shapes have it; ``shape (s, n, 3)`` has the displacements, and
    ``shape_area (n,)`` the areas of all vertices.
    """

    sample: Sample
    keep: np.ndarray
    shape: np.ndarray
    shape_area: np.ndarray

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Expand values ``(..., m)`` to all vertices ``(..., n)``, with NaN at untested ones."""
        if self.keep.all():
            return values
        expanded = np.full((*values.shape[:-1], len(self.keep)), np.nan)
        expanded[..., self.keep] = values
        return expanded

    def on_template(self, result: xr.Dataset) -> xr.Dataset:
        """Return a result at all vertices of the template, with the names of a test of a field."""
        variables = {}
        for name, values in result.items():
            data = values.values
            if values.dims == ("vertex", "xyz"):
                data = data[:, 0]
            if "vertex" in values.dims:
                data = self.whole(data)
            variables[NAMES.get(str(name), str(name))] = data
        renamed = dataset(result.attrs, **variables).assign_coords(result.coords)
        return in_unit(renamed, self.sample.unit, of=FIELD_UNIT)


def field_of(study: xr.DataTree, name: str, shapes: Sequence[str]) -> tuple[np.ndarray, str]:
    """Return a field of these shapes ``(s, n)``, NaN for shapes without it, and its unit.

    Raises
    ------
    ValueError
        If the study has no field of that name; the message names its fields.
    """
    available = list(study["fields"].children) if "fields" in study.children else []
    if name not in available:
        raise ValueError(
            f"the study has no field {name!r}; it has {listed(available) or 'none'}: "
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
    """Return the data of a test of a field, see :func:`s4a.analysis.inputs.sample_of`."""
    names = registration_of(study)["shape"].values.tolist()
    fields, unit = field_of(study, field, names)
    has_field = np.where(np.isnan(fields).all(1), np.nan, 0.0)
    sample = sample_of(study, values, what, covariates, {f"field {field!r}": has_field})
    selected = np.isin(names, sample.registration["shape"].values)
    d, keep = _common(fields[selected], field)
    area = sample.area[keep] / sample.area[keep].sum()
    return FieldSample(sample._replace(d=d, area=area, unit=unit), keep, sample.d, sample.area)


def _common(values, field):
    """Return a field ``(s, m, 1)`` at the vertices ``(n,)`` where all shapes have it."""
    keep = np.isfinite(values).all(0)
    if not keep.any():
        raise ValueError(f"the field {field!r} has no vertex of the template in all shapes")
    if not keep.all():
        log.warning(
            "the field %r is missing in some shape at %d of %d vertices, which are not tested",
            field,
            (~keep).sum(),
            len(keep),
        )
    values = values[:, keep]
    if np.ptp(values, axis=0).max() <= 1e-12 * abs(values).max():
        raise ValueError(f"the field {field!r} is the same in all shapes: no variation to test")
    return values[..., None], keep
