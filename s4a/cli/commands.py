"""The commands of the command line, one function each.

Parsed arguments (:mod:`s4a.cli.flags`) to an exit code.

What they write to the output is put into words and tables in :mod:`s4a.cli.tables`.
"""

import contextlib
import inspect
import sys
import time
import webbrowser
from pathlib import Path

import numpy as np
from joblib import parallel_config

from s4a.analysis import statistics as tests
from s4a.analysis import transfer as travel
from s4a.analysis.export import write_registered, write_results
from s4a.analysis.landmarks import locate
from s4a.cli import tables
from s4a.datasets import synthetic
from s4a.evaluation import accuracy
from s4a.evaluation import compare as comparison
from s4a.input.annotations import (
    labels_of_file,
    labels_of_mesh,
    read_labels,
    read_landmarks,
    write_landmarks,
)
from s4a.input.collection import read_shape, read_shapes
from s4a.input.files import find_meshes, read_mesh, stem_of
from s4a.input.subjects import with_table
from s4a.show import charts
from s4a.show.page import write_page
from s4a.show.pictures import write_animation, write_picture
from s4a.study.insert import insert as place
from s4a.study.pipeline import analyse
from s4a.study.store import ENGINE, open_study


def check(args):
    """Read and clean every file, and say what was found."""
    options = {
        n: getattr(args, n)
        for n in ("components", "strict", "close_holes", "pattern", "intersections")
    }
    report = read_shapes(args.paths, **options)["report"].to_dataset()
    write(tables.report_table(report))
    return 0 if (report["status"] != "excluded").all() else 1


def run(args):
    """The whole analysis over a folder of meshes."""
    begin = time.perf_counter()
    with cluster(args.cluster):
        study = analyse(args.paths, store=args.out, **options_of(args))
    write(tables.run_summary(study, time.perf_counter() - begin))
    write(f"\nstudy: {args.out}; pictures: s4a view {args.out}")
    return 0


def options_of(args):
    """The options of `analyse` from parsed flags."""
    return {n: getattr(args, n) for n in inspect.signature(analyse).parameters if hasattr(args, n)}


