"""Surfaces of genus above zero with ground truth: tori, double tori and vertebrae.

``genus.py [tori] [double_tori] [vertebrae]``: four shapes of each kind, all in one pose, with the
errors of ``s4a.analyse`` for the pose as given and for the search, in % of sqrt(area).  Double tori
and vertebrae are smooth deformations of one surface, each with vertices of its own, so that the
true position of every vertex is known.  The vertebra is that of the shared data beside the
checkout; ``alignment.py vertebrae`` measures real ones by landmarks.
"""

import logging
import sys

import numpy as np
from additions import DATA, remeshed
from alignment import say, title, torus, torus_angles, torus_position

import s4a
from s4a.geometry.mesh import as_arrays, vertex_areas

N_SHAPES = 4
OPTIONS = {"n_coarse": 1000, "k": 40, "intersections": False}
ROWS = (
    {"alignment": "given"},
    {"alignment": "given", "refine": "intrinsic"},
    {"alignment": "search"},
)


def deformed(x, seed):
    """Positions (n, 3) after a smooth deformation; x is in units of sqrt(area)."""
    rng = np.random.default_rng(seed)
    wave, shift = rng.normal(0, 3, (6, 3)), rng.normal(0, 0.02, (6, 3))
    phase = rng.uniform(0, 2 * np.pi, 6)
    return x + np.sin(x @ wave.T + phase) @ shift


def tori():
    """Parameters of the vertices of each torus, and triangles; true positions of parameters."""
    for seed in range(N_SHAPES):
        yield torus_angles(seed).T, torus(seed)[1]


def double_tori():
    """Points of one double torus with the vertices of different grids."""
    from skimage.measure import marching_cubes

    for seed in range(N_SHAPES):
        step, first = 0.035 + 0.001 * seed, np.array([-0.3, -0.8, -0.3])
        x, y, z = (first + step * np.indices((76, 46, 18)).T).T
        X, T, *_ = marching_cubes((x * (x - 1) ** 2 * (x - 2) + y**2) ** 2 + z**2, 0.02)
        yield in_units(first + step * X, T)


def vertebrae():
    """Points of one vertebra, remeshed with different edge lengths."""
    X, T = as_arrays(s4a.read_shape(DATA / "vertebrae" / "sub-verse010_segment_20.ply"))
    for seed in range(N_SHAPES):
        yield in_units(*as_arrays(remeshed(X, T, 4000 + 300 * seed, subdivisions=1)))


def in_units(X, T):
    """Centred points in units of sqrt(area), the same for all shapes up to discretization."""
    return (X - X.mean(0)) / np.sqrt(vertex_areas(X, T).sum()), T


def torus_of(x, seed):
    """Positions of the angles of a torus."""
    return torus_position(seed, *x.T)


SETS = {"tori": (tori, torus_of), "double_tori": (double_tori, deformed)}
SETS["vertebrae"] = vertebrae, deformed


def measure(points, image, options):
    """Mean errors of the shapes in %, and the number of flagged ones."""
    meshes = {f"shape_{i}": (image(x, i), T) for i, (x, T) in enumerate(points)}
    study = s4a.analyse(meshes, **OPTIONS, **options, include_flagged=True)
    registration = study["registration"]
    template = registration.attrs["template"]
    x = points[int(template[-1])][0][study["original"][template]["file_vertex"].values]
    size = np.sqrt(registration["vertex_area"].values.sum())
    errors = []
    for name in meshes:
        if name != template:
            match = registration["registered_match"].sel(shape=name).values
            found = study["original"][name]["position"].values[match]
            off = np.linalg.norm(found - image(x, int(name[-1])), axis=1)
            errors.append(100 * off.mean() / size)
    return errors, (study["report"]["status"].values == "flagged").sum()


def main(names):
    title("surfaces", "genus", "options", "mean error", "worst shape", "flagged")
    for name in names or SETS:
        make, image = SETS[name]
        points = list(make())
        genus = 1 - s4a.geometry.mesh.euler_characteristic(points[0][1]) // 2
        for options in ROWS:
            errors, flagged = measure(points, image, options)
            words = ", ".join(f'`{key}="{value}"`' for key, value in options.items())
            cells = f"{np.mean(errors):.1f}", f"{max(errors):.1f}", flagged
            say(name.replace("_", " "), genus, words, *cells)


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    main(sys.argv[1:])
