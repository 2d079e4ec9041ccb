"""The steps of 4.1 and 4.2 as functions of Datasets: from low-resolution meshes to a registration.

:func:`s4a.analyse` runs them over a folder.  Before them come :func:`s4a.coarsen` and
:func:`s4a.spectrum`, after them :func:`s4a.method.pca.pca`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from s4a.geometry.align import RigidTransform, align, relative_transform
from s4a.method import fmap, network
from s4a.method.alignment import align_all, alignment_residual, pair_transform, transform_onto
from s4a.method.initial_map import initial_map, map_after_alignment
from s4a.method.latent import (
    DENSE_ITERATIONS,
    consistent_zoomout,
    nearest_spectra,
    out_of_sample_basis,
)
from s4a.method.median import median_shape
from s4a.method.register import from_latent, identity, match_functions, match_low
from s4a.method.shape import Basis, Shape
from s4a.options import N_SAMPLES, check, kept_options, names_of
from s4a.schema import Array, check_count, check_type, dataset, require

PROJECTION = names_of("projection")
REGISTRATION = [*names_of("registration"), "alignment", "dense_match", *PROJECTION]
LOW = ("position", "corner_vertex", "vertex_area", "eigenvalue", "eigenfunction")


def check_coarse(coarse: dict[str, xr.Dataset]) -> None:
    """Raise an error unless `coarse` has low-resolution meshes with their spectra by name."""
    check_type(coarse, dict, "coarse")
    for name, mesh in coarse.items():
        require(mesh, *LOW, what=f"coarse mesh {name}")


def bases_of(coarse: dict[str, xr.Dataset]) -> dict[str, Basis]:
    """Return the low-resolution meshes of a collection, each in its frame, after a check."""
    check_coarse(coarse)
    return {name: Shape(coarse=mesh).low for name, mesh in coarse.items()}


class LazyBases(Sequence[Basis]):
    """Low-resolution meshes of a collection, each in its frame and made on access.

    Meshes in files are read on access, so memory holds only those in use.
    """

    def __init__(self, coarse: dict[str, xr.Dataset]):
        self.meshes = list(coarse.values())

    def __len__(self) -> int:
        return len(self.meshes)

    def __getitem__(self, i: Any) -> Any:
        return Shape(coarse=self.meshes[i]).low


def align_pair(source: xr.Dataset, target: xr.Dataset) -> xr.Dataset:
    """Align a shape rigidly to another by iterative closest points (4.1, step 2).

    Parameters
    ----------
    source, target : xarray.Dataset
        Low-resolution meshes with their spectrum, from :func:`s4a.coarsen` and
        :func:`s4a.spectrum`.

    Returns
    -------
    xarray.Dataset
        ``rotation`` R and ``translation`` t of the rigid transform R x + t.  Both shapes are
        centred and scaled to unit area before, so lengths are in multiples of sqrt(area).  The
        attribute ``residual`` is the root mean square distance of the nearest-neighbour pairs in
        position and weighted normal, in the same unit.

    Raises
    ------
    ValueError
        If a mesh lacks a variable.

    See Also
    --------
    build_network : Align all shapes of a collection and compute their initial maps.

    References
    ----------
    P. J. Besl and N. D. McKay (1992), A method for registration of 3-D shapes, IEEE TPAMI 14(2).

    Examples
    --------
    >>> import s4a
    >>> ball = s4a.spectrum(s4a.coarsen(s4a.synthetic.ellipsoid(500), n_coarse=200), k=10)
    >>> (s4a.align_pair(ball, ball)["rotation"].values.round(6) + 0.0).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    M, N = bases_of({"source": source, "target": target}).values()
    R, t, residual = align(M.cloud, N.cloud)
    return dataset({"residual": float(residual)}, rotation=R, translation=t)


