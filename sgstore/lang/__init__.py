"""The query language: text and a catalog in, SQL out; no database inside.

The stages are parse (:mod:`~sgstore.lang.parser`), bind (:mod:`~sgstore.lang.binder`), rewrite
(:mod:`~sgstore.lang.rewrite`) and emit (:mod:`~sgstore.lang.results`), each a pure function whose result can be
printed.
"""

from sgstore.lang.catalog import Catalog, TraceFacts
from sgstore.lang.compiler import Compiled, compile_query
from sgstore.lang.standard import NamedPattern, pattern_named, patterns

__all__ = [
    "Catalog",
    "Compiled",
    "NamedPattern",
    "TraceFacts",
    "compile_query",
    "pattern_named",
    "patterns",
]
