"""Binder of temporal operators, functions over time, and durations.

Temporal operators, functions over time and durations are allowed in conditions and results of a ``MATCH``,
and in a ``CHECK``. Inside braces, conditions are about one frame.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.bind._expressions import parameter
from sgstore.lang.catalog import Type
from sgstore.lang.operators import COMPARISONS
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.errors import TextSpan
    from sgstore.lang.bind._symbols import Session, SymbolTable


MAX_NS: Final = 10**18
"""Longest duration allowed in a query: about 30 years; ns."""

_UNBOUNDED: Final = frozenset({"NEXT", "WEAKNEXT", "PREVIOUS"})
_LENGTH: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(ms|s|min|frames)", re.IGNORECASE)


def tense(e: s.Temporal, names: SymbolTable) -> b.Tense:
    """Return a temporal operator such as ``EVENTUALLY``, with resolved operands and a checked bound.

    Raises
    ------
    QueryError
        It is inside braces, an operand is not a condition, or the bound is invalid.
    """
    _refuse_in_block(e.word, e.span, names)
    operands = tuple(names.condition(operand) for operand in e.operands)
    if e.bound is None:
        return b.Tense(e.word, operands)
    if e.word in _UNBOUNDED:
        names.session.refuse(f"{e.word} has no bound", e.span)
    low = length(e.bound[0], names)
    if e.bound[1] is None:
        return b.Tense(e.word, operands, low.amount, None, low.frames)
    high = length(e.bound[1], names)
    if low.frames != high.frames and low.amount:
        names.session.refuse("a bound must be in time or in frames, not both", e.bound[1].span)
    if high.amount < low.amount:
        names.session.refuse("the end of the bound is before its start", e.bound[1].span)
    return b.Tense(e.word, operands, low.amount, high.amount, high.frames)


def length(e: s.Duration | s.Parameter, names: SymbolTable) -> b.Length:
    """Resolve a duration. A parameter value is a number of seconds, or text such as ``2s``.

    Raises
    ------
    QueryError
        The value is not a duration, or is too long.
    """
    amount, unit = (e.amount, e.unit) if isinstance(e, s.Duration) else _given(e, names)
    if unit == "frames":
        if amount != int(amount):
            names.session.refuse("expected a whole number of frames", e.span)
        if amount >= s.LONGEST:
            names.session.refuse(s.TOO_LONG, e.span)
        return b.Length(int(amount), frames=True)
    ns = s.Duration(amount, unit, e.span).ns
    if not 0 <= ns <= MAX_NS:
        names.session.refuse(s.TOO_LONG, e.span)
    return b.Length(ns, frames=False)


def _given(e: s.Parameter, names: SymbolTable) -> tuple[float, str]:
    value = parameter(e, names)
    if isinstance(value, int | float) and not isinstance(value, bool) and value == value:  # noqa: PLR0124 - no NaN
        return float(max(-s.LONGEST, min(value, s.LONGEST))), "s"
    found = _LENGTH.fullmatch(value.strip()) if isinstance(value, str) else None
    if found is None:
        names.session.refuse(
            f"the parameter '{e.name}' is not a duration",
            e.span,
            "set it to a number of seconds, or a text such as '2s' or '10frames'",
        )
    return min(float(found[1]), s.LONGEST), found[2].lower()


def timespan(e: s.Duration, _: SymbolTable) -> b.Value:
    """Return a duration as a constant: a number of seconds, or of frames."""
    if e.unit == "frames":
        return b.Value(e.amount, Type.number, unit="frames", span=e.span)
    return b.Value(e.ns / 1e9, Type.number, unit="s", span=e.span)


def course(e: s.Call, names: SymbolTable) -> b.Bound:
    """Resolve a call of a function over time: ``prev(x)``, ``delta(x, 2s)``, ``run_length(p)``, ….

    Raises
    ------
    QueryError
        Invalid arguments, or a call inside braces.
    """
    word = normalize_name(e.name)
    _refuse_in_block(f"{e.name}()", e.name_span, names)
    wanted = 2 if word == "delta" or word in _WINDOWS else 1
    if len(e.arguments) != wanted:
        found = len(e.arguments)
        reason = f"{e.name}() takes {wanted} argument{'s' * (wanted > 1)}, found {found}"
        hint = f"add the length of the window: {e.name}(x, 2s)" if word in _WINDOWS else None
        names.session.refuse(reason, e.span, hint)
    return COURSES[word](e, names)


def _previous(e: s.Call, names: SymbolTable) -> b.SignalCall:
    value = names.bind(e.arguments[0])
    _refuse_nested(e, value, names)
    if value.type not in {Type.number, Type.text, Type.boolean, Type.open}:
        names.session.refuse(f"prev() takes a value, not a {value.type.value}", e.arguments[0].span)
    return b.SignalCall("prev", value, type=value.type)


def _delta(e: s.Call, names: SymbolTable) -> b.SignalCall:
    value = names.number(e.arguments[0])
    _refuse_nested(e, value, names)
    by = _how_far(e, names)
    return b.SignalCall("delta", value, by.amount, by.frames)


def _how_far(e: s.Call, names: SymbolTable) -> b.Length:
    """Check and return the duration argument of a call such as ``delta(x, 2s)``."""
    back = e.arguments[1]
    if not isinstance(back, s.Duration | s.Parameter):
        names.session.refuse("expected a duration such as 2s", back.span)
    return length(back, names)


def _window(e: s.Call, names: SymbolTable) -> b.SignalCall:
    """Resolve a call of a function over a time window that ends at the current frame."""
    word = _WINDOWS[normalize_name(e.name)]
    value = names.number(e.arguments[0])
    _refuse_nested(e, value, names)
    ahead = b.Length(0, frames=False)
    if isinstance(window := e.arguments[1], s.FrameWindow):
        by, ahead = length(window.before, names), length(window.ahead, names)
        if by.frames != ahead.frames:
            names.session.refuse("a window must be in time or in frames, not both", window.span)
        if by.frames:  # -2frames..2frames has five frames: two before, its own, and two ahead
            by = replace(by, amount=by.amount + 1)
    else:
        by = _how_far(e, names)
    if by.frames and not by.amount:
        names.session.refuse(
            f"{word}() needs at least one frame",
            e.arguments[1].span,
            "write 1frames for the frame itself, 10frames for the last ten",
        )
    if word == "avg_over" and b.is_angle(value):
        names.session.refuse(
            "angles have no average, because they repeat after 360 degrees",
            e.arguments[0].span,
            "average directions with atan2(avg_over(sin(radians(x)), 2s), avg_over(cos(radians(x)), 2s))",
        )
    return b.SignalCall(word, value, by.amount, by.frames, ahead=ahead.amount)


def refuse_window(e: s.FrameWindow, names: SymbolTable) -> b.Bound:
    """Raise an error for a time window outside the arguments of a function over time."""
    names.session.refuse(
        "-1s..1s is a window of min_over, max_over, avg_over or sum_over",
        e.span,
        "write min_over(x, -1s..1s)",
    )


def refuse_ahead(found: b.Bound, span: TextSpan, names: SymbolTable) -> None:
    """Raise an error if a window in a ``CHECK`` contains later frames. It must end at the frame."""
    if any(isinstance(part, b.SignalCall) and part.ahead for part in b.walk(found)):
        names.session.refuse(
            "a window of a CHECK ends at the frame",
            span,
            "write min_over(x, 2s), or EVENTUALLY[-1s, 1s] p for a condition",
        )


def _run_length(e: s.Call, names: SymbolTable) -> b.SignalCall:
    return b.SignalCall("run_length", _of_past(e, names), frames=True)


def _since_true(e: s.Call, names: SymbolTable) -> b.SignalCall:
    return b.SignalCall("since_true", _of_past(e, names))


def _of_past(e: s.Call, names: SymbolTable) -> b.Bound:
    found = names.condition(e.arguments[0])
    ahead = next((p for p in b.walk(found) if isinstance(p, b.Tense) and p.word in FUTURE), None)
    if ahead is not None:
        names.session.refuse(
            f"{e.name}() looks back, but {ahead.word} in it looks ahead", e.arguments[0].span
        )
    return found


def _robustness(e: s.Call, names: SymbolTable) -> b.SignalCall:
    return b.SignalCall("robustness", names.condition(e.arguments[0]))


def _age(e: s.Call, names: SymbolTable) -> b.SignalCall:
    return b.SignalCall("age", _node(e, names))


def _exists_now(e: s.Call, names: SymbolTable) -> b.SignalCall:
    return b.SignalCall("exists_now", _node(e, names), type=Type.boolean)


def _node(e: s.Call, names: SymbolTable) -> b.NodeValue:
    found = names.bind(e.arguments[0])
    if not isinstance(found, b.NodeValue):
        names.session.refuse(f"{e.name}() takes a node", e.arguments[0].span)
    return found


def _moment(e: s.Call, names: SymbolTable) -> b.Bound:
    argument = e.arguments[0]
    meaning = names.meaning(argument.name) if isinstance(argument, s.Variable) else None
    if meaning is None or not isinstance(meaning.value, b.StepTime):
        names.session.refuse(
            "t() takes the name of a step, after RETURN", argument.span, "MATCH … AS name THEN …"
        )
    return meaning.value


FUTURE: Final = frozenset({"ALWAYS", "EVENTUALLY", "NEXT", "WEAKNEXT", "UNTIL", "RELEASE"})
"""Temporal operators that use future frames."""

_WINDOWS: Final = {normalize_name(word): word for word in b.WINDOWS}

COURSES: Final[dict[str, Callable[[s.Call, SymbolTable], b.Bound]]] = {
    "prev": _previous,
    "delta": _delta,
    **dict.fromkeys(_WINDOWS, _window),
    "runlength": _run_length,
    "sincetrue": _since_true,
    "robustness": _robustness,
    "age": _age,
    "existsnow": _exists_now,
    "t": _moment,
}
"""Functions over time, by name in lower case."""


def _refuse_in_block(word: str, span: TextSpan, names: SymbolTable) -> None:
    if names.scope.parent is not None:
        names.session.refuse(
            f"{word} needs other frames, but a block in braces has only one",
            span,
            "name the node outside: MATCH (v:Vehicle) WHERE …, or FORALL (v:Vehicle) in a CHECK",
        )


def _refuse_nested(e: s.Call, value: b.Bound, names: SymbolTable) -> None:
    if b.is_temporal(value):
        names.session.refuse(f"{e.name}() takes a value of one frame", e.arguments[0].span)


def settled(expression: b.Bound, session: Session) -> b.Bound:
    """Return an expression in which each run length has the unit of the compared value: frames or s.

    A run is a series of frames in which a condition holds.

    Raises
    ------
    QueryError
        A number of frames is compared with another kind of value.
    """
    found = _settled(expression)
    for value in _lengths(found):
        if value.unit == "frames" and value.span is not None:
            session.refuse(
                "a number of frames is compared with run_length() and since_true() only", value.span
            )
    return found


def _settled(expression: b.Bound) -> b.Bound:
    match expression:
        case b.Operation(word, operands, kind):
            parts = tuple(_settled(operand) for operand in operands)
            if word in COMPARISONS:
                parts = _compared(parts)
            return b.Operation(word, parts, kind)
        case _:
            return b.with_operands(expression, _settled)


def _compared(parts: tuple[b.Bound, ...]) -> tuple[b.Bound, ...]:
    """Return both sides of a comparison. A ``run_length`` gets the unit of the other side."""
    inside = [part for side in parts for part in b.walk(side)]
    if not any(isinstance(p, b.SignalCall) and p.word in _RUNS for p in inside):
        return parts
    units = {p.unit for p in inside if isinstance(p, b.Value)}
    frames = True if "frames" in units else False if "s" in units else None
    return tuple(_counting(side, frames) for side in parts)


_RUNS: Final = frozenset({"run_length", "since_true"})


def _counting(expression: b.Bound, frames: bool | None) -> b.Bound:  # noqa: FBT001 - the unit
    match expression:
        case b.Operation(word, operands, kind):
            return b.Operation(word, tuple(_counting(o, frames) for o in operands), kind)
        case b.SignalCall(word=word) if word in _RUNS and frames is not None:
            return replace(expression, frames=frames)
        case b.Value(unit="frames"):
            return replace(expression, unit="")
        case _:
            return expression


def _lengths(expression: b.Bound) -> Iterator[b.Value]:
    """Yield the constants in an expression and in its patterns in braces."""
    for part in b.walk(expression):
        match part:
            case b.Value():
                yield part
            case b.BlockValue():
                for inner in part.inside:
                    yield from _lengths(inner)
            case _:
                pass
