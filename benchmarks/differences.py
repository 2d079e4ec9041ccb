"""The page ``docs/differences.md``: its text here, its figures from ``docs/differences.csv``.

``differences.py`` prints it, ``differences.py --write`` writes it.  The figures are measured by
``additions.py --write``.
"""

import csv
import re
import sys
from pathlib import Path
from typing import NamedTuple

from s4a.options import DECLARED, PRESETS

PAPER = PRESETS["paper"]
DEFAULTS = {name: PRESETS[None][name] for name in PAPER}
DOCS = Path(__file__).parents[1] / "docs"
RESULTS = DOCS / "differences.csv"
PAGE = DOCS / "differences.md"
HEAD = ["set", "row", "matched", "surface", "carried", "seconds", "template"]
SETS = ("brains", "faces", "bodies")
SWITCH = ["equation", "in the paper", "here", "where", "option: default, in the paper"]
LACKING = "not yet"  # in the place of a figure that was not measured


# additions that are another value of an option than its default, and rows of their own
OTHER = {"spectral_icp": "refine"}
MORE = {  # what the table also says of a value
    "lift": "; `RE-MATCH refined` of `s4a.compare`: True",
    "full_resolution_iterations": "; `RE-MATCH refined` of `s4a.compare`: 2",
    "n_samples": ", all",
    "n_projected": ", all",
}


class Reading(NamedTuple):
    """What the paper leaves open, or does by other code, and what is done here."""

    equation: str
    paper: str
    here: str
    other: str  # the option or the function that is put in its place
    rows: tuple[str, ...]  # of the results, measured on the paper; or none
    effect: str = ""  # where nothing is measured


READINGS = [
    Reading(
        "4.2",
        "two ways to full resolution, *standard* and *ours*",
        "*ours*, eq. 7",
        '`dense_match="fmap"`: eq. 3 and 4',
        ("how=standard",),
    ),
    Reading(
        "4.1",
        "a coarse mesh, or the local functions of SCALABLE",
        "a coarse mesh",
        '`method="scalable"`',
        ("method=scalable",),
    ),
    Reading(
        "4.2",
        "Consistent ZoomOut without a step of ZoomOut ahead is unsatisfactory",
        "a step ahead",
        '`initial_refinement="never"`',
        ("initial_refinement=never",),
    ),
    Reading(
        "eq. 3",
        "no weights of the maps",
        "$\\exp(-(e / s)^2 / 2)$ with $e$ the mean over the 3-cycles of a map of what these "
        "lack, $s$ its median",
        '`weights="equal"`; pyFM and Huang et al. (2020): the same with $e$ by a linear program',
        ("weights=equal", "weights of the linear program"),
    ),
    Reading(
        "eq. 3",
        "no size of the latent basis",
        "$K$ columns",
        "`n_latent=90`, the share of 0.9 that pyFM takes",
        ("n_latent=90",),
    ),
    Reading(
        "4.2",
        "no growth per round",
        "5 functions",
        "`step=10`",
        ("step=10",),
    ),
    Reading(
        "4.1, step 1",
        "ReMatching's mesh: the dual of geodesic Voronoi cells of farthest points along the "
        "surface; $U$ from the point of the coarse mesh that is closest in space",
        "the same dual; farthest points of position *and normal*, further ones where it is no "
        "manifold, thin handles cut; $U$ from the coarse triangles around the vertex's own cell, "
        "so that it never looks across a thin wall",
        "$U$, then samples and $U$, as ReMatching has them (no option)",
        ("U by closest points in space", "samples and U of ReMatching"),
    ),
    Reading(
        "4.1, step 2",
        "ICP",
        "point to point, both ways, the farthest tenth of the pairs left out, from the pose as "
        "given, from turns of principal axes and tilted; onto a reference, then again for each "
        "pair",
        "ICP from the pose as given alone (no option)",
        ("ICP from one start",),
    ),
    Reading(
        "4.1, step 4",
        "a map is optimised with landmarks; the code is based on pyFM",
        "heat kernels around the landmarks kept at 8 times, and $C$ commutes with the Laplacians",
        "pyFM's fit: wave kernels of the shapes and around the landmarks (no option)",
        ("initial maps of pyFM",),
    ),
]

