"""Figures whose parts a notebook shows side by side, or below each other in a narrow cell."""

import io

from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from s4a.show.draw import data_uri

GAP = 8  # pixels between parts
SHRINK, GROW = 0.7, 1.6  # how far the width of a part may be from that of the figure
PAGE = """
<figure role="img" aria-label="{{ alt }}" style="margin: 0">
{% if title %}<div style="font-weight: bold; margin: 4px 0 8px">{{ title }}</div>{% endif %}
<div style="display: flex; flex-wrap: wrap; align-items: center; gap: {{ gap }}px">
{% for width, least, most, address in parts %}
<img alt="" src="{{ address }}" style="flex: {{ width }} 1 {{ least }}px;
min-width: 0; max-width: min(100%, {{ most }}px); height: auto">
{% endfor %}
</div>
</figure>
"""


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
            parts.append((width, round(SHRINK * width), round(GROW * width), address))
        self.set_layout_engine(layout)
        page = Environment(autoescape=True).from_string(PAGE)
        return page.render(alt=self.alt or title, title=title, parts=parts, gap=GAP).strip()

    def _boxes(self):
        """The axes of each part and what it takes; several rows stay below each other as one."""
        found = [([ax], ax.get_tightbbox()) for ax in self.axes]
        boxes = [(ax, box) for ax, box in found if box is not None and min(box.size) > 0]
        rows = {ax.get_subplotspec().rowspan.start for ax in self.axes if ax.get_subplotspec()}
        return boxes if len(rows) < 2 else [(self.axes, Bbox.union([box for _, box in boxes]))]

    def _ipython_display_(self) -> None:
        from IPython.display import HTML, display

        display(HTML(self.html()))
