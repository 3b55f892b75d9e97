"""Whether the relations of a pair of entities were computed at all: what a missing edge says.

A scene graph relates the pairs that the settings of its trace name: the ego with what is in range, what moves
with what is near. Of such a pair a missing edge says that the relation does not hold; of any other it says
nothing. ``in_range(a, b)`` is written in terms of distances and labels, so it is answered wherever these are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.bound import (
    ANY,
    EGO,
    Bound,
    Choices,
    Kinds,
    LabelTest,
    NodeAttribute,
    Operation,
    PairNumber,
    TraceAttribute,
    Value,
)
from sgstore.lang.catalog import NODE_ATTRIBUTES, TRACE_ATTRIBUTES, Type
from sgstore.vocabulary import ENTITY_KINDS, SIGNALS, VEHICLES, folded, kinds_labelled

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from typing import Self

    from sgstore.lang.catalog import TraceFacts

_ENTITY: Final = ANY.only(frozenset(ENTITY_KINDS))
_SIGNAL: Final = ANY.only(frozenset(SIGNALS))
_VEHICLE: Final = ANY.only(frozenset(VEHICLES))


@dataclass(frozen=True, slots=True)
class Reach:
    """Which pairs of entities are related, as :class:`sgstore.config.Pairs` says it.

    Attributes
    ----------
    within, ego_within : float
    ego, static : bool
    kinds : tuple of pairs of str
    between : str
        What distances are measured between: :attr:`sgstore.config.Proximity.between`.
    """

    within: float = 25.0
    ego: bool = True
    static: bool = False
    ego_within: float = 0.0
    kinds: tuple[tuple[str, ...], ...] = ()
    between: str = "centres"

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Self | None:
        """As the settings of a trace have it; ``None`` where they do not say it."""
        pairs = settings.get("pairs")
        if pairs is None:
            return None
        kinds = tuple(tuple(labels) for labels in pairs["kinds"])
        between = settings["proximity"]["between"]
        names = ("within", "ego", "static", "ego_within")
        return cls(**{name: pairs[name] for name in names}, kinds=kinds, between=between)


def in_range(a: str, b: str, traces: Iterable[TraceFacts]) -> Bound:
    """Whether the relations of two nodes were computed.

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
    of: dict[Reach | None, list[int]] = {}
    for trace in traces:
        of.setdefault(trace.reach, []).append(trace.trace_id)
    if len(of) < 2:
        return _related(a, b, next(iter(of), Reach()))
    number = TraceAttribute(TRACE_ATTRIBUTES["id"], Type.number)
    return _any(
        _all(
            Operation(
                "IN", (number, Choices(tuple(Value(i, Type.number) for i in ids))), Type.boolean
            ),
            _related(a, b, reach),
        )
        for reach, ids in of.items()
    )


def _related(a: str, b: str, reach: Reach | None) -> Bound:
    if reach is None:
        return Value(None, Type.boolean)
    ego = _any(LabelTest(node, EGO) for node in (a, b))
    ways: list[Bound] = []
    if reach.ego:
        close = [_up_to(a, b, reach.ego_within, reach)] if reach.ego_within > 0 else []
        ways.append(_all(ego, *close))
    if reach.within > 0:
        near = _up_to(a, b, reach.within, reach)
        move = [_not(test) for node in (a, b) for test in (_still(node), LabelTest(node, _SIGNAL))]
        further = [_not(ego)] if reach.ego else []
        ways.append(_all(*further, *move, near))
        if reach.static:
            ways.append(_all(*further, _still(a), _still(b), near))
    listed = [
        _all(LabelTest(a, _labelled(one)), LabelTest(b, _labelled(other)))
        for pair in reach.kinds
        for one, other in (pair, pair[::-1])
    ]
    entities = [LabelTest(node, _ENTITY) for node in (a, b)]
    return _all(*entities, *([_any(listed)] if listed else []), _any(ways))


def _labelled(label: str) -> Kinds:
    return EGO if folded(label) == "ego" else ANY.only(frozenset(kinds_labelled(label) or ()))


def _up_to(a: str, b: str, bound: float, reach: Reach) -> Bound:
    """Whether two nodes are no further apart; what has no place is near nothing."""
    limit = Value(bound, Type.number)
    if reach.between == "origins":
        return _any(
            _all(*tests, _no_more(distance, limit)) for tests, distance in _between_origins(a, b)
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
    low = _all(LabelTest(node, _VEHICLE), _not(_still(node)))
    return low if yes else _not(low)


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


def _not(condition: Bound) -> Bound:
    return Operation("NOT", (condition,), Type.boolean)


def _all(*conditions: Bound) -> Bound:
    return conditions[0] if len(conditions) == 1 else Operation("AND", conditions, Type.boolean)


def _any(conditions: Iterable[Bound]) -> Bound:
    found = tuple(conditions)
    if len(found) < 2:
        return found[0] if found else Value(value=False, type=Type.boolean)
    return Operation("OR", found, Type.boolean)
