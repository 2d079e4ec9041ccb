"""Command line: ``s4a check | run | statistics | insert | transfer | compare | view | demo``.

Every option of :func:`s4a.analyse` is a flag of run.
"""

import argparse
import contextlib
import inspect
import logging
import sys
import textwrap
import time
import webbrowser
from pathlib import Path

import numpy as np
from joblib import parallel_config

from s4a import accuracy, charts, synthetic
from s4a import compare as comparison
from s4a import statistics as tests
from s4a import transfer as travel
from s4a.annotations import labels_of_file, labels_of_mesh, read_labels, read_landmarks, write_landmarks
from s4a.draw import VIEWS
from s4a.export import write_registered, write_results
from s4a.insert import insert as place
from s4a.io import find_meshes, read_mesh, stem_of
from s4a.mesh import as_arrays, vertex_areas
from s4a.options import CHOICES, DEFAULTS
from s4a.pca import mahalanobis
from s4a.picture import write_animation, write_picture
from s4a.pipeline import analyse
from s4a.shapes import read_shape, read_shapes
from s4a.study import ENGINE, VERSION, open_study
from s4a.subjects import with_table
from s4a.view import write_page

HELP = {
    "n_coarse": "vertices of the low-resolution meshes",
    "n_pairs": "pairs of the network",
    "k_init": "size of the first functional maps",
    "k": "size of the refined functional maps",
    "n_latent": "dimension of the latent space (default: k)",
    "step": "growth of the maps per round of Consistent ZoomOut",
    "init": "first maps from all nearest neighbours, or the paper's fit on 10 landmarks",
    "refine": "joint rounds, or the paper's spectral match alone",
    "how": "full resolution by eq. 7, or by eq. 3 and 4",
    "norm": "norm of eq. 5",
    "scale": "take size out of the displacements",
    "components": "'largest', 'all' or how many to keep",
    "strict": "exclude shapes with vertices that are not finite instead of repairing them",
    "wrap": "wrap the shapes watertight before they are remeshed",
    "close_holes": "close every hole by a fan of triangles",
    "intersections": "count triangles that pass through others",
    "pattern": "only files whose name fits, for example '*brain*'",
    "preset": "'paper' sets init, refine and how to the paper's",
    "template": "name of the shape to register to (default: the median shape)",
    "table": "CSV with a column 'shape', covariates and groups, for the statistics",
    "n_jobs": "processes; -1 for all cores",
    "seed": "seed of all randomness",
}


def table(rows, head, width=120):
    """Rows of text as aligned columns: numbers to the right, a long last column wrapped at `width` characters.

    Examples
    --------
    >>> print(table([["a", 1], ["b", 20]], ["name", "n"]))
    name   n
    a      1
    b     20
    """
    rows = [[str(x) for x in row] for row in [head, *rows]]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    numeric = [
        all(x.replace(".", "", 1).isdigit() or x == "-" for x in column) for column in zip(*rows[1:], strict=True)
    ]
    margin = sum(widths[:-1]) + 2 * (len(head) - 1)
    lines = []
    for row in rows:
        last = textwrap.wrap(row[-1], max(width - margin, 40)) or [""]
        columns = zip([*row[:-1], last[0]], widths, numeric, strict=True)
        lines.append("  ".join(x.rjust(w) if right else x.ljust(w) for x, w, right in columns).rstrip())
        lines += [" " * margin + line for line in last[1:]]
    return "\n".join(lines)


def components(text):
    """A number of components, or the word as it is."""
    return int(text) if text.isdigit() else text


def add_options(parser):
    """One flag for every option of `analyse`."""
    for name, parameter in inspect.signature(analyse).parameters.items():
        if name in ("shapes", "store"):
            continue
        if name == "components":
            parser.add_argument("--components", type=components, default=parameter.default, help=HELP[name])
            continue
        flag, default = "--" + name.replace("_", "-"), parameter.default
        if isinstance(default, bool):
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=default, help=HELP[name])
        elif name in CHOICES:
            legal = [c for c in CHOICES[name] if c]
            parser.add_argument(
                flag, choices=legal, default=default, help=f"{HELP[name]} (default: {DEFAULTS.get(name, default)})"
            )
        else:
            number = isinstance(default, int) or name in ("n_latent", "n_jobs")
            default = -1 if name == "n_jobs" else default
            text = HELP[name] if default is None else f"{HELP[name]} (default: {default})"
            parser.add_argument(flag, type=int if number else str, default=default, help=text)


