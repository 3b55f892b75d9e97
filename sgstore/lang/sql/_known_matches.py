"""SQL for results whose matches are computed outside the database, such as those of a sequence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import quoted
from sgstore.lang.catalog import Attribute, DisplayUnit, Type
from sgstore.lang.ir import (
    FrameAttribute,
    OverMatch,
    SignalCall,
    StepTime,
    is_formula,
    with_operands,
)
from sgstore.lang.sql._frame_relations import GATHERED
from sgstore.lang.sql._masks import SqlBuilder
from sgstore.lang.sql._plan import Gathered, SharedRelation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import Bound, Query
    from sgstore.lang.sql._windows import Window


@dataclass(frozen=True, slots=True, eq=False)
class ExternalRelation:
    """Matches that were computed outside the database, as columns of frames, node ids and values.

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
    """Return an empty table of matches with the columns that a query needs."""
    nodes: dict[str, list[int]] = {key: [] for key in query.scope.nodes}
    edges: dict[str, list[str]] = {edge.key: [] for edge in query.scope.edges}
    return ExternalRelation([], [], nodes, edges, [[] for _ in range(values)])


_TYPES: Final = {Type.number: "DOUBLE", Type.text: "VARCHAR", Type.boolean: "BOOLEAN"}
FROM: Final = FrameAttribute(
    Attribute(":from", Type.number, {}, "", DisplayUnit.whole), Type.number
)
TO: Final = FrameAttribute(Attribute(":to", Type.number, {}, "", DisplayUnit.whole), Type.number)

SPAN: Final = (FROM, TO)
"""Placeholders for the first and last ``frame_id`` of a match over several frames."""


def external_matches(
    query: Query,
    catalog: Catalog,
    found: ExternalRelation | Callable[[Window | None], ExternalRelation],
    told: Sequence[FrameAttribute],
) -> SqlBuilder:
    """Return an SQL builder for a query. Its matches are computed outside the database.

    Its other values come from the store.

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
    """Return a list of columns with the matches that were computed outside the database.

    Nodes and edges have the order of ``shape``.
    """
    nodes = [found.nodes[key] for key in shape.nodes]
    edges = [found.edges[key] for key in shape.edges]
    return [found.first, found.last, *nodes, *edges, *found.values]


def with_places(query: Query) -> tuple[Query, dict[Bound, FrameAttribute]]:
    """Replace values that depend on several frames in the result of a query by placeholders.

    Return the new query and the placeholder of each value.
    """
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
