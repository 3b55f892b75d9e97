"""SQL of the first phase: candidate frames as bit masks. A mask has one bit for each of 60 frames (a bucket).

The mask of a row of ``edge`` or ``node`` marks the frames of a bucket in which the row holds. So edges join
on bucket and node ids, and the frames of a match are the common bits of all masks. Conditions on attributes
of one node also become masks, and so do blocks (``EXISTS``, ``COUNT``), which are evaluated once for all
bindings of their outer nodes. Conditions that need values of single frames are evaluated in the second phase
(:mod:`sgstore.lang.sql._frames`).

A relation of this phase has the columns ``bucket``, ``mask``, ``"x.id"`` for each node x and ``"d.type"``
for each edge d. A relation of the second phase has ``frame_id`` instead of the first two.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import quoted
from sgstore.lang.bind import Profile, alias_of, edge_conditions, homes_of, kind_conditions
from sgstore.lang.catalog import LANE_CHAINS, Home
from sgstore.lang.ir import (
    Bound,
    Edge,
    Happened,
    Kinds,
    Node,
    NodeAttribute,
    Scope,
    ego_kinds,
    same_chain,
)
from sgstore.lang.sql._attributes import Aliases, among, attribute_text
from sgstore.lang.sql._expressions import (
    Leaf,
    bound_text,
    columns_of,
    edge_table,
    expression_text,
    is_constant,
    is_position,
    lane_text,
    leaves,
    node_text,
    trace_text,
)
from sgstore.lang.sql._plan import Phases, SharedRelation, apart, phases_of, traces_of
from sgstore.lang.sql._recorded_events import happened_rows
from sgstore.lang.sql._rewrite import FALSE, chain, narrowed, ordered, possible
from sgstore.lang.sql._select import BoundValues, Select, nested
from sgstore.lang.sql._windows import TRACE_OF_BUCKET, TRACE_OF_FRAME
from sgstore.model.vocabulary import entity_kinds

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import BlockValue, Query
    from sgstore.lang.sql._plan import Gathered
    from sgstore.lang.sql._windows import Window


_BIT: Final = '"bit"'


def bit_of(frame: str) -> str:
    """Return SQL for a 64-bit mask in which only the bit of one frame is set."""
    number = frame if frame.endswith(_BIT) else f"{frame} & 63"
    return f"CAST(1 AS BIGINT) << CAST({number} AS INTEGER)"


def folded(text: str, keys: list[str]) -> str:
    """Return SQL that converts rows of single frames to bit masks: one row per bucket (60 frames)."""
    bit = bit_of('"frame_id"')
    select = Select(['"frame_id" >> 6 AS "bucket"', *keys, f'bit_or({bit}) AS "mask"'])
    select.join(nested(text, ":frames"), [])
    select.group = ['"frame_id" >> 6', *keys]
    return select.text()


def merged(text: str, values: Mapping[str, str]) -> str:
    """Return SQL that merges the bit masks of rows with equal bucket (60 frames) and equal values.

    Parameters
    ----------
    text : str
    values : mapping of str to str
        Quoted column → its SQL, in terms of the relation ``":rows"``.
    """
    columns = [f"{value} AS {column}" for column, value in values.items()]
    select = Select(['"bucket"', *columns, 'bit_or("mask") AS "mask"'])
    select.join(nested(text, ":rows"), [])
    select.group = ['"bucket"', *values.values()]
    return select.text()


OUTSIDE: Final = '":outside"'
BUCKET: Final = '":bucket"'
_MANY: Final = 5
"""Largest number of masks that are compared in pairs, so that each join removes rows early."""

_FEW: Final = 2
"""Largest number of edges that one join contains. The database chooses their order."""

_EDGES: Final = 2
"""Number of edges that each further join adds."""

_BRANCHES: Final = 8
"""Largest number of joins for a pattern with paths of variable length: one join for each combination."""


@dataclass(slots=True)
class Base:
    """Joined tables under construction. Each row has the frames of a match as a bit mask.

    Attributes
    ----------
    select : Select
    nodes : dict of str to str
        Column of the id by node.
    edges : dict of str to str
        Column of the relation by edge.
    bucket : str
        Column of the bucket; empty until a table has it.
    masks : list of str
        Columns or SQL terms of masks.
    present : set of str
        Nodes whose presence follows from the mask of an edge.
    repeats : bool
        True if a binding may have several rows with overlapping masks.
    knows_map : bool
        True if the row of the bucket is joined, which has the map.
    stops : list of (str, str)
        Columns of the inner nodes of paths, which must be present, and the tables of their presence; NULL if
        a path has fewer nodes.
    several : set of str
        Edges with several relations. If their relation is not a column, a binding may have several rows.
    kinds : dict of str to str
        Column of the kind by node.
    apart : set of str
        Nodes whose differences earlier steps have tested.
    """

    select: Select = field(default_factory=Select)
    nodes: dict[str, str] = field(default_factory=dict[str, str])
    edges: dict[str, str] = field(default_factory=dict[str, str])
    bucket: str = ""
    masks: list[str] = field(default_factory=list[str])
    present: set[str] = field(default_factory=set[str])
    repeats: bool = False
    knows_map: bool = False
    stops: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    several: set[str] = field(default_factory=set[str])
    kinds: dict[str, str] = field(default_factory=dict[str, str])
    apart: set[str] = field(default_factory=set[str])

    def join(
        self, table: str, alias: str, ends: Mapping[str, str], conditions: Iterable[str] = ()
    ) -> None:
        """Join a table of bit masks on the bucket (60 frames), and on the nodes that are joined already.

        ``ends`` are its node columns.
        """
        on = [f'{alias}."bucket" = {self.bucket}'] if self.bucket else []
        self.bucket = self.bucket or f'{alias}."bucket"'
        self.masks.append(f'{alias}."mask"')
        self.present |= set(ends)
        self.tie(table, ends, [*conditions, *on])

    def tie(self, table: str, ends: Mapping[str, str], conditions: Iterable[str]) -> None:
        """Join a table on the nodes that it shares with the join. ``ends``: the table's node columns."""
        on = list(conditions)
        for key, column in ends.items():
            if key in self.nodes:
                on.append(f"{column} = {self.nodes[key]}")
            else:
                self.nodes[key] = column
        self.select.join(table, on)

    def need_bucket(self) -> None:
        """Join the table ``bucket`` (map of each 60 frames), unless it is part of the join already."""
        if not self.knows_map:
            self.knows_map = True
            on = [f'{BUCKET}."bucket" = {self.bucket}'] if self.bucket else []
            self.select.join(f'"bucket" AS {BUCKET}', on)
            self.bucket = self.bucket or f'{BUCKET}."bucket"'