def options_of(args):
    """The options of `analyse` from parsed flags."""
    options = {n: getattr(args, n) for n in inspect.signature(analyse).parameters if hasattr(args, n)}
    return options


def check(args):
    """Read and clean every file, and say what was found."""
    options = {n: getattr(args, n) for n in ("components", "strict", "close_holes", "pattern", "intersections")}
    report = read_shapes(args.paths, **options)["report"].to_dataset()
    columns = {
        "file_vertices": "vertices",
        "components": "components",
        "genus": "genus",
        "holes": "holes",
        "nonmanifold_edges": "non-manifold",
    }
    rows = []
    for name in report["shape"].values:
        one = report.sel(shape=name)
        counts = ["-" if v not in one or int(one[v]) < 0 else int(one[v]) for v in columns]
        rows.append([name, *counts, one["status"].item(), one["reason"].item()])
    write(table(rows, ["shape", *columns.values(), "status", "found and done"]))
    write_warnings(report)
    return 0 if (report["status"] != "excluded").all() else 1


def write_warnings(report):
    """What looks wrong with shapes, and what concerns the collection."""
    for name in report["shape"].values[report["warning"].values != ""]:
        write(f"  {name}, warning: {report['warning'].sel(shape=name).item()}")
    for remark in report.attrs["remarks"].splitlines():
        write(f"  {remark}")


def run(args):
    """The whole analysis over a folder of meshes."""
    begin = time.perf_counter()
    with cluster(args.cluster):
        study = analyse(args.paths, store=args.out, **options_of(args))
    closing(study, time.perf_counter() - begin)
    write(f"\nstudy: {args.out}; pictures: s4a view {args.out}")
    return 0


@contextlib.contextmanager
def cluster(address):
    """Run joblib's tasks on a dask scheduler: ``tcp://host:port``, or ``local:N`` for N processes started here.

    The workers must see the study's folder under the same path.
    """
    if address is None:
        yield
        return
    try:
        from dask.distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError("--cluster needs dask.distributed: pip install 's4a[cluster]'") from error
    number = address.removeprefix("local:")
    if not address.startswith("tcp://") and not (number != address and number.isdigit() and int(number)):
        raise ValueError(f"--cluster needs tcp://host:port or local:N, found {address!r}")
    with contextlib.ExitStack() as stack:
        if number != address:
            local = LocalCluster(n_workers=int(number), threads_per_worker=1, dashboard_address=None)
            address = stack.enter_context(local).scheduler_address
        stack.enter_context(Client(address))
        stack.enter_context(parallel_config(backend="dask"))
        yield


