"""Aggregates over ranges of frames and over time windows: minimum, maximum, sum and mean.

Offline, each frame has an interval, given by its first frame and the frame after its last. All frames are
processed at once, in O(n log w) for the longest interval w. Online, a stream keeps the values in its window.

**Sums are rounded once**: offline sums use three times the precision, online sums are integers. So the order of
additions and earlier values do not matter.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.lang.operators import Column

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.model.world import Floats
    from sgstore.temporal._progression import Tick

    Places = NDArray[np.int32 | np.int64]


def over_columns(word: str, column: Column, first: Places, end: Places | None = None) -> Column:
    """For each frame, return an aggregate of the known values in its time window.

    Parameters
    ----------
    word : str
        One of :data:`sgstore.lang.ir.WINDOWS`.
    column : Column
        (B, F) the values.
    first : (F,) int
        The first frame of each window.
    end : (F,) int, optional
        The frame after the last one of each window. ``None``: the window ends at its frame.

    Returns
    -------
    Column
        (B, F); unknown if the window has no known value.
    """
    frames = len(first)
    end = np.arange(1, frames + 1) if end is None else end
    shape = (*np.shape(column.values)[:-1], frames)
    values = np.broadcast_to(np.asarray(column.values, np.float64), shape)
    known = np.broadcast_to(column.known, shape)
    if word in {"min_over", "max_over"}:
        sign = 1.0 if word == "max_over" else -1.0
        found = sign * greatest(np.where(known, sign * values, -np.inf), first, end)
        return Column(found, _counts(known, first, end) > 0)
    known = known & np.isfinite(values)
    count = _counts(known, first, end)
    total = sums(np.where(known, values, 0.0), first, end)
    if word == "avg_over":
        total = total / np.maximum(count, 1)
    return Column(total, count > 0)


def greatest(values: Floats, first: Places, end: Places) -> Floats:
    """For each frame, return the maximum of the values in a range, from ``first`` to just before ``end``.

    An empty range gives ``-inf``.

    Parameters
    ----------
    values : (B, N) float64
    first, end : (F,) int
        From 0 to N.
    """
    length = np.maximum(end - first, 0)
    found = np.full((len(values), len(first)), -np.inf)
    longest, size = int(length.max(initial=0)), 1
    most = values
    # The maximum of an interval is the maximum of two overlapping intervals.
    while size <= longest:
        takes = np.flatnonzero((length >= size) & (length < 2 * size))
        whole = len(takes) == len(first)
        if len(takes):
            one, other = (first, end - size) if whole else (first[takes], end[takes] - size)
            both = np.take(most, one, axis=1)
            np.maximum(both, np.take(most, other, axis=1), out=both)
            if whole:
                return both
            found[:, takes] = both
        if 2 * size <= longest:
            most = np.maximum(most[:, :-size], most[:, size:])
        size *= 2
    return found


def sums(values: Floats, first: Places, end: Places) -> Floats:
    """For each frame, return the sum of the values in a range, from ``first`` to just before ``end``.

    Sums are correctly rounded.

    Parameters
    ----------
    values : (B, N) float64
        Finite.
    first, end : (F,) int
        From 0 to N.
    """
    total, less = _summed(values)
    lost, little = _summed(less)
    rest, _ = _summed(little)
    whole, more = _difference(total, first, end)
    part, fraction = _difference(lost, first, end)
    tail = fraction + (rest[:, end] - rest[:, first])
    middle = more + part
    tail += _lost(more, part, middle)
    found = whole + middle
    return found + (_lost(whole, middle, found) + tail)


def _summed(values: Floats) -> tuple[Floats, Floats]:
    total = np.zeros((len(values), values.shape[1] + 1))
    np.cumsum(values, axis=1, out=total[:, 1:])
    return total, _lost(total[:, :-1], values, total[:, 1:])


def _difference(total: Floats, first: Places, end: Places) -> tuple[Floats, Floats]:
    one, other = total[:, end], -total[:, first]
    found = one + other
    return found, _lost(one, other, found)


def _lost(one: Floats, other: Floats, total: Floats) -> Floats:
    """Return the exact rounding error of a sum of two numbers (Knuth's TwoSum)."""
    part = total - one
    return (one - (total - part)) + (other - part)


def _counts(known: NDArray[np.bool_], first: Places, end: Places) -> NDArray[np.int64]:
    total = np.zeros((len(known), known.shape[1] + 1), np.int64)
    np.cumsum(known, axis=1, out=total[:, 1:])
    return total[:, end] - total[:, first]


Point = tuple[int, int, float]
"""Known value: frame number, time (ns), and value."""

Window = tuple[tuple[Point, ...], int]
"""Values in a time window, and their exact sum as a multiple of the smallest positive float."""

_UNIT: Final = 1074
"""Exponent of the smallest positive float: the float is 2 to the power of minus this number."""


def next_window(
    word: str, window: Window | None, value: float | None, here: Tick, oldest: tuple[int, int]
) -> Window | None:
    """Move a time window to the next frame: add the frame's value, drop values that are too old.

    Parameters
    ----------
    word : str
        See :func:`over_columns`.
    window : Window or None
        ``None`` means an empty window.
    value : float or None
        ``None`` means unknown.
    here : Tick
        The frame.
    oldest : (int, int)
        Number and time (ns) of the oldest frame in the window.
    """
    points, total = window or ((), 0)
    gone = 0
    while gone < len(points) and (points[gone][0] < oldest[0] or points[gone][1] < oldest[1]):
        gone += 1
    summed = word in {"sum_over", "avg_over"}
    if summed:
        total -= sum(exact(point[2]) for point in points[:gone])
    points = points[gone:]
    if value is not None and (math.isfinite(value) or not summed):
        if summed:
            total += exact(value)
        else:  # an older value that is not better can never win again
            sign = 1 if word == "max_over" else -1
            kept = len(points)
            while kept and sign * points[kept - 1][2] <= sign * value:
                kept -= 1
            points = points[:kept]
        points = (*points, (here.number, here.time, value))
    return (points, total) if points else None


def window_value(word: str, window: Window | None) -> float | None:
    """Return the aggregate of the values in a time window; None without a known value."""
    if window is None:
        return None
    points, total = window
    if word in {"min_over", "max_over"}:
        return points[0][2]
    found = rounded(total)
    return found / len(points) if word == "avg_over" else found


def exact(value: float) -> int:
    """Return a float as an integer: its exact multiple of the smallest positive float (5e-324)."""
    part, whole = float(value).as_integer_ratio()
    return part << (_UNIT - whole.bit_length() + 1)


def rounded(total: int) -> float:
    """Return a float from its integer: that integer times the smallest positive float (5e-324)."""
    try:
        return total / (1 << _UNIT)
    except OverflowError:
        return math.copysign(math.inf, total)
