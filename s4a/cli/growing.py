"""The commands of fields, growth and asymmetry, see :mod:`s4a.cli.commands`."""

from argparse import Namespace
from pathlib import Path

from s4a.cli.commands import study_to_test, write


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


def growth(args: Namespace) -> int:
    """How shape changes with time in subjects that were seen several times; its animation."""
    from s4a.analysis import statistics as tests
    from s4a.analysis.export import write_results
    from s4a.cli import results, tables
    from s4a.show.page import write_page
    from s4a.show.pictures import write_film

    study, out = study_to_test(args)
    options = {} if args.permutations is None else {"n_permutations": args.permutations}
    found = tests.growth(
        study,
        args.time,
        args.subject,
        covariates=args.covariates or None,
        field=args.field,
        of=args.of,
        variances=args.variances,
        seed=args.seed,
        **options,
    )
    write_results(found, out, "growth")
    write(results.growth_lines(found, args.time))
    write("\n" + tables.significance(found, found, "change within subjects", study))
    if not args.field:
        moving = tests.regression_modes(study, found, args.time)
        write_page(moving, Path(out) / "growth.html", title=f"Growth with {args.time}")
        write_film(moving, Path(out) / "growth.gif")
    write(f"\nresults: {out}")
    return 0


def asymmetry(args: Namespace) -> int:
    """How left and right differ: shares of variance, directional asymmetry, antisymmetry.

    Every shape against its mirror image, or both sides of every subject.
    """
    from s4a.analysis import statistics as tests
    from s4a.analysis.export import write_results
    from s4a.cli import tables
    from s4a.geometry.mesh import as_arrays
    from s4a.input.files import write_mesh
    from s4a.show.page import write_page

    study, out = study_to_test(args)
    options = {} if args.permutations is None else {"n_permutations": args.permutations}
    found = tests.asymmetry(
        study, subject=args.subject, side=args.side, of=args.of, seed=args.seed, **options
    )
    write_results(found, out, "asymmetry")
    write(tables.asymmetry_table(found))
    write("\n" + tables.significance(found, found, "directional asymmetry", study))
    if found.attrs["symmetry"] == "object":
        write_mesh(Path(out) / "symmetric.ply", *as_arrays(tests.symmetric_template(study, found)))
    page = Path(out) / "asymmetry.html"
    write_page(tests.asymmetry_modes(study, found), page, title="Left against right")
    write(f"\nresults: {out}; the modes of asymmetry: {page}")
    return 0
