"""Relations of scene graphs: each is one object, computed by a pure array function over many frames.

A relation stands in one file of this package and in one line of :mod:`sgstore.plugins`, or in a file of another
package and in one entry point. Being listed enrols it in the vocabulary, in the generator, in the table of
``docs/relations.md``, in pictures, and in the law tests: no self edge, symmetric relations symmetric, the same
when the world is moved and turned, the same frame by frame.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
