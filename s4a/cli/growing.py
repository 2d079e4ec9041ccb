"""The commands of fields and structures, see :mod:`s4a.cli.commands`."""

from argparse import Namespace
from pathlib import Path

from s4a.cli.commands import within, write


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


def structures(args: Namespace) -> int:
    """How structures vary in how they lie to each other, and each in its shape."""
    from s4a.analysis import statistics as tests
    from s4a.analysis.export import write_results, write_scores
    from s4a.analysis.structures import LEVELS
    from s4a.cli import results
    from s4a.show.page import write_page
    from s4a.study.tree import open_inserted, open_study

    study = open_study(args.study)
    out = Path(args.out) if args.out else within(args.study, "statistics")
    options = {} if args.permutations is None else {"n_permutations": args.permutations}
    inserted = open_inserted(args.new) if args.new else None
    found = tests.structures(study, scale=args.scale, seed=args.seed, **options)
    write_results(found, out, "structures")
    write(results.structure_lines(found))
    new = None
    if inserted is not None:
        new = tests.structures_of_new(found, inserted)
        write_results(new, out, "new_structures")
        write(f"\nnew subjects\n{results.pose_table(new)}\n")
    for level in LEVELS:
        if level in found["level"] and not found["level_share"].sel(level=level).any():
            write(f"{level}: nothing varies")
            continue
        of_level = tests.structures_modes(study, found, level)
        write(results.level_line(of_level["pca"].to_dataset(), level))
        if args.group:
            test = tests.group_test(of_level, args.group, seed=args.seed, **options)
            write(f"  groups of {args.group}: p = {test['p_value'].item():.3g}")
        if new is not None:
            scores = tests.structures_modes(study, found, level, new)["pca"].to_dataset()
            write(results.new_score_lines(scores))
            write_scores(scores, out / f"new_{level}.csv")
        write_page(of_level, out / f"{level}.html", title=f"Structures: {level}")
    write(f"\nresults: {out}")
    return 0
