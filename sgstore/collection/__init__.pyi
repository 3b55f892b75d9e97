# The face of this package: what others may import from it.

from ._frames import CollectionFrames as CollectionFrames
from ._landing import commit as commit
from ._landing import land as land
from ._open import open as open
from ._pack import CollectionFaults as CollectionFaults
from ._pack import Commit as Commit
from ._pack import Garbage as Garbage
from ._pack import gc as gc
from ._pack import pack as pack
from ._pack import unpack as unpack
from ._pack import verify as verify
from ._place import ABOUT as ABOUT
from ._questions import Collection as Collection
from ._remake import rebuild as rebuild
from ._questions import PartedChecks as PartedChecks
from ._questions import PartedMatches as PartedMatches
from ._questions import PartedRows as PartedRows
from ._questions import PartedUnion as PartedUnion
from ._questions import PartialAnswerError as PartialAnswerError

__all__ = [
    "ABOUT",
    "Collection",
    "CollectionFaults",
    "CollectionFrames",
    "Commit",
    "Garbage",
    "PartedChecks",
    "PartedMatches",
    "PartedRows",
    "PartedUnion",
    "PartialAnswerError",
    "commit",
    "gc",
    "land",
    "open",
    "pack",
    "rebuild",
    "unpack",
    "verify",
]
