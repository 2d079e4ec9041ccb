"""New shapes in a finished study (4.2, 6.1): latent basis, registration and scores.

All others stay as they are.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from s4a.geometry.align import align, realign
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.collection import read_shapes, shape_report
from s4a.input.plausibility import examine, find_warnings, sample_vertices
from s4a.method.first_map import first_map
from s4a.method.latent import latent_basis_of_new
from s4a.method.median import area_differences, conformal_differences, distance_to_identity
from s4a.method.network import spectral_distance
from s4a.method.pca import project_scores
from s4a.method.register import from_latent
from s4a.method.remesh import coarsen
from s4a.method.shape import Basis, Shape
from s4a.method.spectral import spectrum
from s4a.schema import dataset, in_unit, require, unit_of
from s4a.study.options import Options
from s4a.study.tree import stack_registration, template_mesh

NEIGHBOURS = 6  # shapes of the study, the template among them, whose maps a new one has


class Frozen(NamedTuple):
    """The study that new shapes come into: the template, and all shapes, the template first."""

    template: Shape
    low: list[Basis]
    Y: np.ndarray  # (n, k, m), latent bases
    turn: list[np.ndarray]  # rotations onto the template


class Inserted(NamedTuple):
    """What is made of one new shape."""

    coarse: xr.Dataset
    Y: np.ndarray  # (k, m), latent basis
    registration: xr.Dataset
    look: dict


def insert(
    study: xr.DataTree,
    shapes: Path | str | list | dict | xr.Dataset,
    *,
    compare: bool = True,
    n_jobs: int | None = None,
) -> xr.DataTree:
    """New shapes placed into a finished study, which stays as it is.

    Each new shape is remeshed, aligned and mapped to the template and the five shapes of the study
    with the most alike spectra; its latent basis solves eq. 3 with theirs frozen; it is registered
    to the frozen template, and its displacement measured along the frozen modes.  What comes out
    for one shape does not depend on the others given.

    Parameters
    ----------
    study : DataTree
        Of :func:`s4a.analyse` or :func:`s4a.open_study`.
    shapes : path, list of paths, dict or Dataset
        See :func:`s4a.read_shapes`; a single mesh Dataset is named ``new``.
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

    Raises
    ------
    ValueError
        When the study is not finished, no shape can be used, or one has the name of the template.

    Examples
    --------
    >>> import s4a
    >>> brains = s4a.synthetic.brains(4, 1500)["original"]
    >>> brains = {name: mesh.to_dataset() for name, mesh in brains.children.items()}
    >>> last = brains.pop("brain_04")
    >>> study = s4a.analyse(brains, n_coarse=300, k_init=8, k=12)
    >>> s4a.insert(study, {"brain_04": last})["pca"]["score"].sizes["component"]
    2
    """
    needed = ("original", "coarse", "latent", "registration")
    missing = [name for name in needed if name not in study.children]
    if missing:
        raise ValueError(f"a finished study is needed; this one lacks {', '.join(missing)}")
    options = Options.from_report(study)
    template = study["registration"].attrs["template"]
    shapes = {"new": shapes} if isinstance(shapes, xr.Dataset) else shapes
    meshes, attrs = read_new(shapes, options)
    if template in meshes:
        raise ValueError(f"new shapes need other names than the template, {template!r}; rename it")
    frozen = freeze(study)
    results = Parallel(n_jobs=n_jobs)(
        delayed(insert_one)(mesh, frozen, options, compare) for mesh in meshes.values()
    )
    inserted = {}
    for name, result in zip(meshes, results, strict=True):
        if isinstance(result, ValueError):
            attrs[name] = attrs[name] | {"status": "excluded", "reason": str(result)}
        else:
            inserted[name] = result
    if not inserted:
        reasons = "; ".join(f"{name}: {said['reason']}" for name, said in attrs.items())
        raise ValueError(f"no shape can be inserted ({reasons})")

    nodes = {f"original/{name}": meshes[name] for name in inserted}
    nodes[f"original/{template}"] = frozen.template.original
    nodes |= {f"coarse/{name}": new.coarse for name, new in inserted.items()}
    nodes["latent"] = latent_of_new(inserted, study["latent"].to_dataset(), options.norm)
    nodes |= stack_registration(
        template_mesh(frozen.template.original, template),
        {name: new.registration for name, new in inserted.items()},
        list(inserted),
    )
    if "pca" in study:
        nodes["pca"] = scores_of_new(study["pca"].to_dataset(), nodes["registration"])
    if compare:
        looks = {name: new.look for name, new in inserted.items()}
        nodes["report"] = report_beside(study, attrs, looks)
    else:
        nodes["report"] = shape_report(attrs)
    return xr.DataTree.from_dict(nodes)


def read_new(
    shapes: Path | str | list | dict, options: Options
) -> tuple[dict[str, xr.Dataset], dict[str, dict]]:
    """The new meshes that can be used, clean, and the attributes of all for the report."""
    meshes = {}
    if isinstance(shapes, dict):
        for name, mesh in shapes.items():
            if isinstance(mesh, xr.Dataset) and "file_vertex" in mesh:  # clean as it is
                meshes[name] = mesh
        shapes = {name: mesh for name, mesh in shapes.items() if name not in meshes}
    attrs = {name: {"status": "ok", "reason": ""} | mesh.attrs for name, mesh in meshes.items()}
    if isinstance(shapes, dict) and not shapes:
        return meshes, attrs
    tree = read_shapes(shapes, components=options.components, strict=options.strict, compare=False)
    report = tree["report"].to_dataset()
    for name in report["shape"].values.tolist():
        if name in tree["original"].children:
            meshes[name] = tree[f"original/{name}"].to_dataset()
            attrs[name] = meshes[name].attrs
        else:
            row = report.sel(shape=name)
            attrs[name] = {column: row[column].item() for column in ("status", "reason", "path")}
    return meshes, attrs


def freeze(study: xr.DataTree) -> Frozen:
    """What new shapes need of a study, the template first; shapes that failed are left out."""
    latent = study["latent"].to_dataset()
    require(latent, "latent_basis", "latent_eigenvalue", what="latent dataset")
    rotation = study["registration"].dataset["rotation"]
    template = study["registration"].attrs["template"]
    registered = set(rotation["shape"].values.tolist())
    others = [n for n in latent["shape"].values.tolist() if n in registered and n != template]
    names = [template, *others]
    coarse = [study["coarse"][name].to_dataset() for name in names]
    return Frozen(
        Shape(study["original"][template].to_dataset().load(), coarse[0].load()),
        [Shape(None, mesh).low for mesh in coarse],
        latent["latent_basis"].sel(shape=names).values,
        list(rotation.sel(shape=names).values),
    )


def insert_one(
    mesh: xr.Dataset, frozen: Frozen, options: Options, compare: bool
) -> Inserted | ValueError:
    """One new shape: coarse mesh, latent basis, registration, plausibility; or why there is none.

    An error is given back and not raised, as it costs this shape alone.
    """
    try:
        with threadpool_limits(1):
            return _insert_one(mesh, frozen, options, compare)
    except ValueError as error:
        return error


def _insert_one(mesh, frozen, options, compare):
    _, k, _ = frozen.Y.shape
    coarse = coarsen(mesh, n_coarse=options.n_coarse, wrap=options.wrap, seed=options.seed)
    coarse = spectrum(coarse, k=k)
    if coarse.sizes["mode"] < k:
        raise ValueError(
            f"the study needs {k} eigenfunctions, this shape has only {coarse.sizes['mode']}"
        )
    shape = Shape(mesh, coarse)
    new = Shape(None, coarse).low
    template = frozen.template.low
    k_init = min(options.k_init, k)
    chosen = nearest_spectra(new, frozen.low, k_init)
    R, t, _ = align(shape.low.X, shape.low.area, template.X, template.area)
    maps = []
    for j in chosen:
        other = frozen.low[j]
        start = frozen.turn[j].T @ R, np.zeros(3)
        S, u = realign(new.cloud, other.cloud, start)
        to_new = S.T, -S.T @ u
        maps.append(first_map(other, new, to_new, k_init=k_init, init=options.init)[1])
    others = [frozen.low[j] for j in chosen]
    Y = latent_basis_of_new(new, others, frozen.Y[chosen], maps, step=options.step)
    registration = from_latent(
        shape,
        frozen.template,
        (Y, frozen.Y[0]),
        (R, t),
        how=options.how,
        refine=options.refine,
        scale=options.scale,
    )
    seen = {}
    if compare:
        seen = examine(mesh, sample_vertices(frozen.template.original), options.intersections)
    return Inserted(coarse, Y, registration, seen)


def nearest_spectra(new: Basis, shapes: list[Basis], k: int) -> list[int]:
    """The template, first of the shapes, and those whose first k eigenvalues are most alike."""
    distance = spectral_distance([basis.eigenvalue[:k] for basis in (new, *shapes)])[0]
    order = np.argsort(distance[2:], kind="stable")  # without itself and the template
    return [0, *(1 + order[: NEIGHBOURS - 1]).tolist()]


def report_beside(study: xr.DataTree, attrs: dict, looks: dict) -> xr.Dataset:
    """The report on the new shapes, each beside those of the study, as they lie when registered."""
    rotation = study["registration"].dataset["rotation"]
    known = {name: study["original"][name].attrs for name in rotation["shape"].values.tolist()}
    # the hand of the study is the right one, and its own intersections are told already
    usual = {"residual": 0.0, "mirrored": 1.0, "self_intersections": -1}
    known_looks = {name: usual | {"rotation": rotation.sel(shape=name).values} for name in known}
    told_before = find_warnings(known, known_looks)[1]
    reports, remarks = [], {}
    for name, said in attrs.items():
        own_look = {name: looks[name]} if name in looks else {}
        report = shape_report(known | {name: said}, known_looks | own_look)
        reports.append(report.sel(shape=[name]))
        lines = report.attrs["remarks"].splitlines()
        remarks |= dict.fromkeys(line for line in lines if line not in told_before)
    return xr.concat(reports, dim="shape").assign_attrs(remarks="\n".join(remarks))


def latent_of_new(inserted: dict[str, Inserted], latent: xr.Dataset, norm: str) -> xr.Dataset:
    """``/latent`` of the new shapes: bases, shape differences, distances to the limit shape."""
    Y = np.stack([new.Y for new in inserted.values()])
    eigenvalues = np.stack([new.coarse["eigenvalue"].values for new in inserted.values()])
    latent_eigenvalue = latent["latent_eigenvalue"].values
    D = area_differences(Y)
    return dataset(
        latent_basis=Y,
        latent_eigenvalue=latent_eigenvalue,
        area_difference=D,
        conformal_difference=conformal_differences(Y, eigenvalues, latent_eigenvalue),
        distance_to_median=distance_to_identity(D, latent_eigenvalue, norm),
    ).assign_coords(shape=list(inserted))


def scores_of_new(modes: xr.Dataset, registration: xr.Dataset) -> xr.Dataset:
    """The frozen modes, with the scores of the new shapes in place of those that made them."""
    score, left = project_scores(
        registration["displacement"].values,
        modes["mean_displacement"].values,
        modes["deformation"].values,
        modes["standard_deviation"].values,
        vertex_areas(*as_arrays(registration)),
    )
    new = in_unit(dataset(score=score, reconstruction_error=left), unit_of(modes["deformation"]))
    frozen = modes.drop_vars(["score", "shape"])
    return frozen.merge(new).assign_coords(shape=registration["shape"])
