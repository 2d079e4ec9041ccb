"""Registration beside what users of anatomy pick, on meshes that share no vertices.

``peers.py [faces brains skulls cortex] [--tuned|--more] [--ours] [--kept]``, --ours without the
others.
All begin at one rigid transform, of ICP.  Distance to the truth, its mean, 90th and 99th
percentile: faces and brains in % of sqrt(area), skulls in mm at 51 landmarks; cortex the share of
vertices with the right label.  MeshMonk and rustcpd (Coherent Point Drift) run with three settings,
the non-rigid ICP of Amberg et al. in trimesh with its own and with more steps; all are shown.

Faces are registered, vertex i is vertex i; the shape is remeshed so that its vertices say nothing
of these.  Isotropic remeshing alone keeps some: how many is said above each pair, and ``--kept``
shows what that contributes to whom.

Each method runs in a process of its own, which is ended at 900 s of CPU or 16 GiB; then the row
says so.

The pairs that elastic iterations were tuned on are shown with ``--tuned`` and left out otherwise;
of cortex templates there is one pair, which was tuned on.  ``--more`` shows pairs that stand in
neither, among them every other one of the five skulls, without spectral non-rigid ICP and without
trimesh, which takes 16 to 19 minutes a skull; at the end the mean of each method over the pairs of
a set, and on how many it is nearer than S4A.  All but brains need the shared data beside the
checkout; the others come with the extra ``bench``.
"""

import contextlib
import itertools
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import pymeshlab
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

import s4a
from s4a import synthetic
from s4a.geometry.align import align, cloud
from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, triangle_normals, vertex_areas, vertex_normals
from s4a.input.annotations import read_landmarks

MOST_SECONDS, MOST_BYTES = (
    900,
    16 * 2**30,
)  # of CPU and of memory, that a method may take for a pair
SHARES = 0.9, 0.99  # of the area, or of the landmarks, whose errors are below the percentile
DATA = Path(__file__).parents[2] / "shared" / "data"
TUNED = {
    "faces": [(0, 1)],
    "brains": [(1, 2)],
    "skulls": [(0, 1)],
    "cortex": [("conte69", "fsa5")],
}
REPORTED = {
    "faces": [(2, 3), (4, 5), (6, 7)],
    "brains": [(2, 3), (3, 4), (4, 1)],
    "skulls": [(2, 3), (4, 0)],
    "cortex": [],
}
MORE = {
    "faces": [(8, 9), (10, 11), (12, 13)],
    "brains": [(1, 3), (2, 4), (3, 2)],
    "skulls": [(0, 2), (0, 3), (1, 2), (1, 3), (1, 4), (2, 4), (3, 4)],
    "cortex": [],
}


def remeshed(mesh, kept=False):
    """The same surface with vertices of its own; with `kept`, a sixth are nearly where they were.

    After two subdivisions one vertex in 16 is of the mesh, and few of these are kept.
    """
    X, T = as_arrays(mesh)
    length = 0.93 * np.linalg.norm(X[T[:, 0]] - X[T[:, 1]], axis=1).mean()
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(X, T))
    if not kept:
        meshes.meshing_surface_subdivision_midpoint(
            iterations=2, threshold=pymeshlab.PureValue(0.0)
        )
    meshes.meshing_isotropic_explicit_remeshing(
        targetlen=pymeshlab.PureValue(float(length)), iterations=6 if kept else 10
    )
    new = meshes.current_mesh()
    return s4a.clean(as_dataset(new.vertex_matrix(), new.face_matrix()))


def share_kept(true, mesh):
    """Share of true places within a tenth of an edge of a vertex, and what it is by chance."""
    X, T = as_arrays(mesh)
    edge = np.linalg.norm(X[T[:, 0]] - X[T[:, 1]], axis=1).mean()
    gap = cKDTree(X).query(true)[0]
    return (gap < 0.1 * edge).mean(), np.pi * 0.1**2 / np.sqrt(0.75)


def faces(folder, pairs, kept=False):
    """Template, shape and a measure of the template's image, pair by pair."""
    for a, b in pairs:
        template, shape = (
            s4a.read_shape(folder / "faces" / f"identity{i:03d}.ply") for i in (a, b)
        )
        true = shape["position"].values
        new = remeshed(shape, kept)
        share = "{:.3f} kept, chance {:.3f}".format(*share_kept(true, new))
        yield f"faces {a} to {b}, {share}", template, new, distance(template, true)


def brains(_folder, pairs, _kept=False):
    tree = synthetic.brains(4, 20_000, 5)
    for a, b in pairs:
        names = [f"brain_{i:02d}" for i in (a, b)]
        template, shape = (tree["original"][name].to_dataset() for name in names)
        at = tree["truth"][names[0]]["reference_point"].values
        true = synthetic.position(tree["truth"], names[1], at)
        yield f"brains {a} to {b}", template, shape, distance(template, true)


