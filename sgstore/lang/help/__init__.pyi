# The interface of this package: what others may import from it.

from ._completion import words as words
from ._notes import Compared as Compared
from ._notes import compared_in_check as compared_in_check
from ._notes import compared_in_query as compared_in_query
from ._notes import notes_on as notes_on
from ._pattern_parts import PatternPart as PatternPart
from ._pattern_parts import has_nodes as has_nodes
from ._pattern_parts import parts_of as parts_of
from ._why_not import WhyNot as WhyNot
from ._why_not import WhyNotSteps as WhyNotSteps
from ._why_not import events_in as events_in
from ._why_not import looked_up as looked_up
from ._why_not import why_not as why_not

__all__ = [
    "Compared",
    "PatternPart",
    "WhyNot",
    "WhyNotSteps",
    "compared_in_check",
    "compared_in_query",
    "events_in",
    "has_nodes",
    "looked_up",
    "notes_on",
    "parts_of",
    "why_not",
    "words",
]
