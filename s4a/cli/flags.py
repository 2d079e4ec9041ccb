"""Command line: ``s4a check | run | statistics | insert | transfer | compare | view | demo``.

Here are the flags and the exit codes; what the commands do is in :mod:`s4a.cli.commands`.  Every
option of :func:`s4a.analyse` is a flag of run.
"""

import argparse
import inspect
import logging
import sys

from s4a.cli import commands
from s4a.evaluation.compare import METHODS
from s4a.show.draw import VIEWS
from s4a.study.options import CHOICES, DEFAULTS
from s4a.study.pipeline import analyse
from s4a.study.store import VERSION

HELP = {
    "n_coarse": "vertices of the low-resolution meshes",
    "n_pairs": "pairs of the network",
    "k_init": "size of the first functional maps",
    "k": "size of the refined functional maps",
    "n_latent": "dimension of the latent space (default: k)",
    "step": "growth of the maps per round of Consistent ZoomOut",
    "init": "first maps from all nearest neighbours, or the paper's fit on 10 landmarks",
    "refine": "joint rounds, or the paper's spectral match alone",
    "how": "full resolution by eq. 7, or by eq. 3 and 4",
    "norm": "norm of eq. 5",
    "scale": "take size out of the displacements",
    "components": "'largest', 'all' or how many to keep",
    "strict": "exclude shapes with vertices that are not finite instead of repairing them",
    "close_holes": "close every hole by a fan of triangles",
    "wrap": "wrap the shapes watertight before they are remeshed",
    "intersections": "count triangles that pass through others",
    "pattern": "only files whose name fits, for example '*brain*'",
    "preset": "'paper' sets init, refine and how to the paper's",
    "template": "name of the shape to register to (default: the median shape)",
    "table": "CSV with a column 'shape', covariates and groups, for the statistics",
    "n_jobs": "processes; -1 for all cores",
    "seed": "seed of all randomness",
}
TRUTH = "for each target, NPY or text: per vertex of its file that of the source's (from 0; -1: none), or x, y, z"
LANDMARKS = "points by name, of the source's file and of each target's: Slicer .mrk.json, CSV or MeshLab .pp"


def components(text):
    """A number of components, or the word as it is."""
    return int(text) if text.isdigit() else text


def add_options(parser, names):
    """A flag for each of these options of `analyse`."""
    for name in names:
        default, text = inspect.signature(analyse).parameters[name].default, HELP[name]
        if isinstance(default, bool):
            kind = {"action": argparse.BooleanOptionalAction}
        elif name == "components":
            kind = {"type": components}
        elif name in CHOICES:
            kind = {"choices": [c for c in CHOICES[name] if c]}
            text += f" (default: {DEFAULTS.get(name, default)})"
        else:
            kind = {
                "type": int if isinstance(default, int) or name in ("n_latent", "n_jobs") else str
            }
            default = -1 if name == "n_jobs" else default
            text += "" if default is None else f" (default: {default})"
        parser.add_argument("--" + name.replace("_", "-"), default=default, help=text, **kind)


