"""What checks and patterns ask of one frame: each question once, whoever asks it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from sgstore.lang.evaluation import Binding
from sgstore.lang.match import Search, expression
from sgstore.lang.printing import unnumbered_text
from sgstore.vocabulary import RELATIONS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.lang import bound as b
    from sgstore.lang.evaluation import Evaluate, FrameView

Key = tuple[int, ...]
"""What some variables are bound to, in their order."""


class Question:
    """A pattern of one frame, and what is asked of its matches.

    Parameters
    ----------
    query : Query
    variables : tuple of str
        Keys of its nodes that an answer tells; the others are only asked to exist.
    value : Bound, optional
        What is asked of each match.
    edges : tuple of str
        Keys of its edges that an answer tells, behind the nodes: by places in :data:`RELATIONS`.
    """

    def __init__(
        self,
        query: b.Query,
        variables: tuple[str, ...],
        value: b.Bound | None = None,
        edges: tuple[str, ...] = (),
    ) -> None:
        scope = query.scope
        self._variables, self._edges = variables, edges
        self._search = Search(scope, injective=query.injective)
        self._value: Evaluate | None = None
        if value is not None:
            self._value = expression(value, injective=query.injective)
        self._kinds: b.Kinds | None = None
        if value is None and len(scope.nodes) == 1 and not scope.where and not scope.edges:
            self._kinds = next(iter(scope.nodes.values())).kinds

    def answers(self, view: FrameView, people: People) -> Mapping[Key, Any]:
        """What the variables are bound to in a graph, each with its value (``None`` where it is unknown)."""
        if self._kinds is not None:
            present = people.of(self._kinds)
            if self._variables:
                return {(node,): None for node in present}
            return {(): None} if present else {}
        at, found = Binding(view), dict[Key, Any]()
        for _ in self._search.run(at):
            key = tuple(at.nodes[name] for name in self._variables)
            if self._edges:
                key += tuple(RELATIONS.index(at.edges[name][0]) for name in self._edges)
            if key not in found:
                found[key] = self._value(at) if self._value is not None else None
                if not key:
                    break
        return found


class People:
    """The nodes of one graph by what they may be.

    Parameters
    ----------
    view : FrameView
    """

    def __init__(self, view: FrameView) -> None:
        self._view = view
        self._found: dict[b.Kinds, frozenset[int]] = {}

    def __contains__(self, node: int) -> bool:
        return node in self._view.nodes

    def of(self, kinds: b.Kinds) -> frozenset[int]:
        """Those that are of some kinds."""
        if kinds not in self._found:
            view, ego = self._view, self._view.graph.ego
            found = {n for kind in kinds.other for n in view.by_kind.get(kind, ())}
            found.discard(-1 if ego is None else ego)
            if ego is not None and ego in view.nodes and view.is_one(ego, kinds):
                found.add(ego)
            self._found[kinds] = frozenset(found)
        return self._found[kinds]

    def name(self, node: int) -> str:
        """What a node is called."""
        return str(self._view.nodes[node].get("name", node))


@dataclass(slots=True)
class Questions:
    """All questions about the graphs of one ego, and their answers in the last frame.

    Attributes
    ----------
    answers : list of mapping
        By the number of the question.
    fresh : set of Kinds
        Of which somebody is in the last frame who was in none before.
    """

    _known: dict[Any, int] = field(default_factory=dict[Any, int])
    _all: list[Question] = field(default_factory=list["Question"])
    _met: dict[b.Kinds, dict[int, str]] = field(default_factory=dict["b.Kinds", dict[int, str]])
    answers: list[Mapping[Key, Any]] = field(default_factory=list["Mapping[Key, Any]"])
    fresh: set[b.Kinds] = field(default_factory=set["b.Kinds"])

    def met(self, kinds: b.Kinds) -> Mapping[int, str]:
        """Who of some kinds was in a frame so far: node → name; it grows with each frame."""
        return self._met.setdefault(kinds, {})

    def add(
        self,
        query: b.Query,
        variables: tuple[str, ...],
        value: b.Bound | None = None,
        edges: tuple[str, ...] = (),
    ) -> int:
        """The number of a question; the same for those that ask the same."""
        key = _told(query), variables, None if value is None else unnumbered_text(value), edges
        if key not in self._known:
            self._known[key] = len(self._all)
            self._all.append(Question(query, variables, value, edges))
        return self._known[key]

    def ask(self, view: FrameView, people: People) -> None:
        """Ask them all of a graph."""
        self.fresh.clear()
        for kinds, known in self._met.items():
            present = people.of(kinds)
            if not present <= known.keys():
                known.update((node, people.name(node)) for node in present - known.keys())
                self.fresh.add(kinds)
        self.answers = [question.answers(view, people) for question in self._all]


def _told(query: b.Query) -> tuple[Any, ...]:
    scope = query.scope
    nodes = tuple((key, node.kinds) for key, node in sorted(scope.nodes.items()))
    edges = tuple((e.key, e.src, e.dst, e.relations, e.both, e.low, e.high) for e in scope.edges)
    where = tuple(map(unnumbered_text, scope.where))
    return nodes, edges, where, scope.distinct, query.injective
