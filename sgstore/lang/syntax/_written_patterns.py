"""Patterns built in Python: step by step, from networkx, or from an example frame.

Each pattern is converted to query text and parameter values, so it has the meaning of that text.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final

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
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    import networkx as nx

    from sgstore.model.graph import SceneGraph


_NAME: Final = re.compile(r"[A-Za-z_]\w*")
_LABEL: Final = re.compile(r"[A-Za-z_%!(][\w%!&|() ]*")
_RESERVED: Final = frozenset({"label", "kind", "where", "relation", "name"})


@dataclass(frozen=True, slots=True)
class Pattern:
    """Query pattern that is built step by step. Each method returns a new pattern.

    ::

        crossing = (
            Pattern()
            .node("e", "Ego")
            .node("p", "Person", special="child")
            .edge("e", "near|very_near", "p")
            .where("abs(bearing(e, p)) < 45")
        )
        store.find(crossing)

    Attributes
    ----------
    parts : tuple of str
        Nodes and edges, as written after ``MATCH``.
    conditions : tuple of str
        Conditions, joined by ``AND``.
    returned : str
        Text after ``RETURN``; empty for whole matches.
    parameters : mapping
        Values of the parameters ``$name`` in the text.
    """

    parts: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()
    returned: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def node(self, name: str, label: str = "", /, **properties: Any) -> Pattern:
        """Add a node.

        Parameters
        ----------
        name : str
            Name of the variable.
        label : str
            Label such as ``Person``, ``Car|Truck``, ``Vehicle&!Ego``; empty means any node.
        **properties
            Required attribute values.

        Raises
        ------
        QueryError
            Invalid name or label.
        """
        inside = _checked(name, _NAME, "a name") + _label(label)
        parts, values = self._properties(name, properties)
        inside += f" {{{', '.join(parts)}}}" if parts else ""
        return self._with(part=f"({inside})", values=values)

    def edge(
        self,
        src: str,
        relation: str,
        dst: str,
        /,
        *,
        both: bool = False,
        times: str = "",
        name: str = "",
    ) -> Pattern:
        """Add an edge between two nodes.

        Parameters
        ----------
        src, relation, dst : str
            ``relation`` is one relation, or several as ``near|very_near``; empty means any.
        both : bool
            True if the edge may have either direction.
        times : str
            Number of edges in a row: ``2`` or ``1..3``.
        name : str
            Name of the variable; empty without one.

        Raises
        ------
        QueryError
            One of the arguments is invalid in a pattern.
        """
        ends = [_checked(end, _NAME, "a name") for end in (src, dst)]
        inside = (_checked(name, _NAME, "a name") if name else "") + _label(relation)
        inside += (
            f"*{_checked(times, re.compile(r'[0-9]+([.][.][0-9]+)?'), 'a number')}" if times else ""
        )
        return self._with(part=f"({ends[0]})-[{inside}]-{'' if both else '>'}({ends[1]})")

    def where(self, condition: str, /, **parameters: Any) -> Pattern:
        """Add a condition, as written after ``WHERE``, with the values of its parameters."""
        return self._with(condition=f"({condition})", values=parameters)

    def returns(self, what: str, /) -> Pattern:
        """Set the values to return, as written after ``RETURN``."""
        return Pattern(self.parts, self.conditions, what, self.parameters)

    def __repr__(self) -> str:
        return f"<Pattern {str(self) if self.parts else 'without nodes'!r}>"

    def __str__(self) -> str:
        """Text of the pattern."""
        if not self.parts:
            raise QueryError("the pattern is empty", hint="add a node")
        text = f"MATCH {', '.join(self.parts)}"
        text += f" WHERE {' AND '.join(self.conditions)}" if self.conditions else ""
        return text + (f" RETURN {self.returned}" if self.returned else "")

    @classmethod
    def of(cls, graph: nx.Graph[Any]) -> Pattern:
        """Return the pattern that a networkx graph represents.

        Parameters
        ----------
        graph : networkx graph, directed or not, with one or many edges between two nodes
            Attributes of a node: ``label`` (or ``kind``), ``where`` (a condition that uses names of nodes),
            and any other attribute as a required property. Attribute of an edge: ``relation`` (a text such as
            ``near|visible``, or several); without it, any relation. Edges of an undirected graph match either
            direction.

        Raises
        ------
        QueryError
            A part of the graph is invalid in a pattern.
        """
        names = {node: _name_of(node, number) for number, node in enumerate(graph.nodes)}
        pattern = cls()
        conditions: list[str] = []
        for node, attributes in graph.nodes(data=True):
            label = str(attributes.get("label") or attributes.get("kind") or "")
            properties = {k: v for k, v in attributes.items() if k not in _RESERVED}
            pattern = pattern.node(names[node], label, **properties)
            conditions += [attributes["where"]] if "where" in attributes else []
        for src, dst, attributes in graph.edges(data=True):
            relation = _relations(attributes.get("relation") or attributes.get("label") or "")
            both = not graph.is_directed()
            pattern = pattern.edge(names[src], relation, names[dst], both=both)
        for condition in conditions:
            pattern = pattern.where(condition)
        return pattern

    def _with(
        self, *, part: str = "", condition: str = "", values: Mapping[str, Any] | None = None
    ) -> Pattern:
        twice = sorted(set(values or {}) & set(self.parameters))
        if twice:
            raise QueryError(f"the pattern has a parameter '{twice[0]}' already")
        return Pattern(
            (*self.parts, part) if part else self.parts,
            (*self.conditions, condition) if condition else self.conditions,
            self.returned,
            {**self.parameters, **(values or {})},
        )

    def _properties(
        self, node: str, properties: Mapping[str, Any]
    ) -> tuple[list[str], dict[str, Any]]:
        parts: list[str] = []
        values: dict[str, Any] = {}
        for name, value in properties.items():
            key = f"{node}_{name}"
            while key in self.parameters or key in values:
                key += "_"
            parts.append(f"{_checked(name, _NAME, 'an attribute')}: ${key}")
            values[key] = value
        return parts, values


def _checked(text: str, form: re.Pattern[str], what: str) -> str:
    if not form.fullmatch(text):
        raise QueryError(f"{text!r} is not {what} that can stand in a pattern")
    return text


def _label(label: str) -> str:
    depths = list(accumulate((c == "(") - (c == ")") for c in label))
    if depths and (min(depths) < 0 or depths[-1]):
        raise QueryError(f"{label!r} is not a label that can stand in a pattern")
    return f":{_checked(label, _LABEL, 'a label')}" if label else ""


def _name_of(node: object, number: int) -> str:
    """Return the name of a node if it is a valid variable name, otherwise ``n`` and a number."""
    text = str(node)
    return text if _NAME.fullmatch(text) else f"n{number}"


def _relations(relation: str | Iterable[str]) -> str:
    return relation if isinstance(relation, str) else "|".join(relation)


# A frame as example: a pattern that describes the surroundings of its ego, and matches that frame
# ------------------------------------------------------------------------------------------------
# The pattern describes the place of the ego and the traffic related to it: the minimum number of entities of
# each kind at each place. The place is relative to the ego and to its lane, the neighbouring lanes and the
# opposing lanes. Each group is its own block, so the pattern stays fast in dense traffic.

_SCENERY: Final = frozenset({"building", "pole", "barrier", "vegetation"})
"""Kinds that are not traffic."""

_LANES: Final = {
    "same": "EXISTS {{({0})-[:isIn]->(:Lane)<-[:isIn]-(ego)}}",
    "laneChange": "EXISTS {{({0})-[:isIn]->(:Lane)-[:laneChange]-(:Lane)<-[:isIn]-(ego)}}",
    "opposes": "EXISTS {{({0})-[:isIn]->(:Lane)-[:opposes]-(:Lane)<-[:isIn]-(ego)}}",
}
"""Relations between the lane of an entity and the lane of the ego."""

_PLACES: Final = ("crosswalk", "off_road")
"""Kinds of places that an entity may be in, apart from lanes."""


def pattern_of(graph: SceneGraph, ignored: Sequence[str] = ()) -> str:
    """Return a pattern that describes a scene graph around its ego, and matches it.

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
        raise QueryError("the frame has no ego, so nothing is around it")
    around = _Around(graph, graph.ego, *_left(ignored))
    facts = list(around.of_ego())
    groups = Counter(text for text in map(around.block, around.others()) if text)
    for text, number in groups.items():
        facts.append(f"EXISTS {text}" if number == 1 else f"COUNT {text} >= {number}")
    head = f"MATCH {node_of_kind(graph.nodes[graph.ego]['kind'], 'ego', 'Ego')}"
    return head + ("\nWHERE " + "\n  AND ".join(facts) if facts else "")


def _left(ignored: Sequence[str]) -> tuple[frozenset[str], frozenset[str]]:
    """Return the relations and kinds that are not ignored."""
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
    """Neighbourhood of the ego of a graph."""

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
        """Yield conditions on the place of the ego."""
        yield from self._places("ego", self._ego)

    def others(self) -> list[int]:
        """Return the traffic with a relation to the ego."""
        ends = {src for src, _, dst in self._edges if dst == self._ego and src >= 0}
        return [n for n in self._graph.nodes if n in ends and self._kind(n) in self._kinds]

    def block(self, node: int) -> str:
        """Return a block for an entity: its kind, its relations to the ego, its lanes and places."""
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
    """Return a node pattern for one kind, with a mark for the ego or for other nodes.

    A label for several kinds, such as ``Vehicle``, also needs the kind as a property.
    """
    exact = f" {{kind: '{kind}'}}" if kind in SUPER_KINDS else ""
    return f"({name}:{_label_of_example(kind)}&{mark}{exact})"


def _label_of_example(kind: str) -> str:
    return "".join(part.capitalize() for part in kind.split("_"))
