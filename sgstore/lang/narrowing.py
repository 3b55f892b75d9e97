"""What conditions say of kinds of nodes: numbers of pairs are of entities, and what is compared is known."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang.bound import Bound, Operation, PairNumber, Scope
from sgstore.vocabulary import ENTITY_KINDS

if TYPE_CHECKING:
    from collections.abc import Iterator

_ENTITIES: Final = frozenset(ENTITY_KINDS)
_COMPARED: Final = frozenset({"=", "<>", "<", "<=", ">", ">="})
_STRICT: Final = frozenset(
    {"+", "-", "*", "/", "%", "negative", "abs", "sqrt", "floor", "ceil", "round", "min", "max"}
)
"""Operations that are unknown where one operand is."""


def entities_of_pairs(scope: Scope) -> Scope:
    """Nodes whose pair is compared are entities: of others the number is unknown, and a comparison never true.

    Else a node without a label would be tried with every part of the map around.
    """
    nodes = dict(scope.nodes)
    for condition in scope.where:
        if isinstance(condition, Operation) and condition.word in _COMPARED:
            for pair in (p for operand in condition.operands for p in _needed(operand)):
                for key in {pair.a, pair.b} & set(nodes):
                    nodes[key] = replace(nodes[key], kinds=nodes[key].kinds.only(_ENTITIES))
    return replace(scope, nodes=nodes)


def _needed(expression: Bound) -> Iterator[PairNumber]:
    """The numbers of pairs without which an expression is unknown."""
    match expression:
        case PairNumber():
            yield expression
        case Operation(word=word, operands=operands) if word in _STRICT:
            for operand in operands:
                yield from _needed(operand)
        case _:
            pass
