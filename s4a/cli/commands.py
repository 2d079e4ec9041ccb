"""The commands of the command line: from parsed arguments to what is written and an exit code.

The flags are in :mod:`s4a.cli.flags`; what is shown is put into words in :mod:`s4a.cli.tables`.
Every command imports what it needs, so that none waits for what the others need.
"""

import contextlib
import dataclasses
import logging
import re
import shlex
import sys
import time
import webbrowser
from argparse import Namespace
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s4a.input.raw import shown

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr


def check(args: Namespace) -> int:
    """Read and clean every file, and say what was found."""
    from s4a.cli import tables
    from s4a.input.collection import read_shapes

    report = read_shapes(
        args.paths,
        components=args.components,
        strict=args.strict,
        close_holes=args.close_holes,
        pattern=args.pattern,
        label=args.label,
        intersections=args.intersections,
    )["report"].to_dataset()
    write("\n".join([*tables.decision_lines(report), tables.report_table(report)]))
    return 0 if (report["status"] != "excluded").all() else 1


def doctor(args: Namespace) -> int:
    """What this machine lacks, and what to type."""
    from s4a.cli.doctor import examine, lines

    findings = examine(args.folder)
    lacking = sum(finding.state == "lacks" for finding in findings)
    notes = sum(finding.state == "note" for finding in findings)
    write("\n".join([*lines(findings), f"{lacking} lacking, {notes} to know"]))
    return 1 if lacking else 0


def run(args: Namespace) -> int:
    """The whole analysis over a folder of meshes."""
    from s4a.cli import tables
    from s4a.study.pipeline import analyse

    full = within(args.out, "report.txt")
    with cluster(args.cluster), lines_or_bars():
        study = analyse(args.paths, store=args.out, **options_of(args))
    again = shlex.join(["s4a", *(word for word in args.words if word != "--keep-doubtful")])
    report = study["report"].to_dataset()
    lines = [tables.report_table(report), *tables.stage_lines(report)]
    full.write_text("\n".join(lines) + "\n", encoding="utf-8")
    write(tables.run_summary(study, again=again))
    write("\n".join(tables.place_lines(args.out, str(full))))
    return 1 if study["report"].attrs["unforeseen"] else 0


def options_of(args: Namespace) -> dict[str, Any]:
    """The options of `analyse` from parsed flags, and how many processes."""
    from s4a.options import Options

    return {
        name: getattr(args, name)
        for name in [*(f.name for f in dataclasses.fields(Options)), "n_jobs"]
    }


@contextlib.contextmanager
def lines_or_bars() -> Iterator[None]:
    """A line of the log for each stage meanwhile, in place of bars, where there is no terminal."""
    log = logging.getLogger("s4a.study.runner")
    before = log.level
    if not sys.stderr.isatty():
        log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.setLevel(before)


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[None]:
    """Run joblib's tasks on a dask scheduler, where there is an address.

    ``tcp://host:port``, or ``local:N`` for N processes started here.  The workers must see the
    study's folder under the same path.
    """
    if address is None:
        yield
        return
    known = re.fullmatch(r"local:([1-9][0-9]{0,2})|tcp://\S+:[0-9]{1,5}", address)
    if not known:
        raise ValueError(
            f"--cluster needs tcp://host:port, or local:N with N from 1 to 999; found {address!r}"
        )
    try:
        from dask.distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError("--cluster needs dask.distributed: pip install 's4a[cluster]'") from error
    from joblib import parallel_config

    from s4a.study.processes import spawned_end_too

    n_workers = int(known[1] or 0)
    with contextlib.ExitStack() as stack:
        if n_workers:
            stack.enter_context(spawned_end_too())
            local = LocalCluster(n_workers=n_workers, threads_per_worker=1, dashboard_address=None)
            address = stack.enter_context(local).scheduler_address
        stack.enter_context(Client(address))
        stack.enter_context(parallel_config(backend="dask"))
        yield


