"""Which intervals of a line meet: how candidates are found without looking at all pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.relations.scene import spread

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.world import Floats, Ints

    Rows = NDArray[np.intp]

CHUNK: Final = 1 << 16
"""Candidates that are looked at together: bounds the memory of a crowd, and keeps it within a cache."""

FAR: Final = 1e9
"""Where the line ends; m. What lies beyond is taken to be there: it may be a candidate for more."""

_ROUNDING: Final = 1e-15
"""Relative error of a place on the line on which all groups lie one behind the other."""


def meeting(group: Ints, low: Floats, high: Floats) -> Iterator[tuple[Rows, Rows]]:
    """Each unordered pair of intervals of one group that meet, once; and some more that all but meet.

    Parameters
    ----------
    group : (N,) int64
        0 and above.
    low, high : (N,) float64
        Ends of the intervals. What is NaN meets nothing.

    Yields
    ------
    a, b : (n,) intp
        Rows, in chunks of about :data:`CHUNK`.
    """
    rows = np.flatnonzero(~np.isnan(low + high))
    if not len(rows):
        return
    group, low, high = group[rows], np.clip(low[rows], -FAR, FAR), np.clip(high[rows], -FAR, FAR)
    base = float(low.min())
    span = float(high.max()) - base + 1
    # All groups one behind the other: the intervals that meet one are the next in order, up to its end.
    start = group * span + (low - base)
    order = np.argsort(start, kind="stable")
    rows, start = rows[order], start[order]
    slack = _ROUNDING * span * (int(group.max()) + 2)
    end = group[order] * span + (high[order] - base) + slack
    first = np.arange(1, len(rows) + 1)
    count = np.searchsorted(start, end, side="right") - first
    for part in parts(count):
        owner, index = spread(first[part], count[part])
        yield rows[part][owner], rows[index]


def parts(count: Ints) -> Iterator[slice]:
    """Consecutive slices of counts that each add up to :data:`CHUNK` or little more."""
    total = np.cumsum(count)
    bounds = np.searchsorted(total, np.arange(CHUNK, int(total[-1]), CHUNK)) if len(total) else []
    for begin, end in zip([0, *bounds], [*bounds, len(count)], strict=True):
        yield slice(begin, end)
