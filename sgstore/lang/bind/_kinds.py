"""Kinds of nodes, such as car or lane: the tables that store them, and SQL that selects them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import literal
from sgstore.lang.catalog import DisplayUnit, Home
from sgstore.lang.ir import Bound, Operation, PairNumber, Scope, any_relation
from sgstore.lang.operators import COMPARISONS, OPERATORS
from sgstore.model.pair_numbers import PART_DIST
from sgstore.model.vocabulary import KINDS, RELATIONS, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.lang.catalog import Attribute, Catalog
    from sgstore.lang.ir import Edge, Kinds


_FEW: Final = 4
"""Longest ``IN`` list that DuckDB compares word by word. It turns longer lists into a table and joins it."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Kinds of node that a query variable can match, grouped by the table that stores such nodes."""

    moving: frozenset[str]
    fixed: frozenset[str]
    mapped: frozenset[str]

    @classmethod
    def of(cls, kinds: Kinds, catalog: Catalog) -> Profile:
        """Group some kinds of node by the table that stores such nodes.

        Unused entity kinds count as moving, other unused kinds as mapped.
        """
        moving = kinds.every & catalog.moving
        fixed, mapped = kinds.other & catalog.fixed, kinds.other & catalog.mapped
        if not moving | fixed | mapped:
            entities = entity_kinds()
            return cls(kinds.every & entities, frozenset(), kinds.every - entities)
        return cls(moving, fixed, mapped)

    @property
    def kinds(self) -> frozenset[str]:
        """All kinds of node that the query variable can match, from all tables."""
        return self.moving | self.fixed | self.mapped

    @property
    def places(self) -> int:
        """Number of tables that may store the nodes of the query variable."""
        return sum(map(bool, (self.moving, self.fixed, self.mapped)))

    def has(self, home: Home) -> bool:
        """True if a table may have values of these nodes."""
        kinds = {
            Home.state: self.moving,
            Home.entity: self.moving | self.fixed,
            Home.scenery: self.fixed,
            Home.map: self.mapped,
        }
        return bool(kinds[home])


def homes_of(attribute: Attribute, profile: Profile) -> set[Home]:
    """Return the tables to join in SQL to read an attribute of nodes of some kinds.

    The state of a moving entity is joined anyway. So a constant that states repeat is read from the state.
    """
    label = attribute.unit is DisplayUnit.label
    homes = {Home.entity, Home.map} if label else set(attribute.columns)
    if Home.state in homes and not profile.fixed:
        homes -= {Home.entity}
    return {home for home in homes if profile.has(home)}


def kind_conditions(kinds: Kinds, kind: str, ego: str | None, held: frozenset[str]) -> list[str]:
    """Return SQL conditions that select rows by the kind of a node, and by whether it is the ego.

    ``ego=None`` means that no row is the ego.

    ``held`` are all kinds in the column. A condition that all of them meet is omitted.
    """
    if ego is None:
        return _among(kinds.other, kind, held)
    if not kinds.other:
        return [ego, *_among(kinds.ego, kind, held & entity_kinds())]
    if not kinds.ego and held & entity_kinds():
        return [f"NOT {ego}", *_among(kinds.other, kind, held)]
    if kinds.ego == kinds.other & entity_kinds() or not kinds.ego:
        return _among(kinds.other, kind, held)
    one = " AND ".join([ego, *_among(kinds.ego, kind, held)])
    other = " AND ".join([f"NOT {ego}", *_among(kinds.other, kind, held)])
    return [f"({one} OR {other})"]


def _among(kinds: frozenset[str], column: str, held: frozenset[str]) -> list[str]:
    if held <= kinds:
        return []
    others = [kind for kind in KINDS if kind in held - kinds]
    return [_one_of(column, [kind for kind in KINDS if kind in kinds], others)]


def _one_of(column: str, words: list[str], others: Sequence[str] = ()) -> str:
    """Return the SQL condition that a column is one of some words.

    ``others`` are the other possible words.
    """
    if len(words) > _FEW >= len(others) > 0:
        return " AND ".join(f"{column} <> {literal(word)}" for word in others)
    if len(words) == 1:
        return f"{column} = {literal(words[0])}"
    return f"{column} IN ({', '.join(map(literal, words))})" if words else "FALSE"


def edge_conditions(
    catalog: Catalog, scope: Scope, edge: Edge, alias: str, *, moving: bool, swapped: bool = False
) -> list[str]:
    """Return SQL conditions that select rows of an edge table by relation, and by the kinds of both nodes.

    The table is ``edge`` or ``map_edge``.

    ``moving`` selects the table ``edge``. ``swapped``: the row runs from ``dst`` to ``src`` of the edge.
    """
    table = catalog.edges if moving else catalog.map_edges
    held = [triple for triple in table if triple[0] in edge.relations]
    conditions: list[str] = []
    if edge.relations != any_relation():
        relations = [relation for relation in RELATIONS if relation in edge.relations]
        conditions += [_one_of(f'{alias}."relation"', relations)]
    ends = (edge.dst, edge.src) if swapped else (edge.src, edge.dst)
    sides = [(1, "src", ends[0]), (2, "dst", ends[1])]
    # The kind of one end restricts the other end. The ego end restricts most, so it is handled first.
    for side, end, key in sorted(sides, key=lambda one: scope.kinds(one[2]).one_a_frame):
        conditions += kind_conditions(
            scope.kinds(key),
            f'{alias}."{end}_kind"',
            f'{alias}."{end}_is_ego"' if moving else None,
            frozenset(triple[side] for triple in held),
        )
        held = [triple for triple in held if triple[side] in scope.kinds(key).every]
    return conditions


def alias_of(edge: Edge) -> str:
    """Return the SQL alias of a pattern edge: the edge's key, and its relation if only one is possible."""
    return (
        f"{edge.key}:{next(iter(edge.relations))}" if len(edge.relations) == 1 else f"{edge.key}:"
    )


def entities_of_pairs(scope: Scope, _: Catalog) -> Scope:
    """Return a pattern in which each node must be an entity if a condition such as ``ttc(a, b) < 2`` uses it.

    An example is ``ttc(a, b) < 2``.

    For other kinds of nodes the number is unknown, so the comparison is never true. Without this restriction,
    a node without a label would be tried with every part of the map.
    """
    nodes = dict(scope.nodes)
    for condition in scope.where:
        if isinstance(condition, Operation) and condition.word in COMPARISONS:
            for pair in (p for operand in condition.operands for p in _needed(operand)):
                may_be = on_lanes() if pair.function == PART_DIST else entity_kinds()
                for key in {pair.a, pair.b} & set(nodes):
                    nodes[key] = replace(nodes[key], kinds=nodes[key].kinds.only(may_be))
    return replace(scope, nodes=nodes)


def on_lanes() -> frozenset[str]:
    """Return the kinds of nodes that can be located on lanes: entities, and parts of the map."""
    return entity_kinds() | _ON_LANES


_ON_LANES: Final = frozenset({"lane", "road", "junction", "roundabout", "crosswalk"})


def _needed(expression: Bound) -> Iterator[PairNumber]:
    """Yield the numbers of entity pairs, such as ``ttc(a, b)``, without which an expression has no value."""
    match expression:
        case PairNumber():
            yield expression
        case Operation(word=word, operands=operands) if OPERATORS[word].strict:
            for operand in operands:
                yield from _needed(operand)
        case _:
            pass