def map_pairs(
    bases: dict[str, Basis],
    transforms: dict[str, RigidTransform],
    pairs: Sequence[tuple[str, str]],
    *,
    k_init: int = 20,
    init: str = "dense",
    initial_refinement: bool = True,
    n_samples: int = N_SAMPLES,
    alignment: str = "search",
    keep_descriptors: bool = False,
) -> xr.Dataset:
    """Compute the initial maps of some pairs, in both directions (4.1, steps 3 and 4).

    Parameters
    ----------
    bases : dict
        Name of a shape -> its low resolution.
    transforms : dict
        Name -> rigid transform (R, t) onto a common reference.
    pairs : sequence of (str, str)
    k_init, init : see :func:`s4a.analyse`
    initial_refinement : bool
        Whether to refine the maps by a step of ZoomOut (4.2).
    n_samples : int
        Farthest-point samples on which that step searches matches if poses are similar; 0 for all
        vertices.
    alignment : {"search", "icp", "given"}
        See :class:`s4a.Options`.
    keep_descriptors : bool
        Whether to return the descriptors of the landmarks.

    Returns
    -------
    xarray.Dataset
        ``source(pair)``, ``target(pair)`` and ``fmap_initial``; ``fmap_fitted``, the maps before
        the refinement; ``pair_rotation``, ``pair_translation`` and ``pair_residual`` of ICP; with
        landmarks ``landmark_of_source(pair, landmark)``, ``landmark_of_target``,
        ``descriptor_energy(pair)`` and ``laplacian_energy(pair)``.
    """
    options: dict[str, Any] = {"k_init": k_init, "init": init, "n_samples": n_samples}
    options["initial_refinement"] = initial_refinement
    rows: list[tuple[Any, ...]] = []
    fits: list[xr.Dataset] = []
    for a, b in pairs:
        M, N = bases[a], bases[b]
        R, t = pair_transform(M, N, relative_transform(transforms[a], transforms[b]), alignment)
        R_back, t_back = R.T, -R.T @ t
        forth = initial_map(M, N, (R, t), alignment=alignment, **options)
        back = map_after_alignment(N, M, (R_back, t_back), **options)
        if forth.name != init:  # large pose difference: both directions must match the same limbs
            back = back._replace(C=fmap.refine_once(N, M, forth.C.T), fitted=forth.C.T)
        residual = alignment_residual(M, N, (R, t))
        rows.append((a, b, forth.C, forth.fitted, R, t, residual, forth.landmarks))
        rows.append((b, a, back.C, back.fitted, R_back, t_back, residual, back.landmarks))
        fits += [one.fit_to_landmarks(keep_descriptors) for one in (forth, back)]
    names = ("source", "target", "fmap_initial", "fmap_fitted", "pair_rotation", "pair_translation")
    *columns, marks = map(np.array, zip(*rows, strict=True))
    maps = dataset(None, **dict(zip((*names, "pair_residual"), columns, strict=True)))
    if init == "dense":
        return maps
    # marks (p, 2, landmarks)
    marked = dataset(landmark_of_source=marks[:, 0], landmark_of_target=marks[:, 1])
    fitted = xr.concat(fits, dim="pair") if init == "landmarks" else xr.Dataset()
    return maps.merge(marked).merge(fitted)


