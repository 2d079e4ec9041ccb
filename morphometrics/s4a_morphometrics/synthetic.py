"""Synthetic subjects with two structures of known poses and shapes."""

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

AXES = (12.0, 7.0, 5.0)  # semi-axes in mm
SIDES = {"left": -1.0, "right": 1.0}
DISTANCE = 16.0  # mm from the midplane
ROTATION, TRANSLATION = 0.12, 1.5  # standard deviations of poses, rad and mm
LENGTH, BEND = 0.12, 1.2  # standard deviations of shapes, relative and in mm


def bean(u: ArrayLike, length: float = 0.0, bend: float = 0.0) -> np.ndarray:
    """Map unit vectors ``(n, 3)`` to a bent, tapered ellipsoid ``(n, 3)`` in mm.

    Parameters
    ----------
    u : array_like (n, 3)
    length, bend : float
        Relative increase of the length, and increase of the bending in mm.

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
    """Simulate subjects with a left and a right structure in the frame of one scan.

    Parameters
    ----------
    n, n_vertices : int
        Number of subjects, and of vertices of each structure.
    pose, shape : float
        Amount of variation of the poses, and of the shapes without pose; 0 for none.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    dict of dict of Dataset
        For :func:`s4a_morphometrics.analyse_structures`: ``{"subject_1": {"left": mesh, "right":
        mesh}, ...}``; each mesh has ``reference_point(vertex, xyz)``, which defines the
        correspondence of all subjects.  Every subject has other vertices, and every scan another
        frame.

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
    subjects: dict[str, dict[str, xr.Dataset]] = {}
    for i in range(1, n + 1):
        frame = Rotation.from_rotvec(0.3 * random.normal(size=3))
        offset = 20 * random.normal(size=3)
        structures: dict[str, xr.Dataset] = {}
        for name, side in SIDES.items():
            points = u @ Rotation.random(rng=random).as_matrix().T
            rotation, translation = random.normal(size=3), random.normal(size=3)
            change = shape * random.normal(size=2) * [LENGTH, BEND]
            X = _without_pose(bean(points, *change), bean(points), T)
            X = X * [side, 1, 1] @ Rotation.from_rotvec(pose * ROTATION * rotation).as_matrix().T
            X = X + [side * DISTANCE, 0, 0] + pose * TRANSLATION * translation
            triangles = T if side > 0 else T[:, ::-1]
            structures[name] = as_dataset(
                frame.apply(X) + offset, triangles, reference_point=points
            )
        subjects[f"subject_{i:0{width}d}"] = structures
    return subjects


def _without_pose(X, mean, T):
    """Align points rigidly to their mean."""
    R, t, _ = rigid_transform(X, mean, vertex_areas(mean, T))
    return X @ R.T + t


def example_structures() -> xr.DataTree:
    """Analyse a small multi-structure example: six subjects, left and right of 200 vertices.

    Returns
    -------
    DataTree
        From :func:`s4a_morphometrics.analyse_structures`, in memory; the same in every call.

    Examples
    --------
    >>> from s4a_morphometrics.synthetic import example_structures
    >>> list(example_structures()["structures"].children)
    ['left', 'right']
    """
    return analyse_structures(subjects(6, 200), n_coarse=100, k=10, k_init=6, n_pairs=6)