def demo(args: Namespace) -> int:
    """The whole analysis on the bundled collection, as a page.

    Its accuracy against the truth is printed.
    """
    from s4a.cli import tables
    from s4a.datasets import synthetic
    from s4a.evaluation import accuracy
    from s4a.show.page import write_page
    from s4a.show.pictures import write_picture
    from s4a.study.pipeline import analyse

    out = Path(args.out)
    collection = synthetic.brains(args.shapes, args.vertices, args.seed, dirty=args.dirty)
    study = analyse(collection, store=out, preset=args.preset, n_jobs=args.n_jobs, seed=args.seed)
    truth: Any = collection["truth"]

    def image(shape, template):
        return synthetic.position(truth, shape, truth[template]["reference_point"].values)

    write(tables.run_summary(study))
    if "pca" in study:
        write(f"\npicture: {write_picture(study, out / 'modes.png')}")
    errors = accuracy.accuracy(study, image, n_jobs=args.n_jobs)
    write("\n" + tables.error_table(errors))
    if "pca" in study:
        write(tables.planted_line(study["pca"].to_dataset(), truth.to_dataset()))
    page = out / "study.html"
    write_page(study, page, title="Synthetic brains")
    write(f"\npage: {page}")
    if args.open:
        webbrowser.open(page.resolve().as_uri())
    return 0


def verify(args: Namespace) -> int:
    """Whether every file of a study is as it was written, and they belong together."""
    from s4a.cli import tables
    from s4a.study.verify import verify

    found = verify(args.study)
    write(tables.verify_lines(found))
    return 1 if tables.count_faults(found) else 0


def status(args: Namespace) -> int:
    """How far a run is, or was when it was stopped."""
    from s4a.cli import tables
    from s4a.study.progress import status

    write(tables.status_lines(status(args.study), time.time()))
    return 0


def view(args: Namespace) -> int:
    """One self-contained page of a study."""
    from s4a.show.page import write_page
    from s4a.study.tree import open_study

    page = Path(args.out) if args.out else within(args.study, "study.html")
    title = args.title or Path(args.study).name
    write_page(open_study(args.study), page, title=title, view=args.view, up=args.up)
    write(f"wrote {page} ({page.stat().st_size / 1e6:.1f} MB)")
    return 0


def statistics(args: Namespace) -> int:
    """Evaluation of the modes and outliers of a study.

    Tests of groups and variables of its table.
    """
    from s4a.analysis import statistics as tests
    from s4a.analysis.export import write_results
    from s4a.cli import tables
    from s4a.show.page import write_page
    from s4a.show.pictures import write_film

    if (args.covariates or args.field) and not (args.group or args.variable):
        raise ValueError("--covariates and --field are of a test: give --group or --variable")
    study, out = study_to_test(args)
    study = restricted(study, args)
    results = tests_of(study, args)  # first, as options and columns may be refused
    results["evaluation"] = tests.evaluate(study, seed=args.seed)
    results["outliers"] = tests.outliers(study)
    if args.recompute:
        results["generalization"] = tests.generalization(study, n_jobs=args.n_jobs, seed=args.seed)
    for name, result in results.items():
        write_results(result, out, name)
    write(tables.evaluation_table(results["evaluation"], results.get("generalization")))
    outlier = results["outliers"]["outlier"]
    write(f"\noutliers: {', '.join(outlier['shape'].values[outlier.values]) or 'none'}")
    if args.group:
        name = f"groups of {args.group}"
        write("\n" + tables.significance(results["group"], results["group_map"], name, study))
        write(tables.classification_line(results["classification"]))
    if args.variable:
        regression = results["regression"]
        write("\n" + tables.significance(regression, regression, args.variable, study))
        if not args.field:
            moving = tests.regression_modes(study, regression, args.variable)
            page = Path(out) / "regression.html"
            write_page(moving, page, title=f"Regression on {args.variable}")
            write_film(moving, Path(out) / "regression.gif")
    confidence = study["registration"]["confidence"].mean().item()
    write(f"\nmean confidence of the registration {confidence:.2f}; results: {out}")
    return 0