@dataclass(slots=True)
class SqlBuilder:
    """Builder of the SQL of one query, with its parameter values and shared subqueries.

    Attributes
    ----------
    query : Query
        Rewritten query.
    catalog : Catalog
    window : Window or None
        Buckets to search; ``None`` means all.
    values : BoundValues
    shared : list of (str, str)
        Names and SQL of relations that are used more than once.
    found : SharedRelation or None
        Known matches of the outermost scope.
    gathered : tuple of Gathered
        Temporary tables used by the SQL that are not in the store.
    """

    query: Query
    catalog: Catalog
    window: Window | None = None
    values: BoundValues = field(default_factory=BoundValues)
    shared: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    found: SharedRelation | None = None
    gathered: tuple[Gathered, ...] = ()

    @property
    def standing(self) -> frozenset[str]:
        """Kinds of node whose frames the store has as bit masks: static entities and map parts."""
        return self.catalog.fixed | self.catalog.mapped

    def edges_of(self, edge: Edge) -> str:
        """Return the table with the rows of an edge: ``known_edge`` has all edges, ``edge`` those of graphs."""
        return '"known_edge"' if self.catalog.world and edge.known else '"edge"'

    def nodes_of(self, edge: Edge) -> str:
        """Return the name of the table with the frames in which the two nodes of an edge are present."""
        return '"graph_node"' if self.catalog.world and not edge.known else '"node"'

    def found_in(self, scope: Scope) -> SharedRelation | None:
        """If the matches of a pattern were computed outside the database, return them; otherwise None."""
        return self.found if scope is self.query.scope else None

    def within(self, column: str, per: int = 1, *, met: bool = False) -> list[str]:
        """Return SQL conditions that keep only frames (or buckets of 60 frames) in the time window.

        ``per``: 64 if the column has ids of frames, 1 if it has buckets.

        ``met``: the rows are joined with rows of the selected traces. Then the range is sufficient, unless
        matches are known.
        """
        if self.window is None:
            return []
        low, high = self.window.low * per, self.window.high * per
        found = [f"{column} >= {low}", f"{column} < {high}"]
        if self.window.traces is not None and not (met and self.found is None):
            shift = TRACE_OF_FRAME if per > 1 else TRACE_OF_BUCKET
            found.append(among(f"{column} >> {shift}", list(self.window.traces)))
        return found

    def share(self, text: str, name: str) -> str:
        """Add a subquery that several parts of the statement can use, and return its name."""
        full = f"{name} {len(self.shared) + 1}"
        self.shared.append((full, text))
        return full

    def of_traces(self, trace: str, scope: Scope) -> list[str]:
        """Return SQL conditions that keep only the selected traces in the main pattern."""
        if scope is not self.query.scope:
            return []
        chosen, left = traces_of(self.query, self.catalog)
        if chosen is not None:
            return [among(trace, sorted(chosen))]
        return ["NOT " + among(trace, sorted(left))] if left else []

    # The join of edges and nodes


def if_bound(sql: SqlBuilder, node: str, value: str) -> str:
    """Return the SQL of a value. It becomes NULL if its node is optional and missing."""
    return f"CASE WHEN {node} IS NOT NULL THEN {value} END" if sql.query.stages else value


def expanded(text: str, nodes: frozenset[str], edges: frozenset[str], kinds: frozenset[str]) -> str:
    """Return SQL that converts rows with bit masks to one row per frame.

    It includes the kinds of some nodes.
    """
    columns = [*columns_of(nodes, edges), *(quoted(f"{key}.kind") for key in sorted(kinds))]
    keep = [f'":pattern".{column}' for column in columns]
    select = Select(['":pattern"."bucket" * 64 + ":bit"."bit" AS "frame_id"', *keep])
    select.join(nested(text, ":pattern"), [])
    select.join('"bits" AS ":bit"', ['(":pattern"."mask" & ":bit"."m") <> 0'])
    return select.text()


def in_mask(alias: str, frame: str) -> str:
    """Return the SQL condition: the mask of a row has the bit of a frame."""
    return f'({alias}."mask" & ({bit_of(frame)})) <> 0'


def stands_text(frame: str, node: str) -> str:
    """Return the SQL condition: the scene graph of a frame contains a static node."""
    on = [f'":g"."bucket" = {frame} >> 6', f'":g"."node_id" = {node}', in_mask('":g"', frame)]
    rows = Select(["1"], ['"graph_node" AS ":g"'], on)
    return f"EXISTS ({rows.text()})"


