"""The method: one module per step of sections 3, 4 and 6.1 of the paper."""

from pkgutil import iter_modules

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(__name__, [m.name for m in iter_modules(__path__)])
