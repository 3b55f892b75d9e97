"""Aggregates over the frames of a match: minimum, maximum, mean, first value, and their times.

Offline, a match is a row of bindings and a frame interval. Online, a :class:`Fold` is the aggregate of an
interval, and consecutive ones are combined.

Unknown values are ignored, except for ``first`` and ``last``: they are the values of the first and last frame,
even if unknown. Sums are rounded once, so the order of the additions does not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.json_text import shortest
from sgstore.lang import ir as b
from sgstore.lang.memory import expression
from sgstore.lang.operators import Column

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Ints

    Objects = NDArray[np.object_]


class ReturnedValues:
    """``RETURN`` values of a match, computed from aggregates over its frames and from step times.

    Parameters
    ----------
    columns : sequence of ReturnColumn
    word : str
        Default aggregate of a single-frame value: ``first`` or ``last``.
    having : Bound, optional
        ``HAVING`` condition on these values.

    Attributes
    ----------
    parts : tuple of OverMatch
        Distinct parts of the values. Single-frame parts have the steps :data:`AT_FRAME`.
    """

    def __init__(
        self, columns: Sequence[b.ReturnColumn], word: str, having: b.Bound | None = None
    ) -> None:
        self._word = word
        self._columns = [(column.name, self._of_match(column.value)) for column in columns]
        self._having = None if having is None else self._of_match(having)
        self._single = frozenset(column.name for column in columns if column.single)
        values = [*(value for _, value in self._columns), *filter(None, [self._having])]
        found = (part for value in values for part in b.walk(value))
        self.parts = tuple(dict.fromkeys(part for part in found if isinstance(part, b.OverMatch)))

    def _of_match(self, value: b.Bound) -> b.Bound:
        if isinstance(value, b.OverMatch | b.StepTime | b.Value | b.Choices):
            return value
        if any(isinstance(part, b.OverMatch | b.StepTime) for part in b.walk(value)):
            return b.with_operands(value, self._of_match)
        return b.OverMatch(self._word, value, AT_FRAME, AT_FRAME, None, value.type)

    def told(
        self,
        part: Callable[[b.OverMatch], Any],
        seconds: Callable[[int], float | None] | None = None,
    ) -> dict[str, Any] | None:
        """Return the ``RETURN`` values of one match, column → value; None if its ``HAVING`` is false.

        Parameters
        ----------
        part : function
            Function that returns the value of a part.
        seconds : function, optional
            Function that returns the time of a step.
        """

        def known(value: b.Bound) -> b.Bound:
            if isinstance(value, b.OverMatch):
                return b.Value(part(value), value.type)
            if isinstance(value, b.StepTime) and seconds is not None:
                return b.Value(seconds(value.step), value.type)
            return b.with_operands(value, known)

        nothing: Any = None  # constants need no query

        def result(value: b.Bound) -> Any:
            return expression(known(value), injective=False)(nothing)

        if self._having is not None and not result(self._having):
            return None
        told = {name: result(value) for name, value in self._columns}
        return {n: shortest(v) if n in self._single else v for n, v in told.items()}


AT_FRAME: Final = -1
"""Number that stands for the single frame of a value, in place of a step number."""


@dataclass(frozen=True, slots=True)
class Stretches:
    """First and last frame of each match, and the row for its nodes in the arrays of values.

    Attributes
    ----------
    rows : (M,) int64
        Row of each interval's binding in the value columns.
    first, last : (M,) int64
        First and last frames. No interval is empty.
    """

    rows: Ints
    first: Ints
    last: Ints

    def told(self, word: str, column: Column, at: Column | None = None) -> Objects:
        """For each match, return an aggregate of the values in its frames, or None if unknown.

        Parameters
        ----------
        word : str
            One of :data:`sgstore.lang.ir.OF_MATCH`.
        column : Column
            (B, F), or of length 1 in an axis.
        at : Column, optional
            For ``argmin`` and ``argmax``: the value to return at the found frame.
        """
        if not len(self.rows):
            return np.zeros(0, np.object_)
        if word in {"first", "last"}:
            frames = self.first if word == "first" else self.last
            return picked(column, self.rows, frames)
        counts = self.last - self.first + 1
        starts = np.cumsum(counts) - counts
        frames = np.arange(int(counts.sum())) - np.repeat(starts - self.first, counts)
        rows = np.repeat(self.rows, counts)
        told = None if at is None else Column(*_at(at, rows, frames))
        return over_rows(word, Column(*_at(column, rows, frames)), starts, told)


def over_rows(word: str, column: Column, starts: Ints, at: Column | None = None) -> Objects:
    """For each group of rows, return an aggregate such as the minimum, or None if unknown.

    Parameters
    ----------
    word : str
        One of :data:`sgstore.lang.ir.OF_MATCH`.
    column : Column
        (R,), or (1, R).
    starts : (M,) int64
        First row of each group. Groups are consecutive and not empty.
    at : Column, optional
        For ``argmin`` and ``argmax``: the value to return at the found row.

    Returns
    -------
    (M,) object
    """
    values, known = np.ravel(column.values), np.ravel(column.known)
    counts = np.diff(starts, append=len(values))
    if word in {"first", "last"}:
        return _told(values, known, starts if word == "first" else starts + counts - 1)
    values = np.asarray(values, np.float64)
    known = known & ~np.isnan(values)
    if word in {"avg", "sum"}:
        return _summed(word, values, known & np.isfinite(values), starts)
    if not len(starts):
        return np.zeros(0, np.object_)
    sign = 1.0 if word in {"min", "argmin"} else -1.0
    values = np.where(known, sign * values, np.inf)
    some = np.logical_or.reduceat(known, starts)
    best = np.minimum.reduceat(values, starts)
    if at is None:
        found = (sign * best).astype(object)
    else:
        hit = known & (values == np.repeat(best, counts))
        places = np.where(hit, np.arange(len(values)), len(values))
        place = np.minimum.reduceat(places, starts)
        place = np.where(some, place, starts)
        found = _told(np.ravel(at.values), np.ravel(at.known), place)
    found[~some] = None
    return found


def picked(column: Column, rows: Ints, frames: Ints) -> Objects:
    """Return the values at some rows and frames as Python objects, with None for unknown ones.

    Parameters
    ----------
    column : Column
        (B, F), or of length 1 in an axis.
    rows, frames : (M,) int64
    """
    values, known = _at(column, rows, frames)
    return _told(values, known, slice(None))


def _told(values: Any, known: Any, places: Any) -> Objects:
    found = values[places].astype(object)
    found[~known[places]] = None
    return found


def _at(column: Column, rows: Ints, frames: Ints) -> tuple[Any, Bools]:
    """Return the values at some rows and frames, and a mask of the known ones.

    Axes of length 1 are broadcast.
    """

    def some(array: Any) -> Any:
        array = np.atleast_2d(array)
        row = rows if array.shape[0] > 1 else np.zeros_like(rows)
        return array[row, frames if array.shape[1] > 1 else np.zeros_like(frames)]

    return some(column.values), some(column.known)


def _summed(word: str, values: Any, known: Bools, starts: Ints) -> Objects:
    ends = np.append(starts[1:], len(values))[: len(starts)].tolist()
    found = np.full(len(starts), None, object)
    for number, (start, end) in enumerate(zip(starts.tolist(), ends, strict=True)):
        some = values[start:end][known[start:end]].tolist()
        if some:
            found[number] = math.fsum(some) / (len(some) if word == "avg" else 1)
    return found
