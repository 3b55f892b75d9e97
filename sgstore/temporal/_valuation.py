"""Single-frame queries of the monitor, the truth of bindings, and their values over time.

A binding maps each variable to a node, or to ``None``: any node without known values. A binding without an
entry uses the entry of its most specific stored generalisation. So a check over a hundred vehicles with five
near ones costs as much as five.

Sets of bindings are closed under union: they contain the union of any two compatible bindings.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import numpy as np

from sgstore.base.json_text import shortest
from sgstore.errors import QueryError
from sgstore.lang import ir as b
from sgstore.lang.bind import FUTURE
from sgstore.lang.memory import Binding, ScopeSearch, StageSearch, expression
from sgstore.lang.operators import Column
from sgstore.lang.sql import unnumbered_text, value_text
from sgstore.model.vocabulary import RELATIONS
from sgstore.model.world import JUMP_NS, longest_step_ns, tolerance_ns
from sgstore.temporal._check_plan import CheckPlan
from sgstore.temporal._formula import (
    Next,
    Previous,
    Progression,
    ProgressionFrame,
    Since,
    Tick,
    Until,
    walk,
)
from sgstore.temporal._robustness import MarginTable, margin_columns
from sgstore.temporal._signals import NS, Clock, SignalValues, wrapped
from sgstore.temporal._windows import next_window, window_value

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.lang.memory import FrameView
    from sgstore.model.world import Bools, Floats
    from sgstore.temporal._plan import Ask, Plan, Test


Partial = tuple["int | None", ...]
T = TypeVar("T")


class Lattice:
    """Order of partial bindings of some variables, from none bound to all bound.

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
        """Return the binding with these values at some variables."""
        if self.size == 1:
            return key or self.stranger
        told: list[int | None] = [None] * self.size
        for place, node in zip(places, key, strict=True):
            told[place] = node
        return tuple(told)

    def wider(self, binding: Partial) -> Iterator[Partial]:
        """Yield the binding and its generalisations, most specific first."""
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
        """Return a set of bindings closed under union, including the empty binding.

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
        """Sort bindings by the number of bound variables, fewest first."""
        if self.size < 2:
            return sorted(bindings, key=lambda one: one != self.stranger)
        return sorted(bindings, key=lambda one: sum(node is not None for node in one))


def _both(one: Partial, other: Partial) -> Partial | None:
    """Return the union of two bindings. ``None`` means a contradiction."""
    told: list[int | None] = []
    for first, second in zip(one, other, strict=True):
        if first is not None and second is not None and first != second:
            return None
        told.append(second if first is None else first)
    return tuple(told)


class BindingTable(Generic[T]):
    """Values by binding. A binding without a value inherits it from its generalisation.

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
        """Return the value of a binding."""
        held = self.held
        found = held.get(binding)
        if found is not None:
            return found
        return next(held[wider] for wider in self.lattice.wider(binding) if wider in held)

    def keep(self, found: dict[Partial, T], same: Callable[[T, T], bool]) -> None:
        """Store new values, without bindings whose value equals that of a generalisation."""
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


# Single-frame queries of checks and patterns, without duplicates --------------------------------

Key = tuple[int, ...]
"""Nodes of some variables, in order."""


def answerer(ask: Ask) -> Callable[[FrameView, NodeNames], Mapping[Key, Any]]:
    """Return a function from a graph to the bindings of a query, each with its value (``None``: unknown).

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
    """Nodes of one graph by kind, with their names.

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
        """Return the nodes of some kinds."""
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
        """True if the trace records events of this kind."""
        return kind in self._view.graph.events

    def has_lanes(self, what: str) -> bool:
        """True if the map has values for lanes: ``ways``, ``curvature`` or ``slope``."""
        reach = self._view.graph.reach
        return reach is not None and reach.tells(what)

    def name(self, node: int) -> str:
        """Return the name of a node."""
        return str(self._view.nodes[node].get("name", node))