def closing(study, seconds):
    """The table at the end of a run."""
    report = study["report"].to_dataset()
    rows = [
        [stage, f"{s:.1f}", f"{m:.0f}"]
        for stage, s, m in zip(
            report["stage"].values, report["seconds"].values, report["peak_memory"].values, strict=True
        )
    ]
    rows.append(["all", f"{seconds:.1f}", f"{report['peak_memory'].values.max():.0f}"])
    write("\n" + table(rows, ["stage", "seconds", "peak MiB"]) + "\n")
    status = report["status"].values
    write(
        f"{len(status)} shapes: {(status == 'ok').sum()} ok, {(status == 'repaired').sum()} repaired, "
        f"{(status == 'excluded').sum()} excluded"
    )
    for name in report["shape"].values[status == "excluded"]:
        write(f"  {name} excluded: {report['reason'].sel(shape=name).item()}")
    for name in report["shape"].values[(status != "excluded") & (report["reason"].values != "")]:
        write(f"  {name}: {report['reason'].sel(shape=name).item()}")
    write_warnings(report)
    latent = study["latent"].to_dataset()
    order = latent["distance_to_median"].argsort().values[:3]
    near = ", ".join(f"{latent['shape'].values[i]} {latent['distance_to_median'].values[i]:.4f}" for i in order)
    write(f"median shape: {latent.attrs['median']}; nearest to the limit shape (eq. 5): {near}")
    registration = study["registration"].to_dataset()
    confidence, trip = (registration[name].mean().item() for name in ("confidence", "round_trip"))
    write(
        f"registered to {registration.attrs['template']}; mean confidence {confidence:.2f}, cycle error {trip:.4f} of "
        f"sqrt(area), median |distortion| {np.median(np.abs(registration['distortion'])):.3f}"
    )
    if "pca" in study:
        ratio = np.cumsum(study["pca"]["explained_variance_ratio"].values)
        few = [c for c in (1, 3, 10) if c <= len(ratio)]
        write("variance explained: " + ", ".join(f"{100 * ratio[c - 1]:.1f} % by {c}" for c in few))
    else:
        write(f"no modes: {report.attrs['no_modes']}")


def error_table(errors):
    """Mean errors of :func:`s4a.accuracy.accuracy` over the shapes, a row per method."""
    mean = 100 * errors.mean("shape")
    rows = []
    for method in mean["way"].values:
        pair = [mean[name].sel(way=method).item() for name in ("error", "geodesic_error")]
        rows.append([method, *("-" if np.isnan(e) else f"{e:.3f}" for e in pair)])
    return table(rows, ["mean error, % of sqrt(area)", "straight line", "along edges"])


def demo(args):
    """The whole analysis on the embedded collection, with its accuracy against the truth, as a page."""
    begin = time.perf_counter()
    collection = synthetic.brains(args.shapes, args.vertices, args.seed, dirty=args.dirty)
    study = analyse(collection, store=args.out, n_jobs=args.n_jobs, seed=args.seed)
    truth = collection["truth"]

    def image(shape, template):
        return synthetic.position(truth, shape, truth[template]["reference_point"].values)

    errors = accuracy.accuracy(study, image, n_jobs=args.n_jobs)
    closing(study, time.perf_counter() - begin)
    write("\n" + error_table(errors))
    page = Path(args.out) / "study.html"
    write_page(study, page, title="Synthetic brains")
    pictures = [str(page)]
    if "pca" in study:
        planted = truth["planted_score"].sel(shape=study["pca"]["shape"]).values
        score = study["pca"]["score"].values
        n = min(planted.shape[1], score.shape[1])
        both = np.abs(np.corrcoef(planted[:, :n].T, score[:, :n].T))[:n, n:]
        write("correlation of planted and recovered scores: " + ", ".join(f"{r:.3f}" for r in np.diag(both)))
        pictures.append(str(write_picture(study, Path(args.out) / "modes.png")))
    write(f"\npictures: {', '.join(pictures)} ({time.perf_counter() - begin:.0f} s in all)")
    if args.open:
        webbrowser.open(page.resolve().as_uri())
    return 0


def view(args):
    """One self-contained page of a study."""
    page = Path(args.out) if args.out else Path(args.study) / "study.html"
    write_page(open_study(args.study), page, title=args.title or Path(args.study).name, view=args.view, up=args.up)
    write(f"wrote {page} ({page.stat().st_size / 1e6:.1f} MB)")
    return 0