def number_of_frames(text: str) -> str:
    """Return SQL that counts the frames in all bit masks of a subquery."""
    total = 'coalesce(sum(bit_count("mask")), 0) AS "frames"'
    return Select([total], [nested(text, ":pattern")]).text()


def found_masks(found: SharedRelation) -> str:
    """Return SQL that converts series of frames (first, last) to bit masks.

    Each run is within a bucket of 60 frames.
    """
    mask = (
        '((1::BIGINT << ("last" - "first" + 1)::INTEGER) - 1) << ("first" & 63)::INTEGER AS "mask"'
    )
    columns = ['"first" >> 6 AS "bucket"', mask, '* EXCLUDE ("first", "last")']
    return Select(columns, [quoted(found.name)]).text()


def in_which(alias: str) -> list[str]:
    """Return the SQL columns with the frames of a row: bucket (60 frames) and bit mask."""
    return [f'{alias}."bucket"', f'{alias}."mask"']


def held(alias: str) -> str:
    """Return the SQL that counts the frames in the bit mask of a row."""
    return f'bit_count({alias}."mask")'


def with_blocks(
    blocks: Iterable[tuple[str, frozenset[str], bool]],
    given: SharedRelation,
    nodes: frozenset[str],
    edges: frozenset[str],
) -> str:
    """Return SQL that keeps only the frames in which ``EXISTS {…}`` conditions have the wanted value.

    Parameters
    ----------
    blocks : iterable of (str, frozenset of str, bool)
        Relation of each block, its outer nodes, and true if the block must be true.
    given : SharedRelation
    nodes, edges : frozenset of str
    """
    select = Select()
    select.join(f'{quoted(given.name)} AS ":pattern"', [])
    mask = '":pattern"."mask"'
    for number, (text, keys, wanted) in enumerate(blocks, start=1):
        alias = f":block {number}"
        on = [f'":pattern".{c} = {quoted(alias)}.{c}' for c in ('"bucket"', *columns_of(keys))]
        select.join(nested(text, alias), on, "JOIN" if wanted else "LEFT JOIN")
        theirs = f'{quoted(alias)}."mask"'
        mask += f" & {theirs}" if wanted else f" & ~coalesce({theirs}, 0)"
    select.where.append(f"({mask}) <> 0")
    keep = [f'":pattern".{column}' for column in columns_of(nodes, edges)]
    select.columns = ['":pattern"."bucket"', *keep, f'{mask} AS "mask"']
    if nodes != given.nodes:
        select.columns[-1] = f'bit_or({mask}) AS "mask"'
        select.group = ['":pattern"."bucket"', *keep]
    return select.text()


def base_rows(
    sql: SqlBuilder,
    scope: Scope,
    parts: Phases,
    given: SharedRelation | None,
    nodes: frozenset[str],
    edges: frozenset[str],
    kinds: frozenset[str] = frozenset(),
) -> str:
    """Return SQL that joins nodes and edges of a pattern: one row per match and bucket (60 frames)."""
    unfolded = _unfolded(sql, scope, parts, given, nodes, edges)
    if unfolded:
        return unfolded
    base = Base()
    if given is not None and scope.outer:
        _join_given(sql, base, scope, given)
    single, lane, mates = dict(parts.single), dict(parts.lane), parts.mates
    order, steps = _from_ego(sql, scope, base)
    for number, edge in enumerate(order, start=1):
        _join_edge(sql, base, scope, edge)
        if edge.key in lane:
            _join_lane(sql, base, scope, edge, lane.pop(edge.key), parts.single.get(edge.dst, []))
        others = _join_mates(base, mates)
        tied, mates = len(others) < len(mates), others
        if number in steps or (tied and steps and number < len(order)):
            later = {end for one in order[number:] for end in (one.src, one.dst)}
            _join_tests(sql, base, scope, set(base.nodes) - later - parts.late, single)
            _begin_anew(sql, base, scope)
    for block in parts.alone:
        _join_alone(sql, base, scope, block)
    for number, happened in enumerate(parts.happened):
        _join_happened(sql, base, happened, f":happened {number}")
    _join_tests(sql, base, scope, set(scope.nodes) - parts.late, single)
    for key, conditions in single.items():  # of nodes of an outer pattern
        _join_conditions(sql, base, key, _kinds_to_test(scope, key), conditions)
    if not base.masks:  # all nodes are bound in the second phase
        base.need_bucket()
        base.masks.append(f'{BUCKET}."valid"')
    where = base.select.where
    where += _differences(base, scope)
    where += [bound_text(c, base.nodes, base.edges, sql.values) for c in parts.direct]
    where += sql.within(base.bucket)
    where += sql.of_traces(f"{base.bucket} >> 18", scope)
    where += [trace_text(c, f"{base.bucket} >> 18", sql.values) for c in parts.trace]
    keep = dict(zip(columns_of(nodes), (base.nodes[key] for key in sorted(nodes)), strict=True))
    keep |= {quoted(f"{key}.type"): base.edges[key] for key in sorted(edges)}
    keep |= {quoted(f"{key}.kind"): base.kinds[key] for key in sorted(kinds)}
    base.repeats |= bool(base.several - edges) or set(base.nodes) > nodes
    return _masked(sql, base, keep)


