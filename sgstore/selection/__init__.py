"""Selection: which frames, clips or traces of a store to keep, and how good the choice is.

``units`` says what is chosen or not and what it holds · ``choose`` chooses · ``cover`` and ``bounds`` find
few sets that hold everything, and how few there must be · ``curve`` shows what is kept by how many, beside
random order · ``splits`` makes parts that share no recording · ``locking`` makes a lock of it.
"""

from sgstore.locks import cases_of
from sgstore.selection.choose import Selection, Way, Wish, select
from sgstore.selection.cover import Cover, Fitted, minimal, within
from sgstore.selection.curve import Curve, curve
from sgstore.selection.family import Family
from sgstore.selection.locking import locked_selection
from sgstore.selection.splits import parse_split, split, split_table
from sgstore.selection.units import Budget, Measure, Piece, Units, units_of

__all__ = [
    "Budget",
    "Cover",
    "Curve",
    "Family",
    "Fitted",
    "Measure",
    "Piece",
    "Selection",
    "Units",
    "Way",
    "Wish",
    "cases_of",
    "curve",
    "locked_selection",
    "minimal",
    "parse_split",
    "select",
    "split",
    "split_table",
    "units_of",
    "within",
]