def transfer(args):
    """Labels and landmarks of one mesh on others."""
    if not (args.labels or args.landmarks):
        raise ValueError("something to transfer needed: give --labels FILE, --landmarks FILE or both")
    source, label, landmarks = read_shape(args.source), None, None
    if args.labels:
        label = labels_of_mesh(read_labels(args.labels, source.sizes["file_vertex_index"]), source)
    if args.landmarks:
        landmarks = read_landmarks(args.landmarks)
        distance = travel.locate(landmarks, source)["landmark_distance"].values
        write(f"{len(distance)} landmarks, at most {distance.max():.3g} from the surface of {args.source}")
    if len(args.targets) == 1 and (Path(args.targets[0]) / "registration.nc").is_file():
        study, excluded = open_study(args.targets[0]), []
    else:
        shapes = read_shapes(args.targets, compare=False)
        report = shapes["report"].to_dataset()
        excluded = report["shape"].values[report["status"].values == "excluded"].tolist()
        meshes = {name: node.to_dataset() for name, node in shapes["original"].children.items()}
        for name in excluded:
            write(f"{name} excluded: {report['reason'].sel(shape=name).item()}")
        template = next(n for n in ("template", "template_", "template__") if n not in meshes)
        options = {"n_coarse": args.n_coarse, "k": args.k, "k_init": min(20, args.k), "n_jobs": args.n_jobs}
        study = travel.register_pairs(source, meshes, name=template, seed=args.seed, **options)
        source = None  # it is the template now
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    write(table(transfer_rows(study, source, label, landmarks, out), TRANSFERRED))
    return 1 if excluded else 0


def statistics(args):
    """Evaluation of the modes and outliers of a study; tests of groups and variables of its table."""
    study, out = open_study(args.study), args.out or str(Path(args.study) / "statistics")
    study = with_table(study, args.table) if args.table else study
    test = {"covariates": args.covariates or None, "seed": args.seed}
    test |= {} if args.permutations is None else {"n_permutations": args.permutations}
    kept = tests.evaluate(study, seed=args.seed)
    results = {"evaluation": kept, "outliers": tests.outliers(study)}
    if args.recompute:
        results["generalization"] = tests.generalization(study, n_jobs=args.n_jobs, seed=args.seed)
    if args.group:
        results["group"] = tests.group_test(study, args.group, **test)
        results["group_map"] = tests.group_map(study, args.group, **test)
        few = {} if args.permutations is None else {"n_permutations": min(args.permutations, 99)}
        results["classification"] = tests.classify(study, args.group, seed=args.seed, **few)
    if args.variable:
        results["regression"] = tests.regression(study, args.variable, **test)
    for name, found in results.items():
        write_results(found, out, name)
    write(evaluation_table(kept, results.get("generalization")))
    far = results["outliers"]
    names = far["shape"].values[far["outlier"].values].tolist()
    write(f"\noutliers: {', '.join(names) or 'none'}")
    if args.group:
        write("\n" + findings(results["group"], results["group_map"], f"groups of {args.group}", study))
        found = results["classification"]
        share, chance = (100 * found.attrs[name] for name in ("balanced_accuracy", "chance"))
        write(f"classified {share:.0f} % right, chance {chance:.0f} %, p = {found['p_value'].item():.3g}")
    if args.variable:
        write("\n" + findings(results["regression"], results["regression"], args.variable, study))
        moving = tests.regression_modes(study, results["regression"], args.variable)
        write_page(moving, Path(out) / "regression.html", title=f"Regression on {args.variable}")
        write_animation(moving, Path(out) / "regression.gif")
    confidence = study["registration"]["confidence"].mean().item()
    write(f"\nmean confidence of the registration {confidence:.2f}; results: {out}")
    return 0


def evaluation_table(kept, anew):
    """Measures by number of components, with their standard errors."""
    unit = kept["generalization"].attrs["units"]
    columns = [("compactness", kept), ("generalization, kept: optimistic", kept), ("specificity", kept)]
    columns[2:2] = [("generalization, recomputed", anew)] if anew is not None else []
    rows = []
    for c in range(min(10, kept.sizes["component"])):
        row = [c + 1]
        for head, found in columns:
            name = head.partition(",")[0]
            value, error = (
                found[n].values[c] if c < found.sizes["component"] else np.nan for n in (name, f"{name}_error")
            )
            row.append("-" if np.isnan(value) else f"{value:.4g} ± {error:.2g}")
        rows.append(row)
    return f"lengths in {unit}, ± standard error\n" + table(rows, ["components", *(head for head, _ in columns)])


