"""Rigid alignment: accuracy, ambiguous poses, and results of rotated files.

``alignment.py accuracy``: degrees between the rigid transform that each ``alignment=`` finds and
that of the ground truth (corresponding vertices, or landmarks), for all pairs of some shapes.

``alignment.py ambiguous [COLLECTION ...]``: shapes that are flagged with an ambiguous pose: false
positives in real collections, and nearly symmetric rods, discs and tori.

``alignment.py rotations [COLLECTION ...]``: an analysis of the files as they are, and ten of files
that are rotated at random: share of equal matches, and differences of the variance ratios.

``alignment.py femurs``, ``alignment.py vertebrae``: 16 femurs or five vertebrae that are not
aligned: rotations, and landmark errors after ``s4a.analyse`` and after rigid ICP.

``alignment.py modes``: simulated modes that are found with the preset of the paper, by alignment.

The real collections are in the shared data beside the checkout.
"""

import itertools
import json
import logging
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import s4a
from s4a.geometry.align import rigid_transform
from s4a.geometry.mesh import as_arrays
from s4a.input.labels import read_volume
from s4a.method.alignment import align_all, alignment_residual, transform_onto
from s4a.method.shape import Shape
from s4a.options import PRESETS

DATA = Path(__file__).parents[2] / "shared" / "data"
ALIGNMENTS = ("search", "icp", "given")
SMALL = {"n_coarse": 300, "k": 30, "n_samples": 300, "intersections": False}
CLEAN = ("heads", "skulls", "faces", "faust_r", "kids", "hippocampi", "femurs", "femurs_sicas")
CLEAN = (*CLEAN, "spleens", "vertebrae", "brains")
SYMMETRIC = ("rods, bump 30 %", "rods, bump 10 %", "thin rods", "discs", "plain rods", "tori")
ROTATED = {"hippocampi": 5, "tori": 4, "femurs_sicas": 4, "faces": 3, "heads": 3}


def say(*cells):
    """Print a row of a table in Markdown."""
    sys.stdout.write("| " + " | ".join(map(str, cells)) + " |\n")
    sys.stdout.flush()


def title(*cells):
    """Print the head of a table."""
    say(*cells)
    say(*["---"] * len(cells))


def collection(name, most=40):
    """Return the meshes of a collection by name."""
    if name in SYMMETRIC:
        return dict(itertools.islice(simulated(name), most))
    if name == "brains":
        tree = s4a.synthetic.brains(min(most, 12), 4000)["original"].children
        return {shape: node.to_dataset() for shape, node in tree.items()}
    if name == "hippocampi":
        files = sorted((DATA / "hippocampi_msd").glob("*.nii.gz"))[:most]
        volumes = {file.name.partition(".")[0]: read_volume(file, "all")[:2] for file in files}
        return cleaned({shape: (X - X.mean(0), T) for shape, (X, T) in volumes.items()})
    with tempfile.TemporaryDirectory() as folder:
        unpack = [sys.executable, DATA / "unpack.py", folder, name]
        subprocess.run(unpack, check=True, stdout=subprocess.DEVNULL)
        files = sorted(Path(folder, name).glob("*.ply"))[:most]
        return {file.stem: s4a.read_shape(file) for file in files}


def cleaned(arrays):
    """Return clean meshes of points and triangles."""
    tree = s4a.read_shapes(arrays, compare=False)["original"].children
    return {name: node.to_dataset() for name, node in tree.items()}


def simulated(name):
    """Yield nearly symmetric shapes with names, each with its own proportions."""
    options = {
        "rods, bump 30 %": (0.3, (60, 12, 10)),
        "rods, bump 10 %": (0.1, (60, 12, 10)),
        "thin rods": (0.2, (200, 12, 10)),
        "discs": (0.15, (20, 50, 48)),
        "plain rods": (0.0, (60, 12, 10)),
    }
    for seed in range(5):
        mesh = torus(seed) if name == "tori" else bumpy(seed, *options[name])
        yield from cleaned({f"shape_{seed}": mesh}).items()


def bumpy(seed, bump, axes):
    """Return an ellipsoid with one bump and own proportions."""
    rng = np.random.default_rng(seed)
    U, T = as_arrays(s4a.synthetic.sphere(2000))
    half = np.array(axes)[[2, 1, 0]] * (1 + 0.06 * rng.standard_normal(3))
    place = np.array([0.3, 1, 0.8]) / np.linalg.norm([0.3, 1, 0.8])
    height = bump * (1 + 0.1 * rng.standard_normal())
    X = U * half * (1 + height * np.exp(-((U - place) ** 2).sum(1) / 0.15))[:, None]
    return X, T


def torus(seed, n=(90, 40)):
    """Return a torus with own radii along the angle u and own vertices, all in one pose."""
    i, j = np.indices(n)
    corner = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
    vertex = [((a % n[0]) * n[1] + b % n[1]).ravel() for a, b in corner]
    parts = ((0, 1, 2), (0, 2, 3))
    T = np.concatenate([np.stack([vertex[k] for k in part], axis=1) for part in parts])
    return torus_position(seed, *torus_angles(seed, n)), T