def build_network(
    coarse: dict[str, xr.Dataset],
    *,
    n_pairs: int = 500,
    k_init: int = 20,
    init: str = "dense",
    initial_refinement: bool = True,
    n_samples: int = N_SAMPLES,
    alignment: str = "search",
) -> xr.Dataset:
    """Build the network of initial maps of a collection (3.4, 4.1).

    Parameters
    ----------
    coarse : dict of str to xarray.Dataset
        Name -> low-resolution mesh with its spectrum.
    n_pairs : int
        Number of pairs in the network; all pairs if there are fewer.
    k_init : int
        Size of the initial functional maps.
    init : {"dense", "landmarks", "wave_kernels"}
        Fit initial maps to all nearest neighbours, to 10 landmarks as in the paper, or to wave
        kernels of the shapes and around these landmarks as in pyFM.
    initial_refinement : bool
        Refine the initial maps by one ZoomOut iteration (4.2).
    n_samples : int
        Number of farthest-point samples for which that iteration searches matches if pose
        differences are small; 0 for all vertices.
    alignment : {"search", "icp", "given"}
        Rigid alignment: the best of several results of ICP, plain ICP, or the pose as given.

    Returns
    -------
    xarray.Dataset
        The network has two maps for each pair, one per direction, so the dimension ``pair`` counts
        each pair twice.

        - ``source(pair)`` and ``target(pair)``: names of the shapes;
        - ``fmap_initial(pair, eigenpair_target_initial, eigenpair_source_initial)``: initial maps;
        - ``fmap_fitted``: initial maps before their ZoomOut iteration;
        - ``pair_rotation`` and ``pair_translation``: rigid transform of each pair by ICP;
        - ``landmark_of_source(pair, landmark)`` and ``landmark_of_target``: vertices of the
          landmarks, with ``init="landmarks"``;
        - ``icp_rotation(shape, xyz, xyz_2)`` and ``icp_translation(shape, xyz)``: rigid transform
          of each shape onto the shape that the attribute ``reference`` names;
        - ``pair_residual(pair)`` and ``icp_residual(shape)``: residuals of both alignments;
        - ``spectral_distance(shape, shape_2)``: distances that chose the pairs and the reference.

    Raises
    ------
    ValueError
        If a mesh lacks a variable, `init` is unknown, or the pairs cannot connect the shapes.

    See Also
    --------
    refine_network : Refine the maps and compute the latent bases.
    align_pair : Rigid alignment of one pair.

    References
    ----------
    M. Ovsjanikov et al. (2012), Functional maps: a flexible representation of maps between shapes,
    ACM Transactions on Graphics 31(4).

    Examples
    --------
    >>> import s4a
    >>> meshes = s4a.synthetic.brains(3, 200)["original"].children
    >>> coarse = {n: s4a.spectrum(s4a.coarsen(m.to_dataset(), n_coarse=100), k=10)
    ...           for n, m in meshes.items()}
    >>> s4a.build_network(coarse, k_init=6)["fmap_initial"].shape
    (6, 6, 6)

    The network of a study, with one edge per map, coloured by cycle error:

    >>> import numpy as np
    >>> study = s4a.synthetic.example_study()
    >>> network, names = study["network"], list(study["original"].children)
    >>> source, target = (
    ...     np.array([names.index(name) for name in network[end].values])
    ...     for end in ("source", "target")
    ... )
    >>> errors = {"initial": network["cycle_error_initial"], "refined": network["cycle_error"]}
    >>> errors = {title: error.values for title, error in errors.items()}
    >>> charts = s4a.show.charts
    >>> charts.network(charts.on_circle(6), names, source, target, errors)
    <Figure ...>
    """
    check("init", init)
    bases = bases_of(coarse)
    names = list(bases)
    k_init = min(k_init, *(basis.k for basis in bases.values()))
    distance = network.spectral_distance([basis.eigenvalue[:k_init] for basis in bases.values()])
    reference = names[int(np.argmin(distance.sum(1)))]
    transforms = {
        name: aligned.transform for name, aligned in align_all(bases, reference, alignment).items()
    }
    pairs = [(names[i], names[j]) for i, j in network.choose_pairs(distance, n_pairs)]
    options: dict[str, Any] = {"k_init": k_init, "init": init, "n_samples": n_samples}
    options |= {"initial_refinement": initial_refinement, "alignment": alignment}
    maps = map_pairs(bases, transforms, pairs, **options)
    residuals = [alignment_residual(bases[n], bases[reference], transforms[n]) for n in names]
    return with_transforms(maps, transforms, reference, residuals, distance)


def with_transforms(
    maps: xr.Dataset,
    transforms: dict[str, RigidTransform],
    reference: str,
    residuals: Sequence[float],
    distance: Array,
) -> xr.Dataset:
    """Add to a network the transforms onto the `reference`, their residuals, spectral distances."""
    R, t = (np.stack(values) for values in zip(*transforms.values(), strict=True))
    alignment = dataset(
        icp_rotation=R, icp_translation=t, icp_residual=residuals, spectral_distance=distance
    )
    names = list(transforms)
    alignment = alignment.assign_coords(shape=names, shape_2=names)
    return maps.merge(alignment).assign_attrs(reference=reference)


