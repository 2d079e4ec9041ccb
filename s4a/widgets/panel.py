"""What all panels share: a line for messages, callbacks that show their errors, closing, a page."""

import contextlib
import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anywidget
import ipywidgets
import traitlets
import xarray as xr

from s4a.show.browser import FRAME, PARTS, STYLE
from s4a.show.draw import Viewpoint
from s4a.show.panel_page import LIMIT, panel_html, widgets_in
from s4a.show.surfaces import has
from s4a.widgets.views import Scene, camera_group

log = logging.getLogger(__name__)
WIDE = {"width": "26em"}
FOLLOW = "mark what is under the pointer in all views, and not only what is clicked"


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


def layout_of(width: float | str | None) -> dict[str, str]:
    """The layout of a panel that takes all the width there is, or `width`: pixels or CSS.

    Examples
    --------
    >>> from s4a.widgets.panel import layout_of
    >>> layout_of(900)
    {'overflow': 'hidden', 'width': '900px', 'max_width': '100%'}
    """
    layout = {"overflow": "hidden"}
    if width is not None:
        text = width if isinstance(width, str) else f"{width:g}px"
        layout |= {"width": text, "max_width": "100%"}
    return layout


def dropdown(description: str, tooltip: str, options: list, **more: Any) -> ipywidgets.Dropdown:
    """A list to choose from, and what it is."""
    return ipywidgets.Dropdown(options=options, description=description, tooltip=tooltip, **more)


def check(description: str, tooltip: str, on: bool = False, **more: Any) -> ipywidgets.Checkbox:
    """A box to tick, and what it is."""
    more = {"layout": {"width": "auto"}} | more
    return ipywidgets.Checkbox(on, description=description, tooltip=tooltip, indent=False, **more)


def int_slider(
    description: str, tooltip: str, value: int, low: int, high: int, **more: Any
) -> ipywidgets.IntSlider:
    """A slider of integers that tells its value when it is let go, and what it is."""
    more = {"continuous_update": False, "layout": WIDE} | more
    limits = {"min": low, "max": high}
    return ipywidgets.IntSlider(value, description=description, tooltip=tooltip, **limits, **more)


def file_name(name: str) -> ipywidgets.Text:
    """The name of a file to write."""
    tooltip = "the file to write, in the folder of the notebook"
    return ipywidgets.Text(name, description="file", tooltip=tooltip, layout={"width": "20em"})


def row(*widgets: ipywidgets.Widget) -> ipywidgets.HBox:
    """Widgets side by side, on several lines where it is narrow."""
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "center"})


def together(*widgets: ipywidgets.Widget) -> ipywidgets.HBox:
    """Widgets that stay on one line, as what they are of is one thing."""
    layout = {"align_items": "center", "flex": "none", "margin": "0 1em 0 0"}
    return ipywidgets.HBox(widgets, layout=layout)


def beside(*widgets: ipywidgets.Widget, least: str = "24em") -> ipywidgets.HBox:
    """Large parts side by side, of equal width where there is room for the `least` of each."""
    for widget in widgets:
        widget.layout.flex, widget.layout.min_width = f"1 1 {least}", "0"
    return ipywidgets.HBox(widgets, layout={"flex_flow": "row wrap", "align_items": "flex-start"})


def grid(*widgets: ipywidgets.Widget) -> ipywidgets.GridBox:
    """Large parts of equal width, as many side by side as there is room for."""
    for widget in widgets:
        widget.layout.min_width = "0"
    columns = "repeat(auto-fit, minmax(min(20em, 100%), 1fr))"
    return ipywidgets.GridBox(widgets, layout={"grid_template_columns": columns})


class Frame(anywidget.AnyWidget):
    """What every panel has around its parts: full screen, the size of its text, names for a reader.

    Attributes
    ----------
    title : str
        What the panel is called.
    font : float
        Size of the text in pixels; 0 for one that follows the panel's width.
    help : dict
        The tooltip of a control, by what stands before it: some frontends leave it out.
    """

    _esm, _css = FRAME, STYLE
    title = traitlets.Unicode("").tag(sync=True)
    font = traitlets.Float(0.0).tag(sync=True)
    help = traitlets.Dict().tag(sync=True)
    asked = traitlets.Float(0.0).tag(sync=True)  # by a page that wants to know if there is a kernel
    heard = traitlets.Float(0.0).tag(sync=True)  # the answer: the same number

    @traitlets.observe("asked")
    def _answer(self, change: dict) -> None:
        self.heard = change["new"]


