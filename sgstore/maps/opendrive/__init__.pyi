# The face of this package: what others may import from it.

from ._objects import kind_of_object as kind_of_object
from ._read import SIGNS as SIGNS
from ._read import parse_map as parse_map
from ._read import read_map as read_map
from ._signals import kind_of_signal as kind_of_signal

__all__ = ["SIGNS", "kind_of_object", "kind_of_signal", "parse_map", "read_map"]
