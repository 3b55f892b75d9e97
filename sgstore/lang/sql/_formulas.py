"""SQL expressions of values, attributes, conditions and pair numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import literal, quoted
from sgstore.lang.bind import sql_of
from sgstore.lang.catalog import DERIVED, Attribute, DisplayUnit, Home, Type
from sgstore.lang.ir import (
    Aggregate,
    BlockValue,
    Bound,
    Choices,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    GroupKey,
    Happened,
    LabelTest,
    NodeAttribute,
    NodeValue,
    Operation,
    OverMatch,
    PairNumber,
    SignalCall,
    StepTime,
    Tense,
    TraceAttribute,
    Value,
)
from sgstore.lang.operators import COMPARISONS, COMPILER_SQL, OPERATORS
from sgstore.model.pair_numbers import low_and_high_sql, pair_sql, stage_of
from sgstore.model.vocabulary import MAP_KINDS, VEHICLE_LIGHTS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.lang.bind import Profile
    from sgstore.lang.ir import Edge


def pair_column(name: str, a: str, b: str) -> str:
    """Return the column of a pair number, or of an attribute of one entity (``a_x`` is x of a)."""
    if stage_of(name):
        return quoted(f"{name}({a}, {b})")
    return quoted(f"{a if name[0] == 'a' else b}:{name[2:]}")


def pair_text(name: str, a: str, b: str, without: frozenset[str] = frozenset()) -> str:
    """Return the SQL of a pair number, in terms of the columns of earlier layers."""
    return pair_sql(name, lambda part: pair_column(part, a, b), without)


# Pieces of SQL text: values, attributes, conditions, and the numbers of pairs of entities -------
# Only portable SQL: the text runs on DuckDB and can be adapted to other engines. Every identifier is quoted
# and every value of the user is bound. Words of the vocabulary are literals.


@dataclass(slots=True)
class BoundValues:
    """User values bound by a statement, in order."""

    items: list[Any] = field(default_factory=list[Any])

    def add(self, value: object) -> str:
        """Add a value and return its placeholder."""
        self.items.append(value)
        return f"${len(self.items)}"


@dataclass(slots=True)
class Select:
    """Builder of a ``SELECT`` statement: one line for each column, table and condition.

    If ``lenient``, tables are joined by ``LEFT JOIN``, so rows without a partner are kept.
    """

    columns: list[str] = field(default_factory=list[str])
    tables: list[str] = field(default_factory=list[str])
    where: list[str] = field(default_factory=list[str])
    group: list[str] = field(default_factory=list[str])
    having: list[str] = field(default_factory=list[str])
    order: list[str] = field(default_factory=list[str])
    limit: int | None = None
    offset: int = 0
    distinct: bool = False
    lenient: bool = False

    def text(self) -> str:
        """Return the SQL text."""
        head = "SELECT DISTINCT " if self.distinct else "SELECT "
        lines = [head + ",\n  ".join(self.columns)]
        lines += ["FROM " + "\n  ".join(self.tables)] if self.tables else []
        lines += ["WHERE " + "\n  AND ".join(self.where)] if self.where else []
        lines += ["GROUP BY " + ", ".join(self.group)] if self.group else []
        lines += ["HAVING " + "\n  AND ".join(self.having)] if self.having else []
        lines += ["ORDER BY " + ", ".join(self.order)] if self.order else []
        lines += [f"LIMIT {self.limit}"] if self.limit is not None else []
        lines += [f"OFFSET {self.offset}"] if self.offset else []
        return "\n".join(lines)

    def join(self, table: str, conditions: Sequence[str], how: str = "JOIN") -> None:
        """Join a table. Without conditions, it is a cross join."""
        if not self.tables:
            self.tables.append(table)
            self.where += conditions
        elif conditions:
            how = "LEFT JOIN" if self.lenient else how
            self.tables.append(f"{how} {table} ON " + " AND ".join(conditions))
        else:
            self.tables.append(f"CROSS JOIN {table}")


def indented(text: str) -> str:
    """Indent a statement for use in another statement."""
    return "\n".join(f"    {line}" for line in text.splitlines())


def nested(text: str, name: str) -> str:
    """Return a statement as a derived table."""
    return f"(\n{indented(text)}\n  ) AS {quoted(name)}"


# Values of nodes ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Aliases:
    """SQL aliases of the tables with a node's attributes. ``None`` means that the table is not joined."""

    state: str | None = None
    entity: str | None = None
    map: str | None = None
    trace: str | None = None


