"""Femurs with landmarks, and spleens as a shape model, beside other programs.

``anatomy.py femurs``: sixteen raw femurs of the shared data beside the checkout, not aligned, with
six landmarks each.  Those of the template are mapped to the other shapes; the distance to where
they were marked there, in mm.

``anatomy.py spleens``: the 32 aligned spleens with which Point2SSM (Adams and Elhabian, ICLR 2024)
is trained, at 1,024 farthest-point samples of the template and their images, in the frame of the
files.  As that paper: Chamfer distance in mm^2, the mean squared distance of the points to the
nearest vertex of the mesh plus that of its vertices to the nearest point; compactness, the number
of components with 95 % of the variance; generalization, the mean distance between the points of a
left-out shape and its reconstruction by these components; specificity, the mean distance of 1,000
random shapes of the model to the nearest shape.  Its validation and test shapes are not used, so
shapes are left out one by one.  Also the mean distance of the points to the surface, in mm.  The
study has ``init="landmarks"``: with the default most pairs of spleens pass for large pose
differences, whose search takes 10 s a pair.

The template is the median shape of the study, for all methods.  Other programs begin at the rigid
transform that fits the registered surface of the study best, which favours them.  CPU seconds of
one core, a shape.  What is not installed is named.
"""

import argparse
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

N_POINTS, SHARE, N_RANDOM = 1024, 0.95, 1000  # of Point2SSM
FEMURS = ("program", "shapes", "mean, mm", "90 %, mm", "worst shape, mm", "CPU s")
SPLEENS = (
    "program",
    "shapes",
    "Chamfer, mm^2",
    "to the surface, mm",
    "components",
    "generalization, mm",
    "specificity, mm",
    "CPU s",
)


def zoomout(template, shape, start):
    """ZoomOut of pyFM from nearest vertices, with 20, 30, ... 60 eigenfunctions."""
    from pyFM.mesh import TriMesh
    from pyFM.refine.zoomout import mesh_zoomout_refine_p2p

    X = as_arrays(shape)[0]
    pair = [TriMesh(*as_arrays(mesh)).process(k=60, verbose=False) for mesh in (shape, template)]
    match = cKDTree(X).query(start)[1]
    options = {"k_init": 20, "nit": 4, "step": 10, "return_p2p": True}
    return X[mesh_zoomout_refine_p2p(match, *pair, **options)[1]]


PROGRAMS = {"nearest point after rigid alignment": METHODS["ICP, nearest point"]}
PROGRAMS |= {name: how for name, how in METHODS.items() if name.startswith(("MeshMonk", "rustcpd"))}
PROGRAMS |= {"pyFM, ZoomOut after rigid alignment": (zoomout,)}
SLOW = ("pyFM, ZoomOut after rigid alignment",)  # left out for spleens
MODULES = {"MeshMonk": "meshmonk", "rustcpd": "rustcpd", "pyFM": "pyFM"}


def is_installed(program):
    module = MODULES.get(program.split(",")[0])
    return module is None or importlib.util.find_spec(module) is not None


def results(meshes, programs, init):
    """Yield for each program its name, its images of the template by shape, and CPU seconds."""
    started = time.process_time()
    study = s4a.analyse(meshes, init=init, include_flagged=True, n_jobs=1)
    seconds = (time.process_time() - started) / len(meshes)
    name = study["registration"].attrs["template"]
    template, images = meshes[name], surfaces(study)
    yield "S4A, one study", name, images, seconds
    found = study["registration"].to_dataset()
    X, starts = found["position"].values, {}
    for n in meshes.keys() - {name}:
        R, t, s = (found[key].sel(shape=n).values for key in ("rotation", "translation", "scale"))
        starts[n] = (X - t) @ R / s
    for program in filter(is_installed, programs):
        method, *settings = PROGRAMS[program]
        images, spent = {name: template["position"].values}, []
        for n, start in starts.items():
            image, seconds = within_limits(method, template, meshes[n], start, *settings)
            if image is not None:
                images[n] = image
                spent.append(seconds)
        yield program, name, images, np.mean(spent)


