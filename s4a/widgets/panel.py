"""What all panels share.

A line for messages, callbacks that show their errors, closing, and a page of their own.
"""

import functools
import logging
from html import escape
from pathlib import Path

import ipywidgets

from s4a.widgets.page import page

log = logging.getLogger(__name__)
LAYOUT = {"max_width": "1000px", "overflow": "hidden"}


def close_all(widget):
    """Close a widget, all widgets in it, and their layouts and styles.

    Nothing of them stays in the kernel.
    """
    for child in getattr(widget, "children", ()):
        close_all(child)
    for name in ("layout", "style"):
        part = getattr(widget, name, None)
        if isinstance(part, ipywidgets.Widget):
            part.close()
    ipywidgets.Widget.close(widget)


def paragraph(text):
    """A paragraph of HTML, with the usual distance of lines."""
    return f'<div style="line-height:1.4">{text}</div>'


def row(*widgets):
    """Widgets side by side, on several lines where it is narrow."""
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "center"})


def beside(*widgets, width="320px"):
    """Large parts side by side, of equal width where there is room for it."""
    for widget in widgets:
        widget.layout.flex, widget.layout.min_width = f"1 1 {width}", "0"
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "flex-start"})


class Panel(ipywidgets.VBox):
    """A panel: subclasses build their parts in ``build`` and give callbacks through :meth:`guarded`.

    Parameters
    ----------
    study : xarray.DataTree
        With the nodes that the panel's ``needs`` name.

    Raises
    ------
    ValueError
        When the study lacks one of them.
    """

    needs = ()
    title = "Panel"
    live = ()  # groups of controls, by their names, whose values a saved page keeps; the last varies slowest
    clicks = ()  # chart, part of the mark that is clicked, and the control that it sets
    every = ()  # sliders of which a page keeps every value, and not only two dozen of them
    python = ()  # what else needs Python

    def __init__(self, study, **options):
        from s4a.show.pictures import has

        lacking = [name for name in self.needs if not has(study, name)]
        if lacking:
            raise ValueError(
                f"the panel {self.title} needs {', '.join(lacking)}, which this study does not have (yet)"
            )
        super().__init__(layout=LAYOUT)
        self.study = study
        self.message = ipywidgets.HTML()
        self.children = [*self.build(**options), self.message]

    def build(self, **options):
        """The parts of the panel, as a list of widgets."""
        raise NotImplementedError

    def control(self, name):
        """The control of a name in `live`."""
        return getattr(self, name)

    def say(self, text, error=False):
        """Show a line below the panel."""
        style = "color:#a40000;font-weight:bold" if error else "color:#444"
        self.message.value = (
            f'<div role="status" style="{style}">{escape(text)}</div>' if text else ""
        )

    def guarded(self, function):
        """`function` as a callback whose errors are shown in the panel.

        And logged with their place.
        """

        @functools.wraps(function)
        def call(*arguments):
            if "#a40000" in self.message.value:
                self.say("")
            try:
                return function(*arguments)
            except Exception as error:
                log.exception("%s: %s", self.title, function.__name__)
                self.say(f"{type(error).__name__}: {error}", error=True)
                return None

        return call

    def on_change(self, widget, function, name="value"):
        """Call `function` with the new value of a trait, guarded."""
        widget.observe(self.guarded(lambda change: function(change["new"])), name)

    def save_html(self, path):
        """Write the panel, as it stands, as one HTML file that needs no kernel and no network.

        Surfaces turn, charts say their numbers, and controls show what Python showed for their
        values, which are gone through one by one and kept, up to 24 MB of them; the page says what
        needs Python.

        Returns
        -------
        pathlib.Path
        """
        path = Path(path)
        path.write_text(page(self), encoding="utf-8")
        return path

    def close(self):
        """Close the panel and everything in it."""
        close_all(self)
