# The face of this package: what others may import from it.

from . import ir as ir
from . import syntax as syntax
from ._bind import CheckInCatalog as CheckInCatalog
from ._bind import bind_checks as bind_checks
from ._bind import bind_query as bind_query
from ._bind_temporal import FUTURE as FUTURE
from ._beyond import is_limited as is_limited
from ._beyond import within as within
from ._catalog import EDGE_ATTRIBUTES as EDGE_ATTRIBUTES
from ._catalog import ENV_ATTRIBUTES as ENV_ATTRIBUTES
from ._catalog import FRAME_ATTRIBUTES as FRAME_ATTRIBUTES
from ._catalog import NODE_ATTRIBUTES as NODE_ATTRIBUTES
from ._catalog import TRACE_ATTRIBUTES as TRACE_ATTRIBUTES
from ._catalog import Attribute as Attribute
from ._catalog import Catalog as Catalog
from ._catalog import RelationScope as RelationScope
from ._catalog import TableFacts as TableFacts
from ._catalog import TraceFacts as TraceFacts
from ._catalog import Triple as Triple
from ._catalog import attributes_of as attributes_of
from ._catalog import Type as Type
from ._catalog import excluded_kinds as excluded_kinds
from ._catalog import own_type as own_type
from ._notes import Compared as Compared
from ._notes import compared_in_check as compared_in_check
from ._notes import compared_in_query as compared_in_query
from ._notes import notes_on as notes_on
from ._compile import Compiled as Compiled
from ._compile import Layout as Layout
from ._compile import compile_checks as compile_checks
from ._compile import compile_query as compile_query
from ._compile import unnumbered_text as unnumbered_text
from ._compile import value_text as value_text
from ._evaluate import Binding as Binding
from ._evaluate import Columns as Columns
from ._evaluate import Evaluate as Evaluate
from ._evaluate import FrameView as FrameView
from ._evaluate import column_evaluator as column_evaluator
from ._external import CLOCK as CLOCK
from ._external import BUCKETS as BUCKETS
from ._external import CLOCK_OF_TRACES as CLOCK_OF_TRACES
from ._external import TIMES as TIMES
from ._external import TOLD_WEATHER as TOLD_WEATHER
from ._external import TRACES as TRACES
from ._external import ExternalRelation as ExternalRelation
from ._external import entities as entities
from ._external import relation as relation
from ._external import traces_with as traces_with
from ._external import with_places as with_places
from ._compile import for_people as for_people
from ._formulas import recorded_events as recorded_events
from ._formulas import told_events as told_events
from ._sql_ways import told_lanes as told_lanes
from ._functions import FUNCTIONS as FUNCTIONS
from ._horizon import Horizon as Horizon
from ._horizon import horizon as horizon
from ._horizon import spoken_kinds as spoken_kinds
from ._needs import MOTION as MOTION
from ._needs import Need as Need
from ._needs import not_computed as not_computed
from ._needs import of_check as of_check
from ._needs import of_query as of_query
from ._operators import Column as Column
from ._operators import all_known as all_known
from ._parts import ClassQuestion as ClassQuestion
from ._parts import LOG_TIME_COLUMN as LOG_TIME_COLUMN
from ._parts import PARTS as PARTS
from ._parts import Parted as Parted
from ._parts import Pruning as Pruning
from ._parts import class_questions as class_questions
from ._parts import parted as parted
from ._parse import joined as joined
from ._completion import words as words
from ._parse import keywords as keywords
from ._parse import parse as parse
from ._truth_parts import DrawnEdge as DrawnEdge
from ._truth_parts import PatternPart as PatternPart
from ._truth_parts import has_nodes as has_nodes
from ._truth_parts import parts_of as parts_of
from ._patterns import Pattern as Pattern
from ._patterns import node_of_kind as node_of_kind
from ._patterns import pattern_of as pattern_of
from ._plan import TRACE_OF_BUCKET as TRACE_OF_BUCKET
from ._plan import Gathered as Gathered
from ._plan import Window as Window
from ._plan import extents as extents
from ._plan import traces_of as traces_of
from ._results import CONSTANTS as CONSTANTS
from ._results import SqlStatement as SqlStatement
from ._results import about_frame as about_frame
from ._rewrite import rewritten as rewritten
from ._search import ScopeSearch as ScopeSearch
from ._search import expression as expression
from ._stage_search import StageSearch as StageSearch
from ._table_function import PatternTable as PatternTable
from ._table_function import pattern_tables as pattern_tables
from ._union import UnionParts as UnionParts
from ._union import each_match as each_match
from ._union import joined_rows as joined_rows
from ._union import union_parts as union_parts
from ._why_not import WhyNot as WhyNot
from ._why_not import WhyNotSteps as WhyNotSteps
from ._why_not import events_in as events_in
from ._why_not import looked_up as looked_up
from ._why_not import why_not as why_not
from .library import NamedPattern as NamedPattern
from .library import pattern_named as pattern_named
from .library import patterns as patterns
from ._unknowns import CONNECTIVES as CONNECTIVES
from ._unknowns import certain as certain
from ._unknowns import has_pairs as has_pairs
from ._unknowns import negated as negated
from ._unknowns import pushed as pushed
from ._unknowns import spelled_out as spelled_out
from ._unknowns import undecided as undecided
from ._unknowns import unknown as unknown

