"""Abstractions: scene graphs reduced to labels, as the literature has them, and a class for each.

An abstraction is a function from columns (:class:`Seen`) to columns (:class:`Labelled`). Those that are shipped
are listed in :data:`ABSTRACTIONS`; a client's own are registered with :func:`register`, or as an entry point of
the group ``sgstore.abstractions``. ``classes`` says what a class is.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