def refine_network(
    coarse: dict[str, xr.Dataset],
    initial: xr.Dataset,
    *,
    k: int = 100,
    step: int = 5,
    n_latent: int | None = None,
    weights: str = "cycles",
    isometric: bool = False,
    n_samples: int = N_SAMPLES,
    dense_iterations: int = DENSE_ITERATIONS,
    norm: str = "h2",
    keep_iterations: bool = False,
    n_jobs: int | None = 1,
    progress: Callable[..., Any] | None = None,
) -> xr.DataTree:
    """Refine a network by Consistent ZoomOut and find the median shape (4.2; eq. 3 and 5).

    Parameters
    ----------
    coarse : dict of str to xarray.Dataset
        Name -> low-resolution mesh with its spectrum.
    initial : xarray.Dataset
        Network of :func:`build_network`.
    k, step, n_latent, weights, isometric, n_samples, dense_iterations, norm, keep_iterations
        Options of Consistent ZoomOut and of the median shape.  :class:`s4a.Options` describes them.
    n_jobs : int
        Number of threads, as in joblib: -1 for all cores.  The result does not depend on it.
    progress : callable, optional
        Called with the size of the maps after each iteration.

    Returns
    -------
    xarray.DataTree
        The refined network, with the nodes

        - ``/network``: the refined maps ``fmap``, their ``weight``, the errors ``cycle_error`` and
          ``cycle_error_initial`` of the refined and the initial maps, and
          ``iteration_weight(iteration, pair)`` and ``iteration_cycle_error`` of every iteration;
        - ``/latent``: ``latent_basis``, ``latent_eigenvalue``, shape differences and
          ``distance_to_limit(shape)``, see :func:`s4a.method.median.median_shape`.  The attribute
          ``median`` is the name of the median shape;
        - ``/iterations/k_020`` and so on, with `keep_iterations`: ``fmap``, ``latent_basis``,
          ``latent_eigenvalue`` and the matches of eq. 3 for every size of the maps:
          ``matched_source`` and ``matched_target`` of all maps one after the other, and their
          number ``matched_count(pair)``.

    Raises
    ------
    ValueError
        If a mesh or the network lacks a variable, or an option is out of range.  k must be at least
        the size of the initial maps, and at most half of `n_samples` unless `n_samples` is 0.

    See Also
    --------
    build_network : Compute the initial maps.
    latent_map, latent_match : Maps and matches of any two shapes of the network.

    References
    ----------
    S. Melzi et al. (2019), ZoomOut: spectral upsampling for efficient shape correspondence, ACM
    Transactions on Graphics 38(6).
    R. Huang et al. (2020), Consistent ZoomOut: efficient spectral map synchronization, Computer
    Graphics Forum 39(5).

    Examples
    --------
    >>> import s4a
    >>> meshes = s4a.synthetic.brains(3, 200)["original"].children
    >>> coarse = {n: s4a.spectrum(s4a.coarsen(m.to_dataset(), n_coarse=100), k=10)
    ...           for n, m in meshes.items()}
    >>> tree = s4a.refine_network(coarse, s4a.build_network(coarse, k_init=6), k=10)
    >>> tree["latent/latent_basis"].shape, tree["latent"].attrs["median"] in coarse
    ((3, 10, 10), True)
    >>> network, names = tree["network"].to_dataset(), list(coarse)
    >>> source, target = ([names.index(n) for n in network[end].values]
    ...                   for end in ("source", "target"))
    >>> errors = {"initial": network["cycle_error_initial"], "refined": network["cycle_error"]}
    >>> errors = {title: error.values for title, error in errors.items()}
    >>> s4a.show.charts.network(s4a.show.charts.on_circle(3), names, source, target, errors)
    <Figure ...>
    """
    check("weights", weights)
    check("norm", norm)
    check_count("k", k, 1)
    check("step", step)
    if n_latent is not None and n_latent > k:
        raise ValueError(f"n_latent must be at most k = {k}; found {n_latent}")
    require(initial, "source", "target", "fmap_initial", what="network")
    check_coarse(coarse)
    bases, names = LazyBases(coarse), list(coarse)
    k = min([k, *(mesh.sizes["eigenpair"] for mesh in coarse.values())])
    source = np.array([names.index(name) for name in initial["source"].values])
    target = np.array([names.index(name) for name in initial["target"].values])
    C_initial = initial["fmap_initial"].values  # (p, k_init, k_init)
    if k < C_initial.shape[1]:
        raise ValueError(
            f"k must be at least {C_initial.shape[1]}, the size of the initial maps; found {k}"
        )
    iterations: dict[str, xr.Dataset] = {}
    history: list[tuple[int, Array, Array]] = []

    def keep(C, Y, latent_eigenvalue, weight, error):
        history.append((len(Y[0]), weight, error))
        if keep_iterations:
            result = dataset(
                fmap=C.astype(np.float32),
                latent_basis=Y,
                latent_eigenvalue=latent_eigenvalue,
                iteration_weight=weight,
                iteration_cycle_error=error,
            )
            result = result.merge(initial[["source", "target"]]).assign_coords(shape=names)
            iterations[f"iterations/k_{len(Y[0]):03d}"] = result.drop_attrs(deep=False)

    def keep_matches(matches, vertices):
        node = next(reversed(iterations))
        iterations[node] = iterations[node].merge(
            dataset(
                matched_source=np.concatenate(matches).astype(np.int32),
                matched_target=np.concatenate(vertices).astype(np.int32),
                matched_count=list(map(len, matches)),
            )
        )

    with threadpool_limits(1):
        C, weight, _, Y, latent_eigenvalue = consistent_zoomout(
            bases,
            C_initial,
            source,
            target,
            k,
            step=step,
            n_latent=n_latent,
            weights=weights,
            isometric=isometric,
            samples=[basis.sample_vertices_of(n_samples) for basis in bases],
            dense_iterations=dense_iterations,
            n_jobs=n_jobs,
            progress=progress,
            keep=keep,
            keep_matches=keep_matches if keep_iterations else None,
        )
    cycles = network.three_cycles(source.tolist(), target.tolist())
    iteration_size, iteration_weight, iteration_error = map(np.array, zip(*history, strict=True))
    refined = dataset(
        iteration_size=iteration_size,
        iteration_weight=iteration_weight,
        iteration_cycle_error=iteration_error,
        fmap=C.astype(np.float32),
        weight=weight,
        cycle_error=network.cycle_errors(C, cycles, k=C_initial.shape[1]),
        cycle_error_initial=network.cycle_errors(C_initial, cycles),
    )
    latent = dataset(latent_basis=Y, latent_eigenvalue=latent_eigenvalue)
    latent = latent.assign_coords(shape=names)
    eigenvalues = np.stack([mesh["eigenvalue"].values[:k] for mesh in coarse.values()])  # (n, k)
    return xr.DataTree.from_dict(
        {
            "network": initial.merge(refined),
            "latent": median_shape(latent, eigenvalues, norm=norm),
            **iterations,
        }
    )


