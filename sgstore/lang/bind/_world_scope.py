"""Distance relations of entities outside the scene graph of a frame, computed from their positions.

A graph has edges between its own entities only. The distance relations of ``[proximity]`` and ``overlaps``
are defined by positions and sizes, which are also known beyond the graph. In scope ``world`` a block with
such an edge is
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
from sgstore.lang.bind._horizon import LINKS
from sgstore.lang.bind._in_range import bounded, in_traces
from sgstore.lang.catalog import IN_GRAPH, NODE_ATTRIBUTES, RelationScope, Type
from sgstore.model.vocabulary import DIRECTIONS, PROXIMITY, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

_MOST: Final = 3
"""Largest number of edges in braces that are also computed outside the graph. Each subset of them adds a query.
Above this number, a check is unknown, and a pattern matches within the graph only."""

_SIDES: Final = 10.0
"""Extra distance between the centres of two bodies, compared with their edges: sum of the half lengths; m."""


def beyond_graph(edge: b.Edge) -> b.Bound:
    """Return a condition that is true if the nodes of an edge differ and are not both in the graph."""
    keys = edge.src, edge.dst
    two = b.Operation("<>", tuple(map(b.NodeValue, keys)), Type.boolean)
    ends = (b.NodeAttribute(key, IN_GRAPH, Type.boolean) for key in keys)
    return b.all_of(two, b.any_of(map(b.inverse, ends)))


def whole_block(block: b.BlockValue, number: int) -> b.Bound:
    """Return an expression that extends a pattern in braces to entities outside the scene graph.

    Parameters
    ----------
    block : BlockValue
        Block that covers only edges in the graph.
    number : int
        First unused block number.
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
    """True if distances suffice to compute the relation of an edge outside the scene graph."""
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
    # Entities within this distance of the ego are in the graph.
    of_ego = any(not one.other for one in kinds)
    return not (of_ego and all(_reach(edge, reach) <= reach.radius for reach in known))


def bounded_in(scopes: b.Scopes) -> frozenset[str]:
    """Return the names of the relations that have a distance limit in the settings of some traces."""
    rungs = (name for reach, _ in scopes if reach is not None for name, _ in reach.rungs)
    return frozenset({"overlaps", *PROXIMITY, *rungs}) - frozenset(DIRECTIONS)


def _reach(edge: b.Edge, reach: RelationScope) -> float:
    limits = (high for name, high in reach.rungs if name in edge.relations)
    return max(limits, default=0.0) + _SIDES


def _defined(block: b.BlockValue, edges: tuple[b.Edge, ...], number: int) -> b.BlockValue:
    """Return a copy of a pattern in braces in which conditions on distances replace some edges."""
    told = {edge.key for edge in edges}
    where = [*block.scope.where]
    for edge in edges:
        where += [beyond_graph(edge), holds(edge, edge.relations)]
    rest = tuple(edge for edge in block.scope.edges if edge.key not in told)
    return replace(block, scope=replace(block.scope, edges=rest, where=tuple(where)), number=number)


def looks_less(check: b.BoundCheck, ego: b.Node) -> b.BoundCheck:
    """Return a copy of a check that uses only entities within the range of the check around the ego.

    Parameters
    ----------
    check : BoundCheck
        Check with a limit.
    ego : Node
        Node to add if the check has no ego.
    """
    assert check.limit is not None  # noqa: S101 - required by the caller
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
    """Return an expression. Its patterns in braces match only entities within a distance of the ego."""
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
    """True if a node can be an entity other than the ego, so that the distance limit applies to it."""
    return bool(node.kinds.other & entity_kinds())


def within(key: str, ego: str, limit: float) -> b.Bound:
    """Return a condition: true if the footprint of a node is within a distance of the ego's centre.

    A node without a position, and a part of the map, count as near.
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
    """Return a condition: true if the nodes of an edge meet the definition of one of the given relations.

    For a trace with unknown settings: the condition that the edge may have one of them.
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
"""Ways to combine the results of patterns without common matches: first word of the pattern → function."""
