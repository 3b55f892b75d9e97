"""When the value of a formula is certain: the first frame that shows it, whatever may follow.

For each frame of a trace two numbers: from which frame on it is known that a formula is true there, and from
which on that it is false; the number of frames, if the trace ends before that is known. They are made of those
of the parts, as logic without search tells: a conjunction is false once one of its parts is known to be, and
true once all are. It is what :mod:`sgstore.temporal.progression` knows frame by frame, for all frames at once.

An *until* asks at each frame of its bound the same, so what is known of it is a chain of the least and the
greatest of numbers; chains of 2, 4, 8, … frames are put together for all frames, in O(n log n).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sgstore.temporal.formulas import (
    TRUE,
    And,
    Bound,
    Constant,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    Until,
)

if TYPE_CHECKING:
    from sgstore.temporal.columns import Places, Table
    from sgstore.world import Bools


@dataclass(frozen=True, slots=True)
class Known:
    """From which frame on something is known of each frame, (F,); F: never.

    Attributes
    ----------
    true, false : (F,) int32 or int64
        That it is true, that it is false.
    """

    true: Places
    false: Places


def known(formula: Formula, table: Table) -> Known:
    """When it is certain what a formula is at each frame.

    Parameters
    ----------
    formula : Formula
    table : Table
        The trace.
    """
    return _Knowing(table).of(formula)


class _Knowing:
    def __init__(self, table: Table) -> None:
        self._table = table
        self._frames = len(table.times)
        self._here = table.frames
        self._found: dict[Formula, Known] = {}

    def of(self, formula: Formula) -> Known:
        if formula not in self._found:
            self._found[formula] = self._of(formula)
        return self._found[formula]

    def _of(self, formula: Formula) -> Known:  # noqa: PLR0911 - a case each
        match formula:
            case Constant(value=value):
                return self._now(np.full(self._frames, value))
            case Proposition(name=name):
                return self._now(self._table.columns[name])
            case Not(operand=operand):
                told = self.of(operand)
                return Known(told.false, told.true)
            case And(operands=operands):
                parts = [self.of(operand) for operand in operands]
                true = np.maximum.reduce([part.true for part in parts])
                return Known(true, np.minimum.reduce([part.false for part in parts]))
            case Or(operands=operands):
                parts = [self.of(operand) for operand in operands]
                true = np.minimum.reduce([part.true for part in parts])
                return Known(true, np.maximum.reduce([part.false for part in parts]))
            case Next(operand=operand):
                told = self.of(operand)
                never = np.full_like(self._here[:1], self._frames)
                return Known(*(np.append(part[1:], never) for part in (told.true, told.false)))
            case Previous(operand=operand):
                told = self.of(operand)
                true = np.append(np.full_like(self._here[:1], self._frames), told.true[:-1])
                false = np.append(self._here[:1], told.false[:-1])
                return Known(np.maximum(true, self._here), np.maximum(false, self._here))
            case Until():
                return self._until(formula)
            case Since():
                return self._since(formula)

    def _now(self, flags: Bools) -> Known:
        """What is known at the frame itself."""
        never = self._here.dtype.type(self._frames)
        return Known(np.where(flags, self._here, never), np.where(flags, never, self._here))

    def _until(self, formula: Until) -> Known:
        left = None if formula.left == TRUE else self.of(formula.left)
        right = self.of(formula.right)
        true = met(right.true, left and left.true, formula.bound, self._table)
        start, end = _asked(formula.bound, self._table)
        # What is behind the bound is known to be nothing when a frame comes that is behind it.
        closed = np.full_like(self._here, self._frames) if end is None else end
        false = _chained(right.false, left and left.false, start, end, closed, least=False)
        if left is not None and formula.bound.low:
            false = np.minimum(false, -_most(-left.false, self._here, start))
        return Known(true, false)

    def _since(self, formula: Since) -> Known:
        """The same backwards; at the first frame everything before is known."""
        frames, here = self._frames, self._here
        last = frames - 1
        left = None if formula.left == TRUE else self._turned(self.of(formula.left))
        right = self._turned(self.of(formula.right))
        near, far = self._table.window(formula.bound, forward=False)
        start = here if near is None else last - np.maximum(near, -1)[::-1]
        end = None if far is None else frames - np.maximum(far, 0)[::-1]
        before, never = np.full_like(here, -1), np.full_like(here, frames)
        true = _chained(right.true, left and left.true, start, end, never, least=True)
        false = _chained(right.false, left and left.false, start, end, before, least=False)
        if left is not None and near is not None:
            true = np.maximum(true, _most(left.true, here, start))
            false = np.minimum(false, -_most(-left.false, here, start))
        return Known(np.maximum(true[::-1], here), np.maximum(false[::-1], here))

    def _turned(self, told: Known) -> Known:
        return Known(told.true[::-1], told.false[::-1])


def met(right: Places, left: Places | None, bound: Bound, table: Table) -> Places:
    """From when on an *until* is known to be true at each frame, if nothing that is true becomes false.

    Parameters
    ----------
    right, left : (F,) int
        From when on its sides are; F: never. Without ``left``, that is true always.
    bound : Bound
    table : Table
    """
    here = table.frames
    start, end = _asked(bound, table)
    never = np.full_like(here, len(here))
    true = _chained(right, left, start, end, never, least=True)
    return true if left is None or not bound.low else np.maximum(true, _most(left, here, start))


def _asked(bound: Bound, table: Table) -> tuple[Places, Places | None]:
    """The first frame that an *until* asks its right side of, and that behind the last one, if there is one."""
    here, frames = table.frames, len(table.times)
    near, far = table.window(bound, forward=True)
    start = here if near is None else np.minimum(near, frames)
    return start, None if far is None else np.minimum(far + 1, frames)


def _chained(
    right: Places,
    left: Places | None,
    start: Places,
    end: Places | None,
    last: Places,
    *,
    least: bool,
) -> Places:
    """The chain max(right, min(left, …)) over places from ``start`` to before ``end``, ``last`` behind them.

    Parameters
    ----------
    right, left, last : (F,) int
        Without ``left`` only the greatest.
    start, end : (F,) int
        Without ``end`` up to the last place.
    least : bool
        Whether least and greatest change places.
    """
    if least:
        other = None if left is None else -left
        return -_chained(-right, other, start, end, -last, least=False)
    if left is None:
        return np.maximum(_most(right, start, end), last)
    if end is None:
        end = np.full_like(start, len(right))
    low, high = right.copy(), np.maximum(right, left)
    found_low = np.full_like(right, np.iinfo(right.dtype).min)
    found_high = np.full_like(right, np.iinfo(right.dtype).max)
    at, length, size = start.copy(), np.maximum(end - start, 0), 1
    longest = int(length.max(initial=0))
    while size <= longest:
        takes = np.flatnonzero(length & size)
        places = at[takes]
        a, b = found_low[takes], found_high[takes]
        found_low[takes] = np.maximum(a, np.minimum(b, low[places]))
        found_high[takes] = np.maximum(a, np.minimum(b, high[places]))
        at[takes] += size
        # Of the last places, behind which there is nothing, no longer chain is asked for.
        joined = np.minimum(high[:-size], low[size:]), np.minimum(high[:-size], high[size:])
        low[:-size], high[:-size] = (np.maximum(low[:-size], one) for one in joined)
        size *= 2
    return np.maximum(found_low, np.minimum(found_high, last))


def _most(values: Places, start: Places, end: Places | None) -> Places:
    """The greatest value from ``start`` to before ``end``; the least number there is, where that is nothing."""
    nothing = np.iinfo(values.dtype).min
    if end is None:
        onward = np.append(np.maximum.accumulate(values[::-1])[::-1], nothing)
        return onward.astype(values.dtype)[start]
    length = np.maximum(end - start, 0)
    most, size, longest = values.copy(), 1, int(length.max(initial=0))
    found = np.full(len(start), nothing, values.dtype)
    # The greatest of so many places is that of two stretches that may overlap.
    while size <= longest:
        takes = np.flatnonzero((length >= size) & (length < 2 * size))
        first, second = start[takes], end[takes] - size
        found[takes] = np.maximum(most[first], most[second])
        most[:-size] = np.maximum(most[:-size], most[size:])
        size *= 2
    return found
