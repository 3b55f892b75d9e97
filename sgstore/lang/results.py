"""Relations → statements: what a query returns of the frames and bindings that match.

Rows come in the order of frames, then of bindings, unless the query orders them. An *interval* is a maximal
run of consecutive frames of one trace in which the same binding holds; a gap of more than 2.5 median periods
ends it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.bound import (
    CLIP_COLUMNS,
    FRAME_COLUMNS,
    INTERVAL_COLUMNS,
    Aggregate,
    Bound,
    Column,
    EdgeRelation,
    FrameAttribute,
    NodeAttribute,
    NodeValue,
    Operation,
    Query,
    Result,
    Value,
    walk,
)
from sgstore.lang.catalog import NODE_ATTRIBUTES, Catalog, Type, Unit
from sgstore.lang.formulas import (
    Leaf,
    Select,
    columns_of,
    expression_text,
    frame_text,
    leaves,
    nested,
)
from sgstore.lang.frames import Frames, column_of
from sgstore.lang.kinds import Profile
from sgstore.lang.runs import runs
from sgstore.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.lang.phases import Window

EXTENTS: Final = """
SELECT min(bucket) AS first, max(bucket) - min(bucket) + 1 AS buckets FROM bucket
GROUP BY trace_id ORDER BY first
"""
"""First bucket and number of buckets of each trace, in the order of rows."""

CONSTANTS: Final = "SELECT node_id, ident, type_name, parked FROM entities WHERE trace_id = ?"
"""What does not change about the entities of a trace, and stands in no frame."""

LOG_TIME: Final = "log_time_ns"

_NAME: Final = NODE_ATTRIBUTES["name"]
_FRAME: Final = '":frame"'
_TRACE: Final = '":trace"'
_ROWS: Final = '":rows"'
_T: Final = 'CAST({0} - ":trace"."start_ns" AS DOUBLE) / 1e9'


@dataclass(frozen=True, slots=True)
class Gathered:
    """A table that a statement speaks of and the store has not: what was found otherwise.

    Attributes
    ----------
    name : str
    types : mapping of str to str
        The type of each column in the database.
    block : function
        The columns of what is found in a window of whole traces.
    """

    name: str
    types: Mapping[str, str]
    block: Callable[[Window | None], list[list[Any]]]


@dataclass(frozen=True, slots=True)
class Statement:
    """SQL with the values that it binds, the names of its columns, and tables that are put together first."""

    sql: str
    values: tuple[Any, ...]
    columns: tuple[str, ...]
    gathered: tuple[Gathered, ...] = ()


@dataclass(frozen=True, slots=True)
class Output:
    """A column of a result: its name, and its text in terms of a relation's columns."""

    name: str
    text: str


Span = tuple[Leaf, Leaf]
"""Of a match over several frames: the values that are its first and its last ``frame_id``."""


def rows(
    query: Query,
    catalog: Catalog,
    window: Window | None = None,
    writer: Frames | None = None,
    span: Span | None = None,
) -> Statement:
    """The statement for what a query returns, whatever its form.

    Parameters
    ----------
    query : Query
    catalog : Catalog
    window : Window, optional
    writer : Frames, optional
        Says what matches; by default what the pattern finds.
    span : Span, optional
        Of a query whose matches are intervals themselves.
    """
    if query.result.form in {"intervals", "clips"}:
        return intervals(query, catalog, window, writer, span)
    query = _spelled(query, catalog)
    return _Rows(query, writer or Frames(query, catalog, window)).statement()


def frames(
    query: Query, catalog: Catalog, window: Window | None = None, writer: Frames | None = None
) -> Statement:
    """The frames that match, each once, with their log times."""
    writer = writer or Frames(query, catalog, window)
    relation = writer.frames(query.scope, None, frozenset())
    outputs = [*_frame_columns(), (LOG_TIME, f'{_FRAME}."{LOG_TIME}"')]
    select = Select([_named(text, name) for name, text in outputs])
    _from_frames(select, relation)
    select.order = [f'{_ROWS}."frame_id"']
    return _finished(writer, select.text(), [name for name, _ in outputs])


def count(
    query: Query, catalog: Catalog, window: Window | None = None, writer: Frames | None = None
) -> Statement:
    """How many frames match."""
    told, writer = writer is not None, writer or Frames(query, catalog, window)
    parts = writer.phases(query.scope)
    if parts.rest or parts.late or told:
        relation = writer.frames(query.scope, None, frozenset())
        text = Select(['count(*) AS "frames"'], [nested(relation, ":rows")]).text()
    else:
        text = writer.number_of_frames(writer.masks(query.scope, parts, None, frozenset()))
    return _finished(writer, text, ("frames",))


