"""Several structures (6.1): simulated poses and shapes found again, error and power of their tests.

``python benchmarks/structures.py [RUNS]``: two beans of 120 vertices, 60 mm of scan, whose
points correspond.  First the shares of variance between (poses) and within (shapes) where poses,
shapes, both or neither vary, all with noise of 0.05 mm at every vertex, over a tenth of the runs.
Then, where nothing differs, how often a group differs at 0.05 in its poses, in its shapes, and how
often poses and shapes vary together; and the power for a group whose left structure lies 1.5 mm
farther out, whose shapes are 10 % longer, and for lengths that follow the poses with r = 0.7.

``structures.py registered`` runs the analysis over eight subjects of 600 vertices: shares beside
those of the true correspondences.
"""

import logging
import sys

import numpy as np
from scipy.spatial.transform import Rotation

import s4a
import s4a_morphometrics
from s4a.analysis.permutation import Model
from s4a.geometry.align import rigid_transform
from s4a.geometry.mesh import vertex_areas
from s4a_morphometrics.poses import Poses, align_wholes, measure_levels, pose_fields, poses_of
from s4a_morphometrics.synthetic import bean, subjects
from s4a_morphometrics.two_block import coordinates, two_block

SPHERE = s4a.synthetic.sphere(120)
U, T = SPHERE["position"].values, SPHERE["corner_vertex"].values
BEAN = bean(U)
AREA = vertex_areas(BEAN, T)
APART = np.array([[-16.0, 0, 0], [16, 0, 0]])
N_PERMUTATIONS = 99
SIMULATED = {"poses": (1, 0), "shapes": (0, 1), "both": (1, 1), "neither": (0, 0)}
HEAD = ["", "error, poses", "error, shapes", "error, together"]
HEAD += ["power, poses", "power, shapes", "power, together"]


def draw(rng, n, pose, shape, *, out=0.0, longer=0.0, together=0.0):
    """Points (n, 2, v, 3), the second half a group, and nothing else in them."""
    Y = np.empty((n, 2, len(U), 3))
    for i in range(n):
        in_group = i >= n / 2
        for k in range(2):
            shift, turn = 1.5 * rng.normal(size=3), 0.1 * rng.normal(size=3)
            length, bend = rng.normal(size=2)
            length = together * shift[0] / 1.5 + np.sqrt(1 - together**2) * length
            X = bean(U, shape * 0.1 * length + longer * in_group, shape * bend)
            R, t, _ = rigid_transform(X, BEAN, AREA)
            X = (X @ R.T + t) @ Rotation.from_rotvec(pose * turn).as_matrix().T
            shift = pose * shift - [out * in_group * (k == 0), 0, 0]
            Y[i, k] = X + APART[k] + shift + 0.05 * rng.normal(size=X.shape)
    return Y


def parts_of(Y, areas):
    """The poses and shapes of both structures."""
    whole = align_wholes(np.concatenate([Y[:, 0], Y[:, 1]], axis=1), np.concatenate(areas))
    v = len(areas[0])
    return [poses_of(whole[:, :v], areas[0]), poses_of(whole[:, v:], areas[1])]


def levels(each: list[Poses]) -> list[np.ndarray]:
    """Coordinates of the subjects in the space of poses, and of shapes."""
    area = np.tile(AREA, 2)
    d = [pose_fields(one.mean, AREA, one.rotation, one.translation) for one in each]
    blocks = np.concatenate(d, 1), np.concatenate([one.shape for one in each], 1)
    return [coordinates(block, area / area.sum()) for block in blocks]


