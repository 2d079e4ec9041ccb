"""Registered studies of an ellipsoid with simulated displacements, fields and tables."""

import numpy as np
import xarray as xr

from s4a import synthetic
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method.pca import pca
from s4a.schema import dataset

X, T = as_arrays(synthetic.ellipsoid(400))
TOP, HEIGHT = X[:, 2] > 0.3, X[:, 2]


def study_of(d, **columns):
    """A study of given displacements (s, n, 3), with labels of the template."""
    names = [f"shape_{i:02d}" for i in range(len(d))]
    mesh = as_dataset(X, T, {"template": names[0]}).merge(dataset(displacement=d))
    mesh["confidence"] = ("shape", "vertex"), np.tile(np.where(TOP, 0.9, 0.2), (len(d), 1))
    mesh["scale"] = ("shape",), np.ones(len(d))
    mesh = mesh.assign_coords(shape=names)
    table = xr.Dataset({n: ("shape", v) for n, v in columns.items()}, {"shape": names})
    original = as_dataset(X, T).merge(dataset(label=np.where(TOP, 7, 3)))
    nodes = {"registration": mesh, "subjects": table, f"original/{names[0]}": original}
    return xr.DataTree.from_dict(nodes | {"pca": pca(mesh, vertex_areas(X, T))})


def noise(seed, s, size=0.1):
    """Smooth random fields (s, n, 3)."""
    rng = np.random.default_rng(seed)
    k, phase = rng.normal(size=(10, 3)), rng.uniform(0, 6, 10)
    return size * np.einsum("swx,nw->snx", rng.normal(size=(s, 10, 3)), np.cos(X @ k.T + phase))


def with_transferred(study, values, unit="mm"):
    """The study with a field that is on the template already."""
    field = dataset(transferred_field=values).assign_coords(
        shape=study["registration"]["shape"].values
    )
    field["transferred_field"].attrs["units"] = unit
    return xr.DataTree.from_dict(
        {n.path: n.to_dataset(inherit=False) for n in study.subtree} | {"/fields/thickness": field}
    )


def pattern(seed, s):
    """Smooth random fields (s, n)."""
    return noise(seed, s, size=1.0)[..., 0]


def field_study():
    """Twenty shapes whose field is thicker above in group b, grows with age, and follows shape."""
    rng = np.random.default_rng(0)
    group, age = np.repeat(["a", "b"], 10), rng.permutation(20) * 1.0
    score = rng.normal(size=20)
    d = noise(1, 20) + score[:, None, None] * X * [0.5, 0, 0]
    values = 0.5 * pattern(2, 20) + 3 + 4.0 * (group == "b")[:, None] * TOP
    values += 0.2 * (age - 9.5)[:, None] * ~TOP + 3 * score[:, None] * HEIGHT
    return with_transferred(study_of(d, group=group, age=age, score=score), values)