def study_to_test(args: Namespace) -> "tuple[xr.DataTree, str]":
    """The study with the table and the shapes that are asked for, and the folder of results."""
    from s4a.analysis.inputs import with_doubtful
    from s4a.input.plausibility import listed
    from s4a.input.subjects import with_table
    from s4a.study.tree import left_out, open_study

    study, out = open_study(args.study), args.out or str(within(args.study, "statistics"))
    study = with_table(study, args.table) if args.table else study
    study = with_doubtful(study) if args.keep_doubtful else study
    if doubtful := left_out(study):
        write(
            f"{len(doubtful)} doubtful shapes are left out, --keep-doubtful takes them in: "
            f"{listed(doubtful, 200)}\n"
        )
    return study, out


def restricted(study: "xr.DataTree", args: Namespace) -> "xr.DataTree":
    """The study of the part of what varies that is asked for."""
    from s4a.analysis import restrict

    if args.labels and not args.label:
        raise ValueError("--labels is where --label looks: give --label LABEL..., or leave it out")
    is_part = args.size_back or args.without or args.label or args.least_confidence
    if is_part and args.recompute:
        raise ValueError("--recompute finds whole shapes anew: leave it out, or take all of them")
    said = []
    if args.size_back:
        study = restrict.with_size(study)
        said.append("with size given back")
    if args.without:
        study = restrict.without(study, args.without)
        said.append(f"without {', '.join(args.without)}")
    if args.label or args.least_confidence:
        whole = study["registration"].sizes["vertex"]
        study = restrict.within(
            study,
            args.label or None,
            labels=template_labels(study, args.labels),
            least_confidence=args.least_confidence,
        )
        said.append(f"{study['registration'].sizes['vertex']} of {whole} vertices")
    if said:
        write("; ".join(said) + "\n")
    return study


def template_labels(study: "xr.DataTree", file: str | None) -> "np.ndarray | None":
    """Labels of the template, from a file with one for each vertex of its file."""
    from s4a.analysis.inputs import all_registered
    from s4a.input.annotations import labels_of_mesh, read_labels

    if file is None:
        return None
    mesh = study["original"][all_registered(study).attrs["template"]].to_dataset()
    return labels_of_mesh(read_labels(file, mesh.sizes["file_vertex_index"]), mesh)


def tests_of(study: "xr.DataTree", args: Namespace) -> "dict[str, xr.Dataset]":
    """The tests of the group and the variable that are asked for."""
    from s4a.analysis import statistics as tests

    options = {
        "covariates": args.covariates or None,
        "seed": args.seed,
        "variances": args.variances,
    }
    n_classified = {}
    if args.permutations is not None:
        options["n_permutations"] = args.permutations
        n_classified["n_permutations"] = min(args.permutations, 99)  # each trains anew
    results = {}
    if args.group:
        results["group"] = tests.group_test(study, args.group, field=args.field, **options)
        results["group_map"] = tests.group_map(study, args.group, field=args.field, **options)
        results["classification"] = tests.classify(
            study, args.group, field=args.field, seed=args.seed, **n_classified
        )
    if args.variable:
        results["regression"] = tests.regression(study, args.variable, field=args.field, **options)
    return results


def fields(args: Namespace) -> int:
    """A number per vertex of every shape, such as thickness, carried to the template and kept."""
    import numpy as np

    from s4a.analysis.fields import with_field, write_field
    from s4a.study.tree import open_study

    study = open_study(args.study)
    study = with_field(study, args.name, args.folder, unit=args.unit, partial=args.partial)
    path = write_field(study, args.name, args.study)
    field = study["fields"][args.name].to_dataset()["carried_field"]
    known = np.isfinite(field.values)
    write(
        f"{args.name} of {known.any(1).sum()} of {len(known)} shapes, "
        f"{np.nanmin(field):.4g} to {np.nanmax(field):.4g} {field.attrs['units']}, mean "
        f"{np.nanmean(field):.4g}, at {100 * known.mean():.0f} % of the template's vertices: "
        f"{path}\n"
        f"s4a statistics {args.study} --field {args.name} takes it in place of shape"
    )
    return 0


