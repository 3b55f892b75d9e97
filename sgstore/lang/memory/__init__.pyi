# The interface of this package: what others may import from it.

from ._evaluate import Binding as Binding
from ._evaluate import Columns as Columns
from ._evaluate import FrameView as FrameView
from ._evaluate import NodePair as NodePair
from ._evaluate import column_evaluator as column_evaluator
from ._search import ScopeSearch as ScopeSearch
from ._search import expression as expression
from ._stage_search import StageSearch as StageSearch

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
