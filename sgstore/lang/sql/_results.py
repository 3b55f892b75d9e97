"""SQL of query results: rows, frames, intervals, clips and counts.

Rows are sorted by trace, frame and binding, unless the query has an order. An *interval* is a longest run
of consecutive frames of one trace with the same binding. A gap of more than 2.5 median periods ends it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import quoted
from sgstore.lang.bind import Profile
from sgstore.lang.catalog import (
    LANE_CHAINS,
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Catalog,
    DisplayUnit,
    Type,
)
from sgstore.lang.ir import (
    CLIP_COLUMNS,
    FRAME_COLUMNS,
    INTERVAL_COLUMNS,
    Aggregate,
    Bound,
    EdgeRelation,
    FrameAttribute,
    GroupKey,
    NodeAttribute,
    NodeValue,
    Operation,
    Query,
    Result,
    ReturnColumn,
    Sampling,
    TraceAttribute,
    Value,
    is_counted,
    is_passed_on,
    passed_values,
    walk,
    with_operands,
)
from sgstore.lang.sql._attributes import frame_text, owner_text, seconds_text
from sgstore.lang.sql._expressions import Leaf, column_of, columns_of, expression_text, leaves
from sgstore.lang.sql._frames import frames as frames_of
from sgstore.lang.sql._frames import in_masks, masks, phases
from sgstore.lang.sql._masks import SqlBuilder, number_of_frames
from sgstore.lang.sql._node_owners import counted_apart, owners_of
from sgstore.lang.sql._runs import runs
from sgstore.lang.sql._select import BoundValues, Select, nested
from sgstore.lang.sql._windows import frame_key, name_key

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.lang.sql._plan import Gathered
    from sgstore.lang.sql._windows import Window


CONSTANTS: Final = """
SELECT node_id, ident, type_name, lifetime, {parked} AS parked FROM inside.entity WHERE trace_id = ?
"""
"""Tables with constants of the entities of a trace. The frames do not repeat these values."""

FIRST, OWNER_KEY, TOP_OWNER = ":first frame", ":owner", ":top owner"
"""Extra columns of intervals in collections: id of the first frame, owner of each node, and owner of nodes in
sampling keys."""

LOG_TIME: Final = "log_time_ns"

OF_NODES: Final = "intervals are those of single matches"
"""Reason in an error about ``HAVING`` when the intervals of a query are those of single matches."""

_NAME: Final = NODE_ATTRIBUTES["name"]
_TRACE_NAME: Final = TraceAttribute(TRACE_ATTRIBUTES["name"], Type.text)
_FRAME: Final = '":frame"'
_TRACE: Final = '":trace"'
_ROWS: Final = '":rows"'
_T: Final = seconds_text('{0} - ":trace"."start_ns"')


@dataclass(frozen=True, slots=True)
class SqlStatement:
    """SQL statement with its parameter values, column names and temporary tables.

    Attributes
    ----------
    stages : tuple of (str, str)
        Named relations that ``last`` uses. A relation may use earlier ones. ``sql`` combines all of them in
        one statement.
    last : str
    """

    sql: str
    values: tuple[Any, ...]
    columns: tuple[str, ...]
    gathered: tuple[Gathered, ...] = ()
    stages: tuple[tuple[str, str], ...] = ()
    last: str = ""

    def steps(self) -> list[tuple[str, dict[str, Any]]]:
        """Return separate SQL statements with their values: one per temporary table, then the last one.

        The result is the same as that of ``sql``. But the database plans each step with the exact number of
        rows of earlier steps. In one statement, it estimated 40 million rows for a pattern with 180, and
        chose a slow join.
        """
        made = [
            f"CREATE OR REPLACE TEMP TABLE {quoted(name)} AS {body}" for name, body in self.stages
        ]
        return [(text, self._bound(text)) for text in (*made, self.last or self.sql)]

    def _bound(self, text: str) -> dict[str, Any]:
        """Return the parameter values that part of the SQL uses: parameter number → value."""
        numbers = {found[1] for found in _BOUND.finditer(text) if found[1]}
        return {number: self.values[int(number) - 1] for number in sorted(numbers)}


_BOUND: Final = re.compile(r"""'(?:[^']|'')*'|"(?:[^"]|"")*"|\$(\d+)""")
"""Regular expression: quoted texts and names, which stay, and numbers of bound values."""

