"""Whether confidence is what it says: the share of such vertices within 1 % of sqrt(area).

``confidence.py`` registers pairs with a known truth, fits the weights of
:mod:`s4a.method.register` on those of :data:`TUNED`, and says for those of :data:`REPORTED`,
by the weights of the library: how sure it is of a pair and how much is right; Spearman's
correlation of confidence and error, and the share of the worst tenth that is among the least sure
tenth (0.1 by chance); and in bins of confidence, the share that is right.  Bodies, and cats, share
their connectivity; nothing here looks at that.

``confidence.py failures`` registers random pairs of bodies without the search for initial maps, of
which many end with limbs exchanged, and says how well these are reported by their mean confidence,
by the way bidirectional, and by registration_error and distortion, which a study looks at, too.
"""

import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
import plausibility
from peers import DATA, image_of, remeshed
from scipy.stats import spearmanr
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

import s4a
from s4a import synthetic
from s4a.method import initial_map
from s4a.method.register import RADIUS, WEIGHTS, confidence_features
from s4a.options import Options
from s4a.study.pair import match_shapes, shape_of
from s4a.study.quality_control import UNSURE, WRONG

TUNED = {
    "faces": [(0, 1)],
    "brains": [(1, 2)],
    "cats": [(0, 3)],
    "faust": [8, 12],  # seed and number of random pairs
}
REPORTED = {
    "faces": [(2, 3), (4, 5), (6, 7)],
    "brains": [(2, 3), (4, 1)],
    "cats": [(4, 1), (7, 9)],
    "faust": [9, 10],
}
EACH = 2000  # vertices of a pair in the fit
FAILING = range(8, 14)  # seeds of pairs
SIGNS = {  # of a registration; what is high is a sign of failure
    "mean confidence": lambda found: -found["confidence"].values.mean(),
    "bidirectional": lambda found: found["round_trip"].values.mean(),
    "distortion": lambda found: abs(found["distortion"].values).mean(),
    "registration_error": lambda found: found.attrs["score"],
}


class Pair(NamedTuple):
    """Two shapes, the template first, and where its vertices are on the other."""

    name: str
    template: object
    shape: object
    true: np.ndarray


def pairs_of(folder, chosen):
    yield from remeshed_faces(folder, chosen["faces"])
    yield from brains(chosen["brains"])
    yield from same_vertices(folder, "cats", chosen["cats"])
    seed, n = chosen["faust"]
    rng = np.random.default_rng(seed)
    drawn = [rng.choice(20, 2, replace=False).tolist() for _ in range(n)]
    yield from same_vertices(folder, "faust", [(target, source) for source, target in drawn])


def remeshed_faces(folder, pairs):
    for a, b in pairs:
        one, other = (s4a.read_shape(folder / "faces" / f"identity{i:03d}.ply") for i in (a, b))
        yield Pair(f"faces {a} {b}", one, remeshed(other), other["position"].values)


def brains(pairs):
    tree = synthetic.brains(4, 20_000, 5)
    for a, b in pairs:
        names = [f"brain_{i:02d}" for i in (a, b)]
        one, other = (tree["original"][name].to_dataset() for name in names)
        at = tree["truth"][names[0]]["reference_point"].values
        true = synthetic.position(tree["truth"], names[1], at)
        yield Pair(f"brains {a} {b}", one, other, true)


def same_vertices(folder, part, pairs):
    files = sorted((folder / part).glob("*.ply"))
    for a, b in pairs:
        one, other = (s4a.read_shape(files[i]) for i in (a, b))
        yield Pair(f"{part} {a} {b}", one, other, other["position"].values)


def measured(pair):
    """Error of every vertex, share of sqrt(area); confidence_features; the registration."""
    options = Options(n_coarse=4000)
    source, target = (shape_of(mesh, options) for mesh in (pair.shape, pair.template))
    found, _ = match_shapes(source, target, options)
    image = image_of(found, pair.template)
    error = np.linalg.norm(image - pair.true, axis=1) / source.frame[1]
    match = found["registered_match"].values
    return error, confidence_features(source, target, match, source.to_frame(image)), found


