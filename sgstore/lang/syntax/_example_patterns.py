"""Query patterns generated from an example frame. They describe the surroundings of the ego.

The pattern describes the place of the ego and the traffic related to it: the minimum number of entities of
each kind at each place. The place is relative to the ego and to its lane, the neighbouring lanes and the
opposing lanes. Each group is its own block, so the pattern stays fast in dense traffic.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryError
from sgstore.model.vocabulary import (
    ENTITY_KINDS,
    RELATIONS,
    SUPER_KINDS,
    kinds_labelled,
    relation_named,
    suggestion,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.model.graph import SceneGraph

_SCENERY: Final = frozenset({"building", "pole", "barrier", "vegetation"})
"""Node kinds that are scenery, not traffic."""

_LANES: Final = {
    "same": "EXISTS {{({0})-[:isIn]->(:Lane)<-[:isIn]-(ego)}}",
    "laneChange": "EXISTS {{({0})-[:isIn]->(:Lane)-[:laneChange]-(:Lane)<-[:isIn]-(ego)}}",
    "opposes": "EXISTS {{({0})-[:isIn]->(:Lane)-[:opposes]-(:Lane)<-[:isIn]-(ego)}}",
}
"""Relations between the lane of an entity and the lane of the ego."""

_PLACES: Final = ("crosswalk", "off_road")
"""Kinds of places that an entity may be in, apart from lanes."""


def pattern_of(graph: SceneGraph, ignored: Sequence[str] = ()) -> str:
    """Return a query pattern that describes the surroundings of the ego in a scene graph.

    It matches that graph.

    Parameters
    ----------
    graph : SceneGraph
    ignored : sequence of str
        Relations, kinds, or labels for several kinds, that the pattern omits.

    Raises
    ------
    QueryError
        The frame has no ego, or an ignored name is unknown.
    """
    if graph.ego is None or graph.ego not in graph.nodes:
        raise QueryError("the frame has no ego; choose a frame with an ego")
    around = _Around(graph, graph.ego, *_left(ignored))
    facts = list(around.of_ego())
    groups = Counter(text for text in map(around.block, around.others()) if text)
    for text, number in groups.items():
        facts.append(f"EXISTS {text}" if number == 1 else f"COUNT {text} >= {number}")
    head = f"MATCH {node_of_kind(graph.nodes[graph.ego]['kind'], 'ego', 'Ego')}"
    return head + ("\nWHERE " + "\n  AND ".join(facts) if facts else "")


def _left(ignored: Sequence[str]) -> tuple[frozenset[str], frozenset[str]]:
    """Return all relations and node kinds, except the ignored ones."""
    relations, kinds = set(RELATIONS), {*ENTITY_KINDS, "lane", *_PLACES} - _SCENERY
    for name in ignored:
        relation, several = relation_named(name), kinds_labelled(name)
        if relation is None and several is None:
            like = suggestion(name, [*RELATIONS, *ENTITY_KINDS])
            hint = f"did you mean '{like}'?" if like else "expected a kind or a relation"
            raise QueryError(f"unknown kind or relation '{name}' to ignore", hint=hint)
        relations -= {relation}
        kinds -= set(several or ())
    return frozenset(relations), frozenset(kinds)


class _Around:
    """Surroundings of the ego in the scene graph of an example frame."""

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
        """Yield conditions on the ego's place, as query text."""
        yield from self._places("ego", self._ego)

    def others(self) -> list[int]:
        """Return the ids of the entities that have a relation to the ego."""
        ends = {src for src, _, dst in self._edges if dst == self._ego and src >= 0}
        return [n for n in self._graph.nodes if n in ends and self._kind(n) in self._kinds]

    def block(self, node: int) -> str:
        """Return a pattern in braces that describes an entity: kind, relations to the ego, lanes, places."""
        relations = [r for r in RELATIONS if (node, r, self._ego) in self._edges]
        first, *more = relations
        paths = [f"{node_of_kind(self._kind(node), 'x')}-[:{first}]->(ego)"]
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
                yield f"EXISTS {{({name})-[:isIn]->(:{_label_of_example(kind)})}}"

    def _kind(self, node: int) -> str:
        return self._graph.nodes[node]["kind"]


def node_of_kind(kind: str, name: str = "", mark: str = "!Ego") -> str:
    """Return the query text of a node of one kind, such as ``(x:Car&!Ego)``.

    ``mark`` includes or excludes the ego.

    A label for several kinds, such as ``Vehicle``, also needs the kind as a property.
    """
    exact = f" {{kind: '{kind}'}}" if kind in SUPER_KINDS else ""
    return f"({name}:{_label_of_example(kind)}&{mark}{exact})"


def _label_of_example(kind: str) -> str:
    return "".join(part.capitalize() for part in kind.split("_"))
