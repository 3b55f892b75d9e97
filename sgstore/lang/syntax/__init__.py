"""From text to syntax trees: the grammar, the parser, and hints for mistakes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
