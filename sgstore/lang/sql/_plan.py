"""Query plan: sorts conditions into the two SQL phases, bit masks and single frames.

The first phase works on bit masks, the second on single frames. A node that only the second phase needs is
bound there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from sgstore.base.quoting import quoted
from sgstore.lang.bind import Profile
from sgstore.lang.catalog import DisplayUnit
from sgstore.lang.ir import (
    BlockValue,
    Bound,
    EdgeAttribute,
    EdgeRelation,
    Happened,
    NodeAttribute,
    NodeValue,
    Operation,
    Query,
    Scope,
    TraceAttribute,
    blocks_of,
    nodes_of,
    same_chain,
    walk,
)
from sgstore.lang.sql._expressions import Leaf, leaves
from sgstore.lang.sql._rewrite import counted_block, is_lasting, stands_alone
from sgstore.lang.sql._select import Select, nested

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import FrameAttribute
    from sgstore.lang.sql._windows import Window


@dataclass(frozen=True, slots=True)
class Gathered:
    """Temporary table of matches that were computed outside the database.

    Attributes
    ----------
    name : str
    types : mapping of str to str
        Database type of each column.
    block : function
        Function that returns the columns of the matches in a window of whole traces.
    """

    name: str
    types: Mapping[str, str]
    block: Callable[[Window | None], list[list[Any]]]


@dataclass(frozen=True, slots=True)
class SharedRelation:
    """Shared subquery of an SQL statement. It has bit masks of frames, or computed matches.

    Attributes
    ----------
    name : str
    nodes, edges : frozenset of str
        Keys bound by the relation.
    told : mapping of FrameAttribute to str
        Extra values and their columns.
    runs : bool
        True if a row stands for all frames from ``first`` to ``last`` of a bucket, instead of for one frame.
    """

    name: str
    nodes: frozenset[str]
    edges: frozenset[str]
    told: Mapping[FrameAttribute, str] = field(default_factory=dict["FrameAttribute", str])
    runs: bool = False

    def frames(self, alias: str) -> str:
        """Return the subquery as text for ``FROM``, with one row per frame."""
        if not self.runs:
            return f"{quoted(self.name)} AS {quoted(alias)}"
        every = ['unnest(range("first", "last" + 1)) AS "frame_id"', '* EXCLUDE ("first", "last")']
        return nested(Select(every, [quoted(self.name)]).text(), alias)


@dataclass(slots=True)
class Phases:
    """Conditions of a graph pattern, grouped by the part of the SQL that tests them.

    Attributes
    ----------
    blocks : list
        ``EXISTS``, ``NOT EXISTS`` and comparisons of ``COUNT`` with a number: evaluated by masks.
    single : dict
        Conditions on attributes of a single node, by node: evaluated by masks.
    lane : dict
        Conditions on attributes of a single edge, by edge: evaluated by masks.
    mates : list of (str, str)
        Lanes that must have one chain: evaluated in the join of the edges.
    direct : list
        Conditions on node ids, relations and constants: evaluated in the join of the edges.
    alone : list of BlockValue
        Blocks that become their own relations and are joined as edges.
    happened : list of Happened
        Required events: joined as edges.
    trace : list
        Conditions on the trace: evaluated for the bucket.
    rest : list
        Conditions evaluated in the second phase.
    late : set of str
        Nodes bound in the second phase.
    empty : bool
        True if the first phase has no conditions.
    """

    blocks: list[Bound] = field(default_factory=list[Bound])
    single: dict[str, list[Bound]] = field(default_factory=dict[str, list[Bound]])
    lane: dict[str, list[Bound]] = field(default_factory=dict[str, list[Bound]])
    mates: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    direct: list[Bound] = field(default_factory=list[Bound])
    alone: list[BlockValue] = field(default_factory=list[BlockValue])
    happened: list[Happened] = field(default_factory=list[Happened])
    trace: list[Bound] = field(default_factory=list[Bound])
    rest: list[Bound] = field(default_factory=list[Bound])
    late: set[str] = field(default_factory=set[str])
    empty: bool = False


def phases_of(scope: Scope, query: Query, catalog: Catalog) -> Phases:
    """Group the conditions of a pattern by the phase that tests them: on bit masks of frames, or per frame."""
    parts = Phases()
    for condition in scope.where:
        if stands_alone(condition, catalog):
            parts.alone.append(condition)
        else:
            _file(condition, parts, scope, catalog)
    parts.late = set(_late(scope, parts, query, catalog))
    for key in parts.late & set(parts.single):
        parts.rest += parts.single.pop(key)
    parts.rest += [c for c in parts.direct if nodes_of(c) & parts.late]
    parts.direct = [c for c in parts.direct if not nodes_of(c) & parts.late]
    tied = scope.outer or scope.edges or parts.blocks or parts.happened or parts.alone
    first = tied or set(scope.nodes) - parts.late
    parts.empty = bool(parts.late) and not first
    if parts.empty:
        parts.rest += parts.trace + parts.direct
        parts.trace, parts.direct = [], []
    return parts


def _file(condition: Bound, parts: Phases, scope: Scope, catalog: Catalog) -> None:
    if is_masked(condition):
        parts.blocks.append(condition)
        return
    if isinstance(condition, Happened):
        parts.happened.append(condition)
        return
    mates = [*same_chain((condition,))]
    if mates and set(mates[0]) <= {key for edge in scope.edges for key in (edge.src, edge.dst)}:
        parts.mates += mates
        return
    found = set(leaves(condition))
    if all(_is_direct(leaf) for leaf in found):
        parts.direct.append(condition)
    elif any(
        isinstance(leaf, NodeAttribute | EdgeAttribute)
        and leaf.attribute.unit in {DisplayUnit.role, DisplayUnit.own, DisplayUnit.inside}
        for leaf in found
    ):
        parts.rest.append(condition)
    elif all(isinstance(leaf, NodeAttribute) for leaf in found) and len(nodes_of(condition)) == 1:
        parts.single.setdefault(next(iter(nodes_of(condition))), []).append(condition)
    elif all(isinstance(leaf, TraceAttribute) for leaf in found):
        parts.trace.append(condition)
    elif (edge := _edge_alone(found, scope, catalog)) is not None and not _of_null(condition):
        parts.lane.setdefault(edge, []).append(condition)
    else:
        parts.rest.append(condition)


def is_masked(condition: Bound) -> bool:
    """True if a condition is ``EXISTS {…}``, ``NOT EXISTS {…}`` or ``COUNT {…}`` compared with a number."""
    match condition:
        case BlockValue(word="EXISTS") | Operation("NOT", (BlockValue(word="EXISTS"),)):
            return True
        case _:
            return counted_block(condition) is not None


def _is_direct(leaf: Leaf) -> bool:
    match leaf:
        case NodeValue() | EdgeRelation():
            return True
        case NodeAttribute(attribute=attribute):
            return attribute.unit is DisplayUnit.binding
        case _:
            return False


def _edge_alone(found: set[Leaf], scope: Scope, catalog: Catalog) -> str | None:
    """If a condition uses only one edge and its lane, return the key of this edge; otherwise None."""
    edges = {leaf.edge for leaf in found if isinstance(leaf, EdgeAttribute)}
    if len(edges) != 1:
        return None
    (key,) = edges
    ends = {
        edge.dst for edge in scope.edges if edge.key == key and edge.high == 1 and not edge.both
    }
    for leaf in found:
        if isinstance(leaf, EdgeAttribute):
            continue
        if not isinstance(leaf, NodeAttribute) or leaf.node not in ends or _is_direct(leaf):
            return None
        profile = Profile.of(scope.kinds(leaf.node), catalog)
        if not (profile.mapped and profile.places == 1):
            return None
    return key


def _of_null(condition: Bound) -> bool:
    """True if a condition may be true where a row is missing: it contains ``IS NULL`` or similar."""
    return any(
        isinstance(part, Operation) and part.word in {"IS NULL", "IS NOT NULL", "coalesce", "case"}
        for part in walk(condition)
    )


def _late(scope: Scope, parts: Phases, query: Query, catalog: Catalog) -> Iterator[str]:
    """Yield nodes without edges that SQL joins only in single frames, not as bit masks.

    Otherwise, all states would be grouped into masks and then expanded again.
    """
    bound_nodes = {key for edge in scope.edges for key in (edge.src, edge.dst)}
    bound_nodes |= {key for one in parts.happened for key in one.nodes}
    compared = {key for condition in parts.rest for key in nodes_of(condition)}
    whole = scope is query.scope
    alone = whole and len(scope.nodes) == 1
    if whole:
        told = (leaf for value in query.result.values for leaf in leaves(value))
        fleeting = (leaf for leaf in told if not is_lasting(leaf, scope, catalog))
        compared |= {key for leaf in fleeting for key in nodes_of(leaf)}
    spoken_of = blocked(query)
    for key in scope.nodes:
        profile = Profile.of(scope.kinds(key), catalog)
        if profile.fixed or profile.mapped or key in bound_nodes or key in spoken_of:
            continue
        if alone or key in compared:
            yield key


def blocked(query: Query) -> frozenset[str]:
    """Return the nodes of outer patterns that patterns in braces of a query use."""
    return frozenset(_blocked((*query.scope.where, *query.result.values)))


def _blocked(expressions: tuple[Bound, ...]) -> Iterator[str]:
    for expression in expressions:
        for block in blocks_of(expression):
            yield from block.scope.outer
            yield from _blocked(block.inside)


def traces_of(query: Query, catalog: Catalog) -> tuple[set[int] | None, set[int]]:
    """Return the ids of the selected traces (None for all), and of the traces that lack needed data."""
    chosen = None
    if query.ego is not None:
        chosen = {trace.trace_id for trace in catalog.traces if trace.ego == query.ego}
    if catalog.only is not None:
        chosen = set(catalog.only) if chosen is None else chosen & catalog.only
    left: set[int] = set()
    if not query.unknown_is_false:
        left = {t.trace_id for t in catalog.traces if not query.relations <= t.answers}
        left |= catalog.unknowing
    return (None if chosen is None else chosen - left), left


def apart(scope: Scope, nodes: set[str], new: set[str]) -> Iterator[tuple[str, str]]:
    """Yield the pairs of nodes that must differ, for pairs with a node that this join adds.

    Pairs with disjoint kinds differ anyway and are omitted.
    """
    for a, b in sorted(scope.distinct):
        if {a, b} <= nodes and {a, b} & new:
            one, other = scope.kinds(a), scope.kinds(b)
            if (one & other).every:
                yield a, b
