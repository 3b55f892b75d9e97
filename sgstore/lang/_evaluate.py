"""Evaluation in memory: one binding at a time, or columns of nodes.

Bound expressions as Python functions: the value of an expression for one binding of one graph in memory.

The same meaning as :mod:`sgstore.lang._sql_masks` gives them in a store: ``None`` is NULL, and logic has
three values.
"""

from __future__ import annotations

import math
import operator
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from sgstore.geometry import pair_numbers
from sgstore.lang import ir as b
from sgstore.lang._catalog import NODE_ATTRIBUTES, DisplayUnit, Type
from sgstore.lang._formulas import WAY
from sgstore.vocabulary import MAP_KINDS

if TYPE_CHECKING:
    from sgstore.geometry import PairNumbers
    from sgstore.graph import SceneGraph
    from sgstore.world import Bools, Floats


Attributes = Mapping[str, Any]


@dataclass
class FrameView:
    """A scene graph as a search wants it, with what is known of its frame and trace.

    Parameters
    ----------
    graph : SceneGraph
    frame, trace : mapping
        Attributes of ``frame`` and ``trace`` by their names in the language, as far as they are known.
    classes : callable, optional
        Gives the class of the graph in an abstraction, by its name; asked only where a query asks, and once.
        Without it classes are not known.
    roles : callable, optional
        Gives what lanes are to the ego, by node id; asked as classes are.
    """

    graph: SceneGraph
    frame: Attributes = field(default_factory=dict[str, Any])
    trace: Attributes = field(default_factory=dict[str, Any])
    classes: Callable[[str], str | None] | None = None
    roles: Callable[[], Mapping[int, str]] | None = None

    @cached_property
    def nodes(self) -> Mapping[int, Attributes]:
        """Attributes of the nodes by id."""
        return self.graph.nodes

    @cached_property
    def by_kind(self) -> Mapping[str, list[int]]:
        """Nodes of each kind, the ego among them."""
        found: defaultdict[str, list[int]] = defaultdict(list)
        for node, attributes in self.nodes.items():
            found[attributes["kind"]].append(node)
        return found

    @cached_property
    def links(self) -> Mapping[tuple[int, int], dict[str, Attributes]]:
        """Relation and attributes of the edges of each pair of nodes."""
        found: defaultdict[tuple[int, int], dict[str, Attributes]] = defaultdict(dict)
        for src, relation, dst, attributes in self.graph.edges:
            found[src, dst][relation] = attributes
        return found

    @cached_property
    def ahead(self) -> Mapping[tuple[str, int], list[int]]:
        """Where the edges of a relation lead from a node."""
        return self._neighbours(0, 2)

    @cached_property
    def back(self) -> Mapping[tuple[str, int], list[int]]:
        """Where the edges of a relation that end in a node come from."""
        return self._neighbours(2, 0)

    def _neighbours(self, at: int, other: int) -> Mapping[tuple[str, int], list[int]]:
        found: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
        for edge in self.graph.edges:
            found[edge[1], edge[at]].append(edge[other])  # type: ignore[index, arg-type]
        return found

    @cached_property
    def crowds(self) -> dict[b.Kinds, NodeColumns]:
        """Nodes of some kinds with their numbers, kept by :mod:`sgstore.lang._evaluate`."""
        return {}

    def class_in(self, abstraction: str) -> str | None:
        """The class of the graph in an abstraction; ``None`` where it is not known."""
        if abstraction not in self._classes:
            self._classes[abstraction] = self.classes(abstraction) if self.classes else None
        return self._classes[abstraction]

    @cached_property
    def _classes(self) -> dict[str, str | None]:
        return {}

    def role_of(self, node: int) -> str | None:
        """What a lane is to the ego; ``None`` where it is not known."""
        return self._roles.get(node)

    @cached_property
    def _roles(self) -> Mapping[int, str]:
        return self.roles() if self.roles else {}

    def is_one(self, node: int, kinds: b.Kinds) -> bool:
        """Whether a node is of these kinds."""
        kind = self.nodes[node]["kind"]
        return kind in (kinds.ego if node == self.graph.ego else kinds.other)

    def pair(self, name: str, one: int, other: int) -> float | None:
        """A number of a pair of entities; ``None`` where something that it needs is missing."""
        if name == WAY:
            reach = self.graph.reach
            places = self._places.get(one, ()), self._places.get(other, ())
            return None if reach is None else reach.distance(*places)
        place = self.rows.get(other)
        if place is None or one not in self.rows:
            return None
        key = name, one
        if key not in self._numbers:
            self._numbers[key] = self.pairs(name, one).tolist()
        value = self._numbers[key][place]
        return None if math.isnan(value) else value

    def pairs(self, name: str, one: int, *, ahead: bool = True) -> Floats:
        """(E,) a number of one entity and each other, by :attr:`rows`; all at once, for most will be asked.

        NaN where something that it needs is missing. Unless ``ahead``, of each other and the one.
        """
        place = self.rows.get(one)
        if place is None:
            return np.full(len(self.rows), math.nan)
        key = one, ahead
        if key not in self._pairs:
            boxes = self._boxes
            with np.errstate(invalid="ignore", divide="ignore"):
                own = np.broadcast_to(boxes[place], boxes.shape)
                self._pairs[key] = pair_numbers(own, boxes) if ahead else pair_numbers(boxes, own)
        column, scale = PAIR_NUMBERS[name]
        return scale * getattr(self._pairs[key], column)

    @cached_property
    def _places(self) -> Mapping[int, Sequence[tuple[int, float]]]:
        return self.graph.places()

    @cached_property
    def _pairs(self) -> dict[tuple[int, bool], PairNumbers]:
        return {}

    @cached_property
    def _numbers(self) -> dict[tuple[str, int], list[float]]:
        return {}

    @cached_property
    def rows(self) -> Mapping[int, int]:
        """Places of the entities in :meth:`pairs`."""
        known = (n for n, about in self.nodes.items() if about["kind"] not in MAP_KINDS)
        return {node: row for row, node in enumerate(known)}

    @cached_property
    def _boxes(self) -> Floats:
        """(E, 8) what numbers of pairs are made of."""
        rows = [[self.nodes[n].get(name, math.nan) for name in _BOX] for n in self.rows]
        boxes = np.array(rows, np.float64).reshape(-1, len(_BOX))
        boxes[:, 3] = np.radians(boxes[:, 3])
        return boxes


