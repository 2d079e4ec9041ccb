"""Left against right (6.1): error and power of the tests of asymmetry; real shapes.

``python benchmarks/asymmetry.py [RUNS]``: asymmetries of 40 vertices with nothing to find or
a simulated effect.  Error is how often something is found at 0.05 where nothing is: directional
asymmetry at the vertices after the correction for all, and of the whole shape; antisymmetry.  Power
is the share of four simulated vertices that are found, how often the whole shape is, and how often
antisymmetry is, in every fifth run.

``asymmetry.py whole [RUNS]``: the same of :func:`s4a_morphometrics.asymmetry` as it is called:
shapes of an ellipsoid of 500 vertices, smooth in what is alike on both sides and in what is not,
with a bump of one side simulated; each against its mirror image, along the normals or as vectors,
or left and right shapes of subjects.

``asymmetry.py brains [RUNS]``: the errors of a folded brain, the same on both sides, whose partners
are found by registration; the variation of its shapes as large as that of the ellipsoids, or less.

``asymmetry.py antisymmetry [RUNS]``: how often antisymmetry is found in such shapes of subjects
where there is none, in draws of its own.

``asymmetry.py real`` needs the shared data beside the checkout: shares of variance of mouse skulls,
and femurs beside their mirror images.
"""

import sys
from pathlib import Path

import numpy as np
import xarray as xr

import s4a
import s4a_morphometrics
from s4a.analysis.permutation import Model
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas, vertex_normals
from s4a.schema import dataset
from s4a_morphometrics.bilateral import antisymmetry_test, matching_sides, sides_test
from s4a_morphometrics.bilateral_pairs import involution

DATA = Path(__file__).parents[2] / "shared" / "data"
N_VERTICES, N_SIMULATED = 40, 4
N_PERMUTATIONS = 99
EFFECT = 1.2  # directional asymmetry at a vertex, in standard deviations of what fluctuates
HUMPS = 2.0  # of an antisymmetry, in standard deviations around each
N_OF_SURFACE = 500  # vertices of the ellipsoid
BUMP = 0.12  # height of the bump on one side of it, whose axes are 2, 3 and 1.5
WAYS = {
    "normal": "mirror image, along the normals",
    "vector": "mirror image, vectors",
    "sides": "left and right shapes",
}
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


def found(a: np.ndarray, run: int, *, simulated: bool) -> list[float]:
    """Whether, or where, directional asymmetry and antisymmetry are found."""
    model = Model.one_sample(len(a), N_PERMUTATIONS, run)
    p_max = model.vertex_test(a)[2]
    rows = a[..., 0]
    at = (p_max[:N_SIMULATED] <= 0.05).mean() if simulated else p_max.min() <= 0.05
    whole = sides_test(rows @ rows.T, model)[1] <= 0.05
    return [at, whole]


def antisymmetric(rows: np.ndarray, run: int) -> bool:
    """Whether antisymmetry is found."""
    return antisymmetry_test(rows, seed=run)[1] <= 0.05


def rates(n: int, kind: str, runs: int) -> np.ndarray:
    """The six numbers of a row."""
    said = np.full((runs, 6), np.nan)
    for run in range(runs):
        rng = np.random.default_rng([run, n, *map(ord, kind)])
        a = draw(rng, n, kind)
        said[run, :2] = found(a, run, simulated=False)
        said[run, 2] = antisymmetric(a[..., 0], run)
        if run % 5:
            continue
        shifted = a.copy()
        shifted[:, :N_SIMULATED] += EFFECT
        said[run, 3:5] = found(shifted, run, simulated=True)
        a[:, : 2 * N_SIMULATED, 0] += HUMPS * rng.choice([-1, 1], n)[:, None]
        said[run, 5] = antisymmetric(a[..., 0], run)
    return np.nanmean(said, axis=0)


def ellipsoid() -> tuple[np.ndarray, np.ndarray, xr.Dataset]:
    """Vertices, triangles, and their partners as the equation of the surface gives them."""
    X, T = as_arrays(s4a.synthetic.ellipsoid(N_OF_SURFACE, (2.0, 3.0, 1.5)))
    (triangle, weights), _, gap = involution(X * [-1, 1, 1], X, T)
    return (
        X,
        T,
        dataset(partner_triangle=triangle, partner_barycentric=weights, partner_distance=gap),
    )