Span = tuple[Leaf, Leaf]
"""Expressions for the first and the last ``frame_id`` of a match over several frames."""


def names_of(query: Query) -> tuple[str, ...]:
    """Return the names of the result columns of a query."""
    result, scope = query.result, query.scope
    names = list(result.names)
    if result.form == "rows" and result.whole:
        for key, node in scope.nodes.items():
            if node.role == "named":
                names += [f"{key}.id" if key in result.names else key, f"{key}.name"]
        names += [edge.key for edge in scope.edges if edge.named]
    return (*names, *(column.name for column in result.columns))


def rows(
    query: Query,
    catalog: Catalog,
    window: Window | None = None,
    writer: SqlBuilder | None = None,
    span: Span | None = None,
) -> SqlStatement:
    """Return the SQL for the results of a query: rows, intervals or clips, as in its ``RETURN`` clause.

    Parameters
    ----------
    query : Query
    catalog : Catalog
    window : Window, optional
    writer : SqlBuilder, optional
        Builder with the matches. The default searches the pattern.
    span : Span, optional
        Span values, for a query whose matches are intervals.
    """
    if query.result.form in {"intervals", "clips"}:
        return intervals(query, catalog, window, writer, span)
    query = counted_apart(_spelled(query, catalog), catalog)
    return _RowStatement(query, writer or SqlBuilder(query, catalog, window)).statement()


def frames(
    query: Query, catalog: Catalog, window: Window | None = None, writer: SqlBuilder | None = None
) -> SqlStatement:
    """Return the SQL for all matching frames, each once, with their log times."""
    writer = writer or SqlBuilder(query, catalog, window)
    relation = frames_of(writer, query.scope, None, frozenset())
    outputs = [*_frame_columns(), (LOG_TIME, f'{_FRAME}."{LOG_TIME}"')]
    select = Select([_named(text, name) for name, text in outputs])
    _from_frames(select, relation)
    frame = f'{_ROWS}."frame_id"'
    select.order = [frame_key(select, frame, catalog, window, writer.values)]
    return finished(writer, select.text(), [name for name, _ in outputs])


def count(
    query: Query, catalog: Catalog, window: Window | None = None, writer: SqlBuilder | None = None
) -> SqlStatement:
    """Return the SQL for the number of matching frames."""
    told, writer = writer is not None, writer or SqlBuilder(query, catalog, window)
    parts = phases(writer, query.scope)
    if parts.rest or parts.late or told:
        relation = frames_of(writer, query.scope, None, frozenset())
        text = Select(['count(*) AS "frames"'], [nested(relation, ":rows")]).text()
    else:
        text = number_of_frames(masks(writer, query.scope, parts, None, frozenset()))
    return finished(writer, text, ("frames",))


def intervals(
    query: Query,
    catalog: Catalog,
    window: Window | None = None,
    writer: SqlBuilder | None = None,
    span: Span | None = None,
) -> SqlStatement:
    """Return the SQL for intervals: series of frames in which the returned values stay the same."""
    query = _spelled(query, catalog)
    return _IntervalStatement(query, writer or SqlBuilder(query, catalog, window), span).statement()


def about_frame(attributes: Sequence[FrameAttribute]) -> str:
    """Return SQL for attributes of one frame, given its id. The result is one row."""
    texts = [frame_text(one, _FRAME, _TRACE, '":map"') for one in attributes]
    select = Select(
        [f"{text} AS {quoted(column_of(a))}" for text, a in zip(texts, attributes, strict=True)]
    )
    select.join(f'"frame" AS {_FRAME}', [])
    select.where.append(f'{_FRAME}."frame_id" = ?')
    return select.text()


def named_traces(conditions: Sequence[Bound]) -> tuple[str, list[Any]]:
    """Return SQL, and its parameter values, for the names of traces with attributes that meet conditions."""
    values = BoundValues()
    select = Select([f'{_TRACE}."name"'])
    select.join(f'"trace" AS {_TRACE}', [])
    select.join('"map" AS ":map"', [f'":map"."map_id" = {_TRACE}."map_id"'], "LEFT JOIN")

    def leaf(found: Leaf) -> str:
        assert isinstance(found, TraceAttribute)  # noqa: S101 - chosen by the caller
        return frame_text(found, _FRAME, _TRACE, '":map"')

    select.where = [expression_text(one, leaf, values) for one in conditions]
    return select.text(), values.items