_ORIGINS: Final = {
    DisplayUnit.east: "origin_x",
    DisplayUnit.north: "origin_y",
    DisplayUnit.up: "origin_z",
}
PLACES: Final = ", ".join(literal(kind) for kind in MAP_KINDS)
"""Kinds of map parts that are not entities. Signs and lights are entities."""

_ABSENT: Final = {
    Type.number: "CAST(NULL AS DOUBLE)",
    Type.text: "CAST(NULL AS VARCHAR)",
    Type.boolean: "CAST(NULL AS BOOLEAN)",
}


def attribute_text(attribute: Attribute, at: Aliases) -> str:
    """Return the SQL of a node attribute, for nodes stored in one of several tables."""
    if attribute.unit is DisplayUnit.label:
        return _label(at)
    if attribute.name == "kind" and at.state and not (at.entity or at.map):
        return f"{at.state}.{quoted('kind')}"
    parts = [
        _part(attribute, home, f"{alias}.{quoted(attribute.columns[home])}", alias, at.trace)
        for home, alias in (
            (Home.state, at.state),
            (Home.entity, at.entity),
            (Home.scenery, at.entity),
            (Home.map, at.map),
        )
        if alias is not None and home in attribute.columns
    ]
    if attribute.name == "is_ego":
        parts.append("FALSE")
    if not parts:
        return _ABSENT[attribute.type]
    if attribute.values and len(parts) > 1:
        parts = [f"CAST({part} AS VARCHAR)" for part in parts]
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def raw_text(name: str, at: Aliases, *, upright: bool = False) -> str:
    """Return the SQL of a raw column of a node. Positions are relative to the origin of the trace.

    Static entities have no states. Their velocity and acceleration are 0.
    """
    if name in {"low", "high"}:
        return _side_text(name, at, upright=upright)
    still = name in {"vx", "vy", "ax", "ay"}
    parts: list[str] = []
    if name == "carrier":
        return f"{at.state}.{quoted(name)}" if at.state else "CAST(NULL AS INTEGER)"
    if name == "pitch":
        return f"CAST({at.state}.{quoted(name)} AS DOUBLE)" if at.state else "CAST(NULL AS DOUBLE)"
    if name == "node_id":
        ids = [f"{alias}.{quoted(name)}" for alias in (at.state, at.entity, at.map) if alias]
        return ids[0] if len(ids) == 1 else f"coalesce({', '.join(ids)})"
    if at.state:
        parts.append(f"CAST({at.state}.{quoted(name)} AS DOUBLE)")
    if at.entity:
        value = f"CAST({at.entity}.{quoted(name)} AS DOUBLE)"
        parts.append(f'CASE WHEN {at.entity}."is_static" THEN 0e0 END' if still else value)
    if at.map:
        value = "0e0" if still else f"{at.map}.{quoted(name)}"
        value = f'{value} - {at.trace}."origin_{name}"' if name in {"x", "y", "z"} else value
        # Signs and lights of a map are entities. Lanes and roads have no pair numbers.
        parts.append(f'CASE WHEN {at.map}."kind" NOT IN ({PLACES}) THEN {value} END')
    if not parts:
        return "CAST(NULL AS DOUBLE)"
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def _side_text(name: str, at: Aliases, *, upright: bool) -> str:
    """Return the SQL of the lower or upper height of a body. It is NULL for signals and map parts."""
    parts = [
        low_and_high_sql(
            lambda column, alias=alias: (
                f"{alias}.{quoted(column)}"
                if column == "kind"
                else f"CAST({alias}.{quoted(column)} AS DOUBLE)"
            ),
            upright=upright,
        )[name]
        for alias in (at.state, at.entity)
        if alias
    ]
    if not parts:
        return "CAST(NULL AS DOUBLE)"
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def owner_text(node: str, profile: Profile, trace: str, road_map: str) -> str:
    """Return the SQL of the owner of a node id: the trace of an entity, or the map if negative."""
    if not profile.mapped:
        return trace
    of_map = f"coalesce({road_map}, -1 - ({trace}))"
    return (
        of_map if profile.places == 1 else f"CASE WHEN {node} >= 0 THEN {trace} ELSE {of_map} END"
    )


