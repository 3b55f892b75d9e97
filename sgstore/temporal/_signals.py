"""Signals and formulas over whole traces, as columns.

A column has a truth value for each frame; operators map columns to columns. An *until* compares two frames: the
next frame in its bound at which its right side holds, and the next frame at which its left side fails.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.memory import column_evaluator
from sgstore.lang.operators import Column, all_known
from sgstore.temporal._formula import (
    TRUE,
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
from sgstore.temporal._windows import over_columns

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from sgstore.lang.memory import Columns
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.temporal._plan import Ask, Test

    Places = NDArray[np.int32 | np.int64]
    Array = NDArray[Any]


def evaluate(formula: Formula, columns: Mapping[str, Bools], times: Ints) -> Bools:
    """Evaluate a formula at each frame of a trace.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (F,) bool
        Truth values of the propositions.
    times : (F,) int64
        Timestamps of the frames, ascending; ns.

    Returns
    -------
    (F,) bool
        Value of the formula at each frame.

    Raises
    ------
    ValueError
        A proposition is missing, columns have different lengths, or times do not ascend.
    """
    missing = sorted(propositions(formula) - set(columns))
    if missing:
        raise ValueError(f"no column for the proposition {missing[0]!r}")
    for name in propositions(formula):
        if columns[name].shape != times.shape:
            raise ValueError(f"{name} has shape {columns[name].shape}, expected {times.shape}")
    if np.any(np.diff(times) <= 0):
        raise ValueError("the times of the frames must ascend")
    if not len(times):
        return np.zeros(0, np.bool_)
    return PropositionTable(columns, times).whole(formula)


def evaluate_rows(formula: Formula, columns: Mapping[str, Bools], times: Ints, rows: int) -> Bools:
    """Evaluate a formula at each frame of a trace for several bindings.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (B, F) bool, or (1, F)
        Propositions of each binding; (1, F) if equal for all bindings.
    times : (F,) int64
        Times as in :func:`evaluate`; F is at least 1.
    rows : int
        B, the number of bindings.

    Returns
    -------
    (B, F) bool
    """
    found = PropositionTable(columns, times).value(formula)
    return np.broadcast_to(found, (rows, len(times)))


@dataclass(frozen=True, slots=True)
class PropositionTable:
    """Truth values of the propositions of a trace, and of formulas over them.

    Parameters
    ----------
    columns : mapping of str to (F,) bool, or (B, F), or (1, F)
    times : (F,) int64
        Ascending; ns.
    """

    columns: Mapping[str, Bools]
    times: Ints

    def whole(self, formula: Formula) -> Bools:
        """Return the value (F,) of a formula at each frame of a trace with at least one frame."""
        return self.value(formula)[0]

    def value(self, formula: Formula) -> Bools:  # noqa: PLR0911 - a case each
        """Return the value (B, F) of a formula at each frame, or (1, F) if equal for all bindings."""
        match formula:
            case TruthConstant(value=value):
                return np.full((1, len(self.times)), value)
            case Proposition(name=name):
                return np.atleast_2d(self.columns[name])
            case Not(operand=operand):
                return ~self.value(operand)
            case And(operands=operands):
                return reduce(np.logical_and, map(self.value, operands))
            case Or(operands=operands):
                return reduce(np.logical_or, map(self.value, operands))
            case Next(operand=operand, weak=weak):
                shifted = np.roll(self.value(operand), -1, axis=1)
                shifted[:, -1] = weak
                return shifted
            case Previous(operand=operand):
                shifted = np.roll(self.value(operand), 1, axis=1)
                shifted[:, 0] = False
                return shifted
            case Until(left=left, right=right, bound=bound):
                start, end = self.window(bound, forward=True)
                hit = _at(_next(self.value(right)), start)
                true = hit <= np.minimum(
                    len(self.times) - 1 if end is None else end, len(self.times) - 1
                )
                return true if left == TRUE else true & (hit <= _next(~self.value(left)))
            case Since(left=left, right=right, bound=bound):
                start, end = self.window(bound, forward=False)
                hit = _at(_last(self.value(right)), start)
                true = hit >= np.maximum(0 if end is None else end, 0)
                return true if left == TRUE else true & (hit >= _last(~self.value(left)))

    def window(self, bound: Bound, *, forward: bool) -> tuple[Places | None, Places | None]:
        """Return the nearest and farthest frame of an operator's bound, for each frame.

        ``None`` as nearest frame means the frame itself; as farthest frame, the trace end.
        """
        sign = 1 if forward else -1
        near = far = None
        here = self.frames
        low, high = bound.low, bound.high
        period = None if bound.frames else self._period
        if bound.frames or period:
            # With an even clock, counting frames is enough.
            unit = period or 1
            near = here + sign * min(-(-low // unit), len(here)) if low else None
            far = None if high is None else here + sign * min(high // unit, len(here))
        elif forward:
            near = np.searchsorted(self.times, _sum(self.times, low), "left") if low else None
            if high is not None:
                far = np.searchsorted(self.times, _sum(self.times, high), "right") - 1
        else:
            if low:
                near = np.searchsorted(self.times, self.times - low, "right") - 1
            if high is not None:
                far = np.searchsorted(self.times, self.times - high, "left")
        return near, far

    @property
    def frames(self) -> Places:
        """Numbers of the frames, shape (F,)."""
        return _frames(len(self.times))

    @property
    def _period(self) -> int | None:
        """Constant time between frames; ns. ``None`` means a varying time."""
        if len(self.times) < 2:
            return None
        period = int(self.times[1] - self.times[0])
        return period if bool(np.all(np.diff(self.times) == period)) else None


def _sum(times: Ints, by: int) -> Ints:
    return np.minimum(times, np.iinfo(np.int64).max - by) + by


def _frames(frames: int) -> Places:
    return np.arange(frames, dtype=np.int32 if frames < 1 << 29 else np.int64)


def _next(flags: Bools) -> Places:
    frames = flags.shape[1]
    here = _frames(frames)
    places = np.where(flags, here, here.dtype.type(frames))[:, ::-1]
    return np.minimum.accumulate(places, axis=1)[:, ::-1]


def _last(flags: Bools) -> Places:
    here = _frames(flags.shape[1])
    return np.maximum.accumulate(np.where(flags, here, here.dtype.type(-1)), axis=1)


def _at(places: Places, frame: Places | None) -> Places:
    """Return values at other frames. Before the trace, return -1; after it, F."""
    if frame is None:
        return places
    frames = places.shape[1]
    inside = (frame >= 0) & (frame < frames)
    told = places[:, np.clip(frame, 0, frames - 1)]
    return np.where(inside, told, np.where(frame < 0, -1, frames))


# Values over time as columns: ``prev``, ``delta``, windows, ``run_length``, ``since_true``, ``age``, and terms
# of them --------------------------------------------------------------------------------------------
# A column of values, :class:`sgstore.lang.operators.Column`, has a row for each binding and a column for each
# frame. Values do not cross gaps: after a gap, ``prev`` and ``delta`` are unknown, and runs and windows
# restart.

NS: Final = 1e9


@dataclass(frozen=True, slots=True)
class Clock:
    """Times and runs of the frames of a trace.

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
        """Return a clock with gaps at time steps over ``longest`` (ns) and at skipped frame numbers."""
        gaps = (np.diff(times) > longest) | (np.diff(numbers) != 1)
        runs = np.concatenate(([0], np.cumsum(gaps)))[: len(times)]
        return cls(times, runs, period, tolerance)

    @property
    def gap_before(self) -> Bools:
        """Mask (F,) of the frames directly after a gap. The first frame is not one of them."""
        return np.concatenate(([False], np.diff(self.runs) != 0))[: len(self.times)]


