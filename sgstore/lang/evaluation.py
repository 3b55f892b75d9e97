"""Bound expressions as Python functions: the value of an expression for one binding of one graph in memory.

The same meaning as :mod:`sgstore.lang.sql` gives them in a store: ``None`` is NULL, and logic has three values.
"""

from __future__ import annotations

import math
import operator
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.geometry import pair_numbers
from sgstore.lang import bound as b
from sgstore.lang.catalog import NODE_ATTRIBUTES, Unit
from sgstore.lang.pairs import WAY
from sgstore.vocabulary import MAP_KINDS

if TYPE_CHECKING:
    from sgstore.geometry import PairNumbers
    from sgstore.graph import SceneGraph
    from sgstore.lang.crowds import Crowd
    from sgstore.world import Floats

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
    def crowds(self) -> dict[b.Kinds, Crowd]:
        """Nodes of some kinds with their numbers, kept by :mod:`sgstore.lang.crowds`."""
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
            if attribute.unit is Unit.binding:
                return lambda at: at.nodes[node]
            if attribute.unit is Unit.role:
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
        case b.FrameAttribute(attribute=attribute) if attribute.unit is Unit.classed:
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
        case b.Choices() | b.Aggregate() | b.Tense() | b.Course() | b.Moment():
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
