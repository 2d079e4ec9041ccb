"""Figures of ``docs/claims.md`` that no other benchmark measures.

``claims.py [remesh] [swaps] [discretization] [transfer] [--data FOLDER]``: error of a low
resolution (4.1), exchanged eigenfunctions in initial maps (Fig. 2), the same shapes with other
vertices (4.2), and both algorithms of a transfer (6.2).  Heads and faces are read from the shared
data next to the checkout, or from ``--data``, with a folder of PLY files for each set; without them
their rows are omitted.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

import s4a
from s4a import synthetic
from s4a.evaluation.methods import Spaces
from s4a.geometry.closest import distance_to_surface
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.options import Options

DATA = Path(__file__).parents[2] / "shared" / "data"
K = 50  # number of eigenfunctions that are compared
PRESETS = ("paper", None)


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def files_of(name, folder, given):
    """Return the PLY files of a set of real data, an empty list without data."""
    if given is None and DATA.is_dir():
        command = [sys.executable, DATA / "unpack.py", folder, name]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return sorted((Path(given or folder) / name).glob("*.ply"))


def remesh(given):
    """Print errors of surface, eigenvalues and eigenfunctions after remeshing to 6,000 vertices."""
    meshes = {"synthetic brain": synthetic.brains(1, 100_000)["original/brain_01"].to_dataset()}
    with tempfile.TemporaryDirectory() as folder:
        for name, count in (("heads", 2), ("faces", 1)):
            for path in files_of(name, folder, given)[:count]:
                meshes[path.stem] = s4a.read_shape(path)
    say("\n4.1: remeshed to 6,000 vertices\n")
    say(
        f"{'':24} {'vertices':>9} {'fewer by':>9} {'off surface':>12} {'eigenvalues':>12} "
        f"{'outside of the span':>20}"
    )
    for name, mesh in meshes.items():
        with threadpool_limits(1):
            spaces = Spaces(mesh, k=2 * K)
            dense, coarse = spaces.dense.low, spaces.coarse
            lost = lost_share(dense, coarse.U @ coarse.low.Phi)
        X, T = as_arrays(mesh)
        low = coarse.coarse
        off = distance_to_surface(X, *as_arrays(low))
        area = vertex_areas(X, T)
        size = np.sqrt(area.sum())
        approximate, true = coarse.low.eigenvalue[1:K], dense.eigenvalue[1:K]
        say(
            f"{name:24} {len(X):9} {100 * (1 - low.sizes['vertex'] / len(X)):7.1f} % "
            f"{100 * area @ off / area.sum() / size:10.3f} % "
            f"{100 * np.abs(approximate / true - 1).mean():10.2f} % {100 * lost:18.2f} %"
        )


def lost_share(dense, F):
    """Return the RMS residual of the first K eigenfunctions of the mesh in the span of F."""
    root = np.sqrt(dense.area)[:, None]
    Q = np.linalg.qr(root * F)[0]
    Phi = root * dense.Phi[:, :K]
    residual = Phi - Q @ (Q.T @ Phi)
    return float(np.sqrt((residual**2).sum(0)).mean())


def swaps(given):
    """Count the initial maps that exchange two of the first four non-constant eigenfunctions."""
    collections = {"six synthetic brains": synthetic.brains(6, 10_000, 3)}
    with tempfile.TemporaryDirectory() as folder:
        for name, count in (("heads", 6), ("faces", 6)):
            files = files_of(name, folder, given)[:count]
            if files:
                collections[f"six {name}"] = s4a.read_shapes(files, compare=False)
    say("\nFig. 2: initial maps of the paper whose largest entry of a row is off the diagonal")
    for name, tree in collections.items():
        coarse = {
            shape: s4a.spectrum(s4a.coarsen(node.to_dataset(), n_coarse=2000), k=20)
            for shape, node in tree["original"].children.items()
        }
        options = Options(preset="paper")
        network = s4a.build_network(coarse, k_init=20, **options.of("initial maps"))
        C = network["fmap_initial"].values
        block = np.abs(C[:, 1:5, 1:5])
        swapped = (block.argmax(2) != np.arange(4)).any(1)
        say(f"{name}: {swapped.sum()} of {len(swapped)} maps")


def discretization(given):
    """Print the median shape and eq. 5 of six brains with 5,000 to 40,000 vertices (4.2)."""
    say("\n4.2: eq. 5 of the same six brains, other vertices; 2,000 at low resolution, the paper\n")
    for n_vertices in (5_000, 10_000, 20_000, 40_000):
        shapes = synthetic.brains(6, n_vertices, 3)
        study = s4a.analyse(shapes, n_coarse=2000, preset="paper", n_jobs=1)
        latent = study["latent"]
        energy = ", ".join(f"{value:.4f}" for value in latent["distance_to_limit"].values)
        say(f"{n_vertices:7} vertices: median {latent.attrs['median']}; {energy}")


def transfer(given):
    """Transfer an external template to six brains: pair by pair, and through the median (6.2)."""
    tree = synthetic.brains(7, 10_000, 3)
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    outside = meshes.pop("brain_07")
    marks = outside[["landmark_name", "landmark_position"]]
    say(
        "\n6.2: labels and landmarks of a seventh brain on six of 10,000 vertices; CPU seconds of "
        "its registration and of carrying the labels\n"
    )
    say(f"{'':40} {'labels right':>13} {'landmarks off':>14} {'CPU s':>7}")
    for preset in PRESETS:
        study = s4a.analyse(meshes, n_coarse=2000, preset=preset, n_jobs=1)
        begin = time.process_time()
        pairs = s4a.register_pairs(outside, meshes, n_coarse=2000, preset=preset, n_jobs=1)
        label = outside["label"].values
        transferred = s4a.transfer_labels(pairs, label)
        seconds = time.process_time() - begin
        points = s4a.transfer_landmarks(pairs, marks)
        show(f"pair by pair, preset {preset}", transferred, points, meshes, seconds)
        begin = time.process_time()
        transferred = s4a.transfer_labels(study, label, source=outside)
        seconds = time.process_time() - begin
        points = s4a.transfer_landmarks(study, marks, source=outside)
        show(f"through the median, preset {preset}", transferred, points, meshes, seconds)


def show(name, transferred: xr.DataTree, points: xr.DataTree, meshes, seconds):
    """Print a row: share of correct labels, mean distance of landmarks in % of sqrt(area)."""
    right, off = [], []
    for shape, mesh in meshes.items():
        size = np.sqrt(vertex_areas(*as_arrays(mesh)).sum())
        right.append((transferred[shape]["label"].values == mesh["label"].values).mean())
        error = points[shape]["landmark_position"].values - mesh["landmark_position"].values
        off.append(np.linalg.norm(error, axis=1).mean() / size)
    say(f"{name:40} {100 * np.mean(right):11.1f} % {100 * np.mean(off):12.2f} % {seconds:7.1f}")


PARTS = {
    "remesh": remesh,
    "swaps": swaps,
    "discretization": discretization,
    "transfer": transfer,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--data", type=Path, help="a folder of meshes for each set")
    args = parser.parse_args()
    if set(args.parts) - set(PARTS):
        parser.error(f"parts are {', '.join(PARTS)}")
    for part in args.parts or PARTS:
        PARTS[part](args.data)