OTHERS = [
    (
        "4.1, step 3",
        "10 points are sampled",
        "10 farthest points, so that the same shape gives the same",
        "not measured",
    ),
    (
        "3.4, 5.1",
        "500 edges of 1,275, connected",
        "a tree of shapes that are near by their spectra, triangles on it, then the nearest pairs; "
        "each pair has a map both ways",
        "none on these sets, whose 15 pairs are all taken",
    ),
    (
        "3.5, eq. 5",
        "$Y_i$ as they come",
        "turned so that the mean of $Y_i^\\top \\Lambda_i Y_i$ is diagonal, as in the canonical "
        "basis of Huang et al. (2019)",
        "none on matches: eq. 3, 6 and 7 do not see a turn",
    ),
    (
        "4.1, SCALABLE",
        "eigenvalues of the Laplacian restricted to the local functions",
        "the same; they are too large, by 5 % on a sphere and 12 to 15 % on a head "
        "(`method/scalable`), as the functions cannot follow a linear one exactly",
        "on eq. 5 and on the choice of pairs alone; no match is made of eigenvalues",
    ),
    (
        "eq. 8",
        "$d = x - T(x)$",
        "$T(x) - x$, so that template + displacement is the shape",
        "the sign",
    ),
    (
        "6.1",
        "PCA of the fields in the truncated basis",
        "PCA of the smooth fields, vertices weighted by area; the $K \\times 3$ coefficients are "
        "kept as `displacement_coefficient`",
        "on modes alone, none on matches",
    ),
    (
        "6.2",
        "a vertex gets the label of its match",
        "the label with most votes of the corners that it lies between, and of those around, as "
        "far as its match may be wrong; with `s4a.transfer_labels(..., blur=0)` of the corners "
        "alone",
        "on labels alone: 0 to 3 points (`applications.py parcels`, [decisions](decisions.md))",
    ),
    (
        "eq. 10",
        "the second maximum is divided by $n_{\\mathcal N}$",
        "the usual Hausdorff distance; as printed: `hausdorff_paper`, "
        '`s4a.metrics.hausdorff(..., formula="paper")`',
        "on the metric alone",
    ),
    (
        "eq. 11",
        "$f^\\top A L f$, $L$ the Laplacian",
        "$L = A^{-1} W$, so that it is $f^\\top W f$",
        "on the metric alone",
    ),
    (
        "5.2",
        "a preprocessing cleans the meshes",
        "the same cleaning for all methods, each repair in the report; lengths in parts of the "
        "square root of the area",
        "none on clean meshes, as these are",
    ),
]

