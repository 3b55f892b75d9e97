"""What looks at other frames than one: operators of time, functions of how something went, lengths of time.

They stand in conditions of a ``MATCH``, in what it returns, and in a ``CHECK``; inside braces only one frame is
looked at.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang import bound as b
from sgstore.lang import over_time as o
from sgstore.lang import syntax as s
from sgstore.lang.catalog import Type
from sgstore.lang.conditions import bind, condition, number, parameter
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.errors import Span
    from sgstore.lang.names import Names, Session

MAX_NS: Final = 10**18
"""The longest time that a query may speak of: some 30 years; ns."""

_UNBOUNDED: Final = frozenset({"NEXT", "WEAKNEXT", "PREVIOUS"})
_LENGTH: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(ms|s|min|frames)", re.IGNORECASE)
_COMPARISONS: Final = frozenset({"=", "<>", "<", "<=", ">", ">="})


def tense(e: s.Temporal, names: Names) -> b.Tense:
    """An operator of time.

    Raises
    ------
    QueryError
        It stands inside braces, its operands are no conditions, or its bound is none.
    """
    _refuse_in_block(e.word, e.span, names)
    operands = tuple(condition(operand, names) for operand in e.operands)
    if e.bound is None:
        return b.Tense(e.word, operands)
    if e.word in _UNBOUNDED:
        names.session.refuse(f"{e.word} has no bound", e.span)
    low = length(e.bound[0], names)
    if e.bound[1] is None:
        return b.Tense(e.word, operands, low.amount, None, low.frames)
    high = length(e.bound[1], names)
    if low.frames != high.frames and low.amount:
        names.session.refuse("a bound is either in time or in frames", e.bound[1].span)
    if high.amount < low.amount:
        names.session.refuse("the bound ends before it begins", e.bound[1].span)
    return b.Tense(e.word, operands, low.amount, high.amount, high.frames)


def length(e: s.Duration | s.Parameter, names: Names) -> o.Length:
    """A length of time: as written, or what a parameter is: a number of seconds, or a text such as ``2s``.

    Raises
    ------
    QueryError
        It is no length of time, or one that is too long.
    """
    amount, unit = (e.amount, e.unit) if isinstance(e, s.Duration) else _given(e, names)
    if unit == "frames":
        if amount != int(amount):
            names.session.refuse("expected a whole number of frames", e.span)
        return o.Length(int(amount), frames=True)
    ns = s.Duration(amount, unit, e.span).ns
    if not 0 <= ns <= MAX_NS:
        names.session.refuse("no length of time that a trace may have", e.span)
    return o.Length(ns, frames=False)


def _given(e: s.Parameter, names: Names) -> tuple[float, str]:
    value = parameter(e, names)
    if isinstance(value, int | float) and not isinstance(value, bool) and value == value:  # noqa: PLR0124 - no NaN
        return float(min(value, 1e300)), "s"
    found = _LENGTH.fullmatch(value.strip()) if isinstance(value, str) else None
    if found is None:
        names.session.refuse(
            f"the parameter '{e.name}' is no length of time",
            e.span,
            "give it a number of seconds, or a text such as '2s' or '10frames'",
        )
    return float(found[1]), found[2].lower()


def timespan(e: s.Duration) -> b.Value:
    """A length of time as a number: of seconds, or of frames where such are counted."""
    if e.unit == "frames":
        return b.Value(e.amount, Type.number, unit="frames", span=e.span)
    return b.Value(e.ns / 1e9, Type.number, unit="s", span=e.span)


# Functions of how something went ------------------------------------------------------------------


def course(e: s.Call, names: Names) -> b.Bound:
    """A call of ``prev``, ``delta``, ``run_length``, ``since_true``, ``age``, ``exists_now`` or ``t``.

    Raises
    ------
    QueryError
        Its arguments do not fit, or it stands inside braces.
    """
    word = folded(e.name)
    _refuse_in_block(f"{e.name}()", e.name_span, names)
    wanted = 2 if word == "delta" else 1
    if len(e.arguments) != wanted:
        found = len(e.arguments)
        reason = f"{e.name}() takes {wanted} argument{'s' * (wanted > 1)}, found {found}"
        names.session.refuse(reason, e.span)
    return COURSES[word](e, names)


def _previous(e: s.Call, names: Names) -> b.Course:
    value = bind(e.arguments[0], names)
    _refuse_nested(e, value, names)
    if value.type not in {Type.number, Type.text, Type.boolean}:
        names.session.refuse(f"prev() takes a value, not a {value.type.value}", e.arguments[0].span)
    return b.Course("prev", value, type=value.type)


def _delta(e: s.Call, names: Names) -> b.Course:
    value = number(e.arguments[0], names)
    _refuse_nested(e, value, names)
    back = e.arguments[1]
    if not isinstance(back, s.Duration | s.Parameter):
        names.session.refuse("expected a length of time such as 2s", back.span)
    by = length(back, names)
    return b.Course("delta", value, by.amount, by.frames)


def _run_length(e: s.Call, names: Names) -> b.Course:
    return b.Course("run_length", _of_past(e, names), frames=True)


def _since_true(e: s.Call, names: Names) -> b.Course:
    return b.Course("since_true", _of_past(e, names))


def _of_past(e: s.Call, names: Names) -> b.Bound:
    found = condition(e.arguments[0], names)
    ahead = next((p for p in b.walk(found) if isinstance(p, b.Tense) and p.word in FUTURE), None)
    if ahead is not None:
        names.session.refuse(
            f"{e.name}() looks back, but {ahead.word} in it looks ahead", e.arguments[0].span
        )
    return found


def _age(e: s.Call, names: Names) -> b.Course:
    return b.Course("age", _node(e, names))


def _exists_now(e: s.Call, names: Names) -> b.Course:
    return b.Course("exists_now", _node(e, names), type=Type.boolean)


def _node(e: s.Call, names: Names) -> b.NodeValue:
    found = bind(e.arguments[0], names)
    if not isinstance(found, b.NodeValue):
        names.session.refuse(f"{e.name}() takes a node", e.arguments[0].span)
    return found


def _moment(e: s.Call, names: Names) -> b.Bound:
    argument = e.arguments[0]
    meaning = names.meaning(argument.name) if isinstance(argument, s.Variable) else None
    if meaning is None or not isinstance(meaning.value, b.Moment):
        names.session.refuse(
            "t() takes the name of a step, after RETURN", argument.span, "MATCH … AS name THEN …"
        )
    return meaning.value


FUTURE: Final = frozenset({"ALWAYS", "EVENTUALLY", "NEXT", "WEAKNEXT", "UNTIL", "RELEASE"})
"""Operators that look ahead."""

COURSES: Final[dict[str, Callable[[s.Call, Names], b.Bound]]] = {
    "prev": _previous,
    "delta": _delta,
    "runlength": _run_length,
    "sincetrue": _since_true,
    "age": _age,
    "existsnow": _exists_now,
    "t": _moment,
}
"""Functions of how something went, by folded name."""


def _refuse_in_block(word: str, span: Span, names: Names) -> None:
    if names.scope.parent is not None:
        names.session.refuse(
            f"{word} looks at other frames, and inside braces there is but one",
            span,
            "name the node outside: MATCH (v:Vehicle) WHERE …, or FORALL (v:Vehicle) in a CHECK",
        )


def _refuse_nested(e: s.Call, value: b.Bound, names: Names) -> None:
    if b.is_temporal(value):
        names.session.refuse(f"{e.name}() takes a value of one frame", e.arguments[0].span)


# Lengths of runs ----------------------------------------------------------------------------------


def settled(expression: b.Bound, session: Session) -> b.Bound:
    """An expression in which every length of a run counts what it is compared with: frames, or time.

    Raises
    ------
    QueryError
        A number of frames is compared with something else.
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
            if word in _COMPARISONS:
                parts = _compared(parts)
            return b.Operation(word, parts, kind)
        case b.Tense(operands=operands):
            return replace(expression, operands=tuple(_settled(operand) for operand in operands))
        case b.Course(operand=operand):
            return replace(expression, operand=_settled(operand))
        case b.Aggregate(operand=operand) if operand is not None:
            return replace(expression, operand=_settled(operand))
        case _:
            return expression


