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


def kinds_of(study: xr.DataTree) -> dict[str, type[Panel]]:
    """Title of a tab -> its panel: those whose needs the study has, or a finished run gives it."""
    known = PANELS | {kind.title: kind for kind in extensions("s4a.panels").values()}
    coming = STAGES if not study.children or set(STAGES) & set(study.children) else ()
    found = {
        title: kind
        for title, kind in known.items()
        if all(has(study, need) or need.partition("/")[0] in coming for need in kind.needs)
    }
    return found or PANELS


def running_cell() -> str | None:
    """The id of the notebook's cell that runs; None outside of a notebook."""
    kernel = getattr(get_ipython(), "kernel", None)
    return kernel.get_parent().get("metadata", {}).get("cellId") if kernel else None


class Explore(KernelWidget):
    """Tabs over a study.

    Parameters
    ----------
    study : xarray.DataTree
        Finished or not; the tab of a stage that is not there yet says what is missing.
    width : float or str, optional
        In pixels, or any width of CSS; all that the cell has by default.
    **options
        Given to every panel: ``font``, ``view`` and ``up``.

    Attributes
    ----------
    panels : dict
        Title of the tab -> panel, of those that were opened.
    pair : tuple of str
        Source and target of the map that is chosen in all tabs, ("", "") for none.  *Network* and
        *Functional map* stay as they are where the network has no such map.
    shape : str
        The shape that is chosen in all tabs, at first the median; "" for none.
    """

    title = "Panels of a study"
    pair = traitlets.Tuple(("", ""))
    shape = traitlets.Unicode("")

    def __init__(self, study: xr.DataTree, *, width: float | str | None = None, **options: Any):
        self.study, self.options, self.panels = study, options, {}
        self.reasons = {}  # title of the tab -> why it has no panel
        self.kinds = kinds_of(study)
        later = PARTS.message("This tab is filled by a running kernel when it is opened.")
        boxes = [ipywidgets.VBox([ipywidgets.HTML(later)]) for _ in self.kinds]
        self.tabs = ipywidgets.Tab(children=boxes, titles=list(self.kinds))
        self.tabs.add_class("s4a-tabs")  # in style.css
        super().__init__([self.tabs], layout=panel_layout(width))
        self.shape = attribute(study, "latent", "median")
        self.tabs.observe(self.fill, "selected_index")
        self.observe(lambda _: self.give(), ["pair", "shape"])
        self.fill()
        self.cell = None  # at whose next run they close

    @property
    def page(self) -> str:
        """What writes a page of the first tab."""
        title = next(iter(self.kinds))
        return f'panels["{title}"].save_html("{title.lower()}.html")'

    def close_with(self, cell: str) -> None:
        """Close when the cell of the notebook is run again, so that nothing piles up."""
        self.cell = cell
        get_ipython().events.register("pre_run_cell", self.before_run)

    def before_run(self, run: ExecutionInfo) -> None:
        """Close if `run`, what IPython is about to do, is of the cell that made these tabs."""
        if run.cell_id == self.cell:
            self.close()

    def fill(self, change: object = None) -> None:
        """Build the panel of the selected tab, or say why there is none; it shows the selection."""
        title = list(self.kinds)[self.tabs.selected_index or 0]
        box = self.tabs.children[self.tabs.selected_index or 0]
        if title in self.panels:
            self.give()
            return
        for child in box.children:
            close_all(child)
        try:
            self.panels[title] = panel = self.kinds[title](self.study, **self.options)
            box.children = [panel]
            self.reasons.pop(title, None)
            if panel.shares:
                panel.observe(lambda _: self.take(panel), panel.shares)
            self.give()
        except Exception as error:  # whatever it is, the tab must show it
            reason = str(error)
            if not isinstance(error, ValueError):
                log.exception("%s", title)
                reason = f"{type(error).__name__}: {error}"
            self.reasons[title] = reason
            box.children = [ipywidgets.HTML(PARTS.message(reason))]

    def take(self, panel: Panel) -> None:
        """Choose for all tabs what is chosen in a panel."""
        if panel.recording:  # its values are gone through, and nothing is chosen
            return
        found = panel.selection()
        with self.hold_trait_notifications():  # sent together: a panel shows a pair or a shape
            self.pair = found.get("pair", self.pair)
            self.shape = found.get("shape") or self.shape

    def give(self) -> None:
        """Show the selection in the tab that is seen; the others get it when they are."""
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
        """Show what a newer state of the study has more; panels that are open stay as they are."""
        self.study = study
        self.shape = self.shape or attribute(study, "latent", "median")
        self.reasons.clear()
        self.fill()

    def __getitem__(self, title: str) -> ipywidgets.Widget:
        """The panel of a tab, which is opened for it."""
        if title not in self.kinds:
            raise ValueError(f"there is no tab {title!r}; there are {', '.join(self.kinds)}")
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
    """Tabs over a study that close when the cell of the notebook that made them is run again."""
    tabs = Explore(study, **options)
    cell = running_cell()
    if cell:
        tabs.close_with(cell)
    return tabs
