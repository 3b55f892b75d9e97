# The interface of this package: what others may import from it.

from ._compile import Compiled as Compiled
from ._compile import Layout as Layout
from ._compile import compile_checks as compile_checks
from ._compile import compile_query as compile_query
from ._compile import for_people as for_people
from ._compile import unnumbered_text as unnumbered_text
from ._compile import value_text as value_text
from ._formulas import Select as Select
from ._formulas import happened_in_frame as happened_in_frame
from ._formulas import leaves as leaves
from ._formulas import nested as nested
from ._formulas import recorded_events as recorded_events
from ._formulas import told_events as told_events
from ._frame_relations import BUCKETS as BUCKETS
from ._frame_relations import CLOCK as CLOCK
from ._frame_relations import CLOCK_OF_TRACES as CLOCK_OF_TRACES
from ._frame_relations import ExternalRelation as ExternalRelation
from ._frame_relations import TIMES as TIMES
from ._frame_relations import TOLD_WEATHER as TOLD_WEATHER
from ._frame_relations import TRACES as TRACES
from ._frame_relations import entities as entities
from ._frame_relations import relation as relation
from ._frame_relations import traces_with as traces_with
from ._frame_relations import with_places as with_places
from ._lookups import told_lanes as told_lanes
from ._plan import Gathered as Gathered
from ._plan import TRACE_OF_FRAME as TRACE_OF_FRAME
from ._plan import Window as Window
from ._plan import extents as extents
from ._plan import traces_of as traces_of
from ._results import CONSTANTS as CONSTANTS
from ._results import SqlStatement as SqlStatement
from ._results import about_frame as about_frame
from ._rewrite import path_ways as path_ways
from ._rewrite import rewritten as rewritten
from ._union import UnionParts as UnionParts
from ._union import each_match as each_match
from ._union import joined_rows as joined_rows
from ._union import union_parts as union_parts

__all__ = [
    "BUCKETS",
    "CLOCK",
    "CLOCK_OF_TRACES",
    "CONSTANTS",
    "Compiled",
    "ExternalRelation",
    "Gathered",
    "Layout",
    "Select",
    "SqlStatement",
    "TIMES",
    "TOLD_WEATHER",
    "TRACES",
    "TRACE_OF_FRAME",
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
