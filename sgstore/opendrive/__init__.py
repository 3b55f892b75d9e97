"""Text of a road map → RoadMap: OpenDRIVE, and the plain lanes of recordings that carry none.

``document`` reads the text into tables · ``lanes`` evaluates reference lines and stacks lanes on them ·
``network`` finds where traffic flows on, and makes nodes and relations; ``objects`` and ``signals`` theirs.
A road with a defect is left out and named in the map's warnings: the text is then read once more
without it, so that no later step has to know. Of a width, a border, a height or a lane offset that is no
number only that record is left out. Only a map without any usable road is an error.

OpenDRIVE 1.4 to 1.8 (ASAM) are read alike. Superelevation, crossfall and the height of kerbs are not: a lane
lies at the elevation of its reference line, which is what storeys are told apart by.

A map that was read is kept by its content, so that the traces of a store, or pictures one after another, read
it once a process, with the indices that it made. It is not kept on disk: a town is read in a tenth of a second,
less than starting takes, and what is read from a file has to be checked again.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