def findings(whole, where, name, study):
    """What a test and its map found, in words."""
    area = study["registration"].to_dataset()
    area = vertex_areas(*as_arrays(area))
    p, least = whole["p_value"].item(), whole.attrs["smallest_p"]
    text = f"{name} ({whole.attrs['groups']})" if "groups" in whole.attrs else name
    text += f": p = {p:.3g} over the whole shape, the smallest that can be reached is {least:.2g}"
    for key, words in (("p_family_wise", "family-wise"), ("p_false_discovery", "false discovery rate")):
        share = area @ (where[key].values < 0.05) / area.sum()
        text += f"\n  {100 * share:.1f} % of the area under 0.05 ({words}), smallest {where[key].values.min():.3g}"
    return text


def insert(args):
    """New shapes in a finished study, which stays as it is."""
    study = open_study(args.study)
    found = place(study, args.shapes, n_jobs=args.n_jobs)
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    found.to_netcdf(out / "inserted.nc", engine=ENGINE)
    write_registered(found, out)
    report, data, latent = (found[n].to_dataset() for n in ("report", "registration", "latent"))
    rows = []
    for name in report["shape"].values.tolist():
        if report["status"].sel(shape=name).item() == "excluded":
            rows.append([name, *["-"] * 6, f"excluded: {report['reason'].sel(shape=name).item()}"])
            continue
        one = data.sel(shape=name)
        row = [name, f"{one['confidence'].mean().item():.2f}", f"{one['round_trip'].mean().item():.4f}"]
        row += [
            f"{np.median(np.abs(one['distortion'])):.3f}",
            f"{latent['distance_to_median'].sel(shape=name).item():.4f}",
        ]
        if "pca" in found:
            scores = found["pca"].sel(shape=name)
            row += [f"{scores['reconstruction_error'].item():.4g}", f"{mahalanobis(scores['score']):.1f}"]
            row += [" ".join(f"{s:+.2f}" for s in scores["score"].values[:5])]
        rows.append(row + ["-"] * (8 - len(row)))
    unit = data["displacement"].attrs["units"]
    head = [
        "shape",
        "confidence",
        "round trip",
        "|distortion|",
        "to limit shape",
        f"left ({unit})",
        "Mahalanobis",
        "scores",
    ]
    write(table(rows, head))
    write_warnings(report)
    write(f"\nwritten: {out / 'inserted.nc'}, registered meshes and scores in {out}")
    return 1 if (report["status"] == "excluded").any() else 0


TRANSFERRED = ["target", "cycle error", "|distortion|", "confidence", "share of votes"]
TRANSFERRED += ["labels of dropped vertices", "landmarks", "spread"]


def transfer_rows(study, source, label, landmarks, out):
    """Write the files of every target and give the rows of the table that is shown."""
    given = {"source": source}
    labels = None if label is None else travel.transfer_labels(study, label, **given)
    points = None if landmarks is None else travel.transfer_landmarks(study, landmarks, **given)
    targets = list((labels if points is None else points).children)
    meshes = {name: study["original"][name].to_dataset() for name in targets}
    stems = {name: stem_of(mesh.attrs.get("path") or name) for name, mesh in meshes.items()}
    rows = []
    for name, mesh in meshes.items():
        stem = stems[name] if list(stems.values()).count(stems[name]) == 1 else name
        row = [stem, *["-"] * 7]
        one = study["registration"].to_dataset().sel(shape=name)
        row[1:3] = f"{one['round_trip'].mean().item():.4f}", f"{np.median(np.abs(one['distortion'])):.3f}"
        if labels is not None:
            found = labels[name]
            points_of_file = file_points(mesh)
            value, dropped = labels_of_file(found["label"].values, mesh, points_of_file)
            np.save(out / f"{stem}.labels.npy", value)
            np.save(out / f"{stem}.confidence.npy", labels_of_file(found["confidence"].values, mesh, points_of_file)[0])
            row[3:6] = [
                f"{found['confidence'].mean().item():.2f}",
                f"{found['label_share'].mean().item():.2f}",
                dropped,
            ]
        if points is not None:
            found = points[name]
            write_landmarks(out / f"{stem}.landmarks.csv", found)
            row[6] = f"{found['landmark_confidence'].mean().item():.2f}"
            row[7] = f"{found['landmark_spread'].mean().item():.3g}" if "landmark_spread" in found else "-"
        rows.append(row)
    return rows


