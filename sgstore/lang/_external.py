"""Relations of frames and bindings as statements of their own, and results of matches that are known already.

What looks at several frames is worked out in columns, of relations that come from a store
(:func:`relation`); what is found comes back as a relation that the results of a query are taken from, as if the
pattern had just been searched for (:func:`external_matches`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang._catalog import (
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
    DisplayUnit,
    Home,
    Type,
)
from sgstore.lang._formulas import (
    Aliases,
    Select,
    attribute_text,
    column_of,
    expression_text,
    leaves,
    nested,
)
from sgstore.lang._kinds import kind_conditions
from sgstore.lang._plan import TRACE_OF_FRAME, Gathered, SharedRelation
from sgstore.lang._results import SqlStatement, finished, rows
from sgstore.lang._rewrite import rewritten
from sgstore.lang._sql_frames import frames
from sgstore.lang._sql_masks import SqlBuilder
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
from sgstore.quoting import quoted
from sgstore.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sgstore.lang._catalog import Catalog
    from sgstore.lang._plan import Window
    from sgstore.lang.ir import Bound, Query


_WORDS: Final = frozenset({Type.text, Type.edge})
"""Types of values that may be enumerations in the database."""

FRAME: Final = "frame_id"
GATHERED: Final = ":gathered"
"""The table of what is found, where a statement speaks of all of it."""


def relation(
    query: Query,
    catalog: Catalog,
    window: Window | None,
    values: Iterable[Bound] = (),
    bound: Iterable[str] | None = None,
    most: int | None = None,
) -> SqlStatement:
    """The statement for the frames and bindings in which a pattern holds.

    Parameters
    ----------
    query : Query
        Its result does not matter.
    catalog : Catalog
    window : Window or None
        The buckets to look at; ``None``: all.
    values : iterable of Bound
        Asked of each match.
    bound : iterable of str, optional
        Keys of the nodes and edges that are bound, the others being asked to exist; ``None``: all nodes.
    most : int, optional
        How many rows are read at most.

    Returns
    -------
    SqlStatement
        Columns: ``frame_id``, the keys of the nodes in alphabetical order, those of the edges, then the values,
        as ``:0``, ``:1``, … Rows have no order.
    """
    keys = set(query.scope.nodes if bound is None else bound)
    nodes = sorted(keys & set(query.scope.nodes))
    edges = sorted(keys & {edge.key for edge in query.scope.edges})
    # What is asked of matches is rewritten with them: its blocks are opened as those of conditions are.
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
"""The frames of a range, in order."""

CLOCK_OF_TRACES: Final = f"""{_CLOCK}
  AND "frame_id" >> {TRACE_OF_FRAME} IN (SELECT unnest(CAST($3 AS BIGINT[]))) ORDER BY "frame_id" """
"""The frames of some traces in a range, in order."""

BUCKETS: Final = """SELECT "bucket", "valid", "joined" FROM "bucket"
WHERE "bucket" >= $1 AND "bucket" < $2"""
"""The buckets of a range: their frames, and those that follow soon on the one before; in any order."""

TIMES: Final = """SELECT "frame_id", "time_ns" FROM "frame"
WHERE "frame_id" >= $1 AND "frame_id" < $2"""
"""The times of the frames of a range, in any order."""

TRACES: Final = 'SELECT "trace_id", "name", "start_ns", coalesce("period_ns", 0) FROM "trace"'
"""All traces: what the times of their frames are counted by."""


def entities(query: Query, node: str, catalog: Catalog, window: Window | None) -> SqlStatement:
    """The statement for the nodes of some kinds that are in a trace in any frame.

    Parameters
    ----------
    query : Query
        Whose node it is.
    node : str
        Its key.

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
    """The statement for the traces in which something of some kinds is, and an attribute of it is known.

    It looks at whole tables, and at no frames, so it is quick in a large store.

    Parameters
    ----------
    kinds : Kinds
    attribute : Attribute or None
        ``None``: whatever is known of it.
    moving : bool
        Whether only what may move counts.

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
"""The traces that ever told a word of weather and light, given as a regular expression."""


# What is found already ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ExternalRelation:
    """Matches that are known, as columns.

    Attributes
    ----------
    first, last : list of int
        Of runs of ``frame_id``, each within a bucket: the same is matched in each of them.
    nodes : dict of str to list of int
        Node ids by key.
    edges : dict of str to list of str
        Relations by the keys of the edges that have names.
    values : list of lists
        What was worked out for each match: in the order of the places of :func:`external_matches`.
    """

    first: list[int]
    last: list[int]
    nodes: dict[str, list[int]]
    edges: dict[str, list[str]]
    values: list[list[Any]]


def nothing(query: Query, values: int) -> ExternalRelation:
    """No matches of a query."""
    nodes: dict[str, list[int]] = {key: [] for key in query.scope.nodes}
    edges: dict[str, list[str]] = {edge.key: [] for edge in query.scope.edges}
    return ExternalRelation([], [], nodes, edges, [[] for _ in range(values)])


_TYPES: Final = {Type.number: "DOUBLE", Type.text: "VARCHAR", Type.boolean: "BOOLEAN"}
FROM: Final = FrameAttribute(
    Attribute(":from", Type.number, {}, "", DisplayUnit.whole), Type.number
)
TO: Final = FrameAttribute(Attribute(":to", Type.number, {}, "", DisplayUnit.whole), Type.number)
SPAN: Final = (FROM, TO)
"""The first and the last ``frame_id`` of a match over several frames."""


def external_matches(
    query: Query,
    catalog: Catalog,
    found: ExternalRelation | Callable[[Window | None], ExternalRelation],
    told: Sequence[FrameAttribute],
) -> SqlBuilder:
    """A builder for a query whose matches are known; what is returned of them is asked of the store.

    Parameters
    ----------
    query : Query
        Of which :func:`with_places` made that its values speak of what is told.
    catalog : Catalog
    found : ExternalRelation or function
        What finds in a window of whole traces is asked of one after the other, when the statement is asked.
    told : sequence of FrameAttribute
        What stands for the values of ``found``.
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
    """All that is known of matches, a column after the other: nodes and edges in the order of ``shape``."""
    nodes = [found.nodes[key] for key in shape.nodes]
    edges = [found.edges[key] for key in shape.edges]
    return [found.first, found.last, *nodes, *edges, *found.values]


def with_places(query: Query) -> tuple[Query, dict[Bound, FrameAttribute]]:
    """A query whose values over time are places for what is worked out elsewhere, and what they are for."""
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