def with_bindings(query: Query) -> Query:
    """Return a query for intervals: series of frames in which the same nodes match.

    The columns are the nodes and their names.
    """
    columns: list[ReturnColumn] = []
    for node in query.scope.nodes.values():
        if node.role == "named":
            columns.append(ReturnColumn(node.key, NodeValue(node.key)))
            columns.append(
                ReturnColumn(f"{node.key}.name", NodeAttribute(node.key, _NAME, Type.text))
            )
    columns += [ReturnColumn(e.key, EdgeRelation(e.key)) for e in query.scope.edges if e.named]
    having = query.result.having_of_match(OF_NODES)
    result = Result(form="intervals", columns=tuple(columns), whole=False, having=having)
    return replace(query, result=result)


def told_apart_by(query: Query) -> list[FrameAttribute]:
    """Return the ``WITH`` values that belong to a match: two matches differ if these values differ."""
    result = query.result
    if result.whole:
        return [one.value for one in result.columns if is_passed_on(one.value)]
    return [] if result.distinct or result.framed else [*passed_values(query)]


class _RowStatement:
    """Builder of the SQL for results in rows (not intervals or clips)."""

    def __init__(self, query: Query, writer: SqlBuilder) -> None:
        self.query, self.result = query, query.result
        self.writer = writer
        scope = query.scope
        counted = not self.result.distinct and not self.result.framed
        roles = {"named", "unnamed"} if counted and not self.result.whole else {"named"}
        self.nodes = frozenset(k for k, node in scope.nodes.items() if node.role in roles)
        self.edges = frozenset(edge.key for edge in scope.edges if edge.named)
        if (
            query.stages and writer.found is not None
        ):  # variables that WITH does not pass on count too
            self.nodes, self.edges = writer.found.nodes, writer.found.edges
        if self.result.framed or self.result.distinct:
            self.nodes, self.edges = frozenset(), frozenset()
        if self.result.whole:
            self.nodes = frozenset(k for k, n in scope.nodes.items() if n.role == "named")
            self.edges = frozenset(edge.key for edge in scope.edges if edge.named)
        self.grouped = self.result.groups
        # Sampling keys, and keys of ``LIMIT … PER``.
        self.owners, self.top_owners = (
            [] if per is None else owners_of([per], query, writer.catalog)
            for per in (_per(self.result, one) for one in (self.result.sample, self.result.top))
        )
        self.texts = dict[str, str]()  # SQL of the grouping columns
        # 32-bit numbers are grouped by value, and shown with their shortest decimal text.
        self.shortened = {
            quoted(column.name): _named(shortest_text(quoted(column.name)), column.name)
            for column in self.result.columns
            if column.single and self.grouped
        }
        # Values passed by WITH also distinguish matches.
        self.passed = told_apart_by(query)

    def statement(self) -> SqlStatement:
        values = [column.value for column in self.result.columns]
        keys = [c.value for c in self.result.columns if not is_counted(c.value)]
        apart: list[NodeAttribute] = []
        if self.grouped:
            apart = owners_of(keys, self.query, self.writer.catalog)
        values += apart
        values += self.result.values[len(self.result.columns) :]
        values += self.owners + self.top_owners
        values += [name for _, name in self._names()]
        wanted = [leaf for value in values for leaf in leaves(value)]
        wanted += self.passed
        relation = frames_of(self.writer, self.query.scope, None, self.nodes, self.edges, wanted)
        if any(in_order(part) for value in values for part in walk(value)):
            relation = self._placed(relation)
        outputs = self._outputs()
        names = [name for name, _ in outputs]
        select = Select([_named(text, name) for name, text in outputs])
        if self.result.whole or self.result.framed:
            _from_frames(select, relation)
        else:
            select.join(nested(relation, ":rows"), [])
        once = self.result.framed and not (wanted or self.query.stages or self.query.steps)
        select.distinct = not once and (self.result.distinct or self.result.framed)
        if self.result.having is not None and not self.result.aggregated:
            select.where.append(self._text(self.result.having))
        if self.result.aggregated:
            listed = enumerate(self.result.columns, start=1)
            select.group = [str(place) for place, column in listed if not is_counted(column.value)]
            select.group += [_column(owner) for owner in dict.fromkeys([*apart, *self.top_owners])]
            if self.result.having is not None:
                select.having.append(self._text(self.result.having))
        tops = self._tops()
        select.columns += [f"{text} AS {quoted(name)}" for name, text in tops.items()]
        if apart and not self.result.aggregated:
            select = _told_apart(select, [*names, *tops], apart)
        text = self._ordered(select, list(map(quoted, names)), list(map(quoted, tops)))
        return finished(self.writer, text, tuple(names))

    def _tops(self) -> dict[str, str]:
        """Return extra columns for ``LIMIT n PER value``: column name → SQL."""
        top = self.result.top
        per = [] if top is None or top.per is None or isinstance(top.per, str) else [top.per]
        values = [*per, *self.top_owners]
        return {f":top {number}": self._text(value) for number, value in enumerate(values)}

    def _placed(self, relation: str) -> str:
        """Return SQL for the matches, with one more column: the position of each in the default order."""
        select = Select([f"{_ROWS}.*"])
        select.join(nested(relation, ":rows"), [])
        frame, writer = f'{_ROWS}."frame_id"', self.writer
        order = [frame_key(select, frame, writer.catalog, writer.window, writer.values)]
        order += [f"{_ROWS}.{column}" for column in columns_of(self.nodes, self.edges)]
        order += [_column(one) for one in self.passed]
        select.columns.append(f'row_number() OVER (ORDER BY {", ".join(order)}) AS ":place"')
        return select.text()

    def _outputs(self) -> list[tuple[str, str]]:
        """Return the names of the result columns, and their SQL."""
        texts: list[str] = []
        if self.result.whole or self.result.framed:
            texts += [text for _, text in _frame_columns()]
        for key, name in self._names():
            texts += [f"{_ROWS}.{quoted(f'{key}.id')}", self._text(name)]
        if self.result.whole:
            edges = (edge.key for edge in self.query.scope.edges if edge.key in self.edges)
            texts += [f"{_ROWS}.{quoted(f'{key}.type')}" for key in edges]
        for column in self.result.columns:
            whole = self.result.aggregated and not is_counted(column.value)
            text = self._of_group(column.name) if whole else self._text(column.value)
            texts.append(shortest_text(text) if column.single and not self.grouped else text)
        return list(zip(names_of(self.query), texts, strict=True))

    def _names(self) -> list[tuple[str, Bound]]:
        if not self.result.whole:
            return []
        return [
            (k, _name_of(k, self.query, self.writer.catalog))
            for k in self.query.scope.nodes
            if k in self.nodes
        ]

    def _text(self, value: Bound) -> str:
        return expression_text(value, self._leaf, self.writer.values)

    def _leaf(self, leaf: Leaf) -> str:
        return self._of_group(leaf.name) if isinstance(leaf, GroupKey) else _column(leaf)

    def _of_group(self, name: str) -> str:
        """Return the SQL of a grouping value. If the value occurs again, the same SQL is returned."""
        if name not in self.texts:
            value = next(c.value for c in self.result.columns if c.name == name)
            self.texts[name] = self._text(value)
        return self.texts[name]

    def _ordered(self, select: Select, names: list[str], tops: list[str]) -> str:
        """Return SQL for the sorted and limited rows. Rows with equal keys are in the default order."""
        keys = [directed(self._key(k.value), k.descending) for k in self.result.order]
        frame, own, writer = f'{_ROWS}."frame_id"', len(keys), self.writer
        grouped = self.grouped
        once = self.result.framed or (self.result.distinct and not grouped)  # with their frames
        if not grouped:
            keys.append(frame_key(select, frame, writer.catalog, writer.window, writer.values))
        if once and keys[own] == frame:  # the frame is the first of the names
            del keys[own]
        moved = once and len(keys) > own
        bindings = [f"{_ROWS}.{column}" for column in columns_of(self.nodes, self.edges)]
        bindings += [_column(one) for one in self.passed]
        if self.query.steps:  # several matches may have the same binding in their last frame
            bindings += [self._text(column.value) for column in self.result.columns]
        keys += names if once or grouped else bindings
        sample, top = self.result.sample, self.result.top
        named = self._named_traces(keys, own) if grouped else []
        shown = [self.shortened.get(name, name) for name in names]
        if sample is not None:
            per = [] if sample.per is None else [self._key(sample.per)]
            per += [self._text(owner) for owner in self.owners]
            chosen = Chosen(sample.number, per, frame, first=own)
            select, keys = sampled(select, [*shown, *tops], names, keys, chosen)
        elif moved or named or top is not None or self.shortened:
            order = keyed(select, names, keys)
            select = Select([*shown, *tops], [nested(select.text(), ":all")])
            for place in named:
                order[place] = name_key(select, place, keys[place], writer.catalog, writer.values)
            keys = order
        if top is not None:
            per = [quoted(top.per)] if isinstance(top.per, str) else []
            chosen = Chosen(top.number, [*per, *tops])
            select, keys = sampled(select, names, names, keys, chosen)
        select.order = keys
        select.limit, select.offset = self.result.limit, self.result.skip
        return select.text()

    def _named_traces(self, keys: list[str], own: int) -> list[int]:
        """Return the positions of sort keys that are trace names, if these need natural order (2 before 10)."""
        known = [trace.name for trace in self.writer.catalog.traces]
        if known == sorted(known):
            return []
        told = {quoted(c.name) for c in self.result.columns if c.value == _TRACE_NAME}
        return [place for place in range(own, len(keys)) if keys[place] in told]

    def _key(self, value: Bound | str) -> str:
        return quoted(value) if isinstance(value, str) else self._text(value)


