"""SQL of relations of frames and bindings, and results for matches that are already known.

Conditions over several frames are evaluated on columns read from a store (:func:`relation`). The matches then
become a relation again, and the results of the query are computed from it (:func:`external_matches`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import quoted
from sgstore.lang.bind import kind_conditions
from sgstore.lang.catalog import (
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
    DisplayUnit,
    Home,
    Type,
)
from sgstore.lang.ir import (
    FrameAttribute,
    Kinds,
    NodeAttribute,
    NodeValue,
    OverMatch,
    Result,
    ReturnColumn,
    Scope,
    SignalCall,
    StepTime,
    TraceAttribute,
    is_formula,
    with_operands,
)
from sgstore.lang.sql._formulas import (
    Aliases,
    Select,
    attribute_text,
    column_of,
    expression_text,
    leaves,
    nested,
)
from sgstore.lang.sql._frames import frames
from sgstore.lang.sql._masks import SqlBuilder
from sgstore.lang.sql._plan import TRACE_OF_FRAME, Gathered, SharedRelation
from sgstore.lang.sql._results import SqlStatement, finished, rows
from sgstore.lang.sql._rewrite import rewritten
from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import Bound, Query
    from sgstore.lang.sql._plan import Window


_WORDS: Final = frozenset({Type.text, Type.edge})
"""Types of values that may be enumerations in the database."""

FRAME: Final = "frame_id"
GATHERED: Final = ":gathered"
"""Table with all matches."""


def relation(
    query: Query,
    catalog: Catalog,
    window: Window | None,
    values: Iterable[Bound] = (),
    bound: Iterable[str] | None = None,
    most: int | None = None,
) -> SqlStatement:
    """Return the SQL for the frames and bindings in which a pattern holds.

    Parameters
    ----------
    query : Query
        Query with the pattern. Its result clause is ignored.
    catalog : Catalog
    window : Window or None
        Buckets to search; ``None`` means all.
    values : iterable of Bound
        Values to compute for each match.
    bound : iterable of str, optional
        Keys of the nodes and edges to return. The others must only exist. ``None`` means all nodes.
    most : int, optional
        Largest number of rows to read.

    Returns
    -------
    SqlStatement
        Columns: ``frame_id``, the keys of the nodes in alphabetical order, those of the edges, then the values,
        as ``:0``, ``:1``, …. The rows are not sorted.
    """
    keys = set(query.scope.nodes if bound is None else bound)
    nodes = sorted(keys & set(query.scope.nodes))
    edges = sorted(keys & {edge.key for edge in query.scope.edges})
    # The values are rewritten together with the pattern, because their blocks are expanded as in conditions.
    asked = tuple(ReturnColumn(f":{n}", value) for n, value in enumerate(values))
    result = Result(columns=asked, whole=False, distinct=False)
    query = rewritten(replace(query, result=result), catalog)
    values = [column.value for column in query.result.columns]
    sql = SqlBuilder(query, catalog, window)
    wanted = [leaf for value in values for leaf in leaves(value)]
    text = frames(sql, query.scope, None, frozenset(nodes), frozenset(edges), wanted)
    columns = [f'":rows"."{FRAME}" AS "{FRAME}"']
    columns += [f'":rows".{quoted(f"{key}.id")} AS {quoted(key)}' for key in nodes]
    columns += [
        f'CAST(":rows".{quoted(f"{key}.type")} AS VARCHAR) AS {quoted(key)}' for key in edges
    ]
    for number, value in enumerate(values):
        told = expression_text(value, lambda leaf: f'":rows".{quoted(column_of(leaf))}', sql.values)
        told = f"CAST({told} AS VARCHAR)" if value.type in _WORDS else told
        columns.append(f'{told} AS ":{number}"')
    body = "SELECT " + ",\n  ".join(columns) + "\nFROM " + nested(text, ":rows")
    body += "" if most is None else f"\nLIMIT {most}"
    return finished(sql, body, (FRAME, *nodes, *edges, *(f":{n}" for n in range(len(values)))))


_CLOCK: Final = """SELECT "frame_id", "seq", "time_ns", "log_time_ns" FROM "frame"
WHERE "frame_id" >= $1 AND "frame_id" < $2"""
CLOCK: Final = f'{_CLOCK} ORDER BY "frame_id"'
"""Frames of a range, in order."""

CLOCK_OF_TRACES: Final = f"""{_CLOCK}
  AND "frame_id" >> {TRACE_OF_FRAME} IN (SELECT unnest(CAST($3 AS BIGINT[]))) ORDER BY "frame_id" """
"""Frames of some traces in a range, in order."""

BUCKETS: Final = """SELECT "bucket", "valid", "joined" FROM "bucket"
WHERE "bucket" >= $1 AND "bucket" < $2"""
"""Buckets of a range, with the masks of their frames and of the frames without a gap before; unsorted."""

TIMES: Final = """SELECT "frame_id", "time_ns" FROM "frame"
WHERE "frame_id" >= $1 AND "frame_id" < $2"""
"""Times of the frames of a range; unsorted."""

TRACES: Final = 'SELECT "trace_id", "name", "start_ns", coalesce("period_ns", 0) FROM "trace"'
"""All traces with their start times and median periods."""


def entities(query: Query, node: str, catalog: Catalog, window: Window | None) -> SqlStatement:
    """Return the SQL for the entities of a query node that occur in any frame of a trace.

    Parameters
    ----------
    query : Query
        Query with the node.
    node : str
        Key of the node.

    Returns
    -------
    SqlStatement
        Columns: ``trace_id``, ``node_id``, ``name``; each node of a trace once.
    """
    scope = Scope({node: replace(query.scope.nodes[node], role="named")}, {}, (), (), frozenset())
    columns = (
        ReturnColumn("trace_id", TraceAttribute(TRACE_ATTRIBUTES["id"], Type.number)),
        ReturnColumn("node_id", NodeValue(node)),
        ReturnColumn("name", NodeAttribute(node, NODE_ATTRIBUTES["name"], Type.text)),
    )
    result = Result(columns=columns, whole=False, distinct=True)
    asked = replace(query, scope=scope, result=result, steps=(), links=())
    return rows(rewritten(asked, catalog), catalog, window)


def traces_with(kinds: Kinds, attribute: Attribute | None, *, moving: bool) -> str:
    """Return the SQL for traces that have a node of given kinds with a known attribute.

    The statement reads tables without a frame join, so it is fast in a large store.

    Parameters
    ----------
    kinds : Kinds
    attribute : Attribute or None
        ``None`` means that no attribute is required.
    moving : bool
        True if only nodes that may move count.

    Returns
    -------
    str
        Column: ``trace_id``; each trace once.
    """

    def known(home: Home, at: Aliases) -> list[str]:
        if attribute is None:
            return []
        told = attribute.unit is DisplayUnit.along or home in attribute.columns
        return [f"{attribute_text(attribute, at)} IS NOT NULL"] if told else ["FALSE"]

    every = frozenset(KINDS)
    constant = attribute is not None and Home.entity in attribute.columns
    texts: list[str] = []
    if not constant:
        state = Select(['"s"."frame_id" >> 24 AS "trace_id"'], ['"state" AS "s"'], distinct=True)
        state.where = kind_conditions(kinds, '"s"."kind"', '"s"."is_ego"', every)
        state.where += known(Home.state, Aliases(state='"s"'))
        texts.append(state.text())
    if constant or not (moving or kinds.one_a_frame):
        entity = Select(['"e"."trace_id"'], ['"entity" AS "e"'], distinct=True)
        entity.where = [] if constant else ['"e"."is_static"']
        among = Kinds(kinds.every, kinds.every)
        entity.where += kind_conditions(among, '"e"."kind"', None, every)
        home = Home.entity if constant else Home.scenery
        entity.where += known(home, Aliases(entity='"e"'))
        texts.append(entity.text())
    if not (moving or kinds.one_a_frame):
        parts = Select(['"b"."trace_id"'], ['"bucket" AS "b"'], distinct=True)
        parts.join('"map_node" AS "m"', ['"m"."map_id" = "b"."map_id"'])
        parts.where = kind_conditions(kinds, '"m"."kind"', None, every)
        parts.where += known(Home.map, Aliases(map='"m"'))
        texts.append(parts.text())
    return "\nUNION\n".join(texts)


TOLD_WEATHER: Final = """SELECT DISTINCT "trace_id" FROM "event"
WHERE "kind" = 'environment' AND regexp_matches("detail", $1)"""
"""Traces with a weather event that matches a regular expression."""


# Known matches ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ExternalRelation:
    """Known matches in columns.

    Attributes
    ----------
    first, last : list of int
        First and last ``frame_id`` of each run of frames with the same match. A run lies in one bucket.
    nodes : dict of str to list of int
        Node ids by key.
    edges : dict of str to list of str
        Relations by the keys of the named edges.
    values : list of lists
        Computed values of each match, in the order of the placeholders of :func:`external_matches`.
    """

    first: list[int]
    last: list[int]
    nodes: dict[str, list[int]]
    edges: dict[str, list[str]]
    values: list[list[Any]]


def nothing(query: Query, values: int) -> ExternalRelation:
    """Return an empty relation of matches for a query."""
    nodes: dict[str, list[int]] = {key: [] for key in query.scope.nodes}
    edges: dict[str, list[str]] = {edge.key: [] for edge in query.scope.edges}
    return ExternalRelation([], [], nodes, edges, [[] for _ in range(values)])


_TYPES: Final = {Type.number: "DOUBLE", Type.text: "VARCHAR", Type.boolean: "BOOLEAN"}
FROM: Final = FrameAttribute(
    Attribute(":from", Type.number, {}, "", DisplayUnit.whole), Type.number
)
TO: Final = FrameAttribute(Attribute(":to", Type.number, {}, "", DisplayUnit.whole), Type.number)
SPAN: Final = (FROM, TO)
"""First and last ``frame_id`` of a match over several frames."""


def external_matches(
    query: Query,
    catalog: Catalog,
    found: ExternalRelation | Callable[[Window | None], ExternalRelation],
    told: Sequence[FrameAttribute],
) -> SqlBuilder:
    """Return a builder for a query whose matches are known. Other values come from the store.

    Parameters
    ----------
    query : Query
        Query whose values use the placeholders of :func:`with_places`.
    catalog : Catalog
    found : ExternalRelation or function
        The matches, or a function that finds them in a window of whole traces. The function is called for one
        window after the other when the statement runs.
    told : sequence of FrameAttribute
        Placeholders for the values of ``found``.
    """
    sql = SqlBuilder(query, catalog)
    shape = found if isinstance(found, ExternalRelation) else nothing(query, len(told))
    names = {leaf: f":value {number}" for number, leaf in enumerate(told)}
    columns = {"first": "BIGINT", "last": "BIGINT"}
    columns |= {f"{key}.id": "BIGINT" for key in shape.nodes}
    columns |= {f"{key}.type": "VARCHAR" for key in shape.edges}
    columns |= {n: "BIGINT" if one in SPAN else _TYPES[one.type] for one, n in names.items()}
    if isinstance(found, ExternalRelation):
        parts = [
            f"unnest(CAST({sql.values.add(rows)} AS {kind}[])) AS {quoted(name)}"
            for rows, (name, kind) in zip(_columns(found, shape), columns.items(), strict=True)
        ]
        name = sql.share("SELECT " + ",\n  ".join(parts), "found")
    else:
        name = GATHERED
        gathered = Gathered(name, columns, lambda window: _columns(found(window), shape))
        sql.gathered = (gathered,)
    nodes, edges = frozenset(shape.nodes), frozenset(shape.edges)
    sql.found = SharedRelation(name, nodes, edges, names, runs=True)
    return sql


def _columns(found: ExternalRelation, shape: ExternalRelation) -> list[list[Any]]:
    """Return all columns of known matches, with nodes and edges in the order of ``shape``."""
    nodes = [found.nodes[key] for key in shape.nodes]
    edges = [found.edges[key] for key in shape.edges]
    return [found.first, found.last, *nodes, *edges, *found.values]


def with_places(query: Query) -> tuple[Query, dict[Bound, FrameAttribute]]:
    """Replace values over time by placeholders. Return the new query and the placeholder of each value."""
    places: dict[Bound, FrameAttribute] = {}

    def placed(value: Bound) -> Bound:
        if not (isinstance(value, SignalCall | StepTime | OverMatch) or is_formula(value)):
            return with_operands(value, placed)
        if value not in places:
            name = f":value {len(places)}"
            attribute = Attribute(name, value.type, {}, "", DisplayUnit.whole)
            places[value] = FrameAttribute(attribute, value.type)
        return places[value]

    return replace(query, result=query.result.changed(placed)), places
