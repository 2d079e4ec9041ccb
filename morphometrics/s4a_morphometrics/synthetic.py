"""Two structures of each subject, with known poses and shapes."""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from s4a.datasets.synthetic import sphere
from s4a.geometry.align import rigid_transform
from s4a.geometry.mesh import as_dataset, vertex_areas
from s4a.schema import check_count
from s4a.seeds import RNG, seed_of
from s4a_morphometrics.several import analyse_structures

AXES = (12.0, 7.0, 5.0)  # mm, half
SIDES = {"left": -1.0, "right": 1.0}
APART = 16.0  # mm from the middle
TURN, SHIFT = 0.12, 1.5  # standard deviations of poses, rad and mm
LENGTH, BEND = 0.12, 1.2  # of shapes: a share, and mm


def bean(u: ArrayLike, length: float = 0.0, bend: float = 0.0) -> np.ndarray:
    """Points ``(n, 3)`` in mm of a bent, tapered ellipsoid, of unit vectors ``(n, 3)``.

    Parameters
    ----------
    u : array_like (n, 3)
    length, bend : float
        How much longer, as a share, and how much more bent, in mm.

    Examples
    --------
    >>> from s4a_morphometrics.synthetic import bean
    >>> bean([[0, 1, 0], [0, -1, 0]]).round(1).tolist()
    [[0.0, 7.0, -1.0], [0.0, -7.0, -1.0]]
    """
    x, y, z = np.asarray(u, float).T
    thick = 1 + 0.25 * x
    return np.column_stack(
        [
            AXES[0] * (1 + length) * x,
            AXES[1] * thick * y,
            AXES[2] * thick * z + (3 + bend) * x**2 - 1 - 2.5 * x * y,
        ]
    )


def subjects(
    n: int = 8,
    n_vertices: int = 300,
    *,
    pose: float = 1.0,
    shape: float = 1.0,
    seed: int = 0,
    rng: RNG | None = None,
) -> dict[str, dict[str, xr.Dataset]]:
    """Subjects with a left and a right structure in the frame of one scan.

    Parameters
    ----------
    n, n_vertices : int
        Subjects, and vertices of each structure.
    pose, shape : float
        How much the structures vary in their poses, and in their shapes, which have none of it: 0
        for not at all.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    dict of dict of Dataset
        For :func:`s4a_morphometrics.analyse_structures`: ``{"subject_1": {"left": mesh, "right":
        mesh}, ...}``; each mesh has ``reference_point(vertex, xyz)``, by which those of all
        subjects correspond.  Vertices
        lie elsewhere in every subject, and each scan has another frame.

    Examples
    --------
    >>> from s4a_morphometrics.synthetic import subjects
    >>> two = subjects(2, 100)
    >>> list(two), list(two["subject_1"]), two["subject_1"]["left"].sizes["vertex"]
    (['subject_1', 'subject_2'], ['left', 'right'], 100)
    """
    check_count("n", n, 1)
    random = np.random.default_rng(seed_of(seed, rng))
    u, T = (sphere(n_vertices)[name].values for name in ("position", "corner_vertex"))
    width = len(str(n))
    found: dict[str, dict[str, xr.Dataset]] = {}
    for i in range(1, n + 1):
        frame = Rotation.from_rotvec(0.3 * random.normal(size=3))
        place = 20 * random.normal(size=3)
        of: dict[str, xr.Dataset] = {}
        for name, side in SIDES.items():
            own = u @ Rotation.random(rng=random).as_matrix().T
            turn, shift, how = random.normal(size=3), random.normal(size=3), random.normal(size=2)
            X = _without_pose(bean(own, *(shape * how * [LENGTH, BEND])), bean(own), T)
            X = X * [side, 1, 1] @ Rotation.from_rotvec(pose * TURN * turn).as_matrix().T
            X = X + [side * APART, 0, 0] + pose * SHIFT * shift
            triangles = T if side > 0 else T[:, ::-1]
            of[name] = as_dataset(frame.apply(X) + place, triangles, reference_point=own)
        found[f"subject_{i:0{width}d}"] = of
    return found


def _without_pose(X, mean, T):
    """Points moved as one to where they lie best on their mean."""
    R, t, _ = rigid_transform(X, mean, vertex_areas(mean, T))
    return X @ R.T + t


def example_structures() -> xr.DataTree:
    """A small study of several structures: six subjects, a left and a right of 200 vertices each.

    Returns
    -------
    DataTree
        As of :func:`s4a_morphometrics.analyse_structures`, in memory, made in some seconds; the
        same every time.

    Examples
    --------
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> list(example_structures()["structures"].children)
    ['left', 'right']
    """
    return analyse_structures(subjects(6, 200), n_coarse=100, k=10, k_init=6, n_pairs=6)
