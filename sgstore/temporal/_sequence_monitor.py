"""Online monitor of one ``MATCH`` or sequence, and the events that it reports."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import TextSpan
from sgstore.lang.ir import (
    BoundStep,
    OverMatch,
    Query,
    ReturnColumn,
    StepLink,
    StepTime,
    StepWay,
    walk,
)
from sgstore.model.world import seconds_of
from sgstore.temporal._binding_truth import Valuation
from sgstore.temporal._formula import And, Formula
from sgstore.temporal._joint_bindings import written
from sgstore.temporal._match_values import AT_FRAME, ReturnedValues
from sgstore.temporal._match_values_monitor import MatchValues
from sgstore.temporal._plan import asks_of_steps, plan_of_steps, tied_in_steps
from sgstore.temporal._progression import Past, Progression, ProgressionFrame, Term
from sgstore.temporal._valuation import NEVER, BindingTable, Partial

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from sgstore.lang.ir import BoundHold
    from sgstore.temporal._signal_state import StreamClock
    from sgstore.temporal._valuation import Key, Memory, NodeNames, QueryCache

Needs = bool | tuple[tuple[Partial, Term], ...]
"""State of a condition: True, False, or terms. The condition becomes true with any of the terms."""


@dataclass(slots=True)
class Run:
    """Series of consecutive frames without a gap in which a sequence step matches.

    Attributes
    ----------
    number : int
        Number of the first frame.
    last : int
        Number of the last frame so far.
    over : bool
        True if the run has ended.
    """

    number: int
    last: int
    over: bool = False


@dataclass(frozen=True, slots=True)
class StepFrame:
    """Frame in which a sequence step matches.

    Attributes
    ----------
    number, time : int
        Number and time (ns) of the frame.
    gap : bool
        True if a gap lies before the frame.
    run : Run
    """

    number: int
    time: int
    gap: bool
    run: Run

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of three frames: this one, and the first and last of its run of matching frames.

        The last frame is absent while the run continues.
        """
        return (self.number, self.run.number, *([self.run.last] if self.run.over else []))


class StepState:
    """State of a sequence step for one combination of nodes: frames that match, and frames still undecided.

    Parameters
    ----------
    pulse : StreamClock
        Clock, updated with each frame before this object.
    hold : BoundHold, optional
        Required duration of the step.

    Attributes
    ----------
    places : list of StepFrame
        Stored frames, ascending.
    open : deque of Needs
        Open conditions of the undecided frames, earliest first.
    """

    def __init__(self, pulse: StreamClock, hold: BoundHold | None = None) -> None:
        self._pulse, self._hold = pulse, hold
        self.places: list[StepFrame] = []
        self.open: deque[Needs] = deque()
        self._queue: deque[tuple[int, int, bool]] = (
            deque()
        )  # number, time, and gap before each frame
        self._run: Run | None = None
        self._waiting: list[StepFrame] = []
        self._start = (0, 0)
        self._fits = True

    @property
    def idle(self) -> bool:
        """True if the state can be deleted: it has no stored frame and no current run of frames."""
        return not (self.places or self._queue or self._run)

    @property
    def oldest(self) -> int:
        """Number of the oldest frame that the state still needs; :data:`NEVER` without a frame."""
        runs = [place.run.number for place in self.places[:1]]
        runs += [self._run.number] if self._run is not None else []
        return min([*runs, self.undecided])

    @property
    def undecided(self) -> int:
        """Number of the first frame that needs later frames to decide if the step matches; or :data:`NEVER`."""
        if self._waiting:
            return self._waiting[0].number
        return self._queue[0][0] if self._queue else NEVER

    def frames(self) -> Iterator[int]:
        """Yield the numbers of the stored frames of the step, and of the ends of their runs of frames."""
        for place in (*self.places, *self._waiting):
            yield from place.ends
        if self._run is not None:
            yield self._run.number
        yield from (number for number, _, _ in self._queue)

    def ask(self, holds: Needs, *, gap: bool) -> None:
        """Add the next frame in which the step may match. ``holds``: its conditions on later frames."""
        self._queue.append((self._pulse.tick.number, self._pulse.tick.time, gap))
        self.open.append(holds)

    def decide(self, needs: list[Needs]) -> None:
        """Decide if the step matches in frames that are undecided so far. ``needs``: updated conditions."""
        self.open = deque(needs)
        while self.open and isinstance(self.open[0], bool):
            number, time, gap = self._queue.popleft()
            holds = self.open.popleft()
            if gap or not holds:
                self._end()
            if holds:
                self._extend(number, time, gap=gap)

    def _extend(self, number: int, time: int, *, gap: bool) -> None:
        if self._run is None:
            self._run = Run(number, number)
            self._start = number, time
            self._fits = self._hold is None
        self._run.last = number
        self._waiting.append(StepFrame(number, time, gap, self._run))
        growing = self._hold is not None and self._hold.comparison in {">=", ">"}
        self._fits = self._fits or (growing and self._long())
        if self._fits:
            self._flush()

    def _flush(self) -> None:
        self.places += self._waiting
        self._waiting = []

    def _long(self) -> bool:
        """True if the current run of matching frames is as long as the step requires."""
        if self._hold is None:
            return True
        last = self._waiting[-1]
        length = last.time - self._start[1] + (self._pulse.period if self._hold.inclusive else 0)
        if self._hold.length.frames:
            length = last.number - self._start[0] + 1
        return self._hold.fits(length, self._pulse.tick.tolerance)

    def _end(self) -> None:
        if self._waiting and self._long():
            self._flush()
        self._waiting = []
        if self._run is not None:
            self._run.over = True
        self._run = None

    def finish(self) -> None:
        """End the trace: decide for each waiting frame if the step matches there."""
        self.decide([n if isinstance(n, bool) else any(t.ended for _, t in n) for n in self.open])
        self._end()


