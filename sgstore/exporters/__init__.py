"""Exporters of clips and their graphs: one file per format, listed in :data:`EXPORTERS`.

Each export is first written to a temporary folder, then moved completely or not at all, with a
manifest. A format is a function from an :class:`Export` and a folder to the written files. Other
packages add formats with an entry point of the group ``sgstore.exporters``: the name of the format,
and an :class:`Exporter`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
