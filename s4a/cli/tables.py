"""What the commands print: results as tables and sentences, Tables 1 and 2 and Fig. 3 as text.

Every function gives a text, or the cells of a row; nothing is printed or written here.
"""

import shlex
import textwrap
import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.plausibility import Decision, decisions, listed, notices, shortened
from s4a.method.pca import mahalanobis
from s4a.options import kept_options
from s4a.study.progress import STAGES, Status
from s4a.study.tree import seconds_of

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
SCREEN, LINES = 100, 40  # columns and lines of a summary
LEAST, MOST_REMARKS = 5, 6  # excluded shapes at least, and remarks at most, with lines of their own
LONGEST = 24  # letters of a name
LARGEST = 3  # stages whose time a summary says
TRANSFERRED = [
    "target",
    "cycle error",
    "|distortion|",
    "confidence",
    "share of votes",
    "labels of dropped vertices",
    "landmarks",
    "spread",
]


def table(rows: Iterable[Sequence[Any]], head: Sequence[str], width: int = 120) -> str:
    """Rows of text as aligned columns.

    Numbers to the right, a long last column wrapped at `width` characters.

    Examples
    --------
    >>> from s4a.cli.tables import table
    >>> print(table([["a", 1], ["b", 20]], ["name", "n"]))
    name   n
    a      1
    b     20
    """
    rows = [[str(cell) for cell in row] for row in [head, *rows]]
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    numeric = [all(map(is_number, column[1:])) for column in columns]
    margin = sum(widths[:-1]) + 2 * (len(head) - 1)
    lines = []
    for *cells, long in rows:
        first, *rest = wrapped(long, max(width - margin, 40)) or [""]
        layout = zip([*cells, first], widths, numeric, strict=True)
        lines.append("  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in layout).rstrip())
        lines += [" " * margin + line for line in rest]
    return "\n".join(lines)


def is_number(cell: str) -> bool:
    """Whether a cell stands to the right."""
    return cell == "-" or cell.replace(".", "", 1).isdigit()


def wrapped(text: str, width: int, indent: str = "") -> list[str]:
    """Lines of a text, broken at blanks only: paths and words stay whole.

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
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def report_table(report: xr.Dataset) -> str:
    """A row for every shape; below it what was found and done, and what looks wrong."""
    rows, texts = [], []
    for name in report["shape"].values:
        shape = report.sel(shape=name)
        counts = [int(shape[count]) if count in shape else -1 for count in COUNTS]
        cells = ["-" if count < 0 else count for count in counts]
        rows.append([name, *cells, shape["status"].item()])
        warning = shape["warning"].item()
        texts.append([shape["reason"].item(), f"warning: {warning}" if warning else ""])
    head, *lines = table(rows, ["shape", *COUNTS.values(), "status"]).splitlines()
    whole = [head]
    for line, below in zip(lines, texts, strict=True):
        whole.append(line)
        for text in below:
            whole += wrapped(text, SCREEN, "    ")
    for remark in report.attrs["remarks"].splitlines():
        whole += wrapped(remark, SCREEN, "  ")
    return "\n".join(whole)


FAULTS = ("damaged", "missing", "stale")  # states of files without which a study does not hold


def count_faults(found: xr.Dataset) -> int:
    """How many files of :func:`s4a.verify` make that the study does not hold."""
    return int(np.isin(found["state"].values, FAULTS).sum())


def verify_lines(found: xr.Dataset) -> str:
    """What :func:`s4a.verify` has found, in one line, and one for each file that is not whole.

    Examples
    --------
    >>> from s4a.cli.tables import verify_lines
    >>> from s4a.schema import dataset
    >>> found = dataset(state=["whole", "whole"], fault=["", ""])
    >>> print(verify_lines(found.assign_coords(file=["latent.nc", "pca.nc"])))
    2 files, all whole and made from each other
    """
    states = found["state"].values.tolist()
    counts = {state: states.count(state) for state in dict.fromkeys(states)}
    n = sum(count for state, count in counts.items() if state not in ("foreign", "left over"))
    others = [f"{count} {state}" for state, count in counts.items() if state != "whole"]
    if not count_faults(found) and not counts.get("unsealed"):
        line = f"{n} files, all whole and made from each other"
        line += f"; beside them {', '.join(others)}" if others else ""
    else:
        line = f"{n} files: {counts.get('whole', 0)} whole, {', '.join(others)}"
    if counts.get("unsealed"):
        line += "; unsealed ones were written before files had checksums: damage is not seen"
    if count_faults(found):
        line += "; the same `s4a run` again makes what is wrong anew, and nothing else"
    rows = zip(found["file"].values, states, found["fault"].values, strict=True)
    return "\n".join(
        [line, *(f"  {file}, {state}: {fault}" for file, state, fault in rows if fault)]
    )


def status_lines(status: Status, now: float) -> str:
    """How far a run is, at a time in seconds since 1970: a line for each stage."""
    since, told = (time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(t)) for t in status[3:5])
    heads = {
        "running": f"running since {since}: process {status.owner} and {status.processes - 1} "
        f"below it, {status.memory:.0f} MiB now",
        "finished": f"finished at {told}",
        "stopped": f"stopped, it last told at {told}; the same command goes on where it stopped",
        "elsewhere": f"on {status.host}, of which this machine knows no more than the study says: "
        f"it last told at {told}",
    }
    rows = []
    for name in dict.fromkeys([*STAGES, *status.stages]):
        if name not in status.stages:
            if status.state != "finished":
                rows.append([name, *["-"] * 5])
            continue
        stage = status.stages[name]
        goes_on = status.state in ("running", "elsewhere") and not stage.ended
        seconds = stage.seconds + (now - stage.begun if goes_on else 0)
        remaining = stage.remaining(now) if goes_on else np.nan
        cells = [f"{seconds:.0f}", f"{stage.memory:.0f}" if stage.ended else "-"]
        left = "-" if np.isnan(remaining) else f"about {remaining:.0f}"
        rows.append([name, str(stage.done), str(stage.all), *cells, left])
    lines = [heads[status.state], table(rows, ["stage", "done", "of", "s", "peak MiB", "s left"])]
    shown = list(status.failures.items())[:LEAST]
    lines += [f"left out: {name}: {without_middle(why, SCREEN)}" for name, why in shown]
    if len(status.failures) > LEAST:
        lines.append(f"and {len(status.failures) - LEAST} more")
    return "\n".join(lines)


def doubts(report: xr.Dataset) -> list[str]:
    """Lines: what looks wrong with shapes, and what concerns the collection."""
    warnings = zip(report["shape"].values, report["warning"].values, strict=True)
    lines = [f"{name}, warning: {warning}" for name, warning in warnings if warning]
    return [f"  {line}" for line in [*lines, *report.attrs["remarks"].splitlines()]]


def run_summary(study: xr.DataTree, *, again: str = "s4a run FOLDER --out STUDY") -> str:
    """The end of a run, on one screen: what to decide first, then the shapes and the results.

    Parameters
    ----------
    study : DataTree
    again : str
        The command of the run, to which flags can be added.
    """
    report = study["report"].to_dataset()
    before = ["", *decision_lines(report, again), *remark_lines(report)]
    after = [*shape_lines(report), "", *result_lines(study), *cost_lines(report)]
    room = LINES - len(before) - len(after) - 6  # for the lines around them and place_lines
    return "\n".join([*before, *excluded_lines(report, max(room, LEAST)), *after])


def result_lines(study: xr.DataTree) -> list[str]:
    """The median shape, how the shapes are registered, what the first modes explain."""
    registration = registration_of(study)
    confidence, round_trip, distortion = registration_cells(registration)
    (template,) = shortened([registration.attrs["template"]], LONGEST)
    lines = [
        median_line(study["latent"].to_dataset()),
        f"registered to {template}; mean confidence {confidence}, "
        f"cycle error {round_trip} of sqrt(area), median |distortion| {distortion}",
    ]
    if "pca" in study:
        ratio = 100 * study["pca"].to_dataset()["explained_variance_ratio"].cumsum().values
        shares = [f"{ratio[c - 1]:.1f} % by {c}" for c in (1, 3, 10) if c <= len(ratio)]
        lines.append(f"variance explained: {', '.join(shares)}")
    else:
        lines.append(f"no modes: {study['report'].attrs['no_modes']}")
    return [line for text in lines for line in wrapped(text, SCREEN)]


def cost_lines(report: xr.Dataset) -> list[str]:
    """Seconds of all stages and of those that took most, and the most memory."""
    spent = dict(zip(report["stage"].values.tolist(), report["seconds"].values, strict=True))
    most = sorted(spent, key=lambda stage: -spent[stage])[:LARGEST]
    parts = ", ".join(f"{stage} {spent[stage]:.1f}" for stage in most)
    memory = report["peak_memory"].values.max()
    return wrapped(f"{seconds_of(report)} ({parts}, ...); at most {memory:.0f} MiB", SCREEN)


def stage_lines(report: xr.Dataset) -> list[str]:
    """Seconds of every stage."""
    costs = zip(report["stage"].values, report["seconds"].values, strict=True)
    return wrapped(f"seconds: {', '.join(f'{stage} {s:.1f}' for stage, s in costs)}", SCREEN)


def place_lines(study: str, report: str) -> list[str]:
    """Where the study is, how to look at it, and where every shape is told of."""
    line = f"study: {study}; pictures: s4a view {study}; every shape: {report}"
    if len(line) <= SCREEN:
        return [line]
    return [f"study: {study}", f"pictures: s4a view {study}", f"every shape: {report}"]


def decision_lines(report: xr.Dataset, again: str = "s4a run FOLDER --out STUDY") -> list[str]:
    """Doubtful shapes by what is doubtful, what to do about it, and the commands that do it."""
    n = int((report["status"] == "doubtful").sum())
    if not n:
        return []
    kept = kept_options(report).get("keep_doubtful")
    become = "taken in as they are" if kept else "kept apart: in no modes, no statistics, no median"
    lines = [f"TO DECIDE: {n} of {report.sizes['shape']} shapes are doubtful, and {become}"]
    lines += kind_lines(decisions(report))
    if kept:
        return [*lines, *command_lines("to keep them apart:", again, "", "--keep-doubtful"), ""]
    return [
        *lines,
        "  to leave one out: take its file away and run again; nothing else changes",
        *command_lines("to take all of them in:", again, "--keep-doubtful"),
        "",
    ]


def command_lines(what: str, command: str, flag: str = "", without: str = "") -> list[str]:
    """A command for a shell, in lines that fit on the screen; in words where it is long.

    Parameters
    ----------
    what : str
        What it is for.
    command : str
        Without the flags.
    flag, without : str
        The flag that it gets, or one that the command of the run has and it does not.

    Examples
    --------
    >>> from s4a.cli.tables import command_lines
    >>> command_lines("to take all of them in:", "s4a run d --out s", "--keep-doubtful")
    ['  to take all of them in: s4a run d --out s --keep-doubtful']
    >>> command_lines("to take them in:", "s4a run " + 400 * "a.ply ", "--keep-doubtful")
    ['  to take them in: the same command with --keep-doubtful']
    """
    words = [shlex.quote(word) for word in shlex.split(f"{command} {flag}")]
    line, lines = f"  {what}", []
    for word in words:
        if len(line) + len(word) + 3 > SCREEN:  # a blank, and two for the mark of the next line
            lines.append(f"{line} \\")
            line = "     "
        line += f" {word}"
    lines.append(line)
    if len(lines) > 3 or max(map(len, lines)) > SCREEN:
        return [f"  {what} the same command {f'with {flag}' if flag else f'without {without}'}"]
    return lines


def kind_lines(found: list[Decision]) -> list[str]:
    """A line for each kind: how many shapes, which ones as there is room, what to do."""
    heads = [f"{len(one.names):3} {one.kind}" for one in found]
    first = max(map(len, heads), default=0)
    room = SCREEN - first - 6 - max((len(one.remedy) for one in found), default=0)
    letters = max(min(LONGEST, room - len(", 999 more")), 5)
    names = [listed(one.names, room, letters) for one in found]
    second = max(map(len, names), default=0)
    return [
        f"{head.ljust(first)}  {few.ljust(second)}  -> {one.remedy}"
        for head, few, one in zip(heads, names, found, strict=True)
    ]


def excluded_lines(report: xr.Dataset, most: int) -> list[str]:
    """The shapes that could not be used, each with its reason; at most so many of them."""
    out = report.sel(shape=report["status"].values == "excluded")
    names = out["shape"].values.tolist()
    if not names:
        return []
    reasons = [
        short_reason(*texts)
        for texts in zip(out["reason"].values.tolist(), out["path"].values.tolist(), strict=True)
    ]
    shown = list(zip(shortened(names, 20), reasons, strict=True))[:most]
    width = max(len(name) for name, _ in shown)
    lines = [f"{len(names)} of {report.sizes['shape']} shapes cannot be used:"]
    for name, reason in shown:
        head = f"  {name.ljust(width)}  "
        lines.append(head + without_middle(reason, SCREEN - len(head)))
    if len(names) > most:
        lines.append(f"  and {len(names) - most} more: {listed(names[most:], 80)}")
    return [*lines, ""]


def without_middle(text: str, longest: int) -> str:
    """A text of at most so many letters: the words in the middle are left out where it has more.

    Examples
    --------
    >>> from s4a.cli.tables import without_middle
    >>> without_middle("one of PLY, OBJ, OFF, STL expected, found 14 bytes", 36)
    'one of PLY, OBJ, … found 14 bytes'
    """
    words = text.split()
    if len(text) <= longest or len(words) < 3:
        return shortened([text], longest)[0]
    first, last, room = [words[0]], [words[-1]], longest - len(words[0]) - len(words[-1]) - 3
    rest = words[1:-1]
    while rest and room >= 0:  # from both ends by turns
        from_end = len(" ".join(last)) < len(" ".join(first))
        word = rest.pop(-1 if from_end else 0)
        room -= len(word) + 1
        if room >= 0:
            last, first = ([word, *last], first) if from_end else (last, [*first, word])
    return shortened([" ".join([*first, "…", *last])], longest)[0]


def short_reason(reason: str, path: str) -> str:
    """Why a shape is excluded, without the stage and the path, which are said elsewhere.

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


def remark_lines(report: xr.Dataset) -> list[str]:
    """What concerns the collection, shortened, and what else looks wrong with shapes, by kind."""
    remarks = report.attrs["remarks"].splitlines()
    lines = [f"  {without_middle(line, SCREEN - 2)}" for line in remarks]
    if len(lines) > MOST_REMARKS:
        lines = [*lines[:MOST_REMARKS], f"  and {len(remarks) - MOST_REMARKS} more remarks"]
    lines += kind_lines(notices(report))
    return ["to know:", *lines, ""] if lines else []


def shape_lines(report: xr.Dataset) -> list[str]:
    """How many shapes there are of each status."""
    status = report["status"].values
    kinds = ("ok", "repaired", "doubtful", "excluded")
    counts = ", ".join(f"{(status == kind).sum()} {kind}" for kind in kinds)
    return [f"{len(status)} shapes: {counts}"]


def median_line(latent: xr.Dataset) -> str:
    """The median shape, and the three shapes that are nearest to the limit shape."""
    distance = latent["distance_to_median"]
    nearest = distance.isel(shape=distance.argsort().values[:3])
    names = shortened(nearest["shape"].values.tolist(), LONGEST)
    near = ", ".join(f"{name} {d:.4f}" for name, d in zip(names, nearest.values, strict=True))
    (median,) = shortened([latent.attrs["median"]], LONGEST)
    return f"median shape: {median}; nearest to the limit shape (eq. 5): {near}"


def registration_cells(registration: xr.Dataset) -> list[str]:
    """Mean confidence, mean cycle error and median distortion of registrations."""
    confidence, round_trip = (registration[v].mean().item() for v in ("confidence", "round_trip"))
    distortion = np.median(np.abs(registration["distortion"]))
    return [f"{confidence:.2f}", f"{round_trip:.4f}", f"{distortion:.3f}"]


def landmark_cells(landmarks: xr.Dataset) -> list[str]:
    """Mean confidence and spread of landmarks that were carried over."""
    cells = [f"{landmarks['landmark_confidence'].mean().item():.2f}", "-"]
    if "landmark_spread" in landmarks:
        cells[1] = f"{landmarks['landmark_spread'].mean().item():.3g}"
    return cells


def planted_line(modes: xr.Dataset, truth: xr.Dataset) -> str:
    """How well the scores of the modes follow those that made synthetic shapes."""
    planted = truth["planted_score"].sel(shape=modes["shape"]).values  # (s, q)
    score = modes["score"].values  # (s, c)
    n = min(planted.shape[1], score.shape[1])
    correlation = np.abs(np.corrcoef(planted[:, :n].T, score[:, :n].T)).diagonal(n)  # (n,)
    words = ", ".join(f"{r:.3f}" for r in correlation)
    return f"correlation of planted and recovered scores: {words}"


def error_table(errors: xr.Dataset) -> str:
    """Mean errors of :func:`s4a.evaluation.accuracy.accuracy` over the shapes, a row per method."""
    mean = 100 * errors[["error", "geodesic_error"]].mean("shape")
    rows = []
    for method in mean["way"].values:
        pair = [variable.item() for variable in mean.sel(way=method).data_vars.values()]
        rows.append([method, *("-" if np.isnan(error) else f"{error:.3f}" for error in pair)])
    return table(rows, ["mean error, % of sqrt(area)", "straight line", "along edges"])


def evaluation_table(evaluation: xr.Dataset, recomputed: xr.Dataset | None) -> str:
    """Measures by number of components, with their standard errors.

    Parameters
    ----------
    evaluation : Dataset
        See :func:`s4a.analysis.statistics.evaluate`.
    recomputed : Dataset or None
        See :func:`s4a.analysis.statistics.generalization`.
    """
    columns = {"compactness": evaluation, "generalization, kept: optimistic": evaluation}
    if recomputed is not None:
        columns["generalization, recomputed"] = recomputed
    columns["specificity"] = evaluation
    rows = []
    for c in range(min(10, evaluation.sizes["component"])):
        cells = [measure_cell(data, head.partition(",")[0], c) for head, data in columns.items()]
        rows.append([c + 1, *cells])
    unit = evaluation["generalization"].attrs["units"]
    return f"lengths in {unit}, ± standard error\n{table(rows, ['components', *columns])}"


def measure_cell(data: xr.Dataset, name: str, c: int) -> str:
    """A measure of so many components and its standard error."""
    if c >= data.sizes["component"]:
        return "-"
    value, error = data[name].values[c], data[f"{name}_error"].values[c]
    return "-" if np.isnan(value) else f"{value:.4g} ± {error:.2g}"


def significance(whole: xr.Dataset, where: xr.Dataset, name: str, study: xr.DataTree) -> str:
    """What a test and its map found, in words."""
    area = vertex_areas(*as_arrays(study["registration"].to_dataset()))
    p, least = whole["p_value"].item(), whole.attrs["smallest_p"]
    groups = f" ({whole.attrs['groups']})" if "groups" in whole.attrs else ""
    lines = [
        f"{name}{groups}: p = {p:.3g} over the whole shape, "
        f"the smallest that can be reached is {least:.2g}"
    ]
    if whole.attrs["covariates"]:
        lines.append(f"  accounted for: {whole.attrs['covariates']}")
    if whole.attrs["left_out"]:
        lines.append(f"  left out, doubtful or without a value: {whole.attrs['left_out']}")
    corrections = {"p_family_wise": "family-wise", "p_false_discovery": "false discovery rate"}
    for variable, words in corrections.items():
        p_vertex = where[variable].values  # (n,)
        share = 100 * (area @ (p_vertex < 0.05)) / area.sum()
        lines.append(
            f"  {share:.1f} % of the area under 0.05 ({words}), smallest {np.nanmin(p_vertex):.3g}"
        )
    return "\n".join(lines)


def classification_line(result: xr.Dataset) -> str:
    """How well groups are told apart by the scores, in words."""
    share, chance = 100 * result.attrs["balanced_accuracy"], 100 * result.attrs["chance"]
    p = result["p_value"].item()
    return f"classified {share:.0f} % right, chance {chance:.0f} %, p = {p:.3g}"


def inserted_table(inserted: xr.DataTree) -> str:
    """Where new shapes of :func:`s4a.insert` lie in their study, and what looks wrong with them."""
    report, registration = inserted["report"].to_dataset(), inserted["registration"].to_dataset()
    rows = []
    for name in report["shape"].values.tolist():
        shape = report.sel(shape=name)
        if shape["status"].item() == "excluded":
            cells = ["-"] * 6 + [f"excluded: {shape['reason'].item()}"]
        else:
            distance = inserted["latent"]["distance_to_median"].sel(shape=name).item()
            cells = [*registration_cells(registration.sel(shape=name)), f"{distance:.4f}"]
            cells += ["-"] * 3
            if "pca" in inserted:
                cells[-3:] = score_cells(inserted["pca"].to_dataset().sel(shape=name))
        rows.append([name, *cells])
    unit = registration["displacement"].attrs["units"]
    head = ["shape", "confidence", "round trip", "|distortion|", "to limit shape"]
    head += [f"left ({unit})", "Mahalanobis", "scores"]
    return "\n".join([table(rows, head), *doubts(report)])


def score_cells(modes: xr.Dataset) -> list[str]:
    """What the modes leave of one shape, how far it lies from the mean, and its first scores."""
    return [
        f"{modes['reconstruction_error'].item():.4g}",
        f"{mahalanobis(modes['score'].values):.1f}",
        " ".join(f"{score:+.2f}" for score in modes["score"].values[:5]),
    ]


def comparison_table(pairs: xr.Dataset) -> str:
    """Table 1: mean over the pairs of every metric, and the CPU seconds.

    Lengths in % of sqrt(area).
    """
    mean = pairs.mean("pair")
    columns = {name: column for name, column in METRICS.items() if name in mean}
    rows = []
    for name in mean["way"].values:
        method = mean.sel(way=name)
        cells = [
            f"{factor * method[metric].item():.{digits}f}"
            for metric, (_, factor, digits) in columns.items()
        ]
        rows.append([name, f"{method['block_seconds'].sum().item():.1f}", *cells])
    return table(rows, ["method", "CPU s", *(title for title, *_ in columns.values())])


def block_table(methods: Sequence[str], blocks: Sequence[str], seconds: np.ndarray) -> str:
    """CPU seconds (m, b) of every method by block (Fig. 3)."""
    rows = [
        [method, *(f"{s:.1f}" for s in of_blocks), f"{of_blocks.sum():.1f}"]
        for method, of_blocks in zip(methods, seconds, strict=True)
    ]
    return table(rows, ["CPU s", *blocks, "all"])


def collection_table(result: xr.Dataset) -> str:
    """Table 2: mean Chamfer distance to the template, CPU seconds by block, the median shape."""
    rows = []
    for way in result["way"].values:
        for how in result["how"].values:
            method = result.sel(way=way, how=how)
            seconds = method["collection_seconds"].values
            chamfer = 100 * method["collection_chamfer"].mean().item()
            costs = [f"{s:.1f}" for s in (*seconds, seconds.sum())]
            rows.append([way, how, f"{chamfer:.4f}", *costs, method["median_shape"].item()])
    blocks = [f"{block}, s" for block in result["block"].values]
    return table(rows, ["method", "way up", "Chamfer %", *blocks, "all, s", "median shape"])
