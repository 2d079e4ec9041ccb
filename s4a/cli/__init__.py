"""The command line: ``s4a check | run | verify | view | statistics | insert | transfer | ...``.

Here are the parser and the exit codes; what the commands do is in :mod:`s4a.cli.commands`, and
their flags follow from that by :mod:`s4a.cli.flags`.
"""

import argparse
import io
import logging
import sys
from importlib.metadata import version
from typing import Any

from s4a.cli.commands import COMMANDS
from s4a.cli.flags import Command, add_options, command, number_or_name, whole
from s4a.extensions import extensions

__all__ = ["Command", "add_options", "command", "main", "number_or_name", "parser", "whole"]


def parser(only: str | None = None) -> argparse.ArgumentParser:
    """The parser of all commands, with the flags of all or of one."""
    top = argparse.ArgumentParser(
        prog="s4a", description="Scalable spectral statistical shape analysis"
    )
    top.add_argument("--version", action="version", version=f"s4a {version('s4a')}")
    subparsers = top.add_subparsers(required=True, metavar="command")
    # those of the core first, and no extension takes their names
    for name, one in (COMMANDS | extensions("s4a.commands") | COMMANDS).items():
        text = one.run.__doc__
        sub = subparsers.add_parser(name, help=text, description=text)
        sub.set_defaults(function=one.run)
        if only in (None, name):
            one.flags(Groups(sub))
    return top


class Groups:
    """Adds flags to a parser, those of a group below its name."""

    def __init__(self, of: argparse.ArgumentParser) -> None:
        self.of = of
        self.groups: dict[str, Any] = {}

    def __call__(self, *names: str, group: str = "", **told: Any) -> None:
        """Add a flag: as :meth:`argparse.ArgumentParser.add_argument`."""
        if group and group not in self.groups:
            self.groups[group] = self.of.add_argument_group(group)
        self.groups.get(group, self.of).add_argument(*names, **told)


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
    name = next((word for word in words if not word.startswith("-")), "")
    # ends here where they err
    args = parser(name).parse_args(words, argparse.Namespace(words=words))
    if name == "doctor":  # it also runs where packages are missing
        return args.function(args)
    from s4a.input.raw import shown
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
