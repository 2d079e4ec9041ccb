"""Several structures of each subject (6.1): how they lie beside each other, and what each is like.

All registered surfaces of a subject lie in the frame of its scan.  The subject is moved as a whole
onto the mean of all (generalised Procrustes, Gower 1975).  Then each structure k of subject i is

    Y_ik = exp(w_ik) (S_k + v_ik - g_k) + g_k + t_ik

with its mean shape S_k of centroid g_k, a pose relative to the whole, turned by the vector w_ik and
shifted by t_ik (Bossa and Olmos 2006), and the shape v_ik that is left (least squares).  Poses are
compared as fields in the unit of the surfaces, d_ik = w_ik x (S_k - g_k) + t_ik.  At its best the
pose leaves a v_ik without shift and turn, sum_p a_p v_ik = 0 and sum_p a_p (S_k - g_k) x v_ik = 0
under the areas a_p of the vertices, so that the two levels are orthogonal and their variances add
up without a rest:

    sum |d + v|^2 = sum |d|^2 (between structures) + sum |v|^2 (within structures).

The two levels are those of multi-level component analysis (Timmerman 2006; of shapes in ShapeWorks,
Iyer et al. 2022, which takes only the positions of the centres as poses; of organs at several
resolutions Cerrolaza et al. 2015).  A structure weighs by its area.
"""

import logging
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from s4a.analysis.inputs import registration_of
from s4a.analysis.permutation import check_permutations
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.align import rigid_transform
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.input.subjects import listed
from s4a.method.pca import center_gram, gram, pca, principal_components
from s4a.schema import check_switch, covariate, dataset, in_unit, unit_of
from s4a.seeds import RNG, seed_of
from s4a.study.insert import scores_of_new
from s4a_morphometrics.several import of_structure, structure_names
from s4a_morphometrics.two_block import coordinates, two_block

log = logging.getLogger(__name__)

LEVELS = ("joint", "between", "within")
MOST_STEPS, CLOSE = 200, 1e-12  # of the means; until they move by so little of the size
FAR, LEAST = 6, 0.1  # a pose is reported of from so many times the usual, and this much of the size
SAME_CENTRE = 1e-3  # of the size: as if every file was centred
MOST_RATIO = 300  # of sizes: as if units differed


class Poses(NamedTuple):
    """One structure of s subjects: its mean, how it lies, and what its shape is.

    ``mean (n, 3)``, ``rotation (s, 3)`` as vectors around the centroid of the mean and
    ``translation (s, 3)``, their mean zero, and ``shape (s, n, 3)``, displacements of the mean.
    """

    mean: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    shape: np.ndarray


def align_wholes(Y: np.ndarray, area: np.ndarray, *, scale: bool = False) -> np.ndarray:
    """Subjects moved rigidly onto their mean, all their points as one (generalised Procrustes).

    Parameters
    ----------
    Y : float ndarray (s, n, 3)
        Corresponding points of the subjects.
    area : float ndarray (n,)
        Their weights.
    scale : bool
        Whether all are first brought to the mean of their sizes (centroid sizes).

    Returns
    -------
    float ndarray (s, n, 3)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.poses import align_wholes
    >>> Y = np.eye(4)[:, 1:] * [1, 2, 3]
    >>> turned = Y[:, [1, 2, 0]] + 5  # by 120 degrees
    >>> one, other = align_wholes(np.stack([Y, turned]), np.ones(4))
    >>> np.allclose(one, other)
    True
    """
    w = area / area.sum()
    Y = Y - np.einsum("n,snx->sx", w, Y)[:, None]
    size = np.sqrt(np.einsum("n,snx->s", w, Y**2))
    if scale:
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
    """The pose of a structure in every subject, and its shape without.

    Parameters
    ----------
    Y : float ndarray (s, n, 3)
        The structure in subjects that are aligned as a whole.
    area : float ndarray (n,)

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.poses import poses_of
    >>> Y = np.eye(4)[:, 1:] * [1.0, 2, 3]
    >>> found = poses_of(np.stack([Y + [1, 0, 0], Y - [1, 0, 0]]), np.ones(4))
    >>> found.translation.round(6)[:, 0].tolist(), bool(abs(found.shape).max() < 1e-9)
    ([1.0, -1.0], True)
    """
    w = area / area.sum()
    mean = Y.mean(0)
    size = np.sqrt(w @ ((mean - w @ mean) ** 2).sum(1))
    for _ in range(MOST_STEPS):
        g = w @ mean
        _, turn, t, shape = poses_on(mean, Y, w)
        step = shape.mean(0), turn.mean(0), t.mean(0)
        if max(abs(step[0]).max(), abs(step[1]).max() * size, abs(step[2]).max()) < CLOSE * size:
            break
        mean = (mean + step[0] - g) @ Rotation.from_rotvec(step[1]).as_matrix().T + g + step[2]
    return Poses(mean, turn, t, shape)


