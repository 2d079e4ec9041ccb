"""The paper's Table 1 and Table 2 on real and on synthetic shapes: docs/comparison.md's figures.

With truth where there is any, beside pyFM.  Tables are printed as they stand in the page.
``compare.py readings`` prints both tables as section 5.1 can be read, and ``latent`` Table 2 by the
size of the latent basis; both run only if they are named.

The real shapes are those of the shared data beside the checkout, or in a folder that
``--data FOLDER`` names, a folder of PLY files for each set; what is absent is skipped.  Times are
CPU seconds of one core.  Arguments pick parts: registered, more, embedded, heads, collection, and
of the first two the sets: ``compare.py registered faces cats``, ``compare.py more brains``.
"""

import argparse
import importlib.util
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

import s4a
from s4a import metrics, synthetic
from s4a.cli.tables import METRICS
from s4a.evaluation import comparison
from s4a.evaluation.methods import INITS
from s4a.geometry.align import farthest_points
from s4a.geometry.closest import closest_point_in_star, distance_to_surface, interpolate
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method.alignment import transform_onto
from s4a.method.deform import smoother
from s4a.options import PRESETS, Options
from s4a.schema import variable
from s4a.show import charts
from s4a.show.draw import ramp_colors

DATA = Path(__file__).parents[2] / "shared" / "data"
CORRESPONDING = {"faust15k": 6890}  # of these only the first vertices correspond
SETS = {"faces": 2, "faust15k": 2, "cats": 2, "kids": 1}  # pairs
SHOWN = ("geodesic_error", "chamfer", "hausdorff", "dirichlet", "coverage", "bijectivity")
MEASURED = ("chamfer", "hausdorff", "dirichlet", "coverage", "bijectivity")  # without truth
PYFM = {"isometric": True, "weights": "linear_program", "n_latent": 90}  # its defaults
LATENT = {"100, as many as K": {}, "90": {"n_latent": 90}, "50": {"n_latent": 50}}
LATENT |= {"90, with all defaults of pyFM": PYFM}
NAMES = {"fmap": "standard", "latent": "ours"}  # of the paper
COMPARED = ("FMAP+ZO", "RE-MATCH", "RE-MATCH refined", "registered")  # on more pairs
N_LANDMARKS = 10
DISPLACED = (0, 0.1, 0.25, 0.5)
LOOKED_AT = ("RE-MATCH", "registered", "registered surface")
FAR_GAP = 3  # % of sqrt(area), full yellow in the picture
BELOW = (150, 20)  # from where the part is seen that one head has and another has not
PICTURE = Path(__file__).parents[1] / "docs" / "heads.png"


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def unpacked(name, folder):
    subprocess.run(
        [sys.executable, DATA / "unpack.py", folder, name], check=True, stdout=subprocess.DEVNULL
    )
    return sorted((Path(folder) / name).glob("*.ply"))


