"""What correspondences are good for.

``applications.py [ellipsoids groups variance brains skulls faces heads template points
sources parcels volumes]``.

A one-mode family against the closed form, simulated groups, the variance explained at both
resolutions (Fig. 5), transfer between two brain templates and between skulls, displacements and
modes of faces against the published ones, a tenth head inserted into a study of nine, labels and
landmarks of a template that is none of the collection (Fig. 6 and 7), landmarks of several skulls
averaged, 35 regions on remeshed
faces, bodies and cats by how far votes count, and 80 label volumes of hippocampi, from the files
to modes by one command, whole and as two structures.  What is not synthetic needs the shared data
beside the checkout.
"""

import itertools
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr
from peers import remeshed
from scipy import stats
from scipy.integrate import quad
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

import s4a
import s4a_morphometrics
from s4a import metrics, statistics, synthetic
from s4a.analysis import permutation
from s4a.geometry.align import align, cloud, farthest_points
from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, edge_graph, edges, vertex_areas
from s4a.input.annotations import labels_of_mesh, read_landmarks
from s4a.method.deform import displacement_in_template
from s4a.method.pca import project_scores
from s4a.schema import dataset

DATA = Path(__file__).parents[2] / "shared" / "data"


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def icp_motion(source, target):
    """R, t of ICP on up to 6,000 samples, in the unit of the input."""
    low = []
    for mesh in (source, target):
        X, T = as_arrays(mesh)
        every = slice(None, None, max(1, len(X) // 6000))
        low.append(cloud(X[every], vertex_areas(X, T)[every], 500))
    return align(*low)[:2]


def variance(folder=None):
    """Fig. 5: variance explained by the first components at both resolutions, equally smooth."""
    collections = {"12 synthetic brains": synthetic.brains(12, 20_000)}
    if folder is not None:
        collections["25 faces"] = folder / "faces"
    for what, shapes in collections.items():
        for preset in ("paper", None):
            study = s4a.analyse(shapes, preset=preset, n_jobs=-1)
            for resolution, ratio in (
                (
                    "high, eq. 7" if preset else "high, elastic iterations",
                    "explained_variance_ratio",
                ),
                ("low, eq. 6, as smooth", "explained_variance_ratio_low"),
                ("low, eq. 6, as it is", "explained_variance_ratio_raw"),
            ):
                share = 100 * np.cumsum(study["pca"][ratio].values)
                row = ", ".join(f"{share[c - 1]:.1f} % by {c}" for c in (1, 3, 5, 10))
                say(f"{what}, preset {preset}, {resolution}: {row}")


def brains(folder):
    names, meshes, labels = {"fsa5": "fsa5_lh", "conte69": "conte69_32k_lh"}, {}, {}
    for name, file in names.items():
        meshes[name] = s4a.read_shape(folder / "brains" / f"{file}.gii")
        with np.load(folder / "brains" / f"labels_{name}_lh_then_rh.npz") as arrays:
            labels[name] = arrays["aparc"][: meshes[name].sizes["vertex"]]
    (X, _), (Y, _), true = *(as_arrays(m) for m in meshes.values()), labels["conte69"]
    R, t = icp_motion(*meshes.values())
    found = {
        "nearest vertex as they lie": labels["fsa5"][cKDTree(X).query(Y)[1]],
        "nearest vertex after ICP": labels["fsa5"][cKDTree(X @ R.T + t).query(Y)[1]],
    }
    for both in (False, True):
        study = s4a.register_pairs(
            meshes["fsa5"], {"conte69": meshes["conte69"]}, bidirectional=both
        )
        name = "S4A, matched both ways" if both else "S4A, one way"
        found[name] = s4a.transfer_labels(study, labels["fsa5"])["conte69"]["label"].values
    for name, label in found.items():
        dice = [
            2 * ((label == v) & (true == v)).sum() / ((label == v).sum() + (true == v).sum())
            for v in np.unique(true)
        ]
        say(
            f"{name}: {100 * (label == true).mean():.1f} % of vertices right, "
            f"mean Dice {np.mean(dice):.3f}"
        )


def skulls(folder):
    files = sorted((folder / "skulls").glob("*.ply"))
    meshes = {f.stem: s4a.read_shape(f) for f in files}
    marks = {f.stem: read_landmarks(f.with_suffix(".mrk.json")) for f in files}
    point = {name: m["landmark_position"].values for name, m in marks.items()}
    error = {"nearest surface point after ICP": [], "S4A": []}
    for a, b in itertools.combinations(meshes, 2):
        study = s4a.register_pairs(meshes[a], {b: meshes[b]}, name=a)
        for p, q in ((a, b), (b, a)):
            R, t = icp_motion(meshes[p], meshes[q])
            X, T = as_arrays(meshes[q])
            near = interpolate(X, T, *closest_point(point[p] @ R.T + t, X, T))
            ours = s4a.transfer_landmarks(study, marks[p], source=p, targets=[q])[q][
                "landmark_position"
            ].values
            for name, found in zip(error, (near, ours), strict=True):
                error[name].append(np.linalg.norm(found - point[q], axis=1))
    for name, values in error.items():
        values = np.stack(values)
        say(
            f"{name}: mean {values.mean():.3f} mm, median {np.median(values):.3f}, "
            f"{values.shape[0]} ordered pairs"
        )


def faces(folder):
    study = s4a.analyse(folder / "faces", n_jobs=-1, template="generic_neutral_mesh")
    data = study["registration"].to_dataset()
    X, T = as_arrays(data)
    area = vertex_areas(X, T)
    w = area / area.sum()
    names = [n for n in data["shape"].values.tolist() if n != "generic_neutral_mesh"]
    ours = data["displacement"].sel(shape=names).values.astype(float)
    true = np.stack(
        [
            displacement_in_template(X, study["original"][n]["position"].values, area)[0]
            for n in names
        ]
    )
    inner = [np.einsum("nx,nx,n->", a, b, w) for a, b in zip(ours, true, strict=True)]
    size = [np.sqrt(np.einsum("nx,nx,n->", d, d, w)) for d in (*ours, *true)]
    cosine = np.array(inner) / size[: len(names)] / size[len(names) :]
    say(
        f"cosines of displacements: mean {cosine.mean():.4f}, median {np.median(cosine):.4f}, "
        f"least {cosine.min():.4f}"
    )
    for c in (3, 5, 10):
        bases = []
        for d in (ours, true):
            d = ((d - d.mean(0)) * np.sqrt(w)[:, None]).reshape(len(d), -1)
            bases.append(np.linalg.svd(d, full_matrices=False)[2][:c])
        angle = np.degrees(
            np.arccos(np.clip(np.linalg.svd(bases[0] @ bases[1].T, compute_uv=False), 0, 1))
        )
        say(f"principal angles of {c} modes, degrees: {', '.join(f'{a:.1f}' for a in angle)}")


def heads(folder):
    files = sorted((folder / "heads").glob("*.ply"))
    nine = s4a.analyse(files[:-1], n_jobs=-1)
    begin = time.process_time()
    found = s4a.insert(nine, files[-1])
    seconds = time.process_time() - begin
    ten = s4a.analyse(files, n_jobs=-1, template=nine["registration"].attrs["template"])
    area = vertex_areas(*as_arrays(nine["registration"].to_dataset()))

    def gap(a, b):
        distance = np.linalg.norm(a - b, axis=-1)
        return f"mean {area @ distance / area.sum():.2f} mm, median {np.median(distance):.2f}"

    d, before = (tree["registration"]["displacement"] for tree in (ten, nine))
    name, new = files[-1].stem, found["registration"]["displacement"][0].values
    n = found["original"][name].sizes["vertex"]
    say(
        f"{n} vertices inserted in {seconds:.1f} s of CPU; "
        f"to the recomputation {gap(new, d.sel(shape=name).values)}"
    )
    sure, trip, stretch = (
        found["registration"][v].values for v in ("confidence", "round_trip", "distortion")
    )
    say(
        f"confidence {sure.mean():.2f}, round trip {trip.mean():.4f}, "
        f"median |distortion| {np.median(abs(stretch)):.3f}"
    )
    modes = [
        nine["pca"][v].values for v in ("mean_displacement", "deformation", "standard_deviation")
    ]
    again = project_scores(d.sel(shape=[name]).values, *modes, area)[0][0]
    say(
        f"scores {found['pca']['score'].values[0].round(2)}, "
        f"from the recomputation {again.round(2)}"
    )
    for other in before["shape"].values.tolist():
        say(f"  {other} in both: {gap(before.sel(shape=other).values, d.sel(shape=other).values)}")


def cortex(X, T, mirror=False):
    """A hemisphere as a clean mesh; a right one mirrored, so that it is like the left ones."""
    if mirror:
        X, T = X * [-1, 1, 1], T[:, ::-1]
    return s4a.clean(as_dataset(X, T, {"unit": "mm"}))


def hemispheres(folder):
    """Left and mirrored right hemispheres: meshes, and labels of the left numbers, by atlas."""
    meshes, labels = {}, {"aparc": {}, "aal": {}}
    for name, file in (("fsa5", "fsa5"), ("conte69", "conte69_32k")):
        with np.load(folder / "brains" / f"labels_{name}_lh_then_rh.npz") as arrays:
            aparc = arrays["aparc"]
        for side, mirror in (("lh", False), ("rh", True)):
            X, T, _ = s4a.read_mesh(folder / "brains" / f"{file}_{side}.gii")
            meshes[f"{name}_{side}"] = cortex(X, T, mirror)
            own = aparc[len(X) :] - 35 * (aparc[len(X) :] > 0) if mirror else aparc[: len(X)]
            labels["aparc"][f"{name}_{side}"] = own
    X, T, _ = s4a.read_mesh(folder / "brains" / "civet.ply")
    aal, n = np.load(folder / "brains" / "civet_labels.npy"), len(X) // 2
    for side, part in (("lh", slice(0, n)), ("rh", slice(n, None))):
        inside = (T >= n).all(axis=1) if side == "rh" else (T < n).all(axis=1)
        meshes[f"civet_{side}"] = cortex(X[part], T[inside] - (part.start), side == "rh")
        labels["aal"][f"civet_{side}"] = aal[part] - (aal[part] > 0) * (side == "rh")
    X, T, _ = s4a.read_mesh(DATA / "brain_individuals" / "pycortex_S1" / "pia_lh.gii")
    meshes["S1_lh"] = cortex(X, T)
    for of_atlas in labels.values():
        for name, label in of_atlas.items():
            of_atlas[name] = labels_of_mesh(label, meshes[name])
    return meshes, labels


def template(folder):
    """Fig. 6: a template with 35 or 39 labels, none of the collection, carried by both ways of 6.2.

    The collection are the other hemispheres; of those that have the same atlas the labels are
    known.
    """
    meshes, labels = hemispheres(folder)
    for name, atlas in (("conte69_lh", "aparc"), ("civet_lh", "aal")):
        others = {other: mesh for other, mesh in meshes.items() if other != name}
        known = [other for other in others if other in labels[atlas]]
        source, label = meshes[name], labels[atlas][name]
        say(
            f"{name}, {source.sizes['vertex']} vertices, {len(np.unique(label)) - 1} labels; "
            f"collection: {', '.join(others)}"
        )
        found = {"nearest vertex after ICP": {}}
        for other in known:
            R, t = icp_motion(source, others[other])
            tree = cKDTree(source["position"].values @ R.T + t)
            near = tree.query(others[other]["position"].values)[1]
            found["nearest vertex after ICP"][other] = label[near]
        for preset in (None, "paper"):
            begin = time.process_time()
            pairs = s4a.register_pairs(
                source, {n: others[n] for n in known}, name=name, preset=preset
            )
            pairwise = s4a.transfer_labels(pairs, label)
            between = time.process_time()
            study = s4a.analyse(others, n_jobs=1, preset=preset)
            made = time.process_time()
            through = s4a.transfer_labels(study, label, source=source, targets=known)
            end = time.process_time()
            median = study["latent"].attrs["median"]
            for way, tree in (("pairwise", pairwise), (f"through {median}", through)):
                found[f"{way}, preset {preset}"] = {n: tree[n]["label"].values for n in known}
            say(
                f"preset {preset}: CPU s pairwise {between - begin:.0f} for {len(known)} shapes, "
                f"the study {made - between:.0f}, through its median {end - made:.0f}"
            )
        for way, carried in found.items():
            rows = []
            for other in known:
                own, area = labels[atlas][other], vertex_areas(*as_arrays(others[other]))
                right = metrics.label_accuracy(carried[other], own, area)
                rows.append(
                    (right, np.mean(list(metrics.dice(carried[other], own, area).values())))
                )
            each = ", ".join(
                f"{n} {100 * right:.1f} %" for n, (right, _) in zip(known, rows, strict=True)
            )
            say(f"  {way}: right on {each}; mean Dice {np.mean(rows, axis=0)[1]:.3f}")


def points(folder):
    """Fig. 7: 51 expert landmarks of a skull that is none of the collection, by both ways of 6.2.

    Each of five skulls in turn is the template of the four others.
    """
    files = sorted((folder / "skulls").glob("*.ply"))
    meshes = {f.stem: s4a.read_shape(f) for f in files}
    marks = {f.stem: read_landmarks(f.with_suffix(".mrk.json")) for f in files}
    error = {"nearest surface point after ICP": [], "pairwise": [], "through the median": []}
    for name, source in meshes.items():
        others = {other: mesh for other, mesh in meshes.items() if other != name}
        study = s4a.analyse(others, n_jobs=1)
        pairs = s4a.register_pairs(source, others, name=name)
        ways = {
            "pairwise": s4a.transfer_landmarks(pairs, marks[name]),
            "through the median": s4a.transfer_landmarks(study, marks[name], source=source),
        }
        for other, mesh in others.items():
            true = marks[other]["landmark_position"].values
            R, t = icp_motion(source, mesh)
            X, T = as_arrays(mesh)
            moved = marks[name]["landmark_position"].values @ R.T + t
            found = {
                "nearest surface point after ICP": interpolate(X, T, *closest_point(moved, X, T))
            }
            found |= {way: tree[other]["landmark_position"].values for way, tree in ways.items()}
            for way, places in found.items():
                error[way].append(np.linalg.norm(places - true, axis=1))
    for way, values in error.items():
        values = np.stack(values)
        say(
            f"{way}: mean {values.mean():.3f} mm, median {np.median(values):.3f}, "
            f"{values.shape[0]} ordered pairs"
        )


def sources(folder):
    """Landmarks of each of five skulls from one other, and from all four others together."""
    files = sorted((folder / "skulls").glob("*.ply"))
    marks = {f.stem: read_landmarks(f.with_suffix(".mrk.json")) for f in files}
    study = s4a.analyse({f.stem: s4a.read_shape(f) for f in files}, n_jobs=1)
    error = {"one source": [], "four sources": []}
    for name, mark in marks.items():
        others = {other: one for other, one in marks.items() if other != name}
        each = [{other: one} for other, one in others.items()]
        for way, given in [*(("one source", one) for one in each), ("four sources", others)]:
            found = s4a.transfer_landmarks(study, given, targets=[name])[name]
            by_name = found.to_dataset().set_index(landmark="landmark_name")["landmark_position"]
            found = by_name.sel(landmark=mark["landmark_name"].values).values
            error[way].append(np.linalg.norm(found - mark["landmark_position"].values, axis=1))
    for way, values in error.items():
        say(f"{way}: mean {np.mean(values):.3f} mm, median {np.median(values):.3f}")


def parcels(folder):
    """35 regions on remeshed faces, bodies and cats, by how far votes count.

    Regions are nearest to samples of the source, along its edges.  The truth on the target
    is where it lies on the mesh before it was remeshed, whose vertices are those of the source: its
    borders lie between vertices as distances say (smooth), or around them (by vertex), as those
    that are carried.
    """
    for name, pairs in PARCELS.items():
        files = sorted((folder / name).glob("*[0-9].ply"))
        rows = {blur: [] for blur in BLURS}
        sure = []
        for a, b in pairs:
            source, before = s4a.read_shape(files[a]), s4a.read_shape(files[b])
            target = remeshed(before, kept=True)
            X, T = as_arrays(source)
            far = dijkstra(edge_graph(X, edges(T)), indices=farthest_points(X, 35))
            label = far.argmin(axis=0)
            X, T = as_arrays(target)
            before = as_arrays(before)
            triangle, weight = closest_point(X, *before)
            corner, area = before[1][triangle], vertex_areas(X, T)
            smooth = np.einsum("spc,pc->sp", far[:, corner], weight).argmin(axis=0)
            nearest = label[np.take_along_axis(corner, weight.argmax(axis=1)[:, None], 1)[:, 0]]
            pair = s4a.register_pairs(source, {"target": target})
            for blur, found in rows.items():
                node = s4a.transfer_labels(pair, label, blur=blur)["target"]
                carried = node["label"].values
                dice = metrics.dice(carried, smooth, area).values()
                right = [
                    100 * metrics.label_accuracy(carried, true, area) for true in (smooth, nearest)
                ]
                found.append((*right, np.mean(list(dice)), min(dice)))
            sure.append(node["confidence"].values.mean())
        say(f"{name}, {len(pairs)} pairs, confidence {min(sure):.2f} to {max(sure):.2f}")
        for blur, found in rows.items():
            mean = np.mean(found, axis=0)
            n = sum(a[0] > b[0] for a, b in zip(found, rows[0], strict=True))
            better = f"; better than 0 on {n}" if blur else ""
            say(
                f"  blur {blur}: right {mean[0]:.2f} % (by vertex {mean[1]:.2f}), "
                f"mean Dice {mean[2]:.4f}, smallest {mean[3]:.3f}{better}"
            )


def ellipsoids():
    X, T = as_arrays(synthetic.ellipsoid(900))
    score = np.array([-1.9, -1.1, -0.6, -0.2, 0.1, 0.4, 0.9, 1.2, 1.2])
    mode, area = X * [0, 0, 1], vertex_areas(X, T)
    names = [f"ellipsoid_{i}" for i in range(len(score))]
    data = as_dataset(X, T, {"template": names[0]}).merge(
        dataset(displacement=score[:, None, None] * mode)
    )
    study = xr.DataTree.from_dict({"registration": data.assign_coords(shape=names)})
    found = s4a.statistics.evaluate(study, n_samples=20_000)
    size, mean, deviation = (
        np.sqrt(area @ mode[:, 2] ** 2 / area.sum()),
        score.mean(),
        score.std(ddof=1),
    )

    def to_nearest(x):
        return np.abs(x - score).min() * stats.norm.pdf(x, mean, deviation)

    others = (score.sum() - score) / (len(score) - 1)
    closed = {
        "compactness": (
            score.var(ddof=1) * size**2,
            found["compactness"].item(),
            found["compactness_error"].item(),
        ),
        "generalization of the mean": (
            np.abs(score - others).mean() * size,
            found.attrs["generalization_0"],
            np.nan,
        ),
        "generalization of one mode": (
            0.0,
            *(found[f"generalization{e}"].item() for e in ("", "_error")),
        ),
        "specificity": (
            quad(to_nearest, -9, 9, limit=400, points=score)[0] * size,
            *(found[f"specificity{e}"].item() for e in ("", "_error")),
        ),
    }
    for name, (exact, measured, error) in closed.items():
        say(f"{name}: closed form {exact:.5f}, measured {measured:.5f}, standard error {error:.5f}")


def groups():
    tree = synthetic.brains(24, 5000, seed=11)
    truth = tree["truth"]
    group = np.where(truth["true_score"].values[:, 1] > 0, "high", "low")
    shapes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    study = s4a.analyse(shapes, n_coarse=1500, k=60, n_jobs=-1)
    group = dict(zip(truth["shape"].values.tolist(), group.tolist(), strict=True))
    kept, again = statistics.evaluate(study), s4a_morphometrics.generalization(study, n_jobs=-1)
    for measure in ("generalization", "generalization_surface"):
        for which, found in (("kept: optimistic", kept), ("recomputed", again)):
            value, error = (found[f"{measure}{e}"].values for e in ("", "_error"))
            row = ", ".join(f"{value[c - 1]:.3f} ± {error[c - 1]:.3f} by {c}" for c in (1, 3, 10))
            say(f"{measure} in mm, correspondences {which}: {row}")
    low, full = (
        np.cumsum(study["pca"][f"explained_variance_ratio{r}"].values) for r in ("_low", "")
    )
    say(
        f"variance explained by ten: {100 * full[9]:.1f} % at full, "
        f"{100 * low[9]:.1f} % at low resolution"
    )
    whole = statistics.group_test(study, group)
    say(
        f"simulated groups: p = {whole['p_value'].item():.4f}, "
        f"least possible {whole.attrs['smallest_p']:.4f}"
    )
    where = statistics.group_map(study, group)
    u = truth[study["registration"].attrs["template"]]["reference_point"].values
    part = [truth[f"simulated_{v}"].values for v in ("centre", "width", "push", "turn")]
    field = synthetic._fields(synthetic.reference_brain(u), *part[:2], part[2][1], part[3][1])
    size = np.linalg.norm(field, axis=1)
    region = size > 0.25 * size.max()
    for name in ("p_family_wise", "p_false_discovery"):
        marked = where[name].values < 0.05
        say(
            f"{name} < 0.05 and the region: Dice "
            f"{2 * (marked & region).sum() / (marked.sum() + region.sum()):.2f}"
        )
    effect = where["effect"].values
    cosine = abs(np.vdot(effect, field)) / np.linalg.norm(effect) / np.linalg.norm(field)
    say(f"effect and simulated mode: cosine {cosine:.2f}")
    x, p = np.repeat([0.0, 1.0], [8, 10]), []
    for seed in range(100):
        scores = np.random.default_rng(seed).standard_t(5, size=(18, 4))
        p.append(permutation.Model(x, n_permutations=199, seed=seed).test(scores)[1])
    tenths = np.histogram(p, np.linspace(0, 1, 11))[0]
    uniform = stats.kstest(p, "uniform").pvalue
    say(
        f"p values of 100 seeds without a difference, by tenths: {tenths}, "
        f"Kolmogorov-Smirnov p {uniform:.2f}"
    )


def volumes():
    """Label volumes of real hippocampi to modes, whole and in their two parts."""
    files = DATA / "hippocampi_msd"
    with tempfile.TemporaryDirectory() as folder:
        for name, words in (
            ("whole", ["run", "--label", "1,2"]),
            ("two structures", ["run-structures", "--structures", "anterior=1", "posterior=2"]),
        ):
            out = Path(folder) / name.replace(" ", "_")
            command = [*words, "--n-coarse", "1000", "--k", "60", "--", str(files)]
            begin = time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "s4a", command[0], "--out", str(out), *command[1:]],
                check=True,
                capture_output=True,
            )
            took = time.perf_counter() - begin
            opened = s4a.open_study if name == "whole" else s4a_morphometrics.open_structures
            with opened(out) as study:
                if name == "whole":
                    share = np.cumsum(study["pca"]["explained_variance_ratio"].values)
                    n = study["registration"].sizes["shape"]
                    said = f"{100 * share[0]:.0f}, {100 * share[4]:.0f} and {100 * share[9]:.0f} %"
                    said = f"{said} of the variance by 1, 5 and 10 modes"
                else:
                    found = s4a_morphometrics.structures(study)
                    between = float(found["level_share"].sel(level="between").sum())
                    n = found.sizes["shape"]
                    said = f"{100 * between:.0f} % of the variance between the structures"
            say(f"{name}: {n} of {len(list(files.glob('*.nii.gz')))} volumes, {took:.0f} s, {said}")