def role_text(frame: str, node: str) -> str:
    """Return the SQL of the role of a lane relative to the ego in a frame."""
    on = [f'":r"."frame_id" = {frame}', f'":r"."node_id" = {node}']
    role = Select(['any_value(":r"."role")'], ['"roles" AS ":r"'], on)
    return f"({role.text()})"


def own_text(attribute: Attribute, frame: str, node: str, edge: Sequence[str] = ()) -> str:
    """Return the SQL of a user-defined attribute in a frame.

    The attribute belongs to a node, or to the edge from this node with the given relation and other end.
    """
    told = 'json_extract_string(":o"."value", \'$\')'
    value = told
    if attribute.type is Type.number:  # another trace may have texts
        native = "HUGEINT" if attribute.whole else _NATIVE[attribute.type]
        numbers = "'BIGINT', 'UBIGINT', 'HUGEINT', 'DOUBLE'"
        value = f'CASE WHEN json_type(":o"."value") IN ({numbers}) THEN TRY_CAST({told} AS {native}) END'
    elif attribute.type is not Type.text:
        value = f"CAST({told} AS {_NATIVE[attribute.type]})"
    on = [f'":o"."frame_id" = {frame}', f'":o"."node_id" = {node}']
    ends = [
        f'":o"."{name}" = {text}' for name, text in zip(("relation", "dst"), edge, strict=False)
    ]
    on += ends or ['":o"."relation" IS NULL']
    on.append(f'":o"."attribute" = {literal(attribute.name)}')
    rows = Select([f"any_value({value})"], ['"attribute" AS ":o"'], on)
    return f"({rows.text()})"


def _part(attribute: Attribute, home: Home, column: str, alias: str, trace: str | None) -> str:
    number = f"CAST({column} AS DOUBLE)"
    unit = attribute.unit
    if unit in _ORIGINS and home is not Home.map:
        return f"({number} + {trace}.{quoted(_ORIGINS[unit])})"
    if unit in _BITS:
        bit = 2 ** _BITS[unit].index(attribute.name)
        return f"({column} & {bit}) <> 0"
    if (unit, home) in _STILL:
        return _STILL[unit, home].format(column)
    if unit is DisplayUnit.along:
        ay, heading = (f"CAST({alias}.{quoted(c)} AS DOUBLE)" for c in ("ay", "heading"))
        return f"({number} * cos({heading}) + {ay} * sin({heading}))"
    if unit is DisplayUnit.given:
        return f"CASE WHEN {alias}.{quoted('node_id')} IS NOT NULL THEN {column} IS NOT NULL END"
    plain = number if attribute.type is Type.number else column
    return _CONVERTED.get(unit, "{1}").format(column, plain)


_BITS: Final = {
    DisplayUnit.light: VEHICLE_LIGHTS,
    DisplayUnit.derived: tuple(f"derived_{what}" for what in DERIVED),
}
_STILL: Final = {
    (DisplayUnit.standing, Home.map): "CASE WHEN {0} IS NOT NULL THEN TRUE END",
    (DisplayUnit.velocity, Home.scenery): "CASE WHEN {0} THEN 0e0 END",
    (DisplayUnit.velocity, Home.map): f"CASE WHEN {{0}} NOT IN ({PLACES}) THEN 0e0 END",
}
"""Values of entities and map parts that never move."""

_CONVERTED: Final = {DisplayUnit.degrees: "degrees({1})", DisplayUnit.whole: "CAST({0} AS BIGINT)"}


def _label(at: Aliases) -> str:
    parts: list[str] = []
    if at.map:
        parts.append(f"{at.map}.{quoted('name')}")
    told = at.entity or (None if at.map else at.state)
    if told:
        kind = f"CAST({told}.{quoted('kind')} AS VARCHAR)"
        parts.append(f"{kind} || ' ' || CAST({told}.{quoted('node_id')} AS VARCHAR)")
    if not parts:
        return _ABSENT[Type.text]
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def as_type(column: str, kind: Type) -> str:
    """Convert a column of a user table to a value of the query language."""
    return f"CAST({column} AS {_NATIVE[kind]})"


_NATIVE: Final = {Type.number: "DOUBLE", Type.text: "VARCHAR", Type.boolean: "BOOLEAN"}