class _IntervalStatement:
    """Builder of the SQL for results in intervals of frames or in clips.

    The *keys* of an interval stay the same: the returned values, or the parts of a composed name.
    """

    def __init__(self, query: Query, writer: SqlBuilder, span: Span | None) -> None:
        self.query, self.result = query, query.result
        self.writer, self.span = writer, span
        having = [] if self.result.having is None else [*leaves(self.result.having)]
        self.unnamed = list(dict.fromkeys(having))  # values that only HAVING uses
        kept = [value for column in self.result.columns for value in _kept(column.value)]
        kept += self.unnamed
        distinct = enumerate(dict.fromkeys(kept))
        self.keys = {value: quoted(f"key {number}") for number, value in distinct}
        # In a trace, an id has only one kind.
        implied = {kind for c in self.result.columns for kind in _kept(c.value)[:-1]}
        self.apart = [key for value, key in self.keys.items() if value not in implied]

    def statement(self) -> SqlStatement:
        columns = self.result.columns
        wanted = [leaf for column in columns for leaf in leaves(column.value)]
        spans = self._spans([*wanted, *self.unnamed])
        clips = self.result.form == "clips"
        own = self._clip_columns() if clips else self._interval_columns()
        told = dict(own) | {column.name: self._shown(column) for column in columns}
        hidden = self._hidden(told) if self.result.keyed else {}
        select = Select([_named(text, name) for name, text in (told | hidden).items()])
        select.join(nested(self._between(spans), ":runs"), [])
        select.join(f'"trace" AS {_TRACE}', [f'{_TRACE}."trace_id" = ":runs"."trace_id"'])
        first = '":runs"."first"'
        order = [directed(_named_key(k.value), k.descending) for k in self.result.order]
        writer = self.writer
        order.append(frame_key(select, first, writer.catalog, writer.window, writer.values))
        order += [self._told(column.value) for column in columns]
        order += (
            ['"max seq"'] if self.span is not None else []
        )  # several intervals may begin in one frame
        names = (*(name for name, _ in own), *(column.name for column in columns), *hidden)
        if self.result.having is not None:
            select.where.append(self._having(self.result.having, told))
        shown, keys = [quoted(name) for name in names], len(self.result.order)
        sample, top = self.result.sample, self.result.top
        tops = {f'":top {n}"': text for n, text in enumerate(self._per(top, told))}
        select.columns += [f"{text} AS {name}" for name, text in tops.items()]
        if sample is not None:
            chosen = Chosen(sample.number, self._per(sample, told), first, first=keys)
            select, order = sampled(select, [*shown, *tops], shown, order, chosen)
        if top is not None:
            select, order = sampled(select, shown, shown, order, Chosen(top.number, [*tops]))
        select.order = order
        select.limit, select.offset = self.result.limit, self.result.skip
        return finished(self.writer, select.text(), names)

    def _hidden(self, told: dict[str, str]) -> dict[str, str]:
        """Return extra columns that sort the intervals of several stores: first frame, owners of nodes."""
        hidden = {FIRST: '":runs"."first"'}
        for name, chosen in ((OWNER_KEY, self.result.sample), (TOP_OWNER, self.result.top)):
            for owner in self._per(chosen, told)[1:]:
                hidden[name] = owner
        return hidden

    def _having(self, condition: Bound, columns: dict[str, str]) -> str:
        """Return the SQL of the ``HAVING`` condition for an interval, from the columns of the interval."""

        def leaf(found: Leaf) -> str:
            return columns[found.name] if isinstance(found, GroupKey) else self.keys[found]

        return expression_text(condition, leaf, self.writer.values)

    def _per(self, chosen: Sampling | None, told: dict[str, str]) -> list[str]:
        """Return the SQL of the values after ``PER`` in ``SAMPLE n PER value``.

        If it is a node, the SQL of its owner follows.
        """
        if chosen is None or chosen.per is None:
            return []
        assert isinstance(chosen.per, str)  # noqa: S101 - the binder knows the names of intervals only
        per = [told[chosen.per]]
        value = _per(self.result, chosen)
        if isinstance(value, NodeValue):
            profile = Profile.of(self.query.scope.kinds(value.node), self.writer.catalog)
            owner = owner_text(per[0], profile, f'{_TRACE}."trace_id"', f'{_TRACE}."map_id"')
            absent = bool(self.query.stages)
            per.append(f"CASE WHEN {per[0]} IS NOT NULL THEN {owner} END" if absent else owner)
        return per

    def _told(self, value: Bound) -> str:
        """Return the SQL of a returned value, from the columns that are constant in the interval."""
        if value in self.keys and not isinstance(value, NodeAttribute):
            return self.keys[value]
        return expression_text(value, self.keys.__getitem__, self.writer.values)

    def _shown(self, column: ReturnColumn) -> str:
        text = self._told(column.value)
        return shortest_text(text) if column.single else text

    def _keys(self) -> dict[str, str]:
        """Return the columns that are constant in an interval: column → SQL of the value."""
        # A word of the vocabulary stays an internal number until it is returned.
        texts = [
            _column(value)
            if isinstance(value, NodeAttribute)
            else expression_text(value, _column, self.writer.values)
            for value in self.keys
        ]
        return dict(zip(self.keys.values(), texts, strict=True))

    def _spans(self, wanted: list[Leaf]) -> str:
        """Return SQL for the first and last frame of each interval, and for its constant columns."""
        scope = self.query.scope
        if self.span is not None:
            wanted = [*wanted, *self.span]
            relation = frames_of(self.writer, scope, None, frozenset(), frozenset(), wanted)
            ends = [_column(leaf) for leaf in self.span]
            select = Select([f'{ends[0]} AS ":from"', f'{ends[1]} AS ":to"'])
            select.columns += [f"{text} AS {key}" for key, text in self._keys().items()]
            select.join(nested(relation, ":rows"), [])
            select.distinct = True
            return select.text()
        keys = list(self.keys.values())
        return runs(in_masks(self.writer, scope, wanted, self._keys()), keys, self.apart)

    def _between(self, spans: str) -> str:
        """Return SQL for the number, time and log time of the first and of the last frame of each interval."""
        select = Select(['":from"."trace_id" AS "trace_id"', *self.keys.values()])
        select.columns += ['":from"."frame_id" AS "first"']
        select.columns += ['":to"."seq" - ":from"."seq" + 1 AS "frames"']
        for column, name in (("seq", "seq"), ("time_ns", "time"), ("log_time_ns", "log")):
            select.columns += [f'":from".{quoted(column)} AS {quoted(f"min {name}")}']
            select.columns += [f'":to".{quoted(column)} AS {quoted(f"max {name}")}']
        select.join(nested(spans, ":spans"), [])
        select.join('"frame" AS ":from"', ['":from"."frame_id" = ":spans".":from"'])
        select.join('"frame" AS ":to"', ['":to"."frame_id" = ":spans".":to"'])
        return select.text()

    def _interval_columns(self) -> list[tuple[str, str]]:
        since = [_T.format(quoted(f"{end} time")) for end in ("min", "max")]
        texts = [f'{_TRACE}."name"', '"min seq"', '"max seq"', '"min time"', '"max time"', *since]
        return list(zip(INTERVAL_COLUMNS, [*texts, '":runs"."frames"'], strict=True))

    def _clip_columns(self) -> list[tuple[str, str]]:
        start = f'"min log" + {self.result.before}'
        end = f'"max log" + {self.result.after}'
        return list(zip(CLIP_COLUMNS, [f'{_TRACE}."name"', start, end], strict=True))


