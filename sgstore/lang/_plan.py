"""The query plan: which condition is answered in which phase, and the order of rows.

The first phase works on bit masks, the second on single frames. A node that only the second one needs waits
for it.
"""

from __future__ import annotations

from dataclasses import field
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang._catalog import DisplayUnit
from sgstore.lang._formulas import Leaf, Select, leaves, nested
from sgstore.lang._kinds import Profile
from sgstore.lang._rewrite import counted_block, is_lasting, stands_alone
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
    walk,
)
from sgstore.quoting import quoted
from sgstore.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.lang._catalog import Catalog
    from sgstore.lang._formulas import BoundValues
    from sgstore.lang.ir import FrameAttribute


@dataclass(frozen=True, slots=True)
class Window:
    """A range of buckets: ``low`` is in it, ``high`` is not; with ``traces``, only those of these traces."""

    low: int
    high: int
    traces: tuple[int, ...] | None = None

    @classmethod
    def of(cls, extents: Sequence[tuple[int, int]]) -> Window:
        """The window of whole traces, or of a part of one, by first bucket and number of buckets of each."""
        low, high = min(first for first, _ in extents), max(first + many for first, many in extents)
        traces = tuple(first >> TRACE_OF_BUCKET for first, _ in extents)
        return cls(low, high, traces if len(traces) > 1 else None)

    def whole(self, extents: Iterable[tuple[int, int]]) -> Window:
        """The same as a range alone, if no other of all extents, such as are given, begins in it."""
        if self.traces is None:
            return self
        many = sum(self.low <= first < self.high for first, _ in extents)
        return Window(self.low, self.high) if many == len(self.traces) else self

    def __contains__(self, bucket: int) -> bool:
        inside = self.low <= bucket < self.high
        return inside and (self.traces is None or bucket >> TRACE_OF_BUCKET in self.traces)


@dataclass(frozen=True, slots=True)
class Gathered:
    """A table that a statement speaks of and the store has not: what was found otherwise.

    Attributes
    ----------
    name : str
    types : mapping of str to str
        The type of each column in the database.
    block : function
        The columns of what is found in a window of whole traces.
    """

    name: str
    types: Mapping[str, str]
    block: Callable[[Window | None], list[list[Any]]]


@dataclass(frozen=True, slots=True)
class SharedRelation:
    """A shared relation: of the first phase, or, of matches that are known, one row a frame and match.

    Attributes
    ----------
    name : str
    nodes, edges : frozenset of str
        What it binds.
    told : mapping of FrameAttribute to str
        Values that it has beside them, and their columns.
    runs : bool
        Whether a row is of all frames of a bucket from ``first`` to ``last``, rather than of one.
    """

    name: str
    nodes: frozenset[str]
    edges: frozenset[str]
    told: Mapping[FrameAttribute, str] = field(default_factory=dict["FrameAttribute", str])
    runs: bool = False

    def frames(self, alias: str) -> str:
        """The relation with a row for each frame, as ``FROM`` takes it."""
        if not self.runs:
            return f"{quoted(self.name)} AS {quoted(alias)}"
        every = ['unnest(range("first", "last" + 1)) AS "frame_id"', '* EXCLUDE ("first", "last")']
        return nested(Select(every, [quoted(self.name)]).text(), alias)


@dataclass(slots=True)
class Phases:
    """The conditions of a scope by how they are answered.

    Attributes
    ----------
    blocks : list
        ``EXISTS``, ``NOT EXISTS`` and comparisons of ``COUNT`` with a number: by masks.
    single : dict
        Node → conditions on its attributes alone: by masks.
    lane : dict
        Edge → conditions on its attributes alone: by masks.
    direct : list
        On node ids, relations and constants: where the edges are joined.
    alone : list of BlockValue
        Blocks that are relations of their own: joined as edges are.
    happened : list of Happened
        What must have happened: joined as edges are.
    trace : list
        On the trace alone: on the bucket.
    rest : list
        In the second phase.
    late : set of str
        Nodes that are bound in the second phase.
    empty : bool
        Whether the first phase has nothing to say.
    """

    blocks: list[Bound] = field(default_factory=list[Bound])
    single: dict[str, list[Bound]] = field(default_factory=dict[str, list[Bound]])
    lane: dict[str, list[Bound]] = field(default_factory=dict[str, list[Bound]])
    direct: list[Bound] = field(default_factory=list[Bound])
    alone: list[BlockValue] = field(default_factory=list[BlockValue])
    happened: list[Happened] = field(default_factory=list[Happened])
    trace: list[Bound] = field(default_factory=list[Bound])
    rest: list[Bound] = field(default_factory=list[Bound])
    late: set[str] = field(default_factory=set[str])
    empty: bool = False


def phases_of(scope: Scope, query: Query, catalog: Catalog) -> Phases:
    """The conditions of a scope, filed."""
    parts = Phases()
    for condition in scope.where:
        if stands_alone(condition, catalog):
            parts.alone.append(condition)
        else:
            _file(condition, parts)
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