_BOX: Final = ("x", "y", "z", "heading", "length", "width", "vx", "vy")

_DEGREES: Final = 180 / math.pi
PAIR_NUMBERS: Final = {
    "dist": ("distance", 1.0),
    "gap": ("gap", 1.0),
    "lon": ("lon", 1.0),
    "lat": ("lat", 1.0),
    "bearing": ("bearing", _DEGREES),
    "rel_heading": ("rel_heading", _DEGREES),
    "lon_gap": ("lon_gap", 1.0),
    "lat_gap": ("lat_gap", 1.0),
    "apparent_heading": ("apparent_heading", _DEGREES),
    "closing_speed": ("closing_speed", 1.0),
    "closing_time": ("closing_time", 1.0),
    "ttc": ("ttc", 1.0),
    "headway": ("headway", 1.0),
    "rel_speed": ("rel_speed", 1.0),
}
"""Numbers of two boxes: what :func:`sgstore.geometry.pair_numbers` calls them, and what they are seen in."""


@dataclass(slots=True)
class Binding:
    """What the variables are bound to while a graph is searched.

    Attributes
    ----------
    view : FrameView
    nodes : dict of str to int
        Node ids by key; only those of the keys that the search has come to mean something.
    edges : dict of str to (relation, attributes)
    """

    view: FrameView
    nodes: dict[str, int] = field(default_factory=dict[str, int])
    edges: dict[str, tuple[str, Attributes]] = field(
        default_factory=dict[str, "tuple[str, Attributes]"]
    )


Evaluate = Callable[[Binding], Any]
Blocks = Callable[[b.BlockValue], Evaluate]


