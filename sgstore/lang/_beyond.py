"""Distance relations of entities beyond the graph, by their definition.

A graph has edges between its own entities only. The rungs of ``[proximity]`` and ``overlaps`` are defined by
places and sizes, which are also known beyond the graph. In scope ``world`` a block with such an edge is
therefore evaluated twice: with the edge, and with its definition for pairs that are not both in the graph. No
match is in both results, so their counts add up.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang._catalog import IN_GRAPH, NODE_ATTRIBUTES, RelationScope, Type
from sgstore.lang._horizon import LINKS
from sgstore.lang._needs import bounded, in_traces
from sgstore.vocabulary import DIRECTIONS, PROXIMITY, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

_MOST: Final = 3
"""Edges in braces that are evaluated so: each set of them is one more query.

With more edges, a check is unknown and a pattern matches within the graph.
"""

_SIDES: Final = 10.0
"""Half lengths of two bodies together: the distance of centres is greater than that of edges; m."""


def beyond_graph(edge: b.Edge) -> b.Bound:
    """Return the condition that the ends of an edge are two, and not both in the graph."""
    keys = edge.src, edge.dst
    two = b.Operation("<>", tuple(map(b.NodeValue, keys)), Type.boolean)
    ends = (b.NodeAttribute(key, IN_GRAPH, Type.boolean) for key in keys)
    return b.all_of(two, b.any_of(map(b.inverse, ends)))


def whole_block(block: b.BlockValue, number: int) -> b.Bound:
    """Return a block that includes pairs beyond the graph.

    Parameters
    ----------
    block : BlockValue
        Has the edges that were computed.
    number : int
        The first number that no block has yet.
    """
    edges = [edge for edge in block.scope.edges if _is_told(edge, block)]
    if not edges or len(edges) > _MOST or block.word not in _JOINED:
        return block
    told = {edge.key for edge in edges}
    computed = [replace(e, beyond=()) if e.key in told else e for e in block.scope.edges]
    block = replace(block, scope=replace(block.scope, edges=tuple(computed)))
    blocks = [block]
    for many in range(1, len(edges) + 1):
        for some in combinations(edges, many):
            blocks.append(_defined(block, some, number))
            number += 1
    return _JOINED[block.word](blocks)


def _is_told(edge: b.Edge, block: b.BlockValue) -> bool:
    """Return true if an edge beyond the graph follows from its definition."""
    if edge.high > 1 or edge.named or not edge.beyond:
        return False
    kinds = [block.scope.kinds(key) for key in (edge.src, edge.dst)]
    if not all(one.every & entity_kinds() for one in kinds):
        return False
    scopes = [reach for reach, _ in edge.beyond]
    known = [reach for reach in scopes if reach is not None]
    if len(known) < len(scopes):
        return False
    if edge.relations - bounded_in(edge.beyond):
        return False
    # Who is as near to the ego is in the graph.
    of_ego = any(not one.other for one in kinds)
    return not (of_ego and all(_reach(edge, reach) <= reach.radius for reach in known))


def bounded_in(scopes: b.Scopes) -> frozenset[str]:
    """Return the relations that end at some distance; a trace without such a rung has none."""
    rungs = (name for reach, _ in scopes if reach is not None for name, _ in reach.rungs)
    return frozenset({"overlaps", *PROXIMITY, *rungs}) - frozenset(DIRECTIONS)


def _reach(edge: b.Edge, reach: RelationScope) -> float:
    limits = (high for name, high in reach.rungs if name in edge.relations)
    return max(limits, default=0.0) + _SIDES


def _defined(block: b.BlockValue, edges: tuple[b.Edge, ...], number: int) -> b.BlockValue:
    """The block of pairs beyond the graph that have some edges by their definition."""
    told = {edge.key for edge in edges}
    where = [*block.scope.where]
    for edge in edges:
        where += [beyond_graph(edge), holds(edge, edge.relations)]
    rest = tuple(edge for edge in block.scope.edges if edge.key not in told)
    return replace(block, scope=replace(block.scope, edges=rest, where=tuple(where)), number=number)


def looks_less(check: b.BoundCheck, ego: b.Node) -> b.BoundCheck:
    """Return a check in which an entity farther away than its limit is absent.

    Parameters
    ----------
    check : BoundCheck
        With a limit.
    ego : Node
        Added to its nodes if it has no ego.
    """
    assert check.limit is not None  # noqa: S101 - it has one
    own = [key for key, node in check.scope.nodes.items() if not node.kinds.other]
    nodes = check.scope.nodes if own else {**check.scope.nodes, ego.key: ego}
    limited = partial(_limited, ego=nodes[own[0] if own else ego.key], limit=check.limit)
    quantifiers = tuple(
        replace(one, where=one.where and limited(one.where)) for one in check.quantifiers
    )
    return replace(
        check,
        scope=replace(check.scope, nodes=nodes),
        quantifiers=quantifiers,
        formula=limited(check.formula),
        reset=check.reset and limited(check.reset),
    )


def _limited(value: b.Bound, ego: b.Node, limit: float) -> b.Bound:
    """Return a value whose braces match no entity farther from the ego than the limit."""
    again = partial(_limited, ego=ego, limit=limit)
    if not isinstance(value, b.BlockValue):
        return b.with_operands(value, again)
    scope = value.scope
    own = [key for key, node in scope.nodes.items() if is_limited(node)]
    where = [*map(again, scope.where), *(within(key, ego.key, limit) for key in own)]
    outer = (
        {**scope.outer, ego.key: ego.kinds} if own and ego.key not in scope.nodes else scope.outer
    )
    scope = replace(scope, outer=outer, where=tuple(where))
    return replace(value, scope=scope, value=value.value and again(value.value))


def is_limited(node: b.Node) -> bool:
    """Tell whether a node may be an entity that is not the ego."""
    return bool(node.kinds.other & entity_kinds())


def within(key: str, ego: str, limit: float) -> b.Bound:
    """Return the condition that the footprint of a node is no farther from the ego's centre than a limit.

    A node without a place, or one of the map, counts as near.
    """

    def number(name: str) -> b.Bound:
        half = b.NodeAttribute(key, NODE_ATTRIBUTES[name], Type.number)
        known = b.Operation("coalesce", (half, b.Value(0.0, Type.number)), Type.number)
        return b.Operation("/", (known, b.Value(2.0, Type.number)), Type.number)

    def beside(function: str, size: str) -> b.Bound:
        away = b.Operation("abs", (b.PairNumber(function, key, ego),), Type.number)
        past = b.Operation("-", (away, number(size)), Type.number)
        out = b.Operation("max", (past, b.Value(0.0, Type.number)), Type.number)
        return b.Operation("*", (out, out), Type.number)

    square = b.Operation("+", (beside("lon", "length"), beside("lat", "width")), Type.number)
    near = b.Operation("<=", (square, b.Value(limit * limit, Type.number)), Type.boolean)
    return b.Operation("coalesce", (near, b.Value(value=True, type=Type.boolean)), Type.boolean)


def holds(edge: b.Edge, names: Iterable[str]) -> b.Bound:
    """Return the condition that an edge has one of some relations by their definition.

    If the settings of a trace are not known: the condition that it may have one.
    """
    among = frozenset(names)

    def of_scope(reach: RelationScope | None) -> b.Bound:
        if reach is not None:
            return bounded(edge.src, edge.dst, among, reach)
        limit = b.Value(
            max((LINKS.get(name, math.inf) for name in among), default=0.0), Type.number
        )
        apart = b.PairNumber("dist", edge.src, edge.dst)
        return b.Operation("<=", (apart, limit), Type.boolean)

    return in_traces(edge.beyond, of_scope)


def _sum(blocks: list[b.BlockValue]) -> b.Bound:
    found: b.Bound = blocks[0]
    for one in blocks[1:]:
        found = b.Operation("+", (found, one), Type.number)
    return found


def _extreme(word: str, blocks: list[b.BlockValue]) -> b.Bound:
    found: b.Bound = blocks[0]
    for one in blocks[1:]:
        both = b.Operation(word, (found, one), Type.number)
        found = b.Operation("coalesce", (both, found, one), Type.number)
    return found


_JOINED: Final[Mapping[str, Callable[[list[b.BlockValue]], b.Bound]]] = {
    "EXISTS": b.any_of,
    "COUNT": _sum,
    "MIN": lambda blocks: _extreme("min", blocks),
    "MAX": lambda blocks: _extreme("max", blocks),
}
"""What a block is, made of those that have its matches."""
