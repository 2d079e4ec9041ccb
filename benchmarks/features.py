"""Fields that guide registration: what they help, and what they cost where they say nothing.

``features.py``: mean error in % of sqrt(area) without a field and with one of several weights.  Two
pairs of synthetic brains of 6,000 vertices, whose field is a smooth function of the true place,
with and without noise of half its standard deviation at every vertex; and an ellipsoid twisted
within its own surface, of which nothing but the field tells.  With the shared data beside the
checkout also two cortex templates with the depth below their convex hulls, by the share of vertices
that get the right one of 35 labels, in %: a field that the surfaces have told already.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from peers import DATA, cortex, image_of
from scipy.spatial import ConvexHull

import s4a
from s4a import synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas

WEIGHTS = (0.5, 1.0, 2.0, 4.0)
NOISE = 0.5  # of the standard deviation of a field


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def registered(template, shape, fields, weight, **options):
    """The template's vertices on the shape, guided by a field of both, or by none."""
    if weight:
        template, shape = (
            s4a.with_features(mesh, {"field": values}, weight=weight)
            for mesh, values in zip((template, shape), fields, strict=True)
        )
    return image_of(s4a.match_pair(shape, template, **options), template)


def brains(noise):
    """Error of two pairs ``(1 + weights,)``."""
    tree = synthetic.brains(4, 6000, seed=5)
    rng = np.random.default_rng(0)
    rows = []
    for pair in (("brain_01", "brain_02"), ("brain_02", "brain_03")):
        meshes = [tree["original"][name].to_dataset() for name in pair]
        places = [tree["truth"][name]["reference_point"].values for name in pair]
        true = synthetic.position(tree["truth"], pair[1], places[0])
        fields = [
            np.sin(4 * u[:, 0] + 1) + np.cos(5 * u[:, 1]) * np.sin(3 * u[:, 2]) for u in places
        ]
        fields = [f + noise * f.std() * rng.normal(size=len(f)) for f in fields]
        unit = 100 / np.sqrt(vertex_areas(*as_arrays(meshes[1])).sum())
        rows.append(
            [
                unit * np.linalg.norm(image - true, axis=1).mean()
                for image in (
                    registered(*meshes, fields, weight, n_coarse=2000) for weight in (0, *WEIGHTS)
                )
            ]
        )
    return np.mean(rows, axis=0)


def twisted():
    """Error of an ellipsoid on itself, twisted ``(1 + weights,)``."""
    axes = np.array([1.0, 1.3, 2.0])
    X, T = as_arrays(synthetic.ellipsoid(3000, axes))
    u, angle = X / axes, 0.2 * X[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    u = np.stack([c * u[:, 0] - s * u[:, 1], s * u[:, 0] + c * u[:, 1], u[:, 2]], axis=1)
    field = np.sin(2 * X[:, 0]) + X[:, 1] * X[:, 2]
    meshes = [s4a.clean(as_dataset(Y, T)) for Y in (X, u * axes)]
    unit = 100 / np.sqrt(vertex_areas(X, T).sum())
    images = (
        registered(*meshes, (field, field), weight, n_coarse=1000) for weight in (0, *WEIGHTS)
    )
    return [unit * np.linalg.norm(image - u * axes, axis=1).mean() for image in images]


def depth(mesh):
    """How far every vertex lies below the convex hull ``(n,)``, as a square root."""
    X = mesh["position"].values.astype(float)
    planes = ConvexHull(X).equations
    return np.sqrt(np.maximum(-(X @ planes[:, :3].T + planes[:, 3]).max(1), 0))


def row(name, values):
    say(f"| {name} | {' | '.join(f'{value:.3f}' for value in values)} |")


if __name__ == "__main__":
    heads = ["no field", *(f"weight {weight:g}" for weight in WEIGHTS)]
    say(f"| | {' | '.join(heads)} |\n|{' --- |' * (1 + len(heads))}")
    row("two pairs of brains, error", brains(0.0))
    row("with noise at every vertex", brains(NOISE))
    row("a twisted ellipsoid, error", twisted())
    if DATA.is_dir():
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            (place / "brains").symlink_to(DATA / "brain_templates" / "fsaverage5_conte69")
            for pair in (("conte69", "fsa5"), ("fsa5", "conte69")):
                ((name, template, shape, measure),) = cortex(place, [pair])
                fields = depth(template), depth(shape)
                right = [
                    measure(registered(template, shape, fields, weight))[0]
                    for weight in (0, *WEIGHTS)
                ]
                row(name, right)
