"""Command line: ``s4a check | run | statistics | insert | transfer | compare | view | demo``.

Here are the flags and the exit codes; what the commands do is in :mod:`s4a.cli.commands`.  Every
option of :func:`s4a.analyse` is a flag of run.
"""

import argparse
import logging
import sys
from collections.abc import Callable, Iterable
from typing import Any

from s4a.cli import commands
from s4a.evaluation.compare import METHODS
from s4a.show.draw import VIEWS
from s4a.study.options import CHOICES, DEFAULTS, Options
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


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = argparse.ArgumentParser(
        prog="s4a", description="Scalable spectral statistical shape analysis"
    )
    top.add_argument("--version", action="version", version=f"s4a {VERSION}")
    subparsers = top.add_subparsers(required=True, metavar="command")
    for command, add_flags in FLAGS.items():
        text = command.__doc__
        sub = subparsers.add_parser(command.__name__, help=text, description=text)
        sub.set_defaults(function=command)
        add_flags(sub.add_argument)
    return top


def add_options(add: Callable, names: Iterable[str]) -> None:
    """A flag for each of these options of :func:`s4a.analyse`, and for ``n_jobs``."""
    for name in names:
        default = -1 if name == "n_jobs" else getattr(Options, name)
        text = HELP[name]
        if name in CHOICES:
            kind: dict[str, Any] = {"choices": [choice for choice in CHOICES[name] if choice]}
            text += f" (default: {DEFAULTS.get(name, default)})"
        elif isinstance(default, bool):
            kind = {"action": argparse.BooleanOptionalAction}
        elif name == "components":
            kind = {"type": components}
        else:
            kind = {"type": int if isinstance(default, int) or name == "n_latent" else str}
            text += "" if default is None else f" (default: {default})"
        add("--" + name.replace("_", "-"), default=default, help=text, **kind)


def components(text: str) -> int | str:
    """A number of components, or the word as it is."""
    return int(text) if text.isdigit() else text


def _check(add):
    add("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    add_options(add, ["components", "pattern", "strict", "close_holes", "intersections"])


def _run(add):
    add("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    text = "folder of the study; an unfinished one is resumed"
    add("--out", required=True, metavar="STUDY", help=text)
    text = "dask scheduler tcp://host:port, or local:N worker processes"
    add("--cluster", metavar="ADDRESS", help=text)
    add_options(add, HELP)


def _demo(add):
    add("--out", default="demo", metavar="STUDY", help="folder of the study (default: demo)")
    add("--shapes", type=int, default=12, help="number of shapes (default: 12)")
    add("--vertices", type=int, default=40_000, help="vertices of each (default: 40000)")
    add("--dirty", action="store_true", help="with loose parts, holes and non-manifold places")
    add("--open", action="store_true", help="open the page in a browser")
    add_options(add, ["n_jobs", "seed"])


def _view(add):
    add("study", metavar="STUDY")
    add("--out", metavar="PAGE", help="file of the page (default: STUDY/study.html)")
    add("--title", help="title of the page (default: name of the folder)")
    add("--view", default="corner", choices=list(VIEWS), help="from where (default: corner)")
    add("--up", default="z", choices=["x", "y", "z"], help="axis that points up (default: z)")


def _statistics(add):
    add("study", metavar="STUDY")
    text = "test and map of the difference between groups; classification"
    add("--group", metavar="COLUMN", help=text)
    text = "regression of shape on a number, such as age; its animation"
    add("--variable", metavar="COLUMN", help=text)
    add("--covariates", nargs="+", metavar="COLUMN", help="accounted for in both")
    add("--table", metavar="FILE", help="in place of the table of the study")
    text = "generalization with correspondences found anew (slow)"
    add("--recompute", action="store_true", help=text)
    text = "of every test (default: 9999, at every vertex 999, of classes 99)"
    add("--permutations", type=int, help=text)
    add("--out", metavar="DIR", help="for netCDF and CSV (default: STUDY/statistics)")
    add_options(add, ["n_jobs", "seed"])


def _insert(add):
    add("study", metavar="STUDY")
    add("shapes", nargs="+", metavar="SHAPE", help="mesh files, folders or globs")
    text = "for inserted.nc, registered meshes and scores"
    add("--out", required=True, metavar="DIR", help=text)
    add_options(add, ["n_jobs"])


def _transfer(add):
    add("source", metavar="SOURCE", help="mesh file that the labels and landmarks belong to")
    text = "mesh files, folders or globs; or one study folder"
    add("targets", nargs="+", metavar="TARGET", help=text)
    text = "NPY, NPZ (FILE:NAME), CSV, GIFTI label or FreeSurfer annot, also .gz"
    add("--labels", metavar="FILE", help=text)
    text = "points and curves: Slicer .mrk.json, CSV or MeshLab .pp"
    add("--landmarks", metavar="FILE", help=text)
    text = "for <target>.labels.npy, .confidence.npy, .landmarks.csv"
    add("--out", required=True, metavar="DIR", help=text)
    add_options(add, ["n_coarse", "k", "n_jobs", "seed"])


def _compare(add):
    text = "the reference and one or more other meshes"
    add("paths", nargs="*", metavar="SOURCE TARGET", help=text)
    text = "Table 2 on these folders, globs or mesh files"
    add("--collection", nargs="+", metavar="PATH", help=text)
    add("--methods", nargs="+", metavar="METHOD", help=f"of {', '.join(METHODS)}")
    text = (
        "for each target, NPY or text: per vertex of its file that of the source's "
        "(from 0; -1: none), or x, y, z"
    )
    add("--truth", nargs="+", metavar="FILE", help=text)
    text = (
        "points by name, of the source's file and of each target's: "
        "Slicer .mrk.json, CSV or MeshLab .pp"
    )
    add("--landmarks", nargs="+", metavar="FILE", help=text)
    add("--out", default="compare", metavar="DIR", help="for compare.nc and compare.png")
    add_options(add, ["n_coarse", "n_pairs", "k", "seed"])


FLAGS = {
    commands.check: _check,
    commands.run: _run,
    commands.demo: _demo,
    commands.view: _view,
    commands.statistics: _statistics,
    commands.insert: _insert,
    commands.transfer: _transfer,
    commands.compare: _compare,
}


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code.

    A ValueError or OSError becomes one line on the error stream.
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