TEXT = """# What differs from the paper

`preset="paper"` is the paper: in `s4a.analyse`, `s4a.match_pair`, `s4a.register_pairs`,
`s4a.compare`, every transfer of an external mesh, and as `--preset paper`. This page has what is
done otherwise by default, what the paper leaves open and how it is read here, and what each is
worth. To run the paper with one addition:
`s4a.analyse(shapes, **s4a.options.PRESETS["paper"] | {{"refine": "elastic"}})`. Equations and
sections are those of the paper; that its equations hold for arrays is tested by brute force
(`tests/method/test_paper.py`). What holds of the paper's claims stands on [a page of its
own](claims.md).

**How it is measured.** Six shapes of about 10,000 vertices, 2,000 at low resolution, all else as
in 5.1; all are registered to the first. Of every vertex of the template the distance between where
it is carried and where it truly is, mean over vertices and shapes, in % of the square root of the
area: to the *matched* vertex of the shape (eq. 4, 7), which cannot be nearer than the vertices lie
apart, and to the registered *surface*, template + displacement (eq. 8 and the line after it). CPU
seconds are of the whole analysis, in one run beside another program: differences of less than a
fifth say nothing. All else is as by default, or as the paper has it.

- *brains*: synthetic, in the same pose, each of 10,000 vertices of its own.
- *faces*: six identities of a published face model (006 to 011; of those before, 002 is so
  symmetric that it is taken for its own mirror image and would stand apart), registered, so that
  vertex i is vertex i. As they are given they share their vertices, which favours whatever looks
  for nearest neighbours. So each is **remeshed on its own** (PyMeshLab's isotropic remeshing; the
  mesh is subdivided first, as the remesher otherwise keeps vertices, the same ones of each shape),
  and the truth carried through the common triangles.
- *bodies*: one person in six poses that are far apart (FAUST registrations), remeshed in the same
  way.

`python benchmarks/additions.py --write` measures all of it into `docs/differences.csv` and
makes this page from it; `python benchmarks/differences.py --write` makes the page alone.

## All together

{summary}

## Additions, each with a switch

{switches}

Each alone, on top of the paper (errors: matched, surface):

{additions}

Elastic iterations and spectral non-rigid ICP on other sets: [measurements](decisions.md).
`articulated` and `dense_iterations` are shown with the options that they need: elastic iterations
and 1,000 samples. Where poses differ a lot, elastic iterations need `articulated`: without it,
bodies have larger errors than with the paper alone. `n_projected` is measured with 2,500 of 10,000
vertices, the same share as 25,000 of 100,000.
`initial_refinement`, `full_resolution_iterations` and `bidirectional` concern single pairs.

## Pairs that are matched on their own (4.1, 6.2)

The first shape registered to each of the others by `s4a.register_pairs`, with ZoomOut in the place
of Consistent ZoomOut. *Carried* is the error of 300 vertices of the template that are carried over
as landmarks (`s4a.transfer_landmarks`), along both matches of a pair where there are two.

{pairs}

## What the paper leaves open

| | equation | in the paper | read here as | another reading |
| --- | --- | --- | --- | --- |
{readings}

Each other reading on top of the paper:

{read}

**The norm of eq. 5.** The paper writes that of the Sobolev space $H_0^2$, in which $\\lVert f
\\rVert = \\lVert \\Lambda^0 f \\rVert$ with the eigenvalues $\\Lambda^0$ of the limit shape, and
does not say of what $D_i - I$ is an operator. `norm` has five readings; the choice decides which
shape is the median, and so the template, and nothing else. Errors are those of the registration to
that median.

{norms}

## Where there is no other reading to run

| equation | in the paper | here | effect |
| --- | --- | --- | --- |
{others}
"""
NORMS = {
    "h2": "$\\lVert (D - I) (\\Lambda^0)^\\dagger \\rVert_F$, from $H_0^2$ to $L^2$ (default)",
    "h1": "$\\lVert (D - I) ((\\Lambda^0)^\\dagger)^{1/2} \\rVert_F$, from $H_0^1$ to $L^2$",
    "frobenius": "$\\lVert D - I \\rVert_F$",
    "h2_image": "$\\lVert \\Lambda^0 (D - I) \\rVert_F$, from $L^2$ to $H_0^2$",
    "h2_both": "$\\lVert \\Lambda^0 (D - I) (\\Lambda^0)^\\dagger \\rVert_F$, "
    "from $H_0^2$ to itself",
}
PAIRS = {
    "pairs: paper": "the paper",
    "pairs: paper, refine": "and `refine`",
    "pairs: paper, init": "and `init`",
    "pairs: paper, ahead": "and `initial_refinement`",
    "pairs: paper, full_resolution_iterations": "and `full_resolution_iterations`",
    "pairs: paper, both": "and `bidirectional`",
    "pairs: default": "all of them, the default",
    "pairs: default without refine": "without `refine`",
    "pairs: default without init": "without `init`",
    "pairs: default without ahead": "without `initial_refinement`",
    "pairs: default without full_resolution_iterations": "without `full_resolution_iterations`",
    "pairs: default without both": "without `bidirectional`",
}


def results():
    """The rows of the results by set and name."""
    if not RESULTS.is_file():
        return {}
    with RESULTS.open(encoding="utf-8", newline="") as file:
        return {(line["set"], line["row"]): line for line in csv.DictReader(file)}


def keep(which, row, cells):
    """Put a row into the results, in the place of the one that it had."""
    found = results()
    found[which, row] = dict(zip(HEAD, [which, row, *cells], strict=True))
    with RESULTS.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, HEAD, lineterminator="\n")
        writer.writeheader()
        writer.writerows(found.values())


def figure(found, which, row, column):
    """A figure of the results, or that there is none."""
    return found[which, row][column] if (which, row) in found else LACKING


def both_errors(found, which, row):
    """Errors of the matches and of the surface in one cell."""
    if (which, row) not in found:
        return LACKING
    return f"{found[which, row]['matched']}, {found[which, row]['surface']}"


def table(head, rows):
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def measured(found, rows, columns=("matched", "surface", "seconds")):
    """A table of these rows (name in the results -> name on the page), three columns a set."""
    short = {"matched": "", "surface": "", "carried": "carried", "seconds": "CPU s"}
    head = [""]
    for which in SETS:
        head += [f"{which} {short[column]}".strip() for column in columns]
    cells = [
        [name, *(figure(found, which, row, column) for which in SETS for column in columns)]
        for row, name in rows.items()
    ]
    return table(head, cells)