def _column(leaf: Leaf) -> str:
    return f"{_ROWS}.{quoted(column_of(leaf))}"


def _kept(value: Bound) -> tuple[Bound, ...]:
    """Return the expressions needed to compute a value later: kind and id for the name of a node."""
    return (
        tuple(leaves(value)) if isinstance(value, Operation) and value.word == "name" else (value,)
    )


def _name_of(node: str, query: Query, catalog: Catalog) -> Bound:
    """Return the query expression for the name of a node.

    For an entity, the last SELECT composes it from kind and id.
    """
    name = NodeAttribute(node, _NAME, Type.text)
    profile = Profile.of(query.scope.kinds(node), catalog)
    if query.steps or query.stages or profile.mapped or profile.places != 1:
        return name
    kind: Bound = NodeAttribute(node, NODE_ATTRIBUTES["kind"], Type.text)
    if len(profile.kinds) == 1:
        kind = Value(next(iter(profile.kinds)), Type.text, closed=True)
    return Operation("name", (kind, NodeValue(node)), Type.text)


def _spelled(query: Query, catalog: Catalog) -> Query:
    """Return a query that builds node names only in the outermost SELECT, because this is faster."""

    def spelled(value: Bound) -> Bound:
        match value:
            case NodeAttribute(node=node, attribute=attribute) if (
                attribute.unit is DisplayUnit.label
            ):
                return _name_of(node, query, catalog)
            case Operation():
                return with_operands(value, spelled)
            case _:
                return value

    return replace(query, result=query.result.changed(spelled))


