"""Reader of road map texts: OpenDRIVE, and the lane text format of sgstore for other maps.

``document`` reads the text into tables. ``lanes`` evaluates reference lines and stacks lanes on
them. ``network`` finds the traffic flow and makes nodes and relations; ``objects`` and ``signals``
make theirs. A road with a defect is left out and named in the map's warnings: the text is then read
again without it, so that later steps need no check. For an invalid number in a width, border,
height or lane offset, only that record is left out. Only a map without any usable road is an error.

OpenDRIVE 1.4 to 1.8 (ASAM) are read in the same way. Superelevation, crossfall and kerb heights are
ignored: a lane has the elevation of its reference line, which is enough to distinguish storeys.

Maps are cached by content, so that each process reads a map once for all traces of a store or for
several pictures. There is no cache on disk: a town is read in a tenth of a second, and a cached
file would need the same checks.
"""

from sgstore.maps.opendrive._objects import kind_of_object
from sgstore.maps.opendrive._read import SIGNS, parse_map, read_map
from sgstore.maps.opendrive._signals import kind_of_signal

__all__ = [
    "SIGNS",
    "kind_of_object",
    "kind_of_signal",
    "parse_map",
    "read_map",
]
