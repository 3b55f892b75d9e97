"""Functions over time on whole traces, as arrays: durations, changes, sums and means."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.memory import column_evaluator
from sgstore.lang.operators import Column, all_known
from sgstore.temporal._windows import over_columns

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from sgstore.lang.memory import Columns
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.temporal._plan import Ask, Test

    Places = NDArray[np.int32 | np.int64]
    Array = NDArray[Any]

# Values over time as columns: ``prev``, ``delta``, windows, ``run_length``, ``since_true``, ``age``, and terms
# A column of values, :class:`sgstore.lang.operators.Column`, has a row for each binding and a column for each
# frame. Values do not cross gaps: after a gap, ``prev`` and ``delta`` are unknown, and runs and windows
# restart.

NS: Final = 1e9


@dataclass(frozen=True, slots=True)
class Clock:
    """Times of the frames of a trace. A run is a series of frames without a gap.

    Attributes
    ----------
    times : (F,) int64
        Ascending; ns.
    runs : (F,) int64
        Number of each frame's run without gaps.
    period : int
        Median time between two frames; ns.
    tolerance : int
        Time tolerance for equality; ns.
    """

    times: Ints
    runs: Ints
    period: int
    tolerance: int = 0

    @classmethod
    def of(
        cls, times: Ints, numbers: Ints, period: int, longest: float, tolerance: int = 0
    ) -> Clock:
        """Return the frame times of a trace, divided into runs at the gaps.

        A gap is a time step over ``longest`` (ns) or a skipped frame number.
        """
        gaps = (np.diff(times) > longest) | (np.diff(numbers) != 1)
        runs = np.concatenate(([0], np.cumsum(gaps)))[: len(times)]
        return cls(times, runs, period, tolerance)

    @property
    def gap_before(self) -> Bools:
        """Mask (F,) of the frames directly after a recording gap. The first frame does not count."""
        return np.concatenate(([False], np.diff(self.runs) != 0))[: len(self.times)]


class SignalValues:
    """Values of expressions over several frames, for some combinations of nodes.

    Subclasses provide the single-frame values.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def signal(self, signal: Ask) -> Column:
        """Return a number such as a speed for each node combination and frame, (B, F)."""
        raise NotImplementedError

    def condition(self, expression: b.Bound, test: Test) -> Bools:
        """Return a mask of the frames in which the condition inside ``run_length(…)`` or similar is true."""
        raise NotImplementedError

    def proposition(self, name: str) -> Bools:
        """Return a mask of the frames in which a named condition is true, for each combination, (B, F)."""
        raise NotImplementedError

    def margins(self, course: b.SignalCall, test: Test) -> Floats:
        """Return the margin of the condition in ``robustness(…)``, for each combination and frame, (B, F)."""
        raise NotImplementedError

    def test(self, test: Test) -> Column:
        """Return the value of an expression for each node combination and frame, (B, F).

        An axis of equal values has length 1.
        """
        with np.errstate(all="ignore"):
            found = _evaluator(test)(self)
        return Column(np.atleast_2d(found.values), found.known)

    def course(self, course: b.SignalCall, test: Test) -> Column:  # noqa: PLR0911 - a case each
        """Return the value of a function over time, such as ``delta(x, 2s)``, for each frame."""
        match course.word:
            case "prev":
                return self._back(self.signal(test.signals[course.operand]), 1)
            case "delta":
                return self._delta(self.signal(test.signals[course.operand]), course)
            case word if word in b.WINDOWS:
                signal = self.signal(test.signals[course.operand])
                return over_columns(
                    word, signal, self.window_starts(course), self.window_ends(course)
                )
            case "run_length":
                return self._run_length(self.condition(course.operand, test), frames=course.frames)
            case "since_true":
                return self._since(self.condition(course.operand, test), frames=course.frames)
            case "robustness":
                return Column(self.margins(course, test))
            case word:
                (node,) = b.nodes_of(course.operand)
                seen = self.proposition(test.presence[node])
                return self._age(seen) if word == "age" else Column(seen)

    def _back(self, column: Column, by: int | Ints) -> Column:
        """Return, for each frame, the value of a column a given number of frames earlier.

        Values before the trace or across a gap are unknown.
        """
        frames = len(self.clock.times)
        here = np.arange(frames)
        there = here - by if isinstance(by, int) else by
        inside = np.clip(there, 0, None)
        runs = self.clock.runs
        told = (there >= 0) & (runs[inside] == runs)
        values = np.broadcast_to(column.values, (len(column.values), frames))
        known = np.broadcast_to(column.known, (len(column.known), frames))
        return Column(values[:, inside], known[:, inside] & told)

    def window_starts(self, course: b.SignalCall) -> Ints:
        """For each frame, return the first frame of its time window.

        A window never crosses a gap.
        """
        times, here = self.clock.times, np.arange(len(self.clock.times))
        begun = np.maximum.accumulate(np.where(self.clock.gap_before, here, 0))
        if course.frames:
            return np.maximum(here - (course.by - 1), begun)
        then = times - course.by - self.clock.tolerance
        return np.maximum(np.searchsorted(times, then, "left"), begun)

    def window_ends(self, course: b.SignalCall) -> Ints | None:
        """For each frame, return the frame after its time window; None if all windows end at their frame."""
        if not course.ahead:
            return None
        times, frames = self.clock.times, len(self.clock.times)
        here = np.arange(frames)
        gaps = np.append(np.where(self.clock.gap_before, here, frames)[1:], frames)
        over = np.minimum.accumulate(gaps[::-1])[::-1]
        if course.frames:
            return np.minimum(here + course.ahead + 1, over)
        then = times + course.ahead + self.clock.tolerance
        return np.minimum(np.searchsorted(times, then, "right"), over)

    def _delta(self, now: Column, course: b.SignalCall) -> Column:
        times = self.clock.times
        by: int | Ints = course.by
        if not course.frames:
            then = times - course.by + self.clock.tolerance
            by = np.minimum(np.searchsorted(times, then, "right") - 1, np.arange(len(times)))
        before = self._back(now, by)
        known = now.known & before.known
        change = np.where(known, now.values, 0.0) - np.where(known, before.values, 0.0)
        if not b.is_angle(course.operand):
            return Column(change, known)
        return Column(self._turned(now, by, change), known)

    def _turned(self, now: Column, by: int | Ints, change: Array) -> Array:
        """Return, for each frame, the change of an angle since an earlier frame; degrees, with full turns.

        If values are missing, the shortest turn is assumed.
        """
        frames = len(self.clock.times)
        there = np.arange(frames) - by if isinstance(by, int) else by
        there = np.clip(there, 0, None)
        both = now.known[:, 1:] & now.known[:, :-1]
        steps = np.where(both, wrapped(np.diff(np.where(now.known, now.values, 0.0))), 0.0)
        sums, unseen = (_summed(part) for part in (steps, ~both))
        whole = unseen == unseen[:, there]
        return np.where(whole, sums - sums[:, there], wrapped(change))

    def _run_length(self, flags: Bools, *, frames: bool) -> Column:
        """For each frame, return the time for which a condition has been true without a break.

        It is in frames, or in s.
        """
        here = np.arange(flags.shape[1])
        first = flags.copy()
        first[:, 1:] = flags[:, 1:] & (~flags[:, :-1] | self.clock.gap_before[1:])
        start = np.maximum.accumulate(np.where(first, here, 0), axis=1)
        times = self.clock.times
        length = here - start + 1 if frames else (times - times[start]) / NS
        return Column(np.where(flags, length, 0))

    def _since(self, flags: Bools, *, frames: bool) -> Column:
        here = np.arange(flags.shape[1])
        last = np.maximum.accumulate(np.where(flags, here, -1), axis=1)
        times = self.clock.times
        ago = here - last if frames else (times - times[np.clip(last, 0, None)]) / NS
        return Column(ago, last >= 0)

    def _age(self, seen: Bools) -> Column:
        first = np.argmax(seen, axis=1)
        times = self.clock.times
        return Column((times - times[first][:, None]) / NS, seen)


