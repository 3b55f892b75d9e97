"""Online aggregates over the frames of a match, updated frame by frame.

The history of a value begins at the first frame that a match may still need. Frames between possible match ends
are merged. So the memory grows with the number of open matches, not with their duration.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.temporal._binding_truth import Valuation
from sgstore.temporal._valuation import BindingTable
from sgstore.temporal._windows import exact, rounded

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang import ir as b
    from sgstore.lang.operators import Column
    from sgstore.temporal._plan import Plan
    from sgstore.temporal._signal_state import StreamClock
    from sgstore.temporal._valuation import Memory, QueryCache

    Objects = NDArray[np.object_]
    Entry = tuple[Memory, tuple["Fold", ...]]

Span = tuple[int, int]
"""First and last frame number of a part of a match."""


class _Course:
    """Recent values of one expression for all matched nodes. A value stays until no later match can need it."""

    def __init__(
        self,
        value: b.OverMatch,
        plan: Plan,
        questions: QueryCache,
        pulse: StreamClock,
        *,
        bridge: bool,
    ) -> None:
        self._word, self._pulse = value.word, pulse
        self._test = plan.test(value.operand).name
        self._at = None if value.at is None else plan.test(value.at).name
        self._variables = tuple(sorted({n for ask in plan.asks.values() for n in ask.variables}))
        self._valuation = Valuation(plan, self._variables, questions, pulse, bridge=bridge)
        begun: Entry = self._valuation.begun, ()
        self._known: BindingTable[Entry] = BindingTable(self._valuation.lattice, begun)

    def step(self) -> None:
        """Add the value of the next frame. The query results of the frame must be ready."""
        known, word, number = self._known, self._word, self._pulse.tick.number
        letters, memories = self._valuation.read(known.held, lambda row: known.of(row)[0])
        values = self._told(self._test, len(letters))
        at = self._told(self._at, len(letters)) if self._at is not None else values
        found: dict[Any, Entry] = {}
        for row, value, there in zip(letters, values, at, strict=True):
            _, folds = known.of(row)
            new = Fold.of(word, number, value, there)
            found[row] = memories[row], folds if new is None else (*folds, new)
        known.held = found

    def _told(self, test: str, rows: int) -> list[Any]:
        column: Column = self._valuation.columns[test]
        known = np.broadcast_to(np.atleast_2d(column.known)[:, 0], rows).tolist()
        values = np.broadcast_to(column.values[:, 0], rows).tolist()
        return [value if there else None for value, there in zip(values, known, strict=True)]

    def value(self, binding: Mapping[str, int | None], span: Span) -> Any:
        """Return an aggregate of the values of some nodes in a range of frames."""
        start, end = span
        _, folds = self._known.of(tuple(binding.get(name) for name in self._variables))
        inside = [fold for fold in folds if start <= fold.start and fold.end <= end]
        return reduce(Fold.joined, inside).told(self._word, start, end) if inside else None

    def forget(self, kept: Sequence[int]) -> None:
        """Merge stored values to save memory. Only frames where a later match may begin or end stay separate.

        ``kept`` lists the frames at which a later range may begin or end.
        """
        held = {
            row: (memory, _merged(folds, kept)) for row, (memory, folds) in self._known.held.items()
        }
        self._known.keep(held, lambda one, other: one == other)


def _merged(folds: tuple[Fold, ...], kept: Sequence[int]) -> tuple[Fold, ...]:
    if not kept or not folds:
        return ()
    found: list[Fold] = []
    for fold in folds[bisect_left(folds, kept[0], key=lambda one: one.start) :]:
        apart = not found or bisect_left(kept, found[-1].start) < bisect_right(kept, fold.end)
        if apart:
            found.append(fold)
        else:
            found[-1] = found[-1].joined(fold)
    return tuple(found)


class MatchValues:
    """Online aggregates over the frames of the matches of one trace.

    Parameters
    ----------
    parts : iterable of OverMatch
    plan : function
        Function that returns an empty plan for the nodes and edges of the matches.
    questions : QueryCache
        Query cache; the queries of the values are added.
    pulse : StreamClock
        Clock, updated with each frame before this object.
    bridge : bool
        True to ignore gaps.

    Raises
    ------
    QueryError
        A value depends on later frames.
    """

    def __init__(
        self,
        parts: Iterable[b.OverMatch],
        plan: Callable[[], Plan],
        questions: QueryCache,
        pulse: StreamClock,
        *,
        bridge: bool,
    ) -> None:
        self._courses: dict[b.OverMatch, _Course] = {}
        for course in map(_anywhere, parts):
            if course not in self._courses:
                made = _Course(course, plan(), questions, pulse, bridge=bridge)
                self._courses[course] = made

    def step(self) -> None:
        """Add the values of the next frame. The query results of the frame must be ready."""
        for course in self._courses.values():
            course.step()

    def forget(self, kept: Iterable[int]) -> None:
        """Merge the values of old frames, except those in ``kept``, at which a later match may begin or end.

        Parameters
        ----------
        kept : iterable of int
            Numbers of the frames at which a part of a match may begin or end.
        """
        ordered = sorted(set(kept))
        for course in self._courses.values():
            course.forget(ordered)

    def value(self, part: b.OverMatch, binding: Mapping[str, int | None], span: Span) -> Any:
        """Return an aggregate of a match's values in a range of frames, or None if unknown.

        Parameters
        ----------
        part : OverMatch
        binding : mapping of str to int or None
            ``None`` means a node without known values.
        span : (int, int)
            First and last frame number.
        """
        return self._courses[_anywhere(part)].value(binding, span)


def _anywhere(value: b.OverMatch) -> b.OverMatch:
    return replace(value, start=None, end=None)


@dataclass(frozen=True, slots=True)
class Fold:
    """Aggregates (minimum, sum, first, …) of a value over a range of consecutive frames.

    Attributes
    ----------
    start, end : int
        First and last frame number with a known value.
    first, last : object
        Values in the first and the last of these frames.
    best : float
        Minimum; for ``max`` and ``argmax``, the negated maximum.
    at : object
        Value to return at the first frame of the best value.
    total : int
        Sum, as a multiple of the smallest positive float.
    count : int
        Number of values in the sum.
    """

    start: int
    end: int
    first: Any
    last: Any
    best: float = math.inf
    at: Any = None
    total: int = 0
    count: int = 0

    @classmethod
    def of(cls, word: str, frame: int, value: Any, at: Any) -> Fold | None:
        """Return the aggregates of a single frame; None if its value is unknown or not needed."""
        if value is None:
            return None
        if word in {"first", "last"}:
            return cls(frame, frame, value, value)
        if word in {"avg", "sum"}:
            if not math.isfinite(value):
                return None
            return cls(frame, frame, value, value, total=exact(value), count=1)
        if math.isnan(value):
            return None
        best = value if word in {"min", "argmin"} else -value
        return cls(frame, frame, value, value, best, at)

    def joined(self, later: Fold) -> Fold:
        """Return the aggregates of this range of frames combined with those of the range after it.

        For equal extremes, the earlier frame counts.
        """
        better = self if self.best <= later.best else later
        total, count = self.total + later.total, self.count + later.count
        return Fold(
            self.start, later.end, self.first, later.last, better.best, better.at, total, count
        )

    def told(self, word: str, start: int, end: int) -> Any:
        """Return one aggregate, such as the minimum, of the values in this range of frames."""
        match word:
            case "first":
                return self.first if self.start == start else None
            case "last":
                return self.last if self.end == end else None
            case "min":
                return self.best
            case "max":
                return -self.best
            case "argmin" | "argmax":
                return self.at
            case _:
                total = rounded(self.total)
                return total / self.count if word == "avg" else total
