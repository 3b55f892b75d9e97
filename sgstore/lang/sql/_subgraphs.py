"""Results of ``RETURN SUBGRAPHS``: each match as a graph of nodes and edges.

Each match is a small graph, built from the columns of one statement. It contains the nodes bound by the
pattern, named or not, with all known attributes, and the edges of the pattern. A path of exactly n edges is
shown edge by edge. A path of m to n edges is shown as one edge from end to end, with a relation such as
``isIn*1..3``. An undirected edge has the direction in which it is written, and a mark ``either_way``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.catalog import EDGE_ATTRIBUTES, NODE_ATTRIBUTES, Attribute, Catalog
from sgstore.lang.ir import (
    FRAME_COLUMNS,
    Edge,
    EdgeAttribute,
    EdgeRelation,
    Node,
    NodeAttribute,
    NodeValue,
    Query,
    Result,
    ReturnColumn,
    Scope,
    any_relation,
)
from sgstore.lang.sql._rewrite import unfold_paths

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence


Record = dict[str, Any]
"""Node or edge in the node-link form of networkx."""

COLUMNS: Final = ("nodes", "edges")
"""Columns of the result with the graph of each match: lists of :data:`Record`."""

_TWICE: Final = frozenset({"id", "type"})
"""Attributes that a record already has, in part under other names (``type_name``, ``lane_type``)."""


@dataclass(frozen=True, slots=True)
class _ValuePlace:
    """Node or edge of a pattern, and the positions of its values in an SQL row."""

    part: Node | Edge
    first: int
    names: tuple[str, ...]

    def known(self, row: Sequence[Any]) -> Record:
        """Return the values of this node or edge in an SQL row, except NULL."""
        values = zip(self.names, row[self.first :], strict=False)
        return {name: value for name, value in values if value is not None}


@dataclass(frozen=True, slots=True)
class Layout:
    """Query for ``RETURN SUBGRAPHS``, and the positions of the graph values in its rows.

    Attributes
    ----------
    query : Query
        Bound query. It returns frames with values, one row for each match.
    columns : tuple of str
        Names of the columns of :meth:`row`.
    places : tuple of _ValuePlace
        Columns of each node and edge in a row of the query.
    """

    query: Query
    columns: tuple[str, ...]
    places: tuple[_ValuePlace, ...]
    _width: int

    @classmethod
    def of(cls, query: Query) -> Layout:
        """Return a query for subgraphs, and the positions of the graph values in its rows.

        The query's own columns stay first.
        """
        scope = _bound_variables(query)
        result = query.result
        kept = result.form == "subgraphs" or result.whole
        own = result.columns if kept else ()
        columns, places = list(own), list[_ValuePlace]()
        for part in (*scope.nodes.values(), *scope.edges):
            if isinstance(part, Edge) and part.high > 1:
                places.append(_ValuePlace(part, 0, ()))
                continue
            known = _of_node(part) if isinstance(part, Node) else _of_edge(part)
            first = len(FRAME_COLUMNS) + len(columns)
            places.append(_ValuePlace(part, first, tuple(name for name, _ in known)))
            columns += [ReturnColumn(f":{part.key}.{name}", value) for name, value in known]
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
        """Convert an SQL row to a result row: the returned values, then nodes and edges of the subgraph."""
        bound = {place.part.key: place.known(row) for place in self.places}
        parts = [(place.part, bound[place.part.key]) for place in self.places]
        return (*row[: self._width], *graph_of(parts))


def _bound_variables(query: Query) -> Scope:
    """Return a pattern that reports all nodes and all edges, except paths of variable length."""
    scope = unfold_paths(query.scope, Catalog(), injective=query.injective)
    nodes = {
        key: replace(node, role="unnamed") if node.role == "hidden" else node
        for key, node in scope.nodes.items()
    }
    edges = tuple(replace(edge, named=True) if edge.high == 1 else edge for edge in scope.edges)
    return replace(scope, nodes=nodes, edges=edges)


def graph_of(parts: Sequence[tuple[Node | Edge, Record]]) -> tuple[list[Record], list[Record]]:
    """Return the nodes and edges of a match as dictionaries, in the order of the pattern.

    Parameters
    ----------
    parts : sequence of (Node or Edge, dict)
        All nodes of the pattern with their known attributes, including ``id``; then the edges, with
        ``relation`` and attributes.

    Returns
    -------
    nodes : list of dict
        ``id``, ``variables`` (names in the pattern), and attributes. A node bound to several variables occurs
        once.
    edges : list of dict
        ``source`` and ``target`` (ids), ``relation``, and attributes; ``either_way`` for an undirected edge.
        An edge that occurs twice in the pattern is listed once.
    """
    ids: dict[str, int] = {}
    nodes: dict[int, Record] = {}
    edges: dict[tuple[Any, ...], Record] = {}
    for part, known in parts:
        if isinstance(part, Node):
            if "id" not in known:  # of an OPTIONAL MATCH
                continue
            node = ids[part.key] = known["id"]
            record = nodes.setdefault(node, {"id": node, "variables": [], **known})
            record["variables"] += [part.key] if part.role == "named" else []
            continue
        if part.src not in ids or part.dst not in ids or (part.high == 1 and not known):
            continue
        ends: Record = {"source": ids[part.src], "target": ids[part.dst]}
        record = ends | {"relation": path_text(part)} | known
        record |= {"either_way": True} if part.both else {}
        edges[(*ends.values(), record["relation"], part.both)] = record
    return list(nodes.values()), list(edges.values())


def path_text(edge: Edge) -> str:
    """Return a path of edges as text, such as ``isIn*1..3`` or ``*2..4``."""
    relations = "|".join(sorted(edge.relations)) if edge.relations != any_relation() else ""
    return f"{relations}*{edge.low}..{edge.high}"


def _of_node(node: Node) -> list[tuple[str, NodeValue | NodeAttribute]]:
    """Return (name, expression) for the id and each attribute that a pattern node can have."""
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
    """Yield the attributes that an edge of a pattern can have."""
    if edge.high > 1 or len(edge.relations) > 1:
        return
    for attribute in EDGE_ATTRIBUTES.values():
        gap = attribute.name == "gap"
        if gap and edge.relations <= {"leads", "follows"} and not edge.both:
            yield attribute
        if not gap and edge.relations == frozenset({"isIn"}):
            yield attribute


def graph_text(
    nodes: Sequence[Mapping[str, Any]], edges: Sequence[Mapping[str, Any]]
) -> tuple[str, str]:
    """Return the nodes and edges of a graph as text, such as ``e = car 0`` and ``car 0 -near-> car 3``."""
    called = {node["id"]: str(node.get("name", node["id"])) for node in nodes}
    named = (" = ".join([*node["variables"], called[node["id"]]]) for node in nodes)
    lines = (
        f"{called[edge['source']]} -{edge['relation']}-{'>' * ('either_way' not in edge)} "
        f"{called[edge['target']]}"
        for edge in edges
    )
    return ", ".join(named), ", ".join(lines)
