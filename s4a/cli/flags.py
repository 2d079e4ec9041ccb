"""Command line: ``s4a check | run | verify | view | statistics | insert | transfer | ...``.

Here are the flags and the exit codes; what the commands do is in :mod:`s4a.cli.commands`.  Every
option of :func:`s4a.analyse` is a flag of run.
"""

import argparse
import io
import logging
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, get_args

from s4a.cli import commands
from s4a.extensions import extensions
from s4a.input.raw import shown

MOST_PROCESSES = 1000  # so that a slip of the key starts no million of them


@dataclass(frozen=True)
class Command:
    """A command of the command line, of the core or of an extension.

    Parameters
    ----------
    run : callable
        Takes the parsed arguments and gives the exit code; its docstring is the help.
    flags : callable
        Adds the flags of the command through the function that it is given, as
        ``add("--out", help="...")``; see :meth:`argparse.ArgumentParser.add_argument`.
    """

    run: Callable[[argparse.Namespace], int]
    flags: Callable[[Callable[..., Any]], None]


def parser(only: str | None = None) -> argparse.ArgumentParser:
    """The parser of all commands, with the flags of all or of one.

    What the flags of a command may be is asked of the modules that it needs.
    """
    top = argparse.ArgumentParser(
        prog="s4a", description="Scalable spectral statistical shape analysis"
    )
    top.add_argument("--version", action="version", version=f"s4a {version('s4a')}")
    subparsers = top.add_subparsers(required=True, metavar="command")
    for name, command in (extensions("s4a.commands") | COMMANDS).items():
        text = command.run.__doc__
        sub = subparsers.add_parser(name, help=text, description=text)
        sub.set_defaults(function=command.run)
        if only in (None, name):
            command.flags(sub.add_argument)
    return top


def add_options(add: Callable[..., Any], names: Iterable[str], *, unset: bool = False) -> None:
    """A flag for each of these options of :func:`s4a.analyse`, and for ``n_jobs``.

    With `unset` those that are not given are None.
    """
    from s4a.options import DECLARED

    for name in names:
        flag = "--" + name.replace("_", "-")
        if name == "n_jobs":
            add(flag, default=-1, type=processes, help="processes; -1 for all cores (default: -1)")
            continue
        declared = DECLARED[name]
        told, kinds = declared.metadata, get_args(declared.type) or (declared.type,)
        text, default = told["help"], told["default"]
        kind: dict[str, Any] = {"type": str}
        if told["choices"]:
            kind = {"choices": told["choices"]}
        elif bool in kinds:
            kind = {"action": argparse.BooleanOptionalAction}
        elif int in kinds:
            kind = {"type": number_or_name if str in kinds else whole}
        if default is not None and bool not in kinds:
            text += f" (default: {default})"
        add(flag, default=None if unset else declared.default, help=text, **kind)


def number_or_name(text: str) -> int | str:
    """A number of components or of a label, or the word as it is."""
    return whole(text) if text.isdecimal() else text


def whole(text: str) -> int:
    """A whole number; what it may be is said by what takes it."""
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        raise argparse.ArgumentTypeError(
            f"a whole number of at most 18 digits needed, found {text[:40]!r}"
        )
    return int(text)


def processes(text: str) -> int:
    """A number of processes, as in joblib."""
    number = whole(text)
    if number == 0 or abs(number) > MOST_PROCESSES:
        raise argparse.ArgumentTypeError(
            f"a number from 1 to {MOST_PROCESSES} needed, or -1 for all cores, found {number}"
        )
    return number


