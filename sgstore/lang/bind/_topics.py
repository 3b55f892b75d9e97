"""Binder of ``topic('/imu').linear_acceleration.z``: the value of a recorded topic at a frame."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import quoted
from sgstore.errors import QueryNameError, TextSpan
from sgstore.lang import ir as b
from sgstore.lang.bind._expressions import parameter
from sgstore.lang.bind._temporal import length
from sgstore.lang.catalog import TopicValue, Type, topic_attribute
from sgstore.lang.syntax import tree as s

if TYPE_CHECKING:
    from typing import NoReturn

    from sgstore.lang.bind._symbols import Session, SymbolTable
    from sgstore.lang.topics import TopicError

_WHOLE: Final = {"BLOB": "bytes", "JSON": "JSON values"}
_TIME: Final = re.compile(r"(\d+(?:\.\d+)?)(ms|s|min)?", re.IGNORECASE)


def topic_field(e: s.TopicExpression, names: SymbolTable) -> b.FrameAttribute:
    """Resolve a reference to a field of a topic: its value at the frame.

    Raises
    ------
    QueryNameError
        No such topic, or no such field.
    QueryError
        The topic cannot be decoded, or the field has several values.
    """
    session = names.session
    topic = e.topic.value if isinstance(e.topic, s.Constant) else parameter(e.topic, names)
    if not isinstance(topic, str):
        session.refuse("topic() takes the name of a topic, a text", e.topic.span)
    topic, path, kind = _of_recordings(topic, _dotted(e.path), e, session)
    if e.rule == "linear" and kind not in {Type.number, Type.open}:
        session.refuse(
            f"only numbers can be interpolated, and {path} is a {kind.value}",
            e.span,
            f"write topic('{topic}', nearest)",
        )
    tolerance = session.tolerance_ns
    if isinstance(e.tolerance, s.Duration) and math.isinf(e.tolerance.amount):
        tolerance = None
    elif e.tolerance is not None:
        given = length(e.tolerance, names)
        if given.frames:
            session.refuse("the tolerance of topic() is a time such as 0.1s", e.tolerance.span)
        tolerance = given.amount
    value = TopicValue(topic, path, e.rule, tolerance)
    return b.FrameAttribute(topic_attribute(value, kind), kind)


def _of_recordings(
    topic: str, path: str, e: s.TopicExpression, session: Session
) -> tuple[str, str, Type]:
    """Return the topic name and the field name in the spelling of the recordings, and the type."""
    from sgstore.lang.topics import TopicError, field_of, topic_of  # imports numpy

    try:
        if topic not in session.topics and (session.online or session.part):
            known = f"/{topic}" in session.topics
            if not known and (session.part or not session.topics):
                return topic, path, Type.open  # other parts or later frames may have it
        facts = topic_of(session.topics, topic)
    except TopicError as error:
        _refuse(error, e.topic.span, session)
    try:
        if not facts.refused and not facts.source():
            return facts.name, path, Type.open  # the parts of a collection know the fields
        field = field_of(facts, path)
    except TopicError as error:
        if facts.refused:
            session.refuse(f"{error.reason}: {error.hint}", e.topic.span)
        _refuse(error, e.path_span, session)
    if field.type is Type.list:
        reason = f"field {field.name} of {facts.name} has several values"
        hint = f"one of them: {field.name}[0]"
        if not field.declared.endswith("]"):
            reason = (
                f"field {field.name} of {facts.name} has {_WHOLE[field.declared]}, not one value"
            )
            hint = f"in SQL, {quoted(field.name)} is a column of topic('{facts.name}')"
        session.refuse(reason, e.path_span, hint)
    return facts.name, field.name, field.type


def _refuse(error: TopicError, span: TextSpan, session: Session) -> NoReturn:
    raise QueryNameError(error.reason, text=session.text, span=span, hint=error.hint) from None


def tolerance_of(value: str, span: TextSpan, session: Session) -> int | None:
    """Return the time in ``USING TOLERANCE``; ns. None for ``INF``, which means no limit."""
    if value.upper() == "INF":
        return None
    found = _TIME.fullmatch(value)
    if found is None:
        session.refuse(
            f"USING TOLERANCE {value} is not a time", span, "USING TOLERANCE 0.5s, or INF"
        )
    return min(s.Duration(float(found[1]), (found[2] or "s").lower(), span).ns, 2**62)


def _dotted(path: tuple[str | int, ...]) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return "".join(parts).removeprefix(".")