def file_points(mesh):
    """The vertices of a mesh's file; those that were kept, where the file is gone."""
    if Path(mesh.attrs.get("path") or "").is_file():
        return read_mesh(mesh.attrs["path"])[0]
    points = np.full((mesh.sizes["file_vertex_index"], 3), np.nan)
    points[mesh["file_vertex"].values] = mesh["position"].values
    return points


TRUTH = "for each target, NPY or text: per vertex of its file that of the source's (from 0; -1: none), or x, y, z"
LANDMARKS = "points by name, of the source's file and of each target's: Slicer .mrk.json, CSV or MeshLab .pp"
METRICS = {
    "geodesic_error": ("error %", 100, 3),
    "straight_error": ("straight %", 100, 3),
    "chamfer": ("Chamfer %", 100, 3),
    "hausdorff": ("Hausdorff %", 100, 2),
    "dirichlet": ("Dirichlet", 1, 2),
    "coverage": ("coverage", 1, 3),
    "bijectivity": ("round trip %", 100, 3),
    "conformal_distortion": ("conformal", 1, 3),
    "area_distortion": ("area", 1, 3),
    "label_accuracy": ("labels", 1, 3),
    "landmark_error": ("landmarks %", 100, 2),
}


def comparison_table(found):
    """Table 1: mean over the pairs of every metric, and the CPU seconds; lengths in % of sqrt(area)."""
    mean = found.mean("pair")
    columns = {name: column for name, column in METRICS.items() if name in mean}
    rows = []
    for way in mean["way"].values:
        one = mean.sel(way=way)
        row = [f"{scale * one[name].item():.{digits}f}" for name, (_, scale, digits) in columns.items()]
        rows.append([way, f"{one['block_seconds'].sum().item():.1f}", *row])
    return table(rows, ["method", "CPU s", *(title for title, *_ in columns.values())])


def block_table(ways, blocks, seconds):
    """CPU seconds of every method by block (Fig. 3)."""
    rows = [
        [way, *(f"{s:.1f}" for s in row), f"{row.sum():.1f}"]
        for way, row in zip(ways, np.asarray(seconds), strict=True)
    ]
    return table(rows, ["CPU s", *blocks, "all"])


def collection_table(found):
    """Table 2: mean Chamfer distance to the template, CPU seconds by block, and the median shape."""
    rows = []
    for way in found["way"].values:
        for how in found["how"].values:
            one = found.sel(way=way, how=how)
            seconds = one["collection_seconds"].values
            chamfer = f"{100 * one['collection_chamfer'].mean().item():.4f}"
            rows.append([way, how, chamfer, *(f"{s:.1f}" for s in seconds), f"{seconds.sum():.1f}"])
            rows[-1].append(one["median_shape"].item())
    blocks = [f"{block}, s" for block in found["block"].values]
    return table(rows, ["method", "way up", "Chamfer %", *blocks, "all, s", "median shape"])


