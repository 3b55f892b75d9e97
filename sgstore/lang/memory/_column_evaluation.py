"""Evaluation of query expressions in memory, with arrays for many nodes or frames at once.

Numbers of a node, and of its pair with a bound node, are columns over all candidate nodes. A condition on
them is a few array operations. The results are identical to the last bit. Conditions on texts, blocks and
edges are not evaluated in this way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.catalog import NODE_ATTRIBUTES, DisplayUnit, Type
from sgstore.lang.memory._evaluate import Binding, evaluator
from sgstore.lang.memory._frame_view import NodeColumns
from sgstore.lang.operators import OPERATORS, Column
from sgstore.model.criticality import RECORDED
from sgstore.model.pair_numbers import WAYS

if TYPE_CHECKING:
    from sgstore.lang.catalog import Attribute
    from sgstore.model.world import Bools


MOST: Final = 2.0**53
"""Largest integer up to which all integers are exact floats."""

T = TypeVar("T")

Columns = Callable[[T], Column]
"""Function that evaluates an expression for many items at once."""


def column_evaluator(
    expression: b.Bound, leaf: Callable[[b.Bound], Columns[T] | None]
) -> Columns[T]:
    """Return a function that evaluates a query expression with arrays, for many nodes or frames at once.

    Parameters
    ----------
    expression : Bound
    leaf : function
        Function that returns the evaluator of a special part, such as an attribute. ``None`` means that the
        part is evaluated by default rules.
    """
    found = leaf(expression)
    if found is not None:
        return found
    match expression:
        case b.Value(value=None):
            return _always(Column(0, known=False))
        case b.Value(value=value):
            return _always(Column(np.asarray(value)))
        case b.Choices(items=items):
            return _always(Column(tuple(item.value for item in items)))
        case b.Operation(word=word, operands=operands):
            combine = OPERATORS[word].columns
            parts = [column_evaluator(operand, leaf) for operand in operands]
            return lambda asked: combine([part(asked) for part in parts])
        case _:
            raise TypeError(f"{expression} has no columns")


def _always(column: Column) -> Columns[Any]:
    return lambda _: column


Asked = tuple[Binding, NodeColumns]
Test = Callable[[Binding, NodeColumns], "Bools"]


class _Alone(Exception):  # noqa: N818 - not an error: the condition is evaluated node by node
    pass


def crowd_test(condition: b.Bound, key: str) -> Test | None:
    """Return a function that tests a condition for all candidate nodes of one variable at once.

    ``None`` if the condition has a part without an array form.

    Parameters
    ----------
    condition : Bound
    key : str
        Key of the variable. The others are bound.

    Returns
    -------
    function or None
        Function from a binding and candidates to a mask (N,) of bool. ``None`` means that the condition must
        be tested node by node.
    """
    try:
        asked = column_evaluator(condition, lambda part: _of_crowd(part, key))
    except _Alone:
        return None

    def test(at: Binding, among: NodeColumns) -> Bools:
        with np.errstate(all="ignore"):
            return np.broadcast_to(asked((at, among)).true, len(among.nodes))

    return test


def _of_crowd(part: b.Bound, key: str) -> Columns[Asked] | None:
    match part:
        case b.Value(value=str()) | b.Choices():
            raise _Alone
        case b.Value(value=int() | float() as number) if abs(number) > MOST:
            raise _Alone
        case b.Operation(word="coalesce", type=Type.number):
            raise _Alone  # for the remaining nodes only, because pair numbers are expensive
        case b.Value() | b.Operation():
            return None
        case b.NodeAttribute(node=node, attribute=attribute) if attribute.type in {
            Type.number,
            Type.boolean,
        } and not _is_derived(attribute):
            if node != key:
                return _of_others(part)
            name, truth = attribute.name, attribute.type is Type.boolean
            return lambda asked: asked[1].attribute(asked[0].view, name, truth=truth)
        case b.PairNumber(function=function, a=one, b=other) if (
            function not in WAYS | RECORDED.keys()
        ):
            if key not in {one, other}:
                return _of_others(part)
            if one == other:
                raise _Alone
            ahead = other == key
            bound = one if ahead else other
            return lambda asked: asked[1].pair(
                asked[0].view, function, asked[0].nodes[bound], ahead=ahead
            )
        case _:
            raise _Alone


def _is_derived(attribute: Attribute) -> bool:
    """True if a node attribute is computed, and not stored in the node as a number or boolean."""
    return attribute.unit in {
        DisplayUnit.inside,
        DisplayUnit.binding,
        DisplayUnit.role,
        DisplayUnit.own,
    } or attribute in {NODE_ATTRIBUTES["injunction"], NODE_ATTRIBUTES["lifetime"]}


def _of_others(value: b.NodeAttribute | b.PairNumber) -> Columns[Asked]:
    """Return a function for a value of nodes that are already chosen.

    The value is the same for all candidates.
    """
    told = evaluator(value, _no_blocks)

    def same(asked: Asked) -> Column:
        found = told(asked[0])
        return Column(0, known=False) if found is None else Column(found)

    return same


def _no_blocks(block: b.BlockValue) -> Any:
    raise TypeError(f"{block} is not the number of a node")