def fit(results):
    """The weights, of vertices that are drawn from every pair."""
    rng = np.random.default_rng(0)
    seen, right = [], []
    for error, evidence_of_pair, _ in results:
        some = rng.choice(len(error), EACH)
        seen.append(evidence_of_pair[some])
        right.append(error[some] < RADIUS)
    model = LogisticRegression(C=1e3, max_iter=1000)
    model.fit(np.concatenate(seen), np.concatenate(right))
    return model.intercept_[0], *model.coef_[0]


def caught(error, sure):
    """The share of the worst tenth that is among the least sure tenth."""
    n = len(error) // 10
    return len(np.intersect1d(np.argsort(-error)[:n], np.argsort(sure)[:n])) / n


def report(names, results):
    say = sys.stdout.write
    say(f"{'pair':16} {'error %':>8} {'right':>6} {'sure':>6} {'Spearman':>9} {'caught':>7}\n")
    for name, (error, _, found) in zip(names, results, strict=True):
        sure = found["confidence"].values
        right, rank = (error < RADIUS).mean(), spearmanr(-sure, error)[0]
        cells = f"{100 * error.mean():8.3f} {right:6.2f} {sure.mean():6.2f} {rank:9.2f}"
        say(f"{name:16} {cells} {caught(error, sure):7.2f}\n")
    error = np.concatenate([error for error, *_ in results])
    sure = np.concatenate([found["confidence"].values for *_, found in results])
    right, bins = error < RADIUS, np.clip((10 * sure).astype(int), 0, 9)
    say("confidence in the mean, share that is right, share of the vertices:\n")
    for b in np.unique(bins):
        say(
            f"{sure[bins == b].mean():.2f} {right[bins == b].mean():.2f} {(bins == b).mean():.2f}\n"
        )
    base = right.mean()
    say(f"Brier score {np.mean((sure - right) ** 2):.3f}, of the mean {base * (1 - base):.3f}\n")


def failures(folder):
    """Whether a registration that failed is reported from those that are right, and by what."""
    errors, signs = [], {name: [] for name in SIGNS}
    with mock.patch.multiple(initial_map, SEARCHED=(), N_PAIRED=0):
        for seed in FAILING:
            chosen = {"faces": [], "brains": [], "cats": [], "faust": [seed, 30]}
            for pair in pairs_of(folder, chosen):
                error, _, found = measured(pair)
                errors.append(100 * error.mean())
                for name, sign in SIGNS.items():
                    signs[name].append(float(sign(found)))
    errors = np.array(errors)
    signs = {name: np.array(values) for name, values in signs.items()}
    signs["registration_error x distortion"] = signs["registration_error"] * signs["distortion"]
    signs["bidirectional x distortion"] = signs["bidirectional"] * signs["distortion"]
    failed, right = errors > plausibility.FAILED, errors < plausibility.RIGHT
    sys.stdout.write(
        f"{len(errors)} pairs: {failed.sum()} failed, more than {plausibility.FAILED:.0f} %; "
        f"{right.sum()} right, below {plausibility.RIGHT:.0f} %\n"
        f"{'':28} area under curve   told of failed, with 5 % of the right\n"
    )
    for name, sign in signs.items():
        area = roc_auc_score(failed[failed | right], sign[failed | right])
        limit = np.quantile(sign[right], 0.95)
        caught = (sign[failed] > limit).mean()
        sys.stdout.write(f"{name:28} {area:16.3f} {caught:14.2f}, beyond {abs(limit):.4f}\n")
    for what, limit in (("flagged", WRONG), ("a warning", UNSURE)):
        told = signs["registration_error x distortion"] > limit
        sys.stdout.write(
            f"{what}, beyond {limit}: {told[failed].sum()} of {failed.sum()} failed, "
            f"{told[right].sum()} of {right.sum()} right\n"
        )


def calibration(folder):
    """The fit on the tuned pairs, and what the library's weights say of the reported ones."""
    found = {}
    for kind, chosen in (("tuned", TUNED), ("reported", REPORTED)):
        pairs = list(pairs_of(folder, chosen))
        found[kind] = [pair.name for pair in pairs], [measured(pair) for pair in pairs]
    fitted = " ".join(f"{weight:.2f}" for weight in fit(found["tuned"][1]))
    sys.stdout.write(f"fitted weights {fitted}; of the library {WEIGHTS}\n")
    report(*found["reported"])


def main(words):
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, DATA / "unpack.py", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (failures if words == ["failures"] else calibration)(Path(folder))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1:])
