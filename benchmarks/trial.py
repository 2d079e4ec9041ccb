"""A folder of 60 good files and 40 bad ones of 40 kinds: what a run says, and its effect.

``python benchmarks/trial.py [FOLDER]`` writes the files, runs ``s4a run`` over all of them,
and prints the summary and what became of every bad file.  Then it does what the summary says: bad
ones that stood in the network, used with a warning or of a registration that failed, are taken
away.  The results of the good ones are compared bit for bit with those of a run over them alone.
It exits with 1 where they differ, where a bad file is used and nothing is reported of it, or where
the summary is longer or wider than a screen.
"""

import contextlib
import gzip
import io
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from faults import shapes as faulty

from s4a import cli, open_study, synthetic, write_mesh
from s4a.cli.tables import LINES, SCREEN
from s4a.geometry.mesh import as_arrays

N_GOOD = 60
FLAGS = ("--n-coarse 250 --k 40 --k-init 12 --n-pairs 150 --no-intersections").split()
UNREADABLE = ("zero", "cut", "text", "promise", "points", "beyond", "negative", "pickle", "bomb")
STAGES = ("network", "latent", "pca", "registration")


def say(text):
    """A line of the result."""
    sys.stdout.write(f"{text}\n")


def brains(n, vertices=800):
    """Synthetic brains: name -> points and triangles."""
    tree = synthetic.brains(n, vertices, seed=3)["original"]
    return {name: as_arrays(node.to_dataset()) for name, node in tree.children.items()}


def cut_off(X, T, share, axis=2):
    """What lies under a plane that leaves the share of the vertices away."""
    kept = X[:, axis] <= np.quantile(X[:, axis], 1 - share)
    T = T[kept[T].all(axis=1)]
    used = np.unique(T)
    return X[used], np.searchsorted(used, T)


def shuffled(X, T):
    """The same surface, its vertices in another order."""
    order = np.random.default_rng(0).permutation(len(X))
    return X[order], np.argsort(order)[T]


def crumpled(X, T):
    """Noise of a tenth of the size on every vertex."""
    return X + np.random.default_rng(1).normal(0, 0.1 * np.ptp(X), X.shape), T


# of a good shape X, T each makes one that is not what its file says
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
ALTERED = {
    "metres": lambda X, T: (X / 1000, T),
    "centimetres": lambda X, T: (X / 10, T),
    "inches": lambda X, T: (X / 25.4, T),
    "micrometres": lambda X, T: (X * 1000, T),
    "tiny": lambda X, T: (X * 1e-9, T),
    "huge": lambda X, T: (X * 1e9, T),
    "larger_by_6": lambda X, T: (X * 6, T),
    "smaller_by_6": lambda X, T: (X / 6, T),
    "mirrored_x": lambda X, T: (X * [-1, 1, 1], T[:, ::-1]),
    "mirrored_turned": lambda X, T: (X[:, [1, 2, 0]] * [1, -1, 1], T[:, ::-1]),
    "half_missing": lambda X, T: cut_off(X, T, 0.5),
    "third_missing": lambda X, T: cut_off(X, T, 0.33, axis=0),
    "stretched": lambda X, T: (X * [1, 1, 2], T),
    "flattened": lambda X, T: (X * [1, 1, 0.2], T),
    "sphere": lambda X, T: as_arrays(synthetic.sphere(800)),
    "torus": lambda X, T: as_arrays(synthetic.torus(40, 20, 50, 20)),
    "another_kind": lambda X, T: faulty.shape(0, 800),
    "same_file": lambda X, T: (X, T),
    "same_shuffled": shuffled,
    "rounded_to_8": lambda X, T: (8 * np.round(X / 8), T),
    "crumpled": crumpled,
    "tetrahedron": lambda X, T: (60 * np.eye(4, 3), TETRAHEDRON),
    "one_triangle": lambda X, T: (X[T[0]], np.array([[0, 1, 2]])),
    "on_a_line": lambda X, T: (X * [1, 0, 0], T),
    "no_number": lambda X, T: (np.full_like(X, np.nan), T),
    "three_parts": lambda X, T: (np.r_[X, X + 300, X + 600], np.r_[T, T + len(X), T + 2 * len(X)]),
}
WRITTEN = {
    "page.ply": b"<!doctype html><title>404</title>",
    "noise.stl": np.random.default_rng(2).bytes(5000),
    "empty.obj": b"# no vertices\n",
    "half.ply.gz": gzip.compress(bytes(4000))[:20],
    "sentence.off": "kein Netz, nur ein Satz\n".encode("utf-16"),
}
N_BAD = len(UNREADABLE) + len(ALTERED) + len(WRITTEN)


