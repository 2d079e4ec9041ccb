"""What all panels share: a line for messages, callbacks that show their errors, closing, a page."""

import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ipywidgets
import xarray as xr

from s4a.show.browser import PARTS
from s4a.show.panel_page import LIMIT, panel_html
from s4a.show.surfaces import has

log = logging.getLogger(__name__)
LAYOUT = {"max_width": "1000px", "overflow": "hidden"}
WIDER = "1600px"  # of panels of many views
WIDE = {"width": "340px"}


def close_all(widget: ipywidgets.Widget) -> None:
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


def dropdown(description: str, options: list, **more: Any) -> ipywidgets.Dropdown:
    """A list to choose from."""
    return ipywidgets.Dropdown(options=options, description=description, **more)


def int_slider(
    description: str, value: int, low: int, high: int, width: str = "340px", **more: Any
) -> ipywidgets.IntSlider:
    """A slider of integers that tells its value when it is let go."""
    more = {"continuous_update": False, "layout": {"width": width}} | more
    return ipywidgets.IntSlider(value, min=low, max=high, description=description, **more)


def file_name(name: str) -> ipywidgets.Text:
    """The name of a file to write."""
    return ipywidgets.Text(name, description="file", layout={"width": "260px"})


def row(*widgets: ipywidgets.Widget) -> ipywidgets.HBox:
    """Widgets side by side, on several lines where it is narrow."""
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "center"})


def beside(*widgets: ipywidgets.Widget) -> ipywidgets.HBox:
    """Large parts side by side, of equal width where there is room for it."""
    for widget in widgets:
        widget.layout.flex, widget.layout.min_width = "1 1 320px", "0"
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "flex-start"})


def grid(*widgets: ipywidgets.Widget) -> ipywidgets.GridBox:
    """Large parts of equal width, as many side by side as there is room for."""
    for widget in widgets:
        widget.layout.min_width = "0"
    columns = "repeat(auto-fit, minmax(min(300px, 100%), 1fr))"
    return ipywidgets.GridBox(widgets, layout={"grid_template_columns": columns})


class Panel(ipywidgets.VBox):
    """A panel: subclasses build their parts in ``build``, and their callbacks are guarded.

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
    wide = False  # whether it takes more than the width of a text
    # for a saved page:
    live = ()  # groups of controls, by name, whose values it keeps; the last varies slowest
    clicks = ()  # chart, part of the mark that is clicked, and the control that it sets
    every = ()  # sliders of which it keeps every value, and not only two dozen of them
    python = ()  # what else needs Python

    def __init__(self, study: xr.DataTree, **options: Any):
        lacking = [name for name in self.needs if not has(study, name)]
        if lacking:
            raise ValueError(
                f"the panel {self.title} needs {', '.join(lacking)}, "
                "which this study does not have (yet)"
            )
        super().__init__(layout=LAYOUT | ({"max_width": WIDER} if self.wide else {}))
        self.study = study
        self.message, self.failed = ipywidgets.HTML(), False
        self.children = [*self.build(**options), self.message]

    def build(self, **options: Any) -> list[ipywidgets.Widget]:
        """The parts of the panel."""
        raise NotImplementedError

    def control(self, name: str) -> ipywidgets.Widget:
        """The control of a name in `live`."""
        return getattr(self, name)

    def say(self, text: str, error: bool = False) -> None:
        """Show a line below the panel."""
        self.failed = error
        self.message.value = PARTS.message(text, error) if text else ""

    def guarded(self, function: Callable) -> Callable:
        """`function` as a callback whose errors are shown in the panel, and logged."""

        @functools.wraps(function)
        def call(*arguments):
            if self.failed:
                self.say("")
            try:
                return function(*arguments)
            except Exception as error:
                log.exception("%s: %s", self.title, function.__name__)
                self.say(f"{type(error).__name__}: {error}", error=True)
                return None

        return call

    def on_change(self, widget: ipywidgets.Widget, function: Callable, name: str = "value") -> None:
        """Call `function` with the new value of a trait, guarded."""
        widget.observe(self.guarded(lambda change: function(change["new"])), name)

    def redraw(self, function: Callable, *controls: ipywidgets.Widget) -> None:
        """Call `function` without arguments when one of the controls has another value."""
        for control in controls:
            self.on_change(control, lambda _: function())

    def button(
        self, text: str, function: Callable, tooltip: str = "", **more: Any
    ) -> ipywidgets.Button:
        """A button that calls `function` without arguments, guarded."""
        button = ipywidgets.Button(description=text, tooltip=tooltip, **more)
        button.on_click(self.guarded(lambda _: function()))
        return button

    def saving(self, text: str, save: Callable, tooltip: str) -> ipywidgets.Button:
        """A button that writes a file and says which; `save` gives its path."""
        return self.button(text, lambda: self.say(f"written: {save()}"), tooltip)

    def save_html(self, path: Path | str, *, limit: int = LIMIT) -> Path:
        """Write the panel, as it stands, as one HTML file that needs no kernel and no network.

        Surfaces turn, charts say their numbers, and controls show what Python showed for their
        values, which are gone through one by one and kept, up to `limit` characters of them; the
        page says what needs Python.

        Returns
        -------
        pathlib.Path
        """
        path = Path(path)
        path.write_text(panel_html(self, limit), encoding="utf-8")
        return path

    def close(self) -> None:
        """Close the panel and everything in it."""
        close_all(self)
