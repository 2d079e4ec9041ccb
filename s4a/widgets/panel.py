"""Base class of the panels: messages, callbacks that show their errors, closing, saved pages."""

import contextlib
import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import anywidget
import ipywidgets
import traitlets
import xarray as xr

from s4a.show.browser import FRAME, PARTS, STYLE
from s4a.show.draw import Viewpoint
from s4a.show.panel_page import LIMIT, panel_html, widgets_in
from s4a.show.surfaces import has
from s4a.widgets.views import Scene

log = logging.getLogger(__name__)
WIDE = {"width": "26em"}
FOLLOW = "mark the vertex under the pointer in all views, not only a clicked one"


def close_all(widget: ipywidgets.Widget) -> None:
    """Remove a widget, its descendants, and their layouts and styles from the kernel."""
    for child in getattr(widget, "children", ()):
        close_all(child)
    for name in ("layout", "style"):
        part = getattr(widget, name, None)
        if isinstance(part, ipywidgets.Widget):
            part.close()
    ipywidgets.Widget.close(widget)


def panel_layout(width: float | str | None) -> dict[str, str]:
    """Return the layout of a panel of a width in pixels or CSS; None for the available width.

    Examples
    --------
    >>> from s4a.widgets.panel import panel_layout
    >>> panel_layout(900)
    {'overflow': 'hidden', 'width': '900px', 'max_width': '100%'}
    """
    layout = {"overflow": "hidden"}
    if width is not None:
        text = width if isinstance(width, str) else f"{width:g}px"
        layout |= {"width": text, "max_width": "100%"}
    return layout


def dropdown(description: str, tooltip: str, options: list, **more: Any) -> ipywidgets.Dropdown:
    """Return a list of options with a tooltip."""
    return ipywidgets.Dropdown(options=options, description=description, tooltip=tooltip, **more)


def checkbox(description: str, tooltip: str, on: bool = False, **more: Any) -> ipywidgets.Checkbox:
    """Return a checkbox with a tooltip."""
    more = {"layout": {"width": "auto"}} | more
    return ipywidgets.Checkbox(on, description=description, tooltip=tooltip, indent=False, **more)


def int_slider(
    description: str, tooltip: str, value: int, low: int, high: int, **more: Any
) -> ipywidgets.IntSlider:
    """Return a slider of integers with a tooltip; its value changes when it is released."""
    more = {"continuous_update": False, "layout": WIDE} | more
    limits = {"min": low, "max": high}
    return ipywidgets.IntSlider(value, description=description, tooltip=tooltip, **limits, **more)


def file_name(name: str) -> ipywidgets.Text:
    """Return a text field for the name of an output file."""
    tooltip = "the output file, relative to the folder of the notebook"
    return ipywidgets.Text(name, description="file", tooltip=tooltip, layout={"width": "20em"})


def row(*widgets: ipywidgets.Widget) -> ipywidgets.HBox:
    """Return a row of widgets that wraps where the cell is narrow."""
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "center"})


def columns(*widgets: ipywidgets.Widget, min_width: str = "24em") -> ipywidgets.HBox:
    """Return columns of equal width that wrap if one would be narrower than `min_width`."""
    for widget in widgets:
        widget.layout.flex, widget.layout.min_width = f"1 1 {min_width}", "0"
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "flex-start"})


def grid(*widgets: ipywidgets.Widget) -> ipywidgets.GridBox:
    """Return a grid of widgets of equal width, as many in a row as fit."""
    for widget in widgets:
        widget.layout.min_width = "0"
    template = "repeat(auto-fit, minmax(min(20em, 100%), 1fr))"
    return ipywidgets.GridBox(widgets, layout={"grid_template_columns": template})