def _frame_columns() -> list[tuple[str, str]]:
    time = f'{_FRAME}."time_ns"'
    texts = [f'{_FRAME}."frame_id"', f'{_TRACE}."name"', f'{_FRAME}."seq"', time, _T.format(time)]
    return list(zip(FRAME_COLUMNS, texts, strict=True))


def _from_frames(select: Select, relation: str) -> None:
    select.join(nested(relation, ":rows"), [])
    select.join(f'"frame" AS {_FRAME}', [f'{_FRAME}."frame_id" = {_ROWS}."frame_id"'])
    select.join(f'"trace" AS {_TRACE}', [f'{_TRACE}."trace_id" = {_FRAME}."trace_id"'])


def shortest_text(text: str) -> str:
    """Return SQL that converts a 32-bit number to the 64-bit number with the same decimal digits."""
    return f"CAST(CAST(CAST({text} AS FLOAT) AS VARCHAR) AS DOUBLE)"


def _named(text: str, name: str) -> str:
    return f"{text} AS {quoted(name)}"


def _named_key(value: Bound | str) -> str:
    assert isinstance(value, str), value  # noqa: S101 - the binder knows the names of intervals only
    return quoted(value)


def directed(text: str, descending: bool) -> str:  # noqa: FBT001
    return f"{text} {'DESC' if descending else 'ASC'} NULLS LAST"


