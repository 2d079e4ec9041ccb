"""Seconds and memory of every stage, beside what one would call otherwise, and how they grow.

Every row runs in a process of its own with one BLAS thread, ours and the other in turn, on the same
input: seconds of CPU, of the clock, and the peak of memory above what the process holds before.
pyFM is on PyPI as ``pyfmaps`` (the extra ``bench``).  ``speed.py stages``, ``pipelines``,
``growth``, ``pairs``, ``nearest``, or ``write`` runs one part, ``speed.py methods brains
faces heads`` an analysis by RE-MATCH and by SCALABLE of ten shapes of each, ``speed.py whole 51
100000`` the whole analysis of so many synthetic shapes of so many vertices, ``speed.py versions 51
100000`` the same by an older version and by this one, three times in turn, ``speed.py sizes``
meshes of 10,000 to 3.5 million vertices, or of those that are named, ``speed.py million`` a study
of ten shapes of a million.
"""

import io
import itertools
import json
import multiprocessing
import os
import pickle
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import psutil
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

import s4a
from s4a import metrics, synthetic
from s4a.evaluation import accuracy
from s4a.geometry.align import align, farthest_points
from s4a.geometry.crossing import count_crossing
from s4a.geometry.mesh import as_arrays, as_dataset, triangle_areas, unique_edges
from s4a.input.files import find_meshes
from s4a.method import fmap, latent
from s4a.method.initial_map import map_after_alignment
from s4a.method.nearest import nearest_in_cells, nearest_rows
from s4a.method.pca import gram_pca
from s4a.method.register import match_functions
from s4a.method.shape import Shape
from s4a.options import Options
from s4a.study import netcdf
from s4a.study.netcdf import write_netcdf

DATA = Path(__file__).parents[2] / "shared" / "data"
VERTICES, NETWORK, K_INIT, K = 100_000, 10, 20, 100
HEAD = f"{'stage':36} {'':34} {'CPU s':>8} {'wall s':>8} {'MiB':>8} {'ratio':>7}"


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def peak():
    """Peak memory of this process in MiB; not that of its parent, which ru_maxrss begins with."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    words = dict(line.split(":", 1) for line in status.read_text().splitlines())
    return int(words["VmHWM"].split()[0]) / 1024


def child(function, *arguments):
    """What the function gives, its seconds of CPU and of the clock, and its peak memory in MiB."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # some native filters print
    before = peak()
    cpu, wall = time.process_time(), time.perf_counter()
    with threadpool_limits(1):
        result = function(*arguments)
    spent = time.process_time() - cpu, time.perf_counter() - wall
    return result, *spent, peak() - before


def measured(function, *arguments):
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(child, function, *arguments).result()


def beside(stage, ours, *others):
    """Print a row for ours and each of the others: (name, function, arguments).

    Gives what they return.
    """
    results, first = [], None
    for name, function, *arguments in (ours, *others):
        result, cpu, wall, memory = measured(function, *arguments)
        first = first or cpu
        say(f"{stage:36} {name:34} {cpu:8.2f} {wall:8.2f} {memory:8.0f} {cpu / first:7.1f}")
        stage = ""
        results.append(result)
    return results


# ours ---------------------------------------------------------------------------------------------


def our_read(path):
    return s4a.read_shape(path)


def our_crossing(X, T):
    return count_crossing(X, T)


def our_remesh(mesh):
    return s4a.coarsen(mesh)


def our_both(mesh):
    return s4a.spectrum(s4a.coarsen(mesh), k=K)


def our_spectrum(coarse):
    return s4a.spectrum(coarse, k=K)


def our_first_map(a, b, transform):
    return map_after_alignment(a, b, transform, k_init=K_INIT).C


def our_zoomout(C, a, b):
    return fmap.zoomout(a, b, C, K)[0]


def our_network(C, source, target, shapes):
    samples = [basis.sample_vertices_of() for basis in shapes]
    return latent.consistent_zoomout(shapes, C, source, target, K, samples=samples)[3]


def our_nearest(Q, D, cell_q, cell_d):
    return nearest_in_cells(Q, cell_q, D, cell_d)[0]


def our_modes(d, area):
    return gram_pca(d, area)[2]


# the others ---------------------------------------------------------------------------------------


def meshlab(path):
    import pymeshlab

    found = pymeshlab.MeshSet(verbose=False)
    found.load_new_mesh(str(path))
    return found


def other_read(path):
    found = meshlab(path)
    for name in (
        "meshing_remove_duplicate_vertices",
        "meshing_remove_duplicate_faces",
        "meshing_remove_null_faces",
        "meshing_repair_non_manifold_edges",
        "meshing_remove_unreferenced_vertices",
    ):
        found.apply_filter(name)
    return found.current_mesh().vertex_number()


def other_crossing(X, T):
    import pymeshlab

    found = pymeshlab.MeshSet(verbose=False)
    found.add_mesh(pymeshlab.Mesh(X, T))
    found.compute_selection_by_self_intersections_per_face()
    return found.current_mesh().selected_face_number()


