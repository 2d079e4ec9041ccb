"""All panels of a study as tabs; each is built when its tab is first opened."""

import logging
from typing import Any

import ipywidgets
import traitlets
import xarray as xr
from IPython import get_ipython
from IPython.core.interactiveshell import ExecutionInfo

from s4a.extensions import extensions
from s4a.show.browser import PARTS
from s4a.show.surfaces import attribute, has
from s4a.widgets.correspondence import Correspondence
from s4a.widgets.functional import FunctionalMap
from s4a.widgets.median import Median
from s4a.widgets.modes import Modes
from s4a.widgets.network import Network
from s4a.widgets.panel import KernelWidget, Panel, close_all, panel_layout
from s4a.widgets.spectrum import Spectrum
from s4a.widgets.transfer import Transfer

log = logging.getLogger(__name__)
PANELS = {
    "Modes": Modes,
    "Network": Network,
    "Functional map": FunctionalMap,
    "Median": Median,
    "Correspondence": Correspondence,
    "Transfer": Transfer,
    "Spectrum": Spectrum,
}
STAGES = ("original", "coarse", "network", "latent", "registration", "pca")  # nodes of every study


def known_panels() -> dict[str, type[Panel]]:
    """Return title -> panel class of the core and of extensions."""
    return PANELS | {kind.title: kind for kind in extensions("s4a.panels").values()}


def kinds_of(study: xr.DataTree) -> dict[str, type[Panel]]:
    """Return title -> panel class, if the study has, or will have, what the panel needs."""
    expected = STAGES if not study.children or set(STAGES) & set(study.children) else ()
    kinds = {
        title: kind
        for title, kind in known_panels().items()
        if all(has(study, need) or need.partition("/")[0] in expected for need in kind.needs)
    }
    return kinds or PANELS


def running_cell() -> str | None:
    """Return the id of the running notebook cell; None outside of a notebook."""
    kernel = getattr(get_ipython(), "kernel", None)
    return kernel.get_parent().get("metadata", {}).get("cellId") if kernel else None


