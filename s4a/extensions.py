"""Extensions: what other distributions add by entry points; see docs/extensions.md."""

import logging
from functools import cache
from importlib.metadata import entry_points
from typing import Any

log = logging.getLogger(__name__)


@cache
def extensions(group: str) -> dict[str, Any]:
    """What installed distributions register in a group of entry points, by name.

    Parameters
    ----------
    group : str
        ``s4a.commands``, ``s4a.panels`` or ``s4a.variables``.

    Returns
    -------
    dict of str to object
        In the order of the names.  An extension that cannot be imported is logged and left out.

    Examples
    --------
    >>> from s4a.extensions import extensions
    >>> extensions("s4a.nothing")
    {}
    """
    found = {}
    for entry in sorted(entry_points(group=group)):
        try:
            found[entry.name] = entry.load()
        except Exception as error:  # whatever is wrong with an extension, the core works
            of = entry.dist.name if entry.dist else entry.value
            log.warning("%s of %s cannot be imported, and is left out: %s", entry.name, of, error)
    return found
