"""The commands that this extension adds: asymmetry, growth, covariation, complete and export."""

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s4a.cli import Command, add_options, number_or_name, whole
from s4a.cli.commands import study_to_test, template_labels, write

if TYPE_CHECKING:
    import xarray as xr

Add = Callable[..., Any]
# option of the functions of s4a_morphometrics.programs -> flag
GIVEN = {"n_points": "points", "n_modes": "modes", "landmarks": "landmarks", "grid": "grid"}


def add_test(add: Add, permuted: str, *, field: str = "", unequal: str = "") -> None:
    """The flags of every test, and those of a field and of variances where they are described."""
    if field:
        add("--covariates", nargs="+", metavar="COLUMN", help="accounted for")
        add("--field", metavar="NAME", help=field)
    if unequal:
        add("--variances", choices=("equal", "unequal"), default="equal", help=unequal)
    add("--table", metavar="FILE", help="in place of the table of the study")
    add("--keep-doubtful", action="store_true", help="take doubtful shapes in")
    add("--permutations", type=whole, help=f"{permuted} (default: 999)")
    add("--out", metavar="DIR", help="for netCDF, CSV, the page (default: STUDY/statistics)")
    add_options(add, ["seed"])


def drawn(args: Namespace) -> dict[str, Any]:
    """How often a test rearranges, and the seed."""
    given = {"n_permutations": args.permutations, "seed": args.seed}
    return {name: value for name, value in given.items() if value is not None}


def tell(study: "xr.DataTree", found: "xr.Dataset", what: str, lines: str, out: str) -> None:
    """Write a result as netCDF and CSV, and say what it found."""
    from s4a.analysis.export import write_results
    from s4a.cli import tables

    write_results(found, out, what)
    write(lines)
    if "p_family_wise" in found:
        tested = {"growth": "change within subjects", "asymmetry": "directional asymmetry"}
        write("\n" + tables.significance(found, found, tested[what], study))


def asymmetry(args: Namespace) -> int:
    """How left and right differ: shares of variance, directional asymmetry, antisymmetry.

    Every shape against its mirror image, or both sides of every subject.
    """
    from s4a import write_mesh, write_page
    from s4a.geometry.mesh import as_arrays
    from s4a_morphometrics import bilateral, words
    from s4a_morphometrics.halves import symmetric_template

    study, out = study_to_test(args.study, args.out, args.table, args.keep_doubtful)
    found = bilateral.asymmetry(
        study, subject=args.subject, side=args.side, of=args.of, **drawn(args)
    )
    tell(study, found, "asymmetry", words.asymmetry_table(found), out)
    if found.attrs["symmetry"] == "object":
        write_mesh(Path(out) / "symmetric.ply", *as_arrays(symmetric_template(study, found)))
    page = Path(out) / "asymmetry.html"
    write_page(bilateral.asymmetry_modes(study, found), page, title="Left against right")
    write(f"\nresults: {out}; the modes of asymmetry: {page}")
    return 0


def _asymmetry(add: Add) -> None:
    add("study", metavar="STUDY")
    text = "of left and right shapes: whose each is (without, every shape against its mirror image)"
    add("--subject", metavar="COLUMN", help=text)
    add("--side", metavar="COLUMN", help="and of which side")
    text = "what is tested at every vertex: along the normals, or vectors (default: normal)"
    add("--of", choices=["normal", "vector"], default="normal", help=text)
    add_test(add, "changes of sign")


def growth(args: Namespace) -> int:
    """How shape changes with time in subjects that were seen several times; its animation."""
    from s4a import statistics, write_film, write_page
    from s4a_morphometrics import longitudinal, words

    study, out = study_to_test(args.study, args.out, args.table, args.keep_doubtful)
    found = longitudinal.growth(
        study,
        args.time,
        args.subject,
        covariates=args.covariates or None,
        field=args.field,
        of=args.of,
        variances=args.variances,
        **drawn(args),
    )
    tell(study, found, "growth", words.growth_lines(found, args.time), out)
    if not args.field:
        moving = statistics.regression_modes(study, found, args.time)
        write_page(moving, Path(out) / "growth.html", title=f"Growth with {args.time}")
        write_film(moving, Path(out) / "growth.gif")
    write(f"\nresults: {out}")
    return 0


