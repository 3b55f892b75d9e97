"""Relations of frames and bindings as statements of their own, and results of matches that are known already.

What looks at several frames is worked out in columns, of relations that come from a store
(:func:`relation`); what is found comes back as a relation that the results of a query are taken from, as if the
pattern had just been searched for (:class:`ExternalMatches`).
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
    columns_of,
    expression_text,
    leaves,
    nested,
)
from sgstore.lang._kinds import kind_conditions
from sgstore.lang._plan import TRACE_OF_FRAME, Gathered, Phases, SharedRelation
from sgstore.lang._results import SqlStatement, rows
from sgstore.lang._rewrite import rewritten
from sgstore.lang._sql_frames import PATTERN, Frames, Join, column_of
from sgstore.lang._sql_masks import folded
from sgstore.lang.ir import (
    BlockValue,
    FrameAttribute,
    Kinds,
    NodeAttribute,
    NodeValue,
    Result,
    ReturnColumn,
    Scope,
    SignalCall,
    StepTime,
    Tense,
    TraceAttribute,
    with_operands,
)
from sgstore.quoting import quoted
from sgstore.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sgstore.lang._catalog import Catalog
    from sgstore.lang._formulas import Leaf
    from sgstore.lang._plan import Window
    from sgstore.lang.ir import Bound, Query


FRAME: Final = "frame_id"
GATHERED: Final = ":gathered"
"""The table of what is found, where a statement speaks of all of it."""


def relation(
    query: Query,
    catalog: Catalog,
    window: Window | None,
    values: Iterable[Bound] = (),
    bound: Iterable[str] | None = None,
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

    Returns
    -------
    SqlStatement
        Columns: ``frame_id``, the keys of the nodes in alphabetical order, those of the edges, then the values,
        as ``:0``, ``:1``, … Rows have no order.
    """
    keys = set(query.scope.nodes if bound is None else bound)
    nodes = sorted(keys & set(query.scope.nodes))
    edges = sorted(keys & {edge.key for edge in query.scope.edges})
    query = rewritten(query, catalog)
    values = list(values)
    writer = Frames(query, catalog, window)
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
    return SqlStatement(sql, tuple(writer.values.items), names)


_CLOCK: Final = """SELECT "frame_id", "seq", "time_ns", "log_time_ns" FROM "frame"
WHERE "frame_id" >= $1 AND "frame_id" < $2"""
CLOCK: Final = f'{_CLOCK} ORDER BY "frame_id"'
"""The frames of a range, in order."""

CLOCK_OF_TRACES: Final = f"""{_CLOCK}
  AND "frame_id" >> {TRACE_OF_FRAME} IN (SELECT unnest(CAST($3 AS BIGINT[]))) ORDER BY "frame_id" """
"""The frames of some traces in a range, in order."""

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
        Of runs of ``frame_id``: the same is matched in each of them.
    nodes : dict of str to list of int
        Node ids by key.
    edges : dict of str to list of str
        Relations by the keys of the edges that have names.
    values : list of lists
        What was worked out for each match: in the order of the places of :class:`ExternalMatches`.
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