def _file(condition: Bound, parts: Phases) -> None:
    if is_masked(condition):
        parts.blocks.append(condition)
        return
    if isinstance(condition, Happened):
        parts.happened.append(condition)
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
    elif (edge := _edge_alone(found)) is not None and not _of_null(condition):
        parts.lane.setdefault(edge, []).append(condition)
    else:
        parts.rest.append(condition)


def is_masked(condition: Bound) -> bool:
    """Tell whether a condition is a block, or the negation of one, or compares a count with a number."""
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


def _edge_alone(found: set[Leaf]) -> str | None:
    edges = {leaf.edge if isinstance(leaf, EdgeAttribute) else None for leaf in found}
    return edges.pop() if len(edges) == 1 else None


def _of_null(condition: Bound) -> bool:
    """Tell whether a condition may be true of what has no row: of an edge without attributes."""
    return any(
        isinstance(part, Operation) and part.word in {"IS NULL", "IS NOT NULL", "coalesce", "case"}
        for part in walk(condition)
    )


def _late(scope: Scope, parts: Phases, query: Query, catalog: Catalog) -> Iterator[str]:
    """Nodes that no edge or block has a say in, but values have; and a node that is all there is.

    To bind them by their presence would mean to group all states into masks, and to expand these again.
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
    """Nodes that blocks speak of from inside, anywhere in a query."""
    return frozenset(_blocked((*query.scope.where, *query.result.values)))


def _blocked(expressions: tuple[Bound, ...]) -> Iterator[str]:
    for expression in expressions:
        for block in blocks_of(expression):
            yield from block.scope.outer
            yield from _blocked(block.inside)


def traces_of(query: Query, catalog: Catalog) -> tuple[set[int] | None, set[int]]:
    """Ids of the traces that a query chooses (``None``: all), and of those that cannot answer it."""
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
    """Pairs of nodes that must differ and could be the same, of those bound, one of which is newly bound.

    Of two nodes whose kinds exclude one another nothing need be said.
    """
    for a, b in sorted(scope.distinct):
        if {a, b} <= nodes and {a, b} & new:
            one, other = scope.kinds(a), scope.kinds(b)
            if (one & other).every:
                yield a, b


# The order in which traces come where nothing else is said: by name, ``run2`` before ``run10`` ----
# Ids of traces are digests, so the order of ids is none that anybody knows. A catalog has its traces in order
# (see :attr:`sgstore.lang.Catalog.traces`); rows are ordered by the places of their traces there, which are
# numbers, and never by names.

TRACE_OF_BUCKET: Final = 18
"""``bucket >> 18`` is the trace of a bucket."""

TRACE_OF_FRAME: Final = 24
"""``frame_id >> 24`` is the trace of a frame; the bits below are its place in the trace."""


def extents(catalog: Catalog) -> list[tuple[int, int]]:
    """First bucket and number of buckets of each trace, in the order of the traces."""
    return [trace.extent for trace in catalog.traces]


def frame_key(
    select: Select, frame: str, catalog: Catalog, window: Window | None, values: BoundValues
) -> str:
    """Return the sort key that puts traces in order, and the frames of each in theirs.

    It is one number, for that is sorted fastest: the id of the frame, with the place of the trace instead of
    its id. Where ids are in order already, it is the id.

    Parameters
    ----------
    select : Select
        The places of the traces are joined to it.
    frame : str
        The column of the frame's id.
    catalog : Catalog
    window : Window or None
        What the statement looks at.
    values : BoundValues
        Of the statement.
    """
    order = [trace.trace_id for trace in catalog.traces]
    if window is not None:
        low, high = window.low >> TRACE_OF_BUCKET, (window.high - 1) >> TRACE_OF_BUCKET
        chosen = range(low, high + 1) if window.traces is None else set(window.traces)
        order = [trace for trace in order if trace in chosen]
    if order == sorted(order):
        return frame
    firsts = [place << TRACE_OF_FRAME for place in range(len(order))]
    _join(select, ":order", ("BIGINT", order), firsts, f"{frame} >> {TRACE_OF_FRAME}", values)
    return f'":order".":first" + ({frame} & {(1 << TRACE_OF_FRAME) - 1})'


def name_key(
    select: Select, number: int, column: str, catalog: Catalog, values: BoundValues
) -> str:
    """Return the sort key that replaces a column with names of traces.

    Parameters
    ----------
    select : Select
        The places of the traces are joined to it.
    number : int
        Tells this key from others of the statement.
    column : str
    catalog : Catalog
    values : BoundValues
        Of the statement.
    """
    names, alias = [trace.name for trace in catalog.traces], f":order {number}"
    _join(select, alias, ("VARCHAR", names), list(range(len(names))), column, values)
    return f'"{alias}".":first"'


def _join(
    select: Select,
    alias: str,
    known: tuple[str, Sequence[int | str]],
    firsts: list[int],
    column: str,
    values: BoundValues,
) -> None:
    """Join a number to each row by a column: which numbers belong to which of its values."""
    kind, keys = known
    text = (
        f'SELECT unnest(CAST({values.add(list(keys))} AS {kind}[])) AS ":trace",'
        f' unnest(CAST({values.add(firsts)} AS BIGINT[])) AS ":first"'
    )
    select.join(nested(text, alias), [f'"{alias}".":trace" = {column}'], "LEFT JOIN")
