"""The families of relations: each a file, a pure array function over many frames, and a line here.

Being listed in :data:`RELATIONS` enrols a family in the generator and in the law tests: no self edge,
symmetric relations symmetric, the same when the world is moved and turned, the same frame by frame.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