def frame_text(leaf: FrameAttribute | TraceAttribute, frame: str, trace: str, map_: str) -> str:
    """Return the SQL of an attribute of the frame or trace."""
    attribute = leaf.attribute
    home, column = next(iter(attribute.columns.items()))
    if attribute.unit in {
        DisplayUnit.seen,
        DisplayUnit.counted,
        DisplayUnit.weather,
        DisplayUnit.clock,
    }:
        return _looked_up(attribute, frame)
    if attribute.table:
        value = as_type(f'"u".{quoted(column)}', attribute.type)
        on = [f'"u"."frame_id" = {frame}."frame_id"']
        rows = Select([f"any_value({value})"], [f'{quoted(attribute.table)} AS "u"'], on)
        return f"({rows.text()})"
    alias = map_ if home is Home.map else frame if isinstance(leaf, FrameAttribute) else trace
    value = f"{alias}.{quoted(column)}"
    if attribute.unit is DisplayUnit.recording:
        on = [f'"r"."recording_id" = {trace}."recording_id"']
        of = Select([f'"r".{quoted(column)}'], ['"recording" AS "r"'], on)
        value = f"({of.text()})"
    match attribute.unit:
        case DisplayUnit.seconds:
            return "(" + seconds_text(f'{value} - {trace}."start_ns"') + ")"
        case DisplayUnit.span:
            return f"({seconds_text(value)})"
        case DisplayUnit.classed:
            return _class_text(column, frame)
        case _:
            return value


def seconds_text(ns: str) -> str:
    """Return the SQL that converts nanoseconds to seconds, as :func:`sgstore.model.world.seconds_of`."""
    return f"round(CAST({ns} AS DOUBLE) / 1e3) / 1e6"


def _class_text(abstraction: str, frame: str) -> str:
    on = [f'"c"."frame_id" = {frame}."frame_id"', f'"c"."abstraction" = {literal(abstraction)}']
    classes = Select(['any_value("c"."class")'], ['"classes" AS "c"'], on)
    return f"({classes.text()})"


def _looked_up(attribute: Attribute, frame: str) -> str:
    """Return the SQL of a frame value that comes from other frames or events."""
    column = next(iter(attribute.columns.values()))
    if attribute.unit in {DisplayUnit.weather, DisplayUnit.clock}:
        return _weather_text(column, frame)
    held = f'"k"."abstraction" = {literal(column)}'
    if attribute.given:
        return _given_text(attribute, column, frame)
    if attribute.unit is DisplayUnit.seen:
        classes = Select(['"k"."class"'], ['"classes" AS "k"'], [held, '"k"."class" IS NOT NULL'])
        if attribute.table:
            frames = Select(['"u"."frame_id"'], [f'{quoted(attribute.table)} AS "u"'])
            classes.where.append(f'"k"."frame_id" IN ({frames.text()})')
        else:
            classes.where.append(among('"k"."frame_id" >> 24', list(attribute.traces)))
        return f"({_class_text(column, frame)} IN ({classes.text()}))"
    counts = Select(['"k"."class"', 'count(*) AS "frames"'], ['"classes" AS "k"'], [held])
    counts.group = ['"k"."class"']
    number = Select(['any_value("n"."frames")'], [nested(counts.text(), "n")])
    number.where = [f'"n"."class" = {_class_text(column, frame)}']
    return f"({number.text()})"


def _given_text(attribute: Attribute, abstraction: str, frame: str) -> str:
    """Return the SQL of a frame value from the class tables of a whole collection."""
    seen = attribute.unit is DisplayUnit.seen
    dataset = attribute.name.removeprefix(f"class_{abstraction} in ") if seen else ""
    on = [f'"k"."abstraction" = {literal(abstraction)}', f'"k"."dataset" = {literal(dataset)}']
    classed = _class_text(abstraction, frame)
    if seen:
        classes = Select(['"k"."class"'], [f'{quoted(attribute.given)} AS "k"'], on)
        return f"({classed} IN ({classes.text()}))"
    on.append(f'"k"."class" = {classed}')
    number = Select(['any_value("k"."frames")'], [f'{quoted(attribute.given)} AS "k"'], on)
    return f"({number.text()})"