Binding = dict[str, int]
"""Variable → node."""


def joined(one: Binding, names: tuple[str, ...], key: Key, apart: frozenset[str]) -> Binding | None:
    """Merge the nodes of two matches. Return None for a conflict, or if nodes that must differ are equal."""
    both = dict(one)
    for name, node in zip(names, key, strict=True):
        known = both.get(name)
        if known is None:
            others = (v for v, n in one.items() if n == node and v in apart)
            if name in apart and any(written(v) != written(name) for v in others):
                return None
            both[name] = node
        elif known != node:
            return None
    return both


@dataclass(frozen=True, slots=True)
class FrameTime:
    """Number and times of a frame in an online monitor.

    Attributes
    ----------
    seq : int
        Frame number, from 0.
    time_ns : int
        Simulation time.
    t : float
        Seconds since the first frame.
    """

    seq: int
    time_ns: int
    t: float


@dataclass(frozen=True, slots=True)
class MonitorEvent:
    """Event that an online monitor reports at a frame, such as a match or a violation.

    Attributes
    ----------
    kind : str
        ``violated``: a violation begins at ``start``; ``kept again``: a violation ended at ``end``; ``found``:
        a pattern matches.
    name : str
        Name of the check or pattern.
    told : FrameTime
        Frame that triggered the event.
    start, end : Moment
        First and last frame of the event. A current violation has its first frame in both; a sequence has the
        frames of its first and last step.
    nodes : mapping of str to int
        Node ids by variable.
    names : mapping of str to str
        Entity names by variable.
    steps : tuple of FrameTime
        For a sequence: frame of each occurring step.
    at_end : bool
        True if only the trace end caused the violation.
    values : mapping of str to value
        Returned values of a match or of an ended violation: aggregates, and times of its steps.
    """

    kind: str
    name: str
    told: FrameTime
    start: FrameTime
    end: FrameTime
    nodes: Mapping[str, int]
    names: Mapping[str, str]
    steps: tuple[FrameTime, ...] = ()
    at_end: bool = False
    values: Mapping[str, Any] = field(default_factory=dict[str, "Any"])


FAILED: Final = "failed"
OPEN: Final = "open"
Ways = tuple[StepFrame, ...] | str
"""Frames of the remaining steps; :data:`FAILED` if there are none; :data:`OPEN` if not yet known."""

FoundMatch = tuple[StepWay, Binding, tuple[StepFrame, ...]]
"""Match of a sequence: alternative, binding, and one frame for each step."""


