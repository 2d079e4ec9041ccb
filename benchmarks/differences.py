"""Generate ``docs/differences.md`` from the text below and figures in ``docs/differences.csv``.

``differences.py`` prints it, ``differences.py --write`` writes it.  The figures are measured by
``additions.py --write``.
"""

import csv
import re
import sys
from pathlib import Path
from typing import NamedTuple

from s4a.options import DECLARED, HELP, NOTES, PRESETS

PAPER = PRESETS["paper"]
DEFAULTS = {name: PRESETS[None][name] for name in PAPER}
DOCS = Path(__file__).parents[1] / "docs"
RESULTS = DOCS / "differences.csv"
PAGE = DOCS / "differences.md"
HEAD = ["set", "row", "matched", "surface", "carried", "seconds", "template"]
HEAD += ["rotation", "displacement", "modes"]
SETS = ("brains", "faces", "bodies")
SWITCH = ["equation", "in the paper", "in S4A", "where", "option: default, in the paper"]
LACKING = "not yet"  # instead of a figure that was not measured


# additions that are another value of an option than its default, with rows of their own
OTHER = {"spectral_icp": "refine"}
MORE = {  # notes of the table on a value
    "refined_eigenfunctions": "; `RE-MATCH refined` of `s4a.compare`: True",
    "full_resolution_iterations": "; `RE-MATCH refined` of `s4a.compare`: 2",
    "n_samples": ", all",
    "n_projected": ", all",
}


class Reading(NamedTuple):
    """An open point of the paper, or a step by other code, and its implementation here."""

    equation: str
    paper: str
    here: str
    other: str  # option or function of another reading
    rows: tuple[str, ...]  # rows of the results, if measured
    effect: str = ""  # if not measured


READINGS = [
    Reading(
        "4.2",
        "two methods for full resolution, *standard* and *ours*",
        "*ours*, eq. 7",
        '`dense_match="fmap"`: eq. 3 and 4',
        ("dense_match=fmap",),
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
        "Consistent ZoomOut without a step of ZoomOut before it is unsatisfactory",
        "one step of ZoomOut before",
        '`initial_refinement="never"`',
        ("initial_refinement=never",),
    ),
    Reading(
        "eq. 3",
        "no weights of the maps",
        "$\\exp(-(e / s)^2 / 2)$, with $e$ the mean error of the 3-cycles of a map and $s$ its "
        "median",
        '`weights="equal"`; Huang et al. (2020) and pyFM: `weights="linear_program"`, the same '
        "with $e$ from a linear program",
        ("weights=equal", "weights=linear_program"),
    ),
    Reading(
        "3.4, 4.2",
        "Consistent ZoomOut of Huang et al. (2020); the code is based on pyFM",
        "both maps of a pair are refined independently",
        "`isometric=True`: before every latent basis, the more orthogonal one of the two maps of a "
        "pair and its transpose replace both, as in pyFM",
        ("isometric=True",),
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
        "no growth per iteration",
        "5 functions",
        "`step=10`",
        ("step=10",),
    ),
    Reading(
        "4.1, step 1",
        "ReMatching's mesh: the dual of geodesic Voronoi cells of farthest points along the "
        "surface; $U$ from the point of the coarse mesh that is closest in space",
        "the same dual; farthest points of position *and normal*, more samples where it is not "
        "manifold, thin handles cut; $U$ from the coarse triangles around the vertex's own cell, "
        "so that it never interpolates across a thin wall",
        '$U$ as ReMatching has it (no option); `sampling="geodesic"`: samples and $U$',
        ("U by closest points in space", "sampling=geodesic"),
    ),
    Reading(
        "4.1, step 2",
        "ICP",
        'with `preset="paper"` plain ICP: each vertex of the source and the nearest of the target, '
        "from the given pose with centroids aligned, for each pair",
        '`alignment="given"`: no ICP; or `alignment="search"`, an addition',
        ("alignment=given",),
    ),
    Reading(
        "4.1, step 4",
        "a map is optimised with landmarks; the code is based on pyFM",
        "heat kernels around the landmarks at 8 times, with a penalty for a map that does not "
        "commute with the Laplacians",
        '`init="wave_kernels"`: the fit of pyFM 1.3.1, to wave kernels of the shapes and around '
        "the landmarks",
        ("init=wave_kernels",),
    ),
]

