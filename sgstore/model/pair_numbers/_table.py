"""Table of all measures of object pairs: name → declaration, with SQL expressions."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING, Final

import sgstore.model.pair_numbers._boxes as boxes
import sgstore.model.pair_numbers._contact as contact
import sgstore.model.pair_numbers._crossing as crossing
import sgstore.model.pair_numbers._encounter as encounter
import sgstore.model.pair_numbers._evading as evading
import sgstore.model.pair_numbers._following as following
import sgstore.model.pair_numbers._rss as rss
import sgstore.model.pair_numbers._ttc_mild as mild
from sgstore.model.pair_numbers._lane_numbers import WAYS
from sgstore.model.pair_numbers._levels import OPTIONAL

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.pair_numbers._pair_function import PairFunction

# New columns are appended.
_FAMILIES: Final = (boxes, encounter, following, crossing, rss, evading, mild, contact)

PAIR_FUNCTIONS: Final[Mapping[str, PairFunction]] = {
    name: one for family in _FAMILIES for name, one in family.NUMBERS.items()
}
"""Numbers of two entities by name, in the order of the views. A number is NULL if an input is unknown."""

EXPRESSIONS: Final[Mapping[str, str]] = {
    **{name: sql for family in _FAMILIES for name, sql in family.PARTS.items()},
    **{name: one.sql for name, one in PAIR_FUNCTIONS.items() if one.sql},
}
"""SQL expressions by name: the numbers, and the parts that they share."""

NAME: Final = re.compile(r"\b[a-z]\w*\b(?!\()")
"""Regular expression for the name of a part. Words of SQL are in capitals; functions have a bracket."""

MARKS: Final = frozenset({"level", "solid"})
"""Parts of almost all numbers that make them NULL for special pairs, such as an entity and its carrier."""
STOREYS: Final = "apart"
"""Part of ``level`` for storeys. The rest of ``level`` is for trailers and riders."""
Marks = frozenset[str]


@cache
def expression_of(name: str, without: Marks) -> str:
    """Return a measure's SQL expression. Leave out the tests for special pairs in ``without``."""
    text = EXPRESSIONS[name]
    for mark in without:
        text = text.replace(f" + {mark}", "").replace(f"{mark} > 0 OR ", "")
    return text


@cache
def parts_of(name: str, without: Marks = frozenset()) -> tuple[str, ...]:
    """Return the inputs of a measure's SQL expression, by name: columns and other measures."""
    return tuple(sorted({*NAME.findall(expression_of(name, without))}))


@cache
def stage_of(name: str, without: Marks = frozenset()) -> int:
    """Return how deep the SQL expression of a measure is nested; 0 for a column of an object."""
    if name not in EXPRESSIONS:
        return 0
    return 1 + max(stage_of(part, without) for part in parts_of(name, without))


@cache
def needed_for(name: str, without: Marks = frozenset()) -> frozenset[str]:
    """Return the names of a measure and of all its direct and indirect inputs; empty for a map look-up.

    Parameters
    ----------
    name : str
    without : frozenset of str
        Members of :data:`MARKS`, and :data:`STOREYS`, that no pair needs.
    """
    if name in WAYS:
        return frozenset()
    if name not in EXPRESSIONS:
        return frozenset({name})
    parts = parts_of(name, without)
    return frozenset({name}).union(*(needed_for(part, without) for part in parts))


def columns_needed(name: str) -> tuple[frozenset[str], frozenset[str]]:
    """Return the columns that a measure needs of object a and of object b, except heights."""
    raw = [part for part in needed_for(name, MARKS) if part not in EXPRESSIONS]
    raw = [part for part in raw if part[2:] not in {*OPTIONAL, "z"}]
    a, b = (frozenset(part[2:] for part in raw if part[0] == one) for one in "ab")
    return a, b