class SequenceMonitor:
    """Online monitor of one pattern or sequence over one trace.

    Parameters
    ----------
    name : str
    query : Query
    questions : QueryCache
        Query cache; the queries of the pattern are added.
    pulse : StreamClock
        Clock, updated with each frame before this object.
    """

    def __init__(self, name: str, query: Query, questions: QueryCache, pulse: StreamClock) -> None:
        self.name, self.query = name, query
        self._questions, self._pulse = questions, pulse
        one = BoundStep(query.scope, (), None, absent=False, span=TextSpan(0, 0))
        self._steps: Sequence[BoundStep] = query.steps or (one,)
        self._asked = query.ways if query.steps else (StepWay((0,), (0,), ()),)
        self._named = _named(query)
        nodes, edges = tied_in_steps(query)
        self._tied = frozenset({*self._named, *nodes})
        self._edges = frozenset({*(e.key for e in query.scope.edges if e.named), *edges})
        if query.stages:
            bound = (*self._named, *sorted(self._edges))
            self._asks = [(questions.add_parts(query, bound), bound)]
        else:
            asks = asks_of_steps(query, self._steps, self._tied)
            self._asks = [(questions.add(ask), ask.columns) for ask in asks]
        self._conditions = _Conditions(query, self._steps, questions, pulse)
        self._columns = [self._projected(number) for number in range(len(self._steps))]
        self._held: list[dict[Key, StepState]] = [{} for _ in self._steps]
        # The parts already check which nodes must differ. Several nodes may be absent.
        differ = query.injective and not query.stages
        self._apart = self._tied if differ else frozenset[str]()
        self._told: dict[tuple[int, ...], int] = {}
        self._over: set[tuple[int, ...]] = set()
        self._names: dict[int, str] = {}
        self._ended = False
        self._happen = {way: way.happen for way in self._asked}
        having = query.result.having_of_match("a monitor reports single matches")
        self._returned = ReturnedValues(_returned(query), "last", having)
        plan, bridge = partial(plan_of_steps, query, self._steps), query.gaps == "bridge"
        parts = self._returned.parts
        self._values = MatchValues(parts, plan, questions, pulse, bridge=bridge)
        self._pending: list[FoundMatch] = []

    # Online, frame by frame

    def step(self, here: FrameTime, people: NodeNames) -> list[MonitorEvent]:
        """Process the next frame of the trace, and return the new events.

        The query results of the frame must be ready.
        """
        self._conditions.step()
        gap = self._pulse.breaks(bridge=self.query.gaps == "bridge")
        for number in range(len(self._steps)):
            now = self._now(number)
            held = self._held[number]
            for key in now:
                if key not in held:
                    held[key] = StepState(self._pulse, self._steps[number].hold)
                    self._names |= {n: people.name(n) for n in key if n in people}
            for key, one in held.items():
                one.ask(now.get(key, False), gap=gap)
            self._decide(number)
        self._values.step()
        return self._found(here)

    def _now(self, number: int) -> dict[Key, Needs]:
        """Return the matches of a step in this frame: nodes → True, or the conditions still open."""
        question, variables = self._asks[number]
        places = [variables.index(name) for name in self._columns[number]]
        answers = self._questions.answers[question]
        if not self._steps[number].when:
            return dict.fromkeys((tuple(key[p] for p in places) for key in answers), True)
        found: defaultdict[Key, list[tuple[Partial, Term]]] = defaultdict(list)
        for key in answers:
            row = self._conditions.row(dict(zip(variables, key, strict=True)))
            term = self._conditions.now(number, row)
            found[tuple(key[p] for p in places)].append((row, term))
        return {key: settled(needs) for key, needs in found.items()}

    def _projected(self, number: int) -> tuple[str, ...]:
        variables = self._asks[number][1]
        return tuple(n for n in variables if n in self._tied or n in self._edges)

    def _decide(self, number: int) -> None:
        for key, one in list(self._held[number].items()):
            *before, latest = one.open
            needs = [self._conditions.resolved(need) for need in before]
            one.decide([*needs, latest])
            if one.idle:
                del self._held[number][key]

    # Matches

    def _found(self, here: FrameTime) -> list[MonitorEvent]:
        found: list[MonitorEvent] = []
        self._pending += self._certain()
        for one in list(self._pending):
            way, _, places = one
            if self._ended or all(places[n].run.over for n in self._lasting[way]):
                self._pending.remove(one)
                found += self._events(one, here)
        self._forget()
        if self._returned.parts:
            self._values.forget(self._frames())
        return found

    def _certain(self) -> Iterator[FoundMatch]:
        """Yield the matches of the sequence that became certain with this frame."""
        (way,) = self._asked
        if all(self._held[number] for number in self._happen[way]):
            for binding in self._bindings({}, self._happen[way]):
                for places in self._matches(way, binding):
                    yield way, binding, places

    @cached_property
    def _lasting(self) -> dict[StepWay, frozenset[int]]:
        """For each alternative, the steps that must have stopped matching before a match is reported."""
        return {way: frozenset(self._lasting_in(happen)) for way, happen in self._happen.items()}

    def _lasting_in(self, happen: tuple[int, ...]) -> Iterator[int]:
        parts = self._returned.parts
        for part in parts:
            if part.start == part.end and part.start in happen:
                yield happen.index(part.start)
        held = self._steps[happen[-1]].hold is not None or not self.query.spans
        if held and any(part.start is None for part in parts):
            yield len(happen) - 1

    def _frames(self) -> Iterator[int]:
        """Yield the numbers of the stored frames at which a step can begin or end in a match."""
        for number in frozenset[int]().union(*self._happen.values()):
            for one in self._held[number].values():
                yield from one.frames()
        for _, _, places in self._pending:
            for place in places:
                yield from place.ends

    def _bindings(self, binding: Binding, steps: Sequence[int]) -> Iterator[Binding]:
        """Yield the combinations of nodes with which every step of the sequence has matching frames."""
        if not steps:
            yield binding
            return
        for key, held in self._agreeing(steps[0], binding):
            if held.places:
                both = joined(binding, self._columns[steps[0]], key, self._apart)
                if both is not None:
                    yield from self._bindings(both, steps[1:])

    def _agreeing(self, number: int, binding: Binding) -> list[tuple[Key, StepState]]:
        """Return the node combinations of a step that agree with the given nodes, and the state of each."""
        names, held = self._columns[number], self._held[number]
        if all(name in binding for name in names):
            key = tuple(binding[name] for name in names)
            return [(key, held[key])] if key in held else []
        known = [(place, binding[name]) for place, name in enumerate(names) if name in binding]
        return [
            (key, one)
            for key, one in held.items()
            if all(key[place] == node for place, node in known)
        ]

    def _matches(self, way: StepWay, binding: Binding) -> Iterator[tuple[StepFrame, ...]]:
        held = self._of(0, binding)
        key = tuple(binding[name] for name in sorted(binding))
        waiting: int | None = None
        for place in held.places if held is not None else ():
            run = place.run.number
            if run <= self._told.get(key, -1) or run == waiting or key in self._over:
                continue
            ways = self._ways(way, 0, place, binding)
            if ways == OPEN:
                waiting = run
            elif isinstance(ways, tuple):
                self._told[key] = run
                if self.query.policy == "first":
                    self._over.add(key)
                yield ways

    def _of(self, number: int, binding: Binding) -> StepState | None:
        return self._held[number].get(tuple(binding[name] for name in self._columns[number]))

    def _ways(self, way: StepWay, at: int, place: StepFrame, binding: Binding) -> Ways:
        """Return the frames of the remaining steps, this frame first; ``OPEN`` if later frames decide."""
        steps, following = way.steps, at + 1
        if following == len(steps):
            return (place,)
        link, absent = way.links[at], None
        if self._steps[steps[following]].absent:
            absent = self._of(steps[following], binding) or StepState(self._pulse)
            if following + 1 == len(steps):
                return self._unfollowed(place, link, absent)
            link, following = way.links[following], following + 1
        held = self._of(steps[following], binding)
        stop = (
            next((a.number for a in absent.places if a.number > place.number), NEVER)
            if absent
            else NEVER
        )
        found = self._reached(place, link, held, stop)
        latest = self.query.policy == "longest"
        open_end = not self._closed(place, link, held, stop)
        if latest and open_end:
            return OPEN
        for other in reversed(found) if latest else found:
            if absent is not None and absent.undecided < other.number:
                return OPEN
            rest = self._ways(way, following, other, binding)
            if rest != FAILED:
                return rest if isinstance(rest, str) else (place, *rest)
        return OPEN if open_end else FAILED

    def _reached(
        self, place: StepFrame, link: StepLink, held: StepState | None, stop: int
    ) -> list[StepFrame]:
        """Return the frames of the next step that meet its time relation to the previous step."""
        found = [p for p in held.places if p.number <= stop] if held is not None else []
        first = place.number
        match link.kind:
            case "while":
                return [p for p in found if p.number == first]
            case "immediately":
                return [p for p in found if p.number == first + 1 and not p.gap]
            case "until":
                last = place.run.last
                return [
                    p
                    for p in found
                    if first < p.number <= last or (p.number == last + 1 > first and not p.gap)
                ]
            case "then":
                by, jump = self._pulse.tick.tolerance, self._pulse.jump_after(place.time)
                found = [p for p in found if first < p.number < jump]
                return [p for p in found if _within(link, place, p, by)]

    def _closed(  # noqa: PLR0911 - a case each
        self, place: StepFrame, link: StepLink, held: StepState | None, stop: int
    ) -> bool:
        """True if no later frame of the next step can meet its time relation to the previous step."""
        if self._ended:
            return True
        tick = self._pulse.tick
        undecided = min(held.undecided if held is not None else NEVER, tick.number + 1)
        if stop < undecided:
            return True
        match link.kind:
            case "while":
                return undecided > place.number
            case "immediately":
                return undecided > place.number + 1
            case "until":
                return place.run.over and undecided > place.run.last + 1
            case "then":
                within = link.within
                if undecided >= self._pulse.jump_after(place.time):
                    return True
                if within is None:
                    return False
                if within.frames:
                    return undecided > place.number + within.amount
                beyond = tick.time >= place.time + within.amount + tick.tolerance
                return beyond and (held is None or held.undecided == NEVER)

    def _unfollowed(self, place: StepFrame, link: StepLink, absent: StepState) -> Ways:
        plain = replace(link, kind="then", after=None)
        if self._reached(place, plain, absent, NEVER):
            return FAILED
        return (place,) if self._closed(place, plain, absent, NEVER) else OPEN

    def _events(self, found: FoundMatch, here: FrameTime) -> Iterator[MonitorEvent]:
        """Yield the event that reports a match, unless its ``HAVING`` condition is false."""
        way, binding, places = found
        happen = self._happen[way]
        steps = tuple(self._moment(place) for place in places)
        bound: dict[str, Any] = binding  # parts may have absent nodes, and numbered keys
        known = {key: node for key, node in bound.items() if node is not None}
        nodes = {key.partition("~")[0]: n for key, n in known.items() if key in self._named}
        names = {name: self._names.get(node, str(node)) for name, node in nodes.items()}

        def part(value: OverMatch) -> Any:
            if not {value.start, value.end} <= {None, AT_FRAME, *happen}:
                return None  # belongs to a step of another alternative
            return self._values.value(value, binding, self._span(value, happen, places))

        def seconds(step: int) -> float | None:
            return steps[happen.index(step)].t if step in happen else None

        values = self._returned.told(part, seconds)
        if values is None:
            return
        if self.query.stages:
            question, keys = self._asks[0]
            values = self._questions.answers[question][tuple(binding[name] for name in keys)]
        about = here, steps[0], steps[-1], nodes, names, steps
        yield MonitorEvent("found", self.name, *about, values=values)

    def _span(
        self, part: OverMatch, happen: tuple[int, ...], ways: tuple[StepFrame, ...]
    ) -> tuple[int, int]:
        """Return the first and last frame of a match, or of its steps in an ``OVER`` clause."""
        if part.start == AT_FRAME:
            return ways[-1].number, ways[-1].number
        if part.start is None or part.end is None:
            last, whole = ways[-1], not self.query.spans
            held = whole or self._steps[happen[-1]].hold is not None
            first = last.run.number if whole else ways[0].number
            return first, last.run.last if held else last.number
        one, other = (ways[happen.index(step)] for step in (part.start, part.end))
        if part.start == part.end:
            return one.run.number, one.run.last
        return one.number, other.number

    def _moment(self, place: StepFrame) -> FrameTime:
        time = self._pulse.told(place.time)
        return FrameTime(place.number, time, seconds_of(time - self._pulse.start))

    # Stored data

    def _forget(self) -> None:
        """Delete the stored frames of steps that no later match can use."""
        first = self._held[0]
        for key, one in first.items():
            if one.places:
                one.places = self._kept(key, one.places)
        if self._told:
            runs = min((one.oldest for one in first.values()), default=NEVER)
            self._told = {key: run for key, run in self._told.items() if run >= runs}
        for number in range(1, len(self._held)):
            oldest, shared = self._oldest(number)
            for key, one in self._held[number].items():
                begun = oldest.get(tuple(key[place] for place in shared), NEVER)
                while one.places and one.places[0].number <= min(
                    begun - 1, self._pulse.tick.number - 2
                ):
                    one.places.pop(0)

    def _oldest(self, number: int) -> tuple[dict[Key, int], list[int]]:
        """For each combination of shared nodes, return the first frame at which a match can begin.

        The nodes are those of the first step and a given step.

        Also return the columns of the other step with these nodes.
        """
        names, columns = self._columns[0], self._columns[number]
        common = [name for name in columns if name in names]
        own = [names.index(name) for name in common]
        found: dict[Key, int] = {}
        for key, one in self._held[0].items():
            begun = min([one.undecided, *(place.number for place in one.places[:1])])
            both = tuple(key[place] for place in own)
            found[both] = min(begun, found.get(both, NEVER))
        return found, [columns.index(name) for name in common]

    def _kept(self, key: Key, places: list[StepFrame]) -> list[StepFrame]:
        if not self.query.links:
            return [p for p in places if p.number >= self._pulse.tick.number]
        link, absent = self.query.links[0], self._steps[1].absent
        open_ended = link.kind == "until" or (link.kind == "then" and link.within is None)
        if open_ended and not absent and self.query.policy != "longest":
            # Each continuation of a later frame of a run also continues its first frame.
            runs: dict[int, StepFrame] = {}
            for place in places:
                runs.setdefault(place.run.number, place)
            places = list(runs.values())
        binding = dict(zip(self._columns[0], key, strict=True))
        return [p for p in places if self._alive(self._asked[0], 0, binding, p)]

    def _alive(  # noqa: PLR0911 - a case each
        self, way: StepWay, at: int, binding: Binding, place: StepFrame
    ) -> bool:
        """True if a later frame can still continue a sequence after the given frame."""
        following, steps = at + 1, way.steps
        if following == len(steps):
            return False
        link = way.links[at]
        if self._steps[steps[following]].absent:
            if any(held.undecided < NEVER for _, held in self._agreeing(steps[following], binding)):
                return True
            following += 1
            if following == len(steps):
                return not self._closed(place, replace(link, kind="then", after=None), None, NEVER)
            link = way.links[at + 1]
        if not self._closed(place, link, None, NEVER):
            return True
        for key, held in self._agreeing(steps[following], binding):
            if not self._closed(place, link, held, NEVER):
                return True
            both = {**dict(zip(self._columns[steps[following]], key, strict=True)), **binding}
            if any(
                self._alive(way, following, both, other)
                for other in self._reached(place, link, held, NEVER)
            ):
                return True
        return False

    def finish(self, here: FrameTime) -> list[MonitorEvent]:
        """End the trace, and return the events that are certain only then."""
        self._ended = True
        for held in self._held:
            for one in held.values():
                one.finish()
        return self._found(here)