def brain(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, xr.Dataset]:
    """The same of a brain with the same folds on both sides, as large as the ellipsoid.

    Its partners are found by registration.
    """
    made = s4a.synthetic.brains(1, n, seed=seed)
    points = made["truth/brain_01/reference_point"].values
    T = made["original/brain_01/corner_vertex"].values
    other = np.where(points[:, :1] < 0, [-1, 1, 1], 1)
    X = s4a.datasets.synthetic.reference_brain(points * other) * other
    X *= np.sqrt(vertex_areas(*ellipsoid()[:2]).sum() / vertex_areas(X, T).sum())
    still = as_dataset(X, T, {"template": "a"}).merge(dataset(displacement=np.zeros((2, *X.shape))))
    study = xr.DataTree.from_dict({"registration": still.assign_coords(shape=["a", "b"])})
    return X, T, s4a_morphometrics.symmetry(study)


def draw_shapes(rng: np.random.Generator, X: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Displacements ``(n, v, 3)`` that are symmetric in x, and that change their sign there.

    Each is a sum of 12 waves, the latter a sixth as high.
    """

    def waves() -> np.ndarray:
        k, phase = rng.normal(0, 0.6, (12, 3)), rng.uniform(0, 2 * np.pi, 12)
        amplitude = rng.normal(size=(n, 12, 3)) / 4
        there = [np.cos(P @ k.T + phase) for P in (X, X * [-1, 1, 1])]
        return np.stack([np.einsum("swx,nw->snx", amplitude, cosine) for cosine in there])

    here, other = waves()
    alike = here + other * [-1, 1, 1]
    here, other = waves()
    return 0.3 * alike, 0.05 * (here - other * [-1, 1, 1])


def whole_rates(
    surface: tuple, n: int, way: str, runs: int, size: float = 1.0, *, power: bool = True
) -> np.ndarray:
    """Error at vertices, of the whole shape and of antisymmetry; power of the first two.

    Shapes vary by `size` times as much; for `power` the bump is simulated in every fifth run.
    """
    X, T, partners = surface
    height = np.exp(-((X - [1.7, 1.0, 0.6]) ** 2).sum(1) / 0.5)
    push, high = BUMP * height[:, None] * vertex_normals(X, T), height > 0.5
    names = [f"shape_{i:02d}" for i in range(n)]
    options = {"partners": partners, "of": way, "n_permutations": N_PERMUTATIONS}
    if way == "sides":
        options = {"subject": names * 2, "side": ["left"] * n + ["right"] * n}
        options["n_permutations"] = N_PERMUTATIONS
        names = [f"{name}_{side}" for side in "ab" for name in names]
    said = np.full((runs, 5), np.nan)
    for run in range(runs):
        drawn = draw_shapes(np.random.default_rng([run, n, 7]), X, n)
        alike, odd = (size * part for part in drawn)
        for simulated in (False, True)[: 1 + (power and run % 5 == 0)]:
            d = alike + odd + simulated * push
            if way == "sides":
                half = odd + simulated * push / 2
                d = np.concatenate([alike - half, alike + half])
            mesh = as_dataset(X, T, {"template": names[0]}).merge(dataset(displacement=d))
            study = xr.DataTree.from_dict({"registration": mesh.assign_coords(shape=names)})
            if way == "sides":  # as a run that mirrored the left ones says it
                report = dataset(reflected=np.repeat([1, 0], n))
                study["report"] = xr.DataTree(report.assign_coords(shape=names))
            found = s4a_morphometrics.asymmetry(study, seed=run, **options)
            p, p_value = found["p_family_wise"].values, found["p_value"].item()
            if simulated:
                said[run, 3:] = (p[high] <= 0.05).mean(), p_value <= 0.05
            else:
                of_humps = found["antisymmetry_p"].item()
                said[run, :3] = p.min() <= 0.05, p_value <= 0.05, of_humps <= 0.05
    return np.nanmean(said if power else said[:, :3], axis=0)


def humps(n: int, runs: int) -> float:
    """How often antisymmetry is found in left and right shapes that have none."""
    X, T = as_arrays(s4a.synthetic.ellipsoid(N_OF_SURFACE, (2.0, 3.0, 1.5)))
    area = vertex_areas(X, T)
    said = np.empty(runs)
    for run in range(runs):
        alike, odd = draw_shapes(np.random.default_rng([run, n, 8]), X, n)
        a = matching_sides(X + alike - odd, X + alike + odd, T, area).a
        said[run] = antisymmetric((a * np.sqrt(area)[:, None]).reshape(n, -1), run)
    return said.mean()


def write(text: str) -> None:
    """A line, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def shares(name: str, result) -> None:
    """A row of the shares of variance."""
    share = ", ".join(f"{one:.3f}" for one in result["variance_share"].values)
    gap = (
        f"{100 * result.attrs['involution_error']:.2f} %"
        if "involution_error" in result.attrs
        else "-"
    )
    p, least = result["p_value"].item(), result.attrs["smallest_p"]
    write(f"| {name} | {result.sizes['individual']} | {share} | {p:.3f} ({least:.3f}) | {gap} |")


def real() -> None:
    """Mouse skulls against their mirror images; femurs and the mirror images of their files."""
    write("| | n | shares: individuals, sides, individuals x sides | p (least) | gap of tau |")
    write("| --- | --- | --- | --- | --- |")
    options = {"n_coarse": 2000, "k": 50, "intersections": False, "n_jobs": 1}
    skulls = s4a.analyse(DATA / "mouse_skulls", **options)
    shares("mouse skulls, object", s4a_morphometrics.asymmetry(skulls))
    meshes = {}
    for file in sorted((DATA / "lower_limb_bones").glob("*femur*.npz")):
        with np.load(file) as arrays:
            X, T = arrays["V"], arrays["F"]
        meshes[f"{file.stem}_a"] = X, T
        meshes[f"{file.stem}_b"] = X * [-1, 1, 1], T[:, ::-1]
    femurs = s4a.analyse(meshes, reflect="auto", include_flagged=True, **options)
    report = femurs["report"].to_dataset()
    names = report["shape"].values.tolist()
    write(f"mirrored of {len(names)} femurs and mirror images: {int(report['reflected'].sum())}")
    found = s4a_morphometrics.asymmetry(
        femurs, subject=[name[:-2] for name in names], side=[name[-1] for name in names]
    )
    shares("femurs and their mirror images, matching", found)


if __name__ == "__main__":
    if sys.argv[1:] == ["real"]:
        real()
    elif sys.argv[1:2] == ["antisymmetry"]:
        runs = int(sys.argv[2]) if len(sys.argv) > 2 else 4000
        for n in (12, 20):
            write(f"{n} individuals, {runs} runs: antisymmetry found in {humps(n, runs):.3f}")
    elif sys.argv[1:2] == ["brains"]:
        runs = int(sys.argv[2]) if len(sys.argv) > 2 else 100
        write(f"{runs} runs a row, {N_PERMUTATIONS} permutations, 20 individuals\n")
        write(f"| {' | '.join(HEAD[:4])} |\n|{' --- |' * 4}")
        for n, seed in ((2500, 0), (1500, 1), (5000, 2)):
            surface = brain(n, seed)
            for way, size in (("normal", 1.0), ("normal", 0.3), ("vector", 1.0)):
                rates_of = whole_rates(surface, 20, way, runs, size, power=False)
                cells = [f"{rate:.3f}" for rate in rates_of]
                said = f"brain of {n} vertices, {WAYS[way]}, variation times {size}"
                write(f"| {said} | {' | '.join(cells)} |")
    elif sys.argv[1:2] == ["whole"]:
        runs = int(sys.argv[2]) if len(sys.argv) > 2 else 500
        write(f"{runs} runs a row, {N_PERMUTATIONS} permutations\n")
        write(f"| {' | '.join(HEAD[:-1])} |\n|{' --- |' * (len(HEAD) - 1)}")
        surface = ellipsoid()
        for way, n in (
            ("normal", 12),
            ("normal", 20),
            ("sides", 12),
            ("sides", 20),
            ("vector", 12),
            ("vector", 20),
        ):
            cells = [f"{rate:.3f}" for rate in whole_rates(surface, n, way, runs)]
            write(f"| {n} individuals, {WAYS[way]} | {' | '.join(cells)} |")
    else:
        runs = int(sys.argv[1]) if len(sys.argv) > 1 else 500
        write(f"{runs} runs a row, {N_PERMUTATIONS} permutations\n")
        write(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}")
        for kind in ("normal", "heavy tails", "skewed"):
            for n in SIZES if kind == "normal" else (20,):
                cells = [f"{rate:.3f}" for rate in rates(n, kind, runs)]
                write(f"| {n} individuals, {kind} | {' | '.join(cells)} |")
