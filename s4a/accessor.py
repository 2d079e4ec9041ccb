"""The notebook panels of a study, from the library's front door.

They are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import xarray as xr

from s4a.schema import check_type

if TYPE_CHECKING:
    from s4a.widgets.explore import Explore


def explore(
    study: xr.DataTree,
    *,
    width: float | str | None = None,
    font: float | None = None,
    view: str = "corner",
    up: str = "z",
) -> "Explore":
    """Tabs over a finished or running study, for notebooks.

    Modes, network, maps, median, correspondence, spectrum.

    Parameters
    ----------
    study : xarray.DataTree
        As :func:`s4a.analyse` or :func:`s4a.open_study` give it.
    width : float or str, optional
        Of the panels, in pixels or as CSS has it; all that the cell has by default.
    font : float, optional
        Size of their text in pixels; by default it follows their width, so that a projector shows
        it large.
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
    check_type(study, xr.DataTree)
    options = {"width": width, "font": font, "view": view, "up": up}
    return import_module("s4a.widgets.explore").explore(study, **options)


@xr.register_datatree_accessor("s4a")
class StudyAccessor:
    """``study.s4a``: what can be done with a study."""

    def __init__(self, study: xr.DataTree):
        self._study = study

    def explore(self, **options: Any) -> "Explore":
        """See :func:`s4a.explore`."""
        return explore(self._study, **options)
