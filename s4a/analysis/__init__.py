"""Analysis of a registered collection (6): statistics, shape model, transfer."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, [m.name for m in iter_modules(__path__)]
)
