"""Effect of each deviation from the paper, alone and together, on sets with ground truth.

``additions.py [brains] [faces] [bodies] [--only ROW...] [--data FOLDER] [--write]``: mean distances
to the truth in % of sqrt(area), of the matched vertices and of the registered surface, and CPU
seconds.  With ``--write`` they go into ``docs/differences.csv``, and from there into the page
``docs/differences.md``, which ``differences.py --write`` makes again without running anything.
``--only`` runs the rows of these names, or that have one of the words in their name, ``--missing``
those without a result.  Faces and bodies are those of the shared data beside the checkout, or in a
folder that ``--data`` names, a folder of PLY files for each set.  Each is remeshed once: what comes
of it is kept in ``CACHE``, by content, parameters and version.
"""

import argparse
import contextlib
import hashlib
import importlib.metadata
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from unittest import mock

import differences
import numpy as np
from scipy.spatial.transform import Rotation

import s4a
from s4a import synthetic
from s4a.geometry.align import rigid_transform
from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.method.remesh import silence
from s4a.options import DECLARED, PRESETS
from s4a.schema import dataset

DATA = Path(__file__).parents[2] / "shared" / "data"
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "s4a-benchmarks"
N_COARSE = 2000
N_VERTICES = 10_000  # of a shape that is remeshed
CARRIED = 300  # vertices of the template that are transferred as landmarks

# ------------------------------------------------------------------------------ what the paper had


def closest_in_space(X, cell, Y, C):
    """ReMatching's U: the closest point in space of the whole coarse mesh."""
    return closest_point(X, Y, C)


# what is put in the place of ours, where there is no switch
INSTEAD = {
    "U by closest points in space": {"s4a.method.remesh.closest_point_in_star": closest_in_space},
}
PAPER = PRESETS["paper"]
DEFAULTS = PRESETS[None]
N_PROJECTED = 2500  # of 10,000 vertices, as 25,000 of 100,000
ON_THE_PAPER = {
    "refine": {"refine": "elastic"},
    "spectral_icp": {"refine": "spectral_icp"},
    "init": {"init": "dense"},
    "refined_eigenfunctions": {"refined_eigenfunctions": True},
    "n_samples": {"n_samples": DEFAULTS["n_samples"]},
    "dense_iterations": {name: DEFAULTS[name] for name in ("n_samples", "dense_iterations")},
    "articulated": {"refine": "elastic", "articulated": True},
    "alignment": {"alignment": "search"},
    "displacement_alignment": {"displacement_alignment": "fitted"},
    "area_weighted": {"area_weighted": True},
    "n_projected": {"n_projected": N_PROJECTED},
}
READINGS = [
    ("dense_match", "fmap"),
    ("method", "scalable"),
    ("sampling", "geodesic"),
    ("initial_refinement", "never"),
    ("init", "wave_kernels"),
    ("isometric", True),
    ("weights", "equal"),
    ("weights", "linear_program"),
    ("n_latent", 90),
    ("step", 10),
    ("alignment", "given"),
]
NORMS = ("h2", "h1", "frobenius", "h2_image", "h2_both")
OF_A_PAIR = ("refine", "init", "initial_refinement", "full_resolution_iterations", "bidirectional")


def study_rows():
    """Name of a row -> options of the analysis of a collection; what matters most comes first."""
    rows = {"paper": PAPER, "default": {}}
    rows |= {f"paper, {name}": PAPER | added for name, added in ON_THE_PAPER.items()}
    rows |= {f"default without {name}": {name: PAPER[name]} for name in ("init", "articulated")}
    rows["default, spectral_icp"] = {"refine": "spectral_icp"}
    rows["default, refined_eigenfunctions"] = {"refined_eigenfunctions": True}
    rows |= {f"paper, {name}={value}": PAPER | {name: value} for name, value in READINGS}
    rows |= {f"paper, {name}": PAPER for name in INSTEAD}
    rows |= {f"paper, norm={name}": PAPER | {"norm": name, "template": None} for name in NORMS}
    return rows


def pair_rows():
    """The same of pairs that are matched on their own."""
    paper = {name: value for name, value in PAPER.items() if DECLARED[name].metadata["pair"]}
    rows = {"pairs: paper": paper, "pairs: default": {}}
    for name in OF_A_PAIR:
        rows[f"pairs: paper, {name}"] = paper | {name: DEFAULTS[name]}
        rows[f"pairs: default without {name}"] = {name: PAPER[name]}
    return rows