@contextlib.contextmanager
def cluster(address):
    """Run joblib's tasks on a dask scheduler.

    ``tcp://host:port``, or ``local:N`` for N processes started here.

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
    if not address.startswith("tcp://") and not (
        number != address and number.isdigit() and int(number)
    ):
        raise ValueError(f"--cluster needs tcp://host:port or local:N, found {address!r}")
    with contextlib.ExitStack() as stack:
        if number != address:
            local = LocalCluster(
                n_workers=int(number), threads_per_worker=1, dashboard_address=None
            )
            address = stack.enter_context(local).scheduler_address
        stack.enter_context(Client(address))
        stack.enter_context(parallel_config(backend="dask"))
        yield


def demo(args):
    """The whole analysis on the embedded collection, with its accuracy against the truth.

    As a page.
    """
    begin = time.perf_counter()
    collection = synthetic.brains(args.shapes, args.vertices, args.seed, dirty=args.dirty)
    study = analyse(collection, store=args.out, n_jobs=args.n_jobs, seed=args.seed)
    truth = collection["truth"]

    def image(shape, template):
        return synthetic.position(truth, shape, truth[template]["reference_point"].values)

    errors = accuracy.accuracy(study, image, n_jobs=args.n_jobs)
    write(tables.run_summary(study, time.perf_counter() - begin))
    write("\n" + tables.error_table(errors))
    page = Path(args.out) / "study.html"
    write_page(study, page, title="Synthetic brains")
    pictures = [str(page)]
    if "pca" in study:
        planted = truth["planted_score"].sel(shape=study["pca"]["shape"]).values
        score = study["pca"]["score"].values
        n = min(planted.shape[1], score.shape[1])
        both = np.abs(np.corrcoef(planted[:, :n].T, score[:, :n].T))[:n, n:]
        write(
            "correlation of planted and recovered scores: "
            + ", ".join(f"{r:.3f}" for r in np.diag(both))
        )
        pictures.append(str(write_picture(study, Path(args.out) / "modes.png")))
    write(f"\npictures: {', '.join(pictures)} ({time.perf_counter() - begin:.0f} s in all)")
    if args.open:
        webbrowser.open(page.resolve().as_uri())
    return 0


def view(args):
    """One self-contained page of a study."""
    page = Path(args.out) if args.out else Path(args.study) / "study.html"
    write_page(
        open_study(args.study),
        page,
        title=args.title or Path(args.study).name,
        view=args.view,
        up=args.up,
    )
    write(f"wrote {page} ({page.stat().st_size / 1e6:.1f} MB)")
    return 0


def statistics(args):
    """Evaluation of the modes and outliers of a study.

    Tests of groups and variables of its table.
    """
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
    write(tables.evaluation_table(kept, results.get("generalization")))
    far = results["outliers"]
    names = far["shape"].values[far["outlier"].values].tolist()
    write(f"\noutliers: {', '.join(names) or 'none'}")
    if args.group:
        write(
            "\n"
            + tables.significance(
                results["group"], results["group_map"], f"groups of {args.group}", study
            )
        )
        found = results["classification"]
        share, chance = (100 * found.attrs[name] for name in ("balanced_accuracy", "chance"))
        write(
            f"classified {share:.0f} % right, chance {chance:.0f} %, p = {found['p_value'].item():.3g}"
        )
    if args.variable:
        write(
            "\n"
            + tables.significance(
                results["regression"], results["regression"], args.variable, study
            )
        )
        moving = tests.regression_modes(study, results["regression"], args.variable)
        write_page(moving, Path(out) / "regression.html", title=f"Regression on {args.variable}")
        write_animation(moving, Path(out) / "regression.gif")
    confidence = study["registration"]["confidence"].mean().item()
    write(f"\nmean confidence of the registration {confidence:.2f}; results: {out}")
    return 0


def insert(args):
    """New shapes in a finished study, which stays as it is."""
    study = open_study(args.study)
    found = place(study, args.shapes, n_jobs=args.n_jobs)
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    found.to_netcdf(out / "inserted.nc", engine=ENGINE)
    write_registered(found, out)
    write(tables.inserted_table(found))
    write(f"\nwritten: {out / 'inserted.nc'}, registered meshes and scores in {out}")
    return 1 if (found["report"]["status"] == "excluded").any() else 0


def transfer(args):
    """Labels and landmarks of one mesh on others."""
    if not (args.labels or args.landmarks):
        raise ValueError(
            "something to transfer needed: give --labels FILE, --landmarks FILE or both"
        )
    source, label, landmarks = read_shape(args.source), None, None
    if args.labels:
        label = labels_of_mesh(read_labels(args.labels, source.sizes["file_vertex_index"]), source)
    if args.landmarks:
        landmarks = read_landmarks(args.landmarks)
        distance = locate(landmarks, source)["landmark_distance"].values
        write(
            f"{len(distance)} landmarks, at most {distance.max():.3g} from the surface of {args.source}"
        )
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
        options = {
            "n_coarse": args.n_coarse,
            "k": args.k,
            "k_init": min(20, args.k),
            "n_jobs": args.n_jobs,
        }
        study = travel.register_pairs(source, meshes, name=template, seed=args.seed, **options)
        source = None  # it is the template now
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    write(tables.table(transfer_rows(study, source, label, landmarks, out), TRANSFERRED))
    return 1 if excluded else 0


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
        row[1:3] = (
            f"{one['round_trip'].mean().item():.4f}",
            f"{np.median(np.abs(one['distortion'])):.3f}",
        )
        if labels is not None:
            found = labels[name]
            points_of_file = file_points(mesh)
            value, dropped = labels_of_file(found["label"].values, mesh, points_of_file)
            np.save(out / f"{stem}.labels.npy", value)
            np.save(
                out / f"{stem}.confidence.npy",
                labels_of_file(found["confidence"].values, mesh, points_of_file)[0],
            )
            row[3:6] = [
                f"{found['confidence'].mean().item():.2f}",
                f"{found['label_share'].mean().item():.2f}",
                dropped,
            ]
        if points is not None:
            found = points[name]
            write_landmarks(out / f"{stem}.landmarks.csv", found)
            row[6] = f"{found['landmark_confidence'].mean().item():.2f}"
            row[7] = (
                f"{found['landmark_spread'].mean().item():.3g}"
                if "landmark_spread" in found
                else "-"
            )
        rows.append(row)
    return rows


def file_points(mesh):
    """The vertices of a mesh's file; those that were kept, where the file is gone."""
    if Path(mesh.attrs.get("path") or "").is_file():
        return read_mesh(mesh.attrs["path"])[0]
    points = np.full((mesh.sizes["file_vertex_index"], 3), np.nan)
    points[mesh["file_vertex"].values] = mesh["position"].values
    return points