class Frame(anywidget.AnyWidget):
    """Frame of a panel: full screen, font size, accessible names.

    Attributes
    ----------
    title : str
        Title of the panel.
    font : float
        Font size in pixels; 0 if it is proportional to the panel's width.
    help : dict
        Tooltip of each control by its description, for frontends that omit tooltips.
    """

    _esm, _css = FRAME, STYLE
    title = traitlets.Unicode("").tag(sync=True)
    font = traitlets.Float(0.0).tag(sync=True)
    help = traitlets.Dict().tag(sync=True)
    ping = traitlets.Float(0.0).tag(sync=True)  # a number that the page sends to detect a kernel
    pong = traitlets.Float(0.0).tag(sync=True)  # the kernel's answer: the same number

    @traitlets.observe("ping")
    def _answer(self, change: dict) -> None:
        self.pong = change["new"]


class KernelWidget(ipywidgets.VBox):
    """A widget with a note in its place where a notebook is shown without a kernel (nbconvert)."""

    title = ""
    page_command = 'panel.save_html("panel.html")'  # writes a page of the widget

    def without_kernel(self) -> str:
        """Return the HTML that is shown where there is no kernel."""
        return PARTS.needs_kernel(self.title, self.page_command)

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        return super()._repr_mimebundle_(**options) | {"text/html": self.without_kernel()}


