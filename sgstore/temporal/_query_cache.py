"""The monitor's queries on one frame, each asked once, and the truth of bindings.

A binding says of each variable which node it is, or ``None``: any node of which nothing is known. What is known
of a binding that is not held is what is known of the one held that says most of what it says; so a check over a
hundred vehicles of which five come near costs what five cost.

Whatever is told is closed: with two bindings that do not contradict one another, the one that says both is
told.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from sgstore.lang import Binding, ScopeSearch, expression, unnumbered_text
from sgstore.temporal._signal_state import Memory, SignalState, column_of
from sgstore.vocabulary import RELATIONS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from sgstore.lang import Column, Evaluate, FrameView
    from sgstore.lang import ir as b
    from sgstore.temporal._plan import Plan, Signal
    from sgstore.temporal._signal_state import StreamClock
    from sgstore.world import Bools


Partial = tuple["int | None", ...]
T = TypeVar("T")


class Lattice:
    """Order of partial bindings of some variables, from none bound to all.

    Parameters
    ----------
    size : int
        How many variables there are.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.stranger: Partial = (None,) * size
        patterns = [c for n in range(size, -1, -1) for c in combinations(range(size), n)]
        self._patterns = [frozenset(pattern) for pattern in patterns]

    def placed(self, key: Key, places: tuple[int, ...]) -> Partial:
        """Return the binding in which some variables have these values."""
        if self.size == 1:
            return key or self.stranger
        told: list[int | None] = [None] * self.size
        for place, node in zip(places, key, strict=True):
            told[place] = node
        return tuple(told)

    def wider(self, binding: Partial) -> Iterator[Partial]:
        """Bindings that say the same and no more, those that say most first, itself among them."""
        if self.size == 1:
            yield binding
            if binding[0] is not None:
                yield self.stranger
            return
        bound = {place for place, node in enumerate(binding) if node is not None}
        for pattern in self._patterns:
            if pattern <= bound:
                yield tuple(n if place in pattern else None for place, n in enumerate(binding))

    def closed(self, bindings: Iterable[Partial]) -> set[Partial]:
        """Bindings, the one of strangers, and those that say what several of them say."""
        found = {self.stranger}
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
        """Those first that say less."""
        if self.size < 2:
            return sorted(bindings, key=lambda one: one != self.stranger)
        return sorted(bindings, key=lambda one: sum(node is not None for node in one))


def _both(one: Partial, other: Partial) -> Partial | None:
    """Return the union of two bindings; ``None`` if they contradict one another."""
    told: list[int | None] = []
    for a, b in zip(one, other, strict=True):
        if a is not None and b is not None and a != b:
            return None
        told.append(b if a is None else a)
    return tuple(told)


class BindingTable(Generic[T]):
    """Values by binding; a binding without an entry has that of a wider one.

    Parameters
    ----------
    lattice : Lattice
    strangers : T
        What is known of nodes of which nothing is.
    """

    def __init__(self, lattice: Lattice, strangers: T) -> None:
        self.lattice = lattice
        self.held: dict[Partial, T] = {lattice.stranger: strangers}

    def of(self, binding: Partial) -> T:
        """Return the value of a binding."""
        held = self.held
        found = held.get(binding)
        if found is not None:
            return found
        return next(held[wider] for wider in self.lattice.wider(binding) if wider in held)

    def keep(self, found: dict[Partial, T], same: Callable[[T, T], bool]) -> None:
        """Hold what is known now, but for bindings of which the same is known as of wider ones."""
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


# What checks and patterns ask of one frame: each question once, whoever asks it -----------------

Key = tuple[int, ...]
"""What some variables are bound to, in their order."""


