"""What the commands print: results as tables and sentences.

Tables 1 and 2 and Fig. 3 of the paper as text.

Every function gives a text; nothing is printed or written here.
"""

import textwrap

import numpy as np

from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.method.pca import mahalanobis

FOUND = {
    "file_vertices": "vertices",
    "components": "components",
    "genus": "genus",
    "holes": "holes",
    "nonmanifold_edges": "non-manifold",
}
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


def table(rows, head, width=120):
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
    rows = [[str(x) for x in row] for row in [head, *rows]]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    numeric = [
        all(x.replace(".", "", 1).isdigit() or x == "-" for x in column)
        for column in zip(*rows[1:], strict=True)
    ]
    margin = sum(widths[:-1]) + 2 * (len(head) - 1)
    lines = []
    for row in rows:
        last = textwrap.wrap(row[-1], max(width - margin, 40)) or [""]
        columns = zip([*row[:-1], last[0]], widths, numeric, strict=True)
        lines.append(
            "  ".join(x.rjust(w) if right else x.ljust(w) for x, w, right in columns).rstrip()
        )
        lines += [" " * margin + line for line in last[1:]]
    return "\n".join(lines)


def report_table(report):
    """What was found in every shape and done about it, and what looks wrong."""
    rows = []
    for name in report["shape"].values:
        one = report.sel(shape=name)
        counts = ["-" if v not in one or int(one[v]) < 0 else int(one[v]) for v in FOUND]
        rows.append([name, *counts, one["status"].item(), one["reason"].item()])
    return "\n".join(
        [table(rows, ["shape", *FOUND.values(), "status", "found and done"]), *doubts(report)]
    )


def doubts(report):
    """Lines: what looks wrong with shapes, and what concerns the collection."""
    doubtful = report["shape"].values[report["warning"].values != ""]
    lines = [f"{name}, warning: {report['warning'].sel(shape=name).item()}" for name in doubtful]
    return [f"  {line}" for line in [*lines, *report.attrs["remarks"].splitlines()]]


def run_summary(study, seconds):
    """The end of a run: time and memory of the stages, the shapes, the median, the registration.

    The modes.
    """
    report = study["report"].to_dataset()
    stages = zip(
        *(report[name].values for name in ("stage", "seconds", "peak_memory")), strict=True
    )
    rows = [[stage, f"{s:.1f}", f"{m:.0f}"] for stage, s, m in stages]
    rows.append(["all", f"{seconds:.1f}", f"{report['peak_memory'].values.max():.0f}"])
    status, names, reason = (report[name].values for name in ("status", "shape", "reason"))
    counts = ", ".join(f"{(status == one).sum()} {one}" for one in ("ok", "repaired", "excluded"))
    lines = [
        "",
        table(rows, ["stage", "seconds", "peak MiB"]),
        "",
        f"{len(status)} shapes: {counts}",
    ]
    out = status == "excluded"
    lines += [
        f"  {name} excluded: {why}" for name, why in zip(names[out], reason[out], strict=True)
    ]
    done = ~out & (reason != "")
    lines += [f"  {name}: {why}" for name, why in zip(names[done], reason[done], strict=True)]
    lines += doubts(report)
    latent = study["latent"].to_dataset()
    nearest = latent.isel(shape=latent["distance_to_median"].argsort().values[:3])
    pairs = zip(nearest["shape"].values, nearest["distance_to_median"].values, strict=True)
    near = ", ".join(f"{name} {distance:.4f}" for name, distance in pairs)
    lines.append(
        f"median shape: {latent.attrs['median']}; nearest to the limit shape (eq. 5): {near}"
    )
    registration = study["registration"].to_dataset()
    confidence, trip = (registration[name].mean().item() for name in ("confidence", "round_trip"))
    lines.append(
        f"registered to {registration.attrs['template']}; mean confidence {confidence:.2f}, cycle error {trip:.4f} of "
        f"sqrt(area), median |distortion| {np.median(np.abs(registration['distortion'])):.3f}"
    )
    if "pca" in study:
        ratio = np.cumsum(study["pca"]["explained_variance_ratio"].values)
        few = [c for c in (1, 3, 10) if c <= len(ratio)]
        lines.append(
            "variance explained: " + ", ".join(f"{100 * ratio[c - 1]:.1f} % by {c}" for c in few)
        )
    else:
        lines.append(f"no modes: {report.attrs['no_modes']}")
    return "\n".join(lines)


