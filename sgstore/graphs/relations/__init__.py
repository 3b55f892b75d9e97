"""Relations of scene graphs: one object each, computed by a pure array function over many frames.

A relation has one file in this package and one line in :mod:`sgstore.base.plugins`, or one file in
another package and one entry point. The registration adds it to the vocabulary, the generator, the
table of ``docs/relations.md``, pictures, and the law tests: no self edges; symmetric relations are
symmetric; the result does not change when the world is moved or turned, or frame by frame.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
