"""Generalization with new correspondences (6.1): leave-one-out of the registration, too."""

import numpy as np
import xarray as xr
from joblib import delayed
from scipy import stats
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from s4a.analysis.inputs import registration_of
from s4a.analysis.model import describe_by_others, draw_points, surface_error
from s4a.geometry.align import realign
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method.pca import gram
from s4a.method.register import from_latent, identity
from s4a.method.shape import Shape
from s4a.options import Options
from s4a.schema import dataset, in_unit, unit_of
from s4a.seeds import RNG, seed_of
from s4a.study.insert import insert
from s4a.study.processes import workers
from s4a.study.tree import stack_registration, template_mesh

RECOMPUTED = "recomputed for every left-out shape, as an out-of-sample shape of the others"


def without(study: xr.DataTree, name: str, *, n_jobs: int | None = None) -> xr.DataTree:
    """Return the study without shape `name` in latent space, registration and modes.

    If it is the template, the shape next closest to the limit shape (eq. 5) becomes the template,
    and all others are registered to it.  The latent bases of the other shapes are unchanged; they
    come from a network that included the shape.
    """
    registration = registration_of(study)
    names = [n for n in registration["shape"].values.tolist() if n != name]
    latent = latent_of(study, names)
    nodes = {f"{s}/{n}": study[s][n].to_dataset() for s in ("original", "coarse") for n in names}
    nodes |= {"latent": latent, "report": study["report"].to_dataset()}
    if registration.attrs["template"] != name:
        nodes["registration"] = registration.sel(shape=names)
        return xr.DataTree.from_dict(nodes)
    rotation = {n: registration["rotation"].sel(shape=n).values for n in names}
    return xr.DataTree.from_dict(
        nodes | _register_again(nodes, latent, rotation, Options.from_report(study), n_jobs)
    )


def latent_of(study: xr.DataTree, names: list[str]) -> xr.Dataset:
    """Return ``/latent`` of some shapes, including those excluded from the network."""
    excluded = study["latent"].children
    latent = study["latent"].to_dataset()
    if not excluded.keys() & set(names):
        return latent.sel(shape=names)
    parts = [
        excluded[name].to_dataset(inherit=False) if name in excluded else latent.sel(shape=name)
        for name in names
    ]

    def stacked(variable):
        return np.stack([part[variable].values for part in parts])

    return dataset(
        latent_basis=stacked("latent_basis"),
        latent_eigenvalue=latent["latent_eigenvalue"].values,
        area_difference=stacked("area_difference"),
        conformal_difference=stacked("conformal_difference"),
        distance_to_limit=stacked("distance_to_limit"),
    ).assign_coords(shape=names)


def _register_again(nodes, latent, rotation, options, n_jobs):
    """Return ``/registration`` of all shapes to the one closest to the limit shape (eq. 5)."""
    names = latent["shape"].values.tolist()
    median = str(latent["distance_to_limit"].idxmin().item())
    shapes = {
        n: Shape(
            nodes[f"original/{n}"].load(), nodes[f"coarse/{n}"].load(), **options.of("projection")
        )
        for n in names
    }
    template = shapes[median]
    Y = {n: latent["latent_basis"].sel(shape=n).values for n in names}
    others = [n for n in names if n != median]
    # R_i rotates shape i to the old template, so R_median^T R_i rotates it to the new one
    registered = workers(n_jobs)(
        delayed(_register)(
            shapes[n],
            template,
            (Y[n], Y[median]),
            rotation[median].T @ rotation[n],
            options,
        )
        for n in others
    )
    files = dict(zip(others, registered, strict=True)) | {median: identity(template)}
    mesh = template_mesh(template.original, median)
    return stack_registration(mesh, files, names)


def _register(shape, template, bases, rotation, options):
    """Register a shape of a study to another template, with its latent basis."""
    with threadpool_limits(1):
        transform = realign(shape.low.cloud, template.low.cloud, (rotation, np.zeros(3)))
        dense_match = options.dense_match
        return from_latent(
            shape, template, bases, transform, dense_match=dense_match, **options.of("registration")
        )