def evaluator(expression: b.Bound, blocks: Blocks) -> Evaluate:  # noqa: C901, PLR0911, PLR0912 - a case each
    """The function that gives the value of an expression.

    Parameters
    ----------
    expression : Bound
    blocks : function
        Gives the function of a block; it belongs to who can search.
    """
    match expression:
        case b.Value(value=value):
            return lambda _: value
        case b.NodeValue(node=node):
            return lambda at: at.nodes[node]
        case b.NodeAttribute(node=node, attribute=attribute):
            if attribute.unit is DisplayUnit.binding:
                return lambda at: at.nodes[node]
            if attribute.unit is DisplayUnit.role:
                return lambda at: at.view.role_of(at.nodes[node])
            if attribute is NODE_ATTRIBUTES["injunction"]:
                return lambda at: _in_junction(at, at.nodes[node])
            if attribute is NODE_ATTRIBUTES["type"]:
                return lambda at: _type_of(at.view.nodes[at.nodes[node]])
            name = attribute.name
            return lambda at: at.view.nodes[at.nodes[node]].get(name)
        case b.LabelTest(node=node, kinds=kinds):
            return lambda at: at.view.is_one(at.nodes[node], kinds)
        case b.EdgeRelation(edge=edge):
            return lambda at: at.edges[edge][0]
        case b.EdgeAttribute(edge=edge, attribute=attribute):
            name = attribute.name
            return lambda at: at.edges[edge][1].get(name)
        case b.FrameAttribute(attribute=attribute) if attribute.unit is DisplayUnit.classed:
            (name,) = attribute.columns.values()
            return lambda at: at.view.class_in(name)
        case b.FrameAttribute(attribute=attribute):
            name = attribute.name
            return lambda at: at.view.frame.get(name)
        case b.TraceAttribute(attribute=attribute):
            name = attribute.name
            return lambda at: at.view.trace.get(name)
        case b.PairNumber(function=function, a=one, b=other):
            return lambda at: at.view.pair(function, at.nodes[one], at.nodes[other])
        case b.BlockValue():
            return blocks(expression)
        case b.Operation():
            return _operation(expression, blocks)
        case b.Choices() | b.Aggregate() | b.Tense() | b.SignalCall() | b.StepTime():
            raise TypeError(f"{expression} has no value of its own")


def _in_junction(at: Binding, node: int) -> bool | None:
    """Whether a part of the map, whose id is below zero, belongs to a junction."""
    return "junction" in at.view.nodes[node] if node < 0 else None


def _type_of(attributes: Attributes) -> Any:
    return attributes.get("lane_type" if attributes["kind"] == "lane" else "type_name")


def _operation(operation: b.Operation, blocks: Blocks) -> Evaluate:
    word = operation.word
    if word == "IN":
        return _membership(operation, blocks)
    parts = [evaluator(operand, blocks) for operand in operation.operands]
    if word in _LOGIC:
        combine = _LOGIC[word]
        return lambda at: combine(part(at) for part in parts)
    if word == "coalesce":
        return lambda at: next((v for v in (part(at) for part in parts) if v is not None), None)
    if word in {"IS NULL", "IS NOT NULL"}:
        wanted, part = word == "IS NULL", parts[0]
        return lambda at: (part(at) is None) == wanted
    if word == "=~":
        return _regex(operation, parts[0])
    return _strict(_FUNCTIONS[word], parts)


def _strict(function: Callable[..., Any], parts: list[Evaluate]) -> Evaluate:
    """A function that is unknown where one of its arguments is."""
    if len(parts) == 2:
        left, right = parts

        def of_two(at: Binding) -> Any:
            one = left(at)
            if one is None:
                return None
            other = right(at)
            return None if other is None else function(one, other)

        return of_two

    def of_many(at: Binding) -> Any:
        values = [part(at) for part in parts]
        return None if None in values else function(*values)

    return of_many


def _membership(operation: b.Operation, blocks: Blocks) -> Evaluate:
    operand, choices = operation.operands
    if not isinstance(choices, b.Choices):
        raise TypeError(f"{choices} is no list")
    items = frozenset(item.value for item in choices.items)
    value = evaluator(operand, blocks)

    def member(at: Binding) -> bool | None:
        if not items:
            return False
        found = value(at)
        return None if found is None else found in items

    return member