def _returned(query: Query) -> list[ReturnColumn]:
    """Return the ``RETURN`` columns that depend on several frames; none if the query has aggregates."""
    if query.result.aggregated:
        return []
    return [
        column
        for column in query.result.columns
        if any(isinstance(part, OverMatch | StepTime) for part in walk(column.value))
    ]


def _named(query: Query) -> tuple[str, ...]:
    return tuple(
        sorted(
            key for key, node in query.scope.nodes.items() if node.role == "named" or query.steps
        )
    )


def _within(link: StepLink, place: StepFrame, other: StepFrame, tolerance: int) -> bool:
    """True if the time from one frame to another meets the time relation of two steps."""
    later = {True: other.number - place.number, False: other.time - place.time}
    slack = {True: 0, False: tolerance}
    after, within = link.after, link.within
    if after is not None and later[after.frames] < after.amount - slack[after.frames]:
        return False
    return within is None or later[within.frames] <= within.amount + slack[within.frames]


class _Conditions:
    """Conditions of sequence steps that need values of several frames."""

    def __init__(
        self, query: Query, steps: Sequence[BoundStep], questions: QueryCache, pulse: StreamClock
    ) -> None:
        plan = plan_of_steps(query, steps)
        when = [And(tuple(map(plan.formula, step.when))) for step in steps]
        self._progression = Progression(And(tuple(when)))
        whole_formula = self._progression.formula
        assert isinstance(whole_formula, And)  # noqa: S101 - it was made so
        self._when: tuple[Formula, ...] = whole_formula.operands
        self._asked = [bool(step.when) for step in steps]
        self._variables = tuple(sorted({n for ask in plan.asks.values() for n in ask.variables}))
        bridge = query.gaps == "bridge"
        self._letters = Valuation(plan, self._variables, questions, pulse, bridge=bridge)
        self._pulse = pulse
        begun: tuple[Past, Memory] = self._progression.begun, self._letters.begun
        self._known = BindingTable(self._letters.lattice, begun)
        self._frames: dict[Partial, ProgressionFrame] = {}

    def step(self) -> None:
        """Update the conditions with the next frame. The query results of the frame must be ready."""
        if not any(self._asked):
            return
        known = self._known
        letters, memories = self._letters.read(known.held, lambda row: known.of(row)[1])
        shared: dict[tuple[Past, int], ProgressionFrame] = {}
        entries: dict[Partial, tuple[Past, Memory]] = {}
        self._frames = {}
        for row, letter in letters.items():
            past, _ = known.of(row)
            if (past, letter) not in shared:
                named = {n: bool(letter & self._letters.bits[n]) for n in self._progression.names}
                shared[past, letter] = ProgressionFrame(
                    self._progression, past, named, self._pulse.tick
                )
            frame = self._frames[row] = shared[past, letter]
            entries[row] = frame.past(), memories.get(row, ())
        known.keep(entries, lambda one, other: one == other)

    def row(self, nodes: Binding) -> Partial:
        """Return the nodes of a match in the order of the variables of the conditions."""
        return tuple(nodes.get(name) for name in self._variables)

    def now(self, number: int, row: Partial) -> Term:
        """Return the conditions on later frames under which a step matches with these nodes in this frame."""
        return self._frame(row).now(self._when[number])

    def resolved(self, needs: Needs) -> Needs:
        """Return the open conditions of an earlier frame, after this frame has decided some of them."""
        if isinstance(needs, bool):
            return needs
        return settled([(row, self._frame(row).resolved(term)) for row, term in needs])

    def _frame(self, row: Partial) -> ProgressionFrame:
        frames = self._frames
        return next(frames[w] for w in self._letters.lattice.wider(row) if w in frames)