def insert(args: Namespace) -> int:
    """New shapes in a finished study, which stays as it is."""
    from s4a.analysis.export import write_registered
    from s4a.cli import tables
    from s4a.study.insert import insert
    from s4a.study.store import ENGINE
    from s4a.study.tree import open_study

    study = open_study(args.study)
    options = {name: getattr(args, name) for name in ("landmarks", "reflect", "n_jobs")}
    inserted = insert(study, args.shapes, **options)
    out = new_folder(args.out)
    inserted.to_netcdf(out / "inserted.nc", engine=ENGINE)
    write_registered(inserted, out)
    write(tables.inserted_table(inserted))
    write(f"\nwritten: {out / 'inserted.nc'}, registered meshes and scores in {out}")
    return 1 if (inserted["report"]["status"] == "excluded").any() else 0


def transfer(args: Namespace) -> int:
    """Labels and landmarks of one mesh on others."""
    from s4a.analysis import transfer as travel
    from s4a.cli import tables
    from s4a.input.annotations import labels_of_mesh, read_labels, read_landmarks
    from s4a.input.collection import read_shape
    from s4a.input.landmarks import locate
    from s4a.options import DECLARED
    from s4a.study.store import check_is_study
    from s4a.study.tree import open_study

    if not (args.labels or args.landmarks):
        raise ValueError(
            "something to transfer needed: give --labels FILE, --landmarks FILE or both"
        )
    if args.blur is not None and not args.labels:
        raise ValueError("--blur is of labels: give --labels FILE, or leave it out")
    first = Path(args.targets[0])
    into_study = len(args.targets) == 1 and any(first.glob("**/registration.nc"))
    if into_study:
        check_is_study(first)
    source, label, landmarks = read_shape(args.source), None, None
    if args.labels:
        label = labels_of_mesh(read_labels(args.labels, source.sizes["file_vertex_index"]), source)
    if args.landmarks:
        landmarks = read_landmarks(args.landmarks)
        distance = locate(landmarks, source)["landmark_distance"].values
        write(
            f"{len(distance)} landmarks, at most {distance.max():.3g} from the surface of "
            f"{args.source}"
        )
    excluded = []
    asked = {n: getattr(args, n) for n, one in DECLARED.items() if one.metadata["pair"]}
    given = {name: value for name, value in asked.items() if value is not None}
    if into_study:
        study = open_study(first)
        given["source"] = source
    else:
        study, excluded = registered_pairs(source, args, given)
        given = {}  # the source is the template now, and matched
    out = new_folder(args.out)
    labels: Mapping[str, Any] = {}  # name of a target -> node
    points: Mapping[str, Any] = {}
    if label is not None:
        carried = travel.transfer_labels(study, label, blur=args.blur, **given)
        labels = carried.children
    if landmarks is not None:
        points = travel.transfer_landmarks(study, landmarks, **given).children
    write(tables.table(transferred_rows(study, labels, points, out), tables.TRANSFERRED))
    return 1 if excluded else 0


def registered_pairs(
    source: "xr.Dataset", args: Namespace, options: dict[str, Any]
) -> "tuple[xr.DataTree, list[str]]":
    """The source registered as the template of every target, and the targets that are left out."""
    from s4a.analysis.transfer import register_pairs
    from s4a.input.collection import read_shapes
    from s4a.options import Options

    shapes = read_shapes(args.targets, compare=False)
    report = shapes["report"].to_dataset()
    excluded = report["shape"].values[report["status"].values == "excluded"].tolist()
    for name in excluded:
        write(f"{name} excluded: {report['reason'].sel(shape=name).item()}")
    meshes = {name: node.to_dataset() for name, node in shapes["original"].children.items()}
    study = register_pairs(
        source,
        meshes,
        name=next(n for n in ("template", "template_", "template__") if n not in meshes),
        n_jobs=args.n_jobs,
        **{"k_init": min(Options.k_init, options.get("k", Options.k))} | options,
    )
    return study, excluded