def poses_on(mean: np.ndarray, Y: np.ndarray, area: np.ndarray) -> Poses:
    """The poses of a structure beside a mean shape that is known, and its shapes without.

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


def wholes_of(found: xr.Dataset) -> np.ndarray:
    """The aligned subjects ``(s, n, 3)``, all structures of each as one: Y_ik above."""
    Y = np.empty(found["within_displacement"].shape)
    for k, here in places_of(found):
        one = poses_in(found, k, here)
        area = found["vertex_area"].values[here]
        g = area @ one.mean / area.sum()
        turn = Rotation.from_rotvec(one.rotation).as_matrix()
        turned = np.einsum("sxy,sny->snx", turn, one.mean - g + one.shape)
        Y[:, here] = turned + (g + one.translation)[:, None]
    return Y


def poses_in(found: xr.Dataset, k: int, here: np.ndarray) -> Poses:
    """Those of structure k, with vertices `here`, in a Dataset of :func:`structures`."""
    return Poses(
        found["position"].values[here],
        found["pose_rotation"].values[:, k],
        found["pose_translation"].values[:, k],
        found["within_displacement"].values[:, here],
    )


def places_of(found: xr.Dataset) -> list[tuple[int, np.ndarray]]:
    """Number and vertices of each structure of a Dataset of :func:`structures`."""
    of = found["structure_of_vertex"].values
    return [(k, np.flatnonzero(of == k)) for k in range(found.sizes["structure"])]


def pose_fields(
    mean: np.ndarray, area: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Displacements of a mean shape by poses, to first order: w x (S - g) + t, ``(s, n, 3)``.

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
    scale: bool = False,
    n_permutations: int = 999,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """How much do structures vary in how they lie beside each other, and how much in their shape?

    Parameters
    ----------
    study : DataTree
        Of several structures, see :func:`s4a_morphometrics.analyse_structures`.
    scale : bool
        Whether the size of each subject, all structures together, is taken out.
    n_permutations : int
        Of the subjects, for whether poses and shapes vary together.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        ``position(vertex, xyz)``, the mean shapes of all structures in their mean poses as one
        mesh, ``vertex_area`` and ``structure_of_vertex``.
        ``pose_rotation(shape, structure, xyz)``, vectors around the structure's centroid in the
        frame of the mean subject, ``pose_translation`` and ``pose_size``, the root mean square
        displacement that they are;
        ``within_displacement(shape, vertex, xyz)``, the shapes without their poses.
        ``level_variance(structure, level)`` of both levels, mean square over the area of all
        structures, and ``level_share``, which add up to 1.  Of the joint components ``score``,
        ``standard_deviation``, ``explained_variance_ratio`` and ``between_share(component)``, how
        much of each is of poses.  ``pose_shape_rv`` of poses and shapes and its ``pose_shape_p``
        (:mod:`s4a_morphometrics.two_block`); NaN where one of both does not vary.
        A shape is a subject; those without all structures are left out, with a warning.

    Raises
    ------
    ValueError
        When the study is not of several structures, fewer than 4 subjects have all of them, their
        units differ, or nothing varies.

    Notes
    -----
    The shares are of what was registered: noise of the registration is within structures.  Size of
    a structure is within; what all structures share as size of the whole too, unless `scale`.
    Where scans of one subject were moved apart, as when every file is centred, poses are lost and
    nothing here can know it but where all centres coincide, which is reported.

    Examples
    --------
    With a ``study`` of two small structures of six subjects:

    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> study = example_structures()
    >>> found = s4a_morphometrics.structures(study, n_permutations=99)
    >>> float(found["level_share"].sum().round(6)), found.sizes["shape"]
    (1.0, 6)
    """
    seed = seed_of(seed, rng)
    check_permutations(n_permutations)
    check_switch("scale", scale)
    names = structure_names(study)
    registered = {name: registration_of(of_structure(study, name)) for name in names}
    shapes = shared_subjects(registered)
    unit = shared_unit(registered)
    meshes = [as_arrays(registered[name]) for name in names]
    areas = [vertex_areas(*mesh) for mesh in meshes]
    Y = [
        np.stack([image_in_shape(mesh[0], registered[name].sel(shape=one)) for one in shapes])
        for name, mesh in zip(names, meshes, strict=True)
    ]
    report_frames(names, Y, areas)
    counts = [len(area) for area in areas]
    places = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    area = np.concatenate(areas)
    whole = align_wholes(np.concatenate(Y, axis=1), area, scale=scale)
    del Y
    each = [poses_of(whole[:, place], area[place]) for place in places]
    report_poses(names, shapes, each, areas, each)
    triangles = [T + place[0] for (_, T), place in zip(meshes, places, strict=True)]
    result = measured(each, areas, n_permutations=n_permutations, seed=seed)
    mesh = as_dataset(
        np.concatenate([one.mean for one in each]), np.concatenate(triangles), vertex_area=area
    )
    result = in_unit(result.merge(mesh), unit)
    return result.assign_coords(shape=shapes, structure=names, level=list(LEVELS[1:])).assign_attrs(
        scale=str(scale), permutations=n_permutations
    )


def measured(
    each: list[Poses], areas: list[np.ndarray], *, n_permutations: int = 999, seed: int = 0
) -> xr.Dataset:
    """All that :func:`structures` says of the poses and shapes of some structures."""
    total = float(sum(area.sum() for area in areas))
    s = len(each[0].rotation)
    kernels = np.empty((len(each), 2, s, s))  # inner products of poses, of shapes
    size = np.empty((s, len(each)))
    fields = []
    reach = 0.0  # mean square distance from the origin
    for k, (one, area) in enumerate(zip(each, areas, strict=True)):
        d = pose_fields(one.mean, area, one.rotation, one.translation)
        of_poses = gram(d, area)
        size[:, k] = np.sqrt(np.diag(of_poses))
        part = area.sum() / total
        kernels[k] = part * center_gram(of_poses), part * center_gram(gram(one.shape, area))
        fields.append(d)
        reach += float((one.mean**2).sum(1) @ area) / total
    variance = np.trace(kernels, axis1=2, axis2=3) / (s - 1)  # (structure, level)
    K = kernels.sum((0, 1))
    if variance.sum() <= 1e-18 * reach:
        raise ValueError("structures need subjects that differ; all are equal")
    values, V = principal_components(K)
    share_of_poses = np.einsum("sc,st,tc->c", V, kernels[:, 0].sum(0), V) / (values * (s - 1))
    rv: float | np.ndarray = np.nan
    p: float | np.ndarray = np.nan
    of_level = variance.sum(0)
    if of_level.min() > 1e-15 * of_level.max():
        all_areas = np.concatenate(areas)
        blocks = (np.concatenate(fields, 1), np.concatenate([one.shape for one in each], 1))
        A, B = (coordinates(block, all_areas / total) for block in blocks)
        found = two_block(A, B, n_permutations=n_permutations, seed=seed)
        rv, p = found["rv"], found["rv_p"]
    counts = [len(one.mean) for one in each]
    return dataset(
        structure_of_vertex=np.repeat(np.arange(len(each)), counts),
        pose_rotation=np.stack([one.rotation for one in each], axis=1),
        pose_translation=np.stack([one.translation for one in each], axis=1),
        pose_size=size,
        within_displacement=np.concatenate([one.shape for one in each], 1).astype(np.float32),
        level_variance=variance,
        level_share=variance / variance.sum(),
        score=V * np.sqrt(s - 1),
        standard_deviation=np.sqrt(values),
        explained_variance_ratio=values / values.sum(),
        between_share=share_of_poses,
        pose_shape_rv=rv,
        pose_shape_p=p,
    )


def structures_of_new(found: xr.Dataset, inserted: xr.DataTree) -> xr.Dataset:
    """How the structures of new subjects lie beside each other, and their shapes.

    Each new subject is moved as a whole onto the mean of those of the study, which stays as it is;
    then the pose of each structure is that on its mean shape.  A subject of the study itself comes
    out as it is there.

    Parameters
    ----------
    found : Dataset
        Of :func:`structures`, of the study.
    inserted : DataTree
        Of :func:`s4a_morphometrics.insert_structures` into the same study.

    Returns
    -------
    Dataset
        ``pose_rotation``, ``pose_translation``, ``pose_size`` and ``within_displacement`` of the
        new subjects, and the mean shapes of the study, as of :func:`structures`;
        :func:`structures_modes` has their scores.  Those without all structures are left out, with
        a warning.

    Raises
    ------
    ValueError
        When a structure of the study has no new shape, no new subject has all of them, or these
        were registered to another template or in another unit.

    Examples
    --------
    With a ``study`` of two small structures of six subjects, of which one is given once more:

    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> study = example_structures()
    >>> found = s4a_morphometrics.structures(study, n_permutations=99)
    >>> new = s4a_morphometrics.structures_of_new(found, study)
    >>> bool(abs(new["pose_size"] - found["pose_size"]).max() < 1e-4 * found["pose_size"].max())
    True
    """
    names = found["structure"].values.tolist()
    if structure_names(inserted) != names:
        raise ValueError(
            f"new shapes of {listed(names)} needed, found {listed(structure_names(inserted))}"
        )
    registered = {name: registration_of(of_structure(inserted, name)) for name in names}
    shapes = shared_subjects(registered, least=1)
    unit = unit_of(found["position"])
    if shared_unit(registered) != unit:
        raise ValueError(f"new shapes in {unit} needed, found {shared_unit(registered)}")
    places = places_of(found)
    counts = [len(here) for _, here in places]
    others = [registered[name].sizes["vertex"] for name in names]
    if others != counts:
        raise ValueError(
            "shapes inserted into the same study needed, with templates of "
            f"{listed([str(n) for n in counts])} vertices; found {listed([str(n) for n in others])}"
        )
    area, known = found["vertex_area"].values, wholes_of(found)
    w = area / area.sum()
    mean = known.mean(0)
    center, size = w @ mean, np.sqrt(w @ (known[0] ** 2).sum(1))
    whole = np.empty((len(shapes), len(mean), 3))
    for i, one in enumerate(shapes):
        parts = [registered[name].sel(shape=one) for name in names]
        Y = np.concatenate([image_in_shape(part["position"].values, part) for part in parts])
        Y -= w @ Y
        R, _, _ = rigid_transform(Y, mean, w)
        if found.attrs["scale"] == "True":
            Y *= size / np.sqrt(w @ (Y**2).sum(1))  # all of the study have the same
        whole[i] = Y @ R.T + center
    each = [poses_on(found["position"].values[at], whole[:, at], area[at]) for _, at in places]
    usual = [poses_in(found, k, at) for k, at in places]
    report_poses(names, shapes, each, [area[at] for _, at in places], usual)
    d = [
        pose_fields(one.mean, area[at], one.rotation, one.translation)
        for (_, at), one in zip(places, each, strict=True)
    ]
    of_area = [area[at] / area[at].sum() for _, at in places]
    size = [np.sqrt(np.einsum("snx,n->s", f**2, a)) for f, a in zip(d, of_area, strict=True)]
    new = dataset(
        pose_rotation=np.stack([one.rotation for one in each], axis=1),
        pose_translation=np.stack([one.translation for one in each], axis=1),
        pose_size=np.stack(size, axis=1),
        within_displacement=np.concatenate([one.shape for one in each], 1).astype(np.float32),
    )
    mesh = found[["position", "corner_vertex", "vertex_area", "structure_of_vertex"]]
    mesh = mesh.drop_vars(["shape", "level"], errors="ignore")
    result = in_unit(mesh.merge(new), unit).assign_coords(shape=shapes, structure=names)
    return result.assign_attrs(scale=found.attrs["scale"])


def structures_modes(
    study: xr.DataTree, found: xr.Dataset, level: str = "joint", new: xr.Dataset | None = None
) -> xr.DataTree:
    """One level of :func:`structures` as a study of all structures together.

    Everything that takes a study takes it: its modes are those of the level, and so are groups,
    variables and maps, such as :func:`s4a.statistics.group_test` of how structures lie.

    Parameters
    ----------
    study : DataTree
        Of several structures.
    found : Dataset
        Of :func:`structures`.
    level : {"joint", "between", "within"}
        Poses and shapes; poses alone; shapes alone.
    new : Dataset, optional
        Of :func:`structures_of_new`: the shapes of the tree are these, and their scores are those
        on the modes of the study, as of :func:`s4a_morphometrics.insert_structures`.

    Returns
    -------
    DataTree
        ``/registration`` with all structures as one mesh, a shape each subject, and its
        displacements; ``/pca``; and ``/subjects``, the columns in which all structures of a
        subject agree.

    Raises
    ------
    ValueError
        When there is no such level, or it does not vary.

    Notes
    -----
    Turns are drawn along their tangents: at 15 degrees a structure looks 3 % larger.

    Examples
    --------
    With a ``study`` of two small structures of six subjects:

    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> study = example_structures()
    >>> found = s4a_morphometrics.structures(study, n_permutations=99)
    >>> poses = s4a_morphometrics.structures_modes(study, found, "between")
    >>> poses["pca"].sizes["component"]
    5
    """
    if level not in LEVELS:
        raise ValueError(f"level must be one of {', '.join(LEVELS)}; found {level!r}")
    registration = of_level(found, level)
    try:
        modes = pca(registration, found["vertex_area"].values)
    except ValueError as error:
        raise ValueError(f"{level}: {error}") from error
    modes = modes.assign_attrs(variable=level)
    if new is not None:
        registration = of_level(new, level)
        modes = scores_of_new(modes, registration, found["vertex_area"].values)
    nodes = {"/registration": registration, "/pca": modes}
    subjects = (
        xr.Dataset() if new is not None else shared_columns(study, found["shape"].values.tolist())
    )
    if subjects.data_vars:
        nodes["/subjects"] = subjects
    return xr.DataTree.from_dict(nodes, name=study.name)


def of_level(found: xr.Dataset, level: str) -> xr.Dataset:
    """The displacements of one level, on all structures as one mesh."""
    area = found["vertex_area"].values
    d = np.zeros(found["within_displacement"].shape)
    if level != "between":
        d += found["within_displacement"].values
    if level != "within":
        for k, here in places_of(found):
            d[:, here] += pose_fields(
                found["position"].values[here],
                area[here],
                found["pose_rotation"].values[:, k],
                found["pose_translation"].values[:, k],
            )
    mesh = found[["position", "corner_vertex", "vertex_area", "structure_of_vertex"]]
    registration = mesh.assign_attrs(level=level, structures=" ".join(found["structure"].values))
    registration = registration.merge(dataset(displacement=d.astype(np.float32)))
    registration = in_unit(registration, unit_of(found["position"]))
    registration = registration.drop_vars(["structure", "level"], errors="ignore")
    return registration.assign_coords(shape=found["shape"].values)


# what the structures of a subject share


def shared_subjects(registered: dict[str, xr.Dataset], least: int = 4) -> list[str]:
    """The subjects of which all structures are registered; the others are named in a warning."""
    having = {name: data["shape"].values.tolist() for name, data in registered.items()}
    everyone = sorted({one for names in having.values() for one in names})
    lacking = {one: [name for name, of in having.items() if one not in of] for one in everyone}
    shapes = [one for one, without in lacking.items() if not without]
    said = [f"{one} (no {listed(names)})" for one, names in lacking.items() if names]
    if said:
        log.warning(
            "left out, as a structure is missing or flagged: %s", listed(said, "; ", most=9)
        )
    if len(shapes) < least:
        raise ValueError(
            f"structures need at least {least} subjects that have all of them, found "
            f"{len(shapes)} of {len(everyone)}{'; ' if said else ''}{listed(said, '; ')}"
        )
    return shapes


def shared_unit(registered: dict[str, xr.Dataset]) -> str:
    """The unit of all structures; ValueError where they differ."""
    units = {name: unit_of(data["displacement"]) for name, data in registered.items()}
    if len(set(units.values())) > 1:
        said = [f"{name}: {unit}" for name, unit in units.items()]
        raise ValueError(f"structures need one unit; found {listed(said)}")
    return next(iter(units.values()))


def shared_columns(study: xr.DataTree, shapes: list[str]) -> xr.Dataset:
    """The columns of ``/subjects`` in which all structures of each subject have the same value."""
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


def _same(one, other):
    if {one.dtype.kind, other.dtype.kind} <= set("iuf"):
        return np.array_equal(one.values, other.values, equal_nan=True)
    return np.array_equal(one.values, other.values)


def report_frames(names: list[str], Y: list[np.ndarray], areas: list[np.ndarray]) -> None:
    """Warn where structures seem not to lie in one frame, or not to have one unit."""
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
                "%s and %s have the same centre in every subject: were their files centred, so "
                "that how they lie relative to each other is lost?",
                names[0],
                names[k],
            )


def report_poses(
    names: list[str],
    shapes: list[str],
    each: list[Poses],
    areas: list[np.ndarray],
    usual_poses: list[Poses],
) -> None:
    """Warn of structures that lie far from where they usually are."""
    far = np.zeros((len(shapes), len(names)))

    def distances(one, others, area):
        turn = one.rotation - np.median(others.rotation, axis=0)
        shift = one.translation - np.median(others.translation, axis=0)
        d = pose_fields(one.mean, area, turn, shift)
        return np.sqrt(np.einsum("n,snx->s", area / area.sum(), d**2))

    for k, (one, others, area) in enumerate(zip(each, usual_poses, areas, strict=True)):
        away = distances(one, others, area)
        arm = one.mean - (area / area.sum()) @ one.mean
        size = np.sqrt((area / area.sum()) @ (arm**2).sum(1))
        usual = max(FAR * np.median(distances(others, others, area)), LEAST * size)
        far[:, k] = np.where(away > usual, away / size, 0)
    said = [
        f"{shapes[i]} ({names[int(far[i].argmax())]}, by {far[i].max():.1f} of its radius)"
        for i in np.flatnonzero(far.any(1))
    ]
    if said:
        log.warning(
            "structures lie far from where they are in the other subjects, as if in another frame, "
            "mirrored or of another subject: %s",
            listed(said, "; ", most=9),
        )
