"""Output of the commands: results as tables and sentences, Tables 1 and 2 and Fig. 3 as text.

Every function returns a text or the cells of a row; nothing is printed or written here.
"""

import itertools
import shlex
import textwrap
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import lazy_loader

import s4a

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from s4a.input.plausibility import Decision
    from s4a.study.progress import Stage, Status
else:
    np = lazy_loader.load("numpy")  # so that a command starts at once

COUNTS = {
    "file_vertices": "vertices",
    "components": "components",
    "genus": "genus",
    "holes": "holes",
    "nonmanifold_edges": "non-manifold",
}
# metric: (head of its column, factor, digits)
METRICS = {
    "geodesic_error": ("error %", 100, 3),
    "euclidean_error": ("Euclidean %", 100, 3),
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
SCREEN, LINES = 100, 40  # columns and lines of a summary
LEAST, MOST_REMARKS = 5, 6  # excluded shapes at least, and remarks at most, with lines of their own
LONGEST = 24  # letters of a name
LARGEST = 3  # stages whose time a summary says
TRANSFERRED = (
    *("target", "cycle error", "|distortion|", "confidence", "share of votes"),
    *("labels of dropped vertices", "landmarks", "disagreement"),
)


def table(rows: Iterable[Sequence[Any]], head: Sequence[str], number: str = "g") -> str:
    """Return rows of text as aligned columns.

    Numbers are aligned to the right, floats in the format `number`, NaN as "-"; the last column is
    wrapped at 120 characters.

    Examples
    --------
    >>> from s4a.cli.tables import table
    >>> print(table([["a", 1], ["b", 20]], ["name", "n"]))
    name   n
    a      1
    b     20
    """
    rows = [
        [(f"{x:{number}}" if x == x else "-") if isinstance(x, float) else str(x) for x in row]
        for row in [head, *rows]
    ]
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    numeric = [all(map(is_number, column[1:])) for column in columns]
    margin = sum(widths[:-1]) + 2 * (len(head) - 1)
    lines = []
    for *cells, long in rows:
        first, *rest = wrapped(long, max(120 - margin, 40)) or [""]
        layout = zip([*cells, first], widths, numeric, strict=True)
        lines.append("  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in layout).rstrip())
        lines += [" " * margin + line for line in rest]
    return "\n".join(lines)


def is_number(cell: str) -> bool:
    """Return whether a cell is aligned to the right."""
    return cell == "-" or cell.replace(".", "", 1).isdigit()


def wrapped(text: str, width: int, indent: str = "", later: str | None = None) -> list[str]:
    """Wrap a text at blanks only, so that paths and words stay whole.

    Examples
    --------
    >>> from s4a.cli.tables import wrapped
    >>> wrapped("16 edges of zero-area triangles", 14)
    ['16 edges of', 'zero-area', 'triangles']
    """
    return textwrap.wrap(
        text,
        width,
        initial_indent=indent,
        subsequent_indent=indent if later is None else later,
        break_long_words=False,
        break_on_hyphens=False,
    )


def report_table(report: "xr.Dataset") -> str:
    """Return a row for every shape, with what was found and repaired, and warnings, below it."""
    rows, texts = [], []
    for name in report["shape"].values:
        shape = report.sel(shape=name)
        counts = [int(shape[count]) if count in shape else -1 for count in COUNTS]
        cells = ["-" if count < 0 else count for count in counts]
        system = shape["coordinate_system"].item() if "coordinate_system" in shape else ""
        rows.append([name, *cells, shape["status"].item(), system])
        warning = shape["warning"].item()
        texts.append([shape["reason"].item(), f"warning: {warning}" if warning else ""])
    head, *lines = table(rows, ["shape", *COUNTS.values(), "status", "coordinates"]).splitlines()
    whole = [head]
    for line, below in zip(lines, texts, strict=True):
        whole.append(line)
        for text in below:
            whole += wrapped(text, SCREEN, "    ")
    for remark in report.attrs["remarks"].splitlines():
        whole += wrapped(remark, SCREEN, "  ")
    return "\n".join(whole)


FAULTS = ("damaged", "missing", "stale")  # states of files that make a study invalid


def count_faults(found: "xr.Dataset") -> int:
    """Return the number of files of :func:`s4a.verify` that make the study invalid."""
    return int(np.isin(found["state"].values, FAULTS).sum())


def verify_lines(found: "xr.Dataset") -> str:
    """Return a summary of :func:`s4a.verify`, and a line for each file with a fault.

    Examples
    --------
    >>> from s4a.cli.tables import verify_lines
    >>> from s4a.schema import dataset
    >>> found = dataset(state=["whole", "whole"], fault=["", ""])
    >>> print(verify_lines(found.assign_coords(file=["latent.nc", "pca.nc"])))
    2 files: 2 whole
    """
    states = found["state"].values.tolist()
    counts = {state: states.count(state) for state in ["whole", *states]}
    line = f"{len(states)} files: {', '.join(f'{n} {state}' for state, n in counts.items())}"
    if count_faults(found):
        line += "; run the same `s4a run` again to compute these files again"
    rows = zip(found["file"].values, states, found["fault"].values, strict=True)
    return "\n".join(
        [line, *(f"  {file}, {state}: {fault}" for file, state, fault in rows if fault)]
    )


def status_lines(status: "Status", now: float) -> str:
    """Return the progress of a run at a time in seconds since 1970: a line for each stage."""
    since, last = (time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(t)) for t in status[3:5])
    heads = {
        "running": f"running since {since}: process {status.owner} and {status.processes - 1} "
        f"below it, {status.memory:.0f} MiB now",
        "finished": f"finished at {last}",
        "stopped": f"stopped, last seen at {last}; the same command resumes the run",
        "elsewhere": f"on {status.host}, another machine: last seen at {last}",
    }
    known = (
        status.stages
        if status.state == "finished"
        else [*s4a.study.progress.STAGES, *status.stages]
    )
    goes_on = status.state in ("running", "elsewhere")
    rows = [
        [name, *stage_cells(status.stages.get(name), goes_on, now)] for name in dict.fromkeys(known)
    ]
    lines = [heads[status.state], table(rows, ["stage", "done", "of", "s", "peak MiB", "s left"])]
    failures = [sentence_lines(f"left out: {n}: ", why) for n, why in status.failures.items()]
    return "\n".join([*lines, *with_rest(failures, LEAST)])


def stage_cells(stage: "Stage | None", goes_on: bool, now: float) -> list[str]:
    """Return the progress of a stage and its costs."""
    if stage is None:
        return ["-"] * 5
    runs = goes_on and not stage.ended
    cells = [stage.done, stage.all, stage.seconds + (now - stage.begun if runs else 0)]
    left = stage.remaining(now) if runs else np.nan
    return [
        *(f"{cell:.0f}" for cell in cells),
        f"{stage.memory:.0f}" if stage.ended else "-",
        "-" if np.isnan(left) else f"about {left:.0f}",
    ]


def with_rest(texts: list[list[str]], most: int) -> list[str]:
    """Return the lines of some texts, the first and others up to `most` lines, and how many more.

    Examples
    --------
    >>> from s4a.cli.tables import with_rest
    >>> with_rest([["a", "goes on"], ["b"], ["c"]], 3)
    ['a', 'goes on', 'b', '  and 1 more']
    """
    ends = np.cumsum([len(lines) for lines in texts])
    n = max(int((ends <= most).sum()), 1)
    more = [f"  and {len(texts) - n} more"] if len(texts) > n else []
    return [*itertools.chain.from_iterable(texts[:n]), *more]


def run_summary(study: "xr.DataTree", *, again: str = "s4a run FOLDER --out STUDY") -> str:
    """Return the summary of a run, on one screen: decisions, shapes, results.

    Parameters
    ----------
    study : DataTree
    again : str
        The command of the run, to which flags can be added.
    """
    report = study["report"].to_dataset()
    before = ["", *decision_lines(report, again), *remark_lines(report)]
    after = [status_line(report), "", *result_lines(study), *cost_lines(report, LARGEST)]
    room = LINES - len(before) - len(after) - 6  # for the lines around them and place_lines
    return "\n".join([*before, *excluded_lines(report, max(room, LEAST)), *after])


def result_lines(study: "xr.DataTree") -> list[str]:
    """Return the median shape, the quality of the registration and the variance explained."""
    registration = s4a.analysis.inputs.registration_of(study)
    latent = study["latent"].to_dataset()
    distance = latent["distance_to_limit"].sortby(latent["distance_to_limit"])[:3]
    median, template, *nearest = s4a.input.plausibility.shortened(
        [latent.attrs["median"], registration.attrs["template"], *distance["shape"].values], LONGEST
    )
    near = ", ".join(f"{n} {d:.4f}" for n, d in zip(nearest, distance.values, strict=True))
    confidence, round_trip, distortion = registration_cells(registration)
    if "pca" in study:
        ratio = 100 * study["pca"].to_dataset()["explained_variance_ratio"].cumsum().values
        shares = [f"{ratio[c - 1]:.1f} % by {c}" for c in (1, 3, 10) if c <= len(ratio)]
        modes = f"variance explained: {', '.join(shares)}"
    else:
        modes = f"no modes: {study['report'].attrs['no_modes']}"
    return [
        *wrapped(f"median shape: {median}; nearest to the limit shape (eq. 5): {near}", SCREEN),
        *wrapped(
            f"registered to {template}; mean confidence {confidence}, "
            f"cycle error {round_trip} of sqrt(area), median |distortion| {distortion}",
            SCREEN,
        ),
        *wrapped(modes, SCREEN),
    ]


def cost_lines(report: "xr.Dataset", most: int | None = None) -> list[str]:
    """Return the seconds of all stages, or of the longest ones, and the peak memory."""
    spent = dict(zip(report["stage"].values.tolist(), report["seconds"].values, strict=True))
    shown = sorted(spent, key=lambda stage: -spent[stage])[:most] if most else spent
    parts = ", ".join(f"{stage} {spent[stage]:.1f}" for stage in shown)
    memory = report["peak_memory"].values.max()
    all_of_them = s4a.study.tree.seconds_of(report)
    return wrapped(f"{all_of_them}, at most {memory:.0f} MiB ({parts})", SCREEN)


def place_lines(study: str, report: str) -> list[str]:
    """Return where the study is, how to view it, and where the report on every shape is."""
    parts = [f"study: {study}", f"pictures: s4a view {study}", f"every shape: {report}"]
    line = "; ".join(parts)
    return [line] if len(line) <= SCREEN else parts


def decision_lines(report: "xr.Dataset", again: str = "s4a run FOLDER --out STUDY") -> list[str]:
    """Return the flagged shapes by kind, with remedies and the commands for them."""
    n = int((report["status"] == "flagged").sum())
    if not n:
        return []
    kept = s4a.options.kept_options(report).get("include_flagged")
    become = "included" if kept else "excluded from modes, statistics and the median"
    lines = [f"TO DECIDE: {n} of {report.sizes['shape']} shapes are flagged and {become}"]
    lines += kind_lines(s4a.input.plausibility.decisions(report))
    if kept:
        return [*lines, *command_lines("to exclude them:", again, "", "--include-flagged"), ""]
    return [
        *lines,
        "  to exclude one permanently: remove its file and run again; nothing else changes",
        *command_lines("to include all of them:", again, "--include-flagged"),
        "",
    ]


def command_lines(what: str, command: str, flag: str = "", without: str = "") -> list[str]:
    """Return a command for a shell in lines that fit on the screen, in words if it is long.

    Parameters
    ----------
    what : str
        Purpose of the command.
    command : str
        The command without the flags.
    flag, without : str
        A flag to add, or a flag of the run that is left out.

    Examples
    --------
    >>> from s4a.cli.tables import command_lines
    >>> command_lines("to include all of them:", "s4a run d --out s", "--include-flagged")
    ['  to include all of them: s4a run d --out s --include-flagged']
    >>> command_lines("to include them:", "s4a run " + 400 * "a.ply ", "--include-flagged")
    ['  to include them: the same command with --include-flagged']
    """
    words = [shlex.quote(word).replace(" ", "\0") for word in shlex.split(f"{command} {flag}")]
    lines = wrapped(f"  {what} {' '.join(words)}", SCREEN - 2, "", " " * 6)
    if len(lines) > 3 or max(map(len, lines)) > SCREEN - 2:
        return [f"  {what} the same command {f'with {flag}' if flag else f'without {without}'}"]
    return " \\\n".join(lines).replace("\0", " ").split("\n")


def kind_lines(found: "list[Decision]") -> list[str]:
    """Return a line for each kind: number of shapes, their names, what to do."""
    lines = []
    for one in found:
        room = SCREEN - len(one.kind) - len(one.remedy) - 12
        letters = max(min(LONGEST, room - len(", 999 more")), 5)
        names = s4a.input.plausibility.listed(one.names, room, letters)
        lines.append(f"{len(one.names):3} {one.kind}  {names}  -> {one.remedy}")
    return lines


def excluded_lines(report: "xr.Dataset", most: int) -> list[str]:
    """Return the shapes that could not be used with their reasons, at most so many."""
    out = report.sel(shape=report["status"].values == "excluded")
    names = s4a.input.plausibility.shortened(out["shape"].values.tolist(), 20)
    if not names:
        return []
    width, lines = max(map(len, names)), []
    for name, reason, path in zip(names, out["reason"].values, out["path"].values, strict=True):
        head = f"  {name.ljust(width)}  "
        lines.append(sentence_lines(head, short_reason(reason, path)))
    head = f"{len(names)} of {report.sizes['shape']} shapes cannot be used:"
    return [head, *with_rest(lines, most), ""]


def sentence_lines(head: str, text: str) -> list[str]:
    """Return a head and the first sentences of a text, one at least, in lines of a screen."""
    return wrapped(
        f"{head}{s4a.input.raw.sentences(text, SCREEN - len(head))}", SCREEN, "", " " * len(head)
    )


def short_reason(reason: str, path: str) -> str:
    """Return why a shape is excluded, without the stage and the path.

    Examples
    --------
    >>> from s4a.cli.tables import short_reason
    >>> short_reason("read and clean: d/a.ply: d/a.ply cannot be read: found 0 bytes", "d/a.ply")
    'cannot be read: found 0 bytes'
    """
    reason = reason.removeprefix("read and clean: ")
    if not path:
        return reason
    reason = reason.removeprefix(f"{path}: ").removeprefix(f"{path} ")
    folder, slash, file = path.rpartition("/")
    return reason.replace(folder + slash, "").removeprefix(f"{file} ")


def remark_lines(report: "xr.Dataset") -> list[str]:
    """Return sentences of the remarks on the collection, and the warnings by kind."""
    remarks = report.attrs["remarks"].splitlines()
    texts = [sentence_lines("  ", line) for line in remarks]
    lines = [*with_rest(texts, MOST_REMARKS), *kind_lines(s4a.input.plausibility.notices(report))]
    return ["to know:", *lines, ""] if lines else []


def status_line(report: "xr.Dataset") -> str:
    """Return the number of shapes of each status."""
    status = report["status"].values
    kinds = ("ok", "repaired", "flagged", "excluded")
    return f"{len(status)} shapes: {', '.join(f'{(status == k).sum()} {k}' for k in kinds)}"


def registration_cells(registration: "xr.Dataset") -> list[str]:
    """Return mean confidence, mean cycle error and median distortion of registrations."""
    confidence, round_trip = (registration[v].mean().item() for v in ("confidence", "round_trip"))
    distortion = np.median(np.abs(registration["distortion"]))
    return [f"{confidence:.2f}", f"{round_trip:.4f}", f"{distortion:.3f}"]


def landmark_cells(landmarks: "xr.Dataset") -> list[str]:
    """Return mean confidence and disagreement of transferred landmarks."""
    cells = {"landmark_confidence": ".2f", "landmark_disagreement": ".3g"}
    known = {name: landmarks[name].mean().item() for name in cells if name in landmarks}
    return [f"{known[name]:{form}}" if name in known else "-" for name, form in cells.items()]


def true_line(modes: "xr.Dataset", truth: "xr.Dataset") -> str:
    """Return the correlations of the scores with the true scores of simulated shapes."""
    simulated = truth["true_score"].sel(shape=modes["shape"]).values  # (s, q)
    score = modes["score"].values  # (s, c)
    n = min(simulated.shape[1], score.shape[1])
    correlation = np.abs(np.corrcoef(simulated[:, :n].T, score[:, :n].T)).diagonal(n)  # (n,)
    words = ", ".join(f"{r:.3f}" for r in correlation)
    return f"correlation of simulated and recovered scores: {words}"


def error_table(errors: "xr.Dataset") -> str:
    """Return the mean errors of :func:`s4a.evaluation.accuracy.accuracy`, a row per method."""
    mean = 100 * errors[["error", "geodesic_error"]].mean("shape")
    rows = zip(
        *(mean[name].values for name in ("algorithm", "error", "geodesic_error")), strict=True
    )
    return table(rows, ["mean error, % of sqrt(area)", "Euclidean", "along edges"], ".3f")


def evaluation_table(evaluation: "xr.Dataset") -> str:
    """Return measures by number of components, with their standard errors.

    Parameters
    ----------
    evaluation : Dataset
        See :func:`s4a.analysis.statistics.evaluate`.
    """
    columns = ["compactness", "generalization (optimistic)", "specificity"]
    rows = []
    for c in range(min(10, evaluation.sizes["component"])):
        cells = [measure_cell(evaluation, head.split()[0], c) for head in columns]
        rows.append([c + 1, *cells])
    unit = evaluation["generalization"].attrs["units"]
    head = f"compactness: cumulative variance, in {unit} squared; others: lengths in {unit}"
    return f"{head}; ± standard error\n{table(rows, ['components', *columns])}"


def measure_cell(data: "xr.Dataset", name: str, c: int) -> str:
    """Return a measure of so many components and its standard error."""
    if c >= data.sizes["component"]:
        return "-"
    value, error = data[name].values[c], data[f"{name}_error"].values[c]
    return "-" if np.isnan(value) else f"{value:.4g} ± {error:.2g}"


def significance(whole: "xr.Dataset", where: "xr.Dataset", name: str, study: "xr.DataTree") -> str:
    """Return the results of a test and its map in words."""
    mesh = s4a.geometry.mesh.as_arrays(study["registration"].to_dataset())
    area = s4a.geometry.mesh.vertex_areas(*mesh)
    attrs = whole.attrs
    groups = f" ({attrs['groups']})" if "groups" in attrs else ""
    lines = [
        f"{name}{groups}: p = {whole['p_value'].item():.3g} over the whole shape, "
        f"the smallest possible is {attrs['smallest_p']:.2g}"
    ]
    texts = {"covariates": "adjusted for", "left_out": "left out, flagged or without a value:"}
    lines += [f"  {words} {attrs[key]}" for key, words in texts.items() if attrs[key]]
    if where.attrs.get("difference"):
        lines.append(f"  effect: {where.attrs['difference']}")
    corrections = {"p_family_wise": "family-wise", "p_false_discovery": "false discovery rate"}
    for variable, words in corrections.items():
        p_vertex = where[variable].values  # (n,)
        share = 100 * (area @ (p_vertex < 0.05)) / area.sum()
        lines.append(
            f"  {words}: p < 0.05 on {share:.1f} % of the area, least p {np.nanmin(p_vertex):.3g}"
        )
    return "\n".join(lines)


def classification_line(result: "xr.Dataset") -> str:
    """Return the accuracy of a classification in words."""
    share, chance = 100 * result.attrs["balanced_accuracy"], 100 * result.attrs["chance"]
    p = result["p_value"].item()
    return f"classified {share:.0f} % right, chance {chance:.0f} %, p = {p:.3g}"


def inserted_table(inserted: "xr.DataTree") -> str:
    """Return the table of new shapes of :func:`s4a.insert`, with warnings."""
    report, registration = inserted["report"].to_dataset(), inserted["registration"].to_dataset()
    rows, lines = [], []
    for name in report["shape"].values.tolist():
        shape = report.sel(shape=name)
        if shape["status"].item() == "excluded":
            cells = ["-"] * 6 + [f"excluded: {shape['reason'].item()}"]
        else:
            distance = inserted["latent"]["distance_to_limit"].sel(shape=name).item()
            cells = [*registration_cells(registration.sel(shape=name)), f"{distance:.4f}"]
            pca = inserted.get("pca")
            cells += ["-"] * 3 if pca is None else score_cells(pca.to_dataset().sel(shape=name))
        rows.append([name, *cells])
        if shape["warning"].item():
            lines.append(f"  {name}, warning: {shape['warning'].item()}")
    lines += [f"  {remark}" for remark in report.attrs["remarks"].splitlines()]
    unit = registration["displacement"].attrs["units"]
    head = ["shape", "confidence", "round trip", "|distortion|", "to limit shape"]
    head += [f"left ({unit})", "Mahalanobis", "scores"]
    return "\n".join([table(rows, head), *lines])


def score_cells(modes: "xr.Dataset") -> list[str]:
    """Return reconstruction error, Mahalanobis distance and first scores of a shape."""
    return [
        f"{modes['reconstruction_error'].item():.4g}",
        f"{s4a.method.pca.mahalanobis(modes['score'].values):.1f}",
        " ".join(f"{score:+.2f}" for score in modes["score"].values[:5]),
    ]


def comparison_table(pairs: "xr.Dataset") -> str:
    """Return Table 1: mean over the pairs of every metric, and the CPU seconds.

    Lengths in % of sqrt(area).
    """
    mean = pairs.mean("pair")
    columns = {name: column for name, column in METRICS.items() if name in mean}
    rows = []
    for name in mean["algorithm"].values:
        method = mean.sel(algorithm=name)
        cells = [
            f"{factor * method[metric].item():.{digits}f}"
            for metric, (_, factor, digits) in columns.items()
        ]
        rows.append([name, f"{method['block_seconds'].sum().item():.1f}", *cells])
    return table(rows, ["method", "CPU s", *(title for title, *_ in columns.values())])


def collection_table(result: "xr.Dataset") -> str:
    """Return Table 2: mean Chamfer distance to the template, CPU seconds, median shape."""
    rows = []
    for way, how in itertools.product(result["algorithm"].values, result["dense_match"].values):
        method = result.sel(algorithm=way, dense_match=how)
        seconds = method["collection_seconds"].values
        chamfer = 100 * method["collection_chamfer"].mean().item()
        median = method["median_shape"].item()
        rows.append([way, how, f"{chamfer:.4f}", *seconds, seconds.sum(), median])
    blocks = [f"{block}, s" for block in result["block"].values]
    head = ["method", "dense match", "Chamfer %", *blocks, "all, s", "median shape"]
    return table(rows, head, ".1f")
