"""Query patterns built in Python, step by step, or from a networkx graph.

Each pattern is converted to query text and parameter values, so it has the meaning of that text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QueryError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import networkx as nx


_NAME: Final = re.compile(r"[A-Za-z_]\w*")
_LABEL: Final = re.compile(r"[A-Za-z_%!(][\w%!&|() ]*")
_RESERVED: Final = frozenset({"label", "kind", "where", "relation", "name"})


@dataclass(frozen=True, slots=True)
class Pattern:
    """Query pattern under construction. Each method returns a new pattern with one more part.

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

    Examples
    --------
    >>> crossing = sgstore.Pattern().node("e", "Ego").node("p", "Person").edge("e", "near_coll", "p")
    >>> print(crossing)
    MATCH (e:Ego), (p:Person), (e)-[:near_coll]->(p)
    >>> store.find(crossing).count()
    4
    """

    parts: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()
    returned: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def node(self, name: str, label: str = "", /, **properties: Any) -> Pattern:
        """Return a new pattern with an additional node.

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

        Examples
        --------
        >>> print(sgstore.Pattern().node("p", "Person").node("v", "Vehicle&!Ego"))
        MATCH (p:Person), (v:Vehicle&!Ego)
        >>> pattern = sgstore.Pattern().node("l", "TrafficLight", light_state="red")
        >>> print(pattern, dict(pattern.parameters))
        MATCH (l:TrafficLight {light_state: $l_light_state}) {'l_light_state': 'red'}
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
        """Return a new pattern with an additional edge between two nodes.

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

        Examples
        --------
        >>> pair = sgstore.Pattern().node("e", "Ego").node("p", "Person")
        >>> print(pair.edge("e", "near|very_near", "p"))
        MATCH (e:Ego), (p:Person), (e)-[:near|very_near]->(p)
        """
        ends = [_checked(end, _NAME, "a name") for end in (src, dst)]
        inside = (_checked(name, _NAME, "a name") if name else "") + _label(relation)
        inside += (
            f"*{_checked(times, re.compile(r'[0-9]+([.][.][0-9]+)?'), 'a number')}" if times else ""
        )
        return self._with(part=f"({ends[0]})-[{inside}]-{'' if both else '>'}({ends[1]})")

    def where(self, condition: str, /, **parameters: Any) -> Pattern:
        """Return a new pattern with an additional condition. It has the syntax of ``WHERE``.

        Examples
        --------
        >>> fast = sgstore.Pattern().node("v", "Vehicle").where("v.speed > $least", least=9)
        >>> print(fast)
        MATCH (v:Vehicle) WHERE (v.speed > $least)
        """
        return self._with(condition=f"({condition})", values=parameters)

    def returns(self, what: str, /) -> Pattern:
        """Return a new pattern that returns the given values. They have the syntax of ``RETURN``.

        Examples
        --------
        >>> print(sgstore.Pattern().node("v", "Vehicle").returns("v.name, v.speed"))
        MATCH (v:Vehicle) RETURN v.name, v.speed
        """
        return Pattern(self.parts, self.conditions, what, self.parameters)

    def __repr__(self) -> str:
        return f"<Pattern {str(self) if self.parts else 'without nodes'!r}>"

    def __str__(self) -> str:
        """Return the pattern as query text."""
        if not self.parts:
            raise QueryError("the pattern is empty", hint="add a node")
        text = f"MATCH {', '.join(self.parts)}"
        text += f" WHERE {' AND '.join(self.conditions)}" if self.conditions else ""
        return text + (f" RETURN {self.returned}" if self.returned else "")

    @classmethod
    def of(cls, graph: nx.Graph[Any]) -> Pattern:
        """Return the query pattern that a networkx graph describes.

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

        Examples
        --------
        >>> import networkx as nx
        >>> graph = nx.DiGraph()
        >>> graph.add_node("e", label="Ego")
        >>> graph.add_node("p", label="Person")
        >>> graph.add_edge("e", "p", relation="near_coll")
        >>> print(sgstore.Pattern.of(graph))
        MATCH (e:Ego), (p:Person), (e)-[:near_coll]->(p)
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
        raise QueryError(f"{text!r} is not {what} that a pattern can use")
    return text


def _label(label: str) -> str:
    depths = list(accumulate((c == "(") - (c == ")") for c in label))
    if depths and (min(depths) < 0 or depths[-1]):
        raise QueryError(f"{label!r} is not a label that a pattern can use")
    return f":{_checked(label, _LABEL, 'a label')}" if label else ""


def _name_of(node: object, number: int) -> str:
    """Return the variable name for a node: its own name if that is valid, otherwise ``n`` and a number."""
    text = str(node)
    return text if _NAME.fullmatch(text) else f"n{number}"


def _relations(relation: str | Iterable[str]) -> str:
    return relation if isinstance(relation, str) else "|".join(relation)
