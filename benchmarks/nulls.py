"""Error and power of the tests of groups and variables (6.1), simulated.

``python benchmarks/nulls.py [RUNS [WORD]]``: fields of random vectors at 40 vertices and six
scores, with nothing to find or with a simulated effect; rows whose name holds WORD.  Error is how
often something is found where nothing is: at the vertices a p value of at most 0.05 after the
correction for all, or one of the whole shape.  Power is the share of four simulated vertices that
are found, and how often the whole shape is, in every fifth run.  Without WORD the tests at vertices
are set beside a t test of each with the correction of Bonferroni, too.
"""

import sys
from typing import NamedTuple

import numpy as np
from scipy import stats

from s4a.analysis.permutation import Model, indicators

N_VERTICES, N_SIMULATED = 40, 4
N_PERMUTATIONS = 99
SCALES = np.array([3, 2, 1.5, 1, 0.7, 0.5])  # standard deviations of the scores
EFFECT_AT_VERTEX, EFFECT_ON_SCORE = 1.2, 2.5  # times the variable of variance 1


class Setting(NamedTuple):
    """What is simulated: `sizes` of groups, or one number of shapes with a variable."""

    sizes: tuple[int, ...]
    covariates: int | str = 0  # random columns, or "sites": a text of five values
    deviations: tuple[float, ...] = ()  # of the errors of each group; of a variable: grows with it
    skewed: bool = False

    def __str__(self) -> str:
        n = sum(self.sizes)
        name = f"{n} shapes, a variable"
        if len(self.sizes) > 1:
            name = f"{n} shapes, groups of {', '.join(map(str, self.sizes))}"
        if self.covariates == "sites":
            name += ", five sites"
        elif self.covariates:
            name += f", {self.covariates} covariates"
        if len(self.deviations) > 1:
            name += f", sd {', '.join(map(str, self.deviations))}"
        elif self.deviations:
            name += ", sd grows with it"
        return name + (", skewed" if self.skewed else "")


SETTINGS = [
    *(Setting((n,), c) for n, c in [(12, 0), (12, 1), (12, 5), (20, 0), (20, 1), (20, 5), (20, 8)]),
    *(Setting((n,), c) for n, c in [(24, 5), (40, 0), (40, 8), (20, "sites")]),
    *(Setting(sizes) for sizes in [(6, 6), (10, 10), (15, 5), (8, 8, 8), (30, 10)]),
    *(Setting(sizes, 5) for sizes in [(10, 10), (15, 5), (30, 10)]),
    *(Setting(sizes, "sites") for sizes in [(10, 10), (15, 5)]),
    Setting((15, 5), skewed=True),
    *(Setting(sizes, 0, (1, 2)) for sizes in [(6, 6), (10, 10), (20, 20), (15, 5), (30, 10)]),
    *(Setting(sizes, 0, (1, 0.5)) for sizes in [(15, 5), (30, 10)]),
    *(Setting(sizes, 5, (1, 2)) for sizes in [(10, 10), (15, 5), (30, 10)]),
    Setting((20,), 0, (1,)),
    Setting((40,), 5, (1,)),
]


def draw(rng: np.random.Generator, setting: Setting) -> tuple[np.ndarray, ...]:
    """Fields ``(n, v, 3)`` and scores ``(n, 6)`` of noise, what is tested, covariates or None."""
    n = sum(setting.sizes)
    group = rng.permutation(np.repeat(np.arange(len(setting.sizes)), setting.sizes))
    x = indicators(group)[1] if len(setting.sizes) > 1 else rng.normal(size=(n, 1))
    covariates = None
    if setting.covariates == "sites":
        covariates = indicators(rng.permutation(np.arange(n) % 5))[1]
    elif setting.covariates:
        covariates = rng.normal(size=(n, int(setting.covariates)))
    noise = rng.exponential(size=(n, N_VERTICES * 3 + 6)) - 1 if setting.skewed else None
    noise = rng.normal(size=(n, N_VERTICES * 3 + 6)) if noise is None else noise
    if len(setting.deviations) > 1:
        noise *= np.array(setting.deviations)[group][:, None]
    elif setting.deviations:
        noise *= 0.2 + abs(x)
    return noise[:, 6:].reshape(n, N_VERTICES, 3), noise[:, :6] * SCALES, x, covariates


