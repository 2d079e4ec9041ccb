"""Commands of multi-structure studies: flags, actions and output."""

from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from s4a.cli.commands import SYSTEM, exit_code, on_cluster, within, write
from s4a.cli.flags import Command, add_options, whole
from s4a.options import DECLARED

FOLDERS = "folder with a folder of landmark files per structure, or files named as in the table"
OPTIONS = [*(name for name in DECLARED if name != "label"), "n_jobs"]
TABLE = "CSV with columns shape, subject and structure"


def run(args: Namespace) -> int:
    """Analyse every structure of each subject: files and a table, or label volumes."""
    from s4a.cli.tables import run_summary
    from s4a_morphometrics.several import analyse_structures

    given = dict(args.structures) if args.structures else None
    options = {name: getattr(args, name) for name in OPTIONS}
    with on_cluster(args.cluster):
        study = analyse_structures(args.paths, store=args.out, structures=given, **options)
    parts = study["structures"].children
    for name, part in parts.items():
        write(f"structure {name}, study in {args.out}/structures/{name}")
        write(run_summary(part))
    write(f"\ns4a structures {args.out} compares them")
    reports = [part["report"] for part in parts.values()]
    unforeseen = any(report.attrs["unforeseen"] for report in reports)
    return exit_code([report["status"] for report in reports], args.fail_on, int(unforeseen))


def insert(args: Namespace) -> int:
    """Register new subjects to the studies of several structures, which stay unchanged."""
    from s4a.analysis.export import write_registered
    from s4a.cli.tables import inserted_table
    from s4a.input.raw import new_folder
    from s4a.study.tree import write_inserted
    from s4a_morphometrics.several import insert_structures, open_structures

    study = open_structures(args.study)
    options = {
        name: getattr(args, name) for name in ("landmarks", "reflect", "table", *SYSTEM, "n_jobs")
    }
    inserted = insert_structures(study, args.shapes, **options)
    out = new_folder(args.out)
    path = write_inserted(inserted, out)
    for name, part in inserted["structures"].children.items():
        write_registered(part, out / "structures" / name)
        write(f"structures/{name}\n{inserted_table(part)}")
    write(f"\nwritten: {path}, registered meshes and scores in {out}")
    status = inserted["report"]["structure_status"]
    return exit_code([status], args.fail_on, int((status == "excluded").any()))


def compare(args: Namespace) -> int:
    """Analyse the variation of structures in relative pose and in shape."""
    from s4a.analysis.export import write_results, write_scores
    from s4a.analysis.statistics import group_test
    from s4a.show.page import write_page
    from s4a.study.tree import open_inserted
    from s4a_morphometrics import poses, structures_tables
    from s4a_morphometrics.several import open_structures

    study = open_structures(args.study)
    out = Path(args.out) if args.out else within(args.study, "statistics")
    options = {} if args.permutations is None else {"n_permutations": args.permutations}
    inserted = open_inserted(args.new) if args.new else None
    result = poses.structures(study, remove_size=args.remove_size, seed=args.seed, **options)
    write_results(result, out, "structures")
    write(structures_tables.structure_lines(result))
    new = None
    if inserted is not None:
        new = poses.structures_of_new(result, inserted)
        write_results(new, out, "new_structures")
        write(f"\nnew subjects\n{structures_tables.pose_table(new)}\n")
    for level in poses.LEVELS:
        if level in result["level"] and not result["level_share"].sel(level=level).any():
            write(f"{level}: no variation")
            continue
        level_study = poses.structures_modes(study, result, level)
        ratio = level_study["pca"].dataset["explained_variance_ratio"].values[:5]
        shares = ", ".join(f"{100 * share:.1f}" for share in ratio)
        write(f"{level}: modes of {shares} % of its variance")
        if args.group:
            test = group_test(level_study, args.group, seed=args.seed, **options)
            write(f"  groups of {args.group}: p = {test['p_value'].item():.3g}")
        if new is not None:
            scores = poses.structures_modes(study, result, level, new)["pca"].to_dataset()
            write(structures_tables.new_score_lines(scores))
            write_scores(scores, out / f"new_{level}.csv")
        write_page(level_study, out / f"{level}.html", title=f"Structures: {level}")
    write(f"\nresults: {out}")
    return 0


def named_label(text: str) -> tuple[str, str]:
    """Parse a structure and its label or labels, such as ``left=17``."""
    name, equals, label = text.partition("=")
    if not (name and equals and label):
        raise ArgumentTypeError(
            f"a structure and its label needed, such as left=17: found {text!r}"
        )
    return name, label


def _fail_on(add: Callable[..., Any]) -> None:
    text = "end with exit code 3 if shapes are excluded, or also if they are flagged"
    add("--fail-on", choices=("none", "excluded", "flagged"), default="none", help=text)


def _run(add: Callable[..., Any]) -> None:
    add("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files, or label volumes")
    text = "folder of the study; an unfinished one is resumed"
    add("-o", "--out", required=True, metavar="FOLDER", help=text)
    text = "dask scheduler tcp://host:port, or local:N worker processes"
    add("--cluster", metavar="ADDRESS", help=text)
    text = "label volumes with several structures each: left=17 right=53"
    add("--structures", nargs="+", type=named_label, metavar="NAME=LABEL", help=text)
    _fail_on(add)
    add_options(add, OPTIONS)


def _insert(add: Callable[..., Any]) -> None:
    add("study", metavar="STUDY")
    add("shapes", nargs="+", metavar="SHAPE", help="mesh files, label volumes, folders or globs")
    text = "for inserted.nc, registered meshes and scores"
    add("-o", "--out", required=True, metavar="FOLDER", help=text)
    add("--landmarks", metavar="PATH", help=FOLDERS)
    text = "new subjects to mirror: names, with commas; COLUMN=VALUE of the table; or auto"
    add("--reflect", metavar="NAMES", help=text)
    add("--table", metavar="PATH", help=TABLE)
    _fail_on(add)
    add_options(add, [*SYSTEM, "n_jobs"])


def _compare(add: Callable[..., Any]) -> None:
    add("study", metavar="STUDY")
    add("--remove-size", action="store_true", help="remove the size of each whole subject")
    text = "also test groups for differences in relative pose and in shape"
    add("--group", metavar="COLUMN", help=text)
    text = "folder of s4a insert-structures, or its inserted.nc: poses and scores of new subjects"
    add("--new", metavar="DIR", help=text)
    add("--permutations", type=whole, metavar="N", help="of the subjects (default: 999)")
    text = "for netCDF, CSV, the pages (default: STUDY/statistics)"
    add("-o", "--out", metavar="FOLDER", help=text)
    add_options(add, ["seed"])


RUN, INSERT, COMPARE = Command(run, _run), Command(insert, _insert), Command(compare, _compare)