def _regex(operation: b.Operation, text: Evaluate) -> Evaluate:
    pattern = operation.operands[1]
    if not isinstance(pattern, b.Value):
        raise TypeError(f"{pattern} is no constant")
    wanted = re.compile(str(pattern.value))

    def whole(value: str) -> bool:
        return wanted.fullmatch(value) is not None

    return _strict(whole, [text])


def _and(values: Any) -> bool | None:
    result: bool | None = True
    for value in values:
        if value is False:
            return False
        if value is None:
            result = None
    return result


def _or(values: Any) -> bool | None:
    result: bool | None = False
    for value in values:
        if value is True:
            return True
        if value is None:
            result = None
    return result


def _not(values: Any) -> bool | None:
    (value,) = values
    return None if value is None else not value


def _xor(values: Any) -> bool | None:
    known = list(values)
    return None if None in known else sum(known) % 2 == 1


def _implies(values: Any) -> bool | None:
    condition, consequence = values
    return _or((_not((condition,)), consequence))


_LOGIC: Final[dict[str, Callable[[Any], bool | None]]] = {
    "AND": _and,
    "OR": _or,
    "NOT": _not,
    "XOR": _xor,
    "IMPLIES": _implies,
}


def _divided(a: float, by: float) -> float | None:
    return a / by if by else None


def _remainder(a: float, by: float) -> float | None:
    return math.fmod(a, by) if by else None


def _root(a: float) -> float | None:
    return math.sqrt(a) if a >= 0 else None


def _rounded(a: float) -> float:
    """Halves go away from zero, as in SQL."""
    return math.copysign(math.floor(abs(a) + 0.5), a)


_FUNCTIONS: Final[dict[str, Callable[..., Any]]] = {
    "=": operator.eq,
    "<>": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": _divided,
    "%": _remainder,
    "negative": operator.neg,
    "abs": abs,
    "sqrt": _root,
    "floor": math.floor,
    "ceil": math.ceil,
    "round": _rounded,
    "min": min,
    "max": max,
    "lower": str.lower,
    "upper": str.upper,
    "STARTS WITH": str.startswith,
    "ENDS WITH": str.endswith,
    "CONTAINS": operator.contains,
}


# Conditions asked of many nodes at once: what :mod:`sgstore.lang._evaluate` asks of one after the other ----
# Numbers of a node, and of a pair of it and one that is bound already, are columns over all nodes that it may
# be; a condition on them is a few operations on arrays. Answers are the same, to the last bit. What is told by
# something else than numbers (texts, blocks, edges) is not asked here.

MOST: Final = 2.0**53
"""Whole numbers up to here are the same as floats."""


class NodeColumns:
    """The nodes of one graph that a variable may be.

    Parameters
    ----------
    view : FrameView
    kinds : Kinds

    Attributes
    ----------
    nodes : list of int
    """

    def __init__(self, view: FrameView, kinds: b.Kinds) -> None:
        known = (node for kind in kinds.every for node in view.by_kind.get(kind, ()))
        self.nodes = [node for node in known if view.is_one(node, kinds)]
        self._rows = [view.rows.get(node, -1) for node in self.nodes]
        self._columns: dict[object, Floats] = {}

    # The view is not kept, for it keeps the crowd: what refers to one another is freed late.

    def attribute(self, view: FrameView, name: str) -> Floats:
        """(N,) an attribute that is a number, or true or false; NaN where it is not known."""
        column = self._columns.get(name)
        if column is None:
            nodes = view.nodes
            told = [nodes[node].get(name, math.nan) for node in self.nodes]
            column = np.array([math.nan if v is None else v for v in told], np.float64)
            self._columns[name] = column
        return column

    def pair(self, view: FrameView, name: str, one: int, *, ahead: bool) -> Floats:
        """(N,) a number of a node and each of these, or, unless ``ahead``, of each of these and the node."""
        key = name, one, ahead
        column = self._columns.get(key)
        if column is None:
            values = view.pairs(name, one, ahead=ahead)
            column = self._columns[key] = np.append(values, math.nan)[self._rows]
        return column


def crowd(view: FrameView, kinds: b.Kinds) -> NodeColumns:
    """The nodes of a graph that are of some kinds, put together once."""
    found = view.crowds.get(kinds)
    if found is None:
        found = view.crowds[kinds] = NodeColumns(view, kinds)
    return found


