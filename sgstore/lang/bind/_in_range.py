"""Condition ``in_range(a, b)``: true if sgstore computed relations between the two nodes.

A scene graph relates only the pairs selected by the settings of its trace: the ego and entities in range,
moving entities and entities near them. For such a pair, a missing edge means that the relation does not hold.
For any other pair, it means nothing. ``in_range(a, b)`` is expressed by distances and labels, so it is known
wherever these are known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.lang.catalog import NODE_ATTRIBUTES, TRACE_ATTRIBUTES, RelationScope, Type
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
from sgstore.model.pair_numbers import TOUCH
from sgstore.model.vocabulary import SIGNALS, VEHICLES, entity_kinds, kinds_labelled, normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sgstore.lang import ir as b
    from sgstore.lang.catalog import TraceFacts

_SIGNAL: Final = any_kinds().only(frozenset(SIGNALS))
_VEHICLE: Final = any_kinds().only(frozenset(VEHICLES))


def in_range(a: str, b: str, traces: Iterable[TraceFacts]) -> Bound:
    """Return a condition: true if sgstore computed relations between the two nodes.

    Parameters
    ----------
    a, b : str
        Keys of the nodes.
    traces : iterable of TraceFacts
        Traces to search.

    Returns
    -------
    Bound
        False for nodes other than entities; unknown in traces with unknown settings.
    """
    return in_traces(scopes_of(traces), lambda reach: related(a, b, reach))


def scopes_of(traces: Iterable[TraceFacts]) -> b.Scopes:
    """Group traces by the settings that select entity pairs. Return each setting with its trace ids."""
    of: dict[RelationScope | None, list[int]] = {}
    for trace in traces:
        of.setdefault(trace.reach, []).append(trace.trace_id)
    return tuple((reach, tuple(ids)) for reach, ids in of.items()) or ((RelationScope(), ()),)


def in_traces(scopes: b.Scopes, condition: Callable[[RelationScope | None], Bound]) -> Bound:
    """Return one condition for all traces, joined from the condition for each pair setting."""
    if len(scopes) < 2:
        return condition(next(reach for reach, _ in scopes))
    number = TraceAttribute(TRACE_ATTRIBUTES["id"], Type.number)
    return any_of(all_of(is_one_of(number, ids), condition(reach)) for reach, ids in scopes)


def related(a: str, b: str, reach: RelationScope | None) -> Bound:
    """Return a condition: true if relations of two nodes were computed with the given pair settings."""
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
    """Return a condition: true if the labels of two nodes are one of the listed pairs.

    The result is a list of one condition, or empty without pairs.
    """
    listed = [
        all_of(LabelTest(a, _labelled(one)), LabelTest(b, _labelled(other)))
        for pair in kinds
        for one, other in (pair, pair[::-1])
    ]
    return [any_of(listed)] if listed else []


def bounded(a: str, b: str, names: Iterable[str], reach: RelationScope) -> Bound:
    """Return a condition: true if two entities have one of the given distance relations, such as ``near``.

    Parameters
    ----------
    a, b : str
        Keys of the nodes.
    names : iterable of str
        Distance relations of the settings, and ``overlaps``.
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
    """Return a condition: true if the bodies of two entities touch, and at least one of them moves."""
    solid = [inverse(LabelTest(node, _SIGNAL)) for node in (a, b)]
    moves = any_of(inverse(_still(node)) for node in (a, b))
    ego = [] if reach.within > 0 else [any_of(LabelTest(node, ego_kinds()) for node in (a, b))]
    if not (reach.within > 0 or reach.ego):
        return Value(value=False, type=Type.boolean)
    listed = _listed(a, b, reach.kinds)
    return all_of(
        *solid, moves, *ego, *listed, _no_more(PairNumber("gap", a, b), Value(TOUCH, Type.number))
    )


def _labelled(label: str) -> Kinds:
    return (
        ego_kinds()
        if normalize_name(label) == "ego"
        else any_kinds().only(frozenset(kinds_labelled(label) or ()))
    )


def _up_to(a: str, b: str, bound: float, reach: RelationScope) -> Bound:
    """Return a condition: true if the distance of two nodes is at most the limit.

    Without a position it is false.
    """
    limit = Value(bound, Type.number)
    if reach.between == "origins":
        return any_of(
            all_of(*tests, _no_more(distance, limit)) for tests, distance in _between_origins(a, b)
        )
    distance: Bound = PairNumber("dist", a, b)
    if reach.between == "footprints":  # one without extent is a point
        distance = Operation("coalesce", (PairNumber("gap", a, b), distance), Type.number)
    return _no_more(distance, limit)


def _between_origins(a: str, b: str) -> Iterable[tuple[list[Bound], Bound]]:
    """Yield formulas for the distance between the origins of two nodes, each with its conditions.

    The origin of a moving vehicle is on the ground.
    """
    for low_a in (True, False):
        for low_b in (True, False):
            tests = [_lies_low(a, yes=low_a), _lies_low(b, yes=low_b)]
            centres = _apart(_number(a, "z"), _number(b, "z"))
            origins = _apart(_origin(a, low=low_a), _origin(b, low=low_b))
            dist = PairNumber("dist", a, b)
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


def _number(node: str, name: str) -> Bound:
    return NodeAttribute(node, NODE_ATTRIBUTES[name], Type.number)


def _still(node: str) -> Bound:
    return NodeAttribute(node, NODE_ATTRIBUTES["isstatic"], Type.boolean)


def _of(word: str, *operands: Bound) -> Bound:
    return Operation(word, operands, Type.number)