def closest_points(X, V, F):
    """Closest points of X on a mesh, as the rows of a U by Euclidean distance."""
    import igl

    index = igl.point_mesh_squared_distance(X, V, F)[1]
    return index, np.abs(igl.barycentric_coordinates(X, *(V[F[index, i]] for i in range(3))))


def other_quadric(path, X):
    found = meshlab(path)
    found.meshing_decimation_quadric_edge_collapse(targetfacenum=12_000)
    mesh = found.current_mesh()
    return closest_points(X, mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64))


def other_isotropic(path, X):
    import pymeshlab

    found = meshlab(path)
    area = found.get_geometric_measures()["surface_area"]
    length = np.sqrt(area / 12_000 * 4 / np.sqrt(3))
    found.meshing_isotropic_explicit_remeshing(targetlen=pymeshlab.PureValue(length), iterations=5)
    mesh = found.current_mesh()
    return closest_points(X, mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64))


def trimesh(X, T):
    from pyFM.mesh import TriMesh

    return TriMesh(np.ascontiguousarray(X), np.ascontiguousarray(T))


def other_spectrum(X, T):
    return trimesh(X, T).process(k=K, verbose=False).eigenvalues


def other_icp(source, target):
    import pymeshlab

    found = pymeshlab.MeshSet(verbose=False)
    for X, T in (target, source):
        found.add_mesh(pymeshlab.Mesh(X, T))
    found.compute_matrix_by_icp_between_meshes(referencemesh=0, sourcemesh=1)
    return found.current_mesh().transform_matrix()


def processed(X, T, Phi, eigenvalue):
    """A mesh of pyFM with a spectrum that is already there."""
    mesh = trimesh(X, T)
    mesh.process(k=0, verbose=False)
    mesh.eigenvectors, mesh.eigenvalues = Phi, eigenvalue
    return mesh


def other_first_map(a, b, landmarks):
    from pyFM.functional import FunctionalMapping

    model = FunctionalMapping(processed(*a), processed(*b))
    model.preprocess(n_descr=100, landmarks=landmarks, subsample_step=5, k_process=K, k_descr=K)
    model.fit(K=(K_INIT, K_INIT))
    return model.FM_12


