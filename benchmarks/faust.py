"""Bodies and cats by the published protocols: FAUST_r, TOSCA, the connectivity track of SHREC'19.

``faust.py [cats] [--shapes N] [--pairs N] [--seed S] [--templates I ...]``: shapes 000 to 019 of
FAUST_r in the shared data beside the checkout, 5,000 vertices, remeshed separately; or the eleven
cats of TOSCA, 27,894 vertices, of which vertex i is vertex i, at 500 of them.  All ordered pairs
within one study, and some pairs matched alone; with ``--templates`` also with other templates than
the median, by their number from 0.

``faust.py --shrec19 FOLDER [--pairs N]``: pairs of SHREC'19, *Matching Humans with Different
Connectivity*, matched alone.  The data are not shipped; FOLDER is a copy of
``riccardomarin/SHREC19_matching_humans``, see :func:`shrec19`.

Protocol: each point of the ground truth on the first shape is mapped to a vertex of the second; its
error is the length of the shortest path along edges (Dijkstra) from there to the true vertex, over
the square root of the second shape's area, times 100.
"""

import argparse
import itertools
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import scipy.io
from scipy.spatial import cKDTree

import s4a
from s4a.schema import dataset

DATA = Path(__file__).parents[2] / "shared" / "data"
CURVE = (1, 2, 5, 10)  # % of sqrt(area)
N_POINTS = 500  # of the cats
PUBLISHED = "| ULRSSM (Cao et al. 2023), trained on FAUST and SCAPE, 080 to 099 | | 1.6 | | | |\n"


def faust_r(n):
    """The first shapes of FAUST_r: meshes by name, and vertices (5000,) that correspond."""
    meshes, true = {}, {}
    for file in sorted((DATA / "faust_r").glob("*.npz"))[:n]:
        with np.load(file) as kept:
            true[file.stem] = kept["corres"]
            meshes[file.stem] = kept["vertices"].astype(float), kept["faces"]
    return meshes, true


def cats(n):
    """The first cats of TOSCA, in the same form; some of their vertices, the same on all."""
    with np.load(DATA / "tosca" / "cat.npz") as kept:
        names = [name.removesuffix(".off") for name in kept["names"][:n].tolist()]
        meshes = {name: (kept["V"][i].astype(float), kept[f"F{i}"]) for i, name in enumerate(names)}
        n_vertices = kept["V"].shape[1]
    at = np.sort(np.random.default_rng(0).choice(n_vertices, N_POINTS, replace=False))
    return meshes, dict.fromkeys(names, at)


def shrec19(folder):
    """Yield pairs of SHREC'19: both meshes, vertices of the first, true vertices of the second.

    As its ``1_compute_curves.m`` reads them: ``PAIRS_list_SHREC19_connectivity.txt`` has a pair of
    numbers in a line; ``mat/I.mat`` has a struct ``M``, whose first two fields are assumed to be
    vertices and triangles, and the vertices ``smpl_matches`` at which errors count; line v of
    ``FARMgt_txt/I_J.txt`` is the vertex of J for vertex v of I.  All indices begin with 1.
    """
    pairs = np.loadtxt(folder / "PAIRS_list_SHREC19_connectivity.txt", delimiter=",", dtype=int)
    for i, j in pairs:
        files = [scipy.io.loadmat(folder / "mat" / f"{n}.mat", squeeze_me=True) for n in (i, j)]
        source, target = ((X, T.astype(int) - 1) for X, T, *_ in (f["M"].item() for f in files))
        at = files[0]["smpl_matches"].astype(int) - 1
        image = np.loadtxt(folder / "FARMgt_txt" / f"{i}_{j}.txt", dtype=int) - 1
        yield f"{i} to {j}", source, target, at, image[at]


def errors(X, T, images, true):
    """Errors (i, n) of mapped positions of some shapes, each moved to the nearest vertex."""
    match = cKDTree(X).query(np.concatenate(images))[1]
    error = s4a.metrics.geodesic_error(X, T, match, np.tile(true, len(images)), limit=5.0)
    return 100 * error.reshape(len(images), -1)