def _per(result: Result, chosen: Sampling | None) -> Bound | None:
    """Return the value in ``SAMPLE n PER value`` or ``LIMIT n PER value``; None without it."""
    per = chosen and chosen.per
    if isinstance(per, str):
        return next((column.value for column in result.columns if column.name == per), None)
    return per


def _told_apart(select: Select, names: list[str], apart: list[NodeAttribute]) -> Select:
    """Return SQL that removes duplicate rows. Equal node ids of different traces do not count as equal."""
    select.columns += [f'{_column(one)} AS ":owner {i}"' for i, one in enumerate(apart)]
    return Select([quoted(name) for name in names], [nested(select.text(), ":distinct")])


@dataclass(frozen=True, slots=True)
class Chosen:
    """Selection of some rows from each group of rows with equal values, as in ``SAMPLE n PER value``.

    Without a frame, or with ``first`` sort keys, the first rows are selected. Otherwise, rows are selected by
    a pseudo-random number computed from the frame.
    """

    number: int
    per: list[str]
    frame: str | None = None
    first: int = 0


def sampled(
    select: Select, columns: list[str], names: list[str], keys: list[str], chosen: Chosen
) -> tuple[Select, list[str]]:
    """Return a SELECT statement for some rows of each group, and the sort keys for its result."""
    partition = [f'":per {place}"' for place in range(len(chosen.per))]
    if chosen.frame is not None:
        select.columns.append(f'{chosen.frame} % 1000003 * 48271 % 2147483647 AS ":mixed"')
    select.columns += [
        f"{text} AS {name}" for text, name in zip(chosen.per, partition, strict=True)
    ]
    order = keyed(select, names, keys)
    mixed = chosen.frame is not None and not chosen.first
    over = ", ".join(['":mixed"', *order] if mixed else order)
    by = f"PARTITION BY {', '.join(partition)} " if partition else ""
    ranked = Select(["*", f'row_number() OVER ({by}ORDER BY {over}) AS ":rank"'])
    ranked.join(nested(select.text(), ":all"), [])
    outer = Select([*columns], [nested(ranked.text(), ":ranked")])
    outer.where.append(f'":rank" <= {chosen.number}')
    return outer, order


