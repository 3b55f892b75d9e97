"""Binder of aggregates over the frames of a match, such as ``MIN(ttc(e, v)) OVER match``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.catalog import FRAME_ATTRIBUTES, Type
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from sgstore.errors import TextSpan
    from sgstore.lang.bind._symbols import SymbolTable


_VALUES: Final = frozenset({Type.number, Type.text, Type.boolean})


def over_match(e: s.OverExpression, names: SymbolTable) -> b.OverMatch:
    """Return the resolved aggregate over the frames of a match, or over some of its steps.

    Raises
    ------
    QueryError
        It is used without a match, names an unknown step, or its operand is not a value of a frame.
    """
    session = names.session
    if not names.over and names.aggregated:
        session.refuse("a value over a match needs values of its frames", e.span)
    if not names.over:
        session.refuse(
            "OVER is allowed only after RETURN",
            e.span,
            "write min_over(x, 2s), run_length(p) or EVENTUALLY[0s, 2s] p in a condition",
        )
    call = e.call
    counted = isinstance(call, s.CountAll)
    word = normalize_name(call.name) if isinstance(call, s.Call) else ""
    if word not in b.OF_MATCH:
        hint = "write MIN(x) OVER match or LAST(x) OVER match for a value during the match"
        if counted or word == "count":
            hint = "write LAST(frame.t) OVER match - FIRST(frame.t) OVER match for the duration"
        known = ", ".join(map(str.upper, b.OF_MATCH))
        session.refuse(f"expected one of {known} before OVER", call.span, hint)
    assert isinstance(call, s.Call)  # noqa: S101 - COUNT(*) was rejected
    most = 2 if word in b.PLACES else 1
    found = len(call.arguments)
    if not 1 <= found <= most:
        wanted = "1 argument" if most == 1 else "1 or 2 arguments"
        session.refuse(f"{call.name}() takes {wanted}, found {found}", call.span)
    inner = replace(names, aggregates=False, aggregated=True, over=False)
    operand = _operand(word, call.arguments[0], inner)
    at = None
    if word in b.PLACES:
        at = _value(call.arguments[1], inner) if found == 2 else _seconds()
    kind = at.type if at is not None else operand.type
    start, end = _range(e, names)
    return b.OverMatch(word, operand, start, end, at, kind)


def _operand(word: str, argument: s.Expression, names: SymbolTable) -> b.Bound:
    if word in {"first", "last"}:
        return _value(argument, names)
    found = names.number(argument)
    _refuse_steps(found, argument.span, names)
    if word == "avg" and b.is_angle(found):
        names.session.refuse(
            "angles have no average, because they repeat after 360 degrees",
            argument.span,
            "average directions with atan2(AVG(sin(radians(x))) OVER match, AVG(cos(radians(x))) OVER match)",
        )
    return found


def _value(argument: s.Expression, names: SymbolTable) -> b.Bound:
    found = names.bind(argument)
    if found.type not in _VALUES:
        names.session.refuse(
            f"expected a value, but this is a {found.type.value}",
            argument.span,
            "write one of its attributes: v.name, v.speed" if found.type is Type.node else None,
        )
    _refuse_steps(found, argument.span, names)
    return found


def _refuse_steps(found: b.Bound, span: TextSpan, names: SymbolTable) -> None:
    if any(isinstance(part, b.StepTime) for part in b.walk(found)):
        names.session.refuse(
            "t() of a step is the same in every frame", span, "frame.t is the time"
        )


def _seconds() -> b.Bound:
    return b.FrameAttribute(FRAME_ATTRIBUTES["t"], Type.number)


def _range(e: s.OverExpression, names: SymbolTable) -> tuple[int | None, int | None]:
    """Return the numbers of the first and last step in an ``OVER`` clause; None for ``OVER match``."""
    if e.start is None:
        return None, None
    start = _step(e.start, names)
    end = _step(e.end, names) if e.end is not None else start
    if end < start:
        names.session.refuse(
            f"{e.end.name if e.end else ''} comes before {e.start.name}",
            e.span,
            f"write OVER {e.end.name if e.end else ''}..{e.start.name}",
        )
    return start, end


def _step(name: s.Variable, names: SymbolTable) -> int:
    meaning = names.meaning(name.name)
    if meaning is None or not isinstance(meaning.value, b.StepTime):
        meanings = {one: names.meaning(one) for one in sorted(names.visible())}
        known = [o for o, told in meanings.items() if told and isinstance(told.value, b.StepTime)]
        hint = None if known else "OVER match is the whole match; MATCH … AS name names a step"
        names.session.unknown("step", name.name, name.span, known, hint)
    return meaning.value.step
