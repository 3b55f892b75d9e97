"""Import of scene graphs of other tools into a store.

``_formats`` and ``_openlabel`` read the files, with limits for untrusted input. ``_resolve`` maps labels and
relations to the vocabulary. ``_run`` builds frames and stores them.

A file becomes a trace; each of its graphs becomes a frame, in file order. Nodes of two graphs are the same
entity if their name and kind are equal. Lanes, roads and other map parts keep the names of the file and have no
geometry. Functions of poses are therefore unknown in such frames. The view ``imports`` contains the file's name
of each frame.
"""

from sgstore.pipeline.importing._resolve import Words
from sgstore.pipeline.importing._run import FORMATS, Imported, import_graphs

__all__ = [
    "FORMATS",
    "Imported",
    "Words",
    "import_graphs",
]
