"""Lock: text file with the cases of a test set and the digests of their content.

``_text`` reads and writes the text. ``_cases`` makes cases of a store or collection, and finds them
again. ``_sets`` has union, intersection and difference. ``_verify`` finds changes.
"""

from sgstore.testsets.locks._cases import CasePart, lock_of
from sgstore.testsets.locks._find import cases_of, frames_of_lock, store_beside
from sgstore.testsets.locks._sets import intersect, meets, minus, union
from sgstore.testsets.locks._text import ENDING, Lock, LockedCase, LockedTrace, made_with, read_lock
from sgstore.testsets.locks._verify import Difference, verify, verify_case

__all__ = [
    "ENDING",
    "CasePart",
    "Difference",
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