def transferred_rows(
    study: "xr.DataTree", labels: Mapping[str, Any], points: Mapping[str, Any], out: Path
) -> list[list[Any]]:
    """Write the files of every target; the rows of the table that is shown."""
    from s4a.cli import tables
    from s4a.input.annotations import write_landmarks
    from s4a.input.files import stem_of
    from s4a.input.hands import in_file

    meshes = {name: study["original"][name].to_dataset() for name in labels or points}
    stems = {name: stem_of(mesh.attrs.get("path") or name) for name, mesh in meshes.items()}
    rows = []
    for name, mesh in meshes.items():
        stem = stems[name] if list(stems.values()).count(stems[name]) == 1 else name
        cells = tables.registration_cells(study["registration"].to_dataset().sel(shape=name))[1:]
        of_labels, of_points = ["-"] * 3, ["-"] * 2
        if labels:
            of_labels = write_labels(labels[name].to_dataset(), mesh, out, stem)
        if points:
            landmarks = points[name].to_dataset()
            place = landmarks["landmark_position"]
            landmarks["landmark_position"] = place.copy(data=in_file(mesh, place.values))
            write_landmarks(out / f"{stem}.landmarks.csv", landmarks)
            of_points = tables.landmark_cells(landmarks)
        rows.append([stem, *cells, *of_labels, *of_points])
    return rows


def write_labels(labels: "xr.Dataset", mesh: "xr.Dataset", out: Path, stem: str) -> list[str]:
    """Write labels and their confidence as NPY, a row for each vertex of the file; the cells."""
    import numpy as np

    from s4a.input.annotations import labels_of_file

    points = file_points(mesh)
    label, dropped = labels_of_file(labels["label"].values, mesh, points)
    confidence, _ = labels_of_file(labels["confidence"].values, mesh, points)
    np.save(out / f"{stem}.labels.npy", label)
    np.save(out / f"{stem}.confidence.npy", confidence)
    means = [f"{labels[name].mean().item():.2f}" for name in ("confidence", "label_share")]
    return [*means, str(dropped)]


def file_points(mesh: "xr.Dataset") -> "np.ndarray":
    """The vertices of a mesh's file (n, 3), mirrored as it; those kept, where the file is gone."""
    import numpy as np

    from s4a.input.files import read_mesh
    from s4a.input.hands import in_file
    from s4a.input.labels import read_volume

    path, label = mesh.attrs.get("path") or "", mesh.attrs.get("label")
    if Path(path).is_file():
        read = read_volume(path, label) if label else read_mesh(path)
        return in_file(mesh, read[0])
    points = np.full((mesh.sizes["file_vertex_index"], 3), np.nan)
    points[mesh["file_vertex"].values] = mesh["position"].values
    return points


def compare(args: Namespace) -> int:
    """The methods of the paper's Table 1 on pairs, or of its Table 2 on a collection."""
    from s4a.show import charts
    from s4a.study.store import ENGINE

    result: xr.Dataset | xr.DataTree
    if args.collection:
        result, names, seconds, text = compare_collection(args)
    else:
        result, names, seconds, text = compare_pairs(args)
    out = new_folder(args.out)
    result.to_netcdf(out / "compare.nc", engine=ENGINE)
    figure = charts.stacked(names, result.coords["block"].values.tolist(), seconds)
    figure.savefig(out / "compare.png", dpi=150)
    write(text)
    write(
        f"\nlengths in % of sqrt(area), times in CPU seconds of one core; "
        f"in {out}: compare.nc, compare.png"
    )
    return 0


def compare_collection(args: Namespace) -> "tuple[xr.Dataset, list[str], np.ndarray, str]":
    """Table 2: the result, names of the bars of Fig. 3, their seconds by block, and a text."""
    from s4a.cli import tables
    from s4a.evaluation import compare as comparison
    from s4a.options import N_COARSE, Options

    if args.paths or args.truth or args.landmarks or args.keep:
        raise ValueError(
            "--collection takes the shapes alone: no SOURCE, TARGET, --truth, --landmarks or --keep"
        )
    result = comparison.collection(
        args.collection,
        methods=args.methods or list(comparison.COLLECTION_METHODS),
        n_coarse=args.n_coarse or N_COARSE,
        n_pairs=args.n_pairs,
        k_init=min(Options.k_init, args.k),
        k=args.k,
        preset=args.preset,
        seed=args.seed,
    )
    names = [f"{method}, {how}" for method in result["way"].values for how in result["how"].values]
    seconds = result["collection_seconds"].values.reshape(len(names), -1)
    return result, names, seconds, tables.collection_table(result)