def landmarks(folder, name):
    return np.array(
        [mark["coordinates"] for mark in json.loads((folder / f"{name}.json").read_text())]
    )


def landmark_errors(folder, meshes, name, images):
    """Mean distance, 90 % quantile and the largest mean of a shape, in mm."""
    X, T = as_arrays(meshes[name])
    at, errors = closest_point(landmarks(folder, name), X, T), []
    for n, image in images.items():
        if n != name:
            Y, S = as_arrays(meshes[n])
            place = interpolate(image, T, *at)
            place = interpolate(Y, S, *closest_point(place, Y, S))
            errors.append(np.linalg.norm(place - landmarks(folder, n), axis=1))
    return np.mean(errors), np.quantile(errors, 0.9), max(map(np.mean, errors))


def model_measures(meshes, name, images):
    """Chamfer distance, distance to the surface, and what :func:`model` measures."""
    X, _ = as_arrays(meshes[name])
    at = farthest_points(X, N_POINTS)
    P = np.stack([image[at] for image in images.values()])  # (s, p, 3)
    chamfer, distance = [], []
    for n, points in zip(images, P, strict=True):
        Y, S = as_arrays(meshes[n])
        there, back = cKDTree(Y).query(points)[0], cKDTree(points).query(Y)[0]
        chamfer.append((there**2).mean() + (back**2).mean())
        distance.append(distance_to_surface(points, Y, S).mean())
    return np.mean(chamfer), np.mean(distance), *model(P)


def components(P):
    """Mean shape (p, 3), principal components (c, p, 3) with SHARE of the variance, variances."""
    mean = P.mean(0)
    _, deviation, V = np.linalg.svd((P - mean).reshape(len(P), -1), full_matrices=False)
    share = np.cumsum(deviation**2) / (deviation**2).sum()
    c = int(np.searchsorted(share, SHARE)) + 1
    return mean, V[:c].reshape(c, *mean.shape), deviation[:c] ** 2 / (len(P) - 1)


def distances(A, b):
    """Mean distances ``(n,)`` between corresponding points of shapes A ``(n, p, 3)`` and b."""
    return np.linalg.norm(A - b, axis=2).mean(1)


def model(P):
    """Compactness, generalization and specificity of corresponding points ``(s, p, 3)``."""
    errors = []
    for i, left_out in enumerate(P):
        mean, V, _ = components(np.delete(P, i, axis=0))
        score = np.einsum("cpx,px->c", V, left_out - mean)
        errors.append(distances((mean + np.einsum("c,cpx->px", score, V))[None], left_out)[0])
    mean, V, variance = components(P)
    score = np.random.default_rng(0).normal(size=(N_RANDOM, len(V))) * np.sqrt(variance)
    nearest = [distances(P, mean + np.einsum("c,cpx->px", row, V)).min() for row in score]
    return len(V), np.mean(errors), np.mean(nearest)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("set", choices=("femurs", "spleens"))
    femurs = parser.parse_args().set == "femurs"
    head = FEMURS if femurs else SPLEENS
    programs = [name for name in PROGRAMS if femurs or name not in SLOW]
    with tempfile.TemporaryDirectory() as folder:
        kind = "femurs_sicas" if femurs else "spleens"
        command = [sys.executable, DATA / "unpack.py", folder, kind]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        folder = Path(folder) / kind
        meshes = {path.stem: s4a.read_shape(path) for path in sorted(folder.glob("*.ply"))}
        sys.stdout.write(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}\n")
        for program, name, images, seconds in results(
            meshes, programs, "dense" if femurs else "landmarks"
        ):
            if femurs:
                found = landmark_errors(folder, meshes, name, images)
            else:
                found = model_measures(meshes, name, images)
            cells = [f"{x:.2f}" if isinstance(x, float) else str(x) for x in found]
            row = " | ".join([program, str(len(images) - femurs), *cells, f"{seconds:.1f}"])
            sys.stdout.write(f"| {row} |\n")
            sys.stdout.flush()
    missing = sorted({p.split(",")[0] for p in programs if not is_installed(p)})
    sys.stdout.write(f"\nThe template is {name}. Not installed: {', '.join(missing) or 'none'}.\n")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
