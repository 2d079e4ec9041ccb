"""Compiled packages that a kernel in the browser lacks, imported only here.

``from s4a.geometry.compiled import igl`` gives the package or, if it cannot be imported, a falsy
:class:`Missing` that raises ImportError with a remedy on use.  Small steps have an alternative in
NumPy (``if igl: ...``); both give the same results up to ties and rounding.
"""

from importlib import import_module
from typing import Any

# name of the module -> name to install, modules to import
PACKAGES = {
    "fpsample": ("fpsample", ("fpsample",)),
    "igl": ("libigl", ("igl", "igl.predicates")),
    "psutil": ("psutil", ("psutil",)),
    "robust_laplacian": ("robust_laplacian", ("robust_laplacian",)),
}


class Missing:
    """Placeholder for a package that cannot be imported.

    Parameters
    ----------
    name : str
        Name by which pip installs it.
    error : ImportError

    Examples
    --------
    >>> from s4a.geometry.compiled import Missing
    >>> igl = Missing("libigl", ImportError("No module named 'igl'"))
    >>> bool(igl)
    False
    >>> igl.fast_winding_number
    Traceback (most recent call last):
    ...
    ImportError: fast_winding_number needs the package libigl, which cannot be imported here
    (No module named 'igl'): run this step where `pip install libigl` works, keep the study, and
    open it here with s4a.open_study
    """

    def __init__(self, name: str, error: ImportError):
        self._name, self._error = name, error

    def __bool__(self) -> bool:
        return False

    def __getattr__(self, asked: str) -> Any:
        if asked.startswith("__"):  # requested by copy, pickle and inspect
            raise AttributeError(asked)
        raise ImportError(
            f"{asked} needs the package {self._name}, which cannot be imported here "
            f"({self._error}): run this step where `pip install {self._name}` works, keep the "
            "study, and open it here with s4a.open_study"
        ) from self._error


def __getattr__(name: str) -> Any:
    """Import a package on first use."""
    if name not in PACKAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    install, modules = PACKAGES[name]
    try:
        package, *_ = map(import_module, modules)
    except ImportError as error:
        package = Missing(install, error)  # type: ignore[assignment]
    globals()[name] = package
    return package