def error_table(errors):
    """Mean errors of :func:`s4a.evaluation.accuracy.accuracy` over the shapes, a row per method."""
    mean = 100 * errors.mean("shape")
    rows = []
    for method in mean["way"].values:
        pair = [mean[name].sel(way=method).item() for name in ("error", "geodesic_error")]
        rows.append([method, *("-" if np.isnan(e) else f"{e:.3f}" for e in pair)])
    return table(rows, ["mean error, % of sqrt(area)", "straight line", "along edges"])


def evaluation_table(kept, anew):
    """Measures by number of components, with their standard errors."""
    unit = kept["generalization"].attrs["units"]
    columns = [
        ("compactness", kept),
        ("generalization, kept: optimistic", kept),
        ("specificity", kept),
    ]
    columns[2:2] = [("generalization, recomputed", anew)] if anew is not None else []
    rows = []
    for c in range(min(10, kept.sizes["component"])):
        row = [c + 1]
        for head, found in columns:
            name = head.partition(",")[0]
            value, error = (
                found[n].values[c] if c < found.sizes["component"] else np.nan
                for n in (name, f"{name}_error")
            )
            row.append("-" if np.isnan(value) else f"{value:.4g} ± {error:.2g}")
        rows.append(row)
    return f"lengths in {unit}, ± standard error\n" + table(
        rows, ["components", *(head for head, _ in columns)]
    )


def significance(whole, where, name, study):
    """What a test and its map found, in words."""
    area = vertex_areas(*as_arrays(study["registration"].to_dataset()))
    p, least = whole["p_value"].item(), whole.attrs["smallest_p"]
    text = f"{name} ({whole.attrs['groups']})" if "groups" in whole.attrs else name
    text += f": p = {p:.3g} over the whole shape, the smallest that can be reached is {least:.2g}"
    for key, words in (
        ("p_family_wise", "family-wise"),
        ("p_false_discovery", "false discovery rate"),
    ):
        share = area @ (where[key].values < 0.05) / area.sum()
        text += f"\n  {100 * share:.1f} % of the area under 0.05 ({words}), smallest {where[key].values.min():.3g}"
    return text


def inserted_table(found):
    """Where new shapes of :func:`s4a.insert` lie in their study, and what looks wrong with them."""
    report, data, latent = (found[n].to_dataset() for n in ("report", "registration", "latent"))
    rows = []
    for name in report["shape"].values.tolist():
        if report["status"].sel(shape=name).item() == "excluded":
            rows.append([name, *["-"] * 6, f"excluded: {report['reason'].sel(shape=name).item()}"])
            continue
        one = data.sel(shape=name)
        row = [
            name,
            f"{one['confidence'].mean().item():.2f}",
            f"{one['round_trip'].mean().item():.4f}",
        ]
        row.append(f"{np.median(np.abs(one['distortion'])):.3f}")
        row.append(f"{latent['distance_to_median'].sel(shape=name).item():.4f}")
        if "pca" in found:
            scores = found["pca"].sel(shape=name)
            row += [
                f"{scores['reconstruction_error'].item():.4g}",
                f"{mahalanobis(scores['score']):.1f}",
            ]
            row += [" ".join(f"{s:+.2f}" for s in scores["score"].values[:5])]
        rows.append(row + ["-"] * (8 - len(row)))
    head = ["shape", "confidence", "round trip", "|distortion|", "to limit shape"]
    head += [f"left ({data['displacement'].attrs['units']})", "Mahalanobis", "scores"]
    return "\n".join([table(rows, head), *doubts(report)])


def comparison_table(found):
    """Table 1: mean over the pairs of every metric, and the CPU seconds.

    Lengths in % of sqrt(area).
    """
    mean = found.mean("pair")
    columns = {name: column for name, column in METRICS.items() if name in mean}
    rows = []
    for way in mean["way"].values:
        one = mean.sel(way=way)
        row = [
            f"{scale * one[name].item():.{digits}f}" for name, (_, scale, digits) in columns.items()
        ]
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
    """Table 2: mean Chamfer distance to the template, CPU seconds by block.

    And the median shape.
    """
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
