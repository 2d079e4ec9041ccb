"""Figures whose axes a notebook shows side by side, or below each other in a narrow cell."""

import io
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from s4a.show.draw import data_uri

GAP = 8  # pixels between tiles
SHRINK, GROW = 0.85, 1.6  # smallest and largest scale of a tile, relative to the figure
PAGE = Path(__file__).parent / "templates" / "figure.html"


class TiledFigure(Figure):
    """A figure that a notebook shows axes by axes, with a text alternative.

    Attributes
    ----------
    alt : str
        Text alternative for users of a screen reader.

    Examples
    --------
    >>> from s4a.show.tiled_figure import TiledFigure
    >>> figure = TiledFigure(figsize=(4, 2))
    >>> figure.alt = "two empty frames"
    >>> axes = figure.subplots(1, 2)
    >>> figure.html().count("<img")
    2
    """

    alt = ""

    def html(self) -> str:
        """Return HTML with a picture of each axes, at twice its displayed resolution."""
        from jinja2 import Environment

        title = self.get_suptitle()
        self.draw_without_rendering()
        layout = self.get_layout_engine()
        self.set_layout_engine("none")  # it would move the axes when others are hidden
        tiles = []
        for shown, box in self._boxes():
            inches = box.transformed(self.dpi_scale_trans.inverted()).padded(0.04)
            file = io.BytesIO()
            hidden = [ax for ax in self.axes if ax.get_visible() and ax not in shown]
            for ax in hidden:  # wide titles overlap the boxes of their neighbours
                ax.set_visible(False)
            self.savefig(file, format="png", dpi=192, bbox_inches=inches)
            for ax in hidden:
                ax.set_visible(True)
            tiles.append((round(96 * inches.width), data_uri(file.getvalue(), "image/png")))
        self.set_layout_engine(layout)
        page = Environment(autoescape=True).from_string(PAGE.read_text("utf-8"))
        texts = {"alt": self.alt or title, "title": title}
        return page.render(**texts, tiles=tiles, gap=GAP, shrink=SHRINK, grow=GROW).strip()

    def _boxes(self):
        """Return the axes of each tile and its bounding box; several rows are one tile."""
        tight = [([ax], ax.get_tightbbox()) for ax in self.axes]
        boxes = [(ax, box) for ax, box in tight if box is not None and min(box.size) > 0]
        cells = [ax.get_subplotspec() for ax in self.axes]
        rows = {cell.rowspan.start for cell in cells if cell}
        return boxes if len(rows) < 2 else [(self.axes, Bbox.union([box for _, box in boxes]))]

    def _ipython_display_(self) -> None:
        from IPython.display import HTML, display

        display(HTML(self.html()))
