"""Figures whose parts a notebook shows side by side, or below each other in a narrow cell."""

import io
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from s4a.show.draw import data_uri

GAP = 8  # pixels between parts
SHRINK, GROW = 0.7, 1.6  # how far the width of a part may be from that of the figure
PAGE = Path(__file__).parent / "templates" / "figure.html"


def _lines(widths):
    """For one line of parts, two, and so on: what is to say how wide each part is on them.

    The widths that the fullest line has room for, the pixels of the gaps in it at the most, and
    below which width of the cell one line less is too few, None for the first. So all parts are of
    one scale, on as few lines as keep it above `SHRINK`.
    """
    n = len(widths)
    runs = sorted({sum(widths[i:j]) for i in range(n) for j in range(i + 1, n + 1)})
    lines, below = [], None
    for count in range(1, n + 1):
        room = next(run for run in runs if _count(widths, run) <= count)
        gaps = GAP * (n - count) + 1
        lines.append((room, gaps, below))
        below = round(SHRINK * room) + gaps
    return lines


def _count(widths, room):
    """On how many lines parts stand that are begun when the last has no room."""
    count, filled = 1, 0
    for width in widths:
        if width > room:
            return len(widths) + 1
        if filled + width > room:
            count, filled = count + 1, 0
        filled += width
    return count


class Parts(Figure):
    """A figure that a notebook shows axes by axes, with words for those who do not see it.

    Attributes
    ----------
    alt : str
        What is seen in it.

    Examples
    --------
    >>> from s4a.show.parts import Parts
    >>> figure = Parts(figsize=(4, 2))
    >>> figure.alt = "two empty frames"
    >>> axes = figure.subplots(1, 2)
    >>> figure.html().count("<img")
    2
    """

    alt = ""

    def html(self) -> str:
        """A page's part with a picture of each axes, twice as sharp as it is shown."""
        from jinja2 import Environment

        title = self.get_suptitle()
        self.draw_without_rendering()
        layout = self.get_layout_engine()
        self.set_layout_engine("none")  # it would move what is shown where the others are hidden
        parts = []
        for shown, box in self._boxes():
            inches = box.transformed(self.dpi_scale_trans.inverted()).padded(0.04)
            file = io.BytesIO()
            hidden = [ax for ax in self.axes if ax.get_visible() and ax not in shown]
            for ax in hidden:  # wide titles reach into the boxes of their neighbours
                ax.set_visible(False)
            self.savefig(file, format="png", dpi=192, bbox_inches=inches)
            for ax in hidden:
                ax.set_visible(True)
            width = round(96 * inches.width)
            address = data_uri(file.getvalue(), "image/png")
            parts.append((width, round(GROW * width), address))
        self.set_layout_engine(layout)
        page = Environment(autoescape=True).from_string(PAGE.read_text("utf-8"))
        lines = _lines([width for width, *_ in parts])
        looks = {"alt": self.alt or title, "title": title, "gap": GAP}
        return page.render(**looks, parts=parts, lines=lines).strip()

    def _boxes(self):
        """The axes of each part and what it takes; several rows stay below each other as one."""
        found = [([ax], ax.get_tightbbox()) for ax in self.axes]
        boxes = [(ax, box) for ax, box in found if box is not None and min(box.size) > 0]
        places = [ax.get_subplotspec() for ax in self.axes]
        rows = {place.rowspan.start for place in places if place}
        return boxes if len(rows) < 2 else [(self.axes, Bbox.union([box for _, box in boxes]))]

    def _ipython_display_(self) -> None:
        from IPython.display import HTML, display

        display(HTML(self.html()))