def _check(add):
    add("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    add_options(add, ["components", "pattern", "label", "strict", "close_holes", "intersections"])


def _doctor(add):
    text = "where studies are to lie (default: here)"
    add("folder", nargs="?", default=".", metavar="FOLDER", help=text)


def _run(add):
    from s4a.options import DECLARED

    add("paths", nargs="+", metavar="PATH", help="folders, globs or mesh files")
    text = "folder of the study; an unfinished one is resumed"
    add("--out", required=True, metavar="STUDY", help=text)
    text = "dask scheduler tcp://host:port, or local:N worker processes"
    add("--cluster", metavar="ADDRESS", help=text)
    add_options(add, [*DECLARED, "n_jobs"])


def _demo(add):
    add("--out", default="demo", metavar="STUDY", help="folder of the study (default: demo)")
    add("--shapes", type=whole, default=12, help="number of shapes (default: 12)")
    add("--vertices", type=whole, default=40_000, help="vertices of each (default: 40000)")
    add("--dirty", action="store_true", help="with loose parts, holes and non-manifold places")
    add("--open", action="store_true", help="open the page in a browser")
    add_options(add, ["preset", "n_jobs", "seed"])


def _verify(add):
    add("study", metavar="STUDY")


def _status(add):
    add("study", metavar="STUDY")


def _view(add):
    from s4a.show.draw import VIEWS

    add("study", metavar="STUDY")
    add("--out", metavar="PAGE", help="file of the page (default: STUDY/study.html)")
    add("--title", help="title of the page (default: name of the folder)")
    add("--view", default="corner", choices=list(VIEWS), help="from where (default: corner)")
    add("--up", default="z", choices=["x", "y", "z"], help="axis that points up (default: z)")


def _statistics(add):
    from s4a.analysis.effects import VARIANCES

    add("study", metavar="STUDY")
    text = "test and map of the difference between groups; classification"
    add("--group", metavar="COLUMN", help=text)
    text = "regression of shape on a number, such as age; its animation"
    add("--variable", metavar="COLUMN", help=text)
    add("--covariates", nargs="+", metavar="COLUMN", help="accounted for in both")
    text = "a field of s4a fields in place of shape in both"
    add("--field", metavar="NAME", help=text)
    add("--table", metavar="FILE", help="in place of the table of the study")
    text = (
        "of the shapes around what is tested; unequal where groups scatter differently "
        "(default: equal)"
    )
    add("--variances", choices=VARIANCES, default="equal", help=text)
    text = "generalization with correspondences found anew (slow)"
    add("--recompute", action="store_true", help=text)
    add("--keep-doubtful", action="store_true", help="take doubtful shapes in")
    text = "only vertices of the template with these labels"
    add("--label", nargs="+", type=number_or_name, metavar="LABEL", help=text)
    text = "labels of the template's file for --label: NPY, NPZ (FILE:NAME), CSV, GIFTI or annot"
    add("--labels", metavar="FILE", help=text)
    text = "only vertices whose mean confidence is this large, 0 to 1"
    add("--least-confidence", type=float, default=0.0, metavar="SHARE", help=text)
    text = "nuisances: what lies along their regression is taken from all shapes"
    add("--without", nargs="+", metavar="COLUMN", help=text)
    text = "give size back to shapes of which --scale took it out"
    add("--size-back", action="store_true", help=text)
    text = "of every test (default: 9999, at every vertex 999, of classes 99)"
    add("--permutations", type=whole, help=text)
    add("--out", metavar="DIR", help="for netCDF and CSV (default: STUDY/statistics)")
    add_options(add, ["n_jobs", "seed"])


def _fields(add):
    add("study", metavar="STUDY")
    text = "with a file for each shape: NPY, NPZ, PLY, CSV, GIFTI or FreeSurfer's curv"
    add("folder", metavar="FOLDER", help=text)
    text = "of the field; also of its array, column or property in the files"
    add("--name", required=True, metavar="NAME", help=text)
    add("--unit", help="of its numbers, such as mm")
    add("--partial", action="store_true", help="shapes may lack it; tests leave these out")

    add_options(add, ["seed"])


def _insert(add):
    add("study", metavar="STUDY")
    add("shapes", nargs="+", metavar="SHAPE", help="mesh files, label volumes, folders or globs")
    text = "for inserted.nc, registered meshes and scores"
    add("--out", required=True, metavar="DIR", help=text)
    add("--landmarks", metavar="DIR", help="folder of landmark files named as the shapes")
    text = "new shapes to mirror: names, with commas; or auto, those of the other hand"
    add("--reflect", metavar="NAMES", help=text)
    add_options(add, ["n_jobs"])


def _transfer(add):
    from s4a.options import DECLARED

    add("source", metavar="SOURCE", help="mesh file that the labels and landmarks belong to")
    text = "mesh files, folders or globs; or one study folder, whose options hold unless given"
    add("targets", nargs="+", metavar="TARGET", help=text)
    text = "NPY, NPZ (FILE:NAME), CSV, GIFTI label or FreeSurfer annot, also .gz"
    add("--labels", metavar="FILE", help=text)
    text = "points and curves: Slicer .mrk.json, CSV or MeshLab .pp"
    add("--landmarks", metavar="FILE", help=text)
    text = "for <target>.labels.npy, .confidence.npy, .landmarks.csv"
    add("--out", required=True, metavar="DIR", help=text)
    text = "how far around votes for labels count, in multiples of how far matches may be wrong"
    add("--blur", type=float, help=f"{text} (default: 1; 0, not, with --preset paper)")
    add_options(add, ["n_jobs"])
    pair = [name for name, one in DECLARED.items() if one.metadata["pair"]]
    add_options(add, pair, unset=True)


def _compare(add):
    from s4a.evaluation.compare import METHODS

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
    text = "meshes, matches and maps are in compare.nc, too, for the panel that shows them"
    add("--keep", action="store_true", help=text)
    add("--out", default="compare", metavar="DIR", help="for compare.nc and compare.png")
    add_options(add, ["n_coarse", "n_pairs", "k", "preset", "seed"])


COMMANDS = {
    "doctor": Command(commands.doctor, _doctor),
    "check": Command(commands.check, _check),
    "run": Command(commands.run, _run),
    "verify": Command(commands.verify, _verify),
    "status": Command(commands.status, _status),
    "demo": Command(commands.demo, _demo),
    "view": Command(commands.view, _view),
    "statistics": Command(commands.statistics, _statistics),
    "fields": Command(commands.fields, _fields),
    "insert": Command(commands.insert, _insert),
    "transfer": Command(commands.transfer, _transfer),
    "compare": Command(commands.compare, _compare),
}


class Once(logging.Filter):
    """Lets every message through once: several steps of a command may find the same."""

    def __init__(self) -> None:
        super().__init__()
        self.said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the message is new."""
        message = record.getMessage()
        is_new = message not in self.said
        self.said.add(message)
        return is_new


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code.

    A ValueError, OSError or StageError becomes one line on the error stream, a lack of memory too.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    words = sys.argv[1:] if arguments is None else arguments
    command = next((word for word in words if not word.startswith("-")), "")
    # ends here where they err
    args = parser(command).parse_args(words, argparse.Namespace(words=words))
    if args.function is commands.doctor:  # it also runs where packages are missing
        return args.function(args)
    from s4a.study.runner import StageError

    filters = [(handler, Once()) for handler in logging.getLogger().handlers]
    for handler, once in filters:
        handler.addFilter(once)
    try:
        if isinstance(sys.stdout, io.TextIOWrapper):  # letters that the terminal does not know
            sys.stdout.reconfigure(errors="backslashreplace")
        return args.function(args)
    except (ValueError, OSError, StageError) as error:
        sys.stderr.write(f"s4a: {shown(error)}\n")
        return 2
    except MemoryError as error:
        sys.stderr.write(f"s4a: more memory needed than there is: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("s4a: interrupted; the same command goes on where it stopped\n")
        return 130
    finally:
        for handler, once in filters:
            handler.removeFilter(once)


if __name__ == "__main__":
    sys.exit(main())