def _from_ego(sql: SqlBuilder, scope: Scope, base: Base) -> tuple[tuple[Edge, ...], range]:
    """Return the edges in the order of joining, and the edges after which a new subquery begins.

    The database misjudges joins of many tables of masks. So the few rows of the ego, or of the outer pattern,
    come first, and each step begins with a table of the rows found so far.
    """
    egos = {key for key in scope.nodes if scope.kinds(key).one_a_frame}
    begin = set(base.nodes) or egos
    edges = scope.edges
    if len(edges) <= _FEW or not any({edge.src, edge.dst} & begin for edge in edges):
        return edges, range(0)
    edges = ordered(scope, sql.catalog, begin).edges
    seen, connected, mates = set(begin), 0, [*same_chain(scope.where)]
    while connected < len(edges) and {edges[connected].src, edges[connected].dst} & seen:
        seen |= {edges[connected].src, edges[connected].dst}
        seen |= {key for pair in mates if seen.intersection(pair) for key in pair}
        connected += 1
    return edges, range(_EDGES if base.nodes else 1, min(connected, len(edges) - 1) + 1, _EDGES)


def _join_tests(
    sql: SqlBuilder, base: Base, scope: Scope, nodes: set[str], single: dict[str, list[Bound]]
) -> None:
    """Join tables that test nodes: their presence, and their conditions in ``single`` (then removed)."""
    for key in scope.nodes:
        if key in nodes and key not in base.present:
            _join_presence(sql, base, key, scope.kinds(key), single.pop(key, []))
    for key in sorted(nodes & single.keys()):
        _join_conditions(sql, base, key, _kinds_to_test(scope, key), single.pop(key))


def _begin_anew(sql: SqlBuilder, base: Base, scope: Scope) -> None:
    """Make the current join a shared subquery, and start a new join from it."""
    base.need_bucket()
    base.select.where += [*_differences(base, scope), *sql.within(base.bucket)]
    keep = {"map_id": f'{BUCKET}."map_id"'}
    keep |= {f"{key}.id": column for key, column in base.nodes.items()}
    keep |= {f"{key}.type": column for key, column in base.edges.items()}
    keep |= {f"{key}.kind": column for key, column in base.kinds.items()}
    keep |= {f"stop {n}": column for n, (column, _) in enumerate(base.stops)}
    base.select.columns = [f'{base.bucket} AS "bucket"']
    base.select.columns += [f"{column} AS {quoted(name)}" for name, column in keep.items()]
    base.select.columns.append(f'{_common(base)} AS "mask"')
    name = quoted(sql.share(base.select.text(), "step"))
    base.select, base.bucket, base.masks = Select(), f'{BUCKET}."bucket"', [f'{BUCKET}."mask"']
    base.select.join(f"{name} AS {BUCKET}", [])
    base.apart = set(base.nodes)
    base.nodes = {key: f"{BUCKET}.{quoted(f'{key}.id')}" for key in base.nodes}
    base.edges = {key: f"{BUCKET}.{quoted(f'{key}.type')}" for key in base.edges}
    base.kinds = {key: f"{BUCKET}.{quoted(f'{key}.kind')}" for key in base.kinds}
    base.stops = [(f'{BUCKET}."stop {n}"', table) for n, (_, table) in enumerate(base.stops)]


def _differences(base: Base, scope: Scope) -> list[str]:
    """Return the SQL conditions "these nodes differ" that earlier steps did not test."""
    bound = set(base.nodes)
    pairs = apart(scope, bound, bound - base.apart)
    return [f"{base.nodes[a]} <> {base.nodes[b]}" for a, b in pairs]


def _common(base: Base) -> str:
    """Return the SQL of the bits that all masks of a join have in common. Exclude rows without such bits."""
    mask = " & ".join(base.masks)
    if len(base.masks) <= _MANY:
        base.select.where += [f"({a} & {b}) <> 0" for a, b in combinations(base.masks, 2)]
    if len(base.masks) > 2:
        base.select.where.append(f"({mask}) <> 0")
    return mask


def _join_given(sql: SqlBuilder, base: Base, scope: Scope, given: SharedRelation) -> None:
    """Add the rows of the outer pattern to the SQL of a pattern in braces."""
    columns = columns_of(frozenset(scope.outer))
    table = f"{quoted(given.name)} AS {OUTSIDE}"
    if given.edges or given.nodes != frozenset(scope.outer):
        reduced = Select(['"bucket"', *columns, 'bit_or("mask") AS "mask"'])
        reduced.join(quoted(given.name), [])
        reduced.group = ['"bucket"', *columns]
        table = nested(reduced.text(), ":outside")
    ends = zip(sorted(scope.outer), columns, strict=True)
    base.join(table, OUTSIDE, {key: f"{OUTSIDE}.{column}" for key, column in ends})


def _join_edge(sql: SqlBuilder, base: Base, scope: Scope, edge: Edge) -> None:
    ends = scope.kinds(edge.src), scope.kinds(edge.dst)
    moving = any(possible(edge, *ends, sql.catalog.edges))
    lasting = any(possible(edge, *ends, sql.catalog.map_edges))
    alias = quoted(alias_of(edge))
    ends = {edge.src: f'{alias}."src"', edge.dst: f'{alias}."dst"'}
    if edge.high == 1:
        base.edges[edge.key] = f'{alias}."relation"'
    if edge.src == edge.dst:
        base.select.where.append(f'{alias}."src" = {alias}."dst"')
    if edge.high > 1 and (ways := _ways(sql, scope, edge)):
        base.need_bucket()
        base.repeats = True
        on = [f'{alias}."map_id" = {BUCKET}."map_id"']
        base.tie(f"{quoted(sql.share(ways, 'ways'))} AS {alias}", ends, on)
        _join_graph_nodes(sql, base, edge, ends)
        nodes = sql.nodes_of(edge)
        base.stops += [(f'{alias}."stop {number}"', nodes) for number in range(1, edge.high)]
    elif edge.high > 1:
        base.repeats = True
        base.join(nested(_paths(sql, scope, edge), alias[1:-1]), alias, ends)
    elif edge.both or (moving and lasting):
        base.repeats = True
        rows = _rows(sql, scope, edge, moving=moving, lasting=lasting)
        base.join(nested(rows, alias[1:-1]), alias, ends)
    else:
        base.several |= {edge.key} if len(edge.relations) > 1 else set()
        base.kinds |= {edge.src: f'{alias}."src_kind"', edge.dst: f'{alias}."dst_kind"'}
        on = edge_conditions(sql.catalog, scope, edge, alias, moving=not lasting)
        if lasting:
            base.need_bucket()
            on.append(f'{alias}."map_id" = {BUCKET}."map_id"')
            base.tie(f'"map_edge" AS {alias}', ends, on)
            _join_graph_nodes(sql, base, edge, ends)
        else:
            base.join(f"{sql.edges_of(edge)} AS {alias}", alias, ends, on)


