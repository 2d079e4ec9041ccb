"""The notebook panels of a study, from the library's front door.

They are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

import xarray as xr

if TYPE_CHECKING:
    from s4a.widgets.explore import Explore


def explore(study: xr.DataTree, *, view: str = "corner", up: str = "z") -> "Explore":
    """Tabs over a finished or running study, for notebooks.

    Modes, network, maps, median, correspondence, spectrum.

    Parameters
    ----------
    study : xarray.DataTree
        As :func:`s4a.analyse` or :func:`s4a.open_study` give it.
    view, up
        From where surfaces are seen first, and which axis points up; see
        :func:`s4a.show.draw.rotation`.

    Returns
    -------
    s4a.widgets.Explore
        Whose ``close()`` frees everything; a cell that runs again closes the tabs of its run
        before.

    Raises
    ------
    ImportError
        Without the packages of ``pip install s4a[notebook]``.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.explore(study).tabs.titles[:3]
    ('Modes', 'Network', 'Functional map')
    """
    return import_module("s4a.widgets.explore").explore(study, view=view, up=up)


@xr.register_datatree_accessor("s4a")
class StudyAccessor:
    """``study.s4a``: what can be done with a study."""

    def __init__(self, study: xr.DataTree):
        self._study = study

    def explore(self, *, view: str = "corner", up: str = "z") -> "Explore":
        """See :func:`s4a.explore`."""
        return explore(self._study, view=view, up=up)
