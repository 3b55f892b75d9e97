"""SQL for the frames, entities and traces that a query matches.

Conditions over several frames are evaluated on columns read from a store (:func:`relation`). The matches then
become a relation again (:mod:`sgstore.lang.sql._known_matches`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

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
    Kinds,
    NodeAttribute,
    NodeValue,
    Result,
    ReturnColumn,
    Scope,
    TraceAttribute,
)
from sgstore.lang.sql._attributes import Aliases, attribute_text
from sgstore.lang.sql._expressions import column_of, columns_of, expression_text, leaves
from sgstore.lang.sql._frames import frames, masks, phases
from sgstore.lang.sql._masks import SqlBuilder, folded, in_which
from sgstore.lang.sql._results import SqlStatement, finished, rows
from sgstore.lang.sql._rewrite import rewritten
from sgstore.lang.sql._select import Select, nested
from sgstore.lang.sql._windows import TRACE_OF_FRAME
from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import Bound, Query
    from sgstore.lang.sql._windows import Window


_WORDS: Final = frozenset({Type.text, Type.edge})
"""Types of values that the database may store as enumerations."""

FRAME: Final = "frame_id"
GATHERED: Final = ":gathered"
"""Name of the table with all matches."""


def relation(
    query: Query,
    catalog: Catalog,
    window: Window | None,
    values: Iterable[Bound] = (),
    bound: Iterable[str] | None = None,
    most: int | None = None,
    *,
    masked: bool = False,
) -> SqlStatement:
    """Return the SQL for the frames that match a pattern, and for the ids of the matched nodes.

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
    masked : bool
        Return masks of frames without values. A match may then have several rows in a bucket.

    Returns
    -------
    SqlStatement
        Columns: ``frame_id`` (if masked, ``bucket`` and ``frames``), the keys of the nodes in
        alphabetical order, those of the edges, then the values, as ``:0``, ``:1``, …. The rows are not sorted.
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
    parts, both = phases(sql, query.scope), (frozenset(nodes), frozenset(edges))
    if masked and not (parts.rest or parts.late):
        text = masks(sql, query.scope, parts, None, *both)
    else:
        text = frames(sql, query.scope, None, *both, wanted)
        text = folded(text, columns_of(*both)) if masked else text
    of_frames = ("bucket", "frames") if masked else (FRAME,)
    which = in_which('":rows"') if masked else [f'":rows"."{FRAME}"']
    columns = [f'{column} AS "{name}"' for column, name in zip(which, of_frames, strict=True)]
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
    return finished(sql, body, (*of_frames, *nodes, *edges, *(f":{n}" for n in range(len(values)))))


_CLOCK: Final = """SELECT "frame_id", "seq", "time_ns", "log_time_ns" FROM "frame"
WHERE "frame_id" >= $1 AND "frame_id" < $2"""
CLOCK: Final = f'{_CLOCK} ORDER BY "frame_id"'
"""SQL for the frames of a time range, in order."""

CLOCK_OF_TRACES: Final = f"""{_CLOCK}
  AND "frame_id" >> {TRACE_OF_FRAME} IN (SELECT unnest(CAST($3 AS BIGINT[]))) ORDER BY "frame_id" """
"""SQL for the frames of the selected traces in a time range, in order."""

BUCKETS: Final = """SELECT "bucket", "valid", "joined" FROM "bucket"
WHERE "bucket" >= $1 AND "bucket" < $2"""
"""SQL for frame buckets of a time range: masks of frames, and of frames without a gap before; unsorted."""

TIMES: Final = """SELECT "frame_id", "time_ns" FROM "frame"
WHERE "frame_id" >= $1 AND "frame_id" < $2"""
"""SQL for the times of the frames of a range. Unsorted."""

TRACES: Final = 'SELECT "trace_id", "name", "start_ns", coalesce("period_ns", 0) FROM "trace"'
"""SQL for all traces with their start times and median frame periods."""


def entities(query: Query, node: str, catalog: Catalog, window: Window | None) -> SqlStatement:
    """Return the SQL for all entities of a trace that match a node of the pattern in some frame.

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
    """Return the SQL for the traces with a node that has one of the given kinds and a known attribute.

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
"""SQL for the traces with a weather event that matches a regular expression."""