def shares(runs: int) -> None:
    """The table of simulated variation."""
    head = ["simulated", "variance, mm²", "between, %", "within, %", "runs differ by, %"]
    sys.stdout.write(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}\n")
    for name, (pose, shape) in SIMULATED.items():
        found = []
        for run in range(runs):
            Y = draw(np.random.default_rng([run, pose, shape]), 12, pose, shape)
            one = measure_levels(parts_of(Y, [AREA, AREA]), [AREA, AREA], n_permutations=1)
            found.append(one["level_variance"].sum("structure").values)
        between, within = np.mean(found, axis=0)
        share = [100 * one[0] / one.sum() for one in found]
        total = between + within
        cells = [f"{total:.3g}", f"{100 * between / total:.1f}", f"{100 * within / total:.1f}"]
        sys.stdout.write(f"| {name} | {' | '.join(cells)} | {np.std(share):.1f} |\n")
    sys.stdout.flush()


def found_in(rng, n, run, **effect):
    """Whether poses and shapes of groups differ, and whether they vary together."""
    A, B = levels(parts_of(draw(rng, n, 1, 1, **effect), [AREA, AREA]))
    group = np.arange(n) >= n / 2
    options = {"n_permutations": N_PERMUTATIONS, "seed": run}
    model = Model(group.astype(float), **options)
    p = [model.test(M[:, :4])[1] for M in (A, B)]
    return [*(one <= 0.05 for one in p), two_block(A, B, **options)["rv_p"] <= 0.05]


def rates(n: int, runs: int) -> list[float]:
    """The six numbers of a row."""
    null = [found_in(np.random.default_rng([run, n]), n, run) for run in range(runs)]
    power = []
    for at, effect in enumerate(({"out": 1.5}, {"longer": 0.1}, {"together": 0.7})):
        draws = (np.random.default_rng([run, n, at + 1]) for run in range(runs // 10))
        found = [found_in(rng, n, run, **effect)[at] for run, rng in enumerate(draws)]
        power.append(np.mean(found))
    return [*np.mean(null, axis=0), *power]


def registered() -> None:
    """Shares of a study beside those of the truth."""
    from scipy.interpolate import RBFInterpolator

    logging.disable(logging.WARNING)  # so few and small shapes look flagged now and then
    head = ["simulated", "between, %", "of the truth, %", "variance, mm²", "of the truth, mm²"]
    sys.stdout.write(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}\n")
    for name, (pose, shape) in SIMULATED.items():
        made = subjects(8, 600, pose=pose, shape=shape)
        study = s4a_morphometrics.analyse_structures(made, n_coarse=400, k=24, k_init=10, n_jobs=1)
        found = s4a_morphometrics.structures(study, n_permutations=1)
        points, areas = [], []
        for k in ("left", "right"):
            template = made[study[f"structures/{k}/registration"].attrs["template"]][k]
            u = template["reference_point"].values
            areas.append(
                vertex_areas(template["position"].values, template["corner_vertex"].values)
            )
            meshes = [made[one][k] for one in found["shape"].values.tolist()]
            of = [
                RBFInterpolator(mesh["reference_point"].values, mesh["position"].values)(u)
                for mesh in meshes
            ]
            points.append(of)
        cells = []
        truth = measure_levels(parts_of(np.swapaxes(points, 0, 1), areas), areas, n_permutations=1)
        for measure in ("share", "variance"):
            for one in (found, truth):
                level = one[f"level_{measure}"].sum("structure").values
                number = 100 * level[0] if measure == "share" else level.sum()
                cells.append(f"{number:.1f}" if measure == "share" else f"{number:.3g}")
        sys.stdout.write(f"| {name} | {' | '.join(cells)} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    if sys.argv[1:] == ["registered"]:
        registered()
    else:
        runs = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
        sys.stdout.write(f"{runs} runs a row, {N_PERMUTATIONS} permutations\n\n")
        shares(max(runs // 10, 2))
        sys.stdout.write(f"\n| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}\n")
        for n in (10, 20, 40):
            cells = [f"{rate:.3f}" for rate in rates(n, runs)]
            sys.stdout.write(f"| {n} subjects | {' | '.join(cells)} |\n")
            sys.stdout.flush()
