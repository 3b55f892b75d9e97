"""Owners of node ids: a trace for an entity, a map for a map part. Two owners may use the same id.

A node id is unique within a trace, or, if negative, within a map. So an entity is identified by trace and id,
a part of a map by map and id. Traces may share a map.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang.catalog import (
    FRAME_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
    Catalog,
    DisplayUnit,
    Type,
)
from sgstore.lang.ir import (
    Aggregate,
    Bound,
    FrameAttribute,
    NodeAttribute,
    NodeValue,
    Operation,
    Query,
    Result,
    ReturnColumn,
    TraceAttribute,
    with_operands,
)
from sgstore.lang.sql._plan import traces_of

if TYPE_CHECKING:
    from collections.abc import Iterable


_TRACE_KEYS: Final = (TRACE_ATTRIBUTES["id"], TRACE_ATTRIBUTES["name"], FRAME_ATTRIBUTES["id"])
"""Attributes that identify a trace, and therefore also the owner of node ids."""

OWNER: Final = Attribute("owner", Type.number, {}, "whose number the node id is", DisplayUnit.owner)
"""Owner of a node id: the trace of an entity, or the map of a map part. Ids are unique only for one owner, and
traces may share a map. Queries cannot use this attribute."""


def owner_of(node: str) -> NodeAttribute:
    """Return the query expression for the owner of a node, which is a trace or a map."""
    return NodeAttribute(node, OWNER, Type.number)


def owners_of(values: Iterable[Bound], query: Query, catalog: Catalog) -> list[NodeAttribute]:
    """Return the owners (trace or map) of the returned nodes, if ids alone do not identify the nodes.

    Empty if only one trace is searched, or if a value identifies the trace.
    """
    values = list(values)
    if _tells_trace(values) or not _several(query, catalog):
        return []
    return list(dict.fromkeys(owner_of(v.node) for v in values if isinstance(v, NodeValue)))


def with_owners(result: Result) -> Result:
    """Return a result with one more column for each node: its owner, which is a trace or a map.

    Rows with a frame need no such columns.
    """
    if result.names:
        return result
    owners = (
        ReturnColumn(f":owner {place}", owner_of(column.value.node))
        for place, column in enumerate(result.columns)
        if isinstance(column.value, NodeValue)
    )
    return replace(result, columns=(*result.columns, *owners))


def counted_apart(query: Query, catalog: Catalog) -> Query:
    """Return a query in which ``COUNT(DISTINCT v)`` counts equal ids of different traces separately."""
    keys = [column.value for column in query.result.columns]
    if _tells_trace(keys) or not _several(query, catalog):
        return query
    return replace(query, result=query.result.changed(_apart))


def _apart(value: Bound) -> Bound:
    match value:
        case Aggregate(distinct=True, operand=NodeValue(node=node) as operand):
            whose = Operation("whose", (operand, owner_of(node)), Type.node)
            return replace(value, operand=whose)
        case _:
            return with_operands(value, _apart)


def _tells_trace(keys: Iterable[Bound]) -> bool:
    return any(
        isinstance(k, FrameAttribute | TraceAttribute) and k.attribute in _TRACE_KEYS for k in keys
    )


def _several(query: Query, catalog: Catalog) -> bool:
    if catalog.part:  # other parts have traces, too
        return True
    chosen, _ = traces_of(query, catalog)
    return len(catalog.traces if chosen is None else chosen) != 1
