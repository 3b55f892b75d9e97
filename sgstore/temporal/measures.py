"""Values over time as columns: ``prev``, ``delta``, ``run_length``, ``since_true``, ``age``, and terms of them.

A :class:`Column` has a row for each binding and a column for each frame, and says where it is known. Gaps in a
recording are not bridged: behind one, ``prev`` and ``delta`` are unknown and runs begin anew.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang import bound as b

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from sgstore.temporal.plans import Signal, Test
    from sgstore.world import Bools, Ints

    Array = NDArray[Any]

ANGLES: Final = frozenset(
    {"heading", "pitch", "roll", "bearing", "rel_heading", "apparent_heading"}
)
"""Values that come round after 360 degrees."""

NS: Final = 1e9


@dataclass(frozen=True, slots=True)
class Column:
    """Values: (B, F), or (1, F) and (1, 1) for what is the same for all; and where they are known."""

    values: Array
    known: Bools

    @property
    def true(self) -> Bools:
        """Where it is true; unknown is not."""
        return self.known & self.values.astype(np.bool_)


@dataclass(frozen=True, slots=True)
class Clock:
    """The frames of a trace.

    Attributes
    ----------
    times : (F,) int64
        Ascending; ns.
    runs : (F,) int64
        Number of the stretch without gaps that each frame is in.
    period : int
        Median time between two frames; ns.
    """

    times: Ints
    runs: Ints
    period: int

    @classmethod
    def of(cls, times: Ints, numbers: Ints, period: int, longest: float) -> Clock:
        """A clock whose gaps are times of more than ``longest`` periods, and numbers of frames left out."""
        apart = np.diff(times)
        gaps = (apart > longest * period) | (np.diff(numbers) != 1)
        return cls(times, np.concatenate(([0], np.cumsum(gaps)))[: len(times)], period)

    @property
    def gap_before(self) -> Bools:
        """(F,) whether a gap ends at a frame; nothing comes before the first one."""
        return np.concatenate(([False], np.diff(self.runs) != 0))[: len(self.times)]


class Measured:
    """The value of a test for some bindings.

    Parameters
    ----------
    test : Test
    clock : Clock
    signal : function
        Gives the values of a signal.
    condition : function
        Gives the value of a condition within the test: (B, F) bool.
    present : function
        Gives where the atom of that name is true: (B, F) bool.
    """

    def __init__(
        self,
        test: Test,
        clock: Clock,
        signal: Callable[[Signal], Column],
        condition: Callable[[b.Bound], Bools],
        present: Callable[[str], Bools],
    ) -> None:
        self._test, self._clock = test, clock
        self._signal, self._condition, self._present = signal, condition, present

    def column(self, expression: b.Bound | None = None) -> Column:
        """The value of an expression of the test, the whole one by default."""
        if expression is None:
            expression = self._test.expression
        if expression in self._test.signals:
            return self._signal(self._test.signals[expression])
        match expression:
            case b.Value(value=value):
                known = np.full((1, 1), value is not None)
                return Column(np.full((1, 1), 0 if value is None else value), known)
            case b.Course():
                return self._course(expression)
            case b.Tense():
                return _certain(self._condition(expression))
            case b.Operation():
                return self._operation(expression)
            case _:
                raise TypeError(f"{expression} has no value over time")

    def _course(self, course: b.Course) -> Column:
        match course.word:
            case "prev":
                return self._back(self.column(course.operand), 1)
            case "delta":
                return self._delta(course)
            case "run_length":
                return self._run_length(self._condition(course.operand), frames=course.frames)
            case "since_true":
                return self._since(self._condition(course.operand), frames=course.frames)
            case "age":
                return self._age(self._seen(course))
            case _:
                return _certain(self._seen(course))

    def _seen(self, course: b.Course) -> Bools:
        (node,) = b.nodes_of(course.operand)
        return self._present(self._test.presence[node])

    def _back(self, column: Column, by: int | Ints) -> Column:
        """The values some frames before, unknown where there are none or a gap lies between."""
        frames = len(self._clock.times)
        here = np.arange(frames)
        there = here - by if isinstance(by, int) else by
        inside = np.clip(there, 0, None)
        runs = self._clock.runs
        told = (there >= 0) & (runs[inside] == runs)
        values = np.broadcast_to(column.values, (len(column.values), frames))
        known = np.broadcast_to(column.known, (len(column.known), frames))
        return Column(values[:, inside], known[:, inside] & told)

    def _delta(self, course: b.Course) -> Column:
        now, times = self.column(course.operand), self._clock.times
        by = course.by if course.frames else np.searchsorted(times, times - course.by, "right") - 1
        before = self._back(now, by)
        known = now.known & before.known
        change = np.where(known, now.values, 0.0) - np.where(known, before.values, 0.0)
        if not is_angle(course.operand):
            return Column(change, known)
        return Column(self._turned(now, by, change), known)

    def _turned(self, now: Column, by: int | Ints, change: Array) -> Array:
        """How far something turned, all the way round if it did; the short way where it was not seen."""
        frames = len(self._clock.times)
        there = np.arange(frames) - by if isinstance(by, int) else by
        there = np.clip(there, 0, None)
        both = now.known[:, 1:] & now.known[:, :-1]
        steps = np.where(both, _wrapped(np.diff(np.where(now.known, now.values, 0.0))), 0.0)
        sums, unseen = (_summed(part) for part in (steps, ~both))
        whole = unseen == unseen[:, there]
        return np.where(whole, sums - sums[:, there], _wrapped(change))

    def _run_length(self, flags: Bools, *, frames: bool) -> Column:
        """How long a condition has held up to each frame: number of frames, or s from the first of them."""
        here = np.arange(flags.shape[1])
        first = flags.copy()
        first[:, 1:] = flags[:, 1:] & (~flags[:, :-1] | self._clock.gap_before[1:])
        start = np.maximum.accumulate(np.where(first, here, 0), axis=1)
        times = self._clock.times
        length = here - start + 1 if frames else (times - times[start]) / NS
        return _certain(np.where(flags, length, 0))

    def _since(self, flags: Bools, *, frames: bool) -> Column:
        here = np.arange(flags.shape[1])
        last = np.maximum.accumulate(np.where(flags, here, -1), axis=1)
        times = self._clock.times
        ago = here - last if frames else (times - times[np.clip(last, 0, None)]) / NS
        return Column(ago, last >= 0)

    def _age(self, seen: Bools) -> Column:
        first = np.argmax(seen, axis=1)
        times = self._clock.times
        return Column((times - times[first][:, None]) / NS, seen)

    def _operation(self, operation: b.Operation) -> Column:
        if operation.word == "IN":
            return self._membership(operation)
        if operation.word == "=~":
            return self._regex(operation)
        parts = [self.column(operand) for operand in operation.operands]
        if operation.word in _LOGIC:
            return _LOGIC[operation.word](parts)
        with np.errstate(all="ignore"):
            values, defined = _FUNCTIONS[operation.word](*(part.values for part in parts))
        known = _everywhere([part.known for part in parts])
        return Column(values, known & defined)

    def _membership(self, operation: b.Operation) -> Column:
        operand, choices = operation.operands
        assert isinstance(choices, b.Choices)  # noqa: S101 - the binder built it so
        found = self.column(operand)
        items = [item.value for item in choices.items]
        same = [found.values == item for item in items]
        if not same:
            return _certain(np.zeros(found.values.shape, np.bool_))
        return Column(np.logical_or.reduce(same), found.known)

    def _regex(self, operation: b.Operation) -> Column:
        text, pattern = operation.operands
        assert isinstance(pattern, b.Value)  # noqa: S101 - the binder built it so
        found, wanted = self.column(text), re.compile(str(pattern.value))
        words, places = np.unique(
            np.where(found.known, found.values, "").astype(str), return_inverse=True
        )
        flags = np.array([wanted.fullmatch(word) is not None for word in words], np.bool_)
        return Column(flags[places].reshape(found.values.shape), found.known)


def is_angle(value: b.Bound) -> bool:
    """Whether a value comes round after 360 degrees."""
    match value:
        case b.NodeAttribute(attribute=attribute):
            return attribute.name in ANGLES
        case b.PairNumber(function=function):
            return function in ANGLES
        case _:
            return False


def _certain(values: Array) -> Column:
    return Column(values, np.ones((1, 1), np.bool_))


def _everywhere(flags: list[Bools]) -> Bools:
    """Where all are true."""
    return np.asarray(np.logical_and.reduce(np.broadcast_arrays(*flags)), np.bool_)


def _wrapped(degrees: Array) -> Array:
    return (degrees + 180.0) % 360.0 - 180.0


def _summed(steps: Array) -> Array:
    return np.concatenate((np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)), axis=1)


# Operations -------------------------------------------------------------------------------------------------


def _null_test(parts: list[Column]) -> Column:
    return _certain(~parts[0].known)


def _known_test(parts: list[Column]) -> Column:
    return _certain(parts[0].known)


def _coalesce(parts: list[Column]) -> Column:
    found = parts[-1]
    for part in reversed(parts[:-1]):
        found = Column(np.where(part.known, part.values, found.values), part.known | found.known)
    return found


def _and(parts: list[Column]) -> Column:
    true = _everywhere([part.true for part in parts])
    false = ~_everywhere([~(part.known & ~part.true) for part in parts])
    return Column(true, true | false)


def _not(parts: list[Column]) -> Column:
    return Column(~parts[0].true, parts[0].known)


def _or(parts: list[Column]) -> Column:
    return _not([_and([_not([part]) for part in parts])])


def _xor(parts: list[Column]) -> Column:
    odd = np.logical_xor.reduce(np.broadcast_arrays(*(part.true for part in parts)))
    return Column(odd, _everywhere([part.known for part in parts]))


def _implies(parts: list[Column]) -> Column:
    return _or([_not(parts[:1]), parts[1]])


_LOGIC: Final[Mapping[str, Callable[[list[Column]], Column]]] = {
    "AND": _and,
    "OR": _or,
    "NOT": _not,
    "XOR": _xor,
    "IMPLIES": _implies,
    "IS NULL": _null_test,
    "IS NOT NULL": _known_test,
    "coalesce": _coalesce,
}


def _total(function: Callable[..., Any]) -> Callable[..., tuple[Array, Any]]:
    """A function that is defined everywhere."""

    def defined(*values: Array) -> tuple[Array, Any]:
        return function(*values), True

    return defined


def _divided(a: Array, by: Array) -> tuple[Array, Array]:
    fits = np.asarray(by) != 0
    return np.divide(a, np.where(fits, by, 1)), fits


def _remainder(a: Array, by: Array) -> tuple[Array, Array]:
    fits = np.asarray(by) != 0
    return np.fmod(a, np.where(fits, by, 1)), fits


def _root(a: Array) -> tuple[Array, Array]:
    fits = np.asarray(a) >= 0
    return np.sqrt(np.where(fits, a, 0)), fits


def _rounded(a: Array) -> Array:
    return np.copysign(np.floor(np.abs(a) + 0.5), a)


def _least(*values: Array) -> Array:
    return np.minimum.reduce(np.broadcast_arrays(*values))


def _greatest(*values: Array) -> Array:
    return np.maximum.reduce(np.broadcast_arrays(*values))


def _of_texts(function: Callable[..., Any]) -> Callable[..., tuple[Array, Any]]:
    def defined(*values: Array) -> tuple[Array, Any]:
        return function(*(np.asarray(value).astype(str) for value in values)), True

    return defined


def _contains(text: Array, part: Array) -> Array:
    return np.char.find(text, part) >= 0


_FUNCTIONS: Final[Mapping[str, Callable[..., tuple[Array, Any]]]] = {
    "=": _total(np.equal),
    "<>": _total(np.not_equal),
    "<": _total(np.less),
    "<=": _total(np.less_equal),
    ">": _total(np.greater),
    ">=": _total(np.greater_equal),
    "+": _total(np.add),
    "-": _total(np.subtract),
    "*": _total(np.multiply),
    "/": _divided,
    "%": _remainder,
    "negative": _total(np.negative),
    "abs": _total(np.abs),
    "sqrt": _root,
    "floor": _total(np.floor),
    "ceil": _total(np.ceil),
    "round": _total(_rounded),
    "min": _total(_least),
    "max": _total(_greatest),
    "lower": _of_texts(np.char.lower),
    "upper": _of_texts(np.char.upper),
    "STARTS WITH": _of_texts(np.char.startswith),
    "ENDS WITH": _of_texts(np.char.endswith),
    "CONTAINS": _of_texts(_contains),
}
