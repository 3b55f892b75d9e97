"""Relations of frames and bindings as statements of their own, and results of matches that are known already.

What looks at several frames is worked out in columns, of relations that come from a store
(:func:`relation`); what is found comes back as a relation that the results of a query are taken from, as if the
pattern had just been searched for (:class:`Told`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang.bound import (
    Column,
    NodeAttribute,
    NodeValue,
    Result,
    Scope,
    TraceAttribute,
)
from sgstore.lang.catalog import NODE_ATTRIBUTES, TRACE_ATTRIBUTES, Type
from sgstore.lang.formulas import expression_text, leaves, nested, quoted
from sgstore.lang.frames import Frames, column_of
from sgstore.lang.results import Statement, rows
from sgstore.lang.rewrite import rewritten

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.lang.bound import Bound, Query
    from sgstore.lang.catalog import Catalog
    from sgstore.lang.phases import Window

FRAME: Final = "frame_id"


def relation(
    query: Query, catalog: Catalog, window: Window | None, values: Iterable[Bound] = ()
) -> Statement:
    """The statement for the frames and bindings in which a pattern holds.

    Parameters
    ----------
    query : Query
        Its result does not matter. All nodes are bound, and the edges that have names.
    catalog : Catalog
    window : Window or None
        The buckets to look at; ``None``: all.
    values : iterable of Bound
        Asked of each match.

    Returns
    -------
    Statement
        Columns: ``frame_id``, the keys of the nodes in alphabetical order, those of the edges, then the values,
        as ``:0``, ``:1``, … Rows have no order.
    """
    query = rewritten(query, catalog)
    values = list(values)
    writer = Frames(query, catalog, window)
    nodes = sorted(query.scope.nodes)
    edges = sorted(edge.key for edge in query.scope.edges if edge.named)
    wanted = [leaf for value in values for leaf in leaves(value)]
    text = writer.frames(query.scope, None, frozenset(nodes), frozenset(edges), wanted)
    columns = [f'":rows"."{FRAME}" AS "{FRAME}"']
    columns += [f'":rows".{quoted(f"{key}.id")} AS {quoted(key)}' for key in nodes]
    columns += [
        f'CAST(":rows".{quoted(f"{key}.type")} AS VARCHAR) AS {quoted(key)}' for key in edges
    ]
    for number, value in enumerate(values):
        told = expression_text(
            value, lambda leaf: f'":rows".{quoted(column_of(leaf))}', writer.values
        )
        columns.append(f'{told} AS ":{number}"')
    body = "SELECT " + ",\n  ".join(columns) + "\nFROM " + nested(text, ":rows")
    before = [
        f"{quoted(name)} AS NOT MATERIALIZED (\n{shadow}\n)" for name, shadow in catalog.shadows
    ]
    before += [f"{quoted(name)} AS (\n{shared}\n)" for name, shared in writer.shared]
    sql = f"WITH {', '.join(before)}\n{body}" if before else body
    names = (FRAME, *nodes, *edges, *(f":{number}" for number in range(len(values))))
    return Statement(sql, tuple(writer.values.items), names)


CLOCK: Final = """SELECT "frame_id", "seq", "time_ns", "log_time_ns" FROM "frame"
WHERE "frame_id" >= $1 AND "frame_id" < $2 ORDER BY "frame_id" """
"""The frames of a range, in order."""

TRACES: Final = 'SELECT "trace_id", "name", "start_ns", coalesce("period_ns", 0) FROM "trace"'
"""All traces: what the times of their frames are counted by."""


def entities(query: Query, node: str, catalog: Catalog, window: Window | None) -> Statement:
    """The statement for the nodes of some kinds that are in a trace in any frame.

    Parameters
    ----------
    query : Query
        Whose node it is.
    node : str
        Its key.

    Returns
    -------
    Statement
        Columns: ``trace_id``, ``node_id``, ``name``; each node of a trace once.
    """
    scope = Scope({node: replace(query.scope.nodes[node], role="named")}, {}, (), (), frozenset())
    columns = (
        Column("trace_id", TraceAttribute(TRACE_ATTRIBUTES["id"], Type.number)),
        Column("node_id", NodeValue(node)),
        Column("name", NodeAttribute(node, NODE_ATTRIBUTES["name"], Type.text)),
    )
    result = Result(columns=columns, whole=False, distinct=True)
    asked = replace(query, scope=scope, result=result, steps=(), links=())
    return rows(rewritten(asked, catalog), catalog, window)
