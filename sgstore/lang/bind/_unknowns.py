"""Conditions that are true if a value of a frame is unknown: its entities exist, but it was not recorded.

A value is *unknown* if a measured quantity (a speed, a size, the weather) was not recorded, or if a relation
was not computed because an entity is beyond the graph. A value that does not exist is not unknown: two
vehicles that move apart have no time to collision.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.bind._in_range import in_traces, related
from sgstore.lang.bind._needed_values import MEASURED, MOTION
from sgstore.lang.bind._world_scope import beyond_graph, bounded_in, holds
from sgstore.lang.catalog import (
    COMPUTED,
    NODE_ATTRIBUTES,
    UNSURE_LANE,
    UNSURE_LEAD,
    DisplayUnit,
    RelationScope,
    Type,
)
from sgstore.model.pair_numbers import WAYS, columns_needed
from sgstore.model.vocabulary import (
    BEYOND,
    DIRECTIONS,
    MAP_ONLY,
    SIDES,
    SIGNALS,
    entity_kinds,
    normalize_name,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.lang.catalog import Attribute

CONNECTIVES: Final = frozenset({"AND", "OR", "NOT", "XOR", "IMPLIES"})
"""Words that join conditions."""

_ANSWERS: Final = frozenset({"IS NULL", "IS NOT NULL", "coalesce", "case"})
"""Operations whose result is known even if an operand is unknown."""

_FLIPPED: Final = {"<": ">=", "<=": ">", ">": "<=", ">=": "<", "=": "<>", "<>": "="}
_TURNED: Final = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
_EVERYWHERE: Final = frozenset({*BEYOND, *MAP_ONLY, "mayAffect"})
"""Relations that are also known between entities outside the scene graphs."""
_OF_PAIRS: Final = frozenset({*DIRECTIONS, *SIDES})
"""Relations that the generator computes for all entity pairs that the settings select."""
_BOX: Final = frozenset({"heading", "length", "width"})
_NONE: Final = frozenset[str]()
_MADE_OF: Final = {
    **dict.fromkeys((*DIRECTIONS, *SIDES), (_NONE, frozenset({"heading"}))),
    **dict.fromkeys(("overlaps", "leads", "follows"), (_BOX, _BOX)),
    "sees": (frozenset({"height"}), _BOX),
    "isIn": (_BOX, _NONE),
}
"""Attributes of the source and of the destination that a relation is computed from: relation → two sets.
Without these attributes, a missing edge is unknown, not false. All other relations count as recorded."""
_CHOSEN: Final = frozenset({"is_primary", "is_own"})
"""Attributes of ``isIn`` edges that depend on the driven lane."""
_FALSE: Final = b.Value(value=False, type=Type.boolean)
_LOOSE: Final = 1 << 20
"""Number added to the number of a pattern in braces for its copy that also includes uncertain matches."""


def unknown(value: b.Bound) -> b.Bound | None:
    """Return a condition: true if the value of an expression is unknown in a frame. None if it never is.

    Parameters
    ----------
    value : Bound
        Value or condition whose entities are in the frame.
    """
    found = list(dict.fromkeys(_unknown(value)))
    return b.any_of(found) if found else None


def has_pairs(value: b.Bound) -> bool:
    """True if an expression uses a number of two entities that may not exist, such as ``ttc(a, b)``."""
    match value:
        case b.PairNumber():
            return True
        case b.SignalCall(word="run_length" | "since_true" | "robustness"):
            return False
        case _:
            return any(map(has_pairs, b.operands_of(value)))


def negated(condition: b.Bound) -> b.Bound:  # noqa: PLR0911 - a case each
    """Return the negation of a condition. ``NOT`` is moved inside every ``AND`` and ``OR``."""
    match condition:
        case b.Operation("NOT", (operand,)):
            return pushed(operand)
        case b.Operation("AND" | "OR" as word, operands):
            other = "OR" if word == "AND" else "AND"
            return replace(condition, word=other, operands=tuple(map(negated, operands)))
        case b.Operation("IMPLIES", (left, right)):
            return b.all_of(pushed(left), negated(right))
        case b.Operation("XOR", operands):
            return negated(spelled_out(operands))
        case b.Operation(word=word) if word in _FLIPPED and (
            has_pairs(condition) or _counted(condition) is not None
        ):
            return replace(condition, word=_FLIPPED[word])
        case b.Value(value=value):
            return replace(condition, value=value is not True)
        case _:
            return b.inverse(condition)


def pushed(condition: b.Bound) -> b.Bound:
    """Return an equivalent condition in which ``NOT`` is inside every ``AND`` and ``OR``."""
    match condition:
        case b.Operation("NOT", (operand,)):
            return negated(operand)
        case b.Operation("AND" | "OR", operands):
            return replace(condition, operands=tuple(map(pushed, operands)))
        case b.Operation("IMPLIES", (left, right)):
            return b.any_of((negated(left), pushed(right)))
        case b.Operation("XOR", operands):
            return pushed(spelled_out(operands))
        case _:
            return condition


def spelled_out(operands: tuple[b.Bound, ...]) -> b.Bound:
    """Return an equivalent of ``XOR`` that uses only ``AND``, ``OR`` and ``NOT``."""
    first, *rest = operands
    for second in rest:
        ways = (
            b.all_of(first, b.inverse(second)),
            b.all_of(b.inverse(first), second),
        )
        first = b.Operation("OR", ways, Type.boolean)
    return first


def certain(  # noqa: PLR0911 - a case each
    condition: b.Bound, *, decided: bool = False
) -> b.Bound:
    """Return a condition that is true if the given one is true for all values of the unknowns.

    A comparison without a value is false. If it compares pair numbers, its negation is false too.

    Parameters
    ----------
    condition : Bound
    decided : bool
        True if unknown values count as values that do not exist.
    """
    again = partial(certain, decided=decided)
    match condition:
        case b.Operation("AND" | "OR", operands):
            return replace(condition, operands=tuple(map(again, operands)))
        case b.BlockValue():
            return condition if decided else _sure(condition)
        case b.Operation("NOT", (operand,)):
            doubt = None if decided else unknown(operand)
            if _of_blocks(operand) or (by_lanes(operand) and not has_pairs(operand)):
                known = b.Operation("coalesce", (operand, _FALSE), Type.boolean)
                return b.inverse(known if doubt is None else b.any_of((known, doubt)))
            if has_pairs(operand):
                guess = doubt if by_lanes(operand) else None
                return condition if guess is None else b.all_of(condition, b.inverse(guess))
            return b.inverse(b.Operation("coalesce", (operand, doubt or _FALSE), Type.boolean))
        case b.Operation() if not decided and _counted(condition) is not None:
            return _of_counts(condition, least=True)
        case b.Operation() if _of_blocks(condition) or by_lanes(condition):
            doubt = None if decided else unknown(condition)
            return condition if doubt is None else b.all_of(condition, b.inverse(doubt))
        case _:
            return condition


def possible(condition: b.Bound) -> b.Bound:
    """Return a condition that is true if the given one is true for at least one value of the unknowns."""
    match condition:
        case b.Operation("AND" | "OR", operands):
            return replace(condition, operands=tuple(map(possible, operands)))
        case b.Operation("NOT", (b.BlockValue() as block,)):
            return b.inverse(_sure(block))  # only certain matches count
        case b.Operation("NOT", (operand,)):
            doubt = unknown(operand)
            return certain(condition) if doubt is None else b.any_of((certain(condition), doubt))
        case b.Operation() if _counted(condition) is not None:
            return _of_counts(condition, least=False)
        case _:
            doubt = unknown(condition)
            return condition if doubt is None else b.any_of((condition, doubt))


def undecided(condition: b.Bound) -> b.Bound | None:
    """Return a condition that is true if the given one is possible, but not certain.

    ``None`` means that it is always known.

    It also holds if the condition is true and one of its parts is unknown.
    """
    doubts = [doubt for part in _smallest(condition) if (doubt := unknown(part)) is not None]
    return b.all_of(b.any_of(dict.fromkeys(doubts)), possible(condition)) if doubts else None


def _smallest(condition: b.Bound) -> Iterable[b.Bound]:
    if isinstance(condition, b.Operation) and condition.word in CONNECTIVES:
        for operand in condition.operands:
            yield from _smallest(operand)
    else:
        yield condition


def _of_blocks(condition: b.Bound) -> bool:
    """True if a condition contains patterns in braces, such as ``EXISTS {…}``."""
    return any(isinstance(part, b.BlockValue) for part in b.walk(condition))


def _is_null(value: b.Bound) -> b.Bound:
    return b.Operation("IS NULL", (value,), Type.boolean)


def _unknown(value: b.Bound) -> Iterable[b.Bound]:  # noqa: C901, PLR0912 - a case each
    match value:
        case b.Operation(word=word, operands=operands) if word in _ANSWERS:
            doubts = [doubt for one in operands if by_lanes(one) for doubt in _unknown(one)]
            yield from [b.all_of(_frame(UNSURE_LEAD), one) for one in doubts]
        case b.Operation(operands=operands):
            for operand in operands:
                yield from _unknown(operand)
        case b.NodeAttribute() | b.FrameAttribute() | b.EdgeAttribute() | b.PairNumber() if (
            by_lanes(value)
        ):
            yield _later(value)
        case b.NodeAttribute(node=node, attribute=attribute):
            if attribute.name in MEASURED:
                yield _unmeasured(node, attribute.name, value)
        case b.PairNumber(function=function, a=one, b=other):
            parts = [
                _unmeasured(node, name, _attribute(node, name))
                for node, names in zip((one, other), columns_needed(function), strict=True)
                for name in sorted((names - {"vy", "ay"}) & MEASURED)
            ]
            if parts:
                yield b.all_of(b.any_of(parts), _is_null(value))
        case b.FrameAttribute(attribute=attribute):
            if attribute.unit in {DisplayUnit.weather, DisplayUnit.clock} or attribute.topic:
                yield _is_null(value)
        case b.Happened(table=()):
            yield _is_null(value)
        case b.BlockValue():
            yield from _of_block(value)
        case _:
            return


def by_lanes(value: b.Bound) -> bool:
    """True if an expression of the online mode depends on the lanes that vehicles choose in junctions."""
    match value:
        case b.NodeAttribute(attribute=attribute, online=True):
            return attribute.unit is DisplayUnit.role
        case b.FrameAttribute(attribute=attribute, online=True):
            return attribute.unit is DisplayUnit.classed
        case b.EdgeAttribute(attribute=attribute, online=True):
            return attribute.name in _CHOSEN
        case b.PairNumber(function=function, online=True):
            return function in WAYS
        case b.BlockValue(scope=scope):
            within = (*scope.where, *([] if value.value is None else [value.value]))
            return any(map(_leads, scope.edges)) or any(map(by_lanes, within))
        case _:
            return any(map(by_lanes, b.operands_of(value)))


def _later(value: b.NodeAttribute | b.FrameAttribute | b.EdgeAttribute | b.PairNumber) -> b.Bound:
    """Return a condition: true if a value depends on a lane that is known only after later frames."""
    match value:
        case b.EdgeAttribute(edge=edge):
            return b.EdgeAttribute(edge, UNSURE_LANE, Type.boolean)
        case b.PairNumber(a=one, b=other):
            nodes = dict.fromkeys((one, other))
            return b.any_of(b.NodeAttribute(node, UNSURE_LANE, Type.boolean) for node in nodes)
        case _:
            return _frame(UNSURE_LANE)


def _leads(edge: b.Edge) -> bool:
    return edge.online and bool(edge.relations & {"leads", "follows"})


def _frame(attribute: Attribute) -> b.Bound:
    return b.FrameAttribute(attribute, Type.boolean)


def without_guesses(query: b.Query) -> b.Query:
    """Return a query of the online mode that skips matches which depend on a lane not known yet."""

    def sure(condition: b.Bound) -> b.Bound:
        if not by_lanes(condition):
            return condition
        if b.is_temporal(condition):
            return b.with_operands(condition, sure)
        least = certain(pushed(condition))
        return b.all_of(condition, b.any_of((b.inverse(_frame(UNSURE_LEAD)), least)))

    def limited(scope: b.Scope) -> b.Scope:
        return replace(scope, where=tuple(map(sure, scope.where)))

    steps = tuple(
        replace(step, scope=limited(step.scope), when=tuple(map(sure, step.when)))
        for step in query.steps
    )
    stages = tuple(
        replace(stage, scope=limited(stage.scope))
        if isinstance(stage, b.MatchStage)
        else replace(stage, where=tuple(map(sure, stage.where)))
        for stage in query.stages
    )
    return replace(query, scope=limited(query.scope), steps=steps, stages=stages)


def _attribute(node: str, name: str) -> b.Bound:
    attribute = NODE_ATTRIBUTES[normalize_name(name)]
    return b.NodeAttribute(node, attribute, attribute.type)


def _unmeasured(node: str, name: str, value: b.Bound) -> b.Bound:
    """Return a condition: true if a measured attribute of a node, such as its speed, was not recorded."""
    if name not in MOTION:
        return _is_null(value)
    still = b.Operation("coalesce", (_attribute(node, "is_static"), _FALSE), Type.boolean)
    return b.all_of(_is_null(value), b.inverse(still))


@lru_cache(maxsize=1024)
def _of_block(block: b.BlockValue) -> tuple[b.Bound, ...]:
    """Return conditions that are true if a pattern in braces has a match that depends on unknown values.

    The result is cached.
    """
    where = tuple(map(pushed, block.scope.where))
    doubts = [one for part in where for leaf in _smallest(part) for one in _unknown(leaf)]
    if block.value is not None:
        doubts += _unknown(block.value)
    found: list[b.Bound] = []
    if doubts:
        wanted = (*map(possible, where), b.any_of(dict.fromkeys(doubts)))
        found.append(_exists(block, block.scope.edges, wanted, _LOOSE))
    beyond = _of_apart(block)
    return (*found, beyond) if beyond is not None else tuple(found)


def _of_apart(block: b.BlockValue) -> b.Bound | None:
    """Return a condition: true if ``{…}`` may match with an edge that was not computed; None if never."""
    apart = {edge.key: one for edge in block.scope.edges if (one := _not_computed(edge, block))}
    if not apart:
        return None
    rest = tuple(edge for edge in block.scope.edges if edge.key not in apart)
    where = map(pushed, block.scope.where)
    told = (one for one in where if not _edges_of(one) & apart.keys())
    wanted = (*map(possible, told), b.any_of(dict.fromkeys(apart.values())))
    return _exists(block, rest, wanted, 2 * _LOOSE)


@lru_cache(maxsize=1024)
def _sure(block: b.BlockValue) -> b.BlockValue:
    """Return a copy of ``EXISTS {…}`` or ``COUNT {…}`` that counts only matches without unknown values."""
    doubted = any(_of_blocks(one) and unknown(one) is not None for one in block.scope.where)
    loose = [
        b.inverse(b.any_of(doubts))
        for edge in block.scope.edges
        if "isIn" in edge.relations
        and "off_road" in block.scope.kinds(edge.dst).every
        and (doubts := [*_unmeasured_ends(edge, block.scope)])
    ]  # a body with a size may reach onto a road although its centre does not
    if block.word not in {"EXISTS", "COUNT"} or not (loose or doubted):
        return block
    where = tuple(certain(pushed(one)) for one in block.scope.where)
    scope = replace(block.scope, where=(*where, *loose))
    return replace(block, scope=scope, number=block.number + 3 * _LOOSE)


def _exists(
    block: b.BlockValue, edges: tuple[b.Edge, ...], where: tuple[b.Bound, ...], number: int
) -> b.Bound:
    """Return an ``EXISTS {…}`` made from a pattern in braces, but with the given edges and conditions."""
    asked = frozenset().union(*({edge.src, edge.dst} for edge in edges), *map(b.nodes_of, where))
    nodes = {key: node for key, node in block.scope.nodes.items() if key in asked}
    if not nodes and not edges:
        return b.all_of(*where)
    distinct = (
        pair
        for pair in block.scope.distinct
        if not {*pair} & block.scope.nodes.keys() - nodes.keys()
    )
    scope = replace(
        block.scope, nodes=nodes, edges=edges, where=where, distinct=frozenset(distinct)
    )
    return replace(
        block,
        word="EXISTS",
        scope=scope,
        value=None,
        type=Type.boolean,
        number=block.number + number,
    )


def _counted(condition: b.Bound) -> tuple[list[b.BlockValue], str, b.Value] | None:
    """Split a comparison such as ``COUNT {…} > 2`` into patterns, operator and number; None for others."""
    match condition:
        case b.Operation(word, (counts, b.Value(value=int() | float()) as limit)):
            pass
        case b.Operation(word, (b.Value(value=int() | float()) as limit, counts)):
            word = _TURNED.get(word, word)
        case _:
            return None
    blocks = _summands(counts)
    return (blocks, word, limit) if word in _FLIPPED and blocks else None


def _summands(value: b.Bound) -> list[b.BlockValue]:
    match value:
        case b.BlockValue(word="COUNT"):
            return [value]
        case b.Operation("+", (one, other)) if (first := _summands(one)) and (
            rest := _summands(other)
        ):
            return [*first, *rest]
        case _:
            return []


def _of_counts(condition: b.Operation, *, least: bool) -> b.Bound:
    """Return a condition: true if ``COUNT {…} > 2`` is certainly true (``least``), or possibly true."""
    found = _counted(condition)
    assert found is not None  # noqa: S101 - it was asked before
    blocks, word, limit = found
    doubt = unknown(condition)
    if doubt is None:
        return condition
    if not all(map(_can_be_counted, blocks)):
        return b.all_of(condition, b.inverse(doubt)) if least else b.any_of((condition, doubt))
    low, high = _total(map(_sure, blocks)), _total(m for one in blocks for m in _all_of(one))
    ways = {
        "=": ((low, "="), (high, "=")) if least else ((low, "<="), (high, ">=")),
        "<>": ((low, ">"), (high, "<")) if least else ((low, "<>"), (high, "<>")),
    }
    if word not in ways:
        value = low if (word in {">", ">="}) == least else high
        return b.Operation(word, (value, limit), Type.boolean)
    parts = [b.Operation(how, (value, limit), Type.boolean) for value, how in ways[word]]
    return b.all_of(*parts) if word == "=" else b.any_of(parts)


def _can_be_counted(block: b.BlockValue) -> bool:
    """True if the possible matches of a pattern in braces can be counted by its nodes alone."""
    beyond = _of_apart(block)
    told = not any(edge.named for edge in block.scope.edges)
    return beyond is None or (told and isinstance(beyond, b.BlockValue))


def _total(blocks: Iterable[b.BlockValue]) -> b.Bound:
    first, *rest = blocks
    found: b.Bound = first
    for one in rest:
        found = b.Operation("+", (found, one), Type.number)
    return found


def _all_of(block: b.BlockValue) -> Iterable[b.BlockValue]:
    """Yield patterns in braces that together have all possible matches of the given pattern."""
    where = tuple(possible(pushed(part)) for part in block.scope.where)
    scope = replace(block.scope, where=where)
    yield replace(block, scope=scope, number=block.number + 8 * _LOOSE)
    beyond = _of_apart(block)
    if isinstance(beyond, b.BlockValue):
        yield replace(beyond, word="COUNT", type=Type.number, number=block.number + 16 * _LOOSE)


def _edges_of(condition: b.Bound) -> frozenset[str]:
    parts = (part for part in b.walk(condition))
    return frozenset(p.edge for p in parts if isinstance(p, b.EdgeRelation | b.EdgeAttribute))


def _not_computed(edge: b.Edge, block: b.BlockValue) -> b.Bound | None:
    """Return a condition that is true if an edge inside ``{…}`` was not computed; None if never."""
    found = [*_beyond(edge, block.scope), *_unmeasured_ends(edge, block.scope), *_unsure(edge)]
    return b.any_of(found) if found else None


def _unsure(edge: b.Edge) -> Iterable[b.Bound]:
    """Yield conditions that are true if an edge depends on a driven lane that later frames decide."""
    if not _leads(edge):
        return
    if edge.high > 1:
        yield _frame(UNSURE_LEAD)
        return
    behind = {"leads": edge.dst, "follows": edge.src}
    ends = {behind[name] for name in behind.keys() & edge.relations}
    for node in sorted(ends | ({edge.src, edge.dst} if edge.both else set())):
        yield b.NodeAttribute(node, UNSURE_LEAD, Type.boolean)


def _beyond(edge: b.Edge, scope: b.Scope) -> Iterable[b.Bound]:
    """Yield a condition that is true if an edge was not computed, as a node is outside the scene graph.

    A relation does not hold between entities that the settings do not relate. A distance relation does not
    hold beyond its distance.
    """
    names = edge.relations - _EVERYWHERE
    ends = [scope.kinds(key).every & entity_kinds() for key in (edge.src, edge.dst)]
    if not edge.beyond or not names or not all(ends):
        return
    away = beyond_graph(edge)
    if edge.high > 1 or names - _OF_PAIRS - bounded_in(edge.beyond):
        yield away
    elif not names & _OF_PAIRS:
        yield b.all_of(away, holds(edge, names))
    else:
        yield b.all_of(away, in_traces(edge.beyond, lambda reach: _related(edge, reach)))


def _related(edge: b.Edge, reach: RelationScope | None) -> b.Bound:
    return related(edge.src, edge.dst, reach or RelationScope())


def _unmeasured_ends(edge: b.Edge, scope: b.Scope) -> Iterable[b.Bound]:
    """Yield conditions that are true if an edge may be missing because a measured value is missing."""
    for forward in (True, False) if edge.both else (True,):
        for end, key in enumerate((edge.src, edge.dst) if forward else (edge.dst, edge.src)):
            every = scope.kinds(key).every
            names = frozenset().union(*(_MADE_OF[n][end] for n in edge.relations & _MADE_OF.keys()))
            bodies = entity_kinds() - frozenset(SIGNALS)
            if not names or not every & bodies:
                continue
            parts = [_is_null(_attribute(key, name)) for name in sorted(names)]
            computed: b.Bound = b.TraceAttribute(COMPUTED, Type.boolean)
            if not every <= bodies:
                computed = b.all_of(computed, b.LabelTest(key, b.any_kinds().only(bodies)))
            yield b.all_of(b.any_of(parts), computed)
