"""Fields (6.1): error and power of tests of scalar fields, and of field against shape, simulated.

``python benchmarks/fields.py [RUNS]``: smooth fields and displacements on an ellipsoid of 200
vertices.  Error is how often something is found at 0.05 where nothing is: groups at any vertex
after the correction for all, and by the whole field; field against shape by the correlation of the
first pair (r-PLS), its covariance, and RV.  Power is the share of the vertices of a sixth of the
area where groups differ that are found, and how often the others find what is simulated, in every
fifth run.
"""

import sys

import numpy as np
import xarray as xr

import s4a
from s4a.geometry.mesh import as_arrays, as_dataset
from s4a.schema import dataset
from s4a_morphometrics import covariation, field_group_map, field_group_test

X, T = as_arrays(s4a.synthetic.ellipsoid(200))
REGION = X[:, 2] > np.quantile(X[:, 2], 5 / 6)
FIELD, OPTIONS = "thickness", {"n_permutations": 99}
EFFECT, FOLLOWS = 1.5, 0.3  # of the group; of the score of shape
HEAD = [
    "", "error, vertices", "error, whole", "error, r-PLS", "error, covariance", "error, RV",
    "power, vertices", "power, whole", "power, r-PLS", "power, covariance", "power, RV",
]  # fmt: skip
SETTINGS = [(12, 0, "normal"), (20, 0, "normal"), (40, 0, "normal"), (20, 3, "normal")]
SETTINGS += [(20, 0, "skewed"), (20, 3, "skewed")]


def smooth(rng: np.random.Generator, weights: np.ndarray) -> np.ndarray:
    """Sums of ten waves (s, n) with these weights (s, 10)."""
    k, phase = rng.normal(size=(10, 3)), rng.uniform(0, 6, 10)
    return weights @ np.cos(X @ k.T + phase).T / np.sqrt(5)


def draw(
    run: int, setting: tuple[int, int, str], effect: float
) -> tuple[xr.DataTree, np.ndarray, np.ndarray | None]:
    """A study with a field, its groups and covariates."""
    n, n_covariates, kind = setting
    rng = np.random.default_rng([run, n, n_covariates, int(effect > 0)])
    group = np.repeat(["a", "b"], n // 2)
    Z = rng.normal(size=(n, n_covariates)) if n_covariates else None

    def weights():
        if kind == "skewed":
            return rng.exponential(size=(n, 10)) - 1
        return rng.normal(size=(n, 10))

    d = 0.1 * np.stack([smooth(rng, weights()) for _ in range(3)], axis=-1)
    score = rng.normal(size=n)
    field = smooth(rng, weights())
    d += 0.05 * score[:, None, None] * X
    if effect:
        field += effect * (group == "b")[:, None] * REGION
        field += FOLLOWS * score[:, None] * X[:, 0]
    names = [f"shape_{i:02d}" for i in range(n)]
    mesh = as_dataset(X, T, {"template": names[0]}).merge(dataset(displacement=d))
    nodes = {"registration": mesh, "fields/thickness": dataset(transferred_field=field)}
    nodes = {path: node.assign_coords(shape=names) for path, node in nodes.items()}
    return xr.DataTree.from_dict(nodes), group, Z


def found(run: int, setting: tuple[int, int, str], effect: float) -> list[float]:
    """Whether, or where, the five tests find something."""
    study, group, Z = draw(run, setting, effect)
    options = {**OPTIONS, "covariates": Z, "seed": run}
    p = field_group_map(study, FIELD, group, **options)["p_family_wise"].values
    at = (p[REGION] <= 0.05).mean() if effect else p.min() <= 0.05
    whole = field_group_test(study, FIELD, group, **options)["p_value"].item() <= 0.05
    pairs = covariation(study, FIELD, **options)
    by = (pairs["p_value"], pairs["singular_p"][0], pairs["rv_p"])
    return [at, whole, *(p.item() <= 0.05 for p in by)]


def rates(setting: tuple[int, int, str], runs: int) -> list[float]:
    """The ten numbers of a row."""
    said = np.full((runs, 10), np.nan)
    for run in range(runs):
        said[run, :5] = found(run, setting, 0.0)
        if run % 5 == 0:
            said[run, 5:] = found(run, setting, EFFECT)
    return np.nanmean(said, axis=0).tolist()


if __name__ == "__main__":
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    sys.stdout.write(f"{runs} runs a row\n\n| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}\n")
    for n, n_covariates, kind in SETTINGS:
        cells = " | ".join(f"{rate:.3f}" for rate in rates((n, n_covariates, kind), runs))
        beside = f", {n_covariates} covariates" if n_covariates else ""
        sys.stdout.write(f"| {n} shapes{beside}, {kind} | {cells} |\n")
        sys.stdout.flush()