def compare_pairs(
    args: Namespace,
) -> "tuple[xr.Dataset | xr.DataTree, list[str], np.ndarray, str]":
    """Table 1: as :func:`compare_collection`."""
    import xarray as xr

    from s4a.cli import tables
    from s4a.evaluation import compare as comparison
    from s4a.input.files import find_meshes, slugs
    from s4a.options import N_COARSE

    if len(args.paths) < 2:
        raise ValueError("compare needs SOURCE and TARGET, or --collection PATH...")
    source, *paths = args.paths
    files = [file for target in paths for file, _ in find_meshes(target)]
    twice = [str(file) for file in files if files.count(file) > 1]
    if twice:
        raise ValueError(f"every TARGET once needed, found {twice[0]} more than once")
    targets = dict(zip(slugs(files), files, strict=True))  # in the order given, as --truth is
    result = comparison.pairs(
        source,
        targets,
        methods=args.methods,
        truth=truth_of(args.truth, targets),
        landmarks=landmark_pairs(args.landmarks, targets),
        n_coarse=args.n_coarse or N_COARSE,
        k=args.k,
        preset=args.preset,
        keep=args.keep,
        seed=args.seed,
    )
    found = result["metrics"].to_dataset() if isinstance(result, xr.DataTree) else result
    names, seconds = found["way"].values.tolist(), found["block_seconds"].mean("pair").values
    blocks = tables.block_table(names, found["block"].values.tolist(), seconds)
    return result, names, seconds, f"{tables.comparison_table(found)}\n\n{blocks}"


def truth_of(files: list[str] | None, targets: dict[str, Any]) -> "dict[str, np.ndarray] | None":
    """The truth in one file for every target, in the same order, or none."""
    from s4a.evaluation.compare import read_truth

    if not files:
        return None
    if len(files) != len(targets):
        raise ValueError(
            f"--truth needs a file for each of the {len(targets)} targets, found {len(files)}"
        )
    return {name: read_truth(file) for name, file in zip(targets, files, strict=True)}


def landmark_pairs(
    files: list[str] | None, targets: dict[str, Any]
) -> "dict[str, list[np.ndarray]] | None":
    """Positions of the landmarks that source and target both have by name, for every target.

    None where they share none.
    """
    import numpy as np

    if not files:
        return None
    if len(files) != 1 + len(targets):
        raise ValueError(
            "--landmarks needs a file for the source and each target, "
            f"{1 + len(targets)}; found {len(files)}"
        )
    source, *others = map(positions_by_name, files)
    pairs = {}
    for name, file, target in zip(targets, files[1:], others, strict=True):
        both = [landmark for landmark in source if landmark in target]
        if len(both) < 3:
            raise ValueError(
                f"{files[0]} and {file} need 3 landmarks or more of the same names, "
                f"found {len(both)}"
            )
        pairs[name] = [np.stack([end[landmark] for landmark in both]) for end in (source, target)]
    return pairs


def positions_by_name(file: str) -> "dict[str, np.ndarray]":
    """The landmarks of a file: name -> position (3,)."""
    from s4a.input.annotations import read_landmarks

    landmarks = read_landmarks(file)
    names = landmarks["landmark_name"].values.tolist()
    return dict(zip(names, landmarks["landmark_position"].values, strict=True))


def within(study: str, name: str) -> Path:
    """A file or folder to write in that of a study, which may be of a stranger.

    Neither it nor what lies in it may be a link, a pipe or a device.
    """
    place = Path(study) / name
    for path in (place, *(sorted(place.iterdir()) if place.is_dir() else [])):
        if path.is_symlink():
            raise ValueError(f"{path} is a symbolic link, and is not written through: remove it")
        if path.exists() and not path.is_file() and not path.is_dir():
            raise ValueError(f"{path} is a pipe or a device, and is not written to: remove it")
    return place


def new_folder(path: str) -> Path:
    """A folder for results, made where it is not there."""
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write(text: str) -> None:
    """One text to the output, and a new line; of what a file says, nothing moves the cursor."""
    sys.stdout.write("\n".join(map(shown, text.split("\n"))) + "\n")