def intervals(
    query: Query,
    catalog: Catalog,
    window: Window | None = None,
    writer: Frames | None = None,
    span: Span | None = None,
) -> Statement:
    """Intervals in which what is returned (nothing but a match, if nothing is) stays the same."""
    query = _spelled(query, catalog)
    return _Intervals(query, writer or Frames(query, catalog, window), span).statement()


def about_frame(attributes: Sequence[FrameAttribute]) -> str:
    """The statement for what is told of one frame, given its id: one row, a column each."""
    texts = [frame_text(one, _FRAME, _TRACE, '":map"') for one in attributes]
    select = Select(
        [f"{text} AS {quoted(column_of(a))}" for text, a in zip(texts, attributes, strict=True)]
    )
    select.join(f'"frame" AS {_FRAME}', [])
    select.where.append(f'{_FRAME}."frame_id" = ?')
    return select.text()


def with_bindings(query: Query) -> Query:
    """A query that returns its bindings and their names as columns: what intervals of a match keep."""
    columns: list[Column] = []
    for node in query.scope.nodes.values():
        if node.role == "named":
            columns.append(Column(node.key, NodeValue(node.key)))
            columns.append(Column(f"{node.key}.name", NodeAttribute(node.key, _NAME, Type.text)))
    columns += [Column(e.key, EdgeRelation(e.key)) for e in query.scope.edges if e.named]
    return replace(query, result=Result(form="intervals", columns=tuple(columns), whole=False))


class _Rows:
    """Writes the statement of a query whose results are rows."""

    def __init__(self, query: Query, writer: Frames) -> None:
        self.query, self.result = query, query.result
        self.writer = writer
        scope = query.scope
        counted = not self.result.distinct and not self.result.framed
        roles = {"named", "unnamed"} if counted and not self.result.whole else {"named"}
        self.nodes = frozenset(k for k, node in scope.nodes.items() if node.role in roles)
        self.edges = frozenset(edge.key for edge in scope.edges if edge.named)
        if self.result.framed or self.result.distinct:
            self.nodes, self.edges = frozenset(), frozenset()
        if self.result.whole:
            self.nodes = frozenset(k for k, n in scope.nodes.items() if n.role == "named")
            self.edges = frozenset(edge.key for edge in scope.edges if edge.named)

    def statement(self) -> Statement:
        values = [column.value for column in self.result.columns]
        values += [key.value for key in self.result.order if not isinstance(key.value, str)]
        per = self.result.sample and self.result.sample.per
        values += [per] if per is not None and not isinstance(per, str) else []
        values += [name for _, name in self._names()]
        wanted = [leaf for value in values for leaf in leaves(value)]
        relation = self.writer.frames(self.query.scope, None, self.nodes, self.edges, wanted)
        outputs = self._outputs()
        select = Select([_named(o.text, o.name) for o in outputs])
        if self.result.whole or self.result.framed:
            _from_frames(select, relation)
        else:
            select.join(nested(relation, ":rows"), [])
        select.distinct = self.result.distinct or self.result.framed
        if self.result.aggregated:
            listed = enumerate(self.result.columns, start=1)
            select.group = [str(place) for place, column in listed if not _aggregates(column)]
        text = self._ordered(select, [quoted(output.name) for output in outputs])
        return _finished(self.writer, text, tuple(output.name for output in outputs))

    def _outputs(self) -> list[Output]:
        outputs: list[Output] = []
        if self.result.whole or self.result.framed:
            outputs += [Output(name, text) for name, text in _frame_columns()]
        if self.result.whole:
            outputs += self._bindings({output.name for output in outputs})
        outputs += [Output(c.name, self._text(c.value)) for c in self.result.columns]
        return outputs

    def _bindings(self, taken: set[str]) -> list[Output]:
        """Ids and names of the nodes, and relations of the edges, that the query names, as it names them."""
        outputs: list[Output] = []
        for key, name in self._names():
            outputs.append(
                Output(f"{key}.id" if key in taken else key, f"{_ROWS}.{quoted(f'{key}.id')}")
            )
            outputs.append(Output(f"{key}.name", self._text(name)))
        edges = [edge.key for edge in self.query.scope.edges if edge.key in self.edges]
        return outputs + [Output(key, f"{_ROWS}.{quoted(f'{key}.type')}") for key in edges]

    def _names(self) -> list[tuple[str, Bound]]:
        if not self.result.whole:
            return []
        return [
            (k, _name_of(k, self.query, self.writer.catalog))
            for k in self.query.scope.nodes
            if k in self.nodes
        ]

    def _text(self, value: Bound) -> str:
        return expression_text(value, _column, self.writer.values)

    def _ordered(self, select: Select, names: list[str]) -> str:
        """The statement in the order of the query, or else of frames and bindings, cut to what is wanted."""
        keys = [_directed(self._key(k.value), k.descending) for k in self.result.order]
        if select.distinct or self.result.aggregated:
            keys += names
        else:
            bindings = columns_of(self.nodes, self.edges)
            keys += [f'{_ROWS}."frame_id"', *(f"{_ROWS}.{column}" for column in bindings)]
        sample = self.result.sample
        if sample is None:
            select.order, select.limit = keys, self.result.limit
            return select.text()
        per = None if sample.per is None else self._key(sample.per)
        at = f'{_ROWS}."frame_id"'
        text = _sampled(select, names, sample.number, per, at, keys)
        return _limited(text, self.result.limit)

    def _key(self, value: Bound | str) -> str:
        return quoted(value) if isinstance(value, str) else self._text(value)


