"""Conditions asked of many nodes at once: what :mod:`sgstore.lang.evaluation` asks of one after the other.

Numbers of a node, and of a pair of it and one that is bound already, are columns over all nodes that it may be;
a condition on them is a few operations on arrays. Answers are the same, to the last bit. What is told by
something else than numbers (texts, blocks, edges) is not asked here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from sgstore.lang import bound as b
from sgstore.lang.catalog import NODE_ATTRIBUTES, Type, Unit
from sgstore.lang.evaluation import PAIR_NUMBERS, Binding, evaluator

if TYPE_CHECKING:
    from sgstore.lang.evaluation import FrameView
    from sgstore.world import Bools, Floats

MOST: Final = 2.0**53
"""Whole numbers up to here are the same as floats."""


class Crowd:
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


def crowd(view: FrameView, kinds: b.Kinds) -> Crowd:
    """The nodes of a graph that are of some kinds, put together once."""
    found = view.crowds.get(kinds)
    if found is None:
        found = view.crowds[kinds] = Crowd(view, kinds)
    return found


@dataclass(frozen=True, slots=True)
class Told:
    """Where a condition is true and where it is false, (N,) or of all the same; it is unknown elsewhere."""

    true: Any
    false: Any


T = TypeVar("T")

Numbers = Callable[[Binding, Crowd], Any]
"""(N,) numbers, or one that is the same for all; NaN where they are not known."""

Condition = Callable[[Binding, Crowd], Told]
Test = Callable[[Binding, Crowd], "Bools"]


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

    def test(at: Binding, among: Crowd) -> Bools:
        with np.errstate(all="ignore"):
            return np.broadcast_to(asked(at, among).true, len(among.nodes))

    return test


def _always(value: T) -> Callable[[Binding, Crowd], T]:
    def same(_at: Binding, _among: Crowd) -> T:
        return value

    return same


# Conditions --------------------------------------------------------------------------------------------------


def _condition(condition: b.Bound, key: str) -> Condition:
    match condition:
        case b.Value(value=value) if value is None or isinstance(value, bool):
            return _always(Told(value is True, value is False))
        case b.Operation(word=word, operands=operands) if word in _LOGIC:
            parts, combine = [_condition(part, key) for part in operands], _LOGIC[word]
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
    def of_null(at: Binding, among: Crowd) -> Told:
        unknown = np.isnan(numbers(at, among))
        return Told(unknown, ~unknown) if null else Told(~unknown, unknown)

    return of_null


def _plain(attribute: b.NodeAttribute) -> str:
    """The name of an attribute that is told with the node."""
    about = attribute.attribute
    if about.unit in {Unit.binding, Unit.role} or about is NODE_ATTRIBUTES["injunction"]:
        raise _Alone
    return about.name


def _and(parts: list[Told]) -> Told:
    true, false = parts[0].true, parts[0].false
    for part in parts[1:]:
        true, false = true & part.true, false | part.false
    return Told(true, false)


def _not(parts: list[Told]) -> Told:
    return Told(parts[0].false, parts[0].true)


def _or(parts: list[Told]) -> Told:
    return _not([_and([_not([part]) for part in parts])])


def _implies(parts: list[Told]) -> Told:
    return _or([_not(parts[:1]), parts[1]])


def _xor(parts: list[Told]) -> Told:
    odd, known = parts[0].true, parts[0].true | parts[0].false
    for part in parts[1:]:
        odd, known = odd ^ part.true, known & (part.true | part.false)
    return Told(known & odd, known & (odd ^ True))


def _coalesce(parts: list[Told]) -> Told:
    found = parts[-1]
    for part in reversed(parts[:-1]):
        known = part.true | part.false
        found = Told(
            part.true | ((known ^ True) & found.true), part.false | ((known ^ True) & found.false)
        )
    return found


_LOGIC: Final[Mapping[str, Callable[[list[Told]], Told]]] = {
    "AND": _and,
    "OR": _or,
    "NOT": _not,
    "XOR": _xor,
    "IMPLIES": _implies,
    "coalesce": _coalesce,
}


def _compared(true: Callable[..., Any], false: Callable[..., Any]) -> Callable[[Any, Any], Told]:
    """A comparison and its contrary; neither is true where something is not known."""

    def compare(one: Any, other: Any) -> Told:
        known = ~(np.isnan(one) | np.isnan(other))
        return Told(true(one, other) & known, false(one, other) & known)

    return compare


_SAME: Final = _compared(np.equal, np.not_equal)
_COMPARED: Final[Mapping[str, Callable[[Any, Any], Told]]] = {
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
        case b.Operation(word=word, operands=operands) if word in _FUNCTIONS:
            parts, function = [_numbers(part, key) for part in operands], _FUNCTIONS[word]
            return lambda at, among: function(*(part(at, among) for part in parts))
        case _:
            raise _Alone


def _of_others(value: b.NodeAttribute | b.PairNumber) -> Numbers:
    """A number of nodes that are bound: the same for all that are not."""
    asked = evaluator(value, _no_blocks)

    def same(at: Binding, _: Crowd) -> float:
        found = asked(at)
        return math.nan if found is None else float(found)

    return same


def _no_blocks(block: b.BlockValue) -> Any:
    raise TypeError(f"{block} is no number of a node")


def _divided(a: Any, by: Any) -> Any:
    return np.where(np.equal(by, 0), math.nan, np.divide(a, np.where(np.equal(by, 0), 1, by)))


def _remainder(a: Any, by: Any) -> Any:
    return np.where(np.equal(by, 0), math.nan, np.fmod(a, np.where(np.equal(by, 0), 1, by)))


def _rounded(a: Any) -> Any:
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


_FUNCTIONS: Final[Mapping[str, Callable[..., Any]]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": _divided,
    "%": _remainder,
    "negative": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": _rounded,
    "min": _least,
    "max": _greatest,
}