def torus_angles(seed, n=(90, 40)):
    """Angles u and v of the vertices of a torus ``(2, n)``."""
    start, _ = torus_numbers(seed)
    u, v = ((np.arange(k) + o) * 2 * np.pi / k for k, o in zip(n, start, strict=True))
    return np.array(np.meshgrid(u, v, indexing="ij")).reshape(2, -1)


def torus_numbers(seed):
    """Random numbers of a torus: offsets of its vertices, and the three of its radii."""
    rng = np.random.default_rng(seed)
    _, *start = rng.uniform(size=3)
    return start, rng.normal(0, 0.12, 3)


def torus_position(seed, u, v):
    """Positions ``(n, 3)`` of angles on a torus."""
    _, (a, b, c) = torus_numbers(seed)
    r = 0.35 * (1 + 0.35 * np.cos(u) + a * np.cos(2 * u) + b * np.sin(u))
    R = 1 + 0.25 * np.cos(u + 0.3) + c * np.sin(2 * u) + r * np.cos(v)
    x, y, z = R * np.cos(u), 1.2 * R * np.sin(u), r * np.sin(v) + 0.15 * np.sin(u)
    return np.stack([x, y, z], axis=-1)


def low_of(mesh, n_coarse=500):
    """Return the low resolution of a mesh in its frame, without eigenfunctions to speak of."""
    return Shape(coarse=s4a.spectrum(s4a.coarsen(mesh, n_coarse=n_coarse), k=4))


def degrees(R, S):
    """Angle between two rotations."""
    return np.rad2deg(Rotation.from_matrix(R @ S.T).magnitude())


def ambiguous(names):
    """Print how many shapes of each collection are flagged."""
    title("collection", "shapes", "flagged", "residual", "rotated by more than 45 degrees")
    for name in names or (*CLEAN, *SYMMETRIC):
        bases = {shape: low_of(mesh).low for shape, mesh in collection(name).items()}
        reference, *others = bases
        found = align_all(bases, reference)
        flagged = sum(bool(aligned.ambiguity) for aligned in found.values())
        rotated = sum(degrees(aligned.R, np.eye(3)) > 45 for aligned in found.values())
        residual = np.median(
            [alignment_residual(bases[n], bases[reference], found[n].transform) for n in others]
        )
        say(name, len(bases), flagged, f"{residual:.3f}", rotated)


def corresponding():
    """Yield collections: name, and points of each shape that correspond, by name."""
    tree = s4a.synthetic.brains(7, 10_000, seed=0)
    at = tree["truth/brain_01/reference_point"].values[::5]
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    points = {name: s4a.synthetic.position(tree["truth"], name, at) for name in meshes}
    yield "brains", meshes, {name: np.asarray(values) for name, values in points.items()}
    meshes = collection("faces", 8)
    yield "faces", meshes, {name: mesh["position"].values[::5] for name, mesh in meshes.items()}
    yield "femurs", *marked("femurs_sicas")
    yield "skulls", *marked("skulls")
    meshes = collection("heads", 6)
    yield "heads", meshes, {}


def marked(name):
    """Return meshes, and their landmarks (n, 3)."""
    meshes, points = collection(name, 8), {}
    folder = DATA / {"skulls": "mouse_skulls"}.get(name, name)
    for shape in meshes:
        file = next(folder.glob(f"{shape}*.json"))
        points[shape] = landmarks_of(file)
    return meshes, points


def landmarks_of(file):
    """Read landmarks of Scalismo's JSON or of a Slicer file, in RAS."""
    marks = json.loads(file.read_text(encoding="utf-8"))
    if isinstance(marks, list):
        return np.array([mark["coordinates"] for mark in marks])
    marks = marks["markups"][0]["controlPoints"]
    return np.array([mark["position"] for mark in marks])


def accuracy():
    """Print the error of the rotation by alignment, over all pairs."""
    title("collection", "pairs", *(f"{name}: mean (max)" for name in ALIGNMENTS))
    for name, meshes, points in corresponding():
        shapes = {shape: low_of(mesh, 2000) for shape, mesh in meshes.items()}
        errors = {alignment: [] for alignment in ALIGNMENTS}
        for a, b in itertools.combinations(meshes, 2):
            M, N = shapes[a], shapes[b]
            true = np.eye(3)
            if points:
                true = rigid_transform(M.to_frame(points[a]), N.to_frame(points[b]))[0]
            for alignment, values in errors.items():
                R, _ = transform_onto(M.low, N.low, alignment)
                values.append(degrees(R, true))
        cells = [f"{np.mean(values):.2f} ({np.max(values):.1f})" for values in errors.values()]
        say(name, len(values), *cells)


def rotated(meshes, seed, precision):
    """Return points and triangles of files, rotated at random unless the seed is 0."""
    found = {}
    for i, (name, mesh) in enumerate(meshes.items()):
        X, T = as_arrays(mesh)
        Q = Rotation.random(random_state=100 * seed + i).as_matrix() if seed else np.eye(3)
        found[name] = (X @ Q.T).astype(precision).astype(float), T
    return found


