"""Commands, and the flags that follow from the function that a command calls.

Types and defaults are those of the signature of the function, help texts those of its docstring.
"""

import argparse
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from s4a.options import DECLARED, HELP

MOST_PROCESSES = 1000  # a mistyped number starts no million of them
# a parameter in a docstring: name, placeholder of its value, help
PARAMETER = re.compile(r"^(\w+)(?: : (.*))?\n((?:    .*\n)*)", re.MULTILINE)
ALL_OPTIONS = (*DECLARED, "n_jobs")
SHORT = {"out": "-o", "n_jobs": "-j", "k": "-k"}


@dataclass(frozen=True)
class Command:
    """A command of the command line, of the core or of an extension.

    Parameters
    ----------
    run : callable
        Takes the parsed arguments and returns the exit code; its docstring is the help.
    flags : callable
        Adds the flags of the command through the function that it is given, as
        ``add("--out", help="...")``; see :meth:`argparse.ArgumentParser.add_argument`.
    examples : str
        Command lines, one a line, shown at the end of the help.
    """

    run: Callable[[argparse.Namespace], int]
    flags: Callable[[Callable[..., Any]], None]
    examples: str = ""


def command(
    function: Callable[..., int], options: Sequence[str] = (), *, unset: bool = False
) -> Command:
    """Return the command that calls a function, with its parameters as arguments and flags.

    Keyword-only parameters become flags, which are required if they have no default.  Lists take
    several words.  A parameter ``words`` receives the command line itself.  The type of a parameter
    in the docstring is the placeholder of its value in the help.

    Parameters
    ----------
    function : callable
    options : sequence of str
        Names of options of :class:`s4a.Options`, or ``n_jobs``, which the function also takes.
    unset : bool
        Whether options that are not given are None.

    Raises
    ------
    ValueError
        If an option is unknown.

    Examples
    --------
    >>> from s4a.cli.flags import command
    >>> def double(number: int, *, minus: bool = False) -> int:
    ...     '''Double a number.
    ...
    ...     Parameters
    ...     ----------
    ...     number : N
    ...         the number
    ...     '''
    ...     return -2 * number if minus else 2 * number
    >>> command(double).flags(lambda *names, **settings: print(*names, settings["help"]))
    number the number
    --minus None
    """
    text, _, examples = (inspect.getdoc(function) or "").partition("\n\nExamples\n--------\n")
    summary, _, rest = text.partition("\n\nParameters\n----------\n")
    documented = {name: (value, about) for name, value, about in PARAMETER.findall(f"{rest}\n")}
    parameters = inspect.signature(function, eval_str=True).parameters.values()
    if unknown := set(options) - set(ALL_OPTIONS):
        raise ValueError(f"options of s4a.Options, or n_jobs, expected; found {sorted(unknown)}")
    own = [p for p in parameters if p.kind is not p.VAR_KEYWORD and p.name not in options]

    def run(args: argparse.Namespace) -> int:
        names = [*(parameter.name for parameter in own), *options]
        return function(**{name: getattr(args, name) for name in names})

    def flags(add: Callable[..., Any]) -> None:
        for parameter in own:
            if parameter.name != "words":
                value, about = documented.get(parameter.name, ("", ""))
                _add_parameter(add, parameter, value or None, " ".join(about.split()) or None)
        add_options(add, options, unset=unset)

    run.__doc__ = summary
    return Command(run, flags, examples)


def flag_names(name: str) -> list[str]:
    """Return the flags of a parameter or option, the short one first."""
    return [*filter(None, [SHORT.get(name)]), f"--{name.replace('_', '-')}"]


def with_default(text: str | None, default: Any) -> str | None:
    """Return a help text with the default, unless there is none or the text says it."""
    if default is None or not text or "default" in text:
        return text
    shown = {True: "yes", False: "no"}[default] if isinstance(default, bool) else default
    return f"{text.removesuffix('.')} (default: {shown})"


def _add_parameter(add, parameter, metavar, text):
    """Add the flag, or the positional argument, of one parameter of a function."""
    is_set = parameter.default is not parameter.empty
    if parameter.annotation is bool:
        add(*flag_names(parameter.name), action="store_true", help=text)
        return
    settings, many = kind_of(parameter.annotation)
    settings["help"] = with_default(text, parameter.default if is_set else None)
    if metavar and "choices" not in settings:
        settings["metavar"] = metavar
    if is_set:
        settings["default"] = parameter.default
    if parameter.kind is parameter.KEYWORD_ONLY:
        names = flag_names(parameter.name)
        settings |= {"nargs": "+"} if many else {}
        settings |= {} if is_set else {"required": True}
    else:
        names = [parameter.name]
        settings["nargs"] = ("*" if many else "?") if is_set else ("+" if many else None)
    add(*names, **settings)


def kind_of(annotation: Any) -> tuple[dict[str, Any], bool]:
    """Return the settings of argparse for a type, and whether it is a list.

    Examples
    --------
    >>> from s4a.cli.flags import kind_of
    >>> kind_of(list[str] | None)
    ({'type': <class 'str'>}, True)
    """
    kinds = (
        set(get_args(annotation)) if get_origin(annotation) in (Union, UnionType) else {annotation}
    )
    kinds -= {NoneType}
    if len(kinds) == 1:
        (kind,) = kinds
        if get_origin(kind) is list:
            return kind_of(get_args(kind)[0])[0], True
        if get_origin(kind) is Literal:
            return {"choices": get_args(kind)}, False
    if int in kinds:
        return {"type": number_or_name if str in kinds else whole}, False
    return {"type": float if float in kinds else str}, False


def add_options(add: Callable[..., Any], names: Sequence[str], *, unset: bool = False) -> None:
    """Add a flag for each of these options of :func:`s4a.analyse`, and for ``n_jobs``.

    With `unset` the options that are not given are None.
    """
    own = [name for name in names if name in DECLARED]
    last = DECLARED["seed"].metadata["group"]
    for name in sorted(own, key=lambda name: DECLARED[name].metadata["group"] == last):
        option = DECLARED[name]
        default = option.metadata["default"]
        settings: dict[str, Any]
        if option.metadata["choices"]:
            settings = {"choices": option.metadata["choices"]}
        elif isinstance(default, bool):
            settings = {"action": argparse.BooleanOptionalAction}
        else:
            settings, _ = kind_of(option.type)
            metavars = {Path: "PATH", list[str]: "NAMES"}
            found = [metavars[kind] for kind in get_args(option.type) if kind in metavars]
            settings["metavar"] = "N" if settings["type"] is whole else (*found, name.upper())[0]
        settings["default"] = None if unset else option.default
        settings["help"] = with_default(HELP[name], default)
        add(*flag_names(name), group=option.metadata["group"], **settings)
    if "n_jobs" in names:
        settings = {"type": processes, "metavar": "N", "default": -1, "group": last}
        add(*flag_names("n_jobs"), help="processes; -1 for all cores (default: -1)", **settings)


def number_or_name(text: str) -> int | str:
    """Return a number, or the word as it is."""
    return whole(text) if text.isdecimal() else text


def whole(text: str) -> int:
    """Return a whole number; its range is checked by the function that takes it."""
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        raise argparse.ArgumentTypeError(
            f"a whole number of at most 18 digits needed, found {text[:40]!r}"
        )
    return int(text)


def processes(text: str) -> int:
    """Return a number of processes, as in joblib."""
    number = whole(text)
    if number == 0 or abs(number) > MOST_PROCESSES:
        raise argparse.ArgumentTypeError(
            f"a number from 1 to {MOST_PROCESSES} needed, or -1 for all cores, found {number}"
        )
    return number
