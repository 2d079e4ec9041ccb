"""What runs in the browser: the scripts of this package, put together for a widget or for a page of its own."""

from pathlib import Path

try:
    import anywidget
except ImportError:  # the panels then show pictures that Python draws
    anywidget = None

FOLDER = Path(__file__).parent / "esm"


def script(*names):
    """The text of some scripts of the folder ``esm``, one after the other, as one module."""
    return "\n".join((FOLDER / f"{name}.js").read_text(encoding="utf-8") for name in names)


STYLE = (FOLDER / "style.css").read_text(encoding="utf-8")
SCENE = script("dom", "surface", "view", "scene_widget")
CHART = script("dom", "chart", "chart_widget")
MODES = script("dom", "surface", "view", "chart", "modes_widget")
