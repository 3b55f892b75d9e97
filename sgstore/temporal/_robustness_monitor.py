"""Online computation of robustness (margin of a verdict), frame by frame in bounded memory.

The margin of a formula may depend on later frames. For a bounded operator, the monitor waits. For an unbounded
operator, *one* number is unknown: its margin at the next frame. A margin is a function of known and unknown
numbers, built from minimum and maximum. Its values at the extremes of the unknowns define it: 2 values for one
unknown, 4 for two. The next frame replaces each unknown.

Negations occur only at propositions. Below a negation, *until* and *or* become their duals.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import QueryError
from sgstore.temporal._binding_truth import Valuation
from sgstore.temporal._check_plan import (
    FAVOURABLE,
    SIGNS,
    UNFAVOURABLE,
    WITHOUT_ABSENCE,
    Reading,
    base_name,
    misses_absent,
    plan_of_margins,
)
from sgstore.temporal._formula import (
    TRUE,
    WHOLE,
    And,
    Bound,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    TruthConstant,
    Until,
    propositions,
)
from sgstore.temporal._quantifiers import folded_margins, innermost
from sgstore.temporal._robustness import (
    Robustness,
    apart_from_absence,
    condition_text,
    margin_columns,
)
from sgstore.temporal._signal_values import NS
from sgstore.temporal._valuation import BindingTable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.ir import BoundCheck
    from sgstore.lang.operators import Column
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.temporal._plan import Test
    from sgstore.temporal._progression import Tick
    from sgstore.temporal._quantifiers import Level
    from sgstore.temporal._signal_state import StreamClock
    from sgstore.temporal._valuation import Partial, QueryCache

    Margins = NDArray[Any]

MOST_OPEN: Final = 8
"""Largest number of future operators without time limit. Each of them doubles the memory of a margin."""

MARGIN: Final = np.dtype([("value", "f8"), ("name", "i8"), ("frame", "i8"), ("time", "i8")])
"""Margin with its origin: number of the proposition (-1 for none), frame number, and time (ns)."""


def _better(one: Margins, other: Margins, *, greatest: bool) -> Margins:
    a, b = one["value"], other["value"]
    return np.where(b > a if greatest else b < a, other, one)


def _best(margins: Margins, *, greatest: bool) -> Margins:
    values = margins["value"]
    place = values.argmax(axis=0) if greatest else values.argmin(axis=0)
    return np.take_along_axis(margins, place[None], axis=0)[0]


def _best_so_far(margins: Margins, *, greatest: bool) -> Margins:
    """For each frame, return the best margin so far: the maximum or minimum up to this frame."""
    values = margins["value"] if greatest else -margins["value"]
    new = np.ones(values.shape, np.bool_)
    new[1:] = values[1:] > np.maximum.accumulate(values, axis=0)[:-1]
    places = np.where(new, np.arange(len(values))[:, None, None], 0)
    return np.take_along_axis(margins, np.maximum.accumulate(places, axis=0), axis=0)


def _from_a_frame(margins: Margins, others: Margins) -> Margins:
    same = (margins["name"] < 0) & (margins["value"] == others["value"])
    return np.where(same, others, margins)


def _constant(value: Any, shape: tuple[int, ...]) -> Margins:
    found = np.zeros(shape, MARGIN)
    found["value"], found["name"] = value, -1
    return found


@dataclass(slots=True)
class _Tape:
    """Robustness margins of recent frames. A margin stays as long as later margins need it.

    Attributes
    ----------
    start : int
        Number of the first frame.
    values : (N, B, V) of MARGIN
        Margins of each frame, binding and extreme of the unknowns.
    """

    start: int
    values: Margins

    @property
    def end(self) -> int:
        return self.start + len(self.values)

    def at(self, frame: int) -> Margins:
        return self.values[frame - self.start]

    def between(self, start: int, end: int) -> Margins:
        return self.values[start - self.start : end - self.start]

    def add(self, value: Margins) -> None:
        self.values = np.concatenate((self.values, value[None]))

    def forget(self, before: int) -> None:
        gone = min(max(before - self.start, 0), len(self.values))
        if gone:
            self.start, self.values = self.start + gone, self.values[gone:]


@dataclass(slots=True)
class _Part:
    """Part of a temporal formula, with the robustness margins of the frames so far.

    Attributes
    ----------
    formula : Formula
        Subformula without outer negations.
    positive : bool
        True for an even number of outer negations.
    left, right : int or None
        Numbers of the operands; a single operand is ``right``. ``None`` on the left means always true.
    others : tuple of int
        Numbers of the operands of a logical operator.
    bit : int
        Bit of the unknown margin at the next frame; 0: none.
    single : bool
        For a bounded operator with an unbounded right side: True if it needs the right side at one frame only.
    tape : _Tape
    """

    formula: Formula
    positive: bool
    left: int | None = None
    right: int | None = None
    others: tuple[int, ...] = ()
    bit: int = 0
    single: bool = False
    tape: _Tape = field(default_factory=lambda: _Tape(0, np.zeros((0, 1, 1), MARGIN)))

    def join(self, one: Margins, other: Margins) -> Margins:
        """Return the margins of ``one OR other``. If the part is negated, the operator is ``AND``."""
        return _better(one, other, greatest=self.positive)

    def meet(self, one: Margins, other: Margins) -> Margins:
        """Return the margins of ``one AND other``. If the part is negated, the operator is ``OR``."""
        return _better(one, other, greatest=not self.positive)

    @property
    def nothing(self) -> float:
        """Margin of a condition that is always false: minus infinity. If the part is negated, plus infinity."""
        return -np.inf if self.positive else np.inf


class MarginStream:
    """Online computation of the robustness margin of a temporal formula at the first frame.

    It handles several node combinations.

    Parameters
    ----------
    formula : Formula
        Formula with margins as propositions.

    Raises
    ------
    QueryError
        The formula has too many unbounded forward operators.
    """

    def __init__(self, formula: Formula) -> None:
        self._parts: list[_Part] = []
        self._known: dict[tuple[Any, ...], int] = {}
        self._open = 0
        self._build(formula, positive=True)
        self._root = len(self._parts) - 1
        if self._open > MOST_OPEN:
            raise QueryError(
                f"the robustness of {self._open} operators that look ahead without a bound,"
                f" expected at most {MOST_OPEN}",
                hint="bound some of them: EVENTUALLY[0s, 5s] …; or use a store",
            )
        self._vertices = np.arange(1 << self._open)
        self._names = sorted(propositions(formula))
        self._answer: Margins | None = None
        self._rows = 1
        self._columns: Mapping[str, Floats] = {}
        self._times: list[int] = []  # of the frames from the number ``start`` on
        self._start = 0
        self._tolerance = 0
        self._ended = False
        for part in self._parts:
            part.tape = _Tape(0, np.zeros((0, 1, len(self._vertices)), MARGIN))

    # Parts, operands first

    def _build(self, formula: Formula, *, positive: bool) -> int:
        while isinstance(formula, Not):
            formula, positive = formula.operand, not positive
        match formula:
            case And(operands=operands) | Or(operands=operands):
                others = tuple(self._build(one, positive=positive) for one in operands)
                return self._part(_Part(formula, positive, others=others))
            case Next(operand=operand) | Previous(operand=operand):
                right = self._build(operand, positive=positive)
                return self._part(_Part(formula, positive, right=right))
            case Until(left=left, right=right) | Since(left=left, right=right):
                sides = (
                    None if left == TRUE else self._build(left, positive=positive),
                    self._build(right, positive=positive),
                )
                return self._over_time(formula, sides, positive=positive)
            case _:
                return self._part(_Part(formula, positive))

    def _over_time(
        self, formula: Until | Since, sides: tuple[int | None, int], *, positive: bool
    ) -> int:
        part = _Part(formula, positive, *sides)
        if formula.bound.high is not None:
            return self._part(part)
        whole = replace(part, formula=replace(formula, bound=WHOLE))
        onward = self._part(whole)
        if formula.bound == WHOLE:
            return onward
        return self._part(replace(part, right=onward, single=True))

    def _part(self, part: _Part) -> int:
        key = part.formula, part.positive, part.left, part.right, part.others, part.single
        if key not in self._known:
            if isinstance(part.formula, Until) and part.formula.bound == WHOLE:
                part.bit = 1 << self._open
                self._open += 1
            self._known[key] = len(self._parts)
            self._parts.append(replace(part, tape=_Tape(0, np.zeros((0, 1, 1), MARGIN))))
        return self._known[key]

    # Online, frame by frame

    def step(self, columns: Mapping[str, Floats], tick: Tick, parents: Ints) -> None:
        """Update the margins of the formula with the next frame.

        Parameters
        ----------
        columns : mapping of str to (B,) float64
            Margins of the propositions for each binding.
        tick : Tick
        parents : (B,) int64
            Row of each binding, or of its parent binding, in the previous frame.
        """
        if self._count and not np.array_equal(parents, np.arange(self._rows)):
            for part in self._parts:
                part.tape.values = part.tape.values[:, parents]
            if self._answer is not None:
                self._answer = self._answer[parents]
        self._rows = len(parents)
        if not self._count:
            for part in self._parts:
                part.tape.values = np.zeros((0, self._rows, len(self._vertices)), MARGIN)
        self._times.append(tick.time)
        self._tolerance, self._columns = tick.tolerance, columns
        self._advance()
        self._forget()

    def margins(self) -> Margins:
        """Return the margin of each node combination if the trace ended now."""
        return copy(self)._finished()  # noqa: SLF001 - of one's own kind

    def name(self, number: int) -> str:
        """Return the name of the formula's proposition with this number."""
        return self._names[number]

    def _finished(self) -> Margins:
        """End the trace, and return the margin of each node combination. No frame may follow."""
        self._parts = [replace(part, tape=copy(part.tape)) for part in self._parts]
        self._ended = True
        self._advance()
        assert self._answer is not None  # noqa: S101 - there was a frame
        ended = sum(part.bit for part in self._parts if not part.positive)
        return self._answer[:, ended]

    def _advance(self) -> None:
        for number, part in enumerate(self._parts):
            for value in self._told(part):
                if part.bit and part.tape.end:
                    self._replace(part.bit, value)
                part.tape.add(value)
            if number == self._root and self._answer is None and part.tape.end:
                self._answer = part.tape.at(0)

    def _replace(self, bit: int, value: Margins) -> None:
        """Insert a margin of the next frame into all stored results that depend on it."""
        low, high = self._vertices & ~bit, self._vertices | bit

        def shown(old: Margins) -> Margins:
            least = _from_a_frame(_better(old[..., high], value, greatest=False), value)
            return _from_a_frame(_better(old[..., low], least, greatest=True), least)

        for part in self._parts:
            part.tape.values = shown(part.tape.values)
        if self._answer is not None:
            self._answer = shown(self._answer)

    def _all(self, value: float) -> Margins:
        return _constant(value, (self._rows, len(self._vertices)))

    def _here(self, name: str, *, positive: bool) -> Margins:
        """Return the margins of one single-frame condition of the formula in this frame."""
        found = self._all(0.0)
        column = self._columns[name][:, None]
        found["value"] = column if positive else -column
        found["name"] = self._names.index(name)
        found["frame"], found["time"] = self._count - 1, self._times[-1]
        return found

    def _told(self, part: _Part) -> Iterator[Margins]:
        """For part of the formula, yield the margins that are known after this frame, ordered by frame."""
        match part.formula:
            case TruthConstant(value=value):
                if not self._ended:
                    yield self._all(np.inf if value == part.positive else -np.inf)
            case Proposition(name=name):
                if not self._ended:
                    yield self._here(name, positive=part.positive)
            case And() | Or():
                both = part.join if isinstance(part.formula, Or) else part.meet
                while part.tape.end < min(self._parts[o].tape.end for o in part.others):
                    at = part.tape.end
                    yield reduce(both, (self._parts[o].tape.at(at) for o in part.others))
            case _:
                yield from self._over_frames(part)

    def _over_frames(self, part: _Part) -> Iterator[Margins]:
        match part.formula:
            case Next(weak=weak):
                yield from self._next(part, weak=weak)
            case Previous():
                while part.tape.end < self._count and part.tape.end <= self._right(part).end:
                    at = part.tape.end
                    yield self._right(part).at(at - 1) if at else self._all(part.nothing)
            case Until() if part.bit:
                yield from self._onward(part)
            case Until(bound=bound):
                yield from self._ahead(part, bound)
            case Since(bound=bound) if bound == WHOLE:
                yield from self._so_far(part)
            case Since(bound=bound):
                yield from self._back(part, bound)
            case _:
                raise TypeError(f"{part.formula} is of one frame")

    @property
    def _count(self) -> int:
        """Number of frames processed until now."""
        return self._start + len(self._times)

    def _right(self, part: _Part) -> _Tape:
        assert part.right is not None  # noqa: S101 - only of operators
        return self._parts[part.right].tape

    def _left(self, part: _Part) -> _Tape | None:
        return None if part.left is None else self._parts[part.left].tape

    def _sides(self, part: _Part) -> int:
        left = self._left(part)
        return min(self._right(part).end, self._right(part).end if left is None else left.end)

    def _next(self, part: _Part, *, weak: bool) -> Iterator[Margins]:
        while part.tape.end + 1 < self._right(part).end:
            yield self._right(part).at(part.tape.end + 1)
        if self._ended and part.tape.end < self._count:
            yield self._all(-part.nothing if weak else part.nothing)

    def _onward(self, part: _Part) -> Iterator[Margins]:
        ends = np.where(self._vertices & part.bit, np.inf, -np.inf)
        unknown = _constant(ends, (1, len(ends)))
        while part.tape.end < self._sides(part):
            at, left = part.tape.end, self._left(part)
            later = unknown if left is None else part.meet(left.at(at), unknown)
            yield part.join(self._right(part).at(at), later)

    def _so_far(self, part: _Part) -> Iterator[Margins]:
        while part.tape.end < self._sides(part):
            at, left = part.tape.end, self._left(part)
            before = part.tape.at(at - 1) if at else self._all(part.nothing)
            before = before if left is None else part.meet(left.at(at), before)
            yield part.join(self._right(part).at(at), before)

    def _ahead(self, part: _Part, bound: Bound) -> Iterator[Margins]:
        while part.tape.end < self._count:
            at, left = part.tape.end, self._left(part)
            window = self._window_ahead(at, bound, single=part.single)
            if window is None:
                return
            first, end = window
            if self._right(part).end < end or (left is not None and left.end < end - 1):
                return
            if first >= end:
                yield self._all(part.nothing)
                continue
            found = self._right(part).between(first, end)
            if left is not None and end - 1 > at:
                way = _best_so_far(left.between(at, end - 1), greatest=not part.positive)
                if first > at:
                    found = part.meet(found, way[first - at - 1 :])
                else:
                    found = np.concatenate((found[:1], part.meet(found[1:], way)))
            yield _best(found, greatest=part.positive)

    def _window_ahead(self, at: int, bound: Bound, *, single: bool) -> tuple[int, int] | None:
        """Return the first later frame in a time bound, and the frame after the last one.

        ``None`` means that a later frame decides.
        """
        bound, count = bound.widened(self._tolerance), self._count
        if bound.frames:
            first = min(at + bound.low, count)
        else:
            first = self._place(bisect_left, self._time(at) + bound.low)
        if single:
            known = first < count or self._ended
            return (first, min(first + 1, count)) if known else None
        assert bound.high is not None  # noqa: S101 - without it a single frame is asked
        if bound.frames:
            end = min(at + bound.high + 1, count)
            known = at + bound.high < count
        else:
            end = self._place(bisect_right, self._time(at) + bound.high)
            known = end < count
        return (first, end) if known or self._ended else None

    def _back(self, part: _Part, bound: Bound) -> Iterator[Margins]:
        while part.tape.end < self._sides(part):
            at, left = part.tape.end, self._left(part)
            first, last = self._window_back(at, bound, single=part.single)
            if last < max(first, 0):
                yield self._all(part.nothing)
                continue
            right = self._right(part)
            found = right.between(first, last + 1)
            if left is not None and first < at:
                # The left side counts after each frame of the bound, up to here.
                since = left.between(first + 1, at + 1)[::-1]
                way = _best_so_far(since, greatest=not part.positive)[::-1]
                found = (
                    part.meet(found[: len(way)], way[: len(found)])
                    if last < at
                    else (np.concatenate((part.meet(found[:-1], way), found[-1:])))
                )
            yield _best(found, greatest=part.positive)

    def _window_back(self, at: int, bound: Bound, *, single: bool) -> tuple[int, int]:
        """Return the first and the last earlier frame in a time bound. -1 means before the trace."""
        bound = bound.widened(self._tolerance)
        if bound.frames:
            last = max(at - bound.low, -1)
        else:
            last = self._place(bisect_right, self._time(at) - bound.low) - 1
        if single:
            return last, last
        assert bound.high is not None  # noqa: S101 - without it a single frame is asked
        if bound.frames:
            return max(at - bound.high, 0), last
        return self._place(bisect_left, self._time(at) - bound.high), last

    def _place(self, find: Callable[[list[int], int], int], time: int) -> int:
        return self._start + find(self._times, time)

    def _time(self, frame: int) -> int:
        return self._times[frame - self._start]

    # Cleanup of data that no formula needs

    def _forget(self) -> None:
        needed = [part.tape.end - (isinstance(part.formula, Since)) for part in self._parts]
        oldest = self._count - 1
        for part in self._parts:
            own = part.tape.end
            oldest = min(oldest, own)
            if isinstance(part.formula, Previous):
                own -= 1
            elif isinstance(part.formula, Since) and part.formula.bound != WHOLE and own:
                first, _ = self._window_back(own - 1, part.formula.bound, single=part.single)
                own = max(first, 0)
                oldest = min(oldest, own)
            for operand in (part.left, part.right, *part.others):
                if operand is not None:
                    needed[operand] = min(needed[operand], own)
        for part, first in zip(self._parts, needed, strict=True):
            part.tape.forget(first)
        gone = max(oldest - self._start, 0)
        self._times = self._times[gone:]
        self._start += gone