OTHERS = [
    (
        "4.1, step 3",
        "10 points are sampled",
        "10 farthest-point samples, which are the same for the same shape",
        "not measured",
    ),
    (
        "3.4, 5.1",
        "500 edges of 1,275, connected",
        "a spanning tree of shapes with similar spectra, edges that close triangles, then the "
        "nearest pairs; each pair has a map in both directions",
        "none on these sets, where all 15 pairs are used",
    ),
    (
        "3.5, eq. 5",
        "$Y_i$ as they come",
        "rotated such that the mean of $Y_i^\\top \\Lambda_i Y_i$ is diagonal, as in the canonical "
        "basis of Huang et al. (2019)",
        "none on matches: eq. 3, 6 and 7 are invariant to rotation",
    ),
    (
        "4.1, SCALABLE",
        "eigenvalues of the Laplacian restricted to the local functions",
        "the same; they are too large, by 5 % on a sphere and 12 to 15 % on a head "
        "(`method/scalable`), because the functions cannot represent a linear one exactly",
        "on eq. 5 and on the choice of pairs only; no match uses eigenvalues",
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
        "on modes only, none on matches",
    ),
    (
        "6.2",
        "a vertex gets the label of its match",
        "the label with most votes of the corners of its triangle and of those around, within "
        "the uncertainty of the match; with `s4a.transfer_labels(..., blur=0)` of the corners "
        "only",
        "on labels only: 0 to 3 points (`applications.py parcels`, [decisions](decisions.md))",
    ),
    (
        "eq. 10",
        "the second maximum is divided by $n_{\\mathcal N}$",
        "the usual Hausdorff distance; as printed: `hausdorff_paper`, "
        '`s4a.metrics.hausdorff(..., formula="paper")`',
        "on the metric only",
    ),
    (
        "eq. 11",
        "$f^\\top A L f$, $L$ the Laplacian",
        "$L = A^{-1} W$, so that it is $f^\\top W f$",
        "on the metric only",
    ),
    (
        "5.2",
        "a preprocessing cleans the meshes",
        "the same cleaning for all methods, with each repair in the report; lengths relative to "
        "the square root of the area",
        "none on clean meshes such as these",
    ),
]

