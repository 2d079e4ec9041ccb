"""Warnings about modes of variation: a shape that makes one alone, and near copies.

``modes.py [COLLECTION ...]`` analyses twelve shapes of each collection: as they are, with a near
copy of one (noise of 0.05 % of sqrt(area)), and with one that is 1.7 times as large.  The modes are
those of all shapes and of random subsets of six and eight.  Ten minutes.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from compare import unpacked
from plausibility import hippocampi

import s4a
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method.pca import pca_without
from s4a.study.quality_control import check_modes

COLLECTIONS = ("brains", "hippocampi", "femurs_sicas", "spleens", "faust")
SMALL = {"n_coarse": 400, "k_init": 10, "k": 30, "n_jobs": 1, "intersections": False}
NOISE, LARGER = 5e-4, 1.7
TIMES = 50


def collection(name, folder):
    """Return twelve shapes by name, as points and triangles."""
    if name == "brains":
        tree = s4a.synthetic.brains(12, 2000, 1)["original"]
        return {n: as_arrays(mesh.to_dataset()) for n, mesh in tree.children.items()}
    if name == "hippocampi":
        return {n: as_arrays(s4a.clean(as_dataset(*mesh))) for n, mesh in hippocampi()}
    unpacked(name, folder)
    files = sorted((folder / name).glob("*.ply"))[:12]
    return {file.stem: as_arrays(s4a.read_shape(file)) for file in files}


def changed(shapes):
    """Yield what is changed, the shapes, and the name of the changed one."""
    first = sorted(shapes)[0]
    X, T = shapes[first]
    noise = np.random.default_rng(0).normal(size=X.shape)
    yield "clean", shapes, first
    copy = X + NOISE * np.sqrt(vertex_areas(X, T).sum()) * noise
    yield "near-copy", shapes | {"near_copy": (copy, T)}, first
    yield "influential", shapes | {first: (LARGER * X, T)}, first


def warned(shapes, needed):
    """Yield the kinds of warnings of the modes of subsets with the needed shapes."""
    meshes = {name: as_dataset(*mesh) for name, mesh in shapes.items()}
    study = s4a.analyse(meshes, **SMALL, include_flagged=True)
    data = study["registration"].to_dataset()
    area = float(data["vertex_area"].sum())
    rng = np.random.default_rng(0)
    others = [name for name in shapes if name not in needed]
    for n in (6, 8, len(shapes)):
        for _ in range(TIMES if n < len(shapes) else 1):
            kept = [*needed, *rng.permutation(others)[: n - len(needed)]]
            modes = pca_without(data, [name for name in shapes if name not in kept], None)
            flags = check_modes(modes, area)
            yield {flag.kind for some in flags.values() for flag in some}


def main(names):
    """Print the percentage of subsets with each warning."""
    sys.stdout.write("| subsets with a warning, % | clean | near copy | 1.7 times as large |\n")
    sys.stdout.write("|---|---:|---:|---:|\n")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            cells = []
            for kind, shapes, first in changed(collection(name, Path(folder))):
                needed = {"clean": [], "near-copy": [first, "near_copy"]}.get(kind, [first])
                found = list(warned(shapes, needed))
                hits = [bool(kinds) if kind == "clean" else kind in kinds for kinds in found]
                cells.append(f"{100 * np.mean(hits):.3g}")
            sys.stdout.write(f"| {name} | {' | '.join(cells)} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:] or COLLECTIONS)