class Study:
    """Nodes of a tree as Datasets: ``study["coarse/brain_01"]``.

    :class:`s4a.study.tasks.Folder` is the same for a folder, and reads on access.

    Parameters
    ----------
    tree : DataTree
    """

    def __init__(self, tree: xr.DataTree):
        check_type(tree, xr.DataTree)
        self.tree = tree

    def __contains__(self, node: str) -> bool:
        stage, _, name = node.partition("/")
        shapes = self.tree.children.get(stage)
        return shapes is not None and (not name or name in shapes.children)

    def __getitem__(self, node: str) -> xr.Dataset:
        return self.tree[node].to_dataset()


def shape_in(study: Study, name: str, **projection: Any) -> Shape:
    """Return a shape of a study at both resolutions.

    `projection` are the options of :class:`s4a.method.shape.Shape`.
    """
    for stage in ("original", "coarse"):
        if f"{stage}/{name}" not in study:
            raise ValueError(f"a study with /{stage}/{name} is needed; this one has none")
    return Shape(study[f"original/{name}"], study[f"coarse/{name}"], **projection)


def basis_in(study: Study, name: str) -> Basis:
    """Return the coarse mesh of a shape, centred and of unit area, with its eigenfunctions."""
    return Shape(coarse=study[f"coarse/{name}"]).low


def template_of(study: xr.DataTree) -> str:
    """Return the name of the template of a study; the median shape if nothing is registered yet."""
    if "registration" in study and "template" in study["registration"].attrs:
        return study["registration"].attrs["template"]
    return study["latent"].attrs["median"]


def transform_in(study: Study, name: str) -> Any:
    """Return the rigid transform (R, t) of a shape onto the reference of the network, or None.

    A shape outside the network is aligned now if the study lacks its transform.
    """
    if f"network/alignment_{name}" in study:
        alignment = study[f"network/alignment_{name}"]
        return alignment["rotation"].values, alignment["translation"].values
    network = study["network"] if "network" in study else xr.Dataset()
    if "icp_rotation" not in network:
        return None
    if name in network["shape"]:
        alignment = network.sel(shape=name)
        return alignment["icp_rotation"].values, alignment["icp_translation"].values
    return transform_onto(
        shape_in(study, name).low, shape_in(study, network.attrs["reference"]).low
    )


