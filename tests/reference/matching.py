"""A pattern searched for in one graph after the other, in memory: what SQL is tested against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sgstore.lang.ir import Node
from sgstore.lang.memory import Binding, ScopeSearch
from sgstore.lang.sql import Layout
from sgstore.lang.sql._subgraphs import graph_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sgstore.lang.ir import Edge, Query
    from sgstore.lang.memory import FrameView
    from sgstore.lang.sql._subgraphs import Record


@dataclass(frozen=True, slots=True)
class PatternMatch:
    """One match of a pattern.

    Attributes
    ----------
    nodes : mapping of str to int
        Node ids by the names of the variables.
    edges : mapping of str to str
        Relations by the names of the edge variables.
    """

    nodes: Mapping[str, int]
    edges: Mapping[str, str]


class Matcher:
    """A pattern, ready to be searched for in one graph after the other.

    Parameters
    ----------
    query : Query
        As bound .
    """

    def __init__(self, query: Query) -> None:
        self._query, scope = query, query.scope
        self._search = ScopeSearch(scope, injective=query.injective)
        self._names = [key for key, node in scope.nodes.items() if node.role == "named"]
        self._edges = [edge.key for edge in scope.edges if edge.named]

    def matches(self, view: FrameView) -> Iterator[PatternMatch]:
        """Every match in a graph, each once."""
        at = Binding(view)
        seen: set[tuple[object, ...]] = set()
        for _ in self._search.run(at):
            nodes = {name: at.nodes[name] for name in self._names}
            edges = {name: at.edges[name][0] for name in self._edges}
            key = (*nodes.values(), *edges.values())
            if key not in seen:  # unnamed nodes make no new match
                seen.add(key)
                yield PatternMatch(nodes, edges)

    def graphs(self, view: FrameView) -> Iterator[tuple[list[Record], list[Record]]]:
        """Each match as the nodes and edges that it binds."""
        layout = Layout.of(self._query)
        scope, at = layout.query.scope, Binding(view)
        seen: set[tuple[object, ...]] = set()
        for _ in ScopeSearch(scope, injective=self._query.injective).run(at):
            single = [edge for edge in scope.edges if edge.high == 1]
            key = (*(at.nodes[n] for n in scope.nodes), *(at.edges[e.key][0] for e in single))
            if key not in seen:
                seen.add(key)
                yield _graph(layout, at)

    def holds(self, view: FrameView) -> bool:
        """Tell whether there is a match in a graph."""
        return any(True for _ in self._search.run(Binding(view)))


def _graph(layout: Layout, at: Binding) -> tuple[list[Record], list[Record]]:
    """The graph of a match: what is known of its nodes and edges."""
    parts: list[tuple[Node | Edge, Record]] = []
    for place in layout.places:
        key, part = place.part.key, place.part
        if isinstance(part, Node):
            node = at.nodes[key]
            about: Mapping[str, Any] = {"id": node, **at.view.nodes[node]}
        else:
            relation, attributes = at.edges.get(key, ("", {}))
            about = {"relation": relation, **attributes}
        parts.append((part, {name: about[name] for name in place.names if name in about}))
    return graph_of(parts)