class _Intervals:
    """Writes the statement of a query whose results are intervals, or the clips around them.

    What stays the same in an interval are its *keys*: the values that are returned, or, of a name that is put
    together, its parts.
    """

    def __init__(self, query: Query, writer: Frames, span: Span | None) -> None:
        self.query, self.result = query, query.result
        self.writer, self.span = writer, span
        kept = [value for column in self.result.columns for value in _kept(column.value)]
        distinct = enumerate(dict.fromkeys(kept))
        self.keys = {value: quoted(f"key {number}") for number, value in distinct}
        # In a trace, what has one id has one kind.
        implied = {kind for c in self.result.columns for kind in _kept(c.value)[:-1]}
        self.apart = [key for value, key in self.keys.items() if value not in implied]

    def statement(self) -> Statement:
        columns = self.result.columns
        wanted = [leaf for column in columns for leaf in leaves(column.value)]
        spans = self._spans(wanted)
        clips = self.result.form == "clips"
        own = self._clip_columns() if clips else self._interval_columns()
        named = [f"{self._told(c.value)} AS {quoted(c.name)}" for c in columns]
        select = Select([_named(text, name) for name, text in own] + named)
        select.join(nested(self._between(spans), ":runs"), [])
        select.join(f'"trace" AS {_TRACE}', [f'{_TRACE}."trace_id" = ":runs"."trace_id"'])
        first = '":runs"."first"'
        order = [_directed(_named_key(k.value), k.descending) for k in self.result.order]
        order += [first, *(self._told(column.value) for column in columns)]
        names = (*(name for name, _ in own), *(column.name for column in columns))
        sample = self.result.sample
        if sample is None:
            select.order, select.limit = order, self.result.limit
            return _finished(self.writer, select.text(), names)
        per = None if sample.per is None else _named_key(sample.per)
        shown = [quoted(name) for name in names]
        text = _sampled(select, shown, sample.number, per, first, order)
        return _finished(self.writer, _limited(text, self.result.limit), names)

    def _told(self, value: Bound) -> str:
        """A value that is returned, in terms of the keys."""
        if value in self.keys and not isinstance(value, NodeAttribute):
            return self.keys[value]
        return expression_text(value, self.keys.__getitem__, self.writer.values)

    def _keys(self) -> dict[str, str]:
        """Key → the value that stays the same."""
        # A word of the vocabulary is a number inside, as long as it is not told.
        texts = [
            _column(value)
            if isinstance(value, NodeAttribute)
            else expression_text(value, _column, self.writer.values)
            for value in self.keys
        ]
        return dict(zip(self.keys.values(), texts, strict=True))

    def _spans(self, wanted: list[Leaf]) -> str:
        """The first and the last frame of each interval, with the keys."""
        scope = self.query.scope
        if self.span is not None:
            wanted = [*wanted, *self.span]
            relation = self.writer.frames(scope, None, frozenset(), frozenset(), wanted)
            ends = [_column(leaf) for leaf in self.span]
            select = Select([f'{ends[0]} AS ":from"', f'{ends[1]} AS ":to"'])
            select.columns += [f"{text} AS {key}" for key, text in self._keys().items()]
            select.join(nested(relation, ":rows"), [])
            select.distinct = True
            return select.text()
        keys = list(self.keys.values())
        return runs(self.writer.in_masks(scope, wanted, self._keys()), keys, self.apart)

    def _between(self, spans: str) -> str:
        """What is told of the frames at both ends."""
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
    """Where a value stands in what matches."""
    return f"{_ROWS}.{quoted(column_of(leaf))}"