def distance(template, true):
    """Mean distance to the truth in % of sqrt(area), and the percentiles of its vertices."""
    area = vertex_areas(*as_arrays(template))

    def measure(image):
        error = 100 * np.linalg.norm(image - true, axis=1) / np.sqrt(area.sum())
        order = np.argsort(error)
        below = np.cumsum(area[order]) / area.sum()
        return error @ area / area.sum(), *np.interp(SHARES, below, error[order])

    return measure


def skulls(folder, pairs, _kept=False):
    files = sorted((folder / "skulls").glob("*.ply"))
    for a, b in pairs:
        template, shape = (s4a.read_shape(files[i]) for i in (a, b))
        mark, true = (
            read_landmarks(files[i].with_suffix(".mrk.json"))["landmark_position"].values
            for i in (a, b)
        )
        X, T = as_arrays(template)
        on_template = closest_point(mark, X, T)

        def measure(image, T=T, on_template=on_template, shape=shape, true=true):
            Y, S = as_arrays(shape)
            at = interpolate(image, T, *on_template)
            error = np.linalg.norm(interpolate(Y, S, *closest_point(at, Y, S)) - true, axis=1)
            return error.mean(), *np.quantile(error, SHARES)

        yield f"skulls {files[a].stem} to {files[b].stem}, mm", template, shape, measure


def cortex(folder, pairs, _kept=False):
    file = {"fsa5": "fsa5_lh", "conte69": "conte69_32k_lh"}
    for pair in pairs:
        template, shape = (s4a.read_shape(folder / "brains" / f"{file[n]}.gii") for n in pair)
        labels = []
        for name, mesh in zip(pair, (template, shape), strict=True):
            with np.load(folder / "brains" / f"labels_{name}_lh_then_rh.npz") as arrays:
                labels.append(arrays["aparc"][: mesh.sizes["vertex"]])

        def measure(image, shape=shape, labels=labels):
            nearest = cKDTree(shape["position"].values).query(image)[1]
            return 100 * (labels[1][nearest] == labels[0]).mean(), np.nan, np.nan

        yield f"cortex {pair[1]} to {pair[0]}, % right", template, shape, measure


def ours(template, shape, _start, refine):
    return image_of(s4a.match_pair(shape, template, refine=refine), template)


def image_of(found, template):
    """The registered template in the frame of the shape's file ``(n, 3)``."""
    moved = template["position"].values + found["displacement"].values - found["translation"].values
    return moved @ found["rotation"].values / found["scale"].item()


def nearest(_template, shape, start):
    X, T = as_arrays(shape)
    return interpolate(X, T, *closest_point(start, X, T))


def meshmonk(template, shape, start, iterations, size=None):
    """MeshMonk, which has lengths in it: as given, or with `size` as the root of the area."""
    import meshmonk

    X, T = as_arrays(template)
    Y, S = as_arrays(shape)
    unit = size / np.sqrt(vertex_areas(Y, S).sum()) if size else 1.0
    rows = [
        np.concatenate([unit * P, vertex_normals(P, F)], axis=1).astype(np.float32)
        for P, F in ((start, T), (Y, S))
    ]
    found = meshmonk.pyramid_register(
        floating_features=rows[0],
        target_features=rows[1],
        floating_faces=T.astype(np.int32),
        target_faces=S.astype(np.int32),
        floating_flags=np.ones(len(X), np.float32),
        target_flags=np.ones(len(Y), np.float32),
        num_iterations=iterations,
    )
    return np.asarray(found.aligned_vertices, float) / unit


