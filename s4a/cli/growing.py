"""The commands of fields and of growth, see :mod:`s4a.cli.commands`."""

from argparse import Namespace

from s4a.cli.commands import write


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
