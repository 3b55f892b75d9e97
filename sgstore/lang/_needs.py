"""Needs: values that a trace must know to answer a question.

``in_range(a, b)`` asks whether the relations of a pair were computed at all.

A scene graph relates the pairs that the settings of its trace name: the ego with what is in range, what moves
with what is near. Of such a pair a missing edge says that the relation does not hold; of any other it says
nothing. ``in_range(a, b)`` is written in terms of distances and labels, so it is answered wherever these are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.criticality import RECORDED
from sgstore.lang import ir as b
from sgstore.lang._catalog import (
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
    DisplayUnit,
    RelationScope,
    Type,
)
from sgstore.lang.ir import (
    Bound,
    Kinds,
    LabelTest,
    NodeAttribute,
    Operation,
    PairNumber,
    TraceAttribute,
    Value,
    all_of,
    any_kinds,
    any_of,
    ego_kinds,
    inverse,
    is_one_of,
)
from sgstore.pair_numbers import COURSES, TOUCH, WAYS, columns_needed
from sgstore.vocabulary import (
    SIGNALS,
    VEHICLE_LIGHTS,
    VEHICLES,
    entity_kinds,
    kinds_labelled,
    normalize_name,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from sgstore.lang._catalog import TraceFacts
    from sgstore.lang.ir import BoundCheck


_SIGNAL: Final = any_kinds().only(frozenset(SIGNALS))
_VEHICLE: Final = any_kinds().only(frozenset(VEHICLES))


def in_range(a: str, b: str, traces: Iterable[TraceFacts]) -> Bound:
    """Return the condition that the relations of two nodes were computed.

    Parameters
    ----------
    a, b : str
        Keys of the nodes.
    traces : iterable of TraceFacts
        Those that are asked.

    Returns
    -------
    Bound
        False of what is no entity; unknown in traces whose settings are not known.
    """
    return in_traces(scopes_of(traces), lambda reach: related(a, b, reach))


def scopes_of(traces: Iterable[TraceFacts]) -> b.Scopes:
    """Return which pairs are related in some traces: each way once, with the ids of its traces."""
    of: dict[RelationScope | None, list[int]] = {}
    for trace in traces:
        of.setdefault(trace.reach, []).append(trace.trace_id)
    return tuple((reach, tuple(ids)) for reach, ids in of.items()) or ((RelationScope(), ()),)


def in_traces(scopes: b.Scopes, condition: Callable[[RelationScope | None], Bound]) -> Bound:
    """Return a condition that is another one in traces with other settings."""
    if len(scopes) < 2:
        return condition(next(reach for reach, _ in scopes))
    number = TraceAttribute(TRACE_ATTRIBUTES["id"], Type.number)
    return any_of(all_of(is_one_of(number, ids), condition(reach)) for reach, ids in scopes)


def related(a: str, b: str, reach: RelationScope | None) -> Bound:
    """Return the condition that the relations of two nodes were computed with some settings."""
    if reach is None:
        return Value(None, Type.boolean)
    ego = any_of(LabelTest(node, ego_kinds()) for node in (a, b))
    ways: list[Bound] = []
    if reach.ego:
        close = [_up_to(a, b, reach.ego_within, reach)] if reach.ego_within > 0 else []
        ways.append(all_of(ego, *close))
    if reach.within > 0:
        near = _up_to(a, b, reach.within, reach)
        move = [
            inverse(test) for node in (a, b) for test in (_still(node), LabelTest(node, _SIGNAL))
        ]
        further = [inverse(ego)] if reach.ego else []
        ways.append(all_of(*further, *move, near))
        if reach.static:
            ways.append(all_of(*further, _still(a), _still(b), near))
    entities = [LabelTest(node, any_kinds().only(entity_kinds())) for node in (a, b)]
    return all_of(*entities, *_listed(a, b, reach.kinds), any_of(ways))


def _listed(a: str, b: str, kinds: Iterable[tuple[str, ...]]) -> list[Bound]:
    """Return the condition that two nodes have labels that are listed; none where none are."""
    listed = [
        all_of(LabelTest(a, _labelled(one)), LabelTest(b, _labelled(other)))
        for pair in kinds
        for one, other in (pair, pair[::-1])
    ]
    return [any_of(listed)] if listed else []


def bounded(a: str, b: str, names: Iterable[str], reach: RelationScope) -> Bound:
    """Return the condition that two entities have one of some relations that end at some distance.

    Parameters
    ----------
    a, b : str
        Keys of the nodes.
    names : iterable of str
        Rungs of the settings, and ``overlaps``.
    reach : RelationScope
        The settings.
    """
    wanted, ways, low = frozenset(names), list[Bound](), list[Bound]()
    for name, high in reach.rungs:
        near = _up_to(a, b, high, reach)
        if name in wanted:
            ways.append(all_of(near, *low))
        low = [inverse(near)]
    near = (
        [all_of(related(a, b, reach), *_listed(a, b, reach.near_kinds), any_of(ways))]
        if ways
        else []
    )
    return any_of([*near, _touch(a, b, reach)] if "overlaps" in wanted else near)


def _touch(a: str, b: str, reach: RelationScope) -> Bound:
    """Return the condition that two bodies touch, of which one moves."""
    solid = [inverse(LabelTest(node, _SIGNAL)) for node in (a, b)]
    moves = any_of(inverse(_still(node)) for node in (a, b))
    ego = [] if reach.within > 0 else [any_of(LabelTest(node, ego_kinds()) for node in (a, b))]
    if not (reach.within > 0 or reach.ego):
        return Value(value=False, type=Type.boolean)
    listed = _listed(a, b, reach.kinds)
    return all_of(
        *solid, moves, *ego, *listed, _no_more(_pair("gap", a, b), Value(TOUCH, Type.number))
    )


def _labelled(label: str) -> Kinds:
    return (
        ego_kinds()
        if normalize_name(label) == "ego"
        else any_kinds().only(frozenset(kinds_labelled(label) or ()))
    )


def _up_to(a: str, b: str, bound: float, reach: RelationScope) -> Bound:
    """Return the condition that two nodes are no further apart; a node without a place is near nothing."""
    limit = Value(bound, Type.number)
    if reach.between == "origins":
        return any_of(
            all_of(*tests, _no_more(distance, limit)) for tests, distance in _between_origins(a, b)
        )
    distance = _pair("dist", a, b)
    if reach.between == "footprints":  # one without extent is a point
        distance = Operation("coalesce", (_pair("gap", a, b), distance), Type.number)
    return _no_more(distance, limit)


def _between_origins(a: str, b: str) -> Iterable[tuple[list[Bound], Bound]]:
    """Distances of origins, and of what they are: that of a vehicle that moves lies on the ground."""
    for low_a in (True, False):
        for low_b in (True, False):
            tests = [_lies_low(a, yes=low_a), _lies_low(b, yes=low_b)]
            centres = _apart(_number(a, "z"), _number(b, "z"))
            origins = _apart(_origin(a, low=low_a), _origin(b, low=low_b))
            dist = _pair("dist", a, b)
            planar = _of("-", _of("*", dist, dist), _of("*", centres, centres))
            yield (
                tests,
                Operation("sqrt", (_of("+", planar, _of("*", origins, origins)),), Type.number),
            )


def _lies_low(node: str, *, yes: bool) -> Bound:
    low = all_of(LabelTest(node, _VEHICLE), inverse(_still(node)))
    return low if yes else inverse(low)


def _origin(node: str, *, low: bool) -> Bound:
    half = _of("/", _number(node, "height"), Value(2, Type.number))
    return _of("-", _number(node, "z"), half) if low else _number(node, "z")


def _apart(a: Bound, b: Bound) -> Bound:
    return _of("-", b, a)


def _no_more(distance: Bound, limit: Bound) -> Bound:
    near = Operation("<=", (distance, limit), Type.boolean)
    return Operation("coalesce", (near, Value(value=False, type=Type.boolean)), Type.boolean)


def _pair(function: str, a: str, b: str) -> Bound:
    return PairNumber(function, a, b)


def _number(node: str, name: str) -> Bound:
    return NodeAttribute(node, NODE_ATTRIBUTES[name], Type.number)


def _still(node: str) -> Bound:
    return NodeAttribute(node, NODE_ATTRIBUTES["isstatic"], Type.boolean)


def _of(word: str, *operands: Bound) -> Bound:
    return Operation(word, operands, Type.number)


# What a trace must know so that it can answer a question at all ---------------------------------
# A condition that is unknown is not true, and false where time begins. So of a trace that has no ego
# ``ALWAYS ego.speed < 20`` would be false, and of one that never tells a speed, too. Such a trace cannot
# answer: it is left out, and its verdict is unknown. What a question *needs* is told here: that the ego is
# there, and that what is measured of its variables is known of any of them in any frame.
#
# Only what is measured counts. Of an attribute whose absence says something itself (a lane without ``turn``
# is in no junction, a car without ``special`` is an ordinary one), nothing is unknown. What stands in
# ``known``, ``IS NULL``, ``coalesce`` and ``CASE`` says what is to be done without it, and variables of blocks
# are asked to exist.

MOTION: Final = frozenset({"speed", "vx", "vy", "vz", "accel", "ax", "ay", "az", "yaw_rate"})
"""What nothing has that never moves."""

MEASURED: Final = MOTION | {
    *("heading", "pitch", "roll", "length", "width", "height"),
    *("steer", "throttle", "brake", "gear", "hand_brake", "light_state", "parked"),
    *("speed_limit", "curvature"),
    *VEHICLE_LIGHTS,
}
"""Attributes of nodes that are unknown where nobody told them."""

_TELLS: Final = frozenset({"IS NULL", "IS NOT NULL", "coalesce", "case"})
"""What is known even of what is not."""


@dataclass(frozen=True, slots=True)
class Need:
    """Something that a trace must know.

    Attributes
    ----------
    node : str
        The variable; empty: the frame.
    kinds : Kinds or None
        What it may be.
    attribute : Attribute or None
        That must be known of it in some frame, if there is one; ``None``: that there is one.
    event : str
        The kind of event that it must tell of; else empty.
    lanes : str
        What its map must tell of lanes: ``ways``, ``curvature``, ``slope``; else empty.
    """

    node: str
    kinds: b.Kinds | None
    attribute: Attribute | None
    event: str = ""
    lanes: str = ""

    @property
    def is_ego(self) -> bool:
        """Whether it is that there is an ego."""
        return self.attribute is None and not self.event and not self.lanes

    @property
    def reason(self) -> str:
        """Message about a trace that does not meet it."""
        if self.lanes:
            return (
                "it has no map with heights" if self.lanes == "slope" else "it has no map of lanes"
            )
        if self.event:
            return f"it does not record events of the kind {self.event}"
        if self.attribute is None:
            return "it has no ego"
        of = "" if self.kinds is None else f" of {self.node}"
        return f"{self.attribute.name}{of} is never known"


def of_check(check: BoundCheck) -> tuple[Need, ...]:
    """Return the needs of a check; none with ``USING UNKNOWN false``."""
    if check.unknown_is_false:
        return ()
    nodes = check.scope.nodes
    bound = {node for quantifier in check.quantifiers for node in quantifier.nodes}
    spoken = [check.formula, *(q.where for q in check.quantifiers if q.where is not None)]
    spoken += [check.reset] if check.reset is not None else []
    egos = {Need(key, node.kinds, None) for key, node in nodes.items() if key not in bound}
    return _ordered(egos | _of_each(spoken, nodes, strict=True))


def not_computed(check: BoundCheck, facts: TraceFacts) -> str:
    """Return the reason if relations that a check asks for were not computed in a trace, or an empty text."""
    if check.unknown_is_false:
        return ""
    missing = check.relations - facts.answers
    if facts.reach is not None and facts.reach.without:
        spoken = (check.formula, *(q.where for q in check.quantifiers if q.where is not None))
        missing |= facts.reach.without & frozenset().union(*map(_of_entities, spoken))
    return f"it knows nothing of {', '.join(sorted(missing))}" if missing else ""


def _of_entities(expression: Bound) -> frozenset[str]:
    """Return the relations that an expression asks for of entities."""
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
    """Return the needs of a query: what a trace must know so that something can be found in it.

    Where one of several conditions is enough (``OR``), and no time is looked at, what all of them need counts.
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
    # One ego is as good as another.
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
    """Return the needs of an expression; ``strict``: of all its parts, even if fewer were enough."""

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
            if function in RECORDED:  # it is unknown where it needs more than the trace has
                return set()
            told = function if function in COURSES else "ways"
            of_map = {Need("", None, None, lanes=told)} if function in WAYS else set[Need]()
            of_two = zip((one, other), columns_needed(function), strict=True)
            # Both parts of a velocity are known, or none, and of an acceleration.
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
        case b.Happened(kind=kind, table=()):
            return {Need("", None, None, kind)}
        case b.BlockValue(scope=scope, value=value):
            inner = [*scope.where, *([value] if value is not None else [])]
            return _of_each(
                inner, {k: n for k, n in nodes.items() if k in scope.outer}, strict=True
            )
        case _:
            return set()
