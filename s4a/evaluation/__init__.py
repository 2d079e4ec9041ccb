"""How good a correspondence is, and how the methods of the paper compare (5)."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, [m.name for m in iter_modules(__path__)]
)
