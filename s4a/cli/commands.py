"""The commands of the command line: each takes parsed arguments and returns an exit code.

The parameters of a command are its arguments and flags (:mod:`s4a.cli.flags`); its output is
formatted in :mod:`s4a.cli.tables`.  Packages are imported when they are first used, so that help
appears at once.
"""

import contextlib
import itertools
import re
import shlex
import sys
import time
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import lazy_loader

import s4a
from s4a.cli import tables
from s4a.cli.doctor import examine, lines
from s4a.cli.flags import ALL_OPTIONS, command
from s4a.options import DECLARED, N_COARSE, Options, names_of

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
else:
    np = lazy_loader.load("numpy")

DEMO_VERTICES = 5000  # whose errors are averaged: the mean is within 1 % of that of all vertices


def check(paths: list[str], **options: Any) -> int:
    """Read and clean all files, and report what was found.

    Parameters
    ----------
    paths : PATH
        folders, globs or mesh files
    """
    from s4a.input.coordinates import CoordinateSystem, common

    shapes = s4a.read_shapes(paths, **options)
    report = shapes["report"].to_dataset()
    write(*tables.decision_lines(report), tables.report_table(report))
    common({name: CoordinateSystem.of(mesh.attrs) for name, mesh in shapes["original"].items()})
    return 0 if (report["status"] != "excluded").all() else 1


def doctor(folder: str = ".") -> int:
    """Check this machine, and list what is missing and how to install it.

    Parameters
    ----------
    folder : FOLDER
        where studies will be written (default: here)
    """
    findings = examine(folder)
    missing = sum(finding.state == "missing" for finding in findings)
    notes = sum(finding.state == "note" for finding in findings)
    write(*lines(findings), f"{missing} missing, {notes} to know")
    return 1 if missing else 0


def exit_code(statuses: "list[Any]", fail_on: str, otherwise: int) -> int:
    """Return 3 if a shape has the status that --fail-on names, or is excluded with "flagged"."""
    failed = {"none": [], "excluded": ["excluded"], "flagged": ["flagged", "excluded"]}[fail_on]
    return 3 if any(np.isin(status, failed).any() for status in statuses) else otherwise


def run(
    paths: list[str],
    *,
    out: str,
    cluster: str | None = None,
    fail_on: Literal["none", "excluded", "flagged"] = "none",
    words: list[str],
    **options: Any,
) -> int:
    """Analyse a folder of meshes: correspondences, median shape, modes of variation.

    Parameters
    ----------
    paths : PATH
        folders, globs or mesh files
    out : FOLDER
        folder of the study; an unfinished one is resumed
    cluster : ADDRESS
        dask scheduler tcp://host:port, or local:N worker processes
    fail_on
        end with exit code 3 if shapes are excluded, or also if they are flagged

    Examples
    --------
    s4a run meshes -o study
    s4a run meshes -o study --table subjects.csv -j 4 --n-coarse 3000
    s4a run scans -o study --label 17 --preset fast
    """
    full = within(out, "report.txt")
    with on_cluster(cluster):
        study = s4a.analyse([*paths], store=out, **options)
    again = shlex.join(["s4a", *(word for word in words if word != "--include-flagged")])
    report = study["report"].to_dataset()
    lines = [tables.report_table(report), *tables.cost_lines(report)]
    full.write_text("\n".join(lines) + "\n", encoding="utf-8")
    write(tables.run_summary(study, again=again), *tables.place_lines(out, str(full)))
    return exit_code([report["status"]], fail_on, 1 if study["report"].attrs["unforeseen"] else 0)


