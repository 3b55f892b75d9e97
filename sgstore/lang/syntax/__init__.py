"""Parser of the query language: grammar, syntax trees, and hints for mistakes."""

from sgstore.lang.syntax._example_patterns import node_of_kind, pattern_of
from sgstore.lang.syntax._hints import (
    comparison_hint,
    condition_hint,
    hint_at,
    said_of,
    variable_hint,
)
from sgstore.lang.syntax._parse import joined, parse
from sgstore.lang.syntax._pattern_builder import Pattern
from sgstore.lang.syntax._table_function import TOPIC, pattern_tables, topic_tables, topics_in_sql
from sgstore.lang.syntax._tables import keywords

__all__ = [
    "TOPIC",
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
    "topic_tables",
    "topics_in_sql",
    "variable_hint",
]
