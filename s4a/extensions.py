"""Extensions: what other distributions add by entry points; see docs/extensions.md."""

import logging
from functools import cache
from importlib.metadata import entry_points
from typing import Any

log = logging.getLogger(__name__)
GROUPS = {
    "s4a.commands": ("the result of s4a.cli.command(function)", "run flags"),
    "s4a.panels": ("a subclass of s4a.widgets.Panel", "title needs"),
    "s4a.variables": ("a dict of name to (dims, unit, meaning)", "values"),
}


@cache
def extensions(group: str) -> dict[str, Any]:
    """What installed distributions register in a group of entry points, by name.

    Parameters
    ----------
    group : str
        A name of :data:`GROUPS`.

    Returns
    -------
    dict of str to object
        In the order of the names.  An object that cannot be imported, or is not what the group
        needs, is logged and left out.

    Examples
    --------
    >>> from s4a.extensions import extensions
    >>> extensions("s4a.nothing")
    {}
    """
    found = {}
    for entry in sorted(entry_points(group=group)):
        try:
            found[entry.name] = _checked(group, entry.load())
        except Exception as error:  # whatever is wrong with an extension, the core works
            of = entry.dist.name if entry.dist else entry.value
            log.warning("%s of %s cannot be used, and is left out: %s", entry.name, of, error)
    return found


def _checked(group, one):
    """Return what a group needs, recognised by its attributes, or raise TypeError."""
    what, attributes = GROUPS.get(group, ("", ""))
    fits = all(hasattr(one, name) for name in attributes.split())
    if group == "s4a.variables" and fits:
        fits = all(len(row) == 3 for row in one.values())
    if not fits:
        raise TypeError(f"{what} expected, found {str(one)[:200]}")
    return one