# ------------------------------------------------------------------------------- sets with truth


def brains(given=None):
    """Six synthetic brains of 10,000 vertices, and where every template vertex is on each."""
    tree = synthetic.brains(6, N_VERTICES, 3)
    truth = tree["truth"]
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}

    def image(shape, template):
        return synthetic.position(truth, shape, truth[template]["reference_point"].values)

    return meshes, image


def unpacked(name, numbers, given=None):
    """Some of the registered shapes of a set: name -> (points, triangles)."""
    with tempfile.TemporaryDirectory() as folder:
        if given is None:
            command = [sys.executable, DATA / "unpack.py", folder, name]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        files = sorted((Path(given or folder) / name).glob("*.ply"))
        return {files[i].stem: as_arrays(s4a.read_shape(files[i])) for i in numbers}


def remeshed(X, T, n_vertices, subdivisions=2, iterations=10):
    """About so many vertices on the same surface, which tell nothing of the mesh's own.

    Isotropic remeshing keeps many vertices, and of registered shapes the same ones; of a mesh
    that is subdivided first hardly any.
    """
    version = importlib.metadata.version("pymeshlab")
    key = hashlib.sha256(X.tobytes() + T.tobytes())
    key.update(repr((X.dtype, T.dtype, n_vertices, subdivisions, iterations, version)).encode())
    file = CACHE / f"{key.hexdigest()}.npz"
    if not file.is_file():
        V, F = isotropic(X, T, n_vertices, subdivisions, iterations)
        CACHE.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(f".{os.getpid()}.npz")
        np.savez(part, V=V, F=F)
        part.replace(file)
    with np.load(file) as kept:
        return s4a.clean(as_dataset(kept["V"], kept["F"]))


def isotropic(X, T, n_vertices, subdivisions, iterations):
    """Points and triangles of PyMeshLab's isotropic remeshing of a subdivided mesh."""
    import pymeshlab

    length = np.sqrt(2 / np.sqrt(3) * vertex_areas(X, T).sum() / n_vertices)
    with silence():
        meshes = pymeshlab.MeshSet(verbose=False)
        meshes.add_mesh(pymeshlab.Mesh(X, T))
        meshes.meshing_surface_subdivision_midpoint(
            iterations=subdivisions, threshold=pymeshlab.PureValue(0.0)
        )
        meshes.meshing_isotropic_explicit_remeshing(
            targetlen=pymeshlab.PureValue(length), iterations=iterations
        )
        found = meshes.current_mesh()
        return found.vertex_matrix(), found.face_matrix().astype(np.int64)


def registered(name, numbers, given=None):
    """Registered shapes, each remeshed on its own: truth goes through the common triangles."""
    before = unpacked(name, numbers, given)
    meshes = {name: remeshed(*mesh, N_VERTICES) for name, mesh in before.items()}

    def image(shape, template):
        place = closest_point(meshes[template]["position"].values, *before[template])
        return interpolate(before[shape][0], before[template][1], *place)

    return meshes, image


SETS = {
    "brains": brains,
    "faces": lambda given: registered("faces", range(7, 13), given),
    "bodies": lambda given: registered("faust", range(6), given),
}

# -------------------------------------------------------------------------------------- measurement


@contextlib.contextmanager
def in_place(functions):
    """Other functions in the place of ours."""
    with contextlib.ExitStack() as stack:
        for name, function in functions.items():
            stack.enter_context(mock.patch(name, function))
        yield


def errors(study, image):
    """Mean errors of the matched vertices and of the registered surface, in % of sqrt(area)."""
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    size = np.sqrt(registration["vertex_area"].values.sum())
    found = []
    for name in registration["shape"].values.tolist():
        if name == template:
            continue
        one = registration.sel(shape=name)
        true = np.asarray(image(name, template))
        matched = study["original"][name]["position"].values[one["registered_match"].values]
        moved = one["position"].values + one["displacement"].values - one["translation"].values
        surface = moved @ one["rotation"].values / one["scale"].item()
        ends = np.stack([matched, surface])
        found.append(np.linalg.norm(ends - true, axis=2).mean(1))
    return 100 * np.mean(found, axis=0) / size


