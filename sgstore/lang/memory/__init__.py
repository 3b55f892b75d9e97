"""Search for query patterns in one scene graph in memory, without a database."""

from sgstore.lang.memory._evaluate import Binding, Columns, column_evaluator
from sgstore.lang.memory._frame_view import FrameView, NodePair
from sgstore.lang.memory._search import ScopeSearch, StageSearch, expression

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
