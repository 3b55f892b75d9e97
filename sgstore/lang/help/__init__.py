"""Help for users of the query language: reasons for failed matches, notes, words to complete a text."""

from sgstore.lang.help._completion import words
from sgstore.lang.help._notes import (
    Compared,
    absent_part,
    compared_in_check,
    compared_in_query,
    nearest_query,
    notes_on,
    unknown_in_or,
)
from sgstore.lang.help._pattern_parts import PatternPart, has_nodes, parts_of, separable
from sgstore.lang.help._pattern_text import in_words, pattern_text
from sgstore.lang.help._why_not import (
    ConditionValues,
    WhyNot,
    WhyNotSteps,
    condition_values,
    events_in,
    looked_up,
    why_not,
)

__all__ = [
    "Compared",
    "ConditionValues",
    "PatternPart",
    "WhyNot",
    "WhyNotSteps",
    "absent_part",
    "compared_in_check",
    "compared_in_query",
    "condition_values",
    "events_in",
    "has_nodes",
    "in_words",
    "looked_up",
    "nearest_query",
    "notes_on",
    "parts_of",
    "pattern_text",
    "separable",
    "unknown_in_or",
    "why_not",
    "words",
]