class FrameQuery:
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
    first : tuple of str
        Keys of its edges of which, where matches differ in these alone, the relations count that come first in
        the alphabet.
    """

    def __init__(
        self,
        query: b.Query,
        variables: tuple[str, ...],
        value: b.Bound | None = None,
        edges: tuple[str, ...] = (),
        first: tuple[str, ...] = (),
    ) -> None:
        scope = query.scope
        self._variables, self._edges, self._first = variables, edges, first
        self._search = ScopeSearch(scope, injective=query.injective)
        self._value: Evaluate | None = None
        if value is not None:
            self._value = expression(value, injective=query.injective)
        self._kinds: b.Kinds | None = None
        if value is None and len(scope.nodes) == 1 and not scope.where and not scope.edges:
            self._kinds = next(iter(scope.nodes.values())).kinds

    def answers(self, view: FrameView, people: NodeNames) -> Mapping[Key, Any]:
        """Return the bindings of the variables in a graph, each with its value (``None``: unknown)."""
        if self._kinds is not None:
            present = people.of(self._kinds)
            if self._variables:
                return {(node,): None for node in present}
            return {(): None} if present else {}
        at, found = Binding(view), dict[Key, Any]()
        words: dict[Key, tuple[str, ...]] = {}
        for _ in self._search.run(at):
            key = tuple(at.nodes[name] for name in self._variables)
            if self._edges:
                key += tuple(RELATIONS.index(at.edges[name][0]) for name in self._edges)
            if self._first:
                word = tuple(at.edges[name][0] for name in self._first)
                if words.setdefault(key, word) > word:
                    words[key] = word
                    del found[key]
            if key not in found:
                found[key] = self._value(at) if self._value is not None else None
                if not (key or self._first):
                    break
        return found


class NodeNames:
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

    def tells(self, node: int, attribute: str) -> Any:
        """An attribute of a node; ``None``: it is not known."""
        return self._view.nodes[node].get(attribute)

    def name(self, node: int) -> str:
        """Return the name of a node."""
        return str(self._view.nodes[node].get("name", node))


@dataclass(slots=True)
class QueryCache:
    """All questions about the graphs of one ego, and their answers in the last frame.

    Attributes
    ----------
    answers : list of mapping
        By the number of the question.
    fresh : set of Kinds
        Of which somebody is in the last frame who was in none before.
    """

    _known: dict[Any, int] = field(default_factory=dict[Any, int])
    _all: list[FrameQuery] = field(default_factory=list["FrameQuery"])
    _met: dict[b.Kinds, dict[int, str]] = field(default_factory=dict["b.Kinds", dict[int, str]])
    answers: list[Mapping[Key, Any]] = field(default_factory=list["Mapping[Key, Any]"])
    fresh: set[b.Kinds] = field(default_factory=set["b.Kinds"])

    def met(self, kinds: b.Kinds) -> Mapping[int, str]:
        """Return the nodes of some kinds seen so far: node → name; it grows with each frame."""
        return self._met.setdefault(kinds, {})

    def add(
        self,
        query: b.Query,
        variables: tuple[str, ...],
        value: b.Bound | None = None,
        edges: tuple[str, ...] = (),
        first: tuple[str, ...] = (),
    ) -> int:
        """The number of a question; the same for those that ask the same."""
        asked = None if value is None else unnumbered_text(value)
        key = _told(query), variables, asked, edges, first
        if key not in self._known:
            self._known[key] = len(self._all)
            self._all.append(FrameQuery(query, variables, value, edges, first))
        return self._known[key]

    def ask(self, view: FrameView, people: NodeNames) -> None:
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


# What is true of bindings in a frame: the atoms and tests of a plan, a bit each -----------------


class Valuation:
    """The atoms and tests of a plan, for the bindings of which something is known.

    Parameters
    ----------
    plan : Plan
    variables : tuple of str
        What bindings are about, in their order.
    questions : QueryCache
        Those of the plan become part of them.
    pulse : StreamClock
    bridge : bool
        Whether gaps do not matter.

    Attributes
    ----------
    lattice : Lattice
    bits : dict of str to int
        The bit of each atom and test.
    begun : Memory
        What is remembered before the first frame.
    """

    def __init__(
        self,
        plan: Plan,
        variables: tuple[str, ...],
        questions: QueryCache,
        pulse: StreamClock,
        *,
        bridge: bool,
    ) -> None:
        self._variables, self._questions = variables, questions
        self.lattice = Lattice(len(variables))
        self._courses = SignalState(plan, pulse, bridge=bridge)
        self._measured = bool(plan.tests)
        self.begun = self._courses.begun
        self.bits = {name: 1 << number for number, name in enumerate([*plan.atoms, *plan.tests])}
        self._atoms = [
            (self.bits[name], questions.add(one.query, one.variables), self._places(one.variables))
            for name, one in plan.atoms.items()
        ]
        self._signals = {
            name: (
                questions.add(one.query, one.variables, one.value, (), one.edges),
                self._places(one.variables),
            )
            for name, one in plan.signals.items()
        }

    def _places(self, variables: tuple[str, ...]) -> tuple[int, ...]:
        return tuple(self._variables.index(name) for name in variables)

    def read(
        self, held: Iterable[Partial], memory: Callable[[Partial], Memory | None]
    ) -> tuple[dict[Partial, int], Mapping[Partial, Memory]]:
        """A frame has come, and the questions were asked of it.

        Parameters
        ----------
        held : iterable of Partial
            Bindings of which something is known from former frames.
        memory : function
            What a binding remembers; ``None``: nobody asks for it any more.

        Returns
        -------
        letters : dict of Partial to int
            Of all bindings of which something is known now, closed.
        memories : mapping of Partial to Memory
            What they remember from now on; empty if there is nothing to.
        """
        told = self._told()
        lattice = self.lattice
        rows = lattice.closed([*held, *told, *self._told_signals()])
        if self._measured:
            rows = {row for row in rows if memory(row) is not None}
        if lattice.size < 2:
            base = told.get(lattice.stranger, 0)
            letters = {row: base | told.get(row, 0) for row in rows}
        else:
            letters = {row: self._letter(row, told) for row in rows}
        if not self._measured:
            return letters, {}
        return letters, self._measure(list(rows), letters, memory)

    def _told(self) -> dict[Partial, int]:
        """The atoms that are true of bindings which say no more than the atom asks."""
        answers, placed = self._questions.answers, self.lattice.placed
        told: dict[Partial, int] = {}
        for bit, number, places in self._atoms:
            for key in answers[number]:
                row = placed(key, places)
                told[row] = told.get(row, 0) | bit
        return told

    def _letter(self, row: Partial, told: Mapping[Partial, int]) -> int:
        found = 0
        for wider in self.lattice.wider(row):
            found |= told.get(wider, 0)
        return found

    def _told_signals(self) -> Iterator[Partial]:
        for number, places in self._signals.values():
            for key, value in self._questions.answers[number].items():
                if value is not None:
                    yield self.lattice.placed(key, places)

    def _measure(
        self,
        rows: list[Partial],
        letters: dict[Partial, int],
        memory: Callable[[Partial], Memory | None],
    ) -> dict[Partial, Memory]:
        """Tell letters the tests that are true; what bindings remember from now on."""
        self._courses.step()
        columns: dict[str, Bools] = {}

        def atom(name: str) -> Bools:
            if name not in columns:
                bit = self.bits[name]
                columns[name] = np.array([bool(letters[row] & bit) for row in rows], np.bool_)
            return columns[name]

        def signal(one: Signal) -> Column:
            number, places = self._signals[one.name]
            answers: Mapping[Partial, object] = self._questions.answers[number]  # type: ignore[assignment]
            return column_of([answers.get(tuple(row[p] for p in places)) for row in rows])

        tests, memories = self._courses.values([memory(row) or () for row in rows], atom, signal)
        for name, column in tests.items():
            bit = self.bits[name]
            true = np.broadcast_to(column.true[:, 0], len(rows)).tolist()
            for row, flag in zip(rows, true, strict=True):
                if flag:
                    letters[row] |= bit
        return dict(zip(rows, memories, strict=True))