class OfKernel(ipywidgets.VBox):
    """A widget that says so where a notebook is shown without its kernel, as by nbconvert."""

    title = ""
    page = 'panel.save_html("panel.html")'  # what writes a page of it

    def without_kernel(self) -> str:
        """What is shown in place of the widget, as HTML; a page of it takes too long to record."""
        return PARTS.needs_kernel(self.title, self.page)

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        return super()._repr_mimebundle_(**options) | {"text/html": self.without_kernel()}


class Panel(OfKernel):
    """A panel: subclasses build their parts in ``build``, and their callbacks are guarded.

    Parameters
    ----------
    study : xarray.DataTree
        With the nodes that the panel's ``needs`` name.
    width : float or str, optional
        In pixels, or any width of CSS; all that the cell has by default.
    font : float, optional
        Size of the text in pixels; by default it follows the panel's width.
    view, up
        From where surfaces are seen first; see :func:`s4a.show.draw.rotation`.
    **options
        Of the panel itself.

    Raises
    ------
    ValueError
        When the study lacks one of them.
    """

    needs = ()
    title = "Panel"
    # for a saved page:
    live = ()  # groups of controls, by name, whose values it keeps; the last varies slowest
    clicks = ()  # chart, part of the mark that is clicked, and the control that it sets
    every = ()  # sliders of which it keeps every value, and not only two dozen of them
    python = ()  # what else needs Python
    shares = ()  # traits that say which pair or shape is chosen in it, for the other tabs
    scenes: list[Scene] = []  # noqa: RUF012, views that answer together
    recording = False  # while a saved page goes through the values of its controls

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
                "which this study does not have (yet)"
            )
        super().__init__(layout=layout_of(width))
        self.add_class("s4a-panel")  # in style.css
        self.study = study
        self.camera: dict[str, Any] = {"group": camera_group(), "view": view, "up": up}
        self.frame = Frame(title=self.title, font=font or 0.0)
        self.message, self.failed = ipywidgets.HTML(), False
        self.children = [self.frame, *self.build(**options), self.message]
        told = [part for part in widgets_in(self) if getattr(part, "tooltip", None)]
        self.frame.help = {part.description: part.tooltip for part in told if part.description}

    def build(self, **options: Any) -> list[ipywidgets.Widget]:
        """The parts of the panel."""
        raise NotImplementedError

    def new_scene(self, height: int, **options: Any) -> Scene:
        """A view of a surface, which turns with all others of the panel."""
        return Scene(height=height, **self.camera, **options)

    def choose(self, control: ipywidgets.Widget, function: Callable[[], Any]) -> Any:
        """A control, with what is called without arguments when it has another value."""
        self.redraw(function, control)
        return control

    def follow(self) -> ipywidgets.Checkbox:
        """A box that says whether places under the pointer are marked, and not only clicked."""
        box = check("follow the pointer", FOLLOW, True)
        for scene in self.scenes:
            traitlets.link((box, "value"), (scene, "hovering"))
        return box

    def bind(self, control: ipywidgets.Widget, trait: str) -> None:
        """Let a control and a trait of the panel have one value; at first the trait's is empty."""
        self.on_change(control, lambda value: self.set_trait(trait, value))
        self.on_change(self, lambda value: control.set_trait("value", value), trait)

    def selection(self) -> dict[str, Any]:
        """The names of the ``pair`` (source, target) and of the ``shape`` chosen in the panel."""
        return {}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show the pair or shape chosen in another tab, where the panel has it; "" for none."""

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

    def on_pick(self, widget: Any, function: Callable, *events: str) -> None:
        """Call `function` with a place or mark that the browser tells, ``picked`` if not `events`.

        What it changes is sent in one message for each view, with the number of the place.
        """

        def answer(place):
            # views of surfaces answer together, as a place is marked in all of them
            views = self.scenes if widget in self.scenes else [widget]
            others = [part for part in widgets_in(self) if part not in views]
            with contextlib.ExitStack() as held:
                # the views are told first, as the last that are held
                for part in [*others, *views]:
                    held.enter_context(part.hold_sync())
                try:
                    if place.get("vertex", 0) >= 0:  # not beside the surface
                        function(place)
                finally:
                    for view in views:
                        view.answer = place.get("count", 0)

        for event in events or ("picked",):
            self.on_change(widget, answer, event)

    def redraw(self, function: Callable, *controls: ipywidgets.Widget | str) -> None:
        """Call `function` without arguments when a control, or a trait, has another value."""
        for control in controls:
            own = isinstance(control, str)
            where = (self, control) if own else (control, "value")
            self.on_change(where[0], lambda _: function(), where[1])

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
