"""Abstractions reduce scene graphs to labelled graphs from the literature, with a class for each graph.

An abstraction is a function from columns (:class:`GraphColumns`) to columns (:class:`Labelled`).
:data:`ABSTRACTIONS` lists the built-in ones. Users add their own with :func:`register`, or as an
entry point of the group ``sgstore.abstractions``. ``_classes`` defines classes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
