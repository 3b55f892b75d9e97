# The interface of this package: what others may import from it.

from ._entries import NamedPattern as NamedPattern
from ._entries import entries as entries
from ._entries import pattern_named as pattern_named
from ._entries import patterns as patterns
from ._entries import predicates as predicates
from ._entries import search as search

__all__ = [
    "NamedPattern",
    "entries",
    "pattern_named",
    "patterns",
    "predicates",
    "search",
]