def _weather_text(word_: str, frame: str) -> str:
    """Return the SQL of a weather word from the last weather event up to the frame."""
    told = f'regexp_extract("v"."detail", \'(^|, ){word_}=([^,]*)\', 2)'
    if word_ == "time_of_day":
        parts = [
            f"CAST(split_part({told}, ':', {n}) AS DOUBLE) / {60 ** (n - 1)}" for n in (1, 2, 3)
        ]
        since = f'({frame}."time_ns" - "v"."time_ns") / 3.6e12'
        value = f"({' + '.join(parts)} + {since}) % 24"
        said = f"{told} <> ''"
    elif word_ == "temperature":
        value, said = f"CAST(split_part({told}, ' ', 1) AS DOUBLE)", f"{told} <> ''"
    else:
        value, said = f"nullif({told}, '')", "TRUE"
    on = [
        f'"v"."trace_id" = {frame}."trace_id"',
        '"v"."kind" = \'environment\'',
        f'"v"."frame_id" <= {frame}."frame_id"',
        said,
    ]
    last = Select([f'arg_max({value}, "v"."time_ns")'], ['"events" AS "v"'], on)
    return f"({last.text()})"


# Recorded events ---------------------------------------------------------------------------------


def happened_rows(happened: Happened) -> str:
    """Return SQL for the frames of an event, with the nodes involved as ``:0`` and ``:1``."""
    if happened.table:
        return _rows_of_table(happened)
    told, ends = [literal(happened.kind)], ('"node_id"', '"other"')
    ways = [ends, ends[::-1]][
        : 1 + bool(happened.nodes)
    ]  # an event of two nodes is found in either order
    rows: list[str] = []
    for way in ways:
        columns = [f'{end} AS ":{n}"' for n, end in enumerate(way[: len(happened.nodes)])]
        rows.append(Select(['"frame_id"', *columns], ['"events"'], [f'"kind" = {told[0]}']).text())
    return "\nUNION ALL\n".join(rows)


def _rows_of_table(happened: Happened) -> str:
    select = Select(['"u"."frame_id" AS "frame_id"'], [f'{quoted(happened.kind)} AS "u"'])
    for place, name in enumerate(happened.table[: len(happened.nodes)]):
        column = f'"u".{quoted(name)}'
        if name.lower() in {"node_id", "other", "src", "dst"}:
            select.columns.append(f'TRY_CAST({column} AS BIGINT) AS ":{place}"')
            continue
        alias = quoted(f"e{place}")
        on = [f'{alias}."trace_id" = "u"."frame_id" >> 24']
        on.append(f'{alias}."ident" = CAST({column} AS VARCHAR)')
        select.join(f'"entity" AS {alias}', on, "LEFT JOIN")
        select.columns.append(f'{alias}."node_id" AS ":{place}"')
    return select.text()


def happened_text(happened: Happened, frame: str, nodes: Sequence[str]) -> str:
    """Return SQL that tests an event of some nodes. NULL means that the event is not recorded."""
    where = [f'":e"."frame_id" = {frame}']
    where += [f'":e".":{place}" = {node}' for place, node in enumerate(nodes)]
    there = Select(["1"], [nested(happened_rows(happened), ":e")], where)
    if happened.table:
        return f"EXISTS ({there.text()})"
    told = f"{frame} >> 24 IN ({told_events(happened.kind)})"
    return f"CASE WHEN EXISTS ({there.text()}) THEN TRUE WHEN {told} THEN FALSE END"


def happened_in_frame(happened: Happened) -> str:
    """Return SQL for the nodes of an event in one frame: two columns, padded with NULL."""
    told = [f'":{place}"' for place in range(len(happened.nodes))]
    columns = [*told, "NULL", "NULL"][:2]
    rows = nested(happened_rows(happened), ":e")
    return Select(columns, [rows], ['"frame_id" = $1']).text()


EVENT_SCHEMAS: Final = {
    "collision": "CarlaCollisionEvent",
    "lane_invasion": "CarlaLaneInvasionEvent",
}
"""Ends of the schema names of event channels. With such a channel, no messages means no events."""


def told_events(kind: str) -> str:
    """Return SQL for the traces that record events of a kind: they have an event or a channel."""
    events = Select(['"trace_id"'], ['"event"'], [f'"kind" = {literal(kind)}'])
    if kind not in EVENT_SCHEMAS:
        return events.text()
    end = literal(f"%{EVENT_SCHEMAS[kind]}")
    channels = Select(['"trace_id"'], ['"channel"'], [f'"schema" LIKE {end}'])
    return f"{events.text()}\nUNION\n{channels.text()}"


