"""Precision of comparisons: a number is rounded in the same way as the stored value.

The store keeps most attributes of nodes and edges in 32 bits, so a car whose width is 1.8 m has the width
1.7999999523162842. The compared number is rounded to 32 bits first. Times since the
start of a trace count whole microseconds, because clocks of simulators lose the last nanosecond.

Notes
-----
A constant is rounded once, here. Other values are rounded by an operator that each engine has.
Values of pairs of entities, positions and sums are computed in 64 bits and compared as they are.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.catalog import DisplayUnit, Home, Type
from sgstore.lang.operators import ROUNDINGS

if TYPE_CHECKING:
    from sgstore.lang.catalog import Attribute


class Precision(Enum):
    """Rounding of a number before it is compared. Each value is the name of the rounding operator."""

    float32 = "float32"
    microseconds = "microseconds"


_STORED: Final = frozenset({DisplayUnit.plain, DisplayUnit.velocity})
_CONVERTED: Final = frozenset({DisplayUnit.degrees, DisplayUnit.along})
"""Units of numbers that are computed from 32-bit columns of one row."""

_SAME: Final = frozenset({"abs", "negative", "min", "max", "coalesce", "case"})
"""Operators that return one of their operands, possibly with the opposite sign."""

_CHOSEN: Final = frozenset({"min", "max", "first", "last", "median", "percentile", "avg"})
"""Functions whose result lies between the smallest and the largest of their arguments."""

_OVER_TIME: Final = frozenset({"prev", "min_over", "max_over", "avg_over"})


def precision_of(value: b.Bound) -> Precision | None:
    """Return the precision with which the store saves the value of an expression.

    ``None`` means computed in 64 bits.
    """
    if value.type is not Type.number:
        return None
    match value:
        case b.NodeAttribute(attribute=attribute) | b.EdgeAttribute(attribute=attribute):
            stored = attribute.unit in _STORED | _CONVERTED and Home.state in attribute.columns
            return Precision.float32 if stored else None
        case b.FrameAttribute(attribute=attribute) | b.TraceAttribute(attribute=attribute):
            return _of_whole(attribute)
        case b.StepTime():
            return Precision.microseconds
        case b.Operation(word=word, operands=operands) if word in _SAME:
            return _common(operands[1::2] + operands[-1:] if word == "case" else operands)
        case _:
            return _of_many(value)


def _of_whole(attribute: Attribute) -> Precision | None:
    """Return the precision with which the store saves an attribute; None for 64 bits."""
    if attribute.precision:
        return Precision(attribute.precision)
    timed = attribute.unit in {DisplayUnit.seconds, DisplayUnit.span}
    return Precision.microseconds if timed else None


def _of_many(value: b.Bound) -> Precision | None:
    """If an expression selects one of several values, return their stored precision; None for 64 bits."""
    match value:
        case b.OverMatch(word="argmin" | "argmax", at=at) if at is not None:
            return precision_of(at)
        case b.OverMatch(word=word, operand=operand) if word in _CHOSEN:
            return precision_of(operand)
        case b.Aggregate(word=word, operand=operand) if word in _CHOSEN and operand is not None:
            return precision_of(operand)
        case b.BlockValue(word=word, value=inner) if word.lower() in _CHOSEN and inner is not None:
            return precision_of(inner)
        case b.SignalCall(word=word, operand=operand) if word in _OVER_TIME:
            return precision_of(operand)
        case _:
            return None


def _common(operands: tuple[b.Bound, ...]) -> Precision | None:
    """Return the precision of all operands except constants; None if it differs."""
    found = {precision_of(one) for one in operands if not isinstance(one, b.Value)}
    return found.pop() if len(found) == 1 else None


def is_stored(value: b.Bound) -> bool:
    """True if a value is a 32-bit number of the store, or one of several such numbers."""
    return precision_of(value) is Precision.float32 and not any(
        _is_computed(part) for part in b.walk(value)
    )


def _is_computed(part: b.Bound) -> bool:
    match part:
        case b.NodeAttribute(attribute=attribute) | b.EdgeAttribute(attribute=attribute):
            return attribute.unit in _CONVERTED
        case b.OverMatch(word=word) | b.Aggregate(word=word) | b.SignalCall(word=word):
            return word in {"avg", "avg_over"}
        case b.BlockValue(word=word, value=inner):
            return word == "AVG" or (inner is not None and not is_stored(inner))
        case b.FrameAttribute(attribute=attribute):
            return not attribute.stored
        case _:
            return False


def compared(*sides: b.Bound) -> tuple[b.Bound, ...]:
    """Return both sides of a comparison, rounded to the lower precision of the two."""
    known = {precision_of(side) for side in sides} - {None}
    for precision in Precision:
        if precision in known:
            return tuple(_rounded(side, precision) for side in sides)
    return sides


def chosen(value: b.Bound, choices: b.Choices) -> tuple[b.Bound, b.Choices]:
    """Return a value and the constants of its ``IN`` list, all rounded to the lowest precision among them."""
    operand, *items = compared(value, *choices.items)
    return operand, b.Choices(tuple(item for item in items if isinstance(item, b.Value)))


def _rounded(value: b.Bound, precision: Precision) -> b.Bound:
    if value.type is not Type.number or _is_exact(value, precision):
        return value
    if isinstance(value, b.Value) and isinstance(value.value, int | float):
        rounded = ROUNDINGS[precision.value](value.value)
        if rounded is None or rounded == value.value:
            return value
        return replace(value, value=rounded, written=value.shown)
    return b.Operation(precision.value, (value,), Type.number)


def _is_exact(value: b.Bound, precision: Precision) -> bool:
    """True if a stored value has the given precision already and needs no rounding."""
    if precision_of(value) is not precision:
        return False
    if isinstance(value, b.Operation) and value.word in {"abs", "negative"}:
        return _is_exact(value.operands[0], precision)
    if isinstance(value, b.NodeAttribute | b.EdgeAttribute):
        unit, columns = value.attribute.unit, value.attribute.columns
        return unit is DisplayUnit.velocity or (unit in _STORED and Home.map not in columns)
    timed = isinstance(value, b.FrameAttribute | b.TraceAttribute | b.StepTime)
    return timed and not b.is_passed_on(value)
