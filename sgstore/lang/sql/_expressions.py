"""SQL of query expressions: values, attributes, conditions, and numbers of entity pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sgstore.base.quoting import literal, quoted
from sgstore.lang.bind import sql_of
from sgstore.lang.catalog import Attribute, DisplayUnit, Home
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
from sgstore.lang.sql._attributes import Aliases, attribute_text, frame_text
from sgstore.lang.sql._select import BoundValues, Select, indented
from sgstore.model.pair_numbers import pair_sql, stage_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from sgstore.lang.ir import Edge


def pair_column(name: str, a: str, b: str) -> str:
    """Return the SQL column that has a number of two entities, or an attribute of one of them.

    ``a_x`` means x of entity a.
    """
    if stage_of(name):
        return quoted(f"{name}({a}, {b})")
    return quoted(f"{a if name[0] == 'a' else b}:{name[2:]}")


def pair_text(name: str, a: str, b: str, without: frozenset[str] = frozenset()) -> str:
    """Return the SQL of a number of two entities, from columns of a nested SELECT statement."""
    return pair_sql(name, lambda part: pair_column(part, a, b), without)


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
"""Parts of an expression, such as attributes, that an SQL statement must provide as columns."""


def expression_text(expression: Bound, leaf: Callable[[Leaf], str], values: BoundValues) -> str:
    """Return the SQL of a query expression. ``leaf`` returns the SQL of each attribute in it."""
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
            raise TypeError(f"{expression} is not a column")
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
    """Return the SQL of one side of a comparison. A column with an enumerated type needs no cast."""
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
    """Yield the parts of an expression, such as attributes, that SQL reads from a column."""
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
    """Return the quoted SQL columns for the node ids and the edge relations of a match."""
    return [quoted(f"{key}.id") for key in sorted(nodes)] + [
        quoted(f"{key}.type") for key in sorted(edges)
    ]


def column_of(leaf: Leaf) -> str:
    """Return the SQL column for a part of an expression, such as an attribute."""
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
    """Return the SQL column name of an attribute.

    User-defined names that differ only in case get distinct columns.
    """
    own = attribute.unit is DisplayUnit.own and attribute.name != attribute.name.lower()
    return attribute.name.encode().hex() if own else attribute.name


def edge_table(edge: Edge, src: str, dst: str) -> tuple[str, dict[str, str]]:
    """Return the table with the attributes of an edge, and the columns of its two nodes.

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
    """True if an expression is a coordinate of a node. The store has it relative to the trace's origin."""
    return isinstance(leaf, NodeAttribute) and leaf.attribute.unit in {
        DisplayUnit.east,
        DisplayUnit.north,
        DisplayUnit.up,
    }


def is_constant(leaf: Leaf) -> bool:
    """True if an expression is an attribute of a node that never changes while the entity exists."""
    if not isinstance(leaf, NodeAttribute):
        return False
    return Home.entity in leaf.attribute.columns or leaf.attribute.unit is DisplayUnit.label


def node_text(condition: Bound, node: str, at: Aliases, values: BoundValues) -> str:
    """Return the SQL of a condition on one node, from its id column and its tables' aliases."""

    def leaf(found: Leaf) -> str:
        if isinstance(found, NodeAttribute) and found.attribute.unit is not DisplayUnit.binding:
            return attribute_text(found.attribute, at)
        return node

    return expression_text(condition, leaf, values)


def bound_text(
    condition: Bound, nodes: Mapping[str, str], edges: Mapping[str, str], values: BoundValues
) -> str:
    """Return the SQL of a condition that uses only node ids and edge relations."""

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
    """Return the SQL of a condition on trace attributes. ``trace`` is the SQL of the trace id."""
    select = Select(['"t"."trace_id"'], ['"trace" AS "t"'])
    select.join('"map" AS "m"', ['"m"."map_id" = "t"."map_id"'], "LEFT JOIN")

    def leaf(found: Leaf) -> str:
        assert isinstance(found, TraceAttribute)  # noqa: S101 - the condition was filed so
        return frame_text(found, "", '"t"', '"m"')

    select.where.append(expression_text(condition, leaf, values))
    return f"{trace} IN (\n{indented(select.text())}\n  )"