def latent_bases(study: Study, *names: str) -> tuple[Any, ...]:
    """Return the latent bases Y ``(k, m)`` of some shapes of a study.

    Shapes of the network have them in ``/latent``, out-of-sample shapes in ``/latent/<shape>``.
    """
    latent, bases = study["latent"], []
    require(latent, "latent_basis", what="latent dataset")
    for name in names:
        if f"latent/{name}" in study:
            bases.append(study[f"latent/{name}"]["latent_basis"].values)
        elif name in (members := latent["shape"].values.tolist()):
            bases.append(latent["latent_basis"].values[members.index(name)])
        else:
            raise ValueError(f"no shape {name!r} in the network; it has {', '.join(members)}")
    return tuple(bases)


def out_of_sample_basis_in(
    study: Study,
    names: Sequence[str],
    basis: Basis,
    transforms: Callable[[str], RigidTransform],
    **options: Any,
) -> Array:
    """Compute the latent basis Y ``(k, m)`` of an out-of-sample shape (eq. 3).

    Parameters
    ----------
    study : Study
        With ``/latent`` and ``/coarse``.
    names : sequence of str
        Shapes of the network; the first is always used.
    basis : Basis
        Low resolution of the shape.
    transforms : callable
        Returns the rigid transform of the shape onto the shape of a given name.
    **options
        Options of :func:`s4a.method.latent.out_of_sample_basis`.
    """
    spectra = [study[f"coarse/{name}"]["eigenvalue"].values for name in names]
    near = [names[i] for i in nearest_spectra(basis.eigenvalue, spectra, options["k_init"])]
    bases = [basis_in(study, name) for name in near]
    Y = np.stack(latent_bases(study, *near))
    return out_of_sample_basis(basis, bases, Y, [transforms(name) for name in near], **options)


def register_in(
    study: Study,
    name: str,
    template: str,
    target: Shape,
    initial_transform: RigidTransform | None = None,
    alignment: str = "search",
    **options: Any,
) -> xr.Dataset:
    """Register a shape to `target`, the shape of the template; see :func:`register_shape`."""
    if name == template:
        return identity(target)
    projection = {option: getattr(target, option) for option in PROJECTION}
    source = shape_in(study, name, **projection)
    bases = latent_bases(study, name, template)
    M, N = source.low, target.low
    if initial_transform is None and alignment == "search":
        transforms = transform_in(study, name), transform_in(study, template)
        initial_transform = relative_transform(*transforms) if all(transforms) else None
    transform = transform_onto(M, N, alignment, initial_transform)
    return from_latent(source, target, bases, transform, **options)


def latent_match(
    study: xr.DataTree, source: str, target: str, *, dense_match: str = "latent", full: bool = True
) -> xr.Dataset:
    """Match any two shapes of a network by their latent bases (eq. 3 and 6; eq. 7 or 4).

    Parameters
    ----------
    study : xarray.DataTree
        With ``/original``, ``/coarse`` and ``/latent``.
    source, target : str
        Names of shapes.
    dense_match : {"latent", "fmap"}
        Match at full resolution by the latent bases (eq. 7); or by eq. 4, with the functional map
        that eq. 3 gives.
    full : bool
        If True, match original vertices.  If False, match low-resolution vertices by eq. 3.

    Returns
    -------
    xarray.Dataset
        ``match(vertex)``: matched vertex of the source for each vertex of the target.

    Raises
    ------
    ValueError
        If a shape is not in the study, or `dense_match` is unknown.

    See Also
    --------
    latent_map : Functional map of any two shapes.
    register_shape : Registration to the template, which is more accurate.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> match = s4a.latent_match(study, "brain_01", "brain_02")["match"]
    >>> match.sizes["vertex"] == study["original/brain_02"].sizes["vertex"]
    True
    """
    nodes = Study(study)
    shapes = shape_in(nodes, source), shape_in(nodes, target)
    match, functions = match_low(
        *shapes, latent_bases(nodes, source, target), dense_match=dense_match
    )
    if full:
        match, *_ = match_functions(*shapes, *functions)
    return dataset(match=match)