def keyed(select: Select, names: list[str], keys: list[str]) -> list[str]:
    """Add sort keys as columns to a SELECT statement. Return the keys with which to sort its result."""
    ordered = [key.removesuffix(" NULLS LAST") for key in keys]
    plain = [key.removesuffix(" ASC").removesuffix(" DESC") for key in ordered]
    inner = [key if key in names else f'":key {i}"' for i, key in enumerate(plain)]
    select.columns += [
        f"{key} AS {name}" for key, name in zip(plain, inner, strict=True) if name not in names
    ]
    down = [key.endswith(" DESC") for key in ordered]
    return [directed(name, descending) for name, descending in zip(inner, down, strict=True)]


def in_order(part: Bound) -> bool:
    """True if the value of an expression depends on the order of the matches, as for ``collect``."""
    return isinstance(part, Aggregate) and part.word == "collect" and not part.distinct


def finished(writer: SqlBuilder, text: str, columns: Iterable[str]) -> SqlStatement:
    """Return the complete SQL statement. Shared subqueries are in its ``WITH`` clause."""
    shadows = [
        (f"{quoted(name)} AS NOT MATERIALIZED", body) for name, body in writer.catalog.shadows
    ]
    if any('."chain"' in body for body in (text, *(body for _, body in writer.shared))):
        shadows.append(('"map_node" AS NOT MATERIALIZED', _WITH_CHAINS))
    shared = [(f"{quoted(name)} AS", body) for name, body in writer.shared]
    sql, last = _preceded([*shadows, *shared], text), _preceded(shadows, text)
    stages = tuple((name, _preceded(shadows, body)) for name, body in writer.shared)
    values = tuple(writer.values.items)
    return SqlStatement(sql, values, tuple(columns), writer.gathered, stages, last)


_WITH_CHAINS: Final = f"""SELECT n.*, c.chain FROM inside.map_node n LEFT JOIN (
  SELECT map_id, src, max(dst) AS chain FROM {quoted(LANE_CHAINS)} GROUP BY map_id, src
) c ON c.map_id = n.map_id AND c.src = n.node_id"""  # noqa: S608  words of ours
"""SQL for the table of map parts, with the chain of each lane."""


def _preceded(relations: Iterable[tuple[str, str]], text: str) -> str:
    """Return an SQL statement whose ``WITH`` clause contains the named subqueries."""
    before = ",\n".join(
        f"{head} (\n" + "\n".join(f"  {line}" for line in body.splitlines()) + "\n)"
        for head, body in relations
    )
    return f"WITH {before}\n{text}" if before else text
