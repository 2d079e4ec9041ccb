"""Compiled packages that a kernel in the browser lacks: each is imported here and nowhere else.

``from s4a.geometry.compiled import igl`` is the package, or where it cannot be imported a
:class:`Missing` one, which is false and says what to do when something is asked of it. Small steps
have a second way in NumPy (``if igl: ...``); the results of both agree up to ties and rounding.
"""

from importlib import import_module
from typing import Any

# name of the module -> the name to install, what is imported
PACKAGES = {
    "fpsample": ("fpsample", ("fpsample",)),
    "igl": ("libigl", ("igl", "igl.predicates")),
    "psutil": ("psutil", ("psutil",)),
    "robust_laplacian": ("robust_laplacian", ("robust_laplacian",)),
}


class Missing:
    """What stands for a package that cannot be imported.

    Parameters
    ----------
    name : str
        By which it is installed.
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
        if asked.startswith("__"):  # copy, pickle and inspect ask for those
            raise AttributeError(asked)
        raise ImportError(
            f"{asked} needs the package {self._name}, which cannot be imported here "
            f"({self._error}): run this step where `pip install {self._name}` works, keep the "
            "study, and open it here with s4a.open_study"
        ) from self._error


def __getattr__(name: str) -> Any:
    """A package, imported when it is first asked for."""
    if name not in PACKAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    install, modules = PACKAGES[name]
    try:
        package, *_ = map(import_module, modules)
    except ImportError as error:
        package = Missing(install, error)  # type: ignore[assignment]
    globals()[name] = package
    return package