def _join_graph_nodes(sql: SqlBuilder, base: Base, edge: Edge, ends: Mapping[str, str]) -> None:
    """Keep only the frames in which both nodes of an edge are in the scene graph."""
    if sql.nodes_of(edge) == '"node"':
        return
    for key in ends:
        alias = quoted(f"{edge.key}:{key}")
        base.join(f'"graph_node" AS {alias}', alias, {key: f'{alias}."node_id"'})


def _join_alone(sql: SqlBuilder, base: Base, scope: Scope, block: BlockValue) -> None:
    """Join an ``EXISTS {…}`` as a subquery: its frames, and the ids of its nodes from outside the braces."""
    outer = {key: kinds & scope.kinds(key) for key, kinds in block.scope.outer.items()}
    inner = replace(block.scope, outer=outer)
    keys, alias = frozenset(outer), quoted(f":alone {block.number}")
    parts = phases_of(inner, sql.query, sql.catalog)
    rows = base_rows(sql, inner, parts, None, keys, frozenset())
    ends = zip(sorted(keys), columns_of(keys), strict=True)
    there = set(base.present)
    shared = sql.share(rows, "alone")
    base.join(f"{quoted(shared)} AS {alias}", alias, {k: f"{alias}.{c}" for k, c in ends})
    base.present = there | {key for key in keys if outer[key].every <= entity_kinds()}


def _join_happened(sql: SqlBuilder, base: Base, happened: Happened, name: str) -> None:
    """Join the frames of a recorded event, with the ids of the nodes that it involves.

    Presence of the nodes is tested separately.
    """
    keys = [quoted(f":{place}") for place in range(len(happened.nodes))]
    rows, alias = happened_rows(happened), quoted(name)
    inner = Select(['"frame_id"', *keys], [nested(rows, ":events")], sql.within('"frame_id"', 64))
    inner.where.append('"frame_id" IS NOT NULL')
    ends = {key: f"{alias}.{column}" for key, column in zip(happened.nodes, keys, strict=True)}
    there = set(base.present)
    base.join(nested(folded(inner.text(), keys), name), alias, ends)
    base.present = there


def told_kinds(sql: SqlBuilder, scope: Scope, parts: Phases) -> frozenset[str]:
    """Return the nodes of an edge whose kind is a column of the edge's rows."""
    if parts.blocks or any(edge.high > 1 for edge in scope.edges):
        return frozenset()
    found = set[str]()
    for edge in scope.edges:
        ends = scope.kinds(edge.src), scope.kinds(edge.dst)
        tables = (sql.catalog.edges, sql.catalog.map_edges)
        if not edge.both and not all(any(possible(edge, *ends, table)) for table in tables):
            found |= {edge.src, edge.dst}
    return frozenset(found)


def _rows(sql: SqlBuilder, scope: Scope, edge: Edge, *, moving: bool, lasting: bool) -> str:
    """Return SQL for the rows of an edge, from all of its tables, and in both directions if undirected."""
    directions = (False, True) if edge.both else (False,)
    branches: list[str] = []
    for swapped in directions:
        if moving or not lasting:
            select = Select(_row_columns('"e"', '"e"."mask"', swapped=swapped))
            select.join(f'{sql.edges_of(edge)} AS "e"', [])
            select.where = edge_conditions(
                sql.catalog, scope, edge, '"e"', moving=True, swapped=swapped
            )
            select.where += sql.within('"e"."bucket"')
            branches.append(select.text())
        if lasting:
            branches.append(_lasting_rows(sql, scope, edge, swapped=swapped))
    return "\nUNION ALL\n".join(branches)


def _lasting_rows(sql: SqlBuilder, scope: Scope, edge: Edge, *, swapped: bool) -> str:
    """Return SQL for edges of the map. Bit masks mark the frames in which both nodes are present."""
    mask = '"p"."mask" & "q"."mask"'
    select = Select(_row_columns('"m"', mask, swapped=swapped))
    select.columns[0] = '"p"."bucket" AS "bucket"'
    select.join('"map_edge" AS "m"', [])
    select.join('"bucket" AS "b"', ['"b"."map_id" = "m"."map_id"'])
    for alias, end in (("p", "src"), ("q", "dst")):
        select.join(
            f'{sql.nodes_of(edge)} AS "{alias}"',
            [f'"{alias}"."bucket" = "b"."bucket"', f'"{alias}"."node_id" = "m"."{end}"'],
        )
    select.where = edge_conditions(sql.catalog, scope, edge, '"m"', moving=False, swapped=swapped)
    select.where += [f"({mask}) <> 0", *sql.within('"b"."bucket"')]
    return select.text()


