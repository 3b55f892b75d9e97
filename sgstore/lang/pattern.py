"""Patterns given otherwise than as text: built step by step, or drawn as a networkx graph.

Both become a text of the language and the values of its parameters, so that they mean what the text means.
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
