"""SQL compiler: rewrites bound queries, plans them, and writes the statements of each phase."""

from sgstore.lang.sql._compile import (
    Compiled,
    Layout,
    compile_checks,
    compile_query,
    for_people,
    unnumbered_text,
    value_text,
)
from sgstore.lang.sql._formulas import (
    Select,
    happened_in_frame,
    leaves,
    nested,
    recorded_events,
    told_events,
)
from sgstore.lang.sql._frame_relations import (
    BUCKETS,
    CLOCK,
    CLOCK_OF_TRACES,
    TIMES,
    TOLD_WEATHER,
    TRACES,
    ExternalRelation,
    entities,
    relation,
    traces_with,
    with_places,
)
from sgstore.lang.sql._lookups import told_lanes
from sgstore.lang.sql._plan import TRACE_OF_FRAME, Gathered, Window, extents, traces_of
from sgstore.lang.sql._results import CONSTANTS, SqlStatement, about_frame
from sgstore.lang.sql._rewrite import path_ways, rewritten
from sgstore.lang.sql._union import UnionParts, each_match, joined_rows, union_parts

__all__ = [
    "BUCKETS",
    "CLOCK",
    "CLOCK_OF_TRACES",
    "CONSTANTS",
    "TIMES",
    "TOLD_WEATHER",
    "TRACES",
    "TRACE_OF_FRAME",
    "Compiled",
    "ExternalRelation",
    "Gathered",
    "Layout",
    "Select",
    "SqlStatement",
    "UnionParts",
    "Window",
    "about_frame",
    "compile_checks",
    "compile_query",
    "each_match",
    "entities",
    "extents",
    "for_people",
    "happened_in_frame",
    "joined_rows",
    "leaves",
    "nested",
    "path_ways",
    "recorded_events",
    "relation",
    "rewritten",
    "told_events",
    "told_lanes",
    "traces_of",
    "traces_with",
    "union_parts",
    "unnumbered_text",
    "value_text",
    "with_places",
]
