"""Charts that can be clicked: scatter, bars, lines, graph and matrix."""

from typing import Any

import anywidget
import numpy as np
import traitlets

from s4a.show.browser import CHART, STYLE, palette, to_bytes
from s4a.show.draw import SIGNED

AXES = "eigenfunction of the source", "eigenfunction of the target"  # of columns, and of rows
DIRECTION = (
    "C transfers functions from the source to the target: of their coefficients a on the source "
    "(columns) it makes b = C a on the target (rows)."
)


def plain(value: object) -> object:
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


class Chart(anywidget.AnyWidget):
    """A chart in the browser.

    Attributes
    ----------
    spec : dict
        The ``kind`` of chart, its numbers and names.
    picked : dict
        The mark that was clicked: an index, node, edge, or row and column, and its number `count`.
    answer : int
        The number of the mark to which the chart answers as it is; -1 for none.  Answers to marks
        older than the last are not drawn.
    """

    _esm, _css = CHART, STYLE
    spec = traitlets.Dict().tag(sync=True)
    picked = traitlets.Dict().tag(sync=True)
    answer = traitlets.Int(-1).tag(sync=True)
    values = traitlets.Bytes().tag(sync=True)
    palette = traitlets.Bytes(palette(SIGNED)).tag(sync=True)

    def draw(self, kind: str, **spec: Any) -> None:
        """Draw ``scatter``, ``bars``, ``lines`` or ``graph``: numbers as chart.js names them."""
        with self.hold_sync():
            self.answer = -1
            self.spec = plain({"kind": kind, **spec})

    def matrix(self, values: np.ndarray, limit: float = 1.0, **spec: Any) -> None:
        """Draw a functional map ``(rows, columns)`` with signed colours from -limit to limit."""
        rows, columns = np.shape(values)
        with self.hold_sync():
            self.values = to_bytes(values, "float32")
            self.draw("matrix", rows=rows, columns=columns, limit=limit, axes=AXES, **spec)