def make(folder, n_good=N_GOOD, altered=tuple(ALTERED)):
    """Write the good files and the bad ones, in two folders; gives the names of both."""
    shapes = brains(n_good)
    for part in ("good", "bad"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for name, mesh in shapes.items():
        write_mesh(folder / "good" / f"{name}.ply", *mesh)
    bad = []
    for i, kind in enumerate(altered):
        X, T = list(shapes.values())[i % n_good]
        write_mesh(folder / "bad" / f"{kind}.ply", *ALTERED[kind](X, T))
        bad.append(kind)
    for kind in UNREADABLE:
        fault = next(one for one in faulty.FAULTS if one.make.__name__ == kind)
        fault.make(folder / "bad" / fault.file)
        bad.append(kind)
    for file, content in WRITTEN.items():
        (folder / "bad" / file).write_bytes(content)
        bad.append(file.partition(".")[0])
    return list(shapes), bad


def run(paths, study, *flags):
    """``s4a run`` over some folders; what it wrote."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        cli.main(["run", *map(str, paths), "--out", str(study), *FLAGS, *flags])
    return out.getvalue()


def differing(one, other):
    """The stages in which the results of the first study are not in the second, bit for bit."""
    names = one["registration"]["shape"].values
    found = []
    for stage in STAGES:
        a, b = (study[stage].to_dataset().drop_attrs(deep=False) for study in (one, other))
        b = b.drop_vars(["score_excluded", "shape_excluded"], errors="ignore")
        if stage == "registration":
            b = b.sel(shape=[name for name in names if name in b["shape"].values])
        if not a.identical(b):
            found.append(stage)
    return found


def used_and_told(report, bad):
    """Of the bad shapes that a study uses: name -> kinds of what its report tells, or nothing.

    An odd shape may be an honest outlier: then it is reported, and no more.
    """
    of = {name: report.sel(shape=name) for name in bad if name in report["shape"].values}
    used = [name for name, row in of.items() if row["status"].item() in ("ok", "repaired")]
    return {name: of[name]["warning_kinds"].item() for name in used}


def main(folder):
    """Whether all is as it should be."""
    begin = time.monotonic()
    good, bad = make(folder)
    text = run([folder / "good", folder / "bad"], folder / "study")
    say(text)
    lines = text.splitlines()
    say(f"-- {len(lines)} lines, the longest of {max(map(len, lines))} letters\n")
    study = open_study(folder / "study")
    report = study["report"].to_dataset()
    status = dict(zip(report["shape"].values.tolist(), report["status"].values, strict=True))
    for kind in ("ok", "repaired", "flagged", "excluded"):
        say(f"{kind}: {', '.join(name for name in bad if status.get(name) == kind) or 'none'}")
    spoilt = [name for name in good if status[name] != "ok"]
    say(f"good ones that are not ok: {', '.join(spoilt) or 'none'}")
    told = used_and_told(report, bad)
    words = [f"{name} ({kinds or 'NOT TOLD'})" for name, kinds in told.items()]
    say(f"bad ones that are used, and what is reported of them: {', '.join(words) or 'none'}")
    network = study["network"]["shape"].values
    within = [name for name in bad if name in network]
    say(f"bad ones in the network: {', '.join(within) or 'none'}")
    for name in within:
        (folder / "bad" / f"{name}.ply").unlink()
    run([folder / "good", folder / "bad"], folder / "study")
    run([folder / "good"], folder / "alone")
    found = differing(open_study(folder / "alone"), open_study(folder / "study"))
    say(f"those taken away, results of the good ones that differ from those alone: {found or 0}")
    say(f"{time.monotonic() - begin:.0f} s")
    short = len(lines) <= LINES and max(map(len, lines)) <= SCREEN
    return short and all(told.values()) and not found and not spoilt


if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.exit(not main(Path(sys.argv[1])))
    with tempfile.TemporaryDirectory() as folder:
        sys.exit(not main(Path(folder)))
