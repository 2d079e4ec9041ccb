"""Synthetic brains with ground-truth correspondences and modes, and small test surfaces.

The reference brain is a smooth embedding of the unit sphere, including folds.  Every shape is the
reference brain after a smooth diffeomorphism of space, x -> x + sum_m s_m w_m(x) + individual noise
+ tumour, and a rigid transform.  The fields are sums of localised translations and rotations,
exp(-|x - c|^2 / 2 w^2) (translation + rotation x (x - c)), so that :func:`position` gives the exact
position of every reference point (a point of the unit sphere) on every shape.  Units are mm, axes
RAS: x to the right, y to the front, z up.
"""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from joblib import delayed
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from s4a.geometry.align import farthest_samples
from s4a.geometry.compiled import fpsample
from s4a.geometry.mesh import as_arrays, as_dataset, edge_graph, edges, vertex_areas
from s4a.input.collection import read_shapes
from s4a.input.files import write_mesh
from s4a.input.raw import new_folder
from s4a.schema import Array, check_choice, check_count, dataset, in_unit
from s4a.seeds import RNG, seed_of
from s4a.study.pipeline import analyse
from s4a.study.processes import workers


def _add_artefacts(X, T, u, rng):
    """Add artefacts of scanner files to a clean mesh.

    4 loose components of 12 to 60 vertices; 3 holes of 10 to 60 triangles; one bow-tie vertex per
    8,000 triangles; and one per 2,000 triangles, at least 3, of each of these: non-manifold edges,
    duplicate vertices (a seam half around the vertex), split edges with two zero-area triangles,
    duplicate triangles, flipped triangles, unreferenced vertices.  Vertices and triangles are
    shuffled.

    Parameters
    ----------
    X, T : the mesh
    u : float ndarray (n, 3)
        Reference points of the vertices on the unit sphere.
    rng : numpy.random.Generator

    Returns
    -------
    X, T
    u
        NaN in loose components and at unreferenced vertices.
    """
    few = max(3, len(T) // 2000)
    T = _tear(T, u, few, rng)
    T, original = _duplicate_vertices(X, T, u, few, rng)
    X, u = X[original], u[original]
    T = _disorder(T, u, few, rng)
    for near in X[rng.integers(len(X), size=4)]:
        points, triangles = _debris(near, rng)
        X, T = np.r_[X, points], np.r_[T, triangles + len(X)]
    X = np.r_[X, rng.uniform(X.min(0), X.max(0), (few, 3))]
    u = np.r_[u, np.full((len(X) - len(u), 3), np.nan)]
    order = rng.permutation(len(X))
    return X[order], np.argsort(order)[rng.permutation(T)].astype(np.int32), u[order]


def _tear(T, u, few, rng):
    """Remove triangles to make holes and bow-tie vertices.

    At a bow-tie, two triangles of a star with only that vertex in common are removed.
    """
    keep = np.ones(len(T), bool)
    middles = cKDTree(u[T].mean(1))
    for size in rng.integers(10, 60, 3):
        keep[middles.query(u[rng.integers(len(u))], size)[1]] = False
    for v in rng.choice(len(u), max(3, few // 4), replace=False):
        star = np.flatnonzero((T == v).any(1))
        opposite = [t for t in star if len(np.intersect1d(T[t], T[star[0]])) == 1]
        keep[[star[0], *opposite[:1]]] = False
    return T[keep]


def _duplicate_vertices(X, T, u, few, rng):
    """Duplicate some vertices; return the triangles and the original of every vertex.

    Seam: half of the star of v gets a copy.  Split edge: a b c becomes m b c, a m c and a b m,
    where m is a copy of a.
    """
    T, original = T.copy(), np.arange(len(X))
    for v in rng.choice(np.unique(T), few, replace=False):
        star = np.flatnonzero((T == v).any(1))
        along = X[original[T[star]]].mean(1) @ np.cross(u[v], rng.normal(size=3))
        half = star[along > np.median(along)]
        T[half] = np.where(T[half] == v, len(original), T[half])
        original = np.r_[original, v]
    split = rng.choice(len(T), few, replace=False)
    a, b, c = T[split].T
    m = len(original) + np.arange(few)
    T[split] = np.c_[m, b, c]
    return np.r_[T, np.c_[a, m, c], np.c_[a, b, m]], np.r_[original, original[a]]


def _disorder(T, u, few, rng):
    """Duplicate and flip some triangles, and add a third one to some edges."""
    third, twice, flipped = rng.choice(len(T), (3, few), replace=False)
    beyond = cKDTree(u).query(u[T[third]].mean(1), 15)[1][:, -1]
    more = [np.c_[T[third, :2], beyond], np.roll(T[twice], 1, axis=1)]
    T = T.copy()
    T[flipped] = T[flipped, ::-1]
    return np.concatenate([T, *more])


def _debris(near, rng):
    """Return a small loose ellipsoid."""
    u = rng.normal(size=(int(rng.integers(12, 61)), 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return near * rng.uniform(0.8, 1.15) + u * rng.uniform(0.8, 3, 3), ConvexHull(u).simplices


_MODE_RMS = 4.5  # mm, root mean square displacement of mode 1 at one standard deviation
_MODE_RATIO = 0.6  # ratio of each mode to the previous one
_NOISE_RMS = 0.4  # mm, individual noise: 8 translations 16 to 28 mm wide
_TUMOUR = (4.0, 7.0)  # mm, smallest and largest height, on a third of the shapes; 10 to 14 mm wide
_POSE = (10.0, 8.0)  # largest rotation in degrees, standard deviation of the translation in mm
_SEMI_AXES = np.array([64.0, 86.0, 61.0])

# Centre, width, translation, rotation and mirror of the fields of each mode, on the right side; a
# mirror of 1 repeats the field on the left as in a mirror, -1 with the opposite sign, 0 does not.
MODES: list[list[Any]] = [
    [((62, 0, 5), 44, (0, 0, 0), (1, 0, 0), 1)],
    [((0, 60, 10), 38, (0, 0, 0), (0, 1, 0), 0), ((0, -60, 10), 38, (0, 0, 0), (0, -1, 0), 0)],
    [
        ((45, 30, -28), 28, (0, 1, 0.2), (0, 0, 0), 1),
        ((25, -55, -30), 28, (-0.8, 0, 0.6), (0, 0, 0), 1),
    ],
    [((30, -45, 45), 28, (1, 0, -1), (0, 0, 0), -1)],
    [((30, 55, 25), 26, (0, 0, 0), (0.3, 1, 0.3), 1)],
    [((55, -40, 0), 26, (0, 0, 0), (1, 0, 0), -1)],
]
_REGIONS = {
    "frontal pole": (0.3, 0.95, 0.1),
    "superior frontal": (0.3, 0.55, 0.75),
    "inferior frontal": (0.75, 0.6, 0.1),
    "precentral": (0.5, 0.12, 0.85),
    "parietal": (0.55, -0.35, 0.75),
    "supramarginal": (0.9, -0.25, 0.3),
    "temporal": (0.85, 0.15, -0.45),
    "occipital": (0.35, -0.92, 0.1),
    "cerebellum": (0.4, -0.65, -0.65),
    "base": (0.2, 0.25, -0.95),
}
LABELS = ["unknown", *(f"{region} {side}" for side in ("left", "right") for region in _REGIONS)]
LANDMARKS = {
    "frontal pole left": (-0.25, 0.95, 0.1),
    "frontal pole right": (0.25, 0.95, 0.1),
    "occipital pole left": (-0.25, -0.95, 0.1),
    "occipital pole right": (0.25, -0.95, 0.1),
    "temporal pole left": (-0.7, 0.6, -0.4),
    "temporal pole right": (0.7, 0.6, -0.4),
    "lateral left": (-1.0, -0.1, 0.1),
    "lateral right": (1.0, -0.1, 0.1),
    "vertex": (0.1, 0.0, 1.0),
    "brainstem": (0.0, -0.36, -0.93),
}


def _bump(u, centre, sharpness):
    """Return exp(sharpness (cos angle - 1)) around a direction."""
    return np.exp(sharpness * (u @ _unit(centre) - 1))


def _step(x, width):
    """Smooth step from 0 to 1 around x = 0."""
    return 0.5 * (1 + np.tanh(x / width))


def _fold_noise(p):
    """Random field of one wavelength and unit variance, whose zeros are the sulci.

    The field is nearly mirror-symmetric in x.
    """
    rng, wavelength, waves = np.random.default_rng(20), 30.0, 48
    k = rng.normal(size=(waves, 3))
    k *= 2 * np.pi / wavelength / np.linalg.norm(k, axis=1, keepdims=True)
    phase = rng.uniform(0, 2 * np.pi, waves)
    tilt = rng.normal(0, 0.35, waves)  # without it the field would be symmetric
    total = np.zeros(len(p))
    for start in range(0, len(p), 8192):  # 64 KB a column, which stay in the cache
        part = total[start : start + 8192]
        x, y, z = np.ascontiguousarray(p[start : start + 8192].T)
        for (kx, ky, kz), a, b in zip(k, phase, tilt, strict=True):
            part += np.cos(kx * x + b) * np.cos(ky * y + kz * z + a)
    return total * 2 / np.sqrt(waves)


def reference_brain(u: ArrayLike) -> Array:
    """Map points u (p, 3) of the unit sphere to the reference brain: (p, 3) in mm."""
    u = np.asarray(u, float)
    x, y, z = u.T
    side = np.abs(x)
    p = u * _SEMI_AXES
    mirrored = np.stack([np.sqrt(x**2 + 1e-3), y, z], axis=1)
    cerebellum = _bump(mirrored, (0.35, -0.72, -0.68), 9.0)
    stem = _bump(u, (0, -0.36, -0.93), 110.0)
    base = _bump(u, (0, 0.35, -0.94), 6.0)
    temporal = _bump(mirrored, (0.72, 0.25, -0.62), 10.0)
    # grooves: longitudinal fissure, Sylvian fissure, cleft between cerebrum and cerebellum
    top = _step(z + 0.25, 0.2) + 0.7 * _step(-0.6 - z, 0.1) * _step(y - 0.2, 0.1)
    fissure = np.exp(-((x / 0.07) ** 2)) * top
    sylvian = (
        np.exp(-(((z + 0.2 - 0.35 * (0.25 - y)) / 0.075) ** 2))
        * _step(side - 0.55, 0.1)
        * _step(y + 0.3, 0.12)
    )
    tentorium = (
        np.exp(-(((z + 0.36 - 0.15 * y) / 0.06) ** 2))
        * _step(-0.35 - y, 0.12)
        * _step(z + 0.9, 0.1)
    )
    # folds
    cortex = np.clip(1 - cerebellum - 1.5 * stem, 0, 1) * _step(z + 0.82, 0.1)
    sulci = cortex / (1 + (_fold_noise(p) / 0.7) ** 2)
    folia = np.cos(70 * (z - 0.25 * y)) * np.clip(cerebellum * 1.4 - 0.3, 0, 1)
    f = (
        1
        + 0.17 * temporal
        + 0.14 * cerebellum
        + 0.28 * stem
        - 0.12 * base
        + 0.025 * _bump(u, (0.45, 0.85, 0), 8.0)
        + 0.03 * _bump(u, (-0.4, -0.9, 0), 8.0)
        - 0.20 * fissure
        - 0.11 * sylvian
        - 0.12 * tentorium
        - 0.078 * sulci * (1 - fissure)
        + 0.012 * folia
    )
    p = p * f[:, None]
    p[:, 0] *= 1 - 0.10 * p[:, 1] / _SEMI_AXES[1]  # narrower in front
    return p


def _fields(x, centre, width, translation, rotation):
    """Sum exp(-|x - c|^2 / 2 w^2) (translation + rotation x (x - c)) at points x (p, 3)."""
    total = np.zeros_like(x)
    for c, w, a, b in zip(centre, width, translation, rotation, strict=True):
        d = x - c
        local = np.exp(np.einsum("px,px->p", d, d) * (-0.5 / w**2))
        total += local[:, None] * (a + d @ np.cross(b, np.eye(3)))
    return total


def _generators(n_modes):
    """Centres and widths of all regions, and their transform by each generator ``(g, regions, 6)``.

    The generators are the six rigid transforms, as one region of infinite width, and the designed
    modes.  Three columns are the translation, three the rotation.
    """
    centre, width = [np.zeros(3)], [np.inf]
    moves = []  # mode and transform of each region after the first
    for m, mode in enumerate(MODES[:n_modes]):
        for c, w, translation, rotation, mirror in mode:
            for side in (1,) if mirror == 0 else (1, -1):
                flip = np.array([side, 1, 1])
                sign = 1 if side == 1 else mirror
                centre.append(flip * c)
                width.append(w)
                # a rotation is an axial vector: a reflection also changes its sign
                moves.append((m, sign * np.r_[flip * translation, side * flip * rotation]))
    rows = np.zeros((6 + n_modes, len(centre), 6))
    rows[:6, 0] = np.eye(6)
    for region, (m, move) in enumerate(moves, start=1):
        rows[6 + m, region] = move
    return np.array(centre), np.array(width), rows


def _true_modes(n_modes):
    """Centres and widths of all regions, and their translation and rotation in each mode.

    On the reference brain the modes are orthogonal to rigid transforms and to each other, by a
    Cholesky factor of the Gram matrix of the generators.
    """
    check_count("n_modes", n_modes, 0, len(MODES))
    centre, width, rows = _generators(n_modes)
    u, T = _sphere(4000)
    x = reference_brain(u)
    area = vertex_areas(x, T)
    values = np.stack([_fields(x, centre, width, row[:, :3], row[:, 3:]) for row in rows])
    gram = np.einsum("apx,bpx,p->ab", values, values, area / area.sum())
    rows = np.tensordot(np.linalg.inv(np.linalg.cholesky(gram)), rows, 1)[6:]
    rows *= _MODE_RMS * _MODE_RATIO ** np.arange(n_modes)[:, None, None]
    return centre, width, rows[..., :3], rows[..., 3:]


def _true_scores(n, n_modes, rng):
    """Truncated normal scores ``(n, n_modes)``, standardised and uncorrelated if possible."""
    while True:
        score = ndtri(rng.uniform(ndtr(-2.5), ndtr(2.5), (n, n_modes)))
        if n <= n_modes + 1:
            return score
        Q, R = np.linalg.qr(score - score.mean(0))
        score = Q * np.sign(np.diag(R)) * np.sqrt(n)
        if np.abs(score).max(initial=0) <= 2.5:
            return score


def _noise_regions(n, rng):
    """Centres, widths and translations ``(n, 9, ...)`` of the noise and, last, of the tumour."""
    centre = reference_brain(_random_directions(rng, n * 9)).reshape(n, 9, 3)
    width = np.concatenate([rng.uniform(16, 28, (n, 8)), rng.uniform(10, 14, (n, 1))], axis=1)
    translation = rng.normal(size=(n, 9, 3))
    outwards = _random_directions(rng, n)
    outwards[:, 2] = np.abs(outwards[:, 2])  # a tumour is on the upper half
    centre[:, 8] = reference_brain(outwards)
    height = rng.uniform(*_TUMOUR, n) * (rng.permutation(n) < n // 3)
    translation[:, 8] = outwards * height[:, None]
    x = reference_brain(_sphere(4000)[0])
    for c, w, a in zip(centre[:, :8], width[:, :8], translation[:, :8], strict=True):
        a *= _NOISE_RMS / np.sqrt((_fields(x, c, w, a, 0 * a) ** 2).sum(1).mean())  # in place
    return centre, width, translation


def simulate(n: int = 12, seed: int = 0, *, n_modes: int = 3, rng: RNG | None = None) -> xr.Dataset:
    """Simulate the parameters of a population, without meshes.

    Parameters
    ----------
    n : int
        Number of shapes.
    seed : int
        Seed of the random numbers.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.
    n_modes : int
        Number of simulated modes.

    Returns
    -------
    Dataset
        ``true_score(shape, true_mode)``; the regions of the modes; the regions of the noise and,
        last, of the tumour of each shape (with zero translation if there is none); the pose; and
        the reference points of the landmarks.  :func:`position` needs nothing else.

    Raises
    ------
    ValueError
        If `n` is less than 1.

    Examples
    --------
    >>> import s4a
    >>> truth = s4a.synthetic.simulate(6, seed=1)
    >>> truth["true_score"].std("shape").values.round(6).tolist()
    [1.0, 1.0, 1.0]
    """
    check_count("n", n, 1)
    seed = seed_of(seed, rng)
    draw = np.random.default_rng([seed, 0])
    centre, width, translation, rotation = _true_modes(n_modes)
    score = _true_scores(n, n_modes, draw)
    noise_centre, noise_width, noise_translation = _noise_regions(n, draw)
    pose = Rotation.from_rotvec(
        _random_directions(draw, n) * np.deg2rad(draw.uniform(0, _POSE[0], (n, 1)))
    )
    truth = dataset(
        {
            "seed": seed,
            "mode_rms": _MODE_RMS,
            "mode_ratio": _MODE_RATIO,
            "noise_rms": _NOISE_RMS,
            "unit": "mm",
        },
        true_score=score,
        true_centre=centre,
        true_width=width,
        true_translation=translation,
        true_rotation=rotation,
        noise_centre=noise_centre,
        noise_width=noise_width,
        noise_translation=noise_translation,
        rotation=pose.as_matrix(),
        translation=draw.normal(0, _POSE[1], (n, 3)),
        landmark_name=np.array(list(LANDMARKS)),
        landmark_reference=_unit(list(LANDMARKS.values())),
    )
    for name, what in (("rotation", "R"), ("translation", "t")):
        truth[name].attrs["long_name"] = f"{what} of the pose x -> R x + t of the shape"
    return truth.assign_coords(shape=[f"brain_{i + 1:0{max(2, len(str(n)))}d}" for i in range(n)])


def position(truth: xr.Dataset | xr.DataTree, shape: str, reference_point: ArrayLike) -> Array:
    """Return the exact positions of reference points on a shape.

    Parameters
    ----------
    truth : DataTree or Dataset
        ``tree["truth"]`` of :func:`brains`, or the result of :func:`simulate`.
    shape : str
    reference_point : (p, 3)
        Points of the unit sphere.

    Returns
    -------
    float ndarray (p, 3)
        In mm; NaN for rows of NaN.

    Examples
    --------
    >>> import s4a
    >>> s4a.synthetic.position(s4a.synthetic.simulate(4), "brain_02", [[0, 1, 0], [0, -1, 0]]).shape
    (2, 3)
    """
    truth = truth.to_dataset() if isinstance(truth, xr.DataTree) else truth
    row = truth.isel(shape=_index(truth, shape))
    value = {name: v.values for name, v in row.data_vars.items()}
    x = reference_brain(reference_point)
    translation = np.tensordot(value["true_score"], value["true_translation"], 1)  # (regions, 3)
    rotation = np.tensordot(value["true_score"], value["true_rotation"], 1)
    noise_translation = value["noise_translation"]
    moved = x + _fields(x, value["true_centre"], value["true_width"], translation, rotation)
    moved += _fields(
        x, value["noise_centre"], value["noise_width"], noise_translation, 0 * noise_translation
    )
    return moved @ value["rotation"].T + value["translation"]


def _index(truth, shape):
    """Row of a shape in the ground truth."""
    names = truth["shape"].values.tolist()
    check_choice("shape", shape, names)
    return names.index(shape)


def _unit(x):
    x = np.asarray(x, float)
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def _random_directions(rng, n):
    return _unit(rng.normal(size=(n, 3)))


def _fibonacci(n):
    """Return n points evenly distributed over the unit sphere along a spiral."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    angle = np.pi * (1 + np.sqrt(5)) * i  # by the golden section
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _delaunay(u):
    """Triangulate points of the unit sphere by their convex hull, oriented outwards."""
    T = ConvexHull(u).simplices
    inwards = np.einsum("ij,ij->i", np.cross(u[T[:, 0]], u[T[:, 1]]), u[T[:, 2]]) < 0
    T[inwards] = T[inwards][:, ::-1]
    return T


def _sphere(n):
    """Return points ``(n, 3)`` and triangles of the unit sphere."""
    u = _fibonacci(n)
    return u, _delaunay(u)


def _clean_brain(truth, shape, n_vertices, rng):
    """Return farthest-point samples of a shape, their triangles, and their reference points."""
    check_count("n_vertices", n_vertices, 4)
    u = _fibonacci(5 * n_vertices) @ Rotation.random(random_state=rng).as_matrix().T
    u = _unit(u + rng.normal(0, 0.3 * np.sqrt(4 * np.pi / len(u)), u.shape))
    X = position(truth, shape, u)
    x = X.astype(np.float32)
    start = int(rng.integers(len(u)))
    if fpsample:
        h = min(7, int(np.log2(len(u))))  # levels of the tree; no leaf may be empty
        sample = fpsample.bucket_fps_kdline_sampling(x, n_vertices, h=h, start_idx=start)
    else:
        sample = farthest_samples(x, n_vertices, start)
    sample = np.sort(sample)
    return X[sample], _delaunay(u[sample]), u[sample]


def _brain(truth, shape, n_vertices, seed, dirty):
    """Return points, triangles and reference points of one shape of :func:`brains`."""
    clean, artefacts = (np.random.default_rng([seed, i, _index(truth, shape)]) for i in (1, 2))
    X, T, u = _clean_brain(truth, shape, n_vertices, clean)
    return _add_artefacts(X, T, u, artefacts) if dirty else (X, T, u)


def labels(reference_point: ArrayLike) -> Array:
    """Return labels of reference points: indices in :data:`LABELS`, 0 for NaN.

    Examples
    --------
    >>> import s4a
    >>> s4a.synthetic.LABELS[s4a.synthetic.labels([[0.9, 0.1, -0.4]])[0]]
    'temporal right'
    """
    u = np.asarray(reference_point, float)
    seeds = [
        sign * np.array([1, 0, 0]) * s + [0, *s[1:]]
        for sign in (-1, 1)
        for s in _unit(list(_REGIONS.values()))
    ]
    nearest = 1 + np.argmax(np.nan_to_num(u) @ np.array(seeds).T, axis=1)
    return np.where(np.isnan(u).any(axis=1), 0, nearest).astype(np.int32)


def _annotate(mesh, truth, shape, reference_point):
    """Add labels and landmarks to a mesh."""
    annotations = dataset(
        label=labels(reference_point),
        landmark_name=truth["landmark_name"].values,
        landmark_position=position(truth, shape, truth["landmark_reference"].values),
    )
    annotations["label"].attrs["names"] = LABELS
    return in_unit(mesh.merge(annotations).assign_attrs(unit="mm", coordinate_system="RAS"), "mm")


def _reference_after_cleaning(mesh, raw, reference_point):
    """Reference points after cleaning; moved vertices get the mean of their neighbours."""
    X, T = as_arrays(mesh)
    file_vertex = mesh["file_vertex"].values
    u = reference_point[file_vertex]
    moved = (X != raw[file_vertex]).any(axis=1) | np.isnan(u).any(axis=1)
    u[moved] = 0
    u[moved] = _unit((edge_graph(X, edges(T))[moved] != 0) @ u)
    return u


def brains(
    n: int = 12,
    n_vertices: int = 40_000,
    seed: int = 0,
    *,
    dirty: bool = False,
    n_modes: int = 3,
    rng: RNG | None = None,
    n_jobs: int | None = None,
) -> xr.DataTree:
    """Simulate a population of brains with known modes and exact correspondences.

    Parameters
    ----------
    n : int
        Number of shapes.
    n_vertices : int
        Vertices of each shape, exact unless `dirty`.  The population does not depend on it.
    seed : int
        Seed of the random numbers.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.
    dirty : bool
        Whether to add artefacts of scanner files and clean the meshes; ``/raw/<shape>`` then has
        the meshes before cleaning.
    n_modes : int
        Number of simulated modes.
    n_jobs : int, optional
        As in joblib; the result does not depend on it.

    Returns
    -------
    DataTree
        The nodes are

        - ``/original/<shape>`` and ``/report``: as from :func:`s4a.read_shapes`, with labels and
          landmarks;
        - ``/truth``: simulated parameters, see :func:`simulate`;
        - ``/truth/<shape>``: ``reference_point(vertex, xyz)`` of every vertex.  It is approximate
          for the few vertices that cleaning inserts on an edge, and exact for all others.

    Notes
    -----
    Modes move material along the surface, so the nearest vertex after rigid alignment has a mean
    error of 2.5 % of sqrt(area) over the pairs of 12 shapes.  The folds move with the material.

    See Also
    --------
    simulate : the parameters alone.
    position : exact positions of any reference point.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> tree = s4a.synthetic.brains(3, 500)
    >>> mesh, truth = tree["original/brain_02"], tree["truth"]
    >>> exact = s4a.synthetic.position(truth, "brain_02", truth["brain_02/reference_point"])
    >>> np.abs(exact - mesh["position"]).max().item() < 1e-9
    True

    Four brains:

    >>> shapes = s4a.synthetic.brains(4, 3000)["original"].children
    >>> s4a.show.charts.surfaces({name: mesh.to_dataset() for name, mesh in shapes.items()})
    <TiledFigure ...>
    """
    seed = seed_of(seed, rng)
    truth = simulate(n, seed, n_modes=n_modes)
    names = truth["shape"].values.tolist()
    simulated = delayed(_brain)
    meshes = workers(n_jobs)(simulated(truth, name, n_vertices, seed, dirty) for name in names)
    raw = dict(zip(names, meshes, strict=True))
    shapes = read_shapes({shape: (X, T) for shape, (X, T, _) in raw.items()}, compare=False)
    nodes = {"/report": shapes["report"].to_dataset(), "/truth": truth}
    for shape, (X, T, u) in raw.items():
        mesh = shapes[f"original/{shape}"].to_dataset()
        if dirty:
            nodes[f"/raw/{shape}"] = _annotate(as_dataset(X, T, reference_point=u), truth, shape, u)
        u = _reference_after_cleaning(mesh, X, u)
        nodes[f"/original/{shape}"] = _annotate(mesh, truth, shape, u)
        nodes[f"/truth/{shape}"] = dataset(reference_point=u)
    return xr.DataTree.from_dict(nodes)


def write(tree: xr.DataTree, folder: Path | str) -> list[Path]:
    """Write a collection to files: ``<shape>.ply`` with labels, and ``truth.nc``.

    Parameters
    ----------
    tree : DataTree
        From :func:`brains`; the raw meshes are written if there are any.
    folder : path
        Created if missing.

    Returns
    -------
    list of Path
        The PLY files.  ``xarray.open_datatree("truth.nc")`` is the ground truth for
        :func:`position`, with the ``reference_point`` of each file in the order of its vertices,
        and its landmarks.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import s4a
    >>> folder = Path(tempfile.mkdtemp())
    >>> paths = s4a.synthetic.write(s4a.synthetic.brains(2, 200), folder)
    >>> [path.name for path in paths], (folder / "truth.nc").is_file()
    (['brain_01.ply', 'brain_02.ply'], True)
    """
    folder = new_folder(folder)
    truth, paths = tree["truth"].to_dataset(), []
    nodes = {"/": truth}
    for shape in truth["shape"].values:
        mesh = tree[f"raw/{shape}" if "raw" in tree.children else f"original/{shape}"].to_dataset()
        node = tree["truth"].children[shape]
        reference = mesh if "reference_point" in mesh else node.to_dataset(inherit=False)
        nodes[f"/{shape}"] = xr.merge(
            [reference[["reference_point"]], mesh[["label", "landmark_position"]]]
        )
        paths.append(folder / f"{shape}.ply")
        write_mesh(paths[-1], *as_arrays(mesh), label=mesh["label"].values)
    xr.DataTree.from_dict(nodes).to_netcdf(folder / "truth.nc", engine="h5netcdf")
    return paths


def example_study() -> xr.DataTree:
    """Analyse a small collection for examples: six brains of 200 vertices, three modes.

    Returns
    -------
    DataTree
        As from :func:`s4a.analyse`, in memory; the same in every call.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> study["registration"].sizes["vertex"], study["pca"].sizes["component"]
    (200, 5)
    """
    return analyse(brains(6, 200), n_coarse=100, k=10, k_init=6, n_pairs=6, alignment="given")


def sphere(n_vertices: int = 2562, radius: float = 1.0) -> xr.Dataset:
    """Return a sphere with vertices along a Fibonacci spiral and nearly equilateral triangles.

    Examples
    --------
    >>> import s4a
    >>> s4a.synthetic.sphere(100).sizes["triangle"]
    196
    """
    return ellipsoid(n_vertices, (radius,) * 3)


def ellipsoid(
    n_vertices: int = 2562, semi_axes: tuple[float, float, float] = (3.0, 2.0, 1.0)
) -> xr.Dataset:
    """Return an ellipsoid, the affine image of :func:`sphere`.

    Examples
    --------
    >>> import s4a
    >>> s4a.synthetic.ellipsoid(100)["position"].values.max(0).round(1).tolist()
    [3.0, 2.0, 1.0]
    """
    u, T = _sphere(n_vertices)
    return as_dataset(u * np.asarray(semi_axes), T)


def torus(
    n_around: int = 72, n_across: int = 36, radius: float = 3.0, thickness: float = 1.0
) -> xr.Dataset:
    """Return a torus around the z axis with a grid of `n_around` by `n_across` vertices.

    Its area is 4 pi^2 radius thickness.

    Parameters
    ----------
    n_around, n_across : int
    radius, thickness : float
        Radii of the centre line and of the tube.

    Examples
    --------
    >>> import s4a
    >>> s4a.synthetic.torus(12, 6).sizes["vertex"], s4a.synthetic.torus(12, 6).sizes["triangle"]
    (72, 144)
    """
    i, j = np.divmod(np.arange(n_around * n_across), n_across)
    a, b = 2 * np.pi * i / n_around, 2 * np.pi * j / n_across
    r = radius + thickness * np.cos(b)
    right, up = (i + 1) % n_around * n_across, (j + 1) % n_across
    here, corner = i * n_across, right + up
    T = np.stack([np.c_[here + j, right + j, corner], np.c_[here + j, corner, here + up]])
    return as_dataset(np.c_[r * np.cos(a), r * np.sin(a), thickness * np.sin(b)], T.reshape(-1, 3))