def settled(needs: list[tuple[Partial, Term]]) -> Needs:
    """Return True if a condition is true, False if all are false, otherwise those that are still open."""
    if any(term.word == "true" for _, term in needs):
        return True
    left = tuple((row, term) for row, term in needs if term.word != "false")
    return left or False


_Group = tuple[int, "Key", int]
"""Group of matches of which only one counts: number of the first step, nodes, and run of frames."""

_Standing = tuple["StepWay", int, "Binding", "StepFrame"]
"""Incomplete match: alternative sequence, position of the step, nodes, and frame of the step."""

_ANY = -1
"""Value of step and run in a group if only the first match of each binding counts."""


def sequence_monitor(
    name: str, query: Query, questions: QueryCache, pulse: StreamClock
) -> SequenceMonitor:
    """Return the online monitor for a pattern, a sequence, or a sequence with alternatives."""
    kind = ExpressionMonitor if query.alternatives else SequenceMonitor
    return kind(name, query, questions, pulse)


class ExpressionMonitor(SequenceMonitor):
    """Online monitor of a sequence with alternatives over one trace; see :class:`SequenceMonitor`."""

    def __init__(self, name: str, query: Query, questions: QueryCache, pulse: StreamClock) -> None:
        super().__init__(name, query, questions, pulse)
        self._best: dict[_Group, FoundMatch] = {}
        self._done: dict[tuple[int, Key], set[int]] = {}
        self._written = {way: place for place, way in enumerate(self._asked)}

    def _certain(self) -> Iterator[FoundMatch]:
        for way in self._asked:
            if all(self._held[number] for number in self._happen[way]):
                for binding in self._bindings({}, self._happen[way]):
                    self._see(way, binding)
        order = sorted(self._best.items(), key=lambda one: (_frames(one[1]), one[0]))
        for group, found in order:
            if self._ended or self._decided(group, found):
                del self._best[group]
                self._done.setdefault(group[:2], set()).add(group[2])
                yield found

    def _group(self, way: StepWay, binding: Binding, run: int) -> _Group:
        told = tuple(binding[name] for name in self._named)
        if self.query.policy == "first":
            return _ANY, told, _ANY
        return way.steps[0], told, run

    def _see(self, way: StepWay, binding: Binding) -> None:
        """Find the matches of one alternative sequence with given nodes. Keep only the best for each start.

        Only the best match of each start is kept.
        """
        held, seen = self._of(way.steps[0], binding), set[int]()
        for place in held.places if held is not None else ():
            run = place.run.number
            group = self._group(way, binding, run)
            if run in seen or group[2] in self._done.get(group[:2], ()):
                continue
            places = self._ways(way, 0, place, binding)
            if isinstance(places, tuple):
                seen.add(run)
                found = way, binding, places
                known = self._best.get(group)
                if known is None or self._better(found, known):
                    self._best[group] = found

    def _better(self, one: FoundMatch, other: FoundMatch) -> bool:
        """True if the first of two matches is preferred.

        For equal frames, the first alternative of the query is preferred.
        """
        frames, known = _frames(one), _frames(other)
        place, written = self._written[one[0]], self._written[other[0]]
        if self.query.policy == "longest" and frames[0] == known[0]:
            return (frames, -place) > (known, -written)
        return (frames, place) < (known, written)

    def _decided(self, group: _Group, found: FoundMatch) -> bool:
        """True if a match is final: no later match can be preferred to it."""
        step, told, run = group
        bound, frames = dict(zip(self._named, told, strict=True)), _frames(found)
        for way in self._asked:
            first = way.steps[0]
            if step not in {_ANY, first}:
                continue
            before = self._written[way] < self._written[found[0]]
            for key, one in self._agreeing(first, bound):
                if one.undecided <= frames[0]:
                    return False
                both = {**bound, **dict(zip(self._columns[first], key, strict=True))}
                for place in one.places:
                    within = run in {_ANY, place.run.number} and place.number <= frames[0]
                    standing = way, 0, both, place
                    if within and self._may_win(standing, frames, before=before):
                        return False
        return True

    def _may_win(self, standing: _Standing, frames: tuple[int, ...], *, before: bool) -> bool:
        if self.query.policy == "longest":
            return self._alive(*standing)
        return self._overtakes(standing, frames, before=before)

    def _overtakes(self, standing: _Standing, frames: tuple[int, ...], *, before: bool) -> bool:
        *_, place = standing
        if place.number < frames[0]:
            return self._alive(*standing)
        return self._may_be_earlier(standing, frames, before=before)

    def _may_be_earlier(
        self, standing: _Standing, frames: tuple[int, ...], *, before: bool
    ) -> bool:
        """True if an incomplete match can still end before the complete match with the given frames."""
        way, at, binding, place = standing
        if at == len(way.links):
            return False  # an ended match is already known
        following, link, open_ended = self._next_step(way, at, binding, place)
        ends = following == len(way.steps)
        if ends or len(frames) == 1:  # a longer match is later
            return ends and open_ended and (before or len(frames) > 1)
        now, least = self._pulse.tick.number + 1, place.number + (link.kind != "while")
        if not self._closed(place, link, None, NEVER) and max(least, now) <= frames[1]:
            return True
        number = way.steps[following]
        for key, held in self._agreeing(number, binding):
            coming = max(least, min(held.undecided, now))
            if coming <= frames[1] and not self._closed(place, link, held, NEVER):
                return True
            both = {**dict(zip(self._columns[number], key, strict=True)), **binding}
            for other in self._reached(place, link, held, NEVER):
                if other.number > frames[1]:
                    break
                there = way, following, both, other
                if open_ended or self._overtakes(there, frames[1:], before=before):
                    return True
        return False

    def _next_step(
        self, way: StepWay, at: int, binding: Binding, place: StepFrame
    ) -> tuple[int, StepLink, bool]:
        """Return the index of the next required step of a sequence, and its time relation to the step before.

        The third result is True if a ``NOT MATCH`` between them is undecided.
        """
        following, link = at + 1, way.links[at]
        if not self._steps[way.steps[following]].absent:
            return following, link, False
        number = way.steps[following]
        undecided = any(held.undecided < NEVER for _, held in self._agreeing(number, binding))
        if following + 1 == len(way.steps):
            plain = replace(link, kind="then", after=None)
            return following + 1, link, undecided or not self._closed(place, plain, None, NEVER)
        return following + 1, way.links[following], undecided

    # Stored data

    def _forget(self) -> None:
        """Delete the stored frames of steps that no later match can use."""
        firsts = {way.steps[0] for way in self._asked}
        alive = {
            n: {key: self._followed(n, key, one.places) for key, one in self._held[n].items()}
            for n in firsts
        }
        begun = {
            n: {
                k: min([one.undecided, *(p.number for p in alive[n][k][:1])])
                for k, one in held.items()
            }
            for n, held in enumerate(self._held)
            if n in firsts
        }
        runs = min((one.oldest for n in firsts for one in self._held[n].values()), default=NEVER)
        waiting = min((group[2] for group in self._best), default=NEVER)
        if self.query.policy != "first":
            done = self._done.items()
            kept = {key: {run for run in told if run >= min(runs, waiting)} for key, told in done}
            self._done = {key: told for key, told in kept.items() if told}
        for n, held in enumerate(self._held):
            before = {way.steps[0] for way in self._asked if n in way.steps[1:]}
            for key, one in held.items():
                since = min((self._since(first, n, key, begun) for first in before), default=NEVER)
                low = min(since, self._pulse.tick.number - 1) if before else NEVER
                own = alive[n][key] if n in firsts else []
                own_ids = set(map(id, own))
                one.places = [p for p in one.places if p.number >= low or id(p) in own_ids]

    def _since(self, first: int, n: int, key: Key, begun: dict[int, dict[Key, int]]) -> int:
        """Return the first frame at which a match can begin that contains this step with these nodes."""
        names, columns = self._columns[first], self._columns[n]
        own = {name: node for name, node in zip(columns, key, strict=True) if name in names}
        places = [(names.index(name), node) for name, node in own.items()]
        found = (
            frame
            for known, frame in begun[first].items()
            if all(known[place] == node for place, node in places)
        )
        return min(found, default=NEVER)

    def _followed(self, n: int, key: Key, places: list[StepFrame]) -> list[StepFrame]:
        """Return the stored frames of a sequence's first step that can still be the start of a match."""
        binding = dict(zip(self._columns[n], key, strict=True))
        ways = [way for way in self._asked if way.steps[0] == n]
        found: list[StepFrame] = []
        runs: set[int] = set()
        for place in places:
            new, _ = place.run.number not in runs, runs.add(place.run.number)
            asked = (way for way in ways if new or not self._open_ended(way))
            if any(self._alive(way, 0, binding, place) for way in asked):
                found.append(place)
        return found

    def _open_ended(self, way: StepWay) -> bool:
        """True if only the first frame of each run of the first step counts: the next step has no time limit.

        A run is a series of frames in which the step matches.
        """
        if not way.links:
            return False
        link = way.links[0]
        unbounded = link.kind == "until" or (link.kind == "then" and link.within is None)
        absent = self._steps[way.steps[1]].absent
        return unbounded and not absent and self.query.policy != "longest"


def _frames(found: FoundMatch) -> tuple[int, ...]:
    return tuple(place.number for place in found[2])