def rates(setting: Setting, variances: str, runs: int) -> np.ndarray:
    """Error at vertices and of the whole shape, power at vertices and of the whole shape."""
    found = np.full((runs, 4), np.nan)
    for run in range(runs):
        rng = np.random.default_rng([run, *setting.sizes, *map(ord, str(setting))])
        d, scores, x, covariates = draw(rng, setting)
        options = {
            "covariates": covariates,
            "n_permutations": N_PERMUTATIONS,
            "variances": variances,
            "seed": run,
        }
        model = Model(x, **options)
        found[run, 0] = model.vertex_test(d)[2].min() <= 0.05
        found[run, 1] = model.test(scores)[1] <= 0.05
        if run % 5:
            continue
        effect = (x[:, 0] - x[:, 0].mean()) / x[:, 0].std()
        d[:, :N_SIMULATED, 0] += EFFECT_AT_VERTEX * effect[:, None]
        scores[:, 0] += EFFECT_ON_SCORE * effect
        found[run, 2] = (model.vertex_test(d)[2][:N_SIMULATED] <= 0.05).mean()
        found[run, 3] = model.test(scores)[1] <= 0.05
    return np.nanmean(found, axis=0)


def beside_t_tests(smooth: bool, runs: int) -> np.ndarray:
    """Error and power ``(2, 4)`` of max-T and Bonferroni, of vectors and one component.

    Two groups of 10, 200 vertices on a circle, an effect of one standard deviation along x at 20.
    """
    n, v, n_simulated = 20, 200, 20
    away = abs(np.arange(v)[:, None] - np.arange(v)) / v
    W = np.exp(-0.5 * (np.minimum(away, 1 - away) / 0.05) ** 2) if smooth else np.eye(v)
    W /= np.linalg.norm(W, axis=1, keepdims=True)
    error, power = np.zeros((2, runs, 4))
    for run in range(runs):
        rng = np.random.default_rng([9, run, int(smooth)])
        x = (rng.permutation(n) < n // 2).astype(float)
        d = np.einsum("vw,nwk->nvk", W, rng.normal(size=(n, v, 3)))
        for found in (error, power):
            p = stats.ttest_ind(d[x == 1], d[x == 0]).pvalue  # (v, 3)
            options = {"n_permutations": N_PERMUTATIONS, "seed": run}
            corrected = [
                Model(x, **options).vertex_test(d)[2],
                3 * v * p.min(1),
                Model(x, **options).vertex_test(d[..., :1])[2],
                v * p[:, 0],
            ]
            is_found = np.array(corrected) <= 0.05  # (4, v)
            found[run] = is_found.any(1) if found is error else is_found[:, :n_simulated].mean(1)
            d[:, :n_simulated, 0] += 2 * x[:, None] - 1
    return np.array([error.mean(0), power.mean(0)])


if __name__ == "__main__":
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    word = sys.argv[2] if len(sys.argv) > 2 else ""
    head = ["", "variances", "error, vertices", "error, whole", "power, vertices", "power, whole"]
    sys.stdout.write(f"{runs} runs a row, {N_PERMUTATIONS} permutations\n\n")
    sys.stdout.write(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}\n")
    for setting in SETTINGS:
        if word not in str(setting):
            continue
        is_unequal = setting.deviations or setting.skewed
        for variances in ("equal", "unequal") if is_unequal else ("equal",):
            cells = [f"{rate:.3f}" for rate in rates(setting, variances, runs)]
            sys.stdout.write(f"| {setting} | {variances} | {' | '.join(cells)} |\n")
            sys.stdout.flush()
    head = ["", "vectors, max-T", "vectors, t tests", "component, max-T", "component, t tests"]
    for smooth in () if word else (False, True):
        sys.stdout.write(f"\n| {' | '.join(head)} |\n|{' --- |' * len(head)}\n")
        for name, row in zip(("error", "power"), beside_t_tests(smooth, 200), strict=True):
            cells = " | ".join(f"{rate:.3f}" for rate in row)
            sys.stdout.write(f"| {name}, {'smooth' if smooth else 'independent'} | {cells} |\n")