__all__ = [
    "CONNECTIVES",
    "certain",
    "has_pairs",
    "negated",
    "pushed",
    "spelled_out",
    "undecided",
    "unknown",
    "Column",
    "Columns",
    "all_known",
    "attributes_of",
    "column_evaluator",
    "Attribute",
    "Binding",
    "CheckInCatalog",
    "CLASSES_GIVEN",
    "CLOCK",
    "BUCKETS",
    "CLOCK_OF_TRACES",
    "TIMES",
    "CONSTANTS",
    "Catalog",
    "ClassQuestion",
    "Compared",
    "Compiled",
    "DrawnEdge",
    "EDGE_ATTRIBUTES",
    "ENV_ATTRIBUTES",
    "Evaluate",
    "ExternalRelation",
    "FRAME_ATTRIBUTES",
    "FUNCTIONS",
    "FUTURE",
    "FrameView",
    "Gathered",
    "LOG_TIME_COLUMN",
    "Layout",
    "MOTION",
    "NODE_ATTRIBUTES",
    "NamedPattern",
    "Need",
    "PARTS",
    "Parted",
    "Pattern",
    "PatternPart",
    "PatternTable",
    "Pruning",
    "RelationScope",
    "ScopeSearch",
    "StageSearch",
    "SqlStatement",
    "TOLD_WEATHER",
    "TRACES",
    "TRACE_ATTRIBUTES",
    "TRACE_OF_BUCKET",
    "TableFacts",
    "TraceFacts",
    "Triple",
    "Type",
    "own_type",
    "UnionParts",
    "WhyNot",
    "WhyNotSteps",
    "Window",
    "about_frame",
    "bind_checks",
    "bind_query",
    "class_questions",
    "compared_in_check",
    "compared_in_query",
    "compile_checks",
    "compile_query",
    "each_match",
    "entities",
    "events_in",
    "excluded_kinds",
    "expression",
    "extents",
    "for_people",
    "ir",
    "is_limited",
    "joined",
    "keywords",
    "joined_rows",
    "looked_up",
    "recorded_events",
    "told_events",
    "told_lanes",
    "node_of_kind",
    "notes_on",
    "not_computed",
    "of_check",
    "of_query",
    "parse",
    "parted",
    "parts_of",
    "has_nodes",
    "pattern_named",
    "pattern_of",
    "pattern_tables",
    "patterns",
    "relation",
    "rewritten",
    "spoken_kinds",
    "syntax",
    "traces_of",
    "traces_with",
    "union_parts",
    "unnumbered_text",
    "value_text",
    "why_not",
    "words",
    "with_places",
    "within",
]
from ._symbols import CLASSES_GIVEN as CLASSES_GIVEN
from ._symbols import regex as regex