def drift(template, shape, start, beta, alpha):
    """Coherent Point Drift of every second vertex, its deformation at all; lengths for unit area.

    It stops on the way with its own tolerance and its own first variance, which are for clouds that
    are not aligned.
    """
    import rustcpd

    X = np.asarray(shape["position"].values)
    size = np.sqrt(vertex_areas(*as_arrays(shape)).sum())
    center = X.mean(axis=0)
    Y = (start - center) / size
    found = rustcpd.register_deformable(
        ((X - center) / size)[::2],
        Y[::2],
        alpha=alpha,
        beta=beta,
        low_rank=300,
        low_rank_method="pivoted_cholesky",
        normalize=False,
        outlier_weight=0.01,
        sigma2=1e-3,
        tolerance=1e-9,
        max_iterations=100,
        k=30,
    )
    parts = np.array_split(Y, len(Y) // 2000 + 1)  # each takes a matrix to the vertices used above
    return size * np.concatenate([found.transform(part) for part in parts]) + center


def amberg(template, shape, start, stiffness=None):
    """Non-rigid ICP of trimesh, with its own falling stiffness or another."""
    import trimesh
    from trimesh.registration import nricp_amberg

    moved = trimesh.Trimesh(start, as_arrays(template)[1], process=False)
    onto = trimesh.Trimesh(*as_arrays(shape), process=False)
    steps = None if stiffness is None else [[weight, 0, 0.5, 10] for weight in stiffness]
    return np.asarray(nricp_amberg(moved, onto, steps=steps))


OURS = "S4A, elastic iterations (default)"
METHODS = {
    OURS: (ours, "elastic"),
    "S4A, spectral non-rigid ICP": (ours, "joint"),
    "ICP, nearest point": (nearest,),
    "MeshMonk, 80 iterations": (meshmonk, 80),
    "MeshMonk, 80, sqrt(area) 200": (meshmonk, 80, 200.0),
    "MeshMonk, 200 iterations": (meshmonk, 200),
    "rustcpd, beta 1.2, alpha 0.1": (drift, 1.2, 0.1),
    "rustcpd, beta 2, alpha 10": (drift, 2.0, 10.0),
    "rustcpd, beta 4, alpha 0.1": (drift, 4.0, 0.1),
    "trimesh, nricp_amberg": (amberg,),
    "trimesh, 8 steps to 0.01": (amberg, np.geomspace(10, 0.01, 8)),
}


def begin(template, shape):
    """The template's vertices after the rigid transform of ICP onto the shape."""
    clouds = []
    for mesh in (template, shape):
        X, T = as_arrays(mesh)
        every = slice(None, None, max(1, len(X) // 6000))
        clouds.append(cloud(X[every], vertex_areas(X, T)[every], 500))
    R, t = align(*clouds)[:2]
    return template["position"].values @ R.T + t


def turned_over(template, image):
    """How many triangles look against the surface around them."""
    T = as_arrays(template)[1]
    around = vertex_normals(image, T)[T].sum(axis=1)
    return int((np.einsum("tx,tx->t", triangle_normals(image, T), around) < 0).sum())


def within_limits(method, *given):
    """What a method gives and its CPU seconds, in a process of its own; or None and why."""
    context = multiprocessing.get_context("fork")
    receive, send = context.Pipe(duplex=False)

    def run():
        resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS, MOST_SECONDS + 10))
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
        threadpool_limits(1)  # threads of BLAS that wait would count
        begin = time.process_time()
        try:
            send.send((method(*given), time.process_time() - begin))
        except MemoryError:
            os.abort()  # as what is not Python does where it gets no memory

    process = context.Process(target=run)
    process.start()
    send.close()
    found = None
    with contextlib.suppress(EOFError):
        found = receive.recv()
    process.join()
    said = {
        -signal.SIGXCPU: f"more than {MOST_SECONDS} s",
        -signal.SIGABRT: f"more than {MOST_BYTES / 2**30:.0f} GiB",
    }
    return found or (None, said.get(process.exitcode, f"ended with {process.exitcode}"))


def together(kind, of):
    """Each method over the pairs of a set that it came to its end on, beside S4A on the same."""
    text = f"\n{kind:42} {'pairs':>8} {'mean':>8} {'S4A':>8} {'nearer':>7}\n"
    for name, errors in of.items():
        there = np.array(list(errors.values()))
        own = np.array([of[OURS][title] for title in errors])
        nearer = int((there < own).sum())
        text += f"{name:42} {len(there):8d} {there.mean():8.3f} {own.mean():8.3f} {nearer:7d}\n"
    return text


def wanted(words):
    """The methods to run, by name."""
    if "--ours" in words:
        return {name: how for name, how in METHODS.items() if how[0] in (ours, nearest)}
    if "--more" in words:
        return {n: how for n, how in METHODS.items() if how[0] is not amberg and "joint" not in n}
    return METHODS


def main(words):
    sets = [word for word in words if word in REPORTED] or list(REPORTED)
    chosen = TUNED if "--tuned" in words else MORE if "--more" in words else REPORTED
    means = {}  # of a set and a method, pair by pair
    with tempfile.TemporaryDirectory() as folder:
        if DATA.is_dir():
            subprocess.run(
                [sys.executable, DATA / "unpack.py", folder], check=True, stdout=subprocess.DEVNULL
            )
        pairs = itertools.chain(
            *(globals()[name](Path(folder), chosen[name], "--kept" in words) for name in sets)
        )
        for title, template, shape, measure in pairs:
            sys.stdout.write(
                f"\n{title:42} {'mean':>8} {'p90':>8} {'p99':>8} {'turned':>7} {'CPU s':>7}\n"
            )
            start = begin(template, shape)
            for name, (method, *settings) in wanted(words).items():
                image, spent = within_limits(method, template, shape, start, *settings)
                if image is None:
                    sys.stdout.write(f"{name:42} {spent}\n")
                    continue
                flips = turned_over(template, image)
                found = measure(image)
                means.setdefault(title.split()[0], {}).setdefault(name, {})[title] = found[0]
                errors = " ".join(f"{error:8.3f}" for error in found)
                sys.stdout.write(f"{name:42} {errors} {flips:7d} {spent:7.1f}\n")
                sys.stdout.flush()
    if "--more" in words:
        sys.stdout.write("".join(together(kind, of) for kind, of in means.items()))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1:])