def _growth(add: Add) -> None:
    add("study", metavar="STUDY")
    add("--time", required=True, metavar="COLUMN", help="age, or time since the first visit")
    add("--subject", required=True, metavar="COLUMN", help="whose each shape is")
    text = "what is tested at every vertex: vectors, or along the normals (default: vector)"
    add("--of", choices=["vector", "normal"], default="vector", help=text)
    field = "a field of s4a fields in place of shape"
    unequal = "unequal where subjects change differently: signs of subjects (default: equal)"
    add_test(add, "of visits within subjects", field=field, unequal=unequal)


def covariation(args: Namespace) -> int:
    """How a field of s4a fields varies together with shape: partial least squares."""
    from s4a import write_page
    from s4a_morphometrics import two_block, words

    study, out = study_to_test(args.study, args.out, args.table, args.keep_doubtful)
    found = two_block.covariation(
        study, args.field, covariates=args.covariates or None, **drawn(args)
    )
    tell(study, found, "covariation", words.covariation_lines(found), out)
    title = f"Shape with {args.field}"
    write_page(
        two_block.covariation_modes(study, found), Path(out) / "covariation.html", title=title
    )
    write(f"\nresults: {out}")
    return 0


def _covariation(add: Add) -> None:
    add("study", metavar="STUDY")
    add("field", metavar="FIELD", help="name of a field of s4a fields")
    add("--covariates", nargs="+", metavar="COLUMN", help="accounted for")
    add_test(add, "of the shapes")


def complete(args: Namespace) -> int:
    """A part of a shape matched to a finished study, and the whole that it may be of."""
    from s4a import open_study
    from s4a_morphometrics import completion, words

    found = completion.complete(
        open_study(args.study),
        args.part,
        landmarks=args.landmarks,
        components=args.components,
        n_samples=args.samples,
        seed=args.seed,
    )
    paths = completion.write_completed(found, args.out)
    write("\n".join(words.completed_lines(found)))
    write(f"\nwritten: {', '.join(map(str, paths[:2]))}, samples: {len(paths) - 2}")
    return 0


def _complete(add: Add) -> None:
    add("study", metavar="STUDY")
    add("part", metavar="PART", help="mesh file of a part of a shape")
    add("--out", required=True, metavar="DIR", help="for completed.nc and PLY")
    text = "landmarks of the part by the names of the template's, three or more: how it lies"
    add("--landmarks", metavar="FILE", help=text)
    text = "shapes drawn from all that agree with the part (default: 10)"
    add("--samples", type=whole, default=10, help=text)
    text = "pieces of the part to keep, or 'largest' (default: as in the study)"
    add("--components", type=number_or_name, help=text)
    add_options(add, ["seed"])


def export(args: Namespace) -> int:
    """A study in the files of Slicer, ShapeWorks, Scalismo, ParaView, R, or as label volumes."""
    from s4a import open_study
    from s4a.input.annotations import read_landmarks
    from s4a_morphometrics.programs import write_for

    study = open_study(args.study)
    given = {option: getattr(args, flag) for option, flag in GIVEN.items()}
    options = {option: value for option, value in given.items() if value is not None}
    if args.landmarks:
        options["landmarks"] = read_landmarks(args.landmarks)
    if args.labels:
        options["label"] = template_labels(study, args.labels)
    paths = write_for(study, args.out, args.to, **options)
    write(f"{len(paths)} files for {args.to} in {args.out}, such as {paths[-1].name}")
    return 0


def _export(add: Add) -> None:
    from s4a_morphometrics.programs import PROGRAMS

    add("study", metavar="STUDY")
    add("--to", required=True, choices=list(PROGRAMS), help="for which program")
    add("--out", required=True, metavar="DIR", help="for its files")
    text = "vertices that are points or particles, as far apart as can be (default: 500)"
    add("--points", type=whole, help=f"slicer, shapeworks, r: {text}")
    text = "scalismo, paraview: the first modes (default: all; paraview: 3)"
    add("--modes", type=whole, help=text)
    text = "slicer: landmarks of the template's file, carried to all shapes (default: its own)"
    add("--landmarks", metavar="FILE", help=text)
    text = "nifti: labels of the template's file, whole numbers (default: its own)"
    add("--labels", metavar="FILE", help=text)
    text = "nifti: volume whose voxels are labelled (default: that each shape was made of)"
    add("--grid", metavar="FILE", help=text)


ASYMMETRY = Command(asymmetry, _asymmetry)
GROWTH = Command(growth, _growth)
COVARIATION = Command(covariation, _covariation)
COMPLETE = Command(complete, _complete)
EXPORT = Command(export, _export)
