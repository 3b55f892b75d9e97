"""Clips of recordings and their graphs → files: one file for each format, listed in :data:`EXPORTERS`.

Each export is written aside first, then all of it is there or nothing, with a manifest. A format is a function
from an :class:`Export` and a folder to what it wrote there; other packages add theirs as entry points of the
group ``sgstore.exporters``: the name of the format, and an :class:`Exporter`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
