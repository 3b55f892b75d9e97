"""SQL generator of the query compiler.

It has two phases: candidate frames as bit masks, then values of single frames.
"""

from sgstore.lang.sql._compile import Compiled, compile_checks, compile_query
from sgstore.lang.sql._display import for_people
from sgstore.lang.sql._explain import unnumbered_text, value_text
from sgstore.lang.sql._expressions import leaves
from sgstore.lang.sql._frame_relations import (
    BUCKETS,
    CLOCK,
    CLOCK_OF_TRACES,
    TIMES,
    TOLD_WEATHER,
    TRACES,
    entities,
    relation,
    traces_with,
)
from sgstore.lang.sql._known_matches import ExternalRelation, with_places
from sgstore.lang.sql._lookups import told_lanes
from sgstore.lang.sql._plan import Gathered, traces_of
from sgstore.lang.sql._recorded_events import happened_in_frame, recorded_events, told_events
from sgstore.lang.sql._results import CONSTANTS, SqlStatement, about_frame, named_traces
from sgstore.lang.sql._rewrite import path_ways, rewritten
from sgstore.lang.sql._select import Select, nested
from sgstore.lang.sql._subgraphs import Layout
from sgstore.lang.sql._union import UnionParts, each_match, joined_rows, union_parts
from sgstore.lang.sql._windows import TRACE_OF_FRAME, Window, extents

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
    "named_traces",
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
