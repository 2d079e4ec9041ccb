"""How far registered surfaces move when what should not matter changes.

``stability.py [FOLDER]``: a collection of meshes, by default the ten heads of the shared data, is
analysed with its first shape as the template; then without its last one, which is inserted into
that study, and with another seed.  Of every shape the mean and the largest distance between its
registered surfaces before and after.

``stability.py noise``: pairs of brains and faces with ground truth, each registered six times, the
first as they are, then with vertices moved at random by 1e-7 of sqrt(area), about the rounding of
files in single precision.  The mean, least and largest error show which pairs end on one of two
folds by chance; a change of the method by less than that is not shown by such a pair.
"""

import argparse
import pickle
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import peers
import speed

import s4a
from s4a.geometry.mesh import as_arrays, vertex_areas

DATA = Path(__file__).parents[2] / "shared" / "data"


def surfaces(study):
    """Name -> the registered template, in the frame of the shape's file ``(n, 3)``."""
    found = study["registration"].to_dataset()
    X = found["position"].values
    image = {}
    for name in found["shape"].values.tolist():
        one = found.sel(shape=name)
        moved = X + one["displacement"].values - one["translation"].values
        image[name] = moved @ one["rotation"].values / one["scale"].item()
    return image


def movement(before, after, size):
    """Mean and largest distance of two registered templates, in % of sqrt(area) of the shape."""
    gap = 100 * np.linalg.norm(before - after, axis=1) / size
    return gap.mean(), gap.max()


def noise(n_runs=6):
    """Print the mean, least and largest error of each pair over runs with moved vertices."""
    sets = {
        name: (*peers.TUNED[name], *peers.REPORTED[name], *peers.MORE[name])
        for name in ("brains", "faces")
    }
    with tempfile.TemporaryDirectory() as work:
        command = [sys.executable, DATA / "unpack.py", work, "faces"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        speed.write_brains(2, 30_000, Path(work))
        source, target, true = pickle.loads((Path(work) / "pair").read_bytes())
        pairs = [("brains of 30002 vertices", target, source, peers.distance(target, true))]
        for name, some in sets.items():
            pairs += getattr(peers, name)(Path(work), some)
    sys.stdout.write("| pair | mean error | least | largest |\n| --- | --- | --- | --- |\n")
    for title, template, shape, measure in pairs:
        rng = np.random.default_rng(0)
        errors = [
            measure(
                peers.ours(noisy(template, size, rng), noisy(shape, size, rng), None, "elastic")
            )[0]
            for size in (0, *[1e-7] * (n_runs - 1))
        ]
        cells = " | ".join(f"{value:.3f}" for value in (np.mean(errors), min(errors), max(errors)))
        sys.stdout.write(f"| {title.split(',')[0]} | {cells} |\n")
        sys.stdout.flush()


def noisy(mesh, size, rng):
    """The mesh with normally distributed noise of this share of sqrt(area)."""
    X, T = as_arrays(mesh)
    scale = size * np.sqrt(vertex_areas(X, T).sum())
    return mesh.assign(position=mesh["position"] + scale * rng.normal(size=X.shape))


def main():
    if sys.argv[1:] == ["noise"]:
        noise()
        return
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--refine", default="elastic")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        folder = args.folder
        if folder is None:
            command = [sys.executable, DATA / "unpack.py", work, "heads"]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            folder = Path(work) / "heads"
        meshes = {path.stem: s4a.read_shape(path) for path in sorted(folder.glob("*.ply"))}
        report(meshes, args.refine, Path(work) / "study")


def report(meshes, refine, folder):
    """The table."""
    names = list(meshes)
    sizes = {n: np.sqrt(vertex_areas(*as_arrays(mesh)).sum()) for n, mesh in meshes.items()}
    options = {"template": names[0], "refine": refine, "include_flagged": True, "n_jobs": 2}
    fewer = {name: meshes[name] for name in names[:-1]}
    usual = surfaces(s4a.analyse(meshes, **options))
    with s4a.analyse(fewer, store=folder, **options) as study:
        ends = {f"without {names[-1]}": surfaces(study)}
        new = s4a.insert(study, {names[-1]: meshes[names[-1]]}, n_jobs=2)
        ends[f"{names[-1]} inserted"] = surfaces(new)
    ends["seed 1"] = surfaces(s4a.analyse(meshes, **options, seed=1))
    sys.stdout.write(f"| refine={refine!r}, % of sqrt(area): mean, largest | ")
    sys.stdout.write(f"{' | '.join(ends)} |\n{'|---' * (len(ends) + 1)}|\n")
    for name in names[1:]:
        cells = []
        for image in ends.values():
            found = movement(usual[name], image[name], sizes[name]) if name in image else ()
            cells.append(", ".join(f"{value:.3f}" for value in found) or "-")
        sys.stdout.write(f"| {name} | {' | '.join(cells)} |\n")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