def rotations(names):
    """Print the differences between studies of rotated files and that of the files as they are."""
    columns = "equal matches, mean of all", "least of a shape", "variance ratio, most"
    title("collection", "shapes", "coordinates", "rotations with equal samples", *columns)
    for name, precision in itertools.product(names or ROTATED, (np.float64, np.float32)):
        meshes = collection(name, ROTATED.get(name, 5))
        studies = (s4a.analyse(rotated(meshes, seed, precision), **SMALL) for seed in range(11))
        rows = [compared_parts(study) for study in studies]
        (samples, match, ratio), *others = rows
        same = sum(all(map(np.array_equal, samples, s)) for s, _, _ in others)
        equal = [(match == m).mean(1) if m.shape == match.shape else 0 for _, m, _ in others]
        most = max(abs(ratio - r).max() if len(r) == len(ratio) else 1 for *_, r in others)
        shares = f"{100 * np.mean(equal):.2f} %", f"{100 * np.min(equal):.2f} %"
        say(name, len(meshes), f"{precision.__name__}", f"{same} of 10", *shares, f"{most:.0e}")


def compared_parts(study):
    """Return the samples of each low-resolution mesh, sorted, the matches, and variance ratios."""
    samples = [np.sort(node["sample_vertex"].values) for node in study["coarse"].children.values()]
    match = study["registration"]["registered_match"].values
    return samples, match, study["pca"]["explained_variance_ratio"].values


def landmarks(which, n_coarse=1000):
    """Print rotations and landmark errors after registration, and after rigid ICP."""
    meshes = cleaned({name: as_arrays(mesh) for name, mesh in collection(which).items()})
    marks = {name: landmarks_of(DATA / which / f"{name}.json") for name in meshes}
    options = {"n_coarse": n_coarse, "k": 60, "intersections": False}
    study = s4a.analyse(meshes, **options)
    registration, report = study["registration"], study["report"]
    template = registration.attrs["template"]
    X = registration["position"].values
    at = cKDTree(X).query(marks[template])[1]  # vertices of the template
    low = {name: low_of(mesh, n_coarse) for name, mesh in meshes.items()}
    title("shape", "status", "rotation, degrees off", "error after analyse", "after rigid ICP")
    errors = []
    for name in meshes:
        if name == template:
            continue
        one = registration.sel(shape=name)
        R, t = one["rotation"].values, one["translation"].values
        image = X + one["displacement"].values
        moved = marks[name] @ R.T + t
        after = np.linalg.norm(image[at] - moved, axis=1).mean()
        true = rigid_transform(marks[name], marks[template])[0]
        M, N = low[name], low[template]
        S, u = transform_onto(M.low, N.low)
        icp = (M.to_frame(marks[name]) * M.frame[1] / N.frame[1]) @ S.T + u
        rigid = np.linalg.norm(N.from_frame(icp) - marks[template], axis=1).mean()
        errors.append((after, rigid))
        status = report["status"].sel(shape=name).item()
        say(name, status, f"{degrees(R, true):.1f}", f"{after:.2f} mm", f"{rigid:.2f} mm")
    say("mean", "", "", *(f"{value:.2f} mm" for value in np.mean(errors, axis=0)))


def modes(n=12, n_vertices=2500):
    """Print |correlation| of scores and simulated scores of the brains, and displacement errors."""
    tree = s4a.synthetic.brains(n, n_vertices)
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    truth = tree["truth"]["true_score"].values  # (shape, mode)
    shares = "variance of three, of five components", "the same at low resolution"
    title("options", "correlation of each simulated mode", *shares)
    rows = {f"paper, {name}": PRESETS["paper"] | {"alignment": name} for name in ALIGNMENTS}
    rows |= {f"default, {name}": {"alignment": name} for name in ALIGNMENTS[:2]}
    for name, options in rows.items():
        study = s4a.analyse(meshes, **{**options, "n_coarse": 1000, "k": 60}, template="brain_01")
        pca = study["pca"]
        score = pca["score"].values[:, :3]
        both = np.corrcoef(score.T, truth.T)[:3, 3:]
        correlation = " ".join(f"{value:.2f}" for value in np.abs(both).max(0))
        cells = []
        for kind in ("", "_low"):
            explained = np.cumsum(pca[f"explained_variance_ratio{kind}"].values)
            cells.append(f"{explained[2]:.0%}, {explained[4]:.0%}")
        say(name, correlation, *cells)


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    what, *names = sys.argv[1:] or [""]
    actions = {"accuracy": accuracy, "modes": modes}
    actions["femurs"] = lambda: landmarks("femurs_sicas")
    actions["vertebrae"] = lambda: landmarks("vertebrae")
    lists = {"ambiguous": ambiguous, "rotations": rotations}
    if what in lists:
        lists[what](names)
    elif what in actions:
        actions[what]()
    else:
        sys.exit(__doc__)