class ExternalMatches(Frames):
    """Writes relations of a query whose matches are known; what is returned of them is asked of the store.

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

    def __init__(
        self,
        query: Query,
        catalog: Catalog,
        found: ExternalRelation | Callable[[Window | None], ExternalRelation],
        told: Sequence[FrameAttribute],
    ) -> None:
        super().__init__(query, catalog, None)
        self._find = None if isinstance(found, ExternalRelation) else found
        self._found = found if isinstance(found, ExternalRelation) else nothing(query, len(told))
        self._told = {leaf: f":value {number}" for number, leaf in enumerate(told)}
        self._table = ""

    def phases(self, scope: Scope) -> Phases:
        """Of the pattern itself nothing is left to be tested."""
        return Phases() if scope is self.query.scope else super().phases(scope)

    def frames(
        self,
        scope: Scope,
        given: SharedRelation | None,
        nodes: frozenset[str],
        edges: frozenset[str] = frozenset(),
        columns: Iterable[Leaf] = (),
    ) -> str:
        """As of any pattern; matches that differ in nothing that is asked come once."""
        text = super().frames(scope, given, nodes, edges, columns)
        whole = set(self._found.nodes) <= nodes and set(self._found.edges) <= edges
        if whole or scope is not self.query.scope or text.startswith("SELECT DISTINCT"):
            return text
        return "SELECT DISTINCT" + text.removeprefix("SELECT")

    def _first_phase(
        self,
        join: Join,
        scope: Scope,
        parts: Phases,
        given: SharedRelation | None,
        bound: frozenset[str],
        ties: frozenset[str],
        needed: list[Leaf],
    ) -> SharedRelation | None:
        if scope is not self.query.scope:
            return super()._first_phase(join, scope, parts, given, bound, ties, needed)
        if not self._table:
            self._table = self.share(self._told_rows(), "found")
        join.select = _Lenient()
        join.select.join(f"{quoted(self._table)} AS {PATTERN}", [])
        join.frame = f'{PATTERN}."frame_id"'
        join.nodes |= {key: f"{PATTERN}.{quoted(f'{key}.id')}" for key in bound}
        join.edges |= {key: f"{PATTERN}.{quoted(f'{key}.type')}" for key in ties}
        if not any(isinstance(leaf, BlockValue) for leaf in needed):
            return None
        keys = columns_of(bound)
        rows = Select(['"frame_id"', *keys], [quoted(self._table)], distinct=True)
        return SharedRelation(self.share(folded(rows.text(), keys), "pattern"), bound, frozenset())

    def _lasting(self, scope: Scope, wanted: Iterable[Leaf]) -> str | None:
        return None if scope is self.query.scope else super()._lasting(scope, wanted)

    def _say(self, join: Join, scope: Scope, given: SharedRelation | None, leaf: Leaf) -> None:
        if isinstance(leaf, FrameAttribute) and leaf in self._told:
            join.texts[leaf] = f"{PATTERN}.{quoted(self._told[leaf])}"
        else:
            super()._say(join, scope, given, leaf)

    def _told_rows(self) -> str:
        """Return what was found, one row for each frame."""
        columns = {"first": "BIGINT", "last": "BIGINT"}
        columns |= {f"{key}.id": "BIGINT" for key in self._found.nodes}
        columns |= {f"{key}.type": "VARCHAR" for key in self._found.edges}
        for leaf, name in self._told.items():
            columns[name] = "BIGINT" if leaf in SPAN else _TYPES[leaf.type]
        select = Select(['unnest(range("first", "last" + 1)) AS "frame_id"'])
        select.columns += [quoted(name) for name in list(columns)[2:]]
        if self._find is not None:
            find = self._find
            self.gathered = (
                Gathered(GATHERED, columns, lambda window: self._columns(find(window))),
            )
            select.join(quoted(GATHERED), [])
            return select.text()
        told = zip(self._columns(self._found), columns.items(), strict=True)
        parts = [
            f"unnest(CAST({self.values.add(rows)} AS {kind}[])) AS {quoted(name)}"
            for rows, (name, kind) in told
        ]
        select.join(nested("SELECT " + ",\n  ".join(parts), ":runs"), [])
        return select.text()

    def _columns(self, found: ExternalRelation) -> list[list[Any]]:
        """All that is known of matches, a column after the other, in the order of :meth:`_told_rows`."""
        keys = self._found.nodes, self._found.edges
        nodes = [found.nodes[key] for key in keys[0]]
        return [
            found.first,
            found.last,
            *nodes,
            *(found.edges[key] for key in keys[1]),
            *found.values,
        ]


class _Lenient(Select):
    """A statement that keeps its rows: what is not there in the frame is unknown."""

    def join(self, table: str, conditions: Sequence[str], how: str = "JOIN") -> None:
        super().join(table, conditions, "LEFT JOIN" if conditions else how)


def with_places(query: Query) -> tuple[Query, dict[Bound, FrameAttribute]]:
    """A query whose values over time are places for what is worked out elsewhere, and what they are for."""
    places: dict[Bound, FrameAttribute] = {}

    def placed(value: Bound) -> Bound:
        match value:
            case Tense() | SignalCall() | StepTime():
                if value not in places:
                    name = f":value {len(places)}"
                    attribute = Attribute(name, value.type, {}, "", DisplayUnit.whole)
                    places[value] = FrameAttribute(attribute, value.type)
                return places[value]
            case _:
                return with_operands(value, placed)

    return replace(query, result=query.result.changed(placed)), places
