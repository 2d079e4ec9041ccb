"""The notebook panels of a study, imported when they are first used."""

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
    """Show a finished or running study as tabs in a notebook.

    There is a tab for each panel: modes, network, functional map, median, correspondence, ...

    Parameters
    ----------
    study : xarray.DataTree
        Result of :func:`s4a.analyse` or :func:`s4a.open_study`.
    width : float or str, optional
        Width of the panels, in pixels or as a CSS length; by default the width of the cell.
    font : float, optional
        Font size in pixels; by default it is proportional to the width.
    view, up
        Initial direction of view, and the axis that points up; see :func:`s4a.show.draw.rotation`.

    Returns
    -------
    s4a.widgets.Explore
        Its ``close()`` frees all widgets.  A cell that runs again closes its previous tabs.

    Raises
    ------
    ImportError
        If the packages of ``pip install s4a[notebook]`` are missing.

    See Also
    --------
    s4a.write_page : the same views of a study as one HTML file.
    s4a.widgets : the panels one by one.

    Examples
    --------
    With a study of six small brains:

    >>> import s4a
    >>> study = s4a.synthetic.example_study()
    >>> s4a.explore(study).tabs.titles[:3]
    ('Modes', 'Network', 'Functional map')
    """
    panels = import_module("s4a.widgets.explore")  # a missing package is reported first
    check_type(study, xr.DataTree)
    return panels.explore(study, width=width, font=font, view=view, up=up)


@xr.register_datatree_accessor("s4a")
class StudyAccessor:
    """Accessor ``study.s4a`` of a DataTree."""

    def __init__(self, study: xr.DataTree):
        self._study = study

    def explore(self, **options: Any) -> "Explore":
        """Show the study as tabs; see :func:`s4a.explore`."""
        return explore(self._study, **options)
