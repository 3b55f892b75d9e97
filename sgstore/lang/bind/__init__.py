"""From syntax trees to the bound query: names, types, units, and what a trace must know."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