def errors_of(found, rows):
    """The same with both errors in one cell."""
    head = ["", *(f"{which}{what}" for which in SETS for what in ("", ", CPU s"))]
    cells = []
    for row, name in rows.items():
        line = [name]
        for which in SETS:
            line += [both_errors(found, which, row), figure(found, which, row, "seconds")]
        cells.append(line)
    return table(head, cells)


def summary(found):
    """What the additions do on each set, in words made from the figures."""
    lines = []
    single = additions()
    for which in SETS:
        of = {row: float(line["surface"]) for (one, row), line in found.items() if one == which}
        if not {"paper", "default"} <= set(of):
            lines.append(f"- *{which}*: {LACKING} measured.")
            continue
        paper, default = of["paper"], of["default"]
        times = {row: of[row] / paper for row in single if row in of}
        best, worst = min(times, key=times.get), max(times, key=times.get)
        seconds = [float(found[which, row]["seconds"]) for row in ("paper", "default")]
        verdict = "nearer to the truth" if default < paper else "**farther from the truth**"
        line = (
            f"- *{which}*: the registered surface of the default is {verdict} than that of the "
            f"paper, {default:.3f} for {paper:.3f} ({default / paper:.2f} times), in "
            f"{seconds[1]:.1f} for {seconds[0]:.1f} CPU seconds."
        )
        for row, what in ((best, "takes most off"), (worst, "adds most")):
            if (times[row] < 0.99) if row == best else (times[row] > 1.01):
                line += f" Of the single additions {single[row]} {what} ({times[row]:.2f} times)."
        lines.append(line)
    return "\n".join(lines)


def additions():
    """The rows of the results in which one thing alone is added to the paper, and their names."""
    rows = {f"paper, {value}": f'`{option}="{value}"`' for value, option in OTHER.items()}
    return {f"paper, {option}": f"`{option}`" for option in PAPER} | rows


def line_of(name):
    """The line of the table of an option that the preset of the paper sets, as it is declared."""
    told = DECLARED[name].metadata
    text = told["help"] if not told["more"] else f"{told['help']}. {told['more']}"
    text = re.sub(r"``|:\w+:(?=`)", lambda mark: "`" if mark[0] == "``" else "", text)
    where = f"`{told['see']}`"
    values = f"`{name}`: {quoted(DEFAULTS[name])}, {quoted(PAPER[name])}{MORE.get(name, '')}"
    return [told["section"], told["instead"], text, where, values]


def quoted(value):
    """A value as it is written in Python."""
    return f'"{value}"' if isinstance(value, str) else str(value)


def page(found):
    """The page."""
    rows = {"paper": "the paper alone"}
    rows |= {
        row: f"and {name}"
        for row, name in additions().items()
        if any((which, row) in found for which in SETS)
    }
    rows |= {
        "default": "all of them, the default",
        "default without init": "the default without `init`",
        "default without parts": "the default without `articulated`",
        "default, joint": 'the default with `refine="spectral_icp"`',
        "default, lift": "the default and `refined_eigenfunctions`",
    }
    read = {"paper": "the paper as read here"}
    for number, reading in enumerate(READINGS, 1):
        read |= {f"paper, {row}": f"{number}: `{row}`" for row in reading.rows}
    norms = []
    for name, formula in NORMS.items():
        line = [f"`{name}`", formula]
        for which in SETS:
            row = f"paper, norm={name}"
            line += [figure(found, which, row, "template"), both_errors(found, which, row)]
        norms.append(line)
    heads = [f"{which}: {what}" for which in SETS for what in ("median", "errors")]
    return TEXT.format(
        summary=summary(found),
        switches=table(SWITCH, map(line_of, PAPER)),
        additions=errors_of(found, rows),
        pairs=measured(found, PAIRS, ("surface", "carried", "seconds")),
        readings="\n".join(
            f"| {number} | {r.equation} | {r.paper} | {r.here} | {r.other} |"
            for number, r in enumerate(READINGS, 1)
        ),
        read=errors_of(found, read),
        norms=table(["`norm`", "reading", *heads], norms),
        others="\n".join("| " + " | ".join(row) + " |" for row in OTHERS),
    )


def write_page():
    """Write the page from the results."""
    PAGE.write_text(page(results()), encoding="utf-8")


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        write_page()
    else:
        sys.stdout.write(page(results()))