@dataclass(frozen=True, slots=True)
class KnownTruth:
    """Where a condition is true and where it is false, (N,) or of all the same; it is unknown elsewhere."""

    true: Any
    false: Any


T = TypeVar("T")

Numbers = Callable[[Binding, NodeColumns], Any]
"""(N,) numbers, or one that is the same for all; NaN where they are not known."""

Condition = Callable[[Binding, NodeColumns], KnownTruth]
Test = Callable[[Binding, NodeColumns], "Bools"]


class _Alone(Exception):  # noqa: N818 - no error: this is asked of one node after the other
    pass


def crowd_test(condition: b.Bound, key: str) -> Test | None:
    """Where a condition is true, for all that one variable may be, the others being bound.

    Parameters
    ----------
    condition : Bound
    key : str
        The variable.

    Returns
    -------
    function or None
        (N,) bool of a binding and a crowd; ``None``: it is to be asked of one node after the other.
    """
    try:
        asked = _condition(condition, key)
    except _Alone:
        return None

    def test(at: Binding, among: NodeColumns) -> Bools:
        with np.errstate(all="ignore"):
            return np.broadcast_to(asked(at, among).true, len(among.nodes))

    return test


def _always(value: T) -> Callable[[Binding, NodeColumns], T]:
    def same(_at: Binding, _among: NodeColumns) -> T:
        return value

    return same


# Conditions --------------------------------------------------------------------------------------------------


def _condition(condition: b.Bound, key: str) -> Condition:
    match condition:
        case b.Value(value=value) if value is None or isinstance(value, bool):
            return _always(KnownTruth(value is True, value is False))
        case b.Operation(word=word, operands=operands) if word in _COLUMN_LOGIC:
            parts, combine = [_condition(part, key) for part in operands], _COLUMN_LOGIC[word]
            return lambda at, among: combine([part(at, among) for part in parts])
        case b.Operation(word=word, operands=(left, right)) if word in _COMPARED:
            one, other, compare = _numbers(left, key), _numbers(right, key), _COMPARED[word]
            return lambda at, among: compare(one(at, among), other(at, among))
        case b.Operation(word="IS NULL" | "IS NOT NULL" as word, operands=(operand,)):
            return _null_test(_numbers(operand, key), null=word == "IS NULL")
        case b.NodeAttribute(node=node) if node == key and condition.type == Type.boolean:
            name = _plain(condition)
            return lambda at, among: _SAME(among.attribute(at.view, name), 1.0)
        case _:
            raise _Alone


def _null_test(numbers: Numbers, *, null: bool) -> Condition:
    def of_null(at: Binding, among: NodeColumns) -> KnownTruth:
        unknown = np.isnan(numbers(at, among))
        return KnownTruth(unknown, ~unknown) if null else KnownTruth(~unknown, unknown)

    return of_null


def _plain(attribute: b.NodeAttribute) -> str:
    """The name of an attribute that is told with the node."""
    about = attribute.attribute
    if (
        about.unit in {DisplayUnit.binding, DisplayUnit.role}
        or about is NODE_ATTRIBUTES["injunction"]
    ):
        raise _Alone
    return about.name


def _and_columns(parts: list[KnownTruth]) -> KnownTruth:
    true, false = parts[0].true, parts[0].false
    for part in parts[1:]:
        true, false = true & part.true, false | part.false
    return KnownTruth(true, false)


def _not_columns(parts: list[KnownTruth]) -> KnownTruth:
    return KnownTruth(parts[0].false, parts[0].true)


def _or_columns(parts: list[KnownTruth]) -> KnownTruth:
    return _not_columns([_and_columns([_not_columns([part]) for part in parts])])


def _implies_columns(parts: list[KnownTruth]) -> KnownTruth:
    return _or_columns([_not_columns(parts[:1]), parts[1]])


def _xor_columns(parts: list[KnownTruth]) -> KnownTruth:
    odd, known = parts[0].true, parts[0].true | parts[0].false
    for part in parts[1:]:
        odd, known = odd ^ part.true, known & (part.true | part.false)
    return KnownTruth(known & odd, known & (odd ^ True))