@lru_cache(maxsize=256)
def _evaluator(test: Test) -> Columns[SignalValues]:
    return column_evaluator(test.expression, partial(_over_time, test=test))


def _over_time(part: b.Bound, test: Test) -> Columns[SignalValues] | None:
    if part in test.signals:
        signal = test.signals[part]
        return lambda at: at.signal(signal)
    match part:
        case b.SignalCall():
            return lambda at: at.course(part, test)
        case _ if part in test.formulas:
            return lambda at: Column(at.condition(part, test))
        case b.Operation(word=word, operands=operands) if word in _TOLERANT and lasts(part):
            compare = _TOLERANT[word]
            left, right = (column_evaluator(o, partial(_over_time, test=test)) for o in operands)

            def compared(at: SignalValues) -> Column:
                one, other, by = left(at), right(at), at.clock.tolerance / NS
                return Column(compare(one.values, other.values, by), all_known((one, other)))

            return compared
        case _:
            return None


def lasts(expression: b.Bound) -> bool:
    """True if an expression contains a duration in seconds, such as ``run_length(c)``."""
    parts = b.walk(expression)
    return any(isinstance(p, b.SignalCall) and p.word in _TIMES and not p.frames for p in parts)


_TIMES: Final = frozenset({"run_length", "since_true", "age"})


def wrapped(degrees: Any) -> Any:
    """Return angles converted to the range [-180, 180) degrees."""
    return (degrees + 180.0) % 360.0 - 180.0


def _summed(steps: Array) -> Array:
    return np.concatenate((np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)), axis=1)


_TOLERANT: Final[Mapping[str, Callable[[Array, Array, float], Array]]] = {
    "=": lambda one, other, by: np.abs(one - other) <= by,
    "<>": lambda one, other, by: np.abs(one - other) > by,
    "<": lambda one, other, by: one < other - by,
    "<=": lambda one, other, by: one <= other + by,
    ">": lambda one, other, by: one > other + by,
    ">=": lambda one, other, by: one >= other - by,
}
"""Comparison operators for times. Times within the tolerance are equal."""
