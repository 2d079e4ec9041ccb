"""Multi-structure studies (6.1): variation in relative pose and in shape.

All registered surfaces of a subject are in the frame of its scan.  Each subject is aligned as a
whole to the mean (generalised Procrustes, Gower 1975).  Then structure k of subject i is

    Y_ik = exp(w_ik) (S_k + v_ik - g_k) + g_k + t_ik

with its mean shape S_k of centroid g_k, a pose relative to the whole, which is a rotation vector
w_ik and a translation t_ik (Bossa and Olmos 2006), and the residual shape v_ik (least squares).
Poses are compared as displacement fields in the unit of the surfaces,
d_ik = w_ik x (S_k - g_k) + t_ik.  The optimal pose leaves a v_ik without translation and rotation,
sum_p a_p v_ik = 0 and sum_p a_p (S_k - g_k) x v_ik = 0 under the areas a_p of the vertices.  The
two levels are therefore orthogonal and their variances add up exactly:

    sum |d + v|^2 = sum |d|^2 (between structures) + sum |v|^2 (within structures).

These are the two levels of multi-level component analysis (Timmerman 2006; for shapes in
ShapeWorks, Iyer et al. 2022, whose poses are the positions of the centres only; for organs at
several resolutions Cerrolaza et al. 2015).  A structure is weighted by its area.
"""

import itertools
import logging
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from s4a.analysis.inputs import registration_of
from s4a.analysis.permutation import check_permutations
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.align import rigid_transform
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.input.chirality import MIRROR, map_to_file
from s4a.input.coordinates import file_system, map_between, moved
from s4a.input.subjects import listed
from s4a.method.pca import center_gram, gram, pca, principal_components
from s4a.options import MILLIMETRES
from s4a.schema import check_switch, covariate, dataset, in_unit, unit_of
from s4a.seeds import RNG, seed_of
from s4a.study.insert import scores_of_new
from s4a_morphometrics.several import of_structure, structure_names, subject_systems
from s4a_morphometrics.two_block import coordinates, two_block

log = logging.getLogger(__name__)

LEVELS = ("joint", "between", "within")
MOST_STEPS, CLOSE = 200, 1e-12  # iterations of the mean; tolerance, relative to the size
FAR, LEAST = 6, 0.1  # a pose is reported above FAR times the median, and LEAST times the size
SAME_CENTRE = 1e-3  # relative to the size: files may have been centred
MOST_RATIO = 300  # of sizes: units may differ


class Poses(NamedTuple):
    """Mean shape, poses and shapes of one structure of s subjects.

    ``mean (n, 3)``; ``rotation (s, 3)``, rotation vectors about the centroid of the mean, and
    ``translation (s, 3)``, both of mean zero; ``shape (s, n, 3)``, displacements of the mean.
    """

    mean: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    shape: np.ndarray


def align_wholes(Y: np.ndarray, area: np.ndarray, *, remove_size: bool = False) -> np.ndarray:
    """Align whole subjects rigidly to their mean (generalised Procrustes).

    Parameters
    ----------
    Y : float ndarray (s, n, 3)
        Corresponding points of the subjects.
    area : float ndarray (n,)
        Their weights.
    remove_size : bool
        Scale all subjects to the mean centroid size first.

    Returns
    -------
    float ndarray (s, n, 3)

    References
    ----------
    J. C. Gower (1975), Generalized Procrustes analysis, Psychometrika 40(1).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.poses import align_wholes
    >>> Y = np.eye(4)[:, 1:] * [1, 2, 3]
    >>> rotated = Y[:, [1, 2, 0]] + 5  # by 120 degrees
    >>> first, second = align_wholes(np.stack([Y, rotated]), np.ones(4))
    >>> np.allclose(first, second)
    True
    """
    w = area / area.sum()
    Y = Y - np.einsum("n,snx->sx", w, Y)[:, None]
    size = np.sqrt(np.einsum("n,snx->s", w, Y**2))
    if remove_size:
        Y = Y * (size.mean() / size)[:, None, None]
    mean = Y[0]
    for _ in range(MOST_STEPS):
        for i, points in enumerate(Y):
            R, _, _ = rigid_transform(points, mean, w)
            Y[i] = points @ R.T
        before, mean = mean, Y.mean(0)
        if abs(mean - before).max() < CLOSE * size.max():
            break
    return Y