def field_errors(study, image):
    """Errors of rotation (degrees), displacement (% of sqrt(area)) and modes (mean |cos|).

    The true displacement is that after the best rigid transform of the true positions.  Of each of
    the first three principal components of true displacements, |cos| with the most similar of the
    first three modes is taken.
    """
    registration = study["registration"].to_dataset()
    template, X = registration.attrs["template"], registration["position"].values
    area = registration["vertex_area"].values
    others = [name for name in registration["shape"].values.tolist() if name != template]
    angles, true, found = [], [np.zeros_like(X)], [np.zeros_like(X)]
    for name in others:
        one = registration.sel(shape=name)
        Y = np.asarray(image(name, template))
        R, t, _ = rigid_transform(Y, X, area)
        off = Rotation.from_matrix(R @ one["icp_rotation"].values.T)
        angles.append(np.rad2deg(off.magnitude()))
        true.append(Y @ R.T + t - X)
        found.append(one["displacement"].values)
    distance = np.linalg.norm(np.subtract(found, true)[1:], axis=2).mean()
    first, second = (_components(fields, area) for fields in (true, found))
    cosine = np.abs(first @ second.T).max(1).mean()
    return np.mean(angles), 100 * distance / np.sqrt(area.sum()), cosine


def _components(fields, area):
    """The first three principal components of fields (n, v, 3), orthonormal rows."""
    rows = (np.subtract(fields, np.mean(fields, axis=0)) * np.sqrt(area)[:, None]).reshape(
        len(fields), -1
    )
    return np.linalg.svd(rows, full_matrices=False)[2][:3]


def carried_error(study, image):
    """Mean error of vertices of the template that are transferred, both ways where there are."""
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    size = np.sqrt(registration["vertex_area"].values.sum())
    X = registration["position"].values
    some = np.linspace(0, len(X) - 1, CARRIED).astype(int)
    marks = dataset(landmark_position=X[some], landmark_name=some.astype(str))
    found = [
        np.linalg.norm(
            node["landmark_position"].values - np.asarray(image(name, template))[some], axis=1
        ).mean()
        for name, node in s4a.transfer_landmarks(study, marks).children.items()
    ]
    return 100 * np.mean(found) / size


def measure(row, options, meshes, image, folder):
    """The cells of a row of the results; rows of norms share all but the registration."""
    first = min(meshes)
    begin = time.process_time()
    if row.startswith("pairs: "):
        others = {name: mesh for name, mesh in meshes.items() if name != first}
        study = s4a.register_pairs(
            meshes[first], others, name=first, n_coarse=N_COARSE, n_jobs=1, **options
        )
        seconds = time.process_time() - begin
        carried = f"{carried_error(study, image):.3f}"
    else:
        given = {"template": first, "n_coarse": N_COARSE, "include_flagged": True, "n_jobs": 1}
        if "norm=" in row:
            given["store"] = folder
        with in_place(INSTEAD.get(row.removeprefix("paper, "), {})):
            study = s4a.analyse(meshes, **given | options)
        seconds = time.process_time() - begin
        carried = ""
    match, surface = errors(study, image)
    template = study["registration"].attrs["template"]
    rotation, displacement, cosine = field_errors(study, image)
    fields = [f"{rotation:.2f}", f"{displacement:.3f}", f"{cosine:.2f}"]
    return [f"{match:.3f}", f"{surface:.3f}", carried, f"{seconds:.1f}", template, *fields]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"some of {', '.join(SETS)}")
    parser.add_argument("--only", nargs="+", default=[""], metavar="ROW")
    parser.add_argument("--data", type=Path, help="a folder of meshes for each set")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--missing", action="store_true", help="only rows without a result")
    args = parser.parse_args()
    real = args.data is not None or DATA.is_dir()
    for which in args.sets or [name for name in SETS if name == "brains" or real]:
        meshes, image = SETS[which](args.data)
        sys.stdout.write(f"\n{which}: matched, surface, carried, CPU s, template\n")
        rows = {**study_rows(), **pair_rows()}
        chosen = [row for word in args.only for row in rows if row == word]
        chosen += [row for word in args.only for row in rows if word not in rows and word in row]
        with tempfile.TemporaryDirectory() as folder:
            for row in dict.fromkeys(chosen):
                if args.missing and (which, row) in differences.results():
                    continue
                cells = measure(row, rows[row], meshes, image, Path(folder) / "study")
                sys.stdout.write(f"{row:42} {' '.join(f'{cell:>8}' for cell in cells)}\n")
                sys.stdout.flush()
                if args.write:
                    differences.keep(which, row, cells)
    if args.write:
        differences.write_page()


if __name__ == "__main__":
    main()
