"""Left against right (6.1): error and power of the tests of asymmetry; real shapes.

``python tests/benchmarks/asymmetry.py [RUNS]``: asymmetries of 40 vertices with nothing to find or
a planted effect.  Error is how often something is found at 0.05 where nothing is: directional
asymmetry at the vertices after the correction for all, and of the whole shape; antisymmetry.  Power
is the share of four planted vertices that are found, how often the whole shape is, and how often
antisymmetry is, in every fifth run.

``asymmetry.py real`` needs the shared data beside the checkout: shares of variance of mouse skulls,
and femurs beside their mirror images.
"""

import sys
from pathlib import Path

import numpy as np

import s4a
from s4a.analysis.asymmetry import antisymmetry_test, sides_test
from s4a.analysis.permutation import mean_test

DATA = Path(__file__).parents[3] / "shared" / "data"
N_VERTICES, N_PLANTED = 40, 4
N_PERMUTATIONS = 99
EFFECT = 1.2  # directional asymmetry at a vertex, in standard deviations of what fluctuates
HUMPS = 2.0  # of an antisymmetry, in standard deviations around each
SIZES = (6, 8, 12, 20, 40)
HEAD = [
    "", "error, vertices", "error, whole", "error, antisymmetry",
    "power, vertices", "power, whole", "power, antisymmetry",
]  # fmt: skip


def draw(rng: np.random.Generator, n: int, kind: str) -> np.ndarray:
    """Fluctuating asymmetries ``(n, v, 1)`` along the normals, smooth along a row of vertices."""
    noise = {
        "normal": lambda: rng.normal(size=(n, N_VERTICES)),
        "heavy tails": lambda: rng.standard_t(4, size=(n, N_VERTICES)) / np.sqrt(2),
        "skewed": lambda: rng.exponential(size=(n, N_VERTICES)) - 1,
    }[kind]()
    away = abs(np.arange(N_VERTICES)[:, None] - np.arange(N_VERTICES))
    W = np.exp(-0.5 * (away / 2) ** 2)
    return (noise @ (W / np.linalg.norm(W, axis=0)))[..., None]


def found(a: np.ndarray, run: int, *, planted: bool) -> list[float]:
    """Whether, or where, directional asymmetry and antisymmetry are found."""
    options = {"n_permutations": N_PERMUTATIONS, "seed": run}
    p_max = mean_test(a, **options)[2]
    rows = a[..., 0]
    at = (p_max[:N_PLANTED] <= 0.05).mean() if planted else p_max.min() <= 0.05
    whole = sides_test(rows @ rows.T, **options)[1] <= 0.05
    return [at, whole]


def antisymmetric(rows: np.ndarray, run: int) -> bool:
    """Whether antisymmetry is found."""
    return antisymmetry_test(rows, n_draws=N_PERMUTATIONS, seed=run)[1] <= 0.05


def rates(n: int, kind: str, runs: int) -> np.ndarray:
    """The six numbers of a row."""
    said = np.full((runs, 6), np.nan)
    for run in range(runs):
        rng = np.random.default_rng([run, n, *map(ord, kind)])
        a = draw(rng, n, kind)
        said[run, :2] = found(a, run, planted=False)
        said[run, 2] = antisymmetric(a[..., 0], run)
        if run % 5:
            continue
        shifted = a.copy()
        shifted[:, :N_PLANTED] += EFFECT
        said[run, 3:5] = found(shifted, run, planted=True)
        a[:, : 2 * N_PLANTED, 0] += HUMPS * rng.choice([-1, 1], n)[:, None]
        said[run, 5] = antisymmetric(a[..., 0], run)
    return np.nanmean(said, axis=0)


def write(text: str) -> None:
    """A line, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def shares(name: str, result) -> None:
    """A row of the shares of variance."""
    share = ", ".join(f"{one:.3f}" for one in result["variance_share"].values)
    gap = f"{100 * result.attrs['gap']:.2f} %" if "gap" in result.attrs else "-"
    p, least = result["p_value"].item(), result.attrs["smallest_p"]
    write(f"| {name} | {result.sizes['individual']} | {share} | {p:.3f} ({least:.3f}) | {gap} |")


def real() -> None:
    """Mouse skulls against their mirror images; femurs and the mirror images of their files."""
    write("| | n | shares: individuals, sides, individuals x sides | p (least) | gap of tau |")
    write("| --- | --- | --- | --- | --- |")
    options = {"n_coarse": 2000, "k": 50, "intersections": False, "n_jobs": 1}
    skulls = s4a.analyse(DATA / "mouse_skulls", **options)
    shares("mouse skulls, object", s4a.statistics.asymmetry(skulls))
    meshes = {}
    for file in sorted((DATA / "lower_limb_bones").glob("*femur*.npz")):
        with np.load(file) as arrays:
            X, T = arrays["V"], arrays["F"]
        meshes[f"{file.stem}_a"] = X, T
        meshes[f"{file.stem}_b"] = X * [-1, 1, 1], T[:, ::-1]
    femurs = s4a.analyse(meshes, reflect="auto", keep_doubtful=True, **options)
    report = femurs["report"].to_dataset()
    names = report["shape"].values.tolist()
    write(f"mirrored of {len(names)} femurs and mirror images: {int(report['reflected'].sum())}")
    found = s4a.statistics.asymmetry(
        femurs, subject=[name[:-2] for name in names], side=[name[-1] for name in names]
    )
    shares("femurs and their mirror images, matching", found)


if __name__ == "__main__":
    if sys.argv[1:] == ["real"]:
        real()
    else:
        runs = int(sys.argv[1]) if len(sys.argv) > 1 else 500
        write(f"{runs} runs a row, {N_PERMUTATIONS} permutations\n")
        write(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}")
        for kind in ("normal", "heavy tails", "skewed"):
            for n in SIZES if kind == "normal" else (20,):
                cells = [f"{rate:.3f}" for rate in rates(n, kind, runs)]
                write(f"| {n} individuals, {kind} | {' | '.join(cells)} |")
