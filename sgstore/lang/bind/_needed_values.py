"""Data that a query or check needs: a trace without these values, such as speeds, gives no answer.

An unknown condition is not true, and inside temporal operators it is false. So ``ALWAYS ego.speed < 20``
would be false for a trace without an ego or without speeds. Such a trace cannot answer: it is left out, and
its verdict is unknown. The needs of a query are an ego, and measured attributes of its variables that are
known at least once.

Only measured attributes count. Some attributes have a meaning even if they are absent (a lane without
``turn`` is not in a junction, a car without ``special`` is an ordinary car); these are never unknown.
``known``, ``IS NULL``, ``coalesce`` and ``CASE`` handle missing values themselves. Variables of blocks must
only exist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.catalog import (
    NODE_ATTRIBUTES,
    Attribute,
    DisplayUnit,
    TopicValue,
    Type,
    topic_attribute,
)
from sgstore.lang.ir import Bound, NodeAttribute, PairNumber
from sgstore.model.criticality import RECORDED
from sgstore.model.pair_numbers import COURSES, WAYS, columns_needed
from sgstore.model.vocabulary import VEHICLE_LIGHTS, entity_kinds, normalize_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.lang.catalog import TraceFacts
    from sgstore.lang.ir import BoundCheck


MOTION: Final = frozenset({"speed", "vx", "vy", "vz", "accel", "ax", "ay", "az", "yaw_rate"})
"""Attributes that static nodes do not have."""

MEASURED: Final = MOTION | {
    *("heading", "pitch", "roll", "length", "width", "height"),
    *("steer", "throttle", "brake", "gear", "hand_brake", "light_state", "parked"),
    *("speed_limit", "curvature"),
    *VEHICLE_LIGHTS,
}
"""Measured attributes of nodes, which are unknown if the recording does not have them."""

_TELLS: Final = frozenset({"IS NULL", "IS NOT NULL", "coalesce", "case"})
"""Operators whose result is known even if an operand is unknown."""


@dataclass(frozen=True, slots=True)
class Need:
    """Data that a query or check needs from a trace: an attribute, an event, an ego or a map.

    Attributes
    ----------
    node : str
        The variable; empty for the frame.
    kinds : Kinds or None
        Kinds that the node may have.
    attribute : Attribute or None
        Attribute that must be known in at least one frame, if such a node exists. ``None`` means that the
        node must exist.
    event : str
        Kind of event that must be recorded; otherwise empty.
    lanes : str
        Lane data that the map must have: ``ways``, ``curvature`` or ``slope``; otherwise empty.
    """

    node: str
    kinds: b.Kinds | None
    attribute: Attribute | None
    event: str = ""
    lanes: str = ""

    @property
    def is_ego(self) -> bool:
        """True if the needed data is the ego vehicle, and not an attribute, event or map."""
        return self.attribute is None and not self.event and not self.lanes

    @property
    def reason(self) -> str:
        """Message about the needed data that a trace does not have."""
        if self.lanes:
            return (
                "it has no map with heights" if self.lanes == "slope" else "it has no map of lanes"
            )
        if self.event:
            return f"it does not record events of the kind {self.event}"
        if self.attribute is None:
            every = self.kinds is None or self.kinds.ego == b.ego_kinds().ego
            return "it has no ego" if every else "its ego is of another kind, or it has none"
        of = "" if self.kinds is None else f" of {self.node}"
        return f"{self.attribute.name}{of} never has a value"

    def reason_in(self, trace: str) -> str:
        """Return a message about the needed data that the trace with this name does not have."""
        value = self.attribute and self.attribute.topic
        return f"trace {trace} has no topic {value.topic}" if value else self.reason


def of_check(check: BoundCheck) -> tuple[Need, ...]:
    """Return the data that a check needs from a trace.

    The result is empty with ``USING UNKNOWN false``.
    """
    if check.unknown_is_false:
        return ()
    nodes = check.scope.nodes
    bound = {node for quantifier in check.quantifiers for node in quantifier.nodes}
    spoken = [check.formula, *(q.where for q in check.quantifiers if q.where is not None)]
    spoken += [check.reset] if check.reset is not None else []
    egos = {Need(key, node.kinds, None) for key, node in nodes.items() if key not in bound}
    return _ordered(egos | _of_each(spoken, nodes, strict=True))


def not_computed(check: BoundCheck, facts: TraceFacts) -> str:
    """Return a message about the relations that a check uses and a trace does not have, or an empty text."""
    if check.unknown_is_false:
        return ""
    missing = check.relations - facts.answers
    if facts.reach is not None and facts.reach.without:
        spoken = (check.formula, *(q.where for q in check.quantifiers if q.where is not None))
        missing |= facts.reach.without & frozenset().union(*map(_of_entities, spoken))
    return f"it does not contain {', '.join(sorted(missing))}" if missing else ""


def _of_entities(expression: Bound) -> frozenset[str]:
    """Return the names of the relations between entities that an expression uses."""
    found: set[str] = set()
    for part in b.walk(expression):
        match part:
            case PairNumber(function=function) if function in WAYS:
                found.add("isIn")
            case NodeAttribute(attribute=attribute) if attribute is NODE_ATTRIBUTES["injunction"]:
                found.add("isIn")
            case b.BlockValue(scope=scope):
                for edge in scope.edges:
                    ends = scope.kinds(edge.src).every | scope.kinds(edge.dst).every
                    if ends & entity_kinds() and edge.relations != b.any_relation():
                        found |= edge.relations
                found = found.union(*map(_of_entities, part.inside))
            case _:
                pass
    return frozenset(found)


def of_query(query: b.Query) -> tuple[Need, ...]:
    """Return the data without which a trace cannot have a match of the query.

    For an ``OR`` without temporal operators, only needs common to all its conditions count.
    """
    if query.unknown_is_false:
        return ()
    steps = [(step.scope, step.when) for step in query.steps]
    steps = steps or [(scope, ()) for scope in query.required]
    needs: list[set[Need]] = []
    for scope, when in steps:
        egos = {Need(k, n.kinds, None) for k, n in scope.nodes.items() if n.kinds.one_a_frame}
        needs.append(egos | _of_each([*scope.where, *when], scope.nodes, strict=False))
    every = tuple(range(len(steps)))
    ways = [way.steps for way in query.ways] if query.steps else [every]
    found = set.intersection(*(set[Need]().union(*(needs[n] for n in way)) for way in ways))
    # All ego needs of the same kinds are equivalent, so one is sufficient.
    egos = {need.kinds: need for need in found if need.is_ego}
    others = {need for need in found if not need.is_ego}
    return _ordered(others | {*egos.values()})


def _ordered(needs: set[Need]) -> tuple[Need, ...]:
    def rank(need: Need) -> tuple[bool, str, str, str, str]:
        name = need.attribute.name if need.attribute else ""
        return need.attribute is not None, need.node, name, need.event, need.lanes

    return tuple(sorted(needs, key=rank))


def _of_each(
    expressions: Iterable[b.Bound], nodes: Mapping[str, b.Node], *, strict: bool
) -> set[Need]:
    return {need for e in expressions for need in _needed(e, nodes, strict=strict)}


def _needed(  # noqa: C901, PLR0911, PLR0912 - a case each
    expression: b.Bound, nodes: Mapping[str, b.Node], *, strict: bool
) -> set[Need]:
    """Return the data that an expression needs from a trace.

    If ``strict``, all operands count, even of an ``OR``.
    """

    def of_node(key: str, name: str) -> set[Need]:
        if key not in nodes or name not in MEASURED:
            return set()
        return {Need(key, nodes[key].kinds, NODE_ATTRIBUTES[normalize_name(name)])}

    match expression:
        case b.Operation(word=word) if word in _TELLS:
            return set()
        case b.Operation("OR" | "IMPLIES", operands) if not strict:
            return set.intersection(*(_needed(one, nodes, strict=False) for one in operands))
        case b.Operation(operands=operands):
            return _of_each(operands, nodes, strict=strict)
        case b.Tense(operands=operands):
            return _of_each(operands, nodes, strict=True)
        case b.SignalCall(word="age" | "exists_now"):
            return set()
        case b.SignalCall(operand=operand):
            return _needed(operand, nodes, strict=True)
        case b.NodeAttribute(node=node, attribute=attribute):
            return of_node(node, attribute.name)
        case b.PairNumber(function=function, a=one, b=other):
            if function in RECORDED:  # unknown if it needs more than the trace has
                return set()
            told = function if function in COURSES else "ways"
            of_map = {Need("", None, None, lanes=told)} if function in WAYS else set[Need]()
            of_two = zip((one, other), columns_needed(function), strict=True)
            # Both components of a velocity or an acceleration are known, or neither is.
            return of_map | {
                need
                for node, parts in of_two
                for name in parts - {"vy", "ay"}
                for need in of_node(node, name)
            }
        case b.FrameAttribute(attribute=attribute) if attribute.unit in {
            DisplayUnit.weather,
            DisplayUnit.clock,
        }:
            return {Need("", None, attribute)}
        case b.FrameAttribute(attribute=attribute) if (value := attribute.topic) is not None:
            of_any_field = topic_attribute(TopicValue(value.topic, ""), Type.open)
            return {Need("", None, of_any_field)}
        case b.Happened(kind=kind, table=()):
            return {Need("", None, None, kind)}
        case b.BlockValue(scope=scope, value=value):
            inner = [*scope.where, *([value] if value is not None else [])]
            return _of_each(
                inner, {k: n for k, n in nodes.items() if k in scope.outer}, strict=True
            )
        case _:
            return set()
