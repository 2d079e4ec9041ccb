"""Brain-like collections of known correspondences and modes; small surfaces with known answers.

One reference brain is a smooth embedding of the unit sphere; the folds are part of it.  Every shape
is that brain moved by a smooth diffeomorphism of space, x -> x + sum_m s_m w_m(x) + individual
noise + tumour, and then by a rigid transform. The fields are sums of localised slides and turns,
exp(-|x - c|^2 / 2 w^2) (push + turn x (x - c)), so that :func:`position` gives the exact place of
every reference point (a point of the unit sphere) on every shape. Millimetres, and RAS: x to the
right, y to the front, z up.
"""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from s4a.geometry.align import farthest_samples
from s4a.geometry.compiled import fpsample
from s4a.geometry.mesh import as_arrays, as_dataset, edge_graph, edges, vertex_areas
from s4a.input.collection import read_shapes
from s4a.input.files import write_mesh
from s4a.schema import dataset, in_unit
from s4a.seeds import RNG, seed_of
from s4a.study.pipeline import analyse


def _soil(X, T, u, rng):
    """A clean mesh made as dirty as a file from a scanner.

    4 loose components of 12 to 60 vertices; 3 holes of 10 to 60 triangles; one bow-tie vertex for
    8,000 triangles; and one for 2,000 triangles of each of these: non-manifold edges, duplicate
    vertices (a seam half around the vertex), split edges with two zero-area triangles, duplicate
    triangles, flipped triangles, unreferenced vertices; of all of these at least 3.  Vertices and
    triangles are shuffled.

    Parameters
    ----------
    X, T : the mesh
    u : float ndarray (n, 3)
        Points of the unit sphere that the vertices are images of.
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
    """The triangles but for holes, and but for pairs at a vertex, whose star is a bow-tie then.

    The two have that vertex alone in common.
    """
    keep = np.ones(len(T), bool)
    middles = cKDTree(u[T].mean(1))
    for size in rng.integers(10, 60, 3):
        keep[middles.query(u[rng.integers(len(u))], size)[1]] = False
    for v in rng.choice(len(u), max(3, few // 4), replace=False):
        star = np.flatnonzero((T == v).any(1))
        apart = [t for t in star if len(np.intersect1d(T[t], T[star[0]])) == 1]
        keep[[star[0], *apart[:1]]] = False
    return T[keep]


def _duplicate_vertices(X, T, u, few, rng):
    """Triangles that use copies of some vertices, and the original of every vertex.

    A seam: half of the star of v gets a copy.  A split edge: a b c becomes m b c, a m c and a b m,
    m a copy of a.
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
    """Triangles of which some are there twice, and some flipped.

    Some edges have a third triangle then.
    """
    third, twice, flipped = rng.choice(len(T), (3, few), replace=False)
    beyond = cKDTree(u).query(u[T[third]].mean(1), 15)[1][:, -1]
    more = [np.c_[T[third, :2], beyond], np.roll(T[twice], 1, axis=1)]
    T = T.copy()
    T[flipped] = T[flipped, ::-1]
    return np.concatenate([T, *more])