@dataclass(slots=True)
class QueryCache:
    """All queries on the graphs of one ego, with their results in the last frame.

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
        """Return the nodes of some kinds seen so far: node → name. The mapping grows with each frame."""
        return self._met.setdefault(kinds, {})

    def add(self, ask: Ask) -> int:
        """Add a query, and return its number. Equal queries share a number."""
        value = None if ask.value is None else unnumbered_text(ask.value)
        key = _told(ask.query), ask.variables, value, ask.edges
        if key not in self._known:
            self._known[key] = len(self._all)
            self._all.append(answerer(ask))
        return self._known[key]

    def add_parts(self, query: b.Query, keys: tuple[str, ...]) -> int:
        """Add a query for the rows of several pattern parts, and return its number.

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
        """Evaluate all queries on a graph."""
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
"""Number of latest frame intervals for the median."""

NEVER: Final = 1 << 62
"""Frame number after all frames."""

Memory = tuple[Any, ...]
"""Memory of a binding: data of earlier frames for each time function and its conditions."""


class StreamClock:
    """Recent frame times, as far back as an operator needs them.

    Parameters
    ----------
    period_ns : int, optional
        Time between frames; ns. Default: median of the last :data:`TIMES` frames.

    Attributes
    ----------
    tick : Tick
        Last frame. Its time is corrected after a backward jump; see :meth:`told`.
    start : int
        Time of the first frame; ns.
    gap, jump : bool
        True if a gap, or a backward jump, lies before the last frame.
    """

    def __init__(self, period_ns: int | None = None) -> None:
        self._period = period_ns
        self._spans: deque[int] = deque()
        self._sorted: list[int] = []
        self.tick = Tick(0, -1)
        self._last_ns = 0
        self.start = 0
        self.gap = self.jump = False
        # Each backward jump: corrected time of the first frame after it, time shift, and frame number.
        self._jumps: list[tuple[int, int, int]] = []

    @property
    def period(self) -> int:
        """Median time between frames; ns. It is 0 before the second frame."""
        if self._period is not None:
            return self._period
        return self._sorted[(len(self._sorted) - 1) // 2] if self._sorted else 0

    def step(self, time_ns: int) -> None:
        """Add the next frame. A time that does not ascend: see :func:`sgstore.temporal._offline.ascending`."""
        last, told = self.tick, self._last_ns
        self._last_ns = time_ns
        self.jump = last.number >= 0 and time_ns < told
        if last.number < 0:
            self.start = time_ns
        elif self.jump:
            self.gap = True
            behind = last.time + JUMP_NS
            self._jumps.append((behind, behind - time_ns, last.number + 1))
            time_ns = behind
        else:
            time_ns = max(time_ns + (self._jumps[-1][1] if self._jumps else 0), last.time + 1)
            span = time_ns - last.time
            self.gap = bool(self.period) and span > longest_step_ns(self.period)
            if self._period is None:
                self._remember(span)
        self.tick = Tick(time_ns, last.number + 1, tolerance_ns(self.period))

    def breaks(self, *, bridge: bool) -> bool:
        """True if runs end before the last frame. With ``bridge``, only backward jumps end runs."""
        return self.jump or (self.gap and not bridge)

    def told(self, time: int) -> int:
        """Return the original time of a frame from its corrected time; ns."""
        after = bisect_right(self._jumps, (time, NEVER, 0))
        return time - self._jumps[after - 1][1] if after else time

    def jump_after(self, time: int) -> int:
        """Return the number of the first frame after the next backward jump, or :data:`NEVER`."""
        after = bisect_right(self._jumps, (time, NEVER, 0))
        return self._jumps[after][2] if after < len(self._jumps) else NEVER

    def _remember(self, span: int) -> None:
        if len(self._spans) == TIMES:
            del self._sorted[bisect_left(self._sorted, self._spans.popleft())]
        self._spans.append(span)
        insort(self._sorted, span)


def _courses(expression: b.Bound) -> Iterator[b.SignalCall]:
    """Yield the time functions in an expression, except those inside their conditions."""
    if isinstance(expression, b.SignalCall):
        yield expression
    elif not b.is_formula(expression):
        for operand in b.operands_of(expression):
            yield from _courses(operand)


class SignalState:
    """Tests of a plan, evaluated frame by frame.

    Parameters
    ----------
    plan : Plan
    pulse : StreamClock
        Clock, updated with each frame before this object.
    bridge : bool
        True to ignore gaps.

    Raises
    ------
    QueryError
        A test depends on later frames.
    """

    def __init__(self, plan: Plan, pulse: StreamClock, *, bridge: bool = False) -> None:
        self.plan, self.pulse, self._bridge = plan, pulse, bridge
        self.places: dict[b.Bound, int] = {}
        self.conditions: dict[b.Bound, Progression] = {}
        for test in plan.tests.values():
            for condition, formula in test.quantities.items():
                if any(isinstance(part, Next | Previous | Until | Since) for part in walk(formula)):
                    raise QueryError(
                        f"robustness({value_text(condition)}) is not of this frame alone",
                        hint="a monitor has the margins of checks: CHECK ALWAYS … ROBUSTNESS",
                    )
            for part in b.walk(test.expression):
                if isinstance(part, b.Tense) and part.word in FUTURE:
                    raise QueryError(
                        f"{part.word} stands where its value must be known at once, and it looks ahead",
                        hint="join conditions by AND, OR, NOT, IMPLIES",
                    )
            for course in _courses(test.expression):
                self.places.setdefault(course, len(self.places))
            for condition, formula in test.formulas.items():
                self.conditions[condition] = Progression(formula)
        self._frames: deque[tuple[int, int]] = deque()  # times and numbers since the last gap
        self._begun = 0  # number of the first frame after the gap
        deltas = [c for c in self.places if isinstance(c, b.SignalCall) and c.word == "delta"]
        self._back = max((c.by for c in deltas if not c.frames), default=0)
        self._many = max((c.by for c in deltas if c.frames), default=0)

    @property
    def begun(self) -> Memory:
        """Memory before the first frame."""
        pasts = (progression.begun for progression in self.conditions.values())
        return (*(None for _ in self.places), *pasts)

    def step(self) -> None:
        """Process the next frame. The clock must be up to date."""
        tick = self.pulse.tick
        if self.gap:
            self._frames.clear()
            self._begun = tick.number
        self._frames.append((tick.time, tick.number))
        while len(self._frames) > self._many + 1 and self._frames[1][0] <= tick.time - self._back:
            self._frames.popleft()

    @property
    def gap(self) -> bool:
        """True if a gap lies before this frame."""
        return self.pulse.breaks(bridge=self._bridge)

    @property
    def oldest(self) -> int:
        """Number of the oldest frame that a test can still read."""
        return self._frames[0][1]

    def window(self, course: b.SignalCall) -> tuple[int, int]:
        """Return number and time of the oldest frame in the current window of a time function."""
        tick = self.pulse.tick
        if course.frames:
            return max(tick.number - course.by + 1, self._begun), -NEVER
        return self._begun, tick.time - course.by - tick.tolerance

    def there(self, course: b.SignalCall) -> int:
        """Return the number of the frame that ``delta`` compares with this frame, or -1."""
        tick = self.pulse.tick
        if course.frames:
            number = tick.number - course.by
            return number if number >= self.oldest else -1
        found = -1
        for time, number in self._frames:
            if time > tick.time - course.by + tick.tolerance:
                break
            found = number
        return found

    def values(
        self,
        memories: Sequence[Memory],
        atom: Callable[[str], Bools],
        signal: Callable[[Ask], Column],
    ) -> tuple[dict[str, Column], list[Memory]]:
        """Return the values of all tests in this frame for some bindings, and their new memories.

        Parameters
        ----------
        memories : sequence of B
        atom : function
            (B,) mask of an atom by name.
        signal : function
            The values of a signal: (B, 1).

        Returns
        -------
        tests : dict of str to Column
            (B, 1), or (1, 1), by name.
        memories : list of B
        """
        now = _Now(self, memories, atom, signal)
        return {name: now.test(test) for name, test in self.plan.tests.items()}, now.memories()


class _Now(SignalValues):
    """Evaluation of tests in one frame for some bindings."""

    def __init__(
        self,
        courses: SignalState,
        memories: Sequence[Memory],
        atom: Callable[[str], Bools],
        signal: Callable[[Ask], Column],
    ) -> None:
        self._all, self._atom, self._signal = courses, atom, signal
        self._tick = courses.pulse.tick
        nothing = np.zeros(0, np.int64)
        super().__init__(Clock(nothing, nothing, 0, self._tick.tolerance))
        places = len(courses.places)
        columns = list(zip(*memories, strict=True)) or [()] * len(courses.begun)
        self._old = dict(zip(courses.places, columns, strict=False))
        self._pasts = dict(zip(courses.conditions, columns[places:], strict=True))
        self._new: dict[b.Bound, list[Any]] = {}
        self._kept: dict[b.Bound, list[Any]] = {}
        self._tests: dict[str, Column] = {}
        self._courses: dict[b.Bound, Column] = {}
        self._flags: dict[b.Bound, Bools] = {}
        self._rows = len(memories)

    def memories(self) -> list[Memory]:
        """Return the new memory of each binding."""
        columns = [self._new[course] for course in self._all.places]
        columns += [self._kept[condition] for condition in self._all.conditions]
        return list(zip(*columns, strict=True)) if columns else [() for _ in range(self._rows)]

    def test(self, test: Test) -> Column:
        """Return the value (B, 1) of a test. It is computed once, because it updates the memory."""
        if test.name not in self._tests:
            self._tests[test.name] = super().test(test)
        return self._tests[test.name]

    def signal(self, signal: Ask) -> Column:
        """Return the values (B, 1) of a signal."""
        return self._signal(signal)

    def proposition(self, name: str) -> Bools:
        """Return a mask (B, 1) of the bindings for which an atom or test is true."""
        if name in self._all.plan.tests:
            found = self.test(self._all.plan.tests[name]).true
            return np.broadcast_to(found, (self._rows, 1))
        return self._atom(name)[:, None]

    def margins(self, course: b.SignalCall, test: Test) -> Floats:
        """Return the margins (B, 1) of a condition on this frame."""
        formula, tolerance = test.quantities[course.operand], self._tick.tolerance
        columns = margin_columns(self._all.plan, formula, self.test, self.proposition, tolerance)
        value = MarginTable(columns, np.zeros(1, np.int64)).value(formula)
        return np.broadcast_to(value, (self._rows, 1))

    def condition(self, expression: b.Bound, test: Test) -> Bools:
        """Return a mask (B, 1) of the bindings for which a condition inside a test is true."""
        if expression not in self._flags:
            self._flags[expression] = self._condition(expression)[:, None]
        return self._flags[expression]

    def _condition(self, condition: b.Bound) -> Bools:
        progression = self._all.conditions[condition]
        letters = [self.proposition(name)[:, 0].tolist() for name in progression.names]
        known: dict[tuple[Any, ...], tuple[bool, Any]] = {}
        found: list[tuple[bool, Any]] = []
        for past, *letter in zip(self._pasts[condition], *letters, strict=True):
            key = past, *letter
            if key not in known:
                named = dict(zip(progression.names, letter, strict=True))
                frame = ProgressionFrame(progression, past, named, self._tick)
                value = frame.now(progression.formula) is progression.terms.true
                known[key] = value, frame.past()
            found.append(known[key])
        self._kept[condition] = [past for _, past in found]
        return np.array([value for value, _ in found], np.bool_)

    def course(self, course: b.SignalCall, test: Test) -> Column:
        """Return the value of a time function."""
        if course not in self._courses:
            self._courses[course] = self._course(course, test)
        return self._courses[course]

    def _course(self, course: b.SignalCall, test: Test) -> Column:  # noqa: PLR0911 - a case each
        match course.word:
            case "prev" | "delta" | "min_over" | "max_over" | "avg_over" | "sum_over":
                column = self.signal(test.signals[course.operand])
                known = np.broadcast_to(column.known[:, 0], self._rows).tolist()
                values = np.broadcast_to(column.values[:, 0], self._rows).tolist()
                now = [value if told else None for value, told in zip(values, known, strict=True)]
                if course.word == "prev":
                    return self._prev(course, now)
                changed = course.word == "delta"
                return self._changed(course, now) if changed else self._over(course, now)
            case "run_length" | "since_true":
                flags = self.condition(course.operand, test)[:, 0].tolist()
                if course.word == "run_length":
                    return self._run_now(course, flags)
                return self._since_true(course, flags)
            case "robustness":
                self._new[course] = [None] * self._rows
                return Column(self.margins(course, test))
            case word:
                (node,) = b.nodes_of(course.operand)
                seen = self.proposition(test.presence[node])[:, 0].tolist()
                first: list[int | None] = [
                    old if old is not None or not flag else self._tick.time
                    for old, flag in zip(self._old[course], seen, strict=True)
                ]
                self._new[course] = first
                if word == "exists_now":
                    return column_of(seen)
                now = self._tick.time
                ages = zip(first, seen, strict=True)
                return column_of(
                    [(now - f) / NS if flag and f is not None else None for f, flag in ages]
                )

    def _prev(self, course: b.SignalCall, now: list[Any]) -> Column:
        here, gap = self._tick.number, self._all.gap
        self._new[course] = [None if value is None else (here, value) for value in now]
        known = (None if gap or o is None or o[0] != here - 1 else o[1] for o in self._old[course])
        return column_of(list(known))

    def _changed(self, course: b.SignalCall, now: list[Any]) -> Column:
        there, turns = self._all.there(course), b.is_angle(course.operand)
        told: list[float | None] = []
        kept: list[_Trail | None] = []
        for old, value in zip(self._old[course], now, strict=True):
            trail = _moved(old, value, self._tick.number, self._all.oldest)
            kept.append(trail)
            before = (
                next((point for point in trail[1] if point[0] == there), None) if trail else None
            )
            if value is None or before is None or trail is None:
                told.append(None)
                continue
            change = value - before[1]
            if turns:
                total, chain = trail[0][2:]
                change = total - before[2] if chain <= there else wrapped(change)
            told.append(change)
        self._new[course] = kept
        return column_of(told)

    def _over(self, course: b.SignalCall, now: list[Any]) -> Column:
        oldest, tick = self._all.window(course), self._tick
        self._new[course] = [
            next_window(course.word, old, value, tick, oldest)
            for old, value in zip(self._old[course], now, strict=True)
        ]
        return column_of([window_value(course.word, one) for one in self._new[course]])

    def _run_now(self, course: b.SignalCall, flags: list[bool]) -> Column:
        tick, gap = self._tick, self._all.gap
        self._new[course] = [
            (old if old is not None and not gap else tick) if flag else None
            for old, flag in zip(self._old[course], flags, strict=True)
        ]
        return column_of([self._length(course, start, 1) for start in self._new[course]])

    def _since_true(self, course: b.SignalCall, flags: list[bool]) -> Column:
        self._new[course] = [
            self._tick if flag else old for old, flag in zip(self._old[course], flags, strict=True)
        ]
        known = self._new[course]
        return column_of([None if at is None else self._length(course, at, 0) for at in known])

    def _length(self, course: b.SignalCall, start: Tick | None, more: int) -> float:
        if start is None:
            return 0
        if course.frames:
            return self._tick.number - start.number + more
        return (self._tick.time - start.time) / NS


_Point = tuple[int, float, float, int]
"""Known angle in a frame: frame number, value, total turn, and start of the known run."""

_Trail = tuple[_Point, tuple[_Point, ...]]
"""Last known point of an angle, and the earlier points still needed."""


def _moved(old: _Trail | None, value: float | None, here: int, oldest: int) -> _Trail | None:
    """Return an angle history extended by the value of one frame."""
    points = old[1] if old is not None else ()
    if points and points[0][0] < oldest:
        points = tuple(point for point in points if point[0] >= oldest)
    if value is None:
        return (old[0], points) if old is not None else None
    total, chain = 0.0, here
    if old is not None:
        number, before, total, since = old[0]
        if number == here - 1:
            total, chain = total + wrapped(value - before), since
    point = here, value, total, chain
    return point, (*points, point)


def column_of(values: list[Any]) -> Column:
    """Return a column (B, 1) with one value per binding. ``None`` means unknown."""
    known = [value is not None for value in values]
    like = next((value for value in values if value is not None), 0.0)
    empty = "" if isinstance(like, str) else type(like)()
    told = np.array([empty if value is None else value for value in values])
    return Column(told[:, None], np.array(known, np.bool_)[:, None])


# Truth of bindings in a frame: one bit per atom and test of a plan ------------------------------


class Valuation:
    """Truth values of the atoms and tests of a plan, for the known bindings.

    Parameters
    ----------
    plan : Plan
    variables : tuple of str
        Variables of the bindings, in order.
    questions : QueryCache
        Query cache; the queries of the plan are added.
    pulse : StreamClock
    bridge : bool
        True to ignore gaps.

    Attributes
    ----------
    lattice : Lattice
    bits : dict of str to int
        Atom or test → its bit.
    begun : Memory
        Memory before the first frame.
    columns : dict of str to Column
        Values of the tests in the last frame by name: (B, 1) or (1, 1), in the order of the bindings.
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
        self._questions = questions
        self.lattice = Lattice(len(variables))
        self._courses = SignalState(plan, pulse, bridge=bridge)
        self._measured = bool(plan.tests)
        self.begun = self._courses.begun
        self.columns: dict[str, Column] = {}
        self.bits = {name: 1 << number for number, name in enumerate([*plan.atoms, *plan.tests])}
        asked = {
            name: (questions.add(ask), tuple(map(variables.index, ask.variables)))
            for name, ask in plan.asks.items()
        }
        self._atoms = [(self.bits[name], *asked[name]) for name in plan.atoms]
        self._signals = {name: asked[name] for name in plan.signals}
        self._states = plan.states if isinstance(plan, CheckPlan) else {}
        self._asked = asked

    def read(
        self,
        held: Iterable[Partial],
        memory: Callable[[Partial], Memory | None],
        *,
        closed: bool = False,
    ) -> tuple[dict[Partial, int], Mapping[Partial, Memory]]:
        """Process the next frame. Its query results must be ready.

        Parameters
        ----------
        held : iterable of Partial
            Bindings with an entry from earlier frames.
        memory : function
            Function that returns the memory of a binding. ``None`` means no longer needed.
        closed : bool
            True if ``held`` is closed, so that only new bindings need unions.

        Returns
        -------
        letters : dict of Partial to int
            Letters of all bindings with an entry now; closed under union.
        memories : mapping of Partial to Memory
            New memory of each binding; empty without memory.
        """
        told = self._told()
        lattice = self.lattice
        new = [*told, *self._told_signals()]
        rows = lattice.closed(new, held) if closed else lattice.closed([*held, *new])
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
        """Return the true atoms as bits, for each partial binding."""
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
                if value is not None or self._states:
                    yield self.lattice.placed(key, places)

    def _state(self, name: str, rows: list[Partial], letters: Mapping[Partial, int]) -> Column:
        """Return 0 where a value is known, and 1 where it is unknown. An absent value is masked."""
        of, doubt = self._states[name]
        if of is None:
            return column_of([0.0] * len(rows))
        number, places = self._asked[of.name]
        answers = self._questions.answers[number]
        bit = 0 if doubt is None else self.bits[doubt]
        there = (tuple(row[p] for p in places) in answers for row in rows)
        return column_of(
            [
                float(bool(letters[row] & bit)) if t else None
                for row, t in zip(rows, there, strict=True)
            ]
        )

    def _measure(
        self,
        rows: list[Partial],
        letters: dict[Partial, int],
        memory: Callable[[Partial], Memory | None],
    ) -> dict[Partial, Memory]:
        """Set the bits of true tests for each binding, and return the new memory of each binding."""
        self._courses.step()
        columns: dict[str, Bools] = {}

        def atom(name: str) -> Bools:
            if name not in columns:
                bit = self.bits[name]
                columns[name] = np.array([bool(letters[row] & bit) for row in rows], np.bool_)
            return columns[name]

        def signal(one: Ask) -> Column:
            if one.name in self._states:
                return self._state(one.name, rows, letters)
            number, places = self._signals[one.name]
            answers: Mapping[Partial, object] = self._questions.answers[number]  # type: ignore[assignment]
            return column_of([answers.get(tuple(row[p] for p in places)) for row in rows])

        tests, memories = self._courses.values([memory(row) or () for row in rows], atom, signal)
        self.columns = tests
        for name, column in tests.items():
            bit = self.bits[name]
            true = np.broadcast_to(column.true[:, 0], len(rows)).tolist()
            for row, flag in zip(rows, true, strict=True):
                if flag:
                    letters[row] |= bit
        return dict(zip(rows, memories, strict=True))