def parser():
    """The parser of all commands."""
    top = argparse.ArgumentParser(
        prog="s4a", description="Scalable spectral statistical shape analysis"
    )
    top.add_argument("--version", action="version", version=f"s4a {VERSION}")
    subparsers = top.add_subparsers(required=True, metavar="command")

    def command(function, **arguments):
        sub = subparsers.add_parser(
            function.__name__, help=function.__doc__, description=function.__doc__
        )
        sub.set_defaults(function=function)
        return sub

    sub = command(commands.check)
    sub.add_argument("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    add_options(sub, ["components", "pattern", "strict", "close_holes", "intersections"])
    sub = command(commands.run)
    sub.add_argument("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    sub.add_argument(
        "--out",
        required=True,
        metavar="STUDY",
        help="folder of the study; an unfinished one is resumed",
    )
    sub.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="dask scheduler tcp://host:port, or local:N worker processes",
    )
    add_options(sub, HELP)
    sub = command(commands.demo)
    sub.add_argument(
        "--out", default="demo", metavar="STUDY", help="folder of the study (default: demo)"
    )
    sub.add_argument("--shapes", type=int, default=12, help="number of shapes (default: 12)")
    sub.add_argument(
        "--vertices", type=int, default=40_000, help="vertices of each (default: 40000)"
    )
    sub.add_argument(
        "--dirty", action="store_true", help="with loose parts, holes and non-manifold places"
    )
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub.add_argument("--open", action="store_true", help="open the page in a browser")
    sub = command(commands.view)
    sub.add_argument("study", metavar="STUDY")
    sub.add_argument("--out", metavar="PAGE", help="file of the page (default: STUDY/study.html)")
    sub.add_argument("--title", help="title of the page (default: name of the folder)")
    sub.add_argument(
        "--view", default="corner", choices=list(VIEWS), help="from where (default: corner)"
    )
    sub.add_argument(
        "--up", default="z", choices=["x", "y", "z"], help="axis that points up (default: z)"
    )
    sub = command(commands.statistics)
    sub.add_argument("study", metavar="STUDY")
    sub.add_argument(
        "--group",
        metavar="COLUMN",
        help="test and map of the difference between groups; classification",
    )
    sub.add_argument(
        "--variable",
        metavar="COLUMN",
        help="regression of shape on a number, such as age; its animation",
    )
    sub.add_argument("--covariates", nargs="+", metavar="COLUMN", help="accounted for in both")
    sub.add_argument("--table", metavar="FILE", help="in place of the table of the study")
    sub.add_argument(
        "--recompute",
        action="store_true",
        help="generalization with correspondences found anew (slow)",
    )
    sub.add_argument(
        "--permutations",
        type=int,
        help="of every test (default: 9999, at every vertex 999, of classes 99)",
    )
    sub.add_argument("--out", metavar="DIR", help="for netCDF and CSV (default: STUDY/statistics)")
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub.add_argument("--seed", type=int, default=0, help=HELP["seed"])
    sub = command(commands.insert)
    sub.add_argument("study", metavar="STUDY")
    sub.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files, folders or globs")
    sub.add_argument(
        "--out", required=True, metavar="DIR", help="for inserted.nc, registered meshes and scores"
    )
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub = command(commands.transfer)
    sub.add_argument(
        "source", metavar="SOURCE", help="mesh file that the labels and landmarks belong to"
    )
    sub.add_argument(
        "targets",
        nargs="+",
        metavar="TARGET",
        help="mesh files, folders or globs; or one study folder",
    )
    sub.add_argument(
        "--labels",
        metavar="FILE",
        help="NPY, NPZ (FILE:NAME), CSV, GIFTI label or FreeSurfer annot, also .gz",
    )
    sub.add_argument(
        "--landmarks",
        metavar="FILE",
        help="points and curves: Slicer .mrk.json, CSV or MeshLab .pp",
    )
    sub.add_argument(
        "--out",
        required=True,
        metavar="DIR",
        help="for <target>.labels.npy, .confidence.npy, .landmarks.csv",
    )
    sub.add_argument("--n-coarse", type=int, default=6000, help=HELP["n_coarse"])
    sub.add_argument("--k", type=int, default=100, help=HELP["k"])
    sub.add_argument("--n-jobs", type=int, default=-1, help=HELP["n_jobs"])
    sub.add_argument("--seed", type=int, default=0, help=HELP["seed"])
    sub = command(commands.compare)
    sub.add_argument(
        "paths",
        nargs="*",
        metavar="SOURCE TARGET",
        help="the reference and one or more other meshes",
    )
    sub.add_argument(
        "--collection",
        nargs="+",
        metavar="PATH",
        help="Table 2 on these folders, globs or mesh files",
    )
    sub.add_argument("--methods", nargs="+", metavar="METHOD", help=f"of {', '.join(METHODS)}")
    sub.add_argument("--truth", nargs="+", metavar="FILE", help=TRUTH)
    sub.add_argument("--landmarks", nargs="+", metavar="FILE", help=LANDMARKS)
    sub.add_argument(
        "--out", default="compare", metavar="DIR", help="for compare.nc and compare.png"
    )
    sub.add_argument("--n-coarse", type=int, default=6000, help=HELP["n_coarse"])
    sub.add_argument("--n-pairs", type=int, default=500, help=HELP["n_pairs"])
    sub.add_argument("--k", type=int, default=100, help=HELP["k"])
    sub.add_argument("--seed", type=int, default=0, help=HELP["seed"])
    return top


def main(arguments=None):
    """Entry point; returns the exit code.

    And turns a ValueError or OSError into one line on the error stream.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    args = parser().parse_args(arguments)
    try:
        return args.function(args)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"s4a: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("s4a: interrupted; the same command goes on where it stopped\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())
