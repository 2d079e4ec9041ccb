"""Growth (6.1): error and power of the tests of change within subjects, simulated; slopes.

``python benchmarks/growth.py [RUNS]``: 40 vertices of smooth fields, subjects with random
intercepts as large as the residuals, seen two to four times.  Error is how often a change is found
at 0.05 where there is none: at any vertex after the correction for all, and of the whole shape; by
visits permuted within subjects, and by changed signs of whole subjects.  Power is the share of four
simulated vertices that are found, and how often the whole shape is, in every fifth run.

``growth.py statsmodels`` needs that package: the largest difference of slopes, ratios of variances
and residual variances from its MixedLM, and the time of both.
"""

import sys
import time

import numpy as np

from s4a.analysis.permutation import Model
from s4a_morphometrics.longitudinal import random_intercepts, within_subjects

N_VERTICES, N_SIMULATED, N_PERMUTATIONS = 40, 4, 99
EFFECT = 0.6  # slope per standard deviation of time within subjects, in those of the residuals
HEAD = [
    "", "visits: error, vertices", "error, whole", "power, vertices", "power, whole",
    "signs: error, vertices", "error, whole", "power, vertices", "power, whole",
]  # fmt: skip
SETTINGS = [
    (n, visits, kind)
    for n, visits in [(6, "3"), (10, "2"), (10, "3"), (20, "2"), (20, "1 to 4"), (40, "3")]
    for kind in ["normal"]
] + [(20, "3", "skewed"), (20, "3", "own slopes"), (20, "3", "visits alike")]


def draw(run: int, setting: tuple[int, str, str], effect: float) -> tuple[np.ndarray, ...]:
    """Fields (n, v, 1), times and subjects."""
    n, visits, kind = setting
    rng = np.random.default_rng([run, n, len(visits), len(kind), int(effect > 0)])
    each = rng.integers(1, 5, n) if "to" in visits else np.full(n, int(visits))
    subject = np.repeat(np.arange(n), each)
    t = np.concatenate([np.sort(rng.uniform(0, 3, m)) for m in each]) + rng.normal(size=n)[subject]
    away = abs(np.arange(N_VERTICES)[:, None] - np.arange(N_VERTICES))
    W = np.exp(-0.5 * (away / 2) ** 2)
    W /= np.linalg.norm(W, axis=0)

    def smooth(rows):
        noise = rng.exponential(size=(rows, N_VERTICES)) - 1
        return (noise if kind == "skewed" else rng.normal(size=(rows, N_VERTICES))) @ W

    x = within_subjects(t, subject)
    x /= x[x != 0].std()
    d = smooth(n)[subject] + smooth(len(t))
    if kind == "own slopes":
        d += 0.7 * smooth(n)[subject] * x[:, None]
    if kind == "visits alike":  # errors that last: each half of the one before
        e = smooth(len(t))
        for i in range(1, len(t)):
            if subject[i] == subject[i - 1]:
                e[i] = 0.5 * e[i - 1] + np.sqrt(0.75) * e[i]
        d = smooth(n)[subject] + e
    d[:, :N_SIMULATED] += effect * x[:, None]
    return d[..., None], t, subject


def found(run: int, setting: tuple[int, str, str], effect: float, variances: str) -> list[float]:
    """Whether, or where, change is found."""
    d, t, subject = draw(run, setting, effect)
    code, sizes = np.unique(subject, return_inverse=True, return_counts=True)[1:]
    seen = sizes[code] > 1
    subject = subject[seen]
    E, x = within_subjects(d[seen], subject), within_subjects(t[seen], subject)
    options = {"blocks": subject, "n_permutations": N_PERMUTATIONS, "seed": run}
    options["variances"] = variances
    model = Model(x, **options)
    p = model.vertex_test(E)[2]
    U, S, _ = np.linalg.svd(E[..., 0], full_matrices=False)
    whole = model.test(U[:, :4] * S[:4])[1] <= 0.05
    return [(p[:N_SIMULATED] <= 0.05).mean() if effect else p.min() <= 0.05, whole]


def rates(setting: tuple[int, str, str], runs: int) -> list[float]:
    """The eight numbers of a row."""
    said = np.full((runs, 8), np.nan)
    for run in range(runs):
        for at, variances in ((0, "equal"), (4, "unequal")):
            said[run, at : at + 2] = found(run, setting, 0.0, variances)
            if run % 5 == 0:
                said[run, at + 2 : at + 4] = found(run, setting, EFFECT, variances)
    return np.nanmean(said, axis=0).tolist()


def beside_statsmodels() -> None:
    """Slopes, ratios and variances of 20 responses, and seconds of processor time."""
    import warnings

    from statsmodels.regression.mixed_linear_model import MixedLM

    warnings.simplefilter("ignore")  # of its search where a variance is zero
    head = ["", "slope", "ratio", "variance", "s, here", "s, statsmodels"]
    sys.stdout.write(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}\n")
    for name, visits in (("balanced", "3"), ("unbalanced", "1 to 4")):
        d, t, subject = draw(0, (20, visits, "normal"), EFFECT)
        if visits == "3":
            t = np.tile([0.0, 1.0, 2.5], 20)
        X, Y = np.column_stack([np.ones(len(t)), t]), d[:, :20, 0]
        begin = time.process_time()
        fit = random_intercepts(Y, X, subject)
        here = time.process_time() - begin
        begin = time.process_time()
        theirs = [MixedLM(y, X, groups=subject).fit(reml=True, gtol=1e-9) for y in Y.T]
        there = time.process_time() - begin
        rows = [(one.fe_params[1], one.cov_re[0, 0] / one.scale, one.scale) for one in theirs]
        own = np.column_stack([fit.slope[1], fit.ratio, fit.variance])
        gap = abs(own - np.array(rows)).max(0)
        cells = [*(f"{one:.1e}" for one in gap), f"{here:.3f}", f"{there:.2f}"]
        sys.stdout.write(f"| {name} | {' | '.join(cells)} |\n")


if __name__ == "__main__":
    if sys.argv[1:] == ["statsmodels"]:
        beside_statsmodels()
    else:
        runs = int(sys.argv[1]) if len(sys.argv) > 1 else 500
        sys.stdout.write(f"{runs} runs a row, {N_PERMUTATIONS} permutations\n\n")
        sys.stdout.write(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}\n")
        for n, visits, kind in SETTINGS:
            cells = [f"{rate:.3f}" for rate in rates((n, visits, kind), runs)]
            row = f"{n} subjects, {visits} visits, {kind}"
            sys.stdout.write(f"| {row} | {' | '.join(cells)} |\n")
            sys.stdout.flush()