def recorded_events(schemas: Iterable[str]) -> frozenset[str]:
    """Return the kinds of events recorded by channels with the given schemas."""
    names = tuple(schemas)
    return frozenset(k for k, end in EVENT_SCHEMAS.items() if any(n.endswith(end) for n in names))


# Expressions ---------------------------------------------------------------------------------------

Leaf = (
    NodeValue
    | NodeAttribute
    | EdgeRelation
    | EdgeAttribute
    | FrameAttribute
    | TraceAttribute
    | PairNumber
    | Happened
    | BlockValue
    | GroupKey
)
"""Leaves of an expression that a statement must provide as columns."""


def expression_text(expression: Bound, leaf: Callable[[Leaf], str], values: BoundValues) -> str:
    """Return the SQL of an expression. ``leaf`` returns the SQL of each leaf."""
    match expression:
        case Value():
            return _value(expression, values)
        case Operation():
            return _operation(expression, leaf, values)
        case Aggregate(operand=FrameAttribute(attribute=Attribute(name="held")) as held):
            return f"CAST(coalesce(sum({leaf(held)}), 0) AS BIGINT)"
        case Aggregate(operand=operand):
            inner = "*" if operand is None else expression_text(operand, leaf, values)
            return sql_of(expression, inner)
        case NodeAttribute(attribute=attribute) if attribute.values:
            return f"CAST({leaf(expression)} AS VARCHAR)"
        case Choices() | LabelTest() | Tense() | SignalCall() | StepTime() | OverMatch():
            raise TypeError(f"{expression} is no column")
        case _:
            return leaf(expression)


def _value(value: Value, values: BoundValues) -> str:
    if value.value is None:
        return "NULL"
    if isinstance(value.value, bool):
        return "TRUE" if value.value else "FALSE"
    if value.closed:
        return literal(str(value.value))
    return values.add(value.value)


def _operation(operation: Operation, leaf: Callable[[Leaf], str], values: BoundValues) -> str:
    name = operation.word
    if name == "IN":
        parts = _membership(operation, leaf, values)
    elif name in COMPARISONS:
        parts = [_compared(operand, operation, leaf, values) for operand in operation.operands]
    else:
        parts = [expression_text(operand, leaf, values) for operand in operation.operands]
    sql = COMPILER_SQL.get(name) or OPERATORS[name].sql
    return sql(parts)


def _compared(
    operand: Bound, operation: Operation, leaf: Callable[[Leaf], str], values: BoundValues
) -> str:
    """Return the SQL of one side of a comparison. A vocabulary column needs no cast."""
    closed = all(
        (isinstance(o, Value) and o.closed) or (isinstance(o, NodeAttribute) and o.attribute.values)
        for o in operation.operands
    )
    words = any(isinstance(o, Value) for o in operation.operands)
    if closed and words and operation.word in {"=", "<>"} and isinstance(operand, NodeAttribute):
        return leaf(operand)
    return expression_text(operand, leaf, values)


def _membership(
    operation: Operation, leaf: Callable[[Leaf], str], values: BoundValues
) -> list[str]:
    operand, choices = operation.operands
    assert isinstance(choices, Choices)  # noqa: S101 - the binder built it so
    if not choices.items:
        return [""]
    if isinstance(operand, NodeAttribute) and all(item.closed for item in choices.items):
        text = leaf(operand)
    else:
        text = expression_text(operand, leaf, values)
    return [text, *(_value(item, values) for item in choices.items)]


def leaves(expression: Bound) -> Iterable[Leaf]:
    """Yield the leaves of an expression that need a column."""
    match expression:
        case Value() | Choices() | LabelTest() | GroupKey() | Tense() | SignalCall():
            return
        case StepTime() | OverMatch():
            return
        case Operation(operands=operands):
            for operand in operands:
                yield from leaves(operand)
        case Aggregate(operand=operand):
            if operand is not None:
                yield from leaves(operand)
        case _:
            yield expression


def columns_of(nodes: frozenset[str], edges: frozenset[str] = frozenset()) -> list[str]:
    """Return the quoted columns that bind the given nodes and edges."""
    return [quoted(f"{key}.id") for key in sorted(nodes)] + [
        quoted(f"{key}.type") for key in sorted(edges)
    ]


