"""The steps of 4.1 and 4.2 one by one, on Datasets: from low-resolution meshes to a registration.

:func:`s4a.analyse` runs them over a folder; here is what each takes and gives.  Before them come
:func:`s4a.coarsen` and :func:`s4a.spectrum`, after them :func:`s4a.method.pca.pca`.
"""

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from s4a.geometry.align import Motion, align, motion_between, realign
from s4a.method import fmap, network
from s4a.method.first_map import first_map, map_after_motion
from s4a.method.latent import consistent_zoomout
from s4a.method.median import median_shape
from s4a.method.register import from_latent, identity, match_functions, match_low
from s4a.method.shape import Basis, Shape
from s4a.schema import dataset, require

LOW = ("position", "corner_vertex", "vertex_area", "eigenvalue", "eigenfunction")


def bases_of(coarse: dict[str, xr.Dataset]) -> dict[str, Basis]:
    """The low-resolution meshes of a collection in their frames; ValueError where one is none."""
    for name, mesh in coarse.items():
        require(mesh, *LOW, what=f"coarse mesh {name}")
    return {name: Shape(None, mesh).low for name, mesh in coarse.items()}


def align_pair(source: xr.Dataset, target: xr.Dataset) -> xr.Dataset:
    """Rigid motion of a shape onto another by iterative closest points (4.1, step 2).

    Parameters
    ----------
    source, target : xarray.Dataset
        Low-resolution meshes with their spectrum, as of :func:`s4a.coarsen` and
        :func:`s4a.spectrum`.

    Returns
    -------
    xarray.Dataset
        ``rotation`` R and ``translation`` t of R x + t, between the frames of both: centred, the
        square root of the area as unit.  The attribute ``residual`` is the trimmed root mean square
        distance of the pairs, in the same unit.

    Raises
    ------
    ValueError
        When a mesh lacks its variables.

    Examples
    --------
    >>> import s4a
    >>> ball = s4a.spectrum(s4a.coarsen(s4a.synthetic.ellipsoid(500), n_coarse=200), k=10)
    >>> (s4a.align_pair(ball, ball)["rotation"].values.round(6) + 0.0).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    M, N = bases_of({"source": source, "target": target}).values()
    R, t, residual = align(M.X, M.area, N.X, N.area)
    return dataset({"residual": float(residual)}, rotation=R, translation=t)


def map_pairs(
    bases: dict[str, Basis],
    motions: dict[str, Motion],
    pairs: Sequence[tuple[str, str]],
    *,
    k_init: int = 20,
    init: str = "dense",
) -> xr.Dataset:
    """First maps of some pairs, in both directions (4.1, steps 3 and 4).

    Parameters
    ----------
    bases : dict
        Name of a shape -> its low resolution.
    motions : dict
        Name -> motion (R, t) onto a common reference.
    pairs : sequence of (str, str)
    k_init, init : see :func:`s4a.analyse`

    Returns
    -------
    xarray.Dataset
        ``source(pair)``, ``target(pair)`` and ``fmap_initial``.
    """
    source, target, maps = [], [], []
    for a, b in pairs:
        M, N = bases[a], bases[b]
        start = motion_between(motions[a], motions[b])
        R, t = realign(M.cloud, N.cloud, start)
        kind, C, _ = first_map(M, N, (R, t), k_init=k_init, init=init)
        if kind == init:
            back = map_after_motion(N, M, (R.T, -R.T @ t), k_init=k_init, init=init)
        else:  # of far poses: the other direction must tell the same limbs apart
            back = fmap.refine_once(N, M, C.T)
        source += [a, b]
        target += [b, a]
        maps += [C, back]
    return dataset(source=np.array(source), target=np.array(target), fmap_initial=np.stack(maps))


def build_network(
    coarse: dict[str, xr.Dataset], *, n_pairs: int = 500, k_init: int = 20, init: str = "dense"
) -> xr.Dataset:
    """The network of first maps of a collection (3.4, 4.1): its pairs, and a map each way.

    Parameters
    ----------
    coarse : dict of str to xarray.Dataset
        Name -> low-resolution mesh with its spectrum.
    n_pairs, k_init, init : see :func:`s4a.analyse`

    Returns
    -------
    xarray.Dataset
        ``source(pair)``, ``target(pair)`` and ``fmap_initial(pair, mode_target_initial,
        mode_source_initial)``; the attribute ``reference`` is the shape that all are aligned to.

    Raises
    ------
    ValueError
        When a mesh lacks its variables, or the pairs cannot connect the shapes.

    Examples
    --------
    >>> import s4a
    >>> meshes = s4a.synthetic.brains(3, 200)["original"].children
    >>> coarse = {n: s4a.spectrum(s4a.coarsen(m.to_dataset(), n_coarse=100), k=10)
    ...           for n, m in meshes.items()}
    >>> s4a.build_network(coarse, k_init=6)["fmap_initial"].shape
    (6, 6, 6)
    """
    bases = bases_of(coarse)
    names = list(bases)
    k_init = min(k_init, *(basis.k for basis in bases.values()))
    distance = network.spectral_distance([basis.eigenvalue[:k_init] for basis in bases.values()])
    reference = names[int(np.argmin(distance.sum(1)))]
    N = bases[reference]
    motions = {
        name: align(M.X, M.area, N.X, N.area)[:2] for name, M in bases.items() if name != reference
    }
    motions[reference] = np.eye(3), np.zeros(3)
    pairs = [(names[i], names[j]) for i, j in network.choose_pairs(distance, n_pairs)]
    maps = map_pairs(bases, motions, pairs, k_init=k_init, init=init)
    return maps.assign_attrs(reference=reference)


def refine_network(
    coarse: dict[str, xr.Dataset],
    first: xr.Dataset,
    *,
    k: int = 100,
    step: int = 5,
    n_latent: int | None = None,
    norm: str = "h2",
    n_jobs: int | None = 1,
    progress: Callable | None = None,
) -> xr.DataTree:
    """Consistent ZoomOut of a network and the median shape (4.2; eq. 3 and 5).

    Parameters
    ----------
    coarse : dict of str to xarray.Dataset
        Name -> low-resolution mesh with its spectrum.
    first : xarray.Dataset
        As of :func:`build_network`.
    k, step, n_latent, norm : see :func:`s4a.analyse`
    n_jobs : int
        Threads; the result does not depend on it.
    progress : callable, optional
        Called with the size of the maps after each round.

    Returns
    -------
    xarray.DataTree
        ``/network`` with ``fmap``, ``weight``, ``cycle_error`` and ``cycle_error_initial``;
        ``/latent`` with ``latent_basis``, ``latent_eigenvalue`` and what
        :func:`s4a.method.median.median_shape` adds, the attribute ``median`` among it.

    Raises
    ------
    ValueError
        When a mesh or the network lacks its variables.

    Examples
    --------
    >>> import s4a
    >>> meshes = s4a.synthetic.brains(3, 200)["original"].children
    >>> coarse = {n: s4a.spectrum(s4a.coarsen(m.to_dataset(), n_coarse=100), k=10)
    ...           for n, m in meshes.items()}
    >>> tree = s4a.refine_network(coarse, s4a.build_network(coarse, k_init=6), k=10)
    >>> tree["latent/latent_basis"].shape, tree["latent"].attrs["median"] in coarse
    ((3, 10, 10), True)
    """
    require(first, "source", "target", "fmap_initial", what="network")
    bases = bases_of(coarse)
    names = list(bases)
    k = min([k, *(basis.k for basis in bases.values())])
    source = np.array([names.index(name) for name in first["source"].values])
    target = np.array([names.index(name) for name in first["target"].values])
    C_initial = first["fmap_initial"].values  # (p, k_init, k_init)
    with threadpool_limits(1):
        C, weight, _, Y, latent_eigenvalue = consistent_zoomout(
            list(bases.values()),
            C_initial,
            source,
            target,
            k,
            step=step,
            n_latent=n_latent,
            samples=[basis.spread_vertices for basis in bases.values()],
            n_jobs=n_jobs,
            progress=progress,
        )
    cycles = network.three_cycles(source.tolist(), target.tolist())
    refined = dataset(
        fmap=C.astype(np.float32),
        weight=weight,
        cycle_error=network.cycle_errors(C, cycles, k=C_initial.shape[1]),
        cycle_error_initial=network.cycle_errors(C_initial, cycles),
    )
    latent = dataset(latent_basis=Y, latent_eigenvalue=latent_eigenvalue)
    latent = latent.assign_coords(shape=names)
    eigenvalues = np.stack([basis.eigenvalue[:k] for basis in bases.values()])  # (n, k)
    return xr.DataTree.from_dict(
        {
            "network": first.merge(refined),
            "latent": median_shape(latent, eigenvalues, norm=norm),
        }
    )


def shape_in(study: xr.DataTree, name: str) -> Shape:
    """A shape of a study at both resolutions; ValueError where the study has none of that name."""
    for stage in ("original", "coarse"):
        if stage not in study.children or name not in study[stage].children:
            known = ", ".join(study[stage].children) if stage in study.children else "no such node"
            raise ValueError(f"a study with /{stage}/{name} is needed; this one has {known}")
    return Shape(*(study[stage][name].to_dataset() for stage in ("original", "coarse")))


def latent_bases(study: xr.DataTree, *names: str) -> tuple:
    """The latent bases Y ``(k, m)`` of some shapes of a study."""
    require(study["latent"].to_dataset(), "latent_basis", what="latent dataset")
    Y = study["latent"].dataset["latent_basis"]
    return tuple(Y.sel(shape=name).values for name in names)


def latent_match(
    study: xr.DataTree, source: str, target: str, *, how: str = "ours", full: bool = True
) -> xr.Dataset:
    """Match of any two shapes of a network by their latent bases (eq. 3 and 6; eq. 7 or 4).

    Parameters
    ----------
    study : xarray.DataTree
        With ``/original``, ``/coarse`` and ``/latent``.
    source, target : str
        Names of shapes.
    how : {"ours", "standard"}
        At full resolution eq. 7, or eq. 4 with the functional map of the match of eq. 3.
    full : bool
        Whether original vertices are matched, or those of low resolution.

    Returns
    -------
    xarray.Dataset
        ``match(vertex)``: on each vertex of the target, the matched vertex of the source.

    Raises
    ------
    ValueError
        When a shape is not in the study, or `how` is another.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> match = s4a.latent_match(study, "brain_01", "brain_02")["match"]
    >>> match.sizes["vertex"] == study["original/brain_02"].sizes["vertex"]
    True
    """
    if how not in ("ours", "standard"):
        raise ValueError(f"how must be 'ours' or 'standard', found {how!r}")
    shapes = shape_in(study, source), shape_in(study, target)
    match, functions = match_low(*shapes, latent_bases(study, source, target), how=how)
    if full:
        match, *_ = match_functions(*shapes, *functions)
    return dataset(match=match)


def register_shape(
    study: xr.DataTree,
    name: str,
    template: str | None = None,
    *,
    start: Motion | None = None,
    how: str = "ours",
    refine: str = "joint",
    scale: bool = False,
) -> xr.Dataset:
    """One shape of a study registered to the template (4.2; eq. 6, 7 and 8).

    Parameters
    ----------
    study : xarray.DataTree
        With ``/original``, ``/coarse`` and ``/latent``.
    name, template : str
        The median shape is the template by default.
    start : tuple (R, t), optional
        About the rigid motion of the shape onto the template, between their frames; found by ICP
        from the principal axes by default.
    how, refine, scale : see :func:`s4a.analyse`

    Returns
    -------
    xarray.Dataset
        As of :func:`s4a.method.register.register`.

    Raises
    ------
    ValueError
        When a shape is not in the study.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.register_shape(study, "brain_02")["displacement"].dims
    ('vertex', 'xyz')
    """
    template = study["latent"].attrs["median"] if template is None else template
    target = shape_in(study, template)
    if name == template:
        return identity(target)
    source = shape_in(study, name)
    M = source.low
    N = target.low
    if start is None:
        motion = align(M.X, M.area, N.X, N.area)[:2]
    else:
        motion = realign(M.cloud, N.cloud, start)
    bases = latent_bases(study, name, template)
    return from_latent(source, target, bases, motion, how=how, refine=refine, scale=scale)
