"""Studies of a part of the variation (6.1): a region, nuisance regressed out, size restored.

Each function takes a study and returns a new one with its own modes, for all tests, measures, pages
and panels.  The original study stays unchanged.  The alignment is that of the whole shapes.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from s4a.analysis.inputs import (
    Values,
    columns_of,
    covariates_of,
    displacements_of,
    lacks_value,
    registration_of,
)
from s4a.analysis.permutation import standardize
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.columns import check_column
from s4a.input.subjects import listed
from s4a.method.pca import gram, pca
from s4a.schema import variable

LEAST = 12  # smallest number of vertices of a region


def within(
    study: xr.DataTree,
    region: np.ndarray | xr.DataArray | int | str | Sequence[bool | int | str] | None = None,
    *,
    labels: np.ndarray | None = None,
    min_confidence: float = 0.0,
) -> xr.DataTree:
    """Return the study of a region of the template.

    Parameters
    ----------
    study : DataTree
    region : bool array (vertex,), int, str or list of these, optional
        Vertices of the template: a mask, a label or several labels.  All by default.
    labels : ndarray (vertex,), optional
        Labels of the template's vertices; by default ``label`` of ``/original/<template>``.
    min_confidence : float
        Leave out vertices whose mean ``confidence`` over the shapes is lower, 0 to 1.

    Returns
    -------
    DataTree
        ``/registration`` with these vertices and the triangles among them, ``/pca`` of their
        displacements, ``/subjects`` and ``/report``; ``template_vertex`` of ``/registration`` has
        the vertex of the template for each vertex.

    Raises
    ------
    ValueError
        If the mask has another length, the template has no such label, or too few vertices or
        triangles are left.

    See Also
    --------
    s4a_morphometrics.Region : selects a region on the surface.
    without, with_size : other restrictions of a study.

    Examples
    --------
    With the ``study`` of six small brains; the right half:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> right = study["registration"]["position"].values[:, 0] > 0
    >>> half = s4a_morphometrics.within(study, right)
    >>> half["registration"].sizes["vertex"] == right.sum()
    np.True_
    """
    registration = registration_of(study)
    keep = _mask_of(study, registration, region, labels)
    if min_confidence:
        keep = keep & (registration["confidence"].mean("shape").values >= min_confidence)
    triangles = registration["corner_vertex"].values
    inside = keep[triangles].all(axis=1)
    keep = np.isin(np.arange(len(keep)), triangles[inside])  # vertices of triangles in the region
    if keep.sum() < LEAST:
        raise ValueError(
            f"a region needs at least {LEAST} vertices with triangles among them, found "
            f"{keep.sum()} of {len(keep)}"
        )
    number = np.cumsum(keep) - 1
    part = registration.drop_vars(
        [str(name) for name, values in registration.items() if "triangle" in values.dims]
    ).isel(vertex=keep)
    part["corner_vertex"] = variable("corner_vertex", number[triangles[inside]])
    part["template_vertex"] = variable("template_vertex", template_vertices(registration)[keep])
    part["vertex_area"] = variable("vertex_area", vertex_areas(*as_arrays(part)))
    return _study(study, part, np.flatnonzero(keep))


def template_vertices(registration: xr.Dataset) -> np.ndarray:
    """Return the vertex of the template for each vertex of a registration ``(n,)``."""
    if "template_vertex" in registration:  # a region
        return np.asarray(registration["template_vertex"].values)
    return np.arange(registration.sizes["vertex"])


def _mask_of(study, registration, region, labels):
    """Return the vertices of a region as a mask."""
    n = registration.sizes["vertex"]
    if region is None:
        return np.ones(n, bool)
    wanted = np.atleast_1d(np.asarray(region))
    if wanted.dtype == bool:
        if wanted.shape != (n,):
            raise ValueError(
                f"a region needs one value for each of the template's {n} vertices, found "
                f"{wanted.shape}"
            )
        return wanted
    label = _labels_of(study, registration, labels)
    present = set(label.tolist())
    lacking = [str(value) for value in wanted.tolist() if value not in present]
    if lacking:
        raise ValueError(
            f"no vertex of the template has the label {listed(lacking)}; it has "
            f"{listed(list(map(str, np.unique(label).tolist())), most=20)}"
        )
    return np.isin(label, wanted)


def _labels_of(study, registration, given):
    """Return a label for every vertex of a registration, given or of the template."""
    template = registration.attrs.get("template", "")
    meshes = study["original"].children if "original" in study.children else {}
    if given is None:
        if template not in meshes or "label" not in meshes[template]:
            raise ValueError(
                f"the template {template!r} has no labels; give them as labels= (--labels FILE), "
                "or the region as a mask"
            )
        return meshes[template]["label"].values
    n = registration.sizes["vertex"]
    if np.shape(given) != (n,):
        raise ValueError(
            f"labels need one value for each of the template's {n} vertices, found "
            f"{np.shape(given)}"
        )
    return np.asarray(given)


def without(study: xr.DataTree, nuisance: Values | dict[str, Values] | list[str]) -> xr.DataTree:
    """Remove the variation along the regression on a nuisance, such as the opening of a jaw.

    With B the slopes of the displacements on the nuisance (least squares), the projection on B is
    subtracted from every displacement.  The residual displacements have no slope on the nuisance,
    and their modes are orthogonal to B under the vertex areas.  Other variation along B is removed
    as well; to adjust only a test for a variable, pass it as ``covariates``.

    Parameters
    ----------
    study : DataTree
    nuisance : as ``covariates`` of :func:`s4a.statistics.group_test`

    Returns
    -------
    DataTree
        ``/registration`` with the residuals as ``displacement``, ``/pca``, ``/subjects`` and
        ``/report``.

    Raises
    ------
    ValueError
        If a shape has no value, or the nuisance is constant.

    See Also
    --------
    within, with_size : other restrictions of a study.

    Examples
    --------
    With the ``study`` of six small brains; without the variation along the first mode:

    >>> import numpy as np
    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> first = study["pca"]["score"].values[:, 0]
    >>> rest = s4a_morphometrics.without(study, first)
    >>> bool(abs(np.corrcoef(rest["pca"]["score"].values.T, first)[-1, :-1]).max() < 1e-3)
    True
    """
    registration, d, area = displacements_of(study)
    columns = covariates_of(study, nuisance)
    for name, values in columns.items():
        lacking = registration["shape"].values[lacks_value(values)].tolist()
        if lacking:
            raise ValueError(
                f"a nuisance needs a value for every shape; {name} lacks {listed(lacking)}"
            )
        check_column(values, registration["shape"].values.tolist(), name)
    Z, _ = columns_of(columns)
    if Z is None:
        raise ValueError("a nuisance needs a value for every shape, found none")
    U, S, _ = np.linalg.svd(standardize(Z)[0], full_matrices=False)
    U = U[:, S > 1e-8]
    if not U.shape[1]:
        raise ValueError("the nuisance is constant: there is no variation to remove")
    mean = d.mean(0)
    around = (d - mean).astype(float)
    B = np.einsum("sr,snx->rnx", U, around)  # slopes, up to their scale
    root, V = np.linalg.eigh(gram(B, area))
    keep = root > 1e-12 * root.max()
    basis = np.einsum("rk,rnx->knx", V[:, keep] / np.sqrt(root[keep]), B)
    along = np.einsum("snx,knx,n->sk", around, basis, area, optimize=True)
    residual = mean + around - np.einsum("sk,knx->snx", along, basis)
    part = _displaced(registration, residual.astype(d.dtype))
    return _study(study, part)


def with_size(study: xr.DataTree) -> xr.DataTree:
    """Return the study with the size restored that the alignment removed.

    Boas coordinates (Bookstein 2021): a shape that x -> s R x + t scaled to the template's size
    is divided by its s about the centre of the template.

    Parameters
    ----------
    study : DataTree
        From :func:`s4a.analyse` with ``remove_size=True``.

    Returns
    -------
    DataTree
        ``/registration``, ``/pca``, ``/subjects`` and ``/report``; every ``scale`` is 1.

    Raises
    ------
    ValueError
        If size was not removed.

    See Also
    --------
    within, without : other restrictions of a study.

    References
    ----------
    F. L. Bookstein (2021), Centric allometry, Evolutionary Biology 48.

    Examples
    --------
    With the ``study`` of six small brains, which includes size:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> s4a_morphometrics.with_size(s4a.synthetic.example_study())
    Traceback (most recent call last):
    ValueError: the displacements of this study include size (remove_size=False): nothing to restore
    """
    registration = registration_of(study)
    s = registration["scale"].values
    if abs(s - 1).max() < 1e-9:
        raise ValueError(
            "the displacements of this study include size (remove_size=False): nothing to restore"
        )
    X, T = as_arrays(registration)
    area = vertex_areas(X, T)
    center = area @ X / area.sum()
    d = registration["displacement"].values
    sized = (X + d - center) / s[:, None, None] + center - X
    part = _displaced(registration, sized.astype(d.dtype))
    part["scale"] = registration["scale"].copy(data=np.ones_like(s))
    if "translation" in registration:  # of x -> R x + t', which preserves size
        t = registration["translation"]
        part["translation"] = t.copy(data=(t.values - center) / s[:, None] + center)
    return _study(study, part)


def _displaced(registration, d):
    """Return a registration with other displacements, without variables derived from the old."""
    others = [str(name) for name in registration if str(name).startswith("displacement_")]
    return registration.drop_vars(others).assign(
        displacement=registration["displacement"].copy(data=d)
    )


def _study(study, registration, vertices=slice(None)):
    """Return a study of a registration with new modes, and tables and fields of the original."""
    modes = pca(registration, vertex_areas(*as_arrays(registration)))
    nodes = {"/registration": registration, "/pca": modes}
    for name in ("subjects", "report"):
        if name in study.children:
            nodes[f"/{name}"] = study[name].to_dataset()
    if "fields" in study.children:
        for name, field in study["fields"].children.items():
            nodes[f"/fields/{name}"] = field.to_dataset().isel(vertex=vertices)
    return xr.DataTree.from_dict(nodes, name=study.name)
