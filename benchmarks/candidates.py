"""How often the score without truth picks the better candidate, on pairs with known correspondence.

For every pair: the error at low resolution of each candidate of s4a.method.spectral_icp.candidates,
that of the one picked, and that of the best.  Errors are mean straight-line distances in % of
sqrt(area), to the image of each coarse vertex.
"""

import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

import s4a
from s4a import synthetic
from s4a.geometry.align import align
from s4a.method import fmap, spectral_icp
from s4a.method.initial_map import initial_map
from s4a.method.shape import Shape

DATA = Path(__file__).parents[2] / "shared" / "data"
CORRESPONDING = {"faust15k": 6890}  # of these only the first vertices correspond
SETS = ("faces", "faust15k", "cats", "kids")


def shape_of(mesh):
    return Shape(mesh, s4a.spectrum(s4a.coarsen(mesh)))


def errors(source, target, image):
    """Candidate -> (score, error), for the true images of the target's coarse vertices.

    NaN where unknown.
    """
    with threadpool_limits(1):
        M, N = shape_of(source), shape_of(target)
        first = initial_map(M.low, N.low, align(M.low.cloud, N.low.cloud)[:2])
        starts = {
            "intrinsic": fmap.zoomout(M.low, N.low, first.C, 100)[1],
            "icp": first.near,
        }
        center, size = M.frame
        sample = N.coarse["sample_vertex"].values
        true = (np.where(sample[:, None] >= 0, image[sample], np.nan) - center) / size
        return {
            name: (score, 100 * np.nanmean(np.linalg.norm(M.low.X[match] - true, axis=1)))
            for name, (score, match, _) in spectral_icp.candidates(M.low, N.low, starts).items()
        }


def report(name, found):
    better = right = 0
    sys.stdout.write(f"\n{name}\n")
    for pair, candidates in found:
        picked = min(candidates, key=lambda c: candidates[c][0])
        best = min(candidates, key=lambda c: candidates[c][1])
        right += candidates[picked][1] <= 1.05 * candidates[best][1]
        better += candidates[picked][1] <= candidates["intrinsic"][1]
        text = ", ".join(f"{c} {e:.2f}" for c, (_, e) in candidates.items())
        sys.stdout.write(f"  {pair}: {text}; picked {picked}\n")
    sys.stdout.write(
        f"{name}: of {len(found)} pairs, within 5 % of the best candidate {right}, "
        f"not worse than intrinsic alone {better}\n"
    )
    sys.stdout.flush()


def registered(name, folder, limit=6):
    subprocess.run(
        [sys.executable, DATA / "unpack.py", folder, name], check=True, stdout=subprocess.DEVNULL
    )
    meshes = s4a.read_shapes(Path(folder) / name, pattern="*.ply")["original"].children
    pairs = list(pairwise(meshes))[:limit]
    jobs = []
    for a, b in pairs:
        source, target = meshes[a].to_dataset().load(), meshes[b].to_dataset().load()
        known = CORRESPONDING.get(name, len(source["position"]))
        image = np.full((target.sizes["vertex"], 3), np.nan)
        in_file = target["file_vertex"].values
        there = source["vertex_of_file"].values[np.minimum(in_file, known - 1)]
        ok = (in_file < known) & (there >= 0)
        image[ok] = source["position"].values[there[ok]]
        jobs.append(delayed(errors)(source, target, image))
    report(
        name, list(zip([f"{a} -> {b}" for a, b in pairs], Parallel(n_jobs=-1)(jobs), strict=True))
    )


def embedded(limit=6):
    tree = synthetic.brains(limit + 1, 20_000)
    shapes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    pairs = list(pairwise(shapes))
    images = [
        synthetic.position(tree["truth"], a, tree["truth"][b]["reference_point"].values)
        for a, b in pairs
    ]
    jobs = (
        delayed(errors)(shapes[a], shapes[b], image)
        for (a, b), image in zip(pairs, images, strict=True)
    )
    report(
        "embedded",
        list(zip([f"{a} -> {b}" for a, b in pairs], Parallel(n_jobs=-1)(jobs), strict=True)),
    )


if __name__ == "__main__":
    embedded()
    for name in SETS if DATA.is_dir() else ():
        with tempfile.TemporaryDirectory() as folder:
            registered(name, folder)