def column_of(leaf: Leaf) -> str:
    """Return the column name of a leaf."""
    match leaf:
        case NodeValue(node=owner):
            name = "id"
        case EdgeRelation(edge=owner):
            name = "type"
        case (
            NodeAttribute(node=owner, attribute=attribute)
            | EdgeAttribute(edge=owner, attribute=attribute)
        ):
            name = _as_column(attribute)
        case FrameAttribute(attribute=attribute):
            owner, name = "frame", attribute.name
        case TraceAttribute(attribute=attribute):
            owner, name = "trace", attribute.name
        case PairNumber(function=function, a=a, b=b):
            return f"{function}({a}, {b})"
        case Happened(kind=kind, nodes=nodes):
            return f"happens {kind}({', '.join(nodes)})"
        case BlockValue(number=number):
            return f"block {number}"
        case GroupKey(name=name):
            return name
    return f"{owner}.{name}"


def _as_column(attribute: Attribute) -> str:
    """Return the column name of an attribute. Names that differ only in case get distinct columns."""
    own = attribute.unit is DisplayUnit.own and attribute.name != attribute.name.lower()
    return attribute.name.encode().hex() if own else attribute.name


def edge_table(edge: Edge, src: str, dst: str) -> tuple[str, dict[str, str]]:
    """Return the table with the attributes of an edge, and the columns of its two ends.

    The ends of an ``isIn`` edge are an entity, with an id of 0 or above, and a lane, with a negative id. A
    gap is stored once, with the follower first.
    """
    if "isIn" in edge.relations:
        ends = (f"greatest({src}, {dst})", f"least({src}, {dst})") if edge.both else (src, dst)
        return "lane_state", dict(zip(("node_id", "lane"), ends, strict=True))
    behind, ahead = (dst, src) if "leads" in edge.relations else (src, dst)
    return "lane_gap", {"src": behind, "dst": ahead}


def lane_text(leaf: Leaf, alias: str) -> str:
    """Return the SQL of an edge attribute, from a row of :func:`edge_table`."""
    assert isinstance(leaf, EdgeAttribute)  # noqa: S101 - the condition was filed so
    return attribute_text(leaf.attribute, Aliases(state=alias))


def is_position(leaf: Leaf) -> bool:
    """True if a value is a coordinate, stored relative to the origin of the trace."""
    return isinstance(leaf, NodeAttribute) and leaf.attribute.unit in {
        DisplayUnit.east,
        DisplayUnit.north,
        DisplayUnit.up,
    }


def is_constant(leaf: Leaf) -> bool:
    """True if the value never changes for an entity."""
    if not isinstance(leaf, NodeAttribute):
        return False
    return Home.entity in leaf.attribute.columns or leaf.attribute.unit is DisplayUnit.label


def among(column: str, numbers: list[int]) -> str:
    """Return the SQL condition that a column is in a list of integers."""
    return f"({column}) IN ({', '.join(map(str, numbers))})" if numbers else "FALSE"


def node_text(condition: Bound, node: str, at: Aliases, values: BoundValues) -> str:
    """Return the SQL of a condition on one node, from its id column and table aliases."""

    def leaf(found: Leaf) -> str:
        if isinstance(found, NodeAttribute) and found.attribute.unit is not DisplayUnit.binding:
            return attribute_text(found.attribute, at)
        return node

    return expression_text(condition, leaf, values)


def bound_text(
    condition: Bound, nodes: Mapping[str, str], edges: Mapping[str, str], values: BoundValues
) -> str:
    """Return the SQL of a condition on node ids and edge relations, from their columns."""

    def leaf(found: Leaf) -> str:
        match found:
            case EdgeRelation(edge=edge):
                return f"CAST({edges[edge]} AS VARCHAR)"
            case NodeValue(node=node) | NodeAttribute(node=node):
                return nodes[node]
            case _:
                raise TypeError(found)

    return expression_text(condition, leaf, values)


def trace_text(condition: Bound, trace: str, values: BoundValues) -> str:
    """Return the SQL of a condition on the trace, from its id column."""
    select = Select(['"t"."trace_id"'], ['"trace" AS "t"'])
    select.join('"map" AS "m"', ['"m"."map_id" = "t"."map_id"'], "LEFT JOIN")

    def leaf(found: Leaf) -> str:
        assert isinstance(found, TraceAttribute)  # noqa: S101 - the condition was filed so
        return frame_text(found, "", '"t"', '"m"')

    select.where.append(expression_text(condition, leaf, values))
    return f"{trace} IN (\n{indented(select.text())}\n  )"
