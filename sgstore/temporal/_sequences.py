"""Search for sequences in a store. It joins the matches of the steps over time, with arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import QueryError
from sgstore.lang.ir import Bound, OverMatch, Query, SignalCall, StepTime, is_formula
from sgstore.lang.operators import Column
from sgstore.lang.sql import ExternalRelation, Window, relation, value_text
from sgstore.matches import TooMuchError
from sgstore.model.frame_ids import BUCKET_BITS
from sgstore.model.world import JUMP_NS, seconds_of
from sgstore.temporal._formula import formula_text
from sgstore.temporal._joint_bindings import JoinedBindings, joined
from sgstore.temporal._match_values import Stretches, picked
from sgstore.temporal._offline import REMEDY, PlanValues, groups, traces, words
from sgstore.temporal._plan import (
    Test,
    asks_of_steps,
    hold_text,
    link_text,
    needs_text,
    plan_of_steps,
    sql_text,
    tied_in_steps,
    way_text,
)
from sgstore.temporal._runs import RunFinder
from sgstore.temporal._trace_group import TimedRelation, TraceGroup

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import BoundHold, Length, StepWay
    from sgstore.model.world import Bools, Ints
    from sgstore.store import StoreFile
    from sgstore.temporal._formula import Formula
    from sgstore.temporal._plan import Ask
    from sgstore.temporal._signal_values import Clock
    from sgstore.temporal._trace_group import JointClock, TraceReader

    Keys = NDArray[np.int64]


# A match has one frame per step, each within the bounds of the link before it. Each binding and each run of the
# first step has one match: among all that begin in the run, the one with the earliest frames, compared from the
# first step on.
#
# All frames of all bindings share one index, with space between bindings. So every step is one search in a
# sorted array.


@dataclass(frozen=True, slots=True)
class Leg:
    """Time relation of a step to the next one, with the frames of the next and of the forbidden step between.

    Attributes
    ----------
    kind : str
        ``then``, ``immediately``, ``until``, ``while``.
    after, within : Length or None
        Bounds of ``then``.
    absent : (R,) int64 or None
        Positions of an absent step, forbidden strictly between both steps.
    places : (R,) int64 or None
        Positions of the next step, ascending. ``None`` means no next step; the absent step must not occur up to
        ``within``.
    """

    kind: str
    after: Length | None
    within: Length | None
    absent: Ints | None
    places: Ints | None


class BindingLine:
    """Numbering of frames: frame i of node combination b has the position ``b * stride + i``.

    Parameters
    ----------
    clock : Clock or JointClock
    """

    def __init__(self, clock: Clock | JointClock) -> None:
        self.clock = clock
        self._periods = np.broadcast_to(clock.period, len(clock.times))
        self._tolerances = np.broadcast_to(clock.tolerance, len(clock.times))
        self.frames = len(clock.times)
        self.stride = self.frames + 1
        breaks = np.ones(self.stride, np.bool_)
        breaks[1 : self.frames] = clock.gap_before[1:]
        self._breaks = breaks
        jumps = np.flatnonzero(np.diff(clock.times) == JUMP_NS)
        lasts = np.append(jumps, self.frames - 1)
        self._lasts = lasts[
            np.searchsorted(jumps, np.arange(self.frames))
        ]  # before the clock jumps

    def frame(self, places: Ints) -> Ints:
        """Return the frame number of each position. See the class for positions."""
        return places % self.stride

    def run_ends(self, places: Ints) -> Ints:
        """Return, for each position, the last one of its run (consecutive frames), shape (R,)."""
        if not len(places):
            return places
        last = np.append(self._starts(places)[1:], True)
        ends = np.where(last, np.arange(len(places)), len(places))
        return places[np.minimum.accumulate(ends[::-1])[::-1]]

    def run_starts(self, places: Ints) -> Ints:
        """Return, for each position, the first one of its run (consecutive frames), shape (R,)."""
        if not len(places):
            return places
        return places[
            np.maximum.accumulate(np.where(self._starts(places), np.arange(len(places)), 0))
        ]

    def runs(self, places: Ints) -> Ints:
        """Return, for each position, the number of its run (consecutive frames), shape (R,)."""
        return np.cumsum(self._starts(places)) - 1

    def _starts(self, places: Ints) -> Bools:
        """Return a mask of the positions that start a run: they do not continue the position before."""
        starts = np.ones(len(places), np.bool_)
        follows = np.diff(places) == 1
        starts[1:] = ~follows | self._breaks[self.frame(places[1:])]
        return starts

    def held(self, places: Ints, hold: BoundHold) -> Ints:
        """Return the positions in runs of consecutive frames that last as long as the step requires."""
        if not len(places):
            return places
        runs = self.runs(places)
        first = np.flatnonzero(np.diff(runs, prepend=-1))
        last = np.append(first[1:], len(places)) - 1
        if hold.length.frames:
            length = last - first + 1
        else:
            times = self.clock.times
            length = times[self.frame(places[last])] - times[self.frame(places[first])]
            length = length + (self._periods[self.frame(places[first])] if hold.inclusive else 0)
        tolerances: Any = self._tolerances[self.frame(places[first])]
        return places[hold.fits(length, tolerances)[runs]]

    def window(self, leg: Leg, places: Ints) -> tuple[Ints, Ints]:
        """For each position of a step, return the first and the last allowed position of the next step."""
        frame = self.frame(places)
        base = places - frame
        if leg.kind == "while":
            return places, places
        if leg.kind == "then":
            low = np.maximum(self._moved(frame, leg.after, "left"), frame + 1)
            high = np.minimum(self._moved(frame, leg.within, "right"), self._lasts[frame])
        else:
            low, high = frame + 1, frame + 1
            if leg.kind == "until":
                high = self.run_ends(places) - base + 1
            high = np.where(self._breaks[high], high - 1, high)  # there is a gap, or no frame
        low, high = base + low, base + np.minimum(high, self.frames - 1)
        if leg.absent is not None and len(leg.absent):
            following = np.searchsorted(leg.absent, places, "right")
            inside = np.minimum(following, len(leg.absent) - 1)
            beyond = np.iinfo(np.int64).max
            high = np.minimum(
                high, np.where(following < len(leg.absent), leg.absent[inside], beyond)
            )
        return low, high

    def _moved(self, frame: Ints, by: Length | None, side: str) -> Ints:
        """Return, for each frame, the frame that is later by a given duration. None means no limit.

        ``left`` means the first frame at or after it, ``right`` the last frame within it.
        """
        times = self.clock.times
        if by is None:
            return frame if side == "left" else np.full_like(frame, self.frames - 1)
        if by.frames:
            return frame + by.amount
        tolerance = self._tolerances[frame]
        amount = np.maximum(by.amount + (tolerance if side == "right" else -tolerance), 0)
        then = np.minimum(times[frame], np.iinfo(np.int64).max - amount) + amount
        return (
            np.searchsorted(times, then, "left")
            if side == "left"
            else np.searchsorted(times, then, "right") - 1
        )


def matches_of(line: BindingLine, first: Ints, legs: Sequence[Leg], policy: str) -> Ints:
    """Return the matches of a sequence: for each match, the positions of its steps.

    Parameters
    ----------
    line : BindingLine
    first : (R,) int64
        Positions of the first step, ascending.
    legs : sequence of Leg
    policy : str
        ``all``; ``longest``: among matches that begin at the earliest frame, the one with the latest further
        frames, compared from the second step on; ``first``: only the first match of each binding.

    Returns
    -------
    (M, n) int64
        Positions of the occurring steps, ordered by the first.
    """
    steps = [first, *(leg.places for leg in legs if leg.places is not None)]
    onward: list[tuple[Ints, Ints]] = []
    possible = steps[-1]
    rest = list(legs)
    if rest and rest[-1].places is None:
        possible = _unfollowed(line, rest.pop(), possible)
    for leg, here in zip(reversed(rest), reversed(steps[:-1]), strict=True):
        low, high = line.window(leg, here)
        found, fits = _next(possible, low, high, latest=policy == "longest")
        onward.insert(0, (here[fits], found[fits]))
        possible = here[fits]
    chosen = _one_a_run(line, first, possible)
    if policy == "first" and len(chosen):
        chosen = chosen[np.diff(chosen // line.stride, prepend=-1) != 0]
    columns = [chosen]
    for here, found in onward:
        columns.append(found[np.searchsorted(here, columns[-1])])
    return np.stack(columns, axis=1)


def _next(possible: Ints, low: Ints, high: Ints, *, latest: bool) -> tuple[Ints, Bools]:
    """Return the first (or last) possible position in each window, and a mask of windows that have one."""
    if not len(possible):
        return low, np.zeros(len(low), np.bool_)
    if latest:
        at = np.searchsorted(possible, high, "right") - 1
        found = possible[np.clip(at, 0, None)]
        return found, (at >= 0) & (found >= low) & (found <= high)
    at = np.searchsorted(possible, low, "left")
    found = possible[np.clip(at, None, len(possible) - 1)]
    return found, (at < len(possible)) & (found >= low) & (found <= high)


def _unfollowed(line: BindingLine, leg: Leg, places: Ints) -> Ints:
    absent = leg.absent if leg.absent is not None else places[:0]
    low, high = line.window(Leg("then", None, leg.within, None, None), places)
    _, followed = _next(absent, low, high, latest=False)
    return places[~followed]


def _one_a_run(line: BindingLine, first: Ints, possible: Ints) -> Ints:
    """Return the earliest possible position in each run (consecutive frames) of the first step."""
    runs = line.runs(first)[np.searchsorted(first, possible)] if len(possible) else possible
    return possible[np.diff(runs, prepend=-1) != 0] if len(possible) else possible


TRACE: Final = ":trace"
"""Name of the key column for the index of the trace in its group."""

MOST_MATCHES: Final = 2_000_000
"""Largest number of multi-frame matches in one trace. Each match takes about 300 bytes."""

_Part = tuple["Ints", "Ints", "Keys", list[list[Any]]]
"""Matches as columns: id of the first frame, id of the last frame, nodes and edges, and returned values."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchesOfWay:
    """Matches of one alternative step sequence of a query.

    Attributes
    ----------
    happen : tuple of int
        Numbers of the occurring steps.
    part : JoinedBindings
    at : list of (R,) int64
        Positions of each of these steps.
    told : (M, n) int64
        Positions of the steps of each match.
    """

    happen: tuple[int, ...]
    part: JoinedBindings
    at: list[Ints]
    told: Ints

    def chosen(self, rows: Any) -> MatchesOfWay:
        """Return a copy with only the matches in the given rows."""
        return replace(self, told=self.told[rows])


