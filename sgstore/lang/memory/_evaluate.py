"""Evaluation of query expressions in memory for a single match.

Expressions have the same meaning as in :mod:`sgstore.lang.sql._masks`, which evaluates them in a store:
``None`` is NULL, and logic has three values.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.catalog import (
    COMPUTED,
    NODE_ATTRIBUTES,
    UNSURE_LANE,
    UNSURE_LEAD,
    DisplayUnit,
    Type,
)
from sgstore.lang.memory._frame_view import FrameView, NodeColumns, attribute_of
from sgstore.lang.operators import OPERATORS, Column
from sgstore.model.criticality import RECORDED
from sgstore.model.pair_numbers import WAYS
from sgstore.model.vocabulary import NOISE_MARKS

if TYPE_CHECKING:
    from sgstore.lang.catalog import Attribute
    from sgstore.lang.memory._frame_view import Attributes
    from sgstore.model.world import Bools


@dataclass(slots=True)
class Binding:
    """Nodes and edges that the search has chosen so far for the variables of a query.

    Attributes
    ----------
    view : FrameView
    nodes : dict of str to int
        Node ids by key, for the keys bound so far.
    edges : dict of str to (relation, attributes)
    passed : dict of str to value
        Values passed by ``WITH`` and paths, by the names of their placeholders.
    """

    view: FrameView
    nodes: dict[str, int] = field(default_factory=dict[str, int])
    edges: dict[str, tuple[str, Attributes]] = field(
        default_factory=dict[str, "tuple[str, Attributes]"]
    )
    passed: dict[str, Any] = field(default_factory=dict[str, Any])


Evaluate = Callable[[Binding], Any]
Blocks = Callable[[b.BlockValue], Evaluate]


def evaluator(expression: b.Bound, blocks: Blocks) -> Evaluate:  # noqa: C901, PLR0911, PLR0912 - a case each
    """Return a function that computes the value of an expression for the chosen nodes and edges.

    Parameters
    ----------
    expression : Bound
    blocks : function
        Function that returns the evaluator of a block. It is provided by the search.
    """
    match expression:
        case b.Value(value=value):
            return lambda _: value
        case b.NodeValue(node=node):
            return lambda at: at.nodes[node]
        case b.NodeAttribute(node=node, attribute=attribute):
            return _of_node(node, attribute)
        case b.LabelTest(node=node, kinds=kinds):
            return lambda at: at.view.is_one(at.nodes[node], kinds)
        case b.EdgeRelation(edge=edge):
            return lambda at: at.edges[edge][0]
        case b.EdgeAttribute() | b.FrameAttribute() if expression.attribute in _UNSURE:
            return _unsure(expression)
        case b.EdgeAttribute(edge=edge, attribute=attribute):
            name = attribute.name
            if attribute.unit is DisplayUnit.own:
                of = _OWN[attribute.type]
                return lambda at: of(at.edges[edge][1].get(name))
            return lambda at: at.edges[edge][1].get(name)
        case b.FrameAttribute(attribute=attribute) if attribute.unit is DisplayUnit.classed:
            (name,) = attribute.columns.values()
            return lambda at: at.view.class_in(name)
        case b.FrameAttribute(attribute=attribute):
            name = attribute.name
            if b.is_passed_on(expression):
                return lambda at: at.passed[name]
            if attribute.topic is not None and attribute.type in _OWN:
                of = _OWN[attribute.type]
                return lambda at: of(at.view.frame.get(name))
            return lambda at: at.view.frame.get(name)
        case b.TraceAttribute(attribute=attribute):
            if attribute is COMPUTED:
                return lambda _: True
            name = attribute.name
            return lambda at: at.view.trace.get(name)
        case b.PairNumber(function=function, a=one, b=other):
            return lambda at: at.view.pair(function, at.nodes[one], at.nodes[other])
        case b.Happened(nodes=nodes):
            return lambda at: at.view.happens(expression, tuple(at.nodes[one] for one in nodes))
        case b.BlockValue():
            return blocks(expression)
        case b.Choices(items=items):
            chosen = frozenset(item.value for item in items)
            return lambda _: chosen
        case b.Operation(word=word, operands=operands):
            return OPERATORS[word].one([evaluator(operand, blocks) for operand in operands])
        case (
            b.Aggregate() | b.GroupKey() | b.Tense() | b.SignalCall() | b.StepTime() | b.OverMatch()
        ):
            raise TypeError(f"{expression} has no value")


def _of_node(node: str, attribute: Attribute) -> Evaluate:  # noqa: PLR0911 - a case each
    """Return a function that computes an attribute of a node in memory."""
    if attribute.unit is DisplayUnit.binding:
        return lambda at: at.nodes[node]
    if attribute.unit in _OF_VIEW:
        value = _OF_VIEW[attribute.unit]
        return lambda at: value(at.view, at.nodes[node])
    if attribute in _UNSURE:
        return lambda at: at.nodes[node] in getattr(at.view.graph, attribute.name)
    if attribute is NODE_ATTRIBUTES["injunction"]:
        return lambda at: _in_junction(at, at.nodes[node])
    if attribute is NODE_ATTRIBUTES["type"]:
        return lambda at: _type_of(at.view.nodes[at.nodes[node]])
    name = attribute.name
    if attribute is NODE_ATTRIBUTES["lifetime"]:
        return lambda at: _lifetime(at.nodes[node], at.view.nodes[at.nodes[node]])
    if attribute.unit is DisplayUnit.own:
        of = _OWN[attribute.type]
        return lambda at: of(at.view.nodes[at.nodes[node]].get(name))
    if name in NOISE_MARKS:
        return lambda at: attribute_of(at.view.nodes[at.nodes[node]], name)
    return lambda at: at.view.nodes[at.nodes[node]].get(name)


_OF_VIEW: Final = {
    DisplayUnit.role: FrameView.role_of,
    DisplayUnit.chain: FrameView.chain_of,
    DisplayUnit.inside: FrameView.draws,
}
"""Functions for attributes that depend on the frame, or on the whole map."""

_UNSURE: Final = frozenset({UNSURE_LANE, UNSURE_LEAD})


def _unsure(value: b.EdgeAttribute | b.FrameAttribute) -> Evaluate:
    """Return a function that tests if a lane is not known yet, for an edge, the ego or any vehicle."""
    if isinstance(value, b.FrameAttribute) and value.attribute is UNSURE_LANE:
        return lambda at: at.view.graph.ego in at.view.graph.unsure_lane
    if isinstance(value, b.FrameAttribute):
        return lambda at: bool(at.view.graph.unsure_lead)
    edge = value.edge
    return lambda at: "overlap" in at.edges[edge][1] and "is_own" not in at.edges[edge][1]


def _in_junction(at: Binding, node: int) -> bool | None:
    """True if a part of the map belongs to a junction. None for entities."""
    return "junction" in at.view.nodes[node] if node < 0 else None


def _text_of(value: Any) -> str | None:
    """Return a JSON value as text, in the format of the database; None stays None."""
    if value is None or isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def _number_of(value: Any) -> Any:
    """Return a JSON value that is a number; None for other values.

    The same attribute may be a text in other traces.
    """
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


_OWN: Final[Mapping[Type, Callable[[Any], Any]]] = {
    Type.number: _number_of,
    Type.text: _text_of,
    Type.boolean: lambda value: value if isinstance(value, bool) else None,
}
"""Conversions from JSON to the type of a user-defined attribute."""


def _lifetime(node: int, attributes: Attributes) -> int | None:
    """If several entities have this id one after another, return the number of this one, from 1.

    ``None`` for map parts.
    """
    return None if node < 0 else attributes.get("lifetime", 1)


def _type_of(attributes: Attributes) -> Any:
    return attributes.get("lane_type" if attributes["kind"] == "lane" else "type_name")


MOST: Final = 2.0**53
"""Largest integer up to which all integers are exact floats."""

T = TypeVar("T")

Columns = Callable[[T], Column]
"""Function that evaluates an expression for many items at once."""


def column_evaluator(
    expression: b.Bound, leaf: Callable[[b.Bound], Columns[T] | None]
) -> Columns[T]:
    """Return a function that evaluates an expression with arrays: many nodes or frames at once.

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
    """Return a function that tests a condition for many nodes at once: all candidates of a variable.

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
    """True if a node attribute must be computed, as the node has no number or boolean for it."""
    return attribute.unit in {
        DisplayUnit.inside,
        DisplayUnit.binding,
        DisplayUnit.role,
        DisplayUnit.chain,
        DisplayUnit.own,
    } or attribute in {
        *(NODE_ATTRIBUTES["injunction"], NODE_ATTRIBUTES["lifetime"]),
        *_UNSURE,
    }


def _of_others(value: b.NodeAttribute | b.PairNumber) -> Columns[Asked]:
    """Return a function for a value that is equal for all candidates, as it uses only chosen nodes.

    The value is the same for all candidates.
    """
    told = evaluator(value, _no_blocks)

    def same(asked: Asked) -> Column:
        found = told(asked[0])
        return Column(0, known=False) if found is None else Column(found)

    return same


def _no_blocks(block: b.BlockValue) -> Any:
    raise TypeError(f"{block} is not the number of a node")