def poses_of(Y: np.ndarray, area: np.ndarray) -> Poses:
    """Separate the pose of a structure from its shape in every subject.

    Parameters
    ----------
    Y : float ndarray (s, n, 3)
        The structure in the aligned subjects.
    area : float ndarray (n,)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.poses import poses_of
    >>> Y = np.eye(4)[:, 1:] * [1.0, 2, 3]
    >>> result = poses_of(np.stack([Y + [1, 0, 0], Y - [1, 0, 0]]), np.ones(4))
    >>> result.translation.round(6)[:, 0].tolist(), bool(abs(result.shape).max() < 1e-9)
    ([1.0, -1.0], True)
    """
    w = area / area.sum()
    mean = Y.mean(0)
    size = np.sqrt(w @ ((mean - w @ mean) ** 2).sum(1))
    for _ in range(MOST_STEPS):
        g = w @ mean
        _, rotation, t, shape = poses_on(mean, Y, w)
        step = shape.mean(0), rotation.mean(0), t.mean(0)
        if max(abs(step[0]).max(), abs(step[1]).max() * size, abs(step[2]).max()) < CLOSE * size:
            break
        mean = (mean + step[0] - g) @ Rotation.from_rotvec(step[1]).as_matrix().T + g + step[2]
    return Poses(mean, rotation, t, shape)


def poses_on(mean: np.ndarray, Y: np.ndarray, area: np.ndarray) -> Poses:
    """Separate poses from shapes of a structure, relative to a given mean shape.

    Parameters
    ----------
    mean : float ndarray (n, 3)
    Y : float ndarray (s, n, 3)
    area : float ndarray (n,)
    """
    w = area / area.sum()
    g = w @ mean
    R = np.stack([rigid_transform(mean, points, w)[0] for points in Y])
    t = np.einsum("n,snx->sx", w, Y) - g  # of the centroid
    shape = np.einsum("snx,sxy->sny", Y - (g + t)[:, None], R) - (mean - g)
    return Poses(mean, Rotation.from_matrix(R).as_rotvec(), t, shape)


def wholes_of(result: xr.Dataset) -> np.ndarray:
    """Return the aligned subjects ``(s, n, 3)``, all structures together: Y_ik above."""
    Y = np.empty(result["within_displacement"].shape)
    for k, vertices in enumerate(vertices_of(result)):
        poses = poses_in(result, k, vertices)
        area = result["vertex_area"].values[vertices]
        g = area @ poses.mean / area.sum()
        R = Rotation.from_rotvec(poses.rotation).as_matrix()
        rotated = np.einsum("sxy,sny->snx", R, poses.mean - g + poses.shape)
        Y[:, vertices] = rotated + (g + poses.translation)[:, None]
    return Y


def poses_in(result: xr.Dataset, k: int, vertices: np.ndarray) -> Poses:
    """Return the poses of structure k, with these vertices, from a result of :func:`structures`."""
    return Poses(
        result["position"].values[vertices],
        result["pose_rotation"].values[:, k],
        result["pose_translation"].values[:, k],
        result["within_displacement"].values[:, vertices],
    )


def vertices_of(result: xr.Dataset) -> list[np.ndarray]:
    """Return the vertices of each structure in a result of :func:`structures`."""
    structure = result["structure_of_vertex"].values
    return [np.flatnonzero(structure == k) for k in range(result.sizes["structure"])]


