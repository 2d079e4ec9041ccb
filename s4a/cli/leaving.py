"""The command that writes a study for other programs, see :mod:`s4a.cli.commands`."""

from argparse import Namespace

from s4a.cli.commands import template_labels, write

# option of the functions of s4a.analysis.programs -> flag
GIVEN = {"n_points": "points", "n_modes": "modes", "landmarks": "landmarks", "grid": "grid"}


def export(args: Namespace) -> int:
    """A study in the files of Slicer, ShapeWorks, Scalismo, ParaView, R, or as label volumes."""
    from s4a.analysis.programs import write_for
    from s4a.input.annotations import read_landmarks
    from s4a.study.tree import open_study

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