def _coalesce(parts: list[KnownTruth]) -> KnownTruth:
    found = parts[-1]
    for part in reversed(parts[:-1]):
        known = part.true | part.false
        found = KnownTruth(
            part.true | ((known ^ True) & found.true), part.false | ((known ^ True) & found.false)
        )
    return found


_COLUMN_LOGIC: Final[Mapping[str, Callable[[list[KnownTruth]], KnownTruth]]] = {
    "AND": _and_columns,
    "OR": _or_columns,
    "NOT": _not_columns,
    "XOR": _xor_columns,
    "IMPLIES": _implies_columns,
    "coalesce": _coalesce,
}


def _compared(
    true: Callable[..., Any], false: Callable[..., Any]
) -> Callable[[Any, Any], KnownTruth]:
    """A comparison and its contrary; neither is true where something is not known."""

    def compare(one: Any, other: Any) -> KnownTruth:
        known = ~(np.isnan(one) | np.isnan(other))
        return KnownTruth(true(one, other) & known, false(one, other) & known)

    return compare


_SAME: Final = _compared(np.equal, np.not_equal)
_COMPARED: Final[Mapping[str, Callable[[Any, Any], KnownTruth]]] = {
    "=": _SAME,
    "<>": _compared(np.not_equal, np.equal),
    "<": _compared(np.less, np.greater_equal),
    "<=": _compared(np.less_equal, np.greater),
    ">": _compared(np.greater, np.less_equal),
    ">=": _compared(np.greater_equal, np.less),
}


# Numbers -----------------------------------------------------------------------------------------------------


def _numbers(value: b.Bound, key: str) -> Numbers:
    match value:
        case b.Value(value=bool() | str()):
            raise _Alone
        case b.Value(value=number):
            known = math.nan if number is None else float(number)
            if abs(known) > MOST:
                raise _Alone
            return _always(known)
        case b.NodeAttribute(node=node, attribute=attribute) if attribute.type == Type.number:
            name = _plain(value)
            if node == key:
                return lambda at, among: among.attribute(at.view, name)
            return _of_others(value)
        case b.PairNumber(function=function, a=one, b=other) if function in PAIR_NUMBERS:
            if key not in {one, other}:
                return _of_others(value)
            if one == other:
                raise _Alone
            ahead = other == key
            bound = one if ahead else other
            return lambda at, among: among.pair(at.view, function, at.nodes[bound], ahead=ahead)
        case b.Operation(word=word, operands=operands) if word in _COLUMN_FUNCTIONS:
            parts, function = [_numbers(part, key) for part in operands], _COLUMN_FUNCTIONS[word]
            return lambda at, among: function(*(part(at, among) for part in parts))
        case _:
            raise _Alone


def _of_others(value: b.NodeAttribute | b.PairNumber) -> Numbers:
    """A number of nodes that are bound: the same for all that are not."""
    asked = evaluator(value, _no_blocks)

    def same(at: Binding, _: NodeColumns) -> float:
        found = asked(at)
        return math.nan if found is None else float(found)

    return same


def _no_blocks(block: b.BlockValue) -> Any:
    raise TypeError(f"{block} is no number of a node")


def _divided_columns(a: Any, by: Any) -> Any:
    return np.where(np.equal(by, 0), math.nan, np.divide(a, np.where(np.equal(by, 0), 1, by)))


def _remainder_columns(a: Any, by: Any) -> Any:
    return np.where(np.equal(by, 0), math.nan, np.fmod(a, np.where(np.equal(by, 0), 1, by)))


def _rounded_columns(a: Any) -> Any:
    """Halves go away from zero, as in SQL."""
    return np.copysign(np.floor(np.abs(a) + 0.5), a)


def _least(*values: Any) -> Any:
    found = values[0]
    for value in values[1:]:
        found = np.minimum(found, value)
    return found


def _greatest(*values: Any) -> Any:
    found = values[0]
    for value in values[1:]:
        found = np.maximum(found, value)
    return found


_COLUMN_FUNCTIONS: Final[Mapping[str, Callable[..., Any]]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": _divided_columns,
    "%": _remainder_columns,
    "negative": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": _rounded_columns,
    "min": _least,
    "max": _greatest,
}