def mapped(study, source, points, targets=None):
    """Images of points of one shape on others, by name."""
    marks = dataset(landmark_position=points, landmark_name=np.arange(len(points)).astype(str))
    found = s4a.transfer_landmarks(study, marks, source=source, targets=targets)
    return {name: node["landmark_position"].values for name, node in found.children.items()}


def alone(source, target, points):
    """Images of points of one shape on another, matched alone."""
    meshes = s4a.read_shapes({"source": source, "target": target}, compare=False)["original"]
    first, second = (meshes[name].to_dataset() for name in ("source", "target"))
    study = s4a.register_pairs(first, {"target": second}, name="source", n_jobs=1)
    return mapped(study, "source", points)["target"]


def say(name, rows, seconds):
    """Print a row of the table: mean error, that of the worst pair, accuracy curve, CPU time."""
    means, every = [np.mean(values) for values in rows], np.concatenate(rows)
    curve = " ".join(f"{100 * np.mean(every <= share):.1f}" for share in CURVE)
    cells = name, len(rows), f"{np.mean(means):.2f}", f"{max(means):.2f}", curve, f"{seconds:.0f}"
    sys.stdout.write("| " + " | ".join(map(str, cells)) + " |\n")
    sys.stdout.flush()


def in_study(meshes, true, points, folder, **options):
    """Template, errors of all ordered pairs, and CPU seconds; a study in the folder is used."""
    begin = time.process_time()
    study = s4a.analyse(meshes, n_jobs=1, include_flagged=True, store=folder, **options)
    images = {name: mapped(study, name, points[name]) for name in meshes}
    template = study["registration"].attrs["template"]
    study.close()
    seconds = time.process_time() - begin
    within = {}
    for target, mesh in meshes.items():
        sources = [name for name in meshes if name != target]
        found = errors(*mesh, [images[name][target] for name in sources], true[target])
        within |= {(name, target): row for name, row in zip(sources, found, strict=True)}
    return template, within, seconds


def report(meshes, true, n_pairs, seed, templates):
    """Print the rows of a collection: of all pairs in one study, and of some alone.

    With other templates the network is not computed again.
    """
    points = {name: X[true[name]] for name, (X, _) in meshes.items()}
    with tempfile.TemporaryDirectory() as folder:
        median, within, seconds = in_study(meshes, true, points, folder)
        row = f"one study of {len(meshes)} shapes, template"
        say(f"{row} {median}, the median", list(within.values()), seconds)
        for template in [list(meshes)[i] for i in templates]:
            _, other, spent = in_study(meshes, true, points, folder, template=template)
            say(f"{row} {template}", list(other.values()), spent)
    chosen = list(within)
    np.random.default_rng(seed).shuffle(chosen)
    chosen, single, spent = chosen[:n_pairs], [], 0.0
    for source, target in map(tuple, chosen):
        begin = time.process_time()
        image = alone(meshes[source], meshes[target], points[source])
        spent += time.process_time() - begin
        single += list(errors(*meshes[target], [image], true[target]))
    if single:
        say("pairs alone", single, spent)
        say("these pairs in the study", [within[tuple(pair)] for pair in chosen], seconds)


def report_shrec19(folder, n_pairs):
    """Print a row for each pair of SHREC'19."""
    for name, source, target, at, true in itertools.islice(shrec19(folder), n_pairs):
        begin = time.process_time()
        image = alone(source, target, source[0][at])
        say(name, list(errors(*target, [image], true)), time.process_time() - begin)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("set", nargs="?", choices=("faust_r", "cats"), default="faust_r")
    parser.add_argument("--shapes", type=int, default=20)
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--templates", type=int, nargs="+", default=[], metavar="I")
    parser.add_argument("--shrec19", type=Path, metavar="FOLDER")
    args = parser.parse_args()
    shares = ", ".join(map(str, CURVE))
    head = "pairs", "mean error", "worst pair", f"% of points within {shares} %", "CPU s"
    sys.stdout.write(f"| | {' | '.join(head)} |\n|{' --- |' * (len(head) + 1)}\n")
    if args.shrec19:
        report_shrec19(args.shrec19, args.pairs)
        return
    read = cats if args.set == "cats" else faust_r
    report(*read(args.shapes), args.pairs, args.seed, args.templates)
    sys.stdout.write("" if args.set == "cats" else PUBLISHED)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