def pose_fields(
    mean: np.ndarray, area: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Return displacements of a mean shape by poses, w x (S - g) + t, ``(s, n, 3)``.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.poses import pose_fields
    >>> X = np.array([[1.0, 0, 0], [-1, 0, 0]])
    >>> pose_fields(X, np.ones(2), np.array([[0, 0, 0.1]]), np.zeros((1, 3)))[0].tolist()
    [[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]
    """
    arm = mean - (area / area.sum()) @ mean
    return np.cross(rotation[:, None], arm[None]) + translation[:, None]


def structures(
    study: xr.DataTree,
    *,
    remove_size: bool = False,
    n_permutations: int = 999,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Separate the variation of structures in relative pose from that in shape.

    Parameters
    ----------
    study : DataTree
        From :func:`s4a_morphometrics.analyse_structures`.
    remove_size : bool
        Remove the size of each subject, all structures together.
    n_permutations : int
        Permutations of the subjects in the test of covariation of poses and shapes.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        ``position(vertex, xyz)``, the mean shapes of all structures in their mean poses as one
        mesh, ``vertex_area`` and ``structure_of_vertex``.
        ``pose_rotation(shape, structure, xyz)``, rotation vectors about the structure's centroid in
        the frame of the mean subject, ``pose_translation`` and ``pose_size``, the root mean square
        displacement by both;
        ``within_displacement(shape, vertex, xyz)``, the shapes without their poses.
        ``level_variance(structure, level)`` of both levels, mean square over the area of all
        structures, and ``level_share``, which add up to 1.  ``score``, ``standard_deviation``,
        ``explained_variance_ratio`` and ``between_share(component)``, the share of poses, of the
        joint components.  ``pose_shape_rv``, the RV coefficient of poses and shapes, and its
        ``pose_shape_p``; NaN if one of the two does not vary.
        A shape is a subject; subjects that lack a structure are left out, with a warning.

    Raises
    ------
    ValueError
        If the study has one structure only, fewer than 4 subjects have all structures, units
        differ, or nothing varies.

    See Also
    --------
    structures_modes : modes of variation of one level.
    structures_of_new : poses and shapes of new subjects.
    s4a_morphometrics.two_block : the RV coefficient and its test.

    Notes
    -----
    Noise of the registration counts as variation within structures.  So does the size of each
    structure, also the size that all structures share, unless `remove_size`.  If the surfaces of a
    subject are not in one frame, for example because every file was centred, the relative poses are
    lost.  This is reported only if all centres coincide.

    References
    ----------
    M. N. Bossa and S. Olmos (2006), Statistical model of similarity transformations; M. E.
    Timmerman (2006), Multilevel component analysis; see :mod:`s4a_morphometrics.poses`.

    Examples
    --------
    With a ``study`` of two small structures of six subjects:

    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> study = example_structures()
    >>> result = s4a_morphometrics.structures(study, n_permutations=99)
    >>> float(result["level_share"].sum().round(6)), result.sizes["shape"]
    (1.0, 6)
    """
    seed = seed_of(seed, rng)
    check_permutations(n_permutations)
    check_switch("remove_size", remove_size)
    names = structure_names(study)
    registered = {name: registration_of(of_structure(study, name)) for name in names}
    shapes = shared_subjects(registered)
    Y, unit = positions(study, registered, shapes)
    meshes = [as_arrays(registered[name]) for name in names]
    lengths = [MILLIMETRES.get(unit_of(registered[n]["position"]), 1.0) for n in names]
    areas = [  # in the unit of Y
        vertex_areas(X * (length / MILLIMETRES.get(unit, 1.0)), T)
        for (X, T), length in zip(meshes, lengths, strict=True)
    ]
    report_frames(names, Y, areas)
    report_centred(study, names, shapes)
    counts = [len(area) for area in areas]
    vertices = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    area = np.concatenate(areas)
    whole = align_wholes(np.concatenate(Y, axis=1), area, remove_size=remove_size)
    del Y
    each = [poses_of(whole[:, v], area[v]) for v in vertices]
    report_poses(names, shapes, each, areas, each)
    triangles = [T + v[0] for (_, T), v in zip(meshes, vertices, strict=True)]
    result = measure_levels(each, areas, n_permutations=n_permutations, seed=seed)
    mesh = as_dataset(
        np.concatenate([poses.mean for poses in each]), np.concatenate(triangles), vertex_area=area
    )
    result = in_unit(result.merge(mesh), unit)
    return result.assign_coords(shape=shapes, structure=names, level=list(LEVELS[1:])).assign_attrs(
        remove_size=str(remove_size), permutations=n_permutations
    )


def positions(
    study: xr.DataTree, registered: dict[str, xr.Dataset], shapes: list[str], unit: str = ""
) -> tuple[list[np.ndarray], str]:
    """Return the registered surfaces of each structure, in one system per subject, and the unit.

    Parameters
    ----------
    study : DataTree
    registered : dict of str to Dataset
        Registrations by structure.
    shapes : list of str
        The subjects.
    unit : str
        The unit to convert to, if it is known.

    Returns
    -------
    list of float ndarray (s, n, 3)
        Mirrored subjects are mirrored in the coordinates of the subject.
    str
    """
    attrs: dict[str, dict[str, Any]] = {}
    for name in registered:
        part = of_structure(study, name)
        meshes = part["original"].children if "original" in part.children else {}
        attrs[name] = {shape: meshes[shape].attrs if shape in meshes else {} for shape in shapes}
    files = {name: {s: file_system(a) for s, a in own.items()} for name, own in attrs.items()}
    targets = subject_systems(files)
    known = next(iter(targets.values())).unit
    Y = []
    for name, data in registered.items():
        surfaces = []
        for shape in shapes:
            of_mesh, to_file = attrs[name][shape], map_to_file(attrs[name][shape])
            target = replace(targets[shape], unit=unit if known and unit else known)
            M = map_between(files[name][shape], target, f"{shape} ({name})") @ to_file
            M = np.diag([*MIRROR, 1.0]) @ M if of_mesh.get("reflected") else M
            X = image_in_shape(data["position"].values, data.sel(shape=shape))
            surfaces.append(moved(X, M))
        Y.append(np.stack(surfaces))
    return Y, (unit or known) if known else shared_unit(registered)


def measure_levels(
    each: list[Poses], areas: list[np.ndarray], *, n_permutations: int = 999, seed: int = 0
) -> xr.Dataset:
    """Return the variables of :func:`structures` for the poses and shapes of some structures."""
    total = float(sum(area.sum() for area in areas))
    s = len(each[0].rotation)
    kernels = np.empty((len(each), 2, s, s))  # inner products of poses, of shapes
    size = np.empty((s, len(each)))
    fields = []
    reach = 0.0  # mean square distance from the origin
    for k, (poses, area) in enumerate(zip(each, areas, strict=True)):
        d = pose_fields(poses.mean, area, poses.rotation, poses.translation)
        pose_gram = gram(d, area)
        size[:, k] = np.sqrt(np.diag(pose_gram))
        share = area.sum() / total
        kernels[k] = share * center_gram(pose_gram), share * center_gram(gram(poses.shape, area))
        fields.append(d)
        reach += float((poses.mean**2).sum(1) @ area) / total
    variance = np.trace(kernels, axis1=2, axis2=3) / (s - 1)  # (structure, level)
    K = kernels.sum((0, 1))
    if variance.sum() <= 1e-18 * reach:
        raise ValueError("structures need subjects that differ; all are equal")
    values, V = principal_components(K)
    between_share = np.einsum("sc,st,tc->c", V, kernels[:, 0].sum(0), V) / (values * (s - 1))
    rv: float | np.ndarray = np.nan
    p: float | np.ndarray = np.nan
    totals = variance.sum(0)
    if totals.min() > 1e-15 * totals.max():
        all_areas = np.concatenate(areas)
        blocks = (np.concatenate(fields, 1), np.concatenate([poses.shape for poses in each], 1))
        A, B = (coordinates(block, all_areas / total) for block in blocks)
        pls = two_block(A, B, n_permutations=n_permutations, seed=seed)
        rv, p = pls["rv"], pls["rv_p"]
    counts = [len(poses.mean) for poses in each]
    return dataset(
        structure_of_vertex=np.repeat(np.arange(len(each)), counts),
        pose_rotation=np.stack([poses.rotation for poses in each], axis=1),
        pose_translation=np.stack([poses.translation for poses in each], axis=1),
        pose_size=size,
        within_displacement=np.concatenate([poses.shape for poses in each], 1).astype(np.float32),
        level_variance=variance,
        level_share=variance / variance.sum(),
        score=V * np.sqrt(s - 1),
        standard_deviation=np.sqrt(values),
        explained_variance_ratio=values / values.sum(),
        between_share=between_share,
        pose_shape_rv=rv,
        pose_shape_p=p,
    )


def structures_of_new(result: xr.Dataset, inserted: xr.DataTree) -> xr.Dataset:
    """Return relative poses and shapes of the structures of new subjects.

    Each new subject is aligned as a whole to the mean of the study, which stays unchanged; the
    pose of each structure is relative to its mean shape.  For a subject of the study the result is
    that of :func:`structures`.

    Parameters
    ----------
    result : Dataset
        From :func:`structures`, for the study.
    inserted : DataTree
        From :func:`s4a_morphometrics.insert_structures` into the same study.

    Returns
    -------
    Dataset
        ``pose_rotation``, ``pose_translation``, ``pose_size`` and ``within_displacement`` of the
        new subjects, and the mean shapes of the study, as in :func:`structures`.  Subjects that
        lack a structure are left out, with a warning.

    Raises
    ------
    ValueError
        If a structure of the study has no new shape, no new subject has all structures, or the
        shapes were registered to another template or in another unit.

    See Also
    --------
    structures_modes : scores of the new subjects.

    Examples
    --------
    With a ``study`` of two small structures of six subjects, inserted into itself:

    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> study = example_structures()
    >>> result = s4a_morphometrics.structures(study, n_permutations=99)
    >>> new = s4a_morphometrics.structures_of_new(result, study)
    >>> bool(abs(new["pose_size"] - result["pose_size"]).max() < 1e-4 * result["pose_size"].max())
    True
    """
    names = result["structure"].values.tolist()
    if structure_names(inserted) != names:
        raise ValueError(
            f"new shapes of {listed(names)} needed, found {listed(structure_names(inserted))}"
        )
    registered = {name: registration_of(of_structure(inserted, name)) for name in names}
    shapes = shared_subjects(registered, least=1)
    unit = unit_of(result["position"])
    Y_of, unit_of_new = positions(inserted, registered, shapes, unit)
    if unit_of_new != unit:
        raise ValueError(f"new shapes in {unit} needed, found {unit_of_new}")
    vertices = vertices_of(result)
    counts = [len(v) for v in vertices]
    others = [registered[name].sizes["vertex"] for name in names]
    if others != counts:
        raise ValueError(
            "shapes inserted into the same study needed, with templates of "
            f"{listed([str(n) for n in counts])} vertices; found {listed([str(n) for n in others])}"
        )
    area, aligned = result["vertex_area"].values, wholes_of(result)
    w = area / area.sum()
    mean = aligned.mean(0)
    center, size = w @ mean, np.sqrt(w @ (aligned[0] ** 2).sum(1))
    whole = np.empty((len(shapes), len(mean), 3))
    for i in range(len(shapes)):
        Y = np.concatenate([surfaces[i] for surfaces in Y_of])
        Y -= w @ Y
        R, _, _ = rigid_transform(Y, mean, w)
        if result.attrs["remove_size"] == "True":
            Y *= size / np.sqrt(w @ (Y**2).sum(1))  # all subjects of the study have one size
        whole[i] = Y @ R.T + center
    each = [poses_on(result["position"].values[v], whole[:, v], area[v]) for v in vertices]
    usual = [poses_in(result, k, v) for k, v in enumerate(vertices)]
    report_poses(names, shapes, each, [area[v] for v in vertices], usual)
    d = [
        pose_fields(poses.mean, area[v], poses.rotation, poses.translation)
        for v, poses in zip(vertices, each, strict=True)
    ]
    weights = [area[v] / area[v].sum() for v in vertices]
    size = [np.sqrt(np.einsum("snx,n->s", f**2, a)) for f, a in zip(d, weights, strict=True)]
    new = dataset(
        pose_rotation=np.stack([poses.rotation for poses in each], axis=1),
        pose_translation=np.stack([poses.translation for poses in each], axis=1),
        pose_size=np.stack(size, axis=1),
        within_displacement=np.concatenate([poses.shape for poses in each], 1).astype(np.float32),
    )
    mesh = result[["position", "corner_vertex", "vertex_area", "structure_of_vertex"]]
    mesh = mesh.drop_vars(["shape", "level"], errors="ignore")
    new = in_unit(mesh.merge(new), unit).assign_coords(shape=shapes, structure=names)
    return new.assign_attrs(remove_size=result.attrs["remove_size"])


def structures_modes(
    study: xr.DataTree, result: xr.Dataset, level: str = "joint", new: xr.Dataset | None = None
) -> xr.DataTree:
    """Return one level of :func:`structures` as a study of all structures together.

    Every function that takes a study accepts it.  For example, :func:`s4a.statistics.group_test`
    of the level "between" tests groups for differences in relative pose.

    Parameters
    ----------
    study : DataTree
        From :func:`s4a_morphometrics.analyse_structures`.
    result : Dataset
        From :func:`structures`.
    level : {"joint", "between", "within"}
        Poses and shapes, poses only, or shapes only.
    new : Dataset, optional
        From :func:`structures_of_new`: the tree then has the new shapes, with their scores on the
        modes of the study.

    Returns
    -------
    DataTree
        ``/registration`` with all structures as one mesh, one shape per subject, and its
        displacements; ``/pca``; and ``/subjects``, the columns in which all structures of a
        subject agree.

    Raises
    ------
    ValueError
        If there is no such level, or it does not vary.

    See Also
    --------
    structures : the decomposition into levels.

    Notes
    -----
    Rotations are drawn to first order: at 15 degrees a structure appears 3 % larger.

    Examples
    --------
    With a ``study`` of two small structures of six subjects:

    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> study = example_structures()
    >>> result = s4a_morphometrics.structures(study, n_permutations=99)
    >>> poses = s4a_morphometrics.structures_modes(study, result, "between")
    >>> poses["pca"].sizes["component"]
    5
    """
    if level not in LEVELS:
        raise ValueError(f"level must be one of {', '.join(LEVELS)}; found {level!r}")
    registration = level_registration(result, level)
    try:
        modes = pca(registration, result["vertex_area"].values)
    except ValueError as error:
        raise ValueError(f"{level}: {error}") from error
    modes = modes.assign_attrs(variable=level)
    if new is not None:
        registration = level_registration(new, level)
        modes = scores_of_new(modes, registration, result["vertex_area"].values)
    nodes = {"/registration": registration, "/pca": modes}
    subjects = (
        xr.Dataset() if new is not None else shared_columns(study, result["shape"].values.tolist())
    )
    if subjects.data_vars:
        nodes["/subjects"] = subjects
    return xr.DataTree.from_dict(nodes, name=study.name)


def level_registration(result: xr.Dataset, level: str) -> xr.Dataset:
    """Return the displacements of one level, on all structures as one mesh."""
    area = result["vertex_area"].values
    d = np.zeros(result["within_displacement"].shape)
    if level != "between":
        d += result["within_displacement"].values
    if level != "within":
        for k, vertices in enumerate(vertices_of(result)):
            d[:, vertices] += pose_fields(
                result["position"].values[vertices],
                area[vertices],
                result["pose_rotation"].values[:, k],
                result["pose_translation"].values[:, k],
            )
    mesh = result[["position", "corner_vertex", "vertex_area", "structure_of_vertex"]]
    registration = mesh.assign_attrs(level=level, structures=" ".join(result["structure"].values))
    registration = registration.merge(dataset(displacement=d.astype(np.float32)))
    registration = in_unit(registration, unit_of(result["position"]))
    registration = registration.drop_vars(["structure", "level"], errors="ignore")
    return registration.assign_coords(shape=result["shape"].values)


# subjects and columns that all structures have in common


def shared_subjects(registered: dict[str, xr.Dataset], least: int = 4) -> list[str]:
    """Return subjects with all structures registered; a warning names the others."""
    having = {name: data["shape"].values.tolist() for name, data in registered.items()}
    everyone = sorted({subject for subjects in having.values() for subject in subjects})
    lacking = {
        subject: [name for name, subjects in having.items() if subject not in subjects]
        for subject in everyone
    }
    complete = [subject for subject, names in lacking.items() if not names]
    others = [f"{subject} (no {listed(names)})" for subject, names in lacking.items() if names]
    if others:
        log.warning(
            "left out, because a structure is missing or flagged: %s",
            listed(others, "; ", most=9),
        )
    if len(complete) < least:
        raise ValueError(
            f"at least {least} subjects with all structures needed, found "
            f"{len(complete)} of {len(everyone)}{'; ' if others else ''}{listed(others, '; ')}"
        )
    return complete


def shared_unit(registered: dict[str, xr.Dataset]) -> str:
    """Return the unit of all structures; ValueError if units differ."""
    units = {name: unit_of(data["displacement"]) for name, data in registered.items()}
    if len(set(units.values())) > 1:
        each = [f"{name}: {unit}" for name, unit in units.items()]
        raise ValueError(f"structures need one unit; found {listed(each)}")
    return next(iter(units.values()))


def shared_columns(study: xr.DataTree, shapes: list[str]) -> xr.Dataset:
    """Return columns of ``/subjects`` in which all structures of each subject agree."""
    tables = []
    for name in structure_names(study):
        part = of_structure(study, name)
        if "subjects" not in part.children:
            return xr.Dataset()
        tables.append(part["subjects"].to_dataset().sel(shape=shapes))
    first = tables[0]
    same = {
        str(name): covariate(str(name), first[name].values)
        for name in first.data_vars
        if all(name in table and _same(table[name], first[name]) for table in tables)
    }
    return xr.Dataset(same, {"shape": shapes}, first.attrs)


def _same(a, b):
    if {a.dtype.kind, b.dtype.kind} <= set("iuf"):
        return np.array_equal(a.values, b.values, equal_nan=True)
    return np.array_equal(a.values, b.values)


def report_frames(names: list[str], Y: list[np.ndarray], areas: list[np.ndarray]) -> None:
    """Warn if structures do not seem to be in one frame, or in one unit."""
    centre = [np.einsum("n,snx->sx", a / a.sum(), y) for y, a in zip(Y, areas, strict=True)]
    size = [
        np.sqrt(np.einsum("n,snx->s", a / a.sum(), (y - c[:, None]) ** 2)).mean()
        for y, a, c in zip(Y, areas, centre, strict=True)
    ]
    largest, smallest = int(np.argmax(size)), int(np.argmin(size))
    if size[largest] > MOST_RATIO * size[smallest]:
        log.warning(
            "%s is %.0f times as large as %s: are both in the same unit?",
            names[largest],
            size[largest] / size[smallest],
            names[smallest],
        )
    for k in range(1, len(names)):
        if np.linalg.norm(centre[k] - centre[0], axis=1).max() < SAME_CENTRE * size[smallest]:
            log.warning(
                "%s and %s have the same centre in every subject: were their files centred? Then "
                "their relative pose is lost",
                names[0],
                names[k],
            )


def report_centred(study: xr.DataTree, names: list[str], shapes: list[str]) -> None:
    """Warn if the vertices of every file have their mean, or their middle, at the origin."""
    far = []
    for name, shape in itertools.product(names, shapes):
        part = of_structure(study, name)
        meshes = part["original"].children if "original" in part.children else {}
        if shape not in meshes or "position" not in meshes[shape].data_vars:
            return
        mesh = meshes[shape].dataset
        X = moved(mesh["position"].values, map_to_file(mesh.attrs))
        middles = np.stack([X.mean(0), (X.min(0) + X.max(0)) / 2])
        far.append(np.linalg.norm(middles, axis=1) / np.ptp(X, axis=0).max())
    if (np.max(far, axis=0) < SAME_CENTRE).any():
        log.warning(
            "every file of %s has its centre at the origin: were they centred one by one? Then "
            "their relative pose is lost",
            listed(names),
        )


def report_poses(
    names: list[str],
    shapes: list[str],
    each: list[Poses],
    areas: list[np.ndarray],
    usual_poses: list[Poses],
) -> None:
    """Warn about structures with an unusual pose."""
    far = np.zeros((len(shapes), len(names)))

    def distances(poses, reference, area):
        rotation = poses.rotation - np.median(reference.rotation, axis=0)
        translation = poses.translation - np.median(reference.translation, axis=0)
        d = pose_fields(poses.mean, area, rotation, translation)
        return np.sqrt(np.einsum("n,snx->s", area / area.sum(), d**2))

    for k, (poses, reference, area) in enumerate(zip(each, usual_poses, areas, strict=True)):
        distance = distances(poses, reference, area)
        arm = poses.mean - (area / area.sum()) @ poses.mean
        size = np.sqrt((area / area.sum()) @ (arm**2).sum(1))
        limit = max(FAR * np.median(distances(reference, reference, area)), LEAST * size)
        far[:, k] = np.where(distance > limit, distance / size, 0)
    unusual = [
        f"{shapes[i]} ({names[int(far[i].argmax())]}, by {far[i].max():.1f} of its radius)"
        for i in np.flatnonzero(far.any(1))
    ]
    if unusual:
        log.warning(
            "structures with an unusual relative pose, as if in another frame, mirrored or of "
            "another subject: %s",
            listed(unusual, "; ", most=9),
        )
