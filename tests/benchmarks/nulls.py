"""Family-wise error and power of the tests at vertices (6.1), simulated.

``python tests/benchmarks/nulls.py [RUNS]``: fields of random vectors at 40 vertices, with nothing
to find or with an effect of 1.5 standard deviations at four of them; how often the smallest p value
corrected for all vertices is at most 0.05, and how many of the four are found.
"""

import sys
from collections.abc import Iterator

import numpy as np

from s4a.analysis.permutation import indicators, vertex_test

N_VERTICES, N_PLANTED, EFFECT = 40, 4, 1.5
N_PERMUTATIONS = 199


def settings() -> Iterator[tuple[str, int, int, str]]:
    """Name, shapes, columns of covariates and kind of each setting."""
    for n, c in ((20, 0), (20, 1), (20, 5), (20, 8), (12, 1), (12, 5), (40, 8)):
        yield f"{n} shapes, {c} random covariates", n, c, "variable"
    yield "20 shapes, a covariate of five sites", 20, 4, "sites"
    yield "20 shapes, groups of 5 and 15, 5 covariates", 20, 5, "groups"
    yield "20 shapes, groups of 10 and 10 of 1 and 2 sd, 5 covariates", 20, 5, "variances"


def draw(rng: np.random.Generator, n: int, c: int, kind: str) -> tuple:
    """Fields ``(n, v, 3)`` of noise, what is tested ``(n,)``, covariates ``(n, c)`` or None."""
    d = rng.normal(size=(n, N_VERTICES, 3))
    x = rng.normal(size=n)
    covariates = rng.normal(size=(n, c)) if c else None
    if kind == "sites":
        covariates = indicators(rng.permutation(np.arange(n) % 5))[1]
    if kind in ("groups", "variances"):
        x = (rng.permutation(n) < (5 if kind == "groups" else n // 2)).astype(float)
    if kind == "variances":
        d *= 1 + x[:, None, None]
    return d, x, covariates


def rates(n: int, c: int, kind: str, runs: int) -> tuple[float, float]:
    """Share of nulls in which anything is found, and of planted effects that are found."""
    false, found = 0, 0
    for run in range(runs):
        d, x, covariates = draw(np.random.default_rng([n, c, run]), n, c, kind)
        options = {"covariates": covariates, "n_permutations": N_PERMUTATIONS, "seed": run}
        false += vertex_test(d, x, **options)[2].min() <= 0.05
        d[:, :N_PLANTED, 0] += EFFECT * (x[:, None] - x.mean()) / x.std()
        found += (vertex_test(d, x, **options)[2][:N_PLANTED] <= 0.05).mean()
    return false / runs, found / runs


if __name__ == "__main__":
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    sys.stdout.write(f"{runs} runs a row\n\n| | family-wise error | power |\n| --- | --- | --- |\n")
    for name, *setting in settings():
        error, power = rates(*setting, runs)
        sys.stdout.write(f"| {name} | {error:.3f} | {power:.2f} |\n")
        sys.stdout.flush()