def _compared(parts: tuple[b.Bound, ...]) -> tuple[b.Bound, ...]:
    """The sides of a comparison, the lengths of runs in them as the numbers beside them count."""
    inside = [part for side in parts for part in b.walk(side)]
    if not any(isinstance(p, b.Course) and p.word in _RUNS for p in inside):
        return parts
    units = {p.unit for p in inside if isinstance(p, b.Value)}
    frames = True if "frames" in units else False if "s" in units else None
    return tuple(_counting(side, frames) for side in parts)


_RUNS: Final = frozenset({"run_length", "since_true"})


def _counting(expression: b.Bound, frames: bool | None) -> b.Bound:  # noqa: FBT001 - what is counted
    match expression:
        case b.Operation(word, operands, kind):
            return b.Operation(word, tuple(_counting(o, frames) for o in operands), kind)
        case b.Course(word=word) if word in _RUNS and frames is not None:
            return replace(expression, frames=frames)
        case b.Value(unit="frames"):
            return replace(expression, unit="")
        case _:
            return expression


def _lengths(expression: b.Bound) -> Iterator[b.Value]:
    """The lengths of time in an expression and in the blocks in it."""
    for part in b.walk(expression):
        match part:
            case b.Value():
                yield part
            case b.BlockValue(scope=scope, value=value):
                for inner in (*scope.where, *([value] if value is not None else [])):
                    yield from _lengths(inner)
            case _:
                pass