def other_zoomout(C, a, b):
    from pyFM.refine.zoomout import zoomout_refine

    return zoomout_refine(C, a.Phi, b.Phi, nit=(K - K_INIT) // 5, step=5, A2=b.area, n_jobs=1)


def other_network(C, source, target, shapes):
    from pyFM.FMN import FMN

    meshes = [processed(*s) for s in shapes]
    found = FMN(meshes, {(int(i), int(j)): c for i, j, c in zip(source, target, C, strict=True)})
    found.zoomout_refine(
        nit=(K - K_INIT) // 5, step=5, subsample=1000, isometric=True, cclb_ratio=1, n_jobs=1
    )
    found.compute_W()
    found.compute_CLB()
    found.compute_CCLB(K, verbose=False)
    return found.CCLB


def other_nearest(Q, D):
    from pyFM.spectral.nearest_neighbor import knn_query

    return np.ravel(knn_query(D, Q, n_jobs=1))


def scipy_nearest(Q, D):
    from scipy.spatial import cKDTree

    return cKDTree(D).query(Q)[1]


def sklearn_nearest(Q, D):
    from sklearn.neighbors import NearestNeighbors

    return (
        NearestNeighbors(n_neighbors=1, algorithm="brute")
        .fit(D)
        .kneighbors(Q, return_distance=False)[:, 0]
    )


def other_modes(d, area):
    from sklearn.decomposition import PCA

    return PCA().fit((d * np.sqrt(area)[:, None]).reshape(len(d), -1)).explained_variance_


# the tables ---------------------------------------------------------------------------------------


def collection(n, n_vertices, folder):
    """A synthetic collection as PLY files.

    The paths and the truth, with the reference point of every vertex.
    """
    tree = synthetic.brains(n, n_vertices)
    return synthetic.write(tree, folder), tree["truth"]


def files_of_collection(n, n_vertices, folder):
    """The paths alone."""
    return collection(n, n_vertices, folder)[0]


def stages(folder):
    """The table of stages."""
    say(
        f"\nStages: shapes of {VERTICES:,} vertices; the network has {NETWORK} shapes, all pairs\n"
        f"\n{HEAD}"
    )
    paths, _ = collection(2, VERTICES, folder / "two")

    mesh, _ = beside(
        "read and clean",
        ("s4a.read_shape", our_read, paths[0]),
        ("pymeshlab", other_read, paths[0]),
    )
    X, T = as_arrays(mesh)
    beside(
        "triangles that pass through others",
        ("s4a: exact, libigl", our_crossing, X, T),
        ("pymeshlab", other_crossing, X, T),
    )
    coarse, *_ = beside(
        "remesh to 6,000 with U",
        ("s4a.coarsen", our_remesh, mesh),
        ("pymeshlab quadric + igl", other_quadric, str(paths[0]), X),
        ("pymeshlab isotropic + igl", other_isotropic, str(paths[0]), X),
    )
    V, F = as_arrays(coarse)
    spectra = beside(
        f"{K} eigenpairs at 6,000",
        ("s4a.spectrum", our_spectrum, coarse),
        ("pyFM TriMesh.process", other_spectrum, V, F),
    )
    gap = np.abs(spectra[0]["eigenvalue"].values / coarse["vertex_area"].sum().item() - spectra[1])[
        1:
    ]
    say(f"{'':36} largest difference of eigenvalues {(gap / spectra[1][1:]).max():.1e}")
    beside(
        f"{K} eigenpairs at {VERTICES:,}",
        ("s4a: coarsen + spectrum", our_both, mesh),
        ("pyFM TriMesh.process", other_spectrum, *as_arrays(mesh)),
    )

    second = s4a.read_shape(paths[1])
    shapes = [Shape(mesh, spectra[0]), Shape(second, s4a.spectrum(s4a.coarsen(second), k=K))]
    a, b = (shape.low for shape in shapes)
    meshes = [(a.X, a.T), (b.X, b.T)]
    (R, t, _), _ = beside(
        "align, any start",
        ("s4a.geometry.align", align, a.cloud, b.cloud),
        ("pymeshlab ICP, one start", other_icp, *meshes),
    )
    few = [(end.X, end.T, end.Phi, end.eigenvalue) for end in (a, b)]
    landmark = farthest_points(a.X @ R.T + t, 10)
    near = nearest_rows(a.X[landmark] @ R.T + t, b.X)
    C, _ = beside(
        f"initial map, k = {K_INIT}",
        ("s4a: dense, one round more", our_first_map, a, b, (R, t)),
        ("pyFM fit, WKS + 10 landmarks", other_first_map, *few, np.c_[landmark, near]),
    )
    C, _ = beside(
        f"ZoomOut {K_INIT} -> {K}, step 5",
        ("s4a.method.fmap.zoomout", our_zoomout, C, a, b),
        ("pyFM zoomout_refine", other_zoomout, C, a, b),
    )
    Q = (shapes[1].U @ b.Phi).astype(np.float32)
    D = (shapes[0].U @ (a.Phi @ C.T)).astype(np.float32)
    ours, *found = beside(
        f"nearest neighbours, {len(Q):,}, {K} dims",
        ("s4a.nearest_in_cells", our_nearest, Q, D, shapes[1].cell, shapes[0].cell),
        ("scipy KD-tree", scipy_nearest, Q, D),
        ("scikit-learn brute", sklearn_nearest, Q, D),
        ("pyFM knn_query", other_nearest, Q, D),
    )
    gaps = [np.linalg.norm(Q.astype(float) - D[i], axis=1) for i in (ours, found[0])]
    say(f"{'':36} our distances exceed the KD-tree's by at most {(gaps[0] - gaps[1]).max():.1e}")

    network_table()
    d, area = (
        np.random.default_rng(0).normal(size=(51, VERTICES, 3)),
        np.full(VERTICES, 1 / VERTICES),
    )
    beside(
        f"PCA of 51 displacements, {VERTICES:,}",
        ("s4a.method.pca.gram_pca", our_modes, d, area),
        ("scikit-learn PCA", other_modes, d, area),
    )


def network_table():
    """Consistent ZoomOut of a complete network.

    With the error of the matches that its basis gives.
    """
    tree = synthetic.brains(NETWORK, 20_000)
    names = list(tree["original"].children)
    meshes = [tree["original"][n].to_dataset() for n in names]
    shapes = [Shape(m, s4a.spectrum(s4a.coarsen(m), k=K)) for m in meshes]
    low = [shape.low for shape in shapes]
    source, target = np.array(list(itertools.permutations(range(NETWORK), 2))).T
    first = [
        map_after_alignment(
            low[i],
            low[j],
            align(low[i].cloud, low[j].cloud)[:2],
            k_init=K_INIT,
        ).C
        for i, j in zip(source, target, strict=True)
    ]
    given = np.stack(first), source, target
    bases = beside(
        f"Consistent ZoomOut, {len(first)} maps",
        ("s4a.method.latent.consistent_zoomout", our_network, *given, low),
        (
            "pyFM FMN.zoomout_refine",
            other_network,
            *given,
            [(basis.X, basis.T, basis.Phi, basis.eigenvalue) for basis in low],
        ),
    )
    here = [
        cKDTree(m["position"]).query(s.coarse["position"])[1]
        for m, s in zip(meshes, shapes, strict=True)
    ]
    for name, Y in zip(("s4a", "pyFM"), bases, strict=True):
        F = [basis.Phi[:, :K] @ y for basis, y in zip(low, Y, strict=True)]
        gaps = []
        for i in range(1, NETWORK):
            match = nearest_rows(F[0], F[i])
            u = tree[f"truth/{names[0]}/reference_point"].values[here[0]]
            image = shapes[i].coarse["position"].values[match]
            gaps.append(
                error(synthetic.position(tree["truth"], names[i], u), image, shapes[0].frame[1])
            )
        say(
            f"{'':36} {name}: low-resolution matches {np.mean(gaps):.2f} % of sqrt(area) from the "
            "truth"
        )


def error(true, found, size):
    """Mean distance in % of sqrt(area)."""
    return 100 * np.linalg.norm(true - found, axis=1).mean() / size


def our_pipeline(paths, folder, refine, template):
    s4a.analyse(paths, store=folder, n_jobs=1, refine=refine, template=template)
    tree = s4a.open_study(folder)
    data = tree["registration"].to_dataset()
    return {n: data["registered_match"].sel(shape=n).values for n in data["shape"].values.tolist()}


def other_pipeline(paths, template):
    """The same steps put together from pymeshlab, igl, pyFM and their nearest neighbours."""
    shapes = {}
    for path in paths:
        found = meshlab(path)
        X = found.current_mesh().vertex_matrix()
        index, weights = other_quadric(path, X)
        found.meshing_decimation_quadric_edge_collapse(targetfacenum=12_000)
        mesh = trimesh(
            found.current_mesh().vertex_matrix(),
            found.current_mesh().face_matrix().astype(np.int64),
        )
        shapes[Path(path).stem] = (X, index, weights, mesh.process(k=K, verbose=False))
    names = list(shapes)
    moved = {n: shapes[n][3].vertices for n in names}
    for n in names:
        if n != template:
            M = other_icp(
                (moved[n], shapes[n][3].faces), (moved[template], shapes[template][3].faces)
            )
            moved[n] = moved[n] @ M[:3, :3].T + M[:3, 3]
    from pyFM.FMN import FMN
    from pyFM.functional import FunctionalMapping

    maps = {}
    for i, j in itertools.permutations(range(len(names)), 2):
        a, b = names[i], names[j]
        landmark = farthest_points(moved[a], 10)
        model = FunctionalMapping(shapes[a][3], shapes[b][3])
        landmarks = np.c_[landmark, nearest_rows(moved[a][landmark], moved[b])]
        model.preprocess(n_descr=100, landmarks=landmarks, subsample_step=5, k_process=K, k_descr=K)
        model.fit(K=(K_INIT, K_INIT))
        maps[i, j] = model.FM_12
    found = FMN([shapes[n][3] for n in names], maps)
    found.zoomout_refine(
        nit=(K - K_INIT) // 5, step=5, subsample=1000, isometric=True, cclb_ratio=1, n_jobs=1
    )
    found.compute_W()
    found.compute_CLB()
    found.compute_CCLB(K, verbose=False)
    dense = {}
    for n, Y in zip(names, found.CCLB, strict=True):
        _, index, weights, mesh = shapes[n]
        F = mesh.eigenvectors[:, :K] @ Y
        dense[n] = np.einsum("nc,ncd->nd", weights, F[mesh.faces[index]])
    return {n: other_nearest(dense[template], dense[n]) for n in names if n != template}


def pipelines(folder, n=6, n_vertices=50_000):
    """The whole pipeline, ours and the one from pyFM, with errors against the truth."""
    say(
        f"\nPipelines: {n} shapes of {n_vertices:,} vertices, all pairs, "
        f"the first is the template\n\n{HEAD}"
    )
    paths, truth = collection(n, n_vertices, folder / "files")
    paths, template = [str(p) for p in paths], Path(paths[0]).stem
    names = ("s4a, refine='elastic'", "s4a, refine='intrinsic'", "pymeshlab + igl + pyFM")
    found = beside(
        "files -> dense matches",
        (names[0], our_pipeline, paths, folder / "elastic", "elastic", template),
        (names[1], our_pipeline, paths, folder / "intrinsic", "intrinsic", template),
        (names[2], other_pipeline, paths, template),
    )
    X = {Path(p).stem: s4a.read_mesh(p)[0] for p in paths}
    T = s4a.read_mesh(paths[0])[1]
    size = np.sqrt(triangle_areas(X[template], T).sum())
    u = truth[f"{template}/reference_point"].values
    for name, match in zip(names, found, strict=True):
        gaps = [
            error(synthetic.position(truth, s, u), X[s][m], size)
            for s, m in match.items()
            if s != template
        ]
        say(
            f"{'':36} {name}: {np.mean(gaps):.2f} % of sqrt(area) from the truth, "
            f"worst shape {np.max(gaps):.2f}"
        )


def stage_seconds(folder, n, n_vertices, n_pairs):
    paths, _ = collection(n, n_vertices, folder / "files")
    s4a.analyse(paths, store=folder / "study", n_jobs=1, n_pairs=n_pairs)
    report = s4a.open_study(folder / "study")["report"]
    return dict(
        zip(report["stage"].values.tolist(), report["seconds"].values.tolist(), strict=True)
    )


def growth(folder):
    """How the seconds of every stage grow.

    The exponent is the slope of log seconds over log size.
    """
    for what, sizes in (
        ("vertices", [(4, v, 500) for v in (25_000, 50_000, 100_000)]),
        ("shapes", [(n, 10_000, 4 * n) for n in (8, 16, 32)]),
    ):
        say(f"\n{what} x1 x2 x4 (shapes, vertices, pairs): {sizes}; seconds with one process\n")
        found = [
            measured(stage_seconds, folder / what / str(i), *size)[0]
            for i, size in enumerate(sizes)
        ]
        for stage in found[0]:
            seconds = np.array([max(f[stage], 1e-3) for f in found])
            slope = np.polyfit(np.log([1, 2, 4]), np.log(seconds), 1)[0]
            say(f"{stage:36} {'  '.join(f'{t:8.2f}' for t in seconds)}   exponent {slope:5.2f}")


def seconds_of_pairs(coarse, n_pairs, options):
    """CPU seconds of the stages that look at pairs, on low-resolution meshes that are there."""
    begin = time.process_time()
    first = s4a.build_network(coarse, n_pairs=n_pairs, **options.of("initial maps"))
    between = time.process_time()
    names = ("weights", "n_samples", "dense_iterations")
    s4a.refine_network(coarse, first, k=K, **{name: getattr(options, name) for name in names})
    return {
        "alignment and initial maps": between - begin,
        "Consistent ZoomOut and median": time.process_time() - between,
    }


def pairs(folder, n=12, n_coarse=2000):
    """How CPU seconds grow with the pairs (5.3: linearly), by default and as in the paper."""
    paths, _ = collection(n, 5_000, folder / "files")
    coarse = {
        Path(path).stem: s4a.spectrum(s4a.coarsen(s4a.read_shape(path), n_coarse=n_coarse), k=K)
        for path in paths
    }
    sizes = (15, 30, 60)
    for preset in (None, "paper"):
        say(
            f"\n{n} shapes, {n_coarse:,} vertices at low resolution, {sizes} pairs, "
            f"preset {preset}: CPU seconds\n"
        )
        options = Options(preset=preset)
        found = [measured(seconds_of_pairs, coarse, p, options)[0] for p in sizes]
        for stage in found[0]:
            seconds = np.array([f[stage] for f in found])
            slope = np.polyfit(np.log(sizes), np.log(seconds), 1)[0]
            more = np.polyfit(sizes, seconds, 1)[0]
            say(
                f"{stage:36} {'  '.join(f'{t:8.2f}' for t in seconds)}   exponent {slope:5.2f}, "
                f"{more:.3f} a pair more"
            )


def analysed(paths, store, method, preset):
    s4a.analyse(paths, store=store, n_jobs=1, method=method, preset=preset).close()


def one_numbering(study):
    """The true image of the template's vertices on a shape: vertex i of the file is vertex i."""

    def image(shape, template):
        became = study["original"][shape]["vertex_of_file"].values
        vertex = became[study["original"][template]["file_vertex"].values]
        X = study["original"][shape]["position"].values[vertex]
        return np.where(vertex[:, None] >= 0, X, np.nan)

    return image


def simulated(study, truth):
    """The true image of the template's vertices on a synthetic brain."""

    def image(shape, template):
        row = study["original"][template]["file_vertex"].values
        return synthetic.position(truth, shape, truth[template]["reference_point"].values[row])

    return image


def methods(folder, *sets, n=10):
    """A whole study by RE-MATCH and by SCALABLE, by default and as in the paper.

    Errors are in % of sqrt(area): where the truth is known, as of faces whose vertex i is vertex i,
    the mean distance of matches and of the registered surface from it; Chamfer (eq. 9) of the shape
    and the image of the template.
    """
    for name in sets or ("brains", "faces", "heads"):
        truth = None
        if name == "brains":  # synthetic ones, each with vertices of its own
            paths, truth = collection(n, 20_000, folder / name)
        else:
            subprocess.run(
                [sys.executable, DATA / "unpack.py", folder, name],
                check=True,
                stdout=subprocess.DEVNULL,
            )
        paths = [str(path) for path in sorted((folder / name).glob("*.ply"))[:n]]
        say(f"\nA study of {len(paths)} {name}, one process\n")
        say(
            f"{'preset':8} {'method':10} {'CPU s':>7} {'MiB':>6} {'disk':>6} {'match %':>8} "
            f"{'surface %':>9} {'Chamfer %':>9} {'trip %':>7}  median, variance of three modes"
        )
        for preset, method in itertools.product((None, "paper"), ("rematch", "scalable")):
            out = folder / f"{name}_{preset}_{method}"
            _, cpu, _, memory = measured(analysed, paths, out, method, preset)
            disk = sum(path.stat().st_size for path in out.rglob("*.nc")) / 2**20
            with s4a.open_study(out) as study:
                image = {"faces": one_numbering(study), "brains": simulated(study, truth)}.get(name)
                widths = zip(study_errors(study, image), (8, 9, 9, 7), strict=True)
                errors = [f"{error:>{width}}" for error, width in widths]
                ratio = study["pca"]["explained_variance_ratio"].values[:3].sum()
                say(
                    f"{preset or 'none':8} {method:10} {cpu:7.0f} {memory:6.0f} {disk:6.0f} "
                    f"{' '.join(errors)}  {study['latent'].attrs['median']}, {100 * ratio:.1f} %"
                )


def study_errors(study, image):
    """Errors of the matches and of the surfaces, Chamfer distance, round trip, as texts."""
    data = study["registration"].to_dataset()
    template = data.attrs["template"]
    chamfer = []
    for shape in set(data["shape"].values.tolist()) - {template}:
        end = Shape(study["original"][shape].to_dataset())
        X = end.to_frame(end.original["position"].values)
        match = data["registered_match"].sel(shape=shape).values
        chamfer.append(metrics.chamfer(X, X[match]))
    far = ["", ""]
    if image is not None:
        error = accuracy.accuracy(study, image)["error"].mean("shape")
        far = [
            f"{100 * error.sel(algorithm=way):.3f}" for way in (accuracy.MATCH, accuracy.SURFACE)
        ]
    trip = data["round_trip"].values.mean(1).sum() / (data.sizes["shape"] - 1)
    return [*far, f"{100 * np.mean(chamfer):.4f}", f"{100 * trip:.3f}"]


def certificates(folder, n_checked=1000):
    """The dense search of eq. 4 on two shapes of every real collection.

    What the bound leaves to compare.
    """
    if not DATA.is_dir():
        return
    say(
        f"\nNearest neighbours on real shapes: {K} dims, first shape -> second; "
        f"{n_checked} checked in float64\n"
    )
    subprocess.run(
        [sys.executable, DATA / "unpack.py", folder], check=True, stdout=subprocess.DEVNULL
    )
    for one in sorted(p for p in folder.iterdir() if p.is_dir()):
        files = [file for file, _ in find_meshes(one)][:2]
        if len(files) < 2:
            continue
        meshes = [s4a.read_shape(file) for file in files]
        M, N = (Shape(mesh, s4a.spectrum(s4a.coarsen(mesh), k=K)) for mesh in meshes)
        transform = align(M.low.cloud, N.low.cloud)[:2]
        C = map_after_alignment(M.low, N.low, transform, k_init=K_INIT).C
        C = fmap.zoomout(M.low, N.low, C, min(K, M.low.k, N.low.k))[0]
        F = M.low.Phi[:, : C.shape[1]] @ C.T, N.low.Phi[:, : C.shape[0]]
        begin = time.process_time()
        index, compared, certified = match_functions(M, N, *F)
        seconds = time.process_time() - begin
        D, some = M.U @ F[0], np.linspace(0, len(index) - 1, n_checked).astype(int)
        gap = np.linalg.norm(N.U[some] @ F[1] - D[index[some]], axis=1)
        least = cKDTree(D).query(N.U[some] @ F[1])[0]
        say(
            f"{one.name:10} {len(D):8,} x {len(index):8,}  {seconds:6.2f} s  "
            f"compared {100 * compared:6.3f} %  "
            f"certified at once {100 * certified:6.2f} %  farther than the nearest by at most "
            f"{(gap - least).max():.1e}"
        )


def whole(folder, n=51, n_vertices=VERTICES):
    """One collection on all cores: the table of stages of the report.

    Another process makes the files, so that its memory is none of the analysis.
    """
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        paths = pool.submit(files_of_collection, n, n_vertices, folder / "files").result()
    begin = time.perf_counter()
    s4a.analyse(paths, store=folder / "study", n_jobs=-1)
    wall = time.perf_counter() - begin
    report = s4a.open_study(folder / "study")["report"]
    say(
        f"\n{n} shapes of {n_vertices:,} vertices, "
        f"all defaults: {wall:.0f} s on {os.cpu_count()} cores\n"
    )
    for stage, seconds, memory in zip(
        *(report[v].values for v in ("stage", "seconds", "peak_memory")), strict=True
    ):
        say(f"{stage:36} {seconds:8.1f} s {memory:8.0f} MiB")


BEFORE = "4b9c593"  # the version of 22 November 2026
# the analysis of one version in a process of its own: its stages, and where the template's vertices
# are on every shape
ONE_VERSION = """
import json, sys, time
import numpy as np
import s4a
paths, store, images, most = json.loads(sys.argv[1])
begin = time.perf_counter()
s4a.analyse(paths, store=store, n_jobs=-1)
wall = time.perf_counter() - begin
study = s4a.open_study(store)
report, found = (study[node].to_dataset() for node in ("report", "registration"))
template = study["latent"].attrs["median"]
X = study["original"][template]["position"].values
some = np.linspace(0, len(X) - 1, most).astype(int)
image = {}
for name in found["shape"].values.tolist():
    one = found.sel(shape=name)
    moved = X[some] + one["displacement"].values[some] - one["translation"].values
    image[name] = moved @ one["rotation"].values / one["scale"].item()
np.savez(images, some=some, **image)
columns = (report[name].values.tolist() for name in ("stage", "seconds", "peak_memory"))
areas = {name: float(mesh.attrs["area"]) for name, mesh in study["original"].children.items()}
print(json.dumps({"wall": wall, "template": template, "area": areas, "stages": [*zip(*columns)]}))
"""


def versions(folder, n=51, n_vertices=VERTICES, times=3, revision=BEFORE):
    """One collection as an older version of the repository analyses it and as this one, in turn.

    Stages, memory, and the mean distance of the registered surfaces from the truth, of 2,000
    vertices of the template.  The older version runs with the packages that are installed now.
    """
    root = Path(__file__).parents[1]
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        paths, truth = pool.submit(collection, n, n_vertices, folder / "files").result()
    old = folder / "old"
    git = ["git", "-C", root, "worktree"]
    subprocess.run([*git, "add", "--detach", old, revision], check=True, capture_output=True)
    runs = {f"at {revision}": [], "here": []}
    try:
        for i in range(times):
            for (name, found), tree in zip(runs.items(), (old, root), strict=True):
                study, images = folder / f"{i}_{tree.name}", folder / "images.npz"
                given = json.dumps([[str(path) for path in paths], str(study), str(images), 2000])
                end = subprocess.run(
                    [sys.executable, "-c", ONE_VERSION, given],
                    env=os.environ | {"PYTHONPATH": str(tree)},
                    cwd=tree,
                    check=True,
                    stdout=subprocess.PIPE,
                    text=True,
                )
                one = json.loads(end.stdout.splitlines()[-1])
                one["error"] = error_of(images, one["template"], one["area"], truth)
                found.append(one)
                say(f"{name}: {one['wall']:.0f} s, error {one['error']:.3f} %")
                shutil.rmtree(study)
    finally:
        subprocess.run([*git, "remove", "--force", old], check=True)
    say(
        f"\n{n} shapes of {n_vertices:,} vertices, all defaults, on {os.cpu_count()} cores; "
        f"seconds of {times} runs in turn, and the largest memory\n"
    )
    for name, found in runs.items():
        say(f"{name}\n")
        rows = [*zip(*(one["stages"] for one in found), strict=True)]
        for row in rows:
            seconds = " ".join(f"{spent:8.1f}" for _, spent, _ in row)
            say(f"{row[0][0]:36} {seconds} s {max(peak for *_, peak in row):8.0f} MiB")
        seconds = " ".join(f"{one['wall']:8.1f}" for one in found)
        errors = " ".join(f"{one['error']:8.3f}" for one in found)
        say(f"{'whole':36} {seconds} s\n{'error of the surfaces':36} {errors} %\n")


def error_of(images, template, area, truth):
    """Mean distance to the truth of vertices of the template on all shapes, % of sqrt(area)."""
    with np.load(images) as arrays:
        at = truth[template]["reference_point"].values[arrays["some"]]
        names = [name for name in arrays.files if name not in ("some", template)]
        gaps = [
            np.linalg.norm(arrays[name] - synthetic.position(truth, name, at), axis=1).mean()
            for name in names
        ]
    return 100 * float(np.mean(gaps / np.sqrt([area[name] for name in names])))


def divided(u, T):
    """Points of the unit sphere and triangles, each divided into four."""
    E, edge_of, _ = unique_edges(T)
    a, b, c = T.T
    ab, bc, ca = (len(u) + edge_of).reshape(3, -1)  # numbers of the midpoints
    T = np.concatenate(
        [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    middle = u[E].sum(1)
    return np.concatenate([u, middle / np.linalg.norm(middle, axis=1, keepdims=True)]), T


def write_brains(n, n_vertices, folder):
    """Synthetic brains of about so many vertices as PLY and, of two, in memory with the truth.

    Triangles of 16 times fewer vertices are divided twice; all vertices are on the exact surface.
    """
    tree = synthetic.brains(n, n_vertices // 16 + 2)
    meshes = []
    for name, mesh in tree["original"].children.items():
        u, T = tree["truth"][name]["reference_point"].values, mesh["corner_vertex"].values
        for _ in range(2):
            u, T = divided(u, T)
        X = synthetic.position(tree["truth"], name, u)
        s4a.write_mesh(folder / f"{name}.ply", X, T)
        meshes.append(as_dataset(X, T))
    if n == 2:
        pair = *meshes, synthetic.position(tree["truth"], "brain_01", u)
        (folder / "pair").write_bytes(pickle.dumps(pair))
    return len(u)


def checked(folder):
    """Read, clean and examine two files, as ``s4a check`` does."""
    s4a.read_shapes(folder)


def remeshed(path):
    """Low resolution and spectrum of the first mesh of a pair."""
    s4a.spectrum(s4a.coarsen(pickle.loads(path.read_bytes())[0]))


def matched_pair(path, n_jobs=1):
    """Match the pair of a file; return the mean error of the surface in % of sqrt(area)."""
    source, target, true = pickle.loads(path.read_bytes())
    found = s4a.match_pair(source, target, n_jobs=n_jobs)
    moved = target["position"].values + found["displacement"].values - found["translation"].values
    gap = np.linalg.norm(moved @ found["rotation"].values / found["scale"].item() - true, axis=1)
    return 100 * gap.mean() / np.sqrt(triangle_areas(*as_arrays(source)).sum())


def sizes(folder, *numbers):
    """CPU seconds and memory by the vertices of a mesh, from the file to the match of a pair.

    A file is read and cleaned; two are read, cleaned and examined (`s4a check`); a mesh in memory
    is remeshed, with its spectrum; two in memory are matched, and again in two threads.
    """
    parts = ("read", "check two", "remesh", "match two")
    say(
        "\n| vertices |"
        + "".join(f" {part}, CPU s | MiB |" for part in parts)
        + " wall s | two threads, wall s | error, % |"
    )
    say("|" + " --- |" * 12)
    for n in numbers or (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_500_000):
        files = folder / str(n)
        files.mkdir()
        count, *_ = measured(write_brains, 2, n, files)  # in a process of its own
        rows = [
            measured(our_read, files / "brain_01.ply"),
            measured(checked, files),
            measured(remeshed, files / "pair"),
            measured(matched_pair, files / "pair"),
        ]
        spent = "".join(f" {cpu:.1f} | {memory:.0f} |" for _, cpu, _, memory in rows)
        error, _, wall, _ = rows[-1]
        threads = measured(matched_pair, files / "pair", 2)[2]
        say(f"| {count:,} |{spent} {wall:.1f} | {threads:.1f} | {error:.3f} |")
        shutil.rmtree(files)


def million(folder, n=10, n_vertices=1_000_000):
    """A study of large shapes on two processes: stages, and memory of all processes together."""
    measured(write_brains, n, n_vertices, folder)
    sys.path.insert(0, str(Path(__file__).parent))
    from large import Watch

    command = [sys.executable, "-m", "s4a", "run", folder, "--out", folder / "study"]
    begin, watch = time.perf_counter(), Watch()
    run = subprocess.Popen(
        [*map(str, command), "--n-jobs", "2"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while run.poll() is None:
        watch.look(psutil.Process(run.pid), "run")
        time.sleep(0.2)
    wall, spent = time.perf_counter() - begin, watch.stages["run"]
    assert run.returncode == 0, f"exit {run.returncode}"
    say(f"\n{n} shapes of {n_vertices:,} vertices, all defaults, two processes")
    say(f"{wall:.0f} s, {spent['cpu']:.0f} CPU s, at most {spent['memory']:.0f} MiB together\n")
    report = s4a.open_study(folder / "study")["report"]
    for stage, seconds, memory in zip(
        *(report[v].values for v in ("stage", "seconds", "peak_memory")), strict=True
    ):
        say(f"{stage:36} {seconds:8.1f} s {memory:8.0f} MiB")


def cpu_of(function, times=20):
    """Milliseconds of CPU of a call, the least of five."""
    spent = []
    for _ in range(5):
        begin = time.process_time()
        for _ in range(times):
            function()
        spent.append(1000 * (time.process_time() - begin) / times)
    return min(spent)


def write(folder):
    """Every file of a study of six brains of 3,000 vertices, as s4a and as xarray write it."""
    s4a.analyse(synthetic.brains(6, 3000), store=folder, n_coarse=800, n_jobs=1)
    paths = sorted(folder.rglob("*.nc"))
    files = [netcdf.read(path).load().drop_encoding() for path in paths]
    n = sum(len(data.variables) for data in files)
    say(f"{len(files)} files of {n} variables, CPU ms a variable")
    for name, write_one in (
        ("s4a.study.netcdf", lambda data: write_netcdf(data, io.BytesIO())),
        ("xarray with h5netcdf", lambda data: data.to_netcdf(io.BytesIO(), engine="h5netcdf")),
    ):
        spent = cpu_of(lambda write_one=write_one: [write_one(data) for data in files], 5)
        say(f"{name:28} {spent / n:8.2f}")


PARTS = {
    "write": write,
    "stages": stages,
    "pipelines": pipelines,
    "growth": growth,
    "pairs": pairs,
    "nearest": certificates,
    "methods": methods,
    "whole": whole,
    "versions": versions,
    "sizes": sizes,
    "million": million,
}

if __name__ == "__main__":
    part, *words = sys.argv[1:] or [""]
    for run in [PARTS[part]] if part else [stages, pipelines, growth, pairs, certificates]:
        with tempfile.TemporaryDirectory() as folder:
            run(Path(folder), *(int(word) if word.isdecimal() else word for word in words))
