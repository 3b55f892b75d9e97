"""The library: predicates, concepts, scenarios and properties that have names."""

from sgstore.lang.library._entries import (
    NamedPattern,
    entries,
    pattern_named,
    patterns,
    predicates,
    search,
)

__all__ = [
    "NamedPattern",
    "entries",
    "pattern_named",
    "patterns",
    "predicates",
    "search",
]
