"""Results of single-frame queries in an online monitor, and the bindings of a frame.

A binding maps each variable to a node, or to ``None``: any node without known values. A binding without an
entry uses the entry of its most specific stored generalisation. So a check over a hundred vehicles with five
near ones costs as much as five.

Sets of bindings are closed under union: they contain the union of any two compatible bindings.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from sgstore.base.json_text import shortest
from sgstore.lang.memory import Binding, ScopeSearch, StageSearch, expression
from sgstore.lang.sql import unnumbered_text
from sgstore.model.vocabulary import RELATIONS
from sgstore.temporal._topic_values import message_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from sgstore.lang import ir as b
    from sgstore.lang.memory import FrameView
    from sgstore.temporal._plan import Ask


Partial = tuple["int | None", ...]
T = TypeVar("T")


class Lattice:
    """Order of partial bindings, in which only some variables have nodes, from empty to complete.

    Parameters
    ----------
    size : int
        Number of variables.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.stranger: Partial = (None,) * size
        patterns = [c for n in range(size, -1, -1) for c in combinations(range(size), n)]
        self._patterns = [frozenset(pattern) for pattern in patterns]

    def placed(self, key: Key, places: tuple[int, ...]) -> Partial:
        """Return a partial binding with the given nodes at some variables, and None at the others."""
        if self.size == 1:
            return key or self.stranger
        told: list[int | None] = [None] * self.size
        for place, node in zip(places, key, strict=True):
            told[place] = node
        return tuple(told)

    def wider(self, binding: Partial) -> Iterator[Partial]:
        """Yield a partial binding, then bindings with fewer and fewer of its nodes; the empty one is last."""
        if self.size == 1:
            yield binding
            if binding[0] is not None:
                yield self.stranger
            return
        bound = {place for place, node in enumerate(binding) if node is not None}
        for pattern in self._patterns:
            if pattern <= bound:
                yield tuple(n if place in pattern else None for place, n in enumerate(binding))

    def closed(self, bindings: Iterable[Partial], known: Iterable[Partial] = ()) -> set[Partial]:
        """Return partial bindings (nodes for some variables), and the unions of any two that do not conflict.

        The empty binding is included.

        ``known`` bindings are closed already.
        """
        found = {self.stranger, *known}
        if self.size < 2:
            found.update(bindings)
            return found
        for binding in bindings:
            if binding in found:
                continue
            both = (_both(binding, other) for other in found)
            found |= {one for one in both if one is not None}
        return found

    def ordered(self, bindings: Iterable[Partial]) -> list[Partial]:
        """Sort partial bindings (nodes for some variables): those with few variables first."""
        if self.size < 2:
            return sorted(bindings, key=lambda one: one != self.stranger)
        return sorted(bindings, key=lambda one: sum(node is not None for node in one))


def _both(one: Partial, other: Partial) -> Partial | None:
    """Return the union of two partial bindings (nodes for some variables).

    ``None`` means that they have different nodes for a variable.
    """
    told: list[int | None] = []
    for first, second in zip(one, other, strict=True):
        if first is not None and second is not None and first != second:
            return None
        told.append(second if first is None else first)
    return tuple(told)


class BindingTable(Generic[T]):
    """Table: binding → value. A binding without an entry has the value of a less specific binding.

    Parameters
    ----------
    lattice : Lattice
    strangers : T
        Value for nodes without known values.
    """

    def __init__(self, lattice: Lattice, strangers: T) -> None:
        self.lattice = lattice
        self.held: dict[Partial, T] = {lattice.stranger: strangers}

    def of(self, binding: Partial) -> T:
        """Return the value of a binding, from its own entry or from the most specific entry that it extends."""
        held = self.held
        found = held.get(binding)
        if found is not None:
            return found
        return next(held[wider] for wider in self.lattice.wider(binding) if wider in held)

    def keep(self, found: dict[Partial, T], same: Callable[[T, T], bool]) -> None:
        """Replace the table. Entries that equal the entry of a less specific binding are left out."""
        lattice = self.lattice
        strangers = found[lattice.stranger]
        if lattice.size < 2:
            self.held = {one: value for one, value in found.items() if not same(value, strangers)}
            self.held[lattice.stranger] = strangers
            return
        held: dict[Partial, T] = {}
        for binding in lattice.ordered(found):
            value = found[binding]
            wider = next((w for w in lattice.wider(binding) if w in held), None)
            if wider is None or not same(value, held[wider]):
                held[binding] = value
        self.held = held


Key = tuple[int, ...]
"""Nodes of some variables, in a fixed order."""


def answerer(ask: Ask) -> Callable[[FrameView, NodeNames], Mapping[Key, Any]]:
    """Return a function that runs a query on a scene graph and returns its matches.

    Its result is: matched nodes → value (``None``: unknown).

    Edges in a binding are indices in :data:`RELATIONS`.
    """
    scope, injective = ask.query.scope, ask.query.injective
    search = ScopeSearch(scope, injective=injective)
    value = None if ask.value is None else expression(ask.value, injective=injective)
    first, edges = ((), ask.edges) if value is None else (ask.edges, ())

    def present(_: FrameView, people: NodeNames) -> Mapping[Key, Any]:
        there = people.of(next(iter(scope.nodes.values())).kinds)
        if ask.variables:
            return {(node,): None for node in there}
        return {(): None} if there else {}

    def found(view: FrameView, _: NodeNames) -> Mapping[Key, Any]:
        at, told = Binding(view), dict[Key, Any]()
        words: dict[Key, tuple[str, ...]] = {}
        for _match in search.run(at):
            key = tuple(at.nodes[name] for name in ask.variables)
            key += tuple(RELATIONS.index(at.edges[name][0]) for name in edges)
            if first:
                word = tuple(at.edges[name][0] for name in first)
                if words.setdefault(key, word) > word:
                    words[key] = word
                    del told[key]
            if key not in told:
                told[key] = value(at) if value is not None else None
                if not (key or first):
                    break
        return told

    plain = value is None and len(scope.nodes) == 1 and not scope.where and not scope.edges
    return present if plain else found