class RobustnessMonitor:
    """Online monitor of the robustness of a check (margin of its verdict).

    Parameters
    ----------
    check : BoundCheck
    questions : QueryCache
        Query cache; the queries of the margins are added.
    pulse : StreamClock
        Clock, updated with each frame before this object.
    reading : Reading, optional
        Rules for absent entities; by default from the quantifiers.

    Raises
    ------
    QueryError
        The formula has too many unbounded forward operators.

    Notes
    -----
    A margin is stored for each binding that ever differed, because bindings rarely stay equal.
    """

    def __init__(
        self,
        check: BoundCheck,
        questions: QueryCache,
        pulse: StreamClock,
        reading: Reading | None = None,
    ) -> None:
        about = () if reading is None else (reading,)
        self._plan, self._formula = plan_of_margins(check, *about)
        self._without: RobustnessMonitor | None = None
        if reading is None and misses_absent(check):
            self._without = RobustnessMonitor(check, questions, pulse, WITHOUT_ABSENCE)
        self._pulse = pulse
        signs = SIGNS if self._plan.doubts else (UNFAVOURABLE,)
        self._streams = {sign: MarginStream(self._formula) for sign in signs}
        bridge = check.gaps == "bridge"
        self._valuation = Valuation(self._plan, self._plan.bound, questions, pulse, bridge=bridge)
        self._memories = BindingTable(self._valuation.lattice, self._valuation.begun)
        self._rows: dict[Partial, int] = {}

    def step(self) -> None:
        """Update the robustness with the next frame. The query results of the frame must be ready."""
        if self._without is not None:
            self._without.step()
        valuation, known = self._valuation, self._memories
        letters, memories = valuation.read(known.held, known.of, closed=True)
        parents = [self._row(one) if self._rows else 0 for one in letters]
        tick = self._pulse.tick

        def flags(name: str, counted: str) -> Bools:
            if name[-1] in SIGNS and name[-1] != counted:
                return np.zeros((len(letters), 1), np.bool_)
            bit = valuation.bits[base_name(name)]
            return np.array([bool(letter & bit) for letter in letters.values()])[:, None]

        def test(one: Test) -> Column:
            return valuation.columns[one.name]

        for sign, stream in self._streams.items():
            about = test, partial(flags, counted=sign), tick.tolerance
            columns = margin_columns(self._plan, self._formula, *about)
            margins = {
                name: np.broadcast_to(column[:, 0], len(letters))
                for name, column in columns.items()
            }
            stream.step(margins, tick, np.array(parents))
        self._rows = {one: row for row, one in enumerate(letters)}
        known.held = {one: memories.get(one, ()) for one in letters}

    def _row(self, binding: Partial) -> int:
        wider = self._valuation.lattice.wider(binding)
        return next(self._rows[one] for one in wider if one in self._rows)

    def told(self, levels: Sequence[Level], names: Mapping[str, Mapping[int, str]]) -> Robustness:
        """Return the robustness of the check if the trace ended now.

        Parameters
        ----------
        levels : sequence of Level
        names : mapping of str to mapping of int to str
            Variable → names of its possible entities.
        """
        found = self._told(levels, names)
        if self._without is None:
            return found
        return apart_from_absence(found, partial(self._without.told, levels, names))

    def _told(self, levels: Sequence[Level], names: Mapping[str, Mapping[int, str]]) -> Robustness:
        bindings, stream = innermost(levels), self._streams[UNFAVOURABLE]
        rows = np.array([self._row(tuple(key)) for key in bindings.tolist()], np.int64)
        found = {sign: one.margins() for sign, one in self._streams.items()}
        margins = found[UNFAVOURABLE]
        value, row = folded_margins(levels, margins["value"][rows])
        most, _ = folded_margins(levels, found.get(FAVOURABLE, margins)["value"][rows])
        upper = None if most == value else most
        if row is None:
            return Robustness(value, upper=upper)
        nodes = dict(zip(self._plan.bound, bindings[row].tolist(), strict=True))
        called = {name: names[name][node] for name, node in nodes.items()}
        decisive = margins[rows[row]]
        if decisive["name"] < 0:
            return Robustness(value, nodes=nodes, names=called, upper=upper)
        condition = condition_text(self._plan, stream.name(int(decisive["name"])))
        time = self._pulse.told(int(decisive["time"]))
        when = int(decisive["frame"]), time, (time - self._pulse.start) / NS
        return Robustness(value, condition, *when, nodes, called, upper)
