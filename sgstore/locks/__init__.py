"""Locks: test sets as text that says what was in every case, so that another can have the very same.

``lock`` is the text and what it says · ``contents`` takes the digests of cases from a store and its
recordings · ``verify`` looks whether a store has them still · ``found`` finds the frames of a lock in a
store · ``algebra`` unites, intersects and subtracts.
"""

from sgstore.locks.algebra import intersect, minus, union
from sgstore.locks.contents import lock_of
from sgstore.locks.found import cases_of, frames_of_lock, store_beside
from sgstore.locks.lock import Lock, LockedCase, LockedTrace, read_lock
from sgstore.locks.verify import Difference, verify

__all__ = [
    "Difference",
    "Lock",
    "LockedCase",
    "LockedTrace",
    "cases_of",
    "frames_of_lock",
    "intersect",
    "lock_of",
    "minus",
    "read_lock",
    "store_beside",
    "union",
    "verify",
]