def _errors_of(study, name, n_points, seed, n_jobs):
    """Return errors of a left-out shape with 0, 1, ... components of the others ``(n,)``.

    Between vertices, and to the surface of the shape as it was read.
    """
    others = without(study, name, n_jobs=n_jobs)
    mesh = study["original"][name].to_dataset().load()
    new = insert(others, {name: mesh}, compare=False)["registration"].to_dataset()
    registration = others["registration"].to_dataset()
    X, T = as_arrays(registration)
    area = vertex_areas(X, T)
    d = registration["displacement"].values  # (n, v, 3)
    left_out = new["displacement"].values  # (1, v, 3)
    K = gram(np.concatenate([d, left_out]) - d.mean(0), area)
    n = len(d)
    error, _, steps = describe_by_others(K[:n, :n], K[n, :n], K[n, n])
    if not n_points:
        return error, np.full(n, np.nan)
    points = draw_points(area / area.sum(), n_points, np.random.default_rng(seed))
    R, t, s = (new[v].values[0] for v in ("rotation", "translation", "scale"))
    surface = s * mesh["position"].values @ R.T + t
    drawn = X[points] + d[:, points]  # (n, p, 3)
    return error, surface_error(drawn, steps, surface, mesh["corner_vertex"].values)


def generalization(
    study: xr.DataTree,
    *,
    n_points: int = 500,
    n_jobs: int | None = None,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Estimate generalization by leave-one-out, with new correspondences of the left-out shape.

    :func:`s4a.statistics.evaluate` leaves a shape out of the modes only.  This is optimistic,
    because its correspondences come from the whole collection.  Here the shape is also left out of
    the registration, and :func:`s4a.insert` registers it as an out-of-sample shape.  Only the
    latent bases of the others still depend on it, because they come from one network.

    Parameters
    ----------
    study : DataTree
        Finished, with at least 5 shapes.
    n_points : int
        Number of vertices for distances between reconstructions and the surface of the left-out
        shape as it was read; 0 computes no such distances.
    n_jobs : int, optional
        As in joblib; the result does not depend on it.
    seed, rng : see :mod:`s4a.seeds`
        For the choice of these vertices.

    Returns
    -------
    Dataset
        ``generalization(component)``, root mean square distance between vertices over the area, and
        ``generalization_surface(component)``, mean distance from points to the surface; both with
        their standard errors over the shapes, in the unit of the input.  Attributes:
        ``generalization_0``, that of the mean shape alone, ``correspondence``, ``shapes``.

    Raises
    ------
    ValueError
        If the study is not finished, or has fewer than 5 shapes.

    See Also
    --------
    s4a.statistics.evaluate : compactness, generalization and specificity of the modes.

    References
    ----------
    R. H. Davies, C. J. Twining and C. J. Taylor (2008), Statistical models of shape, Springer.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> from s4a_morphometrics import generalization
    >>> study = s4a.synthetic.example_study()
    >>> generalization(study).attrs["shapes"]
    6
    """
    registration = registration_of(study)
    nodes = ("original", "coarse", "latent", "registration", "report")
    missing = [node for node in nodes if node not in study.children]
    if missing:
        raise ValueError(f"a finished study is needed; this one lacks {', '.join(missing)}")
    names = registration["shape"].values.tolist()
    if len(names) < 5:
        raise ValueError(f"at least 5 shapes needed to leave one out, found {len(names)}")
    # the template first and alone: only leaving it out has registrations to run in parallel
    template = registration.attrs["template"]
    seed = seed_of(seed, rng)
    first = _errors_of(study, template, n_points, seed, n_jobs)
    rest = workers(n_jobs, return_as="generator")(
        delayed(_errors_of)(study, name, n_points, seed, 1) for name in names if name != template
    )
    errors = [first, *tqdm(rest, total=len(names) - 1, desc="shapes left out")]
    error, surface = (np.stack(values) for values in zip(*errors, strict=True))  # (s, s - 1) each
    measures = {
        "generalization": error[:, 1:].mean(0),
        "generalization_error": stats.sem(error[:, 1:]),
    }
    if n_points:
        measures["generalization_surface"] = surface[:, 1:].mean(0)
        measures["generalization_surface_error"] = stats.sem(surface[:, 1:])
    attrs = {
        "correspondence": RECOMPUTED,
        "shapes": len(names),
        "generalization_0": float(error[:, 0].mean()),
    }
    return in_unit(dataset(attrs, **measures), unit_of(registration["displacement"]))
