"""Catalogs of a store for the query compiler: names, types and row counts. Each abstraction has one.

With an abstraction, a query sees other tables under the same names: *shadows*, defined before its statement.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import literal
from sgstore.graphs.abstractions import SUBSETS
from sgstore.lang.catalog import (
    NODE_ATTRIBUTES,
    Catalog,
    Home,
    RelationScope,
    TraceFacts,
    Type,
    excluded_kinds,
    own_type,
    relations_of_set,
)
from sgstore.model.vocabulary import BEYOND, NAMES, SIGNALS
from sgstore.store._schema import others_of
from sgstore.store._traces import stored_traces

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from duckdb import DuckDBPyConnection

    from sgstore.graphs.abstractions import Subset
    from sgstore.lang.catalog import Triple
    from sgstore.store._derive import DerivedSet


_NUMBERS: Final = frozenset({"BIGINT", "UBIGINT", "HUGEINT", "DOUBLE"})
"""JSON types that are numbers."""


def catalog_of(connection: DuckDBPyConnection) -> Catalog:
    """Return the catalog of a store: names, types and counts for the query compiler."""

    def kinds(of: str) -> frozenset[str]:
        found = connection.execute(f"SELECT DISTINCT kind FROM {of}").fetchall()
        return frozenset(kind for (kind,) in found)

    classed = connection.execute(
        "SELECT DISTINCT abstraction FROM frame_class UNION SELECT DISTINCT abstraction FROM later_class"
    ).fetchall()
    rows = connection.execute(
        "SELECT trace_id, min(bucket), max(bucket) - min(bucket) + 1 FROM bucket GROUP BY trace_id"
    ).fetchall()
    extents = {trace: (first, buckets) for trace, first, buckets in rows}
    moving, fixed, mapped = (
        kinds(of) for of in ("entity WHERE NOT is_static", "entity WHERE is_static", "map_node")
    )
    whole = Catalog(
        edges=_counted(connection, "edge"),
        map_edges=_counted(connection, "map_edge"),
        moving=moving,
        fixed=fixed,
        mapped=mapped,
        lacking=_lacking(connection, {Home.scenery: fixed, Home.map: mapped}),
        ego_signals=kinds(f"state WHERE is_ego AND kind IN ({_words(SIGNALS)})"),
        traces=tuple(
            TraceFacts(
                t.trace_id,
                t.name,
                t.ego,
                frozenset(t.answers),
                RelationScope.of(t.settings),
                t.period_ns,
                extents.get(t.trace_id, (0, 0)),
                known_range(t.report.get("scope")),
                uneven=t.uneven,
                excluded=excluded_kinds(
                    t.settings.get("kinds", ()), (t.report.get("scope") or {}).get("excluded", ())
                ),
            )
            for t in stored_traces(connection)
        ),
        classed=tuple(sorted(name for (name,) in classed)),
        names={enum: others_of(connection, enum) for enum in NAMES},
        own=_own(connection, "relation IS NULL"),
        own_edges=_own(connection, "relation IS NOT NULL"),
        **_beyond(connection),
    )
    sets = subset_catalogs()
    derived: dict[str, list[DerivedSet]] = {}
    for one in _sets(connection):
        derived.setdefault(one.name, []).append(one)
    for name, of in derived.items():
        changes = _derived(connection, whole, name, of)
        sets[name] = lambda catalog, changes=changes: replace(catalog, **changes)
    return replace(whole, sets=sets)


def subset_catalogs() -> dict[str, Callable[[Catalog], Catalog]]:
    """For each abstraction that drops nodes or edges, return a function that adapts the store's catalog."""
    return {name: partial(_narrowed, name=name, of=of) for name, of in SUBSETS.items()}


def _sets(connection: DuckDBPyConnection) -> tuple[DerivedSet, ...]:
    """Return the named sets of relations that were derived after ingest. Without any, avoid a slow import."""
    if connection.execute("SELECT 1 FROM derived LIMIT 1").fetchone() is None:
        return ()
    from sgstore.store._derive import sets_of

    return sets_of(connection)


def known_range(scope: Mapping[str, Any] | None) -> float:
    """Return the distance around the ego within which the store has all recorded objects; m.

    Infinite means everything.

    Parameters
    ----------
    scope : mapping or None
        Counts of excluded data from the report of a trace.
    """
    if scope is None or not scope["beyond_world"]:
        return math.inf
    return float(max(scope["radius"] or 0.0, scope["world"]))


_KNOWN: Final = ("state", "node", "lane_state", "lane_gap")
"""Graph tables with a ``known_…`` version that includes the data outside the graphs."""