@contextlib.contextmanager
def on_cluster(address: str | None) -> Iterator[None]:
    """Run the tasks of joblib on a dask scheduler, if there is an address.

    ``tcp://host:port``, or ``local:N`` for N processes on this machine.  The workers must see the
    folder of the study under the same path.
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

    with contextlib.ExitStack() as stack:
        if known[1]:
            n = int(known[1])
            local = LocalCluster(n_workers=n, threads_per_worker=1, dashboard_address=None)
            address = stack.enter_context(local).scheduler_address
        stack.enter_context(Client(address))
        stack.enter_context(parallel_config(backend="dask"))
        yield


def demo(
    *,
    out: str = "demo",
    shapes: int = 12,
    vertices: int = 40_000,
    dirty: bool = False,
    open: bool = False,
    seed: int,
    **options: Any,
) -> int:
    """Analyse simulated brains, compare with the ground truth, and write a page.

    Parameters
    ----------
    out : FOLDER
        folder of the study
    shapes : N
        number of shapes
    vertices : N
        number of vertices of each shape
    dirty
        add loose parts, holes and non-manifold edges
    open
        open the page in a browser
    """
    n_jobs = options["n_jobs"]
    collection = s4a.synthetic.brains(shapes, vertices, seed, dirty=dirty, n_jobs=n_jobs)
    study = s4a.analyse(collection, store=out, seed=seed, **options)
    truth: Any = collection["truth"]

    def image(shape, template):
        return s4a.synthetic.position(truth, shape, truth[template]["reference_point"].values)

    write(tables.run_summary(study))
    if "pca" in study:
        write(f"\npicture: {s4a.write_picture(study, Path(out) / 'modes.png')}")
    errors = s4a.evaluation.accuracy.accuracy(study, image, n_vertices=DEMO_VERTICES, n_jobs=n_jobs)
    write("", tables.error_table(errors))
    if "pca" in study:
        write(tables.true_line(study["pca"].to_dataset(), truth.to_dataset()))
    page = Path(out) / "study.html"
    s4a.write_page(study, page, title="Synthetic brains")
    write(f"\npage: {page}")
    if open:
        webbrowser.open(page.resolve().as_uri())
    return 0


def verify(study: str) -> int:
    """Verify checksums and provenance of every file of a study.

    Parameters
    ----------
    study : STUDY
        folder of the study
    """
    found = s4a.verify(study)
    write(tables.verify_lines(found))
    return 1 if tables.count_faults(found) else 0


def status(study: str) -> int:
    """Show the progress of a run.

    Parameters
    ----------
    study : STUDY
        folder of the study
    """
    write(tables.status_lines(s4a.study.progress.status(study), time.time()))
    return 0


def view(
    study: str,
    *,
    page: str | None = None,
    title: str | None = None,
    view: str = "corner",
    up: Literal["x", "y", "z"] = "z",
) -> int:
    """Write a self-contained HTML page of a study.

    Parameters
    ----------
    study : STUDY
        folder of the study
    page : FILE
        file to write (default: STUDY/study.html)
    title : TITLE
        title of the page (default: name of the folder)
    view : VIEW
        viewpoint: corner, front, back, left, right, top or bottom (default: corner)
    up
        axis that points up
    """
    tree = s4a.open_study(study)
    file = Path(page) if page else within(study, "study.html")
    if file.is_dir() or not file.parent.is_dir():
        raise ValueError(f"--page needs a file in an existing folder; found {page}")
    s4a.write_page(tree, file, title=title or Path(study).name, view=view, up=up)
    write(f"wrote {file} ({file.stat().st_size / 1e6:.1f} MB)")
    return 0


def statistics(
    study: str,
    *,
    group: str | None = None,
    regress_on: str | None = None,
    covariates: list[str] | None = None,
    table: str | None = None,
    variances: Literal["equal", "unequal"] = "equal",
    include_flagged: bool = False,
    permutations: int | None = None,
    out: str | None = None,
    seed: int,
) -> int:
    """Evaluate the modes of variation, find outliers, and test groups and variables.

    Parameters
    ----------
    study : STUDY
        folder of the study
    group : COLUMN
        column of groups: test and map their difference, and classify the shapes
    regress_on : COLUMN
        column of numbers, such as age: regress shape on it, and write an animation
    covariates : COLUMN
        covariates of these tests, separated by spaces or commas
    table : PATH
        CSV with a column 'shape', in place of the table of the study
    variances
        variances of the residuals; unequal if groups have different covariance
    include_flagged
        include flagged shapes
    permutations : N
        permutations per test (default: 9999; 999 at every vertex; 99 for classification)
    out : FOLDER
        folder for netCDF and CSV files (default: STUDY/statistics)
    """
    if covariates and not (group or regress_on):
        raise ValueError("--covariates needs a test: give --group or --regress-on")
    tree, out = study_to_test(study, out, table, include_flagged)
    options = {"covariates": covariates, "seed": seed, "variances": variances}
    write_statistics(tree, out, group, regress_on, permutations, options)
    return 0


def write_statistics(
    tree: "xr.DataTree",
    out: str,
    group: str | None,
    variable: str | None,
    permutations: int | None,
    options: dict[str, Any],
) -> None:
    """Evaluate and test a study, write the results to a folder, and print them."""
    results = _tests_of(tree, group, variable, permutations, options)  # first: these may be refused
    results["evaluation"] = s4a.statistics.evaluate(tree, seed=options["seed"])
    results["outliers"] = s4a.statistics.outliers(tree)
    for name, result in results.items():
        s4a.analysis.export.write_results(result, out, name)
    write(tables.evaluation_table(results["evaluation"]))
    outlier = results["outliers"]["outlier"]
    write(f"\noutliers: {', '.join(outlier['shape'].values[outlier.values]) or 'none'}")
    if group:
        of = f"groups of {group}"
        write("", tables.significance(results["group"], results["group_map"], of, tree))
        write(tables.classification_line(results["classification"]))
    if variable:
        regression = results["regression"]
        write("", tables.significance(regression, regression, variable, tree))
        moving = s4a.statistics.regression_modes(tree, regression, variable)
        page = Path(out) / "regression.html"
        s4a.write_page(moving, page, title=f"Regression on {variable}")
        s4a.write_film(moving, page.with_suffix(".gif"))
    confidence = tree["registration"]["confidence"].mean().item()
    write(f"\nmean confidence of the registration {confidence:.2f}; results: {out}")


def study_to_test(
    study: str, out: str | None, table: str | None, include_flagged: bool
) -> "tuple[xr.DataTree, str]":
    """Return the study with the chosen table and shapes, and the folder of the results."""
    tree, out = s4a.open_study(study), out or str(within(study, "statistics"))
    tree = s4a.input.subjects.with_table(tree, table) if table else tree
    tree = s4a.statistics.with_flagged(tree) if include_flagged else tree
    if flagged := s4a.study.tree.left_out(tree):
        write(
            f"{len(flagged)} flagged shapes are excluded, --include-flagged includes them: "
            f"{s4a.input.plausibility.listed(flagged, 200)}\n"
        )
    return tree, out


def labels_in(file: str, mesh: "xr.Dataset") -> "np.ndarray":
    """Return the labels of a mesh from a file with a label for each vertex of the mesh file."""
    label = s4a.input.annotations.read_labels(file, mesh.sizes["file_vertex_index"])
    return s4a.input.annotations.labels_of_mesh(label, mesh)


def _tests_of(study, group, variable, permutations, options):
    """Return the results of the tests of the group and of the variable."""
    of_classes = {"seed": options["seed"]}
    if permutations is not None:
        options = options | {"n_permutations": permutations}
        of_classes["n_permutations"] = min(permutations, 99)  # each trains again
    results = {}
    if group:
        results["group"] = s4a.statistics.group_test(study, group, **options)
        results["group_map"] = s4a.statistics.group_map(study, group, **options)
        results["classification"] = s4a.statistics.classify(study, group, **of_classes)
    if variable:
        results["regression"] = s4a.statistics.regression(study, variable, **options)
    return results


def insert(
    study: str,
    shapes: list[str],
    *,
    out: str,
    landmarks: str | None = None,
    reflect: str | None = None,
    fail_on: Literal["none", "excluded", "flagged"] = "none",
    n_jobs: int,
    **system: Any,
) -> int:
    """Register new shapes to a finished study, which stays unchanged.

    Parameters
    ----------
    study : STUDY
        folder of the study
    shapes : SHAPE
        mesh files, label volumes, folders or globs
    out : FOLDER
        folder for inserted.nc, registered meshes and scores
    landmarks : PATH
        folder of landmark files named as the shapes, which guide registration
    reflect : NAMES
        new shapes to mirror: names separated by commas; or auto, those mirrored to the study
    fail_on
        end with exit code 3 if shapes are excluded, or also if they are flagged
    """
    tree = s4a.open_study(study)
    given = {"landmarks": landmarks, "reflect": reflect, "n_jobs": n_jobs} | system
    inserted = s4a.insert(tree, shapes, **given)
    folder = s4a.input.raw.new_folder(out)
    path = s4a.study.tree.write_inserted(inserted, folder)
    s4a.write_registered(inserted, folder)
    write(tables.inserted_table(inserted), "")
    write(f"written: {path}, registered meshes and scores in {folder}")
    status = inserted["report"]["status"]
    return exit_code([status], fail_on, 1 if (status == "excluded").any() else 0)


def transfer(
    source: str,
    targets: list[str],
    *,
    labels: str | None = None,
    source_landmarks: str | None = None,
    out: str,
    blur: float | None = None,
    fail_on: Literal["none", "excluded", "flagged"] = "none",
    n_jobs: int,
    **options: Any,
) -> int:
    """Transfer labels and landmarks of one mesh to others.

    Parameters
    ----------
    source : SOURCE
        mesh file that the labels and landmarks belong to
    targets : TARGET
        mesh files, folders or globs; or one study folder, whose options are used
        unless you give others
    labels : FILE
        labels of the source's vertices: NPY, NPZ (FILE:NAME), CSV, GIFTI label or FreeSurfer
        annot, also .gz
    source_landmarks : FILE
        landmarks and curves of the source: Slicer .mrk.json or .fcsv, CSV, TPS, .pts or MeshLab .pp
    out : FOLDER
        folder for <target>.labels.npy, .confidence.npy, .landmarks.csv
    blur : X
        smooth the votes for labels over this multiple of the estimated match error; 0: not at all
        (default: 1; 0 with --preset paper)
    fail_on
        end with exit code 3 if targets are excluded, or also if they are flagged
    """
    if not (labels or source_landmarks):
        raise ValueError("nothing to transfer: give --labels FILE, --source-landmarks FILE or both")
    if blur is not None and not labels:
        raise ValueError("--blur needs labels: give --labels FILE, or leave it out")
    into_study = len(targets) == 1 and any(Path(targets[0]).glob("**/registration.nc"))
    if into_study:
        s4a.study.store.check_is_study(Path(targets[0]))
    system = {name: options[name] for name in SYSTEM}
    mesh, label, points = s4a.read_shape(source, **system), None, None
    if labels:
        label = labels_in(labels, mesh)
    if source_landmarks:
        points = s4a.input.annotations.read_landmarks(source_landmarks)
        points = s4a.input.coordinates.with_system(points, **system)
        distance = s4a.input.landmarks.locate(points, mesh)["landmark_distance"].values
        far = f"at most {distance.max():.3g} from the surface of {source}"
        write(f"{len(distance)} landmarks, {far}")
    given = {name: value for name, value in options.items() if value is not None}
    excluded: list[str] = []
    if into_study:
        study = s4a.open_study(targets[0])
        given["source"] = mesh
    else:
        study, excluded = registered_pairs(mesh, targets, n_jobs, given)
        given = {}  # the source is the template now, and matched
    folder, carried = s4a.input.raw.new_folder(out), {}
    if label is not None:
        carried["labels"] = s4a.transfer_labels(study, label, blur=blur, **given)
    if points is not None:
        carried["landmarks"] = s4a.transfer_landmarks(study, points, **given)
    rows = _transferred_rows(study, carried, folder)
    registered = {n: node.attrs for n, node in study["registration"].children.items()}
    warned = {n: attrs for n, attrs in registered.items() if attrs.get("warning")}
    lines = (f"{n} {attrs['status']}: {attrs['warning']}" for n, attrs in warned.items())
    write(tables.table(rows, tables.TRANSFERRED), *lines)
    statuses = [attrs["status"] for attrs in warned.values()] + ["excluded"] * len(excluded)
    return exit_code([statuses], fail_on, 1 if excluded else 0)


def registered_pairs(
    source: "xr.Dataset", targets: list[str], n_jobs: int, options: dict[str, Any]
) -> "tuple[xr.DataTree, list[str]]":
    """Register the source to every target; return the study and the excluded targets."""
    shapes = s4a.read_shapes(targets, compare=False)
    report = shapes["report"].to_dataset()
    excluded = report["shape"].values[report["status"].values == "excluded"].tolist()
    for remark in report.attrs["remarks"].splitlines():
        write(remark)
    for name in excluded:
        write(f"{name} excluded: {report['reason'].sel(shape=name).item()}")
    meshes = {name: node.to_dataset() for name, node in shapes["original"].children.items()}
    name = next(n for n in ("template", "template_", "template__") if n not in meshes)
    options = {"k_init": min(Options.k_init, options.get("k", Options.k))} | options
    return s4a.register_pairs(source, meshes, name=name, n_jobs=n_jobs, **options), excluded


def _transferred_rows(study, carried, out):
    """Write the files of every target, and return the rows of the table that is printed."""
    first, *_ = carried.values()
    meshes = {name: study["original"][name].to_dataset() for name in first.children}
    stems = {
        name: s4a.input.files.stem_of(mesh.attrs.get("path") or name)
        for name, mesh in meshes.items()
    }
    rows = []
    for name, mesh in meshes.items():
        stem = stems[name] if list(stems.values()).count(stems[name]) == 1 else name
        cells = tables.registration_cells(study["registration"].to_dataset().sel(shape=name))[1:]
        of_labels, of_points = ["-"] * 3, ["-"] * 2
        if "labels" in carried:
            of_labels = _write_labels(carried["labels"][name].to_dataset(), mesh, out, stem)
        if "landmarks" in carried:
            landmarks = carried["landmarks"][name].to_dataset()
            place = landmarks["landmark_position"]
            X = s4a.input.chirality.in_file(mesh, place.values)
            landmarks["landmark_position"] = place.copy(data=X)
            s4a.input.annotations.write_landmarks(out / f"{stem}.landmarks.csv", landmarks)
            of_points = tables.landmark_cells(landmarks)
        rows.append([stem, *cells, *of_labels, *of_points])
    return rows


def _write_labels(labels, mesh, out, stem):
    """Write labels and confidence as NPY, a row for each vertex of the file; return the cells."""
    points = _file_points(mesh)
    for name in ("label", "confidence"):
        values, dropped = s4a.input.annotations.labels_of_file(labels[name].values, mesh, points)
        np.save(out / f"{stem}.{'labels' if name == 'label' else name}.npy", values)
    means = [f"{labels[name].mean().item():.2f}" for name in ("confidence", "label_share")]
    return [*means, str(dropped)]


def _file_points(mesh):
    """Return the vertices of a mesh file (n, 3); NaN for dropped ones if the file is gone."""
    path, label = mesh.attrs.get("path") or "", mesh.attrs.get("label")
    if Path(path).is_file():
        read = s4a.input.labels.read_volume(path, label) if label else s4a.read_mesh(path)
        return s4a.input.chirality.in_file(mesh, read[0], back=True)
    points = np.full((mesh.sizes["file_vertex_index"], 3), np.nan)
    points[mesh["file_vertex"].values] = mesh["position"].values
    return points


def compare(
    paths: list[str] | None = None,
    *,
    collection: list[str] | None = None,
    methods: list[str] | None = None,
    truth: list[str] | None = None,
    landmarks: list[str] | None = None,
    keep: bool = False,
    out: str = "compare",
    preset: Literal["paper"] | None = None,
    n_pairs: int,
    **options: Any,
) -> int:
    """Compare the methods of the paper on pairs (Table 1) or on a collection (Table 2).

    Parameters
    ----------
    paths : SOURCE TARGET
        the reference mesh and one or more others
    collection : PATH
        folders, globs or mesh files of the collection of Table 2
    methods : METHOD
        some of kNN, ZO, FMAP+ZO, SCALABLE, RE-MATCH, 'RE-MATCH refined', registered,
        'registered surface' (quote names with spaces)
    truth : FILE
        one file per target (NPY or text) with one row per vertex of the target: index of the
        source vertex (from 0; -1 for none), or its x, y, z
    landmarks : PATH
        landmark files of the source and of each target, whose common names guide registration:
        Slicer .mrk.json or .fcsv, CSV, TPS, .pts or MeshLab .pp
    keep
        also write meshes, matches and maps to compare.nc, for s4a.widgets.Comparison
    out : FOLDER
        folder for compare.nc and compare.png
    preset
        the methods and options of the paper
    """
    options |= {"preset": preset, "n_coarse": options["n_coarse"] or N_COARSE}
    if collection:
        if paths or truth or landmarks or keep:
            raise ValueError(
                "--collection takes the shapes alone: no SOURCE, TARGET, --truth, --landmarks or "
                "--keep"
            )
        options |= {"n_pairs": n_pairs, "k_init": min(Options.k_init, options["k"])}
        options |= {"methods": methods} if methods else {}
        result = found = s4a.compare_collection(collection, **options)
        ways = itertools.product(found["algorithm"].values, found["dense_match"].values)
        names = [", ".join(way) for way in ways]
        seconds = found["collection_seconds"].values.reshape(len(names), -1)
        text = tables.collection_table(found)
    else:
        result = _compare_pairs(paths or [], truth, landmarks, options | {"methods": methods}, keep)
        found = result["metrics"].to_dataset() if keep else result
        names = found["algorithm"].values.tolist()
        seconds = found["block_seconds"].mean("pair").values
        rows = [[name, *row, row.sum()] for name, row in zip(names, seconds, strict=True)]
        blocks = tables.table(rows, ["CPU s", *found["block"].values.tolist(), "all"], ".1f")
        text = f"{tables.comparison_table(found)}\n\n{blocks}"
    folder = s4a.input.raw.new_folder(out)
    result.to_netcdf(folder / "compare.nc", engine="h5netcdf")
    figure = s4a.show.charts.stacked(names, result.coords["block"].values.tolist(), seconds)
    figure.savefig(folder / "compare.png", dpi=150)
    write(
        text,
        "\nlengths in % of sqrt(area), times in CPU seconds of one core; "
        f"in {folder}: compare.nc, compare.png",
    )
    return 0


def _compare_pairs(paths, truth, landmarks, options, keep):
    """Return Table 1 of pairs, as a Dataset, or with `keep` as a DataTree."""
    if len(paths) < 2:
        raise ValueError("compare needs SOURCE and TARGET, or --collection PATH...")
    source, *targets = paths
    files = [file for target in targets for file, _ in s4a.input.files.find_meshes(target)]
    twice = [str(file) for file in files if files.count(file) > 1]
    if twice:
        raise ValueError(f"every TARGET once needed, found {twice[0]} more than once")
    names = s4a.input.files.slugs(files)  # in the order given, as --truth is
    if truth and len(truth) != len(files):
        raise ValueError(
            f"--truth needs a file for each of the {len(files)} targets, found {len(truth)}"
        )
    known = map(s4a.evaluation.comparison.read_ground_truth, truth or [])
    return s4a.compare(
        source,
        dict(zip(names, files, strict=True)),
        truth=dict(zip(names, known, strict=True)) if truth else None,
        landmarks=_landmark_pairs(landmarks, names),
        keep=keep,
        **options,
    )


def _landmark_pairs(files, targets):
    """Return the landmarks that the source and each target have in common."""
    if not files:
        return None
    if len(files) != 1 + len(targets):
        raise ValueError(
            "--landmarks needs a file for the source and each target, "
            f"{1 + len(targets)}; found {len(files)}"
        )
    source, *others = map(s4a.input.annotations.read_landmarks, files)
    pairs = {}
    for name, file, target in zip(targets, files[1:], others, strict=True):
        names_of = [marks["landmark_name"].values.tolist() for marks in (source, target)]
        both = [mark for mark in names_of[0] if mark in names_of[1]]
        if len(both) < 3:
            raise ValueError(
                f"{files[0]} and {file} need 3 landmarks or more of the same names, "
                f"found {len(both)}"
            )
        at = [[own.index(mark) for mark in both] for own in names_of]
        pairs[name] = [source.isel(landmark=at[0]), target.isel(landmark=at[1])]
    return pairs


def within(study: str, name: str) -> Path:
    """Return a path to write to in the folder of a study, which may come from a stranger.

    Neither the path nor the files in it may be a link, a pipe or a device.
    """
    place = Path(study) / name
    for path in (place, *(sorted(place.iterdir()) if place.is_dir() else [])):
        if path.is_symlink():
            raise ValueError(f"{path} is a symbolic link, which would be followed: remove it")
        if path.exists() and not path.is_file() and not path.is_dir():
            raise ValueError(f"{path} is a pipe or a device, not a file: remove it")
    return place


def write(*texts: str) -> None:
    """Print texts; control characters from files are escaped, so that none moves the cursor."""
    from s4a.input.raw import shown  # not through s4a, which may be broken when doctor runs

    lines = [shown(line) for text in texts for line in text.split("\n")]
    sys.stdout.write("\n".join(lines) + "\n")


OF_PAIRS = [name for name, one in DECLARED.items() if one.metadata["pair"]]
SYSTEM = ("coordinate_system", "unit")
COMMANDS = {
    "doctor": command(doctor),
    "check": command(check, ("pattern", *names_of("cleaning"), "intersections")),
    "run": command(run, ALL_OPTIONS),
    "verify": command(verify),
    "status": command(status),
    "demo": command(demo, ("preset", "n_jobs", "seed")),
    "view": command(view),
    "statistics": command(statistics, ("seed",)),
    "insert": command(insert, ("n_jobs", *SYSTEM)),
    "transfer": command(transfer, (*OF_PAIRS, "n_jobs"), unset=True),
    "compare": command(compare, ("n_coarse", "n_pairs", "k", "seed")),
}
