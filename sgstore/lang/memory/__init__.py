"""Search of query patterns in one scene graph in memory, without a database."""

from sgstore.lang.memory._column_evaluation import Columns, column_evaluator
from sgstore.lang.memory._evaluate import Binding
from sgstore.lang.memory._frame_view import FrameView, NodePair
from sgstore.lang.memory._search import ScopeSearch, expression
from sgstore.lang.memory._stage_search import StageSearch

__all__ = [
    "Binding",
    "Columns",
    "FrameView",
    "NodePair",
    "ScopeSearch",
    "StageSearch",
    "column_evaluator",
    "expression",
]
