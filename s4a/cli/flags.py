"""What a command is, and how its flags follow from the function that it calls.

Types and defaults are those of the function's signature, the help is in its docstring.
"""

import argparse
import inspect
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin

from s4a.options import DECLARED

MOST_PROCESSES = 1000  # so that a slip of the key starts no million of them
# a parameter in a docstring: its name, what stands for its value, what it is
PARAMETER = re.compile(r"^(\w+)(?: : (.*))?\n((?:    .*\n)*)", re.MULTILINE)
ALL_OPTIONS = (*DECLARED, "n_jobs")


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


def command(
    function: Callable[..., int], options: Sequence[str] = (), *, unset: bool = False
) -> Command:
    """The command that calls a function, whose parameters are its arguments and flags.

    Keyword-only parameters are flags, those without a default are required; lists take several
    words; a parameter ``words`` is the command line itself.  The type of a parameter in the
    docstring is what stands for its value in the help.

    Parameters
    ----------
    function : callable
    options : sequence of str
        Names of options of :class:`s4a.Options`, or ``n_jobs``, which the function takes, too.
    unset : bool
        Whether those that are not given are None.

    Examples
    --------
    >>> from s4a.cli.flags import command
    >>> def double(number: int, *, minus: bool = False) -> int:
    ...     '''Twice a number.
    ...
    ...     Parameters
    ...     ----------
    ...     number : N
    ...         What is doubled.
    ...     '''
    ...     return -2 * number if minus else 2 * number
    >>> command(double).flags(lambda *name, **told: print(*name, told["help"]))
    number What is doubled.
    --minus None
    """
    text = inspect.getdoc(function) or ""
    summary, _, rest = text.partition("\n\nParameters\n----------\n")
    told = {name: (value, about) for name, value, about in PARAMETER.findall(f"{rest}\n")}
    parameters = inspect.signature(function).parameters.values()
    own = [one for one in parameters if one.kind is not one.VAR_KEYWORD and one.name not in options]

    def run(args: argparse.Namespace) -> int:
        names = [*(one.name for one in own), *options]
        return function(**{name: getattr(args, name) for name in names})

    def flags(add: Callable[..., Any]) -> None:
        for one in own:
            if one.name != "words":
                value, about = told.get(one.name, ("", ""))
                add_parameter(add, one, value or None, " ".join(about.split()) or None)
        add_options(add, options, unset=unset)

    run.__doc__ = summary
    return Command(run, flags)


def add_parameter(
    add: Callable[..., Any], one: inspect.Parameter, metavar: str | None, text: str | None
) -> None:
    """The flag, or the argument, of one parameter of a function."""
    is_set = one.default is not one.empty
    told: dict[str, Any]
    told, many = kind_of(one.annotation)
    if is_set and one.default and text and "default" not in text:
        text = f"{text.removesuffix('.')} (default: {one.default})"
    told["help"] = text
    if one.annotation is bool:
        told = {"action": "store_true", "help": text}
    elif "choices" not in told:
        told["metavar"] = metavar
    if one.kind is one.KEYWORD_ONLY:
        more: dict[str, Any] = {"nargs": "+"} if many else {}
        more |= {"default": one.default} if is_set else {"required": True}
        add(f"--{one.name.replace('_', '-')}", **told, **more)
    else:
        count = ("*" if many else "?") if is_set else ("+" if many else None)
        add(one.name, nargs=count, **told, **({"default": one.default} if is_set else {}))


def kind_of(annotation: Any) -> tuple[dict[str, Any], bool]:
    """What argparse is told of a type, and whether it is a list.

    Examples
    --------
    >>> from s4a.cli.flags import kind_of
    >>> kind_of(list[str] | None)
    ({'type': <class 'str'>}, True)
    """
    kinds = set(get_args(annotation)) if isinstance(annotation, UnionType) else {annotation}
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


def add_options(add: Callable[..., Any], names: Iterable[str], *, unset: bool = False) -> None:
    """A flag for each of these options of :func:`s4a.analyse`, and for ``n_jobs``.

    With `unset` those that are not given are None.
    """
    for name in names:
        flag = f"--{name.replace('_', '-')}"
        if name == "n_jobs":
            text = "processes; -1 for all cores (default: -1)"
            add(
                flag,
                default=-1,
                type=processes,
                help=text,
                group=DECLARED["seed"].metadata["group"],
            )
            continue
        one = DECLARED[name]
        text, default = one.metadata["help"], one.metadata["default"]
        is_switch = isinstance(default, bool)
        if default is not None and not is_switch:
            text += f" (default: {default})"
        told, _ = kind_of(one.type)
        if one.metadata["choices"]:
            told = {"choices": one.metadata["choices"]}
        elif is_switch:
            told = {"action": argparse.BooleanOptionalAction}
        group = one.metadata["group"]
        add(flag, default=None if unset else one.default, help=text, group=group, **told)


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