class SignalValues:
    """Values of the tests of a plan for some bindings. Subclasses provide signals and propositions.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def signal(self, signal: Ask) -> Column:
        """Return the values (B, F) of a signal."""
        raise NotImplementedError

    def condition(self, expression: b.Bound, test: Test) -> Bools:
        """Return a mask (B, F) of the frames in which a condition inside a test is true."""
        raise NotImplementedError

    def proposition(self, name: str) -> Bools:
        """Return a mask (B, F) of the frames in which an atom or test is true."""
        raise NotImplementedError

    def margins(self, course: b.SignalCall, test: Test) -> Floats:
        """Return the margins (B, F) of a condition inside a test."""
        raise NotImplementedError

    def test(self, test: Test) -> Column:
        """Return the value of a test: (B, F), with length 1 in an axis of equal values."""
        with np.errstate(all="ignore"):
            found = _evaluator(test)(self)
        return Column(np.atleast_2d(found.values), found.known)

    def course(self, course: b.SignalCall, test: Test) -> Column:  # noqa: PLR0911 - a case each
        """Return the value of a :class:`~sgstore.lang.ir.SignalCall`."""
        match course.word:
            case "prev":
                return self._back(self.signal(test.signals[course.operand]), 1)
            case "delta":
                return self._delta(self.signal(test.signals[course.operand]), course)
            case word if word in b.WINDOWS:
                signal = self.signal(test.signals[course.operand])
                return over_columns(word, signal, self.window_starts(course))
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
        """Return the values some frames earlier. Values before the trace start or across a gap are unknown."""
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
        """Return the first frame of the time window at each frame, shape (F,). A window never crosses a gap."""
        times, here = self.clock.times, np.arange(len(self.clock.times))
        begun = np.maximum.accumulate(np.where(self.clock.gap_before, here, 0))
        if course.frames:
            return np.maximum(here - (course.by - 1), begun)
        then = times - course.by - self.clock.tolerance
        return np.maximum(np.searchsorted(times, then, "left"), begun)

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
        """Return the change of an angle with full turns. If values are missing, assume the shortest turn."""
        frames = len(self.clock.times)
        there = np.arange(frames) - by if isinstance(by, int) else by
        there = np.clip(there, 0, None)
        both = now.known[:, 1:] & now.known[:, :-1]
        steps = np.where(both, wrapped(np.diff(np.where(now.known, now.values, 0.0))), 0.0)
        sums, unseen = (_summed(part) for part in (steps, ~both))
        whole = unseen == unseen[:, there]
        return np.where(whole, sums - sums[:, there], wrapped(change))

    def _run_length(self, flags: Bools, *, frames: bool) -> Column:
        """Return the duration for which a condition has held, at each frame: in frames, or in s."""
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
    """True if the expression depends on a duration in seconds."""
    parts = b.walk(expression)
    return any(isinstance(p, b.SignalCall) and p.word in _TIMES and not p.frames for p in parts)


_TIMES: Final = frozenset({"run_length", "since_true", "age"})


def wrapped(degrees: Any) -> Any:
    """Return angles in [-180, 180) degrees."""
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
"""Comparisons of times with a tolerance for equality."""
