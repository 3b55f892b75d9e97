"""SQL of the second phase: it tests the candidate frames of the first phase with values of each frame.

The frames from the first phase are joined with ``state`` (and the tables of constants) for each node whose
values are needed. Statements around that join compute pair numbers and test conditions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeGuard

from sgstore.base.quoting import quoted
from sgstore.lang.bind import Profile, homes_of, kind_conditions
from sgstore.lang.catalog import NODE_ATTRIBUTES, DisplayUnit, Home
from sgstore.lang.ir import (
    BlockValue,
    Bound,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    GroupKey,
    Happened,
    Kinds,
    NodeAttribute,
    NodeValue,
    Operation,
    PairNumber,
    Scope,
    TraceAttribute,
    blocks_of,
    nodes_of,
)
from sgstore.lang.operators import COMPARISONS, Column
from sgstore.lang.sql._attributes import (
    Aliases,
    attribute_text,
    frame_text,
    own_text,
    owner_text,
    role_text,
)
from sgstore.lang.sql._expressions import (
    Leaf,
    column_of,
    columns_of,
    edge_table,
    expression_text,
    is_position,
    lane_text,
    leaves,
)
from sgstore.lang.sql._layers import Join, Layers, named, pairs_of
from sgstore.lang.sql._lookups import (
    LOOKED_UP,
    WayEnd,
    is_between_entities,
    lane_distances,
    way_text,
)
from sgstore.lang.sql._mask_counts import CountRange, frames_with
from sgstore.lang.sql._masks import (
    BUCKET,
    SqlBuilder,
    base_rows,
    expanded,
    folded,
    found_masks,
    held,
    if_bound,
    in_mask,
    in_which,
    merged,
    stands_text,
    stored_rows,
    told_kinds,
    with_blocks,
)
from sgstore.lang.sql._plan import Phases, SharedRelation, apart, phases_of
from sgstore.lang.sql._recorded_events import happened_text
from sgstore.lang.sql._rewrite import INVARIANT, bounds, complement, counted_block, is_lasting
from sgstore.lang.sql._select import Select, nested
from sgstore.model.pair_numbers import MARKS, STOREYS, UNEVEN, WAYS
from sgstore.model.vocabulary import SIGNALS, VEHICLES

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from sgstore.lang.catalog import Attribute, Catalog


PATTERN: Final = '":pattern"'
FRAME: Final = '":frame"'
TRACE: Final = '":trace"'
MAP: Final = '":map"'


def phases(sql: SqlBuilder, scope: Scope) -> Phases:
    """Group the conditions of a pattern by the phase that tests them: on bit masks of frames, or per frame.

    Matches that are computed already need no tests.
    """
    return Phases() if sql.found_in(scope) else phases_of(scope, sql.query, sql.catalog)


def masks(
    sql: SqlBuilder,
    scope: Scope,
    parts: Phases,
    given: SharedRelation | None,
    nodes: frozenset[str],
    edges: frozenset[str] = frozenset(),
    kinds: frozenset[str] = frozenset(),
) -> str:
    """Return SQL with one row per match: its node ids, and its frames as a 64-bit mask.

    ``kinds`` are nodes whose kind is also a column; they must be in :func:`told_kinds`.
    """
    if (found := sql.found_in(scope)) is not None:
        return found_masks(found)
    if not parts.blocks:
        return base_rows(sql, scope, parts, given, nodes, edges, kinds)
    outside = {key for c in parts.blocks for block in blocks_of(c) for key in block.scope.outer}
    wide = nodes | frozenset(outside)
    name = sql.share(base_rows(sql, scope, parts, given, wide, edges), "pattern")
    shared = SharedRelation(name, wide, edges)
    return with_blocks([_block(sql, one, shared) for one in parts.blocks], shared, nodes, edges)


def existence(sql: SqlBuilder, scope: Scope, given: SharedRelation | None) -> str:
    """Return SQL for ``EXISTS {…}``: per match, ids of the nodes from outside the braces, and a frame mask."""
    keys = frozenset(scope.outer)
    parts = phases(sql, scope)
    if parts.rest or parts.late:
        return folded(frames(sql, scope, given, keys), columns_of(keys))
    text = masks(sql, scope, parts, given, keys)
    if set(scope.nodes) and not parts.blocks:
        return text  # already grouped, because the inner nodes are dropped
    return merged(text, {column: column for column in columns_of(keys)})


def _block(
    sql: SqlBuilder, condition: Bound, given: SharedRelation
) -> tuple[str, frozenset[str], bool]:
    """For a condition with braces, return its SQL, its nodes from outside the braces, and False if negated."""
    match condition:
        case BlockValue(scope=scope):
            return existence(sql, scope, given), frozenset(scope.outer), True
        case Operation("NOT", (BlockValue(scope=scope),)):
            return existence(sql, scope, given), frozenset(scope.outer), False
        case _:
            return _block_counted(sql, condition, given)


def _block_counted(
    sql: SqlBuilder, condition: Bound, given: SharedRelation
) -> tuple[str, frozenset[str], bool]:
    counted = counted_block(condition)
    assert counted is not None, condition  # noqa: S101 - guaranteed by phases_of
    block, sign, number = counted
    wanted = not COMPARISONS[sign].columns((Column(0), Column(number))).true
    sign = sign if wanted else complement(sign)
    keys = frozenset(block.scope.outer)
    parts = phases(sql, block.scope)
    if not (parts.rest or parts.late):
        rows = masks(sql, block.scope, parts, given, *_told_apart(block.scope))
        name = sql.share(rows, "counted")
        return frames_with(name, columns_of(keys), CountRange.of(sign, number)), keys, wanted
    select = Select(['"frame_id"', *columns_of(keys)])
    select.join(nested(block_matches(sql, block, given), ":counted"), [])
    select.group = ['"frame_id"', *columns_of(keys)]
    select.having = [f"count(*) {sign} {sql.values.add(number)}"]
    return folded(select.text(), columns_of(keys)), keys, wanted


def block_matches(
    sql: SqlBuilder, block: BlockValue, given: SharedRelation | None, columns: Iterable[Leaf] = ()
) -> str:
    """Return SQL for all matches of a pattern in braces: one row per frame and match."""
    nodes, edges = _told_apart(block.scope)
    return frames(sql, block.scope, given, nodes, edges, columns)


def _told_apart(scope: Scope) -> tuple[frozenset[str], frozenset[str]]:
    """Return the nodes and edges of ``{…}`` that identify a match: matches differ if one of these differs."""
    nodes = {key for key, node in scope.nodes.items() if node.role != "hidden"}
    edges = frozenset(edge.key for edge in scope.edges if edge.named)
    return frozenset(nodes) | frozenset(scope.outer), edges


def frames(
    sql: SqlBuilder,
    scope: Scope,
    given: SharedRelation | None,
    nodes: frozenset[str],
    edges: frozenset[str] = frozenset(),
    columns: Iterable[Leaf] = (),
) -> str:
    """Return SQL with one row for each match in each single frame.

    Parameters
    ----------
    sql : SqlBuilder
    scope : Scope
    given : SharedRelation or None
        Relation that binds the outer nodes.
    nodes, edges : frozenset of str
        Nodes and edges to bind. Each binding occurs once for each frame.
    columns : iterable of Leaf
        Additional values, each a column named by :func:`column_of`.
    """
    parts = phases(sql, scope)
    wanted = list(dict.fromkeys(columns))
    if INVARIANT in wanted and not (parts.rest or parts.late):
        return _by_buckets(sql, scope, parts, given, nodes, edges, wanted)
    conditions = [*parts.rest, *bounds(parts.rest)]
    needed = list(dict.fromkeys([*(leaf for c in conditions for leaf in leaves(c)), *wanted]))
    bound = nodes | {key for leaf in needed for key in nodes_of(leaf)}
    edged = {leaf.edge for leaf in needed if isinstance(leaf, EdgeAttribute)}
    bound |= {end for e in scope.edges if e.key in edged for end in (e.src, e.dst)}
    pairs = apart(scope, {*scope.nodes, *scope.outer}, parts.late)
    bound |= {key for pair in pairs for key in pair}
    ties = edges | {leaf.edge for leaf in needed if isinstance(leaf, EdgeRelation) or _is_own(leaf)}
    join, given = _first_phase(sql, scope, parts, given, bound, ties, needed)
    _second_phase(sql, join, scope, parts, given, needed)
    join.world = sql.catalog.world
    # A frame has only one ego, of any kind.
    users = frozenset(
        key for key in {*scope.nodes, *scope.outer} if scope.kinds(key).other <= _USERS
    )
    without = _needless(sql.catalog, pairs_of(needed), users)
    layers = Layers(join, needed, conditions, without, users)
    text = layers.text(sql.values, columns_of(nodes, edges), wanted)
    told = {leaf.node for leaf in wanted if isinstance(leaf, NodeValue)}
    told |= {leaf.edge for leaf in wanted if isinstance(leaf, EdgeRelation)}
    told |= {leaf.node for leaf in wanted if _is(leaf, "id")}
    hidden = (bound | parts.late | ties) - nodes - edges - told
    hidden -= {key for key in hidden - ties if scope.kinds(key).one_a_frame}
    known = sql.found_in(scope)
    once = sql.query.stages and (sql.query.result.whole or not nodes)
    bare = known and once and not {*known.told} <= {*wanted}
    if hidden or bare or (known and not (known.nodes <= nodes and known.edges <= edges)):
        return "SELECT DISTINCT" + text.removeprefix("SELECT")
    return text


def _needless(
    catalog: Catalog, pairs: Iterable[PairNumber], users: frozenset[str]
) -> frozenset[str]:
    """Return the tests for special pairs (such as a carried entity) that the selected traces do not need.

    An example is the height on flat roads.
    """
    uneven = 0
    for trace in catalog.traces:
        uneven |= trace.uneven
    near = "near_" if {key for pair in pairs for key in (pair.a, pair.b)} <= users else ""
    flat = uneven & UNEVEN["flat"] and not near
    storeys = uneven & UNEVEN[f"{near}storeys"]
    left = MARKS - ({"solid"} if flat else set[str]())
    if storeys:
        return left - {"level"}
    return left - {"level"} | {STOREYS} if uneven & UNEVEN["carried"] else left


_USERS: Final = frozenset({*VEHICLES, "person", "animal"})
"""Kinds of road users. Their bodies are never flat."""


def _kinds_of_edges(
    sql: SqlBuilder, scope: Scope, parts: Phases, needed: list[Leaf]
) -> dict[Leaf, str]:
    """Return the node kinds that the rows of edges contain, so that no table of nodes is needed.

    The result is: expression → node.
    """
    found = {leaf: leaf.node for leaf in needed if _is(leaf, "kind")}
    more = {key for leaf in needed if leaf not in found for key in _valued(leaf)} | parts.late
    known = told_kinds(sql, scope, parts) - more
    return {leaf: node for leaf, node in found.items() if node in known}


def _by_buckets(
    sql: SqlBuilder,
    scope: Scope,
    parts: Phases,
    given: SharedRelation | None,
    nodes: frozenset[str],
    edges: frozenset[str],
    wanted: list[Leaf],
) -> str:
    """Return SQL that counts frames: one row per match and bucket (60 frames), with the count."""
    select, texts = _of_buckets(sql, scope, parts, given, nodes, edges, wanted)
    texts[INVARIANT] = held(PATTERN)
    columns = {column: f"{PATTERN}.{column}" for column in columns_of(nodes, edges)}
    columns |= {quoted(column_of(leaf)): texts[leaf] for leaf in wanted}
    select.columns = [named(text, name) for name, text in columns.items()]
    return select.text()


def _of_buckets(
    sql: SqlBuilder,
    scope: Scope,
    parts: Phases,
    given: SharedRelation | None,
    nodes: frozenset[str],
    edges: frozenset[str],
    wanted: Sequence[Leaf],
) -> tuple[Select, dict[Leaf, str]]:
    """Return SQL of the matches as bit masks of frames, joined with those node values that never change.

    The second result is the SQL of each value.
    """
    found = sql.found_in(scope)
    known = set[str]() if found else told_kinds(sql, scope, parts)
    kinds = {leaf: leaf.node for leaf in wanted if _is(leaf, "kind") and leaf.node in known}
    text = masks(sql, scope, parts, given, nodes, edges, frozenset(kinds.values()))
    select = Select()
    if len(scope.edges) > 1 and scope is sql.query.scope and not found:
        text = Select(["*"], [quoted(sql.share(text, "pattern"))]).text()
    select.join(nested(text, PATTERN[1:-1]), [])
    bound = {key: f"{PATTERN}.{quoted(f'{key}.id')}" for key in nodes}
    bucket = f'{PATTERN}."bucket"'
    told = found.told if found else {}
    others = [leaf for leaf in wanted if leaf not in kinds and leaf not in told]
    texts = _join_lasting(select, bucket, bound, scope, sql.catalog, others)
    texts |= {leaf: f"{PATTERN}.{quoted(column_of(leaf))}" for leaf in kinds}
    texts |= {leaf: f"{PATTERN}.{quoted(name)}" for leaf, name in told.items()}
    for leaf in wanted:
        if isinstance(leaf, EdgeRelation):
            texts[leaf] = f"CAST({PATTERN}.{quoted(f'{leaf.edge}.type')} AS VARCHAR)"
    return select, texts


def in_masks(
    sql: SqlBuilder, scope: Scope, wanted: Iterable[Leaf], values: Mapping[str, str]
) -> str:
    """Return SQL for the values of each match, and for the frames with these values, as 64-bit masks.

    Parameters
    ----------
    sql : SqlBuilder
    scope : Scope
    wanted : iterable of Leaf
        Leaves of the values.
    values : mapping of str to str
        Quoted column → its SQL, in terms of a relation ``":rows"`` with the columns ``wanted``.
    """
    rows = _lasting(sql, scope, wanted)
    if rows is not None:
        return merged(rows, values)
    rows = frames(sql, scope, None, frozenset(), frozenset(), wanted)
    select = Select(['"frame_id"'], [nested(rows, ":rows")])
    select.columns += [f"{text} AS {column}" for column, text in values.items()]
    return folded(select.text(), list(values))


def _lasting(sql: SqlBuilder, scope: Scope, wanted: Iterable[Leaf]) -> str | None:
    """Return SQL with one row per match and bucket (60 frames); None if a value can change in a bucket."""
    parts, wanted = phases(sql, scope), list(dict.fromkeys(wanted))
    known = sql.found_in(scope)
    if (known and not known.runs) or parts.rest or parts.late:
        return None
    told = known.told if known else {}
    if not all(leaf in told or is_lasting(leaf, scope, sql.catalog) for leaf in wanted):
        return None
    nodes = frozenset(key for leaf in wanted for key in nodes_of(leaf))
    edges = frozenset(leaf.edge for leaf in wanted if isinstance(leaf, EdgeRelation))
    select, texts = _of_buckets(sql, scope, parts, None, nodes, edges, wanted)
    select.columns = in_which(PATTERN)
    select.columns += [named(texts[leaf], quoted(column_of(leaf))) for leaf in wanted]
    return select.text()


def _first_phase(
    sql: SqlBuilder,
    scope: Scope,
    parts: Phases,
    given: SharedRelation | None,
    bound: frozenset[str],
    ties: frozenset[str],
    needed: list[Leaf],
) -> tuple[Join, SharedRelation | None]:
    """Return a join of the matches, with one row per frame instead of bit masks; and a shared subquery."""
    join, nodes = Join(), bound - parts.late
    if parts.empty:
        return join, None
    blocks = any(isinstance(leaf, BlockValue) for leaf in needed)
    join.nodes |= {key: f"{PATTERN}.{quoted(f'{key}.id')}" for key in nodes}
    join.edges |= {key: f"{PATTERN}.{quoted(f'{key}.type')}" for key in ties}
    known = sql.found_in(scope)
    if known is not None:
        join.select.lenient = True  # absent values of the frame are unknown
        join.select.join(known.frames(PATTERN[1:-1]), [])
        join.frame = f'{PATTERN}."frame_id"'
        if not blocks:
            return join, None
        keys = columns_of(bound)
        rows = Select(['"frame_id"', *keys], [known.frames(":found")], distinct=True)
        name = sql.share(folded(rows.text(), keys), "pattern")
        return join, SharedRelation(name, bound, frozenset())
    told = _kinds_of_edges(sql, scope, parts, needed)
    join.texts |= {leaf: f"{PATTERN}.{quoted(column_of(leaf))}" for leaf in told}
    kinds = frozenset(told.values())
    text = masks(sql, scope, parts, given, nodes, ties, kinds)
    # The database cannot estimate the number of rows of several edges or a block in advance.
    if blocks or (scope is sql.query.scope and (len(scope.edges) > 1 or parts.blocks)):
        given = SharedRelation(sql.share(text, "pattern"), nodes, ties)
        text = Select(["*"], [quoted(given.name)]).text()
    leader = _leader(sql, scope, parts, nodes, needed)
    if leader is None:
        join.select.join(nested(expanded(text, nodes, ties, kinds), PATTERN[1:-1]), [])
        join.frame = f'{PATTERN}."frame_id"'
    else:
        join.select.join(nested(text, PATTERN[1:-1]), [])
        _join_leader(sql, join, scope, leader)
    return join, given


def _leader(
    sql: SqlBuilder, scope: Scope, parts: Phases, nodes: frozenset[str], needed: list[Leaf]
) -> str | None:
    """Return the node at whose states SQL starts, if this is faster than to expand bit masks; else None.

    The states are then looked up in the few rows of the first phase, and not these rows among the many
    states. If the query selects traces, it is faster to start from the frames.
    """
    if parts.trace or (
        scope is sql.query.scope and (sql.query.ego is not None or sql.catalog.only is not None)
    ):
        return None
    moving = [
        key
        for key in sorted({key for leaf in needed for key in _valued(leaf)} & nodes)
        if Profile.of(scope.kinds(key), sql.catalog).places == 1
        and Home.state in _tables_of(sql, scope, key, needed)
    ]
    others = [key for key in moving if scope.kinds(key).other]
    return next(iter(others or moving), None)


def _join_leader(sql: SqlBuilder, join: Join, scope: Scope, key: str) -> None:
    alias = quoted(key)
    frame = f'{alias}."frame_id"'
    on = [f'{frame} >> 6 = {PATTERN}."bucket"', f'{alias}."node_id" = {join.nodes[key]}']
    on += _of_kinds(sql, scope, key, alias)
    join.select.join(f'"state" AS {alias}', [*on, in_mask(PATTERN, frame)])
    join.select.where += sql.within(frame, 64, met=True)
    join.frame = frame
    # The condition is on the bucket, so that constants are looked up for the rows of masks, and not for all
    # states.
    join.trace = f'{PATTERN}."bucket" >> 18'
    join.at[key] = Aliases(state=alias)


def _of_kinds(sql: SqlBuilder, scope: Scope, key: str, state: str) -> list[str]:
    """Return SQL conditions that keep only rows of ``state`` with the allowed kinds of a node.

    For the ego, ``is_ego`` is sufficient.
    """
    if scope.kinds(key).one_a_frame and key not in phases(sql, scope).late:
        return [f'{state}."is_ego"']
    return kind_conditions(
        scope.kinds(key), f'{state}."kind"', f'{state}."is_ego"', sql.catalog.moving
    )


def _tables_of(
    sql: SqlBuilder, scope: Scope, key: str, needed: list[Leaf], *, stated: bool = False
) -> set[Home]:
    """Return the tables that have the needed attributes of a node. If ``stated``, include the state table."""
    profile = Profile.of(scope.kinds(key), sql.catalog)
    of_it = [leaf for leaf in needed if key in _valued(leaf)]
    homes = _homes(of_it, profile)
    if profile.places == 1 and profile.moving and (stated or Home.state in homes):
        # The state also has the kind of the node, and so its name.
        homes = {Home.state} | _homes([leaf for leaf in of_it if not _of_kind(leaf)], profile)
    return homes


def _second_phase(
    sql: SqlBuilder,
    join: Join,
    scope: Scope,
    parts: Phases,
    given: SharedRelation | None,
    needed: list[Leaf],
) -> None:
    """Join the tables with needed values to the candidate frames, and store the SQL of each value."""
    needed = [leaf for leaf in needed if leaf not in join.texts]
    for key in sorted(parts.late):
        _bind_late(sql, join, scope, key)
    join.select.where += [
        f"{join.nodes[a]} <> {join.nodes[b]}" for a, b in apart(scope, set(join.nodes), parts.late)
    ]
    if parts.empty:
        join.select.where += sql.of_traces(f"{join.frame} >> 24", scope)
    _join_rows(sql, join, scope, needed)
    for key in sorted({key for leaf in needed for key in _valued(leaf)}):
        stated = key in join.at and join.at[key].state is not None
        homes = _tables_of(sql, scope, key, needed, stated=stated)
        _join_values(sql, join, scope, key, homes)
    told: dict[Leaf, str] = {INVARIANT: "1"}
    if sql.found is not None:
        told |= {leaf: f"{PATTERN}.{quoted(name)}" for leaf, name in sql.found.told.items()}
    for leaf in needed:
        if not isinstance(leaf, PairNumber) or leaf.function in WAYS:
            join.texts[leaf] = told.get(leaf) or _value_text(sql, join, scope, given, leaf)


def _bind_late(sql: SqlBuilder, join: Join, scope: Scope, key: str) -> None:
    """Join the states of a node that the matches (as bit masks of frames) do not contain."""
    alias = quoted(key)
    on = [f'{alias}."frame_id" = {join.frame}'] if join.frame else []
    on += _of_kinds(sql, scope, key, alias)
    join.select.join(f'"state" AS {alias}', on)
    join.select.where += sql.within(f'{alias}."frame_id"', 64, met=bool(join.frame))
    join.frame = join.frame or f'{alias}."frame_id"'
    join.nodes[key] = f'{alias}."node_id"'
    join.at[key] = Aliases(state=alias)


def _join_rows(sql: SqlBuilder, join: Join, scope: Scope, needed: list[Leaf]) -> None:
    """Join the tables of frames, traces and maps if a value needs them."""
    kinds = {type(leaf) for leaf in needed}
    about = {key for leaf in needed for key in _valued(leaf)}
    about |= {
        leaf.node
        for leaf in needed
        if isinstance(leaf, NodeAttribute) and leaf.attribute.unit is DisplayUnit.owner
    }
    on_map = any(Profile.of(scope.kinds(key), sql.catalog).mapped for key in about)
    position = any(is_position(leaf) for leaf in needed)
    pairs_on_map = on_map and PairNumber in kinds
    trace = TraceAttribute in kinds or position or pairs_on_map
    of_frame = [leaf for leaf in needed if isinstance(leaf, FrameAttribute) and leaf != INVARIANT]
    since = any(leaf.attribute.unit is DisplayUnit.seconds for leaf in of_frame)
    if on_map or trace or since or of_frame:
        join.select.join(f'"frame" AS {FRAME}', [f'{FRAME}."frame_id" = {join.frame}'])
    if trace or since:
        on = [f'{TRACE}."trace_id" = {FRAME}."trace_id"']
        join.select.join(f'"trace" AS {TRACE}', on)
    if any(
        isinstance(leaf, TraceAttribute) and Home.map in leaf.attribute.columns for leaf in needed
    ):
        on = [f'{MAP}."map_id" = {TRACE}."map_id"']
        join.select.join(f'"map" AS {MAP}', on, "LEFT JOIN")


def _join_values(sql: SqlBuilder, join: Join, scope: Scope, key: str, homes: set[Home]) -> None:
    """Join the tables with the needed attributes of a node."""
    profile = Profile.of(scope.kinds(key), sql.catalog)
    at, node = join.at.get(key, Aliases()), join.nodes[key]
    state, entity, part = at.state, None, None
    if Home.state in homes and state is None:
        state = quoted(key)
        on = [f'{state}."frame_id" = {join.frame}']
        if not scope.kinds(key).one_a_frame:  # a single column can filter during the scan
            on.append(f'{state}."node_id" = {node}')
        on += _of_kinds(sql, scope, key, state) + sql.within(f'{state}."frame_id"', 64, met=True)
        alone = profile.places == 1
        join.select.join(f'"state" AS {state}', on, "JOIN" if alone else "LEFT JOIN")
    if homes & {Home.entity, Home.scenery}:
        entity = quoted(f"{key}.entity")
        trace = join.trace or f"{join.frame} >> 24"
        on = [f'{entity}."trace_id" = {trace}', f'{entity}."node_id" = {node}']
        how = "LEFT JOIN" if profile.mapped else "JOIN"
        join.select.join(f'"entity" AS {entity}', on, how)
    if Home.map in homes:
        part = quoted(f"{key}.map")
        on = [f'{part}."map_id" = {FRAME}."map_id"', f'{part}."node_id" = {node}']
        how = "JOIN" if profile.places == 1 else "LEFT JOIN"
        join.select.join(f'"map_node" AS {part}', on, how)
    join.at[key] = Aliases(state, entity, part, TRACE)


def _value_text(  # noqa: PLR0911 - a case each
    sql: SqlBuilder, join: Join, scope: Scope, given: SharedRelation | None, leaf: Leaf
) -> str:
    """Return the SQL of a value. If the value comes from an edge or from braces, join the table for it."""
    match leaf:
        case NodeValue(node=node):
            return join.nodes[node]
        case NodeAttribute(node=node, attribute=attribute):
            return _of_node(sql, join, scope, node, attribute)
        case EdgeRelation(edge=edge):
            return f"CAST({join.edges[edge]} AS VARCHAR)"
        case EdgeAttribute(edge=edge):
            return _of_edge(sql, join, scope, edge, leaf)
        case FrameAttribute() | TraceAttribute():
            return frame_text(leaf, FRAME, TRACE, MAP)
        case BlockValue():
            return _of_block(sql, join, given, leaf)
        case Happened(nodes=nodes):
            return happened_text(leaf, join.frame, [join.nodes[key] for key in nodes])
        case PairNumber():  # looked up; other numbers are computed in layers
            return _of_ways(sql, join, scope, leaf)
        case GroupKey():  # only allowed above groups
            raise TypeError(leaf)


def _of_node(sql: SqlBuilder, join: Join, scope: Scope, node: str, attribute: Attribute) -> str:
    if attribute.unit is DisplayUnit.binding:
        return join.nodes[node]
    if attribute.unit is DisplayUnit.owner:
        profile = Profile.of(scope.kinds(node), sql.catalog)
        owned = owner_text(join.nodes[node], profile, f"{join.frame} >> 24", f'{FRAME}."map_id"')
        return if_bound(sql, join.nodes[node], owned)
    if attribute.unit is DisplayUnit.role:
        return role_text(join.frame, join.nodes[node])
    if attribute.unit is DisplayUnit.own:
        return own_text(attribute, join.frame, join.nodes[node])
    if attribute.unit is DisplayUnit.inside:
        state = join.at.get(node, Aliases()).state
        told = [] if state is None else [f'{state}."in_graph"']
        profile = Profile.of(scope.kinds(node), sql.catalog)
        if profile.fixed or profile.mapped:
            told.append(stands_text(join.frame, join.nodes[node]))
        return if_bound(sql, join.nodes[node], f"coalesce({', '.join(told)})")
    value = attribute_text(attribute, join.at[node])
    return if_bound(sql, join.nodes[node], value) if attribute.name == "is_ego" else value


def _is_own(leaf: Leaf) -> TypeGuard[EdgeAttribute]:
    return isinstance(leaf, EdgeAttribute) and leaf.attribute.unit is DisplayUnit.own


def _of_edge(sql: SqlBuilder, join: Join, scope: Scope, key: str, leaf: EdgeAttribute) -> str:
    alias = quoted(f"{key}:in")
    edge = next(edge for edge in scope.edges if edge.key == key)
    if _is_own(leaf):
        to = join.edges[key], join.nodes[edge.dst]
        return own_text(leaf.attribute, join.frame, join.nodes[edge.src], to)
    table, ends = edge_table(edge, join.nodes[edge.src], join.nodes[edge.dst])
    parts = stored_rows(sql.catalog, table, alias)
    names = (
        {part: quoted(f"{key}:in {part}") for part in parts} if len(parts) > 1 else {table: alias}
    )
    for part, name in names.items() if alias not in join.lanes else ():
        on = [f"{name}.{quoted(column)} = {node}" for column, node in ends.items()]
        on.append(f'{name}."bucket" = {join.frame} >> 6')
        of_bit = f'{name}."bit" = {join.frame} & 63'
        on.append(in_mask(name, join.frame) if part.endswith("_repeated") else of_bit)
        join.select.join(f"{quoted(part)} AS {name}", on, "LEFT JOIN")
    join.lanes.add(alias)
    texts = [lane_text(leaf, name) for name in names.values()]
    return texts[0] if len(texts) == 1 else f"coalesce({', '.join(texts)})"


def _of_ways(sql: SqlBuilder, join: Join, scope: Scope, leaf: PairNumber) -> str:
    """Return the SQL of a number along lanes. All lane distances of the ego use a single join."""
    nodes = join.nodes[leaf.a], join.nodes[leaf.b]
    kinds = [scope.kinds(key) for key in (leaf.a, leaf.b)]
    never = frozenset(SIGNALS) - sql.catalog.ego_signals
    kinds = [Kinds(one.ego - never, one.other) for one in kinds]
    ends = WayEnd(nodes[0], kinds[0]), WayEnd(nodes[1], kinds[1])
    of_ego = any(one.one_a_frame for one in kinds)
    if not (of_ego and is_between_entities(leaf.function, ends, sql.catalog)):
        return way_text(leaf.function, join.frame, ends, sql.catalog)
    alias = f":ways {leaf.a} {leaf.b}"
    if alias not in join.lanes:
        join.lanes.add(alias)
        within = sql.within('":a"."frame_id"', 64, met=True)
        on = [
            f"{quoted(alias)}.{column} = {value}"
            for column, value in zip(
                ('"frame_id"', '"src"', '"dst"'), (join.frame, *nodes), strict=True
            )
        ]
        join.select.join(nested(lane_distances(ends, sql.catalog, within), alias), on, "LEFT JOIN")
    return f'{quoted(alias)}."value"'


def _of_block(sql: SqlBuilder, join: Join, given: SharedRelation | None, leaf: BlockValue) -> str:
    """Return the SQL of a value such as ``COUNT {…}``, joined by frame and by nodes from outside the braces."""
    keys = frozenset(leaf.scope.outer)
    alias = f":block {leaf.number}"
    if alias not in join.lanes:  # a condition may use a block twice
        join.lanes.add(alias)
        rows = _block_rows(sql, leaf, given, keys)
        on = [f'{quoted(alias)}."frame_id" = {join.frame}']
        on += [
            f"{quoted(alias)}.{column} = {join.nodes[key]}"
            for key, column in zip(sorted(keys), columns_of(keys), strict=True)
        ]
        join.select.join(nested(rows, alias), on, "LEFT JOIN")
    value = f'{quoted(alias)}."value"'
    if leaf.word == "EXISTS":
        return f"coalesce({value}, FALSE)"
    return f"coalesce({value}, 0)" if leaf.word in {"COUNT", "SUM"} else value


def _block_rows(
    sql: SqlBuilder, leaf: BlockValue, given: SharedRelation | None, keys: frozenset[str]
) -> str:
    if leaf.word == "EXISTS":
        # A column that is not a key: DuckDB 2.0.0 has a bug if keys are tested for NULL.
        rows = frames(sql, leaf.scope, given, keys)
        return Select(["*", 'TRUE AS "value"'], [nested(rows, ":block")]).text()
    parts = list(leaves(leaf.value)) if leaf.value is not None else []
    select = Select(['"frame_id"', *columns_of(keys)])
    select.join(nested(block_matches(sql, leaf, given, parts), ":counted"), [])
    select.group = list(select.columns)
    if leaf.value is None:
        select.columns.append('count(*) AS "value"')
    else:
        value = expression_text(leaf.value, lambda part: quoted(column_of(part)), sql.values)
        select.columns.append(f'{leaf.word.lower()}({value}) AS "value"')
    return select.text()


def _is(leaf: Leaf, name: str) -> TypeGuard[NodeAttribute]:
    return isinstance(leaf, NodeAttribute) and leaf.attribute is NODE_ATTRIBUTES[name]


_BARE: Final = {DisplayUnit.binding, DisplayUnit.owner, DisplayUnit.role, DisplayUnit.own}
"""Units of attributes that SQL computes without any table of the node."""


def _valued(leaf: Leaf) -> frozenset[str]:
    """Return the nodes that a value needs. Their tables must be joined before the value is computed."""
    match leaf:
        case NodeAttribute(node=node, attribute=attribute):
            return frozenset() if attribute.unit in _BARE else frozenset({node})
        case PairNumber(function=function, a=a, b=b):
            return frozenset() if function in LOOKED_UP else frozenset({a, b})
        case _:
            return frozenset()


def _homes(needed: list[Leaf], profile: Profile) -> set[Home]:
    """Return the tables that contain the needed attributes of a node of these kinds."""
    homes: set[Home] = set()
    for leaf in needed:
        if isinstance(leaf, PairNumber):
            homes |= {Home.state, Home.scenery, Home.map}
        elif isinstance(leaf, NodeAttribute):
            homes |= homes_of(leaf.attribute, profile)
    return {home for home in homes if profile.has(home)}


def _of_kind(leaf: Leaf) -> bool:
    """True if a value is the kind of a node, or its name (kind and id)."""
    return _is(leaf, "kind") or _is(leaf, "name")


def _join_lasting(
    select: Select,
    bucket: str,
    nodes: Mapping[str, str],
    scope: Scope,
    catalog: Catalog,
    needed: Iterable[Leaf],
) -> dict[Leaf, str]:
    """Join tables of constant node values to the matches (as bit masks of frames). Return the values' SQL.

    Results with only such values need no single frames. Their count is the number of frames in a mask.
    """
    needed = list(needed)
    trace = f"{bucket} >> 18"
    of_traces = [leaf for leaf in needed if isinstance(leaf, TraceAttribute)]
    if of_traces:
        select.join(f'"trace" AS {TRACE}', [f'{TRACE}."trace_id" = {trace}'])
    if any(Home.map in leaf.attribute.columns for leaf in of_traces):
        on = [f'{MAP}."map_id" = {TRACE}."map_id"']
        select.join(f'"map" AS {MAP}', on, "LEFT JOIN")
    of_nodes = [leaf for leaf in needed if isinstance(leaf, NodeAttribute)]
    of_nodes = [leaf for leaf in of_nodes if leaf.attribute.unit is not DisplayUnit.binding]
    profiles = {leaf.node: Profile.of(scope.kinds(leaf.node), catalog) for leaf in of_nodes}
    if any(profile.mapped for profile in profiles.values()):
        select.join(f'"bucket" AS {BUCKET}', [f'{BUCKET}."bucket" = {bucket}'])
    owned = [leaf for leaf in of_nodes if leaf.attribute.unit is DisplayUnit.owner]
    texts: dict[Leaf, str] = {
        leaf: owner_text(nodes[leaf.node], profiles[leaf.node], trace, f'{BUCKET}."map_id"')
        for leaf in owned
    }
    of_nodes = [leaf for leaf in of_nodes if leaf not in texts]
    profiles = {key: profiles[key] for key in {leaf.node for leaf in of_nodes}}
    at: dict[str, Aliases] = {}
    for key, profile in sorted(profiles.items()):
        entity = part = None
        if profile.moving or profile.fixed:
            entity = quoted(f"{key}.entity")
            on = [f'{entity}."trace_id" = {trace}', f'{entity}."node_id" = {nodes[key]}']
            select.join(f'"entity" AS {entity}', on, "LEFT JOIN" if profile.mapped else "JOIN")
        if profile.mapped:
            part = quoted(f"{key}.map")
            on = [f'{part}."map_id" = {BUCKET}."map_id"', f'{part}."node_id" = {nodes[key]}']
            select.join(f'"map_node" AS {part}', on, "LEFT JOIN" if entity else "JOIN")
        at[key] = Aliases(entity=entity, map=part)
    texts |= {leaf: attribute_text(leaf.attribute, at[leaf.node]) for leaf in of_nodes}
    for leaf in needed:
        match leaf:
            case TraceAttribute():
                texts[leaf] = frame_text(leaf, "", TRACE, MAP)
            case NodeValue(node=node) | NodeAttribute(node=node) if leaf not in texts:
                texts[leaf] = nodes[node]
            case _:
                pass
    return texts
