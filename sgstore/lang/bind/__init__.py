"""Binder of the query language: resolves the names and types of a parsed query.

It also finds the values that a trace must know.
"""

from sgstore.lang.bind._aggregates import PLACE, sql_of
from sgstore.lang.bind._checks import CheckInCatalog, bind_checks
from sgstore.lang.bind._datasets import CLASSES_GIVEN, traces_in
from sgstore.lang.bind._functions import FUNCTIONS
from sgstore.lang.bind._horizon import Horizon, horizon, spoken_kinds
from sgstore.lang.bind._kinds import (
    Profile,
    alias_of,
    edge_conditions,
    entities_of_pairs,
    homes_of,
    kind_conditions,
)
from sgstore.lang.bind._needed_values import MOTION, Need, not_computed, of_check, of_query
from sgstore.lang.bind._queries import bind_query
from sgstore.lang.bind._temporal import FUTURE
from sgstore.lang.bind._text_tests import regex
from sgstore.lang.bind._unknowns import (
    CONNECTIVES,
    certain,
    has_pairs,
    negated,
    pushed,
    spelled_out,
    undecided,
    unknown,
    without_guesses,
)
from sgstore.lang.bind._world_scope import is_limited, within

__all__ = [
    "CLASSES_GIVEN",
    "CONNECTIVES",
    "FUNCTIONS",
    "FUTURE",
    "MOTION",
    "PLACE",
    "CheckInCatalog",
    "Horizon",
    "Need",
    "Profile",
    "alias_of",
    "bind_checks",
    "bind_query",
    "certain",
    "edge_conditions",
    "entities_of_pairs",
    "has_pairs",
    "homes_of",
    "horizon",
    "is_limited",
    "kind_conditions",
    "negated",
    "not_computed",
    "of_check",
    "of_query",
    "pushed",
    "regex",
    "spelled_out",
    "spoken_kinds",
    "sql_of",
    "traces_in",
    "undecided",
    "unknown",
    "within",
    "without_guesses",
]