def _unfolded(
    sql: SqlBuilder,
    scope: Scope,
    parts: Phases,
    given: SharedRelation | None,
    nodes: frozenset[str],
    edges: frozenset[str],
) -> str:
    """Return SQL with one join per combination of path lengths; an empty text if this is not useful.

    Then the search for a path begins at nodes that other edges bind.
    """
    paths = [edge for edge in scope.edges if edge.high > 1 and not _ways(sql, scope, edge)]
    lengths = list(product(*(range(path.low, path.high + 1) for path in paths)))
    wanted = any(path.key in edges for path in paths)
    if not paths or wanted or len(paths) == len(scope.edges) or len(lengths) > _BRANCHES:
        return ""
    branches: list[str] = []
    for chosen in lengths:
        inner = scope
        for path, length in zip(paths, chosen, strict=True):
            inner = chain(inner, path, length, injective=sql.query.injective)
        inner = ordered(narrowed(inner, sql.catalog), sql.catalog)
        if inner.where != (FALSE,):
            branches.append(base_rows(sql, inner, parts, given, nodes, edges))
    if not branches:
        return ""
    columns = ['"bucket"', *columns_of(nodes, edges)]
    select = Select([*columns, 'bit_or("mask") AS "mask"'], group=columns)
    select.join(nested("\nUNION ALL\n".join(branches), ":lengths"), [])
    select.where = sql.of_traces('"bucket" >> 18', scope)
    return select.text()


def _chains(sql: SqlBuilder, scope: Scope, edge: Edge) -> list[Scope]:
    """Return patterns that replace a path of variable length: one for each length, with single edges."""
    nodes = {key: Node(key, scope.kinds(key), "hidden", edge.span) for key in (edge.src, edge.dst)}
    single = replace(edge, low=1, high=1)
    alone = Scope(nodes, {}, (single,), (), frozenset())
    found = (
        chain(alone, single, length, injective=sql.query.injective)
        for length in range(edge.low, edge.high + 1)
    )
    found = (ordered(narrowed(inner, sql.catalog), sql.catalog) for inner in found)
    return [inner for inner in found if inner.where != (FALSE,)]


def _ways(sql: SqlBuilder, scope: Scope, edge: Edge) -> str:
    """Return SQL for the routes of a path along edges of the map; an empty text if other edges occur.

    Their number does not depend on the number of frames. Other edges are joined to these routes. Then the
    presence of the inner nodes is tested.
    """
    if edge.both or len(scope.edges) == 1:
        return ""
    branches: list[str] = []
    for inner in _chains(sql, scope, edge):
        for link in inner.edges:
            ends = inner.kinds(link.src), inner.kinds(link.dst)
            if any(possible(link, *ends, sql.catalog.edges)):
                return ""
        branches.append(_ways_along(sql, inner, edge))
    return "\nUNION ALL\n".join(branches)


def _ways_along(sql: SqlBuilder, scope: Scope, path: Edge) -> str:
    """Return SQL for the routes along a fixed number of edges of the map."""
    base, first = Base(), f'{quoted(alias_of(scope.edges[0]))}."map_id"'
    for edge in scope.edges:
        alias = quoted(alias_of(edge))
        on = edge_conditions(sql.catalog, scope, edge, alias, moving=False)
        on += [f'{alias}."map_id" = {first}'] if base.nodes else []
        on += [f'{alias}."src" = {alias}."dst"'] if edge.src == edge.dst else []
        ends = {edge.src: f'{alias}."src"', edge.dst: f'{alias}."dst"'}
        base.tie(f'"map_edge" AS {alias}', ends, on)
    bound, select = set(base.nodes), base.select
    select.where += [f"{base.nodes[a]} <> {base.nodes[b]}" for a, b in apart(scope, bound, bound)]
    select.columns = [f'{first} AS "map_id"', f'{base.nodes[path.src]} AS "src"']
    select.columns.append(f'{base.nodes[path.dst]} AS "dst"')
    for number in range(1, path.high):
        stop = base.nodes.get(f"#{path.key}.{number}", "CAST(NULL AS INTEGER)")
        select.columns.append(f'{stop} AS "stop {number}"')
    return select.text()


def _paths(sql: SqlBuilder, scope: Scope, edge: Edge) -> str:
    """Return SQL for a path of several edges: ids of both end nodes, and its frames as bit masks."""
    ends = ((edge.src, "src"), (edge.dst, "dst"))
    keys = frozenset((edge.src, edge.dst))
    branches: list[str] = []
    for inner in _chains(sql, scope, edge):
        rows = base_rows(sql, inner, Phases(), None, keys, frozenset())
        columns = [f'{quoted(f"{key}.id")} AS "{end}"' for key, end in ends]
        select = Select(['"bucket"', *columns, '"mask"'], [nested(rows, ":path")])
        branches.append(select.text())
    if not branches:
        columns = ['"bucket"', '"src"', '"dst"', '"mask"']
        branches.append(Select(columns, ['"edge"'], ["FALSE"]).text())
    return "\nUNION ALL\n".join(branches)


def _join_presence(
    sql: SqlBuilder, base: Base, key: str, kinds: Kinds, conditions: list[Bound]
) -> None:
    """Join bit masks of the frames in which a node is present and meets its conditions."""
    alias = quoted(f"{key}:")
    profile = Profile.of(kinds, sql.catalog)
    if profile.moving or conditions:
        rows = _present(sql, kinds, profile, conditions)
        base.join(nested(rows, f"{key}:"), alias, {key: f'{alias}."node_id"'})
    else:
        on = kind_conditions(kinds, f'{alias}."kind"', None, sql.standing)
        base.join(f'"node" AS {alias}', alias, {key: f'{alias}."node_id"'}, on)