class Finder:
    """Search in a store for the matches of a sequence, or another query on several frames.

    Parameters
    ----------
    file : StoreFile
        Store; it must not change during use.
    query : Query
        Query with steps.
    catalog : Catalog
    """

    def __init__(self, file: StoreFile, query: Query, catalog: Catalog) -> None:
        self._file, self._query, self._catalog = file, query, catalog
        self._plan = plan_of_steps(query, query.steps)
        self._when = [tuple(map(self._plan.formula, step.when)) for step in query.steps]
        self._first = frozenset(self._plan.asks)  # queries needed before the matches
        self._kept = tuple(sorted(query.scope.nodes))
        self._tied = frozenset({*self._kept, *tied_in_steps(query)[0]})
        self._steps = asks_of_steps(query, query.steps, self._tied)
        self._edges = tuple(edge.key for edge in query.scope.edges)
        about = file, catalog, query, self._plan, self._steps[0], self._named(0)
        self._runs = None if query.spans else RunFinder(*about)

    def __call__(self, places: tuple[Bound, ...], window: Window | None) -> ExternalRelation:
        """Return the matches of the query in every trace that has a part in a range of frames.

        Parameters
        ----------
        places : tuple of Bound
            Values to compute for each match.
        window : Window or None
        """
        parts: list[_Part] = []
        for name, part in self._parts(places, window):
            parts.append(part)
            if sum(len(one[0]) for one in parts) > MOST_MATCHES:
                raise TooMuchError(
                    f"{name} has more than {MOST_MATCHES:,} matches, more than memory may take",
                    hint=REMEDY,
                )
        first = [frame for part in parts for frame in part[0].tolist()]
        last = [frame for part in parts for frame in part[1].tolist()]
        width = len(self._kept) + len(self._edges)
        keys = np.concatenate([np.zeros((0, width), np.int64), *(part[2] for part in parts)]).T
        nodes = dict(zip(self._kept, keys.tolist(), strict=False))
        edges = dict(zip(self._edges, words()[keys[len(self._kept) :]].tolist(), strict=True))
        many = len(places) + self._query.spans * 2
        values = [[item for part in parts for item in part[3][n]] for n in range(many)]
        return ExternalRelation(first, last, nodes, edges, values)

    def _parts(
        self, places: tuple[Bound, ...], window: Window | None
    ) -> Iterator[tuple[str, _Part]]:
        """Yield the matches of the query in portions, each with the name of a trace for messages."""
        if self._runs is not None and self._runs.fits(places):
            for first, last, keys, values in self._runs.found(places, _whole(window)):
                yield "a trace", (first, last, self._ordered(self._named(0), keys), values)
            return
        about = self._file, self._catalog, self._query, self._asks_of(places)
        for group in groups(*about, gaps=self._query.gaps, within=_whole(window)):
            for part in self._found(group, places):
                yield group.names[-1], part

    def readers(self, window: Window | None) -> Iterator[TraceReader]:
        """Yield all traces that a window touches, loaded with the data that the query needs."""
        about = self._file, self._catalog, self._query, self._asks_of(())
        return traces(*about, gaps=self._query.gaps, within=_whole(window))

    def matches(self, trace: TraceReader) -> bool:
        """True if the selected frames of a trace contain a match of the query."""
        return any(len(part[0]) for part in self.found_in(TraceGroup.alone(trace), ()))

    def _found(self, group: TraceGroup, places: tuple[Bound, ...]) -> list[_Part]:
        """Return the matches in a group of traces. If there are too many, search each trace separately."""
        try:
            return [*self.found_in(group, places)]
        except QueryError:
            if len(group.ids) == 1:
                raise
        each = (TraceGroup.alone(group.reader(place)) for place in range(len(group.ids)))
        return [part for one in each for part in self.found_in(one, places)]

    def _asks_of(self, places: tuple[Bound, ...]) -> dict[str, Ask]:
        """Return all single-frame queries: of steps, conditions and returned values.

        Queries of returned values need only the nodes that match the steps.
        """
        steps = sorted(self._steps, key=lambda ask: len(ask.after))
        for place in places:
            for value in _worked_out(place):
                self._planned(value)
        happen = tuple(self._steps[number] for number in sorted(self._query.certain))
        asked = self._plan.asks.items()
        first = {name: ask for name, ask in asked if name in self._first}
        later = {name: replace(ask, after=happen) for name, ask in asked if name not in first}
        return first | {ask.name: ask for ask in steps} | later

    def _planned(self, place: Bound) -> Formula | Test:
        if is_formula(place) or (isinstance(place, SignalCall) and place.word == "exists_now"):
            return self._plan.formula(place)
        return self._plan.test(place)

    def text(self, places: tuple[Bound, ...]) -> str:
        """Return the evaluation plan of the query as text: single-frame queries and temporal formulas."""
        lines: list[str] = []
        for number, (step, ask) in enumerate(zip(self._query.steps, self._steps, strict=True)):
            if number and not self._query.alternatives:
                lines.append(link_text(self._query.links[number - 1]))
            lines.append(
                f"{'not ' * step.absent}step {number + 1}({', '.join(self._named(number))})"
            )
            lines += [f"    when {formula_text(formula)}" for formula in self._when[number]]
            lines += [f"    {hold_text(step.hold)}"] if step.hold else []
            if not ask.everywhere:
                lines += sql_text(relation(ask.query, self._catalog, None, (), {*ask.columns}))
        lines += map(way_text, self._query.alternatives)
        for place in places:
            for value in _worked_out(place):
                asked = self._planned(value)
                name = asked.name if isinstance(asked, Test) else formula_text(asked)
                lines.append(f"returned {value_text(value)} = {name}")
        return "\n".join([*lines, *needs_text(self._plan, self._catalog)])

    def found_in(self, group: TraceGroup, places: tuple[Bound, ...]) -> Iterator[_Part]:
        """Yield the matches of the query in a group of traces, in portions."""
        if not len(group.frame_ids):
            return
        line = BindingLine(group.clock)
        held = [self._held(group, line, number) for number in range(len(self._steps))]
        if not self._query.spans:
            yield from self._frames(group, held[0], places)
            return
        ways = (each for way in self._query.ways for each in self._of_way(line, held, way))
        for one in self._chosen(line, held, [*ways]) if self._query.alternatives else ways:
            yield from self._matches(group, line, one, places)

    def _of_way(
        self, line: BindingLine, held: list[TimedRelation], way: StepWay
    ) -> Iterator[MatchesOfWay]:
        """Yield the matches of one alternative step sequence of the query."""
        happen = way.happen
        together = joined([(self._columns(n), held[n]) for n in happen], self._apart)
        for part in together.parts([held[n] for n in happen]):
            at = [self._placed(line, held[n], part.places[:, i]) for i, n in enumerate(happen)]
            absent: dict[int, Ints] = {}
            for number in way.steps:
                if self._query.steps[number].absent:
                    own = part.bindings[
                        :, [part.variables.index(name) for name in self._columns(number)]
                    ]
                    absent[number] = self._placed(line, held[number], held[number].find(own))
            legs = self._legs(way, at, absent)
            told = matches_of(line, at[0], legs, self._query.policy)
            if len(told):
                yield MatchesOfWay(happen, part, at, told)

    def _chosen(
        self, line: BindingLine, held: list[TimedRelation], found: list[MatchesOfWay]
    ) -> Iterator[MatchesOfWay]:
        """Yield the best match for each combination of nodes and each run of the first step.

        A run is a series of consecutive frames.

        Matches compare by the positions of their steps. A longer match counts as later than a shorter one. For
        equal positions, the alternative written first wins.
        """
        if not found:
            return
        width = max(len(one.happen) for one in found)
        tables: list[Ints] = []
        for number, one in enumerate(found):
            frames = np.full((len(one.told), width), -1)
            frames[:, : len(one.happen)] = line.frame(one.told)
            runs = line.run_starts(one.at[0])[np.searchsorted(one.at[0], one.told[:, 0])]
            owners = one.told[:, 0] // line.stride
            bindings = one.part.bindings[owners]
            keys = self._ordered(one.part.variables, bindings)
            keys = np.column_stack((bindings[:, 0], keys))
            about = np.full((len(frames), 3), one.happen[0])
            about[:, 1], about[:, 2] = line.frame(runs), number
            tables.append(np.column_stack((keys, about, frames)))
        rows = np.concatenate(tables)
        one_each = rows[:, : -width - 1]  # group: binding, step, run
        if self._query.policy == "first":
            one_each = rows[:, : -width - 3]
        begin, rest = rows[:, -width], rows[:, rows.shape[1] - width + 1 :]
        rest = -rest if self._query.policy == "longest" else rest
        order = np.lexsort((rows[:, -width - 1], *rest.T[::-1], begin, *one_each.T[::-1]))
        new = np.ones(len(order), np.bool_)
        new[1:] = np.any(np.diff(one_each[order], axis=0) != 0, axis=1)
        best = np.zeros(len(order), np.bool_)
        best[order[new]] = True
        ends = np.cumsum([len(one.told) for one in found])
        for one, kept in zip(found, np.split(best, ends[:-1]), strict=True):
            if kept.any():
                yield one.chosen(kept)

    @property
    def _apart(self) -> frozenset[str]:
        return self._tied if self._query.injective else frozenset()

    def _named(self, number: int) -> tuple[str, ...]:
        """Return the node and edge columns of a step that other steps or the result need."""
        ask = self._steps[number]
        return (*(n for n in ask.variables if n in self._tied), *ask.edges)

    def _columns(self, number: int) -> tuple[str, ...]:
        """Return the key columns of a step's table: the trace, then the nodes and edges."""
        return TRACE, *self._named(number)

    def _held(self, group: TraceGroup, line: BindingLine, number: int) -> TimedRelation:
        """Return the frames in which a step matches, as a table. Its conditions and duration are met."""
        step, ask = self._query.steps[number], self._steps[number]
        relation, names = group.relations[ask.name], (TRACE, *ask.columns)
        if self._when[number]:
            kept = self._true(group, relation, ask, self._when[number])
            owners = relation.owners
            relation = TimedRelation.ordered(relation.frames[kept], relation.keys[owners[kept]])
        if names != self._columns(number):
            owners = relation.owners
            keys = relation.keys[:, [names.index(name) for name in self._columns(number)]]
            relation = TimedRelation.of(relation.frames, keys[owners])
        if step.hold is None:
            return relation
        owners = relation.owners
        places = line.held(owners * line.stride + relation.frames, step.hold)
        return TimedRelation.ordered(line.frame(places), relation.keys[places // line.stride])

    def _true(
        self, group: TraceGroup, relation: TimedRelation, ask: Ask, formulas: Sequence[Formula]
    ) -> Any:
        """Return a mask of the rows of a table: true if all given temporal formulas are true."""
        true = np.zeros(len(relation.frames), np.bool_)
        for trace, part, low in _chunks(group, relation):
            bindings = part.keys[:, : len(ask.variables)]
            owners = part.owners
            values = PlanValues(self._plan, trace, ask.variables, bindings)
            here = np.ones(len(owners), np.bool_)
            for formula in formulas:
                here &= values.formula(formula)[owners, part.frames]
            true[low : low + len(here)] = here
        return true

    # Single frames

    def _frames(
        self, group: TraceGroup, relation: TimedRelation, places: tuple[Bound, ...]
    ) -> Iterator[_Part]:
        names = self._named(0)
        for trace, part, _ in _chunks(group, relation):
            owners = part.owners
            line = BindingLine(trace.clock)
            at_row = owners * line.stride + part.frames
            first = np.searchsorted(at_row, line.run_starts(at_row))
            last = np.searchsorted(at_row, line.run_ends(at_row))
            values = PlanValues(self._plan, trace, names, part.keys)
            told: list[Any] = []
            for place in places:
                if not isinstance(place, OverMatch):
                    told.append(picked(self._value(place, values), owners, part.frames))
                    continue
                runs, member = np.unique(first, return_inverse=True)
                ends = part.frames[last[runs]]
                stretches = Stretches(owners[runs], part.frames[runs], ends)
                told.append(self._over(place, values, stretches)[member])
            ids = trace.frame_ids[part.frames]
            new = np.ones(len(ids), np.bool_)
            new[1:] = (np.diff(ids) != 1) | (np.diff(owners) != 0)
            for column in told:
                new[1:] |= column[1:] != column[:-1]
            first = np.flatnonzero(new)
            last = np.append(first[1:], len(ids))[: len(first)] - 1
            keys = self._ordered(names, part.keys[owners[first]])
            yield ids[first], ids[last], keys, [column[first].tolist() for column in told]

    # Sequences

    def _matches(
        self, group: TraceGroup, line: BindingLine, one: MatchesOfWay, places: tuple[Bound, ...]
    ) -> Iterator[_Part]:
        at, told = one.at, one.told
        bindings = one.part.bindings[told[:, 0] // line.stride]
        frames = line.frame(told)
        ends = frames[:, -1]
        if self._query.steps[one.happen[-1]].hold is not None:
            runs = line.run_ends(at[-1])
            ends = line.frame(runs[np.searchsorted(at[-1], told[:, -1])])
        keys = self._ordered(one.part.variables, bindings)
        spans: dict[Bound, tuple[Ints, Ints]] = {}
        for place in places:
            if isinstance(place, OverMatch) and {place.start, place.end} <= {None, *one.happen}:
                spans[place] = self._span(line, place, one, ends)
        values = self._at_matches(group, one, bindings, frames, places, spans)
        values += [group.frame_ids[frames[:, 0]].tolist(), group.frame_ids[ends].tolist()]
        last = group.frame_ids[frames[:, -1]]
        yield last, last, keys, values

    def _placed(self, line: BindingLine, relation: TimedRelation, places: Ints) -> Ints:
        owner, rows = relation.rows_of(places)
        return owner * line.stride + relation.frames[rows]

    def _legs(self, way: StepWay, at: list[Ints], absent: dict[int, Ints]) -> list[Leg]:
        """Return the time relations between steps. A ``NOT MATCH`` step is included in the relation around it.

        A ``NOT MATCH`` step becomes part of a time relation.
        """
        legs: list[Leg] = []
        links, number, following = way.links, 1, iter(at[1:])
        while number <= len(links):
            there = absent.get(way.steps[number])
            number += there is not None and number < len(links)
            link = links[number - 1]
            happens = way.steps[number] not in absent
            places = next(following) if happens else None
            legs.append(Leg(link.kind, link.after, link.within, there, places))
            number += 1
        return legs

    def _span(
        self, line: BindingLine, place: OverMatch, one: MatchesOfWay, ends: Ints
    ) -> tuple[Ints, Ints]:
        """For each match, return the first and last frame of the steps in an ``OVER`` clause, (M,)."""
        told, happen = one.told, one.happen
        if place.start is None or place.end is None:
            return line.frame(told[:, 0]), ends
        here = told[:, happen.index(place.start)]
        if place.start != place.end:
            return line.frame(here), line.frame(told[:, happen.index(place.end)])
        step = one.at[happen.index(place.start)]
        row = np.searchsorted(step, here)
        return line.frame(line.run_starts(step)[row]), line.frame(line.run_ends(step)[row])

    def _at_matches(
        self,
        group: TraceGroup,
        one: MatchesOfWay,
        bindings: Keys,
        frames: Ints,
        places: tuple[Bound, ...],
        spans: dict[Bound, tuple[Ints, Ints]],
    ) -> list[list[Any]]:
        happen, part = one.happen, one.part
        asked = tuple(p for p in places if p in spans or not isinstance(p, StepTime | OverMatch))
        found: dict[Bound, list[Any]] = {place: [] for place in asked}
        owners = bindings[:, 0]
        first = np.flatnonzero(np.diff(owners, prepend=-1)) if asked else owners[:0]
        for begin, end in zip(first.tolist(), [*first[1:].tolist(), len(owners)], strict=False):
            trace, start = group.reader(owners[begin]), group.starts[owners[begin]]
            for low in range(begin, end, trace.together):
                rows = slice(low, min(low + trace.together, end))
                here = np.arange(len(owners[rows]))
                values = PlanValues(self._plan, trace, part.variables[1:], bindings[rows, 1:])
                for place in asked:
                    if isinstance(place, OverMatch):
                        stretches = Stretches(here, *(last[rows] - start for last in spans[place]))
                        value = self._over(place, values, stretches)
                    else:
                        value = picked(self._value(place, values), here, frames[rows, -1] - start)
                    found[place] += value.tolist()
        for place in places:
            if isinstance(place, StepTime) and place.step in happen:
                times = group.times[frames[:, happen.index(place.step)]] - group.begins[owners]
                found[place] = [seconds_of(time) for time in times.tolist()]
            found.setdefault(
                place, [None] * len(owners)
            )  # belongs to a step of another alternative
        return [found[place] for place in places]

    # Values

    def _value(self, place: Bound, values: PlanValues) -> Column:
        asked = self._planned(place)
        return values.test(asked) if isinstance(asked, Test) else Column(values.formula(asked))

    def _over(self, place: OverMatch, values: PlanValues, stretches: Stretches) -> Any:
        at = None if place.at is None else self._value(place.at, values)
        return stretches.told(place.word, self._value(place.operand, values), at)

    def _ordered(self, names: tuple[str, ...], keys: Keys) -> Keys:
        return keys[:, [names.index(name) for name in (*self._kept, *self._edges)]]


def _whole(window: Window | None) -> Window | None:
    if window is None:
        return None
    high = ((window.high - 1) >> BUCKET_BITS) + 1
    return Window(window.low >> BUCKET_BITS << BUCKET_BITS, high << BUCKET_BITS, window.traces)


def _chunks(
    group: TraceGroup, relation: TimedRelation
) -> Iterator[tuple[TraceReader, TimedRelation, int]]:
    """Divide a table into parts with one trace and few node combinations. Yield each part and its first row."""
    for place in np.unique(relation.keys[:, 0]).tolist():
        trace, whole = group.reader(place), group.part(relation, place)
        begin = int(relation.starts[np.searchsorted(relation.keys[:, 0], place)])
        for low in range(0, len(whole.keys), trace.together):
            high = min(low + trace.together, len(whole.keys))
            first, end = whole.starts[low], whole.starts[high]
            starts = whole.starts[low : high + 1] - first
            yield (
                trace,
                TimedRelation(whole.keys[low:high], starts, whole.frames[first:end]),
                begin + int(first),
            )


def _worked_out(place: Bound) -> tuple[Bound, ...]:
    """Return the single-frame values from which a returned value of a match is computed."""
    match place:
        case StepTime():
            return ()
        case OverMatch(operand=operand, at=at):
            return (operand,) if at is None else (operand, at)
        case _:
            return (place,)
