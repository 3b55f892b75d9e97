"""First frame at which the truth value of a formula is final: no later frame can change it."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

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
)

if TYPE_CHECKING:
    from sgstore.model.world import Bools
    from sgstore.temporal._signals import Places, PropositionTable

# Each frame of a trace has two numbers: the first frame from which the formula is certainly true there, and the
# first from which it is certainly false. Undecided values get the number of frames. The numbers follow from
# those of the operands: a conjunction is false once one operand is false, and true once all are.
# :mod:`sgstore.temporal._formula` computes the same online.
#
# The decision of an *until* is a chain of minima and maxima over its bound. Chains of 2, 4, 8, … frames are
# combined for all frames, in O(n log n).


Decided = tuple["Places", "Places"]
"""For each frame (F,): the frame after which its value is certainly true, and certainly false. F: never."""


def known(  # noqa: PLR0911 - a case each
    formula: Formula, table: PropositionTable, *, ended: int | None = None
) -> Decided:
    """For each frame, return when the formula at this frame is decided as true, and when as false.

    F means never.

    Parameters
    ----------
    formula : Formula
    table : PropositionTable
        The trace.
    ended : int, optional
        If no frame follows: the tolerance added to bounds; ns. An operator whose bound is over, or unlimited,
        has then failed at the last frame.
    """
    again = partial(known, table=table, ended=ended)
    here, frames = table.frames, len(table.times)
    never = np.full_like(here, frames)
    match formula:
        case TruthConstant(value=value):
            return (here, never) if value else (never, here)
        case Proposition(name=name):
            flags = table.columns[name]
            return np.where(flags, here, never), np.where(flags, never, here)
        case Not(operand=operand):
            true, false = again(operand)
            return false, true
        case And(operands=operands):
            true, false = zip(*(again(operand) for operand in operands), strict=True)
            return np.maximum.reduce(true), np.minimum.reduce(false)
        case Or(operands=operands):
            true, false = zip(*(again(operand) for operand in operands), strict=True)
            return np.minimum.reduce(true), np.maximum.reduce(false)
        case Next(operand=operand):
            true, false = again(operand)
            last = never[:1] - 1 if ended is not None and endless(operand) else never[:1]
            return np.append(true[1:], never[:1]), np.append(false[1:], last)
        case Previous(operand=operand):
            true, false = again(operand)
            true, false = np.append(never[:1], true[:-1]), np.append(here[:1], false[:-1])
            return np.maximum(true, here), np.maximum(false, here)
        case Until():
            return _known_until(formula, table, ended=ended)
        case Since():
            return _known_since(formula, table, ended=ended)


def endless(formula: Formula) -> bool:
    """True if a formula is an *until* without upper time bound. It can stay open until the trace ends."""
    return isinstance(formula, Until) and formula.bound.high is None


def _known_until(formula: Until, table: PropositionTable, *, ended: int | None) -> Decided:
    here, bound = table.frames, formula.bound
    left = (None, None) if formula.left == TRUE else known(formula.left, table, ended=ended)
    right = known(formula.right, table, ended=ended)
    true = met(right[0], left[0], bound, table)
    start, end = _asked(bound, table)
    # The first frame after the bound decides that nothing else follows in it.
    closed = np.full_like(here, len(here)) if end is None else end
    if ended is not None:
        closed = np.where(_is_over(bound, table, ended), np.minimum(closed, len(here) - 1), closed)
    false = _chained(right[1], left[1], start, end, closed, least=False)
    if left[1] is not None and bound.low:
        false = np.minimum(false, -_most(-left[1], here, start))
    return true, false


def _is_over(bound: Bound, table: PropositionTable, widened: int) -> Bools:
    """Return a mask of the frames with a time bound that is over, or unlimited, when the trace ends."""
    if bound.high is None:
        return np.ones(len(table.times), np.bool_)
    if bound.frames:
        return table.frames + bound.high < len(table.times)
    return table.times[-1] - table.times >= bound.high - 2 * widened


def _known_since(formula: Since, table: PropositionTable, *, ended: int | None) -> Decided:
    """For each frame, return when a *since* is decided as true, and when as false.

    The frames before the trace count as known.
    """
    here, frames = table.frames, len(table.times)
    left = (None, None)
    if formula.left != TRUE:
        true, false = known(formula.left, table, ended=ended)
        left = true[::-1], false[::-1]
    right = [one[::-1] for one in known(formula.right, table, ended=ended)]
    near, far = table.window(formula.bound, forward=False)
    start = here if near is None else frames - 1 - np.maximum(near, -1)[::-1]
    end = None if far is None else frames - np.maximum(far, 0)[::-1]
    before, never = np.full_like(here, -1), np.full_like(here, frames)
    true = _chained(right[0], left[0], start, end, never, least=True)
    false = _chained(right[1], left[1], start, end, before, least=False)
    if left[0] is not None and near is not None:
        true = np.maximum(true, _most(left[0], here, start))
        false = np.minimum(false, -_most(-left[1], here, start))
    return np.maximum(true[::-1], here), np.maximum(false[::-1], here)


def met(right: Places, left: Places | None, bound: Bound, table: PropositionTable) -> Places:
    """For each frame, return the first frame at which an *until* is decided as true.

    Operands that become true must stay true.

    Parameters
    ----------
    right, left : (F,) int
        First frame from which each side is true; F: never. Without ``left``, the left side is true.
    bound : Bound
    table : PropositionTable
    """
    here = table.frames
    start, end = _asked(bound, table)
    never = np.full_like(here, len(here))
    true = _chained(right, left, start, end, never, least=True)
    return true if left is None or not bound.low else np.maximum(true, _most(left, here, start))


def _asked(bound: Bound, table: PropositionTable) -> tuple[Places, Places | None]:
    """For each frame, return the start and the end of the time bound of an *until*, as frames.

    ``None`` means no upper bound.
    """
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
    """For each frame, return the frame at which an *until* is decided, from decision frames of its operands.

    It uses minima and maxima of the numbers.

    Parameters
    ----------
    right, left, last : (F,) int
        Without ``left``, only the maximum applies.
    start, end : (F,) int
        Without ``end``, the range ends at the last frame.
    least : bool
        True to swap minimum and maximum.
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
        # The last positions need no longer chains, because nothing follows.
        joined = np.minimum(high[:-size], low[size:]), np.minimum(high[:-size], high[size:])
        low[:-size], high[:-size] = (np.maximum(low[:-size], one) for one in joined)
        size *= 2
    return np.maximum(found_low, np.minimum(found_high, last))


def _most(values: Places, start: Places, end: Places | None) -> Places:
    """Return, for each index range, the maximum of the values from ``start`` up to just before ``end``.

    An empty range gives the smallest integer.
    """
    nothing = np.iinfo(values.dtype).min
    if end is None:
        onward = np.append(np.maximum.accumulate(values[::-1])[::-1], nothing)
        return onward.astype(values.dtype)[start]
    length = np.maximum(end - start, 0)
    most, size, longest = values.copy(), 1, int(length.max(initial=0))
    found = np.full(len(start), nothing, values.dtype)
    # The maximum of an interval is the maximum of two overlapping intervals.
    while size <= longest:
        takes = np.flatnonzero((length >= size) & (length < 2 * size))
        first, second = start[takes], end[takes] - size
        found[takes] = np.maximum(most[first], most[second])
        most[:-size] = np.maximum(most[:-size], most[size:])
        size *= 2
    return found