def compare(args):
    """The methods of the paper's Table 1 on pairs, or of its Table 2 on a collection."""
    out = Path(args.out)
    if args.collection:
        if args.paths or args.truth or args.landmarks:
            raise ValueError("--collection takes the shapes alone: no SOURCE, TARGET, --truth or --landmarks")
        methods = args.methods or list(comparison.COLLECTION_METHODS)
        found = comparison.collection(
            args.collection, methods=methods, n_coarse=args.n_coarse, n_pairs=args.n_pairs, k=args.k, seed=args.seed
        )
        names = [f"{way}, {how}" for way in methods for how in found["how"].values]
        seconds = found["collection_seconds"].values.reshape(len(names), -1)
        text = collection_table(found)
    else:
        if len(args.paths) < 2:
            raise ValueError("compare needs SOURCE and TARGET, or --collection PATH...")
        source, *targets = args.paths
        targets = {name: path for target in targets for path, name in find_meshes(target)}
        found = comparison.pairs(
            source,
            targets,
            methods=args.methods or comparison.METHODS,
            truth=per_target(args.truth, targets, "--truth"),
            landmarks=landmark_pairs(args.landmarks, targets),
            n_coarse=args.n_coarse,
            k=args.k,
            seed=args.seed,
        )
        names, seconds = found["way"].values.tolist(), found["block_seconds"].mean("pair").values
        text = comparison_table(found) + "\n\n" + block_table(names, found["block"].values, seconds)
    out.mkdir(parents=True, exist_ok=True)
    found.to_netcdf(out / "compare.nc", engine="h5netcdf")
    figure = charts.stacked(names, found["block"].values.tolist(), seconds)
    figure.savefig(out / "compare.png", dpi=150)
    write(text)
    write(f"\nlengths in % of sqrt(area), times in CPU seconds of one core; in {out}: compare.nc, compare.png")
    return 0


def per_target(files, names, flag):
    """The truth in one file for every target, in the same order, or none."""
    if not files:
        return None
    if len(files) != len(names):
        raise ValueError(f"{flag} needs a file for each of the {len(names)} targets, found {len(files)}")
    return {name: comparison.read_truth(file) for name, file in zip(names, files, strict=True)}


def landmark_pairs(files, targets):
    """Positions of the landmarks that source and target both have by name, for every target, or none."""
    if not files:
        return None
    if len(files) != 1 + len(targets):
        raise ValueError(
            f"--landmarks needs a file for the source and each target, {1 + len(targets)}; found {len(files)}"
        )
    source, *others = (
        dict(zip(found["landmark_name"].values.tolist(), found["landmark_position"].values, strict=True))
        for found in map(read_landmarks, files)
    )
    pairs = {}
    for name, file, target in zip(targets, files[1:], others, strict=True):
        both = [landmark for landmark in source if landmark in target]
        if len(both) < 3:
            raise ValueError(f"{files[0]} and {file} need 3 landmarks or more of the same names, found {len(both)}")
        pairs[name] = [np.stack([end[landmark] for landmark in both]) for end in (source, target)]
    return pairs


def write(text):
    """One text to the output, and a new line."""
    sys.stdout.write(text + "\n")