def peer(source, target, landmarks, truth, k_init=20, k=100, step=5):
    """PyFM's own pipeline: spectrum, wave kernel and landmark descriptors, fit, ZoomOut, match."""
    from pyFM.functional import FunctionalMapping
    from pyFM.mesh import TriMesh

    begin = time.process_time()
    meshes = [TriMesh(*as_arrays(mesh)) for mesh in (source, target)]
    model = FunctionalMapping(*(mesh.process(k=k, verbose=False) for mesh in meshes))
    marks = np.stack(landmarks, axis=1)
    model.preprocess(
        n_descr=100, descr_type="WKS", landmarks=marks, subsample_step=5, k_process=k, verbose=False
    )
    model.fit(K=(k_init, k_init), w_descr=1, w_lap=1e-2, w_dcomm=1e-1, verbose=False)
    refined = model.zoomout_refine(nit=(k - k_init) // step, step=step)
    match = model.get_p2p(refined)
    seconds = time.process_time() - begin
    found = metrics.evaluate(source, target, match, truth=truth)
    spent = np.zeros((1, len(comparison.BLOCKS)))
    spent[0, -1] = seconds
    found["block_seconds"] = variable("block_seconds", spent[None]).isel(algorithm=0, pair=0)
    return found


def files_of(name, folder, given=None):
    """The mesh files of a set: of the folder that was given, or unpacked into another."""
    return sorted((given / name).glob("*.ply")) if given else unpacked(name, folder)


def registered_pairs(name, n_pairs, given=None):
    """Registered shapes, pair by pair, with their truth and landmarks.

    Source, target, true source vertex of each target vertex (-1: none), and ten true pairs as
    landmarks.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = files_of(name, folder, given)[: n_pairs + 1]
        meshes = [s4a.read_shape(path) for path in files]
    for source, target in pairwise(meshes):
        became, row = source["vertex_of_file"].values, target["file_vertex"].values
        known = row < CORRESPONDING.get(name, len(became))
        truth = np.where(known, became[np.minimum(row, len(became) - 1)], -1)
        there = np.flatnonzero(truth >= 0)
        marks = there[farthest_points(target["position"].values[there], N_LANDMARKS)]
        yield source, target, truth, (truth[marks], marks)


def embedded_pairs(n_vertices, n_pairs):
    """The same for the sample data, the truth as positions."""
    tree = synthetic.brains(n_pairs + 1, n_vertices)
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    for (name, source), (other, target) in pairwise(meshes.items()):
        truth = np.asarray(
            synthetic.position(tree["truth"], name, tree["truth"][other]["reference_point"])
        )
        marks = farthest_points(target["position"].values, N_LANDMARKS)
        yield source, target, truth, (truth[marks], target["position"].values[marks])


def markdown(rows, head):
    """Say a table as documentation has it."""
    lines = [head, ["---"] * len(head), *rows]
    say("\n".join(f"| {' | '.join(map(str, line))} |" for line in lines))


def table_1(found, names=None, spread=False):
    """Say the means over pairs of the metrics of these names, or all, and standard deviations."""
    found = found.assign(seconds=seconds_of(found))
    known = {"seconds": ("CPU s", 1, 1)} | METRICS
    columns = {name: known[name] for name in ("seconds", *(names or METRICS)) if name in found}
    rows = []
    for way in found["algorithm"].values:
        one = found.sel(algorithm=way)
        cells = [
            mean_of(factor * one[name].values, digits, spread)
            for name, (_, factor, digits) in columns.items()
        ]
        rows.append([way, *cells])
    markdown(rows, ["", *(head.removesuffix(" %") for head, *_ in columns.values())])


def mean_of(values, digits, spread=False):
    """Write the mean, and the standard deviation; nothing if a value is unknown."""
    if np.isnan(values).any():
        return ""
    text = f"{values.mean():.{digits}f}"
    return f"{text} ± {values.std(ddof=1):.{digits}f}" if spread else text


def registered(name, n_pairs, given=None, init=None, peers=False, methods=comparison.METHODS):
    """All methods, or some, and the peer on registered shapes."""
    rows = []
    for source, target, truth, marks in registered_pairs(name, n_pairs, given):
        options = {"methods": methods, "init": init}
        found = s4a.compare(source, target, truth=truth, landmarks=marks, **options)
        if peers and importlib.util.find_spec("pyFM"):
            with threadpool_limits(1):
                line = peer(source, target, marks, truth)
            line = line.expand_dims(pair=1)
            line = line.assign_coords(algorithm="pyFM (FMAP+ZO)", block=list(comparison.BLOCKS))
            found = xr.concat([found, line.assign_coords(pair=found["pair"])], "algorithm")
        rows.append(found)
    found, n = xr.concat(rows, "pair"), source.sizes["vertex"]
    say(
        f"\nTable 1 on registered shapes, {name}: {n_pairs} pairs of {n} vertices, "
        f"{N_LANDMARKS} true landmarks\n"
    )
    table_1(found, SHOWN)
    figure_3(found)
    if set(comparison.METHODS) <= set(methods):
        verdict(found)


def more(pairs, what, init=None):
    """FMAP+ZO and the three of RE-MATCH on more pairs: errors and seconds, by that of FMAP+ZO."""
    found, options = [], {"methods": COMPARED, "init": init}
    for source, target, truth, marks in pairs:
        one = s4a.compare(source, target, truth=truth, landmarks=marks, **options)
        found.append(one)
        one = one.isel(pair=0)
        cells = zip(COMPARED, one["geodesic_error"].values, seconds_of(one).values, strict=True)
        say("; ".join(f"{way} {100 * error:.3f} % in {s:.1f} s" for way, error, s in cells))
    found = xr.concat(found, "pair")
    error, seconds = 100 * found["geodesic_error"], seconds_of(found)
    say(f"\n{what}: {found.sizes['pair']} pairs of {target.sizes['vertex']} vertices\n")
    first, rows = COMPARED[0], []
    for way in COMPARED:
        one, spent = error.sel(algorithm=way), seconds.sel(algorithm=way)
        by_pair = one / error.sel(algorithm=first)
        rows.append(
            [
                way,
                f"{one.mean():.3f}",
                f"{one.mean() / error.sel(algorithm=first).mean():.3f}",
                f"{by_pair.min():.2f} to {by_pair.max():.2f}",
                f"{spent.mean():.1f}",
                f"{spent.mean() / seconds.sel(algorithm=first).mean():.3f}",
            ]
        )
    markdown(rows, ["", "error", f"by {first}", "by pair", "CPU s", f"by {first}"])


def seconds_of(found):
    """CPU seconds of all blocks."""
    return found["block_seconds"].sum("block")


def verdict(found):
    """What holds of the paper's claims (5.2), and of ours, on the means of these pairs."""
    mean = found.mean("pair")
    of = {
        name: dict(zip(mean["algorithm"].values, mean[name].values, strict=True))
        for name in METRICS
        if name in mean
    }
    time_of = dict(zip(mean["algorithm"].values, seconds_of(mean).values, strict=True))
    five = comparison.PAPER_METHODS
    spectral = [way for way in five if way != "kNN"]
    low = {name: min(five, key=of[name].get) for name in ("chamfer", "hausdorff")}
    fastest = min(spectral, key=time_of.get)
    share = time_of["RE-MATCH"] / time_of["FMAP+ZO"]
    dense = min(time_of["ZO"], time_of["FMAP+ZO"])
    claims = {
        "kNN has the largest Chamfer distance of the five": max(five, key=of["chamfer"].get)
        == "kNN",
        f"RE-MATCH has the smallest Chamfer distance of the five ({low['chamfer']} has)": low[
            "chamfer"
        ]
        == "RE-MATCH",
        f"RE-MATCH has the smallest Hausdorff distance of the five ({low['hausdorff']} has)": low[
            "hausdorff"
        ]
        == "RE-MATCH",
        f"RE-MATCH is the fastest of the spectral methods ({fastest} is)": fastest == "RE-MATCH",
        f"RE-MATCH takes a tenth of the time of FMAP+ZO or less ({share:.2f})": share <= 0.1,
        "SCALABLE is faster than ZO and FMAP+ZO": time_of["SCALABLE"] < dense,
    }
    if "geodesic_error" in of:
        error = of["geodesic_error"]
        worse = {way: error[way] / error["FMAP+ZO"] for way in ("RE-MATCH", "RE-MATCH refined")}
        by_error = sorted(five, key=error.get)
        claims["kNN is the farthest from the truth of the five"] = by_error[-1] == "kNN"
        for way, times in worse.items():
            claims[f"{way} is as near to the truth as FMAP+ZO, within 5 % ({times:.2f})"] = (
                times <= 1.05
            )
        claims |= {
            f"RE-MATCH is the nearest to the truth of the five ({by_error[0]} is)": by_error[0]
            == "RE-MATCH",
            "our registration is more accurate than all five": error["registered"]
            < error[by_error[0]],
            "the order by Chamfer distance is the order by the truth": sorted(
                five, key=of["chamfer"].get
            )
            == by_error,
        }
    say("")
    for claim, holds in claims.items():
        named = claim.endswith(("has)", "is)"))
        text = claim.rpartition(" (")[0] if holds and named else claim
        say(f"- {'holds' if holds else 'does not hold'}: {text}")


def blocks_table(names, blocks, seconds):
    """Say CPU seconds by block, and all."""
    rows = [
        [n, *(f"{s:.1f}" for s in (*one, sum(one)))] for n, one in zip(names, seconds, strict=True)
    ]
    markdown(rows, ["", *blocks, "all"])


def figure_3(found):
    """Say the CPU seconds by block."""
    say("\nCPU seconds by block (Fig. 3):\n")
    blocks_table(
        found["algorithm"].values, found["block"].values, found["block_seconds"].mean("pair").values
    )


def embedded(n_vertices=20_000, methods=comparison.METHODS):
    """Five pairs of the sample data, with truth."""
    tree = synthetic.brains(6, n_vertices)
    meshes = {name: node.to_dataset() for name, node in tree["original"].children.items()}
    (reference, source), *others = meshes.items()
    truth = {
        n: synthetic.position(tree["truth"], reference, tree["truth"][n]["reference_point"])
        for n, _ in others
    }
    truth = {n: np.asarray(t) for n, t in truth.items()}
    found = s4a.compare(source, dict(others), truth=truth, methods=methods)
    say(f"\nTable 1 on the sample data: 5 pairs of {n_vertices} vertices, landmarks as in 4.1\n")
    table_1(found)
    figure_3(found)
    if set(comparison.METHODS) <= set(methods):
        verdict(found)


def pairs_of_heads(given, n_pairs):
    """One real head and others: name, pair, and seconds to read and clean both; no truth."""
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        first, *others = files_of("heads", folder, given)[: n_pairs + 1]
        mesh, load = comparison.load_mesh(first, "source")
        reference = comparison.Spaces(mesh)
        for path in others:
            mesh, seconds = comparison.load_mesh(path, "target")
            yield path.stem, comparison.Pair(reference, comparison.Spaces(mesh)), load + seconds


def heads(given=None, methods=comparison.METHODS, n_pairs=5):
    """Table 1 on real heads.  Every pair is printed when it is done.

    And the picture of where the images of two are far from the source.
    """
    rows, seen = [], {}
    for name, pair, load in pairs_of_heads(given, n_pairs):
        row, outcomes = comparison.metrics_of_pair(pair, methods, load, None, 300)
        rows.append(row)
        if len(seen) < 2:
            seen[name] = outcomes
        say(f"\nTable 1, head_01 and {name}\n")
        table_1(xr.concat(rows[-1:], "pair"))
        figure_3(xr.concat(rows[-1:], "pair"))
    found = xr.concat(rows, "pair", combine_attrs="drop_conflicts")
    say(f"\nTable 1 on real heads: {n_pairs} pairs of 130,000 to 160,000 vertices, no truth\n")
    table_1(found, MEASURED, spread=True)
    figure_3(found)
    if set(comparison.PAPER_METHODS) <= set(methods):
        verdict(found)
    if set(LOOKED_AT) <= set(methods):
        where(pair.source.mesh, seen)


def readings(source, target, transform, match, reverse, functions=None):
    """Eq. 9 and 10 in %, by reading of 5.1: which points of which shapes are compared.

    Parameters
    ----------
    source, target : Spaces
    transform : tuple (R, t)
        Of the source onto the target.
    match, reverse : int ndarray (n_target,) and (n_source,)
        Matched vertices of the source and of the target.
    functions : tuple of float ndarray, optional
        Compared functions of source and target, (n_source, k) and (n_target, k); by default
        positions.
    """
    (X, Y), (R, t) = (source.X, target.X), transform
    (_, T), (_, S) = as_arrays(source.mesh), as_arrays(target.mesh)
    image, placed = X[match], (Y - t) @ R
    low = [space.sampled["sample_vertex"].values for space in (source, target)]
    points = {
        "source, image of the target (as printed)": (X, image),
        "target, image of the source": (Y, Y[reverse]),
        "aligned target, its image": (placed, image),
        "aligned source, its image": (X @ R.T + t, Y[reverse]),
        "source, smoothed image (eq. 8)": (X, placed + smoothed(target, image - placed)),
        "the first at 6,000 vertices": [x[v[v >= 0]] for x, v in zip((X, image), low, strict=True)],
    }
    F, G = (np.ascontiguousarray(f[:], np.float32) for f in functions or (X, placed))
    exact = interpolate(X, T, *closest_point_in_star(G, match, F, T))
    points["the first, image between vertices"] = (X, exact)
    gaps = {name: metrics.nearest_distances(*pair) for name, pair in points.items()}
    gaps["source, surface of the image"] = (distance_to_surface(X, image, S),)
    return {
        name: (100 * sum(gap.mean() for gap in pair), 100 * max(gap.max() for gap in pair))
        for name, pair in gaps.items()
    }


def smoothed(space, d):
    """Project a displacement of all vertices onto U Phi (4.2)."""
    shape = space.coarse
    return shape.U @ (shape.low.Phi @ smoother(shape.low.Phi, shape.full.area, shape.U)(d))


def readings_of_pairs(given=None, methods=comparison.PAPER_METHODS, n_pairs=5):
    """Table 1 on real heads as it can be read: means of both distances over the pairs."""
    found, displaced = {}, []
    for _, pair, _ in pairs_of_heads(given, n_pairs):
        displaced.append([neighbours_displaced(pair, share) for share in DISPLACED])
        for method in methods:
            one, transform = pair.run(method), pair.align_samples[0]
            ends = pair.source, pair.target, transform, one.match, one.reverse
            for name, values in readings(*ends, one.functions).items():
                found.setdefault(name, {}).setdefault(method, []).append(values)
    say(f"\nTable 1 as it can be read, Chamfer / Hausdorff distance, {n_pairs} pairs of heads\n")
    readings_table(found, methods)
    say("\nkNN as printed, with the target displaced after alignment, in shares of sqrt(area)\n")
    cells = [f"{chamfer:.2f} / {hausdorff:.1f}" for chamfer, hausdorff in np.mean(displaced, 0)]
    markdown([["kNN", *cells]], ["displaced by", *DISPLACED])


def neighbours_displaced(pair, share):
    """Eq. 9 and 10 in % of kNN, as printed, with the aligned target displaced along x."""
    (X, Y), (R, t) = (pair.source.X, pair.target.X), pair.align_samples[0]
    match = cKDTree(X).query((Y - t) @ R + [share, 0, 0])[1]
    gap = metrics.nearest_distances(X, X[match])[0]
    return 100 * gap.mean(), 100 * gap.max()


def meshes_of_heads(given=None):
    """Ten real heads by name."""
    with tempfile.TemporaryDirectory() as folder:
        tree = s4a.read_shapes(files_of("heads", folder, given))
        return {name: node.to_dataset() for name, node in tree["original"].children.items()}


def readings_of_collection(given=None):
    """Table 2 on ten real heads as it can be read, with the paper's preset: means over shapes."""
    meshes, found = meshes_of_heads(given), {}
    with threadpool_limits(1):
        for method in comparison.COLLECTION_METHODS:
            one = comparison.latent_collection(meshes, method, 0.0, paper_options())
            for how in comparison.DENSE_MATCHES:
                column = f"{method}, {NAMES[how]}"
                for values in readings_to_template(one, how):
                    for name, pair in values.items():
                        found.setdefault(name, {}).setdefault(column, []).append(pair)
    say("\nTable 2 as it can be read, Chamfer / Hausdorff distance, ten heads\n")
    readings_table(found, list(next(iter(found.values()))))


def latent_sizes(given=None):
    """Table 2 on ten real heads by RE-MATCH, by the size of the latent basis."""
    meshes, rows = meshes_of_heads(given), []
    for name, options in LATENT.items():
        with threadpool_limits(1):
            one = comparison.latent_collection(meshes, "RE-MATCH", 0.0, paper_options(**options))
            gaps = [comparison.chamfer_to_template(one, how)[0] for how in comparison.DENSE_MATCHES]
        cells = [f"{100 * np.nanmean(gap):.4f}" for gap in gaps]
        rows.append([name, *cells, list(meshes)[one.template]])
    say("\nChamfer distance to the template by the size of the latent basis, RE-MATCH\n")
    markdown(rows, ["", *NAMES.values(), "median shape"])


def readings_to_template(found, how):
    """The template as the target, every other shape as the source."""
    low, t = found.spaces[found.template].coarse.low, found.template
    for i, space in enumerate(found.spaces):
        if i != t:
            transform = transform_onto(space.coarse.low, low, "icp")
            functions = [
                found.shapes[end].full.extend(F)
                for end, F in zip((i, t), found.functions(i, t, how), strict=True)
            ]
            match, reverse = found.match(i, t, how), found.match(t, i, how)
            yield readings(space, found.spaces[t], transform, match, reverse, functions)


def paper_options(**others):
    """Options of Table 2 with the preset of the paper, and others."""
    names = ("init", "n_samples", "dense_iterations", "alignment")
    return Options(**{name: PRESETS["paper"][name] for name in names}, **others)


def readings_table(found, columns):
    """Say the means of both distances by reading and column."""
    rows = []
    for name, by in found.items():
        means = [np.mean(by[column], 0) for column in columns]
        rows.append([name, *(f"{chamfer:.3f} / {hausdorff:.2f}" for chamfer, hausdorff in means)])
    markdown(rows, ["compared", *columns])


def where(source, seen):
    """Where images are far from the source: a table, and docs/heads.png."""
    X, T = as_arrays(source)
    size = np.sqrt(vertex_areas(X, T).sum())
    rows, pictures = [], {}
    for name, outcomes in seen.items():
        for way in LOOKED_AT:
            one = outcomes[way]
            image = X[one.match] if one.image is None else one.image
            forth, back = (100 * gap for gap in metrics.nearest_distances(X / size, image / size))
            near = forth <= FAR_GAP
            cells = [f"{np.quantile(forth, q):.2f}" for q in (0.5, 0.99, 1)]
            cells += [f"{forth.mean():.3f}", f"{forth[near].mean():.3f}", f"{back.mean():.3f}"]
            rows.append([name, way, *cells, f"{100 * (1 - near.mean()):.2f}"])
            pictures[f"{name}, {way}"] = ramp_colors(forth, 0, FAR_GAP)
    say("\nFrom every vertex of head_01 to the image of another head, and back, in %\n")
    head = ["target", "", "median", "99 %", "largest", "mean", "without far ones", "mean back"]
    markdown(rows, [*head, f"vertices beyond {FAR_GAP} %"])
    figure = charts.surfaces(dict.fromkeys(pictures, source), pictures, columns=3, view=BELOW)
    figure.savefig(PICTURE, dpi=110)


# initial maps and Consistent ZoomOut of Table 2
FIRST = {
    "paper": ("landmarks (the paper)", {"preset": "paper"}),
    "landmarks": ("landmarks, our iterations", {"init": "landmarks"}),
    "nearest": ("nearest neighbours, our iterations", {}),
}


def table_2(given=None, first=tuple(FIRST)):
    """Ten real heads, with the paper's initial maps and with ours."""
    say("\nTable 2 on ten real heads")
    with tempfile.TemporaryDirectory() as folder:
        shapes = s4a.read_shapes(files_of("heads", folder, given))
    all_rows, distances = [], []
    for what, options in (FIRST[name] for name in first):
        found = s4a.compare_collection(shapes, **options)
        seconds, chamfer = found["collection_seconds"], found["collection_chamfer"].mean("shape")
        for way in found["algorithm"].values:
            for how in found["dense_match"].values:
                spent = (
                    seconds.sel(algorithm=way, dense_match=how)
                    .drop_sel(block="load and clean")
                    .values
                )
                cells = [f"{s:.1f}" for s in (*spent, spent.sum())]
                gap = f"{100 * chamfer.sel(algorithm=way, dense_match=how).item():.4f}"
                shape = found["median_shape"].sel(algorithm=way).item()
                all_rows.append([way, what, NAMES[str(how)], gap, *cells, shape])
            distance = found["distance_to_limit"].sel(algorithm=way).values
            distances.append([way, what, *(f"{d:.4f}" for d in distance)])
        say(f"\nfirst maps: {what}")
        verdict_2(found)
    blocks = [block for block in found["block"].values if block != "load and clean"]
    say("")
    head = ["", "initial maps", "method", "Chamfer to the template", *blocks, "all", "median shape"]
    markdown(all_rows, head)
    say("\nDistance to the limit shape (eq. 5):\n")
    markdown(distances, ["", "initial maps", *found["shape"].values])


def verdict_2(found):
    """What holds of the paper's claims (5.3)."""
    seconds = found["collection_seconds"].sum("block")
    chamfer = found["collection_chamfer"].mean("shape")
    claims = {
        "both methods have the same median shape": len(set(found["median_shape"].values)) == 1,
        "ours takes less time than the standard way": bool(
            (seconds.sel(dense_match="latent") < seconds.sel(dense_match="fmap")).all()
        ),
        "ours has the smaller Chamfer distance": bool(
            (chamfer.sel(dense_match="latent") < chamfer.sel(dense_match="fmap")).all()
        ),
        "RE-MATCH takes less time than SCALABLE": bool(
            (seconds.sel(algorithm="RE-MATCH") < seconds.sel(algorithm="SCALABLE")).all()
        ),
    }
    for claim, holds in claims.items():
        say(f"- {'holds' if holds else 'does not hold'}: {claim}")


PARTS = ("registered", "more", "embedded", "collection", "heads", "readings", "latent")

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    known = [*PARTS, *SETS, "brains"]
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(known))
    parser.add_argument("--data", type=Path, help="a folder of meshes for each set")
    parser.add_argument("--init", choices=INITS, help="initial maps of registered and more")
    parser.add_argument("--first", nargs="+", choices=FIRST, default=[*FIRST], help="of collection")
    parser.add_argument("--methods", nargs="+", default=comparison.METHODS, help="of Table 1")
    parser.add_argument("--pairs", type=int, help="of more, and of heads: 5 by default")
    parser.add_argument("--peer", action="store_true", help="pyFM beside registered shapes, too")
    args = parser.parse_args()
    wrong = set(args.parts) - set(known)
    if wrong:
        parser.error(f"unknown parts {', '.join(wrong)}")
    parts = [part for part in args.parts if part in PARTS] or PARTS
    sets = [name for name in args.parts if name in known[len(PARTS) :]] or known[len(PARTS) :]
    real = args.data is not None or DATA.is_dir()
    real_sets = [name for name in sets if name in SETS] if real else []
    if "registered" in parts:
        for one in real_sets:
            registered(one, SETS[one], args.data, args.init, args.peer, args.methods)
    if "more" in parts:
        for one in real_sets:
            more(registered_pairs(one, args.pairs or 5, args.data), one, args.init)
        if "brains" in sets:
            more(embedded_pairs(100_000, args.pairs or 2), "synthetic brains", args.init)
    if "embedded" in parts:
        embedded(methods=args.methods)
    if "collection" in parts and real:
        table_2(args.data, args.first)
    if "heads" in parts and real:
        heads(args.data, args.methods, args.pairs or 5)
    if "readings" in args.parts and real:
        paper = [method for method in args.methods if method in comparison.PAPER_METHODS]
        readings_of_pairs(args.data, paper, args.pairs or 5)
        readings_of_collection(args.data)
    if "latent" in args.parts and real:
        latent_sizes(args.data)
