"""What runs in the browser: the scripts of this package, put together for a widget."""

from s4a.show.live import script

try:
    import anywidget
except ImportError:  # the panels then show pictures that Python draws
    anywidget = None

SCENE = script("dom", "surface", "view", "scene_widget")
CHART = script("dom", "chart", "chart_widget")