def _kinds_to_test(scope: Scope, key: str) -> Kinds:
    """Return the node kinds that SQL must test in the states. An edge already tests the kind of the ego."""
    kinds = scope.kinds(key)
    said = any(edge.high == 1 and key in {edge.src, edge.dst} for edge in scope.edges)
    return ego_kinds() if said and kinds.one_a_frame else kinds


def _join_conditions(
    sql: SqlBuilder, base: Base, key: str, kinds: Kinds, conditions: list[Bound]
) -> None:
    """Join bit masks of the frames in which a node meets its conditions. Its presence is already tested."""
    profile, alias = Profile.of(kinds, sql.catalog), quoted(f"{key}:")
    constant = all(is_constant(leaf) for c in conditions for leaf in leaves(c))
    if profile.mapped and profile.places == 1:
        base.need_bucket()
        table, at = "map_node", Aliases(map=alias)
        on = [f'{alias}."map_id" = {BUCKET}."map_id"']
    elif constant and not profile.mapped:
        table, at = "entity", Aliases(entity=alias)
        on = [f'{alias}."trace_id" = {base.bucket} >> 18']
    else:
        _join_presence(sql, base, key, kinds, conditions)
        return
    node = f'{alias}."node_id"'
    base.tie(f'"{table}" AS {alias}', {key: node}, on)
    base.select.where += [node_text(c, node, at, sql.values) for c in conditions]


