"""Femurs with landmarks, and spleens as a shape model, compared with other programs.

``anatomy.py femurs``: sixteen raw femurs of the shared data beside the checkout, with six landmarks
each.  Those of the template are mapped to the other shapes; their distance to those marked there.

``anatomy.py spleens``: the 32 aligned spleens with which Point2SSM (Adams and Elhabian, ICLR 2024)
is trained, at 1,024 points of the template.  Chamfer distance as in its code: the mean squared
distance of points to the nearest vertex plus that of vertices to the nearest point; components with
95 % of the variance; generalization, the mean distance of points of a left-out shape to their
reconstruction; specificity, that of 1,000 random shapes to the nearest shape.  Its validation and
test shapes are not used.  With the default `init` these spleens pass for large pose differences,
whose search takes several seconds a pair.

The template is the median shape of the study.  Other programs begin at the rigid transform that
fits the registered surface of the study best, which favours them.  CPU seconds are of a shape.
"""

import importlib.util
import json
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from peers import DATA, METHODS, within_limits
from scipy.spatial import cKDTree
from stability import surfaces

import s4a
from s4a.geometry.align import farthest_points
from s4a.geometry.closest import closest_point, distance_to_surface, interpolate
from s4a.geometry.mesh import as_arrays

N_POINTS, SHARE, N_RANDOM = 1024, 0.95, 1000  # points and share as in Point2SSM
MEASURES = {
    "femurs": "mean, mm | 90 %, mm | worst shape, mm",
    "spleens": "Chamfer, mm^2 | to the surface, mm | components | generalization, mm "
    "| specificity, mm",
}
MODULES = {"MeshMonk": "meshmonk", "rustcpd": "rustcpd", "pyFM": "pyFM"}


def zoomout(template, shape, start):
    """ZoomOut of pyFM from nearest vertices, with 20, 30, ... 60 eigenfunctions."""
    from pyFM.mesh import TriMesh
    from pyFM.refine.zoomout import mesh_zoomout_refine_p2p

    X = as_arrays(shape)[0]
    pair = [TriMesh(*as_arrays(mesh)).process(k=60, verbose=False) for mesh in (shape, template)]
    match = cKDTree(X).query(start)[1]
    options = {"k_init": 20, "nit": 4, "step": 10, "return_p2p": True}
    return X[mesh_zoomout_refine_p2p(match, *pair, **options)[1]]


def programs(missing):
    """The methods to run besides S4A, by name, without those of modules that are missing."""
    found = {"nearest point after rigid alignment": METHODS["ICP, nearest point"]}
    found |= {n: how for n, how in METHODS.items() if n.startswith(("MeshMonk", "rustcpd"))}
    found["pyFM, ZoomOut after rigid alignment"] = (zoomout,)
    return {name: how for name, how in found.items() if not name.startswith(tuple(missing))}


def results(meshes, methods, init):
    """Yield of each program: name, template, its images by shape, CPU seconds of a shape."""
    started = time.process_time()
    study = s4a.analyse(meshes, init=init, include_flagged=True, n_jobs=1)
    name = study["registration"].attrs["template"]
    yield "S4A, one study", name, surfaces(study), (time.process_time() - started) / len(meshes)
    found = study["registration"].to_dataset()
    for program, (method, *settings) in methods.items():
        images, spent = {name: found["position"].values}, []
        for n in sorted(meshes.keys() - {name}):
            one = found.sel(shape=n)
            start = (one["position"] - one["translation"]).values @ one["rotation"].values
            given = meshes[name], meshes[n], start / one["scale"].item()
            image, seconds = within_limits(method, *given, *settings)
            images |= {} if image is None else {n: image}
            spent += [] if image is None else [seconds]
        yield program, name, images, np.mean(spent)


def femurs(folder, meshes, name, images):
    """Mean distance of landmarks, 90 % quantile, and the largest mean of a shape."""
    marks = {
        path.stem: np.array([mark["coordinates"] for mark in json.loads(path.read_text())])
        for path in folder.glob("*.json")
    }
    X, T = as_arrays(meshes[name])
    at, errors = closest_point(marks[name], X, T), []
    for n in images.keys() - {name}:
        Y, S = as_arrays(meshes[n])
        near = closest_point(interpolate(images[n], T, *at), Y, S)
        errors.append(np.linalg.norm(interpolate(Y, S, *near) - marks[n], axis=1))
    return np.mean(errors), np.quantile(errors, 0.9), max(map(np.mean, errors))


def spleens(_folder, meshes, name, images):
    """Chamfer distance, distance to the surface, and the measures of the shape model."""
    at = farthest_points(as_arrays(meshes[name])[0], N_POINTS)
    P = np.stack([image[at] for image in images.values()])  # (s, p, 3)
    found = []
    for n, points in zip(images, P, strict=True):
        Y, S = as_arrays(meshes[n])
        there, back = cKDTree(Y).query(points)[0], cKDTree(points).query(Y)[0]
        chamfer = (there**2).mean() + (back**2).mean()
        found.append((chamfer, distance_to_surface(points, Y, S).mean()))
    errors = []
    for i, left_out in enumerate(P):
        mean, V, _ = components(np.delete(P, i, axis=0))
        score = np.einsum("cpx,px->c", V, left_out - mean)
        errors.append(distance(mean + np.einsum("c,cpx->px", score, V), left_out))
    mean, V, variance = components(P)
    score = np.random.default_rng(0).normal(size=(N_RANDOM, len(V))) * np.sqrt(variance)
    nearest = [distance(P, mean + np.einsum("c,cpx->px", row, V)).min() for row in score]
    return *np.mean(found, 0), len(V), np.mean(errors), np.mean(nearest)


def components(P):
    """Mean shape (p, 3), components (c, p, 3) with SHARE of the variance, and variances (c,)."""
    mean = P.mean(0)
    _, deviation, V = np.linalg.svd((P - mean).reshape(len(P), -1), full_matrices=False)
    c = int(np.searchsorted(np.cumsum(deviation**2), SHARE * (deviation**2).sum())) + 1
    return mean, V[:c].reshape(c, *mean.shape), deviation[:c] ** 2 / (len(P) - 1)


def distance(A, b):
    """Mean distance between corresponding points of shapes ``(..., p, 3)``."""
    return np.linalg.norm(A - b, axis=-1).mean(-1)


def main(kind):
    missing = [name for name, module in MODULES.items() if not importlib.util.find_spec(module)]
    of_femurs = kind == "femurs"
    methods = programs(missing if of_femurs else [*missing, "pyFM"])
    measures = MEASURES[kind]
    sys.stdout.write(f"| program | shapes | {measures} | CPU s |\n")
    sys.stdout.write(f"|{' --- |' * (measures.count('|') + 4)}\n")
    with tempfile.TemporaryDirectory() as folder:
        packed = "femurs_sicas" if of_femurs else "spleens"
        command = [sys.executable, DATA / "unpack.py", folder, packed]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        folder = Path(folder) / packed
        meshes = {path.stem: s4a.read_shape(path) for path in sorted(folder.glob("*.ply"))}
        init = "dense" if of_femurs else "landmarks"
        for program, name, images, seconds in results(meshes, methods, init):
            found = globals()[kind](folder, meshes, name, images)
            cells = [f"{x:.2f}" if isinstance(x, float) else str(x) for x in found]
            row = program, str(len(images) - of_femurs), *cells, f"{seconds:.1f}"
            sys.stdout.write(f"| {' | '.join(row)} |\n")
            sys.stdout.flush()
    sys.stdout.write(f"\nThe template is {name}. Not installed: {', '.join(missing) or 'none'}.\n")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1])
