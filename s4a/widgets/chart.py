"""Charts that can be clicked: scatter, bars, lines, graph and matrix."""

import ipywidgets
import numpy as np
import traitlets

from s4a.show import charts
from s4a.show.draw import SIGNED, data_uri
from s4a.show.live import STYLE, as_bytes, table
from s4a.widgets.browser import CHART, anywidget


def plain(value):
    """NumPy numbers and arrays as Python's own, NaN as None, so that they can be sent.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.chart import plain
    >>> plain({"x": np.array([1.0, np.nan]), "n": np.int64(3)})
    {'x': [1.0, None], 'n': 3}
    """
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


class ChartBase:
    """What a chart does, whoever draws it."""

    def draw(self, kind, **spec):
        """Draw a chart: ``scatter``, ``bars``.

        ``lines`` or ``graph`` with the numbers that the kind needs.
        """
        self.spec = plain({"kind": kind, **spec})

    def matrix(self, values, limit=1.0, **spec):
        """Draw a matrix ``(rows, columns)`` with signed colours from -limit to limit."""
        values = np.asarray(values)
        self.values = as_bytes(values, "float32")
        self.draw("matrix", rows=values.shape[0], columns=values.shape[1], limit=limit, **spec)


if anywidget is not None:

    class Chart(ChartBase, anywidget.AnyWidget):
        """A chart in the browser.

        `picked` is the mark that was clicked: an index, node, edge, or row and column.
        """

        _esm, _css = CHART, STYLE
        spec, picked = traitlets.Dict().tag(sync=True), traitlets.Dict().tag(sync=True)
        values, table = traitlets.Bytes().tag(sync=True), traitlets.Bytes().tag(sync=True)

        def matrix(self, values, limit=1.0, **spec):
            """Draw a matrix ``(rows, columns)`` with signed colours from -limit to limit."""
            with self.hold_sync():
                self.table = self.table or table(SIGNED)
                super().matrix(values, limit, **spec)


class StillChart(ChartBase, ipywidgets.HTML):
    """The chart where anywidget is not installed: a drawing that cannot be clicked."""

    spec, picked, values = traitlets.Dict(), traitlets.Dict(), traitlets.Bytes()

    @traitlets.observe("spec")
    def _draw(self, change):
        figure = charts.from_spec(self.spec, np.frombuffer(self.values, "<f4"))
        self.value = f'<img alt="" src="{data_uri(charts.svg(figure), "image/svg+xml")}">'


def chart():
    """A chart: :class:`Chart`, or drawings where anywidget is not installed."""
    return StillChart() if anywidget is None else Chart()
