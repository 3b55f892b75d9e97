"""The library: predicates, concepts, scenarios and properties that have names."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