def parser():
    """The parser of all commands."""
    top = argparse.ArgumentParser(prog="s4a", description="Scalable spectral statistical shape analysis")
    top.add_argument("--version", action="version", version=f"s4a {VERSION}")
    commands = top.add_subparsers(required=True, metavar="command")

    def command(function, **arguments):
        sub = commands.add_parser(function.__name__, help=function.__doc__, description=function.__doc__)
        sub.set_defaults(function=function)
        return sub

    sub = command(check)
    sub.add_argument("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    sub.add_argument("--components", type=components, default="largest", help=HELP["components"])
    sub.add_argument("--pattern", help=HELP["pattern"])
    for name, default in {"strict": False, "close_holes": False, "intersections": True}.items():
        flag = "--" + name.replace("_", "-")
        sub.add_argument(flag, action=argparse.BooleanOptionalAction, default=default, help=HELP[name])
    sub = command(run)
    sub.add_argument("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    sub.add_argument("--out", required=True, metavar="STUDY", help="folder of the study; an unfinished one is resumed")
    sub.add_argument("--cluster", metavar="ADDRESS", help="dask scheduler tcp://host:port, or local:N worker processes")
    add_options(sub)
    sub = command(demo)
    sub.add_argument("--out", default="demo", metavar="STUDY", help="folder of the study (default: demo)")
    sub.add_argument("--shapes", type=int, default=12, help="number of shapes (default: 12)")
    sub.add_argument("--vertices", type=int, default=40_000, help="vertices of each (default: 40000)")
    sub.add_argument("--dirty", action="store_true", help="with loose parts, holes and non-manifold places")
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub.add_argument("--open", action="store_true", help="open the page in a browser")
    sub = command(view)
    sub.add_argument("study", metavar="STUDY")
    sub.add_argument("--out", metavar="PAGE", help="file of the page (default: STUDY/study.html)")
    sub.add_argument("--title", help="title of the page (default: name of the folder)")
    sub.add_argument("--view", default="corner", choices=list(VIEWS), help="from where (default: corner)")
    sub.add_argument("--up", default="z", choices=["x", "y", "z"], help="axis that points up (default: z)")
    sub = command(statistics)
    sub.add_argument("study", metavar="STUDY")
    sub.add_argument("--group", metavar="COLUMN", help="test and map of the difference between groups; classification")
    sub.add_argument("--variable", metavar="COLUMN", help="regression of shape on a number, such as age; its animation")
    sub.add_argument("--covariates", nargs="+", metavar="COLUMN", help="accounted for in both")
    sub.add_argument("--table", metavar="FILE", help="in place of the table of the study")
    sub.add_argument("--recompute", action="store_true", help="generalization with correspondences found anew (slow)")
    sub.add_argument(
        "--permutations", type=int, help="of every test (default: 9999, at every vertex 999, of classes 99)"
    )
    sub.add_argument("--out", metavar="DIR", help="for netCDF and CSV (default: STUDY/statistics)")
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub.add_argument("--seed", type=int, default=0, help=HELP["seed"])
    sub = command(insert)
    sub.add_argument("study", metavar="STUDY")
    sub.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files, folders or globs")
    sub.add_argument("--out", required=True, metavar="DIR", help="for inserted.nc, registered meshes and scores")
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub = command(transfer)
    sub.add_argument("source", metavar="SOURCE", help="mesh file that the labels and landmarks belong to")
    sub.add_argument("targets", nargs="+", metavar="TARGET", help="mesh files, folders or globs; or one study folder")
    sub.add_argument(
        "--labels", metavar="FILE", help="NPY, NPZ (FILE:NAME), CSV, GIFTI label or FreeSurfer annot, also .gz"
    )
    sub.add_argument("--landmarks", metavar="FILE", help="points and curves: Slicer .mrk.json, CSV or MeshLab .pp")
    sub.add_argument(
        "--out", required=True, metavar="DIR", help="for <target>.labels.npy, .confidence.npy, .landmarks.csv"
    )
    sub.add_argument("--n-coarse", type=int, default=6000, help=HELP["n_coarse"])
    sub.add_argument("--k", type=int, default=100, help=HELP["k"])
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub.add_argument("--seed", type=int, default=0, help=HELP["seed"])
    sub = command(compare)
    sub.add_argument("paths", nargs="*", metavar="SOURCE TARGET", help="the reference and one or more other meshes")
    sub.add_argument("--collection", nargs="+", metavar="PATH", help="Table 2 on these folders, globs or mesh files")
    sub.add_argument("--methods", nargs="+", metavar="METHOD", help=f"of {', '.join(comparison.METHODS)}")
    sub.add_argument("--truth", nargs="+", metavar="FILE", help=TRUTH)
    sub.add_argument("--landmarks", nargs="+", metavar="FILE", help=LANDMARKS)
    sub.add_argument("--out", default="compare", metavar="DIR", help="for compare.nc and compare.png")
    sub.add_argument("--n-coarse", type=int, default=6000, help=HELP["n_coarse"])
    sub.add_argument("--n-pairs", type=int, default=500, help=HELP["n_pairs"])
    sub.add_argument("--k", type=int, default=100, help=HELP["k"])
    sub.add_argument("--seed", type=int, default=0, help=HELP["seed"])
    return top


def main(arguments=None):
    """Entry point; returns the exit code, and turns a ValueError or OSError into one line on the error stream."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    args = parser().parse_args(arguments)
    try:
        return args.function(args)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"s4a: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("s4a: interrupted; the same command goes on where it stopped\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())
