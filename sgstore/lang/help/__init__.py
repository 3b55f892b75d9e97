"""Help for people: why a frame does not match, notes on a query, words for completion."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
