# The face of this package: what others may import from it.

from ._text import ENDING as ENDING
from ._text import Lock as Lock
from ._text import LockedCase as LockedCase
from ._text import LockedTrace as LockedTrace
from ._text import made_with as made_with
from ._text import read_lock as read_lock
from ._cases import CasePart as CasePart
from ._cases import cases_of as cases_of
from ._cases import frames_of_lock as frames_of_lock
from ._cases import lock_of as lock_of
from ._cases import store_beside as store_beside
from ._sets import intersect as intersect
from ._sets import meets as meets
from ._sets import minus as minus
from ._sets import union as union
from ._verify import Difference as Difference
from ._verify import verify as verify
from ._verify import verify_case as verify_case

__all__ = [
    "CasePart",
    "Difference",
    "ENDING",
    "Lock",
    "LockedCase",
    "LockedTrace",
    "cases_of",
    "frames_of_lock",
    "intersect",
    "lock_of",
    "made_with",
    "meets",
    "minus",
    "read_lock",
    "store_beside",
    "union",
    "verify",
    "verify_case",
]
