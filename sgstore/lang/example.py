"""A frame as example: the text of a pattern that describes what is around its ego, and so matches that frame.

It says where the ego is, and of the traffic that a relation joins with it, how many there are at least of
each kind in each place: seen from the ego, and in lanes that are its own, beside it, or against it. Each of
these is a block of its own, so that the pattern stays cheap however much there is around.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryError
from sgstore.vocabulary import (
    ENTITY_KINDS,
    RELATIONS,
    kinds_labelled,
    relation_named,
    suggestion,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.graph import SceneGraph

_SCENERY: Final = frozenset({"building", "pole", "barrier", "vegetation"})
"""Kinds that are no traffic."""

_LANES: Final = {
    "same": "EXISTS {{({0})-[:isIn]->(:Lane)<-[:isIn]-(ego)}}",
    "laneChange": "EXISTS {{({0})-[:isIn]->(:Lane)-[:laneChange]-(:Lane)<-[:isIn]-(ego)}}",
    "opposes": "EXISTS {{({0})-[:isIn]->(:Lane)-[:opposes]-(:Lane)<-[:isIn]-(ego)}}",
}
"""How the lanes of an entity lie to those of the ego: by a relation between them, or the same one."""

_PLACES: Final = ("crosswalk", "off_road")
"""Kinds of places that an entity may be in, beside lanes."""


def pattern_of(graph: SceneGraph, ignored: Sequence[str] = ()) -> str:
    """The text of a pattern that describes a scene graph around its ego, and matches it.

    Parameters
    ----------
    graph : SceneGraph
    ignored : sequence of str
        Relations, and kinds or words for several kinds, that the pattern leaves out.

    Raises
    ------
    QueryError
        The frame has no ego, or nothing is called as what is to be ignored.
    """
    if graph.ego is None or graph.ego not in graph.nodes:
        raise QueryError("the frame has no ego, so nothing is around it")
    around = _Around(graph, graph.ego, *_left(ignored))
    facts = list(around.of_ego())
    groups = Counter(text for text in map(around.block, around.others()) if text)
    for text, number in groups.items():
        facts.append(f"EXISTS {text}" if number == 1 else f"COUNT {text} >= {number}")
    head = f"MATCH (ego:{_label(graph.nodes[graph.ego]['kind'])}&Ego)"
    return head + ("\nWHERE " + "\n  AND ".join(facts) if facts else "")


def _left(ignored: Sequence[str]) -> tuple[frozenset[str], frozenset[str]]:
    """The relations and kinds that are left."""
    relations, kinds = set(RELATIONS), {*ENTITY_KINDS, "lane", *_PLACES} - _SCENERY
    for name in ignored:
        relation, several = relation_named(name), kinds_labelled(name)
        if relation is None and several is None:
            like = suggestion(name, [*RELATIONS, *ENTITY_KINDS])
            hint = f"did you mean '{like}'?" if like else "expected a kind or a relation"
            raise QueryError(f"nothing to ignore is called '{name}'", hint=hint)
        relations -= {relation}
        kinds -= set(several or ())
    return frozenset(relations), frozenset(kinds)


class _Around:
    """What there is around the ego of a graph."""

    def __init__(
        self, graph: SceneGraph, ego: int, relations: frozenset[str], kinds: frozenset[str]
    ) -> None:
        self._graph, self._ego, self._kinds = graph, ego, kinds
        self._relations = relations
        self._edges = {
            (src, relation, dst) for src, relation, dst, _ in graph.edges if relation in relations
        }
        self._beside: dict[tuple[int, int], set[str]] = {}
        for src, relation, dst in self._edges:
            if src < 0 and dst < 0 and relation in _LANES:
                for ends in ((src, dst), (dst, src)):
                    self._beside.setdefault(ends, set()).add(relation)
        self._in: dict[int, set[int]] = {}
        for src, relation, dst in self._edges:
            if relation == "isIn" and src >= 0:
                self._in.setdefault(src, set()).add(dst)

    def of_ego(self) -> Iterator[str]:
        """Where the ego is."""
        yield from self._places("ego", self._ego)

    def others(self) -> list[int]:
        """The traffic that a relation joins with the ego."""
        ends = {src for src, _, dst in self._edges if dst == self._ego and src >= 0}
        return [n for n in self._graph.nodes if n in ends and self._kind(n) in self._kinds]

    def block(self, node: int) -> str:
        """An entity as a block: its kind, its relations to the ego, and the lanes and places it is in."""
        relations = [r for r in RELATIONS if (node, r, self._ego) in self._edges]
        first, *more = relations
        paths = [f"(x:{_label(self._kind(node))}&!Ego)-[:{first}]->(ego)"]
        paths += [f"(x)-[:{relation}]->(ego)" for relation in more]
        facts = [*self._lanes(node), *self._places("x", node)]
        where = f" WHERE {' AND '.join(facts)}" if facts else ""
        return "{" + ", ".join(paths) + where + "}"

    def _lanes(self, node: int) -> Iterator[str]:
        if "lane" not in self._kinds:
            return
        mine, own = self._lanes_of(node), self._lanes_of(self._ego)
        found = {"same"} if mine & own else set[str]()
        found |= {r for a in mine for b in own for r in self._beside.get((a, b), ())}
        yield from (text.format("x") for name, text in _LANES.items() if name in found)

    def _lanes_of(self, node: int) -> set[int]:
        return {place for place in self._in.get(node, ()) if self._kind(place) == "lane"}

    def _places(self, name: str, node: int) -> Iterator[str]:
        kinds = {self._kind(place) for place in self._in.get(node, ())}
        for kind in _PLACES:
            if kind in kinds & self._kinds:
                yield f"EXISTS {{({name})-[:isIn]->(:{_label(kind)})}}"

    def _kind(self, node: int) -> str:
        return self._graph.nodes[node]["kind"]


def _label(kind: str) -> str:
    return "".join(part.capitalize() for part in kind.split("_"))