TEXT = """# Differences from the paper: additions, readings, effect of each

This validation page lists the differences between the defaults of S4A and the paper. They are
additions of S4A, and S4A's reading of points that the paper leaves open. The effect of each is
measured. Equation and section numbers are those of the paper. [The paper's claims](claims.md) are
on another page.

`preset="paper"` switches all additions off, in `s4a.analyse`, `s4a.match_pair`,
`s4a.register_pairs`, `s4a.compare` and every transfer of an external mesh. On the command line it
is `--preset paper`.
To run the paper with one addition:
`s4a.analyse(shapes, **s4a.options.PRESETS["paper"] | {{"refine": "elastic"}})`.

Tests compare each equation with a brute-force implementation (`tests/method/test_paper.py`), and a
whole study with an independent implementation of the paper by numpy, scipy and pyFM
(`tests/independent.py`). From the same low-resolution meshes it has the same rigid transforms,
landmarks and initial maps (to 1e-12), the same median, latent bases to 2e-3, energies to 1 %, and
more than 99 % of the matches of eq. 6 and 7. The rest comes from the tolerance of intermediate
latent bases, 1e-4: a vertex with two nearly equal distances may match another vertex.

**Data.** Each set has six shapes of about 10,000 vertices, 2,000 at low resolution. All other
settings are as in 5.1. All shapes are registered to the first.

- *brains*: synthetic, in the same pose. Each brain has its own 10,000 vertices.
- *faces*: six identities of a published face model (006 to 011; 002 is so symmetric that it is
  flagged as its own mirror image). Vertex i of one face corresponds to vertex i of another, which
  favours every nearest-neighbour search. Therefore each face is **remeshed separately** by
  PyMeshLab's isotropic remeshing. Each face is subdivided first, because the remesher otherwise
  keeps the same vertices of each shape. The ground truth is interpolated in the common triangles.
- *bodies*: one person in six different poses (FAUST registrations), remeshed in the same way.

**Error.** The error is the mean distance between the image of a template vertex and its true
position, over vertices and shapes, in % of the square root of the area. There are two images: the
*matched* vertex of the shape (eq. 4, 7), which cannot be more accurate than the vertex spacing, and
the registered *surface*, template + displacement (eq. 8 and the line after it). These two do not
depend on the rigid transformation. Therefore three more figures are given: the mean angle in
degrees between the rotation of the initial alignment and the best one for the true positions; the
mean distance, in % of the square root of the area, between the displacement and the true one after
the best rigid transformation; and the mean |cos| between each of the first three principal
components of the true displacements and the most similar of the first three modes. CPU seconds are
of the whole analysis, in one run while another program was running. Differences of less than a
fifth have no meaning.

`python benchmarks/additions.py --write` measures everything into `docs/differences.csv` and
writes this page; `python benchmarks/differences.py --write` writes the page only.

## All additions together

{summary}

## Additions, each with an option

{switches}

Each addition alone, on top of the paper (errors: matched, surface):

{additions}

[Design decisions](decisions.md) compares elastic registration with spectral ICP on other sets.
`articulated` and `dense_iterations` are shown together with the additions that they need: elastic
registration, and 1,000 farthest-point samples. If pose differences are large, elastic registration
needs `articulated`: without it, bodies are less accurate than with the paper alone. `n_projected`
is measured with 2,500 of 10,000 vertices, the same share as 25,000 of 100,000.
`initial_refinement`, `full_resolution_iterations` and `bidirectional` concern single pairs.

## Single pairs (4.1, 6.2)

`s4a.register_pairs` registers the first shape to each of the others, with ZoomOut in place of
Consistent ZoomOut. For *transferred*, 300 vertices of the template are transferred as landmarks
(`s4a.transfer_landmarks`), along both matches of a pair if there are two.

{pairs}

## What the paper leaves open

| | equation | in the paper | reading of S4A | another reading |
| --- | --- | --- | --- | --- |
{readings}

Each other reading on top of the paper:

{read}

**Which reading did the paper use?** Most likely those of pyFM in rows 4, 5, 6 and 10, because 5.1
says that the implementation is based on pyFM and names none of these parameters. In pyFM,
`FMN.zoomout_refine` has `isometric=True`, weights by the linear program and a latent basis of 0.9
times the size of the maps as defaults. Until its
[issue 20](https://github.com/RobinMagnet/pyFM/issues/20) (January 2026) it even ignored
`isometric=False`. All of them together:
`PRESETS["paper"] | {{"isometric": True, "weights": "linear_program", "n_latent": 90}}`, and
`"init": "wave_kernels"` for the fit. The preset keeps the equations as printed, which have no such
steps. Tests compare `isometric` and the linear program (`tests/method/test_paper.py`) and the fit
(`tests/method/test_descriptors.py`) with pyFM (pyfmaps 1.3.1). One difference is intended: around
a cycle, pyFM 1.3.1 multiplies $C_{{ij}} C_{{jk}} C_{{ki}}$. As $C_{{ij}}$ maps functions from $i$
to $j$, that product is not $I$ for consistent maps; S4A multiplies $C_{{ki}} C_{{jk}} C_{{ij}}$.

With `isometric=True` the energies of eq. 5 are 11 to 28 times smaller on the brains and 32 to 63
times on the faces (with their common mesh), since orthogonal maps have $D_i$ near $I$. The median
is brain_04 in place of brain_03, and identity006 in place of identity007. The match of eq. 7 moves
by 0.19 and 0.12 % of the square root of the area on average.

**The norm of eq. 5.** The paper writes the norm of the Sobolev space $H_0^2$, in which $\\lVert f
\\rVert = \\lVert \\Lambda^0 f \\rVert$ with the eigenvalues $\\Lambda^0$ of the limit shape. It
does not say between which spaces $D_i - I$ is an operator. `norm` offers five interpretations.
The norm decides only which shape is the median, and therefore the template.
Errors are those of the registration to that median.

{norms}

## Differences without another reading to run

| equation | in the paper | S4A | effect |
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
    "pairs: paper, initial_refinement": "and `initial_refinement`",
    "pairs: paper, full_resolution_iterations": "and `full_resolution_iterations`",
    "pairs: paper, bidirectional": "and `bidirectional`",
    "pairs: default": "all of them, the default",
    "pairs: default without refine": "without `refine`",
    "pairs: default without init": "without `init`",
    "pairs: default without initial_refinement": "without `initial_refinement`",
    "pairs: default without full_resolution_iterations": "without `full_resolution_iterations`",
    "pairs: default without bidirectional": "without `bidirectional`",
}


def results():
    """Return the rows of the results by set and name."""
    if not RESULTS.is_file():
        return {}
    with RESULTS.open(encoding="utf-8", newline="") as file:
        lines = (dict.fromkeys(HEAD, "") | line for line in csv.DictReader(file))
        return {(line["set"], line["row"]): line for line in lines}


def keep(which, row, cells):
    """Add or replace a row of the results."""
    rows = results()
    rows[which, row] = dict(zip(HEAD, [which, row, *cells], strict=True))
    with RESULTS.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, HEAD, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows.values())


def figure(found, which, row, column):
    """Return a figure of the results, or ``LACKING``."""
    return found[which, row][column] if (which, row) in found else LACKING


def both_errors(found, which, row):
    """Return the errors of matches and surface in one cell."""
    if (which, row) not in found:
        return LACKING
    return f"{found[which, row]['matched']}, {found[which, row]['surface']}"


def table(head, rows):
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def measured(found, rows, columns=("matched", "surface", "seconds")):
    """Return a table of rows (name in the results -> name on the page), three columns a set."""
    short = {"matched": "", "surface": "", "carried": "transferred", "seconds": "CPU s"}
    head = [""]
    for which in SETS:
        head += [f"{which} {short[column]}".strip() for column in columns]
    cells = [
        [name, *(figure(found, which, row, column) for which in SETS for column in columns)]
        for row, name in rows.items()
    ]
    return table(head, cells)


def errors_of(found, rows):
    """Return the same table with both errors in one cell."""
    whats = ("", ": rotation, displacement, modes", ", CPU s")
    head = ["", *(f"{which}{what}" for which in SETS for what in whats)]
    cells = []
    for row, name in rows.items():
        line = [name]
        for which in SETS:
            fields = [figure(found, which, row, column) for column in HEAD[-3:]]
            fields = ", ".join(fields) if all(fields) else LACKING
            line += [both_errors(found, which, row), fields, figure(found, which, row, "seconds")]
        cells.append(line)
    return table(head, cells)


def summary(found):
    """Describe the effect of the additions on each set."""
    lines = []
    single = additions()
    for which in SETS:
        errors = {
            row: float(line["surface"]) for (name, row), line in found.items() if name == which
        }
        if not {"paper", "default"} <= set(errors):
            lines.append(f"- *{which}*: {LACKING} measured.")
            continue
        paper, default = errors["paper"], errors["default"]
        times = {row: errors[row] / paper for row in single if row in errors}
        best, worst = min(times, key=times.get), max(times, key=times.get)
        seconds = [float(found[which, row]["seconds"]) for row in ("paper", "default")]
        verdict = "more accurate" if default < paper else "**less accurate**"
        line = (
            f"- *{which}*: the registered surface of the default is {verdict} than that of the "
            f"paper: error {default:.3f}, paper {paper:.3f} ({default / paper:.2f} times); "
            f"{seconds[1]:.1f} CPU seconds, paper {seconds[0]:.1f}."
        )
        for row, what in ((best, "reduces the error most"), (worst, "increases it most")):
            if (times[row] < 0.99) if row == best else (times[row] > 1.01):
                line += f" Of the single additions {single[row]} {what} ({times[row]:.2f} times)."
        lines.append(line)
    return "\n".join(lines)


def additions():
    """Return the rows of the results with one addition to the paper, and their names."""
    rows = {f"paper, {value}": f'`{option}="{value}"`' for value, option in OTHER.items()}
    return {f"paper, {option}": f"`{option}`" for option in PAPER} | rows


def line_of(name):
    """Return the row of the table for an option that the preset of the paper sets."""
    declared = DECLARED[name].metadata
    text = ". ".join(filter(None, [HELP[name], NOTES[name].removesuffix(".")]))
    text = re.sub(r"``|:\w+:(?=`)", lambda mark: "`" if mark[0] == "``" else "", text)
    text = text[0].upper() + text[1:].replace(".  ", ". ")
    where = f"`{declared['see']}`"
    values = f"`{name}`: {quoted(DEFAULTS[name])}, {quoted(PAPER[name])}{MORE.get(name, '')}"
    return [declared["section"], declared["instead"] or "not present", text, where, values]


def quoted(value):
    """Return a value in Python notation."""
    return f'"{value}"' if isinstance(value, str) else str(value)


def page(found):
    """Return the text of the page."""
    rows = {"paper": "the paper alone"}
    rows |= {
        row: f"and {name}"
        for row, name in additions().items()
        if any((which, row) in found for which in SETS)
    }
    rows |= {
        "default": "all of them, the default",
        "default without init": "the default without `init`",
        "default without articulated": "the default without `articulated`",
        "default, spectral_icp": 'the default with `refine="spectral_icp"`',
        "default, refined_eigenfunctions": "the default and `refined_eigenfunctions`",
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