REAL = ("brains", "skulls", "faces", "heads", "template", "points", "sources", "parcels", "volumes")
# collections of these parts
OF = {
    "template": ["brains"],
    "points": ["skulls"],
    "sources": ["skulls"],
    "variance": ["faces"],
    "parcels": ["faces", "faust", "cats"],
}
PARCELS = {  # pairs of the files in their order
    "faces": [(14, 19), (18, 23), (2, 21), (20, 4), (9, 13), (6, 1)],
    "faust": [(9, 5), (13, 16), (1, 11), (3, 6), (8, 18), (15, 19)],
    "cats": [(0, 3), (2, 5), (4, 7), (6, 8), (9, 1), (10, 2)],
}
BLURS = (0, 0.5, 1, 2)

if __name__ == "__main__":
    chosen = sys.argv[1:] or [
        "ellipsoids",
        "groups",
        "variance",
        *(REAL if DATA.is_dir() else ()),
    ]
    for name in chosen:
        say(f"\n{name}")
        if name in ("ellipsoids", "groups", "volumes") or not DATA.is_dir():
            globals()[name]()
            continue
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run(
                [sys.executable, DATA / "unpack.py", folder, *OF.get(name, [name])],
                check=True,
                stdout=subprocess.DEVNULL,
            )
            globals()[name](Path(folder))