def _kept(value: Bound) -> tuple[Bound, ...]:
    """What must stay the same for a value to do so."""
    return (
        tuple(leaves(value)) if isinstance(value, Operation) and value.word == "name" else (value,)
    )


def _name_of(node: str, query: Query, catalog: Catalog) -> Bound:
    """The name of a node; that of an entity is put together late, for till then it is but two numbers."""
    name = NodeAttribute(node, _NAME, Type.text)
    profile = Profile.of(query.scope.kinds(node), catalog)
    if query.steps or profile.mapped or profile.places != 1:
        return name
    kind: Bound = NodeAttribute(node, NODE_ATTRIBUTES["kind"], Type.text)
    if len(profile.kinds) == 1:
        kind = Value(next(iter(profile.kinds)), Type.text, closed=True)
    return Operation("name", (kind, NodeValue(node)), Type.text)


def _spelled(query: Query, catalog: Catalog) -> Query:
    """A query in whose results names are put together late, where they can be."""

    def spelled(value: Bound) -> Bound:
        match value:
            case NodeAttribute(node=node, attribute=attribute) if attribute.unit is Unit.label:
                return _name_of(node, query, catalog)
            case Operation(operands=operands):
                return replace(value, operands=tuple(spelled(operand) for operand in operands))
            case _:
                return value

    return replace(query, result=query.result.changed(spelled))


def _frame_columns() -> list[tuple[str, str]]:
    time = f'{_FRAME}."time_ns"'
    texts = [f'{_FRAME}."frame_id"', f'{_TRACE}."name"', f'{_FRAME}."seq"', time, _T.format(time)]
    return list(zip(FRAME_COLUMNS, texts, strict=True))


def _from_frames(select: Select, relation: str) -> None:
    """A relation with the rows of its frames and of their traces."""
    select.join(nested(relation, ":rows"), [])
    select.join(f'"frame" AS {_FRAME}', [f'{_FRAME}."frame_id" = {_ROWS}."frame_id"'])
    select.join(f'"trace" AS {_TRACE}', [f'{_TRACE}."trace_id" = {_FRAME}."trace_id"'])


def _named(text: str, name: str) -> str:
    return f"{text} AS {quoted(name)}"


def _named_key(value: Bound | str) -> str:
    assert isinstance(value, str), value  # noqa: S101 - the binder knows the names of intervals only
    return quoted(value)


def _directed(text: str, descending: bool) -> str:  # noqa: FBT001
    return f"{text} {'DESC' if descending else 'ASC'} NULLS LAST"


def _sampled(
    select: Select, names: list[str], number: int, per: str | None, frame: str, keys: list[str]
) -> str:
    """At most ``number`` rows of each value of ``per``, chosen by a number that depends on the frame alone."""
    mixed = f"{frame} % 1000003 * 48271 % 2147483647"
    select.columns += [f'{mixed} AS ":mixed"', f'{per or 0} AS ":per"']
    ordered = [key.removesuffix(" NULLS LAST") for key in keys]
    plain = [key.removesuffix(" ASC").removesuffix(" DESC") for key in ordered]
    inner = [key if key in names else f'":key {i}"' for i, key in enumerate(plain)]
    select.columns += [
        f"{key} AS {name}" for key, name in zip(plain, inner, strict=True) if key != name
    ]
    over = ", ".join(['":mixed"', *inner])
    ranked = Select(["*", f'row_number() OVER (PARTITION BY ":per" ORDER BY {over}) AS ":rank"'])
    ranked.join(nested(select.text(), ":all"), [])
    outer = Select(names, [nested(ranked.text(), ":ranked")], [f'":rank" <= {number}'])
    down = [key.endswith(" DESC") for key in ordered]
    outer.order = [
        _directed(name, descending) for name, descending in zip(inner, down, strict=True)
    ]
    return outer.text()


def _limited(text: str, limit: int | None) -> str:
    return text if limit is None else f"{text}\nLIMIT {limit}"


def _aggregates(column: Column) -> bool:
    return any(isinstance(part, Aggregate) for part in walk(column.value))


def _finished(writer: Frames, text: str, columns: Iterable[str]) -> Statement:
    """A statement with the shared relations before it."""
    before = [
        (f"{quoted(name)} AS NOT MATERIALIZED", body) for name, body in writer.catalog.shadows
    ]
    before += [(f"{quoted(name)} AS", body) for name, body in writer.shared]
    shared = ",\n".join(
        f"{head} (\n" + "\n".join(f"  {line}" for line in body.splitlines()) + "\n)"
        for head, body in before
    )
    sql = f"WITH {shared}\n{text}" if shared else text
    return Statement(sql, tuple(writer.values.items), tuple(columns), writer.gathered)
