"""``RETURN SUBGRAPHS``: each match as a small graph, from the columns of one statement.

The graph of a match has the nodes that the pattern binds, those without a name too, with all that is known of
them, and the edges that it asks for. A path of exactly n edges is there edge by edge; one of m to n edges is
one edge from end to end, whose relation is written ``isIn*1..3``. An edge that was asked for either way runs as
it is written, and says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.bound import (
    ANY_RELATION,
    FRAME_COLUMNS,
    Column,
    Edge,
    EdgeAttribute,
    EdgeRelation,
    Node,
    NodeAttribute,
    NodeValue,
    Query,
    Result,
    Scope,
)
from sgstore.lang.catalog import EDGE_ATTRIBUTES, NODE_ATTRIBUTES, Attribute, Catalog
from sgstore.lang.rewrite import unfold_paths

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

Record = dict[str, Any]
"""A node or an edge as networkx has it in node-link form."""

COLUMNS: Final = ("nodes", "edges")
"""Columns of a graph in a row: lists of :data:`Record`."""

_TWICE: Final = frozenset({"id", "type"})
"""Attributes that are there already, or under their own names (``type_name``, ``lane_type``)."""


@dataclass(frozen=True, slots=True)
class _Place:
    """A node or an edge of the pattern, and where its values stand in a row."""

    part: Node | Edge
    first: int
    names: tuple[str, ...]

    def known(self, row: Sequence[Any]) -> Record:
        """What is known of it: the values that are not missing."""
        values = zip(self.names, row[self.first :], strict=False)
        return {name: value for name, value in values if value is not None}


@dataclass(frozen=True, slots=True)
class Layout:
    """A query whose rows hold all that the graphs of its matches are made of.

    Attributes
    ----------
    query : Query
        As bound; it returns frames with values, and each match is one row.
    columns : tuple of str
        Names of the columns of :meth:`row`.
    """

    query: Query
    columns: tuple[str, ...]
    _places: tuple[_Place, ...]
    _width: int

    @classmethod
    def of(cls, query: Query) -> Layout:
        """How the graphs of the matches of a query are had; what it returns beside them is kept."""
        scope = _bound(query)
        result = query.result
        kept = result.form == "subgraphs" or result.whole
        own = result.columns if kept else ()
        columns, places = list(own), list[_Place]()
        for part in (*scope.nodes.values(), *scope.edges):
            if isinstance(part, Edge) and part.high > 1:
                places.append(_Place(part, 0, ()))
                continue
            known = _of_node(part) if isinstance(part, Node) else _of_edge(part)
            first = len(FRAME_COLUMNS) + len(columns)
            places.append(_Place(part, first, tuple(name for name, _ in known)))
            columns += [Column(f":{part.key}.{name}", value) for name, value in known]
        framed = replace(
            result if kept else Result(),
            form="rows",
            columns=tuple(columns),
            whole=False,
            framed=True,
        )
        names = (*FRAME_COLUMNS, *(column.name for column in own), *COLUMNS)
        width = len(FRAME_COLUMNS) + len(own)
        return cls(replace(query, scope=scope, result=framed), names, tuple(places), width)

    def row(self, row: Sequence[Any]) -> tuple[Any, ...]:
        """A row of the query as a row with a graph."""
        bound = {place.part.key: place.known(row) for place in self._places}
        parts = [(place.part, bound[place.part.key]) for place in self._places]
        return (*row[: self._width], *graph_of(parts))

    def graph(
        self,
        nodes: Mapping[str, int],
        edges: Mapping[str, tuple[str, Mapping[str, Any]]],
        known: Mapping[int, Mapping[str, Any]],
    ) -> tuple[list[Record], list[Record]]:
        """The graph of a match that was found in memory.

        Parameters
        ----------
        nodes : mapping of str to int
            Ids by key.
        edges : mapping of str to (str, mapping)
            Relation and attributes by key.
        known : mapping of int to mapping
            Attributes of the nodes of the frame.
        """
        parts: list[tuple[Node | Edge, Record]] = []
        for place in self._places:
            key, part = place.part.key, place.part
            if isinstance(part, Node):
                about: Mapping[str, Any] = {"id": nodes[key], **known[nodes[key]]}
            else:
                relation, attributes = edges.get(key, ("", {}))
                about = {"relation": relation, **attributes}
            parts.append((part, {name: about[name] for name in place.names if name in about}))
        return graph_of(parts)


def _bound(query: Query) -> Scope:
    """The pattern with all its nodes and single edges bound, those of a path of exactly n edges too."""
    scope = unfold_paths(query, Catalog()).scope
    nodes = {
        key: replace(node, role="unnamed") if node.role == "hidden" else node
        for key, node in scope.nodes.items()
    }
    edges = tuple(replace(edge, named=True) if edge.high == 1 else edge for edge in scope.edges)
    return replace(scope, nodes=nodes, edges=edges)


def graph_of(parts: Sequence[tuple[Node | Edge, Record]]) -> tuple[list[Record], list[Record]]:
    """Nodes and edges of a match, in the order of the pattern.

    Parameters
    ----------
    parts : sequence of (Node or Edge, dict)
        All nodes of the pattern with what is known of each, its ``id`` too; then the edges, with ``relation``
        and attributes.

    Returns
    -------
    nodes : list of dict
        ``id``, ``variables`` (names in the pattern), and attributes. A node that several variables mean is
        there once.
    edges : list of dict
        ``source`` and ``target`` (ids), ``relation``, and attributes; ``either_way`` where the pattern leaves
        the direction open. An edge that the pattern asks for twice is there once.
    """
    ids: dict[str, int] = {}
    nodes: dict[int, Record] = {}
    edges: dict[tuple[Any, ...], Record] = {}
    for part, known in parts:
        if isinstance(part, Node):
            node = ids[part.key] = known["id"]
            record = nodes.setdefault(node, {"id": node, "variables": [], **known})
            record["variables"] += [part.key] if part.role == "named" else []
            continue
        ends: Record = {"source": ids[part.src], "target": ids[part.dst]}
        record = ends | {"relation": path_text(part)} | known
        record |= {"either_way": True} if part.both else {}
        edges[(*ends.values(), record["relation"], part.both)] = record
    return list(nodes.values()), list(edges.values())


def path_text(edge: Edge) -> str:
    """What a path of edges is called: ``isIn*1..3``, ``*2..4``."""
    relations = "|".join(sorted(edge.relations)) if edge.relations != ANY_RELATION else ""
    return f"{relations}*{edge.low}..{edge.high}"


def _of_node(node: Node) -> list[tuple[str, NodeValue | NodeAttribute]]:
    """The id of a node, and the attributes that it can have."""
    known: list[tuple[str, NodeValue | NodeAttribute]] = [("id", NodeValue(node.key))]
    return known + [
        (attribute.name, NodeAttribute(node.key, attribute, attribute.type))
        for attribute in NODE_ATTRIBUTES.values()
        if attribute.kinds & node.kinds.every and attribute.name not in _TWICE
    ]


def _of_edge(edge: Edge) -> list[tuple[str, EdgeRelation | EdgeAttribute]]:
    known: list[tuple[str, EdgeRelation | EdgeAttribute]] = [("relation", EdgeRelation(edge.key))]
    return known + [
        (attribute.name, EdgeAttribute(edge.key, attribute, attribute.type))
        for attribute in edge_attributes(edge)
    ]


def edge_attributes(edge: Edge) -> Iterator[Attribute]:
    """The attributes that an edge of a pattern can be asked for."""
    if edge.high > 1 or len(edge.relations) > 1:
        return
    for attribute in EDGE_ATTRIBUTES.values():
        gap = attribute.name == "gap"
        if gap and edge.relations <= {"leads", "follows"} and not edge.both:
            yield attribute
        if not gap and edge.relations == frozenset({"isIn"}):
            yield attribute


def shown(
    nodes: Sequence[Mapping[str, Any]], edges: Sequence[Mapping[str, Any]]
) -> tuple[str, str]:
    """Nodes and edges of a graph as texts for people: ``e = car 0, v = car 3``, ``car 0 -near-> car 3``."""
    called = {node["id"]: str(node.get("name", node["id"])) for node in nodes}
    named = (" = ".join([*node["variables"], called[node["id"]]]) for node in nodes)
    lines = (
        f"{called[edge['source']]} -{edge['relation']}-{'>' * ('either_way' not in edge)} "
        f"{called[edge['target']]}"
        for edge in edges
    )
    return ", ".join(named), ", ".join(lines)