def _debris(near, rng):
    """A small loose ellipsoid."""
    u = rng.normal(size=(int(rng.integers(12, 61)), 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return near * rng.uniform(0.8, 1.15) + u * rng.uniform(0.8, 3, 3), ConvexHull(u).simplices


_MODE_RMS = 4.5  # mm, root mean square displacement of mode 1 at one standard deviation
_MODE_RATIO = 0.6  # of each mode to the one before it
_NOISE_RMS = 0.4  # mm, of the individual noise: 8 slides 16 to 28 mm wide
_TUMOUR = (4.0, 7.0)  # mm, least and largest height, on a third of the shapes; 10 to 14 mm wide
_POSE = (10.0, 8.0)  # largest rotation in degrees, standard deviation of the translation in mm
_SEMI_AXES = np.array([64.0, 86.0, 61.0])

# Centre, width, push, turn and mirror of the slides and turns of each mode, on the right side; a
# mirror of 1 repeats it on the left as in a mirror, -1 with the opposite sign, 0 not at all.
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
    """exp(sharpness (cos angle - 1)) around a direction."""
    return np.exp(sharpness * (u @ _unit(centre) - 1))


def _step(x, width):
    """From 0 to 1 around x = 0."""
    return 0.5 * (1 + np.tanh(x / width))


def _fold_noise(p, wavelength=30.0, waves=48):
    """A random field of one wavelength whose zeros are the sulci, of unit variance.

    It is nearly mirror-symmetric in x.
    """
    rng = np.random.default_rng(20)
    k = rng.normal(size=(waves, 3))
    k *= 2 * np.pi / wavelength / np.linalg.norm(k, axis=1, keepdims=True)
    phase = rng.uniform(0, 2 * np.pi, waves)
    tilt = rng.normal(0, 0.35, waves)  # without it the field would be symmetric
    total = np.zeros(len(p))
    for (kx, ky, kz), a, b in zip(k, phase, tilt, strict=True):
        total += np.cos(kx * p[:, 0] + b) * np.cos(ky * p[:, 1] + kz * p[:, 2] + a)
    return total * 2 / np.sqrt(waves)


def reference_brain(u: ArrayLike) -> np.ndarray:
    """Positions (p, 3) in mm of points u (p, 3) of the unit sphere on the reference brain."""
    u = np.asarray(u, float)
    x, y, z = u.T
    side = np.abs(x)
    p = u * _SEMI_AXES
    mirrored = np.stack([np.sqrt(x**2 + 1e-3), y, z], axis=1)
    cerebellum = _bump(mirrored, (0.35, -0.72, -0.68), 9.0)
    stem = _bump(u, (0, -0.36, -0.93), 110.0)
    base = _bump(u, (0, 0.35, -0.94), 6.0)
    temporal = _bump(mirrored, (0.72, 0.25, -0.62), 10.0)
    # grooves: longitudinal fissure, Sylvian fissure, gap between cerebrum and cerebellum
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


def _fields(x, centre, width, push, turn):
    """Sum over the parts of exp(-|x - c|^2 / 2 w^2) (push + turn x (x - c)) at points x (p, 3)."""
    total = np.zeros_like(x)
    for c, w, a, b in zip(centre, width, push, turn, strict=True):
        d = x - c
        local = np.exp(np.einsum("px,px->p", d, d) * (-0.5 / w**2))
        total += local[:, None] * (a + d @ np.cross(b, np.eye(3)))
    return total


def _generators(n_modes):
    """Centres and widths of all parts, and their push and turn by each generator ``(g, parts, 6)``.

    The generators are the six rigid transforms, of one part of infinite width, and the modes as
    they are designed.
    """
    centre, width = [np.zeros(3)], [np.inf]
    moves = []  # mode, push and turn of each part after the first
    for m, mode in enumerate(MODES[:n_modes]):
        for c, w, push, turn, mirror in mode:
            for side in (1,) if mirror == 0 else (1, -1):
                flip = np.array([side, 1, 1])
                sign = 1 if side == 1 else mirror
                centre.append(flip * c)
                width.append(w)
                # a turn is mirrored as an axial vector: what flips it also changes its sense
                moves.append((m, sign * np.r_[flip * push, side * flip * turn]))
    rows = np.zeros((6 + n_modes, len(centre), 6))
    rows[:6, 0] = np.eye(6)
    for part, (m, move) in enumerate(moves, start=1):
        rows[6 + m, part] = move
    return np.array(centre), np.array(width), rows


def _true_modes(n_modes):
    """Centres and widths of all parts, and each mode's push and turn of them.

    On the reference brain the modes are orthogonal to rigid transforms and to each other: the
    Cholesky factor of the generators' Gram matrix is that of Gram and Schmidt.
    """
    if not 0 <= n_modes <= len(MODES):
        raise ValueError(f"n_modes needs a number from 0 to {len(MODES)}, found {n_modes}")
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
    """Truncated normal scores ``(n, n_modes)``; standard and uncorrelated of shapes enough."""
    while True:
        score = ndtri(rng.uniform(ndtr(-2.5), ndtr(2.5), (n, n_modes)))
        if n <= n_modes + 1:
            return score
        Q, R = np.linalg.qr(score - score.mean(0))
        score = Q * np.sign(np.diag(R)) * np.sqrt(n)
        if np.abs(score).max(initial=0) <= 2.5:
            return score


def _noise_regions(n, rng):
    """Centres, widths and pushes ``(n, 9, ...)`` of each shape's noise and, last, of its tumour."""
    centre = reference_brain(_random_directions(rng, n * 9)).reshape(n, 9, 3)
    width = np.concatenate([rng.uniform(16, 28, (n, 8)), rng.uniform(10, 14, (n, 1))], axis=1)
    push = rng.normal(size=(n, 9, 3))
    outwards = _random_directions(rng, n)
    outwards[:, 2] = np.abs(outwards[:, 2])  # a tumour is on the upper half
    centre[:, 8] = reference_brain(outwards)
    height = rng.uniform(*_TUMOUR, n) * (rng.permutation(n) < n // 3)
    push[:, 8] = outwards * height[:, None]
    x = reference_brain(_sphere(4000)[0])
    for c, w, a in zip(centre[:, :8], width[:, :8], push[:, :8], strict=True):
        a *= _NOISE_RMS / np.sqrt((_fields(x, c, w, a, 0 * a) ** 2).sum(1).mean())  # in push itself
    return centre, width, push


def plant(n: int = 12, seed: int = 0, *, n_modes: int = 3, rng: RNG | None = None) -> xr.Dataset:
    """The simulated parameters of a population: all that :func:`position` needs, without any mesh.

    Parameters
    ----------
    n : int
        Number of shapes.
    seed, rng : see :mod:`s4a.seeds`
    n_modes : int
        Number of simulated modes.

    Returns
    -------
    Dataset
        ``true_score(shape, true_mode)``, the parts of the modes, of each shape's noise and
        tumour (the last part; its push is zero where there is none), its pose, and the landmarks'
        reference points.

    Raises
    ------
    ValueError
        When there is no shape.

    Examples
    --------
    >>> import s4a
    >>> truth = s4a.synthetic.plant(6, seed=1)
    >>> truth["true_score"].std("shape").values.round(6).tolist()
    [1.0, 1.0, 1.0]
    """
    if n < 1:
        raise ValueError(f"a population needs n of 1 or more shapes, found {n}")
    seed = seed_of(seed, rng)
    draw = np.random.default_rng([seed, 0])
    centre, width, push, turn = _true_modes(n_modes)
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
        true_translation=push,
        true_rotation=turn,
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


def position(truth: xr.Dataset | xr.DataTree, shape: str, reference_point: ArrayLike) -> np.ndarray:
    """Exact positions of reference points on a shape.

    Parameters
    ----------
    truth : DataTree or Dataset
        ``tree["truth"]`` of :func:`brains`, or of :func:`plant`.
    shape : str
    reference_point : (p, 3)
        Points of the unit sphere.

    Returns
    -------
    float ndarray (p, 3)
        In mm; a row of NaN stays one.

    Examples
    --------
    >>> import s4a
    >>> s4a.synthetic.position(s4a.synthetic.plant(4), "brain_02", [[0, 1, 0], [0, -1, 0]]).shape
    (2, 3)
    """
    truth = truth.to_dataset() if isinstance(truth, xr.DataTree) else truth
    own = truth.isel(shape=_index(truth, shape))
    value = {name: v.values for name, v in own.data_vars.items()}
    x = reference_brain(reference_point)
    push = np.tensordot(value["true_score"], value["true_translation"], 1)  # (parts, 3)
    turn = np.tensordot(value["true_score"], value["true_rotation"], 1)
    noise_translation = value["noise_translation"]
    moved = x + _fields(x, value["true_centre"], value["true_width"], push, turn)
    moved += _fields(
        x, value["noise_centre"], value["noise_width"], noise_translation, 0 * noise_translation
    )
    return moved @ value["rotation"].T + value["translation"]


def _index(truth, shape):
    """Row of a shape in the truth."""
    names = truth["shape"].values.tolist()
    if shape not in names:
        raise ValueError(
            f"the truth needs the shape; found {shape!r}, and {', '.join(names)} in the truth"
        )
    return names.index(shape)


def _unit(x):
    x = np.asarray(x, float)
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def _random_directions(rng, n):
    return _unit(rng.normal(size=(n, 3)))


def _fibonacci(n):
    """Points spread evenly over the unit sphere along a spiral, n of them."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    angle = np.pi * (1 + np.sqrt(5)) * i  # by the golden section
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _delaunay(u):
    """Delaunay triangles of points of the unit sphere: their convex hull, oriented outwards."""
    T = ConvexHull(u).simplices
    inwards = np.einsum("ij,ij->i", np.cross(u[T[:, 0]], u[T[:, 1]]), u[T[:, 2]]) < 0
    T[inwards] = T[inwards][:, ::-1]
    return T


def _sphere(n):
    """Points ``(n, 3)`` and triangles of the unit sphere."""
    u = _fibonacci(n)
    return u, _delaunay(u)


def _mesh(truth, shape, n_vertices, rng):
    """Reference points and their triangles, the farthest on the shape of five times as many."""
    if n_vertices < 4:
        raise ValueError(f"a closed mesh needs n_vertices of 4 or more, found {n_vertices}")
    u = _fibonacci(5 * n_vertices) @ Rotation.random(random_state=rng).as_matrix().T
    u = _unit(u + rng.normal(0, 0.3 * np.sqrt(4 * np.pi / len(u)), u.shape))
    x = position(truth, shape, u).astype(np.float32)
    start = int(rng.integers(len(u)))
    if fpsample:
        h = min(7, int(np.log2(len(u))))  # levels of its tree, whose leaves must not be empty
        sample = fpsample.bucket_fps_kdline_sampling(x, n_vertices, h=h, start_idx=start)
    else:
        sample = farthest_samples(x, n_vertices, start)
    u = u[np.sort(sample)]
    return u, _delaunay(u)


def labels(reference_point: ArrayLike) -> np.ndarray:
    """Labels of reference points: the index in :data:`LABELS` of the nearest seed, 0 where NaN.

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
    """The mesh with labels and landmarks."""
    extra = dataset(
        label=labels(reference_point),
        landmark_name=truth["landmark_name"].values,
        landmark_position=position(truth, shape, truth["landmark_reference"].values),
    )
    extra["label"].attrs["names"] = LABELS
    return in_unit(mesh.merge(extra).assign_attrs(unit="mm", coordinate_system="RAS"), "mm")


def _raw_brain(truth, shape, n_vertices=40_000, seed=0, *, rng=None):
    """A brain with the artefacts of ``_soil``, as it could lie in a file.

    Parameters
    ----------
    truth, shape : as of :func:`position`
    n_vertices : int
        Before the artefacts are put in.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    points : float ndarray (p, 3)
    triangles : int32 ndarray (m, 3)
    reference_point : float ndarray (p, 3)
        NaN in loose components and at unreferenced vertices.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.datasets.synthetic import _raw_brain
    >>> truth = s4a.synthetic.plant(2)
    >>> points, triangles, reference_point = _raw_brain(truth, "brain_01", 500)
    >>> len(points) > 500, bool(np.isnan(reference_point).any())
    (True, True)
    """
    seed = seed_of(seed, rng)
    i = _index(truth, shape)
    u, T = _mesh(truth, shape, n_vertices, np.random.default_rng([seed, 1, i]))
    return _soil(position(truth, shape, u), T, u, np.random.default_rng([seed, 2, i]))


def _reference_after_cleaning(mesh, raw, reference_point):
    """Reference points of the cleaned vertices; its neighbours' mean where a vertex was moved."""
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
) -> xr.DataTree:
    """A population of brains with simulated modes and exact correspondences.

    Parameters
    ----------
    n : int
        Number of shapes.
    n_vertices : int
        Vertices of each, exactly unless `dirty`.  The population does not depend on it.
    seed, rng : see :mod:`s4a.seeds`
    dirty : bool
        Whether the meshes are those of ``_raw_brain``, cleaned; ``/raw/<shape>`` then holds them
        as they were.
    n_modes : int
        Number of simulated modes.

    Returns
    -------
    DataTree
        ``/original/<shape>`` and ``/report`` as of ``read_shapes``, with labels and landmarks;
        ``/truth``, see :func:`plant`; and in ``/truth/<shape>`` the ``reference_point(vertex,
        xyz)`` of every vertex.  Of the few vertices that cleaning puts on an edge it is that of a
        point nearby, all others are exact.

    Notes
    -----
    Modes slide material along the surface, so that the nearest vertex after a rigid alignment is
    wrong by 2.5 % of sqrt(area) in the mean over the pairs of 12 shapes; the folds move along, and
    give the truth away.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> tree = s4a.synthetic.brains(3, 500)
    >>> mesh, truth = tree["original/brain_02"], tree["truth"]
    >>> exact = s4a.synthetic.position(truth, "brain_02", truth["brain_02/reference_point"])
    >>> np.abs(exact - mesh["position"]).max().item() < 1e-9
    True

    Four of them:

    >>> shapes = s4a.synthetic.brains(4, 3000)["original"].children
    >>> s4a.show.charts.surfaces({name: mesh.to_dataset() for name, mesh in shapes.items()})
    <Parts ...>
    """
    seed = seed_of(seed, rng)
    truth = plant(n, seed, n_modes=n_modes)
    raw = {}
    for i, shape in enumerate(truth["shape"].values.tolist()):
        if dirty:
            raw[shape] = _raw_brain(truth, shape, n_vertices, seed)
        else:
            u, T = _mesh(truth, shape, n_vertices, np.random.default_rng([seed, 1, i]))
            raw[shape] = position(truth, shape, u), T, u
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
    """Write a collection as files: ``<shape>.ply`` with labels, and ``truth.nc``.

    Parameters
    ----------
    tree : DataTree
        Of :func:`brains`; the raw meshes are written where it has them.
    folder : path
        Made where it is missing.

    Returns
    -------
    list of Path
        The PLY files.  ``xarray.open_datatree("truth.nc")`` is the truth for :func:`position`, with
        each file's ``reference_point`` in the order of its vertices, and its landmarks.

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
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
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
    """A small study to try things on: six brains of 200 vertices and their three modes.

    Returns
    -------
    DataTree
        As of ``s4a.analyse``, in memory, made in two to four seconds; the same every time.

    Examples
    --------
    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> study["registration"].sizes["vertex"], study["pca"].sizes["component"]
    (200, 5)
    """
    return analyse(brains(6, 200), n_coarse=100, k=10, k_init=6, n_pairs=6)


def sphere(n_vertices: int = 2562, radius: float = 1.0) -> xr.Dataset:
    """A sphere with vertices along a Fibonacci spiral, triangles nearly equilateral.

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
    """An ellipsoid, the affine image of :func:`sphere`.

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
    """A torus around the z axis: a grid of `n_around` by `n_across` vertices.

    Area 4 pi^2 radius thickness.

    Parameters
    ----------
    n_around, n_across : int
    radius, thickness : float
        Of the circle in the middle of the tube, and of the tube.

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
