"""Patterns from Python: built step by step, from networkx, or from an example frame.

All become a text of the language and the values of its parameters, so that they mean what the text means.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QueryError
from sgstore.vocabulary import (
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

    from sgstore.graph import SceneGraph


_NAME: Final = re.compile(r"[A-Za-z_]\w*")
_LABEL: Final = re.compile(r"[A-Za-z_%!(][\w%!&|() ]*")
_RESERVED: Final = frozenset({"label", "kind", "where", "relation", "name"})


@dataclass(frozen=True, slots=True)
class Pattern:
    """A pattern that is built step by step; every step gives a new one.

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
        Nodes and edges, as they stand after ``MATCH``.
    conditions : tuple of str
        Joined by ``AND``.
    returned : str
        What stands after ``RETURN``; empty for whole matches.
    parameters : mapping
        Values that the text speaks of as ``$name``.
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
            Of its variable.
        label : str
            ``Person``, ``Car|Truck``, ``Vehicle&!Ego``; empty: anything.
        **properties
            Attributes that it must have, with their values.

        Raises
        ------
        QueryError
            The name or the label cannot stand in a pattern.
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
            ``relation`` is one, or several as ``near|very_near``; empty: any.
        both : bool
            Whether it may run either way.
        times : str
            ``2`` or ``1..3``: so many edges, one behind the other.
        name : str
            Of its variable, if it has one.

        Raises
        ------
        QueryError
            One of these cannot stand in a pattern.
        """
        ends = [_checked(end, _NAME, "a name") for end in (src, dst)]
        inside = (_checked(name, _NAME, "a name") if name else "") + _label(relation)
        inside += (
            f"*{_checked(times, re.compile(r'[0-9]+([.][.][0-9]+)?'), 'a number')}" if times else ""
        )
        return self._with(part=f"({ends[0]})-[{inside}]-{'' if both else '>'}({ends[1]})")

    def where(self, condition: str, /, **parameters: Any) -> Pattern:
        """Add a condition, as it would stand after ``WHERE``, with the values of its parameters."""
        return self._with(condition=f"({condition})", values=parameters)

    def returns(self, what: str, /) -> Pattern:
        """Say what to return, as it would stand after ``RETURN``."""
        return Pattern(self.parts, self.conditions, what, self.parameters)

    def __repr__(self) -> str:
        return f"<Pattern {str(self) if self.parts else 'without nodes'!r}>"

    def __str__(self) -> str:
        """The text of the pattern."""
        if not self.parts:
            raise QueryError("the pattern is empty", hint="add a node")
        text = f"MATCH {', '.join(self.parts)}"
        text += f" WHERE {' AND '.join(self.conditions)}" if self.conditions else ""
        return text + (f" RETURN {self.returned}" if self.returned else "")

    @classmethod
    def of(cls, graph: nx.Graph[Any]) -> Pattern:
        """The pattern that a networkx graph draws.

        Parameters
        ----------
        graph : networkx graph, directed or not, with one or many edges between two nodes
            Of a node: ``label`` (or ``kind``), ``where`` (a condition on its name, or on that of others), and
            any other attribute as a property that it must have. Of an edge: ``relation`` (a text such as
            ``near|visible``, or several), without one any; either way if the graph is not directed.

        Raises
        ------
        QueryError
            Something of it cannot stand in a pattern.
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
    """A name for a node: its own, if it can be one."""
    text = str(node)
    return text if _NAME.fullmatch(text) else f"n{number}"


def _relations(relation: str | Iterable[str]) -> str:
    return relation if isinstance(relation, str) else "|".join(relation)


# A frame as example: the text of a pattern that describes what is around its ego, and so matches that frame
# ------------------------------------------------------------------------------------------------
# It says where the ego is, and of the traffic that a relation joins with it, how many there are at least of
# each kind in each place: seen from the ego, and in lanes that are its own, beside it, or against it. Each of
# these is a block of its own, so that the pattern stays cheap however much there is around.

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
    head = f"MATCH {node_of_kind(graph.nodes[graph.ego]['kind'], 'ego', 'Ego')}"
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
        """Place of the ego."""
        yield from self._places("ego", self._ego)

    def others(self) -> list[int]:
        """The traffic that a relation joins with the ego."""
        ends = {src for src, _, dst in self._edges if dst == self._ego and src >= 0}
        return [n for n in self._graph.nodes if n in ends and self._kind(n) in self._kinds]

    def block(self, node: int) -> str:
        """An entity as a block: its kind, its relations to the ego, and the lanes and places it is in."""
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
    """A node of one kind, and whether it is the ego, as a pattern.

    A label that stands for several kinds, as ``Vehicle`` does, needs the kind beside it.
    """
    exact = f" {{kind: '{kind}'}}" if kind in SUPER_KINDS else ""
    return f"({name}:{_label_of_example(kind)}&{mark}{exact})"


def _label_of_example(kind: str) -> str:
    return "".join(part.capitalize() for part in kind.split("_"))