class NodeNames:
    """Nodes of one scene graph in an online monitor, grouped by kind, with their names.

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
        """Return the ids of the nodes of the graph that have some kinds."""
        if kinds not in self._found:
            view, ego = self._view, self._view.graph.ego
            found = {n for kind in kinds.other for n in view.by_kind.get(kind, ())}
            if ego is not None:
                found.discard(ego)
            if ego is not None and ego in view.nodes and view.is_one(ego, kinds):
                found.add(ego)
            self._found[kinds] = frozenset(found)
        return self._found[kinds]

    def tells(self, node: int, attribute: str) -> Any:
        """Return an attribute of a node. ``None`` means unknown."""
        return self._view.nodes[node].get(attribute)

    def records(self, kind: str) -> bool:
        """True if the trace records events of a kind."""
        return kind in self._view.graph.events

    def has_topic(self, topic: str) -> bool:
        """True if the frame has a message of a topic."""
        return message_of(self._view.graph.topics, topic) is not None

    def has_lanes(self, what: str) -> bool:
        """True if the map has values of ``ways``, ``curvature`` or ``slope`` for lanes."""
        reach = self._view.graph.reach
        return reach is not None and reach.tells(what)

    def name(self, node: int) -> str:
        """Return the name of a node."""
        return str(self._view.nodes[node].get("name", node))


@dataclass(slots=True)
class QueryCache:
    """All single-frame queries of a monitor for one ego, with their results in the latest frame.

    Attributes
    ----------
    answers : list of mapping
        Results by query number.
    fresh : set of Kinds
        Kinds with a new entity in the last frame.
    here : dict of Kinds to int
        Number of nodes of these kinds in the last frame.
    """

    _known: dict[Any, int] = field(default_factory=dict[Any, int])
    _all: list[Callable[[FrameView, NodeNames], Mapping[Key, Any]]] = field(default_factory=list)
    _met: dict[b.Kinds, dict[int, str]] = field(default_factory=dict["b.Kinds", dict[int, str]])
    answers: list[Mapping[Key, Any]] = field(default_factory=list["Mapping[Key, Any]"])
    fresh: set[b.Kinds] = field(default_factory=set["b.Kinds"])
    here: dict[b.Kinds, int] = field(default_factory=dict["b.Kinds", int])

    def met(self, kinds: b.Kinds) -> Mapping[int, str]:
        """Return the nodes of the given kinds in all frames so far: node → name.

        Each frame extends the mapping.
        """
        return self._met.setdefault(kinds, {})

    def add(self, ask: Ask) -> int:
        """Add a single-frame query, and return its number. Equal queries get the same number."""
        value = None if ask.value is None else unnumbered_text(ask.value)
        key = _told(ask.query), ask.variables, value, ask.edges
        if key not in self._known:
            self._known[key] = len(self._all)
            self._all.append(answerer(ask))
        return self._known[key]

    def add_parts(self, query: b.Query, keys: tuple[str, ...]) -> int:
        """Add a query with several clauses (``MATCH``, ``WITH``), and return its number.

        The result has the bindings of the named nodes and edges, each with the values of its first row.
        """
        search = StageSearch(query)
        returned = () if query.result.aggregated else query.result.columns
        single = frozenset(column.name for column in returned if column.single)
        values = {column.name: search.value(column.value) for column in returned}

        def found(view: FrameView, _: NodeNames) -> Mapping[Key, Any]:
            told = dict[Key, Any]()
            for row in search.rows(view):
                key = tuple(_place(row, name) for name in keys)
                if key not in told:
                    of_row = {name: value(row) for name, value in values.items()}
                    told[key] = {n: shortest(v) if n in single else v for n, v in of_row.items()}
            return told

        self._all.append(found)
        return len(self._all) - 1

    def ask(self, view: FrameView, people: NodeNames) -> None:
        """Run all queries on the scene graph of a frame, and store the results."""
        self.fresh.clear()
        for kinds, known in self._met.items():
            present = people.of(kinds)
            self.here[kinds] = len(present)
            if not present <= known.keys():
                known.update((node, people.name(node)) for node in present - known.keys())
                self.fresh.add(kinds)
        self.answers = [answers(view, people) for answers in self._all]


def _place(row: Binding, name: str) -> Any:
    if name in row.nodes:
        return row.nodes[name]
    return row.edges[name] and RELATIONS.index(row.edges[name][0])


def _told(query: b.Query) -> tuple[Any, ...]:
    scope = query.scope
    nodes = tuple((key, node.kinds) for key, node in sorted(scope.nodes.items()))
    edges = tuple((e.key, e.src, e.dst, e.relations, e.both, e.low, e.high) for e in scope.edges)
    where = tuple(map(unnumbered_text, scope.where))
    return nodes, edges, where, scope.distinct, query.injective


# Values over time frame by frame: what ``prev``, ``delta``, ``run_length``, ``since_true`` and ``age`` keep ---
# The twin of :mod:`sgstore.temporal._signals`: the same numbers, of one frame at a time, for many bindings at
# once. What a binding must remember is a value that nobody changes in place, so that a binding that is new goes
# on from what is remembered of those that were never seen.

TIMES: Final = 1001
"""Number of recent frame intervals whose median is the frame period."""

NEVER: Final = 1 << 62
"""Frame number that is larger than every real frame number."""

Memory = tuple[Any, ...]
"""Data of earlier frames for one binding: one entry for each function over time and its conditions."""
