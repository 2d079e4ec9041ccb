"""Panels that show a study in a notebook; the computations are in the modules of the steps."""

from typing import Any

try:
    import anywidget  # noqa: F401
    import ipywidgets  # noqa: F401
except ImportError as error:
    raise ImportError(
        "the panels need ipywidgets and anywidget, which are not installed; "
        "run: pip install s4a[notebook]"
    ) from error

from s4a.extensions import extensions
from s4a.widgets.comparison import Comparison as Comparison
from s4a.widgets.correspondence import Correspondence as Correspondence
from s4a.widgets.explore import Explore as Explore
from s4a.widgets.functional import FunctionalMap as FunctionalMap
from s4a.widgets.maps import Maps as Maps
from s4a.widgets.median import Median as Median
from s4a.widgets.modes import Modes as Modes
from s4a.widgets.network import Network as Network
from s4a.widgets.panel import Panel as Panel
from s4a.widgets.progress import Progress as Progress
from s4a.widgets.spectrum import Spectrum as Spectrum
from s4a.widgets.transfer import Transfer as Transfer


def __getattr__(name: str) -> Any:
    """Return a panel that an extension registers."""
    try:
        return extensions("s4a.panels")[name]
    except KeyError:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