class Panel(KernelWidget):
    """Base class of panels: subclasses create their widgets in ``build``.

    Parameters
    ----------
    study : xarray.DataTree
        It must have the nodes and variables that the class attribute ``needs`` lists.
    width : float or str, optional
        Width in pixels or as a CSS length; by default the width of the cell.
    font : float, optional
        Font size in pixels; by default it is proportional to the panel's width.
    view, up
        Initial direction of view; see :func:`s4a.show.draw.rotation`.
    **options
        Passed to ``build``.

    Raises
    ------
    ValueError
        If the study lacks a node or variable.

    See Also
    --------
    s4a.explore : all panels of a study as tabs.
    """

    needs = ()
    title = "Panel"
    # of a saved page:
    live = ()  # groups of controls, by name, whose values are recorded; the last varies slowest
    clicks = ()  # chart, key of the clicked mark, and the control that a click sets
    every = ()  # sliders of which all values are recorded, not only two dozen
    python = ()  # other actions that need Python
    # traits that name the selected pair or shape, for the other tabs; a single one is of `names`
    shares: tuple[str, ...] = ()
    names: list[str] = []  # noqa: RUF012, of the shapes that can be selected
    scenes: list[Scene] = []  # noqa: RUF012, views that are updated together
    recording = False  # while the values of the controls are recorded for a saved page

    def __init__(
        self,
        study: xr.DataTree,
        *,
        width: float | str | None = None,
        font: float | None = None,
        view: Viewpoint = "corner",
        up: str = "z",
        **options: Any,
    ):
        lacking = [name for name in self.needs if not has(study, name)]
        if lacking:
            raise ValueError(
                f"the panel {self.title} needs {', '.join(lacking)}, "
                "which this study does not have (yet); finish the run"
            )
        super().__init__(layout=panel_layout(width))
        self.add_class("s4a-panel")  # in style.css
        self.study = study
        # views of one group rotate together
        self.camera: dict[str, Any] = {"group": uuid4().hex, "view": view, "up": up}
        self.frame = Frame(title=self.title, font=font or 0.0)
        self.message, self.failed = ipywidgets.HTML(), False
        self.children = [self.frame, *self.build(**options), self.message]
        controls = [widget for widget in widgets_in(self) if getattr(widget, "tooltip", None)]
        self.frame.help = {c.description: c.tooltip for c in controls if c.description}

    def build(self, **options: Any) -> list[ipywidgets.Widget]:
        """Return the widgets of the panel."""
        raise NotImplementedError

    def new_scene(self, height: int, **options: Any) -> Scene:
        """Return a view of a surface that rotates with the other views of the panel."""
        return Scene(height=height, **self.camera, **options)

    def follow(self) -> ipywidgets.Checkbox:
        """Return a checkbox: mark the vertex under the pointer, not only a clicked one."""
        box = checkbox("follow the pointer", FOLLOW, True)
        for scene in self.scenes:
            traitlets.link((box, "value"), (scene, "hovering"))
        return box

    def bind(self, control: ipywidgets.Widget, trait: str) -> None:
        """Link a control and a trait of the panel, whose initial value is empty."""
        self.on_change(control, lambda value: self.set_trait(trait, value))
        self.on_change(self, lambda value: control.set_trait("value", value), trait)

    def selection(self) -> dict[str, Any]:
        """Return the selected ``pair`` (source, target) and ``shape``, by name."""
        return {"shape": getattr(self, *self.shares)}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show the pair or shape selected in another tab, if the panel has it; "" for none."""
        if self.shares and shape in self.names:
            self.set_trait(*self.shares, shape)

    def control(self, name: str) -> ipywidgets.Widget:
        """Return the control of a name in `live`."""
        return getattr(self, name)

    def show_message(self, text: str, error: bool = False) -> None:
        """Show a message below the panel."""
        self.failed = error
        self.message.value = PARTS.message(text, error) if text else ""

    def guarded(self, function: Callable) -> Callable:
        """Wrap `function` as a callback whose errors are shown in the panel and logged."""

        @functools.wraps(function)
        def call(*arguments):
            if self.failed:
                self.show_message("")
            try:
                return function(*arguments)
            except Exception as error:
                log.exception("%s: %s", self.title, function.__name__)
                self.show_message(f"{type(error).__name__}: {error}", error=True)
                return None

        return call

    def on_change(self, widget: ipywidgets.Widget, function: Callable, name: str = "value") -> None:
        """Call `function` with the new value of a trait; errors are shown in the panel."""
        widget.observe(self.guarded(lambda change: function(change["new"])), name)

    def on_pick(self, widget: Any, function: Callable, *events: str) -> None:
        """Call `function` with the point or mark that is picked in the browser.

        `events` are the traits that it observes, ``picked`` by default.  Each view gets its changes
        in one message, with the number of the pick that they answer.
        """

        def answer(picked):
            # all views of surfaces are updated, as a picked vertex is marked in each of them
            views = self.scenes if widget in self.scenes else [widget]
            others = [part for part in widgets_in(self) if part not in views]
            with contextlib.ExitStack() as messages:
                # the stack sends in reverse order: views first
                for part in [*others, *views]:
                    messages.enter_context(part.hold_sync())
                try:
                    if picked.get("vertex", 0) >= 0:  # on the surface
                        function(picked)
                finally:
                    for view in views:
                        view.answer = picked.get("count", 0)

        for event in events or ("picked",):
            self.on_change(widget, answer, event)

    def redraw(self, function: Callable, *controls: ipywidgets.Widget | str) -> None:
        """Call `function` without arguments when a control, or a trait of the panel, changes."""
        for control in controls:
            owner, trait = (self, control) if isinstance(control, str) else (control, "value")
            self.on_change(owner, lambda _: function(), trait)

    def button(
        self, text: str, function: Callable, tooltip: str = "", **more: Any
    ) -> ipywidgets.Button:
        """Return a button that calls `function` without arguments; errors are shown."""
        button = ipywidgets.Button(description=text, tooltip=tooltip, **more)
        button.on_click(self.guarded(lambda _: function()))
        return button

    def save_button(self, text: str, save: Callable, tooltip: str) -> ipywidgets.Button:
        """Return a button that calls `save` and shows the path that `save` returns."""
        return self.button(text, lambda: self.show_message(f"written: {save()}"), tooltip)

    def save_html(self, path: Path | str, *, limit: int = LIMIT) -> Path:
        """Write the panel in its current state as one HTML file without kernel and network access.

        Surfaces rotate, charts show their numbers, and controls show recorded output.  The output
        is recorded for the values of the controls one by one, up to `limit` characters.  The page
        says what needs Python.

        Returns
        -------
        pathlib.Path
        """
        path = Path(path)
        path.write_text(panel_html(self, limit), encoding="utf-8")
        return path

    def close(self) -> None:
        """Close the panel and all widgets in it."""
        close_all(self)