def _beyond(connection: DuckDBPyConnection) -> dict[str, Any]:
    """Return the catalog fields for objects outside the graphs; an empty dict without such objects."""
    tables = ("world_state", "world_node", "world_edge")
    there = " UNION ALL ".join(f"(SELECT 1 FROM {table} LIMIT 1)" for table in tables)
    if connection.execute(there).fetchone() is None:
        return {}
    beyond = {table: f"SELECT * FROM inside.known_{table}" for table in _KNOWN}
    beyond["entity"] = "SELECT * REPLACE (world_parked AS parked) FROM inside.entity"
    beyond["graph_node"] = "SELECT * FROM inside.node"
    beyond["known_edge"] = "SELECT * FROM inside.known_edge"
    edges = _counted(connection, "world_edge")
    return {"beyond": tuple(beyond.items()), "beyond_edges": edges}


def _own(connection: DuckDBPyConnection, whose: str) -> dict[str, Type]:
    """Return the types of user-defined attributes of nodes or of edges: attribute name → type.

    In a trace, an attribute is a number or a truth value if all its values are; else it is a text.
    """
    types = "list(DISTINCT json_type(value)) FILTER (json_type(value) <> 'NULL')"
    whole = "bool_and(regexp_full_match(value::VARCHAR, '-?[0-9]+'))"
    large = f"coalesce(max(abs(TRY_CAST(value::VARCHAR AS DOUBLE))), 0) >= {2**53}"
    rows = connection.execute(
        f"SELECT attribute, {types}, {whole}, {large} FROM attribute WHERE {whose}"
        " GROUP BY attribute, frame_id >> 24 ORDER BY ALL"
    ).fetchall()
    found: dict[str, list[tuple[Type, bool, bool]]] = {}
    for name, told, is_whole, is_large in rows:
        number = bool(told) and _NUMBERS.issuperset(told)
        kind = Type.boolean if told == ["BOOLEAN"] else Type.number if number else Type.text
        found.setdefault(name, []).append((kind, is_whole, is_large))
    return {name: _type_of(traces) for name, traces in found.items()}


def _type_of(traces: list[tuple[Type, bool, bool]]) -> Type:
    """Return the common type of a user-defined attribute. Its type can differ from trace to trace.

    Each trace adds its type and two flags: whole values, large values.
    """
    kind = own_type([one for one, _, _ in traces])
    numbers = [flags for one, *flags in traces if one is Type.number]
    exact = all(whole for whole, _ in numbers) and any(large for _, large in numbers)
    return Type.whole if kind is Type.number and exact else kind


_STATED: Final = ("heading", "length", "width", "height", "speed", "vx")
"""Attributes whose missing values are searched in the table of states."""

_HOLDERS: Final = {
    Home.state: ("state", "world_state"),
    Home.scenery: ("(SELECT * FROM entity WHERE is_static)",),
    Home.map: ("map_node",),
}
"""Tables with the values of moving nodes, static entities and map parts."""


def _lacking(
    connection: DuckDBPyConnection, held: Mapping[Home, frozenset[str]]
) -> dict[str, frozenset[str]]:
    """For each attribute, return the kinds of nodes that lack a value in some frame: attribute → kinds.

    DuckDB skips row groups without missing values. ``held``: kinds in tables that may not have the column.
    """
    found: dict[str, frozenset[str]] = {}
    parts: list[str] = []
    for name in _STATED:
        columns, kinds = NODE_ATTRIBUTES[name].columns, NODE_ATTRIBUTES[name].kinds
        found[name] = frozenset().union(
            *(of - kinds if home in columns else of for home, of in held.items())
        )
        parts += [
            f"SELECT DISTINCT {literal(name)} AS name, kind FROM {table} AS t WHERE {columns[home]} IS NULL"
            for home in _HOLDERS.keys() & columns.keys()
            for table in _HOLDERS[home]
        ]
    for name, kind in connection.execute(" UNION ALL ".join(parts)).fetchall():
        found[name] |= {kind}
    return found


def _counted(connection: DuckDBPyConnection, table: str) -> dict[Triple, int]:
    sql = f"SELECT relation, src_kind, dst_kind, count(*) FROM {table} GROUP BY ALL"
    return {(r, a, b): n for r, a, b, n in connection.execute(sql).fetchall()}


def _narrowed(whole: Catalog, name: str, of: Subset) -> Catalog:
    """Return the store catalog for an abstraction that drops some nodes and edges of each graph."""
    kinds = of.kinds
    if kinds is None:
        return replace(whole, name=name)
    among = _words(kinds)
    ends = f"src_kind IN ({among}) AND dst_kind IN ({among})"
    shadows = [
        (
            table,
            f'SELECT * FROM inside."{table}" WHERE relation IN ({_words(relations)}) AND {ends}',
        )
        for table, relations in (("edge", of.moving), ("map_edge", of.lasting))
    ]
    shadows += [
        (table, f'SELECT * FROM inside."{table}" WHERE kind IN ({among})')
        for table in ("node", "state")
    ]

    beyond = dict(whole.beyond)
    for table in beyond.keys() & {"state", "node", "graph_node"}:
        beyond[table] += f" WHERE kind IN ({among})"
    if beyond:
        beyond["known_edge"] += f" WHERE relation IN ({_words(of.moving)}) AND {ends}"

    def held(edges: dict[Triple, int], relations: frozenset[str]) -> dict[Triple, int]:
        return {
            (r, a, b): n for (r, a, b), n in edges.items() if r in relations and {a, b} <= kinds
        }

    return replace(
        whole,
        name=name,
        relations=of.moving | of.lasting,
        shadows=tuple(shadows),
        edges=held(dict(whole.edges), of.moving),
        map_edges=held(dict(whole.map_edges), of.lasting),
        moving=whole.moving & kinds,
        fixed=whole.fixed & kinds,
        mapped=whole.mapped & kinds,
        beyond=tuple(beyond.items()),
        beyond_edges=held(dict(whole.beyond_edges), of.moving),
    )


