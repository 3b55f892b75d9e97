# The interface of this package: what others may import from it.

from ._hints import comparison_hint as comparison_hint
from ._hints import condition_hint as condition_hint
from ._hints import hint_at as hint_at
from ._hints import said_of as said_of
from ._hints import variable_hint as variable_hint
from ._parse import joined as joined
from ._parse import keywords as keywords
from ._parse import parse as parse
from ._table_function import pattern_tables as pattern_tables
from ._written_patterns import Pattern as Pattern
from ._written_patterns import node_of_kind as node_of_kind
from ._written_patterns import pattern_of as pattern_of

__all__ = [
    "Pattern",
    "comparison_hint",
    "condition_hint",
    "hint_at",
    "joined",
    "keywords",
    "node_of_kind",
    "parse",
    "pattern_of",
    "pattern_tables",
    "said_of",
    "variable_hint",
]