def compare(args):
    """The methods of the paper's Table 1 on pairs, or of its Table 2 on a collection."""
    out = Path(args.out)
    if args.collection:
        if args.paths or args.truth or args.landmarks:
            raise ValueError(
                "--collection takes the shapes alone: no SOURCE, TARGET, --truth or --landmarks"
            )
        methods = args.methods or list(comparison.COLLECTION_METHODS)
        found = comparison.collection(
            args.collection,
            methods=methods,
            n_coarse=args.n_coarse,
            n_pairs=args.n_pairs,
            k=args.k,
            seed=args.seed,
        )
        names = [f"{way}, {how}" for way in methods for how in found["how"].values]
        seconds = found["collection_seconds"].values.reshape(len(names), -1)
        text = tables.collection_table(found)
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
        text = (
            tables.comparison_table(found)
            + "\n\n"
            + tables.block_table(names, found["block"].values, seconds)
        )
    out.mkdir(parents=True, exist_ok=True)
    found.to_netcdf(out / "compare.nc", engine="h5netcdf")
    figure = charts.stacked(names, found["block"].values.tolist(), seconds)
    figure.savefig(out / "compare.png", dpi=150)
    write(text)
    write(
        f"\nlengths in % of sqrt(area), times in CPU seconds of one core; in {out}: compare.nc, compare.png"
    )
    return 0


def per_target(files, names, flag):
    """The truth in one file for every target, in the same order, or none."""
    if not files:
        return None
    if len(files) != len(names):
        raise ValueError(
            f"{flag} needs a file for each of the {len(names)} targets, found {len(files)}"
        )
    return {name: comparison.read_truth(file) for name, file in zip(names, files, strict=True)}


def landmark_pairs(files, targets):
    """Positions of the landmarks that source and target both have by name, for every target.

    Or none.
    """
    if not files:
        return None
    if len(files) != 1 + len(targets):
        raise ValueError(
            f"--landmarks needs a file for the source and each target, {1 + len(targets)}; found {len(files)}"
        )
    source, *others = (
        dict(
            zip(
                found["landmark_name"].values.tolist(),
                found["landmark_position"].values,
                strict=True,
            )
        )
        for found in map(read_landmarks, files)
    )
    pairs = {}
    for name, file, target in zip(targets, files[1:], others, strict=True):
        both = [landmark for landmark in source if landmark in target]
        if len(both) < 3:
            raise ValueError(
                f"{files[0]} and {file} need 3 landmarks or more of the same names, found {len(both)}"
            )
        pairs[name] = [np.stack([end[landmark] for landmark in both]) for end in (source, target)]
    return pairs


def write(text):
    """One text to the output, and a new line."""
    sys.stdout.write(text + "\n")
