"""Queries for the stores of a collection, and SQL that merges their results.

A trace is in one part. So the rows, intervals and clips of the collection are those of its parts. Only their
order and their number must be adjusted. Each row has *hidden* columns, named ``:0``, ``:1``, …, which hold
the sort keys of a single store. Counts and sums are computed in each part, group by group, and then over the
parts. Distinct values come from each part as a set.

The merging statements use the tables ``parts``, ``parts 1``, …, one for each query sent to the parts.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import quoted
from sgstore.errors import QueryError
from sgstore.lang.bind import PLACE, sql_of
from sgstore.lang.catalog import FRAME_ATTRIBUTES, TRACE_ATTRIBUTES, Catalog, Type
from sgstore.lang.ir import (
    Aggregate,
    Bound,
    EdgeRelation,
    FrameAttribute,
    GroupKey,
    NodeValue,
    Query,
    Result,
    ReturnColumn,
    Sampling,
    SortKey,
    TraceAttribute,
    is_counted,
    with_operands,
)
from sgstore.lang.sql._expressions import expression_text
from sgstore.lang.sql._node_owners import owner_of, with_owners
from sgstore.lang.sql._results import (
    FIRST,
    OWNER_KEY,
    TOP_OWNER,
    Chosen,
    directed,
    keyed,
    names_of,
    sampled,
    told_apart_by,
    with_bindings,
)
from sgstore.lang.sql._rewrite import rewritten
from sgstore.lang.sql._select import BoundValues, Select, nested
from sgstore.lang.sql._subgraphs import Layout
from sgstore.lang.sql._windows import frame_key, name_key

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sgstore.lang.sql._compile import Compiled

PARTS: Final = "parts"
"""Name of the table with results of the first query. Further queries append a number to it."""

LOG_TIME_COLUMN: Final = ":log_time_ns"

_FRAME_ID: Final = FrameAttribute(FRAME_ATTRIBUTES["id"], Type.number)
_LOG_TIME: Final = FrameAttribute(FRAME_ATTRIBUTES["logtimens"], Type.number)
_TRACE_NAME: Final = TraceAttribute(TRACE_ATTRIBUTES["name"], Type.text)

Terms = list[str]
"""SQL expressions of an ``ORDER BY`` clause."""


@dataclass(frozen=True, slots=True)
class Parted:
    """Queries that each store of a collection runs, and a rule to merge the results.

    Attributes
    ----------
    queries : tuple of Query
        Queries sent to each part. The answers to the first are in table ``parts``, to the second in ``parts
        1``, ….
    columns : tuple of str
        Columns of the merged rows.
    merge : function
        Function from the catalog of the collection and the bound values to the merging statement.
    """

    queries: tuple[Query, ...]
    columns: tuple[str, ...]
    merge: Callable[[Catalog, BoundValues], str]

    def compiled(self, whole: Compiled) -> tuple[Compiled, ...]:
        """Return the compiled queries for one store of the collection."""
        found: list[Compiled] = []
        for query in self.queries:
            ready = query if query.steps else rewritten(query, whole.catalog)
            found.append(replace(whole, bound=query, query=ready))
        return tuple(found)

    def statement(self, catalog: Catalog) -> tuple[str, tuple[Any, ...]]:
        """Return the SQL that merges the results of the stores, and its parameter values."""
        values = BoundValues()
        text = self.merge(catalog, values)
        return text, tuple(values.items)


def parted(compiled: Compiled, form: str = "rows", before: int = 0, after: int = 0) -> Parted:
    """Return the queries that each store of a collection runs, and the rule to merge the results.

    Parameters
    ----------
    compiled : Compiled
        Query compiled against the collection or against a part. The result is the same.
    form : str
        ``rows``: the result of the query; ``apart``: the same, with extra columns that distinguish nodes of
        different traces with the same id. Other forms replace the ``RETURN``: ``frames``, ``intervals``,
        ``bound`` (intervals of bindings), ``clips`` or ``subgraphs``.
    before, after : int
        Time added to clips at both ends, unless the query has offsets; ns.

    Raises
    ------
    QueryError
        No rule exists for merging the answers.
    """
    query = compiled.whole
    _refuse_strange(query.result)
    match form:
        case "frames":
            query = _frames(query)
        case "apart":
            query = replace(query, result=with_owners(query.result))
        case "subgraphs":
            query = Layout.of(compiled.bound).query
        case "bound":
            query = with_bindings(query)
        case "intervals":
            query = _intervals(query, graphs=compiled.layout is not None)
        case "clips" if query.result.form != "clips":
            clips = Result(form="clips", whole=False, before=-before, after=after)
            query = replace(query, result=clips)
        case _:
            pass
    result = query.result
    if result.form in {"intervals", "clips"}:
        return _parted_intervals(query)
    if result.aggregated:
        return _Grouping(query).parted()
    if result.distinct and not (result.whole or result.framed):
        return _parted_sets(query)
    return _parted_rows(query)


MERGED: Final = frozenset(
    {
        *("form", "columns", "whole", "framed", "distinct", "having", "order", "sample", "top"),
        *("skip", "limit", "before", "after", "keyed"),
    }
)
"""Fields of :class:`Result` that have a rule for merging the results of several stores."""

SUMMED: Final = frozenset({"count", "sum", "min", "max", "avg"})
"""Aggregates that each store computes and the collection merges."""

LISTED: Final = frozenset({"stddev", "median", "percentile", "collect"})
"""Aggregates that need all values from each store."""


def _refuse_strange(result: Result) -> None:
    """Raise an error if results of stores cannot be merged because of a setting of the result clause."""
    for one in fields(result):
        if one.name not in MERGED and getattr(result, one.name) != one.default:
            raise QueryError(
                f"a collection cannot compute the value of '{one.name}' in a query over all its bundles",
                hint="'sgstore collection unpack' combines them into one store, which can answer this",
            )


def _frames(query: Query) -> Query:
    """Return a query for the matching frames and their log times.

    With ``LIMIT``, it returns the frame of each row.
    """
    result, time = query.result, ReturnColumn(LOG_TIME_COLUMN, _LOG_TIME)
    if not result.chooses or result.form != "rows" or result.aggregated:
        return replace(query, result=Result(whole=False, framed=True, columns=(time,)))
    framed = replace(result, framed=True, columns=(*result.columns, time))
    return replace(query, result=framed)


def _intervals(query: Query, *, graphs: bool) -> Query:
    result = query.result
    if result.whole or result.aggregated or graphs:
        return with_bindings(query)
    if result.form == "intervals":
        return query
    return replace(query, result=Result(form="intervals", columns=result.columns, whole=False))


def _parted_rows(query: Query) -> Parted:
    result, hidden = query.result, _Hidden()
    own = [directed(hidden.key(k.value), k.descending) for k in result.order]
    pers = _per(result, result.sample, hidden), _per(result, result.top, hidden)
    framed = result.whole or result.framed
    frame = quoted("frame_id") if framed else hidden.add(_FRAME_ID)
    visible = names_of(query)
    rest = list(map(quoted, visible))
    if not (result.framed or result.distinct):
        told = rest if query.steps else []
        rest = [*_bindings(query, hidden), *told]
    asked = _of_part(replace(result, columns=(*result.columns, *hidden.columns)))

    def merge(catalog: Catalog, values: BoundValues) -> str:
        names = list(map(quoted, visible))
        select = Select(list(names), [quoted(PARTS)])
        keys = [*own, frame_key(select, frame, catalog, None, values)]
        keys += [key for key in rest if key != keys[-1]]
        return _chosen(result, select, (names, keys, frame), pers)

    return Parted((replace(query, result=asked),), visible, merge)


Placed = tuple[Terms, Terms, str]
"""Column names of rows, SQL sort keys of the rows, and the column with the frame."""


def _chosen(result: Result, select: Select, placed: Placed, pers: tuple[Terms, Terms]) -> str:
    """Return SQL that sorts, samples and limits the rows of all stores.

    ``pers``: the ``PER`` columns of ``SAMPLE`` and those of ``LIMIT … PER``.
    """
    (names, keys, frame), (per, top_per) = placed, pers
    tops = [f'":top {number}"' for number in range(len(top_per))]
    select.columns += [f"{text} AS {name}" for text, name in zip(top_per, tops, strict=True)]
    if result.sample is not None:
        chosen = Chosen(result.sample.number, per, frame, first=len(result.order))
        select, keys = sampled(select, [*names, *tops], names, keys, chosen)
    if result.top is not None:
        select, keys = sampled(select, names, names, keys, Chosen(result.top.number, tops))
    if result.sample is None and result.top is None:
        keys = keyed(select, names, keys)
        select = Select(names, [nested(select.text(), ":all")])
    select.order = keys
    select.limit, select.offset = result.limit, result.skip
    return select.text()


def _of_part(result: Result) -> Result:
    """Return the result clause for one store, so that the rows suffice for the result of the collection.

    A sample of one part can differ from the sample of the collection, so a limited number of its rows is not
    enough.
    """
    if result.sample is not None:
        return replace(result, top=None, skip=0, limit=None)
    if result.top is not None:
        return replace(result, skip=0, limit=None)
    if result.limit is not None:
        return replace(result, skip=0, limit=result.skip + result.limit)
    return replace(result, order=(), skip=0)


def _bindings(query: Query, hidden: _Hidden) -> Terms:
    """Return the sort keys for matches of the same frame: the nodes and edges of the match.

    A store sorts relations by their enumeration, but returns them as texts.
    """
    roles = {"named"} if query.result.whole else {"named", "unnamed"}
    nodes = sorted(key for key, node in query.scope.nodes.items() if node.role in roles)
    edges = sorted(edge.key for edge in query.scope.edges if edge.named)
    return [
        *(hidden.add(NodeValue(key)) for key in nodes),
        *(f"CAST({hidden.add(EdgeRelation(key))} AS relation)" for key in edges),
        *map(hidden.add, told_apart_by(query)),
    ]


def _per(result: Result, chosen: Sampling | None, hidden: _Hidden) -> Terms:
    """Return the columns of the value in ``SAMPLE n PER value`` or ``LIMIT n PER value``.

    For a node, the owner is included.
    """
    if chosen is None or chosen.per is None:
        return []
    value = _value_of(result, chosen.per)
    per = [hidden.key(chosen.per)]
    if isinstance(value, NodeValue):
        per.append(hidden.add(owner_of(value.node)))
    return per


def _value_of(result: Result, per: Bound | str) -> Bound | str:
    """Return an expression: the given one, or the expression of the column with the given name."""
    if not isinstance(per, str):
        return per
    return next((column.value for column in result.columns if column.name == per), per)


class _Hidden:
    """Columns that the stores of a collection return only because rows are sorted or grouped by them."""

    def __init__(self, first: int = 0) -> None:
        self.columns: list[ReturnColumn] = []
        self._numbers = count(first)

    def add(self, value: Bound) -> str:
        """Add a hidden column for a value. Return its quoted name."""
        column = ReturnColumn(f":{next(self._numbers)}", value)
        self.columns.append(column)
        return quoted(column.name)

    def key(self, value: Bound | str) -> str:
        """Return the quoted column of a sort key. Add a hidden column unless it is a result column."""
        return quoted(value) if isinstance(value, str) else self.add(value)


def _parted_intervals(query: Query) -> Parted:
    result = query.result
    asked = _of_part(replace(result, keyed=True))
    visible = names_of(query)

    def merge(catalog: Catalog, values: BoundValues) -> str:
        names = list(map(quoted, visible))
        select = Select(list(names), [quoted(PARTS)])
        own = [directed(_name(key), key.descending) for key in result.order]
        first = quoted(FIRST)
        keys = [*own, frame_key(select, first, catalog, None, values)]
        keys += [quoted(column.name) for column in result.columns]
        keys.append(quoted("end_ns"))  # several matches of a sequence may begin in one frame
        pers = (
            _per_of_intervals(result, result.sample, OWNER_KEY),
            _per_of_intervals(result, result.top, TOP_OWNER),
        )
        return _chosen(result, select, (names, keys, first), pers)

    return Parted((replace(query, result=asked),), visible, merge)


def _per_of_intervals(result: Result, chosen: Sampling | None, owner: str) -> Terms:
    if chosen is None or chosen.per is None:
        return []
    assert isinstance(chosen.per, str)  # noqa: S101 - the binder knows the names of intervals only
    owned = isinstance(_value_of(result, chosen.per), NodeValue)
    return [quoted(chosen.per), *([quoted(owner)] if owned else [])]


def _name(key: SortKey) -> str:
    assert isinstance(key.value, str)  # noqa: S101 - the binder knows the names of intervals only
    return quoted(key.value)


def _parted_sets(query: Query) -> Parted:
    result, hidden = query.result, _Hidden()
    owners = {
        column.name: hidden.add(owner_of(column.value.node))
        for column in result.columns
        if isinstance(column.value, NodeValue)
    }
    asked = replace(result, columns=(*result.columns, *hidden.columns), top=None)
    asked = _of_part(asked) if result.top is None else replace(asked, order=(), skip=0, limit=None)
    visible = names_of(query)

    def merge(catalog: Catalog, values: BoundValues) -> str:
        every = Select(["*"], [quoted(PARTS)], distinct=True)
        own = [directed(_name(key), key.descending) for key in result.order]
        return _in_names(every.text(), visible, own, result, (catalog, values), owners)

    return Parted((replace(query, result=asked),), visible, merge)


def _in_names(
    text: str,
    visible: Sequence[str],
    own: Terms,
    result: Result,
    bound: tuple[Catalog, BoundValues],
    owners: Mapping[str, str],
) -> str:
    """Return SQL that sorts the rows of all stores: by ``ORDER BY``, then by the result columns.

    ``owners``: the columns with the owners of the nodes in a column.
    """
    catalog, values = bound
    names = list(map(quoted, visible))
    select = Select(list(names), [nested(text, ":rows")])
    keys = [*own, *names]
    known = [trace.name for trace in catalog.traces]
    told = {quoted(c.name) for c in result.columns if c.value == _TRACE_NAME}
    for place in range(len(own), len(keys)) if known != sorted(known) else ():
        if keys[place] in told:
            keys[place] = name_key(select, place, keys[place], catalog, values)
    per = result.top and result.top.per
    tops = [quoted(per), *([owners[per]] if per in owners else [])] if isinstance(per, str) else []
    return _chosen(result, select, (names, keys, ""), ([], tops))


class _Grouping:
    """Split of a query with aggregates: one query per store, and SQL that combines their results.

    The first query for a part has a column for each grouping value, and one or two summable columns for each
    aggregate. An aggregate over *distinct* values needs its own query, which returns the set of values for
    each group. An aggregate over all values needs its own query too, with one row for each match.
    """

    def __init__(self, query: Query) -> None:
        self._query, self._result = query, query.result
        self._groups, self._numbers = _Hidden(), _Hidden(1_000)
        self._more: list[tuple[Query, Callable[[Catalog, BoundValues], str]]] = []
        self._known: dict[Aggregate, str] = {}
        self._partial: list[ReturnColumn] = []
        self._keys: dict[str, str] = {}
        self._owners: dict[str, str] = {}
        for column in self._result.columns:
            if not is_counted(column.value):
                self._keys[column.name] = self._groups.add(column.value)
        for column in self._result.columns:
            if isinstance(column.value, NodeValue):
                self._owners[column.name] = self._groups.add(owner_of(column.value.node))

    def parted(self) -> Parted:
        result = self._result
        outputs = [(column.name, self._column(column)) for column in result.columns]
        own: Terms = []
        for i, key in enumerate(result.order):
            if not isinstance(key.value, str):
                outputs.append((f":order {i}", self._text(key.value)))
            name = key.value if isinstance(key.value, str) else f":order {i}"
            own.append(directed(quoted(name), key.descending))
        having = None if result.having is None else self._text(result.having)
        if not self._partial:  # the part must return its groups
            self._part(Aggregate("count", None, distinct=False, type=Type.number))
        columns = (*self._groups.columns, *self._partial)
        first = Result(columns=columns, whole=False)
        queries = (replace(self._query, result=first), *(query for query, _ in self._more))
        visible = names_of(self._query)
        owners = {name: f'":whose {i}"' for i, name in enumerate(self._owners)}

        def merge(catalog: Catalog, values: BoundValues) -> str:
            select = Select([f"{_sql(v, values)} AS {quoted(n)}" for n, v in outputs])
            whose = zip(self._owners.values(), owners.values(), strict=True)
            select.columns += [f"{column} AS {name}" for column, name in whose]
            select.tables = [nested(self._every(catalog, values), ":every")]
            select.group = [quoted(column.name) for column in self._groups.columns]
            select.having = [] if having is None else [_sql(having, values)]
            return _in_names(select.text(), visible, own, result, (catalog, values), owners)

        return Parted(queries, visible, merge)

    def _column(self, column: ReturnColumn) -> Bound:
        if column.name in self._keys:
            return EdgeRelation(self._keys[column.name])
        return self._text(column.value)

    def _text(self, value: Bound) -> Bound:
        """Return an expression in which columns of the stores' results replace aggregates and group values."""
        match value:
            case GroupKey(name=name):
                return EdgeRelation(self._keys[name])
            case Aggregate():
                return EdgeRelation(self._number(value))
            case _:
                return with_operands(value, self._text)

    def _number(self, number: Aggregate) -> str:
        """Return the SQL of an aggregate over a collection. Add the columns that each store must return."""
        if number not in self._known:
            self._known[number] = self._merged(number)
        return self._known[number]

    def _merged(self, number: Aggregate) -> str:
        if number.word in {"min", "max"}:
            return f"{number.word}({self._part(replace(number, distinct=False))})"
        if number.word in LISTED or (number.distinct and number.word in SUMMED):
            found = f"any_value({self._each(number)})"
            if number.word == "count":
                return f"CAST(coalesce({found}, 0) AS BIGINT)"
            return f"coalesce({found}, [])" if number.word == "collect" else found
        if number.word not in SUMMED:
            raise QueryError(
                f"a collection cannot compute {number.word}() over all its bundles",
                hint="'sgstore collection unpack' combines them into one store, which can answer this",
            )
        if number.word == "avg":
            total = self._part(replace(number, word="sum"))
            many = self._part(replace(number, word="count"))
            return f"(CAST(sum({total}) AS DOUBLE) / nullif(sum({many}), 0))"
        column = self._part(number)
        if number.word == "count":
            return f"CAST(coalesce(sum({column}), 0) AS BIGINT)"
        return f"{number.word}({column})"

    def _part(self, number: Aggregate) -> str:
        name = self._numbers.add(number)
        self._partial.append(self._numbers.columns[-1])
        return name

    def _each(self, number: Aggregate) -> str:
        """Return the column of an aggregate that needs all values of all stores. Add the query for them."""
        assert number.operand is not None  # noqa: S101 - COUNT(*) alone has none
        hidden = _Hidden(2_000)
        value = hidden.add(number.operand)
        if isinstance(number.operand, NodeValue):
            hidden.add(owner_of(number.operand.node))
        ordered = number.word == "collect" and not number.distinct
        frame = hidden.add(_FRAME_ID) if ordered else ""
        bindings = _bindings(self._query, hidden) if ordered else []
        columns = (*self._groups.columns, *hidden.columns)
        result = Result(columns=columns, whole=False, distinct=number.distinct)
        groups = [quoted(column.name) for column in self._groups.columns]
        place = len(self._more) + 1
        name, table = quoted(f":each {place}"), quoted(f"{PARTS} {place}")

        def text(catalog: Catalog, values: BoundValues) -> str:
            rows = Select(["*"], [table], distinct=number.distinct)
            rows.where = [f"{value} IS NOT NULL"] if number.distinct else []
            made = sql_of(replace(number, distinct=False), value)
            if ordered:
                order = [frame_key(rows, frame, catalog, None, values), *bindings]
                rows.columns.append(f"row_number() OVER (ORDER BY {', '.join(order)}) AS {_PLACE}")
            elif number.word == "collect":
                made = f"list({value} ORDER BY {value})"
            made = made.replace(PLACE, _PLACE)
            select = Select([*groups, f"{made} AS {name}"], [nested(rows.text(), ":each")])
            select.group = list(groups)
            return select.text()

        self._more.append((replace(self._query, result=result), text))
        return name

    def _every(self, catalog: Catalog, values: BoundValues) -> str:
        """Return SQL for the result rows of all stores, with partial aggregates or single values."""
        rows = [Select(["*"], [quoted(PARTS)]).text()]
        rows += [text(catalog, values) for _, text in self._more]
        return "\nUNION ALL BY NAME\n".join(f"({text})" for text in rows)


_PLACE: Final = '":place"'


def _sql(value: Bound, values: BoundValues) -> str:
    """Return the SQL of an expression that contains SQL columns instead of attributes."""

    def leaf(found: Any) -> str:
        return found.edge

    return expression_text(value, leaf, values)