def _derived(
    connection: DuckDBPyConnection, whole: Catalog, name: str, of: list[DerivedSet]
) -> dict[str, Any]:
    """For the traces with a set of relations derived after ingest, return the fields that it changes."""
    answers = {one.trace_id: frozenset(one.answers) for one in of}
    reaches = {one.trace_id: RelationScope.of(one.settings) for one in of}
    word = literal(name)
    shadows = {
        table: f'SELECT * FROM inside."{table}" WHERE trace_id IN'
        f" (SELECT d.trace_id FROM derived AS d WHERE d.name = {word})"
        for table in ("frame", "bucket")
    }
    shadows["edge"] = (
        "SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, mask"
        f" FROM derived_edge WHERE set_name = {word}"
    )
    shadows["lane_gap"] = (
        "SELECT bucket * 64 + bit AS frame_id, bucket, bit, src, dst, gap"
        f" FROM derived_gap WHERE set_name = {word}"
    )
    shadows["node"] = (
        f"SELECT kind, bucket, node_id, mask FROM derived_node WHERE set_name = {word} AND NOT moves"
    )
    states = 'SELECT s.* FROM inside."state"'
    if whole.beyond:  # the range of a set may exceed the range of the graphs
        states = "SELECT s.* EXCLUDE (in_graph) FROM inside.known_state"
        shadows["lane_state"] = "SELECT * EXCLUDE (in_graph) FROM inside.known_lane_state"
    shadows["state"] = (
        f"{states} AS s JOIN derived_node AS d"
        f" ON d.set_name = {word} AND d.moves AND d.bucket = s.frame_id >> 6 AND d.node_id = s.node_id"
        " AND (d.mask & (CAST(1 AS BIGINT) << CAST(s.frame_id & 63 AS INTEGER))) <> 0"
    )
    return {
        "name": name,
        "relations": _relations(connection, whole, of),
        "shadows": tuple(shadows.items()),
        "beyond": tuple(_beyond_derived(dict(whole.beyond), shadows, word).items()),
        "edges": _counted(connection, f"({shadows['edge']})"),
        "traces": tuple(
            replace(trace, answers=answers[trace.trace_id], reach=reaches[trace.trace_id])
            for trace in whole.traces
            if trace.trace_id in answers
        ),
    }


def _beyond_derived(beyond: dict[str, str], shadows: dict[str, str], word: str) -> dict[str, str]:
    """Return SQL for objects outside the graphs, with the edges of a set derived after ingest: table → SQL."""
    if not beyond:
        return {}
    traces = f"(SELECT d.trace_id FROM derived AS d WHERE d.name = {word})"
    for table, trace in (("state", "frame_id >> 24"), ("node", "bucket >> 18")):
        beyond[table] += f" WHERE {trace} IN {traces}"
    beyond["graph_node"] = shadows["node"]
    columns = "relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst"
    beyond["known_edge"] = (
        f"SELECT {columns}, bit_or(mask) AS mask FROM ({shadows['edge']} UNION ALL"
        f" SELECT {columns}, mask FROM inside.known_edge WHERE bucket >> 18 IN {traces}"
        f" AND relation IN ({_words(BEYOND)})) GROUP BY {columns}"
    )
    return beyond


def _relations(
    connection: DuckDBPyConnection, whole: Catalog, of: list[DerivedSet]
) -> frozenset[str] | None:
    """Return the relations that a set derived after ingest can contain; ``None`` if they are unknown.

    If a trace has a road map, the set lacks the relations that no trace answers: a relation needs only settings
    and a map. Without a map, the set lacks only the relations that the traces can answer in the store.
    """
    if any("abstraction" in one.settings for one in of):
        return None  # made by an abstraction function: only its result is known
    numbers = {one.trace_id for one in of}
    answered = frozenset(relation for one in of for relation in one.answers)
    told = connection.execute("SELECT trace_id FROM trace WHERE map_id IS NOT NULL").fetchall()
    known = (t.answers for t in whole.traces if t.trace_id in numbers)
    mapped = bool(numbers & {number for (number,) in told})
    return relations_of_set(answered, frozenset[str]().union(*known), mapped=mapped)


def _words(names: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in sorted(names)) or "NULL"