def latent_map(study: xr.DataTree, source: str, target: str) -> xr.Dataset:
    """Compute the functional map of any two shapes of a network, C_ij = Y_j Y_i^+ (3.4).

    The pair need not be an edge of the network.  Latent maps are consistent along every cycle.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/latent``.
    source, target : str
        Names of shapes.

    Returns
    -------
    xarray.Dataset
        ``fmap(eigenpair_target, eigenpair_source)``: the matrix C that maps coefficients of
        functions on the source to coefficients on the target.

    Raises
    ------
    ValueError
        If a shape is not in the study.

    See Also
    --------
    latent_match : Match of any two shapes.
    refine_network : Compute the latent bases.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> C = s4a.latent_map(study, "brain_01", "brain_01")["fmap"].values
    >>> np.allclose(C, np.eye(len(C)))
    True
    >>> there = s4a.latent_map(study, "brain_01", "brain_02")["fmap"].values
    >>> s4a.show.charts.matrices({"C of a shape to itself": C, "brain 1 to 2": there})
    <Figure ...>
    """
    Y_source, Y_target = latent_bases(Study(study), source, target)
    return dataset(fmap=Y_target @ np.linalg.pinv(Y_source))


def register_shape(
    study: xr.DataTree,
    name: str,
    template: str | None = None,
    *,
    initial_transform: RigidTransform | None = None,
    **options: Any,
) -> xr.Dataset:
    """Register one shape of a study to the template (4.2; eq. 6, 7 and 8).

    Parameters
    ----------
    study : xarray.DataTree
        With ``/original``, ``/coarse`` and ``/latent``.  Defaults of the other parameters are taken
        from ``/network``, ``/registration`` and ``/report`` if the study has these nodes.
    name : str
        Name of the shape.
    template : str, optional
        By default the template of the study, or the median shape if nothing is registered yet.
    initial_transform : tuple (R, t), optional
        Approximate rigid transform R x + t of the shape onto the template.  Both are centred and
        scaled to unit area.  The default is the alignment of the network, or ICP from the principal
        axes if there is none.
    **options
        Those of :class:`s4a.Options` for registrations, such as ``dense_match`` and ``refine``;
        the message about another one lists them.  Options that are missing or None have the values
        in the report of the study, or their defaults if there is no report.

    Returns
    -------
    xarray.Dataset
        Displacements are in the frame of the template and in the unit of the input.

        - ``registered_match(vertex)``: matched vertex of the shape for each vertex of the template;
        - ``displacement(vertex, xyz)``: from the template to the registered surface;
        - ``displacement_raw(vertex, xyz)``: from the template to the matched vertices;
        - ``registered_match_low(low_vertex)`` and ``displacement_low``: match by eq. 6 and its
          displacement at low resolution;
        - ``displacement_coefficient(eigenpair, xyz)``: projection of the displacement onto U Phi of
          the template;
        - ``icp_rotation`` and ``icp_translation``: rigid transform by ICP;
        - ``rotation``, ``translation`` and ``scale``: alignment of the shape to the template;
        - ``confidence(vertex)``: estimated probability of an error below 1 % of sqrt(area);
        - ``round_trip(vertex)``: error of the match in both directions, and
          ``distortion(vertex)``, the log area ratio;
        - ``template_triangle(original_vertex)`` and ``template_barycentric``: triangle and
          barycentric coordinates on the template for each vertex of the shape.

        The attribute ``initialisation`` is the name of the initialisation with the best ``score``.

    Raises
    ------
    ValueError
        If a shape is not in the study, or an option has an unknown value.
    TypeError
        If an option is unknown.

    See Also
    --------
    s4a.register_pairs : Register shapes to each other without a study.
    s4a.insert : Register new shapes to the template of a study.
    latent_match : The spectral match alone.

    References
    ----------
    B. Amberg, S. Romdhani and T. Vetter (2007), Optimal step nonrigid ICP algorithms for surface
    registration, CVPR.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.register_shape(study, "brain_02")["displacement"].dims
    ('vertex', 'xyz')
    """
    unknown = [option for option in options if option not in REGISTRATION]
    if unknown:
        raise TypeError(
            f"unexpected options {', '.join(unknown)}; those of a registration are "
            f"{', '.join(REGISTRATION)}"
        )
    check_type(study, xr.DataTree)
    kept = {name: value for name, value in kept_options(study).items() if name in REGISTRATION}
    options = kept | {name: check(name, v) for name, v in options.items() if v is not None}
    projection = {key: options.pop(key) for key in PROJECTION if key in options}
    template = template_of(study) if template is None else template
    target = shape_in(Study(study), template, **projection)
    with threadpool_limits(1):
        return register_in(Study(study), name, template, target, initial_transform, **options)
