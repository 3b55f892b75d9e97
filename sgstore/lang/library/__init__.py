"""Library of ready-made patterns in the query language: predicates, concepts, scenarios and properties."""

from sgstore.lang.library._entries import NamedPattern, entries, patterns, predicates
from sgstore.lang.library._search import pattern_named, search
from sgstore.lang.library._statements import require_sql, statement

__all__ = [
    "NamedPattern",
    "entries",
    "pattern_named",
    "patterns",
    "predicates",
    "require_sql",
    "search",
    "statement",
]
