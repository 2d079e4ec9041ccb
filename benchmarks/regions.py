"""Regions and nuisances (6.1): error and power of tests in a part of what varies, simulated.

``python benchmarks/regions.py [RUNS]``: smooth fields on an ellipsoid of 200 vertices, two
groups of ten that differ in a region of a sixth of the area, or nowhere, and a nuisance that moves
all.  Error is how often groups are reported apart at 0.05, as whole shapes and at any vertex after
the correction for all, where nothing is; power how often as whole shapes, and the share of the
region's vertices, in every fifth run.
"""

import sys

import numpy as np
import xarray as xr

import s4a
from s4a import statistics
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method.pca import pca
from s4a.schema import dataset
from s4a_morphometrics import within, without

X, T = as_arrays(s4a.synthetic.ellipsoid(200))
REGION = X[:, 2] > np.quantile(X[:, 2], 5 / 6)
GROUP = np.repeat(["a", "b"], 10)
EFFECT, NUISANCE = 0.35, 1.0
OPTIONS = {"n_permutations": 99}


def study_of(d: np.ndarray) -> xr.DataTree:
    """A study of given displacements (s, n, 3)."""
    names = [f"shape_{i:02d}" for i in range(len(d))]
    mesh = as_dataset(X, T, {"template": names[0]}).merge(dataset(displacement=d))
    mesh = mesh.assign_coords(shape=names)
    return xr.DataTree.from_dict({"registration": mesh, "pca": pca(mesh, vertex_areas(X, T))})


def draw(run: int, effect: float) -> tuple[xr.DataTree, np.ndarray]:
    """A study, and its nuisance."""
    rng = np.random.default_rng([run, int(effect > 0)])
    k, phase = rng.normal(size=(12, 3)), rng.uniform(0, 6, 12)
    d = 0.1 * np.einsum("swx,nw->snx", rng.normal(size=(20, 12, 3)), np.cos(X @ k.T + phase))
    opening = rng.normal(size=20)
    d += NUISANCE * opening[:, None, None] * X * [0, 0.2, 0]
    d += effect * (GROUP == "b")[:, None, None] * REGION[:, None] * [0, 0, 1]
    return study_of(d), opening


WAYS = {
    "whole": lambda study, opening: study,
    "region": lambda study, opening: within(study, REGION),
    "without the nuisance": without,
    "both": lambda study, opening: within(without(study, opening), REGION),
}


def found(study: xr.DataTree, run: int) -> tuple[bool, np.ndarray]:
    """Whether the groups differ, and the family-wise p of the vertices."""
    whole = statistics.group_test(study, GROUP, seed=run, **OPTIONS)["p_value"].item() <= 0.05
    return whole, statistics.group_map(study, GROUP, seed=run, **OPTIONS)["p_family_wise"].values


def rates(way: str, runs: int) -> list[float]:
    """Error of whole shapes and vertices, power of both."""
    said = np.full((runs, 4), np.nan)
    for run in range(runs):
        whole, p = found(WAYS[way](*draw(run, 0.0)), run)
        said[run, :2] = whole, p.min() <= 0.05
        if run % 5 == 0:
            part = WAYS[way](*draw(run, EFFECT))
            whole, p = found(part, run)
            vertex = part["registration"].get("template_vertex", np.arange(len(X)))
            said[run, 2:] = whole, (p[REGION[np.asarray(vertex)]] <= 0.05).mean()
    return np.nanmean(said, axis=0).tolist()


if __name__ == "__main__":
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    head = ["", "error, whole", "error, vertices", "power, whole", "power, vertices"]
    sys.stdout.write(f"{runs} runs a row\n\n| {' | '.join(head)} |\n|{' --- |' * len(head)}\n")
    for way in WAYS:
        cells = " | ".join(f"{rate:.3f}" for rate in rates(way, runs))
        sys.stdout.write(f"| {way} | {cells} |\n")
        sys.stdout.flush()
