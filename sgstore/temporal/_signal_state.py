"""Functions over time in the online monitor (durations, changes, sums), updated frame by frame."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.errors import QueryError
from sgstore.lang import ir as b
from sgstore.lang.bind import FUTURE
from sgstore.lang.help import in_words
from sgstore.lang.operators import Column
from sgstore.lang.sql import value_text
from sgstore.model.world import JUMP_NS, longest_step_ns, tolerance_ns
from sgstore.temporal._formula import Next, Previous, Since, Until, walk
from sgstore.temporal._progression import Progression, ProgressionFrame, Tick
from sgstore.temporal._robustness import MarginTable, margin_columns
from sgstore.temporal._signal_values import NS, Clock, SignalValues, wrapped
from sgstore.temporal._valuation import NEVER, TIMES, Memory
from sgstore.temporal._windows import next_window, window_value

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from sgstore.model.world import Bools, Floats
    from sgstore.temporal._plan import Ask, Plan, Test


def _courses(expression: b.Bound) -> Iterator[b.SignalCall]:
    """Yield the calls of functions over time, such as ``delta(x, 2s)``, in an expression.

    Nested calls are not included.
    """
    if isinstance(expression, b.SignalCall):
        yield expression
    elif not b.is_formula(expression):
        for operand in b.operands_of(expression):
            yield from _courses(operand)


class SignalState:
    """Online evaluation of expressions over several frames, frame by frame.

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
                        f"robustness({value_text(in_words(condition))}) is not of this frame alone",
                        hint="a monitor has the margins of checks: CHECK ALWAYS … ROBUSTNESS",
                    )
            for part in b.walk(test.expression):
                if isinstance(part, b.Tense) and part.word in FUTURE:
                    raise QueryError(
                        f"{part.word} looks ahead, but its value is needed at once",
                        hint="join conditions by AND, OR, NOT, IMPLIES",
                    )
            for course in _courses(test.expression):
                if course.ahead:
                    raise QueryError(
                        f"the window of {course.word}() has later frames, which a monitor does not have",
                        hint=f"end the window at the frame: {course.word}(x, 2s)",
                    )
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
        """State of functions over time and past operators before the first frame."""
        pasts = (progression.begun for progression in self.conditions.values())
        return (*(None for _ in self.places), *pasts)

    def step(self) -> None:
        """Add the next frame. Its time must already be in the clock."""
        tick = self.pulse.tick
        if self.gap:
            self._frames.clear()
            self._begun = tick.number
        self._frames.append((tick.time, tick.number))
        while len(self._frames) > self._many + 1 and self._frames[1][0] <= tick.time - self._back:
            self._frames.popleft()

    @property
    def gap(self) -> bool:
        """True if a recording gap is between the previous frame and this frame."""
        return self.pulse.breaks(bridge=self._bridge)

    @property
    def oldest(self) -> int:
        """Number of the oldest frame that is still needed to compute an expression."""
        return self._frames[0][1]

    def window(self, course: b.SignalCall) -> tuple[int, int]:
        """Return number and time of the first frame in the time window of a function over time.

        An example is ``avg_over(x, 2s)``.
        """
        tick = self.pulse.tick
        if course.frames:
            return max(tick.number - course.by + 1, self._begun), -NEVER
        return self._begun, tick.time - course.by - tick.tolerance

    def there(self, course: b.SignalCall) -> int:
        """Return the number of the earlier frame that ``delta(x, 2s)`` compares with this frame; or -1."""
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
        """Return the values of all expressions in this frame, and the state that each binding needs later.

        There is one of each for every node combination.

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
    """Values of expressions over several frames at the current frame, for some combinations of nodes."""

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
        """Return the state that each node combination needs at the next frame."""
        columns = [self._new[course] for course in self._all.places]
        columns += [self._kept[condition] for condition in self._all.conditions]
        return list(zip(*columns, strict=True)) if columns else [() for _ in range(self._rows)]

    def test(self, test: Test) -> Column:
        """Return the value of an expression in this frame for each node combination, (B, 1).

        They are computed once, because this changes the memory.
        """
        if test.name not in self._tests:
            self._tests[test.name] = super().test(test)
        return self._tests[test.name]

    def signal(self, signal: Ask) -> Column:
        """Return the value of a single-frame query in this frame for each node combination, (B, 1)."""
        return self._signal(signal)

    def proposition(self, name: str) -> Bools:
        """Return a mask of the node combinations for which a named condition is true in this frame."""
        if name in self._all.plan.tests:
            found = self.test(self._all.plan.tests[name]).true
            return np.broadcast_to(found, (self._rows, 1))
        return self._atom(name)[:, None]

    def margins(self, course: b.SignalCall, test: Test) -> Floats:
        """Return the robustness margin of a condition in this frame for each node combination, (B, 1)."""
        formula, tolerance = test.quantities[course.operand], self._tick.tolerance
        columns = margin_columns(self._all.plan, formula, self.test, self.proposition, tolerance)
        value = MarginTable(columns, np.zeros(1, np.int64)).value(formula)
        return np.broadcast_to(value, (self._rows, 1))

    def condition(self, expression: b.Bound, test: Test) -> Bools:
        """Return a mask of the node combinations for which a condition is true in this frame.

        It is true where the condition inside ``run_length(…)`` or similar is true in this frame.
        """
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
        """Return the value of a function over time, such as ``delta(x, 2s)``, in this frame."""
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
"""Known angle in a frame: frame number, angle, total rotation, and first frame of the known run."""

_Trail = tuple[_Point, tuple[_Point, ...]]
"""History of an angle: its last known point, and earlier points that are still needed."""


def _moved(old: _Trail | None, value: float | None, here: int, oldest: int) -> _Trail | None:
    """Return the history of an angle after this frame. It counts full turns."""
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
    """Return a list of values as a column (B, 1) with a mask of the known ones. None means unknown."""
    known = [value is not None for value in values]
    like = next((value for value in values if value is not None), 0.0)
    empty = "" if isinstance(like, str) else type(like)()
    told = np.array([empty if value is None else value for value in values])
    return Column(told[:, None], np.array(known, np.bool_)[:, None])


class StreamClock:
    """Frame times of an online run, and a shift that keeps them ascending after a backward jump.

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
        """Add the time of the next frame. After a backward jump, shift times so that they ascend.

        A time that does not ascend is corrected, as in :func:`sgstore.temporal._offline.ascending`.
        """
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
        """True if a recording gap, or a backward jump of time, is directly before this frame.

        With ``bridge``, gaps do not count.
        """
        return self.jump or (self.gap and not bridge)

    def told(self, time: int) -> int:
        """Undo the correction of backward clock jumps: return the recorded time of a frame; ns."""
        after = bisect_right(self._jumps, (time, NEVER, 0))
        return time - self._jumps[after - 1][1] if after else time

    def jump_after(self, time: int) -> int:
        """Return the number of the first frame after the next backward jump of time, or :data:`NEVER`."""
        after = bisect_right(self._jumps, (time, NEVER, 0))
        return self._jumps[after][2] if after < len(self._jumps) else NEVER

    def _remember(self, span: int) -> None:
        if len(self._spans) == TIMES:
            del self._sorted[bisect_left(self._sorted, self._spans.popleft())]
        self._spans.append(span)
        insort(self._sorted, span)
