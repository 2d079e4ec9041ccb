"""Read, clean and check meshes, annotations and tables of subjects (5, the data)."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, [m.name for m in iter_modules(__path__)]
)