class Explore(KernelWidget):
    """All panels of a study as tabs.

    Parameters
    ----------
    study : xarray.DataTree
        Finished or running.  The tab of a missing stage shows what is missing.
    width : float or str, optional
        Width in pixels or as a CSS length; by default the width of the cell.
    **options
        ``font``, ``view`` and ``up`` of every panel.

    Attributes
    ----------
    panels : dict
        Title -> panel, of the tabs that were opened.
    pair : tuple of str
        Source and target that are selected in all tabs, ("", "") for none.  *Network* and
        *Functional map* do not change if the network has no map between them.
    shape : str
        Shape that is selected in all tabs, initially the median; "" for none.

    See Also
    --------
    s4a.explore : the same; it closes the tabs of an earlier run of the cell.
    """

    title = "Panels of a study"
    pair = traitlets.Tuple(("", ""))
    shape = traitlets.Unicode("")

    def __init__(self, study: xr.DataTree, *, width: float | str | None = None, **options: Any):
        self.study, self.options, self.panels = study, options, {}
        self.reasons = {}  # title of a tab without panel -> reason
        self.kinds = kinds_of(study)
        waiting = PARTS.message("This tab is filled by a running kernel when it is opened.")
        boxes = [ipywidgets.VBox([ipywidgets.HTML(waiting)]) for _ in self.kinds]
        self.tabs = ipywidgets.Tab(children=boxes, titles=list(self.kinds))
        self.tabs.add_class("s4a-tabs")  # in style.css
        super().__init__([self.tabs], layout=panel_layout(width))
        self.shape = attribute(study, "latent", "median")
        self.tabs.observe(self.fill, "selected_index")
        self.observe(lambda _: self.apply_selection(), ["pair", "shape"])
        self.fill()
        self.cell = None  # the tabs close when this cell runs again

    @property
    def page_command(self) -> str:
        """The expression that writes a page of the first tab."""
        title = next(iter(self.kinds))
        return f'panels["{title}"].save_html("{title.lower()}.html")'

    def close_with(self, cell: str) -> None:
        """Close when the notebook cell runs again."""
        self.cell = cell
        get_ipython().events.register("pre_run_cell", self.before_run)

    def before_run(self, run: ExecutionInfo) -> None:
        """Close if `run`, the next execution of IPython, is of the cell that made these tabs."""
        if run.cell_id == self.cell:
            self.close()

    def fill(self, change: object = None) -> None:
        """Build the panel of the selected tab and apply the selection, or show the error."""
        title = list(self.kinds)[self.tabs.selected_index or 0]
        box = self.tabs.children[self.tabs.selected_index or 0]
        if title in self.panels:
            self.apply_selection()
            return
        for child in box.children:
            close_all(child)
        try:
            self.panels[title] = panel = self.kinds[title](self.study, **self.options)
            box.children = [panel]
            self.reasons.pop(title, None)
            if panel.shares:
                panel.observe(lambda _: self.take_selection(panel), panel.shares)
            self.apply_selection()
        except Exception as error:  # the tab must show any error
            reason = str(error)
            if not isinstance(error, ValueError):
                log.exception("%s", title)
                reason = f"{type(error).__name__}: {error}"
            self.reasons[title] = reason
            box.children = [ipywidgets.HTML(PARTS.message(reason))]

    def take_selection(self, panel: Panel) -> None:
        """Set the selection of all tabs to that of a panel."""
        if panel.recording:  # the values change for a saved page only
            return
        selected = panel.selection()
        with self.hold_trait_notifications():  # one notification: a panel shows a pair or a shape
            self.pair = selected.get("pair", self.pair)
            self.shape = selected.get("shape") or self.shape

    def apply_selection(self) -> None:
        """Show the selection in the visible tab; the others show it when they are opened."""
        panel = self.panels.get(list(self.kinds)[self.tabs.selected_index or 0])
        if panel is not None:
            panel.guarded(panel.adopt)(self.pair, self.shape)

    def refresh(self, study: xr.DataTree) -> None:
        """Show a newer state of the study in all panels."""
        for panel in self.panels.values():
            panel.close()
        self.panels.clear()
        self.extend(study)

    def extend(self, study: xr.DataTree) -> None:
        """Use a newer state of the study for tabs without panel; open panels do not change."""
        self.study = study
        self.shape = self.shape or attribute(study, "latent", "median")
        self.reasons.clear()
        self.fill()

    def __getitem__(self, title: str) -> ipywidgets.Widget:
        """Open a tab and return its panel."""
        if title not in self.kinds:
            needs = getattr(known_panels().get(title), "needs", ())
            lacking = ", ".join(need for need in needs if not has(self.study, need))
            why = f", as the study lacks {lacking}" if lacking else ""
            raise ValueError(f"there is no tab {title!r}{why}; there are {', '.join(self.kinds)}")
        self.tabs.selected_index = list(self.kinds).index(title)
        if title not in self.panels:
            ready = [
                name
                for name, kind in self.kinds.items()
                if name not in self.reasons and all(has(self.study, need) for need in kind.needs)
            ]
            raise ValueError(
                f"the tab {title!r} has no panel: {self.reasons[title]}; "
                f"there are {', '.join(ready) or 'no others'}"
            )
        return self.panels[title]

    def close(self) -> None:
        """Close all panels."""
        if self.cell:
            get_ipython().events.unregister("pre_run_cell", self.before_run)
            self.cell = None
        close_all(self)


def explore(study: xr.DataTree, **options: Any) -> Explore:
    """Return tabs over a study that close when the notebook cell that made them runs again."""
    tabs = Explore(study, **options)
    cell = running_cell()
    if cell:
        tabs.close_with(cell)
    return tabs
