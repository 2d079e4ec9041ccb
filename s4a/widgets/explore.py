"""All panels of a study as tabs; each is built when its tab is first opened."""

from html import escape

import ipywidgets
from IPython import get_ipython

from s4a.widgets.correspondence import Correspondence
from s4a.widgets.functional import FunctionalMap
from s4a.widgets.median import Median
from s4a.widgets.modes import Modes
from s4a.widgets.network import Network
from s4a.widgets.panel import LAYOUT, close_all
from s4a.widgets.spectrum import Spectrum
from s4a.widgets.transfer import Transfer

PANELS = {
    "Modes": Modes,
    "Network": Network,
    "Functional map": FunctionalMap,
    "Median": Median,
    "Correspondence": Correspondence,
    "Transfer": Transfer,
    "Spectrum": Spectrum,
}


class Explore(ipywidgets.VBox):
    """Tabs over a study.

    Parameters
    ----------
    study : xarray.DataTree
        Finished or not; the tab of a stage that is not there yet says what is missing.
    **options
        Given to every panel: ``view`` and ``up``.

    Attributes
    ----------
    panels : dict
        Title of the tab -> panel, of those that were opened.
    """

    def __init__(self, study, **options):
        self.study, self.options, self.panels = study, options, {}
        self.tabs = ipywidgets.Tab(
            children=[ipywidgets.VBox() for _ in PANELS], titles=list(PANELS)
        )
        self.tabs.add_class("s4a-tabs")  # in style.css
        super().__init__([self.tabs], layout=LAYOUT)
        self.tabs.observe(self.fill, "selected_index")
        self.fill()

    def fill(self, change=None):
        """Build the panel of the selected tab, or say why there is none."""
        title = list(PANELS)[self.tabs.selected_index or 0]
        box = self.tabs.children[self.tabs.selected_index or 0]
        if title in self.panels:
            return
        for child in box.children:
            close_all(child)
        try:
            self.panels[title] = PANELS[title](self.study, **self.options)
            box.children = [self.panels[title]]
        except ValueError as error:
            box.children = [ipywidgets.HTML(f'<p role="status">{escape(str(error))}</p>')]

    def refresh(self, study):
        """Show a newer state of the study in all panels."""
        for panel in self.panels.values():
            panel.close()
        self.panels.clear()
        self.extend(study)

    def extend(self, study):
        """Show what a newer state of the study has more; panels that are open stay as they are."""
        self.study = study
        self.fill()

    def __getitem__(self, title):
        """The panel of a tab, which is opened for it."""
        self.tabs.selected_index = list(PANELS).index(title)
        return self.panels[title]

    def close(self):
        """Close all panels."""
        close_all(self)


OPEN = {}  # cell of a notebook -> the run of it, and the tabs that this run opened


def running_cell():
    """The cell of a notebook that runs, and which run of it this is; None elsewhere."""
    kernel = getattr(get_ipython(), "kernel", None)
    message = {} if kernel is None else kernel.get_parent()
    cell = message.get("metadata", {}).get("cellId")
    return cell and (cell, message["header"]["msg_id"])


def explore(study, **options):
    """Tabs in place of those that an earlier run of the same cell opened, which are closed.

    Nothing piles up.
    """
    found = running_cell()
    if found is None:
        return Explore(study, **options)
    cell, run = found
    before, opened = OPEN.get(cell, (run, []))
    if before != run:
        for tabs in opened:
            tabs.close()
        opened = []
    OPEN[cell] = run, [*opened, Explore(study, **options)]
    return OPEN[cell][1][-1]
