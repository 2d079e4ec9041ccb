"""The command line: ``s4a check | run | verify | view | statistics | insert | transfer | ...``.

The parser and the exit codes are here, the commands in :mod:`s4a.cli.commands`; their flags follow
from the functions of the commands, see :mod:`s4a.cli.flags`.
"""

import argparse
import difflib
import io
import logging
import re
import sys
import textwrap
from collections.abc import Callable, Iterable
from importlib.metadata import version
from typing import Any, NoReturn

from s4a.cli.commands import COMMANDS
from s4a.cli.flags import Command, add_options, command, number_or_name, whole
from s4a.extensions import extensions

__all__ = ["Command", "add_options", "command", "main", "number_or_name", "parser", "whole"]

PAGE = "https://github.com/OWNER/s4a/blob/HEAD/docs/commands.md"
LINKS = f"documentation: {PAGE}\nSections and equations are those of the paper, Maccarone et al."


class Parser(argparse.ArgumentParser):
    """A parser that answers a mistake with one line of usage and a suggestion.

    Calling it adds a flag, as :meth:`argparse.ArgumentParser.add_argument` does, below the heading
    of its `group`.
    """

    def __init__(self, **settings: Any) -> None:
        layout = argparse.RawDescriptionHelpFormatter
        super().__init__(allow_abbrev=False, formatter_class=layout, **settings)
        self.groups: dict[str, Any] = {"": self}
        self.flags = ["-h", "--help"]

    def __call__(self, *names: str, group: str = "", **settings: Any) -> None:
        """Add a flag or an argument; the usage shows those that are required."""
        if group not in self.groups:
            self.groups[group] = self.add_argument_group(group)
        action = self.groups[group].add_argument(*names, **settings)
        action.help = settings.get("help")  # Python before 3.13 adds the default of a switch
        self.flags += action.option_strings
        if self.usage and (action.required or not action.option_strings):
            value = action.metavar or action.dest.upper()
            value += "..." if action.nargs in ("+", "*") else ""
            words = f"{' '.join(names[-1:])} {value}" if action.option_strings else value
            self.usage += f" {words}" if action.required else f" [{words}]"

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the words after a command, and refuse flags that it does not have."""
        for word in args if self.usage else ():
            if word == "--":
                break
            flag = word.partition("=")[0] if word.startswith("--") else word[:2]
            if re.match("--?[A-Za-z]", flag) and flag not in self.flags:
                self.error(f"unknown flag {flag}{suggestion(flag, self.flags)}")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Write one line of usage and the message, and end with 2."""
        self.exit(2, f"{self.format_usage()}s4a: {message}\n")


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return the end of a message that names the most similar word, if there is one.

    Examples
    --------
    >>> from s4a.cli import suggestion
    >>> suggestion("--ncoarse", ["--n-coarse", "--out"])
    '; did you mean --n-coarse?'
    """
    near = difflib.get_close_matches(word, known, 1)
    return f"; did you mean {near[0]}?" if near else ""


def parser(only: str | None = None) -> Parser:
    """Return the parser of all commands, with the flags of all or of one."""
    top = Parser(prog="s4a", description="Scalable spectral statistical shape analysis")
    top.add_argument("--version", action="version", version=f"s4a {version('s4a')}")
    top.epilog = f"s4a COMMAND --help shows the flags of a command.  Documentation: {PAGE}"
    subparsers = top.add_subparsers(required=True, metavar="command")
    # commands of the core come first, and no extension can replace them
    commands = COMMANDS | extensions("s4a.commands") | COMMANDS
    for name, one in commands.items():
        text = one.run.__doc__ or ""
        line = text.partition(".")[0]
        sub = subparsers.add_parser(name, help=line, description=text, usage=f"s4a {name}")
        if only in (None, name):
            one.flags(sub)
            sub(
                "-v",
                "--verbose",
                action="store_true",
                help="a line for each stage in place of a progress bar",
            )
            sub("-q", "--quiet", action="store_true", help="no progress bar and no warnings")
            sub.usage = f"{sub.usage} [options]"
            examples = textwrap.indent(f"{one.examples}\n", "  ") if one.examples else ""
            sub.epilog = f"examples:\n{examples}\n" * bool(examples) + LINKS
        sub.set_defaults(function=one.run, flags=sub.flags)
    if only and only not in commands:
        top.error(f"{only!r} is not a command{suggestion(only, commands)}")
    return top


def as_flags(message: str, flags: Iterable[str]) -> str:
    """Return a message about options in terms of the flags that set them.

    Examples
    --------
    >>> from s4a.cli import as_flags
    >>> as_flags("k must be at least k_init = 20; found 5", ["--k", "--k-init"])
    '--k must be at least --k-init 20; found 5'
    """
    names = {flag.strip("-").replace("-", "_"): flag for flag in flags}
    names |= {f"n_{name}": flag for name, flag in names.items() if f"n_{name}" not in names}
    pattern = rf"(?<![\w.-])({'|'.join(names)})(?: ?= ?(True|False)?| (?=must |needs? |cannot ))"

    def flag_of(match: re.Match[str]) -> str:
        flag, value = names[match[1]], match[2]
        return flag.replace("--", "--no-") if value == "False" else flag + " " * (not value)

    return re.sub(pattern, flag_of, message)


def once() -> Callable[[logging.LogRecord], bool]:
    """Return a filter that passes every message once: several steps may find the same."""
    seen: dict[str, float] = {}  # message -> when it was logged first
    return lambda record: seen.setdefault(record.getMessage(), record.created) == record.created


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return the exit code.

    A ValueError, OSError or StageError becomes one line on the error stream, as does a lack of
    memory.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    words = sys.argv[1:] if arguments is None else arguments
    name = next((word for word in words if not word.startswith("-")), "")
    args = parser(name).parse_args(words, argparse.Namespace(words=words))
    if name == "doctor":  # it also runs if packages are missing
        return args.function(args)
    from s4a.input.raw import shown
    from s4a.study.runner import StageError

    stages = logging.getLogger("s4a.study.runner")
    before = stages.level
    filters = [(handler, once()) for handler in logging.getLogger().handlers]
    for handler, is_new in filters:
        handler.addFilter(is_new)
    try:
        if args.quiet:
            logging.disable(logging.WARNING)
        elif args.verbose or not sys.stderr.isatty():  # a line for each stage, no progress bar
            stages.setLevel(logging.INFO)
        if isinstance(sys.stdout, io.TextIOWrapper):  # letters that the terminal cannot show
            sys.stdout.reconfigure(errors="backslashreplace")
        return args.function(args)
    except (ValueError, OSError, StageError) as error:
        sys.stderr.write(f"s4a: {as_flags(shown(error), args.flags)}\n")
        return 2
    except MemoryError as error:
        sys.stderr.write(f"s4a: more memory is needed than there is: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("s4a: interrupted; the same command resumes where it stopped\n")
        return 130
    finally:
        logging.disable(logging.NOTSET)
        stages.setLevel(before)
        for handler, is_new in filters:
            handler.removeFilter(is_new)