def _join_mates(base: Base, mates: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Join lanes of one chain to the lanes that are joined already. Return the other pairs of lanes."""
    for a, b in [pair for pair in mates if base.nodes.keys() & pair]:
        alias = quoted(f"{a} {b}:chain")
        base.need_bucket()
        on = [f'{alias}."map_id" = {BUCKET}."map_id"']
        ends = {a: f'{alias}."src"', b: f'{alias}."dst"'}
        base.tie(f"{quoted(LANE_CHAINS)} AS {alias}", ends, on)
    return [pair for pair in mates if not base.nodes.keys() & pair]


def _join_lane(
    sql: SqlBuilder,
    base: Base,
    scope: Scope,
    edge: Edge,
    conditions: list[Bound],
    of_lane: list[Bound],
) -> None:
    """Join bit masks of the frames in which an edge meets the conditions on itself and on its lane.

    The kinds of its entity, and the conditions ``of_lane`` if the lane is read anyway, are tested here too,
    because the table has a row for each entity, lane and frame.
    """
    table, nodes = edge_table(edge, base.nodes[edge.src], base.nodes[edge.dst])
    keys = [f'"l".{quoted(column)}' for column in ("bucket", *nodes)]
    on_map = any(isinstance(leaf, NodeAttribute) for c in conditions for leaf in leaves(c))
    profile = Profile.of(scope.kinds(edge.dst), sql.catalog)
    if on_map and profile.mapped and profile.places == 1:
        conditions = [*conditions, *(c for c in of_lane if not any(map(is_position, leaves(c))))]
    kinds, of_kind = scope.kinds(edge.src), list[str]()
    if table == "lane_state" and not edge.both:
        among = Kinds(kinds.every, kinds.every)
        of_kind = kind_conditions(among, '"l"."kind"', None, entity_kinds())

    def leaf_text(leaf: Leaf) -> str:
        if isinstance(leaf, NodeAttribute):
            return attribute_text(leaf.attribute, Aliases(map='"n"'))
        return lane_text(leaf, '"l"')

    where = [expression_text(c, leaf_text, sql.values) for c in conditions]
    rows: list[str] = []
    for part, mask in stored_rows(sql.catalog, table, '"l"').items():
        select = Select([*keys, f'{mask} AS "mask"'], [f'{quoted(part)} AS "l"'])
        select.where = [*sql.within('"l"."bucket"'), *of_kind, *where]
        if table == "lane_state" and not edge.both and kinds.one_a_frame:
            on = ['"g"."bucket" = "l"."bucket"', '"g"."node_id" = "l"."node_id"']
            select.join(nested(_ego(sql), "g"), on)
        if on_map:
            select.join('"bucket" AS "b"', ['"b"."bucket" = "l"."bucket"'])
            select.join(
                '"map_node" AS "n"', ['"n"."map_id" = "b"."map_id"', '"n"."node_id" = "l"."lane"']
            )
        rows.append(select.text())
    name = f"{edge.key}:in"
    alias = quoted(name)
    text = merged("\nUNION ALL\n".join(rows), {quoted(column): quoted(column) for column in nodes})
    on = [f"{alias}.{quoted(column)} = {node}" for column, node in nodes.items()]
    base.join(nested(text, name), alias, {}, on)


def stored_rows(catalog: Catalog, view: str, alias: str) -> dict[str, str]:
    """Return the tables behind a view of edge attributes: table → SQL of a row's bit mask.

    The view has a row for each frame. A table has one row for many frames with equal values.
    """
    bit = bit_of(f"{alias}.{_BIT}")
    if view in dict(catalog.shadows):
        return {view: bit}
    stem = view.removesuffix("_state").removeprefix("lane_")
    return {f"{stem}_single": bit, f"{stem}_repeated": f'{alias}."mask"'}


def _present(sql: SqlBuilder, kinds: Kinds, profile: Profile, conditions: list[Bound]) -> str:
    """Return SQL for nodes that are present and meet conditions, with their frames as bit masks.

    It has one part for each table.
    """
    branches: list[str] = []
    if (
        profile.moving
        and not conditions
        and not kinds.other
        and profile.moving >= (sql.catalog.moving & entity_kinds())
    ):
        branches.append(_ego(sql))
    elif profile.moving:
        branches.append(_moving(sql, kinds, profile, conditions))
    if profile.fixed:
        branches.append(_standing(sql, kinds.only(profile.fixed), conditions, "fixed"))
    if profile.mapped:
        branches.append(_standing(sql, kinds.only(profile.mapped), conditions, "mapped"))
    return "\nUNION ALL\n".join(branches)


def _ego(sql: SqlBuilder) -> str:
    select = Select(['"bucket"', '"ego" AS "node_id"', f'bit_or({bit_of(_BIT)}) AS "mask"'])
    select.join('"frame"', ['"ego" IS NOT NULL', *sql.within('"bucket"')])
    select.group = ['"bucket"', '"ego"']
    return select.text()


def _moving(sql: SqlBuilder, kinds: Kinds, profile: Profile, conditions: list[Bound]) -> str:
    frame, node = '"s"."frame_id"', '"s"."node_id"'
    select = Select(
        [f'{frame} >> 6 AS "bucket"', node, f'bit_or({bit_of(frame)}) AS "mask"'],
        group=[f"{frame} >> 6", node],
    )
    select.join(
        '"state" AS "s"',
        kind_conditions(kinds, '"s"."kind"', '"s"."is_ego"', sql.catalog.moving),
    )
    select.where += sql.within(frame, 64)
    found = [leaf for c in conditions for leaf in leaves(c) if isinstance(leaf, NodeAttribute)]
    homes = {home for leaf in found for home in homes_of(leaf.attribute, profile)}
    entity = '"n"' if Home.entity in homes else None
    if entity:
        on = [f'"n"."trace_id" = {frame} >> 24', f'"n"."node_id" = {node}']
        select.join('"entity" AS "n"', on)
    at = Aliases('"s"', entity, None, _join_trace(sql, select, f"{frame} >> 24", conditions))
    select.where += [node_text(c, node, at, sql.values) for c in conditions]
    return select.text()


def _standing(sql: SqlBuilder, kinds: Kinds, conditions: list[Bound], place: str) -> str:
    bucket, node = '"p"."bucket"', '"p"."node_id"'
    select = Select([bucket, node, '"p"."mask"'])
    select.join(
        '"node" AS "p"',
        kind_conditions(kinds, '"p"."kind"', None, sql.standing),
    )
    select.where += [f"{node} {'>=' if place == 'fixed' else '<'} 0", *sql.within(bucket)]
    at = Aliases()
    if conditions and place == "fixed":
        on = [f'"n"."trace_id" = {bucket} >> 18', f'"n"."node_id" = {node}']
        select.join('"entity" AS "n"', on)
        trace = _join_trace(sql, select, f"{bucket} >> 18", conditions)
        at = Aliases(entity='"n"', trace=trace)
    elif conditions:
        select.join('"bucket" AS "b"', [f'"b"."bucket" = {bucket}'])
        on = ['"n"."map_id" = "b"."map_id"', f'"n"."node_id" = {node}']
        select.join('"map_node" AS "n"', on)
        at = Aliases(map='"n"')
    select.where += [node_text(c, node, at, sql.values) for c in conditions]
    return select.text()


def _join_trace(sql: SqlBuilder, select: Select, trace: str, conditions: list[Bound]) -> str | None:
    """If a condition uses a position, join the table ``trace`` and return its alias; otherwise None."""
    if not any(is_position(leaf) for c in conditions for leaf in leaves(c)):
        return None
    select.join('"trace" AS "t"', [f'"t"."trace_id" = {trace}'])
    return '"t"'


def _masked(sql: SqlBuilder, base: Base, keep: Mapping[str, str]) -> str:
    """Return SQL for a join with its bit masks combined, the given columns, and no duplicates."""
    select, mask = base.select, _common(base)
    named = [f"{column} AS {name}" for name, column in keep.items()]
    select.columns = [f'{base.bucket} AS "bucket"', *named, f'{mask} AS "mask"']
    if base.stops:
        return _on_the_way(sql, select, base.stops, list(keep))
    if base.repeats:
        select.columns[-1] = f'bit_or({mask}) AS "mask"'
        select.group = [base.bucket, *keep.values()]
    return select.text()


def _on_the_way(
    sql: SqlBuilder, join: Select, stops: list[tuple[str, str]], keys: list[str]
) -> str:
    """Return SQL that keeps only the frames of a join in which the inner nodes of paths are present."""
    names = [f"stop {number}" for number in range(1, len(stops) + 1)]
    tables = {name: table for name, (_, table) in zip(names, stops, strict=True)}
    join.columns += [
        f"{stop} AS {quoted(name)}" for name, (stop, _) in zip(names, stops, strict=True)
    ]
    found = Select(['":way"."bucket"', *(f'":way".{key}' for key in keys)])
    found.join(f'{quoted(sql.share(join.text(), "way"))} AS ":way"', [])
    mask = '":way"."mask"'
    for name in names:
        alias, node = quoted(f":{name}"), f'":way".{quoted(name)}'
        on = [f'{alias}."bucket" = ":way"."bucket"', f'{alias}."node_id" = {node}']
        found.join(f"{tables[name]} AS {alias}", on, "LEFT JOIN")
        mask += f' & CASE WHEN {node} IS NULL THEN -1 ELSE coalesce({alias}."mask", 0) END'
    found.where.append(f"({mask}) <> 0")
    found.group = list(found.columns)
    found.columns.append(f'bit_or({mask}) AS "mask"')
    return found.text()


def _row_columns(alias: str, mask: str, *, swapped: bool) -> list[str]:
    src, dst = ("dst", "src") if swapped else ("src", "dst")
    ends = [f'{alias}."{src}" AS "src"', f'{alias}."{dst}" AS "dst"']
    return [f'{alias}."bucket"', *ends, f'{alias}."relation"', f'{mask} AS "mask"']
